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
from px4fuse.comparison.trials import Trial, becomes_consistent, find_trial
from px4fuse.core.text import format_factor
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning
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
    parameter_noise_m = inputs.settings[aid.noise]
    uses_reported_sigma = used_noise_m > parameter_noise_m
    ratio = estimated_noise_m / used_noise_m
    factor, size_word, gain_size_word = ratio, "small", "large"
    if ratio < 1.0:
        factor, size_word, gain_size_word = 1.0 / ratio, "large", "small"
    sensor_name = source_name(analysis.source)
    is_kf_noise_equal_to_ekf2 = analysis.source.origin.is_gnss and math.isclose(
        analysis.settings.sigma_z_m, used_noise_m, rel_tol=1e-2
    )
    effect_text = ""
    reason = f"EKF2's gain is too {gain_size_word}, and its reported σ is too {size_word}."
    rejected_fraction = analysis.main.rejected_fraction or 0.0
    if rejected_fraction >= MIN_REJECTED_FRACTION_IN_MESSAGE:
        effect_text = f": EKF2 rejects {format_percent(rejected_fraction)} of the positions"
        reason = f"EKF2 rejects normal {sensor_name} noise as outliers."
    name = "EKF2's position noise" if uses_reported_sigma else aid.noise
    title = f"{name} is {format_factor(factor)} times too {size_word}"
    is_default_noise = used_noise_m == analysis.flight.log.find_default_value(aid.noise)
    # PX4's default suits usual sensors: if it is too small, this sensor is noisier
    if ratio > 1.0 and is_default_noise:
        filter_names = "KF and EKF2" if is_kf_noise_equal_to_ekf2 else "EKF2"
        title = (
            f"{sensor_name} noise is {format_factor(factor)} times the noise setting of "
            f"{filter_names}"
        )
    interval_text, horizontal_tuning = "", analysis.tuning.get(HORIZONTAL)
    if isinstance(horizontal_tuning, AxisTuning):
        low_m, high_m = horizontal_tuning.sigma_z.low, horizontal_tuning.sigma_z.high
        interval_text = f" (95 % {low_m:.3g} to {high_m:.3g} m)" if low_m and high_m else ""
    message = (
        f"{title}{effect_text}. {name} is {used_noise_m:.3g} m; the maximum-likelihood estimate is "
        f"{estimated_noise_m:.3g} m{interval_text}. {reason}"
    )
    action = f"Set {format_settings(select_changed_settings(trial.change, inputs.settings))}."
    if uses_reported_sigma:
        mode_text = f" ({aid.noise_mode_parameter} 0)" if aid.noise_mode_parameter else ""
        message += (
            f" EKF2 uses the σ that {sensor_name} reports{mode_text}, because this σ is larger "
            f"than {aid.noise} ({parameter_noise_m:g} m)."
        )
        action += f" Alternatively, report a variance of {estimated_noise_m**2:.2g} m²."
    if is_kf_noise_equal_to_ekf2:
        message += f" KF takes SIGMA_Z from {aid.noise}."
    yield finding(
        "error" if factor >= MIN_NOISE_FACTOR_FOR_ERROR else "warning",
        f"ekf2_noise_too_{size_word}",
        message,
        action + make_height_noise_advice(analysis, analysis.tuning, estimated_noise_m),
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
    is_confirmed = trial is not None and becomes_consistent(trial, "source")
    return trial if is_confirmed else None
