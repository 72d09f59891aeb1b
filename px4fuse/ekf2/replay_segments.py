"""Continuous parts of a flight for the EKF2 replay: prediction steps and initial state.

Source: PX4-Autopilot ``EKF/imu_down_sampler/imu_down_sampler.cpp``.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import pandas as pd
from scipy.linalg import block_diag

from px4fuse.arrays import Array, BoolArray, IntArray
from px4fuse.ekf2.earth_model import earth_rate_rad_s, ekf2_metres_per_metre
from px4fuse.flight import BAD_ACCELERATION, Columns, Ekf2, Flight, FusionRecord, Unavailable
from px4fuse.notebook_display import one_line_repr
from px4fuse.readers.px4_ekf2 import rows_of_timestamps, samples_per_step
from px4fuse.trajectory.rotation import (
    conjugate,
    cumulative_product,
    from_vector,
    interpolate,
    multiply,
    to_matrix,
    to_vector,
)

# s; after a longer gap in the source or IMU the replay restarts from the log, because EKF2 then
# fuses gravity, fake positions or zero velocity, which the model does not contain
RESTART_GAP_S = 2.0
# s; PX4 limits a prediction step to 2 EKF2_PREDICT_US, so motion in a longer gap is lost
IMU_GAP_S = 0.05
# s; minimum time of fusion before the replay starts
START_AFTER_S = 1.0
# s; minimum time in the air before the replay starts: on the ground EKF2 fuses zero velocity and
# gravity, and take-off separates tilt from accelerometer bias
AIRBORNE_S = 4.0
SETTLING_S = 5.0  # s; time of the replay before it is evaluated
# s; EKF2 resets heading and fields after take-off, and only later samples are logged
FIELD_AFTER_S = 1.0
# s; flight time before the start of the replay, used to estimate the initial correlations
HISTORY_S = 20.0
# Hz; EKF2 fuses the field at 14 Hz (SENS_MAG_RATE 15), a logged sample represents several; and the
# lowest logged rate that can be replayed
FIELD_HZ, MIN_FIELD_HZ = 14.0, 1.5
# s, time constant of EKF2's low-pass filter of innovations (updateAidSourceStatus, ekf_helper.cpp)
FILTER_S = 0.5
MIN_STRETCH_S = 10.0
# s; resets are published up to the largest delay plus one row of the log later
MAX_RESET_DELAY_S = 0.5
# fraction of clipped samples within 1 s above which the motion is lost
MAX_CLIPPED_SHARE = 0.05

GRAVITY_M_S2 = np.array([0.0, 0.0, 9.80665])  # CONSTANTS_ONE_G


# Row ranges in Stretch.state
STATES = 15
IMU_STATE_COUNT = 9  # states that the IMU propagates: all except the biases
THETA, VELOCITY, POSITION = slice(0, 3), slice(3, 6), slice(6, 9)
GYRO_BIAS, ACCELEROMETER_BIAS, BIASES = slice(9, 12), slice(12, 15), slice(9, 15)
EARTH_FIELD, BODY_FIELD = slice(15, 18), slice(18, 21)  # NED and FRD, if fused


@dataclass(frozen=True)
class SensorSamples:
    """Magnetometer or optical flow samples of one stretch, as m means of several samples.

    Attributes
    ----------
    step : ndarray of int, shape (m,)
        Prediction step after which EKF2 fuses the last sample of each mean.
    value : ndarray, shape (m, k)
        Magnetic field (gauss, body FRD); or velocity forward and right (m/s) minus the velocity
        change that the IMU measured since the start of the stretch.
    turn : ndarray, shape (m, k, 3)
        Mean rotation from NED to the body axes.
    samples : ndarray, shape (m,)
        Number of samples that EKF2 received.
    noise : ndarray, shape (m,)
        R of one sample; 0 if it follows from the parameters.
    gate : float
        In √S; infinite if it follows from the parameters.
    """

    step: IntArray
    value: Array
    turn: Array
    samples: Array
    noise: Array
    gate: float = np.inf

    __repr__ = one_line_repr


@dataclass(frozen=True)
class HeightSamples:
    """Height measurements of one stretch.

    Attributes
    ----------
    fused : tuple of str
        PX4's names of the height sensors: barometer, GNSS, or both.
    reference : str
        Sensor without bias.
    bias : (float, float)
        Initial bias of the other sensor (m, positive: too high), and its variance (m²).
    step : ndarray of int, shape (m,)
        Prediction step after which EKF2 fuses each barometer sample.
    taken_s, down_m : ndarray, shape (m,)
        EKF2's measurement time, and the height.
    dead_zone_m : ndarray, shape (m,)
        Dead zone: in ground effect a height this far below the state is ignored.
    weight : float
        Number of EKF2 samples per logged sample.
    """

    fused: tuple[str, ...]
    reference: str
    bias: tuple[float, float]
    step: IntArray
    taken_s: Array
    down_m: Array
    dead_zone_m: Array
    weight: float

    __repr__ = one_line_repr


@dataclass(frozen=True)
class Stretch:
    """Continuous part of a flight that is replayed in one run of n prediction steps.

    The nominal attitude is the published one. The model estimates its error, so the equations are
    linear. Vectors are in NED unless noted.

    Attributes
    ----------
    time_s : ndarray, shape (n + 1,)
        Start, then the end of each step.
    step_s : ndarray, shape (n,)
    rotation : ndarray, shape (n + 1, 3, 3)
        Nominal attitude, body FRD to NED.
    correction_rad : ndarray, shape (n, 3)
        Rotation of the nominal attitude in each step minus the rotation measured by the gyro, plus
        the rotation of the earth.
    force_m_s2 : ndarray, shape (n, 3)
        Specific force in each step (body frame at its end), without the nominal bias.
    accelerometer_bias_m_s2 : ndarray, shape (3,)
        Nominal bias: the logged one at the start.
    state : ndarray, shape (15,) or (21,)
        Initial attitude error, velocity, position, errors of both biases, magnetic fields.
    variance : ndarray, shape (15,) or (21,)
        Initial variances, in the same order.
    down_m : ndarray, shape (n + 1,)
        Published height.
    attitude_variance_rad2 : ndarray, shape (n + 1, 3)
    down_variance_m2 : ndarray, shape (n + 1,)
        Logged variances.
    attitude_error_rad : ndarray, shape (n + 1, 3)
        Logged attitude at the fusion horizon minus the nominal attitude.
    correlation : ndarray, shape (n, n)
        Of the initial state; estimated, because the log has variances only.
    fusing : bool
        True if EKF2 fuses the source at the start.
    field : SensorSamples or None
        Magnetometer samples, then 21 states; None: the logged EKF2 heading is used.
    heights : HeightSamples or None
        None: the logged EKF2 height, or that of vision, is used.
    bad_acceleration_share : ndarray, shape (n + 1,), or None
        Share of accelerometer axes to which EKF2 gave a larger noise in the step before: all during
        a bad vertical acceleration, else the clipped ones; None: never.
    flow : SensorSamples or None
        Optical flow samples, if EKF2 fused them.
    metres : (float, float, float)
        Metres in the state per published metre, north, east and down.
    history : Stretch or None
        Flight before the start, from which the initial correlations are estimated.
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
    attitude_variance_rad2: Array
    down_variance_m2: Array
    attitude_error_rad: Array
    correlation: Array
    fusing: bool = True
    field: SensorSamples | None = None
    heights: HeightSamples | None = None
    bad_acceleration_share: Array | None = None
    flow: SensorSamples | None = None
    metres: tuple[float, float, float] = (1.0, 1.0, 1.0)
    history: "Stretch | None" = None

    __repr__ = one_line_repr

    @cached_property
    def imu_velocity_m_s(self) -> Array:
        """Velocity change from the IMU since the start (m/s, NED), shape (n + 1, 3)."""
        force = np.einsum("nij,nj->ni", self.rotation[1:], self.force_m_s2) + GRAVITY_M_S2
        gained = np.cumsum(force * self.step_s[:, None], axis=0)
        return np.concatenate([np.zeros((1, 3)), gained])

    @cached_property
    def imu_displacement_m(self) -> Array:
        """Displacement from the IMU since the start, from rest (m, NED), shape (n + 1, 3)."""
        speed = self.imu_velocity_m_s
        path = np.cumsum(0.5 * (speed[1:] + speed[:-1]) * self.step_s[:, None], axis=0)
        return np.concatenate([np.zeros((1, 3)), path])


