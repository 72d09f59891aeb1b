"""EKF2 parameters that change in flight, with the consistency of EKF2 before and after."""

import math

from px4fuse.analysis import Analysis
from px4fuse.core.text import format_ratio
from px4fuse.filter.consistency import assess
from px4fuse.findings.model import Findings, note, warning
from px4fuse.flight.ekf2_parameters import PARAMETERS
from px4fuse.flight.model import Ekf2, Unavailable


def detect(analysis: Analysis) -> Findings:
    """Detect changes of the EKF2 parameters that px4fuse uses."""
    ekf2, segment = analysis.flight.ekf2, analysis.segment
    changes = [
        change
        for change in (ekf2.parameter_changes if isinstance(ekf2, Ekf2) else ())
        if change.name in PARAMETERS and segment.start_s < change.time_s < segment.end_s
    ]
    edges_s = [segment.start_s, *(change.time_s for change in changes), segment.end_s]
    for number, (time_s, name, before, after) in enumerate(changes):
        verdict_before, verdict_after = (
            _verdict(analysis, *edges_s[index : index + 2]) for index in (number, number + 1)
        )
        unit, effect = f" {PARAMETERS[name].printed_unit}".rstrip(), ""
        if verdict_before and verdict_after:
            effect = (
                f" EKF2 is {verdict_before} before the change and {verdict_after} after it "
                "(innovations along the main axis)."
            )
        has_effect = verdict_before.partition(" ")[0] != verdict_after.partition(" ")[0]
        yield (warning if has_effect else note)(
            "parameter_changed",
            f"{name} changed from {before:g} to {after:g}{unit} at {time_s:.1f} s.{effect}",
            "Analyse the flight before and after the change separately "
            f"(--end {time_s:.1f}, --start {time_s:.1f}).",
            {"parameter": name, "before": before, "after": after, "at_s": time_s},
            ((time_s, time_s),),
        )


def _verdict(analysis: Analysis, start_s: float, end_s: float) -> str:
    """Describe the consistency of EKF2 in a time span; "" if it cannot be tested."""
    innovations = analysis.main.ekf2_innovations
    if isinstance(innovations, Unavailable):
        return ""
    samples = innovations[(innovations.index >= start_s) & (innovations.index < end_s)]
    result = assess(
        samples["innovation_m"].to_numpy(), samples["innovation_variance_m2"].to_numpy(), math.inf
    )
    if isinstance(result, Unavailable):
        return ""
    if result.verdict == "consistent":
        return result.verdict
    direction = "small" if result.sigma_ratio > 1.0 else "large"
    factor = format_ratio(result.sigma_error_factor)
    return f"{result.verdict} (σ {factor} times too {direction})"
