"""Which findings have one cause, and in which order they are told.

What a cause brings with it stands behind it, with its evidence, so that a report has one finding
per thing to put right.
"""

from collections.abc import Iterable

from msgspec.structs import replace

from px4fuse.findings.model import NAMES, SEVERITIES, Finding, by_root
from px4fuse.record import table

# In the evidence of a finding about a variance: what the detector holds it to be the effect of
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
# In the evidence of a slow error: how many times what a filter assumes of the noise its white part
# is; where it is beyond that, the noise is wrong by itself
WHITE_BEYOND = "white_over_assumed"
# Likewise of an aid: it is of the sensor that the positions are of, or changed in flight
SENSOR, CHANGE = "the source's sensor", "change"

_KF_VARIANCES = frozenset({"kf_variance_overstated", "kf_variance_understated"})
SETTINGS = frozenset({"sigma_a_large", "sigma_a_small", "sigma_z_large", "sigma_z_small"})
VARIANCES = _KF_VARIANCES | {"ekf2_variance_overstated", "ekf2_variance_understated"}
NOISES = SETTINGS | VARIANCES | {"process_noise_forgotten"}
CONSEQUENCES = table(__file__, "consequences.toml", dict[str, tuple[str, ...]])
# What the recording lacks: put right first, since noises are judged by what was recorded
RECORDING = frozenset(
    {
        "autopilot_restarted",
        "imu_gap",
        "input_unavailable",
        "log_damaged",
        "logger_dropouts",
        "logging_rate_low",
        "source_decimated",
        "source_gap",
        "source_not_logged",
        "source_samples_lost",
        "too_few_innovations",
    }
)


def group_by_cause(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Findings in the order in which to put them right, each behind what it follows from.

    By severity and then in the order of :data:`NAMES`, except that what the recording lacks comes
    before errors of noises. A cause is as severe as what it brings with it.
    """
    places = list(NAMES)
    groups = sorted(by_root(findings), key=lambda group: places.index(group[0].id))
    for cause, listed in CONSEQUENCES.items():
        cause_group = next((group for group in groups if group[0].id == cause), None)
        if cause_group is None or WHITE_BEYOND in cause_group[0].evidence:
            continue
        effect_groups = [
            group for group in groups if group is not cause_group and _is_effect(group[0], listed)
        ]
        groups = [group for group in groups if group not in effect_groups]
        for first, *rest in effect_groups:
            cause_group += [replace(first, caused_by=cause), *rest]
        # the variance of our filter is judged by the setting that it follows from
        severities = (
            first.severity for first, *_ in effect_groups if first.id not in _KF_VARIANCES
        )
        severity = min((cause_group[0].severity, *severities), key=SEVERITIES.index)
        cause_group[0] = replace(cause_group[0], severity=severity)
    return tuple(finding for group in sorted(groups, key=_report_rank) for finding in group)


def _is_effect(finding: Finding, listed: tuple[str, ...]) -> bool:
    return finding.id in listed or f"{finding.id}:{finding.evidence.get(CAUSE)}" in listed


def _report_rank(group: list[Finding]) -> int:
    """Place in a report."""
    error, warning = 2 if group[0].id in NOISES else 0, 1 if group[0].id in RECORDING else 3
    return {"error": error, "warning": warning, "info": 4}[group[0].severity]
