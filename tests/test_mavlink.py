"""MAVLink recordings: units, frames, directions, and comparison with the ULog of the same flight.

The number of fuzz cases is the environment variable PX4FUSE_FUZZ_CASES (default 60); the cases are
the same in every run::

    PX4FUSE_FUZZ_CASES=20000 python -m pytest tests/test_mavlink.py -k malicious
"""

import itertools
import json
import math
import os
import re
import struct
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from comparisons import compare
from mavlink_tools import (
    AUTOPILOT,
    BOOT_S,
    COMPANION,
    GRAVITY_M_S2,
    LEAST_DELAY_S,
    MESSAGES,
    POSE_VARIANCE,
    VELOCITY_VARIANCE,
    Aisle,
    Recorder,
    boot,
    heartbeat,
    message,
    ms,
    odometry,
    raw_frame,
    same,
    stamp,
    track_of,
    unix,
    us,
    xyz,
)
from numpy.testing import assert_allclose, assert_array_equal
from pandas.testing import assert_frame_equal
from scipy.spatial.transform import Rotation
from time_limit import time_limit

from px4fuse.diagnose import diagnose_comparison
from px4fuse.errors import LogError, MissingDataError
from px4fuse.flight.model import (
    AS_RECEIVED_ORIGIN,
    MOTION_CAPTURE_ORIGIN,
    Columns,
    Ekf2,
    Flight,
    Truth,
    Unavailable,
)
from px4fuse.info.inventory import list_log_contents
from px4fuse.readers import read_log
from px4fuse.readers.mavlink_frames import wire_layout
from px4fuse.readers.mavlink_positions import compute_pressure_altitude_m
from px4fuse.readers.px4_positions import unproject

FUZZ_CASES = int(os.environ.get("PX4FUSE_FUZZ_CASES", "60"))
VARIANCE_COLUMNS = Columns.POSITION_VARIANCE + Columns.VELOCITY_VARIANCE
PAIRS = ("v1.13.3_aisle_hwlogvision", "v1.16.1_aisle_clock_late", "v1.16.1_aisle_clock_nosync")


def record_without(aisle: Aisle, *names: str) -> Recorder:
    recorder = aisle.record()
    recorder.sent = [s for s in recorder.sent if s[2].get_type() not in names]
    return recorder


def add(recorder: Recorder, rate_hz: float, make, sender=AUTOPILOT, seconds=40.0) -> Recorder:
    """Add a message at a fixed rate, received at once."""
    for boot_s in Aisle(seconds=seconds).times(rate_hz):
        recorder.hear(unix(boot_s + LEAST_DELAY_S), sender, make(boot_s))
    return recorder


def reason(flight: Flight, what: str) -> str:
    return next(str(part) for part in flight.missing if part.what == what)


# ---- whole simulated flight ---------------------------------------------------------------------


def test_read_mavlink_returns_the_simulated_motion_and_imu(read):
    """All parts equal their closed form; HIGHRES_IMU is preferred to a denser SCALED_IMU."""
    aisle = Aisle(asks=True)
    made = aisle.record()
    flight = read(add(made, 100.0, lambda t: message("SCALED_IMU", time_boot_ms=ms(t))))
    assert flight.log.format == "MAVLink tlog"
    assert flight.log.autopilot == "PX4"
    assert flight.log.boot_time_s == BOOT_S
    assert flight.log.duration_s == pytest.approx(39.99, abs=1e-6)
    force = np.array([aisle.path(t)[2] - [0, 0, GRAVITY_M_S2] for t in boot(flight, flight.imu)])
    assert_allclose(flight.imu[Columns.SPECIFIC_FORCE], force, atol=1e-5)
    assert len(flight.imu) == 2000
    assert_array_equal(flight.attitude[Columns.QUATERNION], np.tile([1.0, 0, 0, 0], (800, 1)))
    state = flight.ekf2.state
    expected = np.array([np.hstack(aisle.path(t)[:2]) for t in boot(flight, state)])
    assert_allclose(state[Columns.STATE], expected, atol=1e-5)
    assert_allclose(boot(flight, state), aisle.times(20.0), atol=1e-6)
    variances = np.tile([*POSE_VARIANCE, *VELOCITY_VARIANCE], (800, 1))
    assert_allclose(flight.ekf2.variance[VARIANCE_COLUMNS], variances, rtol=1e-6)
    assert_allclose(flight.airborne, [(10.0, 30.0)], atol=0.1)
    assert flight.streams["imu"].topics == ("HIGHRES_IMU",)
    assert flight.streams["ekf2_state"].topics == ("ODOMETRY",)
    [track] = flight.positions
    assert track.name == "VISION_POSITION_ESTIMATE"
    assert (track.origin.route, track.frame) == (AS_RECEIVED_ORIGIN.route, "NED")
    variance = track.samples[Columns.POSITION_VARIANCE]
    assert_allclose(variance, np.tile(POSE_VARIANCE, (200, 1)), rtol=1e-6)


def test_read_mavlink_version_1_equals_version_2(read):
    """MAVLink 1 has no ids above 255, so the state message is LOCAL_POSITION_NED."""
    aisle = Aisle(state="LOCAL_POSITION_NED")
    recorder = record_without(aisle, "ODOMETRY")
    as_2 = read(recorder)
    recorder.v1 = True
    as_1 = read(recorder)
    raw = read(recorder, stamped=False)
    for other in (as_1, raw):
        assert_frame_equal(as_2.imu, other.imu)
        assert_frame_equal(as_2.attitude, other.attitude)
        assert_frame_equal(as_2.ekf2.state, other.ekf2.state)
    assert_frame_equal(as_2.positions[0].samples, as_1.positions[0].samples)


