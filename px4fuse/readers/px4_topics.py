"""PX4 topic and field names of all supported PX4 releases.

The data are in ``px4_topics.toml``. Source: PX4-Autopilot ``msg/*.msg``.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import msgspec
from msgspec import structs

from px4fuse.core.record import read_toml
from px4fuse.flight.ekf2_parameters import AIDS
from px4fuse.flight.model import SourceOrigin, find_source_origin

from .common import MessageLayout, expand_layouts


@dataclass(frozen=True)
class TrackSource:
    """Description of a position source: kind, coordinate frame, topics and logging advice."""

    route: str
    description: str
    # Advice if the positions of this source are not logged
    remedy: str
    kind: str = "uwb"
    # False if EKF2 never fuses these positions
    fused: bool = True
    # Coordinate frame of the positions; if "unknown", the topic may contain it
    frame: str = "unknown"
    # Names of the possible topic definitions in ``px4_topics.toml``, preferred first
    layouts: tuple[str, ...] = ()

    @property
    def origin(self) -> SourceOrigin:
        origin = find_source_origin(self.kind, self.route)
        return origin if self.fused else structs.replace(origin, aid=None)


_TOPIC_TABLES = read_toml(__file__, dict[str, dict[str, Any]])
TOPIC_LAYOUTS = expand_layouts(_TOPIC_TABLES["layouts"])
TOPIC_LAYOUTS["gps_in_integers"] = replace(
    TOPIC_LAYOUTS["gps_in_integers"],
    optional_columns=TOPIC_LAYOUTS["vehicle_gps_position"].optional_columns,
)
TOPIC_LAYOUTS["estimator_gnss_hgt_bias"] = replace(
    TOPIC_LAYOUTS["estimator_baro_bias"], topic="estimator_gnss_hgt_bias"
)
TRACK_SOURCES = msgspec.convert(_TOPIC_TABLES["tracks"], dict[str, TrackSource])
FRAME_BY_FIELD_VALUE = msgspec.convert(
    _TOPIC_TABLES["frames"], dict[str, dict[int, str]], strict=False
)
UNUSED_TOPICS: Mapping[str, str] = _TOPIC_TABLES["unused"]
IMU_LAYOUT, LOCAL_POSITION_LAYOUT = (
    TOPIC_LAYOUTS["sensor_combined"],
    TOPIC_LAYOUTS["vehicle_local_position"],
)
HEIGHT_BIAS_LAYOUT_BY_AID = {
    "baro_hgt": TOPIC_LAYOUTS["estimator_baro_bias"],
    "gnss_hgt": TOPIC_LAYOUTS["estimator_gnss_hgt_bias"],
}
# Advice if a topic of the default logging profile is not logged
DEFAULT_PROFILE_REMEDY = "Record with SDLOG_PROFILE bit 0 (default)."
# Topics with EKF2's state vector and variances, in order of preference
STATE_VECTOR_TOPICS = ("estimator_states", "estimator_status")  # since v1.12, v1.8 to v1.11
# Number of logged attitude variances: 4 for a quaternion, 3 for a rotation vector. The keys are the
# numbers of logged states and of logged variances (generated/state.h)
ATTITUDE_VARIANCE_COUNT_BY_ARRAY_LENGTHS: Mapping[tuple[int, int], int] = {
    (24, 24): 4,
    (24, 23): 3,
    (25, 24): 3,
    (32, 28): 4,  # PX4 before v1.9, which uses only the first 24 of the 32 states
}
QUATERNION_VARIANCE_COUNT = 4
# Values of the option --position-source
FUSED_OBSERVATION_TRACK_NAME = "estimator_aid_src_ev_pos"
RECONSTRUCTED_TRACK_NAME = "ekf2_state_plus_innovation"
GPS_POSITION_TOPIC = "vehicle_gps_position"
# Position sources that have their own topic, without GNSS
SOURCE_TRACK_NAMES = [
    name for name, track in TRACK_SOURCES.items() if track.layouts and name != GPS_POSITION_TOPIC
]
# The flag "fused" of these aiding sources is always set in v1.15 and v1.16
AIDS_ALWAYS_FUSED = ("gravity", "drag")
# Aiding sources whose logged observation is a local position
AIDS_WITH_LOCAL_POSITION_OBSERVATION = ("ev_pos", "ev_hgt")
STATUS_FLAGS_TOPIC, STATUS_TOPIC = "estimator_status_flags", "estimator_status"
# Topics with innovations and innovation variances of all aiding sources (since v1.12)
INNOVATION_TOPICS = "estimator_innovations", "estimator_innovation_variances"
OLD_INNOVATION_TOPIC = "ekf2_innovations"


def find_track_layouts(source_name: str) -> list[MessageLayout]:
    """Return the possible topics and fields of a position source, best first."""
    layouts = [TOPIC_LAYOUTS[name] for name in TRACK_SOURCES[source_name].layouts]
    return [replace(layout, topic=layout.topic or source_name) for layout in layouts]


def list_topics() -> list[str]:
    """Return the sorted names of all PX4 topics that the ULog reader decodes."""
    layout_topics = {
        layout.topic for track in TRACK_SOURCES for layout in find_track_layouts(track)
    }
    layout_topics |= {layout.topic for layout in TOPIC_LAYOUTS.values() if layout.topic}
    layout_topics |= {f"estimator_aid_src_{name}" for name in AIDS}
    layout_topics |= {STATUS_FLAGS_TOPIC, *INNOVATION_TOPICS, OLD_INNOVATION_TOPIC}
    return sorted(layout_topics | UNUSED_TOPICS.keys() | {*STATE_VECTOR_TOPICS})
