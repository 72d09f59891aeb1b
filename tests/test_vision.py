"""External vision in addition to GNSS in the EKF2 model.

References are a plain EKF that fuses both one after the other at their own steps, and the scalar
equations of PX4's bias estimator.
"""

import json
from dataclasses import dataclass
from functools import cache
from typing import Any

import jsonschema
import numpy as np
import pandas as pd
import pytest
from comparisons import compare
from ekf2_tools import explained, opened, step_matrix, step_noise, step_state
from exchange import replace

from px4fuse.diagnose import diagnose_comparison, run_what_if
from px4fuse.ekf2 import steps
from px4fuse.ekf2.filter_batch import FilterConfiguration
from px4fuse.ekf2.filter_recursion import SegmentRun, run_segment
from px4fuse.ekf2.inputs import ReceivedPositions, ReplayInputs
from px4fuse.ekf2.intervals import FusionEvents, make_event_intervals
from px4fuse.ekf2.model import (
    Ekf2Model,
    list_modelled_aids,
    prepare_ekf2_model,
    replay_with_settings,
    run_configurations,
)
from px4fuse.ekf2.replay_segments import ReplaySegment
from px4fuse.ekf2.vision import MAX_SAMPLE_GAP_S
from px4fuse.ekf2.whatif import what_if
from px4fuse.errors import SettingsError
from px4fuse.filter.settings import Settings
from px4fuse.findings import find
from px4fuse.flight.model import (
    AS_RECEIVED_ORIGIN,
    AidLog,
    Columns,
    Flight,
    PositionTrack,
    Unavailable,
)
from px4fuse.report.difference_page import format_replay_agreement
from px4fuse.report.whatif import list_statistics
from px4fuse.request import WhatIfRequest
from px4fuse.results.build import make_whatif_results
from px4fuse.results.contract import schema, to_json
from px4fuse.simulation import ekf2 as simulated
from px4fuse.simulation.faults import parse_faults
from px4fuse.simulation.flights import simulate_flight
from px4fuse.simulation.scenario import make_scenario

OUTDOOR = make_scenario("outdoor", seed=3, passes=2)
OF_VISION = {
    "EKF2_EV_CTRL": 1.0, "EKF2_EVP_NOISE": 0.1, "EKF2_EVP_GATE": 5.0, "EKF2_EV_DELAY": 0.0,
    "EKF2_EV_NOISE_MD": 0.0, "EKF2_EV_POS_X": 0.0, "EKF2_EV_POS_Y": 0.0, "EKF2_EV_POS_Z": 0.0,
}  # fmt: skip
SETTINGS = {name: value for name, value in OF_VISION.items() if name != "EKF2_EV_CTRL"}
FRAME_M = np.array([5.0, -3.0, 0.0])  # origin of the vision frame


@cache
def on_gnss() -> Ekf2Model:
    return opened(simulate_flight(OUTDOOR, parse_faults(())))


def sent(
    rate_hz: float = 15.0, sigma_m: float = 0.3, late_s: float = 0.0, seed: int = 1
) -> ReceivedPositions:
    """Return vision positions: ground truth in an offset frame, plus a random walk."""
    truth = on_gnss().flight.truth
    rng = np.random.default_rng(seed)
    stamp = np.arange(1.0, truth.samples.index[-1] - 1.0, 1.0 / rate_hz)
    position = np.column_stack([
        np.interp(stamp, truth.samples.index, truth.samples[name]) for name in Columns.POSITION
    ])  # fmt: skip
    wander = np.cumsum(rng.normal(0.0, 0.01 / np.sqrt(rate_hz), position.shape), axis=0)
    position = position + FRAME_M + wander + rng.normal(0.0, sigma_m, position.shape)
    count = len(stamp)
    return ReceivedPositions(
        stamp + late_s, np.full(count, -np.inf), position, np.full((count, 3), 0.01),
        np.full(count, np.nan), np.zeros(count, bool), "vehicle_visual_odometry",
    )  # fmt: skip


# ------------------------------------------------------------------ plain filter


