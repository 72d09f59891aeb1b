"""The parts of a flight that the model replays in one go: prediction steps and where to start.

Sources: PX4-Autopilot ``EKF/imu_down_sampler/imu_down_sampler.cpp``.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import pandas as pd
from scipy.linalg import block_diag

from px4fuse.arrays import Array, BoolArray, IntArray
from px4fuse.display import one_line_repr
from px4fuse.ekf2.earth import earth_rate_rad_s, metres_of
from px4fuse.flight import BAD_ACCELERATION, Columns, Ekf2, Flight, FusionRecord, Unavailable
from px4fuse.readers.px4_ekf2 import rows_of_stamps, samples_per_step
from px4fuse.trajectory.rotation import (
    conjugate,
    from_vector,
    interpolate,
    matrix,
    multiply,
    running_product,
    to_vector,
)

# Without source or IMU for longer than this the model starts again from the log: other things
# then move EKF2 (gravity, fake position, zero velocity), which the model does not have
RESTART_GAP_S = 2.0
# PX4 limits a prediction step to twice EKF2_PREDICT_US, so that a longer gap is lost motion
IMU_GAP_S = 0.05
# Fusion must have run so long when the model starts, and the model so long before it is judged
START_AFTER_S = 1.0
# and the vehicle so long off the ground: on it EKF2 fuses zero velocity and gravity, and taking off
# settles what is tilt and what is accelerometer bias
AIRBORNE_S = 4.0
SETTLING_S = 5.0
# EKF2 resets heading and fields when the vehicle has taken off; what the log has is of after that
FIELD_AFTER_S = 1.0
# So long before the start begins what the correlations there come of, where the log has it
HISTORY_S = 20.0
# EKF2 fuses 14 samples of the field a second (SENS_MAG_RATE is 15): one of fewer that are in the
# log stands for several, down to this rate
FIELD_HZ, MIN_FIELD_HZ = 14.0, 1.5
# Time constant of EKF2's low pass of innovations (updateAidSourceStatus, ekf_helper.cpp)
FILTER_S = 0.5
MIN_STRETCH_S = 10.0
# Resets are published up to the longest delay and a row of the log later
MAX_RESET_DELAY_S = 0.5
# Of the samples in a second: more clipped ones are lost motion
MAX_CLIPPED_SHARE = 0.05

GRAVITY_M_S2 = np.array([0.0, 0.0, 9.80665])  # CONSTANTS_ONE_G


# States, of Stretch.state
STATES = 15
IMU_STATE_COUNT = 9  # of them, those that the IMU moves: all but the biases
THETA, VELOCITY, POSITION = slice(0, 3), slice(3, 6), slice(6, 9)
GYRO_BIAS, ACCELEROMETER_BIAS, BIASES = slice(9, 12), slice(12, 15), slice(9, 15)
EARTH_FIELD, BODY_FIELD = slice(15, 18), slice(18, 21)  # NED and FRD, where they are fused


@dataclass(frozen=True)
class SensorSamples:
    """What the magnetometer or optical flow measured in one stretch, in m means of some samples.

    Attributes
    ----------
    step : ndarray of int, shape (m,)
        At the end of which prediction step EKF2 takes the last sample of each.
    value : ndarray, shape (m, k)
        The field in the body (gauss, FRD); or the velocity forward and to the right (m/s), less
        what the IMU gained of it since the stretch began.
    turn : ndarray, shape (m, k, 3)
        Mean rotation from NED to these.
    samples : ndarray, shape (m,)
        How many EKF2 had.
    noise : ndarray, shape (m,)
        R of one sample, where the settings do not have it; else 0.
    gate : float
        In standard deviations, where the settings do not have it.
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
    """What EKF2's height rests on in one stretch.

    Attributes
    ----------
    fused : tuple of str
        PX4's names of its sensors: of the barometer, of GNSS, or of both.
    reference : str
        The one that has no bias.
    bias : (float, float)
        By how much the other one is too high at the start (m), and its variance (m²).
    step : ndarray of int, shape (m,)
        At the end of which prediction step EKF2 takes each sample of the barometer.
    taken_s, down_m : ndarray, shape (m,)
        When it takes it to have been measured, and what it is.
    dead_m : ndarray, shape (m,)
        By how much it may be below the state unheeded: in ground effect.
    weight : float
        Samples that EKF2 had for each one in the log.
    """

    fused: tuple[str, ...]
    reference: str
    bias: tuple[float, float]
    step: IntArray
    taken_s: Array
    down_m: Array
    dead_m: Array
    weight: float

    __repr__ = one_line_repr


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
        By how much the nominal attitude turns in each step beyond what the gyro measured of the
        vehicle, less how the earth turned.
    force_m_s2 : ndarray, shape (n, 3)
        Specific force of the body in each step, nominal bias removed, in the frame at its end.
    accelerometer_bias_m_s2 : ndarray, shape (3,)
        Nominal bias: the log's at the start.
    state : ndarray, shape (15,) or (21,)
        At the start: attitude error, velocity, position, errors of both biases, magnetic fields.
    variance : ndarray, shape (15,) or (21,)
        At the start, in the same order.
    down_m : ndarray, shape (n + 1,)
        Published height.
    attitude_variance_rad2 : ndarray, shape (n + 1, 3)
    down_variance_m2 : ndarray, shape (n + 1,)
        As the log has them.
    attitude_error_rad : ndarray, shape (n + 1, 3)
        Of EKF2's own filter at its horizon, against the nominal attitude.
    correlation : ndarray, shape (n, n)
        Of the state at the start; the log has variances only.
    fusing : bool
        Whether EKF2 fuses the source when it begins.
    field : Sensed or None
        What the magnetometer measured: then the magnetic fields are states too, and there are 21;
        None: the heading is EKF2's own as flown, whatever is changed.
    heights : Heights or None
        None: the height is EKF2's own as flown, or vision's.
    distrusted_share : ndarray, shape (n + 1,), or None
        Share of the accelerometer's axes that EKF2 relied on less in the step before: all while it
        took the vertical acceleration to be wrong, else those at the end of their range (of the
        axes together, as R turns them); None: never any.
    flow : Sensed or None
        What optical flow measured, where EKF2 fused it.
    metres : (float, float, float)
        What a metre of a track is in those of the state's position.
    history : Stretch or None
        What came before, up to its start: the correlations at the start come of that.
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
    distrusted_share: Array | None = None
    flow: SensorSamples | None = None
    metres: tuple[float, float, float] = (1.0, 1.0, 1.0)
    history: "Stretch | None" = None

    __repr__ = one_line_repr

    @cached_property
    def gained_m_s(self) -> Array:
        """Velocity gained since the start by the IMU alone, at each step's end, (n + 1, 3)."""
        force = np.einsum("nij,nj->ni", self.rotation[1:], self.force_m_s2) + GRAVITY_M_S2
        gained = np.cumsum(force * self.step_s[:, None], axis=0)
        return np.concatenate([np.zeros((1, 3)), gained])

    @cached_property
    def path_m(self) -> Array:
        """Way since the start by the IMU alone, from rest, at each step's end, (n + 1, 3)."""
        speed = self.gained_m_s
        path = np.cumsum(0.5 * (speed[1:] + speed[:-1]) * self.step_s[:, None], axis=0)
        return np.concatenate([np.zeros((1, 3)), path])


