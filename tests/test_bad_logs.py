"""Damaged, unsupported and empty files: a flight or a px4fuse error.

:func:`read_log` returns one of both for any content.

It ends in limited time, prints nothing and raises no exception of the parser.
"""

import contextlib
import io
import re
import struct
import sys
from pathlib import Path

import numpy as np
import pytest
from time_limit import time_limit
from ulog_tools import Log, make_log, position, seconds_of, selector, stamps, take, topic

from px4fuse.cli import main
from px4fuse.comparison.preparation import choose_segment, choose_source
from px4fuse.diagnose import diagnose_or_check_aids
from px4fuse.errors import LogError, Px4FuseError
from px4fuse.filter.signals import make_axes
from px4fuse.flight.model import Flight, Unavailable
from px4fuse.info.inventory import list_log_contents
from px4fuse.readers import ULOG_MAGIC, read_log
from px4fuse.request import ComparisonRequest
from px4fuse.results.build import make_comparison_or_aids_results
from px4fuse.results.contract import to_json


def read_or_error(path: Path) -> Flight | Px4FuseError:
    """Return the flight or the px4fuse error; fail on any other exception or printed text."""
    printed = io.StringIO()
    result: Flight | Px4FuseError
    with contextlib.redirect_stdout(printed), time_limit():
        try:
            result = read_log(path)
        except Px4FuseError as error:
            result = error
    assert printed.getvalue() == ""
    if isinstance(result, Px4FuseError):
        assert "\n" not in str(result)
        assert str(result).startswith(f"{path.name}: ")
    return result


def read_error(path: Path) -> str:
    result = read_or_error(path)
    assert isinstance(result, LogError), "this file must be rejected"
    return str(result)


def read_and_make_axes(path: Path) -> Flight | None:
    """Read a log and make its axes; return None if it is rejected."""
    flight = read_or_error(path)
    if isinstance(flight, Px4FuseError):
        return None
    with contextlib.suppress(Px4FuseError):
        track, _ = choose_source(flight)
        axes = make_axes(flight, track, choose_segment(flight, track))
        for axis in axes:
            assert np.isfinite(axis.measurement_m).all()
            assert (np.diff(axis.measurement_time_s) > 0).all()
    return flight


# ---- not a log --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "empty"),
        (b"%PDF-1.4 and so on", "a PDF, not a flight log"),
        (b"\xa3\x95\x80DataFlash", "an ArduPilot DataFlash log, not a PX4 ULog"),
        *(
            (content, "neither a PX4 ULog nor a MAVLink recording")
            for content in (
                b"\0", b"ULog", ULOG_MAGIC[:-1], "a text file, naïve\n".encode(), bytes(4096),
            )
        ),
        *(
            (ULOG_MAGIC + content, "")
            for content in (
                b"", b"\x01", b"\x01" + bytes(7), b"\x01" + bytes(8), b"\x01" + bytes(200),
                b"\x01" + b"\xff" * 200, b"\x01" + b"\xff" * 40_000,
                b"\x01" + bytes(range(256)) * 8,
            )
        ),
    ],
)  # fmt: skip
def test_read_log_of_unsupported_file_format_is_rejected(tmp_path, content, words):
    path = tmp_path / "other.ulg"
    path.write_bytes(content)
    assert words in read_error(path)


@pytest.mark.parametrize(
    ("name", "content", "what", "command"),
    [
        (
            "uwb.csv",
            b"time_s,x_m,y_m,z_m\n0,1,2,3\n",
            "the file is a table",
            "compare LOG --position uwb.csv",
        ),
        ("slam.tum", b"0.0 1 2 3 0 0 0 1\n", "the file is a trajectory or pose", "loop slam.tum"),
        ("log.pdf", b"%PDF-1.7 and so on", "the file is a PDF", "verify log.pdf LOG"),
    ],
)
def test_read_log_of_unsuitable_file_suggests_another_command(
    tmp_path, name, content, what, command
):
    (tmp_path / name).write_bytes(content)
    message = read_error(tmp_path / name)
    assert message.startswith(f"{name}: {what}")
    assert message.endswith(f"px4fuse {command}.")


def test_read_log_with_mistyped_name_suggests_existing_file(tmp_path):
    make_log().write(tmp_path / "aisle_uwb.ulg")
    assert read_error(tmp_path / "aisle_uvb.ulg").endswith(
        f"Did you mean {tmp_path / 'aisle_uwb.ulg'}?"
    )