@dataclass
class PlainBias:
    """One axis of PositionBiasEstimator (bias_estimator.cpp), step by step."""

    bias: float
    variance: float
    most: float
    signed: float = 0.0

    def predict(self, dt: float) -> None:
        boost = 1e3 if abs(self.signed) > 0.2 else 1.0
        self.variance = min(max(self.variance + boost * 0.13**2 * dt, 1e-8), self.most)

    def fuse(self, measured: float, variance: float, dt: float) -> None:
        S = self.variance + max(0.01**2, variance)
        nu, K = measured - self.bias, self.variance / S
        ratio = nu * nu / (9.0 * S)
        if ratio < 1.0:
            self.bias += K * nu
            self.variance = min(max(self.variance - K * self.variance, 1e-8), self.most)
        signed = min(max(np.sign(nu) * ratio, -1.0), 1.0)
        self.signed += dt / (10.0 + dt) * (signed - self.signed)


def run_reference_ekf(  # noqa: PLR0915 (one filter, read from top to bottom)
    inputs: ReplayInputs, segment: ReplaySegment, events: FusionEvents
) -> tuple[np.ndarray, np.ndarray]:
    """Run a plain EKF: one prediction at a time, each fix and each vision sample at its step.

    All axes are fused with the initial innovation and S (fuseDirectStateMeasurement). Returns a row
    per fix, and a row per vision sample.
    """
    settings, received, vision = inputs.settings, inputs.received_positions, inputs.vision_positions
    assert vision is not None
    assert received.velocity_m_s is not None
    assert received.velocity_variance_m2_s2 is not None
    drift = np.zeros(15)
    drift[9:12] = settings["EKF2_GYR_B_NOISE"] ** 2
    drift[12:15] = settings["EKF2_ACC_B_NOISE"] ** 2
    noises = settings["EKF2_GYR_NOISE"], settings["EKF2_ACC_NOISE"]
    deviation = np.sqrt(segment.variance)
    x, P = segment.state.copy(), deviation[:, None] * segment.initial_state_correlation * deviation
    measured_at_s = vision.timestamp_s - 1e-3 * settings["EKF2_EV_DELAY"] - 0.5 * inputs.mean_step_s
    steps = np.searchsorted(segment.time_s, measured_at_s - 1e-9).tolist()
    has_sample = {step: row for row, step in enumerate(steps) if step > 0}
    at = {int(event.end_step): event for event in events}
    gps2, fixes, update_records = settings["EKF2_GPS_P_NOISE"] ** 2, [], []
    biases: list[PlainBias] = []

    def fuse(i: int, nu: float, S: float, R: float) -> None:
        nonlocal x, P
        K = P[:, i] / S
        x = x + K * nu
        A = np.eye(15)
        A[:, i] -= K
        P = A @ P @ A.T + np.outer(K, K) * R

    for k in range(1, int(events.end_step[-1]) + 1):
        F, x = step_matrix(segment, k - 1, trapezoid=False), step_state(segment, k - 1, x)
        P = F @ P @ F.T + step_noise(segment, k - 1, *noises)
        P += np.diag(drift * inputs.mean_step_s**2)
        for bias in biases:
            bias.predict(inputs.mean_step_s)
        event = at.get(k)
        if event is not None and event.action:
            row = event.sample
            speed = np.maximum(received.velocity_variance_m2_s2[row],
                               settings["EKF2_GPS_V_NOISE"] ** 2)  # fmt: skip
            R = np.concatenate([speed * [1.0, 1.0, 2.25],
                                np.maximum(received.variance_m2[row, :2], gps2)])  # fmt: skip
            nu = np.concatenate([received.velocity_m_s[row], received.position_m[row, :2]])
            nu, S = nu - x[3:8], np.diag(P)[3:8] + R
            fixes.append(np.concatenate([nu, S]))
            for j in range(5):
                fuse(3 + j, nu[j], S[j], R[j])
        if event is not None:
            x[2] = segment.attitude_error_rad[k, 2]
        if k not in has_sample:
            continue
        position, off = (
            vision.position_m[has_sample[k], :2],
            vision.position_m[has_sample[k], :2] - x[6:8],
        )
        R0 = max(vision.variance_m2[has_sample[k], 0], settings["EKF2_EVP_NOISE"] ** 2, gps2)
        if not biases:
            biases = [PlainBias(float(value), 0.5 * R0, R0) for value in off]
            continue
        nu = position - [bias.bias for bias in biases] - x[6:8]
        R = np.array([R0 + bias.variance for bias in biases])
        S = np.diag(P)[6:8] + R
        update_records.append(np.concatenate([[measured_at_s[has_sample[k]]], nu, S]))
        for j, bias in enumerate(biases):
            bias.fuse(float(off[j]), R0 + P[6 + j, 6 + j], inputs.mean_step_s)
        if np.all(nu**2 <= settings["EKF2_EVP_GATE"] ** 2 * S):
            for j in range(2):
                fuse(6 + j, nu[j], S[j], R[j])
    return np.array(fixes), np.array(update_records)


