"""The whole messages of a ULog, and how much of the file is none: cut off, overwritten, zeros.

A message is a header (size, 2 bytes; kind, 1 byte) and so many bytes. Source: "ULog File Format",
docs.px4.io. pyulog looks for the next message byte by byte, half a second for a megabyte of zeros;
it is given whole messages only.
"""

import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

HEADER_BYTES = 16
KINDS = frozenset(b"FBIMPQARDLCSO")
_KIND = re.compile(b"[FBIMPQARDLCSO]")
_DATA, _DATA_KIND = ord("D"), re.compile(b"D")
# So many headers in a row that make sense are found in rubbish by chance once in 10¹⁴ places
IN_A_ROW = 12
# Of a topic and as long as all of that topic by chance once in 10⁸ places
FEW = 3
# What is no kind of message may be one of a later PX4, if a message stands behind it
LETTERS = frozenset(range(ord("A"), ord("Z") + 1))
# The message of flags holds where data were appended after a crash of the logger
_FLAGS, _APPENDED = ord("B"), 1


@dataclass(frozen=True)
class Framing:
    """What could be read of a file.

    Attributes
    ----------
    content : bytes
        The file's header and its whole messages.
    lost_bytes : int
    places : int
        How many stretches that is.
    in_message : bool
        Whether the file ends in the middle of a message.
    """

    content: bytes
    lost_bytes: int = 0
    places: int = 0
    in_message: bool = False


def whole_messages(content: bytes) -> Framing:
    """The whole messages of a file that begins as a ULog does."""
    pieces: list[tuple[int, int]] = []
    in_message = False
    edges = [HEADER_BYTES, *_appended(content), len(content)]
    for start, end in pairwise(edges):
        found, in_message = _walk(content, start, end)
        pieces += found
    lost = len(content) - HEADER_BYTES - sum(end - start for start, end in pieces)
    if lost <= 0:
        return Framing(content)
    head = content[:HEADER_BYTES]
    made = bytearray(head + b"".join(content[start:end] for start, end in pieces))
    if len(edges) > 2:  # nothing is appended to what is joined here
        made[HEADER_BYTES + 3 + 8 : HEADER_BYTES + 3 + 40] = bytes(32)
    joined = [(0, HEADER_BYTES), *pieces, (len(content), len(content))]
    places = sum(one[1] < other[0] for one, other in pairwise(joined))
    return Framing(bytes(made), lost, places, in_message)


def _walk(content: bytes, start: int, end: int) -> tuple[list[tuple[int, int]], bool]:
    """Stretches of whole messages between two places, and whether the last one is cut off."""
    pieces = []
    at = begun = before = start
    # Of each number of a topic: bytes of its last message, and of all, once two had as many
    last: dict[int, int] = {}
    sizes: dict[int, int] = {}
    sure = start  # where the last message of a topic ends that is as long as those before it
    while at + 3 <= end:
        size, kind = content[at] | content[at + 1] << 8, content[at + 2]
        behind = at + 3 + size
        known = kind in KINDS or (kind in LETTERS and _is_row(content, behind, end, IN_A_ROW))
        if known and size and behind <= end:
            topic = content[at + 3] | content[at + 4] << 8 if kind == _DATA and size > 1 else None
            if topic is None or sizes.get(topic, size) == size:
                if topic is not None and last.get(topic) == size:
                    sizes[topic] = size
                    sure = behind
                elif topic is not None:
                    last[topic] = size
                before, at = at, behind
                continue
        # cut off, unless sound messages follow. Headers in rubbish can look sound: what stands
        # behind the last sure message, or this one if its size was overwritten, was none
        begins = _next(content, sure if sizes else before + 1, end, sizes)
        if begins is not None and sizes:
            at = sure
        elif begins is not None and begins < at:
            at = before
        if at > begun:
            pieces.append((begun, at))
        if begins is None:
            return pieces, known and behind > end
        at = begun = before = sure = begins
    if at > begun:
        pieces.append((begun, at))
    return pieces, at < end


def _next(content: bytes, start: int, end: int, sizes: Mapping[int, int]) -> int | None:
    """Where the next message begins, with others behind it.

    Where sizes of topics are known it is one of these: in rubbish a header of another kind leads
    to a sound message by chance, and all between would be lost.
    """
    for found in (_DATA_KIND if sizes else _KIND).finditer(content, start + 2, end):
        at = found.start() - 2
        if sizes:
            size, topic = struct.unpack("<HxH", content[at : at + 5].ljust(5))
            if sizes.get(topic) != size:
                continue
        if _is_row(content, at, end, FEW if sizes else IN_A_ROW):
            return at
    return None


def _is_row(content: bytes, at: int, end: int, count: int) -> bool:
    """Whether so many messages stand there, or fewer that end where the file does."""
    for _ in range(count):
        if at == end:
            return True
        if at + 3 > end or content[at + 2] not in KINDS:
            return False
        size = content[at] | content[at + 1] << 8
        if not size:
            return False
        at += 3 + size
    return at <= end


def _appended(content: bytes) -> list[int]:
    """Where data were appended, by the message of flags, as far as these are places in the file."""
    at = HEADER_BYTES
    if len(content) < at + 3 + 40 or content[at + 2] != _FLAGS or not content[at + 11] & _APPENDED:
        return []
    offsets = struct.unpack_from("<3Q", content, at + 3 + 16)
    return sorted(offset for offset in offsets if at < offset < len(content))
