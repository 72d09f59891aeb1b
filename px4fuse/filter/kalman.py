"""KF: the two-state Kalman filter of the course UAT 366, module 2, computed with filterpy.

State x = [position, velocity] along one axis; the input u is the acceleration::

    predict    x = Fx + Bu        P = FPFᵀ + Q
    update     y = z - Hx         S = HPHᵀ + R      K = PHᵀS⁻¹
               x = x + Ky         P = (I - KH)P

F, B, Q and H are defined in :mod:`px4fuse.filter.model`. The module
:mod:`~px4fuse.filter.likelihood` runs KF with fewer predictions and equal results.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
import pandas as pd

from px4fuse.core.arrays import Array
from px4fuse.core.record import one_line_repr

from . import model
from .settings import Settings
from .signals import Axis
from .steps import PredictionSteps, make_prediction_steps

# Columns of ``KfRun.updates``
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
STATE_TABLE_COLUMNS = model.STATE_COLUMNS + model.COVARIANCE_COLUMNS
NO_UPDATE = (math.nan,) * len(UPDATE_TABLE_COLUMNS)


@dataclass(frozen=True)
class KfRun:
    """Results of KF along one axis.

    Attributes
    ----------
    steps : DataFrame, shape (n, 7)
        State and covariance after each step; input of the next step: acceleration, and additional
        acceleration variance if the step is in an IMU gap.
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


def run_kf(axis: Axis, settings: Settings, *, fast: bool = False) -> KfRun:
    """Run KF along one axis.

    The initial position is the first measurement, the initial velocity is zero.

    Parameters
    ----------
    axis : Axis
        Measured positions, and acceleration as input of KF.
    fast : bool
        True to compute with Python floats, for many re-runs (faster, equal results). By default, KF
        is computed with the library filterpy.

    Raises
    ------
    SettingsError
        ``settings.input`` is "imu" and the axis has no acceleration.
    """
    prediction_steps = make_prediction_steps(axis, settings)
    run_filter = _run_with_floats if fast else _run_with_filterpy
    position_m = axis.measurement_m.tolist()
    measurements_m = [
        position_m[index] if index >= 0 else None
        for index in prediction_steps.measurement_index[1:].tolist()  # 0 is the initial state
    ]
    # Each row contains a state (STATE_TABLE_COLUMNS), then an update (UPDATE_TABLE_COLUMNS), which
    # is NaN in the row of the initial state and in steps without a measurement
    initial_row = (position_m[0], 0.0, *model.INITIAL_COVARIANCE, *NO_UPDATE)
    rows = run_filter(settings, position_m[0], prediction_steps, measurements_m)
    # A list of rows would need more memory
    time_s, row_type = prediction_steps.time_s, np.dtype((float, len(initial_row)))
    values = np.fromiter(chain([initial_row], rows), row_type, len(time_s))
    states, updates = np.split(values, [len(STATE_TABLE_COLUMNS)], axis=1)
    steps = pd.DataFrame(states, pd.Index(time_s, name="time_s"), STATE_TABLE_COLUMNS)
    # No step follows the last state
    steps["acceleration_m_s2"] = np.append(prediction_steps.acceleration_m_s2, 0.0)
    steps["imu_gap_variance_m2_s4"] = np.append(prediction_steps.imu_gap_variance_m2_s4, 0.0)
    update_rows = prediction_steps.last_steps
    return KfRun(
        axis,
        settings,
        steps,
        pd.DataFrame(updates[update_rows], steps.index[update_rows], UPDATE_TABLE_COLUMNS),
        prediction_steps.input_gap_s,
    )


