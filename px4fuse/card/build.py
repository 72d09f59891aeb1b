"""Build the diagnosis card: one-page summary of the faults and filter consistency of a flight."""

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from px4fuse.analysis import AidingSourceAnalysis, Analysis
from px4fuse.comparison.flight_events import MIN_GAP_S
from px4fuse.comparison.model import (
    FILTER_NAMES,
    AxisComparison,
    ErrorsAgainstTruth,
    FilterName,
    select_north_and_east,
)
from px4fuse.comparison.remedy import find_aid
from px4fuse.comparison.rerun_effects import classify_improvement
from px4fuse.core.reading import display_name, get_file_size, read_head
from px4fuse.core.text import (
    capitalise_first_letter,
    format_metres,
    format_ratio,
    lowercase_first_letter,
    with_log_name,
)
from px4fuse.ekf2.fusion_conditions import is_height_only
from px4fuse.errors import LogError, MissingDataError
from px4fuse.filter.consistency import classify_sigma_ratio
from px4fuse.filter.settings import KF_NUMERIC_SETTINGS, SETTING_RANGES, Settings
from px4fuse.filter.signals import AISLE_AXIS
from px4fuse.finding import Finding
from px4fuse.findings.model import format_occurrences, format_percent, split_cause_groups
from px4fuse.findings.source_positions import has_little_motion
from px4fuse.flight.ekf2_parameters import MODEL_PARAMETERS
from px4fuse.flight.model import Ekf2, LogInfo, Unavailable
from px4fuse.request import (
    COMPARISON_OPTIONS,
    ComparisonRequest,
    command_line,
    replace_argument_names,
)

from .causes import (
    RankedCause,
    can_show_effect,
    make_cause,
    make_cause_without_reruns,
    rank_causes,
)
from .model import (
    MAX_CAUSES_ON_CARD,
    MAX_HEADLINE_LENGTH,
    Action,
    AidConsistency,
    AnalysisDescription,
    CardSeverity,
    DiagnosedCause,
    DiagnosisCard,
    FlightErrors,
    Note,
    Verdict,
)
from .verdicts import make_sigma_verdicts

MAX_ACTIONS = 3
# Minimum fraction of rejected positions that is stated on the diagnosis card
MIN_REPORTED_REJECTED_FRACTION = 0.01
# Aiding sources for which EKF2's √S is usually too large with PX4's default noises
USUALLY_UNDERCONFIDENT_AIDS = frozenset({"baro_hgt", "mag", "gravity"})
SMALL_INNOVATIONS_EXPLANATION = (
    "The innovations are smaller than expected. Small innovations are not a fault here: the "
    "source may drift, and innovations do not show drift. Do not reduce noise settings."
)
# The σ ratio (actual σ ÷ reported σ) against ground truth is compared with the σ ratio against the
# source. They agree if the verdicts are the same and the first is at most this multiple of the
# second
MAX_TRUTH_TO_SOURCE_RATIO = 2.0
PRINTED_FIRST_BYTES = 4  # number of first bytes of an unreadable log that are printed
ULOG_FIRST_BYTES = "55 4C 6F 67"  # first bytes of each ULog file (hexadecimal)
HEADING_ERROR_EXPLANATION = (
    "KF and EKF2 rotate the measured acceleration by a wrong heading. The innovations stay small, "
    "because each measured position corrects the predicted position."
)
OUTLIER_EXPLANATION = (
    "The mean NIS of EKF2 includes the outliers that EKF2's gate rejects. Rejected outliers do not "
    "affect EKF2's position."
)
UNEXPLAINED_DIFFERENCE_TEXT = (
    "For KF or EKF2, innovations and ground truth give different ratios of actual to reported σ. "
    "No re-run of the filters explains the difference."
)
# Reasons why faults of the source increase errors, but hardly change innovations
SOURCE_FAULT_EXPLANATIONS = (
    (
        {"source_axes_wrong", "source_orientation_wrong", "source_unit_wrong"},
        "KF uses positions that px4fuse corrected. EKF2 used the uncorrected positions.",
    ),
    (
        {
            "source_time_offset",
            "source_scale_error",
            "source_frame_misaligned",
            "source_position_jump",
        },
        "KF and EKF2 follow the faulty positions, so innovations hardly show the position error.",
    ),
)


