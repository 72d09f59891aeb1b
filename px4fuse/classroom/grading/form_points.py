"""Points (0 to 100) for a student's answers about a flight, by comparison with the answer key.

The constants reproduce points that an instructor gave by hand. A score is a fraction of the points.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import zip_longest
from operator import itemgetter
from typing import NamedTuple

from px4fuse.core.record import Record, read_csv, read_toml
from px4fuse.results.answer_form import (
    CHOICE_LETTERS,
    FAULT_KINDS,
    NO_FAULT_KIND,
    NOT_AVAILABLE,
    Answers,
    Choice,
    NamedFault,
    NumericAnswer,
    select_questions,
)

from ..assignment.key import CorrectFormAnswers, InjectedFault
from .model import ItemScore

# If the answer form also has questions about plots of other flights: fraction of the points for
# questions about the student's own flight. The plots give the other points
POINTS_FRACTION_OF_FLIGHT_QUESTIONS = 0.2
# Points deducted, of 100 points for questions about the flight, for each fault that the student
# names but that was not injected
FALSE_FAULT_DEDUCTION = 10.0
# If a student names at least this number of faults that were not injected (guesses), injected
# faults that the student names give no points either
MIN_FALSE_FAULTS_FOR_ZERO_POINTS = 3
# Score for the answer that names a fault similar to the injected fault
SCORE_FOR_SIMILAR_FAULT = 0.4
# Score of a student who names a wrong EKF2_EVP_NOISE, although the injected fault is a wrong
# variance that the position source reports: both faults make R wrong
SCORE_FOR_WRONG_NOISE_PARAMETER = 2.0 / 3.0
# Score for naming a consequence of the injected fault, for example outliers after a jump
SCORE_FOR_NAMED_CONSEQUENCE = 0.15
# Kinds of injected faults that a student can guess: points also depend on the stated size
GUESSABLE_FAULT_KINDS = {"open-end"}
# The size of a fault in GUESSABLE_FAULT_KINDS gives no points if its relative error exceeds the
# tolerance by this value
EXCESS_SIZE_ERROR_AT_ZERO_POINTS = 0.08
NO_BOUNDS = (-math.inf, math.inf)
# Minimum tolerance (s) of the start and the end of a fault that the student states
FAULT_TIME_TOLERANCE_S = 2.0
# Tolerance of the start and the end of a fault ÷ time since the first sample
FAULT_TIME_TOLERANCE_FRACTION = 0.05
# Maximum relative error of a number that the student computed, for full points
MAX_RELATIVE_NUMBER_ERROR_FOR_FULL_POINTS = 0.02
# Maximum relative error of a number that the student computed, for half of the points
MAX_RELATIVE_NUMBER_ERROR_FOR_HALF_POINTS = 0.10
# Maximum relative error of the stated size of an injected fault, for half of the points
MAX_RELATIVE_SIZE_ERROR_FOR_HALF_POINTS = 0.4


class CorrectionRule(Record):
    """Rule for the points of a correction that a student names (row of ``corrections.csv``).

    The first row of a fault contains its best correction.

    Attributes
    ----------
    parameter : str
        Changed option, EKF2 parameter, or other action.
    fault_kinds : str
        Faults for which this correction gives points, separated by blanks.
    score : float
        Fraction of the points: 1 if the parameter corrects the fault, 1/2 if it concerns the fault
        but does not correct it, and 1/3 if it only hides the fault.
    right_value_range : str
        "LOW to HIGH", or the name of a computed range; "" if any value is right.
    """

    parameter: str
    fault_kinds: str
    score: float
    right_value_range: str


CORRECTION_RULES = read_csv(__file__, CorrectionRule, "corrections.csv")
POINTS_CONFIG = read_toml(__file__, dict)
SIMILAR_FAULT_GROUPS = [set(kinds.split()) for kinds in POINTS_CONFIG["neighbours"].values()]
FORM_PART_NAMES = tuple(POINTS_CONFIG["weights"])


@dataclass(frozen=True)
class FormPoints:
    """Points and feedback for a student's answer form.

    Attributes
    ----------
    parts : tuple of ItemScore
        Points for each part of the form, for example "mistakes" (names of the faults).
    did_student_name_fault : mapping of str to bool
        For each kind of injected fault: True if the student named this fault.
    """

    parts: tuple[ItemScore, ...] = ()
    feedback: tuple[str, ...] = ()
    did_student_name_fault: Mapping[str, bool] = field(default_factory=dict)

    @property
    def fraction(self) -> float:
        points = sum(part.points for part in self.parts)
        return max(points, 0.0) / sum(part.max_points for part in self.parts)


def compute_form_points(answers: Answers, right_answers: CorrectFormAnswers) -> FormPoints:
    """Compare a student's answers with the right answers, and compute the points."""
    is_recognised_as_fault_free = not right_answers.mistakes and answers.declares_no_fault
    # if the form also has questions about the figures of other flights, the questions about the
    # student's own flight give only a fraction of the points
    flight_points_fraction = POINTS_FRACTION_OF_FLIGHT_QUESTIONS if right_answers.choices else 1.0
    table_name = "weights_clean" if is_recognised_as_fault_free else "weights"
    weights = {
        name: flight_points_fraction * max_points
        for name, max_points in POINTS_CONFIG[table_name].items()
    }
    # score (0 to 1) of each part
    scores = dict.fromkeys(FORM_PART_NAMES, 0.0)
    matches, wrongly_named_faults = _match_faults(answers, right_answers)
    if is_recognised_as_fault_free:
        scores["mistakes"] = 1.0
    elif len(wrongly_named_faults) < MIN_FALSE_FAULTS_FOR_ZERO_POINTS:  # else guessed
        scores |= _score_faults(matches, right_answers)
    scores["numbers"] = _score_numbers(answers, right_answers)
    scores["verdicts"] = _score_verdicts(answers, right_answers)
    if not scores["numbers"] and not is_recognised_as_fault_free:
        # verdicts can be guessed, so they give half of the points if no computed number is right
        scores["verdicts"] *= 0.5
    # points of each part
    points = {name: max_points * scores[name] for name, max_points in weights.items()}
    if right_answers.mistakes and all(fault.size is None for fault in right_answers.mistakes):
        # No injected fault has a size, so the right fault names also earn the points for sizes
        points["mistakes"] += weights["sizes"] * scores["mistakes"]
    deduction = flight_points_fraction * FALSE_FAULT_DEDUCTION * len(wrongly_named_faults)
    points["mistakes"] = max(points["mistakes"] - deduction, 0.0)
    if right_answers.choices:
        weights["figures"] = 100.0 * (1.0 - flight_points_fraction)
        points["figures"] = weights["figures"] * _score_choices(answers, right_answers)
    kinds_named_by_student = [named_fault.kind for named_fault in answers.mistakes]
    feedback = (
        *_describe_fault_answers(matches, wrongly_named_faults, is_recognised_as_fault_free),
        *_describe_wrong_answers(answers, right_answers),
    )
    parts = tuple(
        ItemScore(name, points[name], max_points, "") for name, max_points in weights.items()
    )
    return FormPoints(
        parts,
        feedback,
        {fault.kind: fault.kind in kinds_named_by_student for fault in right_answers.mistakes},
    )


