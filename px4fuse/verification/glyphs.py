"""Whether a font embedded in a PDF draws the letters that it says it draws.

A font is code that turns numbers into shapes: with one outline exchanged a page prints another
digit while every text in it stays the same. Where two embedded fonts are not the same bytes (the
subset is another one, or was cut by another version), each glyph in use is compared by itself:
its outline, its hints and its width.
"""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from typing import Any

from fontTools.ttLib import TTFont  # type: ignore[import-untyped]

_HINTS = ("fpgm", "prep", "cvt ")
_RANGE = re.compile(rb"<([0-9a-fA-F]{4})>\s*<([0-9a-fA-F]{4})>\s*(?:\[([^\]]*)\]|<([0-9a-fA-F]+)>)")
_CHARACTER = re.compile(rb"<([0-9a-fA-F]{4})>\s*<([0-9a-fA-F]+)>")
_SECTION = re.compile(rb"begin(bfrange|bfchar)(.*?)end\1", re.DOTALL)
_MAX_CODES = 65_536


@dataclass(frozen=True)
class Font:
    """One embedded TrueType font, as PDF composes it.

    Attributes
    ----------
    text : dict of int to str
        What each code stands for.
    glyph_of : bytes
        Two bytes for each code: the number of its glyph.
    widths : dict of int to float
        Thousandths of an em.
    program : TTFont
    hints : tuple of bytes
        The font's own programs, which may move outlines.
    """

    text: dict[int, str]
    glyph_of: bytes
    widths: dict[int, float]
    program: Any
    hints: tuple[bytes, ...]

    def glyph(self, code: int) -> str:
        """Name of the glyph of a code.

        Raises
        ------
        KeyError
            There is none.
        """
        entry = self.glyph_of[2 * code : 2 * code + 2]
        if len(entry) < 2:
            raise KeyError(code)
        name: str = self.program.getGlyphName(int.from_bytes(entry, "big"))
        return name


def read_font(font: Any, inflate: Any) -> Font:
    """Read a composite font with TrueType outlines.

    Parameters
    ----------
    font : dictionary of pypdf
        Of type ``/Type0``.
    inflate : callable
        Gives the bytes of a stream, within bounds.

    Raises
    ------
    Exception
        Of any kind, where the font is another one or damaged.
    """
    if font["/Subtype"] != "/Type0" or font["/Encoding"] != "/Identity-H":
        raise ValueError("not a font as px4fuse embeds it")
    descendant = font["/DescendantFonts"][0].get_object()
    if descendant["/Subtype"] != "/CIDFontType2":
        raise ValueError("not a TrueType font")
    data = inflate(descendant["/FontDescriptor"]["/FontFile2"])
    program = TTFont(io.BytesIO(data), lazy=True)
    raw = program.reader
    if raw is None:
        raise ValueError("no tables")
    tags = set(raw.keys())
    return Font(
        text=code_texts(inflate(font["/ToUnicode"])),
        glyph_of=inflate(descendant["/CIDToGIDMap"]),
        widths=_widths(descendant["/W"]),
        program=program,
        hints=tuple(raw[tag] if tag in tags else b"" for tag in _HINTS),
    )


def code_texts(cmap: bytes) -> dict[int, str]:
    """Text of each code, from a ToUnicode map.

    >>> code_texts(b"1 beginbfrange <0041> <0042> [<0058> <0059>] endbfrange")
    {65: 'X', 66: 'Y'}
    """
    found: dict[int, str] = {}
    for section in _SECTION.finditer(cmap):
        if section[1] == b"bfchar":
            for match in _CHARACTER.finditer(section[2]):
                found[int(match[1], 16)] = _utf16(match[2])
            continue
        for match in _RANGE.finditer(section[2]):
            first, last = int(match[1], 16), int(match[2], 16)
            if match[3] is not None:
                texts = [_utf16(part) for part in re.findall(rb"<([0-9a-fA-F]+)>", match[3])]
                found |= dict(zip(range(first, last + 1), texts, strict=False))
            else:
                start = int(match[4], 16)
                found |= {code: chr(start + code - first) for code in range(first, last + 1)}
            if len(found) > _MAX_CODES:
                raise ValueError("too many codes")
    return found


def _utf16(digits: bytes) -> str:
    return bytes.fromhex(digits.decode("ascii")).decode("utf-16-be")


def _widths(entries: Any) -> dict[int, float]:
    """Widths of codes, from ``[first [w w w] first [w] ...]``."""
    return {
        int(first) + place: float(width)
        for first, widths in zip(entries[::2], entries[1::2], strict=True)
        for place, width in enumerate(widths.get_object())
    }


def same_glyph(one: Font, one_code: int, other: Font, other_code: int) -> bool:
    """Whether two fonts draw the same for two codes, as wide, and with the same hints."""
    if one.widths.get(one_code) != other.widths.get(other_code) or one.hints != other.hints:
        return False
    if one.program["head"].unitsPerEm != other.program["head"].unitsPerEm:
        return False
    names = one.glyph(one_code), other.glyph(other_code)
    return _same_outline(one.program["glyf"], names[0], other.program["glyf"], names[1])


def _same_outline(one: Any, one_name: str, other: Any, other_name: str) -> bool:
    """Whether two outlines are alike; followed along the parts of the second, which is ours."""
    first, second = one[one_name], other[other_name]
    first.expand(one)
    second.expand(other)
    if first.numberOfContours != second.numberOfContours:
        return False
    if _bytecode(first) != _bytecode(second):
        return False
    if not second.isComposite():
        if second.numberOfContours == 0:
            return True
        return (
            list(first.coordinates) == list(second.coordinates)
            and list(first.endPtsOfContours) == list(second.endPtsOfContours)
            and [flag & 1 for flag in first.flags] == [flag & 1 for flag in second.flags]
        )
    return len(first.components) == len(second.components) and all(
        _placed(part) == _placed(our_part)
        and _same_outline(one, part.glyphName, other, our_part.glyphName)
        for part, our_part in zip(first.components, second.components, strict=True)
    )


def _bytecode(glyph: Any) -> bytes:
    program = getattr(glyph, "program", None)
    return b"" if program is None else bytes(program.getBytecode())


def _placed(part: Any) -> tuple[Any, ...]:
    """Where a composite glyph puts a part."""
    names = ("x", "y", "firstPt", "secondPt", "transform", "flags")
    return tuple(getattr(part, name, None) for name in names)
