"""Wrong settings of EKF2: noise, innovation gate, and parameters that change in flight."""

import math
from itertools import pairwise

from px4fuse.analysis import Analysis
from px4fuse.comparison.comparison import compute_position_errors
from px4fuse.comparison.model import AxisComparison
from px4fuse.comparison.remedy import (
    find_aid,
    find_used_noise_m,
    format_changes,
    make_height_noise_advice,
    select_changed_settings,
)
from px4fuse.comparison.rerun_effects import (
    Rerun,
    becomes_consistent,
    classify_improvement,
    compute_preference_key,
    find_rerun,
)
from px4fuse.core.arrays import rms
from px4fuse.core.text import format_factor, format_metres, format_ratio
from px4fuse.filter.consistency import Consistency
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning
from px4fuse.flight.ekf2_parameters import AID_MASK_PARAMETER, MODEL_PARAMETERS
from px4fuse.flight.model import Ekf2, Unavailable

from .cause_text import format_action
from .model import (
    CAUSE_KEY,
    REPORTED_VARIANCE_USED_BY_EKF2_CAUSE,
    Findings,
    error_if,
    find_source_texts,
    finding,
    format_percent,
    make_note,
    make_warning,
    make_zero_length_spans,
)

# Wrong measurement noise of EKF2: severity "error" if the noise is at least this factor too small
# or too large
MIN_NOISE_FACTOR_FOR_SEVERITY_ERROR = 2.0
# Wrong measurement noise of EKF2: the message states the fraction of positions that EKF2 rejects,
# if the fraction is at least this value
MIN_REJECTED_FRACTION_IN_MESSAGE = 0.05
# Minimum fraction of rejected positions for a warning: with a gate of 5 √S, a consistent filter
# rejects a fraction of 6e-7
REJECTED_FRACTION_FOR_WARNING = 0.01
# Minimum fraction of rejected positions for severity "error"
MIN_REJECTED_FRACTION_FOR_SEVERITY_ERROR = 0.20
# A re-run with a changed setting prevents rejections if it reduces the rejected fraction to less
# than this multiple of the fraction without the change
MAX_REJECTED_AFTER_TO_BEFORE_RATIO = 0.5
# A parameter change in flight has an effect if EKF2's σ ratio or position RMSE changes by more than
# this factor
MIN_SIGMA_RATIO_OR_RMSE_CHANGE_FACTOR = 1.5


def detect(analysis: Analysis) -> Findings:
    yield from detect_wrong_noise(analysis)
    yield from detect_rejections(analysis)
    yield from detect_parameter_changes(analysis)


def detect_wrong_noise(analysis: Analysis) -> Findings:
    """Detect a wrong noise parameter of EKF2, confirmed by a replay."""
    rerun, aid = find_confirmed_noise_rerun(analysis), find_aid(analysis)
    if rerun is None:
        return
    assert not isinstance(analysis.ekf2_model, Unavailable)
    inputs, parameter = analysis.ekf2_model.inputs, aid.noise
    used_noise_m, estimated_noise_m = find_used_noise_m(inputs), rerun.change[parameter]
    # EKF2 uses the larger of reported σ and noise parameter
    noise_setting_m = inputs.settings[parameter]
    uses_reported_sigma = used_noise_m > noise_setting_m
    is_too_small = used_noise_m <= estimated_noise_m
    factor = max(estimated_noise_m / used_noise_m, used_noise_m / estimated_noise_m)
    size_word = "small" if is_too_small else "large"
    # 1. Title: the sensor is too noisy, or the setting is wrong
    sensor_name = analysis.source.kind_name
    name = "EKF2's assumed measurement noise" if uses_reported_sigma else parameter
    # PX4's default suits usual sensors: if it is too small, this sensor is noisier
    is_default_noise = used_noise_m == analysis.flight.log.find_default_value(parameter)
    if is_too_small and is_default_noise:
        title = f"{sensor_name} noise is {format_factor(factor)} times the noise setting of EKF2"
    else:
        title = f"{name} is {format_factor(factor)} times too {size_word}"
    # 2. Effect on EKF2: rejected positions, or a wrong gain
    rejected_fraction = analysis.main.rejected_fraction or 0.0
    if is_too_small and rejected_fraction >= MIN_REJECTED_FRACTION_IN_MESSAGE:
        title += f": EKF2 rejects {format_percent(rejected_fraction)} of the positions"
        reason = f"EKF2 rejects normal {sensor_name} noise as outliers."
    else:
        reason = f"EKF2's gain is too {'large' if is_too_small else 'small'}."
    # 3. Estimate with its 95 % interval, if known
    interval_text, horizontal_tuning = "", analysis.tuning.get(HORIZONTAL)
    if isinstance(horizontal_tuning, AxisTuning):
        low_m, high_m = horizontal_tuning.sigma_z.low, horizontal_tuning.sigma_z.high
        interval_text = f" (95 % {low_m:.3g} to {high_m:.3g} m)" if low_m and high_m else ""
    message = (
        f"{title}. {name} is {used_noise_m:.3g} m; the maximum-likelihood estimate is "
        f"{estimated_noise_m:.3g} m{interval_text}. {reason}"
    )
    # 4. Action: another parameter, or another reported variance
    action = f"Set {format_changes(select_changed_settings(rerun.change, inputs.settings))}."
    if uses_reported_sigma:
        mode_text = f" ({aid.noise_mode_parameter} 0)" if aid.noise_mode_parameter else ""
        message += (
            f" EKF2 uses the σ that {sensor_name} reports{mode_text}, because this σ is larger "
            f"than {parameter} ({noise_setting_m:g} m)."
        )
        action += f" Or let the position source report a variance of {estimated_noise_m**2:.2g} m²."
    yield finding(
        error_if(factor >= MIN_NOISE_FACTOR_FOR_SEVERITY_ERROR),
        f"ekf2_noise_too_{size_word}",
        message,
        action + make_height_noise_advice(analysis, analysis.tuning, estimated_noise_m),
        {
            "flown_m": used_noise_m,
            "estimate_m": estimated_noise_m,
            "factor": estimated_noise_m / used_noise_m,
            CAUSE_KEY: REPORTED_VARIANCE_USED_BY_EKF2_CAUSE if uses_reported_sigma else "",
        },
    )


