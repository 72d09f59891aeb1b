"""Topics of a ULog file as tables with valid timestamps.

Samples with invalid timestamps are removed. In real logs, timestamps may be zero, decrease or jump
by hours.
"""

import contextlib
import hashlib
import io
import struct
from bisect import bisect_left
from collections.abc import Callable, Mapping
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import Any

import numpy as np
import pandas as pd
from msgspec import UNSET
from numpy.typing import NDArray
from pyulog import ULog
from pyulog.exceptions import ULogException

from px4fuse.core.arrays import IntArray
from px4fuse.core.text import join_first_names
from px4fuse.errors import LogError
from px4fuse.flight.ekf2_parameters import (
    MODEL_PARAMETERS,
    PARAMETERS_IN_RESULTS,
    replace_invalid_parameters,
)
from px4fuse.flight.model import (
    DataSource,
    Dropout,
    LogInfo,
    ParameterChange,
    rows_between,
    sample_step_function,
    time_index,
)

from .common import MAX_FIELD_VALUE, MessageLayout
from .px4_topics import IMU_LAYOUT, TOPIC_LAYOUTS, list_topics

_MICROSECOND_S = 1e-6
# Maximum delay (s) from measurement to publication; otherwise, timestamp_sample is not boot time
MAX_PUBLICATION_LAG_S = 10.0
# Maximum time (s) of a valid sample before or after the IMU data
MAX_SAMPLE_TIME_OUTSIDE_IMU_S = 2.0
# ULog info message with a note for the users of the log
ULOG_NOTE_KEY = "px4fuse_note"
# ULog info message that marks a student assignment
ULOG_ASSIGNMENT_KEY = "px4fuse_assessed"
# True for commands of instructors: they also report the faults in the log of a student assignment.
# Other commands hide these faults
shows_diagnosis_of_assignments = ContextVar("shows_diagnosis_of_assignments", default=False)
# Maximum interval (s) between valid IMU timestamps
MAX_DATA_GAP_S = 600.0
# Maximum number of fields of all topics, to limit the memory; real logs have 3,300
MAX_FIELDS = 200_000
# Length (bytes) of a ULog message header
HEADER_BYTES = 3
# Header of a sample: length of the message, its type, and number of the topic instance
SAMPLE_HEADER = struct.Struct("<HBH")
TIMESTAMP_FORMAT = struct.Struct("<Q")

# Samples of one topic instance: an array for each PX4 field
TopicArrays = dict[str, NDArray[Any]]
# Tables by topic name and instance number
TopicTables = dict[tuple[str, int], TopicArrays]
# Time (s) and number of each new primary EKF2 instance
InstanceSwitches = tuple[tuple[float, int], ...]
# Value for logs without a change of the primary instance: EKF2 instance 0 is always primary
NO_EKF2_INSTANCE_SWITCHES: InstanceSwitches = ((-np.inf, 0),)


class _ULogContent(io.BytesIO):
    """Content of a ULog file; reads samples, and counts the damaged bytes that pyulog skips."""

    parser: ULog | None = None  # set after the definitions of the ULog are read
    skipped_bytes = 0
    header_start_offset = read_end_offset = position = 0  # byte offsets in the file

    def read(self, size: int, /) -> bytes:  # type: ignore[override]  # pyulog gives a size
        """Return ``size`` bytes from the current position.

        pyulog reads each message as a header and a content. Before a header, all samples up to the
        next message that is not a sample are read here. pyulog continues after these samples.
        """
        start = self.position
        if size == HEADER_BYTES:
            # After an invalid message, pyulog seeks to a later position. The bytes from the header
            # of the invalid message to this position are damaged
            if start != self.read_end_offset:
                self.skipped_bytes += start - self.header_start_offset
            if self.parser is not None:
                start = super().seek(_read_samples(self.parser, self.getvalue(), start))
            self.header_start_offset = start
        self.read_end_offset = self.position = start + size
        return super().read(size)

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        # Seek relative to the end of the requested bytes, even if fewer bytes were read. Otherwise,
        # pyulog would read the end of a truncated file endlessly
        if whence == io.SEEK_CUR:
            offset += self.position
        self.position = super().seek(offset)
        return self.position


