"""Records of grading: submitted files, graded reports, and rows of the class table."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

from px4fuse.classroom.assignment.roster import Person
from px4fuse.results.answer_form import Answers
from px4fuse.verification.model import Verification

# Title of the sum over all rubric items, in overrides.csv and messages
TOTAL_TITLE = "total"

UNKNOWN_PERSON = Person("")


@dataclass(frozen=True)
class ExportOrigin:
    """Student and submission time of a file, as a learning platform encodes them in its name.

    Attributes
    ----------
    platform : str
        Learning platform (``platforms.toml``); "" if no platform wrote the file name.
    person : Person
        Student. ``numbers`` contains the number of the participant (Moodle), the user (Canvas,
        ILIAS) or the submission (Gradescope).
    time : datetime or None
        Submission time; without time zone if the platform omits it.
    is_late : bool
        True if the platform marks the file as late.
    is_imitated : bool
        True if the student imitated the file name of a platform.
    """

    platform: str = ""
    person: Person = UNKNOWN_PERSON
    time: datetime | None = None
    is_late: bool = False
    is_imitated: bool = False


UNKNOWN_SUBMITTER = ExportOrigin()


@dataclass(frozen=True)
class Submission:
    """Submitted PDF: a file, or an entry of a zip file.

    Attributes
    ----------
    file : Path
        The PDF, or the zip file that contains it.
    zip_entry : str
        Name of the entry in the zip file; "" for a file.
    name : str
        Unique name for messages, with at most 200 characters.
    time : datetime or None
        Time of the zip entry (submission or download), in an unknown time zone.
    """

    file: Path
    zip_entry: str
    name: str
    time: datetime | None = None
    origin: ExportOrigin = UNKNOWN_SUBMITTER


@dataclass(frozen=True)
class Item:
    """Points of a report for one item of the rubric, with a comment for the student.

    ``awaits_points`` is True until the instructor scores an item that px4fuse cannot score.
    """

    title: str
    points: float
    max_points: float
    comment: str
    is_scored_by_instructor: bool = False
    awaits_points: bool = False


@dataclass(frozen=True)
class GradedReport:
    """Submitted report with its points and the result of its verification.

    Attributes
    ----------
    submission : str
        Name of the submission in messages.
    student, student_id : str
        Name and id in the report.
    instructor_action : str
        Decision that the instructor has to make before the points count; "" if they count.
    numbers : mapping
        Numbers of the report for the class table, by column title.
    version : str
        Version of px4fuse that made the report.
    mistakes : mapping
        True for each injected fault of the assigned flight that the answer form names.
    form_parts : tuple of Item
        Points for each part of the answer form, of 100 points in total.
    redrawn_path : str
        Path of the PDF that px4fuse drew again from the log, relative to the class page.
    """

    submission: str
    student: str
    student_id: str
    verification: Verification
    items: tuple[Item, ...] = ()
    flags: tuple[str, ...] = ()
    instructor_action: str = ""
    form: Answers | None = None
    numbers: Mapping[str, float] = field(default_factory=dict)
    sha256: str = ""
    log_sha256: str = ""
    version: str = ""
    notes: str = field(default="", repr=False)
    mistakes: Mapping[str, bool] = field(default_factory=dict)
    form_parts: tuple[Item, ...] = ()
    redrawn_path: str = ""

    @property
    def status(self) -> str:
        """Status of the verification; "page differs" if only pages differ."""
        return self.verification.outcome

    @property
    def points(self) -> float:
        """Sum of the points of all items, with those that do not count yet."""
        return sum(item.points for item in self.items)

    @property
    def counted_points(self) -> float | None:
        """Sum of the points; None while the instructor has to decide or to score an item."""
        return None if self.instructor_action or self.awaits_points else self.points

    @property
    def awaits_points(self) -> bool:
        return any(item.awaits_points for item in self.items)

    @property
    def pending_reason(self) -> str:
        """Actions of the instructor before the points count; "" if they count."""
        actions = [
            f"Enter the points of the item {item.title}."
            for item in self.items
            if item.awaits_points
        ]
        return " ".join([self.instructor_action, *actions]).strip()

    @property
    def max_points(self) -> float:
        return sum(item.max_points for item in self.items)


@dataclass(frozen=True)
class Override:
    """Points of the instructor, which replace those of px4fuse, and an additional comment."""

    points: float | None = None
    comment: str = ""


@dataclass(frozen=True)
class Entry:
    """Row of the class table: a student, or a report of an unknown student.

    Attributes
    ----------
    counted_report : GradedReport or None
        Report that counts, with the instructor's points; None without a submission.
    other_reports : tuple of GradedReport
        Reports of the same student that do not count, earliest first.
    late_s : float or None
        Submission time minus due time (s), 0 if in time; None if unknown.
    deduction : float
        Points deducted for late submission.
    overrides : mapping
        Points and comments of the instructor, by item title, "total", or "" (the whole report).
    total : float or None
        Grade in points; None without a submission, and while the instructor has to decide.
    """

    student: str
    student_id: str
    counted_report: GradedReport | None
    other_reports: tuple[GradedReport, ...] = ()
    submission_time: str = ""
    late_s: float | None = None
    deduction: float = 0.0
    overrides: Mapping[str, Override] = field(default_factory=dict)
    comment: str = ""
    total: float | None = None
    max_points: float = 0.0
    flags: tuple[str, ...] = ()

    @property
    def reports(self) -> tuple[GradedReport, ...]:
        return (*([self.counted_report] if self.counted_report else []), *self.other_reports)

    @property
    def display_name(self) -> str:
        return self.student or self.student_id or "no name"


def list_titles(entries: Sequence[Entry]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the titles of all rubric items, and of all numbers of reports."""
    reports = [report for entry in entries if (report := entry.counted_report)]
    items = dict.fromkeys(item.title for report in reports for item in report.items)
    numbers = dict.fromkeys(title for report in reports for title in report.numbers)
    return tuple(items), tuple(numbers)
