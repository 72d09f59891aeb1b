"""EKF2 parameters that are changed in flight, and EKF2's consistency before and after."""

import math
from itertools import pairwise
from typing import NamedTuple

from px4fuse.analysis import Analysis
from px4fuse.comparison.comparison import compute_position_errors
from px4fuse.comparison.remedy import find_aid
from px4fuse.core.text import format_metres, format_ratio
from px4fuse.filter.consistency import Consistency, assess_innovations
from px4fuse.findings.model import Findings, make_note, make_warning
from px4fuse.flight.ekf2_parameters import AID_MASK_PARAMETER, PARAMETERS
from px4fuse.flight.model import Ekf2, Unavailable

# A parameter change has an effect if σ ratio or RMSE change by at least this factor
MIN_SIGMA_RATIO_OR_RMSE_CHANGE_FACTOR = 1.5


class SpanConsistency(NamedTuple):
    """Consistency and position RMSE of EKF2 between two parameter changes, if known."""

    consistency: Consistency | Unavailable
    rmse_m: float


def detect(analysis: Analysis) -> Findings:
    """Detect changes of EKF2 parameters in flight."""
    ekf2, segment = analysis.flight.ekf2, analysis.segment
    fusion_parameters = (find_aid(analysis).switch, AID_MASK_PARAMETER)
    changes = [
        change
        for change in (ekf2.parameter_changes if isinstance(ekf2, Ekf2) else ())
        if change.name in (*PARAMETERS, *fusion_parameters)
        and segment.start_s < change.time_s < segment.end_s
    ]
    edges_s = [segment.start_s, *(change.time_s for change in changes), segment.end_s]
    spans = [_assess_span(analysis, *span_s) for span_s in pairwise(edges_s)]
    for (time_s, name, value_before, value_after), (before, after) in zip(
        changes, pairwise(spans), strict=True
    ):
        unit = "" if name in fusion_parameters else f" {PARAMETERS[name].printed_unit}".rstrip()
        effect_sentences, has_effect = "", name in fusion_parameters
        nis_before, nis_after = before.consistency, after.consistency
        if not isinstance(nis_before, Unavailable) and not isinstance(nis_after, Unavailable):
            has_effect |= nis_before.verdict != nis_after.verdict
            has_effect |= _differ_by_min_factor(nis_before.sigma_ratio, nis_after.sigma_ratio)
            effect_sentences = (
                f" EKF2 is {_format_verdict(nis_before)} before the change and "
                f"{_format_verdict(nis_after)} after it (innovations along the main axis)."
            )
        if _differ_by_min_factor(before.rmse_m, after.rmse_m):
            has_effect = True
            effect_sentences += (
                " EKF2's position RMSE along the main axis is "
                f"{format_metres(before.rmse_m)} m before the change and "
                f"{format_metres(after.rmse_m)} m after it."
            )
        action = (
            f"Analyse the flight before (--end {time_s:.1f}) and after the change "
            f"(--start {time_s:.1f}) separately."
        )
        if name in fusion_parameters:
            action = f"Do not change {name} in flight. {action}"
        yield (make_warning if has_effect else make_note)(
            "parameter_changed",
            f"{name} changed from {value_before:g} to {value_after:g}{unit} at {time_s:.1f} "
            f"s.{effect_sentences}",
            action,
            {"parameter": name, "before": value_before, "after": value_after, "at_s": time_s},
            ((time_s, time_s),),
        )


def _differ_by_min_factor(before: float, after: float) -> bool:
    """Return True if both values are known and differ by more than the minimum factor."""
    low, high = sorted((before, after))
    return low > 0.0 and high > MIN_SIGMA_RATIO_OR_RMSE_CHANGE_FACTOR * low


def _format_verdict(consistency: Consistency) -> str:
    if consistency.verdict == "consistent":
        return "consistent"
    size_word = "small" if consistency.sigma_ratio > 1.0 else "large"
    factor = format_ratio(consistency.sigma_error_factor)
    return f"{consistency.verdict} (σ {factor} times too {size_word})"


def _assess_span(analysis: Analysis, start_s: float, end_s: float) -> SpanConsistency:
    rmse_m = math.nan
    errors = compute_position_errors(analysis.main, "ekf2")
    if not isinstance(errors, Unavailable):
        rmse_m = float((errors["error_m"].loc[start_s:end_s] ** 2).mean() ** 0.5)
    innovations = analysis.main.ekf2_innovations
    if isinstance(innovations, Unavailable):
        return SpanConsistency(innovations, rmse_m)
    samples = innovations[(innovations.index >= start_s) & (innovations.index < end_s)]
    consistency = assess_innovations(
        samples["innovation_m"].to_numpy(), samples["innovation_variance_m2"].to_numpy(), math.inf
    )
    return SpanConsistency(consistency, rmse_m)
