"""The table of MAVLink messages: names, units, frames and directions as data.

A new message with a position is a row of :data:`POSITION_INPUTS`, and nothing else.

Sources: MAVLink ``common.xml``; PX4 ``src/modules/mavlink/mavlink_receiver.cpp`` and
``streams/*.hpp`` (v1.13 to v1.16).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from scipy import constants

from px4fuse.flight import RECORD_NOT_LOGGED, Columns, Unavailable
from px4fuse.origin import MOTION_CAPTURE, RECEIVED, Origin
from px4fuse.readers import layouts
from px4fuse.readers.layouts import Layout, elements, fields

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

# By part of a flight: the message that carries it from PX4 and from ArduPilot, and how often (Hz)
_STREAMS: Mapping[str, tuple[str, str, int]] = {
    "imu": ("HIGHRES_IMU", "SCALED_IMU2", 50),
    "attitude": ("ATTITUDE_QUATERNION", "ATTITUDE", 20),
    "state": ("ODOMETRY", "LOCAL_POSITION_NED", 30),
}
_LANDED = "Have EXTENDED_SYS_STATE sent at 1 Hz, or give --start and --end."
_ROUTER = "Record where the companion's link passes (a MAVLink router), or"
_FILE = "give the positioning system's own file with --position."
ARDUPILOT_REPLAY = Unavailable(
    "replay of the estimator",
    "ArduPilot's estimator is another one than the one that px4fuse has a model of",
    "Read its state as it is.",
)


def remedies_of(autopilot: str) -> tuple[Mapping[str, str], Unavailable]:
    """What would have recorded each part, and why EKF2 is not replayed; PX4's but for ArduPilot."""
    if autopilot == "ArduPilot":
        kept = "ArduPilot keeps them in its DataFlash log (.BIN), which px4fuse does not read."
        asked = {
            part: f"Ask the autopilot for {name} at {hz} Hz (MAV_CMD_SET_MESSAGE_INTERVAL)."
            for part, (_, name, hz) in _STREAMS.items()
        }
        return asked | {
            "landed": _LANDED,
            "variance": kept,
            "inside": kept,
            "position": f"{_ROUTER} {_FILE}",
            "truth": "ArduPilot fuses motion capture itself: a real flight has no truth.",
        }, ARDUPILOT_REPLAY
    streamed = {
        part: f"Set the stream rate of {name} to {hz} Hz or more (in PX4's console: mavlink stream "
        f"-d DEVICE -s {name} -r {hz}), or join the ULog."
        for part, (name, _, hz) in _STREAMS.items()
    }
    return streamed | {
        "landed": _LANDED,
        "variance": streamed["state"],
        "inside": "Give the ULog of the same flight as LOG, and this recording with --mavlink.",
        "position": f"{_ROUTER} join the ULog of the flight, or {_FILE}",
        "truth": "Real flights have truth only from motion capture (send ATT_POS_MOCAP).",
    }, RECORD_NOT_LOGGED


_IMU_COLUMNS = Columns.SPECIFIC_FORCE + Columns.ANGULAR_RATE
_IMU_FIELDS = fields(_IMU_COLUMNS, "xacc yacc zacc xgyro ygyro zgyro")
# milli-g and mrad/s
_MILLI = dict(zip(_IMU_COLUMNS, [constants.g * 1e-3] * 3 + [1e-3] * 3, strict=True))
IMU = (
    Layout("HIGHRES_IMU", _IMU_FIELDS),
    *(Layout(f"SCALED_IMU{n}", _IMU_FIELDS, scale=_MILLI) for n in ("", "2", "3")),
)
# Messages whose time_usec is the autopilot's boot clock; GPS_RAW_INT's, say, is the receiver's
STAMPED_BY_BOOT_CLOCK = ("HIGHRES_IMU", "ODOMETRY", "ESTIMATOR_STATUS")
# What an autopilot sends of itself, and nobody else
OWN_MESSAGES = (
    "HIGHRES_IMU", "SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3", "RAW_IMU", "ATTITUDE_QUATERNION",
    "LOCAL_POSITION_NED", "GLOBAL_POSITION_INT", "SYS_STATUS", "ESTIMATOR_STATUS",
)  # fmt: skip
_ANGLES = {"roll": "roll", "pitch": "pitch", "yaw": "yaw"}
_Q = elements(Columns.QUATERNION, "q")
# Equally dense ones are taken in this order
ATTITUDE = (
    Layout("ATTITUDE_QUATERNION", {name: f"q{i}" for i, name in enumerate(Columns.QUATERNION, 1)}),
    Layout("ATTITUDE", _ANGLES),
    Layout("ODOMETRY", _Q),
)


def _pose(covariance: str) -> dict[str, str]:
    """Variances of position and orientation, which stand on the diagonal of a covariance."""
    return elements(Columns.POSITION_VARIANCE, covariance, layouts.POSE_DIAGONAL) | elements(
        Columns.ROTATION_VARIANCE, covariance, layouts.ROTATION_DIAGONAL
    )


ODOMETRY = Layout(
    "ODOMETRY",
    layouts.POSITION_AND_VELOCITY
    | _Q
    | _pose("pose_covariance")
    | elements(Columns.VELOCITY_VARIANCE, "velocity_covariance", layouts.POSE_DIAGONAL)
    | {name: name for name in ("frame_id", "child_frame_id", "reset_counter")},
)
# EKF2's state, that with variances first
STATES = (ODOMETRY, Layout("LOCAL_POSITION_NED", layouts.POSITION_AND_VELOCITY))
ACCURACY = Layout(
    "ESTIMATOR_STATUS", {"horizontal_m": "pos_horiz_accuracy", "vertical_m": "pos_vert_accuracy"}
)