def test_read_mavlink_removes_duplicates_of_two_links(read):
    """MAVProxy with two radios records every message twice, with a delay."""
    aisle = Aisle(asks=True)
    once = aisle.record()
    twice = Recorder()
    for received, sender, made, _ in once.sent:
        twice.hear(received, sender, made, link=0)
        twice.hear(received + 0.03, sender, made, link=1)
    one, two = read(once), read(twice)
    assert_frame_equal(one.imu, two.imu)
    assert_frame_equal(one.ekf2.state, two.ekf2.state)
    assert len(two.positions[0].samples) == 200
    assert_allclose(one.positions[0].samples.index, two.positions[0].samples.index, atol=1e-3)
    assert {s.lost_fraction for s in two.log.senders} == {0.0}


# ---- IMU ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3"])
def test_mavlink_scaled_imu_is_converted_to_si_units(read, name):
    recorder = add(record_without(Aisle(), "HIGHRES_IMU"), 50.0, lambda t: message(
        name, time_boot_ms=ms(t), xacc=1000, yacc=-500, zacc=-1000, xgyro=1000, ygyro=-20, zgyro=3,
    ))  # fmt: skip
    imu = read(recorder).imu
    assert len(imu) == 2000
    assert_allclose(imu[Columns.SPECIFIC_FORCE].iloc[0], [9.80665, -4.903325, -9.80665], rtol=1e-12)
    assert_allclose(imu[Columns.ANGULAR_RATE].iloc[0], [1.0, -0.02, 0.003], rtol=1e-12)


def test_mavlink_raw_imu_without_unit_is_unavailable(read):
    recorder = add(record_without(Aisle(), "HIGHRES_IMU"), 50.0, lambda t: message(
        "RAW_IMU", time_usec=us(t), xacc=17, zacc=-998,
    ))  # fmt: skip
    flight = read(recorder)
    assert isinstance(flight.imu, Unavailable)
    assert "no usable HIGHRES_IMU or SCALED_IMU" in reason(flight, "IMU")
    reason_raw = "raw counts without a unit"
    assert [(u.name, u.count, u.reason) for u in flight.unused] == [("RAW_IMU", 2000, reason_raw)]


def test_mavlink_imu_with_several_ids_uses_most_frequent_id(read):
    recorder = record_without(Aisle(), "HIGHRES_IMU")
    add(recorder, 50.0, lambda t: message("HIGHRES_IMU", time_usec=us(t), xacc=2.0, id=1))
    add(recorder, 10.0, lambda t: message("HIGHRES_IMU", time_usec=us(t) + 7, xacc=9.0, id=0))
    imu = read(recorder).imu
    assert len(imu) == 2000
    assert set(imu["forward_m_s2"]) == {2.0}


# ---- attitude -----------------------------------------------------------------------------------


def test_mavlink_euler_angles_are_converted_to_quaternion(read):
    roll, pitch, yaw = 0.1, -0.3, 2.0
    recorder = add(record_without(Aisle(), "ATTITUDE_QUATERNION"), 30.0, lambda t: message(
        "ATTITUDE", time_boot_ms=ms(t), roll=roll, pitch=pitch, yaw=yaw,
    ))  # fmt: skip
    flight = read(recorder)
    assert flight.streams["attitude"].topics == ("ATTITUDE",)
    got = Rotation.from_quat(flight.attitude[Columns.QUATERNION].to_numpy()[0], scalar_first=True)
    # rotations about the body x axis, then y, then the vertical
    about = [Rotation.from_rotvec(turn) for turn in ([roll, 0, 0], [0, pitch, 0], [0, 0, yaw])]
    expected = about[2].as_matrix() @ about[1].as_matrix() @ about[0].as_matrix()
    assert_allclose(got.as_matrix(), expected, atol=1e-6)
    # down component of the nose direction is -sin(pitch)
    assert got.as_matrix()[2, 0] == pytest.approx(-np.sin(pitch), abs=1e-6)


# ---- frames of reference and senders ------------------------------------------------------------


@pytest.mark.parametrize(("frame_id", "name", "position", "variance"), [
    (1, "NED", [1.0, 2.0, 3.0], [0.01, 0.02, 0.03]),
    (4, "NED", [2.0, 1.0, -3.0], [0.02, 0.01, 0.03]),  # ENU
    (20, "FRD", [1.0, 2.0, 3.0], [0.01, 0.02, 0.03]),
    (21, "FRD", [1.0, -2.0, -3.0], [0.01, 0.02, 0.03]),  # FLU
    (8, "", [], []),  # turns with the vehicle
    (12, "", [], []),
    (255, "", [], []),
])  # fmt: skip
def test_mavlink_odometry_position_is_converted_to_ned(read, frame_id, name, position, variance):
    flight = read(add(Aisle(uwb=None, asks=True).record(), 30.0, lambda t: odometry(
        us(unix(t)), [1.0, 2.0, 3.0], [0, 0, 0], estimator=3, frame_id=frame_id,
        attitude=Rotation.from_euler("z", 0.1 * t),
    ), COMPANION))  # fmt: skip
    if not name:
        assert flight.positions == ()
        assert "only 0 finite samples" in reason(flight, "position source ODOMETRY_VIO")
        return
    [track] = flight.positions
    assert (track.name, track.frame) == ("ODOMETRY_VIO", name)
    assert_array_equal(track.samples[Columns.POSITION].iloc[5], position)
    assert_allclose(track.samples[Columns.POSITION_VARIANCE].iloc[5], variance)
    # the body axes of a sender of ENU or FLU are unknown
    assert (track.orientation is None) == (frame_id in (4, 21))


