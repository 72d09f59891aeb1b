"""Inputs of the EKF2 replay from a log: parameters, rules, vision, and segments of steps.

The limits are repeated here, so that a change in the code needs a change in the test.
"""

import math
from collections.abc import Callable
from dataclasses import fields
from operator import attrgetter
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from findings_tools import NONE, log, made
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from px4fuse.ekf2 import inputs as inputs_module
from px4fuse.ekf2.inputs import (
    FusionRules,
    ReceivedPositions,
    ReplayInputs,
    _find_vision_track,
    _read_logged_decisions,
    prepare_inputs,
    read_vision,
)
from px4fuse.ekf2.replay_segments import (
    ReplaySegment,
    _make_segment,
    downsample_imu,
    find_replay_segments,
    find_step_ends,
    read_prediction_step_s,
)
from px4fuse.ekf2.whatif import make_sweep_values
from px4fuse.errors import SettingsError
from px4fuse.flight.ekf2_parameters import (
    GNSS_POS,
    MODEL_PARAMETERS,
    check_parameters,
    fill_parameters_with_defaults,
    uses_aid_mask,
)
from px4fuse.flight.model import (
    ALIGNED_BY_EKF2_ORIGIN,
    AS_RECEIVED_ORIGIN,
    DEAD_RECKONING_FLAG,
    GNSS_ORIGIN,
    KEPT_BY_EKF2_ORIGIN,
    MOTION_CAPTURE_ORIGIN,
    POSITION_FILE_ORIGIN,
    AidLog,
    Columns,
    Ekf2,
    Flight,
    FusionRecord,
    PositionTrack,
    Reset,
    SourceOrigin,
    Unavailable,
)
from px4fuse.trajectory.rotation import to_rotation_matrix

ALIGNED_TOPIC = "estimator_visual_odometry_aligned"
AID = ("estimator_aid_src_ev_pos",)


# ---------------------------------------------------------------- parameters


def test_ekf2_parameters_missing_in_log_have_px4_defaults():
    """Defaults of PX4's module.yaml and params_*.yaml, by fused aid."""
    vision, gnss = fill_parameters_with_defaults({}), fill_parameters_with_defaults({}, GNSS_POS)
    for names, other_names, begin in ((vision, gnss, "EKF2_EV"), (gnss, vision, "EKF2_GPS")):
        assert {*names} - {*other_names} == {
            name for name in MODEL_PARAMETERS if name.startswith(begin)
        }
    assert (
        fill_parameters_with_defaults({"EKF2_AID_MASK": 1.0}, GNSS_POS)["EKF2_GPS_DELAY"] == 110.0
    )
    assert fill_parameters_with_defaults({})["EKF2_EV_DELAY"] == 0.0
    assert fill_parameters_with_defaults({"EKF2_AID_MASK": 8.0})["EKF2_EV_DELAY"] == 175.0
    assert (
        fill_parameters_with_defaults({"EKF2_AID_MASK": 8.0, "EKF2_EV_DELAY": 50.0})[
            "EKF2_EV_DELAY"
        ]
        == 50.0
    )
    assert not uses_aid_mask({"EKF2_AID_MASK": 8.0, "EKF2_EV_CTRL": 15.0})


@pytest.mark.parametrize(("name", "fits", "not_fits"), [
    ("EKF2_EVP_GATE", (1.0, 1e3), (0.99, 1001.0)), ("EKF2_EV_NOISE_MD", (0.0, 1.0), (0.5, 2.0)),
    ("EKF2_EV_POS_X", (-5.0, 5.0), (math.inf, math.nan)),
])  # fmt: skip
def test_ekf2_parameter_check_accepts_limits_of_range(name, fits, not_fits):
    for value in fits:
        assert check_parameters({name: value}) == {name: value}
    for value in not_fits:
        unit = {"EKF2_EVP_GATE": " SD", "EKF2_EV_POS_X": " m"}.get(name, "")
        with pytest.raises(SettingsError, match=rf"{unit} is outside|is neither 0 nor 1"):
            check_parameters({name: value})


def test_parameter_sweep_accepts_2_to_200_values():
    assert make_sweep_values("EKF2_EV_DELAY", 0.0, 100.0, 2) == [0.0, 100.0]
    assert len(make_sweep_values("EKF2_EV_DELAY", 0.0, 100.0, 200)) == 200
    assert len(make_sweep_values("EKF2_EV_DELAY", 0.0, 100.0)) == 9
    assert make_sweep_values("EKF2_EVP_NOISE", 0.01, 1.0, 3) == pytest.approx([0.01, 0.1, 1.0])
    for low, high, count in ((0.0, 100.0, 1), (0.0, 100.0, 201), (50.0, 50.0, 5)):
        with pytest.raises(SettingsError):
            make_sweep_values("EKF2_EV_DELAY", low, high, count)


