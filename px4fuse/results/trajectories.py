"""Results about paths, part by part: scores, loops and their corrections, pose graphs.

Units stand in the names. Positions along the axes of a path's frame go by the axes' names.
"""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from px4fuse.record import Count, Maybe, NotNegative, Record, Share, Unavailable, Vector
from px4fuse.trajectory.evaluation import AbsoluteError
from px4fuse.trajectory.offset import TimeOffset
from px4fuse.trajectory.scores import RelativeError

Frame = Literal["NED", "FRD", "ENU", "camera", "unknown"]
Kind = Literal["vio", "ekf2", "kf", "truth", "slam", "unknown"]
AxisLengths = Annotated[dict[str, float], Meta(min_length=3, max_length=3)]


class Track(Record, frozen=True):
    """A trajectory and the file that it was read from."""

    name: str
    sha256: Annotated[str, Meta(pattern="^([0-9a-f]{64})?$")]
    size_bytes: Count
    kind: Kind
    frame: Frame
    poses: Count
    start_s: float
    end_s: float
    orientations: bool
    notes: tuple[str, ...]


class Transform(Record, frozen=True):
    """What brings the estimate onto the reference: x ↦ scale · R x + t."""

    quaternion_wxyz: tuple[float, float, float, float]
    translation_m: Vector
    scale: float
    degrees_of_freedom: Count


class Association(Record, frozen=True):
    """How poses were paired by time, and how many were left out."""

    method: Literal["interpolate", "nearest"]
    poses: Count
    max_gap_s: NotNegative
    outside: Count
    in_gaps: Count
    coverage_estimate: float
    coverage_reference: float


class Score(Record, frozen=True, kw_only=True):
    """ATE and RPE (Sturm et al. 2012) of a path against a reference."""

    alignment: Literal["none", "yaw", "se3", "sim3"]
    alignment_reason: str
    transform: Transform
    association: Association
    time_offset: TimeOffset
    ate: AbsoluteError
    rpe: tuple[RelativeError, ...]
    notes: tuple[str, ...]
    warnings: tuple[str, ...]


class KnownEnd(Record, frozen=True, kw_only=True):
    """Where the vehicle really ended, seen from its start."""

    displacement_m: AxisLengths
    heading_change_deg: float | None = None
    sigma_m: NotNegative
    sigma_heading_deg: NotNegative | None = None
    source: str
    assumed: bool


class OdometryNoise(Record, frozen=True):
    """Drift of the odometry in 100 m and by time (1 σ)."""

    position_m: NotNegative
    heading_deg: NotNegative
    position_m_per_root_s: NotNegative
    heading_deg_per_root_s: NotNegative
    tilt_share: NotNegative


class Closure(Record, frozen=True):
    """Two times at one place, what the gate says of it, and its weights in robust solutions."""

    time_1_s: float
    time_2_s: float
    sigma_m: NotNegative
    source: str
    distance_m: NotNegative
    d2: NotNegative
    degrees_of_freedom: Count
    p: Share
    accepted: bool
    weight_dcs: float | None = None
    weight_gnc: float | None = None


class Correction(Record, frozen=True, kw_only=True):
    """A path, how far it was moved, and its scores by reference."""

    moved_max_m: NotNegative
    moved_rms_m: NotNegative
    cost_initial: NotNegative | None = None
    cost: NotNegative | None = None
    iterations: Count | None = None
    converged: bool | None = None
    scores: dict[str, Maybe[Score]]


class Corrections(Record, frozen=True):
    """The path as it is, and by every way to correct it.

    ``by_distance_plain`` moves positions alone, as the lesson's Example 2; ``by_distance`` turns
    headings too, where it is known how far they are off.
    """

    uncorrected: Maybe[Correction]
    by_distance_plain: Maybe[Correction]
    by_distance: Maybe[Correction]
    pose_graph_all: Maybe[Correction]
    pose_graph_gated: Maybe[Correction]
    pose_graph_dcs: Maybe[Correction]
    pose_graph_gnc: Maybe[Correction]


class LoopPart(Record, frozen=True, kw_only=True):
    """A path that truly returns.

    ``closure_error_m`` is how far its end is from where the vehicle really ended;
    ``closure_percent`` the same in per cent of the path; ``absolute`` says that the track follows
    a positioning system and does not drift.
    """

    track: str
    kind: Kind
    frame: Frame
    start_s: float
    end_s: float
    part_reason: str
    poses: Count
    key_frames: Count
    key_frame_spacing_m: NotNegative
    path_length_m: NotNegative
    end_from_start_m: AxisLengths
    heading_change_deg: float | None = None
    known_end: Maybe[KnownEnd]
    closure_error_m: NotNegative | None = None
    closure_percent: NotNegative | None = None
    closure_error_axes_m: AxisLengths | None = None
    heading_error_deg: float | Unavailable
    absolute: bool
    odometry_noise: OdometryNoise
    closures: tuple[Closure, ...]
    corrections: Corrections
    notes: tuple[str, ...]


class GraphGate(Record, frozen=True):
    """What the gate says of one closure, by the vertex numbers of the file."""

    first: int
    second: int
    d2: NotNegative
    degrees_of_freedom: Count
    p: Share
    accepted: bool


class GraphSolution(Record, frozen=True):
    """One solution of a pose graph; ``dropped`` counts edges of weight below a half."""

    cost_initial: NotNegative
    cost: NotNegative
    iterations: Count
    converged: bool
    dropped: Count


class Graph(Record, frozen=True):
    """A pose graph from a file, its closures and its solutions."""

    name: str
    dimension: Count
    poses: Count
    edges: Count
    initialised: str
    gates: tuple[GraphGate, ...] | Unavailable
    solutions: dict[str, GraphSolution]
