"""Search for the cause of an inconsistent filter by re-runs with one change at a time.

If no single change is sufficient, the best change is combined with each other change.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, NamedTuple, TypeGuard

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from px4fuse.core.arrays import Array
from px4fuse.ekf2.filter_batch import FilterConfiguration
from px4fuse.ekf2.inputs import ReplayInputs
from px4fuse.ekf2.model import Ekf2Model, misalign_positions, replay_with_settings
from px4fuse.ekf2.replay import HORIZONTAL_AXES, Ekf2Replay, rows_inside
from px4fuse.ekf2.steps import DifferenceExplanation
from px4fuse.filter.kalman import run_kf
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import (
    Acceleration,
    compute_ned_acceleration,
    integrate_ned_acceleration,
    weighted_sum,
)
from px4fuse.filter.time_offset import SourceTimeOffset
from px4fuse.filter.tuning import HORIZONTAL
from px4fuse.flight.ekf2_parameters import MODEL_PARAMETERS
from px4fuse.flight.model import Columns, Spans, Unavailable

from .changes import (
    classify_change,
    find_additional_changes,
    find_axis_tuning,
    find_candidate_changes,
    remove_repeated_changes,
)
from .comparison import (
    compare,
    compute_difference_statistics,
    compute_error_statistics,
    find_compared_track,
    make_run_tracks,
)
from .estimates import Estimates, TuningByAxis
from .model import (
    AxisComparison,
    Comparison,
    ErrorsAgainstTruth,
    FilterDifference,
    FilterSummary,
    PreparedComparison,
    UntestedFilter,
)
from .projection import project, project_truth
from .remedy import is_source_fused
from .rerun_effects import (
    CONSISTENCY_STATISTICS,
    FORWARD_BIAS_KEY,
    MIN_REPORTED_NEES,
    OUTLIERS_KEY,
    RIGHT_BIAS_KEY,
    ROTATION_KEY,
    TIME_OFFSET_KEY,
    ChangedValues,
    Rerun,
    RunStatistics,
    Statistic,
    find_partial_corrections,
)

# Mean NIS above which innovations are too large for the reported σ
MAX_NORMAL_NIS = 1.5
# Reference for the re-runs of EKF2: the log, if a replay without changes agrees with it, else this
# replay. Replay and log agree if their position RMSEs, and their ratios of actual to reported σ,
# differ by at most this factor
MAX_REPLAYED_TO_LOGGED_ERROR_RATIO = 1.10


class ErrorAboveSigma(NamedTuple):
    """Position error of a filter against ground truth that exceeds the filter's reported σ."""

    nees: float
    rmse_m: float
    reported_sigma_m: float
    nis_mean: float | None


def find_error_above_sigma(summary: FilterSummary | UntestedFilter) -> ErrorAboveSigma | None:
    """Return the position error if it exceeds the reported σ although the mean NIS is normal."""
    truth = summary.truth
    if isinstance(truth, Unavailable):
        return None
    nis_mean = None if isinstance(summary, Unavailable) else summary.nis_mean
    if nis_mean is not None and nis_mean >= MAX_NORMAL_NIS:
        return None
    # An error due only to the lag of the output predictor does not count. The NEES at the fusion
    # horizon, if logged, does not contain this lag
    nees, rmse_m = truth.nees_position_mean or 0.0, truth.position_rmse_m
    fusion_horizon_nees = truth.nees_position_horizon_mean or nees
    if min(nees, fusion_horizon_nees) < MIN_REPORTED_NEES:
        return None
    # If the median reported σ is missing, compute σ from NEES = (error / σ)²
    reported_sigma_m = summary.sigma_p_median_m or rmse_m / nees**0.5
    return ErrorAboveSigma(nees, rmse_m, reported_sigma_m, nis_mean)


@dataclass(frozen=True, kw_only=True)
class Reruns:
    """Replay of EKF2, and re-runs of KF and EKF2 with changed settings or data.

    Attributes
    ----------
    ekf2_model : Ekf2Model or Unavailable
        Replay of EKF2 with the logged parameters.
    difference_steps : mapping from axis name to DifferenceExplanation or Unavailable
        Causes of the difference KF - EKF2.
    reruns : tuple of Rerun
        Re-runs along the axis of largest motion, and along each axis with an inconsistent filter.
    """

    ekf2_model: Ekf2Model | Unavailable
    difference_steps: Mapping[str, DifferenceExplanation | Unavailable]
    reruns: tuple[Rerun, ...]