def test_read_log_without_known_topics_reports_no_data(tmp_path):
    at = stamps(2.0, 10.0)
    log = Log([topic("battery_status", at, {"voltage_v": np.full(len(at), 16.0)})])
    flight = read_or_error(log.write(tmp_path / "battery.ulg"))
    parts = (flight.imu, flight.attitude, flight.ekf2, flight.truth, flight.airborne)
    assert all(isinstance(part, Unavailable) for part in parts)
    assert set(parts[:4]) <= set(flight.missing)
    assert flight.positions == ()
    assert flight.streams == {}
    assert flight.log.duration_s == pytest.approx(1.9)
    assert any("battery_status" in note for note in flight.log.notes)
    inventory = list_log_contents(flight)
    assert all(row.unavailable for row in inventory.sources)
    assert not any(ability.possible for ability in inventory.abilities)
    with pytest.raises(Px4FuseError, match=r"no external position .* SDLOG_PROFILE to 129"):
        choose_source(flight)


def test_read_log_with_recursive_ulog_format_does_not_hang(tmp_path):
    """A format that contains itself must not cause infinite recursion."""
    path = tmp_path / "nested.ulg"
    content = make_log("v1.16", 1.0).encode()
    name = b"vehicle_attitude:"
    at = content.index(name)
    length = struct.unpack("<H", content[at - 3 : at - 1])[0]
    text = b"vehicle_attitude:uint64_t timestamp;vehicle_attitude a;"
    message = struct.pack("<HB", len(text), ord("F")) + text
    path.write_bytes(content[: at - 3] + message + content[at + length :])
    read_or_error(path)


@pytest.mark.parametrize("key", ["char[4] ver_sw_release", "uint32_t[1] ver_sw_release",
                                 "float ver_sw_release"])  # fmt: skip
def test_read_log_ignores_firmware_version_of_wrong_type(tmp_path, key):
    """A damaged type name makes the release number another type."""
    content = make_log("v1.16", 1.0).encode()
    old = b"uint32_t ver_sw_release"
    at = content.index(old) - 1
    assert content[at] == len(old)
    size = struct.unpack("<H", content[at - 3 : at - 1])[0] + len(key) - len(old)
    new = struct.pack("<H", size) + b"I" + bytes([len(key)]) + key.encode()
    path = tmp_path / "release.ulg"
    path.write_bytes(content[: at - 3] + new + content[at + 1 + len(old) :])
    flight = read_or_error(path)
    assert len(flight.imu) == 100


# ---- logs without a part ----------------------------------------------------------------------


def write_and_read(log: Log, tmp_path: Path) -> Flight:
    flight = read_or_error(log.write(tmp_path / "made.ulg"))
    assert isinstance(flight, Flight)
    return flight


@pytest.mark.parametrize(
    ("topic", "part"),
    [
        ("sensor_combined", "imu"),
        ("vehicle_attitude", "attitude"),
        ("vehicle_local_position", "ekf2"),
        ("vehicle_land_detected", "airborne"),
    ],
)
def test_read_log_without_one_topic_contains_all_other_data(tmp_path, topic, part):
    flight = write_and_read(make_log("v1.16", 2.0).drop(topic), tmp_path)
    for name in ("imu", "attitude", "ekf2", "airborne"):
        assert isinstance(getattr(flight, name), Unavailable) == (name == part)
    assert (getattr(flight, part) in flight.missing) == (part != "airborne")
    track, _ = choose_source(flight)
    assert track.name == "vehicle_visual_odometry"
    if part == "attitude":
        axis = make_axes(flight, track, choose_segment(flight, track))[0]
        assert axis.acceleration is flight.attitude


