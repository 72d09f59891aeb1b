"""What is read from a report, and what verification says of it."""

from dataclasses import dataclass, field
from typing import Literal

# What Python raises where a value in a broken file is of another type, out of range or not there
BAD_VALUES = (
    ArithmeticError, AssertionError, LookupError, OSError, RuntimeError, TypeError, ValueError,
)  # fmt: skip
# Of the numbers; how the pages look is a result of its own
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
    """A page that was handed in and does not look like the one that px4fuse draws.

    Attributes
    ----------
    page : int
        Counted from 1.
    what : str
        In what it differs: the end of a sentence.
    words : int
        Places where its text is another.
    picture : float
        How far the pictures are apart, from 0 to 1; see :mod:`px4fuse.verification.pages`.
    """

    page: int
    what: str
    words: int
    picture: float


@dataclass(frozen=True)
class Verdict:
    """What verification found.

    Attributes
    ----------
    status : Status
        Of the numbers: whether the log gives them.
    reasons : tuple of str
        Sentences: what differs, or why nothing can be said; for "verified" what was checked.
    with_log : bool
        Whether the analysis was run again on the log.
    page_status : {"same", "differ", "not compared"}
        Whether the pages that were handed in look like the redrawn ones.
    pages : tuple of PageDifference
        Those that do not.
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
    def page(self) -> int:
        """The page that differs most, counted from 1; the cover where none does."""
        most = max(self.pages, key=lambda one: (one.picture, one.words), default=None)
        return most.page if most else 1

    @property
    def outcome(self) -> str:
        """In two words: the status, and where that is "verified" what the pages add to it."""
        if self.status != "verified" or self.page_status == "same":
            return self.status
        return "page differs" if self.page_status == "differ" else "pages not compared"
