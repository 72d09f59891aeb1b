"""Trajectory files: TUM, EuRoC ground truth and ORB-SLAM3's mixture of both.

TUM is ``time tx ty tz qx qy qz qw`` in seconds between blanks (Sturm 2012); EuRoC's ground truth
is ``time, x, y, z, qw, qx, qy, qz, ...`` in nanoseconds between commas (Burri 2016). ORB-SLAM3's
``SaveTrajectoryEuRoC`` writes TUM's columns with nanoseconds, and leaves out the frames where it
was lost. Which one it is shows in the content. Every decision is stated in the notes.
"""

from __future__ import annotations

import hashlib
import math
import re
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from px4fuse.arrays import Array, BoolArray
from px4fuse.errors import TrajectoryError
from px4fuse.readers.text_table import (
    UNIX_END_S,
    UNIX_START_S,
    at_line,
    is_number,
    quote,
    seconds_of,
    text_of,
)
from px4fuse.reading import read_whole, shown
from px4fuse.trajectory.model import MIN_POSES, Frame, Kind, Trajectory

MAX_FILE_BYTES = 500_000_000
COLUMNS = 8
MAX_USUAL_STEP_S = 10.0
EUROC_COLUMNS = (8, 17)  # alone, or with velocity and the biases of gyro and accelerometer
HEAD_LINES = 1000  # in which the format must show
# A key frame may be a minute from the next, but no frames come at a kHz
MAX_INTERVAL_S, MIN_INTERVAL_S = 1000.0, 1e-3
PER_SECOND = {"nanoseconds": 10**9, "microseconds": 10**6, "milliseconds": 10**3}
MAX_NORM_ERROR = 0.1
MAX_VALUE = 1e9  # beyond it stands a time stamp, or damage
UNIT_NORM = 1e-15  # left alone, so that what was written is read back to the last bit
MAX_REPEATED = 0.01  # share of stamps that repeat; more means that digits are missing
IDENTITY_M, IDENTITY_RAD = 1e-6, 1e-6
# A level flight: it extends in two directions and hardly in the third, which is near y
MAX_THICKNESS, MIN_WIDTH, MAX_TILT_RAD = 1 / 3, 0.1, math.radians(20.0)
# Frames come at a rate where so many intervals are this near to the median one
REGULAR_SHARE, REGULAR_WITHIN = 0.9, 0.5
GAP_INTERVALS, GAP_S = 2.5, 0.3

_TUM = "TUM (time x y z qx qy qz qw)"
_TRUTH = re.compile(r"truth|vicon|leica|mocap|(?<![a-z])gt(?![a-z])", re.IGNORECASE)
_REMEDY = f"Export the trajectory as {_TUM}, in seconds."


@dataclass(frozen=True)
class _Layout:
    """How rows are written: separator (None is white space), columns, w first, what it is."""

    separator: str | None
    columns: int
    w_first: bool
    words: str


@dataclass(frozen=True)
class _File:
    """A file's lines, its name, and its comments in one text."""

    name: str
    lines: list[str]
    comments: str

    def refuse(self, row: int, what: str, remedy: str) -> TrajectoryError:
        """Error that names the line of a row of data."""
        numbers = (at for at, line in enumerate(self.lines, 1) if _is_row(line))
        number = next(at for index, at in enumerate(numbers) if index == row)
        return TrajectoryError(at_line(self.name, number, what, remedy))


