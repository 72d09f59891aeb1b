"""What happened on a flight, in up to three sentences made from its numbers and findings.

How well both filters did along the axis of the lab, then what weighs most: the worst findings, and
why EKF2 differs.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import (
    AgainstTruth,
    AxisComparison,
    Comparison,
    Difference,
    FilterName,
)
from px4fuse.comparison.why import the
from px4fuse.ekf2.walk import Why
from px4fuse.filter.kalman import state_at
from px4fuse.filter.settings import Settings
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning, Noise
from px4fuse.findings.errors_larger_than_claimed import hidden_errors
from px4fuse.findings.model import Finding
from px4fuse.flight import Unavailable
from px4fuse.loop.loop import Loop
from px4fuse.plain import excess_words, length_words

MOST_SENTENCES = 3
# What the first sentence tells already
TOLD_FIRST = frozenset(
    {
        "kf_variance_overstated", "kf_variance_understated", "ekf2_variance_overstated",
        "ekf2_variance_understated", "errors_larger_than_claimed", "ekf2_unavailable",
    }
)  # fmt: skip
SETTINGS = frozenset({"sigma_a_large", "sigma_a_small", "sigma_z_large", "sigma_z_small"})
# What weighs less than why EKF2 differs
EFFECTS = frozenset({"ekf2_resets", "ekf2_rejecting", "ekf2_fusion_interrupted"})


def story(analysis: Analysis, findings: tuple[Finding, ...]) -> tuple[str, ...]:
    """What happened, the most important first.

    Parameters
    ----------
    analysis : Analysis
    findings : tuple of Finding
        Most severe first.

    Returns
    -------
    tuple of str
        One to three sentences.
    """
    told = [
        _verdict(analysis),
        *_causes(analysis, [f for f in findings if f.id not in EFFECTS]),
        *_differences(analysis),
        *_causes(analysis, [f for f in findings if f.id in EFFECTS]),
    ]
    return tuple(told[:MOST_SENTENCES])


def _verdict(analysis: Analysis) -> str:
    """How far off both filters were, and whether they knew it."""
    comparison = analysis
    result = comparison.main
    along, since = f"Along {the(result.axis.name)}", _since(analysis, result)
    ours, ours_truth = _knows(comparison, "kf", result), result.filters["kf"].truth
    if isinstance(result.ekf2_state, Unavailable):
        return (
            f"{along} our filter was {_error(ours_truth)}{ours}{since}; there is no EKF2 "
            f"beside it: {result.ekf2_state.reason}."
        )
    ekf2 = _knows(comparison, "ekf2", result)
    ekf2_truth = result.filters["ekf2"].truth
    if isinstance(ekf2_truth, AgainstTruth) and isinstance(ours_truth, AgainstTruth):
        return (
            f"{along} EKF2 was {_error(ekf2_truth)}{ekf2}; our filter was "
            f"{_error(ours_truth)}{ours}{since}."
        )
    apart = "both were flown"
    if isinstance(result.difference, Difference):
        apart = f"ours and EKF2 are {length_words(result.difference.position_rmse_m)} apart (RMS)"
    if comparison.source.origin.may_drift:
        judged = f"both follow {comparison.source.name}, which may drift"
    elif ekf2 == ours and not since:
        judged = f"by their own innovations both are {ours}"
    else:
        judged = f"by its own innovations EKF2 is {ekf2}, our filter {ours}{since}"
    return f"{along} {apart}, and the log has no truth: {judged}."


def _error(truth: AgainstTruth | Unavailable) -> str:
    """Error of one filter, with what joins it to the next phrase; empty without truth."""
    if isinstance(truth, Unavailable):
        return ""
    return f"{length_words(truth.position_rmse_m)} from the truth (RMS) and "


def _knows(comparison: Comparison, owner: FilterName, result: AxisComparison) -> str:
    """Whether a filter's variance is what its innovations, and the truth, show."""
    name = result.axis.name
    for hidden in hidden_errors(comparison):
        if hidden.owner == owner and hidden.result.axis.name == name:
            claimed = hidden.truth.position_rmse_m / np.sqrt(hidden.nees)
            return f"claimed {length_words(float(claimed))}"
    statement = result.filters[owner]
    if isinstance(statement, Unavailable):
        return "cannot be judged by innovations, since the log has none or too few"
    factor = statement.variance_factor
    if statement.verdict == "consistent":
        return "honest about it"
    if factor > 1.0:
        return f"{excess_words(factor)} too modest"
    return f"{excess_words(1.0 / factor)} too sure of itself"


