"""Comparison of a submitted PDF with the report that px4fuse recomputes from the log ("redrawn").

All objects of both files are compared pairwise. Two kinds of differences are tolerated:

- Changes of programs that save a PDF again: object numbers, compression and program names.
- Different last digits on other processors: coordinates, and printed numbers.
"""

import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import islice, zip_longest
from typing import Any
from xml.etree import ElementTree

import pypdf
from pypdf.errors import LimitReachedError
from pypdf.generic import (
    ArrayObject,
    ByteStringObject,
    DictionaryObject,
    IndirectObject,
    NameObject,
    NullObject,
    StreamObject,
    TextStringObject,
)

from px4fuse.core.text import shorten_to_line
from px4fuse.core.workers import JobFailure, run_one_with_limits

from .model import PageDifference
from .pdf_input import (
    BROKEN_PDF_ERRORS,
    MAX_PDF_VALUES,
    PYPDF_LIMITS,
    open_strictly,
    resolve_reference,
)

# Tolerance (pt) of coordinates; different processors move points by at most 0.07 pt
COORDINATE_TOLERANCE_PT = 0.25
# Tolerance of PDF numbers except coordinates: programs may save 32-bit floats
PDF_NUMBER_TOLERANCE = 1e-5
# A text in a submitted PDF may contain a number with another last digit, due to rounding. The
# kerning of this text must be below the limit (1/1000 em), because a large kerning could move
# digits to other places
MAX_KERNING_PER_MILLE_EM = 200.0
# Maximum size of a page's content in the submitted PDF ÷ in the redrawn PDF (generated again by
# px4fuse). Escape sequences need four bytes per character
MAX_SIZE_RATIO_TO_REDRAWN_PAGE = 4
# Maximum time (s) for comparing two PDFs; the comparison of the largest report takes 3 s
PDF_COMPARISON_TIMEOUT_S = 12.0
# Maximum memory (bytes) for comparing two PDFs; the largest report needs 0.3 GB
MAX_MEMORY_BYTES = 1_000_000_000
MAX_LISTED_DIFFERENCES = 20
SECOND_XREF_TABLE_REASON = (
    "the PDF was changed after px4fuse wrote it (second cross-reference table)"
)
# PDF dictionary keys that are not compared, because programs that save a PDF change them
_COMPRESSION_AND_LENGTH_KEYS = {"/Length", "/Filter"}
_WRITER_KEYS = {"/Producer", "/CreationDate", "/ModDate"}
_XMP_WRITER_FIELDS = re.compile(r"<(\w+:(?:Producer|\w+Date|\w+ID|when))( [^<>]*)?>[^<]*</\1>")
MAX_XMP_BYTES = 100_000
# Typst version in the PDF; not compared, because different versions produce equal pages
_TYPST_VERSION_PATTERN = re.compile(r"Typst \d+(\.\d+)*")
_END_OF_FILE_PATTERN = re.compile(rb"startxref\s+(\d{1,10})\s+%%EOF\s*\Z")
# Tokens of PDF page content (ISO 32000-1, 7.2 and 7.3): strings, hexadecimal strings, and others
_TOKEN_PATTERN = re.compile(
    r"\(((?:[^\\()]|\\.|\((?:[^\\()]|\\.)*+\))*+)\)|<([0-9A-Fa-f]*)>"
    r"|(<<|>>|/?[^\0\t\n\f\r ()<>\[\]{}/%]+|[^\0\t\n\f\r ])",
    re.DOTALL,
)
_NUMBER_PATTERN = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)")
_ESCAPE_PATTERN = re.compile(r"\\([0-7]{1,3}|\r\n?|.)|\r\n?", re.DOTALL)
_ESCAPED_CHARACTERS = dict.fromkeys(("\n", "\r", "\r\n"), "") | dict(
    zip("nrtbf", "\n\r\t\b\f", strict=True)
)
# PDF drawing operators with coordinates: index of the first operand that is a coordinate
_FIRST_COORDINATE_INDEX = {"m": 0, "l": 0, "c": 0, "v": 0, "y": 0, "re": 0, "cm": 4, "Tm": 4}
_TEXT_OPERATORS = {"Tj", "TJ"}
# Entry of a font's ToUnicode map: glyph number and UTF-16 text, in hexadecimal digits
_TO_UNICODE_ENTRY_PATTERN = re.compile(r"<([0-9A-Fa-f]{4})> <((?:[0-9A-Fa-f]{4})+)>\n")

