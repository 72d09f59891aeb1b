"""SIGMA_Z or SIGMA_A that contradicts the innovations, and KF or EKF2 that is not consistent.

The mean NIS alone cannot separate SIGMA_A from SIGMA_Z: both increase S. The likelihood can:
SIGMA_A correlates the innovations that follow each other, SIGMA_Z does not. Both are estimated
together and proposed together, the larger deviation first. A deviation of a default setting is one
severity level lower than that of a chosen one.
"""

from typing import NamedTuple

import numpy as np
from msgspec import structs

from px4fuse.analysis import Analysis
from px4fuse.comparison import remedy
from px4fuse.comparison.causal_replays import (
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
from px4fuse.comparison.estimates import first_axis_tuning
from px4fuse.comparison.model import FILTERS, AxisComparison, FilterName, FilterSummary
from px4fuse.comparison.projection import EKF2_MIN_NOISE_M
from px4fuse.comparison.remedy import aid_of
from px4fuse.ekf2_parameters import BAROMETER, PARAMETERS
from px4fuse.filter.settings import UNITS, Settings
from px4fuse.filter.signals import cut_to_segment
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning, Noise
from px4fuse.findings.cause_grouping import CAUSE, ELSEWHERE, NOISE
from px4fuse.findings.cause_text import format_remedy, format_remedy_of_ekf2, format_rerun, kind_of
from px4fuse.findings.hidden_errors import hidden_errors
from px4fuse.findings.model import (
    Finding,
    Found,
    Severity,
    error,
    finding,
    format_percent,
    one_level_lower,
)
from px4fuse.findings.source_positions import hardly_moved
from px4fuse.flight import Columns, Unavailable, sample_rate
from px4fuse.text import format_factor, format_number

MIN_NOISE_RATIO = 1.5  # ratio of σ; below, the tracks hardly change
MIN_NOISE_RATIO_ERROR = 4.0  # ratio of σ; the gain differs clearly
MIN_RESPONSE_TIME_S = 2.5  # s; five times that of the lesson, a vehicle turns around in less
INTERVAL_WIDENING = 1.5  # factor on the 95 % interval (log scale); 0.3 % of clean flights exceed it
MIN_LAG1_AUTOCORRELATION = 0.3  # white innovations stay below 2/√n, 0.2 for n = 100

SIGMA_RATIO_ERROR = 2.0  # reported over actual σ, or its inverse
NOISE_RATIO_TOLERANCE = 1.25  # 2 σ of the median for n = 100 (σ of the median: 1.17/√n)
NOT_EXPLAINED = (
    "No tested change of noise, time offset, frame or outliers explains half of the deviation. "
    "Check the IMU (rate, gaps, vibration) and the other findings."
)
UNKNOWN_NOISE = "The noise could not be estimated; px4fuse tune prints the reason."


GROUPS = {"horizontal": ("north", "east", "aisle"), "vertical": ("down",)}
ONLY_HORIZONTAL = Unavailable(
    "EKF2 replay", "the EKF2 replay covers horizontal position only", "None."
)
KEEP_NOISES_DRIFT = (
    "Do not reduce the noises. The source may drift, and innovations do not show this error."
)
KEEP_NOISES_CORRELATED = (
    "Do not reduce the noises. Most of the error of {} is time-correlated: R has to cover it, but "
    "innovations do not show it."
)
KEEP_NOISES_TRUTH = (
    "Do not reduce the noises. The reported σ would become smaller than the errors against ground "
    "truth."
)
# Effect of a wrong setting, by option and direction
SETTING_EFFECTS = {
    (SIGMA_Z, "small"): "The gain is too large, so KF follows the measurement noise.",
    (SIGMA_Z, "large"): "The gain is too small, so KF corrects slowly.",
    (SIGMA_A, "small"): "P grows too little between updates, the gain is too small, and KF lags.",
    (SIGMA_A, "large"): (
        "P grows too much between updates, the gain is too large, and KF follows the measurement "
        "noise."
    ),
}

Member = tuple[AxisComparison, FilterSummary]


class SettingDeviation(NamedTuple):
    """Deviation of a setting.

    Attributes
    ----------
    value : float
        Maximum-likelihood estimate, or its upper bound.
    size : float
        Ratio of the setting and this value, at least 1.
    severity : Severity
    """

    value: float
    size: float
    severity: Severity


def detect(analysis: Analysis) -> Found:
    """Detect wrong settings, then the inconsistent variances that follow from them."""
    yield from deviating_settings(analysis)
    yield from process_noise_near_zero(analysis)
    yield from variances(analysis)


def deviating_settings(analysis: Analysis) -> Found:
    """Detect settings outside their (widened) 95 % interval, the larger deviation first."""
    axis_tuning = first_axis_tuning(analysis.tuning, HORIZONTAL, "aisle", "down")
    if axis_tuning is None:
        return
    chosen = {SIGMA_Z: analysis.settings.sigma_z_m, SIGMA_A: analysis.settings.sigma_a_m_s2}
    ml_noises = {SIGMA_Z: axis_tuning.sigma_z, SIGMA_A: axis_tuning.sigma_a_two_state}
    if hardly_moved(analysis):  # without motion SIGMA_A cannot be estimated
        del ml_noises[SIGMA_A]
    found = {
        name: setting_deviation(name, chosen[name], noise) for name, noise in ml_noises.items()
    }
    off = {name: each for name, each in found.items() if each is not None}
    # innovations of a source with drift or time-correlated errors (also shown by ground truth) only
    # prove that a noise is too small, not that it is too large
    drifts, has_slow_errors = analysis.source.origin.may_drift, analysis.source.origin.is_gnss
    if drifts or has_slow_errors or any(owner == "kf" for owner, *_ in hidden_errors(analysis)):
        off = {
            name: each
            for name, each in off.items()
            if chosen[name] < each.value and not (drifts and each.severity == "note")
        }
    if not off:
        return
    worst_first = sorted(off, key=lambda name: -off[name].size)
    values = {name: off[name].value for name in worst_first}
    if SIGMA_Z in values and axis_tuning.sigma_z.value is None:
        values[SIGMA_Z] = max(values[SIGMA_Z], SMALLEST_SIGMA_Z_M)
    held_out_gain = (
        None
        if isinstance(axis_tuning.held_out, Unavailable)
        else axis_tuning.held_out.log_likelihood_gain_per_measurement
    )
    remedy_text, first = remedy.format_kf_remedy(analysis, values, unseen_nats=held_out_gain), None
    for name in worst_first:
        (value, size, severity), noise = off[name], ml_noises[name]
        (value, size, severity), noise = off[name], ml_noises[name]
        side, unit = "small" if chosen[name] < value else "large", UNITS[name]
        is_bound = noise.value is None
        interval = f"; 95 % {noise.low or 0.0:.3g} to {noise.high:.3g} {unit}" if noise.high else ""
        setting_finding = finding(
            severity,
            f"{name[:7]}_too_{side}",
            f"{name[:7].upper()} {chosen[name]:g} {unit} is {'at least ' if is_bound else ''}"
            f"{format_factor(size)} times too {side}. The maximum-likelihood estimate is "
            f"{'at most ' if is_bound else ''}{value:.3g} {unit} ({axis_tuning.name}"
            f"{'' if is_bound else interval}). {SETTING_EFFECTS[name, side]}",
            remedy_text,
            {
                "chosen": chosen[name],
                "most_likely": value,
                "factor": chosen[name] / value,
                "lag1_autocorrelation": getattr(
                    axis_tuning.before, "lag1_autocorrelation", float("nan")
                ),
            },
        )
        yield structs.replace(setting_finding, caused_by=first)
        first = first or setting_finding.id


def setting_deviation(name: str, chosen: float, ml_noise: Noise) -> SettingDeviation | None:
    """Compare a setting with its maximum-likelihood estimate; None if the deviation is small."""
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
    """Detect SIGMA_A so small that σ hardly grows between updates and KF ignores measurements.

    A slow filter is correct without motion, so correlated, too large innovations are required. The
    first axis with a long response time is reported.
    """
    for name, result in analysis.axes.items():
        updates, statement = result.replay.updates, result.filters["kf"]
        if isinstance(statement, Unavailable) or statement.verdict != "overconfident":
            continue
        if statement.lag1_autocorrelation < MIN_LAG1_AUTOCORRELATION:
            continue
        gain = float(updates["gain_position"].iloc[len(updates) // 2 :].median())
        response_s = 1.0 / (sample_rate(updates) * gain)
        if response_s < MIN_RESPONSE_TIME_S:
            continue
        after = result.replay.steps["position_variance_m2"].reindex(updates.index).to_numpy()
        before = updates["prior_position_variance_m2"].to_numpy()
        growth = float(np.median((before[1:] / after[:-1] - 1.0)[len(after) // 2 :]))
        tuned = tuning_of_axis(analysis.tuning, name)
        ml_sigma_a = None if tuned is None else tuned.sigma_a_two_state.value
        remedy_text = (
            ""
            if ml_sigma_a is None
            else f" {remedy.format_kf_remedy(analysis, {SIGMA_A: ml_sigma_a})}"
        )
        sigma_a = analysis.settings.sigma_a_m_s2
        yield error(
            "process_noise_near_zero",
            f"SIGMA_A {sigma_a:g} m/s² makes Q almost zero. The position variance grows by only "
            f"{format_percent(growth, 1)} between updates, and the gain falls to {gain:.3f}. KF "
            f"needs {response_s:.0f} s to follow a change (along {result.axis.label}).",
            f"Increase SIGMA_A.{remedy_text}",
            {"relative_growth": growth, "gain": gain, "response_s": response_s, "axis": name},
        )
        return


def variances(analysis: Analysis) -> Found:
    """Detect inconsistent variances; the vertical axis follows the horizontal group."""
    for owner in FILTERS:
        for over in (True, False):
            first = None
            for group, axes in GROUPS.items():
                results = [analysis.axes[name] for name in axes if name in analysis.axes]
                pairs = [(result, result.filters[owner]) for result in results]
                off = [(result, each) for result, each in pairs if is_inconsistent(each)]
                members = [pair for pair in off if (pair[1].sigma_ratio < 1.0) == over]
                if members:
                    found = _variance_finding(analysis, owner, group, members)
                    yield structs.replace(found, caused_by=first)
                    first = found.id


def _variance_finding(
    analysis: Analysis, owner: FilterName, group: str, members: list[Member]
) -> Finding:
    """Make one finding for a group of axes, with the axis whose mean NIS is furthest from 1."""
    result, statement = max(members, key=lambda pair: abs(np.log(pair[1].nis_mean)))
    over, factor = statement.sigma_ratio < 1.0, statement.sigma_error_factor
    severity: Severity = "error" if factor >= SIGMA_RATIO_ERROR else "warning"
    if _is_default(analysis, owner, result):
        severity = one_level_lower(severity)
    tuned = tuning_of_axis(analysis.tuning, result.axis.name)
    confidence = "underconfident" if over else "overconfident"
    if over and analysis.source.origin.may_drift:
        severity, remedy_text, cause = "note", KEEP_NOISES_DRIFT, ELSEWHERE
    elif over and analysis.source.origin.is_gnss:
        is_barometer = analysis.source.aid(result.axis.name) == BAROMETER
        remedy_text = (
            _noise_above_reported(analysis) if owner == "ekf2" and not is_barometer else ""
        )
        cause = NOISE if remedy_text else ELSEWHERE
        keep = KEEP_NOISES_CORRELATED.format("a barometer" if is_barometer else "GNSS")
        severity, remedy_text = severity if remedy_text else "note", remedy_text or keep
    elif over and any(each == owner for each, *_ in hidden_errors(analysis)):
        remedy_text, cause = KEEP_NOISES_TRUTH, ELSEWHERE
    else:
        cause_found = cause_of(analysis.causes, owner, result.axis.name)
        cause, remedy_text = (
            kind_of(analysis, cause_found),
            _remedy(analysis, owner, result, tuned, cause_found),
        )
        severity = "note" if remedy_text == KEEP_NOISES_TRUTH else severity
    evidence: dict[str, float | str] = {
        "axis": result.axis.name,
        "sigma_ratio": statement.sigma_ratio,
        "nis_mean": statement.nis_mean,
        "fraction_outside_gate": statement.fraction_outside_gate,
        CAUSE: cause,
    }
    if tuned is not None and (ml_sigma_z := _value_or_bound(tuned.sigma_z)) is not None:
        evidence["sigma_z_asked_m"] = ml_sigma_z
        evidence["sigma_z_asked_is_upper_bound"] = float(tuned.sigma_z.value is None)
    low, high = statement.nis_band
    name, gate_effect = {"kf": "KF", "ekf2": "EKF2"}[owner], ""
    if owner == "ekf2":
        accepted = "accept positions with large errors" if over else "reject good positions"
        gate_effect = f" The gate of EKF2 may then {accepted}."
    return finding(
        severity,
        f"{owner}_{confidence}",
        f"{name} is {confidence} along {result.axis.label}: σ is "
        f"{format_factor(factor)} times too {'large' if over else 'small'}. The mean NIS is "
        f"{format_number(statement.nis_mean)}, expected {low:.2f} to {high:.2f} ({group} axes)."
        f"{gate_effect}",
        remedy_text,
        evidence,
    )


def _noise_above_reported(analysis: Analysis) -> str:
    """Action if EKF2's parameter keeps R above the accuracy that the receiver reports, else ""."""
    name = aid_of(analysis).noise
    parameter_m = analysis.flight.log.parameters.get(name, float("nan"))
    stated = cut_to_segment(analysis.source.samples, analysis.segment)[Columns.POSITION_VARIANCE[0]]
    stated_m = float(np.sqrt(stated.median()))
    if not parameter_m > NOISE_RATIO_TOLERANCE * stated_m:  # false for NaN too
        return ""
    prefix = f"{name} {parameter_m:g} m exceeds the accuracy reported by GNSS ({stated_m:.2g} m)"
    return remedy.format_ekf2_remedy(
        analysis.ekf2_model,
        {name: float(f"{stated_m:.2g}")},
        remedy.noise_helps,
        why=f"{prefix}. If the reported accuracy is right, ",
        fallback_remedy=f"{prefix}.",
    )


def _is_default(analysis: Analysis, owner: FilterName, result: AxisComparison) -> bool:
    """Return True if the noises in use are defaults of px4fuse (KF) or PX4 (EKF2)."""
    if owner == "kf":
        chosen, own = analysis.settings, Settings()
        return (chosen.sigma_z_m, chosen.sigma_a_m_s2) == (own.sigma_z_m, own.sigma_a_m_s2)
    name = aid_of(analysis, result.axis.name).noise
    default = PARAMETERS[name].default
    untouched = analysis.flight.log.parameters.get(name, default) == default
    # a variance that the sender reports is a choice of the user
    return untouched and not abs(np.log(ekf2_noise_m(result) / default)) > np.log(
        NOISE_RATIO_TOLERANCE
    )


def _value_or_bound(noise: Noise) -> float | None:
    """Maximum-likelihood value of a noise, else its upper bound."""
    return noise.high if noise.value is None else noise.value


def _remedy(
    analysis: Analysis,
    owner: FilterName,
    result: AxisComparison,
    tuned: AxisTuning | None,
    cause: Intervention | None,
) -> str:
    """Action against the cause; without a cause, the changes that do not explain the deviation."""
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
        "The noise of the source is too small to be estimated at this rate. "
        f"{remedy.format_kf_remedy(analysis, cause.change, ', and a smaller SIGMA_A')}"
    )


def _remedy_without_cause(
    analysis: Analysis, owner: FilterName, result: AxisComparison, tuned: AxisTuning | None
) -> str:
    """Action if no re-run explains the deviation, with the closest re-run."""
    tried = interventions_on(analysis.causes, owner, result.axis.name)
    if any(each.contradicts_truth for each in tried):
        return KEEP_NOISES_TRUTH
    if tried:
        nearest = min(tried, key=lambda each: abs(each.explained_fraction - 1.0))
        return f"{NOT_EXPLAINED} Closest: {format_rerun(analysis, nearest)}."
    if owner == "ekf2":
        return _remedy_without_replay(analysis, result, tuned)
    return UNKNOWN_NOISE if tuned is None else NOT_EXPLAINED


def _remedy_without_replay(
    analysis: Analysis, result: AxisComparison, tuned: AxisTuning | None
) -> str:
    """Compare EKF2's measurement noise with the estimated noise if no replay is possible."""
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
    prefix = f"The noise of the source is {noise_m:.2g} m, EKF2 uses {used_m:.2g} m"
    statement = result.filters["ekf2"]
    assert not isinstance(statement, Unavailable)
    ratio = noise_m / used_m
    if not (
        ratio < 1.0 / NOISE_RATIO_TOLERANCE
        if statement.sigma_ratio < 1.0
        else ratio > NOISE_RATIO_TOLERANCE
    ):
        return (
            f"{prefix}: this does not explain the deviation. Check the time offset ({aid.delay}) "
            f"and EKF2's process noise (EKF2_ACC_NOISE). {remedy.format_not_replayed(reason)}"
        )
    changes = remedy.noise_change(aid, analysis.flight.log.parameters, used_m, noise_m)
    return f"{prefix}. Set {remedy.format_settings(changes)}. {remedy.format_not_replayed(reason)}"


def ekf2_noise_m(result: AxisComparison) -> float:
    """Median √R (m) that EKF2 used; NaN if unknown."""
    frame = result.ekf2_innovations
    if isinstance(frame, Unavailable):
        return float("nan")
    return float(np.sqrt(frame["observation_variance_m2"].median()))
