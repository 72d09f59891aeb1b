"""A loop: how far it fails to close, and the path corrected for that in several ways."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from px4fuse.arrays import Array, IntArray
from px4fuse.display import Shown
from px4fuse.errors import MissingDataError
from px4fuse.flight import Unavailable
from px4fuse.loop.model import CorrectedPath, KnownEnd, LoopPart, Way
from px4fuse.trajectory.graph.model import PoseGraph
from px4fuse.trajectory.model import Frame, Trajectory


class Loop(Shown, LoopPart, frozen=True, kw_only=True, eq=False):
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
    given_frame : Frame
        That of the trajectory as it was given.
    """

    written_as = LoopPart
    corrections: Mapping[Way, CorrectedPath | Unavailable]
    nodes: IntArray
    distance_m: Array
    graph: PoseGraph | Unavailable
    references: tuple[Trajectory, ...]
    given_frame: Frame

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
    def reported(self) -> tuple[CorrectedPath, ...]:
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
    def end_assumed(self) -> bool:
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
