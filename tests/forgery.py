"""Forged reports: one change, everything else as px4fuse wrote it."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import msgspec
from pypdf import PdfReader, PdfWriter
from pypdf.generic import (
    ArrayObject,
    DecodedStreamObject,
    DictionaryObject,
    FloatObject,
    NameObject,
    NumberObject,
)

from px4fuse.core.reading import hash_files
from px4fuse.errors import ResultsError
from px4fuse.results.contract import ReportedResults, to_json
from px4fuse.results.reading import read_results
from px4fuse.verification import verification
from px4fuse.verification.model import Verification
from px4fuse.verification.verification import RecomputedReport, verify

Forge = Callable[[PdfWriter], Any]
Edit = Callable[[bytes], bytes]
Change = Callable[[dict[str, Any]], Any]
ESCAPED = {0x08: b"\\b", 0x09: b"\\t", 0x0A: b"\\n", 0x0C: b"\\f", 0x0D: b"\\r", 0x28: b"\\(",
           0x29: b"\\)", 0x5C: b"\\\\"}  # fmt: skip


def forged(pdf: bytes, *changes: Forge) -> bytes:
    """Return the PDF with changes."""
    writer = PdfWriter(clone_from=io.BytesIO(pdf))
    for change in changes:
        change(writer)
    return pdf_bytes(writer)


def pdf_bytes(writer: PdfWriter) -> bytes:
    """Return the file that a writer contains."""
    out = io.BytesIO()
    writer.write(out)
    return out.getvalue()


def edit_stream(stream: Any, change: Edit) -> DecodedStreamObject:
    """Return a stream with changed content."""
    before = stream.get_data()
    content = change(before)
    assert content != before, "nothing was forged"
    made = DecodedStreamObject()
    made.update(
        {key: held for key, held in stream.items() if key not in ("/Length", "/Filter", "/Params")}
    )
    made.set_data(content)
    return made


def replace_stream(holder: Any, key: str, change: Edit) -> Forge:
    """Replace the stream at a key of a dictionary by a changed one."""

    def forge(writer: PdfWriter) -> None:
        held = holder(writer)
        held[NameObject(key)] = writer._add_object(edit_stream(held[key].get_object(), change))

    return forge


def on_page(number: int, change: Edit) -> Forge:
    return replace_stream(lambda writer: writer.pages[number - 1], "/Contents", change)


def with_results(text: str) -> Forge:
    """Replace the attached results."""

    def forge(writer: PdfWriter) -> None:
        files: Any = writer.root_object["/Names"]["/EmbeddedFiles"]["/Names"]  # type: ignore[index]
        held = files[1].get_object()["/EF"]
        made = writer._add_object(edit_stream(held["/F"].get_object(), lambda _: text.encode()))
        for key in ("/F", "/UF"):
            held[NameObject(key)] = made

    return forge


def font(name: str) -> Callable[[PdfWriter], Any]:
    """Return a function that finds a font of the first page."""

    def find(writer: PdfWriter) -> Any:
        return writer.pages[0]["/Resources"]["/Font"][name].get_object()  # type: ignore[index]

    return find


def glyphs(holder: DictionaryObject) -> dict[str, int]:
    """Return glyph numbers by their characters."""
    names: Any = holder["/ToUnicode"]
    pairs = re.findall(rb"<([0-9a-fA-F]{4})> <([0-9a-fA-F]{4})>\s", names.get_data())
    return {chr(int(letter, 16)): int(glyph, 16) for glyph, letter in pairs}


def text(glyph: int) -> bytes:
    """Encode a glyph number as in a text string."""
    return b"".join(
        ESCAPED.get(byte, bytes([byte]) if 0x20 <= byte < 0x7F else b"\\%03o" % byte)
        for byte in glyph.to_bytes(2, "big")
    )


def entry(key: str, value: Any) -> Callable[[Any], None]:

    def change(holder: Any) -> None:
        holder[NameObject(key)] = NumberObject(value) if isinstance(value, int) else value

    return change


def name(word: str) -> NameObject:
    return NameObject(f"/{word}")


def array(*parts: Any) -> ArrayObject:
    return ArrayObject(parts)


def box(*corners: float) -> ArrayObject:
    return array(*(FloatObject(corner) for corner in corners))


def dictionary(**entries: Any) -> DictionaryObject:
    return DictionaryObject({name(key): value for key, value in entries.items()})


def stream(data: bytes, **entries: Any) -> DecodedStreamObject:
    made = DecodedStreamObject()
    made.update(dictionary(**entries))
    made.set_data(data)
    return made


def catalogue(key: str, value: Any) -> Forge:
    return lambda writer: entry(key, value)(writer.root_object)


def document_info(**entries: str) -> Forge:
    return lambda writer: writer.add_metadata({f"/{key}": held for key, held in entries.items()})


def append_update(pdf: bytes, change: Forge) -> bytes:
    """Append an incremental update, as viewers do."""
    writer = PdfWriter(io.BytesIO(pdf), incremental=True)
    change(writer)
    return pdf_bytes(writer)


# ------------------------------------------------------------------ reports that verify


def set_value(value: Any, *path: Any) -> Change:
    """Set the value at a path in the results; the index after the end of a list appends."""

    def change(results: dict[str, Any]) -> None:
        part: Any = results
        for name in path[:-1]:
            part = part[name]
        if isinstance(part, list) and path[-1] == len(part):
            part.append(value)
        else:
            part[path[-1]] = value

    return change


def read_attached_results(pdf: bytes) -> ReportedResults:
    """Read the attached results without the checks of read_report."""
    return read_results(PdfReader(io.BytesIO(pdf)).attachments["results.json"][0])


def to_dict(report: ReportedResults) -> dict[str, Any]:
    """Convert results to a dictionary that can be changed."""
    made: dict[str, Any] = json.loads(to_json(report))
    return made


def read_again(results: dict[str, Any]) -> ReportedResults:
    """Decode changed results as from a report."""
    return read_results(to_json(results).encode())


RECOMPUTE = verification.recompute_report


def verify_with(
    pdf: bytes,
    files: Mapping[str, Path],
    recompute: Callable[..., RecomputedReport | Verification],
) -> Verification:
    """Verify a report with another function that repeats its analysis."""
    report = read_attached_results(pdf)
    with mock.patch.object(verification, "recompute_report", recompute):
        return verify(report, pdf, files)


@dataclass(frozen=True)
class VerifiedReport:
    """Report that is verified, with its analysis, which is computed once."""

    pdf: bytes
    results: dict[str, Any]
    again: RecomputedReport
    files: Mapping[str, Path]

    def recompute(
        self, results: ReportedResults, logs: Mapping[str, Path]
    ) -> RecomputedReport | Verification:
        """Return the analysis; the stored one if request, student, log and versions are equal."""
        ours, theirs = (
            # the command is derived from the request
            (held.request, held.student, verification.log_sha256(held),
             msgspec.structs.replace(held.provenance, command=""))
            for held in (self.again[0], results)
        )  # fmt: skip
        return self.again if ours == theirs else RECOMPUTE(results, logs)

    def verified(self, pdf: bytes) -> Verification:
        """Verify a forged report with the log."""
        try:
            return verify_with(pdf, self.files, self.recompute)
        except ResultsError as error:  # rejected before verification
            return Verification("cannot verify", (str(error),), with_log=False)

    def with_results(self, results: dict[str, Any]) -> bytes:
        """Return the report with other results attached."""
        return forged(self.pdf, with_results(to_json(results)))


def make_verified_report(pdf: bytes, log: Path) -> VerifiedReport:
    files = hash_files([log])
    again = verification.recompute_report(read_attached_results(pdf), files)
    drawn = again[1]()
    return VerifiedReport(
        drawn, to_dict(read_attached_results(drawn)), (again[0], lambda: drawn), files
    )
