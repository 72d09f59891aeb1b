"""Misalignment of the positions' frame against the logged heading, over the flight.

Indoors a magnetometer may rotate EKF2's heading by tens of degrees within one flight, so one angle
for the flight is not enough. If the source has an orientation, both headings are compared.
Otherwise the positions are filtered along north and east together, with the IMU acceleration
rotated by the logged attitude. The state is [p, v, b, η]: b the acceleration error in NED (m/s²), η
the rotation (rad) beyond the angle of linearisation, which may be a random walk. A likelihood ratio
test decides if it is.
"""

from itertools import product
from typing import Literal, NamedTuple

import numpy as np
import pandas as pd
from msgspec import structs
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc

from px4fuse.arrays import Array, cumulative_integral
from px4fuse.filter.imu_motion import MAX_IMU_INTERVAL_S
from px4fuse.filter.model import INITIAL_SIGMA_P_M, INITIAL_SIGMA_V_M_S, continuous_noise_unit
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import IMU_GAP_S, Segment, ned_acceleration, within
from px4fuse.flight import Columns, Flight, PositionTrack, Unavailable
from px4fuse.notebook_display import one_line_repr
from px4fuse.record import NotNegative, Record, Share

# s; averaging time of the parts
PART_LENGTH_S = 2.0
MIN_PARTS = 3
MIN_MEASUREMENTS = 50
MIN_PART_SAMPLES = 3
# More measurements hardly improve the heading and take time
MAX_MEASUREMENTS = 1000
# p value and range (°) from which the heading error changes significantly
MAX_DRIFT_P = 0.002
MIN_DRIFT_DEG = 5.5
# At higher yaw rates a late timestamp looks like a heading error: 0.2 s are 2°
MAX_TURN_RATE_DEG_S = 10.0
# Smallest σ of a heading difference: mounting, vibration, rounding
MIN_SIGMA_DEG = 0.5
MAX_ATTITUDE_INTERVAL_S = 0.11
LINEARISATIONS = 3
# Change of the linearisation angle below which the iteration stops
SMALL_TURN_RAD = 0.01
STATE_COUNT = 7
TURN = 6  # index of the rotation in the state
ADJUGATE_SIGNS = np.array([[1.0, -1.0], [-1.0, 1.0]])
# Initial σ: position (m), velocity (m/s), acceleration error (m/s²) and rotation (rad)
INITIAL_SIGMAS = np.repeat([INITIAL_SIGMA_P_M, INITIAL_SIGMA_V_M_S, 0.3, 0.6], [2, 2, 2, 1])
GAP_SIGMA = 5.0  # m and m/s; process noise in a gap of the IMU
# Grid: random walks in 1 s of rotation (rad) and acceleration error (m/s²), and SIGMA_A (m/s²)
TURN_WALKS = np.radians([0.0, 0.3, 1.0, 3.0])
BIAS_WALKS = np.array([0.003, 0.03])
SIGMA_A_GRID = np.array([0.03, 0.1, 0.3, 1.0])


class HeadingPart(Record, frozen=True):
    """Heading error of one part of the flight: start and end (s), angle and its σ (°)."""

    start_s: float
    end_s: float
    heading_error_deg: float
    sigma_deg: NotNegative


