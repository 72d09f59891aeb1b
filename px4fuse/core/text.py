"""Formatting, parsing and escaping of texts and numbers, and data classes converted for JSON."""

import math
import re
import shlex
import unicodedata
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import is_dataclass
from datetime import UTC, datetime
from decimal import Decimal
from typing import Any

import msgspec

from .record import read_toml

_UNIT_TABLES = read_toml(__file__, dict[str, dict[str, Any]], "units.toml")
# Full name of each unit, by its symbol
UNIT_NAME_BY_SYMBOL: Mapping[str, str] = _UNIT_TABLES["names"]
# Unit of an option or of the size of a fault, by the suffix of the name of its field
UNIT_BY_SUFFIX = {
    "_m_s2": "m/s²",
    "_m_s": "m/s",
    "_m": "m",
    "_s": "s",
    "_hz": "Hz",
    "_deg": "°",
    "_percent": "%",
    "_ppm": "ppm",
    "_gauss": "gauss",
}
# Conversion factors to the base unit of each quantity
_UNIT_FACTORS: Mapping[str, Mapping[str, float]] = _UNIT_TABLES["typed"]
_NUMBER_WITH_UNIT_PATTERN = re.compile(r"([-+]?[\d.,]+(?:e[-+]?\d+)?)\s*(\S*)", re.IGNORECASE)
# Control characters except tab and line feed; separators of lines, and direction of text (bidi);
# surrogates; noncharacters, and the last two code points of each plane; invisible tags
_UNSAFE_CHARACTER_PATTERN = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff\ufdd0-\ufdef"
    f"{''.join(chr(plane + 0xFFFE) + chr(plane + 0xFFFF) for plane in range(0, 0x110000, 0x10000))}"
    "\U000e0000-\U000e007f]"
)
FORMULA_START_CHARACTERS = "=+-@"
# Maximum length (characters) of a table cell; Excel allows 32,767
MAX_CELL_LENGTH = 32_000


def to_json_types(value: object) -> Any:
    """Convert data classes, mappings and tuples to dicts and lists for JSON.

    Dict entries with None, UNSET, NaN or infinity are omitted.

    >>> to_json_types({"rate_hz": float("nan"), "topics": ("a", "b")})
    {'topics': ['a', 'b']}
    """
    if isinstance(value, msgspec.Struct):
        value = msgspec.structs.asdict(value)
    elif is_dataclass(value):
        value = vars(value)
    if isinstance(value, Mapping):
        json_by_name = {str(name): to_json_types(child) for name, child in value.items()}
        return {name: child for name, child in json_by_name.items() if child is not None}
    if isinstance(value, list | tuple):
        return list(map(to_json_types, value))
    if value is msgspec.UNSET or (isinstance(value, float) and not math.isfinite(value)):
        return None
    return value


def convert_nested(value: Any, convert: Callable[[Any], Any]) -> Any:
    """Convert the keys and elements of nested dicts, lists and tuples.

    >>> convert_nested({"a": ["b", 1]}, lambda element: f"<{element}>")
    {'<a>': ['<b>', '<1>']}
    """
    if isinstance(value, dict):
        return {convert(key): convert_nested(child, convert) for key, child in value.items()}
    if isinstance(value, list | tuple):
        return [convert_nested(child, convert) for child in value]
    return convert(value)


def format_utc_time(unix_s: float | None) -> str | None:
    """Format a UNIX time (s) as ISO 8601 with milliseconds.

    Return None if the time is unknown or out of range.

    >>> format_utc_time(1.5), format_utc_time(1e18)
    ('1970-01-01T00:00:01.500+00:00', None)
    """
    if unix_s is None:
        return None
    try:
        return datetime.fromtimestamp(unix_s, UTC).isoformat(timespec="milliseconds")
    except (OverflowError, ValueError, OSError):
        return None


def format_number(value: float, digits: int = 3) -> str:
    """Format a number with ``digits`` significant digits and without an exponent.

    >>> [format_number(value) for value in (0.811, 22.41, 3412.0, 4.2e6, 0.0129, 2.9e-05, 0.0)]
    ['0.811', '22.4', '3,410', '4,200,000', '0.0129', '0.000029', '0']
    """
    return f"{Decimal(f'{value:.{digits}g}'):,f}"


def format_count(count: int, noun: str) -> str:
    """Format a count with its noun.

    >>> format_count(1, "innovation"), format_count(2, "innovation")
    ('1 innovation', '2 innovations')
    """
    return f"{count} {noun}{'' if count == 1 else 's'}"


def format_factor(factor: float) -> str:
    """Format a factor with 2 significant digits (3 if the factor is below 2).

    >>> [format_factor(f) for f in (1.18, 9.87, 61.2, 388.0, 3412.0, 5.13e6)]
    ['1.18', '9.9', '61', '390', '3,400', '5,100,000']
    """
    return format_number(factor, 3 if factor < 2.0 else 2)


def capitalise_first_letter(text: str) -> str:
    return text[:1].upper() + text[1:]


def lowercase_first_letter(text: str) -> str:
    """Change the first letter to lower case, except in an acronym such as UWB."""
    return text if text[1:2].isupper() else text[:1].lower() + text[1:]


def join_first_names(names: Sequence[str], max_count: int, separator: str = ", ") -> str:
    """Join the first ``max_count`` names, and append the number of further names.

    >>> join_first_names("abcd", 2), join_first_names("ab", 2)
    ('a, b and 2 more', 'a, b')
    """
    suffix = f" and {len(names) - max_count} more" if len(names) > max_count else ""
    return separator.join(names[:max_count]) + suffix


