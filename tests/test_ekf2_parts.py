"""The parts of the model of EKF2, each on numbers whose answer is known, and at its limits.

The limits are written out here, so that one that is changed must be changed here as well.
"""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from findings_tools import NONE, log, made
from scipy.spatial.transform import Rotation

from px4fuse.ekf2 import inputs as inputs_module
from px4fuse.ekf2.agreement import (
    _axis,
    _verdict,
    agreement_with_log,
    judged_from,
    logged_innovations,
    match,
    settled,
    with_obedient,
)
from px4fuse.ekf2.inputs import Inputs, Rules, prepare
from px4fuse.ekf2.legs import (
    FUSE,
    GRAVITY_M_S2,
    IDLE,
    START,
    Timing,
    _actions,
    _events,
    _noises,
    make_legs,
)
from px4fuse.ekf2.model import Model, replay_settings
from px4fuse.ekf2.parameters import PARAMETERS, check, fuses_by_mask, settings_in_force
from px4fuse.ekf2.recursion import (
    Run,
    Variant,
    _decide,
    _down_to,
    _drift,
    _Fusion,
    _limit_bias,
    run,
)
from px4fuse.ekf2.recursion import _measurements as measurements
from px4fuse.ekf2.replay import Agreement, AxisAgreement, Ekf2Replay
from px4fuse.ekf2.stretches import (
    Stretch,
    _counted,
    _stretch,
    down_sampled,
    find_stretches,
    predict_s,
)
from px4fuse.ekf2.stretches import step_ends as ends_of
from px4fuse.ekf2.vision import Vision, _decisions, _source, read_vision
from px4fuse.ekf2.walk import AxisWalk, Line, Student, _coast, _variants
from px4fuse.ekf2.walk import _to_truth as walk_to_truth
from px4fuse.ekf2.whatif import (
    AxisSummary,
    Summary,
    _longest,
    _notes,
    _sigma,
    _to_truth,
    sweep_values,
)
from px4fuse.errors import SettingsError
from px4fuse.flight import (
    ACCELEROMETER_BIAS_COLUMNS,
    ANGULAR_RATE_COLUMNS,
    DELAYED_VARIANCE_COLUMNS,
    GYRO_BIAS_COLUMNS,
    POSITION_COLUMNS,
    POSITION_VARIANCE_COLUMNS,
    QUATERNION_COLUMNS,
    SPECIFIC_FORCE_COLUMNS,
    STATE_COLUMNS,
    VELOCITY_COLUMNS,
    Ekf2,
    Flight,
    FusionRecord,
    PositionTrack,
    Reset,
    Truth,
    Unavailable,
)
from px4fuse.trajectory.rotation import (
    from_vector,
    interpolate,
    matrix,
    multiply,
    running_product,
    to_vector,
)

ALIGNED = "estimator_visual_odometry_aligned"
AID = ("estimator_aid_src_ev_pos",)

# ---------------------------------------------------------------- parameters


def test_parameters_are_px4s() -> None:
    """Defaults and ranges of PX4's module.yaml and params_*.yaml."""
    inf = math.inf
    assert {n: (p.default, p.minimum, p.maximum) for n, p in PARAMETERS.items()} == {
        "EKF2_EVP_NOISE": (0.1, 0.01, 1e3), "EKF2_EV_NOISE_MD": (0.0, 0.0, 1.0),
        "EKF2_EVP_GATE": (5.0, 1.0, 1e3), "EKF2_EV_DELAY": (0.0, 0.0, 300.0),
        "EKF2_DELAY_MAX": (200.0, 0.0, 1e3), "EKF2_EV_POS_X": (0.0, -inf, inf),
        "EKF2_EV_POS_Y": (0.0, -inf, inf), "EKF2_EV_POS_Z": (0.0, -inf, inf),
        "EKF2_ACC_NOISE": (0.35, 0.01, 1.0), "EKF2_GYR_NOISE": (0.015, 1e-4, 0.1),
        "EKF2_ACC_B_NOISE": (0.003, 0.0, 0.01), "EKF2_GYR_B_NOISE": (0.001, 0.0, 0.01),
        "EKF2_TAU_POS": (0.25, 0.1, 1.0), "EKF2_TAU_VEL": (0.25, 0.0, 1.0),
    }  # fmt: skip
    assert settings_in_force({})["EKF2_EV_DELAY"] == 0.0
    assert settings_in_force({"EKF2_AID_MASK": 8.0})["EKF2_EV_DELAY"] == 175.0
    assert settings_in_force({"EKF2_AID_MASK": 8.0, "EKF2_EV_DELAY": 50.0})["EKF2_EV_DELAY"] == 50.0
    assert not fuses_by_mask({"EKF2_AID_MASK": 8.0, "EKF2_EV_CTRL": 15.0})


@pytest.mark.parametrize(
    ("name", "fits", "not_fits"),
    [("EKF2_EVP_GATE", (1.0, 1e3), (0.99, 1001.0)), ("EKF2_EV_NOISE_MD", (0.0, 1.0), (0.5, 2.0)),
     ("EKF2_EV_POS_X", (-5.0, 5.0), (math.inf, math.nan))],
)  # fmt: skip
def test_both_ends_of_a_range_are_in_it(
    name: str, fits: tuple[float, ...], not_fits: tuple[float, ...]
) -> None:
    for value in fits:
        assert check({name: value}) == {name: value}
    for value in not_fits:
        unit = {"EKF2_EVP_GATE": " SD", "EKF2_EV_POS_X": " m"}.get(name, "")
        with pytest.raises(SettingsError, match=rf"{unit} \(default|only 0 and 1"):
            check({name: value})


def test_a_sweep_has_2_to_200_values() -> None:
    assert sweep_values("EKF2_EV_DELAY", 0.0, 100.0, 2) == [0.0, 100.0]
    assert len(sweep_values("EKF2_EV_DELAY", 0.0, 100.0, 200)) == 200
    assert len(sweep_values("EKF2_EV_DELAY", 0.0, 100.0)) == 9
    assert sweep_values("EKF2_EVP_NOISE", 0.01, 1.0, 3) == pytest.approx([0.01, 0.1, 1.0])
    for low, high, count in ((0.0, 100.0, 1), (0.0, 100.0, 201), (50.0, 50.0, 5)):
        with pytest.raises(SettingsError):
            sweep_values("EKF2_EV_DELAY", low, high, count)


# ---------------------------------------------------------------- rotations


def test_a_rotation_that_hardly_turns_keeps_its_size() -> None:
    tiny = np.array([1.0, 2e-14, -4e-14, 6e-14])
    for sign in (1.0, -1.0):
        np.testing.assert_allclose(to_vector(sign * tiny), [4e-14, -8e-14, 12e-14])
    vectors = np.random.default_rng(1).uniform(-1.5, 1.5, (20, 3))
    np.testing.assert_allclose(to_vector(from_vector(vectors)), vectors, atol=1e-12)


@pytest.mark.parametrize("count", [1, 2, 3, 8, 9, 10])
def test_a_running_product_is_the_product(count: int) -> None:
    turns = from_vector(np.random.default_rng(count).normal(0.0, 1.0, (count, 3)))
    product, one = running_product(turns), np.array([1.0, 0.0, 0.0, 0.0])
    for row, turn in zip(product, turns, strict=True):
        one = multiply(one, turn)
        np.testing.assert_allclose(row, one, atol=1e-12)


def test_between_two_quaternions_lies_their_middle() -> None:
    known = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, -1.0], [-1.0, 0.0, 0.0, 0.0]])
    middle = interpolate(np.array([0.5, 1.5]), np.arange(3.0), known)
    half = math.sqrt(0.5)
    np.testing.assert_allclose(np.abs(middle), [[half, 0.0, 0.0, half]] * 2)
    assert np.linalg.norm(middle, axis=1) == pytest.approx(1.0)


