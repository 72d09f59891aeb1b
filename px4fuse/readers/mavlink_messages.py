"""The table of MAVLink messages: names, units, frames and directions as data.

Sources: MAVLink ``common.xml``; PX4 ``src/modules/mavlink/mavlink_receiver.cpp`` and
``streams/*.hpp`` (v1.13 to v1.16).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import constants

from px4fuse.arrays import Array
from px4fuse.flight import RECORD_NOT_LOGGED, Unavailable
from px4fuse.origin import MOTION_CAPTURE, RECEIVED, Origin

AUTOPILOT_COMPONENT = 1  # MAV_COMP_ID_AUTOPILOT1
NO_AUTOPILOT = 8  # MAV_AUTOPILOT_INVALID: a ground station, a camera, a companion computer
GROUND_STATION = 6  # MAV_TYPE_GCS
LANDED = 1  # MAV_LANDED_STATE_ON_GROUND
AUTOPILOTS: Mapping[int, str] = {0: "generic autopilot", 3: "ArduPilot", 12: "PX4"}
VEHICLE_TYPES: Mapping[int, str] = {
    0: "generic vehicle", 1: "fixed wing", 2: "quadrotor", 3: "coaxial helicopter",
    4: "helicopter", 5: "antenna tracker", 6: "ground station", 10: "ground rover",
    11: "surface boat", 12: "submarine", 13: "hexarotor", 14: "octorotor", 15: "tricopter",
    18: "companion computer", 19: "VTOL", 20: "VTOL", 21: "VTOL", 22: "VTOL", 26: "gimbal",
    27: "ADS-B receiver", 30: "camera",
}  # fmt: skip
# HEARTBEAT.custom_mode, px4_custom_mode.h: main mode in bits 16 to 23, that of Auto above them
AUTO_MODE = 4
MAIN_MODES: Mapping[int, str] = {
    1: "Manual", 2: "Altitude", 3: "Position", 5: "Acro", 6: "Offboard", 7: "Stabilized",
    8: "Rattitude", 10: "Termination",
}  # fmt: skip
AUTO_MODES: Mapping[int, str] = {
    2: "Takeoff", 3: "Hold", 4: "Mission", 5: "Return", 6: "Land", 8: "Follow Me",
    9: "Precision Land", 10: "VTOL Takeoff",
}  # fmt: skip
NO_MODES = Unavailable(
    "flight modes", "no HEARTBEAT of a PX4 autopilot", "Record the link of a PX4 vehicle."
)


@dataclass(frozen=True)
class Remedies:
    """What would have put each part of a flight into a recording, by the autopilot's own means."""

    imu: str
    attitude: str
    state: str
    variance: str
    innovations: str
    fusing: str
    landed: str
    position: str
    truth: str
    replay: Unavailable