def _read_samples(parser: ULog, content: bytes, start: int) -> int:
    """Read topic samples from byte offset ``start`` up to the first message that is not a sample.

    Return the offset of that message. pyulog reads all other messages. It would also read samples,
    but in twice the time.
    """
    subscriptions, ignored_message_ids = parser._subscriptions, parser._filtered_message_ids
    last_time_us = parser._last_timestamp
    while start <= len(content) - SAMPLE_HEADER.size:
        size, message_type, number = SAMPLE_HEADER.unpack_from(content, start)
        end = start + HEADER_BYTES + size
        if message_type != ULog.MSG_TYPE_DATA or end > len(content):
            break
        if number in subscriptions:
            subscription, sample_start = subscriptions[number], start + SAMPLE_HEADER.size
            time_start = sample_start + subscription.timestamp_offset
            if (
                subscription.dtype.itemsize != end - sample_start
                or end < time_start + TIMESTAMP_FORMAT.size
            ):
                break
            subscription.buffer += content[sample_start:end]
            (time_us,) = TIMESTAMP_FORMAT.unpack_from(content, time_start)
            if time_us > last_time_us:  # noqa: PLR1730 (max is slower)
                last_time_us = time_us
        elif number not in ignored_message_ids:
            break
        start = end
    parser._last_timestamp = last_time_us
    return start


def _skip_if_short(parse: Callable[..., Any]) -> Callable[..., Any]:
    """Decorate a message parser to raise ValueError for messages that are too short.

    After ValueError, pyulog skips the message. After struct.error, it stops.
    """

    def parse_or_raise_value_error(*arguments: Any, **keywords: Any) -> Any:
        try:
            return parse(*arguments, **keywords)
        except struct.error as error:
            raise ValueError(str(error)) from error

    return parse_or_raise_value_error


class _MessageData(ULog._MessageData):  # type: ignore[misc]  # pyulog has no types
    initialize = _skip_if_short(ULog._MessageData.initialize)


class _TolerantULogParser(ULog):  # type: ignore[misc]
    """ULog parser that continues after damaged bytes and limits the number of fields.

    In a malicious file, a few bytes can define millions of fields.
    """

    fields = 0
    _MessageData = _MessageData
    _MessageInfo = staticmethod(_skip_if_short(ULog._MessageInfo))
    _MessageParameterDefault = staticmethod(_skip_if_short(ULog._MessageParameterDefault))
    MessageDropout = staticmethod(_skip_if_short(ULog.MessageDropout))
    MessageLogging = staticmethod(_skip_if_short(ULog.MessageLogging))
    MessageLoggingTagged = staticmethod(_skip_if_short(ULog.MessageLoggingTagged))

    def _read_file_data(self, topic_names: Any, read_until: int | None = None) -> None:
        # If data were appended to the ULog, pyulog stops after it has read `read_until` bytes. It
        # does not count samples that _ULogContent reads, so it must then read the samples itself
        self._file_handle.parser = None if read_until else self
        super()._read_file_data(topic_names, read_until)

    def _check_packet_corruption(self, header: Any) -> bool:
        # pyulog accepts unknown message types, but valid types are capital letters
        is_corrupt: bool = super()._check_packet_corruption(header)
        if not ord("A") <= header.msg_type <= ord("Z"):
            self._file_corrupt = is_corrupt = True
        return is_corrupt

    @_skip_if_short
    def _MessageAddLogged(self, data: bytes, header: Any, formats: Any) -> Any:  # noqa: N802

        # Number of fields of a topic, including those of nested message types
        @cache
        def count_fields(name: str) -> int:
            fields: list[tuple[str, int, str]] = formats[name].fields
            return 1 + sum(
                max(size, 1) * (count_fields(kind) if kind in formats else 1)
                for kind, size, _ in fields
            )

        self.fields += count_fields(self.parse_string(data[3:]))
        if self.fields > MAX_FIELDS:
            raise ULogException(f"the topics have more than {MAX_FIELDS:,} fields in total")
        return ULog._MessageAddLogged(data, header, formats)


