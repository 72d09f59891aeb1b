"""Topic tables of a ULog file with valid timestamps; the only module that uses pyulog.

pyulog parses the file. This module removes invalid samples: real logs contain timestamps that are
zero, go back or jump by hours, and topics with two subscriptions.
"""

import contextlib
import hashlib
import io
import struct
from bisect import bisect_left
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache, cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pyulog import ULog
from pyulog.exceptions import ULogException

from px4fuse.arrays import IntArray
from px4fuse.ekf2_parameters import REPORTED, replace_invalid_parameters
from px4fuse.errors import LogError
from px4fuse.log import Dropout, LogInfo, Stream
from px4fuse.readers.field_maps import IMPOSSIBLE, Layout
from px4fuse.readers.px4_topics import IMU, LAYOUTS, topics
from px4fuse.text import join_first

_MICROSECOND = 1e-6
# s; a measurement time further than this from publication is not boot time (GPS topics before
# v1.16 have receiver time, ground truth in v1.13 has 0)
MAX_PUBLICATION_LAG_S = 10.0
# s; samples this far outside the data span are left over from before
WINDOW_MARGIN_S = 2.0
RELEASE = 255
# Info message with a note of the log's author to its users
NOTE_KEY = "px4fuse_note"
# s; after a longer gap of the IMU timestamps the samples are from another boot
MAX_DATA_GAP_S = 600.0
# Limit on the fields of all subscriptions, 300 bytes of memory each; real logs have up to 3,300
MAX_FIELDS = 200_000
HEADER_BYTES = 3
# Exceptions that pyulog may raise when it parses damaged bytes as messages
_PARSE_ERRORS = (
    ULogException,
    struct.error,
    IndexError,
    KeyError,
    ValueError,
    TypeError,
    AttributeError,
    OverflowError,
    UnicodeError,
    EOFError,
    MemoryError,
    AssertionError,
    RecursionError,
)


# (start time in s, primary EKF2 instance from then on)
Instances = tuple[tuple[float, int], ...]
# Without the selector topic there is one EKF2 instance
NO_SELECTOR: Instances = ((-np.inf, 0),)


class _Content(io.BytesIO):
    """Content of a ULog; counts the bytes that pyulog skips.

    pyulog reads a header of 3 bytes, then the message. After an invalid header it advances by one
    byte, or to the next synchronisation message.

    Attributes
    ----------
    skipped_bytes : int
    start, end, position : int
        Offsets of the last header, of the end of the last read, and of the next read. The last two
        may be after the end of the file.
    """

    skipped_bytes = start = end = position = 0

    def read(self, size: int, /) -> bytes:  # type: ignore[override]  # pyulog gives a size
        at = self.position
        if size == HEADER_BYTES:
            if at != self.end:
                self.skipped_bytes += at - self.start
            self.start = at
        self.end = self.position = at + size
        return io.BytesIO.read(self, size)

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        # pyulog moves back by the requested length, which may exceed the rest of a damaged file.
        # The virtual position prevents an endless loop
        if whence == io.SEEK_CUR:
            offset += self.position
        self.position = super().seek(offset)
        return self.position


def _skip_if_short(read: Callable[..., Any]) -> Callable[..., Any]:
    """Decorate a parser to raise ValueError instead of struct.error for short messages.

    pyulog skips a message after ValueError, but stops reading the file after struct.error.
    """

    def checked(*arguments: Any, **named: Any) -> Any:
        try:
            return read(*arguments, **named)
        except struct.error as error:
            raise ValueError(str(error)) from error

    return checked


class _MessageData(ULog._MessageData):  # type: ignore[misc]  # pyulog has no types
    initialize = _skip_if_short(ULog._MessageData.initialize)


