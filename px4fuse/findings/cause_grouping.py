"""Order of the findings, and grouping of each cause with its consequences.

A report thus lists one finding per fault to correct, and the consequences below it.
"""

from collections.abc import Iterable, Mapping

from msgspec.structs import replace

from px4fuse.finding import SEVERITIES, Finding
from px4fuse.findings.model import TITLES, group_by_root

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
# Kind of cause of resets: all of them follow a gap in the source
GAP = "gap"
# Kind of cause of little motion
GROUND = "never took off"

_UNDERCONFIDENT = ("kf_underconfident", "ekf2_underconfident")
_KF_VARIANCES = ("kf_underconfident", "kf_overconfident")
SETTINGS = ("sigma_a_too_large", "sigma_a_too_small", "sigma_z_too_large", "sigma_z_too_small")
_VARIANCES_AND_SETTINGS = (*_KF_VARIANCES, "ekf2_underconfident", "ekf2_overconfident", *SETTINGS)
NOISES = frozenset((*_VARIANCES_AND_SETTINGS, "process_noise_near_zero"))
# Consequences by id of the cause; a pair applies only to findings with this kind of cause in their
# evidence. A finding is attached to the first cause of this table that is present, so a cause that
# has itself a cause stands before it.
CONSEQUENCES: Mapping[str, tuple[str | tuple[str, str], ...]] = {
    "source_timestamps_constant": ("source_timestamp_jitter",),
    "sigma_a_too_small": (("kf_overconfident", PROCESS),),
    "process_noise_near_zero": ("sigma_a_too_small", ("kf_overconfident", PROCESS)),
    "sigma_z_too_small": (("kf_overconfident", NOISE),),
    "sigma_a_too_large": (("kf_underconfident", PROCESS),),
    "sigma_z_too_large": (("kf_underconfident", NOISE),),
    "error_exceeds_reported_sigma": _UNDERCONFIDENT,
    # rejected samples do not correct EKF2, so it drifts and resets
    "ekf2_rejects_positions": (("ekf2_resets", ELSEWHERE),),
    # the width of the gate is proportional to √S
    "ekf2_overconfident": ("ekf2_rejects_positions",),
    "ekf2_noise_too_small": (
        "ekf2_overconfident",
        "ekf2_rejects_positions",
        ("ekf2_resets", ELSEWHERE),
        "ekf2_fusion_interrupted",
        "aid_not_fused",
        ("error_exceeds_reported_sigma", NOISE),
        ("error_exceeds_reported_sigma", ELSEWHERE),
        "sigma_z_too_small",
        ("kf_overconfident", NOISE),
    ),
    "ekf2_noise_too_large": (
        "ekf2_underconfident",
        "sigma_z_too_large",
        ("kf_underconfident", NOISE),
    ),
    "source_outliers": (
        ("kf_overconfident", OUTLIERS),
        ("ekf2_overconfident", OUTLIERS),
        ("ekf2_overconfident", ELSEWHERE),
        "ekf2_rejects_positions",
        ("ekf2_resets", ELSEWHERE),
        ("aid_not_fused", SENSOR),
    ),
    "source_drift": _UNDERCONFIDENT,
    "ekf2_gate_too_small": (
        "ekf2_rejects_positions",
        ("ekf2_resets", ELSEWHERE),
        "ekf2_fusion_interrupted",
        ("ekf2_overconfident", GATE),
        ("ekf2_overconfident", ELSEWHERE),
        ("error_exceeds_reported_sigma", GATE),
        ("error_exceeds_reported_sigma", ELSEWHERE),
        ("aid_not_fused", SENSOR),
    ),
    "source_may_drift": _UNDERCONFIDENT,
    "ekf2_ev_delay_wrong": (
        ("error_exceeds_reported_sigma", CLOCK),
        ("ekf2_overconfident", CLOCK),
        ("ekf2_underconfident", CLOCK),
    ),
    "source_low_pass_filtered": (
        *_VARIANCES_AND_SETTINGS,
        "error_exceeds_reported_sigma",
        "ekf2_ev_delay_wrong",
    ),
    # R describes neither time-correlated nor unequal noise
    "source_noise_time_correlated": (
        *_VARIANCES_AND_SETTINGS,
        "source_reported_variance_wrong",
        "error_exceeds_reported_sigma",
    ),
    "source_noise_unequal_axes": (
        *_KF_VARIANCES,
        "source_outliers",
        "source_reported_variance_wrong",
    ),
    "ekf2_heading_error": (
        ("error_exceeds_reported_sigma", FRAME),
        ("kf_overconfident", FRAME),
        ("error_exceeds_reported_sigma", ELSEWHERE),
        "sigma_a_too_small",
        ("aid_overconfident", SENSOR),
        ("ekf2_overconfident", ELSEWHERE),
        ("aid_not_fused", SENSOR),
    ),
    "source_position_jump": (
        ("kf_overconfident", OUTLIERS),
        ("kf_overconfident", ELSEWHERE),
        ("error_exceeds_reported_sigma", ELSEWHERE),
        ("ekf2_overconfident", ELSEWHERE),
        ("ekf2_overconfident", OUTLIERS),
        "ekf2_rejects_positions",
        ("ekf2_resets", ELSEWHERE),
        ("aid_not_fused", SENSOR),
        "ekf2_heading_error",
    ),
    "source_scale_error": (("error_exceeds_reported_sigma", ELSEWHERE),),
    # jumps and scale errors are tested with one noise for the whole flight
    "source_noise_varies": (
        *_KF_VARIANCES,
        "source_outliers",
        "source_reported_variance_wrong",
        "source_noise_time_correlated",
        "source_position_jump",
        "source_scale_error",
    ),
    "accelerometer_bias": (
        ("error_exceeds_reported_sigma", ELSEWHERE),
        ("error_exceeds_reported_sigma", ACCELEROMETER),
        ("kf_overconfident", ACCELEROMETER),
        "sigma_a_too_small",
    ),
    # a step of the time offset shifts the positions of a moving vehicle
    "source_time_offset_changes": (
        "source_position_jump",
        "source_scale_error",
        "source_low_pass_filtered",
        "source_noise_time_correlated",
        "ekf2_ev_delay_wrong",
        "error_exceeds_reported_sigma",
    ),
    "source_timestamps_are_arrival_times": ("source_time_offset_changes",),
    "source_time_offset": (
        "source_timestamps_are_arrival_times",
        "ekf2_ev_delay_wrong",
        ("error_exceeds_reported_sigma", CLOCK),
        ("kf_overconfident", CLOCK),
        ("ekf2_overconfident", CLOCK),
        ("aid_overconfident", SENSOR),
    ),
    "source_frame_misaligned": (
        ("error_exceeds_reported_sigma", FRAME),
        ("error_exceeds_reported_sigma", ELSEWHERE),
        ("kf_overconfident", FRAME),
    ),
    "source_samples_repeated": (
        "source_low_pass_filtered",
        "source_noise_time_correlated",
        "source_position_jump",
        "source_scale_error",
        "source_noise_unequal_axes",
        "source_noise_varies",
        "source_time_offset",
        "source_time_offset_changes",
        "ekf2_ev_delay_wrong",
        "source_outliers",
        *_VARIANCES_AND_SETTINGS,
        "source_reported_variance_wrong",
        "error_exceeds_reported_sigma",
    ),
    "source_not_logged": ("source_rate_limited_by_logger",),
    # EKF2 then rejects the samples that contradict it
    "aid_innovation_shift": (("aid_not_fused", CHANGE),),
    "source_gap": (
        "ekf2_fusion_interrupted",
        ("error_exceeds_reported_sigma", ELSEWHERE),
        "ekf2_resets",
        ("aid_not_fused", SENSOR),
    ),
    "logger_dropouts": ("imu_gap",),
    "imu_samples_missing": ("logger_dropouts", "imu_gap"),
    # without a position PX4 does not take off
    "ekf2_not_fusing": (("no_motion", GROUND),),
}
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


def effect_ids(cause: str) -> tuple[str, ...]:
    """Return the ids of the possible consequences of a finding, each once."""
    effects = CONSEQUENCES.get(cause, ())
    return tuple(
        dict.fromkeys(effect if isinstance(effect, str) else effect[0] for effect in effects)
    )


def _is_effect(finding: Finding, effects: tuple[str | tuple[str, str], ...]) -> bool:
    return finding.id in effects or (finding.id, finding.evidence.get(CAUSE)) in effects


def _report_rank(group: list[Finding]) -> int:
    """Return the sort key of a group: severity, with the recording before noises."""
    error_rank, warning_rank = (
        2 if group[0].id in NOISES else 0,
        1 if group[0].id in RECORDING else 3,
    )
    return {"error": error_rank, "warning": warning_rank, "note": 4}[group[0].severity]
