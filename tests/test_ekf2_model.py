"""The model of EKF2 against its equations written plainly, and against the log."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from ekf2_tools import plain_replay, step_matrix, step_noise, step_state
from exchange import replace
from findings_tools import made
from scipy.spatial.transform import Rotation

from px4fuse.ekf2 import model as model_module
from px4fuse.ekf2.inputs import Inputs, prepare
from px4fuse.ekf2.legs import FUSE, START, Legs, Timing, make_legs
from px4fuse.ekf2.model import (
    Model,
    delayed_states,
    open_model,
    replay_ekf2,
    replay_settings,
    run_variants,
)
from px4fuse.ekf2.recursion import Variant, run
from px4fuse.ekf2.replay import HORIZONTAL, Ekf2Replay
from px4fuse.ekf2.stretches import Stretch, step_ends
from px4fuse.errors import SettingsError
from px4fuse.flight import (
    POSITION_COLUMNS,
    QUATERNION_COLUMNS,
    Ekf2,
    Flight,
    FusionRecord,
    Unavailable,
)
from px4fuse.origin import RECEIVED
from px4fuse.alignment.joining import join
from px4fuse.readers import read_log


@pytest.fixture(scope="module")
def model(sample_flight: Flight) -> Model:
    made = open_model(sample_flight)
    assert isinstance(made, Model)
    return made


@pytest.fixture(scope="module")
def legs(model: Model) -> Legs:
    return model.legs[0]


def of(flight: Flight) -> tuple[Ekf2, FusionRecord]:
    assert isinstance(flight.ekf2, Ekf2)
    assert isinstance(flight.ekf2.record, FusionRecord)
    return flight.ekf2, flight.ekf2.record


def with_record(flight: Flight, **changes: object) -> Flight:
    ekf2, record = of(flight)
    return replace(flight, ekf2=replace(ekf2, record=replace(record, **changes)))


def with_vision(flight: Flight, samples: pd.DataFrame, **changes: object) -> Flight:
    tracks = [t for t in flight.positions if t.name != "vehicle_visual_odometry"]
    own = next(t for t in flight.positions if t.name == "vehicle_visual_odometry")
    return replace(flight, positions=(replace(own, samples=samples, **changes), *tracks))


def vision_of(flight: Flight) -> pd.DataFrame:
    return next(t for t in flight.positions if t.name == "vehicle_visual_odometry").samples


def opened(flight: Flight) -> Model:
    made = open_model(flight)
    assert isinstance(made, Model), made
    return made


def test_a_leg_is_the_product_of_its_steps(model: Model, legs: Legs) -> None:
    stretch = model.inputs.stretches[0]
    starts = np.concatenate([[0], legs.end[:-1]])
    gyro, force = (model.inputs.settings[f"EKF2_{name}_NOISE"] for name in ("GYR", "ACC"))
    noise = np.zeros_like(legs.transition)
    noise[:, :9, :9] = gyro**2 * legs.gyro_noise + force**2 * legs.accelerometer_noise
    for leg in (0, 1, 57, 300, len(legs.end) - 1):
        F, Q = np.eye(15), np.zeros((15, 15))
        x = x0 = np.random.default_rng(leg).normal(0.0, 0.01, 15)
        for k in range(starts[leg], legs.end[leg]):
            F = step_matrix(stretch, k) @ F
            old = step_matrix(stretch, k, trapezoid=False)
            Q = old @ Q @ old.T + step_noise(stretch, k, gyro, force)
            x = step_state(stretch, k, x)
        assert legs.transition[leg] == pytest.approx(F, abs=1e-12)
        moved = legs.transition[leg] @ x0 + legs.turn[leg] + legs.drive[leg]
        assert moved == pytest.approx(x, abs=1e-12)
        # closed forms for equal steps under a mean force, where the real ones jitter
        part = slice(0, 9)
        scale = np.sqrt(np.outer(np.diag(Q), np.diag(Q)))[part, part]
        assert np.max(np.abs(noise[leg] - Q)[part, part] / scale) < 0.03


@pytest.mark.parametrize("attitude", [True, False])
def test_within_a_leg_a_state_follows_from_its_beginning(model: Model, attitude: bool) -> None:
    """Without attitude as a state, the nominal one is not corrected either."""
    variant = Variant(model.inputs.settings, attitude=attitude)
    timing = variant.timing(model.inputs)
    (part,) = run_variants(model.inputs, [variant], {timing: model.legs})
    kept = np.random.default_rng(4).normal(0.0, 0.05, part.run.state.shape)
    part = replace(part, run=replace(part.run, state=kept))
    state, _ = delayed_states(part, 0)
    stretch, ends = part.stretch, part.events[0].end
    if not attitude:
        stretch = replace(stretch, correction_rad=np.zeros_like(stretch.correction_rad))
    np.testing.assert_array_equal(state[ends], kept[1:, 0])
    for leg in (0, 1, 57, 300, len(ends)):  # after the last event comes one more
        x = kept[leg, 0]
        first, last = np.concatenate([[0], ends, [len(stretch.step_s)]])[[leg, leg + 1]]
        for k in range(first, last - 1):
            x = step_state(stretch, k, x)
            np.testing.assert_allclose(state[k + 1], x, rtol=0.0, atol=1e-10)


def test_the_recursion_is_the_plain_filter(model: Model, legs: Legs) -> None:
    stretch = model.inputs.stretches[0]
    first = legs.end < 3000
    nu, S = plain_replay(
        model.inputs, stretch, legs.end[first], legs.sample[first], legs.action[first]
    )
    updates = model.flown.updates.iloc[: len(nu)]
    assert len(nu) > 100
    for at, axis in enumerate(HORIZONTAL):
        made = updates[f"innovation_{axis}_m"].to_numpy()
        assert made == pytest.approx(nu[:, at], abs=5e-4)
        variance = updates[f"innovation_variance_{axis}_m2"].to_numpy()
        assert variance == pytest.approx(S[:, at], rel=3e-3)


def test_the_sample_flight_agrees_with_its_log(model: Model) -> None:
    agreement = model.agreement
    assert agreement.good
    assert agreement.samples > 200
    assert agreement.rejected_share_logged == agreement.rejected_share_replayed == 0.0
    for axis in agreement.axes.values():
        assert axis.innovation_correlation > 0.999
        assert axis.innovation_rms_difference < 0.005
        assert axis.s_ratio_median == pytest.approx(1.0, abs=0.005)
        assert axis.s_ratio_p5 > 0.98
        assert axis.s_ratio_p95 < 1.02
        assert axis.position_rms_difference_m < 0.007
        assert axis.velocity_rms_difference_m_s < 0.010
        assert axis.nis_mean_replayed == pytest.approx(axis.nis_mean_logged, rel=0.02)


def test_several_settings_at_once_are_each_alone(model: Model) -> None:
    settings = [
        {"EKF2_EVP_NOISE": 0.02},
        {"EKF2_EV_DELAY": 80.0},
        {"EKF2_EVP_NOISE": 0.3, "EKF2_EV_DELAY": 40.0, "EKF2_EVP_GATE": 2.0},
        {},
    ]
    together = replay_settings(model, settings)
    for change, found in zip(settings, together, strict=True):
        alone = replay_settings(model, [change])[0]
        for part in ("updates", "delayed", "published"):
            pd.testing.assert_frame_equal(
                getattr(found, part), getattr(alone, part), rtol=0.0, atol=1e-9
            )
        assert dict(found.changed) == change
    pd.testing.assert_frame_equal(together[3].published, model.flown.published, rtol=0.0, atol=1e-9)


def test_replay_by_one_call(sample_flight: Flight, model: Model) -> None:
    plain = replay_ekf2(sample_flight)
    changed = replay_ekf2(sample_flight, {"EKF2_EVP_NOISE": 0.5})
    assert isinstance(plain, Ekf2Replay)
    assert isinstance(changed, Ekf2Replay)
    pd.testing.assert_frame_equal(plain.updates, model.flown.updates)
    assert changed.agreement == plain.agreement
    assert changed.settings["EKF2_EVP_NOISE"] == 0.5
    settled = changed.updates.iloc[100:]
    assert (settled["innovation_variance_north_m2"] > 0.25).all()
    with pytest.raises(SettingsError, match="EKF2_EVP_NOSE"):
        replay_ekf2(sample_flight, {"EKF2_EVP_NOSE": 0.5})


def test_outliers_are_rejected_together_and_reset_after_a_second(sample_flight: Flight) -> None:
    samples = vision_of(sample_flight).copy()
    moved = (samples.index > 60.0) & (samples.index < 63.0)
    samples.loc[moved, "north_m"] += 5.0  # north alone: east shares its fate
    updates = opened(with_vision(sample_flight, samples)).flown.updates
    part = updates.loc[59.5:64.5]
    before, after = updates.loc[40.0:59.5], updates.loc[68.0:80.0]
    assert not before["rejected"].any()
    assert not after["rejected"].any()
    resets = part.index[part["reset"] > 0]
    # five or six samples at 5 Hz until a second has passed, there and back again
    assert len(resets) == 2
    assert 61.0 < resets[0] < 61.5
    assert 63.7 < resets[1] < 64.5
    assert part.loc[60.0 : resets[0], "rejected"].iloc[1:].all()
    assert not part.loc[resets[0] : 62.9, "rejected"].iloc[1:].any()
    at = part.loc[resets[0]]
    assert at["position_variance_north_m2"] == pytest.approx(0.01, rel=1e-3)  # set to R


def test_a_wide_gate_takes_what_a_narrow_one_rejects(sample_flight: Flight) -> None:
    samples = vision_of(sample_flight).copy()
    samples.loc[(samples.index > 60.0) & (samples.index < 60.3), "east_m"] += 1.0
    made = opened(with_vision(sample_flight, samples))
    narrow, wide = replay_settings(made, [{"EKF2_EVP_GATE": 3.0}, {"EKF2_EVP_GATE": 50.0}])
    assert narrow.updates.loc[60.0:60.3, "rejected"].any()
    assert not wide.updates["rejected"].any()
    jump = wide.delayed["east_m"] - narrow.delayed["east_m"]
    assert jump.loc[60.0:61.0].max() > 0.1
    # published later than it happened, by the horizon, and pulled in with the time constants
    assert abs(jump.loc[75.0:80.0]).max() < 0.02


def test_vision_that_pauses_stops_fusion_until_two_samples_in_a_row(
    sample_flight: Flight,
) -> None:
    samples = vision_of(sample_flight)
    paused = samples[(samples.index < 60.0) | (samples.index > 61.0)]
    inputs = prepare(with_vision(sample_flight, paused))
    assert isinstance(inputs, Inputs)
    legs = make_legs(inputs, inputs.stretches[0], Timing(0.0, inputs.horizon_s))
    sampled = legs.sample >= 0
    action, time = legs.action[sampled], legs.time_s[sampled]
    started = np.flatnonzero(action == START)
    assert len(started) == 1
    gap = np.diff(time)[started[0] - 1]
    assert gap < 0.2  # the sample before it came less than 0.2 s before
    idle = (time > 61.0) & (time < time[started[0]])
    assert idle.any()
    assert not action[idle].any()
    assert (action[time < 60.0][1:] == FUSE).all()
    # up to v1.13 there is no such rule
    patient = replace(inputs.rules, start_interval_s=np.inf, stop_s=7.0)
    legs = make_legs(
        replace(inputs, rules=patient), inputs.stretches[0], Timing(0.0, inputs.horizon_s)
    )
    assert (legs.action[legs.sample >= 0][1:-3] == FUSE).all()


def test_a_long_pause_begins_a_stretch_of_its_own(sample_flight: Flight) -> None:
    samples = vision_of(sample_flight)
    made = opened(with_vision(sample_flight, samples[(samples.index < 60) | (samples.index > 65)]))
    assert len(made.flown.stretches_s) == 2
    assert made.flown.stretches_s[0][1] < 60.0
    assert made.flown.stretches_s[1][0] > 65.0
    assert made.agreement.good


def test_the_lever_arm_turns_with_the_body(model: Model, sample_flight: Flight) -> None:
    arm = np.array([0.3, -0.2, 0.1])
    change = {f"EKF2_EV_POS_{axis}": value for axis, value in zip("XYZ", arm, strict=True)}
    with_arm = replay_settings(model, [change])[0]
    # the same from samples that are moved by hand, at the attitude when each is fused
    legs, stretch = model.legs[0], model.inputs.stretches[0]
    sampled = legs.sample >= 0
    vision = model.inputs.vision
    position = vision.position_m.copy()
    position[legs.sample[sampled]] -= np.einsum(
        "nij,j->ni", stretch.rotation[legs.end[sampled]], arm
    )
    inputs = replace(model.inputs, vision=replace(vision, position_m=position))
    done = run(inputs, stretch, [legs], np.zeros(1, np.intp), [Variant(inputs.settings)])
    seen = np.isfinite(done.innovation_m[:, 0, 0])
    made = with_arm.updates[["innovation_north_m", "innovation_east_m"]].to_numpy()
    assert made == pytest.approx(done.innovation_m[seen, 0], abs=1e-12)
    assert np.abs(made - model.flown.updates.iloc[:, :2].to_numpy()).max() > 0.1


def test_reported_variances_count_unless_the_mode_says_not(sample_flight: Flight) -> None:
    samples = vision_of(sample_flight).copy()
    samples["north_m2"] = 0.25
    made = opened(with_vision(sample_flight, samples))
    theirs, ours = replay_settings(made, [{"EKF2_EV_NOISE_MD": 0.0}, {"EKF2_EV_NOISE_MD": 1.0}])
    assert (theirs.updates["observation_variance_north_m2"] == 0.25).all()
    assert ours.updates["observation_variance_north_m2"].to_numpy() == pytest.approx(0.01)
    assert theirs.updates["observation_variance_east_m2"].to_numpy() == pytest.approx(0.01)


def test_samples_that_arrive_after_the_horizon_are_late_or_lost(model: Model) -> None:
    vision = model.inputs.vision
    assert not model.flown.late
    assert not model.flown.lost
    slow = replace(vision, arrival_s=vision.stamp_s + 0.02)
    made = replace(model, inputs=replace(model.inputs, vision=slow))
    # they arrive 20 ms after their stamp; the horizon is 214 ms, and 100 ms more are forgiven
    in_time, late, lost = replay_settings(
        made, [{"EKF2_EV_DELAY": delay} for delay in (190.0, 260.0, 300.0)]
    )
    assert (in_time.late, in_time.lost) == (0, 0)
    assert late.late > 0.95 * len(late.updates)
    assert late.lost == 0
    assert lost.lost > 500
    assert lost.updates["fused"].sum() < 10
    more = replay_settings(made, [{"EKF2_EV_DELAY": 300.0, "EKF2_DELAY_MAX": 400.0}])[0]
    assert not more.late
    assert not more.lost


def test_prediction_steps_count_samples_and_obey_known_ends() -> None:
    even = np.full(30, 0.00375)
    assert step_ends(even, np.array([], int), 0.01).tolist() == list(range(3, 31, 3))
    # a known end that is out of step sets the count again
    assert step_ends(even, np.array([10]), 0.01).tolist()[:6] == [3, 6, 9, 10, 13, 16]
    # two samples that are longer than the target together are a step
    slow = even.copy()
    slow[4] = 0.0075
    assert step_ends(slow, np.array([], int), 0.01).tolist()[:4] == [3, 5, 8, 11]
    assert step_ends(np.full(10, 0.02), np.array([], int), 0.01).tolist() == list(range(1, 11))


def unavailable(flight: Flight) -> str:
    found = replay_ekf2(flight)
    assert isinstance(found, Unavailable)
    assert found.remedy.endswith(".")
    return found.reason


def test_a_log_that_cannot_carry_the_model_says_why(sample_flight: Flight) -> None:
    ekf2, _ = of(sample_flight)
    missing = Unavailable("IMU", "no topic sensor_combined", "Record it.")
    assert "sensor_combined" in unavailable(replace(sample_flight, imu=missing))
    assert "GPS" in unavailable(with_record(sample_flight, other_aiding=("GPS",)))
    bare = replace(ekf2, record=Unavailable("record", "no estimator_states", "Record it."))
    assert "estimator_states" in unavailable(replace(sample_flight, ekf2=bare))
    slow = sample_flight.imu.iloc[::5]
    assert "53 Hz" in unavailable(replace(sample_flight, imu=slow))
    copies = tuple(t for t in sample_flight.positions if t.origin != RECEIVED)
    assert "estimator_aid_src_ev_pos holds one sample in 0.5" in unavailable(
        replace(sample_flight, positions=copies)
    )
    dropped = sample_flight.imu[(sample_flight.imu.index % 8.0) > 0.1]
    assert "without a gap" in unavailable(replace(sample_flight, imu=dropped))
    frame = with_vision(sample_flight, vision_of(sample_flight), frame="FRD")
    assert "no orientation" in unavailable(frame)
    no_horizon = replace(ekf2, horizon_s=Unavailable("horizon", "not told", "Update PX4."))
    assert "not told" in unavailable(replace(sample_flight, ekf2=no_horizon))


def test_disagreement_is_said(sample_flight: Flight) -> None:
    ekf2, _ = of(sample_flight)
    other = {
        axis: frame.assign(innovation_variance_m2=frame["innovation_variance_m2"] * 0.8)
        for axis, frame in ekf2.innovations.items()
        if isinstance(frame, pd.DataFrame)
    }
    changed = replace(sample_flight, ekf2=replace(ekf2, innovations={**ekf2.innovations, **other}))
    agreement = opened(changed).agreement
    assert not agreement.good
    assert "1.25 of the logged one" in agreement.reason
    shuffled = {
        axis: frame.assign(innovation_m=frame["innovation_m"].to_numpy()[::-1])
        for axis, frame in ekf2.innovations.items()
        if isinstance(frame, pd.DataFrame)
    }
    changed = replace(
        sample_flight, ekf2=replace(ekf2, innovations={**ekf2.innovations, **shuffled})
    )
    agreement = opened(changed).agreement
    assert not agreement.good
    assert "correlate by" in agreement.reason


def test_a_mavlink_recording_gives_the_samples_that_the_log_lacks(sample_flight: Flight) -> None:
    path = Path(__file__).parents[1] / "sample_logs" / "aisle_uwb.tlog"
    recording = read_log(path)
    assert "estimator_states" in unavailable(recording)
    log = replace(
        sample_flight,
        positions=tuple(t for t in sample_flight.positions if t.origin != RECEIVED),
    )
    made = opened(join(log, recording))
    assert made.flown.source == "VISION_POSITION_ESTIMATE"
    assert made.agreement.good
    assert made.agreement.axes["north"].innovation_correlation > 0.999


def test_the_published_attitude_follows_the_replayed_one(model: Model) -> None:
    """Had EKF2's own attitude been 0.02 rad more about north, the replayed one would be so less."""
    stretch = model.inputs.stretches[0]
    tilted = replace(
        stretch, attitude_error_rad=stretch.attitude_error_rad + np.array([0.02, 0, 0])
    )
    other = replace(model, inputs=replace(model.inputs, stretches=(tilted,)))
    plain, changed = (replay_settings(m, [{"EKF2_TAU_POS": 0.25}])[0] for m in (model, other))
    pd.testing.assert_frame_equal(plain.updates, changed.updates)
    moved = (changed.published - plain.published).loc[40.0:120.0].mean()
    # at the horizon the pull makes up for it; from there on it is dead reckoning
    assert moved["east_m_s"] == pytest.approx(-0.02 * 9.8 * model.inputs.horizon_s, rel=0.15)
    assert abs(moved["north_m_s"]) < 0.005