def rerun_filters(
    comparison: Comparison, estimates: Estimates, model: Ekf2Model | Unavailable
) -> tuple[Rerun, ...]:
    """Re-run KF and EKF2 along each axis with each change that may make them consistent.

    EKF2 is re-run only if its replay agrees with the log, and only once for each change, because a
    replay contains all axes.
    """
    rerun_kf = partial(_rerun_kf, comparison, estimates.tuning)
    reruns = [
        rerun
        for axis_result in comparison.axes.values()
        for rerun in _rerun_with_changes(comparison, estimates, axis_result, rerun_kf)
    ]
    if (
        isinstance(model, Ekf2Model)
        and model.agreement.good
        and is_source_fused(comparison, model.inputs)
    ):
        # One replay of each change for all axes. The argument is a frozenset, because a mapping
        # cannot be the key of a cache
        @cache
        def replay_ekf2(change_items: frozenset[tuple[str, float]]) -> Ekf2Replay:
            return _replay_ekf2(comparison, estimates.tuning, model, dict(change_items))

        def rerun_ekf2(axis_result: AxisComparison, change: ChangedValues) -> RunStatistics:
            ekf2_replay = replay_ekf2(frozenset(change.items()))
            return _summarise_replay(comparison, model, ekf2_replay, axis_result, change)

        for axis_result in comparison.axes.values():
            reruns += _rerun_with_changes(comparison, estimates, axis_result, rerun_ekf2, model)
    return tuple(reruns)


def rerun_kf_with_time_offset(prepared: PreparedComparison, time_offset: SourceTimeOffset) -> Rerun:
    """Run KF along one axis with and without a time offset, as :func:`rerun_filters` does."""
    comparison = compare(prepared)
    change = {TIME_OFFSET_KEY: round(time_offset.offset_s, 3)}
    return Rerun(
        filter="kf",
        axis=comparison.main.axis.name,
        kinds=classify_change(comparison, None, change),
        change=change,
        before=_rerun_kf(comparison, {}, comparison.main, {}),
        after=_rerun_kf(comparison, {}, comparison.main, change),
    )


def list_rerun_configurations(
    comparison: Comparison, estimates: Estimates, ekf2_inputs: ReplayInputs
) -> list[FilterConfiguration]:
    """Return the EKF2 configurations that :func:`rerun_filters` will replay."""
    if not is_source_fused(comparison, ekf2_inputs):
        return []
    logged_parameters = ekf2_inputs.settings
    return [
        FilterConfiguration({**logged_parameters, **change})
        for axis_result in comparison.axes.values()
        for change, _ in _find_changes_to_test(comparison, estimates, ekf2_inputs, axis_result)
        if change.keys() <= logged_parameters.keys()
    ]


def is_inconsistent(summary: FilterSummary | UntestedFilter) -> TypeGuard[FilterSummary]:
    """Return True if the filter is overconfident or underconfident."""
    return not isinstance(summary, Unavailable) and summary.verdict != "consistent"


def _find_changes_to_test(
    comparison: Comparison,
    estimates: Estimates,
    ekf2_inputs: ReplayInputs | None,
    axis_result: AxisComparison,
) -> list[tuple[ChangedValues, tuple[Statistic, ...]]]:
    """Return the changes to test along an axis, and the statistics that each change may correct.

    ``ekf2_inputs`` is None for KF. Along the main axis, all candidate changes are tested. Along
    other axes, changes are tested only if the filter is inconsistent.
    """
    axis = axis_result.axis.name
    summary = axis_result.filters["kf" if ekf2_inputs is None else "ekf2"]
    if not isinstance(summary, FilterSummary) or (ekf2_inputs is not None and axis == "down"):
        return []  # EKF2's replay contains no vertical position
    candidates = {
        statistic: find_candidate_changes(
            comparison, estimates, ekf2_inputs, axis, summary, statistic
        )
        for statistic in CONSISTENCY_STATISTICS
    }
    # Inconsistency can show in the mean NEES (errors against ground truth) or in the mean NIS
    # (innovations). Find the statistics that show it
    statistics: list[Statistic] = ["nees"] if find_error_above_sigma(summary) else []
    if is_inconsistent(summary):
        statistics.append("nis")
    if axis_result is comparison.main:
        # Along the main axis, changes are tested even if the filter is consistent. Changes against
        # a wrong mean NIS are tested first
        changes = [*candidates["nis"], *candidates["nees"]]
        changes += find_additional_changes(comparison, estimates, ekf2_inputs, changes)
    else:
        changes = [change for statistic in statistics for change in candidates[statistic]]
    return [
        (change, tuple(statistic for statistic in statistics if change in candidates[statistic]))
        for change in remove_repeated_changes(changes)
    ]


