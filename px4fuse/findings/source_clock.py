"""Time offset between position source and IMU, its change in flight, and a wrong EKF2_EV_DELAY."""

import math

from px4fuse.analysis import Analysis
from px4fuse.comparison import remedy
from px4fuse.comparison.model import FilterName, PreparedComparison
from px4fuse.comparison.rerun_effects import Rerun
from px4fuse.filter.time_offset import SourceTimeOffset
from px4fuse.flight.ekf2_parameters import GNSS_POS, RECEIVER_DELAY_PARAMETERS
from px4fuse.flight.model import Unavailable

from .cause_text import format_sender_action
from .model import Findings, error_if, finding, make_error, make_warning
from .source_positions import find_low_pass
from .source_stamps import find_timesync_convergence

# Minimum time offset (s) for severity "error"; it causes a position error of 0.1 m at 1 m/s
MIN_OFFSET_FOR_SEVERITY_ERROR_S = 0.10
# Maximum ratio of KF's position RMSE with corrected timestamps to the RMSE without correction
MAX_RMSE_RATIO_AFTER_CORRECTION = 1.005
CORRECT_AT_SENDER_ACTION = "Correct the position timestamps before sending."
CHECK_RECEIVER_ACTION = f"Check the delay of the GNSS receiver ({GNSS_POS.delay})."


def detect(analysis: Analysis) -> Findings:
    """Yield the findings on the time offset of the positions, and on EKF2's delay parameters."""
    time_offset = analysis.time_offset
    if (
        isinstance(time_offset, SourceTimeOffset)
        and time_offset.is_determinable
        and not analysis.source.origin.reconstructed
    ):
        yield from detect_time_offset(analysis, time_offset)
        yield from detect_wrong_delay(analysis, time_offset)
    yield from detect_wrong_gnss_delay(analysis)


def detect_time_offset(analysis: Analysis, time_offset: SourceTimeOffset) -> Findings:
    """Detect a time offset of the position timestamps, or its change in flight."""
    if find_low_pass(analysis) is not None:  # a low-pass filter delays positions, not timestamps
        return
    low_s, high_s = time_offset.interval_s
    # The evidence contains the total offset, with the part that --clock-offset already corrects
    evidence = {
        "offset_s": time_offset.offset_s,
        "interval_low_s": low_s,
        "interval_high_s": high_s,
    }
    if time_offset.has_changed() and time_offset.change_p_value is not None:
        yield make_error(
            "source_time_offset_changes",
            "The time offset of the positions changes in flight from "
            f"{time_offset.parts[0].offset_s:+.2f} s to {time_offset.parts[-1].offset_s:+.2f} s "
            f"(significance test: p {time_offset.change_p_value:.1g}). No single --clock-offset "
            "corrects the whole flight. Possible cause: PX4 uses arrival times until 500 TIMESYNC "
            "answers have synchronised the clocks.",
            "Let the clocks synchronise for one minute before take-off. Analyse only the time "
            "before or after the change of the time offset (--start, --end).",
            {**evidence, "change_p_value": time_offset.change_p_value},
        )
        return
    # One offset cannot correct timestamps that are partly arrival times
    if (
        not time_offset.is_significant(time_offset.remaining_s)
        or find_timesync_convergence(analysis) is not None
        or truth_refutes_offset(find_offset_rerun(analysis))
    ):
        return
    # The message states the part of the offset that is not yet corrected, as a positive number
    offset_s, low_s, high_s = (
        value - time_offset.applied_s for value in (time_offset.offset_s, low_s, high_s)
    )
    late_or_early = "early"
    if offset_s < 0.0:
        offset_s, low_s, high_s, late_or_early = -offset_s, -high_s, -low_s, "late"
    yield finding(
        error_if(offset_s > MIN_OFFSET_FOR_SEVERITY_ERROR_S),
        "source_time_offset",
        f"Position timestamps are {offset_s:.2f} s {late_or_early}. The time offset estimated from "
        f"IMU and positions is {offset_s:.3f} s (95 % {low_s:.3f} to {high_s:.3f} s). At 1 m/s, "
        f"this offset is a position error of {offset_s:.2f} m, which innovations hardly "
        f"show.{_format_assumed_delay(analysis, time_offset)}",
        _find_offset_remedy(analysis, time_offset),
        evidence,
    )


