"""Trajectory files: TUM, EuRoC ground truth and ORB-SLAM3's mixture of both.

TUM is ``time tx ty tz qx qy qz qw`` in seconds between blanks (Sturm 2012); EuRoC's ground truth
is ``time, x, y, z, qw, qx, qy, qz, ...`` in nanoseconds between commas (Burri 2016). ORB-SLAM3's
``SaveTrajectoryEuRoC`` writes TUM's columns with nanoseconds, and leaves out the frames where it
was lost. Which one it is shows in the content. Every decision is stated in the notes.
"""

import hashlib
import math
import re
from decimal import Decimal
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from px4fuse.arrays import Array, BoolArray
from px4fuse.errors import TrajectoryError
from px4fuse.readers.text_table import UNIX_END_S, UNIX_START_S, Rows, decode_text, is_number, quote
from px4fuse.reading import display_name, read_bytes_limited
from px4fuse.trajectory.model import MIN_POSES, Frame, Kind, Trajectory

MAX_FILE_BYTES = 500_000_000
COLUMNS = 8
MAX_USUAL_STEP_S = 10.0
EUROC_COLUMNS = (8, 17)  # alone, or with velocity and the biases of gyro and accelerometer
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
_EUROC = "EuRoC (time, x, y, z, qw, qx, qy, qz between commas)"
# "q_RS_w []" and "qw" alike
_NAME_OF_AXIS = re.compile(r"\bq(?:\w*_)?([wxyz])\b")
_TRUTH = re.compile(r"truth|vicon|leica|mocap|(?<![a-z])gt(?![a-z])", re.IGNORECASE)
_REMEDY = f"Export the trajectory as {_TUM}, in seconds."


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
    name = display_name(path)
    content = read_bytes_limited(
        path, TrajectoryError, MAX_FILE_BYTES, empty_remedy="Export it again"
    )
    rows, comments, truncation_note = _rows(name, content)
    first = rows.lines[0][1].partition("#")[0]
    separator, columns = ("," if "," in first else None), len(_fields(first))
    if columns not in ((COLUMNS,) if separator is None else EUROC_COLUMNS):
        raise rows.row_error(
            0,
            f"{columns} columns; TUM has {COLUMNS} between blanks, EuRoC {EUROC_COLUMNS[0]} or "
            f"{EUROC_COLUMNS[1]} between commas",
            _REMEDY,
        )
    w_first, words = _quaternion_order(rows, separator, comments)
    stamps, values = rows.parse(1, columns - 1, separator)
    time, time_words = _stamps_in_seconds(rows, stamps[:, 0].tolist())
    problem = f"a value that is not finite, or beyond {MAX_VALUE:.0e}"
    rows.raise_where(~(np.abs(values[:, :7]) < MAX_VALUE), problem, "Remove that line.")
    position, rotation = values[:, :3], _read_rotation(rows, values[:, 3:7], w_first)
    keep, dropped = _increasing_rows(rows, time)
    time, position, rotation = time[keep], position[keep], rotation[keep]
    kind, kind_words = _detect_kind(path, columns, comments, position, rotation)
    frame, frame_words = _detect_frame(kind, position)
    is_unix = UNIX_START_S <= time[0] < UNIX_END_S
    clock = "its stamps are UNIX time" if is_unix else "its clock is its own, not UNIX time"
    reader_notes = (
        f"Recognised as {words}; {clock}.",
        time_words,
        kind_words,
        frame_words,
        dropped,
        _gap_words(time, kind),
        truncation_note,
    )
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
        notes=tuple(note for note in reader_notes if note),
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
        raise TrajectoryError.of("tum_without_orientation", trajectory=trajectory)
    time = trajectory.time_s + (trajectory.unix_offset_s or 0.0)
    table = np.column_stack((time, trajectory.position_m, trajectory.rotation.as_quat()))
    rows = (" ".join(map(repr, row)) for row in table.tolist())
    return "# timestamp tx ty tz qx qy qz qw\n" + "\n".join(rows) + "\n"


