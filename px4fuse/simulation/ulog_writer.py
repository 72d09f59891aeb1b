"""Encoding of topics as a ULog file.

Source: ULog file format, version 1, https://docs.px4.io/main/en/dev_log/ulog_file_format
"""

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from px4fuse.readers import ULOG_MAGIC
from px4fuse.record import table

_VERSION = b"\x01"
# ULog names of numpy types; integer types only add "_t"
_TYPES = {"float64": "double", "float32": "float", "bool": "bool"}
_FLAG_BITS = bytes(40)
# Type and default of each field by topic; a field without default is optional
FIELDS = table(__file__, "topics.toml", dict[str, dict[str, list[Any]]])


@dataclass(frozen=True)
class Topic:
    """One instance of a PX4 topic with its fields.

    Attributes
    ----------
    name : str
    fields : mapping from PX4 field name to ndarray
        Shape (n,) or (n, k), in the logged types. The first is ``timestamp``, µs since boot, not
        decreasing.
    instance : int
    """

    name: str
    fields: Mapping[str, NDArray[Any]]
    instance: int = 0


def topic(name: str, field_values: Mapping[str, ArrayLike], table_row: str = "") -> Topic:
    """Return a topic with PX4's fields and types.

    Parameters
    ----------
    name : str
    field_values : mapping
        Fields with one row per message; a scalar applies to all messages.
    table_row : str
        Row of the table, if it differs from the topic name.
    """
    rows, count = FIELDS[table_row or name], np.size(field_values["timestamp"])
    assert field_values.keys() <= rows.keys(), f"{name} has no {field_values.keys() - rows.keys()}"
    fields = {}
    for field, (kind, *default_values) in rows.items():
        values = (
            field_values[field]
            if field in field_values
            else default_values[0]
            if len(default_values) == 1
            else default_values
        )
        if field in field_values or default_values:
            if field not in field_values or not np.ndim(values):
                values = np.broadcast_to(values, (count, *np.shape(values)))
            fields[field] = np.asarray(values).astype(kind)
    return Topic(name, fields)


def encode(
    topics: Sequence[Topic],
    parameters: Mapping[str, int | float],
    info: Mapping[str, int | str],
    start_us: int,
    dropouts_ms: Sequence[int] = (),
) -> bytes:
    """Encode a ULog file; the same input gives the same bytes.

    Parameters
    ----------
    topics : sequence of Topic
        Messages are sorted by timestamp; the order within a topic is kept.
    parameters : mapping
        int becomes int32, float becomes float32.
    info : mapping
        int becomes uint32.
    start_us : int
        Boot time at which logging starts.
    dropouts_ms : sequence of int
        Durations of the dropouts, written after the data.
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
    field_types = []
    for name, values in topic.fields.items():
        size = f"[{values.shape[1]}]" if values.ndim == 2 else ""
        kind = _TYPES.get(values.dtype.name, f"{values.dtype.name}_t")
        field_types.append(f"{kind}{size} {name};")
    return f"{topic.name}:{''.join(field_types)}"


def _data(topic: Topic, number: int) -> list[bytes]:
    """Return one complete message per sample."""
    head = [("size", "<u2"), ("kind", "u1"), ("number", "<u2")]
    body = [
        (name, values.dtype.newbyteorder("<"), values.shape[1:])
        for name, values in topic.fields.items()
    ]
    # the underscore avoids name conflicts with PX4 fields
    dtype = np.dtype([(f"_{name}", kind) for name, kind in head] + body)
    records = np.zeros(len(topic.fields["timestamp"]), dtype)
    records["_size"] = dtype.itemsize - 3  # excludes the header bytes of size and kind
    records["_kind"] = ord("D")
    records["_number"] = number
    for name, values in topic.fields.items():
        records[name] = values
    content, width = records.tobytes(), dtype.itemsize
    return [content[at : at + width] for at in range(0, len(content), width)]