def find_confirmed_noise_rerun(analysis: Analysis) -> Rerun | None:
    """Return a re-run in which another EKF2 measurement noise makes EKF2 consistent, or None."""
    rerun = find_rerun(analysis.select_main_reruns(), "ekf2", "noise", find_aid(analysis).noise)
    return rerun if rerun is not None and becomes_consistent(rerun, "source") else None


def detect_rejections(analysis: Analysis) -> Findings:
    """Detect positions that EKF2 rejects, and a gate so small that it causes the rejections."""
    ekf2 = analysis.flight.ekf2
    if not isinstance(ekf2, Ekf2):
        return
    rejection_findings = tuple(_find_rejections(analysis, ekf2.gate))
    # For a consistent filter, erf(gate/√2)² is the probability that both innovations, north and
    # east, are inside the gate
    expected_rejected_fraction = 1.0 - math.erf(ekf2.gate / math.sqrt(2.0)) ** 2
    # With such a small gate, even a consistent filter rejects at least 1 % of the positions
    if rejection_findings and expected_rejected_fraction >= REJECTED_FRACTION_FOR_WARNING:
        aid = find_aid(analysis)
        rejected_fraction = float(rejection_findings[0].evidence["rejected_fraction"])
        yield finding(
            rejection_findings[0].severity,
            "ekf2_gate_too_small",
            f"{aid.gate} {ekf2.gate:g} is too small: EKF2 rejects "
            f"{format_percent(rejected_fraction)} of the positions. Without any fault, this "
            f"gate rejects {format_percent(expected_rejected_fraction)}.",
            f"Set {aid.gate} to {aid.default_gate:g} (PX4's default, in multiples of √S).",
            {"gate": ekf2.gate, "rejected_by_gate": expected_rejected_fraction},
        )
    yield from rejection_findings


def _find_rejections(analysis: Analysis, gate: float) -> Findings:
    """Detect that EKF2 rejects at least 1 % of the positions, or of the heights."""
    down_comparison = analysis.axes.get("down")
    # EKF2 rejects north and east together, so one horizontal axis is sufficient
    results = [analysis.main]
    if down_comparison is not None and down_comparison is not analysis.main:
        results.append(down_comparison)
    for result in results:
        innovations = result.ekf2_tracks.innovations
        if isinstance(innovations, Unavailable):
            continue
        rejected_flags = innovations["rejected"].dropna()
        rejected_fraction = float(rejected_flags.mean())  # NaN without logged flags
        if rejected_fraction >= REJECTED_FRACTION_FOR_WARNING:
            quantity = "heights" if result is down_comparison else "positions"
            yield finding(
                error_if(rejected_fraction >= MIN_REJECTED_FRACTION_FOR_SEVERITY_ERROR),
                "ekf2_rejects_positions",
                f"EKF2 rejects {format_percent(rejected_fraction)} of the {quantity}. The "
                f"rejected innovations are outside EKF2's gate of {gate:g} √S.",
                _find_rejection_remedy(analysis, result),
                {
                    "rejected_fraction": rejected_fraction,
                    "count": len(innovations),
                    "axis": result.axis.name,
                },
                make_zero_length_spans(rejected_flags.index[rejected_flags > 0.0]),
            )


def _find_rejection_remedy(analysis: Analysis, result: AxisComparison) -> str:
    """Return the action against rejections along an axis."""
    aid = find_aid(analysis, result.axis.name)
    helpful_reruns = [
        rerun for rerun in analysis.select_main_reruns() if _prevents_rejections(rerun)
    ]
    if helpful_reruns and result is analysis.main:
        return format_action(analysis, min(helpful_reruns, key=compute_preference_key).change)
    return (
        f"{find_source_texts(analysis).data_link_check}. Then check {aid.delay} and "
        f"{aid.noise}. Increase {aid.gate} only if no fault is found."
    )


