"""Results as pictures, in the colours of the report."""

from __future__ import annotations

from textwrap import fill
from typing import Any

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes

from px4fuse.analysis import Analysis
from px4fuse.arrays import Array
from px4fuse.comparison.model import AxisComparison, Comparison
from px4fuse.display import frame
from px4fuse.ekf2.walk import Why
from px4fuse.ekf2.whatif import WhatIf
from px4fuse.filter.clock import ClockOffset
from px4fuse.filter.tuning import AxisTuning
from px4fuse.flight import Flight, Unavailable
from px4fuse.loop.loop import Loop
from px4fuse.notebook.tables import EKF2, tracks, variants
from px4fuse.report.panels import ERROR, INNOVATIONS, POSITION, SIGMA_P, error_reference
from px4fuse.report.style import EKF2 as EKF2_COLOUR
from px4fuse.report.style import EKF2_LINE, OURS_BAND, OURS_DOTS, OURS_LINE
from px4fuse.report.style import OURS as OURS_COLOUR
from px4fuse.trajectory.evaluation import Evaluation
from px4fuse.trajectory.model import Trajectory
from px4fuse.trajectory.scores import PairwiseError

# Negative log-likelihood by which a pair of noises may lie above the best one, 95 %: χ²(2)/2
REGION_DROP, SHOWN_DROP = 3.0, 12.0
# Characters in a line of what stands beside an axis
LABEL_WIDTH = 26
# Of a frame, which coordinates a map shows to the right and upwards
ACROSS = {"NED": (1, 0), "FRD": (1, 0), "ENU": (0, 1), "camera": (0, 2), "unknown": (0, 1)}


def _one(ax: Axes | None) -> Axes:
    return plt.subplots(layout="constrained")[1] if ax is None else ax


def _map(ax: Axes, right: str, up: str) -> Axes:
    ax.set(xlabel=right, ylabel=up, aspect="equal")
    ax.legend(loc="upper left", bbox_to_anchor=(1.02, 1.0), fontsize="small")
    return ax


def flight(result: Flight, ax: Axes | None = None) -> Axes:
    """Every position from above."""
    ax = _one(ax)
    for name, samples in tracks(result):
        style: dict[str, Any] = EKF2_LINE if name == EKF2 else {"lw": 0.8}
        if name.startswith("truth"):
            style = {"color": "black", "lw": 0.7}
        elif name != EKF2:
            style = {"ls": "none", "marker": ".", "ms": 3}
        ax.plot(samples["east_m"], samples["north_m"], label=name, **style)
    return _map(ax, "east, m", "north, m")


def axis_comparison(result: AxisComparison, ax: Any = None) -> Any:
    """Error, innovations and standard deviation over time, as in the report: three axes."""
    if ax is None:
        _, ax = plt.subplots(3, 1, sharex=True, figsize=(8, 7), layout="constrained")
    first = POSITION if isinstance(error_reference(result), Unavailable) else ERROR
    for axes, panel in zip(ax, (first, INNOVATIONS, SIGMA_P), strict=True):
        panel.draw(axes, result)
        axes.set_ylabel(fill(panel.named(result), LABEL_WIDTH))
    ax[0].set_title(result.axis.name)
    ax[-1].set_xlabel("time (s)")
    return ax


def comparison(result: Comparison | Analysis, axis: str | None = None, ax: Any = None) -> Any:
    """One axis, by default the aisle where there is one."""
    return axis_comparison(result.main if axis is None else result[axis], ax)


def why(result: Why, ax: Axes | None = None) -> Axes:
    """What each step brings our filter nearer to EKF2."""
    ax = _one(ax)
    table = frame(result).iloc[::-1]
    ax.barh(table["step"], table["position_mean_square_m2"], color=OURS_COLOUR)
    ax.set_xlabel("nearer to EKF2, mean square, m²")
    return ax


def tuning(result: AxisTuning, ax: Axes | None = None) -> Axes:
    """Likelihood of both noises, the most likely ones and their 95 % region."""
    ax = _one(ax)
    grid = result.map
    drop = np.minimum(grid.drop.T, SHOWN_DROP)
    ax.contourf(grid.sigma_a_m_s2, grid.sigma_z_m, drop, levels=12, cmap="Blues_r")
    ax.contour(grid.sigma_a_m_s2, grid.sigma_z_m, drop, levels=[REGION_DROP], colors=OURS_COLOUR)
    best = np.unravel_index(np.argmin(grid.drop), grid.drop.shape)
    ax.plot(grid.sigma_a_m_s2[best[0]], grid.sigma_z_m[best[1]], "+", color=EKF2_COLOUR)
    ax.set(xlabel="SIGMA_A, m/s²", ylabel="SIGMA_Z, m")
    ax.set_title(f"{result.name}: most likely noises, 95 % region")
    return ax


