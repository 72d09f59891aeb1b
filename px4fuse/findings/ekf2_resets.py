"""EKF2's output jumped, or another instance took over."""

import numpy as np

from px4fuse.analysis import Analysis
from px4fuse.comparison.projection import continuous_state
from px4fuse.findings.model import Found, finding, moments, times, warning
from px4fuse.flight import Ekf2


def detect(analysis: Analysis) -> Found:
    """Resets of the position, and switches, in the segment."""
    ekf2, segment = analysis.flight.ekf2, analysis.segment
    if not isinstance(ekf2, Ekf2):
        return
    inside = [
        r for r in ekf2.resets
        if segment.start_s < r.time_s <= segment.end_s and r.quantity == "position" and any(r.delta)
    ]  # fmt: skip
    if inside:
        sizes = [float(np.linalg.norm(r.delta)) for r in inside]
        at_s = inside[int(np.argmax(sizes))].time_s
        horizontal = sum(any(r.delta[:2]) for r in inside)
        _, treated = continuous_state(ekf2, analysis.source, segment)
        yield finding(
            "warning" if horizontal else "info",
            "ekf2_resets",
            f"EKF2 reset its {'height' if not horizontal else 'position'} {times(len(inside))}"
            + (f" ({horizontal} horizontally)" if 0 < horizontal < len(inside) else "")
            + f", by up to {max(sizes):.2f} m at {at_s:.1f} s",
            f". In the comparison: {treated}.",
            "Look for the gap or rejection at that time."
            if horizontal
            else "A height reset at take-off is usual; in mid-flight look for a change of the "
            "height source.",
            {"count": len(inside), "largest_m": max(sizes), "at_s": at_s},
            moments(r.time_s for r in inside),
        )
    switches = [time for time, _ in ekf2.instances if segment.start_s < time <= segment.end_s]
    if switches:
        yield warning(
            "ekf2_instance_switch",
            f"The primary EKF2 instance changed {times(len(switches))}, first at "
            f"{switches[0]:.1f} s",
            "; each part of the comparison uses the one in charge.",
            "Compare the IMUs (vehicle_imu_status); set EKF2_MULTI_IMU to 1 for a lab flight.",
            {"count": len(switches), "at_s": switches[0]},
            moments(switches),
        )