def _rows(name: str, content: bytes) -> tuple[Rows, str, str]:
    """Rows of numbers, comments and header in one text, and the words on a row that is cut."""
    text = decode_text(content)
    if text is None:
        is_ulog = content.startswith(b"ULog")
        what = "a PX4 log" if is_ulog else "a binary file"
        remedy = f"Name a part of the log: {name}:vio or {name}:ekf2." if is_ulog else _REMEDY
        raise TrajectoryError(f"{name}: {what}, not a trajectory file", remedy)
    lines = [(number, line) for number, line in enumerate(text.split("\n"), 1) if line.strip()]
    comments = [line for _, line in lines if line.lstrip().startswith("#")]
    data = [row for row in lines if not row[1].lstrip().startswith("#")]
    if len(data) > 1 and not _is_numeric_row(data[0][1]) and _is_numeric_row(data[1][1]):
        comments.append(data.pop(0)[1])  # a header that is no comment
    if data and not _is_numeric_row(data[0][1]):
        what = f"not a trajectory file: its first line is {quote(data[0][1])}"
        raise TrajectoryError(f"{name}: {what}", _REMEDY)
    truncation_note = ""
    is_short = len(data) > 1 and len(_fields(data[-1][1])) < len(_fields(data[0][1]))
    if is_short and not text.endswith("\n"):
        truncation_note = f"Line {data[-1][0]}, the last one, was dropped: it is cut."
        data.pop()
    if len(data) < MIN_POSES:
        raise TrajectoryError.of("poses_few", name=name, count=len(data), least=MIN_POSES)
    return Rows(name, data), "\n".join(comments), truncation_note


def _fields(line: str) -> list[str]:
    """Fields of a row, between commas where there are any."""
    line = line.partition("#")[0]
    return line.split("," if "," in line else None)


def _is_numeric_row(line: str) -> bool:
    return all(is_number(field.strip()) for field in _fields(line))


def _quaternion_order(rows: Rows, separator: str | None, comments: str) -> tuple[bool, str]:
    """Whether the quaternion's w comes first, and what such a table is called.

    Without a header, blanks mean TUM, and commas with nanoseconds EuRoC.
    """
    order = "".join(_NAME_OF_AXIS.findall(comments.casefold())[-4:])
    w_first = order == "wxyz"
    if order not in ("wxyz", "xyzw") and separator is not None:
        first = _fields(rows.lines[0][1])
        has_header = any(len(line.split(",")) == len(first) for line in comments.split("\n"))
        w_first = not has_header and float(first[0]) * 1e-9 >= UNIX_START_S
        if not w_first:
            raise rows.row_error(
                0,
                "the place of the quaternion's w is not known, as no header names it",
                "Add the line '#timestamp, p_x, p_y, p_z, q_w, q_x, q_y, q_z' with the columns in "
                "their order.",
            )
    if w_first == (separator is not None):
        return w_first, _EUROC if w_first else _TUM
    between = "blanks, quaternion w first" if w_first else "commas, quaternion w last"
    return w_first, f"columns between {between}, by its header"


def _stamps_in_seconds(rows: Rows, stamps: list[str]) -> tuple[Array, str]:
    """Stamps in seconds, and the words on their unit where it is not seconds."""
    bad = np.array([not is_number(one.strip()) or not np.isfinite(float(one)) for one in stamps])
    rows.raise_where(bad, "column 1 is not a time", "Correct or remove that line.")
    values = np.array(stamps, dtype=np.float64)
    step = float(np.median(np.abs(np.diff(values))))
    if step <= MAX_INTERVAL_S and np.abs(values).max() < UNIX_END_S:
        interval_question = (
            f"Poses are {step:.0f} s apart, read as seconds: are the stamps in milliseconds?"
        )
        return values, interval_question if step >= MAX_USUAL_STEP_S else ""
    for unit, per_second in PER_SECOND.items():
        first, last = float(values[0]) / per_second, float(np.abs(values).max()) / per_second
        # on a clock of its own only ORB-SLAM3's nanoseconds are known to occur
        is_known = first >= UNIX_START_S or unit == "nanoseconds"
        if is_known and last < UNIX_END_S and MIN_INTERVAL_S <= step / per_second <= MAX_INTERVAL_S:
            ticks = np.array([int(Decimal(stamp)) for stamp in stamps], dtype=np.int64)
            words = f"Its stamps are {unit} and were divided by {per_second:.0e}."
            # in two parts, as float64 does not hold the digits of UNIX time in ns
            return ticks // per_second + ticks % per_second / per_second, words
    raise TrajectoryError.of("stamps_apart", rows=rows, step=step)


