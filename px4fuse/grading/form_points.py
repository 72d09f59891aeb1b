"""Points for a form, by the answer key: of 100.

The weights and shares are those by which forms were judged by hand. A guess does not pay: each
claim that is not true costs, and what needs no measurement counts only with the size.
``form_points.toml`` has the rows.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import msgspec

from px4fuse.answers import MISTAKES, Answers, Claim, Quantified
from px4fuse.assignment.truth import FormTruth, Wrong
from px4fuse.filter.consistency import SIGMA_OFF
from px4fuse.record import table

FALSE_CLAIM, MOST_FALSE = 10.0, 3
NEIGHBOUR, SAME_NUMBER, EFFECT = 0.4, 2.0 / 3.0, 0.15
# What needs no measurement: it counts only where the size is right, and close is not enough, since
# the sizes that are drawn lie close to each other
GUESSABLE = frozenset(("open-end",))
ANY = (-math.inf, math.inf)
CLOSE_S, CLOSE_SHARE = 2.0, 0.05
FULL_WITHIN, HALF_WITHIN = 0.02, 0.10
HALF_SIZE = 0.4


@dataclass(frozen=True)
class _Cure:
    """A row of the cures: ``to`` are bounds, or how they follow from the mistake."""

    parameter: str
    of: Mapping[str, float]
    to: tuple[float, float] | str = ANY
    late: bool = False


TABLE = table(__file__, "form_points.toml", dict)
CURES = msgspec.convert(TABLE["cures"], tuple[_Cure, ...])
NEIGHBOURS = msgspec.convert([*TABLE["neighbours"].values()], tuple[frozenset[str], ...])
PARTS = tuple(TABLE["weights"])


@dataclass(frozen=True)
class FormPoints:
    """What a form is worth.

    Attributes
    ----------
    parts : mapping
        Points by the name of the part, of :attr:`of`.
    said : tuple of str
        What was right and what was not, for the student.
    named : mapping
        The flight's mistakes, and whether the form names each.
    """

    parts: Mapping[str, float]
    of: Mapping[str, float]
    said: tuple[str, ...] = ()
    named: Mapping[str, bool] = field(default_factory=dict)

    @property
    def share(self) -> float:
        """Of all points."""
        return sum(self.parts.values()) / sum(self.of.values())


def form_points(answers: Answers, truth: FormTruth) -> FormPoints:
    """Points for a form about a flight whose truth is known."""
    called_clean = not truth.mistakes and answers.says_none
    weights = TABLE["weights_clean" if called_clean else "weights"]
    shares = dict.fromkeys(PARTS, 0.0)
    matched, false = _matched(answers, truth)
    if truth.mistakes and len(false) < MOST_FALSE:
        shares |= _of_mistakes(matched, truth)
    shares["quantities"] = computed = _quantities(answers, truth)
    # on many flights the verdicts are the same: who computed nothing may have guessed them
    shares["verdicts"] = _verdicts(answers, truth) * (1.0 if computed else 0.5)
    parts = {name: weights[name] * share for name, share in shares.items()}
    if called_clean:
        parts["kinds"] = weights["kinds"]
    elif truth.mistakes and all(wrong.size is None for wrong in truth.mistakes):
        parts["kinds"] += weights["sizes"] * shares["kinds"]  # there is nothing to size
    parts["kinds"] = max(parts["kinds"] - FALSE_CLAIM * len(false), 0.0)
    claimed = [claim.kind for claim in answers.mistakes]
    named = {wrong.kind: wrong.kind in claimed for wrong in truth.mistakes}
    return FormPoints(parts, weights, tuple(_said(matched, false, called_clean)), named)


Match = tuple[Wrong, Claim | None, float]


def _said(matched: list[Match], false: list[Claim], called_clean: bool) -> Iterator[str]:
    """What of the mistakes was found, in words."""
    if not matched:
        yield f"your flight has no mistake{', as you say' * called_clean}"
    for wrong, claim, _ in matched:
        what = f"{wrong.kind} ({MISTAKES[wrong.kind].words})"
        if claim is None:
            yield f"you missed {what}"
        elif claim.kind != wrong.kind:
            yield f"you named {claim.kind} where it is {what}"
        else:
            yield f"you found {wrong.kind}"
    if false:
        yield f"not in your flight: {', '.join(claim.kind for claim in false)}"


def _matched(answers: Answers, truth: FormTruth) -> tuple[list[Match], list[Claim]]:
    """Each mistake with the claim that stands for it and its share of the kind; false claims.

    The best match is taken first: the kind itself, then its neighbours, then what it causes.
    """
    left = [claim for claim in answers.mistakes if claim.kind != "none"]
    found: dict[str, tuple[Claim, float]] = {}
    tried = [
        (kind_share(wrong.kind, claim.kind), wrong.kind, claim)
        for wrong in truth.mistakes
        for claim in left
    ]
    for share, kind, claim in sorted(tried, key=lambda one: -one[0]):
        if share and kind not in found and claim in left:
            found[kind] = claim, share
            left.remove(claim)
    return [(wrong, *found.get(wrong.kind, (None, 0.0))) for wrong in truth.mistakes], left


def kind_share(kind: str, claimed: str) -> float:
    """What naming one kind is worth where it is another."""
    if kind == claimed:
        return 1.0
    if (kind, claimed) == ("r-scale", "ekf2-noise"):
        return SAME_NUMBER
    if any({kind, claimed} <= group for group in NEIGHBOURS):
        return NEIGHBOUR
    return EFFECT if claimed in TABLE["effects"].get(kind, ()) else 0.0


def _of_mistakes(matched: list[Match], truth: FormTruth) -> dict[str, float]:
    """Shares of kinds, sizes, when and cure, each the mean over the mistakes."""
    sized = sum(wrong.size is not None for wrong, _, _ in matched)
    shares = dict.fromkeys(("kinds", "sizes", "when", "cure"), 0.0)
    for wrong, claim, share in matched:
        if claim is None:
            continue
        size = size_share(wrong, claim)
        seen = when_share(wrong, claim) * (1.0 if claim.kind == wrong.kind else 0.5)
        cured = cure_share(wrong, claim, truth)
        counts = size if wrong.kind in GUESSABLE else 1.0
        shares["kinds"] += share / len(matched)
        shares["when"] += seen * counts / len(matched)
        shares["cure"] += cured * counts / len(matched)
        shares["sizes"] += size / max(sized, 1)
    return shares


def size_share(wrong: Wrong, claim: Claim) -> float:
    """What a size is worth: in full, half, or a third with the wrong sign or for a neighbour."""
    size = claim.size_in_first_unit()
    if wrong.size is None or wrong.low is None or wrong.high is None or size is None:
        return 0.0
    if claim.kind != wrong.kind:
        same_unit = [*MISTAKES[claim.kind].units][:1] == [*MISTAKES[wrong.kind].units][:1]
        return 1.0 / 3.0 if wrong.low <= size <= wrong.high and same_unit else 0.0
    close = wrong.kind not in GUESSABLE and abs(size - wrong.size) <= HALF_SIZE * abs(wrong.size)
    return _value_share(size, wrong.low, wrong.high, 0.5 if close else 0.0)


def when_share(wrong: Wrong, claim: Claim) -> float:
    """Half for the time, half for a panel that can show it."""
    if wrong.from_s is None and wrong.until_s is None:
        timed = claim.when == "whole flight"
    else:
        asked = (wrong.from_s, claim.from_s), (wrong.until_s, claim.until_s)
        timed = not claim.when and all(
            known is None
            or (given is not None and abs(given - known) <= max(CLOSE_S, CLOSE_SHARE * known))
            for known, given in asked
        )
    return 0.5 * timed + 0.5 * (claim.panel in panels(wrong.kind))


def panels(kind: str) -> list[str]:
    """The panels that can show a kind of mistake."""
    return [*(panel for panel, kinds in TABLE["shows"].items() if kind in kinds), "cover"]


def cure_share(wrong: Wrong, claim: Claim, truth: FormTruth) -> float:
    """What the parameter and its value are worth, by what they do to this flight."""
    value = claim.value_in_first_unit()
    worth = [
        share
        if (low, high) == ANY
        else share * (0.5 if value is None else _value_share(value, low, high, 0.5))
        for parameter, (low, high), share in cures(wrong, truth)
        if parameter == claim.parameter
    ]
    return max(worth, default=0.0)


def _value_share(value: float, low: float, high: float, otherwise: float) -> float:
    """All for what is right, a third for the wrong sign."""
    if low <= value <= high:
        return 1.0
    return 1.0 / 3.0 if low <= -value <= high else otherwise


Cure = tuple[str, tuple[float, float], float]


def cures(wrong: Wrong, truth: FormTruth) -> tuple[Cure, ...]:
    """Parameters that act on a mistake, from which value to which they cure it, and their share."""
    size, low, high = (0.0 if one is None else one for one in (wrong.size, wrong.low, wrong.high))
    from_s = 0.0 if wrong.from_s is None else wrong.from_s
    until_s = from_s if wrong.until_s is None else wrong.until_s
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
            0.0 if row.late and size <= 0.0 else row.of[wrong.kind],
        )
        for row in CURES
        if wrong.kind in row.of
    )


def _verdicts(answers: Answers, truth: FormTruth) -> float:
    """Mean share of the verdicts on both filters and of what EKF2 did."""
    shares = [_did(answers, truth)]
    for given, known in ((answers.verdict_ours, truth.ours), (answers.verdict_ekf2, truth.ekf2)):
        right = given and given == known.verdict
        # a factor so small can be taken for none
        nearly = known.factor is not None and known.factor < SIGMA_OFF and given == "consistent"
        shares.append(1.0 if right else 0.5 if nearly else 0.0)
    return sum(shares) / len(shares)


def _did(answers: Answers, truth: FormTruth) -> float:
    """What EKF2 did: full for all of it and nothing false, half for some."""
    given, must = set(answers.ekf2_did), set(truth.ekf2_did)
    allowed = must | set(truth.ekf2_did_also)
    false, right = len(given - allowed), len(given & allowed)
    if not right or false > 1:
        return 0.0
    whole = must <= given or (len(must) == 1 and bool(given & set(truth.ekf2_did_also)))
    return 1.0 if whole and not false else 0.5


def _quantities(answers: Answers, truth: FormTruth) -> float:
    """Mean share of the numbers that can be known."""
    # an empty list is right on most flights of some kinds, and says nothing
    known = sum(one not in (None, ()) for one in truth.quantities)
    pairs = zip(answers.quantities, truth.quantities, strict=False)
    return sum(_quantity(*pair) for pair in pairs) / max(known, 1)


def _quantity(given: Quantified, known: Quantified) -> float:
    if isinstance(given, tuple) and isinstance(known, tuple):
        off = len(set(given) ^ set(known))
        return (1.0, 0.5)[off] if off < 2 and set(given) & set(known) else 0.0
    if isinstance(given, float | int) and isinstance(known, float | int):
        for within, share in ((FULL_WITHIN, 1.0), (HALF_WITHIN, 0.5)):
            if abs(given - known) <= within * abs(known):
                return share
    return 0.0