# Injected fault, matching fault that the student named (or None), and score (0 to 1)
FaultMatch = tuple[InjectedFault, NamedFault | None, float]


def _describe_fault_answers(
    matches: list[FaultMatch], wrongly_named_faults: list[NamedFault], declares_no_fault: bool
) -> Iterator[str]:
    """Yield feedback on each injected fault, and on named faults that the flight does not have."""
    if not matches:
        yield f"your flight has no injected fault{', as your form states' * declares_no_fault}"
    for fault, named_fault, _ in matches:
        fault_text = f"{fault.kind} ({FAULT_KINDS[fault.kind].description})"
        right_answer = describe_right_answer(fault)
        if named_fault is None:
            yield f"you did not name {fault_text}: {right_answer}"
        elif named_fault.kind != fault.kind:
            yield f"you named {named_fault.kind} instead of {fault_text}: {right_answer}"
        else:
            yield f"you named {fault.kind}, which is right ({right_answer})"
    if wrongly_named_faults:
        kinds = ", ".join(named_fault.kind for named_fault in wrongly_named_faults)
        yield f"you named faults that your flight does not have: {kinds}"


def describe_right_answer(fault: InjectedFault) -> str:
    """State the accepted size and the time of a fault, and the plots that show the fault."""
    texts = []
    if fault.low is not None and fault.high is not None:
        unit = FAULT_KINDS[fault.kind].standard_unit
        texts.append(f"accepted fault size {fault.low:.3g} to {fault.high:.3g} {unit}".rstrip())
    start_text = "" if fault.from_s is None else f"from {fault.from_s:.0f} s "
    end_text = "" if fault.until_s is None else f"until {fault.until_s:.0f} s"
    texts.append(f"{start_text}{end_text}".strip() or "whole flight")
    return ", ".join([*texts, f"shown in {' or '.join(find_panels_showing_fault(fault.kind))}"])