def samples_by_event(
    stretch: Stretch, end: IntArray, step: IntArray, position_m: Array, axes: slice, *more: Array
) -> Array:
    """Positions by the event at which they are fused, for the k that come in one interval at most.

    Parameters
    ----------
    stretch : Stretch
    end : ndarray of int, shape (E,)
        Step of each event.
    step : ndarray of int, shape (m,)
        At the end of which each position is taken; increasing.
    position_m : ndarray, shape (m, a)
    axes : slice
        Which of north, east and down they are.
    *more : ndarray, shape (m,)

    Returns
    -------
    ndarray, shape (a + 2 + len(more), k, E)
        Position at the event, as if the vehicle had stood still since, age then, ``more``, and 1;
        all 0 where there is none.
    """
    event = np.searchsorted(end, step)
    event = event[event < len(end)]
    count = len(event)
    step, event_step = step[:count], end[event]
    age_s = stretch.time_s[event_step] - stretch.time_s[step]
    path, speed = stretch.path_m[:, axes], stretch.gained_m_s[:, axes]
    position_m = (
        position_m[:count] + path[event_step] - path[step] - speed[event_step] * age_s[:, None]
    )
    slot = np.arange(count) - np.searchsorted(event, event)
    sample_columns = *position_m.T, age_s, *(each[:count] for each in more), np.ones(count)
    samples = np.zeros((len(sample_columns), slot.max(initial=-1) + 1, len(end)))
    samples[:, slot, event] = sample_columns
    return samples


