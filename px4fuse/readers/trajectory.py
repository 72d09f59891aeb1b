"""Reader of trajectory files: TUM, EuRoC ground truth and ORB-SLAM3.

TUM is ``time tx ty tz qx qy qz qw`` in seconds, separated by blanks (Sturm 2012). EuRoC ground
truth is ``time, x, y, z, qw, qx, qy, qz, ...`` in nanoseconds, separated by commas (Burri 2016).
ORB-SLAM3's ``SaveTrajectoryEuRoC`` writes TUM columns with nanoseconds and omits frames without
tracking. The format is detected from the content and reported in the notes.
"""

import hashlib
import math
import re
from decimal import Decimal
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from px4fuse.core.arrays import Array, BoolArray
from px4fuse.core.reading import display_name, read_bytes_limited
from px4fuse.errors import TrajectoryError
from px4fuse.readers.text_table import UNIX_END_S, UNIX_START_S, Rows, decode_text, is_number, quote
from px4fuse.trajectory.model import MIN_POSES, Frame, Kind, Trajectory

MAX_FILE_BYTES = 500_000_000
TUM_COLUMNS = 8
# Numbers of columns in EuRoC files: pose only, or also velocity and biases of gyro and
# accelerometer
EUROC_COLUMNS = (8, 17)
# Maximum median interval (s) between poses that is not reported as doubtful: a longer interval may
# be in milliseconds
MAX_USUAL_INTERVAL_S = 10.0
# Maximum plausible median interval (s) between poses: key frames may have minutes between them
MAX_INTERVAL_S = 1000.0
# Minimum plausible median interval (s) between poses: frame rates are below 1 kHz
MIN_INTERVAL_S = 1e-3
UNITS_PER_SECOND = {"nanoseconds": 10**9, "microseconds": 10**6, "milliseconds": 10**3}
# Maximum deviation of a valid quaternion from norm 1
MAX_NORM_ERROR = 0.1
# Maximum absolute coordinate (m): larger values are timestamps or damaged text
MAX_COORDINATE_M = 1e9
# Maximum deviation of a quaternion from norm 1 that is not corrected: a rounding error of float64
UNIT_NORM_TOLERANCE = 1e-15
# Maximum fraction of repeated timestamps: a larger fraction shows that timestamps have too few
# digits
MAX_REPEATED_FRACTION = 0.01
# Maximum coordinate (m) and rotation angle (rad) to accept the first pose as the identity
MAX_IDENTITY = 1e-6
# Maximum ratio of height to width of a level motion (RMS extents along the principal axes)
MAX_THICKNESS_RATIO = 1 / 3
# Minimum ratio of width to length of a level motion: a straight motion does not show the vertical
MIN_WIDTH_RATIO = 0.1
# Maximum angle (rad) between the vertical of a level motion and the y axis of a camera frame
MAX_TILT_RAD = math.radians(20.0)
# Minimum fraction of intervals between poses near the median interval, for a regular frame rate
MIN_REGULAR_FRACTION = 0.9
# Maximum relative deviation of a regular interval from the median interval
MAX_INTERVAL_DEVIATION = 0.5
# Minimum interval between two poses that counts as a gap, in median intervals
MIN_GAP_INTERVALS = 2.5
# Minimum interval (s) between two poses that counts as a gap
MIN_GAP_S = 0.3

_TUM = "TUM (time x y z qx qy qz qw)"
_EUROC = "EuRoC (time, x, y, z, qw, qx, qy, qz with commas)"
# Column names of quaternion components in EuRoC headers, such as "q_RS_w []" and "qw"
_QUATERNION_NAME = re.compile(r"\bq(?:\w*_)?([wxyz])\b")
_TRUTH_WORDS = re.compile(r"truth|vicon|leica|mocap|(?<![a-z])gt(?![a-z])", re.IGNORECASE)
_REMEDY = f"Export the trajectory in the format {_TUM} with times in seconds."