def build_card(
    analysis: Analysis, request: ComparisonRequest, student: tuple[str, str] = ("", "")
) -> DiagnosisCard:
    """Build the diagnosis card of a flight.

    Parameters
    ----------
    request : ComparisonRequest
        Options for the recommended commands.
    student : (str, str)
        Name and id.
    """
    source, segment = analysis.source, analysis.segment
    settings_text, changed_options = _describe_kf_settings(analysis, request)
    analysis_description = _describe_analysis(
        analysis.flight.log,
        request,
        student,
        source=f"{source.kind_name} {source.compute_rate_hz():.1f} Hz",
        settings=settings_text,
        changed=changed_options,
        parameters=_format_changed_parameters(analysis),
        segment=f"{segment.start_s:.1f} to {segment.end_s:.1f} s, {segment.reason}",
    )
    if analysis.flight.log.is_assessed:
        headline = "Assignment: the student makes the diagnosis, so px4fuse prints none"
        return DiagnosisCard(severity="note", headline=headline, identity=analysis_description)
    cause_findings = [group[0] for group in split_cause_groups(analysis.findings)]
    verdicts = make_sigma_verdicts(analysis.main)
    ranked_causes = rank_causes(analysis, cause_findings)
    causes = tuple(
        make_cause(analysis, ranked_cause, verdicts, request)
        for ranked_cause in ranked_causes[:MAX_CAUSES_ON_CARD]
    )
    # An inconsistent σ is not always a fault of the filter settings. Find the verdicts that need no
    # change of settings, and the reason
    sigma_verdicts, explanation = _explain_verdict_differences(analysis, verdicts, causes)
    effect = _summarise_errors(analysis)
    severity: CardSeverity = "clean"
    if causes:
        severity = causes[0].severity
    elif any(verdict.is_fault for verdict in sigma_verdicts):
        severity = "note"
    notes = _make_notes(cause_findings, request.log)
    return DiagnosisCard(
        severity=severity,
        id=causes[0].id if causes else "",
        headline=_make_headline(causes, sigma_verdicts),
        effect=effect,
        effect_text=_describe_effect(analysis, effect, sigma_verdicts),
        do_this=_format_actions(causes, notes),
        verdicts=sigma_verdicts,
        reconcile=explanation,
        difference=_describe_difference(effect, ranked_causes),
        causes=causes,
        more_causes=max(len(ranked_causes) - MAX_CAUSES_ON_CARD, 0),
        notes=notes,
        identity=analysis_description,
    )


def build_aids_card(
    analysis: AidingSourceAnalysis, request: ComparisonRequest, student: tuple[str, str]
) -> DiagnosisCard:
    """Build the diagnosis card of a flight without positions, about the aiding sources of EKF2."""
    cause_findings = [group[0] for group in split_cause_groups(analysis.findings)]
    faults = [finding for finding in cause_findings if finding.severity != "note"]
    causes = tuple(make_cause_without_reruns(finding) for finding in faults[:MAX_CAUSES_ON_CARD])
    missing_data = analysis.missing_data
    notes = _make_notes(cause_findings, request.log)
    return DiagnosisCard(
        severity=causes[0].severity if causes else "clean",
        id=causes[0].id if causes else "",
        headline=causes[0].title if causes else "No fault found in EKF2's aiding sources",
        do_this=_format_actions(causes, notes),
        causes=causes,
        more_causes=max(len(faults) - MAX_CAUSES_ON_CARD, 0),
        notes=notes,
        aids=tuple(
            AidConsistency(
                label=aid.label,
                component=name,
                ratio=math.sqrt(axis.nis_mean) if axis.nis_mean else None,
                is_usual=key in USUALLY_UNDERCONFIDENT_AIDS,
            )
            for key, aid in analysis.aids.items()
            for name, axis in aid.axes.items()
        ),
        facts={
            "KF": f"not run: {missing_data.reason}. {replace_argument_names(missing_data.remedy)}"
        },
        identity=_describe_analysis(
            analysis.flight.log, request, student, source="no position source"
        ),
    )


