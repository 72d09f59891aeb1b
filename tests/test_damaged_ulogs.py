"""Damaged ULogs: the reader states the missing part, or rejects the file with one line."""

import random
import re
import struct

import pandas as pd
import pytest
from cli_tools import run_main
from time_limit import time_limit
from ulog_tools import make_log

from px4fuse.diagnose import diagnose
from px4fuse.errors import LogError
from px4fuse.flight.model import Ekf2, Flight
from px4fuse.readers import read_log
from px4fuse.readers.ulog import read_ulog
from px4fuse.request import ComparisonRequest

KINDS = ("truncated", "zeroed", "random", "deleted", "inserted", "flipped")
PLACES = 12
SIZES = (1, 2, 5, 20, 100, 1000)  # bytes, or bits of kind "flipped"
# A damaged message size may exceed the rest of the file; pyulog then stops reading
MAX_MESSAGE_BYTES = 65_538
# Fraction of samples; a smaller loss may be undetected, because a ULog has no checksums
MAX_SILENT_LOSS = 0.005
IMU_HZ, DURATION_S = 250.0, 40.0
HEAD = b"ULog\x01\x12\x35\x01" + bytes(8)


@pytest.fixture(scope="module")
def content() -> bytes:
    """A ULog of 0.5 MB without damage."""
    return make_log("v1.16", DURATION_S, IMU_HZ).encode()


@pytest.fixture(scope="module")
def whole(content: bytes) -> int:
    """Number of samples in the ULog without damage."""
    flight = read_ulog("whole.ulg", content)
    assert flight.log.damage == ()
    assert flight.log.bytes_read == len(content)
    return count_samples(flight)


def count_samples(flight: Flight) -> int:
    state = flight.ekf2.state if isinstance(flight.ekf2, Ekf2) else None
    frames = (flight.imu, flight.attitude, state, *(one.samples for one in flight.positions))
    return sum(len(frame) for frame in frames if isinstance(frame, pd.DataFrame))


