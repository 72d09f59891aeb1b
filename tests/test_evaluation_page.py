"""The page of ``evaluate``: what they say and draw, against closed forms."""

import re
from functools import cache
from typing import Any

import numpy as np
import pytest
from conftest import REPOSITORY
from exchange import replace
from matplotlib.axes import Axes
from page_tools import every, words
from scipy.spatial.transform import Rotation
from trajectory_tools import flight, moved

from px4fuse.loop.tracks import read_source
from px4fuse.report.evaluation import (
    draw,
    path_views,
    quarter_rmse,
    quarters_sentence,
    rpe_growth_sentence,
    unaligned_sentence,
    worst_moments_sentence,
)
from px4fuse.report.page import Page
from px4fuse.report.style import report_style
from px4fuse.trajectory.evaluation import Evaluation, evaluate
from px4fuse.trajectory.model import Trajectory
from px4fuse.trajectory.scores import Delta

LOOP = REPOSITORY / "sample_logs" / "loop_vio.ulg"
DELTAS = (Delta(1.0, "m"), Delta(10.0, "m"))


@cache
def sample() -> Evaluation:
    """The sample's odometry against its SLAM trajectory, which has a gap."""
    odometry, slam = read_source(f"{LOOP}:vio"), read_source(str(LOOP.with_name("loop_slam.tum")))
    return evaluate(odometry.trajectory, slam.trajectory)


def line(count: int = 2001) -> Trajectory:
    """A straight flight at 1 m/s and 10 Hz, level and without turning."""
    along = 0.1 * np.arange(count)
    position = np.column_stack([along, np.zeros(count), np.full(count, -1.5)])
    return Trajectory("line.tum", "truth", along.copy(), position, Rotation.identity(count), "NED")


def wrong_by(error: np.ndarray) -> Evaluation:
    """An estimate of the line that is wrong by this, shape (n, 3), and not aligned."""
    true = line(len(error))
    estimate = replace(true, name="e.tum", kind="vio", position_m=true.position_m + error)
    return evaluate(estimate, true, alignment="none", rpe_deltas=DELTAS)


def across(values: np.ndarray) -> np.ndarray:
    return np.column_stack([np.zeros_like(values), values, np.zeros_like(values)])


def pages(score: Evaluation) -> list[Page]:
    with report_style():
        return list(draw(score, None))


def panels(score: Evaluation) -> dict[str, Axes]:
    """Axes by their titles."""
    blocks = (block for page in pages(score) for block in every(page.blocks))
    return {block["title"]: block["axes"] for block in blocks if "axes" in block}


def panel(score: Evaluation, title: str) -> Axes:
    """The panel whose title begins so."""
    return next(axes for name, axes in panels(score).items() if name.startswith(title))


# -- what is said ----------------------------------------------------------------------------------


def test_before_alignment_the_error_is_that_of_evo_without_alignment() -> None:
    pytest.importorskip("evo")
    from evo.core import metrics, sync
    from evo.core.trajectory import PoseTrajectory3D

    true = flight()
    estimate = moved(true, Rotation.from_euler("z", 0.5), np.array([3.0, -1.0, 0.2]))
    score = evaluate(replace(estimate, kind="vio"), true)

    def of_evo(one: Trajectory) -> Any:
        turned = one.rotation.as_quat(scalar_first=True)
        return PoseTrajectory3D(one.position_m, turned, one.time_s)

    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data(sync.associate_trajectories(of_evo(true), of_evo(estimate)))
    rmse = ape.get_statistic(metrics.StatisticsType.rmse)
    words = unaligned_sentence(score)
    assert f"{rmse:.3f} m apart (RMSE)" in words
    assert f"Turned by {np.degrees(0.5):.1f}°" in words
    assert "scaled" not in words
    centre = true.position_m.mean(axis=0) - estimate.position_m.mean(axis=0)
    assert f"moved {np.linalg.norm(centre):.3f} m" in words
    half = moved(true, Rotation.identity(), np.zeros(3), 0.5, kind="slam")
    assert "scaled 2 times" in unaligned_sentence(evaluate(half, true, alignment="sim3"))


def test_an_error_that_grows_with_distance_has_the_quarters_of_a_ramp() -> None:
    score = wrong_by(across(np.linspace(0.0, 4.0, 2001)))
    ends = np.arange(5.0)  # ∫ x² dx over a quarter
    expected = np.sqrt((ends[1:] ** 3 - ends[:-1] ** 3) / 3.0)
    np.testing.assert_allclose(quarter_rmse(score), expected, rtol=0.01)
    assert ", ".join(f"{q:.3f}" for q in quarter_rmse(score)) in quarters_sentence(score)


@pytest.mark.parametrize(("error", "share"), [
    (np.full(2000, 0.3), "10%"), (np.arange(2000) // 100 == 7, "100%"), (np.zeros(2000), "0%"),
], ids=["even", "a peak", "none"])  # fmt: skip
def test_whether_a_few_moments_decide_is_the_share_of_the_worst_tenth(error, share) -> None:
    words = worst_moments_sentence(wrong_by(across(error.astype(np.float64))))
    assert f"makes {share} of the squared error" in words


@pytest.mark.parametrize(("kind", "times"), [("noise", 1.0), ("walk", 10**0.5), ("scale", 10.0)])
def test_the_growth_of_the_rpe_tells_noise_from_drift(kind: str, times: float) -> None:
    rng = np.random.default_rng(3)
    n = 20_001
    error = {
        "noise": rng.normal(0.0, 0.1, (n, 3)),
        "walk": np.cumsum(rng.normal(0.0, 0.01, (n, 3)), axis=0),
        "scale": 0.05 * line(n).position_m,
    }[kind]
    words = rpe_growth_sentence(wrong_by(error).rpe)
    found = re.search(r"From 1 to 10 m, 10 times, the RMSE is ([\d.]+) times as large", words)
    assert float(found[1]) == pytest.approx(times, rel=0.1)
    assert "1 is noise of each pose, 3.2 a random walk, 10 a wrong scale" in words
    assert "A second distance" in rpe_growth_sentence(wrong_by(error).rpe[:1])


# -- what is drawn ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("frame", "axes"), [
    ("NED", (1, 0)), ("FRD", (1, 0)), ("ENU", (0, 1)), ("camera", (0, 2)), ("unknown", (0, 1)),
])  # fmt: skip
def test_a_flat_path_is_seen_from_above_and_another_from_the_side_too(frame, axes) -> None:
    spatial = replace(flight(), frame=frame)
    vertical = 3 - sum(axes)
    level = spatial.position_m.copy()
    level[:, vertical] *= 0.01
    for position, count in ((spatial.position_m, 2), (level, 1)):
        one = replace(spatial, position_m=position)
        seen = path_views(evaluate(one, one, alignment="none"))
        assert (seen[0].across, seen[0].up) == axes
        assert len(seen) == count
    side = path_views(evaluate(spatial, spatial, alignment="none"))[1]
    assert side.up == vertical
    assert side.is_down == (frame in ("NED", "FRD", "camera"))


def test_what_is_not_done_has_no_panel() -> None:
    assert not any("alignment" in title for title in panels(wrong_by(across(np.full(2001, 0.3)))))
    bare = evaluate(replace(flight(), rotation=None, kind="vio"), flight())
    assert "the estimate has no orientation" in words(*pages(bare))
    assert not any("RPE" in title for title in panels(bare))
