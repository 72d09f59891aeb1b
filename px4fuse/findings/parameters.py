"""EKF2 parameters that change in flight, with the consistency of EKF2 before and after."""

import math
from typing import NamedTuple

import numpy as np

from px4fuse.analysis import Analysis
from px4fuse.comparison.comparison import position_errors
from px4fuse.comparison.remedy import aid_of
from px4fuse.core.text import format_metres, format_ratio
from px4fuse.filter.consistency import assess
from px4fuse.findings.model import Findings, note, warning
from px4fuse.flight.ekf2_parameters import AID_MASK, PARAMETERS
from px4fuse.flight.model import Ekf2, Unavailable

# Minimum ratio of two values (σ ratio, position RMSE) before and after a change, for a warning
MIN_EFFECT = 1.5


class Part(NamedTuple):
    """EKF2 in one part of the flight; values are NaN and texts empty if unknown."""

    verdict: str
    sigma_ratio: float
    rmse_m: float


def detect(analysis: Analysis) -> Findings:
    """Detect changes of the EKF2 parameters that px4fuse uses."""
    ekf2, segment = analysis.flight.ekf2, analysis.segment
    switches = (aid_of(analysis).switch, AID_MASK)
    changes = [
        change
        for change in (ekf2.parameter_changes if isinstance(ekf2, Ekf2) else ())
        if change.name in (*PARAMETERS, *switches)
        and segment.start_s < change.time_s < segment.end_s
    ]
    edges_s = [segment.start_s, *(change.time_s for change in changes), segment.end_s]
    for number, (time_s, name, before, after) in enumerate(changes):
        old, new = (_part(analysis, *edges_s[i : i + 2]) for i in (number, number + 1))
        unit = "" if name in switches else f" {PARAMETERS[name].printed_unit}".rstrip()
        effect, has_effect = "", name in switches
        if old.verdict and new.verdict:
            has_effect |= _differ(old.sigma_ratio, new.sigma_ratio)
            effect = (
                f" EKF2 is {old.verdict} before the change and {new.verdict} after it "
                "(innovations along the main axis)."
            )
        if _differ(old.rmse_m, new.rmse_m):
            has_effect = True
            effect += (
                f" EKF2's position RMSE along the main axis is {format_metres(old.rmse_m)} m "
                f"before the change and {format_metres(new.rmse_m)} m after it."
            )
        action = (
            "Analyse the flight before and after the change separately "
            f"(--end {time_s:.1f}, --start {time_s:.1f})."
        )
        if name in switches:
            action = f"Do not change {name} in flight. {action}"
        yield (warning if has_effect else note)(
            "parameter_changed",
            f"{name} changed from {before:g} to {after:g}{unit} at {time_s:.1f} s.{effect}",
            action,
            {"parameter": name, "before": before, "after": after, "at_s": time_s},
            ((time_s, time_s),),
        )


def _differ(before: float, after: float) -> bool:
    """Return True if both values are known and differ by more than the factor MIN_EFFECT."""
    return before > 0.0 and after > 0.0 and abs(math.log(after / before)) > math.log(MIN_EFFECT)


def _part(analysis: Analysis, start_s: float, end_s: float) -> Part:
    """Describe EKF2 in a time span."""
    unknown, rmse_m = float("nan"), float("nan")
    errors = position_errors(analysis.main, "ekf2")
    if not isinstance(errors, Unavailable):
        rmse_m = float(np.sqrt((errors["error_m"].loc[start_s:end_s] ** 2).mean()))
    innovations = analysis.main.ekf2_innovations
    if isinstance(innovations, Unavailable):
        return Part("", unknown, rmse_m)
    samples = innovations[(innovations.index >= start_s) & (innovations.index < end_s)]
    result = assess(
        samples["innovation_m"].to_numpy(), samples["innovation_variance_m2"].to_numpy(), math.inf
    )
    if isinstance(result, Unavailable):
        return Part("", unknown, rmse_m)
    direction = "small" if result.sigma_ratio > 1.0 else "large"
    factor = format_ratio(result.sigma_error_factor)
    verdict = f"{result.verdict} (σ {factor} times too {direction})"
    if result.verdict == "consistent":
        verdict = result.verdict
    return Part(verdict, result.sigma_ratio, rmse_m)
