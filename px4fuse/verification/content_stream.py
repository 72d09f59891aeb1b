"""What a PDF's content stream draws, read strictly: what px4fuse never writes is not read at all.

A lenient reader can be made to see another page than a viewer shows. Comments, inline images,
dictionaries and unbalanced brackets are therefore errors here, not oddities.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any, NamedTuple

_CONSTRUCTION = frozenset({"m", "l", "c", "v", "y", "h", "re"})
PATH = "path"
# ISO 32000-1, 7.2 and 7.3; strings without nested parentheses, which matplotlib escapes
_TOKEN = re.compile(
    rb"""
      (?P<blank>[\x00\t\n\f\r ]+)
    | (?P<number>[+-]?(?:\d+\.?\d*|\.\d+)(?![^\x00\t\n\f\r \[\]()/<>]))
    | (?P<name>/[^\x00\t\n\f\r \[\]()/<>%{}]*)
    | \((?P<string>[^()\\]*(?:\\.[^()\\]*)*)\)
    | <(?P<hex>[0-9A-Fa-f\x00\t\n\f\r ]*)>
    | (?P<open>\[)
    | (?P<close>\])
    | (?P<operator>[A-Za-z'"][A-Za-z0-9]*\*?)
    """,
    re.VERBOSE | re.DOTALL,
)
_ESCAPE = re.compile(rb"\\([0-7]{1,3}|\r\n|.)", re.DOTALL)
_ESCAPED = {
    b"n": b"\n", b"r": b"\r", b"t": b"\t", b"b": b"\b", b"f": b"\f", b"\n": b"", b"\r": b"",
    b"\r\n": b"",
}  # fmt: skip
_MAX_OPERANDS = 100_000
_NOT_DRAWN = frozenset({"BI", "ID", "EI", "true", "false", "null"})


class UnreadableError(ValueError):
    """A content stream holds what px4fuse never writes."""


class Operation(NamedTuple):
    """An operator with its operands; what builds one path is one operation, called ``path``.

    Operands are float, str (names, with their slash), bytes (strings) and lists. Those of a path
    are operations.
    """

    operator: str
    operands: list[Any]


def operations(content: bytes) -> list[Operation]:
    """Read a content stream.

    Raises
    ------
    UnreadableError
        It holds what px4fuse never writes.

    >>> operations(b"1 0 0 RG 0 0 m 5 5 l S")[1]
    Operation(operator='path', operands=[('m', [0.0, 0.0]), ('l', [5.0, 5.0])])
    """
    found: list[Operation] = []
    path: list[Any] = []
    for operator, operands in _single(content):
        if operator in _CONSTRUCTION:
            path.append((operator, operands))
            continue
        if path:
            found.append(Operation(PATH, path))
            path = []
        found.append(Operation(operator, operands))
    if path:
        raise UnreadableError("it ends within a path")
    return found


def _single(content: bytes) -> Iterator[tuple[str, list[Any]]]:
    operands: list[Any] = []
    array: list[Any] | None = None
    place = 0
    for match in _TOKEN.finditer(content):
        if match.start() != place:
            break
        place = match.end()
        kind, text = match.lastgroup, match[match.lastgroup or 0]
        if kind == "blank":
            continue
        if kind == "operator":
            operator = text.decode("ascii")
            if array is not None or operator in _NOT_DRAWN:
                raise UnreadableError(f"{operator} stands where px4fuse writes none")
            yield operator, operands
            operands = []
        elif kind == "open":
            if array is not None:
                raise UnreadableError("an array in an array")
            array = []
        elif kind == "close":
            if array is None:
                raise UnreadableError("an array that was not begun")
            operands.append(array)
            array = None
        else:
            (operands if array is None else array).append(_value(kind, text))
            if len(operands) > _MAX_OPERANDS:
                raise UnreadableError("too many operands")
    if place != len(content) or operands or array is not None:
        raise UnreadableError(f"byte {place} is nothing that px4fuse writes")


def _value(kind: str | None, text: bytes) -> float | str | bytes:
    if kind == "number":
        return float(text)
    if kind == "name":
        return text.decode("latin-1")
    if kind == "hex":
        digits = bytes(text.translate(None, b"\x00\t\n\f\r "))
        return bytes.fromhex((digits + b"0" * (len(digits) % 2)).decode("ascii"))
    return _ESCAPE.sub(_unescaped, text) if b"\\" in text else text


def _unescaped(match: re.Match[bytes]) -> bytes:
    what = match[1]
    if what[:1].isdigit() and what[:1] < b"8":
        return bytes([int(what, 8) & 0xFF])
    return _ESCAPED.get(what, what)
