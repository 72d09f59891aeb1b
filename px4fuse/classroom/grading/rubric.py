"""Scoring of reports by a rubric, the instructor's list of checks that give points.

Suspicious reports get flags: sentences for the instructor, without effect on points.
A flag does not prove a copy.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, Union

import msgspec
from msgspec import Meta

from px4fuse.core.reading import read_text
from px4fuse.core.record import Record
from px4fuse.core.text import capitalise_first_letter, join_first_names, shorten_to_line
from px4fuse.errors import SettingsError
from px4fuse.request import LoopRequest
from px4fuse.results.answer_form import Answers, NumericAnswer
from px4fuse.results.contract import LoopResults, ReportedResults
from px4fuse.verification.model import Verification
from px4fuse.verification.verification import log_sha256, make_unverifiable_result

from ..assignment.key import AnswerKey
from ..assignment.roster import make_unique, normalise_text
from .checks import (
    FORM_MISMATCH_REASON,
    OneLineText,
    RubricItem,
    ScoringInput,
    format_reason,
    shorten_text,
)
from .form_points import FormPoints
from .model import TOTAL_POINTS_TITLE, GradedReport, ItemScore

DEFAULT_RUBRIC = Path(__file__).with_name("rubric.toml")
MAX_RUBRIC_BYTES = 1_000_000
RUBRIC_HELP = "Write an example rubric with px4fuse grade --write-rubric FILE.toml."

# Columns of the class table with numbers from the reports: title, and path in the results
CLASS_TABLE_NUMBERS = (
    ("SIGMA_A (m/s²)", "settings.sigma_a_m_s2"),
    ("SIGMA_Z (m)", "settings.sigma_z_m"),
    ("mean NIS of KF, north", "axes.north.filters.kf.nis_mean"),
    ("mean NIS of KF, east", "axes.east.filters.kf.nis_mean"),
    (
        "position RMSE of KF against ground truth, along the axis of largest motion (m)",
        "axes.aisle.filters.kf.truth.position_rmse_m",
    ),
    ("closure error (m)", "loop.closure_error_m"),
)

# Minimum number of equal numbers in the reports or answer forms of two students for a suspicion of
# a copy
MIN_EQUAL_NUMBERS_OF_A_COPY = 3
# Minimum number of answered multiple-choice questions for comparing two students
MIN_ANSWERED_CHOICES = 6
# Numbers in the answer forms of two students count as equal if their relative difference is at most
# this value, because a student may slightly change a copied number
SAME_NUMBER_RELATIVE_TOLERANCE = 0.02
# Minimum fraction of the log that a report must analyse
MIN_ANALYSED_LOG_FRACTION = 0.5
# A report is flagged if --drift or --heading-drift differs from its default by this factor
MAX_DRIFT_TO_DEFAULT_RATIO = 4.0
MAX_LISTED_REPORTS = 4

if TYPE_CHECKING:
    AnyRubricItem = RubricItem
else:
    # union of all subclasses; the field "check" in the TOML file selects the subclass
    AnyRubricItem = Union[tuple(RubricItem.__subclasses__())]  # noqa: UP007
# Rule for the points of a report; "pending" points need a decision of the instructor
ReportPointsRule = Literal["pending", "zero", "count"]


class Rubric(Record, kw_only=True):
    """Instructor's list of checks that give points to a report.

    Attributes
    ----------
    unverified : {"pending", "zero"}
        Rule for a report that could not be verified.
    others_log : {"pending", "zero", "count"}
        Rule for a report on the log of another student.
    pages : {"count", "pending", "zero"}
        Rule for a report with verified numbers whose pages differ from the recomputed report.
    """

    title: OneLineText = ""
    unverified: Literal["pending", "zero"] = "pending"
    others_log: ReportPointsRule = "pending"
    pages: ReportPointsRule = "count"
    items: Annotated[tuple[AnyRubricItem, ...], Meta(min_length=1, max_length=100)] = msgspec.field(
        name="item"
    )

    def __post_init__(self) -> None:
        titles = [TOTAL_POINTS_TITLE, *(item.title for item in self.items)]
        for title, unique_title in zip(titles, make_unique(titles), strict=True):
            if title != unique_title:
                raise ValueError(
                    f"the item title {title!r} is not unique or is reserved. Choose another title"
                )


def read_default_rubric_text() -> str:
    return DEFAULT_RUBRIC.read_text("utf-8")


def read_rubric(path: Path | None) -> Rubric:
    """Read and check a rubric; None for the default rubric.

    Raises
    ------
    SettingsError
        The file cannot be read or is not a rubric.
    """
    path = path or DEFAULT_RUBRIC
    return parse_rubric(read_text(path, SettingsError, MAX_RUBRIC_BYTES, name=str(path)), str(path))


def parse_rubric(text: str, source_name: str) -> Rubric:
    """Parse and check the text (TOML) of a rubric."""
    try:
        return msgspec.convert(tomllib.loads(text), Rubric)
    # tomllib raises ValueError for a syntax error, and for an integer with very many digits
    except (msgspec.ValidationError, ValueError, RecursionError) as error:
        message = re.sub(r"`\$\.item\[(\d+)\]\.?([^`]*)`", _format_item_and_field, str(error))
        raise SettingsError(
            f"{source_name}: {shorten_to_line(message, 300)}", RUBRIC_HELP
        ) from error


def _format_item_and_field(path: re.Match[str]) -> str:
    """Convert a path of msgspec, such as ``$.item[3].points``, to "item 4, field points"."""
    return f"item {int(path[1]) + 1}{f', field {path[2]}' * bool(path[2])}"


# ------------------------------------------------------------------ points

FORM_MISMATCH_ADVICE = (
    "The answer form was made for another log. Ask for a report with the right form."
)


def score_report(
    results: ReportedResults,
    verification: Verification,
    rubric: Rubric,
    key: AnswerKey | None,
    submitter_id: str = "",
) -> GradedReport:
    """Compute the points of a report, and add sentences about suspicious contents.

    ``submitter_id`` is the student id on the learning platform.
    """
    scoring_input = ScoringInput(results, verification, key, submitter_id)
    student, values = results.student, scoring_input.values
    problems = [*_find_problems(scoring_input, rubric)]
    zero_points_reasons = [reason for rule, reason, _ in problems if rule == "zero"]
    pending_actions = [action for rule, _, action in problems if rule == "pending"]
    items = [*_score_items(scoring_input, rubric)]
    if zero_points_reasons:
        comment, pending_actions = f"No points: {zero_points_reasons[0]}.", []
        items = [
            replace(item, points=0.0, comment=comment, is_awaiting_points=False) for item in items
        ]
    form_points = scoring_input.form_points
    if isinstance(form_points, str) or not scoring_input.is_own_log:
        form_points = FormPoints()
    return GradedReport(
        "",
        student.name,
        student.id,
        verification,
        tuple(items),
        flags=tuple(_flag_report(scoring_input)),
        instructor_action=" ".join(pending_actions),
        did_student_name_fault=form_points.did_student_name_fault,
        form_part_scores=form_points.parts,
        form=scoring_input.form if isinstance(scoring_input.form, Answers) else None,
        numbers={
            title: float(values[path]) for title, path in CLASS_TABLE_NUMBERS if path in values
        },
        log_sha256=log_sha256(results),
        version=results.provenance.px4fuse,
        notes=student.notes,
    )


def _score_items(scoring_input: ScoringInput, rubric: Rubric) -> Iterator[ItemScore]:
    """Yield the points of each rubric item that applies to the command of the report."""
    command = "loop" if isinstance(scoring_input.results, LoopResults) else "compare"
    has_text = bool(scoring_input.results.student.notes.strip())
    for item in rubric.items:
        if item.is_applicable(command, scoring_input.key):
            fraction, comment = item.score(scoring_input)
            yield ItemScore(
                item.title,
                round(item.points * fraction, 2),
                item.points,
                comment,
                item.is_scored_by_instructor,
                item.is_scored_by_instructor and has_text,
            )


def _flag_report(scoring_input: ScoringInput) -> Iterator[str]:
    """Yield flags about changed pages, unusual settings, and a log or form of another student."""
    page_differences = scoring_input.verification.pages
    if page_differences:
        yield (
            "The PDF differs from the report that px4fuse recomputed from the log. "
            f"{capitalise_first_letter(page_differences[0].sentence)}."
        )
    yield from flag_settings(scoring_input.results)
    if not scoring_input.is_own_log:
        yield _make_other_students_log_advice(scoring_input)
    if scoring_input.has_form_of_other_log:
        yield FORM_MISMATCH_ADVICE


def _find_problems(
    scoring_input: ScoringInput, rubric: Rubric
) -> Iterator[tuple[ReportPointsRule, str, str]]:
    """Yield the problems of a student's report that affect its points.

    A problem consists of the rule for the points, the reason for the student and the action of the
    instructor.
    """
    verification = scoring_input.verification
    reason_text = format_reason("".join(verification.reasons[:1]))
    if verification.status == "numbers differ":
        yield "zero", f"the numbers of your report differ from those of its log{reason_text}", ""
    elif verification.status != "verified":
        action = verification.remedy or f"Check the report by hand: not verified{reason_text}."
        yield rubric.unverified, f"your report could not be verified{reason_text}", action
    elif verification.page_status == "differ":
        yield (
            rubric.pages,
            "some pages of your PDF differ from the report recomputed from its log",
            "Compare the pages of the PDF with the report that px4fuse recomputed from the log.",
        )
    if not scoring_input.is_own_log:
        action = _make_other_students_log_advice(scoring_input)
        yield rubric.others_log, "your report is not about the log that you were given", action
    if scoring_input.has_form_of_other_log:
        yield "pending", FORM_MISMATCH_REASON, FORM_MISMATCH_ADVICE
    if scoring_input.key is not None and getattr(scoring_input.results.request, "position", None):
        action = (
            "Ask the student where the position file comes from: students are given a log only."
        )
        yield "pending", "", action


def _make_other_students_log_advice(scoring_input: ScoringInput) -> str:
    """Return the action of the instructor for a report on the log of another student."""
    student_id = shorten_text(scoring_input.results.student.id)
    id_text = f"the student id {student_id}" if student_id else "no student id"
    if scoring_input.right_answers is None:
        return (
            "The log of the report is not in the answer key. Ask for a report on the assigned log."
        )
    assigned_id = shorten_text(scoring_input.right_answers.student_id)
    advice = (
        f"Ask who wrote the report: its log was assigned to student {assigned_id}, but the report "
        f"contains {id_text}."
    )
    if scoring_input.submitter_id:
        advice += f" Student {shorten_text(scoring_input.submitter_id)} submitted the report."
    return advice


def grade_unreadable_file(
    rubric: Rubric, key: AnswerKey | None, reason: str, remedy: str = ""
) -> GradedReport:
    """Return zero points for a file that is not a report."""
    comment = f"0 points: the file is not a px4fuse report ({shorten_text(reason).rstrip('.')})."
    graded_items = tuple(
        ItemScore(item.title, 0.0, item.points, comment)
        for item in rubric.items
        if item.is_applicable("compare", key)
    )
    return GradedReport(
        "", "", "", make_unverifiable_result(reason, remedy), graded_items, instructor_action=remedy
    )


# ------------------------------------------------------------------ flags


def flag_settings(results: ReportedResults) -> Iterator[str]:
    """Yield sentences about unusual settings of a report."""
    if isinstance(results, LoopResults):
        yield from _flag_drift(results.request)
        return
    settings, log_duration_s = results.settings, results.log.duration_s
    analysed_fraction = (
        (settings.end_s - settings.start_s) / log_duration_s if log_duration_s else 1.0
    )
    has_time_options = (results.request.start_s, results.request.end_s) != (None, None)
    if has_time_options and analysed_fraction < MIN_ANALYSED_LOG_FRACTION:
        yield (
            f"The student analysed only {analysed_fraction:.0%} of the log ({settings.start_s:.1f} "
            f"to {settings.end_s:.1f} s of {log_duration_s:.1f} s). Ask the student for the reason."
        )
    has_no_imu = any(finding.id == "acceleration_not_logged" for finding in results.findings)
    if settings.input == "zero" and not has_no_imu:
        yield "KF did not use the IMU (--input zero)."
    source = results.source
    if source.path != "as received" and any(
        track.path == "as received" for track in source.available
    ):
        yield (
            f"The position source is {source.name} ({source.path}). The log also contains the "
            "positions as received by PX4."
        )


def _flag_drift(request: LoopRequest) -> Iterator[str]:
    """Yield sentences about --drift and --heading-drift values that are far from the default."""
    defaults = LoopRequest(source="")
    for option, unit, drift, default in (
        ("--drift", "m", request.position_drift_m, defaults.position_drift_m),
        ("--heading-drift", "°", request.heading_drift_deg, defaults.heading_drift_deg),
    ):
        ratio = drift / default
        if not 1.0 / MAX_DRIFT_TO_DEFAULT_RATIO <= ratio <= MAX_DRIFT_TO_DEFAULT_RATIO:
            yield (
                f"{option} is {drift:g} {unit} per 100 m (default {default:g} {unit}). The test of "
                "the loop closure depends on this value. Ask the student for the reason."
            )


def flag_equal_contents(reports: Sequence[GradedReport]) -> Mapping[str, Sequence[str]]:
    """Return sentences about reports with equal contents, by name of the submitted file."""
    other_report_names_by_flag: dict[tuple[str, str], list[str]] = defaultdict(list)
    for report, other_report in combinations(reports, 2):
        for sentence in _find_equal_contents(report, other_report):
            for flagged, other in ((report, other_report), (other_report, report)):
                name = f"{_format_student(other)} ({shorten_to_line(other.submission, 80)})"
                other_report_names_by_flag[flagged.submission, sentence].append(name)
    flags_by_submission: dict[str, list[str]] = defaultdict(list)
    for (submission, sentence), names in other_report_names_by_flag.items():
        names_text = join_first_names(names, MAX_LISTED_REPORTS, "; ")
        flags_by_submission[submission].append(sentence.format(names_text))
    return flags_by_submission


def _find_equal_contents(report: GradedReport, other: GradedReport) -> Iterator[str]:
    """Yield a sentence for each part that two reports have in common; "{}" is the other report.

    Parts are the PDF, the student id, the log, the numbers, and the answers of the form. The same
    log and equal forms are reported only for two different students.
    """
    is_other_student = _identify_student(report) != _identify_student(other)
    is_same_log = report.log_sha256 == other.log_sha256
    if report.sha256 == other.sha256 != "":
        yield "This PDF is identical to the PDF of {}."
    if normalise_text(report.student_id) == normalise_text(other.student_id) != "":
        yield "The student id in this report is also in the report of {}."
    if is_same_log and is_other_student and report.log_sha256:
        yield "This report is about the same log as the report of {}."
    if (
        report.verification.status == other.verification.status == "verified"
        and report.numbers == other.numbers
        and len(report.numbers) >= MIN_EQUAL_NUMBERS_OF_A_COPY
        and not is_same_log
    ):
        yield (
            "The numbers equal those in the report of {}, but the SHA-256 of the log differs: the "
            "report is a copy."
        )
    if report.form is None or other.form is None or not is_other_student:
        return
    choices = report.form.choices
    if choices == other.form.choices and sum(map(bool, choices)) >= MIN_ANSWERED_CHOICES:
        yield "The answers about the plots are the same as those of {}, but the plots differ."
    if _count_equal_numbers(report.form, other.form) >= MIN_EQUAL_NUMBERS_OF_A_COPY:
        yield (
            "The answer form contains the same numbers as the answer form of {}. It may be a copy."
        )


def _count_equal_numbers(form: Answers, other_form: Answers) -> int:
    """Count the equal sizes of faults and equal numbers in the answer forms of two students."""
    pairs = [*zip(form.quantities, other_form.quantities, strict=False)]
    pairs += [
        (fault.size, other_fault.size)
        for fault in form.mistakes
        for other_fault in other_form.mistakes
        if fault.kind == other_fault.kind
    ]
    return sum(_is_same_number(*pair) for pair in pairs)


def _is_same_number(answer: NumericAnswer, other_answer: NumericAnswer) -> bool:
    """Return True if two answers are so similar that one may be copied from the other.

    Numbers with one significant digit do not count, because they are often equal by chance.
    """
    if isinstance(answer, float) and isinstance(other_answer, float):
        has_one_digit = answer == float(f"{answer:.0e}")
        return not has_one_digit and math.isclose(
            answer, other_answer, rel_tol=SAME_NUMBER_RELATIVE_TOLERANCE
        )
    return isinstance(answer, tuple) and answer == other_answer != ()


def _identify_student(report: GradedReport) -> str:
    """Return a text that identifies the student: id, else name, else submitted file."""
    return normalise_text(report.student_id) or normalise_text(report.student) or report.submission


def _format_student(report: GradedReport) -> str:
    names = filter(None, (report.student.strip(), report.student_id.strip()))
    return shorten_to_line(", ".join(names) or report.submission, 80)