def flying(
    vision: ReceivedPositions | None, seconds: float = 40.0, **settings: float
) -> ReplayInputs:
    """Return the start of the flight, with only GNSS and vision correcting tilt and height."""
    inputs = on_gnss().inputs
    (whole,) = inputs.segments
    count = int(np.searchsorted(whole.time_s, whole.time_s[0] + seconds))
    unknown = np.full((count, 3), np.inf)
    segment = replace(
        whole, time_s=whole.time_s[:count], step_s=whole.step_s[: count - 1],
        body_to_ned=whole.body_to_ned[:count],
        attitude_correction_rad=whole.attitude_correction_rad[: count - 1],
        specific_force_m_s2=whole.specific_force_m_s2[: count - 1], down_m=whole.down_m[:count],
        magnetic_field=None, height_samples=None,
        state=whole.state[:15], variance=whole.variance[:15],
        clipped_fraction=None, is_acceleration_bad=None,
        initial_state_correlation=np.eye(15), attitude_variance_rad2=unknown,
        down_variance_m2=unknown[:, 0],
        attitude_error_rad=whole.attitude_error_rad[:count],
    )  # fmt: skip
    known = {**inputs.settings, **SETTINGS, **settings}
    return replace(inputs, segments=(segment,), vision_positions=vision, settings=known)


def ran(inputs: ReplayInputs, *configurations: FilterConfiguration) -> SegmentRun:
    (segment,) = inputs.segments
    configurations = configurations or (FilterConfiguration(inputs.settings),)
    made = [
        make_event_intervals(inputs, segment, one.compute_delays(inputs)) for one in configurations
    ]
    return run_segment(inputs, segment, configurations, made)


def update_records(done: SegmentRun, at: int = 0) -> pd.DataFrame:
    assert done.vision_filter is not None
    return done.vision_filter.make_update_table(at, done.segment.time_s[done.events[at].end_step])


@pytest.mark.parametrize(("rate_hz", "late_s", "settings"), [
    (30.0, 0.0, {}), (12.0, 0.1, {"EKF2_EV_DELAY": 100.0}), (30.0, 0.0, {"EKF2_EVP_NOISE": 0.8}),
])  # fmt: skip
def test_ekf2_replay_of_vision_and_gnss_equals_kalman_filter(
    rate_hz: float, late_s: float, settings: dict[str, float]
) -> None:
    inputs = flying(sent(rate_hz, late_s=late_s), **settings)
    done, alone = ran(inputs), ran(replace(inputs, vision_positions=None))
    events = done.events[0]
    fixes, rows = run_reference_ekf(inputs, done.segment, events)
    used = events.action > 0
    nu, S = done.innovation[used, 0, :5], done.innovation_variance[used, 0, :5]
    late = slice(30, None)  # after the transient of the bias
    difference = np.sqrt(np.mean((nu - fixes[:, :5])[late] ** 2, axis=0))
    without = np.sqrt(np.mean((alone.innovation[used, 0, :5] - fixes[:, :5])[late] ** 2, axis=0))
    assert difference.max() < 0.006
    assert np.all(without[3:] > 8.0 * difference[3:])
    np.testing.assert_allclose(S[10:], fixes[10:, 5:], rtol=2e-3)
    found = update_records(done)
    found = found.loc[rows[0, 0] + 3.0 :]
    rows = rows[np.searchsorted(rows[:, 0], found.index - 1e-6)]
    assert len(found) > 20.0 * rate_hz
    np.testing.assert_allclose(found.index, rows[:, 0], atol=1e-9)
    np.testing.assert_allclose(found.iloc[:, :2], rows[:, 1:3], atol=0.02)
    assert np.sqrt(np.mean((found.iloc[:, :2] - rows[:, 1:3]) ** 2)) < 0.004
    np.testing.assert_allclose(found.iloc[:, 2:4], rows[:, 3:5], rtol=3e-3)
    assert found["fused"].all()


