"""Topics that were logged too slowly for what is done with them."""

from __future__ import annotations

import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.findings.model import Found, warning
from px4fuse.flight import sample_rate
from px4fuse.recording import LogInfo

MIN_IMU_RATE_HZ = 50.0  # 5 IMU samples per DT of 0.1 s, and 10 with margin for aliasing
MIN_ATTITUDE_RATE_HZ = 10.0  # PX4's default is 20 Hz; slerp bridges 0.1 s of a tilt
RATE_MARGIN = 0.98  # a stream set to a rate runs a little below it


def too_slow(samples: pd.DataFrame, needed_hz: float) -> bool:
    """Whether samples come at a lower rate than is needed."""
    return sample_rate(samples) < RATE_MARGIN * needed_hz


def detect(analysis: Analysis) -> Found:
    """IMU or attitude, below the rate that the acceleration needs."""
    flight = analysis.flight
    for part, name, default, needed_hz in (
        (flight.imu, "imu", "sensor_combined", MIN_IMU_RATE_HZ),
        (flight.attitude, "attitude", "vehicle_attitude", MIN_ATTITUDE_RATE_HZ),
    ):
        topic = flight.streams[name].topics[0] if name in flight.streams else default
        if isinstance(part, pd.DataFrame) and too_slow(part, needed_hz):
            rate_hz = sample_rate(part)
            yield warning(
                "logging_rate_low",
                f"{topic} was logged at {rate_hz:.1f} Hz, below the {needed_hz:g} Hz that the "
                "acceleration needs",
                ": motion between samples is lost.",
                _remedy(flight.log, topic, 2.0 * needed_hz),
                {"rate_hz": rate_hz, "needed_hz": needed_hz, "topic": topic},
            )


def _remedy(log: LogInfo, topic: str, rate_hz: float) -> str:
    if not log.format.startswith("MAVLink"):
        return f'Put the line "{topic} 0" into etc/logging/logger_topics.txt on the SD card.'
    if not log.has_ulog:
        return f"Ask for {topic} at {rate_hz:g} Hz (MAV_CMD_SET_MESSAGE_INTERVAL)."
    return (
        f"Raise its stream rate (mavlink stream -d DEVICE -s {topic} -r {rate_hz:g} in PX4's "
        "console), or join the ULog (--mavlink)."
    )
