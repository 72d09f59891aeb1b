"""Causes of inconsistency, found by re-running a filter with one change at a time.

A discrepancy is a mean NIS outside its band, or errors larger than the reported σ (mean NEES). Each
candidate change is re-run alone; if none suffices, the best one is combined with each other one. A
cause is the smallest change that brings the statistic into its band, or else explains at least half
of its logarithm. A smaller noise is not a cause if the reported σ would then be smaller than the
errors against ground truth. A fault of a sensor that explains as much as a setting comes first: the
setting would only hide it.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal, NamedTuple, TypeGuard

import numpy as np
import pandas as pd
from msgspec import structs
from scipy.spatial.transform import Rotation

from px4fuse.arrays import Array
from px4fuse.comparison.comparison import difference, error_statistics, kf_error_statistics
from px4fuse.comparison.estimates import Tuning, first_axis_tuning
from px4fuse.comparison.model import (
    AgainstTruth,
    AxisComparison,
    Comparison,
    Difference,
    FilterName,
    FilterSummary,
    UnjudgedFilter,
)
from px4fuse.comparison.projection import project, project_truth
from px4fuse.comparison.remedy import is_fused_source, ml_delay_change, noise_change
from px4fuse.ekf2.filter_recursion import Variant
from px4fuse.ekf2.inputs import Inputs
from px4fuse.ekf2.model import Model, replay_settings, with_misaligned_positions
from px4fuse.ekf2.replay import HORIZONTAL as LEVEL
from px4fuse.ekf2.replay import UPDATE_COLUMNS, Ekf2Replay, inside_spans
from px4fuse.ekf2_parameters import EV_POS, GNSS_VEL, PARAMETERS
from px4fuse.filter.consistency import nis_band
from px4fuse.filter.fast_replay import quick_replay
from px4fuse.filter.frame_rotation import HeadingError
from px4fuse.filter.hypotheses import BiasScaleJumpFit
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import (
    Acceleration,
    along,
    ned_acceleration,
    project_acceleration,
    within,
)
from px4fuse.filter.time_offset import ClockOffset
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning
from px4fuse.flight import Columns, Unavailable
from px4fuse.record import Count, NotNegative, Positive, Record, Share

Statistic = Literal["nis", "nees", "difference"]
Change = Mapping[str, float]
# Mean NEES from which errors exceed the reported σ (by 2 in σ); below 3 without a fault
MIN_NEES_FINDING = 4.0
# Largest mean NEES after a change to a smaller noise, if the mean NEES was above 1 before
MAX_NEES_AFTER_CHANGE = 2.0
# Mean NIS above which the innovations already show that the σ is too small
MAX_UNSUSPICIOUS_NIS = 1.5
# Share of ln(statistic) that a cause explains: at least this, at most 2 minus this
MIN_EXPLAINED_SHARE = 0.5
# Distance from the whole logarithm within which a sensor fault suffices: noises are approximate
SUFFICIENT_TOLERANCE = 0.25
# Share of ln(statistic) that a change must explain to be combined with the best one
MIN_HELPFUL_SHARE = 0.1
CLOCK, TURN, OUTLIERS = "clock_offset_s", "turned_deg", "outliers_left_out"
FORWARD, RIGHT = "bias_forward_m_s2", "bias_right_m_s2"
# Changes that correct a sensor; they precede changes of settings
SENSOR_CHANGES = frozenset((OUTLIERS, CLOCK, TURN, FORWARD))
# m; smallest SIGMA_Z of a re-run: accuracy of motion capture in flight
SMALLEST_SIGMA_Z_M = 0.005
SIGMA_A, SIGMA_Z = "sigma_a_m_s2", "sigma_z_m"
# Kind of a change by its name
KF_KINDS = {
    SIGMA_A: "noises",
    SIGMA_Z: "noises",
    OUTLIERS: "outliers",
    CLOCK: "time offset",
    TURN: "rotation",
    FORWARD: "bias",
    RIGHT: "bias",
}
# Parts of a change that do not count as separate changes
ACCOMPANYING_CHANGES = frozenset(("EKF2_DELAY_MAX", EV_POS.noise_mode, RIGHT))
SETTING_CHANGES = frozenset((SIGMA_A, SIGMA_Z))
ACC_NOISE = "EKF2_ACC_NOISE"
# SIGMA_A also covers tilt error and bias, so EKF2_ACC_NOISE is raised only above this factor
VIBRATION_FACTOR = 3.0
# Parameters of EKF2 that are re-run with PX4's default if another value was flown
PARAMETERS_OF_EKF2 = (
    ACC_NOISE,
    "EKF2_GYR_NOISE",
    "EKF2_ACC_B_NOISE",
    "EKF2_GYR_B_NOISE",
    GNSS_VEL.noise,
    GNSS_VEL.gate,
)
# Columns of north and east
INNOVATION_COLUMNS, INNOVATION_VARIANCE_COLUMNS = UPDATE_COLUMNS[:2], UPDATE_COLUMNS[2:4]
POSITION_VARIANCES = [f"position_variance_{axis}_m2" for axis in LEVEL]
OBSERVATION_VARIANCES = [f"observation_variance_{axis}_m2" for axis in LEVEL]
NO_DIFFERENCE = Unavailable(
    "difference KF - EKF2", "the filters use different frames after the change", ""
)
# Ratio of replay and log as flown within which a prediction of EKF2 is printed
MAX_REPLAY_FACTOR = 1.10
# Further changes that are combined with the best one
MAX_PAIRS = 4
# Misalignments within this many σ are not significant
HEADING_SIGMAS = 3.0


class Outcome(Record, frozen=True, kw_only=True):
    """Statistics of one filter along one axis in one run.

    Attributes
    ----------
    innovations : int
    nis_mean : float or None
    position_rmse_m, nees_mean : float or None
        Against ground truth, at the times of EKF2's published state.
    difference_rms_m : float or None
        RMS of KF - EKF2 in position.
    rejected_fraction : float or None
        Of EKF2; None for KF, which has no gate.
    """

    innovations: Count = 0
    nis_mean: Positive | None = None
    position_rmse_m: NotNegative | None = None
    nees_mean: NotNegative | None = None
    difference_rms_m: NotNegative | None = None
    rejected_fraction: Share | None = None

    def value(self, statistic: Statistic) -> float | None:
        """Return one of the three statistics."""
        return {
            "nis": self.nis_mean,
            "nees": self.nees_mean,
            "difference": self.difference_rms_m,
        }[statistic]


class Trial(Record, frozen=True, kw_only=True):
    """Re-run of one filter along the main axis with one or two changes.

    Attributes
    ----------
    filter : {"kf", "ekf2"}
    kinds : tuple of str
        Kind of each change: noises, defaults, outliers, time offset, delay, rotation, bias, noise,
        gate or process noise.
    change : mapping from name to value
        See :class:`Intervention`.
    before : Outcome
        As flown, of the same samples: KF as run, EKF2 from the log.
    after : Outcome
        With the change; EKF2 by its replay.
    from_s : float or None
        Start of the replay.
    """

    filter: FilterName
    kinds: tuple[str, ...]
    change: Change
    before: Outcome
    after: Outcome
    from_s: float | None = None


class Intervention(Record, frozen=True, kw_only=True):
    """One change, and the statistic before and after it.

    Attributes
    ----------
    statistic : {"nis", "nees", "difference"}
        Statistic: mean NIS, mean NEES of position, or RMS difference KF - EKF2 (m). The last one is
        computed for causes only.
    filter : {"kf", "ekf2"}
    axis : str
    change : mapping from name to value
        Fields of Settings, PX4 parameters, ``turned_deg`` (rotation of the positions, clockwise
        from above), ``outliers_left_out`` (number), and the removed accelerometer biases
        ``bias_forward_m_s2`` and ``bias_right_m_s2``.
    before, after : float
        Statistic without the change (EKF2: from the log) and with it (from a re-run).
    explained_fraction : float
        Share of ln(statistic) that the change removes; above 1 it overshoots. For the RMS
        difference, the share of the mean square.
    is_sufficient : bool
        True if the mean NIS is in its 95 % band, or the mean NEES below
        :data:`MIN_NEES_FINDING`.
    contradicts_truth : bool
        True if the reported σ would then be smaller than the errors.
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
        """True if it explains at least half of ln(statistic) and does not overshoot by more."""
        return (
            MIN_EXPLAINED_SHARE <= self.explained_fraction <= 2.0 - MIN_EXPLAINED_SHARE
            and not self.contradicts_truth
        )

    @property
    def of_sensors(self) -> bool:
        """True if it corrects a sensor, which precedes changes of settings."""
        return not SENSOR_CHANGES.isdisjoint(self.change)

    @property
    def needs_no_other(self) -> bool:
        """True if no other cause is needed: in the band, or nearly all by a sensor."""
        return self.is_sufficient or (
            self.of_sensors and abs(self.explained_fraction - 1.0) <= SUFFICIENT_TOLERANCE
        )


