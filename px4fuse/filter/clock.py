"""Clock offset between the position source and the IMU, by joint maximum likelihood.

Positions whose stamps are wrong by τ lag or lead what the IMU felt. Innovations hardly grow, since
the filter follows; what shows is that they agree with the acceleration. So the likelihood of the
positions is maximised over τ, jointly with everything that could pass for it: the accelerometers'
and gyros' biases and the errors of the initial attitude are states of the filter, and the noises
are fitted at every τ.

The attitude is integrated from the gyros alone, from the logged attitude at the start: EKF2's own
later attitude was corrected by the very positions that are in question, and carries their lateness.

Per stretch, the state is [p, v, c], p and v in NED and c nine constants: errors of the initial
attitude (rad, NED), gyro biases (rad/s, body) and accelerometer biases (m/s², body). To first order
the acceleration is linear in c, so each constant's own signal is integrated once, and τ only moves
where the integrals are read.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy import constants
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation, Slerp
from scipy.stats import chi2

from px4fuse.arrays import Array
from px4fuse.filter.kalman import Settings
from px4fuse.filter.likelihood import parabola_vertex, profile_interval
from px4fuse.filter.model import INITIAL_SIGMA_P_M, INITIAL_SIGMA_V_M_S, move, noise_of_many_steps
from px4fuse.filter.signals import Segment, within
from px4fuse.flight import (
    ANGULAR_RATE_COLUMNS,
    POSITION_COLUMNS,
    QUATERNION_COLUMNS,
    SPECIFIC_FORCE_COLUMNS,
    Flight,
    PositionTrack,
    Unavailable,
)
from px4fuse.trajectory.graph import lie

# Standard deviations of the constants, wide for consumer sensors: tilt and heading (rad), gyro
# (rad/s) and accelerometer (m/s²)
CONSTANT_SIGMA = np.repeat([0.05, 0.004, 0.3], 3)
CONSTANTS = len(CONSTANT_SIGMA)
HEADING = 2  # which of them is a turn about down
STATE_COUNT = 6 + CONSTANTS
# To first order only while the angles stay small: longer flights are cut into stretches. A gyro
# bias of 0.004 rad/s turns by 0.12 rad in one, whose square costs 0.07 m/s².
STRETCH_S = 30.0
# Stretches on which changes of the offset are sought
PART_S = STRETCH_S
SEARCH_S = 0.6
COARSE_POINTS, FINE_POINTS = 25, 31
SIGMA_A_FACTORS = np.geomspace(0.25, 2.0, 5)
MIN_MEASUREMENTS = 30
# A wider interval says nothing that a student could use
MAX_HALF_INTERVAL_S = 0.15
# Gyros are averaged to this interval before they are integrated
GYRO_STEP_S = 0.02
# Parts further apart than chance would put them (two-sided)
CHANGE_P = 0.005


@dataclass(frozen=True)
class PartOffset:
    """Offset of one part of the flight: start, end, offset and its standard deviation, all s."""

    start_s: float
    end_s: float
    offset_s: float
    sigma_s: float


@dataclass(frozen=True)
class ClockOffset:
    """What must be added to the position source's stamps.

    Attributes
    ----------
    offset_s : float
        Most likely; negative where the stamps are late.
    interval_s : (float, float)
        95 % profile-likelihood interval.
    sigma_s : float
        Standard deviation by the curvature at the maximum.
    determinable : bool
        Whether the interval is narrow enough, and closed, to say anything.
    reason : str
        Why not, where it is not; else empty.
    curve_s, curve_drop : ndarray, shape (n,)
        Offsets, and how far each lies below the greatest log-likelihood.
    parts : tuple of PartOffset
        Offsets of consecutive parts.
    drift_ppm, drift_sigma_ppm : float or None
        Of the source's clock against the autopilot's, from the parts; None with fewer than three.
    change_p : float or None
        p-value of "all parts have the same offset"; None with fewer than two parts.
    sigma_a_m_s2, sigma_z_m : float
        Noises at the maximum.
    count : int
        Measurements.
    heading_error_deg, heading_sigma_deg : float
        By how much the source's frame is turned, clockwise seen from above, against the logged
        attitude; and its standard deviation.
    """

    offset_s: float
    interval_s: tuple[float, float]
    sigma_s: float
    determinable: bool
    reason: str
    curve_s: Array
    curve_drop: Array
    parts: tuple[PartOffset, ...]
    drift_ppm: float | None
    drift_sigma_ppm: float | None
    change_p: float | None
    sigma_a_m_s2: float
    sigma_z_m: float
    count: int
    heading_error_deg: float
    heading_sigma_deg: float


@dataclass(frozen=True)
class _Signals:
    """Acceleration of one stretch and of each constant, and their integrals.

    ``value``, ``velocity`` and ``position`` have shape (n, 3, 1 + CONSTANTS); the first is the
    acceleration with all constants zero.
    """

    time_s: Array
    value: Array
    velocity: Array
    position: Array

    def between(self, time_s: Array) -> tuple[Array, Array]:
        """Change of velocity and of position beyond constant velocity from each time to the next.

        Parameters
        ----------
        time_s : ndarray, shape (..., m + 1)

        Returns
        -------
        velocity, position : ndarray, shape (..., m, 3, 1 + CONSTANTS)
        """
        at = np.clip(np.searchsorted(self.time_s, time_s, side="right") - 1, 0, None)
        ahead = (time_s - self.time_s[at])[..., None, None]
        position, velocity = move(self.position[at], self.velocity[at], self.value[at], ahead)
        step = np.diff(time_s, axis=-1)[..., None, None]
        before, after = velocity[..., :-1, :, :], velocity[..., 1:, :, :]
        return after - before, np.diff(position, axis=-3) - before * step


@dataclass(frozen=True)
class _Stretch:
    """Measurements of one stretch and the signals under them."""

    signals: _Signals
    time_s: Array
    position_m: Array


def estimate_clock_offset(
    flight: Flight,
    track: PositionTrack,
    segment: Segment,
    settings: Settings,
    sigma_z_m: float,
    outlier_time_s: Array | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> ClockOffset | Unavailable:
    """Estimate what must be added to the stamps of a position track.

    Parameters
    ----------
    flight : Flight
    track : PositionTrack
        As logged.
    segment : Segment
    settings : Settings
        ``dt_s`` gives SIGMA_A its meaning; ``sigma_a_m_s2`` is where its search starts.
    sigma_z_m : float
        Measurement noise to start with, of all axes.
    outlier_time_s : ndarray, optional
        Measurements to leave out.
    progress : callable

    Returns
    -------
    ClockOffset, or Unavailable where there is no IMU, no attitude or too few measurements.
    """
    if isinstance(flight.imu, Unavailable):
        return flight.imu
    if isinstance(flight.attitude, Unavailable):
        return flight.attitude
    samples = within(track.samples, segment)[POSITION_COLUMNS].dropna(subset=POSITION_COLUMNS[:2])
    if outlier_time_s is not None and len(outlier_time_s):
        samples = samples[~np.isin(samples.index.to_numpy(), outlier_time_s)]
    low = max(flight.imu.index[0], flight.attitude.index[0]) + SEARCH_S
    high = min(flight.imu.index[-1], flight.attitude.index[-1]) - SEARCH_S
    samples = samples[(samples.index >= low) & (samples.index <= high)]
    if len(samples) < MIN_MEASUREMENTS:
        return Unavailable(
            "clock offset",
            f"{len(samples)} measurements with IMU and attitude are too few (at least "
            f"{MIN_MEASUREMENTS})",
            "Analyse a longer segment.",
        )
    progress("clock offset")
    stretches = _stretches(flight.imu, flight.attitude, samples, STRETCH_S)
    sigma_a, sigma_z, offset = settings.sigma_a_m_s2, sigma_z_m, 0.0
    grid = np.linspace(-SEARCH_S, SEARCH_S, COARSE_POINTS)
    for _ in range(2):
        # coarse over τ and SIGMA_A; then the scale of both noises so that the mean NIS is 1
        levels = sigma_a * SIGMA_A_FACTORS
        score, nis = _score(stretches, grid, levels, sigma_z, settings.dt_s)
        i, k = np.unravel_index(np.argmin(score), score.shape)
        offset, scale = float(grid[i]), float(np.sqrt(nis[i, k]))
        sigma_a, sigma_z = float(levels[k]) * scale, sigma_z * scale
    step = grid[1] - grid[0]
    width = 1.5 * step
    for _ in range(2):
        ends = np.clip([offset - width, offset + width], -SEARCH_S, SEARCH_S)
        fine = np.linspace(ends[0], ends[1], FINE_POINTS)
        levels = sigma_a * SIGMA_A_FACTORS[1:-1] ** 0.5
        score, _nis = _score(stretches, fine, levels, sigma_z, settings.dt_s)
        profile = score.min(axis=1)
        offset, sigma = _vertex(fine, profile)
        width = float(np.clip(3.5 * sigma, 0.01, 2.0 * SEARCH_S))
    low, high = profile_interval(fine, profile)
    closed = low is not None and high is not None
    interval = fine[0] if low is None else low, fine[-1] if high is None else high
    # an IMU sample is the mean over its interval, stamped somewhere in it
    resolution = 0.5 * float(np.median(np.diff(flight.imu.index.to_numpy())))
    widened = np.hypot(np.array(interval) - offset, 1.96 * resolution)
    interval = float(offset - widened[0]), float(offset + widened[1])
    half = (interval[1] - interval[0]) / 2.0
    reason = ""
    if not closed or half > MAX_HALF_INTERVAL_S:
        reason = (
            f"the positions fit offsets from {interval[0]:+.2f} s to {interval[1]:+.2f} s almost "
            "equally well: too little acceleration, or too noisy a source"
        )
    parts: tuple[PartOffset, ...] = ()
    if not reason:
        progress("changes of the clock")
        noises = sigma_a, sigma_z, settings.dt_s
        parts = _parts(flight.imu, flight.attitude, samples, offset, *noises)
    drift, drift_sigma, change_p = _changes(parts)
    heading, heading_sigma = _heading_error(stretches, offset, sigma_a, sigma_z, settings.dt_s)
    return ClockOffset(
        offset_s=offset,
        interval_s=interval,
        sigma_s=float(np.hypot(sigma, resolution)),
        determinable=not reason,
        reason=reason,
        curve_s=fine,
        curve_drop=profile - profile.min(),
        parts=parts,
        drift_ppm=drift,
        drift_sigma_ppm=drift_sigma,
        change_p=change_p,
        sigma_a_m_s2=sigma_a,
        sigma_z_m=sigma_z,
        count=len(samples),
        heading_error_deg=float(np.degrees(heading)),
        heading_sigma_deg=float(np.degrees(heading_sigma)),
    )


def _stretches(
    imu: pd.DataFrame, attitude: pd.DataFrame, samples: pd.DataFrame, longest_s: float
) -> list[_Stretch]:
    """Cut the measurements into stretches of equal length, each with signals of its own."""
    time = samples.index.to_numpy()
    count = max(1, int(np.ceil((time[-1] - time[0]) / longest_s)))
    edges = np.searchsorted(time, np.linspace(time[0], time[-1], count + 1)[1:-1])
    stretches = []
    for rows in np.split(np.arange(len(time)), edges):
        if len(rows) >= MIN_MEASUREMENTS // 2:
            part = samples.iloc[rows]
            around = part.index[0] - SEARCH_S, part.index[-1] + SEARCH_S
            signals = _signals(imu, attitude, around)
            stretches.append(_Stretch(signals, part.index.to_numpy(), part.to_numpy()))
    return stretches


def _signals(imu: pd.DataFrame, attitude: pd.DataFrame, span: tuple[float, float]) -> _Signals:
    """Acceleration in NED by the gyros' attitude, and what each constant adds to it."""
    inside = imu.loc[(imu.index >= span[0] - GYRO_STEP_S) & (imu.index <= span[1] + GYRO_STEP_S)]
    time = inside.index.to_numpy()
    force = inside[SPECIFIC_FORCE_COLUMNS].to_numpy(copy=True)
    turn = _integrate_gyros(time, inside[ANGULAR_RATE_COLUMNS].to_numpy(copy=True), attitude)
    body_to_ned = turn.as_matrix()
    specific = np.einsum("nij,nj->ni", body_to_ned, force)
    # a small rotation θ of the attitude adds θ × f; a gyro bias b turns it by -∫ R b dt
    angles = [np.broadcast_to(axis, specific.shape) for axis in np.eye(3)]
    angles += [
        -cumulative_trapezoid(body_to_ned[:, :, axis], time, axis=0, initial=0) for axis in range(3)
    ]
    columns = [specific + np.array([0.0, 0.0, constants.g])]
    columns += [np.cross(angle, specific) for angle in angles]
    columns += [-body_to_ned[:, :, axis] for axis in range(3)]
    value = np.stack(columns, axis=2)
    velocity = cumulative_trapezoid(value, time, axis=0, initial=0)
    position = cumulative_trapezoid(velocity, time, axis=0, initial=0)
    return _Signals(time, value, velocity, position)


