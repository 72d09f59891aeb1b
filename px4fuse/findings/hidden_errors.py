"""Errors that innovations do not show: errors against ground truth, and drift of the source.

Innovations compare a filter with its source, so they do not show an error of the source that the
filter follows. NEES: squared error against ground truth divided by the reported variance (expected
1).
"""

from collections.abc import Mapping

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.arrays import Array
from px4fuse.comparison.causal_replays import (
    ErrorAboveSigma,
    Intervention,
    error_above_reported_sigma,
    find_cause,
)
from px4fuse.comparison.model import AxisComparison, Comparison, ErrorsAgainstTruth, FilterName
from px4fuse.errors import TrajectoryError
from px4fuse.filter.kalman import state_at
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning
from px4fuse.findings.cause_grouping import CAUSE
from px4fuse.findings.cause_text import classify_cause, format_remedy, format_rerun
from px4fuse.findings.model import Finding, Findings, finding, note
from px4fuse.loop.model import Loop
from px4fuse.text import capitalise_first, format_factor, format_number
from px4fuse.trajectory.alignment import fit_alignment

MIN_NEES_ERROR = 16.0  # mean NEES; errors of 4 σ
MAX_SMALL_NIS = 0.5  # mean NIS; innovations are 30 % smaller than expected
MAX_KF_ERROR_RATIO = (
    0.7  # RMSE of KF over EKF2; below, the source causes less than half of the squares
)
MAX_ALIGNED_SHARE = 0.5  # RMSE after over RMSE before alignment; below, misalignment dominates
FILTERS: Mapping[FilterName, str] = {"kf": "KF", "ekf2": "EKF2"}
DRIFT_REMEDY = (
    "Do not take SIGMA_Z or EKF2_EVP_NOISE from these innovations. Correct the drift with a loop "
    "(px4fuse loop LOG), or add a second, absolute source."
)
FRAME_REMEDY = (
    "Rotate and shift the source's frame into that of the ground truth. Do not take noises from "
    "these innovations."
)
EKF2_REMEDY = (
    "KF has a smaller error with the same source. Check EKF2's delay, heading and other aids."
)
SHARED_REMEDY = (
    "Check errors that source and filter share: time offset (px4fuse sync LOG), low-pass filtering "
    "in the source, multipath, anchor geometry and survey, scale."
)
GNSS_REMEDY = (
    "Check errors that receiver and filter share: age of a fix (px4fuse sync LOG), time-correlated "
    "reception errors, EKF2's heading, lever arm of the antenna."
)


def find_hidden_errors(comparison: Comparison) -> list[tuple[FilterName, str, ErrorAboveSigma]]:
    """Find errors larger than the reported σ that innovations do not show.

    Returns filter, axis and numbers of each, the largest mean NEES first.
    """
    errors = [
        (filter_name, name, error)
        for name, result in comparison.axes.items()
        for filter_name, summary in result.filters.items()
        if (error := error_above_reported_sigma(summary))
    ]
    return sorted(errors, key=lambda entry: -entry[2].nees)


def detect(analysis: Analysis) -> Findings:
    """Detect errors that innovations do not show; without such errors, a source that may drift."""
    if hidden := find_hidden_errors(analysis):
        yield make_error_finding(analysis, hidden)
    elif analysis.source.origin.may_drift:
        yield make_drift_finding(analysis)


