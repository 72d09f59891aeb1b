"""Positions and aiding sources that EKF2 does not fuse, or fuses with a wrong σ or a bias.

An EKF2 position that EKF2 itself declares invalid is also detected.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.comparison.comparison import compute_position_errors
from px4fuse.comparison.flight_events import find_airborne_spans
from px4fuse.comparison.model import Comparison, PreparedComparison
from px4fuse.core.arrays import rms
from px4fuse.core.record import Span
from px4fuse.core.text import format_metres, format_number, format_ratio
from px4fuse.ekf2.aids import INNOVATION_MEAN_WINDOW_S, AidResult
from px4fuse.ekf2.fusion_conditions import (
    CHECK_SOURCE_ACTION,
    EV_START_INTERVAL_S,
    EV_STOP_INTERVAL_S,
    POSITION_RATE_ACTION,
    UnfusedPositions,
    find_unmet_condition,
    is_height_only,
)
from px4fuse.filter.signals import cut_to_segment
from px4fuse.finding import Finding
from px4fuse.flight.ekf2_parameters import AIDS, BAROMETER, MAG
from px4fuse.flight.model import (
    BAD_ACCELERATION_FLAG,
    POSITION_FILE_ORIGIN,
    Ekf2,
    PositionTrack,
    Truth,
    Unavailable,
)

from .model import (
    CAUSE_KEY,
    INNOVATION_CHANGE_CAUSE,
    SOURCE_SENSOR_CAUSE,
    Findings,
    compute_flag_fraction,
    error_if,
    find_spans_with_value,
    finding,
    format_percent,
    make_note,
    make_warning,
)

# Severity "error" if EKF2 fuses the positions for less than this fraction of the time
MAX_FUSED_FRACTION_FOR_SEVERITY_ERROR = 0.5
# Warning if EKF2 fuses the positions for less than this fraction of the time
MAX_FUSED_FRACTION_FOR_WARNING = 0.98
# Minimum mean position interval (s) that may delay the start of fusion: with jitter, some intervals
# exceed EKF2's limit of 0.2 s
MIN_INTERVAL_FOR_LATE_START_S = 0.18
MOTION_CAPTURE_TOPIC = "vehicle_mocap_odometry"
# Minimum position error (m) for a finding while EKF2 declares its position invalid
MIN_INVALID_POSITION_ERROR_M = 1.0
AIDS_TESTED_BY_REPLAY = ("ev_pos", "ev_hgt")
# A pause of barometer fusion is normal if it begins within this time (s) after take-off (ground
# effect)
GROUND_EFFECT_DURATION_S = 10.0
# A pause of barometer fusion has a large effect if EKF2's maximum height error in the pause ÷
# height RMSE in the rest of the flight exceeds this ratio
MIN_GAP_ERROR_TO_HEIGHT_RMSE_RATIO = 3.0
# Aiding sources whose vertical innovations EKF2 tests to flag a bad vertical acceleration
AIDS_OF_VERTICAL_ACCELERATION_TEST = ("gnss_vel", "gnss_hgt", "baro_hgt")
# Severity "note" if the flag fs_bad_acc_vertical is set for at most this fraction of the time
MAX_FLAGGED_TIME_FRACTION_FOR_SEVERITY_NOTE = 0.3
# Action for each sensor that EKF2 does not fuse, by the PX4 parameter that enables its fusion
ACTION_BY_SWITCH = {
    "EKF2_BARO_CTRL": "Shield the barometer from propeller wash and light.",
    "EKF2_GPS_CTRL": "Give the antenna a free view of the sky.",
    "EKF2_RNG_CTRL": "Fly within the range of the distance sensor.",
    "EKF2_OF_CTRL": "Fly over a textured and lit floor.",
    "EKF2_MAG_TYPE": "Mount the magnetometer away from motors and power cables.",
    "EKF2_EV_CTRL": CHECK_SOURCE_ACTION,
}
DEFAULT_ACTION = "Check mounting and power supply of the sensor."


def detect(analysis: Analysis) -> Findings:
    """Yield the findings on the fusion of the positions and of EKF2's other aiding sources."""
    yield from detect_position_fusion_faults(analysis)
    if isinstance(analysis.aids, Unavailable):
        return
    aid = analysis.source.origin.aid
    take_off_times_s = [start_s for start_s, _ in find_airborne_spans(analysis.flight)]
    height_error_m = None
    if barometer := analysis.aids.get(BAROMETER.name):
        height_error_m = _find_large_height_error_m(analysis, barometer.longest_gap_s)
    yield from detect_aid_faults(
        analysis.aids, aid.name if aid else "", take_off_times_s, height_error_m
    )
    yield from detect_bad_acceleration(analysis, analysis.aids)


