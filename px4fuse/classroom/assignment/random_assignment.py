"""Random assignment of a flight with injected faults to each student.

Random numbers are the HMAC (RFC 2104) of the student id with the instructor's secret as key. The
numbers cannot be predicted without the secret, and a second run gives the same flights.
"""

from __future__ import annotations

import hashlib
import hmac
import math
from bisect import bisect
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import accumulate
from typing import Any, Literal

from px4fuse.classroom.assignment.roster import normalise_text
from px4fuse.core.record import Record, read_toml
from px4fuse.errors import SettingsError
from px4fuse.simulation.scenario import Scenario, ScenarioKind, make_scenario

# Kind of the flights of a class; for "mixed", aisle or loop is drawn for each student
FlightKind = Literal["aisle", "loop", "mixed"]

# Minimum length (characters) of the instructor's secret: a shorter one can be guessed
MIN_SECRET_LENGTH = 16
# First part of each HMAC message. Another label would change all flights, so that students could
# not be added to existing answer keys
DRAW_LABEL = "px4fuse assignment 2"
# Fractions of flights with 0, 1 and 2 injected faults, by kind of flight. The only
# possible injected fault of a loop is "open-end". Many loops have no injected fault, so that
# students cannot guess "open-end"
MISTAKE_COUNT_FRACTIONS: dict[ScenarioKind, tuple[float, ...]] = {
    "aisle": (0.1, 0.5, 0.4),
    "loop": (0.4, 0.6),
}
# Fraction of the students of a "mixed" class who get a loop; the others get an aisle flight
LOOP_FRACTION = 1 / 3
# Range of the difficulty of an injected fault: smallest size that px4fuse detects, divided by the
# size in the flight
EASIEST_DIFFICULTY, HARDEST_DIFFICULTY = 0.6, 1.0
# Fraction of the flights whose faults are smaller than those that px4fuse detects, so that its
# findings are not the right answers, and the largest difficulty of these flights
UNDETECTABLE_FRACTION, UNDETECTABLE_DIFFICULTY = 0.25, 1.5


class AssignableMistake(Record):
    """Injected fault of a simulated flight that can be assigned to a student.

    Attributes
    ----------
    group : str
        Two faults of one group are not assigned together, because one hides the other.
    detectable_size : float or None
        Smallest size, in ``unit``, that px4fuse detects in 19 of 20 flights
        (tests/studies/rates.csv); None for a fault without a size.
    is_smaller_easier : bool
        True if a smaller number is easier to detect.
    has_either_sign : bool
        True if the sign of the size is drawn at random.
    start_range_s : (float, float) or None
        Earliest and latest start (s); None for a fault that lasts the whole flight.
    hidden_groups : tuple of str
        Groups of faults that this fault hides.
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

        ``start_fraction`` selects the start time: 0 for the earliest start, 1 for the latest.
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


class DrawingRules(Record):
    """Possible injected faults of a kind of flight, and ranges of random numbers (``drawn.toml``).

    ``numbers`` are minimum, maximum and decimals, by field of the scenario.
    """

    mistakes: tuple[AssignableMistake, ...]
    numbers: dict[str, tuple[float, float, int]]


RULES_BY_KIND = read_toml(__file__, dict[ScenarioKind, DrawingRules], "drawn.toml")


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
        Difficulty of the most difficult injected fault; HARDEST_DIFFICULTY without a fault.
        Above HARDEST_DIFFICULTY, px4fuse may not detect the fault.
    """

    scenario: Scenario
    mistake_options: tuple[str, ...]
    difficulty: float


def draw_bits(secret: bytes, student_id: str, kind: FlightKind, label: str) -> int:
    """Return a random number of 128 bits that secret, student, kind and label determine."""
    message = "\0".join((DRAW_LABEL, kind, normalise_text(student_id), label))
    digest = hmac.new(secret, message.encode(errors="replace"), hashlib.sha256).digest()
    return int.from_bytes(digest[:16], "big")


def draw_uniform(secret: bytes, student_id: str, kind: FlightKind, label: str) -> float:
    """Return a random number in [0, 1), the first 53 bits of :func:`draw_bits`."""
    return (draw_bits(secret, student_id, kind, label) >> 75) / 2**53


