"""Results read back, strictly and within bounds: they may come from a stranger."""

import json
import unicodedata
from functools import cache
from typing import Any

import msgspec

from px4fuse.errors import ResultsError
from px4fuse.record import decode_record_or_unavailable
from px4fuse.results.contract import KINDS, Results
from px4fuse.results.model import VERSION

MAX_BYTES = 5_000_000
INTEGER_BITS = 64


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
        By the name in its schema. Texts are :func:`clean_text`, numbers are finite.

    Raises
    ------
    ResultsError
        It is too large, not JSON, nested too deeply, or not results of this version.
    """
    if len(data) > MAX_BYTES:
        raise ResultsError(f"{name} is larger than {MAX_BYTES // 1_000_000} MB.")
    try:
        value = _clean_values(msgspec.json.decode(data))
        json.loads(data, object_pairs_hook=_require_unique_keys)
    except RecursionError as error:
        raise ResultsError(f"{name} is nested too deeply.") from error
    except (msgspec.DecodeError, ValueError) as error:
        raise ResultsError(f"{name} is not JSON ({one_line(str(error), 100)}).") from error
    schema = value.get("schema") if isinstance(value, dict) else None
    kind = KINDS.get(str(schema.get("name"))) if isinstance(schema, dict) else None
    if schema is None or kind is None:
        raise ResultsError(f"{name} holds no results of px4fuse.")
    if (version := str(schema.get("version"))) != VERSION:
        raise ResultsError.of(
            "other_version", name=name, version=one_line(version, 20), reads=VERSION
        )
    try:
        results: Results = msgspec.convert(value, kind, dec_hook=decode_record_or_unavailable)
    except msgspec.ValidationError as error:
        raise ResultsError.of("not_of_schema", name=name, why=one_line(str(error), 300)) from error
    return results


def _require_unique_keys(pairs: list[tuple[str, Any]]) -> None:
    """Refuse what one program reads from its first place and another one from its last."""
    if len(dict(pairs)) < len(pairs):
        raise ValueError("a key stands there twice")


def _clean_values(value: Any) -> Any:
    """The same with every text :func:`clean_text`."""
    if isinstance(value, str):
        return clean_text(value)
    if isinstance(value, dict):
        return {clean_text(name): _clean_values(part) for name, part in value.items()}
    if isinstance(value, int) and value.bit_length() > INTEGER_BITS:
        raise ValueError("an integer is too large")
    return [_clean_values(part) for part in value] if isinstance(value, list) else value


def clean_text(text: str) -> str:
    r"""Text without characters that act on a terminal, a page or the order of its neighbours.

    Control characters other than newline and tab, bidirectional embeddings, overrides and
    isolates, line and paragraph separators, invisible tags, noncharacters and lone surrogates are
    dropped. Letters and signs of all languages stay.

    >>> clean_text("Zo\u00eb\x1b[2J \u202egnp.exe\ud800")
    'Zoë[2J gnp.exe'
    """
    return text if text.isascii() and text.isprintable() else "".join(filter(_is_harmless, text))


def one_line(text: str, length: int) -> str:
    r"""A cleaned text on one line, at most ``length`` characters long.

    >>> one_line("a\nb\t c", 4)
    'a b…'
    """
    # of a million characters only as many are looked at as may count
    line = " ".join(clean_text(text[: 10 * length]).split())
    return line if len(line) <= length else line[: length - 1].rstrip() + "…"


@cache
def _is_harmless(character: str) -> bool:
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