def format_p_value(p_value: float) -> str:
    """Format a p-value with 2 significant digits, or as "p < 0.001".

    >>> [format_p_value(p) for p in (0.43, 0.0214, 0.00051, 3e-113, 0.0)]
    ['p 0.43', 'p 0.021', 'p < 0.001', 'p < 0.001', 'p < 0.001']
    """
    return "p < 0.001" if p_value < 0.001 else f"p {format_number(p_value, 2)}"


def format_ratio(ratio: float) -> str:
    """Format a σ ratio (actual σ over reported σ).

    >>> [format_ratio(ratio) for ratio in (128.2, 21.04, 4.52, 1.214, 0.926, 0.0012)]
    ['128', '21', '4.5', '1.21', '0.93', '0.001']
    """
    decimals = sum(ratio < limit for limit in (9.95, 1.995, 0.00995))
    return f"{ratio:.{decimals}f}"


def format_metres(length_m: float) -> str:
    """Format a length (m) in metres, without the unit.

    >>> [format_metres(length) for length in (2981.4, 12.34, 2.114, 0.388, 0.0623, 0.0004)]
    ['2981', '12.3', '2.11', '0.39', '0.062', '0.000']
    """
    decimals = sum(abs(length_m) < limit for limit in (99.95, 9.995, 0.0995))
    return f"{length_m:.{decimals}f}"


def replace_unencodable(text: str) -> str:
    """Replace invalid UTF-8 bytes in a path or command line by question marks."""
    return text.encode(errors="replace").decode()


def with_log_name(text: str, log_name: str) -> str:
    """Replace the placeholder LOG in commands by the name of the log, quoted for a shell.

    >>> with_log_name("Check the time offset (px4fuse sync LOG).", "my log.ulg")
    "Check the time offset (px4fuse sync 'my log.ulg')."
    """
    return re.sub(r"(px4fuse \w+) LOG\b", lambda match: f"{match[1]} {shlex.quote(log_name)}", text)


def clean_text(text: str) -> str:
    r"""Remove characters that control a terminal, a page layout or the text direction.

    Letters and symbols of all languages, newline and tab remain.

    >>> clean_text("Zo\u00eb\x1b[2J \u202egnp.exe\ud800")
    'Zoë[2J gnp.exe'
    """
    return _UNSAFE_CHARACTER_PATTERN.sub("", text)


def shorten_to_line(text: str, max_length: int) -> str:
    r"""Clean a text (:func:`clean_text`) and shorten it to one line of ``max_length`` characters.

    >>> shorten_to_line("a\nb\t c", 4)
    'a b…'
    """
    # shorten first: cleaning millions of characters is slow
    line = " ".join(clean_text(text[: 10 * max_length]).split())
    return line if len(line) <= max_length else line[: max_length - 1].rstrip() + "…"


def convert_to_unit(text: str, unit: str) -> float | None:
    """Parse a number with or without a unit, and convert it to ``unit``.

    Return None if the text is not a number, or has a unit of another quantity.

    >>> convert_to_unit("10cm", "m"), convert_to_unit("0,5", "s"), convert_to_unit("10 apples", "m")
    (0.1, 0.5, None)
    """
    match = _NUMBER_WITH_UNIT_PATTERN.fullmatch(text.strip())
    if match is None:
        return None
    unit = unit.lower()
    unit_in_text = match[2].lower() or unit
    # {unit: 1.0} is for a unit that the tables do not contain, because its quantity has no other
    # unit (Hz)
    for factors in ({unit: 1.0}, *_UNIT_FACTORS.values()):
        if {unit_in_text, unit} <= factors.keys():
            with suppress(ValueError):  # float() rejects several decimal points
                return float(match[1].replace(",", ".")) * (factors[unit_in_text] / factors[unit])
    return None


def neutralise_formulas(text: str) -> str:
    r"""Escape text so that a spreadsheet does not execute it as a formula (OWASP, CSV injection).

    >>> [neutralise_formulas(text) for text in ("=1+1", " \uff0b1", "a;=1+1", "3 - 2", "-17")]
    ["'=1+1", "' ＋1", "a;'=1+1", '3 - 2', '-17']
    """
    # with some regional settings, Excel splits cells at semicolons
    cells = (f"'{cell}" if _is_formula(cell) else cell for cell in text.split(";"))
    safe_text = "".join(map(_replace_control_character, ";".join(cells)))
    return safe_text if len(safe_text) <= MAX_CELL_LENGTH else safe_text[:MAX_CELL_LENGTH] + "…"


def _is_formula(text: str) -> bool:
    """Return True if a spreadsheet may execute the text as a formula.

    This depends on the first visible character, for example "=".
    """
    if re.fullmatch(r"[+-][0-9]+", text):  # signed integer, for example a student id
        return False
    if text.startswith(("\t", "\r")):
        return True
    for character in text:
        # Unicode categories Z (separators) and C (control characters) are not visible
        if character in "\"'" or unicodedata.category(character)[0] in "ZC":
            continue
        return unicodedata.normalize("NFKC", character)[0] in FORMULA_START_CHARACTERS
    return False


def _replace_control_character(character: str) -> str:
    if unicodedata.category(character) in ("Cc", "Cs", "Zl", "Zp"):
        return " " if character.isspace() else "\N{REPLACEMENT CHARACTER}"
    return character
