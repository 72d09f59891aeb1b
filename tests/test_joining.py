"""Joining of two recordings of one flight; recordings of two flights are refused."""

import numpy as np
import pandas as pd
import pytest
from exchange import replace
from flights import aisle_flight
from mavlink_tools import BOOT_S, Aisle, boot, track_of, unix
from ulog_tools import load

from px4fuse.alignment.merge_recordings import join, shift_times
from px4fuse.errors import MissingDataError
from px4fuse.flight.model import AXIS_NAMES, Columns, Flight, FlightMode, Reset, Unavailable
from px4fuse.readers import read_log

POSITION_TOPICS = ("vehicle_visual_odometry", "estimator_aid_src_ev_pos")


@pytest.fixture(scope="module")
def tlog_flight(sample_log) -> Flight:
    return read_log(sample_log.with_suffix(".tlog"))


@pytest.fixture(scope="module")
def stripped(sample_log, tmp_path_factory) -> Flight:
    """Sample ULog without position topics, as with SDLOG_PROFILE 1 on v1.15."""
    log = load(sample_log)
    log.drop(*(name for name in log.names() if name.startswith(POSITION_TOPICS)))
    path = tmp_path_factory.mktemp("stripped") / "stripped.ulg"
    return read_log(log.write(path))


@pytest.fixture
def record(tmp_path):
    def write_and_read(aisle: Aisle, name: str = "made.tlog", *leave_out: str) -> Flight:
        recorder = aisle.record()
        recorder.sent = [s for s in recorder.sent if s[2].get_type() not in leave_out]
        path = tmp_path / name
        path.write_bytes(recorder.tlog())
        return read_log(path)

    return write_and_read


# ---- the sample -------------------------------------------------------------------------------


def test_joined_ulog_without_positions_gets_those_of_the_tlog(stripped, tlog_flight, sample_flight):
    assert "vehicle_visual_odometry" not in [t.name for t in stripped.positions]
    joined = join(stripped, tlog_flight)
    assert joined.positions[0].name == "VISION_POSITION_ESTIMATE"
    mine = joined.positions[0].samples
    truth = track_of(sample_flight, "vehicle_visual_odometry").samples
    ours, theirs = (
        samples[Columns.POSITION].set_axis(pd.Index(boot(flight, samples), name="t"))
        for flight, samples in ((joined, mine), (sample_flight, truth))
    )
    nearest = pd.merge_asof(
        theirs, ours, left_index=True, right_index=True, direction="nearest", tolerance=1e-3
    )
    left, right = (nearest[[c + end for c in Columns.POSITION]] for end in ("_x", "_y"))
    np.testing.assert_allclose(left, right, atol=1e-6)
    assert joined.log.boot_time_s == stripped.log.boot_time_s
    for part in ("imu", "attitude", "truth", "airborne"):
        assert getattr(joined, part) is getattr(stripped, part)
    assert joined.ekf2.state is stripped.ekf2.state
    assert joined.streams["imu"].log == "stripped.ulg"
    assert joined.log.senders == tlog_flight.log.senders
    set_back = replace(tlog_flight, log=replace(tlog_flight.log, receive_time_reversals=3))
    assert join(stripped, set_back).log.receive_time_reversals == 3
    [given] = joined.inputs
    assert (given.name, given.role) == ("aisle_uwb.tlog", "mavlink")
    assert given.sha256 == tlog_flight.log.sha256


def test_joined_recordings_have_equal_times_in_either_order(sample_flight, tlog_flight):
    one, other = join(sample_flight, tlog_flight), join(tlog_flight, sample_flight)
    note = one.log.notes[-1]
    for said in ("joined with aisle_uwb.tlog", "129.7 s in common", "differ by 0.001 m (median)"):
        assert said in note
    for joined in (one, other):
        places = [t.origin.preference for t in joined.positions]
        assert places == sorted(places)
    for name in ("vehicle_visual_odometry", "VISION_POSITION_ESTIMATE"):
        first, second = track_of(one, name).samples, track_of(other, name).samples
        np.testing.assert_allclose(boot(one, first), boot(other, second), atol=1e-6)
    # MAVLink contains no innovations, and an existing EKF2 is not replaced
    assert isinstance(other.ekf2.innovations["north"], Unavailable)


# ---- made recordings ----------------------------------------------------------------------------


