"""The table of PX4 topic and field names by generation: data, no ifs elsewhere.

Each quantity is a layout, or lists those in which PX4 has logged it, best first. A reader takes
the first whose topic holds all its ``columns``; ``optional`` columns are read where they exist.
Names are from PX4-Autopilot's ``msg/*.msg`` at the release tags that its comments name.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from px4fuse.ekf2_parameters import AID_MASK, EV_POS
from px4fuse.flight import BAD_ACCELERATION, GROUND_EFFECT, Columns
from px4fuse.origin import ALIGNED, GNSS, KEPT, MOTION_CAPTURE, REBUILT, RECEIVED, Origin
from px4fuse.readers import layouts
from px4fuse.readers.layouts import Layout, elements, fields

IMU = Layout(
    "sensor_combined",
    elements(Columns.SPECIFIC_FORCE, "accelerometer_m_s2")
    | elements(Columns.ANGULAR_RATE, "gyro_rad"),
    {
        "accelerometer_offset_us": "accelerometer_timestamp_relative",
        "clipped": "accelerometer_clipping",  # v1.10
    },
)

ATTITUDE = Layout("vehicle_attitude", elements(Columns.QUATERNION, "q"))

_RESETS = ("xy_reset_counter", "z_reset_counter", "vxy_reset_counter", "vz_reset_counter")
LOCAL_POSITION = Layout(
    "vehicle_local_position",
    layouts.POSITION_AND_VELOCITY,
    {name: name for name in (*_RESETS, "ref_lat", "ref_lon", "ref_alt")}
    | {"delta_down_m": "delta_z", "delta_down_m_s": "delta_vz"}
    | elements(["delta_north_m", "delta_east_m"], "delta_xy")
    | elements(["delta_north_m_s", "delta_east_m_s"], "delta_vxy"),
)

# What records all that EKF2 and the loggers publish by default
DEFAULT_PROFILE = "Record with SDLOG_PROFILE bit 0 (default)."

# Topics with EKF2's state vector and its variances, best first
ESTIMATOR_STATES = ("estimator_states", "estimator_status")  # since v1.12, v1.8 to v1.11
# The magnetic field: what was measured, and what EKF2 has kept of it (from v1.14)
MAGNETOMETER = (
    ("vehicle_magnetometer", "magnetometer_ga"), ("estimator_aid_src_mag", "observation"),
)  # fmt: skip
# (number of states, number of variances) -> how many variances attitude has; velocity and position
# follow it. 4: of the quaternion filter, whose biases are increments per prediction; 3: of the
# error-state filter (EKF/python/ekf_derivation/generated/state.h at v1.15.4 and v1.16)
ATTITUDE_VARIANCES: Mapping[tuple[int, int], int] = {
    (24, 24): 4,
    (24, 23): 3,
    (25, 24): 3,
    (32, 28): 4,  # before v1.9: arrays padded beyond the 24 states of EKF2
}
QUATERNION_FILTER = 4

# EKF2's accelerometer bias in m/s², whatever the generation of the state vector
SENSOR_BIAS = Layout("estimator_sensor_bias", elements(Columns.SPECIFIC_FORCE, "accel_bias"))

SELECTOR = Layout("estimator_selector_status", {"instance": "primary_instance"})  # v1.12

LAND_DETECTED = Layout("vehicle_land_detected", {"landed": "landed"})

FLIGHT_MODE = Layout("vehicle_status", {"nav_state": "nav_state"})
FAILURE = Layout("failure_detector_status", {"roll": "fd_roll", "pitch": "fd_pitch"})  # v1.13
# vehicle_status.nav_state as QGroundControl names it, msg/VehicleStatus.msg; the numbers that are
# missing here were never flown in v1.12 to v1.16
NAV_STATES: Mapping[int, str] = {
    0: "Manual", 1: "Altitude", 2: "Position", 3: "Mission", 4: "Hold", 5: "Return",
    6: "Position Slow", 8: "Altitude Cruise", 10: "Acro", 12: "Descend", 13: "Termination",
    14: "Offboard", 15: "Stabilized", 16: "Rattitude", 17: "Takeoff", 18: "Land",
    19: "Follow Me", 20: "Precision Land", 21: "Orbit", 22: "VTOL Takeoff",
    **{22 + number: f"External {number}" for number in range(1, 9)},
}  # fmt: skip

TRUTH_LOCAL = Layout("vehicle_local_position_groundtruth", layouts.POSITION_AND_VELOCITY)
TRUTH_GLOBAL = Layout(
    "vehicle_global_position_groundtruth",
    layouts.GLOBAL,
    fields(Columns.VELOCITY, "vel_n vel_e vel_d"),
)
TRUTH_ATTITUDE = Layout("vehicle_attitude_groundtruth", elements(Columns.QUATERNION, "q"))

BAROMETER = Layout("vehicle_air_data", {"altitude_m": "baro_alt_meter"})
_BIAS = {"bias_m": "bias", "bias_m2": "bias_var"}
HEIGHT_BIAS = {
    "baro_hgt": Layout("estimator_baro_bias", _BIAS),
    "gnss_hgt": Layout("estimator_gnss_hgt_bias", _BIAS),
}

# Velocity of the body (FRD) that each sample of optical flow tells of, as EKF2 low-passes it, and
# the rate that it is from: the range is what lies between them
FLOW = (
    Layout(
        "estimator_optical_flow_vel",
        elements(["forward_m_s", "right_m_s"], "vel_body_filtered")
        | elements(["newest_forward_m_s", "newest_right_m_s"], "vel_body")
        | elements(["x_rad_s", "y_rad_s"], "flow_rate_compensated"),
    ),
    Layout("vehicle_optical_flow", {"interval_us": "integration_timespan_us"}),
    Layout("estimator_aid_src_optical_flow", {"noise": "observation_variance[0]"}),
)

_GPS_OPTIONAL = {
    "eph_m": "eph", "epv_m": "epv", "fix_type": "fix_type", "utc_us": "time_utc_usec",
    "published_us": "timestamp", "speed_accuracy_m_s": "s_variance_m_s",
    **fields(Columns.VELOCITY, "vel_n_m_s vel_e_m_s vel_d_m_s"),
}  # fmt: skip
_VEHICLE_GNSS = _GPS_OPTIONAL | fields(Columns.VELOCITY, "vel_north vel_east vel_down")
ANTENNA_COLUMNS = ["antenna_forward_m", "antenna_right_m", "antenna_down_m"]


def _of_receiver(names: Mapping[str, str]) -> dict[str, str]:
    """Fields of the receiver's message inside another."""
    return {ours: f"receiver.{px4}" for ours, px4 in names.items()}


