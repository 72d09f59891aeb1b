"""Summary of a flight: up to three paragraphs made from its numbers and findings.

The first one states the errors and the consistency of KF and EKF2 along the main axis. Then follow
the most severe findings, and the explanation of the difference KF - EKF2.
"""

from collections.abc import Iterator, Mapping

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.comparison import causal_replays
from px4fuse.comparison.causal_replays import Intervention, Statistic, find_cause, interventions_for
from px4fuse.comparison.model import FILTERS, Difference, ErrorsAgainstTruth, FilterName
from px4fuse.ekf2.steps import DifferenceExplanation
from px4fuse.ekf2_parameters import AIDS, EV_POS
from px4fuse.filter.kalman import state_at
from px4fuse.findings.cause_grouping import CLOCK, FRAME, PROCESS, SETTINGS, VARIANCES
from px4fuse.findings.cause_text import FINDINGS_OF_CAUSE, classify_cause, format_rerun
from px4fuse.findings.model import Finding, format_percent
from px4fuse.findings.source_positions import hardly_moved
from px4fuse.flight import Ekf2, Unavailable
from px4fuse.loop.model import Loop
from px4fuse.readers.px4_ekf2 import OTHER_HORIZONTAL_AIDS
from px4fuse.text import capitalise_first, format_factor

MAX_PARAGRAPHS = 3  # paragraphs of the summary
# Findings whose content is in the first paragraph
IN_FIRST_PARAGRAPH = VARIANCES | {"error_exceeds_reported_sigma", "ekf2_not_logged"}
# Faults of the source that no noise setting and no outlier removal corrects
NOISE_SHAPE_FINDINGS = frozenset(
    (
        "source_noise_unequal_axes",
        "source_time_offset_changes",
        "source_noise_time_correlated",
        "source_position_jump",
        "source_noise_varies",
        "source_samples_repeated",
        "source_scale_error",
        "source_low_pass_filtered",
    )
)
# Faults that rotate the measured acceleration, with the effect of process noise
MISALIGNMENT_FINDINGS = frozenset(("ekf2_heading_error", "source_frame_misaligned"))
# Findings listed after the explanation of the difference KF - EKF2
EFFECT_FINDINGS = frozenset({"ekf2_resets", "ekf2_rejects_positions", "ekf2_fusion_interrupted"})
NAMES: Mapping[FilterName, str] = {"kf": "KF", "ekf2": "EKF2"}


def summarise(analysis: Analysis, findings: tuple[Finding, ...]) -> tuple[str, ...]:
    """Summarise a flight in paragraphs, the most important first.

    Parameters
    ----------
    analysis : Analysis
    findings : tuple of Finding
        Most severe first.

    Returns
    -------
    tuple of str
        One to three paragraphs of short sentences.
    """
    axis = analysis.main.axis.name
    cause_by_filter = {
        filter_name: find_cause(
            analysis.causes, filter_name, axis, _statistic_to_explain(analysis, filter_name)
        )
        for filter_name in FILTERS
    }
    noise_shape_ids = {
        finding.id
        for finding in findings
        if finding.id in NOISE_SHAPE_FINDINGS and finding.severity != "note"
    }
    # a low-pass filter delays the positions, so the time offset is not a separate cause
    allowed_kinds = (FRAME,) if "source_low_pass_filtered" in noise_shape_ids else (CLOCK, FRAME)
    is_misaligned = any(
        finding.id in MISALIGNMENT_FINDINGS and finding.severity != "note" for finding in findings
    )
    for filter_name, cause in cause_by_filter.items():
        kind = classify_cause(analysis, cause)
        if (noise_shape_ids and kind not in allowed_kinds) or (is_misaligned and kind == PROCESS):
            cause_by_filter[filter_name] = None
    stated_ids = IN_FIRST_PARAGRAPH
    for cause in filter(None, cause_by_filter.values()):
        stated_ids |= FINDINGS_OF_CAUSE.get(classify_cause(analysis, cause), frozenset())
    if cause_by_filter["kf"] is not None and not causal_replays.SETTING_CHANGES.isdisjoint(
        cause_by_filter["kf"].change
    ):
        stated_ids |= SETTINGS
    findings_to_state = [
        finding
        for finding in findings
        if finding.caused_by is None and finding.severity != "note" and finding.id not in stated_ids
    ]
    has_explanation = bool(noise_shape_ids) or any(
        finding.id == "error_exceeds_reported_sigma" and finding.caused_by for finding in findings
    )
    sentences = [
        _verdict_paragraph(analysis, cause_by_filter, has_explanation),
        *(reduction_texts := tuple(_difference_after_change(analysis, cause_by_filter))),
        *(
            _finding_sentence(analysis, finding)
            for finding in findings_to_state
            if finding.id not in EFFECT_FINDINGS
        ),
        *_closing_sentences(analysis, has_difference_text=bool(reduction_texts)),
        *(
            _finding_sentence(analysis, finding)
            for finding in findings_to_state
            if finding.id in EFFECT_FINDINGS
        ),
    ]
    return tuple(sentences[:MAX_PARAGRAPHS])