# ---------------------------------------------------------------- agreement


def replayed(fused_at: list[float], taken: list[float] | None = None) -> Any:
    index = pd.Index(fused_at if taken is None else taken)
    return SimpleNamespace(updates=pd.DataFrame({"fused_at_s": fused_at}, index=index))


def test_a_logged_innovation_belongs_to_the_sample_of_its_time() -> None:
    replay, logged = replayed([9.0, 9.0, 9.0], [1.0, 1.1, 1.2]), {"innovation_topics": AID}
    times = np.array([0.9, 0.9941, 1.0, 1.1059, 1.1061, 1.2, 1.3])
    assert match(replay, made(Ekf2, **logged), times).tolist() == [-1, 0, 0, 1, -1, 2, -1]


def test_an_older_topic_repeats_the_last_fusion_for_half_a_second() -> None:
    ekf2 = made(Ekf2, innovation_topics=("ekf2_innovations",))
    times = np.array([0.9998, 0.99995, 1.0, 1.5, 1.5001, 2.0, 2.4])
    found = match(replayed([1.0, 2.0], [0.8, 1.8]), ekf2, times)
    assert found.tolist() == [-1, 0, 0, 0, -1, 1, 1]


def test_the_first_five_seconds_of_each_stretch_are_not_judged() -> None:
    judged = judged_from(SimpleNamespace(stretches=((10.0, 30.0), (40.0, 60.0))))  # type: ignore[arg-type]
    assert judged == ((15.0, 30.0), (45.0, 60.0))
    times = np.array([15.0, 15.1, 29.9, 30.0, 45.0, 50.0, 60.0])
    assert settled(times, judged).tolist() == [False, True, True, False, False, True, False]


def agreeing(correlation: float = 1.0, s: float = 1.0, nis: float = 1.0) -> AxisAgreement:
    return AxisAgreement(correlation, 0.0, s, s, s, 1.0, nis, 0.0, 0.0)


@pytest.mark.parametrize(
    ("axis", "logged", "replayed_share", "good", "says"),
    [
        (agreeing(s=1.049), 0.0, 0.0, True, "correlate by 1.0000 or better"),
        (agreeing(s=1.051), 0.0, 0.0, False, "is 1.05 of the logged one"),
        (agreeing(s=0.949), 0.0, 0.0, False, "is 0.95 of the logged one"),
        (agreeing(0.95), 0.0, 0.0, True, "correlate by 0.9500"),
        (agreeing(0.949), 0.0, 0.09, False, "correlate by 0.95 only"),
        # where much is rejected, shares and NIS decide
        (agreeing(0.5), 0.1, 0.06, True, "6.0% of the samples are rejected, 10.0% in the log"),
        (agreeing(0.5), 0.06, 0.1, True, "single samples part"),
        (agreeing(0.5), 0.25, 0.19, False, "are allowed"),
        (agreeing(0.5), 0.125, 0.1875, False, "are allowed"),
        (agreeing(0.5, nis=1.25), 0.1, 0.1, True, "mean NIS differs by 25%"),
        (agreeing(0.5, nis=1.26), 0.1, 0.1, False, "mean NIS differs by 26%"),
        (agreeing(0.5, nis=0.74), 0.1, 0.1, False, "mean NIS differs by 26%"),
    ],
)  # fmt: skip
def test_when_a_replay_is_believed(
    axis: AxisAgreement, logged: float, replayed_share: float, good: bool, says: str
) -> None:
    for axes in ({"north": axis, "east": agreeing()}, {"north": agreeing(), "east": axis}):
        found, reason = _verdict(axes, logged, replayed_share)
        assert found is good
        assert says in reason


@pytest.mark.parametrize(("correlation", "good"), [(0.95, True), (0.949, False)])
def test_a_replay_that_rejects_what_ekf2_rejected_must_agree(
    correlation: float, good: bool
) -> None:
    one = Agreement({"north": agreeing(0.5)}, 50, 0.2, 0.2, 0.9, True, "so far")
    axes = {"north": agreeing(), "east": agreeing(correlation)}
    found = with_obedient(one, replace(one, axes=axes))
    assert found.good is good
    assert f"the innovations correlate by {correlation:.3f}" in found.reason
    assert found.reason.startswith("so far; ") is good


def test_what_an_axis_is_compared_by() -> None:
    s_log = np.full(101, 4.0)
    s = np.linspace(4.0, 8.0, 101)
    nu_log = np.tile([2.0, -2.0], 51)[:101]
    frame = {"innovation_east_m": nu_log, "innovation_variance_east_m2": s_log}
    model = pd.DataFrame({"innovation_east_m": nu_log + 0.5, "innovation_variance_east_m2": s})
    index = pd.Index([16.0, 17.0, 99.0])
    still = pd.DataFrame(0.0, index=index, columns=STATE_COLUMNS)
    off = still.assign(**{STATE_COLUMNS[1]: [3.0, 4.0, 50.0], STATE_COLUMNS[4]: 0.25})
    replay = SimpleNamespace(published=off, stretches=((10.0, 20.0),))
    found = _axis("east", pd.DataFrame(frame), model, made(Ekf2, state=still), replay)  # type: ignore[arg-type]
    assert found.innovation_correlation == pytest.approx(1.0)
    assert found.innovation_rms_difference_m == pytest.approx(0.5)
    assert (found.s_ratio_p5, found.s_ratio_median, found.s_ratio_p95) == pytest.approx(
        (1.05, 1.5, 1.95)
    )
    assert found.nis_mean_logged == pytest.approx(1.0)
    assert found.nis_mean_replayed == pytest.approx(np.mean((nu_log + 0.5) ** 2 / s))
    assert found.position_rms_difference_m == pytest.approx(math.sqrt(12.5))
    assert found.velocity_rms_difference_m_s == pytest.approx(0.25)


def compared(count: int, *, varying: bool = True) -> Agreement | Unavailable:
    """A log and a replay of itself, judged on this many samples."""
    time = 10.0 + np.arange(count + 5.0)
    rng = np.random.default_rng(2)
    nu = rng.normal(0.0, 0.1, len(time)) if varying else np.full(len(time), 0.1)
    frame = pd.DataFrame(
        {"innovation_m": nu, "innovation_variance_m2": 0.01, "rejected": 0.0}, index=time
    )
    frame.loc[frame.index[-2:], "rejected"] = 1.0
    state = pd.DataFrame(0.0, index=time, columns=STATE_COLUMNS)
    ekf2 = made(
        Ekf2, innovations={"north": frame, "east": frame}, innovation_topics=AID, state=state
    )
    updates = pd.DataFrame({"rejected": 0.0, "fused_at_s": time}, index=time)
    for axis in ("north", "east"):
        updates[f"innovation_{axis}_m"] = nu
        updates[f"innovation_variance_{axis}_m2"] = 0.01
    updates.loc[updates.index[-1], "rejected"] = 1.0
    replay = SimpleNamespace(updates=updates, published=state, stretches=((9.5, 999.0),))
    return agreement_with_log(SimpleNamespace(ekf2=ekf2), replay)  # type: ignore[arg-type]


def test_twenty_innovations_are_enough_to_compare() -> None:
    found = compared(20)
    assert isinstance(found, Agreement)
    assert found.samples == 20
    assert found.good
    shares = found.rejected_share_logged, found.rejected_share_replayed, found.same_share
    assert shares == pytest.approx((0.1, 0.05, 0.95))
    assert isinstance(few := compared(19), Unavailable)
    assert "19 logged innovations to compare with are too few (at least 20)" in few.reason
    assert isinstance(same := compared(20, varying=False), Unavailable)
    assert "do not vary" in same.reason


