"""Flags: sentences for the instructor about suspicious reports. They do not change points.

A flag does not prove a copy: two students may fly together, and students who follow the advice of
px4fuse get the same settings.
"""

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from decimal import Decimal
from itertools import combinations
from operator import attrgetter
from typing import Any

from px4fuse.assignment.roster import normalise_text
from px4fuse.filter.tuning import NoiseEstimate
from px4fuse.grading.model import GradedReport
from px4fuse.request import LoopRequest
from px4fuse.results.contract import LoopResults, ReportedResults
from px4fuse.results.reading import one_line
from px4fuse.simulation import flights
from px4fuse.text import capitalise_first, join_first
from px4fuse.verification.model import Verdict

# minimum number of equal numbers in two answer forms that are flagged, and relative tolerance of
# equal numbers, which detects a copy with small changes
MIN_SAME_NUMBERS, SAME_NUMBER_TOLERANCE = 3, 0.02
# minimum fraction of the log in the segment of --start and --end; a shorter segment is flagged
MIN_SEGMENT_FRACTION = 0.5
# maximum factor between SIGMA_A or SIGMA_Z and its maximum-likelihood estimate, in both directions
MAX_SETTING_FACTOR = 30.0
# maximum factor between --drift or --heading-drift and its default, in both directions
MAX_DRIFT_FACTOR = 4.0
# maximum number of reports that a flag lists
MAX_LISTED_REPORTS = 4
# pairs of reports with the same contents
Pairs = Iterator[tuple[GradedReport, GradedReport]]


def flag_pages(verdict: Verdict) -> Iterator[str]:
    """Flag a PDF that differs from the redrawn report, with the first difference."""
    if verdict.pages:
        first, *others = verdict.pages
        more_text = f" The PDF has {len(others)} more differences." if others else ""
        yield (
            "The PDF differs from the report that px4fuse draws from the log. "
            f"{capitalise_first(first.sentence)}.{more_text} Read the redrawn report."
        )


def flag_settings(results: ReportedResults, has_key: bool = False) -> Iterator[str]:
    """Flag unusual settings of one report.

    ``has_key``: True if there is an answer key; a simulated log is then expected.
    """
    if isinstance(results, LoopResults):
        yield from _flag_drift(results.request)
        return
    settings, whole_s = results.settings, results.log.duration_s
    segment_fraction = (settings.end_s - settings.start_s) / whole_s if whole_s else 1.0
    has_segment = (results.request.start_s, results.request.end_s) != (None, None)
    if has_segment and segment_fraction < MIN_SEGMENT_FRACTION:
        yield (
            f"The student analysed only {segment_fraction:.0%} of the log "
            f"({settings.start_s:.1f} to {settings.end_s:.1f} s of {whole_s:.1f} s). Ask for the "
            "reason."
        )
    if not {"north", "east", "aisle"} & set(results.axes):
        yield "Only the vertical axis was analysed (--axis)."
    without_imu = any(finding.id == "acceleration_not_logged" for finding in results.findings)
    if settings.input == "zero" and not without_imu:
        yield "The IMU was not used (--input zero)."
    source = results.source
    tracks_as_received = [track.name for track in source.available if track.path == "as received"]
    if tracks_as_received and source.path != "as received":
        yield (
            f"The position source is {source.name} ({source.path}), not "
            f"{tracks_as_received[0]}, the positions as received by PX4."
        )
    for name, label in (("sigma_z_m", "SIGMA_Z"), ("sigma_a_m_s2", "SIGMA_A")):
        value = getattr(settings, name)
        tuned = (
            estimate for estimate in results.tuning.values() if isinstance(estimate, NoiseEstimate)
        )
        ml_values = [ml_value for estimate in tuned if (ml_value := getattr(estimate, name))]
        if ml_values and not min(ml_values) / MAX_SETTING_FACTOR < value < MAX_SETTING_FACTOR * max(
            ml_values
        ):
            yield (
                f"{label} {value:g} differs by more than a factor of {MAX_SETTING_FACTOR:g} from "
                f"its maximum-likelihood estimate ({ml_values[0]:.3g})."
            )
    if results.log.hardware == flights.HARDWARE and not has_key:
        yield "The log is simulated (px4fuse simulate), not a real flight."


def _flag_drift(request: LoopRequest) -> Iterator[str]:
    """Flag a drift of the odometry, stated by an option, that is far from the default.

    The chi-square test of a loop closure uses this drift; the limit is MAX_DRIFT_FACTOR.
    """
    defaults = LoopRequest(source="")
    for option, unit, drift, default in (
        ("--drift", "m", request.position_drift_m, defaults.position_drift_m),
        ("--heading-drift", "°", request.heading_drift_deg, defaults.heading_drift_deg),
    ):
        if not default / MAX_DRIFT_FACTOR <= drift <= default * MAX_DRIFT_FACTOR:
            yield (
                f"{option} is {drift:g} {unit} per 100 m (default {default:g} {unit}). The test of "
                "the loop closure depends on this value. Ask for the reason."
            )


