"""Misalignment in yaw between the position source's frame and EKF2's heading, over the flight.

Indoors a disturbed magnetometer may rotate EKF2's heading by tens of degrees within one flight, so
one angle for the flight is not enough. If the source measures an orientation, its heading is
compared with EKF2's heading. Otherwise the positions are filtered along north and east together,
with the IMU acceleration rotated by EKF2's logged attitude. The state is [p, v, b, η]: position,
velocity, acceleration error in NED (m/s²), and rotation (rad) relative to the angle of
linearisation. A likelihood ratio test decides if the rotation is constant or a random walk.
"""

from itertools import product
from typing import Literal, NamedTuple

import numpy as np
import pandas as pd
from msgspec import structs
from scipy.special import chdtrc

from px4fuse.core.arrays import Array, ArrayPair, cumulative_integral
from px4fuse.core.notebook_display import one_line_repr
from px4fuse.core.record import NotNegative, Record, Share
from px4fuse.filter.imu_motion import MAX_IMU_INTERVAL_S
from px4fuse.filter.model import INITIAL_SIGMA_P_M, INITIAL_SIGMA_V_M_S, continuous_noise_unit
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import (
    IMU_GAP_S,
    Acceleration,
    Segment,
    cut_to_segment,
    too_few_measurements,
)
from px4fuse.flight.model import Columns, Flight, PositionTrack, Unavailable
from px4fuse.trajectory.rotation import heading

# Length (s) of the parts of the flight over which the heading error is averaged
PART_LENGTH_S = 2.0
MIN_PARTS = 3
MIN_MEASUREMENTS = 50
MIN_PART_SAMPLES = 3  # minimum number of samples in a part of the flight
# Maximum number of measurements; longer tracks are downsampled: more measurements take time and
# hardly improve the heading
MAX_MEASUREMENTS = 1000
# Maximum p-value of the hypothesis "constant heading error", for a heading error that counts as
# changing in flight
MAX_DRIFT_P_VALUE = 0.002
# Minimum change (°) over the flight of a heading error that counts as changing in flight
MIN_DRIFT_DEG = 5.5
# Maximum yaw rate at which the headings of source and EKF2 are compared: at a higher rate, a delay
# of 0.2 s would look like a heading error of more than 2°
MAX_YAW_RATE_DEG_S = 10.0
# Minimum σ of a heading difference between source and EKF2, for mounting, vibration and rounding
MIN_SIGMA_DEG = 0.5
# Maximum median interval between logged attitudes
MAX_ATTITUDE_INTERVAL_S = 0.11
# Maximum number of linearisations of the filter about the estimated rotation
MAX_LINEARISATIONS = 3
# Maximum change of the rotation by the last linearisation
MAX_FINAL_STEP_RAD = 0.01
STATE_COUNT = 7
ROTATION_INDEX = 6  # index of the rotation in the state
ADJUGATE_SIGNS = np.array([[1.0, -1.0], [-1.0, 1.0]])  # signs in the adjugate of a 2 × 2 matrix
# Initial σ of position (m), velocity (m/s), acceleration error (m/s²) and rotation (rad)
INITIAL_SIGMAS = np.repeat([INITIAL_SIGMA_P_M, INITIAL_SIGMA_V_M_S, 0.3, 0.6], [2, 2, 2, 1])
GAP_SIGMA = 5.0  # process noise of position (m) and velocity (m/s) in a gap of the IMU
# Random walk of the rotation (rad in 1 s): values of the likelihood grid
ROTATION_RANDOM_WALKS = np.radians([0.0, 0.3, 1.0, 3.0])
# Random walk of the acceleration error (m/s² in 1 s): values of the likelihood grid
BIAS_RANDOM_WALKS = np.array([0.003, 0.03])
# SIGMA_A (m/s²): values of the likelihood grid
SIGMA_A_GRID = np.array([0.03, 0.1, 0.3, 1.0])


class HeadingPart(Record, frozen=True):
    """Yaw misalignment of the position source in one part of the flight: span (s), angle, σ (°)."""

    start_s: float
    end_s: float
    heading_error_deg: float
    sigma_deg: NotNegative