def test_without_innovations_there_is_nothing_to_compare() -> None:
    frame = pd.DataFrame({"innovation_m": [0.1], "innovation_variance_m2": 0.1, "rejected": 0.0})
    ekf2 = made(Ekf2, innovations={"north": frame, "east": NONE}, innovation_topics=AID)
    assert logged_innovations(ekf2).empty
    unknown = frame.assign(rejected=np.nan)
    ekf2 = made(Ekf2, innovations={"north": frame, "east": unknown}, innovation_topics=AID)
    assert logged_innovations(ekf2).empty


# ---------------------------------------------------------------- inputs and vision


def flown(
    monkeypatch: pytest.MonkeyPatch, *, interval_s: float = 0.008, **record: Any
) -> Inputs | Unavailable:
    """What is prepared of a flight of which only the parameters matter."""
    monkeypatch.setattr(inputs_module, "read_vision", lambda *_: made(Vision))
    monkeypatch.setattr(inputs_module, "find_stretches", lambda *_: (made(Stretch),))
    parts = {"parameters": {}, "other_aiding": (), "per_step_biases": False, **record}
    fusing = parts.pop("fusing", pd.DataFrame({"vertical": [1.0, 0.0]}))
    horizon = parts.pop("horizon_s", 0.1)
    firmware = parts.pop("firmware", "PX4 v1.16.1")
    ekf2 = made(
        Ekf2, record=made(FusionRecord, **parts), innovations={"north": pd.DataFrame()},
        horizon_s=horizon, step_s=0.01, fusing=fusing,
    )  # fmt: skip
    imu = pd.DataFrame(index=interval_s * np.arange(2))
    return prepare(made(Flight, imu=imu, attitude=imu, ekf2=ekf2, log=log(firmware=firmware)))


def test_rules_of_the_releases(monkeypatch: pytest.MonkeyPatch) -> None:
    """EV_MAX_INTERVAL, ev_control.cpp; no_aid_timeout_max and reset_timeout_max, common.h."""
    new = flown(monkeypatch, parameters={"EKF2_DELAY_MAX": 200.0, "EKF2_IMU_POS_Y": 0.25})
    assert isinstance(new, Inputs)
    assert new.rules == Rules(0.2, 0.4, 1.0, 5, None, False)
    assert new.imu_offset_m.tolist() == [0.0, 0.25, 0.0]
    assert (new.step_s, new.horizon_s, new.predict_s, new.max_leg_s) == (0.01, 0.1, 0.01, 0.25)
    old = flown(monkeypatch, parameters={"EKF2_AID_MASK": 8.0}, per_step_biases=True)
    assert isinstance(old, Inputs)
    assert old.rules == Rules(math.inf, 7.0, 7.0, 1_000_000, pytest.approx(5e-4), True)
    assert old.settings["EKF2_EV_DELAY"] == 175.0
    predict = flown(monkeypatch, parameters={"EKF2_PREDICT_US": 8000.0})
    assert isinstance(predict, Inputs)
    assert predict.predict_s == pytest.approx(0.008)


def test_what_a_log_must_hold(monkeypatch: pytest.MonkeyPatch) -> None:
    assert isinstance(flown(monkeypatch, interval_s=0.012), Inputs)
    slow = flown(monkeypatch, interval_s=0.0125)
    assert isinstance(slow, Unavailable)
    assert "logged at 80 Hz" in slow.reason
    assert isinstance(flown(monkeypatch, horizon_s=NONE), Unavailable)
    oldest = flown(monkeypatch, horizon_s=NONE, firmware="PX4 v1.13.3")
    assert isinstance(oldest, Inputs)
    assert oldest.horizon_s == 0.0
    for vertical, there in (([1.0, 0.0], False), ([1.0, 1.0, 0.0], True)):
        fusing = pd.DataFrame({"vertical": vertical})
        one = flown(monkeypatch, fusing=fusing)
        assert isinstance(one, Inputs)
        assert one.vision_height is there
    none = flown(monkeypatch, fusing=NONE)
    assert isinstance(none, Inputs)
    assert none.vision_height is False


def track(name: str, rung: int, interval_s: float = 0.1, **parts: Any) -> PositionTrack:
    time = 10.0 + interval_s * np.arange(30)
    samples = pd.DataFrame(1.0, index=time, columns=POSITION_COLUMNS + POSITION_VARIANCE_COLUMNS)
    usual = {"frame": "NED", "orientation": None, "topics": (name,)}
    return made(PositionTrack, name=name, rung=rung, samples=samples, **{**usual, **parts})


@pytest.mark.parametrize(
    ("tracks", "expected"),
    [
        ([track("file", 1), track("vehicle_visual_odometry", 2)], "vehicle_visual_odometry"),
        ([track("file", 1), track("gps", 7)], "file"), ([track("mocap", 3)], None),
        # copies that the logger did not thin: below 0.9 of its interval, and 4 Hz at least
        ([track(ALIGNED, 4, 0.179)], ALIGNED), ([track(ALIGNED, 4, 0.181)], None),
        ([track("estimator_aid_src_ev_pos", 5, 0.25)], "estimator_aid_src_ev_pos"),
        ([track("estimator_aid_src_ev_pos", 5, 0.26)], None),
    ],
)  # fmt: skip
def test_the_track_that_ekf2_received_whole(
    tracks: list[PositionTrack], expected: str | None
) -> None:
    found = _source(made(Flight, positions=tuple(tracks)))
    assert getattr(found, "name", None) == expected


def test_a_frame_of_its_own_is_turned_with_its_variance() -> None:
    """Published heading 90°, sent 0°: what was sent as north lies east."""
    time = 10.0 + 0.1 * np.arange(30)

    def facing(heading: float) -> pd.DataFrame:
        q = Rotation.from_euler("z", heading, degrees=True).as_quat(scalar_first=True)
        return pd.DataFrame([q] * 30, index=time, columns=QUATERNION_COLUMNS)

    own = track("vehicle_visual_odometry", 2, frame="FRD", orientation=facing(0.0))
    own.samples[POSITION_COLUMNS] = [2.0, 0.5, -1.0]
    own.samples[POSITION_VARIANCE_COLUMNS] = [0.04, np.nan, 0.09]
    for parameters, yaw, turned in (
        ({}, 0.0, True), ({}, 1.0, False), ({"EKF2_AID_MASK": 64.0}, 1.0, True),
        ({"EKF2_AID_MASK": 8.0}, 0.0, False),
    ):  # fmt: skip
        ages = pd.Series([0.05, 0.15], index=[time[0], time[-1]])
        record = made(FusionRecord, parameters=parameters, vision_age_s=ages)
        ekf2 = made(
            Ekf2, fusing=pd.DataFrame({"yaw": [0.0, yaw]}), innovations={"north": NONE},
            record=record, horizon_s=0.1, innovation_topics=AID,
        )  # fmt: skip
        found = read_vision(made(Flight, positions=(own,)), ekf2, record, facing(90.0))
        assert isinstance(found, Vision)
        where = [-0.5, 2.0, -1.0] if turned else [2.0, 0.5, -1.0]
        np.testing.assert_allclose(found.position_m, [where] * 30, atol=1e-12)
        spread = [0.0, 0.04, 0.09] if turned else [0.04, 0.0, 0.09]
        np.testing.assert_allclose(found.variance_m2, [spread] * 30, atol=1e-12)
        np.testing.assert_allclose(found.arrival_s - time, np.linspace(0.05, 0.15, 30))
    copy = track("estimator_aid_src_ev_pos", 5)
    found = read_vision(made(Flight, positions=(copy,)), ekf2, record, facing(90.0))
    assert isinstance(found, Vision)
    assert np.all(found.arrival_s == -np.inf)