def detect_position_fusion_faults(comparison: Comparison) -> Findings:
    if is_height_only(comparison.source):
        return
    if isinstance(comparison.flight.ekf2, Ekf2):
        yield from _detect_invalid_position(comparison, comparison.flight.ekf2)
    yield from detect_unfused_positions(comparison)


def detect_unfused_positions(analysis: PreparedComparison) -> Findings:
    """Detect positions that EKF2 fuses only for a part of the time, or never."""
    ekf2, source = analysis.flight.ekf2, _find_received_source(analysis)
    if not isinstance(ekf2, Ekf2) or isinstance(ekf2.fusion_flags, Unavailable):
        return
    fusion_flag = ekf2.fusion_flags["horizontal"]
    fused_fraction = compute_flag_fraction(fusion_flag, analysis.segment)
    is_mostly_fused = fused_fraction >= MAX_FUSED_FRACTION_FOR_SEVERITY_ERROR
    if is_mostly_fused:
        yield from _detect_slow_restart(analysis, fusion_flag)
    if source is None or fused_fraction >= MAX_FUSED_FRACTION_FOR_WARNING:
        return
    title = f"EKF2 never fused the {source.positions_text}"
    if fused_fraction:
        title = (
            f"EKF2 fused the {source.positions_text} only {format_percent(fused_fraction)} of "
            "the time"
        )
    evidence: dict[str, float | str] = {
        "fused_fraction": fused_fraction,
        "source_interval_s": 1.0 / source.compute_rate_hz(),
    }
    # Case 1: EKF2 does not read the topic of the positions
    if source.origin.aid is None:
        if source.name == MOTION_CAPTURE_TOPIC and not fused_fraction:
            yield make_warning(
                "ekf2_not_fusing",
                f"{title}: EKF2 does not read {source.name}. This topic contains ground truth: "
                "ATT_POS_MOCAP, or ODOMETRY of estimator type MOCAP.",
                "To fuse these positions, send VISION_POSITION_ESTIMATE, or ODOMETRY of "
                "estimator type VISION.",
                evidence,
            )
        return
    # Otherwise find the EKF2 condition that was not met in the longest time without fusion
    spans = find_spans_with_value(0.0, fusion_flag, analysis.segment)
    longest_span_s = max(spans, key=lambda span: span[1] - span[0])
    parameters = {**analysis.flight.log.parameters, **ekf2.parameters}
    unmet_condition = find_unmet_condition(
        UnfusedPositions(ekf2, source, source.origin.aid, parameters, longest_span_s)
    )
    condition, action = unmet_condition.condition, unmet_condition.action
    evidence["condition"] = condition
    if not condition and not source.origin.has_all_samples:
        action = f"Record with SDLOG_PROFILE 129 (default and vision). {action}"
    if unmet_condition.fault:
        title += f": {unmet_condition.fault}"
    message = f"{title}. {unmet_condition.reason}"
    # Case 2: EKF2 fused the positions, with interruptions
    if is_mostly_fused:
        message += (
            f" For up to {longest_span_s[1] - longest_span_s[0]:.1f} s EKF2 relied on the IMU and "
            "other aiding sources."
        )
        yield make_warning("ekf2_fusion_interrupted", message, action, evidence, spans)
        return
    # Case 3: EKF2 hardly fused the positions. GNSS may be switched off on purpose
    is_disabled_gnss = source.origin.is_fused_as_gnss and condition == "switch"
    yield finding(
        "note" if is_disabled_gnss else "error",
        "ekf2_not_fusing",
        message,
        action,
        evidence,
        spans if fused_fraction else (),
    )