def _statistic_to_explain(analysis: Analysis, filter_name: FilterName) -> Statistic:
    """Return the statistic that a cause explains: mean NEES if the error exceeds σ, else NIS."""
    return (
        "nees"
        if causal_replays.error_above_reported_sigma(analysis.main.filters[filter_name])
        else "nis"
    )


def format_metres(metres: float) -> str:
    """Format a length with two decimals, three below 0.1 m.

    >>> format_metres(0.0612), format_metres(0.3), format_metres(2.24)
    ('0.061 m', '0.30 m', '2.24 m')
    """
    return f"{metres:.{3 if metres < 0.0995 else 2}f} m"


def _verdict_paragraph(
    analysis: Analysis, causes: Mapping[FilterName, Intervention | None], has_explanation: bool
) -> str:
    """Format error and consistency of EKF2 and KF along the main axis, each with its re-run."""
    result, source = analysis.main, analysis.source
    along = f"Along {result.axis.label}"
    sentences = [_limited_flight(analysis)]
    filters: tuple[FilterName, ...] = ("ekf2", "kf")
    if isinstance(result.ekf2_state, Unavailable):
        filters = ("kf",)
    elif not all(
        isinstance(result.filters[filter_name].truth, ErrorsAgainstTruth) for filter_name in filters
    ):
        difference_text = f"{along} KF and EKF2 are compared"
        if isinstance(result.difference, Difference):
            difference_m = format_metres(result.difference.position_rms_m)
            difference_text = f"{along} KF and EKF2 differ by {difference_m} RMS"
        sentences.append(f"{difference_text}. The log contains no ground truth.")
        if source.origin.may_drift:
            sentences.append(f"Both filters follow {source.name}, which may drift.")
            filters = ()
    for filter_name in filters:
        sentences.append(_filter_sentence(analysis, filter_name))
        sentences.append(_explanation(analysis, filter_name, causes[filter_name], has_explanation))
    if isinstance(result.ekf2_state, Unavailable):
        sentences.append(f"The log contains no EKF2 state: {result.ekf2_state.reason}.")
    return " ".join(filter(None, sentences))


def _limited_flight(analysis: Analysis) -> str:
    """Return a sentence about a flight with little motion; empty for other flights."""
    if analysis.flight.airborne == ():
        return "The vehicle never took off."
    return "The vehicle hovered." if hardly_moved(analysis) else ""


def _filter_sentence(analysis: Analysis, filter_name: FilterName) -> str:
    """Format position RMSE and consistency of one filter, without causes."""
    name, summary, axis_label = (
        NAMES[filter_name],
        analysis.main.filters[filter_name],
        analysis.main.axis.label,
    )
    if isinstance(summary, Unavailable):
        verdict = "is not tested for consistency: the log has no innovations or too few"
    elif summary.verdict == "consistent":
        verdict = "is consistent"
    else:
        size = "large" if summary.verdict == "underconfident" else "small"
        factor = format_factor(summary.sigma_error_factor)
        verdict = f"is {summary.verdict}: σ is {factor} times too {size}"
    if not isinstance(summary.truth, ErrorsAgainstTruth):
        return f"By its innovations along {axis_label} {name} {verdict}."
    rmse = format_metres(summary.truth.position_rmse_m)
    if error := causal_replays.error_above_reported_sigma(summary):
        verdict = f"reports σ {format_metres(error.reported_sigma_m)}"
        return f"Along {axis_label} {name} has a position RMSE of {rmse}, but {verdict}."
    return f"Along {axis_label} {name} has a position RMSE of {rmse} and {verdict}."


def _explanation(
    analysis: Analysis, filter_name: FilterName, cause: Intervention | None, has_explanation: bool
) -> str:
    """Format the re-run that explains an inconsistent filter, or a note; empty if consistent."""
    summary, axis = analysis.main.filters[filter_name], analysis.main.axis.name
    is_hidden = causal_replays.error_above_reported_sigma(summary)
    if isinstance(summary, Unavailable) or (summary.verdict == "consistent" and not is_hidden):
        return ""
    if cause is not None:
        return f"{capitalise_first(format_rerun(analysis, cause))}."
    reruns = interventions_for(
        analysis.causes, filter_name, axis, _statistic_to_explain(analysis, filter_name)
    )
    if any(intervention.contradicts_truth for intervention in reruns):
        return "A smaller σ would be below the errors against ground truth."
    # drift and faults of the source are listed as findings
    is_explained_elsewhere = has_explanation or analysis.source.origin.may_drift
    return "No tested change explains this." if reruns and not is_explained_elsewhere else ""


