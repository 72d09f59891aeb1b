"""Bytes that the reader had to pass over, and single samples that it dropped."""

from __future__ import annotations

from px4fuse.analysis import Analysis
from px4fuse.findings.model import Detector, Finding, Found, sentence


def _detect(analysis: Analysis) -> Found:
    log = analysis.flight.log
    dropped = [note for note in log.notes if " dropped: " in note]
    ends = f"the log ends in flight, after {log.duration_s:.1f} s: the landing is not in it"
    if log.damage or log.ends_in_flight:
        yield Finding(
            "log_damaged",
            "warning" if log.damage else "info",
            ". ".join(map(sentence, log.damage or (ends,))) + ".",
            "Log until after the landing; if the log was cut short, copy it again."
            if not log.damage
            else "Record where the link loses no bytes: by cable, or on the companion."
            if log.format.startswith("MAVLink")
            else "Copy the log again; if that does not help, replace the SD card.",
            {
                "lost_bytes": float(log.bytes - log.bytes_read),
                "ends_in_flight": float(log.ends_in_flight),
            },
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
