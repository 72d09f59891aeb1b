"""EKF2's output jumped, or another instance took over."""

import numpy as np

from px4fuse.analysis import Analysis
from px4fuse.comparison.projection import continuous_state
from px4fuse.findings.model import Found, finding, format_count, moments, warning
from px4fuse.flight import Ekf2


def detect(analysis: Analysis) -> Found:
    """Resets of the position, and switches, in the segment."""
    ekf2, segment = analysis.flight.ekf2, analysis.segment
    if not isinstance(ekf2, Ekf2):
        return
    inside = [
        r
        for r in ekf2.resets
        if segment.start_s < r.time_s <= segment.end_s and r.quantity == "position" and any(r.delta)
    ]
    if inside:
        sizes = [float(np.linalg.norm(r.delta)) for r in inside]
        at_s = inside[int(np.argmax(sizes))].time_s
        horizontal = sum(any(r.delta[:2]) for r in inside)
        _, treated = continuous_state(ekf2, analysis.source, segment)
        yield finding(
            "warning" if horizontal else "info",
            "ekf2_resets",
            {"count": len(inside), "largest_m": max(sizes), "at_s": at_s},
            moments(r.time_s for r in inside),
            often=format_count(len(inside)),
            treated=treated,
            horizontal=horizontal,
            part=0 < horizontal < len(inside),
            case=horizontal > 0,
        )
    switches = [time for time, _ in ekf2.instances if segment.start_s < time <= segment.end_s]
    if switches:
        evidence = {"count": len(switches), "at_s": switches[0]}
        often = format_count(len(switches))
        yield warning("ekf2_instance_switch", evidence, moments(switches), often=often)
