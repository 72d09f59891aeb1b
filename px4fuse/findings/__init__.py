"""The mistakes that px4fuse names: a file for those that share a condition.

A file declares thresholds with unit and source and, in ``detect``, the condition and evidence of
its findings; their words stand in ``words.toml``. A detector never prints and never guesses: what
it cannot see it does not mention.

To add a finding: its file with a ``detect``, the file in :data:`DETECTORS`, its words in
``words.toml``, and the flights on which its rate is measured in ``tests/studies/rates.csv``.
"""

from collections.abc import Callable, Mapping

from px4fuse.analysis import Analysis, explain
from px4fuse.comparison.model import Comparison
from px4fuse.ekf2.aids import AidResult
from px4fuse.findings import (
    aids,
    ekf2_not_fusing,
    ekf2_rejecting,
    ekf2_resets,
    hidden_errors,
    imu,
    loops,
    missing,
    noises,
    recording,
    source_clock,
    source_frame,
    source_intervals,
    source_noise,
    source_positions,
    source_stamps,
)
from px4fuse.findings.causes import group_by_cause
from px4fuse.findings.model import NAMES, Finding, Found, Severity, by_root
from px4fuse.loop.model import Loop

__all__ = ["NAMES", "Finding", "Severity", "by_root", "find", "find_aids", "find_loop", "named"]

# Detectors of a comparison; by_cause orders their findings
DETECTORS: tuple[Callable[[Analysis], Found], ...] = (
    aids.detect,
    ekf2_not_fusing.detect,
    ekf2_rejecting.detect,
    ekf2_resets.detect,
    hidden_errors.detect,
    imu.detect,
    loops.detect,
    missing.detect,
    noises.detect,
    recording.detect,
    source_clock.detect,
    source_frame.detect,
    source_intervals.detect,
    source_noise.detect,
    source_positions.detect,
    source_stamps.detect,
)


def find(subject: Analysis | Comparison) -> tuple[Finding, ...]:
    """Findings, most severe first and what the recording lacks before noises.

    What follows from another stands behind it, see :attr:`Finding.caused_by`.

    Parameters
    ----------
    subject : Analysis or Comparison
        A comparison is explained first, which takes some seconds.
    """
    analysis = subject if isinstance(subject, Analysis) else explain(subject)
    return group_by_cause(found for detect in DETECTORS for found in detect(analysis))


def find_loop(loop: Loop) -> tuple[Finding, ...]:
    """All findings about a loop, most severe first."""
    return group_by_cause(loops.find_in(loop))


def find_aids(results: Mapping[str, AidResult]) -> tuple[Finding, ...]:
    """All findings about EKF2's aids alone, most severe first."""
    return group_by_cause(aids.find_in(results))


def finding_title(finding: str) -> str:
    """A finding as part of a sentence; one that this version does not know by its id.

    >>> finding_title("source_gap"), finding_title("of_a_later_version")
    ('a time without positions', 'of a later version')
    """
    return NAMES.get(finding, finding.replace("_", " "))
