"""EKF2 measurement noise parameter that is too small or too large, confirmed by a replay."""

import math

from px4fuse.analysis import Analysis
from px4fuse.comparison.remedy import (
    find_aid,
    find_used_noise_m,
    format_settings,
    make_height_noise_advice,
    select_changed_settings,
)
from px4fuse.comparison.trials import Trial, compare_sigma_ratios, find_trial
from px4fuse.core.text import format_factor
from px4fuse.filter.consistency import classify_sigma_ratio
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning
from px4fuse.finding import Severity
from px4fuse.findings.cause_grouping import CAUSE_KEY, REPORTED_VARIANCE_USED_BY_EKF2_CAUSE
from px4fuse.findings.model import Findings, finding, format_percent
from px4fuse.flight.model import Unavailable, source_name

# Minimum factor between EKF2's noise parameter and its estimate, for severity "error"
MIN_NOISE_FACTOR_FOR_ERROR = 2.0
MIN_REJECTED_FRACTION_IN_MESSAGE = 0.05


def detect(analysis: Analysis) -> Findings:
    """Detect a wrong noise parameter of EKF2, confirmed by a replay."""
    trial, aid = find_confirmed_noise_trial(analysis), find_aid(analysis)
    if trial is None:
        return
    assert not isinstance(analysis.ekf2_model, Unavailable)
    inputs = analysis.ekf2_model.inputs
    used_noise_m, estimated_noise_m = find_used_noise_m(inputs), trial.change[aid.noise]
    # EKF2 uses the larger of reported σ and noise parameter
    uses_reported_sigma = used_noise_m > inputs.settings[aid.noise]
    ratio, is_set_too_small = estimated_noise_m / used_noise_m, estimated_noise_m > used_noise_m
    factor, size_word = max(ratio, 1.0 / ratio), "small" if is_set_too_small else "large"
    sensor_name = source_name(analysis.source)
    is_kf_noise_equal_to_ekf2 = analysis.source.origin.is_gnss and math.isclose(
        analysis.settings.sigma_z_m, used_noise_m, rel_tol=1e-2
    )
    rejected_fraction = analysis.main.rejected_fraction or 0.0
    if rejected_fraction >= MIN_REJECTED_FRACTION_IN_MESSAGE:
        effect_text = f": EKF2 rejects {format_percent(rejected_fraction)} of the positions"
        reason = f"EKF2 rejects normal {sensor_name} noise as outliers and relies on the IMU."
    else:
        effect_text, gain_size_word = "", "large" if is_set_too_small else "small"
        reason = (
            f"With a noise of {used_noise_m:.3g} m, EKF2's gain is too {gain_size_word}, and its "
            f"reported σ is too {size_word}."
        )
    name = "EKF2's position noise" if uses_reported_sigma else aid.noise
    title = f"{name} is {format_factor(factor)} times too {size_word}{effect_text}"
    is_default_noise = used_noise_m == analysis.flight.log.find_default_value(aid.noise)
    # PX4's default suits usual sensors: if it is too small, this sensor is noisier
    if is_set_too_small and is_default_noise:
        filter_names = "KF and EKF2" if is_kf_noise_equal_to_ekf2 else "EKF2"
        title = (
            f"{sensor_name} noise is {format_factor(factor)} times the noise setting of "
            f"{filter_names}{effect_text}"
        )
    source_sentence = ""
    variance_action = ""
    if uses_reported_sigma:
        variance_action = (
            f" Alternatively, report a variance of {estimated_noise_m**2:.2g} m² with each "
            "position."
        )
        mode_text = f" ({aid.noise_mode_parameter} 0)" if aid.noise_mode_parameter else ""
        source_sentence = (
            f"EKF2 uses the σ that {sensor_name} reports{mode_text}, because this σ is larger than "
            f"{aid.noise} ({inputs.settings[aid.noise]:g} m). "
        )
    interval_text, horizontal_tuning = "", analysis.tuning.get(HORIZONTAL)
    if (
        isinstance(horizontal_tuning, AxisTuning)
        and horizontal_tuning.sigma_z.low
        and horizontal_tuning.sigma_z.high
    ):
        interval_text = (
            f" (95 % {horizontal_tuning.sigma_z.low:.3g} to {horizontal_tuning.sigma_z.high:.3g} m)"
        )
    severity: Severity = "error" if factor >= MIN_NOISE_FACTOR_FOR_ERROR else "warning"
    yield finding(
        severity,
        f"ekf2_noise_too_{size_word}",
        f"{title}. {name} is {used_noise_m:.3g} m; the maximum-likelihood estimate is "
        f"{estimated_noise_m:.3g} m{interval_text}. "
        f"{source_sentence}{reason}"
        f"{f' KF takes SIGMA_Z from {aid.noise}.' if is_kf_noise_equal_to_ekf2 else ''}",
        f"Set {format_settings(select_changed_settings(trial.change, inputs.settings))}."
        f"{variance_action}"
        f"{make_height_noise_advice(analysis, analysis.tuning, estimated_noise_m)}",
        {
            "flown_m": used_noise_m,
            "estimate_m": estimated_noise_m,
            "factor": ratio,
            CAUSE_KEY: REPORTED_VARIANCE_USED_BY_EKF2_CAUSE if uses_reported_sigma else "",
        },
    )


def find_confirmed_noise_trial(analysis: Analysis) -> Trial | None:
    """Return a re-run in which another EKF2 measurement noise makes EKF2 consistent, or None."""
    trial = find_trial(analysis.select_main_trials(), "ekf2", "noise", find_aid(analysis).noise)
    is_confirmed = trial is not None and any(
        classify_sigma_ratio(ratio_before, reference) != "consistent"
        and classify_sigma_ratio(ratio_after, reference) == "consistent"
        for reference, ratio_before, ratio_after in compare_sigma_ratios(trial)
        if reference == "source"
    )
    return trial if is_confirmed else None