BODY = Rotation.from_euler("ZYX", [120.0, 10.0, -20.0], degrees=True)
# Rotation matrix to NED by MAV_FRAME: body (8, 12), NED (1), ENU (4), FLU (21)
TO_NED = {
    8: BODY.as_matrix(), 12: BODY.as_matrix(), 1: np.eye(3),
    4: np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]]), 21: np.diag([1, -1, -1]),
}  # fmt: skip


@pytest.mark.parametrize("child", TO_NED)
def test_mavlink_odometry_velocity_is_rotated_to_ned(read, child):
    """PX4 v1.13: v_NED = R v and var_i = Σ_j R_ij² var_j."""
    velocity, matrix = np.array([1.0, -0.5, 0.25]), TO_NED[child]
    recorder = add(record_without(Aisle(), "ODOMETRY"), 30.0, lambda t: odometry(
        us(t), [1, 2, 3], velocity, estimator=8, child=child, attitude=BODY,
    ))  # fmt: skip
    ekf2 = read(recorder).ekf2
    assert_allclose(ekf2.state[Columns.VELOCITY].iloc[3], matrix @ velocity, atol=1e-6)
    assert_allclose(
        ekf2.variance[Columns.VELOCITY_VARIANCE].iloc[3],
        np.diag(matrix @ np.diag(VELOCITY_VARIANCE) @ matrix.T), rtol=1e-5,
    )  # fmt: skip


@pytest.mark.parametrize(("estimator", "name", "origin"), [
    (0, "ODOMETRY", AS_RECEIVED_ORIGIN), (1, "ODOMETRY_NAIVE", AS_RECEIVED_ORIGIN),
    (2, "ODOMETRY_VISION", AS_RECEIVED_ORIGIN), (3, "ODOMETRY_VIO", AS_RECEIVED_ORIGIN),
    (6, "ODOMETRY_MOCAP", MOTION_CAPTURE_ORIGIN), (4, "", None), (8, "", None),
])  # fmt: skip
def test_mavlink_odometry_estimator_type_selects_source_name(read, estimator, name, origin):
    """ODOMETRY from the autopilot remains EKF2's state; types GPS and AUTOPILOT are no input."""
    flight = read(Aisle(uwb="ODOMETRY", estimator=estimator, asks=True))
    if not name:
        assert flight.positions == ()
        assert "no ODOMETRY sent to the autopilot" in reason(flight, "position source ODOMETRY")
        return
    [track] = flight.positions
    assert (track.name, track.origin.route, track.topics) == (name, origin.route, ("ODOMETRY",))
    assert len(track.samples) == 200
    assert len(flight.ekf2.state) == 800
    given = track.samples[Columns.POSITION_VARIANCE]
    if estimator == 1:
        assert given.isna().all(axis=None)
    else:
        assert_allclose(given.iloc[0], POSE_VARIANCE, rtol=1e-6)


def test_mavlink_mocap_is_ground_truth_if_other_source_exists(read):
    aisle = Aisle(asks=True)
    recorder = aisle.record()
    add(recorder, 50.0, lambda t: message(
        "ATT_POS_MOCAP", time_usec=us(unix(t)), q=[1, 0, 0, 0], **xyz(aisle.path(t)[0]),
    ), COMPANION)  # fmt: skip
    flight = read(recorder)
    assert flight.truth.name == "ATT_POS_MOCAP"
    expected = np.array([aisle.path(t)[0] for t in aisle.times(50.0)])
    assert_allclose(flight.truth.samples[Columns.POSITION], expected, atol=1e-5)
    assert flight.truth.samples[Columns.VELOCITY].isna().all(axis=None)
    assert [t.name for t in flight.positions] == ["VISION_POSITION_ESTIMATE", "ATT_POS_MOCAP"]


def test_read_mavlink_drops_nan_positions(read):
    """NaN positions are dropped; a variance of 0 or NaN is not given."""
    recorder = Aisle(uwb=None, asks=True).record()
    kinds = itertools.cycle(range(4))

    def make(t):
        kind = next(kinds)
        covariance = [[0.5] * 21, [0.0] * 21, [float("nan")] * 21, [0.5] * 21][kind]
        x = float("nan") if kind == 3 else 1.0
        return message("VISION_POSITION_ESTIMATE", usec=us(unix(t)), x=x, covariance=covariance)

    [track] = read(add(recorder, 10.0, make, COMPANION)).positions
    assert len(track.samples) == 300
    given = track.samples["north_m2"].to_numpy()
    assert_array_equal(given[:6], [0.5, np.nan, np.nan] * 2)


# ---- EKF2's state and variances -----------------------------------------------------------------