def rich_log() -> Log:
    """Make a v1.16 log with all topics that are read, including optional fields."""
    log = make_log("v1.16", 2.0)
    at = stamps(2.0, 5.0)
    count = len(at)
    fix = {"fix_type": np.full(count, 3, np.uint8), "eph": np.ones(count), "epv": np.ones(count)}
    receiver = topic("vehicle_gps_position", at, fix)
    receiver.fields.update(
        {"latitude_deg": np.full(count, 47.0), "longitude_deg": np.full(count, 8.0)}
    )
    receiver.fields["altitude_msl_m"] = np.full(count, 500.0)
    truth = topic("vehicle_global_position_groundtruth", at, {
        "alt": np.full(count, 500.0), "vel_n": np.zeros(count), "vel_e": np.zeros(count),
        "vel_d": np.zeros(count),
    })  # fmt: skip
    truth.fields.update({"lat": np.full(count, 47.0), "lon": np.full(count, 8.0)})
    local = log["vehicle_local_position"]
    for name, value in (("ref_lat", 47.0), ("ref_lon", 8.0), ("ref_alt", 500.0)):
        local[name] = np.full(len(local["timestamp"]), value)
    return log.add(receiver, truth, selector([(0.0, 0)]))


@pytest.mark.parametrize("name", sorted(rich_log().names()))
def test_read_log_with_any_one_field_removed_succeeds(tmp_path, name):
    """Fields may be missing in other PX4 releases or in a damaged format."""
    for field in rich_log()[name].keys() - {"timestamp"}:
        log = rich_log()
        del log[name][field]
        assert read_and_make_axes(log.write(tmp_path / "made.ulg")) is not None, field


# ---- impossible values ------------------------------------------------------------------------


def test_read_log_rejects_log_whose_timestamps_are_all_zero(tmp_path):
    log = make_log("v1.16", 2.0)
    for made in log.topics:
        made.fields["timestamp"][:] = 0
        made.fields.get("timestamp_sample", np.zeros(1))[:] = 0
    assert "all timestamps are zero" in read_error(log.write(tmp_path / "zero.ulg"))


def test_read_log_adds_note_on_topic_with_zero_timestamps(tmp_path):
    """ekf2_innovations of a real log of 2016 had this fault."""
    log = make_log("v1.9", 2.0)
    log["ekf2_innovations"]["timestamp"][:] = 0
    flight = write_and_read(log, tmp_path)
    assert isinstance(flight.ekf2.innovations["north"], Unavailable)
    assert any("ekf2_innovations" in note for note in flight.log.notes)


@pytest.mark.parametrize(
    "name", ["sensor_combined", "vehicle_attitude", "vehicle_visual_odometry",
             "vehicle_local_position", "estimator_aid_src_ev_pos"],
)  # fmt: skip
def test_read_log_drops_swapped_timestamps_with_a_note(tmp_path, name):
    log = make_log("v1.16", 4.0)
    index = next(i for i, made in enumerate(log.topics) if made.name == name)
    count = len(log[name]["timestamp"])
    order = np.arange(count)
    order[[5, 12]] = order[[12, 5]]
    log.topics[index] = take(log.topics[index], order)
    flight = write_and_read(log, tmp_path)
    frames = [flight.imu, flight.attitude, flight.ekf2.state, flight.ekf2.innovations["north"]]
    frames += [track.samples for track in flight.positions]
    assert all((np.diff(frame.index) > 0).all() for frame in frames)
    [note] = [note for note in flight.log.notes if f"samples of {name} dropped" in note]
    assert note.endswith(": 2")
    state = flight.ekf2.state
    np.testing.assert_allclose(state["north_m"], position(state.index)[:, 0], rtol=1e-6)


def test_read_log_with_reboot_keeps_the_longer_part(tmp_path):
    log = make_log("v1.16", 4.0)
    for made in log.topics:
        for name in ("timestamp", "timestamp_sample"):
            if name in made.fields:
                late = seconds_of(made.fields["timestamp"]) >= 3.0
                made.fields[name][late] -= np.uint64(3_000_000)
    flight = write_and_read(log, tmp_path)
    assert flight.log.duration_s == pytest.approx(2.99, abs=0.2)
    assert (np.diff(flight.imu.index) > 0).all()


MISSING_PARTS = {
    ("sensor_combined", "accelerometer_m_s2"): lambda flight: flight.imu,
    ("vehicle_attitude", "q"): lambda flight: flight.attitude,
    ("vehicle_visual_odometry", "position"): lambda flight: None,
    ("estimator_aid_src_ev_pos", "observation"): lambda flight: None,
    ("estimator_aid_src_ev_pos", "innovation"): lambda flight: flight.ekf2.innovations["north"],
    ("estimator_states", "covariances"): lambda flight: flight.ekf2.variance,
    ("vehicle_local_position", "vz"): lambda flight: flight.ekf2,
}


