"""SIGMA_Z or SIGMA_A that the innovations do not ask for, and S larger or smaller than they are.

The mean NIS alone cannot tell SIGMA_A from SIGMA_Z: both make S larger. The likelihood can, since
SIGMA_A makes the innovations of a stretch agree with each other and SIGMA_Z does not. Both are
fitted together, so that they are put right together: the one that is further off comes first. A
setting that nobody chose is advice, one step less severe than one that was.
"""

from typing import NamedTuple

import numpy as np
from msgspec import structs

from px4fuse.analysis import Analysis
from px4fuse.comparison import remedy
from px4fuse.comparison.estimates import first_axis_tuning
from px4fuse.comparison.interventions import (
    SETTING_CHANGES,
    SIGMA_A,
    SIGMA_Z,
    SMALLEST_SIGMA_Z_M,
    Intervention,
    cause_of,
    interventions_on,
    is_inconsistent,
    tuning_of_axis,
)
from px4fuse.comparison.model import FILTERS, AxisComparison, FilterName, FilterSummary
from px4fuse.comparison.projection import EKF2_MIN_NOISE_M
from px4fuse.comparison.remedy import aid_of
from px4fuse.ekf2_parameters import BAROMETER, PARAMETERS
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import within
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning, Noise
from px4fuse.findings.causes import CAUSE, ELSEWHERE, NOISE
from px4fuse.findings.hidden_errors import hidden_errors
from px4fuse.findings.model import Finding, Found, Severity, error, finding, one_level_lower
from px4fuse.findings.since import format_reason, format_remedy, format_remedy_of_ekf2, kind_of
from px4fuse.findings.source_positions import hardly_moved
from px4fuse.flight import Columns, Unavailable, sample_rate
from px4fuse.plain import format_factor, format_number

MIN_NOISE_RATIO = 1.5  # times, in standard deviation; below, the tracks hardly change
MIN_NOISE_RATIO_ERROR = 4.0  # times: the gain is a different one
RESPONSE_TIME_S = 2.5  # five times the lesson's; a vehicle turns around in less
INTERVAL_WIDENING = 1.5  # times the 95 % interval's reach; 0.3 % of clean flights lie beyond
MIN_LAG1_AUTOCORRELATION = 0.3  # correlation; white innovations stay below 2/√n, 0.2 at n = 100

SIGMA_OFF_ERROR = 2.0  # times, in standard deviation
NOISE_FITS = 1.25  # times: the median's own scatter below n = 100 (1.17/√n, two σ)
NOT_EXPLAINED = (
    "No change of a noise, the clock, the frame or the outliers explains half of it: look at the "
    "acceleration input (IMU rate, gaps, vibration) and at what else the findings name."
)
UNKNOWN_NOISE = "Which noise the data ask for could not be told: see tuning."


GROUPS = {"horizontal": ("north", "east", "aisle"), "vertical": ("down",)}
ONLY_HORIZONTAL = Unavailable("EKF2 replay", "the model of EKF2 is of horizontal position", "None.")
AGAINST_DRIFT = (
    "Nothing follows from innovations alone: against a source that may drift they show how well "
    "the filter follows it, not how wrong both are."
)
AGAINST_SLOW_ERRORS = (
    "Lower no noise for these innovations: errors of {} are slow for the most part, which R has to "
    "cover and innovations do not show."
)
AGAINST_TRUTH = (
    "Lower no noise for these innovations: the filter would claim less than its errors against the "
    "truth."
)

Member = tuple[AxisComparison, FilterSummary]


class SettingDeviation(NamedTuple):
    """How a setting is off: ``size`` times from the most likely value, or from its bound."""

    value: float
    size: float
    severity: Severity


def detect(analysis: Analysis) -> Found:
    """Settings first: the variances follow from them."""
    yield from deviating_settings(analysis)
    yield from process_noise_near_zero(analysis)
    yield from variances(analysis)


