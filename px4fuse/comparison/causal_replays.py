"""Causes of inconsistent filters, found by re-running a filter with one change at a time.

A discrepancy of a filter is a mean NIS outside its band, or a mean NEES that shows errors larger
than the reported σ. Changes that may explain it are re-run one by one; if none suffices, the best
change is combined with each other one. The cause is the smallest change that brings the statistic
into its band, or else explains at least half of the logarithm of the statistic. A smaller noise is
not a cause if the reported σ would then be smaller than the errors against ground truth. A sensor
fault that explains as much as a setting is preferred: the setting would only hide the fault.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple, TypeGuard

import numpy as np
import pandas as pd
from msgspec import structs
from scipy.spatial.transform import Rotation

from px4fuse.comparison.changes import (
    ACCOMPANYING_CHANGES,
    CLOCK_OFFSET,
    FORWARD_BIAS,
    OUTLIERS,
    RIGHT_BIAS,
    ROTATION,
    SENSOR_CHANGES,
    candidate_changes,
    change_kinds,
    main_axis_changes,
    tuning_of_axis,
)
from px4fuse.comparison.comparison import difference, error_statistics, kf_error_statistics
from px4fuse.comparison.estimates import Estimates, Tuning
from px4fuse.comparison.model import (
    AxisComparison,
    Comparison,
    Difference,
    ErrorsAgainstTruth,
    FilterName,
    FilterSummary,
    UntestedFilter,
)
from px4fuse.comparison.projection import project, project_truth
from px4fuse.comparison.remedy import is_fused_source
from px4fuse.comparison.trials import Change, RunStatistics, Statistic, Trial, distance_from_one
from px4fuse.core.arrays import Array
from px4fuse.core.record import Positive, Record
from px4fuse.ekf2.filter_recursion import FilterConfiguration
from px4fuse.ekf2.inputs import Inputs
from px4fuse.ekf2.model import Model, replay_settings, with_misaligned_positions
from px4fuse.ekf2.replay import HORIZONTAL as HORIZONTAL_AXES
from px4fuse.ekf2.replay import UPDATE_COLUMNS, Ekf2Replay, inside_spans
from px4fuse.ekf2.steps import DifferenceExplanation
from px4fuse.filter.consistency import nis_band
from px4fuse.filter.kalman import replay
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import (
    Acceleration,
    cut_to_segment,
    ned_acceleration,
    project_acceleration,
    weighted_sum,
)
from px4fuse.filter.tuning import HORIZONTAL
from px4fuse.flight.ekf2_parameters import PARAMETERS
from px4fuse.flight.model import Columns, Unavailable

# Mean NEES from which position errors are larger than the reported σ: errors of 2 σ; flights
# without a fault have less than 3
MIN_NEES_FINDING = 4.0
# Maximum mean NEES after a change to a smaller noise, if the mean NEES was above 1 before
MAX_NEES_AFTER_CHANGE = 2.0
# Maximum mean NIS with which innovations do not show that the reported σ is too small
MAX_UNREMARKABLE_NIS = 1.5
# Minimum fraction of ln(statistic) that a cause removes; at most 1.5 may be removed (overshoot)
MIN_EXPLAINED_SHARE = 0.5
# Maximum deviation from 1 of the explained fraction of ln(statistic) for a sensor fault to be the
# only cause: the noises of the re-run are approximate
SENSOR_CAUSE_TOLERANCE = 0.25
# Minimum fraction of ln(statistic) that a change removes to be combined with the best change
MIN_HELPFUL_SHARE = 0.1
# Columns of an EKF2 replay for north and east
INNOVATION_COLUMNS, INNOVATION_VARIANCE_COLUMNS = UPDATE_COLUMNS[:2], UPDATE_COLUMNS[2:4]
POSITION_VARIANCES = [f"position_variance_{axis}_m2" for axis in HORIZONTAL_AXES]
OBSERVATION_VARIANCES = [f"observation_variance_{axis}_m2" for axis in HORIZONTAL_AXES]
NO_DIFFERENCE = Unavailable(
    "difference KF - EKF2", "the filters use different frames after the change", ""
)
# Maximum ratio of a statistic in the replay as flown and in the log, for re-runs to be valid
MAX_REPLAY_FACTOR = 1.10
# Maximum number of changes that are combined with the best change
MAX_PAIRS = 4


class Intervention(Record, frozen=True, kw_only=True):
    """One statistic of a filter with and without a change, from a re-run.

    Attributes
    ----------
    statistic : {"nis", "nees", "difference"}
        Mean NIS, mean NEES of position, or RMS difference KF - EKF2 (m, for causes only).
    filter : {"kf", "ekf2"}
    axis : str
    change : mapping from name to value
        Fields of Settings, PX4 parameters, ``turned_deg`` (rotation of the positions, clockwise
        from above), ``outliers_left_out`` (number), and the removed accelerometer biases
        ``bias_forward_m_s2`` and ``bias_right_m_s2``.
    before, after : float
        Statistic of a re-run without the change and with it, of the same samples.
    explained_fraction : float
        Fraction of ln(statistic) that the change removes; above 1 the change overshoots. For the
        RMS difference, the fraction of the mean square.
    is_sufficient : bool
        True if the mean NIS is in its 95 % band, or the mean NEES below
        :data:`MIN_NEES_FINDING`.
    contradicts_truth : bool
        True if the reported σ with the change is smaller than the errors against ground truth.
    """

    statistic: Statistic
    filter: FilterName
    axis: str
    change: Change
    before: Positive
    after: Positive
    explained_fraction: float
    is_sufficient: bool
    contradicts_truth: bool = False

    @property
    def is_cause(self) -> bool:
        """True if the change explains 50 to 150 % of the logarithm of the mean NIS or NEES."""
        return (
            MIN_EXPLAINED_SHARE <= self.explained_fraction <= 2.0 - MIN_EXPLAINED_SHARE
            and not self.contradicts_truth
        )

    @property
    def corrects_sensor(self) -> bool:
        """True if the change corrects a sensor fault instead of a setting."""
        return not SENSOR_CHANGES.isdisjoint(self.change)

    @property
    def is_complete_cause(self) -> bool:
        """True if the mean NIS or NEES is then in its band, or a sensor fault explains it."""
        return self.is_sufficient or (
            self.corrects_sensor and abs(self.explained_fraction - 1.0) <= SENSOR_CAUSE_TOLERANCE
        )


def interventions_for(
    causes: Iterable[Intervention], filter_name: FilterName, axis: str, statistic: Statistic = "nis"
) -> list[Intervention]:
    """Return the re-runs of one filter and axis that may explain its mean NIS or NEES."""
    return [
        intervention
        for intervention in causes
        if (intervention.statistic, intervention.filter, intervention.axis)
        == (statistic, filter_name, axis)
    ]


def find_cause(
    causes: Iterable[Intervention], filter_name: FilterName, axis: str, statistic: Statistic = "nis"
) -> Intervention | None:
    """Return the cause of a mean NIS or NEES outside its limits; None if no re-run explains it."""
    return min(
        (
            intervention
            for intervention in interventions_for(causes, filter_name, axis, statistic)
            if intervention.is_cause
        ),
        key=lambda intervention: (
            not intervention.is_complete_cause,
            len(intervention.change.keys() - ACCOMPANYING_CHANGES),
            not intervention.corrects_sensor,
            abs(intervention.explained_fraction - 1.0),
        ),
        default=None,
    )


class ErrorAboveSigma(NamedTuple):
    """Position error against ground truth that is larger than the reported σ."""

    nees: float
    rmse_m: float
    reported_sigma_m: float
    nis_mean: float


def error_above_reported_sigma(
    summary: FilterSummary | UntestedFilter,
) -> ErrorAboveSigma | None:
    """Return the position error if it exceeds the reported σ, but innovations do not show this."""
    truth = summary.truth
    if isinstance(summary, Unavailable) or isinstance(truth, Unavailable):
        return None
    nees, rmse_m = truth.nees_position_mean or 0.0, truth.position_rmse_m
    if nees < MIN_NEES_FINDING or truth.is_lag_only or summary.nis_mean >= MAX_UNREMARKABLE_NIS:
        return None
    reported_sigma_m = summary.sigma_p_median_m or rmse_m / float(np.sqrt(nees))
    return ErrorAboveSigma(nees, rmse_m, reported_sigma_m, summary.nis_mean)


@dataclass(frozen=True, kw_only=True)
class Reruns:
    """Re-runs of KF and EKF2 with changes.

    Attributes
    ----------
    ekf2_model : Model or Unavailable
        Model of EKF2 for replays; ``agreement`` compares a replay with the log.
    difference_steps : mapping from axis name to DifferenceExplanation or Unavailable
        Differences KF - EKF2 after each replacement of one KF property by that of EKF2.
    causes : tuple of Intervention
        Re-runs with one change each, and the fraction of an inconsistency that it explains.
    trials : tuple of Trial
        Re-runs along the main axis, with all statistics before and after the change.
    """

    ekf2_model: Model | Unavailable
    difference_steps: Mapping[str, DifferenceExplanation | Unavailable]
    causes: tuple[Intervention, ...]
    trials: tuple[Trial, ...]


Rerun = Callable[[AxisComparison, Change], RunStatistics]


class _Filter(NamedTuple):
    """Filter with the function that runs it along an axis with a change; ``model``: of EKF2."""

    name: FilterName
    rerun: Rerun
    model: Model | None = None

    @property
    def inputs(self) -> Inputs | None:
        return None if self.model is None else self.model.inputs


def run_interventions(
    comparison: Comparison, estimates: Estimates, model: Model | Unavailable
) -> tuple[tuple[Intervention, ...], tuple[Trial, ...]]:
    """Re-run both filters with each change that may explain a discrepancy, and along the main axis.

    ``model`` is EKF2 of the same flight.
    """
    filters = [_Filter("kf", partial(_rerun_kf, comparison, estimates.tuning))]
    if (
        isinstance(model, Model)
        and model.agreement.good
        and is_fused_source(comparison, model.inputs)
    ):
        replays: dict[frozenset[tuple[str, float]], Ekf2Replay] = {}

        def rerun_ekf2(result: AxisComparison, change: Change) -> RunStatistics:
            key = frozenset(change.items())
            if key not in replays:
                replays[key] = _replay_ekf2(comparison, estimates.tuning, model, change)
            return _replay_statistics(comparison, model, replays[key], result, change)

        filters.append(_Filter("ekf2", rerun_ekf2, model))
    causes, trials = list[Intervention](), list[Trial]()
    for each in filters:
        for result, statistic in _find_discrepancies(comparison, each.name):
            changes = candidate_changes(comparison, estimates, each.inputs, result, statistic)
            tried = _try_for_discrepancy(each, result, statistic, changes)
            causes += tried
            if cause := find_cause(tried, each.name, result.axis.name, statistic):
                causes += _difference_reduction(cause, each.rerun, result)
        trials += _try_on_main_axis(comparison, estimates, each)
    return tuple(causes), tuple(trials)


def planned_configurations(
    comparison: Comparison, estimates: Estimates, inputs: Inputs
) -> list[FilterConfiguration]:
    """Return the EKF2 filter configurations that :func:`run_interventions` replays in any case."""
    if not is_fused_source(comparison, inputs):
        return []
    flown = inputs.settings
    changes = [
        change
        for discrepancy in _find_discrepancies(comparison, "ekf2")
        for change in candidate_changes(comparison, estimates, inputs, *discrepancy)
    ]
    if isinstance(comparison.main.filters["ekf2"], FilterSummary):
        changes += main_axis_changes(comparison, estimates, inputs)
    return [
        FilterConfiguration({**flown, **change})
        for change in changes
        if change.keys() <= flown.keys()
    ]


def is_inconsistent(statement: FilterSummary | UntestedFilter) -> TypeGuard[FilterSummary]:
    """Return True if the filter was tested and is over- or underconfident."""
    return not isinstance(statement, Unavailable) and statement.verdict != "consistent"


def _find_discrepancies(
    comparison: Comparison, filter_name: FilterName
) -> list[tuple[AxisComparison, Statistic]]:
    """Return axis and statistic (mean NIS or NEES) of each discrepancy of a filter."""
    found = list[tuple[AxisComparison, Statistic]]()
    for result in comparison.axes.values():
        if filter_name == "ekf2" and result.axis.name == "down":
            continue  # the EKF2 replay is horizontal
        summary = result.filters[filter_name]
        found += [(result, "nees")] if error_above_reported_sigma(summary) else []
        found += [(result, "nis")] if is_inconsistent(summary) else []
    return found


def _try_for_discrepancy(
    each: _Filter, result: AxisComparison, statistic: Statistic, changes: Sequence[Change]
) -> list[Intervention]:
    """Re-run each change that may explain a discrepancy; if none suffices, also pairs."""
    flown = each.rerun(result, {})
    before, nees = flown.value(statistic), flown.nees_mean
    if not before:
        return []
    is_checked_by_truth = statistic == "nis" and before < 1.0
    max_nees = MAX_NEES_AFTER_CHANGE if nees is not None and nees > 1.0 else MIN_NEES_FINDING

    def explain(change: Change) -> list[Intervention]:
        outcome = each.rerun(result, change)
        after = outcome.value(statistic)
        if not after:
            return []
        is_nis = statistic == "nis"
        low, high = nis_band(outcome.innovations) if is_nis else (0.0, MIN_NEES_FINDING)
        nees_after = outcome.nees_mean if is_checked_by_truth else None
        return [
            Intervention(
                statistic=statistic,
                filter=each.name,
                axis=result.axis.name,
                change=change,
                before=before,
                after=after,
                explained_fraction=1.0 - float(np.log(after) / np.log(before)),
                is_sufficient=low <= after <= high,
                contradicts_truth=nees_after is not None and nees_after >= max_nees,
            )
        ]

    singles = [intervention for change in changes for intervention in explain(change)]
    helpful = sorted(
        (
            intervention
            for intervention in singles
            if MIN_HELPFUL_SHARE < intervention.explained_fraction < 2.0 - MIN_HELPFUL_SHARE
        ),
        key=lambda intervention: abs(intervention.explained_fraction - 1.0),
    )
    if not helpful or any(intervention.is_sufficient for intervention in helpful):
        return singles
    best, *others = helpful
    pairs = [explain({**best.change, **other.change}) for other in others]
    return singles + [intervention for pair in pairs for intervention in pair]


def _difference_reduction(
    cause: Intervention, rerun: Rerun, result: AxisComparison
) -> list[Intervention]:
    before, after = (rerun(result, change).difference_rms_m for change in ({}, cause.change))
    if not before or not after:
        return []
    return [
        structs.replace(
            cause,
            statistic="difference",
            before=before,
            after=after,
            explained_fraction=1.0 - (after / before) ** 2,
            is_sufficient=False,
        )
    ]


def _try_on_main_axis(comparison: Comparison, estimates: Estimates, each: _Filter) -> list[Trial]:
    """Re-run each change along the main axis, and the best one with each other one."""
    result, model = comparison.main, each.model
    if not isinstance(result.filters[each.name], FilterSummary):
        return []
    changes = main_axis_changes(comparison, estimates, each.inputs)
    if not changes or (before := _flown_statistics(each, result)) is None:
        return []

    def run(change: Change) -> Trial:
        return Trial(
            filter=each.name,
            kinds=change_kinds(comparison, each.inputs, change),
            change=change,
            before=before,
            after=each.rerun(result, change),
            from_s=None if model is None else model.flown.evaluated_s[0][0],
        )

    singles = [run(change) for change in changes]
    best = min(singles, key=lambda trial: distance_from_one(trial.after))
    if distance_from_one(best.after) >= distance_from_one(before):
        return singles
    others = [trial for trial in singles if best.change.keys().isdisjoint(trial.change)]
    return singles + [run({**best.change, **other.change}) for other in others[:MAX_PAIRS]]


def _flown_statistics(each: _Filter, result: AxisComparison) -> RunStatistics | None:
    """Return the statistics as flown, of the same samples as a re-run; of EKF2 from the log.

    None if the replay of EKF2 as flown has other statistics, so that nothing is comparable.
    """
    replayed, logged = each.rerun(result, {}), result.ekf2_state
    if each.model is None:
        return replayed
    innovations = result.ekf2_innovations
    if isinstance(logged, Unavailable):
        return None
    assert not isinstance(innovations, Unavailable)  # a FilterSummary needs them
    compared_s = each.model.flown.evaluated_s
    state = logged[inside_spans(logged.index, compared_s)]
    innovations = innovations[inside_spans(innovations.index, compared_s)]
    rejected = innovations["rejected"].dropna()
    in_log = _statistics(
        innovations["innovation_m"].to_numpy(),
        innovations["innovation_variance_m2"].to_numpy(),
        error_statistics(state, result.ekf2_variance, result.truth),
        difference(result.replay, state),
        float((rejected > 0.0).mean()) if len(rejected) else None,
    )
    pairs = (
        (in_log.position_rmse_m, replayed.position_rmse_m, MAX_REPLAY_FACTOR),
        (in_log.nis_mean, replayed.nis_mean, MAX_REPLAY_FACTOR**2),
        (in_log.nees_mean, replayed.nees_mean, MAX_REPLAY_FACTOR**2),
    )
    agrees = all(
        one and other and 1.0 / factor <= one / other <= factor
        for one, other, factor in pairs
        if one is not None
    )
    return in_log if agrees else None


def _statistics(
    innovation_m: Array,
    variance_m2: Array,
    errors: ErrorsAgainstTruth | Unavailable,
    kf_minus_ekf2: Difference | Unavailable,
    rejected_fraction: float | None = None,
) -> RunStatistics:
    truth = errors if isinstance(errors, ErrorsAgainstTruth) else None
    has_innovations = len(innovation_m) > 0
    return RunStatistics(
        innovations=len(innovation_m),
        nis_mean=float(np.mean(innovation_m**2 / variance_m2)) if has_innovations else None,
        position_rmse_m=None if truth is None else truth.position_rmse_m,
        nees_mean=None if truth is None else truth.nees_position_mean,
        difference_rms_m=None
        if isinstance(kf_minus_ekf2, Unavailable)
        else kf_minus_ekf2.position_rms_m,
        rejected_fraction=rejected_fraction,
    )


def _rotate_direction(direction: Array, rotation_deg: float) -> Array:
    """Return an NED direction in the frame of positions that are rotated clockwise."""
    return np.asarray(Rotation.from_euler("z", -rotation_deg, degrees=True).apply(direction))


def _rerun_kf(
    comparison: Comparison, tuning: Tuning, result: AxisComparison, change: Change
) -> RunStatistics:
    source, segment, axis = comparison.source, comparison.segment, result.axis
    kf_settings: dict[str, Any] = {
        name: change[name] for name in change if name in vars(Settings())
    }
    settings = replace(comparison.settings, **kf_settings)
    truth, is_gnss_rotation = result.truth, ROTATION in change and source.origin.is_gnss
    if ROTATION in change:
        rotated_direction = _rotate_direction(axis.direction, change[ROTATION])
        measured_m = weighted_sum(
            cut_to_segment(source.samples, segment), Columns.POSITION, rotated_direction
        )
        axis = replace(axis, measurement_m=measured_m[np.isfinite(measured_m)])
        if is_gnss_rotation:
            # GNSS and ground truth both refer to true north, so the attitude is misaligned and
            # not one of them: the rotation applies to both
            rotated_axis = replace(axis, direction=rotated_direction)
            truth = project_truth(comparison.flight.truth, rotated_axis, segment)
    if FORWARD_BIAS in change:
        acceleration = _acceleration_without_bias(comparison, change, axis.direction)
        axis = replace(axis, acceleration=acceleration)
    time_s, tuned = axis.measurement_time_s, tuning_of_axis(tuning, axis.name)
    is_used = np.ones(len(time_s), dtype=bool)
    if OUTLIERS in change and tuned is not None:
        is_used = ~np.isin(time_s, tuned.outlier_time_s)
    shift_s = settings.clock_offset_s - comparison.settings.clock_offset_s
    axis = replace(
        axis,
        measurement_time_s=time_s[is_used] + shift_s,
        measurement_m=axis.measurement_m[is_used],
    )
    run, state = replay(axis, settings, fast=True), result.ekf2_state
    return _statistics(
        run.updates["innovation_m"].to_numpy(),
        run.updates["innovation_variance_m2"].to_numpy(),
        kf_error_statistics(run, truth, state),
        NO_DIFFERENCE
        if is_gnss_rotation or isinstance(state, Unavailable)
        else difference(run, state),
    )


def _acceleration_without_bias(
    comparison: Comparison, change: Change, direction: Array
) -> Acceleration | Unavailable:
    flight, imu = comparison.flight, comparison.flight.imu
    if isinstance(imu, Unavailable):
        return imu
    bias = pd.Series([change[FORWARD_BIAS], change[RIGHT_BIAS], 0.0], Columns.SPECIFIC_FORCE)
    flight = replace(flight, imu=imu.assign(**(imu[Columns.SPECIFIC_FORCE] - bias)))
    return project_acceleration(ned_acceleration(flight), direction, comparison.segment)


def _replay_ekf2(
    comparison: Comparison, tuning: Tuning, model: Model, change: Change
) -> Ekf2Replay:
    if not change:
        return model.flown
    settings = {name: value for name, value in change.items() if name in PARAMETERS}
    changed = with_misaligned_positions(
        model, change.get(ROTATION, 0.0), change.get(CLOCK_OFFSET, 0.0)
    )
    excluded_s, tuned = None, tuning_of_axis(tuning, HORIZONTAL)
    if OUTLIERS in change and tuned is not None:
        excluded_s = tuned.outlier_time_s - comparison.settings.clock_offset_s
        if comparison.source.origin.fused_as_gnss:
            excluded_s += 1e-3 * model.inputs.settings[model.inputs.aid.delay]
        excluded_s += change.get(CLOCK_OFFSET, 0.0)
    (replay,) = replay_settings(changed, [settings], excluded_s)
    return replay


def _replay_statistics(
    comparison: Comparison,
    model: Model,
    ekf2_replay: Ekf2Replay,
    result: AxisComparison,
    change: Change,
) -> RunStatistics:
    """Return the statistics of a replay; without a change the difference is that of the log."""
    compared_s, axis = model.flown.evaluated_s, result.axis
    if ROTATION in change and comparison.source.origin.is_gnss:
        # the change corrects the attitude, so the axis keeps its direction relative to north
        axis = replace(axis, direction=_rotate_direction(axis.direction, -change[ROTATION]))
    weights, updates = axis.direction[:2], ekf2_replay.updates
    updates = updates[inside_spans(updates.index, compared_s)]
    innovation_variance_m2 = weighted_sum(updates, INNOVATION_VARIANCE_COLUMNS, weights**2)
    prior_m2 = innovation_variance_m2 - weighted_sum(updates, OBSERVATION_VARIANCES, weights**2)
    posterior_m2 = weighted_sum(updates, POSITION_VARIANCES, weights**2)
    variance = pd.DataFrame(
        {
            "position_variance_m2": 0.5 * (prior_m2 + posterior_m2),
            "velocity_variance_m2_s2": np.nan,
        },
        index=pd.Index(updates["fused_at_s"].to_numpy()),
    )
    published = project(ekf2_replay.published, axis, comparison.segment)
    published = published[inside_spans(published.index, compared_s)]
    logged, compared = result.ekf2_state, published
    if not change and not isinstance(logged, Unavailable):
        compared = logged[inside_spans(logged.index, compared_s)]
    return _statistics(
        weighted_sum(updates, INNOVATION_COLUMNS, weights),
        innovation_variance_m2,
        error_statistics(published, variance, result.truth),
        difference(result.replay, compared),
        float((updates["rejected"] > 0.0).mean()) if len(updates) else None,
    )
