"""Order of the findings in a report: each cause is followed by its effects."""

from collections.abc import Iterable, Mapping

from msgspec.structs import replace

from px4fuse.core.record import read_toml
from px4fuse.finding import SEVERITIES, Finding
from px4fuse.findings.model import CATALOGUE, split_cause_groups

# Key in Finding.evidence for the cause. Its values are the constants ..._CAUSE: settings or sensor
# faults that a re-run corrects, and causes that the detectors of findings distinguish
CAUSE_KEY = "cause"
NOISE_CAUSE = "measurement noise"
PROCESS_NOISE_CAUSE = "process noise"
OUTLIER_CAUSE = "outliers"
CLOCK_CAUSE = "clock"
FRAME_CAUSE = "frame"
GATE_CAUSE = "gate"
ACCELEROMETER_CAUSE = "accelerometer"
OTHER_CAUSE = "elsewhere"
# Key in Finding.evidence: white position noise ÷ assumed measurement noise, only if this is large
WHITE_NOISE_RATIO_KEY = "white_over_assumed"
# Cause of a fault of an aiding source: it belongs to the sensor whose positions KF uses
SOURCE_SENSOR_CAUSE = "the source's sensor"
# Cause: the variance that the source reports is wrong, and EKF2 uses it as measurement noise
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
# Findings that are causes of other findings only if their severity is warning or error
CAUSES_ONLY_ABOVE_NOTE = ("ekf2_not_aligned", "parameter_changed")
# Findings that keep their action if they are effects of another finding: the action corrects both
EFFECTS_KEEPING_ACTION = ("ekf2_ev_delay_wrong",)

_KF_FINDINGS = ("kf_underconfident", "kf_overconfident")
# Effects of each finding: ids of other findings, one per line
CONSEQUENCES: Mapping[str, str] = read_toml(__file__, dict[str, str], "consequences.toml")


def group_by_cause(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Sort findings by severity; each cause is followed by its effects."""
    ids = list(CATALOGUE)
    groups = sorted(split_cause_groups(findings), key=lambda group: ids.index(group[0].id))
    for cause, effects in CONSEQUENCES.items():
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
        _with_action_of(group[0], finding)
        for group in sorted(groups, key=_find_report_rank)
        for finding in group
    )


def _with_action_of(cause: Finding, finding: Finding) -> Finding:
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
    effects = CONSEQUENCES.get(cause, "").splitlines()
    return tuple(dict.fromkeys(effect.partition(":")[0] for effect in effects))


def _find_report_rank(group: list[Finding]) -> int:
    cause = group[0]
    role = CATALOGUE[cause.id].role
    is_first = CONVENTION_KEY in cause.evidence or role in ("unusable", "misleading", "first")
    if is_first and cause.severity != "note":
        return -1
    # Warnings on the recording (1) precede noise errors (2), because bad data bias noise estimates
    rank_by_severity = {"error": 2 * (role == "noise"), "warning": 3 - 2 * (role == "recording")}
    return rank_by_severity.get(cause.severity, 4)
