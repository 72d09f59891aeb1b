"""Reports forged with care: one thing changed, everything else as px4fuse wrote it."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from typing import Any

from pypdf import PdfWriter
from pypdf.generic import DecodedStreamObject, DictionaryObject, NameObject, NumberObject

Forge = Callable[[PdfWriter], Any]
Edit = Callable[[bytes], bytes]
SEAL = re.compile(rb"%px4fuse-sha256 [0-9a-f]{64}\n\Z")
ESCAPED = {0x08: b"\\b", 0x09: b"\\t", 0x0A: b"\\n", 0x0C: b"\\f", 0x0D: b"\\r", 0x28: b"\\(",
           0x29: b"\\)", 0x5C: b"\\\\"}  # fmt: skip


def forged(pdf: bytes, *changes: Forge) -> bytes:
    """The file with something changed in it, without a seal."""
    writer = PdfWriter(clone_from=io.BytesIO(pdf))
    for change in changes:
        change(writer)
    out = io.BytesIO()
    writer.write(out)
    return out.getvalue()


def seal(pdf: bytes) -> bytes:
    found = SEAL.search(pdf)
    assert found is not None
    return found[0]


def edited(stream: Any, change: Edit) -> DecodedStreamObject:
    """A stream with other content."""
    before = stream.get_data()
    content = change(before)
    assert content != before, "nothing was forged"
    made = DecodedStreamObject()
    made.update(
        {key: held for key, held in stream.items() if key not in ("/Length", "/Filter", "/Params")}
    )
    made.set_data(content)
    return made


def replaced(holder: Any, key: str, change: Edit) -> Forge:
    """Another stream in place of the one that a dictionary holds."""

    def forge(writer: PdfWriter) -> None:
        held = holder(writer)
        held[NameObject(key)] = writer._add_object(edited(held[key].get_object(), change))

    return forge


def on_page(number: int, change: Edit) -> Forge:
    """What a page draws, changed."""
    return replaced(lambda writer: writer.pages[number - 1], "/Contents", change)


def with_results(text: str) -> Forge:
    """Other results attached."""

    def forge(writer: PdfWriter) -> None:
        files: Any = writer.root_object["/Names"]["/EmbeddedFiles"]["/Names"]  # type: ignore[index]
        held = files[1].get_object()["/EF"]
        made = writer._add_object(edited(held["/F"].get_object(), lambda _: text.encode()))
        for key in ("/F", "/UF"):
            held[NameObject(key)] = made

    return forge


def font(name: str) -> Callable[[PdfWriter], Any]:
    """A font of the first page."""

    def find(writer: PdfWriter) -> Any:
        return writer.pages[0]["/Resources"]["/Font"][name].get_object()  # type: ignore[index]

    return find


def glyphs(holder: DictionaryObject) -> dict[str, int]:
    """Numbers of the glyphs by the letters that they stand for."""
    names: Any = holder["/ToUnicode"]
    pairs = re.findall(rb"<([0-9a-fA-F]{4})> <([0-9a-fA-F]{4})>\s", names.get_data())
    return {chr(int(letter, 16)): int(glyph, 16) for glyph, letter in pairs}


def text(glyph: int) -> bytes:
    """A glyph as it is written in a text."""
    return b"".join(
        ESCAPED.get(byte, bytes([byte]) if 0x20 <= byte < 0x7F else b"\\%03o" % byte)
        for byte in glyph.to_bytes(2, "big")
    )


def entry(key: str, value: Any) -> Callable[[Any], None]:
    """Put an entry into a dictionary."""

    def change(holder: Any) -> None:
        holder[NameObject(key)] = NumberObject(value) if isinstance(value, int) else value

    return change
