"""What innovations cannot show: errors against the truth, and the drift of a source.

Innovations judge a filter against its source, truth judges both: an error that filter and source
share shows in no innovation. Normalised by the variance that the filter states, the squared error
is the NEES (1 is consistent).
"""

from collections.abc import Mapping

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.arrays import Array
from px4fuse.comparison.interventions import (
    ErrorBeyondSigma,
    Intervention,
    cause_of,
    error_beyond_reported_sigma,
)
from px4fuse.comparison.model import AgainstTruth, AxisComparison, Comparison, FilterName
from px4fuse.errors import TrajectoryError
from px4fuse.filter.kalman import state_at
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning
from px4fuse.findings.causes import CAUSE
from px4fuse.findings.model import WORDS, Finding, Found, finding, info
from px4fuse.findings.since import format_cause, format_remedy, kind_of
from px4fuse.loop.model import Loop
from px4fuse.plain import format_factor, format_number
from px4fuse.trajectory.alignment import fit_alignment

NEES_ERROR = 16.0  # errors four times as large as σ
MAX_SMALL_NIS = 0.5  # innovations are 30 % smaller than claimed
MAX_KF_ERROR_RATIO = 0.7  # times: of EKF2's mean square error half is its own
FRAME_SHARE = 0.5  # of the error: what is left is less than what turning took away
FILTERS: Mapping[FilterName, str] = {"kf": "our filter", "ekf2": "EKF2"}
REMEDIES: Mapping[str, str] = WORDS["errors_larger_than_claimed"]["remedy"]


def hidden_errors(comparison: Comparison) -> list[tuple[FilterName, str, ErrorBeyondSigma]]:
    """Where the error is larger than claimed and no innovation says so, by filter and axis.

    The worst comes first.
    """
    found = [
        (owner, name, hidden)
        for name, result in comparison.axes.items()
        for owner, statement in result.filters.items()
        if (hidden := error_beyond_reported_sigma(statement))
    ]
    return sorted(found, key=lambda each: -each[2].nees)


def detect(analysis: Analysis) -> Found:
    """Errors that innovations hide, or a drift that nothing shows."""
    if hidden := hidden_errors(analysis):
        yield error_exceeds_sigma(analysis, hidden)
    elif analysis.source.origin.may_drift:
        yield drift(analysis)


def error_exceeds_sigma(
    analysis: Analysis, hidden: list[tuple[FilterName, str, ErrorBeyondSigma]]
) -> Finding:
    """Told of each filter's worst axis."""
    (worst_filter, main, worst), drifts = hidden[0], analysis.source.origin.may_drift
    evidence: dict[str, float | str] = {"axis": main, "filter": worst_filter}
    sentences, causes = [], dict[FilterName, Intervention | None]()
    for owner, name in FILTERS.items():
        for _, axis, one in [each for each in hidden if each[0] == owner][:1]:
            evidence |= {
                f"{owner}_nis_mean": one.nis_mean,
                f"{owner}_nees_position_mean": one.nees,
                f"{owner}_position_rmse_m": one.rmse_m,
                f"{owner}_sigma_p_m": one.reported_sigma_m,
            }
            causes[owner] = cause_of(analysis.causes, owner, axis, "nees")
            sentences.append(
                f"{name} claims σ {one.reported_sigma_m:.2g} m along {axis} and errs by "
                f"{one.rmse_m:.2f} m RMS (mean NEES {format_factor(one.nees)}, mean NIS "
                f"{format_number(one.nis_mean, 2)}; 1 is consistent)"
                f"{format_cause(analysis, causes[owner])}"
            )
    words = "; ".join(sentences) + "."
    kf_truth = analysis.axes[main].filters["kf"].truth
    is_kf_better = (
        isinstance(kf_truth, AgainstTruth)
        and kf_truth.position_rmse_m < MAX_KF_ERROR_RATIO * worst.rmse_m
    )
    is_ekf2_alone = is_kf_better and all(owner == "ekf2" for owner, *_ in hidden)
    shared = "gnss" if analysis.source.origin.is_gnss else "shared"
    remedy = "drift" if drifts else "ekf2" if is_ekf2_alone else shared
    known_causes = filter(None, (causes[worst_filter], *causes.values()))
    evidence |= {CAUSE: kind_of(analysis, next(known_causes, None))}
    if cures := {
        format_remedy(analysis, cause): None for cause in causes.values() if cause is not None
    }:
        remedy = "cured"
    elif frame := _rmse_after_alignment(analysis, worst_filter):
        horizontal_rmse_m, aligned_rmse_m = frame
        evidence |= {
            "position_rmse_horizontal_m": horizontal_rmse_m,
            "position_rmse_aligned_m": aligned_rmse_m,
        }
        remainder_text = f"of {horizontal_rmse_m:.2f} m horizontally {aligned_rmse_m:.2f} m remain after the best shift and turn"
        if aligned_rmse_m < FRAME_SHARE * horizontal_rmse_m:
            words += f" Most of it is how the source's frame lies: {remainder_text}."
            remedy = "frame"
        elif drifts:
            words += f" The source drifts, and the filter follows it: {remainder_text}."
    return finding(
        "error" if worst.nees >= NEES_ERROR else "warning",
        "errors_larger_than_claimed",
        evidence,
        small=worst.nis_mean < MAX_SMALL_NIS,
        words=words,
        remedy=remedy,
        cures=" ".join(cures),
    )


