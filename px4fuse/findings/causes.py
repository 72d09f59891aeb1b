"""What findings are called, which of them have one cause, and in which order they are told.

What a cause brings with it stands behind it, with its evidence, so that a report has one finding
per thing to put right.
"""

from collections.abc import Iterable, Mapping

from msgspec.structs import replace

from px4fuse.findings.model import SEVERITIES, Finding, by_root

# What each finding is called within a sentence (a student reads words, never ids), in the order
# in which those of one rank are told
NAMES: Mapping[str, str] = {
    "source_stamps_constant": "position stamps that never change",
    "source_receipt_jitter": "stamps of receipt instead of measurement",
    "source_stamps_of_arrival": "position stamps that are times of arrival until the clocks agree",
    "source_thinned": "positions that were thinned before they were sent",
    "source_repeats": "positions that are sent again",
    "source_smoothed": "positions that were smoothed before they were sent",
    "source_coloured": "errors of the positions that hang together",
    "source_jumps": "positions that jump",
    "vehicle_tumbled": "a vehicle that tumbled",
    "accelerometer_bias": "a bias of the accelerometer",
    "accelerometer_clipped": "an accelerometer at the end of its range",
    "source_scale_wrong": "positions whose scale is wrong",
    "source_clock_changes": "position stamps whose offset changes in flight",
    "source_clock_offset": "position stamps that are early or late",
    "errors_larger_than_claimed": "errors larger than the filter claims",
    "source_frame_turned": "positions that are turned against north",
    "ekf2_heading_wrong": "a heading of EKF2 that is wrong or drifts",
    "source_noise_changes": "positions that are noisier for a part of the flight",
    "source_axes_unequal": "positions that are noisier along one axis than along the other",
    "source_outliers": "outliers among the positions",
    "source_variance_wrong": "a variance that the position source states wrongly",
    "sigma_z_small": "a SIGMA_Z that is too small",
    "sigma_z_large": "a SIGMA_Z that is too large",
    "sigma_a_small": "a SIGMA_A that is too small",
    "sigma_a_large": "a SIGMA_A that is too large",
    "loop_drift_understated": "odometry that drifts more than was stated",
    "false_loop_closure": "a loop that does not end where it began",
    "loop_closure_doubtful": "a closure that the others contradict",
    "loop_of_absolute_track": "a loop measured on a track that does not drift",
    "loop_end_assumed": "a landing place that was only assumed",
    "ekf2_not_fusing": "EKF2 that never used the positions",
    "ekf2_fusion_interrupted": "EKF2 that stopped fusing for a time",
    "process_noise_forgotten": "process noise that is nearly zero",
    "kf_variance_overstated": "a filter variance that is too large",
    "kf_variance_understated": "a filter variance that is too small",
    "ekf2_variance_overstated": "EKF2 that is too cautious about its variance",
    "ekf2_variance_understated": "EKF2 that is too sure: its variance is too small",
    "ekf2_gate_small": "a gate of EKF2 that rejects good positions",
    "ekf2_rejecting": "EKF2 that rejects good measurements",
    "ekf2_ev_delay_wrong": "a delay set in EKF2 that is not that of the positions",
    "aid_starved": "an aid that EKF2 went without for long",
    "aid_understated": "an aid that EKF2 trusts too much",
    "aid_changed": "an aid that changes in flight",
    "aid_biased": "an aid that pulls EKF2 to one side",
    "companion_not_synchronised": "a companion computer without time synchronisation",
    "position_file_placement": "the placing of the position file",
    "source_not_logged": "a position source that was not logged",
    "source_decimated": "positions logged too slowly",
    "source_gap": "a time without positions",
    "logger_dropouts": "dropouts of the logger",
    "imu_gap": "a gap in the IMU's samples",
    "autopilot_restarted": "a restart of the autopilot",
    "ekf2_resets": "resets of EKF2",
    "ekf2_instance_switch": "a change of the EKF2 instance",
    "no_motion": "a vehicle that hardly moved",
    "source_may_drift": "a position source that may drift",
    "logging_rate_low": "an IMU that was logged too slowly",
    "ekf2_innovations_decimated": "EKF2's innovations logged too slowly",
    "source_frame_not_north": "positions whose axes are not north and east",
    "ekf2_unavailable": "a log without EKF2",
    "input_unavailable": "a log without acceleration",
    "too_few_innovations": "too few measurements to judge a filter by",
    "log_damaged": "a damaged log",
    "samples_dropped": "samples that were dropped because their stamps went back",
    "source_samples_lost": "positions lost on the way",
    "not_px4": "a log that is not of PX4",
    "receipt_out_of_order": "messages that came out of order",
    "innovations_need_ulog": "innovations that only a ULog holds",
    "ekf2_is_a_model": "EKF2 that is a model of it",
}
# In the evidence of a finding about a variance: what the detector holds it to be the effect of
CAUSE = "cause"
NOISE, PROCESS, OUTLIERS, CLOCK, FRAME, GATE, ACCELEROMETER, ELSEWHERE = (
    "measurement noise", "process noise", "outliers", "clock", "frame", "gate", "accelerometer",
    "elsewhere",
)  # fmt: skip
# In the evidence of a slow error: how many times what a filter assumes of the noise its white part
# is; where it is beyond that, the noise is wrong by itself
WHITE_BEYOND = "white_over_assumed"
# Likewise of an aid: it is of the sensor that the positions are of, or changed in flight
SENSOR, CHANGE = "the source's sensor", "change"

