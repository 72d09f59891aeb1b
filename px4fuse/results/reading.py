"""Results read back, strictly and within bounds: they may come from a stranger."""

from __future__ import annotations

import json
import math
import unicodedata
from functools import cache
from typing import Any

import msgspec

from px4fuse.errors import ResultsError
from px4fuse.record import choose
from px4fuse.results.contract import KINDS, Results
from px4fuse.results.model import VERSION

MAX_BYTES = 5_000_000
MAX_DEPTH = 64
MAX_VALUES = 2_000_000
MAX_ITEMS = 200_000
MAX_STRING = 200_000
MAX_DIGITS = 20


def read_results(data: bytes, name: str = "results.json") -> Results:
    """Read results that px4fuse wrote, whoever hands them in.

    Parameters
    ----------
    data : bytes
        Anything.
    name : str
        What to call it in errors.

    Returns
    -------
    Results
        By the name in its schema. Texts are :func:`cleaned`, numbers are finite.

    Raises
    ------
    ResultsError
        It is too large, not JSON, nested too deeply, or not results of this version.
    """
    try:
        return _decoded(_bounded(_parsed(data)))
    except RecursionError as error:
        raise ResultsError(f"{name} is nested too deeply.") from error
    except _RefusedError as refusal:
        why, *remedy = refusal.args
        raise ResultsError(f"{name} {why}.", *remedy) from refusal


def cleaned(text: str) -> str:
    r"""Text without characters that act on a terminal, a page or the order of its neighbours.

    Control characters other than newline and tab, bidirectional embeddings, overrides and
    isolates, line and paragraph separators, invisible tags, noncharacters and lone surrogates are
    dropped. Letters and signs of all languages stay.

    >>> cleaned("Zo\u00eb\x1b[2J \u202egnp.exe\ud800")
    'Zoë[2J gnp.exe'
    """
    return text if text.isascii() and text.isprintable() else "".join(filter(_harmless, text))


def one_line(text: str, length: int) -> str:
    r"""A cleaned text on one line, at most ``length`` characters long.

    >>> one_line("a\nb\t c", 4)
    'a b…'
    """
    # of a million characters only as many are looked at as may count
    line = " ".join(cleaned(text[: 10 * length]).split())
    return line if len(line) <= length else line[: length - 1].rstrip() + "…"


@cache
def _harmless(character: str) -> bool:
    code = ord(character)
    if character in "\n\t":
        return True
    return not (
        unicodedata.category(character) in {"Cc", "Cs", "Zl", "Zp"}
        or 0x202A <= code <= 0x202E
        or 0x2066 <= code <= 0x2069
        or 0xE0000 <= code <= 0xE007F
        or 0xFDD0 <= code <= 0xFDEF
        or code & 0xFFFE == 0xFFFE
    )


class _RefusedError(Exception):
    """Why these are no results: the end of a sentence, on its way to :func:`read_results`."""


def _parsed(data: bytes) -> Any:
    """JSON, more strictly than Python or msgspec read it."""
    if len(data) > MAX_BYTES:
        raise _RefusedError(f"is larger than {MAX_BYTES // 1_000_000} MB")
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise _RefusedError("is not UTF-8 text") from error
    # an upper bound that costs nothing: each further value has a comma or bracket before it
    if sum(map(text.count, ",[{")) >= MAX_VALUES:
        raise _RefusedError("holds more values than results can have")
    try:
        return json.loads(
            text,
            object_pairs_hook=_without_twins,
            parse_constant=_no_constant,
            parse_int=_integer,
            parse_float=_finite,
        )
    except json.JSONDecodeError as error:
        raise _RefusedError("is not JSON") from error


def _without_twins(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    made = dict(pairs)
    if len(made) != len(pairs):
        raise _RefusedError("has a key twice")
    return made


def _no_constant(name: str) -> float:
    raise _RefusedError(f"has the number {name}, which is not JSON")


def _integer(digits: str) -> int:
    if len(digits) > MAX_DIGITS:
        raise _RefusedError("has a number with too many digits")
    return int(digits)


def _finite(digits: str) -> float:
    number = float(digits)
    if not math.isfinite(number):
        raise _RefusedError("has a number that is too large")
    return number


def _bounded(value: Any, depth: int = 1) -> Any:
    """The same with cleaned texts, nothing in it too deep, too long or too many."""
    if depth > MAX_DEPTH:
        raise _RefusedError("is nested too deeply")
    if isinstance(value, str):
        if len(value) > MAX_STRING:
            raise _RefusedError("has a text that is too long")
        return cleaned(value)
    if not isinstance(value, dict | list):
        return value
    if len(value) > MAX_ITEMS:
        raise _RefusedError("has a list that is too long")
    if isinstance(value, list):
        return [_bounded(part, depth + 1) for part in value]
    if any(_bounded(key) != key for key in value):
        raise _RefusedError("has a key with control characters")
    return {key: _bounded(part, depth + 1) for key, part in value.items()}


def _decoded(value: Any) -> Results:
    schema = value.get("schema") if isinstance(value, dict) else None
    name, version = (schema.get("name"), schema.get("version")) if isinstance(schema, dict) else (
        None,
        None,
    )  # fmt: skip
    if not isinstance(name, str) or name not in KINDS or not isinstance(version, str):
        raise _RefusedError("holds no results of px4fuse")
    if version != VERSION:
        raise _RefusedError(
            f"follows version {one_line(version, 20)} of the results' schema, this px4fuse reads "
            f"version {VERSION}: make the report again with it",
            "Run it with the px4fuse that the report was made with.",
        )
    try:
        found: Results = msgspec.convert(value, KINDS[name], dec_hook=choose)
    except msgspec.ValidationError as error:
        raise _RefusedError(f"does not follow the schema: {one_line(str(error), 300)}") from error
    return found