def find_offset_rerun(analysis: Analysis) -> Rerun | None:
    return _find_rerun(analysis, "kf", "time offset")


def truth_refutes_offset(rerun: Rerun | None) -> bool:
    """Return True if a corrected time offset increases KF's error against ground truth."""
    return _compute_rmse_ratio(rerun) > MAX_RMSE_RATIO_AFTER_CORRECTION


def _find_rerun(analysis: Analysis, filter_name: FilterName, kind: str) -> Rerun | None:
    reruns = analysis.select_main_reruns()
    return next((run for run in reruns if (run.filter, run.kinds) == (filter_name, (kind,))), None)


def _compute_rmse_ratio(rerun: Rerun | None) -> float:
    """Return position RMSE with a change / position RMSE without it; NaN if unknown."""
    if rerun is None or not rerun.before.position_rmse_m or rerun.after.position_rmse_m is None:
        return math.nan
    return rerun.after.position_rmse_m / rerun.before.position_rmse_m


def _find_receiver_delay_parameter(analysis: Analysis) -> str | None:
    for name in (*RECEIVER_DELAY_PARAMETERS, GNSS_POS.delay):
        if analysis.source.origin.is_fused_as_gnss and name in analysis.flight.log.parameters:
            return name
    return None


def _format_assumed_delay(analysis: Analysis, time_offset: SourceTimeOffset) -> str:
    """Format the logged and the estimated delay of the GNSS receiver; "" for other sources."""
    delay_parameter = _find_receiver_delay_parameter(analysis)
    if delay_parameter is None:
        return ""
    delay_ms = analysis.flight.log.parameters[delay_parameter]
    estimated_delay_ms = max(delay_ms - 1e3 * time_offset.remaining_s, 0.0)
    return f" {delay_parameter} is {delay_ms:g} ms; the estimate is {estimated_delay_ms:.0f} ms."


def _find_offset_remedy(analysis: Analysis, time_offset: SourceTimeOffset) -> str:
    if delay_parameter := _find_receiver_delay_parameter(analysis):
        return f"Check the delay of the GNSS receiver ({delay_parameter})."
    if analysis.source.alignment is not None:
        total_offset_s = compute_clock_offset_option_s(analysis, time_offset)
        return f"Run again with --clock-offset {total_offset_s:.3f}."
    position_age_ms = (remedy.find_logged_delay_ms(analysis) or 0.0) - 1e3 * time_offset.remaining_s
    action = format_sender_action(analysis.source, time_offset.remaining_s)
    if delay_max_change := remedy.find_delay_max_change(analysis, position_age_ms):
        action += f", and set {remedy.format_changes(delay_max_change)}"
    return f"{action}."


def compute_clock_offset_option_s(
    comparison: PreparedComparison, time_offset: SourceTimeOffset
) -> float:
    """Return the value (s) of ``--clock-offset`` that corrects a time offset."""
    # --clock-offset replaces the offset from the alignment, so it must include that offset
    alignment = comparison.source.alignment
    return time_offset.offset_s + (0.0 if alignment is None else alignment.clock_offset_s)


