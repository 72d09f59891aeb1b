"""Motion as the IMU alone has it, and what every constant error of the IMU would add to it.

The attitude is integrated from the gyros, from the logged attitude at the start of each stretch:
EKF2's own later attitude was corrected by the very positions that are in question, and carries
their lateness. To first order the acceleration is linear in ten constants of each stretch: errors
of the initial attitude (rad, NED), gyro biases (rad/s, body), accelerometer biases (m/s², body)
and the scale of the positions. Each one's own signal is integrated once, and a clock offset only
moves where the integrals are read. The signal of the scale is the path's own acceleration, which
:func:`px4fuse.filter.marginal.centred` puts in: that of the IMU holds the very noise that is
sought, and would pass much of it off as scale (errors in variables, Fuller 1987).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy import constants
from scipy.spatial.transform import Rotation, Slerp

from px4fuse.arrays import Array, IntArray, cumulative_integral
from px4fuse.filter.chain import Chain
from px4fuse.filter.marginal import Positions
from px4fuse.filter.model import noise_of_many_steps
from px4fuse.filter.signals import imu_gaps
from px4fuse.flight import ANGULAR_RATE_COLUMNS, QUATERNION_COLUMNS, SPECIFIC_FORCE_COLUMNS
from px4fuse.trajectory.rotation import from_vector, matrix, multiply, running_product

# Standard deviations of the constants, wide for consumer sensors: tilt and heading (rad), gyro
# (rad/s) and accelerometer (m/s²), scale of the positions (1)
CONSTANT_SIGMA = np.repeat([0.05, 0.004, 0.3, 0.1], [3, 3, 3, 1])
# To first order only while the angles stay small: longer flights are cut into stretches. A gyro
# bias of 0.004 rad/s turns by 0.12 rad in one, whose square costs 0.07 m/s².
STRETCH_S = 30.0
SEARCH_S = 0.6
MIN_MEASUREMENTS = 15
# Of a stretch of which only some are taken
FEW_MEASUREMENTS = 5
# The IMU is averaged to this interval before it is integrated
STEP_S = 0.02
# Of position (1/m²) and velocity (s²/m²) where a stretch starts: as good as nothing, but enough
# for one in which an axis was hardly measured
START_PRECISION = 1e-6, 1e-4
# Slower, and what the acceleration did between samples is not known
MAX_IMU_INTERVAL_S = 0.025


@dataclass(frozen=True)
class Signals:
    """Acceleration of one stretch and of each constant, and their integrals.

    ``table`` has shape (n, 3, 3, constants): position, velocity and acceleration along each axis,
    with all constants zero, then what each constant but the scale adds. Each acceleration holds
    from its time to the next.
    """

    time_s: Array
    table: Array

    def at(self, time_s: Array, axes: slice = slice(None)) -> tuple[Array, Array, Array]:
        """Position, velocity and acceleration at other times, shape (..., axes, constants)."""
        last = len(self.time_s) - 1
        at = np.clip(np.searchsorted(self.time_s, time_s, side="right") - 1, 0, last)
        ahead = (time_s - self.time_s[at])[..., None, None]
        rows = np.moveaxis(self.table[at, :, axes], -3, 0)
        position, velocity, value = rows
        position += ahead * (velocity + (0.5 * ahead) * value)
        velocity += ahead * value
        return position, velocity, value


@dataclass(frozen=True)
class PreparedMotion:
    """The IMU's signals under the measurements of one source, in stretches.

    Attributes
    ----------
    time_s : ndarray, shape (m,)
        Stamps of the measurements that lie in a stretch.
    row : ndarray of int, shape (m,)
        Which of the given measurements they are.
    edges : ndarray of int, shape (s + 1,)
        First measurement of each stretch, and their number.
    signals : tuple of Signals
        Of each stretch.
    """

    time_s: Array
    row: IntArray
    edges: IntArray
    signals: tuple[Signals, ...]

    def thinned(self, count: int) -> PreparedMotion | None:
        """About so many of the measurements, in the stretches that keep a few; None without one.

        Parameters
        ----------
        count : int
        """
        kept = np.arange(len(self.time_s)) % max(1, len(self.time_s) // count) == 0
        counts = np.add.reduceat(kept.astype(int), self.edges[:-1])
        enough = counts >= FEW_MEASUREMENTS
        if not enough.any():
            return None
        kept = kept & np.repeat(enough, np.diff(self.edges))
        return PreparedMotion(
            self.time_s[kept],
            self.row[kept],
            np.cumsum([0, *counts[enough]]),
            tuple(each for each, good in zip(self.signals, enough, strict=True) if good),
        )

    def positions(self, measurement_m: Array, dt_s: float) -> Positions:
        """Positions along some axes, ready to be fitted.

        Parameters
        ----------
        measurement_m : ndarray, shape (given, a)
            All that were given; NaN where there is none.
        dt_s : float
            DT, which gives SIGMA_A its meaning.
        """
        end = np.setdiff1d(np.arange(1, len(self.time_s)), self.edges)
        length = np.diff(self.time_s)[end - 1]
        unit = dt_s * np.stack(noise_of_many_steps(length), 1)
        measured = measurement_m[self.row]
        # from the first of each stretch, whose place nothing says: numbers stay small
        stretch = np.repeat(np.arange(len(self.signals)), np.diff(self.edges))
        measured = measured - pd.DataFrame(measured).groupby(stretch).transform("first").to_numpy()
        start = np.zeros((len(measured), 2))
        start[self.edges[:-1]] = START_PRECISION
        chain = Chain(end, length, unit, np.zeros_like(unit))
        return Positions(chain, measured, self.edges[:-1], start, CONSTANT_SIGMA)

    def legs(self, directions: Array, offset_s: Array) -> tuple[Array, Array]:
        """What the acceleration adds on each leg where stamps are corrected by each offset.

        Parameters
        ----------
        directions : ndarray, shape (a, 3)
            Unit vectors in NED.
        offset_s : ndarray, shape (T,)

        Returns
        -------
        delta_position_m, delta_velocity_m_s : ndarray, shape (a, T, 1 + constants, m - 1)
            Zero where a stretch begins, and for the scale.
        """
        width = 1 + len(CONSTANT_SIGMA)
        dp, dv = np.zeros((2, len(self.time_s) - 1, len(directions), len(offset_s), width))
        for at, begin, end, position, velocity in self._moved(directions, offset_s):
            step = np.diff(self.time_s[begin:end])[:, None, None]
            leg = np.s_[begin : end - 1, :, at, :-1]
            np.subtract(velocity[1:], velocity[:-1], out=dv[leg])
            way = dp[leg]
            np.subtract(position[1:], position[:-1], out=way)
            way -= velocity[:-1] * step
        return np.moveaxis(dp, 0, -1), np.moveaxis(dv, 0, -1)

    def paths(self, directions: Array, offset_s: Array) -> Array:
        """Where the acceleration leads from rest at the start of each stretch.

        Parameters
        ----------
        directions, offset_s : ndarray
            As :meth:`legs` takes them.

        Returns
        -------
        ndarray, shape (m, a, T, constants)
            What is known where all constants are zero, then what each but the scale adds.
        """
        made = np.empty((len(self.time_s), len(directions), len(offset_s), len(CONSTANT_SIGMA)))
        for at, begin, end, position, velocity in self._moved(directions, offset_s):
            since = (self.time_s[begin:end] - self.time_s[begin])[:, None, None]
            way = made[begin:end, :, at]
            np.subtract(position, position[0], out=way)
            way -= velocity[0] * since
        return made

    def _moved(
        self, directions: Array, offset_s: Array
    ) -> Iterator[tuple[int, int, int, Array, Array]]:
        """Which offset, first measurement and end of each stretch, its position and velocity."""
        # most directions are axes themselves
        used = np.flatnonzero(np.any(directions, axis=0))
        axes = slice(int(used[0]), int(used[-1]) + 1)  # a view of the signals
        own = directions[:, axes]
        turned = None if np.array_equal(own, np.eye(own.shape[1])) else own
        for begin, end, signals in self._stretches():
            for at, offset in enumerate(offset_s.tolist()):
                position, velocity, _ = signals.at(self.time_s[begin:end] + offset, axes)
                if turned is not None:
                    position, velocity = turned @ position, turned @ velocity
                yield at, begin, end, position, velocity

    def _stretches(self) -> Iterator[tuple[int, int, Signals]]:
        return zip(self.edges[:-1].tolist(), self.edges[1:].tolist(), self.signals, strict=True)


Made = dict[tuple[float, float], Signals]


def motion(
    imu: pd.DataFrame, attitude: pd.DataFrame, time_s: Array, made: Made | None = None
) -> PreparedMotion | None:
    """Cut measurements into stretches that the IMU covers without a gap.

    Parameters
    ----------
    imu, attitude : DataFrame
        As in :class:`px4fuse.flight.Flight`.
    time_s : ndarray, shape (m,)
    made : dict, optional
        Signals of this flight by their span, which are kept there and used again.

    Returns
    -------
    PreparedMotion, or None where no stretch has enough measurements or the IMU is too slow.
    """
    made = {} if made is None else made
    imu_time = imu.index.to_numpy()
    if len(imu_time) < 2 or np.median(np.diff(imu_time)) > MAX_IMU_INTERVAL_S:
        return None
    low = max(imu.index[0], attitude.index[0])
    high = min(imu.index[-1], attitude.index[-1])
    gaps = np.flatnonzero(imu_gaps(imu_time))
    begins = np.maximum(imu_time[np.r_[0, gaps + 1]], low)
    ends = np.minimum(imu_time[np.r_[gaps, len(imu_time) - 1]], high)
    rows: list[IntArray] = []
    signals = []
    for begin, end in zip(begins, ends, strict=True):
        inside = np.flatnonzero((time_s >= begin + SEARCH_S) & (time_s <= end - SEARCH_S))
        if not len(inside):
            continue
        within = time_s[inside]
        count = max(1, int(np.ceil((within[-1] - within[0]) / STRETCH_S)))
        cuts = np.linspace(within[0], within[-1], count + 1)[1:-1]
        for part in np.split(inside, np.searchsorted(within, cuts)):
            if len(part) >= MIN_MEASUREMENTS:
                rows.append(part)
                around = time_s[part[0]] - SEARCH_S, time_s[part[-1]] + SEARCH_S
                if around not in made:
                    made[around] = _signals(imu, attitude, around)
                signals.append(made[around])
    if not rows:
        return None
    row = np.concatenate(rows)
    edges = np.cumsum([0, *map(len, rows)])
    return PreparedMotion(time_s[row], row, edges, tuple(signals))


def _signals(imu: pd.DataFrame, attitude: pd.DataFrame, span: tuple[float, float]) -> Signals:
    """Acceleration in NED by the gyros' attitude, and what each constant adds to it."""
    time = imu.index.to_numpy()
    first, last = np.searchsorted(time, [span[0] - 2 * STEP_S, span[1] + 2 * STEP_S], side="left")
    inside, time = imu.iloc[first:last], time[first:last]
    columns = [*SPECIFIC_FORCE_COLUMNS, *ANGULAR_RATE_COLUMNS]
    integral = cumulative_integral(inside[columns].to_numpy(), time)
    edges = np.arange(time[0], time[-1], STEP_S)
    read = np.column_stack([np.interp(edges, time, one) for one in integral.T])
    force, angle = read[:, :3], read[:, 3:]
    turn = _integrate_gyros(edges, angle, attitude)
    # of each step, in its middle
    mean = np.diff(force, axis=0) / STEP_S
    body_to_ned = matrix(multiply(turn[:-1], from_vector(np.diff(angle, axis=0) / 2.0)))
    specific = np.einsum("nij,nj->ni", body_to_ned, mean)
    table = np.zeros((len(mean), 3, 3, len(CONSTANT_SIGMA)))
    position, velocity, value = np.moveaxis(table, 1, 0)
    value[:, :, 0] = specific
    value[:, 2, 0] += constants.g
    # a small rotation θ of the attitude adds θ × f; a gyro bias b turns it by -∫ R b dt
    turned = -STEP_S * (np.cumsum(body_to_ned, axis=0) - body_to_ned / 2.0)
    for axis in range(3):
        after, last = (axis + 1) % 3, (axis + 2) % 3
        value[:, after, 1 + axis] = -specific[:, last]
        value[:, last, 1 + axis] = specific[:, after]
        value[:, axis, 4:7] = turned[:, after] * specific[:, [last]]
        value[:, axis, 4:7] -= turned[:, last] * specific[:, [after]]
    value[:, :, 7:10] = -body_to_ned
    np.cumsum(value[:-1] * STEP_S, axis=0, out=velocity[1:])
    step = velocity[:-1] + value[:-1] * (STEP_S / 2.0)
    np.cumsum(step * STEP_S, axis=0, out=position[1:])
    return Signals(edges[:-1], table)


def _integrate_gyros(edges: Array, angle: Array, attitude: pd.DataFrame) -> Array:
    """Attitude (body to NED, w first) from the logged one at the start and the gyros alone."""
    known = attitude.index.to_numpy()
    near = slice(*np.clip(np.searchsorted(known, edges[0]) + np.array([-2, 3]), 0, len(known)))
    logged = attitude.iloc[near][QUATERNION_COLUMNS].to_numpy(copy=True)
    at_start = np.clip(edges[0], known[near][0], known[near][-1])
    slerp = Slerp(known[near], Rotation.from_quat(logged, scalar_first=True))
    start = slerp(at_start).as_quat(scalar_first=True)
    turned = running_product(from_vector(np.diff(angle, axis=0)))
    return np.vstack([start, multiply(start, turned)])
