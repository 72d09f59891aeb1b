"""Findings: faults of a flight, its sensors and its settings.

Each module in :data:`DETECTORS` has a function ``detect`` that yields findings. docs/built.md lists
the files to change for a new finding.
"""

from collections.abc import Mapping

from px4fuse.analysis import Analysis
from px4fuse.comparison.flight_events import find_airborne_spans
from px4fuse.ekf2.aids import AidResult
from px4fuse.filter.signals import Segment
from px4fuse.finding import Finding
from px4fuse.flight.model import Ekf2, Flight
from px4fuse.loop.model import Loop
from px4fuse.readers.px4_positions import NO_FIX_ACTION

from . import (
    ekf2_fusion,
    ekf2_settings,
    ekf2_state,
    hidden_errors,
    imu,
    loops,
    noises,
    recording,
    source_clock,
    source_convention,
    source_errors,
    source_frame,
    source_intervals,
    source_positions,
    source_stamps,
    source_values,
)
from .model import group_by_cause, make_warning

DETECTORS = (
    ekf2_fusion,
    ekf2_settings,
    ekf2_state,
    hidden_errors,
    imu,
    loops,
    noises,
    recording,
    source_clock,
    source_convention,
    source_frame,
    source_intervals,
    source_errors,
    source_positions,
    source_stamps,
    source_values,
)


def find(analysis: Analysis) -> tuple[Finding, ...]:
    """Return the findings of a comparison of KF with EKF2, most severe first."""
    findings = [finding for module in DETECTORS for finding in module.detect(analysis)]
    return group_by_cause(source_convention.remove_convention_effects(analysis, findings))


def find_loop_findings(loop: Loop) -> tuple[Finding, ...]:
    """Return the findings on the loop closures of a path, most severe first."""
    if loop.is_assessed:
        return ()
    return group_by_cause([*loop.orientation_findings, *loops.detect_loop_faults(loop)])


def find_aid_findings(aid_results: Mapping[str, AidResult], flight: Flight) -> tuple[Finding, ...]:
    """Return the findings on EKF2 and its aiding sources, for a flight without position source."""
    findings = list(ekf2_fusion.detect_aid_faults(aid_results))
    for item in flight.missing:
        if item.remedy == NO_FIX_ACTION:
            message = f"The GNSS receiver had no position: {item.reason}."
            findings.append(make_warning("source_without_position", message, item.remedy))
    if isinstance(flight.ekf2, Ekf2):
        spans_s = find_airborne_spans(flight) or ((0.0, flight.log.duration_s),)
        segment = Segment(spans_s[0][0], spans_s[-1][1], "")
        findings += ekf2_state.detect_instance_switches(flight.ekf2, segment)
        findings += ekf2_state.detect_missing_alignment(flight, segment)
    return group_by_cause(findings)