def interventions_on(
    causes: Iterable[Intervention], owner: FilterName, axis: str, statistic: Statistic = "nis"
) -> list[Intervention]:
    """Return the re-runs for one discrepancy."""
    return [
        intervention
        for intervention in causes
        if (intervention.statistic, intervention.filter, intervention.axis)
        == (statistic, owner, axis)
    ]


def cause_of(
    causes: Iterable[Intervention], owner: FilterName, axis: str, statistic: Statistic = "nis"
) -> Intervention | None:
    """Return the cause of one discrepancy, or None if no re-run explains it."""
    return min(
        (
            intervention
            for intervention in interventions_on(causes, owner, axis, statistic)
            if intervention.is_cause
        ),
        key=lambda intervention: (
            not intervention.needs_no_other,
            len(intervention.change.keys() - ACCOMPANYING_CHANGES),
            not intervention.of_sensors,
            abs(intervention.explained_fraction - 1.0),
        ),
        default=None,
    )


class ErrorBeyondSigma(NamedTuple):
    """Position RMSE and NEES against ground truth, larger than the reported σ."""

    nees: float
    rmse_m: float
    reported_sigma_m: float
    nis_mean: float


def error_beyond_reported_sigma(
    statement: FilterSummary | UnjudgedFilter,
) -> ErrorBeyondSigma | None:
    """Return the errors if they exceed the reported σ without effect on the innovations."""
    truth = statement.truth
    if isinstance(statement, Unavailable) or isinstance(truth, Unavailable):
        return None
    nees, rmse_m = truth.nees_position_mean or 0.0, truth.position_rmse_m
    if nees < MIN_NEES_FINDING or statement.nis_mean >= MAX_UNSUSPICIOUS_NIS:
        return None
    reported_sigma_m = statement.sigma_p_median_m or rmse_m / float(np.sqrt(nees))
    return ErrorBeyondSigma(nees, rmse_m, reported_sigma_m, statement.nis_mean)


