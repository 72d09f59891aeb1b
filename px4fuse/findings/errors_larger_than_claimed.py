"""Innovations that a filter is content with, and errors against the truth that it is not.

Innovations judge a filter against its source, truth judges both: an error that filter and source
share shows in no innovation. Normalised by the variance that the filter states, the squared error
is the NEES (1 is consistent).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.arrays import Array
from px4fuse.comparison.model import AgainstTruth, AxisComparison, Comparison
from px4fuse.errors import TrajectoryError
from px4fuse.filter.consistency import Consistency
from px4fuse.filter.kalman import state_at
from px4fuse.findings.model import Detector, Finding, Found, Threshold
from px4fuse.flight import Unavailable
from px4fuse.plain import factor_words, number_words
from px4fuse.trajectory.alignment import fit

NEES_LARGE = Threshold(4.0, "times", "errors twice as large as σ; clean flights stay below 3")
NEES_ERROR = Threshold(16.0, "times", "errors four times as large as σ")
CONTENT = Threshold(1.5, "mean NIS", "above, the innovations themselves say so (variance.py)")
SMALL = Threshold(0.5, "mean NIS", "innovations are 30 % smaller than claimed")
FRAME_SHARE = Threshold(0.5, "of the error", "what is left is less than what turning took away")
FILTERS = {"kf": "our filter", "ekf2": "EKF2"}
REMEDIES = {
    "drift": "Take no noise from these innovations: correct the drift at a loop (px4fuse loop "
    "LOG), or give the filter a second, absolute source.",
    "frame": "Turn and shift the source's frame into that of the truth before you judge a filter "
    "by it, and take no noise from these innovations.",
    "ekf2": "Our filter errs less with the same source, so the error is EKF2's own: look at "
    "EKF2_EV_DELAY, at its heading, and at what else it fuses.",
    "shared": "Look for an error that source and filter share: the clock (px4fuse sync LOG), a "
    "source that smooths its positions, its scale, the survey of the anchors.",
}


@dataclass(frozen=True)
class Hidden:
    """One filter on one axis whose innovations hide its error."""

    owner: str
    result: AxisComparison
    statement: Consistency
    truth: AgainstTruth
    nees: float


def hidden_errors(comparison: Comparison) -> list[Hidden]:
    """Where the error is larger than claimed and no innovation says so, the worst first."""
    found = []
    for result in comparison.axes.values():
        for owner, statement in result.filters.items():
            truth = statement.truth
            if isinstance(statement, Unavailable) or isinstance(truth, Unavailable):
                continue
            nees = truth.nees_position_mean
            if nees is None or nees < NEES_LARGE.value:
                continue
            if statement.nis_mean < CONTENT.value:
                found.append(Hidden(owner, result, statement, truth, nees))
    return sorted(found, key=lambda hidden: -hidden.nees)


def _detect(analysis: Analysis) -> Found:
    comparison = analysis
    hidden = hidden_errors(comparison)
    if not hidden:
        return
    worst = hidden[0]
    drifts = comparison.source.origin.may_drift
    evidence: dict[str, float | str] = {"axis": worst.result.axis.name, "filter": worst.owner}
    said = []
    for owner, name in FILTERS.items():
        one = next((h for h in hidden if h.owner == owner), None)
        if one is None:
            continue
        claimed = one.truth.position_rmse_m / np.sqrt(one.nees)
        evidence |= {
            f"{owner}_nis_mean": one.statement.nis_mean,
            f"{owner}_nees_position_mean": one.nees,
            f"{owner}_position_rmse_m": one.truth.position_rmse_m,
            f"{owner}_sigma_p_m": claimed,
        }
        said.append(
            f"{name} claims σ {claimed:.2g} m along {one.result.axis.name} and errs by "
            f"{one.truth.position_rmse_m:.2f} m RMS (mean NEES {factor_words(one.nees)}, mean NIS "
            f"{number_words(one.statement.nis_mean, 2)}; 1 is consistent)"
        )
    small = worst.statement.nis_mean < SMALL.value
    words = "; ".join(said) + "."
    frame = _after_turning(comparison, worst.owner)
    alone = all(one.owner == "ekf2" for one in hidden)
    remedy = REMEDIES["drift" if drifts else "ekf2" if alone else "shared"]
    if frame is not None:
        before, left = frame
        evidence |= {"position_rmse_horizontal_m": before, "position_rmse_aligned_m": left}
        remain = f"of {before:.2f} m horizontally {left:.2f} m remain after the best shift and turn"
        if left < FRAME_SHARE.value * before:
            words += f" Most of it is how the source's frame lies: {remain}."
            remedy = REMEDIES["frame"]
        elif drifts:
            words += f" The source drifts, and the filter follows it: {remain}."
    yield Finding(
        "errors_larger_than_claimed",
        "error" if worst.nees >= NEES_ERROR.value else "warning",
        f"Innovations {'small, errors large' if small else 'consistent, errors not'}: {words} "
        "Innovations judge a filter against its source, truth judges both.",
        remedy,
        evidence,
    )


def _after_turning(comparison: Comparison, owner: str) -> tuple[float, float] | None:
    """Horizontal RMSE (m) to the truth, and what of it the best shift and turn leave."""
    axes = comparison.axes
    if not {"north", "east"} <= axes.keys():
        return None
    north, east = axes["north"], axes["east"]
    if not isinstance(north.truth, pd.DataFrame) or not isinstance(east.truth, pd.DataFrame):
        return None
    times = north.truth.index.to_numpy()
    columns = []
    for result in (north, east):
        if owner == "kf":
            columns.append(state_at(result.replay, times)[0])
        elif isinstance(result.ekf2_state, pd.DataFrame):
            state = result.ekf2_state["position_m"]
            columns.append(np.interp(times, state.index, state, left=np.nan, right=np.nan))
    if len(columns) < 2:
        return None
    level = np.zeros(len(times))
    estimate = np.column_stack([*columns, level])
    true = np.column_stack([north.truth["position_m"], east.truth["position_m"], level])
    known = np.isfinite(estimate).all(axis=1) & np.isfinite(true).all(axis=1)
    estimate, true = estimate[known], true[known]
    try:
        aligned = fit(estimate, true, "yaw").apply(estimate)
    except TrajectoryError:  # too little motion to turn by
        return None
    return _rms(estimate - true), _rms(aligned - true)


def _rms(errors: Array) -> float:
    """Root mean square of the lengths of vectors, shape (n, 3)."""
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


DETECTOR = Detector(
    _detect,
    names={"errors_larger_than_claimed": "errors larger than the filter claims"},
)