def test_vision_noise_is_at_least_gnss_noise_while_gnss_is_fused() -> None:
    """R is the largest of EKF2_EVP_NOISE, EKF2_GPS_P_NOISE and the reported variance."""
    inputs = flying(sent(), EKF2_GPS_P_NOISE=0.5)
    noises = ({**inputs.settings, "EKF2_EVP_NOISE": noise_m} for noise_m in (0.01, 0.5, 0.7))
    alone = FilterConfiguration(inputs.settings, disable_time_s_by_aid={"gnss_pos": 0.0})
    done = ran(inputs, *map(FilterConfiguration, noises), alone)
    assert done.vision_filter is not None
    noise = np.sqrt(
        np.unique(
            done.vision_filter.R_m2[done.vision_filter.has_sample[0]].round(9),
            axis=0,
        )
    )
    assert sorted({*noise[:, 0].round(6)}) == [0.1, 0.5, 0.7]
    pd.testing.assert_frame_equal(update_records(done, 0), update_records(done, 1))
    assert np.abs(update_records(done, 2) - update_records(done, 1)).max(axis=None) > 0.01


def test_vision_lever_arm_is_subtracted_in_replay() -> None:
    """EKF2_EV_POS is in the body frame, rotated by the attitude at each sample."""
    inputs, vision, lever_arm_m = flying(sent()), sent(), np.array([1.5, -0.5, 0.8])
    (segment,) = inputs.segments
    step = np.searchsorted(segment.time_s, vision.timestamp_s - 0.5 * inputs.mean_step_s - 1e-9)
    turn = segment.body_to_ned[np.minimum(step, len(segment.body_to_ned) - 1)]
    beside = replace(vision, position_m=vision.position_m + turn @ lever_arm_m)
    settings = {
        f"EKF2_EV_POS_{axis}": value for axis, value in zip("XYZ", lever_arm_m, strict=True)
    }
    pd.testing.assert_frame_equal(
        update_records(ran(flying(beside, **settings))), update_records(ran(inputs))
    )


def test_vision_position_bias_estimates_frame_offset() -> None:
    done = ran(flying(sent(sigma_m=0.05)))
    assert done.vision_filter is not None
    np.testing.assert_allclose(-done.vision_filter.bias.bias_m[0], FRAME_M[:2], atol=0.5)
    truth = on_gnss().flight.truth
    end_s = float(done.segment.time_s[done.events[0].end_step[-1]])
    for axis in (0, 1):
        name = Columns.POSITION[axis]
        true = np.interp(end_s, truth.samples.index, truth.samples[name])
        assert done.state[-1, 0, 6 + axis] == pytest.approx(true, abs=0.5)


def test_ekf2_rejects_vision_jump_until_position_bias_is_reset() -> None:
    vision = sent(sigma_m=0.05)
    at_s = float(on_gnss().inputs.segments[0].time_s[0]) + 20.0
    jumped = replace(
        vision, position_m=vision.position_m + 20.0 * (vision.timestamp_s > at_s)[:, None]
    )
    smooth, done = ran(flying(vision)), ran(flying(jumped))
    found = update_records(done)
    rejected = found.index[found["rejected"] > 0.0]
    assert rejected[0] == pytest.approx(at_s, abs=0.05)
    assert rejected[-1] - rejected[0] == pytest.approx(1.0, abs=0.1)
    assert found.loc[rejected[-1] + 0.01 :, "fused"].all()
    assert not found["reset"].any()
    assert not done.position_reset_m.any()
    difference = done.state[-1, 0, 6:8] - smooth.state[-1, 0, 6:8]
    assert np.abs(difference).max() < 0.05
    without_gate = ran(flying(jumped), FilterConfiguration(flying(jumped).settings, has_gate=False))
    assert not update_records(without_gate)["rejected"].any()