def _find_received_source(analysis: PreparedComparison) -> PositionTrack | None:
    """Return the positions that PX4 received, if any."""
    if analysis.source.origin != POSITION_FILE_ORIGIN:
        return analysis.source
    for track in analysis.flight.positions:
        if track.origin.is_vision and track.origin != POSITION_FILE_ORIGIN:
            return track
    return None


def _detect_invalid_position(analysis: Comparison, ekf2: Ekf2) -> Findings:
    """Detect that EKF2 declares its own horizontal position invalid (flag ``xy_valid`` is 0)."""
    is_valid = ekf2.status_flags.get("xy_valid")
    if is_valid is None or is_valid.empty:
        return
    # The same limits as for the fraction of the time with fusion
    valid_fraction = compute_flag_fraction(is_valid, analysis.segment)
    if valid_fraction >= MAX_FUSED_FRACTION_FOR_WARNING:
        return
    spans = find_spans_with_value(0.0, is_valid, analysis.segment)
    distance_m = _find_largest_distance_m(analysis, ekf2, spans)
    # An unknown distance (NaN) is reported, too
    if distance_m < MIN_INVALID_POSITION_ERROR_M:
        return
    reference = "ground truth" if isinstance(analysis.flight.truth, Truth) else "position source"
    distance_sentence = ""
    if np.isfinite(distance_m):
        distance_sentence = (
            f" EKF2's invalid position is up to {format_metres(distance_m)} m from the {reference}."
        )
    yield finding(
        error_if(valid_fraction < MAX_FUSED_FRACTION_FOR_SEVERITY_ERROR),
        "ekf2_position_invalid",
        f"EKF2's horizontal position is invalid {format_percent(1.0 - valid_fraction)} of the time "
        f"(xy_valid 0), and PX4 does not use this position.{distance_sentence}",
        "First restore the fusion of positions. Noise settings do not change the error.",
        {"invalid_fraction": 1.0 - valid_fraction, "distance_m": distance_m},
        spans,
    )


def _find_largest_distance_m(analysis: Comparison, ekf2: Ekf2, spans: tuple[Span, ...]) -> float:
    """Return EKF2's largest horizontal distance (m) from ground truth or source in time spans."""
    truth, columns = analysis.flight.truth, ["north_m", "east_m"]
    reference = truth.samples if isinstance(truth, Truth) else analysis.source.samples
    ekf2_position_m = pd.concat([ekf2.state[columns].loc[start:end] for start, end in spans])
    differences_m = [
        ekf2_position_m[axis]
        - np.interp(ekf2_position_m.index, reference.index, reference[axis], np.nan, np.nan)
        for axis in columns
    ]
    return float(np.hypot(*differences_m).max())


