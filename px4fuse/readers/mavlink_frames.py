"""MAVLink wire format: bytes to frames, and frames to columns.

Every byte position at which a frame of a known message could begin is verified by the checksum.
Invalid bytes and incomplete frames are skipped and counted, without loss of valid frames. All
frames of one message type are decoded at once with the field tables of pymavlink's dialect.

Sources: MAVLink developer guide, "Packet Serialization"; pymavlink's generated dialects.
"""

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from fastcrc.crc16 import mcrf4xx  # CRC-16/MCRF4XX is MAVLink's X.25 checksum
from numpy.typing import NDArray
from pymavlink.dialects.v20 import all as dialect

from px4fuse.arrays import BoolArray, IntArray
from px4fuse.errors import LogError

Integers = NDArray[np.int64]
# (MAVLink system id, MAVLink component id)
Address = tuple[int, int]

MAGIC_1, MAGIC_2 = 0xFE, 0xFD
HEADER_1, HEADER_2 = 6, 10
CHECKSUM = 2
SIGNATURE = 13
SIGNED = 0x01
LONGEST_FRAME = HEADER_2 + 255 + CHECKSUM + SIGNATURE
# Receive time that QGroundControl and MAVProxy write before each frame: µs, big-endian
STAMP_BYTES = 8
# Bytes scanned at once; limits the memory for malicious files
BLOCK_BYTES = 1 << 16
# Frames decoded at once; limits the memory
FRAMES_PER_PIECE = 1 << 12
# Fraction of bytes in valid frames, below which a file is not a MAVLink recording. Random bytes
# contain one valid frame in about eight million.
MIN_GOOD_SHARE = 0.01
# µs; a receive time further than this from the median is damaged (limit of pymavlink)
MAX_STAMP_DISTANCE_US = 3 * 24 * 3600 * 1_000_000
MESSAGE_IDS: Mapping[str, int] = {one.msgname: at for at, one in dialect.mavlink_map.items()}
# CRC_EXTRA byte by message id, the last input of the checksum; -1 for unknown messages
_SEEDS = np.full(max(1 << 16, *(number + 1 for number in dialect.mavlink_map)), -1, dtype=np.int16)
_SEEDS[[*dialect.mavlink_map]] = [message.crc_extra for message in dialect.mavlink_map.values()]
# Checksum of each single byte, for the last step of the checksum with CRC_EXTRA
_LAST = np.array([mcrf4xx(bytes([byte]), 0) for byte in range(256)], dtype=np.uint16)


@dataclass(frozen=True)
class Frames:
    """Frames of one recording with valid checksums, in file order.

    Attributes
    ----------
    name : str
        File name.
    content : bytes
    sha256 : str
    start : ndarray of int64, shape (n,)
        Offset of each frame's first byte.
    message_id : ndarray of int32, shape (n,)
    system, component, sequence : ndarray of uint8, shape (n,)
    payload_start : ndarray of int64, shape (n,)
    payload_length : ndarray of uint8, shape (n,)
    received_us : ndarray of int64, shape (n,), or None
        Receive time (UNIX, µs), with damaged ones interpolated; None for a raw stream.
    unknown_frame_count : int
        Complete frames of messages that are not in the dialect.
    bad_bytes : int
        Bytes that are not part of a frame.
    in_frame : bool
        True if the file ends within a frame.
    bad_stamps : int
        Damaged receive times.
    """

    name: str
    content: bytes
    sha256: str
    start: Integers
    message_id: NDArray[np.int32]
    system: NDArray[np.uint8]
    component: NDArray[np.uint8]
    sequence: NDArray[np.uint8]
    payload_start: Integers
    payload_length: NDArray[np.uint8]
    received_us: Integers | None
    unknown_frame_count: int
    bad_bytes: int
    in_frame: bool
    bad_stamps: int

    def __len__(self) -> int:
        return len(self.start)

    def rows(self, message: str) -> IntArray:
        """Return the indices of the frames of one message, given its MAVLink name."""
        return np.flatnonzero(self.message_id == MESSAGE_IDS[message])

    def sent_by(self, address: Address, rows: IntArray | slice = slice(None)) -> BoolArray:
        """Return a mask of the frames (all by default) from one system and component."""
        system, component = address
        return np.asarray((self.system[rows] == system) & (self.component[rows] == component))

    def table(self, message: str, rows: IntArray) -> NDArray[Any]:
        """Decode frames of one message.

        Parameters
        ----------
        message : str
            MAVLink name, for example "ATTITUDE".
        rows : ndarray, shape (n,)
            Frame indices from :meth:`rows`.

        Returns
        -------
        structured ndarray, shape (n,)
            One field per MAVLink field, in MAVLink units. The trailing zeros that MAVLink 2 omits
            from the payload are restored.
        """
        layout = wire_layout(MESSAGE_IDS[message])
        payload = np.zeros((len(rows), layout.itemsize), dtype=np.uint8)
        source = np.frombuffer(self.content, dtype=np.uint8)
        starts, lengths = self.payload_start[rows], self.payload_length[rows]
        for length in np.unique(lengths).tolist():
            size = min(length, layout.itemsize)
            if size:
                rows_of_length = np.flatnonzero(lengths == length)
                windows = np.lib.stride_tricks.sliding_window_view(source, size)
                # Indexing copies the payloads, so the number of frames per step is limited
                for at in range(0, len(rows_of_length), FRAMES_PER_PIECE):
                    piece_rows = rows_of_length[at : at + FRAMES_PER_PIECE]
                    payload[piece_rows, :size] = windows[starts[piece_rows]]
        return payload.view(layout)[:, 0]


