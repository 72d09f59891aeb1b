"""Comparison of a handed-in PDF with the report that px4fuse draws again from the log.

Starting from each page, the document information and the catalogue, all objects of both files are
compared pairwise. They have to be equal in keys, names, numbers, texts and decoded streams:
content, fonts with widths, encodings and ToUnicode, bookmarks, structure tree, metadata. Anything
that px4fuse does not write is a difference, so no list of possible forgeries is needed.

Tolerated, because programs that save a PDF again change it: object numbers, compression, the
trailer's ``/ID``, the header, unused objects, the spelling of numbers and strings, ``/Producer``
and dates of the document information, and the same fields and the identifiers of XMP. Tolerated,
because processors differ in the last digits: coordinates by COORDINATE_TOLERANCE_PT, and numbers in
texts if they are roundings of results that are equal within the tolerances. The attached results
are compared as numbers, see :mod:`px4fuse.verification.verification`.
"""

import math
import re
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
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

from px4fuse.results.reading import one_line
from px4fuse.verification.model import PageDifference
from px4fuse.verification.pdf_input import (
    BROKEN_PDF_ERRORS,
    MAX_VALUES,
    PYPDF_LIMITS,
    open_strictly,
)
from px4fuse.workers import JobFailure, run_one_bounded

# maximum difference of coordinates (pt): different OpenBLAS kernels move points by at most 0.07 pt,
# and 0.25 pt is not visible
COORDINATE_TOLERANCE_PT = 0.25
# relative and absolute tolerance of other numbers, because other programs save 32-bit floats
NUMBER_TOLERANCE = 1e-5
# maximum letter distance (1/1000 em) of a text in which a number may differ by rounding
MAX_KERNING = 200.0
# maximum length of submitted over redrawn content: a byte of a string may be written as four bytes
MAX_LENGTH_RATIO = 4
# limits of one comparison, which needs 3 s and 0.3 GB for the largest report
TIMEOUT_S, MEMORY_BYTES = 12.0, 1_000_000_000
MAX_LISTED_DIFFERENCES = 20
# keys that are not compared: compression of streams, and fields that other programs write
_COMPRESSION_KEYS = frozenset(("/Length", "/Filter"))
_WRITER_KEYS = frozenset(("/Producer", "/CreationDate", "/ModDate"))
_XMP_WRITER_FIELDS = re.compile(
    r"<(pdf:Producer|xmp:(?:Create|Modify|Metadata)Date|xmpMM:(?:Document|Instance)ID"
    r"|stEvt:(?:when|instanceID))( [^>]*)?>[^<]*</\1>"
)
MAX_XMP_BYTES = 100_000
# the Typst version is not compared: 0.15.0 and 0.15.2 produce the same pages
_TYPST_VERSION = re.compile(r"Typst \d+(\.\d+)*")
_END_OF_FILE = re.compile(rb"startxref\s+(\d{1,10})\s+%%EOF\s*\Z")
_PART_NAMES = {
    "/AA": "an action",
    "/AcroForm": "form fields",
    "/Annots": "an annotation",
    "/CropBox": "a crop box",
    "/OCProperties": "layers",
    "/OpenAction": "an action",
    "/Outlines": "bookmarks",
    "/Rotate": "a rotation",
    "/UserUnit": "another unit of length",
    "/XObject": "a picture or form",
}
# ISO 32000-1, 7.2 and 7.3: strings, delimiters of dictionaries, names, numbers and operators
_TOKEN = re.compile(
    r"\(((?:[^\\()]|\\.|\((?:[^\\()]|\\.)*+\))*+)\)|<([0-9A-Fa-f]*)>"
    r"|(<<|>>|/?[^\0\t\n\f\r ()<>\[\]{}/%]+|[^\0\t\n\f\r ])",
    re.DOTALL,
)
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)")
_ESCAPE = re.compile(r"\\([0-7]{1,3}|\r\n?|.)|\r\n?", re.DOTALL)
_ESCAPED_CHARACTERS = {
    "n": "\n",
    "r": "\r",
    "t": "\t",
    "b": "\b",
    "f": "\f",
    "\n": "",
    "\r": "",
    "\r\n": "",
}
# operators with coordinates, and index of their first coordinate
_FIRST_COORDINATE = {"m": 0, "l": 0, "c": 0, "v": 0, "y": 0, "re": 0, "cm": 4, "Tm": 4}
_TEXT_OPERATORS = frozenset(("Tj", "TJ"))
# entry of a ToUnicode map: glyph and letters
_TO_UNICODE_ENTRY = re.compile(r"<([0-9A-Fa-f]{4})> <((?:[0-9A-Fa-f]{4})+)>\n")

