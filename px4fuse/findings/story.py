"""What happened on a flight, in up to three sentences made from its numbers and findings.

How well both filters did along the axis of the lab, then what weighs most: the worst findings, and
why EKF2 differs.
"""

from collections.abc import Iterator, Mapping

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.comparison import interventions
from px4fuse.comparison.interventions import Intervention, Of, cause_of, tried_on
from px4fuse.comparison.model import FILTERS, AgainstTruth, AxisComparison, Difference, FilterName
from px4fuse.ekf2.walk import Why
from px4fuse.ekf2_parameters import AIDS, EV_POS
from px4fuse.filter.kalman import state_at
from px4fuse.findings.causes import CLOCK, FRAME, PROCESS, SETTINGS, VARIANCES
from px4fuse.findings.model import Finding
from px4fuse.findings.since import TOLD_BY, effect_words, kind_of, since_words
from px4fuse.findings.source_positions import hardly_moved
from px4fuse.flight import Ekf2, Unavailable
from px4fuse.loop.model import Loop
from px4fuse.plain import capital, excess_words, length_words
from px4fuse.readers.px4_ekf2 import OTHER_AIDING

MOST_SENTENCES = 3
# What the first sentence tells already
TOLD_FIRST = VARIANCES | {"errors_larger_than_claimed", "ekf2_unavailable"}
# What a source can have that no setting and no outlier stands for
SHAPED = frozenset(
    (
        "source_axes_unequal",
        "source_clock_changes",
        "source_coloured",
        "source_jumps",
        "source_noise_changes",
        "source_repeats",
        "source_scale_wrong",
        "source_smoothed",
    )
)
# What looks like noise of the acceleration, which it turns
TURNED = frozenset(("ekf2_heading_wrong", "source_frame_turned"))
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
    axis = analysis.main.axis.name
    since = {
        owner: cause_of(analysis.causes, owner, axis, _wrong(analysis, owner)) for owner in FILTERS
    }
    shapes = {one.id for one in findings if one.id in SHAPED and one.severity != "info"}
    # what smooths makes positions late, which is no clock
    own = (FRAME,) if "source_smoothed" in shapes else (CLOCK, FRAME)
    turned = any(one.id in TURNED and one.severity != "info" for one in findings)
    for owner, cause in since.items():
        kind = kind_of(analysis, cause)
        if (shapes and kind not in own) or (turned and kind == PROCESS):
            since[owner] = None
    known = TOLD_FIRST
    for cause in filter(None, since.values()):
        known |= TOLD_BY.get(kind_of(analysis, cause), frozenset())
    if since["kf"] is not None and not interventions.OF_SETTINGS.isdisjoint(since["kf"].change):
        known |= SETTINGS
    causes = [
        one
        for one in findings
        if one.caused_by is None and one.severity != "info" and one.id not in known
    ]
    explained = bool(shapes) or any(
        one.id == "errors_larger_than_claimed" and one.caused_by for one in findings
    )
    sentences = [
        _verdict(
            analysis,
            _judged(analysis, "kf", since, explained),
            _judged(analysis, "ekf2", since, explained),
        ),
        *(closer := tuple(_closer(analysis, since))),
        *(_told(analysis, one) for one in causes if one.id not in EFFECTS),
        *_differences(analysis, told=bool(closer)),
        *(_told(analysis, one) for one in causes if one.id in EFFECTS),
    ]
    return tuple(sentences[:MOST_SENTENCES])


def _wrong(analysis: Analysis, owner: FilterName) -> Of:
    """What of a filter asks for a cause: an error larger than it claims, or its variance."""
    return "nees" if interventions.beyond_claim(analysis.main.filters[owner]) else "nis"


def _verdict(analysis: Analysis, ours: str, ekf2: str) -> str:
    """How far off both filters were, and whether they knew it."""
    result, source = analysis.main, analysis.source
    along = capital(f"{_flown(analysis)}along {result.axis.called}")
    ours_off, ekf2_off = (_error(result, owner) for owner in FILTERS)
    our_filter = f"our filter was {ours_off}{ours}"
    if isinstance(result.ekf2_state, Unavailable):
        return f"{along} {our_filter}; there is no EKF2 beside it: {result.ekf2_state.reason}."
    if ours_off and ekf2_off:
        return f"{along} EKF2 was {ekf2_off}{ekf2}; {our_filter}."
    apart = "both were flown"
    if isinstance(result.difference, Difference):
        apart = f"ours and EKF2 are {length_words(result.difference.position_rmse_m)} apart (RMS)"
    if source.origin.may_drift:
        said = f"both follow {source.name}, which may drift"
    elif ours == ekf2:
        said = f"by their own innovations both {_verb(result, 'kf', 'are ')}{ours}"
    else:
        said = (
            f"by its own innovations EKF2 {_verb(result, 'ekf2')}{ekf2}, our filter "
            f"{_verb(result, 'kf')}{ours}"
        )
    return f"{along} {apart}, and the log has no truth: {said}."