_JOIN = "Give the ULog of the same flight as LOG, and this recording with --mavlink."
_FILE = "give the positioning system's own file with --position."
PX4_REMEDIES = Remedies(
    imu="Set the stream rate of HIGHRES_IMU to 50 Hz or more (in PX4's console: mavlink stream "
    "-d DEVICE -s HIGHRES_IMU -r 100), or join the ULog.",
    attitude="Set the stream rate of ATTITUDE_QUATERNION to 20 Hz or more, or join the ULog.",
    state="Set the stream rate of ODOMETRY to 30 Hz or more, or join the ULog.",
    variance="Set the stream rate of ODOMETRY to 30 Hz or more, or join the ULog.",
    innovations=_JOIN,
    fusing=_JOIN,
    landed="Set the stream rate of EXTENDED_SYS_STATE to 1 Hz, or give --start and --end.",
    position="Record where the companion's link passes (a MAVLink router), or join the ULog of the "
    f"flight, or {_FILE}",
    truth="Real flights have truth only from motion capture (send ATT_POS_MOCAP).",
    replay=RECORD_NOT_LOGGED,
)
# Its own log is DataFlash (.BIN), and SRn_ parameters set the streams of its serial port n
ARDUPILOT_REMEDIES = Remedies(
    imu="Ask the autopilot for SCALED_IMU2 at 50 Hz (MAV_CMD_SET_MESSAGE_INTERVAL, or SRn_RAW_SENS "
    "of the recorded link).",
    attitude="Ask the autopilot for ATTITUDE at 20 Hz (MAV_CMD_SET_MESSAGE_INTERVAL, or SRn_EXTRA1 "
    "of the recorded link).",
    state="Ask the autopilot for LOCAL_POSITION_NED at 10 Hz (MAV_CMD_SET_MESSAGE_INTERVAL, or "
    "SRn_POSITION of the recorded link).",
    variance="ArduPilot sends no variances; px4fuse does not read its DataFlash log (.BIN).",
    innovations="ArduPilot keeps them in its DataFlash log (.BIN), which px4fuse does not read.",
    fusing="ArduPilot keeps them in its DataFlash log (.BIN), which px4fuse does not read.",
    landed="Ask for EXTENDED_SYS_STATE at 1 Hz, or give --start and --end.",
    position=f"Record where the companion's link passes (a MAVLink router), or {_FILE}",
    truth="ArduPilot fuses motion capture itself, so that a real flight's recording has no truth.",
    replay=Unavailable(
        "replay of the estimator",
        "ArduPilot's estimator is another one than the one that px4fuse has a model of",
        "Read its state as it is.",
    ),
)


def remedies_of(autopilot: str) -> Remedies:
    """Remedies for the autopilot of that name; PX4's for all but ArduPilot."""
    return ARDUPILOT_REMEDIES if autopilot == "ArduPilot" else PX4_REMEDIES


# Row-major upper triangle of a 6×6 matrix: x, y, z
POSE_DIAGONAL = np.array([0, 6, 11])
# The same triangle's rotations about x, y, z
ROTATION_DIAGONAL = np.array([15, 18, 20])
# Row-major upper triangle of a 9×9 matrix: x, y, z, vx, vy, vz
EXTENDED_COVARIANCE_DIAGONAL = np.array([0, 9, 17, 24, 30, 35])


@dataclass(frozen=True)
class ImuSource:
    """An IMU message and what its units are in m/s² and rad/s; axes are body FRD."""

    message: str
    acceleration_unit: float
    angular_rate_unit: float


IMU = (
    ImuSource("HIGHRES_IMU", 1.0, 1.0),
    # milli-g and mrad/s
    ImuSource("SCALED_IMU", constants.g * 1e-3, 1e-3),
    ImuSource("SCALED_IMU2", constants.g * 1e-3, 1e-3),
    ImuSource("SCALED_IMU3", constants.g * 1e-3, 1e-3),
)
# Messages whose time_usec is the autopilot's boot clock; GPS_RAW_INT's, say, is the receiver's
STAMPED_BY_BOOT_CLOCK = ("HIGHRES_IMU", "ODOMETRY", "ESTIMATOR_STATUS")
# What an autopilot sends of itself, and nobody else
OWN_MESSAGES = (
    "HIGHRES_IMU", "SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3", "RAW_IMU", "ATTITUDE_QUATERNION",
    "LOCAL_POSITION_NED", "GLOBAL_POSITION_INT", "SYS_STATUS", "ESTIMATOR_STATUS",
)  # fmt: skip
# Equally dense ones are taken in this order
ATTITUDE = ("ATTITUDE_QUATERNION", "ATTITUDE", "ODOMETRY")


@dataclass(frozen=True)
class PositionInput:
    """An external position on its way to the autopilot.

    ``name`` is the track's name for ``--position-source``, ``stamp`` the field with the sender's
    time in µs. PX4 drops the covariance of a naive estimator (``mavlink_receiver.cpp``).
    """

    name: str
    message: str
    stamp: str
    origin: Origin
    description: str
    drops_covariance: bool = False


