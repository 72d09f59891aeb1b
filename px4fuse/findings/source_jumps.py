"""The source's positions step to another place and stay there: a false match, a moved anchor."""

from __future__ import annotations

from px4fuse.analysis import Analysis
from px4fuse.filter.causes import Explained
from px4fuse.findings import source_stamps_of_arrival
from px4fuse.findings.model import Detector, Finding, Found, Threshold, moments, times

JUMP = Threshold(0.2, "m", "twice a good UWB's noise")
JUMP_ERROR = Threshold(0.5, "m", "no longer the same place")


def _detect(analysis: Analysis) -> Found:
    found = analysis.explained
    if not isinstance(found, Explained):
        return
    # a moving vehicle's positions jump where the stamps do
    if any(source_stamps_of_arrival.DETECTOR.detect(analysis)):
        return
    jumps = [jump for jump in found.jumps if jump.size_m >= JUMP.value]
    if not jumps:
        return
    largest = max(jumps, key=lambda jump: jump.size_m)
    sigma = max(step.sigma for step in largest.step_m)
    yield Finding(
        "source_jumps",
        "error" if largest.size_m >= JUMP_ERROR.value else "warning",
        f"{analysis.source.name} jumps {times(len(jumps))} and stays there, by "
        f"{largest.size_m:.2f} m (± {1.96 * sigma:.2f}) at {largest.time_s:.1f} s, while the IMU "
        "measures no such motion: a false match, another set of anchors or an origin that was "
        "set again. After it both filters are wrong by that, and consistent.",
        "Analyse one side of the jump with --start, --end; let the source keep one origin and "
        "one set of anchors in flight.",
        {
            "count": float(len(jumps)),
            "size_m": largest.size_m,
            "at_s": largest.time_s,
            "sigma_m": sigma,
        },
        spans_s=moments(jump.time_s for jump in jumps),
    )


DETECTOR = Detector(
    _detect,
    {"source_jumps": tuple(f"--mistake jump={size}" for size in ("0.5m", "1m", "2m"))},
    names={"source_jumps": "positions that jump"},
)
