"""Order of the findings, and grouping of consequences behind their cause.

A report then has one finding per fault to correct; its consequences keep their evidence.
"""

from collections.abc import Iterable

from msgspec.structs import replace

from px4fuse.findings.model import SEVERITIES, TITLES, Finding, by_root
from px4fuse.record import table

# Key in the evidence of a finding about a variance: kind of the cause, by the re-runs
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
# Key in the evidence of time-correlated noise: its white part over the σ that a filter assumes. It
# is set if the ratio is large: the assumed noise is then wrong in addition
WHITE_RATIO = "white_over_assumed"
# Kinds of cause of an aid's finding: the sensor of the position source, or a shift in flight
SENSOR, CHANGE = "the source's sensor", "change"

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
    """Sort findings in the order of correction, consequences behind their cause.

    By severity, then in the order of :data:`TITLES`; findings about the recording come before
    errors of noises. A cause is at least as severe as its consequences.
    """
    places = list(TITLES)
    groups = sorted(by_root(findings), key=lambda group: places.index(group[0].id))
    for cause, listed in CONSEQUENCES.items():
        cause_group = next((group for group in groups if group[0].id == cause), None)
        if cause_group is None or WHITE_RATIO in cause_group[0].evidence:
            continue
        effect_groups = [
            group for group in groups if group is not cause_group and _is_effect(group[0], listed)
        ]
        groups = [group for group in groups if group not in effect_groups]
        for first, *rest in effect_groups:
            cause_group += [replace(first, caused_by=cause), *rest]
        # the severity of a KF variance follows from the setting that causes it
        severities = (
            first.severity for first, *_ in effect_groups if first.id not in _KF_VARIANCES
        )
        severity = min((cause_group[0].severity, *severities), key=SEVERITIES.index)
        cause_group[0] = replace(cause_group[0], severity=severity)
    return tuple(finding for group in sorted(groups, key=_report_rank) for finding in group)


def _is_effect(finding: Finding, listed: tuple[str, ...]) -> bool:
    return finding.id in listed or f"{finding.id}:{finding.evidence.get(CAUSE)}" in listed


def _report_rank(group: list[Finding]) -> int:
    """Sort key of a group in a report: severity, recording before noises."""
    error, warning = 2 if group[0].id in NOISES else 0, 1 if group[0].id in RECORDING else 3
    return {"error": error, "warning": warning, "note": 4}[group[0].severity]