def _integrate_gyros(time: Array, rate: Array, attitude: pd.DataFrame) -> Rotation:
    """Attitude (body to NED) from the logged one at the start and the gyros alone."""
    edges = np.arange(time[0], time[-1] + GYRO_STEP_S, GYRO_STEP_S)
    turned = cumulative_trapezoid(rate, time, axis=0, initial=0)
    angle = np.column_stack([np.interp(edges, time, turned[:, axis]) for axis in range(3)])
    steps = np.zeros((len(edges) - 1, 7))  # poses that only turn
    steps[:, 3:] = Rotation.from_rotvec(np.diff(angle, axis=0)).as_quat()
    logged = Rotation.from_quat(attitude[QUATERNION_COLUMNS].to_numpy(copy=True), scalar_first=True)
    known = attitude.index.to_numpy()
    start = Slerp(known, logged)(np.clip(time[0], known[0], known[-1]))
    integrated = start * Rotation.from_quat(lie.chain(steps)[:, 3:])
    return Slerp(edges, integrated)(np.clip(time, edges[0], edges[-1]))


def _score(
    stretches: list[_Stretch], offsets: Array, sigma_a: Array, sigma_z: float, dt_s: float
) -> tuple[Array, Array]:
    """Negative log-likelihood and mean NIS over offsets × SIGMA_A."""
    total = np.zeros((len(offsets), len(sigma_a)))
    square, count = np.zeros_like(total), 0
    for stretch in stretches:
        chi_square, log_s, used, _ = _filter(stretch, offsets, sigma_a, sigma_z, dt_s)
        total += 0.5 * (chi_square + log_s)
        square += chi_square
        count += used
    return total, square / max(count, 1)