def samples_by_event(
    stretch: Stretch, end: IntArray, step: IntArray, position_m: Array, axes: slice, *more: Array
) -> Array:
    """Return position samples by the event at which they are fused, in up to k slots per event.

    Parameters
    ----------
    stretch : Stretch
    end : ndarray of int, shape (E,)
        Step of each event.
    step : ndarray of int, shape (m,)
        Prediction step after which each position was measured; increasing.
    position_m : ndarray, shape (m, a)
    axes : slice
        Its axes within north, east and down.
    *more : ndarray, shape (m,)
        Further columns.

    Returns
    -------
    ndarray, shape (a + 2 + len(more), k, E)
        Position at the event without the motion of the state, age, ``more``, and 1; all 0 in empty
        slots.
    """
    event = np.searchsorted(end, step)
    event = event[event < len(end)]
    count = len(event)
    step, event_step = step[:count], end[event]
    age_s = stretch.time_s[event_step] - stretch.time_s[step]
    path, speed = stretch.imu_displacement_m[:, axes], stretch.imu_velocity_m_s[:, axes]
    position_m = (
        position_m[:count] + path[event_step] - path[step] - speed[event_step] * age_s[:, None]
    )
    slot = np.arange(count) - np.searchsorted(event, event)
    sample_columns = *position_m.T, age_s, *(each[:count] for each in more), np.ones(count)
    samples = np.zeros((len(sample_columns), slot.max(initial=-1) + 1, len(end)))
    samples[:, slot, event] = sample_columns
    return samples