def test_what_ekf2_did_with_a_sample_is_found_by_its_time() -> None:
    """Measured half a step and the delay before its stamp, to 6 ms; resets show within 0.2 s."""
    stamp = 10.0 + 0.5 * np.arange(6)
    taken = stamp - 0.05 - 0.005
    off = np.array([0.0, 0.0059, -0.0059, 0.0061, -0.0061, 0.0])
    logged = pd.DataFrame({"rejected": [1.0, 1.0, 0.0, 1.0, 1.0, 0.0]}, index=taken + off)
    shown = taken + 0.1
    resets = (
        Reset(float(shown[0]) + 0.19, "position", (1.0, 0.0, 0.0)),
        Reset(float(shown[1]) + 0.21, "position", (1.0, 0.0, 0.0)),  # too late
        Reset(float(shown[2]) + 0.1, "position", (0.0, 0.0, 1.0)),  # of the height
        Reset(float(shown[3]) + 0.1, "velocity", (1.0, 0.0, 0.0)),
        Reset(float(shown[4]), "position", (0.0, 1.0, 0.0)),
        Reset(float(shown[5]) + 0.1, "position", (0.0, 1.0, 0.0)),  # of what was fused
    )
    record = made(FusionRecord, parameters={"EKF2_EV_DELAY": 50.0})
    parts = {
        "innovations": {"north": logged}, "horizon_s": 0.1, "step_s": 0.01, "resets": resets,
        "innovation_topics": AID,
    }  # fmt: skip
    rejected, reset = _decisions(made(Ekf2, **parts), record, stamp)
    np.testing.assert_array_equal(rejected, [1.0, 1.0, 0.0, np.nan, np.nan, 0.0])
    assert reset.tolist() == [True, False, False, False, True, False]
    for other in ({"innovation_topics": ()}, {"horizon_s": NONE}, {"innovations": {"north": NONE}}):
        rejected, reset = _decisions(made(Ekf2, **{**parts, **other}), record, stamp)
        assert np.isnan(rejected).all()
        assert not reset.any()


# ---------------------------------------------------------------- steps and legs


def test_a_step_ends_after_its_samples_or_when_it_is_long() -> None:
    assert _counted(np.array([0.004] * 5), 2, 0.008) == [2, 4]
    assert _counted(np.array([0.004, 0.009, 0.004, 0.004]), 2, 0.008) == [2, 4]
    assert _counted(np.array([0.009, 0.004, 0.004]), 2, 0.008) == [1, 3]
    assert _counted(np.array([0.005] * 6), 3, 0.0155) == [3, 6]
    # by count only when more than half of the step has passed
    assert _counted(np.array([0.002, 0.002, 0.0021]), 2, 0.008) == [3]
    assert ends_of(np.full(9, 0.004), np.array([3]), 0.008).tolist() == [2, 3, 5, 7, 9]
    assert ends_of(np.full(6, 0.004), np.array([], int), 0.008).tolist() == [2, 4, 6]
    assert ends_of(np.full(3, 0.01), np.array([], int), 0.008).tolist() == [1, 2, 3]
    late = np.array([0.004, 0.004, 0.009, 0.004, 0.004])
    assert ends_of(late, np.array([], int), 0.008).tolist() == [2, 3, 5]


def test_a_gain_is_seen_from_the_end_of_its_step() -> None:
    """A turn of 1 mrad each sample: what was gained before lies turned by what came after."""
    turn = np.tile([0.0, 0.0, 0.001], (3, 1))
    gain = np.tile([1.0, 0.0, 0.0], (3, 1))
    total, gained = down_sampled(turn, gain, np.array([2, 3]))
    np.testing.assert_allclose(total[:, 2], [0.002, 0.001])
    np.testing.assert_allclose(gained[:, 0], [2.0, 1.0])
    np.testing.assert_allclose(gained[:, 1], [-0.002, -0.0005], atol=1e-12)


@pytest.mark.parametrize("n", [4, 200])
def test_unit_noise_at_the_end_of_a_leg_is_that_of_its_steps(n: int) -> None:
    """Step by step: θ gains unit noise · dt, v turns with it, p follows v."""
    dt = 0.008
    force = np.array([0.3, -0.2, -9.8])
    tilt = -np.array(
        [[0.0, -force[2], force[1]], [force[2], 0.0, -force[0]], [-force[1], force[0], 0.0]]
    ) * dt  # fmt: skip
    F = np.eye(9)
    F[3:6, 0:3] = tilt
    F[6:9, 3:6] = dt * np.eye(3)
    sums = np.zeros((2, 9, 9))
    for _ in range(n):
        for at, rows in enumerate((slice(0, 3), slice(3, 6))):
            sums[at] = F @ sums[at] @ F.T
            sums[at][rows, rows] += dt**2 * np.eye(3)
    made_at_once = _noises(np.array([float(n)]), np.array([n * dt]), (n * tilt)[None])
    # of the gyro, leading terms of position alone with velocity and itself
    sums[0][6:9, 3:9] = made_at_once[0][0, 6:9, 3:9] if n == 4 else sums[0][6:9, 3:9]
    sums[0][3:6, 6:9] = sums[0][6:9, 3:6].T
    for found, true in zip(made_at_once, sums, strict=True):
        scale = np.sqrt(np.outer(np.diag(true), np.diag(true)))
        scale[scale == 0.0] = 1.0
        assert np.max(np.abs(found[0] - true) / scale) < (1e-9 if n == 4 else 0.03)
    one_step = _noises(np.array([1.0]), np.array([dt]), tilt[None])
    np.testing.assert_allclose(np.diag(one_step[1][0])[3:6], dt**2)
    np.testing.assert_allclose(np.diag(one_step[1][0])[6:9], 0.0, atol=1e-18)


RULES = Rules(0.2, 0.4, 1.0, 5, None, False)


def stretch_of(count: int, *, fusing: bool = True) -> Stretch:
    return made(Stretch, time_s=10.0 + 0.01 * np.arange(count + 1), fusing=fusing)


def vision_of(stamps: list[float], age_s: float = 0.0) -> Vision:
    stamp = np.array(stamps)
    return made(Vision, stamp_s=stamp, arrival_s=stamp + age_s)


def acting(stamps: list[float], *, fusing: bool = True, rules: Rules = RULES) -> list[int]:
    stretch = stretch_of(500, fusing=fusing)
    taken = np.array(stamps)
    end = np.searchsorted(stretch.time_s, taken - 1e-9)
    inputs = made(Inputs, rules=rules)
    action, _ = _actions(inputs, stretch, taken, end, np.ones(len(taken), bool))
    return action.tolist()


def test_fusion_starts_on_the_second_of_two_samples_and_stops_in_silence() -> None:
    assert acting([10.1, 10.3, 10.45], fusing=False) == [IDLE, IDLE, START]
    assert acting([10.1, 10.29, 10.45], fusing=False) == [IDLE, START, FUSE]
    assert acting([10.1, 10.29, 10.45]) == [FUSE, FUSE, FUSE]
    # 0.4 s to the step before
    assert acting([10.1, 10.5, 10.6]) == [FUSE, FUSE, FUSE]
    assert acting([10.1, 10.53, 10.6]) == [FUSE, IDLE, START]
    old = replace(RULES, start_interval_s=math.inf, stop_s=7.0)
    assert acting([10.1, 12.0, 14.9], fusing=False, rules=old) == [IDLE, START, FUSE]


