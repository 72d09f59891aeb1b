"""What is analysed and how: the one thing that a command line is parsed into.

A request is what :func:`px4fuse.analysis.run` takes and what the results record, so that a report
can be made again without its command line.
"""

import os
import re
import shlex
import subprocess
from collections.abc import Iterator, Mapping
from pathlib import PurePath
from typing import Annotated, Any, Literal, Self

import msgspec

from px4fuse.record import table

AUTO: Literal["auto"] = "auto"
# The filter's settings where nobody chooses
SIGMA_A_M_S2, SIGMA_Z_M, DT_S = 0.5, 0.10, 0.1
AxisName = Literal["north", "east", "down", "aisle"]
InputName = Literal["imu", "zero"]
# What a log does not tell of a position source
SourceKind = Literal["uwb", "vio", "mocap", "gnss"]
# What the height of a GNSS flight is from
HeightName = Literal["gnss", "barometer"]
# What a trajectory file's axes may be said to be
FrameName = Literal["NED", "FRD", "ENU", "camera"]
System = Annotated[int, msgspec.Meta(ge=0, le=255)]


class PositionFile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The positioning system's own recording, and how it is read.

    Attributes
    ----------
    path : str
    frame : {"ned", "enu", "nwu"} or None
        None: from its column names, or what fits EKF2.
    yaw_deg : float, "auto" or None
        Turn it clockwise, seen from above; "auto" finds yaw and origin.
    columns : tuple of str or None
        Names or numbers of its columns: time, x, y, z and sigma.
    time_unit : {"s", "ms", "us", "ns"} or None
    length_unit : {"m", "cm", "mm"} or None
    """

    path: str
    frame: Literal["ned", "enu", "nwu"] | None = None
    yaw_deg: float | Literal["auto"] | None = None
    columns: tuple[str, ...] | None = None
    time_unit: Literal["s", "ms", "us", "ns"] | None = None
    length_unit: Literal["m", "cm", "mm"] | None = None


# Fields of a request that are paths
_PATHS = ("log", "mavlink", "source", "estimate", "reference")


class _RequestBase(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What all requests share."""

    def without_paths(self) -> Self:
        """The same with the names of files alone, as results record it."""
        paths = {name: getattr(self, name, None) for name in _PATHS}
        changes: dict[str, Any] = {n: _name(path) for n, path in paths.items() if path is not None}
        position = getattr(self, "position", None)
        if position is not None:
            changes["position"] = msgspec.structs.replace(position, path=_name(position.path))
        return msgspec.structs.replace(self, **changes)


class ComparisonRequest(
    _RequestBase, frozen=True, kw_only=True, tag_field="command", tag="compare"
):
    """A flight to compare with EKF2, as ``compare``, ``tune`` and ``sync`` take it.

    Attributes
    ----------
    log : str
        Path of the ULog or MAVLink recording; in results its name.
    mavlink : str or None
        Path of the MAVLink recording of the same flight.
    system : int or None
        MAVLink system id of the vehicle; None for the one with the most data.
    position : PositionFile or None
    position_source : str or None
        Name of a track of the flight; None for the best.
    source_kind : {"uwb", "vio", "mocap", "gnss"} or None
        What the source is; None for what its messages make of it.
    height : {"gnss", "barometer"} or None
        What "down" is from where the source is GNSS; None for the one that EKF2 fused, GNSS first.
    sigma_a_m_s2, dt_s : float
        As :class:`px4fuse.filter.settings.Settings`.
    sigma_z_m : float or None
        None: 0.1, and of GNSS what EKF2 takes for its noise.
    input : {"imu", "zero"} or None
        None: the IMU where it is logged.
    axes : tuple of str
        Empty for all that the source supports.
    heading_deg : float or None
        Of the aisle; None for that of the track.
    start_s, end_s : float or None
        Segment, seconds from the first data; None for the flight.
    clock_offset_s : float, "auto" or None
        Added to the source's stamps; None is 0, or "auto" with ``position``.
    """

    log: str
    mavlink: str | None = None
    system: System | None = None
    position: PositionFile | None = None
    position_source: str | None = None
    source_kind: SourceKind | None = None
    height: HeightName | None = None
    sigma_a_m_s2: float = SIGMA_A_M_S2
    sigma_z_m: float | None = None
    dt_s: float = DT_S
    input: InputName | None = None
    axes: tuple[AxisName, ...] = ()
    heading_deg: float | None = None
    start_s: float | None = None
    end_s: float | None = None
    clock_offset_s: float | Literal["auto"] | None = None