def detect_wrong_delay(analysis: Analysis, time_offset: SourceTimeOffset) -> Findings:
    if truth_refutes_offset(find_offset_rerun(analysis)):
        return
    source, delay_ms = analysis.source, remedy.find_logged_delay_ms(analysis)
    is_gnss = source.origin.is_fused_as_gnss
    if delay_ms is None or not (source.origin.is_vision or is_gnss):
        return
    # detect_time_offset reports a wrong EKF2_GPS_DELAY, unless --clock-offset corrects it
    if is_gnss and time_offset.is_significant(time_offset.remaining_s):
        return
    estimated_delay_ms = remedy.estimate_delay_if_not_as_logged_ms(analysis, time_offset, delay_ms)
    if estimated_delay_ms is None:
        return
    # Delay = assumed delay - time offset, so the largest offset is the smallest delay
    low_ms, high_ms = (
        1e3 * (source.assumed_delay_s - offset_s) for offset_s in reversed(time_offset.interval_s)
    )
    if low_ms <= 0.0 <= high_ms:
        delay_text = "the positions have no significant delay"
    elif estimated_delay_ms < 0.0:  # state how early the timestamps are, as a positive number
        delay_text = f"the timestamps are {-estimated_delay_ms:.0f} ms early"
        low_ms, high_ms = -high_ms, -low_ms
    else:
        delay_text = f"the positions are {estimated_delay_ms:.0f} ms late"
    parameter = remedy.find_aid(analysis).delay
    # Action if the parameter cannot correct the delay: PX4 does not permit the value, or a re-run
    # with it does not help
    if not is_gnss:
        finding_id, action = "ekf2_ev_delay_wrong", CORRECT_AT_SENDER_ACTION
        evidence = {"ekf2_ev_delay_ms": delay_ms, "asked_ms": estimated_delay_ms}
    else:
        finding_id, action = "ekf2_gps_delay_wrong", CHECK_RECEIVER_ACTION
        evidence = {
            "ekf2_gps_delay_ms": delay_ms,
            "estimate_ms": estimated_delay_ms,
            "sigma_ms": 1e3 * time_offset.sigma_s,
        }
    limit_sentence = ""
    if exceed_limit_or_be_negative := remedy.describe_delay_limit(
        parameter, estimated_delay_ms, delay_ms
    ):
        limit_sentence = f" The parameter {parameter} cannot {exceed_limit_or_be_negative}."
    else:
        action = _find_delay_remedy(analysis, parameter, action)
    yield make_warning(
        finding_id,
        f"{parameter} is {delay_ms:g} ms, but {delay_text}. The 95 % interval is {round(low_ms)} "
        f"to {round(high_ms)} ms. EKF2's track leads or lags the motion.{limit_sentence}",
        action,
        evidence,
    )


def detect_wrong_gnss_delay(analysis: Analysis) -> Findings:
    """Detect a wrong EKF2_GPS_DELAY in a flight in which EKF2 also fuses vision."""
    ekf2_model = analysis.ekf2_model
    if isinstance(ekf2_model, Unavailable) or not ekf2_model.agreement.good:
        return
    estimate = remedy.estimate_gnss_delay_ms(analysis, ekf2_model, analysis.time_offset)
    if estimate is None:
        return
    delay_ms, (estimated_delay_ms, sigma_ms) = ekf2_model.inputs.settings[GNSS_POS.delay], estimate
    change = remedy.make_delay_change(ekf2_model.inputs, estimated_delay_ms)
    yield make_warning(
        "ekf2_gps_delay_wrong",
        f"{GNSS_POS.delay} is {delay_ms:g} ms, but GNSS positions and velocities are "
        f"{estimated_delay_ms:.0f} ms late (± {1.96 * sigma_ms:.0f} ms, 95 %, compared with "
        "vision). EKF2's track leads or lags the motion.",
        f"Set {remedy.format_changes(change)}." if change else CHECK_RECEIVER_ACTION,
        {"ekf2_gps_delay_ms": delay_ms, "estimate_ms": estimated_delay_ms, "sigma_ms": sigma_ms},
    )


def _find_delay_remedy(analysis: Analysis, parameter: str, action_if_not_confirmed: str) -> str:
    """Return the action for a wrong delay parameter: the change of a re-run that reduces the error.

    The error is the position RMSE or, without ground truth, the mean NIS. If the re-run does not
    reduce the error, return ``action_if_not_confirmed``. Without a re-run, the action is a check.
    """
    rerun = _find_rerun(analysis, "ekf2", "delay")
    if rerun is None:
        return f"Check {parameter}."
    ratio = _compute_rmse_ratio(rerun)
    if math.isnan(ratio) and rerun.before.nis_mean and rerun.after.nis_mean:
        ratio = rerun.after.nis_mean / rerun.before.nis_mean
    return f"Set {remedy.format_changes(rerun.change)}." if ratio < 1.0 else action_if_not_confirmed