def _filter(
    stretch: _Stretch, offsets: Array, sigma_a: Array, sigma_z: float, dt_s: float
) -> tuple[Array, Array, int, tuple[Array, Array]]:
    """Run the filter for every offset and SIGMA_A.

    Returns Σν²/S, Σ ln S, the number of innovations, and the last state with its covariance.
    """
    time, measured = stretch.time_s, stretch.position_m
    speed, way = stretch.signals.between(time[None, :] + offsets[:, None])
    shape = len(offsets), len(sigma_a)
    x = np.zeros((*shape, STATE_COUNT))
    x[..., :3] = np.nan_to_num(measured[0])
    P = np.zeros((*shape, STATE_COUNT, STATE_COUNT))
    diagonal = np.arange(STATE_COUNT)
    P[..., diagonal, diagonal] = np.concatenate(
        [np.repeat([INITIAL_SIGMA_P_M**2, INITIAL_SIGMA_V_M_S**2], 3), CONSTANT_SIGMA**2]
    )
    # F = [[1, dt, way], [0, 1, speed], [0, 0, 1]], whose last two blocks of columns are applied
    # apart: most of F is zero
    by_constants = np.concatenate([way, speed], axis=2)[:, :, None, :, 1:]
    noise = sigma_a**2 * dt_s
    chi_square, log_s, used = np.zeros(shape), np.zeros(shape), 0
    axes = np.arange(3)
    for k, dt in enumerate(np.diff(time)):
        moved = by_constants[:, k]
        x[..., :3] += dt * x[..., 3:6] + way[:, k, None, :, 0]
        x[..., 3:6] += speed[:, k, None, :, 0]
        x[..., :6] += (moved @ x[..., 6:, None])[..., 0]
        # P = FPFᵀ: the rows, then the columns
        P[..., :3, :] += dt * P[..., 3:6, :]
        P[..., :6, :] += moved @ P[..., 6:, :]
        P[..., :, :3] += dt * P[..., :, 3:6]
        P[..., :, :6] += P[..., :, 6:] @ np.swapaxes(moved, -1, -2)
        for row, column, size in zip((0, 0, 3), (0, 3, 3), noise_of_many_steps(dt), strict=True):
            P[..., axes + row, axes + column] += (noise * size)[:, None]
            if row != column:
                P[..., axes + column, axes + row] += (noise * size)[:, None]
        # one axis after the other: their noises are independent
        for axis in axes[np.isfinite(measured[k + 1])].tolist():
            s = P[..., axis, axis] + sigma_z**2
            nu = measured[k + 1, axis] - x[..., axis]
            gain = P[..., :, axis] / s[..., None]
            chi_square += nu**2 / s
            log_s += np.log(s)
            used += 1
            x = x + gain * nu[..., None]
            P -= gain[..., :, None] * P[..., None, axis, :]
    return chi_square, log_s, used, (x, P)


