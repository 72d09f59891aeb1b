"""The parts of a flight that the model replays in one go: prediction steps and where to start.

Sources: PX4-Autopilot ``EKF/imu_down_sampler/imu_down_sampler.cpp``.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from px4fuse.display import brief
from px4fuse.ekf2.vision import Vision
from px4fuse.flight import (
    ACCELEROMETER_BIAS_COLUMNS,
    ANGULAR_RATE_COLUMNS,
    DELAYED_VARIANCE_COLUMNS,
    GYRO_BIAS_COLUMNS,
    POSITION_COLUMNS,
    QUATERNION_COLUMNS,
    SPECIFIC_FORCE_COLUMNS,
    VELOCITY_COLUMNS,
    Ekf2,
    Flight,
    FusionRecord,
    Unavailable,
)
from px4fuse.readers.px4_ekf2 import samples_per_step
from px4fuse.trajectory.rotation import (
    conjugate,
    from_vector,
    interpolate,
    matrix,
    multiply,
    running_product,
    to_vector,
)

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

# Without vision or IMU for longer than this the model starts again from the log: other things than
# vision then move EKF2 (gravity, fake position, zero velocity), which the model does not have
RESTART_GAP_S = 2.0
# PX4 limits a prediction step to twice EKF2_PREDICT_US, so that a longer gap is lost motion
IMU_GAP_S = 0.05
# Fusion must have run so long when the model starts, and the model so long before it is judged
START_AFTER_S = 1.0
# and the vehicle so long off the ground: on it EKF2 fuses zero velocity and gravity, and taking off
# settles what is tilt and what is accelerometer bias
AIRBORNE_S = 4.0
SETTLING_S = 5.0
MIN_STRETCH_S = 10.0


@dataclass(frozen=True)
class Stretch:
    """A part of the flight that the model replays in one go: n prediction steps.

    The nominal attitude is the published one; what the model estimates is its error, so that the
    equations are linear. Vectors are NED unless they are said to be of the body.

    Attributes
    ----------
    time_s : ndarray, shape (n + 1,)
        Start, then the end of each step.
    step_s : ndarray, shape (n,)
    rotation : ndarray, shape (n + 1, 3, 3)
        Nominal attitude, body FRD to NED.
    correction_rad : ndarray, shape (n, 3)
        By how much the nominal attitude turns in each step beyond what the gyro measured.
    force_m_s2 : ndarray, shape (n, 3)
        Specific force of the body in each step, nominal bias removed, in the frame at its end.
    accelerometer_bias_m_s2 : ndarray, shape (3,)
        Nominal bias: the log's at the start.
    state : ndarray, shape (15,)
        At the start: attitude error, velocity, position, errors of both biases.
    variance : ndarray, shape (15,)
        At the start, in the same order.
    down_m : ndarray, shape (n + 1,)
        Published height.
    heading_variance_rad2, down_variance_m2 : ndarray, shape (n + 1,)
        As the log has them.
    attitude_error_rad : ndarray, shape (n + 1, 3)
        Of EKF2's own filter at its horizon, against the nominal attitude.
    correlation : ndarray, shape (15, 15)
        Of the state at the start; the log has variances only.
    fusing : bool
        Whether EKF2 fuses vision when it begins.
    """

    time_s: Array
    step_s: Array
    rotation: Array
    correction_rad: Array
    force_m_s2: Array
    accelerometer_bias_m_s2: Array
    state: Array
    variance: Array
    down_m: Array
    heading_variance_rad2: Array
    down_variance_m2: Array
    attitude_error_rad: Array
    correlation: Array
    fusing: bool = True

    __repr__ = brief


def find_stretches(
    flight: Flight,
    imu: pd.DataFrame,
    attitude: pd.DataFrame,
    ekf2: Ekf2,
    record: FusionRecord,
    vision: Vision,
) -> tuple[Stretch, ...]:
    """Parts of a flight without gaps in IMU and vision, from when EKF2 has fused for a while.

    Parameters
    ----------
    flight : Flight
        For when it is airborne.
    imu, attitude : DataFrame
    ekf2 : Ekf2
    record : FusionRecord
    vision : Vision
    """
    innovations = ekf2.innovations["north"]
    if isinstance(innovations, Unavailable):
        return ()
    fused = innovations.index.to_numpy()
    delayed_time = record.delayed.index.to_numpy()
    time = imu.index.to_numpy()
    interval = np.diff(time)
    cuts = [time[0], time[-1]]
    for stamps, limit in ((time, IMU_GAP_S), (vision.stamp_s, RESTART_GAP_S)):
        gap = np.flatnonzero(np.diff(stamps) > limit)
        cuts += [*stamps[gap], *stamps[gap + 1]]
    first = max(attitude.index[0], vision.stamp_s[0])
    last = min(attitude.index[-1], vision.stamp_s[-1] + 1.0)
    found = []
    edges = np.unique(np.clip(cuts, first, last))
    for low, high in pairwise(edges):
        inside = fused[(fused >= low) & (fused <= high)]
        if not len(inside):
            continue
        begin = inside[0] + START_AFTER_S
        if not isinstance(flight.airborne, Unavailable):
            offs = [off + AIRBORNE_S for off, _ in flight.airborne if off < high]
            begin = max([begin, *offs[:1]])
        at = int(np.searchsorted(delayed_time, begin))
        if at == len(delayed_time) or high - delayed_time[at] < MIN_STRETCH_S:
            continue
        if np.any(interval[(time[1:] > delayed_time[at]) & (time[:-1] < high)] > IMU_GAP_S):
            continue
        found.append(_stretch(imu, attitude, ekf2, record, at, high))
    return tuple(found)


def _stretch(
    imu: pd.DataFrame,
    attitude: pd.DataFrame,
    ekf2: Ekf2,
    record: FusionRecord,
    at: int,
    end_s: float,
) -> Stretch:
    start = record.delayed.iloc[at]
    time = imu.index.to_numpy()
    from_row = int(np.argmin(np.abs(time - record.delayed.index[at])))
    to_row = int(np.searchsorted(time, end_s, side="right"))
    time = time[from_row:to_row]
    interval = np.diff(time)
    known = np.flatnonzero(np.isin(np.rint(time * 1e6), np.rint(record.delayed.index * 1e6)))
    ends = step_ends(interval, known, predict_s(record))
    gyro_bias = start[GYRO_BIAS_COLUMNS].to_numpy(dtype=np.float64)
    accelerometer_bias = start[ACCELEROMETER_BIAS_COLUMNS].to_numpy(dtype=np.float64)
    rate = imu[ANGULAR_RATE_COLUMNS].to_numpy()[from_row + 1 : to_row] - gyro_bias
    force = imu[SPECIFIC_FORCE_COLUMNS].to_numpy()[from_row + 1 : to_row] - accelerometer_bias
    turn, gain = down_sampled(rate * interval[:, None], force * interval[:, None], ends)
    step_time = time[np.concatenate([[0], ends])]
    step = np.diff(step_time)
    gyro = running_product(np.concatenate([[[1.0, 0.0, 0.0, 0.0]], from_vector(turn)]))
    logged = attitude[QUATERNION_COLUMNS].to_numpy()
    logged_time = attitude.index.to_numpy()
    inside = (logged_time >= step_time[0]) & (logged_time <= step_time[-1])
    logged, logged_time = logged[inside], logged_time[inside]
    # what the published attitude has beyond the gyro's, in the earth frame
    beyond = multiply(logged, conjugate(interpolate(logged_time, step_time, gyro)))
    extra = interpolate(step_time, logged_time, beyond)
    nominal = multiply(extra, gyro)
    delayed_time = record.delayed.index.to_numpy()
    inside = (delayed_time >= step_time[0] - 1e-4) & (delayed_time <= step_time[-1])
    own = record.delayed.loc[inside, QUATERNION_COLUMNS].to_numpy(copy=True)
    error = to_vector(
        multiply(own, conjugate(interpolate(delayed_time[inside], step_time, nominal)))
    )
    state = np.zeros(15)
    state[:3] = error[0]
    state[3:6] = start[VELOCITY_COLUMNS]
    position = start[POSITION_COLUMNS].to_numpy(dtype=np.float64)
    published = [
        np.interp(step_time[0], ekf2.state.index, ekf2.state[name]) for name in POSITION_COLUMNS
    ]
    state[6:9] = np.where(np.isfinite(position), position, published)
    state[8] = published[2]  # altitude and height have different origins since v1.16
    return Stretch(
        time_s=step_time,
        step_s=step,
        rotation=matrix(nominal),
        correction_rad=to_vector(multiply(extra[1:], conjugate(extra[:-1]))),
        force_m_s2=gain / step[:, None],
        accelerometer_bias_m_s2=accelerometer_bias,
        state=state,
        variance=start[DELAYED_VARIANCE_COLUMNS].to_numpy(dtype=np.float64),
        down_m=np.interp(step_time, ekf2.state.index, ekf2.state["down_m"]),
        heading_variance_rad2=_at(record.delayed["attitude_down_rad2"], step_time),
        down_variance_m2=_at(record.delayed["down_m2"], step_time),
        attitude_error_rad=np.column_stack(
            [np.interp(step_time, delayed_time[inside], part) for part in error.T]
        ),
        correlation=np.eye(15),
    )


def predict_s(record: FusionRecord) -> float:
    """EKF2_PREDICT_US (s)."""
    return record.parameters.get("EKF2_PREDICT_US", 10_000.0) * 1e-6


def _at(series: pd.Series, times: Array) -> Array:
    values: Array = np.interp(times, series.index.to_numpy(), series.to_numpy())
    return values


def step_ends(interval_s: Array, known: Indices, target_s: float) -> Indices:
    """Where EKF2's prediction steps end: after how many IMU intervals from the start.

    A step is complete after :func:`samples_per_step`, or as soon as it is longer than the target.
    Ends that the log shows set the count again.

    Parameters
    ----------
    interval_s : ndarray, shape (n,)
        Of the IMU samples after the start.
    known : ndarray of int
        Ends that are known, increasing; the start may be among them.
    target_s : float
        EKF2_PREDICT_US.

    Returns
    -------
    ndarray of int
        The last is at most n.
    """
    needed = samples_per_step(target_s, float(np.median(interval_s)))
    early = np.flatnonzero(np.convolve(interval_s, np.ones(max(needed - 1, 1)), "valid") > target_s)
    ends: list[NDArray[np.intp]] = []
    shown = set(known.tolist())
    marks = sorted({0, len(interval_s), *shown})
    for low, high in pairwise(marks):
        if needed == 1 or np.searchsorted(early, low) == np.searchsorted(early, high):
            block = np.arange(low + needed, high + 1, needed, dtype=np.intp)
        else:
            block = np.array(_counted(interval_s[low:high], needed, target_s), dtype=np.intp) + low
        if high in shown and (not len(block) or block[-1] != high):
            block = np.append(block, high)
        ends.append(block)
    return np.concatenate(ends)


def _counted(interval_s: Array, needed: int, target_s: float) -> list[int]:
    ends, count, total = [], 0, 0.0
    for at, interval in enumerate(interval_s.tolist(), start=1):
        count += 1
        total += interval
        if (count >= needed and total > 0.5 * target_s) or total > target_s:
            ends.append(at)
            count, total = 0, 0.0
    return ends


def down_sampled(turn: Array, gain: Array, ends: Indices) -> tuple[Array, Array]:
    """Turn and velocity gained in each step, the gain in the body's frame at the step's end."""
    starts = np.concatenate([[0], ends[:-1]])
    turned = np.concatenate([np.zeros((1, 3)), np.cumsum(turn, axis=0)])
    total = turned[ends] - turned[starts]
    count = ends - starts
    of_step = np.repeat(np.arange(len(ends)), count)
    used = slice(0, int(ends[-1]))
    left = turned[ends][of_step] - 0.5 * (turned[:-1][used] + turned[1:][used])
    seen_from_end = gain[used] - np.cross(left, gain[used])
    return total, np.add.reduceat(seen_from_end, starts, axis=0)