@dataclass(eq=False)  # not frozen: the readers add streams and counts
class Topics:
    """Decoded topics of a ULog, and a description of the log."""

    log: LogInfo
    tables: TopicTables
    # Boot time (µs) at flight time zero
    time_origin_us: int
    # All EKF2 parameters at take-off
    ekf2_parameters: Mapping[str, float]
    # True if the file ends within a message
    is_truncated: bool
    # True if pyulog skipped invalid bytes or messages
    is_damaged: bool
    # Changes of EKF2 parameters after take-off
    parameter_changes: tuple[ParameterChange, ...]
    # Topics and clock of each kind of data, such as "imu"
    data_source_by_data_kind: dict[str, DataSource] = field(default_factory=dict)
    # Number of samples with an invalid timestamp, by topic
    dropped: dict[str, int] = field(default_factory=dict)

    def instances(self, topic: str) -> list[int]:
        """Return the instance numbers of a topic, in ascending order."""
        return sorted(instance for name, instance in self.tables if name == topic)

    def tables_of(self, topic: str) -> list[TopicArrays]:
        """Return the tables of all instances of a topic, by ascending instance number."""
        return [self.tables[topic, number] for number in self.instances(topic)]

    def first_table(self, topic: str) -> TopicArrays:
        """Return the table of the lowest instance number; empty if the topic is not logged."""
        tables = self.tables_of(topic)
        return tables[0] if tables else {}

    @cached_property
    def primary_instances(self) -> InstanceSwitches:
        """Time (s) and number of each new primary EKF2 instance (PX4's ``EKF2Selector``)."""
        instances = self.read(TOPIC_LAYOUTS["estimator_selector_status"])["instance"]
        instances = instances[instances < 255]  # 255 means that no instance is selected yet
        changes = instances[instances.ne(instances.shift())].astype(int)
        if changes.empty:
            return NO_EKF2_INSTANCE_SWITCHES
        # The first instance counts as primary from the beginning of the log
        switch_times_s = [-np.inf, *changes.index[1:]]
        return tuple(zip(switch_times_s, changes.tolist(), strict=True))

    def find_layout(self, *layouts: MessageLayout) -> MessageLayout | None:
        """Return the first topic definition whose required fields are in the log, or None."""
        for layout in layouts:
            if any(
                {*layout.columns.values()} <= table.keys() for table in self.tables_of(layout.topic)
            ):
                return layout
        return None

    def read_instance(self, layout: MessageLayout, instance: int = 0) -> pd.DataFrame:
        """Read the fields of a topic instance as float64, indexed by measurement time (s).

        Parameters
        ----------
        instance : int
            Number of the topic instance; if not logged, the lowest number is read.

        Returns
        -------
        DataFrame
            Samples with strictly increasing times.
        """
        table = self.tables.get((layout.topic, instance)) or self.first_table(layout.topic)
        fields = {
            column: field_name
            for column, field_name in {**layout.columns, **layout.optional_columns}.items()
            if field_name in table
        }
        time_us = get_measurement_times_us(table)
        kept_rows = find_longest_increasing_subsequence(time_us)
        if len(kept_rows) < len(time_us):
            self.dropped[layout.topic] = len(time_us) - len(kept_rows)
        values = np.empty((len(fields), len(kept_rows)))
        with np.errstate(invalid="ignore"):  # damaged bytes can be signalling NaNs
            for row, (column, field_name) in zip(values, fields.items(), strict=True):
                field_values, scale = table[field_name][kept_rows], layout.scale.get(column, 1.0)
                np.multiply(field_values, scale, out=row, dtype=np.float64)
                row[~(np.abs(row) < MAX_FIELD_VALUE)] = np.nan  # damaged values
        index = time_index((time_us[kept_rows] - self.time_origin_us) * _MICROSECOND_S)
        samples = pd.DataFrame(values.T, index, list(fields), copy=False)
        if layout.is_step_function:
            return samples
        end_s = self.log.duration_s + MAX_SAMPLE_TIME_OUTSIDE_IMU_S
        return rows_between(samples, -MAX_SAMPLE_TIME_OUTSIDE_IMU_S, end_s)

    def read(self, *layouts: MessageLayout) -> pd.DataFrame:
        """Read a topic with the first of several definitions whose required fields are logged.

        Return an empty table if no definition fits.
        """
        layout = self.find_layout(*layouts)
        return _empty_frame(layouts[0]) if layout is None else self.read_instance(layout)

    def primary_samples(
        self,
        layout: MessageLayout,
        select_rows: Callable[[pd.DataFrame], pd.DataFrame] = lambda samples: samples,
    ) -> pd.DataFrame:
        """Read an EKF2 topic from the EKF2 instance that was primary at each time.

        ``select_rows`` is an optional function that selects rows from each instance's samples.
        """
        if self.find_layout(layout) is None:
            return _empty_frame(layout)
        if self.primary_instances == NO_EKF2_INSTANCE_SWITCHES:
            return select_rows(self.read_instance(layout))
        primary_instance_number = pd.Series(dict(self.primary_instances), dtype=np.float64)
        instance_tables: list[pd.DataFrame] = []
        for number in self.instances(layout.topic):
            samples = select_rows(self.read_instance(layout, number))
            is_primary = sample_step_function(primary_instance_number, samples.index) == number
            instance_tables.append(samples[is_primary])
        joined_tables = pd.concat(instance_tables).sort_index()
        return joined_tables[~joined_tables.index.duplicated()]

    def record_data_source(self, data_kind: str, *topics: str) -> None:
        """Store the origin of a kind of data, such as "imu", for the report.

        The origin is the names of the topics, and the clock of their timestamps.
        """
        # The timestamp of sensor_combined is the gyro's measurement time
        has_measurement_time = data_kind == "imu" or any(
            np.any(get_measurement_times_us(table) != table["timestamp"].astype(np.int64))
            for table in self.tables_of(topics[0])
        )
        timestamp_kind = "measurement" if has_measurement_time else "publication"
        clock = f"autopilot boot clock ({timestamp_kind} time)"
        self.data_source_by_data_kind[data_kind] = DataSource(topics, clock, self.log.name)


