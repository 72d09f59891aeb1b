"""Replay like :mod:`px4fuse.filter.kalman` in plain floats, for re-runs."""

import numpy as np

from px4fuse.filter.kalman import Replay, as_replay
from px4fuse.filter.model import INITIAL_COVARIANCE, predict_step, update_step
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import Axis
from px4fuse.filter.steps import make_timeline


def quick_replay(axis: Axis, settings: Settings) -> Replay:
    """Run KF as :func:`~px4fuse.filter.kalman.replay`, equal to 1e-9 and much faster.

    Parameters
    ----------
    axis : Axis
    settings : Settings

    Raises
    ------
    SettingsError
        See :func:`~px4fuse.filter.kalman.replay`.
    """
    line = make_timeline(axis, settings)
    measured_m, r = axis.measurement_m.tolist(), settings.sigma_z_m**2
    p, v, covariance = measured_m[0], 0.0, INITIAL_COVARIANCE
    states, updates = [(p, v, *covariance)], []
    for dt, a, q, measurement in zip(
        np.diff(line.time_s).tolist(),
        line.acceleration_m_s2.tolist(),
        ((settings.sigma_a_m_s2**2 + line.input_variance_m2_s4) * settings.dt_s).tolist(),
        line.measurement[1:].tolist(),
        strict=True,
    ):
        p, v, covariance = predict_step(p, v, covariance, a, q, dt)
        if measurement >= 0:
            z = measured_m[measurement]
            innovation_and_gains, updated = update_step(p, v, covariance, z, r)
            updates.append((z, *innovation_and_gains, p, covariance[0], covariance[2]))
            p, v, covariance = updated
        states.append((p, v, *covariance))
    return as_replay(axis, settings, line, states, updates)