def interventions(
    comparison: Comparison,
    tuning: Tuning,
    clock: ClockOffset | Unavailable,
    heading: HeadingError | Unavailable,
    bias_scale_jump_fit: BiasScaleJumpFit | Unavailable,
    model: Model | Unavailable,
) -> tuple[tuple[Intervention, ...], tuple[Trial, ...]]:
    """Re-run every candidate change for every discrepancy, and along the main axis.

    Parameters
    ----------
    comparison : Comparison
    tuning : mapping from axis name, or "horizontal", to AxisTuning or Unavailable
    clock : ClockOffset or Unavailable
    heading : HeadingError or Unavailable
    bias_scale_jump_fit : BiasScaleJumpFit or Unavailable
        Contains the accelerometer biases.
    model : Model or Unavailable
        EKF2 of the same flight.
    """
    estimates = comparison, tuning, clock, heading
    filters: list[_FilterChanges] = [_KfChanges(*estimates, bias_scale_jump_fit)]
    if (
        isinstance(model, Model)
        and model.agreement.good
        and is_fused_source(comparison, model.inputs)
    ):
        filters.append(_Ekf2Changes(*estimates, model.inputs, model))
    rows: list[Intervention] = []
    for changed in filters:
        for result, statistic in changed.discrepancies():
            tried_changes = _try_candidates(changed, result, statistic)
            rows += tried_changes
            if cause := cause_of(tried_changes, changed.owner, result.axis.name, statistic):
                rows += _difference_reduction(cause, result, changed)
    return tuple(rows), tuple(trial for changed in filters for trial in _try_on_main_axis(changed))


