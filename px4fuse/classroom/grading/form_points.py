"""Points of a student's answer form (0 to 100), by comparison with the answer key.

The constants reproduce points that an instructor gave by hand. Guessing is not rewarded: each fault
that the form names and the flight does not have (a false fault) costs points. A fault that can be
guessed without a measurement has points only with the correct size.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import zip_longest
from typing import NamedTuple

import msgspec

from px4fuse.classroom.assignment.truth import FormTruth, TrueMistake
from px4fuse.core.record import read_toml
from px4fuse.results.answer_form import (
    CHOICE_NAMES,
    MISTAKES,
    NO_MISTAKE_KIND,
    NOT_AVAILABLE,
    Answers,
    QuantityAnswer,
    StudentMistake,
    draw_questions,
)

# Fraction of the points for the diagnosis if the answer key has choices: a student can copy the
# diagnosis from the output of px4fuse, but not the answers about the figures
DIAGNOSIS_SHARE = 0.2
# Points deducted for each false fault
FALSE_MISTAKE_POINTS = 10.0
# Minimum number of false faults in an answer form for which its right faults give no points
MIN_FALSE_MISTAKES_WITHOUT_POINTS = 3
# Fraction of the points if the answer form names another fault of the same group
SAME_GROUP_FRACTION = 0.4
# Fraction of the points if the answer form names ekf2-noise instead of r-scale: both make R wrong
NOISE_FOR_R_SCALE_FRACTION = 2.0 / 3.0
# Fraction of the points if the answer form names a consequence of the injected fault
EFFECT_FRACTION = 0.15
# Kinds of injected faults that can be guessed without a measurement
GUESSABLE_KINDS = frozenset(("open-end",))
# Relative error over which the points for the size of a guessable fault decrease from full to zero:
# the sizes that are assigned to students differ little
GUESSABLE_SIZE_RANGE = 0.08
ANY_BOUNDS = (-math.inf, math.inf)
# Minimum tolerance (s) of the start and the end of an injected fault
TIME_TOLERANCE_S = 2.0
# Tolerance of the start and the end of an injected fault, as fraction of the time since the first
# data
TIME_TOLERANCE_FRACTION = 0.05
# Maximum relative error of a computed number for full points
FULL_POINTS_TOLERANCE = 0.02
# Maximum relative error of a computed number for half of the points
HALF_POINTS_TOLERANCE = 0.10
# Maximum relative error of the size of an injected fault for half of the points
HALF_POINTS_SIZE_TOLERANCE = 0.4


class _CorrectionRule(NamedTuple):
    """Correction of injected faults, and the fraction of the points for naming it.

    ``right_values`` are the smallest and the largest right value of the parameter, or the name of
    bounds that :func:`accepted_corrections` computes.
    """

    parameter: str
    fraction_by_mistake: Mapping[str, float]
    right_values: tuple[float, float] | str = ANY_BOUNDS


POINTS_TABLE = read_toml(__file__, dict)
CORRECTIONS = msgspec.convert(POINTS_TABLE["corrections"], tuple[_CorrectionRule, ...])
NEIGHBOURS = msgspec.convert([*POINTS_TABLE["neighbours"].values()], tuple[frozenset[str], ...])
PART_NAMES = tuple(POINTS_TABLE["weights"])


@dataclass(frozen=True)
class FormPoints:
    """Points for each part of an answer form ("mistakes", "sizes", ...).

    ``feedback`` are clauses for the student. ``is_named_by_kind`` is True for each injected fault
    of the flight that the form names.
    """

    points_by_part: Mapping[str, float]
    max_points_by_part: Mapping[str, float]
    feedback: tuple[str, ...] = ()
    is_named_by_kind: Mapping[str, bool] = field(default_factory=dict)

    @property
    def fraction(self) -> float:
        points = sum(self.points_by_part.values())
        return max(points, 0.0) / sum(self.max_points_by_part.values())


def form_points(answers: Answers, truth: FormTruth) -> FormPoints:
    """Compute the points of an answer form by comparison with the right answers."""
    is_no_mistake_right = not truth.mistakes and answers.names_no_mistake
    weights = POINTS_TABLE["weights_clean" if is_no_mistake_right else "weights"]
    fractions = dict.fromkeys(PART_NAMES, 0.0)
    matches, false_mistakes = _match_mistakes(answers, truth)
    if truth.mistakes and len(false_mistakes) < MIN_FALSE_MISTAKES_WITHOUT_POINTS:
        fractions |= _mistake_fractions(matches, truth)
    fractions["numbers"] = quantities_fraction = _quantities_fraction(answers, truth)
    # half of the points for the verdicts on a flight with faults if no computed number is right,
    # because most verdicts can be guessed
    is_guess_possible = not quantities_fraction and not is_no_mistake_right
    fractions["verdicts"] = _verdicts_fraction(answers, truth) * (0.5 if is_guess_possible else 1.0)
    points_by_part = {name: weights[name] * fraction for name, fraction in fractions.items()}
    if is_no_mistake_right:
        points_by_part["mistakes"] = weights["mistakes"]
    elif truth.mistakes and all(mistake.size is None for mistake in truth.mistakes):
        # no injected fault of this flight has a size, so the part "mistakes" gets the points of
        # "sizes" too
        points_by_part["mistakes"] += weights["sizes"] * fractions["mistakes"]
    points_by_part["mistakes"] -= FALSE_MISTAKE_POINTS * len(false_mistakes)
    points_by_part["mistakes"] = max(points_by_part["mistakes"], 0.0)
    if truth.choices:
        weights = {name: DIAGNOSIS_SHARE * points for name, points in weights.items()}
        weights["figures"] = 100.0 * (1.0 - DIAGNOSIS_SHARE)
        points_by_part = {name: DIAGNOSIS_SHARE * points for name, points in points_by_part.items()}
        points_by_part["figures"] = weights["figures"] * _choices_fraction(answers, truth)
    named_kinds = [student_mistake.kind for student_mistake in answers.mistakes]
    is_named_by_kind = {mistake.kind: mistake.kind in named_kinds for mistake in truth.mistakes}
    feedback = (
        *_mistake_feedback(matches, false_mistakes, is_no_mistake_right),
        *_answer_feedback(answers, truth),
    )
    return FormPoints(points_by_part, weights, feedback, is_named_by_kind)


# Injected fault, matching fault in the answer form (if any), and fraction of the points
Match = tuple[TrueMistake, StudentMistake | None, float]


def _mistake_feedback(
    matches: list[Match], false_mistakes: list[StudentMistake], is_no_mistake_right: bool
) -> Iterator[str]:
    """Yield a clause for each right or missed injected fault, and one for all false faults."""
    if not matches:
        yield f"your flight has no injected fault{', as your form states' * is_no_mistake_right}"
    for mistake, student_mistake, _ in matches:
        mistake_text = f"{mistake.kind} ({MISTAKES[mistake.kind].description})"
        right_answer = describe_right_answer(mistake)
        if student_mistake is None:
            yield f"you did not name {mistake_text}: {right_answer}"
        elif student_mistake.kind != mistake.kind:
            yield f"you named {student_mistake.kind} instead of {mistake_text}: {right_answer}"
        else:
            yield f"you named {mistake.kind}, which is right: {right_answer}"
    if false_mistakes:
        kinds = ", ".join(student_mistake.kind for student_mistake in false_mistakes)
        yield f"you named faults that your flight does not have: {kinds}"


def describe_right_answer(mistake: TrueMistake) -> str:
    """State the accepted size, the time and the panels of the report that show the fault."""
    texts = []
    if mistake.low is not None and mistake.high is not None:
        unit = next(iter(MISTAKES[mistake.kind].units), "")
        texts.append(f"accepted size {mistake.low:.3g} to {mistake.high:.3g} {unit}".rstrip())
    start_text = "" if mistake.from_s is None else f"from {mistake.from_s:.0f} s "
    end_text = "" if mistake.until_s is None else f"until {mistake.until_s:.0f} s"
    texts.append(f"{start_text}{end_text}".strip() or "whole flight")
    return ", ".join([*texts, f"shown in {' or '.join(panels_showing(mistake.kind))}"])


def _answer_feedback(answers: Answers, truth: FormTruth) -> Iterator[str]:
    """Yield a clause with the right answer to each further question that is not answered right."""
    rows: list[tuple[str, object, object]] = [
        ("verdict on KF", answers.verdict_kf, truth.kf.verdict or NOT_AVAILABLE),
        ("verdict on EKF2", answers.verdict_ekf2, truth.ekf2.verdict or NOT_AVAILABLE),
    ]
    if _ekf2_behaviour_fraction(answers, truth) < 1.0:
        rows.append(("behaviour of EKF2", answers.ekf2_did, truth.ekf2_did))
    for question, given, right in zip_longest(
        draw_questions(answers.log_sha256), answers.quantities, truth.quantities
    ):
        if right not in (None, ()) and _quantity_fraction(given, right) < 1.0:
            rows.append(
                (f"{question.text}, within {100.0 * FULL_POINTS_TOLERANCE:g} %", given, right)
            )
    for letter, (choice, right_letter) in zip_longest(
        answers.choices[: len(truth.choices)], truth.choices
    ):
        given_text = choice.answer_text(letter) if letter else ""
        rows.append((choice.question, given_text, choice.answer_text(right_letter)))
    for name, given, right in rows:
        if given != right:
            yield f"{name}: {_format_answer(right)} is right, you gave {_format_answer(given)}"


def _format_answer(answer: object) -> str:
    if isinstance(answer, tuple):
        return ", ".join(map(_format_answer, answer)) or "none"
    return f"{answer:.4g}" if isinstance(answer, float | int) else f"'{answer or 'none'}'"


def _match_mistakes(answers: Answers, truth: FormTruth) -> tuple[list[Match], list[StudentMistake]]:
    """Match each injected fault with the fault in the form that gives the most points.

    Also return the false faults: those in the form that match no injected fault.
    """
    unmatched = [
        student_mistake
        for student_mistake in answers.mistakes
        if student_mistake.kind != NO_MISTAKE_KIND
    ]
    match_by_kind: dict[str, tuple[StudentMistake, float]] = {}
    pairs = [
        (fraction_for_named_kind(mistake.kind, student_mistake.kind), mistake.kind, student_mistake)
        for mistake in truth.mistakes
        for student_mistake in unmatched
    ]
    for fraction, kind, student_mistake in sorted(pairs, key=lambda pair: -pair[0]):
        if fraction and kind not in match_by_kind and student_mistake in unmatched:
            match_by_kind[kind] = student_mistake, fraction
            unmatched.remove(student_mistake)
    no_match = (None, 0.0)
    matches = [
        (true_mistake, *match_by_kind.get(true_mistake.kind, no_match))
        for true_mistake in truth.mistakes
    ]
    return matches, unmatched


def fraction_for_named_kind(kind: str, named_kind: str) -> float:
    """Return the fraction of the points for naming ``named_kind`` instead of the fault ``kind``."""
    if kind == named_kind:
        return 1.0
    if (kind, named_kind) == ("r-scale", "ekf2-noise"):
        return NOISE_FOR_R_SCALE_FRACTION
    if any({kind, named_kind} <= group for group in NEIGHBOURS):
        return SAME_GROUP_FRACTION
    return EFFECT_FRACTION if named_kind in POINTS_TABLE["effects"].get(kind, ()) else 0.0


def _mistake_fractions(matches: list[Match], truth: FormTruth) -> dict[str, float]:
    """Return the fraction of the points of the parts about faults, as means over all faults."""
    mistake_with_size_count = sum(mistake.size is not None for mistake, _, _ in matches)
    fractions = dict.fromkeys(("mistakes", "sizes", "time and panel", "correction"), 0.0)
    for mistake, student_mistake, fraction in matches:
        if student_mistake is None:
            continue
        size_points = size_fraction(mistake, student_mistake)
        weight = (size_points if mistake.kind in GUESSABLE_KINDS else 1.0) / len(matches)
        time_weight = weight if student_mistake.kind == mistake.kind else 0.5 * weight
        fractions["mistakes"] += fraction / len(matches)
        fractions["time and panel"] += (
            time_and_panel_fraction(mistake, student_mistake) * time_weight
        )
        fractions["correction"] += correction_fraction(mistake, student_mistake, truth) * weight
        fractions["sizes"] += size_points / max(mistake_with_size_count, 1)
    return fractions


def size_fraction(mistake: TrueMistake, student_mistake: StudentMistake) -> float:
    """Return the fraction of the points for the size of a fault.

    The fraction is 1 within the tolerance and 1/2 near it. It is 1/3 for a wrong sign, and if the
    form names another fault with this size.
    """
    named_size = student_mistake.size_in_first_unit()
    if mistake.size is None or mistake.low is None or mistake.high is None or named_size is None:
        return 0.0
    if student_mistake.kind != mistake.kind:
        first_units = [[*MISTAKES[kind].units][:1] for kind in (student_mistake.kind, mistake.kind)]
        is_right = mistake.low <= named_size <= mistake.high and first_units[0] == first_units[1]
        return is_right / 3.0
    deviation = abs(named_size - mistake.size) / abs(mistake.size)
    close_fraction = 0.5 * (deviation <= HALF_POINTS_SIZE_TOLERANCE)
    if mistake.kind in GUESSABLE_KINDS:
        tolerance = (mistake.high - mistake.low) / (2.0 * abs(mistake.size))
        close_fraction = max(1.0 - (deviation - tolerance) / GUESSABLE_SIZE_RANGE, 0.0)
    return _value_fraction(named_size, mistake.low, mistake.high, close_fraction)


def time_and_panel_fraction(mistake: TrueMistake, student_mistake: StudentMistake) -> float:
    """Return the fraction of the points for time and report panel of a fault: half for each."""
    if mistake.from_s is None and mistake.until_s is None:
        is_time_right = student_mistake.when == "whole flight"
    else:
        times = (mistake.from_s, student_mistake.from_s), (mistake.until_s, student_mistake.until_s)
        is_time_right = not student_mistake.when and all(
            named_s is not None
            and abs(named_s - true_s) <= max(TIME_TOLERANCE_S, TIME_TOLERANCE_FRACTION * true_s)
            for true_s, named_s in times
            if true_s is not None
        )
    return 0.5 * is_time_right + 0.5 * (student_mistake.panel in panels_showing(mistake.kind))


def panels_showing(kind: str) -> list[str]:
    return [*(panel for panel, kinds in POINTS_TABLE["shows"].items() if kind in kinds), "cover"]


def correction_fraction(
    mistake: TrueMistake, student_mistake: StudentMistake, truth: FormTruth
) -> float:
    """Return the fraction of the points for a named correction and the value given with it."""
    named_value = student_mistake.value_in_first_unit()
    fractions = [
        fraction
        if (low, high) == ANY_BOUNDS
        else fraction
        * (0.5 if named_value is None else _value_fraction(named_value, low, high, 0.5))
        for parameter, (low, high), fraction in accepted_corrections(mistake, truth)
        if parameter == student_mistake.parameter
    ]
    return max(fractions, default=0.0)


def _value_fraction(value: float, low: float, high: float, fraction_outside: float) -> float:
    """Return 1 within the bounds, 1/3 for a wrong sign, and ``fraction_outside`` otherwise."""
    if low <= value <= high:
        return 1.0
    return 1.0 / 3.0 if low <= -value <= high else fraction_outside


# Parameter that corrects an injected fault, bounds of its accepted values, fraction of the points
AcceptedCorrection = tuple[str, tuple[float, float], float]


def accepted_corrections(mistake: TrueMistake, truth: FormTruth) -> tuple[AcceptedCorrection, ...]:
    """Return the parameters that correct an injected fault, with bounds of accepted values."""
    size, low, high = (value or 0.0 for value in (mistake.size, mistake.low, mistake.high))
    from_s = mistake.from_s or 0.0
    until_s = from_s if mistake.until_s is None else mistake.until_s
    bounds_by_name = {
        "negated": (-high, -low),
        "size": (low, high),
        "late milliseconds": (1e3 * low, 1e3 * high),
        "twice": (2.0 * size, 1e4),
        "factors": (100.0 / (100.0 + high), 100.0 / (100.0 + low)),
        "noise": (0.8 * truth.sigma_z_m, 1.25 * truth.sigma_z_m),
        "after": (until_s - 1.0, until_s + 15.0),
        "before": (from_s - 15.0, from_s + 1.0),
    }
    return tuple(
        (
            rule.parameter,
            bounds_by_name[values] if isinstance(values := rule.right_values, str) else values,
            rule.fraction_by_mistake[mistake.kind],
        )
        for rule in CORRECTIONS
        if mistake.kind in rule.fraction_by_mistake
        # EKF2_EV_DELAY cannot be negative
        and (size > 0.0 or rule.right_values != "late milliseconds")
    )


def _verdicts_fraction(answers: Answers, truth: FormTruth) -> float:
    """Return the fraction of the points for the verdicts on KF and EKF2, and EKF2's behaviour."""
    pairs = (answers.verdict_kf, truth.kf.verdict), (answers.verdict_ekf2, truth.ekf2.verdict)
    right_count = sum(answer == (right or NOT_AVAILABLE) for answer, right in pairs)
    return (right_count + _ekf2_behaviour_fraction(answers, truth)) / 3.0


