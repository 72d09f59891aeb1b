"""Flight segments without gaps for the EKF2 replay: prediction steps, initial state and samples.

Sources: PX4-Autopilot ``EKF/imu_down_sampler/imu_down_sampler.cpp``, ``EKF/ekf_helper.cpp``
(calcEarthRateNED), ``EKF/ekf.cpp`` (predictState), ``lib/lat_lon_alt/lat_lon_alt.cpp``
(computeRadiiOfCurvature), ``EKF/aid_sources/optical_flow`` (``optical_flow_control.cpp``: velocity
and low-pass filter; ``optical_flow_fusion.cpp``: R and gate).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from dataclasses import field as record_field
from functools import cached_property
from itertools import pairwise

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
    interpolate_columns,
    select_intervals,
)
from px4fuse.core.record import Span
from px4fuse.flight.ekf2_parameters import MODEL_PARAMETERS
from px4fuse.flight.model import (
    BAD_ACCELERATION_FLAG,
    FLOW_FILTER_NEW_SAMPLE_WEIGHT,
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
from px4fuse.readers.px4_positions import EARTH_RADIUS_M
from px4fuse.trajectory.rotation import (
    conjugate,
    cumulative_product,
    from_rotation_vector,
    interpolate,
    multiply,
    rotate,
    to_rotation_matrix,
    to_rotation_vector,
)

# After a longer gap (s) in the position source, the replay restarts from the logged state. In gaps,
# EKF2 fuses fake positions, which the model does not contain
RESTART_GAP_S = 2.0
# A longer IMU interval (s) is a gap: EKF2 limits a prediction step to 2 EKF2_PREDICT_US
MIN_IMU_GAP_S = 0.05
# Minimum time (s) from EKF2's first position fusion to the start of the replay
MIN_TIME_SINCE_FIRST_FUSION_S = 1.0
# Minimum time (s) from take-off to the replay: on the ground, EKF2 also fuses zero velocity
MIN_TIME_SINCE_TAKEOFF_S = 4.0
# Time (s) from the start of a replay to the start of the evaluation
REPLAY_SETTLING_S = 5.0
# EKF2's first fusion of all magnetometer axes resets the magnetic field states. The replay uses
# these states from this time (s) after the reset
MAGNETIC_FIELD_SETTLING_S = 1.0
# Correlations of the initial state are estimated by a replay of this time (s) before a segment
CORRELATION_ESTIMATION_TIME_S = 20.0
# Rate (Hz) at which EKF2 fuses the magnetometer with SENS_MAG_RATE 15 (default)
MAG_FUSION_HZ = 14.0
# Minimum logging rate (Hz) of the magnetometer for a replay of its fusion
MIN_MAG_LOG_HZ = 1.5
# Time constant (s) of EKF2's low-pass filter of innovations (updateAidSourceStatus, ekf_helper.cpp)
INNOVATION_LOW_PASS_TIME_CONSTANT_S = 0.5
# Minimum length (s) of a replayed segment
MIN_SEGMENT_DURATION_S = 10.0
# Maximum delay (s) from a reset to its publication
MAX_RESET_DELAY_S = 0.5
# The EKF2 replay is interrupted if a larger fraction of the IMU samples within 1 s is clipped
MAX_CLIPPED_IMU_FRACTION = 0.05
# Maximum fraction of missing IMU samples that the EKF2 replay ignores
MAX_LOST_IMU_FRACTION = 0.02

EARTH_RATE_RAD_S = 7.292115e-5
EQUATORIAL_RADIUS_M, ECCENTRICITY = 6_378_137.0, 0.0818191908425
# Gravity in NED (CONSTANTS_ONE_G in PX4)
GRAVITY_M_S2 = np.array([0.0, 0.0, 9.80665])

# Number of states without magnetic fields
STATE_COUNT = 15
# Number of states that the IMU propagates: all except the biases
MOTION_STATE_COUNT = 9
# State indices of attitude error, velocity, position and biases
THETA, VELOCITY, POSITION = slice(0, 3), slice(3, 6), slice(6, 9)
GYRO_BIAS, ACCELEROMETER_BIAS = slice(9, 12), slice(12, 15)
HORIZONTAL_VELOCITY, HORIZONTAL_POSITION = slice(3, 5), slice(6, 8)
# State indices of the earth field (NED) and the body field (FRD), if there are 21 states
EARTH_MAGNETIC_FIELD, BODY_MAGNETIC_FIELD = slice(15, 18), slice(18, 21)


@dataclass(frozen=True)
class SensorSamples:
    """Means of magnetometer or optical flow samples in one part of a flight.

    Attributes
    ----------
    step_indices : ndarray of int, shape (m,)
        Prediction step that fuses each mean.
    value : ndarray, shape (m, k)
        Magnetometer: magnetic field (gauss, FRD). Optical flow: velocity forward and right (m/s).
        The velocity change from the IMU since the start of the segment is subtracted from it, so
        that samples of several times can be averaged.
    ned_to_body_rotation : ndarray, shape (m, k, 3)
        Mean rotation from NED to the body axes.
    sample_count : ndarray, shape (m,)
        Number of samples in each mean.
    noise : ndarray, shape (m,)
        R of one sample; 0 if an EKF2 parameter determines R.
    gate : float
        Maximum accepted |innovation| ÷ √S; infinite if an EKF2 parameter determines the gate.
    state_slices : tuple of slice
        State indices of the measured vector (NED) and of the sensor bias (body frame).
    """

    step_indices: IntArray
    value: Array
    ned_to_body_rotation: Array
    sample_count: Array
    noise: Array
    gate: float = np.inf
    state_slices: tuple[slice, ...] = (EARTH_MAGNETIC_FIELD, BODY_MAGNETIC_FIELD)


@dataclass(frozen=True)
class HeightSamples:
    """Height measurements in one part of a flight.

    Attributes
    ----------
    fused_sensors : tuple of str
        PX4's names of the fused height sensors.
    reference : str
        PX4's name of the height reference, which has no bias.
    initial_bias_and_variance : ndarray, shape (2,)
        Initial bias (m, positive: too high) and variance (m²) of the other height sensor.
    step_indices : ndarray of int, shape (m,)
        Prediction step of each barometer sample.
    samples : DataFrame, shape (m, 3)
        Barometer samples, indexed by measurement time: height ``down_m``; dead zone
        ``dead_zone_m`` of the innovation in ground effect, else 0; ``weight``, the number of EKF2
        samples that the sample represents.
    """

    fused_sensors: tuple[str, ...]
    reference: str
    initial_bias_and_variance: Array
    step_indices: IntArray
    samples: pd.DataFrame


@dataclass(frozen=True)
class ReplaySegment:
    """Part of a flight without gaps, with n prediction steps of EKF2.

    The nominal attitude is the attitude that EKF2 published in the log. Vectors are in NED, unless
    another frame is given.

    Attributes
    ----------
    time_s : ndarray, shape (n + 1,)
        Start of the first step, then end of each step.
    body_to_ned : ndarray, shape (n + 1, 3, 3)
        Nominal attitude.
    attitude_correction_rad: ndarray, shape (n, 3)
        Rotation of the nominal attitude in each step, minus rotation measured by the gyro.
    specific_force_m_s2 : ndarray, shape (n, 3)
        Specific force minus nominal bias, in the body frame at the end of the step.
    accelerometer_bias_m_s2 : ndarray, shape (3,)
        Nominal accelerometer bias: the logged bias at the start.
    state, variance : ndarray, shape (15,) or (21,)
        Initial attitude error, velocity, position, bias errors, and magnetic fields.
    down_m, down_variance_m2 : ndarray, shape (n + 1,)
        Published height (positive down), and its variance.
    attitude_error_rad, attitude_variance_rad2 : ndarray, shape (n + 1, 3)
        Logged attitude minus nominal attitude, and its variance.
    initial_state_correlation : ndarray, shape (15, 15) or (21, 21)
        Estimated correlations of the initial state.
    clipped_fraction : ndarray, shape (n + 1,), or None
        Fraction of the accelerometer axes that are clipped in the step.
    is_acceleration_bad : ndarray of bool, shape (n + 1,), or None
        Logged flag for a bad vertical acceleration.
    mean_bias_down_m_s2 : float
        Mean vertical accelerometer bias.
    internal_to_published_position_ratio : float or ndarray, shape (3,)
        Ratio of EKF2's internal to its published position along each axis. It is not 1 since PX4
        v1.16, which computes positions on an ellipsoid but publishes them on a sphere.
    preceding_segment : ReplaySegment or None
        Seconds of the flight before this segment. Their replay gives the correlations of the
        initial state, which are not logged.
    changed_parameters : mapping from PX4's name to float
        Parameters that were changed in flight.
    """

    time_s: Array
    step_s: Array
    body_to_ned: Array
    attitude_correction_rad: Array
    specific_force_m_s2: Array
    accelerometer_bias_m_s2: Array
    state: Array
    variance: Array
    down_m: Array
    attitude_variance_rad2: Array
    down_variance_m2: Array
    attitude_error_rad: Array
    initial_state_correlation: Array
    starts_while_fusing: bool = True
    magnetic_field: SensorSamples | None = None
    height_samples: HeightSamples | None = None
    clipped_fraction: Array | None = None
    is_acceleration_bad: BoolArray | None = None
    mean_bias_down_m_s2: float = 0.0
    flow: SensorSamples | None = None
    internal_to_published_position_ratio: Array | float = 1.0
    preceding_segment: "ReplaySegment | None" = None
    changed_parameters: Mapping[str, float] = record_field(default_factory=dict)

    @cached_property
    def imu_velocity_change_m_s(self) -> Array:
        """Velocity change (m/s, NED) since the start, integrated from the IMU; shape (n + 1, 3)."""
        acceleration_m_s2 = rotate(self.body_to_ned[1:], self.specific_force_m_s2) + GRAVITY_M_S2
        return cumulative_sums(acceleration_m_s2 * self.step_s[:, None])

    @cached_property
    def imu_displacement_m(self) -> Array:
        """Displacement (m, NED) since the start, integrated from the IMU; shape (n + 1, 3)."""
        velocity = self.imu_velocity_change_m_s
        return cumulative_sums(0.5 * (velocity[1:] + velocity[:-1]) * self.step_s[:, None])


def group_samples_by_event(
    segment: ReplaySegment,
    event_steps: IntArray,
    measurement_step_indices: IntArray,
    measured_position_m: Array,
    axes: slice,
    *quantities: Array,
) -> Array:
    """Group position samples by the fusion event of the replay that uses them.

    Each event fuses the samples since the previous event. Samples after the last event are omitted.

    Parameters
    ----------
    segment : ReplaySegment
    event_steps : ndarray of int, shape (events,)
        Prediction step in which each event occurs, increasing.
    measurement_step_indices : ndarray of int, shape (m,)
        Prediction step in which each sample was measured, increasing.
    measured_position_m : ndarray, shape (m, a)
        Measured positions along ``axes``.
    axes : slice
        Indices of the measured axes in NED; a is their number.
    *quantities : ndarray, shape (m,)
        Further quantities of each sample, for example its variance.

    Returns
    -------
    ndarray, shape (a + 2 + len(quantities), k, events)
        Samples of each event. k is the largest number of samples in one event; other events are
        padded with zeros. First dimension: position (m) along the a axes; age of the sample at the
        event (s); further quantities; 1 for a sample, 0 for padding. The positions are corrected
        with the IMU, so that each measures position - age · velocity at the event.
    """
    # 1. Event of each sample. Samples after the last event are not used
    event_indices = np.searchsorted(event_steps, measurement_step_indices)
    sample_count = int(np.searchsorted(event_indices, len(event_steps)))
    event_indices = event_indices[:sample_count]
    measurement_steps = measurement_step_indices[:sample_count]
    event_step = event_steps[event_indices]
    age_s = segment.time_s[event_step] - segment.time_s[measurement_steps]
    # 2. Correction for accelerations: movement from measurement to event, minus age · velocity at
    # the event. The unknown initial velocity of the integrated IMU cancels
    displacement_m = (
        segment.imu_displacement_m[event_step]
        - segment.imu_displacement_m[measurement_steps]
        - segment.imu_velocity_change_m_s[event_step] * age_s[:, None]
    )
    # 3. Index of each sample in its event: its row minus the first row of the event
    index_in_event = np.arange(sample_count) - np.searchsorted(event_indices, event_indices)
    columns = (
        *(measured_position_m[:sample_count] + displacement_m[:, axes]).T,
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
    """Return a table of the updates with one aiding source, indexed by measurement time (s).

    Parameters
    ----------
    update_records : ndarray, shape (events, k, columns)
        Records of up to k samples; NaN without a sample. The columns are innovations (one for each
        axis), innovation variances, rejected, fused, reset, position variances and observation
        variances. The last of them may be missing: GNSS velocity ends with rejected, heights with
        fused, vision in addition to GNSS with reset.
    measurement_times_s : ndarray, shape (events, k)
        Measurement time of each sample.
    end_s : ndarray, shape (events,)
        Time of each fusion event.
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
    event_indices, _ = np.nonzero(has_innovation)
    return updates.assign(fused_at_s=end_s[event_indices])


