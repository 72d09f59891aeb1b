"""Causes by intervention: each thing that may make a filter inconsistent is changed, and replayed.

A discrepancy is a mean NIS outside its band, or an error beyond what a filter claims (NEES). Each
candidate is tried alone, then with what the best one leaves. A cause is the smallest change that
brings the number into its band, or else explains at least half of its logarithm; "since" stands
before nothing else. A smaller noise by which the filter would claim less than its errors against
the truth is none. Where a fault of the source explains as much as a setting, it comes first: a
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
    FilterName,
    FilterSummary,
    UnjudgedFilter,
)
from px4fuse.comparison.projection import project, project_truth
from px4fuse.comparison.remedy import is_fused_source, ml_delay_change, noise_change
from px4fuse.ekf2.inputs import Inputs
from px4fuse.ekf2.model import Model, replay_settings, with_misaligned_positions
from px4fuse.ekf2.recursion import Variant
from px4fuse.ekf2.replay import HORIZONTAL as LEVEL
from px4fuse.ekf2.replay import UPDATE_COLUMNS, Ekf2Replay, inside_spans
from px4fuse.ekf2_parameters import EV_POS, GNSS_VEL, PARAMETERS
from px4fuse.filter.causes import BiasScaleJumpFit
from px4fuse.filter.clock import ClockOffset
from px4fuse.filter.consistency import SIGMA_FACTOR_FINDING, nis_band
from px4fuse.filter.heading import HeadingError
from px4fuse.filter.kalman import Replay
from px4fuse.filter.likelihood import innovations, preintegrate
from px4fuse.filter.quick import quick_replay
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import (
    Acceleration,
    along,
    ned_acceleration,
    project_acceleration,
    within,
)
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning
from px4fuse.flight import Columns, Unavailable
from px4fuse.record import Positive, Record

Of = Literal["nis", "nees", "apart"]
Change = Mapping[str, float]
# Squared errors of so many times what is claimed are beyond it: twice σ; clean flights stay below 3
MIN_NEES_FINDING = 4.0
# Beyond it a smaller noise is wrong where the errors are larger than claimed as it is
MAX_NEES_AFTER_CHANGE = 2.0
# Mean NIS above which the innovations themselves say so
MAX_UNSUSPICIOUS_NIS = 1.5
# Of the logarithm, and as far above 1 as below
MIN_EXPLAINED_SHARE = 0.5
# How far from all of the logarithm is nearly all: noises are never quite right
SUFFICIENT_TOLERANCE = 0.25
# Of the logarithm, for what is tried together with the best of the others
MIN_HELPFUL_SHARE = 0.1
CLOCK, TURN, OUTLIERS = "clock_offset_s", "turned_deg", "outliers_left_out"
FORWARD, RIGHT = "bias_forward_m_s2", "bias_right_m_s2"
# What is wrong with a sensor, before any setting
SENSOR_CHANGES = frozenset((OUTLIERS, CLOCK, TURN, FORWARD))
# What a filter is run with where the source is better than its rate can show (m): what motion
# capture resolves in flight
SMALLEST_SIGMA_Z_M = 0.005
SIGMA_A, SIGMA_Z = "sigma_a_m_s2", "sigma_z_m"
# What a change of another needs along with it
ACCOMPANYING_CHANGES = frozenset(("EKF2_DELAY_MAX", EV_POS.noise_mode, RIGHT))
SETTING_CHANGES = frozenset((SIGMA_A, SIGMA_Z))
ACC_NOISE = "EKF2_ACC_NOISE"
# Tilt and biases are acceleration's noise too, so that a calm flight asks for more than EKF2 takes
VIBRATION_FACTOR = 3.0
# What EKF2 has besides the aid's own; PX4's default is tried where something else was flown
PARAMETERS_OF_EKF2 = (
    ACC_NOISE,
    "EKF2_GYR_NOISE",
    "EKF2_ACC_B_NOISE",
    "EKF2_GYR_B_NOISE",
    GNSS_VEL.noise,
    GNSS_VEL.gate,
)
INNOVATION_COLUMNS, INNOVATION_VARIANCE_COLUMNS = UPDATE_COLUMNS[:2], UPDATE_COLUMNS[2:4]
POSITION_VARIANCES = [f"position_variance_{axis}_m2" for axis in LEVEL]
HEADING_SIGMAS = 3.0


class Intervention(Record, frozen=True, kw_only=True):
    """One change, and what it makes of a number that should be 1, or of a distance.

    Attributes
    ----------
    of : {"nis", "nees", "apart"}
        Mean NIS, mean NEES of position, or how far both filters are apart (m, RMS), which is asked
        of causes alone.
    filter : {"kf", "ekf2"}
    axis : str
    change : mapping from name to value
        Fields of the settings, PX4's parameters, ``turned_deg`` (of the positions, clockwise seen
        from above), ``outliers_left_out`` (how many), and the accelerometer's ``bias_forward_m_s2``
        and ``bias_right_m_s2``, taken out.
    before, after : float
        The number without the change, of EKF2 by the log, and by a replay with it.
    explains : float
        Share of its logarithm that the change takes away; above 1 it goes to the other side. Of a
        distance the share of its mean square.
    brings_into_band : bool
        Of a NIS its 95 % band; an error is beyond a claim from a NEES of :data:`MIN_NEES_FINDING` on.
    denied_by_truth : bool
        Whether the filter would then claim less than its errors.
    """

    of: Of
    filter: FilterName
    axis: str
    change: Change
    before: Positive
    after: Positive
    explains: float
    brings_into_band: bool
    denied_by_truth: bool = False

    @property
    def is_cause(self) -> bool:
        """Whether it explains enough of it, and not so much that it is something else."""
        return (
            MIN_EXPLAINED_SHARE <= self.explains <= 2.0 - MIN_EXPLAINED_SHARE
            and not self.denied_by_truth
        )

    @property
    def of_sensors(self) -> bool:
        """Whether something is wrong with a sensor, which goes before any setting."""
        return not SENSOR_CHANGES.isdisjoint(self.change)

    @property
    def is_enough(self) -> bool:
        """Whether nothing else has to be looked for: it is all of it, or of a sensor nearly all."""
        return self.brings_into_band or (
            self.of_sensors and abs(self.explains - 1.0) <= SUFFICIENT_TOLERANCE
        )


def interventions_on(
    causes: Iterable[Intervention], owner: FilterName, axis: str, of: Of = "nis"
) -> list[Intervention]:
    """What was tried on one discrepancy."""
    return [
        intervention
        for intervention in causes
        if (intervention.of, intervention.filter, intervention.axis) == (of, owner, axis)
    ]


def cause_of(
    causes: Iterable[Intervention], owner: FilterName, axis: str, of: Of = "nis"
) -> Intervention | None:
    """The cause of one discrepancy, by all that was tried; None where nothing explains it."""
    return min(
        (
            intervention
            for intervention in interventions_on(causes, owner, axis, of)
            if intervention.is_cause
        ),
        key=lambda intervention: (
            not intervention.is_enough,
            len(intervention.change.keys() - ACCOMPANYING_CHANGES),
            not intervention.of_sensors,
            abs(intervention.explains - 1.0),
        ),
        default=None,
    )


class ErrorBeyondSigma(NamedTuple):
    """An error to the truth (RMS, and its NEES) beyond the standard deviation that is claimed."""

    nees: float
    rmse_m: float
    reported_sigma_m: float
    nis_mean: float


def error_beyond_reported_sigma(
    statement: FilterSummary | UnjudgedFilter,
) -> ErrorBeyondSigma | None:
    """The error to the truth where it is larger than claimed, and no innovation says so."""
    truth = statement.truth
    if isinstance(statement, Unavailable) or isinstance(truth, Unavailable):
        return None
    nees, rmse_m = truth.nees_position_mean or 0.0, truth.position_rmse_m
    if nees < MIN_NEES_FINDING or statement.nis_mean >= MAX_UNSUSPICIOUS_NIS:
        return None
    claimed_m = statement.sigma_p_median_m or rmse_m / float(np.sqrt(nees))
    return ErrorBeyondSigma(nees, rmse_m, claimed_m, statement.nis_mean)


def interventions(
    comparison: Comparison,
    tuning: Tuning,
    clock: ClockOffset | Unavailable,
    heading: HeadingError | Unavailable,
    bias_scale_jump_fit: BiasScaleJumpFit | Unavailable,
    model: Model | Unavailable,
) -> tuple[Intervention, ...]:
    """Try every candidate on every discrepancy.

    Parameters
    ----------
    comparison : Comparison
    tuning : mapping from axis name, or "horizontal", to AxisTuning or Unavailable
    clock : ClockOffset or Unavailable
    heading : HeadingError or Unavailable
    bias_scale_jump_fit : Explained or Unavailable
        With the biases of the accelerometer.
    model : Model or Unavailable
        Of EKF2.
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
        for result, of in changed.discrepancies():
            tried_changes = _try_candidates(changed, result, of)
            rows += tried_changes
            if cause := cause_of(tried_changes, changed.owner, result.axis.name, of):
                rows += _difference_reduction(cause, result, changed)
    return tuple(rows)


