"""Reader of trajectories: TUM, EuRoC, ORB-SLAM3, KITTI, ROS bags, and all position files.

The format is detected from the content.
"""

import math
import re
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from px4fuse.core.arrays import Array
from px4fuse.core.reading import read_head
from px4fuse.errors import LogError, TrajectoryError
from px4fuse.trajectory.model import Frame, Trajectory, TrajectoryKind

from .position_file import PositionRecording, read_position_file
from .recording_table import COLUMNS_OPTION, HEADERLESS_TABLE_FORMAT
from .ros_bag import is_bag

# Maximum deviation of a valid quaternion from norm 1
MAX_QUATERNION_NORM_ERROR = 0.1
# Maximum absolute coordinate (m); larger values are timestamps or damaged text
MAX_COORDINATE_M = 1e9
# Maximum deviation of a unit quaternion from norm 1 (rounding of float64)
UNIT_NORM_TOLERANCE = 1e-15
# Maximum fraction of rows that are dropped. If more rows are dropped, the timestamps are probably
# rounded, so that successive rows have equal times
MAX_DROPPED_ROW_FRACTION = 0.01
# Maximum coordinate (m) and rotation angle (rad) of a first pose that counts as the identity
MAX_DEVIATION_FROM_IDENTITY = 1e-6
# RMS extents of a trajectory along its three principal axes: the motion is planar if the smallest ÷
# the second largest extent is below this ratio
MAX_SMALLEST_TO_SECOND_EXTENT_RATIO = 1 / 3
# The plane of a motion is unique, because the motion is not along a straight line, if the second
# largest ÷ the largest RMS extent exceeds this ratio
MIN_SECOND_TO_LARGEST_EXTENT_RATIO = 0.1
# Maximum angle (rad) between the normal of the plane of motion and the y axis of a camera frame
MAX_TILT_RAD = math.radians(20.0)
# Regular frame rate of a trajectory: minimum fraction of pose intervals near the median interval
MIN_REGULAR_INTERVAL_FRACTION = 0.9
# A pose interval is near the median interval if it differs by at most this fraction of the median
MAX_RELATIVE_DEVIATION_FROM_MEDIAN_INTERVAL = 0.5
# Minimum duration of a gap between two poses ÷ median interval between poses
MIN_GAP_IN_MEDIAN_INTERVALS = 2.5
# Minimum duration (s) of a gap between two poses
MIN_POSE_GAP_S = 0.3

# Words that indicate ground truth; b_w_RS_S is the gyro bias in EuRoC ground truth
_TRUTH_NAME_PATTERN = re.compile(
    r"truth|vicon|leica|mocap|(?<![a-z])gt(?![a-z])|b_w_RS_S", re.IGNORECASE
)
# Number of bytes at the start of a file in which comments are searched
_COMMENT_SEARCH_BYTES = 4096
# Coordinate frame of a trajectory, if format or column names of the file allow only one frame. The
# axes "edn" are those of a camera
_FRAME_BY_RECORDING_FRAMES: dict[tuple[str, ...], Frame] = {
    ("ned",): "NED",
    ("enu",): "ENU",
    ("edn",): "camera",
}


def read_trajectory(path: str | Path, body: str | None = None) -> Trajectory:
    """Read a trajectory file, and detect its kind (ground truth or SLAM) and coordinate frame.

    ``body`` selects a rigid body, a UWB tag or a topic of a ROS bag.

    Raises
    ------
    TrajectoryError
        The file cannot be read, or its poses are not valid.
    """
    path = Path(path)
    try:
        recording = read_position_file(path, body=body, is_trajectory=True)
    except LogError as error:
        # Remove advice on an option that trajectory commands do not have
        remedy = re.sub(f" [^.]*{COLUMNS_OPTION}.", "", error.remedy)
        raise TrajectoryError(error.reason, remedy) from error
    name, samples = recording.name, recording.samples
    position_m = samples[["x_m", "y_m", "z_m"]].to_numpy()
    dropped_count = recording.row_count - len(samples)
    if recording.format == HEADERLESS_TABLE_FORMAT:
        raise TrajectoryError(
            f"{name} has no header that names its columns",
            "Add a header such as '# time x y z qx qy qz qw'.",
        )
    if dropped_count > MAX_DROPPED_ROW_FRACTION * recording.row_count:
        raise TrajectoryError(
            f"{name}: {dropped_count} of {recording.row_count} rows are not valid poses "
            f"({'; '.join(recording.notes)})",
            "Export the timestamps with all digits (%.9f), and remove the invalid rows.",
        )
    if np.isnan(position_m).any():
        raise TrajectoryError(f"{name} contains no height", "Export x, y and z.")
    rotation = _read_rotation(recording)
    first_bytes = b"" if is_bag(path) else read_head(path, _COMMENT_SEARCH_BYTES, TrajectoryError)
    comment_text = "\n".join(re.findall(r"(?m)^\s*#.*", first_bytes.decode(errors="replace")))
    kind, kind_note = _detect_trajectory_kind(path, comment_text, position_m, rotation)
    # A frame that the file format or the column names state is preferred to the detected frame
    frame, frame_note = _detect_frame(kind, position_m)
    frame = _FRAME_BY_RECORDING_FRAMES.get(recording.frames, frame)
    time_s = samples.index.to_numpy()
    notes = (*recording.format_detection_notes, *recording.notes)
    return Trajectory(
        name=name,
        kind=kind,
        time_s=time_s,
        position_m=position_m,
        rotation=rotation,
        frame=frame,
        unix_offset_s=0.0 if recording.clock_kind == "UNIX" else None,
        sha256=recording.sha256,
        size_bytes=recording.size_bytes,
        notes=(
            *(f"{note[0].upper()}{note[1:]}." for note in notes),
            *filter(None, (kind_note, frame_note, _describe_gaps(time_s))),
        ),
    )