# ---------------------------------------------------------------- inputs and vision


@pytest.fixture
def flown(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """Return a function that prepares inputs of a flight with the given parameters."""
    monkeypatch.setattr(
        inputs_module,
        "read_vision",
        lambda *_: ReceivedPositions(*np.zeros((6, 1)), source="vision"),
    )
    segment = made(ReplaySegment, magnetic_field=None)
    monkeypatch.setattr(inputs_module, "find_replay_segments", lambda *_, **_more: (segment,))

    def prepared(
        interval_s: float = 0.008, horizon_s: Any = 0.1, firmware: str = "PX4 v1.16.1",
        fusing: Any = NONE, has_delta_angle_biases: bool = False, without: Any = (),
        **parameters: float,
    ) -> Any:  # fmt: skip
        record = made(
            FusionRecord, parameters=parameters, other_horizontal_aids=(),
            has_delta_angle_biases=has_delta_angle_biases, flow=pd.DataFrame(),
        )  # fmt: skip
        ekf2 = made(
            Ekf2, record=record, innovations={"north": pd.DataFrame({"rejected": []})},
            horizon_s=horizon_s, step_s=0.01, fusion_flags=fusing, aids={}, status_flags={},
        )  # fmt: skip
        imu = pd.DataFrame(index=np.delete(interval_s * np.arange(1000), without))
        return prepare_inputs(
            made(Flight, imu=imu, attitude=imu, ekf2=ekf2, log=log(firmware=firmware))
        )

    return prepared


def test_ekf2_fusion_rules_are_those_of_logged_px4_release(flown):
    """EV_MAX_INTERVAL, ev_control.cpp; no_aid_timeout_max and reset_timeout_max, common.h."""
    new = flown(EKF2_DELAY_MAX=200.0, EKF2_IMU_POS_Y=0.25)
    assert new.rules == FusionRules(0.2, 0.4, 1.0, 5, None, False)
    assert new.imu_offset_m.tolist() == [0.0, 0.25, 0.0]
    assert (new.mean_step_s, new.configured_step_s) == (0.01, 0.01)
    assert (new.horizon_s, new.max_height_fusion_interval_in_position_gap_s) == (0.1, 0.25)
    old = flown(EKF2_AID_MASK=8.0, has_delta_angle_biases=True)
    assert old.rules == FusionRules(math.inf, 7.0, 7.0, 1_000_000, pytest.approx(5e-4), True)
    assert old.settings["EKF2_EV_DELAY"] == 175.0
    assert flown(EKF2_PREDICT_US=8000.0).configured_step_s == pytest.approx(0.008)


def test_ekf2_replay_without_complete_imu_data_is_unavailable(flown):
    assert isinstance(flown(0.0119), ReplayInputs)
    assert "logged at 80 Hz" in flown(0.0125).reason
    assert isinstance(flown(horizon_s=NONE), Unavailable)
    assert flown(horizon_s=NONE, firmware="PX4 v1.13.3").horizon_s == 0.0
    for vertical, there in (([1.0, 0.0], False), ([1.0, 1.0, 0.0], True)):
        assert flown(fusing=pd.DataFrame({"vertical": vertical})).fuses_vision_height is there
    assert flown(fusing=NONE).fuses_vision_height is False
    every = np.arange(2, 998)
    assert "12 % of the IMU samples are missing" in flown(without=every[::8]).reason
    # fewer missing samples, and a gap, at which a segment ends
    assert isinstance(flown(without=every[::12]), ReplayInputs)
    assert isinstance(flown(without=np.arange(400, 600)), ReplayInputs)


def track(name: str, origin: SourceOrigin, interval_s: float = 0.1, **parts: Any) -> PositionTrack:
    time = 10.0 + interval_s * np.arange(30)
    samples = pd.DataFrame(1.0, index=time, columns=Columns.POSITION + Columns.POSITION_VARIANCE)
    usual = {"frame": "NED", "orientation": None, "topics": (name,), "status": pd.DataFrame()}
    return made(PositionTrack, name=name, origin=origin, samples=samples, **{**usual, **parts})


@pytest.mark.parametrize(("tracks", "expected"), [
    ([track("file", POSITION_FILE_ORIGIN), track("vehicle_visual_odometry", AS_RECEIVED_ORIGIN)],
     "vehicle_visual_odometry"),
    ([track("file", POSITION_FILE_ORIGIN), track("gps", GNSS_ORIGIN)], "file"),
    ([track("mocap", MOTION_CAPTURE_ORIGIN)], None),
    # complete copies: interval below 0.9 times the logger's, and at least 4 Hz
    ([track(ALIGNED_TOPIC, ALIGNED_BY_EKF2_ORIGIN, 0.179)], ALIGNED_TOPIC),
    ([track(ALIGNED_TOPIC, ALIGNED_BY_EKF2_ORIGIN, 0.181)], None),
    ([track("estimator_aid_src_ev_pos", KEPT_BY_EKF2_ORIGIN, 0.25)], "estimator_aid_src_ev_pos"),
    ([track("estimator_aid_src_ev_pos", KEPT_BY_EKF2_ORIGIN, 0.26)], None),
])  # fmt: skip
def test_ekf2_replay_selects_the_most_complete_vision_topic(tracks, expected):
    found = _find_vision_track(made(Flight, positions=tuple(tracks)))
    assert getattr(found, "name", None) == expected


def test_vision_positions_in_frd_are_rotated_to_ned():
    """Published heading 90°, sent 0°: sent north is east."""
    time = 10.0 + 0.1 * np.arange(30)

    def facing(heading: float) -> pd.DataFrame:
        q = Rotation.from_euler("z", heading, degrees=True).as_quat(scalar_first=True)
        return pd.DataFrame([q] * 30, index=time, columns=Columns.QUATERNION)

    own = track("vehicle_visual_odometry", AS_RECEIVED_ORIGIN, frame="FRD", orientation=facing(0.0))
    own.samples[Columns.POSITION] = [2.0, 0.5, -1.0]
    own.samples[Columns.POSITION_VARIANCE] = [0.04, np.nan, 0.09]
    for parameters, yaw, turned in (
        ({}, 0.0, True), ({}, 1.0, False), ({"EKF2_AID_MASK": 64.0}, 1.0, True),
        ({"EKF2_AID_MASK": 8.0}, 0.0, False),
    ):  # fmt: skip
        ages = pd.Series([0.05, 0.15], index=[time[0], time[-1]])
        record = made(FusionRecord, parameters=parameters, vision_age_s=ages, status_flags={})
        ekf2 = made(
            Ekf2, fusion_flags=pd.DataFrame({"yaw": [0.0, yaw]}), innovations={"north": NONE},
            record=record, horizon_s=0.1, innovation_topics=AID,
        )  # fmt: skip
        found = read_vision(made(Flight, positions=(own,)), ekf2, record, facing(90.0))
        where = [-0.5, 2.0, -1.0] if turned else [2.0, 0.5, -1.0]
        assert_allclose(found.position_m, [where] * 30, atol=1e-12)
        spread = [0.0, 0.04, 0.09] if turned else [0.04, 0.0, 0.09]
        assert_allclose(found.variance_m2, [spread] * 30, atol=1e-12)
        assert_allclose(found.arrival_s - time, np.linspace(0.05, 0.15, 30))
    copy = track("estimator_aid_src_ev_pos", KEPT_BY_EKF2_ORIGIN)
    found = read_vision(made(Flight, positions=(copy,)), ekf2, record, facing(90.0))
    assert np.all(found.arrival_s == -np.inf)


def test_logged_rejections_are_matched_by_measurement_time():
    """Measured half a step and the delay before the timestamp; resets show within 0.2 s."""
    stamp = 10.0 + 0.5 * np.arange(6)
    taken = stamp - 0.05 - 0.005
    off = np.array([0.0, 0.0059, -0.0059, 0.0061, -0.0061, 0.0])
    columns = {"rejected": [1.0, 1.0, 0.0, 1.0, 1.0, 0.0], "innovation_m": 1.0}
    logged = pd.DataFrame(columns, index=taken + off)
    shown = taken + 0.1
    resets = (
        Reset(float(shown[0]) + 0.19, "position", (1.0, 0.0, 0.0)),
        Reset(float(shown[1]) + 0.21, "position", (1.0, 0.0, 0.0)),  # too late
        Reset(float(shown[2]) + 0.1, "position", (0.0, 0.0, 1.0)),  # height reset
        Reset(float(shown[3]) + 0.1, "velocity", (1.0, 0.0, 0.0)),
        Reset(float(shown[4]), "position", (0.0, 1.0, 0.0)),
        Reset(float(shown[5]) + 0.1, "position", (0.0, 1.0, 0.0)),  # this sample was fused
    )
    record = made(FusionRecord, parameters={"EKF2_EV_DELAY": 50.0}, status_flags={})
    parts = {
        "innovations": {"north": logged}, "horizon_s": 0.1, "step_s": 0.01, "resets": resets,
        "innovation_topics": AID, "aids": {"ev_pos": made(AidLog, samples=logged)},
        "status_flags": {},
    }  # fmt: skip

    def decisions(**other: Any) -> Any:
        return _read_logged_decisions(made(Ekf2, **parts | other), record, stamp, stamp - 1.0)

    rejected, reset = decisions()
    assert_array_equal(rejected, [1.0, 1.0, 0.0, np.nan, np.nan, 0.0])
    assert reset.tolist() == [True, False, False, False, True, False]
    logged.loc[logged.index[5], "innovation_m"] = 0.0  # EKF2 logs a reset with innovation 0
    assert decisions()[1][5]
    for other in ({"innovation_topics": ()}, {"horizon_s": NONE}, {"innovations": {"north": NONE}}):
        rejected, reset = decisions(**other)
        assert np.isnan(rejected).all()
        assert not reset.any()


def test_logged_rejections_are_derived_from_last_fusion_time():
    """Rows at 0.5 and 1 s of samples at 10 Hz; EKF2 fused at 0.2 s and reset its position at 1.3 s.

    Inertial dead reckoning lasts from 1.2 s, which is 1 s after the last fusion, to 1.3 s.
    """
    taken = 0.1 * np.arange(16)
    columns = {"rejected": [1.0, 1.0], "innovation_m": 1.0, "last_fused_s": 0.203}
    logged = pd.DataFrame(columns, index=[0.5, 1.0])
    steps = pd.Series([0.0, 1.0, 0.0], index=[0.0, 1.203, 1.303])
    ekf2 = made(
        Ekf2, innovations={"north": logged}, horizon_s=0.1, step_s=0.0, innovation_topics=AID,
        resets=(Reset(1.52, "position", (1.0, 0.0, 0.0)),),
        aids={"ev_pos": made(AidLog, samples=logged)},
        status_flags={"ev_pos": pd.Series([1.0], index=[0.0])},
    )  # fmt: skip
    for states, resets_at in (({DEAD_RECKONING_FLAG: steps}, 13), ({}, 14)):
        record = made(FusionRecord, parameters={}, status_flags=states)
        rejected, reset = _read_logged_decisions(ekf2, record, taken, taken - 1.0)
        assert rejected[2] == 0.0
        known = 13 if states else 11
        assert_array_equal(rejected[3:known], 1.0)
        assert np.isnan(rejected[known:]).all()
        assert np.isnan(rejected[:2]).all()
        assert np.flatnonzero(reset).tolist() == [resets_at]


# ---------------------------------------------------------------- segments


@pytest.mark.parametrize(("interval_ms", "known", "ends"), [
    ([4] * 5, [], [2, 4]),
    ([4, 9, 4, 4], [], [2, 4]),  # longer than the target before its samples are complete
    ([9, 4, 4], [], [1, 3]),
    ([4, 4, 9, 4, 4], [], [2, 3, 5]),
    ([4, 4, 1, 1.5, 4, 4, 4], [], [2, 5, 7]),  # by count after half of the target
    ([4] * 9, [3], [2, 3, 5, 7, 9]),  # a logged end restarts the count
    ([10] * 3, [], [1, 2, 3]),
    # 2 of 12 samples are not logged, but EKF2 counted them
    ([4, 4, 8, 4, 4, 4, 4, 8, 4, 4], [], [2, 3, 5, 7, 8, 10]),
    ([2.75] * 7, [0, 6], [3, 6]),
    ([3.2] * 9, [0, 2, 6], [2, 4, 6, 8]),  # 2.5 samples, rounded as the log shows
])  # fmt: skip
def test_ekf2_step_ends_after_n_imu_samples_or_minimum_time(interval_ms, known, ends):
    found = find_step_ends(np.array(interval_ms) * 1e-3, np.array(known, int), 0.008)
    assert found.tolist() == ends


def test_downsampled_delta_velocity_is_in_frame_of_last_sample():
    """With 1 mrad per sample, earlier velocity changes are rotated by the later rotation."""
    turn = np.tile([0.0, 0.0, 0.001], (3, 1))
    gain = np.tile([1.0, 0.0, 0.0], (3, 1))
    total, gained = downsample_imu(turn, gain, np.array([2, 3]))
    assert_allclose(total[:, 2], [0.002, 0.001])
    assert_allclose(gained[:, 0], [2.0, 1.0])
    assert_allclose(gained[:, 1], [-0.002, -0.0005], atol=1e-12)


def facing(at: Any, error: Any = 0.0) -> np.ndarray:
    angle = 0.5 * (np.asarray(at) - 10.5) + error
    return np.column_stack([np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)])


