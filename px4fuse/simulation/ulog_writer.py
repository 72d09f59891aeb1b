"""Topics to the bytes of a ULog file.

Source: ULog file format, version 1, https://docs.px4.io/main/en/dev_log/ulog_file_format
"""

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from px4fuse.readers import ULOG_MAGIC

_VERSION = b"\x01"
_TYPES = {
    "<u8": "uint64_t", "<u4": "uint32_t", "<u2": "uint16_t", "|u1": "uint8_t",
    "<i8": "int64_t", "<i4": "int32_t", "<i2": "int16_t", "|i1": "int8_t",
    "<f8": "double", "<f4": "float", "|b1": "bool",
}  # fmt: skip
_FLAG_BITS = bytes(40)


@dataclass(frozen=True)
class Topic:
    """One instance of a topic: PX4's name and its fields.

    Attributes
    ----------
    name : str
    fields : mapping from PX4 field name to ndarray
        Of shape (n,) or (n, k), in the types in which they are logged; the first is
        ``timestamp``, µs since boot, not decreasing.
    instance : int
    """

    name: str
    fields: Mapping[str, NDArray[Any]]
    instance: int = 0


def encode(
    topics: Sequence[Topic],
    parameters: Mapping[str, int | float],
    info: Mapping[str, int | str],
    start_us: int,
    dropouts_ms: Sequence[int] = (),
) -> bytes:
    """Encode a ULog file: the same input gives the same bytes.

    Parameters
    ----------
    topics : sequence of Topic
        Messages are written in the order of their time stamps, those of one topic as they stand.
    parameters : mapping
        int becomes int32, float becomes float32.
    info : mapping
        int becomes uint32.
    start_us : int
        Boot time at which logging starts.
    dropouts_ms : sequence of int
        Written after the data.
    """
    out = [ULOG_MAGIC + _VERSION, struct.pack("<Q", start_us), _message("B", _FLAG_BITS)]
    formats = dict.fromkeys(_format(topic) for topic in topics)
    out += [_message("F", each.encode()) for each in formats]
    for name, word in info.items():
        if isinstance(word, str):
            text = word.encode()
            out.append(_keyed("I", f"char[{len(text)}] {name}", text))
        else:
            out.append(_keyed("I", f"uint32_t {name}", struct.pack("<I", word)))
    for name, value in parameters.items():
        kind, code = ("int32_t", "<i") if isinstance(value, int) else ("float", "<f")
        out.append(_keyed("P", f"{kind} {name}", struct.pack(code, value)))
    for number, topic in enumerate(topics):
        out.append(_message("A", struct.pack("<BH", topic.instance, number) + topic.name.encode()))
    messages: list[bytes] = []
    for number, topic in enumerate(topics):
        messages += _data(topic, number)
    stamps = [np.maximum.accumulate(topic.fields["timestamp"]) for topic in topics]
    out += [messages[at] for at in np.argsort(np.concatenate(stamps), kind="stable").tolist()]
    out += [_message("O", struct.pack("<H", length)) for length in dropouts_ms]
    return b"".join(out)


def _message(kind: str, content: bytes) -> bytes:
    return struct.pack("<HB", len(content), ord(kind)) + content


def _keyed(kind: str, key: str, value: bytes) -> bytes:
    return _message(kind, bytes([len(key)]) + key.encode() + value)


def _format(topic: Topic) -> str:
    parts = []
    for name, values in topic.fields.items():
        size = f"[{values.shape[1]}]" if values.ndim == 2 else ""
        parts.append(f"{_TYPES[values.dtype.newbyteorder('<').str]}{size} {name};")
    return f"{topic.name}:{''.join(parts)}"


def _data(topic: Topic, number: int) -> list[bytes]:
    """One whole message per sample."""
    head = [("size", "<u2"), ("kind", "u1"), ("number", "<u2")]
    body = [
        (name, values.dtype.newbyteorder("<"), values.shape[1:])
        for name, values in topic.fields.items()
    ]
    # a field of PX4 may be called like one of the header
    dtype = np.dtype([(f"_{name}", kind) for name, kind in head] + body)
    records = np.zeros(len(topic.fields["timestamp"]), dtype)
    records["_size"] = dtype.itemsize - 3  # what follows size and kind
    records["_kind"] = ord("D")
    records["_number"] = number
    for name, values in topic.fields.items():
        records[name] = values
    content, width = records.tobytes(), dtype.itemsize
    return [content[at : at + width] for at in range(0, len(content), width)]