TextComparison = Callable[[str, str], bool]
# Operand of a PDF drawing operation: number, string, or another token (name or bracket)
Operand = float | bytes | str
Operation = tuple[str, tuple[Operand, ...]]
# Value in the submitted PDF, value in the redrawn PDF (generated again by px4fuse), and their key
_ValuePair = tuple[Any, Any, str]
# Description of a difference, and True (_STRUCTURAL_DIFFERENCE) for added or missing PDF objects
_PdfDifference = tuple[str, bool]
_STRUCTURAL_DIFFERENCE, _CONTENT_DIFFERENCE = True, False


def compare_pages(
    submitted_pdf: bytes, redrawn_pdf: bytes, is_same_text: TextComparison
) -> tuple[PageDifference, ...]:
    """Compare two PDFs in a process with limits of time and memory.

    ``is_same_text`` returns True if two texts are equal up to the rounding of numbers.
    """
    differences = run_one_with_limits(
        _compare_pdfs,
        (submitted_pdf, redrawn_pdf, is_same_text),
        PDF_COMPARISON_TIMEOUT_S,
        MAX_MEMORY_BYTES,
    )
    if not isinstance(differences, JobFailure):
        return differences
    reason = differences.reason.rstrip(".")
    return (
        PageDifference(
            0, f"the PDF pages could not be compared with the recomputed report ({reason})", True
        ),
    )


def _compare_pdfs(job: tuple[bytes, bytes, TextComparison]) -> tuple[PageDifference, ...]:
    """Compare two PDFs, and return at most MAX_LISTED_DIFFERENCES differences of values."""
    submitted_bytes, redrawn_bytes, is_same_text = job
    try:
        with pypdf.apply_configuration(**PYPDF_LIMITS):
            submitted_pdf, redrawn_pdf = map(open_strictly, (submitted_bytes, redrawn_bytes))
            page_differences = _PdfComparison(is_same_text).find_differences(
                submitted_pdf, redrawn_pdf
            )
            differences = [
                *_find_ambiguities(submitted_bytes),
                *islice(page_differences, MAX_LISTED_DIFFERENCES),
            ]
            producer = (submitted_pdf.metadata or DictionaryObject()).get("/Producer")
            if producer is not None and any(difference.is_structural for difference in differences):
                program = shorten_to_line(str(producer), 60)
                description = f"another program wrote this file ({program})"
                differences.insert(0, PageDifference(0, description, True))
            return tuple(differences)
    except (LimitReachedError, RecursionError, SyntaxError, *BROKEN_PDF_ERRORS) as error:
        return (PageDifference(0, f"the PDF cannot be read ({type(error).__name__})", True),)


