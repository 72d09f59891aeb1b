"""What is read from a submission, what verification says of it, and what it is worth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

# Whether the file is, to the byte, as px4fuse wrote it
Seal = Literal["intact", "broken", "missing"]
Status = Literal["verified", "numbers differ", "page altered", "other log", "cannot verify"]


@dataclass(frozen=True)
class Submission:
    """One PDF that was handed in: a file, or an entry of a zip file.

    Attributes
    ----------
    file : Path
        The PDF itself, or the zip file that holds it.
    entry : str
        Name of the entry in the zip file, as it stands there; "" for a file.
    name : str
        For people: without folders of this machine, control characters or more than 200
        characters. Unique within a run.
    """

    file: Path
    entry: str
    name: str


@dataclass(frozen=True)
class Report:
    """A report as it was handed in.

    Attributes
    ----------
    sha256 : str
        Of the PDF.
    size_bytes : int
    seal : {"intact", "broken", "missing"}
    results : dict
        The attached results; a JSON object with a ``schema`` of px4fuse's.
    pages : tuple of str
        Text of each page.
    pdf : bytes
        The file itself.
    """

    sha256: str
    size_bytes: int
    seal: Seal
    results: dict[str, Any]
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


@dataclass(frozen=True)
class Item:
    """Points for one part of the rubric, and why."""

    title: str
    points: float
    of: float
    comment: str


@dataclass(frozen=True)
class Graded:
    """One submission, graded.

    Attributes
    ----------
    submission : str
        :attr:`Submission.name`.
    student, student_id : str
        As the report says; "" where it does not.
    verdict : Verdict
        "cannot verify" with the reason for what is no report.
    items : tuple of Item
        In the rubric's order.
    flags : tuple of str
        What an instructor should look at: sentences.
    numbers : mapping
        A few for the class table, by column title; absent ones are left out.
    sha256, log_sha256, version : str
        Of the PDF, of the log it is about, and of px4fuse; "" where unknown.
    settings : str
        The settings to the last digit, for comparison between students.
    notes : str
        The student's own words.
    picture : bytes
        PNG of the report's key page; empty without.
    """

    submission: str
    student: str
    student_id: str
    verdict: Verdict
    items: tuple[Item, ...] = ()
    flags: tuple[str, ...] = ()
    numbers: Mapping[str, float] = field(default_factory=dict)
    sha256: str = ""
    log_sha256: str = ""
    version: str = ""
    settings: str = ""
    notes: str = field(default="", repr=False)
    picture: bytes = field(default=b"", repr=False)

    @property
    def points(self) -> float:
        """Sum over the items."""
        return sum(item.points for item in self.items)

    @property
    def of(self) -> float:
        """The most that there is to have."""
        return sum(item.of for item in self.items)