class _Reader(ULog):  # type: ignore[misc]
    """pyulog reader with better recovery from damage and a limit on the number of fields.

    A format of 20 bytes can declare 65,535 fields, and nested formats multiply the number.
    """

    fields = 0
    _MessageData = _MessageData
    _MessageInfo = staticmethod(_skip_if_short(ULog._MessageInfo))
    _MessageParameterDefault = staticmethod(_skip_if_short(ULog._MessageParameterDefault))
    MessageDropout = staticmethod(_skip_if_short(ULog.MessageDropout))
    MessageLogging = staticmethod(_skip_if_short(ULog.MessageLogging))
    MessageLoggingTagged = staticmethod(_skip_if_short(ULog.MessageLoggingTagged))

    def _check_packet_corruption(self, header: Any) -> bool:
        # pyulog accepts unknown types up to 10,000 bytes; valid types are capital letters
        is_corrupt: bool = super()._check_packet_corruption(header)
        if not ord("A") <= header.msg_type <= ord("Z"):
            self._file_corrupt = is_corrupt = True
        return is_corrupt

    @_skip_if_short
    def _MessageAddLogged(self, data: bytes, header: Any, formats: Any) -> Any:  # noqa: N802
        @cache
        def count(name: str) -> int:
            fields: list[tuple[str, int, str]] = formats[name].fields
            return 1 + sum(
                max(size, 1) * (count(kind) if kind in formats else 1) for kind, size, _ in fields
            )

        self.fields += count(self.parse_string(data[3:]))
        if self.fields > MAX_FIELDS:
            raise ULogException(f"its topics have more than {MAX_FIELDS:,} fields")
        return ULog._MessageAddLogged(data, header, formats)


