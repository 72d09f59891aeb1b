"""Wrong SIGMA_Z or SIGMA_A of KF, and over- or underconfidence of KF or EKF2.

SIGMA_A and SIGMA_Z are estimated together, because the mean NIS does not distinguish them.
"""

from itertools import product
from typing import NamedTuple

import numpy as np
from msgspec import structs

from px4fuse.analysis import Analysis
from px4fuse.comparison.changes import SIGMA_A_KEY, SIGMA_Z_KEY, find_axis_tuning
from px4fuse.comparison.estimates import find_first_available_tuning
from px4fuse.comparison.model import FILTER_NAMES, AxisComparison, FilterName, FilterSummary
from px4fuse.comparison.projection import EKF2_MIN_NOISE_M
from px4fuse.comparison.remedy import find_aid, format_changes, make_noise_change
from px4fuse.comparison.rerun_effects import (
    Rerun,
    can_show_improvement,
    find_cause_rerun,
    find_rerun,
    find_reruns,
    makes_overconfident,
)
from px4fuse.comparison.reruns import is_inconsistent
from px4fuse.core.text import format_factor, format_number, format_ratio
from px4fuse.filter.settings import SETTING_RANGES, Settings
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning, NoiseEstimate
from px4fuse.finding import SEVERITIES, Finding, Severity
from px4fuse.flight.ekf2_parameters import BAROMETER, EV_POS, GNSS_POS, MODEL_PARAMETERS
from px4fuse.flight.model import Columns, Unavailable, compute_sample_rate_hz
from px4fuse.readers.px4_innovations import has_fused_aid
from px4fuse.request import COMPARISON_OPTIONS

from .cause_text import (
    classify_cause,
    format_action,
    format_kf_settings,
    rerun_refutes_cause,
)
from .hidden_errors import find_hidden_errors
from .model import (
    CAUSE_KEY,
    MEASUREMENT_NOISE_CAUSE,
    UNKNOWN_CAUSE,
    Findings,
    error_if,
    finding,
    lower_severity,
    make_error,
)
from .source_positions import has_little_motion

# Warning if a noise setting is at least this factor too small or too large
MIN_NOISE_SETTING_TO_ESTIMATE_FACTOR = 1.5
# Severity "error" if a noise setting is at least this factor too small or too large
MIN_NOISE_FACTOR_FOR_SEVERITY_ERROR = 4.0
# KF hardly reacts to new positions if its time constant exceeds this value (s)
MIN_KF_TIME_CONSTANT_S = 2.5
# Factor that widens the 95 % interval of ln(noise): only 0.3 % of correct noise settings are
# outside
CONFIDENCE_INTERVAL_WIDENING_FACTOR = 1.5
# KF lags if the lag-1 autocorrelation of its innovations exceeds this value (white noise: at most
# 0.2)
MIN_INNOVATION_LAG1_AUTOCORRELATION = 0.3

# Severity "error" if the reported σ is at least this factor too small or too large
MIN_SIGMA_FACTOR_FOR_SEVERITY_ERROR = 2.0
# Maximum ratio (larger ÷ smaller) of two noises that count as equal: a σ estimated from the median
# of 100 values has a standard error of 12 %
MAX_RATIO_OF_EQUAL_NOISES = 1.25
# EKF2 is assumed to use the variance in the messages if EKF2's √R ÷ EKF2_EVP_NOISE exceeds this
# ratio
MIN_USED_TO_PARAMETER_NOISE_RATIO = 1.25
UNEXPLAINED_SIGMA_ACTION = (
    "No tested change of data or settings makes the filter's σ consistent. Check the IMU (rate, "
    "gaps, vibration)."
)
UNKNOWN_NOISE_ACTION = "The noise could not be estimated; px4fuse tune LOG states the reason."
NO_IMPROVEMENT_ACTION = (
    "Change nothing: a re-run with the estimated noise improves neither KF's position nor its σ."
)
AXIS_GROUPS = (("north", "east", "aisle"), ("down",))
KEEP_NOISE_BECAUSE_OF_DRIFT_ACTION = (
    "Do not reduce noise settings: innovations do not show the drift of the source."
)
KEEP_NOISE_BECAUSE_OF_CORRELATION_ACTION = (
    "Do not reduce noise settings. Innovations do not show the time-correlated error of {sensor}, "
    "but R has to include this error."
)
KEEP_NOISE_BECAUSE_OF_TRUTH_ACTION = (
    "Do not reduce noise settings: ground truth shows that a smaller σ would be too small."
)


