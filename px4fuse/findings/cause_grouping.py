"""Order of the findings, and grouping of each cause with its consequences.

A report thus lists one finding per fault to correct, and the consequences below it.
"""

from collections.abc import Iterable

from msgspec.structs import replace

from px4fuse.findings.model import SEVERITIES, TITLES, Finding, group_by_root
from px4fuse.record import table

# Evidence key of findings about a variance: kind of the cause that the re-runs show
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
# Evidence key of time-correlated noise: ratio of the white part to the σ that a filter assumes. The
# key is present only if the ratio is large, so that the assumed noise is wrong in addition
WHITE_RATIO = "white_over_assumed"
# Kinds of cause of findings about an aid: the sensor of the position source, or a shift in flight
SENSOR, CHANGE = "the source's sensor", "change"
# Kind of cause of little motion
GROUND = "never took off"

_KF_VARIANCES = frozenset({"kf_underconfident", "kf_overconfident"})
SETTINGS = frozenset(
    {"sigma_a_too_large", "sigma_a_too_small", "sigma_z_too_large", "sigma_z_too_small"}
)
VARIANCES = _KF_VARIANCES | {"ekf2_underconfident", "ekf2_overconfident"}
NOISES = SETTINGS | VARIANCES | {"process_noise_near_zero"}
CONSEQUENCES = table(__file__, "consequences.toml", dict[str, tuple[str, ...]])
# Findings about the recording: listed before those about noises, which depend on the recording
RECORDING = frozenset(
    {
        "autopilot_restarted",
        "imu_gap",
        "imu_samples_missing",
        "acceleration_not_logged",
        "log_damaged",
        "logger_dropouts",
        "imu_rate_too_low",
        "source_rate_limited_by_logger",
        "source_gap",
        "source_not_logged",
        "source_samples_lost",
        "too_few_innovations",
    }
)


def group_by_cause(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Sort findings in the order of correction, each cause followed by its consequences.

    The order follows severity, then :data:`TITLES`; findings about the recording precede
    errors of noises. A cause is at least as severe as its consequences.
    """
    ids = list(TITLES)
    groups = sorted(group_by_root(findings), key=lambda group: ids.index(group[0].id))
    for cause, effect_ids in CONSEQUENCES.items():
        cause_group = next((group for group in groups if group[0].id == cause), None)
        if cause_group is None or WHITE_RATIO in cause_group[0].evidence:
            continue
        effect_groups = [
            group
            for group in groups
            if group is not cause_group and _is_effect(group[0], effect_ids)
        ]
        groups = [group for group in groups if group not in effect_groups]
        for effect, *further_effects in effect_groups:
            cause_group += [replace(effect, caused_by=cause), *further_effects]
        # the severity of a KF variance follows from the setting that causes it
        severities = (
            effect.severity for effect, *_ in effect_groups if effect.id not in _KF_VARIANCES
        )
        severity = min((cause_group[0].severity, *severities), key=SEVERITIES.index)
        cause_group[0] = replace(cause_group[0], severity=severity)
    return tuple(finding for group in sorted(groups, key=_report_rank) for finding in group)


def _is_effect(finding: Finding, effect_ids: tuple[str, ...]) -> bool:
    return finding.id in effect_ids or f"{finding.id}:{finding.evidence.get(CAUSE)}" in effect_ids


def _report_rank(group: list[Finding]) -> int:
    """Return the sort key of a group: severity, with the recording before noises."""
    error_rank, warning_rank = (
        2 if group[0].id in NOISES else 0,
        1 if group[0].id in RECORDING else 3,
    )
    return {"error": error_rank, "warning": warning_rank, "note": 4}[group[0].severity]