def planned_variants(
    comparison: Comparison,
    tuning: Tuning,
    clock: ClockOffset | Unavailable,
    heading: HeadingError | Unavailable,
    inputs: Inputs,
) -> list[Variant]:
    """The variants of EKF2 that :func:`interventions` will ask for, as far as can be told before.

    One that is not among them is replayed when it is asked for.
    """
    if not is_fused_source(comparison, inputs):
        return []
    ekf2_changes, flown = _Ekf2Changes(comparison, tuning, clock, heading, inputs), inputs.settings
    changes = [
        change
        for discrepancy in ekf2_changes.discrepancies()
        for change in ekf2_changes.candidates(*discrepancy)
    ]
    return [Variant({**flown, **change}) for change in changes if change.keys() <= flown.keys()]


def _difference_reduction(
    cause: Intervention, result: AxisComparison, changed: _FilterChanges
) -> list[Intervention]:
    """How far a cause keeps both filters apart."""
    before, after = (
        changed.statistic_after(result, "apart", change) for change in ({}, cause.change)
    )
    if before is None or after is None:
        return []
    explained_share = 1.0 - (after[0] / before[0]) ** 2
    return [
        structs.replace(
            cause,
            of="apart",
            before=before[0],
            after=after[0],
            explains=explained_share,
            brings_into_band=False,
        )
    ]