def planned_variants(
    comparison: Comparison,
    tuning: Tuning,
    clock: ClockOffset | Unavailable,
    heading: HeadingError | Unavailable,
    inputs: Inputs,
) -> list[Variant]:
    """Return the EKF2 variants that :func:`interventions` will need, as far as known.

    Variants that are missing here are replayed on demand.
    """
    if not is_fused_source(comparison, inputs):
        return []
    ekf2_changes, flown = _Ekf2Changes(comparison, tuning, clock, heading, inputs), inputs.settings
    changes = [
        change
        for discrepancy in ekf2_changes.discrepancies()
        for change in ekf2_changes.candidates(*discrepancy)
    ]
    if isinstance(comparison.main.filters["ekf2"], FilterSummary):
        changes += ekf2_changes.main_axis_candidates(comparison.main)
    return [Variant({**flown, **change}) for change in changes if change.keys() <= flown.keys()]


def _difference_reduction(
    cause: Intervention, result: AxisComparison, changed: _FilterChanges
) -> list[Intervention]:
    """Compute the RMS difference KF - EKF2 (m) with and without a cause."""
    before, after = (
        changed.outcome(result, change).difference_rms_m for change in ({}, cause.change)
    )
    if not before or not after:
        return []
    explained_share = 1.0 - (after / before) ** 2
    return [
        structs.replace(
            cause,
            statistic="difference",
            before=before,
            after=after,
            explained_fraction=explained_share,
            is_sufficient=False,
        )
    ]


def is_inconsistent(statement: FilterSummary | UnjudgedFilter) -> TypeGuard[FilterSummary]:
    """Return True if the filter was tested and is not consistent."""
    return not isinstance(statement, Unavailable) and statement.verdict != "consistent"


def _find_discrepancies(statement: FilterSummary | UnjudgedFilter) -> list[Statistic]:
    """Return the statistics of a filter that are outside their limits."""
    found: list[Statistic] = ["nees"] if error_beyond_reported_sigma(statement) else []
    return [*found, "nis"] if is_inconsistent(statement) else found


def _try_candidates(
    changed: _FilterChanges, result: AxisComparison, statistic: Statistic
) -> list[Intervention]:
    """Re-run all candidates alone; if none suffices, combine the best with each other one."""
    statement, candidates = result.filters[changed.owner], changed.candidates(result, statistic)
    assert isinstance(statement, FilterSummary)  # else it has no discrepancy
    truth = statement.truth
    nees = None if isinstance(truth, Unavailable) else truth.nees_position_mean
    before = statement.nis_mean if nees is None or statistic == "nis" else nees
    is_checked_by_truth = (
        statistic == "nis" and before < 1.0 and not isinstance(result.truth, Unavailable)
    )

    def rerun(change: Change) -> list[Intervention]:
        outcome = changed.outcome(result, change)
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
                filter=changed.owner,
                axis=result.axis.name,
                change=change,
                before=before,
                after=after,
                explained_fraction=1.0 - float(np.log(after) / np.log(before)),
                is_sufficient=low <= after <= high,
                contradicts_truth=nees_after is not None and nees_after >= max_nees,
            )
        ]

    single_changes = [each for change in candidates for each in rerun(change)]
    helpful_changes = sorted(
        (
            intervention
            for intervention in single_changes
            if MIN_HELPFUL_SHARE < intervention.explained_fraction < 2.0 - MIN_HELPFUL_SHARE
        ),
        key=lambda intervention: abs(intervention.explained_fraction - 1.0),
    )
    if not helpful_changes or any(each.is_sufficient for each in helpful_changes):
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
    errors: AgainstTruth | Unavailable,
    kf_minus_ekf2: Difference | Unavailable,
    rejected_fraction: float | None = None,
) -> Outcome:
    """Collect the statistics of one run; those that cannot be computed are None."""
    truth = errors if isinstance(errors, AgainstTruth) else None
    has_innovations = len(innovation_m) > 0
    return Outcome(
        innovations=len(innovation_m),
        nis_mean=float(np.mean(innovation_m**2 / variance_m2)) if has_innovations else None,
        position_rmse_m=None if truth is None else truth.position_rmse_m,
        nees_mean=None if truth is None else truth.nees_position_mean,
        difference_rms_m=None
        if isinstance(kf_minus_ekf2, Unavailable)
        else kf_minus_ekf2.position_rms_m,
        rejected_fraction=rejected_fraction,
    )


