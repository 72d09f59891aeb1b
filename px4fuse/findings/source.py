"""What is wrong with the recording: the position source, the IMU and the logger."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.findings.model import Finding, motion_range_m, sentence, step_share, times
from px4fuse.findings.thresholds import (
    FUSING_SHARE_ERROR,
    GAP,
    GAP_INTERVALS,
    IMU_GAP_TOTAL,
    LOGGER_INTERVAL_TOLERANCE,
    LOGGER_INTERVALS_S,
    MIN_ATTITUDE_RATE,
    MIN_IMU_RATE,
    MIN_INNOVATION_SHARE,
    MOTION_RANGE,
    RATE_MARGIN,
    VISION_PROFILE_BIT,
)
from px4fuse.flight import Ekf2, Unavailable, sample_rate


def source_reconstructed(analysis: Analysis) -> Iterator[Finding]:
    """The position source as it arrived is not in the log."""
    comparison = analysis.comparison
    source = comparison.source
    logged = any(track.rung == 2 for track in comparison.flight.positions)
    if source.rung not in (4, 5, 6) or logged:
        return
    profile = int(comparison.flight.log.parameters.get("SDLOG_PROFILE", 1))
    why = next(
        (
            part.reason
            for part in comparison.missing
            if part.what == "position source vehicle_visual_odometry"
        ),
        "it is not in this log",
    )
    yield Finding(
        "source_not_logged",
        "warning",
        f"No vehicle_visual_odometry, the position as it arrived ({why}); "
        f"{source.name} ({source.description}) stands in for it at {source.rate_hz:.1f} Hz.",
        f"Set SDLOG_PROFILE to {profile | VISION_PROFILE_BIT} and fly again.",
        {"rate_hz": source.rate_hz, "sdlog_profile": float(profile)},
    )
    intervals = LOGGER_INTERVALS_S.get(source.name, ())
    limits = [
        interval
        for interval in intervals
        if abs(1.0 / source.rate_hz / interval - 1.0) < LOGGER_INTERVAL_TOLERANCE.value
    ]
    for interval in limits:
        yield Finding(
            "source_decimated",
            "warning",
            f"{source.name} is logged at {source.rate_hz:.1f} Hz, the logger's own limit for it "
            f"({1 / interval:g} Hz): the source may have run faster, the samples between are lost.",
            f"Set SDLOG_PROFILE to {profile | VISION_PROFILE_BIT} and fly again.",
            {"rate_hz": source.rate_hz, "logger_limit_hz": 1.0 / interval},
        )


def source_frame(analysis: Analysis) -> Iterator[Finding]:
    """The source's x axis is not north."""
    comparison = analysis.comparison
    ekf2 = comparison.flight.ekf2
    if comparison.source.frame != "FRD":
        return
    aligned = False
    if isinstance(ekf2, Ekf2) and isinstance(ekf2.fusing, Unavailable):
        yield Finding(
            "source_frame_not_north",
            "info",
            "The source's frame is FRD: its x axis is where the vehicle pointed at start, not "
            "north. Whether EKF2 fused its yaw, so that the frames are the same, is not in this "
            "recording.",
            "Read 'north' as the source's x axis; the ULog says whether EKF2's is the same.",
        )
        return
    if isinstance(ekf2, Ekf2) and isinstance(ekf2.fusing, pd.DataFrame):
        segment = comparison.segment
        share = step_share(ekf2.fusing["yaw"], segment.start_s, segment.end_s)
        aligned = share > FUSING_SHARE_ERROR.value
    yield Finding(
        "source_frame_not_north",
        "info" if aligned else "warning",
        "The source's frame is FRD: its x axis is where the vehicle pointed at start, not north"
        + (
            "; EKF2 fused its yaw, so that EKF2's frame is the same."
            if aligned
            else ", while the IMU is turned into NED: north and east of the two may differ."
        ),
        "Read 'north' as the source's x axis."
        if aligned
        else "Send the position in NED, or let EKF2 fuse the yaw (EKF2_EV_CTRL bit 3).",
    )