class HeadingError(Record, frozen=True):
    """Misalignment of the source's frame in yaw against the logged attitude, over the flight.

    Attributes
    ----------
    misalignment_deg : float
        Mean over the flight.
    sigma_deg : float
        Standard deviation of the mean; not reduced by averaging, as errors are common to all parts.
    drifts : bool
        True if the angle changes significantly and by at least ``MIN_DRIFT_DEG``.
    parts : tuple of HeadingPart
        Consecutive parts; angles clockwise from above, including the constant misalignment.
    drift_p : float
        p-value of a constant angle.
    by : {"orientation", "positions"}
        Data from which the angle is estimated.
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
        """Parts with the smallest and the largest angle, in time order."""
        turns_deg = [heading_part.heading_error_deg for heading_part in self.parts]
        first_index, last_index = sorted((int(np.argmin(turns_deg)), int(np.argmax(turns_deg))))
        return self.parts[first_index], self.parts[last_index]


def combine_heading_parts(
    parts: tuple[HeadingPart, ...], drift_p: float, by: Literal["orientation", "positions"]
) -> HeadingError:
    """Combine the parts of a flight into one result."""
    turns_deg = [heading_part.heading_error_deg for heading_part in parts]
    return HeadingError(
        misalignment_deg=float(np.mean(turns_deg)),
        sigma_deg=float(np.mean([heading_part.sigma_deg for heading_part in parts])),
        drifts=drift_p < MAX_DRIFT_P and max(turns_deg) - min(turns_deg) >= MIN_DRIFT_DEG,
        parts=parts,
        drift_p=drift_p,
        by=by,
    )


def estimate_heading_error(
    flight: Flight,
    track: PositionTrack,
    segment: Segment,
    settings: Settings,
    sigma_z_m: float,
    offset_s: float = 0.0,
) -> HeadingError | Unavailable:
    """Estimate the source frame's misalignment in yaw against the logged attitude.

    Parameters
    ----------
    flight : Flight
    track : PositionTrack
    segment : Segment
    settings : Settings
        Its ``dt_s`` defines the unit of SIGMA_A.
    sigma_z_m : float
        Noise of the positions.
    offset_s : float
        Added to the timestamps of the track.

    Returns
    -------
    HeadingError, or Unavailable without attitude or with too few measurements or IMU samples.
    """
    if isinstance(flight.attitude, Unavailable):
        return flight.attitude
    if np.median(np.diff(flight.attitude.index.to_numpy())) > MAX_ATTITUDE_INTERVAL_S:
        return Unavailable(
            "heading error", "the attitude rate is too low", "Log it at 10 Hz or more."
        )
    by_orientation = None
    if track.orientation is not None:
        by_orientation = _compare_orientations(
            flight.attitude, track.orientation, segment, offset_s
        )
        if by_orientation is not None and by_orientation.drifts:
            return by_orientation
    acceleration = ned_acceleration(flight)
    if isinstance(acceleration, Unavailable):
        return acceleration
    samples = within(track.samples, segment)[Columns.POSITION[:2]].dropna()
    samples = samples.set_axis(samples.index.to_numpy() + offset_s)
    first_s, last_s = acceleration.index[[0, -1]]
    samples = samples[(samples.index >= first_s) & (samples.index <= last_s)]
    is_slow = np.median(np.diff(acceleration.index.to_numpy())) > MAX_IMU_INTERVAL_S
    count = len(samples)
    if is_slow or count < MIN_MEASUREMENTS:
        return (
            Unavailable(
                "heading error", "the IMU rate is too low", "Log sensor_combined at full rate."
            )
            if is_slow
            else Unavailable(
                "heading error",
                f"only {count} measurements",
                "Log sensor_combined at full rate, and analyse a longer segment.",
            )
        )
    samples = samples.iloc[:: int(np.ceil(len(samples) / MAX_MEASUREMENTS))]
    result = _estimate_from_positions(acceleration, samples, settings.dt_s, sigma_z_m)
    # the mounting angle of the source is unknown but constant, so the orientations exclude a change
    return result if by_orientation is None else structs.replace(result, drift_p=1.0, drifts=False)


def _mean_per_part(time: Array, turn: Array, sigma: Array) -> tuple[HeadingPart, ...]:
    """Return means over parts of equal length, in degrees."""
    # long flights are downsampled, which limits the number of parts
    count = max(
        int(min((time[-1] - time[0]) / PART_LENGTH_S, len(time) / (2 * MIN_PART_SAMPLES))), 1
    )
    edges = np.searchsorted(time, np.linspace(time[0], time[-1], count + 1)[1:-1])
    part_rows = [
        rows for rows in np.split(np.arange(len(time)), edges) if len(rows) >= MIN_PART_SAMPLES
    ]
    part_ends = [time[rows[[0, -1]]].tolist() for rows in part_rows]
    part_means = [
        np.degrees([turn[rows].mean(), np.sqrt(np.mean(sigma[rows] ** 2))]).tolist()
        for rows in part_rows
    ]
    return tuple(
        HeadingPart(*span, *mean) for span, mean in zip(part_ends, part_means, strict=True)
    )


def heading_rad(quaternions: pd.DataFrame) -> Array:
    """Return the heading of attitudes (rad, clockwise from above), unwrapped."""
    values = quaternions[Columns.QUATERNION].to_numpy(copy=True)
    angles: Array = Rotation.from_quat(values, scalar_first=True).as_euler("ZYX")[:, 0]
    return np.unwrap(angles)


def _compare_orientations(
    attitude: pd.DataFrame, orientation: pd.DataFrame, segment: Segment, offset_s: float
) -> HeadingError | None:
    """Return the source's heading minus the attitude's, at low yaw rates; None if too few."""
    samples = within(orientation, segment)
    time = samples.index.to_numpy() + offset_s
    attitude_s = attitude.index.to_numpy()
    is_covered = (time >= attitude_s[0]) & (time <= attitude_s[-1])
    if np.count_nonzero(is_covered) < MIN_PARTS * MIN_PART_SAMPLES:
        return None
    source_heading, time = heading_rad(samples)[is_covered], time[is_covered]
    yaw = np.interp(time, attitude_s, heading_rad(attitude))
    turn = source_heading - yaw
    turn -= 2.0 * np.pi * np.round(np.median(turn) / (2.0 * np.pi))
    is_calm = np.abs(np.gradient(yaw, time)) < np.radians(MAX_TURN_RATE_DEG_S)
    if np.count_nonzero(is_calm) < MIN_PARTS * MIN_PART_SAMPLES:
        return None
    time, turn = time[is_calm], turn[is_calm]
    # differences of neighbours give the noise; it is not reduced by averaging
    noise = 1.4826 * np.median(np.abs(np.diff(turn))) / np.sqrt(2.0)
    sigma = np.full(len(time), max(float(noise), np.radians(MIN_SIGMA_DEG)))
    heading_parts = _mean_per_part(time, turn, sigma)
    if len(heading_parts) < MIN_PARTS:
        return None
    turns_deg = np.array([heading_part.heading_error_deg for heading_part in heading_parts])
    chi_square = np.sum((turns_deg - turns_deg.mean()) ** 2) / np.degrees(sigma[0]) ** 2
    return combine_heading_parts(
        heading_parts, float(chdtrc(len(heading_parts) - 1, chi_square)), "orientation"
    )


def _estimate_from_positions(
    acceleration: pd.DataFrame, samples: pd.DataFrame, dt_s: float, sigma_z: float
) -> HeadingError:
    """Estimate the rotation as a state that may be a random walk, over a grid of noises."""
    time, measured_m = samples.index.to_numpy(), samples.to_numpy()
    interval_inputs = _interval_inputs(acceleration, time)
    # √DT converts SIGMA_A, a σ over one DT, to a random walk in 1 s
    grid = np.array(list(product(TURN_WALKS, BIAS_WALKS, SIGMA_A_GRID * np.sqrt(dt_s))))
    has_no_walk = grid[:, 0] == 0.0
    turn = 0.0
    for _ in range(LINEARISATIONS):
        log_p, _, steps = _run_filters(
            interval_inputs, measured_m, turn, grid[has_no_walk], sigma_z
        )
        step = float(steps[-1].x[np.argmax(log_p), TURN])
        turn += step
        if abs(step) < SMALL_TURN_RAD:
            break
    turn = float(np.angle(np.exp(1j * turn)))
    log_p, scale, steps = _run_filters(interval_inputs, measured_m, turn, grid, sigma_z)
    best_index = int(np.argmax(log_p))
    ratio = 2.0 * (log_p[best_index] - log_p[has_no_walk].max())
    smoothed, variance = _smooth_turn(steps, best_index)
    # one-sided test: the random walk cannot be negative
    p_value = 0.5 * float(chdtrc(1, ratio)) if ratio > 0.0 else 1.0
    sigma = np.sqrt(scale[best_index] * np.maximum(variance, 0.0))
    return combine_heading_parts(_mean_per_part(time, turn + smoothed, sigma), p_value, "positions")


def _interval_inputs(acceleration: pd.DataFrame, time: Array) -> tuple[Array, Array, Array]:
    """Return Δp (m) and Δv (m/s) north and east, (n, 4), interval lengths (s) and IMU gaps."""
    imu_s, acceleration_m_s2 = acceleration.index.to_numpy(), acceleration.to_numpy()[:, :2]
    velocity = cumulative_integral(acceleration_m_s2, imu_s)
    integrals = np.hstack([velocity, cumulative_integral(velocity, imu_s)])
    integrals = np.column_stack([np.interp(time, imu_s, column) for column in integrals.T])
    dt = np.diff(time)
    gaps = np.concatenate([[0.0], np.cumsum(np.diff(imu_s) > IMU_GAP_S)])
    has_gap = np.diff(np.interp(time, imu_s, gaps)) > 0.0
    change = np.diff(integrals, axis=0)
    return np.hstack([change[:, 2:] - integrals[:-1, :2] * dt[:, None], change[:, :2]]), dt, has_gap


def _transitions(increments: Array, dt_s: Array, turn: float) -> tuple[Array, Array]:
    """Return F and the input of every interval, linearised about the rotation ``turn``."""
    count, dt = len(dt_s), dt_s[:, None, None]
    cosine, sine = np.cos(turn), np.sin(turn)
    rotation = np.array([[cosine, -sine], [sine, cosine]])
    rotation_slope = np.array([[-sine, -cosine], [cosine, -sine]])
    increments = increments.reshape(count, 2, 2)
    F = np.tile(np.eye(STATE_COUNT), (count, 1, 1))
    F[:, :2, 2:4] = F[:, 2:4, 4:6] = dt * np.eye(2)
    F[:, :2, 4:6] = dt**2 / 2.0 * np.eye(2)
    F[:, :4, TURN] = (increments @ rotation_slope.T).reshape(count, 4)
    inputs = np.zeros((count, STATE_COUNT))
    inputs[:, :4] = (increments @ rotation.T).reshape(count, 4)
    return F, inputs


def _process_noise(dt_s: Array, gap: Array, noises: Array) -> Array:
    """Return Q of every interval for each of k settings, shape (n, k, 7, 7)."""
    position, velocity, bias = (slice(axis, axis + 2) for axis in (0, 2, 4))
    identity, count = np.eye(2), len(noises)
    sigma_a_block = (noises[:, 2] ** 2)[:, None, None] * identity
    # Q per unit of q00, q01, q11, per second and per gap
    unit_00, unit_01, unit_11, unit_second, unit_gap = unit_noises = np.zeros(
        (5, count, STATE_COUNT, STATE_COUNT)
    )
    unit_00[:, position, position] = unit_11[:, velocity, velocity] = sigma_a_block
    unit_01[:, position, velocity] = unit_01[:, velocity, position] = sigma_a_block
    unit_second[:, bias, bias] = (noises[:, 1] ** 2)[:, None, None] * identity
    unit_second[:, TURN, TURN] = noises[:, 0] ** 2
    unit_gap[:, position, position] = unit_gap[:, velocity, velocity] = GAP_SIGMA**2 * identity
    amounts = np.stack([*continuous_noise_unit(dt_s), dt_s, gap], axis=1)
    return np.asarray((amounts @ unit_noises.reshape(5, -1)).reshape(-1, *unit_noises.shape[1:]))


class _FilterStep(NamedTuple):
    """F of one interval, and states and covariances of k filters before and after the update."""

    F: Array
    x_prior: Array
    P_prior: Array
    x: Array
    P: Array


def _run_filters(
    interval_inputs: tuple[Array, Array, Array],
    measured_m: Array,
    turn: float,
    noises: Array,
    sigma_z: float,
) -> tuple[Array, Array, list[_FilterStep]]:
    """Return ln p of k filters with the best common scale, its square, and all steps.

    The first step is the initial state.
    """
    increments, length_s, has_gap = interval_inputs
    count = len(noises)
    x = np.zeros((count, STATE_COUNT))
    x[:, :2] = measured_m[0]
    P = np.tile(np.diag(INITIAL_SIGMAS**2), (count, 1, 1))
    steps = [_FilterStep(np.eye(STATE_COUNT), x, P, x, P)]
    square, log_s = np.zeros(count), np.zeros(count)
    R = sigma_z**2 * np.eye(2)
    Q_of = _process_noise(length_s, has_gap, noises)
    for z, F, input_step, Q in zip(
        measured_m[1:], *_transitions(increments, length_s, turn), Q_of, strict=True
    ):
        x_prior, P_prior = x @ F.T + input_step, F @ P @ F.T + Q
        S = P_prior[:, :2, :2] + R
        # closed form of the 2 × 2 inverse of S
        determinant = S[:, 0, 0] * S[:, 1, 1] - S[:, 0, 1] ** 2
        inverse = S[:, ::-1, ::-1] * ADJUGATE_SIGNS / determinant[:, None, None]
        K = np.swapaxes(P_prior[:, :2, :], 1, 2) @ inverse
        y = (z - x_prior[:, :2])[..., None]
        square += (np.swapaxes(y, 1, 2) @ inverse @ y)[:, 0, 0]
        log_s += np.log(determinant)
        x = x_prior + (K @ y)[..., 0]
        P = P_prior - K @ P_prior[:, :2, :]
        P = (P + np.swapaxes(P, 1, 2)) / 2.0
        steps.append(_FilterStep(F, x_prior, P_prior, x, P))
    size = 2 * len(length_s)
    scale = square / size
    return -0.5 * (size * np.log(scale) + log_s), scale, steps


def _smooth_turn(steps: list[_FilterStep], filter_index: int) -> tuple[Array, Array]:
    """Smooth the rotation over all measurements; return it with its variance (RTS, 1965)."""
    state, covariance = steps[-1].x[filter_index], steps[-1].P[filter_index]
    turns = [(state[TURN], covariance[TURN, TURN])]
    for step, next_step in zip(steps[-2::-1], steps[:0:-1], strict=True):
        P_prior, P = next_step.P_prior[filter_index], step.P[filter_index]
        gain = np.linalg.solve(P_prior, next_step.F @ P).T
        state = step.x[filter_index] + gain @ (state - next_step.x_prior[filter_index])
        covariance = P + gain @ (covariance - P_prior) @ gain.T
        turns.append((state[TURN], covariance[TURN, TURN]))
    turn, variance = np.array(turns[::-1]).T
    return turn, variance
