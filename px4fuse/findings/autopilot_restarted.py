"""The boot clock began again in mid-recording, and only one part was read."""

from __future__ import annotations

from px4fuse.analysis import Analysis
from px4fuse.findings.model import Detector, Finding, Found, sentence


def _detect(analysis: Analysis) -> Found:
    for note in analysis.flight.log.notes:
        if "boot clock went back" in note:
            yield Finding(
                "autopilot_restarted",
                "warning",
                f"{sentence(note)}.",
                "Record each flight into a file of its own.",
            )


DETECTOR = Detector(
    _detect,
    names={"autopilot_restarted": "a restart of the autopilot"},
)