@dataclass(frozen=True)
class Topics:
    """Decoded topics of one log.

    Attributes
    ----------
    log : LogInfo
        Log description, without notes on single topics (see :attr:`dropped`).
    tables : mapping from (topic, instance) to mapping from PX4 field name to array
    zero_us : int
        Boot time of time zero in µs.
    dropped : dict
        Samples dropped because of an invalid timestamp, by topic and instance; filled by
        :meth:`frame`.
    ekf2_parameters : mapping
        All EKF2_ parameters by PX4 name; ``log`` contains only those used in results.
    is_cut : bool
        True if the file ends within a message.
    is_damaged : bool
        True if pyulog skipped invalid bytes or messages.
    streams : dict
        Source of each part of the flight; filled by :meth:`record_stream`.
    """

    log: LogInfo
    tables: dict[tuple[str, int], dict[str, NDArray[Any]]]
    zero_us: int
    dropped: dict[tuple[str, int], int]
    ekf2_parameters: Mapping[str, float]
    is_cut: bool
    is_damaged: bool
    streams: dict[str, Stream] = field(default_factory=dict)

    def instances(self, topic: str) -> list[int]:
        """Return the sorted instance numbers of a topic with data."""
        return sorted(instance for name, instance in self.tables if name == topic)

    def of(self, topic: str) -> list[dict[str, NDArray[Any]]]:
        """Return the tables of a topic's instances, in order."""
        return [self.tables[topic, number] for number in self.instances(topic)]

    @cached_property
    def primary(self) -> Instances:
        """Primary EKF2 instance from each time on (``EKF2Selector.cpp``)."""
        selected = self.read(LAYOUTS["selector"], step=True)["instance"]
        selected = selected[selected < 255]  # 255: none selected yet
        if selected.empty:
            return NO_SELECTOR
        changes = selected[selected.ne(selected.shift())]
        times = [-np.inf, *changes.index[1:]]
        return tuple((float(at), int(number)) for at, number in zip(times, changes, strict=True))

    def find(self, *layouts: Layout) -> Layout | None:
        """Return the first layout whose fields are in the log, or None."""
        for layout in layouts:
            if any({*layout.columns.values()} <= table.keys() for table in self.of(layout.topic)):
                return layout
        return None

    def frame(self, layout: Layout, instance: int = 0, *, step: bool = False) -> pd.DataFrame:
        """Read one layout as a frame of float64 columns, indexed by measurement time in s.

        Parameters
        ----------
        layout : Layout
            A layout that :meth:`find` returned.
        instance : int
            Topic instance; if it does not exist, the lowest one is read.
        step : bool
            True for a step function, in which samples before time zero remain valid.

        Returns
        -------
        DataFrame
            Strictly increasing in time; may be empty.
        """
        available = self.instances(layout.topic)
        table = self.tables[layout.topic, instance if instance in available else available[0]]
        optional = {
            column: field_name
            for column, field_name in layout.optional.items()
            if field_name in table
        }
        columns = {**layout.columns, **optional}
        time_us = measurement_time_us(table)
        keep = longest_increasing_run(time_us)
        if len(keep) < len(time_us):
            self.dropped[layout.topic, instance] = len(time_us) - len(keep)
        with np.errstate(invalid="ignore"):  # damaged bytes can be signalling NaNs
            frame = pd.DataFrame(
                {
                    column: table[field_name][keep].astype(np.float64)
                    * layout.scale.get(column, 1.0)
                    for column, field_name in columns.items()
                },
                index=pd.Index((time_us[keep] - self.zero_us) * _MICROSECOND, name="time_s"),
            )
        frame = frame.where(np.abs(frame) < IMPOSSIBLE)  # damaged values become NaN
        end = self.log.duration_s + WINDOW_MARGIN_S
        return frame if step else frame[(frame.index >= -WINDOW_MARGIN_S) & (frame.index <= end)]

    def read(self, *layouts: Layout, step: bool = False) -> pd.DataFrame:
        """Read the first layout in the log as in :meth:`frame`; empty if none is."""
        layout = self.find(*layouts)
        return _empty_frame(layouts[0]) if layout is None else self.frame(layout, step=step)

    def primary_samples(
        self,
        layout: Layout,
        *,
        step: bool = False,
        select: Callable[[pd.DataFrame], pd.DataFrame] | None = None,
    ) -> pd.DataFrame:
        """Read an EKF2 topic from the instance that was primary at each time.

        The frame is empty if the layout is not in the log.

        Parameters
        ----------
        layout, step
            As in :meth:`frame`.
        select : callable, optional
            Filter for the rows of each instance; by default all rows are used.
        """
        if self.find(layout) is None:
            return _empty_frame(layout)
        available = self.instances(layout.topic)
        is_single = self.primary == NO_SELECTOR
        starts, numbers = (np.array(part) for part in zip(*self.primary, strict=True))
        primary_frames: list[pd.DataFrame] = []
        for number in available[:1] if is_single else available:
            frame = self.frame(layout, number, step=step)
            frame = frame if select is None else select(frame)
            at = np.searchsorted(starts, frame.index.to_numpy(), side="right") - 1
            primary_frames.append(frame if is_single else frame[numbers[at] == number])
        joined_frames = pd.concat(primary_frames).sort_index()
        return joined_frames[~joined_frames.index.duplicated()]

    def record_stream(self, part: str, *topics: str) -> None:
        """Record the source of a part of the flight, with measurement or publication time."""
        # The timestamp of sensor_combined is the gyro's measurement time
        measured = part == "imu" or any(
            np.any(measurement_time_us(table) != table["timestamp"].astype(np.int64))
            for table in self.of(topics[0])
        )
        clock = f"autopilot boot clock, at {'measurement' if measured else 'publication'}"
        self.streams[part] = Stream(topics, clock, self.log.name)


def _empty_frame(layout: Layout) -> pd.DataFrame:
    """Return an empty frame with the columns of a layout."""
    times = pd.Index([], dtype=np.float64, name="time_s")
    return pd.DataFrame(columns=list(layout.columns), index=times, dtype=np.float64)