def _form_numbers(report: GradedReport) -> dict[tuple[str, str], float]:
    """Return the numbers of an answer form, by (mistake, "size" or "value") or ("", question)."""
    if report.form is None:
        return {}
    values_by_place: dict[tuple[str, str], object] = {
        (mistake.kind, name): getattr(mistake, name)
        for mistake in report.form.mistakes
        for name in ("size", "value")
    }
    values_by_place |= {
        ("", f"q{index}"): number for index, number in enumerate(report.form.quantities)
    }
    return {key: float(n) for key, n in values_by_place.items() if isinstance(n, float | int)}


def _count_same_numbers(numbers: Mapping[Any, float], other_numbers: Mapping[Any, float]) -> int:
    """Count the equal numbers of two forms that have more than one digit.

    Sizes and answers are equal within SAME_NUMBER_TOLERANCE, values of corrections exactly.
    """
    return sum(
        _count_digits(number) > 1
        and abs(number - other_numbers[key])
        <= (key[1] != "value") * SAME_NUMBER_TOLERANCE * abs(number)
        for key, number in numbers.items()
        if key in other_numbers
    )


def _student_key(report: GradedReport) -> str:
    return normalise_text(report.student_id) or normalise_text(report.student) or report.submission


# checks for equal contents: sentence of the flag, function for the content (empty contents are not
# compared), and function for the owner. Only reports of different owners are flagged: for example,
# two reports of one student may be about the same log
COMMON_CHECKS: tuple[
    tuple[str, Callable[[GradedReport], object], Callable[[GradedReport], str]], ...
] = (
    ("This PDF is identical to that of {}.", attrgetter("sha256"), attrgetter("submission")),
    (
        "The id in this report is also in that of {}.",
        lambda report: normalise_text(report.student_id),
        attrgetter("submission"),
    ),
    ("This report is about the same log as that of {}.", attrgetter("log_sha256"), _student_key),
    (
        "The numbers are those of {}, but the SHA-256 of the log differs: a changed copy of the "
        "log.",
        lambda report: (
            report.verdict.status == "verified"
            and len(report.numbers) >= MIN_SAME_NUMBERS
            and tuple(report.numbers.values())
        ),
        attrgetter("log_sha256"),
    ),
)


def flag_equal_contents(reports: Sequence[GradedReport]) -> Mapping[str, Sequence[str]]:
    """Return the flags of :data:`COMMON_CHECKS` and of copied forms, by name of the submission."""
    flags_by_submission: dict[str, list[str]] = defaultdict(list)
    for sentence, pairs in (
        *(
            (sentence, _same_pairs(reports, key_of, owner_of))
            for sentence, key_of, owner_of in COMMON_CHECKS
        ),
        ("The answer form has the same numbers as that of {}.", _copied_forms(reports)),
    ):
        texts_by_submission: dict[str, list[str]] = defaultdict(list)
        for first, second in pairs:
            for report, other in ((first, second), (second, first)):
                file = one_line(other.submission, 80)
                texts_by_submission[report.submission].append(f"{_student_text(other)} ({file})")
        for name, texts in texts_by_submission.items():
            flags_by_submission[name].append(
                sentence.format(join_first(texts, MAX_LISTED_REPORTS, "; "))
            )
    return flags_by_submission


def _same_pairs(
    reports: Sequence[GradedReport],
    key_of: Callable[[GradedReport], object],
    owner_of: Callable[[GradedReport], str],
) -> Pairs:
    groups: dict[object, list[GradedReport]] = defaultdict(list)
    for report in reports:
        groups[key_of(report)].append(report)
    for key, group in groups.items():
        for report, other in combinations(group if key else (), 2):
            if owner_of(report) != owner_of(other):
                yield report, other


def _copied_forms(reports: Sequence[GradedReport]) -> Pairs:
    """Yield pairs of reports of different students whose answer forms have the same numbers."""
    numbers_by_report = [(report, _form_numbers(report)) for report in reports]
    for (report, numbers), (other, other_numbers) in combinations(numbers_by_report, 2):
        if _count_same_numbers(numbers, other_numbers) >= MIN_SAME_NUMBERS and _student_key(
            report
        ) != _student_key(other):
            yield report, other


def _student_text(report: GradedReport) -> str:
    """Format name and id of the student; without both, the name of the submission."""
    names = filter(None, (report.student.strip(), report.student_id.strip()))
    return one_line(", ".join(names) or report.submission, 80)


def _count_digits(number: float) -> int:
    """Count the significant digits of a number."""
    return len(Decimal(repr(abs(number))).normalize().as_tuple().digits) if number else 0
