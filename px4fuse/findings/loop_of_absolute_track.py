"""The loop was measured on a track that does not drift."""

from __future__ import annotations

from px4fuse.findings.model import Detector, Finding, Found
from px4fuse.loop.loop import Loop


def _detect(loop: Loop) -> Found:
    if loop.absolute:
        yield Finding(
            "loop_of_absolute_track",
            "warning",
            "This track follows a positioning system and does not drift: its closure error is the "
            "noise of one position, and to spread it over the path makes the path worse.",
            "Measure the loop on odometry: send visual-inertial odometry to PX4 as ODOMETRY.",
            {} if loop.closure_error_m is None else {"closure_error_m": loop.closure_error_m},
        )


DETECTOR = Detector(
    _detect,
    names={"loop_of_absolute_track": "a loop measured on a track that does not drift"},
)
