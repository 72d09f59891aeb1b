"""Flags: sentences on suspicious reports for the instructor. They do not change points.

A flag is not a proof. Two students may share a flight, and following the advice of px4fuse leads to
the same settings.
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

# number of equal values in two forms that is not a coincidence, and relative tolerance for copies
# with small changes
SAME_NUMBERS, MAX_NUMBER_DIFFERENCE = 3, 0.02
# fraction of the log below which a segment chosen by hand is flagged
MIN_CHOSEN_SHARE = 0.5
# factor between a setting and its maximum-likelihood estimate above which the setting is flagged
MAX_SETTING_FACTOR = 30.0
# factor between the stated drift and the default of px4fuse loop above which the drift is flagged
FAR_OFF = 4.0
MAX_SHOWN = 4
# pairs of reports with equal contents
Pairs = Iterator[tuple[GradedReport, GradedReport]]


def page_flags(verdict: Verdict) -> Iterator[str]:
    """Flag a PDF that differs from the redrawn report, with the first difference."""
    if verdict.pages:
        first, *others = verdict.pages
        more_text = f" Further differences: {len(others)}." if others else ""
        yield (
            "The PDF differs from the report that px4fuse draws from the log. "
            f"{capitalise_first(first.sentence)}.{more_text} Read the redrawn report."
        )


def own_flags(results: ReportedResults, handed_out: bool = False) -> Iterator[str]:
    """Flag unusual settings of one report.

    ``handed_out``: an answer key exists, so that simulated logs are expected.
    """
    if isinstance(results, LoopResults):
        yield from _drift_flags(results.request)
        return
    settings, whole_s = results.settings, results.log.duration_s
    share = (settings.end_s - settings.start_s) / whole_s if whole_s else 1.0
    chosen = (results.request.start_s, results.request.end_s) != (None, None)
    if chosen and share < MIN_CHOSEN_SHARE:
        yield (
            f"The segment was chosen by hand and covers {share:.0%} of the log "
            f"({settings.start_s:.1f} to {settings.end_s:.1f} s of {whole_s:.1f} s). Ask for the "
            "reason."
        )
    if not {"north", "east", "aisle"} & set(results.axes):
        yield "Only the vertical axis was analysed (--axis)."
    without_imu = any(finding.id == "acceleration_not_logged" for finding in results.findings)
    if settings.input == "zero" and not without_imu:
        yield "The IMU was not used (--input zero)."
    source = results.source
    tracks_as_received = [track.name for track in source.available if track.path == "as it arrived"]
    if tracks_as_received and source.path != "as it arrived":
        yield (
            f"The position source is {source.name} ({source.path}), not "
            f"{tracks_as_received[0]}, the positions as received by PX4."
        )
    for name, label in (("sigma_z_m", "SIGMA_Z"), ("sigma_a_m_s2", "SIGMA_A")):
        chosen = getattr(settings, name)
        tuned = (one for one in results.tuning.values() if isinstance(one, NoiseEstimate))
        ml_values = [ml_value for one in tuned if (ml_value := getattr(one, name))]
        if ml_values and not min(
            ml_values
        ) / MAX_SETTING_FACTOR < chosen < MAX_SETTING_FACTOR * max(ml_values):
            yield (
                f"{label} {chosen:g} is far from its maximum-likelihood estimate "
                f"({ml_values[0]:.3g})."
            )
    if results.log.hardware == flights.HARDWARE and not handed_out:
        yield "The log is simulated (px4fuse simulate), not a real flight."


def _drift_flags(request: LoopRequest) -> Iterator[str]:
    """Flag a stated drift that differs from the default by more than the factor FAR_OFF.

    The stated drift decides whether a loop closure is accepted.
    """
    usual = LoopRequest(source="")
    for option, unit, stated, default in (
        ("--drift", "m", request.position_drift_m, usual.position_drift_m),
        ("--heading-drift", "°", request.heading_drift_deg, usual.heading_drift_deg),
    ):
        if not default / FAR_OFF <= stated <= default * FAR_OFF:
            yield (
                f"{option} is {stated:g} {unit} per 100 m (default {default:g} {unit}). It decides "
                "whether the loop closure is accepted. Ask for the reason."
            )


def _form_numbers(one: GradedReport) -> dict[tuple[str, str], float]:
    """Return sizes, values and quantities of a form, by their place."""
    if one.form is None:
        return {}
    values_by_place: dict[tuple[str, str], object] = {
        (each.kind, name): getattr(each, name)
        for each in one.form.mistakes
        for name in ("size", "value")
    }
    values_by_place |= {("", f"q{at}"): number for at, number in enumerate(one.form.quantities)}
    return {key: float(n) for key, n in values_by_place.items() if isinstance(n, float | int)}


def _same_numbers(one: Mapping[Any, float], other: Mapping[Any, float]) -> int:
    """Count nearly equal numbers with more than one digit; values of corrections must be equal."""
    return sum(
        _digits(number) > 1
        and abs(number - other[key]) <= (key[1] != "value") * MAX_NUMBER_DIFFERENCE * abs(number)
        for key, number in one.items()
        if key in other
    )


def _student_key(one: GradedReport) -> str:
    return normalise_text(one.student_id) or normalise_text(one.student) or one.submission


# contents that two reports must not share: sentence, content (empty: not compared), and owner;
# pairs with the same owner are not flagged, such as two reports of a student on one log
COMMON_CHECKS: tuple[
    tuple[str, Callable[[GradedReport], object], Callable[[GradedReport], str]], ...
] = (
    ("The same file as {}.", attrgetter("sha256"), attrgetter("submission")),
    (
        "The same student id as in {}.",
        lambda one: normalise_text(one.student_id),
        attrgetter("submission"),
    ),
    ("The same log as {}.", attrgetter("log_sha256"), _student_key),
    (
        "The same numbers as {}, from a log with another SHA-256: a copy of the log.",
        lambda one: (
            one.verdict.status == "verified"
            and len(one.numbers) >= SAME_NUMBERS
            and tuple(one.numbers.values())
        ),
        attrgetter("log_sha256"),
    ),
)


def class_flags(graded: Sequence[GradedReport]) -> Mapping[str, Sequence[str]]:
    """Return flags on equal contents of several reports, by submission name."""
    flags_by_submission: dict[str, list[str]] = defaultdict(list)
    for sentence, pairs in (
        *(
            (sentence, _same_pairs(graded, key_of, owner_of))
            for sentence, key_of, owner_of in COMMON_CHECKS
        ),
        ("The answer form has the same numbers as {}.", _copied_forms(graded)),
    ):
        others: dict[str, list[str]] = defaultdict(list)
        for first, second in pairs:
            for one, other in ((first, second), (second, first)):
                file = one_line(other.submission, 80)
                others[one.submission].append(f"{_name(other)} ({file})")
        for name, names in others.items():
            flags_by_submission[name].append(sentence.format(join_first(names, MAX_SHOWN, "; ")))
    return flags_by_submission


def _same_pairs(
    graded: Sequence[GradedReport],
    key_of: Callable[[GradedReport], object],
    owner_of: Callable[[GradedReport], str],
) -> Pairs:
    groups: dict[object, list[GradedReport]] = defaultdict(list)
    for one in graded:
        groups[key_of(one)].append(one)
    for key, group in groups.items():
        for one, other in combinations(group if key else (), 2):
            if owner_of(one) != owner_of(other):
                yield one, other


def _copied_forms(graded: Sequence[GradedReport]) -> Pairs:
    """Yield pairs of reports of different students with the same numbers in the form."""
    numbers = [(one, _form_numbers(one)) for one in graded]
    for (one, form_numbers), (other, other_numbers) in combinations(numbers, 2):
        if _same_numbers(form_numbers, other_numbers) >= SAME_NUMBERS and _student_key(
            one
        ) != _student_key(other):
            yield one, other


def _name(one: GradedReport) -> str:
    """Format the student of a report for a sentence."""
    names = filter(None, (one.student.strip(), one.student_id.strip()))
    return one_line(", ".join(names) or one.submission, 80)


def _digits(number: float) -> int:
    """Count the significant digits of a number."""
    return len(Decimal(repr(abs(number))).normalize().as_tuple().digits) if number else 0