def is_inconsistent(statement: FilterSummary | UnjudgedFilter) -> TypeGuard[FilterSummary]:
    """Whether a variance is not what innovations show, by more than chance and enough to matter."""
    if isinstance(statement, Unavailable):
        return False
    return (
        statement.verdict != "consistent" and statement.sigma_error_factor >= SIGMA_FACTOR_FINDING
    )


def _find_discrepancies(statement: FilterSummary | UnjudgedFilter) -> list[Of]:
    """What of a filter is not as it should be."""
    found: list[Of] = ["nees"] if error_beyond_reported_sigma(statement) else []
    return [*found, "nis"] if is_inconsistent(statement) else found


def _try_candidates(changed: _FilterChanges, result: AxisComparison, of: Of) -> list[Intervention]:
    """All candidates alone; where the best leaves the number outside its band, with the others."""
    statement, candidates = result.filters[changed.owner], changed.candidates(result, of)
    assert isinstance(statement, FilterSummary)  # else it has no discrepancy
    truth = statement.truth
    nees = None if isinstance(truth, Unavailable) else truth.nees_position_mean
    before = statement.nis_mean if nees is None or of == "nis" else nees
    is_checked_by_truth = of == "nis" and before < 1.0 and not isinstance(result.truth, Unavailable)

    def tried(change: Change) -> list[Intervention]:
        statistic = changed.statistic_after(result, of, change)
        if statistic is None or statistic[0] <= 0.0:
            return []
        after, count = statistic
        low, high = nis_band(count) if of == "nis" else (0.0, MIN_NEES_FINDING)
        nees_after = (
            changed.statistic_after(result, "nees", change) if is_checked_by_truth else None
        )
        max_nees = MAX_NEES_AFTER_CHANGE if nees is not None and nees > 1.0 else MIN_NEES_FINDING
        return [
            Intervention(
                of=of,
                filter=changed.owner,
                axis=result.axis.name,
                change=change,
                before=before,
                after=after,
                explains=1.0 - float(np.log(after) / np.log(before)),
                brings_into_band=low <= after <= high,
                denied_by_truth=nees_after is not None and nees_after[0] >= max_nees,
            )
        ]

    single_changes = [each for change in candidates for each in tried(change)]
    helpful_changes = sorted(
        (
            intervention
            for intervention in single_changes
            if MIN_HELPFUL_SHARE < intervention.explains < 2.0 - MIN_HELPFUL_SHARE
        ),
        key=lambda intervention: abs(intervention.explains - 1.0),
    )
    if not helpful_changes or any(each.brings_into_band for each in helpful_changes):
        return single_changes
    best_change, *other_changes = helpful_changes
    return single_changes + [
        intervention
        for other in other_changes
        for intervention in tried({**best_change.change, **other.change})
    ]