def test_joined_recording_copies_missing_data_with_shifted_time(record):
    """The second recording starts 5 s later."""
    left_out = "HIGHRES_IMU", "ATTITUDE_QUATERNION", "EXTENDED_SYS_STATE", "ODOMETRY"
    bare = record(Aisle(uwb=None), "bare.tlog", *left_out)
    assert bare.log.duration_s == 0.0 or isinstance(bare.imu, Unavailable)
    bare = replace(bare, log=replace(bare.log, boot_time_s=BOOT_S, duration_s=40.0))
    full = record(Aisle(seconds=40.0, start_s=BOOT_S + 5.0), "full.tlog")
    joined = join(bare, full)
    for part in ("imu", "attitude", "airborne", "ekf2"):
        assert isinstance(getattr(bare, part), Unavailable)
        assert not isinstance(getattr(joined, part), Unavailable)
    parts = ((one.imu, one.ekf2.state, one.ekf2.variance) for one in (joined, full))
    for ours, theirs in zip(*parts, strict=True):
        np.testing.assert_allclose(boot(joined, ours), boot(full, theirs), atol=1e-9)
    np.testing.assert_allclose(joined.airborne, np.array(full.airborne) + 5.0, atol=1e-9)
    assert joined.streams["imu"] == full.streams["imu"]
    assert joined.streams["ekf2_variance"] == full.streams["ekf2_variance"]
    assert "not verified that both are of the same flight" in joined.log.notes[-1]


def test_shift_times_also_shifts_times_inside_records(sample_flight):
    ekf2 = replace(sample_flight.ekf2, instances=((0.0, 0), (9.0, 1)), gate=5.0)
    ekf2 = replace(ekf2, resets=(Reset(3.0, "position", (1.0, 0.0, 0.0)),))
    moved = shift_times(ekf2, 2.5)
    assert moved.instances == ((2.5, 0), (11.5, 1))
    assert moved.resets == (Reset(5.5, "position", (1.0, 0.0, 0.0)),)
    assert (moved.gate, moved.step_s) == (5.0, ekf2.step_s)
    assert shift_times((FlightMode(1.0, 2.0, "Land"),), 2.5) == (FlightMode(3.5, 4.5, "Land"),)


def test_joined_recording_lists_only_data_missing_in_both(record):
    bare = record(Aisle(uwb=None), "bare.tlog", "ODOMETRY", "HIGHRES_IMU")
    full = record(Aisle(), "full.tlog")
    assert {"EKF2", "IMU"} <= {part.what for part in bare.missing}
    joined = join(bare, full)
    whats = [part.what for part in joined.missing]
    assert "EKF2" not in whats
    assert "IMU" not in whats
    assert whats.count("ground truth") == 1
    for axis in AXIS_NAMES:
        assert f"EKF2 innovations, {axis}" in whats
    assert len(whats) == len(set(whats))


@pytest.mark.parametrize("earlier_s", [0.0, 10.0])
def test_joined_recording_has_senders_and_shifted_unix_time(record, earlier_s):
    ulog = aisle_flight(duration_s=60.0, ekf2=None, attitude_hz=None)
    ulog = replace(ulog, log=replace(ulog.log, boot_time_s=BOOT_S - earlier_s))
    flight = record(Aisle(system_time=True))
    joined = join(ulog, flight)
    assert joined.log.start_unix_s == pytest.approx(unix(BOOT_S - earlier_s), abs=1e-2)
    assert joined.log.senders == flight.log.senders
    assert flight.clocks[0] in joined.clocks


# ---- refusals -----------------------------------------------------------------------------------


def test_join_of_recordings_without_overlap_states_both_spans(record):
    first = record(Aisle(seconds=20.0), "first.tlog")
    second = record(Aisle(seconds=20.0, start_s=BOOT_S + 30.0), "second.tlog")
    said = r"first.tlog and second.tlog do not overlap.*50.0 s to 70.0 s.*80.0 s to 100.0 s"
    with pytest.raises(MissingDataError, match=said):
        join(first, second)


def test_join_of_flights_with_different_positions_is_rejected(sample_flight, tlog_flight):
    moved = replace(tlog_flight.ekf2, state=tlog_flight.ekf2.state + 3.0)
    with pytest.raises(
        MissingDataError, match="are different flights: their EKF2 positions differ"
    ):
        join(sample_flight, replace(tlog_flight, ekf2=moved))


@pytest.mark.reallogs
def test_join_of_other_flight_with_same_boot_time_is_rejected(shared_logs, sample_flight):
    other = read_log(shared_logs / "mavlink" / "v1.16.1_aisle_clock_nosync.tlog")
    other = replace(other, log=replace(other.log, boot_time_s=sample_flight.log.boot_time_s))
    with pytest.raises(MissingDataError, match="different flights"):
        join(sample_flight, other)
