"""External positions that were sent to the autopilot over MAVLink, and the truth."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd

from px4fuse.flight import (
    POSITION_COLUMNS,
    POSITION_VARIANCE_COLUMNS,
    QUATERNION_COLUMNS,
    ROTATION_VARIANCE_COLUMNS,
    STATE_COLUMNS,
    VELOCITY_COLUMNS,
    PositionTrack,
    Truth,
    Unavailable,
    best_first,
)
from px4fuse.origin import with_orientation
from px4fuse.readers.mavlink_clocks import Mapped
from px4fuse.readers.mavlink_messages import (
    FRAMES_OF_REFERENCE,
    POSITION_INPUTS,
    TRUTH,
    PositionInput,
)
from px4fuse.readers.mavlink_recording import RECEIPT_CLOCK, Address, Recording
from px4fuse.readers.mavlink_senders import senders_of
from px4fuse.readers.parts import attitude_of, orientation_of
from px4fuse.readers.px4_positions import (
    GLOBAL_COLUMNS,
    MIN_TRACK_SAMPLES,
    captured_truth,
    clean_positions,
    motion_capture,
    projected,
)


def read_positions(
    recording: Recording, mapped: dict[Address, Mapped], remedy: str
) -> tuple[tuple[PositionTrack, ...], tuple[Unavailable, ...]]:
    """Every external position that was sent to the autopilot, the best first.

    Parameters
    ----------
    mapped : mapping from address to Mapped
        Clock of every sender.
    remedy : str
        What would have recorded one that is missing.
    """
    found: list[PositionTrack | Unavailable] = []
    for message in dict.fromkeys(source.message for source in POSITION_INPUTS):
        senders = senders_of(recording, message)
        tracks = [
            track
            for sender in senders
            for source in POSITION_INPUTS
            if source.message == message
            for track in _read_track(recording, source, sender, mapped[sender], remedy, senders)
        ]
        found += tracks or [
            Unavailable(
                f"position source {message}",
                f"no {message} to the autopilot in the recording",
                remedy,
                source=message,
            )
        ]
    missing = tuple(part for part in found if isinstance(part, Unavailable))
    return best_first(part for part in found if isinstance(part, PositionTrack)), missing


def _read_track(
    recording: Recording,
    source: PositionInput,
    sender: Address,
    clock: Mapped,
    remedy: str,
    senders: list[Address],
) -> tuple[PositionTrack | Unavailable, ...]:
    """What one sender sent of one kind; nothing where it did not."""
    rows = recording.rows(source.message, sender)
    table = recording.frames.table(source.message, rows)
    if source.estimator is not None:
        own = table["estimator_type"] == source.estimator
        rows, table = rows[own], table[own]
    if not len(rows):
        return ()
    name = source.name + (f"_{sender[0]}_{sender[1]}" if len(senders) > 1 else "")
    stamp_s = table[source.stamp] * 1e-6
    boot_s = recording.receipt_boot_s(rows)
    if clock.to_boot is not None:
        boot_s = np.where(stamp_s > 0.0, clock.to_boot.at(stamp_s), np.nan)
    samples = recording.read(source.layout, rows, boot_s, name)
    frame = "NED"
    if "frame_id" in samples and len(samples):
        # one frame per track: that of the last sample, as PX4 would have used it
        reference = FRAMES_OF_REFERENCE.get(int(samples["frame_id"].iloc[-1]))
        frame = "unknown" if reference is None else reference.name
    if source.drops_covariance:
        samples[POSITION_VARIANCE_COLUMNS + ROTATION_VARIANCE_COLUMNS] = np.nan
    orientation = orientation_of(samples)
    samples = clean_positions(samples, POSITION_COLUMNS)
    if len(samples) < MIN_TRACK_SAMPLES:
        reason = f"{len(samples)} finite samples are too few"
        return (Unavailable(f"position source {name}", reason, remedy, source=name),)
    statement = clock.statement
    is_boot = statement.method == "boot clock"
    return (
        PositionTrack(
            name=name,
            origin=with_orientation(source.origin, turns=orientation is not None),
            description=source.description,
            samples=samples,
            frame=frame,
            clock=statement.clock
            + ("" if is_boot else f", mapped to boot time by {statement.method}"),
            topics=(source.message,),
            log=recording.frames.name,
            clock_map=statement,
            orientation=orientation,
        ),
    )


def read_truth(
    recording: Recording, positions: tuple[PositionTrack, ...], remedies: Mapping[str, str]
) -> Truth | Unavailable:
    """Simulation truth, or motion capture where another track feeds EKF2.

    Simulation truth carries no usable clock (``HIL_STATE_QUATERNION.time_usec`` is 0 in PX4), so
    the time of receipt is taken, and no local position, so it is projected about its own first
    sample, where the simulated vehicle was put.
    """
    for layout in TRUTH:
        rows = recording.rows(layout.topic)
        if len(rows) < MIN_TRACK_SAMPLES:
            continue
        samples = recording.read(layout, rows, recording.receipt_boot_s(rows))
        samples = samples.dropna(subset=GLOBAL_COLUMNS[:2])
        if not samples["latitude_deg"].any():
            continue
        samples = samples.reindex(columns=[*GLOBAL_COLUMNS, *VELOCITY_COLUMNS, *QUATERNION_COLUMNS])
        if not samples[VELOCITY_COLUMNS].to_numpy().any():
            # not sent: a vehicle that never moves has no use for truth
            samples[VELOCITY_COLUMNS] = np.nan
        recording.came_from("truth", RECEIPT_CLOCK, layout.topic)
        state = pd.concat([projected(samples, None), samples[VELOCITY_COLUMNS]], axis=1)
        return Truth(layout.topic, state[STATE_COLUMNS], attitude_of(samples))
    captured = motion_capture(positions, "ATT_POS_MOCAP")
    if captured is None:
        return Unavailable(
            "ground truth",
            "neither simulation truth nor motion capture is in the recording",
            remedies["truth"],
        )
    recording.came_from("truth", captured.clock, *captured.topics)
    return captured_truth(captured)
