"""MAVLink recording of one vehicle, with all message times on its boot clock.

The delay from timestamp to receive time is never negative and often large. A line is therefore
fitted to the messages with the smallest delay.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import theilslopes

from px4fuse.core.arrays import Array, IntArray
from px4fuse.flight.model import Columns, DataSource, time_index
from px4fuse.trajectory.rotation import rotate

from .common import MAX_FIELD_VALUE, MIN_QUATERNION_NORM, MessageLayout
from .mavlink_frames import (
    MavlinkAddress,
    MavlinkFrames,
    message_name,
    wire_layout,
)
from .mavlink_messages import (
    BOOT_CLOCK_MESSAGES,
    CONVERSION_BY_MAV_FRAME,
    MISSING_DATA_REMEDIES,
)
from .ulog_topics import find_longest_increasing_subsequence

BOOT_CLOCK_TEXT = "autopilot boot clock"
RECEIPT_CLOCK_TEXT = "autopilot boot clock, estimated from receive times"
# Factors from latitude, longitude and altitude in MAVLink messages to degrees and m
GEODETIC_SCALE = {"latitude_deg": 1e-7, "longitude_deg": 1e-7, "altitude_m": 1e-3}
# Minimum UNIX time (s), in 2001; smaller times are times since boot
MIN_UNIX_TIME_S = 1e9
# The clock fit uses the message with the least delay in each interval of this length (s)
CLOCK_FIT_INTERVAL_S = 2.0
MAX_CLOCK_FIT_INTERVALS = 200
# Minimum time span (s) to estimate a clock drift
MIN_DRIFT_SPAN_S = 30.0
# Maximum relative difference between the rates of two clocks. A larger difference shows that the
# recording was made during a replay at another speed
MAX_RELATIVE_CLOCK_RATE_DIFFERENCE = 0.01
# Maximum ratio of the rates of two clocks. It exceeds 1e9, because timestamps in ns may have been
# read as s
MAX_RATIO_OF_CLOCK_RATES = 1e12
# Minimum fraction of distinct timestamps of a running clock
MIN_DISTINCT_TIME_FRACTION = 0.1
# Minimum backward step (s) of the boot clock at a restart
MIN_BACKWARD_STEP_AT_RESTART_S = 5.0
# Number of messages around a backward step of the timestamps that confirm a restart
RESTART_CHECK_MESSAGE_COUNT = 20
# Timestamps without long gaps form a group. A group at the start or end of the recording is invalid
# if it has fewer timestamps than this fraction of the largest group
MIN_TIMESTAMP_GROUP_FRACTION = 0.01
# Maximum time (s) of a valid timestamp outside the analysed time span
MAX_TIME_OUTSIDE_FLIGHT_S = 60.0
# Columns of ODOMETRY that are equal in all coordinate frames
UNCONVERTED_COLUMNS = ["frame_id", "child_frame_id", "reset_counter"]
# Minimum number of timestamps to detect a stopped clock
MIN_STOPPED_CLOCK_TIMESTAMPS = 10


@dataclass(frozen=True)
class ClockLine:
    """Linear relation between readings x of a source clock and y of a target clock.

    y = y0 + slope · (x - x0)

    ``jitter_s`` is the robust standard deviation of the clock readings from the line.
    """

    x0: float
    y0: float
    slope: float
    jitter_s: float
    reading_pair_count: int

    def at(self, x: Array | float) -> Array:
        """Convert readings x of the source clock to readings y of the target clock."""
        return np.asarray(self.y0 + self.slope * (x - self.x0))

    def inverse(self) -> ClockLine:
        """Return the line that converts readings of the target clock to the source clock."""
        return ClockLine(
            self.y0, self.x0, 1.0 / self.slope, self.jitter_s / self.slope, self.reading_pair_count
        )


def fit_clock_line(x: Array, y: Array) -> ClockLine:
    """Fit a line to clock readings x and y (s); y is read after x, with an unknown delay.

    The fit uses the reading with the least delay in each interval.
    """
    time_order = np.argsort(x, kind="stable")
    x, y = x[time_order], y[time_order]
    x0, span_s = float(x[len(x) // 2]), float(x[-1] - x[0])
    interval_count = int(np.clip(span_s / CLOCK_FIT_INTERVAL_S, 1, MAX_CLOCK_FIT_INTERVALS))
    interval_edges = np.linspace(x[0], x[-1], interval_count + 1)[1:-1]
    interval_of_row = np.searchsorted(interval_edges, x, side="right")
    # First approximation, from the middle reading of each interval
    _, first_rows, row_counts = np.unique(interval_of_row, return_index=True, return_counts=True)
    rows = first_rows + row_counts // 2
    slope = _fit_clock_rate(x[rows], y[rows])
    if abs(slope - 1.0) <= MAX_RELATIVE_CLOCK_RATE_DIFFERENCE:
        slope = 1.0

    def select_least_delayed(slope: float) -> tuple[Array, IntArray]:
        """Return the delay (s) of each reading, and the row of the least delay in each interval.

        The delay is y minus the line through (x0, 0), so it contains an unknown constant.
        """
        delay_s = y - slope * (x - x0)
        return delay_s, pd.Series(delay_s).groupby(interval_of_row).idxmin().to_numpy()

    if span_s >= MIN_DRIFT_SPAN_S:
        # Fit the slope twice, because the slope affects which readings have the least delay
        for _ in range(2):
            delay_s, rows = select_least_delayed(slope)
            slope = _fit_clock_rate(x[rows], delay_s[rows], slope)
    delay_s, rows = select_least_delayed(slope)
    y0 = float(np.median(delay_s[rows]))
    # Robust standard deviation: 1.4826 · median absolute deviation
    jitter_s = float(1.4826 * np.median(np.abs(delay_s - np.median(delay_s))))
    return ClockLine(x0, y0, slope, jitter_s, len(x))


def _fit_clock_rate(x: Array, y: Array, added_rate: float = 0.0) -> float:
    """Return the rate of clock y relative to clock x; 1 if it is not plausible.

    It is the Theil-Sen slope of y over x plus ``added_rate``, the rate that was subtracted from y.
    """
    if len(x) < 2 or x[0] == x[-1]:
        return 1.0
    with np.errstate(over="ignore", invalid="ignore"):
        rate = float(theilslopes(y, x)[0]) + added_rate
    return rate if 1.0 / MAX_RATIO_OF_CLOCK_RATES < rate < MAX_RATIO_OF_CLOCK_RATES else 1.0


def is_running_clock(timestamps_s: Array) -> bool:
    """Return True if the timestamps are of a running clock: enough of them are distinct."""
    return len(np.unique(timestamps_s)) >= max(MIN_DISTINCT_TIME_FRACTION * len(timestamps_s), 2)


@dataclass(eq=False)  # not frozen: the readers add streams and counts
class Recording:
    """MAVLink recording of one flight, with the conversion of receive times to boot times."""

    frames: MavlinkFrames
    # Address of the autopilot of this flight
    address: MavlinkAddress
    # Type of the autopilot, such as "PX4"
    autopilot: str
    # Analysed frames, between two restarts of the autopilot
    analysed_frame_slice: slice
    # Receive time (s) of each frame. Without receive times: last boot time in the stream before it
    receive_times_s: Array
    # Conversion of receive times to the boot clock
    receive_to_boot_time_fit: ClockLine
    # Time since boot of the autopilot (s) at time zero of the flight
    time_origin_s: float
    duration_s: float
    notes: list[str]
    # Number of restarts of the autopilot; None without a restart
    restart_count: int | None
    # Number of samples with an invalid timestamp, by message
    dropped_count_by_message: dict[str, int] = field(default_factory=dict)
    # Messages and clock of each kind of data, such as "imu"
    data_source_by_data_kind: dict[str, DataSource] = field(default_factory=dict)

    @property
    def remedies(self) -> Mapping[str, str]:
        """Advice to the user for each kind of missing data."""
        return MISSING_DATA_REMEDIES["ArduPilot" if self.autopilot == "ArduPilot" else "PX4"]

    def rows_of_all_senders(self, message: str) -> IntArray:
        """Return the indices of the MAVLink frames that contain a message, from all senders."""
        rows = self.frames.rows(message)
        analysed_frames = self.analysed_frame_slice
        return np.asarray(rows[(rows >= analysed_frames.start) & (rows < analysed_frames.stop)])

    def rows(self, message: str, address: MavlinkAddress | None = None) -> IntArray:
        """Return the indices of the frames with a message from ``address`` (default: autopilot)."""
        rows = self.rows_of_all_senders(message)
        return rows[self.frames.is_sent_by(address or self.address, rows)]

    def table(self, message: str) -> NDArray[Any]:
        """Return the fields of all messages of one type from the autopilot, in MAVLink units."""
        return self.frames.table(message, self.rows(message))

    def find_most_frequent_layout(self, layouts: Sequence[MessageLayout]) -> MessageLayout:
        """Return the layout of the message type that the autopilot sent most often."""
        return max(layouts, key=lambda layout: len(self.rows(layout.topic)))

    def read(
        self,
        layout: MessageLayout,
        rows: IntArray | None = None,
        boot_times_s: Array | None = None,
        name: str = "",
    ) -> pd.DataFrame:
        """Read one message as a DataFrame with strictly increasing times (s).

        The times begin at the start of the flight, ``time_origin_s``. Euler angles are converted to
        quaternions, and vectors to NED (or FRD).

        Parameters
        ----------
        layout : MessageLayout
            Message and fields to read.
        rows : ndarray, shape (n,), optional
            Frame indices; by default all frames from the autopilot.
        boot_times_s : ndarray, shape (n,), optional
            Times since boot; by default the timestamps of the messages.
        name : str, optional
            Name under which dropped samples are counted; by default the message name.
        """
        rows = self.rows(layout.topic) if rows is None else rows
        table = self.frames.table(layout.topic, rows)
        boot_times_s = (
            self.compute_boot_times_s(table, rows) if boot_times_s is None else boot_times_s
        )
        selected_rows = self._find_rows_with_valid_time(name or layout.topic, boot_times_s)
        if len(selected_rows) < len(table):
            table = table[selected_rows]
        # Copy fields only once, because one hour of IMU data has hundreds of megabytes
        values = np.empty((len(selected_rows), len(layout.columns)))
        scales = {**GEODETIC_SCALE, **layout.scale}
        for column_index, (column, field_name) in enumerate(layout.columns.items()):
            # A field, or one element of an array field, for example "q[0]"
            array_name, _, element = field_name.removesuffix("]").partition("[")
            array = table[array_name]
            values[:, column_index] = array[:, int(element)] if element else array
            values[:, column_index] *= scales.get(column, 1.0)
        del table
        values[~(np.abs(values) < MAX_FIELD_VALUE)] = np.nan  # damaged values, and NaN
        index = time_index(boot_times_s[selected_rows] - self.time_origin_s)
        samples = pd.DataFrame(values, index, list(layout.columns), copy=False)
        if "roll" in samples:
            attitude = Rotation.from_euler("ZYX", samples[["yaw", "pitch", "roll"]].to_numpy())
            samples[Columns.QUATERNION] = attitude.as_quat(scalar_first=True)
        return _to_ned(samples) if "frame_id" in samples else samples

    def _find_rows_with_valid_time(self, name: str, boot_times_s: Array) -> IntArray:
        """Return the indices of valid and increasing boot times; count the others as dropped."""
        middle_s = self.time_origin_s + 0.5 * self.duration_s
        max_difference_s = 0.5 * self.duration_s + MAX_TIME_OUTSIDE_FLIGHT_S
        is_valid = (np.abs(boot_times_s - middle_s) <= max_difference_s) & (boot_times_s > 0.0)
        rows = np.flatnonzero(is_valid)
        time_us = np.rint(boot_times_s[rows] * 1e6).astype(np.int64)
        # A message that is received twice, over two links, does not count as dropped
        distinct = np.sort(np.unique(time_us, return_index=True)[1])
        rows, time_us = rows[distinct], time_us[distinct]
        increasing = find_longest_increasing_subsequence(time_us)
        dropped_count = np.count_nonzero(~is_valid) + len(rows) - len(increasing)
        if dropped_count:
            self.dropped_count_by_message[name] = int(dropped_count)
        return rows[increasing]

    def compute_receipt_boot_times_s(self, rows: IntArray) -> Array:
        """Return receive times of frames, converted to the boot clock (s).

        The conversion removes the minimum delay of the link.
        """
        return self.receive_to_boot_time_fit.at(self.receive_times_s[rows])

    def compute_boot_times_s(self, table: NDArray[Any], rows: IntArray) -> Array:
        """Return the time since boot (s) of each message; without timestamp, its receive time."""
        # If no message contains the boot clock, only receive times are known
        if not self.receive_to_boot_time_fit.reading_pair_count:
            return self.compute_receipt_boot_times_s(rows)
        if "time_boot_ms" in (table.dtype.names or ()):
            return table["time_boot_ms"] * 1e-3
        timestamp_s: Array = table["time_usec"] * 1e-6
        # time_usec is boot time or UNIX time. It is usable if the time origin has the same clock
        is_unix_time = timestamp_s >= MIN_UNIX_TIME_S
        is_origin_unix_time = self.time_origin_s >= MIN_UNIX_TIME_S
        is_usable = (timestamp_s > 0.0) & (is_unix_time == is_origin_unix_time)
        return np.where(is_usable, timestamp_s, self.compute_receipt_boot_times_s(rows))

    def record_data_source(
        self, data_kind: str, *messages: str, clock: str = BOOT_CLOCK_TEXT
    ) -> None:
        """Store the origin of a kind of data, such as "imu", for the report.

        The origin is the names of the MAVLink messages, and the clock of their timestamps.
        """
        self.data_source_by_data_kind[data_kind] = DataSource(messages, clock, self.frames.name)


def _to_ned(samples: pd.DataFrame) -> pd.DataFrame:
    """Convert ODOMETRY samples to NED, or to FRD if the sender's axes are not tied to north.

    Values in unsupported frames become NaN. PX4 up to v1.13 sends the velocity in the body frame,
    later releases in NED (``streams/ODOMETRY.hpp``).
    """
    quaternions = samples[Columns.QUATERNION].to_numpy(copy=True)
    has_quaternion = np.linalg.norm(quaternions, axis=1) > MIN_QUATERNION_NORM
    orientation = Columns.QUATERNION + Columns.ROTATION_VARIANCE
    # All other columns are NaN at first
    converted_samples = samples[UNCONVERTED_COLUMNS].reindex(columns=samples.columns)
    for frame_number, frame in CONVERSION_BY_MAV_FRAME.items():
        is_position_in_frame = samples["frame_id"] == frame_number
        is_velocity_in_frame = samples["child_frame_id"] == frame_number
        if frame.is_body_frame:
            # A position in the body frame is invalid. The conversion of a velocity needs the
            # attitude
            rows = is_velocity_in_frame & has_quaternion
            if rows.any():
                rotation = Rotation.from_quat(quaternions[rows], scalar_first=True).as_matrix()
                for columns, matrix in (
                    (Columns.VELOCITY, rotation),
                    # Variances in NED: diagonal of R diag(σ²) Rᵀ with the rotation matrix R
                    (Columns.VELOCITY_VARIANCE, rotation**2),
                ):
                    body_values = samples.loc[rows, columns].to_numpy()
                    converted_samples.loc[rows, columns] = rotate(matrix, body_values)
            continue
        if min(frame.axis_signs) > 0.0:  # NED or FRD
            # Quaternions relative to ENU or FLU are not converted
            rows = is_position_in_frame
            converted_samples.loc[rows, orientation] = samples.loc[rows, orientation]
        for rows, columns, variance_columns in (
            (is_position_in_frame, Columns.POSITION, Columns.POSITION_VARIANCE),
            (is_velocity_in_frame, Columns.VELOCITY, Columns.VELOCITY_VARIANCE),
        ):
            vectors = samples.loc[rows, columns].to_numpy()[:, frame.axis_order]
            variances = samples.loc[rows, variance_columns].to_numpy()[:, frame.axis_order]
            converted_samples.loc[rows, columns] = vectors * frame.axis_signs
            converted_samples.loc[rows, variance_columns] = variances
    return converted_samples


def _read_boot_times(frames: MavlinkFrames, address: MavlinkAddress) -> tuple[IntArray, Array]:
    """Return the indices of the autopilot's frames with a boot time, and these times (s)."""
    is_from_autopilot = frames.is_sent_by(address)
    times_s = np.zeros(len(frames))
    for message_id in np.unique(frames.message_ids[is_from_autopilot]).tolist():
        name = message_name(message_id)
        rows = np.flatnonzero(is_from_autopilot & (frames.message_ids == message_id))
        if "time_boot_ms" in (wire_layout(message_id).names or ()):
            times_s[rows] = frames.table(name, rows)["time_boot_ms"] * 1e-3
        elif name in BOOT_CLOCK_MESSAGES:
            times_s[rows] = frames.table(name, rows)["time_usec"] * 1e-6
    is_boot_time = (times_s > 0.0) & (times_s < MIN_UNIX_TIME_S)
    rows = np.flatnonzero(is_boot_time if np.any(is_boot_time) else times_s >= MIN_UNIX_TIME_S)
    if len(rows) >= MIN_STOPPED_CLOCK_TIMESTAMPS and not is_running_clock(times_s[rows]):
        rows = rows[:0]
    return rows, times_s[rows]