def test_a_frame_of_its_own_is_turned_by_the_orientations(
    model: Model, sample_flight: Flight
) -> None:
    assert isinstance(sample_flight.attitude, pd.DataFrame)
    turn = Rotation.from_euler("Z", -70.0, degrees=True)
    samples = vision_of(sample_flight).copy()
    samples[POSITION_COLUMNS] = turn.apply(samples[POSITION_COLUMNS].to_numpy(copy=True))
    attitude = sample_flight.attitude
    sent = turn * Rotation.from_quat(attitude.to_numpy(copy=True), scalar_first=True)
    orientation = pd.DataFrame(sent.as_quat(scalar_first=True), attitude.index, QUATERNION_COLUMNS)
    made = opened(with_vision(sample_flight, samples, frame="FRD", orientation=orientation))
    plain, turned = (m.flown.updates["innovation_north_m"].to_numpy() for m in (model, made))
    assert turned == pytest.approx(plain, abs=2e-3)
    # where EKF2 takes its yaw from vision, the frame is vision's own
    ekf2, _ = of(sample_flight)
    assert isinstance(ekf2.fusing, pd.DataFrame)
    yawed = replace(sample_flight, ekf2=replace(ekf2, fusing=ekf2.fusing.assign(yaw=1.0)))
    inputs = prepare(with_vision(yawed, samples, frame="FRD", orientation=orientation))
    assert isinstance(inputs, Inputs)
    assert inputs.vision.position_m[:, 0] == pytest.approx(samples["north_m"].to_numpy())


