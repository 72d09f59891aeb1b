"""EKF2 model on cases with a known answer, and at its limits: intervals and recursion.

The limits are repeated here, so that a change in the code needs a change in the test.
"""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from ekf2_tools import RULES, step_matrix, step_noise
from exchange import replace
from findings_tools import log, made
from scipy.spatial.transform import Rotation

from px4fuse.ekf2.filter_batch import FilterBatch, FilterConfiguration
from px4fuse.ekf2.filter_recursion import (
    SegmentRun,
    _compute_steady_state_correlation,
    _FusionDecisions,
    _limit_bias_variance,
    _update_sequentially,
    run_segment,
)
from px4fuse.ekf2.filter_recursion import _collect_measurements as measurements
from px4fuse.ekf2.inputs import FusionRules, ReceivedPositions, ReplayInputs
from px4fuse.ekf2.intervals import (
    FUSE,
    NO_ACTION,
    START_FUSION,
    FusionDelays,
    _compute_imu_process_noise,
    _find_fusion_actions,
    _make_fusion_events,
    make_event_intervals,
)
from px4fuse.ekf2.model import Ekf2Model, replay_with_settings
from px4fuse.ekf2.replay_segments import (
    GRAVITY_M_S2,
    ReplaySegment,
    add_magnetic_field_states,
    make_magnetic_field_samples,
)
from px4fuse.errors import SettingsError
from px4fuse.flight.ekf2_parameters import EV_POS, GNSS_POS, MAG, Aid, fill_parameters_with_defaults
from px4fuse.trajectory.rotation import skew


def test_accelerometer_bias_variance_obeys_px4_limits():
    P = np.zeros((2, 15, 15))
    for each in P:
        np.fill_diagonal(each[12:, 12:], [4.0, 1e-3, 0.1])
    _limit_bias_variance(P, 5e-4, np.array([True, False]))
    # at most 0.1 g, ratio between the axes at most 100
    np.testing.assert_allclose(np.diag(P[0])[12:], [0.980665**2, 0.04, 0.1])
    np.testing.assert_allclose(np.diag(P[1])[12:], [4.0, 1e-3, 0.1])
    np.fill_diagonal(P[0][12:, 12:], [1e-3, 1e-5, 1e-3])
    _limit_bias_variance(P, 5e-4, np.array([True, False]))
    np.testing.assert_allclose(np.diag(P[0])[12:], [1e-3, 5e-4, 1e-3])


def test_vision_measurements_apply_lever_arm_and_noise_minimum():
    vision = made(ReceivedPositions, position_m=np.array([[1.0, 2.0, 3.0]]),
                  variance_m2=np.array([[0.04, 0.0001, 0.0]]))  # fmt: skip
    turned = Rotation.from_euler("z", 90.0, degrees=True).as_matrix()
    segment = made(ReplaySegment, body_to_ned=np.array([np.eye(3), turned]))
    parameters = {
        "EKF2_EVP_NOISE": np.array([0.1, 0.001]), "EKF2_EV_NOISE_MD": np.array([0.0, 1.0]),
        "EKF2_EV_POS_X": np.array([0.0, 0.3]), "EKF2_EV_POS_Y": np.zeros(2),
        "EKF2_EV_POS_Z": np.zeros(2),
    }  # fmt: skip
    inputs = made(ReplayInputs, received_positions=vision, imu_offset_m=np.zeros(3))
    both = made(
        FilterBatch, inputs=inputs, segment=segment, parameters=parameters,
        event_steps=np.array([[1, 1]]), events={"sample": np.zeros((1, 2), int)},
        uses_reported_noise=np.array([True, True]),
    )  # fmt: skip
    position, noise = measurements(both)
    # 0.3 m ahead of a body that faces east: the body is west of the sensor
    assert np.isnan(position[..., :3]).all()
    np.testing.assert_allclose(position[0, :, 3:], [[1, 2, 3], [1, 1.7, 3]], atol=1e-12)
    # the reported variance, at least EKF2_EVP_NOISE; or EKF2_EVP_NOISE only, at least 1 cm
    np.testing.assert_allclose(noise[0, :, 3:], [[0.04, 0.01, 0.01], [1e-4, 1e-4, 1e-4]])
    both.uses_reported_noise = np.array([False, False])
    _, noise = measurements(both)
    np.testing.assert_allclose(noise[0, :, 3:], [[0.01, 0.01, 0.01], [1e-4, 1e-4, 1e-4]])