def read_recording(frames: MavlinkFrames, address: MavlinkAddress, autopilot: str) -> Recording:
    """Return the longest part of a recording without a restart of the autopilot."""
    notes: list[str] = []
    rows, boot_times_s = _read_boot_times(frames, address)
    # Select the longest part between two restarts
    analysed_frame_slice = slice(0, len(frames))
    restart_rows = _find_restarts(boot_times_s)
    if len(restart_rows):
        rows_by_part = np.split(np.arange(len(rows)), restart_rows)
        longest_part = max(rows_by_part, key=len)
        longest_part_fraction = len(longest_part) / len(rows)
        rows, boot_times_s = rows[longest_part], boot_times_s[longest_part]
        # `rows` are the frames with a boot time in the longest part. Frames before the first boot
        # time of the recording belong to its first part. Frames after the last boot time belong to
        # its last part
        analysed_frame_slice = slice(
            0 if longest_part is rows_by_part[0] else int(rows[0]),
            len(frames) if longest_part is rows_by_part[-1] else int(rows[-1]) + 1,
        )
        notes.append(
            f"number of restarts of the boot clock: {len(restart_rows)}. Only the longest part "
            f"between two restarts is analysed: {boot_times_s[0]:.1f} s to {boot_times_s[-1]:.1f} "
            f"s after boot ({longest_part_fraction:.0%} of the data)"
        )
    # Select the valid timestamps
    increasing_time_rows = _remove_stray_timestamps(
        boot_times_s,
        find_longest_increasing_subsequence(np.rint(boot_times_s * 1e6).astype(np.int64)),
    )
    rows, boot_times_s = rows[increasing_time_rows], boot_times_s[increasing_time_rows]
    # A file without receive times gets boot times as receive times, so the conversion changes
    # nothing. A file without boot times and receive times gets zeros
    receive_times_s = np.zeros(len(frames))
    receive_to_boot_time_fit = ClockLine(0.0, 0.0, 1.0, 0.0, len(rows))
    if frames.receive_times_us is not None:
        receive_times_s = (frames.receive_times_us - frames.receive_times_us[0]) * 1e-6
        if len(rows):
            receive_to_boot_time_fit = fit_clock_line(boot_times_s, receive_times_s[rows]).inverse()
    elif len(rows):
        # A raw stream has no receive times. Use the last boot time before each frame
        message_count = np.searchsorted(rows, np.arange(len(frames)), side="right")
        receive_times_s = boot_times_s[np.maximum(message_count - 1, 0)]
    else:
        notes.append("no message in the stream contains a time")
    # Without boot times, the flight lasts from the first to the last receive time
    if not len(boot_times_s):
        boot_times_s = np.array([0.0, receive_times_s.max()])
    time_origin_s, end_s = boot_times_s[[0, -1]].tolist()
    return Recording(
        frames,
        address,
        autopilot,
        analysed_frame_slice,
        receive_times_s,
        receive_to_boot_time_fit,
        time_origin_s=time_origin_s,
        duration_s=end_s - time_origin_s,
        notes=notes,
        restart_count=len(restart_rows) or None,
    )