def message_name(number: int) -> str:
    """Return the MAVLink name of a message id."""
    return str(dialect.mavlink_map[number].msgname)


@cache
def wire_layout(number: int) -> np.dtype[Any]:
    """Return the payload layout of a message id as a packed structured dtype."""
    message = dialect.mavlink_map[number]
    kinds = message.native_format.decode().removeprefix("<")  # struct codes, same as in numpy
    fields: list[Any] = []
    for name, kind, length in zip(
        message.ordered_fieldnames, kinds, message.array_lengths, strict=True
    ):
        if kind == "c":
            fields.append((name, f"S{length or 1}"))
        else:
            fields.append((name, f"<{kind}", (length,)) if length else (name, f"<{kind}"))
    return np.dtype(fields)


def read_frames(name: str, content: bytes) -> Frames:
    """Find all frames with valid checksums in a recording.

    Parameters
    ----------
    name : str
        File name for error messages.
    content : bytes
        A ``.tlog`` with receive times, or a raw stream of MAVLink 1 and 2.

    Raises
    ------
    LogError
        The content is not MAVLink.
    """
    start, end, number = _remove_overlapping(_scan(content)).T
    stamp = STAMP_BYTES if len(start) and _has_receive_stamps(start, end) else 0
    good_bytes = int(np.sum(end - start))
    if good_bytes < MIN_GOOD_SHARE * len(content) or not len(start):
        raise LogError(
            f"{name}: neither a PX4 ULog nor a MAVLink recording ({len(start)} frames "
            f"with a valid checksum in {len(content)} bytes).",
            "Give the .ulg from the vehicle, or a .tlog or raw MAVLink stream.",
        )
    source = np.frombuffer(content, dtype=np.uint8)
    is_version_2 = source[start] == MAGIC_2
    # Header order: sequence, system, component
    at = start + np.where(is_version_2, 4, 2)
    unknown_frame_count, bad_bytes, in_frame = _count_other_bytes(
        content, start - stamp, end, stamp
    )
    received, bad_stamps = _stamps(source, start, end) if stamp else (None, 0)
    return Frames(
        name=name,
        content=content,
        sha256=hashlib.sha256(content).hexdigest(),
        start=start,
        message_id=number.astype(np.int32),
        system=source[at + 1],
        component=source[at + 2],
        sequence=source[at],
        payload_start=start + np.where(is_version_2, HEADER_2, HEADER_1),
        payload_length=source[start + 1],
        received_us=received,
        unknown_frame_count=unknown_frame_count,
        bad_bytes=bad_bytes,
        in_frame=in_frame,
        bad_stamps=bad_stamps,
    )


def _scan(content: bytes) -> Integers:
    """Return start, end and message id, shape (n, 3), of all valid frames; they may overlap."""
    source, view = np.frombuffer(content, dtype=np.uint8), memoryview(content)
    found = [np.zeros((0, 3), dtype=np.int64)]
    for low in range(0, len(source), BLOCK_BYTES):
        frames, crc_end = _candidates(source, low)
        bodies = zip((frames[:, 0] + 1).tolist(), crc_end.tolist(), strict=True)
        crc = np.array([mcrf4xx(view[a:b]) for a, b in bodies], dtype=np.uint16)
        crc = (crc >> 8) ^ _LAST[(crc ^ _SEEDS[frames[:, 2]].astype(np.uint16)) & 0xFF]
        stored = source[crc_end] | source[crc_end + 1].astype(np.uint16) << 8
        found.append(frames[stored == crc])
    return np.concatenate(found)


def _remove_overlapping(frames: Integers) -> Integers:
    """Remove frames that begin inside the previous frame.

    The payload of one frame may contain another frame (TUNNEL). A receive time can look like the
    beginning of a frame; it must not hide the frame after it.
    """
    if not np.any(frames[1:, 0] < frames[:-1, 1]):
        return frames
    start, end = frames[:, 0].tolist(), frames[:, 1].tolist()
    keep, end_reached, starts = [], 0, {*start}
    for row, begin in enumerate(start):
        next_starts = end_reached, end_reached + STAMP_BYTES
        if begin >= end_reached and (begin in next_starts or starts.isdisjoint(next_starts)):
            keep.append(row)
            end_reached = end[row]
    return frames[keep]


