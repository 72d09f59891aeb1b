"""What is poorly determined about where an external position file lies in the flight."""

from __future__ import annotations

from px4fuse.analysis import Analysis
from px4fuse.findings.model import Detector, Finding, Found, sentence


def _detect(analysis: Analysis) -> Found:
    source = analysis.source
    alignment = source.alignment
    if alignment is None:
        return
    for warning in alignment.warnings:
        said, option, value = warning.rstrip(".").partition("ive --position-")
        message = sentence(f"{said[:-1].rstrip(' :')}" if option else said)
        yield Finding(
            "position_file_placement",
            "error" if option else "warning",
            f"{source.name}: {message.rstrip('.')}.",
            f"Give --position-{value}."
            if option
            else "Give --clock-offset, --position-frame and --position-yaw where you know them.",
        )


DETECTOR = Detector(
    _detect,
    names={"position_file_placement": "the placing of the position file"},
)
