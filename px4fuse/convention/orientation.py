"""Convention of an orientation: order of the quaternion, frames, constant rotation of the body.

The reference is the attitude from the gyroscopes, whose tilt follows gravity. A hypothesis is
scored by the median difference of the tilt and of the heading, the heading about its circular mean.
"""

from itertools import product
from typing import Final, NamedTuple, cast

import numpy as np

from px4fuse.arrays import Array
from px4fuse.convention.model import Frames, OrientationConvention
from px4fuse.convention.motion import Inertial
from px4fuse.trajectory.rotation import heading, interpolate, multiply

IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
FRD_FLU = np.array([0.0, 1.0, 0.0, 0.0])  # half a turn about x
ENU_NED = np.array([0.0, np.sqrt(0.5), np.sqrt(0.5), 0.0])
# Rotations of world and body to NED and FRD
FRAMES: Final[dict[str, tuple[Array, Array]]] = {
    "FRD to NED": (IDENTITY, IDENTITY),
    "FLU to ENU": (ENU_NED, FRD_FLU),
    "FLU to NWU": (FRD_FLU, FRD_FLU),
    "FLU to NED": (IDENTITY, FRD_FLU),
    "FRD to ENU": (ENU_NED, IDENTITY),
}
MAX_COPY_DEG = 0.15  # copies differ by up to 0.03°, fused motion capture by more than 0.2°
COPY_DELAYS_S = np.arange(0.0, 0.205, 0.01)
MAX_TILT_DEG, MAX_HEADING_DEG = 6.0, 12.0  # median tilt, heading difference if correct
MIN_DIFFERENCE_DEG = 0.7
SCORE_PER_S = 0.5
MIN_LOG_ODDS = 4.0
MAX_SAMPLES, MIN_SAMPLES = 600, 20


class Candidate(NamedTuple):
    """Hypothesis on an orientation; its rotation to FRD and NED, without ``body_quarters``."""

    score: float
    order: str
    frames: str
    body_quarters: int
    tilt_deg: float
    heading_deg: float
    attitude: Array

    @property
    def meaning(self) -> tuple[str, str]:
        """Convention without headings: ENU and NWU differ by a rotation about the vertical."""
        return self.order, self.frames.replace("ENU", "NWU")


def check_orientation(
    inertial: Inertial, time_s: Array, quaternion: Array
) -> tuple[OrientationConvention, Array, Array] | None:
    """Determine the convention of an orientation.

    Parameters
    ----------
    inertial : Inertial
    time_s : ndarray, shape (n,)
    quaternion : ndarray, shape (n, 4)
        As sent; w, x, y, z by definition of the message.

    Returns
    -------
    convention : OrientationConvention
        Without ``heading_error_deg``.
    time_s : ndarray, shape (m,)
        Some of the times in flight.
    attitude : ndarray, shape (m, 4)
        Orientation at these times, rotates FRD to NED.
    """
    in_flight = np.zeros(len(time_s), dtype=bool)
    for start, end in inertial.valid_spans_s:
        in_flight |= (time_s >= start) & (time_s <= end)
    rows = np.flatnonzero(in_flight)
    if len(rows) < MIN_SAMPLES:
        return None
    rows = rows[:: -(-len(rows) // MAX_SAMPLES)]
    time, sent = time_s[rows], quaternion[rows]
    sent = sent / np.linalg.norm(sent, axis=1, keepdims=True)
    angles_deg = [
        np.median(angle_deg(sent, interpolate(time - delay, inertial.time_s, inertial.logged)))
        for delay in COPY_DELAYS_S
    ]
    if min(angles_deg) < MAX_COPY_DEG:
        return OrientationConvention(verdict="copied"), time, sent
    reference = interpolate(time, inertial.time_s, inertial.gyro)
    candidates = sorted(
        (
            _make_candidate(time, sent, reference, order, frames, quarters)
            for order, frames, quarters in product(("w x y z", "x y z w"), FRAMES, range(4))
        ),
        key=lambda candidate: -candidate.score,
    )
    best = candidates[0]
    rival = next(one for one in candidates if one.meaning != best.meaning)
    verdict = "determined" if best.score - rival.score >= MIN_LOG_ODDS else "ambiguous"
    if best.tilt_deg > MAX_TILT_DEG or best.heading_deg > MAX_HEADING_DEG:
        verdict = "unrelated"
    convention = OrientationConvention(
        verdict=verdict,  # type: ignore[arg-type]
        order=best.order,  # type: ignore[arg-type]
        frames=cast(Frames, best.frames),
        tilt_difference_deg=best.tilt_deg,
    )
    return convention, time, best.attitude


def to_attitude(quaternion: Array, convention: OrientationConvention) -> Array:
    """Convert an orientation as sent to the attitude (w, x, y, z; FRD to NED)."""
    return _convert(quaternion, convention.order, convention.frames)


def _convert(sent: Array, order: str, frames: str) -> Array:
    world, body = FRAMES[frames]
    return multiply(multiply(world, sent if order == "w x y z" else np.roll(sent, 1, 1)), body)


def _make_candidate(
    time: Array,
    sent: Array,
    reference: Array,
    order: str,
    frames: str,
    quarters: int,
) -> Candidate:
    """Convert an orientation by a hypothesis and compare it with the reference."""
    attitude = _convert(sent, order, frames)
    half = quarters * np.pi / 4.0
    turned = multiply(attitude, np.array([np.cos(half), 0.0, 0.0, np.sin(half)]))
    difference = np.exp(1j * (heading(turned) - heading(reference)))
    mean = np.mean(difference)
    offset_rad = float(np.angle(mean))
    heading_deg = float(
        np.median(np.abs(np.degrees(np.angle(difference / np.exp(1j * offset_rad)))))
    )
    cosine = np.sum(down_in_body(turned) * down_in_body(reference), axis=1)
    tilt_deg = float(np.median(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))))
    score = (
        -SCORE_PER_S
        * float(time[-1] - time[0])
        * float(
            np.log(max(tilt_deg, MIN_DIFFERENCE_DEG)) + np.log(max(heading_deg, MIN_DIFFERENCE_DEG))
        )
    )
    score -= 4.0 * (order != "w x y z") + 2.0 * (frames != "FRD to NED")
    score -= 2.0 * (quarters != 0) + 1.0 * (abs(offset_rad) > np.radians(8.0))
    return Candidate(score, order, frames, quarters, tilt_deg, heading_deg, attitude)


def down_in_body(q: Array) -> Array:
    """Return the unit vector down in the body frame."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    return np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=-1)


def angle_deg(a: Array, b: Array) -> Array:
    """Return the angles between quaternions."""
    cosine = np.clip(np.abs(np.sum(a * b, axis=-1)), 0.0, 1.0)
    return np.asarray(np.degrees(2.0 * np.arccos(cosine)))