@dataclass
class _PdfComparison:
    """Pairwise comparison of all objects of two PDFs."""

    is_same_text: TextComparison
    # pairs of PDF objects that are already compared: object number and generation in the submitted
    # PDF, and object number in the redrawn PDF
    compared_objects: set[tuple[int, int, int]] = field(default_factory=set)
    # stack of PDF value pairs that are still to be compared: usually a page, and the values nested
    # in it
    pairs_to_compare: list[_ValuePair] = field(default_factory=list)
    # pairs of PDF values that are compared after all pages: document information, catalogue, and
    # parents of pages
    deferred_pairs: list[_ValuePair] = field(default_factory=list)
    # fonts of the current page by name
    fonts: Mapping[str, Any] = field(default_factory=dict)
    # limited, because a malicious PDF may contain millions of values
    pdf_value_count: int = 0

    def find_differences(
        self, submitted_pdf: pypdf.PdfReader, redrawn_pdf: pypdf.PdfReader
    ) -> Iterator[PageDifference]:
        """Yield the differences of pages, document information and catalogue."""
        pages = [_get_page_references(reader) for reader in (submitted_pdf, redrawn_pdf)]
        # document information and catalogue; dict.get does not resolve the references
        self.deferred_pairs = [
            (dict.get(submitted_pdf.trailer, key), dict.get(redrawn_pdf.trailer, key), key)
            for key in ("/Info", "/Root")
        ]
        for page_number, (submitted_page, redrawn_page) in enumerate(zip_longest(*pages), start=1):
            if submitted_page is None or redrawn_page is None:
                yield PageDifference(
                    page_number,
                    f"the PDF has {len(pages[0])} pages; the recomputed report has {len(pages[1])}",
                )
                return
            self.fonts = resolve_reference(redrawn_page.get_object()["/Resources"].get("/Font", {}))
            for difference in self._compare((submitted_page, redrawn_page, "/Page")):
                yield PageDifference(page_number, *difference)
        # compare document information, catalogue and parents of pages last. The comparison of the
        # catalogue may append further parents to the list
        for pair in self.deferred_pairs:
            for difference in self._compare(pair):
                yield PageDifference(0, *difference)
        # programs for PDF 1.4 ignore /XRefStm, and could display other pages
        if "/XRefStm" in submitted_pdf.trailer:
            yield PageDifference(0, SECOND_XREF_TABLE_REASON, _STRUCTURAL_DIFFERENCE)

    def _compare(self, pair: _ValuePair) -> Iterator[_PdfDifference]:
        """Yield the differences of two PDF values, including nested values."""
        # a stack instead of recursion: lists and dictionaries add the pairs of their elements, the
        # last element first, and the loop compares the newest pair
        self.pairs_to_compare = [pair]
        while self.pairs_to_compare:
            submitted_value, redrawn_value, key = self.pairs_to_compare.pop()
            self.pdf_value_count += 1
            if self.pdf_value_count > MAX_PDF_VALUES:
                raise LimitReachedError(f"the PDF contains more than {MAX_PDF_VALUES} values")
            if isinstance(submitted_value, IndirectObject):
                if submitted_value.generation:
                    # programs that ignore generation numbers would display another object
                    yield f"another program changed the PDF entry {key}", _STRUCTURAL_DIFFERENCE
                if isinstance(redrawn_value, IndirectObject):
                    # objects may refer to each other in a cycle, so each pair is compared once
                    object_ids = (
                        submitted_value.idnum,
                        submitted_value.generation,
                        redrawn_value.idnum,
                    )
                    if object_ids in self.compared_objects:
                        continue
                    self.compared_objects.add(object_ids)
            submitted_value = resolve_reference(submitted_value)
            redrawn_value = resolve_reference(redrawn_value)
            if _pdf_type_of(submitted_value) is not _pdf_type_of(redrawn_value):
                yield f"the PDF entry {key} has a wrong type", _STRUCTURAL_DIFFERENCE
            elif isinstance(redrawn_value, DictionaryObject):
                yield from self._compare_dictionaries(submitted_value, redrawn_value, key)
            elif isinstance(redrawn_value, ArrayObject):
                if len(submitted_value) != len(redrawn_value):
                    yield (
                        f"the PDF array {key} has {len(submitted_value)} elements; px4fuse "
                        f"wrote {len(redrawn_value)}",
                        _STRUCTURAL_DIFFERENCE,
                    )
                    continue
                # list.__iter__ does not resolve references to other PDF objects
                elements = zip(*map(list.__iter__, (submitted_value, redrawn_value)), strict=True)
                # the last pair of pairs_to_compare is compared first
                self.pairs_to_compare += reversed([(*pair, key) for pair in elements])
            elif not self._is_same_value(submitted_value, redrawn_value):
                submitted_text = shorten_to_line(str(submitted_value), 60)
                redrawn_text = shorten_to_line(str(redrawn_value), 60)
                yield (
                    f"the PDF entry {key} was changed to {submitted_text!r}; px4fuse wrote "
                    f"{redrawn_text!r}",
                    _CONTENT_DIFFERENCE,
                )

    def _compare_dictionaries(
        self, submitted_dictionary: Any, redrawn_dictionary: DictionaryObject, key: str
    ) -> Iterator[_PdfDifference]:
        """Yield the differences in keys and streams of two PDF dictionaries.

        The values of their common keys are not compared here. The pairs of values are added to
        ``pairs_to_compare``, or to ``deferred_pairs``, which is compared after all pages.
        """
        submitted_keys = _select_compared_keys(submitted_dictionary, key)
        redrawn_keys = _select_compared_keys(redrawn_dictionary, key)
        for name in sorted(submitted_keys ^ redrawn_keys):
            if name in submitted_keys:
                yield (
                    f"the PDF contains an entry {shorten_to_line(name, 40)}, which px4fuse does "
                    "not write",
                    _STRUCTURAL_DIFFERENCE,
                )
            else:
                yield f"the PDF lacks an entry {shorten_to_line(name, 40)}", _STRUCTURAL_DIFFERENCE
        # the last pair of pairs_to_compare is compared first
        for name in sorted(submitted_keys & redrawn_keys, reverse=True):
            # /Parent of a page refers to all other pages, so it is compared after all pages
            (self.deferred_pairs if name == "/Parent" else self.pairs_to_compare).append(
                (submitted_dictionary.raw_get(name), redrawn_dictionary.raw_get(name), name)
            )
        if isinstance(redrawn_dictionary, StreamObject):
            yield from self._compare_streams(submitted_dictionary, redrawn_dictionary, key)

    def _is_same_value(self, submitted_value: Any, redrawn_value: Any) -> bool:
        """Return True if two PDF values of the same simple type are equal."""
        if _pdf_type_of(redrawn_value) is float:
            return math.isclose(
                submitted_value,
                redrawn_value,
                rel_tol=PDF_NUMBER_TOLERANCE,
                abs_tol=PDF_NUMBER_TOLERANCE,
            )
        if _pdf_type_of(redrawn_value) is not str:
            return bool(submitted_value == redrawn_value)
        texts = [
            str(value) if isinstance(value, str) else value.decode("latin-1")
            for value in (submitted_value, redrawn_value)
        ]
        return all(map(_TYPST_VERSION_PATTERN.fullmatch, texts)) or self.is_same_text(*texts)

    def _compare_streams(
        self, submitted_stream: StreamObject, redrawn_stream: StreamObject, key: str
    ) -> Iterator[_PdfDifference]:
        """Yield the difference in the content of two PDF streams, after decompression."""
        stream_type = redrawn_stream.get("/Type")
        if stream_type == "/EmbeddedFile":  # attached results: compared in verification.py
            return
        filters = resolve_reference(submitted_stream.get("/Filter"))
        if filters not in (None, "/FlateDecode", ["/FlateDecode"]):  # pypdf does not decode JPEG
            yield f"the compression of the PDF entry {key} is not supported", _STRUCTURAL_DIFFERENCE
            return
        submitted_data, redrawn_data = submitted_stream.get_data(), redrawn_stream.get_data()
        if submitted_data == redrawn_data or (
            stream_type == "/Metadata"
            and _normalise_xmp_metadata(submitted_data) == _normalise_xmp_metadata(redrawn_data)
        ):
            return
        is_page_content = key == "/Contents" or stream_type == "/Pattern"
        if not is_page_content or len(submitted_data) > MAX_SIZE_RATIO_TO_REDRAWN_PAGE * len(
            redrawn_data
        ):
            yield f"the content of the PDF entry {key} was changed", _CONTENT_DIFFERENCE
        elif description := self._describe_operation_difference(submitted_data, redrawn_data):
            yield description, _CONTENT_DIFFERENCE

    def _describe_operation_difference(
        self, submitted_content: bytes, redrawn_content: bytes
    ) -> str:
        """Describe the first drawing operation that differs; "" if all are equal."""
        operation_lists = map(_parse_drawing_operations, (submitted_content, redrawn_content))
        font_name = ""
        for number, (submitted, redrawn) in enumerate(
            zip_longest(*operation_lists, fillvalue=("", ())), start=1
        ):
            submitted_operator, submitted_operands = submitted
            redrawn_operator, redrawn_operands = redrawn
            # Tf selects the font of the next texts
            if redrawn_operator == "Tf":
                font_name = str(redrawn_operands[0])
            if _is_same_operation(submitted, redrawn):
                continue
            if not {submitted_operator, redrawn_operator} <= _TEXT_OPERATORS:
                operator_text = shorten_to_line(redrawn_operator, 9)
                return f"PDF drawing operation {number} ({operator_text}) was changed"
            submitted_text = self._decode_text(submitted_operands, font_name)
            redrawn_text = self._decode_text(redrawn_operands, font_name)
            # the operator TJ prints several strings, and a number between two strings (kerning)
            # moves the second string
            kerning = [abs(value) for value in submitted_operands if isinstance(value, float)]
            # a different text is tolerated only if a number was rounded to another last digit. If
            # the texts are equal, only the kerning differs, which is not tolerated
            if (
                submitted_text == redrawn_text
                or max(kerning, default=0.0) >= MAX_KERNING_PER_MILLE_EM
                or not self.is_same_text(submitted_text, redrawn_text)
            ):
                return (
                    f"the PDF contains the text {shorten_to_line(submitted_text, 60)!r}; px4fuse "
                    "prints "
                    f"{shorten_to_line(redrawn_text, 60)!r}"
                )
        return ""

    def _decode_text(self, operands: tuple[Operand, ...], font: str) -> str:
        """Decode a PDF text (operator Tj or TJ) with the ToUnicode map of its font."""
        to_unicode_map = self.fonts[font].get_object()["/ToUnicode"].get_data().decode("latin-1")
        text_by_glyph = {
            bytes.fromhex(glyph): bytes.fromhex(utf16_text)
            for glyph, utf16_text in _TO_UNICODE_ENTRY_PATTERN.findall(to_unicode_map)
        }
        glyph_bytes = b"".join(operand for operand in operands if isinstance(operand, bytes))
        utf16_text = b"".join(
            text_by_glyph.get(glyph_bytes[start : start + 2], b"\0?")
            for start in range(0, len(glyph_bytes), 2)
        )
        return utf16_text.decode("utf-16-be", "replace")


