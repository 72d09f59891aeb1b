"""What is read from a report, and what verification says of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from px4fuse.results.contract import Reported

# Whether the file is, to the byte, as px4fuse wrote it
Seal = Literal["intact", "broken", "missing"]
Status = Literal["verified", "numbers differ", "page altered", "other log", "cannot verify"]


@dataclass(frozen=True)
class Report:
    """A report as it was handed in.

    Attributes
    ----------
    sha256 : str
        Of the PDF.
    size_bytes : int
    seal : {"intact", "broken", "missing"}
    results : ComparisonResults or LoopResults
        The attached results.
    pages : tuple of str
        Text of each page.
    pdf : bytes
        The file itself.
    """

    sha256: str
    size_bytes: int
    seal: Seal
    results: Reported
    pages: tuple[str, ...]
    pdf: bytes = field(repr=False)


@dataclass(frozen=True)
class Refused:
    """A submission that cannot be read as a report, and why: one sentence for a person."""

    reason: str


@dataclass(frozen=True)
class Difference:
    """One number or text that a new run of the analysis does not confirm.

    Attributes
    ----------
    path : str
        Where it stands in the results: ``axes.north.kf.nis_mean``.
    recorded, recomputed : str
        "absent" where there is none.
    """

    path: str
    recorded: str
    recomputed: str


@dataclass(frozen=True)
class Verdict:
    """What verification found.

    Attributes
    ----------
    status : Status
    reasons : tuple of str
        Sentences: what differs, or why nothing can be said; for "verified" what was checked.
    with_log : bool
        Whether the analysis was run again on the log.
    differences : tuple of Difference
    pages : tuple of int
        Pages, counted from 1, that are not what the results print.
    """

    status: Status
    reasons: tuple[str, ...]
    with_log: bool
    differences: tuple[Difference, ...] = ()
    pages: tuple[int, ...] = ()