def turning(states: np.ndarray) -> tuple[pd.DataFrame, pd.DataFrame, Ekf2, FusionRecord]:
    """Rotation of 0.5 rad/s about the vertical; EKF2 has estimated the gyro bias of 0.01 rad/s."""
    time = 10.0 + 0.005 * np.arange(401)
    imu = pd.DataFrame(0.0, index=time, columns=Columns.ANGULAR_RATE + Columns.SPECIFIC_FORCE)
    imu[Columns.ANGULAR_RATE[2]] = 0.51
    imu[Columns.SPECIFIC_FORCE] = [1.0, 0.2, -9.8]
    attitude = pd.DataFrame(facing(time[::4]), index=time[::4], columns=Columns.QUATERNION)
    turned = facing(states, 0.1 * (states - 10.0))
    delayed_state = pd.DataFrame(turned, index=states, columns=Columns.QUATERNION)
    delayed_state = delayed_state.assign(**dict.fromkeys(Columns.VELOCITY, 2.0), **{
        **dict.fromkeys(Columns.POSITION, np.nan), **dict.fromkeys(Columns.GYRO_BIAS, 0.0),
        **dict.fromkeys(Columns.ACCELEROMETER_BIAS, 0.2), Columns.GYRO_BIAS[2]: 0.01,
        **{name: 1.0 + n for n, name in enumerate(Columns.FUSION_HORIZON_VARIANCE)},
    })  # fmt: skip
    delayed_state["attitude_down_rad2"] = states
    state = pd.DataFrame(7.0, index=time, columns=Columns.STATE).assign(down_m=time)
    record = made(FusionRecord, delayed_state=delayed_state, parameters={}, status_flags={})
    return imu, attitude, made(Ekf2, state=state), record


