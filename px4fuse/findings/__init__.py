"""The mistakes that px4fuse names: each a detector with evidence and a remedy that can be typed.

Thresholds are data, with unit and source. A detector looks at an :class:`Analysis` and yields
findings; it never prints and never guesses: what it cannot see it does not mention.
"""

from __future__ import annotations

from collections.abc import Iterable

from px4fuse.analysis import Analysis
from px4fuse.findings.ekf2 import (
    accelerometer_bias,
    ekf2_not_fusing,
    ekf2_rejecting,
    ekf2_unavailable,
    resets,
)
from px4fuse.findings.filter import process_noise_forgotten, too_few_innovations, variance_wrong
from px4fuse.findings.loop import find_in_loop, loop_closures
from px4fuse.findings.model import SEVERITIES, Detector, Finding, Severity
from px4fuse.findings.noise import (
    clock_off,
    ekf2_delay_off,
    frame_turned,
    noises_off,
    outliers,
)
from px4fuse.findings.recording import (
    autopilot_restarted,
    companion_not_synchronised,
    innovations_need_ulog,
    other_autopilot,
    position_file_placement,
    receipt_out_of_order,
    samples_lost,
    stamps_meaningless,
)
from px4fuse.findings.source import (
    gaps,
    input_unavailable,
    log_damaged,
    logging_rate_low,
    no_motion,
    source_frame,
    source_reconstructed,
)
from px4fuse.loop.loop import Loop

__all__ = ["DETECTORS", "SEVERITIES", "Finding", "Severity", "find", "find_loop"]


def find(analysis: Analysis) -> tuple[Finding, ...]:
    """All findings of all detectors, most severe first, each detector's own order kept."""
    return _sorted(finding for detector in DETECTORS for finding in detector(analysis))


def find_loop(loop: Loop) -> tuple[Finding, ...]:
    """All findings about a loop, most severe first."""
    return _sorted(find_in_loop(loop))


def _sorted(found: Iterable[Finding]) -> tuple[Finding, ...]:
    return tuple(sorted(found, key=lambda finding: SEVERITIES.index(finding.severity)))


DETECTORS: tuple[Detector, ...] = (
    stamps_meaningless,
    clock_off,
    frame_turned,
    outliers,
    noises_off,
    loop_closures,
    ekf2_not_fusing,
    process_noise_forgotten,
    variance_wrong,
    ekf2_rejecting,
    ekf2_delay_off,
    accelerometer_bias,
    companion_not_synchronised,
    position_file_placement,
    source_reconstructed,
    gaps,
    autopilot_restarted,
    resets,
    no_motion,
    logging_rate_low,
    source_frame,
    ekf2_unavailable,
    input_unavailable,
    too_few_innovations,
    log_damaged,
    samples_lost,
    other_autopilot,
    receipt_out_of_order,
    innovations_need_ulog,
)
