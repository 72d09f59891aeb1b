"""Resets of EKF2's position, and changes of the primary EKF2 instance."""

import numpy as np

from px4fuse.analysis import Analysis
from px4fuse.comparison.projection import continuous_state
from px4fuse.findings.model import Findings, finding, format_count, warning, zero_length_spans
from px4fuse.flight import Ekf2


def detect(analysis: Analysis) -> Findings:
    """Detect position resets and instance changes in the segment."""
    ekf2, segment = analysis.flight.ekf2, analysis.segment
    if not isinstance(ekf2, Ekf2):
        return
    resets = [
        r
        for r in ekf2.resets
        if segment.start_s < r.time_s <= segment.end_s and r.quantity == "position" and any(r.delta)
    ]
    if resets:
        sizes_m = [float(np.linalg.norm(r.delta)) for r in resets]
        at_s = resets[int(np.argmax(sizes_m))].time_s
        horizontal_count = sum(any(r.delta[:2]) for r in resets)
        _, treatment = continuous_state(ekf2, analysis.source, segment)
        count_text = format_count(len(resets))
        if 0 < horizontal_count < len(resets):
            count_text += f" ({horizontal_count} horizontally)"
        yield finding(
            "warning" if horizontal_count else "note",
            "ekf2_resets",
            f"EKF2 reset its {'position' if horizontal_count else 'height'} {count_text}, by up to "
            f"{max(sizes_m):.2f} m at {at_s:.1f} s. In the comparison: {treatment}.",
            "Check the gap or the rejections at that time."
            if horizontal_count
            else "A height reset at take-off is normal. In flight, check for a change of the "
            "height source.",
            {"count": len(resets), "largest_m": max(sizes_m), "at_s": at_s},
            zero_length_spans(r.time_s for r in resets),
        )
    switches = [time for time, _ in ekf2.instances if segment.start_s < time <= segment.end_s]
    if switches:
        yield warning(
            "ekf2_instance_switch",
            f"The primary EKF2 instance changed {format_count(len(switches))}, first at "
            f"{switches[0]:.1f} s. The comparison uses the primary instance at each time.",
            "Compare the IMUs (vehicle_imu_status). Set EKF2_MULTI_IMU to 1 for a lab flight.",
            {"count": len(switches), "at_s": switches[0]},
            zero_length_spans(switches),
        )