def read_trajectory(path: str | Path) -> Trajectory:
    """Read a trajectory file.

    Parameters
    ----------
    path : str or Path
        TUM, EuRoC ground truth, or what ORB-SLAM3 saves; recognised by content.

    Returns
    -------
    Trajectory
        ``time_s`` in the file's own stamps as seconds. ``kind`` is "truth" where comments or name
        say so (or the columns are those of EuRoC's ground truth), "slam" where the first pose is
        the identity. ``frame`` is "camera" where the world is such a first pose and the motion is
        level with y vertical.

    Raises
    ------
    TrajectoryError
        The file cannot be read or is no trajectory, has fewer than three poses, stamps that go
        back, numbers that are not finite, or quaternions that are far from unit length.
    """
    path = Path(path)
    name = shown(path)
    content = read_whole(path, TrajectoryError, MAX_FILE_BYTES, again="Export it again")
    lines = _text(name, content).split("\n")
    comments = "\n".join(line for line in lines if line.lstrip().startswith("#"))
    file = _File(name, lines, comments)
    layout, notes = _recognise(file), []
    rows = [line for line in lines if _is_row(line)]
    if not _numeric(_fields(rows[0], layout)):  # a header that is no comment
        lines[lines.index(rows.pop(0))] = ""
    if lines[-1] and len(rows) > 1 and len(_fields(rows[-1], layout)) < layout.columns:
        notes.append(f"Line {len(lines)}, the last one, was dropped: it is cut.")
        rows.pop()
    if len(rows) < MIN_POSES:
        raise TrajectoryError(
            f"{name}: poses: {len(rows)}, at least {MIN_POSES} are needed",
            "Export the trajectory again; where SLAM lost track at once, its file is almost empty.",
        )
    stamps, values = _parse(file, layout, rows)
    time, time_words = _seconds(file, stamps)
    time, values, dropped = _increasing(file, time, values)
    position, rotation = values[:, :3], _rotation(values[:, 3:7], layout.w_first)
    kind, kind_words = _kind(file, path, layout, position, rotation)
    frame, frame_words = _frame(kind, position)
    is_unix = UNIX_START_S <= time[0] < UNIX_END_S
    clock = "its stamps are UNIX time" if is_unix else "its clock is its own, not UNIX time"
    recognised = f"Recognised as {layout.words}; {clock}."
    said = (
        recognised, time_words, _far_apart(time), kind_words, frame_words, dropped,
        _gaps(time, kind), *notes,
    )  # fmt: skip
    return Trajectory(
        name=name,
        kind=kind,
        time_s=time,
        position_m=position,
        rotation=rotation,
        frame=frame,
        unix_offset_s=0.0 if is_unix else None,
        sha256=hashlib.sha256(content).hexdigest(),
        size_bytes=len(content),
        notes=tuple(note for note in said if note),
    )


def tum_text(trajectory: Trajectory) -> str:
    """Text of a TUM file: ``time tx ty tz qx qy qz qw`` with every digit.

    Parameters
    ----------
    trajectory : Trajectory
        With orientation. Stamps are written as UNIX time where ``unix_offset_s`` is known.

    Raises
    ------
    TrajectoryError
        It has no orientation, which the format demands.
    """
    if trajectory.rotation is None:
        raise TrajectoryError(
            f"{trajectory.name}: a TUM file needs orientations, and here are only positions",
            "Choose a part with orientation.",
        )
    time = trajectory.time_s + (trajectory.unix_offset_s or 0.0)
    table = np.column_stack((time, trajectory.position_m, trajectory.rotation.as_quat()))
    rows = (" ".join(map(repr, row)) for row in table.tolist())
    return "# timestamp tx ty tz qx qy qz qw\n" + "\n".join(rows) + "\n"


def _text(name: str, content: bytes) -> str:
    """Text with line feeds between lines."""
    text = text_of(content)
    if text is None:
        is_ulog = content.startswith(b"ULog")
        what = "a PX4 log" if is_ulog else "a binary file"
        remedy = f"Name a part of the log: {name}:vio or {name}:ekf2." if is_ulog else _REMEDY
        raise TrajectoryError(f"{name}: {what}, not a trajectory file", f"{remedy}")
    return text


def _is_row(line: str) -> bool:
    """Whether a line holds something besides a comment."""
    text = line.lstrip()
    return bool(text) and not text.startswith("#")


def _fields(line: str, layout: _Layout | None = None) -> list[str]:
    """Fields of a row, between commas where there are any."""
    line = line.partition("#")[0]
    separator = layout.separator if layout else "," if "," in line else None
    return [field.strip() for field in line.strip().split(separator)]


def _numeric(fields: list[str]) -> bool:
    return all(map(is_number, fields))