def decide_gnss_fusion(
    *,
    action: int = FUSE,
    can_start_fusion: bool = False,
    has_gate: bool = True,
    follows_log: bool = False,
    logged: float = np.nan,
    logged_reset: bool = False,
    outside: bool = True,
    gap_s: float = 0.5,
    stopped: bool = False,
    left: int = 5,
    rules: FusionRules = RULES,
    velocity_gap_s: float = 0.0,
) -> tuple[bool, bool, bool, float, bool, int]:
    """Return rejected, fused and reset at 10 s; then last fusion, stopped, remaining resets."""
    fusion = made(
        _FusionDecisions, fusion_rules=rules, sample_actions=np.array([[action]]),
        can_start_fusion=np.array([[can_start_fusion]]),
        time_s=np.array([[10.0]]), has_gate=np.array([has_gate]),
        uses_logged_decisions=np.array([follows_log]),
        logged_rejected_flags=np.array([logged]), logged_resets=np.array([logged_reset]),
        is_every_reset_logged=False, last_position_s=np.array([10.0 - gap_s]),
    )  # fmt: skip
    fusion.last_velocity_s = np.array([10.0 - velocity_gap_s])
    fusion.is_stopped, fusion.remaining_resets = np.array([stopped]), np.array([left])
    rejected, taken, reset, _ = fusion.decide_fusion(0, np.array([outside]), np.array([False]))
    last, stop, rest = fusion.last_position_s[0], fusion.is_stopped[0], fusion.remaining_resets[0]
    return bool(rejected[0]), bool(taken[0]), bool(reset[0]), float(last), bool(stop), int(rest)


@pytest.mark.parametrize(("case", "expected"), [
    ({"outside": False}, (False, True, False, 10.0, False, 5)),
    ({}, (True, False, False, 9.5, False, 5)),
    ({"gap_s": 1.0}, (True, False, False, 9.0, False, 5)),
    ({"gap_s": 1.5}, (True, False, True, 10.0, False, 4)),
    ({"gap_s": 1.5, "left": 1}, (True, False, True, 10.0, False, 0)),
    ({"gap_s": 1.5, "left": 0}, (True, False, False, 8.5, True, 0)),
    ({"has_gate": False}, (False, True, False, 10.0, False, 5)),
    ({"action": START_FUSION, "left": 2}, (False, False, True, 10.0, False, 5)),
    ({"stopped": True, "outside": False}, (False, False, False, 9.5, True, 5)),
    ({"stopped": True, "can_start_fusion": True, "left": 0}, (True, False, True, 10.0, False, 5)),
    ({"action": NO_ACTION}, (False, False, False, 9.5, False, 5)),
    # logged decisions
    ({"follows_log": True, "logged": 0.0}, (False, True, False, 10.0, False, 5)),
    ({"follows_log": True, "logged": 1.0, "outside": False}, (True, False, False, 9.5, False, 5)),
    ({"follows_log": True, "logged": 1.0, "gap_s": 9.0, "left": 0},
     (True, False, False, 1.0, False, 0)),
    ({"follows_log": True, "logged": 1.0, "logged_reset": True},
     (True, False, True, 10.0, False, 5)),
    ({"follows_log": True}, (True, False, False, 9.5, False, 5)),
    ({"logged": 0.0}, (True, False, False, 9.5, False, 5)),
])  # fmt: skip
def test_ekf2_model_stops_fusion_and_resets_after_ekf2_timeouts(case, expected):
    assert decide_gnss_fusion(**case) == expected


