"""Nobody said where the vehicle landed, so that the closure error rests on an assumption."""

from __future__ import annotations

from px4fuse.findings.model import Detector, Finding, Found
from px4fuse.loop.loop import Loop


def _detect(loop: Loop) -> Found:
    if loop.closure_error_m is not None and loop.end_assumed:
        yield Finding(
            "loop_end_assumed",
            "info",
            "It is assumed that the vehicle landed where it took off: if it did not, the distance "
            "between the two is counted as closure error.",
            "Measure where it landed and give --landed-at FORWARD,RIGHT (m, along its nose at "
            "take-off and to the right of it).",
            {"closure_error_m": loop.closure_error_m},
        )


DETECTOR = Detector(
    _detect,
    names={"loop_end_assumed": "a landing place that was only assumed"},
)
