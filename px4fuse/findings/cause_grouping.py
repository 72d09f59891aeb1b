"""Order of the findings in a report: each cause is followed by the findings that it explains."""

from collections.abc import Iterable, Mapping

from msgspec.structs import replace

from px4fuse.core.record import table
from px4fuse.finding import SEVERITIES, Finding
from px4fuse.findings.model import TITLES, group_by_root

# Key in Finding.evidence whose value is the kind of cause that re-runs of a filter have shown
CAUSE = "cause"
NOISE, PROCESS, OUTLIERS, CLOCK, FRAME, GATE, ACCELEROMETER, ELSEWHERE = (
    "measurement noise",
    "process noise",
    "outliers",
    "clock",
    "frame",
    "gate",
    "accelerometer",
    "elsewhere",
)
# Key in Finding.evidence: ratio of the source's white noise to the measurement noise that a filter
# assumes. Only a large ratio is stored; the assumed noise is then a separate fault
WHITE_RATIO = "white_over_assumed"
# Values of CAUSE in a finding about an aiding source: it belongs to the same sensor as the
# positions of KF, or its mean innovation changes in flight
SENSOR, CHANGE = "the source's sensor", "change"
# Value of CAUSE in the finding ekf2_resets if each position reset follows a gap in the source
GAP = "gap"
# Key in Finding.evidence of findings about axes, unit, clock or orientation of the source, which
# precede all other findings
CONVENTION = "convention"
# Findings that are listed before all others: they make all estimates from the IMU or the positions
# invalid
UNUSABLE = (
    "imu_values_impossible",
    "gyroscope_bias",
    "ekf2_bias_at_limit",
    "source_is_ekf2_estimate",
    "source_two_senders",
    "source_positions_rounded",
    "source_lever_arm",
    "source_height_only",
    "source_relocalises",
    "source_timestamps_shared",
)
# Key in Finding.evidence of the time (s) at which the source announced a jump by its reset_counter
ANNOUNCED = "reset_at_s"
WITHOUT = "source_without_position"
MISLEADING = ("source_timestamp_unit", "source_position_held", "source_zero_positions")
# Causes that explain other findings only if they are no notes
CORRECTED_FIRST = ("ekf2_not_aligned", "parameter_changed")
# Effects whose action corrects their cause, too, so that either action is enough
ALTERNATIVE_FIXES = ("ekf2_ev_delay_wrong",)
# Kind of cause of no_motion: the vehicle stayed on the ground
GROUND = "never took off"

_KF_VARIANCES = ("kf_underconfident", "kf_overconfident")
NOISES = frozenset(
    (
        *_KF_VARIANCES,
        "ekf2_underconfident",
        "ekf2_overconfident",
        "sigma_a_too_large",
        "sigma_a_too_small",
        "sigma_z_too_large",
        "sigma_z_too_small",
        "process_noise_near_zero",
    )
)
# Effects of a finding, by its id; one effect per line: "id", or "id: value of CAUSE"
CONSEQUENCES: Mapping[str, str] = table(__file__, "consequences.toml", dict[str, str])
RECORDING = frozenset(
    {
        "autopilot_restarted",
        "imu_gap",
        "imu_samples_missing",
        "acceleration_not_logged",
        "log_damaged",
        "logger_dropouts",
        "imu_rate_too_low",
        "source_begins",
        "source_gap",
        "source_gap_in_log",
        "source_not_logged",
        "source_samples_lost",
        "source_stops",
        "too_few_innovations",
    }
)


def group_by_cause(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Sort findings in the order of correction: each cause is followed by its effects.

    Findings are sorted by severity, then in the order of :data:`TITLES`. A cause is at least as
    severe as the findings that it explains.
    """
    ids = list(TITLES)
    groups = sorted(group_by_root(findings), key=lambda group: ids.index(group[0].id))
    for cause, effects in CONSEQUENCES.items():
        cause_group = next((group for group in groups if group[0].id == cause), None)
        if cause_group is None or (cause_group[0].severity == "note" and cause in CORRECTED_FIRST):
            continue
        if WHITE_RATIO in cause_group[0].evidence:
            continue
        effect_groups = [
            group
            for group in groups
            if group is not cause_group
            and not {group[0].id, f"{group[0].id}: {group[0].evidence.get(CAUSE)}"}.isdisjoint(
                effects.splitlines()
            )
        ]
        groups = [group for group in groups if group not in effect_groups]
        for effect, *further_effects in effect_groups:
            cause_group += [replace(effect, caused_by=cause), *further_effects]
        # kf_underconfident and kf_overconfident do not increase the severity of their cause
        severities = (
            effect.severity for effect, *_ in effect_groups if effect.id not in _KF_VARIANCES
        )
        severity = min((cause_group[0].severity, *severities), key=SEVERITIES.index)
        cause_group[0] = replace(cause_group[0], severity=severity)
    return tuple(
        _with_action_of(group[0], finding)
        for group in sorted(groups, key=_report_rank)
        for finding in group
    )


def _with_action_of(cause: Finding, finding: Finding) -> Finding:
    """Replace the action of an effect, which would hide its cause, by the action of the cause.

    For example a larger measurement noise hides outliers.
    """
    if finding.caused_by is None or cause.severity == "note" or finding.id in ALTERNATIVE_FIXES:
        return finding
    return replace(finding, remedy=cause.remedy)


def effect_ids(cause: str) -> tuple[str, ...]:
    """Return the ids of the findings that one finding can cause, without duplicates."""
    effects = CONSEQUENCES.get(cause, "").splitlines()
    return tuple(dict.fromkeys(effect.partition(":")[0] for effect in effects))


def _report_rank(group: list[Finding]) -> int:
    # gaps in the recording falsify noise estimates: warnings in RECORDING precede errors in NOISES
    cause = group[0]
    is_first = CONVENTION in cause.evidence or cause.id in (
        *UNUSABLE,
        *MISLEADING,
        WITHOUT,
        "ekf2_not_aligned",
    )
    if is_first and cause.severity != "note":
        return -1
    ranks = {"error": 2 * (cause.id in NOISES), "warning": 3 - 2 * (cause.id in RECORDING)}
    return ranks.get(cause.severity, 4)