def _describe_wrong_answers(answers: Answers, right_answers: CorrectFormAnswers) -> Iterator[str]:
    """Yield feedback on wrong answers: consistency, EKF2, numeric questions and plots."""
    # question, answer of the student, and right answer. Answers that are accepted although they
    # differ from the right answer are not added
    rows: list[tuple[str, object, object]] = [
        ("consistency of KF", answers.verdict_kf, right_answers.kf.verdict or NOT_AVAILABLE),
        ("consistency of EKF2", answers.verdict_ekf2, right_answers.ekf2.verdict or NOT_AVAILABLE),
    ]
    if _score_ekf2_behaviour(answers, right_answers) < 1.0:
        rows.append(("behaviour of EKF2", answers.ekf2_did, right_answers.ekf2_did))
    tolerance_text = f"within {100.0 * MAX_RELATIVE_NUMBER_ERROR_FOR_FULL_POINTS:g} %"
    # a form without numbers contains fewer answers than questions
    for question, given, right in zip_longest(
        select_questions(answers.log_sha256), answers.quantities, right_answers.quantities
    ):
        if right not in (None, ()) and _score_number(given, right) < 1.0:
            rows.append((f"{question.text}, {tolerance_text}", given, right))
    for choice, right_letter, letter in list_answered_choices(answers, right_answers):
        rows.append((choice.question, choice.answer_text(letter), choice.answer_text(right_letter)))
    for name, given, right in rows:
        if given != right:
            yield f"{name}: {_format_answer(right)} is right, you gave {_format_answer(given)}"


class AnsweredChoice(NamedTuple):
    """Multiple-choice question, and the letter that the student gave ("" if left blank)."""

    choice: Choice
    right_letter: str
    letter: str


def list_answered_choices(
    answers: Answers, right_answers: CorrectFormAnswers
) -> list[AnsweredChoice]:
    """Return the multiple-choice questions of the answer key with the student's letters."""
    # letters of the student, filled with "" to at least the number of questions
    letters = (*answers.choices, *[""] * len(right_answers.choices))
    return [
        AnsweredChoice(*right_choice, letter)
        for right_choice, letter in zip(right_answers.choices, letters, strict=False)
    ]


def _format_answer(answer: object) -> str:
    if isinstance(answer, tuple):
        return ", ".join(map(_format_answer, answer)) or "none"
    return f"{answer:.4g}" if isinstance(answer, float | int) else f"'{answer or 'none'}'"


