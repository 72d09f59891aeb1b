"""Detect position errors that innovations do not show, and drift of the position source.

Innovations compare a filter with its position source. If the filter follows an error of the source,
the innovations stay small. Only ground truth or a loop closure shows such an error.
"""

from collections.abc import Mapping

import numpy as np

from px4fuse.analysis import Analysis
from px4fuse.comparison.comparison import compute_position_errors
from px4fuse.comparison.model import (
    FILTER_NAMES,
    Comparison,
    ErrorsAgainstTruth,
    FilterName,
    select_north_and_east,
)
from px4fuse.comparison.rerun_effects import Rerun, find_cause_rerun
from px4fuse.comparison.reruns import ErrorAboveSigma, find_error_above_sigma
from px4fuse.core.text import capitalise_first_letter, format_metres, format_ratio
from px4fuse.errors import TrajectoryError
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning
from px4fuse.finding import Finding
from px4fuse.flight.model import Unavailable
from px4fuse.trajectory.alignment import fit_alignment

from .cause_text import classify_cause, format_action, rerun_refutes_cause
from .loops import find_usable_loop
from .model import (
    CAUSE_KEY,
    Findings,
    error_if,
    find_source_texts,
    finding,
    format_percent,
    make_error,
    make_note,
)

# Minimum mean NEES, for severity "error": an RMS position error of 4 times the reported σ
MIN_NEES_FOR_SEVERITY_ERROR = 16.0
# If KF's position RMSE ÷ EKF2's position RMSE is below this ratio, the fault is in EKF2 and not in
# the positions, which both filters use
MAX_KF_TO_EKF2_RMSE_RATIO = 0.7
# The position frame is misaligned if alignment (shift and rotation) reduces the position RMSE to
# less than this fraction
MAX_ALIGNED_TO_UNALIGNED_RMSE_RATIO = 0.5
DRIFT_REMEDY = "In the next flight, send an absolute position (GNSS, UWB) as well."
LOOP_REMEDY = "To correct the path of this flight by a loop closure, run px4fuse loop LOG."
FRAME_REMEDY = "Rotate and shift the positions into the frame of the ground truth."
EKF2_REMEDY = (
    "Check delay, heading and other aiding sources of EKF2: KF has a smaller error with the "
    "same positions."
)
EKF2_HEIGHT_REMEDY = (
    "Check EKF2's height sensors (EKF2_HGT_REF) and the accelerometer: KF has a smaller height "
    "error."
)


def find_hidden_errors(comparison: Comparison) -> list[tuple[FilterName, str, ErrorAboveSigma]]:
    """Find position errors that exceed the reported σ although the innovations are consistent.

    Return (filter, axis, error) for each error, largest mean NEES first.
    """
    alignment, min_kf_rmse_by_axis = comparison.source.alignment, dict[str, float]()
    # Positions of a file that were shifted and rotated to fit EKF2's track contain errors of EKF2,
    # and so does KF's track. Ignore errors of KF up to the RMS residual of the fit. The residual is
    # only horizontal: ignore all height errors of KF
    if alignment is not None and alignment.yaw_sigma_deg is not None:
        min_kf_rmse_by_axis = dict.fromkeys(comparison.axes, alignment.residual_rms_m or 0.0)
        min_kf_rmse_by_axis["down"] = np.inf
    errors_not_in_innovations = [
        (filter_name, name, error)
        for name, result in comparison.axes.items()
        for filter_name, summary in result.filters.items()
        if (error := find_error_above_sigma(summary))
        and (filter_name == "ekf2" or error.rmse_m > min_kf_rmse_by_axis.get(name, 0.0))
    ]
    return sorted(errors_not_in_innovations, key=lambda entry: -entry[2].nees)


def detect(analysis: Analysis) -> Findings:
    if errors_not_in_innovations := find_hidden_errors(analysis):
        yield make_hidden_error_finding(analysis, errors_not_in_innovations)
    elif analysis.source.origin.may_drift:
        yield make_possible_drift_finding(analysis)


