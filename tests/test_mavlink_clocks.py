"""Clock mapping of recordings whose clocks are linear functions of the boot clock."""

from dataclasses import astuple

import numpy as np
import pytest
from exchange import replace
from hypothesis import example, given, settings
from hypothesis import strategies as st
from mavlink_tools import (
    AUTOPILOT,
    BOOT_S,
    COMPANION,
    GROUND,
    LEAST_DELAY_S,
    UNIX_S,
    Aisle,
    Recorder,
    frame,
    heartbeat,
    message,
    ms,
    ns,
    same,
    stamp,
    unix,
    us,
)

from px4fuse.errors import SettingsError
from px4fuse.flight.model import Flight, compute_sample_rate_hz
from px4fuse.readers import read_log
from px4fuse.readers.mavlink_recording import ClockLine, fit_clock_line
from px4fuse.readers.mavlink_senders import map_clock_to_boot

EMPTY = np.zeros(0)
NO_EXCHANGES = (EMPTY, EMPTY), (EMPTY, EMPTY)


def clock_error(flight: Flight, aisle: Aisle, track: int = 0) -> np.ndarray:
    """Return the boot time that the reader gives each position, minus the true one (s)."""
    times = flight.positions[track].samples.index.to_numpy() + flight.log.boot_time_s
    true = np.array(aisle.times(5.0))
    assert len(times) == len(true)
    return times - true


# ---- least delay ------------------------------------------------------------------------------


@given(
    offset=st.floats(-1e9, 1e9), drift_ppm=st.floats(-200.0, 200.0), least=st.floats(0.0, 0.5),
    scale=st.floats(0.0, 0.3), seed=st.integers(0, 2**32 - 1),
)  # fmt: skip
@settings(max_examples=60)
def test_mavlink_clock_fit_with_random_delay_recovers_offset(offset, drift_ppm, least, scale, seed):
    """1200 messages in 120 s: the smallest delay in each 2 s is scale/20 on average."""
    rng = np.random.default_rng(seed)
    x = np.arange(1200) * 0.1
    exact = offset + (1.0 + drift_ppm * 1e-6) * x
    line = fit_clock_line(x, exact + least + rng.exponential(scale, len(x)))
    error = line.at(x) - exact - least
    rounding = 4.0 * np.spacing(abs(offset) + 200.0)
    assert np.all(error > -0.2 * scale - rounding)
    assert np.all(error < 0.3 * scale + rounding)
    assert abs(line.slope - 1.0 - drift_ppm * 1e-6) < scale * 5e-3 + rounding / 10.0


@pytest.mark.parametrize(("span", "slope"), [(100.0, 1.00005), (20.0, 1.0)])
def test_mavlink_clock_fit_of_messages_without_delay_is_exact(span, slope):
    x = np.linspace(0.0, span, 500)
    line = fit_clock_line(x, 7.0 + 1.00005 * x)
    assert (line.reading_pair_count, line.slope) == (500, pytest.approx(slope, abs=1e-12))
    np.testing.assert_allclose(line.at(x), 7.0 + 1.00005 * x, atol=1e-9 if span > 30 else 1e-3)
    np.testing.assert_allclose(line.inverse().at(line.at(x)), x, atol=1e-9)
    assert line.jitter_s < 1e-3


@pytest.mark.parametrize("speed", [0.04, 0.5, 10.0])
@pytest.mark.parametrize("span", [10.0, 100.0])
def test_clock_fit_finds_playback_speed_of_recording(speed, span):
    x = np.linspace(0.0, span, 600)
    delay = np.random.default_rng(1).exponential(0.01, len(x))
    line = fit_clock_line(x, 5.0 + speed * x + delay)
    assert line.slope == pytest.approx(speed, rel=0.01)
    assert np.abs(line.at(x) - 5.0 - speed * x).max() < 0.05


@given(st.lists(st.tuples(st.floats(-1e13, 1e13), st.floats(-1e13, 1e13)), min_size=1, max_size=60))
# a slope of 5.5e-309, whose inverse is infinite
@example([(0.0, 0.0), (4.0, 2.2e-308)])
# a slope of 1e321, which is infinite
@example([(-2.0, 0.0), (-1e-308, 0.0), (1e-308, 1e13), (2e-308, 1e13), (2.0, 1e13)])
@settings(max_examples=100)
def test_mavlink_clock_fit_of_any_time_pairs_is_invertible(pairs):
    x, y = np.array(pairs).T
    line = fit_clock_line(x, y)
    turned = line.inverse()
    assert line.slope > 0.0
    assert turned.slope > 0.0
    assert np.isfinite(astuple(line)).all()
    assert np.isfinite(astuple(turned)).all()