def damage(content: bytes, kind: str, place: int) -> tuple[bytes, int, int]:
    """Damage a file at one of 12 places; return its content, the place and the size."""
    dice, size, data = (
        random.Random(f"{kind} {place}"),
        SIZES[place % len(SIZES)],
        bytearray(content),
    )
    first, last = (len(content) * edge // PLACES for edge in (place, place + 1))
    at = dice.randrange(max(first, len(HEAD)), last)
    end = min(at + size, last)
    match kind:
        case "truncated":
            del data[at:]
        case "zeroed":
            data[at:end] = bytes(end - at)
        case "random":
            data[at:end] = dice.randbytes(end - at)
        case "deleted":
            del data[at:end]
        case "inserted":
            data[at:at] = dice.randbytes(size)
        case "flipped":
            for _ in range(size):
                data[dice.randrange(len(HEAD), len(data))] ^= 1 << dice.randrange(8)
    return bytes(data), at, size


@pytest.mark.parametrize("place", range(PLACES))
@pytest.mark.parametrize("kind", KINDS)
def test_read_damaged_ulog_reports_the_missing_data(
    content, whole, capsys, kind: str, place: int
) -> None:
    data, at, size = damage(content, kind, place)
    flight, refusal = None, ""
    with time_limit():
        try:
            flight = read_ulog("damaged.ulg", data)
        except LogError as error:
            refusal = str(error)
    assert "".join(capsys.readouterr()) == ""
    if flight is None:
        assert re.fullmatch(r"damaged\.ulg: .+", refusal)
        return
    log, kept = flight.log, count_samples(flight) / whole
    if kind == "flipped":
        assert kept > {100: 0.8, 1000: 0.05}.get(size, 0.995)
    else:
        kept_before = at / len(content) - 0.01
        assert kept > (kept_before if at > len(data) - MAX_MESSAGE_BYTES else 0.85)
    text = " ".join(log.damage)
    stated = re.search(r"([\d.]+) s of ([\d.]+) s of IMU data are missing", text)
    if kept < 1.0 - MAX_SILENT_LOSS:
        assert stated or "ends within a message after" in text or log.ends_in_flight
    if stated and kind != "flipped":
        missing_s, end_s = map(float, stated.groups())
        assert missing_s == pytest.approx(end_s - len(flight.imu) / IMU_HZ, abs=0.3)


@pytest.mark.parametrize("rubbish", [bytes(200_000), b"\xff" * 200_000], ids=["zeros", "ones"])
def test_read_ulog_with_invalid_bytes_keeps_valid_messages(content, whole, rubbish: bytes) -> None:
    at = content.index(b"D\0\0", len(content) // 2) - 2  # a message of the first topic
    flight = read_ulog("long.ulg", content[:at] + rubbish + content[at:])
    assert count_samples(flight) > 0.999 * whole
    assert flight.log.bytes - flight.log.bytes_read == pytest.approx(len(rubbish), abs=2000)
    assert re.search(r"\b0\.0 s of [\d.]+ s of IMU data are missing", flight.log.damage[0])


def test_read_ulog_with_damaged_format_does_not_hang(content) -> None:
    """Without the fix, pyulog loops at a definition longer than the rest of the file."""
    cut = content[: content.index(b"vehicle_attitude:")]
    with time_limit(), pytest.raises(LogError, match="contains no samples"):
        read_ulog("cut.ulg", cut[:-3] + struct.pack("<HB", 60_000, 0) + bytes(100))


def message(kind: str, content: bytes) -> bytes:
    return struct.pack("<HB", len(content), ord(kind)) + content


@pytest.mark.parametrize(
    "definitions",
    [
        [message("F", b"a:b[65535] b;"), message("F", b"b:uint8_t[65535] c;")],
        [message("F", b"a:" + b"uint8_t[65535] c;" * 3800)],
        [message("F", b"a:uint8_t[60000] c;")] * 50,
    ],
    ids=["nested", "long", "many"],
)
def test_read_ulog_with_huge_format_definition_is_rejected(definitions: list[bytes]) -> None:
    """Without a limit these formats need up to 1,000 GB of memory."""
    subscriptions = [
        message("A", struct.pack("<BH", 0, number) + b"a") for number in range(len(definitions))
    ]
    with (
        time_limit(),
        pytest.raises(LogError, match=r"the topics have more than 200,000 fields in total"),
    ):
        read_ulog("huge.ulg", HEAD + b"".join(definitions + subscriptions))


@pytest.mark.parametrize("share", [0.1, 0.25, 0.5, 0.9])
def test_read_truncated_log_reports_that_it_ends_in_flight(
    tmp_path, sample_log, share: float
) -> None:
    path = tmp_path / "cut.ulg"
    content = sample_log.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    flight = read_log(path)
    assert flight.log.ends_in_flight
    assert flight.log.bytes_read == pytest.approx(share * len(content), abs=1000)
    (text,) = flight.log.damage
    assert f"ends within a message after {flight.log.duration_s:.1f} s, in flight" in text
    if share > 0.1:
        return
    found = diagnose(ComparisonRequest(log=str(path))).findings
    (named,) = [one for one in found if one.id == "log_damaged"]
    assert "the file ends within a message" in named.message.lower()


def test_commands_on_damaged_log_print_the_missing_data(
    tmp_path, sample_log, monkeypatch, capsys
) -> None:
    """A fifth of the sample flight with a hole of 20 kB."""
    content = bytearray(sample_log.read_bytes()[:700_000])
    content[400_000:420_000] = bytes(20_000)
    path = tmp_path / "hole.ulg"
    path.write_bytes(content)
    for arguments in (["info", path], ["compare", path, "--json", "-"]):
        code, out, err = run_main(monkeypatch, capsys, *arguments)
        assert (code, "Traceback" in err) == (0, False)
        text = " ".join(out.split())  # lines are wrapped
        assert "the file ends within a message after 24.0 s, in flight" in text
        assert "0.8 s of 24.0 s of IMU data are missing" in text


def test_commands_on_unreadable_log_print_one_error_line(tmp_path, monkeypatch, capsys) -> None:
    path = tmp_path / "head.ulg"
    path.write_bytes(HEAD + b"\xff" * 5000)
    for command in ("info", "compare"):
        code, out, err = run_main(monkeypatch, capsys, command, path)
        assert (code, out, len(err.splitlines())) == (2, "", 1)
        assert "contains no samples" in err


# (IMU samples found by a reader with better resynchronisation, fraction that pyulog may lose)
DAMAGED = {
    "Auterion_px4-ulog-rs_hist_15eddfaf_corrupt_format_not_utf8": (13_951, 0.0006),
    "Auterion_px4-ulog-rs_hist_2f3b79f6_corrupt_unregistered_msg_id": (19_191, 0.0046),
}


@pytest.mark.reallogs
@pytest.mark.parametrize("name", DAMAGED)
def test_read_log_of_damaged_real_flight_keeps_most_samples(shared_logs, name: str) -> None:
    count, lost = DAMAGED[name]
    flight = read_log(shared_logs / "real" / f"{name}.ulg")
    assert count * (1.0 - lost) < len(flight.imu) < count
    assert "of IMU data are missing" in flight.log.damage[0]