_OVERSTATED = ("kf_variance_overstated", "ekf2_variance_overstated")
_OURS = ("kf_variance_overstated", "kf_variance_understated")
SETTINGS = frozenset({"sigma_a_large", "sigma_a_small", "sigma_z_large", "sigma_z_small"})
VARIANCES = frozenset({*_OVERSTATED, *_OURS, "ekf2_variance_understated"})
NOISES = SETTINGS | VARIANCES | {"process_noise_forgotten"}
_FITTED = tuple(sorted(SETTINGS | VARIANCES))
# Cause to what it brings with it, read from above, so that a finding goes to the first cause that
# is there; what brings others with it stands before what brings it; "id:cause" only where the
# evidence names that cause
CONSEQUENCES: Mapping[str, tuple[str, ...]] = {
    "source_stamps_constant": ("source_receipt_jitter",),
    "sigma_a_small": (f"kf_variance_understated:{PROCESS}",),
    "process_noise_forgotten": ("sigma_a_small", f"kf_variance_understated:{PROCESS}"),
    "sigma_z_small": (f"kf_variance_understated:{NOISE}",),
    "sigma_a_large": (f"kf_variance_overstated:{PROCESS}",),
    "sigma_z_large": (f"kf_variance_overstated:{NOISE}",),
    # the gate is as wide as S says
    "ekf2_variance_understated": ("ekf2_rejecting",),
    "source_outliers": (
        f"kf_variance_understated:{OUTLIERS}", f"ekf2_variance_understated:{OUTLIERS}",
        f"ekf2_variance_understated:{ELSEWHERE}", "ekf2_rejecting",
    ),
    "errors_larger_than_claimed": _OVERSTATED,
    # what is rejected is not corrected: EKF2 drifts, resets, and its innovations grow
    "ekf2_gate_small": (
        "ekf2_rejecting", "ekf2_resets", "ekf2_fusion_interrupted",
        f"ekf2_variance_understated:{GATE}",
        f"ekf2_variance_understated:{ELSEWHERE}", f"errors_larger_than_claimed:{GATE}",
        f"errors_larger_than_claimed:{ELSEWHERE}", f"aid_starved:{SENSOR}",
    ),
    "source_may_drift": _OVERSTATED,
    "ekf2_ev_delay_wrong": (
        f"errors_larger_than_claimed:{CLOCK}", f"ekf2_variance_understated:{CLOCK}",
        f"ekf2_variance_overstated:{CLOCK}",
    ),
    "source_smoothed": (*_FITTED, "errors_larger_than_claimed", "ekf2_ev_delay_wrong"),
    # R describes none of these three
    "source_coloured": (*_FITTED, "source_variance_wrong", "errors_larger_than_claimed"),
    "source_axes_unequal": (*_OURS, "source_outliers", "source_variance_wrong"),
    "ekf2_heading_wrong": (
        f"errors_larger_than_claimed:{FRAME}", f"kf_variance_understated:{FRAME}",
        f"errors_larger_than_claimed:{ELSEWHERE}", "sigma_a_small", f"aid_understated:{SENSOR}",
        f"ekf2_variance_understated:{ELSEWHERE}", f"aid_starved:{SENSOR}",
    ),
    "source_jumps": (
        f"kf_variance_understated:{OUTLIERS}", f"kf_variance_understated:{ELSEWHERE}",
        f"errors_larger_than_claimed:{ELSEWHERE}", f"ekf2_variance_understated:{ELSEWHERE}",
        f"ekf2_variance_understated:{OUTLIERS}", "ekf2_rejecting", "ekf2_resets",
        f"aid_starved:{SENSOR}", "ekf2_heading_wrong",
    ),
    "source_scale_wrong": (f"errors_larger_than_claimed:{ELSEWHERE}",),
    # a jump and a scale are judged by one noise throughout
    "source_noise_changes": (
        *_OURS, "source_outliers", "source_variance_wrong", "source_coloured", "source_jumps",
        "source_scale_wrong",
    ),
    "accelerometer_bias": (
        f"errors_larger_than_claimed:{ELSEWHERE}", f"errors_larger_than_claimed:{ACCELEROMETER}",
        f"kf_variance_understated:{ACCELEROMETER}", "sigma_a_small",
    ),
    # a step of the stamps moves positions of a vehicle that moves
    "source_clock_changes": (
        "source_jumps", "source_scale_wrong", "source_smoothed", "source_coloured",
        "ekf2_ev_delay_wrong", "errors_larger_than_claimed",
    ),
    "source_stamps_of_arrival": ("source_clock_changes",),
    "source_clock_offset": (
        "source_stamps_of_arrival", "ekf2_ev_delay_wrong", f"errors_larger_than_claimed:{CLOCK}",
        f"kf_variance_understated:{CLOCK}", f"ekf2_variance_understated:{CLOCK}",
        f"aid_understated:{SENSOR}",
    ),
    "source_frame_turned": (
        f"errors_larger_than_claimed:{FRAME}", f"errors_larger_than_claimed:{ELSEWHERE}",
        f"kf_variance_understated:{FRAME}",
    ),
    "source_repeats": (
        "source_smoothed", "source_coloured", "source_jumps", "source_scale_wrong",
        "source_axes_unequal", "source_noise_changes", "source_clock_offset",
        "source_clock_changes", "ekf2_ev_delay_wrong", "source_outliers", *_FITTED,
        "source_variance_wrong", "errors_larger_than_claimed",
    ),
    "source_not_logged": ("source_decimated",),
    # what contradicts EKF2 from then on is rejected
    "aid_changed": (f"aid_starved:{CHANGE}",),
    "source_gap": ("ekf2_fusion_interrupted", f"errors_larger_than_claimed:{ELSEWHERE}"),
    "logger_dropouts": ("imu_gap",),
}  # fmt: skip
# What the recording lacks: put right first, since noises are judged by what was recorded
RECORDING = frozenset({
    "autopilot_restarted", "imu_gap", "input_unavailable", "log_damaged", "logger_dropouts",
    "logging_rate_low", "source_decimated", "source_gap", "source_not_logged",
    "source_samples_lost", "too_few_innovations",
})  # fmt: skip


