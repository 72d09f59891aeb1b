"""The two-state Kalman filter of the lesson, on filterpy: Axis + Settings → Replay.

Its model, F, B, Q, H and R, stands in :mod:`px4fuse.filter.model`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import get_args

import numpy as np
import pandas as pd

from px4fuse.arrays import Array, BoolArray, IntArray
from px4fuse.display import brief
from px4fuse.errors import SettingsError
from px4fuse.filter.driven import driven
from px4fuse.filter.model import (
    COVARIANCES,
    INITIAL_COVARIANCE,
    STATES,
    H,
    Symmetric,
    matrix,
    move,
    noise,
    spread,
)
from px4fuse.filter.signals import Axis, step_means
from px4fuse.flight import Unavailable
from px4fuse.request import InputName

INPUT_NAMES: tuple[InputName, ...] = get_args(InputName)

# Ranges outside which a setting is a slip of the keyboard, not a choice.
SIGMA_A_RANGE_M_S2 = (1e-4, 100.0)
SIGMA_Z_RANGE_M = (1e-4, 100.0)
DT_RANGE_S = (1e-3, 1.0)
CLOCK_OFFSET_RANGE_S = (-10.0, 10.0)
# Two times closer than this are one step: stamps have a resolution of one microsecond.
SAME_TIME_S = 5e-7


@dataclass(frozen=True)
class Settings:
    """What the user may turn.

    Attributes
    ----------
    sigma_a_m_s2 : float
        Process noise SIGMA_A, standard deviation of the acceleration input over one DT.
    sigma_z_m : float
        Measurement noise SIGMA_Z.
    dt_s : float
        Prediction grid DT.
    input : {"imu", "zero"}
        Acceleration measured by the IMU, or the lesson's constant-velocity case.
    clock_offset_s : float
        Added to the position source's time stamps.

    Raises
    ------
    SettingsError
        A value is outside its documented range, or not a number.
    """

    sigma_a_m_s2: float = 0.5
    sigma_z_m: float = 0.10
    dt_s: float = 0.1
    input: InputName = "imu"
    clock_offset_s: float = 0.0

    def __post_init__(self) -> None:
        for name, value, (low, high), unit in (
            ("sigma_a_m_s2", self.sigma_a_m_s2, SIGMA_A_RANGE_M_S2, "m/s²"),
            ("sigma_z_m", self.sigma_z_m, SIGMA_Z_RANGE_M, "m"),
            ("dt_s", self.dt_s, DT_RANGE_S, "s"),
            ("clock_offset_s", self.clock_offset_s, CLOCK_OFFSET_RANGE_S, "s"),
        ):
            if not low <= value <= high:  # false for NaN too
                raise SettingsError(
                    f"`{name}` {value:g} is out of range: give {low:g} to {high:g} {unit}."
                )
        if self.input not in INPUT_NAMES:
            raise SettingsError(f"`input` {self.input}: give {' or '.join(INPUT_NAMES)}.")


@dataclass(frozen=True)
class InitialState:
    """Where the filter starts: time (s), position (m) and velocity (m/s), with the lesson's P₀."""

    time_s: float
    position_m: float
    velocity_m_s: float = 0.0


@dataclass(frozen=True)
class Replay:
    """The filter's run over one axis.

    Attributes
    ----------
    axis : Axis
    settings : Settings
    steps : DataFrame, shape (n, 7)
        After each predict, and its update where there was one: ``position_m, velocity_m_s,
        position_variance_m2, covariance_m2_s, velocity_variance_m2_s2``, and of the step that
        *starts* there (0 at the last) its input ``acceleration_m_s2`` and
        ``input_variance_m2_s4``, added to SIGMA_A² where the IMU has a gap.
    updates : DataFrame, shape (m, 8)
        At each measurement after the first: ``measurement_m, innovation_m`` (z - Hx, prior),
        ``innovation_variance_m2`` (HPHᵀ + R), ``gain_position`` (1), ``gain_velocity`` (1/s), and
        ``prior_position_m``, ``prior_position_variance_m2``, ``prior_velocity_variance_m2_s2``.
    input_gap_s : float
        Seconds without IMU inside the replay, where Q was raised by the input's mean square.
    """

    axis: Axis
    settings: Settings
    steps: pd.DataFrame
    updates: pd.DataFrame
    input_gap_s: float = field(default=0.0)

    __repr__ = brief


@dataclass(frozen=True)
class Timeline:
    """The filter's steps: the DT grid and every measurement's own time.

    Attributes
    ----------
    time_s : ndarray, shape (n,)
        Strictly increasing; the first is the initial state's.
    measurement : ndarray of int, shape (n,)
        Index of the measurement at that time, -1 where there is none.
    acceleration_m_s2 : ndarray, shape (n - 1,)
        Input of each step.
    input_variance_m2_s4 : ndarray, shape (n - 1,)
        Added to SIGMA_A² where the IMU has a gap.
    """

    time_s: Array
    measurement: IntArray
    acceleration_m_s2: Array
    input_variance_m2_s4: Array
    input_gap_s: float


