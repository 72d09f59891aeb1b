"""Findings: faults of a flight, its sensors and its settings that the log shows.

Each module in :data:`DETECTORS` has a function ``detect`` that yields findings. docs/built.md lists
the files to change for a new finding.
"""

from collections.abc import Mapping

from px4fuse.analysis import Analysis
from px4fuse.ekf2.aids import AidResult
from px4fuse.finding import Finding, Severity
from px4fuse.findings import (
    aids,
    ekf2_noise,
    ekf2_not_fusing,
    ekf2_rejecting,
    ekf2_resets,
    ekf2_state,
    hidden_errors,
    imu,
    loops,
    missing,
    noises,
    parameters,
    recording,
    source_clock,
    source_convention,
    source_frame,
    source_intervals,
    source_noise,
    source_patterns,
    source_positions,
    source_stamps,
    source_values,
)
from px4fuse.findings.cause_grouping import group_by_cause
from px4fuse.findings.model import TITLES, group_by_root
from px4fuse.flight.model import Ekf2, Unavailable
from px4fuse.loop.model import Loop

__all__ = [
    "TITLES",
    "Finding",
    "Severity",
    "find",
    "find_aids",
    "find_loop",
    "finding_title",
    "group_by_root",
]

DETECTORS = (
    aids,
    ekf2_noise,
    ekf2_not_fusing,
    ekf2_rejecting,
    ekf2_resets,
    ekf2_state,
    hidden_errors,
    imu,
    loops,
    missing,
    noises,
    parameters,
    recording,
    source_clock,
    source_convention,
    source_frame,
    source_intervals,
    source_noise,
    source_patterns,
    source_positions,
    source_stamps,
    source_values,
)


def find(analysis: Analysis) -> tuple[Finding, ...]:
    """Return the findings of a comparison of KF with EKF2, most severe first."""
    findings = [found for module in DETECTORS for found in module.detect(analysis)]
    return group_by_cause(source_convention.apply_convention(analysis, findings))


def find_loop(loop: Loop) -> tuple[Finding, ...]:
    """Return the findings on the loop closures of a path, most severe first."""
    return () if loop.is_assessed else group_by_cause(loops.detect_in_loop(loop))


def find_aids(
    aid_results: Mapping[str, AidResult], ekf2: Ekf2 | Unavailable | None = None
) -> tuple[Finding, ...]:
    """Return the findings on EKF2 and its aiding sources, for a flight without position source."""
    findings = list(aids.detect_in_aids(aid_results))
    if isinstance(ekf2, Ekf2):
        span_s = ekf2.instances[0][0], ekf2.instances[-1][0]
        findings += ekf2_resets.detect_instance_switches(ekf2, span_s)
    return group_by_cause(findings)


def finding_title(finding_id: str) -> str:
    """Return the title of a finding. If its id is unknown, return the id with blanks.

    >>> finding_title("source_gap"), finding_title("of_a_later_version")
    ('Gap in the position source', 'of a later version')
    """
    return TITLES.get(finding_id, finding_id.replace("_", " "))
