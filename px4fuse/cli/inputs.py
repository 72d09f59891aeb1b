"""Options that several commands share: which recordings of one flight are read, and how."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from px4fuse.errors import LogError, SettingsError

if TYPE_CHECKING:
    from px4fuse.flight import Flight

AUTO: Literal["auto"] = "auto"


class NumberOrAuto(click.ParamType[float | str]):
    """A number, or the word ``auto``."""

    name = "number"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float | str:
        """Convert what was typed."""
        if value == AUTO or isinstance(value, float):
            return value  # type: ignore[no-any-return]
        try:
            return float(value)
        except ValueError:
            self.fail(f"{value!r} is neither a number nor 'auto'.", param, ctx)


_RECORDINGS = (
    click.option(
        "--mavlink",
        type=click.Path(path_type=Path),
        default=None,
        metavar="FILE.tlog",
        help="MAVLink recording of the same flight: gives what LOG lacks.",
    ),
    click.option(
        "--system",
        type=click.IntRange(0, 255),
        default=None,
        metavar="ID",
        help="MAVLink system id of the vehicle.  [default: the one with the most data]",
    ),
)
_POSITION = (
    click.option(
        "--position",
        type=click.Path(path_type=Path),
        default=None,
        metavar="FILE.csv",
        help="The positioning system's own recording: time, x, y, z.",
    ),
    click.option(
        "--position-frame",
        type=click.Choice(["ned", "enu", "nwu"]),
        default=None,
        help="What its x, y, z are.  [default: from its column names, or what fits EKF2]",
    ),
    click.option(
        "--position-yaw",
        type=NumberOrAuto(),
        default=None,
        metavar="DEG|auto",
        help="Turn it clockwise, seen from above; auto finds yaw and origin.  [default: 0]",
    ),
    click.option(
        "--position-columns",
        default=None,
        metavar="TIME,X,Y,Z[,SIGMA]",
        help="Names or numbers of its columns.  [default: by their names]",
    ),
    click.option(
        "--position-time-unit",
        type=click.Choice(["s", "ms", "us", "ns"]),
        default=None,
        help="Unit of its time.  [default: detected]",
    ),
    click.option(
        "--position-unit",
        type=click.Choice(["m", "cm", "mm"]),
        default=None,
        help="Unit of its x, y, z.  [default: detected]",
    ),
)


def recording_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options that name further recordings by the autopilot."""
    for option in reversed(_RECORDINGS):
        command = option(command)
    return command


def position_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options that bring in an external position file."""
    for option in reversed(_POSITION):
        command = option(command)
    return command


def read_recordings(log: Path, mavlink: Path | None, system: int | None) -> Flight:
    """Read a log, joined with the MAVLink recording of the same flight where one is given."""
    from px4fuse.readers import read_log

    if mavlink is None:
        return read_log(log, system=system)
    from px4fuse.joining import join

    flight = read_log(log)
    other = read_log(mavlink, system=system)
    if not other.log.format.startswith("MAVLink"):
        raise LogError(f"--mavlink {mavlink.name}: a {other.log.format}, no MAVLink recording.")
    return join(flight, other)


clock_offset_option = click.option(
    "--clock-offset",
    type=NumberOrAuto(),
    default=None,
    metavar="S|auto",
    help="Added to the position source's time stamps.  [default: 0; auto with --position]",
)


def with_position(
    flight: Flight,
    position: Path | None,
    clock_offset: float | str | None,
    **options: Any,
) -> Flight:
    """Bring in the external position file, where one is given.

    Parameters
    ----------
    flight : Flight
    position : Path or None
    clock_offset : float, "auto" or None
        What must be added to the file's stamps; None and "auto" find it.
    **options
        ``position_frame, position_yaw, position_columns, position_time_unit, position_unit``.
    """
    given = [name for name, value in options.items() if value is not None]
    if position is None:
        if given:
            raise SettingsError(f"--{given[0].replace('_', '-')} is of use with --position only.")
        if clock_offset == AUTO:
            raise SettingsError(
                "--clock-offset auto is of use with --position only; give the seconds to add."
            )
        return flight
    from px4fuse.alignment import place
    from px4fuse.readers.position_csv import read_position_csv

    columns = options["position_columns"]
    file = read_position_csv(
        position,
        columns=None if columns is None else tuple(columns.split(",")),
        time_unit=options["position_time_unit"],
        length_unit=options["position_unit"],
    )
    return place(
        flight,
        file,
        frame=options["position_frame"],
        yaw_deg=options["position_yaw"],
        clock_offset_s=clock_offset if isinstance(clock_offset, float) else None,
    )
