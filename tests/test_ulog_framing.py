"""What of a ULog is read: cut off, overwritten, with zeros or rubbish in it and behind it."""

import itertools
import random
import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from px4fuse.analysis import run_comparison
from px4fuse.findings import find
from px4fuse.readers import read_log
from px4fuse.readers.ulog_framing import HEADER_BYTES, whole_messages
from px4fuse.request import ComparisonRequest

HEAD = b"ULog\x01\x12\x35\x01" + bytes(8)
# Without letters: one in twenty random headers is of a kind that there is
RUBBISH = bytes(byte | 0x80 for byte in random.Random(1).randbytes(3_000_000))


def message(kind: bytes, content: bytes) -> bytes:
    return struct.pack("<H", len(content)) + kind + content


MESSAGES = [message(b"D", bytes([n]) * (n + 1)) for n in range(60)]
WHOLE = HEAD + b"".join(MESSAGES)


# Where each message ends
ENDS = [*itertools.accumulate(map(len, MESSAGES), initial=HEADER_BYTES)][1:]


def test_a_whole_file_is_what_it_is() -> None:
    found = whole_messages(WHOLE)
    assert found.content is WHOLE
    assert (found.lost_bytes, found.places, found.in_message) == (0, 0, False)


@given(st.integers(HEADER_BYTES, len(WHOLE)))
def test_a_file_that_is_cut_off_keeps_its_whole_messages(cut: int) -> None:
    found = whole_messages(WHOLE[:cut])
    whole = max((end for end in (HEADER_BYTES, *ENDS) if end <= cut), default=HEADER_BYTES)
    assert found.content == WHOLE[:whole]
    assert found.lost_bytes == cut - whole
    assert found.in_message is (cut > whole)


@pytest.mark.parametrize("rubbish", [bytes(100_000), RUBBISH[:100_000], b"\xff" * 777])
@pytest.mark.parametrize("at", [20, 30, 60])
def test_what_is_put_in_or_behind_is_lost_alone(rubbish: bytes, at: int) -> None:
    place = ENDS[at - 1]
    found = whole_messages(WHOLE[:place] + rubbish + WHOLE[place:])
    assert found.content == WHOLE
    assert (found.lost_bytes, found.places) == (len(rubbish), 1)


def test_a_size_that_was_overwritten_costs_one_message() -> None:
    place = ENDS[19]
    spoilt = WHOLE[:place] + b"\xf0" + WHOLE[place + 1 :]
    found = whole_messages(spoilt)
    assert found.content == HEAD + b"".join(MESSAGES[:20] + MESSAGES[21:])
    assert found.lost_bytes == len(MESSAGES[20])


def test_appended_data_begin_where_the_flags_say() -> None:
    """After a crash of the logger the message before may be cut off."""
    flags = bytes(8) + b"\x01" + bytes(7)
    before = b"".join(MESSAGES[:30])
    start = HEADER_BYTES + 3 + 40
    cut = before[:-7]
    appended = message(b"B", flags + struct.pack("<3Q", start + len(cut), 0, 0))
    found = whole_messages(HEAD + appended + cut + b"".join(MESSAGES[30:]))
    assert found.content[start:] == b"".join(MESSAGES[:29] + MESSAGES[30:])
    assert found.lost_bytes == len(MESSAGES[29]) - 7
    # nothing is appended to what was joined
    assert found.content[HEADER_BYTES + 3 :][:40] == bytes(40)


@pytest.mark.parametrize("share", [0.1, 0.25, 0.5, 0.9])
def test_a_log_that_is_cut_off_says_so_on_its_first_page(tmp_path, sample_log, share) -> None:
    path = tmp_path / "cut.ulg"
    content = sample_log.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    flight = read_log(path)
    assert flight.log.ends_in_flight
    assert flight.log.bytes_read == pytest.approx(share * len(content), abs=1000)
    (said,) = flight.log.damage
    assert f"ends in mid-message after {flight.log.duration_s:.1f} s, in flight" in said
    if share > 0.1:
        return
    found = find(run_comparison(ComparisonRequest(log=str(path))))
    (named,) = [one for one in found if one.id == "log_damaged"]
    assert named.message.startswith("The file ends in mid-message")


@pytest.mark.parametrize("rubbish", [bytes(3_000_000), RUBBISH], ids=["zeros", "random"])
@pytest.mark.parametrize("inside", [False, True])
def test_rubbish_costs_nothing_of_the_flight(tmp_path, sample_log, rubbish, inside) -> None:
    content = sample_log.read_bytes()
    at = whole_messages(content[: len(content) // 2]).content if inside else content
    path = tmp_path / "long.ulg"
    path.write_bytes(at + rubbish + content[len(at) :])
    flight, whole = read_log(path), read_log(sample_log)
    assert flight.log.duration_s == whole.log.duration_s
    assert len(flight.imu) == len(whole.imu)
    assert flight.log.bytes - flight.log.bytes_read == len(rubbish)
    assert "3,000,000 of its" in flight.log.damage[0]
    assert not flight.log.ends_in_flight


@pytest.mark.parametrize("seed", range(20))
def test_rubbish_that_looks_like_headers_takes_its_neighbours_alone(seed, sample_log) -> None:
    """One in twenty random headers is of a kind that there is, and leads into what is whole."""
    dice = random.Random(seed)
    content = sample_log.read_bytes()
    at = dice.randrange(len(content) // 5, len(content) - 30_000)
    found = whole_messages(content[:at] + dice.randbytes(20_000) + content[at + 20_000 :])
    assert 19_500 < found.lost_bytes < 20_700
    assert found.content[:at].startswith(content[: at - 500])
    assert found.content.endswith(content[at + 20_500 :])


def test_a_recording_that_ends_in_flight_says_so(tmp_path: Path, sample_log: Path) -> None:
    content = sample_log.with_suffix(".tlog").read_bytes()
    path = tmp_path / "half.tlog"
    path.write_bytes(content[: len(content) // 2])
    assert read_log(path).log.ends_in_flight
    assert not read_log(sample_log.with_suffix(".tlog")).log.ends_in_flight