class HeadingError(Record, frozen=True):
    """Misalignment in yaw between the source's frame and the logged attitude, over the flight.

    Attributes
    ----------
    misalignment_deg : float
        Mean over the flight.
    sigma_deg : float
        Standard deviation of ``misalignment_deg``. Not reduced by averaging over the parts, because
        the errors of all parts are correlated.
    drifts : bool
        True if the angle changes significantly and by at least ``MIN_DRIFT_DEG``.
    parts : tuple of HeadingPart
        Consecutive parts of the flight. Angles are clockwise from above and include the constant
        misalignment.
    drift_p : float
        p-value of the hypothesis that the angle is constant.
    by : {"orientation", "positions"}
        Data of the position source from which the angle is estimated.
    """

    misalignment_deg: float
    sigma_deg: NotNegative
    drifts: bool
    parts: tuple[HeadingPart, ...]
    drift_p: Share
    by: Literal["orientation", "positions"]

    __repr__ = one_line_repr

    @property
    def ends(self) -> tuple[HeadingPart, HeadingPart]:
        """The parts of the flight with the smallest and the largest angle, in time order."""
        angles_deg = [heading_part.heading_error_deg for heading_part in self.parts]
        first_index, last_index = sorted((int(np.argmin(angles_deg)), int(np.argmax(angles_deg))))
        return self.parts[first_index], self.parts[last_index]


def combine_heading_parts(
    parts: tuple[HeadingPart, ...], drift_p: float, method: Literal["orientation", "positions"]
) -> HeadingError:
    """Combine the heading errors of the parts of a flight into one result."""
    angles_deg = [heading_part.heading_error_deg for heading_part in parts]
    return HeadingError(
        misalignment_deg=float(np.mean(angles_deg)),
        sigma_deg=float(np.mean([heading_part.sigma_deg for heading_part in parts])),
        drifts=drift_p < MAX_DRIFT_P_VALUE and max(angles_deg) - min(angles_deg) >= MIN_DRIFT_DEG,
        parts=parts,
        drift_p=drift_p,
        by=method,
    )


def estimate_heading_error(  # noqa: PLR0911 (one return per missing input)
    flight: Flight,
    track: PositionTrack,
    segment: Segment,
    acceleration: Acceleration | Unavailable,
    settings: Settings,
    sigma_z_m: float,
    offset_s: float = 0.0,
) -> HeadingError | Unavailable:
    """Estimate the misalignment in yaw between the source's frame and the logged attitude.

    Parameters
    ----------
    flight : Flight
    track : PositionTrack
    segment : Segment
    acceleration : Acceleration or Unavailable
        Acceleration along any axis, with that in NED.
    settings : Settings
        Only ``dt_s`` is used, to which SIGMA_A refers.
    sigma_z_m : float
        Noise of the positions.
    offset_s : float
        Time offset added to the timestamps of the track.

    Returns
    -------
    HeadingError, or Unavailable without attitude or with too few measurements or IMU samples.
    """
    if isinstance(flight.attitude, Unavailable):
        return flight.attitude
    if np.median(np.diff(flight.attitude.index)) > MAX_ATTITUDE_INTERVAL_S:
        return Unavailable(
            "heading error", "the attitude rate is too low", "Log the attitude at 10 Hz or more."
        )
    orientation_result = None
    if track.orientation is not None:
        orientation_result = _compare_orientations(
            flight.attitude, track.orientation, segment, offset_s
        )
        if orientation_result is not None and orientation_result.drifts:
            return orientation_result
    if isinstance(acceleration, Unavailable):
        return acceleration
    samples = cut_to_segment(track.samples, segment)[Columns.POSITION[:2]].dropna()
    samples = samples.set_axis(samples.index.to_numpy() + offset_s)
    first_s, last_s = acceleration.time_s[[0, -1]]
    samples = samples[(samples.index >= first_s) & (samples.index <= last_s)]
    if np.median(np.diff(acceleration.time_s)) > MAX_IMU_INTERVAL_S:
        return Unavailable(
            "heading error", "the IMU rate is too low", "Log sensor_combined at full rate."
        )
    if len(samples) < MIN_MEASUREMENTS:
        return too_few_measurements("heading error", len(samples), MIN_MEASUREMENTS)
    samples = samples.iloc[:: int(np.ceil(len(samples) / MAX_MEASUREMENTS))]
    result = _estimate_from_positions(acceleration, samples, settings.dt_s, sigma_z_m)
    # orientations give no absolute angle, because the mounting angle of the source is unknown, but
    # a constant difference of the headings shows that the misalignment is constant
    return (
        result if orientation_result is None else structs.replace(result, drift_p=1.0, drifts=False)
    )