def _empty_frame(layout: MessageLayout) -> pd.DataFrame:
    return pd.DataFrame(
        columns=list(layout.columns), index=time_index(np.zeros(0)), dtype=np.float64
    )


def get_measurement_times_us(table: TopicArrays) -> NDArray[np.int64]:
    """Return the measurement time since boot (µs) of each sample: ``timestamp_sample``.

    If it is missing or invalid, return the publication time (``timestamp``). It is invalid in GPS
    topics before v1.16 (receiver time) and in ground truth of v1.13 (0).
    """
    published_us = table["timestamp"].astype(np.int64)
    sample_timestamps_us = table.get("timestamp_sample")
    if sample_timestamps_us is None:
        return published_us
    sample_timestamps_us = sample_timestamps_us.astype(np.int64)
    lag_s = np.abs(published_us - sample_timestamps_us) * _MICROSECOND_S
    # Publication times replace isolated invalid measurement times
    is_plausible = (sample_timestamps_us > 0) & (lag_s <= MAX_PUBLICATION_LAG_S)
    if np.count_nonzero(is_plausible) * 2 < len(is_plausible):
        return published_us
    return np.where(is_plausible, sample_timestamps_us, published_us)


def find_longest_increasing_subsequence(time_us: NDArray[np.int64]) -> IntArray:
    """Return the indices of the longest strictly increasing subsequence of positive timestamps.

    Do not use a running maximum: a single late timestamp would remove all samples after it.
    Method: patience sorting, Fredman 1975.
    """
    positive_time_indices = np.flatnonzero(time_us > 0)
    positive_times = time_us[positive_time_indices]
    if len(positive_times) < 2 or np.all(np.diff(positive_times) > 0):
        return positive_time_indices
    # At index k: smallest last timestamp of an increasing subsequence of k + 1 timestamps
    smallest_end_times: list[int] = []
    end_indices: list[int] = []
    previous_index = np.empty(len(positive_times), dtype=np.intp)
    for index, time in enumerate(positive_times.tolist()):
        length = bisect_left(smallest_end_times, time)
        previous_index[index] = end_indices[length - 1] if length else -1
        smallest_end_times[length : length + 1] = [time]
        end_indices[length : length + 1] = [index]
    reversed_subsequence_indices = []
    index = end_indices[-1]
    while index >= 0:
        reversed_subsequence_indices.append(index)
        index = int(previous_index[index])
    return positive_time_indices[np.array(reversed_subsequence_indices[::-1], dtype=np.intp)]


