"""Page of ``px4fuse evaluate``: captions and panels, checked against closed forms and evo."""

from functools import cache
from typing import Any

import numpy as np
import pytest
from conftest import REPOSITORY
from exchange import replace
from matplotlib.axes import Axes
from page_tools import every, words
from scipy.spatial.transform import Rotation
from trajectory_tools import flight, transformed

from px4fuse.core.text import format_metres
from px4fuse.loop.tracks import read_trajectory_source
from px4fuse.report.evaluation import (
    describe_unaligned_rmse,
    draw_pages,
)
from px4fuse.report.page import Page
from px4fuse.report.style import apply_report_style
from px4fuse.trajectory.evaluation import Evaluation, evaluate
from px4fuse.trajectory.model import Trajectory
from px4fuse.trajectory.scores import RpePairDistance

LOOP = REPOSITORY / "sample_logs" / "loop_vio.ulg"
DELTAS = (RpePairDistance(1.0, "m"), RpePairDistance(10.0, "m"))


@cache
def sample() -> Evaluation:
    """Evaluate the odometry of the sample against its SLAM trajectory, which has a gap."""
    odometry, slam = (
        read_trajectory_source(f"{LOOP}:vio"),
        read_trajectory_source(str(LOOP.with_name("loop_slam.tum"))),
    )
    return evaluate(odometry.trajectory, slam.trajectory)


def line(count: int = 2001) -> Trajectory:
    """Make a straight, level flight at 1 m/s with 10 poses per second."""
    along = 0.1 * np.arange(count)
    position = np.column_stack([along, np.zeros(count), np.full(count, -1.5)])
    return Trajectory("line.tum", "truth", along.copy(), position, Rotation.identity(count), "NED")


def evaluate_with_error(error: np.ndarray) -> Evaluation:
    """Evaluate the line with an added error (m), shape (n, 3), without alignment."""
    true = line(len(error))
    estimate = replace(true, name="e.tum", kind="vio", position_m=true.position_m + error)
    return evaluate(estimate, true, alignment="none", rpe_deltas=DELTAS)


def across(values: np.ndarray) -> np.ndarray:
    return np.column_stack([np.zeros_like(values), values, np.zeros_like(values)])


def pages(score: Evaluation) -> list[Page]:
    with apply_report_style():
        return list(draw_pages(score, None))


def panels(score: Evaluation) -> dict[str, Axes]:
    """Return the axes of the page by title."""
    blocks = (block for page in pages(score) for block in every(page.blocks))
    return {block["title"]: block["axes"] for block in blocks if "axes" in block}


def panel(score: Evaluation, title: str) -> Axes:
    """Return the panel whose title begins with `title`."""
    return next(axes for name, axes in panels(score).items() if name.startswith(title))


# -- captions --------------------------------------------------------------------------------------


def test_unaligned_rmse_in_evaluation_report_equals_evo() -> None:
    pytest.importorskip("evo")
    from evo.core import metrics, sync
    from evo.core.trajectory import PoseTrajectory3D

    true = flight()
    estimate = transformed(true, Rotation.from_euler("z", 0.5), np.array([3.0, -1.0, 0.2]))
    score = evaluate(replace(estimate, kind="vio"), true)

    def of_evo(one: Trajectory) -> Any:
        quaternions = one.rotation.as_quat(scalar_first=True)
        return PoseTrajectory3D(one.position_m, quaternions, one.time_s)

    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data(sync.associate_trajectories(of_evo(true), of_evo(estimate)))
    rmse = ape.get_statistic(metrics.StatisticsType.rmse)
    sentence = describe_unaligned_rmse(score)
    assert f"RMSE before alignment {format_metres(rmse)} m" in sentence
    assert f"rotation {np.degrees(0.5):.1f}°" in sentence
    assert "scale" not in sentence
    centre = true.position_m.mean(axis=0) - estimate.position_m.mean(axis=0)
    assert f"translation {format_metres(np.linalg.norm(centre))} m" in sentence
    half = transformed(true, Rotation.identity(), np.zeros(3), 0.5, kind="slam")
    assert ", scale 2." in describe_unaligned_rmse(evaluate(half, true, alignment="sim3"))


# -- panels ----------------------------------------------------------------------------------------


def test_evaluation_report_without_alignment_omits_its_plot() -> None:
    assert not any(
        "alignment" in title for title in panels(evaluate_with_error(across(np.full(2001, 0.3))))
    )
    bare = evaluate(replace(flight(), rotation=None, kind="vio"), flight())
    assert "the estimate has no orientation" in words(*pages(bare))
    assert "RPE over" in words(*pages(bare))
