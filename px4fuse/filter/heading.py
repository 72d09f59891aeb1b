"""How the frame of the positions is turned against the vehicle's heading, over the flight.

A magnetometer indoors may turn EKF2's heading by tens of degrees within one flight, so that one
number for the whole flight would be wrong at every moment. Where the source carries an orientation
of its own, the two headings are compared at its samples. Otherwise the positions are filtered
along north and east together, with the acceleration of the IMU turned by the logged attitude, and
the turn is a state that may walk: state [p, v, b, η], b what the acceleration is off by in NED
(m/s²) and η the turn (rad) beyond the one about which the rotation is taken to first order.
Whether it walks is told by the likelihood ratio.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np
import pandas as pd
from msgspec import structs
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc

from px4fuse.arrays import Array, cumulative_integral
from px4fuse.filter.model import INITIAL_SIGMA_P_M, INITIAL_SIGMA_V_M_S, noise_of_many_steps
from px4fuse.filter.motion import MAX_IMU_INTERVAL_S
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import IMU_GAP_S, Segment, ned_acceleration, within
from px4fuse.flight import (
    POSITION_COLUMNS,
    QUATERNION_COLUMNS,
    Flight,
    PositionTrack,
    Unavailable,
)
from px4fuse.record import NotNegative, Record, Share

PART_S = 2.0
MIN_PARTS = 3
MIN_MEASUREMENTS = 50
MIN_PART_SAMPLES = 3
# More say nothing new about a heading, but cost time
MAX_MEASUREMENTS = 1000
# Parts further apart than chance would put them
DRIFT_P = 0.002
MIN_DRIFT_DEG = 5.5
# Turning faster, a late stamp looks like a wrong heading: 0.2 s of it are 2°
MAX_TURN_RATE_DEG_S = 10.0
# What two headings differ by that agree: mounting, vibration, rounding
LEAST_SIGMA_DEG = 0.5
MAX_ATTITUDE_INTERVAL_S = 0.11
LINEARISATIONS = 3
# About a turn so near the last run is as good as about the right one
SMALL_TURN_RAD = 0.01
STATE_COUNT = 7
TURN = 6
CROSSED = np.array([[1.0, -1.0], [-1.0, 1.0]])
INITIAL_SIGMA_BIAS_M_S2 = 0.3
INITIAL_SIGMA_TURN_RAD = 0.6
GAP_SIGMA = 5.0  # m and m/s, over a gap of the IMU
# Walks over one second: of the turn (rad; none first), of the acceleration's error (m/s²), and
# SIGMA_A (m/s²)
TURN_WALKS = np.radians([0.0, 0.3, 1.0, 3.0])
BIAS_WALKS = np.array([0.003, 0.03])
SIGMA_AS = np.array([0.03, 0.1, 0.3, 1.0])


class HeadingPart(Record, frozen=True):
    """Turn of one part of the flight: start and end (s), turn and its standard deviation."""

    start_s: float
    end_s: float
    heading_error_deg: float
    sigma_deg: NotNegative


class HeadingError(Record, frozen=True):
    """By how much the source's frame is turned against the logged attitude, over the flight.

    Attributes
    ----------
    turn_deg : float
        Mean over the flight.
    sigma_deg : float
        Standard deviation of the mean: what the parts have in common is not averaged out.
    drifts : bool
        Whether the turn changes beyond chance, and by enough to matter.
    parts : tuple of HeadingPart
        Consecutive, clockwise seen from above; what the frame and the attitude have in common all
        along is in each.
    drift_p : float
        p-value of "it is the same throughout".
    by : {"orientation", "positions"}
        What it was found with.
    """

    turn_deg: float
    sigma_deg: NotNegative
    drifts: bool
    parts: tuple[HeadingPart, ...]
    drift_p: Share
    by: Literal["orientation", "positions"]

    @property
    def ends(self) -> tuple[HeadingPart, HeadingPart]:
        """The parts of the least and of the greatest turn, the earlier one first."""
        turns = [part.heading_error_deg for part in self.parts]
        first, last = sorted((int(np.argmin(turns)), int(np.argmax(turns))))
        return self.parts[first], self.parts[last]


def turned(
    parts: tuple[HeadingPart, ...], drift_p: float, by: Literal["orientation", "positions"]
) -> HeadingError:
    """What the parts of a flight say together."""
    turns = [part.heading_error_deg for part in parts]
    return HeadingError(
        turn_deg=float(np.mean(turns)),
        sigma_deg=float(np.mean([part.sigma_deg for part in parts])),
        drifts=drift_p < DRIFT_P and max(turns) - min(turns) >= MIN_DRIFT_DEG,
        parts=parts,
        drift_p=drift_p,
        by=by,
    )


def heading_error(
    flight: Flight,
    track: PositionTrack,
    segment: Segment,
    settings: Settings,
    sigma_z_m: float,
    offset_s: float = 0.0,
) -> HeadingError | Unavailable:
    """Estimate the turn of the source's frame against the logged attitude over the flight.

    Parameters
    ----------
    flight : Flight
    track : PositionTrack
    segment : Segment
    settings : Settings
        ``dt_s`` gives SIGMA_A its meaning.
    sigma_z_m : float
        Noise of the positions.
    offset_s : float
        To be added to the track's stamps.

    Returns
    -------
    HeadingError, or Unavailable where there is no attitude, or too few measurements or IMU samples.
    """
    if isinstance(flight.attitude, Unavailable):
        return flight.attitude
    if np.median(np.diff(flight.attitude.index.to_numpy())) > MAX_ATTITUDE_INTERVAL_S:
        return Unavailable("heading error", "the attitude is too slow", "Log it at 10 Hz or more.")
    compared = None
    if track.orientation is not None:
        compared = _by_orientation(flight.attitude, track.orientation, segment, offset_s)
        if compared is not None and compared.drifts:
            return compared
    acceleration = ned_acceleration(flight)
    if isinstance(acceleration, Unavailable):
        return acceleration
    samples = within(track.samples, segment)[POSITION_COLUMNS[:2]].dropna()
    samples = samples.set_axis(samples.index.to_numpy() + offset_s)
    low, high = acceleration.index[[0, -1]]
    samples = samples[(samples.index >= low) & (samples.index <= high)]
    slow = np.median(np.diff(acceleration.index.to_numpy())) > MAX_IMU_INTERVAL_S
    if slow or len(samples) < MIN_MEASUREMENTS:
        return Unavailable(
            "heading error",
            "the IMU is too slow" if slow else f"{len(samples)} measurements are too few",
            "Log sensor_combined at its full rate, and analyse a longer segment.",
        )
    samples = samples.iloc[:: int(np.ceil(len(samples) / MAX_MEASUREMENTS))]
    found = _by_positions(acceleration, samples, settings.dt_s, sigma_z_m)
    # how the source's own axes lie in the vehicle is not known, but that they do not turn is
    return found if compared is None else structs.replace(found, drift_p=1.0, drifts=False)


def _parts(time: Array, turn: Array, sigma: Array) -> tuple[HeadingPart, ...]:
    """Means over parts of equal length, in degrees."""
    # of a long flight only some measurements were taken
    count = max(int(min((time[-1] - time[0]) / PART_S, len(time) / (2 * MIN_PART_SAMPLES))), 1)
    edges = np.searchsorted(time, np.linspace(time[0], time[-1], count + 1)[1:-1])
    return tuple(
        HeadingPart(
            float(time[rows[0]]),
            float(time[rows[-1]]),
            float(np.degrees(turn[rows].mean())),
            float(np.degrees(np.sqrt(np.mean(sigma[rows] ** 2)))),
        )
        for rows in np.split(np.arange(len(time)), edges)
        if len(rows) >= MIN_PART_SAMPLES
    )


def _yaw(quaternions: pd.DataFrame) -> Array:
    values = quaternions[QUATERNION_COLUMNS].to_numpy(copy=True)
    angles: Array = Rotation.from_quat(values, scalar_first=True).as_euler("ZYX")[:, 0]
    return np.unwrap(angles)


def _by_orientation(
    attitude: pd.DataFrame, orientation: pd.DataFrame, segment: Segment, offset_s: float
) -> HeadingError | None:
    """The source's heading minus the attitude's, while the vehicle hardly turns."""
    inside = within(orientation, segment)
    time = inside.index.to_numpy() + offset_s
    known = attitude.index.to_numpy()
    covered = (time >= known[0]) & (time <= known[-1])
    if np.count_nonzero(covered) < MIN_PARTS * MIN_PART_SAMPLES:
        return None
    own, time = _yaw(inside)[covered], time[covered]
    yaw = np.interp(time, known, _yaw(attitude))
    turn = own - yaw
    turn -= 2.0 * np.pi * np.round(np.median(turn) / (2.0 * np.pi))
    calm = np.abs(np.gradient(yaw, time)) < np.radians(MAX_TURN_RATE_DEG_S)
    if np.count_nonzero(calm) < MIN_PARTS * MIN_PART_SAMPLES:
        return None
    time, turn = time[calm], turn[calm]
    # what two neighbours differ by is noise; it does not shrink with their number
    noise = 1.4826 * np.median(np.abs(np.diff(turn))) / np.sqrt(2.0)
    sigma = np.full(len(time), max(float(noise), np.radians(LEAST_SIGMA_DEG)))
    parts = _parts(time, turn, sigma)
    if len(parts) < MIN_PARTS:
        return None
    found = np.array([part.heading_error_deg for part in parts])
    square = np.sum((found - found.mean()) ** 2) / np.degrees(sigma[0]) ** 2
    return turned(parts, float(chdtrc(len(parts) - 1, square)), "orientation")


@dataclass(frozen=True)
class _Legs:
    """What the acceleration adds between measurements, and F and Q without the turn.

    ``moved`` has shape (n, 4): north and east of position (m), then of velocity (m/s).
    """

    moved: Array
    dt_s: Array
    gap: Array


def _by_positions(
    acceleration: pd.DataFrame, samples: pd.DataFrame, dt_s: float, sigma_z: float
) -> HeadingError:
    time, measured = samples.index.to_numpy(), samples.to_numpy()
    legs = _legs(acceleration, time)
    grid = np.array(list(product(TURN_WALKS, BIAS_WALKS, SIGMA_AS)))
    still = grid[grid[:, 0] == 0.0]

    turn = 0.0
    for _ in range(LINEARISATIONS):
        run = _filter(legs, measured, turn, still, sigma_z, dt_s)
        step = float(run.last[np.argmax(run.log_p), TURN])
        turn += step
        if abs(step) < SMALL_TURN_RAD:
            break
    turn = float(np.angle(np.exp(1j * turn)))
    run = _filter(legs, measured, turn, grid, sigma_z, dt_s)
    best = int(np.argmax(run.log_p))
    ratio = 2.0 * (run.log_p[best] - run.log_p[grid[:, 0] == 0.0].max())
    smoothed, sigma = _smooth(run, measured, best)
    # at the end of its range a walk is half of the time none
    p = 0.5 * float(chdtrc(1, ratio)) if ratio > 0.0 else 1.0
    return turned(_parts(time, turn + smoothed, sigma), p, "positions")


def _legs(acceleration: pd.DataFrame, time: Array) -> _Legs:
    known, value = acceleration.index.to_numpy(), acceleration.to_numpy()[:, :2]
    speed = cumulative_integral(value, known)
    way = cumulative_integral(speed, known)
    v, p = (
        np.column_stack([np.interp(time, known, one) for one in both.T]) for both in (speed, way)
    )
    dt = np.diff(time)
    gaps = np.concatenate([[0.0], np.cumsum(np.diff(known) > IMU_GAP_S)])
    passed = np.diff(np.interp(time, known, gaps)) > 0.0
    moved = np.hstack([np.diff(p, axis=0) - v[:-1] * dt[:, None], np.diff(v, axis=0)])
    return _Legs(moved, dt, passed)


def _transitions(legs: _Legs, turn: float) -> tuple[Array, Array]:
    """F and the input of every leg, the rotation to first order about ``turn``."""
    count, dt = len(legs.dt_s), legs.dt_s[:, None, None]
    cosine, sine = np.cos(turn), np.sin(turn)
    rotation = np.array([[cosine, -sine], [sine, cosine]])
    slope = np.array([[-sine, -cosine], [cosine, -sine]])
    moved = legs.moved.reshape(count, 2, 2)
    F = np.tile(np.eye(STATE_COUNT), (count, 1, 1))
    F[:, :2, 2:4] = F[:, 2:4, 4:6] = dt * np.eye(2)
    F[:, :2, 4:6] = dt**2 / 2.0 * np.eye(2)
    F[:, :4, TURN] = (moved @ slope.T).reshape(count, 4)
    push = np.zeros((count, STATE_COUNT))
    push[:, :4] = (moved @ rotation.T).reshape(count, 4)
    return F, push


def _noise(legs: _Legs, noises: Array, dt_s: float) -> Array:
    """Q of every leg for each of k settings, shape (n, k, 7, 7)."""
    position, velocity, bias = (slice(axis, axis + 2) for axis in (0, 2, 4))
    pair, count = np.eye(2), len(noises)
    level = (noises[:, 2] ** 2 * dt_s)[:, None, None] * pair
    # of each: what is added for one of q00, q01, q11, a second and a gap
    of_00, of_01, of_11, of_second, of_gap = made = np.zeros((5, count, STATE_COUNT, STATE_COUNT))
    of_00[:, position, position] = of_11[:, velocity, velocity] = level
    of_01[:, position, velocity] = of_01[:, velocity, position] = level
    of_second[:, bias, bias] = (noises[:, 1] ** 2)[:, None, None] * pair
    of_second[:, TURN, TURN] = noises[:, 0] ** 2
    of_gap[:, position, position] = of_gap[:, velocity, velocity] = GAP_SIGMA**2 * pair
    amounts = np.stack([*noise_of_many_steps(legs.dt_s), legs.dt_s, legs.gap], axis=1)
    return np.asarray((amounts @ made.reshape(5, -1)).reshape(-1, *made.shape[1:]))


def _start(measured: Array, count: int) -> tuple[Array, Array]:
    x = np.zeros((count, STATE_COUNT))
    x[:, :2] = measured[0]
    sigmas = np.repeat(
        [INITIAL_SIGMA_P_M, INITIAL_SIGMA_V_M_S, INITIAL_SIGMA_BIAS_M_S2, INITIAL_SIGMA_TURN_RAD],
        [2, 2, 2, 1],
    )
    return x, np.broadcast_to(np.diag(sigmas**2), (count, STATE_COUNT, STATE_COUNT)).copy()


@dataclass(frozen=True)
class _Run:
    """What k filters with other noises made of the measurements.

    Attributes
    ----------
    log_p : ndarray, shape (k,)
        With the best scale of all noises.
    scale : ndarray, shape (k,)
        That scale, of their variances.
    last : ndarray, shape (k, 7)
        The last state.
    steps : list
        Of every step F, prior states and covariances, and posterior ones.
    """

    log_p: Array
    scale: Array
    last: Array
    steps: list[tuple[Array, Array, Array, Array, Array]]


def _filter(
    legs: _Legs, measured: Array, turn: float, noises: Array, sigma_z: float, dt_s: float
) -> _Run:
    x, P = _start(measured, len(noises))
    square, log_s = np.zeros(len(noises)), np.zeros(len(noises))
    steps = []
    R = sigma_z**2 * np.eye(2)
    each = zip(*_transitions(legs, turn), _noise(legs, noises, dt_s), strict=True)
    for k, (F, push, Q) in enumerate(each):
        x = x @ F.T + push
        P = F @ P @ F.T + Q
        prior = x, P
        S = P[:, :2, :2] + R
        # S⁻¹ of two rows and columns, written out
        determinant = S[:, 0, 0] * S[:, 1, 1] - S[:, 0, 1] ** 2
        inverse = S[:, ::-1, ::-1] * CROSSED / determinant[:, None, None]
        gain = np.swapaxes(P[:, :2, :], 1, 2) @ inverse
        nu = (measured[k + 1] - x[:, :2])[..., None]
        square += (np.swapaxes(nu, 1, 2) @ inverse @ nu)[:, 0, 0]
        log_s += np.log(determinant)
        x = x + (gain @ nu)[..., 0]
        P = P - gain @ P[:, :2, :]
        P = (P + np.swapaxes(P, 1, 2)) / 2.0
        steps.append((F, *prior, x, P))
    count = 2 * len(legs.dt_s)
    scale = square / count
    return _Run(-0.5 * (count * np.log(scale) + log_s), scale, x, steps)


def _smooth(run: _Run, measured: Array, which: int) -> tuple[Array, Array]:
    """Turn at every measurement by all of them, and its standard deviation (Rauch et al. 1965)."""
    x, P = _start(measured, 1)
    before = [(x[0], P[0]), *((step[3][which], step[4][which]) for step in run.steps)]
    state, covariance = before[-1]
    turns, variances = [state[TURN]], [covariance[TURN, TURN]]
    for (x_k, P_k), (F, prior, spread, _, _) in zip(before[-2::-1], run.steps[::-1], strict=True):
        gain = np.linalg.solve(spread[which], F @ P_k).T
        state = x_k + gain @ (state - prior[which])
        covariance = P_k + gain @ (covariance - spread[which]) @ gain.T
        turns.append(state[TURN])
        variances.append(covariance[TURN, TURN])
    variance = run.scale[which] * np.maximum(np.array(variances[::-1]), 0.0)
    return np.array(turns[::-1]), np.sqrt(variance)