def _increasing_rows(rows: Rows, time: Array) -> tuple[BoolArray, str]:
    """Rows whose stamps increase: of those that repeat the first, and the words on the others."""
    steps = np.diff(time, prepend=-np.inf)
    remedy = "Sort the lines by time, or separate the recordings."
    rows.raise_where(steps < 0.0, "its time is before that of the line above", remedy)
    repeated = int((steps == 0.0).sum())
    if repeated > MAX_REPEATED * len(steps):
        what = f"its time is that of the line above, as in {repeated} of {len(steps)} lines"
        remedy = "Export the stamps with all their digits (%.9f)."
        rows.raise_where(steps == 0.0, what, remedy)
    note = f"Dropped poses with the stamp of the one before: {repeated}." if repeated else ""
    return steps > 0.0, note


def _read_rotation(rows: Rows, quaternion: Array, w_first: bool) -> Rotation:
    norms = np.linalg.norm(quaternion, axis=1)
    what = "columns 5 to 8 are not a quaternion: its norm is not 1"
    remedy = f"Remove that line, or check the order of the columns. {_REMEDY}"
    rows.raise_where(np.abs(norms - 1.0) > MAX_NORM_ERROR, what, remedy)
    norms[np.abs(norms - 1.0) < UNIT_NORM] = 1.0
    quaternion = np.roll(quaternion, -1, axis=1) if w_first else quaternion
    return Rotation(quaternion / norms[:, None], normalize=False)


def _detect_kind(
    path: Path, columns: int, comments: str, position: Array, rotation: Rotation
) -> tuple[Kind, str]:
    """What made it, and the words on that."""
    if columns == EUROC_COLUMNS[1]:
        return "truth", "Ground truth, as its 17 columns are those of EuRoC's."
    # EuRoC's file is called data.csv; its folder says what it is
    folder = path.absolute().parent.name if path.name == "data.csv" else ""
    text_by_source = {"comments say": comments, "name says": path.name, "folder says": folder}
    for words, text in text_by_source.items():
        if _TRUTH.search(text):
            return "truth", f"Ground truth, as its {words}."
    if np.abs(position[0]).max() < IDENTITY_M and rotation[0].magnitude() < IDENTITY_RAD:
        return "slam", "SLAM, as its first pose is the identity: its world is its first key frame."
    return "unknown", ""


def _detect_frame(kind: Kind, position: Array) -> tuple[Frame, str]:
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


def _gap_words(time: Array, kind: Kind) -> str:
    """Words on missing frames, or on poses that are key frames."""
    steps = np.diff(time)
    median = float(np.median(steps))
    near: BoolArray = np.abs(steps - median) <= REGULAR_WITHIN * median
    if near.mean() < REGULAR_SHARE:
        format_interval = f"every {median:.3g} s in the median, {steps.max():.3g} s apart at most"
        return (
            f"Poses come at no rate ({format_interval}): key frames, or a recording that lost many."
        )
    gaps = np.flatnonzero(steps > max(GAP_INTERVALS * median, GAP_S))
    if not len(gaps):
        return ""
    lost = steps[gaps] - median
    missing = int((np.rint(steps[gaps] / median) - 1).sum())
    longest = time[gaps[np.argmax(lost)]] - time[0]
    what = "Tracking lost" if kind == "slam" else "No poses"
    several = f"in {len(gaps)} gaps, the longest " if len(gaps) > 1 else ""
    where = f"{several}at {longest:.1f} s after its start"
    return f"{what} for {lost.sum():.1f} s {where}, {missing} frames missing."
