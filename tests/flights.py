"""Synthetic flights with known truth, made in memory, with optional mistakes.

The vehicle moves back and forth along an aisle. Accelerometer noise is white and equals KF's
default process noise, and UWB noise is white, so a clean flight is consistent with default
settings. EKF2 is synthetic: truth plus noise according to its variances, and innovations with the
wanted NIS.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from px4fuse.analysis import Analysis
from px4fuse.comparison.estimates import Estimates, TuningByAxis
from px4fuse.comparison.flight_events import collect_events
from px4fuse.comparison.imu_oscillation import find_imu_oscillation
from px4fuse.comparison.model import Comparison
from px4fuse.comparison.noise_differences import (
    find_noisy_flight_part,
    tune_perpendicular_axes,
)
from px4fuse.comparison.reruns import rerun_filters
from px4fuse.core.arrays import Array
from px4fuse.ekf2.aids import evaluate_aids
from px4fuse.filter.signals import Axis, Segment, integrate_ned_acceleration
from px4fuse.filter.tuning import HORIZONTAL, tune
from px4fuse.flight.model import (
    AS_RECEIVED_ORIGIN,
    AXIS_NAMES,
    Alignment,
    Columns,
    Dropout,
    Ekf2,
    Flight,
    LogInfo,
    PositionTrack,
    Reset,
    SourceOrigin,
    Truth,
    Unavailable,
)

Span = tuple[float, float]

DT = 0.1  # s, KF's default
GRAVITY_M_S2 = 9.80665
PERIOD_S = 20.0  # s, period of the motion along the aisle
PARAMETERS = {"EKF2_EVP_NOISE": 0.10, "EKF2_EVP_GATE": 5.0, "SDLOG_PROFILE": 129.0}
BODY_TO_NED = Rotation.from_euler("ZYX", [40.0, -3.0, 5.0], degrees=True)


@dataclass(frozen=True)
class Imu:
    """Accelerometer with white noise; ``sigma_a_m_s2`` is that of the mean over DT."""

    rate_hz: float = 100.0
    sigma_a_m_s2: float = 0.5
    gap_s: Span | None = None
    clipped_s: Span | None = None


@dataclass(frozen=True)
class Uwb:
    """The position source."""

    rate_hz: float = 5.0
    sigma_m: float = 0.10
    gap_s: Span | None = None
    outlier_share: float = 0.0
    outlier_m: float = 3.0
    name: str = "vehicle_visual_odometry"
    origin: SourceOrigin = AS_RECEIVED_ORIGIN
    frame: str = "NED"


@dataclass(frozen=True)
class Estimator:
    """Synthetic EKF2.

    ``nis`` is the expected NIS of its innovations; ``every``: one of this many innovations is kept;
    ``fusing``: step function of (time, 0 or 1) for horizontal position, None if not logged.
    """

    sigma_p_m: float = 0.05
    sigma_v_m_s: float = 0.04
    prior_variance_m2: float = 0.06**2
    noise_m: float = 0.10
    nis: float = 1.0
    every: int = 1
    rejected_fraction: float = 0.0
    fusing: tuple[tuple[float, float], ...] | None = ((0.0, 1.0),)
    fusing_yaw: float = 1.0
    resets: tuple[Reset, ...] = ()
    primary_instances: tuple[tuple[float, int], ...] = ((-np.inf, 0),)
    variance_logged: bool = True
    innovations_logged: bool = True
    noise_logged: bool = True
    rejected_logged: bool = True


CLEAN_IMU, CLEAN_UWB, CLEAN_EKF2 = Imu(), Uwb(), Estimator()


def aisle_flight(
    *,
    seed: int = 1,
    duration_s: float = 120.0,
    heading_deg: float = 30.0,
    length_m: float = 10.0,
    imu: Imu | None = CLEAN_IMU,
    attitude_hz: float | None = 50.0,
    uwb: Uwb = CLEAN_UWB,
    ekf2: Estimator | None = CLEAN_EKF2,
    truth: bool = True,
    parameters: Mapping[str, float] | None = None,
    dropouts: tuple[Dropout, ...] = (),
    notes: tuple[str, ...] = (),
    damage: tuple[str, ...] = (),
    excessive_tilt_spans_s: tuple[Span, ...] = (),
) -> Flight:
    """Simulate a flight along the aisle; None omits a part of the log."""
    rng = np.random.default_rng(seed)

    def path(time_s: Array) -> tuple[Array, Array, Array]:
        return motion(time_s, heading_deg, length_m)

    sensor = imu or CLEAN_IMU
    clipped_s = sensor.clipped_s or (np.inf, np.inf)
    time = times(duration_s, sensor.rate_hz, sensor.gap_s)
    force = (path(time)[2] - [0.0, 0.0, GRAVITY_M_S2]) @ BODY_TO_NED.as_matrix()
    # white noise whose mean over DT has sigma_a
    force += rng.normal(0.0, sensor.sigma_a_m_s2 * np.sqrt(DT * sensor.rate_hz), force.shape)
    track = _track(rng, times(duration_s, uwb.rate_hz, uwb.gap_s), uwb, path)
    position_time = times(duration_s, 50.0)
    return Flight(
        log=LogInfo(
            name="aisle.ulg",
            sha256="0" * 64,
            bytes=1,
            format="ULog",
            firmware="PX4 v1.16.1",
            firmware_hash="unknown",
            hardware="PX4_SITL",
            boot_time_s=0.0,
            duration_s=duration_s,
            dropouts=dropouts,
            parameters=PARAMETERS if parameters is None else parameters,
            notes=notes,
            damage=damage,
        ),
        imu=unavailable("IMU")
        if imu is None
        else table(
            time, np.hstack([force, 0.0 * force]), Columns.SPECIFIC_FORCE + Columns.ANGULAR_RATE
        ).assign(clipped=(time >= clipped_s[0]) & (time <= clipped_s[1])),
        attitude=unavailable("attitude")
        if attitude_hz is None
        else table(
            times(duration_s, attitude_hz),
            np.tile(
                BODY_TO_NED.as_quat(scalar_first=True), (len(times(duration_s, attitude_hz)), 1)
            ),
            Columns.QUATERNION,
        ),
        positions=(track,),
        ekf2=unavailable("EKF2")
        if ekf2 is None
        else _ekf2(rng, ekf2, duration_s, track.samples.index.to_numpy()[1 :: ekf2.every], path),
        truth=Truth(
            "vehicle_local_position_groundtruth",
            table(
                position_time,
                np.hstack(path(position_time)[:2]),
                Columns.POSITION + Columns.VELOCITY,
            ),
        )
        if truth
        else unavailable("ground truth"),
        airborne=((0.0, duration_s),),
        excessive_tilt_spans_s=excessive_tilt_spans_s,
    )


def motion(time_s: Array, heading_deg: float, length_m: float) -> tuple[Array, Array, Array]:
    """Return true position, velocity and acceleration, each of shape (n, 3), NED."""
    # along, across, down
    amplitude = np.array([0.5, 0.02, 0.01]) * length_m
    pulsation = 2.0 * np.pi / PERIOD_S * np.array([1.0, 2.0, 1.0])
    phase = np.outer(time_s, pulsation)
    to_ned = Rotation.from_euler("z", heading_deg, degrees=True)
    position = to_ned.apply(amplitude * (1.0 - np.cos(phase))) - [0.0, 0.0, 1.5]
    velocity = to_ned.apply(amplitude * pulsation * np.sin(phase))
    return position, velocity, to_ned.apply(amplitude * pulsation**2 * np.cos(phase))


def times(duration_s: float, rate_hz: float, gap_s: Span | None = None) -> Array:
    """Return times from 0 on, without those strictly inside the gap."""
    time = np.arange(round(duration_s * rate_hz) + 1) / rate_hz
    return time if gap_s is None else time[(time <= gap_s[0]) | (time >= gap_s[1])]


def table(time_s: Array, values: ArrayLike, columns: list[str]) -> pd.DataFrame:
    """Return a time-indexed frame, assembled by columns as the readers do."""
    return pd.DataFrame(
        dict(zip(columns, np.array(values, dtype=float).T, strict=True)),
        index=pd.Index(time_s, name="time_s"),
        copy=False,
    )


def unavailable(what: str) -> Unavailable:
    """Return Unavailable for a part that the log does not contain."""
    return Unavailable(what, f"no {what} topic is logged", f"Log {what}.")


def _track(rng: np.random.Generator, time: Array, uwb: Uwb, path) -> PositionTrack:
    position = path(time)[0] + rng.normal(0.0, uwb.sigma_m, (len(time), 3))
    position[rng.random(len(time)) < uwb.outlier_share, :2] += uwb.outlier_m
    return PositionTrack(
        name=uwb.name,
        origin=uwb.origin,
        description="synthetic UWB",
        samples=table(
            time,
            np.hstack([position, np.full(position.shape, np.nan)]),
            Columns.POSITION + Columns.POSITION_VARIANCE,
        ),
        frame=uwb.frame,
        clock="autopilot boot clock",
        topics=(uwb.name,),
    )


def _ekf2(
    rng: np.random.Generator, made: Estimator, duration_s: float, updates: Array, path
) -> Ekf2:
    time = times(duration_s, 10.0)
    position, velocity, _ = path(time)
    position = position + rng.normal(0.0, made.sigma_p_m, position.shape)
    velocity = velocity + rng.normal(0.0, made.sigma_v_m_s, velocity.shape)
    for reset in made.resets:
        part = position if reset.quantity == "position" else velocity
        part[time >= reset.time_s] += reset.delta
    second = times(duration_s, 1.0)
    variances = np.repeat([made.sigma_p_m**2, made.sigma_v_m_s**2], 3)
    rejected = rng.random(len(updates)) < made.rejected_fraction
    return Ekf2(
        state=table(time, np.hstack([position, velocity]), Columns.POSITION + Columns.VELOCITY),
        variance=table(
            second,
            np.tile(variances, (len(second), 1)),
            Columns.POSITION_VARIANCE + Columns.VELOCITY_VARIANCE,
        )
        if made.variance_logged
        else unavailable("EKF2 variances"),
        innovations={
            axis: _innovations(rng, made, updates, rejected)
            if made.innovations_logged
            else unavailable(f"EKF2 innovations, {axis}")
            for axis in AXIS_NAMES
        },
        innovation_topics=("estimator_aid_src_ev_pos",) if made.innovations_logged else (),
        fusion_flags=unavailable("EKF2 fusion flags")
        if made.fusing is None
        else table(
            np.array([at for at, _ in made.fusing]),
            [[value, 1.0, made.fusing_yaw] for _, value in made.fusing],
            ["horizontal", "vertical", "yaw"],
        ),
        resets=made.resets,
        primary_instances=made.primary_instances,
        gate=5.0,
    )


def _innovations(
    rng: np.random.Generator, made: Estimator, updates: Array, rejected: NDArray[np.bool_]
) -> pd.DataFrame:
    r = made.noise_m**2
    s = r + made.prior_variance_m2
    normalised = rng.normal(0.0, np.sqrt(made.nis), len(updates))
    normalised[rejected] = 6.0  # outside the gate of 5 √S
    return pd.DataFrame(
        {
            "innovation_m": normalised * np.sqrt(s),
            "innovation_variance_m2": s,
            "observation_variance_m2": r if made.noise_logged else np.nan,
            "test_ratio": (normalised / 5.0) ** 2,
            "fused": np.where(rejected, 0.0, 1.0),
            "rejected": np.where(rejected, 1.0, 0.0) if made.rejected_logged else np.nan,
        },
        index=pd.Index(updates, name="time_s"),
    )


def line(
    measurement_time_s: ArrayLike,
    measurement_m: ArrayLike,
    acceleration: tuple[ArrayLike, ArrayLike] | None = None,
) -> Axis:
    """Return an axis with measurements and, from times and values, acceleration."""
    time = np.asarray(measurement_time_s, dtype=float)
    north = np.array([1.0, 0.0, 0.0])
    if acceleration is None:
        signal = unavailable("acceleration")
    else:
        signal = integrate_ned_acceleration(
            table(
                np.asarray(acceleration[0], dtype=float),
                np.outer(acceleration[1], north),
                list(AXIS_NAMES),
            ),
            Segment(-np.inf, np.inf, "whole flight"),
        )
    return Axis("north", north, 0.0, "", time, np.asarray(measurement_m, dtype=float), signal)


def random_walk(
    rng: np.random.Generator, *, count: int, interval_s: float, sigma_a: float, sigma_z: float
) -> Axis:
    """Return an axis for ``input="zero"`` whose process noise equals KF's in each step."""
    per_update = round(interval_s / DT)
    p, v = 0.0, 0.0
    measured = []
    for step in range(count * per_update):
        if step % per_update == 0:
            measured.append(p + rng.normal(0.0, sigma_z) if sigma_z else p)
        a = rng.normal(0.0, sigma_a)
        p, v = p + v * DT + a * DT**2 / 2.0, v + a * DT
    return line(DT * per_update * np.arange(count), measured)