def timeline(axis: Axis, settings: Settings, initial: InitialState | None = None) -> Timeline:
    """Lay out the filter's steps.

    Raises
    ------
    SettingsError
        ``settings.input`` is "imu" and the axis has no acceleration, or no measurement follows
        the start.
    """
    first = axis.measurement_time_s[0] if initial is None else initial.time_s
    usable = axis.measurement_time_s > first + SAME_TIME_S
    measured = axis.measurement_time_s[usable]
    if not len(measured):
        raise SettingsError(f"axis {axis.name}: no measurement after the start at {first:.2f} s.")
    count = int(np.floor((measured[-1] - first) / settings.dt_s + 1e-9)) + 1
    grid = first + settings.dt_s * np.arange(count)
    # a grid time that coincides with a measurement gives way to the measurement's own stamp
    nearest = measured[np.clip(np.searchsorted(measured, grid), 0, len(measured) - 1)]
    before = measured[np.clip(np.searchsorted(measured, grid) - 1, 0, len(measured) - 1)]
    distance = np.minimum(np.abs(nearest - grid), np.abs(before - grid))
    time = np.union1d(grid[distance > SAME_TIME_S], measured)
    if time[0] > first + SAME_TIME_S:
        time = np.concatenate([[first], time])
    measurement = np.full(len(time), -1, dtype=np.intp)
    measurement[np.searchsorted(time, measured)] = np.flatnonzero(usable)
    steps = len(time) - 1
    if settings.input == "zero":
        return Timeline(time, measurement, np.zeros(steps), np.zeros(steps), 0.0)
    if isinstance(axis.acceleration, Unavailable):
        raise SettingsError(f"`input` imu needs an acceleration. {axis.acceleration}")
    mean, gap = step_means(axis.acceleration, time)
    gap_s = gap * np.diff(time)
    # Unknown acceleration persists through a gap: after T seconds it has moved the velocity by
    # rms·T, not by the rms·√(DT·T) of white noise, so its variance is scaled by T/DT.
    leg = np.searchsorted(np.flatnonzero(measurement >= 0), np.arange(1, len(time)))
    gap_of_leg = np.bincount(leg, weights=gap_s)[leg]
    persistence = np.maximum(gap_of_leg / settings.dt_s, 1.0)
    return Timeline(
        time,
        measurement,
        mean,
        gap * persistence * axis.acceleration.rms_m_s2**2,
        float(np.sum(gap_s)),
    )


def replay(axis: Axis, settings: Settings, initial: InitialState | None = None) -> Replay:
    """Run the filter over one axis.

    Parameters
    ----------
    axis : Axis
    settings : Settings
    initial : InitialState, optional
        By default the first measurement, at rest; that measurement is then not fused again.

    Returns
    -------
    Replay

    Raises
    ------
    SettingsError
        ``settings.input`` is "imu" and the axis has no acceleration.
    """
    line = timeline(axis, settings, initial)
    start = initial or InitialState(line.time_s[0], axis.measurement_m[0])
    return _replayed((axis,), settings, (line,), (start,))[0]


def replay_all(axes: tuple[Axis, ...], settings: Settings) -> tuple[Replay, ...]:
    """Run the filter over several axes, as :func:`replay` does each.

    Axes with the same steps have the same P, S and K, which are computed once.

    Parameters
    ----------
    axes : tuple of Axis
    settings : Settings

    Raises
    ------
    SettingsError
        ``settings.input`` is "imu" and an axis has no acceleration.
    """
    lines = [timeline(axis, settings) for axis in axes]
    made: dict[int, Replay] = {}
    for at, line in enumerate(lines):
        if at in made:
            continue
        same = [k for k in range(at, len(axes)) if k not in made and _same_steps(line, lines[k])]
        runs = _replayed(
            tuple(axes[k] for k in same),
            settings,
            tuple(lines[k] for k in same),
            tuple(InitialState(line.time_s[0], axes[k].measurement_m[0]) for k in same),
        )
        made |= dict(zip(same, runs, strict=True))
    return tuple(made[at] for at in range(len(axes)))


def _same_steps(one: Timeline, other: Timeline) -> bool:
    return all(
        np.array_equal(getattr(one, name), getattr(other, name))
        for name in ("time_s", "measurement", "input_variance_m2_s4")
    )