def test_ekf2_replay_imu_input_equals_motion_of_turning_vehicle():
    flown = turning(10.0 + 0.1 * np.arange(21))
    found = _make_segment(*flown, 5, 11.5)
    steps = 10.5 + 0.01 * np.arange(101)
    assert_allclose(found.time_s, steps, atol=1e-9)
    assert_allclose(found.step_s, 0.01, atol=1e-9)
    turned = to_rotation_matrix(facing(steps))
    assert_allclose(found.body_to_ned, turned, atol=1e-6)
    assert_allclose(found.attitude_correction_rad, 0.0, atol=1e-6)
    # body frame at the end of the step, without bias
    assert_allclose(found.specific_force_m_s2, [[0.8, 0.0, -10.0]] * 100, atol=5e-3)
    assert_allclose(found.state[:3], [0.0, 0.0, 0.05], atol=1e-6)
    assert_allclose(found.state[3:9], [2.0, 2.0, 2.0, 7.0, 7.0, 10.5])
    assert_allclose(found.state[9:], 0.0)
    expected = np.arange(1.0, 16.0)
    expected[Columns.FUSION_HORIZON_VARIANCE.index("attitude_down_rad2")] = 10.5
    assert_allclose(found.variance, expected)
    assert_allclose(found.attitude_variance_rad2[:, 2], steps)
    assert_allclose(found.down_m, steps)
    assert_allclose(found.attitude_error_rad[:, 2], 0.05 + 0.1 * (steps - 10.5), atol=1e-6)
    assert found.starts_while_fusing
    flown[3].delayed_state[Columns.POSITION] = 3.0
    assert_allclose(_make_segment(*flown, 5, 11.5).state[6:9], [3.0, 3.0, 10.5])


