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
from px4fuse.comparison.comparison import against_truth, difference, kf_against_truth
from px4fuse.comparison.estimates import Tuning, known_noises
from px4fuse.comparison.model import (
    AgainstTruth,
    AxisComparison,
    Comparison,
    FilterName,
    FilterSummary,
    UnjudgedFilter,
)
from px4fuse.comparison.projection import project, project_truth
from px4fuse.comparison.remedy import delay_asked, fused, noise_change
from px4fuse.ekf2.inputs import Inputs
from px4fuse.ekf2.model import Model, moved, replay_settings
from px4fuse.ekf2.recursion import Variant
from px4fuse.ekf2.replay import HORIZONTAL as LEVEL
from px4fuse.ekf2.replay import UPDATE_COLUMNS, Ekf2Replay, settled
from px4fuse.ekf2_parameters import EV_POS, GNSS_VEL, PARAMETERS
from px4fuse.filter.causes import Explained
from px4fuse.filter.clock import ClockOffset
from px4fuse.filter.consistency import SIGMA_OFF, nis_band
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
NEES_LARGE = 4.0
# Beyond it a smaller noise is wrong where the errors are larger than claimed as it is
NEES_DENIES = 2.0
# Mean NIS above which the innovations themselves say so
CONTENT_NIS = 1.5
# Of the logarithm, and as far above 1 as below
EXPLAINS = 0.5
# How far from all of the logarithm is nearly all: noises are never quite right
NEARLY_ALL = 0.25
# Of the logarithm, for what is tried together with the best of the others
HELPS = 0.1
CLOCK, TURN, OUTLIERS = "clock_offset_s", "turned_deg", "outliers_left_out"
FORWARD, RIGHT = "bias_forward_m_s2", "bias_right_m_s2"
# What is wrong with a sensor, before any setting
OF_SENSORS = frozenset((OUTLIERS, CLOCK, TURN, FORWARD))
# What a filter is run with where the source is better than its rate can show (m): what motion
# capture resolves in flight
SMALLEST_SIGMA_Z_M = 0.005
SIGMA_A, SIGMA_Z = "sigma_a_m_s2", "sigma_z_m"
# What a change of another needs along with it
ALONG = frozenset(("EKF2_DELAY_MAX", EV_POS.noise_mode, RIGHT))
OF_SETTINGS = frozenset((SIGMA_A, SIGMA_Z))
ACC_NOISE = "EKF2_ACC_NOISE"
# Tilt and biases are acceleration's noise too, so that a calm flight asks for more than EKF2 takes
SHAKEN = 3.0
# What EKF2 has besides the aid's own; PX4's default is tried where something else was flown
NOT_OF_AID = (
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
        Of a NIS its 95 % band; an error is beyond a claim from a NEES of :data:`NEES_LARGE` on.
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
        return EXPLAINS <= self.explains <= 2.0 - EXPLAINS and not self.denied_by_truth

    @property
    def of_sensors(self) -> bool:
        """Whether something is wrong with a sensor, which goes before any setting."""
        return not OF_SENSORS.isdisjoint(self.change)

    @property
    def is_enough(self) -> bool:
        """Whether nothing else has to be looked for: it is all of it, or of a sensor nearly all."""
        return self.brings_into_band or (self.of_sensors and abs(self.explains - 1.0) <= NEARLY_ALL)


def tried_on(
    causes: Iterable[Intervention], owner: FilterName, axis: str, of: Of = "nis"
) -> list[Intervention]:
    """What was tried on one discrepancy."""
    return [each for each in causes if (each.of, each.filter, each.axis) == (of, owner, axis)]


def cause_of(
    causes: Iterable[Intervention], owner: FilterName, axis: str, of: Of = "nis"
) -> Intervention | None:
    """The cause of one discrepancy, by all that was tried; None where nothing explains it."""
    return min(
        (each for each in tried_on(causes, owner, axis, of) if each.is_cause),
        key=lambda each: (
            not each.is_enough,
            len(each.change.keys() - ALONG),
            not each.of_sensors,
            abs(each.explains - 1.0),
        ),
        default=None,
    )


class Hidden(NamedTuple):
    """An error to the truth (RMS, and its NEES) beyond the standard deviation that is claimed."""

    nees: float
    rmse_m: float
    claimed_m: float
    nis_mean: float


def beyond_claim(statement: FilterSummary | UnjudgedFilter) -> Hidden | None:
    """The error to the truth where it is larger than claimed, and no innovation says so."""
    truth = statement.truth
    if isinstance(statement, Unavailable) or isinstance(truth, Unavailable):
        return None
    nees, rmse_m = truth.nees_position_mean or 0.0, truth.position_rmse_m
    if nees < NEES_LARGE or statement.nis_mean >= CONTENT_NIS:
        return None
    claimed_m = statement.sigma_p_median_m or rmse_m / float(np.sqrt(nees))
    return Hidden(nees, rmse_m, claimed_m, statement.nis_mean)


def interventions(
    comparison: Comparison,
    tuning: Tuning,
    clock: ClockOffset | Unavailable,
    heading: HeadingError | Unavailable,
    explained: Explained | Unavailable,
    model: Model | Unavailable,
) -> tuple[Intervention, ...]:
    """Try every candidate on every discrepancy.

    Parameters
    ----------
    comparison : Comparison
    tuning : mapping from axis name, or "horizontal", to AxisTuning or Unavailable
    clock : ClockOffset or Unavailable
    heading : HeadingError or Unavailable
    explained : Explained or Unavailable
        With the biases of the accelerometer.
    model : Model or Unavailable
        Of EKF2.
    """
    known = comparison, tuning, clock, heading
    filters: list[_Changed] = [_Ours(*known, explained)]
    if isinstance(model, Model) and model.agreement.good and fused(comparison, model.inputs):
        filters.append(_Ekf2(*known, model.inputs, model))
    rows: list[Intervention] = []
    for changed in filters:
        for result, of in changed.asked():
            tried = _tried(changed, result, of)
            rows += tried
            if cause := cause_of(tried, changed.owner, result.axis.name, of):
                rows += _apart(cause, result, changed)
    return tuple(rows)


def to_try(
    comparison: Comparison,
    tuning: Tuning,
    clock: ClockOffset | Unavailable,
    heading: HeadingError | Unavailable,
    inputs: Inputs,
) -> list[Variant]:
    """The variants of EKF2 that :func:`interventions` will ask for, as far as can be told before.

    One that is not among them is replayed when it is asked for.
    """
    if not fused(comparison, inputs):
        return []
    tried, flown = _Ekf2(comparison, tuning, clock, heading, inputs), inputs.settings
    changes = [change for one in tried.asked() for change in tried.candidates(*one)]
    return [Variant({**flown, **change}) for change in changes if change.keys() <= flown.keys()]


def _apart(cause: Intervention, result: AxisComparison, changed: _Changed) -> list[Intervention]:
    """How far a cause keeps both filters apart."""
    before, after = (changed.number(result, "apart", change) for change in ({}, cause.change))
    if before is None or after is None:
        return []
    share = 1.0 - (after[0] / before[0]) ** 2
    return [
        structs.replace(
            cause,
            of="apart",
            before=before[0],
            after=after[0],
            explains=share,
            brings_into_band=False,
        )
    ]


def is_off(statement: FilterSummary | UnjudgedFilter) -> TypeGuard[FilterSummary]:
    """Whether a variance is not what innovations show, by more than chance and enough to matter."""
    if isinstance(statement, Unavailable):
        return False
    return statement.verdict != "consistent" and statement.times_off >= SIGMA_OFF


def _discrepancies(statement: FilterSummary | UnjudgedFilter) -> list[Of]:
    """What of a filter is not as it should be."""
    found: list[Of] = ["nees"] if beyond_claim(statement) else []
    return [*found, "nis"] if is_off(statement) else found


def _tried(changed: _Changed, result: AxisComparison, of: Of) -> list[Intervention]:
    """All candidates alone; where the best leaves the number outside its band, with the others."""
    statement, candidates = result.filters[changed.owner], changed.candidates(result, of)
    assert isinstance(statement, FilterSummary)  # else it has no discrepancy
    truth = statement.truth
    nees = None if isinstance(truth, Unavailable) else truth.nees_position_mean
    before = statement.nis_mean if nees is None or of == "nis" else nees
    deniable = of == "nis" and before < 1.0 and not isinstance(result.truth, Unavailable)

    def tried(change: Change) -> list[Intervention]:
        found = changed.number(result, of, change)
        if found is None or found[0] <= 0.0:
            return []
        after, count = found
        low, high = nis_band(count) if of == "nis" else (0.0, NEES_LARGE)
        claimed = changed.number(result, "nees", change) if deniable else None
        most = NEES_DENIES if nees is not None and nees > 1.0 else NEES_LARGE
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
                denied_by_truth=claimed is not None and claimed[0] >= most,
            )
        ]

    alone = [each for change in candidates for each in tried(change)]
    helping = sorted(
        (e for e in alone if HELPS < e.explains < 2.0 - HELPS), key=lambda e: abs(e.explains - 1.0)
    )
    if not helping or any(each.brings_into_band for each in helping):
        return alone
    best, *others = helping
    return alone + [e for other in others for e in tried({**best.change, **other.change})]


