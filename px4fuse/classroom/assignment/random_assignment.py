"""Random assignment of a flight with injected faults to each student.

Random numbers are the HMAC (RFC 2104) of the student id with the instructor's secret as key.
Students cannot predict them without the secret, and a second run gives the same flights.
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

# Kind of the flights of a class; for "mixed", each student gets an aisle or a loop at random
FlightKind = Literal["aisle", "loop", "mixed"]

# Minimum length (characters) of the instructor's secret: a shorter secret can be guessed
MIN_SECRET_LENGTH = 16
# First part of each HMAC message. Another label would change the flights of existing answer keys
HMAC_LABEL = "px4fuse assignment 2"
# Fractions of flights with 0, 1 and 2 injected faults, by kind of flight. Many loops have no
# injected fault, so that students cannot guess "open-end", the only possible fault of a loop
FAULT_COUNT_FRACTIONS: dict[ScenarioKind, tuple[float, ...]] = {
    "aisle": (0.1, 0.5, 0.4),
    "loop": (0.4, 0.6),
}
# Fraction of the students of a "mixed" class who get a loop; the others get an aisle flight
LOOP_FRACTION = 1 / 3
# Range of the difficulty of an injected fault: smallest detectable size, divided by the size in
# the flight
EASIEST_DIFFICULTY, HARDEST_DIFFICULTY = 0.6, 1.0
# Fraction of the flights with faults that are too small for detection by px4fuse, so that students
# cannot copy its findings, and the maximum difficulty of these faults
UNDETECTABLE_FRACTION, UNDETECTABLE_DIFFICULTY = 0.25, 1.5


class AssignableFault(Record):
    """Injected fault of a simulated flight that can be assigned to a student.

    Attributes
    ----------
    group : str
        A flight has at most one fault of a group, because one fault would hide the other.
    detectable_size : float or None
        Smallest size, in ``unit``, that px4fuse detects in 19 of 20 flights
        (tests/studies/rates.csv); None for a fault without a size.
    is_smaller_easier : bool
        True if a smaller number is easier to detect.
    has_either_sign : bool
        True if the sign of the size is random.
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

    def is_detectable_with(self, other_fault: AssignableFault) -> bool:
        """Return True if both injected faults can be detected in the same flight."""
        is_hidden = other_fault.group in (self.group, *self.hidden_groups)
        return not is_hidden and self.group not in other_fault.hidden_groups

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


class SamplingRules(Record):
    """Injected faults that a kind of flight can have, and ranges of its random numbers.

    ``numbers`` are minimum, maximum and number of decimals of each random field of the scenario.
    """

    mistakes: tuple[AssignableFault, ...]
    numbers: dict[str, tuple[float, float, int]]


RULES_BY_KIND = read_toml(__file__, dict[ScenarioKind, SamplingRules], "drawn.toml")


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
        Largest ratio of the smallest detectable size of an injected fault to its size in the
        flight; 1 without a fault. px4fuse may not detect a fault with a ratio above 1.
    """

    scenario: Scenario
    mistake_options: tuple[str, ...]
    difficulty: float


def random_bits(secret: bytes, student_id: str, kind: FlightKind, label: str) -> int:
    """Return the random integer (128 bits) of a student for a label."""
    message = "\0".join((HMAC_LABEL, kind, normalise_text(student_id), label))
    digest = hmac.new(secret, message.encode(errors="replace"), hashlib.sha256).digest()
    return int.from_bytes(digest[:16], "big")


def random_uniform(secret: bytes, student_id: str, kind: FlightKind, label: str) -> float:
    """Return the random number in [0, 1) of a student for a label."""
    return (random_bits(secret, student_id, kind, label) >> 75) / 2**53


def assign_random_flight(
    secret: bytes,
    student_id: str,
    kind: FlightKind,
    fault_count: int | None = None,
    truth: bool = True,
) -> AssignedFlight:
    """Select injected faults and scenario of one student's flight at random.

    Parameters
    ----------
    kind : {"aisle", "loop", "mixed"}
        "mixed" selects aisle or loop at random.
    fault_count : int, optional
        Number of injected faults; random by default.
    truth : bool
        True to log the ground truth of aisle flights. The log of a loop never contains it, because
        the ground truth shows the landing place.

    Raises
    ------
    SettingsError
        One flight cannot have this many injected faults.
    """
    possible_kinds = FAULT_COUNT_FRACTIONS if kind == "mixed" else (kind,)
    max_fault_count = (
        min(len(FAULT_COUNT_FRACTIONS[scenario_kind]) for scenario_kind in possible_kinds) - 1
    )
    if fault_count is not None and not 0 <= fault_count <= max_fault_count:
        raise SettingsError(
            f"--mistakes {fault_count} is out of range: a flight of kind {kind} has 0 to "
            f"{max_fault_count} faults."
        )
    if kind == "mixed":
        kind = (
            "loop" if random_uniform(secret, student_id, kind, "kind") < LOOP_FRACTION else "aisle"
        )
    random_number = partial(random_uniform, secret, student_id, kind)
    if fault_count is None:
        fault_count = bisect(
            list(accumulate(FAULT_COUNT_FRACTIONS[kind][:-1])), random_number("count")
        )
    faults: list[AssignableFault] = []
    rules = RULES_BY_KIND[kind]
    for fault in sorted(rules.mistakes, key=lambda each: random_number(f"order {each.mistake}")):
        if len(faults) < fault_count and all(map(fault.is_detectable_with, faults)):
            faults.append(fault)
    low, high = EASIEST_DIFFICULTY, HARDEST_DIFFICULTY
    if random_number("undetectable") < UNDETECTABLE_FRACTION:
        low, high = HARDEST_DIFFICULTY, UNDETECTABLE_DIFFICULTY
    difficulties, mistake_options = [], []
    for fault in faults:
        name, difficulty = fault.mistake, EASIEST_DIFFICULTY
        if fault.detectable_size is not None:
            difficulty = low + (high - low) * random_number(f"size {name}")
        sign = -1.0 if fault.has_either_sign and random_number(f"sign {name}") < 0.5 else 1.0
        difficulties.append(difficulty)
        mistake_options.append(fault.format_option(difficulty, sign, random_number(f"at {name}")))
    scenario = make_scenario(
        kind,
        truth=truth and kind == "aisle",
        seed=random_bits(secret, student_id, kind, "seed"),
        **random_scenario_numbers(kind, random_number),
    )
    difficulty = max(difficulties, default=HARDEST_DIFFICULTY)
    return AssignedFlight(scenario, tuple(mistake_options), round(difficulty, 2))


def random_scenario_numbers(
    kind: ScenarioKind, random_number: Callable[[str], float]
) -> dict[str, Any]:
    """Return random values for the numeric fields of a scenario."""
    return {
        name: round(low + (high - low) * random_number(name), decimals)
        for name, (low, high, decimals) in RULES_BY_KIND[kind].numbers.items()
    }


def encode_secret(text: str, source_name: str) -> bytes:
    """Return the instructor's secret as seed of the random numbers.

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
    """Derive the key of the random numbers by scrypt (RFC 7914), so that guessing is slow."""
    text = secret.encode(errors="replace")
    return hashlib.scrypt(text, salt=HMAC_LABEL.encode(), n=2**14, r=8, p=1, dklen=32)
