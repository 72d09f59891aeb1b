"""Fusion of optical flow in the EKF2 replay, as horizontal velocity in the body frame.

The log contains a low-pass filtered velocity; it is converted to means between two rows. Each mean
is fused at the next event, after adding the velocity change measured by the IMU. The range to the
ground is the logged one.

Sources: PX4-Autopilot ``EKF/aid_sources/optical_flow`` (``optical_flow_control.cpp``: velocity and
low-pass filter; ``optical_flow_fusion.cpp``: R and gate).
"""

from dataclasses import replace

import numpy as np
import pandas as pd

from px4fuse.arrays import Array
from px4fuse.ekf2.magnetometer import EventSamples, fuse_mean
from px4fuse.ekf2.replay_segments import VELOCITY, SensorSamples, Stretch, low_passed
from px4fuse.flight import FLOW_SHARE


def add_flow_samples(stretch: Stretch, flow: pd.DataFrame, gate: float) -> Stretch:
    """Return the stretch with its optical flow samples.

    Parameters
    ----------
    stretch : Stretch
    flow : DataFrame
        As :attr:`px4fuse.flight.FusionRecord.flow`.
    gate : float
        In √S.
    """
    begin_s = flow.index - (flow["samples"] - 1.0) * flow["interval_s"]
    flow = flow[(begin_s > stretch.time_s[0]) & (flow.index <= stretch.time_s[-1])]
    count, interval_s = flow["samples"].to_numpy(), flow["interval_s"].to_numpy()
    step, weight = low_passed(stretch, flow.index.to_numpy(), count, interval_s, FLOW_SHARE)
    turn = stretch.rotation[step].swapaxes(2, 3)[:, :, :2]
    imu_gain = np.einsum("ki,kiab,kib->ka", weight, turn, stretch.imu_velocity_m_s[step])
    velocity, mean = flow[["forward_m_s", "right_m_s"]], np.einsum("ki,kiab->kab", weight, turn)
    sample_fields = (
        step[:, 0],
        velocity.to_numpy() - imu_gain,
        mean,
        count,
        flow["noise_m2_s2"].to_numpy(),
    )
    return replace(stretch, flow=SensorSamples(*sample_fields, gate))


def fuse_flow(x: Array, P: Array, flow_samples: EventSamples, gate: float) -> tuple[Array, Array]:
    """Return state and covariance of S variants after fusing the flow of one event."""
    return fuse_mean(x, P, flow_samples, flow_samples.noise, np.full(len(x), gate), VELOCITY)[:2]
