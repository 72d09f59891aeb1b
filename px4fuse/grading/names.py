"""What findings and places in the results are called in a sentence."""

from __future__ import annotations

from collections.abc import Mapping

from px4fuse.findings import names

# Places in the results that the default rubric names
PARTS: Mapping[str, str] = {
    "axes.*.kf": "the consistency of the filter",
    "clock": "the clock offset",
    "loop.closure_error_m": "the closure error",
    "loop.path_length_m": "the length of the path",
    "loop.corrections": "the corrected paths",
    "tuning": "the noises that the data ask for",
    "tuning.horizontal.held_out.gain_nats": "what tuning would still gain",
    "why": "why EKF2 differs",
}


def part(path: str) -> str:
    """A place in the results as part of a sentence."""
    return PARTS.get(path, path)


def named(finding: str) -> str:
    """A finding as part of a sentence.

    >>> named("source_gap"), named("of_a_later_version")
    ('a time without positions', 'of a later version')
    """
    return names().get(finding, finding.replace("_", " "))
