"""What an instructor should look at: sentences, never points.

A flag is not a proof. Two students may fly one flight together, and advice that px4fuse prints
leads everyone to the same number.
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
from px4fuse.plain import capitalise_first, join_first
from px4fuse.request import LoopRequest
from px4fuse.results.contract import LoopResults, Reported
from px4fuse.results.reading import one_line
from px4fuse.simulation import flights
from px4fuse.verification.model import Verdict

# Numbers of a form that two students do not have in common by chance, also where one of them has
# changed each a little
SAME_NUMBERS, MAX_NUMBER_DIFFERENCE = 3, 0.02
# A hand-picked part of the flight below this share leaves most of it out
MIN_CHOSEN_SHARE = 0.5
# A setting so many times larger or smaller than what the data ask for has another reason
MAX_SETTING_FACTOR = 30.0
# Factor on the usual drift (px4fuse loop's defaults) from which on a stated drift is flagged
FAR_OFF = 4.0
MAX_SHOWN = 4
# Two reports with something in common
Pairs = Iterator[tuple[GradedReport, GradedReport]]


def page_flags(verdict: Verdict) -> Iterator[str]:
    """Flag a PDF that is not what px4fuse draws from the log, with the first difference."""
    if verdict.pages:
        first, *others = verdict.pages
        more_text = f" {len(others)} more differences." if others else ""
        yield (
            "The PDF that was handed in is not what px4fuse draws from the log. "
            f"{capitalise_first(first.sentence)}.{more_text} Read the redrawn report."
        )


def own_flags(results: Reported, handed_out: bool = False) -> Iterator[str]:
    """What stands out in one report by itself.

    ``handed_out``: there is an answer key, so that logs are simulated for a reason.
    """
    if isinstance(results, LoopResults):
        yield from _drift_flags(results.request)
        return
    settings, whole_s = results.settings, results.log.duration_s
    share = (settings.end_s - settings.start_s) / whole_s if whole_s else 1.0
    chosen = (results.request.start_s, results.request.end_s) != (None, None)
    if chosen and share < MIN_CHOSEN_SHARE:
        yield (
            f"The analysed part was chosen by hand and is {share:.0%} of the log "
            f"({settings.start_s:.1f} to {settings.end_s:.1f} s of {whole_s:.1f} s): ask why the "
            "rest was left out."
        )
    if not {"north", "east", "aisle"} & set(results.axes):
        yield "Only the vertical axis was analysed (--axis)."
    without_imu = any(finding.id == "input_unavailable" for finding in results.findings)
    if settings.input == "zero" and not without_imu:
        yield "The IMU was not used (--input zero)."
    source = results.source
    tracks_as_received = [one.name for one in source.available if one.passage == "as it arrived"]
    if tracks_as_received and source.passage != "as it arrived":
        yield (
            f"The positions are not those that arrived ({tracks_as_received[0]}) but {source.name} "
            f"({source.passage})."
        )
    for name, label in (("sigma_z_m", "SIGMA_Z"), ("sigma_a_m_s2", "SIGMA_A")):
        chosen = getattr(settings, name)
        tuned = (one for one in results.tuning.values() if isinstance(one, NoiseEstimate))
        ml_values = [ml_value for one in tuned if (ml_value := getattr(one, name))]
        if ml_values and not min(
            ml_values
        ) / MAX_SETTING_FACTOR < chosen < MAX_SETTING_FACTOR * max(ml_values):
            yield f"{label} {chosen:g} is far from what the data ask for ({ml_values[0]:.3g})."
    if results.log.hardware == flights.HARDWARE and not handed_out:
        yield "The log was made by px4fuse simulate: no vehicle flew."


def _drift_flags(request: LoopRequest) -> Iterator[str]:
    """Flag a stated drift that is more than FAR_OFF times the usual one, or less than 1/FAR_OFF.

    The closure is accepted or rejected by the stated drift.
    """
    usual = LoopRequest(source="")
    for option, unit, stated, default in (
        ("--drift", "m", request.position_drift_m, usual.position_drift_m),
        ("--heading-drift", "°", request.heading_drift_deg, usual.heading_drift_deg),
    ):
        if not default / FAR_OFF <= stated <= default * FAR_OFF:
            yield (
                f"{option} is {stated:g} {unit} per 100 m; usual is {default:g} {unit}. Ask for "
                "the reason: the closure is accepted or rejected by it."
            )


def _form_numbers(one: GradedReport) -> dict[tuple[str, str], float]:
    """Sizes, values and quantities of a form by where they stand."""
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
    """How many numbers nearly agree that nobody types by chance; a value follows from its size."""
    return sum(
        _digits(number) > 1
        and abs(number - other[key]) <= (key[1] != "value") * MAX_NUMBER_DIFFERENCE * abs(number)
        for key, number in one.items()
        if key in other
    )


def _student_key(one: GradedReport) -> str:
    return normalise_text(one.student_id) or normalise_text(one.student) or one.submission


# What no two reports should have in common: the sentence, what it is (empty for nothing to
# compare), and whose it has to be to count: two reports of one student may be on one log
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
        "The same numbers to the last digit, from a log of another hash, as {}: a copy of the log.",
        lambda one: (
            one.verdict.status == "verified"
            and len(one.numbers) >= SAME_NUMBERS
            and tuple(one.numbers.values())
        ),
        attrgetter("log_sha256"),
    ),
)


def class_flags(graded: Sequence[GradedReport]) -> Mapping[str, Sequence[str]]:
    """What stands out between the reports of a class: sentences, by names of submissions."""
    flags_by_submission: dict[str, list[str]] = defaultdict(list)
    for sentence, pairs in (
        *(
            (sentence, _same_pairs(graded, key_of, owner_of))
            for sentence, key_of, owner_of in COMMON_CHECKS
        ),
        ("The form has the numbers of {}.", _copied_forms(graded)),
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
    """Whose forms have the same numbers, though the flights are others."""
    numbers = [(one, _form_numbers(one)) for one in graded]
    for (one, form_numbers), (other, other_numbers) in combinations(numbers, 2):
        if _same_numbers(form_numbers, other_numbers) >= SAME_NUMBERS and _student_key(
            one
        ) != _student_key(other):
            yield one, other


def _name(one: GradedReport) -> str:
    """A student in a sentence."""
    names = filter(None, (one.student.strip(), one.student_id.strip()))
    return one_line(", ".join(names) or one.submission, 80)


def _digits(number: float) -> int:
    """Significant digits of a number as typed."""
    return len(Decimal(repr(abs(number))).normalize().as_tuple().digits) if number else 0