def _find_restarts(boot_times_s: Array) -> IntArray:
    """Return the index of the first boot time (time since boot) after each autopilot restart.

    A backward step alone may be a single late or early packet. Therefore, the boot time
    RESTART_CHECK_MESSAGE_COUNT messages after the step must also be smaller than two times before
    the step: the last one, and the one RESTART_CHECK_MESSAGE_COUNT messages earlier.
    """
    rows = np.flatnonzero(np.diff(boot_times_s) < -MIN_BACKWARD_STEP_AT_RESTART_S) + 1
    earlier_rows = np.maximum(rows - 1 - RESTART_CHECK_MESSAGE_COUNT, 0)
    later_rows = np.minimum(rows + RESTART_CHECK_MESSAGE_COUNT, len(boot_times_s) - 1)
    times_before_step_s = np.minimum(boot_times_s[earlier_rows], boot_times_s[rows - 1])
    is_restart = boot_times_s[later_rows] < times_before_step_s - MIN_BACKWARD_STEP_AT_RESTART_S
    return rows[is_restart]


def _remove_stray_timestamps(times_s: Array, rows: IntArray) -> IntArray:
    """Remove a few isolated timestamps at the beginning and end of a recording."""
    timestamp_groups = np.split(
        rows, np.flatnonzero(np.diff(times_s[rows]) > MAX_TIME_OUTSIDE_FLIGHT_S) + 1
    )
    min_group_size = MIN_TIMESTAMP_GROUP_FRACTION * max(len(group) for group in timestamp_groups)
    large_group_indices = [
        index for index, group in enumerate(timestamp_groups) if len(group) >= min_group_size
    ]
    return np.concatenate(timestamp_groups[large_group_indices[0] : large_group_indices[-1] + 1])


def map_boot_to_unix(recording: Recording) -> ClockLine | None:
    """Return the conversion of boot time to UNIX time; None if SYSTEM_TIME has no UNIX time."""
    table = recording.table("SYSTEM_TIME")
    table = table[table["time_unix_usec"] * 1e-6 > MIN_UNIX_TIME_S]
    if not len(table):
        return None
    return fit_clock_line(table["time_boot_ms"] * 1e-3, table["time_unix_usec"] * 1e-6)
