"""Causes of inconsistent filters, found by re-running a filter with one change at a time.

A discrepancy of a filter is a mean NIS outside its band, or a mean NEES that shows errors larger
than the reported σ. Changes that may explain it are re-run one by one; if none suffices, the best
change is combined with each other one. The cause is the smallest change that brings the statistic
into its band, or else explains at least half of the logarithm of the statistic. A smaller noise is
not a cause if the reported σ would then be smaller than the errors against ground truth. A sensor
fault that explains as much as a setting is preferred: the setting would only hide the fault.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, NamedTuple, TypeGuard

import numpy as np
import pandas as pd
from msgspec import structs
from scipy.spatial.transform import Rotation

from px4fuse.arrays import Array
from px4fuse.comparison.comparison import difference, error_statistics, kf_error_statistics
from px4fuse.comparison.estimates import Tuning, first_axis_tuning
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
from px4fuse.comparison.remedy import is_fused_source, ml_delay_change, noise_change
from px4fuse.comparison.trials import Change, RunStatistics, Statistic, Trial, distance_from_one
from px4fuse.ekf2.filter_recursion import FilterConfiguration
from px4fuse.ekf2.inputs import Inputs
from px4fuse.ekf2.model import Model, replay_settings, with_misaligned_positions
from px4fuse.ekf2.replay import HORIZONTAL as HORIZONTAL_AXES
from px4fuse.ekf2.replay import UPDATE_COLUMNS, Ekf2Replay, inside_spans
from px4fuse.ekf2_parameters import EV_POS, GNSS_VEL, PARAMETERS
from px4fuse.filter.consistency import nis_band
from px4fuse.filter.fast_replay import quick_replay
from px4fuse.filter.frame_rotation import HeadingError
from px4fuse.filter.hypotheses import BiasScaleJumpFit
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import (
    Acceleration,
    cut_to_segment,
    ned_acceleration,
    project_acceleration,
    weighted_sum,
)
from px4fuse.filter.time_offset import ClockOffset
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning
from px4fuse.flight import Columns, Unavailable
from px4fuse.record import Positive, Record

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
CLOCK_OFFSET, ROTATION, OUTLIERS = "clock_offset_s", "turned_deg", "outliers_left_out"
FORWARD_BIAS, RIGHT_BIAS = "bias_forward_m_s2", "bias_right_m_s2"
# Changes that correct a sensor fault; they are preferred to changes of settings
SENSOR_CHANGES = frozenset((OUTLIERS, CLOCK_OFFSET, ROTATION, FORWARD_BIAS))
# Minimum SIGMA_Z (m) of a re-run: accuracy of motion capture in flight
SMALLEST_SIGMA_Z_M = 0.005
SIGMA_A, SIGMA_Z = "sigma_a_m_s2", "sigma_z_m"
# Kind of a change of KF, by the name of the changed setting or data
KF_KINDS = {
    SIGMA_A: "noises",
    SIGMA_Z: "noises",
    OUTLIERS: "outliers",
    CLOCK_OFFSET: "time offset",
    ROTATION: "rotation",
    FORWARD_BIAS: "bias",
    RIGHT_BIAS: "bias",
}
# Parameters that a change of another parameter requires; they do not count as separate changes
ACCOMPANYING_CHANGES = frozenset(("EKF2_DELAY_MAX", EV_POS.noise_mode, RIGHT_BIAS))
SETTING_CHANGES = frozenset((SIGMA_A, SIGMA_Z))
ACC_NOISE = "EKF2_ACC_NOISE"
# Minimum ratio of the estimated SIGMA_A to EKF2_ACC_NOISE for a re-run with a larger
# EKF2_ACC_NOISE: SIGMA_A also covers tilt error and bias
VIBRATION_FACTOR = 3.0
# EKF2 parameters that are re-run with PX4's default value if another value was flown
PARAMETERS_OF_EKF2 = (
    ACC_NOISE,
    "EKF2_GYR_NOISE",
    "EKF2_ACC_B_NOISE",
    "EKF2_GYR_B_NOISE",
    GNSS_VEL.noise,
    GNSS_VEL.gate,
)
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
# Minimum misalignment in standard deviations of its estimate for a re-run with rotated positions
HEADING_SIGMAS = 3.0


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
        Statistic without the change (EKF2: from the log) and with it (from a re-run).
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


def run_interventions(
    comparison: Comparison,
    tuning: Tuning,
    clock: ClockOffset | Unavailable,
    heading: HeadingError | Unavailable,
    bias_scale_jump_fit: BiasScaleJumpFit | Unavailable,
    model: Model | Unavailable,
) -> tuple[tuple[Intervention, ...], tuple[Trial, ...]]:
    """Re-run both filters with each change that may explain a discrepancy, and along the main axis.

    Parameters
    ----------
    comparison : Comparison
    tuning : mapping from axis name, or "horizontal", to AxisTuning or Unavailable
    clock : ClockOffset or Unavailable
    heading : HeadingError or Unavailable
    bias_scale_jump_fit : BiasScaleJumpFit or Unavailable
        Estimate that includes the accelerometer biases.
    model : Model or Unavailable
        EKF2 of the same flight.
    """
    estimates = comparison, tuning, clock, heading
    filters: list[_FilterRerun] = [_KfRerun(*estimates, bias_scale_jump_fit)]
    if (
        isinstance(model, Model)
        and model.agreement.good
        and is_fused_source(comparison, model.inputs)
    ):
        filters.append(_Ekf2Rerun(*estimates, model.inputs, model))
    rows: list[Intervention] = []
    for filter_changes in filters:
        for result, statistic in filter_changes.discrepancies():
            tried_changes = _try_candidates(filter_changes, result, statistic)
            rows += tried_changes
            if cause := find_cause(
                tried_changes, filter_changes.filter_name, result.axis.name, statistic
            ):
                rows += _difference_reduction(cause, result, filter_changes)
    return tuple(rows), tuple(trial for changed in filters for trial in _try_on_main_axis(changed))


def planned_configurations(
    comparison: Comparison,
    tuning: Tuning,
    clock: ClockOffset | Unavailable,
    heading: HeadingError | Unavailable,
    inputs: Inputs,
) -> list[FilterConfiguration]:
    """Return the EKF2 filter configurations that :func:`run_interventions` replays in any case."""
    if not is_fused_source(comparison, inputs):
        return []
    ekf2_changes, flown = _Ekf2Rerun(comparison, tuning, clock, heading, inputs), inputs.settings
    changes = [
        change
        for discrepancy in ekf2_changes.discrepancies()
        for change in ekf2_changes.candidates(*discrepancy)
    ]
    if isinstance(comparison.main.filters["ekf2"], FilterSummary):
        changes += ekf2_changes.changes_on_requested_axis(comparison.main)
    return [
        FilterConfiguration({**flown, **change})
        for change in changes
        if change.keys() <= flown.keys()
    ]


def _difference_reduction(
    cause: Intervention, result: AxisComparison, filter_changes: _FilterRerun
) -> list[Intervention]:
    before, after = (
        filter_changes.outcome(result, change).difference_rms_m for change in ({}, cause.change)
    )
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


def is_inconsistent(statement: FilterSummary | UntestedFilter) -> TypeGuard[FilterSummary]:
    """Return True if the filter was tested and is over- or underconfident."""
    return not isinstance(statement, Unavailable) and statement.verdict != "consistent"


def _find_discrepancies(summary: FilterSummary | UntestedFilter) -> list[Statistic]:
    statistics: list[Statistic] = ["nees"] if error_above_reported_sigma(summary) else []
    return [*statistics, "nis"] if is_inconsistent(summary) else statistics


def _try_candidates(
    filter_changes: _FilterRerun, result: AxisComparison, statistic: Statistic
) -> list[Intervention]:
    """Re-run each change that may explain a discrepancy; if none suffices, also pairs."""
    summary = result.filters[filter_changes.filter_name]
    assert isinstance(summary, FilterSummary)  # else it has no discrepancy
    truth = summary.truth
    nees = None if isinstance(truth, Unavailable) else truth.nees_position_mean
    before = summary.nis_mean if nees is None or statistic == "nis" else nees
    is_checked_by_truth = (
        statistic == "nis" and before < 1.0 and not isinstance(result.truth, Unavailable)
    )

    def rerun(change: Change) -> list[Intervention]:
        outcome = filter_changes.outcome(result, change)
        after = outcome.value(statistic)
        if not after:
            return []
        is_nis = statistic == "nis"
        low, high = nis_band(outcome.innovations) if is_nis else (0.0, MIN_NEES_FINDING)
        nees_after = outcome.nees_mean if is_checked_by_truth else None
        max_nees = MAX_NEES_AFTER_CHANGE if nees is not None and nees > 1.0 else MIN_NEES_FINDING
        return [
            Intervention(
                statistic=statistic,
                filter=filter_changes.filter_name,
                axis=result.axis.name,
                change=change,
                before=before,
                after=after,
                explained_fraction=1.0 - float(np.log(after) / np.log(before)),
                is_sufficient=low <= after <= high,
                contradicts_truth=nees_after is not None and nees_after >= max_nees,
            )
        ]

    single_changes = [
        intervention
        for change in filter_changes.candidates(result, statistic)
        for intervention in rerun(change)
    ]
    helpful_changes = sorted(
        (
            intervention
            for intervention in single_changes
            if MIN_HELPFUL_SHARE < intervention.explained_fraction < 2.0 - MIN_HELPFUL_SHARE
        ),
        key=lambda intervention: abs(intervention.explained_fraction - 1.0),
    )
    if not helpful_changes or any(intervention.is_sufficient for intervention in helpful_changes):
        return single_changes
    best_change, *other_changes = helpful_changes
    return single_changes + [
        intervention
        for other in other_changes
        for intervention in rerun({**best_change.change, **other.change})
    ]


def _outcome(
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


def _try_on_main_axis(changed: _FilterRerun) -> list[Trial]:
    """Re-run each change along the main axis, and the best one with each other one."""
    result, owner = changed.comparison.main, changed.filter_name
    if not isinstance(result.filters[owner], FilterSummary):
        return []
    candidates = changed.changes_on_requested_axis(result)
    if not candidates or (before := changed.flown_outcome(result)) is None:
        return []

    def run(change: Change) -> Trial:
        return Trial(
            filter=owner,
            kinds=("defaults",)
            if change == changed.default_change()
            else tuple(
                dict.fromkeys(
                    changed.kind_of(name) for name in change if name not in ACCOMPANYING_CHANGES
                )
            ),
            change=change,
            before=before,
            after=changed.outcome(result, change),
            from_s=changed.replay_start_s,
        )

    singles = [run(change) for change in candidates]
    best = min(singles, key=lambda trial: distance_from_one(trial.after))
    if distance_from_one(best.after) >= distance_from_one(before):
        return singles
    others = [trial for trial in singles if best.change.keys().isdisjoint(trial.change)]
    return singles + [run({**best.change, **other.change}) for other in others[:MAX_PAIRS]]


def _agrees(logged: RunStatistics, replayed: RunStatistics) -> bool:
    pairs = (
        (logged.position_rmse_m, replayed.position_rmse_m, MAX_REPLAY_FACTOR),
        (logged.nis_mean, replayed.nis_mean, MAX_REPLAY_FACTOR**2),
        (logged.nees_mean, replayed.nees_mean, MAX_REPLAY_FACTOR**2),
    )
    return all(
        one and other and 1.0 / factor <= one / other <= factor
        for one, other, factor in pairs
        if one is not None
    )


def tuning_of_axis(tuning: Tuning, axis: str) -> AxisTuning | None:
    """Return the noise estimate of an axis; of both horizontal axes together if available."""
    return first_axis_tuning(tuning, *(() if axis == "down" else (HORIZONTAL,)), axis)


def _rotate_direction(direction: Array, rotation_deg: float) -> Array:
    """Return an NED direction in the frame of positions that are rotated clockwise."""
    return np.asarray(Rotation.from_euler("z", -rotation_deg, degrees=True).apply(direction))


@dataclass(frozen=True)
class _FilterRerun:
    """Changes of one filter that may explain a discrepancy, and statistics of their re-runs."""

    comparison: Comparison
    tuning: Tuning
    clock: ClockOffset | Unavailable
    heading: HeadingError | Unavailable

    filter_name: ClassVar[FilterName]

    def discrepancies(self) -> list[tuple[AxisComparison, Statistic]]:
        """Return axis and statistic (mean NIS or NEES) of each discrepancy of the filter."""
        return [
            (result, statistic)
            for result in self.comparison.axes.values()
            # EKF2 can be replayed along horizontal axes only
            if self.filter_name == "kf" or result.axis.name != "down"
            for statistic in _find_discrepancies(result.filters[self.filter_name])
        ]

    @abstractmethod
    def noise_candidates(
        self, summary: FilterSummary, tuned: AxisTuning, is_underconfident: bool
    ) -> list[Change]:
        """Return changes to the estimated noises whose 95 % interval excludes the flown value."""

    @abstractmethod
    def other_candidates(self, tuned: AxisTuning | None) -> list[Change]:
        """Return changes of settings that are no position noise, time offset or heading.

        ``tuned`` is None if the reported σ is too large: a larger noise is then no candidate.
        """

    @abstractmethod
    def outcome(self, result: AxisComparison, change: Change) -> RunStatistics:
        """Return the statistics of the filter along an axis with a change, or as flown without."""

    @abstractmethod
    def kind_of(self, name: str) -> str:
        """Return the kind of a change by the name of its setting or parameter."""

    @property
    def replay_start_s(self) -> float | None:
        """Time (s) from which a re-run is evaluated; None for the whole segment."""
        return None

    def default_change(self) -> Change:
        """Return the change to the default settings; empty if there is none."""
        return {}

    def flown_outcome(self, result: AxisComparison) -> RunStatistics | None:
        """Return the statistics as flown, of the same samples as a re-run.

        None if a re-run without a change has other statistics, so that nothing is comparable.
        """
        return self.outcome(result, {})

    def changes_on_requested_axis(self, result: AxisComparison) -> list[Change]:
        """Return each changed setting that is re-run on the requested axis, for NIS or NEES."""
        changes = self.candidates(result, "nis")
        return changes + [
            change for change in self.candidates(result, "nees") if change not in changes
        ]

    def candidates(self, result: AxisComparison, statistic: Statistic) -> list[Change]:
        """Return the changes that may explain a mean NIS or NEES outside its limits."""
        summary, origin = result.filters[self.filter_name], self.comparison.source.origin
        assert isinstance(summary, FilterSummary)  # else it has no discrepancy
        is_underconfident = statistic == "nis" and summary.nis_mean < 1.0
        tuned = tuning_of_axis(self.tuning, result.axis.name)
        changes = list[Change]()
        # innovations do not show the slow errors of GNSS or of a drifting source, so they do not
        # justify a smaller noise
        hides_slow_errors = origin.may_drift or origin.is_gnss
        if tuned is not None and not (is_underconfident and hides_slow_errors):
            changes += self.noise_candidates(summary, tuned, is_underconfident)
        if tuned is not None and not is_underconfident and len(tuned.outlier_time_s):
            changes.append({OUTLIERS: float(len(tuned.outlier_time_s))})
        changes += self.time_offset_candidates()
        if result.axis.name == "down":
            return changes
        if isinstance(heading := self.heading, HeadingError):
            is_significant = abs(heading.misalignment_deg) > HEADING_SIGMAS * heading.sigma_deg
            changes += [{ROTATION: -round(heading.misalignment_deg, 1)}] if is_significant else []
        return changes + self.other_candidates(None if is_underconfident else tuned)

    def time_offset_candidates(self) -> list[Change]:
        """Return a change of the time offset, if its part not yet applied is significant."""
        if isinstance(self.clock, Unavailable) or not self.clock.is_determinable:
            return []
        applied_s = self.comparison.settings.clock_offset_s
        offset_s = applied_s + self.clock.remaining_s
        unapplied_s = offset_s - (applied_s if self.filter_name == "kf" else 0.0)
        is_significant = abs(unapplied_s) > self.clock.three_sigma_s
        return [{CLOCK_OFFSET: round(offset_s, 3)}] if is_significant else []


@dataclass(frozen=True)
class _KfRerun(_FilterRerun):
    bias_scale_jump_fit: BiasScaleJumpFit | Unavailable

    filter_name = "kf"

    def kind_of(self, name: str) -> str:
        return KF_KINDS[name]

    def changes_on_requested_axis(self, result: AxisComparison) -> list[Change]:
        """Return the single changes, both noises together, and the default settings."""
        changes = super().changes_on_requested_axis(result)
        noises = [change for change in changes if change.keys() <= SETTING_CHANGES]
        if len(noises) > 1:
            changes.append({name: value for change in noises for name, value in change.items()})
        defaults = self.default_change()
        return [*changes, *([defaults] if defaults and noises else [])]

    def default_change(self) -> Change:
        """Return the default of each noise that the user set; GNSS uses SIGMA_Z from EKF2."""
        chosen, default = self.comparison.settings, Settings()
        names = (SIGMA_A,) if self.comparison.source.origin.is_gnss else (SIGMA_A, SIGMA_Z)
        return {
            name: getattr(default, name)
            for name in names
            if getattr(chosen, name) != getattr(default, name)
        }

    def noise_candidates(
        self, summary: FilterSummary, tuned: AxisTuning, is_underconfident: bool
    ) -> list[Change]:
        """Return SIGMA_A and SIGMA_Z estimates whose 95 % interval excludes the setting."""
        changes = list[Change]()
        for name, noise in ((SIGMA_A, tuned.sigma_a_two_state), (SIGMA_Z, tuned.sigma_z)):
            chosen_sigma = getattr(self.comparison.settings, name)
            ml_sigma = noise.value or (noise.high if is_underconfident else None) or 0.0
            bound = noise.high if is_underconfident else noise.low
            if noise.value is None and name == SIGMA_Z:
                ml_sigma = max(ml_sigma, SMALLEST_SIGMA_Z_M)
            if (
                ml_sigma
                and bound is not None
                and (chosen_sigma > bound if is_underconfident else chosen_sigma < bound)
            ):
                changes.append({name: float(f"{ml_sigma:.3g}")})
        return changes

    def other_candidates(self, tuned: AxisTuning | None) -> list[Change]:
        """Return the removal of the accelerometer biases, if they are significant."""
        fit = self.bias_scale_jump_fit
        if isinstance(fit, Unavailable) or not fit.has_bias:
            return []
        biases = {FORWARD_BIAS: fit.forward_bias, RIGHT_BIAS: fit.right_bias}
        return [{name: round(bias.value, 3) for name, bias in biases.items()}]

    def _acceleration_without_bias(
        self, change: Change, direction: Array
    ) -> Acceleration | Unavailable:
        flight, imu = self.comparison.flight, self.comparison.flight.imu
        if isinstance(imu, Unavailable):
            return imu
        bias = pd.Series([change[FORWARD_BIAS], change[RIGHT_BIAS], 0.0], Columns.SPECIFIC_FORCE)
        flight = replace(flight, imu=imu.assign(**(imu[Columns.SPECIFIC_FORCE] - bias)))
        corrected_ned = ned_acceleration(flight)
        if isinstance(corrected_ned, Unavailable):
            return corrected_ned
        return project_acceleration(corrected_ned, direction, self.comparison.segment)

    def outcome(self, result: AxisComparison, change: Change) -> RunStatistics:
        source, segment, axis = self.comparison.source, self.comparison.segment, result.axis
        kf_settings: dict[str, Any] = {
            name: change[name] for name in change if name in vars(Settings())
        }
        settings = replace(self.comparison.settings, **kf_settings)
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
                truth = project_truth(self.comparison.flight.truth, rotated_axis, segment)
        if FORWARD_BIAS in change:
            axis = replace(
                axis, acceleration=self._acceleration_without_bias(change, axis.direction)
            )
        time_s, tuned = axis.measurement_time_s, tuning_of_axis(self.tuning, axis.name)
        is_used = np.ones(len(time_s), dtype=bool)
        if OUTLIERS in change and tuned is not None:
            is_used = ~np.isin(time_s, tuned.outlier_time_s)
        shift_s = settings.clock_offset_s - self.comparison.settings.clock_offset_s
        axis = replace(
            axis,
            measurement_time_s=time_s[is_used] + shift_s,
            measurement_m=axis.measurement_m[is_used],
        )
        run, state = quick_replay(axis, settings), result.ekf2_state
        return _outcome(
            run.updates["innovation_m"].to_numpy(),
            run.updates["innovation_variance_m2"].to_numpy(),
            kf_error_statistics(run, truth, state),
            NO_DIFFERENCE
            if is_gnss_rotation or isinstance(state, Unavailable)
            else difference(run, state),
        )


@dataclass(frozen=True)
class _Ekf2Rerun(_FilterRerun):
    """Re-runs of EKF2, which fused the analysed source; without ``model`` only their changes."""

    inputs: Inputs
    model: Model | None = None
    replays: dict[tuple[tuple[str, float], ...], Ekf2Replay] = field(default_factory=dict)

    filter_name = "ekf2"

    def kind_of(self, name: str) -> str:
        aid = self.inputs.aid
        kinds = {aid.noise: "noise", aid.gate: "gate", aid.delay: "delay"}
        return KF_KINDS.get(name) or kinds.get(name, "process noise")

    @property
    def replay_start_s(self) -> float | None:
        """Time (s) from which the replay is evaluated."""
        return None if self.model is None else self.model.flown.evaluated_s[0][0]

    def flown_outcome(self, result: AxisComparison) -> RunStatistics | None:
        """Return the statistics of the log in the replayed spans; None if the replay differs."""
        logged, innovations = result.ekf2_state, result.ekf2_innovations
        if self.model is None or isinstance(logged, Unavailable):
            return None
        assert not isinstance(innovations, Unavailable)  # a FilterSummary needs them
        compared_s = self.model.flown.evaluated_s
        state = logged[inside_spans(logged.index, compared_s)]
        innovations = innovations[inside_spans(innovations.index, compared_s)]
        rejected = innovations["rejected"].dropna()
        in_log = _outcome(
            innovations["innovation_m"].to_numpy(),
            innovations["innovation_variance_m2"].to_numpy(),
            error_statistics(state, result.ekf2_variance, result.truth),
            difference(result.replay, state),
            float((rejected > 0.0).mean()) if len(rejected) else None,
        )
        return in_log if _agrees(in_log, self.outcome(result, {})) else None

    def changes_on_requested_axis(self, result: AxisComparison) -> list[Change]:
        """Return changes of one setting; a delay also as a shift of the position timestamps."""
        changes = super().changes_on_requested_axis(result)
        delays = [change for change in changes if self.inputs.aid.delay in change]
        offsets = super().time_offset_candidates() if delays else []
        return [*changes, *(offset for offset in offsets if offset not in changes)]

    @property
    def flown_noise_m(self) -> float:
        """Median √R (m) of EKF2 as flown."""
        aid, flown = self.inputs.aid, self.inputs.settings
        uses_reported = not aid.noise_mode or flown[aid.noise_mode] != 1.0
        reported_m2 = self.inputs.received.variance_m2[:, :2] * uses_reported
        return float(np.sqrt(np.median(np.maximum(reported_m2, flown[aid.noise] ** 2))))

    def time_offset_candidates(self) -> list[Change]:
        """Return a change of EKF2's delay parameter, else a shift of the timestamps."""
        delay = ml_delay_change(self.comparison, self.inputs, self.clock)
        return [delay] if delay else super().time_offset_candidates()

    def other_candidates(self, tuned: AxisTuning | None) -> list[Change]:
        """Return PX4's default of the gate and other parameters, and a noise for vibration."""
        aid, flown = self.inputs.aid, self.inputs.settings
        log = self.comparison.flight.log
        default_values = {name: log.default_of(name) for name in (aid.gate, *PARAMETERS_OF_EKF2)}
        changes: list[Change] = [
            {name: value}
            for name, value in default_values.items()
            if name in flown
            and not np.isclose(flown[name], value, rtol=1e-3)
            and (name != aid.gate or flown[name] < value)
        ]
        vibration_change = {} if tuned is None else self._vibration_noise(tuned)
        return [*changes, vibration_change] if vibration_change else changes

    def _vibration_noise(self, tuned: AxisTuning) -> Change:
        """Return the maximum-likelihood process noise for vibration, within PX4's range.

        EKF2 adds (EKF2_ACC_NOISE · step)² to the velocity variance in each step; KF adds
        SIGMA_A² · DT² in each DT.
        """
        steps = self.comparison.settings.dt_s / self.inputs.step_s
        flown, px4_maximum = self.inputs.settings[ACC_NOISE], PARAMETERS[ACC_NOISE].maximum
        if (tuned.sigma_a_two_state.low or 0.0) * steps**0.5 <= VIBRATION_FACTOR * flown:
            return {}
        ml_noise = min((tuned.sigma_a_two_state.value or 0.0) * steps**0.5, px4_maximum)
        return {ACC_NOISE: float(f"{ml_noise:.2g}")} if ml_noise > flown else {}

    def noise_candidates(
        self, summary: FilterSummary, tuned: AxisTuning, is_underconfident: bool
    ) -> list[Change]:
        """Return the estimated position noise if its 95 % interval excludes EKF2's value."""
        noise = tuned.sigma_z
        if (noise.low or 0.0) <= self.flown_noise_m <= (noise.high or np.inf):
            return []
        proposed_noise_m = noise.value
        if proposed_noise_m is None:  # the RMS of EKF2's innovations is an upper bound of the noise
            proposed_noise_m = float(np.hypot(summary.innovation_std_m, summary.innovation_mean_m))
        return [
            noise_change(
                self.inputs.aid, self.inputs.settings, self.flown_noise_m, proposed_noise_m
            )
        ]

    def outcome(self, result: AxisComparison, change: Change) -> RunStatistics:
        """Replay EKF2 with the change; without a change the difference is that of the log."""
        assert self.model is not None
        compared_s, axis = self.model.flown.evaluated_s, result.axis
        ekf2_replay = self._replay_with(self.model, change)
        if ROTATION in change and self.comparison.source.origin.is_gnss:
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
        published = project(ekf2_replay.published, axis, self.comparison.segment)
        published = published[inside_spans(published.index, compared_s)]
        logged, compared = result.ekf2_state, published
        if not change and not isinstance(logged, Unavailable):
            compared = logged[inside_spans(logged.index, compared_s)]
        return _outcome(
            weighted_sum(updates, INNOVATION_COLUMNS, weights),
            innovation_variance_m2,
            error_statistics(published, variance, result.truth),
            difference(result.replay, compared),
            float((updates["rejected"] > 0.0).mean()) if len(updates) else None,
        )

    def _replay_with(self, model: Model, change: Change) -> Ekf2Replay:
        if not change:
            return model.flown
        key = tuple(sorted(change.items()))
        if key not in self.replays:
            settings = {name: value for name, value in change.items() if name in PARAMETERS}
            model = with_misaligned_positions(
                model, change.get(ROTATION, 0.0), change.get(CLOCK_OFFSET, 0.0)
            )
            excluded_s, tuned = None, tuning_of_axis(self.tuning, HORIZONTAL)
            if OUTLIERS in change and tuned is not None:
                excluded_s = tuned.outlier_time_s - self.comparison.settings.clock_offset_s
                if self.comparison.source.origin.fused_as_gnss:
                    excluded_s += 1e-3 * self.inputs.settings[self.inputs.aid.delay]
                excluded_s += change.get(CLOCK_OFFSET, 0.0)
            (self.replays[key],) = replay_settings(model, [settings], excluded_s)
        return self.replays[key]