def measurement_time_us(table: dict[str, NDArray[Any]]) -> NDArray[np.int64]:
    """Return the measurement time (µs): ``timestamp_sample`` if it is boot time.

    Otherwise it is the publication time, ``timestamp``, which is up to 0.2 s later in EKF2 topics.
    """
    published = table["timestamp"].astype(np.int64)
    sampled = table.get("timestamp_sample")
    if sampled is None:
        return published
    sampled = sampled.astype(np.int64)
    lag_s = np.abs(published - sampled) * _MICROSECOND
    # Single invalid measurement times, such as in the first message, are replaced by publication
    plausible = (sampled > 0) & (lag_s <= MAX_PUBLICATION_LAG_S)
    if np.count_nonzero(plausible) * 2 < len(plausible):
        return published
    return np.where(plausible, sampled, published)


def longest_increasing_run(time_us: NDArray[np.int64]) -> IntArray:
    """Return the indices of the longest strictly increasing subsequence of positive timestamps.

    A timestamp hours ahead then costs one sample, while a running maximum would drop all later
    ones. Patience sorting, Fredman 1975.
    """
    indices = np.flatnonzero(time_us > 0)
    stamps = time_us[indices]
    if len(stamps) < 2 or np.all(np.diff(stamps) > 0):
        return indices
    tails: list[int] = []  # smallest last timestamp of an increasing subsequence of each length
    tail_at: list[int] = []  # index of that timestamp
    previous = np.empty(len(stamps), dtype=np.intp)
    for at, stamp in enumerate(stamps.tolist()):
        length = bisect_left(tails, stamp)
        previous[at] = tail_at[length - 1] if length else -1
        tails[length : length + 1] = [stamp]
        tail_at[length : length + 1] = [at]
    run = []
    at = tail_at[-1]
    while at >= 0:
        run.append(at)
        at = int(previous[at])
    return indices[np.array(run[::-1], dtype=np.intp)]


def dropped_note(count: int, name: str, why: str) -> str:
    """Format the note on samples that were dropped because of invalid timestamps.

    >>> dropped_note(1, "ATTITUDE", "zero")
    '1 sample of ATTITUDE was dropped: its timestamp is zero'
    """
    if count == 1:
        why = why.replace("go back", "goes back").replace("are outside", "is outside")
        return f"1 sample of {name} was dropped: its timestamp is {why}"
    return f"{count} samples of {name} were dropped: their timestamps are {why}"


def read_topics(name: str, content: bytes) -> Topics:
    """Decode the topics of a ULog that px4fuse uses.

    Raises
    ------
    LogError
        The content is not a ULog, or contains no data with valid timestamps.
    """
    source, size = _Content(content), len(content)
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # pyulog prints its warnings
            ulog = _Reader(source, message_name_filter_list=topics())
            tables = _tables(ulog)
            # Without topics that px4fuse uses, all other topics give the duration of the log
            time_tables = tables or _tables(_Reader(_Content(content)))
    except _PARSE_ERRORS as error:
        raise LogError(
            f"{name}: the ULog cannot be read ({str(error) or type(error).__name__}).",
            "Copy the .ulg from the vehicle again.",
        ) from error
    notes: tuple[str, ...] = ()
    if not time_tables:
        raise LogError(
            f"{name}: this ULog contains no data (no IMU, no position, no EKF2)",
            "If it was cut off, copy it again. Otherwise record with SDLOG_PROFILE 129.",
        )
    if not tables:
        names = sorted({topic for topic, _ in time_tables})
        notes += (f"px4fuse uses none of the topics in this log ({join_first(names, 5)})",)
    if NOTE_KEY in ulog.msg_info_dict:
        notes += (_text(ulog.msg_info_dict, NOTE_KEY, ""),)
    zero_us, end_us = _data_span(time_tables, name)
    parameter_items = ulog.initial_parameters.items()
    numbers = {name: float(v) for name, v in parameter_items if isinstance(v, int | float)}
    parameter_values, faults = replace_invalid_parameters(numbers)
    log = LogInfo(
        name=name,
        sha256=hashlib.sha256(content).hexdigest(),
        bytes=size,
        format="ULog",
        firmware=_firmware(ulog.msg_info_dict),
        firmware_hash=_text(ulog.msg_info_dict, "ver_sw", "unknown"),
        hardware=_text(ulog.msg_info_dict, "ver_hw", "unknown"),
        boot_time_s=zero_us * _MICROSECOND,
        duration_s=(end_us - zero_us) * _MICROSECOND,
        dropouts=tuple(
            Dropout((d.timestamp - zero_us) * _MICROSECOND, d.duration * 1e-3)
            for d in ulog.dropouts
        ),
        parameters=MappingProxyType(
            {name: parameter_values[name] for name in REPORTED if name in parameter_values}
        ),
        notes=(*notes, *faults),
        bytes_read=source.start - source.skipped_bytes,
        autopilot=_text(ulog.msg_info_dict, "sys_name", "PX4"),
        vehicle=_text(ulog.msg_info_dict, "sys_uuid", ""),
    )
    parameters = {
        name: value for name, value in parameter_values.items() if name.startswith("EKF2_")
    }
    is_cut = source.start < size < source.end
    return Topics(
        log, tables, zero_us, {}, MappingProxyType(parameters), is_cut, ulog.file_corruption
    )


