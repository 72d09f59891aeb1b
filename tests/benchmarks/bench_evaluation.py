"""Speed of trajectory files and scores; prints times and asserts nothing.

A file of 20,000 poses, then reading, association, scores with intervals, and the time offset, on a
ten-minute flight: 30 Hz of an estimate against 200 Hz of a reference.

    python tests/benchmarks/bench_evaluation.py
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

from measured import seconds

sys.path.insert(0, str(Path(__file__).parents[1]))

RUNS = 3


def main() -> None:
    import numpy as np
    from trajectory_tools import flight

    from px4fuse.readers.trajectory import format_tum, read_trajectory
    from px4fuse.trajectory.association import associate
    from px4fuse.trajectory.evaluation import evaluate
    from px4fuse.trajectory.scores import estimate_rmse_interval
    from px4fuse.trajectory.time_offset import estimate_time_offset

    reference = flight(600.0, 200.0)
    estimate = flight(600.0, 30.0, "vio")
    noise = np.random.default_rng(1).normal(0.0, 0.05, estimate.position_m.shape)
    estimate = replace(estimate, position_m=estimate.position_m + noise)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "track.tum"
        path.write_text(format_tum(reference[:20_000]))
        size = path.stat().st_size / 1e6
        took = seconds(lambda: read_trajectory(path), RUNS)
        print(f"read 20,000 poses, {size:.1f} MB       {took:7.3f} s")
    x, y, _ = associate(estimate, reference)
    error = np.linalg.norm(x.position_m - y.position_m, axis=1)
    for words, work in (
        ("write 120,000 poses", lambda: format_tum(reference)),
        ("associate 18,000 with 120,000", lambda: associate(estimate, reference)),
        ("interval of 18,000 errors", lambda: estimate_rmse_interval(error, "ATE")),
        ("all scores", lambda: evaluate(estimate, reference)),
        ("the time offset", lambda: estimate_time_offset(estimate, reference)),
    ):
        print(f"{words:35} {seconds(work, RUNS):7.3f} s")


if __name__ == "__main__":
    main()