@pytest.mark.parametrize("state", ["LOCAL_POSITION_NED", "ODOMETRY"])
def test_mavlink_ekf2_variance_is_read_from_estimator_status(read, state):
    """The horizontal accuracy is the root of the sum of both variances."""
    recorder = Aisle(state="LOCAL_POSITION_NED" if state != "ODOMETRY" else None).record()
    if state == "ODOMETRY":
        nothing = [float("nan")] * 21
        add(recorder, 30.0, lambda t: message(
            "ODOMETRY", time_usec=us(t), frame_id=1, child_frame_id=1, q=[1, 0, 0, 0],
            pose_covariance=nothing, velocity_covariance=nothing, estimator_type=8,
        ))  # fmt: skip
    add(recorder, 5.0, lambda t: message(
        "ESTIMATOR_STATUS", time_usec=us(t), pos_horiz_accuracy=0.5, pos_vert_accuracy=0.3,
    ))  # fmt: skip
    flight = read(recorder)
    variance = flight.ekf2.variance
    assert flight.streams["ekf2_state"].topics == (state,)
    assert_allclose(variance[Columns.POSITION_VARIANCE].iloc[0], [0.125, 0.125, 0.09], rtol=1e-6)
    assert variance[Columns.VELOCITY_VARIANCE].isna().all(axis=None)
    assert flight.streams["ekf2_variance"].topics == ("ESTIMATOR_STATUS",)
    assert any("ESTIMATOR_STATUS" in note for note in flight.ekf2.notes)


# ---- truth --------------------------------------------------------------------------------------

EARTH_RADIUS_M = 6_371_000.0
LATITUDE, LONGITUDE, HEIGHT_M = 47.0, 8.0, 500.0


def degrees(aisle: Aisle, boot_s: float) -> tuple[float, float, float, np.ndarray]:
    """Return latitude, longitude, height and velocity of the flight, about its first sample."""
    position, velocity, _ = aisle.path(boot_s)
    d = position - aisle.path(BOOT_S)[0]
    latitude = LATITUDE + np.degrees(d[0] / EARTH_RADIUS_M)
    longitude = LONGITUDE + np.degrees(d[1] / (EARTH_RADIUS_M * np.cos(np.radians(LATITUDE))))
    return latitude, longitude, HEIGHT_M - d[2], velocity


def simulated(name: str, aisle: Aisle, boot_s: float):
    latitude, longitude, height, v = degrees(aisle, boot_s)
    as_integer = {"lat": round(latitude * 1e7), "lon": round(longitude * 1e7)}
    if name == "HIL_STATE_QUATERNION":
        speed = dict(zip(("vx", "vy", "vz"), (round(x * 100) for x in v), strict=True))
        return message(name, alt=round(height * 1e3), **as_integer, **speed)
    return message(name, lat=as_integer["lat"], lng=as_integer["lon"])


@pytest.mark.parametrize("name", ["HIL_STATE_QUATERNION", "SIMSTATE"])
def test_mavlink_simulated_truth_is_projected_to_local_metres(read, name):
    """The time is the receive time, because the timestamp is 0 in PX4."""
    aisle = Aisle(asks=True)
    flight = read(add(aisle.record(), 25.0, lambda t: simulated(name, aisle, t)))
    assert flight.truth.name == name
    times = boot(flight, flight.truth.samples)
    assert_allclose(times, aisle.times(25.0), atol=1e-3)
    start = aisle.path(BOOT_S)[0]
    expected = np.array([aisle.path(t)[0] - start for t in aisle.times(25.0)])
    got = flight.truth.samples
    assert_allclose(got[Columns.POSITION[:2]], expected[:, :2], atol=0.012)
    velocity = np.array([aisle.path(t)[1] for t in aisle.times(25.0)])
    if name == "SIMSTATE":
        assert got[["down_m", *Columns.VELOCITY]].isna().all(axis=None)
    else:
        assert_allclose(got["down_m"], expected[:, 2], atol=1e-3)
        assert_allclose(got[Columns.VELOCITY], velocity, atol=5.1e-3)


# ---- the log itself -----------------------------------------------------------------------------


def parameter(name: bytes, value: int | float, *, by_bytes: bool):
    kind = 6 if isinstance(value, int) else 9
    if isinstance(value, int) and by_bytes:
        value = struct.unpack("<f", struct.pack("<i", value))[0]
    return message("PARAM_VALUE", param_id=name, param_value=float(value), param_type=kind)


@pytest.mark.parametrize(("autopilot", "by_bytes"), [(12, True), (3, False)])
def test_integer_parameters_are_decoded_for_px4_and_ardupilot(read, autopilot, by_bytes):
    recorder = record_without(Aisle(), "HEARTBEAT")
    add(recorder, 1.0, lambda t: heartbeat(2, autopilot))
    for i, (name, value) in enumerate(
        {b"EKF2_EV_CTRL": 15, b"SDLOG_PROFILE": 129, b"EKF2_EVP_GATE": 3.5, b"X": 7}.items()
    ):
        recorder.hear(unix(60.0 + i), AUTOPILOT, parameter(name, value, by_bytes=by_bytes))
    # a change in flight is ignored; the first value is used
    later = parameter(b"EKF2_EVP_GATE", 9.0, by_bytes=by_bytes)
    recorder.hear(unix(80.0), AUTOPILOT, later)
    flight = read(recorder)
    assert flight.log.autopilot == ("PX4" if by_bytes else "ArduPilot")
    expected = {"EKF2_EV_CTRL": 15.0, "SDLOG_PROFILE": 129.0, "EKF2_EVP_GATE": 3.5}
    assert dict(flight.log.parameters) == expected
    assert flight.ekf2.gate == 3.5


