"""Two recordings of one flight on one clock: what one lacks, the other gives."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy as np
import pandas as pd
from msgspec import structs
from scipy.spatial.transform import Rotation

from px4fuse.errors import MissingDataError
from px4fuse.flight import (
    POSITION_COLUMNS,
    QUATERNION_COLUMNS,
    Ekf2,
    Flight,
    FlightMode,
    FusionRecord,
    PositionTrack,
    Reset,
    Truth,
    Unavailable,
    best_first,
)
from px4fuse.readers.parts import missing_parts
from px4fuse.recording import InputFile

Table = TypeVar("Table", pd.DataFrame, pd.Series)
# Both recordings must hold this much of the same time
MIN_OVERLAP_S = 2.0
# EKF2's position is sent as it is logged: what is left is interpolation between samples
MAX_POSITION_DIFFERENCE_M = 0.5
MAX_ATTITUDE_DIFFERENCE_DEG = 10.0
MIN_COMMON_SAMPLES = 5


def join(flight: Flight, other: Flight) -> Flight:
    """Join two recordings of one flight on the autopilot's boot clock.

    Parameters
    ----------
    flight : Flight
        Keeps its time zero and everything that it has.
    other : Flight
        Gives what ``flight`` lacks, and all its position tracks.

    Raises
    ------
    MissingDataError
        The two do not overlap in time, or are not of the same flight.
    """
    if other.log.sha256 == flight.log.sha256:
        raise MissingDataError(
            f"{other.log.name}: the same recording twice. Give the other recording of the flight."
        )
    shift_s = other.log.boot_time_s - flight.log.boot_time_s
    low, high = max(0.0, shift_s), min(flight.log.duration_s, shift_s + other.log.duration_s)
    if high - low < MIN_OVERLAP_S:
        raise MissingDataError(
            f"{flight.log.name} and {other.log.name} do not overlap in time: {_span(flight)} and "
            f"{_span(other)} on the autopilot's boot clock. Give the recordings of one flight."
        )
    moved = _shifted(other, shift_s)
    unix_s = flight.log.start_unix_s
    if unix_s is None and other.log.start_unix_s is not None:
        unix_s = other.log.start_unix_s - shift_s
    agreement = _agreement(flight, moved)
    taken: dict[str, object] = {}
    streams = dict(flight.streams)
    for part in ("imu", "attitude", "ekf2", "truth", "airborne", "modes"):
        mine, theirs = getattr(flight, part), getattr(moved, part)
        if isinstance(mine, Unavailable) and not isinstance(theirs, Unavailable):
            taken[part] = theirs
            streams |= {k: v for k, v in moved.streams.items() if k.startswith(part)}
    ekf2 = flight.ekf2
    if (
        isinstance(ekf2, Ekf2)
        and isinstance(ekf2.variance, Unavailable)
        and isinstance(moved.ekf2, Ekf2)
        and isinstance(moved.ekf2.variance, pd.DataFrame)
    ):
        taken["ekf2"] = replace(ekf2, variance=moved.ekf2.variance)
        streams["ekf2_variance"] = moved.streams["ekf2_variance"]
    joined = replace(flight, **taken)  # type: ignore[arg-type]
    lacking = missing_parts(joined.imu, joined.attitude, joined.ekf2, joined.truth)
    return replace(
        joined,
        log=structs.replace(
            flight.log,
            notes=(
                *flight.log.notes,
                *(f"{other.log.name}: {note}" for note in other.log.notes),
                f"joined with {other.log.name} on the boot clock, {high - low:.1f} s in common; "
                f"{agreement}",
            ),
            start_unix_s=unix_s,
            damage=(
                *flight.log.damage,
                *(f"{other.log.name}: {said}" for said in other.log.damage),
            ),
            senders=flight.log.senders or other.log.senders,
        ),
        positions=best_first((*flight.positions, *moved.positions)),
        missing=(*lacking, *(part for part in flight.missing if part.source)),
        streams=streams,
        clocks=(*flight.clocks, *other.clocks),
        unused=(*flight.unused, *other.unused),
        inputs=(
            *flight.inputs,
            InputFile(other.log.name, other.log.sha256, other.log.bytes, "mavlink"),
        ),
    )


def _span(flight: Flight) -> str:
    start = flight.log.boot_time_s
    return f"{start:.1f} s to {start + flight.log.duration_s:.1f} s"


def _later(frame: Table, shift_s: float) -> Table:
    return frame.set_axis(pd.Index(frame.index.to_numpy() + shift_s, name="time_s"))


def _shifted(flight: Flight, shift_s: float) -> Flight:
    """The same flight counted from another time zero."""

    def moved(part: pd.DataFrame | Unavailable) -> pd.DataFrame | Unavailable:
        return part if isinstance(part, Unavailable) else _later(part, shift_s)

    ekf2, truth, airborne, modes = flight.ekf2, flight.truth, flight.airborne, flight.modes
    if isinstance(ekf2, Ekf2):
        ekf2 = replace(
            ekf2,
            state=_later(ekf2.state, shift_s),
            variance=moved(ekf2.variance),
            innovations={axis: moved(part) for axis, part in ekf2.innovations.items()},
            fusing=moved(ekf2.fusing),
            accelerometer_bias=moved(ekf2.accelerometer_bias),
            resets=tuple(Reset(r.time_s + shift_s, r.quantity, r.delta) for r in ekf2.resets),
            instances=tuple((time + shift_s, number) for time, number in ekf2.instances),
            record=_later_record(ekf2.record, shift_s),
        )
    if isinstance(truth, Truth):
        truth = replace(
            truth,
            samples=_later(truth.samples, shift_s),
            attitude=None if truth.attitude is None else _later(truth.attitude, shift_s),
        )
    if not isinstance(airborne, Unavailable):
        airborne = tuple((start + shift_s, end + shift_s) for start, end in airborne)
    if not isinstance(modes, Unavailable):
        modes = tuple(FlightMode(m.start_s + shift_s, m.end_s + shift_s, m.name) for m in modes)
    tracks: list[PositionTrack] = [
        replace(
            track,
            samples=_later(track.samples, shift_s),
            orientation=None if track.orientation is None else _later(track.orientation, shift_s),
        )
        for track in flight.positions
    ]
    return replace(
        flight,
        imu=moved(flight.imu),
        attitude=moved(flight.attitude),
        positions=tuple(tracks),
        ekf2=ekf2,
        truth=truth,
        airborne=airborne,
        modes=modes,
    )


def _later_record(record: FusionRecord | Unavailable, shift_s: float) -> FusionRecord | Unavailable:
    if isinstance(record, Unavailable):
        return record
    return replace(
        record,
        delayed=_later(record.delayed, shift_s),
        vision_age_s=_later(record.vision_age_s, shift_s),
    )


def _agreement(flight: Flight, other: Flight) -> str:
    """How well two recordings agree where both know the same thing.

    Two flights may both count from a boot of their own, so that overlap alone proves nothing.
    """
    if isinstance(flight.ekf2, Ekf2) and isinstance(other.ekf2, Ekf2):
        mine, theirs = flight.ekf2.state, other.ekf2.state
        at = theirs.index[(theirs.index >= mine.index[0]) & (theirs.index <= mine.index[-1])]
        if len(at) >= MIN_COMMON_SAMPLES:
            difference = np.column_stack(
                [np.interp(at, mine.index, mine[c]) - theirs.loc[at, c] for c in POSITION_COLUMNS]
            )
            median = float(np.median(np.linalg.norm(difference, axis=1)))
            if median > MAX_POSITION_DIFFERENCE_M:
                raise MissingDataError(
                    f"{flight.log.name} and {other.log.name} are not of the same flight: EKF2's "
                    f"positions differ by {median:.2f} m (median). Give the recordings of one "
                    "flight."
                )
            return f"their EKF2 positions differ by {median:.3f} m (median)"
    if isinstance(flight.attitude, pd.DataFrame) and isinstance(other.attitude, pd.DataFrame):
        nearest = pd.merge_asof(
            flight.attitude, other.attitude, left_index=True, right_index=True,
            direction="nearest", tolerance=0.1,  # type: ignore[arg-type]
        ).dropna()  # fmt: skip
        if len(nearest) >= MIN_COMMON_SAMPLES:
            first, second = (
                Rotation.from_quat(
                    nearest[[c + suffix for c in QUATERNION_COLUMNS]].to_numpy(copy=True),
                    scalar_first=True,
                )
                for suffix in ("_x", "_y")
            )
            angle = float(np.degrees(np.median((first.inv() * second).magnitude())))
            if angle > MAX_ATTITUDE_DIFFERENCE_DEG:
                raise MissingDataError(
                    f"{flight.log.name} and {other.log.name} are not of the same flight: their "
                    f"attitudes differ by {angle:.0f}° (median). Give the recordings of one flight."
                )
            return f"their attitudes differ by {angle:.1f}° (median)"
    return "that they are of the same flight could not be checked: nothing is in both"
