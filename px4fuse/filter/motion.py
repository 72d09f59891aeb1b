"""Motion as the IMU alone has it, and what every constant error of the IMU would add to it.

The attitude is integrated from the gyros, from the logged attitude at the start of each stretch:
EKF2's own later attitude was corrected by the very positions that are in question, and carries
their lateness. To first order the acceleration is linear in ten constants of each stretch: errors
of the initial attitude (rad, NED), gyro biases (rad/s, body), accelerometer biases (m/s², body)
and the scale of the positions. Each one's own signal is integrated once, and a clock offset only
moves where the integrals are read. The signal of the scale is the path's own acceleration, which
:func:`px4fuse.filter.marginal.centre_on_path` puts in: that of the IMU holds the very noise that is
sought, and would pass much of it off as scale (errors in variables, Fuller 1987).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from scipy import constants
from scipy.spatial.transform import Rotation, Slerp

from px4fuse.arrays import Array, IntArray, cumulative_integral
from px4fuse.filter.fitting import Noises, fit_ratios
from px4fuse.filter.marginal import Positions, centre_on_path
from px4fuse.filter.model import continuous_noise_unit
from px4fuse.filter.signals import imu_gaps
from px4fuse.flight import Columns, Flight, Unavailable
from px4fuse.record import missing_data
from px4fuse.trajectory.rotation import from_vector, matrix, multiply, running_product

# Standard deviations of the constants, wide for consumer sensors: tilt and heading (rad), gyro
# (rad/s) and accelerometer (m/s²), scale of the positions (1)
CONSTANT_SIGMA = np.repeat([0.05, 0.004, 0.3, 0.1], [3, 3, 3, 1])
# To first order only while the angles stay small: longer flights are cut into stretches. A gyro
# bias of 0.004 rad/s turns by 0.12 rad in one, whose square costs 0.07 m/s².
STRETCH_S = 30.0
MAX_OFFSET_S = 0.6
# The whole search is gone through in so many steps, with about so many of the measurements
COARSE_POINTS, COARSE_MEASUREMENTS = 25, 600
# Numbers of signals that are made at once, and of offsets at least
SIGNALS_PER_BATCH, MIN_OFFSETS = 2**16, 3
# Of all stretches together, and of one
MIN_MEASUREMENTS, MIN_STRETCH_MEASUREMENTS = 30, 15
# Of a stretch of which only some are taken
MIN_KEPT_MEASUREMENTS = 5
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

    def at(self, time_s: Array) -> tuple[Array, Array]:
        """Position and velocity at other times, shape (..., 3, constants)."""
        last_index = len(self.time_s) - 1
        at = np.clip(np.searchsorted(self.time_s, time_s, side="right") - 1, 0, last_index)
        elapsed_s = (time_s - self.time_s[at])[..., None, None]
        position, velocity, acceleration = np.moveaxis(self.table[at], -3, 0)
        position += elapsed_s * (velocity + (0.5 * elapsed_s) * acceleration)
        velocity += elapsed_s * acceleration
        return position, velocity


# Signals of one flight by their span, which are made once and used again
SignalCache = dict[tuple[float, float], Signals]


@dataclass(frozen=True)
class PreparedMotion:
    """Positions of one source over the IMU's motion, in stretches, at any clock offset.

    Attributes
    ----------
    time_s : ndarray, shape (m,)
        Stamps of the measurements that lie in a stretch.
    measurement_m : ndarray, shape (m, a)
        From the first of each stretch; NaN where there is none.
    weight : ndarray, shape (m,)
        What each counts.
    edges : ndarray of int, shape (s + 1,)
        First measurement of each stretch, and their number.
    signals : tuple of Signals
        Of each stretch.
    directions : ndarray, shape (a, 3)
        Unit vectors in NED.
    dt_s : float
        DT, which gives SIGMA_A its meaning.
    imu_interval_s : float
    heading_sigma_rad : float
        Of the heading where a stretch starts.
    """

    time_s: Array
    measurement_m: Array
    weight: Array
    edges: IntArray
    signals: tuple[Signals, ...]
    directions: Array
    dt_s: float
    imu_interval_s: float
    heading_sigma_rad: float = float(CONSTANT_SIGMA[2])

    def downsample(self, count: int) -> PreparedMotion:
        """About so many of the measurements, in the stretches that keep a few; all without one."""
        is_kept = np.arange(len(self.time_s)) % max(1, round(len(self.time_s) / count)) == 0
        counts = np.add.reduceat(is_kept.astype(int), self.edges[:-1])
        has_enough = counts >= MIN_KEPT_MEASUREMENTS
        if not has_enough.any():
            return self
        is_kept &= np.repeat(has_enough, np.diff(self.edges))
        arrays = {
            name: getattr(self, name)[is_kept] for name in ("time_s", "measurement_m", "weight")
        }
        signals = tuple(
            stretch_signals
            for stretch_signals, is_good in zip(self.signals, has_enough, strict=True)
            if is_good
        )
        return replace(self, **arrays, edges=np.cumsum([0, *counts[has_enough]]), signals=signals)

    def positions(self, offset_s: Array) -> Positions:
        """Positions, with what moves them where their stamps are corrected by each offset.

        The signal of the scale is zero.

        Parameters
        ----------
        offset_s : ndarray, shape (T,)
        """
        length_s = np.diff(self.time_s)
        noise_unit = self.dt_s * np.stack(continuous_noise_unit(length_s))
        initial = np.zeros((len(self.time_s), 2))
        initial[self.edges[:-1]] = START_PRECISION
        shape = len(self.directions), len(offset_s), 1 + len(CONSTANT_SIGMA), len(length_s)
        dp, dv = np.zeros((2, *shape))
        for begin, end, signals in zip(self.edges, self.edges[1:], self.signals, strict=False):
            time = self.time_s[begin:end]
            # by axis, offset, constant and time
            position, velocity = (
                np.moveaxis(self.directions @ signal, (2, 0, 3, 1), range(4))
                for signal in signals.at(time + offset_s[:, None])
            )
            rows = np.s_[:, :, :-1, begin : end - 1]
            dv[rows] = np.diff(velocity)
            dp[rows] = np.diff(position) - velocity[..., :-1] * np.diff(time)
        return Positions(
            measurement_m=self.measurement_m,
            start=self.edges[:-1],
            length_s=length_s,
            noise_unit=noise_unit,
            noise_fixed=np.zeros_like(noise_unit),
            initial=initial,
            constant_sigma=np.concatenate(
                [CONSTANT_SIGMA[:2], [self.heading_sigma_rad], CONSTANT_SIGMA[3:]]
            ),
            delta_position_m=dp,
            delta_velocity_m_s=dv,
        )

    def at(self, offset_s: float) -> Positions:
        """The same at one offset, about a smooth path whose scale is the last constant."""
        return next(self.blocks(np.array([offset_s])))

    def blocks(self, offset_s: Array, *, scaled: bool = True) -> Iterator[Positions]:
        """The same at some offsets, a few at a time, with the scale as a constant or without."""
        signal_count = len(self.time_s) * len(self.directions) * (1 + len(CONSTANT_SIGMA))
        batch_size = max(MIN_OFFSETS, SIGNALS_PER_BATCH // signal_count)
        for batch in np.split(offset_s, range(batch_size, len(offset_s), batch_size)):
            positions = self.positions(batch)
            yield centre_on_path(positions, scaled=True) if scaled else positions

    def search(
        self, noises: Noises, factors: Sequence[float] = (1.0,), *, scaled: bool = True
    ) -> tuple[float, Noises]:
        """The most likely offset over the whole search, and SIGMA_A of some.

        Parameters
        ----------
        noises : Noises
        factors : sequence of float
            Of SIGMA_A.
        scaled : bool
            Whether the scale of the positions is one of the constants.
        """
        offsets = np.linspace(-MAX_OFFSET_S, MAX_OFFSET_S, COARSE_POINTS)
        sigma = noises.sigma_z_m
        ratios = [factor * noises.sigma_a_m_s2 / sigma for factor in factors]
        coarse_motion = self.downsample(COARSE_MEASUREMENTS)
        blocks = coarse_motion.blocks(offsets, scaled=scaled)
        fits = fit_ratios(blocks, ratios, noises.walk_m / sigma, coarse_motion.weight, sigma)
        scores = np.stack([fit.scaled(sigma).totals()[0] for fit in fits])
        factor_index, offset_index = np.unravel_index(np.argmin(scores), scores.shape)
        sigma_a = noises.sigma_a_m_s2 * factors[int(factor_index)]
        return float(offsets[offset_index]), replace(noises, sigma_a_m_s2=sigma_a)


def prepare_motion(
    flight: Flight,
    time_s: Array,
    measurement_m: Array,
    *,
    directions: Array,
    dt_s: float,
    weight: Array | None = None,
    signals: SignalCache | None = None,
    heading_sigma_rad: float = float(CONSTANT_SIGMA[2]),
) -> PreparedMotion | Unavailable:
    """Cut measurements into stretches that the IMU covers without a gap.

    Parameters
    ----------
    flight : Flight
    time_s : ndarray, shape (m,)
    measurement_m : ndarray, shape (m, a)
    directions, dt_s, weight, heading_sigma_rad
        As :class:`PreparedMotion` has them; by default all count the same.
    signals : dict, optional
        Signals of this flight, to which new ones are added.

    Returns
    -------
    PreparedMotion, or Unavailable without IMU or attitude, or with too few measurements with them.
    """
    imu, attitude = flight.imu, flight.attitude
    if isinstance(imu, Unavailable):
        return imu
    if isinstance(attitude, Unavailable):
        return attitude
    signals = {} if signals is None else signals
    stretch_signals: list[Signals] = []
    imu_time, attitude_s = imu.index.to_numpy(), attitude.index.to_numpy()
    rows_by_stretch: list[IntArray] = []
    for begin, end in _covered_spans(imu_time, attitude_s):
        inside_rows = np.flatnonzero(
            (time_s >= begin + MAX_OFFSET_S) & (time_s <= end - MAX_OFFSET_S)
        )
        if not len(inside_rows):
            continue
        inside_s = time_s[inside_rows]
        count = max(1, int(np.ceil((inside_s[-1] - inside_s[0]) / STRETCH_S)))
        cuts = np.linspace(inside_s[0], inside_s[-1], count + 1)[1:-1]
        for stretch_rows in np.split(inside_rows, np.searchsorted(inside_s, cuts)):
            if len(stretch_rows) >= MIN_STRETCH_MEASUREMENTS:
                rows_by_stretch.append(stretch_rows)
                span = (
                    time_s[stretch_rows[0]] - MAX_OFFSET_S,
                    time_s[stretch_rows[-1]] + MAX_OFFSET_S,
                )
                if span not in signals:
                    signals[span] = make_signals(imu, attitude, span)
                stretch_signals.append(signals[span])
    used_rows = np.concatenate([np.zeros(0, dtype=np.intp), *rows_by_stretch])
    if len(used_rows) < MIN_MEASUREMENTS:
        return missing_data("motion_few", count=len(used_rows), least=MIN_MEASUREMENTS)
    edges = np.cumsum([0, *map(len, rows_by_stretch)])
    # from the first of each stretch, whose place nothing says: numbers stay small
    measured = pd.DataFrame(measurement_m[used_rows])
    first = measured.groupby(np.repeat(np.arange(len(rows_by_stretch)), np.diff(edges))).transform(
        "first"
    )
    return PreparedMotion(
        time_s[used_rows],
        (measured - first).to_numpy(),
        np.ones(len(used_rows)) if weight is None else weight[used_rows],
        edges,
        tuple(stretch_signals),
        directions,
        dt_s,
        float(np.median(np.diff(imu_time))),
        heading_sigma_rad,
    )


def _covered_spans(imu_time: Array, attitude_time: Array) -> list[tuple[float, float]]:
    """Start and end of all that IMU and attitude cover; nothing where the IMU is too slow."""
    if len(imu_time) < 2 or np.median(np.diff(imu_time)) > MAX_IMU_INTERVAL_S:
        return []
    gaps = np.flatnonzero(imu_gaps(imu_time))
    begins = np.maximum(imu_time[np.r_[0, gaps + 1]], attitude_time[0])
    ends = np.minimum(imu_time[np.r_[gaps, len(imu_time) - 1]], attitude_time[-1])
    return list(zip(begins.tolist(), ends.tolist(), strict=True))


def make_signals(imu: pd.DataFrame, attitude: pd.DataFrame, span: tuple[float, float]) -> Signals:
    """Acceleration in NED by the gyros' attitude, and what each constant adds to it."""
    time = imu.index.to_numpy()
    first_row, last_axis = np.searchsorted(
        time, [span[0] - 2 * STEP_S, span[1] + 2 * STEP_S], side="left"
    )
    samples, time = imu.iloc[first_row:last_axis], time[first_row:last_axis]
    columns = [*Columns.SPECIFIC_FORCE, *Columns.ANGULAR_RATE]
    integral = cumulative_integral(samples[columns].to_numpy(), time)
    edges = np.arange(time[0], time[-1], STEP_S)
    integrals_at_edges = np.column_stack([np.interp(edges, time, column) for column in integral.T])
    force, angle = integrals_at_edges[:, :3], integrals_at_edges[:, 3:]
    attitude_quaternion = _integrate_gyros(edges, angle, attitude)
    # of each step, in its middle
    mean = np.diff(force, axis=0) / STEP_S
    body_to_ned = matrix(
        multiply(attitude_quaternion[:-1], from_vector(np.diff(angle, axis=0) / 2.0))
    )
    force_ned = np.einsum("nij,nj->ni", body_to_ned, mean)
    table = np.zeros((len(mean), 3, 3, len(CONSTANT_SIGMA)))
    position, velocity, acceleration = np.moveaxis(table, 1, 0)
    acceleration[:, :, 0] = force_ned
    acceleration[:, 2, 0] += constants.g
    # a small rotation θ of the attitude adds θ × f; a gyro bias b turns it by -∫ R b dt
    gyro_bias_rotation = -STEP_S * (np.cumsum(body_to_ned, axis=0) - body_to_ned / 2.0)
    for axis in range(3):
        next_axis, last_axis = (axis + 1) % 3, (axis + 2) % 3
        acceleration[:, next_axis, 1 + axis] = -force_ned[:, last_axis]
        acceleration[:, last_axis, 1 + axis] = force_ned[:, next_axis]
        acceleration[:, axis, 4:7] = gyro_bias_rotation[:, next_axis] * force_ned[:, [last_axis]]
        acceleration[:, axis, 4:7] -= gyro_bias_rotation[:, last_axis] * force_ned[:, [next_axis]]
    acceleration[:, :, 7:10] = -body_to_ned
    np.cumsum(acceleration[:-1] * STEP_S, axis=0, out=velocity[1:])
    mean_velocity = velocity[:-1] + acceleration[:-1] * (STEP_S / 2.0)
    np.cumsum(mean_velocity * STEP_S, axis=0, out=position[1:])
    return Signals(edges[:-1], table)


def _integrate_gyros(edges: Array, angle: Array, attitude: pd.DataFrame) -> Array:
    """Attitude (body to NED, w first) from the logged one at the start and the gyros alone."""
    attitude_s = attitude.index.to_numpy()
    near_rows = slice(
        *np.clip(np.searchsorted(attitude_s, edges[0]) + np.array([-2, 3]), 0, len(attitude_s))
    )
    logged = attitude.iloc[near_rows][Columns.QUATERNION].to_numpy(copy=True)
    at_start = np.clip(edges[0], attitude_s[near_rows][0], attitude_s[near_rows][-1])
    slerp = Slerp(attitude_s[near_rows], Rotation.from_quat(logged, scalar_first=True))
    start = slerp(at_start).as_quat(scalar_first=True)
    rotation_since_start = running_product(from_vector(np.diff(angle, axis=0)))
    return np.vstack([start, multiply(start, rotation_since_start)])
