"""What is drawn for a student: which flight, which mistakes, of which sizes.

It follows from the instructor's secret and the student's id by HMAC (RFC 2104), so that nobody
without the secret can guess another's, and a second run gives the same.
"""

from __future__ import annotations

import hashlib
import hmac
import math
from bisect import bisect
from dataclasses import dataclass
from functools import partial
from itertools import accumulate
from typing import Any, Literal

from px4fuse.assignment.roster import normalise_text
from px4fuse.errors import SettingsError
from px4fuse.record import Record, table
from px4fuse.simulation.scenario import Kind, Scenario, make_scenario

# Of a class: one kind of flight for all, or drawn for each
Kinds = Literal["aisle", "loop", "mixed"]

MIN_SECRET = 8
# Named in every draw: another text gives other flights, and keys of another text cannot be extended
DRAW_LABEL = "px4fuse assignment 2"
# Shares of flights with so many mistakes, where the number is not given. The loop has one mistake
# to offer; with fewer flights without it, "false closure" would be a safe guess.
COUNTS: dict[Kind, tuple[float, ...]] = {"aisle": (0.1, 0.5, 0.4), "loop": (0.4, 0.6)}
# Of a class of both kinds
LOOP_SHARE = 1 / 3
# Of the smallest size of a mistake that px4fuse finds in 19 of 20 flights, over the size in the
# flight: between these everyone's lies
EASIEST_DIFFICULTY, HARDEST_DIFFICULTY = 0.6, 1.0


class AssignableMistake(Record, frozen=True):
    """A mistake that may be drawn, at sizes at which it is found.

    Attributes
    ----------
    mistake : str
        Name in :data:`px4fuse.simulation.mistakes.MISTAKES`.
    group : str
        Of two of the same group, one would hide the other.
    limit : float or None
        The smallest size, in ``unit``, from which on it is found in 19 of
        20 flights (tests/studies/rates.csv); None for a mistake without a size.
    unit : str
        As it is typed.
    less_is_plainer : bool
        Whether a smaller number is the larger mistake.
    at_s : (float, float) or None
        When it begins, where that can be said.
    hides : tuple of str
        Other groups whose mistakes this one hides, or whose mistakes hide it.
    """

    mistake: str
    group: str
    limit: float | None = None
    unit: str = ""
    less_is_plainer: bool = False
    either_sign: bool = False
    at_s: tuple[float, float] | None = None
    hides: tuple[str, ...] = ()

    def goes_with(self, other: AssignableMistake) -> bool:
        """Whether both are found in one flight."""
        return not (
            self.group == other.group or self.group in other.hides or other.group in self.hides
        )

    def typed(self, difficulty: float, sign: float = 1.0, at: float = 0.5) -> str:
        """As ``px4fuse simulate --mistake`` takes it, of the size that is as difficult.

        ``at``: when it begins, as a share of the span in which it may.
        """
        if self.limit is None:
            return self.mistake
        size = self.limit * difficulty if self.less_is_plainer else self.limit / difficulty
        text = f"{self.mistake}={math.copysign(float(f'{size:.3g}'), sign):g}{self.unit}"
        if self.at_s is None:
            return text
        first, last = self.at_s
        return f"{text},{first + at * (last - first):.0f}s"


class DrawingRules(Record, frozen=True):
    """What may be drawn for a kind of flight: numbers of the scenario, and mistakes.

    Numbers are (low, high, decimals), by field.
    """

    mistakes: tuple[AssignableMistake, ...]
    numbers: dict[str, tuple[float, float, int]]


_OF_KIND = table(__file__, "drawn.toml", dict[Kind, DrawingRules])
ASSIGNABLE_MISTAKES = {kind: of.mistakes for kind, of in _OF_KIND.items()}


@dataclass(frozen=True)
class AssignedFlight:
    """What was drawn for a student.

    Attributes
    ----------
    typed : tuple of str
        The mistakes, as they are typed.
    difficulty : float
        That of the hardest mistake; what has no size cannot be missed for being small. Only a
        student who has looked for the smallest can say that there is none: such a flight is among
        the hardest.
    """

    scenario: Scenario
    typed: tuple[str, ...]
    difficulty: float


def uniform(secret: bytes, student_id: str, kind: Kinds, label: str) -> float:
    """A number in [0, 1) that only those who know the secret can tell."""
    message = "\0".join((DRAW_LABEL, kind, normalise_text(student_id), label))
    digest = hmac.new(secret, message.encode(errors="replace"), hashlib.sha256).digest()
    return int.from_bytes(digest[:7], "big") / 2**56


def draw(
    secret: bytes, student_id: str, kind: Kinds, count: int | None = None, truth: bool = True
) -> AssignedFlight:
    """Draw one student's flight.

    Parameters
    ----------
    kind : {"aisle", "loop", "mixed"}
        "mixed" draws which of the two.
    count : int, optional
        Of mistakes; None draws it.
    truth : bool
        Whether an aisle's log holds the truth. A loop's does not: it would tell where it landed.

    Raises
    ------
    SettingsError
        So many mistakes cannot be in one flight.
    """
    most = (
        min(len(COUNTS[draw_number]) for draw_number in (COUNTS if kind == "mixed" else (kind,)))
        - 1
    )
    if count is not None and not 0 <= count <= most:
        raise SettingsError.of("mistakes_many", count=count, kind=kind, most=most)
    if kind == "mixed":
        kind = "loop" if uniform(secret, student_id, kind, "kind") < LOOP_SHARE else "aisle"
    draw_number = partial(uniform, secret, student_id, kind)
    if count is None:
        count = bisect(list(accumulate(COUNTS[kind][:-1])), draw_number("count"))
    chosen_mistakes: list[tuple[AssignableMistake, float, str]] = []
    for choice in sorted(
        ASSIGNABLE_MISTAKES[kind], key=lambda c: draw_number(f"order {c.mistake}")
    ):
        if len(chosen_mistakes) < count and all(
            choice.goes_with(other) for other, *_ in chosen_mistakes
        ):
            name = choice.mistake
            share = 0.0 if choice.limit is None else draw_number(f"size {name}")
            sign = -1.0 if choice.either_sign and draw_number(f"sign {name}") < 0.5 else 1.0
            difficulty = EASIEST_DIFFICULTY + (HARDEST_DIFFICULTY - EASIEST_DIFFICULTY) * share
            chosen_mistakes.append(
                (choice, difficulty, choice.typed(difficulty, sign, draw_number(f"at {name}")))
            )
    numbers: dict[str, Any] = {
        name: round(low + (high - low) * draw_number(name), decimals)
        for name, (low, high, decimals) in _OF_KIND[kind].numbers.items()
    }
    has_truth, seed = truth and kind == "aisle", int(draw_number("seed") * 2**32)
    scenario = make_scenario(kind, truth=has_truth, seed=seed, **numbers)
    hardest = max((difficulty for _, difficulty, _ in chosen_mistakes), default=HARDEST_DIFFICULTY)
    return AssignedFlight(
        scenario, tuple(typed for *_, typed in chosen_mistakes), round(hardest, 2)
    )


def encode_secret(text: str, where: str) -> bytes:
    """A secret as bytes, from an option or a file.

    Raises
    ------
    SettingsError
        It is too short to be one.
    """
    stripped = text.strip()
    if len(stripped) < MIN_SECRET:
        raise SettingsError.of("secret_short", where=where, length=len(stripped), least=MIN_SECRET)
    return stripped.encode(errors="replace")
