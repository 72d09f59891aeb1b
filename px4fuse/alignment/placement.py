"""An external position file placed into a flight: clock, frame, yaw and origin.

A UWB computer records on its own clock and in its own frame. Both are found by matching its track
with a reference in the log: EKF2's position, or, where that does not serve, the IMU's acceleration
integrated twice, with both sides passed through the same filter.

Horizontal positions are complex numbers here, north + i·east, so that a yaw is a factor e^{iψ}. The
clock is found in two steps: over all lags by masked cross-correlation through the FFT (Padfield
2012), then far below one sample by robust least squares. What is found is relative to the
reference: an EKF2 that was fed with late positions is late itself, and the clock offset with it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from msgspec import structs

from px4fuse.alignment.description import describe
from px4fuse.alignment.matching import Question, find_match
from px4fuse.alignment.tracks import EKF2_POSITION, FRAMES, IMU, MIN_SAMPLES, NoMatchError
from px4fuse.errors import MissingDataError, SettingsError
from px4fuse.flight import Flight, PositionTrack
from px4fuse.origin import GIVEN_FILE
from px4fuse.readers.parts import finite_rows
from px4fuse.recording import InputFile

if TYPE_CHECKING:
    from px4fuse.readers.position_csv import PositionRecording

__all__ = ["EKF2_POSITION", "IMU", "place"]


def place(
    flight: Flight,
    file: PositionRecording,
    *,
    frame: str | None = None,
    yaw_deg: float | Literal["auto"] | None = None,
    clock_offset_s: float | None = None,
) -> Flight:
    """Place an external position file into a flight, as its first position track.

    Parameters
    ----------
    frame : {"ned", "enu", "nwu"}, optional
        What the file's x, y, z are; by default what its column names say, or else what fits.
    yaw_deg : float or "auto", optional
        Rotation of the file about down, clockwise seen from above, after the frame. None is 0: the
        file's frame is EKF2's but for the names of its axes. "auto" finds yaw and origin.
    clock_offset_s : float, optional
        The autopilot's boot clock minus the file's; by default it is found, relative to the
        reference. Where EKF2 was fed with late positions its track lags the vehicle, and the
        offset that is found contains this lag.

    Returns
    -------
    Flight
        With the track first in ``positions``, the file in ``inputs``, and what the file's reader
        decided in ``log.notes``. All of the file is kept, what lies outside the flight too.

    Raises
    ------
    SettingsError
        The frame is unknown, or yaw or clock offset is not a finite number.
    MissingDataError
        Clock, frame or yaw was to be found and cannot be, or file and log do not overlap in time.
    """
    _check_options(frame, yaw_deg, clock_offset_s)
    samples = finite_rows(file.samples, ["x_m", "y_m"])
    if len(samples) < MIN_SAMPLES:
        raise MissingDataError(
            f"{file.name}: {len(samples)} positions are too few, at least {MIN_SAMPLES} are needed."
        )
    start_s, end_s = float(samples.index[0]), float(samples.index[-1])
    boot_s = flight.log.boot_time_s
    spans = (
        f"the log covers {boot_s:.2f} s to {boot_s + flight.log.duration_s:.2f} s of the boot "
        f"clock, the file {start_s:.2f} s to {end_s:.2f} s of its own {file.clock} clock"
    )
    lag_s = None if clock_offset_s is None else start_s + clock_offset_s - boot_s
    if lag_s is not None and not start_s - end_s <= lag_s <= flight.log.duration_s:
        raise MissingDataError(
            f"{file.name}: with `clock_offset_s` {clock_offset_s:.3f} it does not overlap the log; "
            f"{spans}",
            "Correct the offset, or leave it out to have it found.",
        )
    yaw_rad = None if yaw_deg == "auto" else float(np.radians(yaw_deg or 0.0))
    try:
        asked = Question(samples, frame or file.frame, yaw_rad, lag_s)
        match = find_match(flight, asked)
    except NoMatchError as error:
        raise MissingDataError(f"{file.name}: {error}; {spans}", f"{error.remedy}.") from None
    alignment, placed = describe(flight, file, asked, match, frame, yaw_deg, clock_offset_s)
    how = f"matched with {alignment.reference}" if clock_offset_s is None else "as given"
    turned = f" turned by {alignment.yaw_deg:.1f}°" if alignment.yaw_deg else ""
    track = PositionTrack(
        name=file.name,
        origin=GIVEN_FILE,
        description=f"external position file, {len(placed)} samples, {alignment.frame}{turned}",
        samples=placed,
        frame="NED",
        clock=f"the file's own {file.clock} clock, {alignment.clock_offset_s:+.3f} s to the boot "
        f"clock, {how}",
        topics=(file.name,),
        log=file.name,
        alignment=alignment,
    )
    said = tuple(f"{file.name}: {text}" for text in (*file.detected, *file.notes))
    dropped = {file.name: file.dropped} if file.dropped else {}
    return replace(
        flight,
        log=structs.replace(
            flight.log,
            notes=(*flight.log.notes, *said),
            dropped={**flight.log.dropped, **dropped},
        ),
        positions=(track, *flight.positions),
        inputs=(*flight.inputs, InputFile(file.name, file.sha256, file.size_bytes, "position")),
    )


def _check_options(
    frame: str | None, yaw_deg: float | str | None, clock_offset_s: float | None
) -> None:
    if frame is not None and frame not in FRAMES:
        raise SettingsError(
            f"`frame` {frame}: not a known frame", f"Choose from {', '.join(FRAMES)}."
        )
    if isinstance(yaw_deg, str) and yaw_deg != "auto":
        raise SettingsError(f"`yaw_deg` {yaw_deg}: give degrees, or auto.")
    for name, value in (("yaw_deg", yaw_deg), ("clock_offset_s", clock_offset_s)):
        if isinstance(value, float) and not np.isfinite(value):
            raise SettingsError(f"`{name}` {value:g} is not a finite number.")