def _heading_error(
    stretches: list[_Stretch], offset: float, sigma_a: float, sigma_z: float, dt_s: float
) -> tuple[float, float]:
    """Heading of the logged attitude that the positions ask for, minus it (rad), and its σ.

    Each stretch has its own; what the prior added is taken out of each before they are joined.
    """
    weight = total = 0.0
    prior = CONSTANT_SIGMA[HEADING] ** -2.0
    for stretch in stretches:
        at = np.array([offset]), np.array([sigma_a])
        x, P = _filter(stretch, *at, sigma_z, dt_s)[3]
        found, variance = x[0, 0, 6 + HEADING], P[0, 0, 6 + HEADING, 6 + HEADING]
        weight += max(1.0 / variance - prior, 0.0)
        total += found / variance
    if weight <= 0.0:
        return 0.0, float("inf")
    return float(total / weight), float(weight**-0.5)


def _vertex(grid: Array, profile: Array) -> tuple[float, float]:
    """Minimum of a profile by a parabola, and the standard deviation that its bend gives."""
    at = int(np.clip(np.argmin(profile), 1, len(grid) - 2))
    step = grid[1] - grid[0]
    shift, bend = parabola_vertex(profile, at)
    if bend <= 0.0:
        return float(grid[int(np.argmin(profile))]), float(grid[-1] - grid[0])
    return float(grid[at] + np.clip(shift, -1.0, 1.0) * step), float(step / np.sqrt(bend))