@pytest.mark.parametrize("value", [np.nan, -np.inf])
@pytest.mark.parametrize(("name", "field"), MISSING_PARTS)
def test_log_field_without_finite_values_is_unavailable(tmp_path, name, field, value):
    log = make_log("v1.16", 2.0)
    log[name][field][:] = value
    flight = read_and_make_axes(log.write(tmp_path / "made.ulg"))
    part = MISSING_PARTS[name, field](flight)
    if part is None:
        assert name not in [track.name for track in flight.positions]
    else:
        assert isinstance(part, Unavailable)


@pytest.mark.parametrize("value", [7.4e8, -1.1e4])
def test_read_log_drops_impossible_acceleration_sample(tmp_path, value):
    """One such sample made the information matrix of the noises indefinite (found by fuzzing)."""
    log = make_log("v1.16", 10.0)
    log["sensor_combined"]["accelerometer_m_s2"][500, 2] = value
    flight = read_log(log.write(tmp_path / "l.ulg"))
    assert len(flight.imu) == 999
    assert flight.imu["down_m_s2"].abs().max() < 10.0


def test_read_log_drops_single_nan_samples(tmp_path):
    log = make_log("v1.16", 2.0)
    log["sensor_combined"]["accelerometer_m_s2"][[10, 20], 1] = np.nan
    log["vehicle_attitude"]["q"][7, 3] = np.nan
    log["vehicle_attitude"]["q"][:5] = 0.0
    log["vehicle_local_position"]["vx"][4] = np.nan
    flight = write_and_read(log, tmp_path)
    assert (len(flight.imu), len(flight.attitude), len(flight.ekf2.state)) == (198, 34, 19)


