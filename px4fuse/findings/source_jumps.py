"""The source's positions step to another place and stay there: a false match, a moved anchor."""

from __future__ import annotations

from px4fuse.analysis import Analysis
from px4fuse.filter.causes import Explained
from px4fuse.findings.model import Found, finding, moments, times
from px4fuse.findings.source_stamps import arrivals

JUMP_M = 0.2  # twice a good UWB's noise
JUMP_ERROR_M = 0.5  # no longer the same place


def detect(analysis: Analysis) -> Found:
    """Steps that the IMU does not measure; a moving vehicle's positions jump where stamps do."""
    found = analysis.explained
    if not isinstance(found, Explained) or any(arrivals(analysis)):
        return
    jumps = [jump for jump in found.jumps if jump.size_m >= JUMP_M]
    if not jumps:
        return
    largest = max(jumps, key=lambda jump: jump.size_m)
    size, at_s, sigma = largest.size_m, largest.time_s, max(s.sigma for s in largest.step_m)
    yield finding(
        "error" if size >= JUMP_ERROR_M else "warning",
        "source_jumps",
        f"{analysis.source.name} jumps {times(len(jumps))} and stays there, by {size:.2f} m "
        f"(± {1.96 * sigma:.2f}) at {at_s:.1f} s, while the IMU measures no such motion",
        ": a false match, another set of anchors or an origin that was set again. After it both "
        "filters are wrong by that, and consistent.",
        "Analyse one side of the jump with --start, --end; let the source keep one origin and "
        "one set of anchors in flight.",
        {"count": len(jumps), "size_m": size, "at_s": at_s, "sigma_m": sigma},
        moments(jump.time_s for jump in jumps),
    )