@pytest.mark.parametrize(("settings", "by_delay", "timing"), [
    ({"EKF2_EV_DELAY": 50.0}, False, FusionDelays(0.05, 0.12)),
    ({"EKF2_DELAY_MAX": 300.0}, False, FusionDelays(0.0, 0.29)),
    ({"EKF2_DELAY_MAX": 301.0}, False, FusionDelays(0.0, 0.3)),
    ({"EKF2_DELAY_MAX": 0.0}, False, FusionDelays(0.0, 0.01)),
    ({"EKF2_EV_DELAY": 50.0}, True, FusionDelays(0.05, 0.12)),
    ({"EKF2_EV_DELAY": 200.0}, True, FusionDelays(0.2, 0.19)),
])  # fmt: skip
def test_fusion_horizon_delay_equals_duration_of_ekf2_buffer(settings, by_delay, timing):
    usual = {"EKF2_EV_DELAY": 0.0, "EKF2_DELAY_MAX": 200.0}
    rules = replace(RULES, is_horizon_set_by_largest_delay=by_delay)
    inputs = made(
        ReplayInputs,
        rules=rules,
        settings=usual,
        horizon_s=0.12,
        mean_step_s=0.01,
        configured_step_s=0.01,
    )
    found = FilterConfiguration({**usual, **settings}).compute_delays(inputs)
    assert (found.delay_s, found.horizon_s) == pytest.approx((timing.delay_s, timing.horizon_s))
    shifted = FilterConfiguration(usual, timestamp_offset_s=0.03).compute_delays(inputs)
    assert (shifted.delay_s, shifted.horizon_s) == pytest.approx((-0.035, math.inf))


def test_ekf2_replay_of_px4_v1_14_rejects_ekf2_delay_max():
    rules = replace(RULES, is_horizon_set_by_largest_delay=True)
    received = made(ReceivedPositions, uses_sender_timestamps=False)
    inputs = made(ReplayInputs, rules=rules, settings={}, aid=EV_POS, received_positions=received)
    flight = SimpleNamespace(log=log(firmware="PX4 v1.14"))
    model = made(Ekf2Model, inputs=inputs, flight=flight)
    with pytest.raises(SettingsError, match=r"PX4 v1\.14 has no EKF2_DELAY_MAX"):
        list(replay_with_settings(model, [{"EKF2_DELAY_MAX": 100.0}]))
    assert not list(replay_with_settings(model, []))


GNSS_RULES = replace(
    RULES, stop_timeout_s=math.inf, reset_timeout_s=7.0, max_resets=1_000_000, resets_velocity=True
)


@pytest.mark.parametrize(("gap_s", "velocity_gap_s", "resets_velocity", "resets"), [
    (7.1, 7.1, True, True), (6.9, 7.1, True, False), (7.1, 6.9, True, False),
    (13.9, 0.0, True, False), (14.1, 0.0, True, True), (7.1, 0.0, False, True),
])  # fmt: skip
def test_ekf2_resets_to_gnss_after_7_s_without_any_gnss_fusion(
    gap_s, velocity_gap_s, resets_velocity, resets
):
    """shouldResetGpsFusion: from PX4 main of 2026 on, a position reset ignores the velocity."""
    rules = replace(GNSS_RULES, resets_velocity=resets_velocity)
    _, taken, reset, *_ = decide_gnss_fusion(
        gap_s=gap_s, velocity_gap_s=velocity_gap_s, rules=rules, left=9
    )
    assert (taken, reset) == (False, resets)