def _find_ambiguities(pdf: bytes) -> Iterator[PageDifference]:
    """Yield each file structure that PDF programs may interpret differently."""
    end_match = _END_OF_FILE_PATTERN.search(pdf[-1024:])
    if end_match is None:
        yield PageDifference(
            0, "the file has bytes after the end of the PDF", _STRUCTURAL_DIFFERENCE
        )
    elif b"/Linearized" in pdf[:1024]:
        # in a linearised PDF (ISO 32000-1, annex F), the cross-reference table follows the first
        # object, and the end of the file states its position ("startxref"). If both positions
        # differ, there are two tables, and the second could replace pages
        first_object_end = pdf.find(b"endobj") + len(b"endobj")
        stated_xref_table_start = int(end_match[1])
        if pdf[first_object_end:stated_xref_table_start].strip():
            yield PageDifference(0, SECOND_XREF_TABLE_REASON, _STRUCTURAL_DIFFERENCE)


def _get_page_references(reader: pypdf.PdfReader) -> list[Any]:
    """Return references to the pages of a report, whose page tree has one level."""
    page_tree: Any = reader.root_object["/Pages"]
    return [*list.__iter__(page_tree["/Kids"])]


def _pdf_type_of(value: Any) -> type:
    """Return the type of a PDF value: string, number, stream, dictionary, array or name."""
    if isinstance(value, TextStringObject | ByteStringObject):
        return str
    if isinstance(value, int | float):
        return float
    pdf_types = StreamObject, DictionaryObject, ArrayObject, NameObject
    return next((pdf_type for pdf_type in pdf_types if isinstance(value, pdf_type)), type(value))


