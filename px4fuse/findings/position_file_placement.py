"""What is poorly determined about where an external position file lies in the flight."""

from __future__ import annotations

from px4fuse.analysis import Analysis
from px4fuse.findings.model import Found, finding
from px4fuse.plain import capital


def detect(analysis: Analysis) -> Found:
    """Every warning of the placing."""
    source = analysis.source
    for warning in source.alignment.warnings if source.alignment is not None else ():
        said, option, value = warning.rstrip(".").partition("ive --position-")
        message = capital(f"{said[:-1].rstrip(' :')}" if option else said).rstrip(".")
        yield finding(
            "error" if option else "warning",
            "position_file_placement",
            f"{source.name}: {message}",
            ".",
            f"Give --position-{value}."
            if option
            else "Give --clock-offset, --position-frame and --position-yaw where you know them.",
        )