def segments(monkeypatch, **parts: Any) -> list[tuple[float, float]]:
    """Return start and end of each segment of a 60 s flight with samples every 0.01 or 0.1 s."""
    found: list[tuple[float, float]] = []
    tenths = np.arange(0.0, 60.0, 0.1)
    usual = {
        "imu": np.arange(0.0, 60.0, 0.01), "attitude": np.arange(0.0, 60.0, 0.01),
        "vision": tenths, "fused": tenths, "airborne": NONE,
        "delayed_state": tenths[::5], "primary_instances": ((-np.inf, 0),),
    }  # fmt: skip
    given = SimpleNamespace(**{**usual, **parts})

    def keep(*inputs: Any) -> ReplaySegment:
        *_, record, at, high = inputs
        found.append((float(record.delayed_state.index[at]), round(float(high), 2)))
        return made(ReplaySegment, **dict.fromkeys(map(attrgetter("name"), fields(ReplaySegment))))

    monkeypatch.setattr("px4fuse.ekf2.replay_segments._make_segment", keep)
    monkeypatch.setattr("px4fuse.ekf2.replay_segments.CORRELATION_ESTIMATION_TIME_S", 0.0)
    imu, attitude, fused, delayed_state = (
        pd.DataFrame(index=each)
        for each in (given.imu, given.attitude, given.fused, given.delayed_state)
    )
    ekf2 = made(Ekf2, innovations={"north": fused}, primary_instances=given.primary_instances)
    record = made(FusionRecord, delayed_state=delayed_state)
    find_replay_segments(
        made(Flight, airborne=given.airborne),
        imu,
        attitude,
        ekf2,
        record,
        given.vision,
        is_gnss=False,
    )
    return found


