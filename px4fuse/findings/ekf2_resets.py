"""EKF2's output jumped."""

from __future__ import annotations

import numpy as np

from px4fuse.analysis import Analysis
from px4fuse.findings.model import Detector, Finding, Found, moments, times
from px4fuse.flight import Unavailable


def _detect(analysis: Analysis) -> Found:
    comparison = analysis
    ekf2, segment = comparison.flight.ekf2, comparison.segment
    if isinstance(ekf2, Unavailable):
        return
    inside = [
        r
        for r in ekf2.resets
        if segment.start_s < r.time_s <= segment.end_s and r.quantity == "position" and any(r.delta)
    ]
    if not inside:
        return
    sizes = [float(np.linalg.norm(r.delta)) for r in inside]
    largest = inside[int(np.argmax(sizes))]
    horizontal = sum(any(r.delta[:2]) for r in inside)
    said = next((note for note in comparison.notes if note.startswith("EKF2 resets")), "")
    yield Finding(
        "ekf2_resets",
        "warning" if horizontal else "info",
        f"EKF2 reset its position {times(len(inside))} ({horizontal} horizontal), by up to "
        f"{max(sizes):.2f} m at {largest.time_s:.1f} s. In the comparison: {said[5:]}.",
        "Look for the gap or rejection at that time."
        if horizontal
        else "A height reset at take-off is usual; in mid-flight look for a change of the "
        "height source.",
        {"count": float(len(inside)), "largest_m": max(sizes), "at_s": largest.time_s},
        spans_s=moments(reset.time_s for reset in inside),
    )


DETECTOR = Detector(
    _detect,
    names={"ekf2_resets": "resets of EKF2"},
)