# ---- method of the clock map --------------------------------------------------------------------


DAY_S, HOUR_S, WAY_S = 86_400.0, 3600.0, LEAST_DELAY_S
# Case: flight, expected method, beginning of the clock's name, limits of the mean error (s)
METHODS = {
    # the companion replies after the autopilot's request has reached it
    "replies only, early by the link delay":
        (Aisle(seconds=60.0), "TIMESYNC", "UNIX time", (-1.5 * WAY_S, 0.0)),
    "requests only, late by the link delay": (
        Aisle(seconds=60.0, replies=False, asks=True), "TIMESYNC", "UNIX time", (0.0, 1.5 * WAY_S),
    ),
    "both directions cancel the link delay":
        (Aisle(seconds=60.0, asks=True), "TIMESYNC", "UNIX time", (-0.25 * WAY_S, 0.25 * WAY_S)),
    "TIMESYNC with a ground station clock that is wrong by one hour":
        (Aisle(receiver=lambda boot: UNIX_S + HOUR_S + boot), "TIMESYNC", "UNIX time",
         (-1.5 * WAY_S, 1.5 * WAY_S)),
    "second choice is SYSTEM_TIME":
        (Aisle(replies=False, system_time=True), "SYSTEM_TIME", "UNIX time", (-1e-3, 1e-3)),
    "SYSTEM_TIME is not used for a companion with a wrong date":
        (Aisle(replies=False, system_time=True, clock=lambda boot: UNIX_S - DAY_S + boot),
         "receive time", "UNIX time", (-1.5 * WAY_S, 1.5 * WAY_S)),
    # both links have the same minimum delay, which cancels
    "last choice is receive time":
        (Aisle(replies=False, seconds=60.0), "receive time", "UNIX time", (-1.5e-3, 1.5e-3)),
    "a boot clock needs no mapping":
        (Aisle(clock=same, replies=False), "boot clock", "system 1", (-1e-6, 1e-6)),
    # a companion's monotonic clock that started 3 s later
    "TIMESYNC for a clock that started seconds after the autopilot's":
        (Aisle(clock=lambda boot: boot - 3.0, asks=True), "TIMESYNC", "clock of", (-WAY_S, WAY_S)),
    "receive time for another clock hours away":
        (Aisle(clock=lambda boot: boot + 2 * HOUR_S, replies=False), "receive time", "clock of",
         (-1.5 * WAY_S, 1.5 * WAY_S)),
}  # fmt: skip
NOTES = {
    "SYSTEM_TIME": "UNIX clocks of sender and autopilot",
    "receive time": "minimum delay of the link",
}


@pytest.mark.parametrize("case", METHODS)
def test_clock_mapping_prefers_timesync_then_system_time(read, case):
    aisle, method, clock, (low, high) = METHODS[case]
    flight = read(aisle)
    found = flight.positions[0].clock_map
    assert (found.method, found.clock[: len(clock)]) == (method, clock)
    assert NOTES.get(method, "") in found.note
    error = clock_error(flight, aisle)
    assert np.abs(error).max() <= max(-low, high)
    assert low <= error.mean() <= high
    middle = BOOT_S + aisle.seconds / 2.0
    assert found.offset_s == pytest.approx(middle - aisle.clock(middle), abs=2 * WAY_S)
    if "both" in case:
        assert found.pairs == 1200
    if "second" in case and method == "SYSTEM_TIME":
        assert flight.log.start_unix_s == pytest.approx(UNIX_S + BOOT_S, abs=1e-3)
    here = np.array([aisle.path(boot)[0] for boot in aisle.times(5.0)])
    np.testing.assert_allclose(flight.positions[0].samples.to_numpy()[:, :3], here, atol=1e-5)


@pytest.mark.parametrize("asks", [False, True])
def test_constant_mavlink_timestamp_is_replaced_by_receive_time(read, asks):
    """TIMESYNC is not used for timestamps that are not a clock."""
    aisle = Aisle()
    recorder = replace(aisle, uwb=None, asks=asks).record()
    rng = np.random.default_rng(1)
    for i, boot in enumerate(aisle.times(5.0)):
        made = message(
            "VISION_POSITION_ESTIMATE", usec=us(UNIX_S) + (i >= 100), x=1.0 + i,
            covariance=[0] * 21,
        )  # fmt: skip
        recorder.hear(unix(boot + aisle.delay(rng)), COMPANION, made)
    flight = read(recorder)
    track = flight.positions[0]
    assert track.clock_map.distinct_stamps == 2
    assert track.clock_map.method == "receive time"
    assert "2 distinct values" in track.clock_map.note
    assert np.abs(clock_error(flight, aisle)).max() < 0.02
    # the delay is exponential with a mean of 2 ms
    assert 0.5e-3 < track.clock_map.jitter_s < 4e-3


