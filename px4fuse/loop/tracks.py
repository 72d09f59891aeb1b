"""Trajectories out of a flight: its odometry, EKF2, our filter, and the truth."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation, Slerp

from px4fuse.arrays import Array
from px4fuse.comparison.comparison import compare
from px4fuse.comparison.projection import continuous_state
from px4fuse.errors import MissingDataError
from px4fuse.filter.signals import Segment
from px4fuse.flight import (
    AXIS_NAMES,
    POSITION_COLUMNS,
    POSITION_VARIANCE_COLUMNS,
    QUATERNION_COLUMNS,
    ROTATION_VARIANCE_COLUMNS,
    Ekf2,
    Flight,
    PositionTrack,
    Truth,
    Unavailable,
)
from px4fuse.readers.parts import finite_rows
from px4fuse.trajectory.model import MIN_POSES, Frame, Kind, Trajectory

Part = Literal["vio", "ekf2", "kf", "truth"]
PARTS: tuple[Part, ...] = get_args(Part)


def odometry_of(flight: Flight) -> PositionTrack | Unavailable:
    """The track that is an odometry: external vision with an orientation that turns.

    A positioning system such as UWB sends no orientation, or always the same one.
    """
    for track in flight.positions:
        if track.origin.is_vision and track.orientation is not None:
            return track
    have = ", ".join(track.name for track in flight.positions) or "none"
    return Unavailable(
        "visual-inertial odometry",
        "no external vision with orientation is in the log (position sources: " + have + ")",
        "Send the odometry to PX4 as ODOMETRY and set SDLOG_PROFILE to 129 to log it.",
    )


def trajectory_of(flight: Flight, part: Part) -> Trajectory:
    """One part of a flight as a trajectory.

    Parameters
    ----------
    flight : Flight
    part : {"vio", "ekf2", "kf", "truth"}
        "kf" is our filter, along north, east and down, with the autopilot's attitude.

    Raises
    ------
    MissingDataError
        The log lacks it; the text says what would have logged it.
    """
    if part == "kf":
        return _ours(flight)
    found = {"vio": odometry_of(flight), "truth": flight.truth, "ekf2": flight.ekf2}[part]
    if isinstance(found, PositionTrack):
        # where the log does not say, x is taken to be forward at the start
        frame: Frame = "NED" if found.frame == "NED" else "FRD"
        note = f"{found.name}: {found.description}"
        return _trajectory(flight, part, found.samples, found.orientation, (note,), frame)
    if isinstance(found, Truth):
        return _trajectory(flight, part, found.samples, found.attitude, (found.name,))
    if not isinstance(found, Ekf2):
        raise MissingDataError(f"{flight.log.name}:{part}: {found.reason}", f"{found.remedy}")
    state, notes = found.state, ["EKF2's position as published"]
    source = next((t for t in flight.positions if t.origin.is_vision), None)
    if source is not None:
        whole = Segment(0.0, flight.log.duration_s, "the whole log")
        state, resets = continuous_state(found, source, whole)
        notes += [resets] if resets else []
    return _trajectory(flight, part, state, flight.attitude, tuple(notes))


def _ours(flight: Flight) -> Trajectory:
    compared = compare(flight, axes=AXIS_NAMES)
    position = pd.DataFrame(
        {
            column: result.replay.steps["position_m"]
            for column, result in zip(POSITION_COLUMNS, compared.axes.values(), strict=True)
        }
    )
    used = compared.settings
    note = (
        f"our filter over {compared.source.name}, SIGMA_A {used.sigma_a_m_s2:g} m/s², SIGMA_Z "
        f"{used.sigma_z_m:g} m"
    )
    return _trajectory(flight, "kf", position, flight.attitude, (note,))


def _trajectory(
    flight: Flight,
    part: Kind,
    samples: pd.DataFrame,
    orientation: pd.DataFrame | Unavailable | None,
    notes: tuple[str, ...],
    frame: Frame = "NED",
) -> Trajectory:
    """Poses at the times of the positions, the orientation interpolated to them (slerp)."""
    samples = finite_rows(samples, POSITION_COLUMNS)
    rotation, rotation_variance = None, None
    if isinstance(orientation, pd.DataFrame):
        known = orientation.index.to_numpy()
        inside = samples[(samples.index >= known[0]) & (samples.index <= known[-1])]
        if len(inside) >= MIN_POSES:
            samples = inside
            quaternions = orientation[QUATERNION_COLUMNS].to_numpy(copy=True)
            turns = Rotation.from_quat(quaternions, scalar_first=True)
            rotation = Slerp(known, turns)(samples.index.to_numpy())
            reported = _whole(orientation, ROTATION_VARIANCE_COLUMNS)
            if reported is not None:
                columns = [np.interp(samples.index, known, column) for column in reported.T]
                rotation_variance = np.column_stack(columns)
    if len(samples) < MIN_POSES:
        raise MissingDataError(
            f"{flight.log.name}:{part}: {len(samples)} poses are too few (at least {MIN_POSES})."
        )
    return Trajectory(
        name=f"{flight.log.name}:{part}",
        kind=part,
        time_s=samples.index.to_numpy(np.float64),
        position_m=samples[POSITION_COLUMNS].to_numpy(np.float64),
        rotation=rotation,
        frame=frame,
        unix_offset_s=flight.log.start_unix_s,
        position_variance_m2=_whole(samples, POSITION_VARIANCE_COLUMNS),
        rotation_variance_rad2=rotation_variance,
        sha256=flight.log.sha256,
        size_bytes=flight.log.bytes,
        notes=notes,
    )


def _whole(samples: pd.DataFrame, columns: list[str]) -> Array | None:
    """Reported variances, shape (n, 3); None where there are none, or some are missing."""
    if not set(columns) <= set(samples.columns) or samples[columns].isna().to_numpy().any():
        return None
    return samples[columns].to_numpy(np.float64)