def test_east_update_uses_innovation_from_before_north_update():
    """The second gain uses the new covariance and the old S, as in EKF2; it is not optimal."""
    rng = np.random.default_rng(6)
    root = rng.normal(size=(2, 15, 15))
    P, nu, R = root @ np.swapaxes(root, 1, 2), rng.normal(size=(2, 6)), np.full((2, 6), 0.5)
    S = np.diagonal(P, axis1=1, axis2=2)[:, 3:9] + R
    taken = np.array([True, False])
    fused = np.outer(taken, [False, False, False, True, True])
    x, left = _update_sequentially(np.zeros((2, 15)), P, nu, S, R, fused)
    expected, state = P[0], np.zeros(15)
    for column, row in ((3, 6), (4, 7)):
        K = expected[:, row] / S[0, column]
        kept = np.eye(15) - np.outer(K, np.eye(15)[row])
        expected = kept @ expected @ kept.T + R[0, column] * np.outer(K, K)
        state = state + K * nu[0, column]
        if row == 6:  # the first update is that of the Kalman filter
            np.testing.assert_allclose(expected, P[0] - np.outer(K, P[0, 6]), atol=1e-9)
    np.testing.assert_allclose(x, [state, np.zeros(15)], atol=1e-9)
    np.testing.assert_allclose(left, [expected, P[1]], atol=1e-9)
    assert np.linalg.eigvalsh(left[0]).min() > -1e-9


def on_gnss(north_m: list[float], north_m_s: list[float], **more: Any) -> SegmentRun:
    """:func:`at_rest` on GNSS, with a velocity for each fix."""
    speed = np.zeros((len(north_m_s), 3))
    speed[:, 0] = north_m_s
    return at_rest(north_m, aid=GNSS_POS, rules=GNSS_RULES, speed_m_s=speed, **more)


def test_ekf2_replay_tilt_variance_is_limited_to_logged_value():
    """Tilt is corrected as by a measurement to the logged variance, and only with GNSS."""
    fixes = [0.0] * 20
    free, limited = (on_gnss(fixes, fixes, tilt_rad2=tilt) for tilt in (np.inf, 2.5e-5))
    np.testing.assert_allclose(limited.variance[1:, 0, :2], 2.5e-5, rtol=0.02)
    assert (free.variance[1:, 0, :2] > 5e-5).all()
    np.testing.assert_allclose(limited.state, free.state, atol=1e-9)
    assert (limited.variance[-1, 0, 3:5] < free.variance[-1, 0, 3:5]).all()
    vision, with_tilt = (at_rest(fixes, tilt_rad2=tilt) for tilt in (np.inf, 2.5e-5))
    np.testing.assert_array_equal(vision.variance, with_tilt.variance)


@pytest.mark.parametrize(("speed_m_s", "moves"), [(1.0, True), (3.0, False)])
def test_ekf2_replay_rejects_gnss_velocity_outside_gate(speed_m_s, moves):
    """Five times √(P + 0.09) is 1.5 m/s; the position of the fix is fused nevertheless."""
    done = on_gnss([0.0] * 20, [0.0] * 10 + [speed_m_s] + [0.0] * 9)
    assert done.fused.all()
    assert bool(abs(done.state[11, 0, 3]) > 1e-3) is moves
    assert done.innovation[10, 0, 0] == pytest.approx(speed_m_s, abs=0.01)
    wider = on_gnss([0.0] * 20, [0.0] * 10 + [3.0] + [0.0] * 9, EKF2_GPS_V_GATE=20.0)
    assert abs(wider.state[11, 0, 3]) > 1e-3


def test_steady_state_correlations_equal_15_state_kalman_filter():
    """Reference: a plain Kalman filter of a vehicle at rest for one minute, facing east."""
    turn = Rotation.from_euler("z", 110.0, degrees=True).as_matrix()
    count = 6000
    segment = made(
        ReplaySegment, step_s=np.full(count, 0.01), body_to_ned=np.tile(turn, (count + 1, 1, 1)),
        specific_force_m_s2=np.zeros((count, 3)) - GRAVITY_M_S2, variance=np.empty(15),
    )  # fmt: skip
    P = np.diag(np.repeat([0.1, 0.3, 0.5, 1e-5, 0.2], 3) ** 2)
    for k in range(count):
        F = step_matrix(segment, k)
        P = F @ P @ F.T + step_noise(segment, k, 1e-4, 0.35)
        if k % 10 == 9:
            for row in (3, 4, 5):
                P -= np.outer(P[row], P[row]) / (P[row, row] + 0.01)
    deviation = np.sqrt(np.diag(P))
    known = (P / deviation[:, None] / deviation)[:2, 12:14]
    segment.variance[:] = np.diag(P)
    found = _compute_steady_state_correlation(segment)
    np.testing.assert_allclose(found[:2, 12:14], known, atol=0.03)
    assert np.abs(known).max() > 0.9
    np.testing.assert_allclose(np.diag(found), 1.0)
    assert np.linalg.eigvalsh(found).min() > -1e-9


