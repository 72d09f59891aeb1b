"""Points of an answer form (of 100), by comparison with the answer key.

The weights and shares reproduce grading by hand. Guessing does not pay: each mistake that the
flight does not have costs points, and what can be guessed without measurement counts only with the
right size. ``form_points.toml`` contains the tables.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import msgspec

from px4fuse.answer_form import MISTAKES, Answers, QuantityAnswer, StudentMistake
from px4fuse.assignment.truth import FormTruth, TrueMistake
from px4fuse.record import table

FALSE_CLAIM_POINTS, MAX_FALSE_CLAIMS = 10.0, 3
NEIGHBOUR_SHARE, SAME_NUMBER_SHARE, EFFECT_SHARE = 0.4, 2.0 / 3.0, 0.15
# mistakes that can be guessed without measurement count only with the right size; a close size is
# not enough, because the drawn sizes are close to each other
GUESSABLE_KINDS = frozenset(("open-end",))
ANY_VALUE = (-math.inf, math.inf)
TIME_TOLERANCE_S, TIME_TOLERANCE_SHARE = 2.0, 0.05
FULL_TOLERANCE, HALF_TOLERANCE = 0.02, 0.10
HALF_SIZE_TOLERANCE = 0.4


@dataclass(frozen=True)
class _Cure:
    """Correction of mistakes; ``to``: bounds of right values, or a rule of :func:`cures`."""

    parameter: str
    of: Mapping[str, float]
    to: tuple[float, float] | str = ANY_VALUE
    late: bool = False


TABLE = table(__file__, "form_points.toml", dict)
CURES = msgspec.convert(TABLE["cures"], tuple[_Cure, ...])
NEIGHBOURS = msgspec.convert([*TABLE["neighbours"].values()], tuple[frozenset[str], ...])
PART_NAMES = tuple(TABLE["weights"])


@dataclass(frozen=True)
class FormPoints:
    """Points of a form.

    Attributes
    ----------
    points_by_part : mapping
        Points of each part.
    of : mapping
        Maximum points of each part.
    feedback : tuple of str
        Right and wrong mistakes, for the student.
    named : mapping
        Mistakes of the flight; True if the form names them.
    """

    points_by_part: Mapping[str, float]
    of: Mapping[str, float]
    feedback: tuple[str, ...] = ()
    named: Mapping[str, bool] = field(default_factory=dict)

    @property
    def share(self) -> float:
        """Fraction of all points."""
        return sum(self.points_by_part.values()) / sum(self.of.values())


def form_points(answers: Answers, truth: FormTruth) -> FormPoints:
    """Compute the points of a form for a flight with known answers."""
    is_claimed_clean = not truth.mistakes and answers.claims_no_mistake
    weights = TABLE["weights_clean" if is_claimed_clean else "weights"]
    shares = dict.fromkeys(PART_NAMES, 0.0)
    matches, false_claims = _match_claims(answers, truth)
    if truth.mistakes and len(false_claims) < MAX_FALSE_CLAIMS:
        shares |= _mistake_shares(matches, truth)
    shares["quantities"] = computed = _quantities_share(answers, truth)
    # half if no number was computed: many flights have the same verdicts, which can be guessed
    shares["verdicts"] = _verdicts_share(answers, truth) * (1.0 if computed else 0.5)
    points_by_part = {name: weights[name] * share for name, share in shares.items()}
    if is_claimed_clean:
        points_by_part["kinds"] = weights["kinds"]
    elif truth.mistakes and all(mistake.size is None for mistake in truth.mistakes):
        points_by_part["kinds"] += weights["sizes"] * shares["kinds"]  # no mistake has a size
    points_by_part["kinds"] = max(
        points_by_part["kinds"] - FALSE_CLAIM_POINTS * len(false_claims), 0.0
    )
    claimed = [claim.kind for claim in answers.mistakes]
    named = {mistake.kind: mistake.kind in claimed for mistake in truth.mistakes}
    return FormPoints(
        points_by_part,
        weights,
        tuple(_mistake_feedback(matches, false_claims, is_claimed_clean)),
        named,
    )


Match = tuple[TrueMistake, StudentMistake | None, float]


def _mistake_feedback(
    matches: list[Match], false_claims: list[StudentMistake], is_claimed_clean: bool
) -> Iterator[str]:
    """Yield a phrase for each right, missed or wrong mistake."""
    if not matches:
        yield f"your flight has no mistake{', as your form states' * is_claimed_clean}"
    for mistake, claim, _ in matches:
        mistake_text = f"{mistake.kind} ({MISTAKES[mistake.kind].description})"
        if claim is None:
            yield f"you missed {mistake_text}"
        elif claim.kind != mistake.kind:
            yield f"you named {claim.kind} instead of {mistake_text}"
        else:
            yield f"you found {mistake.kind}"
    if false_claims:
        yield f"not in your flight: {', '.join(claim.kind for claim in false_claims)}"


def _match_claims(answers: Answers, truth: FormTruth) -> tuple[list[Match], list[StudentMistake]]:
    """Match each mistake with a claim and its share; also return the unmatched (false) claims.

    The best matches are taken first: the same kind, then related mistakes, then consequences.
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


