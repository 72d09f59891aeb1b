"""Random assignment: draw flight, mistakes and sizes of each student.

Numbers are drawn by HMAC (RFC 2104) from the secret of the instructor and the id of the student:
without the secret they cannot be predicted, and a second run gives the same flights.
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

# kind of flight of a class; mixed: drawn for each student
Kinds = Literal["aisle", "loop", "mixed"]

MIN_SECRET = 8  # characters
# part of every draw: if it changes, the flights change, and existing keys cannot be extended
DRAW_LABEL = "px4fuse assignment 2"
# fractions of flights with 0, 1, 2 mistakes if --mistakes is not given. A loop has only one
# possible mistake; with fewer flights without a mistake, "open-end" would be a safe guess
COUNTS: dict[Kind, tuple[float, ...]] = {"aisle": (0.1, 0.5, 0.4), "loop": (0.4, 0.6)}
# fraction of loops in a mixed class
LOOP_SHARE = 1 / 3
# range of the difficulty: the smallest size that px4fuse detects in 19 of 20 flights, divided by
# the size in the flight
EASIEST_DIFFICULTY, HARDEST_DIFFICULTY = 0.6, 1.0


class AssignableMistake(Record, frozen=True):
    """Mistake that may be drawn, with detectable sizes.

    Attributes
    ----------
    mistake : str
        Name in :data:`px4fuse.simulation.mistakes.MISTAKES`.
    group : str
        Mistakes of the same group are not combined: one would hide the other.
    limit : float or None
        Smallest size, in ``unit``, that px4fuse detects in 19 of 20 flights
        (tests/studies/rates.csv); None for a mistake without a size.
    unit : str
        Unit as in ``--mistake``.
    less_is_plainer : bool
        A smaller number is a larger mistake.
    at_s : (float, float) or None
        Range of the start time (s), for a mistake that has one.
    hides : tuple of str
        Groups that are not combined with this mistake.
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
        """Return True if both mistakes can be detected in one flight."""
        return not (
            self.group == other.group or self.group in other.hides or other.group in self.hides
        )

    def typed(self, difficulty: float, sign: float = 1.0, at: float = 0.5) -> str:
        """Format the mistake for ``px4fuse simulate --mistake``, with the size of a difficulty.

        ``at``: start time, as fraction of its range.
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
    """Rules for one kind of flight: possible mistakes, and numbers of the scenario.

    Numbers are (low, high, decimals), by field.
    """

    mistakes: tuple[AssignableMistake, ...]
    numbers: dict[str, tuple[float, float, int]]


_OF_KIND = table(__file__, "drawn.toml", dict[Kind, DrawingRules])
ASSIGNABLE_MISTAKES = {kind: of.mistakes for kind, of in _OF_KIND.items()}


@dataclass(frozen=True)
class AssignedFlight:
    """Flight that was drawn for a student.

    Attributes
    ----------
    typed : tuple of str
        Mistakes, as ``--mistake`` reads them.
    difficulty : float
        Difficulty of the hardest mistake. Mistakes without a size do not count. A flight without
        mistakes has the highest difficulty: excluding all mistakes requires the most work.
    """

    scenario: Scenario
    typed: tuple[str, ...]
    difficulty: float


def uniform(secret: bytes, student_id: str, kind: Kinds, label: str) -> float:
    """Return a reproducible number in [0, 1); without the secret it cannot be predicted."""
    message = "\0".join((DRAW_LABEL, kind, normalise_text(student_id), label))
    digest = hmac.new(secret, message.encode(errors="replace"), hashlib.sha256).digest()
    return int.from_bytes(digest[:7], "big") / 2**56


def draw(
    secret: bytes, student_id: str, kind: Kinds, count: int | None = None, truth: bool = True
) -> AssignedFlight:
    """Draw the flight of one student.

    Parameters
    ----------
    kind : {"aisle", "loop", "mixed"}
        "mixed" draws aisle or loop.
    count : int, optional
        Number of mistakes; drawn by default.
    truth : bool
        The log of an aisle contains the ground truth. Logs of loops never do: ground truth
        contains the landing place.

    Raises
    ------
    SettingsError
        One flight cannot have this many mistakes.
    """
    max_count = min(len(COUNTS[k]) for k in (COUNTS if kind == "mixed" else (kind,))) - 1
    if count is not None and not 0 <= count <= max_count:
        raise SettingsError(
            f"--mistakes {count} is out of range: a flight of kind {kind} has 0 to "
            f"{max_count} detectable mistakes."
        )
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
    """Return a secret as bytes; ``where`` names its option or file in errors.

    Raises
    ------
    SettingsError
        The secret is shorter than MIN_SECRET.
    """
    stripped = text.strip()
    if len(stripped) < MIN_SECRET:
        raise SettingsError(
            f"{where}: the secret has only {len(stripped)} characters and can be guessed.",
            f"Use {MIN_SECRET} or more, or omit it: px4fuse then generates one and "
            "stores it in the answer key.",
        )
    return stripped.encode(errors="replace")