def _recognise(file: _File) -> _Layout:
    """Recognise the layout by the first row and the header."""
    head = file.lines[:HEAD_LINES]
    rows = [fields for line in head if _is_row(line) for fields in [_fields(line)]]
    header = [line.strip().lstrip("# ") for line in head if line.lstrip().startswith("#")]
    if rows and not _numeric(rows[0]) and len(rows) > 1 and _numeric(rows[1]):
        header.append(",".join(rows.pop(0)))
    if not rows:
        what = "nothing but comments" if header else "nothing but blank lines"
        raise TrajectoryError(f"{file.name}: {what} in the first {HEAD_LINES} lines", f"{_REMEDY}")
    first = rows[0]
    if re.match(r"(VERTEX|EDGE|FIX|PARAMS)[_ ]?", first[0]):
        raise TrajectoryError(
            f"{file.name}: a pose graph (g2o), not a trajectory: it has no times", f"{_REMEDY}"
        )
    if not _numeric(first):
        raise TrajectoryError(
            f"{file.name}: not a trajectory file: its first line is {quote(' '.join(first))}",
            f"{_REMEDY}",
        )
    separator = "," if any("," in line for line in head if _is_row(line)) else None
    if len(first) in ((COLUMNS,) if separator is None else EUROC_COLUMNS):
        return _layout(file, first, separator, header)
    kitti = ": a KITTI file, which has no times" if not separator and len(first) == 12 else ""
    raise TrajectoryError(
        f"{file.name}: {len(first)} columns{kitti}; TUM has {COLUMNS} between blanks, EuRoC "
        f"{EUROC_COLUMNS[0]} or {EUROC_COLUMNS[1]} between commas",
        f"{_REMEDY}",
    )


def _layout(file: _File, first: list[str], separator: str | None, header: list[str]) -> _Layout:
    """Layout of rows with as many columns as a format has: where w stands shows in the header.

    Without a header, blanks mean TUM, and commas with nanoseconds EuRoC.
    """
    split = [
        line.replace(",", " ").split() if separator is None else line.split(",") for line in header
    ]
    named = [names for names in split if len(names) == len(first)]
    names = [re.sub(r"\s*[\[(].*", "", name).strip().casefold() for name in (named or [[]])[-1]]
    # "q_RS_w []" and "qw" alike: the last letter of each name before its unit
    axes, turn = "".join(n[-1:] for n in names[1:4]), "".join(n[-1:] for n in names[4:8])
    euroc = "EuRoC (time, x, y, z, qw, qx, qy, qz between commas)"
    if axes == "xyz" and turn in ("wxyz", "xyzw") and all("q" in n for n in names[4:8]):
        between = "blanks" if separator is None else "commas"
        order = {"wxyz": "quaternion w first", "xyzw": "quaternion w last"}[turn]
        words = f"columns between {between}, {order}, by its header"
        if (separator, turn) == (None, "xyzw"):
            words = _TUM
        elif (separator, turn) == (",", "wxyz"):
            words = euroc
        return _Layout(separator, len(first), turn == "wxyz", words)
    if separator is None:
        return _Layout(separator, len(first), False, _TUM)
    if names:
        raise TrajectoryError(
            f"{file.name}: its columns are {quote(', '.join(names))}, not time, position x y z and "
            f"quaternion w x y z",
            f"{_REMEDY}",
        )
    if abs(float(first[0])) * 1e-9 >= UNIX_START_S:
        return _Layout(separator, len(first), True, euroc + ", by its nanoseconds")
    raise TrajectoryError(
        f"{file.name}: {len(first)} columns between commas without a header, so the place of the "
        "quaternion's w is not known",
        "Add the line "
        "'#timestamp, p_x, p_y, p_z, q_w, q_x, q_y, q_z' with the columns in their order.",
    )