def test_mavlink_clocks_of_two_companions_are_separated(read):
    """Both send TIMESYNC requests; ``ts1`` assigns the autopilot's replies."""
    first = Aisle(asks=True, replies=False)
    second = replace(first, clock=lambda boot: unix(boot) + 2.0, seed=2, state=None)
    recorder = first.record()
    other = second.record()
    recorder.sent += [
        (received, (1, 198) if sender == COMPANION else sender, made, link)
        for received, sender, made, link in other.sent
        if sender == COMPANION or made.get_type() == "TIMESYNC"
    ]
    flight = read(recorder)
    assert [t.name for t in flight.positions] == [
        "VISION_POSITION_ESTIMATE_1_197", "VISION_POSITION_ESTIMATE_1_198",
    ]  # fmt: skip
    for number, aisle in enumerate((first, second)):
        assert flight.positions[number].clock_map.method == "TIMESYNC"
        assert np.abs(clock_error(flight, aisle, number)).max() < 1.5 * LEAST_DELAY_S


def test_mavlink_clock_mapping_ignores_ground_station_timesync(read):
    """QGroundControl sends requests with its clock and replies to the autopilot."""
    aisle = Aisle(asks=True)
    recorder = aisle.record()
    for boot in aisle.times(10.0):
        wrong = unix(boot) - 5.0
        recorder.hear(unix(boot), GROUND, message("TIMESYNC", tc1=ns(wrong), ts1=ns(boot)))
        recorder.hear(unix(boot), GROUND, message("TIMESYNC", ts1=ns(wrong)))
        reply = message("TIMESYNC", tc1=ns(boot + 0.004), ts1=ns(wrong))
        recorder.hear(unix(boot), AUTOPILOT, reply)
    flight = read(recorder)
    assert np.abs(clock_error(flight, aisle)).max() < LEAST_DELAY_S


def test_mavlink_stream_without_receive_time_uses_timesync(read):
    for replies, method, allowed in (
        (True, "TIMESYNC", 1.5 * LEAST_DELAY_S),
        (False, "message order", 0.1),
    ):
        aisle = Aisle(replies=replies)
        flight = read(aisle, stamped=False)
        assert flight.log.format == "MAVLink stream"
        assert flight.positions[0].clock_map.method == method
        assert np.abs(clock_error(flight, aisle)).max() < allowed
        assert [c.clock for c in flight.clocks] == ["UNIX time of system 1, component 197"]


def test_mavlink_without_boot_clock_starts_at_first_message(read):
    """Only messages from the companion were recorded."""
    aisle = Aisle(replies=False)
    recorder = aisle.record()
    recorder.sent = [s for s in recorder.sent if s[1] == COMPANION]
    flight = read(recorder)
    assert flight.log.boot_time_s == 0.0
    assert flight.log.duration_s == pytest.approx(aisle.seconds, abs=0.5)
    times = flight.positions[0].samples.index.to_numpy()
    assert len(times) >= 199
    np.testing.assert_allclose(np.diff(times), 0.2, atol=1e-3)


def change_messages(recorder: Recorder, change) -> Recorder:
    """Apply ``change`` to sender and message of each message; None drops it."""
    sent = [(at, change(sender, made), link) for at, sender, made, link in recorder.sent]
    recorder.sent = [(at, *found, link) for at, found, link in sent if found is not None]
    return recorder


def with_autopilot_heartbeat(sender, made):
    """Give the companion the heartbeat of an autopilot, as copied by some scripts."""
    beat = made.get_type() == "HEARTBEAT" and sender == COMPANION
    return sender, heartbeat(kind=18, autopilot=0) if beat else made


def without_heartbeat(sender, made):
    found = with_autopilot_heartbeat(sender, made)
    return None if made.get_type() == "HEARTBEAT" and sender != COMPANION else found


def as_component_4(sender, made):
    if made.get_type() == "HEARTBEAT":
        return None
    return ((1, 4), made) if sender == AUTOPILOT else (sender, made)


def change_timestamps(boot_ms, usec):
    """Return a change of the autopilot's timestamps; ``boot_ms`` None drops those messages."""

    def change(sender, made):
        if sender == AUTOPILOT and hasattr(made, "time_boot_ms"):
            if boot_ms is None:
                return None
            made.time_boot_ms = boot_ms(made.time_boot_ms)
        if sender == AUTOPILOT and hasattr(made, "time_usec"):
            made.time_usec = usec(made.time_usec)
        return sender, made

    return change


