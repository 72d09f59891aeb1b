"""Random choice of a simulated flight with injected faults for each student.

Random numbers are the HMAC (RFC 2104) of the student id, with the instructor's secret as key.
"""

from __future__ import annotations

import hashlib
import hmac
from bisect import bisect
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import accumulate
from typing import Any, Literal

from px4fuse.core.record import Record, read_csv, read_toml
from px4fuse.errors import SettingsError
from px4fuse.simulation.scenario import Scenario, ScenarioKind, make_scenario

from .roster import normalise_text

# Kind of the simulated flights: along an aisle, around a loop, or one of both at random
FlightKind = Literal["aisle", "loop", "mixed"]
# Function that returns a random number in [0, 1) for the name of a quantity; equal names give equal
# numbers
DrawRandomNumber = Callable[[str], float]

# Minimum length (characters) of the instructor's secret: a shorter secret can be guessed
MIN_SECRET_LENGTH = 16
# Do not change this label: the flights would no longer agree with existing answer keys
HMAC_LABEL = "px4fuse assignment 2"
# Probabilities of 0, 1 and 2 injected faults in a flight
PROBABILITY_BY_FAULT_COUNT: dict[ScenarioKind, tuple[float, ...]] = {
    "aisle": (0.1, 0.5, 0.4),
    "loop": (0.4, 0.6),
}
# Probability of a loop if the kind of flight is "mixed"
LOOP_FLIGHT_PROBABILITY = 1 / 3
# Range of the difficulty of an injected fault: smallest size that px4fuse detects ÷ injected size.
# A fault with difficulty 1 is just detectable
EASIEST_DIFFICULTY, HARDEST_DIFFICULTY = 0.6, 1.0
# Probability that a flight has faults with a difficulty above 1, which px4fuse may not detect; and
# the maximum difficulty of these faults
DIFFICULT_FAULTS_PROBABILITY, MAX_FAULT_DIFFICULTY = 0.25, 1.5


class AssignableFault(Record):
    """Type of fault that can be injected into a student's flight (``assignable_faults.csv``).

    IMU gaps are not assigned: in half of the flights with an IMU gap, px4fuse reports a change of
    the time offset instead of the gap.

    Attributes
    ----------
    name : str
        Name of the fault in ``px4fuse simulate --mistake``.
    group : str
        Group of faults that mask each other; a flight has at most one of them.
    detection_limit : float
        Smallest size (in ``unit``) that px4fuse detects in 19 of 20 flights
        (tests/studies/rates.csv); 0 for a fault without size.
    has_either_sign : bool
        True if the sign of the size is random.
    earliest_start_s, latest_start_s : float
        Range of the start of the fault; 0 for a fault of the whole flight.
    masked_fault_groups : str
        Groups, separated by blanks, of faults that px4fuse cannot detect in a flight with this
        fault. Examples: a reduced IMU rate masks the groups "clock" and "frame", because the
        estimates of time offset and yaw need the IMU at full rate. Outliers mask the group "frame",
        because they change the yaw estimate. A too small noise or gate of EKF2 masks the group
        "outliers", because both increase the number of rejected positions.
    """

    flight_kind: ScenarioKind
    name: str
    group: str
    detection_limit: float
    unit: str
    is_smaller_size_easier_to_detect: bool
    has_either_sign: bool
    earliest_start_s: float
    latest_start_s: float
    masked_fault_groups: str

    def is_detectable_with(self, other_fault: AssignableFault) -> bool:
        """Return True if neither of two faults masks the other in the same flight."""
        is_masked = other_fault.group in (self.group, *self.masked_fault_groups.split())
        return not is_masked and self.group not in other_fault.masked_fault_groups.split()

    def format_option(self, difficulty: float, draw_number: DrawRandomNumber) -> str:
        """Return the value of the option ``px4fuse simulate --mistake`` for this fault.

        Parameters
        ----------
        difficulty : float
            Smallest size that px4fuse detects, divided by the size of the fault in the flight.
        draw_number : callable
            Returns a random number in [0, 1) for the name of a quantity.
        """
        if not self.detection_limit:
            return self.name
        size = self.detection_limit / difficulty
        if self.is_smaller_size_easier_to_detect:
            size = self.detection_limit * difficulty
        if self.has_either_sign and draw_number(f"sign {self.name}") < 0.5:
            size = -size
        option_value = f"{self.name}={float(f'{size:.3g}'):g}{self.unit}"
        if not self.latest_start_s:
            return option_value
        start_range_s = self.latest_start_s - self.earliest_start_s
        start_s = self.earliest_start_s + start_range_s * draw_number(f"at {self.name}")
        return f"{option_value},{start_s:.0f}s"


ASSIGNABLE_FAULTS = read_csv(__file__, AssignableFault, "assignable_faults.csv")
# Minimum, maximum and number of decimals of each random field of the scenario, by kind of flight
SCENARIO_NUMBERS_BY_KIND = read_toml(
    __file__, dict[ScenarioKind, dict[str, tuple[float, float, int]]], "drawn.toml"
)


