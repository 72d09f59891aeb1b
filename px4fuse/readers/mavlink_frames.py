"""Decoder of the MAVLink wire format: bytes to frames (packets), and frames to arrays of fields.

Invalid bytes and incomplete frames are skipped and counted.

Sources: MAVLink developer guide, "Packet Serialization"; pymavlink's generated dialects.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from fastcrc.crc16 import mcrf4xx  # CRC-16/MCRF4XX is MAVLink's X.25 checksum
from numpy.typing import NDArray
from pymavlink.dialects.v20 import all as dialect

from px4fuse.core.arrays import BoolArray, IntArray, iterate_row_blocks
from px4fuse.errors import LogError

Int64Array = NDArray[np.int64]
ByteArray = NDArray[np.uint8]
# Address of a sender: MAVLink system id and component id
MavlinkAddress = tuple[int, int]

MAGIC_BYTE_V1, MAGIC_BYTE_V2 = 0xFE, 0xFD
HEADER_BYTES_V1, HEADER_BYTES_V2 = 6, 10
# Offsets (bytes) in the header. Sequence number, system id and component id are consecutive bytes
LENGTH_OFFSET, FLAGS_OFFSET_V2 = 1, 2
SEQUENCE_OFFSET_V1, SEQUENCE_OFFSET_V2 = 2, 4
MESSAGE_ID_OFFSET_V1, MESSAGE_ID_OFFSET_V2 = 5, 7
CHECKSUM_BYTES = 2
SIGNATURE_BYTES = 13
SIGNED_FLAG = 0x01
MAX_FRAME_BYTES = HEADER_BYTES_V2 + 255 + CHECKSUM_BYTES + SIGNATURE_BYTES
# Receive time that QGroundControl and MAVProxy write before each frame: µs, big-endian
RECEIVE_TIME_BYTES = 8
# Block size (bytes) of the search for frames, which limits the memory
BLOCK_BYTES = 1 << 16
# Minimum fraction of bytes in valid frames; otherwise, the file is not MAVLink
MIN_VALID_FRAME_FRACTION = 0.01
# Maximum difference (µs) of a valid receive time from the median, as in pymavlink
MAX_RECEIVE_TIME_DIFFERENCE_US = 3 * 24 * 3600 * 1_000_000
MESSAGE_IDS: Mapping[str, int] = {
    message.msgname: number for number, message in dialect.mavlink_map.items()
}
# Vehicle types, such as "quadrotor", by MAV_TYPE number
VEHICLE_TYPES = {
    number: entry.name.removeprefix("MAV_TYPE_").replace("_", " ").lower()
    for number, entry in dialect.enums["MAV_TYPE"].items()
} | {6: "ground station", 18: "companion computer"}
# CRC_EXTRA byte of the checksum by message id; -1 for unknown messages. All known ids have 16 bits.
# The last element is for all ids with 24 bits
_CRC_EXTRA = np.full((1 << 16) + 1, -1, np.int16)
_CRC_EXTRA[[*dialect.mavlink_map]] = [message.crc_extra for message in dialect.mavlink_map.values()]
# CRC of each byte value
_CRC_TABLE = np.array([mcrf4xx(bytes([byte]), 0) for byte in range(256)], np.uint16)


@dataclass(frozen=True)
class MavlinkFrames:
    """MAVLink frames of one recording with valid checksums, in file order."""

    name: str
    content: bytes
    sha256: str
    # Offset of the first byte of each frame
    start_offsets: Int64Array
    message_ids: NDArray[np.int32]
    system_ids: ByteArray
    component_ids: ByteArray
    sequence_numbers: ByteArray
    payload_offsets: Int64Array
    payload_lengths: ByteArray
    # Receive times (UNIX time); None for a raw stream
    receive_times_us: Int64Array | None
    # Number of frames with unknown messages
    unknown_frame_count: int
    # Number of bytes that are not part of a frame
    byte_count_outside_frames: int
    # True if the file ends within a frame
    is_last_frame_incomplete: bool

    def __len__(self) -> int:
        return len(self.start_offsets)

    def rows(self, message: str) -> IntArray:
        """Return the indices of the frames with the given MAVLink message."""
        return np.flatnonzero(self.message_ids == MESSAGE_IDS[message])

    def is_sent_by(
        self, address: MavlinkAddress, rows: IntArray | slice = slice(None)
    ) -> BoolArray:
        """Return True for each frame that was sent by ``address``."""
        system, component = address
        return np.asarray(
            (self.system_ids[rows] == system) & (self.component_ids[rows] == component)
        )

    def table(self, message: str, rows: IntArray) -> NDArray[Any]:
        """Decode messages of one type to a structured array with one row per frame.

        The fields are in MAVLink units. ``rows`` are the indices of the frames to decode. MAVLink 2
        omits trailing zero bytes of the payload. They are added again.
        """
        layout = wire_layout(MESSAGE_IDS[message])
        payload = np.zeros((len(rows), layout.itemsize), np.uint8)
        content_bytes = np.frombuffer(self.content, np.uint8)
        payload_starts = self.payload_offsets[rows]
        payload_lengths = self.payload_lengths[rows]
        for length in np.unique(payload_lengths).tolist():
            # A longer payload has extension fields that pymavlink does not know
            byte_count = min(length, layout.itemsize)
            if not byte_count:
                continue
            # Row i of this view contains the bytes from offset i. A view needs no memory
            bytes_from_offset = np.lib.stride_tricks.sliding_window_view(content_bytes, byte_count)
            rows_with_length = np.flatnonzero(payload_lengths == length)
            # Blocks limit the memory, because indexing copies the payloads
            for block in iterate_row_blocks(len(rows_with_length)):
                block_rows = rows_with_length[block]
                payload[block_rows, :byte_count] = bytes_from_offset[payload_starts[block_rows]]
        return payload.view(layout)[:, 0]


def message_name(message_id: int) -> str:
    """Return the MAVLink name of a message id."""
    return str(dialect.mavlink_map[message_id].msgname)


@cache
def wire_layout(message_id: int) -> np.dtype[Any]:
    """Return the payload fields of a MAVLink message as a structured dtype without padding."""
    message = dialect.mavlink_map[message_id]
    # pymavlink and numpy have the same type codes
    type_codes = message.native_format.decode().removeprefix("<")
    fields: list[Any] = []
    for name, type_code, length in zip(
        message.ordered_fieldnames, type_codes, message.array_lengths, strict=True
    ):
        if type_code == "c":
            fields.append((name, f"S{length or 1}"))
        else:
            fields.append((name, f"<{type_code}", (length,) if length else ()))
    return np.dtype(fields)


def read_frames(name: str, content: bytes) -> MavlinkFrames:
    """Find all frames with valid checksums in a ``.tlog`` or a raw stream.

    Raises
    ------
    LogError
        The content is not MAVLink.
    """
    start_offsets, end_offsets, message_ids = _remove_nested_frames(_find_valid_frames(content)).T
    frame_byte_count = np.sum(end_offsets - start_offsets)
    if not frame_byte_count or frame_byte_count < MIN_VALID_FRAME_FRACTION * len(content):
        raise LogError(
            f"{name}: the file is neither a PX4 ULog nor a MAVLink recording. It contains "
            f"{len(start_offsets)} frames with a valid checksum in {len(content)} bytes.",
            "Give a .ulg, a .tlog or a raw MAVLink stream.",
        )
    receive_time_size_bytes = (
        RECEIVE_TIME_BYTES if _has_receive_times(start_offsets, end_offsets) else 0
    )
    content_bytes = np.frombuffer(content, np.uint8)
    is_version_2 = content_bytes[start_offsets] == MAGIC_BYTE_V2
    sequence_offsets = start_offsets + np.where(
        is_version_2, SEQUENCE_OFFSET_V2, SEQUENCE_OFFSET_V1
    )
    unknown_frame_count, byte_count_outside_frames, is_last_frame_incomplete = (
        _count_bytes_outside_frames(
            content, start_offsets - receive_time_size_bytes, end_offsets, receive_time_size_bytes
        )
    )
    return MavlinkFrames(
        name=name,
        content=content,
        sha256=hashlib.sha256(content).hexdigest(),
        start_offsets=start_offsets,
        message_ids=message_ids.astype(np.int32),
        system_ids=content_bytes[sequence_offsets + 1],
        component_ids=content_bytes[sequence_offsets + 2],
        sequence_numbers=content_bytes[sequence_offsets],
        payload_offsets=start_offsets + np.where(is_version_2, HEADER_BYTES_V2, HEADER_BYTES_V1),
        payload_lengths=content_bytes[start_offsets + LENGTH_OFFSET],
        receive_times_us=_read_receive_times(content_bytes, start_offsets, end_offsets)
        if receive_time_size_bytes
        else None,
        unknown_frame_count=unknown_frame_count,
        byte_count_outside_frames=byte_count_outside_frames,
        is_last_frame_incomplete=is_last_frame_incomplete,
    )


def _find_valid_frames(content: bytes) -> Int64Array:
    """Return start, end and message id of each frame with a valid checksum, shape (n, 3)."""
    content_bytes = np.frombuffer(content, np.uint8)
    content_view = memoryview(content)
    valid_frames = []
    for block_start in range(0, len(content) + 1, BLOCK_BYTES):
        frames = _find_possible_frames(content, block_start)
        start_offsets, _, message_ids, crc_offsets = frames.T
        # The CRC is that of the frame without magic byte, followed by the CRC_EXTRA byte
        byte_ranges = zip((start_offsets + 1).tolist(), crc_offsets.tolist(), strict=True)
        crc = np.array(
            [mcrf4xx(content_view[first_byte:end_byte]) for first_byte, end_byte in byte_ranges],
            np.uint16,
        )
        crc = (crc >> 8) ^ _CRC_TABLE[(crc ^ _CRC_EXTRA[message_ids]) & 0xFF]
        stored_crc = content_bytes[crc_offsets] | content_bytes[crc_offsets + 1].astype(int) << 8
        valid_frames.append(frames[stored_crc == crc, :3])
    return np.concatenate(valid_frames)


def _remove_nested_frames(frames: Int64Array) -> Int64Array:
    """Remove MAVLink frames inside other frames, such as in the payload of message TUNNEL.

    Each row of ``frames`` contains start, end and message id.
    """
    start_offsets, end_offsets, _ = frames.T
    if np.all(start_offsets[1:] >= end_offsets[:-1]):
        return frames
    all_frame_starts = {*start_offsets.tolist()}
    kept_rows = []
    previous_end = 0
    for row, (frame_start, frame_end, _) in enumerate(frames.tolist()):
        # A frame begins where the previous frame ends, or after the receive time (8 bytes) between
        # them
        expected_frame_starts = previous_end, previous_end + RECEIVE_TIME_BYTES
        is_expected = frame_start in expected_frame_starts
        # A frame at another offset is valid only if no frame begins at an expected offset: damaged
        # bytes or an unknown frame then precede it. Otherwise, it is inside the previous frame, or
        # bytes of a receive time look like a frame
        is_after_skipped_bytes = frame_start >= previous_end and all_frame_starts.isdisjoint(
            expected_frame_starts
        )
        if is_expected or is_after_skipped_bytes:
            kept_rows.append(row)
            previous_end = frame_end
    return frames[kept_rows]


def _find_possible_frames(content: bytes, block_start: int) -> Int64Array:
    """Find possible MAVLink frames that begin in one block of the file.

    Checksums are not tested. Return start, end, message id and checksum offset of each frame, shape
    (n, 4).
    """
    # Zeros after the end of the file complete its last headers
    byte_count = BLOCK_BYTES + HEADER_BYTES_V2 - 1
    block = content[block_start : block_start + byte_count].ljust(byte_count, b"\0")
    headers = np.lib.stride_tricks.sliding_window_view(
        np.frombuffer(block, np.uint8), HEADER_BYTES_V2
    )
    rows = np.flatnonzero((headers[:, 0] == MAGIC_BYTE_V1) | (headers[:, 0] == MAGIC_BYTE_V2))
    headers = headers[rows].astype(np.int32)
    is_version_2 = headers[:, 0] == MAGIC_BYTE_V2
    low_byte, middle_byte, high_byte = headers[:, MESSAGE_ID_OFFSET_V2:].T
    message_ids = np.where(
        is_version_2,
        low_byte | middle_byte << 8 | high_byte << 16,
        headers[:, MESSAGE_ID_OFFSET_V1],
    ).clip(max=len(_CRC_EXTRA) - 1)
    flags = np.where(is_version_2, headers[:, FLAGS_OFFSET_V2], 0)
    start_offsets = block_start + rows
    header_bytes = np.where(is_version_2, HEADER_BYTES_V2, HEADER_BYTES_V1)
    crc_offsets = start_offsets + header_bytes + headers[:, LENGTH_OFFSET]
    end_offsets = crc_offsets + CHECKSUM_BYTES + SIGNATURE_BYTES * flags
    # Frames with other flags have an unknown format
    is_possible = (
        (flags <= SIGNED_FLAG) & (_CRC_EXTRA[message_ids] >= 0) & (end_offsets <= len(content))
    )
    frames = np.stack([start_offsets, end_offsets, message_ids, crc_offsets], axis=1)
    return np.asarray(frames[is_possible])


def _has_receive_times(start_offsets: Int64Array, end_offsets: Int64Array) -> bool:
    """Return True if receive times precede most frames, as in a ``.tlog``."""
    gap_sizes_bytes = start_offsets[1:] - end_offsets[:-1]
    gap_sizes_bytes = gap_sizes_bytes[np.isin(gap_sizes_bytes, (0, RECEIVE_TIME_BYTES))]
    if not len(gap_sizes_bytes):
        gap_sizes_bytes = start_offsets[:1]
    return bool(np.mean(gap_sizes_bytes == RECEIVE_TIME_BYTES) > 0.5)


def _count_bytes_outside_frames(
    content: bytes, start_offsets: Int64Array, end_offsets: Int64Array, receive_time_size_bytes: int
) -> tuple[int, int, bool]:
    """Count the frames with unknown messages, and the bytes outside of all frames.

    ``start_offsets`` and ``end_offsets`` are those of the frames with known messages. The third
    value is True if the file ends within a frame.
    """
    unknown_frame_count = byte_count_outside_frames = offset = 0
    gap_starts = np.append(0, end_offsets)
    gap_ends = np.append(start_offsets, len(content))
    is_gap = gap_starts < gap_ends
    # The bytes after the last known frame always count as a gap, even if there are no such bytes.
    # The loop then ends with the offset at which an incomplete last frame would begin
    is_gap[-1] = True
    for gap_start, gap_end in zip(
        gap_starts[is_gap].tolist(), gap_ends[is_gap].tolist(), strict=True
    ):
        offset = gap_start
        while frame_size_bytes := _measure_unknown_frame(
            content, offset, gap_end, receive_time_size_bytes
        ):
            unknown_frame_count += 1
            offset += frame_size_bytes
        byte_count_outside_frames += gap_end - offset
    rest = content[offset:]
    # `rest_of_frame` is empty if the file ends within the receive time of the last frame
    rest_of_frame = rest[receive_time_size_bytes:]
    is_last_frame_incomplete = 0 < len(rest) < receive_time_size_bytes + MAX_FRAME_BYTES and (
        not rest_of_frame or rest_of_frame[0] in (MAGIC_BYTE_V1, MAGIC_BYTE_V2)
    )
    return unknown_frame_count, byte_count_outside_frames, is_last_frame_incomplete


def _measure_unknown_frame(
    content: bytes, offset: int, gap_end: int, receive_time_size_bytes: int
) -> int:
    """Return the size (bytes) of a MAVLink frame with an unknown message id.

    The size includes the receive time before the frame. Return 0 if no such frame begins at the
    offset.
    """
    header_offset = offset + receive_time_size_bytes
    if header_offset + HEADER_BYTES_V1 > gap_end:
        return 0
    header = content[header_offset : header_offset + HEADER_BYTES_V2]
    frame_size_bytes = receive_time_size_bytes + header[LENGTH_OFFSET] + CHECKSUM_BYTES
    if header[0] == MAGIC_BYTE_V1:
        message_id = header[MESSAGE_ID_OFFSET_V1]
        frame_size_bytes += HEADER_BYTES_V1
    elif header[0] == MAGIC_BYTE_V2:
        message_id = int.from_bytes(header[MESSAGE_ID_OFFSET_V2:], "little")
        frame_size_bytes += HEADER_BYTES_V2 + SIGNATURE_BYTES * (
            header[FLAGS_OFFSET_V2] & SIGNED_FLAG
        )
    else:
        return 0
    # All valid frames with known messages were found before. A known message id between them
    # therefore belongs to a frame with an invalid checksum
    is_known = message_id in dialect.mavlink_map
    return 0 if is_known or offset + frame_size_bytes > gap_end else frame_size_bytes


def _read_receive_times(
    content_bytes: ByteArray, start_offsets: Int64Array, end_offsets: Int64Array
) -> Int64Array:
    """Return the receive time (UNIX, µs) of each MAVLink frame.

    Times far from the median time are damaged, and are replaced by interpolated times.
    """
    is_usable = start_offsets >= RECEIVE_TIME_BYTES
    is_usable[1:] &= start_offsets[1:] - end_offsets[:-1] >= RECEIVE_TIME_BYTES
    eight_byte_windows = np.lib.stride_tricks.sliding_window_view(content_bytes, RECEIVE_TIME_BYTES)
    time_bytes = eight_byte_windows[np.maximum(start_offsets - RECEIVE_TIME_BYTES, 0)]
    # damaged values above the range of int64 become negative
    receive_times_us = np.ascontiguousarray(time_bytes).view(">u8")[:, 0].astype(np.int64)
    is_usable &= (receive_times_us >= 0) & (receive_times_us < 1 << 62)
    median_receive_time_us = int(np.median(receive_times_us[is_usable])) if np.any(is_usable) else 0
    is_usable &= np.abs(receive_times_us - median_receive_time_us) <= MAX_RECEIVE_TIME_DIFFERENCE_US
    rows = np.flatnonzero(is_usable)
    if not len(rows):
        return np.zeros_like(receive_times_us)
    # Interpolate times relative to the first, so that float64 resolves microseconds
    first_time_us = receive_times_us[rows[0]]
    time_since_first_us = np.interp(
        np.arange(len(start_offsets)), rows, receive_times_us[rows] - first_time_us
    )
    return np.asarray(first_time_us + np.rint(time_since_first_us).astype(np.int64))