def pad_samples(sample_arrays: Sequence[Array]) -> list[Array]:
    """Pad the arrays of :func:`samples_by_event` to the same number of slots."""
    max_slots = max(samples.shape[1] for samples in sample_arrays)
    return [
        np.pad(each, ((0, 0), (0, max_slots - each.shape[1]), (0, 0))) for each in sample_arrays
    ]


def find_stretches(
    flight: Flight,
    imu: pd.DataFrame,
    attitude: pd.DataFrame,
    ekf2: Ekf2,
    record: FusionRecord,
    source_s: Array,
    *,
    gnss: bool = False,
) -> tuple[Stretch, ...]:
    """Find the parts of a flight without gaps in IMU and positions, after EKF2 started to fuse.

    Parameters
    ----------
    flight : Flight
        Provides the times in the air.
    imu, attitude : DataFrame
    ekf2 : Ekf2
    record : FusionRecord
    source_s : ndarray
        Timestamps of the position samples.
    gnss : bool
        True if EKF2 fuses GNSS: magnetic fields are then states if the log permits, and a bad or
        clipped acceleration gets a larger noise.
    """
    innovations = ekf2.innovations["north"]
    assert isinstance(innovations, pd.DataFrame)
    fused, states = innovations.index.to_numpy(), record.delayed.index.to_numpy()
    time = imu.index.to_numpy()
    cuts = [time[0], time[-1]]
    for stamps, limit in ((time, IMU_GAP_S), (source_s, RESTART_GAP_S)):
        gap = np.flatnonzero(np.diff(stamps) > limit)
        cuts += [*stamps[gap], *stamps[gap + 1]]
    cuts += _break_times_s(imu, ekf2) if gnss else ()
    first = max(attitude.index[0], source_s[0])
    last = min(attitude.index[-1], source_s[-1] + 1.0)
    airborne = () if isinstance(flight.airborne, Unavailable) else flight.airborne
    field_span = _field_span(record) if gnss else None
    cuts += field_span[1:] if field_span else ()
    # another EKF2 instance has different states
    cuts += [time_s for time_s, _ in ekf2.instances[1:]]
    stretches = []
    for low, high in pairwise(np.unique(np.clip(cuts, first, last))):
        fused_inside = fused[(fused >= low) & (fused <= high)]
        if not len(fused_inside):
            continue
        starts = [off + AIRBORNE_S for off, _ in airborne if off < high][:1]
        if field_span and low <= field_span[0] < high:
            starts.append(field_span[0])
        start_row = int(np.searchsorted(states, max([fused_inside[0] + START_AFTER_S, *starts])))
        if start_row == len(states) or high - states[start_row] < MIN_STRETCH_S:
            continue
        is_covered = (time[1:] > states[start_row]) & (time[:-1] < high)
        if not np.all(np.diff(time)[is_covered] <= IMU_GAP_S):
            continue
        stretch_inputs = imu, attitude, ekf2, record
        if not gnss:
            stretches.append(_stretch(*stretch_inputs, start_row, high))
            continue
        stretch = _gnss_stretch(*stretch_inputs, start_row, high)
        history_row = int(np.searchsorted(states, max(first, states[start_row] - HISTORY_S)))
        if history_row < start_row:
            stretch = replace(
                stretch, history=_gnss_stretch(*stretch_inputs, history_row, states[start_row])
            )
        has_field = field_span and field_span[0] <= states[start_row] and high <= field_span[1]
        stretches.append(
            _add_field(stretch, record, start_row, ekf2.step_s) if has_field else stretch
        )
    return tuple(stretches)