def describe_dropped_samples(dropped_counts: Mapping[str, int]) -> tuple[str, ...]:
    """Return one note per topic with the number of dropped samples."""
    return tuple(
        f"number of samples of {topic} dropped because of an invalid timestamp: {count}"
        for topic, count in dropped_counts.items()
    )


def read_topics(name: str, content: bytes) -> Topics:
    """Decode the topics of a ULog that px4fuse uses.

    Raises
    ------
    LogError
        The content is not a ULog, or contains no data with valid timestamps.
    """
    content_reader = _ULogContent(content)
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # suppress the warnings that pyulog prints
            ulog = _TolerantULogParser(content_reader, message_name_filter_list=list_topics())
            tables = _read_tables(ulog)
            # If the log contains no topic that px4fuse uses, read all topics: their times give the
            # duration of the log, and their names are reported
            known_or_all_topic_tables = tables or _read_tables(
                _TolerantULogParser(_ULogContent(content))
            )
    except Exception as error:  # pyulog raises many types for damaged bytes
        raise LogError(
            f"{name}: the ULog cannot be read ({str(error) or type(error).__name__}).",
            "Copy the .ulg from the vehicle again.",
        ) from error
    if not known_or_all_topic_tables:
        raise LogError(
            f"{name}: the ULog contains no samples",
            "Copy the file again, or set SDLOG_PROFILE to 129 (default and vision topics).",
        )
    info, notes = ulog.msg_info_dict, []
    if not tables:
        names = join_first_names(sorted({topic for topic, _ in known_or_all_topic_tables}), 5)
        notes.append(f"the log contains only topics that px4fuse does not use ({names})")
    if ULOG_NOTE_KEY in info:
        notes.append(_read_printable_text(info, ULOG_NOTE_KEY, ""))
    time_origin_us, data_end_us = _find_data_span_us(known_or_all_topic_tables, name)
    logged_values, parameter_changes = _read_parameters(ulog, tables, time_origin_us)
    parameter_values, invalid_parameter_notes = replace_invalid_parameters(logged_values)
    # pyulog stops at a message that is longer than the rest of the file. The log is truncated if it
    # ends within this message: after the start of its header, and before the end of its content
    last_header_offset = content_reader.header_start_offset
    is_truncated = last_header_offset < len(content) < content_reader.read_end_offset
    log = LogInfo(
        name=name,
        sha256=hashlib.sha256(content).hexdigest(),
        bytes=len(content),
        format="ULog",
        firmware=_format_firmware(info),
        firmware_hash=_read_printable_text(info, "ver_sw", "unknown"),
        hardware=_read_printable_text(info, "ver_hw", "unknown"),
        boot_time_s=time_origin_us * _MICROSECOND_S,
        duration_s=(data_end_us - time_origin_us) * _MICROSECOND_S,
        dropouts=tuple(
            Dropout((dropout.timestamp - time_origin_us) * _MICROSECOND_S, dropout.duration * 1e-3)
            for dropout in ulog.dropouts
        ),
        parameters={
            name: parameter_values[name]
            for name in PARAMETERS_IN_RESULTS
            if name in parameter_values
        },
        parameter_defaults={
            name: value
            for name, value in sorted(ulog.get_default_parameters(0).items())
            if name in MODEL_PARAMETERS
        },
        notes=(*notes, *invalid_parameter_notes),
        bytes_read=last_header_offset - content_reader.skipped_bytes,
        autopilot=_read_printable_text(info, "sys_name", "PX4"),
        vehicle=_read_printable_text(info, "sys_uuid", ""),
        is_assessed=True
        if ULOG_ASSIGNMENT_KEY in info and not shows_diagnosis_of_assignments.get()
        else UNSET,
    )
    return Topics(
        log,
        tables,
        time_origin_us,
        {name: value for name, value in parameter_values.items() if name.startswith("EKF2_")},
        is_truncated,
        ulog.file_corruption,
        parameter_changes,
    )