def test_ekf2_vision_position_bias_is_reset_after_vision_gap() -> None:
    vision = sent(sigma_m=0.05)
    at_s = float(on_gnss().inputs.segments[0].time_s[0]) + 20.0
    for gap_s, anew in ((0.9 * MAX_SAMPLE_GAP_S, False), (1.5 * MAX_SAMPLE_GAP_S, True)):
        remaining = (vision.timestamp_s < at_s) | (vision.timestamp_s > at_s + gap_s)
        moved = vision.position_m + 20.0 * (vision.timestamp_s > at_s)[:, None]
        fields = ("timestamp_s", "arrival_s", "variance_m2", "rejected_flags", "is_reset_to_sample")
        parts = {name: getattr(vision, name)[remaining] for name in fields}
        found = update_records(ran(flying(replace(vision, position_m=moved[remaining], **parts))))
        after = found.loc[at_s + gap_s :]
        assert bool(after["rejected"].any()) is not anew


def test_loss_of_gnss_resets_position_to_vision() -> None:
    """Reset without bias, with the noise of vision (ev_pos_control.cpp)."""
    inputs = flying(sent(sigma_m=0.05))
    lost_s = float(inputs.segments[0].time_s[0]) + 20.0
    lost = dict.fromkeys(("gnss_pos", "gnss_vel"), lost_s)
    done = ran(
        inputs,
        FilterConfiguration(inputs.settings),
        FilterConfiguration(inputs.settings, disable_time_s_by_aid=lost),
    )
    found, flown = update_records(done, 1), update_records(done, 0)
    assert not flown["reset"].any()
    (reset_s,) = found.index[found["reset"] > 0.0]
    assert reset_s == pytest.approx(lost_s, abs=0.3)
    moved = done.position_reset_m[:, 1]
    np.testing.assert_allclose(moved.sum(axis=0), FRAME_M[:2], atol=0.6)
    assert done.vision_filter is not None
    np.testing.assert_array_equal(done.vision_filter.bias.bias_m[1], 0.0)
    difference = done.state[-1, 1, 6:8] - done.state[-1, 0, 6:8]
    np.testing.assert_allclose(difference, FRAME_M[:2], atol=0.6)
    after = found.loc[reset_s + 1.0 :]
    # σ is 0.1 m in EKF2_EVP_NOISE and in the reported variance
    assert 0.01 < after["innovation_variance_north_m2"].median() < 0.02
    assert after["fused"].all()


def test_vision_position_bias_changes_with_gnss_position_reset() -> None:
    """Position and bias move together (resetHorizontalPositionTo): vision is fused as before."""
    inputs = flying(sent(sigma_m=0.05))
    for resets_velocity in (False, True):
        rules = replace(inputs.rules, resets_velocity=resets_velocity)
        done = ran(
            replace(
                inputs,
                rules=rules,
                received_positions=add_position_jump(inputs.received_positions, 30.0),
            )
        )
        # up to v1.16 any fused position, also from vision, prevents a reset to GNSS
        assert int(done.reset.sum()) == (not resets_velocity)
        assert done.position_reset_m.sum() == pytest.approx(
            0.0 if resets_velocity else 30.0, abs=3.0
        )
        assert update_records(done)["fused"].mean() > 0.999


def add_position_jump(received: ReceivedPositions, north_m: float) -> ReceivedPositions:
    """Return the positions with an offset from 15 s on."""
    start_s = float(on_gnss().inputs.segments[0].time_s[0])
    far = (received.timestamp_s > start_s + 15.0)[:, None] * np.array([north_m, 0.0, 0.0])
    return replace(received, position_m=received.position_m + far)