GPS = (
    Layout(  # main of 2026
        "vehicle_gnss",
        _of_receiver(fields(layouts.GLOBAL_COLUMNS, "latitude longitude altitude_msl")),
        _of_receiver(_VEHICLE_GNSS | {"speed_accuracy_m_s": "speed_accuracy"})
        | elements(ANTENNA_COLUMNS, "antenna_offset"),
    ),
    Layout(  # v1.14
        "vehicle_gps_position",
        fields(layouts.GLOBAL_COLUMNS, "latitude_deg longitude_deg altitude_msl_m"),
        _GPS_OPTIONAL
        | fields(ANTENNA_COLUMNS, "antenna_offset_x antenna_offset_y antenna_offset_z"),
    ),
    # v1.8 to v1.13
    Layout("vehicle_gps_position", layouts.GLOBAL, _GPS_OPTIONAL, layouts.GLOBAL_SCALE),
)

FUSED_FIXES = (
    Layout(
        "estimator_aid_src_gnss_pos",
        elements(["latitude_deg", "longitude_deg"], "observation")  # v1.16
        | {"fused": "fused", "rejected": "innovation_rejected"},
    ),
    Layout("estimator_aid_src_gnss_vel", elements(Columns.VELOCITY, "observation")),
)
FUSED_HEIGHT = Layout(
    "estimator_aid_src_gnss_hgt", {"altitude_m": "observation"}, scale={"altitude_m": -1.0}
)


