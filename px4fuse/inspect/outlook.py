"""What can be done with a log, and what to change before the next flight."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import pandas as pd

from px4fuse.comparison.preparation import NOT_ITS_OWN_TRUTH
from px4fuse.comparison.projection import (
    MIN_COMMON_SAMPLES,
    project_innovations,
    project_state,
    project_truth,
    project_variance,
)
from px4fuse.filter.consistency import MIN_INNOVATIONS
from px4fuse.filter.signals import Axis, Segment, ned_acceleration, within
from px4fuse.findings.ekf2_not_fusing import EV_START_INTERVAL_S
from px4fuse.findings.imu import (
    IMU_GAP_TOTAL_S,
    MIN_ATTITUDE_RATE_HZ,
    MIN_IMU_RATE_HZ,
    too_slow,
)
from px4fuse.findings.missing import MIN_INNOVATION_SHARE, VISION_PROFILE_BIT
from px4fuse.flight import VELOCITY_COLUMNS, Ekf2, Flight, PositionTrack, Unavailable, sample_rate
from px4fuse.origin import MOTION_CAPTURE, RECEIVED

# How a part is named for a person, by its name in Flight.streams
PART_NAMES = {
    "imu": "IMU",
    "attitude": "attitude",
    "ekf2_state": "EKF2 state",
    "ekf2_variance": "EKF2 variance",
    "ekf2_innovations": "innovations",
    "ekf2_fusing": "fusion flags",
    "truth": "truth",
    "airborne": "land detector",
}
# The position as PX4 received it
AS_RECEIVED = "vehicle_visual_odometry"
# EKF2 starts on external vision only where samples are closer than EV_START_INTERVAL_S; with jitter
# a source needs this much more than that rate to be fused without luck
EV_RATE_MARGIN = 1.25


@dataclass(frozen=True)
class Ability:
    """One thing that px4fuse can or cannot do with the log, and with what or why not."""

    name: str
    possible: bool
    reason: str


@dataclass(frozen=True)
class Advice:
    """What to do before the next flight, and for what."""

    remedy: str
    improves: tuple[str, ...]


@dataclass(frozen=True)
class Plan:
    """How far compare would get: its source, segment and first axes, or why not."""

    track: PositionTrack | None
    segment: Segment | None
    axes: tuple[Axis, ...]
    reason: str
    remedy: str


def abilities(flight: Flight, plan: Plan) -> Iterator[Ability]:
    """What compare would do, asked of the functions that compare uses."""
    track, segment = plan.track, plan.segment
    if track is None or segment is None:
        yield Ability("compare", False, plan.reason)
    else:
        count = len(within(track.samples, segment))
        yield Ability(
            "compare",
            True,
            f"our filter on {track.name}, {count} samples, {segment.start_s:.1f} s to "
            f"{segment.end_s:.1f} s",
        )
    acceleration = plan.axes[0].acceleration if plan.axes else ned_acceleration(flight)
    if isinstance(acceleration, Unavailable):
        yield Ability("acceleration", False, f"{acceleration.reason}; velocity is held constant")
    elif slow := list(_too_slow(flight)):
        rates = " and ".join(
            f"{PART_NAMES[key]} at {_hertz(rate)} Hz ({needed:g} Hz are needed)"
            for key, rate, needed in slow
        )
        taken = "" if segment is None else "; compare takes it all the same"
        yield Ability("acceleration", False, f"{rates}: motion between samples is lost{taken}")
    else:
        yield Ability("acceleration", True, "IMU turned into NED by the attitude, gravity removed")
    yield from _ekf2abilities(flight, plan)
    yield _truth_ability(flight, plan)


def _too_slow(flight: Flight) -> Iterator[tuple[str, float, float]]:
    """Part, its rate and the rate that the acceleration needs, where it falls short of that."""
    for key, part, needed in (
        ("imu", flight.imu, MIN_IMU_RATE_HZ),
        ("attitude", flight.attitude, MIN_ATTITUDE_RATE_HZ),
    ):
        if isinstance(part, pd.DataFrame) and too_slow(part, needed):
            yield key, sample_rate(part), needed


def _hertz(rate: float) -> str:
    return f"{rate:.{1 if rate < 10 else 0}f}"


def _ekf2abilities(flight: Flight, plan: Plan) -> Iterator[Ability]:
    names = ("EKF2 states", "EKF2 variances", "EKF2 innovations")
    ekf2 = flight.ekf2
    if isinstance(ekf2, Unavailable):
        for name in names:
            yield Ability(name, False, ekf2.reason)
        return
    if plan.track is None or plan.segment is None:
        for name, part in zip(
            names, (ekf2.state, ekf2.variance, most_innovations(ekf2)), strict=True
        ):
            reason = part.reason if isinstance(part, Unavailable) else "no position to compare on"
            yield Ability(name, False, reason)
        return
    axis, segment = plan.axes[0], plan.segment
    state = project_state(ekf2.state, axis, segment)
    enough = len(state) >= MIN_COMMON_SAMPLES
    yield Ability(names[0], enough, f"{len(state)} samples of position and velocity")
    variance = project_variance(ekf2, axis, segment)
    if isinstance(variance, Unavailable):
        yield Ability(names[1], False, variance.reason)
    else:
        yield Ability(names[1], True, f"{len(variance)} samples")
    found = {
        axis.name: project_innovations(flight, ekf2, plan.track, axis, segment)
        for axis in plan.axes
    }
    counts = {name: len(f) for name, f in found.items() if isinstance(f, pd.DataFrame)}
    if not counts:
        reason = next(part.reason for part in found.values() if isinstance(part, Unavailable))
        yield Ability(names[2], False, reason)
    elif max(counts.values()) < MIN_INNOVATIONS:
        most = max(counts.values())
        yield Ability(names[2], False, f"{most} are too few for a statement")
    else:
        said = ", ".join(f"{name} {count}" for name, count in counts.items())
        yield Ability(names[2], True, f"two-sided consistency: {said}")


def _truth_ability(flight: Flight, plan: Plan) -> Ability:
    truth = flight.truth
    if isinstance(truth, Unavailable):
        return Ability("truth", False, truth.reason)
    if plan.track is None or plan.segment is None:
        return Ability("truth", False, "no position to compare on")
    if plan.track.name == truth.name:
        return Ability("truth", False, NOT_ITS_OWN_TRUTH.reason)
    projected = project_truth(truth, plan.axes[0], plan.segment)
    if isinstance(projected, Unavailable):
        return Ability("truth", False, projected.reason)
    has_velocity = bool(truth.samples[VELOCITY_COLUMNS].notna().any(axis=None))
    what = "position and velocity" if has_velocity else "position only"
    return Ability("truth", True, f"RMSE and NEES of {what} against {truth.name}")


def advice(flight: Flight, plan: Plan) -> tuple[Advice, ...]:
    """What to do before the next flight, most important first, each remedy once."""
    improves: dict[str, dict[str, None]] = {}
    for single in _advice(flight, plan):
        improves.setdefault(single.remedy, {}).update(dict.fromkeys(single.improves))
    return tuple(Advice(remedy, tuple(parts)) for remedy, parts in improves.items())


def _advice(flight: Flight, plan: Plan) -> Iterator[Advice]:
    log, track, ekf2 = flight.log, plan.track, flight.ekf2
    if log.damage:
        remedy = (
            "Record where the link loses no bytes: by cable, or on the companion."
            if log.format.startswith("MAVLink")
            else "Copy the log from the SD card again; if it stays damaged, replace the card."
        )
        yield Advice(remedy, ("everything",))
    if plan.remedy:
        yield Advice(f"{plan.remedy[0].upper()}{plan.remedy[1:]}", ("position",))
    elif track is not None:
        yield from _position_advice(flight, track)
    yield from _rate_advice(flight)
    if isinstance(ekf2, Unavailable):
        yield Advice(ekf2.remedy, ("EKF2",))
    elif log.has_ulog:  # no other autopilot could have recorded more of its estimator
        if track is not None:  # without a position, EKF2 had nothing to fuse
            yield from _innovation_advice(ekf2, track)
        for key, part in (("ekf2_variance", ekf2.variance), ("ekf2_fusing", ekf2.fusing)):
            if isinstance(part, Unavailable):
                yield Advice(part.remedy, (PART_NAMES[key],))
    lost_s = sum(dropout.duration_s for dropout in log.dropouts)
    if lost_s > IMU_GAP_TOTAL_S:
        yield Advice("Use a faster SD card, or log less (SDLOG_PROFILE).", ("dropouts",))
    for key, last in (("airborne", flight.airborne), ("truth", flight.truth)):
        if isinstance(last, Unavailable) and (key == "airborne" or log.has_ulog):
            yield Advice(last.remedy, (PART_NAMES[key],))


def _position_advice(flight: Flight, track: PositionTrack) -> Iterator[Advice]:
    missing = next((part for part in flight.missing if part.source == AS_RECEIVED), None)
    profile = int(flight.log.parameters.get("SDLOG_PROFILE", 1))
    if track.origin.preference > MOTION_CAPTURE.preference and missing is not None:
        remedy = (
            missing.remedy
            if profile & VISION_PROFILE_BIT
            else f"Set SDLOG_PROFILE to {profile | VISION_PROFILE_BIT} (it is {profile}): bit 7 "
            "logs the position as it arrives, vehicle_visual_odometry."
        )
        yield Advice(remedy, ("position",))
    ekf2 = flight.ekf2
    fused = isinstance(ekf2, Ekf2) and isinstance(ekf2.innovations["north"], pd.DataFrame)
    slow = track.rate_hz < EV_RATE_MARGIN / EV_START_INTERVAL_S
    if fused and slow and track.origin.preference == RECEIVED.preference:
        yield Advice(
            "Send the position at 10 Hz: EKF2 (v1.14 and later) starts to fuse only samples less "
            f"than {EV_START_INTERVAL_S:g} s apart.",
            ("EKF2",),
        )


def _rate_advice(flight: Flight) -> Iterator[Advice]:
    for key, part in (("imu", flight.imu), ("attitude", flight.attitude)):
        if isinstance(part, Unavailable):
            yield Advice(part.remedy, (PART_NAMES[key],))
    for key, rate, needed in _too_slow(flight):
        if key in flight.streams:
            topic = flight.streams[key].topics[0]
            how = (
                f'put the line "{topic} 0" into etc/logging/logger_topics.txt on the SD card'
                if flight.log.format == "ULog"
                else f"request {topic} at a higher rate (MAV_CMD_SET_MESSAGE_INTERVAL)"
            )
            yield Advice(
                f"{rate:.1f} Hz is below the {needed:g} Hz that the acceleration needs: {how}.",
                (PART_NAMES[key],),
            )


def _innovation_advice(ekf2: Ekf2, track: PositionTrack) -> Iterator[Advice]:
    innovations, height = ekf2.innovations["north"], ekf2.innovations["down"]
    if isinstance(innovations, Unavailable):
        yield Advice(innovations.remedy, (PART_NAMES["ekf2_innovations"],))
        return
    measured = track.samples.loc[innovations.index[0] : innovations.index[-1]]
    decimated = len(innovations) < MIN_INNOVATION_SHARE * len(measured)
    if decimated and not track.origin.reconstructed and ekf2.innovation_topics:
        yield Advice(
            f'Put the line "{ekf2.innovation_topics[0]} 0" into etc/logging/logger_topics.txt on '
            f"the SD card: the log holds {len(innovations)} EKF2 innovations for "
            f"{len(measured)} measurements.",
            (PART_NAMES["ekf2_innovations"],),
        )
    if isinstance(height, Unavailable):
        yield Advice(height.remedy, ("innovations of height",))


def most_innovations(ekf2: Ekf2) -> pd.DataFrame | Unavailable:
    """Innovations of the axis that has most of them."""
    frames = [frame for frame in ekf2.innovations.values() if isinstance(frame, pd.DataFrame)]
    if frames:
        return max(frames, key=len)
    return next(part for part in ekf2.innovations.values() if isinstance(part, Unavailable))
