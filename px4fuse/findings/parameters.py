"""EKF2 parameters that are changed in flight, and EKF2's consistency before and after."""

import math
from typing import NamedTuple

import numpy as np

from px4fuse.analysis import Analysis
from px4fuse.comparison.comparison import position_errors
from px4fuse.comparison.remedy import aid_of
from px4fuse.core.text import format_metres, format_ratio
from px4fuse.filter.consistency import assess
from px4fuse.findings.model import Findings, note, warning
from px4fuse.flight.ekf2_parameters import AID_MASK_PARAMETER, PARAMETERS
from px4fuse.flight.model import Ekf2, Unavailable

# A parameter change has an effect if σ ratio or position RMSE change by at least this factor
MIN_CHANGE_RATIO = 1.5


class PartConsistency(NamedTuple):
    """Consistency and position RMSE of EKF2 in one part of the flight.

    Unknown values are NaN or "".
    """

    verdict: str
    sigma_ratio: float
    rmse_m: float


def detect(analysis: Analysis) -> Findings:
    """Detect EKF2 parameters that are changed in flight and that px4fuse uses."""
    ekf2, segment = analysis.flight.ekf2, analysis.segment
    fusion_parameters = (aid_of(analysis).switch, AID_MASK_PARAMETER)
    changes = [
        change
        for change in (ekf2.parameter_changes if isinstance(ekf2, Ekf2) else ())
        if change.name in (*PARAMETERS, *fusion_parameters)
        and segment.start_s < change.time_s < segment.end_s
    ]
    part_edges_s = [segment.start_s, *(change.time_s for change in changes), segment.end_s]
    for change_index, (time_s, name, before, after) in enumerate(changes):
        part_before, part_after = (
            _assess_part(analysis, *part_edges_s[part_index : part_index + 2])
            for part_index in (change_index, change_index + 1)
        )
        unit = "" if name in fusion_parameters else f" {PARAMETERS[name].printed_unit}".rstrip()
        effect_sentences, has_effect = "", name in fusion_parameters
        if part_before.verdict and part_after.verdict:
            verdicts = {part.verdict.partition(" ")[0] for part in (part_before, part_after)}
            has_effect |= len(verdicts) > 1
            has_effect |= _differ_significantly(part_before.sigma_ratio, part_after.sigma_ratio)
            effect_sentences = (
                f" EKF2 is {part_before.verdict} before the change and {part_after.verdict} after "
                "it (innovations along the main axis)."
            )
        if _differ_significantly(part_before.rmse_m, part_after.rmse_m):
            has_effect = True
            effect_sentences += (
                f" EKF2's position RMSE along the main axis is {format_metres(part_before.rmse_m)} "
                f"m before the change and {format_metres(part_after.rmse_m)} m after it."
            )
        action = (
            "Analyse the flight before and after the change separately "
            f"(--end {time_s:.1f}, --start {time_s:.1f})."
        )
        if name in fusion_parameters:
            action = f"Do not change {name} in flight. {action}"
        yield (warning if has_effect else note)(
            "parameter_changed",
            f"{name} changed from {before:g} to {after:g}{unit} at {time_s:.1f} "
            f"s.{effect_sentences}",
            action,
            {"parameter": name, "before": before, "after": after, "at_s": time_s},
            ((time_s, time_s),),
        )


def _differ_significantly(before: float, after: float) -> bool:
    """Return True if both values are known and differ by more than the factor MIN_CHANGE_RATIO."""
    return (
        before > 0.0 and after > 0.0 and abs(math.log(after / before)) > math.log(MIN_CHANGE_RATIO)
    )


def _assess_part(analysis: Analysis, start_s: float, end_s: float) -> PartConsistency:
    unknown, rmse_m = float("nan"), float("nan")
    errors = position_errors(analysis.main, "ekf2")
    if not isinstance(errors, Unavailable):
        rmse_m = float(np.sqrt((errors["error_m"].loc[start_s:end_s] ** 2).mean()))
    innovations = analysis.main.ekf2_innovations
    if isinstance(innovations, Unavailable):
        return PartConsistency("", unknown, rmse_m)
    samples = innovations[(innovations.index >= start_s) & (innovations.index < end_s)]
    consistency = assess(
        samples["innovation_m"].to_numpy(), samples["innovation_variance_m2"].to_numpy(), math.inf
    )
    if isinstance(consistency, Unavailable):
        return PartConsistency("", unknown, rmse_m)
    direction = "small" if consistency.sigma_ratio > 1.0 else "large"
    factor = format_ratio(consistency.sigma_error_factor)
    verdict = f"{consistency.verdict} (σ {factor} times too {direction})"
    if consistency.verdict == "consistent":
        verdict = consistency.verdict
    return PartConsistency(verdict, consistency.sigma_ratio, rmse_m)
