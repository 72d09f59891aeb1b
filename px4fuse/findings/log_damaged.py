"""Bytes that the reader had to pass over, and single samples that it dropped."""

from __future__ import annotations

from px4fuse.analysis import Analysis
from px4fuse.findings.model import Detector, Finding, Found, sentence


def _detect(analysis: Analysis) -> Found:
    log = analysis.flight.log
    damage = [note for note in log.notes if "damaged" in note]
    dropped = [note for note in log.notes if " dropped: " in note]
    if damage:
        yield Finding(
            "log_damaged",
            "warning",
            _first_of(damage),
            "Record where the link loses no bytes: by cable, or on the companion."
            if log.format.startswith("MAVLink")
            else "Copy the log again; if that does not help, replace the SD card.",
            {"notes": float(len(damage))},
        )
    if dropped:
        yield Finding(
            "samples_dropped",
            "info",
            _first_of(dropped),
            "The file is whole: a clock was set back, or messages overtook each other. If it is "
            "the position source, synchronise its clock before take-off (TIMESYNC).",
            {"notes": float(len(dropped))},
        )


def _first_of(notes: list[str]) -> str:
    more = len(notes) - 1
    others = f" (and {more} more such note{'s' if more > 1 else ''})" if more else ""
    return f"{sentence(notes[0])}{others}."


DETECTOR = Detector(
    _detect,
    names={
        "log_damaged": "a damaged log",
        "samples_dropped": "samples that were dropped because their stamps went back",
    },
)
