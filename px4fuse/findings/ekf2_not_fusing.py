"""Detect positions that EKF2 does not fuse or fuses late, and an invalid EKF2 position."""

import numpy as np
import pandas as pd

from px4fuse.comparison.model import Comparison, PreparedComparison
from px4fuse.core.record import Span
from px4fuse.core.text import format_metres
from px4fuse.ekf2.fusion_conditions import (
    EV_START_INTERVAL_S,
    EV_STOP_INTERVAL_S,
    UnfusedPositions,
    find_unmet_condition,
    is_height_only,
)
from px4fuse.findings.model import (
    Findings,
    compute_flag_fraction,
    find_spans_with_value,
    finding,
    format_percent,
    make_note,
    make_warning,
)
from px4fuse.flight.model import (
    POSITION_FILE_ORIGIN,
    Ekf2,
    PositionTrack,
    Truth,
    Unavailable,
    positions_phrase,
)

# Severity "error" if EKF2 fuses the positions for less than this fraction of the time
FUSED_FRACTION_FOR_ERROR = 0.5
# Warning if EKF2 fuses the positions for less than this fraction of the time
FUSED_FRACTION_FOR_WARNING = 0.98
# Minimum mean position interval (s) that may delay the start of fusion: with jitter, some intervals
# exceed EKF2's limit of 0.2 s
MIN_INTERVAL_FOR_LATE_START_S = 0.18
MOTION_CAPTURE_TOPIC = "vehicle_mocap_odometry"
# Minimum position error (m) for a finding while EKF2 declares its position invalid
MIN_INVALID_POSITION_ERROR_M = 1.0


def detect(analysis: Comparison) -> Findings:
    if is_height_only(analysis.source):
        return
    if isinstance(analysis.flight.ekf2, Ekf2):
        yield from _detect_invalid_position(analysis, analysis.flight.ekf2)
    yield from detect_unfused_positions(analysis)


def detect_unfused_positions(analysis: PreparedComparison) -> Findings:
    ekf2, source = analysis.flight.ekf2, _find_received_source(analysis)
    if not isinstance(ekf2, Ekf2) or isinstance(ekf2.fusion_flags, Unavailable):
        return
    fusion_flag = ekf2.fusion_flags["horizontal"]
    fused_fraction = compute_flag_fraction(fusion_flag, analysis.segment)
    if fused_fraction >= FUSED_FRACTION_FOR_ERROR:
        yield from _detect_slow_restart(analysis, fusion_flag)
    if source is None or fused_fraction >= FUSED_FRACTION_FOR_WARNING:
        return
    title = f"EKF2 never fused the {positions_phrase(source)}"
    evidence: dict[str, float | str] = {
        "fused_fraction": fused_fraction,
        "source_interval_s": 1.0 / source.compute_rate_hz(),
    }
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
    if fused_fraction:
        title = (
            f"EKF2 fused the {positions_phrase(source)} only {format_percent(fused_fraction)} of "
            "the time"
        )
    if unmet_condition.fault:
        title += f": {unmet_condition.fault}"
    message = f"{title}. {unmet_condition.reason}"
    if fused_fraction >= FUSED_FRACTION_FOR_ERROR:
        message += (
            f" For up to {longest_span_s[1] - longest_span_s[0]:.1f} s EKF2 relied on the IMU and "
            "other aiding sources."
        )
        yield make_warning("ekf2_fusion_interrupted", message, action, evidence, spans)
        return
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
    is_valid = ekf2.status_flags.get("xy_valid")
    if is_valid is None or is_valid.empty:
        return
    invalid_fraction = 1.0 - compute_flag_fraction(is_valid, analysis.segment)
    if invalid_fraction <= 1.0 - FUSED_FRACTION_FOR_WARNING:
        return
    spans = find_spans_with_value(0.0, is_valid, analysis.segment)
    distance_m = _find_largest_distance_m(analysis, ekf2, spans)
    if distance_m < MIN_INVALID_POSITION_ERROR_M:
        return
    reference = "ground truth" if isinstance(analysis.flight.truth, Truth) else "position source"
    distance_sentence = ""
    if np.isfinite(distance_m):
        distance_sentence = (
            f" The invalid position is up to {format_metres(distance_m)} m from the {reference}."
        )
    yield finding(
        "error" if invalid_fraction > FUSED_FRACTION_FOR_ERROR else "warning",
        "ekf2_position_invalid",
        f"EKF2's horizontal position is invalid {format_percent(invalid_fraction)} of the time "
        f"(xy_valid 0), and PX4 does not use this position.{distance_sentence}",
        "First restore the fusion of positions. Noise settings do not change the error.",
        {"invalid_fraction": invalid_fraction, "distance_m": distance_m},
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
        or not source.origin.has_all_samples
        or source.alignment
        or 1.0 / rate_hz < MIN_INTERVAL_FOR_LATE_START_S
    ):
        return
    time_s = source.samples.index.to_numpy()
    gap_ends_s = time_s[1:][np.diff(time_s) > EV_STOP_INTERVAL_S]
    delay_spans = []
    for start_s, end_s in find_spans_with_value(0.0, fusion_flag, analysis.segment):
        # Positions from the last gap end on, while EKF2 does not fuse
        last_gap_end_s = gap_ends_s[gap_ends_s < end_s].max(initial=-np.inf)
        unfused_times_s = time_s[(time_s >= last_gap_end_s) & (time_s < end_s)]
        if (
            last_gap_end_s > start_s - EV_STOP_INTERVAL_S
            and len(unfused_times_s) > 2
            and unfused_times_s[1] - unfused_times_s[0] >= EV_START_INTERVAL_S
        ):
            delay_spans.append((float(unfused_times_s[0]), end_s))
    if delay_spans:
        longest_delay_s = max(end - start for start, end in delay_spans)
        yield make_note(
            "source_rate_at_limit",
            f"After a gap EKF2 resumed fusion {longest_delay_s:.1f} s late: "
            f"{positions_phrase(source)} come at only {rate_hz:.1f} Hz. EKF2 (v1.14 and later) "
            f"starts fusion when two positions arrive within {EV_START_INTERVAL_S:g} s.",
            "Send the position at 10 Hz.",
            {"rate_hz": rate_hz, "longest_s": longest_delay_s, "count": len(delay_spans)},
            tuple(delay_spans),
        )
