"""Random choice of a simulated flight with injected faults for each student.

Random numbers are the HMAC (RFC 2104) of the student id with the instructor's secret as key.
Students without the secret cannot predict them, and a second run gives the same flights.
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

# Kind of the simulated flights: along an aisle, around a loop, or one of both at random
FlightKind = Literal["aisle", "loop", "mixed"]

# Minimum length (characters) of the instructor's secret: a shorter secret can be guessed
MIN_SECRET_LENGTH = 16
# First part of each HMAC message. Another label would change the flights of existing answer keys
HMAC_LABEL = "px4fuse assignment 2"
# Fractions of the flights that have 0, 1 and 2 injected faults. The only fault of a loop is
# "open-end" (landing far from the start); 40 % have no fault, so that students cannot guess it
FAULT_COUNT_FRACTIONS: dict[ScenarioKind, tuple[float, ...]] = {
    "aisle": (0.1, 0.5, 0.4),
    "loop": (0.4, 0.6),
}
# Fraction of loops if the kind of flight is "mixed"; the other flights are along an aisle
LOOP_FLIGHT_FRACTION = 1 / 3
# Range of the difficulty of an injected fault. Difficulty: smallest size that px4fuse detects,
# divided by the size in the flight
EASIEST_DIFFICULTY, HARDEST_DIFFICULTY = 0.6, 1.0
# Fraction of the flights with faults that px4fuse may not detect (difficulty above 1), and maximum
# difficulty of these faults: students must analyse them without the findings of px4fuse
UNDETECTABLE_FLIGHT_FRACTION, MAX_FAULT_DIFFICULTY = 0.25, 1.5


class AssignableFault(Record):
    """Type of fault that can be injected into a student's simulated flight.

    Attributes
    ----------
    name : str
        Name of the fault in ``px4fuse simulate --mistake``.
    group : str
        Faults with equal groups hide each other, so a flight has at most one of them.
    detectable_size : float or None
        Size (in ``unit``) that px4fuse detects in 19 of 20 flights (tests/studies/rates.csv); None
        for a fault without a size.
    is_smaller_easier : bool
        True if a fault with a smaller size is easier to detect.
    has_either_sign : bool
        True if the sign of the size is random.
    start_range_s : (float, float) or None
        Earliest and latest start (s); None for a fault of the whole flight.
    hidden_groups : tuple of str
        Groups of faults that this fault hides.
    """

    name: str
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
        """Return the value of the option ``px4fuse simulate --mistake`` for this fault.

        ``difficulty`` is the smallest size that px4fuse detects, divided by the size in the flight.
        ``start_fraction`` is 0 for the earliest start and 1 for the latest start.
        """
        if self.detectable_size is None:
            return self.name
        size = self.detectable_size / difficulty
        if self.is_smaller_easier:
            size = self.detectable_size * difficulty
        option_value = f"{self.name}={math.copysign(float(f'{size:.3g}'), sign):g}{self.unit}"
        if self.start_range_s is None:
            return option_value
        earliest_start_s, latest_start_s = self.start_range_s
        start_s = earliest_start_s + start_fraction * (latest_start_s - earliest_start_s)
        return f"{option_value},{start_s:.0f}s"


class SamplingRules(Record):
    """Possible faults and random parameters of one kind of simulated flight.

    ``numbers`` gives (minimum, maximum, number of decimals) of each random field of the scenario.
    """

    faults: tuple[AssignableFault, ...]
    numbers: dict[str, tuple[float, float, int]]


SAMPLING_RULES_BY_KIND = read_toml(__file__, dict[ScenarioKind, SamplingRules], "drawn.toml")


@dataclass(frozen=True)
class AssignedFlight:
    """Settings of the simulated flight of one student.

    Attributes
    ----------
    mistake_options : tuple of str
        Injected faults, as values of ``px4fuse simulate --mistake``.
    difficulty : float
        Difficulty of the fault that is hardest to detect: smallest size that px4fuse detects,
        divided by the size in the flight. 1 without a fault.
    """

    scenario: Scenario
    mistake_options: tuple[str, ...]
    difficulty: float


def draw_bits(secret: bytes, student_id: str, kind: FlightKind, quantity: str) -> int:
    """Return a random integer (128 bits) for a quantity of a student's flight, such as "seed".

    Equal arguments always give the same number.
    """
    message = "\0".join((HMAC_LABEL, kind, normalise_text(student_id), quantity))
    digest = hmac.new(secret, message.encode(errors="replace"), hashlib.sha256).digest()
    return int.from_bytes(digest[:16], "big")


def draw_uniform(secret: bytes, student_id: str, kind: FlightKind, quantity: str) -> float:
    """Return a uniform random number in [0, 1) for a quantity of a student's flight."""
    return (draw_bits(secret, student_id, kind, quantity) >> 75) / 2**53


