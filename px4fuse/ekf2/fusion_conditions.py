"""Checks by which EKF2 decides to fuse positions of external vision or GNSS.

Source: PX4-Autopilot ``src/modules/ekf2``, v1.13.3 to main: ``RingBuffer.h``, ``ev_control.cpp``,
``ev_pos_control.cpp``, ``gnss_checks.cpp`` (``control.cpp``, ``gps_checks.cpp`` before v1.15).
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd

from px4fuse.core.record import Span
from px4fuse.ekf2.intervals import MAX_LATENESS_S
from px4fuse.flight.ekf2_parameters import AID_MASK_PARAMETER, Aid
from px4fuse.flight.model import Columns, Ekf2, PositionTrack, step_values_at

# EKF2 starts vision fusion if two samples arrive within this time (s): EV_MAX_INTERVAL of PX4 v1.14
# and later (ev_control.cpp)
EV_START_INTERVAL_S = 0.2
# EKF2 stops vision fusion after this time (s) without a sample: 2 EV_MAX_INTERVAL
# (ev_pos_control.cpp)
EV_STOP_INTERVAL_S = 0.4
# EKF2 stops GNSS fusion, and before v1.14 vision fusion, after this time (s): reset_timeout_max
FUSION_STOP_S = 7.0
# Maximum delay (s) of EKF2's fusion horizon, if the log does not contain EKF2_DELAY_MAX
MAX_HORIZON_S = 1.0
# Maximum number of position samples in EKF2's buffer
BUFFER_COUNT = 20
# Tolerance (s) of a sample interval: half of the timestamp resolution of 1 µs
INTERVAL_TOLERANCE_S = 5e-7
# EKF2 stops fusion after it has rejected all samples for this time (s): no_aid_timeout_max
MAX_REJECTED_S = 1.0
# x and y are not measured if their range (m) is smaller
MAX_CONSTANT_RANGE_M = 1e-3
# A GNSS check explains missing GNSS fusion if it fails for at least this fraction of the time
MIN_FAILED_FRACTION = 0.1
SET_TIMESTAMP_ACTION = (
    "Set timestamp_sample to the time of measurement in microseconds since the autopilot's boot."
)
SYNCHRONISE_ACTION = (
    "Synchronise the clocks: UXRCE_DDS_SYNCT 1 with the uXRCE-DDS agent, or answer TIMESYNC of "
    "MAVLink. Send microseconds."
)
# Age of the positions for EKF2, by the wrong clock of their timestamps
AGE_BY_WRONG_CLOCK = {
    **dict.fromkeys(
        ("another clock", "an unknown clock", "UNIX time in seconds"), "too old or in the future"
    ),
    **{f"UNIX time in {unit}seconds": "in the future" for unit in ("nano", "micro", "milli")},
}
# Age of the positions for EKF2, by the wrong clock or unit of their timestamps
AGE_BY_WRONG_TIMESTAMP = {
    **dict.fromkeys(("0", "milliseconds", "seconds"), "too old"),
    **AGE_BY_WRONG_CLOCK,
    "nanoseconds": "in the future",
}
# GNSS checks in the order of their bits in gps_check_fail_flags: name, parameter with the limit,
# unit of the limit
GNSS_CHECKS = (
    ("3D fix", "", ""),
    ("number of satellites", "EKF2_REQ_NSATS", ""),
    ("PDOP", "EKF2_REQ_PDOP", ""),
    ("horizontal accuracy", "EKF2_REQ_EPH", " m"),
    ("vertical accuracy", "EKF2_REQ_EPV", " m"),
    ("speed accuracy", "EKF2_REQ_SACC", " m/s"),
    ("horizontal drift at rest", "EKF2_REQ_HDRIFT", " m/s"),
    ("vertical drift at rest", "EKF2_REQ_VDRIFT", " m/s"),
    ("horizontal speed at rest", "EKF2_REQ_HDRIFT", " m/s"),
    ("vertical speed", "EKF2_REQ_VDRIFT", " m/s"),
    ("spoofing", "", ""),
    ("jamming", "", ""),
)


class UnmetCondition(NamedTuple):
    """Condition for fusion in EKF2 that is not met: name, fault, explanation, and action."""

    condition: str
    fault: str
    reason: str
    action: str


UNKNOWN_CONDITION = UnmetCondition(
    "",
    "",
    "The log does not contain the reason: the logged conditions of EKF2 are met.",
    "Check `ekf2 status` in the console of PX4.",
)


@dataclass(frozen=True)
class FusionAttempt:
    """Positions that EKF2 received but did not fuse in the time span ``span_s``."""

    ekf2: Ekf2
    source: PositionTrack
    aid: Aid
    parameters: Mapping[str, float]
    span_s: Span

    @property
    def is_vision(self) -> bool:
        return self.source.origin.is_vision

    @property
    def has_switch(self) -> bool:
        """True if a parameter of this source alone enables its fusion (PX4 v1.14 and later)."""
        return self.aid.switch in self.parameters

    @property
    def horizon_s(self) -> float:
        """Maximum age (s) of buffered samples: EKF2_DELAY_MAX, or MAX_HORIZON_S if not logged."""
        horizon_s = self.ekf2.horizon_s
        limit_s = 1e-3 * self.parameters.get("EKF2_DELAY_MAX", 1e3 * MAX_HORIZON_S)
        return horizon_s if isinstance(horizon_s, float) else limit_s

    @property
    def interval_s(self) -> float:
        return 1.0 / self.source.compute_rate_hz()

    def samples_in_span(self, samples: pd.DataFrame, before_s: float = 0.0) -> pd.DataFrame:
        """Return the samples from ``before_s`` (s) before ``span_s`` to the end of ``span_s``."""
        return samples.loc[self.span_s[0] - before_s : self.span_s[1]]

    def fraction_set(self, state: str, bit: int = 0) -> float:
        """Return the fraction of ``span_s`` in which a status bit is set; NaN if not logged."""
        state_changes = self.ekf2.states.get(state)
        if state_changes is None:
            return float("nan")
        state_values = step_values_at(state_changes, np.linspace(*self.span_s, 200))
        return float(np.mean(state_values.astype(np.int64) >> bit & 1))


def find_unmet(attempt: FusionAttempt) -> UnmetCondition:
    """Return the first condition for fusion that is not met; UNKNOWN_CONDITION if all are met."""
    conditions = VISION_CONDITIONS if attempt.is_vision else GNSS_CONDITIONS
    return next((unmet for check in conditions for unmet in check(attempt)), UNKNOWN_CONDITION)


def _check_switch(attempt: FusionAttempt) -> Iterator[UnmetCondition]:
    parameter_name, bit = attempt.aid.switch, 0
    if not attempt.has_switch:
        parameter_name, bit = AID_MASK_PARAMETER, 3 if attempt.is_vision else 0
    parameter_value = int(attempt.parameters.get(parameter_name, 1 << bit))
    if parameter_value >> bit & 1:
        return
    fused_quantity = (
        "horizontal position" if attempt.has_switch else attempt.aid.label.replace(",", "")
    )
    reason = f"Bit {bit} ({fused_quantity}) of {parameter_name} is not set."
    action = f"Set {parameter_name} to {parameter_value | 1 << bit}."
    if is_height_only(attempt.source):
        reason = f"The source contains no horizontal position: x and y are constant. {reason}"
        action = f"Leave bit {bit} of {parameter_name} unset."
    yield UnmetCondition("switch", f"{parameter_name} is {parameter_value}", reason, action)


def constant_coordinates(source: PositionTrack) -> list[str]:
    """Return the coordinates (x, y, z) that a position source does not measure: constant values."""
    ranges_m = np.ptp(source.samples[Columns.POSITION].to_numpy(), axis=0)
    is_constant = ranges_m < MAX_CONSTANT_RANGE_M
    return [name for name, constant in zip("xyz", is_constant, strict=True) if constant]


def is_height_only(source: PositionTrack) -> bool:
    """Return True if a position source measures only the height: x and y are constant."""
    return {"x", "y"} <= {*constant_coordinates(source)}


def _check_frame(attempt: FusionAttempt) -> Iterator[UnmetCondition]:
    source = attempt.source
    if attempt.has_switch and (source.frame, source.name) == ("unknown", "vehicle_visual_odometry"):
        yield UnmetCondition(
            "frame",
            "the pose_frame is unknown",
            "EKF2 (v1.14 and later) reads positions only in the frames NED (1) and FRD (2).",
            "Send pose_frame 1 (x north, y east) or 2 (x forward at start); in MAVLink ODOMETRY "
            "the frame_id MAV_FRAME_LOCAL_NED or MAV_FRAME_LOCAL_FRD.",
        )


def _check_position_gap(attempt: FusionAttempt) -> Iterator[UnmetCondition]:
    has_short_timeout = attempt.is_vision and attempt.has_switch
    stop_timeout_s = EV_STOP_INTERVAL_S if has_short_timeout else FUSION_STOP_S
    times_s = attempt.source.samples.index.to_numpy()
    start_s, end_s = attempt.span_s
    # EKF2 stops fusion if no position arrives for stop_timeout_s
    last_position_s = max(times_s[times_s < start_s], default=start_s)
    duration_s = np.min(times_s[times_s >= start_s], initial=end_s) - last_position_s
    if duration_s > stop_timeout_s + attempt.interval_s:
        yield UnmetCondition(
            "gap",
            f"no position for {duration_s:.1f} s from {last_position_s:.1f} s on",
            f"EKF2 stops fusion {stop_timeout_s:g} s after the last position.",
            "Check the position source and its data link.",
        )


def _check_timestamps(attempt: FusionAttempt) -> Iterator[UnmetCondition]:
    clock_map, status = attempt.source.clock_map, attempt.source.status
    if clock_map and (clock := clock_map.clock) in AGE_BY_WRONG_TIMESTAMP:
        yield UnmetCondition(
            "clock",
            "the timestamps are " + ("0" if clock == "0" else f"in {clock}"),
            "EKF2 reads timestamp_sample in microseconds since the autopilot's boot. For EKF2 the "
            f"positions are {AGE_BY_WRONG_TIMESTAMP[clock]}.",
            SYNCHRONISE_ACTION if clock in AGE_BY_WRONG_CLOCK else SET_TIMESTAMP_ACTION,
        )
    if "age_s" not in status:
        return
    # EKF2 subtracts the delay from each timestamp; age_s is arrival time minus timestamp
    delay_s = attempt.parameters.get(attempt.aid.delay, 0.0) * 1e-3
    age_s = float(attempt.samples_in_span(status)["age_s"].median()) + delay_s
    if -age_s > BUFFER_COUNT * attempt.interval_s:
        yield UnmetCondition(
            "age",
            f"the timestamps are {-age_s:.2f} s in the future",
            f"EKF2 waits until this time, but buffers only {BUFFER_COUNT} positions.",
            SYNCHRONISE_ACTION,
        )
    if age_s > attempt.horizon_s + MAX_LATENESS_S:
        action = SYNCHRONISE_ACTION
        if age_s < MAX_HORIZON_S:
            max_delay_ms = 50.0 * np.ceil(20.0 * age_s)  # rounded up to a multiple of 50 ms
            action = (
                "Check the clock of the positioning system. Then set EKF2_DELAY_MAX to "
                f"{max_delay_ms:.0f} ms (v1.15 and later)."
            )
        yield UnmetCondition(
            "age",
            f"the positions are {age_s:.2f} s old at arrival",
            f"EKF2 buffers only {attempt.horizon_s:.2f} s. Timestamps that are too early have the "
            "same effect.",
            action,
        )


def _check_quality(attempt: FusionAttempt) -> Iterator[UnmetCondition]:
    min_quality, status = attempt.parameters.get("EKF2_EV_QMIN", 0.0), attempt.source.status
    if min_quality <= 0.0 or "quality" not in status:
        return
    quality = attempt.samples_in_span(status)["quality"]
    # EKF2 checks the quality of the fused sample, of the sample before it, and of the newest sample
    # in the buffer
    sample_count = int(np.ceil(attempt.horizon_s / attempt.interval_s)) + 2
    is_good = (quality >= min_quality).astype(float)
    if is_good.rolling(min(sample_count, max(len(quality), 1))).min().max() == 1.0:
        return
    median_quality = float(quality.median())
    reason = (
        f"{100.0 * (1.0 - is_good.mean()):.0f} % of {len(quality)} positions are below the limit."
    )
    action = (
        "Improve light and texture in the camera view, or fly slower. Set EKF2_EV_QMIN to "
        f"{max(median_quality, 0.0):.0f} only if the positions are correct."
    )
    if not quality.any():
        reason = f"{reason} MAVLink VISION_POSITION_ESTIMATE has no quality; EKF2 then uses 0."
        action = "Send the quality with MAVLink ODOMETRY, or set EKF2_EV_QMIN to 0."
    fault = f"the quality is {median_quality:.0f}, below EKF2_EV_QMIN {min_quality:.0f}"
    yield UnmetCondition("quality", fault, reason, action)


def _check_interval(attempt: FusionAttempt) -> Iterator[UnmetCondition]:
    intervals_s = np.diff(attempt.samples_in_span(attempt.source.samples).index)
    # Positions that are reconstructed from EKF2 topics have the rate of the logger
    is_interval_known = (
        attempt.has_switch and not attempt.source.origin.reconstructed and len(intervals_s)
    )
    if is_interval_known and intervals_s.min() >= EV_START_INTERVAL_S - INTERVAL_TOLERANCE_S:
        yield UnmetCondition(
            "interval",
            f"the positions come at {attempt.source.compute_rate_hz():.2g} Hz",
            f"The interval between positions is {attempt.interval_s:.2f} s. EKF2 (v1.14 and later) "
            "starts to fuse external vision only when two positions come within "
            f"{EV_START_INTERVAL_S:g} s. No parameter changes this limit.",
            "Send the position at 10 Hz.",
        )


def _check_alignment(attempt: FusionAttempt) -> Iterator[UnmetCondition]:
    if attempt.fraction_set("tilt_align") < 0.5:
        yield UnmetCondition(
            "alignment",
            "EKF2 has not aligned its tilt",
            "The flag cs_tilt_align is 0. EKF2 fuses no position before the tilt is aligned.",
            "Keep the vehicle at rest after boot until EKF2 is ready.",
        )
    needs_no_heading = attempt.is_vision and attempt.has_switch and attempt.source.frame == "FRD"
    if not needs_no_heading and attempt.fraction_set("yaw_align") < 0.5:
        actions = ["Calibrate and enable the magnetometer (EKF2_MAG_TYPE 0)"]
        if attempt.is_vision:
            actions.append("send a valid orientation and set bit 3 (yaw) of EKF2_EV_CTRL")
        yield UnmetCondition(
            "alignment",
            "EKF2 has not aligned its heading",
            "The flag cs_yaw_align is 0. EKF2 needs a heading to fuse positions relative to north.",
            f"{', or '.join(actions)}.",
        )


def _check_gnss(attempt: FusionAttempt) -> Iterator[UnmetCondition]:
    if attempt.fraction_set("gnss_fault") > MIN_FAILED_FRACTION:
        yield UnmetCondition(
            "fault",
            "EKF2 declared GNSS faulty",
            "The flag cs_gnss_fault is set: GNSS and another position source contradicted each "
            "other for 7 s.",
            "Compare both sources. EKF2_GPS_MODE 1 permits a reset to GNSS.",
        )
    parameters, source = attempt.parameters, attempt.source
    # Bit n of EKF2_GPS_CHECK enables the check of bit n + 1; bit 0, the fix, is always checked
    checked_mask = int(parameters.get("EKF2_GPS_CHECK", -1)) << 1 | 1
    failed_fractions = {
        bit: attempt.fraction_set("failed_checks", bit) for bit in range(len(GNSS_CHECKS))
    }
    failed_bits = [
        bit
        for bit in failed_fractions
        if checked_mask >> bit & 1 and failed_fractions[bit] > MIN_FAILED_FRACTION
    ]
    if not failed_bits:
        return
    failed_bits.sort(key=lambda bit: -failed_fractions[bit])
    samples = attempt.samples_in_span(source.samples)
    reported_variances = {3: samples["north_m2"], 4: samples["down_m2"]}
    if source.velocity is not None:
        reported_variances[5] = attempt.samples_in_span(source.velocity)["north_m2_s2"]
    check_texts = []
    for bit in failed_bits[:3]:
        name, parameter, unit = GNSS_CHECKS[bit]
        check_details = [f"{100.0 * failed_fractions[bit]:.0f} % of the time"]
        if np.isfinite(limit := parameters.get(parameter, np.nan)):
            # Positions without a fix are not in the samples, so the median may be below the limit
            if bit in reported_variances:
                median_value = float(np.sqrt(reported_variances[bit].median()))
                if median_value > limit:
                    check_details.append(f"median {median_value:.2f}{unit}")
            check_details.append(f"limit {parameter} {limit:g}{unit}")
        check_texts.append(f"{name} ({', '.join(check_details)})")
    yield UnmetCondition(
        "checks",
        f"GNSS fails EKF2's check of the {GNSS_CHECKS[failed_bits[0]][0]}",
        f"Failed checks: {'; '.join(check_texts)}. EKF2 starts to fuse GNSS after "
        f"{parameters.get('EKF2_REQ_GPS_H', 10.0):g} s without a failure.",
        "Give the antenna a free view of the sky, and take off only after EKF2 fuses GNSS.",
    )


def _check_gate(attempt: FusionAttempt) -> Iterator[UnmetCondition]:
    aid = attempt.aid
    aid_log = attempt.ekf2.aids.get(aid.name)
    if aid_log is None or "rejected" not in aid_log.samples:
        return
    rejected_fraction = attempt.samples_in_span(aid_log.samples, MAX_REJECTED_S)["rejected"].mean()
    if rejected_fraction > 0.5:
        yield UnmetCondition(
            "gate",
            f"EKF2 rejects {100.0 * rejected_fraction:.0f} % of the positions",
            "The innovations are beyond EKF2's gate of "
            f"{attempt.parameters.get(aid.gate, aid.default_gate):g} √S.",
            f"Check the frame of the positions, {aid.delay} and {aid.noise}. Increase {aid.gate} "
            "only if all three are correct.",
        )


# Checks for external vision, in EKF2's order
VISION_CONDITIONS = (
    _check_switch,
    _check_frame,
    _check_position_gap,
    _check_timestamps,
    _check_quality,
    _check_interval,
    _check_alignment,
    _check_gate,
)
# Checks for GNSS. _check_gnss is before _check_position_gap, because positions without a fix are
# not logged and look like a gap
GNSS_CONDITIONS = (_check_switch, _check_gnss, _check_position_gap, _check_alignment, _check_gate)