def _mean_per_part(time_s: Array, rotation_rad: Array, sigma_rad: Array) -> tuple[HeadingPart, ...]:
    """Average rotation and σ (rad) over parts of the flight with equal duration; return degrees."""
    # parts of a long, downsampled track may be longer, to contain enough samples
    count = max(
        int(min((time_s[-1] - time_s[0]) / PART_LENGTH_S, len(time_s) / (2 * MIN_PART_SAMPLES))), 1
    )
    edges = np.searchsorted(time_s, np.linspace(time_s[0], time_s[-1], count + 1)[1:-1])
    part_rows = [
        rows for rows in np.split(np.arange(len(time_s)), edges) if len(rows) >= MIN_PART_SAMPLES
    ]
    part_ends = [time_s[rows[[0, -1]]].tolist() for rows in part_rows]
    part_means = [
        np.degrees([rotation_rad[rows].mean(), np.sqrt(np.mean(sigma_rad[rows] ** 2))]).tolist()
        for rows in part_rows
    ]
    return tuple(
        HeadingPart(*span, *mean) for span, mean in zip(part_ends, part_means, strict=True)
    )


def heading_rad(quaternions: pd.DataFrame) -> Array:
    """Return the headings of attitude quaternions (rad, clockwise from above), unwrapped."""
    return heading(quaternions[Columns.QUATERNION].to_numpy())


def _compare_orientations(
    attitude: pd.DataFrame, orientation: pd.DataFrame, segment: Segment, offset_s: float
) -> HeadingError | None:
    """Return the heading of the source minus EKF2's logged heading; None with too few samples."""
    samples = cut_to_segment(orientation, segment)
    time_s = samples.index.to_numpy() + offset_s
    attitude_s = attitude.index.to_numpy()
    is_covered = (time_s >= attitude_s[0]) & (time_s <= attitude_s[-1])
    if np.count_nonzero(is_covered) < MIN_PARTS * MIN_PART_SAMPLES:
        return None
    source_yaw_rad = heading_rad(samples)[is_covered]
    time_s = time_s[is_covered]
    yaw_rad = np.interp(time_s, attitude_s, heading_rad(attitude))
    rotation_rad = source_yaw_rad - yaw_rad
    rotation_rad -= 2.0 * np.pi * np.round(np.median(rotation_rad) / (2.0 * np.pi))
    is_calm = np.abs(np.gradient(yaw_rad, time_s)) < np.radians(MAX_YAW_RATE_DEG_S)
    if np.count_nonzero(is_calm) < MIN_PARTS * MIN_PART_SAMPLES:
        return None
    time_s = time_s[is_calm]
    rotation_rad = rotation_rad[is_calm]
    # σ from differences of successive samples; averaging does not reduce it, because the errors are
    # correlated
    noise_rad = 1.4826 * np.median(np.abs(np.diff(rotation_rad))) / np.sqrt(2.0)
    sigma_rad = np.full(len(time_s), max(float(noise_rad), np.radians(MIN_SIGMA_DEG)))
    part_headings = _mean_per_part(time_s, rotation_rad, sigma_rad)
    if len(part_headings) < MIN_PARTS:
        return None
    angles_deg = np.array([heading_part.heading_error_deg for heading_part in part_headings])
    chi_square = np.sum((angles_deg - angles_deg.mean()) ** 2) / np.degrees(sigma_rad[0]) ** 2
    return combine_heading_parts(
        part_headings, float(chdtrc(len(part_headings) - 1, chi_square)), "orientation"
    )


