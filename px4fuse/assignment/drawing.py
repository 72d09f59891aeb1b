"""What is drawn for a student: which flight, which mistakes, of which sizes.

It follows from the instructor's secret and the student's id by HMAC (RFC 2104), so that nobody
without the secret can guess another's, and a second run gives the same.
"""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from px4fuse.assignment.key import folded
from px4fuse.errors import SettingsError
from px4fuse.simulation.scenario import Kind, Scenario

MIN_SECRET = 8
# What is drawn, and from where to where, with the decimals that are kept. Beyond these the rates at
# which mistakes are found (findings/rates.csv) have not been checked.
NOISES: dict[Kind, dict[str, tuple[float, float, int]]] = {
    "aisle": {
        "sigma_uwb_m": (0.07, 0.12, 3),
        "sigma_a_m_s2": (0.15, 0.30, 3),
        "speed_m_s": (0.9, 1.3, 2),
        "heading_deg": (-180.0, 180.0, 1),
    },
    "loop": {
        "vio_drift": (0.008, 0.02, 4),
        "sigma_vio_m": (0.008, 0.015, 4),
        "sigma_a_m_s2": (0.15, 0.30, 3),
        "speed_m_s": (0.8, 1.2, 2),
        "heading_deg": (-180.0, 180.0, 1),
    },
}
PASSES: dict[Kind, int] = {"aisle": 6, "loop": 1}
# Shares of flights with so many mistakes, where the number is not given. The loop has one mistake
# to offer; with fewer flights without it, "false closure" would be a safe guess.
COUNTS: dict[Kind, tuple[float, ...]] = {"aisle": (0.1, 0.5, 0.4), "loop": (0.4, 0.6)}


@dataclass(frozen=True)
class Choice:
    """A mistake that may be drawn, at sizes at which it is found.

    Attributes
    ----------
    mistake : str
        Name in :data:`px4fuse.simulation.mistakes.MISTAKES`.
    finding : str
        What names it.
    group : str
        Of two of the same group, one would hide the other.
    hides : tuple of str
        Other groups whose mistakes this one hides, or whose mistakes hide it.
    low, high : float
        Sizes, in ``unit``; findings/rates.csv has the finding in nine flights of ten or more at
        ``low`` or at something less plain.
    unit : str
        As it is typed.
    either_sign : bool
    at_s : (float, float) or None
        When it begins, where that can be said.
    """

    mistake: str
    finding: str
    group: str
    low: float
    high: float
    unit: str
    either_sign: bool = False
    at_s: tuple[float, float] | None = None
    hides: tuple[str, ...] = ()

    def goes_with(self, other: Choice) -> bool:
        """Whether both are found in one flight."""
        return not (
            self.group == other.group or self.group in other.hides or other.group in self.hides
        )


# Clock and heading are estimated from the IMU. A gap of the IMU is not among the choices: it passes
# for a change of the clock in every second flight. Outliers make EKF2 reject and its NIS grow too.
NEED_IMU = ("clock", "frame")
CHOICES: dict[Kind, tuple[Choice, ...]] = {
    "aisle": (
        Choice("clock-offset", "source_clock_offset", "clock", 220, 350, "ms", True),
        Choice(
            "clock-jump", "source_clock_changes", "clock", 400, 450, "ms", hides=("frame", "gap")
        ),
        Choice("yaw", "source_frame_turned", "frame", 20, 35, "deg", True),
        Choice("nlos", "source_outliers", "outliers", 2, 6, "%"),
        Choice("dropout", "source_gap", "gap", 3, 8, "s", at_s=(30, 70)),
        Choice("imu-rate", "logging_rate_low", "rate", 15, 25, "Hz", hides=NEED_IMU),
        Choice("ekf2-noise", "ekf2_variance_understated", "ekf2", 2, 3, "cm", hides=("outliers",)),
        Choice("ekf2-gate", "ekf2_rejecting", "ekf2", 1.5, 2, "", hides=("outliers",)),
        Choice("ekf2-delay", "ekf2_ev_delay_wrong", "clock", 175, 200, "ms"),
    ),
    "loop": (Choice("open-end", "false_loop_closure", "end", 5, 8, "m"),),
}
POSSIBLE_FINDINGS = frozenset(choice.finding for kind in CHOICES.values() for choice in kind)


def uniform(secret: bytes, student_id: str, kind: Kind, label: str) -> float:
    """A number in [0, 1) that only those who know the secret can tell."""
    message = "\0".join(("px4fuse assignment 1", kind, folded(student_id), label))
    digest = hmac.new(secret, message.encode(errors="replace"), hashlib.sha256).digest()
    return int.from_bytes(digest[:7], "big") / 2**56


def draw(
    secret: bytes, student_id: str, kind: Kind, count: int | None = None, truth: bool = True
) -> tuple[Scenario, tuple[Choice, ...], tuple[str, ...]]:
    """Draw one student's flight.

    Parameters
    ----------
    secret : bytes
    student_id : str
    kind : {"aisle", "loop"}
    count : int, optional
        Of mistakes; None draws it.
    truth : bool
        Whether an aisle's log holds the truth. A loop's does not: it would tell where it landed.

    Returns
    -------
    scenario : Scenario
    chosen : tuple of Choice
    mistakes : tuple of str
        As typed, in the same order.
    """

    def number(label: str, low: float, high: float, decimals: int) -> float:
        return round(low + (high - low) * uniform(secret, student_id, kind, label), decimals)

    drawn: dict[str, Any] = {name: number(name, *span) for name, span in NOISES[kind].items()}
    scenario = Scenario(
        kind=kind,
        passes=PASSES[kind],
        truth=truth and kind == "aisle",
        seed=int(uniform(secret, student_id, kind, "seed") * 2**32),
        **drawn,
    )
    if count is None:
        count = _count(uniform(secret, student_id, kind, "count"), COUNTS[kind])
    left = sorted(
        CHOICES[kind], key=lambda c: uniform(secret, student_id, kind, f"order {c.mistake}")
    )
    chosen: list[Choice] = []
    for choice in left:
        if len(chosen) < count and all(map(choice.goes_with, chosen)):
            chosen.append(choice)
    typed = []
    for choice in chosen:
        size = number(f"size {choice.mistake}", choice.low, choice.high, 1)
        if choice.either_sign and uniform(secret, student_id, kind, f"sign {choice.mistake}") < 0.5:
            size = -size
        text = f"{choice.mistake}={size:g}{choice.unit}"
        if choice.at_s is not None:
            text += f",{number(f'at {choice.mistake}', *choice.at_s, 0):g}s"
        typed.append(text)
    return scenario, tuple(chosen), tuple(typed)


def _count(drawn: float, shares: Sequence[float]) -> int:
    total = 0.0
    for count, share in enumerate(shares):
        total += share
        if drawn < total:
            return count
    return len(shares) - 1


def most_mistakes(kind: Kind) -> int:
    """How many mistakes a flight can have."""
    return len(COUNTS[kind]) - 1


def secret_of(text: str, where: str) -> bytes:
    """A secret as bytes, from an option or a file.

    Raises
    ------
    SettingsError
        It is too short to be one.
    """
    stripped = text.strip()
    if len(stripped) < MIN_SECRET:
        raise SettingsError(
            f"{where}: a secret of {len(stripped)} characters can be guessed. Give "
            f"{MIN_SECRET} or more, or leave it out: one is made up and kept in the answer key."
        )
    return stripped.encode(errors="replace")