def test_ekf2_resets_to_vision_if_gnss_and_vision_are_rejected() -> None:
    inputs = flying(add_position_jump(sent(sigma_m=0.05), 20.0), seconds=20.0)
    done = ran(
        replace(inputs, received_positions=add_position_jump(inputs.received_positions, 40.0))
    )
    found = update_records(done)
    (reset_s,) = found.index[found["reset"] > 0.0]
    assert reset_s == pytest.approx(float(done.segment.time_s[0]) + 16.0, abs=0.2)
    np.testing.assert_allclose(done.position_reset_m.sum(axis=(0, 1)), [20.0, 0.0], atol=0.7)
    assert found.loc[reset_s + 0.1 :, "fused"].all()
    assert done.vision_filter is not None
    np.testing.assert_allclose(-done.vision_filter.bias.bias_m[0], FRAME_M[:2], atol=0.7)


def test_larger_vision_delay_extends_the_fusion_horizon() -> None:
    inputs = flying(sent())
    settings = inputs.settings
    flown = FilterConfiguration(settings).compute_delays(inputs)
    later = FilterConfiguration({**settings, "EKF2_EV_DELAY": 290.0}).compute_delays(inputs)
    assert later.delay_s == flown.delay_s == pytest.approx(1e-3 * settings["EKF2_GPS_DELAY"])
    assert later.horizon_s == pytest.approx(28 * inputs.mean_step_s)
    assert flown.horizon_s == inputs.horizon_s < later.horizon_s


def test_second_vision_sample_in_one_step_is_dropped() -> None:
    vision = sent(rate_hz=25.0)
    doubled = {
        name: np.repeat(getattr(vision, name), 2, axis=0)
        for name in (
            "arrival_s",
            "position_m",
            "variance_m2",
            "rejected_flags",
            "is_reset_to_sample",
        )
    }
    stamps = np.repeat(vision.timestamp_s, 2)
    stamps[::2] -= 0.0005
    once, twice = (update_records(ran(flying(one))) for one in (
        vision, replace(vision, timestamp_s=stamps, **doubled)))  # fmt: skip
    assert len(once) <= len(twice) <= 1.1 * len(once)
    horizon_s = flying(vision).horizon_s
    for age_s, remaining in ((horizon_s + 0.05, True), (horizon_s + 0.15, False)):
        late = replace(vision, arrival_s=vision.timestamp_s + age_s)
        assert bool(len(update_records(ran(flying(late))))) is remaining


# ------------------------------------------------------------- a flight with both


@cache
def flown(
    wrong_m: float = 0.0, flipped: bool = False, off_from_s: float = np.inf, **changed: float
) -> Flight:
    """Simulate a flight whose EKF2 model fuses both; two innovations per second are logged.

    ``wrong_m``: noise that EKF2 received and the log does not contain; ``flipped``: vision with the
    opposite sign in EKF2; ``off_from_s``: EKF2 does not fuse vision from then on.
    """
    vision, runs = sent(), []
    usual, usual_run = simulated.make_parameters, run_configurations
    noise = np.random.default_rng(9).normal(0.0, 1.0, vision.position_m.shape)
    heard = replace(vision, position_m=(-1.0 if flipped else 1.0) * vision.position_m
                    + wrong_m * noise)  # fmt: skip

    def both(inputs: ReplayInputs, configurations: list[FilterConfiguration]) -> list[SegmentRun]:
        settings = {**inputs.settings, **SETTINGS, **changed}
        given = replace(inputs, vision_positions=heard, settings=settings)
        runs.extend(
            usual_run(
                given,
                [FilterConfiguration(settings, disable_time_s_by_aid={"ev_pos": off_from_s})],
            )
        )
        return runs

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulated, "make_parameters", lambda *of: usual(*of) | OF_VISION | changed)
        patch.setattr(simulated, "run_configurations", both)
        flight = simulate_flight(OUTDOOR, parse_faults(()))
    updates = update_records(runs[0])
    enabled = pd.Series([1.0, 0.0], index=[0.0, off_from_s])
    samples = pd.DataFrame({
        "innovation_north": updates["innovation_north_m"],
        "innovation_east": updates["innovation_east_m"],
        "variance_north": updates["innovation_variance_north_m2"],
        "variance_east": updates["innovation_variance_east_m2"],
        "noise_north": 0.25, "noise_east": 0.25, "fused": updates["fused"],
        "rejected": updates["rejected"],
    }).iloc[::7]  # fmt: skip
    log = AidLog(
        ("estimator_aid_src_ev_pos",), ("north", "east"), samples, enabled, {**OF_VISION, **changed}
    )
    rows = pd.DataFrame(np.hstack([vision.position_m, vision.variance_m2]), vision.timestamp_s,
                        [*Columns.POSITION, *Columns.POSITION_VARIANCE])  # fmt: skip
    track = PositionTrack(
        vision.source, AS_RECEIVED_ORIGIN, "external vision", rows, "NED", "boot", (vision.source,)
    )
    ekf2 = replace(flight.ekf2, aids={**flight.ekf2.aids, "ev_pos": log})
    return replace(flight, positions=(track, *flight.positions), ekf2=ekf2)