TextComparison = Callable[[str, str], bool]
# operand of an operation: number, string, or name, bracket and other tokens
Operand = float | bytes | str
Operation = tuple[str, tuple[Operand, ...]]


def compare_pages(
    submitted: bytes, redrawn: bytes, is_same_text: TextComparison
) -> tuple[PageDifference, ...]:
    """Compare a handed-in PDF with the redrawn report, in a process with limits.

    Parameters
    ----------
    submitted : bytes
        A file that :func:`px4fuse.verification.pdf_input.read_report` accepted.
    is_same_text : callable
        Returns True if two texts are equal up to the rounding of a number.

    Returns
    -------
    tuple of PageDifference
        At most MAX_LISTED_DIFFERENCES, in page order; empty if the PDF is as px4fuse writes it. If
        the comparison exceeds its limits, this is the only difference.
    """
    job = (submitted, redrawn, is_same_text)
    differences = run_one_bounded(_compare_pdfs, job, TIMEOUT_S, MEMORY_BYTES)
    if isinstance(differences, JobFailure):
        what = f"not compared within the limits ({differences.reason.rstrip('.')})"
        return (PageDifference(0, what, True),)
    return differences


def _compare_pdfs(job: tuple[bytes, bytes, TextComparison]) -> tuple[PageDifference, ...]:
    submitted, redrawn, is_same_text = job
    try:
        with pypdf.apply_configuration(**PYPDF_LIMITS):
            submitted_pdf, redrawn_pdf = map(open_strictly, (submitted, redrawn))
            walk = _Walk(is_same_text)
            differences = [PageDifference(0, what, True) for what in _ambiguities(submitted)]
            differences += islice(
                walk.differences(submitted_pdf, redrawn_pdf), MAX_LISTED_DIFFERENCES
            )
            producer = (submitted_pdf.metadata or DictionaryObject()).get("/Producer")
            if producer is not None and any(difference.is_structural for difference in differences):
                what = f"another program wrote this file ({one_line(str(producer), 60)})"
                differences.insert(0, PageDifference(0, what, True))
            return tuple(differences)
    except (LimitReachedError, RecursionError, SyntaxError, *BROKEN_PDF_ERRORS) as error:
        what = f"cannot be read ({type(error).__name__})"
        return (PageDifference(0, what, True),)