def gaps(analysis: Analysis) -> Iterator[Finding]:
    """The source, the IMU or the logger stopped for a while."""
    comparison = analysis.comparison
    segment, source = comparison.segment, comparison.source
    measured_s = comparison.axes[0].axis.measurement_time_s
    intervals = np.diff(measured_s)
    limit = max(GAP.value, GAP_INTERVALS.value / source.rate_hz)
    long = intervals[intervals > limit]
    if len(long):
        at = float(measured_s[:-1][intervals > limit][np.argmax(long)])
        yield Finding(
            "source_gap",
            "warning",
            f"The source was silent {times(len(long))} for more than {limit:.1f} s, the longest "
            f"time {long.max():.1f} s at {at:.1f} s: only the IMU carries the position there.",
            "Check line of sight to the anchors and the link; analyse one side with --start, "
            "--end.",
            {"count": float(len(long)), "longest_s": float(long.max()), "at_s": at},
        )
    lost = [
        d for d in comparison.flight.log.dropouts
        if d.start_s <= segment.end_s and d.start_s + d.duration_s >= segment.start_s
    ]  # fmt: skip
    if lost:
        total = sum(d.duration_s for d in lost)
        yield Finding(
            "logger_dropouts",
            "warning",
            f"The logger lost data {times(len(lost))}, {total:.2f} s in all, the longest "
            f"{max(d.duration_s for d in lost):.2f} s.",
            "Use a faster SD card, or log less (SDLOG_PROFILE).",
            {"count": float(len(lost)), "total_s": total},
        )
    gap_s = comparison.axes[0].replay.input_gap_s
    imu = comparison.flight.imu
    interval_s = 1.0 / sample_rate(imu) if isinstance(imu, pd.DataFrame) else 0.0
    if gap_s > max(IMU_GAP_TOTAL.value, 2.0 * interval_s):
        yield Finding(
            "imu_gap",
            "warning",
            f"The IMU is missing for {gap_s:.2f} s of the segment; the process noise was raised "
            "there to the size of the motion.",
            "Use a faster SD card, or choose a segment without the gap (--start, --end).",
            {"total_s": gap_s},
        )


def no_motion(analysis: Analysis) -> Iterator[Finding]:
    """The vehicle hardly moved: nothing about dynamics can be identified."""
    comparison = analysis.comparison
    extent = motion_range_m(comparison)
    if extent < MOTION_RANGE.value:
        yield Finding(
            "no_motion",
            "warning",
            f"The vehicle moved only {extent:.2f} m horizontally (5 to 95 %): velocity, heading "
            "and clock offset cannot be judged from this flight.",
            "Fly several passes of 5 m or more, with clear starts and stops.",
            {"range_m": extent},
        )


def logging_rate_low(analysis: Analysis) -> Iterator[Finding]:
    """Topics that were logged too slowly for what is done with them."""
    comparison = analysis.comparison
    flight = comparison.flight
    mavlink = flight.log.format.startswith("MAVLink")
    for part, name, default, threshold in (
        (flight.imu, "imu", "sensor_combined", MIN_IMU_RATE),
        (flight.attitude, "attitude", "vehicle_attitude", MIN_ATTITUDE_RATE),
    ):
        topic = flight.streams[name].topics[0] if name in flight.streams else default
        if isinstance(part, pd.DataFrame) and sample_rate(part) < RATE_MARGIN * threshold.value:
            yield Finding(
                "logging_rate_low",
                "warning",
                f"{topic} was logged at {sample_rate(part):.1f} Hz, below the "
                f"{threshold.value:g} Hz that the acceleration needs: motion between samples "
                "is lost.",
                f"Raise its stream rate (mavlink stream -d DEVICE -s {topic} -r "
                f"{2 * threshold.value:g} in PX4's console), or join the ULog (--mavlink)."
                if mavlink
                else f'Put the line "{topic} 0" into etc/logging/logger_topics.txt on the SD card.',
                {"rate_hz": sample_rate(part), "needed_hz": threshold.value, "topic": topic},
            )
    innovations = next(
        (
            a.ekf2_innovations
            for a in comparison.axes
            if isinstance(a.ekf2_innovations, pd.DataFrame)
        ),
        None,
    )
    if innovations is not None and not comparison.source.reconstructed:
        count = len(comparison.axes[0].replay.updates)
        share = len(innovations) / count
        if share < MIN_INNOVATION_SHARE.value and isinstance(flight.ekf2, Ekf2):
            topic = flight.ekf2.innovation_topics[0]
            yield Finding(
                "ekf2_innovations_decimated",
                "info",
                f"The log holds {len(innovations)} EKF2 innovations for {count} measurements: "
                f"{1 - share:.0%} of what EKF2 did with the source is not in it.",
                f'Put the line "{topic} 0" into etc/logging/logger_topics.txt on the SD card.',
                {"logged": float(len(innovations)), "measurements": float(count)},
            )


def input_unavailable(analysis: Analysis) -> Iterator[Finding]:
    """No IMU or attitude: the filter ran without its input."""
    comparison = analysis.comparison
    acceleration = comparison.axes[0].axis.acceleration
    if isinstance(acceleration, Unavailable):
        yield Finding(
            "input_unavailable",
            "warning",
            f"No acceleration input ({acceleration.what}: {acceleration.reason}); "
            "our filter assumes constant velocity.",
            acceleration.remedy,
        )


def log_damaged(analysis: Analysis) -> Iterator[Finding]:
    """Bytes or samples that the reader had to pass over."""
    comparison = analysis.comparison
    notes = [n for n in comparison.flight.log.notes if "damaged" in n or "dropped" in n]
    if notes:
        yield Finding(
            "log_damaged",
            "warning",
            sentence(notes[0])
            + (f" (and {len(notes) - 1} more such notes)." if len(notes) > 1 else "."),
            "Copy the log again; if it stays, replace the SD card or mend the MAVLink link.",
            {"notes": float(len(notes))},
        )
