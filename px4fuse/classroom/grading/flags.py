"""Sentences ("flags") for the instructor about suspicious reports, without effect on points.

A flag does not prove a copy.
"""

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from decimal import Decimal
from itertools import chain, combinations, permutations
from operator import attrgetter
from typing import Any

from px4fuse.classroom.assignment.roster import normalise_text
from px4fuse.classroom.grading.model import GradedReport
from px4fuse.core.text import capitalise_first, join_first_names, one_line
from px4fuse.request import LoopRequest
from px4fuse.results.contract import LoopResults, ReportedResults
from px4fuse.simulation import flights
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
# Pairs of reports with equal contents
ReportPairs = Iterator[tuple[GradedReport, GradedReport]]


def flag_page_differences(verification: Verification) -> Iterator[str]:
    """Yield the first difference between a PDF and the report drawn from its log, if any."""
    if verification.pages:
        first_difference, *further_differences = verification.pages
        count = len(further_differences)
        further_text = f" Further differences: {count}." if count else ""
        yield (
            "The PDF differs from the report that px4fuse draws from the log. "
            f"{capitalise_first(first_difference.sentence)}.{further_text} Read the redrawn report."
        )


def flag_settings(results: ReportedResults, has_key: bool = False) -> Iterator[str]:
    """Yield sentences about unusual settings of a report.

    ``has_key`` is True if the instructor handed out simulated logs.
    """
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
    names_of_received_tracks = [
        track.name for track in source.available if track.path == "as received"
    ]
    if names_of_received_tracks and source.path != "as received":
        yield (
            f"The position source is {source.name} ({source.path}). The positions as received by "
            f"PX4 are also in the log: {names_of_received_tracks[0]}."
        )
    if results.log.hardware == flights.SIMULATION_HARDWARE and not has_key:
        yield "The log is simulated (px4fuse simulate), not a real flight."


def _flag_drift(request: LoopRequest) -> Iterator[str]:
    """Yield sentences about --drift and --heading-drift values that are far from the default."""
    defaults = LoopRequest(source="")
    for option, unit, drift, default in (
        ("--drift", "m", request.position_drift_m, defaults.position_drift_m),
        ("--heading-drift", "°", request.heading_drift_deg, defaults.heading_drift_deg),
    ):
        if (
            not default / MAX_DRIFT_TO_DEFAULT_RATIO
            <= drift
            <= default * MAX_DRIFT_TO_DEFAULT_RATIO
        ):
            yield (
                f"{option} is {drift:g} {unit} per 100 m (default {default:g} {unit}). The test of "
                "the loop closure depends on this value. Ask the student for the reason."
            )


def _collect_form_numbers(report: GradedReport) -> dict[tuple[str, str], float]:
    """Return the numbers in a student's answers, by fault kind (or "") and field name."""
    if report.form is None:
        return {}
    answers: dict[tuple[str, str], object] = {
        (fault.kind, name): getattr(fault, name)
        for fault in report.form.mistakes
        for name in ("size", "value")
    }
    answers |= {("", f"q{index}"): number for index, number in enumerate(report.form.quantities)}
    # numbers of a list are compared as one number: (3, 14) as 314
    answers |= {
        (f"q{index}", "value"): float("".join(f"{number:.0f}" for number in numbers))
        for index, numbers in enumerate(report.form.quantities)
        if isinstance(numbers, tuple) and numbers
    }
    return {key: float(n) for key, n in answers.items() if isinstance(n, float | int)}


def _count_same_numbers(numbers: Mapping[Any, float], other_numbers: Mapping[Any, float]) -> int:
    """Count the equal numbers of two students, except numbers with one digit."""
    return sum(
        _count_digits(number) > 1
        and abs(number - other_numbers[key])
        <= (key[1] != "value") * SAME_NUMBER_RELATIVE_TOLERANCE * abs(number)
        for key, number in numbers.items()
        if key in other_numbers
    )