@dataclass(frozen=True)
class TrackSource:
    """A position track of a log, by its name for ``--position-source``.

    ``remedy`` says what would have logged it; ``layouts`` are those of a track that has a topic of
    its own.
    """

    name: str
    origin: Origin
    description: str
    remedy: str
    layouts: tuple[Layout, ...] = ()


# msg/VehicleOdometry.msg: LOCAL_FRAME_* up to v1.13, POSE_FRAME_* since v1.14
FRAMES: Mapping[str, Mapping[int, str]] = {
    "pose_frame": {0: "unknown", 1: "NED", 2: "FRD"},
    "local_frame": {0: "NED", 1: "FRD", 2: "unknown", 3: "FRD"},
}


_OLD_POSE = elements(Columns.POSITION_VARIANCE, "pose_covariance", layouts.POSE_DIAGONAL)
_OLD_ODOMETRY = (
    _OLD_POSE
    | elements(Columns.QUATERNION, "q")
    | elements(Columns.ROTATION_VARIANCE, "pose_covariance", layouts.ROTATION_DIAGONAL)
    | {"local_frame": "local_frame"}
)


def _odometry(topic: str) -> tuple[Layout, ...]:
    return (
        Layout(  # v1.14
            topic,
            elements(Columns.POSITION, "position"),
            elements(Columns.POSITION_VARIANCE, "position_variance")
            | {"pose_frame": "pose_frame"}
            | elements(Columns.QUATERNION, "q")
            | elements(Columns.ROTATION_VARIANCE, "orientation_variance"),
        ),
        Layout(topic, layouts.XYZ, _OLD_ODOMETRY),  # v1.9 to v1.13
    )


# Names for ``--position-source`` of what EKF2 kept of external vision, and of GNSS
KEPT_OBSERVATION = "estimator_aid_src_ev_pos"
RECONSTRUCTION = "ekf2_state_plus_innovation"
GPS_POSITION = "vehicle_gps_position"
_TRACKS = (
    TrackSource(
        "vehicle_visual_odometry", RECEIVED, "external vision position as PX4 received it",
        "Set SDLOG_PROFILE to 129 (default and vision) to log it as it arrives.",
        _odometry("vehicle_visual_odometry"),
    ),
    TrackSource(
        "vehicle_mocap_odometry", MOTION_CAPTURE, "motion capture, which EKF2 never fuses",
        "Logged when ATT_POS_MOCAP is sent to PX4.", _odometry("vehicle_mocap_odometry"),
    ),
    TrackSource(
        "estimator_visual_odometry_aligned", ALIGNED, "external vision rotated into EKF2's frame",
        "Logged by PX4 v1.10 to v1.13 when external vision is fused.",
        (
            Layout("estimator_visual_odometry_aligned", layouts.XYZ, _OLD_ODOMETRY),  # v1.12, v1.13
            Layout("vehicle_visual_odometry_aligned", layouts.XYZ, _OLD_POSE),  # v1.10, v1.11
        ),
    ),
    TrackSource(
        KEPT_OBSERVATION, KEPT, "the observations that EKF2 kept of external vision",
        "Logged by default since v1.16 when EKF2 runs on external vision.",
    ),
    TrackSource(
        RECONSTRUCTION, REBUILT, "EKF2's position plus its innovation",
        "Needs EKF2 innovations of external vision.",
    ),
    TrackSource(
        GPS_POSITION, GNSS, "GNSS position", "Logged when a GPS receiver is connected.", GPS
    ),
)  # fmt: skip
TRACKS: Mapping[str, TrackSource] = {track.name: track for track in _TRACKS}
# Those of external vision and motion capture that are read as they are logged
LOGGED = [name for name, track in TRACKS.items() if track.layouts and name != GPS_POSITION]
TOPIC_ORIGINS = {name: track.origin for name, track in TRACKS.items()}
# What has EKF2 fuse external vision; it starts on samples less than 0.2 s apart (ev_control.cpp)
HOW_TO_FUSE: Mapping[str, str] = {
    "horizontal": "Send the position at 10 Hz (EKF2 starts on samples less than 0.2 s apart) and "
    f"set bit 0 of {EV_POS.switch} (bit 3 of {AID_MASK} before v1.14).",
    "vertical": f"Set bit 1 of {EV_POS.switch} (EKF2_HGT_MODE 3 before v1.14) if EKF2 is to fuse "
    "the source's height.",
}