def _match_faults(
    answers: Answers, right_answers: CorrectFormAnswers
) -> tuple[list[FaultMatch], list[NamedFault]]:
    """Match each injected fault with the fault in a student's answers that gives most points.

    Return the matches, and the faults in the answers that match no injected fault.
    """
    unmatched_faults = [
        named_fault for named_fault in answers.mistakes if named_fault.kind != NO_FAULT_KIND
    ]
    candidates = [
        (score_fault_kind(fault.kind, named_fault.kind), fault.kind, named_fault)
        for fault in right_answers.mistakes
        for named_fault in unmatched_faults
    ]
    match_by_kind: dict[str, tuple[NamedFault, float]] = {}
    # match the pairs with the highest scores first; each fault belongs to at most one pair
    for score, kind, named_fault in sorted(candidates, key=itemgetter(0), reverse=True):
        if score and kind not in match_by_kind and named_fault in unmatched_faults:
            match_by_kind[kind] = named_fault, score
            unmatched_faults.remove(named_fault)
    matches = [
        (fault, *match_by_kind.get(fault.kind, (None, 0.0))) for fault in right_answers.mistakes
    ]
    return matches, unmatched_faults


def score_fault_kind(kind: str, named_kind: str) -> float:
    """Return the score (0 to 1) of the answer ``named_kind`` if the injected fault is ``kind``."""
    if kind == named_kind:
        return 1.0
    if (kind, named_kind) == ("r-scale", "ekf2-noise"):
        return SCORE_FOR_WRONG_NOISE_PARAMETER
    if any({kind, named_kind} <= group for group in SIMILAR_FAULT_GROUPS):
        return SCORE_FOR_SIMILAR_FAULT
    is_consequence = named_kind in POINTS_CONFIG["effects"].get(kind, "").split()
    return SCORE_FOR_NAMED_CONSEQUENCE if is_consequence else 0.0


def _score_faults(matches: list[FaultMatch], right_answers: CorrectFormAnswers) -> dict[str, float]:
    """Return the mean score of all injected faults, by part of the answer form.

    The score for sizes is the mean of the faults with a size.
    """
    faults_with_size_count = sum(fault.size is not None for fault, _, _ in matches)
    scores = dict.fromkeys(("mistakes", "sizes", "fault time and plot", "correction"), 0.0)
    for fault, named_fault, kind_score in matches:
        if named_fault is None:
            continue
        size_score = score_fault_size(fault, named_fault)
        evidence_score = score_evidence(fault, named_fault)
        correction_score = score_correction(fault, named_fault, right_answers)
        # if the student names a similar fault instead of the injected fault, the right time and
        # plot give half of the points
        if named_fault.kind != fault.kind:
            evidence_score *= 0.5
        # students can guess the names of faults in GUESSABLE_FAULT_KINDS. The right time, plot and
        # correction follow from the name, so their scores are multiplied by the score for the
        # stated size
        if fault.kind in GUESSABLE_FAULT_KINDS:
            evidence_score *= size_score
            correction_score *= size_score
        scores["mistakes"] += kind_score / len(matches)
        scores["fault time and plot"] += evidence_score / len(matches)
        scores["correction"] += correction_score / len(matches)
        if fault.size is not None:
            scores["sizes"] += size_score / faults_with_size_count
    return scores


def score_fault_size(fault: InjectedFault, named_fault: NamedFault) -> float:
    """Return the score (0 to 1) for the size that the student states for a fault."""
    stated_size = named_fault.convert_size_to_standard_unit()
    if fault.size is None or fault.low is None or fault.high is None or stated_size is None:
        return 0.0
    if named_fault.kind != fault.kind:
        # if the student names a similar fault instead of the injected fault, a size within the
        # accepted range gives a third of the points. Both sizes need the same unit
        unit, stated_unit = (FAULT_KINDS[each.kind].standard_unit for each in (fault, named_fault))
        return (fault.low <= stated_size <= fault.high and unit == stated_unit) / 3.0
    relative_error = abs(stated_size - fault.size) / abs(fault.size)
    if fault.kind in GUESSABLE_FAULT_KINDS:
        # the score decreases linearly with the distance from the accepted range
        tolerance = (fault.high - fault.low) / (2.0 * abs(fault.size))
        excess_error = relative_error - tolerance
        score_outside_range = max(1.0 - excess_error / EXCESS_SIZE_ERROR_AT_ZERO_POINTS, 0.0)
    else:
        score_outside_range = 0.5 * (relative_error <= MAX_RELATIVE_SIZE_ERROR_FOR_HALF_POINTS)
    return _score_number_in_range(stated_size, fault.low, fault.high, score_outside_range)