def _rms_apart(run: Replay, state: pd.DataFrame) -> tuple[float, int] | None:
    """Root mean square of ours - EKF2 in position (m), and of how many."""
    found = difference(run, state)
    return None if isinstance(found, Unavailable) else (found.position_rmse_m, found.count)


def _nees(judged: AgainstTruth | Unavailable) -> tuple[float, int] | None:
    """Mean NEES of position, and of how many."""
    if isinstance(judged, Unavailable) or judged.nees_position_mean is None:
        return None
    return judged.nees_position_mean, judged.count


def tuned_for(tuning: Tuning, axis: str) -> AxisTuning | None:
    """What was tuned for an axis: both horizontal ones together, where there are both."""
    return known_noises(tuning, *(() if axis == "down" else (HORIZONTAL,)), axis)


def _turned(direction: Array, turned_deg: float) -> Array:
    """A direction in the frame in which the positions are turned (clockwise from above)."""
    return np.asarray(Rotation.from_euler("z", -turned_deg, degrees=True).apply(direction))


@dataclass(frozen=True)
class _Changed:
    """A filter, what the data ask to change of it, and what it does with changes."""

    comparison: Comparison
    tuning: Tuning
    clock: ClockOffset | Unavailable
    heading: HeadingError | Unavailable

    owner: ClassVar[FilterName]

    def asked(self) -> list[tuple[AxisComparison, Of]]:
        """Its discrepancies, each with its axis; EKF2 is replayed along horizontal ones."""
        return [
            (result, of)
            for result in self.comparison.axes.values()
            if self.owner == "kf" or result.axis.name != "down"
            for of in _discrepancies(result.filters[self.owner])
        ]

    @abstractmethod
    def of_noise(self, statement: FilterSummary, tuned: AxisTuning, over: bool) -> list[Change]:
        """The noises that the data ask for, where their interval excludes those that were taken."""

    @abstractmethod
    def of_filter(self, tuned: AxisTuning | None) -> list[Change]:
        """What else may be wrong; ``tuned`` where the variance is not larger than what is shown."""

    @abstractmethod
    def number(self, result: AxisComparison, of: Of, change: Change) -> tuple[float, int] | None:
        """Mean NIS or NEES along an axis with a change, or how far apart; and of how many."""

    def candidates(self, result: AxisComparison, of: Of) -> list[Change]:
        """What to try along an axis."""
        statement, origin = result.filters[self.owner], self.comparison.source.origin
        assert isinstance(statement, FilterSummary)  # else it has no discrepancy
        over = of == "nis" and statement.nis_mean < 1.0
        tuned = tuned_for(self.tuning, result.axis.name)
        found = list[Change]()
        # small innovations against such a source say too little of its errors
        hides_noise = origin.may_drift or origin.is_gnss
        if tuned is not None and not (over and hides_noise):
            found += self.of_noise(statement, tuned, over)
        if tuned is not None and not over and len(tuned.outlier_time_s):
            found.append({OUTLIERS: float(len(tuned.outlier_time_s))})
        found += self.of_stamps()
        if result.axis.name == "down":
            return found
        if isinstance(turn := self.heading, HeadingError):
            beyond = abs(turn.turn_deg) > HEADING_SIGMAS * turn.sigma_deg
            found += [{TURN: -round(turn.turn_deg, 1)}] if beyond else []
        return found + self.of_filter(None if over else tuned)

    def of_stamps(self) -> list[Change]:
        """The offset of the stamps, where what was not taken of it is beyond chance."""
        if isinstance(self.clock, Unavailable) or not self.clock.determinable:
            return []
        taken_s = self.comparison.settings.clock_offset_s
        offset_s = taken_s + self.clock.remaining_s
        missing_s = offset_s - (taken_s if self.owner == "kf" else 0.0)
        return [{CLOCK: round(offset_s, 3)}] if abs(missing_s) > self.clock.chance_s else []


