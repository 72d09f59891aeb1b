"""Plain implementation of the EKF2 model, one prediction at a time: reference for the fast one."""

import numpy as np

from px4fuse.ekf2.filter_batch import FilterConfiguration
from px4fuse.ekf2.inputs import FusionRules, ReplayInputs
from px4fuse.ekf2.intervals import EventIntervals, FusionEvents, make_event_intervals
from px4fuse.ekf2.model import Ekf2Model, prepare_ekf2_model
from px4fuse.ekf2.replay_segments import GRAVITY_M_S2, ReplaySegment
from px4fuse.ekf2.steps import DifferenceExplanation, explain_difference_by_replacements
from px4fuse.filter.kalman import run_kf
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import Segment, make_axes
from px4fuse.flight.model import Flight, Unavailable
from px4fuse.trajectory.rotation import skew

EYE = np.eye(15)
# Properties of KF in the order in which EKF2's replace them, without additional aiding sources
REPLACED_PROPERTIES = (
    "sample times and time steps", "timestamps and delay", "measurement noise",
    "accelerometer bias state", "process noise", "attitude and gyro bias states",
    "rejections and resets", "output predictor",
)  # fmt: skip
# rules of v1.16
RULES = FusionRules(0.2, 0.4, 1.0, 5, None, False)


def opened(flight: Flight) -> Ekf2Model:
    found = prepare_ekf2_model(flight)
    assert isinstance(found, Ekf2Model), found
    return found


def explained(model: Ekf2Model) -> dict[str, DifferenceExplanation] | Unavailable:
    """Explain the difference between EKF2 and KF with the same position source."""
    source = model.inputs.received_positions.source
    track = next(track for track in model.flight.positions if track.name == source)
    segment = Segment(0.0, model.flight.log.duration_s, "")
    axes = make_axes(model.flight, track, segment, names=("north", "east"))
    kf_runs = {axis.name: run_kf(axis, Settings(), fast=True) for axis in axes}
    return explain_difference_by_replacements(model, Settings(), kf_runs)


def intervals_of(model: Ekf2Model) -> EventIntervals:
    """Return the intervals of the first segment with the logged parameters."""
    inputs = model.inputs
    delays = FilterConfiguration(inputs.settings).compute_delays(inputs)
    return make_event_intervals(inputs, inputs.segments[0], delays)


def step_matrix(segment: ReplaySegment, k: int, *, trapezoid: bool = True) -> np.ndarray:
    """Return ∂(state after step k) / ∂(state before); PX4's covariance has no trapezoid."""
    dt, after = segment.step_s[k], segment.body_to_ned[k + 1]
    F = EYE.copy()
    F[0:3, 9:12] = -after * dt
    F[3:6, 0:3] = -skew(after @ segment.specific_force_m_s2[k]) * dt
    F[3:6, 12:15] = -after * dt
    F[6:9, 3:6] = np.eye(3) * dt
    if trapezoid:  # mean of the velocities before and after
        F[6:9] = EYE[6:9] + 0.5 * dt * (EYE[3:6] + F[3:6])
    return F


def step_noise(segment: ReplaySegment, k: int, gyro: float, force: float) -> np.ndarray:
    return np.diag(np.repeat([gyro**2, force**2, 0.0, 0.0, 0.0], 3) * segment.step_s[k] ** 2)


def step_state(segment: ReplaySegment, k: int, x: np.ndarray) -> np.ndarray:
    """Predict the state by one step, directly from the equations."""
    dt, after = segment.step_s[k], segment.body_to_ned[k + 1]
    force = after @ segment.specific_force_m_s2[k]
    x = x.copy()
    velocity = x[3:6].copy()
    x[3:6] += (force + GRAVITY_M_S2 - skew(force) @ x[0:3] - after @ x[12:15]) * dt
    x[6:9] += 0.5 * dt * (velocity + x[3:6])
    x[0:3] += -after @ x[9:12] * dt - segment.attitude_correction_rad[k]
    return x


def plain_replay(
    inputs: ReplayInputs, segment: ReplaySegment, events: FusionEvents
) -> tuple[np.ndarray, np.ndarray]:
    """Return innovations and variances of a flight as flown, without rejections.

    Covariance and state are predicted in each step; every measurement is fused separately.
    """
    settings = inputs.settings
    gyro, force = settings["EKF2_GYR_NOISE"], settings["EKF2_ACC_NOISE"]
    drift = np.zeros(15)
    drift[9:12] = settings["EKF2_GYR_B_NOISE"] ** 2
    drift[12:15] = settings["EKF2_ACC_B_NOISE"] ** 2
    deviation = np.sqrt(segment.variance)
    P = deviation[:, None] * segment.initial_state_correlation * deviation
    x, k = segment.state.copy(), 0
    R = settings["EKF2_EVP_NOISE"] ** 2
    innovations, variances = [], []

    def fuse(i: int, nu: float, noise: float) -> None:
        nonlocal x, P
        K = P[:, i] / (P[i, i] + noise)
        x = x + K * nu
        P = P - np.outer(K, P[i])

    for end, sample, action in zip(events.end_step, events.sample, events.action, strict=True):
        while k < end:
            F = step_matrix(segment, k, trapezoid=False)
            x = step_state(segment, k, x)
            P = F @ P @ F.T + step_noise(segment, k, gyro, force)
            P += np.diag(drift * inputs.mean_step_s**2)
            k += 1
        position = inputs.received_positions.position_m[sample]
        if action:
            innovations.append(position[:2] - x[6:8])
            variances.append([P[6, 6] + R, P[7, 7] + R])
        for i, value, target in (
            (2, segment.attitude_error_rad[end, 2], segment.attitude_variance_rad2[end, 2]),
            (8, segment.down_m[end], segment.down_variance_m2[end]),
        ):
            if P[i, i] > target:
                fuse(i, value - x[i], P[i, i] * target / (P[i, i] - target))
        if action:
            for i in (6, 7):
                fuse(i, position[i - 6] - x[i], R)
        x[2] = segment.attitude_error_rad[end, 2]
    return np.array(innovations), np.array(variances)
