"""IMU rate that the estimate of a clock offset needs."""

import pytest
from comparisons import compare
from exchange import replace
from flights import Imu, aisle_flight

from px4fuse.comparison.estimates import estimate_noises_and_time_offset
from px4fuse.filter.time_offset import SourceTimeOffset
from px4fuse.flight.model import DataSource, Unavailable


@pytest.mark.parametrize(("topic", "imu_hz", "needed"), [
    ("HIGHRES_IMU", 100.0, "200 Hz"),
    ("SCALED_IMU2", 4.0, "200 Hz"),
    ("HIGHRES_IMU", 200.0, None),
    ("sensor_combined", 100.0, None),
    ("sensor_combined", 20.0, "40 Hz"),
])  # fmt: skip
def test_time_offset_with_low_imu_rate_is_unavailable(topic, imu_hz, needed) -> None:
    """Telemetry samples of a faster IMU are single values, not means over the interval."""
    flight = aisle_flight(duration_s=40.0, imu=Imu(rate_hz=imu_hz))
    flight = replace(flight, streams={"imu": DataSource((topic,), "boot clock", flight.log.name)})
    _, found = estimate_noises_and_time_offset(compare(flight, axes=("north", "east")))
    if needed is None:
        assert isinstance(found, SourceTimeOffset)
        return
    assert isinstance(found, Unavailable)
    assert f"{imu_hz:g} Hz" in found.reason
    assert needed in found.reason
    assert ("ULog" in found.remedy) == (topic != "sensor_combined")