def test_height_of_vision_counts_where_ekf2_fused_it(model: Model, sample_flight: Flight) -> None:
    ekf2, _ = of(sample_flight)
    assert isinstance(ekf2.fusing, pd.DataFrame)
    samples = vision_of(sample_flight).copy()
    samples["down_m"] += 0.7
    fused = replace(sample_flight, ekf2=replace(ekf2, fusing=ekf2.fusing.assign(vertical=1.0)))
    low = opened(with_vision(fused, samples)).flown.delayed["down_m"].loc[40.0:100.0]
    own = model.flown.delayed["down_m"].loc[40.0:100.0]
    vision = samples["down_m"].loc[40.0:100.0]
    assert low.mean() == pytest.approx(vision.mean(), abs=0.03)
    assert abs(own.mean() - vision.mean()) > 0.4


def test_a_bias_that_ekf2_does_not_learn_is_no_trouble(sample_flight: Flight) -> None:
    _, record = of(sample_flight)
    fixed = record.delayed.copy()
    fixed.loc[:, [name for name in fixed if str(name).endswith("m2_s4")]] = 0.0
    made = opened(
        with_record(
            sample_flight,
            delayed=fixed,
            parameters={**record.parameters, "EKF2_ACC_B_NOISE": 0.0},
        )
    )
    assert np.isfinite(made.flown.published.to_numpy()).all()
    assert np.isfinite(made.flown.updates.to_numpy()).all()


