"""Points (0 to 100) for a student's answers about a flight, by comparison with the answer key.

The constants reproduce points that an instructor gave by hand. Guesses do not pay: each false fault
(named by the student, but not in the flight) costs points, and a fault that can be guessed without
a measurement has points only with the correct size.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import zip_longest
from typing import NamedTuple

import msgspec

from px4fuse.classroom.assignment.truth import InjectedFault, RightFormAnswers
from px4fuse.classroom.grading.model import ItemScore
from px4fuse.core.record import read_toml
from px4fuse.results.answer_form import (
    CHOICE_NAMES,
    FAULT_KINDS,
    NO_FAULT_KIND,
    NOT_AVAILABLE,
    Answers,
    NamedFault,
    QuantityAnswer,
    select_questions,
)

# Fraction of the points for questions about the flight; the rest is for questions about figures.
# Small, because px4fuse itself can answer the questions about the flight
FLIGHT_SHARE = 0.2
# Points deducted for each false fault
FALSE_FAULT_POINTS = 10.0
# Minimum number of false faults for zero points: the student guessed
MIN_FALSE_FAULTS_WITHOUT_POINTS = 3
# Fraction of the points for naming a fault that is similar to the injected fault
SIMILAR_FAULT_FRACTION = 0.4
# Fraction of the points for naming ekf2-noise instead of r-scale: both make R wrong
NOISE_FOR_R_SCALE_FRACTION = 2.0 / 3.0
# Fraction of the points for naming a consequence of the injected fault instead of the fault
EFFECT_FRACTION = 0.15
# Kinds of injected faults that can be guessed without a measurement
GUESSABLE_KINDS = frozenset(("open-end",))
# Relative error, in excess of the tolerance, at which the size of a guessable fault gives no
# points. Small, because the sizes in the students' flights differ little
GUESSABLE_SIZE_RANGE = 0.08
NO_BOUNDS = (-math.inf, math.inf)
# Minimum tolerance (s) of the start and the end of an injected fault
TIME_TOLERANCE_S = 2.0
# Tolerance of the start and the end of an injected fault, relative to the time since the first data
TIME_TOLERANCE_FRACTION = 0.05
# Maximum relative error of a number that the student computed, for full points
FULL_POINTS_TOLERANCE = 0.02
# Maximum relative error of a number that the student computed, for half of the points
HALF_POINTS_TOLERANCE = 0.10
# Maximum relative error of the size of an injected fault for half of the points
HALF_POINTS_FAULT_SIZE_TOLERANCE = 0.4


class _CorrectionRule(NamedTuple):
    """Parameter that corrects some injected faults.

    Attributes
    ----------
    fraction_by_kind : mapping
        Fraction of the points for naming the parameter, by kind of fault.
    right_values : (float, float) or str
        Smallest and largest right value, or the name of a rule in :func:`accepted_corrections`.
    """

    parameter: str
    fraction_by_kind: Mapping[str, float]
    right_values: tuple[float, float] | str = NO_BOUNDS


POINTS_TABLE = read_toml(__file__, dict)
CORRECTIONS = msgspec.convert(POINTS_TABLE["corrections"], tuple[_CorrectionRule, ...])
SIMILAR_FAULTS = msgspec.convert([*POINTS_TABLE["neighbours"].values()], tuple[frozenset[str], ...])
PART_NAMES = tuple(POINTS_TABLE["weights"])


@dataclass(frozen=True)
class FormPoints:
    """Points for the parts of a student's answers ("mistakes", "sizes", ...), and feedback.

    ``is_named_by_kind`` is True for each injected fault that the student named.
    """

    parts: tuple[ItemScore, ...] = ()
    feedback: tuple[str, ...] = ()
    is_named_by_kind: Mapping[str, bool] = field(default_factory=dict)

    @property
    def fraction(self) -> float:
        points = sum(part.points for part in self.parts)
        return max(points, 0.0) / sum(part.max_points for part in self.parts)


def form_points(answers: Answers, right_answers: RightFormAnswers) -> FormPoints:
    """Compare a student's answers with the right answers, and compute the points."""
    is_no_fault_right = not right_answers.mistakes and answers.states_no_fault
    weights = POINTS_TABLE["weights_clean" if is_no_fault_right else "weights"]
    fractions = dict.fromkeys(PART_NAMES, 0.0)
    matches, false_faults = _match_faults(answers, right_answers)
    if right_answers.mistakes and len(false_faults) < MIN_FALSE_FAULTS_WITHOUT_POINTS:
        fractions |= _fault_fractions(matches, right_answers)
    fractions["numbers"] = quantities_fraction = _quantities_fraction(answers, right_answers)
    # consistency can be guessed: without a right number, the answers give half of the points
    is_guess_possible = not quantities_fraction and not is_no_fault_right
    fractions["verdicts"] = _verdicts_fraction(answers, right_answers) * (
        0.5 if is_guess_possible else 1.0
    )
    points_by_part = {name: weights[name] * fraction for name, fraction in fractions.items()}
    if is_no_fault_right:
        points_by_part["mistakes"] = weights["mistakes"]
    elif right_answers.mistakes and all(fault.size is None for fault in right_answers.mistakes):
        # the faults have no size: add the points for sizes to the points for naming the faults
        points_by_part["mistakes"] += weights["sizes"] * fractions["mistakes"]
    points_by_part["mistakes"] -= FALSE_FAULT_POINTS * len(false_faults)
    points_by_part["mistakes"] = max(points_by_part["mistakes"], 0.0)
    if right_answers.choices:
        weights = {name: FLIGHT_SHARE * points for name, points in weights.items()}
        weights["figures"] = 100.0 * (1.0 - FLIGHT_SHARE)
        points_by_part = {name: FLIGHT_SHARE * points for name, points in points_by_part.items()}
        points_by_part["figures"] = weights["figures"] * _choices_fraction(answers, right_answers)
    named_kinds = [named_fault.kind for named_fault in answers.mistakes]
    is_named_by_kind = {fault.kind: fault.kind in named_kinds for fault in right_answers.mistakes}
    feedback = (
        *_fault_feedback(matches, false_faults, is_no_fault_right),
        *_answer_feedback(answers, right_answers),
    )
    parts = tuple(
        ItemScore(name, points_by_part[name], max_points, "")
        for name, max_points in weights.items()
        if max_points
    )
    return FormPoints(parts, feedback, is_named_by_kind)