def _finding_sentence(analysis: Analysis, finding: Finding) -> str:
    """Return the headline of a finding with its time."""
    if finding.id == "source_gap":
        return _gap_sentence(analysis, finding)
    when = finding.when if finding.when and not finding.has_time_in_message else ""
    return f"{finding.title}{f' ({when})' if when else ''}."


def _gap_sentence(analysis: Analysis, finding: Finding) -> str:
    """Describe the longest gap in the source, with the errors of KF and EKF2 at its end."""
    start, end = max(finding.spans_s, key=lambda span: span[1] - span[0])
    before_end_s, result = end - 1e-6, analysis.main
    axis, ekf2 = result.axis, result.ekf2_state
    kf_position_m = float(state_at(result.replay, np.array([start, before_end_s]))[0][1])
    next_position_m = float(
        axis.measurement_m[np.searchsorted(axis.measurement_time_s, before_end_s)]
    )
    true_position_m, quantity = next_position_m, "distance to the next position"
    if isinstance(result.truth, pd.DataFrame):
        true_position = result.truth["position_m"]
        true_position_m, quantity = (
            float(np.interp(end, true_position.index, true_position)),
            "position error",
        )
    filters_text = "KF relied on the IMU"
    errors_text = f"{format_metres(abs(kf_position_m - true_position_m))} (KF)"
    if isinstance(ekf2, pd.DataFrame) and len(ekf2_position := ekf2["position_m"].loc[:end]):
        filters_text = "KF and EKF2 relied on the IMU"
        if other_aids := _find_continuously_fused_aids(analysis.flight.ekf2, start, end):
            filters_text = f"KF relied on the IMU, EKF2 also on {' and '.join(other_aids)}"
        ekf2_error_m = abs(float(ekf2_position.iloc[-1]) - true_position_m)
        errors_text += f" and {format_metres(ekf2_error_m)} (EKF2)"
    count = len(finding.spans_s)
    longest = f" (the longest of {count})" if count > 1 else ""
    return (
        f"Gap in the position source from {start:.0f} s to {end:.0f} s{longest}. In it "
        f"{filters_text}. At its end the {quantity} was {errors_text}."
    )


def _find_continuously_fused_aids(
    ekf2: Ekf2 | Unavailable, start_s: float, end_s: float
) -> list[str]:
    """Return the labels of motion aids that EKF2 fused without a gap of half the span."""
    labels = []
    for name in (EV_POS.name, *OTHER_HORIZONTAL_AIDS):
        log = None if isinstance(ekf2, Unavailable) else ekf2.aids.get(name)
        if log is not None and "fused" in log.samples:
            fused = log.samples["fused"].loc[start_s:end_s]
            times_s = [start_s, *fused.index[fused > 0.0], end_s]
            if np.diff(times_s).max() < 0.5 * (end_s - start_s):
                labels.append(AIDS[name].label)
    return labels


def _difference_after_change(
    analysis: Analysis, causes: Mapping[FilterName, Intervention | None]
) -> Iterator[str]:
    """Yield the difference KF - EKF2 before and after the re-run with the largest effect."""
    reductions = [
        intervention
        for filter_name, cause in causes.items()
        for intervention in interventions_for(
            analysis.causes, filter_name, analysis.main.axis.name, "difference"
        )
        if cause is not None
        and intervention.explained_fraction >= causal_replays.MIN_EXPLAINED_SHARE
    ]
    if reductions:
        largest = max(reductions, key=lambda intervention: intervention.explained_fraction)
        yield (
            f"Re-run of {NAMES[largest.filter]} with this correction: difference KF - EKF2 "
            f"{largest.before:.2f} → {largest.after:.2f} m RMS."
        )


def _closing_sentences(analysis: Analysis, *, has_difference_text: bool) -> Iterator[str]:
    """Yield the loop closure error, and the explanation of the difference KF - EKF2."""
    loop, why = analysis.loop, analysis.difference_steps.get(analysis.main.axis.name)
    if isinstance(loop, Loop) and (error_m := loop.closure_error_m) is not None:
        length_m = loop.path_length_m
        yield (
            f"The odometry has a loop closure error of {format_metres(error_m)} after "
            f"{length_m:.0f} m ({format_percent(error_m / length_m, 1)})."
        )
    if isinstance(why, DifferenceExplanation) and not has_difference_text:
        yield why.cause