def _rms_difference(run: Replay, state: pd.DataFrame) -> tuple[float, int] | None:
    """Root mean square of ours - EKF2 in position (m), and of how many."""
    found = difference(run, state)
    return None if isinstance(found, Unavailable) else (found.position_rmse_m, found.count)


def _mean_nees(judged: AgainstTruth | Unavailable) -> tuple[float, int] | None:
    """Mean NEES of position, and of how many."""
    if isinstance(judged, Unavailable) or judged.nees_position_mean is None:
        return None
    return judged.nees_position_mean, judged.count


def tuning_of_axis(tuning: Tuning, axis: str) -> AxisTuning | None:
    """What was tuned for an axis: both horizontal ones together, where there are both."""
    return first_axis_tuning(tuning, *(() if axis == "down" else (HORIZONTAL,)), axis)


def _rotate_direction(direction: Array, rotation_deg: float) -> Array:
    """A direction in the frame in which the positions are turned (clockwise from above)."""
    return np.asarray(Rotation.from_euler("z", -rotation_deg, degrees=True).apply(direction))


@dataclass(frozen=True)
class _FilterChanges:
    """A filter, what the data ask to change of it, and what it does with changes."""

    comparison: Comparison
    tuning: Tuning
    clock: ClockOffset | Unavailable
    heading: HeadingError | Unavailable

    owner: ClassVar[FilterName]

    def discrepancies(self) -> list[tuple[AxisComparison, Of]]:
        """Its discrepancies, each with its axis; EKF2 is replayed along horizontal ones."""
        return [
            (result, of)
            for result in self.comparison.axes.values()
            if self.owner == "kf" or result.axis.name != "down"
            for of in _find_discrepancies(result.filters[self.owner])
        ]

    @abstractmethod
    def noise_candidates(
        self, statement: FilterSummary, tuned: AxisTuning, over: bool
    ) -> list[Change]:
        """The noises that the data ask for, where their interval excludes those that were taken."""

    @abstractmethod
    def other_candidates(self, tuned: AxisTuning | None) -> list[Change]:
        """What else may be wrong; ``tuned`` where the variance is not larger than what is shown."""

    @abstractmethod
    def statistic_after(
        self, result: AxisComparison, of: Of, change: Change
    ) -> tuple[float, int] | None:
        """Mean NIS or NEES along an axis with a change, or how far apart; and of how many."""

    def candidates(self, result: AxisComparison, of: Of) -> list[Change]:
        """What to try along an axis."""
        statement, origin = result.filters[self.owner], self.comparison.source.origin
        assert isinstance(statement, FilterSummary)  # else it has no discrepancy
        is_overstated = of == "nis" and statement.nis_mean < 1.0
        tuned = tuning_of_axis(self.tuning, result.axis.name)
        changes = list[Change]()
        # small innovations against such a source say too little of its errors
        hides_noise = origin.may_drift or origin.is_gnss
        if tuned is not None and not (is_overstated and hides_noise):
            changes += self.noise_candidates(statement, tuned, is_overstated)
        if tuned is not None and not is_overstated and len(tuned.outlier_time_s):
            changes.append({OUTLIERS: float(len(tuned.outlier_time_s))})
        changes += self.time_offset_candidates()
        if result.axis.name == "down":
            return changes
        if isinstance(turn := self.heading, HeadingError):
            is_significant = abs(turn.turn_deg) > HEADING_SIGMAS * turn.sigma_deg
            changes += [{TURN: -round(turn.turn_deg, 1)}] if is_significant else []
        return changes + self.other_candidates(None if is_overstated else tuned)

    def time_offset_candidates(self) -> list[Change]:
        """The offset of the stamps, where what was not taken of it is beyond chance."""
        if isinstance(self.clock, Unavailable) or not self.clock.determinable:
            return []
        applied_s = self.comparison.settings.clock_offset_s
        offset_s = applied_s + self.clock.remaining_s
        missing_s = offset_s - (applied_s if self.owner == "kf" else 0.0)
        return [{CLOCK: round(offset_s, 3)}] if abs(missing_s) > self.clock.three_sigma_s else []