def test_mavlink_parameter_out_of_range_is_replaced_by_default(read):
    recorder = Aisle().record()
    for name, value in (
        (b"EKF2_EVP_GATE", 0.0),
        (b"EKF2_EVP_NOISE", 1e30),
        (b"EKF2_EV_DELAY", 300.0),
    ):
        recorder.hear(unix(60.0), AUTOPILOT, parameter(name, value, by_bytes=True))
    flight = read(recorder)
    notes = [note for note in flight.log.notes if "EKF2_" in note]
    assert notes == [
        "EKF2_EVP_GATE 0 SD is outside PX4's range 1 to 1000. px4fuse uses the parameter default "
        "5.",
        "EKF2_EVP_NOISE 1e+30 m is outside PX4's range 0.01 to 1000. px4fuse uses the parameter "
        "default 0.1.",
    ]
    assert flight.ekf2.gate == 5.0
    assert flight.log.parameters["EKF2_EV_DELAY"] == 300.0


@pytest.mark.parametrize(
    "missing_messages", [(), ("VISION_POSITION_ESTIMATE",), ("HIGHRES_IMU", "ODOMETRY")]
)
def test_advice_on_ardupilot_recording_names_no_px4_terms(read, missing_messages):
    """ArduPilot has no ULog, no PX4 console and no PX4 parameters."""
    recorder = record_without(
        Aisle(imu_hz=4.0, seconds=20.0), *missing_messages, "EXTENDED_SYS_STATE"
    )
    for at, (received, sender, made, link) in enumerate(recorder.sent):
        if made.get_type() == "HEARTBEAT" and sender == AUTOPILOT:
            recorder.sent[at] = received, sender, heartbeat(2, 3), link
    flight = read(recorder)
    assert flight.log.autopilot == "ArduPilot"
    texts = [str(part) for part in list_log_contents(flight).advice]
    texts += [str(part) for part in flight.missing]
    if flight.positions:
        texts += [
            f"{f.message} {f.remedy}"
            for f in diagnose_comparison(compare(flight)).findings
            if f.id != "not_px4"
        ]
    else:
        with pytest.raises(MissingDataError) as refused:
            compare(flight)
        texts.append(str(refused.value))
    for text in texts:
        assert not re.search(r"ULog|PX4|SDLOG|SD card|EKF2_|mavlink stream", text), text
    assert len(texts) > 3


def test_read_mavlink_reads_firmware_from_autopilot_version(read):
    recorder = Aisle().record()
    recorder.hear(unix(60.0), AUTOPILOT, message(
        "AUTOPILOT_VERSION", flight_sw_version=0x011001FF,
        flight_custom_version=list(bytes.fromhex("0123456789abcdef"))[::-1],
    ))  # fmt: skip
    flight = read(recorder)
    assert flight.log.firmware == "PX4 v1.16.1"
    assert flight.log.firmware_hash == "0123456789abcdef"
    assert "unknown version" in read(Aisle()).log.firmware


ORIGIN_DEG = (47.4, 8.5)


def place(boot_s: float) -> dict[str, int]:
    north, east, down = Aisle().path(boot_s)[0]
    (latitude,), (longitude,) = unproject(np.array([north]), np.array([east]), ORIGIN_DEG)
    return {"lat": round(latitude * 1e7), "lon": round(longitude * 1e7),
            "alt": round(4e5 - 1e3 * down)}  # fmt: skip


def fix(boot_s: float, *, clock=same, fix_type: int = 3):
    """Make a GNSS fix with a delay of 0.11 s and a timestamp of ``clock``."""
    return message(
        "GPS_RAW_INT", time_usec=us(clock(boot_s)), fix_type=fix_type, eph=90, h_acc=300,
        v_acc=500, **place(boot_s - 0.11),
    )  # fmt: skip


def global_state(boot_s: float):
    return message("GLOBAL_POSITION_INT", time_boot_ms=ms(boot_s), **place(boot_s))


def pressure(boot_s: float, *, clock=same):
    """Make the standard pressure at the vehicle; the origin is at 400 m."""
    altitude_m = 400.0 - Aisle().path(boot_s)[0][2]
    hpa = 1013.25 * (1.0 - 0.0065 * altitude_m / 288.15) ** 5.25588
    return message("SCALED_PRESSURE", time_boot_ms=ms(clock(boot_s)), press_abs=hpa)


def outdoors(
    rate_hz: float = 5.0, *, origin: bool = True, has_global_position: bool = True, **of_fix
):
    recorder = add(Aisle(uwb=None, state="LOCAL_POSITION_NED").record(), rate_hz,
                   lambda t: fix(t, **of_fix))  # fmt: skip
    if origin:
        recorder.hear(unix(60.0), AUTOPILOT, message(
            "GPS_GLOBAL_ORIGIN", latitude=474000000, longitude=85000000, altitude=400000,
            time_usec=us(60.0),
        ))  # fmt: skip
    return add(recorder, 2.0, global_state) if has_global_position else recorder


@pytest.mark.parametrize(("origin", "clock"), [(True, same), (False, same), (False, unix)])
def test_mavlink_gnss_position_is_relative_to_autopilot_origin(read, origin, clock):
    """The receiver's timestamps may be boot time or UNIX time."""
    flight = read(outdoors(origin=origin, clock=clock))
    (track,) = flight.positions
    assert (track.name, track.origin.is_fused_as_gnss, track.origin.is_selectable_by_default) == (
        "GPS_RAW_INT",
        True,
        True,
    )
    assert track.assumed_delay_s == pytest.approx(0.11)
    true = np.array([Aisle().path(BOOT_S + t)[0] for t in track.samples.index])
    exact_m = 0.02 if clock is same else 0.03
    assert track.samples[Columns.POSITION].to_numpy() == pytest.approx(true, abs=exact_m)
    variance = track.samples[Columns.POSITION_VARIANCE].iloc[0]
    assert variance.to_numpy() == pytest.approx([0.09, 0.09, 0.25])
    result = compare(flight, sigma_z_m=None)
    assert result.source.name == "GPS_RAW_INT"
    assert result.settings.sigma_z_m == 0.5  # EKF2_GPS_P_NOISE is the lower limit