def build_unusable_log_card(error: LogError | MissingDataError, path: Path) -> DiagnosisCard:
    """Build the diagnosis card of a log that cannot be analysed, with reason and action."""
    text_by_label = {}
    with suppress(LogError):  # the headline already contains the reason of an unreadable file
        first_bytes = read_head(path, PRINTED_FIRST_BYTES, LogError).hex(" ").upper()
        size_bytes = get_file_size(path, LogError)
        text_by_label["read"] = (
            f"{size_bytes:,} bytes; first bytes {first_bytes} (of a ULog: {ULOG_FIRST_BYTES})"
        )
    if error.remedy:
        text_by_label["fix"] = replace_argument_names(with_log_name(error.remedy, str(path)))
    return DiagnosisCard(
        severity="refused",
        id=error.id,
        headline=replace_argument_names(error.reason),
        facts=text_by_label,
        identity=AnalysisDescription(file=display_name(path)),
    )


def _make_headline(causes: Sequence[DiagnosedCause], sigma_verdicts: Sequence[Verdict]) -> str:
    """Return the headline of the diagnosis card."""
    if causes:
        main_cause, *further_causes = causes
        for further_cause in further_causes:
            joined_titles = f"{main_cause.title}; {lowercase_first_letter(further_cause.title)}"
            if further_cause.severity == "error" and len(joined_titles) <= MAX_HEADLINE_LENGTH:
                return joined_titles
        return main_cause.title
    if fault_verdicts := [verdict for verdict in sigma_verdicts if verdict.is_fault]:
        worst_verdict = max(fault_verdicts, key=lambda verdict: abs(math.log(verdict.ratio or 1.0)))
        ratio = worst_verdict.ratio or 1.0
        return (
            f"{FILTER_NAMES[worst_verdict.filter]} {worst_verdict.word}: σ "
            f"{format_ratio(max(ratio, 1.0 / ratio))} times too "
            f"{'small' if ratio > 1.0 else 'large'} compared with "
            f"{'the innovations' if worst_verdict.against == 'source' else 'ground truth'}"
        )
    consistent_filters = dict.fromkeys(
        FILTER_NAMES[verdict.filter] for verdict in sigma_verdicts if verdict.word == "consistent"
    )
    if not consistent_filters:
        return "No fault found; KF and EKF2 could not be evaluated"
    verb = "is" if len(consistent_filters) == 1 else "are"
    return f"No fault found: {' and '.join(consistent_filters)} {verb} consistent"


def _summarise_errors(analysis: Analysis) -> FlightErrors:
    """Return position errors along the axis of largest motion, and EKF2's rejections and resets."""
    comparison, segment, reset_count = analysis.main, analysis.segment.whole_flight, None
    difference = comparison.difference
    if isinstance(analysis.flight.ekf2, Ekf2):
        reset_count = sum(
            segment.start_s < reset.time_s <= segment.end_s
            for reset in analysis.flight.ekf2.find_horizontal_resets()
        )
    return FlightErrors(
        axis=describe_axis(analysis, comparison),
        position_rmse_m=_find_rmse_by_filter_m(comparison),
        horizontal_rmse_m=_compute_horizontal_rmse_m(analysis),
        difference_rms_m=None if isinstance(difference, Unavailable) else difference.position_rms_m,
        rejected_fraction=comparison.rejected_fraction,
        horizontal_resets=reset_count,
    )


def describe_axis(analysis: Analysis, result: AxisComparison) -> str:
    """Describe a direction, for example "along the axis of largest motion, 30° from north"."""
    direction, heading, source = f"along {result.axis.label}", result.heading_deg, analysis.source
    if result.axis.name != AISLE_AXIS or heading is None:
        return direction
    reference = f"the {source.kind_name} x axis" if source.frame == "FRD" else "north"
    return f"{direction}, {heading % 180.0:.0f}° from {reference}"


def _find_rmse_by_filter_m(result: AxisComparison) -> dict[FilterName, float]:
    return {
        filter_name: truth.position_rmse_m
        for filter_name, summary in result.filters.items()
        if isinstance(truth := summary.truth, ErrorsAgainstTruth)
    }


def _compute_horizontal_rmse_m(analysis: Analysis) -> dict[FilterName, float]:
    """Return √(RMSE_north² + RMSE_east²) for each filter with errors along both axes."""
    rmse_by_axis_m = [_find_rmse_by_filter_m(result) for result in select_north_and_east(analysis)]
    return {
        name: math.hypot(*(rmse_m[name] for rmse_m in rmse_by_axis_m))
        for name in FILTER_NAMES
        if len(rmse_by_axis_m) == 2 and all(name in rmse_m for rmse_m in rmse_by_axis_m)
    }