@dataclass(frozen=True)
class _KfChanges(_FilterChanges):
    """Our filter with changes."""

    bias_scale_jump_fit: BiasScaleJumpFit | Unavailable

    owner = "kf"

    def noise_candidates(
        self, statement: FilterSummary, tuned: AxisTuning, over: bool
    ) -> list[Change]:
        """SIGMA_A and SIGMA_Z."""
        changes = list[Change]()
        for name, noise in ((SIGMA_A, tuned.filter_sigma_a), (SIGMA_Z, tuned.sigma_z)):
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
        """The accelerometer's bias."""
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
        """The acceleration along a direction, without the accelerometer's bias."""
        flight, imu = self.comparison.flight, self.comparison.flight.imu
        if isinstance(imu, Unavailable):
            return imu
        bias = pd.Series([change[FORWARD], change[RIGHT], 0.0], Columns.SPECIFIC_FORCE)
        flight = replace(flight, imu=imu.assign(**(imu[Columns.SPECIFIC_FORCE] - bias)))
        corrected_ned = ned_acceleration(flight)
        if isinstance(corrected_ned, Unavailable):
            return corrected_ned
        return project_acceleration(corrected_ned, direction, self.comparison.segment)

    def statistic_after(
        self, result: AxisComparison, of: Of, change: Change
    ) -> tuple[float, int] | None:
        """By our filter, run again."""
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
            if is_gnss_rotation:  # GNSS knows north, and so does the truth: the attitude does not
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
        if of == "nis":
            legs = preintegrate(axis, settings)
            nu, s = innovations(legs, settings.sigma_a_m_s2, settings.sigma_z_m)
            return float(np.mean(nu**2 / s)), len(nu)
        run = quick_replay(axis, settings)
        if of == "apart":
            state = result.ekf2_state
            return (
                None
                if is_gnss_rotation or isinstance(state, Unavailable)
                else _rms_difference(run, state)
            )
        return _mean_nees(kf_error_statistics(run, truth, run.steps))