def stack_samples(samples_by_filter: Sequence[Array]) -> Array:
    """Stack the sensor samples of all filter configurations along a new last axis.

    The axes of each array are quantities, samples of one fusion event, and events. Arrays with
    fewer samples per event are padded with zeros.
    """
    max_samples_per_event = max(samples.shape[1] for samples in samples_by_filter)
    return np.stack(
        [
            np.pad(samples, ((0, 0), (0, max_samples_per_event - samples.shape[1]), (0, 0)))
            for samples in samples_by_filter
        ],
        axis=-1,
    )


def find_replay_segments(
    flight: Flight,
    imu: pd.DataFrame,
    attitude: pd.DataFrame,
    ekf2: Ekf2,
    fusion_record: FusionRecord,
    position_times_s: Array,
    *,
    is_gnss: bool,
) -> tuple[ReplaySegment, ...]:
    """Find the parts of a flight without gaps in IMU and positions, after EKF2's first fusion.

    Each part is replayed from a logged state. ``position_times_s`` are the times (s) of all
    horizontal aiding samples.
    """
    innovations = ekf2.innovations["north"]
    assert isinstance(innovations, pd.DataFrame)
    state_times_s = fusion_record.delayed_state.index.to_numpy()
    imu_times_s = imu.index.to_numpy()
    magnetic_field_start_s = magnetic_field_end_s = np.inf
    if is_gnss:
        magnetic_field_start_s, magnetic_field_end_s = _find_magnetometer_3d_fusion_span(
            fusion_record
        )
    parameter_changes = [
        change for change in ekf2.parameter_changes if change.name in MODEL_PARAMETERS
    ]
    boundary_times_s = [
        *_find_data_boundary_times_s(imu_times_s, position_times_s),
        *(_find_interruption_times_s(imu, ekf2) if is_gnss else ()),
        # Times of switches to another EKF2 instance, whose state is different. The first instance
        # is not a switch
        *(time_s for time_s, _ in ekf2.primary_instances[1:]),
        *(change.time_s for change in parameter_changes),
        magnetic_field_end_s,
    ]
    # The replay can start up to MIN_IMU_GAP_S before the first IMU sample. It can end up to
    # MIN_IMU_GAP_S after the last IMU sample, and 1 s after the last position
    earliest_start_s = max(attitude.index[0], imu_times_s[0] - MIN_IMU_GAP_S, position_times_s[0])
    latest_end_s = min(
        attitude.index[-1], imu_times_s[-1] + MIN_IMU_GAP_S, position_times_s[-1] + 1.0
    )
    takeoff_s = -np.inf
    if not isinstance(flight.airborne, Unavailable) and flight.airborne:
        takeoff_s = flight.airborne[0][0]

    def make_segment(start_row: int, end_s: float) -> ReplaySegment:
        segment = _make_segment(imu, attitude, ekf2, fusion_record, start_row, end_s)
        return _add_gnss_model_inputs(segment, imu, ekf2, fusion_record) if is_gnss else segment

    segments = []
    for part_start_s, part_end_s in pairwise(
        np.unique(np.clip(boundary_times_s, earliest_start_s, latest_end_s))
    ):
        # 1. Earliest start of the replay: EKF2 has fused positions, the vehicle has taken off and,
        # in the part with magnetometer fusion, the magnetic field states have settled
        fusion_times_in_part_s = rows_between(innovations, part_start_s, part_end_s).index
        if not len(fusion_times_in_part_s):
            continue
        start_s = fusion_times_in_part_s[0] + MIN_TIME_SINCE_FIRST_FUSION_S
        if takeoff_s < part_end_s:
            start_s = max(start_s, takeoff_s + MIN_TIME_SINCE_TAKEOFF_S)
        if part_start_s <= magnetic_field_start_s < part_end_s:
            start_s = max(start_s, magnetic_field_start_s)
        # 2. Start at the first logged state after this time
        start_row = int(np.searchsorted(state_times_s, start_s))
        if start_row == len(state_times_s):
            continue
        start_s = state_times_s[start_row]
        if part_end_s - start_s < MIN_SEGMENT_DURATION_S:
            continue
        # The part between two boundary times may itself be a gap of the IMU data
        is_covered = (imu_times_s[1:] > start_s) & (imu_times_s[:-1] < part_end_s)
        if not np.all(np.diff(imu_times_s)[is_covered] <= MIN_IMU_GAP_S):
            continue
        # 3. Preceding seconds, for the correlations of the initial state
        preceding_segment = None
        preceding_start_s = max(earliest_start_s, start_s - CORRELATION_ESTIMATION_TIME_S)
        preceding_start_row = int(np.searchsorted(state_times_s, preceding_start_s))
        if preceding_start_row < start_row:
            preceding_segment = make_segment(preceding_start_row, start_s)
        segment = replace(
            make_segment(start_row, part_end_s),
            preceding_segment=preceding_segment,
            changed_parameters={
                change.name: change.value_after
                for change in parameter_changes
                if change.time_s <= part_start_s
            },
        )
        if magnetic_field_start_s <= start_s and part_end_s <= magnetic_field_end_s:
            segment = _add_magnetic_field(segment, fusion_record, start_row, ekf2.step_s)
        segments.append(segment)
    return tuple(segments)


