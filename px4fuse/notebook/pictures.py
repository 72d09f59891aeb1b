"""Results as pictures, in the colours of the report."""

from collections.abc import Callable
from textwrap import fill
from typing import Any

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import AxisComparison, Comparison
from px4fuse.display import frame
from px4fuse.ekf2.walk import Why
from px4fuse.ekf2.whatif import WhatIf
from px4fuse.filter.clock import ClockOffset
from px4fuse.filter.tuning import AxisTuning
from px4fuse.flight import Flight, Unavailable
from px4fuse.loop.model import Loop
from px4fuse.notebook.tables import EKF2, tracks, variants
from px4fuse.report.clock import draw_curve
from px4fuse.report.evaluation import AXES, draw_ape, draw_path, over_time, views
from px4fuse.report.loop import draw_map
from px4fuse.report.panels import ERROR, INNOVATIONS, POSITION, SIGMA_P, error_reference
from px4fuse.report.style import EKF2 as EKF2_COLOUR
from px4fuse.report.style import EKF2_LINE, OURS_DOTS
from px4fuse.report.style import OURS as OURS_COLOUR
from px4fuse.trajectory.evaluation import Evaluation
from px4fuse.trajectory.model import Trajectory
from px4fuse.trajectory.scores import PairwiseError

# Negative log-likelihood by which a pair of noises may lie above the best one, 95 %: χ²(2)/2
REGION_DROP, SHOWN_DROP = 3.0, 12.0
# Characters in a line of what stands beside an axis
LABEL_WIDTH = 26


def _map(ax: Axes, right: str, up: str) -> Axes:
    ax.set(xlabel=right, ylabel=up, aspect="equal")
    return _beside(ax)


def _beside(ax: Axes) -> Axes:
    """With a legend to the right."""
    ax.legend(loc="upper left", bbox_to_anchor=(1.02, 1.0), fontsize="small")
    return ax


def flight(result: Flight, ax: Axes) -> Axes:
    """Every position from above."""
    for name, samples in tracks(result):
        style: dict[str, Any] = EKF2_LINE if name == EKF2 else {"lw": 0.8}
        if name.startswith("truth"):
            style = {"color": "black", "lw": 0.7}
        elif name != EKF2:
            style = {"ls": "none", "marker": ".", "ms": 3}
        ax.plot(samples["east_m"], samples["north_m"], label=name, **style)
    return _map(ax, "east, m", "north, m")


def axis_comparison(result: AxisComparison, ax: Any) -> Any:
    """Error, innovations and standard deviation over time, as in the report: three axes."""
    first = POSITION if isinstance(error_reference(result), Unavailable) else ERROR
    for axes, panel in zip(ax, (first, INNOVATIONS, SIGMA_P), strict=True):
        panel.draw(axes, result)
        axes.set_ylabel(fill(panel.named(result), LABEL_WIDTH))
    ax[0].set_title(result.axis.name)
    ax[-1].set_xlabel("time (s)")
    return ax


def comparison(result: Comparison | Analysis, ax: Any, axis: str | None = None) -> Any:
    """One axis, by default the aisle where there is one."""
    return axis_comparison(result.main if axis is None else result[axis], ax)


def why(result: Why, ax: Axes) -> Axes:
    """What each step brings our filter nearer to EKF2."""
    table = frame(result).iloc[::-1]
    ax.barh(table["step"], table["position_mean_square_m2"], color=OURS_COLOUR)
    ax.set_xlabel("nearer to EKF2, mean square, m²")
    return ax


def tuning(result: AxisTuning, ax: Axes) -> Axes:
    """Likelihood of both noises, the most likely ones and their 95 % region."""
    grid = result.map
    drop = np.minimum(grid.drop.T, SHOWN_DROP)
    ax.contourf(grid.sigma_a_m_s2, grid.sigma_z_m, drop, levels=12, cmap="Blues_r")
    ax.contour(grid.sigma_a_m_s2, grid.sigma_z_m, drop, levels=[REGION_DROP], colors=OURS_COLOUR)
    best = np.unravel_index(np.argmin(grid.drop), grid.drop.shape)
    ax.plot(grid.sigma_a_m_s2[best[0]], grid.sigma_z_m[best[1]], "+", color=EKF2_COLOUR)
    ax.set(xlabel="SIGMA_A, m/s²", ylabel="SIGMA_Z, m")
    ax.set_title(f"{result.name}: most likely noises, 95 % region")
    return ax


