"""Flight → what the model of EKF2 runs on: prediction steps, vision samples, where to start.

Sources: PX4-Autopilot ``EKF/imu_down_sampler/imu_down_sampler.cpp`` (prediction steps),
``EKF/estimator_interface.cpp`` (buffers), ``EKF/aid_sources/external_vision/ev_pos_control.cpp``
and, before v1.15, ``EKF/ev_pos_control.cpp`` (frames).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from px4fuse.ekf2.parameters import fuses_by_mask, settings_in_force
from px4fuse.ekf2.rotation import (
    conjugate,
    from_vector,
    interpolate,
    matrix,
    multiply,
    running_product,
    to_vector,
)
from px4fuse.flight import (
    ACCELEROMETER_BIAS_COLUMNS,
    ANGULAR_RATE_COLUMNS,
    DELAYED_VARIANCE_COLUMNS,
    GYRO_BIAS_COLUMNS,
    POSITION_COLUMNS,
    POSITION_VARIANCE_COLUMNS,
    QUATERNION_COLUMNS,
    SPECIFIC_FORCE_COLUMNS,
    VELOCITY_COLUMNS,
    Ekf2,
    Flight,
    FusionRecord,
    PositionTrack,
    Unavailable,
)

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

WHAT = "EKF2 replay"
# Without vision or IMU for longer than this the model starts again from the log: other things than
# vision then move EKF2 (gravity, fake position, zero velocity), which the model does not have
RESTART_GAP_S = 2.0
# PX4 limits a prediction step to twice EKF2_PREDICT_US, so that a longer gap is lost motion
IMU_GAP_S = 0.05
# Predictions of more than this lose turns and vibration inside a step; EKF2's own are 8 to 13 ms
MAX_IMU_INTERVAL_S = 0.012
# Fusion must have run so long when the model starts, and the model so long before it is judged
START_AFTER_S = 1.0
# and the vehicle so long off the ground: on it EKF2 fuses zero velocity and gravity, and taking off
# settles what is tilt and what is accelerometer bias
AIRBORNE_S = 4.0
SETTLING_S = 5.0
MIN_STRETCH_S = 10.0
# Logger limits of the topics that hold a copy of the vision samples (logged_topics.cpp)
COPY_INTERVAL_S = {"estimator_visual_odometry_aligned": 0.2, "estimator_aid_src_ev_pos": 0.5}
# The first release that stamps estimator_states with the time of the horizon
STAMPED_AT_HORIZON = "PX4 v1.13"
NO_LIMIT = 1_000_000
# The aid-source topics carry the time of measurement, as EKF2 takes it, to about a millisecond
AID_SOURCE = "estimator_aid_src_ev_pos"
SAME_SAMPLE_S = 0.006
# vehicle_local_position is logged every 0.1 s
RESET_SHOWS_S = 0.2
ROTATE_VISION_BIT = 64  # EKF2_AID_MASK, up to v1.13


@dataclass(frozen=True)
class Rules:
    """What decides when EKF2 starts, stops and resets vision position, by release.

    Attributes
    ----------
    start_interval_s : float
        Fusion starts on a sample that follows the one before it within this.
    stop_s : float
        Fusion stops after this time without a sample.
    reset_s : float
        The position is reset to the sample after this time of rejections.
    resets : int
        So many resets in a row, then fusion stops until a sample on which it may start.
    bias_floor : float or None
        Least variance of the accelerometer's bias (m²/s⁴), where the release has one.
    horizon_by_delay : bool
        Whether the longest delay makes the horizon; else EKF2_DELAY_MAX does (from v1.15).
    """

    start_interval_s: float
    stop_s: float
    reset_s: float
    resets: int
    bias_floor: float | None
    horizon_by_delay: bool


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
    gyro_bias_rad_s, accelerometer_bias_m_s2 : ndarray, shape (3,)
        Nominal biases: the log's at the start.
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
    """

    time_s: Array
    step_s: Array
    rotation: Array
    correction_rad: Array
    force_m_s2: Array
    gyro_bias_rad_s: Array
    accelerometer_bias_m_s2: Array
    state: Array
    variance: Array
    down_m: Array
    heading_variance_rad2: Array
    down_variance_m2: Array
    attitude_error_rad: Array
    correlation: Array


@dataclass(frozen=True)
class Inputs:
    """All that the model needs of a flight.

    Attributes
    ----------
    settings : dict
        The model's parameters as flown, by PX4 name.
    stretches : tuple of Stretch
    vision : Vision
    rules : Rules
    step_s : float
        Average prediction step.
    horizon_s : float
        How far the fusion runs behind the output.
    predict_s : float
        EKF2_PREDICT_US.
    vision_height : bool
        Whether EKF2 took its height from vision.
    imu_offset_m : ndarray, shape (3,)
        EKF2_IMU_POS, body FRD.
    """

    settings: dict[str, float]
    stretches: tuple[Stretch, ...]
    vision: Vision
    rules: Rules
    step_s: float
    horizon_s: float
    predict_s: float
    vision_height: bool
    imu_offset_m: Array


