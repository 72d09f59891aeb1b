"""Speed of pose graph optimisation compared with GTSAM, with equal start and tolerances.

Both run in turn, so the ratio does not depend on the load of the computer; both include their
ordering. Then the time as a function of the number of poses. Prints times and asserts nothing.
Needs GTSAM and ../shared/pose_graphs.

    OMP_NUM_THREADS=1 python tests/benchmarks/bench_pose_graph.py [RUNS] [FILE ...]
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from measured import seconds

sys.path.insert(0, str(Path(__file__).parents[1]))

FOLDER = Path(__file__).parents[3] / "shared" / "pose_graphs"
NAMED = (
    "SE-Sync_manhattan",
    "SE-Sync_sphere2500",
    "SE-Sync_parking-garage",
    "SE-Sync_city10000",
    "SE-Sync_torus3D",
)
SIZES = (100, 300, 1000, 3000, 10_000)


def chain(poses: int):
    """Make laps of 50 poses in space; every tenth pose has a closure to the previous lap."""
    from px4fuse.trajectory.graph import lie
    from px4fuse.trajectory.graph.model import PoseGraph, set_poses_from_odometry

    rng = np.random.default_rng(0)
    step = np.array([1.0, 0.0, 0.02, 0.0, 0.01, 2.0 * np.pi / 50])
    truth = lie.accumulate_poses(lie.exp(np.tile(step, (poses - 1, 1))))
    first, last = np.arange(poses - 1), np.arange(0, poses - 50, 10)
    i, j = np.concatenate([first, last]), np.concatenate([first + 1, last + 50])
    spread = np.repeat([0.02, 0.002], 3)
    noise = lie.exp(rng.normal(size=(len(i), 6)) * spread)
    measured = lie.compose(lie.relative_pose(truth[i], truth[j]), noise)
    information = np.tile(np.diag(spread**-2.0), (len(i), 1, 1))
    return set_poses_from_odometry(
        PoseGraph(3, np.arange(poses), truth, i, j, measured, information)
    )


def main() -> None:
    import gtsam
    from trajectory_tools import gtsam_optimiser

    from px4fuse.readers.g2o import read_g2o
    from px4fuse.trajectory.graph.model import cost
    from px4fuse.trajectory.graph.solver import solve

    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 5
    for name in sys.argv[2:] or NAMED:
        file = FOLDER / f"{name}.g2o"
        reading = seconds(lambda file=file: read_g2o(file))
        graph = read_g2o(file)
        ours, theirs = np.empty((2, runs))
        for run in range(runs):
            ours[run] = seconds(lambda graph=graph: solve(graph))
            factors, optimiser = gtsam_optimiser(gtsam, graph)
            theirs[run] = seconds(optimiser.optimize)
        found, other = solve(graph), factors.error(optimiser.values())
        print(
            f"{name}: {len(graph)} poses, {len(graph.first_nodes)} edges, "
            f"{graph.initial_pose_origin}, read in "
            f"{reading:.2f} s; {np.median(ours / theirs):.2f} x GTSAM "
            f"({np.median(ours):.3f} s / {np.median(theirs):.3f} s, {runs} pairs); "
            f"steps {found.iterations} / {optimiser.iterations()}; cost {cost(graph):.6g} -> "
            f"{found.cost:.9g}, {found.cost / other - 1.0:+.0e} of GTSAM's"
        )
    took = []
    for poses in SIZES:
        graph = chain(poses)
        took.append(min(seconds(lambda graph=graph: solve(graph)) for _ in range(3)))
        print(f"laps of {poses} poses: {took[-1]:.3f} s, {solve(graph).iterations} steps")
    whole = np.log(took[-1] / took[0]) / np.log(SIZES[-1] / SIZES[0])
    end = np.log(took[-1] / took[-3]) / np.log(SIZES[-1] / SIZES[-3])
    print(f"time grows as n^{whole:.2f} from 100 to 10,000, as n^{end:.2f} from 1,000 (aim 1.3)")


if __name__ == "__main__":
    main()
