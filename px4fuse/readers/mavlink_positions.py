"""External positions that were sent to the autopilot over MAVLink, and the truth."""

from __future__ import annotations

from typing import Any

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from px4fuse.arrays import Array, IntArray
from px4fuse.flight import (
    POSITION_COLUMNS,
    POSITION_VARIANCE_COLUMNS,
    QUATERNION_COLUMNS,
    ROTATION_VARIANCE_COLUMNS,
    STATE_COLUMNS,
    PositionTrack,
    Truth,
    Unavailable,
    best_first,
)
from px4fuse.origin import with_orientation
from px4fuse.readers.mavlink_clocks import Mapped
from px4fuse.readers.mavlink_ekf2 import odometry
from px4fuse.readers.mavlink_messages import (
    FRAMES_OF_REFERENCE,
    ODOMETRY_INPUTS,
    POSE_DIAGONAL,
    POSITION_INPUTS,
    ROTATION_DIAGONAL,
    PositionInput,
    Remedies,
)
from px4fuse.readers.mavlink_recording import (
    RECEIPT_CLOCK,
    Address,
    Recording,
    quaternions_of_angles,
    vector,
)
from px4fuse.readers.mavlink_senders import senders_of
from px4fuse.readers.parts import orientation_of
from px4fuse.readers.px4_positions import (
    MIN_TRACK_SAMPLES,
    captured_truth,
    clean_positions,
    motion_capture,
    project,
)

TRACK_COLUMNS = [
    *POSITION_COLUMNS, *POSITION_VARIANCE_COLUMNS, *QUATERNION_COLUMNS, *ROTATION_VARIANCE_COLUMNS,
]  # fmt: skip


def read_positions(
    recording: Recording, mapped: dict[Address, Mapped], remedies: Remedies
) -> tuple[tuple[PositionTrack, ...], tuple[Unavailable, ...]]:
    """Every external position that was sent to the autopilot, the best first.

    Parameters
    ----------
    mapped : mapping from address to Mapped
        Clock of every sender.
    """
    found: list[PositionTrack | Unavailable] = []
    for source in POSITION_INPUTS:
        senders = senders_of(recording, source.message)
        before = len(found)
        for sender in senders:
            suffix = f"_{sender[0]}_{sender[1]}" if len(senders) > 1 else ""
            rows = recording.rows(source.message, sender)
            for kind, part in _kinds(source, recording.frames.table(source.message, rows)):
                track = _read_track(recording, kind, suffix, rows[part], mapped[sender])
                found.append(
                    structs.replace(track, remedy=remedies.position)
                    if isinstance(track, Unavailable)
                    else track
                )
        if len(found) == before:
            found.append(
                Unavailable(
                    f"position source {source.message}",
                    f"no {source.message} to the autopilot in the recording",
                    remedies.position,
                    source=source.message,
                )
            )
    tracks = [part for part in found if isinstance(part, PositionTrack)]
    missing = tuple(part for part in found if isinstance(part, Unavailable))
    return best_first(tracks), missing


def _kinds(source: PositionInput, table: NDArray[Any]) -> list[tuple[PositionInput, IntArray]]:
    """Tracks in one message: one, or for ODOMETRY one per kind of estimator."""
    if source.message != "ODOMETRY":
        return [(source, np.arange(len(table)))]
    parts = [
        (kind, np.flatnonzero(table["estimator_type"] == number))
        for number, kind in ODOMETRY_INPUTS.items()
    ]
    return [(kind, part) for kind, part in parts if len(part)]


def _read_track(
    recording: Recording, source: PositionInput, suffix: str, rows: IntArray, clock: Mapped
) -> PositionTrack | Unavailable:
    table = recording.frames.table(source.message, rows)
    frame = "NED"
    if source.message == "ODOMETRY":
        state, variances = odometry(table)
        position, variance = state[:, :3], variances[:, :3]
        # one frame per track: that of the last sample, as PX4 would have used it
        reference = FRAMES_OF_REFERENCE.get(int(table["frame_id"][-1]))
        frame = "unknown" if reference is None else reference.name
    else:
        position = vector(table, "x", "y", "z")
        variance = table["covariance"][:, POSE_DIAGONAL].astype(np.float64)
    quaternion, turn_variance = _orientation(source, table, frame)
    if source.drops_covariance:
        variance, turn_variance = np.full_like(variance, np.nan), np.full_like(variance, np.nan)
    stamp_s = table[source.stamp] * 1e-6
    boot_s = (
        recording.receipt_boot_s(rows)
        if clock.to_boot is None
        else np.where(stamp_s > 0.0, clock.to_boot.at(stamp_s), np.nan)
    )
    name = source.name + suffix
    values = np.column_stack([position, variance, quaternion, turn_variance])
    samples = recording.frame(name, boot_s, TRACK_COLUMNS, values)
    orientation = orientation_of(samples)
    samples = clean_positions(samples, POSITION_COLUMNS)
    if len(samples) < MIN_TRACK_SAMPLES:
        return Unavailable(
            f"position source {name}",
            f"{len(samples)} finite samples are too few",
            "",
            source=name,
        )
    statement = clock.statement
    mapping = (
        "" if statement.method == "boot clock" else f", mapped to boot time by {statement.method}"
    )
    return PositionTrack(
        name=name,
        origin=with_orientation(source.origin, turns=orientation is not None),
        description=source.description,
        samples=samples,
        frame=frame,
        clock=f"{statement.clock}{mapping}",
        topics=(source.message,),
        log=recording.frames.name,
        clock_map=statement,
        orientation=orientation,
    )


