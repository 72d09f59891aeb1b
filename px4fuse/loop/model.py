"""Results of a loop analysis: true final pose, loop closures and corrected paths."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import numpy as np

from px4fuse.core.arrays import Array
from px4fuse.core.record import (
    NOT_IN_JSON,
    Count,
    NonNegativeFloat,
    NotInJson,
    OrUnavailable,
    Record,
    Share,
    Unavailable,
)
from px4fuse.errors import MissingDataError
from px4fuse.finding import Finding
from px4fuse.trajectory.evaluation import Evaluation
from px4fuse.trajectory.graph.model import PoseGraph
from px4fuse.trajectory.graph.solver import Solution
from px4fuse.trajectory.model import Frame, Trajectory, TrajectoryKind, VectorComponents

# Names of the uncorrected path and of the corrected paths. "by_distance" distributes the closure
# errors of position and heading in proportion to the distance flown, "by_distance_plain" only that
# of position
CorrectionName = Literal[
    "uncorrected",
    "by_distance_plain",
    "by_distance",
    "pose_graph_gated",
    "pose_graph_gnc",
]
# Source of the loop closure between take-off and landing
LANDING_CLOSURE_SOURCE = "landing"


class TrueFinalPose(Record, kw_only=True):
    """True final pose of a path relative to its initial pose.

    Attributes
    ----------
    displacement_m : mapping from axis name to float
        Final position minus initial position (m).
    heading_change_deg : float or None
        Final heading minus initial heading (°), clockwise.
    sigma_m, sigma_heading_deg : float
        Standard deviations of final position (per axis) and final heading.
    source : str
        Origin of the final pose, for the user.
    assumed : bool
        True if the landing place is assumed to be the take-off place.
    """

    displacement_m: VectorComponents
    heading_change_deg: float | None = None
    sigma_m: NonNegativeFloat
    sigma_heading_deg: NonNegativeFloat | None = None
    source: str
    assumed: bool

    @property
    def displacement_vector_m(self) -> Array:
        """Final position minus initial position (m), shape (3,)."""
        return np.array(list(self.displacement_m.values()))


class OdometryNoise(Record, omit_defaults=False):
    """Drift of odometry: random walks of position and heading.

    Sources of the defaults: Delmerico and Scaramuzza 2018; Intel's data sheet of the T265.
    """

    # σ (m) of the position drift per axis after a path of 100 m, without heading errors
    position_m: NonNegativeFloat = 1.0
    # σ (°) of the heading drift after a path of 100 m
    heading_deg: NonNegativeFloat = 3.0
    # Drift of position (m/√s) and heading (°/√s) over time
    position_m_per_root_s: NonNegativeFloat = 0.01
    heading_deg_per_root_s: NonNegativeFloat = 0.03
    # Tilt drift divided by heading drift; small, because gravity corrects the tilt
    tilt_share: NonNegativeFloat = 0.1


class LoopClosure(Record, kw_only=True):
    """Loop closure (two times at one place), with the result of its χ² test."""

    # Two times (s) at which the vehicle was at the same place
    time_1_s: float
    time_2_s: float
    # σ (m), per axis, of the assumed displacement between the positions at time_1_s and time_2_s
    sigma_m: NonNegativeFloat
    # "landing": loop closure between take-off and landing; "given": between two times from the user
    source: str
    # Closure error (m) of odometry
    distance_m: NonNegativeFloat
    # χ² test of the loop closure error: squared Mahalanobis distance, degrees of freedom, p value,
    # and acceptance
    d2: NonNegativeFloat
    degrees_of_freedom: Count
    p: Share
    accepted: bool
    # Weight of the loop closure in robust optimisation (GNC), from 0 to 1
    weight_gnc: float | None = None

    def __str__(self) -> str:
        if self.source == LANDING_CLOSURE_SOURCE:
            return "the loop closure between take-off and landing"
        return f"the loop closure between {self.time_1_s:.12g} s and {self.time_2_s:.12g} s"


class PathResult(Record, kw_only=True):
    """Path before or after correction by loop closures, with ATE and RPE per reference."""

    # Maximum and RMS distance (m) between corrected and uncorrected positions
    correction_max_m: NonNegativeFloat
    correction_rms_m: NonNegativeFloat
    # Results of the pose graph optimisation; None without a pose graph
    cost_initial: NonNegativeFloat | None = None
    cost: NonNegativeFloat | None = None
    iterations: Count | None = None
    converged: bool | None = None
    scores: Mapping[str, OrUnavailable[Evaluation]]
    name: NotInJson[str] = NOT_IN_JSON
    trajectory: NotInJson[Trajectory] = NOT_IN_JSON
    solution: NotInJson[Solution | None] = None


class Loop(Record, kw_only=True):
    """Results of a loop analysis: true final pose, loop closure errors and corrected paths.

    Attributes
    ----------
    closure_error_m, closure_percent : float or None
        Loop closure error in m, and in per cent of the path length.
    is_absolute_track : bool
        True if the positions do not drift.
    distance_m : ndarray, shape (n,)
        Path length from the start to each pose.
    graph : PoseGraph or Unavailable
        Pose graph before optimisation.
    original_frame : Frame
        Frame before the conversion to z down.
    orientation_findings : tuple of Finding
        Faults of the logged orientation of the odometry.
    """

    track: str
    kind: TrajectoryKind
    frame: Frame
    start_s: float
    end_s: float
    part_reason: str
    poses: Count
    key_frames: Count
    key_frame_spacing_m: NonNegativeFloat
    path_length_m: NonNegativeFloat
    end_from_start_m: VectorComponents
    heading_change_deg: float | None = None
    true_end: OrUnavailable[TrueFinalPose]
    closure_error_m: NonNegativeFloat | None = None
    closure_percent: NonNegativeFloat | None = None
    closure_error_axes_m: VectorComponents | None = None
    heading_error_deg: float | Unavailable
    is_absolute_track: bool
    odometry_noise: OdometryNoise
    closures: tuple[LoopClosure, ...]
    corrections: Mapping[CorrectionName, OrUnavailable[PathResult]]
    notes: tuple[str, ...]
    distance_m: NotInJson[Array] = NOT_IN_JSON
    graph: NotInJson[PoseGraph | Unavailable] = NOT_IN_JSON
    references: NotInJson[tuple[Trajectory, ...]] = NOT_IN_JSON
    original_frame: NotInJson[Frame] = NOT_IN_JSON
    is_assessed: NotInJson[bool] = False
    orientation_findings: NotInJson[tuple[Finding, ...]] = ()

    @property
    def odometry(self) -> PathResult:
        """Uncorrected path."""
        return self.find_paths()["uncorrected"]

    def find_paths(self) -> dict[CorrectionName, PathResult]:
        """Return the odometry path and all paths corrected by loop closures, by name."""
        return {
            name: path for name, path in self.corrections.items() if isinstance(path, PathResult)
        }

    def select_reported_paths(self) -> tuple[PathResult, ...]:
        """Return the odometry path and the paths corrected by loop closures, without duplicates."""
        paths = self.find_paths()
        if isinstance(self.heading_error_deg, Unavailable):
            # If the heading error is unknown, the path "by_distance" is corrected in position only.
            # It is then the same path as "by_distance_plain"
            paths.pop("by_distance", None)
        return tuple(paths.values())

    def choose_best_path(self) -> PathResult:
        """Return the path with the most reliable correction that is available.

        The order is: pose graph without rejected closures, closure error distributed by distance,
        no correction.
        """
        paths = self.find_paths()
        return paths.get("pose_graph_gated") or paths.get("by_distance") or paths["uncorrected"]

    @property
    def is_landing_place_assumed(self) -> bool:
        """True if the landing place is assumed to be the take-off place."""
        return isinstance(self.true_end, TrueFinalPose) and self.true_end.assumed

    def solved_graph(self) -> PoseGraph:
        """Return the optimised pose graph; without accepted closures, the poses are odometry.

        Raises
        ------
        MissingDataError
            There is no pose graph.
        """
        if isinstance(self.graph, Unavailable):
            raise MissingDataError(f"{self.graph.what}: {self.graph.reason}.")
        corrected_path = self.corrections["pose_graph_gated"]
        if isinstance(corrected_path, Unavailable) or corrected_path.solution is None:
            return self.graph
        return replace(self.graph, poses=corrected_path.solution.poses)