# Injected fault, fault that the student named for it (or None), and fraction of the points
Match = tuple[InjectedFault, NamedFault | None, float]


def _fault_feedback(
    matches: list[Match], false_faults: list[NamedFault], is_no_fault_right: bool
) -> Iterator[str]:
    """Yield feedback on each injected fault, and on faults that the flight does not have."""
    if not matches:
        yield f"your flight has no injected fault{', as your form states' * is_no_fault_right}"
    for fault, named_fault, _ in matches:
        fault_text = f"{fault.kind} ({FAULT_KINDS[fault.kind].description})"
        right_answer = describe_right_answer(fault)
        if named_fault is None:
            yield f"you did not name {fault_text}: {right_answer}"
        elif named_fault.kind != fault.kind:
            yield f"you named {named_fault.kind} instead of {fault_text}: {right_answer}"
        else:
            yield f"you named {fault.kind}, which is right: {right_answer}"
    if false_faults:
        kinds = ", ".join(named_fault.kind for named_fault in false_faults)
        yield f"you named faults that your flight does not have: {kinds}"


def describe_right_answer(fault: InjectedFault) -> str:
    """State the accepted size and the time of a fault, and the plots that show the fault."""
    texts = []
    if fault.low is not None and fault.high is not None:
        unit = next(iter(FAULT_KINDS[fault.kind].units), "")
        texts.append(f"accepted size {fault.low:.3g} to {fault.high:.3g} {unit}".rstrip())
    start_text = "" if fault.from_s is None else f"from {fault.from_s:.0f} s "
    end_text = "" if fault.until_s is None else f"until {fault.until_s:.0f} s"
    texts.append(f"{start_text}{end_text}".strip() or "whole flight")
    return ", ".join([*texts, f"shown in {' or '.join(panels_showing(fault.kind))}"])