def _gnss_stretch(
    imu: pd.DataFrame,
    attitude: pd.DataFrame,
    ekf2: Ekf2,
    record: FusionRecord,
    start_row: int,
    end_s: float,
) -> Stretch:
    """Return a stretch with earth rotation and a larger noise of bad accelerations."""
    stretch = _on_rotating_earth(_stretch(imu, attitude, ekf2, record, start_row, end_s), record)
    return replace(
        stretch, bad_acceleration_share=_bad_acceleration_share(imu, record, stretch.time_s)
    )


def _on_rotating_earth(stretch: Stretch, record: FusionRecord) -> Stretch:
    """Add earth rotation, and convert the position to metres of EKF2's state."""
    metres, state = ekf2_metres_per_metre(record), stretch.state.copy()
    state[POSITION] *= metres
    turned = earth_rate_rad_s(record) * stretch.step_s[:, None]
    return replace(
        stretch, state=state, metres=metres, correction_rad=stretch.correction_rad + turned
    )


def _break_times_s(imu: pd.DataFrame, ekf2: Ekf2) -> list[float]:
    """Return the times (s) at which the replay must be interrupted.

    These are the limits of times with many clipped samples, in which motion is lost, and of resets
    of height and vertical velocity, which are published with a delay.
    """
    breaks = [
        time
        for reset in ekf2.resets
        if reset.delta[2]
        for time in (reset.time_s - MAX_RESET_DELAY_S, reset.time_s)
    ]
    if "clipped" in imu:
        times = imu.index.to_numpy()
        clipped_s = times[imu["clipped"].to_numpy() > 0.0]
        begin, end = (np.searchsorted(clipped_s, clipped_s + s) for s in (-0.5, 0.5))
        clipped_moments = clipped_s[
            end - begin > MAX_CLIPPED_SHARE / float(np.median(np.diff(times)))
        ]
        breaks += [*(clipped_moments - 0.5), *(clipped_moments + 0.5)]
    return breaks


