"""What the names of columns mean in the position logs of UWB vendors, rosbag and rostopic."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
LENGTH_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}

Position = tuple[int, int, int | None]


def _words(table: Mapping[str, str]) -> dict[str, str]:
    """Turn a table of meaning to words into one of word to meaning."""
    return {word: meaning for meaning, words in table.items() for word in words.split()}


# Names are read in lower case and as words: "position.x_m" is position, x, m
_UNITS = _words(
    {
        "s": "s sec secs second seconds",
        "ms": "ms msec msecs millis millisecond milliseconds",
        "us": "us usec usecs micros microsecond microseconds",
        "ns": "ns nsec nsecs nanos nanosec nanosecs nanosecond nanoseconds",
        "m": "m meter meters metre metres",
        "cm": "cm centimeter centimeters centimetre centimetres",
        "mm": "mm millimeter millimeters millimetre millimetres",
    }
)
# Words without what stands between them, in order of preference
_TIMES = _words(
    {
        "time of measurement": "headerstamp headertimestamp headertime measurementtime sampletime "
        "measurementtimestamp sensortime timestampsample",
        "time": "timestamp time t ts stamp unix unixtime unixtimestamp timestampunix timeunix "
        "epoch epochtime datetime utc utctime timeutc timestamputc elapsed elapsedtime",
        "time of recording": "bagtime bagtimestamp bagstamp rosbagtime rosbagtimestamp recvtime "
        "receivetime receivetimestamp receivedtime rxtime arrivaltime logtime logtimestamp "
        "recordtime recordingtime hosttime hosttimestamp pctime systemtime",
    }
)
TIME_KINDS = list(dict.fromkeys(_TIMES.values()))
_TIME_CONTEXT = ("field", "msg", "data", "uwb", "tag", "since", "start", "boot")
_WHOLE_NAMES = _words(
    {
        "quality": "quality q qf qualityfactor positionquality confidence",
        "tag": "tag tagid id serial address node nodeid deviceid",
    }
)
_AXES = _words(
    {
        "x": "x v0",
        "y": "y v1",
        "z": "z v2",
        "north": "n north northing",
        "east": "e east easting",
        "down": "d down",
        "up": "u up height altitude alt",
    }
)
_ROLES = _words(
    {
        "sigma": "sigma std stdev stddev sd s accuracy uncertainty deviation",
        "context": "p t pos position positions pose point translation transform location loc coord "
        "coordinate coordinates field msg data uwb rtls tag est estimate estimated measured raw "
        "filtered local world map",
    }
)
_GLUED = re.compile(r"(pos|position|p|t|sigma|std|stddev|s)([xyzneud])|([xyz])(pos|std|sigma)")
# Frame, and the names of its axes in order; the first whose horizontal names are there is taken
_FRAMES: tuple[tuple[str | None, tuple[str, str, str]], ...] = (
    ("ned", ("north", "east", "down")),
    ("enu", ("east", "north", "up")),
    (None, ("x", "y", "z")),
    (None, ("x", "y", "up")),
    (None, ("x", "y", "down")),
)


@dataclass(frozen=True)
class Meaning:
    """What one column's name says; all "" where it says nothing."""

    kind: str = ""  # "time", "position", "sigma", "quality" or "tag"
    key: str = ""  # name of the axis, or which time of `TIME_KINDS`
    unit: str = ""
    group: str = ""  # what else a position's name holds, which its x, y and z share


def meaning(name: str) -> Meaning:
    """Read a column's name."""
    plain = unicodedata.normalize("NFKC", name).replace("μ", "u")
    plain = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", plain).lower()
    words = re.findall(r"[^\W_]+", plain)
    unit = _UNITS.get(words[-1], "") if words else ""
    if unit and len(words) > 1:
        words.pop()
    elif unit in TIME_UNITS:
        words = ["time"]  # a column named "secs" or "millis"
    else:
        unit = ""
    key = "".join(word for word in words if word not in _TIME_CONTEXT)
    if key in _TIMES and unit not in LENGTH_UNITS:
        return Meaning("time", _TIMES[key], unit)
    whole = "".join(word for word in words if not word.isdecimal())  # "quality (0-100)"
    if whole in _WHOLE_NAMES and not unit:
        return Meaning(_WHOLE_NAMES[whole])
    parts: list[str] = []
    for word in words:
        glued = None if word in _ROLES or word in _AXES else _GLUED.fullmatch(word)
        parts += [part for part in glued.groups() if part] if glued else [word]
    axes = [_AXES[part] for part in parts if part in _AXES]
    rest = [part for part in parts if part not in _AXES]
    roles = {_ROLES.get(part.rstrip("0123456789")) for part in rest}
    if unit in TIME_UNITS or len(axes) > 1 or None in roles:
        return Meaning()
    if "sigma" in roles:
        return Meaning("sigma", "".join(axes), unit)
    return Meaning("position", axes[0], unit, ".".join(rest)) if axes else Meaning()


def find_position(meanings: Sequence[Meaning]) -> tuple[str | None, Position] | None:
    """Frame and columns of the first track that has two horizontal axes, best all three."""
    groups: dict[str, dict[str, int]] = {}
    for index, column in enumerate(meanings):
        if column.kind == "position":
            groups.setdefault(column.group, {}).setdefault(column.key, index)
    for complete in (True, False):
        for axes in groups.values():
            for frame, (first, second, third) in _FRAMES:
                if first in axes and second in axes and (third in axes or not complete):
                    return frame, (axes[first], axes[second], axes.get(third))
    return None


def find_sigma(sigmas: Mapping[str, int], frame: str | None) -> tuple[int | None, ...]:
    """Columns of sigma of the frame's axes, from those by axis; "" is one for all of them."""
    axes = next(axes for name, axes in _FRAMES if name == frame)
    return tuple(
        sigmas.get(axis, sigmas.get(letter, sigmas.get("")))
        for axis, letter in zip(axes, "xyz", strict=True)
    )