def _parse(file: _File, layout: _Layout, rows: list[str]) -> tuple[list[str], Array]:
    """Stamps as text, and position and quaternion of each row, shape (n, 7)."""
    try:
        table = np.loadtxt(
            rows,
            dtype=[("stamp", "U80"), ("pose", "f8", (layout.columns - 1,))],
            delimiter=layout.separator,
            comments="#",
        )
    except ValueError as error:
        raise _bad_row(file, layout, rows) from error
    values: Array = np.ascontiguousarray(table["pose"][:, :7])
    wrong = ~(np.abs(values) < MAX_VALUE).all(axis=1)
    if wrong.any():
        what = f"a value that is not finite, or beyond {MAX_VALUE:.0e}"
        raise file.refuse(int(np.argmax(wrong)), what, "Remove that line.")
    norms = np.linalg.norm(values[:, 3:7], axis=1)
    wrong = np.abs(norms - 1.0) > MAX_NORM_ERROR
    if wrong.any():
        row = int(np.argmax(wrong))
        raise file.refuse(
            row,
            f"columns 5 to 8 are not a quaternion: its norm is {norms[row]:.4g}, not 1",
            f"Remove that line, or check the order of the columns. {_REMEDY}",
        )
    return table["stamp"].tolist(), values


def _bad_row(file: _File, layout: _Layout, rows: list[str]) -> TrajectoryError:
    """Name the first row that does not parse."""
    for row, line in enumerate(rows):
        fields = _fields(line, layout)
        if len(fields) != layout.columns:
            what = f"{len(fields)} columns, where the first line has {layout.columns}"
            return file.refuse(row, what, "Correct or remove that line.")
        for column, field in enumerate(fields, 1):
            if not is_number(field):
                what = f"column {column}: {quote(field)} is not a number"
                return file.refuse(row, what, "Correct or remove that line.")
    return TrajectoryError(f"{file.name}: no table of numbers. {_REMEDY}")


def _seconds(file: _File, stamps: list[str]) -> tuple[Array, str]:
    """Stamps in seconds, and the words on their unit where it is not seconds."""
    try:
        values = np.array(stamps, dtype=np.float64)
    except ValueError as error:
        row = next(i for i, stamp in enumerate(stamps) if not is_number(stamp.strip()))
        what = f"column 1: {quote(stamps[row])} is not a time"
        raise file.refuse(row, what, "Correct or remove that line.") from error
    finite = np.isfinite(values)
    if not finite.all():
        row = int(np.argmin(finite))
        raise file.refuse(row, f"column 1: {quote(stamps[row])} is not a time", "Remove that line.")
    step = float(np.median(np.abs(np.diff(values))))
    if step <= MAX_INTERVAL_S and np.abs(values).max() < UNIX_END_S:
        return values, ""
    for unit, per_second in PER_SECOND.items():
        first, last = float(values[0]) / per_second, float(np.abs(values).max()) / per_second
        # on a clock of its own only ORB-SLAM3's nanoseconds are known to occur
        is_known = first >= UNIX_START_S or unit == "nanoseconds"
        if is_known and last < UNIX_END_S and MIN_INTERVAL_S <= step / per_second <= MAX_INTERVAL_S:
            ticks = np.array([int(Decimal(stamp.strip())) for stamp in stamps], dtype=np.int64)
            return seconds_of(
                ticks, per_second
            ), f"Its stamps are {unit} and were divided by {per_second:.0e}."
    raise TrajectoryError(
        f"{file.name}: its stamps are {step:.3g} apart (median), which is not an interval of "
        "frames in seconds or nanoseconds",
        "Give stamps in seconds.",
    )


def _increasing(file: _File, time: Array, values: Array) -> tuple[Array, Array, str]:
    """Rows whose stamps increase: of those that repeat the first, and the words on the others."""
    steps = np.diff(time)
    if (steps < 0.0).any():
        row = int(np.argmax(steps < 0.0)) + 1
        raise file.refuse(
            row,
            f"its time {time[row]!s} s is before that of the line above ({time[row - 1]!s} s)",
            "Sort the lines by time, or separate the recordings.",
        )
    keep = np.concatenate(([True], steps > 0.0))
    repeated = len(keep) - int(keep.sum())
    if not repeated:
        return time, values, ""
    row = int(np.argmin(keep))
    if repeated > MAX_REPEATED * len(keep):
        raise file.refuse(
            row,
            f"its time {time[row]!s} s is that of the line above, as in {repeated} of "
            f"{len(keep)} lines",
            "Export the stamps with all their digits (%.9f).",
        )
    what = "1 pose" if repeated == 1 else f"{repeated} poses"
    note = f"Dropped {what} with the stamp of the one before, first at {time[row]!s} s."
    return time[keep], values[keep], note