def _find_data_boundary_times_s(imu_times_s: Array, position_times_s: Array) -> list[float]:
    """Return the ends (s) of the IMU data, and start and end of each gap of IMU or positions."""
    boundary_times_s = [imu_times_s[0], imu_times_s[-1]]
    for times_s, max_gap_s in ((imu_times_s, MIN_IMU_GAP_S), (position_times_s, RESTART_GAP_S)):
        for gap in select_intervals(times_s, np.diff(times_s) > max_gap_s):
            boundary_times_s += gap
    return boundary_times_s


def _add_gnss_model_inputs(
    segment: ReplaySegment, imu: pd.DataFrame, ekf2: Ekf2, fusion_record: FusionRecord
) -> ReplaySegment:
    """Add the inputs that only a replay of GNSS uses, such as earth rotation and clipping."""
    internal_to_published_position_ratio = compute_internal_to_published_position_ratio(
        fusion_record
    )
    initial_state = segment.state.copy()
    initial_state[POSITION] *= internal_to_published_position_ratio
    earth_rotation_rad = compute_earth_rate_rad_s(fusion_record) * segment.step_s[:, None]
    # Mean vertical bias: vertical velocity change from the IMU minus that of EKF2, per time
    start_s, end_s = segment.time_s[[0, -1]]
    start_m_s, end_m_s = np.interp([start_s, end_s], ekf2.state.index, ekf2.state["down_m_s"])
    _, _, imu_change_down_m_s = segment.imu_velocity_change_m_s[-1]
    velocity_change_error_m_s = imu_change_down_m_s - (end_m_s - start_m_s)
    return replace(
        segment,
        state=initial_state,
        internal_to_published_position_ratio=internal_to_published_position_ratio,
        attitude_correction_rad=segment.attitude_correction_rad + earth_rotation_rad,
        clipped_fraction=_compute_clipped_fraction(imu, segment.time_s),
        mean_bias_down_m_s2=float(velocity_change_error_m_s / (end_s - start_s)),
    )