def clock(result: ClockOffset, ax: Axes) -> Axes:
    """Likelihood of each offset, with the 95 % interval, as in the report."""
    draw_curve(ax, result)
    ax.set_ylabel("ln of how much less likely than the best")
    return ax


def loop(result: Loop, ax: Axes) -> Axes:
    """The path and its corrections in the odometry's frame, as in the report."""
    draw_map(ax, result)
    return _beside(ax)


def trajectory(result: Trajectory, ax: Axes) -> Axes:
    """The path from above."""
    right, up, *_ = AXES[result.frame]
    table = frame(result)
    ax.plot(table.iloc[:, right], table.iloc[:, up], lw=0.9, label=result.name)
    return _map(ax, table.columns[right], table.columns[up])


def evaluation(result: Evaluation, ax: Any) -> Any:
    """The path coloured by its error, and the error over time, as in the report: two axes."""
    path, ape = ax
    draw_path(path, result, views(result)[0])
    draw_ape(ape, result, *over_time(result))
    ape.set_ylabel("APE (m)")
    for each in ax:
        each.legend(fontsize="small")
    return ax


def relative_error(result: PairwiseError, ax: Axes) -> Axes:
    """Error of every pair, by the pose that it starts from."""
    ax.plot(result.start, result.translation_error_m, **OURS_DOTS)
    ax.set(xlabel="pose that the pair starts from", ylabel=f"error over {result.delta_words}, m")
    return ax


def what_if(result: WhatIf, ax: Any) -> Any:
    """Mean NIS, and error to the truth or share of rejections, of each EKF2: two axes."""
    labels = {"rejected_share": "share rejected", "nis_mean": "mean NIS (1 is consistent)"}
    known = not isinstance(result.logged.position_rmse_to_truth_m, Unavailable)
    second = "position_rmse_to_truth_m" if known else "rejected_share"
    names, parts = zip(*reversed(variants(result)), strict=True)
    for panel, field in zip(ax, ("nis_mean", second), strict=True):
        panel.barh(names, [getattr(part, field) for part in parts], color=EKF2_COLOUR)
        panel.set_xlabel(labels.get(field, "position, m RMS from the truth"))
    ax[0].axvline(1.0, color=OURS_COLOUR, lw=0.8)
    return ax


# Of each result how it is drawn, and in which figure where no axes are given
ONE: dict[str, Any] = {}
OVER_TIME: dict[str, Any] = {"nrows": 3, "sharex": True, "figsize": (8, 7)}
PICTURES: dict[type, tuple[Callable[..., Any], dict[str, Any]]] = {
    Flight: (flight, ONE),
    AxisComparison: (axis_comparison, OVER_TIME),
    Comparison: (comparison, OVER_TIME),
    Analysis: (comparison, OVER_TIME),
    Why: (why, ONE),
    AxisTuning: (tuning, ONE),
    ClockOffset: (clock, ONE),
    Loop: (loop, ONE),
    Trajectory: (trajectory, ONE),
    Evaluation: (evaluation, {"nrows": 2, "figsize": (7, 8)}),
    PairwiseError: (relative_error, ONE),
    WhatIf: (what_if, {"ncols": 2, "sharey": True, "figsize": (10, 3.5)}),
}


def picture(result: Any, ax: Any = None, **options: Any) -> Any:
    """Draw a result, by default in a figure of its own.

    Raises
    ------
    TypeError
        It has no picture.
    """
    if type(result) not in PICTURES:
        raise TypeError(f"{type(result).__name__} has no picture; its table: .to_frame()")
    drawn, size = PICTURES[type(result)]
    if ax is None:
        ax = plt.subplots(layout="constrained", **size)[1]
    return drawn(result, ax, **options)