def assign_random_flight(
    secret: bytes,
    student_id: str,
    kind: FlightKind,
    fault_count: int | None = None,
    with_ground_truth: bool = True,
) -> AssignedFlight:
    """Select injected faults and parameters of a student's simulated flight at random.

    Parameters
    ----------
    kind : {"aisle", "loop", "mixed"}
        "mixed" selects aisle or loop at random.
    fault_count : int, optional
        Number of injected faults; random by default.
    with_ground_truth : bool
        True to log the ground truth. The log of a loop never contains the ground truth, because
        students have to estimate the landing place.

    Raises
    ------
    SettingsError
        A flight cannot have ``fault_count`` injected faults.
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
            "loop"
            if draw_uniform(secret, student_id, kind, "kind") < LOOP_FLIGHT_FRACTION
            else "aisle"
        )
    draw_number = partial(draw_uniform, secret, student_id, kind)
    if fault_count is None:
        fault_count = bisect(
            list(accumulate(FAULT_COUNT_FRACTIONS[kind][:-1])), draw_number("count")
        )
    faults: list[AssignableFault] = []
    rules = SAMPLING_RULES_BY_KIND[kind]
    for fault in sorted(rules.faults, key=lambda each: draw_number(f"order {each.name}")):
        if len(faults) < fault_count and all(map(fault.is_detectable_with, faults)):
            faults.append(fault)
    difficulty_range = EASIEST_DIFFICULTY, HARDEST_DIFFICULTY
    if draw_number("undetectable") < UNDETECTABLE_FLIGHT_FRACTION:
        difficulty_range = HARDEST_DIFFICULTY, MAX_FAULT_DIFFICULTY
    difficulties, mistake_options = [], []
    for fault in faults:
        name, difficulty = fault.name, EASIEST_DIFFICULTY
        if fault.detectable_size is not None:
            low, high = difficulty_range
            difficulty = low + (high - low) * draw_number(f"size {name}")
        sign = -1.0 if fault.has_either_sign and draw_number(f"sign {name}") < 0.5 else 1.0
        difficulties.append(difficulty)
        mistake_options.append(fault.format_option(difficulty, sign, draw_number(f"at {name}")))
    scenario = make_scenario(
        kind,
        truth=with_ground_truth and kind == "aisle",
        seed=draw_bits(secret, student_id, kind, "seed"),
        **draw_scenario_numbers(kind, draw_number),
    )
    max_difficulty = max(difficulties, default=HARDEST_DIFFICULTY)
    return AssignedFlight(scenario, tuple(mistake_options), round(max_difficulty, 2))


def draw_scenario_numbers(
    kind: ScenarioKind, draw_number: Callable[[str], float]
) -> dict[str, Any]:
    """Return random values for the numeric fields of :class:`Scenario`."""
    return {
        name: round(low + (high - low) * draw_number(name), decimals)
        for name, (low, high, decimals) in SAMPLING_RULES_BY_KIND[kind].numbers.items()
    }


def derive_seed_from_secret(text: str, source_name: str) -> bytes:
    """Derive the seed of the random numbers from the instructor's secret.

    Raises
    ------
    SettingsError
        The secret is shorter than MIN_SECRET_LENGTH; the message begins with ``source_name``.
    """
    secret = text.strip()
    if len(secret) < MIN_SECRET_LENGTH:
        raise SettingsError(
            f"{source_name}: the secret has only {len(secret)} characters and can be guessed.",
            f"Use {MIN_SECRET_LENGTH} or more characters, or omit the secret: px4fuse then "
            "generates a secret and stores it in the answer key.",
        )
    return derive_hmac_key(secret)


def derive_hmac_key(secret: str) -> bytes:
    """Derive the key of the random generator from the secret; scrypt (RFC 7914) slows guessing."""
    text = secret.encode(errors="replace")
    return hashlib.scrypt(text, salt=HMAC_LABEL.encode(), n=2**14, r=8, p=1, dklen=32)