def _bad_acceleration_share(imu: pd.DataFrame, record: FusionRecord, time_s: Array) -> Array:
    """Return the share of accelerometer axes with a larger noise, at the end of each step."""
    share_by_step = record.was_in_state(BAD_ACCELERATION, time_s).astype(float)
    if "clipped" in imu:  # one bit per axis
        clipped = imu.loc[(imu["clipped"] > 0.0) & (imu.index <= time_s[-1]), "clipped"]
        clipped_share = np.unpackbits(clipped.to_numpy(np.uint8)[:, None], axis=1).sum(axis=1) / 3.0
        np.maximum.at(share_by_step, np.searchsorted(time_s, clipped.index), clipped_share)
    return share_by_step


def _stretch(
    imu: pd.DataFrame,
    attitude: pd.DataFrame,
    ekf2: Ekf2,
    record: FusionRecord,
    start_row: int,
    end_s: float,
) -> Stretch:
    start = record.delayed.iloc[start_row].astype(np.float64)
    time = imu.index.to_numpy()
    first_row = int(np.argmin(np.abs(time - record.delayed.index[start_row])))
    rows = slice(first_row, int(np.searchsorted(time, end_s, side="right")))
    time, imu = time[rows], imu.iloc[rows]
    interval = np.diff(time)
    end_stamps = rows_of_timestamps(time, record.delayed.index)
    ends = step_ends(interval, end_stamps, predict_s(record))
    bias = np.asarray(start[Columns.ACCELEROMETER_BIAS])
    rate = imu[Columns.ANGULAR_RATE].to_numpy()[1:] - np.asarray(start[Columns.GYRO_BIAS])
    force = imu[Columns.SPECIFIC_FORCE].to_numpy()[1:] - bias
    turn, gain = down_sampled(rate * interval[:, None], force * interval[:, None], ends)
    times = time[np.concatenate([[0], ends])]
    step = np.diff(times)
    gyro = cumulative_product(np.concatenate([[[1.0, 0.0, 0.0, 0.0]], from_vector(turn)]))

    def attitude_beyond(
        frame: pd.DataFrame, early_s: float, end_stamps: Array
    ) -> tuple[Array, Array]:
        """Return times and rotations of a frame beyond the known attitudes."""
        inside = (frame.index >= times[0] - early_s) & (frame.index <= times[-1])
        at_s, own = frame.index[inside].to_numpy(), frame.loc[inside, Columns.QUATERNION].to_numpy()
        return at_s, multiply(own, conjugate(interpolate(at_s, times, end_stamps)))

    # rotation of the published attitude beyond the gyro, earth frame
    extra_rotation = interpolate(times, *attitude_beyond(attitude, 0.0, gyro))
    nominal = multiply(extra_rotation, gyro)
    states, turned_states = attitude_beyond(record.delayed, 1e-4, nominal)
    error = to_vector(turned_states)
    published = [np.interp(times[0], ekf2.state.index, ekf2.state[c]) for c in Columns.POSITION]
    position = start[Columns.POSITION].to_numpy()
    position = np.where(np.isfinite(position), position, published)
    position[2] = published[2]  # altitude and height have different origins from v1.16 on
    return Stretch(
        time_s=times,
        step_s=step,
        rotation=to_matrix(nominal),
        correction_rad=to_vector(multiply(extra_rotation[1:], conjugate(extra_rotation[:-1]))),
        force_m_s2=gain / step[:, None],
        accelerometer_bias_m_s2=bias,
        state=np.concatenate([error[0], start[Columns.VELOCITY], position, np.zeros(6)]),
        variance=np.asarray(start[Columns.DELAYED_VARIANCE[:15]]),
        down_m=_interpolate(ekf2.state["down_m"], times),
        attitude_variance_rad2=np.column_stack(
            [_interpolate(record.delayed[name], times) for name in Columns.DELAYED_VARIANCE[:3]]
        ),
        down_variance_m2=_interpolate(record.delayed["down_m2"], times),
        attitude_error_rad=np.column_stack(
            [np.interp(times, states, component) for component in error.T]
        ),
        correlation=np.eye(15),
    )


