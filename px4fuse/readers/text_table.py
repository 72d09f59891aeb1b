"""Functions for text files: unsupported formats, decoding, numbers, quotation marks."""

import re
from pathlib import Path
from typing import Any

from px4fuse.core.reading import display_name
from px4fuse.core.record import read_toml
from px4fuse.errors import Px4FuseError

_TEXT_FORMATS = read_toml(__file__, dict[str, list[dict[str, Any]]], "formats.toml")
# Text formats of UWB systems
UWB_TEXT_FORMATS = _TEXT_FORMATS["streams"]


def refuse_foreign_format(path: Path, first_bytes: bytes, error_type: type[Px4FuseError]) -> None:
    """Raise an error if px4fuse does not support the file format."""
    name = display_name(path)
    for foreign_format in _TEXT_FORMATS["foreign"]:
        if any(
            first_bytes.startswith(start.encode("latin-1")) for start in foreign_format["starts"]
        ):
            remedy = foreign_format["remedy"].format(name=name)
            raise error_type(f"{name}: the file is {foreign_format['name']}", remedy)


# Valid UNIX times (s): years 2000 to 2100
MIN_VALID_UNIX_TIME_S, MAX_VALID_UNIX_TIME_S = 946_684_800.0, 4_102_444_800.0
# Number of characters that are searched for signs of a binary file
_CHECKED_CHAR_COUNT = 100_000
# Byte order marks of UTF-16, the encoding of texts from Windows shells
_UTF_16_BYTE_ORDER_MARKS = (b"\xff\xfe", b"\xfe\xff")
_CONTROL_CHARACTER_PATTERN = re.compile("[\x00-\x08\x0e-\x1b]")
_NUMBER_PATTERN = re.compile(
    r"[+-]?(?:(?:[0-9]+\.?|[0-9]*\.[0-9]+)(?:e[+-]?[0-9]+)?|nan|inf)", re.IGNORECASE
)


def decode_text(content: bytes) -> str | None:
    """Decode a text in UTF-8, UTF-16 or Latin-1, with line feeds as line ends; None if binary."""
    if content.startswith(_UTF_16_BYTE_ORDER_MARKS):
        text = content[: len(content) // 2 * 2].decode("utf-16", errors="replace")
    else:
        content = content.rstrip(b"\0\x1a")  # NUL at the end after a power loss, 0x1a from DOS
        try:
            text = content.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = content.decode("latin-1")
    if "\0" in text or _CONTROL_CHARACTER_PATTERN.search(text, 0, _CHECKED_CHAR_COUNT):
        return None
    return text.replace("\r\n", "\n").replace("\r", "\n")


def is_number(text: str) -> bool:
    """Return True if the text is a number, NaN or infinity."""
    return _NUMBER_PATTERN.fullmatch(text) is not None


def quote(text: str) -> str:
    """Put a text in quotation marks, and shorten it to 40 characters."""
    return repr(text if len(text) <= 40 else text[:37] + "...")