def _answer_feedback(answers: Answers, right_answers: RightFormAnswers) -> Iterator[str]:
    """Yield feedback on wrong answers about consistency, EKF2, numbers and figures."""
    rows: list[tuple[str, object, object]] = [
        (
            "consistency of KF",
            answers.verdict_kf,
            right_answers.kf.verdict or NOT_AVAILABLE,
        ),
        (
            "consistency of EKF2",
            answers.verdict_ekf2,
            right_answers.ekf2.verdict or NOT_AVAILABLE,
        ),
    ]
    if _ekf2_behaviour_fraction(answers, right_answers) < 1.0:
        rows.append(("behaviour of EKF2", answers.ekf2_did, right_answers.ekf2_did))
    for question, given, right in zip_longest(
        select_questions(answers.log_sha256), answers.quantities, right_answers.quantities
    ):
        if right not in (None, ()) and _quantity_fraction(given, right) < 1.0:
            rows.append(
                (f"{question.text}, within {100.0 * FULL_POINTS_TOLERANCE:g} %", given, right)
            )
    for letter, (choice, right_letter) in zip_longest(
        answers.choices[: len(right_answers.choices)], right_answers.choices
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


def _match_faults(
    answers: Answers, right_answers: RightFormAnswers
) -> tuple[list[Match], list[NamedFault]]:
    """Match each injected fault with the named fault that gives the most points.

    Return the matches, and the named faults that match no injected fault.
    """
    unmatched = [
        named_fault for named_fault in answers.mistakes if named_fault.kind != NO_FAULT_KIND
    ]
    match_by_kind: dict[str, tuple[NamedFault, float]] = {}
    candidates = [
        (fraction_for_named_kind(fault.kind, named_fault.kind), fault.kind, named_fault)
        for fault in right_answers.mistakes
        for named_fault in unmatched
    ]
    for fraction, kind, named_fault in sorted(candidates, key=lambda each: -each[0]):
        if fraction and kind not in match_by_kind and named_fault in unmatched:
            match_by_kind[kind] = named_fault, fraction
            unmatched.remove(named_fault)
    no_match = (None, 0.0)
    matches = [
        (fault, *match_by_kind.get(fault.kind, no_match)) for fault in right_answers.mistakes
    ]
    return matches, unmatched


def fraction_for_named_kind(kind: str, named_kind: str) -> float:
    """Return the fraction of the points for naming ``named_kind`` if the fault is ``kind``."""
    if kind == named_kind:
        return 1.0
    if (kind, named_kind) == ("r-scale", "ekf2-noise"):
        return NOISE_FOR_R_SCALE_FRACTION
    if any({kind, named_kind} <= group for group in SIMILAR_FAULTS):
        return SIMILAR_FAULT_FRACTION
    return EFFECT_FRACTION if named_kind in POINTS_TABLE["effects"].get(kind, ()) else 0.0


def _fault_fractions(matches: list[Match], right_answers: RightFormAnswers) -> dict[str, float]:
    """Return the mean score (0 to 1) over all injected faults, by part of the answers."""
    sized_fault_count = sum(fault.size is not None for fault, _, _ in matches)
    fractions = dict.fromkeys(("mistakes", "sizes", "time and panel", "correction"), 0.0)
    for fault, named_fault, fraction in matches:
        if named_fault is None:
            continue
        size_score = size_fraction(fault, named_fault)
        weight = (size_score if fault.kind in GUESSABLE_KINDS else 1.0) / len(matches)
        time_weight = weight if named_fault.kind == fault.kind else 0.5 * weight
        fractions["mistakes"] += fraction / len(matches)
        fractions["time and panel"] += evidence_fraction(fault, named_fault) * time_weight
        fractions["correction"] += correction_fraction(fault, named_fault, right_answers) * weight
        fractions["sizes"] += size_score / max(sized_fault_count, 1)
    return fractions


def size_fraction(fault: InjectedFault, named_fault: NamedFault) -> float:
    """Return the fraction of the points for the size that the student states for a fault.

    1: within the tolerance. 1/2: near the tolerance. 1/3: wrong sign, or correct size of a wrong
    fault.
    """
    named_size = named_fault.convert_size_to_first_unit()
    if fault.size is None or fault.low is None or fault.high is None or named_size is None:
        return 0.0
    if named_fault.kind != fault.kind:
        units = [[*FAULT_KINDS[kind].units][:1] for kind in (named_fault.kind, fault.kind)]
        is_right = fault.low <= named_size <= fault.high and units[0] == units[1]
        return is_right / 3.0
    deviation = abs(named_size - fault.size) / abs(fault.size)
    close_fraction = 0.5 * (deviation <= HALF_POINTS_FAULT_SIZE_TOLERANCE)
    if fault.kind in GUESSABLE_KINDS:
        tolerance = (fault.high - fault.low) / (2.0 * abs(fault.size))
        close_fraction = max(1.0 - (deviation - tolerance) / GUESSABLE_SIZE_RANGE, 0.0)
    return _value_fraction(named_size, fault.low, fault.high, close_fraction)


def evidence_fraction(fault: InjectedFault, named_fault: NamedFault) -> float:
    """Return 1/2 for the right time of a fault, plus 1/2 for naming a plot that shows the fault."""
    if fault.from_s is None and fault.until_s is None:
        is_time_right = named_fault.when == "whole flight"
    else:
        true_and_named_s = (fault.from_s, named_fault.from_s), (fault.until_s, named_fault.until_s)
        is_time_right = not named_fault.when and all(
            named_s is not None
            and abs(named_s - true_s) <= max(TIME_TOLERANCE_S, TIME_TOLERANCE_FRACTION * true_s)
            for true_s, named_s in true_and_named_s
            if true_s is not None
        )
    return 0.5 * is_time_right + 0.5 * (named_fault.panel in panels_showing(fault.kind))


def panels_showing(fault_kind: str) -> list[str]:
    kinds_by_panel = POINTS_TABLE["shows"].items()
    return [*(panel for panel, kinds in kinds_by_panel if fault_kind in kinds), "cover"]


def correction_fraction(
    fault: InjectedFault, named_fault: NamedFault, right_answers: RightFormAnswers
) -> float:
    """Return the fraction of the points for the parameter that corrects a fault, with its value."""
    named_value = named_fault.convert_value_to_first_unit()
    fractions = [
        fraction
        if (low, high) == NO_BOUNDS
        else fraction
        * (0.5 if named_value is None else _value_fraction(named_value, low, high, 0.5))
        for parameter, (low, high), fraction in accepted_corrections(fault, right_answers)
        if parameter == named_fault.parameter
    ]
    return max(fractions, default=0.0)


def _value_fraction(value: float, low: float, high: float, fraction_outside: float) -> float:
    """Return 1 within the bounds, 1/3 for a wrong sign, and ``fraction_outside`` otherwise."""
    if low <= value <= high:
        return 1.0
    return 1.0 / 3.0 if low <= -value <= high else fraction_outside


# Parameter that corrects an injected fault, range of right values, and fraction of the points
AcceptedCorrection = tuple[str, tuple[float, float], float]


def accepted_corrections(
    fault: InjectedFault, right_answers: RightFormAnswers
) -> tuple[AcceptedCorrection, ...]:
    size, low, high = (value or 0.0 for value in (fault.size, fault.low, fault.high))
    from_s = fault.from_s or 0.0
    until_s = from_s if fault.until_s is None else fault.until_s
    bounds_by_name = {
        "negated": (-high, -low),
        "size": (low, high),
        "late milliseconds": (1e3 * low, 1e3 * high),
        "twice": (2.0 * size, 1e4),
        "factors": (100.0 / (100.0 + high), 100.0 / (100.0 + low)),
        "noise": (0.8 * right_answers.sigma_z_m, 1.25 * right_answers.sigma_z_m),
        "after": (until_s - 1.0, until_s + 15.0),
        "before": (from_s - 15.0, from_s + 1.0),
    }
    return tuple(
        (
            rule.parameter,
            bounds_by_name[values] if isinstance(values := rule.right_values, str) else values,
            rule.fraction_by_kind[fault.kind],
        )
        for rule in CORRECTIONS
        if fault.kind in rule.fraction_by_kind
        # EKF2_EV_DELAY cannot be negative
        and (size > 0.0 or rule.right_values != "late milliseconds")
    )


def _verdicts_fraction(answers: Answers, right_answers: RightFormAnswers) -> float:
    """Return the mean score for the consistency of KF and of EKF2, and the behaviour of EKF2."""
    given_and_right = (
        (answers.verdict_kf, right_answers.kf.verdict),
        (answers.verdict_ekf2, right_answers.ekf2.verdict),
    )
    right_count = sum(answer == (right or NOT_AVAILABLE) for answer, right in given_and_right)
    return (right_count + _ekf2_behaviour_fraction(answers, right_answers)) / 3.0


def _ekf2_behaviour_fraction(answers: Answers, right_answers: RightFormAnswers) -> float:
    """Return 1 if the reported behaviour of EKF2 is right, 1/2 with one error, otherwise 0."""
    stated_behaviours, required_behaviours = set(answers.ekf2_did), set(right_answers.ekf2_did)
    also_allowed = set(right_answers.ekf2_did_also)
    false_count = len(stated_behaviours - required_behaviours - also_allowed)
    if len(stated_behaviours) == false_count or false_count > 1:
        return 0.0
    is_complete = required_behaviours <= stated_behaviours or (
        len(required_behaviours) == 1 and stated_behaviours & also_allowed
    )
    return 1.0 if is_complete and not false_count else 0.5


def _choices_fraction(answers: Answers, right_answers: RightFormAnswers) -> float:
    """Return the mean score of the multiple-choice questions; random answers give 0 on average."""
    wrong_points = -1.0 / (len(CHOICE_NAMES) - 1)
    right_letters = (right_letter for _, right_letter in right_answers.choices)
    points = (
        1.0 if letter == right_letter else wrong_points
        for letter, right_letter in zip(answers.choices, right_letters, strict=False)
        if letter
    )
    return sum(points) / len(right_answers.choices)


def _quantities_fraction(answers: Answers, right_answers: RightFormAnswers) -> float:
    """Return the mean score for the numbers that the student computed with KF."""
    # an empty list as right answer is not scored, because it could be guessed
    scored_count = sum(value not in (None, ()) for value in right_answers.quantities)
    given_and_right = zip(answers.quantities, right_answers.quantities, strict=False)
    return sum(_quantity_fraction(*pair) for pair in given_and_right) / max(scored_count, 1)


def _quantity_fraction(answer: QuantityAnswer, right_answer: QuantityAnswer) -> float:
    if isinstance(right_answer, tuple) and answer is not None:
        answer = answer if isinstance(answer, tuple) else (answer,)
        difference_count = len(set(answer) ^ set(right_answer))
        has_right_number = not set(answer).isdisjoint(right_answer)
        return max(1.0 - 0.5 * difference_count, 0.0) * has_right_number
    if isinstance(answer, float | int) and isinstance(right_answer, float | int):
        for tolerance, fraction in ((FULL_POINTS_TOLERANCE, 1.0), (HALF_POINTS_TOLERANCE, 0.5)):
            if abs(answer - right_answer) <= tolerance * abs(right_answer):
                return fraction
    return 0.0