@dataclass
class _Walk:
    """Pairwise comparison of all objects of two PDFs.

    Attributes
    ----------
    compared : set of tuple
        Compared pairs: object number and generation in the submitted file, number in the redrawn.
    parents : list of tuple
        Parents of pages, which are compared after the catalogue.
    fonts : mapping
        Fonts of the current page, by their names in the content of the page.
    """

    is_same_text: TextComparison
    compared: set[tuple[int, int, int]] = field(default_factory=set)
    parents: list[tuple[Any, Any, str]] = field(default_factory=list)
    fonts: Mapping[str, Any] = field(default_factory=dict)
    steps: int = 0

    def differences(
        self, submitted: pypdf.PdfReader, redrawn: pypdf.PdfReader
    ) -> Iterator[PageDifference]:
        """Yield the differences of pages, document information and catalogue."""
        pages = [_page_references(reader) for reader in (submitted, redrawn)]
        for number, (one, other) in enumerate(zip_longest(*pages), start=1):
            if one is None or other is None:
                what = "missing" if one is None else f"px4fuse draws only {len(pages[1])} pages"
                yield PageDifference(number, what)
                return
            self.fonts = _resolved(other.get_object()["/Resources"].get("/Font", {}))
            yield from self._compare(one, other, "/Page", number)
        for key in ("/Info", "/Root"):
            one, other = (dict.get(reader.trailer, key) for reader in (submitted, redrawn))
            yield from self._compare(one, other, key, 0)
        for one, other, key in self.parents:
            yield from self._compare(one, other, key, 0)
        if "/XRefStm" in submitted.trailer:  # programs differ in the table that they use
            yield PageDifference(0, "a second table of objects", True)

    def _compare(
        self, submitted: Any, redrawn: Any, key: str, page: int
    ) -> Iterator[PageDifference]:
        """Yield the differences of two values and of all that they contain."""
        remaining = [(submitted, redrawn, key)]
        while remaining:
            submitted, redrawn, key = remaining.pop()
            self.steps += 1
            if self.steps > MAX_VALUES:
                raise LimitReachedError("too many values")
            if (
                isinstance(submitted, IndirectObject) and submitted.generation
            ):  # some programs ignore the generation
                yield PageDifference(page, f"{key}: an object of a later generation", True)
            if isinstance(submitted, IndirectObject) and isinstance(redrawn, IndirectObject):
                pair = submitted.idnum, submitted.generation, redrawn.idnum
                if pair in self.compared:
                    continue
                self.compared.add(pair)
            submitted, redrawn = _resolved(submitted), _resolved(redrawn)
            if _kind(submitted) is not _kind(redrawn):
                yield PageDifference(page, f"{key} is of another type", True)
            elif isinstance(redrawn, DictionaryObject):
                yield from self._dictionaries(submitted, redrawn, key, page, remaining)
            elif isinstance(redrawn, ArrayObject):
                if len(submitted) != len(redrawn):
                    what = f"{key} has {len(submitted)} parts; px4fuse writes {len(redrawn)}"
                    yield PageDifference(page, what, True)
                    continue
                pairs = zip(list.__iter__(submitted), list.__iter__(redrawn), strict=True)
                remaining += [(one, other, key) for one, other in pairs][::-1]
            elif not self._is_same_value(submitted, redrawn):
                submitted_text, redrawn_text = (
                    one_line(str(each), 60) for each in (submitted, redrawn)
                )
                yield PageDifference(
                    page, f"{key} is {submitted_text!r}; px4fuse writes {redrawn_text!r}"
                )

    def _dictionaries(
        self,
        submitted: DictionaryObject,
        redrawn: DictionaryObject,
        key: str,
        page: int,
        remaining: list[tuple[Any, Any, str]],
    ) -> Iterator[PageDifference]:
        """Yield the differences of keys and streams; add the values to ``remaining``."""
        submitted_keys, redrawn_keys = (_keys(each, key) for each in (submitted, redrawn))
        for name in sorted(submitted_keys ^ redrawn_keys):
            part_name = _PART_NAMES.get(name, f"an entry {one_line(name, 40)}")
            what = "that px4fuse does not write" if name in submitted_keys else "is missing"
            yield PageDifference(page, f"{part_name} {what}", True)
        for name in sorted(submitted_keys & redrawn_keys, reverse=True):
            pair = submitted.raw_get(name), redrawn.raw_get(name), name
            (self.parents if page and name == "/Parent" else remaining).append(pair)
        if isinstance(submitted, StreamObject) and isinstance(redrawn, StreamObject):
            yield from self._streams(submitted, redrawn, key, page)

    def _is_same_value(self, submitted: Any, redrawn: Any) -> bool:
        if _kind(redrawn) is float:
            return math.isclose(
                submitted, redrawn, rel_tol=NUMBER_TOLERANCE, abs_tol=NUMBER_TOLERANCE
            )
        if (
            _kind(redrawn) is str
            and _TYPST_VERSION.fullmatch(str(submitted))
            and _TYPST_VERSION.fullmatch(str(redrawn))
        ):
            return True
        if _kind(redrawn) is str:
            one, other = (
                str(each) if isinstance(each, str) else each.decode("latin-1")
                for each in (submitted, redrawn)
            )
            return one == other or self.is_same_text(one, other)
        return bool(submitted == redrawn)

    def _streams(
        self, submitted: StreamObject, redrawn: StreamObject, key: str, page: int
    ) -> Iterator[PageDifference]:
        kind = redrawn.get("/Type")
        if kind == "/EmbeddedFile":  # results.json, which intake has read
            return
        filters = _resolved(submitted.get("/Filter"))
        if filters not in (None, "/FlateDecode", ["/FlateDecode"]):  # pypdf does not decode JPEG
            yield PageDifference(page, f"{key} has another compression", True)
            return
        one, other = submitted.get_data(), redrawn.get_data()
        if one == other or (kind == "/Metadata" and _xmp(one) == _xmp(other)):
            return
        if (key != "/Contents" and kind != "/Pattern") or len(one) > MAX_LENGTH_RATIO * len(other):
            yield PageDifference(page, f"{key}: the content differs from px4fuse's")
        elif what := self._describe_operation_difference(one, other):
            yield PageDifference(page, what)

    def _describe_operation_difference(self, submitted: bytes, redrawn: bytes) -> str:
        """Describe the first drawing operation that differs; "" if there is none."""
        operation_lists = [_operations(each) for each in (submitted, redrawn)]
        font = ""
        for number, pair in enumerate(zip_longest(*operation_lists, fillvalue=("", ())), start=1):
            (submitted_operator, submitted_operands), (redrawn_operator, redrawn_operands) = pair
            if redrawn_operator == "Tf":
                font = str(redrawn_operands[0])
            if pair[0] == pair[1] or (
                submitted_operator == redrawn_operator
                and _has_near_operands(submitted_operator, submitted_operands, redrawn_operands)
            ):
                continue
            if {submitted_operator, redrawn_operator} <= _TEXT_OPERATORS:
                texts = [
                    self._text(operands, font)
                    for operands in (submitted_operands, redrawn_operands)
                ]
                max_kerning = max(
                    (abs(each) for each in submitted_operands if isinstance(each, float)),
                    default=0.0,
                )
                if texts[0] != texts[1] and max_kerning < MAX_KERNING and self.is_same_text(*texts):
                    continue
                shortened_texts = [one_line(text, 60) for text in texts]
                return f"text {shortened_texts[0]!r}; px4fuse prints {shortened_texts[1]!r}"
            expected = one_line(redrawn_operator, 9)
            return f"drawing operation {number} differs from px4fuse's ({expected})"
        return ""

    def _text(self, operands: tuple[Operand, ...], font: str) -> str:
        """Decode the text of Tj or TJ with the font's ToUnicode map; ? for unknown glyphs."""
        cmap = self.fonts[font].get_object()["/ToUnicode"].get_data().decode("latin-1")
        letters = {
            int(glyph, 16): bytes.fromhex(text) for glyph, text in _TO_UNICODE_ENTRY.findall(cmap)
        }
        glyphs = b"".join(each for each in operands if isinstance(each, bytes))
        numbers = struct.unpack(f">{len(glyphs) // 2}H", glyphs[: len(glyphs) // 2 * 2])
        return b"".join(letters.get(each, b"\0?") for each in numbers).decode(
            "utf-16-be", "replace"
        )


def _ambiguities(pdf: bytes) -> Iterator[str]:
    """Yield structures of the PDF in which different programs may read different objects."""
    end = _END_OF_FILE.search(pdf[-1024:])
    if end is None:
        yield "bytes after its end"
    elif b"/Linearized" in pdf[:1024]:
        # the end of the file must refer to the first cross-reference table
        begin = pdf.find(b"endobj") + len(b"endobj")
        if pdf[begin : int(end[1])].strip():
            yield "a second table of objects"


def _page_references(reader: pypdf.PdfReader) -> list[Any]:
    """Return references to the pages of a page tree with one level, as px4fuse writes it."""
    tree: Any = reader.root_object["/Pages"]
    return list(list.__iter__(tree["/Kids"]))


def _resolved(value: Any) -> Any:
    return value.get_object() if isinstance(value, IndirectObject) else value


def _kind(value: Any) -> type:
    """Return the type of a PDF value; a name is not a string, a stream not a dictionary."""
    kinds = StreamObject, DictionaryObject, ArrayObject, NameObject
    if isinstance(value, TextStringObject | ByteStringObject):
        return str
    if isinstance(value, int | float):
        return float
    return next((kind for kind in kinds if isinstance(value, kind)), type(value))


def _keys(value: DictionaryObject, key: str) -> set[str]:
    """Return the keys of a dictionary that are compared; a null counts as absent."""
    ignored_keys = set(_COMPRESSION_KEYS) if isinstance(value, StreamObject) else set()
    ignored_keys |= _WRITER_KEYS if key == "/Info" else set()
    ignored_keys |= {"/Params"} if value.get("/Type") == "/EmbeddedFile" else set()
    return {
        each for each in value if not isinstance(value.raw_get(each), NullObject)
    } - ignored_keys


def _xmp(data: bytes) -> str:
    """Return XMP metadata in canonical form, without fields that other programs change."""
    if (
        len(data) > MAX_XMP_BYTES or b"<!" in data
    ):  # document types may contain entities that expand
        return data.decode("latin-1")
    packet = re.sub(r"<\?.*?\?>", "", data.decode("utf-8", "replace"))
    canonical_text = ElementTree.canonicalize(packet.strip(), strip_text=True)
    return _TYPST_VERSION.sub("Typst", _XMP_WRITER_FIELDS.sub("", canonical_text))


def _operations(content: bytes) -> Iterator[Operation]:
    """Parse page content: yield each operator with its operands."""
    operands: list[Operand] = []
    for match in _TOKEN.finditer(content.decode("latin-1")):
        literal, digits, token = match.groups("")
        if not token:
            operands.append(
                bytes.fromhex(digits + "0" * (len(digits) % 2))
                if digits
                else _ESCAPE.sub(_unescaped, literal).encode("latin-1")
            )
        elif _NUMBER.fullmatch(token):
            operands.append(float(token))
        elif token[0] in "/[]<>{}":
            operands.append(token)
        else:
            yield token, tuple(operands)
            operands.clear()
    yield "", tuple(operands)


def _unescaped(match: re.Match[str]) -> str:
    escaped = match[1]
    if escaped is None:  # any end of line
        return "\n"
    if escaped[0] in "01234567":
        return chr(int(escaped, 8) & 255)
    return _ESCAPED_CHARACTERS.get(escaped, escaped)


def _has_near_operands(
    operator: str, submitted: Sequence[Operand], redrawn: Sequence[Operand]
) -> bool:
    """Return True if operands are equal, coordinates within COORDINATE_TOLERANCE_PT."""
    first = _FIRST_COORDINATE.get(operator, len(redrawn))
    return len(submitted) == len(redrawn) and all(
        one == other
        or (
            isinstance(one, float)
            and isinstance(other, float)
            and math.isclose(
                one,
                other,
                rel_tol=NUMBER_TOLERANCE,
                abs_tol=COORDINATE_TOLERANCE_PT if at >= first else NUMBER_TOLERANCE,
            )
        )
        for at, (one, other) in enumerate(zip(submitted, redrawn, strict=True))
    )