def test_mavlink_barometer_height_is_computed_from_pressure(read):
    """Pressures are from the table of the standard atmosphere (ISO 2533), at 400 m and 1 km."""
    altitude_m = compute_pressure_altitude_m(np.array([1013.25, 966.114, 898.746]))
    assert altitude_m == pytest.approx([0.0, 400.0, 1000.0], abs=0.1)
    flight = read(add(outdoors(), 5.0, pressure))
    assert compare(flight, axes=("down",)).source.barometer is None
    (down,) = compare(flight, axes=("down",), height="barometer").input_axes
    true = np.array([Aisle().path(BOOT_S + t)[0][2] for t in down.measurement_time_s])
    assert down.measurement_m - true == pytest.approx(0.0, abs=0.05)
    # without a valid time they are dropped with a note
    flight = read(add(outdoors(), 5.0, lambda t: pressure(t, clock=lambda _: 0.0)))
    assert flight.barometer is None
    assert [note for note in flight.log.notes if "SCALED_PRESSURE" in note]


def test_mavlink_gnss_not_used_by_ekf2_is_not_default_source(read):
    flight = read(outdoors(has_global_position=False))
    assert not flight.positions[0].origin.is_selectable_by_default
    with pytest.raises(MissingDataError, match=r"position.source`? GPS_RAW_INT"):
        compare(flight)


def test_read_mavlink_drops_repeated_and_2d_gnss_fixes(read):
    again = read(add(outdoors(), 5.0, fix, seconds=39.9))
    assert again.positions[0].compute_rate_hz() == pytest.approx(5.0, rel=0.02)
    assert read(outdoors(fix_type=2)).positions == ()


def test_read_mavlink_with_only_heartbeats_lists_missing_data(read):
    flight = read(add(Recorder(), 1.0, lambda t: heartbeat()))
    for part in ("imu", "attitude", "ekf2", "truth", "airborne"):
        assert isinstance(getattr(flight, part), Unavailable)
    whats = {part.what for part in flight.missing}
    assert {"IMU", "attitude", "EKF2", "ground truth", "position source ODOMETRY"} <= whats


# ---- two recordings of one flight ---------------------------------------------------------------


def stamp_differences(tlog: Flight, ulog: Flight) -> tuple[np.ndarray, np.ndarray]:
    """Return tlog minus ULog boot time of identical positions, and their rows in the ULog."""
    tlog_samples = track_of(tlog, "VISION_POSITION_ESTIMATE").samples
    ulog_samples = track_of(ulog, "vehicle_visual_odometry").samples

    def keys(samples: pd.DataFrame) -> list[tuple[float, ...]]:
        single = samples[Columns.POSITION].to_numpy().astype(np.float32)
        return [tuple(row) for row in single.tolist()]

    at = {key: row for row, key in enumerate(keys(ulog_samples))}
    pairs = [(row, at[key]) for row, key in enumerate(keys(tlog_samples)) if key in at]
    tlog_rows, other = np.array(pairs).T
    return boot(tlog, tlog_samples)[tlog_rows] - boot(ulog, ulog_samples)[other], other


def differences(
    tlog: Flight,
    ulog: Flight,
    tlog_rows: pd.DataFrame,
    ulog_samples: pd.DataFrame,
    columns: list[str],
) -> np.ndarray:
    """Return tlog samples minus interpolated ULog samples at common boot times."""
    a, b = boot(tlog, tlog_rows), boot(ulog, ulog_samples)
    within = (a > b[0]) & (a < b[-1])
    return np.column_stack(
        [
            tlog_rows[c].to_numpy()[within] - np.interp(a[within], b, ulog_samples[c])
            for c in columns
        ]
    )


def assert_same_flight(tlog: Flight, ulog: Flight) -> None:
    """Check that EKF2 state, attitude and ground truth are equal in both files."""
    states = differences(tlog, ulog, tlog.ekf2.state, ulog.ekf2.state, Columns.POSITION)
    assert len(states) > 1000
    assert np.abs(np.median(states, axis=0)).max() < 1e-3
    assert np.percentile(np.abs(states), 99) < 0.02
    speeds = differences(tlog, ulog, tlog.ekf2.state, ulog.ekf2.state, Columns.VELOCITY)
    assert np.abs(np.median(speeds, axis=0)).max() < 2e-3
    assert np.percentile(np.abs(speeds), 99) < 0.06
    nearest = pd.merge_asof(
        tlog.attitude.set_axis(pd.Index(boot(tlog, tlog.attitude), name="t")),
        ulog.attitude.set_axis(pd.Index(boot(ulog, ulog.attitude), name="t")),
        left_index=True, right_index=True, direction="nearest", tolerance=0.011,
    ).dropna()  # fmt: skip
    assert len(nearest) > 1000
    one, other = (
        Rotation.from_quat(nearest[[c + s for c in Columns.QUATERNION]].to_numpy(copy=True),
                           scalar_first=True)
        for s in ("_x", "_y")
    )  # fmt: skip
    assert np.degrees(np.median((one.inv() * other).magnitude())) < 0.5
    truth = differences(tlog, ulog, tlog.truth.samples, ulog.truth.samples, Columns.POSITION)
    assert len(truth) > 1000
    # the projection origins are the first samples of the two files, which differ by millimetres
    assert np.abs(np.median(truth, axis=0)).max() < 0.015
    assert truth.std(axis=0).max() < 0.01


