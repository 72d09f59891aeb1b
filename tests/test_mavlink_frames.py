"""MAVLink frames and columns compared with pymavlink's reader, and recovery from damage."""

import contextlib
import tracemalloc
from collections import Counter
from itertools import cycle
from pathlib import Path

import numpy as np
import pytest
from conftest import SHARED
from fastcrc.crc16 import mcrf4xx
from hypothesis import given, settings
from hypothesis import strategies as st
from mavlink_tools import (
    AUTOPILOT,
    COMPANION,
    MESSAGES,
    Aisle,
    Heard,
    frame,
    heard_by_pymavlink,
    heartbeat,
    message,
    odometry,
    raw_frame,
    stamp,
)

from px4fuse.errors import LogError
from px4fuse.flight.model import Flight
from px4fuse.readers import mavlink_frames, read_log
from px4fuse.readers.mavlink_frames import MavlinkFrames, message_name, read_frames

START_US = 1_700_000_000_000_000
# valid frames that pymavlink skips after invalid bytes, because it uses a wrong length there
BEYOND_PYMAVLINK = {
    "ArduPilot_UAVLogViewer_hist_7092460c_flight_logs.tlog": 5,
    "mbiuki_Phoenix_mission1.rlog": 17,
}
REAL_RECORDINGS = [
    path
    for path in sorted((SHARED / "logs" / "mavlink").glob("*"))
    if path.suffix in (".tlog", ".rlog", ".raw")
]
LONG_BYTES = 500_000
ATTITUDE = message("ATTITUDE", time_boot_ms=1000, roll=0.1, pitch=-0.2, yaw=1.5)
MANY_BYTES = 5_000_000
# Memory limit per frame besides its content: offsets, header fields, receive time, temporary arrays
FRAME_BYTES = 150
# Memory limit per decoded frame, for any payload length
DECODED_BYTES = 800
TINY_BYTES = 1_000_000
# Memory limit of one block of the scan in which every byte may begin a frame
BLOCK_BYTES = 15_000_000
# Memory limit for 65,536 senders
SENDER_BYTES = 10_000_000


@pytest.fixture
def read(tmp_path):
    """Write bytes and read their frames."""

    def write_and_read(content: bytes) -> MavlinkFrames:
        path = tmp_path / "made.tlog"
        path.write_bytes(content)
        return read_frames(path.name, path.read_bytes())

    return write_and_read


def names(frames: MavlinkFrames) -> list[str]:
    return [message_name(number) for number in frames.message_ids.tolist()]


def stamped(*contents: bytes) -> bytes:
    """A tlog with one frame in each millisecond."""
    return b"".join(stamp(START_US + 1000 * i) + part for i, part in enumerate(contents))


def beats(count: int, sender: tuple[int, int] = AUTOPILOT) -> list[bytes]:
    return [frame(heartbeat(), sender, number) for number in range(count)]


def decoded(frames: MavlinkFrames, name: str) -> np.ndarray:
    return frames.table(name, frames.rows(name))


def with_wrong_checksum(made: bytes) -> bytes:
    """Change the checksum of a frame to a wrong one."""
    return made[:-1] + bytes([made[-1] ^ 1])