def _run_with_filterpy(
    settings: Settings,
    initial_position_m: float,
    prediction_steps: PredictionSteps,
    measurements_m: Sequence[float | None],
) -> Iterator[tuple[float, ...]]:
    """Run KF with filterpy; yield the state and the update after each step.

    The values are the columns STATE_TABLE_COLUMNS and UPDATE_TABLE_COLUMNS. ``measurements_m`` is
    the measured position at the end of each step, or None.
    """
    from .filterpy_import import KalmanFilter  # noqa: PLC0415 - takes 0.1 s

    kalman = KalmanFilter(dim_x=2, dim_z=1, dim_u=1)
    kalman.x = np.array([[initial_position_m], [0.0]])
    kalman.P = model.make_symmetric_matrix(model.INITIAL_COVARIANCE)
    kalman.H = np.array([[1.0, 0.0]])
    kalman.R = np.array([[settings.sigma_z_m**2]])
    kalman.inv = np.reciprocal  # S is 1 by 1
    dt_s = np.diff(prediction_steps.time_s)
    noise_density = settings.compute_noise_density(prediction_steps.imu_gap_variance_m2_s4)
    matrices = (
        prediction_steps.acceleration_m_s2[:, None, None],
        np.stack([dt_s**2 / 2.0, dt_s], axis=1)[:, :, None],
        model.make_transition_matrix(dt_s),
        noise_density[:, None, None]
        * model.make_symmetric_matrix(model.compute_unit_density_process_noise(dt_s)),
    )
    for u, B, F, Q, measured_m in zip(*matrices, measurements_m, strict=True):
        kalman.predict(u=u, B=B, F=F, Q=Q)
        update = NO_UPDATE
        if measured_m is not None:
            # Without the argument H, filterpy copies the measurement (slow)
            kalman.update(measured_m, H=kalman.H)
            x, P, K = kalman.x_prior, kalman.P_prior, kalman.K
            update = (
                measured_m,
                kalman.y[0, 0],
                kalman.S[0, 0],
                *K[:, 0],
                x[0, 0],
                P[0, 0],
                P[1, 1],
            )
        x, P = kalman.x, kalman.P
        yield (*x[:, 0], P[0, 0], P[0, 1], P[1, 1], *update)


def _run_with_floats(
    settings: Settings,
    initial_position_m: float,
    prediction_steps: PredictionSteps,
    measurements_m: Sequence[float | None],
) -> Iterator[tuple[float, ...]]:
    """Run KF with Python floats. Arguments and results are those of _run_with_filterpy."""
    position, velocity, covariance = initial_position_m, 0.0, model.INITIAL_COVARIANCE
    arrays = (
        np.diff(prediction_steps.time_s),
        prediction_steps.acceleration_m_s2,
        settings.compute_noise_density(prediction_steps.imu_gap_variance_m2_s4),
    )
    for dt_s, acceleration, noise_density, measured_m in zip(
        *(values.tolist() for values in arrays), measurements_m, strict=True
    ):
        position, velocity, covariance = model.predict_step(
            position, velocity, covariance, acceleration, noise_density, dt_s
        )
        update = NO_UPDATE
        if measured_m is not None:
            innovation_and_gains, updated_state = model.update_step(
                position, velocity, covariance, measured_m, settings.sigma_z_m**2
            )
            # The order is that of UPDATE_TABLE_COLUMNS. Position and variances are those before the
            # update (prior)
            update = measured_m, *innovation_and_gains, position, covariance[0], covariance[2]
            position, velocity, covariance = updated_state
        yield (position, velocity, *covariance, *update)


def predict_track(run: KfRun, times_s: Array) -> pd.DataFrame:
    """Predict state and covariance at each time from KF's last step before it.

    Interpolation would use later measurements. Times outside the time span of KF give NaN.
    """
    step_times_s = run.steps.index.to_numpy()
    is_inside = (times_s >= step_times_s[0]) & (times_s <= step_times_s[-1])
    step_index = np.clip(np.searchsorted(step_times_s, times_s, side="right") - 1, 0, None)
    position, velocity, p00, p01, p11, acceleration, imu_gap_variance_m2_s4 = run.steps.to_numpy()[
        step_index
    ].T
    position, velocity, covariance = model.predict_step(
        position,
        velocity,
        (p00, p01, p11),
        acceleration,
        run.settings.compute_noise_density(imu_gap_variance_m2_s4),
        np.where(is_inside, times_s - step_times_s[step_index], np.nan),
    )
    track = np.transpose([position, velocity, *covariance])
    return pd.DataFrame(track, times_s, STATE_TABLE_COLUMNS)
