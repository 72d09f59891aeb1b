"""Points of a student's answer form (0 to 100), by comparison with the answer key.

The constants reproduce points that an instructor gave by hand. Guessing is not rewarded: each false
mistake (named in the form, but not in the flight) costs points, and a mistake that can be guessed
without a measurement has points only with the correct size. ``form_points.toml`` contains the
tables.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import msgspec

from px4fuse.answer_form import MISTAKES, Answers, QuantityAnswer, StudentMistake
from px4fuse.assignment.truth import FormTruth, TrueMistake
from px4fuse.record import table

# deduction (points) for each false mistake, and number of false mistakes from which the right ones
# have no points either
FALSE_CLAIM_POINTS, MAX_FALSE_CLAIMS = 10.0, 3
# fractions of the points if the form names another mistake instead: a related one, one with the
# same effect on EKF2's noise, and a consequence
NEIGHBOUR_SHARE, SAME_NUMBER_SHARE, EFFECT_SHARE = 0.4, 2.0 / 3.0, 0.15
# mistakes that can be guessed without a measurement: only the correct size has points. A close size
# has none, because the assigned sizes are close to each other
GUESSABLE_KINDS = frozenset(("open-end",))
ANY_BOUNDS = (-math.inf, math.inf)
# tolerances of a time, the larger one applies: seconds, and fraction of the time
TIME_TOLERANCE_S, TIME_TOLERANCE_SHARE = 2.0, 0.05
# relative tolerances of a computed number for all points and for half of the points
FULL_TOLERANCE, HALF_TOLERANCE = 0.02, 0.10
# relative tolerance of the size of a mistake for half of the points
HALF_SIZE_TOLERANCE = 0.4


@dataclass(frozen=True)
class _Cure:
    """Correction that the form may name: parameter and right values, from ``form_points.toml``.

    Attributes
    ----------
    of : mapping
        Fraction of the points for this correction, by mistake.
    to : (float, float) or str
        Bounds of the right values, or the name of a rule in :func:`cures`.
    late : bool
        True if the correction is right for late timestamps only.
    """

    parameter: str
    of: Mapping[str, float]
    to: tuple[float, float] | str = ANY_BOUNDS
    late: bool = False


TABLE = table(__file__, "form_points.toml", dict)
CORRECTIONS = msgspec.convert(TABLE["cures"], tuple[_Cure, ...])
NEIGHBOURS = msgspec.convert([*TABLE["neighbours"].values()], tuple[frozenset[str], ...])
PART_NAMES = tuple(TABLE["weights"])


@dataclass(frozen=True)
class FormPoints:
    """Points of an answer form.

    Attributes
    ----------
    points_by_part : mapping
        Points of each part of the form: "mistakes", "sizes", "correction", ....
    max_points_by_part : mapping
        Maximum points of each part of the form.
    feedback : tuple of str
        Phrases about right, missed and false mistakes, for the student.
    is_named_by_mistake : mapping
        True for each mistake of the flight that the form names.
    """

    points_by_part: Mapping[str, float]
    max_points_by_part: Mapping[str, float]
    feedback: tuple[str, ...] = ()
    is_named_by_mistake: Mapping[str, bool] = field(default_factory=dict)

    @property
    def share(self) -> float:
        """Points divided by the maximum points."""
        return sum(self.points_by_part.values()) / sum(self.max_points_by_part.values())


def form_points(answers: Answers, truth: FormTruth) -> FormPoints:
    """Compute the points of a form by comparison with the right answers."""
    is_clean_named = not truth.mistakes and answers.names_no_mistake
    weights = TABLE["weights_clean" if is_clean_named else "weights"]
    shares = dict.fromkeys(PART_NAMES, 0.0)
    matches, false_claims = _match_claims(answers, truth)
    if truth.mistakes and len(false_claims) < MAX_FALSE_CLAIMS:
        shares |= _mistake_shares(matches, truth)
    shares["numbers"] = quantities_share = _quantities_share(answers, truth)
    # half of the points if no computed number is right, because most verdicts can be guessed
    shares["verdicts"] = _verdicts_share(answers, truth) * (1.0 if quantities_share else 0.5)
    points_by_part = {name: weights[name] * share for name, share in shares.items()}
    if is_clean_named:
        points_by_part["mistakes"] = weights["mistakes"]
    elif truth.mistakes and all(mistake.size is None for mistake in truth.mistakes):
        # no mistake of this flight has a size, so "mistakes" gets the points of "sizes" in addition
        points_by_part["mistakes"] += weights["sizes"] * shares["mistakes"]
    points_by_part["mistakes"] = max(
        points_by_part["mistakes"] - FALSE_CLAIM_POINTS * len(false_claims), 0.0
    )
    claimed_kinds = [claim.kind for claim in answers.mistakes]
    is_named_by_mistake = {
        mistake.kind: mistake.kind in claimed_kinds for mistake in truth.mistakes
    }
    return FormPoints(
        points_by_part,
        weights,
        tuple(_mistake_feedback(matches, false_claims, is_clean_named)),
        is_named_by_mistake,
    )


# mistake of the flight, best matching mistake in the form, and fraction of the points
Match = tuple[TrueMistake, StudentMistake | None, float]


def _mistake_feedback(
    matches: list[Match], false_claims: list[StudentMistake], is_clean_named: bool
) -> Iterator[str]:
    """Yield a phrase for each right or missed mistake, and one for all false mistakes."""
    if not matches:
        yield f"your flight has no mistake{', as your form states' * is_clean_named}"
    for mistake, claim, _ in matches:
        mistake_text = f"{mistake.kind} ({MISTAKES[mistake.kind].description})"
        if claim is None:
            yield f"you did not name {mistake_text}"
        elif claim.kind != mistake.kind:
            yield f"you named {claim.kind} instead of {mistake_text}"
        else:
            yield f"you named {mistake.kind}, which is right"
    if false_claims:
        yield f"your flight does not have {', '.join(claim.kind for claim in false_claims)}"


def _match_claims(answers: Answers, truth: FormTruth) -> tuple[list[Match], list[StudentMistake]]:
    """Match each mistake of the flight with one of the form; also return the false mistakes.

    Equal mistakes are matched first, then related mistakes, then consequences.
    """
    unmatched = [claim for claim in answers.mistakes if claim.kind != "none"]
    claim_by_kind: dict[str, tuple[StudentMistake, float]] = {}
    candidates = [
        (kind_share(mistake.kind, claim.kind), mistake.kind, claim)
        for mistake in truth.mistakes
        for claim in unmatched
    ]
    for share, kind, claim in sorted(candidates, key=lambda candidate: -candidate[0]):
        if share and kind not in claim_by_kind and claim in unmatched:
            claim_by_kind[kind] = claim, share
            unmatched.remove(claim)
    return [
        (mistake, *claim_by_kind.get(mistake.kind, (None, 0.0))) for mistake in truth.mistakes
    ], unmatched


def kind_share(kind: str, claimed_kind: str) -> float:
    """Return the fraction of the points if the form names ``claimed_kind`` instead of ``kind``."""
    if kind == claimed_kind:
        return 1.0
    if (kind, claimed_kind) == ("r-scale", "ekf2-noise"):
        return SAME_NUMBER_SHARE
    if any({kind, claimed_kind} <= group for group in NEIGHBOURS):
        return NEIGHBOUR_SHARE
    return EFFECT_SHARE if claimed_kind in TABLE["effects"].get(kind, ()) else 0.0


def _mistake_shares(matches: list[Match], truth: FormTruth) -> dict[str, float]:
    """Return the fraction of the points of the parts about mistakes: the mean over the mistakes."""
    sized_count = sum(mistake.size is not None for mistake, _, _ in matches)
    shares = dict.fromkeys(("mistakes", "sizes", "time and panel", "correction"), 0.0)
    for mistake, claim, share in matches:
        if claim is None:
            continue
        size_points = size_share(mistake, claim)
        when_points = when_share(mistake, claim) * (1.0 if claim.kind == mistake.kind else 0.5)
        cure_points = cure_share(mistake, claim, truth)
        weight = size_points if mistake.kind in GUESSABLE_KINDS else 1.0
        shares["mistakes"] += share / len(matches)
        shares["time and panel"] += when_points * weight / len(matches)
        shares["correction"] += cure_points * weight / len(matches)
        shares["sizes"] += size_points / max(sized_count, 1)
    return shares


def size_share(mistake: TrueMistake, claim: StudentMistake) -> float:
    """Return the fraction of the points for a size: 1 (right), 1/2 (close), 1/3, or 0.

    1/3 is for the wrong sign, and for the correct size of a related mistake.
    """
    size = claim.size_in_first_unit()
    if mistake.size is None or mistake.low is None or mistake.high is None or size is None:
        return 0.0
    if claim.kind != mistake.kind:
        has_same_unit = [*MISTAKES[claim.kind].units][:1] == [*MISTAKES[mistake.kind].units][:1]
        return 1.0 / 3.0 if mistake.low <= size <= mistake.high and has_same_unit else 0.0
    is_close = mistake.kind not in GUESSABLE_KINDS and abs(
        size - mistake.size
    ) <= HALF_SIZE_TOLERANCE * abs(mistake.size)
    return _value_share(size, mistake.low, mistake.high, 0.5 if is_close else 0.0)


def when_share(mistake: TrueMistake, claim: StudentMistake) -> float:
    """Return the fraction of the points for the time and the report panel: half for each."""
    if mistake.from_s is None and mistake.until_s is None:
        is_time_right = claim.when == "whole flight"
    else:
        times = (mistake.from_s, claim.from_s), (mistake.until_s, claim.until_s)
        is_time_right = not claim.when and all(
            true_s is None
            or (
                claimed_s is not None
                and abs(claimed_s - true_s) <= max(TIME_TOLERANCE_S, TIME_TOLERANCE_SHARE * true_s)
            )
            for true_s, claimed_s in times
        )
    return 0.5 * is_time_right + 0.5 * (claim.panel in panels(mistake.kind))


def panels(kind: str) -> list[str]:
    """Return the panels of the report that can show a kind of mistake."""
    return [*(panel for panel, kinds in TABLE["shows"].items() if kind in kinds), "cover"]


def cure_share(mistake: TrueMistake, claim: StudentMistake, truth: FormTruth) -> float:
    """Return the fraction of the points for a correction and its value."""
    value = claim.value_in_first_unit()
    shares = [
        share
        if (low, high) == ANY_BOUNDS
        else share * (0.5 if value is None else _value_share(value, low, high, 0.5))
        for parameter, (low, high), share in cures(mistake, truth)
        if parameter == claim.parameter
    ]
    return max(shares, default=0.0)


def _value_share(value: float, low: float, high: float, fallback: float) -> float:
    """Return 1 for a value within bounds, 1/3 for its negative within bounds, else ``fallback``."""
    if low <= value <= high:
        return 1.0
    return 1.0 / 3.0 if low <= -value <= high else fallback


# parameter, bounds of the right values, and fraction of the points
Cure = tuple[str, tuple[float, float], float]


def cures(mistake: TrueMistake, truth: FormTruth) -> tuple[Cure, ...]:
    """Return the right corrections of a mistake, with bounds of their right values."""
    size, low, high = (
        0.0 if value is None else value for value in (mistake.size, mistake.low, mistake.high)
    )
    from_s = 0.0 if mistake.from_s is None else mistake.from_s
    until_s = from_s if mistake.until_s is None else mistake.until_s
    bounds = {
        "back": (-high, -low),
        "size": (low, high),
        "milliseconds": (1e3 * low, 1e3 * high),
        "twice": (2.0 * size, 1e4),
        "factors": (100.0 / (100.0 + high), 100.0 / (100.0 + low)),
        "noise": (0.8 * truth.sigma_z_m, 1.25 * truth.sigma_z_m),
        "after": (until_s - 1.0, until_s + 15.0),
        "before": (from_s - 15.0, from_s + 1.0),
    }
    return tuple(
        (
            row.parameter,
            bounds[row.to] if isinstance(row.to, str) else row.to,
            0.0 if row.late and size <= 0.0 else row.of[mistake.kind],
        )
        for row in CORRECTIONS
        if mistake.kind in row.of
    )


def _verdicts_share(answers: Answers, truth: FormTruth) -> float:
    """Return the fraction of the points for both verdicts (KF, EKF2) and the behaviour of EKF2."""
    shares = [_ekf2_behaviour_share(answers, truth)]
    for answer, known in ((answers.verdict_kf, truth.kf), (answers.verdict_ekf2, truth.ekf2)):
        shares.append(1.0 if answer and answer == known.verdict else 0.0)
    return sum(shares) / len(shares)


def _ekf2_behaviour_share(answers: Answers, truth: FormTruth) -> float:
    """Return the fraction of the points for EKF2's behaviour: 1 if complete, 1/2 with one error.

    An error is a missing or a false statement.
    """
    named, required = set(answers.ekf2_did), set(truth.ekf2_did)
    allowed = required | set(truth.ekf2_did_also)
    false_count, right_count = len(named - allowed), len(named & allowed)
    if not right_count or false_count > 1:
        return 0.0
    is_complete = required <= named or (
        len(required) == 1 and bool(named & set(truth.ekf2_did_also))
    )
    return 1.0 if is_complete and not false_count else 0.5


def _quantities_share(answers: Answers, truth: FormTruth) -> float:
    """Return the fraction of the points for the numbers that can be computed from the flight."""
    # an empty list is the right answer on most flights, so it has no points
    known_count = sum(value not in (None, ()) for value in truth.quantities)
    pairs = zip(answers.quantities, truth.quantities, strict=False)
    return sum(_quantity_share(*pair) for pair in pairs) / max(known_count, 1)


def _quantity_share(answer: QuantityAnswer, true_value: QuantityAnswer) -> float:
    if isinstance(answer, tuple) and isinstance(true_value, tuple):
        difference_count = len(set(answer) ^ set(true_value))
        return (
            (1.0, 0.5)[difference_count]
            if difference_count < 2 and set(answer) & set(true_value)
            else 0.0
        )
    if isinstance(answer, float | int) and isinstance(true_value, float | int):
        for tolerance, share in ((FULL_TOLERANCE, 1.0), (HALF_TOLERANCE, 0.5)):
            if abs(answer - true_value) <= tolerance * abs(true_value):
                return share
    return 0.0
