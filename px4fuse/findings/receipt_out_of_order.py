"""The recording computer's clock was set back while it recorded."""

from __future__ import annotations

from px4fuse.analysis import Analysis
from px4fuse.findings.model import Detector, Finding, Found, sentence


def _detect(analysis: Analysis) -> Found:
    for note in analysis.flight.log.notes:
        if "time of receipt went back" in note:
            yield Finding(
                "receipt_out_of_order",
                "info",
                f"{sentence(note)}: the recording computer's clock was set, or "
                "recordings were put together; the sender's own stamps are not affected.",
                "Switch the recording computer's time service off while recording.",
            )


DETECTOR = Detector(
    _detect,
    names={"receipt_out_of_order": "messages that came out of order"},
)
