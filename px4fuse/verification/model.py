"""Results of verification: verdict, and differences of numbers and pages."""

from dataclasses import dataclass, field
from typing import Literal

# Python errors that missing or invalid values in a damaged file can raise
BAD_VALUE_ERRORS = (
    ArithmeticError,
    AssertionError,
    LookupError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
)
# Result of comparing the numbers (Status) and the pages (PageStatus) of a report with a new run
Status = Literal["verified", "numbers differ", "other log", "cannot verify"]
PageStatus = Literal["same", "differ", "not compared"]


@dataclass(frozen=True)
class Mismatch:
    """Value in a report that a new run of the analysis does not reproduce.

    ``path`` is the place in the results, such as ``axes.north.filters.kf.nis_mean``. A missing
    value is "absent".
    """

    path: str
    recorded: str
    recomputed: str


@dataclass(frozen=True)
class PageDifference:
    """Difference between a submitted PDF and the report that px4fuse draws again.

    ``page`` is 0 for the whole document. ``is_structural`` is True if the difference shows that
    another program wrote the file, as added or missing PDF objects do.
    """

    page: int
    what: str
    is_structural: bool = False

    @property
    def sentence(self) -> str:
        return f"{f'page {self.page}' if self.page else 'document'}: {self.what}"


@dataclass(frozen=True)
class Verification:
    """Result of verifying a report against its log.

    Attributes
    ----------
    reasons : tuple of str
        Sentences with the differences, the reason for "cannot verify", or the successful checks.
    with_log : bool
        True if the analysis was repeated on the log.
    redrawn_pdf : bytes
        Report from the repeated analysis, to be read instead of the submitted PDF; empty if the
        analysis was not repeated.
    remedy : str
        Action of the user if the report was not verified.
    missing : str
        Name of a missing log or other input file.
    """

    status: Status
    reasons: tuple[str, ...]
    with_log: bool
    differences: tuple[Mismatch, ...] = ()
    page_status: PageStatus = "not compared"
    pages: tuple[PageDifference, ...] = ()
    redrawn_pdf: bytes = field(default=b"", repr=False)
    remedy: str = ""
    missing: str = ""

    @property
    def outcome(self) -> str:
        """Status of the numbers, or "page differs" if only pages of the report differ."""
        has_different_pages = self.status == "verified" and self.page_status == "differ"
        return "page differs" if has_different_pages else self.status