def _rerun_with_changes(
    comparison: Comparison,
    estimates: Estimates,
    axis_result: AxisComparison,
    rerun_filter: Callable[[AxisComparison, ChangedValues], RunStatistics],
    model: Ekf2Model | None = None,
) -> list[Rerun]:
    """Re-run a filter along an axis with each change to test; ``model`` is None for KF."""
    ekf2_inputs = None if model is None else model.inputs
    changes = _find_changes_to_test(comparison, estimates, ekf2_inputs, axis_result)
    if not changes:
        return []
    # The re-runs are compared with the original run of KF. Those of EKF2 are compared with the log
    # or, if the unchanged replay differs too much from the log, with the unchanged replay
    original_statistics, is_logged, spans_s = rerun_filter(axis_result, {}), True, None
    if model is not None:
        spans_s = model.baseline_replay.find_evaluated_spans()
        logged_statistics = _find_logged_statistics(original_statistics, axis_result, spans_s)
        is_logged = logged_statistics is not None
        original_statistics = logged_statistics or original_statistics

    def make_rerun(change: ChangedValues, discrepancies: Iterable[Statistic]) -> Rerun:
        """Re-run the filter with one change, and compare it with the run without change."""
        rerun_statistics = rerun_filter(axis_result, change)
        return Rerun(
            filter="kf" if model is None else "ekf2",
            axis=axis_result.axis.name,
            kinds=classify_change(comparison, ekf2_inputs, change),
            change=change,
            discrepancies=tuple(
                statistic
                for statistic in discrepancies
                if original_statistics.value(statistic) and rerun_statistics.value(statistic)
            ),
            before=original_statistics,
            is_logged=is_logged,
            after=rerun_statistics,
            from_s=None if spans_s is None else spans_s[0][0],
        )

    reruns = [make_rerun(change, discrepancies) for change, discrepancies in changes]
    # If no change alone makes the filter consistent, combine the best change with each other change
    # that makes it more consistent
    for statistic in CONSISTENCY_STATISTICS:
        helpful_reruns = find_partial_corrections(reruns, statistic)
        reruns += [
            make_rerun({**helpful_reruns[0].change, **other_rerun.change}, (statistic,))
            for other_rerun in helpful_reruns[1:]
        ]
    return reruns


def _find_logged_statistics(
    replayed: RunStatistics, axis_result: AxisComparison, evaluated_spans_s: Spans
) -> RunStatistics | None:
    """Return the logged statistics of EKF2; None if those of the unchanged replay differ.

    ``replayed`` are the statistics of the replay without changes. They must agree with the logged
    ones within a factor. Return None also if state or innovations are not logged.
    """
    ekf2, innovations = axis_result.ekf2_tracks, axis_result.ekf2_tracks.innovations
    if isinstance(ekf2.state, Unavailable) or isinstance(innovations, Unavailable):
        return None
    logged_state = rows_inside(ekf2.state, evaluated_spans_s)
    innovations = rows_inside(innovations, evaluated_spans_s)
    rejected_flags = innovations["rejected"].dropna()
    logged = _summarise_run(
        innovations["innovation_m"].to_numpy(),
        innovations["innovation_variance_m2"].to_numpy(),
        compute_error_statistics(logged_state, ekf2.variance, axis_result.truth),
        compute_difference_statistics(axis_result.kf_run, logged_state),
        float((rejected_flags > 0.0).mean()) if len(rejected_flags) else None,
    )
    # A statistic that is not logged is not compared
    is_replay_similar = all(
        logged_value and replayed_value and 1.0 / limit <= logged_value / replayed_value <= limit
        for logged_value, replayed_value, limit in (
            (logged.position_rmse_m, replayed.position_rmse_m, MAX_REPLAYED_TO_LOGGED_ERROR_RATIO),
            (logged.nis_mean, replayed.nis_mean, MAX_REPLAYED_TO_LOGGED_ERROR_RATIO**2),
            (logged.nees_mean, replayed.nees_mean, MAX_REPLAYED_TO_LOGGED_ERROR_RATIO**2),
        )
        if logged_value is not None
    )
    return logged if is_replay_similar else None