def pad_samples(sample_arrays: Sequence[Array]) -> list[Array]:
    """The same of :func:`samples_by_event` for several sets of events, with room for as many in each."""
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
    """Parts of a flight without gaps in IMU and positions, from when EKF2 has fused for a while.

    Parameters
    ----------
    flight : Flight
        For when it is airborne.
    imu, attitude : DataFrame
    ekf2 : Ekf2
    record : FusionRecord
    source_s : ndarray
        Stamps of what EKF2's position rests on.
    gnss : bool
        Whether EKF2 fuses GNSS: then the magnetic fields are states, where the log allows it, and
        an acceleration that is wrong or clipped is relied on less.
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
    # another instance has states of its own
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
    """A stretch on an earth that turns, where bad accelerations are relied on less."""
    stretch = _on_rotating_earth(_stretch(imu, attitude, ekf2, record, start_row, end_s), record)
    return replace(stretch, distrusted_share=_distrusted_share(imu, record, stretch.time_s))


def _on_rotating_earth(stretch: Stretch, record: FusionRecord) -> Stretch:
    """The same stretch on an earth that turns, its position in EKF2's own metres."""
    metres, state = metres_of(record), stretch.state.copy()
    state[POSITION] *= metres
    turned = earth_rate_rad_s(record) * stretch.step_s[:, None]
    return replace(
        stretch, state=state, metres=metres, correction_rad=stretch.correction_rad + turned
    )


