"""Axes and flights for tests of the filter, with known noises, biases and time offsets."""

import numpy as np
import pandas as pd
from exchange import replace
from flights import aisle_flight, line, table
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from px4fuse.comparison.preparation import choose_segment, choose_source
from px4fuse.core.arrays import Array
from px4fuse.filter.likelihood import PreintegratedMotion
from px4fuse.filter.model import INITIAL_COVARIANCE, propagate_covariance, update_step
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import Axis, make_axes
from px4fuse.flight.model import Columns, Flight

# --- axes that follow the model of KF ---

TRUE = Settings(sigma_a_m_s2=0.5, sigma_z_m=0.10, dt_s=0.1, input="zero")
INTERVAL_S = 0.2
COUNT = 300


def modelled(seed: int, count: int = COUNT, *, sigma_a: float = 0.5, sigma_z: float = 0.1) -> Axis:
    """Simulate an axis exactly as KF assumes it, with an initial state drawn from P₀."""
    rng = np.random.default_rng(seed)
    per_leg = round(INTERVAL_S / TRUE.dt_s)
    pushed = rng.normal(0.0, sigma_a, count * per_leg)
    velocity = rng.normal(0.0, 1.0) + TRUE.dt_s * np.concatenate([[0.0], np.cumsum(pushed)])
    way = velocity[:-1] * TRUE.dt_s + pushed * TRUE.dt_s**2 / 2.0
    position = rng.normal(0.0, 0.5) + np.concatenate([[0.0], np.cumsum(way)])
    measured = position[::per_leg] + rng.normal(0.0, sigma_z, count + 1)
    measured[0] = 0.0  # KF starts at 0 m; the true position has σ 0.5 m
    return line(INTERVAL_S * np.arange(count + 1), measured)


def sample_axes(flight: Flight) -> tuple[Axis, ...]:
    track, _ = choose_source(flight)
    return make_axes(flight, track, choose_segment(flight, track))


log_uniform = st.floats(-2.0, 1.0).map(lambda exponent: 10.0**exponent)
any_settings = st.builds(
    Settings,
    sigma_a_m_s2=log_uniform,
    sigma_z_m=log_uniform,
    dt_s=st.floats(0.02, 1.0),
    input=st.sampled_from(["imu", "zero"]),
)


@st.composite
def any_axis(draw: st.DrawFn) -> Axis:
    """Draw measurements at irregular times and an acceleration sampled at 50 Hz."""
    intervals = draw(st.lists(st.floats(0.005, 0.7), min_size=3, max_size=20))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    measured = draw(st.floats(0.0, 500.0)) + np.cumsum(intervals)
    imu = np.arange(measured[0] - 0.05, measured[-1] + 0.05, 0.02)
    return line(measured, rng.normal(0.0, 5.0, len(measured)), (imu, rng.normal(0, 3, len(imu))))


# --- flights with IMU biases and wrong timestamps ---

GRAVITY = np.array([0.0, 0.0, 9.80665])
AMPLITUDE = np.array([4.0, 1.0, 0.3])
PULSATION = 2.0 * np.pi / np.array([12.0, 7.0, 9.0])
IMU_HZ, UWB_HZ = 100.0, 5.0
SIGMA_A, SIGMA_Z, DT = 0.1, 0.1, 0.1
SETTINGS = Settings(sigma_a_m_s2=SIGMA_A, sigma_z_m=SIGMA_Z, dt_s=DT)


def position(time_s: Array) -> Array:
    """Return the true position (m, NED): from rest, oscillating along all three axes."""
    return AMPLITUDE * (1.0 - np.cos(np.outer(time_s, PULSATION)))


def acceleration(time_s: Array) -> Array:
    return AMPLITUDE * PULSATION**2 * np.cos(np.outer(time_s, PULSATION))


def attitude(time_s: Array) -> Rotation:
    """Return the true attitude, body to NED: yaw oscillates by 20°, pitch and roll by 10°."""
    phase = np.outer(time_s, 2.0 * np.pi / np.array([25.0, 6.0, 8.0]))
    angles = np.radians([30.0, 0.0, 5.0]) + np.radians([20.0, 10.0, 10.0]) * np.sin(phase)
    return Rotation.from_euler("ZYX", angles)