def _describe_effect(
    analysis: Analysis, effect: FlightErrors, sigma_verdicts: Sequence[Verdict]
) -> str:
    if analysis.flight.airborne == () and has_little_motion(analysis):
        return (
            "The vehicle stayed on the ground, so the errors of KF and EKF2 apply only to a "
            "vehicle at rest."
        )
    if is_height_only(analysis.source):
        return "The source measures only the height, so horizontal errors are not evaluated."
    has_truth = bool(effect.position_rmse_m)
    sentences = _describe_position_errors(analysis, effect, sigma_verdicts) if has_truth else []
    is_consistent = all(verdict.word == "consistent" for verdict in sigma_verdicts)
    if effect.difference_rms_m is not None and (is_consistent or not has_truth):
        sentences.append(f"{_format_difference(effect.axis, effect.difference_rms_m)}.")
    if not has_truth:
        sentences.append(
            "The log has no ground truth, so the position errors of KF and EKF2 are unknown."
        )
    rejected_fraction = effect.rejected_fraction or 0.0
    if rejected_fraction >= MIN_REPORTED_REJECTED_FRACTION:
        sentences.append(f"EKF2 rejected {format_percent(rejected_fraction)} of the positions.")
    if effect.horizontal_resets:
        count_text = format_occurrences(effect.horizontal_resets)
        sentences.append(f"EKF2 reset its horizontal position {count_text}.")
    return " ".join(sentences)


def _describe_position_errors(
    analysis: Analysis, effect: FlightErrors, sigma_verdicts: Sequence[Verdict]
) -> list[str]:
    """Describe the position errors of KF and EKF2 against ground truth.

    The errors are given as RMSE, and as a multiple of the reported σ for inconsistent filters.
    """
    segment, flight, span_text = analysis.segment, analysis.segment.whole_flight, ""
    if max(segment.start_s - flight.start_s, flight.end_s - segment.end_s) > MIN_GAP_S:
        span_text = f" from {segment.start_s:.1f} to {segment.end_s:.1f} s"
    sentences = [
        f"Position RMSE along {analysis.main.axis.label}{span_text}: "
        f"{_format_lengths(effect.position_rmse_m)}."
    ]
    if effect.horizontal_rmse_m:
        sentences.append(f"Horizontal RMSE: {_format_lengths(effect.horizontal_rmse_m)}.")
    sentences += [
        f"The position error of {FILTER_NAMES[verdict.filter]} is "
        f"{format_ratio(verdict.ratio)} times its reported σ."
        for verdict in sigma_verdicts
        if verdict.against == "truth" and verdict.ratio and verdict.word != "consistent"
    ]
    return sentences + _describe_worst_axis(analysis)


def _describe_worst_axis(analysis: Analysis) -> list[str]:
    """State EKF2's position error along a secondary axis if EKF2 is most overconfident there.

    Secondary axes are all axes except the axis of largest motion.
    """

    def compute_error_to_sigma_ratio(result: AxisComparison) -> float:
        """Return √(mean NEES) of EKF2's position along an axis; 0 if the axis is not considered."""
        truth = result.filters["ekf2"].truth
        if isinstance(truth, Unavailable) or (
            truth.has_only_lag_errors and result is not analysis.main
        ):
            return 0.0
        return math.sqrt(truth.nees_position_mean or 0.0)

    worst_result = max(
        (analysis.main, *analysis.select_secondary_axes()), key=compute_error_to_sigma_ratio
    )
    ratio = compute_error_to_sigma_ratio(worst_result)
    if worst_result is analysis.main or classify_sigma_ratio(ratio, "truth") != "overconfident":
        return []
    rmse_m = _find_rmse_by_filter_m(worst_result)["ekf2"]
    return [
        f"EKF2's position RMSE along {worst_result.axis.label} is {format_metres(rmse_m)} m, "
        f"{format_ratio(ratio)} times its reported σ."
    ]


def _format_difference(axis_text: str, rms_m: float) -> str:
    direction = axis_text.partition(",")[0]
    return f"RMS position difference KF − EKF2 {direction}: {format_metres(rms_m)} m"