def _candidates(source: NDArray[np.uint8], low: int) -> tuple[Integers, Integers]:
    """Return possible frames in one block (as in :func:`_scan`) and their checksum offsets."""
    block = source[low : low + BLOCK_BYTES]
    start = np.flatnonzero((block == MAGIC_1) | (block == MAGIC_2)).astype(np.int64) + low
    header = np.where(source[start] == MAGIC_2, HEADER_2, HEADER_1)
    has_whole_header = start + header + CHECKSUM <= len(source)
    start, header = start[has_whole_header], header[has_whole_header]
    is_version_2 = header == HEADER_2
    at = start[is_version_2]
    number = source[start + 5].astype(np.int64)
    number[is_version_2] = source[at + 7] | source[at + 8].astype(np.int64) << 8
    is_known = _SEEDS[number] >= 0
    is_known[is_version_2] &= (source[at + 9] == 0) & (source[at + 2] <= SIGNED)
    crc_end = start + source[start + 1] + header
    end = crc_end + CHECKSUM
    end[is_version_2] += SIGNATURE * (source[at + 2] & SIGNED).astype(np.int64)
    is_known &= end <= len(source)
    return np.stack([start, end, number], axis=1)[is_known], crc_end[is_known]


def _has_receive_stamps(start: Integers, end: Integers) -> bool:
    """Return True if most frames are separated by the eight bytes of a receive time."""
    gap_bytes = start[1:] - end[:-1]
    stamped_count, bare_count = (
        np.count_nonzero(gap_bytes == STAMP_BYTES),
        np.count_nonzero(gap_bytes == 0),
    )
    return (
        bool(stamped_count > bare_count)
        if stamped_count + bare_count
        else bool(start[0] == STAMP_BYTES)
    )


def _count_other_bytes(
    content: bytes, start: Integers, end: Integers, stamp: int
) -> tuple[int, int, bool]:
    """Count the content between valid frames; ``start`` includes the receive time.

    Returns
    -------
    int
        Complete frames of messages that are not in the dialect.
    int
        Bytes that are not part of a frame.
    bool
        True if the last of these bytes are the beginning of a frame.
    """
    unknown_frame_count, bad, rest = 0, 0, b""
    lows, highs = np.append(0, end), np.append(start, len(content))
    for low, high in np.column_stack([lows, highs])[lows < highs].tolist():
        at = low
        for size in _unknown_frames(content, low, high, stamp):
            unknown_frame_count += 1
            at += size
        bad += high - at
        rest = content[at:high] if high == len(content) else b""
    begins_frame = rest[stamp : stamp + 1] in (b"", bytes([MAGIC_1]), bytes([MAGIC_2]))
    return unknown_frame_count, bad, 0 < len(rest) < stamp + LONGEST_FRAME and begins_frame


def _unknown_frames(content: bytes, at: int, high: int, stamp: int) -> Iterator[int]:
    """Yield the sizes (bytes) of consecutive frames of unknown messages, from their headers."""
    while at + stamp + HEADER_1 + CHECKSUM <= high:
        head = content[at + stamp : at + stamp + HEADER_2]
        number, size = head[5], stamp + head[1] + HEADER_1 + CHECKSUM
        if head[0] == MAGIC_2:
            number = int.from_bytes(head[7:10], "little")
            size += HEADER_2 - HEADER_1 + SIGNATURE * (head[2] & SIGNED)
        at += size
        if head[0] not in (MAGIC_1, MAGIC_2) or number in dialect.mavlink_map or at > high:
            return
        yield size


def _stamps(source: NDArray[np.uint8], start: Integers, end: Integers) -> tuple[Integers, int]:
    """Return the receive times (UNIX, µs) and the number of damaged ones."""
    usable = start >= STAMP_BYTES
    usable[1:] &= start[1:] - end[:-1] >= STAMP_BYTES
    windows = np.lib.stride_tricks.sliding_window_view(source, STAMP_BYTES)
    # The first frame may have no receive time before it
    stamp = np.ascontiguousarray(windows[np.maximum(start - STAMP_BYTES, 0)]).view(">u8")[:, 0]
    received = stamp.astype(np.int64)  # values above 1 << 63 become negative
    usable &= (received >= 0) & (received < 1 << 62)
    middle = int(np.median(received[usable])) if np.any(usable) else 0
    usable &= np.abs(received - middle) <= MAX_STAMP_DISTANCE_US
    received = np.where(usable, received, 0)
    if np.any(usable):
        rows = np.flatnonzero(usable)
        # Relative to the first receive time, so that float64 resolves microseconds
        steps = np.interp(np.arange(len(start)), rows, received[rows] - received[rows[0]])
        received = received[rows[0]] + np.rint(steps).astype(np.int64)
    return received, int(np.count_nonzero(~usable))
