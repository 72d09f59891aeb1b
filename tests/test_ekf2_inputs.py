"""What the model of EKF2 takes from a log: parameters, rules, the IMU and vision.

The limits are written out here, so that one that is changed must be changed here as well.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pandas as pd
import pytest
from findings_tools import NONE, log, made
from scipy.spatial.transform import Rotation

from px4fuse.ekf2 import inputs as inputs_module
from px4fuse.ekf2.inputs import Inputs, Rules, Vision, _decisions, _source, prepare, read_vision
from px4fuse.ekf2.stretches import Stretch
from px4fuse.ekf2.whatif import sweep_values
from px4fuse.ekf2_parameters import PARAMETERS, check, fuses_by_mask, settings_in_force
from px4fuse.errors import SettingsError
from px4fuse.flight import (
    POSITION_COLUMNS,
    POSITION_VARIANCE_COLUMNS,
    QUATERNION_COLUMNS,
    Ekf2,
    Flight,
    FusionRecord,
    PositionTrack,
    Reset,
    Unavailable,
)
from px4fuse.origin import ALIGNED, GIVEN_FILE, GNSS, KEPT, MOTION_CAPTURE, RECEIVED, Origin

ALIGNED_TOPIC = "estimator_visual_odometry_aligned"
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


# ---------------------------------------------------------------- inputs and vision


def flown(
    monkeypatch: pytest.MonkeyPatch, *, interval_s: float = 0.008, **record: Any
) -> Inputs | Unavailable:
    """What is prepared of a flight of which only the parameters matter."""
    monkeypatch.setattr(inputs_module, "read_vision", lambda *_: made(Vision, stamp_s=None))
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
    assert (new.step_s, new.horizon_s, new.predict_s, new.max_interval_s) == (0.01, 0.1, 0.01, 0.25)
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


def track(name: str, origin: Origin, interval_s: float = 0.1, **parts: Any) -> PositionTrack:
    time = 10.0 + interval_s * np.arange(30)
    samples = pd.DataFrame(1.0, index=time, columns=POSITION_COLUMNS + POSITION_VARIANCE_COLUMNS)
    usual = {"frame": "NED", "orientation": None, "topics": (name,)}
    return made(PositionTrack, name=name, origin=origin, samples=samples, **{**usual, **parts})


@pytest.mark.parametrize(
    ("tracks", "expected"),
    [
        ([track("file", GIVEN_FILE), track("vehicle_visual_odometry", RECEIVED)],
         "vehicle_visual_odometry"),
        ([track("file", GIVEN_FILE), track("gps", GNSS)], "file"),
        ([track("mocap", MOTION_CAPTURE)], None),
        # copies that the logger did not thin: below 0.9 of its interval, and 4 Hz at least
        ([track(ALIGNED_TOPIC, ALIGNED, 0.179)], ALIGNED_TOPIC),
        ([track(ALIGNED_TOPIC, ALIGNED, 0.181)], None),
        ([track("estimator_aid_src_ev_pos", KEPT, 0.25)], "estimator_aid_src_ev_pos"),
        ([track("estimator_aid_src_ev_pos", KEPT, 0.26)], None),
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

    own = track("vehicle_visual_odometry", RECEIVED, frame="FRD", orientation=facing(0.0))
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
    copy = track("estimator_aid_src_ev_pos", KEPT)
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