# Simulation truth; ArduPilot's SIMSTATE has no height and no velocity
TRUTH = (
    Layout(
        "HIL_STATE_QUATERNION",
        layouts.GLOBAL | layouts.VELOCITY | elements(Columns.QUATERNION, "attitude_quaternion"),
        scale=layouts.GLOBAL_SCALE | dict.fromkeys(Columns.VELOCITY, 1e-2),
    ),
    Layout("SIMSTATE", fields(layouts.GLOBAL_COLUMNS[:2], "lat lng"), scale=layouts.GLOBAL_SCALE),
)


@dataclass(frozen=True)
class PositionInput:
    """An external position on its way to the autopilot.

    ``name`` is the track's name for ``--position-source``, ``stamp`` the field with the sender's
    time in µs, ``estimator`` the MAV_ESTIMATOR_TYPE of which it is, where the message has that.
    PX4 drops the covariance of a naive estimator (``mavlink_receiver.cpp``).
    """

    name: str
    layout: Layout
    stamp: str
    origin: Origin
    description: str
    estimator: int | None = None
    drops_covariance: bool = False

    @property
    def message(self) -> str:
        """Its MAVLink name."""
        return self.layout.topic


_SENT = "as it was sent to the autopilot"
_MOCAP = "motion capture, which EKF2 never fuses"
# ODOMETRY from outside the autopilot is by MAV_ESTIMATOR_TYPE. The others are no measurement: PX4
# refuses GPS, GPS_INS, LIDAR and AUTOPILOT as input; from the autopilot itself it is EKF2's output.
POSITION_INPUTS = (
    PositionInput(
        "VISION_POSITION_ESTIMATE",
        Layout("VISION_POSITION_ESTIMATE", layouts.XYZ | _ANGLES | _pose("covariance")),
        "usec", RECEIVED, f"external vision position {_SENT}",
    ),
    PositionInput(
        "ODOMETRY", ODOMETRY, "time_usec", RECEIVED, f"external odometry {_SENT}", 0,
    ),
    PositionInput(
        "ODOMETRY_NAIVE", ODOMETRY, "time_usec", RECEIVED, "external odometry, without covariance",
        1, drops_covariance=True,
    ),
    PositionInput(
        "ODOMETRY_VISION", ODOMETRY, "time_usec", RECEIVED, f"visual odometry {_SENT}", 2,
    ),
    PositionInput(
        "ODOMETRY_VIO", ODOMETRY, "time_usec", RECEIVED, f"visual-inertial odometry {_SENT}", 3,
    ),
    PositionInput("ODOMETRY_MOCAP", ODOMETRY, "time_usec", MOTION_CAPTURE, _MOCAP, 6),
    PositionInput(
        "ATT_POS_MOCAP",
        Layout("ATT_POS_MOCAP", layouts.XYZ | _Q | _pose("covariance")),
        "time_usec", MOTION_CAPTURE, _MOCAP,
    ),
)  # fmt: skip


# What a GNSS receiver gave, as the autopilot passes it on; accuracies are extensions of MAVLink 2,
# eph and epv are dilutions of precision
GNSS_INPUTS = tuple(
    Layout(
        message,
        layouts.GLOBAL | {"fix_type": "fix_type", "eph_m": "h_acc", "epv_m": "v_acc"},
        scale=layouts.GLOBAL_SCALE | {"eph_m": 1e-3, "epv_m": 1e-3},
    )
    for message in ("GPS_RAW_INT", "GPS2_RAW")
)
PRESSURE = Layout("SCALED_PRESSURE", {"pressure_hpa": "press_abs"})
ORIGIN = Layout(
    "GPS_GLOBAL_ORIGIN",
    fields(layouts.GLOBAL_COLUMNS, "latitude longitude altitude"),
    scale=layouts.GLOBAL_SCALE,
)
GLOBAL_STATE = Layout("GLOBAL_POSITION_INT", layouts.GLOBAL, scale=layouts.GLOBAL_SCALE)


class FrameOfReference(NamedTuple):
    """A MAV_FRAME: which component is north (or forward), east (right) and down, and its sign.

    ``body`` says whether it turns with the vehicle.
    """

    name: str
    order: tuple[int, int, int] = (0, 1, 2)
    signs: tuple[float, float, float] = (1.0, 1.0, 1.0)
    body: bool = False


FRAMES_OF_REFERENCE: Mapping[int, FrameOfReference] = {
    1: FrameOfReference("NED"),
    4: FrameOfReference("NED", (1, 0, 2), (1.0, 1.0, -1.0)),  # ENU: x_N = y, y_E = x, z_D = -z
    8: FrameOfReference("FRD", body=True),  # MAV_FRAME_BODY_NED, in fact FRD
    12: FrameOfReference("FRD", body=True),
    20: FrameOfReference("FRD"),
    21: FrameOfReference("FRD", signs=(1.0, -1.0, -1.0)),
}

UNUSED: Mapping[str, str] = {
    "RAW_IMU": "raw counts without a unit",
    "VISION_SPEED_ESTIMATE": "a velocity, not a position; for information",
    "VICON_POSITION_ESTIMATE": "PX4 does not read it",
    "GLOBAL_VISION_POSITION_ESTIMATE": "PX4 does not read it",
    "GPS_INPUT": "a substitute GPS receiver",
    "DISTANCE_SENSOR": "a range, not a position",
    "OPTICAL_FLOW_RAD": "an angular rate, not a position",
}
