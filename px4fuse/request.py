"""Requests: files and settings of one analysis.

The results contain the request, so that :func:`px4fuse.diagnose.diagnose` can repeat the analysis.
"""

import os
import re
import shlex
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from pathlib import PurePath
from typing import Annotated, Any, Literal, Self

import msgspec

from .core.text import UNIT_BY_SUFFIX, replace_unencodable

AUTO: Literal["auto"] = "auto"
# Default settings of KF: process noise, measurement noise and prediction interval
SIGMA_A_M_S2, SIGMA_Z_M, DT_S = 0.5, 0.10, 0.1
AxisName = Literal["north", "east", "down", "aisle"]
KfInputName = Literal["imu", "zero"]
# Kinds of position source that the user can state
SourceKind = Literal["uwb", "vio", "mocap", "gnss"]
# Directions of x, y and z in a position file, such as east, up and south
PositionFrame = Literal["ned", "enu", "nwu", "eus", "edn"]
# Height source of a flight with GNSS
HeightSensor = Literal["gnss", "barometer"]
# Coordinate frame of a trajectory file
FrameName = Literal["NED", "FRD", "ENU", "camera"]
SystemId = Annotated[int, msgspec.Meta(ge=0, le=255)]

_PATH_FIELDS = ("log", "path", "source", "estimate", "reference")