def test_ekf2_replay_gnss_reset_sets_position_and_velocity():
    """After 7 s without both: position and velocity are those of the fix, with their variances."""
    done = on_gnss([0.0] * 5 + [300.0] * 80, [0.0] * 5 + [40.0] * 80)
    at = int(np.flatnonzero(done.reset[:, 0])[0])
    assert at == 5 + 70  # the 71st rejected fix is the first more than 7 s after the last fusion
    np.testing.assert_allclose(done.state[at + 1, 0, [6, 3]], [300.0, 40.0], atol=1e-9)
    np.testing.assert_allclose(done.variance[at + 1, 0, 6:8], 0.25)
    np.testing.assert_allclose(done.variance[at + 1, 0, 3:5], 0.09)


def test_ekf2_replay_does_not_fuse_a_lost_aiding_source():
    """Ten fixes at the origin, ten fixes 1 m north with 0.5 m/s; GNSS is lost at 11.05 s."""
    fixes, speeds = [0.0] * 10 + [1.0] * 10, [0.0] * 10 + [0.5] * 10
    done = {name: on_gnss(fixes, speeds, without=dict.fromkeys(name.split(), 11.05))
            for name in ("", "gnss_pos", "gnss_vel", "gnss_pos gnss_vel")}  # fmt: skip
    whole = done[""]
    for name, run in done.items():
        np.testing.assert_array_equal(run.state[:10], whole.state[:10])
        assert run.fused[:10].all()
        # innovations are still computed
        assert np.isfinite(run.innovation[10:, 0, 3:5]).all()
        assert run.fused[10:].any() == ("gnss_pos" not in name)
        assert not (run.rejected | run.reset).any()
    north, speed = ({name: run.state[-1, 0, row] for name, run in done.items()} for row in (6, 3))
    assert [north["gnss_pos gnss_vel"], speed["gnss_pos gnss_vel"]] == pytest.approx([0.0, 0.0])
    assert speed["gnss_pos"] == pytest.approx(0.5, abs=0.05)
    assert 0.0 < north["gnss_pos"] < north[""]
    assert north["gnss_vel"] > 0.05


@pytest.mark.parametrize("speed_m_s", [None, np.zeros((20, 3))])
def test_ekf2_replay_with_magnetometer_estimates_heading(speed_m_s):
    """The initial heading error is 0.05 rad; the logged heading is not used."""
    done = at_rest([0.0] * 5 + [1.0] * 15, aid=GNSS_POS, rules=GNSS_RULES, speed_m_s=speed_m_s,
                   heading_rad=0.05, down_m=-3.0, field_gauss=(0.21, 0.0, 0.43))  # fmt: skip
    assert done.state.shape == (len(done.innovation) + 1, 1, 21)
    heading = done.state[:, 0, 2]
    assert 0.02 < heading[1] < 0.05
    assert heading[-1] == pytest.approx(0.0, abs=0.01)
    # 28 samples of 0.21 gauss with σ 0.05; the gyro adds a little
    expected = 1.0 / (0.01**-1 + 28 * (0.21 / 0.05) ** 2)
    assert expected < done.variance[-1, 0, 2] < 1.4 * expected
    np.testing.assert_array_equal(done.state[1:, 0, 8], -3.0)
    np.testing.assert_allclose(done.variance[10:, 0, 8], 4e-4, rtol=1e-3)
    assert done.fused.all()
    assert done.state[-1, 0, 6] > 0.02