def made_flight(
    seed: int = 1,
    *,
    offset_s: float = 0.0,
    duration_s: float = 60.0,
    moving: float = 1.0,
    jump_s: float = 0.0,
    drift_ppm: float = 0.0,
    outliers: int = 0,
    biased: bool = True,
    sigma_a: float = SIGMA_A,
    hole_s: float = 0.0,
) -> tuple[Flight, NDArray[np.bool_]]:
    """Simulate a flight whose timestamps lack ``offset_s``; return it with the outlier mask.

    All sensor noise is white. In the middle of the flight the clock jumps by ``jump_s``, the clock
    drift is zero, and a gap of ``hole_s`` begins in the IMU.
    """
    rng = np.random.default_rng(seed)
    scale = 1.0 if biased else 0.0
    tilt, gyro_bias, force_bias = (
        scale * rng.normal(0.0, sigma, 3) for sigma in (0.02, 0.002, 0.1)
    )
    time = np.arange(round(duration_s * IMU_HZ) + 1) / IMU_HZ
    h = 0.25 / IMU_HZ
    rate = (attitude(time - h).inv() * attitude(time + h)).as_rotvec() / (2.0 * h)
    force = attitude(time).inv().apply(moving * acceleration(time) - GRAVITY)
    rate += gyro_bias + rng.normal(0.0, 0.002, rate.shape)
    # σ of the average over DT is sigma_a
    force += force_bias + rng.normal(0.0, sigma_a * np.sqrt(DT * IMU_HZ), force.shape)
    logged = np.arange(round(duration_s * 50.0) + 1) / 50.0
    quaternion = (Rotation.from_rotvec(tilt) * attitude(logged)).as_quat(scalar_first=True)
    true = np.arange(round(duration_s * UWB_HZ)) / UWB_HZ + rng.uniform(0.0, 0.05)
    measured = moving * position(true) + rng.normal(0.0, SIGMA_Z, (len(true), 3))
    outlier = np.zeros(len(true), dtype=bool)
    outlier[rng.choice(np.arange(10, len(true) - 10), outliers, replace=False)] = True
    measured[outlier, :2] += 1.5
    middle = duration_s / 2.0
    timestamps_s = true - offset_s - jump_s * (true > middle) - drift_ppm * 1e-6 * (true - middle)
    base = aisle_flight(seed=seed, duration_s=duration_s, ekf2=None, truth=False)
    track = replace(
        base.positions[0],
        samples=table(
            timestamps_s,
            np.hstack([measured, np.full(measured.shape, np.nan)]),
            Columns.POSITION + Columns.POSITION_VARIANCE,
        ),
    )
    imu = imu_table(time, force, rate)
    imu = imu[(time <= middle) | (time >= middle + hole_s)]
    flight = replace(
        base, imu=imu, attitude=table(logged, quaternion, Columns.QUATERNION), positions=(track,)
    )
    return flight, outlier


def imu_table(time: Array, force: Array, rate: Array) -> pd.DataFrame:
    return table(time, np.hstack([force, rate]), Columns.SPECIFIC_FORCE + Columns.ANGULAR_RATE)


def attitude_table(time: Array, turn: Rotation) -> pd.DataFrame:
    return table(time, turn.as_quat(scalar_first=True), Columns.QUATERNION)


def score_grid(
    intervals: list[PreintegratedMotion], sigma_a_m_s2: Array, sigma_z_m: Array, weight: Array
) -> Array:
    """Return KF's -ln p of all axes (without a constant) on a grid of settings.

    The variance of a measurement is SIGMA_Z² / weight.
    """
    q, r = np.broadcast_arrays(np.square(sigma_a_m_s2), np.square(sigma_z_m))
    total = np.zeros(q.shape)
    for axis in intervals:
        p, v = 0.0 * q, 0.0 * q
        covariance = INITIAL_COVARIANCE
        for k, z in enumerate(axis.measurement_m):
            p = p + axis.interval_s[k] * v + axis.delta_position_m[k]
            v = v + axis.delta_velocity_m_s[k]
            covariance = tuple(
                p_ij + q * unit + fixed
                for p_ij, unit, fixed in zip(
                    propagate_covariance(covariance, axis.interval_s[k]),
                    axis.process_noise_per_sigma_a_squared[k],
                    axis.process_noise_independent_of_sigma_a[k], strict=True,
                )
            )  # fmt: skip
            (nu, s, _, _), (p, v, covariance) = update_step(p, v, covariance, z, r / weight[k])
            total += 0.5 * (np.log(s) + nu**2 / s)
    return total