def _since(analysis: Analysis, result: AxisComparison) -> str:
    """The setting that makes our variance too large or too small, where the data say so."""
    comparison, statement = analysis, result.filters["kf"]
    if isinstance(statement, Unavailable) or statement.verdict == "consistent":
        return ""
    if comparison.source.origin.may_drift:
        return ""
    name = "down" if result.axis.name == "down" else HORIZONTAL
    tuned = analysis.tuning.get(name, analysis.tuning.get(result.axis.name))
    if not isinstance(tuned, AxisTuning):
        return ""
    settings, over = comparison.settings, statement.variance_factor > 1.0
    off = [
        (abs(np.log(chosen / best)), f"{label} {chosen:g}", f"{best:.2g} {unit}")
        for label, unit, chosen, noise in _noises(settings, tuned)
        if (best := _beyond(noise, chosen, over=over)) is not None
    ]
    if not off:
        return ""
    _, setting, asked = max(off)
    size = "larger" if over else "smaller"
    return f", since {setting} is {size} than the {asked} that this flight asks for"


def _noises(settings: Settings, tuned: AxisTuning) -> Iterator[tuple[str, str, float, Noise]]:
    yield "SIGMA_A", "m/s²", settings.sigma_a_m_s2, tuned.filter_sigma_a
    yield "SIGMA_Z", "m", settings.sigma_z_m, tuned.sigma_z


def _beyond(noise: Noise, chosen: float, *, over: bool) -> float | None:
    """The value that the data ask for, where the chosen one is beyond its interval on that side."""
    if over:
        beyond = noise.high is not None and chosen > noise.high
        return (noise.value or noise.high) if beyond else None
    beyond = noise.value is not None and noise.low is not None and chosen < noise.low
    return noise.value if beyond else None


def _causes(analysis: Analysis, findings: list[Finding]) -> Iterator[str]:
    """The findings that weigh most, a sentence each."""
    told = TOLD_FIRST | (SETTINGS if _since(analysis, analysis.main) else frozenset())
    for finding in findings:
        if finding.severity == "info" or finding.id in told:
            continue
        if finding.id == "source_gap":
            yield _gap(analysis, finding)
            continue
        headline = finding.headline
        dated = any(f"{time:.1f} s" in headline for span in finding.spans_s for time in span)
        yield f"{headline}{f' ({finding.when})' if finding.when and not dated else ''}."


def _gap(comparison: Comparison, finding: Finding) -> str:
    """The longest silence of the source, and where it left both filters."""
    start, end = max(finding.spans_s, key=lambda span: span[1] - span[0])
    result = comparison.main
    ours = state_at(result.replay, np.array([start, end - 1e-6]))[0][1]
    apart = []
    after = result.axis.measurement_m[np.searchsorted(result.axis.measurement_time_s, end - 1e-6)]
    reference, against = float(after), "from the next position"
    if isinstance(result.truth, pd.DataFrame):
        true = result.truth["position_m"]
        reference, against = float(np.interp(end, true.index, true)), "from the truth"
    apart.append(f"ours was {length_words(abs(float(ours) - reference))}")
    if isinstance(result.ekf2_state, pd.DataFrame):
        before = result.ekf2_state["position_m"].loc[:end]
        if len(before):
            apart.append(f"EKF2 {length_words(abs(float(before.iloc[-1]) - reference))}")
    who = "both filters" if len(apart) > 1 else "the filter"
    others = len(finding.spans_s) - 1
    more = f" (the longest of {others + 1} times)" if others else ""
    return (
        f"From {start:.0f} s to {end:.0f} s the source was silent{more}: {who} coasted on the IMU; "
        f"at the end {' and '.join(apart)} {against}."
    )


def _differences(analysis: Analysis) -> Iterator[str]:
    """Why EKF2 differs, and what a loop shows."""
    loop = analysis.loop
    if isinstance(loop, Loop) and (gap := loop.closure_error_m) is not None:
        length = loop.path_length_m
        yield (
            f"The odometry fails to close its loop by {length_words(gap)} after "
            f"{length_words(length)} ({gap / length:.1%})."
        )
    why = analysis.why.get(analysis.main.axis.name)
    if isinstance(why, Why):
        yield why.cause  # wrong stamps are a finding of their own