def _detect_slow_restart(analysis: PreparedComparison, fusion_flag: pd.Series) -> Findings:
    """Detect that EKF2 resumes fusion late after a gap, because the position rate is too low."""
    source, rate_hz = analysis.source, analysis.source.compute_rate_hz()
    if (
        "EKF2_EV_CTRL" not in analysis.flight.log.parameters  # PX4 before v1.14
        or not source.origin.is_vision
        # Only the log shows all positions as EKF2 received them
        or not source.origin.has_all_samples
        or source.alignment
        or 1.0 / rate_hz < MIN_INTERVAL_FOR_LATE_START_S
    ):
        return
    time_s = source.samples.index.to_numpy()
    gap_ends_s = time_s[1:][np.diff(time_s) > EV_STOP_INTERVAL_S]
    delay_spans = []
    for start_s, end_s in find_spans_with_value(0.0, fusion_flag, analysis.segment):
        # Positions between the end of the last gap and the time at which EKF2 resumes fusion
        last_gap_end_s = gap_ends_s[gap_ends_s < end_s].max(initial=-np.inf)
        unfused_times_s = time_s[(time_s >= last_gap_end_s) & (time_s < end_s)]
        if (
            # EKF2 stopped fusion because of this gap, not because of an earlier gap
            last_gap_end_s > start_s - EV_STOP_INTERVAL_S
            # With only one or two unfused positions after the gap, EKF2 resumed fusion at once
            and len(unfused_times_s) > 2
            and unfused_times_s[1] - unfused_times_s[0] >= EV_START_INTERVAL_S
        ):
            delay_spans.append((float(unfused_times_s[0]), end_s))
    if delay_spans:
        longest_delay_s = max(end - start for start, end in delay_spans)
        yield make_note(
            "source_rate_at_limit",
            f"After a gap EKF2 resumed fusion {longest_delay_s:.1f} s late: "
            f"{source.positions_text} come at only {rate_hz:.1f} Hz. EKF2 (v1.14 and later) "
            f"starts fusion when two positions arrive within {EV_START_INTERVAL_S:g} s.",
            POSITION_RATE_ACTION,
            {"rate_hz": rate_hz, "longest_s": longest_delay_s, "count": len(delay_spans)},
            tuple(delay_spans),
        )


def detect_bad_acceleration(analysis: Analysis, aids: Mapping[str, AidResult]) -> Findings:
    """Detect that EKF2 flagged its vertical acceleration as bad."""
    ekf2 = analysis.flight.ekf2
    if isinstance(ekf2, Unavailable) or isinstance(ekf2.record, Unavailable):
        return
    state_times_s = cut_to_segment(ekf2.state, analysis.segment).index.to_numpy()
    is_flagged_bad = ekf2.record.was_flag_set(BAD_ACCELERATION_FLAG, state_times_s)
    if not is_flagged_bad.any():
        return
    too_small_noises = {
        AIDS[name].noise
        for name in AIDS_OF_VERTICAL_ACCELERATION_TEST
        if name in aids and aids[name].verdict == "overconfident"
    }
    cause = "Normal noise can set the flag fs_bad_acc_vertical for some seconds."
    remedy = "If fs_bad_acc_vertical stays set, check the IMU for vibration and clipping."
    if too_small_noises:
        parameters_text = " and ".join(sorted(too_small_noises))
        cause = f"The measurement noise is set too small: {parameters_text}."
        remedy = f"Increase {parameters_text} to the true noise of the sensor."
    flagged_fraction = float(is_flagged_bad.mean())
    start_s = float(state_times_s[is_flagged_bad.argmax()])
    yield finding(
        "warning" if flagged_fraction > MAX_FLAGGED_TIME_FRACTION_FOR_SEVERITY_NOTE else "note",
        "ekf2_acceleration_bad",
        f"EKF2 flags its vertical acceleration as bad for {format_percent(flagged_fraction)} of "
        f"the time, first at {start_s:.0f} s. Barometer and GNSS both measure a larger height than "
        f"EKF2 estimates. {cause}",
        remedy,
        {"fraction": flagged_fraction, "start_s": start_s},
    )


