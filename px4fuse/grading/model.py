"""Data of grading: submissions, graded reports, and rows of the class."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

from px4fuse.answer_form import Answers
from px4fuse.assignment.roster import Person
from px4fuse.verification.model import Verdict

# title of the sum over all items
TOTAL = "total"


UNKNOWN_PERSON = Person("")


@dataclass(frozen=True)
class ExportOrigin:
    """Information of a learning platform about a file.

    Attributes
    ----------
    platform : str
        One of :data:`px4fuse.grading.submissions.PLATFORMS`; "" if the name is not of a platform.
    person : Person
        Student; the number is that of the platform (participant in Moodle, user in Canvas and
        ILIAS, submission in Gradescope).
    time : datetime or None
        Submission time; without time zone if the platform omits it.
    late : bool
        The platform marks the file as late.
    is_imitated : bool
        The part of the name that the student chose imitates the names of a platform.
    """

    platform: str = ""
    person: Person = UNKNOWN_PERSON
    time: datetime | None = None
    late: bool = False
    is_imitated: bool = False


UNKNOWN_SUBMITTER = ExportOrigin()


@dataclass(frozen=True)
class Submission:
    """PDF that was handed in: a file, or an entry of a zip file.

    Attributes
    ----------
    file : Path
        The PDF, or the zip file that contains it.
    entry : str
        Name of the entry in the zip file; "" for a file.
    name : str
        Name in messages: one line of at most 200 characters, without folders of this computer;
        unique in a run by a number at the end.
    time : datetime or None
        Time of the zip entry, in an unknown time zone: submission or packing.
    origin : ExportOrigin
        Student and time according to a platform.
    """

    file: Path
    entry: str
    name: str
    time: datetime | None = None
    origin: ExportOrigin = UNKNOWN_SUBMITTER


@dataclass(frozen=True)
class Item:
    """Points of a report for one item of the rubric, with a comment.

    ``by_hand``: scored by the instructor; ``awaits_points``: not yet scored.
    """

    title: str
    points: float
    of: float
    comment: str
    by_hand: bool = False
    awaits_points: bool = False


@dataclass(frozen=True)
class GradedReport:
    """Submission with verdict and points; missing texts are empty.

    Attributes
    ----------
    submission : str
        :attr:`Submission.name`.
    student, student_id : str
        As in the report.
    verdict : Verdict
        Result of verification; "cannot verify" for a file that is not a report.
    items : tuple of Item
        In the order of the rubric.
    flags : tuple of str
        Sentences on suspicious contents, for the instructor.
    pending : str
        Action of the instructor before the points count; "" if they count.
    form : Answers or None
        Completed answer form.
    numbers : mapping
        Numbers of the class table, by column title.
    sha256, log_sha256, version : str
        SHA-256 of the PDF and of its log, and px4fuse version of the report.
    notes : str
        Text of the student.
    mistakes : mapping
        Mistakes of the student's flight (answer key); True if the form names them.
    redrawn_name : str
        Path of the redrawn PDF, relative to the class page.
    """

    submission: str
    student: str
    student_id: str
    verdict: Verdict
    items: tuple[Item, ...] = ()
    flags: tuple[str, ...] = ()
    pending: str = ""
    form: Answers | None = None
    numbers: Mapping[str, float] = field(default_factory=dict)
    sha256: str = ""
    log_sha256: str = ""
    version: str = ""
    notes: str = field(default="", repr=False)
    mistakes: Mapping[str, bool] = field(default_factory=dict)
    redrawn_name: str = ""

    @property
    def status(self) -> str:
        """Outcome of the verification, including "page differs"."""
        return self.verdict.outcome

    @property
    def points(self) -> float:
        """Sum over the items; only a proposal while :attr:`pending`."""
        return sum(item.points for item in self.items)

    @property
    def counted(self) -> float | None:
        """Points that count; None while they, or points of an item, are pending."""
        return None if self.pending or self.awaits_points else self.points

    @property
    def awaits_points(self) -> bool:
        """True if the instructor has not scored an item yet."""
        return any(item.awaits_points for item in self.items)

    @property
    def of(self) -> float:
        """Maximum points."""
        return sum(item.of for item in self.items)


@dataclass(frozen=True)
class Override:
    """Points or comment, or both, that the instructor sets."""

    points: float | None = None
    comment: str = ""


@dataclass(frozen=True)
class Entry:
    """Row of the class: a student, or a report of an unknown student.

    Attributes
    ----------
    student, student_id : str
        As in the class list, else as in the report or platform.
    counting : GradedReport or None
        Attempt that counts, with overrides applied; None without a submission.
    others : tuple of GradedReport
        Other attempts, earliest first.
    handed_in : str
        Submission time of the counting attempt; "" if unknown.
    late_s : float or None
        Time after the due time (s), 0 if in time; None if unknown.
    deduction : float
        Points deducted for late submission.
    overrides : mapping
        Overrides by the title of an item, "total", or "" (the whole report).
    comment : str
        Comment of the instructor on the whole report.
    total : float or None
        Grade in points; None while pending or missing.
    of : float
        Maximum points.
    flags : tuple of str
        All flags: on student and attempt, on the report, and on equal contents of other reports.
    """

    student: str
    student_id: str
    counting: GradedReport | None
    others: tuple[GradedReport, ...] = ()
    handed_in: str = ""
    late_s: float | None = None
    deduction: float = 0.0
    overrides: Mapping[str, Override] = field(default_factory=dict)
    comment: str = ""
    total: float | None = None
    of: float = 0.0
    flags: tuple[str, ...] = ()

    @property
    def files(self) -> tuple[GradedReport, ...]:
        """All attempts, the one that counts first."""
        return (*([self.counting] if self.counting else []), *self.others)

    @property
    def display_name(self) -> str:
        """Name of the student on the class page."""
        return self.student or self.student_id or "no name"


def columns(entries: Sequence[Entry]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the titles of all items and of all numbers of the class, each once."""
    graded = [one for entry in entries if (one := entry.counting)]
    items = dict.fromkeys(item.title for one in graded for item in one.items)
    return tuple(items), tuple(dict.fromkeys(title for one in graded for title in one.numbers))