def clock(result: ClockOffset, ax: Axes | None = None) -> Axes:
    """Log-likelihood of each offset, with the 95 % interval."""
    ax = _one(ax)
    ax.plot(result.curve_s, -result.curve_drop, **OURS_LINE)
    ax.axvspan(*result.interval_s, color=OURS_BAND)
    ax.set(xlabel="added to the source's stamps, s", ylabel="log-likelihood below its maximum")
    return ax


def loop(result: Loop, ax: Axes | None = None) -> Axes:
    """The path and its corrections, in the frame of the reference where there is one."""
    ax = _one(ax)
    reference = result.references[0] if result.references else None
    right, up = ACROSS["NED"]
    for path in result.reported:
        position = path.trajectory.position_m
        score = None if reference is None else path.scores.get(reference.name)
        if isinstance(score, Evaluation):
            position = score.estimate_m
        ax.plot(position[:, right], position[:, up], lw=0.9, label=path.name)
    uncorrected = result.odometry.scores.get(reference.name) if reference is not None else None
    if isinstance(uncorrected, Evaluation):
        truth = uncorrected.reference_m
        ax.plot(truth[:, right], truth[:, up], "k:", lw=0.8, label=uncorrected.reference.name)
    return _map(ax, "right, m", "ahead, m")


def trajectory(result: Trajectory, ax: Axes | None = None) -> Axes:
    """The path from above."""
    ax = _one(ax)
    right, up = ACROSS[result.frame]
    table = frame(result)
    ax.plot(table.iloc[:, right], table.iloc[:, up], lw=0.9, label=result.name)
    return _map(ax, table.columns[right], table.columns[up])


def evaluation(result: Evaluation, ax: Any = None) -> Any:
    """The path coloured by its error, and the error over time: two axes."""
    if ax is None:
        _, ax = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    right, up = ACROSS[result.reference.frame]
    left, over_time = ax
    reference: Array = result.reference_m
    left.plot(reference[:, right], reference[:, up], "k:", lw=0.8, label=result.reference.name)
    dots = left.scatter(
        result.estimate_m[:, right], result.estimate_m[:, up], 4, result.position_error_m,
        cmap="viridis", label=result.estimate.name,
    )  # fmt: skip
    left.figure.colorbar(dots, ax=left, label="error, m")
    _map(left, "right, m", "ahead, m")
    rmse = result.ate.translation_m.rmse
    over_time.plot(result.time_s, result.position_error_m, **OURS_LINE)
    over_time.axhline(rmse, color=EKF2_COLOUR, label=f"ATE {rmse:.3g} m")
    over_time.set(xlabel="time, s", ylabel="error, m", ylim=(0.0, None))
    over_time.legend()
    return ax


def relative_error(result: PairwiseError, ax: Axes | None = None) -> Axes:
    """Error of every pair, by the pose that it starts from."""
    ax = _one(ax)
    ax.plot(result.start, result.translation_error_m, **OURS_DOTS)
    ax.set(xlabel="pose that the pair starts from", ylabel=f"error over {result.delta_words}, m")
    return ax


def what_if(result: WhatIf, ax: Any = None) -> Any:
    """Mean NIS, and error to the truth or share of rejections, of each EKF2: two axes."""
    if ax is None:
        _, ax = plt.subplots(1, 2, sharey=True, figsize=(10, 3.5), layout="constrained")
    labels = {"rejected_share": "share rejected", "nis_mean": "mean NIS (1 is consistent)"}
    known = not isinstance(result.logged.position_rmse_to_truth_m, Unavailable)
    second = "position_rmse_to_truth_m" if known else "rejected_share"
    names, parts = zip(*reversed(variants(result)), strict=True)
    for panel, field in zip(ax, ("nis_mean", second), strict=True):
        panel.barh(names, [getattr(part, field) for part in parts], color=EKF2_COLOUR)
        panel.set_xlabel(labels.get(field, "position, m RMS from the truth"))
    ax[0].axvline(1.0, color=OURS_COLOUR, lw=0.8)
    return ax


PICTURES = {
    Flight: flight,
    AxisComparison: axis_comparison,
    Comparison: comparison,
    Analysis: comparison,
    Why: why,
    AxisTuning: tuning,
    ClockOffset: clock,
    Loop: loop,
    Trajectory: trajectory,
    Evaluation: evaluation,
    PairwiseError: relative_error,
    WhatIf: what_if,
}