class _BaseRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base class of the settings of all commands."""

    def with_file_names(self) -> Self:
        """Return the settings with file names instead of paths."""
        changes: dict[str, Any] = {
            name: _extract_file_name(path)
            for name in _PATH_FIELDS
            if (path := getattr(self, name, None)) is not None
        }
        if (position := getattr(self, "position", None)) is not None:
            changes["position"] = position.with_file_names()
        return msgspec.structs.replace(self, **changes)


class PositionFile(_BaseRequest, frozen=True, kw_only=True):
    """File with positions that the positioning system recorded, and its frame, columns and units.

    Attributes
    ----------
    path : str
    body : str or None
        Rigid body, tag or ROS topic in the file; None if there is only one.
    frame : {"ned", "enu", "nwu", "eus", "edn"} or None
        Coordinate frame of the positions; None: detected.
    yaw_deg : float, "auto" or None
        Clockwise rotation of the positions, seen from above; "auto" estimates yaw and origin.
    columns : tuple of str or None
        Names or numbers of the columns: time, x, y, z and sigma; None: detected.
    time_unit : {"s", "ms", "us", "ns"} or None
        Unit of the times; None: detected.
    length_unit : {"m", "cm", "mm"} or None
        Unit of x, y and z; None: detected.
    """

    path: str
    body: str | None = None
    frame: PositionFrame | None = None
    yaw_deg: float | Literal["auto"] | None = None
    columns: tuple[str, ...] | None = None
    time_unit: Literal["s", "ms", "us", "ns"] | None = None
    length_unit: Literal["m", "cm", "mm"] | None = None


class ComparisonRequest(
    _BaseRequest, frozen=True, kw_only=True, tag_field="command", tag="compare"
):
    """Files and settings of ``px4fuse compare``, ``tune`` or ``sync``.

    The fields are the arguments of :func:`px4fuse.compare`.
    """

    log: str
    system: SystemId | None = None
    position: PositionFile | None = None
    position_source: str | None = None
    source_kind: SourceKind | None = None
    height: HeightSensor | None = None
    sigma_a_m_s2: float = SIGMA_A_M_S2
    sigma_z_m: float | None = None
    dt_s: float = DT_S
    input: KfInputName | None = None
    axes: tuple[AxisName, ...] = ()
    heading_deg: float | None = None
    start_s: float | None = None
    end_s: float | None = None
    clock_offset_s: float | Literal["auto"] | None = None


class Landing(_BaseRequest, frozen=True):
    """Landing place and heading relative to take-off, as measured by the user.

    Attributes
    ----------
    forward_m, right_m : float
        Distances of the landing place forward and right of the vehicle at take-off.
    turned_deg : float or None
        Clockwise rotation of the vehicle between take-off and landing; None if unknown.
    """

    forward_m: float
    right_m: float
    turned_deg: float | None = None


class GivenClosure(_BaseRequest, frozen=True):
    """Loop closure from the user: the same position (σ ``sigma_m``) at two times."""

    time_1_s: float
    time_2_s: float
    sigma_m: float = 0.10


class LoopRequest(_BaseRequest, frozen=True, kw_only=True, tag_field="command", tag="loop"):
    """File and settings of ``px4fuse loop``, which corrects a loop closure error.

    Attributes
    ----------
    source : str
        Path of a trajectory or a flight log (``FILE`` or ``LOG:TRACK``).
    frame : str or None
        Coordinate frame of a trajectory file; None: detected.
    system : int or None
        MAVLink system id of the vehicle; None: the id with the most messages.
    reference : str or None
        Path of a reference trajectory for ATE and RPE, in addition to the log's ground truth.
    start_s, end_s : float or None
        Start and end of the loop; None: take-off and landing.
    landed_at : Landing or None
        Measured landing place; None: from ground truth, else the take-off place.
    closed_loop : bool
        False if the vehicle did not return to the take-off place.
    closures : tuple of GivenClosure
        Further loop closures.
    position_drift_m, heading_drift_deg : float
        Drift of the odometry after 100 m (1 σ).
    key_frames_m : float or None
        Distance between key frames of the pose graph; None: 2 % of the path's extent.
    """

    source: str
    frame: FrameName | None = None
    system: SystemId | None = None
    reference: str | None = None
    start_s: float | None = None
    end_s: float | None = None
    landed_at: Landing | None = None
    closed_loop: bool = True
    closures: tuple[GivenClosure, ...] = ()
    position_drift_m: float = 1.0
    heading_drift_deg: float = 3.0
    key_frames_m: float | None = None


class Sweep(_BaseRequest, frozen=True):
    """Range of an EKF2 parameter for replays; the spacing is logarithmic if ``low`` is above 0."""

    parameter: str
    low: float
    high: float
    count: int = 9


class WhatIfRequest(_BaseRequest, frozen=True, kw_only=True, tag_field="command", tag="whatif"):
    """Log and settings of ``px4fuse whatif``, which replays EKF2 with changed parameters.

    Attributes
    ----------
    log : str
        Path of the ULog.
    system : int or None
        MAVLink system id of the vehicle; None: the id with the most messages.
    changes : mapping from PX4 name to value
        Changed parameters in PX4's units; default: estimates of noise and delay.
    sweep : Sweep or None
        Values of one parameter, in addition to ``changes``.
    without : mapping from PX4's name of an aiding source to float
        Time (s) from which EKF2 does not fuse the aiding source.
    """

    log: str
    system: SystemId | None = None
    changes: dict[str, float] = {}
    sweep: Sweep | None = None
    without: dict[str, float] = {}


class EvaluationRequest(_BaseRequest, frozen=True, kw_only=True):
    """Files and settings of ``px4fuse evaluate``, which computes ATE and RPE of a trajectory.

    Attributes
    ----------
    estimate, reference : str
        Paths of trajectories or flight logs (``FILE`` or ``LOG:TRACK``).
    alignment, association, max_gap_s, time_offset_s
        Arguments of :func:`px4fuse.evaluate`; None: selected automatically.
    rpe : tuple of str
        Deltas of the RPE with their units; empty: selected automatically.
    consecutive : bool
        True to compute the RPE over consecutive, non-overlapping pairs of poses.
    system : int or None
        MAVLink system id of the vehicle; None: the id with the most messages.
    """

    estimate: str
    reference: str
    alignment: Literal["none", "yaw", "se3", "sim3"] | None = None
    association: Literal["interpolate", "nearest"] = "interpolate"
    max_gap_s: float | None = None
    time_offset_s: float | Literal["auto"] | None = None
    rpe: tuple[str, ...] = ()
    consecutive: bool = False
    system: SystemId | None = None


Request = ComparisonRequest | LoopRequest | WhatIfRequest


def _make_option_names(
    request_type: type[msgspec.Struct],
    excluded_fields: Sequence[str] = (),
    *,
    prefix: str = "--",
    **renamed_options: str,
) -> dict[str, str]:
    """Return the command-line option of each optional field, for example ``--max-gap``.

    ``renamed_options`` are exceptions from the rule ``max_gap_s`` → ``--max-gap``.
    """
    option_names = {
        field.name: prefix
        + re.sub(f"({'|'.join(UNIT_BY_SUFFIX)})$", "", field.name).replace("_", "-")
        for field in msgspec.structs.fields(request_type)
        if not field.required and field.name not in excluded_fields
    }
    return option_names | renamed_options


_POSITION_OPTIONS = _make_option_names(
    PositionFile,
    prefix="--position-",
    path="--position",
    body="--body",
    length_unit="--position-unit",
)
# Command-line options of the fields of each request class
OPTION_NAMES: Mapping[type[msgspec.Struct], Mapping[str, str]] = {
    ComparisonRequest: _make_option_names(ComparisonRequest, ["position"], axes="--axis")
    | _POSITION_OPTIONS,
    PositionFile: _POSITION_OPTIONS,
    LoopRequest: _make_option_names(
        LoopRequest,
        start_s="--from",
        end_s="--to",
        closed_loop="--open",
        closures="--closure",
        position_drift_m="--drift",
    ),
    WhatIfRequest: _make_option_names(WhatIfRequest, ["changes", "sweep", "without"]),
    EvaluationRequest: _make_option_names(EvaluationRequest),
}
COMPARISON_OPTIONS = OPTION_NAMES[ComparisonRequest]
# Options that occur in the error messages of several commands, by Python argument
_SHARED_OPTION_NAMES = {"position": "--position", "changes": "--set", "scheduler": "--scheduler"}


def replace_argument_names(text: str, option_names: Mapping[str, str] = COMPARISON_OPTIONS) -> str:
    """Replace Python arguments in backticks by command-line options.

    >>> replace_argument_names("`sigma_z_m` 0 is out of range: give 0.0001 to 100 m.")
    '--sigma-z 0 is out of range: give 0.0001 to 100 m.'
    """
    all_option_names = {**_SHARED_OPTION_NAMES, **option_names}
    return re.sub(r"`(\w+)`", lambda match: all_option_names.get(match[1], match[0]), text)


def command_line(
    request: Request | EvaluationRequest, command: str | None = None, *, for_shell: bool = False
) -> str:
    """Format the command line that repeats an analysis; options with default values are omitted.

    Parameters
    ----------
    request : Request or EvaluationRequest
    command : str, optional
        Name of the command; by default from the type of ``request``.
    for_shell : bool
        True for complete paths and this system's shell; False for file names only.
    """
    shown_request = request if for_shell else request.with_file_names()
    # Fields without a default are input files, and all others are options
    files = [
        getattr(shown_request, field.name)
        for field in msgspec.structs.fields(shown_request)
        if field.required
    ]
    # without "./", a path that begins with "-" is read as an option
    files = [f"./{path}" if path.startswith("-") else path for path in files]
    arguments = [command or str(type(shown_request).__struct_config__.tag or "evaluate"), *files]
    for option, value_text in _list_changed_options(shown_request):
        arguments += [option] if value_text is None else [option, value_text]
    if isinstance(shown_request, WhatIfRequest):
        for name, value in shown_request.changes.items():
            arguments += ["--set", f"{name}={_format_value(value)}"]
        if (sweep := shown_request.sweep) is not None:
            range_text = f"{_format_value(sweep.low)}:{_format_value(sweep.high)}:{sweep.count}"
            arguments += ["--sweep", f"{sweep.parameter}={range_text}"]
        for name in shown_request.without:
            arguments += ["--without", name]
        # px4fuse whatif omits all aiding sources (--without) from the same time
        start_s = max(shown_request.without.values(), default=0.0)
        if start_s:
            arguments += ["--from", _format_value(start_s)]
    command_words = ["px4fuse", *arguments]
    return quote_command(command_words) if for_shell else shlex.join(command_words)


def quote_command(words: Sequence[str]) -> str:
    """Join the words of a command, quoted for the shell of this system."""
    return subprocess.list2cmdline(words) if os.name == "nt" else shlex.join(words)


def format_settings_suffix(request: ComparisonRequest | EvaluationRequest | LoopRequest) -> str:
    """Format the settings that differ from their defaults, as the end of a file name.

    >>> file = PositionFile(path="b/c.csv")
    >>> format_settings_suffix(ComparisonRequest(log="a.ulg", sigma_z_m=0.05, position=file))
    '_sigma-z-0.05_position-c'
    """
    name_suffix = ""
    for option, value in _list_changed_options(request.with_file_names()):
        value_text = PurePath(value).stem if option == "--position" and value is not None else value
        name_suffix += f"_{option[2:]}" + ("" if value_text is None else f"-{value_text}")
    return re.sub(r"[^\w.,+-]+", "-", name_suffix)


def _list_changed_options(request: msgspec.Struct) -> Iterator[tuple[str, str | None]]:
    """Yield each option that differs from its default, with its value (None for a flag)."""
    option_names = OPTION_NAMES[type(request)]
    for field in msgspec.structs.fields(request):
        value = getattr(request, field.name)
        if field.name not in option_names or value == field.default:
            continue
        option_values = value if field.name in ("axes", "closures", "rpe") else (value,)
        for single_value in option_values:
            value_text = None if isinstance(single_value, bool) else _format_value(single_value)
            yield option_names[field.name], value_text
    if (position := getattr(request, "position", None)) is not None:
        yield from _list_changed_options(position)


def _format_value(value: Any) -> str:
    """Format a value as on the command line: parts with commas between them, None omitted."""
    if isinstance(value, msgspec.Struct):
        value = msgspec.structs.astuple(value)
    if isinstance(value, tuple):
        return ",".join(_format_value(part) for part in value if part is not None)
    return f"{value:.15g}" if isinstance(value, float) else str(value)


def _extract_file_name(path: str) -> str:
    """Return the file name in a path, including the topic of a ROS bag (``BAG:/TOPIC``)."""
    file, topic, _ = re.split(r"((?<=..):/.*|$)", path, maxsplit=1, flags=re.DOTALL)
    return replace_unencodable(PurePath(file).name) + topic