def _ekf2_behaviour_fraction(answers: Answers, truth: FormTruth) -> float:
    """Return 1 if the form names EKF2's behaviour completely, 1/2 with one error, else 0.

    An error is a missing or a false statement.
    """
    stated_behaviours, required_behaviours = set(answers.ekf2_did), set(truth.ekf2_did)
    also_allowed = set(truth.ekf2_did_also)
    false_count = len(stated_behaviours - required_behaviours - also_allowed)
    if len(stated_behaviours) == false_count or false_count > 1:
        return 0.0
    is_complete = required_behaviours <= stated_behaviours or (
        len(required_behaviours) == 1 and stated_behaviours & also_allowed
    )
    return 1.0 if is_complete and not false_count else 0.5


def _choices_fraction(answers: Answers, truth: FormTruth) -> float:
    """Return the fraction of the points for choices: negative, so that guesses average to zero."""
    wrong_points = -1.0 / (len(CHOICE_NAMES) - 1)
    right_letters = (right_letter for _, right_letter in truth.choices)
    points = (
        1.0 if letter == right_letter else wrong_points
        for letter, right_letter in zip(answers.choices, right_letters, strict=False)
        if letter
    )
    return sum(points) / len(truth.choices)


def _quantities_fraction(answers: Answers, truth: FormTruth) -> float:
    """Return the fraction of the points for the numbers of KF that the student computed."""
    # an empty list of updates is the right answer on most flights, so it has no points
    scored_count = sum(value not in (None, ()) for value in truth.quantities)
    pairs = zip(answers.quantities, truth.quantities, strict=False)
    return sum(_quantity_fraction(*pair) for pair in pairs) / max(scored_count, 1)


def _quantity_fraction(answer: QuantityAnswer, true_value: QuantityAnswer) -> float:
    if isinstance(true_value, tuple) and answer is not None:
        answer = answer if isinstance(answer, tuple) else (answer,)
        difference_count = len(set(answer) ^ set(true_value))
        has_right_number = not set(answer).isdisjoint(true_value)
        return max(1.0 - 0.5 * difference_count, 0.0) * has_right_number
    if isinstance(answer, float | int) and isinstance(true_value, float | int):
        for tolerance, fraction in ((FULL_POINTS_TOLERANCE, 1.0), (HALF_POINTS_TOLERANCE, 0.5)):
            if abs(answer - true_value) <= tolerance * abs(true_value):
                return fraction
    return 0.0
