"""KF: the lesson's two-state Kalman filter, computed with filterpy.

State x = [position, velocity] along one axis; the input u is the acceleration over the step::

    predict    x = Fx + Bu        P = FPFᵀ + Q
    update     y = z - Hx         S = HPHᵀ + R      K = PHᵀS⁻¹
               x = x + Ky         P = (I - KH)P

F, B, Q and H are defined in :mod:`px4fuse.filter.model`, the steps in :mod:`px4fuse.filter.steps`.
``quick`` and the likelihoods, which run many times, have faster recursions, equal to 1e-9.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import pandas as pd

from px4fuse.arrays import Array, BoolArray, IntArray
from px4fuse.filter import model
from px4fuse.filter.settings import InitialState, Settings
from px4fuse.filter.signals import Axis
from px4fuse.filter.steps import Timeline, make_timeline
from px4fuse.notebook_display import one_line_repr

Row = tuple[float, ...]
# Columns of ``Replay.updates``
UPDATE_COLUMNS = [
    "measurement_m",
    "innovation_m",
    "innovation_variance_m2",
    "gain_position",
    "gain_velocity",
    "prior_position_m",
    "prior_position_variance_m2",
    "prior_velocity_variance_m2_s2",
]


@dataclass(frozen=True)
class Replay:
    """Run of KF along one axis.

    Attributes
    ----------
    axis : Axis
    settings : Settings
    steps : DataFrame, shape (n, 7)
        After each prediction and its update, if any: ``position_m, velocity_m_s,
        position_variance_m2, covariance_m2_s, velocity_variance_m2_s2``, and of the step that
        *starts* there (0 at the last) the input ``acceleration_m_s2`` and
        ``input_variance_m2_s4``, added to SIGMA_A² in gaps of the IMU.
    updates : DataFrame, shape (m, 8)
        At each measurement after the first: ``measurement_m, innovation_m`` (z - Hx, prior),
        ``innovation_variance_m2`` (HPHᵀ + R), ``gain_position`` (1), ``gain_velocity`` (1/s), and
        ``prior_position_m``, ``prior_position_variance_m2``, ``prior_velocity_variance_m2_s2``.
    input_gap_s : float
        Time without IMU data (s), in which Q is increased by the input's mean square.
    """

    axis: Axis
    settings: Settings
    steps: pd.DataFrame
    updates: pd.DataFrame
    input_gap_s: float = field(default=0.0)

    __repr__ = one_line_repr


def replay(axis: Axis, settings: Settings, initial: InitialState | None = None) -> Replay:
    """Run KF along one axis.

    Parameters
    ----------
    axis : Axis
    settings : Settings
    initial : InitialState, optional
        Default: first measurement, at rest; that measurement is not fused again.

    Returns
    -------
    Replay

    Raises
    ------
    SettingsError
        ``settings.input`` is "imu" and the axis has no acceleration.
    """
    # late import: filterpy imports scipy.stats, which takes 0.3 s
    from filterpy.kalman import KalmanFilter  # noqa: PLC0415

    line = make_timeline(axis, settings, initial)
    start = initial or InitialState(line.time_s[0], axis.measurement_m[0])
    kalman = KalmanFilter(dim_x=2, dim_z=1, dim_u=1)
    kalman.x = np.array([[start.position_m], [start.velocity_m_s]])
    kalman.P = model.symmetric_matrix(model.INITIAL_COVARIANCE)
    kalman.H = model.H
    kalman.R = np.array([[settings.sigma_z_m**2]])
    kalman.inv = np.reciprocal  # S is 1 by 1
    states, updates = [_state_row(kalman.x, kalman.P)], []
    for dt, u, extra, measurement in zip(
        np.diff(line.time_s),
        line.acceleration_m_s2,
        line.input_variance_m2_s4,
        line.measurement[1:],
        strict=True,
    ):
        Q = (
            (settings.sigma_a_m_s2**2 + extra)
            * settings.dt_s
            * model.symmetric_matrix(model.process_noise_unit(dt))
        )
        kalman.predict(u=np.array([[u]]), B=model.input_matrix(dt), F=model.transition(dt), Q=Q)
        if measurement >= 0:
            z = axis.measurement_m[measurement]
            kalman.update(z)
            y, S, K = kalman.y[0, 0], kalman.S[0, 0], kalman.K[:, 0]
            x, P = kalman.x_prior, kalman.P_prior
            updates.append((z, y, S, *K, x[0, 0], P[0, 0], P[1, 1]))
        states.append(_state_row(kalman.x, kalman.P))
    return as_replay(axis, settings, line, states, updates)


def as_replay(
    axis: Axis, settings: Settings, line: Timeline, states: Sequence[Row], updates: Sequence[Row]
) -> Replay:
    """Build a replay from its rows: state and covariance per step, and the updates."""
    times = line.time_s, line.time_s[line.measurement >= 0]
    time, update_index = (pd.Index(update_time_s, name="time_s") for update_time_s in times)
    steps = pd.DataFrame(states, index=time, columns=model.STATES + model.COVARIANCES)
    steps["acceleration_m_s2"] = np.append(line.acceleration_m_s2, 0.0)
    steps["input_variance_m2_s4"] = np.append(line.input_variance_m2_s4, 0.0)
    return Replay(
        axis, settings, steps, pd.DataFrame(updates, update_index, UPDATE_COLUMNS), line.input_gap_s
    )


def _state_row(x: Array, P: Array) -> Row:
    """Return state and covariance as a row of ``Replay.steps``."""
    return x[0, 0], x[1, 0], P[0, 0], P[0, 1], P[1, 1]


def _step_before(run: Replay, times: Array) -> tuple[IntArray, Array, BoolArray]:
    """Return the index of the step before each time, the time since (s), and if it is outside."""
    edges = run.steps.index.to_numpy()
    step_index = np.clip(np.searchsorted(edges, times, side="right") - 1, 0, len(edges) - 1)
    return step_index, times - edges[step_index], (times < edges[0]) | (times > edges[-1])


def state_at(run: Replay, times: Array) -> tuple[Array, Array]:
    """Return position (m) and velocity (m/s) at other times, predicted from the step before.

    Nothing later than the time is used: interpolation between two steps would use a measurement
    before it is received. NaN outside the replay.
    """
    index, elapsed_s, outside = _step_before(run, times)
    position, velocity, acceleration = (
        run.steps[column].to_numpy()[index] for column in (*model.STATES, "acceleration_m_s2")
    )
    position, velocity = model.propagate_state(position, velocity, acceleration, elapsed_s)
    return np.where(outside, np.nan, position), np.where(outside, np.nan, velocity)


def variance_at(run: Replay, times: Array) -> tuple[Array, Array]:
    """Return the variances (m², m²/s²) of :func:`state_at`: FPFᵀ + Q from the step before."""
    index, elapsed_s, outside = _step_before(run, times)
    p00, p01, p11 = run.steps[model.COVARIANCES].to_numpy()[index].T
    extra = run.steps["input_variance_m2_s4"].to_numpy()[index]
    q = (run.settings.sigma_a_m_s2**2 + extra) * run.settings.dt_s
    (p00, _, p11), (q00, _, q11) = (
        model.propagate_covariance((p00, p01, p11), elapsed_s),
        model.process_noise_unit(elapsed_s),
    )
    return np.where(outside, np.nan, p00 + q * q00), np.where(outside, np.nan, p11 + q * q11)