def _estimate_from_positions(
    acceleration: Acceleration, samples: pd.DataFrame, dt_s: float, sigma_z: float
) -> HeadingError:
    """Estimate the frame's rotation as a filter state, with maximum-likelihood noises of a grid."""
    time = samples.index.to_numpy()
    measured_m = samples.to_numpy()
    interval_inputs = _interval_inputs(acceleration, time)
    # √DT converts SIGMA_A, the σ of the acceleration over one DT, to a velocity random walk in 1 s
    grid = np.array(
        list(product(ROTATION_RANDOM_WALKS, BIAS_RANDOM_WALKS, SIGMA_A_GRID * np.sqrt(dt_s)))
    )
    is_constant = grid[:, 0] == 0.0
    rotation_rad = 0.0
    for _ in range(MAX_LINEARISATIONS):
        log_p, _, steps = _run_filters(
            interval_inputs, measured_m, rotation_rad, grid[is_constant], sigma_z
        )
        step = float(steps[-1].x[np.argmax(log_p), ROTATION_INDEX])
        rotation_rad += step
        if abs(step) < MAX_FINAL_STEP_RAD:
            break
    rotation_rad = float(np.angle(np.exp(1j * rotation_rad)))
    log_p, scale, steps = _run_filters(interval_inputs, measured_m, rotation_rad, grid, sigma_z)
    best_index = int(np.argmax(log_p))
    likelihood_ratio = 2.0 * (log_p[best_index] - log_p[is_constant].max())
    smoothed, variance = _smooth_rotation(steps, best_index)
    # one-sided test: the random walk cannot be negative
    p_value = 0.5 * float(chdtrc(1, likelihood_ratio)) if likelihood_ratio > 0.0 else 1.0
    sigma = np.sqrt(scale[best_index] * np.maximum(variance, 0.0))
    return combine_heading_parts(
        _mean_per_part(time, rotation_rad + smoothed, sigma), p_value, "positions"
    )


def _interval_inputs(acceleration: Acceleration, time: Array) -> tuple[Array, Array, Array]:
    """Integrate the acceleration over each interval between positions.

    Return Δp (m) and Δv (m/s) north and east, shape (n, 4); interval lengths (s); and a mask of
    intervals with an IMU gap.
    """
    imu_s, acceleration_m_s2 = acceleration.time_s, acceleration.ned_m_s2[:, :2]
    velocity = cumulative_integral(acceleration_m_s2, imu_s)
    integrals = np.hstack([velocity, cumulative_integral(velocity, imu_s)])
    integrals = np.column_stack([np.interp(time, imu_s, column) for column in integrals.T])
    dt = np.diff(time)
    gaps = np.append(0.0, np.cumsum(np.diff(imu_s) > IMU_GAP_S))
    has_gap = np.diff(np.interp(time, imu_s, gaps)) > 0.0
    increments = np.diff(integrals, axis=0)
    return (
        np.hstack([increments[:, 2:] - integrals[:-1, :2] * dt[:, None], increments[:, :2]]),
        dt,
        has_gap,
    )


def _transitions(increments: Array, dt_s: Array, rotation_rad: float) -> ArrayPair:
    """Return transition matrix F and input vector of each interval between positions.

    Both are linearised about the frame rotation ``rotation_rad``.
    """
    count = len(dt_s)
    dt = dt_s[:, None, None]
    cosine = np.cos(rotation_rad)
    sine = np.sin(rotation_rad)
    rotation = np.array([[cosine, -sine], [sine, cosine]])
    rotation_slope = np.array([[-sine, -cosine], [cosine, -sine]])
    increments = increments.reshape(count, 2, 2)
    F = np.tile(np.eye(STATE_COUNT), (count, 1, 1))
    F[:, :2, 2:4] = F[:, 2:4, 4:6] = dt * np.eye(2)
    F[:, :2, 4:6] = dt**2 / 2.0 * np.eye(2)
    F[:, :4, ROTATION_INDEX] = (increments @ rotation_slope.T).reshape(count, 4)
    inputs = np.zeros((count, STATE_COUNT))
    inputs[:, :4] = (increments @ rotation.T).reshape(count, 4)
    return F, inputs


