"""What is read from a report, and what verification says of it."""

from dataclasses import dataclass, field
from typing import Literal

# What Python raises where a value in a broken file is of another type, out of range or not there
BAD_VALUES = (
    ArithmeticError,
    AssertionError,
    LookupError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
)
# Of the numbers; the comparison of pages is a result of its own
Status = Literal["verified", "numbers differ", "other log", "cannot verify"]
PageStatus = Literal["same", "differ", "not compared"]


@dataclass(frozen=True)
class Mismatch:
    """One number or text that a new run of the analysis does not confirm.

    Attributes
    ----------
    path : str
        Where it stands in the results: ``axes.north.filters.kf.nis_mean``.
    recorded, recomputed : str
        "absent" where there is none.
    """

    path: str
    recorded: str
    recomputed: str


@dataclass(frozen=True)
class PageDifference:
    """A difference between the handed-in PDF and the report that px4fuse draws.

    Attributes
    ----------
    page : int
        Counted from 1; 0 for the document.
    what : str
        The difference: the end of a sentence.
    structural : bool
        The PDF has parts that px4fuse does not write, or lacks parts: another program made it, or
        something was added.
    """

    page: int
    what: str
    structural: bool = False

    @property
    def sentence(self) -> str:
        """The difference with its place."""
        return f"{f'page {self.page}' if self.page else 'document'}: {self.what}"


@dataclass(frozen=True)
class Verdict:
    """What verification found.

    Attributes
    ----------
    status : Status
        Of the numbers: whether the log gives them. "cannot verify" too if they are right, but the
        PDF has another structure than the redrawn one.
    reasons : tuple of str
        Sentences: what differs, or why nothing can be said; for "verified" what was checked.
    with_log : bool
        Whether the analysis was run again on the log.
    page_status : {"same", "differ", "not compared"}
        Result of the comparison of the handed-in PDF with the redrawn one.
    pages : tuple of PageDifference
        What differs.
    redrawn : bytes
        The report as px4fuse draws it from what the log gives, as a PDF: what to read instead of
        what was handed in. Empty where the analysis was not run again.
    remedy : str
        What whoever verifies it can do where nothing could be said: one sentence.
    missing : str
        Name of the log, or of another file, without which nothing could be said.
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
