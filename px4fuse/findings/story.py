"""What happened on a flight, in up to three sentences made from its numbers and findings.

How well both filters did along the axis of the lab, then what weighs most: the worst findings, and
why EKF2 differs.
"""

from collections.abc import Iterator, Mapping

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.comparison import interventions
from px4fuse.comparison.interventions import Intervention, Of, cause_of, interventions_on
from px4fuse.comparison.model import FILTERS, AgainstTruth, AxisComparison, Difference, FilterName
from px4fuse.ekf2.walk import Why
from px4fuse.ekf2_parameters import AIDS, EV_POS
from px4fuse.filter.kalman import state_at
from px4fuse.findings.causes import CLOCK, FRAME, PROCESS, SETTINGS, VARIANCES
from px4fuse.findings.model import Finding
from px4fuse.findings.since import FINDINGS_OF_CAUSE, format_cause, format_effect, kind_of
from px4fuse.findings.source_positions import hardly_moved
from px4fuse.flight import Ekf2, Unavailable
from px4fuse.loop.model import Loop
from px4fuse.plain import capitalise_first, format_excess, format_length
from px4fuse.readers.px4_ekf2 import OTHER_AIDING

MAX_SENTENCES = 3
# What the first sentence tells already
IN_FIRST_SENTENCE = VARIANCES | {"errors_larger_than_claimed", "ekf2_unavailable"}
# What a source can have that no setting and no outlier stands for
NOISE_SHAPE_FINDINGS = frozenset(
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
MISALIGNMENT_FINDINGS = frozenset(("ekf2_heading_wrong", "source_frame_turned"))
# What weighs less than why EKF2 differs
EFFECT_FINDINGS = frozenset({"ekf2_resets", "ekf2_rejecting", "ekf2_fusion_interrupted"})


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
    cause_by_filter = {
        owner: cause_of(analysis.causes, owner, axis, _failed_statistic(analysis, owner))
        for owner in FILTERS
    }
    shapes = {
        one.id for one in findings if one.id in NOISE_SHAPE_FINDINGS and one.severity != "info"
    }
    # what smooths makes positions late, which is no clock
    own = (FRAME,) if "source_smoothed" in shapes else (CLOCK, FRAME)
    turned = any(one.id in MISALIGNMENT_FINDINGS and one.severity != "info" for one in findings)
    for owner, cause in cause_by_filter.items():
        kind = kind_of(analysis, cause)
        if (shapes and kind not in own) or (turned and kind == PROCESS):
            cause_by_filter[owner] = None
    known = IN_FIRST_SENTENCE
    for cause in filter(None, cause_by_filter.values()):
        known |= FINDINGS_OF_CAUSE.get(kind_of(analysis, cause), frozenset())
    if cause_by_filter["kf"] is not None and not interventions.SETTING_CHANGES.isdisjoint(
        cause_by_filter["kf"].change
    ):
        known |= SETTINGS
    causes = [
        one
        for one in findings
        if one.caused_by is None and one.severity != "info" and one.id not in known
    ]
    has_explanation = bool(shapes) or any(
        one.id == "errors_larger_than_claimed" and one.caused_by for one in findings
    )
    sentences = [
        _verdict_sentence(
            analysis,
            _filter_verdict(analysis, "kf", cause_by_filter, has_explanation),
            _filter_verdict(analysis, "ekf2", cause_by_filter, has_explanation),
        ),
        *(reduction_sentences := tuple(_difference_after_change(analysis, cause_by_filter))),
        *(_finding_sentence(analysis, one) for one in causes if one.id not in EFFECT_FINDINGS),
        *_differences(analysis, has_difference_sentence=bool(reduction_sentences)),
        *(_finding_sentence(analysis, one) for one in causes if one.id in EFFECT_FINDINGS),
    ]
    return tuple(sentences[:MAX_SENTENCES])


def _failed_statistic(analysis: Analysis, owner: FilterName) -> Of:
    """What of a filter asks for a cause: an error larger than it claims, or its variance."""
    return (
        "nees" if interventions.error_beyond_reported_sigma(analysis.main.filters[owner]) else "nis"
    )


def _verdict_sentence(analysis: Analysis, kf_verdict: str, ekf2_verdict: str) -> str:
    """How far off both filters were, and whether they knew it."""
    result, source = analysis.main, analysis.source
    along = capitalise_first(f"{_flown(analysis)}along {result.axis.called}")
    ours_off, ekf2_off = (_error(result, owner) for owner in FILTERS)
    our_filter = f"our filter was {ours_off}{kf_verdict}"
    if isinstance(result.ekf2_state, Unavailable):
        return f"{along} {our_filter}; there is no EKF2 beside it: {result.ekf2_state.reason}."
    if ours_off and ekf2_off:
        return f"{along} EKF2 was {ekf2_off}{ekf2_verdict}; {our_filter}."
    difference_text = "both were flown"
    if isinstance(result.difference, Difference):
        difference_text = (
            f"ours and EKF2 are {format_length(result.difference.position_rmse_m)} apart (RMS)"
        )
    if source.origin.may_drift:
        verdict_text = f"both follow {source.name}, which may drift"
    elif kf_verdict == ekf2_verdict:
        verdict_text = f"by their own innovations both {_verb(result, 'kf', 'are ')}{kf_verdict}"
    else:
        verdict_text = (
            f"by its own innovations EKF2 {_verb(result, 'ekf2')}{ekf2_verdict}, our filter "
            f"{_verb(result, 'kf')}{kf_verdict}"
        )
    return f"{along} {difference_text}, and the log has no truth: {verdict_text}."


def _flown(analysis: Analysis) -> str:
    """What was not much of a flight, before a sentence about it."""
    if analysis.flight.airborne == ():
        return "the vehicle never took off: "
    return "the vehicle hovered: " if hardly_moved(analysis) else ""


def _verb(result: AxisComparison, owner: FilterName, verb: str = "is ") -> str:
    """What stands before words of :func:`_filter_verdict`; "cannot be judged" has a verb of its own."""
    return "" if isinstance(result.filters[owner], Unavailable) else verb


def _error(result: AxisComparison, owner: FilterName) -> str:
    """Error of one filter, with what joins it to the next phrase; empty without truth."""
    truth = result.filters[owner].truth
    if not isinstance(truth, AgainstTruth):
        return ""
    return f"{format_length(truth.position_rmse_m)} from the truth (RMS) and "


def _filter_verdict(
    analysis: Analysis,
    owner: FilterName,
    causes: Mapping[FilterName, Intervention | None],
    has_explanation: bool,
) -> str:
    """Whether a filter's variance is what its innovations, and the truth, show; and why not."""
    statement, cause = analysis.main.filters[owner], causes[owner]
    since = format_cause(analysis, cause)
    if owner == "kf" and cause and causes["ekf2"] and cause.change == causes["ekf2"].change:
        since = f", for the same reason ({format_effect(cause)})"
    # a drift, and what no setting stands for, are told by themselves
    is_explained_elsewhere = has_explanation or analysis.source.origin.may_drift
    axis = analysis.main.axis.name
    tried = interventions_on(analysis.causes, owner, axis, _failed_statistic(analysis, owner))
    unexplained = (
        ", which nothing that was tried explains" if tried and not is_explained_elsewhere else ""
    )
    if any(each.denied_by_truth for each in tried):
        unexplained = ", as its errors against the truth ask for"
    if hidden := interventions.error_beyond_reported_sigma(statement):
        return f"claimed {format_length(hidden.reported_sigma_m)}{since or unexplained}"
    if isinstance(statement, Unavailable):
        return "cannot be judged, since the log has no innovations or too few"
    if statement.verdict == "consistent":
        return "honest about it"
    how = "too modest" if statement.sigma_factor > 1.0 else "too sure of itself"
    return f"{format_excess(statement.sigma_error_factor)} {how}{since or unexplained}"


def _finding_sentence(analysis: Analysis, finding: Finding) -> str:
    """What a finding says is wrong, with when."""
    if finding.id == "source_gap":
        return _gap_sentence(analysis, finding)
    when = f" ({finding.when})" if finding.when and not finding.says_when else ""
    return f"{finding.headline}{when}."


def _gap_sentence(analysis: Analysis, finding: Finding) -> str:
    """The longest silence of the source, and where it left both filters."""
    start, end = max(finding.spans_s, key=lambda span: span[1] - span[0])
    just_before, result = end - 1e-6, analysis.main
    axis, ekf2 = result.axis, result.ekf2_state
    kf_position_m = float(state_at(result.replay, np.array([start, just_before]))[0][1])
    after = float(axis.measurement_m[np.searchsorted(axis.measurement_time_s, just_before)])
    true_position_m, against = after, "from the next position"
    if isinstance(result.truth, pd.DataFrame):
        true = result.truth["position_m"]
        true_position_m, against = float(np.interp(end, true.index, true)), "from the truth"
    filters_text, error_text = (
        "the filter coasted on the IMU",
        f"ours was {format_length(abs(kf_position_m - true_position_m))}",
    )
    if isinstance(ekf2, pd.DataFrame) and len(before := ekf2["position_m"].loc[:end]):
        filters_text = "both filters coasted on the IMU"
        if others := _fused(analysis.flight.ekf2, start, end):
            filters_text = f"ours coasted on the IMU, EKF2 went on by {' and '.join(others)}"
        error_text += f" and EKF2 {format_length(abs(float(before.iloc[-1]) - true_position_m))}"
    count = len(finding.spans_s)
    more = f" (the longest of {count} times)" if count > 1 else ""
    return (
        f"From {start:.0f} s to {end:.0f} s the source was silent{more}: {filters_text}; at the end {error_text} "
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


def _difference_after_change(
    analysis: Analysis, causes: Mapping[FilterName, Intervention | None]
) -> Iterator[str]:
    """What putting the cause right does to how far both filters are apart."""
    reductions = [
        intervention
        for owner, cause in causes.items()
        for intervention in interventions_on(
            analysis.causes, owner, analysis.main.axis.name, "apart"
        )
        if cause is not None and intervention.explains >= interventions.MIN_EXPLAINED_SHARE
    ]
    if reductions:
        most = max(reductions, key=lambda intervention: intervention.explains)
        owner = "our filter" if most.filter == "kf" else "EKF2"
        yield (
            f"Put right in {owner}, that brings both from {format_length(most.before)} to "
            f"{format_length(most.after)} apart (RMS, replayed)."
        )


def _differences(analysis: Analysis, *, has_difference_sentence: bool) -> Iterator[str]:
    """Why EKF2 differs, and what a loop shows."""
    loop, why = analysis.loop, analysis.why.get(analysis.main.axis.name)
    if isinstance(loop, Loop) and (gap := loop.closure_error_m) is not None:
        length = loop.path_length_m
        yield (
            f"The odometry fails to close its loop by {format_length(gap)} after "
            f"{format_length(length)} ({gap / length:.1%})."
        )
    if isinstance(why, Why) and not has_difference_sentence:
        yield why.cause  # wrong stamps are a finding of their own
