"""Rank the possible causes of a fault by re-runs of KF and EKF2, and choose actions."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from typing import NamedTuple

from msgspec import structs

from px4fuse.analysis import Analysis
from px4fuse.comparison.changes import SIGMA_A_KEY, SIGMA_Z_KEY
from px4fuse.comparison.model import FilterName
from px4fuse.comparison.remedy import make_delay_change, select_changed_settings
from px4fuse.comparison.rerun_effects import (
    OUTLIERS_KEY,
    TIME_OFFSET_KEY,
    Rerun,
    becomes_consistent,
    classify_improvement,
    compare_sigma_ratios,
    compute_preference_key,
    compute_sigma_ratio_improvement,
    halves_discrepancy,
    has_effect,
    remains_overconfident,
)
from px4fuse.core.text import lowercase_first_letter, with_log_name
from px4fuse.filter.consistency import classify_sigma_ratio
from px4fuse.finding import Finding
from px4fuse.findings.cause_text import format_sender_action
from px4fuse.findings.model import FINDING_CATALOGUE, WRONG_CONVENTION_KEY
from px4fuse.flight.ekf2_parameters import MODEL_PARAMETERS
from px4fuse.flight.model import PositionTrack, Unavailable
from px4fuse.request import COMPARISON_OPTIONS, ComparisonRequest, command_line

from .model import Action, ActionTarget, CardRerun, DiagnosedCause, Verdict

SETTING_CHANGE_KINDS = frozenset({"noises", "noise", "gate", "process noise"})
# Kinds of changes in a re-run that shift or rotate the position measurements: only errors against
# ground truth show their effect
CHANGE_KINDS_VISIBLE_ONLY_IN_TRUTH = frozenset({"time offset", "delay", "rotation"})
# Name endings of PX4 parameters that require a reboot (reboot_required)
REBOOT_PARAMETER_SUFFIXES = ("_DELAY", "_DELAY_MAX", "_PREDICT_US")
# The table of re-runs shows the fraction of rejected positions if it is at least this value
MIN_REJECTED_FRACTION_TO_SHOW = 0.005
# Filters whose settings the user can change
TARGET_BY_ADJUSTABLE_FILTER: Mapping[FilterName, ActionTarget] = {"kf": "KF", "ekf2": "EKF2"}
# Label of a re-run with corrected data, by kind of change
CORRECTION_TEXTS = {
    "time offset": "time offset corrected",
    "rotation": "rotation corrected",
    "bias": "accelerometer bias corrected",
}
# Device or filter that the user must change, by group of the finding
ACTION_TARGET_BY_GROUP: Mapping[str, ActionTarget] = {
    "position source": "sender",
    "time": "sender",
    "IMU": "flight",
    "tuning": "KF",
    "EKF2": "EKF2",
    "loops": "source",
    "logging": "logging",
}
# Exceptions from ACTION_TARGET_BY_GROUP: device or filter that the user must change, by finding id
ACTION_TARGET_BY_FINDING_ID: Mapping[str, ActionTarget] = {
    "source_drift": "source",
    "source_lever_arm": "EKF2",
    "source_coordinate_constant": "EKF2",
    "source_height_constant": "EKF2",
    "ekf2_not_fusing": "sender",
}


class RankedCause(NamedTuple):
    """Finding that may be the cause of an inconsistent filter, and the re-runs that test it.

    Attributes
    ----------
    rank : int
        Importance: 0 for the most important causes, 4 for the least important causes.
    ln_sigma_ratio_reduction : float
        Decrease of |ln(actual σ ÷ reported σ)|, summed over the re-runs.
    """

    finding: Finding
    rank: int
    ln_sigma_ratio_reduction: float
    reruns: tuple[Rerun, ...]


def rank_causes(analysis: Analysis, cause_findings: Sequence[Finding]) -> list[RankedCause]:
    """Sort errors and warnings by importance; omit findings whose re-runs have no effect."""
    # a finding that only repeats that the reported σ of a filter is wrong names no cause. Such
    # findings are returned only if no finding names a cause
    causes, repeated_verdicts = list[RankedCause](), list[RankedCause]()
    for finding in cause_findings:
        if finding.severity == "note":
            continue
        reruns = find_reruns_of_finding(analysis.select_main_reruns(), finding)
        is_repeated_verdict = FINDING_CATALOGUE[finding.id].verdict == "repeated"
        if is_repeated_verdict:
            reruns = tuple(filter(may_improve_filter, reruns))
        # a fault is no cause if all re-runs could show an effect of it, but show none
        elif reruns and all(can_show_effect(rerun) and not has_effect(rerun) for rerun in reruns):
            continue
        ln_sigma_ratio_reduction = sum(map(compute_sigma_ratio_improvement, reruns))
        rank = _find_cause_rank(finding, reruns)
        ranked_cause = RankedCause(finding, rank, ln_sigma_ratio_reduction, reruns)
        (repeated_verdicts if is_repeated_verdict else causes).append(ranked_cause)
    return sorted(
        causes or repeated_verdicts,
        key=lambda cause: (
            cause.rank,
            # List faults of the source before wrong settings, because a changed setting may only
            # hide a fault of the source. Rank 4 (warnings that no re-run confirms) has no such
            # order
            cause.rank < 4 and _is_wrong_setting(cause.finding),
            -cause.ln_sigma_ratio_reduction,
        ),
    )


def _is_wrong_setting(finding: Finding) -> bool:
    rerun_kinds = FINDING_CATALOGUE[finding.id].rerun_kinds
    return bool(rerun_kinds) and rerun_kinds <= SETTING_CHANGE_KINDS


def _find_cause_rank(finding: Finding, reruns: Sequence[Rerun]) -> int:
    """Return the importance of a possible cause.

    0 faults that make all results meaningless, 1 a re-run without the fault makes a filter
    consistent, 2 a re-run halves the deviation of the reported σ, 3 other errors, 4 other warnings.
    """
    if (
        FINDING_CATALOGUE[finding.id].verdict == "meaningless"
        or WRONG_CONVENTION_KEY in finding.evidence
    ):
        return 0
    # If a filter is still overconfident against ground truth after a setting is corrected, this
    # setting is not the main cause. This applies even if the mean NIS is then consistent
    if _is_wrong_setting(finding) and any(map(remains_overconfident, reruns)):
        return 3
    if any(map(becomes_consistent, reruns)):
        return 1
    if any(map(halves_discrepancy, reruns)):
        return 2
    return 3 if finding.severity == "error" else 4


def find_reruns_of_finding(reruns: Iterable[Rerun], finding: Finding) -> tuple[Rerun, ...]:
    """Return the best re-run for each filter and each kind of change that tests a finding.

    Re-runs that make the filter consistent are preferred, see
    :func:`~px4fuse.comparison.rerun_effects.compute_preference_key`.
    """
    tested_change_kinds = FINDING_CATALOGUE[finding.id].rerun_kinds
    tested_change_kinds |= {"defaults"} if "noises" in tested_change_kinds else set()
    best_rerun_by_filter_and_kind: dict[tuple[FilterName, str], Rerun] = {}
    for rerun in reruns:
        if len(rerun.kinds) == 1 and rerun.kinds[0] in tested_change_kinds:
            key = rerun.filter, rerun.kinds[0]
            best_rerun_by_filter_and_kind[key] = min(
                rerun, best_rerun_by_filter_and_kind.get(key, rerun), key=compute_preference_key
            )
    return tuple(best_rerun_by_filter_and_kind.values())


def can_show_effect(rerun: Rerun) -> bool:
    """Return False if only ground truth could show the effect of a re-run, but is not logged."""
    has_truth = rerun.before.position_rmse_m is not None
    return (
        has_truth or CHANGE_KINDS_VISIBLE_ONLY_IN_TRUTH.isdisjoint(rerun.kinds) or has_effect(rerun)
    )


def may_improve_filter(rerun: Rerun) -> bool:
    """Return True if a re-run improves the filter, or if the log cannot show its effect."""
    return classify_improvement(rerun) != "nothing" or not can_show_effect(rerun)


def make_cause(
    analysis: Analysis,
    ranked_cause: RankedCause,
    sigma_verdicts: Sequence[Verdict],
    request: ComparisonRequest,
) -> DiagnosedCause:
    """Describe one cause of the diagnosis, with actions for position source, KF and EKF2."""
    finding, reruns = ranked_cause.finding, ranked_cause.reruns
    useful_reruns = [rerun for rerun in reruns if may_improve_filter(rerun)]
    alternative_action_groups, actions = _make_actions(
        analysis, ranked_cause, useful_reruns, sigma_verdicts, request
    )
    return structs.replace(
        make_cause_without_reruns(finding),
        alternatives=alternative_action_groups,
        actions=actions,
        reruns=tuple(map(_make_card_rerun, filter(can_show_effect, reruns))),
        after=_format_closing_sentence(
            useful_reruns, has_alternatives=bool(alternative_action_groups)
        ),
    )


def make_cause_without_reruns(finding: Finding) -> DiagnosedCause:
    """Describe the fault that a finding reports, if no re-run tests it."""
    return DiagnosedCause(
        id=finding.id,
        severity="error" if finding.severity == "error" else "warning",
        title=finding.title,
        why=finding.message.removeprefix(finding.title).lstrip(". "),
        spans_s=finding.spans_s,
        actions=(Action(_find_action_target(finding), finding.remedy),) if finding.remedy else (),
    )


def _make_actions(
    analysis: Analysis,
    ranked_cause: RankedCause,
    useful_reruns: Sequence[Rerun],
    sigma_verdicts: Sequence[Verdict],
    request: ComparisonRequest,
) -> tuple[tuple[tuple[Action, ...], ...], tuple[Action, ...]]:
    """Return the actions against a cause: alternative groups of actions, and further actions.

    The fault is corrected by all actions of one group together with the further actions. There are
    two groups if a re-run with corrected timestamps and one with another delay parameter both help:
    correct the sender, or set the delay parameter.
    """
    finding = ranked_cause.finding
    rerun_by_filter_and_kind = {(rerun.filter, rerun.kinds[0]): rerun for rerun in useful_reruns}
    delay_rerun = rerun_by_filter_and_kind.get(("ekf2", "delay"))
    offset_rerun = rerun_by_filter_and_kind.get(
        ("ekf2", "time offset")
    ) or rerun_by_filter_and_kind.get(("kf", "time offset"))
    sender_actions = _make_sender_actions(analysis, ranked_cause, offset_rerun, request)
    alternative_action_groups: tuple[tuple[Action, ...], ...] = ()
    actions: list[Action] = []
    if delay_rerun:
        # The user corrects either the timestamps or the delay parameter: two alternatives. A
        # parameter that both corrections change (EKF2_DELAY_MAX) is not part of the alternatives,
        # but a further action
        time_offset_setting_names = offset_rerun.change.keys() if offset_rerun else ()
        delay_parameter_values = {
            name: value
            for name, value in delay_rerun.change.items()
            if name not in time_offset_setting_names
        }
        delay_action = make_parameter_action(analysis, delay_parameter_values)
        if offset_rerun:
            alternative_action_groups = tuple(sender_actions), (delay_action,)
        else:
            actions.append(delay_action)
    # If only the settings are wrong, the sender needs no change
    elif offset_rerun or not (_is_wrong_setting(finding) and ranked_cause.reruns):
        actions += sender_actions
    actions += _make_setting_actions(analysis, useful_reruns, request)
    # Actions on the vehicle first, actions on KF last
    actions.sort(key=lambda action: action.target == "KF")
    action_targets = {
        action.target for group in (actions, *alternative_action_groups) for action in group
    }
    actions += _explain_missing_actions(finding, action_targets, sigma_verdicts)
    return alternative_action_groups, tuple(actions)


def _make_setting_actions(
    analysis: Analysis, reruns: Iterable[Rerun], request: ComparisonRequest
) -> Iterator[Action]:
    """Yield the changes of EKF2 parameters and KF options that the re-runs tested."""
    for rerun in reruns:
        change = dict(rerun.change)
        if rerun.kinds == ("delay",):  # _make_actions makes this action
            continue
        if rerun.filter == "ekf2":
            # Omit corrections of the data, such as a time offset: they are not EKF2 parameters. The
            # action for the sender contains them
            change = {name: value for name, value in change.items() if name in MODEL_PARAMETERS}
            if change:
                yield make_parameter_action(analysis, change)
        # Default settings of KF need no command, because the description of the cause already
        # states that KF is consistent with them. Corrections of the data without an option have no
        # command
        elif rerun.kinds != ("defaults",) and change.keys() <= COMPARISON_OPTIONS.keys():
            # --clock-offset replaces the offset from the alignment, so it must include that offset
            if TIME_OFFSET_KEY in change and (alignment := analysis.source.alignment):
                total_offset_s = change[TIME_OFFSET_KEY] + alignment.clock_offset_s
                change[TIME_OFFSET_KEY] = round(total_offset_s, 3)
            command = command_line(structs.replace(request, **change))
            yield Action("KF", "", (command,), "shell")


def _explain_missing_actions(
    finding: Finding, action_targets: Set[ActionTarget], sigma_verdicts: Sequence[Verdict]
) -> list[Action]:
    """Explain why the settings of a filter need no change."""
    actions = [
        Action(target, reason)
        for filter_name, target in TARGET_BY_ADJUSTABLE_FILTER.items()
        if target not in action_targets
        and (reason := _explain_missing_action(finding, filter_name, sigma_verdicts))
    ]
    reasons = [action.sentence for action in actions]
    if len(reasons) == 2 and reasons[0] == reasons[1]:
        return [Action("KF, EKF2", reasons[0])]
    return actions


def _make_sender_actions(
    analysis: Analysis,
    ranked_cause: RankedCause,
    offset_rerun: Rerun | None,
    request: ComparisonRequest,
) -> list[Action]:
    """Return the action against a cause, except changes of delay and noise after a re-run.

    - Time offset: shift the timestamps by the time offset of ``offset_rerun``.
    - Wrong EKF2_GPS_DELAY without re-run: set the parameter to its estimate.
    - Other faults: the action of the finding, if it has one.
    """
    finding, source, model = ranked_cause.finding, analysis.source, analysis.ekf2_model
    # The sender must shift its timestamps if a re-run with shifted timestamps improves a filter. A
    # GNSS receiver cannot shift them, so the remedy of the finding is used for GNSS
    if offset_rerun and not (source.origin.is_gnss and finding.remedy):
        shift_s = offset_rerun.change[TIME_OFFSET_KEY]
        # The shift of a KF re-run includes the offset --clock-offset, which this analysis already
        # applies. Subtract this offset: only the remaining shift is an error of the sender
        if offset_rerun.filter == "kf":
            shift_s -= analysis.settings.clock_offset_s
        return [Action("sender", lowercase_first_letter(format_sender_action(source, shift_s)))]
    # If KF uses vision, no re-run tests the delay of GNSS. Then set the delay parameter to the
    # estimate in the finding
    if (
        finding.id == "ekf2_gps_delay_wrong"
        and not ranked_cause.reruns
        and not isinstance(model, Unavailable)
    ):
        delay_change = make_delay_change(model.inputs, float(finding.evidence["estimate_ms"]))
        if delay_change:
            return [make_parameter_action(analysis, delay_change)]
    if not finding.remedy:
        return []
    remedy = with_log_name(finding.remedy, request.log)
    return [Action(_find_action_target(finding, source), remedy)]


def _explain_missing_action(
    finding: Finding, filter_name: FilterName, sigma_verdicts: Sequence[Verdict]
) -> str:
    """Return the reason why the settings of a filter need no change, or "" without any verdict."""
    # Verdict of the filter against "source" (innovations) and against "truth" (ground truth)
    verdict_by_reference = {
        verdict.against: verdict.word
        for verdict in sigma_verdicts
        if verdict.filter == filter_name and verdict.ratio is not None
    }
    if not verdict_by_reference:
        return ""
    if set(verdict_by_reference.values()) == {"consistent"}:
        needs_ground_truth = (
            FINDING_CATALOGUE[finding.id].rerun_kinds & CHANGE_KINDS_VISIBLE_ONLY_IN_TRUTH
        )
        if needs_ground_truth and "truth" not in verdict_by_reference:
            return "keep the settings: only ground truth shows this fault, but the log has none"
        return "keep the settings: the reported σ is consistent"
    if finding.id == "source_outliers":
        if filter_name == "kf":
            return (
                "no option makes KF reject outliers; a larger SIGMA_Z (--sigma-z) only reduces the "
                "mean NIS"
            )
        if verdict_by_reference.get("truth", "consistent") == "consistent":
            return (
                "keep the settings: EKF2's gate rejects these outliers, and EKF2's σ is consistent"
            )
    return "no filter setting corrects this fault"


def _find_action_target(finding: Finding, source: PositionTrack | None = None) -> ActionTarget:
    """Return the device or filter to which the remedy of a finding applies."""
    group = FINDING_CATALOGUE[finding.id].group
    target = ACTION_TARGET_BY_FINDING_ID.get(finding.id) or ACTION_TARGET_BY_GROUP[group]
    # The remedy of a finding about the position source is normally for the sender. If the remedy
    # names an EKF2 parameter, it is for EKF2
    is_remedy_about_ekf2_parameter = finding.remedy.startswith(("Set EKF2_", "Check EKF2_"))
    # Errors above the reported σ are one finding for both filters. If its evidence contains no σ of
    # KF, only EKF2 is overconfident
    is_only_ekf2_overconfident = (
        finding.id == "error_exceeds_reported_sigma"
        and finding.evidence.get("filter") == "ekf2"
        and "kf_sigma_p_m" not in finding.evidence
    )
    if (target == "sender" and is_remedy_about_ekf2_parameter) or is_only_ekf2_overconfident:
        target = "EKF2"
    is_gnss_receiver = target == "sender" and source is not None and source.origin.is_gnss
    return "receiver" if is_gnss_receiver else target


def make_parameter_action(analysis: Analysis, change: Mapping[str, float]) -> Action:
    """Return an action with the MAVLink console commands that change EKF2 parameters."""
    model = analysis.ekf2_model
    logged_parameters = {} if isinstance(model, Unavailable) else model.inputs.settings
    change_texts, commands = [], []
    change = select_changed_settings(change, logged_parameters)
    for name, value in change.items():
        change_text = f"{name} {logged_parameters.get(name, math.nan):g} → {value:g}"
        change_texts.append(f"{change_text} {MODEL_PARAMETERS[name].printed_unit}".rstrip())
        commands.append(f"param set {name} {value:g}")
    commands += ["reboot"] * any(name.endswith(REBOOT_PARAMETER_SUFFIXES) for name in change)
    return Action("EKF2", ", ".join(change_texts), tuple(commands), "console")


def _make_card_rerun(rerun: Rerun) -> CardRerun:
    before, after = rerun.before, rerun.after
    ratios_by_reference = {
        reference: (ratio_before, ratio_after)
        for reference, ratio_before, ratio_after in compare_sigma_ratios(rerun)
    }
    rejected_fractions = _pair_known(before.rejected_fraction, after.rejected_fraction)
    if rejected_fractions and max(rejected_fractions) < MIN_REJECTED_FRACTION_TO_SHOW:
        rejected_fractions = None
    return CardRerun(
        label=_format_rerun_label(rerun),
        is_prediction=rerun.filter == "ekf2",
        from_s=rerun.from_s,
        position_rmse_m=_pair_known(before.position_rmse_m, after.position_rmse_m),
        source_ratio=ratios_by_reference.get("source"),
        truth_ratio=ratios_by_reference.get("truth"),
        rejected_fraction=rejected_fractions,
        improves=classify_improvement(rerun),
    )


def _pair_known(before: float | None, after: float | None) -> tuple[float, float] | None:
    """Return a statistic before and after a change, or None if one value is unknown."""
    return None if before is None or after is None else (before, after)


def _format_rerun_label(rerun: Rerun) -> str:
    """Return filter and change of a re-run, for example "EKF2 (replay), EKF2_EV_DELAY 100"."""
    (kind,) = rerun.kinds
    label = TARGET_BY_ADJUSTABLE_FILTER[rerun.filter] + " (replay)" * (rerun.filter == "ekf2")
    if OUTLIERS_KEY in rerun.change:
        return f"{label} without {rerun.change[OUTLIERS_KEY]:.0f} outliers"
    if kind in CORRECTION_TEXTS:
        return f"{label}, {CORRECTION_TEXTS[kind]}"
    prefix = "default " if kind == "defaults" else ""
    change_texts = [
        f"{prefix}{COMPARISON_OPTIONS.get(name, name)} {value:g}"
        for name, value in rerun.change.items()
        if name in {*MODEL_PARAMETERS, SIGMA_A_KEY, SIGMA_Z_KEY}
    ]
    return ", ".join([label, *change_texts])


def _format_closing_sentence(useful_reruns: Sequence[Rerun], *, has_alternatives: bool) -> str:
    """Return the last sentence about a cause: a remark on its actions or re-runs, or ""."""
    if has_alternatives:
        return (
            "For the next flights, correct either the sender or the delay parameter, not both. "
            "--clock-offset corrects only this analysis."
        )
    if any(rerun.kinds == ("defaults",) for rerun in useful_reruns):
        return "KF is consistent both with default and with estimated noise settings."
    sigma_ratios_against_truth = [
        math.sqrt(rerun.after.nees_mean) for rerun in useful_reruns if rerun.after.nees_mean
    ]
    if (
        sigma_ratios_against_truth
        and classify_sigma_ratio(min(sigma_ratios_against_truth), "truth") == "overconfident"
    ):
        return (
            "Even in the best re-run, the reported σ is too small against ground truth: another "
            "error remains."
        )
    return ""