def without(times: np.ndarray, low: float, high: float) -> np.ndarray:
    return times[(times < low + 1e-6) | (times > high - 1e-6)]


def test_ekf2_replay_segments_end_at_vision_and_imu_gaps(monkeypatch):
    imu, vision = np.arange(0.0, 60.0, 0.01), np.arange(0.0, 60.0, 0.1)
    assert segments(monkeypatch) == [(1.0, 59.99)]
    # 1 s of fusion, 4 s in the air
    late = np.arange(20.0, 60.0, 0.1)
    assert segments(monkeypatch, fused=late) == [(21.0, 59.99)]
    assert segments(monkeypatch, airborne=((10.0, 50.0), (52.0, 60.0))) == [(14.0, 59.99)]
    assert segments(monkeypatch, airborne=((70.0, 90.0),)) == [(1.0, 59.99)]
    # gaps above 2 s in vision and above 0.05 s in the IMU split the flight
    assert len(segments(monkeypatch, vision=without(vision, 30.0, 31.9))) == 1
    exactly = without(np.arange(0.0, 60.0, 0.125), 30.0, 32.0)
    assert len(segments(monkeypatch, vision=exactly)) == 1
    parted = segments(monkeypatch, vision=without(vision, 30.0, 32.2))
    assert parted == [(1.0, 30.0), (33.5, 59.99)]
    assert len(segments(monkeypatch, imu=without(imu, 30.0, 30.04))) == 1
    parted = segments(monkeypatch, imu=without(imu, 30.0, 30.07))
    assert [start for start, _ in parted] == [1.0, 31.5]
    # no segment is in a part of the flight before or after the IMU data
    assert segments(monkeypatch, imu=imu[imu < 20.0]) == [(1.0, 19.99)]
    assert [start for start, _ in segments(monkeypatch, imu=imu[imu > 40.0])] == [41.5]
    # another EKF2 instance has different states and splits the flight
    parted = segments(monkeypatch, primary_instances=((-np.inf, 0), (30.2, 1)))
    assert parted == [(1.0, 30.2), (31.5, 59.99)]
    # a segment has at least 10 s and ends 1 s after the last vision sample
    assert segments(monkeypatch, fused=np.arange(48.0, 60.0, 0.1))[0][0] == 49.0
    assert segments(monkeypatch, fused=np.arange(49.3, 60.0, 0.1)) == []
    assert segments(monkeypatch, fused=np.array([])) == []
    assert segments(monkeypatch, vision=np.arange(5.0, 40.0, 0.1)) == [(6.0, 40.9)]
    assert read_prediction_step_s(made(FusionRecord, parameters={})) == 0.01


@pytest.mark.parametrize(
    ("name", "suggestion"),
    [("EKF2_EVP_NOIS", "Did you mean EKF2_EVP_NOISE?"), ("EKF2_EV_CTRL", ""), ("EKF2_EV_QMIN", "")],
)
def test_parameter_error_suggests_name_only_if_it_is_mistyped(name: str, suggestion: str) -> None:
    with pytest.raises(SettingsError, match=f"does not contain the parameter {name}") as raised:
        check_parameters({name: 1.0})
    assert raised.value.remedy.startswith(f"{suggestion} Choose from".lstrip())