def given_placement(*warnings: str) -> Alignment:
    """Return the frame, yaw and clock options of a position file, all set."""
    return Alignment(
        frame="enu", frame_reason="given", yaw_deg=0.0, yaw_reason="given",
        origin_m=(0.0, 0.0, 0.0), clock_offset_s=0.0, clock_reason="given", reference="",
        warnings=warnings,
    )  # fmt: skip


def unexplained(comparison: Comparison, tuning: TuningByAxis | None = None) -> Analysis:
    """Return an analysis of the comparison without estimates other than ``tuning``."""
    parts = {part.name: getattr(comparison, part.name) for part in fields(Comparison)}
    missing = unavailable("estimates")
    estimates = Estimates(
        tuning=tuning or {}, time_offset=missing, heading=missing, systematic_errors=missing,
        source_low_pass=missing, time_correlated_noise=missing,
        axis_tunings=tune_perpendicular_axes(comparison),
        noisy_flight_part=find_noisy_flight_part(comparison, (tuning or {}).get(HORIZONTAL)),
        imu_oscillation=find_imu_oscillation(comparison),
    )  # fmt: skip
    trials = rerun_filters(comparison, estimates, missing)
    return Analysis(
        **parts, **vars(estimates), ekf2_model=missing, difference_steps={}, reruns=trials,
        events=collect_events(comparison), aids=evaluate_aids(comparison.flight),
        loop=missing,
    )  # fmt: skip


def with_noises(comparison: Comparison) -> Analysis:
    """Return an analysis of the comparison and the maximum-likelihood noises."""
    axes = tuple(result.axis for result in comparison.axes.values())
    tuning = tune(axes, comparison.settings, (HORIZONTAL, "down"))
    return unexplained(comparison, tuning)
