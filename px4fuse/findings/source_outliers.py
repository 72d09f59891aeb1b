"""Measurements that no noise explains: reflections, no line of sight."""

from __future__ import annotations

from px4fuse.analysis import Analysis
from px4fuse.filter.causes import AFTER_STEP_S, Explained
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning
from px4fuse.findings.model import Found, finding, moments

OUTLIERS = 0.005  # of the measurements; a normal source has 0.02 % beyond 3.7 σ
OUTLIERS_ERROR = 0.02  # of the measurements: every tenth second at 5 Hz
MIN_OUTLIERS = 3


def detect(analysis: Analysis) -> Found:
    """More than a normal source has, without what begins a step that stays."""
    tuned = analysis.tuning.get(HORIZONTAL) or next(iter(analysis.tuning.values()), None)
    if not isinstance(tuned, AxisTuning):
        return
    found = analysis.explained
    jumps = [jump.time_s for jump in found.jumps] if isinstance(found, Explained) else []
    outliers = [
        time
        for time in tuned.outlier_time_s.tolist()
        if not any(at <= time < at + AFTER_STEP_S for at in jumps)
    ]
    count, share = len(outliers), len(outliers) / tuned.count
    if share < OUTLIERS or count < MIN_OUTLIERS:
        return
    first = ", ".join(f"{time:.1f}" for time in outliers[:3])
    yield finding(
        "error" if share >= OUTLIERS_ERROR else "warning",
        "source_outliers",
        f"{count} of {tuned.count} measurements ({share:.1%}) are outliers that no noise explains",
        f" ({tuned.name}; at {first} s{' and more' if count > 3 else ''}): for UWB most likely "
        "reflections without line of sight. They pull both filters, and look like noise unless "
        "they are left out.",
        "Give the tag line of sight to the anchors there, or reject them before they are sent; do "
        "not raise SIGMA_Z or EKF2_EVP_NOISE for them.",
        {"count": count, "share": share, "first_s": outliers[0]},
        moments(outliers),
    )
