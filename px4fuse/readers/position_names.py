"""What the names of columns mean in position logs: "x_m", "position.x", "East [mm]", "bag_time"."""

import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass

from px4fuse.record import table

TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
LENGTH_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}

Position = tuple[int, int, int | None]


_WORDS = table(__file__, "position_names.toml", dict[str, dict[str, str]])
_UNITS, _AXES = (
    {word: meaning for meaning, words in _WORDS[group].items() for word in words.split()}
    for group in ("units", "axes")
)
_ROLES = {role: {*words.split()} for role, words in _WORDS["roles"].items()}
_TIME_ROLES = _ROLES["time"] | _ROLES["measured"] | _ROLES["recorded"] | _ROLES["context"]
# Whose time it is, in order of preference
TIME_KINDS = ["time of measurement", "time", "time of recording"]
_GLUED = re.compile(r"(pos|p|t|sigma|std|s)([xyzneud])|([xyz])(pos|std|sigma)")
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

    kind: str = ""  # "time", "position", "sigma" or "tag"
    key: str = ""  # name of the axis, or which time of `TIME_KINDS`
    unit: str = ""
    group: str = ""  # what else a position's name holds, which its x, y and z share


def meaning(name: str) -> Meaning:
    """Read a column's name."""
    plain = unicodedata.normalize("NFKC", name).replace("μ", "u")
    plain = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", plain).lower()
    words = re.findall(r"[^\W_]+", plain)
    unit = _UNITS.get(words[-1], "") if len(words) > 1 else ""
    words = words[:-1] if unit else words
    told = {*words}
    if told & _ROLES["time"] and told <= _TIME_ROLES and unit not in LENGTH_UNITS:
        kinds = [bool(told & _ROLES["measured"]), not told & _ROLES["recorded"], True]
        return Meaning("time", TIME_KINDS[kinds.index(True)], unit)
    if told and told <= _ROLES["tag"]:
        return Meaning("tag")
    parts: list[str] = []
    for word in words:
        glued = None if word in _ROLES["sigma"] | _ROLES["context"] else _GLUED.fullmatch(word)
        parts += [part for part in glued.groups() if part] if glued else [word]
    axes = [_AXES[part] for part in parts if part in _AXES]
    rest = [part for part in parts if part not in _AXES]
    if unit in TIME_UNITS or len(axes) > 1 or not {*rest} <= _ROLES["sigma"] | _ROLES["context"]:
        return Meaning()
    if {*rest} & _ROLES["sigma"]:
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


def find_sigma(meanings: Sequence[Meaning], frame: str | None) -> tuple[int | None, ...]:
    """Columns of sigma of the frame's axes; one without an axis is for all of them."""
    # of several with one meaning the first is kept, as of positions
    sigmas = {m.key: at for at, m in [*enumerate(meanings)][::-1] if m.kind == "sigma"}
    axes = next(axes for name, axes in _FRAMES if name == frame)
    both = zip(axes, "xyz", strict=True)
    return tuple(sigmas.get(axis, sigmas.get(letter, sigmas.get(""))) for axis, letter in both)