def flight_and_peak(path: Path) -> tuple[Flight | None, int]:
    """Return the flight (None if rejected) and the peak memory of reading it."""
    tracemalloc.start()
    flight = None
    with contextlib.suppress(LogError):
        flight = read_log(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return flight, peak


# ---- against pymavlink ------------------------------------------------------------------------


def assert_same_values(kind, name: str, table: np.ndarray, heard: list[Heard]) -> None:
    """Check that every field of one message type equals pymavlink's value."""
    types = dict(zip(kind.fieldnames, kind.fieldtypes, strict=True))
    for field in kind.fieldnames:
        expected_values = [one.fields[field] for one in heard]
        values_read = table[field]
        if types[field] == "char":
            # pymavlink cuts a text at its first zero, numpy only at the end
            texts = [
                value.split(b"\0")[0].decode(errors="replace") for value in values_read.tolist()
            ]
            assert [value.split("\0")[0] for value in expected_values] == texts, (name, field)
            continue
        assert values_read.shape == np.shape(expected_values), (name, field)
        expected = np.array(expected_values, dtype=values_read.dtype)
        np.testing.assert_array_equal(values_read, expected, err_msg=f"{name}.{field}")


def assert_equals_pymavlink(path: Path) -> None:
    with_stamps = path.suffix == ".tlog"
    heard, unknown = heard_by_pymavlink(path, stamped=with_stamps)
    frames = read_frames(path.name, path.read_bytes())
    at = {start: row for row, start in enumerate(frames.start_offsets.tolist())}
    count = 0
    for name, all_heard in heard.items():
        rows = np.array([at[one.start] for one in all_heard], dtype=np.intp)
        assert (frames.message_ids[rows] == MESSAGES[name].id).all()
        assert_same_values(MESSAGES[name], name, frames.table(name, rows), all_heard)
        senders = np.column_stack([frames.system_ids[rows], frames.component_ids[rows]])
        np.testing.assert_array_equal(senders, [one.sender for one in all_heard])
        np.testing.assert_array_equal(
            frames.sequence_numbers[rows], [one.sequence for one in all_heard]
        )
        if with_stamps:
            received = [one.received_us for one in all_heard]
            np.testing.assert_array_equal(frames.receive_times_us[rows], received)
        count += len(rows)
    assert (frames.receive_times_us is not None) == with_stamps
    assert len(frames) - count == BEYOND_PYMAVLINK.get(path.name, 0)
    if path.name not in BEYOND_PYMAVLINK:  # pymavlink counts some of them as unknown frames
        assert frames.unknown_frame_count == unknown


def test_mavlink_frames_of_sample_tlog_equal_pymavlink(sample_log):
    assert_equals_pymavlink(sample_log.with_suffix(".tlog"))


@pytest.mark.reallogs
@pytest.mark.parametrize("path", REAL_RECORDINGS, ids=lambda path: path.name)
def test_mavlink_frames_of_real_recordings_equal_pymavlink(path, tmp_path):
    """Only beginning and end of long files, because pymavlink needs half a minute for each."""
    if path.stat().st_size > LONG_BYTES and path.name not in BEYOND_PYMAVLINK:
        frames, content = read_frames(path.name, path.read_bytes()), path.read_bytes()
        gap = 8 if path.suffix == ".tlog" else 0
        starts = frames.start_offsets - gap
        first = int(starts[np.searchsorted(starts, LONG_BYTES // 2)])
        last = int(starts[np.searchsorted(starts, len(content) - LONG_BYTES // 2)])
        path = tmp_path / path.name
        path.write_bytes(content[:first] + content[last:])
    assert_equals_pymavlink(path)


def example(kind) -> object:
    """Make a message with a different value in every field and array element."""
    fields = {}
    lengths = dict(zip(kind.ordered_fieldnames, kind.array_lengths, strict=True))
    for number, (key, wire) in enumerate(zip(kind.fieldnames, kind.fieldtypes, strict=True)):
        length = lengths[key]
        if wire == "char":
            fields[key] = b"text%d"[: length or 1] % number if length > 5 else b"t"
        elif length:
            fields[key] = [(number + 3 * i) % 100 + 1 for i in range(length)]
        else:
            fields[key] = number + 1
    return message(kind.msgname, **fields)


def test_each_mavlink_message_is_decoded_as_packed_by_pymavlink(read):
    """The layouts are from pymavlink's tables, the bytes from its packers."""
    kinds = [kind for _, kind in sorted(MESSAGES.items())]
    made = [example(kind) for kind in kinds]
    frames = read(stamped(*(frame(one, sequence=i % 256) for i, one in enumerate(made))))
    assert names(frames) == [kind.msgname for kind in kinds]
    for kind, one in zip(kinds, made, strict=True):
        fields = {
            key: value.decode() if isinstance(value, bytes) else value
            for key, value in ((key, getattr(one, key)) for key in kind.fieldnames)
        }
        heard = [Heard(0, 0, AUTOPILOT, 0, fields)]
        assert_same_values(kind, kind.msgname, decoded(frames, kind.msgname), heard)


# ---- the wire format --------------------------------------------------------------------------


def test_mavlink_2_trailing_zeros_of_payload_are_restored(read):
    whole = message("PARAM_VALUE", param_id=b"EKF2_EV_DELAY", param_value=3.5, param_type=9)
    short = message("ATTITUDE", time_boot_ms=7)
    frames = read(stamped(frame(short), frame(whole, sequence=1), frame(ATTITUDE, sequence=2)))
    assert frames.payload_lengths.tolist()[0] == 1  # of 28
    table = decoded(frames, "ATTITUDE")
    assert table["time_boot_ms"].tolist() == [7, 1000]
    np.testing.assert_array_equal(table["yaw"], np.float32([0.0, 1.5]))
    assert decoded(frames, "PARAM_VALUE")["param_id"].tolist() == [b"EKF2_EV_DELAY"]


def test_mavlink_payload_with_unknown_extension_is_truncated(read):
    """A later dialect may add extension fields at the end."""
    payload = bytes(ATTITUDE.unpacker.pack(1000, 0.1, -0.2, 1.5, 0.0, 0.0, 0.0)) + b"\x07" * 20
    longer = raw_frame(30, payload, seed=ATTITUDE.crc_extra)
    frames = read(stamped(frame(ATTITUDE), longer))
    assert frames.payload_lengths.tolist() == [16, 48]
    table = decoded(frames, "ATTITUDE")
    assert table[0] == table[1]


BEATS = beats(10)
SIGNED = [frame(heartbeat(), sequence=i, key=bytes(range(32)) if i % 2 else None)
          for i in range(10)]  # fmt: skip
# Messages that are not in the dialect; one is signed, one is MAVLink 1
UNKNOWN = [raw_frame(40_000, bytes(40), seed=1), raw_frame(70_000, b"\x01", seed=1, flags=1),
           raw_frame(207, b"\x01\x02", seed=1, v1=True)]  # fmt: skip
JUNK = {"zeros": b"\x00" * 50, "starts": b"\xfd" * 50, "old starts": b"\xfe" * 300,
        "all bytes": bytes(range(256))}  # fmt: skip


@pytest.mark.parametrize("with_stamps", [True, False])
@pytest.mark.parametrize(("parts", "good", "unknown_frame_count", "bad"), [
    pytest.param(SIGNED, range(10), 0, 0, id="signed"),
    pytest.param([*BEATS[:4], *UNKNOWN, *BEATS[4:]], range(10), 3, 0, id="unknown"),
    pytest.param([*BEATS[:4], with_wrong_checksum(BEATS[4]), *BEATS[5:]],
                 (0, 1, 2, 3, 5, 6, 7, 8, 9), 0, 1, id="damaged"),
])  # fmt: skip
def test_read_mavlink_counts_unknown_frames_and_bad_bytes(
    read, parts, good, unknown_frame_count, bad, with_stamps
):
    """Signatures are not bad bytes, and unknown frames do not affect other frames."""
    frames = read(stamped(*parts) if with_stamps else b"".join(parts))
    assert frames.sequence_numbers.tolist() == [*good]
    assert frames.unknown_frame_count == unknown_frame_count
    assert frames.byte_count_outside_frames == bad * (len(BEATS[4]) + 8 * with_stamps)


@pytest.mark.parametrize(("share", "is_stated"), [(0.002, False), (0.005, True)])
def test_mavlink_bad_bytes_above_limit_are_reported_as_damage(
    tmp_path, share: float, is_stated: bool
):
    content = Aisle(seconds=40.0).record().raw()
    junk = b"\x00" * round(share * len(content) + 2 * is_stated * mavlink_frames.MAX_FRAME_BYTES)
    at = len(content) // 2
    (tmp_path / "made.tlog").write_bytes(content[:at] + junk + content[at:])
    log = read_log(tmp_path / "made.tlog").log
    damage = [text for text in log.damage if "not part of a complete MAVLink frame" in text]
    assert bool(damage) is is_stated
    assert log.bytes - log.bytes_read >= len(junk)


@pytest.mark.parametrize("stamped", [True, False])
@pytest.mark.parametrize("missing", [0, 1, 11, 25, 30])
def test_truncated_mavlink_recording_is_reported_as_damage(tmp_path, stamped: bool, missing: int):
    made = Aisle(seconds=20.0).record()
    content = made.tlog() if stamped else made.raw()
    (tmp_path / "made.tlog").write_bytes(content[: len(content) - missing])
    log = read_log(tmp_path / "made.tlog").log
    wanted = f"the file ends within a frame after {log.duration_s:.1f} s"
    assert [text.startswith(wanted) for text in log.damage] == [True] * (missing > 0)


@pytest.mark.parametrize("rest", [b"\x00" * 50, raw_frame(40_000, b"abcdefg", seed=7)])
def test_complete_mavlink_recording_is_not_reported_truncated(read, rest: bytes):
    """Invalid bytes and a complete frame of an unknown dialect are not a truncated frame."""
    assert not read(b"".join(beats(6)) + rest).is_last_frame_incomplete


@pytest.mark.parametrize("junk", JUNK.values(), ids=JUNK)
def test_invalid_bytes_between_mavlink_frames_are_skipped(read, junk):
    parts = beats(6)
    frames = read(b"".join(parts[:3]) + junk + b"".join(parts[3:]))
    assert frames.sequence_numbers.tolist() == list(range(6))
    assert frames.byte_count_outside_frames == len(junk)


def test_tlog_time_with_frame_start_byte_is_not_read_as_frame(read):
    """Its last bytes and the next frame together form a valid MAVLink 1 STATUSTEXT."""
    head = raw_frame(30, b"\x01\x02\x03", seed=0, sequence=3)[:-2]
    body = bytes([12, 1, 1, 1]) + bytes([0xFD, 28]) + head[2:]
    checksum = mcrf4xx(body + bytes([MESSAGES["STATUSTEXT"].crc_extra]))
    payload = b"\x01\x02\x03" + checksum.to_bytes(2, "little") + bytes([7] * 23)
    true = raw_frame(30, payload, seed=ATTITUDE.crc_extra, sequence=3)
    parts = [stamp(START_US + i) + part for i, part in enumerate(beats(6))]
    parts[3] = stamp(START_US)[:3] + b"\xfe" + body[:4] + true
    frames = read(b"".join(parts))
    assert names(frames) == ["HEARTBEAT"] * 3 + ["ATTITUDE"] + ["HEARTBEAT"] * 2
    assert frames.byte_count_outside_frames == 0


@pytest.mark.parametrize("with_stamps", [True, False])
def test_mavlink_frame_inside_payload_is_ignored(read, with_stamps):
    """TUNNEL contains complete frames, even some that end at the outer frame's checksum."""
    inner = frame(message("VISION_POSITION_ESTIMATE", usec=1, x=1.0), COMPANION)
    payload = list(inner.ljust(128, b"\x01"))
    outer = message("TUNNEL", payload_length=len(inner), payload=payload)
    filled = message("TUNNEL", payload_length=128, payload=list((b"\x01" * 128 + inner)[-128:]))
    parts = [*beats(2), frame(outer), *beats(2), frame(filled), *beats(2)]
    frames = read(stamped(*parts) if with_stamps else b"".join(parts))
    assert Counter(names(frames)) == {"HEARTBEAT": 6, "TUNNEL": 2}
    assert frames.byte_count_outside_frames == 0
    carried = decoded(frames, "TUNNEL")["payload"][0]
    assert bytes(carried[: len(inner)]) == inner


def test_incomplete_first_and_last_mavlink_frame_are_dropped(read):
    parts = beats(5)
    whole = b"".join(parts)
    for cut in (1, 5, len(parts[0]) - 1):
        frames = read(whole[cut : len(whole) - cut])
        assert frames.sequence_numbers.tolist() == [1, 2, 3]
        assert frames.byte_count_outside_frames == 2 * (len(parts[0]) - cut)
    tlog = stamped(*parts)
    for cut in (3, 8, 12):
        frames = read(tlog[cut : len(tlog) - cut])
        expected = [0, 1, 2, 3] if cut <= 8 else [1, 2, 3]
        assert frames.sequence_numbers.tolist() == expected
        assert (np.diff(frames.receive_times_us[1:]) == 1000).all()


def test_damaged_tlog_receive_times_are_interpolated(read):
    parts = beats(9)
    times = [START_US + 1000 * i for i in range(9)]
    for at, wrong in ((2, 0), (3, 2**64 - 1), (6, START_US + 10**12)):
        times[at] = wrong
    content = b"".join(stamp(us) + part for us, part in zip(times, parts, strict=True))
    frames = read(content)
    assert frames.receive_times_us.tolist() == [START_US + 1000 * i for i in range(9)]


@pytest.mark.parametrize("with_stamps", [True, False])
def test_mavlink_file_of_a_single_message_is_read(read, with_stamps):
    content = frame(odometry(5_000_000, [1, 2, 3], [0, 0, 0], estimator=8))
    frames = read(stamped(content) if with_stamps else content)
    assert len(frames) == 1
    assert (frames.receive_times_us is not None) == with_stamps
    assert frames.byte_count_outside_frames == 0


@given(st.lists(st.sampled_from(["v1", "v2", "signed", "unknown", "bad", "junk"]), min_size=1))
@settings(max_examples=60)
def test_valid_mavlink_frames_are_found_among_damaged_ones(tmp_path_factory, kinds):
    """The number of valid frames is known; junk contains no byte that could begin a frame."""
    good = 3
    parts = [*beats(3)]
    for i, kind in enumerate(kinds):
        made = frame(ATTITUDE, sequence=i % 256, v1=kind == "v1", key=bytes(32) if kind == "signed"
                     else None)  # fmt: skip
        if kind == "unknown":
            made = raw_frame(40_001, bytes(i % 200), seed=3)
        elif kind == "bad":
            made = made[:-1] + bytes([made[-1] ^ 0xFF])
        elif kind == "junk":
            made = bytes(i % 40)
        good += kind in ("v1", "v2", "signed")
        parts += [made, *beats(1)]
        good += 1
    path = tmp_path_factory.mktemp("mixture") / "made.raw"
    path.write_bytes(b"".join(parts))
    frames = read_frames(path.name, path.read_bytes())
    assert len(frames) == good
    assert frames.unknown_frame_count <= kinds.count("unknown")


# ---- other content, and limits of memory and work ----------------------------------------------


@pytest.mark.parametrize(("name", "content"), [
    ("zeros", bytes(MANY_BYTES)),
    ("MAVLink 2 starts", b"\xfd" * MANY_BYTES),
    ("MAVLink 1 starts", b"\xfe" * (MANY_BYTES // 12)),
    ("headers of long frames", (b"\xfd\xff\x00" + b"\xfd" * 7) * (MANY_BYTES // 10)),
    ("chance", np.random.default_rng(1).bytes(MANY_BYTES)),
], ids=lambda value: value if isinstance(value, str) else "")  # fmt: skip
def test_file_without_mavlink_is_rejected_in_bounded_memory(tmp_path, name, content):
    path = tmp_path / "hostile.tlog"
    path.write_bytes(content)
    flight, peak = flight_and_peak(path)
    assert flight is None
    assert peak < 4 * len(content) + BLOCK_BYTES, name


def test_mavlink_checksum_computation_on_hostile_file_is_limited(tmp_path, monkeypatch):
    """The checksum input is at most 267 bytes per byte of the file; independent of run time."""
    summed = 0

    def counting(part, *start):
        nonlocal summed
        summed += len(part)
        return mcrf4xx(part, *start)

    content = b"\xfe" * 200_000
    path = tmp_path / "hostile.tlog"
    path.write_bytes(content)
    monkeypatch.setattr(mavlink_frames, "mcrf4xx", counting)
    with pytest.raises(LogError):
        read_frames(path.name, path.read_bytes())
    assert 200 * len(content) < summed < 280 * len(content)


def short_frames(ids: list[int], *, v1: bool) -> list[bytes]:
    """Make frames without payload from random senders."""
    seeds = {kind.id: kind.crc_extra for kind in MESSAGES.values()}
    senders = np.random.default_rng(1).integers(0, 256, (18_000, 2)).tolist()
    return [
        raw_frame(number, b"", seed=seeds[number], sender=tuple(sender), sequence=i % 256, v1=v1)
        for i, (number, sender) in enumerate(zip(cycle(ids), senders, strict=False))
    ]


def cut_frames(name: str, sender: tuple[int, int]) -> list[bytes]:
    """Make frames without trailing zeros: 232 bytes of ODOMETRY are 15 in the file."""
    kind = MESSAGES[name]
    stamps = [(10**6 + 1000 * i).to_bytes(4, "little") for i in range(20_000)]
    return beats(3) + [
        raw_frame(kind.id, payload, seed=kind.crc_extra, sender=sender, sequence=i % 256)
        for i, payload in enumerate(stamps)
    ]


ALL_IDS = sorted(kind.id for kind in MESSAGES.values() if kind.id < 60_000)


@pytest.mark.parametrize(("make", "each_bytes", "more_bytes"), [
    (lambda: short_frames([0], v1=True), FRAME_BYTES, SENDER_BYTES),
    (lambda: short_frames(ALL_IDS, v1=False), FRAME_BYTES, SENDER_BYTES),
    (lambda: cut_frames("ODOMETRY", AUTOPILOT), DECODED_BYTES, TINY_BYTES),
    (lambda: cut_frames("ODOMETRY", COMPANION), DECODED_BYTES, TINY_BYTES),
    (lambda: cut_frames("VISION_POSITION_ESTIMATE", COMPANION), DECODED_BYTES, TINY_BYTES),
    (lambda: cut_frames("PARAM_VALUE", AUTOPILOT), DECODED_BYTES, TINY_BYTES),
], ids=["shortest", "all", "own state", "odometry", "vision", "parameters"])  # fmt: skip
def test_read_mavlink_memory_per_frame_is_bounded(tmp_path, make, each_bytes, more_bytes):
    parts, path = make(), tmp_path / "hostile.raw"
    path.write_bytes(b"".join(parts[:800]))
    read_log(path)  # fills the caches before the measurement
    path.write_bytes(b"".join(parts))
    flight, peak = flight_and_peak(path)
    assert len(flight.log.senders) <= 32
    assert len(read_frames(path.name, path.read_bytes())) == len(parts)
    assert peak < path.stat().st_size + each_bytes * len(parts) + more_bytes


def test_truncated_tlog_is_reported_to_end_in_flight(tmp_path, sample_log):
    content = sample_log.with_suffix(".tlog").read_bytes()
    path = tmp_path / "half.tlog"
    path.write_bytes(content[: len(content) // 2])
    assert read_log(path).log.ends_in_flight
    assert not read_log(sample_log.with_suffix(".tlog")).log.ends_in_flight
