"""What happened on a flight, in up to three sentences made from its numbers and findings.

How well both filters did along the axis of the lab, then what weighs most: the worst findings, and
why EKF2 differs.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import AgainstTruth, AxisComparison, Difference, FilterName
from px4fuse.ekf2.walk import Why
from px4fuse.filter.kalman import replay, state_at
from px4fuse.filter.settings import Settings
from px4fuse.findings.causes import SETTINGS, VARIANCES
from px4fuse.findings.hidden_errors import hidden_error
from px4fuse.findings.model import Finding
from px4fuse.findings.sigma import tuned_for
from px4fuse.findings.source_positions import MOTION_RANGE_M, motion_range_m
from px4fuse.flight import Unavailable
from px4fuse.loop.loop import Loop
from px4fuse.plain import capital, excess_words, length_words, number_words

MOST_SENTENCES = 3
# What the first sentence tells already
TOLD_FIRST = VARIANCES | {"errors_larger_than_claimed", "ekf2_unavailable"}
# Share of the logarithm of the mean NIS that a cause explains
EXPLAINS = 0.5
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
    since = _since(analysis)
    known = TOLD_FIRST | (SETTINGS if since else frozenset())
    causes = [
        one for one in findings
        if one.caused_by is None and one.severity != "info" and one.id not in known
    ]  # fmt: skip
    sentences = [
        _verdict(analysis, since),
        *(_cause(analysis, one) for one in causes if one.id not in EFFECTS),
        *_differences(analysis),
        *(_cause(analysis, one) for one in causes if one.id in EFFECTS),
    ]
    return tuple(sentences[:MOST_SENTENCES])


def _verdict(analysis: Analysis, since: str) -> str:
    """How far off both filters were, and whether they knew it."""
    result, source = analysis.main, analysis.source
    along = capital(f"{_flown(analysis)}along {result.axis.called}")
    (ours_off, ours), (ekf2_off, ekf2) = (
        (_error(result, owner), _knows(analysis, result, owner)) for owner in ("kf", "ekf2")
    )
    our_filter = f"our filter was {ours_off}{ours}{since}"
    if isinstance(result.ekf2_state, Unavailable):
        return f"{along} {our_filter}; there is no EKF2 beside it: {result.ekf2_state.reason}."
    if ours_off and ekf2_off:
        return f"{along} EKF2 was {ekf2_off}{ekf2}; {our_filter}."
    apart = "both were flown"
    if isinstance(result.difference, Difference):
        apart = f"ours and EKF2 are {length_words(result.difference.position_rmse_m)} apart (RMS)"
    if source.origin.may_drift:
        judged = f"both follow {source.name}, which may drift"
    elif ekf2 == ours and not since:
        judged = f"by their own innovations both {_verb(result, 'kf', 'are ')}{ours}"
    else:
        judged = (
            f"by its own innovations EKF2 {_verb(result, 'ekf2')}{ekf2}, our filter "
            f"{_verb(result, 'kf')}{ours}{since}"
        )
    return f"{along} {apart}, and the log has no truth: {judged}."


def _flown(analysis: Analysis) -> str:
    """What was not much of a flight, before a sentence about it."""
    if analysis.flight.airborne == ():
        return "the vehicle never took off: "
    return "the vehicle hovered: " if motion_range_m(analysis) < MOTION_RANGE_M else ""


def _verb(result: AxisComparison, owner: FilterName, verb: str = "is ") -> str:
    """What stands before words of :func:`_knows`; "cannot be judged" has a verb of its own."""
    return "" if isinstance(result.filters[owner], Unavailable) else verb


def _error(result: AxisComparison, owner: FilterName) -> str:
    """Error of one filter, with what joins it to the next phrase; empty without truth."""
    truth = result.filters[owner].truth
    if not isinstance(truth, AgainstTruth):
        return ""
    return f"{length_words(truth.position_rmse_m)} from the truth (RMS) and "


def _knows(analysis: Analysis, result: AxisComparison, owner: FilterName) -> str:
    """Whether a filter's variance is what its innovations, and the truth, show."""
    if hidden := hidden_error(analysis, result, owner):
        return f"claimed {length_words(hidden.claimed_m)}"
    statement = result.filters[owner]
    if isinstance(statement, Unavailable):
        return "cannot be judged, since the log has no innovations or too few"
    factor = statement.variance_factor
    if statement.verdict == "consistent":
        return "honest about it"
    if factor > 1.0:
        return f"{excess_words(factor)} too modest"
    return f"{excess_words(1.0 / factor)} too sure of itself"