def events(
    stamps: list[float], *, delay_s: float = 0.0, age_s: float = -9.0, horizon_s: float = 0.0
) -> Any:
    inputs = made(Inputs, vision=vision_of(stamps, age_s), step_s=0.01, rules=RULES, max_leg_s=0.25)
    return _events(inputs, stretch_of(100), Timing(delay_s, horizon_s))


def test_a_sample_is_fused_at_the_end_of_the_step_of_its_measurement() -> None:
    """Half a step and the delay before its stamp; events without one where vision is silent."""
    found = events([10.2, 10.305, 10.9])
    seen = found.sample >= 0
    assert found.sample.tolist() == [0, 1, -1, -1, 2]
    assert found.end[seen].tolist() == [20, 30, 90]
    assert found.end[~seen].tolist() == [50, 70]
    assert found.time_s == pytest.approx([10.195, 10.3, 10.5, 10.7, 10.895])
    assert found.usable[seen].all()
    assert not found.usable[~seen].any()
    assert found.action.tolist() == [FUSE, FUSE, IDLE, IDLE, IDLE]
    assert events([10.2, 10.305], delay_s=0.05).end[:2].tolist() == [15, 25]
    assert events([10.505]).sample[:3].tolist() == [-1, -1, 0]
    # in the first step, and before it
    assert events([10.01]).usable[0]
    assert events([10.01]).end[0] == 1
    assert not events([10.004]).usable[0]
    # of two samples in one step the newer one
    assert events([10.2, 10.202]).usable[:2].tolist() == [False, True]


@pytest.mark.parametrize(
    ("age_s", "late", "lost"),
    [(0.22, False, False), (0.24, True, False), (0.28, True, False), (0.31, False, True)],
)
def test_a_sample_that_comes_after_the_horizon_is_late_or_lost(
    age_s: float, late: bool, lost: bool
) -> None:
    """Due 0.2 s after its stamp: late by more than 0.03 s, lost from 0.1 s on."""
    found = events([10.2, 10.4], age_s=age_s, horizon_s=0.2)
    assert (bool(found.late[0]), bool(found.lost[0])) == (late, lost)
    assert bool(found.usable[0]) is not lost


# ---------------------------------------------------------------- the recursion


def test_a_variance_is_brought_down_to_its_target() -> None:
    variance, target = np.array([0.5, 4.0, 0.1]), np.array([0.2, 3.5, 0.2])
    noise = _down_to(variance, target)
    np.testing.assert_allclose(variance[:2] * noise[:2] / (variance + noise)[:2], target[:2])
    assert noise[2] == 1e9


def test_biases_gain_variance_per_step_up_to_the_noise() -> None:
    knob = {
        f"EKF2_{name}_NOISE": np.array([value])
        for name, value in (("GYR", 0.015), ("ACC", 0.35), ("GYR_B", 0.001), ("ACC_B", 0.003))
    }
    inputs, yes, no = made(Inputs, step_s=0.01), np.array([True]), np.array([False])
    drift, limit = _drift(inputs, knob, yes, yes)
    np.testing.assert_allclose(drift, [[1e-10] * 3 + [9e-10] * 3])
    np.testing.assert_allclose(limit, [[0.015**2] * 3 + [0.35**2] * 3])
    np.testing.assert_allclose(_drift(inputs, knob, no, yes)[0], [[1e-10] * 3 + [0.0] * 3])
    np.testing.assert_allclose(_drift(inputs, knob, yes, no)[0], [[0.0] * 3 + [9e-10] * 3])


def test_the_variance_of_a_bias_stays_within_px4s_limits() -> None:
    P = np.zeros((2, 15, 15))
    for each in P:
        np.fill_diagonal(each[12:, 12:], [4.0, 1e-3, 0.1])
    _limit_bias(P, 5e-4, np.array([True, False]))
    # 0.1 g at most, a ratio of 100 between the axes at least
    np.testing.assert_allclose(np.diag(P[0])[12:], [0.980665**2, 0.04, 0.1])
    np.testing.assert_allclose(np.diag(P[1])[12:], [4.0, 1e-3, 0.1])
    np.fill_diagonal(P[0][12:, 12:], [1e-3, 1e-5, 1e-3])
    _limit_bias(P, 5e-4, np.array([True, False]))
    np.testing.assert_allclose(np.diag(P[0])[12:], [1e-3, 5e-4, 1e-3])


def test_what_counts_as_measurement_and_noise() -> None:
    vision = made(
        Vision, position_m=np.array([[1.0, 2.0, 3.0]]), variance_m2=np.array([[0.04, 0.0001, 0.0]])
    )
    turned = Rotation.from_euler("z", 90.0, degrees=True).as_matrix()
    stretch = made(Stretch, rotation=np.array([np.eye(3), turned]))
    legs = [SimpleNamespace(sample=np.array([0]), end=np.array([1]))]
    knob = {
        "EKF2_EVP_NOISE": np.array([0.1, 0.001]), "EKF2_EV_NOISE_MD": np.array([0.0, 1.0]),
        "EKF2_EV_POS_X": np.array([0.0, 0.3]), "EKF2_EV_POS_Y": np.zeros(2),
        "EKF2_EV_POS_Z": np.zeros(2),
    }  # fmt: skip
    inputs = made(Inputs, vision=vision, imu_offset_m=np.zeros(3))
    which = np.zeros(2, np.intp)
    position, noise = measurements(inputs, stretch, legs, which, knob)  # type: ignore[arg-type]
    # 0.3 m ahead of a body that faces east: the body is west of the sensor
    np.testing.assert_allclose(position[0], [[1.0, 2.0, 3.0], [1.0, 1.7, 3.0]], atol=1e-12)
    # what is reported, EKF2_EVP_NOISE at least; or that alone, 1 cm at least
    np.testing.assert_allclose(noise[0], [[0.04, 0.01, 0.01], [1e-4, 1e-4, 1e-4]])


def deciding(
    *, action: int = FUSE, startable: bool = False, gated: bool = True, obeys: bool = False,
    told: float = np.nan, told_reset: bool = False, outside: bool = True, silent_s: float = 0.5,
    stopped: bool = False, left: int = 5,
) -> tuple[bool, bool, bool, float, bool, int]:  # fmt: skip
    """What is rejected, taken and reset at 10 s; then last fusion, whether stopped, resets left."""
    schedule = SimpleNamespace(
        action=np.array([[action]]), startable=np.array([[startable]]), time_s=np.array([[10.0]]),
        gated=np.array([gated]), obeys=np.array([obeys]), told=np.array([told]),
        told_reset=np.array([told_reset]),
    )  # fmt: skip
    before = _Fusion(np.array([10.0 - silent_s]), np.array([stopped]), np.array([left]))
    rejected, taken, reset, after = _decide(RULES, schedule, 0, np.array([outside]), before)  # type: ignore[arg-type]
    last, stop, rest = after.last_s[0], after.stopped[0], after.left[0]
    return bool(rejected[0]), bool(taken[0]), bool(reset[0]), float(last), bool(stop), int(rest)


