"""Fonts for names and notes in every script: which of this machine draw a text, or what to install.

Typst shapes text, so that Arabic joins, Devanagari orders and Thai stacks as they should. What it
needs is a font that has the characters.
"""

from functools import cache
from pathlib import Path

from matplotlib import font_manager
from matplotlib.font_manager import FontEntry, FontPath

from px4fuse.report import say

# Matplotlib's own, always there: Latin, Greek, Cyrillic, Arabic, Hebrew and symbols
FONT = "DejaVu Sans"
# These have a box for every character
BOX_FONTS = ("lastresort", "last resort", "blank", "notdef")
NO_GLYPH = "\N{WHITE SQUARE}"
MAX_SHOWN = 12


@cache
def font_of(character: str) -> str | None:
    """The font that draws a character: DejaVu Sans, else the first of the machine that has it."""
    if ord(character) in _characters(font_manager.findfont(FONT)):
        return FONT
    return next(
        (name for name, path in _other_fonts() if ord(character) in _characters(path)), None
    )


def font_names(text: str) -> list[str]:
    """Fonts that draw a text, DejaVu Sans first."""
    names = [font_of(character) for character in _non_ascii(text)]
    return list(dict.fromkeys([FONT, *(name for name in names if name is not None)]))


def font_folders(names: tuple[str, ...]) -> list[str]:
    """Folders that hold the files of some fonts."""
    paths = {name: path for name, path in _other_fonts() if name in names} if len(names) > 1 else {}
    font_files = [font_manager.findfont(FONT), *paths.values()]
    return list(dict.fromkeys(str(Path(str(path)).parent) for path in font_files))


def missing_characters(text: str) -> str:
    """Characters of a text that no font of this machine has, each once."""
    return "".join(character for character in _non_ascii(text) if font_of(character) is None)


def font_advice(characters: str) -> str:
    """What to install for :func:`missing_characters` characters, as one sentence or two."""
    shown = characters[:MAX_SHOWN] + ("…" if len(characters) > MAX_SHOWN else "")
    return say("install_font", shown=shown, sign=NO_GLYPH)


def _non_ascii(text: str) -> list[str]:
    return [c for c in dict.fromkeys(text) if not c.isascii() and c.isprintable()]


@cache
def _other_fonts() -> tuple[tuple[str, FontPath], ...]:
    """Every other font of the machine, also those newer than matplotlib's own list."""
    manager = font_manager.fontManager
    known = {str(entry.fname) for entry in manager.ttflist}
    for path in sorted(set(font_manager.findSystemFonts()) - known):
        try:
            manager.addfont(path)
        except (OSError, RuntimeError, NotImplementedError):
            continue  # what matplotlib cannot read draws nothing
    entries = [
        entry
        for entry in manager.ttflist
        if entry.style == "normal" and not any(word in entry.name.lower() for word in BOX_FONTS)
    ]
    return tuple(
        (entry.name, FontPath(entry.fname, entry.index)) for entry in sorted(entries, key=_sort_key)
    )


def _sort_key(entry: FontEntry) -> tuple[object, ...]:
    """Those of Noto first, then without serifs, then the most regular.

    Those with PostScript outlines come late: they are embedded as if they were TrueType, and not
    every viewer forgives that.
    """
    weight = entry.weight if isinstance(entry.weight, int) else 400
    postscript = str(entry.fname).lower().endswith(".otf")
    noto, sans = entry.name.startswith("Noto Sans"), "Sans" in entry.name
    return (
        postscript,
        not noto,
        not sans,
        abs(weight - 400),
        entry.name,
        str(entry.fname),
        entry.index,
    )


@cache
def _characters(path: FontPath) -> frozenset[int]:
    return frozenset(font_manager.get_font(path).get_charmap())
