"""Where the releases of PX4 log what EKF2 fuses: the rows that :mod:`px4_aids` reads.

Sources: PX4-Autopilot ``msg/EstimatorAidSource{1,2,3}d.msg``, ``msg/EstimatorInnovations.msg``,
``msg/EstimatorStatusFlags.msg``, ``msg/EstimatorStatus.msg``, ``EKF2.cpp`` (PublishInnovations).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

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
}  # fmt: skip
# Releases whose rows say "fused" whether it was or not (v1.15, v1.16): the control bit tells
FLAG_ALWAYS_SET = ("gravity", "drag")
# Their observation is a position in EKF2's frame (that of GNSS is latitude and longitude)
WITH_OBSERVATION = ("ev_pos", "ev_hgt")
STATUS_FLAGS, STATUS = "estimator_status_flags", "estimator_status"


def aid_topics() -> set[str]:
    """Every topic that :func:`read_aids` looks at."""
    own = {f"estimator_aid_src_{name}" for name in SOURCES}
    return own | {
        STATUS_FLAGS, STATUS, "estimator_innovations", "estimator_innovation_variances",
        "ekf2_innovations",
    }  # fmt: skip