def compute_earth_rate_rad_s(fusion_record: FusionRecord) -> Array:
    """Return the earth rotation rate (rad/s, NED, shape (3,)); 0 if the latitude is unknown."""
    latitude_rad = np.radians(fusion_record.latitude_deg)
    return np.nan_to_num(
        EARTH_RATE_RAD_S * np.array([np.cos(latitude_rad), 0.0, -np.sin(latitude_rad)])
    )


def compute_internal_to_published_position_ratio(fusion_record: FusionRecord) -> Array | float:
    """Return the ratio of EKF2's internal to its published position along north, east and down.

    Since PX4 v1.16, EKF2 computes positions on an ellipsoid, but publishes positions on a sphere.
    """
    if np.isnan(fusion_record.latitude_deg) or not fusion_record.stores_latitude():
        return 1.0
    eccentricity_squared = ECCENTRICITY**2
    q = 1.0 - eccentricity_squared * np.sin(np.radians(fusion_record.latitude_deg)) ** 2
    # PX4 uses the exponent 2.5 for the meridian radius; the exponent of an ellipsoid is 1.5
    earth_curvature_radii_m = (
        EQUATORIAL_RADIUS_M * np.array([(1.0 - eccentricity_squared) / q**2.5, q**-0.5])
        + fusion_record.altitude_m
    )
    return np.append(earth_curvature_radii_m / EARTH_RADIUS_M, 1.0)