def make_hidden_error_finding(
    analysis: Analysis, errors_not_in_innovations: list[tuple[FilterName, str, ErrorAboveSigma]]
) -> Finding:
    """Make the finding on position errors above the reported σ, or on the drift that causes them.

    ``errors_not_in_innovations`` are sorted, the largest first.
    """
    # Errors along the main axis first. Of each filter, only the first error is reported
    errors_not_in_innovations = sorted(
        errors_not_in_innovations, key=lambda entry: entry[1] != analysis.main.axis.name
    )
    worst_filter, worst_axis, worst_error = errors_not_in_innovations[0]
    error_by_filter = dict[FilterName, tuple[str, ErrorAboveSigma]]()
    for filter_name, axis, error in errors_not_in_innovations:
        error_by_filter.setdefault(filter_name, (axis, error))
    # 1. Texts, evidence and cause for each filter
    evidence: dict[str, float | str] = {"axis": worst_axis, "filter": worst_filter}
    ratio_texts, sentences = dict[str, str](), list[str]()
    rerun_by_filter = dict[FilterName, Rerun]()
    for filter_name, label in FILTER_NAMES.items():
        if filter_name not in error_by_filter:
            continue
        axis, error = error_by_filter[filter_name]
        if error.nis_mean is not None:
            evidence[f"{filter_name}_nis_mean"] = error.nis_mean
        evidence |= {
            f"{filter_name}_nees_position_mean": error.nees,
            f"{filter_name}_position_rmse_m": error.rmse_m,
            f"{filter_name}_sigma_p_m": error.reported_sigma_m,
        }
        cause = find_cause_rerun(analysis.reruns, filter_name, axis, "nees")
        if cause is not None and not rerun_refutes_cause(analysis, filter_name, cause):
            rerun_by_filter[filter_name] = cause
        ratio_texts[label] = f"{label} error {format_ratio(error.nees**0.5)} times the reported σ"
        sentences.append(
            f"{label}: position RMSE {format_metres(error.rmse_m)} m along "
            f"{analysis.axes[axis].axis.label}, reported σ "
            f"{format_metres(error.reported_sigma_m)} m."
        )
    # 2. Find the cause of the largest error. If its cause is unknown, use the cause of the other
    # filter's error
    cause = (
        rerun_by_filter.get(worst_filter)
        or rerun_by_filter.get("kf")
        or rerun_by_filter.get("ekf2")
    )
    evidence[CAUSE_KEY] = classify_cause(analysis, cause)
    # 3. Without a cause, test if an alignment with ground truth removes most of the error
    is_misaligned = False
    rmse_text = f"position RMSE {format_metres(worst_error.rmse_m)} m against ground truth"
    if cause is None and (alignment_rmse := _compute_alignment_rmse(analysis, worst_filter)):
        unaligned_rmse_m, aligned_rmse_m = alignment_rmse
        rmse_text = (
            f"horizontal position RMSE {format_metres(unaligned_rmse_m)} m before and "
            f"{format_metres(aligned_rmse_m)} m after alignment (shift and rotation)"
        )
        evidence |= {
            "position_rmse_horizontal_m": unaligned_rmse_m,
            "position_rmse_aligned_m": aligned_rmse_m,
        }
        is_misaligned = aligned_rmse_m < MAX_ALIGNED_TO_UNALIGNED_RMSE_RATIO * unaligned_rmse_m
    # 4. Remedy, in the order of certainty
    kf_errors = analysis.axes[worst_axis].filters["kf"].truth
    if cause is not None:
        remedy = format_action(analysis, cause.change)
    elif is_misaligned:
        sentences.append(f"The position frame is misaligned: {rmse_text}.")
        remedy = FRAME_REMEDY
    elif analysis.source.origin.may_drift:
        return _make_drift_finding(analysis, rmse_text, evidence, tuple(ratio_texts))
    # KF uses the same positions: if its error is smaller, the fault is in EKF2
    elif (
        error_by_filter.keys() == {"ekf2"}
        and isinstance(kf_errors, ErrorsAgainstTruth)
        and kf_errors.position_rmse_m < MAX_KF_TO_EKF2_RMSE_RATIO * worst_error.rmse_m
    ):
        remedy = EKF2_HEIGHT_REMEDY if worst_axis == "down" else EKF2_REMEDY
    else:
        remedy = _find_source_remedy(analysis)
    return finding(
        error_if(worst_error.nees >= MIN_NEES_FOR_SEVERITY_ERROR),
        "error_exceeds_reported_sigma",
        f"Position errors that innovations do not show: {', '.join(ratio_texts.values())}. "
        f"{' '.join(sentences)}",
        remedy,
        evidence,
    )


def _find_source_remedy(analysis: Analysis) -> str:
    """Return the advice to check time offset and slow errors of the position source."""
    remedy = "Check the time offset of the positions (px4fuse sync LOG)."
    if isinstance(analysis.time_offset, Unavailable):
        remedy = (
            "A time offset of the positions is possible, but this log cannot show it: "
            f"{analysis.time_offset.reason}. {analysis.time_offset.remedy}"
        )
    return f"{remedy} {find_source_texts(analysis).slow_error_check}."