def _format_lengths(length_by_filter_m: Mapping[FilterName, float]) -> str:
    return ", ".join(
        f"{FILTER_NAMES[filter_name]} {format_metres(length_m)} m"
        for filter_name, length_m in length_by_filter_m.items()
    )


def _format_actions(causes: Sequence[DiagnosedCause], notes: Sequence[Note]) -> tuple[str, ...]:
    """Return at most MAX_ACTIONS recommended actions, each as one sentence."""
    action_sentences = [
        f"Optional: {lowercase_first_letter(note.action)}"
        for note in notes
        if not causes and note.action.startswith("Set ")
    ]
    for number, cause in enumerate(causes, 1):
        alternative_texts = [
            _format_action(action) for group in cause.alternatives for action in group
        ]
        sentences = [", or ".join(alternative_texts)] if alternative_texts else []
        sentences += [
            _format_action(action)
            for action in cause.actions
            if action.commands or action.changes_something()
        ]
        label = f"Cause {number}, " if len(causes) > 1 else ""
        action_sentences += [
            capitalise_first_letter(f"{label}{sentence}.") for sentence in sentences
        ]
    if not (causes or action_sentences):
        return ("Change nothing.",)
    return tuple(dict.fromkeys(action_sentences))[:MAX_ACTIONS]


def _format_action(action: Action) -> str:
    """Format an action as "device or filter: commands", or as "device or filter: sentence"."""
    if action.where == "console":
        # A single command "param set EKF2_EV_DELAY 100" already names the parameter. Of the
        # sentence "EKF2_EV_DELAY 0 → 100 ms", keep only "0 → 100 ms"
        change_text = action.sentence
        if len(action.commands) == 1:
            _, _, change_text = action.sentence.partition(" ")
        return f"EKF2: {', '.join(action.commands)} ({change_text})"
    if action.where == "shell":
        # Of the command "px4fuse compare LOG --sigma-z 0.1", show only "--sigma-z 0.1"
        _, _, options_text = action.commands[0].partition(" --")
        return f"KF: run again with --{options_text}"
    text = lowercase_first_letter(action.sentence.rstrip("."))
    return f"{action.target_name}: {text}"


def _mark_explained_verdicts(
    sigma_verdicts: Sequence[Verdict], causes: Sequence[DiagnosedCause], *, may_drift: bool
) -> tuple[Verdict, ...]:
    """Set ``is_explained`` in the verdicts that do not require a change of filter settings.

    A verdict "overconfident" or "underconfident" requires no change if

    - the recommended action is to keep the settings of the filter,
    - the filter is consistent against ground truth, or
    - the filter is underconfident only against its source, and the source may drift.
    """
    filters_to_keep_unchanged = {
        label
        for cause in causes
        for action in cause.actions
        if action.keeps_settings
        for label in action.target.split(", ")  # the target may be "KF, EKF2"
    }
    truth_verdict_word_by_filter = {
        verdict.filter: verdict.word for verdict in sigma_verdicts if verdict.against == "truth"
    }

    def needs_no_change(verdict: Verdict) -> bool:
        # Verdict on the same filter from its errors against ground truth
        truth_word = truth_verdict_word_by_filter[verdict.filter]
        if FILTER_NAMES[verdict.filter] in filters_to_keep_unchanged or truth_word == "consistent":
            return True
        # Innovations do not contain drift, so small innovations do not prove a too large σ
        has_small_innovations = (verdict.against, verdict.word) == ("source", "underconfident")
        return may_drift and has_small_innovations and truth_word != "underconfident"

    return tuple(
        replace(verdict, is_explained=verdict.is_fault and needs_no_change(verdict))
        for verdict in sigma_verdicts
    )


