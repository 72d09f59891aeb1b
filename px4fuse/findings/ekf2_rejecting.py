"""Detect positions that EKF2's innovation gate rejects, and a gate that is too small."""

import math

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import AxisComparison
from px4fuse.comparison.remedy import find_aid
from px4fuse.comparison.trials import Trial, classify_improvement, compute_preference_key
from px4fuse.finding import Finding
from px4fuse.findings.cause_text import format_action
from px4fuse.findings.model import (
    Findings,
    find_source_texts,
    finding,
    format_percent,
    make_zero_length_spans,
)
from px4fuse.flight.model import Ekf2, Unavailable

# Minimum rejected fraction for a warning: with a gate of 5 √S, a consistent filter rejects 6e-7
REJECTED_FRACTION_FOR_WARNING = 0.01
REJECTED_FRACTION_FOR_ERROR = 0.20
# Maximum ratio of rejected fractions, after to before a change that prevents rejections
MAX_REJECTED_AFTER_TO_BEFORE_RATIO = 0.5


def detect(analysis: Analysis) -> Findings:
    rejection_findings = tuple(_detect_rejections(analysis))
    yield from _detect_small_gate(analysis, rejection_findings)
    yield from rejection_findings


def _detect_small_gate(analysis: Analysis, rejection_findings: tuple[Finding, ...]) -> Findings:
    """Detect a gate so small that a consistent filter would reject 1 % of the positions."""
    ekf2 = analysis.flight.ekf2
    if isinstance(ekf2, Ekf2) and rejection_findings:
        # Probability that both innovations, north and east, are inside the gate: erf(gate/√2)²
        expected_rejected_fraction = 1.0 - math.erf(ekf2.gate / math.sqrt(2.0)) ** 2
        if expected_rejected_fraction >= REJECTED_FRACTION_FOR_WARNING:
            aid = find_aid(analysis)
            rejected_fraction = float(rejection_findings[0].evidence["rejected_fraction"])
            yield finding(
                rejection_findings[0].severity,
                "ekf2_gate_too_small",
                f"{aid.gate} {ekf2.gate:g} is too small: EKF2 rejects "
                f"{format_percent(rejected_fraction)} of the positions. Without any fault, this "
                f"gate rejects {format_percent(expected_rejected_fraction)} of the positions.",
                f"Set {aid.gate} to {aid.default_gate:g} (PX4's default, in multiples of √S).",
                {"gate": ekf2.gate, "rejected_by_gate": expected_rejected_fraction},
            )


def _detect_rejections(analysis: Analysis) -> Findings:
    ekf2, down_comparison = analysis.flight.ekf2, analysis.axes.get("down")
    # EKF2 rejects north and east together, so one horizontal axis is sufficient
    results = [analysis.main]
    if down_comparison is not None and down_comparison is not analysis.main:
        results.append(down_comparison)
    for result in results:
        innovations = result.ekf2_innovations
        if isinstance(innovations, Unavailable) or isinstance(ekf2, Unavailable):
            continue
        rejected_flags = innovations["rejected"].dropna()
        rejected_fraction = float(rejected_flags.mean())  # NaN without logged flags
        if rejected_fraction >= REJECTED_FRACTION_FOR_WARNING:
            quantity = "heights" if result is down_comparison else "positions"
            yield finding(
                "error" if rejected_fraction >= REJECTED_FRACTION_FOR_ERROR else "warning",
                "ekf2_rejects_positions",
                f"EKF2 rejects {format_percent(rejected_fraction)} of the {quantity}. Their "
                f"innovations are outside its gate of {ekf2.gate:g} √S. Possible causes: outliers, "
                "measurement noise set too small, or late timestamps.",
                _find_rejection_remedy(analysis, result),
                {
                    "rejected_fraction": rejected_fraction,
                    "count": len(innovations),
                    "axis": result.axis.name,
                },
                make_zero_length_spans(rejected_flags.index[rejected_flags > 0.0]),
            )


def _find_rejection_remedy(analysis: Analysis, result: AxisComparison) -> str:
    aid = find_aid(analysis, result.axis.name)
    helpful_trials = [
        trial for trial in analysis.select_main_trials() if _prevents_rejections(trial)
    ]
    if helpful_trials and result is analysis.main:
        return format_action(analysis, min(helpful_trials, key=compute_preference_key).change)
    return (
        f"{find_source_texts(analysis.source).data_link_check}. Then check {aid.delay} and "
        f"{aid.noise}. Increase {aid.gate} only if no fault is found."
    )


def _prevents_rejections(trial: Trial) -> bool:
    before, after = trial.before.rejected_fraction, trial.after.rejected_fraction
    return (
        before is not None
        and after is not None
        and len(trial.kinds) == 1
        and classify_improvement(trial) != "nothing"
        and after < MAX_REJECTED_AFTER_TO_BEFORE_RATIO * before
    )