def deviating_settings(analysis: Analysis) -> Found:
    """What is off beyond its interval, the worse one first."""
    axis_tuning = first_axis_tuning(analysis.tuning, HORIZONTAL, "aisle", "down")
    if axis_tuning is None:
        return
    chosen = {SIGMA_Z: analysis.settings.sigma_z_m, SIGMA_A: analysis.settings.sigma_a_m_s2}
    ml_noises = {SIGMA_Z: axis_tuning.sigma_z, SIGMA_A: axis_tuning.filter_sigma_a}
    if hardly_moved(analysis):  # without motion the acceleration's noise is hardly seen
        del ml_noises[SIGMA_A]
    found = {
        name: setting_deviation(name, chosen[name], noise) for name, noise in ml_noises.items()
    }
    off = {name: each for name, each in found.items() if each is not None}
    # where a source may drift, or the truth shows it, innovations tell too little noise alone, and
    # a filter may follow such a source as closely as it likes
    drifts, slow = analysis.source.origin.may_drift, analysis.source.origin.is_gnss
    if drifts or slow or any(owner == "kf" for owner, *_ in hidden_errors(analysis)):
        off = {
            name: each
            for name, each in off.items()
            if chosen[name] < each.value and not (drifts and each.severity == "info")
        }
    if not off:
        return
    worst_first = sorted(off, key=lambda name: -off[name].size)
    values = {name: off[name].value for name in worst_first}
    if SIGMA_Z in values and axis_tuning.sigma_z.value is None:
        values[SIGMA_Z] = max(values[SIGMA_Z], SMALLEST_SIGMA_Z_M)
    held_out_gain = (
        None if isinstance(axis_tuning.held_out, Unavailable) else axis_tuning.held_out.gain_nats
    )
    remedy_text, first = remedy.format_kf_remedy(analysis, values, unseen_nats=held_out_gain), None
    for name in worst_first:
        (value, size, severity), noise = off[name], ml_noises[name]
        known, side = noise.value is not None, "small" if chosen[name] < value else "large"
        setting_finding = finding(
            severity,
            f"{name[:7]}_{side}",
            {
                "chosen": chosen[name],
                "most_likely": value,
                "factor": chosen[name] / value,
                "lag1_autocorrelation": getattr(
                    axis_tuning.before, "lag1_autocorrelation", float("nan")
                ),
            },
            axes=axis_tuning.name,
            times=format_factor(size),
            case=known,
            low=noise.low or 0.0,
            high=noise.high,
            within=known and bool(noise.high),
            remedy=remedy_text,
        )
        yield structs.replace(setting_finding, caused_by=first)
        first = first or setting_finding.id


def setting_deviation(name: str, chosen: float, ml_noise: Noise) -> SettingDeviation | None:
    """How far a setting is off, and how bad that is; None where it is not."""
    value = _value_or_bound(ml_noise)
    if value is None:
        return None
    low, high = (
        (0.0, value) if ml_noise.value is None else (ml_noise.low or 0.0, ml_noise.high or np.inf)
    )
    low, high = (value * (end / value) ** INTERVAL_WIDENING for end in (low, high))
    size = max(chosen / value, value / chosen)
    if low <= chosen <= high or size < MIN_NOISE_RATIO:
        return None
    severity: Severity = "error" if size >= MIN_NOISE_RATIO_ERROR else "warning"
    return SettingDeviation(
        value, size, one_level_lower(severity) if chosen == getattr(Settings(), name) else severity
    )