def _process_noise(dt_s: Array, has_gap: Array, noises: Array) -> Array:
    """Return the process noise Q of n intervals for k sets of noises, shape (n, k, 7, 7)."""
    position, velocity, bias = (slice(axis, axis + 2) for axis in (0, 2, 4))
    identity = np.eye(2)
    count = len(noises)
    sigma_a_block = (noises[:, 2] ** 2)[:, None, None] * identity
    # matrices that are scaled and added to Q: for the elements 00, 01, 11 of the acceleration
    # noise, for the random walks in 1 s, and for an IMU gap
    unit_00, unit_01, unit_11, unit_second, unit_gap = unit_noises = np.zeros(
        (5, count, STATE_COUNT, STATE_COUNT)
    )
    unit_00[:, position, position] = unit_11[:, velocity, velocity] = sigma_a_block
    unit_01[:, position, velocity] = unit_01[:, velocity, position] = sigma_a_block
    unit_second[:, bias, bias] = (noises[:, 1] ** 2)[:, None, None] * identity
    unit_second[:, ROTATION_INDEX, ROTATION_INDEX] = noises[:, 0] ** 2
    unit_gap[:, position, position] = unit_gap[:, velocity, velocity] = GAP_SIGMA**2 * identity
    amounts = np.stack([*continuous_noise_unit(dt_s), dt_s, has_gap], axis=1)
    return np.asarray((amounts @ unit_noises.reshape(5, -1)).reshape(-1, *unit_noises.shape[1:]))


class _FilterStep(NamedTuple):
    """Prediction and update of k filters: F, state and covariance before and after the update."""

    F: Array
    x_prior: Array
    P_prior: Array
    x: Array
    P: Array


def _run_filters(
    interval_inputs: tuple[Array, Array, Array],
    measured_m: Array,
    rotation_rad: float,
    noises: Array,
    sigma_z: float,
) -> tuple[Array, Array, list[_FilterStep]]:
    """Run k filters with different noises; return ln p, the noise scale squared, and filter steps.

    ln p is for all noises multiplied by the maximum-likelihood scale. The first filter step is the
    initial state.
    """
    increments, length_s, has_gap = interval_inputs
    count = len(noises)
    x = np.zeros((count, STATE_COUNT))
    x[:, :2] = measured_m[0]
    P = np.tile(np.diag(INITIAL_SIGMAS**2), (count, 1, 1))
    steps = [_FilterStep(np.eye(STATE_COUNT), x, P, x, P)]
    square_sum = np.zeros(count)
    log_s = np.zeros(count)
    R = sigma_z**2 * np.eye(2)
    Q_of = _process_noise(length_s, has_gap, noises)
    for z, F, input_step, Q in zip(
        measured_m[1:], *_transitions(increments, length_s, rotation_rad), Q_of, strict=True
    ):
        x_prior = x @ F.T + input_step
        P_prior = F @ P @ F.T + Q
        S = P_prior[:, :2, :2] + R
        # closed form of the 2 × 2 inverse of S
        determinant = S[:, 0, 0] * S[:, 1, 1] - S[:, 0, 1] ** 2
        inverse_s = S[:, ::-1, ::-1] * ADJUGATE_SIGNS / determinant[:, None, None]
        K = np.swapaxes(P_prior[:, :2, :], 1, 2) @ inverse_s
        innovation = (z - x_prior[:, :2])[..., None]
        square_sum += (np.swapaxes(innovation, 1, 2) @ inverse_s @ innovation)[:, 0, 0]
        log_s += np.log(determinant)
        x = x_prior + (K @ innovation)[..., 0]
        P = P_prior - K @ P_prior[:, :2, :]
        P = (P + np.swapaxes(P, 1, 2)) / 2.0
        steps.append(_FilterStep(F, x_prior, P_prior, x, P))
    value_count = 2 * len(length_s)
    scale = square_sum / value_count
    return -0.5 * (value_count * np.log(scale) + log_s), scale, steps


def _smooth_rotation(steps: list[_FilterStep], filter_index: int) -> ArrayPair:
    """Return the smoothed frame rotation (rad) and its variance (Rauch, Tung, Striebel 1965)."""
    state = steps[-1].x[filter_index]
    covariance = steps[-1].P[filter_index]
    rotations = [(state[ROTATION_INDEX], covariance[ROTATION_INDEX, ROTATION_INDEX])]
    for step, next_step in zip(steps[-2::-1], steps[:0:-1], strict=True):
        P_prior = next_step.P_prior[filter_index]
        P = step.P[filter_index]
        gain = np.linalg.solve(P_prior, next_step.F @ P).T
        state = step.x[filter_index] + gain @ (state - next_step.x_prior[filter_index])
        covariance = P + gain @ (covariance - P_prior) @ gain.T
        rotations.append((state[ROTATION_INDEX], covariance[ROTATION_INDEX, ROTATION_INDEX]))
    rotation_rad, variance = np.array(rotations[::-1]).T
    return rotation_rad, variance
