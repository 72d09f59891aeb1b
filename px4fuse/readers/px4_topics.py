"""The table of PX4 topic and field names by generation: data, no ifs elsewhere.

Each quantity lists the layouts in which PX4 has logged it, best first. A reader takes the first
whose topic holds all its ``columns``; ``optional`` columns are read where they exist. Names are
from PX4-Autopilot's ``msg/*.msg`` at the release tags named in ``since``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from px4fuse.flight import (
    ANGULAR_RATE_COLUMNS,
    AXIS_NAMES,
    POSITION_COLUMNS,
    POSITION_VARIANCE_COLUMNS,
    QUATERNION_COLUMNS,
    ROTATION_VARIANCE_COLUMNS,
    SPECIFIC_FORCE_COLUMNS,
    VELOCITY_COLUMNS,
)
from px4fuse.origin import ALIGNED, GNSS, KEPT, MOTION_CAPTURE, REBUILT, RECEIVED, Origin


@dataclass(frozen=True)
class Layout:
    """One way in which PX4 has logged a quantity.

    Attributes
    ----------
    topic : str
    columns : mapping
        Our column name to PX4's field name; all must be present.
    since : str
        The PX4 releases that log it so.
    optional : mapping
        Further columns, read where the topic has them.
    """

    topic: str
    columns: Mapping[str, str]
    since: str
    optional: Mapping[str, str] = field(default_factory=dict)


def _vector(names: list[str], px4_field: str) -> dict[str, str]:
    return {name: f"{px4_field}[{i}]" for i, name in enumerate(names)}


_XYZ = dict(zip(POSITION_COLUMNS, "xyz", strict=True))
_POSITION_AND_VELOCITY = _XYZ | dict(zip(VELOCITY_COLUMNS, ("vx", "vy", "vz"), strict=True))
# pose_covariance is the row-major upper triangle of a 6×6 matrix, rotations last
_POSE_DIAGONAL = {
    name: f"pose_covariance[{at}]"
    for name, at in zip(POSITION_VARIANCE_COLUMNS, (0, 6, 11), strict=True)
}
_ROTATION_DIAGONAL = {
    name: f"pose_covariance[{at}]"
    for name, at in zip(ROTATION_VARIANCE_COLUMNS, (15, 18, 20), strict=True)
}

IMU = (
    Layout(
        "sensor_combined",
        _vector(SPECIFIC_FORCE_COLUMNS, "accelerometer_m_s2")
        | _vector(ANGULAR_RATE_COLUMNS, "gyro_rad"),
        "v1.8",
        {"accelerometer_offset_us": "accelerometer_timestamp_relative"},
    ),
)

ATTITUDE = (Layout("vehicle_attitude", _vector(QUATERNION_COLUMNS, "q"), "v1.8"),)

LOCAL_POSITION = (
    Layout(
        "vehicle_local_position",
        _POSITION_AND_VELOCITY,
        "v1.8",
        {
            **{
                f"{moved}_reset_counter": f"{moved}_reset_counter"
                for moved in ("xy", "z", "vxy", "vz")
            },
            "delta_north_m": "delta_xy[0]",
            "delta_east_m": "delta_xy[1]",
            "delta_down_m": "delta_z",
            "delta_north_m_s": "delta_vxy[0]",
            "delta_east_m_s": "delta_vxy[1]",
            "delta_down_m_s": "delta_vz",
            **{name: name for name in ("ref_lat", "ref_lon", "ref_alt")},
        },
    ),
)

# EKF2's state vector with its variances; the offsets of the variances follow from the lengths
ESTIMATOR_STATES = (
    Layout("estimator_states", {}, "v1.12"),
    Layout("estimator_status", {}, "v1.8 to v1.11"),
)

# (number of states, number of covariances) -> index of the first velocity and position variance.
# 24/24: quaternion filter; 24/23 and 25/24: error-state filter with three attitude errors
# (src/modules/ekf2/EKF/python/ekf_derivation/generated/state.h at v1.15.4 and v1.16).
COVARIANCE_OFFSETS: Mapping[tuple[int, int], tuple[int, int]] = {
    (24, 24): (4, 7),
    (24, 23): (3, 6),
    (25, 24): (3, 6),
    (32, 28): (4, 7),  # before v1.9: arrays padded beyond the 24 states of EKF2
}

# EKF2's accelerometer bias in m/s², whatever the generation of the state vector
SENSOR_BIAS = (
    Layout("estimator_sensor_bias", _vector(SPECIFIC_FORCE_COLUMNS, "accel_bias"), "v1.11"),
)
ACCELEROMETER_BIAS_STATE = 13
# States of the quaternion filter (24 covariances or 28) are velocity increments per prediction
BIAS_PER_STEP: frozenset[tuple[int, int]] = frozenset({(24, 24), (32, 28)})

SELECTOR = (Layout("estimator_selector_status", {"instance": "primary_instance"}, "v1.12"),)

FUSING = (
    Layout(
        "estimator_status_flags",
        {"horizontal": "cs_ev_pos", "vertical": "cs_ev_hgt", "yaw": "cs_ev_yaw"},
        "v1.12",
    ),
    Layout("estimator_status", {"flags": "control_mode_flags"}, "v1.8"),
)
# estimator_status.control_mode_flags, msg/EstimatorStatus.msg
CONTROL_MODE_BITS: Mapping[str, int] = {"horizontal": 12, "yaw": 13, "vertical": 14}

_AID_OPTIONAL = {"fused": "fused", "rejected": "innovation_rejected"}


def _aid(index: str) -> dict[str, str]:
    return {
        "innovation_m": f"innovation{index}",
        "innovation_variance_m2": f"innovation_variance{index}",
        "observation_variance_m2": f"observation_variance{index}",
        "test_ratio": f"test_ratio{index}",
    }


# The per-source record of every fusion attempt, with exact times, since v1.14
AID_SOURCE: Mapping[str, tuple[Layout, ...]] = {
    "north": (Layout("estimator_aid_src_ev_pos", _aid("[0]"), "v1.14", _AID_OPTIONAL),),
    "east": (Layout("estimator_aid_src_ev_pos", _aid("[1]"), "v1.14", _AID_OPTIONAL),),
    "down": (Layout("estimator_aid_src_ev_hgt", _aid(""), "v1.14", _AID_OPTIONAL),),
}


@dataclass(frozen=True)
class InnovationLayout:
    """Innovations, their variances and test ratios, which are separate topics before v1.14.

    ``fields`` gives the field per axis, ``ratio_fields`` that of the test ratio: v1.11 to v1.13
    store the larger of the two horizontal ratios in element 0.
    """

    topic: str
    variance_topic: str
    ratio_topic: str
    fields: Mapping[str, str]
    variance_fields: Mapping[str, str]
    ratio_fields: Mapping[str, str]
    since: str


_EV_FIELDS = {"north": "ev_hpos[0]", "east": "ev_hpos[1]", "down": "ev_vpos"}
INNOVATIONS = (
    InnovationLayout(
        "estimator_innovations",
        "estimator_innovation_variances",
        "estimator_innovation_test_ratios",
        _EV_FIELDS,
        _EV_FIELDS,
        _EV_FIELDS,
        "v1.11",
    ),
    InnovationLayout(
        "ekf2_innovations",
        "ekf2_innovations",
        "",
        {axis: f"vel_pos_innov[{3 + i}]" for i, axis in enumerate(AXIS_NAMES)},
        {axis: f"vel_pos_innov_var[{3 + i}]" for i, axis in enumerate(AXIS_NAMES)},
        {},
        "v1.8 to v1.10",
    ),
)

LAND_DETECTED = (Layout("vehicle_land_detected", {"landed": "landed"}, "v1.8"),)

FLIGHT_MODE = (Layout("vehicle_status", {"nav_state": "nav_state"}, "v1.8"),)
# vehicle_status.nav_state as QGroundControl names it, msg/VehicleStatus.msg; the numbers that are
# missing here were never flown in v1.12 to v1.16
NAV_STATES: Mapping[int, str] = {
    0: "Manual", 1: "Altitude", 2: "Position", 3: "Mission", 4: "Hold", 5: "Return",
    6: "Position Slow", 8: "Altitude Cruise", 10: "Acro", 12: "Descend", 13: "Termination",
    14: "Offboard", 15: "Stabilized", 16: "Rattitude", 17: "Takeoff", 18: "Land",
    19: "Follow Me", 20: "Precision Land", 21: "Orbit", 22: "VTOL Takeoff",
    **{22 + number: f"External {number}" for number in range(1, 9)},
}  # fmt: skip

TRUTH_LOCAL = (Layout("vehicle_local_position_groundtruth", _POSITION_AND_VELOCITY, "simulation"),)
TRUTH_GLOBAL = (
    Layout(
        "vehicle_global_position_groundtruth",
        {"latitude_deg": "lat", "longitude_deg": "lon", "altitude_m": "alt"},
        "simulation",
        {"north_m_s": "vel_n", "east_m_s": "vel_e", "down_m_s": "vel_d"},
    ),
)
TRUTH_ATTITUDE = (
    Layout("vehicle_attitude_groundtruth", _vector(QUATERNION_COLUMNS, "q"), "simulation"),
)

_GPS_OPTIONAL = {
    "eph_m": "eph", "epv_m": "epv", "fix_type": "fix_type", "utc_us": "time_utc_usec",
}  # fmt: skip
GPS = (
    Layout(
        "vehicle_gps_position",
        {
            "latitude_deg": "latitude_deg",
            "longitude_deg": "longitude_deg",
            "altitude_m": "altitude_msl_m",
        },
        "v1.14",
        _GPS_OPTIONAL,
    ),
    Layout(
        "vehicle_gps_position",
        {"latitude_1e7": "lat", "longitude_1e7": "lon", "altitude_mm": "alt"},
        "v1.8 to v1.13",
        _GPS_OPTIONAL,
    ),
)


@dataclass(frozen=True)
class TrackSource:
    """A logged position track: its name for ``--position-source``, and its layouts."""

    name: str
    origin: Origin
    description: str
    layouts: tuple[Layout, ...]


# msg/VehicleOdometry.msg: LOCAL_FRAME_* up to v1.13, POSE_FRAME_* since v1.14
FRAMES: Mapping[str, Mapping[int, str]] = {
    "pose_frame": {0: "unknown", 1: "NED", 2: "FRD"},
    "local_frame": {0: "NED", 1: "FRD", 2: "unknown", 3: "FRD"},
}


def _odometry_until_v1_13(topic: str, since: str) -> Layout:
    optional = _POSE_DIAGONAL | _vector(QUATERNION_COLUMNS, "q") | _ROTATION_DIAGONAL
    return Layout(topic, _XYZ, f"{since} to v1.13", optional | {"local_frame": "local_frame"})


def _odometry(topic: str) -> tuple[Layout, ...]:
    return (
        Layout(
            topic,
            _vector(POSITION_COLUMNS, "position"),
            "v1.14",
            _vector(POSITION_VARIANCE_COLUMNS, "position_variance")
            | {"pose_frame": "pose_frame"}
            | _vector(QUATERNION_COLUMNS, "q")
            | _vector(ROTATION_VARIANCE_COLUMNS, "orientation_variance"),
        ),
        _odometry_until_v1_13(topic, "v1.9"),
    )


TRACKS = (
    TrackSource(
        "vehicle_visual_odometry",
        RECEIVED,
        "external vision position as PX4 received it",
        (*_odometry("vehicle_visual_odometry"), Layout("vehicle_vision_position", _XYZ, "v1.8")),
    ),
    TrackSource(
        "vehicle_mocap_odometry",
        MOTION_CAPTURE,
        "motion capture, which EKF2 never fuses",
        (*_odometry("vehicle_mocap_odometry"), Layout("att_pos_mocap", _XYZ, "v1.8")),
    ),
    TrackSource(
        "estimator_visual_odometry_aligned",
        ALIGNED,
        "external vision rotated into EKF2's frame",
        (
            _odometry_until_v1_13("estimator_visual_odometry_aligned", "v1.12"),
            Layout("vehicle_visual_odometry_aligned", _XYZ, "v1.10 to v1.11", _POSE_DIAGONAL),
        ),
    ),
)

# Names for ``--position-source`` of what EKF2 kept of external vision, and of GNSS
KEPT_OBSERVATION = "estimator_aid_src_ev_pos"
RECONSTRUCTION = "ekf2_state_plus_innovation"
GPS_POSITION = "vehicle_gps_position"
TOPIC_ORIGINS = {track.name: track.origin for track in TRACKS} | {
    KEPT_OBSERVATION: KEPT, RECONSTRUCTION: REBUILT, GPS_POSITION: GNSS,
}  # fmt: skip

AID_OBSERVATION_HORIZONTAL = (
    Layout(
        "estimator_aid_src_ev_pos",
        {"north_m": "observation[0]", "east_m": "observation[1]"},
        "v1.14",
        {"north_m2": "observation_variance[0]", "east_m2": "observation_variance[1]"},
    ),
)
AID_OBSERVATION_VERTICAL = (
    Layout(
        "estimator_aid_src_ev_hgt",
        {"down_m": "observation"},
        "v1.14",
        {"down_m2": "observation_variance"},
    ),
)

# What bears on position and is not used, and why
UNUSED: Mapping[str, str] = {
    "sensor_uwb": "one range and two angles per message, not a position: send the position that "
    "the UWB system computes as VISION_POSITION_ESTIMATE",
    "uwb_distance": "ranges to the anchors, and the landing target seen from the vehicle",
    "uwb_grid": "positions of the UWB anchors and of the landing target, not the vehicle's",
}


def topics() -> list[str]:
    """Every topic named in this table, sorted: all that a reader needs to decode."""
    groups = (
        IMU, ATTITUDE, LOCAL_POSITION, ESTIMATOR_STATES, SENSOR_BIAS, SELECTOR, FUSING,
        LAND_DETECTED, FLIGHT_MODE, TRUTH_LOCAL, TRUTH_GLOBAL, TRUTH_ATTITUDE, GPS,
        AID_OBSERVATION_HORIZONTAL, AID_OBSERVATION_VERTICAL, *AID_SOURCE.values(),
        *(track.layouts for track in TRACKS),
    )  # fmt: skip
    names = {layout.topic for group in groups for layout in group} | UNUSED.keys()
    for layout in INNOVATIONS:
        names |= {layout.topic, layout.variance_topic, layout.ratio_topic}
    return sorted(names - {""})