def _flown(analysis: Analysis) -> str:
    """What was not much of a flight, before a sentence about it."""
    if analysis.flight.airborne == ():
        return "the vehicle never took off: "
    return "the vehicle hovered: " if hardly_moved(analysis) else ""


def _verb(result: AxisComparison, owner: FilterName, verb: str = "is ") -> str:
    """What stands before words of :func:`_judged`; "cannot be judged" has a verb of its own."""
    return "" if isinstance(result.filters[owner], Unavailable) else verb


def _error(result: AxisComparison, owner: FilterName) -> str:
    """Error of one filter, with what joins it to the next phrase; empty without truth."""
    truth = result.filters[owner].truth
    if not isinstance(truth, AgainstTruth):
        return ""
    return f"{length_words(truth.position_rmse_m)} from the truth (RMS) and "


def _judged(
    analysis: Analysis,
    owner: FilterName,
    causes: Mapping[FilterName, Intervention | None],
    named: bool,
) -> str:
    """Whether a filter's variance is what its innovations, and the truth, show; and why not."""
    statement, cause = analysis.main.filters[owner], causes[owner]
    since = since_words(analysis, cause)
    if owner == "kf" and cause and causes["ekf2"] and cause.change == causes["ekf2"].change:
        since = f", for the same reason ({effect_words(cause)})"
    # a drift, and what no setting stands for, are told by themselves
    told = named or analysis.source.origin.may_drift
    axis = analysis.main.axis.name
    tried = tried_on(analysis.causes, owner, axis, _wrong(analysis, owner))
    unexplained = ", which nothing that was tried explains" if tried and not told else ""
    if any(each.denied_by_truth for each in tried):
        unexplained = ", as its errors against the truth ask for"
    if hidden := interventions.beyond_claim(statement):
        return f"claimed {length_words(hidden.claimed_m)}{since or unexplained}"
    if isinstance(statement, Unavailable):
        return "cannot be judged, since the log has no innovations or too few"
    if statement.verdict == "consistent":
        return "honest about it"
    how = "too modest" if statement.sigma_factor > 1.0 else "too sure of itself"
    return f"{excess_words(statement.times_off)} {how}{since or unexplained}"


def _told(analysis: Analysis, finding: Finding) -> str:
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
    who, off = "the filter coasted on the IMU", f"ours was {length_words(abs(ours - right))}"
    if isinstance(ekf2, pd.DataFrame) and len(before := ekf2["position_m"].loc[:end]):
        who = "both filters coasted on the IMU"
        if others := _fused(analysis.flight.ekf2, start, end):
            who = f"ours coasted on the IMU, EKF2 went on by {' and '.join(others)}"
        off += f" and EKF2 {length_words(abs(float(before.iloc[-1]) - right))}"
    count = len(finding.spans_s)
    more = f" (the longest of {count} times)" if count > 1 else ""
    return (
        f"From {start:.0f} s to {end:.0f} s the source was silent{more}: {who}; at the end {off} "
        f"{against}."
    )


def _fused(ekf2: Ekf2 | Unavailable, start_s: float, end_s: float) -> list[str]:
    """What EKF2 fused through a span, without a break of half of it, of what tells of motion."""
    found = []
    for name in (EV_POS.name, *OTHER_AIDING):
        log = None if isinstance(ekf2, Unavailable) else ekf2.aids.get(name)
        if log is not None and "fused" in log.samples:
            fused = log.samples["fused"].loc[start_s:end_s]
            ends = [start_s, *fused.index[fused > 0.0], end_s]
            if np.diff(ends).max() < 0.5 * (end_s - start_s):
                found.append(AIDS[name].label)
    return found


def _closer(analysis: Analysis, causes: Mapping[FilterName, Intervention | None]) -> Iterator[str]:
    """What putting the cause right does to how far both filters are apart."""
    told = [
        each
        for owner, cause in causes.items()
        for each in tried_on(analysis.causes, owner, analysis.main.axis.name, "apart")
        if cause is not None and each.explains >= interventions.EXPLAINS
    ]
    if told:
        most = max(told, key=lambda each: each.explains)
        owner = "our filter" if most.filter == "kf" else "EKF2"
        yield (
            f"Put right in {owner}, that brings both from {length_words(most.before)} to "
            f"{length_words(most.after)} apart (RMS, replayed)."
        )


def _differences(analysis: Analysis, *, told: bool) -> Iterator[str]:
    """Why EKF2 differs, and what a loop shows."""
    loop, why = analysis.loop, analysis.why.get(analysis.main.axis.name)
    if isinstance(loop, Loop) and (gap := loop.closure_error_m) is not None:
        length = loop.path_length_m
        yield (
            f"The odometry fails to close its loop by {length_words(gap)} after "
            f"{length_words(length)} ({gap / length:.1%})."
        )
    if isinstance(why, Why) and not told:
        yield why.cause  # wrong stamps are a finding of their own