def _orientation(source: PositionInput, table: NDArray[Any], frame: str) -> tuple[Array, Array]:
    """Quaternions w, x, y, z from body FRD, shape (n, 4), and rotation variances, shape (n, 3).

    NaN where the frame is not one of NED and FRD: what such a sender calls its body is not known.
    """
    nothing = np.full((len(table), 4), np.nan), np.full((len(table), 3), np.nan)
    if source.message == "ODOMETRY":
        reference = FRAMES_OF_REFERENCE.get(int(table["frame_id"][-1]))
        if reference is None or not reference.as_is or np.ptp(table["frame_id"]):
            return nothing
        covariance = table["pose_covariance"]
    else:
        covariance = table["covariance"]
    variance = covariance[:, ROTATION_DIAGONAL].astype(np.float64)
    if source.message != "VISION_POSITION_ESTIMATE":
        return table["q"].astype(np.float64), variance
    return quaternions_of_angles(table), variance


def read_truth(
    recording: Recording, positions: tuple[PositionTrack, ...], remedies: Remedies
) -> Truth | Unavailable:
    """Simulation truth, or motion capture where another track feeds EKF2.

    Simulation truth carries no usable clock (``HIL_STATE_QUATERNION.time_usec`` is 0 in PX4), so
    the time of receipt is taken, and no local position, so it is projected about its own first
    sample, where the simulated vehicle was put.
    """
    for message, read in (
        ("HIL_STATE_QUATERNION", _hil_state),
        ("SIM_STATE", _sim_state),
        ("SIMSTATE", _simstate),
    ):
        rows = recording.rows(message)
        if len(rows) < MIN_TRACK_SAMPLES:
            continue
        latitude, longitude, height, velocity, attitude = read(
            recording.frames.table(message, rows)
        )
        if not np.any(velocity):  # not sent: a vehicle that never moves has no use for truth
            velocity = np.full_like(velocity, np.nan)
        north, east = project(latitude, longitude, (float(latitude[0]), float(longitude[0])))
        values = np.column_stack([north, east, height[0] - height, velocity, attitude])
        samples = recording.frame(
            message, recording.receipt_boot_s(rows), STATE_COLUMNS + QUATERNION_COLUMNS, values
        ).dropna(subset=POSITION_COLUMNS[:2])
        if len(samples):
            recording.came_from("truth", RECEIPT_CLOCK, message)
            turns = orientation_of(samples)
            return Truth(
                message,
                samples[STATE_COLUMNS],
                None if turns is None else turns[QUATERNION_COLUMNS],
            )
    captured = motion_capture(positions, "ATT_POS_MOCAP")
    if captured is None:
        return Unavailable(
            "ground truth",
            "neither simulation truth nor motion capture is in the recording",
            remedies.truth,
        )
    recording.came_from("truth", captured.clock, *captured.topics)
    return captured_truth(captured)


def _hil_state(table: NDArray[Any]) -> tuple[Array, Array, Array, Array, Array]:
    """Latitude, longitude (degrees), height (m), NED velocity (m/s) and quaternion w, x, y, z.

    Of shapes (n,), (n,), (n,), (n, 3) and (n, 4); NaN where there is none.
    """
    return (
        table["lat"] * 1e-7,
        table["lon"] * 1e-7,
        table["alt"] * 1e-3,
        vector(table, "vx", "vy", "vz", scale=1e-2),
        table["attitude_quaternion"].astype(np.float64),
    )


def _sim_state(table: NDArray[Any]) -> tuple[Array, Array, Array, Array, Array]:
    """As :func:`_hil_state`; latitude as integer where the sender has that extension."""
    fine = bool(np.any(table["lat_int"]))
    latitude = table["lat_int"] * 1e-7 if fine else table["lat"].astype(np.float64)
    longitude = table["lon_int"] * 1e-7 if fine else table["lon"].astype(np.float64)
    velocity, attitude = vector(table, "vn", "ve", "vd"), vector(table, "q1", "q2", "q3", "q4")
    return latitude, longitude, table["alt"].astype(np.float64), velocity, attitude


def _simstate(table: NDArray[Any]) -> tuple[Array, Array, Array, Array, Array]:
    """As :func:`_hil_state`; ArduPilot's has no height and no velocity."""
    nothing = np.full((len(table), 4), np.nan)
    return table["lat"] * 1e-7, table["lng"] * 1e-7, nothing[:, 0], nothing[:, :3], nothing