def _replayed(
    axes: tuple[Axis, ...],
    settings: Settings,
    lines: tuple[Timeline, ...],
    starts: tuple[InitialState, ...],
) -> tuple[Replay, ...]:
    """Run one filter over axes whose steps are the same: P, S and K once, x of each.

    Each measurement is an update of filterpy's. Between them P = FPFᵀ + Q is written out in plain
    floats, which filterpy's matrices take twenty times as long for.
    """
    # scipy.stats, which filterpy imports, costs a third of a second: not where nothing is replayed
    from filterpy.kalman import KalmanFilter  # noqa: PLC0415

    line = lines[0]
    kalman = KalmanFilter(dim_x=2, dim_z=1)
    kalman.H = H
    kalman.R = np.array([[settings.sigma_z_m**2]])
    lengths = np.diff(line.time_s)
    measures = line.measurement[1:] >= 0
    noises = (settings.sigma_a_m_s2**2 + line.input_variance_m2_s4) * settings.dt_s
    covariance: Symmetric[float] = INITIAL_COVARIANCE
    covariances, shared = [covariance], []  # of updates: S, K, and the prior variances
    for dt, q, measured in zip(lengths.tolist(), noises.tolist(), measures.tolist(), strict=True):
        p00, p01, p11 = spread(covariance, dt)
        q00, q01, q11 = noise(dt)
        covariance = p00 + q * q00, p01 + q * q01, p11 + q * q11
        if measured:
            kalman.P = matrix(covariance)
            kalman.update(0.0)  # what was measured enters neither S nor K nor P
            gains = kalman.K[:, 0].tolist()
            shared.append((kalman.S[0, 0], *gains, covariance[0], covariance[2]))
            (p00, p01), (_, p11) = kalman.P.tolist()
            covariance = p00, p01, p11
        covariances.append(covariance)
    told = np.array(shared)
    gain, fused = np.zeros((len(lengths), 2)), np.zeros((len(lengths), len(axes)))
    gain[measures] = told[:, 1:3]
    update = np.flatnonzero(line.measurement >= 0)
    fused[measures] = np.stack([axis.measurement_m for axis in axes], 1)[line.measurement[update]]
    acceleration = np.stack([each.acceleration_m_s2 for each in lines], axis=1)
    step = lengths[:, None]
    begin = np.array([[at.position_m for at in starts], [at.velocity_m_s for at in starts]])
    prior, state = driven(
        lengths, gain, acceleration * step**2 / 2.0, acceleration * step, fused, begin
    )
    time, updated = (pd.Index(each, name="time_s") for each in (line.time_s, line.time_s[update]))
    runs = []
    for at, (axis, own) in enumerate(zip(axes, lines, strict=True)):
        steps = pd.DataFrame(
            np.column_stack([state[..., at], covariances]),
            index=time,
            columns=STATES + COVARIANCES,
        )
        steps["acceleration_m_s2"] = np.append(own.acceleration_m_s2, 0.0)
        steps["input_variance_m2_s4"] = np.append(line.input_variance_m2_s4, 0.0)
        updates = pd.DataFrame(
            {
                "measurement_m": fused[measures, at],
                "innovation_m": (fused - prior)[measures, at],
                "innovation_variance_m2": told[:, 0],
                "gain_position": told[:, 1],
                "gain_velocity": told[:, 2],
                "prior_position_m": prior[measures, at],
                "prior_position_variance_m2": told[:, 3],
                "prior_velocity_variance_m2_s2": told[:, 4],
            },
            index=updated,
        )
        runs.append(Replay(axis, settings, steps, updates, own.input_gap_s))
    return tuple(runs)


def _ahead(run: Replay, times: Array) -> tuple[IntArray, Array, BoolArray]:
    """The step before each time, how long ago it was (s), and whether the time is outside."""
    edges = run.steps.index.to_numpy()
    at = np.clip(np.searchsorted(edges, times, side="right") - 1, 0, len(edges) - 1)
    return at, times - edges[at], (times < edges[0]) | (times > edges[-1])


def state_at(run: Replay, times: Array) -> tuple[Array, Array]:
    """Position (m) and velocity (m/s) at other times, predicted from the step before each.

    Nothing later than the time itself is used: interpolating between two steps would let a
    measurement act before it arrived. NaN outside the replay.
    """
    at, ahead, outside = _ahead(run, times)
    position, velocity, acceleration = (
        run.steps[column].to_numpy()[at] for column in (*STATES, "acceleration_m_s2")
    )
    position, velocity = move(position, velocity, acceleration, ahead)
    return np.where(outside, np.nan, position), np.where(outside, np.nan, velocity)


def variance_at(run: Replay, times: Array) -> tuple[Array, Array]:
    """Variances (m², m²/s²) that belong to :func:`state_at`: P = FPFᵀ + Q from the step before."""
    at, ahead, outside = _ahead(run, times)
    p00, p01, p11 = run.steps[COVARIANCES].to_numpy()[at].T
    extra = run.steps["input_variance_m2_s4"].to_numpy()[at]
    q = (run.settings.sigma_a_m_s2**2 + extra) * run.settings.dt_s
    (p00, _, p11), (q00, _, q11) = spread((p00, p01, p11), ahead), noise(ahead)
    return np.where(outside, np.nan, p00 + q * q00), np.where(outside, np.nan, p11 + q * q11)
