"""Result of verifying a report (PDF) against its log."""

from dataclasses import dataclass, field
from typing import Literal

# Exceptions that missing or invalid values in a damaged file can raise
BAD_VALUE_ERRORS = (
    ArithmeticError,
    AssertionError,
    LookupError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
)
# Results of comparing numbers and pages of a report with a new analysis
VerificationStatus = Literal["verified", "numbers differ", "other log", "cannot verify"]
PageStatus = Literal["same", "differ", "not compared"]


@dataclass(frozen=True)
class Mismatch:
    """Value in a report that differs from a new analysis of the log.

    Attributes
    ----------
    path : str
        Field of the results, for example ``axes.north.filters.kf.nis_mean``.
    recorded : str
        Value in the report; "absent" for a missing value.
    recomputed : str
        Value in the new analysis; "absent" for a missing value.
    """

    path: str
    recorded: str
    recomputed: str


@dataclass(frozen=True)
class PageDifference:
    """Difference between a submitted PDF and the report that px4fuse recomputes from the log.

    Attributes
    ----------
    page : int
        Page number; 0 for the whole document.
    what : str
        Description of the difference.
    is_structural : bool
        True for added or missing PDF objects.
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
        Sentences that explain the status.
    with_log : bool
        True if the analysis was repeated on the log.
    redrawn_pdf : bytes
        PDF report of the repeated analysis, or empty.
    remedy : str
        Action of the user if the report was not verified.
    missing : str
        Name of a missing log or other input file.
    """

    status: VerificationStatus
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
        """Result of the verification for users.

        It is ``status``, or "page differs" if the numbers are verified but pages of the PDF differ.
        """
        has_different_pages = self.status == "verified" and self.page_status == "differ"
        return "page differs" if has_different_pages else self.status