@dataclass(frozen=True)
class AssignedFlight:
    """Settings of the simulated flight of one student.

    Attributes
    ----------
    mistake_options : tuple of str
        Injected faults, as values of ``px4fuse simulate --mistake``.
    difficulty : float
        Difficulty of the fault that is hardest to detect; 1 without a fault.
    """

    scenario: Scenario
    mistake_options: tuple[str, ...]
    difficulty: float


def derive_random_bits(secret: bytes, student_id: str, kind: FlightKind, quantity: str) -> int:
    """Return a random integer (128 bits) for a quantity of a student's flight, such as "seed".

    Equal arguments always give the same number.
    """
    message = "\0".join((HMAC_LABEL, kind, normalise_text(student_id), quantity))
    digest = hmac.new(secret, message.encode(errors="replace"), hashlib.sha256).digest()
    return int.from_bytes(digest[:16], "big")


def draw_uniform(secret: bytes, student_id: str, kind: FlightKind, quantity: str) -> float:
    """Return a uniform random number in [0, 1) for a quantity of a student's flight."""
    return (derive_random_bits(secret, student_id, kind, quantity) >> 75) / 2**53


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
        True to log the ground truth (flights along an aisle only).

    Raises
    ------
    SettingsError
        A flight cannot have ``fault_count`` injected faults.
    """
    possible_kinds = PROBABILITY_BY_FAULT_COUNT if kind == "mixed" else (kind,)
    max_fault_count = min(len(PROBABILITY_BY_FAULT_COUNT[each]) for each in possible_kinds) - 1
    if fault_count is not None and not 0 <= fault_count <= max_fault_count:
        raise SettingsError(
            f"--mistakes {fault_count} is out of range: a flight of kind {kind} has 0 to "
            f"{max_fault_count} faults."
        )
    if kind == "mixed":
        is_loop = draw_uniform(secret, student_id, kind, "kind") < LOOP_FLIGHT_PROBABILITY
        kind = "loop" if is_loop else "aisle"
    draw_number = partial(draw_uniform, secret, student_id, kind)
    if fault_count is None:
        # index of the first cumulative probability that is larger than the random number
        *cumulative_probabilities, _ = accumulate(PROBABILITY_BY_FAULT_COUNT[kind])
        fault_count = bisect(cumulative_probabilities, draw_number("count"))
    # try the faults in random order; omit a fault that masks a selected fault, or is masked by it
    faults: list[AssignableFault] = []
    possible_faults = (fault for fault in ASSIGNABLE_FAULTS if fault.flight_kind == kind)
    for fault in sorted(possible_faults, key=lambda each: draw_number(f"order {each.name}")):
        if len(faults) < fault_count and all(map(fault.is_detectable_with, faults)):
            faults.append(fault)
    # difficulty: smallest size that px4fuse detects ÷ injected size. Above 1, a fault is smaller
    # than that, and px4fuse may not detect it
    low, high = EASIEST_DIFFICULTY, HARDEST_DIFFICULTY
    if draw_number("undetectable") < DIFFICULT_FAULTS_PROBABILITY:
        low, high = HARDEST_DIFFICULTY, MAX_FAULT_DIFFICULTY
    # a fault without size is easy
    difficulties = [
        low + (high - low) * draw_number(f"size {fault.name}")
        if fault.detection_limit
        else EASIEST_DIFFICULTY
        for fault in faults
    ]
    mistake_options = tuple(
        fault.format_option(difficulty, draw_number)
        for fault, difficulty in zip(faults, difficulties, strict=True)
    )
    scenario = make_scenario(
        kind,
        truth=with_ground_truth and kind == "aisle",
        seed=derive_random_bits(secret, student_id, kind, "seed"),
        **draw_scenario_numbers(kind, draw_number),
    )
    hardest_difficulty = max(difficulties, default=1.0)
    return AssignedFlight(scenario, mistake_options, round(hardest_difficulty, 2))


def draw_scenario_numbers(kind: ScenarioKind, draw_number: DrawRandomNumber) -> dict[str, Any]:
    """Return random values for the numeric fields of :class:`Scenario`."""
    return {
        name: round(low + (high - low) * draw_number(name), decimals)
        for name, (low, high, decimals) in SCENARIO_NUMBERS_BY_KIND[kind].items()
    }


def derive_seed_from_secret(text: str, source_name: str) -> bytes:
    """Derive the seed of the random numbers from the instructor's secret.

    Raises
    ------
    SettingsError
        The secret is shorter than MIN_SECRET_LENGTH characters.
    """
    secret = text.strip()
    if len(secret) < MIN_SECRET_LENGTH:
        raise SettingsError(
            f"{source_name}: the secret has only {len(secret)} characters and can be guessed.",
            f"Use {MIN_SECRET_LENGTH} or more characters, or omit the secret.",
        )
    return derive_hmac_key(secret)


def derive_hmac_key(secret: str) -> bytes:
    """Derive the HMAC key from the secret with scrypt (RFC 7914), which slows guessing."""
    text = secret.encode(errors="replace")
    return hashlib.scrypt(text, salt=HMAC_LABEL.encode(), n=2**14, r=8, p=1, dklen=32)
