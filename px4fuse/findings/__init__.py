"""The mistakes that px4fuse names: a file each, with all that is said about it.

A file declares ids, thresholds with unit and source, the detector (condition, words, remedy), what
the finding is called, and the flights on which its rate is measured. A detector never prints and
never guesses: what it cannot see it does not mention.

To add a finding: its file, its name below, its place in ``causes.py`` if it follows from another or
brings others with it, its rows of ``tests/studies/rates.csv``.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache

from px4fuse.analysis import Analysis, explain
from px4fuse.comparison.model import Comparison
from px4fuse.findings import (
    accelerometer_bias,
    autopilot_restarted,
    companion_not_synchronised,
    ekf2_ev_delay_wrong,
    ekf2_innovations_decimated,
    ekf2_instance_switch,
    ekf2_is_a_model,
    ekf2_not_fusing,
    ekf2_rejecting,
    ekf2_resets,
    errors_larger_than_claimed,
    imu_gap,
    innovations_need_ulog,
    log_damaged,
    logger_dropouts,
    logging_rate_low,
    loop_closures,
    loop_end_assumed,
    loop_of_absolute_track,
    no_motion,
    not_px4,
    position_file_placement,
    process_noise_forgotten,
    receipt_out_of_order,
    sigma,
    source_clock,
    source_frame_not_north,
    source_frame_turned,
    source_gap,
    source_jumps,
    source_may_drift,
    source_not_logged,
    source_outliers,
    source_samples_lost,
    source_scale_wrong,
    source_smoothed,
    source_stamps,
    source_stamps_of_arrival,
    source_thinned,
    source_variance_wrong,
    unavailable,
    variance,
)
from px4fuse.findings.causes import by_cause
from px4fuse.findings.model import SEVERITIES, Detector, Finding, Found, Severity, Subject
from px4fuse.loop.loop import Loop

__all__ = [
    "DETECTORS",
    "SEVERITIES",
    "Finding",
    "Severity",
    "find",
    "find_loop",
    "named",
    "names",
]


def find(subject: Analysis | Comparison) -> tuple[Finding, ...]:
    """One finding per cause, most severe first and what the recording lacks before noises.

    Parameters
    ----------
    subject : Analysis or Comparison
        A comparison is explained first, which takes some seconds.
    """
    return _find(DETECTORS, subject if isinstance(subject, Analysis) else explain(subject))


def find_loop(loop: Loop) -> tuple[Finding, ...]:
    """All findings about a loop, most severe first."""
    return _find(LOOP_DETECTORS, loop)


@cache
def names() -> dict[str, str]:
    """What each finding is called within a sentence: a student reads words, never ids."""
    return {name: said for detector in DETECTORS for name, said in detector.names.items()}


def named(finding: str) -> str:
    """A finding as part of a sentence; one that this version does not know by its id.

    >>> named("source_gap"), named("of_a_later_version")
    ('a time without positions', 'of a later version')
    """
    return names().get(finding, finding.replace("_", " "))


def _find(detectors: Iterable[Detector[Subject]], subject: Subject) -> tuple[Finding, ...]:
    return by_cause(finding for detector in detectors for finding in detector.detect(subject))


def _in_flight(detector: Detector[Loop]) -> Detector[Analysis]:
    """The same about the loop of a flight that holds one."""

    def detect(analysis: Analysis) -> Found:
        if isinstance(analysis.loop, Loop):
            yield from detector.detect(analysis.loop)

    return Detector(detect, detector.measured_on, names=detector.names)


# Within one severity, in the order in which a report tells them (exceptions in causes.py)
LOOP_DETECTORS: tuple[Detector[Loop], ...] = (
    loop_closures.DETECTOR,
    loop_of_absolute_track.DETECTOR,
    loop_end_assumed.DETECTOR,
)
DETECTORS: tuple[Detector[Analysis], ...] = (
    source_stamps.DETECTOR,
    source_stamps_of_arrival.DETECTOR,
    source_thinned.DETECTOR,
    source_smoothed.DETECTOR,
    source_jumps.DETECTOR,
    accelerometer_bias.DETECTOR,
    source_scale_wrong.DETECTOR,
    source_clock.DETECTOR,
    errors_larger_than_claimed.DETECTOR,
    source_frame_turned.DETECTOR,
    source_outliers.DETECTOR,
    source_variance_wrong.DETECTOR,
    sigma.DETECTOR,
    *map(_in_flight, LOOP_DETECTORS),
    ekf2_not_fusing.DETECTOR,
    process_noise_forgotten.DETECTOR,
    variance.DETECTOR,
    ekf2_rejecting.DETECTOR,
    ekf2_ev_delay_wrong.DETECTOR,
    companion_not_synchronised.DETECTOR,
    position_file_placement.DETECTOR,
    source_not_logged.DETECTOR,
    source_gap.DETECTOR,
    logger_dropouts.DETECTOR,
    imu_gap.DETECTOR,
    autopilot_restarted.DETECTOR,
    ekf2_resets.DETECTOR,
    ekf2_instance_switch.DETECTOR,
    no_motion.DETECTOR,
    source_may_drift.DETECTOR,
    logging_rate_low.DETECTOR,
    ekf2_innovations_decimated.DETECTOR,
    source_frame_not_north.DETECTOR,
    unavailable.DETECTOR,
    log_damaged.DETECTOR,
    source_samples_lost.DETECTOR,
    not_px4.DETECTOR,
    receipt_out_of_order.DETECTOR,
    innovations_need_ulog.DETECTOR,
    ekf2_is_a_model.DETECTOR,
)