def _rotation(quaternion: Array, w_first: bool) -> Rotation:
    quaternion = np.roll(quaternion, -1, axis=1) if w_first else quaternion
    norms = np.linalg.norm(quaternion, axis=1, keepdims=True)
    norms[np.abs(norms - 1.0) < UNIT_NORM] = 1.0
    return Rotation(quaternion / norms, normalize=False)


def _kind(
    file: _File, path: Path, layout: _Layout, position: Array, rotation: Rotation
) -> tuple[Kind, str]:
    """What made it, and the words on that."""
    if layout.columns == EUROC_COLUMNS[1]:
        return "truth", "Ground truth, as its 17 columns are those of EuRoC's."
    # EuRoC's file is called data.csv; its folder says what it is
    folder = path.absolute().parent.name if path.name == "data.csv" else ""
    said = {"comments say": file.comments, "name says": path.name, "folder says": folder}
    for words, text in said.items():
        if _TRUTH.search(text):
            return "truth", f"Ground truth, as its {words}."
    if np.abs(position[0]).max() < IDENTITY_M and rotation[0].magnitude() < IDENTITY_RAD:
        return "slam", "SLAM, as its first pose is the identity: its world is its first key frame."
    return "unknown", ""


def _frame(kind: Kind, position: Array) -> tuple[Frame, str]:
    """Axes of the world, and the words on them."""
    if kind != "slam":
        return "unknown", ""
    centred = position - position.mean(axis=0)
    spread, axes = np.linalg.eigh(centred.T @ centred)  # ascending
    thin, width, length = np.sqrt(np.maximum(spread, 0.0) / len(position))
    tilt = math.acos(min(1.0, abs(float(axes[1, 0]))))
    is_level = width > MIN_WIDTH * length and thin < MAX_THICKNESS * width
    if not is_level or tilt > MAX_TILT_RAD:
        return "unknown", ""
    return "camera", (
        "Camera frame (x right, y down, z forward): the motion is level, "
        f"{thin:.2g} m against {width:.2g} and {length:.2g} m (RMS), and what is vertical is "
        f"{math.degrees(tilt):.0f}° from y."
    )


def _far_apart(time_s: Array) -> str:
    step = float(np.median(np.diff(time_s)))
    if step < MAX_USUAL_STEP_S:
        return ""
    return f"Poses are {step:.0f} s apart, read as seconds: are the stamps in milliseconds?"


def _gaps(time: Array, kind: Kind) -> str:
    """Words on missing frames, or on poses that are key frames."""
    steps = np.diff(time)
    median = float(np.median(steps))
    near: BoolArray = np.abs(steps - median) <= REGULAR_WITHIN * median
    if near.mean() < REGULAR_SHARE:
        return (
            f"Poses come at no rate (every {median:.3g} s in the median, {steps.max():.3g} s apart "
            "at most): key frames, or a recording that lost many."
        )
    gaps = np.flatnonzero(steps > max(GAP_INTERVALS * median, GAP_S))
    if not len(gaps):
        return ""
    lost = steps[gaps] - median
    missing = int((np.rint(steps[gaps] / median) - 1).sum())
    longest = gaps[int(np.argmax(lost))]
    what = "Tracking lost" if kind == "slam" else "No poses"
    at = f"{time[longest] - time[0]:.1f} s after its start"
    if len(gaps) == 1:
        return f"{what} for {lost[0]:.1f} s at {at}, {missing} frames missing."
    return (
        f"{what} {len(gaps)} times, for {lost.sum():.1f} s in all and at most for {lost.max():.1f} "
        f"s, at {at}; {missing} frames missing."
    )