def test_read_log_of_sample_tlog_equals_its_ulog(sample_log, sample_flight):
    tlog = read_log(sample_log.with_suffix(".tlog"))
    late, rows = stamp_differences(tlog, sample_flight)
    assert len(rows) == len(track_of(sample_flight, "vehicle_visual_odometry").samples)
    assert np.abs(late).max() < 1e-3
    assert_same_flight(tlog, sample_flight)
    assert tlog.log.firmware_hash in ("unknown", sample_flight.log.firmware_hash[:16])


@pytest.mark.reallogs
@pytest.mark.parametrize("name", PAIRS)
def test_read_log_of_real_tlog_and_ulog_gives_equal_times(shared_logs, name):
    """The tlog times are the companion's timestamps converted to boot time.

    Without TIMESYNC the ULog has arrival times, 250 ms after the measurement.
    """
    tlog = read_log(shared_logs / "mavlink" / f"{name}.tlog")
    log = shared_logs / "simulated" / f"{name}.ulg"
    ulog, recorded = read_log(log), json.loads(log.with_suffix(".json").read_text())
    late, rows = stamp_differences(tlog, ulog)
    assert len(rows) > 590
    expected = -0.250 if "nosync" in name else 0.0
    spread = 0.015 if "nosync" in name else 1e-3
    assert np.median(late) == pytest.approx(expected, abs=2e-3)
    assert np.abs(late - expected).max() < spread
    offset = recorded["clock"]["px4_boot_minus_companion_unix_ns"] * 1e-9
    [clock] = [c for c in tlog.clocks if "component 197" in c.clock]
    assert clock.offset_s == pytest.approx(offset, abs=1e-3)
    # every position time equals a sent timestamp of the simulation
    stamps = [sample["usec_sent"] for sample in recorded["uwb"] if "usec_sent" in sample]
    sent = np.array(stamps) * 1e-6 + offset
    tlog_samples = boot(tlog, track_of(tlog, "VISION_POSITION_ESTIMATE").samples)
    nearest = np.abs(sent[None, :] - tlog_samples[:, None]).min(axis=1)
    assert nearest.max() < 1e-3
    assert_same_flight(tlog, ulog)


@pytest.mark.reallogs
def test_read_log_of_public_mavlink_recordings_succeeds(shared_logs):
    folder = shared_logs / "mavlink"
    flight = read_log(folder / "Ian-McConachie-CU_drone_position_hold_hist_40e21c1c_mav.tlog")
    [track] = flight.positions
    assert (flight.log.autopilot, track.clock_map.distinct_stamps) == ("ArduPilot", 2)
    assert track.compute_rate_hz() == pytest.approx(47.0, abs=2.0)
    assert flight.streams["imu"].topics == ("SCALED_IMU2",)
    assert ("RAW_IMU", 188) in [(unused.name, unused.count) for unused in flight.unused]
    vtol = read_log(folder / "ArduPilot_UAVLogViewer_vtol.tlog")
    assert (vtol.truth.name, vtol.log.autopilot) == ("SIMSTATE", "ArduPilot")
    sub = read_log(folder / "clydemcqueen_ardusub_log_tools_small.tlog")
    assert sub.log.hardware.startswith("submarine")
    assert len(sub.log.senders) == 5
    one, other = (read_log(folder / f"mbiuki_Phoenix_mission1.{s}") for s in ("tlog", "rlog"))
    assert one.log.boot_time_s == other.log.boot_time_s
    assert one.log.duration_s == other.log.duration_s


# ---- fuzz ---------------------------------------------------------------------------------------

EXTREME_INTEGERS = [0, 1, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**63, 2**64 - 1]
READ = [
    "HEARTBEAT", "HIGHRES_IMU", "SCALED_IMU", "SCALED_IMU2", "ATTITUDE", "ATTITUDE_QUATERNION",
    "ODOMETRY", "LOCAL_POSITION_NED", "ESTIMATOR_STATUS", "TIMESYNC",
    "SYSTEM_TIME", "VISION_POSITION_ESTIMATE", "ATT_POS_MOCAP", "EXTENDED_SYS_STATE",
    "PARAM_VALUE", "AUTOPILOT_VERSION", "HIL_STATE_QUATERNION", "SIMSTATE", "RAW_IMU",
]  # fmt: skip
SENDERS = [(1, 1), (1, 1), (1, 1), (1, 197), (2, 1), (255, 190)]