def _parts(
    imu: pd.DataFrame,
    attitude: pd.DataFrame,
    samples: pd.DataFrame,
    offset: float,
    sigma_a: float,
    sigma_z: float,
    dt_s: float,
) -> tuple[PartOffset, ...]:
    """Offset of each part of the flight by itself, the noises as for the whole."""
    grid = offset + np.linspace(-SEARCH_S, SEARCH_S, 2 * COARSE_POINTS - 1)
    found = []
    for part in _stretches(imu, attitude, samples, PART_S):
        time = part.time_s
        inside = grid[
            (time[0] + grid >= part.signals.time_s[0])
            & (time[-1] + grid <= part.signals.time_s[-1])
        ]
        if len(inside) < COARSE_POINTS // 2:
            continue
        score, _ = _score([part], inside, np.array([sigma_a]), sigma_z, dt_s)
        middle, sigma = _vertex(inside, score[:, 0])
        found.append(PartOffset(float(time[0]), float(time[-1]), middle, sigma))
    return tuple(found)


def _changes(parts: tuple[PartOffset, ...]) -> tuple[float | None, float | None, float | None]:
    """Drift (ppm) with its standard deviation, and the p-value of no change at all."""
    if len(parts) < 2:
        return None, None, None
    offset = np.array([part.offset_s for part in parts])
    weight = np.array([part.sigma_s for part in parts]) ** -2.0
    mean = np.sum(weight * offset) / np.sum(weight)
    p = float(chi2.sf(np.sum(weight * (offset - mean) ** 2), len(parts) - 1))
    if len(parts) < 3:
        return None, None, p
    time = np.array([(part.start_s + part.end_s) / 2.0 for part in parts])
    centred = time - np.sum(weight * time) / np.sum(weight)
    spread = np.sum(weight * centred**2)
    drift = float(np.sum(weight * centred * offset) / spread)
    return drift * 1e6, float(spread**-0.5) * 1e6, p