def _since(analysis: Analysis) -> str:
    """The setting that makes our variance too large or too small.

    Where the data ask for another value, and a replay with it explains at least half of how far the
    mean NIS is from 1 (by its logarithm), without going as far to the other side. An error beyond
    what the filter claims has other causes than the size of S.
    """
    settings, statement = analysis.settings, analysis.main.filters["kf"]
    if isinstance(statement, Unavailable) or statement.verdict == "consistent":
        return ""
    if hidden_error(analysis, analysis.main, "kf"):
        return ""
    tuned, over = tuned_for(analysis, analysis.main.axis.name), statement.variance_factor > 1.0
    origin = analysis.source.origin
    if origin.may_drift or tuned is None or (over and origin.is_gnss):
        return ""
    causes, before = [], statement.nis_mean
    for field, unit, noise in (
        ("sigma_a_m_s2", "m/s²", tuned.filter_sigma_a), ("sigma_z_m", "m", tuned.sigma_z)
    ):  # fmt: skip
        chosen = getattr(settings, field)
        end, asked = (noise.high, noise.value or noise.high) if over else (noise.low, noise.value)
        if end is not None and asked and (chosen > end if over else chosen < end):
            changed: dict[str, Any] = {field: asked}
            after = nis_with(analysis, replace(settings, **changed))
            explained = 1.0 - float(np.log(after) / np.log(before))
            if EXPLAINS <= explained <= 2.0 - EXPLAINS:
                label, side = field[:7].upper(), "larger" if over else "smaller"
                causes.append((
                    explained, f", since {label} {chosen:g} is {side} than the {asked:.2g} {unit} "
                    f"that this flight asks for (replayed: mean NIS {number_words(before, 2)} → "
                    f"{number_words(after, 2)})",
                ))  # fmt: skip
    return min(causes, key=lambda cause: abs(cause[0] - 1.0))[1] if causes else ""


def nis_with(analysis: Analysis, settings: Settings) -> float:
    """Mean NIS of our filter along the axis of the lab with other settings, by a replay."""
    updates = replay(analysis.main.axis, settings).updates
    return float(np.mean(updates["innovation_m"] ** 2 / updates["innovation_variance_m2"]))


def _cause(analysis: Analysis, finding: Finding) -> str:
    """What a finding says is wrong, with when."""
    if finding.id == "source_gap":
        return _gap(analysis, finding)
    when = f" ({finding.when})" if finding.when and not finding.says_when else ""
    return f"{finding.headline}{when}."


def _gap(analysis: Analysis, finding: Finding) -> str:
    """The longest silence of the source, and where it left both filters."""
    start, end = max(finding.spans_s, key=lambda span: span[1] - span[0])
    just_before, result = end - 1e-6, analysis.main
    axis, ekf2 = result.axis, result.ekf2_state
    ours = float(state_at(result.replay, np.array([start, just_before]))[0][1])
    after = float(axis.measurement_m[np.searchsorted(axis.measurement_time_s, just_before)])
    right, against = after, "from the next position"
    if isinstance(result.truth, pd.DataFrame):
        true = result.truth["position_m"]
        right, against = float(np.interp(end, true.index, true)), "from the truth"
    who, off = "the filter", f"ours was {length_words(abs(ours - right))}"
    if isinstance(ekf2, pd.DataFrame) and len(before := ekf2["position_m"].loc[:end]):
        who = "both filters"
        off += f" and EKF2 {length_words(abs(float(before.iloc[-1]) - right))}"
    count = len(finding.spans_s)
    more = f" (the longest of {count} times)" if count > 1 else ""
    return (
        f"From {start:.0f} s to {end:.0f} s the source was silent{more}: {who} coasted on the IMU; "
        f"at the end {off} {against}."
    )


def _differences(analysis: Analysis) -> Iterator[str]:
    """Why EKF2 differs, and what a loop shows."""
    loop, why = analysis.loop, analysis.why.get(analysis.main.axis.name)
    if isinstance(loop, Loop) and (gap := loop.closure_error_m) is not None:
        length = loop.path_length_m
        yield (
            f"The odometry fails to close its loop by {length_words(gap)} after "
            f"{length_words(length)} ({gap / length:.1%})."
        )
    if isinstance(why, Why):
        yield why.cause  # wrong stamps are a finding of their own
