"""Faults of EKF2's aiding sources: not fused, σ too small, biased or shifted innovations."""

from collections.abc import Mapping, Sequence

import numpy as np

from px4fuse.analysis import Analysis
from px4fuse.comparison.comparison import position_errors
from px4fuse.comparison.flight_events import airborne_spans
from px4fuse.core.record import Span
from px4fuse.core.text import format_number, format_ratio
from px4fuse.ekf2.aids import CHANGE_WINDOW_S, AidResult
from px4fuse.finding import Finding
from px4fuse.findings.cause_grouping import CAUSE, CHANGE, SENSOR
from px4fuse.findings.model import Findings, finding, format_percent, note, warning
from px4fuse.flight.ekf2_parameters import AIDS, BAROMETER, MAG
from px4fuse.flight.model import BAD_ACCELERATION_FLAG, Unavailable

# Aiding sources of external vision, which other modules test by replays of EKF2
AIDS_OF_OTHER_DETECTORS = ("ev_pos", "ev_hgt")
# Time (s) after take-off in which EKF2 may ignore the barometer because of ground effect
TAKE_OFF_S = 10.0
# EKF2's height error in a barometer gap is reported if largest error / height RMSE outside the gap
# is larger
MIN_HEIGHT_ERROR_RATIO = 3.0
# Aiding sources whose vertical innovations can set EKF2's flag for a bad vertical acceleration
VERTICAL_AIDS = ("gnss_vel", "gnss_hgt", "baro_hgt")
# Maximum fraction of the time with EKF2's flag for a bad vertical acceleration, for severity note;
# above: severity warning
MAX_BAD_FRACTION_NOTE = 0.3
# Action if EKF2 does not fuse a sensor, by the PX4 parameter that enables its fusion
CHECKS = {
    "EKF2_BARO_CTRL": "Shield the barometer from propeller wash and light.",
    "EKF2_GPS_CTRL": "Give the antenna a free view of the sky.",
    "EKF2_RNG_CTRL": "Fly within the range of the distance sensor.",
    "EKF2_OF_CTRL": "Fly over a textured and lit floor.",
    "EKF2_MAG_TYPE": "Mount the magnetometer away from motors and power cables.",
    "EKF2_EV_CTRL": "Check the position source and its data link.",
}
DEFAULT_CHECK = "Check mounting and power supply of the sensor."


def detect(analysis: Analysis) -> Findings:
    """Detect faults of EKF2's aiding sources."""
    if isinstance(analysis.aids, Unavailable):
        return
    aid = analysis.source.origin.aid
    take_off_s = [start_s for start_s, _ in airborne_spans(analysis.flight)]
    barometer = analysis.aids.get(BAROMETER.name)
    height_error_m = _large_height_error_m(analysis, barometer.longest_gap_s) if barometer else None
    yield from detect_in_aids(analysis.aids, aid.name if aid else "", take_off_s, height_error_m)
    yield from detect_bad_acceleration(analysis, analysis.aids)


def detect_bad_acceleration(analysis: Analysis, aids: Mapping[str, AidResult]) -> Findings:
    """Detect that EKF2 flagged its vertical acceleration as bad."""
    ekf2 = analysis.flight.ekf2
    if isinstance(ekf2, Unavailable) or isinstance(ekf2.record, Unavailable):
        return
    state_times_s = ekf2.state.index.to_numpy()
    state_times_s = state_times_s[
        (state_times_s >= analysis.segment.start_s) & (state_times_s <= analysis.segment.end_s)
    ]
    is_bad = ekf2.record.was_in_state(BAD_ACCELERATION_FLAG, state_times_s)
    if not is_bad.any():
        return
    small_noise_parameters = {
        AIDS[name].noise
        for name in VERTICAL_AIDS
        if name in aids and aids[name].verdict == "overconfident"
    }
    cause = "Normal measurement noise can cause this for some seconds."
    remedy = "If it lasts longer, check the IMU for vibration and clipping."
    if small_noise_parameters:
        cause = "EKF2's noise parameters of these sensors are too small."
        remedy = f"Increase {' and '.join(sorted(small_noise_parameters))} to the true noise."
    bad_fraction, start_s = float(is_bad.mean()), float(state_times_s[is_bad.argmax()])
    yield finding(
        "warning" if bad_fraction > MAX_BAD_FRACTION_NOTE else "note",
        "ekf2_acceleration_bad",
        f"EKF2 flags its vertical acceleration as bad for {format_percent(bad_fraction)} of the "
        f"time, first at {start_s:.0f} s. Barometer and GNSS both measure a larger height than "
        f"EKF2 estimates. {cause}",
        remedy,
        {"fraction": bad_fraction, "start_s": start_s},
    )