def _select_compared_keys(value: DictionaryObject, key: str) -> set[str]:
    """Return the keys of a PDF dictionary that are compared."""
    compared_keys = {name for name in value if not isinstance(value.raw_get(name), NullObject)}
    if isinstance(value, StreamObject):
        compared_keys -= _COMPRESSION_AND_LENGTH_KEYS
    if key == "/Info":
        compared_keys -= _WRITER_KEYS
    # ignore dates and size of an attachment: its content is compared
    return compared_keys - {"/Params"} if value.get("/Type") == "/EmbeddedFile" else compared_keys


def _normalise_xmp_metadata(xmp_bytes: bytes) -> str:
    """Return XMP metadata in canonical form, without the fields that differ between programs."""
    # do not parse a document type ("<!"): its entities may expand to huge texts
    if len(xmp_bytes) > MAX_XMP_BYTES or b"<!" in xmp_bytes:
        return xmp_bytes.decode("latin-1")
    xmp_text = re.sub(r"<\?.*?\?>", "", xmp_bytes.decode("utf-8", "replace"))
    canonical_text = ElementTree.canonicalize(xmp_text.strip(), strip_text=True)
    return _TYPST_VERSION_PATTERN.sub("Typst", _XMP_WRITER_FIELDS.sub("", canonical_text))


