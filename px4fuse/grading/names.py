"""What findings are called in a sentence: a student reads words, never ids."""

from __future__ import annotations

from collections.abc import Mapping

NAMES: Mapping[str, str] = {
    "accelerometer_bias": "a bias of the accelerometer",
    "autopilot_restarted": "a restart of the autopilot",
    "companion_not_synchronised": "a companion computer without time synchronisation",
    "ekf2_ev_delay_wrong": "a delay set in EKF2 that is not that of the positions",
    "ekf2_fusion_interrupted": "EKF2 that stopped fusing for a time",
    "ekf2_heading_wrong": "a heading of EKF2 that is wrong or drifts",
    "ekf2_innovations_decimated": "EKF2's innovations logged too slowly",
    "ekf2_instance_switch": "a change of the EKF2 instance",
    "ekf2_is_a_model": "EKF2 that is a model of it",
    "ekf2_not_fusing": "EKF2 that never used the positions",
    "ekf2_rejecting": "EKF2 that rejects good measurements",
    "ekf2_resets": "resets of EKF2",
    "ekf2_unavailable": "a log without EKF2",
    "ekf2_variance_overstated": "EKF2 that is too cautious about its variance",
    "ekf2_variance_understated": "EKF2 that is too sure: its variance is too small",
    "errors_larger_than_claimed": "errors larger than the filter claims",
    "false_loop_closure": "a loop that does not end where it began",
    "imu_gap": "a gap in the IMU's samples",
    "innovations_need_ulog": "innovations that only a ULog holds",
    "input_unavailable": "a log without acceleration",
    "kf_variance_overstated": "a filter variance that is too large",
    "kf_variance_understated": "a filter variance that is too small",
    "log_damaged": "a damaged log",
    "logger_dropouts": "dropouts of the logger",
    "logging_rate_low": "an IMU that was logged too slowly",
    "loop_closure_doubtful": "a closure that the others contradict",
    "loop_drift_understated": "odometry that drifts more than was stated",
    "loop_end_assumed": "a landing place that was only assumed",
    "loop_of_absolute_track": "a loop measured on a track that does not drift",
    "no_motion": "a vehicle that hardly moved",
    "not_px4": "a log that is not of PX4",
    "position_file_placement": "the placing of the position file",
    "process_noise_forgotten": "process noise that is nearly zero",
    "receipt_out_of_order": "messages that came out of order",
    "samples_dropped": "samples that were dropped because their stamps went back",
    "sigma_a_large": "a SIGMA_A that is too large",
    "sigma_a_small": "a SIGMA_A that is too small",
    "sigma_z_large": "a SIGMA_Z that is too large",
    "sigma_z_small": "a SIGMA_Z that is too small",
    "source_clock_changes": "position stamps whose offset changes in flight",
    "source_clock_offset": "position stamps that are early or late",
    "source_decimated": "positions logged too slowly",
    "source_frame_not_north": "positions whose axes are not north and east",
    "source_frame_turned": "positions that are turned against north",
    "source_gap": "a time without positions",
    "source_jumps": "positions that jump",
    "source_may_drift": "a position source that may drift",
    "source_not_logged": "a position source that was not logged",
    "source_outliers": "outliers among the positions",
    "source_receipt_jitter": "stamps of receipt instead of measurement",
    "source_samples_lost": "positions lost on the way",
    "source_scale_wrong": "positions whose scale is wrong",
    "source_smoothed": "positions that were smoothed before they were sent",
    "source_stamps_constant": "position stamps that never change",
    "source_stamps_of_arrival": "position stamps that are times of arrival until the clocks agree",
    "source_thinned": "positions that were thinned before they were sent",
    "source_variance_wrong": "a variance that the position source states wrongly",
    "too_few_innovations": "too few measurements to judge a filter by",
}


# Places in the results that the default rubric names
PARTS: Mapping[str, str] = {
    "axes.*.kf": "the consistency of the filter",
    "clock": "the clock offset",
    "loop.closure_error_m": "the closure error",
    "loop.path_length_m": "the length of the path",
    "loop.corrections": "the corrected paths",
    "tuning": "the noises that the data ask for",
    "tuning.horizontal.held_out.gain_nats": "what tuning would still gain",
    "why": "why EKF2 differs",
}


def part(path: str) -> str:
    """A place in the results as part of a sentence."""
    return PARTS.get(path, path)


def named(finding: str) -> str:
    """A finding as part of a sentence.

    >>> named("source_gap"), named("of_a_later_version")
    ('a time without positions', 'of a later version')
    """
    return NAMES.get(finding, finding.replace("_", " "))