@pytest.mark.parametrize("parameter", ["EKF2_EV_DELAY", "EKF2_EVP_GATE"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_read_log_with_nan_delay_parameter_gives_finite_times(tmp_path, parameter, value):
    log = make_log("v1.16", 2.0)
    log.parameters[parameter] = value
    flight = read_and_make_axes(log.write(tmp_path / "made.ulg"))
    for track in flight.positions:
        assert np.isfinite(track.samples.index).all()


@pytest.mark.parametrize(
    ("parameter", "value", "note"),
    [
        ("EKF2_GYR_NOISE", 1e30, "1e+30 rad/s is outside PX4's range 0.0001 to 0.1. "
         "px4fuse uses the parameter default 0.015."),
        ("EKF2_PREDICT_US", -1.0, "-1 µs is outside PX4's range 1000 to 20000. "
         "px4fuse uses the parameter default 10000."),
        ("EKF2_EVV_GATE", 0.0, "0 SD is outside PX4's range 1 to 1000. "
         "px4fuse uses the parameter default 3."),
        ("EKF2_EV_POS_X", 1e30, "1e+30 m is outside PX4's range -100 to 100. "
         "px4fuse uses the parameter default 0."),
        ("EKF2_ACC_NOISE", np.nan, "is not a finite number. "
         "px4fuse uses the parameter default 0.35."),
        ("SDLOG_PROFILE", np.inf, "is not a finite number. px4fuse ignores SDLOG_PROFILE."),
    ],
)  # fmt: skip
def test_px4_parameter_out_of_range_is_replaced_by_default(tmp_path, parameter, value, note):
    log = rich_log()
    log.parameters[parameter] = value
    flight = write_and_read(log, tmp_path)
    assert [message for message in flight.log.notes if parameter in message] == [
        f"{parameter} {note}"
    ]
    assert flight.log.parameters.get(parameter) != value
    assert flight.ekf2.step_s == 0.01
    assert all(aid.parameters.get(parameter) != value for aid in flight.ekf2.aids.values())


def test_px4_parameter_at_float32_limit_of_range_is_accepted(tmp_path):
    log = make_log("v1.16", 2.0)
    lowest = float(np.float32(0.01))  # 0.0099999998
    log.parameters |= {"EKF2_EVP_NOISE": lowest, "EKF2_GYR_NOISE": float(np.float32(0.1))}
    flight = write_and_read(log, tmp_path)
    assert flight.log.parameters["EKF2_EVP_NOISE"] == lowest
    assert flight.log.notes == ()


@pytest.mark.parametrize("count", [0, 1, 2])
def test_read_log_with_0_to_2_samples_per_topic_succeeds(tmp_path, count):
    log = make_log("v1.16", 2.0)
    log.topics = [take(made, range(count)) for made in log.topics]
    result = read_or_error(log.write(tmp_path / "made.ulg"))
    if count == 0:
        assert isinstance(result, LogError)
    else:
        assert result.positions == ()
        assert isinstance(result.imu, Unavailable) == (count == 1)


def flags_at_largest_time(log: Log) -> None:
    log["estimator_status_flags"]["timestamp"][:] = np.uint64(2**64 - 1)
    log["estimator_status_flags"]["timestamp_sample"][:] = np.uint64(2**64 - 1)


def flags_late(log: Log) -> None:
    log["estimator_status_flags"]["timestamp"] += np.uint64(60_000_000)
    log["estimator_status_flags"]["timestamp_sample"] += np.uint64(60_000_000)


def one_state(log: Log) -> None:
    log.topics = [take(one, [0]) if one.name == "estimator_states" else one for one in log.topics]


def source_frozen(log: Log) -> None:
    log["estimator_aid_src_ev_pos"]["innovation"][:] = 0.1


def truth_impossible(log: Log) -> None:
    at = stamps(20.0, 10.0)
    names = ("x", "y", "z", "vx", "vy", "vz")
    fields = {name: np.full(len(at), 1e30) for name in names}
    log.add(topic("vehicle_local_position_groundtruth", at, fields))


@pytest.mark.parametrize(
    "damage", [flags_at_largest_time, flags_late, one_state, source_frozen, truth_impossible],
    ids=lambda one: one.__name__,
)  # fmt: skip
def test_compare_of_log_with_damaged_values_gives_finite_results(tmp_path, damage):
    """Warnings are errors in these tests."""
    log = make_log("v1.16", 20.0)
    damage(log)
    request = ComparisonRequest(log=str(log.write(tmp_path / "made.ulg")))
    results = make_comparison_or_aids_results(request, diagnose_or_check_aids(request))
    assert not re.search(r"\b(nan|inf)\b|e\+[23]\d", to_json(results))
    if damage is truth_impossible:
        reason = "vehicle_local_position_groundtruth has no finite sample"
        assert any(reason in missing.reason for missing in results.missing)


def test_read_ekf2_covariance_drops_negative_variance(tmp_path):
    """The square root of a negative variance would be NaN, with a warning."""
    log = make_log("v1.16", 2.0)
    states = log["estimator_states"]
    states["states"][:, 0] = 1.0
    states["covariances"][2, 7] = -1e-9
    assert (
        len(write_and_read(log, tmp_path).ekf2.record.delayed_state) == len(states["timestamp"]) - 1
    )


def test_info_command_shows_no_rate_for_a_single_sample(tmp_path):
    log = make_log("v1.16", 20.0)
    name = "estimator_aid_src_ev_hgt"
    log.topics = [take(one, [50]) if one.name == name else one for one in log.topics]
    flight = write_and_read(log, tmp_path)
    aids = next(one for one in list_log_contents(flight).abilities if one.name.startswith("aiding"))
    assert "external vision, height: 1 sample" in aids.reason
    assert "nan" not in aids.reason


@pytest.mark.parametrize("command", ["sync", "tune", "loop"])
@pytest.mark.parametrize(("value", "whole"), [(3e38, True), (-1e20, False)])
@pytest.mark.parametrize(
    ("name", "column"),
    [("vehicle_visual_odometry", "position"), ("sensor_combined", "accelerometer_m_s2")],
)
def test_commands_on_impossible_log_values_print_no_nan(
    tmp_path, monkeypatch, capsys, name, column, whole, value, command
):
    """Warnings of overflow are errors in these tests."""
    log = make_log("v1.16", 20.0)
    values = log[name][column]
    values[slice(None) if whole else len(values) // 2] = value
    options = ["--axis", "north"] if command in ("sync", "tune") else []
    path = log.write(tmp_path / "l.ulg")
    monkeypatch.setattr(sys, "argv", ["px4fuse", command, str(path), *options])
    with pytest.raises(SystemExit) as ended:
        main()
    out, err = capsys.readouterr()
    assert (ended.value.code or 0, len(err.splitlines())) in ((0, 0), (2, 1))
    assert not re.search(r"\b(nan|inf)\b", out)
