"""KF: the two-state Kalman filter of the course UAT 366, module 2, computed with filterpy.

State x = [position, velocity] along one axis; the input u is the acceleration::

    predict    x = Fx + Bu        P = FPFᵀ + Q
    update     y = z - Hx         S = HPHᵀ + R      K = PHᵀS⁻¹
               x = x + Ky         P = (I - KH)P

F, B, Q and H are defined in :mod:`px4fuse.filter.model`. The module
:mod:`~px4fuse.filter.likelihood` runs KF with fewer predictions and equal results.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
import pandas as pd

from px4fuse.core.arrays import Array, BoolArray, IntArray
from px4fuse.core.record import one_line_repr
from px4fuse.filter import model
from px4fuse.filter.settings import InitialState, Settings
from px4fuse.filter.signals import Axis
from px4fuse.filter.steps import make_prediction_steps

TableRows = list[tuple[float, ...]]
# Columns of ``Replay.updates``
UPDATE_TABLE_COLUMNS = [
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
    """Results of KF along one axis.

    Attributes
    ----------
    steps : DataFrame, shape (n, 7)
        State and covariance after each step.
    updates : DataFrame, shape (m, 8)
        Innovation, innovation variance, gains and predicted state at each measurement.
    input_gap_s : float
        Time without IMU data.
    """

    axis: Axis
    settings: Settings
    steps: pd.DataFrame
    updates: pd.DataFrame
    input_gap_s: float = 0.0

    __repr__ = one_line_repr


def replay(
    axis: Axis, settings: Settings, initial: InitialState | None = None, *, fast: bool = False
) -> Replay:
    """Run KF along one axis.

    Parameters
    ----------
    initial : InitialState, optional
        Default: the first measurement, with velocity zero.
    fast : bool
        True to compute with Python floats instead of filterpy (faster, equal results).

    Raises
    ------
    SettingsError
        ``settings.input`` is "imu" and the axis has no acceleration.
    """
    prediction_steps = make_prediction_steps(axis, settings, initial)
    initial_state = initial or InitialState(prediction_steps.time_s[0], axis.measurement_m[0])
    run_filter = _run_with_floats if fast else _run_with_filterpy
    states, updates = run_filter(
        initial_state,
        settings.sigma_z_m**2,
        np.diff(prediction_steps.time_s).tolist(),
        prediction_steps.acceleration_m_s2.tolist(),
        (
            (settings.sigma_a_m_s2**2 + prediction_steps.input_variance_m2_s4) * settings.dt_s
        ).tolist(),
        [
            axis.measurement_m[index] if index >= 0 else None
            for index in prediction_steps.measurement_index[1:]
        ],
    )
    step_times_s, update_times_s = (
        pd.Index(times_s, name="time_s")
        for times_s in (
            prediction_steps.time_s,
            prediction_steps.time_s[prediction_steps.measurement_index >= 0],
        )
    )
    steps = _make_table(states, step_times_s, model.STATE_COLUMNS + model.COVARIANCE_COLUMNS)
    steps["acceleration_m_s2"] = np.append(prediction_steps.acceleration_m_s2, 0.0)
    steps["input_variance_m2_s4"] = np.append(prediction_steps.input_variance_m2_s4, 0.0)
    return Replay(
        axis,
        settings,
        steps,
        _make_table(updates, update_times_s, UPDATE_TABLE_COLUMNS),
        prediction_steps.input_gap_s,
    )


def _make_table(rows: TableRows, index: "pd.Index[float]", columns: list[str]) -> pd.DataFrame:
    # pandas needs twice the time for a list of tuples
    values = np.fromiter(chain.from_iterable(rows), np.float64, len(rows) * len(columns))
    return pd.DataFrame(values.reshape(-1, len(columns)), index, columns)


def _run_with_filterpy(
    initial_state: InitialState, measurement_variance: float, *inputs: Sequence[Any]
) -> tuple[TableRows, TableRows]:
    """Run KF with filterpy; return the rows of :attr:`Replay.steps` and :attr:`Replay.updates`.

    ``inputs`` are four sequences with one value for each step: step length (s), acceleration
    (m/s²), noise density SIGMA_A² · DT (m²/s³), and measured position (m) or None.
    """
    from px4fuse.filter.filterpy_import import KalmanFilter  # noqa: PLC0415 - takes 0.1 s

    kalman = KalmanFilter(dim_x=2, dim_z=1, dim_u=1)
    kalman.x = np.array([[initial_state.position_m], [initial_state.velocity_m_s]])
    kalman.P = model.make_symmetric_matrix(model.INITIAL_COVARIANCE)
    kalman.H = np.array([[1.0, 0.0]])
    kalman.R = np.array([[measurement_variance]])
    kalman.inv = np.reciprocal  # S is 1 by 1
    states: TableRows = [
        (initial_state.position_m, initial_state.velocity_m_s, *model.INITIAL_COVARIANCE)
    ]
    updates: TableRows = []
    dt_s, acceleration, noise_density = (np.array(values)[:, None, None] for values in inputs[:3])
    matrices = (
        acceleration,
        np.concatenate([dt_s**2 / 2.0, dt_s], axis=1),
        model.make_transition_matrix(dt_s[:, 0, 0]),
        noise_density
        * model.make_symmetric_matrix(model.compute_process_noise_per_density(dt_s[:, 0, 0])),
    )
    for u, B, F, Q, measured_m in zip(*matrices, inputs[3], strict=True):
        kalman.predict(u=u, B=B, F=F, Q=Q)
        if measured_m is not None:
            # Without the argument H, filterpy copies the measurement (slow)
            kalman.update(measured_m, H=kalman.H)
            x, P, K = kalman.x_prior, kalman.P_prior, kalman.K
            updates.append(
                (
                    measured_m,
                    kalman.y[0, 0],
                    kalman.S[0, 0],
                    K[0, 0],
                    K[1, 0],
                    x[0, 0],
                    P[0, 0],
                    P[1, 1],
                )
            )
        x, P = kalman.x, kalman.P
        states.append((x[0, 0], x[1, 0], P[0, 0], P[0, 1], P[1, 1]))
    return states, updates


def _run_with_floats(
    initial_state: InitialState, measurement_variance: float, *inputs: Sequence[Any]
) -> tuple[TableRows, TableRows]:
    """Run KF with Python floats, which is faster than filterpy."""
    position, velocity, covariance = (
        initial_state.position_m,
        initial_state.velocity_m_s,
        model.INITIAL_COVARIANCE,
    )
    states: TableRows = [(position, velocity, *covariance)]
    updates: TableRows = []
    for dt_s, acceleration, noise_density, measured_m in zip(*inputs, strict=True):
        position, velocity, covariance = model.predict_step(
            position, velocity, covariance, acceleration, noise_density, dt_s
        )
        if measured_m is not None:
            innovation_variance_and_gains, updated_state = model.update_step(
                position, velocity, covariance, measured_m, measurement_variance
            )
            updates.append(
                (measured_m, *innovation_variance_and_gains, position, covariance[0], covariance[2])
            )
            position, velocity, covariance = updated_state
        states.append((position, velocity, *covariance))
    return states, updates


def _find_previous_steps(run: Replay, times_s: Array) -> tuple[IntArray, Array, BoolArray]:
    """Find for each time the last step of KF before it.

    Return its index, the time (s) since this step, and True for times outside KF's time span.
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


