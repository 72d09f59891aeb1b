"""Faults of EKF2's aiding sources: not fused, σ too small, biased or shifted innovations."""

from collections.abc import Mapping, Sequence

from px4fuse.analysis import Analysis
from px4fuse.comparison.comparison import compute_position_errors
from px4fuse.comparison.flight_events import find_airborne_spans
from px4fuse.core.arrays import rms
from px4fuse.core.record import Span
from px4fuse.core.text import format_number, format_ratio
from px4fuse.ekf2.aids import INNOVATION_MEAN_WINDOW_S, AidResult
from px4fuse.filter.signals import cut_to_segment
from px4fuse.finding import Finding
from px4fuse.findings.model import (
    CAUSE_KEY,
    INNOVATION_CHANGE_CAUSE,
    SOURCE_SENSOR_CAUSE,
    Findings,
    finding,
    format_percent,
    make_note,
    make_warning,
)
from px4fuse.flight.ekf2_parameters import AIDS, BAROMETER, MAG
from px4fuse.flight.model import BAD_ACCELERATION_FLAG, Unavailable

AIDS_TESTED_BY_REPLAY = ("ev_pos", "ev_hgt")
# A pause of barometer fusion is normal up to this time (s) after take-off (ground effect)
GROUND_EFFECT_DURATION_S = 10.0
# Minimum ratio: height error while barometer fusion is paused ÷ height RMSE for the rest of the
# flight
MIN_GAP_ERROR_TO_HEIGHT_RMSE_RATIO = 3.0
# Aiding sources whose vertical innovations EKF2 tests to flag a bad vertical acceleration
AIDS_OF_VERTICAL_ACCELERATION_TEST = ("gnss_vel", "gnss_hgt", "baro_hgt")
# Severity "note" if the flag fs_bad_acc_vertical is set for at most this fraction of the time
MAX_BAD_ACCELERATION_FRACTION_FOR_NOTE = 0.3
# Action for each sensor that EKF2 does not fuse, by PX4 parameter
ACTION_BY_SWITCH = {
    "EKF2_BARO_CTRL": "Shield the barometer from propeller wash and light.",
    "EKF2_GPS_CTRL": "Give the antenna a free view of the sky.",
    "EKF2_RNG_CTRL": "Fly within the range of the distance sensor.",
    "EKF2_OF_CTRL": "Fly over a textured and lit floor.",
    "EKF2_MAG_TYPE": "Mount the magnetometer away from motors and power cables.",
    "EKF2_EV_CTRL": "Check the position source and its data link.",
}
DEFAULT_ACTION = "Check mounting and power supply of the sensor."


def detect(analysis: Analysis) -> Findings:
    """Detect faults of EKF2's aiding sources."""
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
    cause = "Normal noise can set this flag (fs_bad_acc_vertical) for some seconds."
    remedy = "If the flag stays set, check the IMU for vibration and clipping."
    if too_small_noises:
        parameters_text = " and ".join(sorted(too_small_noises))
        cause = f"The measurement noise is set too small: {parameters_text}."
        remedy = f"Increase {parameters_text} to the true noise of the sensor."
    flagged_fraction = float(is_flagged_bad.mean())
    start_s = float(state_times_s[is_flagged_bad.argmax()])
    yield finding(
        "warning" if flagged_fraction > MAX_BAD_ACCELERATION_FRACTION_FOR_NOTE else "note",
        "ekf2_acceleration_bad",
        f"EKF2 flags its vertical acceleration as bad for {format_percent(flagged_fraction)} of "
        f"the time, first at {start_s:.0f} s. Barometer and GNSS both measure a larger height than "
        f"EKF2 estimates. {cause}",
        remedy,
        {"fraction": flagged_fraction, "start_s": start_s},
    )


def detect_aid_faults(
    aids: Mapping[str, AidResult],
    source_aid: str = "",
    take_off_times_s: Sequence[float] = (),
    height_error_m: float | None = None,
) -> Findings:
    """Detect faults of EKF2's aiding sources.

    ``source_aid`` is the aiding source that also gives KF's positions. ``height_error_m`` is EKF2's
    height error in a barometer gap.
    """
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
        yield _make_not_fused_finding(fusion_parameter, aids_of_sensor, source_aid, height_error_m)
    for name, aid in aids_to_test.items():
        sensor_cause = _find_source_sensor_cause(AIDS[name].switch, source_aid)
        if not sensor_cause and any(result.change for result in aid.axes.values()):
            yield _make_innovation_change_finding(name, aid)
        elif aid.verdict == "overconfident" and name != source_aid:
            yield _make_overconfident_finding(name, aid, sensor_cause)
        elif aid.verdict == "biased":
            yield _make_innovation_bias_finding(name, aid)


def _make_not_fused_finding(
    fusion_parameter: str,
    aids_of_sensor: list[AidResult],
    source_aid: str,
    height_error_m: float | None,
) -> Finding:
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
            CAUSE_KEY: _find_source_sensor_cause(fusion_parameter, source_aid)
            or (INNOVATION_CHANGE_CAUSE if has_innovation_shift else ""),
        },
        (aid_with_longest_gap.longest_gap_s,),
    )


def _make_innovation_change_finding(name: str, aid: AidResult) -> Finding:
    changes = [(result.change, axis) for axis, result in aid.axes.items() if result.change]
    (time_s, mean_change), axis = max(changes, key=lambda item: abs(item[0][1]))
    innovation_sigma = aid.axes[axis].s_sqrt_median
    return make_warning(
        "aid_innovation_shift",
        f"The mean {axis} innovation of {_format_aid_label(aid)} shifts by "
        f"{format_number(abs(mean_change) * innovation_sigma, 2)} {aid.unit} at {time_s:.0f} s "
        f"({abs(mean_change):.1f} times √S of {format_number(innovation_sigma, 2)} {aid.unit}).",
        f"Check which device near the sensor was switched or moved at {time_s:.0f} s.",
        {"aid": name, "axis": axis, "time_s": time_s, "moved": mean_change},
        ((time_s, time_s + INNOVATION_MEAN_WINDOW_S),),
    )


def _make_overconfident_finding(name: str, aid: AidResult, sensor_cause: str) -> Finding:
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
    if "down" not in analysis.axes:
        return None
    errors = compute_position_errors(analysis.axes["down"], "ekf2")
    if isinstance(errors, Unavailable):
        return None
    error_m = errors["error_m"].abs()
    is_in_span = (error_m.index >= span_s[0]) & (error_m.index <= span_s[1])
    largest_error_m = float(error_m[is_in_span].max())
    is_large = largest_error_m > MIN_GAP_ERROR_TO_HEIGHT_RMSE_RATIO * rms(error_m[~is_in_span])
    return largest_error_m if is_large else None


def _format_aid_label(aid: AidResult) -> str:
    return f"the {aid.label}" if aid.label in (BAROMETER.label, MAG.label) else aid.label


def _find_source_sensor_cause(fusion_parameter: str, source_aid: str) -> str:
    """Return SOURCE_SENSOR_CAUSE if the parameter enables the sensor of KF's positions, else ""."""
    return SOURCE_SENSOR_CAUSE if source_aid and AIDS[source_aid].switch == fusion_parameter else ""