def format_tum(trajectory: Trajectory) -> str:
    """Write a trajectory as the text of a TUM file, with all digits of float64.

    Raises
    ------
    TrajectoryError
        The trajectory has no orientations.
    """
    if trajectory.rotation is None:
        raise TrajectoryError(
            f"{trajectory.name} has no orientations, which a TUM file needs",
            "Choose a track with orientations.",
        )
    time_s = trajectory.time_s + (trajectory.unix_offset_s or 0.0)
    tum_columns = np.column_stack((time_s, trajectory.position_m, trajectory.rotation.as_quat()))
    rows = (" ".join(map(repr, row)) for row in tum_columns.tolist())
    return "# timestamp tx ty tz qx qy qz qw\n" + "\n".join(rows) + "\n"


def _read_rotation(recording: PositionRecording) -> Rotation | None:
    """Return the orientation of each pose; None if the file contains only positions."""
    quaternions = recording.quaternions
    if quaternions is None:
        return None
    norms = np.linalg.norm(quaternions, axis=1)
    if not np.nan_to_num(norms).any():  # zeros or NaN: the file has positions only
        return None
    if not (np.abs(norms - 1.0) <= MAX_QUATERNION_NORM_ERROR).all():
        raise TrajectoryError(
            f"{recording.name}: a quaternion does not have norm 1",
            "Check the columns qx, qy, qz and qw.",
        )
    norms[np.abs(norms - 1.0) < UNIT_NORM_TOLERANCE] = 1.0
    return Rotation(quaternions / norms[:, None], normalize=False)


def _detect_trajectory_kind(
    path: Path, comment_text: str, position_m: Array, rotation: Rotation | None
) -> tuple[TrajectoryKind, str]:
    # EuRoC files are always called data.csv, so the folder name is searched
    folder = path.absolute().parent.name if path.name == "data.csv" else ""
    searched_texts = {
        "A comment in the file": comment_text,
        "The file name": path.name,
        "The folder name": folder,
    }
    for place, text in searched_texts.items():
        if _TRUTH_NAME_PATTERN.search(text):
            return "truth", f"{place} states that the trajectory is ground truth."
    if (
        rotation is not None
        and max(np.abs(position_m[0]).max(), rotation[0].magnitude()) < MAX_DEVIATION_FROM_IDENTITY
    ):
        return "slam", "px4fuse assumes SLAM, because the first pose is the identity."
    return "unknown", ""


def _detect_frame(kind: TrajectoryKind, position_m: Array) -> tuple[Frame, str]:
    """Return the coordinate frame of a trajectory, and the reason as a sentence."""
    if kind != "slam":
        return "unknown", ""
    centred_m = position_m - position_m.mean(axis=0)
    eigenvalues, axes = np.linalg.eigh(centred_m.T @ centred_m)  # eigenvalues in ascending order
    smallest_extent, second_extent, largest_extent = np.sqrt(np.maximum(eigenvalues, 0.0))
    tilt_rad = math.acos(min(1.0, abs(axes[1, 0])))
    is_planar = (
        second_extent > MIN_SECOND_TO_LARGEST_EXTENT_RATIO * largest_extent
        and smallest_extent < MAX_SMALLEST_TO_SECOND_EXTENT_RATIO * second_extent
    )
    if not is_planar or tilt_rad > MAX_TILT_RAD:
        return "unknown", ""
    return "camera", (
        "The frame is a camera frame (x right, y down, z forward): the motion is in a plane "
        f"perpendicular to y within {math.degrees(tilt_rad):.0f}°, so y is vertical."
    )


def _describe_gaps(time_s: Array) -> str:
    """Return a note on gaps or irregular intervals between poses; "" if there are none."""
    intervals_s = np.diff(time_s)
    median_interval_s = np.median(intervals_s)
    max_deviation_s = MAX_RELATIVE_DEVIATION_FROM_MEDIAN_INTERVAL * median_interval_s
    is_regular = np.abs(intervals_s - median_interval_s) <= max_deviation_s
    if np.mean(is_regular) < MIN_REGULAR_INTERVAL_FRACTION:
        return (
            f"The pose intervals are irregular (median {median_interval_s:.3g} s, maximum "
            f"{intervals_s.max():.3g} s): the poses are key frames, or many poses are missing."
        )
    gap_indices = np.flatnonzero(
        intervals_s > max(MIN_GAP_IN_MEDIAN_INTERVALS * median_interval_s, MIN_POSE_GAP_S)
    )
    if not len(gap_indices):
        return ""
    missing_time_s = intervals_s[gap_indices] - median_interval_s
    longest_gap_start_s = time_s[gap_indices[np.argmax(missing_time_s)]] - time_s[0]
    return (
        f"Poses are missing for {missing_time_s.sum():.1f} s in {len(gap_indices)} gaps. The "
        f"longest gap begins {longest_gap_start_s:.1f} s after the first pose."
    )
