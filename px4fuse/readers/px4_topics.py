"""The table of PX4 topic and field names by generation: data, no ifs elsewhere.

``px4_topics.toml`` has the rows: a quantity is a layout, or lists those in which PX4 has logged
it, best first. A reader takes the first whose topic holds all its ``columns``; ``optional`` columns
are read where they exist. Names are from PX4-Autopilot's ``msg/*.msg`` at the release tags that
its comments name; those of EKF2's aids stand in ``ekf2_parameters.toml``.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import msgspec

from px4fuse.ekf2_parameters import AIDS
from px4fuse.origin import Origin, find_origin
from px4fuse.readers.layouts import Layout, expand_layouts
from px4fuse.record import table


@dataclass(frozen=True)
class TrackSource:
    """A position track of a log, by its name for ``--position-source``.

    ``kind`` and ``passage`` are those of its origin, ``remedy`` says what would have logged it;
    ``layouts`` are those of a track that has a topic of its own.
    """

    kind: str
    passage: str
    description: str
    remedy: str
    layouts: tuple[str, ...] = ()

    @property
    def origin(self) -> Origin:
        """Where it comes from, with all that follows from it."""
        return find_origin(self.kind, self.passage)


_ROWS = table(__file__, "px4_topics.toml", dict[str, dict[str, Any]])
LAYOUTS = expand_layouts(_ROWS["layouts"])
TRACKS = msgspec.convert(_ROWS["tracks"], dict[str, TrackSource])
FRAMES = msgspec.convert(_ROWS["frames"], dict[str, dict[int, str]], strict=False)
NAV_STATES = msgspec.convert(_ROWS["nav_states"], dict[int, str], strict=False)
UNUSED: Mapping[str, str] = _ROWS["unused"]
IMU, LOCAL_POSITION = LAYOUTS["imu"], LAYOUTS["local_position"]
HEIGHT_BIAS = {name: LAYOUTS[f"bias_of_{name}"] for name in ("baro_hgt", "gnss_hgt")}
# What records all that EKF2 and the loggers publish by default
DEFAULT_PROFILE = "Record with SDLOG_PROFILE bit 0 (default)."
# Topics with EKF2's state vector and its variances, best first
ESTIMATOR_STATES = ("estimator_states", "estimator_status")  # since v1.12, v1.8 to v1.11
# The magnetic field: what was measured, and what EKF2 has kept of it (from v1.14)
MAGNETOMETER = (
    ("vehicle_magnetometer", "magnetometer_ga"),
    ("estimator_aid_src_mag", "observation"),
)
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
ANTENNA_COLUMNS = ["antenna_forward_m", "antenna_right_m", "antenna_down_m"]
# Names for ``--position-source`` of what EKF2 kept of external vision, and of GNSS
KEPT_OBSERVATION = "estimator_aid_src_ev_pos"
RECONSTRUCTION = "ekf2_state_plus_innovation"
GPS_POSITION = "vehicle_gps_position"
# Those of external vision and motion capture that are read as they are logged
LOGGED = [name for name, track in TRACKS.items() if track.layouts and name != GPS_POSITION]
TOPIC_ORIGINS = {name: track.origin for name, track in TRACKS.items()}
# Releases whose rows say "fused" whether it was or not (v1.15, v1.16): the control bit tells
FLAG_ALWAYS_SET = ("gravity", "drag")
# Their observation is a position in EKF2's frame (that of GNSS is latitude and longitude)
WITH_OBSERVATION = ("ev_pos", "ev_hgt")
STATUS_FLAGS, STATUS = "estimator_status_flags", "estimator_status"
# Every aid in one topic: innovations and variances, before v1.12 both
INNOVATIONS = "estimator_innovations", "estimator_innovation_variances"
OLD_INNOVATIONS = "ekf2_innovations"


def layouts_of_track(track: str) -> list[Layout]:
    """How a track may be logged, best first; a row that names no topic is of the track's own."""
    rows = [LAYOUTS[name] for name in TRACKS[track].layouts]
    return [replace(row, topic=row.topic or track) for row in rows]


def topics() -> list[str]:
    """Every topic named in this table, sorted: all that a reader needs to decode."""
    named_topics = {row.topic for track in TRACKS for row in layouts_of_track(track)}
    named_topics |= {row.topic for row in LAYOUTS.values() if row.topic}
    named_topics |= {f"estimator_aid_src_{name}" for name in AIDS}
    aid_topics = {STATUS_FLAGS, *INNOVATIONS, OLD_INNOVATIONS}
    return sorted(
        named_topics | UNUSED.keys() | aid_topics | {*ESTIMATOR_STATES, MAGNETOMETER[0][0]}
    )