def kind_share(kind: str, claimed: str) -> float:
    """Return the share of the points for naming ``claimed`` instead of ``kind``."""
    if kind == claimed:
        return 1.0
    if (kind, claimed) == ("r-scale", "ekf2-noise"):
        return SAME_NUMBER_SHARE
    if any({kind, claimed} <= group for group in NEIGHBOURS):
        return NEIGHBOUR_SHARE
    return EFFECT_SHARE if claimed in TABLE["effects"].get(kind, ()) else 0.0


def _mistake_shares(matches: list[Match], truth: FormTruth) -> dict[str, float]:
    """Return the shares of kinds, sizes, when and cure: means over the mistakes."""
    sized = sum(mistake.size is not None for mistake, _, _ in matches)
    shares = dict.fromkeys(("kinds", "sizes", "when", "cure"), 0.0)
    for mistake, claim, share in matches:
        if claim is None:
            continue
        size = size_share(mistake, claim)
        when_points = when_share(mistake, claim) * (1.0 if claim.kind == mistake.kind else 0.5)
        cure_points = cure_share(mistake, claim, truth)
        weight = size if mistake.kind in GUESSABLE_KINDS else 1.0
        shares["kinds"] += share / len(matches)
        shares["when"] += when_points * weight / len(matches)
        shares["cure"] += cure_points * weight / len(matches)
        shares["sizes"] += size / max(sized, 1)
    return shares


def size_share(mistake: TrueMistake, claim: StudentMistake) -> float:
    """Return the share for a size: 1, 1/2 (close), or 1/3 (wrong sign, or related mistake)."""
    size = claim.size_in_first_unit()
    if mistake.size is None or mistake.low is None or mistake.high is None or size is None:
        return 0.0
    if claim.kind != mistake.kind:
        same_unit = [*MISTAKES[claim.kind].units][:1] == [*MISTAKES[mistake.kind].units][:1]
        return 1.0 / 3.0 if mistake.low <= size <= mistake.high and same_unit else 0.0
    close = mistake.kind not in GUESSABLE_KINDS and abs(
        size - mistake.size
    ) <= HALF_SIZE_TOLERANCE * abs(mistake.size)
    return _value_share(size, mistake.low, mistake.high, 0.5 if close else 0.0)


def when_share(mistake: TrueMistake, claim: StudentMistake) -> float:
    """Return the share for time and panel: one half each."""
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
    """Return the share for a correction and its value."""
    value = claim.value_in_first_unit()
    worth = [
        share
        if (low, high) == ANY_VALUE
        else share * (0.5 if value is None else _value_share(value, low, high, 0.5))
        for parameter, (low, high), share in cures(mistake, truth)
        if parameter == claim.parameter
    ]
    return max(worth, default=0.0)


def _value_share(value: float, low: float, high: float, fallback: float) -> float:
    """Return 1 for a value within bounds, 1/3 with the wrong sign, else ``fallback``."""
    if low <= value <= high:
        return 1.0
    return 1.0 / 3.0 if low <= -value <= high else fallback


Cure = tuple[str, tuple[float, float], float]


def cures(mistake: TrueMistake, truth: FormTruth) -> tuple[Cure, ...]:
    """Return the corrections of a mistake: parameter, bounds of right values, share of points."""
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
        for row in CURES
        if mistake.kind in row.of
    )


def _verdicts_share(answers: Answers, truth: FormTruth) -> float:
    """Return the mean share for both verdicts and the behaviour of EKF2."""
    shares = [_ekf2_behaviour_share(answers, truth)]
    for answer, known in ((answers.verdict_kf, truth.kf), (answers.verdict_ekf2, truth.ekf2)):
        shares.append(1.0 if answer and answer == known.verdict else 0.0)
    return sum(shares) / len(shares)


def _ekf2_behaviour_share(answers: Answers, truth: FormTruth) -> float:
    """Return 1 for the complete behaviour of EKF2 without a false one; 1/2 for a part."""
    claimed, required = set(answers.ekf2_did), set(truth.ekf2_did)
    allowed = required | set(truth.ekf2_did_also)
    false_count, right_count = len(claimed - allowed), len(claimed & allowed)
    if not right_count or false_count > 1:
        return 0.0
    is_complete = required <= claimed or (
        len(required) == 1 and bool(claimed & set(truth.ekf2_did_also))
    )
    return 1.0 if is_complete and not false_count else 0.5


def _quantities_share(answers: Answers, truth: FormTruth) -> float:
    """Return the mean share for the numbers that the flight determines."""
    # an empty list is not counted: it is right on most flights
    known = sum(value not in (None, ()) for value in truth.quantities)
    pairs = zip(answers.quantities, truth.quantities, strict=False)
    return sum(_quantity_share(*pair) for pair in pairs) / max(known, 1)


def _quantity_share(answer: QuantityAnswer, known: QuantityAnswer) -> float:
    if isinstance(answer, tuple) and isinstance(known, tuple):
        difference_count = len(set(answer) ^ set(known))
        return (
            (1.0, 0.5)[difference_count]
            if difference_count < 2 and set(answer) & set(known)
            else 0.0
        )
    if isinstance(answer, float | int) and isinstance(known, float | int):
        for within, share in ((FULL_TOLERANCE, 1.0), (HALF_TOLERANCE, 0.5)):
            if abs(answer - known) <= within * abs(known):
                return share
    return 0.0