def _field_span(record: FusionRecord) -> tuple[float, float] | None:
    """Return start and end (s) of continuous three-axis magnetometer fusion, or None."""
    fused = record.field_gauss["fused_3d"] if len(record.field_gauss) else pd.Series(dtype=float)
    times, is_fused = fused.index.to_numpy(), fused.to_numpy() > 0.0
    if not is_fused.any() or 1.0 / np.median(np.diff(times)) < MIN_FIELD_HZ:
        return None
    first, last = np.flatnonzero(is_fused)[[0, -1]]
    if not is_fused[first:last].all():
        return None
    return float(times[first]) + FIELD_AFTER_S, float(times[last])


def _add_field(stretch: Stretch, record: FusionRecord, start_row: int, step_s: float) -> Stretch:
    """Return the stretch with the magnetic fields as states."""
    start, frame = record.delayed.iloc[start_row], record.field_gauss
    stamps = frame.index.to_numpy()
    age_s = record.parameters.get("EKF2_MAG_DELAY", 0.0) * 1e-3 + 0.5 * step_s
    weight = max(FIELD_HZ * float(np.median(np.diff(stamps))), 1.0)
    gauss = frame.iloc[:, :3].to_numpy()
    fields = np.asarray(start[[*Columns.EARTH_FIELD, *Columns.BODY_FIELD]])
    variance = np.asarray(start[Columns.DELAYED_VARIANCE[-6:]])
    extended = add_field_states(stretch, stamps - age_s, gauss, weight, fields, variance)
    if Columns.FIELD_INNOVATION[0] not in frame:
        return extended
    filtered_gauss = frame[Columns.FIELD_INNOVATION].to_numpy()
    return replace(
        extended, field=_mean_field(stretch, record.delayed, stamps - age_s, filtered_gauss)
    )


def _mean_field(
    stretch: Stretch, delayed: pd.DataFrame, taken_s: Array, filtered_gauss: Array
) -> SensorSamples:
    """Return means of the field between two rows, from EKF2's low-pass filtered innovations.

    An innovation is the predicted minus the measured field, and the prediction is known.
    """
    between_s = np.diff(taken_s)
    is_inside = (taken_s[:-1] > stretch.time_s[0]) & (taken_s[1:] <= stretch.time_s[-1])
    rows = np.flatnonzero(is_inside & (between_s > 0.0) & (between_s < RESTART_GAP_S)) + 1
    taken_s, between_s = taken_s[rows], between_s[rows - 1]
    count = np.maximum(np.rint(FIELD_HZ * between_s), 1.0)
    share = between_s / (between_s + count * FILTER_S)
    decay = ((1.0 - share) ** count)[:, None]
    innovation = (filtered_gauss[rows] - decay * filtered_gauss[rows - 1]) / (1.0 - decay)
    step, weight = low_passed(stretch, taken_s, count, between_s / count, share)
    turn = stretch.rotation[step].swapaxes(2, 3)
    earth, body = (
        np.column_stack([np.interp(taken_s, delayed.index, delayed[name]) for name in names])
        for names in (Columns.EARTH_FIELD, Columns.BODY_FIELD)
    )
    rotated_earth_field = earth[:, None] - np.cross(
        stretch.attitude_error_rad[step], earth[:, None]
    )
    expected = np.einsum("ki,kiab,kib->ka", weight, turn, rotated_earth_field) + body
    mean = np.einsum("ki,kiab->kab", weight, turn)
    return SensorSamples(step[:, 0], expected - innovation, mean, count, np.zeros(len(rows)))


def low_passed(
    stretch: Stretch, newest_s: Array, count: Array, interval_s: Array, share: Array | float
) -> tuple[IntArray, Array]:
    """Return the steps of the samples behind a low-pass filtered mean, and their weights.

    Parameters
    ----------
    newest_s, count, interval_s : ndarray, shape (m,)
        Time of the newest sample of each mean, number of samples, and their interval.
    share : float or ndarray, shape (m,)
        Weight of a new sample in the low-pass filter.

    Returns
    -------
    step, weight : ndarray, shape (m, k)
        Newest first, with k the largest number of samples.
    """
    back = np.arange(int(count.max(initial=1.0)))
    weight = np.where(back < count[:, None], (1.0 - np.reshape(share, (-1, 1))) ** back, 0.0)
    weight /= weight.sum(axis=1, keepdims=True)
    taken_s = newest_s[:, None] - back * interval_s[:, None]
    return np.searchsorted(stretch.time_s, taken_s - 1e-9), weight