def detect_aid_faults(
    aids: Mapping[str, AidResult],
    kf_position_aid: str = "",
    take_off_times_s: Sequence[float] = (),
    height_error_m: float | None = None,
) -> Findings:
    """Detect faults of EKF2's aiding sources.

    ``kf_position_aid`` is the aiding source that also gives KF's positions. ``height_error_m`` is
    EKF2's height error in a barometer gap.
    """
    # One finding for all aiding sources of a sensor: the same parameter enables their fusion
    aids_to_test = {name: aid for name, aid in aids.items() if name not in AIDS_TESTED_BY_REPLAY}
    unfused_aids_by_switch: dict[str, list[AidResult]] = {}
    for name, aid in aids_to_test.items():
        is_take_off_gap = name == BAROMETER.name and any(
            start <= aid.longest_gap_s[0] <= start + GROUND_EFFECT_DURATION_S
            for start in take_off_times_s
        )
        if aid.verdict == "not_fused" and not is_take_off_gap:
            unfused_aids_by_switch.setdefault(AIDS[name].switch or name, []).append(aid)
    for fusion_parameter, aids_of_sensor in unfused_aids_by_switch.items():
        yield _make_not_fused_finding(
            fusion_parameter, aids_of_sensor, kf_position_aid, height_error_m
        )
    # A change of the mean innovation in flight also affects mean and NIS of the whole flight, so it
    # is tested first. Other findings report overconfidence about the source of KF's positions
    for name, aid in aids_to_test.items():
        sensor_cause = _find_shared_sensor_cause(AIDS[name].switch, kf_position_aid)
        if not sensor_cause and any(result.change for result in aid.axes.values()):
            yield _make_innovation_change_finding(name, aid)
        elif aid.verdict == "overconfident" and name != kf_position_aid:
            yield _make_overconfident_finding(name, aid, sensor_cause)
        elif aid.verdict == "biased":
            yield _make_innovation_bias_finding(name, aid)


def _make_not_fused_finding(
    fusion_parameter: str,
    aids_of_sensor: list[AidResult],
    kf_position_aid: str,
    height_error_m: float | None,
) -> Finding:
    """Make the finding on a sensor of which EKF2 fused no sample for a long time."""
    aid_with_longest_gap = max(aids_of_sensor, key=lambda aid: aid.longest_gap_duration_s)
    aid_labels_text = ", ".join(map(_format_aid_label, aids_of_sensor))
    has_innovation_shift = any(axis.change for aid in aids_of_sensor for axis in aid.axes.values())
    is_barometer = fusion_parameter == BAROMETER.switch
    height_error_text = ""
    if is_barometer and height_error_m is not None:
        height_error_text = f": EKF2's height error is {height_error_m:.2f} m"
    return finding(
        "note" if is_barometer and not height_error_text else "warning",
        "aid_not_fused",
        f"EKF2 fused no sample of {aid_labels_text} for "
        f"{aid_with_longest_gap.longest_gap_duration_s:.0f} s{height_error_text}. EKF2 rejected "
        f"{format_percent(aid_with_longest_gap.rejected_fraction)} of the samples.",
        ACTION_BY_SWITCH.get(fusion_parameter, DEFAULT_ACTION),
        {
            "aid": aid_labels_text,
            "longest_gap_s": aid_with_longest_gap.longest_gap_duration_s,
            "rejected_fraction": aid_with_longest_gap.rejected_fraction,
            CAUSE_KEY: _find_shared_sensor_cause(fusion_parameter, kf_position_aid)
            or (INNOVATION_CHANGE_CAUSE if has_innovation_shift else ""),
        },
        (aid_with_longest_gap.longest_gap_s,),
    )


def _make_innovation_change_finding(name: str, aid: AidResult) -> Finding:
    """Make the finding on the axis whose mean innovation changes most in flight."""
    changes = [(result.change, axis) for axis, result in aid.axes.items() if result.change]
    (time_s, mean_change), axis = max(changes, key=lambda item: abs(item[0][1]))
    innovation_sigma = aid.axes[axis].s_sqrt_median
    return make_warning(
        "aid_innovation_shift",
        f"The mean {axis} innovation of {_format_aid_label(aid)} shifts by "
        f"{format_number(abs(mean_change) * innovation_sigma, 2)} {aid.unit} at {time_s:.0f} s "
        f"({abs(mean_change):.1f} times √S of {format_number(innovation_sigma, 2)} {aid.unit}).",
        f"Check which device near the sensor was switched on or off, or moved, at {time_s:.0f} s.",
        {"aid": name, "axis": axis, "time_s": time_s, "moved": mean_change},
        ((time_s, time_s + INNOVATION_MEAN_WINDOW_S),),
    )