UNIX_CLOCK = change_timestamps(None, lambda usec: usec + us(UNIX_S))
CONSTANT_CLOCK = change_timestamps(lambda _: 1000, lambda _: 1_000_000)


@pytest.mark.parametrize(("change", "stamped"), [
    (with_autopilot_heartbeat, True), (without_heartbeat, True), (as_component_4, True),
    (as_component_4, False), (UNIX_CLOCK, True), (UNIX_CLOCK, False), (CONSTANT_CLOCK, True),
])  # fmt: skip
def test_mavlink_autopilot_without_heartbeat_is_found(read, change, stamped):
    """The companion also sends setpoints with a constant boot time."""
    aisle = Aisle(replies=False, state=None if change is CONSTANT_CLOCK else "ODOMETRY")
    recorder = change_messages(aisle.record(), change)
    if change in (with_autopilot_heartbeat, without_heartbeat):
        for boot in aisle.times(100.0):
            point = message("SET_POSITION_TARGET_LOCAL_NED", time_boot_ms=10)
            recorder.hear(unix(boot), COMPANION, point)
    flight = read(recorder, stamped=stamped)
    assert flight.log.duration_s == pytest.approx(aisle.seconds, abs=0.1)
    assert compute_sample_rate_hz(flight.imu) == pytest.approx(aisle.imu_hz, rel=0.01)
    if change is not CONSTANT_CLOCK:  # for constant timestamps the times are receive times
        assert len(flight.imu) == aisle.seconds * aisle.imu_hz
        np.testing.assert_allclose(np.diff(flight.imu.index), 1.0 / aisle.imu_hz, atol=1e-5)


def test_mavlink_stream_without_timestamps_adds_note(read):
    flight = read(Recorder().hear(0.0, AUTOPILOT, heartbeat()), stamped=False)
    assert flight.log.duration_s == 0.0
    assert any("no message in the stream contains a time" in note for note in flight.log.notes)


# ---- restarts, late packets, several vehicles ---------------------------------------------------


def test_mavlink_recording_with_reboot_keeps_longer_part(read):
    first = Aisle(seconds=20.0, start_s=500.0)
    second = Aisle(seconds=60.0, start_s=3.0, receiver=lambda boot: UNIX_S + 520.0 + boot,
                   clock=lambda boot: UNIX_S + 520.0 + boot, seed=2)  # fmt: skip
    recorder = second.record(first.record())
    flight = read(recorder)
    assert flight.log.boot_time_s == pytest.approx(3.0, abs=0.1)
    assert flight.log.duration_s == pytest.approx(60.0, abs=0.1)
    [note] = [note for note in flight.log.notes if "restart" in note]
    assert "restarts of the boot clock: 1. Only the longest part" in note
    # messages before the first one with the new boot clock cannot be assigned
    times = flight.positions[0].samples.index.to_numpy() + flight.log.boot_time_s
    assert len(times) >= 299
    assert np.abs(times - second.times(5.0)[-len(times) :]).max() < 1.5 * LEAST_DELAY_S
    assert flight.airborne[0] == pytest.approx((15.0, 45.0), abs=0.1)


def test_late_mavlink_packet_is_not_taken_for_a_reboot(read):
    """Packets may be ten seconds late, for example from a router's queue."""
    aisle = Aisle(seconds=40.0)
    recorder = aisle.record()
    for boot in (60.0, 70.0):
        late = message("ATTITUDE_QUATERNION", time_boot_ms=ms(boot), q1=1.0)
        recorder.hear(unix(boot + 10.0), AUTOPILOT, late)
    ahead = message("ATTITUDE_QUATERNION", time_boot_ms=900_000_000, q1=1.0)
    recorder.hear(unix(70.0), AUTOPILOT, ahead)
    flight = read(recorder)
    assert not [note for note in flight.log.notes if "restart" in note]
    assert flight.log.duration_s == pytest.approx(40.0, abs=0.1)
    assert len(flight.attitude) == 800


def test_mavlink_timestamp_years_ahead_is_dropped(read):
    aisle = Aisle()
    recorder = aisle.record()
    end = BOOT_S + aisle.seconds
    for year in (1, 2, 3):
        at = us(unix(end)) + year * 31_557_600_000_000
        made = message("VISION_POSITION_ESTIMATE", usec=at, covariance=[0] * 21)
        recorder.hear(unix(end + 0.1 * year), COMPANION, made)
    flight = read(recorder)
    assert np.abs(clock_error(flight, aisle)).max() < 1.5 * LEAST_DELAY_S
    [note] = [note for note in flight.log.notes if "VISION_POSITION_ESTIMATE" in note]
    assert note.endswith(": 3")


