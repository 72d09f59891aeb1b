"""The table of MAVLink messages: names, units, frames and directions as data.

A new message with a position is a row of ``mavlink_messages.toml``, and nothing else.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import msgspec

from px4fuse.flight import RECORD_NOT_LOGGED, Unavailable
from px4fuse.origin import Origin, find_origin
from px4fuse.readers.layouts import Layout, expand_layouts
from px4fuse.record import missing_data, table

AUTOPILOT_COMPONENT = 1  # MAV_COMP_ID_AUTOPILOT1
NO_AUTOPILOT = 8  # MAV_AUTOPILOT_INVALID: a ground station, a camera, a companion computer
GROUND_STATION = 6  # MAV_TYPE_GCS
LANDED = 1  # MAV_LANDED_STATE_ON_GROUND
AUTO_MODE = 4  # PX4_CUSTOM_MAIN_MODE_AUTO
NO_MODES = missing_data("modes_not_sent")
ARDUPILOT_REPLAY = missing_data("replay_of_ardupilot")
# Messages whose time_usec is the autopilot's boot clock; GPS_RAW_INT's, say, is the receiver's
STAMPED_BY_BOOT_CLOCK = ("HIGHRES_IMU", "ODOMETRY", "ESTIMATOR_STATUS")
# What an autopilot sends of itself, and nobody else
OWN_MESSAGES = (
    "HIGHRES_IMU",
    "SCALED_IMU",
    "SCALED_IMU2",
    "SCALED_IMU3",
    "RAW_IMU",
    "ATTITUDE_QUATERNION",
    "LOCAL_POSITION_NED",
    "GLOBAL_POSITION_INT",
    "SYS_STATUS",
    "ESTIMATOR_STATUS",
)


@dataclass(frozen=True)
class PositionInput:
    """An external position on its way to the autopilot.

    ``name`` is the track's name for ``--position-source``, ``row`` how its message holds it,
    ``stamp`` the field with the sender's time in µs, ``estimator`` the MAV_ESTIMATOR_TYPE of which
    it is, where the message has that. PX4 drops the covariance of a naive estimator
    (``mavlink_receiver.cpp``).
    """

    row: str
    description: str
    name: str = ""
    kind: str = "uwb"
    stamp: str = "time_usec"
    estimator: int | None = None
    drops_covariance: bool = False

    @property
    def layout(self) -> Layout:
        """How its message holds it."""
        return LAYOUTS[self.row]

    @property
    def origin(self) -> Origin:
        """Where it comes from, with all that follows from it."""
        return find_origin(self.kind, "as it arrived")

    @property
    def message(self) -> str:
        """Its MAVLink name."""
        return self.layout.topic


@dataclass(frozen=True)
class FrameOfReference:
    """A MAV_FRAME: which component is north (or forward), east (right) and down, and its sign."""

    name: str
    order: tuple[int, int, int] = (0, 1, 2)
    signs: tuple[float, float, float] = (1.0, 1.0, 1.0)
    body: bool = False


_ROWS = table(__file__, "mavlink_messages.toml", dict[str, dict[str, Any]])
LAYOUTS = expand_layouts(_ROWS["layouts"])
_INPUTS = msgspec.convert(_ROWS["positions"], dict[str, PositionInput])
FRAMES_OF_REFERENCE = msgspec.convert(_ROWS["frames"], dict[int, FrameOfReference], strict=False)
AUTOPILOTS, VEHICLE_TYPES, MAIN_MODES, AUTO_MODES = (
    msgspec.convert(_ROWS[name], dict[int, str], strict=False)
    for name in ("autopilots", "vehicle_types", "main_modes", "auto_modes")
)
UNUSED: Mapping[str, str] = _ROWS["unused"]
POSITION_INPUTS = tuple(replace(row, name=name) for name, row in _INPUTS.items())
_SCALED_IMU = (replace(LAYOUTS["scaled_imu"], topic=f"SCALED_IMU{n}") for n in ("", "2", "3"))
IMU = (LAYOUTS["highres_imu"], *_SCALED_IMU)
# Equally dense ones are taken in this order
ATTITUDE = (LAYOUTS["quaternion"], LAYOUTS["angles"], LAYOUTS["attitude_of_odometry"])
# EKF2's state, that with variances first
STATES = (LAYOUTS["odometry"], LAYOUTS["local_position"])
# Simulation truth
TRUTH = (LAYOUTS["truth"], LAYOUTS["sim_state"])
GNSS_INPUTS = (LAYOUTS["gnss"], replace(LAYOUTS["gnss"], topic="GPS2_RAW"))


def remedies_of_autopilot(autopilot: str) -> tuple[Mapping[str, str], Unavailable]:
    """What would have recorded each part, and why EKF2 is not replayed; PX4's but for ArduPilot."""
    if autopilot == "ArduPilot":
        return _ROWS["remedies"][autopilot], ARDUPILOT_REPLAY
    return _ROWS["remedies"]["PX4"], RECORD_NOT_LOGGED
