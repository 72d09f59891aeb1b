"""The ULog and the MAVLink recording of one flight never contradict each other."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest
from conftest import REPOSITORY, SHARED_LOGS
from exchange import replace
from flights import Imu, aisle_flight

from px4fuse.analysis import Analysis, explain
from px4fuse.comparison.comparison import compare
from px4fuse.comparison.estimates import noises_and_clock
from px4fuse.filter.clock import ClockOffset
from px4fuse.filter.tuning import AxisTuning
from px4fuse.findings import find
from px4fuse.flight import Flight, Unavailable
from px4fuse.readers import read_log
from px4fuse.recording import Stream

SAMPLE = "aisle_uwb"
# Of v1.16.1_aisle_clock_nosync the ULog has times of arrival where the recording has the sender's
# own stamps: they are 0.25 s apart, and are said to be
PAIRS = (SAMPLE, "v1.13.3_aisle_hwlogvision", "v1.16.1_aisle_clock_late")
# Opposite statements on one number
OPPOSITES = ("large", "small"), ("overstated", "understated"), ("late", "early")


def paths(pair: str) -> tuple[Path, Path]:
    if pair == SAMPLE:
        folder = REPOSITORY / "sample_logs"
        return folder / f"{pair}.ulg", folder / f"{pair}.tlog"
    return SHARED_LOGS / "simulated" / f"{pair}.ulg", SHARED_LOGS / "mavlink" / f"{pair}.tlog"


@cache
def analysed(path: Path) -> Analysis:
    return explain(compare(read_log(path), axes=("north", "east")))


def overlap(one: tuple[float, float], other: tuple[float, float]) -> bool:
    return one[0] <= other[1] and other[0] <= one[1]


@pytest.mark.reallogs
@pytest.mark.parametrize("pair", PAIRS)
def test_a_ulog_and_the_recording_of_the_same_flight_agree(shared_logs, pair) -> None:
    ulog, tlog = (analysed(path) for path in paths(pair))
    for name in {*ulog.tuning} & {*tlog.tuning}:
        one, other = ulog.tuning[name], tlog.tuning[name]
        assert isinstance(one, AxisTuning)
        assert isinstance(other, AxisTuning)
        # what the filter needs may differ: PX4 takes EKF2's bias out of what it sends
        for which in ("sigma_z", "sigma_a"):
            noises = getattr(one, which), getattr(other, which)
            ends = [(noise.low or 0.0, noise.high or 1e9) for noise in noises]
            assert overlap(*ends), (name, which)
    assert isinstance(ulog.clock, ClockOffset)
    if isinstance(tlog.clock, ClockOffset) and tlog.clock.determinable:
        assert overlap(ulog.clock.interval_s, tlog.clock.interval_s)
    found = [{f.id: f.message for f in find(each)} for each in (ulog, tlog)]
    for ours, theirs in (found, found[::-1]):
        for one, opposite in OPPOSITES:
            for name in ours:
                assert name.replace(one, opposite) == name or name.replace(one, opposite) not in (
                    theirs
                ), name
        # what one says of the clock the other says too, or says why it cannot
        if "source_clock_offset" in ours and "source_clock_offset" not in theirs:
            assert theirs is found[1]
            assert isinstance(tlog.clock, Unavailable)


def recorded(flight: Flight, topic: str) -> Flight:
    """The same flight whose IMU came by that topic."""
    return replace(flight, streams={"imu": Stream((topic,), "boot clock", flight.log.name)})


@pytest.mark.parametrize(
    ("topic", "imu_hz", "needed"),
    [
        ("HIGHRES_IMU", 100.0, "200 Hz"),
        ("SCALED_IMU2", 4.0, "200 Hz"),
        ("HIGHRES_IMU", 200.0, None),
        ("sensor_combined", 100.0, None),
        ("sensor_combined", 20.0, "40 Hz"),
    ],
)
def test_a_clock_offset_needs_the_whole_imu(topic, imu_hz, needed) -> None:
    """A sample that telemetry picks out of many is no mean over its interval."""
    flight = recorded(aisle_flight(duration_s=40.0, imu=Imu(rate_hz=imu_hz)), topic)
    _, found = noises_and_clock(compare(flight, axes=("north", "east")))
    if needed is None:
        assert isinstance(found, ClockOffset)
        return
    assert isinstance(found, Unavailable)
    assert f"{imu_hz:.{1 if imu_hz < 10 else 0}f} Hz" in found.reason
    assert needed in found.reason
    assert ("ULog" in found.remedy) == (topic != "sensor_combined")
