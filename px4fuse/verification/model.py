"""Results of verification: verdict, and differences of numbers and pages."""

from dataclasses import dataclass, field
from typing import Literal

# Python errors caused by values of a damaged file: wrong type, out of range, missing
BAD_VALUES = (
    ArithmeticError,
    AssertionError,
    LookupError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
)
# results of the comparison of numbers (Status) and of the comparison of pages (PageStatus)
Status = Literal["verified", "numbers differ", "other log", "cannot verify"]
PageStatus = Literal["same", "differ", "not compared"]


@dataclass(frozen=True)
class Mismatch:
    """Value in a report that differs from the value of a new run of the analysis.

    Attributes
    ----------
    path : str
        Path in the results, for example ``axes.north.filters.kf.nis_mean``.
    recorded, recomputed : str
        Values; "absent" if missing.
    """

    path: str
    recorded: str
    recomputed: str


@dataclass(frozen=True)
class PageDifference:
    """Difference between the handed-in PDF and the report that px4fuse draws.

    Attributes
    ----------
    page : int
        Page number from 1; 0 for the document.
    what : str
        Difference, as the end of a sentence that begins with the page.
    is_structural : bool
        True if parts of the PDF are added or missing, because another program wrote the file.
    """

    page: int
    what: str
    is_structural: bool = False

    @property
    def sentence(self) -> str:
        """Sentence with page and difference."""
        return f"{f'page {self.page}' if self.page else 'document'}: {self.what}"


@dataclass(frozen=True)
class Verdict:
    """Result of a verification.

    Attributes
    ----------
    status : Status
        Result of the comparison of numbers. If the numbers agree, it is still "cannot verify" in
        two cases: the structure of the PDF differs from that of the redrawn report, or pages differ
        and the report was made with other library versions.
    reasons : tuple of str
        Sentences: the differences, the reason for "cannot verify", or the checks of a verified
        report.
    with_log : bool
        True if the analysis was repeated on the log.
    page_status : {"same", "differ", "not compared"}
        Result of the comparison of pages.
    pages : tuple of PageDifference
    redrawn : bytes
        Report that px4fuse drew from the repeated analysis (PDF), to be read instead of the
        handed-in one; empty if the analysis was not repeated.
    remedy : str
        Action if the report was not verified: one sentence.
    missing : str
        Name of the log or other input file that is missing; else empty.
    """

    status: Status
    reasons: tuple[str, ...]
    with_log: bool
    differences: tuple[Mismatch, ...] = ()
    page_status: PageStatus = "not compared"
    pages: tuple[PageDifference, ...] = ()
    redrawn: bytes = field(default=b"", repr=False)
    remedy: str = ""
    missing: str = ""

    @property
    def outcome(self) -> str:
        """Status, or "page differs" if the numbers are verified and the pages are not."""
        differ = self.status == "verified" and self.page_status == "differ"
        return "page differs" if differ else self.status