def _summarise_run(
    innovation_m: Array,
    innovation_variance_m2: Array,
    errors: ErrorsAgainstTruth | Unavailable,
    kf_minus_ekf2: FilterDifference | Unavailable | None,
    rejected_fraction: float | None = None,
) -> RunStatistics:
    """Compute the statistics of one run of a filter along one axis."""
    nis = innovation_m**2 / innovation_variance_m2
    return RunStatistics(
        innovations=len(nis),
        nis_mean=float(np.mean(nis)) if len(nis) else None,
        position_rmse_m=getattr(errors, "position_rmse_m", None),
        nees_mean=getattr(errors, "nees_position_mean", None),
        difference_rms_m=getattr(kf_minus_ekf2, "position_rms_m", None),
        rejected_fraction=rejected_fraction,
    )


def _rotate_direction(direction: Array, rotation_deg: float) -> Array:
    """Rotate a direction (NED) counterclockwise, seen from above, by an angle (°)."""
    return Rotation.from_euler("z", -rotation_deg, degrees=True).apply(direction)


def _rerun_kf(
    comparison: Comparison, tuning: TuningByAxis, axis_result: AxisComparison, change: ChangedValues
) -> RunStatistics:
    """Run KF along an axis with a change of its settings or of its data, and summarise the run."""
    axis, truth, ekf2_state = axis_result.axis, axis_result.truth, axis_result.ekf2_tracks.state
    # The corrected time offset (clock_offset_s) is also a setting of KF
    kf_settings: dict[str, Any] = {
        name: change[name] for name in change if name in vars(Settings())
    }
    changed_settings = replace(comparison.settings, **kf_settings)
    # Apply the corrections of the data in sequence. 1. Rotation of the positions: project them onto
    # the axis rotated in the opposite direction
    rotates_gnss_positions = ROTATION_KEY in change and comparison.source.origin.is_gnss
    if ROTATION_KEY in change:
        rotated_direction = _rotate_direction(axis.direction, change[ROTATION_KEY])
        measured_m = weighted_sum(comparison.source_samples, Columns.POSITION, rotated_direction)
        axis = replace(axis, measurement_m=measured_m[np.isfinite(measured_m)])
        if rotates_gnss_positions:
            # GNSS positions are right, but the heading of KF's acceleration is wrong. Rotating
            # positions and ground truth has the same effect as correcting the heading
            rotated_axis = replace(axis, direction=rotated_direction)
            truth = project_truth(comparison.flight.truth, rotated_axis, comparison.segment)
    # 2. Accelerometer bias
    if FORWARD_BIAS_KEY in change:
        axis = replace(axis, acceleration=_remove_accelerometer_bias(comparison, change))
    # 3. Outliers
    time_s, axis_tuning = axis.measurement_time_s, find_axis_tuning(tuning, axis.name)
    is_used = np.ones(len(time_s), dtype=bool)
    if OUTLIERS_KEY in change and axis_tuning is not None:
        is_used = ~np.isin(time_s, axis_tuning.outlier_time_s)
    # 4. Time offset: the timestamps already contain the offset of the original run
    shift_s = changed_settings.clock_offset_s - comparison.settings.clock_offset_s
    axis = replace(
        axis,
        measurement_time_s=time_s[is_used] + shift_s,
        measurement_m=axis.measurement_m[is_used],
    )
    kf_run = run_kf(axis, changed_settings, fast=True)
    # If GNSS positions are rotated, KF and EKF2 have different frames: no difference KF - EKF2
    return _summarise_run(
        kf_run.updates["innovation_m"].to_numpy(),
        kf_run.updates["innovation_variance_m2"].to_numpy(),
        compute_error_statistics(*find_compared_track(make_run_tracks(kf_run), ekf2_state), truth),
        None if rotates_gnss_positions else compute_difference_statistics(kf_run, ekf2_state),
    )


def _remove_accelerometer_bias(
    comparison: Comparison, change: ChangedValues
) -> Acceleration | Unavailable:
    """Subtract the accelerometer bias in ``change`` from the IMU data, and integrate them again."""
    flight, imu = comparison.flight, comparison.flight.imu
    if isinstance(imu, Unavailable):
        return imu
    accelerometer_bias = pd.Series(
        [change[FORWARD_BIAS_KEY], change[RIGHT_BIAS_KEY], 0.0], Columns.SPECIFIC_FORCE
    )
    flight = replace(flight, imu=imu.assign(**(imu[Columns.SPECIFIC_FORCE] - accelerometer_bias)))
    return integrate_ned_acceleration(compute_ned_acceleration(flight), comparison.segment)