def test_magnetometer_noise_is_at_least_0_01_gauss():
    """The limit is in mag_control.cpp."""
    low, limit, high = (
        at_rest([0.0] * 20, aid=GNSS_POS, rules=GNSS_RULES, heading_rad=0.05,
                field_gauss=(0.21, 0.0, 0.43), EKF2_MAG_NOISE=noise_gauss)
        for noise_gauss in (0.0, 0.01, 0.02)
    )  # fmt: skip
    np.testing.assert_allclose(low.state, limit.state, atol=1e-5)
    assert np.abs(high.state - limit.state).max() > 1e-4


def at_rest(
    measured_m: list[float], down_m: float = 0.0, aid: Aid = EV_POS, rules: FusionRules = RULES,
    speed_m_s: Any = None, tilt_rad2: float = np.inf, without: Any = None,
    heading_rad: float = 0.0, field_gauss: Any = None, reset_s: Any = (), **settings: float,
) -> SegmentRun:  # fmt: skip
    """Run a level vehicle at rest at the origin, measured at 10 Hz at these north positions."""
    count = 10 * (len(measured_m) + 1)
    flat = np.zeros((count, 3))
    segment = ReplaySegment(
        time_s=10.0 + 0.01 * np.arange(count + 1), step_s=np.full(count, 0.01),
        body_to_ned=np.tile(np.eye(3), (count + 1, 1, 1)), attitude_correction_rad=flat,
        specific_force_m_s2=flat - GRAVITY_M_S2,
        accelerometer_bias_m_s2=np.zeros(3), state=np.zeros(15), variance=np.full(15, 1e-4),
        down_m=np.full(count + 1, down_m),
        attitude_variance_rad2=np.tile([tilt_rad2, tilt_rad2, 1e-4], (count + 1, 1)),
        down_variance_m2=np.full(count + 1, 4e-4), attitude_error_rad=np.zeros((count + 1, 3)),
        initial_state_correlation=np.eye(15),
    )  # fmt: skip
    segment.state[2] = heading_rad
    if field_gauss is not None:
        at, known = np.arange(7, count, 7), np.append(field_gauss, np.zeros(3))
        gauss = np.tile(field_gauss, (len(at), 1))
        samples = make_magnetic_field_samples(segment, segment.time_s[at], gauss, 1.0)
        segment = add_magnetic_field_states(segment, samples, known, np.full(6, 1e-8))
        segment.variance[2] = 0.01
    stamp = 10.105 + 0.1 * np.arange(len(measured_m))
    north = np.array(measured_m)
    vision = ReceivedPositions(
        stamp, np.full(len(stamp), -np.inf), np.column_stack([north, 0.0 * north, 0.0 * north]),
        np.zeros((len(stamp), 3)), np.full(len(stamp), np.nan), np.zeros(len(stamp), bool), "uwb",
    )  # fmt: skip
    exact = None if speed_m_s is None else np.zeros_like(speed_m_s)
    vision = replace(
        vision,
        velocity_m_s=speed_m_s,
        velocity_variance_m2_s2=exact,
        reset_times_s=reset_s,
    )
    inputs = ReplayInputs(
        fill_parameters_with_defaults(settings, aid, *([MAG] if segment.magnetic_field else [])),
        (segment,), vision,
        rules, 0.01, 0.1, 0.01,
        fuses_vision_height=False, imu_offset_m=np.zeros(3), aid=aid,
    )  # fmt: skip
    intervals = make_event_intervals(inputs, segment, FusionDelays(0.0, 0.1))
    configuration = FilterConfiguration(
        inputs.settings, uses_logged_decisions=True, disable_time_s_by_aid=without or {}
    )
    return run_segment(inputs, segment, [configuration], [intervals])


def test_new_vision_reset_counter_resets_ekf2_position():
    """The source jumps by 0.3 m, inside the gate, and announces it at 10.605 s."""
    done = at_rest([0.0] * 5 + [0.3] * 15, reset_s=np.array([10.605]))
    assert np.flatnonzero(done.reset[:, 0]).tolist() == [5]
    np.testing.assert_allclose(done.state[6:, 0, 6], 0.3, atol=1e-6)