class SettingDeviation(NamedTuple):
    """Deviation of a noise setting from its estimate, or from the upper bound of the estimate.

    ``factor`` is the ratio of the larger to the smaller value.
    """

    estimate: float
    factor: float
    severity: Severity


def detect(analysis: Analysis) -> Findings:
    yield from detect_wrong_settings(analysis)
    yield from detect_process_noise_near_zero(analysis)
    yield from detect_inconsistent_variances(analysis)


def detect_wrong_settings(analysis: Analysis) -> Findings:
    """Detect KF noise settings that differ significantly from their estimates.

    The settings are SIGMA_A (acceleration noise) and SIGMA_Z (position noise).
    """
    axis_tuning = find_first_available_tuning(analysis.tuning, HORIZONTAL, "aisle", "down")
    if axis_tuning is None:
        return
    noise_estimates = {SIGMA_Z_KEY: axis_tuning.sigma_z, SIGMA_A_KEY: axis_tuning.sigma_a_two_state}
    if has_little_motion(analysis):  # without motion SIGMA_A cannot be estimated
        del noise_estimates[SIGMA_A_KEY]
    may_drift = analysis.source.origin.may_drift
    # The estimates are from innovations, which do not show drift and time-correlated errors. A
    # larger setting may be correct for odometry, for GNSS, and if KF's error exceeds its σ
    may_setting_exceed_estimate = (
        may_drift
        or analysis.source.origin.is_gnss
        or any(filter_name == "kf" for filter_name, *_ in find_hidden_errors(analysis))
    )
    findings = []
    for name, noise in noise_estimates.items():
        setting = getattr(analysis.settings, name)
        deviation = find_setting_deviation(name, setting, noise)
        if deviation is None:
            continue
        if may_setting_exceed_estimate and setting >= deviation.estimate:
            continue
        # For a source that may drift, report only large deviations
        if may_drift and deviation.severity == "note":
            continue
        setting_finding = _make_setting_finding(analysis, axis_tuning, name, noise, deviation)
        findings.append((deviation.factor, setting_finding))
    # SIGMA_Z and SIGMA_A are estimated together: the more severe finding (or, of equal severity,
    # the larger deviation) is the cause of the other
    findings.sort(key=lambda item: (SEVERITIES.index(item[1].severity), -item[0]))
    cause_id = None
    for _, setting_finding in findings:
        yield structs.replace(setting_finding, caused_by=cause_id)
        cause_id = cause_id or setting_finding.id


def _make_setting_finding(
    analysis: Analysis,
    axis_tuning: AxisTuning,
    name: str,
    noise: NoiseEstimate,
    deviation: SettingDeviation,
) -> Finding:
    """Make the finding on a KF noise setting (``name``) that is too small or too large."""
    estimated_noise, factor, severity = deviation
    setting, label = getattr(analysis.settings, name), SETTING_RANGES[name].label
    is_too_small = setting < estimated_noise
    # R = SIGMA_Z² decreases KF's gain, Q from SIGMA_A increases the gain
    is_gain_too_large = is_too_small if name == SIGMA_Z_KEY else not is_too_small
    if is_gain_too_large:
        effect, gain_size_word = "KF follows the noise of single positions", "large"
    else:
        effect, gain_size_word = "KF lags behind the positions", "small"
    size_word = "small" if is_too_small else "large"
    action = format_setting_action(analysis, name)
    return finding(
        "note" if action == NO_IMPROVEMENT_ACTION else severity,
        f"{label.lower()}_too_{size_word}",
        f"{label} is {'at least ' if noise.value is None else ''}{format_factor(factor)} "
        f"times too {size_word}: {effect}. {format_estimate(name, setting, noise)}. KF's gain is "
        f"too {gain_size_word}.",
        action,
        {
            "chosen": setting,
            "most_likely": estimated_noise,
            "factor": setting / estimated_noise,
            "lag1_autocorrelation": getattr(axis_tuning.before, "lag1_autocorrelation", np.nan),
        },
    )


