"""KF: the two-state Kalman filter of the lesson UAT 366, module 2, computed with filterpy.

State x = [position, velocity] along one axis; the input u is the acceleration over the step::

    predict    x = Fx + Bu        P = FPFᵀ + Q
    update     y = z - Hx         S = HPHᵀ + R      K = PHᵀS⁻¹
               x = x + Ky         P = (I - KH)P

F, B, Q and H are defined in :mod:`px4fuse.filter.model`, the prediction steps in
:mod:`px4fuse.filter.steps`.
:mod:`~px4fuse.filter.fast_replay` and :mod:`~px4fuse.filter.likelihood` run KF many times; their
faster recursions have the same results to 1e-9.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import pandas as pd

from px4fuse.core.arrays import Array, ArrayPair, BoolArray, IntArray
from px4fuse.core.notebook_display import one_line_repr
from px4fuse.filter import model
from px4fuse.filter.settings import InitialState, Settings
from px4fuse.filter.signals import Axis
from px4fuse.filter.steps import Timeline, make_timeline

StateRow = tuple[float, ...]
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
        State after each prediction and its update, if any: ``position_m, velocity_m_s,
        position_variance_m2, covariance_m2_s, velocity_variance_m2_s2``. Input of the prediction
        step that starts at this time (0 in the last row): ``acceleration_m_s2``, and
        ``input_variance_m2_s4``, which is added to SIGMA_A² in gaps of the IMU.
    updates : DataFrame, shape (m, 8)
        At each measurement after the first: ``measurement_m, innovation_m`` (z - Hx⁻),
        ``innovation_variance_m2`` (HP⁻Hᵀ + R), ``gain_position`` (1), ``gain_velocity`` (1/s), and
        before the update ``prior_position_m``, ``prior_position_variance_m2``,
        ``prior_velocity_variance_m2_s2``.
    input_gap_s : float
        Time without IMU data (s), in which Q is increased by the mean square of the input.
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
        By default the position of the first measurement and velocity zero; the first measurement is
        then not fused.

    Raises
    ------
    SettingsError
        ``settings.input`` is "imu" and the axis has no acceleration.
    """
    from px4fuse.filter.filterpy_import import KalmanFilter  # noqa: PLC0415 - takes 0.1 s

    timeline = make_timeline(axis, settings, initial)
    initial_state = initial or InitialState(timeline.time_s[0], axis.measurement_m[0])
    kalman = KalmanFilter(dim_x=2, dim_z=1, dim_u=1)
    kalman.x = np.array([[initial_state.position_m], [initial_state.velocity_m_s]])
    kalman.P = model.symmetric_matrix(model.INITIAL_COVARIANCE)
    kalman.H = model.H
    kalman.R = np.array([[settings.sigma_z_m**2]])
    kalman.inv = np.reciprocal  # S is 1 by 1
    states = [_state_row(kalman.x, kalman.P)]
    updates = []
    for dt_s, acceleration, gap_variance, measurement_index in zip(
        np.diff(timeline.time_s),
        timeline.acceleration_m_s2,
        timeline.input_variance_m2_s4,
        timeline.measurement_index[1:],
        strict=True,
    ):
        Q = (
            (settings.sigma_a_m_s2**2 + gap_variance)
            * settings.dt_s
            * model.symmetric_matrix(model.process_noise_unit(dt_s))
        )
        kalman.predict(
            u=np.array([[acceleration]]), B=model.input_matrix(dt_s), F=model.transition(dt_s), Q=Q
        )
        if measurement_index >= 0:
            z = axis.measurement_m[measurement_index]
            kalman.update(z)
            y = kalman.y[0, 0]
            S = kalman.S[0, 0]
            K = kalman.K[:, 0]
            x = kalman.x_prior
            P = kalman.P_prior
            updates.append((z, y, S, *K, x[0, 0], P[0, 0], P[1, 1]))
        states.append(_state_row(kalman.x, kalman.P))
    return make_replay(axis, settings, timeline, states, updates)


def make_replay(
    axis: Axis,
    settings: Settings,
    timeline: Timeline,
    states: Sequence[StateRow],
    updates: Sequence[StateRow],
) -> Replay:
    """Build a run of KF from the rows (state, covariance) of ``steps`` and those of ``updates``."""
    time_arrays = timeline.time_s, timeline.time_s[timeline.measurement_index >= 0]
    time, update_index = (pd.Index(times_s, name="time_s") for times_s in time_arrays)
    steps = pd.DataFrame(states, index=time, columns=model.STATE_COLUMNS + model.COVARIANCE_COLUMNS)
    steps["acceleration_m_s2"] = np.append(timeline.acceleration_m_s2, 0.0)
    steps["input_variance_m2_s4"] = np.append(timeline.input_variance_m2_s4, 0.0)
    return Replay(
        axis,
        settings,
        steps,
        pd.DataFrame(updates, update_index, UPDATE_COLUMNS),
        timeline.input_gap_s,
    )


def _state_row(x: Array, P: Array) -> StateRow:
    return x[0, 0], x[1, 0], P[0, 0], P[0, 1], P[1, 1]


def _step_before(run: Replay, times_s: Array) -> tuple[IntArray, Array, BoolArray]:
    """Return the last prediction step before each time, and the time since that step (s).

    Return also a mask of times outside the run.
    """
    step_times_s = run.steps.index.to_numpy()
    step_index = np.clip(
        np.searchsorted(step_times_s, times_s, side="right") - 1, 0, len(step_times_s) - 1
    )
    return (
        step_index,
        times_s - step_times_s[step_index],
        (times_s < step_times_s[0]) | (times_s > step_times_s[-1]),
    )


def state_at(run: Replay, times_s: Array) -> ArrayPair:
    """Predict position (m) and velocity (m/s) at each time from KF's last step before that time.

    Interpolation between two prediction steps would use a measurement before it is received. The
    result is NaN outside the run.
    """
    index, elapsed_s, is_outside = _step_before(run, times_s)
    position, velocity, acceleration = (
        run.steps[column].to_numpy()[index]
        for column in (*model.STATE_COLUMNS, "acceleration_m_s2")
    )
    position, velocity = model.propagate_state(position, velocity, acceleration, elapsed_s)
    return np.where(is_outside, np.nan, position), np.where(is_outside, np.nan, velocity)


def variance_at(run: Replay, times_s: Array) -> ArrayPair:
    """Return the variances (m², m²/s²) of the results of :func:`state_at`: FPFᵀ + Q."""
    index, elapsed_s, is_outside = _step_before(run, times_s)
    p00, p01, p11 = run.steps[model.COVARIANCE_COLUMNS].to_numpy()[index].T
    gap_variance = run.steps["input_variance_m2_s4"].to_numpy()[index]
    noise_density = (run.settings.sigma_a_m_s2**2 + gap_variance) * run.settings.dt_s
    p00, _, p11 = model.propagate_covariance((p00, p01, p11), elapsed_s)
    q00, _, q11 = model.process_noise_unit(elapsed_s)
    return np.where(is_outside, np.nan, p00 + noise_density * q00), np.where(
        is_outside, np.nan, p11 + noise_density * q11
    )