def test_ekf2_replay_variance_at_rest_equals_kalman_update():
    done = at_rest([0.0] * 20)
    np.testing.assert_allclose(done.state, 0.0, atol=1e-9)
    assert done.fused.all()
    np.testing.assert_allclose(done.noise[..., 3:], 0.01)
    # P after = P R / (P + R), separately for north and east
    before, after = done.innovation_variance[0, 0, 3:5] - 0.01, done.variance[1, 0, 6:8]
    np.testing.assert_allclose(after, before * 0.01 / (before + 0.01), rtol=1e-3)
    # first 0.1 s: 1e-4 from position and from velocity, plus tilt and noise
    assert before[0] == pytest.approx(1e-4 + 1e-4 * 0.1**2, rel=0.05)
    # heading and height have the logged variances
    np.testing.assert_allclose(done.variance[1:, 0, 2], 1e-4, rtol=0.01)
    assert done.variance[-1, 0, 8] == pytest.approx(4e-4, rel=0.01)


def test_ekf2_replay_of_position_jump_resets_after_1_s():
    done = at_rest([0.0] * 5 + [3.0] * 15)
    rejected, reset, fused = done.rejected[:, 0], done.reset[:, 0], done.fused[:, 0]
    assert np.flatnonzero(rejected).tolist() == list(range(5, 16))
    assert np.flatnonzero(reset).tolist() == [15]
    assert np.flatnonzero(fused).tolist() == [*range(5), *range(16, 20)]
    np.testing.assert_allclose(done.innovation[5, 0, 3:5], [3.0, 0.0], atol=1e-3)
    np.testing.assert_allclose(done.state[16, 0, 6:8], [3.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(done.state[15, 0, 6:8], [0.0, 0.0], atol=1e-3)
    np.testing.assert_allclose(done.variance[16, 0, 6:8], 0.01)
    # other states do not change
    np.testing.assert_allclose(done.variance[16, 0, 8], done.variance[15, 0, 8], rtol=0.01)
    assert (done.variance[16, 0, 3:6] > done.variance[15, 0, 3:6]).all()
    assert at_rest([0.0] * 5 + [3.0] * 15, EKF2_EVP_GATE=100.0).fused.all()
    sigma = float(np.sqrt(done.innovation_variance[5, 0, 3]))
    for times, beyond in ((4.99, False), (5.01, True)):
        assert at_rest([0.0] * 5 + [times * sigma]).rejected[5, 0] == beyond


# ---------------------------------------------------------------- intervals


@pytest.mark.parametrize("n", [4, 200])
def test_closed_form_process_noise_equals_sum_over_steps(n):
    """Step by step: θ gains unit noise · dt, v depends on θ, p on v."""
    dt = 0.008
    tilt = -skew(np.array([[0.3, -0.2, -9.8]]))[0] * dt
    F = np.eye(9)
    F[3:6, 0:3], F[6:9, 3:6] = tilt, dt * np.eye(3)
    sums = np.zeros((2, 9, 9))
    for _ in range(n):
        for at, rows in enumerate((slice(0, 3), slice(3, 6))):
            sums[at] = F @ sums[at] @ F.T
            sums[at][rows, rows] += dt**2 * np.eye(3)
    closed_forms = _compute_imu_process_noise(
        np.array([float(n)]), np.array([n * dt]), (n * tilt)[None]
    )
    # for the gyro, only leading terms of position with velocity and itself
    sums[0][6:9, 3:9] = closed_forms[0][0, 6:9, 3:9] if n == 4 else sums[0][6:9, 3:9]
    sums[0][3:6, 6:9] = sums[0][6:9, 3:6].T
    for found, true in zip(closed_forms, sums, strict=True):
        scale = np.sqrt(np.outer(np.diag(true), np.diag(true)))
        scale[scale == 0.0] = 1.0
        assert np.max(np.abs(found[0] - true) / scale) < (1e-9 if n == 4 else 0.03)


def make_replay_segment(count: int, *, fusing: bool = True) -> ReplaySegment:
    return made(
        ReplaySegment, time_s=10.0 + 0.01 * np.arange(count + 1), starts_while_fusing=fusing
    )


def vision_of(stamps: list[float], age_s: float = 0.0) -> ReceivedPositions:
    stamp = np.array(stamps)
    return made(ReceivedPositions, timestamp_s=stamp, arrival_s=stamp + age_s)


def find_actions(
    stamps: list[float], *, fusing: bool = True, rules: FusionRules = RULES
) -> list[int]:
    segment = make_replay_segment(500, fusing=fusing)
    taken = np.array(stamps)
    end = np.searchsorted(segment.time_s, taken - 1e-9)
    inputs = made(ReplayInputs, rules=rules)
    action, _ = _find_fusion_actions(inputs, segment, taken, end, np.ones(len(taken), bool))
    return action.tolist()


def test_ekf2_stops_vision_fusion_at_too_long_sample_interval():
    assert find_actions([10.1, 10.3, 10.45], fusing=False) == [NO_ACTION, NO_ACTION, START_FUSION]
    assert find_actions([10.1, 10.29, 10.45], fusing=False) == [NO_ACTION, START_FUSION, FUSE]
    assert find_actions([10.1, 10.29, 10.45]) == [FUSE, FUSE, FUSE]
    # 0.4 s to the previous step
    assert find_actions([10.1, 10.5, 10.6]) == [FUSE, FUSE, FUSE]
    assert find_actions([10.1, 10.53, 10.6]) == [FUSE, NO_ACTION, START_FUSION]
    old = replace(RULES, max_sample_interval_to_start_s=math.inf, stop_timeout_s=7.0)
    assert find_actions([10.1, 12.0, 14.9], fusing=False, rules=old) == [
        NO_ACTION,
        START_FUSION,
        FUSE,
    ]


def events(
    stamps: list[float], *, delay_s: float = 0.0, age_s: float = -9.0, horizon_s: float = 0.0
) -> Any:
    inputs = made(
        ReplayInputs,
        received_positions=vision_of(stamps, age_s),
        mean_step_s=0.01,
        rules=RULES,
        max_height_fusion_interval_in_position_gap_s=0.25,
    )
    return _make_fusion_events(inputs, make_replay_segment(100), FusionDelays(delay_s, horizon_s))


def test_ekf2_replay_fuses_vision_half_a_step_before_timestamp():
    """Half a step and the delay before its timestamp; additional events in gaps of vision."""
    found = events([10.2, 10.305, 10.9])
    has_sample = found.sample >= 0
    assert found.sample.tolist() == [0, 1, -1, -1, 2]
    assert found.end_step[has_sample].tolist() == [20, 30, 90]
    assert found.end_step[~has_sample].tolist() == [50, 70]
    assert found.time_s == pytest.approx([10.195, 10.3, 10.5, 10.7, 10.895])
    assert found.usable[has_sample].all()
    assert not found.usable[~has_sample].any()
    assert found.action.tolist() == [FUSE, FUSE, NO_ACTION, NO_ACTION, NO_ACTION]
    assert events([10.2, 10.305], delay_s=0.05).end_step[:2].tolist() == [15, 25]
    assert events([10.505]).sample[:3].tolist() == [-1, -1, 0]
    # in the first step, and before it
    assert events([10.01]).usable[0]
    assert events([10.01]).end_step[0] == 1
    assert not events([10.004]).usable[0]
    # of two samples in one step the newer one
    assert events([10.2, 10.202]).usable[:2].tolist() == [False, True]


@pytest.mark.parametrize(("age_s", "late", "lost"), [
    (0.22, False, False), (0.24, True, False), (0.28, True, False), (0.31, False, True),
])  # fmt: skip
def test_vision_sample_that_arrives_late_is_marked_late_or_lost(age_s, late, lost):
    """Due 0.2 s after its timestamp: late by more than 0.03 s, lost from 0.1 s on."""
    found = events([10.2, 10.4], age_s=age_s, horizon_s=0.2)
    assert (bool(found.late[0]), bool(found.lost[0])) == (late, lost)
    assert bool(found.usable[0]) is not lost