@pytest.mark.parametrize(("horizon_s", "lag"), [(0.0, 1), (0.024, 2), (0.026, 3), (9.0, 100)])
def test_what_is_published_has_the_bias_of_the_horizon(
    monkeypatch: pytest.MonkeyPatch, horizon_s: float, lag: int
) -> None:
    """The newest IMU samples are corrected by the bias that the filter has ``lag`` steps before."""
    count = 80
    state = np.zeros((count + 1, 15))
    state[:, 12:15] = np.random.default_rng(3).normal(0.0, 0.1, (count + 1, 3))
    stretch = made(
        Stretch, time_s=0.01 * np.arange(count + 1), step_s=np.full(count, 0.01),
        rotation=np.tile(np.eye(3), (count + 1, 1, 1)), force_m_s2=np.ones((count, 3)),
    )  # fmt: skip
    variant = SimpleNamespace(
        timing=lambda _: Timing(0.0, horizon_s), attitude=False,
        settings={"EKF2_TAU_VEL": 0.25, "EKF2_TAU_POS": 0.4},
    )  # fmt: skip
    taken = {}

    def keep(**given: Any) -> tuple[np.ndarray, np.ndarray]:
        taken.update(given)
        return state[:, 3:6], state[:, 6:9]

    monkeypatch.setattr(model_module, "delayed_states", lambda *_: (state, state[:, :3]))
    monkeypatch.setattr(model_module, "_delayed", lambda *_: pd.DataFrame())
    monkeypatch.setattr(model_module, "publish", keep)
    part = SimpleNamespace(stretch=stretch, variants=[variant])
    model_module._tracks(made(Inputs, step_s=0.01), part, 0)  # type: ignore[arg-type]
    assert taken["lag"] == lag
    gravity = np.array([0.0, 0.0, 9.80665])
    for step in range(count):
        bias = state[max(step + 1 - lag, 0), 12:15]
        np.testing.assert_allclose(taken["gain_m_s"][step], (1.0 - bias + gravity) * 0.01)
