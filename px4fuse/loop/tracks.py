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
        return _odometry(flight, found)
    if isinstance(found, Ekf2):
        return _ekf2(flight, found)
    if isinstance(found, Truth):
        samples = finite_rows(found.samples, POSITION_COLUMNS)[POSITION_COLUMNS]
        return _trajectory(flight, part, samples, found.attitude, "NED", None, (found.name,))
    raise MissingDataError(f"{flight.log.name}:{part}: {found.reason}. {found.remedy}")


def _odometry(flight: Flight, track: PositionTrack) -> Trajectory:
    # where the log does not say, x is taken to be forward at the start
    frame: Frame = "NED" if track.frame == "NED" else "FRD"
    samples = finite_rows(track.samples, POSITION_COLUMNS)
    return _trajectory(
        flight,
        "vio",
        samples[POSITION_COLUMNS],
        track.orientation,
        frame,
        samples[POSITION_VARIANCE_COLUMNS],
        (f"{track.name}: {track.description}",),
    )


def _ekf2(flight: Flight, ekf2: Ekf2) -> Trajectory:
    state, resets = ekf2.state, ""
    source = next((t for t in flight.positions if t.origin.is_vision), None)
    if source is not None:
        whole = Segment(0.0, flight.log.duration_s, "the whole log")
        state, resets = continuous_state(ekf2, source, whole)
    attitude = None if isinstance(flight.attitude, Unavailable) else flight.attitude
    notes = tuple(note for note in ("EKF2's position as published", resets) if note)
    return _trajectory(flight, "ekf2", state[POSITION_COLUMNS], attitude, "NED", None, notes)


def _ours(flight: Flight) -> Trajectory:
    compared = compare(flight, axes=AXIS_NAMES)
    position = pd.DataFrame(
        {
            column: result.replay.steps["position_m"]
            for column, result in zip(POSITION_COLUMNS, compared.axes.values(), strict=True)
        }
    ).dropna()
    attitude = None if isinstance(flight.attitude, Unavailable) else flight.attitude
    used = compared.settings
    note = (
        f"our filter over {compared.source.name}, SIGMA_A {used.sigma_a_m_s2:g} m/s², SIGMA_Z "
        f"{used.sigma_z_m:g} m"
    )
    return _trajectory(flight, "kf", position, attitude, "NED", None, (note,))


def _trajectory(
    flight: Flight,
    part: Kind,
    position: pd.DataFrame,
    orientation: pd.DataFrame | None,
    frame: Frame,
    variance: pd.DataFrame | None,
    notes: tuple[str, ...],
) -> Trajectory:
    """Poses at the times of the positions, the orientation interpolated to them (slerp)."""
    rotation, rotation_variance = None, None
    if orientation is not None:
        inside = (position.index >= orientation.index[0]) & (
            position.index <= orientation.index[-1]
        )
        if inside.sum() >= MIN_POSES:
            position = position[inside]
            variance = None if variance is None else variance[inside]
            times = position.index.to_numpy()
            quaternions = orientation[QUATERNION_COLUMNS].to_numpy(copy=True)
            known = Rotation.from_quat(quaternions, scalar_first=True)
            rotation = Slerp(orientation.index.to_numpy(), known)(times)
            rotation_variance = _at(orientation, times)
    if len(position) < MIN_POSES:
        raise MissingDataError(
            f"{flight.log.name}:{part}: {len(position)} poses are too few (at least {MIN_POSES})."
        )
    if variance is not None and variance.isna().to_numpy().any():
        variance = None
    return Trajectory(
        name=f"{flight.log.name}:{part}",
        kind=part,
        time_s=position.index.to_numpy(np.float64),
        position_m=position.to_numpy(np.float64),
        rotation=rotation,
        frame=frame,
        unix_offset_s=flight.log.start_unix_s,
        position_variance_m2=None if variance is None else variance.to_numpy(np.float64),
        rotation_variance_rad2=rotation_variance,
        sha256=flight.log.sha256,
        size_bytes=flight.log.bytes,
        notes=notes,
    )


def _at(orientation: pd.DataFrame, times: Array) -> Array | None:
    """Reported rotation variances at some times, shape (n, 3); None where there are none."""
    if not set(ROTATION_VARIANCE_COLUMNS) <= set(orientation.columns):
        return None
    values = orientation[ROTATION_VARIANCE_COLUMNS].to_numpy()
    if np.isnan(values).any():
        return None
    return np.column_stack([np.interp(times, orientation.index, column) for column in values.T])
