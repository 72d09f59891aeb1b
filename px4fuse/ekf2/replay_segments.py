"""Flight segments without gaps for the EKF2 replay: prediction steps and initial state.

Source: PX4-Autopilot ``EKF/imu_down_sampler/imu_down_sampler.cpp``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from dataclasses import field as record_field
from functools import cached_property
from itertools import chain, pairwise

import numpy as np
import pandas as pd
from scipy.linalg import block_diag

from px4fuse.core.arrays import (
    Array,
    ArrayPair,
    BoolArray,
    IntArray,
    compute_median_interval_s,
    cumulative_sums,
    row_blocks,
)
from px4fuse.core.record import Span
from px4fuse.ekf2.earth_model import compute_earth_rate_rad_s, compute_position_scale
from px4fuse.flight.ekf2_parameters import PARAMETERS
from px4fuse.flight.model import (
    BAD_ACCELERATION_FLAG,
    Columns,
    Ekf2,
    Flight,
    FusionRecord,
    NedAxis,
    Unavailable,
    rows_between,
    time_index,
)
from px4fuse.readers.px4_ekf2 import compute_samples_per_step, find_rows_of_timestamps
from px4fuse.trajectory.rotation import (
    conjugate,
    cumulative_product,
    from_vector,
    interpolate,
    multiply,
    rotate,
    to_matrix,
    to_vector,
)

# After a longer gap (s) in the position source, the replay restarts from the logged state. In gaps
# EKF2 fuses gravity, fake positions or zero velocity, which the model does not contain
RESTART_GAP_S = 2.0
# Longer IMU intervals (s) interrupt the replay: EKF2 limits a prediction step to 2 EKF2_PREDICT_US
IMU_GAP_S = 0.05
# Minimum time (s) from EKF2's first position fusion to the start of the replay
MIN_FUSION_S = 1.0
# Minimum time (s) from take-off to the start of the replay: on the ground, EKF2 also fuses zero
# velocity and gravity
MIN_TIME_SINCE_TAKEOFF_S = 4.0
# Time (s) from the start of a replay to the start of the evaluation
REPLAY_SETTLING_S = 5.0
# EKF2's first fusion of all magnetometer axes resets the field states. Logged field states are used
# from this time (s) after the first fusion on
MAGNETIC_FIELD_SETTLING_S = 1.0
# Flight time (s) before the replay that is used to estimate correlations of the initial state
STATE_CORRELATION_HISTORY_S = 20.0
# Rate (Hz) at which EKF2 fuses the magnetometer with SENS_MAG_RATE 15 (default)
MAG_FUSION_HZ = 14.0
# Minimum rate (Hz) of the logged magnetometer for a replay of its fusion
MIN_MAG_LOG_HZ = 1.5
# Time constant (s) of EKF2's low-pass filter of innovations (updateAidSourceStatus, ekf_helper.cpp)
INNOVATION_TIME_CONSTANT_S = 0.5
# Minimum length (s) of a replayed segment
MIN_SEGMENT_DURATION_S = 10.0
# Maximum delay (s) from a reset to its publication
MAX_RESET_DELAY_S = 0.5
# The EKF2 replay is interrupted if a larger fraction of the IMU samples within 1 s is clipped
MAX_CLIPPED_FRACTION = 0.05
# If a smaller fraction of the IMU samples is missing, the EKF2 replay ignores it
MAX_LOST_IMU_FRACTION = 0.02

# Gravity in NED (CONSTANTS_ONE_G in PX4)
GRAVITY_M_S2 = np.array([0.0, 0.0, 9.80665])

# Number of states without magnetic fields
STATE_COUNT = 15
# Number of states that the IMU propagates: all except the biases
IMU_STATE_COUNT = 9
# State indices of attitude error, velocity, position and biases
THETA, VELOCITY, POSITION = slice(0, 3), slice(3, 6), slice(6, 9)
GYRO_BIAS, ACCELEROMETER_BIAS, BIASES = slice(9, 12), slice(12, 15), slice(9, 15)
# State indices of the earth field (NED) and the body field (FRD), if there are 21 states
EARTH_FIELD, BODY_FIELD = slice(15, 18), slice(18, 21)


@dataclass(frozen=True)
class SensorSamples:
    """Means of successive magnetometer or optical flow samples in one segment, m in total.

    Attributes
    ----------
    step_indices : ndarray of int, shape (m,)
        Prediction step that fuses the last sample of each mean.
    value : ndarray, shape (m, k)
        Magnetic field (gauss, FRD), or optical flow velocity forward and right minus the velocity
        change from the IMU since the start of the segment (m/s).
    rotation_to_body : ndarray, shape (m, k, 3)
        Mean rotation from NED to the body axes.
    sample_count : ndarray, shape (m,)
    noise : ndarray, shape (m,)
        R of one sample; 0 if an EKF2 parameter determines R.
    gate : float
        Innovation gate in √S; infinite if an EKF2 parameter determines the gate.
    state_rows : tuple of slice
        State indices of the measured vector (NED; for example the earth field) and, optionally, of
        the sensor's bias vector (body frame).
    """

    step_indices: IntArray
    value: Array
    rotation_to_body: Array
    sample_count: Array
    noise: Array
    gate: float = np.inf
    state_rows: tuple[slice, ...] = (EARTH_FIELD, BODY_FIELD)


@dataclass(frozen=True)
class HeightSamples:
    """Height measurements of one segment of the EKF2 replay.

    Attributes
    ----------
    fused_sensors : tuple of str
        PX4's names of the fused height sensors.
    reference : str
        PX4's name of the height reference, which has no bias.
    initial_bias_and_variance : (float, float)
        Initial bias of the sensor that is not the reference (m, positive: too high), and its
        variance (m²).
    step_indices, measurement_times_s, down_m : ndarray, shape (m,)
        Prediction step, measurement time, and height (m, down) of each barometer sample.
    dead_zone_m : ndarray, shape (m,)
        EKF2 reduces the innovation of a height below the state by up to this distance (ground
        effect).
    weight : ndarray, shape (m,)
        Number of barometer samples fused by EKF2 that each sample represents.
    """

    fused_sensors: tuple[str, ...]
    reference: str
    initial_bias_and_variance: tuple[float, float]
    step_indices: IntArray
    measurement_times_s: Array
    down_m: Array
    dead_zone_m: Array
    weight: Array


@dataclass(frozen=True)
class ReplaySegment:
    """Part of a flight without gaps, which is replayed with n prediction steps.

    The model estimates the error of a nominal attitude, which is EKF2's published attitude. Vectors
    are in NED, if not stated otherwise.

    Attributes
    ----------
    time_s : ndarray, shape (n + 1,)
        Start of the first step, then end of each step.
    body_to_ned : ndarray, shape (n + 1, 3, 3)
        Nominal attitude.
    correction_rad : ndarray, shape (n, 3)
        Rotation of the nominal attitude in each step minus rotation measured by the gyro.
    force_m_s2 : ndarray, shape (n, 3)
        Specific force minus nominal bias, in the body frame at the end of the step.
    accelerometer_bias_m_s2 : ndarray, shape (3,)
        Nominal accelerometer bias: the logged bias at the start.
    state, variance : ndarray, shape (15,) or (21,)
        Initial attitude error, velocity, position, bias errors, and magnetic fields.
    down_m, down_variance_m2 : ndarray, shape (n + 1,)
        Published height (positive down), and its variance.
    attitude_error_rad, attitude_variance_rad2 : ndarray, shape (n + 1, 3)
        Logged attitude minus nominal attitude, and its variance.
    state_correlation : ndarray, shape (15, 15) or (21, 21)
        Estimated correlations of the initial state.
    field, flow : SensorSamples or None
    height_samples : HeightSamples or None
    clipped_fraction : ndarray, shape (n + 1,), or None
        Fraction of the accelerometer axes that are clipped in the step.
    is_acceleration_bad : ndarray of bool, shape (n + 1,), or None
        Logged flag for a bad vertical acceleration.
    mean_bias_down_m_s2 : float
        Mean vertical accelerometer bias, computed from the published velocity.
    position_scale : (float, float, float)
        Ratio of EKF2's internal to its published position along each axis.
    preceding_segment : ReplaySegment or None
        Flight before the start, from which the correlations are estimated.
    changed_parameters : mapping from PX4's name to float
        Parameters that were changed in flight.
    """

    time_s: Array
    step_s: Array
    body_to_ned: Array
    correction_rad: Array
    force_m_s2: Array
    accelerometer_bias_m_s2: Array
    state: Array
    variance: Array
    down_m: Array
    attitude_variance_rad2: Array
    down_variance_m2: Array
    attitude_error_rad: Array
    state_correlation: Array
    is_fusing: bool = True
    field: SensorSamples | None = None
    height_samples: HeightSamples | None = None
    clipped_fraction: Array | None = None
    is_acceleration_bad: BoolArray | None = None
    mean_bias_down_m_s2: float = 0.0
    flow: SensorSamples | None = None
    position_scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    preceding_segment: "ReplaySegment | None" = None
    changed_parameters: Mapping[str, float] = record_field(default_factory=dict)

    @cached_property
    def imu_velocity_change_m_s(self) -> Array:
        """Velocity change (m/s, NED) since the start, integrated from the IMU, shape (n + 1, 3)."""
        acceleration_m_s2 = rotate(self.body_to_ned[1:], self.force_m_s2) + GRAVITY_M_S2
        return cumulative_sums(acceleration_m_s2 * self.step_s[:, None])

    @cached_property
    def imu_displacement_m(self) -> Array:
        """Displacement (m, NED) since the start, integrated from the IMU, shape (n + 1, 3)."""
        velocity = self.imu_velocity_change_m_s
        return cumulative_sums(0.5 * (velocity[1:] + velocity[:-1]) * self.step_s[:, None])


def group_samples_by_event(
    segment: ReplaySegment,
    event_steps: IntArray,
    measurement_steps: IntArray,
    position_m: Array,
    axes: slice,
    *quantities: Array,
) -> Array:
    """Group position samples by event: each event fuses the samples since the previous one.

    Parameters
    ----------
    segment : ReplaySegment
    event_steps : ndarray of int, shape (events,)
        Prediction step of each event.
    measurement_steps : ndarray of int, shape (m,)
        Prediction step of each sample, increasing.
    position_m : ndarray, shape (m, a)
    axes : slice
        Axes of the position within NED.
    *quantities : ndarray, shape (m,)
        Further quantities of each sample.

    Returns
    -------
    ndarray, shape (a + 2 + len(quantities), k, events)
        Up to k samples per event. Rows: position, propagated to the event with the IMU; age (s);
        further quantities; and 1 for a sample, 0 for padding.
    """
    event_indices = np.searchsorted(event_steps, measurement_steps)
    event_indices = event_indices[event_indices < len(event_steps)]
    sample_count = len(event_indices)
    measurement_steps = measurement_steps[:sample_count]
    event_step = event_steps[event_indices]
    age_s = segment.time_s[event_step] - segment.time_s[measurement_steps]
    displacement_m = segment.imu_displacement_m[:, axes]
    velocity_m_s = segment.imu_velocity_change_m_s[:, axes]
    displacement_m = (
        displacement_m[event_step]
        - displacement_m[measurement_steps]
        - velocity_m_s[event_step] * age_s[:, None]
    )
    index_in_event = np.arange(sample_count) - np.searchsorted(event_indices, event_indices)
    position_m = position_m[:sample_count] + displacement_m
    columns = (
        *position_m.T,
        age_s,
        *(column[:sample_count] for column in quantities),
        np.ones(sample_count),
    )
    samples = np.zeros((len(columns), index_in_event.max(initial=-1) + 1, len(event_steps)))
    samples[:, index_in_event, event_indices] = columns
    return samples


def make_update_table(
    update_records: Array, measurement_times_s: Array, end_s: Array, axes: Sequence[NedAxis]
) -> pd.DataFrame:
    """Return the updates with one aiding source as a table, indexed by measurement time (s).

    Parameters
    ----------
    update_records : ndarray, shape (events, k, ...)
        For up to k samples of each event: innovations, their variances, and optionally further
        columns of the table in their order; NaN without a sample.
    measurement_times_s : ndarray, shape (events, k)
    end_s : ndarray, shape (events,)
        Time of each event.
    axes : sequence of str
    """
    has_innovation = np.isfinite(update_records[..., 0])
    columns = [
        *(f"innovation_{axis}_m" for axis in axes),
        *(f"innovation_variance_{axis}_m2" for axis in axes),
        "rejected",
        "fused",
        "reset",
        *(f"position_variance_{axis}_m2" for axis in axes),
        *(f"observation_variance_{axis}_m2" for axis in axes),
    ]
    updates = pd.DataFrame(
        update_records[has_innovation],
        time_index(measurement_times_s[has_innovation]),
        columns[: update_records.shape[-1]],
    )
    return updates.assign(fused_at_s=end_s[np.nonzero(has_innovation)[0]])


def pad_samples(sample_arrays: Sequence[Array]) -> list[Array]:
    """Pad arrays of :func:`group_samples_by_event` with zeros to the same k samples per event."""
    max_samples_per_event = max(samples.shape[1] for samples in sample_arrays)
    return [
        np.pad(samples, ((0, 0), (0, max_samples_per_event - samples.shape[1]), (0, 0)))
        for samples in sample_arrays
    ]


def find_replay_segments(
    flight: Flight,
    imu: pd.DataFrame,
    attitude: pd.DataFrame,
    ekf2: Ekf2,
    fusion_record: FusionRecord,
    position_times_s: Array,
    *,
    is_gnss: bool = False,
) -> tuple[ReplaySegment, ...]:
    """Find the parts of a flight without gaps in IMU and positions, after EKF2's first fusion.

    ``position_times_s`` contains the timestamps of the positions.
    """
    innovations = ekf2.innovations["north"]
    assert isinstance(innovations, pd.DataFrame)
    fusion_times_s = innovations.index.to_numpy()
    state_times_s = fusion_record.delayed.index.to_numpy()
    imu_times_s = imu.index.to_numpy()
    cut_times_s = [imu_times_s[0], imu_times_s[-1]]
    for sample_times_s, limit in ((imu_times_s, IMU_GAP_S), (position_times_s, RESTART_GAP_S)):
        gap_rows = np.flatnonzero(np.diff(sample_times_s) > limit)
        cut_times_s += [*sample_times_s[gap_rows], *sample_times_s[gap_rows + 1]]
    cut_times_s += _find_break_times_s(imu, ekf2) if is_gnss else ()
    earliest_start_s = max(attitude.index[0], position_times_s[0])
    end_s = min(attitude.index[-1], position_times_s[-1] + 1.0)
    airborne = () if isinstance(flight.airborne, Unavailable) else flight.airborne
    magnetic_field_span_s = _find_field_fusion_span(fusion_record) if is_gnss else None
    cut_times_s += magnetic_field_span_s[1:] if magnetic_field_span_s else ()
    # The replay restarts when another EKF2 instance becomes primary, because its state differs
    cut_times_s += [time_s for time_s, _ in ekf2.primary_instances[1:]]
    parameter_changes = [change for change in ekf2.parameter_changes if change.name in PARAMETERS]
    cut_times_s += [change.time_s for change in parameter_changes]

    def make_segment(start_row: int, end_s: float) -> ReplaySegment:
        segment = _make_segment(imu, attitude, ekf2, fusion_record, start_row, end_s)
        return _add_gnss_quantities(segment, imu, ekf2, fusion_record) if is_gnss else segment

    segments = []
    for part_start_s, part_end_s in pairwise(
        np.unique(np.clip(cut_times_s, earliest_start_s, end_s))
    ):
        fusion_times_in_part_s = fusion_times_s[
            (fusion_times_s >= part_start_s) & (fusion_times_s <= part_end_s)
        ]
        if not len(fusion_times_in_part_s):
            continue
        # The replay starts MIN_TIME_SINCE_TAKEOFF_S after the first take-off, if before part_end_s
        earliest_starts_s = [
            start_s + MIN_TIME_SINCE_TAKEOFF_S
            for start_s, _ in airborne[:1]
            if start_s < part_end_s
        ]
        if magnetic_field_span_s and part_start_s <= magnetic_field_span_s[0] < part_end_s:
            earliest_starts_s.append(magnetic_field_span_s[0])
        start_row = int(
            np.searchsorted(
                state_times_s, max([fusion_times_in_part_s[0] + MIN_FUSION_S, *earliest_starts_s])
            )
        )
        if (
            start_row == len(state_times_s)
            or part_end_s - state_times_s[start_row] < MIN_SEGMENT_DURATION_S
        ):
            continue
        is_covered = (imu_times_s[1:] > state_times_s[start_row]) & (imu_times_s[:-1] < part_end_s)
        if not np.all(np.diff(imu_times_s)[is_covered] <= IMU_GAP_S):
            continue
        changed_parameters = {
            change.name: change.value_after
            for change in parameter_changes
            if change.time_s <= part_start_s
        }
        segment = make_segment(start_row, part_end_s)
        history_start_row = int(
            np.searchsorted(
                state_times_s,
                max(earliest_start_s, state_times_s[start_row] - STATE_CORRELATION_HISTORY_S),
            )
        )
        if history_start_row < start_row:
            preceding_segment = make_segment(history_start_row, state_times_s[start_row])
            segment = replace(segment, preceding_segment=preceding_segment)
        if (
            magnetic_field_span_s
            and magnetic_field_span_s[0] <= state_times_s[start_row]
            and part_end_s <= magnetic_field_span_s[1]
        ):
            segment = _add_magnetic_field(segment, fusion_record, start_row, ekf2.step_s)
        segments.append(replace(segment, changed_parameters=changed_parameters))
    return tuple(segments)


def _add_gnss_quantities(
    segment: ReplaySegment, imu: pd.DataFrame, ekf2: Ekf2, fusion_record: FusionRecord
) -> ReplaySegment:
    """Add quantities that only the GNSS model uses.

    These are earth rotation, position scale, clipping and mean vertical bias of the accelerometer.
    """
    position_scale = compute_position_scale(fusion_record)
    initial_state = segment.state.copy()
    initial_state[POSITION] *= position_scale
    earth_rotation_rad = compute_earth_rate_rad_s(fusion_record) * segment.step_s[:, None]
    start_s, end_s = span_s = segment.time_s[[0, -1]]
    velocity_change_m_s = np.diff(np.interp(span_s, ekf2.state.index, ekf2.state["down_m_s"]))[0]
    velocity_error = segment.imu_velocity_change_m_s[-1, 2] - velocity_change_m_s
    return replace(
        segment,
        state=initial_state,
        position_scale=position_scale,
        correction_rad=segment.correction_rad + earth_rotation_rad,
        clipped_fraction=_compute_clipped_fraction(imu, segment.time_s),
        mean_bias_down_m_s2=float(velocity_error / (end_s - start_s)),
    )


def _find_break_times_s(imu: pd.DataFrame, ekf2: Ekf2) -> list[float]:
    """Return the times (s) at which the replay must be interrupted: clipping and height resets."""
    break_times_s = [
        time
        for reset in ekf2.resets
        if reset.delta[2]
        for time in (reset.time_s - MAX_RESET_DELAY_S, reset.time_s)
    ]
    if "clipped" in imu:
        imu_times_s = imu.index.to_numpy()
        clipped_times_s = imu_times_s[imu["clipped"].to_numpy() > 0.0]
        begin_rows, end_rows = (
            np.searchsorted(clipped_times_s, clipped_times_s + s) for s in (-0.5, 0.5)
        )
        heavy_clipping_times_s = clipped_times_s[
            end_rows - begin_rows > MAX_CLIPPED_FRACTION / compute_median_interval_s(imu_times_s)
        ]
        break_times_s += [*(heavy_clipping_times_s - 0.5), *(heavy_clipping_times_s + 0.5)]
    return break_times_s


def _compute_clipped_fraction(imu: pd.DataFrame, time_s: Array) -> Array:
    """Return the fraction of the three accelerometer axes that is clipped in each step."""
    clipped_fraction_by_step = np.zeros(len(time_s))
    # "clipped" has one bit per axis
    if "clipped" in imu:
        clipping_masks = imu.loc[(imu["clipped"] > 0.0) & (imu.index <= time_s[-1]), "clipped"]
        clipped_fraction = (
            np.unpackbits(clipping_masks.to_numpy(np.uint8)[:, None], axis=1).sum(axis=1) / 3.0
        )
        np.maximum.at(
            clipped_fraction_by_step,
            np.searchsorted(time_s, clipping_masks.index),
            clipped_fraction,
        )
    return clipped_fraction_by_step


def _make_segment(
    imu: pd.DataFrame,
    attitude: pd.DataFrame,
    ekf2: Ekf2,
    fusion_record: FusionRecord,
    start_row: int,
    end_s: float,
) -> ReplaySegment:
    initial_row = fusion_record.delayed.iloc[start_row].astype(np.float64)
    imu_times_s = imu.index.to_numpy()
    first_row = int(np.argmin(np.abs(imu_times_s - fusion_record.delayed.index[start_row])))
    segment_rows = slice(first_row, int(np.searchsorted(imu_times_s, end_s, side="right")))
    imu_times_s = imu_times_s[segment_rows]
    imu = imu.iloc[segment_rows]
    imu_intervals_s = np.diff(imu_times_s)
    logged_end_indices = find_rows_of_timestamps(imu_times_s, fusion_record.delayed.index)
    step_end_indices = find_step_ends(
        imu_intervals_s, logged_end_indices, read_prediction_step_s(fusion_record)
    )
    accelerometer_bias = np.asarray(initial_row[Columns.ACCELEROMETER_BIAS])
    gyro_bias = np.asarray(initial_row[Columns.GYRO_BIAS])
    rotation_vectors, velocity_increments = np.zeros((2, len(step_end_indices), 3))
    for steps in row_blocks(len(step_end_indices)):
        first_row = step_end_indices[steps.start - 1] if steps.start else 0
        rows = slice(first_row, step_end_indices[steps][-1])
        samples, intervals_s = imu.iloc[rows.start + 1 : rows.stop + 1], imu_intervals_s[rows, None]
        rotation_vectors[steps], velocity_increments[steps] = downsample_imu(
            (samples[Columns.ANGULAR_RATE].to_numpy() - gyro_bias) * intervals_s,
            (samples[Columns.SPECIFIC_FORCE].to_numpy() - accelerometer_bias) * intervals_s,
            step_end_indices[steps] - first_row,
        )
    step_times_s = imu_times_s[np.append(0, step_end_indices)]
    step_s = np.diff(step_times_s)
    gyro_attitude = cumulative_product(
        np.concatenate([[[1.0, 0.0, 0.0, 0.0]], from_vector(rotation_vectors)])
    )

    def compute_relative_attitude(
        attitude_samples: pd.DataFrame, lead_time_s: float, end_attitude: Array
    ) -> ArrayPair:
        attitude_samples = rows_between(
            attitude_samples, step_times_s[0] - lead_time_s, step_times_s[-1]
        )
        at_s = attitude_samples.index.to_numpy()
        inverse_attitude = conjugate(interpolate(at_s, step_times_s, end_attitude))
        return at_s, multiply(attitude_samples[Columns.QUATERNION].to_numpy(), inverse_attitude)

    # Rotation (in NED) from the attitude integrated from the gyro to EKF2's published attitude
    gyro_to_published_rotation = interpolate(
        step_times_s, *compute_relative_attitude(attitude, 0.0, gyro_attitude)
    )
    nominal_attitude = multiply(gyro_to_published_rotation, gyro_attitude)
    state_times_s, error_quaternions = compute_relative_attitude(
        fusion_record.delayed, 1e-4, nominal_attitude
    )
    attitude_error_rad = to_vector(error_quaternions)
    published_position_m = _interpolate(ekf2.state[Columns.POSITION], step_times_s[:1])[0]
    position_m = initial_row[Columns.POSITION].to_numpy()
    position_m = np.where(np.isfinite(position_m), position_m, published_position_m)
    # Since PX4 v1.16, heights in the logged state and published heights have different origins. The
    # model uses published heights
    position_m[2] = published_position_m[2]
    return ReplaySegment(
        time_s=step_times_s,
        step_s=step_s,
        # float32 (as in PX4) saves memory: these arrays are the largest
        body_to_ned=to_matrix(nominal_attitude).astype(np.float32),
        correction_rad=to_vector(
            multiply(gyro_to_published_rotation[1:], conjugate(gyro_to_published_rotation[:-1]))
        ).astype(np.float32),
        force_m_s2=velocity_increments / step_s[:, None],
        accelerometer_bias_m_s2=accelerometer_bias,
        state=np.concatenate(
            [attitude_error_rad[0], initial_row[Columns.VELOCITY], position_m, np.zeros(6)]
        ),
        variance=np.asarray(initial_row[Columns.FUSION_HORIZON_VARIANCE[:15]]),
        down_m=_interpolate(ekf2.state[["down_m"]], step_times_s)[:, 0],
        attitude_variance_rad2=_interpolate(
            fusion_record.delayed[Columns.FUSION_HORIZON_VARIANCE[:3]], step_times_s
        ).astype(np.float32),
        down_variance_m2=_interpolate(fusion_record.delayed[["down_m2"]], step_times_s)[:, 0],
        attitude_error_rad=_interpolate(
            pd.DataFrame(attitude_error_rad, state_times_s), step_times_s
        ).astype(np.float32),
        state_correlation=np.eye(15),
        is_acceleration_bad=(
            fusion_record.was_flag_set(BAD_ACCELERATION_FLAG, step_times_s)
            if BAD_ACCELERATION_FLAG in fusion_record.states
            else None
        ),
    )


def _find_field_fusion_span(fusion_record: FusionRecord) -> Span | None:
    """Return start and end (s) of EKF2's fusion of all three magnetometer axes.

    Return None if EKF2 did not fuse all three axes, or interrupted this fusion.
    """
    is_fused_3d = (
        fusion_record.magnetic_field_gauss["fused_3d"]
        if len(fusion_record.magnetic_field_gauss)
        else pd.Series(dtype=float)
    )
    flag_times_s = is_fused_3d.index.to_numpy()
    is_fused = is_fused_3d.to_numpy() > 0.0
    if not is_fused.any() or 1.0 / compute_median_interval_s(flag_times_s) < MIN_MAG_LOG_HZ:
        return None
    first_row, last_row = np.flatnonzero(is_fused)[[0, -1]]
    if not is_fused[first_row:last_row].all():
        return None
    return float(flag_times_s[first_row]) + MAGNETIC_FIELD_SETTLING_S, float(flag_times_s[last_row])


def _add_magnetic_field(
    segment: ReplaySegment, fusion_record: FusionRecord, start_row: int, step_s: float
) -> ReplaySegment:
    initial_row = fusion_record.delayed.iloc[start_row]
    field_gauss = fusion_record.magnetic_field_gauss
    sample_times_s = field_gauss.index.to_numpy()
    age_s = fusion_record.parameters.get("EKF2_MAG_DELAY", 0.0) * 1e-3 + 0.5 * step_s
    fused_samples_per_row = max(MAG_FUSION_HZ * compute_median_interval_s(sample_times_s), 1.0)
    measurement_times_s = sample_times_s - age_s
    extended_segment = add_field_states(
        segment,
        measurement_times_s,
        field_gauss.iloc[:, :3].to_numpy(),
        fused_samples_per_row,
        np.asarray(initial_row[[*Columns.EARTH_MAGNETIC_FIELD, *Columns.BODY_MAGNETIC_FIELD]]),
        np.asarray(initial_row[Columns.FUSION_HORIZON_VARIANCE[-6:]]),
    )
    if Columns.MAGNETIC_FIELD_INNOVATION[0] not in field_gauss:
        return extended_segment
    filtered_nu_gauss = field_gauss[Columns.MAGNETIC_FIELD_INNOVATION].to_numpy()
    return replace(
        extended_segment,
        field=_compute_mean_field(
            segment, fusion_record.delayed, measurement_times_s, filtered_nu_gauss
        ),
    )


def _compute_mean_field(
    segment: ReplaySegment,
    delayed_state: pd.DataFrame,
    measurement_times_s: Array,
    filtered_nu_gauss: Array,
) -> SensorSamples:
    """Compute the mean of the magnetometer samples between two logged rows (FRD, gauss).

    Mean = field predicted from the logged states - innovation. The innovation is computed from two
    successive low-pass filtered innovations in the log.
    """
    row_interval_s = np.diff(measurement_times_s)
    is_inside = (measurement_times_s[:-1] > segment.time_s[0]) & (
        measurement_times_s[1:] <= segment.time_s[-1]
    )
    gap_free_rows = (
        np.flatnonzero(is_inside & (row_interval_s > 0.0) & (row_interval_s < RESTART_GAP_S)) + 1
    )
    measurement_times_s = measurement_times_s[gap_free_rows]
    row_interval_s = row_interval_s[gap_free_rows - 1]
    fused_sample_counts = np.maximum(np.rint(MAG_FUSION_HZ * row_interval_s), 1.0)
    new_sample_weight = row_interval_s / (
        row_interval_s + fused_sample_counts * INNOVATION_TIME_CONSTANT_S
    )
    previous_innovation_weight = ((1.0 - new_sample_weight) ** fused_sample_counts)[:, None]
    nu_gauss = (
        filtered_nu_gauss[gap_free_rows]
        - previous_innovation_weight * filtered_nu_gauss[gap_free_rows - 1]
    ) / (1.0 - previous_innovation_weight)
    step_indices, weight = compute_low_pass_weights(
        segment,
        measurement_times_s,
        fused_sample_counts,
        row_interval_s / fused_sample_counts,
        new_sample_weight,
    )
    rotation_to_body = segment.body_to_ned[step_indices].swapaxes(2, 3)
    earth_field_gauss, body_field_gauss = (
        _interpolate(delayed_state[names], measurement_times_s)
        for names in (Columns.EARTH_MAGNETIC_FIELD, Columns.BODY_MAGNETIC_FIELD)
    )
    rotated_earth_field = earth_field_gauss[:, None] - np.cross(
        segment.attitude_error_rad[step_indices], earth_field_gauss[:, None]
    )
    expected_field_gauss = (
        np.einsum("ki,kiab,kib->ka", weight, rotation_to_body, rotated_earth_field)
        + body_field_gauss
    )
    mean = np.einsum("ki,kiab->kab", weight, rotation_to_body)
    return SensorSamples(
        step_indices[:, 0],
        expected_field_gauss - nu_gauss,
        mean,
        fused_sample_counts,
        np.zeros(len(gap_free_rows)),
    )


def compute_low_pass_weights(
    segment: ReplaySegment,
    newest_sample_s: Array,
    sample_count: Array,
    interval_s: Array,
    new_sample_weight: Array | float,
) -> tuple[IntArray, Array]:
    """Return prediction steps and weights, shape (m, k), of up to k samples in m low-pass means.

    Parameters
    ----------
    newest_sample_s, sample_count, interval_s : ndarray, shape (m,)
        Time of the newest sample, number of samples, and sample interval of each mean.
    new_sample_weight : float or ndarray, shape (m,)
        Weight of a new sample in the low-pass filter.
    """
    # In sample intervals: 0 is the newest sample of a mean
    age_in_samples = np.arange(int(sample_count.max(initial=1.0)))
    weight = np.where(
        age_in_samples < sample_count[:, None],
        (1.0 - np.reshape(new_sample_weight, (-1, 1))) ** age_in_samples,
        0.0,
    )
    weight /= weight.sum(axis=1, keepdims=True)
    measurement_times_s = newest_sample_s[:, None] - age_in_samples * interval_s[:, None]
    return np.searchsorted(segment.time_s, measurement_times_s - 1e-9), weight


def add_field_states(
    segment: ReplaySegment,
    measurement_times_s: Array,
    field_gauss: Array,
    sample_weight: float,
    initial_fields_gauss: Array,
    field_variance_gauss2: Array,
) -> ReplaySegment:
    """Add the magnetic fields of earth and body to the states of a segment.

    Parameters
    ----------
    measurement_times_s, field_gauss : ndarray, shape (m,) and (m, 3)
        Magnetometer samples (body FRD) at EKF2's measurement time.
    sample_weight : float
        Number of samples fused by EKF2 that each logged sample represents.
    initial_fields_gauss, field_variance_gauss2 : ndarray, shape (6,)
        Initial fields of earth (NED) and body (FRD), and their variances.
    """
    step_index, is_inside = find_sample_steps(segment, measurement_times_s)
    rotation_to_body = segment.body_to_ned[step_index].transpose(0, 2, 1)
    sample_count = len(step_index)
    return replace(
        segment,
        state=np.concatenate([segment.state, initial_fields_gauss]),
        variance=np.concatenate([segment.variance, field_variance_gauss2]),
        state_correlation=block_diag(segment.state_correlation, np.eye(len(initial_fields_gauss))),
        field=SensorSamples(
            step_index,
            field_gauss[is_inside],
            rotation_to_body,
            np.full(sample_count, sample_weight),
            np.zeros(sample_count),
        ),
    )


def find_sample_steps(
    segment: ReplaySegment, measurement_times_s: Array
) -> tuple[IntArray, BoolArray]:
    """Return the index of the prediction step in which each sample of the segment is fused.

    The second array is True for each given sample that is in the segment.
    """
    step_index = np.searchsorted(segment.time_s, measurement_times_s - 1e-9)
    is_inside = (step_index > 0) & (step_index < len(segment.time_s))
    return step_index[is_inside], is_inside


def read_prediction_step_s(fusion_record: FusionRecord) -> float:
    """Return EKF2_PREDICT_US in seconds."""
    return fusion_record.parameters.get("EKF2_PREDICT_US", 10_000.0) * 1e-6


def _interpolate(table: pd.DataFrame, times_s: Array) -> Array:
    """Interpolate the columns of a table, indexed by time (s)."""
    return np.column_stack([np.interp(times_s, table.index, table[name]) for name in table])


def find_step_ends(
    interval_s: Array, logged_end_indices: IntArray, configured_step_s: float
) -> IntArray:
    """Return the index of the IMU sample at the end of each prediction step of EKF2.

    A step ends after :func:`compute_samples_per_step` IMU samples, after ``configured_step_s``, or
    at a logged end of a step, whichever is first.
    """
    median_interval_s = float(np.median(interval_s))
    # Number of IMU samples in each logged interval. Few missing samples are not counted, because
    # they may be gaps of the IMU itself
    sample_counts = np.maximum(np.rint(interval_s / median_interval_s), 1.0)
    if sample_counts.mean() <= 1.0 + MAX_LOST_IMU_FRACTION:
        sample_counts[:] = 1.0
    sample_counts_at_ends = np.append(0.0, np.cumsum(sample_counts))[logged_end_indices]
    needed_sample_count = compute_samples_per_step(
        configured_step_s, median_interval_s, sample_counts_at_ends
    )
    logged_end_set = set(logged_end_indices.tolist())
    end_indices = []
    accumulated_count = accumulated_time_s = 0.0
    samples = np.stack([interval_s, sample_counts], axis=1)
    for sample, (interval, sample_count) in enumerate(
        chain.from_iterable(samples[rows].tolist() for rows in row_blocks(len(samples))), start=1
    ):
        accumulated_count = accumulated_count + sample_count
        accumulated_time_s = accumulated_time_s + interval
        is_step_complete = (
            accumulated_count >= needed_sample_count
            and accumulated_time_s > 0.5 * configured_step_s
        )
        if is_step_complete or accumulated_time_s > configured_step_s or sample in logged_end_set:
            end_indices.append(sample)
            accumulated_count = accumulated_time_s = 0.0
    return np.array(end_indices, dtype=np.intp)


def downsample_imu(
    rotation_vectors: Array, velocity_increments: Array, step_end_indices: IntArray
) -> ArrayPair:
    """Return the rotation (rad) and velocity change (m/s) of each prediction step from IMU samples.

    The velocity change is in the body frame at the end of the step.
    """
    start_indices = np.append(0, step_end_indices[:-1])
    cumulative_rotation_rad = cumulative_sums(rotation_vectors)
    rotation_at_step_end_rad = np.repeat(
        cumulative_rotation_rad[step_end_indices], step_end_indices - start_indices, axis=0
    )
    step_count = len(rotation_at_step_end_rad)
    rotation_at_sample_middle_rad = 0.5 * (
        cumulative_rotation_rad[:step_count] + cumulative_rotation_rad[1 : step_count + 1]
    )
    velocity_increments = velocity_increments[:step_count]
    rotated_increments = velocity_increments - np.cross(
        rotation_at_step_end_rad - rotation_at_sample_middle_rad, velocity_increments
    )
    step_rotation_rad = (
        cumulative_rotation_rad[step_end_indices] - cumulative_rotation_rad[start_indices]
    )
    return step_rotation_rad, np.add.reduceat(rotated_increments, start_indices, axis=0)