def read_trajectory(path: str | Path) -> Trajectory:
    """Read a trajectory file.

    Parameters
    ----------
    path : str or Path
        File in the format of TUM, EuRoC ground truth or ORB-SLAM3.

    Returns
    -------
    Trajectory
        ``time_s`` are the timestamps of the file in s. ``kind`` is "truth" if a comment, the file
        name or the EuRoC columns indicate ground truth, and "slam" if the first pose is the
        identity. ``frame`` is "camera" if ``kind`` is "slam" and the motion is level with y
        vertical.

    Raises
    ------
    TrajectoryError
        The file cannot be read or is not a trajectory, has fewer than three poses, timestamps that
        go back, numbers that are not finite, or quaternions without unit length.
    """
    path = Path(path)
    name = display_name(path)
    content = read_bytes_limited(
        path, TrajectoryError, MAX_FILE_BYTES, empty_remedy="Export the trajectory again."
    )
    rows, comments, truncation_note = _split_rows(name, content)
    first_row = rows.lines[0][1].partition("#")[0]
    separator = "," if "," in first_row else None
    columns = len(_fields(first_row))
    if columns not in ((TUM_COLUMNS,) if separator is None else EUROC_COLUMNS):
        raise rows.row_error(
            0,
            f"the line has {columns} columns; TUM has {TUM_COLUMNS} separated by blanks, EuRoC "
            f"{EUROC_COLUMNS[0]} or {EUROC_COLUMNS[1]} separated by commas",
            _REMEDY,
        )
    is_w_first, format_name = _detect_quaternion_order(rows, separator, comments)
    timestamps, values = rows.parse(1, columns - 1, separator)
    time, time_note = _convert_timestamps(rows, timestamps[:, 0].tolist())
    rows.raise_where(
        ~(np.abs(values[:, :7]) < MAX_COORDINATE_M),
        f"the line contains a value that is not finite or above {MAX_COORDINATE_M:.0e}",
        "Remove this line.",
    )
    position = values[:, :3]
    rotation = _read_rotation(rows, values[:, 3:7], is_w_first)
    is_kept, dropped_note = _increasing_rows(rows, time)
    time, position, rotation = time[is_kept], position[is_kept], rotation[is_kept]
    kind, kind_note = _detect_kind(path, columns, comments, position, rotation)
    frame, frame_note = _detect_frame(kind, position)
    is_unix = UNIX_START_S <= time[0] < UNIX_END_S
    clock_text = "UNIX times" if is_unix else "not UNIX times"
    reader_notes = (
        f"The format is {format_name}; the timestamps are {clock_text}.",
        time_note,
        kind_note,
        frame_note,
        dropped_note,
        _describe_gaps(time, kind),
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
    """Return the trajectory as the text of a TUM file, with all digits of float64.

    Parameters
    ----------
    trajectory : Trajectory
        Trajectory with orientation. Timestamps are UNIX time if ``unix_offset_s`` is known.

    Raises
    ------
    TrajectoryError
        The trajectory has no orientation, which the format requires.
    """
    if trajectory.rotation is None:
        raise TrajectoryError(
            f"{trajectory.name} has no orientations, which a TUM file needs",
            "Choose a track with orientations.",
        )
    time = trajectory.time_s + (trajectory.unix_offset_s or 0.0)
    table = np.column_stack((time, trajectory.position_m, trajectory.rotation.as_quat()))
    rows = (" ".join(map(repr, row)) for row in table.tolist())
    return "# timestamp tx ty tz qx qy qz qw\n" + "\n".join(rows) + "\n"


def _split_rows(name: str, content: bytes) -> tuple[Rows, str, str]:
    """Return the numeric rows, the comments (with header), and a note on a dropped last row."""
    text = decode_text(content)
    if text is None:
        fault, remedy = "a binary file", _REMEDY
        if content.startswith(b"ULog"):
            fault, remedy = "a PX4 log", f"Choose a track of the log: {name}:vio or {name}:ekf2."
        raise TrajectoryError(f"{name} is {fault}, not a trajectory file", remedy)
    lines = [(number, line) for number, line in enumerate(text.split("\n"), 1) if line.strip()]
    comments = [line for _, line in lines if line.lstrip().startswith("#")]
    numeric_rows = [row for row in lines if not row[1].lstrip().startswith("#")]
    # A line that is not numeric is a header without #, if a numeric line is below it
    is_numeric = [_is_numeric_row(line) for _, line in numeric_rows[:2]]
    if is_numeric == [False, True]:
        comments.append(numeric_rows.pop(0)[1])
    elif is_numeric and not is_numeric[0]:
        raise TrajectoryError(
            f"{name} is not a trajectory file: the first line is {quote(numeric_rows[0][1])}",
            _REMEDY,
        )
    truncation_note = ""
    widths = [len(_fields(line)) for _, line in (*numeric_rows[:1], *numeric_rows[-1:])]
    if not text.endswith("\n") and widths != sorted(widths):
        truncation_note = (
            f"The last line (line {numeric_rows.pop()[0]}) is incomplete and was dropped."
        )
    if len(numeric_rows) < MIN_POSES:
        raise TrajectoryError(
            f"{name} contains {len(numeric_rows)} poses; at least {MIN_POSES} are needed",
            "Export the trajectory again.",
        )
    return Rows(name, numeric_rows), "\n".join(comments), truncation_note


def _fields(line: str) -> list[str]:
    line = line.partition("#")[0]
    return line.split("," if "," in line else None)


def _is_numeric_row(line: str) -> bool:
    return all(is_number(field.strip()) for field in _fields(line))


def _detect_quaternion_order(rows: Rows, separator: str | None, comments: str) -> tuple[bool, str]:
    """Return True if w is the first quaternion component, and the name of the format.

    Without a header, blanks mean TUM, and commas with UNIX time in nanoseconds mean EuRoC.
    """
    order = "".join(_QUATERNION_NAME.findall(comments.casefold())[-4:])
    is_w_first = order == "wxyz"
    if order not in ("wxyz", "xyzw") and separator is not None:
        first_row = _fields(rows.lines[0][1])
        has_header = any(len(line.split(",")) == len(first_row) for line in comments.split("\n"))
        is_w_first = not has_header and float(first_row[0]) * 1e-9 >= UNIX_START_S
        if not is_w_first:
            raise rows.row_error(
                0,
                "the header does not contain the order of the quaternion components",
                "Add a header such as '#timestamp, p_x, p_y, p_z, q_w, q_x, q_y, q_z'.",
            )
    if is_w_first == (separator is not None):
        return is_w_first, _EUROC if is_w_first else _TUM
    order = "blanks and quaternion order wxyz" if is_w_first else "commas and quaternion order xyzw"
    return is_w_first, f"a table separated by {order}, according to the header"


def _convert_timestamps(rows: Rows, timestamps: list[str]) -> tuple[Array, str]:
    """Convert the timestamps to seconds; also return a note on the unit, or an empty string."""
    is_invalid = np.array(
        [not is_number(text.strip()) or not np.isfinite(float(text)) for text in timestamps]
    )
    rows.raise_where(is_invalid, "the first column is not a time", "Correct or remove this line.")
    values = np.array(timestamps, dtype=np.float64)
    median_interval = float(np.median(np.abs(np.diff(values))))
    if median_interval <= MAX_INTERVAL_S and np.abs(values).max() < UNIX_END_S:
        if median_interval < MAX_USUAL_INTERVAL_S:
            return values, ""
        return values, (
            f"The timestamps are read as seconds; the median interval is {median_interval:.0f} s. "
            "Check that the unit is not milliseconds."
        )
    for unit, units_per_second in UNITS_PER_SECOND.items():
        first_s = float(values[0]) / units_per_second
        latest_s = float(np.abs(values).max()) / units_per_second
        # Times that are not UNIX time must be in nanoseconds, as ORB-SLAM3 writes them
        if (
            (first_s >= UNIX_START_S or unit == "nanoseconds")
            and latest_s < UNIX_END_S
            and MIN_INTERVAL_S <= median_interval / units_per_second <= MAX_INTERVAL_S
        ):
            counts = np.array([int(Decimal(timestamp)) for timestamp in timestamps], dtype=np.int64)
            # Seconds and remainder are divided separately: float64 cannot represent UNIX time in ns
            seconds = counts // units_per_second + counts % units_per_second / units_per_second
            return seconds, f"The timestamps were converted from {unit} to seconds."
    raise TrajectoryError(
        f"{rows.file_name}: the median interval of the timestamps, {median_interval:.3g}, is not "
        "valid in any unit from seconds to nanoseconds",
        "Give timestamps in seconds.",
    )


def _increasing_rows(rows: Rows, time: Array) -> tuple[BoolArray, str]:
    """Return a mask of the rows without repeated timestamps, and a note on the other rows."""
    steps = np.diff(time, prepend=-np.inf)
    rows.raise_where(
        steps < 0.0,
        "the timestamp is earlier than in the line above",
        "Sort the lines by time, or write each recording to a separate file.",
    )
    repeated_count = int((steps == 0.0).sum())
    if repeated_count > MAX_REPEATED_FRACTION * len(steps):
        rows.raise_where(
            steps == 0.0,
            f"this line and {repeated_count - 1} others have the same timestamp as the line above",
            "Export the timestamps with all digits (%.9f).",
        )
    note = (
        f"Number of dropped poses with a repeated timestamp: {repeated_count}."
        if repeated_count
        else ""
    )
    return steps > 0.0, note


def _read_rotation(rows: Rows, quaternion: Array, is_w_first: bool) -> Rotation:
    norms = np.linalg.norm(quaternion, axis=1)
    rows.raise_where(
        np.abs(norms - 1.0) > MAX_NORM_ERROR,
        "columns 5 to 8 are not a quaternion with norm 1",
        f"Remove this line, or check the order of the columns. {_REMEDY}",
    )
    norms[np.abs(norms - 1.0) < UNIT_NORM_TOLERANCE] = 1.0
    quaternion = np.roll(quaternion, -1, axis=1) if is_w_first else quaternion
    return Rotation(quaternion / norms[:, None], normalize=False)


def _detect_kind(
    path: Path, columns: int, comments: str, position: Array, rotation: Rotation
) -> tuple[Kind, str]:
    if columns == EUROC_COLUMNS[1]:
        return "truth", "The trajectory is ground truth, according to the 17 columns of the file."
    # EuRoC files are always called data.csv; their folder name indicates the kind
    folder = path.absolute().parent.name if path.name == "data.csv" else ""
    text_by_source = {"a comment": comments, "the file name": path.name, "the folder name": folder}
    for source, text in text_by_source.items():
        if _TRUTH_WORDS.search(text):
            return "truth", f"The trajectory is ground truth, according to {source}."
    if max(np.abs(position[0]).max(), rotation[0].magnitude()) < MAX_IDENTITY:
        return "slam", "The trajectory is from SLAM, because the first pose is the identity."
    return "unknown", ""


def _detect_frame(kind: Kind, position: Array) -> tuple[Frame, str]:
    if kind != "slam":
        return "unknown", ""
    centred_m = position - position.mean(axis=0)
    eigenvalues, axes = np.linalg.eigh(centred_m.T @ centred_m)  # eigenvalues in ascending order
    height, width, length = np.sqrt(np.maximum(eigenvalues, 0.0) / len(position))
    tilt = math.acos(min(1.0, abs(float(axes[1, 0]))))
    is_level = width > MIN_WIDTH_RATIO * length and height < MAX_THICKNESS_RATIO * width
    if not is_level or tilt > MAX_TILT_RAD:
        return "unknown", ""
    return "camera", (
        "The frame is a camera frame (x right, y down, z forward), because the motion is in a "
        f"plane with the normal {math.degrees(tilt):.0f}° from the y axis."
    )


def _describe_gaps(time: Array, kind: Kind) -> str:
    """Return a note on gaps between poses or an irregular pose rate.

    Return an empty string if the pose rate is regular.
    """
    intervals_s = np.diff(time)
    median_s = float(np.median(intervals_s))
    is_regular: BoolArray = np.abs(intervals_s - median_s) <= MAX_INTERVAL_DEVIATION * median_s
    if is_regular.mean() < MIN_REGULAR_FRACTION:
        return (
            "The poses are key frames, or many poses are missing: the pose intervals are irregular "
            f"(median {median_s:.3g} s, maximum {intervals_s.max():.3g} s)."
        )
    gaps = np.flatnonzero(intervals_s > max(MIN_GAP_INTERVALS * median_s, MIN_GAP_S))
    if not len(gaps):
        return ""
    lost_s = intervals_s[gaps] - median_s
    longest_start_s = time[gaps[np.argmax(lost_s)]] - time[0]
    fault = "Tracking was lost" if kind == "slam" else "Poses are missing"
    return (
        f"{fault} for {lost_s.sum():.1f} s in {len(gaps)} gaps. The longest gap begins "
        f"{longest_start_s:.1f} s after the first pose."
    )