class FuzzCases:
    """Frames of a simulated recording, from which fuzz cases are made."""

    def __init__(self, folder: Path):
        self.path = folder / "fuzz.tlog"
        made = Aisle(seconds=4.0, asks=True, system_time=True).record()
        for name in ("LOCAL_POSITION_NED", "ATTITUDE", "SCALED_IMU2"):
            add(made, 5.0, lambda t, name=name: message(name, time_boot_ms=ms(t)), seconds=4.0)
        add(made, 5.0, lambda t: simulated("HIL_STATE_QUATERNION", Aisle(), t), seconds=4.0)
        add(made, 5.0, lambda t: message("ATT_POS_MOCAP", time_usec=us(unix(t))), COMPANION, 4.0)
        self.frames = [stamp(us_) + content for us_, _, content in made.frames()]

    def is_read(self, content: bytes) -> bool:
        """Return True if the content is read as a valid flight, False if it is rejected."""
        self.path.write_bytes(content)
        try:
            with time_limit():
                flight = read_log(self.path)
        except LogError:
            return False
        self.check(flight)
        return True

    def check(self, flight: Flight) -> None:
        parts = [flight.imu, flight.attitude, *(track.samples for track in flight.positions)]
        if isinstance(flight.truth, Truth):
            parts.append(flight.truth.samples)
        if isinstance(flight.ekf2, Ekf2):
            parts += [flight.ekf2.state, flight.ekf2.variance]
            assert np.isfinite(flight.ekf2.state.to_numpy()).all()
        for table in (part for part in parts if isinstance(part, pd.DataFrame)):
            times = table.index.to_numpy()
            assert np.isfinite(times).all()
            assert (np.diff(times) > 0.0).all()
            assert not np.isinf(table.to_numpy()).any()
        for track in flight.positions:
            assert np.isfinite(track.samples[Columns.POSITION].to_numpy()).all()
            assert not (track.samples[Columns.POSITION_VARIANCE].to_numpy() <= 0.0).any()
        for clock in flight.clocks:
            assert np.isfinite([clock.offset_s, clock.drift_ppm, clock.jitter_s]).all()
        assert np.isfinite([flight.log.boot_time_s, flight.log.duration_s]).all()
        assert flight.log.duration_s >= 0.0


@pytest.fixture(scope="module")
def fuzz_cases(tmp_path_factory) -> FuzzCases:
    return FuzzCases(tmp_path_factory.mktemp("fuzz"))


def malicious_value(rng: np.random.Generator, kind: np.dtype) -> bytes:
    """Make the bytes of one field: random, extreme, or a time near those of the flight."""
    size = kind.itemsize
    if kind.kind == "f":
        known = [0.0, 1.0, -1.0, 1e3, np.nan, np.inf, -np.inf, 3e38, 1e-38]
        return [rng.bytes(size), kind.type(rng.choice(known)).tobytes()][rng.integers(0, 2)]
    time_s = rng.choice([0.0, unix(0.0)]) + BOOT_S + rng.uniform(0.0, 4.0)
    numbers = [
        int.from_bytes(rng.bytes(size), "little"),
        EXTREME_INTEGERS[rng.integers(0, len(EXTREME_INTEGERS))],
        int(time_s * rng.choice([1e3, 1e6, 1e9])),
        int(rng.integers(0, 13)),
    ]
    return (numbers[rng.integers(0, 4)] % 256**size).to_bytes(size, "little")


def malicious_frame(rng: np.random.Generator) -> bytes:
    """Make a frame with a valid checksum and malicious content."""
    kind = MESSAGES[READ[rng.integers(0, len(READ))]]
    fields = [one for one, _ in wire_layout(kind.id).fields.values()]
    payload = b"".join(
        malicious_value(rng, one.base) for one in fields for _ in range(math.prod(one.shape))
    )
    if rng.integers(0, 8) == 0:
        payload = payload[: rng.integers(0, len(payload) + 1)]
    return raw_frame(
        kind.id, payload, seed=kind.crc_extra, sender=SENDERS[rng.integers(0, len(SENDERS))],
        sequence=int(rng.integers(0, 256)), v1=bool(kind.id < 256 and rng.integers(0, 8) == 0),
    )  # fmt: skip


def malicious_recording(
    rng: np.random.Generator, fuzz_cases: FuzzCases, pool: list[bytes]
) -> bytes:
    """Make a recording with some replaced frames, with or without receive times."""
    stamped = rng.integers(0, 3) > 0
    parts = list(fuzz_cases.frames) if rng.integers(0, 4) else []
    if parts and rng.integers(0, 2):
        first = int(rng.integers(0, len(parts)))
        parts = parts[first : first + int(rng.integers(1, 300))]
    # repeated frames, so that one part of a flight may consist of malicious frames only
    for _ in range(rng.integers(1, 40)):
        repeats = int(rng.integers(1, 12))
        at = int(rng.integers(0, len(parts) + 1))
        time_us = us(unix(BOOT_S + 4.0 * at / (len(parts) + 1)))
        if rng.integers(0, 10) == 0:
            time_us = EXTREME_INTEGERS[rng.integers(0, len(EXTREME_INTEGERS))]
        made = [pool[i] for i in rng.integers(0, len(pool), repeats).tolist()]
        parts[at:at] = [stamp(min(time_us + i, 2**64 - 1)) + one for i, one in enumerate(made)]
    return b"".join(parts if stamped else [part[8:] for part in parts])


def test_read_mavlink_with_malicious_values_raises_no_exception(fuzz_cases):
    rng = np.random.default_rng(1)
    read = 0
    for case in range(FUZZ_CASES):
        if case % 250 == 0:
            pool = [malicious_frame(rng) for _ in range(2000)]
        content = malicious_recording(rng, fuzz_cases, pool)
        try:
            read += fuzz_cases.is_read(content)
        except Exception as error:
            error.add_note(f"case {case}")
            raise
    assert read > 0.95 * FUZZ_CASES
