"""Fast replay of KF with Python floats instead of arrays, for repeated runs."""

import numpy as np

from px4fuse.filter.kalman import Replay, make_replay
from px4fuse.filter.model import INITIAL_COVARIANCE, predict_step, update_step
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import Axis
from px4fuse.filter.steps import make_timeline


def quick_replay(axis: Axis, settings: Settings) -> Replay:
    """Run KF along one axis: same result as :func:`~px4fuse.filter.kalman.replay` to 1e-9, faster.

    Raises
    ------
    SettingsError
        ``settings.input`` is "imu" and the axis has no acceleration.
    """
    timeline = make_timeline(axis, settings)
    measured_m = axis.measurement_m.tolist()
    variance = settings.sigma_z_m**2
    p = measured_m[0]
    v = 0.0
    covariance = INITIAL_COVARIANCE
    states = [(p, v, *covariance)]
    updates = []
    for dt_s, acceleration, noise_density, measurement_index in zip(
        np.diff(timeline.time_s).tolist(),
        timeline.acceleration_m_s2.tolist(),
        ((settings.sigma_a_m_s2**2 + timeline.input_variance_m2_s4) * settings.dt_s).tolist(),
        timeline.measurement_index[1:].tolist(),
        strict=True,
    ):
        p, v, covariance = predict_step(p, v, covariance, acceleration, noise_density, dt_s)
        if measurement_index >= 0:
            z = measured_m[measurement_index]
            innovation_and_gains, updated_state = update_step(p, v, covariance, z, variance)
            updates.append((z, *innovation_and_gains, p, covariance[0], covariance[2]))
            p, v, covariance = updated_state
        states.append((p, v, *covariance))
    return make_replay(axis, settings, timeline, states, updates)
