"""What a comparison begins with: the source, the segment and the axes, before any filter runs."""

from __future__ import annotations

from dataclasses import dataclass, replace

from px4fuse.display import brief
from px4fuse.errors import SettingsError
from px4fuse.filter.kalman import Settings
from px4fuse.filter.signals import (
    Axis,
    Segment,
    choose_segment,
    choose_source,
    make_axes,
    shift_clock,
)
from px4fuse.flight import Flight, PositionTrack, Truth, Unavailable

NOT_ITS_OWN_TRUTH = Unavailable(
    "ground truth",
    "the position source is the only reference in the log, and it is what our filter was given",
    "Choose another --position-source to have it as the truth.",
)


@dataclass(frozen=True)
class Prepared:
    """What a comparison begins with: everything but the filter's run.

    Attributes
    ----------
    flight : Flight
    source : PositionTrack
    source_reason : str
    segment : Segment
    settings : Settings
        As used: ``input`` is "zero" where the log has no acceleration.
    lines : tuple of Axis
    notes : tuple of str
        Choices made on the way.
    missing : tuple of Unavailable
    """

    flight: Flight
    source: PositionTrack
    source_reason: str
    segment: Segment
    settings: Settings
    lines: tuple[Axis, ...]
    notes: tuple[str, ...]
    missing: tuple[Unavailable, ...]

    __repr__ = brief


def prepare(
    flight: Flight,
    settings: Settings | None = None,
    *,
    axes: tuple[str, ...] | None = None,
    heading_deg: float | None = None,
    position_source: str | None = None,
    start_s: float | None = None,
    end_s: float | None = None,
    input_required: bool = False,
) -> Prepared:
    """Choose the source, the segment and the axes, with the arguments of :func:`compare`.

    Raises
    ------
    MissingDataError, SettingsError
        As :func:`compare`.
    """
    settings = settings or Settings()
    track, reason = choose_source(flight, position_source)
    track = shift_clock(track, settings.clock_offset_s)
    segment = choose_segment(flight, track, start_s, end_s)
    lines = make_axes(flight, track, segment, names=axes, heading_deg=heading_deg)
    if isinstance(flight.truth, Truth) and flight.truth.name == track.name:
        flight = replace(flight, truth=NOT_ITS_OWN_TRUTH)
    missing = list(flight.missing)
    notes = [*flight.log.notes, *track.notes]
    acceleration = lines[0].acceleration
    if settings.input == "imu" and isinstance(acceleration, Unavailable):
        if input_required:
            raise SettingsError(f"{flight.log.name}: `input` imu: {acceleration}")
        settings = replace(settings, input="zero")
        notes.append(f"no acceleration input ({acceleration.reason}): constant velocity was used")
        if acceleration not in missing:
            missing.append(acceleration)
    return Prepared(flight, track, reason, segment, settings, lines, tuple(notes), tuple(missing))