def _try_on_main_axis(changed: _FilterChanges) -> list[Trial]:
    """Run all candidate changes along the main axis, and the best one with each other one."""
    result, owner = changed.comparison.main, changed.owner
    if not isinstance(result.filters[owner], FilterSummary):
        return []
    candidates = changed.main_axis_candidates(result)
    if not candidates:
        return []
    before = changed.flown_outcome(result)
    if before is None:
        return []

    def run(change: Change) -> Trial:
        return Trial(
            filter=owner,
            kinds=tuple(
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


def distance_from_one(outcome: Outcome) -> float:
    """Return the sum of |ln ratio| of actual to reported σ, against source and ground truth."""
    means = [mean for mean in (outcome.nis_mean, outcome.nees_mean) if mean]
    return sum(0.5 * abs(float(np.log(mean))) for mean in means)


def _agrees(logged: Outcome, replayed: Outcome) -> bool:
    """Return True if a replay as flown has the RMSE and the ratios of the log within 10 %."""
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
    """Return the tuning of an axis: for horizontal axes the common one if available."""
    return first_axis_tuning(tuning, *(() if axis == "down" else (HORIZONTAL,)), axis)


def _rotate_direction(direction: Array, rotation_deg: float) -> Array:
    """Return a direction in the frame of positions that are rotated clockwise from above."""
    return np.asarray(Rotation.from_euler("z", -rotation_deg, degrees=True).apply(direction))


@dataclass(frozen=True)
class _FilterChanges:
    """Candidate changes of one filter, and its statistics after a change."""

    comparison: Comparison
    tuning: Tuning
    clock: ClockOffset | Unavailable
    heading: HeadingError | Unavailable

    owner: ClassVar[FilterName]

    def discrepancies(self) -> list[tuple[AxisComparison, Statistic]]:
        """Return the discrepancies with their axes; for EKF2 along horizontal axes only."""
        return [
            (result, statistic)
            for result in self.comparison.axes.values()
            if self.owner == "kf" or result.axis.name != "down"
            for statistic in _find_discrepancies(result.filters[self.owner])
        ]

    @abstractmethod
    def noise_candidates(
        self, statement: FilterSummary, tuned: AxisTuning, over: bool
    ) -> list[Change]:
        """Return maximum-likelihood noises whose interval excludes the value in use."""

    @abstractmethod
    def other_candidates(self, tuned: AxisTuning | None) -> list[Change]:
        """Return further candidates; ``tuned`` is None if the reported σ is too large."""

    @abstractmethod
    def outcome(self, result: AxisComparison, change: Change) -> Outcome:
        """Run the filter along an axis with a change; without one, as flown."""

    @abstractmethod
    def kind_of(self, name: str) -> str:
        """Return the kind of a change by the name of its setting or parameter."""

    @property
    def replay_start_s(self) -> float | None:
        """Time (s) from which a re-run is evaluated; None for the whole segment."""
        return None

    def flown_outcome(self, result: AxisComparison) -> Outcome | None:
        """Return the statistics as flown, of the same samples as a re-run.

        None if a re-run without a change has other statistics, so that nothing is comparable.
        """
        return self.outcome(result, {})

    def main_axis_candidates(self, result: AxisComparison) -> list[Change]:
        """Return the candidate changes along the main axis, each once."""
        changes: list[Change] = []
        for statistic in ("nis", "nees"):
            changes += [
                change for change in self.candidates(result, statistic) if change not in changes
            ]
        return changes

    def candidates(self, result: AxisComparison, statistic: Statistic) -> list[Change]:
        """Return the candidate changes for a discrepancy along an axis."""
        statement, origin = result.filters[self.owner], self.comparison.source.origin
        assert isinstance(statement, FilterSummary)  # else it has no discrepancy
        is_underconfident = statistic == "nis" and statement.nis_mean < 1.0
        tuned = tuning_of_axis(self.tuning, result.axis.name)
        changes = list[Change]()
        # innovations against GNSS or a drifting source do not show its slow errors
        hides_noise = origin.may_drift or origin.is_gnss
        if tuned is not None and not (is_underconfident and hides_noise):
            changes += self.noise_candidates(statement, tuned, is_underconfident)
        if tuned is not None and not is_underconfident and len(tuned.outlier_time_s):
            changes.append({OUTLIERS: float(len(tuned.outlier_time_s))})
        changes += self.time_offset_candidates()
        if result.axis.name == "down":
            return changes
        if isinstance(turn := self.heading, HeadingError):
            is_significant = abs(turn.misalignment_deg) > HEADING_SIGMAS * turn.sigma_deg
            changes += [{TURN: -round(turn.misalignment_deg, 1)}] if is_significant else []
        return changes + self.other_candidates(None if is_underconfident else tuned)

    def time_offset_candidates(self) -> list[Change]:
        """Return the time offset if the part that the filter does not apply is significant."""
        if isinstance(self.clock, Unavailable) or not self.clock.is_determinable:
            return []
        applied_s = self.comparison.settings.clock_offset_s
        offset_s = applied_s + self.clock.remaining_s
        missing_s = offset_s - (applied_s if self.owner == "kf" else 0.0)
        return [{CLOCK: round(offset_s, 3)}] if abs(missing_s) > self.clock.three_sigma_s else []


@dataclass(frozen=True)
class _KfChanges(_FilterChanges):
    """KF with changes."""

    bias_scale_jump_fit: BiasScaleJumpFit | Unavailable

    owner = "kf"

    def kind_of(self, name: str) -> str:
        """Return the kind of a change of KF."""
        return KF_KINDS[name]

    def main_axis_candidates(self, result: AxisComparison) -> list[Change]:
        """Return the candidates, both noises together, and the default settings."""
        changes = super().main_axis_candidates(result)
        noises = [change for change in changes if change.keys() <= SETTING_CHANGES]
        if len(noises) > 1:
            changes.append({name: value for change in noises for name, value in change.items()})
        chosen, default = self.comparison.settings, Settings()
        names = (SIGMA_A,) if self.comparison.source.origin.is_gnss else (SIGMA_A, SIGMA_Z)
        defaults = {
            name: getattr(default, name)
            for name in names
            if getattr(chosen, name) != getattr(default, name)
        }
        return [*changes, *([defaults] if defaults and noises else [])]

    def noise_candidates(
        self, statement: FilterSummary, tuned: AxisTuning, over: bool
    ) -> list[Change]:
        """Return SIGMA_A and SIGMA_Z whose interval excludes the value in use."""
        changes = list[Change]()
        for name, noise in ((SIGMA_A, tuned.sigma_a_two_state), (SIGMA_Z, tuned.sigma_z)):
            chosen_sigma = getattr(self.comparison.settings, name)
            ml_sigma = noise.value or (noise.high if over else None) or 0.0
            bound = noise.high if over else noise.low
            if noise.value is None and name == SIGMA_Z:
                ml_sigma = max(ml_sigma, SMALLEST_SIGMA_Z_M)
            if (
                ml_sigma
                and bound is not None
                and (chosen_sigma > bound if over else chosen_sigma < bound)
            ):
                changes.append({name: float(f"{ml_sigma:.3g}")})
        return changes

    def other_candidates(self, tuned: AxisTuning | None) -> list[Change]:
        """Return the accelerometer biases if they are significant."""
        if (
            isinstance(self.bias_scale_jump_fit, Unavailable)
            or not self.bias_scale_jump_fit.has_bias
        ):
            return []
        forward, right = self.bias_scale_jump_fit.forward_bias, self.bias_scale_jump_fit.right_bias
        return [{FORWARD: round(forward.value, 3), RIGHT: round(right.value, 3)}]

    def _acceleration_without_bias(
        self, change: Change, direction: Array
    ) -> Acceleration | Unavailable:
        """Return the acceleration along a direction after removal of the accelerometer biases."""
        flight, imu = self.comparison.flight, self.comparison.flight.imu
        if isinstance(imu, Unavailable):
            return imu
        bias = pd.Series([change[FORWARD], change[RIGHT], 0.0], Columns.SPECIFIC_FORCE)
        flight = replace(flight, imu=imu.assign(**(imu[Columns.SPECIFIC_FORCE] - bias)))
        corrected_ned = ned_acceleration(flight)
        if isinstance(corrected_ned, Unavailable):
            return corrected_ned
        return project_acceleration(corrected_ned, direction, self.comparison.segment)

    def outcome(self, result: AxisComparison, change: Change) -> Outcome:
        """Run KF with the change."""
        source, segment, axis = self.comparison.source, self.comparison.segment, result.axis
        kf_settings: dict[str, Any] = {
            name: change[name] for name in change if name in vars(Settings())
        }
        settings = replace(self.comparison.settings, **kf_settings)
        truth, is_gnss_rotation = result.truth, TURN in change and source.origin.is_gnss
        if TURN in change:
            rotated_direction = _rotate_direction(axis.direction, change[TURN])
            measured_m = along(within(source.samples, segment), Columns.POSITION, rotated_direction)
            axis = replace(axis, measurement_m=measured_m[np.isfinite(measured_m)])
            if (
                is_gnss_rotation
            ):  # GNSS and ground truth refer to true north; the attitude is misaligned
                rotated_axis = replace(axis, direction=rotated_direction)
                truth = project_truth(self.comparison.flight.truth, rotated_axis, segment)
        if FORWARD in change:
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
class _Ekf2Changes(_FilterChanges):
    """EKF2 with changes, if it fused the analysed source.

    Without ``model`` only the candidates are available.
    """

    inputs: Inputs
    model: Model | None = None
    replays: dict[tuple[tuple[str, float], ...], Ekf2Replay] = field(default_factory=dict)

    owner = "ekf2"

    def kind_of(self, name: str) -> str:
        """Return the kind of a change of EKF2."""
        aid = self.inputs.aid
        kinds = {aid.noise: "noise", aid.gate: "gate", aid.delay: "delay"}
        return KF_KINDS.get(name) or kinds.get(name, "process noise")

    @property
    def replay_start_s(self) -> float | None:
        """Time (s) from which the replay is evaluated."""
        return None if self.model is None else self.model.flown.evaluated_s[0][0]

    def flown_outcome(self, result: AxisComparison) -> Outcome | None:
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

    def main_axis_candidates(self, result: AxisComparison) -> list[Change]:
        """Return the candidates; a delay also as a shift of the timestamps by the sender."""
        changes = super().main_axis_candidates(result)
        delays = [change for change in changes if self.inputs.aid.delay in change]
        offsets = super().time_offset_candidates() if delays else []
        return [*changes, *(offset for offset in offsets if offset not in changes)]

    @property
    def used_m(self) -> float:
        """Median √R (m) as flown."""
        aid, flown = self.inputs.aid, self.inputs.settings
        takes_stated = not aid.noise_mode or flown[aid.noise_mode] != 1.0
        stated = self.inputs.received.variance_m2[:, :2] * takes_stated
        return float(np.sqrt(np.median(np.maximum(stated, flown[aid.noise] ** 2))))

    def time_offset_candidates(self) -> list[Change]:
        """Return a change of EKF2's delay, or else a shift of the timestamps."""
        delay = ml_delay_change(self.comparison, self.inputs, self.clock)
        return [delay] if delay else super().time_offset_candidates()

    def other_candidates(self, tuned: AxisTuning | None) -> list[Change]:
        """Return the default gate, other PX4 defaults, and the process noise for vibration."""
        aid, flown = self.inputs.aid, self.inputs.settings
        default_values = {
            name: PARAMETERS[name].default for name in (aid.gate, *PARAMETERS_OF_EKF2)
        }
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
        self, statement: FilterSummary, tuned: AxisTuning, over: bool
    ) -> list[Change]:
        """Return the source's measurement noise if its interval excludes EKF2's value."""
        noise = tuned.sigma_z
        if (noise.low or 0.0) <= self.used_m <= (noise.high or np.inf):
            return []
        ml_noise_m = noise.value
        if ml_noise_m is None:  # EKF2's innovations give an upper bound
            ml_noise_m = float(np.hypot(statement.innovation_std_m, statement.innovation_mean_m))
        return [noise_change(self.inputs.aid, self.inputs.settings, self.used_m, ml_noise_m)]

    def outcome(self, result: AxisComparison, change: Change) -> Outcome:
        """Replay EKF2 with the change; the difference without a change is from the log."""
        assert self.model is not None
        compared_s, axis, segment = (
            self.model.flown.evaluated_s,
            result.axis,
            self.comparison.segment,
        )
        ekf2_replay = self._replay_with(self.model, change)
        if TURN in change and self.comparison.source.origin.is_gnss:
            # the change corrects the attitude: only its frame rotates, north stays
            axis = replace(axis, direction=_rotate_direction(axis.direction, -change[TURN]))
        weights = axis.direction[:2]
        updates = ekf2_replay.updates
        updates = updates[inside_spans(updates.index, compared_s)]
        innovation_variance_m2 = along(updates, INNOVATION_VARIANCE_COLUMNS, weights**2)
        prior_m2 = innovation_variance_m2 - along(updates, OBSERVATION_VARIANCES, weights**2)
        posterior_m2 = along(updates, POSITION_VARIANCES, weights**2)
        variance = pd.DataFrame(
            {
                "position_variance_m2": 0.5 * (prior_m2 + posterior_m2),
                "velocity_variance_m2_s2": np.nan,
            },
            index=pd.Index(updates["fused_at_s"].to_numpy()),
        )
        published = project(ekf2_replay.published, axis, segment)
        published = published[inside_spans(published.index, compared_s)]
        logged = result.ekf2_state
        if not change and not isinstance(logged, Unavailable):
            compared = logged[inside_spans(logged.index, compared_s)]
        else:
            compared = published
        return _outcome(
            along(updates, INNOVATION_COLUMNS, weights),
            innovation_variance_m2,
            error_statistics(published, variance, result.truth),
            difference(result.replay, compared),
            float((updates["rejected"] > 0.0).mean()) if len(updates) else None,
        )

    def _replay_with(self, model: Model, change: Change) -> Ekf2Replay:
        """Return the replay of EKF2 with a change, from the cache if available."""
        if not change:
            return model.flown
        key = tuple(sorted(change.items()))
        if key not in self.replays:
            settings = {name: value for name, value in change.items() if name in PARAMETERS}
            model = with_misaligned_positions(model, change.get(TURN, 0.0), change.get(CLOCK, 0.0))
            excluded_s, tuned = None, tuning_of_axis(self.tuning, HORIZONTAL)
            if OUTLIERS in change and tuned is not None:
                delay_s = 1e-3 * self.inputs.settings[self.inputs.aid.delay]
                is_gnss_source = self.comparison.source.origin.fused_as_gnss
                excluded_s = tuned.outlier_time_s - self.comparison.settings.clock_offset_s
                excluded_s = (
                    excluded_s + (delay_s if is_gnss_source else 0.0) + change.get(CLOCK, 0.0)
                )
            (self.replays[key],) = replay_settings(model, [settings], excluded_s)
        return self.replays[key]