@dataclass(frozen=True)
class _Ours(_Changed):
    """Our filter with changes."""

    explained: Explained | Unavailable

    owner = "kf"

    def of_noise(self, statement: FilterSummary, tuned: AxisTuning, over: bool) -> list[Change]:
        """SIGMA_A and SIGMA_Z."""
        found = list[Change]()
        for name, noise in ((SIGMA_A, tuned.filter_sigma_a), (SIGMA_Z, tuned.sigma_z)):
            chosen = getattr(self.comparison.settings, name)
            asked = noise.value or (noise.high if over else None) or 0.0
            end = noise.high if over else noise.low
            if noise.value is None and name == SIGMA_Z:
                asked = max(asked, SMALLEST_SIGMA_Z_M)
            if asked and end is not None and (chosen > end if over else chosen < end):
                found.append({name: float(f"{asked:.3g}")})
        return found

    def of_filter(self, tuned: AxisTuning | None) -> list[Change]:
        """The accelerometer's bias."""
        if isinstance(self.explained, Unavailable) or not self.explained.biased:
            return []
        forward, right = self.explained.forward_bias, self.explained.right_bias
        return [{FORWARD: round(forward.value, 3), RIGHT: round(right.value, 3)}]

    def _unbiased(self, change: Change, direction: Array) -> Acceleration | Unavailable:
        """The acceleration along a direction, without the accelerometer's bias."""
        flight, imu = self.comparison.flight, self.comparison.flight.imu
        if isinstance(imu, Unavailable):
            return imu
        bias = pd.Series([change[FORWARD], change[RIGHT], 0.0], Columns.SPECIFIC_FORCE)
        flight = replace(flight, imu=imu.assign(**(imu[Columns.SPECIFIC_FORCE] - bias)))
        made = ned_acceleration(flight)
        if isinstance(made, Unavailable):
            return made
        return project_acceleration(made, direction, self.comparison.segment)

    def number(self, result: AxisComparison, of: Of, change: Change) -> tuple[float, int] | None:
        """By our filter, run again."""
        source, segment, axis = self.comparison.source, self.comparison.segment, result.axis
        named: dict[str, Any] = {name: change[name] for name in change if name in vars(Settings())}
        settings = replace(self.comparison.settings, **named)
        truth, compass = result.truth, TURN in change and source.origin.is_gnss
        if TURN in change:
            turned = _turned(axis.direction, change[TURN])
            measured_m = along(within(source.samples, segment), Columns.POSITION, turned)
            axis = replace(axis, measurement_m=measured_m[np.isfinite(measured_m)])
            if compass:  # GNSS knows north, and so does the truth: the attitude does not
                there = replace(axis, direction=turned)
                truth = project_truth(self.comparison.flight.truth, there, segment)
        if FORWARD in change:
            axis = replace(axis, acceleration=self._unbiased(change, axis.direction))
        time_s, tuned = axis.measurement_time_s, tuned_for(self.tuning, axis.name)
        kept = np.ones(len(time_s), dtype=bool)
        if OUTLIERS in change and tuned is not None:
            kept = ~np.isin(time_s, tuned.outlier_time_s)
        shift_s = settings.clock_offset_s - self.comparison.settings.clock_offset_s
        axis = replace(
            axis, measurement_time_s=time_s[kept] + shift_s, measurement_m=axis.measurement_m[kept]
        )
        if of == "nis":
            legs = preintegrate(axis, settings)
            nu, s = innovations(legs, settings.sigma_a_m_s2, settings.sigma_z_m)
            return float(np.mean(nu**2 / s)), len(nu)
        run = quick_replay(axis, settings)
        if of == "apart":
            state = result.ekf2_state
            return None if compass or isinstance(state, Unavailable) else _rms_apart(run, state)
        return _nees(kf_against_truth(run, truth, run.steps))