@cache
def model() -> Ekf2Model:
    return opened(flown())


def test_ekf2_replay_of_gnss_and_vision_agrees_with_log() -> None:
    agreement = model().agreement
    assert agreement.good
    assert agreement.doubtful == {}
    for axes in (agreement.ev_pos, agreement.gnss_pos, agreement.gnss_vel):
        assert {*axes} == {"north", "east"}
        for axis in axes.values():
            assert axis.innovation_correlation > 0.998
            assert 0.99 < axis.s_ratio_p5 < axis.s_ratio_p95 < 1.01
    assert list_modelled_aids(model().inputs)[:3] == ["gnss_pos", "gnss_vel", "ev_pos"]
    assert model().inputs.settings["EKF2_EVP_NOISE"] == pytest.approx(0.1)


def test_replay_with_other_vision_noise_equals_flight_with_it() -> None:
    other = opened(flown(EKF2_EVP_NOISE=1.0))
    for one, value, then in ((model(), 1.0, other), (other, 0.1, model())):
        found, true = what_if(one, [{"EKF2_EVP_NOISE": value}]), what_if(then, [])
        (predicted,), replayed = found.whatif, true.replayed
        of_vision = (one.others["ev_pos"].nis_mean for one in (predicted, replayed))
        assert next(of_vision) == pytest.approx(next(of_vision), rel=0.01)
        assert predicted.nis_mean == pytest.approx(replayed.nis_mean, rel=0.01)
    assert found.logged.others["ev_pos"].nis_mean < 0.5 * predicted.others["ev_pos"].nis_mean
    # R is then the noise of GNSS
    update_records = what_if(model(), [{"EKF2_EVP_NOISE": 0.2}])
    assert (
        "the noise of vision positions is at least EKF2_GPS_P_NOISE (0.4 m)"
        in update_records.notes[-1]
    )
    assert update_records.whatif[0].others == update_records.replayed.others


def test_ekf2_replay_with_smaller_vision_gate_rejects_more() -> None:
    request = WhatIfRequest(log="flight.ulg", changes={"EKF2_EVP_GATE": 1.0})
    made_of = run_what_if(request, flight=flown())
    found = made_of.statistics
    assert any("external vision, position: mean NIS" in line for line in list_statistics(made_of))
    results = json.loads(to_json(make_whatif_results(request, made_of)))
    jsonschema.validate(results, schema())
    assert results["replayed"]["others"]["ev_pos"]["rejected_fraction"] == 0.0
    assert found.replayed.others["ev_pos"].rejected_fraction == 0.0
    assert found.whatif[0].others["ev_pos"].rejected_fraction > 0.2


