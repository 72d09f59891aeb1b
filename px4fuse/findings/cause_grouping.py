"""Order of the findings in a report: each cause is followed by its effects."""

from collections.abc import Iterable, Mapping

from msgspec.structs import replace

from px4fuse.core.record import read_toml
from px4fuse.finding import SEVERITIES, Finding
from px4fuse.findings.model import FINDING_CATALOGUE, split_cause_groups

# Key of the cause in Finding.evidence
CAUSE_KEY = "cause"
# Causes that a re-run of a filter confirms
MEASUREMENT_NOISE_CAUSE = "measurement noise"
PROCESS_NOISE_CAUSE = "process noise"
OUTLIER_CAUSE = "outliers"
CLOCK_CAUSE = "clock"
MISALIGNED_FRAME_CAUSE = "frame"
WRONG_GATE_CAUSE = "gate"
ACCELEROMETER_CAUSE = "accelerometer"
# No tested change of a setting corrects the filter
UNKNOWN_CAUSE = "elsewhere"
# Key in Finding.evidence: σ of the white position noise ÷ assumed measurement noise
WHITE_TO_ASSUMED_NOISE_RATIO_KEY = "white_over_assumed"
# The sensor of the aiding source also gives KF's positions
SOURCE_SENSOR_CAUSE = "the source's sensor"
# EKF2 uses a wrong variance that the source reports
REPORTED_VARIANCE_USED_BY_EKF2_CAUSE = "EKF2's noise"
# The mean innovation of the aiding source changes in flight
INNOVATION_CHANGE_CAUSE = "change"
# EKF2's position resets follow gaps in the position source
SOURCE_GAP_CAUSE = "gap"
# The vehicle stayed on the ground
VEHICLE_ON_GROUND_CAUSE = "never took off"
# Key in Finding.evidence: property with a wrong convention ("axes", "unit", "time offset", ...)
WRONG_CONVENTION_KEY = "convention"
# Key in Finding.evidence: time (s) of a position jump with a change of reset_counter
RESET_TIME_KEY = "reset_at_s"
# These findings cause other findings only as warning or error
CAUSES_UNLESS_NOTE = ("ekf2_not_aligned", "parameter_changed")
# Effects that keep their own action, because it also corrects the cause
EFFECTS_WITH_OWN_ACTION = ("ekf2_ev_delay_wrong",)

_KF_FINDINGS = ("kf_underconfident", "kf_overconfident")
# Ids of the effects of each cause
EFFECTS_BY_CAUSE: Mapping[str, str] = read_toml(__file__, dict[str, str], "consequences.toml")


def group_by_cause(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Sort findings by severity; each cause is followed by its effects."""
    ids = list(FINDING_CATALOGUE)
    groups = sorted(split_cause_groups(findings), key=lambda group: ids.index(group[0].id))
    for cause, effects_text in EFFECTS_BY_CAUSE.items():
        cause_group = next((group for group in groups if group[0].id == cause), None)
        if (
            cause_group is None
            or (cause_group[0].severity == "note" and cause in CAUSES_UNLESS_NOTE)
            or WHITE_TO_ASSUMED_NOISE_RATIO_KEY in cause_group[0].evidence
        ):
            continue
        effects, severity = effects_text.splitlines(), cause_group[0].severity
        for group in [group for group in groups if group is not cause_group]:
            effect = group[0]
            if effect.id in effects or f"{effect.id}: {effect.evidence.get(CAUSE_KEY)}" in effects:
                groups.remove(group)
                cause_group += [replace(effect, caused_by=cause), *group[1:]]
                if effect.id not in _KF_FINDINGS:
                    severity = min(severity, effect.severity, key=SEVERITIES.index)
        cause_group[0] = replace(cause_group[0], severity=severity)
    findings = list[Finding]()
    for cause_finding, *effect_findings in sorted(groups, key=_compute_report_rank):
        findings.append(cause_finding)
        for effect in effect_findings:
            # The action of an effect may be wrong: a larger noise setting only hides outliers
            keeps_action = cause_finding.severity == "note" or effect.id in EFFECTS_WITH_OWN_ACTION
            remedy = effect.remedy if keeps_action else cause_finding.remedy
            findings.append(replace(effect, remedy=remedy))
    return tuple(findings)


def find_effect_ids(cause: str) -> tuple[str, ...]:
    """Return the ids of the findings that a finding can cause."""
    effects = EFFECTS_BY_CAUSE.get(cause, "").splitlines()
    return tuple(dict.fromkeys(effect.partition(":")[0] for effect in effects))


def _compute_report_rank(group: list[Finding]) -> int:
    cause = group[0]
    report_class = FINDING_CATALOGUE[cause.id].report_class
    if cause.severity == "note":
        return 4
    if WRONG_CONVENTION_KEY in cause.evidence or report_class in (
        "unusable",
        "misleading",
        "first",
    ):
        return -1
    # A bad recording makes the noise estimates wrong, so its warnings precede noise errors
    if cause.severity == "error":
        return 2 if report_class == "noise" else 0
    return 1 if report_class == "recording" else 3