def format_estimate(name: str, setting: float, noise: NoiseEstimate) -> str:
    """Format a noise setting with its maximum-likelihood estimate and 95 % interval."""
    unit, label = SETTING_RANGES[name][2:]
    value = f"at most {noise.high:.3g}" if noise.value is None else f"{noise.value:.3g}"
    value += f" {unit}"
    if noise.value is not None and noise.high:
        value += f" (95 % {noise.low or 0.0:.3g} to {noise.high:.3g} {unit})"
    return f"{label} is {setting:g} {unit}; its maximum-likelihood estimate is {value}"


def format_setting_action(analysis: Analysis, name: str) -> str:
    """Format the action on a KF noise setting that is wrong according to its estimate.

    The action is the change that a re-run confirmed. Without such a re-run, the text says why the
    setting is not changed or how to test it. ``name`` is the field of
    :class:`~px4fuse.filter.settings.Settings`.
    """
    if rerun := find_rerun(analysis.select_main_reruns(), "kf", "noises", name):
        return format_kf_settings(rerun.change)
    if any(
        rerun.filter == "kf" and rerun.change.keys() == {name} and can_show_improvement(rerun)
        for rerun in analysis.select_main_reruns()
    ):
        return NO_IMPROVEMENT_ACTION
    if getattr(analysis.request, name, None) is not None:
        return f"To test the default value, run again without {COMPARISON_OPTIONS[name]}."
    # SIGMA_A and SIGMA_Z are estimated together: setting only one of them to its estimate can make
    # a consistent KF inconsistent
    other_label = "SIGMA_A" if name == SIGMA_Z_KEY else "SIGMA_Z"
    return (
        f"Do not change this setting alone: it is estimated together with {other_label}, and no "
        "re-run confirmed the estimate."
    )


def find_setting_deviation(
    name: str, setting: float, noise_estimate: NoiseEstimate
) -> SettingDeviation | None:
    """Return the deviation of a noise setting from its estimate, if it is significant."""
    # An unknown end of the 95 % interval is 0 or infinite
    low, high = noise_estimate.low or 0.0, noise_estimate.high or np.inf
    estimate = noise_estimate.value
    if estimate is None:  # only an upper bound is known: compare the setting with this bound
        low, estimate = 0.0, noise_estimate.high
    if not estimate:
        return None
    # Widen the 95 % interval by a factor on the logarithmic scale:
    # ln(new end) = ln(estimate) + factor · (ln(end) - ln(estimate))
    low, high = (
        estimate * (end / estimate) ** CONFIDENCE_INTERVAL_WIDENING_FACTOR for end in (low, high)
    )
    factor = max(setting / estimate, estimate / setting)
    if low <= setting <= high or factor < MIN_NOISE_SETTING_TO_ESTIMATE_FACTOR:
        return None
    severity = error_if(factor >= MIN_NOISE_FACTOR_FOR_SEVERITY_ERROR)
    if setting == getattr(Settings(), name):  # px4fuse's default, not chosen by the user
        severity = lower_severity(severity)
    return SettingDeviation(estimate, factor, severity)