def by_cause(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Findings in the order in which to put them right, each behind what it follows from.

    By severity and then in the order of :data:`NAMES`, except that what the recording lacks comes
    before errors of noises. A cause is as severe as what it brings with it.
    """
    places = {name: place for place, name in enumerate(NAMES)}
    groups = sorted(by_root(findings), key=lambda group: places[group[0].id])
    for cause, listed in CONSEQUENCES.items():
        into = next((group for group in groups if group[0].id == cause), None)
        if into is None or WHITE_BEYOND in into[0].evidence:
            continue
        taken = [group for group in groups if group is not into and _follows(group[0], listed)]
        groups = [group for group in groups if group not in taken]
        for first, *rest in taken:
            into += [replace(first, caused_by=cause), *rest]
        # the variance of our filter is judged by the setting that it follows from
        weighed = (first.severity for first, *_ in taken if first.id not in _OURS)
        severity = min((into[0].severity, *weighed), key=SEVERITIES.index)
        into[0] = replace(into[0], severity=severity)
    return tuple(one for group in sorted(groups, key=_rank) for one in group)


def _follows(finding: Finding, listed: tuple[str, ...]) -> bool:
    return finding.id in listed or f"{finding.id}:{finding.evidence.get(CAUSE)}" in listed


def _rank(group: list[Finding]) -> int:
    """Place in a report."""
    error, warning = 2 if group[0].id in NOISES else 0, 1 if group[0].id in RECORDING else 3
    return {"error": error, "warning": warning, "info": 4}[group[0].severity]