def _explain_verdict_differences(
    analysis: Analysis, sigma_verdicts: tuple[Verdict, ...], causes: Sequence[DiagnosedCause]
) -> tuple[tuple[Verdict, ...], str]:
    """Explain why verdicts from innovations differ from verdicts from errors against ground truth.

    Return the verdicts with ``is_explained`` set, and the explanation.
    """
    may_drift, ekf2_errors = analysis.source.origin.may_drift, analysis.main.filters["ekf2"].truth
    sigma_verdicts = _mark_explained_verdicts(sigma_verdicts, causes, may_drift=may_drift)
    ekf2_verdict = next(
        each for each in sigma_verdicts if (each.filter, each.against) == ("ekf2", "truth")
    )
    # EKF2 reports σ for its position at the fusion horizon, not for the published position. If no
    # fault is known and the error at the fusion horizon agrees with σ, EKF2 is consistent
    if (
        not causes
        and ekf2_verdict.word == "overconfident"
        and isinstance(ekf2_errors, ErrorsAgainstTruth)
        and ekf2_errors.nees_position_horizon_mean
    ):
        horizon_sigma_ratio = math.sqrt(ekf2_errors.nees_position_horizon_mean)
        if classify_sigma_ratio(horizon_sigma_ratio, "truth") == "consistent":
            sigma_verdicts = tuple(
                replace(each, is_explained=True) if each is ekf2_verdict else each
                for each in sigma_verdicts
            )
            return sigma_verdicts, (
                "EKF2 reports σ for its delayed position at the fusion horizon. The error of the "
                f"delayed position is {format_ratio(horizon_sigma_ratio)} times σ, so EKF2 is "
                "consistent. The output predictor adds a lag error to the published position."
            )
    explanation = _explain_differing_verdicts(analysis, sigma_verdicts, causes)
    # The innovations and the errors against ground truth may give contradictory verdicts without a
    # known reason. Then do not mark any verdict as free of fault
    if explanation == UNEXPLAINED_DIFFERENCE_TEXT:
        sigma_verdicts = tuple(replace(verdict, is_explained=False) for verdict in sigma_verdicts)
    elif not explanation and may_drift and any(verdict.is_explained for verdict in sigma_verdicts):
        explanation = SMALL_INNOVATIONS_EXPLANATION
    return sigma_verdicts, explanation


def _explain_differing_verdicts(
    analysis: Analysis, sigma_verdicts: Sequence[Verdict], causes: Sequence[DiagnosedCause]
) -> str:
    """Return the reason why the two σ ratios of a filter differ; "" if they agree."""
    # Filters whose position and σ both improve in a re-run without the main fault. A re-run with
    # is_prediction is a replay of EKF2
    filters_affected_by_fault = {
        "ekf2" if rerun.is_prediction else "kf"
        for rerun in (causes[0].reruns if causes else ())
        if rerun.improves == "position and σ"
    }
    filters_with_differing_ratios = []
    for filter_name in FILTER_NAMES:
        # A filter has two verdicts: first against the source, then against ground truth
        source, truth = (verdict for verdict in sigma_verdicts if verdict.filter == filter_name)
        if source.ratio is None or truth.ratio is None:
            continue
        # The two σ ratios of a filter may differ strongly although their verdicts are the same. The
        # first fault is a sufficient reason if a re-run without it improves the filter
        is_truth_ratio_unexplained = (
            truth.ratio > MAX_TRUTH_TO_SOURCE_RATIO * source.ratio
            and filter_name not in filters_affected_by_fault
        )
        if source.word != truth.word or is_truth_ratio_unexplained:
            filters_with_differing_ratios.append(filter_name)
    if not filters_with_differing_ratios:
        return ""
    finding_ids = {finding.id for finding in analysis.findings}
    for fault_ids, sentence in SOURCE_FAULT_EXPLANATIONS:
        if not finding_ids.isdisjoint(fault_ids):
            return sentence
    if filters_affected_by_fault.issuperset(filters_with_differing_ratios):
        filter_labels = " and ".join(FILTER_NAMES[name] for name in filters_with_differing_ratios)
        return (
            f"The main fault hardly changes the innovations of {filter_labels}, but it increases "
            "the errors against ground truth. A re-run without the main fault reduces the "
            "position error."
        )
    if analysis.source.origin.may_drift:
        return (
            "The position noise is smaller than KF and EKF2 assume, so innovations are small. Only "
            "ground truth or a loop closure shows the drift of the source."
        )
    if "source_noise_time_correlated" in finding_ids:
        return (
            "KF and EKF2 follow time-correlated position errors. Only ground truth shows these "
            "errors."
        )
    explanation = UNEXPLAINED_DIFFERENCE_TEXT
    if "source_outliers" in finding_ids and "ekf2" in filters_with_differing_ratios:
        explanation = OUTLIER_EXPLANATION
    elif "ekf2_heading_error" in finding_ids:
        explanation = HEADING_ERROR_EXPLANATION
    return explanation


