"""Writer of ULog files.

Source: ULog file format, version 1, https://docs.px4.io/main/en/dev_log/ulog_file_format
"""

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from px4fuse.core.record import read_toml
from px4fuse.readers import ULOG_MAGIC

_ULOG_VERSION = b"\x01"
# ULog names of numpy types; names of integer types end in "_t"
_ULOG_TYPES = {"float64": "double", "float32": "float", "bool": "bool"}
# Fields of each topic, with types and default values
FIELD_DEFINITIONS_BY_TOPIC = read_toml(__file__, dict[str, str], "topics.toml")


@dataclass(frozen=True)
class Topic:
    """Messages of one instance of a PX4 topic, as arrays by field, shape (n,) or (n, k).

    The first field is ``timestamp`` (µs since boot), which must not decrease.
    """

    name: str
    fields: Mapping[str, NDArray[Any]]
    instance: int = 0


def make_topic(name: str, field_values: Mapping[str, ArrayLike]) -> Topic:
    """Make a topic with PX4's fields and types, and defaults for missing fields.

    A scalar value is used for all messages.
    """
    # all topics of aiding sources have the same fields, except those that topics.toml lists
    fields_text = FIELD_DEFINITIONS_BY_TOPIC.get(
        name, FIELD_DEFINITIONS_BY_TOPIC["estimator_aid_src"]
    )
    message_count, fields = np.size(field_values["timestamp"]), {}
    # A line, for example "float32 nan 4: q", contains the type, the default value and the number of
    # elements of an array (both optional), and the names of fields
    for line in ["uint64: timestamp timestamp_sample", *fields_text.splitlines()]:
        type_and_default, field_names = line.split(":")
        numpy_type, *default_and_shape = type_and_default.split()
        for field in field_names.split():
            if field in field_values:
                values = np.asarray(field_values[field])
                if not values.ndim:
                    values = np.full(message_count, values)
            elif default_and_shape:
                default, *shape = default_and_shape
                values = np.full([message_count, *map(int, shape)], float(default))
            else:  # not logged
                continue
            fields[field] = values.astype(numpy_type)
    unknown_fields = field_values.keys() - fields.keys()
    assert not unknown_fields, f"{name} has no {unknown_fields}"
    return Topic(name, fields)


def encode_ulog(
    topics: Sequence[Topic],
    parameters: Mapping[str, int | float],
    info: Mapping[str, int | str],
    start_us: int,
) -> bytes:
    """Encode a ULog file with messages sorted by timestamp; equal input gives equal bytes.

    ``start_us`` is the boot time (µs) at which logging starts.
    """
    content = [
        ULOG_MAGIC + _ULOG_VERSION,
        struct.pack("<Q", start_us),
        _pack_message("B", bytes(40)),  # flag bits
    ]
    format_texts = dict.fromkeys(map(_make_format_definition, topics))
    content += [_pack_message("F", format_text.encode()) for format_text in format_texts]
    for name, info_value in info.items():
        if isinstance(info_value, str):
            ulog_type, value_bytes = f"char[{len(info_value.encode())}]", info_value.encode()
        else:
            ulog_type, value_bytes = "uint32_t", struct.pack("<I", info_value)
        content.append(_pack_keyed_message("I", f"{ulog_type} {name}", value_bytes))
    for name, value in parameters.items():
        ulog_type, struct_code = ("int32_t", "<i") if isinstance(value, int) else ("float", "<f")
        value_bytes = struct.pack(struct_code, value)
        content.append(_pack_keyed_message("P", f"{ulog_type} {name}", value_bytes))
    data_messages: list[bytes] = []
    for topic_id, topic in enumerate(topics):
        subscription = struct.pack("<BH", topic.instance, topic_id) + topic.name.encode()
        content.append(_pack_message("A", subscription))
        data_messages += _encode_data_messages(topic, topic_id)
    timestamps_us = [np.maximum.accumulate(topic.fields["timestamp"]) for topic in topics]
    content += [
        data_messages[index]
        for index in np.argsort(np.concatenate(timestamps_us), kind="stable").tolist()
    ]
    return b"".join(content)


def _pack_message(message_type: str, content: bytes) -> bytes:
    return struct.pack("<HB", len(content), ord(message_type)) + content


def _pack_keyed_message(message_type: str, key: str, value: bytes) -> bytes:
    return _pack_message(message_type, bytes([len(key)]) + key.encode() + value)


def _make_format_definition(topic: Topic) -> str:
    """Return the ULog format of a topic, for example "sensor:uint64_t timestamp;float[3] xyz;"."""
    field_types = []
    for name, values in topic.fields.items():
        array_size = f"[{values.shape[1]}]" if values.ndim == 2 else ""
        ulog_type = _ULOG_TYPES.get(values.dtype.name, f"{values.dtype.name}_t")
        field_types.append(f"{ulog_type}{array_size} {name};")
    return f"{topic.name}:{''.join(field_types)}"


def _encode_data_messages(topic: Topic, topic_id: int) -> list[bytes]:
    """Encode each message of a topic as a ULog data message: header, then the fields."""
    # Name, little-endian type and shape of each field
    topic_fields = (
        (name, values.dtype.newbyteorder("<"), values.shape[1:])
        for name, values in topic.fields.items()
    )
    # the underscore avoids conflicts of header names with PX4 fields
    dtype = np.dtype([("_size", "<u2"), ("_kind", "u1"), ("_number", "<u2"), *topic_fields])
    records = np.zeros(len(topic.fields["timestamp"]), dtype)
    records["_size"] = dtype.itemsize - 3  # the size excludes 3 bytes: size and message type
    records["_kind"] = ord("D")
    records["_number"] = topic_id
    for name, values in topic.fields.items():
        records[name] = values
    return [record.tobytes() for record in records]