def _odometry(
    name: str, description: str, drops: bool = False, origin: Origin = RECEIVED
) -> PositionInput:
    return PositionInput(name, "ODOMETRY", "time_usec", origin, description, drops)


_MOCAP = "motion capture, which EKF2 never fuses"
POSITION_INPUTS = (
    PositionInput(
        "VISION_POSITION_ESTIMATE", "VISION_POSITION_ESTIMATE", "usec", RECEIVED,
        "external vision position as it was sent to the autopilot",
    ),
    _odometry("ODOMETRY", "external odometry as it was sent to the autopilot"),
    PositionInput("ATT_POS_MOCAP", "ATT_POS_MOCAP", "time_usec", MOTION_CAPTURE, _MOCAP),
)  # fmt: skip
# ODOMETRY from outside the autopilot by MAV_ESTIMATOR_TYPE. The others are no measurement: PX4
# refuses GPS, GPS_INS, LIDAR and AUTOPILOT as input; from the autopilot itself it is EKF2's output.
ODOMETRY_INPUTS: Mapping[int, PositionInput] = {
    0: _odometry("ODOMETRY", "external odometry as it was sent to the autopilot"),
    1: _odometry("ODOMETRY_NAIVE", "external odometry, without covariance", True),
    2: _odometry("ODOMETRY_VISION", "visual odometry as it was sent to the autopilot"),
    3: _odometry("ODOMETRY_VIO", "visual-inertial odometry as it was sent to the autopilot"),
    6: _odometry("ODOMETRY_MOCAP", _MOCAP, origin=MOTION_CAPTURE),
}


@dataclass(frozen=True)
class FrameOfReference:
    """A MAV_FRAME: which component is north (or forward), east (right) and down, and its sign.

    ``body`` says whether it turns with the vehicle.
    """

    name: str
    order: tuple[int, int, int]
    signs: tuple[float, float, float]
    body: bool = False

    @property
    def as_is(self) -> bool:
        """Whether it is NED (or FRD) already, and does not turn with the vehicle."""
        return not self.body and self.order == _AS_IS and self.signs == _NOTHING

    def turn(self, vectors: Array) -> Array:
        """Vectors of this frame in NED (or FRD), shape (n, 3)."""
        return vectors[:, self.order] * self.signs

    def permute(self, variances: Array) -> Array:
        """Variances of this frame's components in NED (or FRD) order, shape (n, 3)."""
        return variances[:, self.order]


_AS_IS, _NOTHING = (0, 1, 2), (1.0, 1.0, 1.0)
FRAMES_OF_REFERENCE: Mapping[int, FrameOfReference] = {
    1: FrameOfReference("NED", _AS_IS, _NOTHING),
    4: FrameOfReference("NED", (1, 0, 2), (1.0, 1.0, -1.0)),  # ENU: x_N = y, y_E = x, z_D = -z
    8: FrameOfReference("FRD", _AS_IS, _NOTHING, body=True),  # MAV_FRAME_BODY_NED, in fact FRD
    12: FrameOfReference("FRD", _AS_IS, _NOTHING, body=True),
    20: FrameOfReference("FRD", _AS_IS, _NOTHING),
    21: FrameOfReference("FRD", _AS_IS, (1.0, -1.0, -1.0)),
}

UNUSED: Mapping[str, str] = {
    "RAW_IMU": "raw counts without a unit",
    "VISION_SPEED_ESTIMATE": "a velocity, not a position; for information",
    "VICON_POSITION_ESTIMATE": "PX4 does not read it",
    "GLOBAL_VISION_POSITION_ESTIMATE": "PX4 does not read it",
    "GPS_INPUT": "a substitute GPS receiver",
    "GPS_RAW_INT": "GPS is not an indoor position",
    "DISTANCE_SENSOR": "a range, not a position",
    "OPTICAL_FLOW_RAD": "an angular rate, not a position",
}