@pytest.mark.parametrize(
    ("case", "expected"),
    [
        ({"outside": False}, (False, True, False, 10.0, False, 5)),
        ({}, (True, False, False, 9.5, False, 5)),
        ({"silent_s": 1.0}, (True, False, False, 9.0, False, 5)),
        ({"silent_s": 1.5}, (True, False, True, 10.0, False, 4)),
        ({"silent_s": 1.5, "left": 1}, (True, False, True, 10.0, False, 0)),
        ({"silent_s": 1.5, "left": 0}, (True, False, False, 8.5, True, 0)),
        ({"gated": False}, (False, True, False, 10.0, False, 5)),
        ({"action": START, "left": 2}, (False, False, True, 10.0, False, 5)),
        ({"stopped": True, "outside": False}, (False, False, False, 9.5, True, 5)),
        ({"stopped": True, "startable": True, "left": 0}, (True, False, True, 10.0, False, 5)),
        ({"action": IDLE}, (False, False, False, 9.5, False, 5)),
        # as the log tells
        ({"obeys": True, "told": 0.0}, (False, True, False, 10.0, False, 5)),
        ({"obeys": True, "told": 1.0, "outside": False}, (True, False, False, 9.5, False, 5)),
        ({"obeys": True, "told": 1.0, "silent_s": 9.0, "left": 0},
         (True, False, False, 1.0, False, 0)),
        ({"obeys": True, "told": 1.0, "told_reset": True}, (True, False, True, 10.0, False, 5)),
        ({"obeys": True}, (True, False, False, 9.5, False, 5)),
        ({"told": 0.0}, (True, False, False, 9.5, False, 5)),
    ],
)  # fmt: skip
def test_what_is_decided_of_a_sample(case: dict[str, Any], expected: tuple[Any, ...]) -> None:
    assert deciding(**case) == expected


@pytest.mark.parametrize(
    ("settings", "by_delay", "timing"),
    [
        ({"EKF2_EV_DELAY": 50.0}, False, Timing(0.05, 0.12)),
        ({"EKF2_DELAY_MAX": 300.0}, False, Timing(0.0, 0.29)),
        ({"EKF2_DELAY_MAX": 301.0}, False, Timing(0.0, 0.3)),
        ({"EKF2_DELAY_MAX": 0.0}, False, Timing(0.0, 0.01)),
        ({"EKF2_EV_DELAY": 50.0}, True, Timing(0.05, 0.12)),
        ({"EKF2_EV_DELAY": 200.0}, True, Timing(0.2, 0.19)),
    ],
)
def test_the_horizon_is_the_length_of_the_buffer(
    settings: dict[str, float], by_delay: bool, timing: Timing
) -> None:
    usual = {"EKF2_EV_DELAY": 0.0, "EKF2_DELAY_MAX": 200.0}
    rules = replace(RULES, horizon_by_delay=by_delay)
    inputs = made(Inputs, rules=rules, settings=usual, horizon_s=0.12, step_s=0.01, predict_s=0.01)
    found = Variant({**usual, **settings}).timing(inputs)
    assert (found.delay_s, found.horizon_s) == pytest.approx((timing.delay_s, timing.horizon_s))
    shifted = Variant(usual, stamp_offset_s=0.03).timing(inputs)
    assert (shifted.delay_s, shifted.horizon_s) == pytest.approx((-0.035, math.inf))


def test_a_release_without_delay_max_has_none() -> None:
    rules = replace(RULES, horizon_by_delay=True)
    inputs, flight = made(Inputs, rules=rules), SimpleNamespace(log=log(firmware="PX4 v1.14"))
    model = made(Model, inputs=inputs, flight=flight)
    with pytest.raises(SettingsError, match=r"PX4 v1\.14 has no such parameter"):
        replay_settings(model, [{"EKF2_DELAY_MAX": 100.0}])
    assert replay_settings(model, []) == ()


def at_rest(
    measured_m: list[float], told: float = np.nan, down_m: float = 0.0, **settings: float
) -> Run:
    """A level vehicle that stands still at the origin, seen at 10 Hz at these places north.

    EKF2 itself rejected the fourth sample where that is told.
    """
    count = 10 * (len(measured_m) + 1)
    flat = np.zeros((count, 3))
    stretch = Stretch(
        time_s=10.0 + 0.01 * np.arange(count + 1), step_s=np.full(count, 0.01),
        rotation=np.tile(np.eye(3), (count + 1, 1, 1)), correction_rad=flat,
        force_m_s2=flat - GRAVITY_M_S2, gyro_bias_rad_s=np.zeros(3),
        accelerometer_bias_m_s2=np.zeros(3), state=np.zeros(15), variance=np.full(15, 1e-4),
        down_m=np.full(count + 1, down_m), heading_variance_rad2=np.full(count + 1, 1e-4),
        down_variance_m2=np.full(count + 1, 4e-4), attitude_error_rad=np.zeros((count + 1, 3)),
        correlation=np.eye(15),
    )  # fmt: skip
    stamp = 10.105 + 0.1 * np.arange(len(measured_m))
    north = np.array(measured_m)
    vision = Vision(
        stamp, np.full(len(stamp), -np.inf), np.column_stack([north, 0.0 * north, 0.0 * north]),
        np.zeros((len(stamp), 3)), np.full(len(stamp), np.nan), np.zeros(len(stamp), bool), "uwb",
    )  # fmt: skip
    vision.rejected[3] = told
    inputs = Inputs(
        settings_in_force(settings), (stretch,), vision, RULES, 0.01, 0.1, 0.01,
        vision_height=False, imu_offset_m=np.zeros(3),
    )  # fmt: skip
    legs = make_legs(inputs, stretch, Timing(0.0, 0.1))
    variant = Variant(inputs.settings, as_logged=True)
    return run(inputs, stretch, [legs], np.zeros(1, np.intp), [variant])


def test_a_vehicle_at_rest_stays_and_its_variance_is_the_kalman_filters() -> None:
    done = at_rest([0.0] * 20)
    np.testing.assert_allclose(done.state, 0.0, atol=1e-9)
    assert done.fused.all()
    np.testing.assert_allclose(done.noise_m2, 0.01)
    # P after = P R / (P + R), each of north and east alone
    before, after = done.variance_m2[0, 0] - 0.01, done.variance[1, 0, 6:8]
    np.testing.assert_allclose(after, before * 0.01 / (before + 0.01), rtol=1e-3)
    # the first 0.1 s: position 1e-4 and velocity 1e-4 over it, and what tilt and noise add
    assert before[0] == pytest.approx(1e-4 + 1e-4 * 0.1**2, rel=0.05)
    # heading and height have the variances of EKF2's own
    np.testing.assert_allclose(done.variance[1:, 0, 2], 1e-4, rtol=0.01)
    assert done.variance[-1, 0, 8] == pytest.approx(4e-4, rel=0.01)