def _make_overconfident_finding(name: str, aid: AidResult, sensor_cause: str) -> Finding:
    """Make the finding that EKF2 is overconfident about an aiding source (mean NIS above 1)."""
    # Innovations alone do not distinguish noise from a wrong delay, so no noise value is proposed
    noise_text, action = "", "let the sensor's driver report the true noise (σ)"
    if AIDS[name].noise:
        action = f"increase {AIDS[name].noise}"
    if aid.noise is not None:
        noise_text = f" ({format_number(aid.noise)} {aid.unit}, from {aid.noise_from})"
    return make_warning(
        "aid_overconfident",
        f"EKF2 is overconfident about {_format_aid_label(aid)}: σ is "
        f"{format_ratio(aid.nis_mean**0.5)} times too small. The mean NIS is "
        f"{format_number(aid.nis_mean)} (expected 1). EKF2 rejects "
        f"{format_percent(aid.rejected_fraction)} of the samples. Possible causes: errors above "
        f"√R{noise_text}, or errors of another sensor.",
        f"First check delay and mounting of the sensor. Then {action}.",
        {
            "aid": name,
            "nis_mean": aid.nis_mean,
            "rejected_fraction": aid.rejected_fraction,
            CAUSE_KEY: sensor_cause,
        },
    )


def _make_innovation_bias_finding(name: str, aid: AidResult) -> Finding:
    """Make the note on the axis with the largest mean innovation, in multiples of √S."""
    axis, worst_axis = max(
        aid.axes.items(), key=lambda item: abs(item[1].mean_normalised_innovation)
    )
    return make_note(
        "aid_innovation_bias",
        f"The mean {axis} innovation of {_format_aid_label(aid)} is "
        f"{format_number(worst_axis.innovation_mean)} {aid.unit}, expected 0 (√S "
        f"{format_number(worst_axis.s_sqrt_median)} {aid.unit}).",
        "Calibrate the sensor. Noise settings do not correct a bias.",
        {
            "aid": name,
            "axis": axis,
            "innovation_mean": worst_axis.innovation_mean,
            "s_sqrt_median": worst_axis.s_sqrt_median,
        },
    )


def _find_large_height_error_m(analysis: Analysis, span_s: Span) -> float | None:
    """Return EKF2's largest height error (m) in a time span without barometer fusion."""
    if "down" not in analysis.axes:
        return None
    errors = compute_position_errors(analysis.axes["down"], "ekf2")
    if isinstance(errors, Unavailable):
        return None
    error_m = errors["error_m"].abs()
    error_in_span_m = error_m.loc[slice(*span_s)]
    largest_error_m = float(error_in_span_m.max())
    other_errors_m = error_m.drop(error_in_span_m.index)
    is_large = largest_error_m > MIN_GAP_ERROR_TO_HEIGHT_RMSE_RATIO * rms(other_errors_m)
    return largest_error_m if is_large else None


def _format_aid_label(aid: AidResult) -> str:
    return f"the {aid.label}" if aid.label in (BAROMETER.label, MAG.label) else aid.label


def _find_shared_sensor_cause(fusion_parameter: str, kf_position_aid: str) -> str:
    """Return SOURCE_SENSOR_CAUSE if an aiding source is from the sensor of KF's positions.

    This is the case if one EKF2 parameter enables the fusion of both. Otherwise, return "".
    """
    if kf_position_aid and AIDS[kf_position_aid].switch == fusion_parameter:
        return SOURCE_SENSOR_CAUSE
    return ""
