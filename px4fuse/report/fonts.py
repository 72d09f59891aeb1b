"""Fonts for texts in any script."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path

from matplotlib import font_manager
from matplotlib.font_manager import FontPath

from px4fuse.core.text import shorten_to_line

from .style import FONT

# Names of placeholder fonts, which draw each character as a box
PLACEHOLDER_FONT_WORDS = ("lastresort", "last resort", "blank", "notdef")
MISSING_GLYPH_SYMBOL = "\N{WHITE SQUARE}"
MAX_LISTED_CHARACTERS = 12


@cache
def find_font(character: str) -> str | None:
    """Return the name of an installed font with a character, or None."""
    if ord(character) in _read_font_characters(font_manager.findfont(FONT)):
        return FONT
    for name, path in _list_fonts_except_dejavu():
        if ord(character) in _read_font_characters(path):
            return name
    return None


def find_font_names(text: str) -> list[str]:
    """Return the names of the fonts that a text needs."""
    return list(
        dict.fromkeys([FONT, *filter(None, map(find_font, _find_non_ascii_characters(text)))])
    )


def find_font_folders(names: Sequence[str]) -> list[str]:
    path_by_name = dict(_list_fonts_except_dejavu()) if len(names) > 1 else {}
    font_files = [font_manager.findfont(FONT), *filter(None, map(path_by_name.get, names))]
    return list(dict.fromkeys(str(Path(str(file)).parent) for file in font_files))


def find_missing_characters(text: str) -> str:
    """Return the characters of a text that no installed font contains."""
    return "".join(
        character for character in _find_non_ascii_characters(text) if find_font(character) is None
    )


def format_font_advice(characters: str) -> str:
    listed_characters = shorten_to_line(characters, MAX_LISTED_CHARACTERS)
    return (
        f"No installed font has the characters {listed_characters}; the report shows "
        f"{MISSING_GLYPH_SYMBOL} instead. Install a font with these characters, for "
        "example from fonts.google.com/noto."
    )


def _find_non_ascii_characters(text: str) -> list[str]:
    return [c for c in dict.fromkeys(text) if not c.isascii() and c.isprintable()]


@cache
def _list_fonts_except_dejavu() -> tuple[tuple[str, FontPath], ...]:
    """Return names and paths of installed fonts except DejaVu Sans, in order of preference."""
    manager = font_manager.fontManager
    known_font_paths = {str(entry.fname) for entry in manager.ttflist}
    for path in sorted(set(font_manager.findSystemFonts()) - known_font_paths):
        try:
            manager.addfont(path)
        except (OSError, RuntimeError, NotImplementedError):
            continue  # matplotlib cannot read this font
    entries = [
        entry
        for entry in manager.ttflist
        if entry.style == "normal"
        and not any(word in entry.name.lower() for word in PLACEHOLDER_FONT_WORDS)
    ]
    return tuple(
        (entry.name, FontPath(entry.fname, entry.index))
        for entry in sorted(
            entries,
            # PostScript fonts are last, because some PDF viewers do not display them
            key=lambda entry: (
                entry.fname.lower().endswith(".otf"),
                not entry.name.startswith("Noto Sans"),
                "Sans" not in entry.name,
                entry.name,
                entry.fname,
                entry.index,
            ),
        )
    )


@cache
def _read_font_characters(path: FontPath) -> frozenset[int]:
    return frozenset(font_manager.get_font(path).get_charmap())
