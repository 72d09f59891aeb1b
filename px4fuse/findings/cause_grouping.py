"""Order of the findings in a report: each cause is followed by its effects."""

from collections.abc import Iterable, Mapping

from msgspec.structs import replace

from px4fuse.core.record import read_toml
from px4fuse.finding import SEVERITIES, Finding
from px4fuse.findings.model import FINDING_CATALOGUE, split_cause_groups

# Key in Finding.evidence: cause of the finding, one of the constants ..._CAUSE. Re-runs show the
# causes up to ACCELEROMETER_CAUSE, detectors show the causes after UNKNOWN_CAUSE
CAUSE_KEY = "cause"
MEASUREMENT_NOISE_CAUSE = "measurement noise"
PROCESS_NOISE_CAUSE = "process noise"
OUTLIER_CAUSE = "outliers"
CLOCK_CAUSE = "clock"
FRAME_CAUSE = "frame"
GATE_CAUSE = "gate"
ACCELEROMETER_CAUSE = "accelerometer"
UNKNOWN_CAUSE = "elsewhere"
# Key in Finding.evidence: σ of white position noise ÷ assumed measurement noise, if this is large
WHITE_NOISE_RATIO_KEY = "white_over_assumed"
# Cause of a fault of an EKF2 aiding source from the sensor whose positions KF uses
SOURCE_SENSOR_CAUSE = "the source's sensor"
# Cause: EKF2 uses a wrong variance, which the source reports, as measurement noise
REPORTED_VARIANCE_CAUSE = "EKF2's noise"
# Cause: the mean innovation of the aiding source changes in flight
INNOVATION_SHIFT_CAUSE = "change"
# Cause of resets: each position reset of EKF2 follows a gap in the position source
GAP_CAUSE = "gap"
# Cause of missing motion: the vehicle stayed on the ground
NO_TAKE_OFF_CAUSE = "never took off"
# Key in Finding.evidence: property that the source sends wrongly (axes, unit, clock, orientation)
CONVENTION_KEY = "convention"
# Key in Finding.evidence: time (s) of a position jump that the source announces by reset_counter
RESET_TIME_KEY = "reset_at_s"
# As a note, these findings are independent; as a warning or error, they cause other findings
CAUSES_ONLY_ABOVE_NOTE = ("ekf2_not_aligned", "parameter_changed")
# An effect has the action of its cause. These effects keep their action: it also corrects the cause
EFFECTS_KEEPING_ACTION = ("ekf2_ev_delay_wrong",)

_KF_FINDINGS = ("kf_underconfident", "kf_overconfident")
# Ids of the findings that a finding causes, one per line, by id of the cause
EFFECTS_BY_CAUSE: Mapping[str, str] = read_toml(__file__, dict[str, str], "consequences.toml")


def group_by_cause(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Sort findings by severity; each cause is followed by its effects."""
    ids = list(FINDING_CATALOGUE)
    groups = sorted(split_cause_groups(findings), key=lambda group: ids.index(group[0].id))
    for cause, effects in EFFECTS_BY_CAUSE.items():
        cause_group = next((group for group in groups if group[0].id == cause), None)
        if (
            cause_group is None
            or (cause_group[0].severity == "note" and cause in CAUSES_ONLY_ABOVE_NOTE)
            or WHITE_NOISE_RATIO_KEY in cause_group[0].evidence
        ):
            continue
        effect_groups = [
            group
            for group in groups
            if group is not cause_group
            and not {group[0].id, f"{group[0].id}: {group[0].evidence.get(CAUSE_KEY)}"}.isdisjoint(
                effects.splitlines()
            )
        ]
        groups = [group for group in groups if group not in effect_groups]
        for effect, *further_effects in effect_groups:
            cause_group += [replace(effect, caused_by=cause), *further_effects]
        severities = (
            effect.severity for effect, *_ in effect_groups if effect.id not in _KF_FINDINGS
        )
        severity = min((cause_group[0].severity, *severities), key=SEVERITIES.index)
        cause_group[0] = replace(cause_group[0], severity=severity)
    return tuple(
        _replace_effect_action(group[0], finding)
        for group in sorted(groups, key=_find_report_rank)
        for finding in group
    )


def _replace_effect_action(cause: Finding, finding: Finding) -> Finding:
    """Replace the action of an effect by the action of its cause.

    The action of an effect may be wrong. Example: a larger noise setting, which hides outliers.
    """
    if (
        finding.caused_by is None
        or cause.severity == "note"
        or finding.id in EFFECTS_KEEPING_ACTION
    ):
        return finding
    return replace(finding, remedy=cause.remedy)


def effect_ids(cause: str) -> tuple[str, ...]:
    effects = EFFECTS_BY_CAUSE.get(cause, "").splitlines()
    return tuple(dict.fromkeys(effect.partition(":")[0] for effect in effects))


def _find_report_rank(group: list[Finding]) -> int:
    cause = group[0]
    role = FINDING_CATALOGUE[cause.id].role
    is_first = CONVENTION_KEY in cause.evidence or role in ("unusable", "misleading", "first")
    if is_first and cause.severity != "note":
        return -1
    # Ranks: recording warnings (1) precede noise errors (2), because bad recordings bias noise
    # estimates
    rank_by_severity = {"error": 2 * (role == "noise"), "warning": 3 - 2 * (role == "recording")}
    return rank_by_severity.get(cause.severity, 4)