def _find_interruption_times_s(imu: pd.DataFrame, ekf2: Ekf2) -> list[float]:
    """Return start and end (s) of each clipping and height reset, which interrupt the replay."""
    interruption_times_s = [
        time
        for reset in ekf2.resets
        if reset.delta[2]
        for time in (reset.time_s - MAX_RESET_DELAY_S, reset.time_s)
    ]
    if "clipped" in imu:
        imu_times_s = imu.index.to_numpy()
        clipped_times_s = imu_times_s[imu["clipped"].to_numpy() > 0.0]
        # Number of clipped samples from 0.5 s before to 0.5 s after each clipped sample
        window_begin_rows, window_end_rows = (
            np.searchsorted(clipped_times_s, clipped_times_s + s) for s in (-0.5, 0.5)
        )
        samples_per_second = 1.0 / compute_median_interval_s(imu_times_s)
        heavy_clipping_times_s = clipped_times_s[
            window_end_rows - window_begin_rows > MAX_CLIPPED_IMU_FRACTION * samples_per_second
        ]
        interruption_times_s += [*(heavy_clipping_times_s - 0.5), *(heavy_clipping_times_s + 0.5)]
    return interruption_times_s


def _compute_clipped_fraction(imu: pd.DataFrame, time_s: Array) -> Array:
    """Return the fraction of the three accelerometer axes that clip in each prediction step.

    ``time_s``, shape (n + 1,), contains the start and the ends of the n steps. Element k of the
    result belongs to the step that ends at ``time_s[k]``. It is the maximum over the IMU samples of
    the step, and 0 if clipping is not logged.
    """
    clipped_fraction_by_step = np.zeros(len(time_s))
    # "clipped" has one bit per axis
    if "clipped" in imu:
        clipping_bits = imu.loc[(imu["clipped"] > 0.0) & (imu.index <= time_s[-1]), "clipped"]
        clipped_fraction = (
            np.unpackbits(clipping_bits.to_numpy(np.uint8)[:, None], axis=1).sum(axis=1) / 3.0
        )
        np.maximum.at(
            clipped_fraction_by_step,
            np.searchsorted(time_s, clipping_bits.index),
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
    """Make the segment from a row of ``estimator_states`` to ``end_s``."""
    # 1. IMU samples of the segment, and the last sample of each prediction step
    initial_row = fusion_record.delayed_state.iloc[start_row].astype(np.float64)
    imu_times_s = imu.index.to_numpy()
    first_row = int(np.argmin(np.abs(imu_times_s - fusion_record.delayed_state.index[start_row])))
    segment_rows = slice(first_row, int(np.searchsorted(imu_times_s, end_s, side="right")))
    imu_times_s = imu_times_s[segment_rows]
    imu = imu.iloc[segment_rows]
    imu_intervals_s = np.diff(imu_times_s)
    logged_step_end_indices = find_rows_of_timestamps(
        imu_times_s, fusion_record.delayed_state.index
    )
    step_end_indices = find_step_ends(
        imu_intervals_s, logged_step_end_indices, read_prediction_step_s(fusion_record)
    )
    # 2. Rotation and velocity change of each step, without the logged (nominal) biases. An IMU
    # sample is the mean over the interval before it
    accelerometer_bias = np.asarray(initial_row[Columns.ACCELEROMETER_BIAS])
    gyro_bias = np.asarray(initial_row[Columns.GYRO_BIAS])
    rotation_vectors, velocity_increments = downsample_imu(
        (imu[Columns.ANGULAR_RATE].to_numpy()[1:] - gyro_bias) * imu_intervals_s[:, None],
        (imu[Columns.SPECIFIC_FORCE].to_numpy()[1:] - accelerometer_bias)
        * imu_intervals_s[:, None],
        step_end_indices,
    )
    step_times_s = imu_times_s[np.append(0, step_end_indices)]
    step_s = np.diff(step_times_s)
    # 3. Nominal attitude: EKF2's published attitude, interpolated with the gyro. gyro_attitude is
    # the attitude relative to the start, from the gyro alone
    gyro_attitude = cumulative_product(
        np.concatenate([[[1.0, 0.0, 0.0, 0.0]], from_rotation_vector(rotation_vectors)])
    )

    def compute_rotation_from_reference(
        attitude_samples: pd.DataFrame, lead_time_s: float, reference_attitude: Array
    ) -> ArrayPair:
        attitude_samples = rows_between(
            attitude_samples, step_times_s[0] - lead_time_s, step_times_s[-1]
        )
        attitude_time_s = attitude_samples.index.to_numpy()
        inverse_attitude = conjugate(interpolate(attitude_time_s, step_times_s, reference_attitude))
        return attitude_time_s, multiply(
            attitude_samples[Columns.QUATERNION].to_numpy(), inverse_attitude
        )

    # Rotation (in NED) that turns the gyro's integrated attitude into EKF2's published attitude
    rotation_to_published_attitude = interpolate(
        step_times_s, *compute_rotation_from_reference(attitude, 0.0, gyro_attitude)
    )
    nominal_attitude = multiply(rotation_to_published_attitude, gyro_attitude)
    # 4. Error of the nominal attitude, from the attitude in the logged states. The first state row
    # may be up to 0.1 ms before the first IMU sample
    state_times_s, error_quaternions = compute_rotation_from_reference(
        fusion_record.delayed_state, 1e-4, nominal_attitude
    )
    attitude_error_rad = to_rotation_vector(error_quaternions)
    # 5. Initial position: that of the logged state, or the published position
    published_position_m = _interpolate(ekf2.state[Columns.POSITION], step_times_s[:1])[0]
    position_m = initial_row[Columns.POSITION].to_numpy()
    position_m = np.where(np.isfinite(position_m), position_m, published_position_m)
    # Since PX4 v1.16, heights in estimator_states and published heights have different origins
    position_m[2] = published_position_m[2]
    return ReplaySegment(
        time_s=step_times_s,
        step_s=step_s,
        # float32 (as in PX4) saves memory: these arrays are the largest
        body_to_ned=to_rotation_matrix(nominal_attitude).astype(np.float32),
        attitude_correction_rad=to_rotation_vector(
            multiply(
                rotation_to_published_attitude[1:], conjugate(rotation_to_published_attitude[:-1])
            )
        ).astype(np.float32),
        specific_force_m_s2=velocity_increments / step_s[:, None],
        accelerometer_bias_m_s2=accelerometer_bias,
        state=np.concatenate(
            [attitude_error_rad[0], initial_row[Columns.VELOCITY], position_m, np.zeros(6)]
        ),
        variance=np.asarray(initial_row[Columns.FUSION_HORIZON_VARIANCE[:15]]),
        down_m=_interpolate(ekf2.state[["down_m"]], step_times_s)[:, 0],
        attitude_variance_rad2=_interpolate(
            fusion_record.delayed_state[Columns.FUSION_HORIZON_VARIANCE[:3]], step_times_s
        ).astype(np.float32),
        down_variance_m2=_interpolate(fusion_record.delayed_state[["down_m2"]], step_times_s)[:, 0],
        attitude_error_rad=interpolate_columns(
            step_times_s, state_times_s, attitude_error_rad
        ).astype(np.float32),
        initial_state_correlation=np.eye(15),
        is_acceleration_bad=(
            fusion_record.was_flag_set(BAD_ACCELERATION_FLAG, step_times_s)
            if BAD_ACCELERATION_FLAG in fusion_record.status_flags
            else None
        ),
    )


def _find_magnetometer_3d_fusion_span(fusion_record: FusionRecord) -> Span:
    """Return start and end (s) of the time in which the replay can fuse all magnetometer axes.

    This time starts MAGNETIC_FIELD_SETTLING_S after EKF2's first fusion of all three axes, and ends
    with the last. Both results are infinite (no such time) if EKF2 never fused all axes, if it
    interrupted their fusion, or if the magnetometer is logged at less than MIN_MAG_LOG_HZ.
    """
    field_gauss = fusion_record.magnetic_field_gauss
    if len(field_gauss) and field_gauss["fused_3d"].any():
        flag_times_s = field_gauss.index.to_numpy()
        is_fused = field_gauss["fused_3d"].to_numpy() > 0.0
        first_row, last_row = np.flatnonzero(is_fused)[[0, -1]]
        if (
            is_fused[first_row:last_row].all()
            and 1.0 / compute_median_interval_s(flag_times_s) >= MIN_MAG_LOG_HZ
        ):
            start_s, end_s = flag_times_s[[first_row, last_row]].tolist()
            return start_s + MAGNETIC_FIELD_SETTLING_S, end_s
    return np.inf, np.inf


def _add_magnetic_field(
    segment: ReplaySegment, fusion_record: FusionRecord, start_row: int, step_s: float
) -> ReplaySegment:
    """Add magnetic field states and magnetometer samples to a segment.

    The log contains only some of the samples that EKF2 fused. If EKF2's low-pass filtered
    innovations are logged, they give the mean of the samples between two logged ones. Otherwise,
    each logged sample is used as the mean of several samples.
    """
    initial_row = fusion_record.delayed_state.iloc[start_row]
    field_gauss = fusion_record.magnetic_field_gauss
    sample_times_s = field_gauss.index.to_numpy()
    # EKF2 subtracts its delay parameter and half a prediction step from the sample times
    age_s = fusion_record.parameters.get("EKF2_MAG_DELAY", 0.0) * 1e-3 + 0.5 * step_s
    measurement_times_s = sample_times_s - age_s
    if Columns.MAGNETIC_FIELD_INNOVATION[0] in field_gauss:
        samples = _compute_mean_magnetic_field(
            segment,
            fusion_record.delayed_state,
            measurement_times_s,
            field_gauss[Columns.MAGNETIC_FIELD_INNOVATION].to_numpy(),
        )
    else:
        samples = make_magnetic_field_samples(
            segment,
            measurement_times_s,
            field_gauss.iloc[:, :3].to_numpy(),
            max(MAG_FUSION_HZ * compute_median_interval_s(sample_times_s), 1.0),
        )
    return add_magnetic_field_states(
        segment,
        samples,
        np.asarray(initial_row[[*Columns.EARTH_MAGNETIC_FIELD, *Columns.BODY_MAGNETIC_FIELD]]),
        np.asarray(initial_row[Columns.FUSION_HORIZON_VARIANCE[-6:]]),
    )


def _compute_mean_magnetic_field(
    segment: ReplaySegment,
    delayed_state: pd.DataFrame,
    measurement_times_s: Array,
    filtered_field_innovation_gauss: Array,
) -> SensorSamples:
    """Return the mean magnetic field (gauss, FRD) between successive logged rows.

    Mean field = predicted field - mean innovation. The mean innovation is computed from logged
    low-pass filtered innovations.
    """
    # Use pairs of successive rows in the segment without a gap between them
    start_times_s, end_times_s = measurement_times_s[:-1], measurement_times_s[1:]
    row_interval_s = end_times_s - start_times_s
    is_used = (start_times_s > segment.time_s[0]) & (end_times_s <= segment.time_s[-1])
    is_used &= (row_interval_s > 0.0) & (row_interval_s < RESTART_GAP_S)
    end_times_s, row_interval_s = end_times_s[is_used], row_interval_s[is_used]
    # The mean innovation ν between two rows follows from the logged filtered innovations f. Each of
    # n samples updates f ← (1 - w) f + w ν. With a constant ν and p = (1 - w)^n, f = p f_previous +
    # (1 - p) ν
    sample_counts = np.maximum(np.rint(MAG_FUSION_HZ * row_interval_s), 1.0)
    sample_interval_s = row_interval_s / sample_counts
    w = sample_interval_s / (sample_interval_s + INNOVATION_LOW_PASS_TIME_CONSTANT_S)
    previous_weight = ((1.0 - w) ** sample_counts)[:, None]
    mean_innovation_gauss = (
        filtered_field_innovation_gauss[1:][is_used]
        - previous_weight * filtered_field_innovation_gauss[:-1][is_used]
    ) / (1.0 - previous_weight)
    # The predicted field is C (earth field - δθ × earth field) + body field. C rotates from NED to
    # the nominal body axes, and δθ is the attitude error. The prediction for row k is the mean over
    # its samples i, weighted as in the low-pass filter
    step_indices, weight = compute_low_pass_weights(
        segment, end_times_s, sample_counts, sample_interval_s, w
    )
    ned_to_body_rotation = segment.body_to_ned[step_indices].swapaxes(2, 3)
    earth_field_gauss, body_field_gauss = (
        _interpolate(delayed_state[names], end_times_s)
        for names in (Columns.EARTH_MAGNETIC_FIELD, Columns.BODY_MAGNETIC_FIELD)
    )
    earth_field_with_attitude_error_gauss = earth_field_gauss[:, None] - np.cross(
        segment.attitude_error_rad[step_indices], earth_field_gauss[:, None]
    )
    expected_field_gauss = (
        np.einsum(
            "ki,kiab,kib->ka", weight, ned_to_body_rotation, earth_field_with_attitude_error_gauss
        )
        + body_field_gauss
    )
    return SensorSamples(
        step_indices[:, 0],  # step of the newest sample
        expected_field_gauss - mean_innovation_gauss,
        np.einsum("ki,kiab->kab", weight, ned_to_body_rotation),
        sample_counts,
        np.zeros(len(sample_counts)),
    )


def add_flow_samples(segment: ReplaySegment, flow: pd.DataFrame, gate: float) -> ReplaySegment:
    """Add the logged optical flow to a part of the flight, as horizontal velocity (body frame).

    The logged velocity is low-pass filtered. The replay fuses the mean velocity between two logged
    samples. ``gate`` is the innovation gate (√S).
    """
    # Each row of the flow table is the mean of several samples; begin_s is the time of the first.
    # Keep the rows whose samples are all in the segment
    begin_s = flow.index - (flow["samples"] - 1.0) * flow["interval_s"]
    flow = flow[(begin_s > segment.time_s[0]) & (flow.index <= segment.time_s[-1])]
    sample_count = flow["samples"].to_numpy()
    interval_s = flow["interval_s"].to_numpy()
    step_index, weight = compute_low_pass_weights(
        segment, flow.index.to_numpy(), sample_count, interval_s, FLOW_FILTER_NEW_SAMPLE_WEIGHT
    )
    # Optical flow measures the velocity along the forward and right axes, so only the first two
    # rows of the rotation to the body frame are used
    ned_to_body_rotation = segment.body_to_ned[step_index].swapaxes(2, 3)[:, :, :2]
    # Flow value k is the mean of samples i, which measured the velocity at different times. The
    # weighted mean of the IMU velocity change since the start of the segment is subtracted. The
    # result is the velocity at the start
    imu_velocity_m_s = np.einsum(
        "ki,kiab,kib->ka", weight, ned_to_body_rotation, segment.imu_velocity_change_m_s[step_index]
    )
    sensor_samples = SensorSamples(
        step_index[:, 0],
        flow[["forward_m_s", "right_m_s"]].to_numpy() - imu_velocity_m_s,
        np.einsum("ki,kiab->kab", weight, ned_to_body_rotation),
        sample_count,
        flow["noise_m2_s2"].to_numpy(),
        gate,
        (VELOCITY,),
    )
    return replace(segment, flow=sensor_samples)


def compute_low_pass_weights(
    segment: ReplaySegment,
    newest_sample_times_s: Array,
    sample_count: Array,
    interval_s: Array,
    new_sample_weight: Array | float,
) -> tuple[IntArray, Array]:
    """Return the samples in each of m low-pass filtered values, and their weights.

    The first array contains the prediction step of each sample. Both arrays have the shape (m, k)
    for up to k samples per value, newest sample first. The weights are those of a first-order
    low-pass filter, and their sum is 1 in each value. A value with fewer than k samples is padded
    with the weight 0.

    Parameters
    ----------
    newest_sample_times_s, sample_count, interval_s : ndarray, shape (m,)
        For each value: time of its newest sample, number of samples, and sample interval.
    new_sample_weight : float or ndarray, shape (m,)
        Weight of the newest sample in one update of the low-pass filter.
    """
    # Age of each sample in sample intervals; the newest sample has age 0
    age_in_samples = np.arange(int(sample_count.max(initial=1.0)))
    weight = np.where(
        age_in_samples < sample_count[:, None],
        (1.0 - np.reshape(new_sample_weight, (-1, 1))) ** age_in_samples,
        0.0,
    )
    weight /= weight.sum(axis=1, keepdims=True)
    measurement_times_s = newest_sample_times_s[:, None] - age_in_samples * interval_s[:, None]
    return np.searchsorted(segment.time_s, measurement_times_s - 1e-9), weight


def make_magnetic_field_samples(
    segment: ReplaySegment, measurement_times_s: Array, field_gauss: Array, sample_weight: float
) -> SensorSamples:
    """Return magnetometer samples of a segment from m logged samples (body FRD).

    ``measurement_times_s``, shape (m,), are EKF2's measurement times. Each logged sample represents
    ``sample_weight`` EKF2 samples.
    """
    step_index, is_inside = find_sample_steps(segment, measurement_times_s)
    sample_count = len(step_index)
    return SensorSamples(
        step_index,
        field_gauss[is_inside],
        segment.body_to_ned[step_index].transpose(0, 2, 1),
        np.full(sample_count, sample_weight),
        np.zeros(sample_count),
    )


def add_magnetic_field_states(
    segment: ReplaySegment,
    samples: SensorSamples,
    initial_fields_gauss: Array,
    field_variance_gauss2: Array,
) -> ReplaySegment:
    """Add magnetometer samples, and the magnetic fields of earth and body as states.

    Parameters
    ----------
    initial_fields_gauss, field_variance_gauss2 : ndarray, shape (6,)
        Initial fields of earth (NED) and body (FRD), and their variances.
    """
    return replace(
        segment,
        state=np.concatenate([segment.state, initial_fields_gauss]),
        variance=np.concatenate([segment.variance, field_variance_gauss2]),
        initial_state_correlation=block_diag(
            segment.initial_state_correlation, np.eye(len(initial_fields_gauss))
        ),
        magnetic_field=samples,
    )


def find_sample_steps(
    segment: ReplaySegment, measurement_times_s: Array
) -> tuple[IntArray, BoolArray]:
    """Return the prediction step of each sample inside the segment, and a mask of these samples."""
    step_index = np.searchsorted(segment.time_s, measurement_times_s - 1e-9)
    is_inside = (step_index > 0) & (step_index < len(segment.time_s))
    return step_index[is_inside], is_inside


def read_prediction_step_s(fusion_record: FusionRecord) -> float:
    """Return EKF2_PREDICT_US in seconds."""
    return fusion_record.parameters.get("EKF2_PREDICT_US", 10_000.0) * 1e-6


def _interpolate(table: pd.DataFrame, times_s: Array) -> Array:
    """Interpolate the columns of a table, indexed by time (s)."""
    return interpolate_columns(times_s, table.index.to_numpy(), table.to_numpy())


def find_step_ends(
    interval_s: Array, logged_step_end_indices: IntArray, configured_step_s: float
) -> IntArray:
    """Return the index of the IMU sample at the end of each prediction step of EKF2."""
    median_interval_s = float(np.median(interval_s))
    # EKF2 counts samples. If samples are missing in the log, an interval counts as several samples.
    # A small number of missing samples is ignored: the IMU itself may have gaps
    sample_counts = np.maximum(np.rint(interval_s / median_interval_s), 1.0)
    if sample_counts.mean() <= 1.0 + MAX_LOST_IMU_FRACTION:
        sample_counts[:] = 1.0
    sample_numbers_at_logged_step_ends = np.append(0.0, np.cumsum(sample_counts))[
        logged_step_end_indices
    ]
    samples_per_step = compute_samples_per_step(
        configured_step_s, median_interval_s, sample_numbers_at_logged_step_ends
    )
    logged_step_end_index_set = set(logged_step_end_indices.tolist())
    end_indices = []
    accumulated_count = accumulated_time_s = 0.0
    for sample, (interval, sample_count) in enumerate(
        zip(interval_s.tolist(), sample_counts.tolist(), strict=True), start=1
    ):
        accumulated_count += sample_count
        accumulated_time_s += interval
        # A step ends if it has enough samples and more than half of the configured length. It also
        # ends after the configured length, and at a logged state (imu_down_sampler.cpp)
        if (
            (accumulated_count >= samples_per_step and accumulated_time_s > 0.5 * configured_step_s)
            or accumulated_time_s > configured_step_s
            or sample in logged_step_end_index_set
        ):
            end_indices.append(sample)
            accumulated_count = accumulated_time_s = 0.0
    return np.array(end_indices, dtype=np.intp)


def downsample_imu(
    rotation_vectors: Array, velocity_increments: Array, step_end_indices: IntArray
) -> ArrayPair:
    """Return rotation (rad) and velocity change (m/s) of each prediction step from IMU samples.

    The velocity change is in the body frame at the end of the step. The rotations in a step are
    small, so rotation vectors are added, and a rotation by φ changes a vector v by φ × v.
    """
    start_indices = np.append(0, step_end_indices[:-1])
    used_count = step_end_indices[-1]
    velocity_increments = velocity_increments[:used_count]
    rotation_rad = cumulative_sums(rotation_vectors[:used_count])
    # Each velocity increment belongs to the attitude in the middle of its interval
    middle_rotation_rad = 0.5 * (rotation_rad[:-1] + rotation_rad[1:])
    step_end_rotation_rad = np.repeat(
        rotation_rad[step_end_indices], step_end_indices - start_indices, axis=0
    )
    rotated_velocity_increments = velocity_increments - np.cross(
        step_end_rotation_rad - middle_rotation_rad, velocity_increments
    )
    return rotation_rad[step_end_indices] - rotation_rad[start_indices], np.add.reduceat(
        rotated_velocity_increments, start_indices, axis=0
    )