def detect_in_aids(
    aids: Mapping[str, AidResult],
    source_aid: str = "",
    take_off_s: Sequence[float] = (),
    height_error_m: float | None = None,
) -> Findings:
    """Detect faults of EKF2's aiding sources.

    ``source_aid`` is the aiding source whose positions KF uses, ``take_off_s`` are the times (s) of
    take-off, ``height_error_m`` is EKF2's height error in a barometer gap, if large.
    """
    tested_aids = {name: aid for name, aid in aids.items() if name not in AIDS_OF_OTHER_DETECTORS}
    unfused_aids_by_switch: dict[str, list[AidResult]] = {}
    for name, aid in tested_aids.items():
        is_take_off_gap = name == BAROMETER.name and any(
            start <= aid.longest_gap_s[0] <= start + TAKE_OFF_S for start in take_off_s
        )
        if aid.verdict == "not_fused" and not is_take_off_gap:
            unfused_aids_by_switch.setdefault(AIDS[name].switch or name, []).append(aid)
    for switch, aids_of_sensor in unfused_aids_by_switch.items():
        yield _not_fused_finding(switch, aids_of_sensor, source_aid, height_error_m)
    for name, aid in tested_aids.items():
        sensor_cause = _sensor_cause(AIDS[name].switch, source_aid)
        if not sensor_cause and any(result.change for result in aid.axes.values()):
            yield _innovation_shift_finding(name, aid)
        elif aid.verdict == "overconfident" and name != source_aid:
            yield _overconfident_finding(name, aid, sensor_cause)
        elif aid.verdict == "biased":
            yield _biased_finding(name, aid)


def _not_fused_finding(
    switch: str, aids_of_sensor: list[AidResult], source_aid: str, height_error_m: float | None
) -> Finding:
    longest_unfused = max(aids_of_sensor, key=lambda aid: aid.longest_gap_duration_s)
    aid_labels = ", ".join(_aid_label(aid) for aid in aids_of_sensor)
    has_innovation_shift = any(axis.change for aid in aids_of_sensor for axis in aid.axes.values())
    is_barometer, height_error_text = switch == BAROMETER.switch, ""
    if is_barometer and height_error_m is not None:
        height_error_text = f": EKF2's height error is {height_error_m:.2f} m"
    return finding(
        "note" if is_barometer and not height_error_text else "warning",
        "aid_not_fused",
        f"EKF2 fused no sample of {aid_labels} for "
        f"{longest_unfused.longest_gap_duration_s:.0f} s{height_error_text}. EKF2 rejected "
        f"{format_percent(longest_unfused.rejected_fraction)} of the samples, and relied on "
        "the IMU and other aiding sources.",
        CHECKS.get(switch, DEFAULT_CHECK),
        {
            "aid": aid_labels,
            "longest_gap_s": longest_unfused.longest_gap_duration_s,
            "rejected_fraction": longest_unfused.rejected_fraction,
            CAUSE: _sensor_cause(switch, source_aid) or (CHANGE if has_innovation_shift else ""),
        },
        (longest_unfused.longest_gap_s,),
    )


