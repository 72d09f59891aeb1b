"""Optical flow as EKF2 fuses it, told as the velocity of the body across the camera's axis.

The log has a low pass of it, and of that the mean of all samples between two rows. It is fused with
the next event: where the body moved from then on is known from the IMU. The range to the ground is
the log's own.

Sources: PX4-Autopilot ``EKF/aid_sources/optical_flow`` (``optical_flow_control.cpp``: velocities
and their low pass; ``optical_flow_fusion.cpp``: R and gate).
"""

from dataclasses import replace

import numpy as np
import pandas as pd

from px4fuse.arrays import Array
from px4fuse.ekf2.magnetometer import EventSamples, fuse_mean
from px4fuse.ekf2.stretches import VELOCITY, SensorSamples, Stretch, low_passed
from px4fuse.flight import FLOW_SHARE


def add_flow_samples(stretch: Stretch, flow: pd.DataFrame, gate: float) -> Stretch:
    """The same stretch with what of the flow lies in it.

    Parameters
    ----------
    stretch : Stretch
    flow : DataFrame
        As :attr:`px4fuse.flight.FusionRecord.flow` has it.
    gate : float
        In standard deviations.
    """
    begin_s = flow.index - (flow["samples"] - 1.0) * flow["interval_s"]
    flow = flow[(begin_s > stretch.time_s[0]) & (flow.index <= stretch.time_s[-1])]
    count, interval_s = flow["samples"].to_numpy(), flow["interval_s"].to_numpy()
    step, weight = low_passed(stretch, flow.index.to_numpy(), count, interval_s, FLOW_SHARE)
    turn = stretch.rotation[step].swapaxes(2, 3)[:, :, :2]
    imu_gain = np.einsum("ki,kiab,kib->ka", weight, turn, stretch.gained_m_s[step])
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
    """State and covariance of S variants after the flow of one event."""
    return fuse_mean(x, P, flow_samples, flow_samples.noise, np.full(len(x), gate), VELOCITY)[:2]
