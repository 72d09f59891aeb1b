"""What is known of a loop, as it is computed and written: ends, closures, corrected paths."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import numpy as np

from px4fuse.arrays import Array, IntArray
from px4fuse.display import one_line_repr
from px4fuse.errors import MissingDataError
from px4fuse.record import Count, NotNegative, OrUnavailable, Record, Share, Unavailable
from px4fuse.trajectory.evaluation import Evaluation, Score
from px4fuse.trajectory.graph.model import PoseGraph
from px4fuse.trajectory.graph.solver import Solution
from px4fuse.trajectory.model import AxisLengths, Frame, Kind, Trajectory

# How a path is corrected; the part after "pose_graph_" as in `trajectory.graph.analysis.SOLUTIONS`
Way = Literal[
    "uncorrected",
    "by_distance_plain",
    "by_distance",
    "pose_graph_all",
    "pose_graph_gated",
    "pose_graph_dcs",
    "pose_graph_gnc",
]
LANDING = "landing"


class KnownEnd(Record, frozen=True, kw_only=True):
    """Where the vehicle really ended, seen from where it began.

    Attributes
    ----------
    displacement_m : mapping from the name of an axis to float
    heading_change_deg : float or None
        From the first heading to the last, clockwise; None where it is not known.
    sigma_m, sigma_heading_deg : float
        Standard deviations; that of the heading where it is known.
    source : str
        Who says so.
    assumed : bool
        Whether nobody knows.
    """

    displacement_m: AxisLengths
    heading_change_deg: float | None = None
    sigma_m: NotNegative
    sigma_heading_deg: NotNegative | None = None
    source: str
    assumed: bool

    @property
    def displacement(self) -> Array:
        """In the frame of the trajectory, shape (3,), in m."""
        return np.array(list(self.displacement_m.values()))


class OdometryNoise(Record, frozen=True, omit_defaults=False):
    """Drift of an odometry as random walks over distance and over time.

    Attributes
    ----------
    position_m : float
        Standard deviation of position, each axis, after 100 m by steps of translation alone.
    heading_deg : float
        Standard deviation of heading after 100 m.
    position_m_per_root_s, heading_deg_per_root_s : float
        The same for the time that passes, hovering included (m/√s, °/√s).
    tilt_share : float
        Drift of roll and pitch against that of heading: gravity holds them.

    Notes
    -----
    The defaults are what indoor visual-inertial odometry reaches: about 1 % of the distance
    (Delmerico and Scaramuzza 2018; Intel's data sheet of the T265 states the same).
    """

    position_m: NotNegative = 1.0
    heading_deg: NotNegative = 3.0
    position_m_per_root_s: NotNegative = 0.01
    heading_deg_per_root_s: NotNegative = 0.03
    tilt_share: NotNegative = 0.1


class Closure(Record, frozen=True, kw_only=True):
    """Two times at one place, what the gate says of it, and its weights in robust solutions.

    Attributes
    ----------
    time_1_s, time_2_s : float
        In the trajectory's own time.
    sigma_m : float
        Standard deviation of the displacement, each axis.
    source : str
        "landing", or "given".
    distance_m : float
        By which the odometry misses it.
    d2, degrees_of_freedom, p, accepted
        As :class:`~px4fuse.trajectory.graph.covariance.GateResult` has them.
    weight_dcs, weight_gnc : float or None
        What robust solving gives it, 0 to 1; None where there is no redundancy.
    """

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

    def __str__(self) -> str:
        if self.source == LANDING:
            return "the closure of take-off and landing"
        return f"the closure of {self.time_1_s:.12g} s and {self.time_2_s:.12g} s"


class Correction(Record, frozen=True, kw_only=True):
    """How far a path was moved, the pose graph's costs, and scores by reference."""

    moved_max_m: NotNegative
    moved_rms_m: NotNegative
    cost_initial: NotNegative | None = None
    cost: NotNegative | None = None
    iterations: Count | None = None
    converged: bool | None = None
    scores: Mapping[str, OrUnavailable[Score]]


class CorrectedPath(Correction, frozen=True, kw_only=True, eq=False):
    """A corrected path, or the odometry itself.

    Attributes
    ----------
    scores : mapping from the reference's name to Evaluation or Unavailable
    name : str
    trajectory : Trajectory
        All poses of the part, corrected.
    moved_m : ndarray, shape (n,)
        How far each pose moved.
    solution : Solution or None
        Of a pose graph.
    """

    schema_type = Correction
    scores: Mapping[str, Evaluation | Unavailable]
    name: str
    trajectory: Trajectory
    moved_m: Array
    solution: Solution | None = None

    __repr__ = one_line_repr


class LoopResult(Record, frozen=True, kw_only=True):
    """A path that truly returns.

    ``closure_error_m`` is how far its end is from where the vehicle really ended;
    ``closure_percent`` the same in per cent of the path; ``absolute`` says that the track follows
    a positioning system and does not drift. ``by_distance_plain`` of the corrections moves
    positions alone, as the lesson's Example 2; ``by_distance`` turns headings too, where it is
    known how far they are off.
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
    known_end: OrUnavailable[KnownEnd]
    closure_error_m: NotNegative | None = None
    closure_percent: NotNegative | None = None
    closure_error_axes_m: AxisLengths | None = None
    heading_error_deg: float | Unavailable
    absolute: bool
    odometry_noise: OdometryNoise
    closures: tuple[Closure, ...]
    corrections: Mapping[Way, OrUnavailable[Correction]]
    notes: tuple[str, ...]


class Loop(LoopResult, frozen=True, kw_only=True, eq=False):
    """The result of ``px4fuse loop``: what is written, and the paths.

    Attributes
    ----------
    corrections : mapping from way to CorrectedPath or Unavailable
    nodes : ndarray of int, shape (k,)
        Key frames, as indices of poses.
    distance_m : ndarray, shape (n,)
        Along the path at each pose, by key frames.
    graph : PoseGraph or Unavailable
        With all closures, before it is solved.
    references : tuple of Trajectory
    original_frame : Frame
        That of the trajectory as it was given.
    """

    schema_type = LoopResult
    corrections: Mapping[Way, CorrectedPath | Unavailable]
    nodes: IntArray
    distance_m: Array
    graph: PoseGraph | Unavailable
    references: tuple[Trajectory, ...]
    original_frame: Frame

    __repr__ = one_line_repr

    @property
    def odometry(self) -> CorrectedPath:
        """The part between take-off and landing as it was measured, in a frame with z down."""
        return self.paths["uncorrected"]

    @property
    def paths(self) -> dict[Way, CorrectedPath]:
        """Every path that there is, the odometry first."""
        every = self.corrections.items()
        return {way: path for way, path in every if isinstance(path, CorrectedPath)}

    @property
    def reported_paths(self) -> tuple[CorrectedPath, ...]:
        """The paths worth a row: each once."""
        same: set[Way] = set()
        if all(closure.accepted for closure in self.closures):
            same.add("pose_graph_all")
        if isinstance(self.heading_error_deg, Unavailable):
            same.add("by_distance")
        return tuple(path for way, path in self.paths.items() if way not in same)

    @property
    def best(self) -> CorrectedPath:
        """The gated solution of the pose graph, else by distance, else the odometry."""
        ways: tuple[Way, ...] = ("pose_graph_gated", "by_distance", "uncorrected")
        return next(self.paths[way] for way in ways if way in self.paths)

    @property
    def is_end_assumed(self) -> bool:
        """Whether the misclosure rests on the assumption that it landed where it took off."""
        return isinstance(self.known_end, KnownEnd) and self.known_end.assumed

    def solved_graph(self) -> PoseGraph:
        """The pose graph with all its closures, its poses those of the best solution there is.

        Raises
        ------
        MissingDataError
            There is no graph.
        """
        if isinstance(self.graph, Unavailable):
            raise MissingDataError(f"{self.graph.what}: {self.graph.reason}.")
        gated, plain = self.paths.get("pose_graph_gated"), self.paths.get("pose_graph_all")
        solved = gated or plain
        found = None if solved is None else solved.solution
        return self.graph if found is None else replace(self.graph, poses=found.poses)
