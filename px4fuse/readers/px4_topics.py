"""PX4 topic and field names of all supported PX4 releases.

``px4_topics.toml`` contains one or more layouts of each quantity: topic, fields and DataFrame
columns. The first layout is read of which the log contains the topic and all required fields. The
names are from PX4-Autopilot's ``msg/*.msg`` at the releases in the comments of ``px4_topics.toml``.
The names of EKF2's aiding sources are in ``ekf2_parameters.toml``.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import msgspec
from msgspec import structs

from px4fuse.core.record import read_toml
from px4fuse.flight.ekf2_parameters import AIDS
from px4fuse.flight.model import Origin, find_origin
from px4fuse.readers.field_maps import Layout, expand_layouts


@dataclass(frozen=True)
class TrackSource:
    """Position source that a ULog may contain, as ``px4_topics.toml`` describes it."""

    # Kind of the source, such as "uwb", and the way of its positions into the log (see Origin)
    kind: str
    path: str
    description: str
    # Advice how to record these positions
    remedy: str
    # False if EKF2 never fuses these positions
    fused: bool = True
    # Coordinate frame of the positions. If "unknown", a field of the topic may contain it (FRAMES)
    frame: str = "unknown"
    # Keys in LAYOUTS, one for each format of the topic in PX4 releases; empty for positions that
    # are computed from several topics
    layouts: tuple[str, ...] = ()

    @property
    def origin(self) -> Origin:
        origin = find_origin(self.kind, self.path)
        return origin if self.fused else structs.replace(origin, aid=None)


_TABLE = read_toml(__file__, dict[str, dict[str, Any]])
LAYOUTS = expand_layouts(_TABLE["layouts"])
TRACKS = msgspec.convert(_TABLE["tracks"], dict[str, TrackSource])
FRAMES = msgspec.convert(_TABLE["frames"], dict[str, dict[int, str]], strict=False)
UNUSED_TOPICS: Mapping[str, str] = _TABLE["unused"]
IMU, LOCAL_POSITION = LAYOUTS["imu"], LAYOUTS["local_position"]
HEIGHT_BIAS_LAYOUTS = {name: LAYOUTS[f"bias_of_{name}"] for name in ("baro_hgt", "gnss_hgt")}
# Advice to the user if a topic of the default logging profile is not logged
DEFAULT_PROFILE_REMEDY = "Record with SDLOG_PROFILE bit 0 (default)."
# Topics with EKF2's state vector and variances, in order of preference
STATE_VECTOR_TOPICS = ("estimator_states", "estimator_status")  # since v1.12, v1.8 to v1.11
# Layouts of the measured magnetic field: magnetometer, and EKF2's observation (since v1.14)
MAGNETIC_FIELD_LAYOUTS = LAYOUTS["magnetometer"], LAYOUTS["observed_field"]
# Number of attitude variances, by the number of logged states and of logged variances of EKF2. An
# EKF2 with quaternion states has 4, with attitude errors 3 (generated/state.h, v1.15.4 and v1.16)
ATTITUDE_VARIANCE_COUNTS: Mapping[tuple[int, int], int] = {
    (24, 24): 4,
    (24, 23): 3,
    (25, 24): 3,
    (32, 28): 4,  # before v1.9: arrays padded after the 24 states of EKF2
}
QUATERNION_VARIANCE_COUNT = 4
ANTENNA_COLUMNS = ["antenna_forward_m", "antenna_right_m", "antenna_down_m"]
# Names in the option --position-source: EKF2's observations, EKF2 position plus innovation, GNSS
FUSED_OBSERVATION = "estimator_aid_src_ev_pos"
RECONSTRUCTION = "ekf2_state_plus_innovation"
GPS_POSITION = "vehicle_gps_position"
# Position sources, other than GNSS, with a topic that contains the positions
SOURCE_TRACKS = [name for name, track in TRACKS.items() if track.layouts and name != GPS_POSITION]
ORIGIN_BY_TRACK_NAME = {name: track.origin for name, track in TRACKS.items()}
# Aiding sources whose flag "fused" is always set in v1.15 and v1.16. The flag is not used
AIDS_ALWAYS_FUSED = ("gravity", "drag")
# Aiding sources whose logged observation is a local position; that of GNSS is a latitude
AIDS_WITH_OBSERVATION = ("ev_pos", "ev_hgt")
STATUS_FLAGS, STATUS_TOPIC = "estimator_status_flags", "estimator_status"
# Topics with the innovations and the innovation variances of all aiding sources (since v1.12)
INNOVATION_TOPICS = "estimator_innovations", "estimator_innovation_variances"
OLD_INNOVATION_TOPIC = "ekf2_innovations"


def layouts_of_track(source_name: str) -> list[Layout]:
    """Return the possible topics and fields of a position source, best first.

    If a layout contains no topic, the topic has the name of the position source.
    """
    layouts = [LAYOUTS[name] for name in TRACKS[source_name].layouts]
    return [replace(layout, topic=layout.topic or source_name) for layout in layouts]


def topics() -> list[str]:
    """Return the sorted names of all PX4 topics that the ULog reader decodes."""
    named_topics = {layout.topic for track in TRACKS for layout in layouts_of_track(track)}
    named_topics |= {layout.topic for layout in LAYOUTS.values() if layout.topic}
    named_topics |= {f"estimator_aid_src_{name}" for name in AIDS}
    aid_topics = {STATUS_FLAGS, *INNOVATION_TOPICS, OLD_INNOVATION_TOPIC}
    return sorted(named_topics | UNUSED_TOPICS.keys() | aid_topics | {*STATE_VECTOR_TOPICS})
