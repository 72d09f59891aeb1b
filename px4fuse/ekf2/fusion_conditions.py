"""Conditions for the fusion of vision or GNSS positions in EKF2.

Source: PX4-Autopilot ``src/modules/ekf2``, v1.13.3 to main: ``RingBuffer.h``, ``ev_control.cpp``,
``ev_pos_control.cpp``, ``gnss_checks.cpp`` (``control.cpp``, ``gps_checks.cpp`` before v1.15).
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd

from px4fuse.core.record import Span
from px4fuse.flight.ekf2_parameters import AID_MASK_PARAMETER, Aid
from px4fuse.flight.model import Columns, Ekf2, PositionTrack, sample_step_function

from .intervals import MAX_DELAY_BEHIND_HORIZON_S

# EKF2 starts vision fusion if two samples arrive within this time (s): EV_MAX_INTERVAL
# (ev_control.cpp, PX4 v1.14 and later)
EV_START_INTERVAL_S = 0.2
# EKF2 stops vision fusion after this time (s) without a sample: 2 EV_MAX_INTERVAL
# (ev_pos_control.cpp)
EV_STOP_INTERVAL_S = 0.4
# EKF2 stops GNSS fusion after this time (s) without a sample: reset_timeout_max. Before PX4 v1.14,
# this time also applies to vision
FUSION_STOP_TIMEOUT_S = 7.0
# Maximum delay (s) of EKF2's fusion horizon, if EKF2_DELAY_MAX is not logged
MAX_HORIZON_DELAY_S = 1.0
# Maximum number of position samples in EKF2's buffer
MAX_BUFFERED_POSITIONS = 20
# Tolerance (s) of a sample interval: half of the timestamp resolution of 1 µs
INTERVAL_TOLERANCE_S = 5e-7
# EKF2 stops fusion after it has rejected all samples for this time (s): no_aid_timeout_max
REJECTION_TIMEOUT_S = 1.0
# A coordinate that varies less than this distance (m) counts as not measured
MIN_RANGE_OF_MEASURED_COORDINATE_M = 1e-3
# A GNSS check explains missing GNSS fusion if it fails for at least this fraction of the time
MIN_GNSS_CHECK_FAILURE_FRACTION = 0.1
SET_TIMESTAMP_ACTION = (
    "Set timestamp_sample to the time of measurement in microseconds since the autopilot's boot."
)
CLOCK_SYNCHRONISATION_ACTION = (
    "Synchronise the clocks: set UXRCE_DDS_SYNCT to 1 (uXRCE-DDS agent), or answer MAVLink "
    "TIMESYNC messages. Send timestamps in microseconds."
)
CHECK_SOURCE_ACTION = "Check the position source and its data link."
POSITION_RATE_ACTION = "Send the position at 10 Hz."
EFFECT_OF_TOO_OLD_TIMESTAMPS = "The position timestamps are too old for EKF2."
EFFECT_OF_TIMESTAMPS_AHEAD_OF_CLOCK = "The position timestamps are ahead of EKF2's clock."
# Effect on EKF2 of timestamps in a wrong unit
EFFECT_BY_WRONG_UNIT = {
    **dict.fromkeys(("0", "milliseconds", "seconds"), EFFECT_OF_TOO_OLD_TIMESTAMPS),
    "nanoseconds": EFFECT_OF_TIMESTAMPS_AHEAD_OF_CLOCK,
}
# Effect on EKF2 of unusable timestamps, by their clock or unit
EFFECT_BY_UNUSABLE_TIMESTAMP = {
    **EFFECT_BY_WRONG_UNIT,
    **{
        f"UNIX time in {unit}seconds": EFFECT_OF_TIMESTAMPS_AHEAD_OF_CLOCK
        for unit in ("nano", "micro", "milli")
    },
    **dict.fromkeys(
        ("another clock", "an unknown clock", "UNIX time in seconds"),
        "The position timestamps are too old for EKF2, or ahead of EKF2's clock.",
    ),
}
# GNSS checks in the bit order of gps_check_fail_flags: name, parameter of the limit, unit
GNSS_CHECKS = (
    ("3D fix", "", ""),
    ("number of satellites", "EKF2_REQ_NSATS", ""),
    ("PDOP", "EKF2_REQ_PDOP", ""),
    ("horizontal accuracy", "EKF2_REQ_EPH", " m"),
    ("vertical accuracy", "EKF2_REQ_EPV", " m"),
    ("speed accuracy", "EKF2_REQ_SACC", " m/s"),
    ("horizontal drift at rest", "EKF2_REQ_HDRIFT", " m/s"),
    ("vertical drift at rest", "EKF2_REQ_VDRIFT", " m/s"),
    ("horizontal speed while the vehicle is at rest", "EKF2_REQ_HDRIFT", " m/s"),
    ("vertical speed", "EKF2_REQ_VDRIFT", " m/s"),
    ("spoofing", "", ""),
    ("jamming", "", ""),
)


class UnmetCondition(NamedTuple):
    """Unmet condition for fusion in EKF2: name, fault, explanation and action."""

    condition: str
    fault: str
    reason: str
    action: str


NO_UNMET_CONDITION_LOGGED = UnmetCondition(
    "",
    "",
    "The log does not show why EKF2 fused no position: all logged conditions for fusion are met.",
    "Run `ekf2 status` in the PX4 console to check attitude and position.",
)


@dataclass(frozen=True)
class UnfusedPositions:
    """Positions that EKF2 received but did not fuse in the time span ``unfused_span_s``."""

    ekf2: Ekf2
    source: PositionTrack
    aid: Aid
    parameters: Mapping[str, float]
    unfused_span_s: Span

    @property
    def is_vision(self) -> bool:
        return self.source.origin.is_vision

    @property
    def has_enabling_parameter(self) -> bool:
        """True if the source has its own parameter for fusion (PX4 v1.14 and later)."""
        return self.aid.switch in self.parameters

    @property
    def max_sample_age_s(self) -> float:
        """Maximum age (s) of a sample that EKF2 fuses: the delay of the fusion horizon."""
        horizon_delay_s = self.ekf2.horizon_s
        if isinstance(horizon_delay_s, float):
            return horizon_delay_s
        return 1e-3 * self.parameters.get("EKF2_DELAY_MAX", 1e3 * MAX_HORIZON_DELAY_S)

    @property
    def interval_s(self) -> float:
        return 1.0 / self.source.compute_rate_hz()

    def select_samples(self, samples: pd.DataFrame, lead_time_s: float = 0.0) -> pd.DataFrame:
        """Return the samples in the time span without fusion, and in ``lead_time_s`` (s) before."""
        return samples.loc[self.unfused_span_s[0] - lead_time_s : self.unfused_span_s[1]]

    def compute_status_bit_fraction(self, field_name: str, bit: int = 0) -> float:
        """Return the fraction of the time without fusion in which an EKF2 status bit is set.

        The time without fusion is ``unfused_span_s``. Return NaN if the status field is not logged.
        """
        state_changes = self.ekf2.status_flags.get(field_name)
        if state_changes is None:
            return float("nan")
        state_values = sample_step_function(state_changes, np.linspace(*self.unfused_span_s, 200))
        return float(np.mean(state_values.astype(np.int64) >> bit & 1))


def find_unmet_condition(positions: UnfusedPositions) -> UnmetCondition:
    """Return the first unmet condition for fusion, or NO_UNMET_CONDITION_LOGGED."""
    checks = VISION_FUSION_CHECKS if positions.is_vision else GNSS_FUSION_CHECKS
    return next(
        (unmet for check in checks for unmet in check(positions)), NO_UNMET_CONDITION_LOGGED
    )


def _check_enabling_parameter(positions: UnfusedPositions) -> Iterator[UnmetCondition]:
    """Yield an unmet condition if a parameter disables fusion of the position source."""
    parameter_name, bit = positions.aid.switch, 0
    if not positions.has_enabling_parameter:
        # Before PX4 v1.14, one bit mask enables all sources: bit 0 GNSS, bit 3 vision
        parameter_name = AID_MASK_PARAMETER
        if positions.is_vision:
            bit = 3
    bit_value = 1 << bit
    # Without the parameter in the log, the source is assumed to be enabled
    parameter_value = int(positions.parameters.get(parameter_name, bit_value))
    if parameter_value & bit_value:
        return
    fused_quantity_name = (
        "horizontal position"
        if positions.has_enabling_parameter
        else positions.aid.label.replace(",", "")
    )
    reason = (
        f"Fusion of {fused_quantity_name} is disabled: bit {bit} of {parameter_name} is not set."
    )
    action = f"Set {parameter_name} to {parameter_value | bit_value}."
    # Such a source cannot be fused as a position: the parameter is correct
    if is_height_only(positions.source):
        reason = f"The source contains no horizontal position: x and y are constant. {reason}"
        action = f"Leave bit {bit} of {parameter_name} unset."
    yield UnmetCondition("switch", f"{parameter_name} is {parameter_value}", reason, action)


def find_constant_coordinates(source: PositionTrack) -> list[str]:
    """Return the names of the coordinates (x, y, z) that are constant in all positions."""
    ranges_m = np.ptp(source.samples[Columns.POSITION].to_numpy(), axis=0)
    is_constant = ranges_m < MIN_RANGE_OF_MEASURED_COORDINATE_M
    return [name for name, constant in zip("xyz", is_constant, strict=True) if constant]


def is_height_only(source: PositionTrack) -> bool:
    """Return True if a position source measures only the height: x and y are constant."""
    return {"x", "y"} <= {*find_constant_coordinates(source)}


def _check_position_frame(positions: UnfusedPositions) -> Iterator[UnmetCondition]:
    """Yield an unmet condition if the frame of vision positions is unknown."""
    source = positions.source
    if positions.has_enabling_parameter and (source.frame, source.name) == (
        "unknown",
        "vehicle_visual_odometry",
    ):
        yield UnmetCondition(
            "frame",
            "the pose_frame is unknown",
            "EKF2 (v1.14 and later) reads only the frames NED (1) and FRD (2).",
            "Send pose_frame 1 (x north, y east) or 2 (x forward at start). In MAVLink ODOMETRY, "
            "send frame_id MAV_FRAME_LOCAL_NED or MAV_FRAME_LOCAL_FRD.",
        )


def _check_position_gap(positions: UnfusedPositions) -> Iterator[UnmetCondition]:
    """Yield an unmet condition if a gap of the position source ended the fusion."""
    uses_vision_stop_timeout = positions.is_vision and positions.has_enabling_parameter
    stop_timeout_s = EV_STOP_INTERVAL_S if uses_vision_stop_timeout else FUSION_STOP_TIMEOUT_S
    times_s = positions.source.samples.index.to_numpy()
    start_s, end_s = positions.unfused_span_s
    last_position_time_s = max(times_s[times_s < start_s], default=start_s)
    duration_s = np.min(times_s[times_s >= start_s], initial=end_s) - last_position_time_s
    if duration_s > stop_timeout_s + positions.interval_s:
        yield UnmetCondition(
            "gap",
            f"no position for {duration_s:.1f} s from {last_position_time_s:.1f} s on",
            f"EKF2 stops fusion {stop_timeout_s:g} s after the last position.",
            CHECK_SOURCE_ACTION,
        )


def find_timestamp_action(clock_name: str) -> str:
    """Return the action for timestamps of a wrong clock or in a wrong unit."""
    is_wrong_unit = clock_name in EFFECT_BY_WRONG_UNIT
    return SET_TIMESTAMP_ACTION if is_wrong_unit else CLOCK_SYNCHRONISATION_ACTION


def _check_timestamps(positions: UnfusedPositions) -> Iterator[UnmetCondition]:
    """Yield the unmet conditions of the position timestamps."""
    clock_map, status = positions.source.clock_map, positions.source.status
    if clock_map and (clock := clock_map.clock) in EFFECT_BY_UNUSABLE_TIMESTAMP:
        yield UnmetCondition(
            "clock",
            f"the position timestamps are {'' if clock == '0' else 'in '}{clock}",
            EFFECT_BY_UNUSABLE_TIMESTAMP[clock],
            find_timestamp_action(clock),
        )
    if "age_s" not in status:
        return
    # EKF2 subtracts the delay parameter from the timestamp, so the delay increases the age
    delay_s = positions.parameters.get(positions.aid.delay, 0.0) * 1e-3
    age_s = float(positions.select_samples(status)["age_s"].median()) + delay_s
    if -age_s > MAX_BUFFERED_POSITIONS * positions.interval_s:
        yield UnmetCondition(
            "age",
            f"the timestamps are {-age_s:.2f} s in the future",
            f"EKF2 buffers only {MAX_BUFFERED_POSITIONS} positions. Newer positions overwrite "
            "each position before EKF2 reaches its timestamp.",
            CLOCK_SYNCHRONISATION_ACTION,
        )
    if age_s > positions.max_sample_age_s + MAX_DELAY_BEHIND_HORIZON_S:
        action = CLOCK_SYNCHRONISATION_ACTION
        if age_s < MAX_HORIZON_DELAY_S:
            max_delay_ms = 50.0 * np.ceil(20.0 * age_s)  # next multiple of 50 ms
            action = (
                "Correct a wrong clock of the positioning system. If the positions are "
                f"late, set EKF2_DELAY_MAX to {max_delay_ms:.0f} ms (v1.15 and later)."
            )
        yield UnmetCondition(
            "age",
            f"the positions are {age_s:.2f} s old at arrival",
            f"EKF2 fuses no position older than {positions.max_sample_age_s:.2f} s. "
            "Possible cause: the positions arrive late, or the sender's clock is behind PX4's.",
            action,
        )


def _check_position_quality(positions: UnfusedPositions) -> Iterator[UnmetCondition]:
    """Yield an unmet condition of fusion if the quality of the positions is too small.

    EKF2 fuses positions only if several successive positions have a quality of at least
    EKF2_EV_QMIN.
    """
    min_quality, status = positions.parameters.get("EKF2_EV_QMIN", 0.0), positions.source.status
    if min_quality <= 0.0 or "quality" not in status:
        return
    quality = positions.select_samples(status)["quality"]
    # To start fusion, EKF2 requires the minimum quality of successive samples: from one sample
    # before the fused (delayed) sample to the newest sample. Their number follows from the delay
    sample_count = int(np.ceil(positions.max_sample_age_s / positions.interval_s)) + 2
    has_min_quality = (quality >= min_quality).astype(float)
    have_all_min_quality = has_min_quality.rolling(min(sample_count, max(len(quality), 1))).min()
    if (have_all_min_quality == 1.0).any():
        return
    median_quality = float(quality.median())
    reason = (
        f"{100.0 * (1.0 - has_min_quality.mean()):.0f} % of {len(quality)} positions have a "
        "quality below EKF2_EV_QMIN."
    )
    if quality.any():
        action = (
            "Improve light and texture in the camera view, or fly slower. Set EKF2_EV_QMIN to "
            f"{max(median_quality, 0.0):.0f} only if the positions are correct."
        )
    else:
        reason += " MAVLink VISION_POSITION_ESTIMATE contains no quality, so EKF2 assumes 0."
        action = "Send the quality field of MAVLink ODOMETRY, or set EKF2_EV_QMIN to 0."
    fault = f"the quality is {median_quality:.0f}, below EKF2_EV_QMIN {min_quality:.0f}"
    yield UnmetCondition("quality", fault, reason, action)


def _check_interval(positions: UnfusedPositions) -> Iterator[UnmetCondition]:
    """Yield an unmet condition if vision positions come too seldom to start fusion."""
    intervals_s = np.diff(positions.select_samples(positions.source.samples).index)
    # Reconstructed positions have the rate of the logger, not the rate of the source
    is_interval_known = (
        positions.has_enabling_parameter
        and not positions.source.origin.reconstructed
        and len(intervals_s)
    )
    if is_interval_known and intervals_s.min() >= EV_START_INTERVAL_S - INTERVAL_TOLERANCE_S:
        yield UnmetCondition(
            "interval",
            f"the positions come at {positions.source.compute_rate_hz():.2g} Hz",
            "EKF2 (v1.14 and later) starts to fuse external vision only when two positions come "
            f"within {EV_START_INTERVAL_S:g} s. No parameter changes this minimum rate.",
            POSITION_RATE_ACTION,
        )


def _check_alignment(positions: UnfusedPositions) -> Iterator[UnmetCondition]:
    """Yield an unmet condition for each missing alignment of EKF2: tilt, heading."""
    if positions.compute_status_bit_fraction("tilt_align") < 0.5:
        yield UnmetCondition(
            "alignment",
            "EKF2 has not aligned its tilt",
            "The flag cs_tilt_align is 0. EKF2 fuses no position before the tilt is aligned.",
            "Keep the vehicle at rest after boot until EKF2 is ready.",
        )
    needs_no_heading = (
        positions.is_vision and positions.has_enabling_parameter and positions.source.frame == "FRD"
    )
    if not needs_no_heading and positions.compute_status_bit_fraction("yaw_align") < 0.5:
        actions = ["Calibrate and enable the magnetometer (EKF2_MAG_TYPE 0)"]
        if positions.is_vision:
            actions.append("send a valid orientation and set bit 3 (yaw) of EKF2_EV_CTRL")
        yield UnmetCondition(
            "alignment",
            "EKF2 has not aligned its heading",
            "The flag cs_yaw_align is 0. EKF2 needs a heading to fuse positions relative to north.",
            f"{', or '.join(actions)}.",
        )


def _check_gnss(positions: UnfusedPositions) -> Iterator[UnmetCondition]:
    """Yield the unmet conditions of GNSS: GNSS declared faulty, failed GNSS checks of EKF2."""
    if positions.compute_status_bit_fraction("gnss_fault") > MIN_GNSS_CHECK_FAILURE_FRACTION:
        yield UnmetCondition(
            "fault",
            "EKF2 declared GNSS faulty",
            "The flag cs_gnss_fault is set: GNSS and another position source contradicted each "
            "other for 7 s.",
            "Compare GNSS with the other position source. With EKF2_GPS_MODE 1, EKF2 may reset to "
            "GNSS.",
        )
    parameters = positions.parameters
    # Bit n of EKF2_GPS_CHECK enables check n + 1 of GNSS_CHECKS; check 0 (fix) is always enabled
    checked_mask = int(parameters.get("EKF2_GPS_CHECK", -1)) << 1 | 1
    failed_checks = [
        (fraction, *check)
        for bit, check in enumerate(GNSS_CHECKS)
        if checked_mask >> bit & 1
        and (fraction := positions.compute_status_bit_fraction("failed_checks", bit))
        > MIN_GNSS_CHECK_FAILURE_FRACTION
    ]
    if not failed_checks:
        return
    # Most frequent failures first
    failed_checks.sort(key=lambda check: -check[0])
    check_texts = []
    for fraction, name, parameter, unit in failed_checks[:3]:
        failed_percent = 100.0 * fraction
        limit_text = ""
        if parameter in parameters:
            limit_text = f", limit {parameter} {parameters[parameter]:g}{unit}"
        check_texts.append(f"{name} (check failed {failed_percent:.0f} % of the time{limit_text})")
    yield UnmetCondition(
        "checks",
        f"GNSS fails EKF2's check of the {failed_checks[0][1]}",
        f"Failed checks: {'; '.join(check_texts)}. EKF2 starts to fuse GNSS after "
        f"{parameters.get('EKF2_REQ_GPS_H', 10.0):g} s without a failure.",
        "Give the antenna a free view of the sky, and take off only after EKF2 fuses GNSS.",
    )


def _check_gate(positions: UnfusedPositions) -> Iterator[UnmetCondition]:
    """Yield an unmet condition if EKF2's gate rejects most positions."""
    aid = positions.aid
    aid_log = positions.ekf2.aids.get(aid.name)
    if aid_log is None or "rejected" not in aid_log.samples:
        return
    rejected_fraction = positions.select_samples(aid_log.samples, REJECTION_TIMEOUT_S)[
        "rejected"
    ].mean()
    if rejected_fraction > 0.5:
        yield UnmetCondition(
            "gate",
            f"EKF2 rejects {100.0 * rejected_fraction:.0f} % of the positions",
            "The position innovations exceed EKF2's gate of "
            f"{positions.parameters.get(aid.gate, aid.default_gate):g} √S.",
            f"Check the frame of the positions, {aid.delay} and {aid.noise}. Increase {aid.gate} "
            "only if all three are correct.",
        )


# Checks for external vision, in EKF2's order
VISION_FUSION_CHECKS = (
    _check_enabling_parameter,
    _check_position_frame,
    _check_position_gap,
    _check_timestamps,
    _check_position_quality,
    _check_interval,
    _check_alignment,
    _check_gate,
)
# Checks for GNSS. _check_gnss is first: positions without a fix are not logged and look like a gap
GNSS_FUSION_CHECKS = (
    _check_enabling_parameter,
    _check_gnss,
    _check_position_gap,
    _check_alignment,
    _check_gate,
)