def make_error_finding(
    analysis: Analysis, hidden: list[tuple[FilterName, str, ErrorAboveSigma]]
) -> Finding:
    """Make the finding of large errors, with numbers of the worst axis of each filter."""
    (worst_filter, main_axis, worst), may_drift = hidden[0], analysis.source.origin.may_drift
    evidence: dict[str, float | str] = {"axis": main_axis, "filter": worst_filter}
    size = "small" if worst.nis_mean < MAX_SMALL_NIS else "consistent"
    sentences = [f"Position errors exceed the reported σ, although the innovations are {size}."]
    causes = dict[FilterName, Intervention | None]()
    for filter_name, label in FILTERS.items():
        for _, axis, error in [entry for entry in hidden if entry[0] == filter_name][:1]:
            evidence |= {
                f"{filter_name}_nis_mean": error.nis_mean,
                f"{filter_name}_nees_position_mean": error.nees,
                f"{filter_name}_position_rmse_m": error.rmse_m,
                f"{filter_name}_sigma_p_m": error.reported_sigma_m,
            }
            causes[filter_name] = cause = find_cause(analysis.causes, filter_name, axis, "nees")
            along = analysis.axes[axis].axis.label
            sentences.append(
                f"{label} along {along}: position RMSE {error.rmse_m:.2f} m, reported σ "
                f"{error.reported_sigma_m:.2g} m (mean NEES {format_factor(error.nees)}, mean NIS "
                f"{format_number(error.nis_mean, 2)}; expected 1)."
            )
            if cause is not None:
                sentences.append(f"{capitalise_first(format_rerun(analysis, cause))}.")
    kf_truth = analysis.axes[main_axis].filters["kf"].truth
    is_kf_better = (
        isinstance(kf_truth, ErrorsAgainstTruth)
        and kf_truth.position_rmse_m < MAX_KF_ERROR_RATIO * worst.rmse_m
    )
    is_ekf2_alone = is_kf_better and all(filter_name == "ekf2" for filter_name, *_ in hidden)
    shared_remedy = GNSS_REMEDY if analysis.source.origin.is_gnss else SHARED_REMEDY
    remedy = DRIFT_REMEDY if may_drift else EKF2_REMEDY if is_ekf2_alone else shared_remedy
    available_causes = filter(None, (causes[worst_filter], *causes.values()))
    evidence |= {CAUSE: classify_cause(analysis, next(available_causes, None))}
    if cause_remedies := {
        format_remedy(analysis, cause): None for cause in causes.values() if cause is not None
    }:
        remedy = " ".join(cause_remedies)
    elif alignment_rmse_m := _rmse_after_alignment(analysis, worst_filter):
        horizontal_rmse_m, aligned_rmse_m = alignment_rmse_m
        evidence |= {
            "position_rmse_horizontal_m": horizontal_rmse_m,
            "position_rmse_aligned_m": aligned_rmse_m,
        }
        is_misaligned = aligned_rmse_m < MAX_ALIGNED_SHARE * horizontal_rmse_m
        if is_misaligned:
            remedy = FRAME_REMEDY
        if is_misaligned or may_drift:
            sentences.append(
                f"After the best shift and rotation {aligned_rmse_m:.2f} m of the horizontal RMSE "
                f"of {horizontal_rmse_m:.2f} m remain: "
                f"{'the frame is misaligned' if is_misaligned else 'the source drifts'}."
            )
    sentences.append(
        "Innovations compare a filter with its source; only ground truth, a loop or a second "
        "source shows the error."
    )
    return finding(
        "error" if worst.nees >= MIN_NEES_ERROR else "warning",
        "error_exceeds_reported_sigma",
        " ".join(sentences),
        remedy,
        evidence,
    )


def _rmse_after_alignment(comparison: Comparison, filter_name: str) -> tuple[float, float] | None:
    """Return the horizontal RMSE (m) against ground truth, before and after alignment in yaw."""
    axes = [comparison.axes[name] for name in ("north", "east") if name in comparison.axes]
    truths = [result.truth for result in axes if isinstance(result.truth, pd.DataFrame)]
    if len(truths) < 2:
        return None
    times = truths[0].index.to_numpy()
    tracks = [
        state_at(result.replay, times)[0]
        if filter_name == "kf"
        else _interpolate_ekf2_position(result, times)
        for result in axes
    ]
    zero_height = np.zeros(len(times))
    estimate = np.column_stack([*tracks, zero_height])
    true_track = np.column_stack([*(truth["position_m"] for truth in truths), zero_height])
    is_known = np.isfinite(estimate).all(axis=1) & np.isfinite(true_track).all(axis=1)
    estimate, true_track = estimate[is_known], true_track[is_known]
    try:
        aligned = fit_alignment(estimate, true_track, "yaw").apply(estimate)
    except TrajectoryError:  # too little motion for a rotation
        return None
    errors = (estimate - true_track, aligned - true_track)
    rmse_m, aligned_rmse_m = (
        float(np.linalg.norm(error)) / len(true_track) ** 0.5 for error in errors
    )
    return rmse_m, aligned_rmse_m


def _interpolate_ekf2_position(result: AxisComparison, times: Array) -> Array:
    """Interpolate EKF2's position (m) along one axis; NaN outside the log."""
    assert isinstance(result.ekf2_state, pd.DataFrame)  # an error of EKF2 was computed from it
    state = result.ekf2_state["position_m"]
    return np.asarray(np.interp(times, state.index, state, left=np.nan, right=np.nan))


def make_drift_finding(analysis: Analysis) -> Finding:
    """Make the finding of a source that may drift, with its short-term noise and closure error."""
    name, tuned, loop = analysis.source.name, analysis.tuning.get(HORIZONTAL), analysis.loop
    evidence: dict[str, float | str] = {"source": name}
    message = (
        f"{name} may drift: the source sends a heading, as odometry (VIO, SLAM) does. Innovations "
        "show how well a filter follows the source, not the position error."
    )
    if isinstance(tuned, AxisTuning) and (noise := tuned.sigma_z.value or tuned.sigma_z.high):
        bound = "at most " if tuned.sigma_z.value is None else ""
        evidence |= {"short_term_noise_m": noise}
        message += f" The short-term noise is {bound}{noise:.2g} m; it does not include the drift."
    if isinstance(loop, Loop) and (gap_m := loop.closure_error_m) is not None:
        evidence |= {"closure_error_m": gap_m, "path_length_m": loop.path_length_m}
        message += f" The loop closure error is {gap_m:.2f} m after {loop.path_length_m:.0f} m."
    action = (
        "Check the error with a loop (px4fuse loop LOG) or with ground truth (ATT_POS_MOCAP). If "
        "the source is motion capture, give --source-kind mocap."
    )
    return note("source_may_drift", message, action, evidence)