def test_mavlink_system_option_selects_one_of_several_vehicles(read):
    busy = Aisle(seconds=30.0, system=3)
    other = Aisle(seconds=20.0, system=7, start_s=900.0, clock=lambda boot: unix(boot) - 850.0,
                  receiver=lambda boot: unix(boot) - 850.0, seed=2)  # fmt: skip
    recorder = other.record(busy.record())
    for system, aisle in ((None, busy), (3, busy), (7, other)):
        flight = read(recorder, system=system)
        [track] = flight.positions
        assert track.name == "VISION_POSITION_ESTIMATE"
        assert f"system {aisle.system})" in flight.log.hardware
        assert flight.log.boot_time_s == pytest.approx(aisle.start_s, abs=0.1)
        assert np.abs(clock_error(flight, aisle)).max() < 1.5 * LEAST_DELAY_S
        [chosen] = [s for s in flight.log.senders if s.chosen]
        assert (chosen.system, chosen.component) == (aisle.system, 1)
    for system in (5, 255):
        with pytest.raises(SettingsError, match=r"System ids of autopilots in this file: 3, 7\."):
            read(recorder, system=system)


def test_mavlink_sequence_gaps_give_lost_fraction_per_sender(tmp_path):
    """Every tenth message of the companion is missing, every twentieth is repeated."""
    aisle = Aisle(seconds=60.0)
    recorder = aisle.record()
    for boot in aisle.times(1.0):
        recorder.hear(unix(boot), GROUND, heartbeat(kind=6, autopilot=8))
    path = tmp_path / "lossy.tlog"
    parts = [stamp(received) + made for received, _, made in recorder.frames()]
    of_companion = [i for i, part in enumerate(parts) if part[13:15] == bytes(COMPANION)]
    for i in of_companion[5::10]:
        parts[i] = b""
    for i in of_companion[7::20]:  # repeated over a slower link
        parts[i + 5] += parts[i]
    end_us, constant = recorder.frames()[-1][0], (1, 190)  # sender with constant sequence number
    parts += 5 * [stamp(end_us) + frame(heartbeat(kind=6, autopilot=8), constant, 7)]
    path.write_bytes(b"".join(parts))
    flight = read_log(path)
    described = {(s.system, s.component): s for s in flight.log.senders}
    assert described[AUTOPILOT].description == "PX4 quadrotor"
    assert described[COMPANION].description == "companion computer"
    assert described[GROUND].description == "ground station"
    assert described[COMPANION].lost_fraction == pytest.approx(0.1, abs=0.005)
    assert described[AUTOPILOT].lost_fraction == 0.0
    assert described[constant].lost_fraction is None
    assert [*described] == [AUTOPILOT, COMPANION, GROUND, constant]  # most messages first


# ---- the map itself -----------------------------------------------------------------------------


def map_unix_timestamps(received, *exchanges):
    """Return UNIX timestamps at 10 Hz and their clock map for given receive times."""
    stamps = UNIX_S + 0.1 * np.arange(len(received))
    line = ClockLine(0.0, 0.0, 1.0, 0.0, 9)
    return stamps, map_clock_to_boot(
        "x", stamps, received, line, *exchanges, None, has_receive_times=True
    )


def test_timesync_one_hour_after_receive_times_is_ignored():
    """This TIMESYNC would place messages one hour before their receipt."""
    received = np.arange(0.0, 60.0, 0.1) + 0.01
    wrong = (received, UNIX_S + 3600.0 + received), NO_EXCHANGES[1]
    stamps, found = map_unix_timestamps(received, *wrong)
    assert found.description.method == "receive time"
    np.testing.assert_allclose(found.sender_to_boot_fit.at(stamps), received, atol=1e-6)


def test_mavlink_clock_mapping_equals_reported_offset_and_drift():
    """boot = timestamp + offset + drift · (timestamp - middle of the timestamps)."""
    received = 20.0 + 1.0001 * np.arange(0.0, 100.0, 0.1)
    stamps, found = map_unix_timestamps(received, *NO_EXCHANGES)
    statement = found.description
    assert statement.drift_ppm == pytest.approx(100.0, abs=0.1)
    middle = 0.5 * (stamps[0] + stamps[-1])
    by_statement = stamps + statement.offset_s + statement.drift_ppm * 1e-6 * (stamps - middle)
    np.testing.assert_allclose(by_statement, found.sender_to_boot_fit.at(stamps), atol=2e-6)
    np.testing.assert_allclose(by_statement, received, atol=2e-6)
