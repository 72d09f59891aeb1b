"""What is handed in, and what it is worth: a submission, what it earns, and a student's row."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

from px4fuse.answers import Answers
from px4fuse.assignment.roster import Person
from px4fuse.verification.model import Verdict

# What the sum over the items is called
TOTAL = "total"


UNKNOWN_PERSON = Person("")


@dataclass(frozen=True)
class ExportOrigin:
    """What a platform says of a file that was handed in.

    Attributes
    ----------
    platform : str
        One of :data:`px4fuse.grading.submissions.PLATFORMS`; "" where the name is of no platform.
    person : Person
        The student, as far as the platform says; its number is the platform's own (Moodle's
        participant, Canvas's and ILIAS's user, Gradescope's submission), never the university's.
    time : datetime or None
        Without a time zone where the platform leaves it out.
    late : bool
        Whether the platform marks it so.
    is_imitated : bool
        Whether a student's own part of the name looks like a platform's.
    """

    platform: str = ""
    person: Person = UNKNOWN_PERSON
    time: datetime | None = None
    late: bool = False
    is_imitated: bool = False


UNKNOWN_SUBMITTER = ExportOrigin()


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
        characters, a number behind it not counted. Unique within a run.
    time : datetime or None
        Of the entry in the zip file, in an unknown time zone: when the platform took it, or when
        it packed the zip file.
    origin : ExportOrigin
        Who handed it in, as a platform says.
    """

    file: Path
    entry: str
    name: str
    time: datetime | None = None
    origin: ExportOrigin = UNKNOWN_SUBMITTER


@dataclass(frozen=True)
class Item:
    """Points for one part of the rubric, and why.

    ``by_hand``: only the instructor gives them; ``awaits_points``: has not yet.
    """

    title: str
    points: float
    of: float
    comment: str
    by_hand: bool = False
    awaits_points: bool = False


@dataclass(frozen=True)
class GradedReport:
    """One submission, graded; texts and bytes are empty where there is nothing to say.

    Attributes
    ----------
    submission : str
        :attr:`Submission.name`.
    student, student_id : str
        As the report says.
    verdict : Verdict
        "cannot verify" with the reason for what is not a report.
    items : tuple of Item
        In the rubric's order.
    flags : tuple of str
        What an instructor should look at in this report: sentences.
    pending : str
        One sentence: what the instructor can do so that the points count.
    form : Answers or None
        The form as it was filled in.
    numbers : mapping
        A few for the class table, by column title.
    sha256, log_sha256, version : str
        Of the PDF, of the log it is about, and of px4fuse.
    notes : str
        The student's own words.
    mistakes : mapping
        What the answer key says is wrong in the student's flight, and whether the form names it.
    redrawn_name : str
        Where the redrawn PDF stands, relative to the class page.
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
        """That of the verdict, or "page differs" if only the numbers are verified."""
        return self.verdict.outcome

    @property
    def points(self) -> float:
        """Sum over the items; while :attr:`pending` a proposal, never to be added to anything."""
        return sum(item.points for item in self.items)

    @property
    def counted(self) -> float | None:
        """The points that count; None while they, or some of them, are the instructor's to say."""
        return None if self.pending or self.awaits_points else self.points

    @property
    def awaits_points(self) -> bool:
        """Whether the instructor has not yet given the points of an item."""
        return any(item.awaits_points for item in self.items)

    @property
    def of(self) -> float:
        """The most that there is to have."""
        return sum(item.of for item in self.items)


@dataclass(frozen=True)
class Override:
    """What the instructor says instead: points, or words, or both."""

    points: float | None = None
    comment: str = ""


@dataclass(frozen=True)
class Entry:
    """One row of the class: a student, or a report that belongs to nobody known.

    Attributes
    ----------
    student, student_id : str
        As the roster says; of somebody who is not in it, as the report or the platform says.
    counting : Graded or None
        The attempt that counts, with the instructor's points and comments on its items; None where
        nothing was handed in.
    others : tuple of Graded
        Further attempts, earliest first.
    handed_in : str
        When the counting one was handed in, as the platform says; "" where unknown.
    late_s : float or None
        After the due time (s), 0 in time; None where one of the two is unknown.
    deduction : float
        Points taken off for being late, from the sum over the items.
    overrides : mapping
        What the instructor says, by the title of an item, "total", or "" for all of it.
    comment : str
        The instructor's own words on all of it.
    total : float or None
        What is entered as the grade; None while pending or missing.
    of : float
        The most that there is to have.
    flags : tuple of str
        All that an instructor should look at: on who this is and what counts, on the counting
        report, and on what it has in common with others.
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
        """What the class page calls the student."""
        return self.student or self.student_id or "no name"


def columns(entries: Sequence[Entry]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Titles of the items and of the numbers that the class has, each once."""
    graded = [one for entry in entries if (one := entry.counting)]
    items = dict.fromkeys(item.title for one in graded for item in one.items)
    return tuple(items), tuple(dict.fromkeys(title for one in graded for title in one.numbers))
