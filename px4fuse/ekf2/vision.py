"""The external vision samples that EKF2 received, and what it did with them.

Sources: PX4-Autopilot ``EKF/aid_sources/external_vision/ev_pos_control.cpp`` and, before v1.15,
``EKF/ev_pos_control.cpp`` (frames), ``logged_topics.cpp`` (logging rates).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from px4fuse.display import brief
from px4fuse.ekf2_parameters import fuses_by_mask, settings_in_force
from px4fuse.flight import (
    POSITION_COLUMNS,
    POSITION_VARIANCE_COLUMNS,
    QUATERNION_COLUMNS,
    Ekf2,
    Flight,
    FusionRecord,
    PositionTrack,
    Unavailable,
)
from px4fuse.origin import GIVEN_FILE
from px4fuse.trajectory.rotation import conjugate, interpolate, matrix, multiply

Array = NDArray[np.float64]

WHAT = "EKF2 replay"
# Logger limits of the topics that hold a copy of the vision samples (logged_topics.cpp)
COPY_INTERVAL_S = {"estimator_visual_odometry_aligned": 0.2, "estimator_aid_src_ev_pos": 0.5}
ROTATE_VISION_BIT = 64  # EKF2_AID_MASK, up to v1.13
# The aid-source topics carry the time of measurement, as EKF2 takes it, to about a millisecond
AID_SOURCE = "estimator_aid_src_ev_pos"
SAME_SAMPLE_S = 0.006
# vehicle_local_position is logged every 0.1 s
RESET_SHOWS_S = 0.2


@dataclass(frozen=True)
class Vision:
    """External vision samples as EKF2 received them, shape (m,) or (m, ...), in time order.

    Attributes
    ----------
    stamp_s, arrival_s : ndarray, shape (m,)
    position_m : ndarray, shape (m, 3)
        NED.
    variance_m2 : ndarray, shape (m, 3)
        As reported; 0 where the sender gave none.
    rejected : ndarray, shape (m,)
        Whether EKF2's gate rejected it, 1 or 0; NaN where the log does not tell.
    reset : ndarray of bool, shape (m,)
        Whether EKF2 reset its position to it, where the log tells what it rejected.
    source : str
        Name of the track.
    """

    stamp_s: Array
    arrival_s: Array
    position_m: Array
    variance_m2: Array
    rejected: Array
    reset: NDArray[np.bool_]
    source: str

    __repr__ = brief


def read_vision(
    flight: Flight, ekf2: Ekf2, record: FusionRecord, attitude: pd.DataFrame
) -> Vision | Unavailable:
    """The samples that EKF2 received, in NED, or why the log does not hold them all.

    Parameters
    ----------
    flight : Flight
    ekf2 : Ekf2
    record : FusionRecord
    attitude : DataFrame
        As published, to turn samples of a frame of their own.
    """
    track = _source(flight)
    if isinstance(track, Unavailable):
        return track
    samples = track.samples.dropna(subset=POSITION_COLUMNS[:2])
    stamp = samples.index.to_numpy()
    position = samples[POSITION_COLUMNS].to_numpy(copy=True)
    variance = samples[POSITION_VARIANCE_COLUMNS].fillna(0.0).to_numpy(copy=True)
    rotated = not isinstance(ekf2.fusing, pd.DataFrame) or not ekf2.fusing["yaw"].any()
    if fuses_by_mask(record.parameters):
        rotated = bool(int(record.parameters["EKF2_AID_MASK"]) & ROTATE_VISION_BIT)
    if track.frame == "FRD" and rotated:
        if track.orientation is None:
            return Unavailable(
                WHAT,
                f"{track.name} is in a frame of its own (FRD) and gives no orientation by which "
                "EKF2 turned it north",
                "Send the position in NED, or with an orientation.",
            )
        published = interpolate(
            stamp, attitude.index.to_numpy(), attitude[QUATERNION_COLUMNS].to_numpy()
        )
        sent = interpolate(
            stamp,
            track.orientation.index.to_numpy(),
            track.orientation[QUATERNION_COLUMNS].to_numpy(),
        )
        turn = matrix(multiply(published, conjugate(sent)))
        position = np.einsum("nij,nj->ni", turn, position)
        variance = np.einsum("nij,nj->ni", turn**2, variance)
    age = record.vision_age_s
    if len(age) and "vehicle_visual_odometry" in track.topics:
        arrival = stamp + np.interp(stamp, age.index.to_numpy(), age.to_numpy())
    else:
        arrival = np.full(len(stamp), -np.inf)  # unknown: never taken to be late
    rejected, reset = _decisions(ekf2, record, stamp)
    return Vision(stamp, arrival, position, variance, rejected, reset, track.name)


def _decisions(ekf2: Ekf2, record: FusionRecord, stamp: Array) -> tuple[Array, NDArray[np.bool_]]:
    """What EKF2 rejected and reset to, where its aid-source topic tells, by time of measurement."""
    rejected, reset = np.full(len(stamp), np.nan), np.zeros(len(stamp), dtype=bool)
    innovations = ekf2.innovations["north"]
    if (
        isinstance(innovations, Unavailable)
        or isinstance(ekf2.horizon_s, Unavailable)
        or AID_SOURCE not in ekf2.innovation_topics
    ):
        return rejected, reset
    delay_s = settings_in_force(record.parameters)["EKF2_EV_DELAY"] * 1e-3
    taken, logged = stamp - delay_s - 0.5 * ekf2.step_s, innovations.index.to_numpy()
    at = np.clip(np.searchsorted(logged, taken - SAME_SAMPLE_S), 0, len(logged) - 1)
    same = np.abs(logged[at] - taken) <= SAME_SAMPLE_S
    rejected[same] = innovations["rejected"].to_numpy()[at[same]]
    # a reset shows in the first published sample after it, the horizon after the measurement
    published = taken + ekf2.horizon_s
    for one in ekf2.resets:
        before = np.flatnonzero((published <= one.time_s) & (rejected != 0.0))
        moved = one.quantity == "position" and bool(one.delta[0] or one.delta[1])
        if moved and len(before) and one.time_s - published[before[-1]] < RESET_SHOWS_S:
            reset[before[-1]] = True
    return rejected, reset


def _source(flight: Flight) -> PositionTrack | Unavailable:
    """The track that EKF2 received, complete."""
    why = ["no vehicle_visual_odometry"]
    for track in sorted(flight.positions, key=lambda t: t.origin == GIVEN_FILE):
        if track.origin.is_vision and track.origin.as_sent:
            return track
        if track.name in COPY_INTERVAL_S:
            interval = float(np.median(np.diff(track.samples.index.to_numpy())))
            limit = COPY_INTERVAL_S[track.name]
            if interval < 0.9 * limit and interval <= 0.25:
                return track
            why.append(
                f"{track.name} holds one sample in {interval:.2g} s, fewer than EKF2 may have fused"
            )
    return Unavailable(
        WHAT,
        "; ".join(why),
        "Set SDLOG_PROFILE to 129 (default and vision), or give the MAVLink recording too.",
    )