def _read_parameters(
    ulog: ULog, tables: TopicTables, time_origin_us: int
) -> tuple[dict[str, float], tuple[ParameterChange, ...]]:
    """Return the parameters at take-off, and later changes of EKF2 parameters."""
    land_detector, take_off_time_us = tables.get(("vehicle_land_detected", 0), {}), 0
    landed = land_detector.get("landed")
    if landed is not None and not landed.all():
        # Time of the first sample with landed = 0
        take_off_time_us = int(land_detector["timestamp"][landed.argmin()])
    values_at_take_off, last_values, changes = dict[str, float](), dict[str, float](), []
    time_us_and_parameters = [(0, *parameter) for parameter in ulog.initial_parameters.items()]
    time_us_and_parameters += sorted(ulog.changed_parameters, key=lambda change: change[0])
    for time_us, name, value in time_us_and_parameters:
        if not isinstance(value, int | float):
            continue
        # The first logged value of a parameter is also its value at take-off
        if time_us <= take_off_time_us or name not in last_values:
            values_at_take_off[name] = float(value)
        elif name.startswith("EKF2_") and value != last_values[name]:
            time_s = (time_us - time_origin_us) * _MICROSECOND_S
            changes.append(ParameterChange(time_s, name, last_values[name], float(value)))
        last_values[name] = float(value)
    return values_at_take_off, tuple(changes)


def _read_tables(ulog: ULog) -> TopicTables:
    """Return the samples of each topic instance. Two subscriptions to one instance are merged."""
    tables: TopicTables = {}
    for subscription in ulog.data_list:
        table: TopicArrays = subscription.data
        if "timestamp" not in table:
            continue
        key = (subscription.name, subscription.multi_id)
        if other_table := tables.get(key):
            table = {
                name: np.concatenate([values, table[name]])
                for name, values in other_table.items()
                if name in table
            }
            time_order = np.argsort(table["timestamp"], kind="stable")
            table = {name: values[time_order] for name, values in table.items()}
        tables[key] = table
    return tables


def _find_data_span_us(tables: TopicTables, name: str) -> tuple[int, int]:
    """Return the first and last time (µs) of the IMU data; ``name`` is the file name for the error.

    If the log contains no IMU data, the topic with the most samples is used.
    """
    for key in sorted(
        tables, key=lambda key: (key[0] != IMU_LAYOUT.topic, -len(tables[key]["timestamp"]))
    ):
        time_us = tables[key]["timestamp"].astype(np.int64)
        increasing_times_us = time_us[find_longest_increasing_subsequence(time_us)]
        if len(increasing_times_us):
            # Use the longest part without a gap, because invalid timestamps may be hours away
            gap_rows = (
                np.flatnonzero(np.diff(increasing_times_us) > MAX_DATA_GAP_S / _MICROSECOND_S) + 1
            )
            longest_gap_free_times_us = max(np.split(increasing_times_us, gap_rows), key=len)
            return int(longest_gap_free_times_us[0]), int(longest_gap_free_times_us[-1])
    raise LogError(f"{name}: all timestamps are zero", "Record the flight again.")


def _read_printable_text(info: dict[str, Any], key: str, default: str) -> str:
    return (
        "".join(character for character in str(info.get(key, default)) if character.isprintable())
        or default
    )


def _format_firmware(info: dict[str, Any]) -> str:
    """Return name and version of the firmware, for example "PX4 v1.14.0-beta"."""
    release = info.get("ver_sw_release")
    if not isinstance(release, int):
        return "unknown"
    major, minor, patch, release_type = (release & 0xFFFFFFFF).to_bytes(4, "big")
    if (major, minor, patch) == (0, 0, 0):
        return "PX4 development version"
    # The last byte is 0 (development), 64 (alpha), 128 (beta), 192 (candidate) or 255 (release)
    suffix = ("-dev", "-alpha", "-beta", "-rc", "")[(release_type + 1) // 64]
    return f"{_read_printable_text(info, 'sys_name', 'PX4')} v{major}.{minor}.{patch}{suffix}"
