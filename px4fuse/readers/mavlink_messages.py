"""MAVLink messages that px4fuse reads: fields, units and coordinate frames.

The data are in ``mavlink_messages.toml``.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import msgspec

from px4fuse.core.record import read_toml
from px4fuse.flight.model import Unavailable

from .common import MessageLayout, expand_layouts

AUTOPILOT_COMPONENT_ID = 1  # MAV_COMP_ID_AUTOPILOT1
NO_AUTOPILOT = 8  # MAV_AUTOPILOT_INVALID: sent by ground stations, cameras, companions
GROUND_STATION_TYPE = 6  # MAV_TYPE_GCS
ON_GROUND_STATE = 1  # MAV_LANDED_STATE_ON_GROUND
ARDUPILOT_REPLAY_UNAVAILABLE = Unavailable(
    "estimator replay",
    "px4fuse has no model of ArduPilot's estimator (EKF3)",
    "Give a PX4 ULog. px4fuse replays only PX4's EKF2.",
)
# Messages with boot time in the field time_usec
BOOT_CLOCK_MESSAGES = ("HIGHRES_IMU", "ODOMETRY", "ESTIMATOR_STATUS")
# Messages that only an autopilot sends
AUTOPILOT_MESSAGES = (
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
class PositionMessageType:
    """MAVLink message with an external position for the autopilot: fields, frame and clock."""

    # Name of the position source for the option --position-source
    track_name: str
    description: str
    kind: str = "uwb"
    # Coordinate frame of the positions
    frame: str = "unknown"
    # Field with the sender's timestamp (µs)
    timestamp_field: str = "time_usec"
    # Required MAV_ESTIMATOR_TYPE, if any
    estimator_type: int | None = None
    # True if PX4 ignores the covariance of this estimator type (mavlink_receiver.cpp)
    drops_covariance: bool = False

    @property
    def layout(self) -> MessageLayout:
        """Fields of the message, and the DataFrame columns that they become.

        Positions in ODOMETRY messages are split into several sources by estimator type, such as
        ODOMETRY_VIO. All of them have the fields of ODOMETRY.
        """
        return MESSAGE_LAYOUTS.get(self.track_name, MESSAGE_LAYOUTS["ODOMETRY"])

    @property
    def message(self) -> str:
        return self.layout.topic


@dataclass(frozen=True)
class FrameConversion:
    """Conversion of vectors from a MAV_FRAME to NED or FRD: order and signs of the components."""

    name: str
    axis_order: tuple[int, int, int] = (0, 1, 2)
    axis_signs: tuple[float, float, float] = (1.0, 1.0, 1.0)
    is_body_frame: bool = False


_MESSAGE_TABLES = read_toml(__file__, dict[str, dict[str, Any]])
MESSAGE_LAYOUTS = expand_layouts(_MESSAGE_TABLES["layouts"])
CONVERSION_BY_MAV_FRAME = {
    1: FrameConversion("NED"),
    4: FrameConversion("NED", (1, 0, 2), (1.0, 1.0, -1.0)),  # ENU
    8: FrameConversion("FRD", is_body_frame=True),  # MAV_FRAME_BODY_NED, in fact FRD
    12: FrameConversion("FRD", is_body_frame=True),
    20: FrameConversion("FRD"),
    21: FrameConversion("FRD", axis_signs=(1.0, -1.0, -1.0)),  # FLU
}
# Names of MAV_AUTOPILOT
AUTOPILOT_NAME_BY_ID = {0: "generic autopilot", 3: "ArduPilot", 12: "PX4"}
# Advice to the user for each kind of missing data, by autopilot
MISSING_DATA_REMEDIES: Mapping[str, Mapping[str, str]] = _MESSAGE_TABLES["remedies"]
REASON_BY_UNUSED_MESSAGE: Mapping[str, str] = _MESSAGE_TABLES["unused"]
POSITION_MESSAGE_TYPES = tuple(
    msgspec.convert({"track_name": name, **row}, PositionMessageType)
    for name, row in _MESSAGE_TABLES["positions"].items()
)
HIGHRES_IMU_LAYOUT = MESSAGE_LAYOUTS["HIGHRES_IMU"]
# IMU messages; HIGHRES_IMU, or else the message with most samples, is used
IMU_LAYOUTS = (
    HIGHRES_IMU_LAYOUT,
    MESSAGE_LAYOUTS["SCALED_IMU"],
    replace(MESSAGE_LAYOUTS["SCALED_IMU"], topic="SCALED_IMU2"),
    replace(MESSAGE_LAYOUTS["SCALED_IMU"], topic="SCALED_IMU3"),
)
# Attitude messages; the message with most samples is used
ATTITUDE_LAYOUTS = (
    MESSAGE_LAYOUTS["ATTITUDE_QUATERNION"],
    MESSAGE_LAYOUTS["ATTITUDE"],
    MESSAGE_LAYOUTS["attitude_of_odometry"],
)
LOCAL_POSITION_LAYOUT = MESSAGE_LAYOUTS["LOCAL_POSITION_NED"]
# Messages with ground truth of a simulation
TRUTH_LAYOUTS = (MESSAGE_LAYOUTS["HIL_STATE_QUATERNION"], MESSAGE_LAYOUTS["SIMSTATE"])
GNSS_LAYOUTS = (
    MESSAGE_LAYOUTS["GPS_RAW_INT"],
    replace(MESSAGE_LAYOUTS["GPS_RAW_INT"], topic="GPS2_RAW"),
)