def predict_state(run: Replay, times_s: Array) -> Array:
    """Predict position (m) and velocity (m/s) at each time from KF's last step before it.

    Interpolation would use later measurements. Times outside the time span of KF give NaN.
    """
    step_index, elapsed_s, is_outside = _find_previous_steps(run, times_s)
    position, velocity, acceleration = (
        run.steps[column].to_numpy()[step_index]
        for column in (*model.STATE_COLUMNS, "acceleration_m_s2")
    )
    state = model.propagate_state(position, velocity, acceleration, elapsed_s)
    return np.where(is_outside, np.nan, state)


def predict_variance(run: Replay, times_s: Array) -> Array:
    """Return the variances (m², m²/s²) of position and velocity from :func:`predict_state`."""
    step_index, elapsed_s, is_outside = _find_previous_steps(run, times_s)
    p00, p01, p11 = run.steps[model.COVARIANCE_COLUMNS].to_numpy()[step_index].T
    imu_gap_variance_m2_s4 = run.steps["input_variance_m2_s4"].to_numpy()[step_index]
    noise_density = (run.settings.sigma_a_m_s2**2 + imu_gap_variance_m2_s4) * run.settings.dt_s
    position_variance_m2, _, velocity_variance_m2_s2 = model.propagate_covariance(
        (p00, p01, p11), elapsed_s
    )
    q00, _, q11 = model.compute_process_noise_per_density(elapsed_s)
    return np.where(
        is_outside,
        np.nan,
        (position_variance_m2 + noise_density * q00, velocity_variance_m2_s2 + noise_density * q11),
    )
