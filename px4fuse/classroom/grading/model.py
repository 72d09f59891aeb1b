"""Data classes for grading: submitted files, graded reports, and points per student."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

from px4fuse.results.answer_form import Answers
from px4fuse.verification.model import Verification

from ..assignment.roster import Person

# Name of the sum of all points, in overrides.csv and messages
TOTAL_POINTS_TITLE = "total"

UNKNOWN_PERSON = Person("")


@dataclass(frozen=True)
class SubmissionOrigin:
    """Student and submission time that a learning platform writes into a file name.

    Attributes
    ----------
    platform : str
        Name of the learning platform; "" if no platform wrote the file name.
    person : Person
        Student, with the number that the platform uses.
    time : datetime or None
        Submission time; without time zone if the platform omits it.
    is_late : bool
        True if the platform marks the file as late.
    has_imitated_platform_name : bool
        True if the student's own file name imitates that of a platform.
    """

    platform: str = ""
    person: Person = UNKNOWN_PERSON
    time: datetime | None = None
    is_late: bool = False
    has_imitated_platform_name: bool = False


UNKNOWN_SUBMISSION_ORIGIN = SubmissionOrigin()


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
        Unique, shortened name for messages.
    """

    file: Path
    zip_entry: str
    name: str
    origin: SubmissionOrigin = UNKNOWN_SUBMISSION_ORIGIN


@dataclass(frozen=True)
class ItemScore:
    """Points of a report for one rubric item, with a comment for the student.

    ``is_awaiting_points`` is True if the instructor has not yet entered the points.
    """

    title: str
    points: float
    max_points: float
    comment: str
    is_scored_by_instructor: bool = False
    is_awaiting_points: bool = False


@dataclass(frozen=True)
class GradedReport:
    """Submitted report with its points and the result of its verification.

    Attributes
    ----------
    submission : str
        Name of the submission in messages.
    origin : SubmissionOrigin
        Student and submission time from the learning platform.
    student, student_id : str
        Name and id in the report.
    instructor_action : str
        Decision that the instructor must make before the points count; "" if none is needed.
    flags : tuple of str
        Sentences for the instructor about suspicious contents.
    form : Answers or None
        Answers of the student to the questions about the flight.
    numbers : mapping
        Numbers of the report for the table of the class, by column title.
    version : str
        Version of px4fuse that wrote the report.
    did_student_name_fault : mapping
        For each injected fault of the student's flight: True if the student named the fault.
    form_part_scores : tuple of ItemScore
        Points for each part of ``form``, 100 points in total.
    redrawn_report_path : str
        Relative path of the report (PDF) that px4fuse recomputes from the log.
    """

    submission: str
    student: str
    student_id: str
    verification: Verification
    items: tuple[ItemScore, ...] = ()
    flags: tuple[str, ...] = ()
    instructor_action: str = ""
    form: Answers | None = None
    numbers: Mapping[str, float] = field(default_factory=dict)
    sha256: str = ""
    log_sha256: str = ""
    version: str = ""
    notes: str = field(default="", repr=False)
    did_student_name_fault: Mapping[str, bool] = field(default_factory=dict)
    form_part_scores: tuple[ItemScore, ...] = ()
    origin: SubmissionOrigin = UNKNOWN_SUBMISSION_ORIGIN
    redrawn_report_path: str = ""

    @property
    def status(self) -> str:
        """Status of the verification, for example "verified" or "numbers differ"."""
        return self.verification.outcome

    @property
    def points(self) -> float:
        """Sum of the points of all rubric items, also those that the instructor must confirm."""
        return sum(item.points for item in self.items)

    @property
    def counted_points(self) -> float | None:
        """Sum of the points; None while a decision or points of the instructor are missing."""
        return None if self.instructor_action or self.is_awaiting_points else self.points

    @property
    def is_awaiting_points(self) -> bool:
        return any(item.is_awaiting_points for item in self.items)

    @property
    def pending_actions(self) -> str:
        """Actions required of the instructor before the points count; "" for none."""
        actions = [
            f"Enter the points of the item {item.title}."
            for item in self.items
            if item.is_awaiting_points
        ]
        return " ".join([self.instructor_action, *actions]).strip()

    @property
    def max_points(self) -> float:
        return sum(item.max_points for item in self.items)


@dataclass(frozen=True)
class GradeOverride:
    """Points and comment of the instructor; the points replace those computed by px4fuse."""

    points: float | None = None
    comment: str = ""


@dataclass(frozen=True)
class Grade:
    """Grade of a student, or of a report whose student is unknown.

    Attributes
    ----------
    counted_report : GradedReport or None
        Report that counts; None without a submission.
    other_reports : tuple of GradedReport
        Reports of the student that do not count, earliest first.
    lateness_s : float or None
        Submission time minus due time (s), 0 if in time; None if unknown.
    deducted_points : float
        Points deducted for late submission.
    overrides : mapping
        Points and comments of the instructor, by rubric item, "total", or "" (whole report).
    total : float or None
        Points after deductions; None without a submission or with a pending decision.
    """

    student: str
    student_id: str
    counted_report: GradedReport | None
    other_reports: tuple[GradedReport, ...] = ()
    submission_time: str = ""
    lateness_s: float | None = None
    deducted_points: float = 0.0
    overrides: Mapping[str, GradeOverride] = field(default_factory=dict)
    comment: str = ""
    total: float | None = None
    max_points: float = 0.0
    flags: tuple[str, ...] = ()

    @property
    def reports(self) -> tuple[GradedReport, ...]:
        return tuple(filter(None, (self.counted_report, *self.other_reports)))

    @property
    def file_name(self) -> str:
        """Name of the submitted file that is graded; "" without a submission."""
        return self.counted_report.submission if self.counted_report else ""

    @property
    def display_name(self) -> str:
        return self.student or self.student_id or "no name"


def select_counted_reports(grades: Sequence[Grade]) -> list[GradedReport]:
    return [report for grade in grades if (report := grade.counted_report)]


def list_item_titles(grades: Sequence[Grade]) -> list[str]:
    """Return the titles of all rubric items that score a report."""
    items = (item for report in select_counted_reports(grades) for item in report.items)
    return [*dict.fromkeys(item.title for item in items)]