AID_OBSERVATION_HORIZONTAL = Layout(
    KEPT_OBSERVATION,
    elements(Columns.POSITION[:2], "observation"),
    # v1.14
    elements(Columns.POSITION_VARIANCE[:2], "observation_variance"),
)
AID_OBSERVATION_VERTICAL = Layout(
    "estimator_aid_src_ev_hgt",
    {"down_m": "observation"},
    # v1.14
    {"down_m2": "observation_variance"},
)

# What EKF2 fuses: msg/EstimatorAidSource{1,2,3}d.msg, EstimatorInnovations.msg,
# EstimatorStatusFlags.msg, EstimatorStatus.msg, and EKF2.cpp (PublishInnovations)
_NED, _HORIZONTAL, _XYZ = ("north", "east", "down"), ("north", "east"), ("x", "y", "z")


@dataclass(frozen=True)
class AidSource:
    """Where releases log an aid.

    Attributes
    ----------
    axes : tuple of str
        Of its innovations, in PX4's order.
    fields : tuple of str
        Of ``estimator_innovations`` and ``_variances``, by axis; empty where they have none.
    before : tuple of str
        Of ``ekf2_innovations`` (v1.8 to v1.10), to which ``_var`` is added for the variance.
    flags : tuple of tuple of str
        Of ``estimator_status_flags``: the first group that the log has tells, by any of its flags,
        whether EKF2 means to fuse the aid.
    bit : int or None
        The same of ``estimator_status.control_mode_flags``.
    """

    axes: tuple[str, ...]
    fields: tuple[str, ...] = ()
    before: tuple[str, ...] = ()
    flags: tuple[tuple[str, ...], ...] = ()
    bit: int | None = None


def _of(name: str, count: int, first: int = 0) -> tuple[str, ...]:
    """Elements of an array field."""
    return tuple(f"{name}[{first + number}]" for number in range(count))


