"""Optical flow as EKF2 fuses it, told as the velocity of the body across the camera's axis.

The log has a low pass of it, and of that the mean of all samples between two rows. It is fused with
the next event: where the body moved from then on is known from the IMU. The range to the ground is
the log's own.

Sources: PX4-Autopilot ``EKF/aid_sources/optical_flow`` (``optical_flow_control.cpp``: velocities
and their low pass; ``optical_flow_fusion.cpp``: R and gate).
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pandas as pd

from px4fuse.arrays import Array, IntArray
from px4fuse.ekf2.magnetometer import CROSS, EYE, fuse_mean, mean_by_event
from px4fuse.ekf2.stretches import THETA, VELOCITY, Flow, Stretch
from px4fuse.flight import FLOW_SHARE


class FlowSamples(NamedTuple):
    """Means of flow by the event at which they are fused; shape (E, ...), or (E, S, ...).

    ``speed_m_s`` forward and to the right, ``turn`` the rotation from NED of the same two,
    ``number`` how many samples EKF2 had, and ``noise_m2_s2`` R of one.
    """

    speed_m_s: Array
    turn: Array
    number: Array
    noise_m2_s2: Array


def with_flow(stretch: Stretch, flow: pd.DataFrame, gate: float) -> Stretch:
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
    back = np.arange(int(count.max(initial=1.0)))
    weight = np.where(back < count[:, None], (1.0 - FLOW_SHARE) ** back, 0.0)
    weight /= weight.sum(axis=1, keepdims=True)
    taken_s = flow.index.to_numpy()[:, None] - back * interval_s[:, None]
    step = np.searchsorted(stretch.time_s, taken_s - 1e-9)
    turn = stretch.rotation[step].swapaxes(2, 3)[:, :, :2]
    gained = np.einsum("ki,kiab,kib->ka", weight, turn, stretch.gained_m_s[step])
    return replace(stretch, flow=Flow(
        step=step[:, 0], speed_m_s=flow[["forward_m_s", "right_m_s"]].to_numpy() - gained,
        turn=np.einsum("ki,kiab->kab", weight, turn), noise_m2_s2=flow["noise_m2_s2"].to_numpy(),
        samples=count, gate=gate,
    ))  # fmt: skip


def gather_flow(stretch: Stretch, flow: Flow, end: IntArray) -> FlowSamples:
    """Means by the event at which they are fused; ``end`` is the step of each event."""
    event = np.searchsorted(end, flow.step)
    inside = event < len(end)
    event, turn = event[inside], flow.turn[inside]
    since = np.einsum("kab,kb->ka", turn, stretch.gained_m_s[end[event]])
    rows = np.concatenate([flow.speed_m_s[inside] + since, turn.reshape(-1, 6),
                           flow.noise_m2_s2[inside, None]], axis=1)  # fmt: skip
    mean, _ = mean_by_event(event, rows, len(end))
    number = np.zeros(len(end))
    np.add.at(number, event, flow.samples[inside])
    return FlowSamples(mean[:, :2], mean[:, 2:8].reshape(-1, 2, 3), number, mean[:, 8])


def fuse_flow(x: Array, P: Array, told: FlowSamples, gate: float) -> tuple[Array, Array]:
    """State and covariance of S variants after the flow of one event."""
    speed = x[:, VELOCITY]
    of_speed, of_turn = ((each @ CROSS).reshape(-1, 3, 3) for each in (speed, x[:, THETA]))
    H = np.zeros((len(x), 2, x.shape[1]))
    H[:, :, THETA] = told.turn @ of_speed
    H[:, :, VELOCITY] = told.turn @ (EYE - of_turn)
    seen = (H[:, :, VELOCITY] @ speed[:, :, None])[:, :, 0]
    gates = np.full(len(x), gate)
    return fuse_mean(x, P, H, told.speed_m_s - seen, told.noise_m2_s2, told.number, gates)[:2]