def _innovation_shift_finding(name: str, aid: AidResult) -> Finding:
    label = _aid_label(aid)
    shifts_by_axis = {axis: result.change for axis, result in aid.axes.items() if result.change}
    axis, (time_s, mean_change) = max(shifts_by_axis.items(), key=lambda item: abs(item[1][1]))
    s_sqrt = aid.axes[axis].s_sqrt_median
    return warning(
        "aid_innovation_shift",
        f"{label}: the {axis} innovation shifts by {format_number(abs(mean_change) * s_sqrt, 2)} "
        f"{aid.unit} at {time_s:.0f} s. The mean innovation before and after differs by "
        f"{abs(mean_change):.1f} √S (√S {format_number(s_sqrt, 2)} {aid.unit}).",
        f"Check what was switched, moved or passed near the sensor at {time_s:.0f} s.",
        {"aid": name, "axis": axis, "time_s": time_s, "moved": mean_change},
        ((time_s, time_s + CHANGE_WINDOW_S),),
    )


def _overconfident_finding(name: str, aid: AidResult, sensor_cause: str) -> Finding:
    # No noise value is proposed, because innovations alone do not distinguish noise from a
    # wrong delay
    action = "correct the accuracy that the sensor reports"
    if noise_parameter := AIDS[name].noise:
        action = f"increase {noise_parameter}"
    noise_text = ""
    if aid.noise is not None:
        noise_text = f" ({format_number(aid.noise)} {aid.unit}, from {aid.noise_from})"
    return warning(
        "aid_overconfident",
        f"EKF2 is overconfident about {_aid_label(aid)}: σ is {format_ratio(aid.nis_mean**0.5)} "
        f"times too small. The mean NIS is {format_number(aid.nis_mean)} (expected 1). "
        f"EKF2 rejects {format_percent(aid.rejected_fraction)} of the samples. Possible "
        f"causes: errors of this sensor larger than its √R{noise_text}, or errors of "
        "another sensor.",
        f"Check delay and mounting of the sensor first. Then {action}.",
        {
            "aid": name,
            "nis_mean": aid.nis_mean,
            "rejected_fraction": aid.rejected_fraction,
            CAUSE: sensor_cause,
        },
    )


def _biased_finding(name: str, aid: AidResult) -> Finding:
    axis, worst_axis = max(
        aid.axes.items(), key=lambda item: abs(item[1].mean_normalised_innovation)
    )
    return note(
        "aid_innovation_bias",
        f"{_aid_label(aid)}: the {axis} innovation has a mean of "
        f"{format_number(worst_axis.innovation_mean)} {aid.unit} (√S "
        f"{format_number(worst_axis.s_sqrt_median)} {aid.unit}). This aiding source "
        "contradicts another one.",
        "Calibrate the sensor. Changed noise settings do not correct a bias.",
        {
            "aid": name,
            "axis": axis,
            "innovation_mean": worst_axis.innovation_mean,
            "s_sqrt_median": worst_axis.s_sqrt_median,
        },
    )


def _large_height_error_m(analysis: Analysis, span_s: Span) -> float | None:
    down_comparison = analysis.axes.get("down")
    errors = None if down_comparison is None else position_errors(down_comparison, "ekf2")
    if errors is None or isinstance(errors, Unavailable):
        return None
    error_m = errors["error_m"].abs()
    is_in_span = (error_m.index >= span_s[0]) & (error_m.index <= span_s[1])
    rmse_outside_m = float(np.sqrt(np.mean(error_m[~is_in_span] ** 2)))
    largest_error_m = float(error_m[is_in_span].max())
    return largest_error_m if largest_error_m > MIN_HEIGHT_ERROR_RATIO * rmse_outside_m else None


def _aid_label(aid: AidResult) -> str:
    return f"the {aid.label}" if aid.label in (BAROMETER.label, MAG.label) else aid.label


def _sensor_cause(switch: str, source_aid: str) -> str:
    return SENSOR if source_aid and AIDS[source_aid].switch == switch else ""
