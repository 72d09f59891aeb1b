"""Reader of positions in bags of ROS 1 and ROS 2, with the library rosbags."""

import hashlib
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np

from px4fuse.core.reading import (
    LOG_SIZE_REMEDY,
    display_name,
    format_size_limit,
    get_file_size,
    list_files_recursively,
    max_log_bytes,
)
from px4fuse.errors import LogError

from .recording_table import PositionTable

_BAG_SUFFIXES = (".bag", ".mcap", ".db3")
_PATH_MESSAGE_TYPE = "nav_msgs/msg/Path"
_FRAME_NED = 1  # VehicleOdometry.POSE_FRAME_NED
_POSE_COLUMNS = ["x_m", "y_m", "z_m", "qx", "qy", "qz", "qw", "sigma_x_m", "sigma_y_m", "sigma_z_m"]


# Message types that contain a position
_POSITION_MESSAGE_TYPES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
    "geometry_msgs/msg/PointStamped",
    "nav_msgs/msg/Odometry",
    _PATH_MESSAGE_TYPE,
    "px4_msgs/msg/VehicleOdometry",
)


def _read_pose_values(message: Any) -> list[float]:
    """Return x, y, z and, if available, the quaternion (x, y, z, w) and the position σ."""
    if hasattr(message, "q"):  # px4_msgs/VehicleOdometry, with the quaternion w, x, y, z
        return [*message.position.tolist(), *np.roll(message.q, -1).tolist()]
    sigma: list[float] = []
    if hasattr(message, "point"):  # PointStamped
        vectors = [message.point]
    elif hasattr(message, "transform"):  # TransformStamped
        vectors = [message.transform.translation, message.transform.rotation]
    else:
        pose = message.pose
        if hasattr(pose, "covariance"):  # Odometry and PoseWithCovarianceStamped
            variances = pose.covariance.reshape(6, 6).diagonal()[:3]
            sigma = np.sqrt(np.where(variances > 0.0, variances, np.nan)).tolist()
            pose = pose.pose
        vectors = [pose.position, pose.orientation]
    return [
        getattr(vector, axis) for vector in vectors for axis in "xyzw" if hasattr(vector, axis)
    ] + sigma


def is_bag(path: Path) -> bool:
    """Return True if the path is a ROS bag (file or folder)."""
    return (path / "metadata.yaml").exists() or path.suffix.lower() in _BAG_SUFFIXES


def read_bag(path: Path, topic: str | None) -> tuple[PositionTable, str, int]:
    """Read the poses in one topic of a ROS bag, and the SHA-256 and size (bytes) of the bag.

    Raises
    ------
    LogError
        The library rosbags is missing, the bag cannot be read, or the topic has no positions.
    """
    name = display_name(path)
    try:
        # Imported here, because the library rosbags is optional
        from rosbags.highlevel import AnyReader  # noqa: PLC0415
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415
    except ImportError:
        raise LogError(
            f"{name} is a ROS bag, but the library rosbags, which reads it, is not installed",
            "Run pip install 'px4fuse[ros]'.",
        ) from None
    files = list_files_recursively(path) if path.is_dir() else [path]
    size_bytes = sum(get_file_size(file, LogError) for file in files)
    if size_bytes > max_log_bytes.get():
        raise LogError(format_size_limit(name, size_bytes, max_log_bytes.get()), LOG_SIZE_REMEDY)
    sha256 = hashlib.sha256()
    for file in files:
        with file.open("rb") as stream:
            # All files are added to one hash object, so the result is the hash of all files
            hashlib.file_digest(stream, lambda: sha256)
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            return _read_topic(name, reader, topic), sha256.hexdigest(), size_bytes
    except LogError:
        raise
    except Exception as error:  # rosbags raises many types for damaged bags
        raise LogError(
            f"{name}: the ROS bag cannot be read ({error})", "Repair the bag with ros2 bag reindex."
        ) from error


def _read_topic(name: str, reader: Any, topic: str | None) -> PositionTable:
    type_by_topic = {
        connection.topic: connection.msgtype
        for connection in reader.connections
        if connection.msgtype in _POSITION_MESSAGE_TYPES
    }
    if topic is None and len(type_by_topic) == 1:
        [topic] = type_by_topic
    if topic not in type_by_topic:
        raise LogError(
            f"{name} does not contain {f'topic {topic}' if topic else 'exactly one topic'} with "
            f"positions; topics with positions: {', '.join(type_by_topic) or 'none'}",
            f"Give the topic as {name}:TOPIC."
            if type_by_topic
            else "Record the positions as PoseStamped.",
        )
    message_type = type_by_topic[topic]
    messages = reader.messages(
        [connection for connection in reader.connections if connection.topic == topic]
    )
    if message_type == _PATH_MESSAGE_TYPE:
        messages = deque(messages, maxlen=1)  # the last path repeats the poses of all others
    rows, pose_frames = [], set()
    for connection, _, raw_message in messages:
        message = reader.deserialize(raw_message, connection.msgtype)
        for pose in message.poses if message_type == _PATH_MESSAGE_TYPE else [message]:
            pose_frames.add(getattr(pose, "pose_frame", None))
            rows.append([_read_time_ns(pose), *_read_pose_values(pose)])
    column_count = len(rows[0]) - 1 if rows else 3
    return PositionTable(
        name,
        "ROS bag",
        ["time_ns", *_POSE_COLUMNS[:column_count]],
        "".join(f"{','.join(map(str, row))}\n" for row in rows),
        has_only_chosen_body=True,
        frames=("ned",) if pose_frames == {_FRAME_NED} else (),
        notes=(f"the topic is {topic} ({message_type})",),
    )


def _read_time_ns(message: Any) -> int:
    if hasattr(message, "header"):
        return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)
    return int(message.timestamp_sample) * 1000