def test_a_step_of_the_source_is_rejected_for_a_second_and_then_reset_to() -> None:
    done = at_rest([0.0] * 5 + [3.0] * 15)
    rejected, reset, fused = done.rejected[:, 0], done.reset[:, 0], done.fused[:, 0]
    assert np.flatnonzero(rejected).tolist() == list(range(5, 16))
    assert np.flatnonzero(reset).tolist() == [15]
    assert np.flatnonzero(fused).tolist() == [*range(5), *range(16, 20)]
    np.testing.assert_allclose(done.innovation_m[5, 0], [3.0, 0.0], atol=1e-3)
    np.testing.assert_allclose(done.state[16, 0, 6:8], [3.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(done.state[15, 0, 6:8], [0.0, 0.0], atol=1e-3)
    np.testing.assert_allclose(done.variance[16, 0, 6:8], 0.01)
    # nothing else is touched
    np.testing.assert_allclose(done.variance[16, 0, 8], done.variance[15, 0, 8], rtol=0.01)
    assert (done.variance[16, 0, 3:6] > done.variance[15, 0, 3:6]).all()
    assert at_rest([0.0] * 5 + [3.0] * 15, EKF2_EVP_GATE=100.0).fused.all()
    sigma = float(np.sqrt(done.variance_m2[5, 0, 0]))
    for times, beyond in ((4.99, False), (5.01, True)):
        assert at_rest([0.0] * 5 + [times * sigma]).rejected[5, 0] == beyond


def test_what_the_log_tells_of_a_rejection_is_obeyed() -> None:
    done = at_rest([0.0] * 6, told=1.0)
    assert done.rejected[:, 0].tolist() == [False, False, False, True, False, False]
    assert done.fused[:, 0].tolist() == [True, True, True, False, True, True]
    assert at_rest([0.0] * 6, told=0.0).fused.all()


def test_height_follows_ekf2s_own() -> None:
    done = at_rest([0.0] * 20, down_m=0.05)
    before, after = done.variance[0, 0, 8], done.variance[1:, 0, 8]
    assert before == 1e-4  # already below EKF2's own, so that nothing is taken at first
    assert abs(done.state[1, 0, 8]) < 1e-3
    assert after[-1] == pytest.approx(4e-4, rel=0.01)
    assert done.state[-1, 0, 8] == pytest.approx(0.05, abs=0.02)


# ---------------------------------------------------------------- walk and what-if


def test_the_walk_changes_one_thing_after_the_other() -> None:
    flown = {"EKF2_EVP_NOISE": 0.3, "EKF2_EV_NOISE_MD": 0.0, "EKF2_ACC_NOISE": 0.35}
    model = made(Model, inputs=made(Inputs, settings=flown, step_s=0.01))
    found = list(_variants(model, Student(0.5, 0.2, 0.16, -0.05)).values())
    assert [one.settings["EKF2_ACC_NOISE"] for one in found] == pytest.approx(
        [2.0] * 4 + [0.35] * 3
    )
    assert [one.settings["EKF2_EVP_NOISE"] for one in found] == [0.2] * 2 + [0.3] * 5
    assert [one.settings["EKF2_EV_NOISE_MD"] for one in found] == [1.0] * 2 + [0.0] * 5
    assert [one.biases for one in found] == [False] * 3 + [True] * 4
    assert [one.attitude for one in found] == [False] * 5 + [True] * 2
    assert [one.gated for one in found] == [False] * 6 + [True]
    assert [one.as_logged for one in found] == [False] * 6 + [True]
    assert [one.stamp_offset_s for one in found] == [-0.05] + [None] * 6


def test_the_longest_run_of_rejections_is_told_with_how_far_it_led() -> None:
    taken = 20.0 + np.arange(10.0)
    updates = pd.DataFrame(
        {"rejected": [0, 1, 0, 0, 1, 1, 1, 0, 1, 1], "fused_at_s": taken + 0.5}, index=taken
    )
    time = np.arange(20.0, 31.0, 0.5)
    still = pd.DataFrame(0.0, index=time, columns=STATE_COLUMNS)
    away = still.copy()
    away.iloc[:, 0] = np.where(time == 26.5, 3.0, 0.0)
    away.iloc[:, 1] = np.where(time == 26.5, -4.0, np.where(time < 24.0, 99.0, 0.0))
    one = made(Ekf2Replay, updates=updates, delayed=away)
    found = _coast(one, still, (0.0, 99.0), ((0.0, 99.0),))
    assert found is not None
    assert (found.start_s, found.samples, found.duration_s) == (24.5, 3, 3.0)
    assert found.distance_m == pytest.approx(5.0)
    # what is not judged, and what nobody rejected
    early = _coast(one, still, (0.0, 22.0), ((0.0, 99.0),))
    assert early is not None
    assert (early.start_s, early.samples, early.duration_s) == (21.5, 1, 0.0)
    assert _coast(one, still, (22.4, 24.4), ((0.0, 99.0),)) is None


def truth_of(where: dict[str, float]) -> Truth:
    frame = pd.DataFrame(0.0, index=[10.0, 20.0], columns=STATE_COLUMNS)
    return made(Truth, samples=frame.assign(**where))


def test_errors_to_the_truth_are_of_its_own_span() -> None:
    times = np.array([9.0, 10.0, 15.0, 20.0, 21.0])
    off = np.array([9.0, 3.0, 4.0, 5.0, 9.0])
    flight = made(Flight, truth=truth_of({"north_m": 1.0, "east_m": 2.0}))
    line = Line(0.6, 0.8)  # along which the truth is at 2.2 m
    model = SimpleNamespace(flight=flight)
    found = walk_to_truth(model, 2.2 + off, line, times)  # type: ignore[arg-type]
    assert found == pytest.approx(math.sqrt(50.0 / 3.0))
    later = walk_to_truth(model, off[:1], line, times[:1])  # type: ignore[arg-type]
    assert isinstance(later, Unavailable)
    published = pd.DataFrame({"east_m": 2.0 + off}, index=times)
    assert _to_truth(flight, published, "east", times) == pytest.approx(math.sqrt(50.0 / 3.0))
    assert isinstance(_to_truth(flight, published, "east", times[:1]), Unavailable)
    assert isinstance(_to_truth(made(Flight, truth=NONE), published, "east", times), Unavailable)


def test_the_longest_time_without_fusion_counts_both_ends() -> None:
    judged = ((15.0, 30.0), (40.0, 60.0))
    assert _longest(np.array([16.0, 29.0, 41.0, 59.0]), judged) == 18.0
    assert _longest(np.array([40.0]), judged) == 25.0
    assert _longest(np.array([16.0]), judged) == 44.0


def test_the_stated_sigma_goes_from_after_one_sample_to_before_the_next() -> None:
    """At the middle between them the variance is the mean of 0.01 after and 0.09 before."""
    updates = pd.DataFrame(
        {
            "innovation_variance_east_m2": [0.05, 0.13], "observation_variance_east_m2": 0.04,
            "position_variance_east_m2": [0.01, 0.02], "fused_at_s": [20.0, 22.0],
        }
    )  # fmt: skip
    ekf2 = made(Ekf2, variance=pd.DataFrame(index=[21.0]))
    one = made(Ekf2Replay, updates=updates)
    assert _sigma(ekf2, one, "east", ((10.0, 30.0),)) == pytest.approx(math.sqrt(0.05))
    assert _sigma(made(Ekf2, variance=NONE), one, "east", ((10.0, 30.0),)) is NONE


def test_a_summary_joins_north_and_east() -> None:
    def axis(nis: float, error: Any) -> AxisSummary:
        return AxisSummary(nis, (0.9, 1.1), 0.1, 0.1, error)

    one = Summary({}, {"north": axis(1.0, 0.3), "east": axis(3.0, 0.4)}, 9, 0.0, 0.1, 0)
    assert one.nis_mean == 2.0
    assert one.position_rmse_to_truth_m == pytest.approx(0.5)
    lacking = replace(one, axes={"north": axis(1.0, 0.3), "east": axis(3.0, NONE)})
    assert lacking.position_rmse_to_truth_m is NONE


def test_samples_that_come_too_late_are_a_note() -> None:
    for by_delay, remedy in ((False, ": raise EKF2_DELAY_MAX"), (True, "")):
        rules = replace(RULES, horizon_by_delay=by_delay)
        model = SimpleNamespace(inputs=SimpleNamespace(rules=rules))
        one = SimpleNamespace(late=3, lost=2, updates=range(8), changed={"EKF2_EV_DELAY": 90.0})
        (note,) = _notes(model, one)  # type: ignore[arg-type]
        assert note == (
            "EKF2_EV_DELAY=90: 5 of 10 samples would reach EKF2 after its fusion horizon has "
            f"passed them (2 would never be fused){remedy}"
        )
        assert _notes(model, SimpleNamespace(late=0, lost=0)) == []  # type: ignore[arg-type]
        one.late, one.changed = 0, {}
        assert _notes(model, one)[0].startswith("as flown: 2 of 10 samples")  # type: ignore[arg-type]


def test_what_is_left_is_a_share_of_all() -> None:
    assert made(AxisWalk, position_left_m2=1.0, position_total_m2=4.0).position_left_share == 0.25
    frame = pd.DataFrame({"north_m": [0.0, 2.0], "east_m": [4.0, 4.0]}, index=[0.0, 1.0])
    along = Line(0.6, 0.8).along(frame, ["north_m", "east_m"], np.array([0.5]))
    assert along == pytest.approx([3.8])


# ---------------------------------------------------------------- what a stretch is made of


def test_a_stretch_of_a_vehicle_that_turns() -> None:
    """0.5 rad/s about the vertical; the gyro reads 0.01 rad/s too much, EKF2 knows."""
    time = 10.0 + 0.005 * np.arange(401)
    imu = pd.DataFrame(0.0, index=time, columns=ANGULAR_RATE_COLUMNS + SPECIFIC_FORCE_COLUMNS)
    imu[ANGULAR_RATE_COLUMNS[2]] = 0.51
    imu[SPECIFIC_FORCE_COLUMNS] = [1.0, 0.2, -9.8]

    def facing(at: Any, error: Any = 0.0) -> np.ndarray:
        angle = 0.5 * (np.asarray(at) - 10.5) + error
        return np.column_stack([np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)])

    attitude = pd.DataFrame(facing(time[::4]), index=time[::4], columns=QUATERNION_COLUMNS)
    states = 10.0 + 0.1 * np.arange(21)
    delayed = pd.DataFrame(
        facing(states, 0.01 * np.arange(21)), index=states, columns=QUATERNION_COLUMNS
    )
    delayed = delayed.assign(**dict.fromkeys(VELOCITY_COLUMNS, 2.0), **{
        **dict.fromkeys(POSITION_COLUMNS, np.nan), **dict.fromkeys(GYRO_BIAS_COLUMNS, 0.0),
        **dict.fromkeys(ACCELEROMETER_BIAS_COLUMNS, 0.2), GYRO_BIAS_COLUMNS[2]: 0.01,
        **{name: 1.0 + n for n, name in enumerate(DELAYED_VARIANCE_COLUMNS)},
    })  # fmt: skip
    delayed["attitude_down_rad2"] = states
    state = pd.DataFrame(7.0, index=time, columns=STATE_COLUMNS).assign(down_m=time)
    record = made(FusionRecord, delayed=delayed, parameters={})
    found = _stretch(imu, attitude, made(Ekf2, state=state), record, 5, 11.5)
    steps = 10.5 + 0.01 * np.arange(101)
    np.testing.assert_allclose(found.time_s, steps, atol=1e-9)
    np.testing.assert_allclose(found.step_s, 0.01, atol=1e-9)
    turned = matrix(facing(steps))
    np.testing.assert_allclose(found.rotation, turned, atol=1e-6)
    np.testing.assert_allclose(found.correction_rad, 0.0, atol=1e-6)
    # in the frame at the end of the step, without its bias
    np.testing.assert_allclose(found.force_m_s2, [[0.8, 0.0, -10.0]] * 100, atol=5e-3)
    np.testing.assert_allclose(found.state[:3], [0.0, 0.0, 0.05], atol=1e-6)
    np.testing.assert_allclose(found.state[3:9], [2.0, 2.0, 2.0, 7.0, 7.0, 10.5])
    np.testing.assert_allclose(found.state[9:], 0.0)
    expected = np.arange(1.0, 16.0)
    expected[DELAYED_VARIANCE_COLUMNS.index("attitude_down_rad2")] = 10.5
    np.testing.assert_allclose(found.variance, expected)
    np.testing.assert_allclose(found.heading_variance_rad2, steps)
    np.testing.assert_allclose(found.down_m, steps)
    np.testing.assert_allclose(
        found.attitude_error_rad[:, 2], 0.05 + 0.1 * (steps - 10.5), atol=1e-6
    )
    assert found.gyro_bias_rad_s.tolist() == [0.0, 0.0, 0.01]
    assert found.fusing
    delayed[POSITION_COLUMNS] = 3.0
    own = _stretch(imu, attitude, made(Ekf2, state=state), record, 5, 11.5)
    np.testing.assert_allclose(own.state[6:9], [3.0, 3.0, 10.5])


# ---------------------------------------------------------------- where a stretch begins


def stretches(monkeypatch: pytest.MonkeyPatch, **parts: Any) -> list[tuple[float, float]]:
    """Start and end of each, of a flight of 60 s with everything every 0.01 or 0.1 s."""
    found: list[tuple[float, float]] = []
    usual = {
        "imu": np.arange(0.0, 60.0, 0.01), "vision": np.arange(0.0, 60.0, 0.1),
        "fused": np.arange(0.0, 60.0, 0.1), "airborne": NONE, "delayed": np.arange(0.0, 60.0, 0.5),
    }  # fmt: skip
    given = {**usual, **parts}

    def keep(_imu: Any, _attitude: Any, _ekf2: Any, record: Any, at: int, high: float) -> None:
        found.append((float(record.delayed.index[at]), round(float(high), 2)))

    monkeypatch.setattr("px4fuse.ekf2.stretches._stretch", keep)
    find_stretches(
        made(Flight, airborne=given["airborne"]),
        pd.DataFrame(index=given["imu"]),
        pd.DataFrame(index=given["imu"]),
        made(Ekf2, innovations={"north": pd.DataFrame(index=given["fused"])}),
        made(FusionRecord, delayed=pd.DataFrame(index=given["delayed"])),
        made(Vision, stamp_s=given["vision"]),
    )
    return found


def without(times: np.ndarray, low: float, high: float) -> np.ndarray:
    return times[(times < low + 1e-6) | (times > high - 1e-6)]


def test_where_a_stretch_begins_and_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    imu, vision = np.arange(0.0, 60.0, 0.01), np.arange(0.0, 60.0, 0.1)
    assert stretches(monkeypatch) == [(1.0, 59.99)]
    # a second of fusion, four in the air
    late = np.arange(20.0, 60.0, 0.1)
    assert stretches(monkeypatch, fused=late) == [(21.0, 59.99)]
    assert stretches(monkeypatch, airborne=((10.0, 50.0), (52.0, 60.0))) == [(14.0, 59.99)]
    assert stretches(monkeypatch, airborne=((70.0, 90.0),)) == [(1.0, 59.99)]
    # gaps of vision beyond 2 s, and of the IMU beyond 0.05 s, part the flight
    assert len(stretches(monkeypatch, vision=without(vision, 30.0, 31.9))) == 1
    exactly = without(np.arange(0.0, 60.0, 0.125), 30.0, 32.0)
    assert len(stretches(monkeypatch, vision=exactly)) == 1
    parted = stretches(monkeypatch, vision=without(vision, 30.0, 32.2))
    assert parted == [(1.0, 30.0), (33.5, 59.99)]
    assert len(stretches(monkeypatch, imu=without(imu, 30.0, 30.04))) == 1
    parted = stretches(monkeypatch, imu=without(imu, 30.0, 30.07))
    assert [start for start, _ in parted] == [1.0, 31.5]
    # ten seconds at least, and a second after the last sample of vision
    assert stretches(monkeypatch, fused=np.arange(48.0, 60.0, 0.1))[0][0] == 49.0
    assert stretches(monkeypatch, fused=np.arange(49.3, 60.0, 0.1)) == []
    assert stretches(monkeypatch, fused=np.array([])) == []
    assert stretches(monkeypatch, vision=np.arange(5.0, 40.0, 0.1)) == [(6.0, 40.9)]
    assert predict_s(made(FusionRecord, parameters={})) == 0.01