def _replay_ekf2(
    comparison: Comparison, tuning: TuningByAxis, model: Ekf2Model, change: ChangedValues
) -> Ekf2Replay:
    """Replay EKF2 with changed parameters, or with corrected positions."""
    if not change:
        return model.baseline_replay
    # A change contains parameters of EKF2, and corrections of the positions under other names
    changed_parameters = {name: value for name, value in change.items() if name in MODEL_PARAMETERS}
    time_offset_s = change.get(TIME_OFFSET_KEY, 0.0)
    model = misalign_positions(model, change.get(ROTATION_KEY, 0.0), time_offset_s)
    excluded_times_s, axis_tuning = None, find_axis_tuning(tuning, HORIZONTAL)
    if OUTLIERS_KEY in change and axis_tuning is not None:
        # Outlier times are KF's timestamps. To find these positions in the replay, remove KF's time
        # offset, and add the tested offset
        excluded_times_s = (
            axis_tuning.outlier_time_s - comparison.settings.clock_offset_s + time_offset_s
        )
        # For GNSS, KF's timestamps are earlier by the delay parameter than those of the replay
        if comparison.source.origin.is_fused_as_gnss:
            excluded_times_s += 1e-3 * model.inputs.settings[model.inputs.aid.delay]
    (replay,) = replay_with_settings(model, [changed_parameters], excluded_times_s)
    return replay


def _summarise_replay(
    comparison: Comparison,
    model: Ekf2Model,
    ekf2_replay: Ekf2Replay,
    axis_result: AxisComparison,
    change: ChangedValues,
) -> RunStatistics:
    """Compute the statistics of a replay of EKF2 along one axis.

    The reported variance is the mean of the variances before and after each update.
    """
    evaluated_spans_s, axis = model.baseline_replay.find_evaluated_spans(), axis_result.axis
    if ROTATION_KEY in change and comparison.source.origin.is_gnss:
        # The re-run rotates the GNSS positions, and EKF2's frame with them. Rotate the evaluated
        # axis by the same angle. The minus sign is necessary because the change is a clockwise
        # angle
        axis = replace(axis, direction=_rotate_direction(axis.direction, -change[ROTATION_KEY]))
    # 1. Project three variances from north and east onto the axis: the innovation variance S, the
    # measurement noise R, and the position variance P⁺ after the update
    cosines, updates = axis.direction[:2], rows_inside(ekf2_replay.updates, evaluated_spans_s)
    innovation_variance_m2, observation_variance_m2, posterior_variance_m2 = (
        weighted_sum(
            updates, [f"{name}_{horizontal}_m2" for horizontal in HORIZONTAL_AXES], cosines**2
        )
        for name in ("innovation_variance", "observation_variance", "position_variance")
    )
    # 2. Reported position variance at each update: mean of P⁻ = S - R (before) and P⁺ (after)
    prior_variance_m2 = innovation_variance_m2 - observation_variance_m2
    variance_by_time = pd.DataFrame(
        {
            "position_variance_m2": 0.5 * (prior_variance_m2 + posterior_variance_m2),
            "velocity_variance_m2_s2": np.nan,
        },
        index=pd.Index(updates["fused_at_s"].to_numpy()),
    )
    # 3. Track for the errors against ground truth, and track for the difference to KF
    published_track = project(ekf2_replay.published_state, axis, comparison.segment)
    published_track = rows_inside(published_track, evaluated_spans_s)
    logged_state, track_compared_with_kf = axis_result.ekf2_tracks.state, published_track
    # Without changed parameters or data, compare KF with the logged EKF2, as in the report
    if not change and not isinstance(logged_state, Unavailable):
        track_compared_with_kf = rows_inside(logged_state, evaluated_spans_s)
    return _summarise_run(
        weighted_sum(updates, [f"innovation_{name}_m" for name in HORIZONTAL_AXES], cosines),
        innovation_variance_m2,
        compute_error_statistics(published_track, variance_by_time, axis_result.truth),
        compute_difference_statistics(axis_result.kf_run, track_compared_with_kf),
        float((updates["rejected"] > 0.0).mean()) if len(updates) else None,
    )
