"""Resets of EKF2's position, and changes of the primary EKF2 instance."""

import math

import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.comparison.flight_events import find_airborne_spans
from px4fuse.comparison.projection import remove_origin_resets
from px4fuse.core.record import Span
from px4fuse.findings.cause_grouping import CAUSE_KEY, SOURCE_GAP_CAUSE, UNKNOWN_CAUSE
from px4fuse.findings.model import (
    Findings,
    finding,
    format_count,
    make_warning,
    make_zero_length_spans,
)
from px4fuse.flight.model import Ekf2, Reset

# Time (s) after take-off with normal height resets
TAKE_OFF_DURATION_S = 10.0
# Maximum time (s) from the end of a position gap to the EKF2 reset that it causes
MAX_RESET_DELAY_S = 5.0
# Maximum delay (s) of the normal reset at the start of fusion, because flags are logged at 1 Hz
MAX_FUSION_START_TO_RESET_S = 1.0


def detect(analysis: Analysis) -> Findings:
    ekf2, segment = analysis.flight.ekf2, analysis.segment.whole_flight
    if not isinstance(ekf2, Ekf2):
        return
    # Resets up to the start of fusion are normal
    fusion_start_s = -math.inf
    if isinstance(ekf2.fusion_flags, pd.DataFrame):
        is_fused = ekf2.fusion_flags["horizontal"] > 0.0
        fusion_start_s = is_fused.index[is_fused].min() + MAX_FUSION_START_TO_RESET_S
    position_resets = [
        reset
        for reset in ekf2.resets
        if segment.start_s < reset.time_s <= segment.end_s
        and reset.quantity == "position"
        and any(reset.delta)
        and not _is_take_off_height_reset(analysis, reset)
        and not reset.time_s <= fusion_start_s
    ]
    if position_resets:
        horizontal_resets = [reset for reset in position_resets if any(reset.delta[:2])]
        resets = horizontal_resets or position_resets
        follows_gap = all(
            any(
                start <= reset.time_s <= end + MAX_RESET_DELAY_S
                for start, end in analysis.events.gaps
            )
            for reset in resets
        )
        largest_reset = max(resets, key=lambda reset: math.hypot(*reset.delta))
        largest_m, time_s = math.hypot(*largest_reset.delta), largest_reset.time_s
        _, treatment = remove_origin_resets(ekf2, analysis.source, analysis.segment)
        yield finding(
            "warning" if horizontal_resets else "note",
            "ekf2_resets",
            f"EKF2 reset its {'horizontal position' if horizontal_resets else 'height'} "
            f"{format_count(len(resets))} (largest reset: {largest_m:.2f} m at {time_s:.1f} s)."
            f"{f' Treatment in the comparison: {treatment}.' if treatment else ''}",
            f"Run px4fuse explore LOG and compare position and innovation at {time_s:.1f} s.",
            {
                "count": len(resets),
                "largest_m": largest_m,
                "at_s": time_s,
                CAUSE_KEY: SOURCE_GAP_CAUSE if follows_gap else UNKNOWN_CAUSE,
            },
            make_zero_length_spans(reset.time_s for reset in resets),
        )
    yield from detect_instance_switches(ekf2, (segment.start_s, segment.end_s))


def detect_instance_switches(ekf2: Ekf2, span_s: Span) -> Findings:
    """Detect changes of the primary EKF2 instance in a time span (s)."""
    switch_times_s = [time for time, _ in ekf2.primary_instances if span_s[0] < time <= span_s[1]]
    if switch_times_s:
        yield make_warning(
            "ekf2_instance_switch",
            f"The primary EKF2 instance changed {format_count(len(switch_times_s))}, first at "
            f"{switch_times_s[0]:.1f} s. The comparison uses the primary instance at each time.",
            "Compare vibration and clipping of the IMUs (vehicle_imu_status). For a lab flight set "
            "EKF2_MULTI_IMU to 1: EKF2 then uses one IMU.",
            {"count": len(switch_times_s), "at_s": switch_times_s[0]},
            make_zero_length_spans(switch_times_s),
        )


def _is_take_off_height_reset(analysis: Analysis, reset: Reset) -> bool:
    return not any(reset.delta[:2]) and any(
        start_s <= reset.time_s <= start_s + TAKE_OFF_DURATION_S
        for start_s, _ in find_airborne_spans(analysis.flight)
    )
