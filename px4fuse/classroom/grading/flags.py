"""Sentences ("flags") for the instructor about suspicious reports, without effect on points.

A flag does not prove a copy.
"""

import math
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations

from px4fuse.classroom.assignment.roster import normalise_text
from px4fuse.classroom.grading.model import GradedReport
from px4fuse.core.text import capitalise_first, join_first_names, one_line
from px4fuse.request import LoopRequest
from px4fuse.results.answer_form import Answers, NumericAnswer
from px4fuse.results.contract import LoopResults, ReportedResults
from px4fuse.verification.model import Verification

# Minimum number of equal numbers in the reports of two students for a suspicion of a copy
MIN_EQUAL_NUMBERS_OF_A_COPY = 3
# Minimum number of answered multiple-choice questions for comparing two students
MIN_ANSWERED_CHOICES = 6
# Maximum relative difference of numbers that count as equal: a copy may have small changes
SAME_NUMBER_RELATIVE_TOLERANCE = 0.02
# Minimum fraction of the log that a report must analyse
MIN_ANALYSED_LOG_FRACTION = 0.5
# A report is flagged if --drift or --heading-drift differs from its default by this factor
MAX_DRIFT_TO_DEFAULT_RATIO = 4.0
MAX_LISTED_REPORTS = 4


def flag_page_differences(verification: Verification) -> Iterator[str]:
    """Yield the first difference between a PDF and the recomputed report, if any."""
    if verification.pages:
        yield (
            "The PDF differs from the report that px4fuse recomputed from the log. "
            f"{capitalise_first(verification.pages[0].sentence)}."
        )


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
    names_by_flag: dict[tuple[str, str], list[str]] = defaultdict(list)
    for report, other_report in combinations(reports, 2):
        for sentence in _find_equal_contents(report, other_report):
            for flagged, other in ((report, other_report), (other_report, report)):
                name = f"{_format_student(other)} ({one_line(other.submission, 80)})"
                names_by_flag[flagged.submission, sentence].append(name)
    flags_by_submission: dict[str, list[str]] = defaultdict(list)
    for (submission, sentence), names in names_by_flag.items():
        names_text = join_first_names(names, MAX_LISTED_REPORTS, "; ")
        flags_by_submission[submission].append(sentence.format(names_text))
    return flags_by_submission


def _find_equal_contents(report: GradedReport, other: GradedReport) -> Iterator[str]:
    """Yield a sentence for each content that is equal in two reports; "{}" is the other report."""
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
    """Return True for equal lists, and for nearly equal numbers with more than one digit."""
    if isinstance(answer, float) and isinstance(other_answer, float):
        has_one_digit = answer == float(f"{answer:.0e}")
        return not has_one_digit and math.isclose(
            answer, other_answer, rel_tol=SAME_NUMBER_RELATIVE_TOLERANCE
        )
    return isinstance(answer, tuple) and answer == other_answer != ()


def _identify_student(report: GradedReport) -> str:
    return normalise_text(report.student_id) or normalise_text(report.student) or report.submission


def _format_student(report: GradedReport) -> str:
    names = filter(None, (report.student.strip(), report.student_id.strip()))
    return one_line(", ".join(names) or report.submission, 80)
