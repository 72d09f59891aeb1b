"""Bytes or samples that the reader had to pass over."""

from __future__ import annotations

from px4fuse.analysis import Analysis
from px4fuse.findings.model import Detector, Finding, Found, sentence


def _detect(analysis: Analysis) -> Found:
    notes = [n for n in analysis.comparison.flight.log.notes if "damaged" in n or "dropped" in n]
    if notes:
        yield Finding(
            "log_damaged",
            "warning",
            sentence(notes[0])
            + (f" (and {len(notes) - 1} more such notes)." if len(notes) > 1 else "."),
            "Copy the log again; if that does not help, replace the SD card or fix the "
            "MAVLink link.",
            {"notes": float(len(notes))},
        )


DETECTOR = Detector(
    _detect,
    {"log_damaged": "damaged, corrupt, logger, stamp go back, stamp backward, samples dropped"},
)