def test_ekf2_replay_without_gnss_uses_vision() -> None:
    without_vision = what_if(model(), [{}], {"ev_pos": 40.0})
    assert without_vision.whatif[0].others == {}
    lost = what_if(model(), [{}], dict.fromkeys(("gnss_pos", "gnss_vel"), 40.0))
    (after,) = lost.whatif
    assert after.resets == 1
    # vision frame: 5 m north and 3 m west of ground truth
    assert after.position_rmse_to_truth_m == pytest.approx(np.hypot(5.0, 3.0), abs=0.5)
    assert "EKF2_NOAID_TOUT" not in lost.notes[-1]
    none = what_if(model(), [{}], dict.fromkeys(("gnss_pos", "gnss_vel", "ev_pos"), 40.0))
    assert "EKF2_NOAID_TOUT" in none.notes[-1]
    with pytest.raises(
        SettingsError, match="replay of this log fuses only gnss_pos, gnss_vel, mag"
    ):
        what_if(on_gnss(), [{}], {"ev_pos": 40.0})


@pytest.mark.parametrize("wrong", [{"wrong_m": 1.0}, {"flipped": True}])
def test_ekf2_model_excludes_vision_if_replay_differs_from_log(wrong: dict[str, Any]) -> None:
    found = opened(flown(**wrong))
    assert "external vision" in format_replay_agreement(found.agreement)
    assert "ev_pos" in found.agreement.doubtful
    assert found.agreement.ev_pos["north"].innovation_correlation < 0.5
    # a replay with GNSS only differs from EKF2
    assert not found.agreement.good
    assert found.inputs.vision_positions is None
    assert "ev_pos" not in list_modelled_aids(found.inputs)
    # the message names the first of several parameters without effect
    change = {"EKF2_EVP_NOISE": 0.3, "EKF2_EVP_GATE": 5.0, "EKF2_EV_DELAY": 0.0}
    with pytest.raises(SettingsError, match="EKF2_EVP_NOISE has no effect in a replay of this log"):
        list(replay_with_settings(found, [change, {"EKF2_EV_POS_X": 0.1}]))


def test_ekf2_model_does_not_fuse_vision_while_disabled() -> None:
    found = opened(flown(off_from_s=60.0))
    assert found.inputs.vision_positions is not None
    update_records = np.isfinite(found.inputs.vision_positions.position_m[:, 0])
    assert found.inputs.vision_positions.timestamp_s[update_records][-1] == pytest.approx(
        60.0, abs=0.1
    )
    assert found.agreement.good
    assert found.agreement.doubtful == {}


def test_ekf2_model_without_logged_vision_topic_is_unavailable() -> None:
    flight = flown()
    gnss_alone = replace(flight, positions=flight.positions[1:])
    lacking = prepare_ekf2_model(gnss_alone)
    assert isinstance(lacking, Unavailable)
    assert "no topic vehicle_visual_odometry" in lacking.reason
    record = flight.ekf2.record
    remaining = {name: v for name, v in record.parameters.items() if name != "EKF2_EV_CTRL"}
    older = replace(record, parameters={**remaining, "EKF2_AID_MASK": 9.0})
    refused = prepare_ekf2_model(replace(flight, ekf2=replace(flight.ekf2, record=older)))
    assert isinstance(refused, Unavailable)
    assert "position increments of external vision" in refused.reason


def test_fused_vision_is_reported_as_part_of_kf_ekf2_difference() -> None:
    found = explained(model())
    for why in found.values():
        names = [step.name for step in why.steps]
        assert (
            names.index(steps.GNSS_VELOCITY_PROPERTY_NAME)
            < names.index(steps.VISION_PROPERTY_NAME)
            < names.index(steps.REJECTION_PROPERTY_NAME)
        )
        assert why.unexplained_fraction < 0.05
        moved_m = {step.name: step.position_moved_m for step in why.steps}
        assert (
            min(
                moved_m[steps.GNSS_VELOCITY_PROPERTY_NAME],
                moved_m[steps.VISION_PROPERTY_NAME],
            )
            > 0.05
        )
    analysis = diagnose_comparison(compare(flown(), Settings(0.27, 0.4)))
    # the noise of vision does not lead to a remedy for GNSS noise
    assert analysis.source.name == "vehicle_visual_odometry"
    assert {trial.filter for trial in analysis.reruns} == {"kf"}
    assert not [item for item in find(analysis) if "EKF2_GPS_P_NOISE" in item.remedy]