@dataclass(frozen=True)
class _Ekf2Changes(_FilterChanges):
    """EKF2 with changes, where it fused what was analysed.

    Without a model, which must agree with the log, it only has candidates.
    """

    inputs: Inputs
    model: Model | None = None
    replays: dict[tuple[tuple[str, float], ...], Ekf2Replay] = field(default_factory=dict)

    owner = "ekf2"

    @property
    def used_m(self) -> float:
        """Median √R (m) as flown."""
        aid, flown = self.inputs.aid, self.inputs.settings
        takes_stated = not aid.noise_mode or flown[aid.noise_mode] != 1.0
        stated = self.inputs.received.variance_m2[:, :2] * takes_stated
        return float(np.sqrt(np.median(np.maximum(stated, flown[aid.noise] ** 2))))

    def time_offset_candidates(self) -> list[Change]:
        """A delay is EKF2's own to set; there is none for stamps that are early."""
        delay = ml_delay_change(self.comparison, self.inputs, self.clock)
        return [delay] if delay else super().time_offset_candidates()

    def other_candidates(self, tuned: AxisTuning | None) -> list[Change]:
        """The gate, parameters that are not PX4's own, and the process noise."""
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
        """The process noise that the vibration asks for, as far as PX4's range goes.

        EKF2 adds (EKF2_ACC_NOISE · step)² to the variance of the velocity in each step, ours
        SIGMA_A² DT² in each DT.
        """
        steps = self.comparison.settings.dt_s / self.inputs.step_s
        flown, px4_maximum = self.inputs.settings[ACC_NOISE], PARAMETERS[ACC_NOISE].maximum
        if (tuned.filter_sigma_a.low or 0.0) * steps**0.5 <= VIBRATION_FACTOR * flown:
            return {}
        ml_noise = min((tuned.filter_sigma_a.value or 0.0) * steps**0.5, px4_maximum)
        return {ACC_NOISE: float(f"{ml_noise:.2g}")} if ml_noise > flown else {}

    def noise_candidates(
        self, statement: FilterSummary, tuned: AxisTuning, over: bool
    ) -> list[Change]:
        """The source's noise."""
        noise = tuned.sigma_z
        if (noise.low or 0.0) <= self.used_m <= (noise.high or np.inf):
            return []
        asked_m = noise.value
        if asked_m is None:  # EKF2's own innovations bound it too, and less tightly
            asked_m = float(np.hypot(statement.innovation_std_m, statement.innovation_mean_m))
        return [noise_change(self.inputs.aid, self.inputs.settings, self.used_m, asked_m)]

    def statistic_after(
        self, result: AxisComparison, of: Of, change: Change
    ) -> tuple[float, int] | None:
        """By a replay, along a horizontal axis; unchanged how far apart by the log."""
        assert self.model is not None
        judged_s, axis = self.model.flown.judged_s, result.axis
        ekf2_replay = self._replay_with(self.model, change)
        if TURN in change and self.comparison.source.origin.is_gnss:
            # what is put right is the attitude: its frame is turned, north is where it was
            axis = replace(axis, direction=_rotate_direction(axis.direction, -change[TURN]))
        weights = axis.direction[:2]
        updates = ekf2_replay.updates[inside_spans(ekf2_replay.updates.index, judged_s)]
        if of == "nis":
            nu = along(updates, INNOVATION_COLUMNS, weights)
            s = along(updates, INNOVATION_VARIANCE_COLUMNS, weights**2)
            return (float(np.mean(nu**2 / s)), len(nu)) if len(nu) else None
        state = project(ekf2_replay.published, axis, self.comparison.segment)
        if of == "apart":
            logged = result.ekf2_state
            state = state if change or isinstance(logged, Unavailable) else logged
            return _rms_difference(result.replay, state[inside_spans(state.index, judged_s)])
        at_s, track = (
            updates["fused_at_s"],
            along(ekf2_replay.delayed, Columns.POSITION, axis.direction),
        )
        horizon_columns = {
            "position_m": np.interp(at_s, ekf2_replay.delayed.index, track),
            "position_variance_m2": along(updates, POSITION_VARIANCES, weights**2),
        }
        horizon = pd.DataFrame(horizon_columns, index=pd.Index(at_s))
        return _mean_nees(error_statistics(state, result.ekf2_variance, result.truth, horizon))

    def _replay_with(self, model: Model, change: Change) -> Ekf2Replay:
        """EKF2 with a change, each replayed once."""
        if not change:
            return model.flown
        key = tuple(sorted(change.items()))
        if key not in self.replays:
            settings = {name: value for name, value in change.items() if name in PARAMETERS}
            model = with_misaligned_positions(model, change.get(TURN, 0.0), change.get(CLOCK, 0.0))
            left_out_s, tuned = None, tuning_of_axis(self.tuning, HORIZONTAL)
            if OUTLIERS in change and tuned is not None:
                delay_s = 1e-3 * self.inputs.settings[self.inputs.aid.delay]
                is_gnss_source = self.comparison.source.origin.fused_as_gnss
                left_out_s = tuned.outlier_time_s - self.comparison.settings.clock_offset_s
                left_out_s = (
                    left_out_s + (delay_s if is_gnss_source else 0.0) + change.get(CLOCK, 0.0)
                )
            (self.replays[key],) = replay_settings(model, [settings], left_out_s)
        return self.replays[key]