def score_evidence(fault: InjectedFault, named_fault: NamedFault) -> float:
    """Return 1/2 for the right time of a fault, plus 1/2 for naming a plot that shows the fault."""
    if fault.from_s is None and fault.until_s is None:
        is_time_right = named_fault.when == "whole flight"
    else:
        true_and_named_times_s = (
            (fault.from_s, named_fault.from_s),
            (fault.until_s, named_fault.until_s),
        )
        is_time_right = not named_fault.when and all(
            named_s is not None
            and abs(named_s - true_s)
            <= max(FAULT_TIME_TOLERANCE_S, FAULT_TIME_TOLERANCE_FRACTION * true_s)
            for true_s, named_s in true_and_named_times_s
            if true_s is not None
        )
    return 0.5 * is_time_right + 0.5 * (named_fault.panel in find_panels_showing_fault(fault.kind))


def find_panels_showing_fault(fault_kind: str) -> list[str]:
    return [
        *(panel for panel, kinds in POINTS_CONFIG["shows"].items() if fault_kind in kinds.split()),
        "cover",
    ]


def score_correction(
    fault: InjectedFault, named_fault: NamedFault, right_answers: CorrectFormAnswers
) -> float:
    """Return the score (0 to 1) for the parameter and the value that correct a fault."""
    stated_value, best_score = named_fault.convert_value_to_standard_unit(), 0.0
    for parameter, bounds, score in find_accepted_corrections(fault, right_answers):
        if parameter == named_fault.parameter:
            # the right parameter with a wrong or without a value gives half of the score
            value_score = 0.5
            if bounds == NO_BOUNDS:
                value_score = 1.0
            elif stated_value is not None:
                value_score = _score_number_in_range(stated_value, *bounds, 0.5)
            best_score = max(best_score, score * value_score)
    return best_score


def _score_number_in_range(
    value: float, low: float, high: float, score_outside_range: float
) -> float:
    """Return 1 within the range, 1/3 if only the sign is wrong, or ``score_outside_range``."""
    if low <= value <= high:
        return 1.0
    return 1.0 / 3.0 if low <= -value <= high else score_outside_range


# Parameter that corrects an injected fault, range of right values, and score
AcceptedCorrection = tuple[str, tuple[float, float], float]


def find_accepted_corrections(
    fault: InjectedFault, right_answers: CorrectFormAnswers
) -> list[AcceptedCorrection]:
    """Return the corrections that are accepted for a fault (rows of ``corrections.csv``).

    Each correction has the range of its accepted values. The file states this range, or its name. A
    named range depends on size and time of the injected fault, or on the true position noise.
    """
    size, lower_bound, upper_bound = (value or 0.0 for value in (fault.size, fault.low, fault.high))
    fault_start_s = fault.from_s or 0.0
    fault_end_s = fault_start_s if fault.until_s is None else fault.until_s
    # ranges of right parameter values. The column right_value_range of corrections.csv refers to
    # them by name
    range_by_name = {
        "": NO_BOUNDS,
        # value that cancels the fault
        "negated": (-upper_bound, -lower_bound),
        "size": (lower_bound, upper_bound),
        # Range of a time offset in ms (injected in s)
        "late milliseconds": (1e3 * lower_bound, 1e3 * upper_bound),
        # Range of IMU log rates (Hz): at least twice the rate that the fault injected
        "twice": (2.0 * size, 1e4),
        # Range of factors that correct a scale factor error of lower_bound to upper_bound per cent
        "factors": (100.0 / (100.0 + upper_bound), 100.0 / (100.0 + lower_bound)),
        # measurement noise σ (m): with 0.8 to 1.25 times the true σ, a filter is consistent
        "noise": (0.8 * right_answers.sigma_z_m, 1.25 * right_answers.sigma_z_m),
        # start time ("after") or end time ("before") of an analysis that excludes the fault. The
        # analysis may contain up to 1 s of the fault, or omit up to 15 s of data without the fault
        "after": (fault_end_s - 1.0, fault_end_s + 15.0),
        "before": (fault_start_s - 15.0, fault_start_s + 1.0),
    }
    accepted_corrections = []
    for rule in CORRECTION_RULES:
        if fault.kind not in rule.fault_kinds.split():
            continue
        # EKF2_EV_DELAY cannot be negative, so it does not correct timestamps that are too early
        if rule.right_value_range == "late milliseconds" and size <= 0.0:
            continue
        if rule.right_value_range in range_by_name:
            low, high = range_by_name[rule.right_value_range]
        else:
            low, high = map(float, rule.right_value_range.split(" to "))
        accepted_corrections.append((rule.parameter, (low, high), rule.score))
    return accepted_corrections