def detect_process_noise_near_zero(analysis: Analysis) -> Findings:
    """Detect a SIGMA_A so small that KF ignores new positions."""
    # The axis of largest motion is first (False is sorted before True). Report only one axis
    for result in sorted(analysis.axes.values(), key=lambda result: result is not analysis.main):
        updates, summary = result.kf_run.updates, result.filters["kf"]
        # A small SIGMA_A is a fault only if KF is overconfident and lags behind the motion. Without
        # motion there is no acceleration, so a small SIGMA_A is correct
        if (
            isinstance(summary, Unavailable)
            or summary.verdict != "overconfident"
            or summary.lag1_autocorrelation < MIN_INNOVATION_LAG1_AUTOCORRELATION
        ):
            continue
        # Gain of the second half of the flight, after convergence. Each update removes the fraction
        # `gain` of a deviation, so deviations decrease with the time constant 1 / (rate · gain)
        gain = float(updates["gain_position"].iloc[len(updates) // 2 :].median())
        time_constant_s = 1.0 / (compute_sample_rate_hz(updates) * gain)
        if time_constant_s < MIN_KF_TIME_CONSTANT_S:
            continue
        sigma_a_m_s2 = analysis.settings.sigma_a_m_s2
        axis_tuning = find_axis_tuning(analysis.tuning, result.axis.name)
        title, estimate_text = f"Process noise SIGMA_A is almost zero ({sigma_a_m_s2:g} m/s²)", ""
        action = "Increase SIGMA_A (--sigma-a)."
        if axis_tuning is not None and (estimate := axis_tuning.sigma_a_two_state).value:
            title = f"SIGMA_A is {format_factor(estimate.value / sigma_a_m_s2)} times too small"
            estimate_text = f"{format_estimate(SIGMA_A_KEY, sigma_a_m_s2, estimate)}. "
            action = format_setting_action(analysis, SIGMA_A_KEY)
        yield make_error(
            "process_noise_near_zero",
            f"{title}: KF ignores new positions. {estimate_text}KF's position gain decreases to "
            f"{gain:.2g}, so KF needs {time_constant_s:.0f} s to follow a change.",
            action,
            {"gain": gain, "response_s": time_constant_s, "axis": result.axis.name},
        )
        return


def detect_inconsistent_variances(analysis: Analysis) -> Findings:
    """Detect an under- or overconfident KF or EKF2, separately for horizontal and vertical axes."""
    for filter_name, is_underconfident in product(FILTER_NAMES, (True, False)):
        # id of the finding on the horizontal axes, which is the cause of the finding on the
        # vertical axis
        horizontal_finding_id = None
        for axes in AXIS_GROUPS:
            inconsistent_axes = [
                (analysis.axes[name], summary)
                for name in axes
                if name in analysis.axes
                and is_inconsistent(summary := analysis.axes[name].filters[filter_name])
                and (summary.sigma_ratio < 1.0) == is_underconfident
            ]
            if inconsistent_axes:
                sigma_finding = _make_wrong_sigma_finding(analysis, filter_name, inconsistent_axes)
                yield structs.replace(sigma_finding, caused_by=horizontal_finding_id)
                horizontal_finding_id = sigma_finding.id


def _make_wrong_sigma_finding(
    analysis: Analysis,
    filter_name: FilterName,
    inconsistent_axes: list[tuple[AxisComparison, FilterSummary]],
) -> Finding:
    """Make the finding on the most inconsistent of several axes; the main axis has priority."""
    worst_axis, summary = max(
        inconsistent_axes,
        key=lambda axis: (axis[0] is analysis.main, abs(np.log(axis[1].nis_mean))),
    )
    severity = error_if(summary.sigma_error_factor >= MIN_SIGMA_FACTOR_FOR_SEVERITY_ERROR)
    if _has_default_noises(analysis, filter_name, worst_axis):
        severity = lower_severity(severity)
    cause, remedy_text, is_note = _explain_wrong_sigma(analysis, filter_name, worst_axis, summary)
    low, high = summary.nis_band  # 95 % interval of the mean NIS of a consistent filter
    size_word = "large" if summary.sigma_ratio < 1.0 else "small"
    return finding(
        "note" if is_note else severity,
        f"{filter_name}_{summary.verdict}",
        f"{FILTER_NAMES[filter_name]} is {summary.verdict} along {worst_axis.axis.label}: σ is "
        f"{format_ratio(summary.sigma_error_factor)} times too {size_word}. The mean NIS is "
        f"{format_number(summary.nis_mean)}, expected {low:.2f} to {high:.2f}.",
        remedy_text,
        {
            "axis": worst_axis.axis.name,
            "sigma_ratio": summary.sigma_ratio,
            "nis_mean": summary.nis_mean,
            "fraction_outside_gate": summary.fraction_outside_gate,
            CAUSE_KEY: cause,
        },
    )


def _explain_wrong_sigma(
    analysis: Analysis, filter_name: FilterName, result: AxisComparison, summary: FilterSummary
) -> tuple[str, str, bool]:
    """Return cause and remedy of a wrong σ, and True if the wrong σ is no fault (severity note).

    An underconfident filter may need its large σ, because innovations do not show slow errors.
    These cases are tested first. Otherwise the re-run that corrects the mean NIS shows the cause.
    """
    source, is_ekf2 = analysis.source, filter_name == "ekf2"
    is_underconfident = summary.sigma_ratio < 1.0
    # 1. Too small innovations do not prove a fault: slow errors, which only ground truth shows, may
    # require the large σ
    may_have_slow_errors = is_underconfident and not summary.is_underconfident_against_truth
    if may_have_slow_errors and source.origin.may_drift:
        return UNKNOWN_CAUSE, KEEP_NOISE_BECAUSE_OF_DRIFT_ACTION, True
    if may_have_slow_errors and source.origin.is_gnss:
        is_barometer = source.aid(result.axis.name) == BAROMETER
        # EKF2's noise parameter is wrong if it is larger than the estimated noise and than the
        # noise that GNSS reports
        action = _format_action_for_excessive_noise(analysis)
        if is_ekf2 and not is_barometer and action:
            return MEASUREMENT_NOISE_CAUSE, action, False
        sensor = "a barometer" if is_barometer else "GNSS"
        return UNKNOWN_CAUSE, KEEP_NOISE_BECAUSE_OF_CORRELATION_ACTION.format(sensor=sensor), True
    # 2. An underconfident filter keeps its noise setting in two cases: PX4 permits no smaller
    # noise, or ground truth shows errors above the reported σ along one of the axes
    if is_underconfident and is_ekf2 and (action := _explain_noise_minimum(analysis)):
        return UNKNOWN_CAUSE, action, True
    if is_underconfident and any(name == filter_name for name, *_ in find_hidden_errors(analysis)):
        return UNKNOWN_CAUSE, KEEP_NOISE_BECAUSE_OF_TRUTH_ACTION, False
    # Find the cause by re-runs
    rerun = find_cause_rerun(analysis.reruns, filter_name, result.axis.name)
    action = _find_action_for_wrong_sigma(analysis, filter_name, result, rerun)
    is_kf_noise_from_ekf2 = is_underconfident and not is_ekf2 and source.origin.is_gnss
    is_note = is_kf_noise_from_ekf2 or action == KEEP_NOISE_BECAUSE_OF_TRUTH_ACTION
    return classify_cause(analysis, rerun), action, is_note


def _find_reported_noise_m(analysis: Analysis) -> float:
    return float(np.sqrt(analysis.source_samples[Columns.POSITION_VARIANCE[0]].median()))


def _format_action_for_excessive_noise(analysis: Analysis) -> str:
    """Return the action for an EKF2 noise parameter above reported and estimated noise; else ""."""
    name = find_aid(analysis).noise
    noise_setting_m = analysis.flight.log.parameters.get(name, np.nan)
    reported_noise_m = _find_reported_noise_m(analysis)
    noise_m, noise_label = reported_noise_m, "noise that the receiver reports"
    horizontal_tuning = analysis.tuning.get(HORIZONTAL)
    if isinstance(horizontal_tuning, AxisTuning):
        estimated_noise_m = horizontal_tuning.sigma_z.value or 0.0
        if estimated_noise_m > reported_noise_m:
            noise_m, noise_label = estimated_noise_m, "estimated noise"
    # `not >` instead of `<=`: an unknown parameter (NaN) gives no action
    if not noise_setting_m > MAX_RATIO_OF_EQUAL_NOISES * noise_m:
        return ""
    return (
        f"{name} is {noise_setting_m:g} m, but the {noise_label} is {noise_m:.2g} m. Test this "
        "smaller noise by a replay: px4fuse whatif LOG."
    )


def _explain_noise_minimum(analysis: Analysis) -> str:
    """Return the advice to change nothing if PX4 limits the noise from below; else ""."""
    parameters, origin = analysis.flight.log.parameters, analysis.source.origin
    gnss_noise_m = parameters.get(GNSS_POS.noise, MODEL_PARAMETERS[GNSS_POS.noise].default)
    if (
        origin.is_fused_as_gnss
        and (reported_noise_m := _find_reported_noise_m(analysis)) >= gnss_noise_m
    ):
        return (
            "Change nothing: EKF2 never assumes a GNSS position noise below the noise that the "
            f"receiver reports ({reported_noise_m:.2g} m)."
        )
    # While EKF2 fuses GNSS too, a smaller EKF2_EVP_NOISE has no effect
    if (
        origin.is_vision
        and has_fused_aid(analysis.flight.ekf2)
        and parameters.get(EV_POS.noise, 0.0) <= gnss_noise_m
    ):
        return (
            "Change nothing: while EKF2 also fuses GNSS, the noise of vision positions in PX4 is "
            f"at least {GNSS_POS.noise} ({gnss_noise_m:g} m)."
        )
    return ""


def _has_default_noises(
    analysis: Analysis, filter_name: FilterName, result: AxisComparison
) -> bool:
    """Return True if a filter uses default noise settings: PX4's (EKF2) or px4fuse's."""
    if filter_name != "ekf2":
        settings, defaults = analysis.settings, Settings()
        return (settings.sigma_z_m, settings.sigma_a_m_s2) == (
            defaults.sigma_z_m,
            defaults.sigma_a_m_s2,
        )
    parameter, log = find_aid(analysis, result.axis.name).noise, analysis.flight.log
    default_noise = log.find_default_value(parameter)
    if log.parameters.get(parameter, default_noise) != default_noise:
        return False
    # If √R differs from the noise parameter, EKF2 does not use the parameter as R, for example
    # because the source reports variances. Unknown R (NaN) counts as the default
    ratio = find_ekf2_noise_m(result) / default_noise
    return not max(ratio, 1.0 / ratio) > MAX_RATIO_OF_EQUAL_NOISES


def _find_action_for_wrong_sigma(
    analysis: Analysis,
    filter_name: FilterName,
    result: AxisComparison,
    cause: Rerun | None,
) -> str:
    """Return the action for a wrong σ of a filter along an axis."""
    if cause is not None and not rerun_refutes_cause(analysis, filter_name, cause):
        return format_action(analysis, cause.change)
    reruns = find_reruns(analysis.reruns, filter_name, result.axis.name)
    if any(makes_overconfident(rerun, "nis") for rerun in reruns):
        return KEEP_NOISE_BECAUSE_OF_TRUTH_ACTION
    axis_tuning = find_axis_tuning(analysis.tuning, result.axis.name)
    if axis_tuning is None:
        return UNKNOWN_NOISE_ACTION
    if filter_name == "ekf2" and not reruns:
        return _find_sigma_action_without_replay(analysis, result, axis_tuning)
    return UNEXPLAINED_SIGMA_ACTION


def _find_sigma_action_without_replay(
    analysis: Analysis, result: AxisComparison, axis_tuning: AxisTuning
) -> str:
    """Return the change of EKF2's noise to its estimate, if EKF2 cannot be replayed.

    If the estimate is unknown or does not explain the wrong σ, the text names other checks.
    """
    aid, ekf2_summary = find_aid(analysis, result.axis.name), result.filters["ekf2"]
    assert not isinstance(ekf2_summary, Unavailable)
    estimated_noise_m = axis_tuning.sigma_z.value_or_bound(0.0)
    noise_m, used_noise_m = max(estimated_noise_m, EKF2_MIN_NOISE_M), find_ekf2_noise_m(result)
    if not estimated_noise_m or np.isnan(used_noise_m):
        return UNEXPLAINED_SIGMA_ACTION
    # The estimated noise corrects an underconfident EKF2 only if it is smaller than the used noise,
    # and an overconfident EKF2 only if it is larger. In both cases, this ratio is above 1
    is_underconfident = ekf2_summary.sigma_ratio < 1.0
    ratio = used_noise_m / noise_m if is_underconfident else noise_m / used_noise_m
    if ratio <= MAX_RATIO_OF_EQUAL_NOISES:
        return (
            f"Keep EKF2's measurement noise ({used_noise_m:.2g} m): its estimate "
            f"({noise_m:.2g} m) does not explain the wrong σ. "
            "Check the time offset (px4fuse sync LOG) and the IMU (gaps, vibration)."
        )
    # If EKF2 used more noise than its parameter, it used the variances in the messages. A smaller
    # noise then also requires that EKF2 ignores these variances (make_noise_change)
    parameters, reported_noise_m = analysis.flight.log.parameters, 0.0
    noise_setting_m = parameters.get(aid.noise, np.inf)
    if used_noise_m > MIN_USED_TO_PARAMETER_NOISE_RATIO * noise_setting_m:
        reported_noise_m = used_noise_m
    noise_change = make_noise_change(aid, parameters, reported_noise_m, noise_m)
    changes = {name: value for name, value in noise_change.items() if value != parameters.get(name)}
    if not changes:
        return UNEXPLAINED_SIGMA_ACTION
    return (
        f"Set {format_changes(changes)}. EKF2 used a measurement noise of {used_noise_m:.2g} m. "
        "Fly again to test the change, because EKF2 cannot be replayed."
    )


def find_ekf2_noise_m(result: AxisComparison) -> float:
    """Return EKF2's median measurement noise √R (m) along an axis; NaN if unknown."""
    innovations = result.ekf2_tracks.innovations
    if isinstance(innovations, Unavailable):
        return np.nan
    return float(np.sqrt(innovations["observation_variance_m2"].median()))