def _tables(ulog: ULog) -> dict[tuple[str, int], dict[str, NDArray[Any]]]:
    """Return the topic tables; two subscriptions to a topic are joined on their common fields."""
    tables: dict[tuple[str, int], dict[str, NDArray[Any]]] = {}
    for data in ulog.data_list:
        if "timestamp" not in data.data:
            continue
        key = (data.name, data.multi_id)
        table = {name: np.asarray(values) for name, values in data.data.items()}
        if key in tables:
            first = tables[key]
            table = {one: np.concatenate([first[one], table[one]]) for one in first if one in table}
            order = np.argsort(table["timestamp"], kind="stable")
            table = {name: values[order] for name, values in table.items()}
        tables[key] = table
    return tables


def _data_span(
    tables: dict[tuple[str, int], dict[str, NDArray[Any]]], name: str
) -> tuple[int, int]:
    """Return the first and last time (µs) of the IMU, or else of the topic with most samples."""
    for key in sorted(tables, key=lambda of: (of[0] != IMU.topic, -len(tables[of]["timestamp"]))):
        time_us = tables[key]["timestamp"].astype(np.int64)
        increasing_us = time_us[longest_increasing_run(time_us)]
        if len(increasing_us):
            # Timestamps hours away from the others are leftovers, so the longest interval is used
            breaks = np.flatnonzero(np.diff(increasing_us) > MAX_DATA_GAP_S / _MICROSECOND) + 1
            stretch = max(np.split(increasing_us, breaks), key=len)
            return int(stretch[0]), int(stretch[-1])
    raise LogError(
        f"{name}: all timestamps are zero, so the data have no time",
        "The logger started before the clock. Record again.",
    )


def _text(info: dict[str, Any], key: str, otherwise: str) -> str:
    """Return a text from the log without control characters, which could affect a terminal."""
    text = str(info.get(key, otherwise))
    return "".join(c for c in text if c.isprintable()) or otherwise


def _firmware(info: dict[str, Any]) -> str:
    release = info.get("ver_sw_release")
    if not isinstance(release, int):
        return "unknown"
    major, minor, patch, kind = (release & 0xFFFFFFFF).to_bytes(4, "big")
    if (major, minor, patch) == (0, 0, 0):
        return "PX4 development version"
    # last byte: 0 development, 64 alpha, 128 beta, 192 release candidate, 255 release
    suffix = "" if kind == RELEASE else ("-dev", "-alpha", "-beta", "-rc")[kind // 64]
    return f"{_text(info, 'sys_name', 'PX4')} v{major}.{minor}.{patch}{suffix}"