def add_field_states(
    stretch: Stretch, taken_s: Array, gauss: Array, weight: float, fields: Array, variance: Array
) -> Stretch:
    """Add the fields of earth and body to the states, uncorrelated with the others.

    Parameters
    ----------
    taken_s, gauss : ndarray, shape (m,) and (m, 3)
        Magnetometer samples (body FRD) at EKF2's measurement time.
    weight : float
        Number of EKF2 samples per logged sample.
    fields, variance : ndarray, shape (6,)
        At the start: earth (NED) and body (FRD).
    """
    step, inside = sample_steps(stretch, taken_s)
    turn, count = stretch.rotation[step].transpose(0, 2, 1), len(step)
    return replace(
        stretch,
        state=np.concatenate([stretch.state, fields]),
        variance=np.concatenate([stretch.variance, variance]),
        correlation=block_diag(stretch.correlation, np.eye(len(fields))),
        field=SensorSamples(step, gauss[inside], turn, np.full(count, weight), np.zeros(count)),
    )


def sample_steps(stretch: Stretch, taken_s: Array) -> tuple[IntArray, BoolArray]:
    """Return the prediction step after which each sample is fused, and True for samples inside."""
    step = np.searchsorted(stretch.time_s, taken_s - 1e-9)
    is_inside = (step > 0) & (step < len(stretch.time_s))
    return step[is_inside], is_inside


def predict_s(record: FusionRecord) -> float:
    """Return EKF2_PREDICT_US in seconds."""
    return record.parameters.get("EKF2_PREDICT_US", 10_000.0) * 1e-6


def _interpolate(series: pd.Series, times: Array) -> Array:
    return np.asarray(np.interp(times, series.index, series))


def step_ends(interval_s: Array, known: IntArray, target_s: float) -> IntArray:
    """Return the ends of EKF2's prediction steps, as numbers of IMU intervals from the start.

    A step ends after :func:`samples_per_step` samples, or when it is longer than the target. Logged
    ends restart the count.

    Parameters
    ----------
    interval_s : ndarray, shape (n,)
        IMU intervals after the start.
    known : ndarray of int
        Logged ends, increasing; may include the start.
    target_s : float
        EKF2_PREDICT_US.

    Returns
    -------
    ndarray of int
        The last one is at most n.
    """
    samples_needed = samples_per_step(target_s, float(np.median(interval_s)), known)
    known_ends = set(known.tolist())
    ends, count, total = [], 0, 0.0
    for sample, interval in enumerate(interval_s.tolist(), start=1):
        count, total = count + 1, total + interval
        is_complete = count >= samples_needed and total > 0.5 * target_s
        if is_complete or total > target_s or sample in known_ends:
            ends.append(sample)
            count, total = 0, 0.0
    return np.array(ends, dtype=np.intp)


def down_sampled(turn: Array, gain: Array, ends: IntArray) -> tuple[Array, Array]:
    """Return rotation and velocity change of each step, in the body frame at its end."""
    starts = np.concatenate([[0], ends[:-1]])
    turned = np.concatenate([np.zeros((1, 3)), np.cumsum(turn, axis=0)])
    total = turned[ends] - turned[starts]
    count = ends - starts
    of_step = np.repeat(np.arange(len(ends)), count)
    used_rows = slice(0, int(ends[-1]))
    remaining_turn = turned[ends][of_step] - 0.5 * (turned[:-1][used_rows] + turned[1:][used_rows])
    seen_from_end = gain[used_rows] - np.cross(remaining_turn, gain[used_rows])
    return total, np.add.reduceat(seen_from_end, starts, axis=0)
