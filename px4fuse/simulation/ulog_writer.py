"""Topics to the bytes of a ULog file.

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
# By numpy's names, where they are not the same but for the "_t" of integers
_TYPES = {"float64": "double", "float32": "float", "bool": "bool"}
_FLAG_BITS = bytes(40)
# By topic and field: its type, and what it holds where that is not given
FIELDS = table(__file__, "topics.toml", dict[str, dict[str, list[Any]]])


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


def topic(name: str, field_values: Mapping[str, ArrayLike], table_row: str = "") -> Topic:
    """A topic with the fields of PX4 in their types.

    Parameters
    ----------
    name : str
    field_values : mapping
        Fields, a row per message; one number stands for all of them.
    table_row : str
        Of which row of the table the topic is, where that is not its name.
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
    field_types = []
    for name, values in topic.fields.items():
        size = f"[{values.shape[1]}]" if values.ndim == 2 else ""
        kind = _TYPES.get(values.dtype.name, f"{values.dtype.name}_t")
        field_types.append(f"{kind}{size} {name};")
    return f"{topic.name}:{''.join(field_types)}"


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