def _rmse_after_alignment(comparison: Comparison, owner: str) -> tuple[float, float] | None:
    """Horizontal RMSE (m) to the truth, and what of it the best shift and turn leave."""
    axes = [comparison.axes[name] for name in ("north", "east") if name in comparison.axes]
    truths = [result.truth for result in axes if isinstance(result.truth, pd.DataFrame)]
    if len(truths) < 2:
        return None
    times = truths[0].index.to_numpy()
    tracks = [
        state_at(result.replay, times)[0] if owner == "kf" else _published(result, times)
        for result in axes
    ]
    level = np.zeros(len(times))
    estimate = np.column_stack([*tracks, level])
    true = np.column_stack([*(truth["position_m"] for truth in truths), level])
    known = np.isfinite(estimate).all(axis=1) & np.isfinite(true).all(axis=1)
    estimate, true = estimate[known], true[known]
    try:
        aligned = fit_alignment(estimate, true, "yaw").apply(estimate)
    except TrajectoryError:  # too little motion to turn by
        return None
    errors = (estimate - true, aligned - true)
    rmse_m, aligned_rmse_m = (float(np.linalg.norm(error)) / len(true) ** 0.5 for error in errors)
    return rmse_m, aligned_rmse_m


def _published(result: AxisComparison, times: Array) -> Array:
    """Position (m) of EKF2 along one axis; NaN where it is not known."""
    assert isinstance(result.ekf2_state, pd.DataFrame)  # else no error of EKF2 is hidden
    state = result.ekf2_state["position_m"]
    return np.asarray(np.interp(times, state.index, state, left=np.nan, right=np.nan))


def drift(analysis: Analysis) -> Finding:
    """Neither truth nor anything else judges it: what it scatters by, and what its loop shows."""
    name, tuned, loop = analysis.source.name, analysis.tuning.get(HORIZONTAL), analysis.loop
    evidence: dict[str, float | str] = {"source": name}
    shown_text = ""
    if isinstance(tuned, AxisTuning) and (noise := tuned.sigma_z.value or tuned.sigma_z.high):
        bound = "at most " if tuned.sigma_z.value is None else ""
        evidence |= {"short_term_noise_m": noise}
        shown_text = (
            f" Over a second or so it scatters by {bound}{noise:.2g} m, which is not its error."
        )
    if isinstance(loop, Loop) and (gap_m := loop.closure_error_m) is not None:
        evidence |= {"closure_error_m": gap_m, "path_length_m": loop.path_length_m}
        shown_text += f" Its loop misses by {gap_m:.2f} m after {loop.path_length_m:.0f} m."
    return info("source_may_drift", evidence, shown=shown_text)