def process_noise_near_zero(analysis: Analysis) -> Found:
    """SIGMA_A so small that σ hardly grows between updates and new measurements are ignored.

    A slow filter is no mistake where nothing happens: its innovations must say that it lags. Told
    of the first axis on which it needs too long to follow.
    """
    for name, result in analysis.axes.items():
        updates, statement = result.replay.updates, result.filters["kf"]
        if isinstance(statement, Unavailable) or statement.verdict != "variance understated":
            continue
        if statement.lag1_autocorrelation < MIN_LAG1_AUTOCORRELATION:
            continue
        gain = float(updates["gain_position"].iloc[len(updates) // 2 :].median())
        response_s = 1.0 / (sample_rate(updates) * gain)
        if response_s < RESPONSE_TIME_S:
            continue
        after = result.replay.steps["position_variance_m2"].reindex(updates.index).to_numpy()
        before = updates["prior_position_variance_m2"].to_numpy()
        growth = float(np.median((before[1:] / after[:-1] - 1.0)[len(after) // 2 :]))
        tuned = tuning_of_axis(analysis.tuning, name)
        ml_sigma_a = None if tuned is None else tuned.filter_sigma_a.value
        remedy_text = (
            ""
            if ml_sigma_a is None
            else f" {remedy.format_kf_remedy(analysis, {SIGMA_A: ml_sigma_a})}"
        )
        yield error(
            "process_noise_forgotten",
            {"relative_growth": growth, "gain": gain, "response_s": response_s, "axis": name},
            sigma_a=analysis.settings.sigma_a_m_s2,
            cure=remedy_text,
        )
        return


def variances(analysis: Analysis) -> Found:
    """One finding for the horizontal axes, which the vertical one follows: they have one noise."""
    for owner in FILTERS:
        for over in (True, False):
            first = None
            for group, axes in GROUPS.items():
                results = [analysis.axes[name] for name in axes if name in analysis.axes]
                pairs = [(result, result.filters[owner]) for result in results]
                off = [(result, each) for result, each in pairs if is_inconsistent(each)]
                members = [pair for pair in off if (pair[1].sigma_factor > 1.0) == over]
                if members:
                    found = _variance_finding(analysis, owner, group, members)
                    yield structs.replace(found, caused_by=first)
                    first = found.id


def _variance_finding(
    analysis: Analysis, owner: FilterName, group: str, members: list[Member]
) -> Finding:
    """One finding for a group of axes, on the axis whose NIS is furthest from 1."""
    result, statement = max(members, key=lambda pair: abs(np.log(pair[1].nis_mean)))
    over, factor = statement.sigma_factor > 1.0, statement.sigma_error_factor
    severity: Severity = "error" if factor >= SIGMA_OFF_ERROR else "warning"
    if _is_default(analysis, owner, result):
        severity = one_level_lower(severity)
    tuned = tuning_of_axis(analysis.tuning, result.axis.name)
    stated = "overstated" if over else "understated"
    if over and analysis.source.origin.may_drift:
        severity, remedy_text, cause = "info", AGAINST_DRIFT, ELSEWHERE
    elif over and analysis.source.origin.is_gnss:
        is_barometer = analysis.source.aid(result.axis.name) == BAROMETER
        remedy_text = (
            _noise_above_reported(analysis) if owner == "ekf2" and not is_barometer else ""
        )
        cause = NOISE if remedy_text else ELSEWHERE
        slow = AGAINST_SLOW_ERRORS.format("a barometer" if is_barometer else "GNSS")
        severity, remedy_text = severity if remedy_text else "info", remedy_text or slow
    elif over and any(each == owner for each, *_ in hidden_errors(analysis)):
        remedy_text, cause = AGAINST_TRUTH, ELSEWHERE
    else:
        cause_found = cause_of(analysis.causes, owner, result.axis.name)
        cause, remedy_text = (
            kind_of(analysis, cause_found),
            _remedy(analysis, owner, result, tuned, cause_found),
        )
        severity = "info" if remedy_text == AGAINST_TRUTH else severity
    evidence: dict[str, float | str] = {
        "axis": result.axis.name,
        "sigma_factor": statement.sigma_factor,
        "nis_mean": statement.nis_mean,
        "outside_gate": statement.outside_gate,
        CAUSE: cause,
    }
    if tuned is not None and (ml_sigma_z := _value_or_bound(tuned.sigma_z)) is not None:
        evidence["sigma_z_asked_m"] = ml_sigma_z
        evidence["sigma_z_asked_is_upper_bound"] = float(tuned.sigma_z.value is None)
    return finding(
        severity,
        f"{owner}_variance_{stated}",
        evidence,
        times=format_factor(factor),
        nis=format_number(statement.nis_mean),
        band=statement.nis_band,
        group=group,
        remedy=remedy_text,
    )


def _noise_above_reported(analysis: Analysis) -> str:
    """What to set where EKF2's parameter holds R above the accuracy that a receiver states."""
    name = aid_of(analysis).noise
    parameter_m = analysis.flight.log.parameters.get(name, float("nan"))
    stated = within(analysis.source.samples, analysis.segment)[Columns.POSITION_VARIANCE[0]]
    stated_m = float(np.sqrt(stated.median()))
    if not parameter_m > NOISE_FITS * stated_m:  # false for NaN too
        return ""
    prefix = f"{name} {parameter_m:g} m holds R above what the receiver states ({stated_m:.2g} m)"
    return remedy.format_ekf2_remedy(
        analysis.ekf2_model,
        {name: float(f"{stated_m:.2g}")},
        remedy.noise_helps,
        why=f"{prefix}: where you trust the receiver, ",
        fallback_remedy=f"{prefix}.",
    )


def _is_default(analysis: Analysis, owner: FilterName, result: AxisComparison) -> bool:
    """Whether the measurement noise in force is the one that comes with the program."""
    if owner == "kf":
        chosen, own = analysis.settings, Settings()
        return (chosen.sigma_z_m, chosen.sigma_a_m_s2) == (own.sigma_z_m, own.sigma_a_m_s2)
    name = aid_of(analysis, result.axis.name).noise
    default = PARAMETERS[name].default
    untouched = analysis.flight.log.parameters.get(name, default) == default
    # a sender that reports a larger variance has chosen it
    return untouched and not abs(np.log(ekf2_noise_m(result) / default)) > np.log(NOISE_FITS)


def _value_or_bound(noise: Noise) -> float | None:
    """A noise by tuning, the same in all findings: a value, else an upper bound."""
    return noise.high if noise.value is None else noise.value


def _remedy(
    analysis: Analysis,
    owner: FilterName,
    result: AxisComparison,
    tuned: AxisTuning | None,
    cause: Intervention | None,
) -> str:
    """What to type or to set against the cause; where there is none, what it is not."""
    if cause is None:
        return _remedy_without_cause(analysis, owner, result, tuned)
    if owner == "ekf2":
        return format_remedy_of_ekf2(analysis, cause)
    if not cause.change.keys() <= SETTING_CHANGES:
        return format_remedy(analysis, cause)
    bounded = tuned is not None and tuned.sigma_z.value is None and SIGMA_Z in cause.change
    if not bounded:
        return remedy.format_kf_remedy(analysis, cause.change)
    return (
        "The source's noise is below what this rate can show. "
        f"{remedy.format_kf_remedy(analysis, cause.change, ', and less SIGMA_A')}"
    )


def _remedy_without_cause(
    analysis: Analysis, owner: FilterName, result: AxisComparison, tuned: AxisTuning | None
) -> str:
    """What was tried and how near it came, or that nothing could be."""
    tried = interventions_on(analysis.causes, owner, result.axis.name)
    if any(each.denied_by_truth for each in tried):
        return AGAINST_TRUTH
    if tried:
        nearest = min(tried, key=lambda each: abs(each.explains - 1.0))
        return f"{NOT_EXPLAINED} The nearest: {format_reason(analysis, nearest)}."
    if owner == "ekf2":
        return _remedy_without_replay(analysis, result, tuned)
    return UNKNOWN_NOISE if tuned is None else NOT_EXPLAINED


def _remedy_without_replay(
    analysis: Analysis, result: AxisComparison, tuned: AxisTuning | None
) -> str:
    """What the data ask of EKF2's noise where no replay can confirm it."""
    aid, model = aid_of(analysis, result.axis.name), analysis.ekf2_model
    reason: Unavailable | None = model if isinstance(model, Unavailable) else None
    if result.axis.name == "down":
        reason = ONLY_HORIZONTAL
    elif not isinstance(model, Unavailable) and not model.agreement.good:
        reason = model.agreement.as_unavailable("EKF2 replay")
    ml_noise_m = None if tuned is None else _value_or_bound(tuned.sigma_z)
    if ml_noise_m is None or reason is None:
        return UNKNOWN_NOISE if tuned is None else NOT_EXPLAINED
    noise_m, used_m = max(ml_noise_m, EKF2_MIN_NOISE_M), ekf2_noise_m(result)
    prefix = f"The source's noise is {noise_m:.2g} m, EKF2 takes it to be {used_m:.2g} m"
    statement = result.filters["ekf2"]
    assert not isinstance(statement, Unavailable)
    ratio = noise_m / used_m
    if not (ratio < 1.0 / NOISE_FITS if statement.sigma_factor > 1.0 else ratio > NOISE_FITS):
        return (
            f"{prefix}: that is not it. Look at the clock ({aid.delay}) and at EKF2's process noise "
            f"(EKF2_ACC_NOISE). {remedy.format_not_replayed(reason)}"
        )
    changes = remedy.noise_change(aid, analysis.flight.log.parameters, used_m, noise_m)
    return f"{prefix}: set {remedy.format_settings(changes)}. {remedy.format_not_replayed(reason)}"


def ekf2_noise_m(result: AxisComparison) -> float:
    """Median √R that EKF2 used; NaN where unknown."""
    frame = result.ekf2_innovations
    if isinstance(frame, Unavailable):
        return float("nan")
    return float(np.sqrt(frame["observation_variance_m2"].median()))