def _identify_student(report: GradedReport) -> str:
    return normalise_text(report.student_id) or normalise_text(report.student) or report.submission


# Sentence for the instructor, compared content of two reports, and content that must differ
EQUAL_CONTENT_CHECKS: tuple[
    tuple[str, Callable[[GradedReport], object], Callable[[GradedReport], str]], ...
] = (
    ("This PDF is identical to the PDF of {}.", attrgetter("sha256"), attrgetter("submission")),
    (
        "The student id in this report is also in the report of {}.",
        lambda report: normalise_text(report.student_id),
        attrgetter("submission"),
    ),
    (
        "This report is about the same log as the report of {}.",
        attrgetter("log_sha256"),
        _identify_student,
    ),
    (
        "The numbers equal those in the report of {}, but the SHA-256 of the log differs: the "
        "report is a copy.",
        lambda report: (
            report.verification.status == "verified"
            and len(report.numbers) >= MIN_EQUAL_NUMBERS_OF_A_COPY
            and tuple(report.numbers.values())
        ),
        attrgetter("log_sha256"),
    ),
    (
        "The answers about the figures equal those of {}, whose figures were different.",
        lambda report: (
            report.form
            and sum(map(bool, report.form.choices)) >= MIN_ANSWERED_CHOICES
            and report.form.choices
        ),
        _identify_student,
    ),
)


def flag_equal_contents(reports: Sequence[GradedReport]) -> Mapping[str, Sequence[str]]:
    """Return sentences about reports with equal contents, by name of the submitted file."""
    flags_by_submission: dict[str, list[str]] = defaultdict(list)
    for flag_text, pairs in (
        *(
            (flag_text, _find_equal_reports(reports, get_compared_content, get_required_difference))
            for flag_text, get_compared_content, get_required_difference in EQUAL_CONTENT_CHECKS
        ),
        (
            "The answer form contains the same numbers as the answer form of {}. It may be a copy.",
            _find_copied_forms(reports),
        ),
    ):
        students_by_submission: dict[str, list[str]] = defaultdict(list)
        for report, other_report in chain.from_iterable(map(permutations, pairs)):
            file_name = one_line(other_report.submission, 80)
            students_by_submission[report.submission].append(
                f"{_format_student(other_report)} ({file_name})"
            )
        for submission_name, student_texts in students_by_submission.items():
            flags_by_submission[submission_name].append(
                flag_text.format(join_first_names(student_texts, MAX_LISTED_REPORTS, "; "))
            )
    return flags_by_submission


def _find_equal_reports(
    reports: Sequence[GradedReport],
    get_compared_content: Callable[[GradedReport], object],
    get_required_difference: Callable[[GradedReport], str],
) -> ReportPairs:
    reports_by_content: dict[object, list[GradedReport]] = defaultdict(list)
    for report in reports:
        reports_by_content[get_compared_content(report)].append(report)
    for content, equal_reports in reports_by_content.items():
        for report, other_report in combinations(equal_reports if content else (), 2):
            if get_required_difference(report) != get_required_difference(other_report):
                yield report, other_report


def _find_copied_forms(reports: Sequence[GradedReport]) -> ReportPairs:
    """Yield pairs of reports of different students whose answers have equal numbers."""
    reports_and_numbers = [(report, _collect_form_numbers(report)) for report in reports]
    for (report, numbers), (other_report, other_numbers) in combinations(reports_and_numbers, 2):
        is_copied = _count_same_numbers(numbers, other_numbers) >= MIN_EQUAL_NUMBERS_OF_A_COPY
        if is_copied and _identify_student(report) != _identify_student(other_report):
            yield report, other_report


def _format_student(report: GradedReport) -> str:
    names = filter(None, (report.student.strip(), report.student_id.strip()))
    return one_line(", ".join(names) or report.submission, 80)


def _count_digits(number: float) -> int:
    return len(Decimal(repr(abs(number))).normalize().as_tuple().digits) if number else 0