def prepare(flight: Flight) -> Inputs | Unavailable:
    """What the model runs on, or why the log cannot carry it.

    Parameters
    ----------
    flight : Flight
    """
    imu, attitude, ekf2 = flight.imu, flight.attitude, flight.ekf2
    for part in (imu, attitude, ekf2):
        if isinstance(part, Unavailable):
            return Unavailable(WHAT, f"{part.what}: {part.reason}", part.remedy)
    assert isinstance(imu, pd.DataFrame)
    assert isinstance(attitude, pd.DataFrame)
    assert isinstance(ekf2, Ekf2)
    record = ekf2.record
    if isinstance(record, Unavailable):
        return Unavailable(WHAT, record.reason, record.remedy)
    if record.other_aiding:
        return Unavailable(
            WHAT,
            f"EKF2 fused more than vision position horizontally ({', '.join(record.other_aiding)})",
            "Fly with EKF2_GPS_CTRL 0, EKF2_OF_CTRL 0 and without bit 2 of EKF2_EV_CTRL.",
        )
    interval = float(np.median(np.diff(imu.index.to_numpy())))
    if interval > MAX_IMU_INTERVAL_S:
        return Unavailable(
            WHAT,
            f"the IMU is logged at {1 / interval:.0f} Hz, slower than EKF2 predicts",
            "Record with SDLOG_PROFILE bit 0 (default), which logs sensor_combined at full rate.",
        )
    vision = _vision(flight, ekf2, record, attitude)
    if isinstance(vision, Unavailable):
        return vision
    horizon_s = ekf2.horizon_s
    if isinstance(horizon_s, Unavailable):
        if not flight.log.firmware.startswith(STAMPED_AT_HORIZON):
            return Unavailable(WHAT, horizon_s.reason, horizon_s.remedy)
        horizon_s = 0.0  # a buffer of one step: EKF2_EV_DELAY is at most EKF2_PREDICT_US
    stretches = _stretches(flight, imu, attitude, ekf2, record, vision)
    if not stretches:
        return Unavailable(
            WHAT,
            f"no {MIN_STRETCH_S:g} s of external vision fused without a gap in IMU or vision",
            "Record without dropouts (a faster SD card, fewer topics), and send vision steadily.",
        )
    old = fuses_by_mask(record.parameters)
    floor = 5e-8 / ekf2.step_s**2 if record.per_step_biases else None
    # EV_MAX_INTERVAL, ev_control.cpp; no_aid_timeout_max and reset_timeout_max, common.h
    by_delay = "EKF2_DELAY_MAX" not in record.parameters
    rules = (
        Rules(np.inf, 7.0, 7.0, NO_LIMIT, floor, by_delay)
        if old
        else Rules(0.2, 0.4, 1.0, 5, floor, by_delay)
    )
    fusing = ekf2.fusing
    return Inputs(
        settings=settings_in_force(record.parameters),
        stretches=stretches,
        vision=vision,
        rules=rules,
        step_s=ekf2.step_s,
        horizon_s=horizon_s,
        predict_s=_predict_s(record),
        vision_height=isinstance(fusing, pd.DataFrame) and bool(fusing["vertical"].mean() > 0.5),
        imu_offset_m=np.array([record.parameters.get(f"EKF2_IMU_POS_{x}", 0.0) for x in "XYZ"]),
    )


def _vision(
    flight: Flight, ekf2: Ekf2, record: FusionRecord, attitude: pd.DataFrame
) -> Vision | Unavailable:
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


def _decisions(
    ekf2: Ekf2, record: FusionRecord, stamp: Array
) -> tuple[Array, NDArray[np.bool_]]:
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
    for track in sorted(flight.positions, key=lambda t: (t.rung == 1, t.rung)):
        if track.rung in (1, 2):
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


def _stretches(
    flight: Flight,
    imu: pd.DataFrame,
    attitude: pd.DataFrame,
    ekf2: Ekf2,
    record: FusionRecord,
    vision: Vision,
) -> tuple[Stretch, ...]:
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
    for low, high in zip(edges[:-1], edges[1:], strict=True):
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
    known = np.searchsorted(time, record.delayed.index.to_numpy() - 1e-4)
    known = known[(known < len(time)) & (known > 0)]
    on_sample = np.isin(np.rint(time[known] * 1e6), np.rint(record.delayed.index * 1e6))
    ends = step_ends(interval, known[on_sample], _predict_s(record))
    gyro_bias = start[GYRO_BIAS_COLUMNS].to_numpy(dtype=np.float64)
    accelerometer_bias = start[ACCELEROMETER_BIAS_COLUMNS].to_numpy(dtype=np.float64)
    rate = imu[ANGULAR_RATE_COLUMNS].to_numpy()[from_row + 1 : to_row] - gyro_bias
    force = imu[SPECIFIC_FORCE_COLUMNS].to_numpy()[from_row + 1 : to_row] - accelerometer_bias
    turn, gain = _down_sampled(rate * interval[:, None], force * interval[:, None], ends)
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
        gyro_bias_rad_s=gyro_bias,
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


def _predict_s(record: FusionRecord) -> float:
    return record.parameters.get("EKF2_PREDICT_US", 10_000.0) * 1e-6


def _at(series: pd.Series, times: Array) -> Array:
    return np.interp(times, series.index.to_numpy(), series.to_numpy())


def step_ends(interval_s: Array, known: Indices, target_s: float) -> Indices:
    """Where EKF2's prediction steps end: after how many IMU intervals from the start.

    A step is complete after round(target / interval) samples, or as soon as it is longer than the
    target. Ends that the log shows set the count again.

    Parameters
    ----------
    interval_s : ndarray, shape (n,)
        Of the IMU samples after the start.
    known : ndarray of int
        Ends that are known, increasing, each above 0.
    target_s : float
        EKF2_PREDICT_US.

    Returns
    -------
    ndarray of int
        The last is at most n.
    """
    needed = max(1, round(target_s / float(np.median(interval_s))))
    early = np.flatnonzero(
        np.convolve(interval_s, np.ones(max(needed - 1, 1)), "valid") > target_s
    )
    ends: list[NDArray[np.intp]] = []
    shown = set(known.tolist())
    marks = sorted({0, len(interval_s), *shown})
    for low, high in zip(marks[:-1], marks[1:], strict=True):
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


def _down_sampled(turn: Array, gain: Array, ends: Indices) -> tuple[Array, Array]:
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
