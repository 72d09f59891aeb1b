"""Valid timestamps of a ULog, and the ULog writer of the tests."""

import struct
from itertools import combinations, pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyulog import ULog
from ulog_tools import GENERATIONS, make_log, position, seconds_of, take

from px4fuse.readers.ulog_topics import (
    find_longest_increasing_subsequence,
    get_measurement_times_us,
    read_topics,
)

few_timestamps = st.lists(st.integers(-2, 12), max_size=9)
any_timestamps = st.lists(st.integers(-(2**63), 2**63 - 1), max_size=60)


def kept_indices(stamps: list[int]) -> list[int]:
    return find_longest_increasing_subsequence(np.array(stamps, dtype=np.int64)).tolist()


def longest_run_length(stamps: list[int]) -> int:
    """Return the length of the longest increasing subsequence, by brute force."""
    positive = [stamp for stamp in stamps if stamp > 0]
    for length in range(len(positive), 0, -1):
        for run in combinations(positive, length):
            if all(a < b for a, b in pairwise(run)):
                return length
    return 0


@given(any_timestamps)
def test_ulog_rows_with_decreasing_timestamps_are_dropped(stamps):
    indices = kept_indices(stamps)
    chosen = [stamps[at] for at in indices]
    assert indices == sorted(set(indices))
    assert all(stamp > 0 for stamp in chosen)
    assert all(a < b for a, b in pairwise(chosen))


@given(few_timestamps)
def test_kept_ulog_timestamps_are_longest_increasing_sequence(stamps):
    assert len(kept_indices(stamps)) == longest_run_length(stamps)


def table(published, sampled=None):
    arrays = {"timestamp": np.array(published, dtype=np.uint64)}
    if sampled is not None:
        arrays["timestamp_sample"] = np.array(sampled, dtype=np.uint64)
    return arrays


PUBLISHED = [10_000_000, 11_000_000, 12_000_000, 13_000_000]


@pytest.mark.parametrize(("sampled", "expected"), [
    pytest.param(None, PUBLISHED, id="nothing else is logged"),
    pytest.param([at - 214_000 for at in PUBLISHED], None, id="measurement is preferred"),
    # timestamps of a sender whose clock is ahead are kept, so that a finding reports them
    pytest.param([at + 250_000 for at in PUBLISHED], None, id="ahead of publication"),
    pytest.param([0] * 4, PUBLISHED, id="zero, as the ground truth of v1.13 has it"),
    pytest.param([17 * 10**14 + i for i in range(4)], PUBLISHED, id="UNIX time of a receiver"),
    pytest.param([0, 0, 0, 12_900_000], PUBLISHED, id="mostly unusable"),
    pytest.param(
        [0, 10_900_000, 11_900_000, 12_900_000],
        [10_000_000, 10_900_000, 11_900_000, 12_900_000],
        id="one unusable falls back alone",
    ),
])  # fmt: skip
def test_measurement_time_is_timestamp_sample_or_else_timestamp(sampled, expected):
    assert get_measurement_times_us(table(PUBLISHED, sampled)).tolist() == (expected or sampled)


@pytest.mark.parametrize("generation", GENERATIONS)
def test_generated_ulog_is_read_back_by_pyulog(tmp_path, generation):
    """pyulog, which is independent of the writer, reads every value that was written."""
    log = make_log(generation, 2.0)
    ulog = ULog(str(log.write(tmp_path / "made.ulg")))
    assert not ulog.file_corruption
    assert {data.name for data in ulog.data_list} == log.names()
    assert ulog.get_version_info_str() == f"{generation}.0"
    assert ulog.initial_parameters == log.parameters
    for topic in log.topics:
        read = ulog.get_dataset(topic.name).data
        for name, values in topic.fields.items():
            columns = values.T if values.ndim == 2 else [values]
            keys = [f"{name}[{i}]" for i in range(len(columns))] if values.ndim == 2 else [name]
            for key, column in zip(keys, columns, strict=True):
                np.testing.assert_array_equal(read[key], column, err_msg=f"{topic.name}.{key}")


def test_read_ulog_sets_time_zero_to_first_imu_sample(tmp_path):
    path = make_log("v1.16", 10.0).write(tmp_path / "made.ulg")
    topics = read_topics(path.name, path.read_bytes())
    assert topics.log.boot_time_s == pytest.approx(5.0)
    assert topics.log.duration_s == pytest.approx(9.99)
    assert topics.log.bytes == path.stat().st_size
    assert topics.log.firmware == "PX4 v1.16.0"
    assert topics.log.firmware_hash == "0123456789abcdef"
    assert topics.log.parameters == {
        "EKF2_EN": 1.0, "EKF2_EVP_GATE": 5.0, "EKF2_EV_DELAY": 0.0, "SDLOG_PROFILE": 129.0,
    }  # fmt: skip


@pytest.mark.parametrize(("kind", "text"), [
    (255, "PX4 v1.16.2"), (192, "PX4 v1.16.2-rc"), (128, "PX4 v1.16.2-beta"),
    (64, "PX4 v1.16.2-alpha"), (0, "PX4 v1.16.2-dev"),
])  # fmt: skip
def test_firmware_version_of_ulog_includes_release_type(kind, text):
    log = make_log("v1.16", 2.0)
    log.info["ver_sw_release"] = 1 << 24 | 16 << 16 | 2 << 8 | kind
    assert read_topics("made.ulg", log.encode()).log.firmware == text


def test_read_ulog_gives_start_and_duration_of_dropout():
    log = make_log("v1.16", 2.0)
    log.dropouts_ms = (250,)
    last = max(int(topic.fields["timestamp"].max()) for topic in log.topics)
    (dropout,) = read_topics("made.ulg", log.encode()).log.dropouts
    assert dropout.duration_s == pytest.approx(0.25)
    assert dropout.start_s == pytest.approx((last - 5_000_000) * 1e-6)


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_read_ulog_joins_two_subscriptions_of_one_topic(order):
    """A logger that restarts subscribes again; both parts belong to the same topic."""
    log = make_log("v1.9", 4.0)
    whole = next(t for t in log.topics if t.name == "vehicle_local_position")
    halves = np.array_split(np.arange(len(whole.fields["timestamp"])), 2)
    log.drop("vehicle_local_position").add(*(take(whole, halves[i]) for i in order))
    topics = read_topics("made.ulg", log.encode())
    read = topics.tables["vehicle_local_position", 0]
    np.testing.assert_array_equal(read["timestamp"], whole.fields["timestamp"])
    expected = position(seconds_of(whole.fields["timestamp"]))[:, 0]
    np.testing.assert_allclose(read["x"], expected, rtol=1e-6)


def test_logged_parameter_default_overrides_px4_default() -> None:
    key = b"float EKF2_EV_DELAY"
    body = struct.pack("<BB", 1, len(key)) + key + struct.pack("<f", 175.0)
    message = struct.pack("<HB", len(body), ord("Q")) + body
    content = make_log().encode()
    end = 19 + struct.unpack("<H", content[16:18])[0]  # of the first message after the file header
    log = read_topics("a.ulg", content[:end] + message + content[end:]).log
    assert log.parameter_defaults == {"EKF2_EV_DELAY": 175.0}
    assert (log.find_default_value("EKF2_EV_DELAY"), log.find_default_value("EKF2_EVP_NOISE")) == (
        175.0,
        0.1,
    )