class Landing(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where it landed from where it took off, and how far it was turned there.

    Attributes
    ----------
    forward_m, right_m : float
        Along the vehicle's nose at take-off, and to the right of it.
    turned_deg : float or None
        Clockwise; None where it is not known.
    """

    forward_m: float
    right_m: float
    turned_deg: float | None = None


class GivenClosure(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Two times (s) at which the vehicle was at the same place, and how precisely (m, 1 σ)."""

    time_1_s: float
    time_2_s: float
    sigma_m: float = 0.10


class LoopRequest(_RequestBase, frozen=True, kw_only=True, tag_field="command", tag="loop"):
    """A loop to measure and correct, as ``loop`` takes it.

    Attributes
    ----------
    source : str
        Path of a trajectory or a flight log, as ``FILE`` or ``LOG:PART``; in results its name.
    frame : str or None
        What a trajectory's axes are; None as its reader tells.
    system : int or None
        MAVLink system id of the vehicle.
    reference : str or None
        Path of what the paths are scored against, besides the log's ground truth.
    start_s, end_s : float or None
        Override take-off and landing.
    landed_at : Landing or None
    came_back : bool
        False where the landing closes no loop.
    closures : tuple of GivenClosure
    position_drift_m, heading_drift_deg : float
        What the odometry drifts in 100 m (1 σ).
    key_frames_m : float or None
        Distance between key frames; None for one that suits the path.
    """

    source: str
    frame: FrameName | None = None
    system: System | None = None
    reference: str | None = None
    start_s: float | None = None
    end_s: float | None = None
    landed_at: Landing | None = None
    came_back: bool = True
    closures: tuple[GivenClosure, ...] = ()
    position_drift_m: float = 1.0
    heading_drift_deg: float = 3.0
    key_frames_m: float | None = None


class Sweep(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Values of one parameter, both ends included; equal ratios above zero, else equal steps."""

    parameter: str
    low: float
    high: float
    count: int = 9


class WhatIfRequest(_RequestBase, frozen=True, kw_only=True, tag_field="command", tag="whatif"):
    """A flight whose EKF2 is replayed with other parameters, as ``whatif`` takes it.

    Attributes
    ----------
    log : str
        Path of the ULog; in results its name.
    mavlink : str or None
        Path of the MAVLink recording of the same flight.
    system : int or None
        MAVLink system id of the vehicle; None for the one with the most data.
    changes : mapping from PX4 name to value
        In PX4's units. Empty without a sweep: what the data ask for.
    sweep : Sweep or None
        One parameter over several values, the others changed as said.
    without : mapping from PX4's name of an aid to float
        From when on (s) it is not fused, besides.
    """

    log: str
    mavlink: str | None = None
    system: System | None = None
    changes: dict[str, float] = {}
    sweep: Sweep | None = None
    without: dict[str, float] = {}


class EvaluationRequest(_RequestBase, frozen=True, kw_only=True):
    """Two trajectories to score, as ``evaluate`` takes them.

    Attributes
    ----------
    estimate, reference : str
        Paths of trajectories or flight logs, as ``FILE`` or ``LOG:PART``.
    alignment, association, max_gap_s, time_offset_s
        As :func:`px4fuse.evaluate` takes them; None as it chooses.
    rpe : tuple of str
        Deltas with their units; empty for some that suit the path.
    consecutive : bool
    system : int or None
        MAVLink system id of the vehicle.
    """

    estimate: str
    reference: str
    alignment: Literal["none", "yaw", "se3", "sim3"] | None = None
    association: Literal["interpolate", "nearest"] = "interpolate"
    max_gap_s: float | None = None
    time_offset_s: float | Literal["auto"] | None = None
    rpe: tuple[str, ...] = ()
    consecutive: bool = False
    system: System | None = None


Request = ComparisonRequest | LoopRequest | WhatIfRequest


class Option(msgspec.Struct, frozen=True):
    """How a field of a request is typed on the command line; what it takes is the field's type.

    Attributes
    ----------
    name : str
    meaning : str
        Its help; empty where the command declares the option itself.
    unit : str
        Of a number, as :data:`px4fuse.units.NAMES` has it.
    example : float
        Shown where what was typed cannot be understood.
    metavar : str or None
    """

    name: str
    meaning: str = ""
    unit: str = ""
    example: float = 0.1
    metavar: str | None = None


_TABLES = table(__file__, "options.toml", dict[str, dict[str, Option]])
# Which recordings of one flight are read, and what the filter does, for one flight or many
RECORDINGS, FILTER_OPTIONS = _TABLES["recordings"], _TABLES["filter"]
POSITION_OPTIONS, CLOCK_OPTION = _TABLES["position"], _TABLES["clock"]
LOOP_OPTIONS, EVALUATION_OPTIONS = _TABLES["loop"], _TABLES["evaluation"]
OPTIONS = RECORDINGS | POSITION_OPTIONS | CLOCK_OPTION | FILTER_OPTIONS
_OF_REQUESTS: dict[type[msgspec.Struct], Mapping[str, Option]] = {
    ComparisonRequest: OPTIONS,
    PositionFile: POSITION_OPTIONS,
    LoopRequest: LOOP_OPTIONS,
    WhatIfRequest: RECORDINGS,
    EvaluationRequest: EVALUATION_OPTIONS,
}

# What the errors of a command may name, besides fields: arguments in Python, to its options
_ARGUMENTS = {
    "position": "--position",
    "changes": "--set",
    "scheduler": "--scheduler",
}


def with_options(text: str, options: Mapping[str, Option] = OPTIONS) -> str:
    """The text of an error with options in the place of the arguments that it names.

    >>> with_options("`sigma_z_m` 0 is out of range: give 0.0001 to 100 m.")
    '--sigma-z 0 is out of range: give 0.0001 to 100 m.'
    """
    names = _ARGUMENTS | {field: option.name for field, option in options.items()}
    return re.sub(r"`(\w+)`", lambda name: names.get(name[1], name[0]), text)


def command_line(
    request: Request | EvaluationRequest, command: str | None = None, *, typed: bool = False
) -> str:
    """The command that makes this again, for people to read: without defaults.

    Parameters
    ----------
    request : Request or EvaluationRequest
    command : str, optional
        Of those that take this request; by default ``compare``, ``loop``, ``whatif`` or
        ``evaluate``.
    typed : bool
        With the paths as they were typed, for the shell of this system; else with the names of
        files alone, as a POSIX shell reads it.
    """
    shown_request = request if typed else request.without_paths()
    # what must be given are files, and everything else is an option
    needed = [field.name for field in msgspec.structs.fields(shown_request) if field.required]
    files = [_path_argument(getattr(shown_request, name)) for name in needed]
    words = [command or str(type(shown_request).__struct_config__.tag or "evaluate"), *files]
    words += [word for pair in _all_options(shown_request) for word in pair if word is not None]
    if isinstance(shown_request, WhatIfRequest):
        for name, value in shown_request.changes.items():
            words += ["--set", f"{name}={_option_text(value)}"]
        if (sweep_range := shown_request.sweep) is not None:
            ends = f"{_option_text(sweep_range.low)}:{_option_text(sweep_range.high)}:{sweep_range.count}"
            words += ["--sweep", f"{sweep_range.parameter}={ends}"]
        for name in shown_request.without:
            words += ["--without", name]
        for since in {*shown_request.without.values()} - {0.0}:
            words += ["--from", _option_text(since)]
    join = subprocess.list2cmdline if typed and os.name == "nt" else shlex.join
    return join(["px4fuse", *words])


def settings_name(request: ComparisonRequest | EvaluationRequest | LoopRequest) -> str:
    """What is not at its default, as a part of a file name.

    >>> settings_name(ComparisonRequest(log="a.ulg", sigma_z_m=0.05, mavlink="b/c.tlog"))
    '_mavlink-c_sigma-z-0.05'
    """
    name_suffix = ""
    for option, value in _all_options(request.without_paths()):
        is_file = option in ("--mavlink", "--position")
        typed = PurePath(value).stem if is_file and value is not None else value
        name_suffix += f"_{option[2:]}" + ("" if typed is None else f"-{typed}")
    return re.sub(r"[^\w.,+-]+", "-", name_suffix)


def _path_argument(path: str) -> str:
    """A path that is not taken for an option."""
    return f"./{path}" if path.startswith("-") else path


def _all_options(request: msgspec.Struct) -> Iterator[tuple[str, str | None]]:
    """Options with their values, None for a flag, of the fields that are not at their defaults."""
    options = _OF_REQUESTS[type(request)]
    for field in msgspec.structs.fields(request):
        value = getattr(request, field.name)
        if field.name not in options or value == field.default:
            continue
        several = value if field.name in ("axes", "closures", "rpe") else (value,)
        for single in several:
            name = options[field.name].name
            yield name, None if isinstance(single, bool) else _option_text(single)
    if (position := getattr(request, "position", None)) is not None:
        yield from _all_options(position)


def _option_text(value: Any) -> str:
    """A value as it is typed."""
    if isinstance(value, msgspec.Struct):
        value = msgspec.structs.astuple(value)
    if isinstance(value, tuple):
        return ",".join(_option_text(part) for part in value if part is not None)
    return f"{value:.12g}" if isinstance(value, float) else str(value)


def _name(path: str) -> str:
    """Name of a file without its folders and without stray bytes that a terminal hands over."""
    return PurePath(path).name.encode(errors="replace").decode()
