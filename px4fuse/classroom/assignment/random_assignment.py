"""Random assignment of a flight with injected faults to each student.

Random numbers are the HMAC (RFC 2104) of the student id with the instructor's secret as key. The
numbers cannot be predicted without the secret, and a second run gives the same flights.
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

from px4fuse.classroom.assignment.roster import normalise_text
from px4fuse.core.record import Record, table
from px4fuse.errors import SettingsError
from px4fuse.simulation.scenario import Kind, Scenario, make_scenario

# Kind of the flights of a class; for "mixed", aisle or loop is drawn for each student
FlightKind = Literal["aisle", "loop", "mixed"]

# Minimum length (characters) of the instructor's secret: a shorter one can be guessed
MIN_SECRET_LENGTH = 16
# First part of each HMAC message. Another label would change all flights, so that students could
# not be added to existing answer keys
DRAW_LABEL = "px4fuse assignment 2"
# Fractions of flights with 0, 1 and 2 injected faults, unless --mistakes sets the number. The only
# possible injected fault of a loop is "open-end". Many loops have no injected fault, so that
# students cannot guess "open-end"
COUNT_FRACTIONS: dict[Kind, tuple[float, ...]] = {"aisle": (0.1, 0.5, 0.4), "loop": (0.4, 0.6)}
# Fraction of the students of a "mixed" class who get a loop; the others get an aisle flight
LOOP_FRACTION = 1 / 3
# Minimum difficulty of an injected fault: smallest detectable size divided by the size in the
# flight
EASIEST_DIFFICULTY = 0.6
# Maximum difficulty of an injected fault: its size in the flight is the smallest detectable size
HARDEST_DIFFICULTY = 1.0


class AssignableMistake(Record, frozen=True):
    """Injected fault of a simulated flight that can be assigned to a student.

    Attributes
    ----------
    mistake : str
        Name in :data:`px4fuse.simulation.mistakes.MISTAKES`.
    group : str
        Two injected faults of one group are not assigned together: one would hide the other.
    detectable_size : float or None
        Smallest size, in ``unit``, that px4fuse detects in 19 of 20 flights
        (tests/studies/rates.csv); None for an injected fault without a size.
    unit : str
        Unit of ``detectable_size``, as in ``px4fuse simulate --mistake``.
    is_smaller_easier : bool
        True if a smaller number is easier to detect.
    has_either_sign : bool
        True if the sign of the size is drawn at random.
    start_range_s : (float, float) or None
        Earliest and latest start (s) of an injected fault that does not last the whole flight.
    hidden_groups : tuple of str
        Groups of injected faults that cannot be detected in a flight with this injected fault.
    """

    mistake: str
    group: str
    detectable_size: float | None = None
    unit: str = ""
    is_smaller_easier: bool = False
    has_either_sign: bool = False
    start_range_s: tuple[float, float] | None = None
    hidden_groups: tuple[str, ...] = ()

    def is_detectable_with(self, other_mistake: AssignableMistake) -> bool:
        """Return True if both injected faults can be detected in the same flight."""
        is_hidden = other_mistake.group in (self.group, *self.hidden_groups)
        return not is_hidden and self.group not in other_mistake.hidden_groups

    def format_option(
        self, difficulty: float, sign: float = 1.0, start_fraction: float = 0.5
    ) -> str:
        """Format the value of ``px4fuse simulate --mistake`` that gives this difficulty.

        ``start_fraction``: position of the start time in ``start_range_s`` (0 to 1).
        """
        if self.detectable_size is None:
            return self.mistake
        size = self.detectable_size / difficulty
        if self.is_smaller_easier:
            size = self.detectable_size * difficulty
        text = f"{self.mistake}={math.copysign(float(f'{size:.3g}'), sign):g}{self.unit}"
        if self.start_range_s is None:
            return text
        earliest_s, latest_s = self.start_range_s
        return f"{text},{earliest_s + start_fraction * (latest_s - earliest_s):.0f}s"


class DrawingRules(Record, frozen=True):
    """Rules for drawing aisle flights or loops at random (``drawn.toml``).

    Attributes
    ----------
    mistakes : tuple of AssignableMistake
        Possible injected faults.
    numbers : dict
        Minimum, maximum and decimals of random numbers, by field of the scenario.
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
    scenario : Scenario
        Settings of the simulation.
    mistake_options : tuple of str
        Values of ``px4fuse simulate --mistake``.
    difficulty : float
        Largest difficulty of the injected faults: smallest detectable size divided by the size. A
        flight without an injected fault is the most difficult, because all injected faults have to
        be excluded.
    """

    scenario: Scenario
    mistake_options: tuple[str, ...]
    difficulty: float


def draw_uniform(secret: bytes, student_id: str, kind: FlightKind, label: str) -> float:
    """Return a random number in [0, 1) that secret, student, kind and label determine."""
    message = "\0".join((DRAW_LABEL, kind, normalise_text(student_id), label))
    digest = hmac.new(secret, message.encode(errors="replace"), hashlib.sha256).digest()
    return int.from_bytes(digest[:7], "big") / 2**56


def draw(
    secret: bytes, student_id: str, kind: FlightKind, count: int | None = None, truth: bool = True
) -> AssignedFlight:
    """Draw the flight of one student.

    Parameters
    ----------
    kind : {"aisle", "loop", "mixed"}
        "mixed" draws aisle or loop.
    count : int, optional
        Number of injected faults; drawn at random by default.
    truth : bool
        True to log the ground truth of aisle flights. The log of a loop never contains it, because
        the ground truth shows the landing place.

    Raises
    ------
    SettingsError
        One flight cannot have this many injected faults.
    """
    possible_kinds = COUNT_FRACTIONS if kind == "mixed" else (kind,)
    max_count = min(len(COUNT_FRACTIONS[each]) for each in possible_kinds) - 1
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
    mistakes: list[AssignableMistake] = []
    for mistake in sorted(
        ASSIGNABLE_MISTAKES[kind], key=lambda each: draw_number(f"order {each.mistake}")
    ):
        if len(mistakes) < count and all(map(mistake.is_detectable_with, mistakes)):
            mistakes.append(mistake)
    difficulties, options = [], []
    for mistake in mistakes:
        name, difficulty = mistake.mistake, EASIEST_DIFFICULTY
        if mistake.detectable_size is not None:
            difficulty += (HARDEST_DIFFICULTY - difficulty) * draw_number(f"size {name}")
        sign = -1.0 if mistake.has_either_sign and draw_number(f"sign {name}") < 0.5 else 1.0
        difficulties.append(difficulty)
        options.append(mistake.format_option(difficulty, sign, draw_number(f"at {name}")))
    numbers: dict[str, Any] = {
        name: round(low + (high - low) * draw_number(name), decimals)
        for name, (low, high, decimals) in _RULES_BY_KIND[kind].numbers.items()
    }
    has_truth, seed = truth and kind == "aisle", int(draw_number("seed") * 2**32)
    scenario = make_scenario(kind, truth=has_truth, seed=seed, **numbers)
    hardest = max(difficulties, default=HARDEST_DIFFICULTY)
    return AssignedFlight(scenario, tuple(options), round(hardest, 2))


def encode_secret(text: str, where: str) -> bytes:
    """Derive the key of the random numbers from the instructor's secret by scrypt (RFC 7914).

    scrypt makes each guess of the secret slow. ``where`` names the option or file in errors.

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
    return derive_key(stripped)


def derive_key(secret: str) -> bytes:
    """Derive the key of the random numbers from a secret."""
    text = secret.encode(errors="replace")
    return hashlib.scrypt(text, salt=DRAW_LABEL.encode(), n=2**14, r=8, p=1, dklen=32)