def _score_verdicts(answers: Answers, right_answers: CorrectFormAnswers) -> float:
    """Return the mean of three scores (0 to 1): verdict on KF, on EKF2, and behaviour of EKF2."""
    is_kf_right = answers.verdict_kf == (right_answers.kf.verdict or NOT_AVAILABLE)
    is_ekf2_right = answers.verdict_ekf2 == (right_answers.ekf2.verdict or NOT_AVAILABLE)
    return (is_kf_right + is_ekf2_right + _score_ekf2_behaviour(answers, right_answers)) / 3.0


def _score_ekf2_behaviour(answers: Answers, right_answers: CorrectFormAnswers) -> float:
    """Return the score (0, 1/2 or 1) of the behaviours of EKF2 that a student reports.

    The score is 1 for all required behaviours without a false one. It is 0 without any right
    behaviour, or with several false ones. Otherwise it is 1/2.
    """
    stated, required = set(answers.ekf2_did), set(right_answers.ekf2_did)
    right = stated & {*required, *right_answers.ekf2_did_also}
    false_count = len(stated - right)
    if not right or false_count > 1:
        return 0.0
    # If only one behaviour is required, an allowed behaviour (ekf2_did_also) may replace it
    is_complete = required <= stated or len(required) == 1
    return 1.0 if is_complete and not false_count else 0.5


def _score_choices(answers: Answers, right_answers: CorrectFormAnswers) -> float:
    """Return the mean score of the multiple-choice questions; random answers give 0 on average."""
    points = 0.0
    for _, right_letter, letter in list_answered_choices(answers, right_answers):
        if letter:
            points += 1.0 if letter == right_letter else -1.0 / (len(CHOICE_LETTERS) - 1)
    return points / len(right_answers.choices)


def _score_numbers(answers: Answers, right_answers: CorrectFormAnswers) -> float:
    """Return the mean score for the numbers that the student computed with KF."""
    # an empty list as right answer is not scored, because it could be guessed
    scored_number_count = sum(value not in (None, ()) for value in right_answers.quantities)
    return sum(
        _score_number(*pair)
        for pair in zip(answers.quantities, right_answers.quantities, strict=False)
    ) / max(scored_number_count, 1)


def _score_number(answer: NumericAnswer, right_answer: NumericAnswer) -> float:
    """Return the score (0, 1/2 or 1) of a number, or of a list of numbers."""
    if isinstance(right_answer, tuple) and answer is not None:
        # list of numbers: each missing and each false number costs half of the points
        given, right = set(answer if isinstance(answer, tuple) else (answer,)), set(right_answer)
        return max(1.0 - 0.5 * len(given ^ right), 0.0) if given & right else 0.0
    if isinstance(answer, float | int) and isinstance(right_answer, float | int):
        error, magnitude = abs(answer - right_answer), abs(right_answer)
        if error <= MAX_RELATIVE_NUMBER_ERROR_FOR_FULL_POINTS * magnitude:
            return 1.0
        if error <= MAX_RELATIVE_NUMBER_ERROR_FOR_HALF_POINTS * magnitude:
            return 0.5
    return 0.0