@dataclass(frozen=True)
class _Ekf2(_Changed):
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

    def of_stamps(self) -> list[Change]:
        """A delay is EKF2's own to set; there is none for stamps that are early."""
        delay = delay_asked(self.comparison, self.inputs, self.clock)
        return [delay] if delay else super().of_stamps()

    def of_filter(self, tuned: AxisTuning | None) -> list[Change]:
        """The gate, parameters that are not PX4's own, and the process noise."""
        aid, flown = self.inputs.aid, self.inputs.settings
        usual = {name: PARAMETERS[name].default for name in (aid.gate, *NOT_OF_AID)}
        found: list[Change] = [
            {name: value}
            for name, value in usual.items()
            if name in flown
            and not np.isclose(flown[name], value, rtol=1e-3)
            and (name != aid.gate or flown[name] < value)
        ]
        shaken = {} if tuned is None else self._shaken(tuned)
        return [*found, shaken] if shaken else found

    def _shaken(self, tuned: AxisTuning) -> Change:
        """The process noise that the vibration asks for, as far as PX4's range goes.

        EKF2 adds (EKF2_ACC_NOISE · step)² to the variance of the velocity in each step, ours
        SIGMA_A² DT² in each DT.
        """
        steps = self.comparison.settings.dt_s / self.inputs.step_s
        flown, most = self.inputs.settings[ACC_NOISE], PARAMETERS[ACC_NOISE].maximum
        if (tuned.filter_sigma_a.low or 0.0) * steps**0.5 <= SHAKEN * flown:
            return {}
        asked = min((tuned.filter_sigma_a.value or 0.0) * steps**0.5, most)
        return {ACC_NOISE: float(f"{asked:.2g}")} if asked > flown else {}

    def of_noise(self, statement: FilterSummary, tuned: AxisTuning, over: bool) -> list[Change]:
        """The source's noise."""
        noise = tuned.sigma_z
        if (noise.low or 0.0) <= self.used_m <= (noise.high or np.inf):
            return []
        asked_m = noise.value
        if asked_m is None:  # EKF2's own innovations bound it too, and less tightly
            asked_m = float(np.hypot(statement.innovation_std_m, statement.innovation_mean_m))
        return [noise_change(self.inputs.aid, self.inputs.settings, self.used_m, asked_m)]

    def number(self, result: AxisComparison, of: Of, change: Change) -> tuple[float, int] | None:
        """By a replay, along a horizontal axis; unchanged how far apart by the log."""
        assert self.model is not None
        judged_s, axis = self.model.flown.judged_s, result.axis
        made = self._replayed(self.model, change)
        if TURN in change and self.comparison.source.origin.is_gnss:
            # what is put right is the attitude: its frame is turned, north is where it was
            axis = replace(axis, direction=_turned(axis.direction, -change[TURN]))
        weights = axis.direction[:2]
        updates = made.updates[settled(made.updates.index, judged_s)]
        if of == "nis":
            nu = along(updates, INNOVATION_COLUMNS, weights)
            s = along(updates, INNOVATION_VARIANCE_COLUMNS, weights**2)
            return (float(np.mean(nu**2 / s)), len(nu)) if len(nu) else None
        state = project(made.published, axis, self.comparison.segment)
        if of == "apart":
            logged = result.ekf2_state
            state = state if change or isinstance(logged, Unavailable) else logged
            return _rms_apart(result.replay, state[settled(state.index, judged_s)])
        at_s, track = updates["fused_at_s"], along(made.delayed, Columns.POSITION, axis.direction)
        stated = {
            "position_m": np.interp(at_s, made.delayed.index, track),
            "position_variance_m2": along(updates, POSITION_VARIANCES, weights**2),
        }
        horizon = pd.DataFrame(stated, index=pd.Index(at_s))
        return _nees(against_truth(state, result.ekf2_variance, result.truth, horizon))

    def _replayed(self, model: Model, change: Change) -> Ekf2Replay:
        """EKF2 with a change, each replayed once."""
        if not change:
            return model.flown
        key = tuple(sorted(change.items()))
        if key not in self.replays:
            settings = {name: value for name, value in change.items() if name in PARAMETERS}
            model = moved(model, change.get(TURN, 0.0), change.get(CLOCK, 0.0))
            left_out_s, tuned = None, tuned_for(self.tuning, HORIZONTAL)
            if OUTLIERS in change and tuned is not None:
                stamp = 1e-3 * self.inputs.settings[self.inputs.aid.delay]
                of_source = self.comparison.source.origin.by_gnss
                left_out_s = tuned.outlier_time_s - self.comparison.settings.clock_offset_s
                left_out_s = left_out_s + (stamp if of_source else 0.0) + change.get(CLOCK, 0.0)
            (self.replays[key],) = replay_settings(model, [settings], left_out_s)
        return self.replays[key]