def _parse_drawing_operations(content: bytes) -> Iterator[Operation]:
    """Parse the content of a PDF page into drawing operators with their operands."""
    operands: list[Operand] = []
    for match in _TOKEN_PATTERN.finditer(content.decode("latin-1")):
        # a literal string "(...)", a hexadecimal string "<...>", or another token
        string_text, hex_digits, token = match.groups("")
        if not token:
            operands.append(
                bytes.fromhex(hex_digits + "0" * (len(hex_digits) % 2))
                if hex_digits
                else _ESCAPE_PATTERN.sub(_unescape, string_text).encode("latin-1")
            )
        elif _NUMBER_PATTERN.fullmatch(token):
            operands.append(float(token))
        elif token[0] in "/[]<>{}":
            operands.append(token)
        else:
            yield token, tuple(operands)
            operands.clear()
    # return operands after the last operator too, so that they are compared
    yield "", tuple(operands)


def _unescape(match: re.Match[str]) -> str:
    escaped_characters = match[1]
    if escaped_characters is None:  # each end of line in a PDF string means a line feed
        return "\n"
    if escaped_characters[0] in "01234567":
        return chr(int(escaped_characters, 8) & 255)
    return _ESCAPED_CHARACTERS.get(escaped_characters, escaped_characters)


def _is_same_operation(submitted: Operation, redrawn: Operation) -> bool:
    """Return True if two PDF drawing operations are equal within the tolerances."""
    if submitted == redrawn:
        return True
    operator, redrawn_operands = redrawn
    if submitted[0] != operator or len(submitted[1]) != len(redrawn_operands):
        return False
    first_coordinate_operand_index = _FIRST_COORDINATE_INDEX.get(operator, len(redrawn_operands))
    for index, (submitted_operand, redrawn_operand) in enumerate(
        zip(submitted[1], redrawn_operands, strict=True)
    ):
        if submitted_operand == redrawn_operand:
            continue
        if not isinstance(submitted_operand, float) or not isinstance(redrawn_operand, float):
            return False
        is_coordinate = index >= first_coordinate_operand_index
        tolerance = COORDINATE_TOLERANCE_PT if is_coordinate else PDF_NUMBER_TOLERANCE
        if not math.isclose(
            submitted_operand, redrawn_operand, rel_tol=PDF_NUMBER_TOLERANCE, abs_tol=tolerance
        ):
            return False
    return True