def draw(
    secret: bytes,
    student_id: str,
    kind: FlightKind,
    mistake_count: int | None = None,
    truth: bool = True,
) -> AssignedFlight:
    """Draw the flight of one student.

    Parameters
    ----------
    kind : {"aisle", "loop", "mixed"}
        "mixed" draws aisle or loop.
    mistake_count : int, optional
        Number of injected faults; drawn at random by default.
    truth : bool
        True to log the ground truth of aisle flights. The log of a loop never contains it, because
        the ground truth shows the landing place.

    Raises
    ------
    SettingsError
        One flight cannot have this many injected faults.
    """
    possible_kinds = MISTAKE_COUNT_FRACTIONS if kind == "mixed" else (kind,)
    max_mistake_count = (
        min(len(MISTAKE_COUNT_FRACTIONS[scenario_kind]) for scenario_kind in possible_kinds) - 1
    )
    if mistake_count is not None and not 0 <= mistake_count <= max_mistake_count:
        raise SettingsError(
            f"--mistakes {mistake_count} is out of range: a flight of kind {kind} has 0 to "
            f"{max_mistake_count} detectable mistakes."
        )
    if kind == "mixed":
        kind = "loop" if draw_uniform(secret, student_id, kind, "kind") < LOOP_FRACTION else "aisle"
    draw_number = partial(draw_uniform, secret, student_id, kind)
    if mistake_count is None:
        mistake_count = bisect(
            list(accumulate(MISTAKE_COUNT_FRACTIONS[kind][:-1])), draw_number("count")
        )
    mistakes: list[AssignableMistake] = []
    rules = RULES_BY_KIND[kind]
    for mistake in sorted(rules.mistakes, key=lambda each: draw_number(f"order {each.mistake}")):
        if len(mistakes) < mistake_count and all(map(mistake.is_detectable_with, mistakes)):
            mistakes.append(mistake)
    low, high = EASIEST_DIFFICULTY, HARDEST_DIFFICULTY
    if draw_number("undetectable") < UNDETECTABLE_FRACTION:
        low, high = HARDEST_DIFFICULTY, UNDETECTABLE_DIFFICULTY
    difficulties, options = [], []
    for mistake in mistakes:
        name, difficulty = mistake.mistake, EASIEST_DIFFICULTY
        if mistake.detectable_size is not None:
            difficulty = low + (high - low) * draw_number(f"size {name}")
        sign = -1.0 if mistake.has_either_sign and draw_number(f"sign {name}") < 0.5 else 1.0
        difficulties.append(difficulty)
        options.append(mistake.format_option(difficulty, sign, draw_number(f"at {name}")))
    scenario = make_scenario(
        kind,
        truth=truth and kind == "aisle",
        seed=draw_bits(secret, student_id, kind, "seed"),
        **draw_numbers(kind, draw_number),
    )
    difficulty = max(difficulties, default=HARDEST_DIFFICULTY)
    return AssignedFlight(scenario, tuple(options), round(difficulty, 2))


def draw_numbers(kind: ScenarioKind, draw_number: Callable[[str], float]) -> dict[str, Any]:
    """Draw the numbers of a scenario of this kind, by field."""
    return {
        name: round(low + (high - low) * draw_number(name), decimals)
        for name, (low, high, decimals) in RULES_BY_KIND[kind].numbers.items()
    }


def encode_secret(text: str, source_name: str) -> bytes:
    """Derive the key of the random numbers from the instructor's secret.

    Raises
    ------
    SettingsError
        The secret is shorter than MIN_SECRET_LENGTH; the message names the file of the secret.
    """
    secret = text.strip()
    if len(secret) < MIN_SECRET_LENGTH:
        raise SettingsError(
            f"{source_name}: the secret has only {len(secret)} characters and can be guessed.",
            f"Use {MIN_SECRET_LENGTH} or more characters, or omit the secret: px4fuse then "
            "generates a secret and stores it in the answer key.",
        )
    return derive_key(secret)


def derive_key(secret: str) -> bytes:
    """Derive the key of the random numbers by scrypt (RFC 7914), which makes guessing slow."""
    text = secret.encode(errors="replace")
    return hashlib.scrypt(text, salt=DRAW_LABEL.encode(), n=2**14, r=8, p=1, dklen=32)
