"""Which findings have one cause, and in which order causes are told.

What a cause brings with it is told inside it, with its evidence, so that a report has one finding
per thing to put right. The table is read from above: a finding goes to the first cause that is
there.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from msgspec.structs import replace

from px4fuse.findings.model import SEVERITIES, Finding

# In the evidence of a finding about a variance: what the detector holds it to be the effect of
CAUSE = "cause"
NOISE, OUTLIERS, ELSEWHERE = "measurement noise", "outliers", "elsewhere"

_OVERSTATED = ("kf_variance_overstated", "ekf2_variance_overstated")
# Cause to what it brings with it, read from above: what brings others with it stands before what
# brings it; "id:cause" only where the evidence names that cause
CONSEQUENCES: Mapping[str, tuple[str, ...]] = {
    "source_stamps_constant": ("source_receipt_jitter",),
    "sigma_a_small": ("kf_variance_understated",),
    "process_noise_forgotten": ("sigma_a_small", "kf_variance_understated"),
    "sigma_z_small": ("kf_variance_understated",),
    "sigma_a_large": ("kf_variance_overstated",),
    "sigma_z_large": ("kf_variance_overstated",),
    # the gate is as wide as S says
    "ekf2_variance_understated": ("ekf2_rejecting",),
    "source_outliers": (
        f"kf_variance_understated:{OUTLIERS}",
        f"ekf2_variance_understated:{OUTLIERS}",
        "ekf2_rejecting",
    ),
    "errors_larger_than_claimed": _OVERSTATED,
    "source_may_drift": _OVERSTATED,
    "ekf2_ev_delay_wrong": ("errors_larger_than_claimed",),
    "source_smoothed": (
        "sigma_z_large",
        "sigma_z_small",
        "sigma_a_large",
        "sigma_a_small",
        *_OVERSTATED,
        "kf_variance_understated",
        "ekf2_variance_understated",
        "errors_larger_than_claimed",
    ),
    "source_jumps": ("errors_larger_than_claimed",),
    "source_scale_wrong": ("errors_larger_than_claimed",),
    "accelerometer_bias": ("errors_larger_than_claimed",),
    # a step of the stamps moves positions of a vehicle that moves
    "source_clock_changes": (
        "source_jumps",
        "ekf2_ev_delay_wrong",
        "errors_larger_than_claimed",
    ),
    "source_stamps_of_arrival": ("source_clock_changes",),
    "source_clock_offset": (
        "source_stamps_of_arrival",
        "ekf2_ev_delay_wrong",
        "errors_larger_than_claimed",
        f"kf_variance_understated:{ELSEWHERE}",
        f"ekf2_variance_understated:{ELSEWHERE}",
    ),
    "source_frame_turned": ("errors_larger_than_claimed",),
    "source_not_logged": ("source_decimated",),
    "source_gap": ("ekf2_fusion_interrupted",),
    "logger_dropouts": ("imu_gap",),
}
# What the recording lacks: put right first, since noises are judged by what was recorded
RECORDING = frozenset(
    {
        "autopilot_restarted", "imu_gap", "input_unavailable", "log_damaged", "logger_dropouts",
        "logging_rate_low", "source_decimated", "source_gap", "source_not_logged",
        "source_samples_lost", "too_few_innovations",
    }
)  # fmt: skip
NOISES = frozenset(
    {
        "kf_variance_overstated", "kf_variance_understated", "ekf2_variance_overstated",
        "ekf2_variance_understated", "process_noise_forgotten", "sigma_a_large", "sigma_a_small",
        "sigma_z_large", "sigma_z_small",
    }
)  # fmt: skip
# Judged by the setting that it follows from, whatever its own size
_JUDGED_BY_CAUSE = frozenset({"kf_variance_overstated", "kf_variance_understated"})


def by_cause(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """One finding per cause, in the order in which to put them right.

    By severity and then in the given order, except that what the recording lacks comes before
    errors of noises.
    """
    return tuple(sorted(_joined(list(findings)), key=_rank))


def _joined(findings: list[Finding]) -> list[Finding]:
    for cause, listed in CONSEQUENCES.items():
        at = next((i for i, finding in enumerate(findings) if finding.id == cause), None)
        if at is None:
            continue
        taken = [i for i, finding in enumerate(findings) if i != at and _follows(finding, listed)]
        if taken:
            joined = _join(findings[at], [findings[i] for i in taken])
            findings = [
                joined if i == at else finding
                for i, finding in enumerate(findings)
                if i not in taken
            ]
    return findings


def _follows(finding: Finding, listed: tuple[str, ...]) -> bool:
    return finding.id in listed or f"{finding.id}:{finding.evidence.get(CAUSE)}" in listed


def _join(cause: Finding, taken: list[Finding]) -> Finding:
    weighed = [f.severity for f in taken if f.id not in _JUDGED_BY_CAUSE]
    inner = tuple(one for f in taken for one in (replace(f, consequences=()), *f.consequences))
    return replace(
        cause,
        severity=min((cause.severity, *weighed), key=SEVERITIES.index),
        consequences=(*cause.consequences, *inner),
    )


def _rank(finding: Finding) -> int:
    """Place in a report."""
    if finding.severity == "error":
        return 2 if finding.id in NOISES else 0
    if finding.severity == "warning":
        return 1 if finding.id in RECORDING else 3
    return 4
