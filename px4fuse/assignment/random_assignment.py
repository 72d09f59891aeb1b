"""Random assignment: draws flight, mistakes and their sizes for each student.

Random numbers are the HMAC (RFC 2104) of the student id with the instructor's secret as key. They
cannot be predicted without the secret, and a second run gives the same flights.
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

# kind of flight of a class; for "mixed", the kind is drawn for each student
Kinds = Literal["aisle", "loop", "mixed"]

MIN_SECRET_LENGTH = 8  # characters
# part of each HMAC message. With another label all flights change, and existing answer keys cannot
# be extended
DRAW_LABEL = "px4fuse assignment 2"
# fractions of flights with 0, 1 and 2 mistakes, without --mistakes. Loops have one possible
# mistake, "open-end". Many loops have none, so that students cannot guess it
COUNT_FRACTIONS: dict[Kind, tuple[float, ...]] = {"aisle": (0.1, 0.5, 0.4), "loop": (0.4, 0.6)}
# fraction of loops in a mixed class
LOOP_FRACTION = 1 / 3
# range of the drawn difficulty: smallest detectable size of a mistake over the size in the flight
EASIEST_DIFFICULTY, HARDEST_DIFFICULTY = 0.6, 1.0


class AssignableMistake(Record, frozen=True):
    """Mistake that can be assigned, with its smallest detectable size.

    Attributes
    ----------
    mistake : str
        Name in :data:`px4fuse.simulation.mistakes.MISTAKES`.
    group : str
        Two mistakes of one group are not assigned together: one would hide the other.
    detectable_size : float or None
        Smallest size, in ``unit``, that px4fuse detects in 19 of 20 flights
        (tests/studies/rates.csv); None for a mistake without a size.
    unit : str
        Unit of ``detectable_size``, as in ``--mistake``.
    is_smaller_easier : bool
        True if a smaller number is easier to detect.
    has_either_sign : bool
        True if the sign of the size is drawn.
    start_range_s : (float, float) or None
        Range of the start time (s), for a mistake that has one.
    hidden_groups : tuple of str
        Groups of mistakes that cannot be detected beside this mistake.
    """

    mistake: str
    group: str
    detectable_size: float | None = None
    unit: str = ""
    is_smaller_easier: bool = False
    has_either_sign: bool = False
    start_range_s: tuple[float, float] | None = None
    hidden_groups: tuple[str, ...] = ()

    def is_detectable_with(self, other: AssignableMistake) -> bool:
        """Return True if both mistakes can be detected in the same flight."""
        return not (
            self.group == other.group
            or self.group in other.hidden_groups
            or other.group in self.hidden_groups
        )

    def format_option(
        self, difficulty: float, sign: float = 1.0, start_fraction: float = 0.5
    ) -> str:
        """Format the value of ``--mistake`` that gives this difficulty.

        ``start_fraction``: start time, as a fraction of ``start_range_s`` (0 to 1).
        """
        if self.detectable_size is None:
            return self.mistake
        size = (
            self.detectable_size * difficulty
            if self.is_smaller_easier
            else self.detectable_size / difficulty
        )
        text = f"{self.mistake}={math.copysign(float(f'{size:.3g}'), sign):g}{self.unit}"
        if self.start_range_s is None:
            return text
        earliest_s, latest_s = self.start_range_s
        return f"{text},{earliest_s + start_fraction * (latest_s - earliest_s):.0f}s"


class DrawingRules(Record, frozen=True):
    """Rules for one kind of flight: possible mistakes, and ranges of the scenario's numbers.

    A range is (low, high, decimals), by field of the scenario.
    """

    mistakes: tuple[AssignableMistake, ...]
    numbers: dict[str, tuple[float, float, int]]


_RULES_BY_KIND = table(__file__, "drawn.toml", dict[Kind, DrawingRules])
ASSIGNABLE_MISTAKES = {kind: rules.mistakes for kind, rules in _RULES_BY_KIND.items()}


@dataclass(frozen=True)
class AssignedFlight:
    """Flight that is assigned to a student.

    Attributes
    ----------
    mistake_options : tuple of str
        Values of ``--mistake``.
    difficulty : float
        Largest difficulty of the mistakes with a size: smallest detectable size over size. A flight
        without a mistake has the largest difficulty, because excluding all mistakes is the most
        work.
    """

    scenario: Scenario
    mistake_options: tuple[str, ...]
    difficulty: float


def draw_uniform(secret: bytes, student_id: str, kind: Kinds, label: str) -> float:
    """Return a reproducible random number in [0, 1) for a student and a label."""
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
        True to log the ground truth of aisle flights. The log of a loop never contains it, because
        the ground truth shows the landing place.

    Raises
    ------
    SettingsError
        One flight cannot have this many mistakes.
    """
    max_count = (
        min(len(COUNT_FRACTIONS[k]) for k in (COUNT_FRACTIONS if kind == "mixed" else (kind,))) - 1
    )
    if count is not None and not 0 <= count <= max_count:
        raise SettingsError(
            f"--mistakes {count} is out of range: a flight of kind {kind} has 0 to "
            f"{max_count} detectable mistakes."
        )
    if kind == "mixed":
        kind = "loop" if draw_uniform(secret, student_id, kind, "kind") < LOOP_FRACTION else "aisle"
    draw_number = partial(draw_uniform, secret, student_id, kind)
    if count is None:
        count = bisect(list(accumulate(COUNT_FRACTIONS[kind][:-1])), draw_number("count"))
    chosen_mistakes: list[tuple[AssignableMistake, float, str]] = []
    for choice in sorted(
        ASSIGNABLE_MISTAKES[kind], key=lambda c: draw_number(f"order {c.mistake}")
    ):
        if len(chosen_mistakes) < count and all(
            choice.is_detectable_with(other) for other, *_ in chosen_mistakes
        ):
            name = choice.mistake
            difficulty_fraction = (
                0.0 if choice.detectable_size is None else draw_number(f"size {name}")
            )
            sign = -1.0 if choice.has_either_sign and draw_number(f"sign {name}") < 0.5 else 1.0
            difficulty = (
                EASIEST_DIFFICULTY + (HARDEST_DIFFICULTY - EASIEST_DIFFICULTY) * difficulty_fraction
            )
            chosen_mistakes.append(
                (
                    choice,
                    difficulty,
                    choice.format_option(difficulty, sign, draw_number(f"at {name}")),
                )
            )
    numbers: dict[str, Any] = {
        name: round(low + (high - low) * draw_number(name), decimals)
        for name, (low, high, decimals) in _RULES_BY_KIND[kind].numbers.items()
    }
    has_truth, seed = truth and kind == "aisle", int(draw_number("seed") * 2**32)
    scenario = make_scenario(kind, truth=has_truth, seed=seed, **numbers)
    hardest = max((difficulty for _, difficulty, _ in chosen_mistakes), default=HARDEST_DIFFICULTY)
    return AssignedFlight(
        scenario, tuple(option for *_, option in chosen_mistakes), round(hardest, 2)
    )


def encode_secret(text: str, where: str) -> bytes:
    """Encode a secret as bytes; ``where`` names its option or file in errors.

    Raises
    ------
    SettingsError
        The secret is shorter than MIN_SECRET_LENGTH.
    """
    stripped = text.strip()
    if len(stripped) < MIN_SECRET_LENGTH:
        raise SettingsError(
            f"{where}: the secret has only {len(stripped)} characters and can be guessed.",
            f"Use {MIN_SECRET_LENGTH} or more characters, or omit the secret: px4fuse then "
            "generates one and stores it in the answer key.",
        )
    return stripped.encode(errors="replace")
