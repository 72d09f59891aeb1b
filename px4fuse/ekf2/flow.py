"""Fusion of optical flow in the EKF2 replay, as horizontal velocity in the body frame.

The logged velocity is low-pass filtered. The replay computes and fuses the mean velocity between
two logged samples.

Sources: PX4-Autopilot ``EKF/aid_sources/optical_flow`` (``optical_flow_control.cpp``: velocity and
low-pass filter; ``optical_flow_fusion.cpp``: R and gate).
"""

from dataclasses import replace

import numpy as np
import pandas as pd

from px4fuse.ekf2.replay_segments import (
    VELOCITY,
    ReplaySegment,
    SensorSamples,
    compute_low_pass_weights,
)
from px4fuse.flight.model import FLOW_FILTER_NEW_SAMPLE_WEIGHT


def add_flow_samples(segment: ReplaySegment, flow: pd.DataFrame, gate: float) -> ReplaySegment:
    """Add the logged optical flow to a part of the flight.

    ``gate`` is the innovation gate (√S).
    """
    begin_s = flow.index - (flow["samples"] - 1.0) * flow["interval_s"]
    flow = flow[(begin_s > segment.time_s[0]) & (flow.index <= segment.time_s[-1])]
    sample_count = flow["samples"].to_numpy()
    interval_s = flow["interval_s"].to_numpy()
    step_index, weight = compute_low_pass_weights(
        segment, flow.index.to_numpy(), sample_count, interval_s, FLOW_FILTER_NEW_SAMPLE_WEIGHT
    )
    ned_to_body_rotation = segment.body_to_ned[step_index].swapaxes(2, 3)[:, :, :2]
    imu_velocity_m_s = np.einsum(
        "ki,kiab,kib->ka", weight, ned_to_body_rotation, segment.imu_velocity_change_m_s[step_index]
    )
    sensor_samples = SensorSamples(
        step_index[:, 0],
        flow[["forward_m_s", "right_m_s"]].to_numpy() - imu_velocity_m_s,
        np.einsum("ki,kiab->kab", weight, ned_to_body_rotation),
        sample_count,
        flow["noise_m2_s2"].to_numpy(),
        gate,
        (VELOCITY,),
    )
    return replace(segment, flow=sensor_samples)