def _break_times_s(imu: pd.DataFrame, ekf2: Ekf2) -> list[float]:
    """Beginnings and ends of what the model cannot follow.

    Many clipped samples, which lose motion as a gap does, and resets of EKF2's height and vertical
    velocity, which are published a while after.
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


def _distrusted_share(imu: pd.DataFrame, record: FusionRecord, time_s: Array) -> Array:
    """Share of the accelerometer's axes that are relied on less, at the end of each step."""
    share_by_step = record.was_in_state(BAD_ACCELERATION, time_s).astype(float)
    if "clipped" in imu:  # a bit for each axis
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
    end_stamps = rows_of_stamps(time, record.delayed.index)
    ends = step_ends(interval, end_stamps, predict_s(record))
    bias = np.asarray(start[Columns.ACCELEROMETER_BIAS])
    rate = imu[Columns.ANGULAR_RATE].to_numpy()[1:] - np.asarray(start[Columns.GYRO_BIAS])
    force = imu[Columns.SPECIFIC_FORCE].to_numpy()[1:] - bias
    turn, gain = down_sampled(rate * interval[:, None], force * interval[:, None], ends)
    times = time[np.concatenate([[0], ends])]
    step = np.diff(times)
    gyro = running_product(np.concatenate([[[1.0, 0.0, 0.0, 0.0]], from_vector(turn)]))

    def attitude_beyond(
        frame: pd.DataFrame, early_s: float, end_stamps: Array
    ) -> tuple[Array, Array]:
        """Times of a frame's attitudes, and what they have beyond the known ones at the steps."""
        inside = (frame.index >= times[0] - early_s) & (frame.index <= times[-1])
        at_s, own = frame.index[inside].to_numpy(), frame.loc[inside, Columns.QUATERNION].to_numpy()
        return at_s, multiply(own, conjugate(interpolate(at_s, times, end_stamps)))

    # what the published attitude has beyond the gyro's, in the earth frame
    extra_rotation = interpolate(times, *attitude_beyond(attitude, 0.0, gyro))
    nominal = multiply(extra_rotation, gyro)
    states, turned_states = attitude_beyond(record.delayed, 1e-4, nominal)
    error = to_vector(turned_states)
    published = [np.interp(times[0], ekf2.state.index, ekf2.state[c]) for c in Columns.POSITION]
    position = start[Columns.POSITION].to_numpy()
    position = np.where(np.isfinite(position), position, published)
    position[2] = published[2]  # altitude and height have different origins since v1.16
    return Stretch(
        time_s=times,
        step_s=step,
        rotation=matrix(nominal),
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
    """From when to when EKF2 fused all of the field, without a break, once it was settled."""
    fused = record.field_gauss["fused_3d"] if len(record.field_gauss) else pd.Series(dtype=float)
    times, is_fused = fused.index.to_numpy(), fused.to_numpy() > 0.0
    if not is_fused.any() or 1.0 / np.median(np.diff(times)) < MIN_FIELD_HZ:
        return None
    first, last = np.flatnonzero(is_fused)[[0, -1]]
    if not is_fused[first:last].all():
        return None
    return float(times[first]) + FIELD_AFTER_S, float(times[last])


def _add_field(stretch: Stretch, record: FusionRecord, start_row: int, step_s: float) -> Stretch:
    """The same stretch with the magnetic fields among its states."""
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
    """Of the field, means of all samples between two rows, by EKF2's low pass of its innovations.

    An innovation is what EKF2 expected minus what was measured, and what it expected is known.
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
    """Of the samples that a low pass has the mean of: at which steps, and for how much each counts.

    Parameters
    ----------
    newest_s, count, interval_s : ndarray, shape (m,)
        When the newest of each mean was taken, how many there are, and how far apart.
    share : float or ndarray, shape (m,)
        Of a new sample in the low pass.

    Returns
    -------
    step, weight : ndarray, shape (m, k)
        Newest first, for the k of the longest.
    """
    back = np.arange(int(count.max(initial=1.0)))
    weight = np.where(back < count[:, None], (1.0 - np.reshape(share, (-1, 1))) ** back, 0.0)
    weight /= weight.sum(axis=1, keepdims=True)
    taken_s = newest_s[:, None] - back * interval_s[:, None]
    return np.searchsorted(stretch.time_s, taken_s - 1e-9), weight


def add_field_states(
    stretch: Stretch, taken_s: Array, gauss: Array, weight: float, fields: Array, variance: Array
) -> Stretch:
    """The same stretch with the fields of earth and body among its states, uncorrelated with them.

    Parameters
    ----------
    taken_s, gauss : ndarray, shape (m,) and (m, 3)
        Samples of the magnetometer (body FRD), by the time that EKF2 takes them to be of.
    weight : float
        Samples that EKF2 had for each.
    fields, variance : ndarray, shape (6,)
        At the start, of earth (NED) and body.
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
    """Step at the end of which each sample in a stretch is taken, and which samples those are."""
    step = np.searchsorted(stretch.time_s, taken_s - 1e-9)
    is_inside = (step > 0) & (step < len(stretch.time_s))
    return step[is_inside], is_inside


def predict_s(record: FusionRecord) -> float:
    """EKF2_PREDICT_US (s)."""
    return record.parameters.get("EKF2_PREDICT_US", 10_000.0) * 1e-6


def _interpolate(series: pd.Series, times: Array) -> Array:
    return np.asarray(np.interp(times, series.index, series))


def step_ends(interval_s: Array, known: IntArray, target_s: float) -> IntArray:
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
    """Turn and velocity gained in each step, the gain in the body's frame at the step's end."""
    starts = np.concatenate([[0], ends[:-1]])
    turned = np.concatenate([np.zeros((1, 3)), np.cumsum(turn, axis=0)])
    total = turned[ends] - turned[starts]
    count = ends - starts
    of_step = np.repeat(np.arange(len(ends)), count)
    used_rows = slice(0, int(ends[-1]))
    remaining_turn = turned[ends][of_step] - 0.5 * (turned[:-1][used_rows] + turned[1:][used_rows])
    seen_from_end = gain[used_rows] - np.cross(remaining_turn, gain[used_rows])
    return total, np.add.reduceat(seen_from_end, starts, axis=0)