def _make_drift_finding(
    analysis: Analysis,
    rmse_text: str,
    evidence: Mapping[str, float | str],
    filter_labels: tuple[str, ...],
) -> Finding:
    """Make the finding that the source drifts although the innovations are consistent.

    ``filter_labels`` are the filters whose position error exceeds their reported σ.
    """
    loop, drift_text, rmse_sentence = find_usable_loop(analysis), rmse_text, ""
    # State the loop closure error first if the true end is known and the path is odometry
    if (
        loop is not None
        and not (loop.is_landing_place_assumed or loop.is_absolute_track)
        and not isinstance(loop.true_end, Unavailable)
        and (closure_error_m := loop.closure_error_m) is not None
    ):
        length_m = loop.path_length_m
        evidence = {**evidence, "closure_error_m": closure_error_m, "path_length_m": length_m}
        rmse_sentence = f"{capitalise_first_letter(rmse_text)}. "
        drift_text = (
            f"loop closure error {format_metres(closure_error_m)} m, "
            f"{format_percent(closure_error_m / length_m, 1)} of a path of {length_m:.0f} m"
        )
    aid = analysis.source.origin.aid
    return make_error(
        "source_drift",
        f"{analysis.source.kind_name} drifts: {drift_text}. {rmse_sentence}The innovations of "
        f"{' and '.join(filter_labels)} do not show the drift. Do not reduce SIGMA_Z"
        f"{f' or {aid.noise}' if aid else ''}.",
        DRIFT_REMEDY if loop is None else f"{DRIFT_REMEDY} {LOOP_REMEDY}",
        evidence,
    )


def _compute_alignment_rmse(
    comparison: Comparison, filter_name: FilterName
) -> tuple[float, float] | None:
    """Return the horizontal position RMSE before and after alignment (shift and yaw rotation)."""
    true_positions_m, positions_m = [], []
    for result in select_north_and_east(comparison):
        errors, truth = compute_position_errors(result, filter_name), result.truth
        if isinstance(errors, Unavailable) or isinstance(truth, Unavailable):
            return None
        true_positions_m.append(np.interp(errors.index, truth.index, truth["position_m"]))
        positions_m.append(true_positions_m[-1] + errors["error_m"].to_numpy())
    if len(positions_m) < 2:
        return None
    is_known = np.isfinite(positions_m).all(axis=0)
    # Columns north, east, down; all heights are zero
    true_position_m, position_m = (
        np.pad(np.column_stack(columns), ((0, 0), (0, 1)))[is_known]
        for columns in (true_positions_m, positions_m)
    )
    try:
        aligned_position_m = fit_alignment(position_m, true_position_m, "yaw").apply(position_m)
    except TrajectoryError:  # the track is too short to determine a rotation
        return None
    unaligned_rmse_m, aligned_rmse_m = (
        float(np.linalg.norm(estimate_m - true_position_m)) / len(true_position_m) ** 0.5
        for estimate_m in (position_m, aligned_position_m)
    )
    return unaligned_rmse_m, aligned_rmse_m


def make_possible_drift_finding(analysis: Analysis) -> Finding:
    """Make the note that the source may drift, with noise and closure error, if known."""
    loop, horizontal_tuning = find_usable_loop(analysis), analysis.tuning.get(HORIZONTAL)
    evidence: dict[str, float | str] = {"source": analysis.source.name}
    message = (
        f"{analysis.source.kind_name} may drift. "
        "KF and EKF2 follow the drift, so innovations do not show the drift."
    )
    if isinstance(horizontal_tuning, AxisTuning) and (
        noise_m := horizontal_tuning.sigma_z.value_or_bound(0.0)
    ):
        bound_text = "at most " if horizontal_tuning.sigma_z.value is None else ""
        evidence["short_term_noise_m"] = noise_m
        message += f" The position noise (1 σ) is {bound_text}{noise_m:.2g} m, without the drift."
    if loop is not None and (closure_error_m := loop.closure_error_m) is not None:
        evidence |= {"closure_error_m": closure_error_m, "path_length_m": loop.path_length_m}
        message += (
            f" The loop closure error is {format_metres(closure_error_m)} m after a path of "
            f"{loop.path_length_m:.0f} m."
        )
    loop_text = "" if loop is None else "from the loop closure error (px4fuse loop LOG) or "
    action = (
        f"Measure the drift {loop_text}with ground truth (ATT_POS_MOCAP). If the source is "
        "motion capture, run again with --source-kind mocap."
    )
    return make_note("source_may_drift", message, action, evidence)