def _prevents_rejections(rerun: Rerun) -> bool:
    """Return True if a re-run with one change improves EKF2 and more than halves rejections."""
    before, after = rerun.before.rejected_fraction, rerun.after.rejected_fraction
    return (
        before is not None
        and after is not None
        # A re-run with two changes does not show which of them the user has to make
        and len(rerun.kinds) == 1
        and classify_improvement(rerun) != "nothing"
        and after < MAX_REJECTED_AFTER_TO_BEFORE_RATIO * before
    )


def detect_parameter_changes(analysis: Analysis) -> Findings:
    """Detect changes of EKF2 parameters in flight."""
    ekf2, segment = analysis.flight.ekf2, analysis.segment
    if not isinstance(ekf2, Ekf2):
        return
    fusion_parameters = (find_aid(analysis).switch, AID_MASK_PARAMETER)
    changes = [
        change
        for change in ekf2.parameter_changes
        if change.name in (*MODEL_PARAMETERS, *fusion_parameters)
        and segment.start_s < change.time_s < segment.end_s
    ]
    edges_s = [segment.start_s, *(change.time_s for change in changes), segment.end_s]
    spans = [_assess_span(analysis, *span_s) for span_s in pairwise(edges_s)]
    # Compare EKF2's mean NIS and position RMSE in the time spans before and after each parameter
    # change
    for (time_s, name, value_before, value_after), (before, after) in zip(
        changes, pairwise(spans), strict=True
    ):
        (nis_before, rmse_before_m), (nis_after, rmse_after_m) = before, after
        action = (
            f"Analyse the flight before (--end {time_s:.1f}) and after the parameter change "
            f"(--start {time_s:.1f}) separately."
        )
        if name in fusion_parameters:  # always has an effect: it switches sensors
            has_effect, unit_text = True, ""
            action = f"Do not change {name} in flight. {action}"
        else:
            unit = MODEL_PARAMETERS[name].printed_unit
            has_effect, unit_text = False, f" {unit}" if unit else ""
        effect_sentences = ""
        if not isinstance(nis_before, Unavailable) and not isinstance(nis_after, Unavailable):
            has_effect |= nis_before.verdict != nis_after.verdict
            has_effect |= _differ_by_min_factor(nis_before.sigma_ratio, nis_after.sigma_ratio)
            effect_sentences = (
                f" EKF2 is {_format_verdict(nis_before)} before the change and "
                f"{_format_verdict(nis_after)} after (innovations along "
                f"{analysis.main.axis.label})."
            )
        if _differ_by_min_factor(rmse_before_m, rmse_after_m):
            has_effect = True
            effect_sentences += (
                f" EKF2's position RMSE along {analysis.main.axis.label} is "
                f"{format_metres(rmse_before_m)} m "
                f"before and {format_metres(rmse_after_m)} m after the change."
            )
        yield (make_warning if has_effect else make_note)(
            "parameter_changed",
            f"{name} changed from {value_before:g} to {value_after:g}{unit_text} at {time_s:.1f} "
            f"s.{effect_sentences}",
            action,
            {"parameter": name, "before": value_before, "after": value_after, "at_s": time_s},
            ((time_s, time_s),),
        )


def _differ_by_min_factor(value_before: float, value_after: float) -> bool:
    """Return True if both values are known, and differ by more than the minimum factor."""
    low, high = sorted((value_before, value_after))
    return low > 0.0 and high > MIN_SIGMA_RATIO_OR_RMSE_CHANGE_FACTOR * low


def _format_verdict(consistency: Consistency) -> str:
    if consistency.verdict == "consistent":
        return "consistent"
    size_word = "small" if consistency.sigma_ratio > 1.0 else "large"
    factor = format_ratio(consistency.sigma_error_factor)
    return f"{consistency.verdict} (σ {factor} times too {size_word})"


def _assess_span(
    analysis: Analysis, start_s: float, end_s: float
) -> tuple[Consistency | Unavailable, float]:
    """Return consistency and position RMSE (m) of EKF2 in a time span; NaN without ground truth."""
    rmse_m = math.nan
    errors = compute_position_errors(analysis.main, "ekf2")
    if not isinstance(errors, Unavailable):
        rmse_m = rms(errors["error_m"].loc[start_s:end_s])
    innovations = analysis.main.ekf2_tracks.innovations
    if isinstance(innovations, Unavailable):
        return innovations, rmse_m
    samples = innovations.loc[start_s:end_s]
    consistency = Consistency.from_innovations(
        samples["innovation_m"].to_numpy(), samples["innovation_variance_m2"].to_numpy(), math.inf
    )
    return consistency, rmse_m