_GPS = (("cs_gnss_pos",), ("cs_gps",))
_GPS_VELOCITY = (("cs_gnss_vel",), ("cs_gps",))
# No aids, but what bears on them
DISTURBANCES = (GROUND_EFFECT, BAD_ACCELERATION)
SOURCES: Mapping[str, AidSource] = {
    "gnss_pos": AidSource(
        _HORIZONTAL, _of("gps_hpos", 2), _of("vel_pos_innov", 2, 3), _GPS, 2
    ),
    "gnss_vel": AidSource(
        _NED, (*_of("gps_hvel", 2), "gps_vvel"), _of("vel_pos_innov", 3), _GPS_VELOCITY, 2
    ),
    "gnss_hgt": AidSource(
        ("down",), ("gps_vpos",), ("vel_pos_innov[5]",), (("cs_gps_hgt",),), 11
    ),
    "gnss_yaw": AidSource(
        ("yaw",), ("heading",), ("heading_innov",), (("cs_gnss_yaw",), ("cs_gps_yaw",)), 22
    ),
    "ev_pos": AidSource(
        _HORIZONTAL, _of("ev_hpos", 2), _of("vel_pos_innov", 2, 3), (("cs_ev_pos",),), 12
    ),
    "ev_vel": AidSource(_NED, (*_of("ev_hvel", 2), "ev_vvel"), (), (("cs_ev_vel",),), 24),
    "ev_hgt": AidSource(("down",), ("ev_vpos",), ("vel_pos_innov[5]",), (("cs_ev_hgt",),), 14),
    "ev_yaw": AidSource(("yaw",), ("heading",), ("heading_innov",), (("cs_ev_yaw",),), 13),
    "baro_hgt": AidSource(
        ("down",), ("baro_vpos",), ("vel_pos_innov[5]",), (("cs_baro_hgt",),), 9
    ),
    "rng_hgt": AidSource(
        ("down",), ("rng_vpos",), ("vel_pos_innov[5]",),
        (("cs_rng_hgt", "cs_rng_terrain"), ("cs_rng_hgt",)), 10,
    ),
    "optical_flow": AidSource(
        ("x", "y"), _of("flow", 2), _of("flow_innov", 2),
        (("cs_opt_flow", "cs_opt_flow_terrain"), ("cs_opt_flow",)), 3,
    ),
    "mag": AidSource(
        _XYZ, _of("mag_field", 3), _of("mag_innov", 3),
        (("cs_mag", "cs_mag_hdg", "cs_mag_3d"), ("cs_mag_3d",)), 5,
    ),
    # where there is a flag cs_mag, "heading" is the largest component of the field, in gauss
    "mag_heading": AidSource(("yaw",), ("heading",), ("heading_innov",), (("cs_mag_hdg",),), 4),
    "airspeed": AidSource(("x",), ("airspeed",), ("airspeed_innov",), (("cs_fuse_aspd",),), 19),
    "sideslip": AidSource(("y",), ("beta",), ("beta_innov",), (("cs_fuse_beta",),), 15),
    "drag": AidSource(("x", "y"), _of("drag", 2), _of("drag_innov", 2), (("cs_wind",),), 8),
    "gravity": AidSource(_XYZ, _of("gravity", 3), (), (("cs_gravity_vector",),)),
    "aux_vel": AidSource(_HORIZONTAL, _of("aux_hvel", 2)),
    "aux_global_position": AidSource(_HORIZONTAL, (), (), (("cs_aux_gpos",),)),
    "fake_pos": AidSource(
        _HORIZONTAL, (), (), (("cs_fake_pos", "cs_valid_fake_pos"), ("cs_fake_pos",))
    ),
    GROUND_EFFECT: AidSource((), flags=(("cs_gnd_effect",),), bit=20),
    BAD_ACCELERATION: AidSource((), flags=(("fs_bad_acc_vertical",),)),
}  # fmt: skip
# Releases whose rows say "fused" whether it was or not (v1.15, v1.16): the control bit tells
FLAG_ALWAYS_SET = ("gravity", "drag")
# Their observation is a position in EKF2's frame (that of GNSS is latitude and longitude)
WITH_OBSERVATION = ("ev_pos", "ev_hgt")
STATUS_FLAGS, STATUS = "estimator_status_flags", "estimator_status"
CONTROL_BITS = Layout(STATUS, {"bits": "control_mode_flags"})
# Every aid in one topic: innovations and variances, before v1.12 both
INNOVATIONS = "estimator_innovations", "estimator_innovation_variances"
OLD_INNOVATIONS = "ekf2_innovations"

# What bears on position and is not used, and why
UNUSED: Mapping[str, str] = {
    "sensor_uwb": "one range and two angles per message, not a position: send the position that "
    "the UWB system computes as VISION_POSITION_ESTIMATE",
    "uwb_distance": "ranges to the anchors, and the landing target seen from the vehicle",
    "uwb_grid": "positions of the UWB anchors and of the landing target, not the vehicle's",
}


def topics() -> list[str]:
    """Every topic named in this table, sorted: all that a reader needs to decode."""
    layouts = (
        IMU, ATTITUDE, LOCAL_POSITION, SENSOR_BIAS, SELECTOR, LAND_DETECTED, FLIGHT_MODE, FAILURE,
        BAROMETER, TRUTH_LOCAL, TRUTH_GLOBAL, TRUTH_ATTITUDE, AID_OBSERVATION_HORIZONTAL,
        AID_OBSERVATION_VERTICAL, *HEIGHT_BIAS.values(), *FLOW,
        *(layout for track in _TRACKS for layout in track.layouts),
    )  # fmt: skip
    named = {layout.topic for layout in layouts}
    named |= {f"estimator_aid_src_{name}" for name in SOURCES}
    of_aids = {STATUS_FLAGS, STATUS, *INNOVATIONS, OLD_INNOVATIONS}
    return sorted(named | UNUSED.keys() | of_aids | {*ESTIMATOR_STATES, MAGNETOMETER[0][0]})