def _describe_difference(effect: FlightErrors, ranked_causes: Sequence[RankedCause]) -> str:
    """Describe the RMS difference KF − EKF2, and the effect of the main fault on the difference."""
    if effect.difference_rms_m is None or not ranked_causes:
        return ""
    difference_text = _format_difference(effect.axis, effect.difference_rms_m)
    reruns = ranked_causes[0].reruns
    # A fault affects a filter if a re-run without the fault improves the position of the filter.
    # If the log cannot show this effect, the filter counts as affected
    filters_affected_by_fault = {
        rerun.filter
        for rerun in reruns
        if classify_improvement(rerun) in ("position", "position and σ")
        or not can_show_effect(rerun)
    }
    if len(filters_affected_by_fault) == 2:
        return (
            f"{difference_text}. The main fault affects both KF and EKF2, so the difference "
            "KF − EKF2 hardly shows this fault."
        )
    # Report the re-run of the affected filter. If no filter is affected, report any re-run, but
    # prefer a re-run of KF
    possible_filters = filters_affected_by_fault or {rerun.filter for rerun in reruns}
    corrected_filter: FilterName = "kf" if "kf" in possible_filters else "ekf2"
    for rerun in reruns:  # the best re-run first
        rms_m = rerun.after.difference_rms_m
        if rerun.filter == corrected_filter and rms_m is not None:
            label = {"kf": "KF", "ekf2": "EKF2 (replay)"}[corrected_filter]
            return f"{difference_text}; {format_metres(rms_m)} m in the re-run of {label}."
    return f"{difference_text}."


def _make_notes(cause_findings: Sequence[Finding], log_name: str) -> tuple[Note, ...]:
    return tuple(
        Note(finding.id, f"{finding.title}.", with_log_name(finding.remedy, log_name))
        for finding in cause_findings
        if finding.severity == "note"
    )


def _describe_analysis(
    log: LogInfo, request: ComparisonRequest, student: tuple[str, str], **texts: Any
) -> AnalysisDescription:
    """Describe the log and the command of an analysis."""
    return AnalysisDescription(
        file=log.name,
        firmware=log.firmware,
        hardware=log.hardware,
        duration_s=log.duration_s,
        command=command_line(request.with_file_names()),
        student=student[0],
        student_id=student[1],
        version=f"px4fuse {metadata.version('px4fuse')}",
        **texts,
    )


def _describe_kf_settings(
    analysis: Analysis, request: ComparisonRequest
) -> tuple[str, tuple[str, ...]]:
    """Return all settings of KF with their origin, and the options that change a default."""
    setting_texts, changed_options = [], []
    for name in KF_NUMERIC_SETTINGS:
        used, default, requested = (
            getattr(settings, name) for settings in (analysis.settings, Settings(), request)
        )
        origin_text = "default" if used == default else "set by the user"
        default_text = f"{default:g}"
        # For GNSS, SIGMA_Z defaults to the noise parameter of EKF2, not to a constant
        if name == "sigma_z_m" and analysis.source.origin.is_gnss:
            default, default_text = None, f"from {find_aid(analysis).noise}"
            if requested is None:
                origin_text = default_text
        setting_texts.append(f"{SETTING_RANGES[name].format_value(used)} ({origin_text})")
        if requested not in (None, default):
            option = f"{COMPARISON_OPTIONS[name]} {requested:g}"
            changed_options.append(f"{option} (default {default_text})")
    return ", ".join(setting_texts), tuple(changed_options)


def _format_changed_parameters(analysis: Analysis) -> tuple[str, ...]:
    aid = analysis.source.origin.aid
    if aid is None:
        return ()
    log, parameter_texts = analysis.flight.log, []
    for name in (aid.noise, aid.delay, aid.gate):
        value, default = log.parameters.get(name), log.find_default_value(name)
        if value is not None and not math.isclose(value, default, rel_tol=1e-3):
            value_text = f"{name} {value:.4g} {MODEL_PARAMETERS[name].unit}".rstrip()
            parameter_texts.append(f"{value_text} (PX4 default {default:g})")
    return tuple(parameter_texts)
