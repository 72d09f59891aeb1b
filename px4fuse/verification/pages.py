"""Comparison of a handed-in PDF with the report that px4fuse draws again from the log.

Both files are walked in parallel from each page, the document information and the catalogue. They
have to be equal in keys, names, numbers, texts and decoded streams: content, fonts with widths,
encodings and ToUnicode, bookmarks, structure tree, metadata. This is an allow-list: whatever
px4fuse does not write is a difference, without a list of what a forger may add.

Tolerated, because programs that save a PDF again change it: object numbers, compression, the
trailer's ``/ID``, the header, unused objects, the spelling of numbers and strings, ``/Producer``
and dates of the document information, and the same fields and the identifiers of XMP. Tolerated,
because processors differ in the last digits: coordinates by COORDINATE_PT, and numbers in texts
that are the rounded twins of numbers in the results. The attached results are compared as numbers,
see :mod:`px4fuse.verification.verification`.
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
from px4fuse.verification.pdf_input import BROKEN_PDF_ERRORS, MAX_VALUES, PYPDF_LIMITS, opened
from px4fuse.workers import JobFailure, run_one_bounded

# pt; tolerance of coordinates. Other kernels of OpenBLAS move points by at most 0.07; 0.25 is not
# visible
COORDINATE_PT = 0.25
# relative tolerance of other numbers: programs that save a PDF again write 32-bit floats
NUMBER = 1e-5
# 1/1000 em; largest letter distance in texts whose numbers may be rounded differently
KERNING = 200.0
# factor on the length of content: each byte of a string may be an escape sequence of four
SPELLING = 4
# limits of one comparison, which needs 3 s and 0.3 GB for the largest report
TIMEOUT_S, MEMORY_BYTES = 12.0, 1_000_000_000
# number of differences that are listed
MAX_FOUND = 20
# not compared: compression of streams, and document information that other programs write
_PACKED = frozenset(("/Length", "/Filter"))
_STAMPS = frozenset(("/Producer", "/CreationDate", "/ModDate"))
_XMP_STAMPS = re.compile(
    r"<(pdf:Producer|xmp:(?:Create|Modify|Metadata)Date|xmpMM:(?:Document|Instance)ID"
    r"|stEvt:(?:when|instanceID))( [^>]*)?>[^<]*</\1>"
)
MAX_XMP_BYTES = 100_000
# the Typst version is not compared: 0.15.0 and 0.15.2 produce the same pages
_TYPST = re.compile(r"Typst \d+(\.\d+)*")
_END = re.compile(rb"startxref\s+(\d{1,10})\s+%%EOF\s*\Z")
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
_ESCAPED = {"n": "\n", "r": "\r", "t": "\t", "b": "\b", "f": "\f", "\n": "", "\r": "", "\r\n": ""}
# operators with coordinates, and index of their first coordinate
_COORDINATES = {"m": 0, "l": 0, "c": 0, "v": 0, "y": 0, "re": 0, "cm": 4, "Tm": 4}
_TEXT = frozenset(("Tj", "TJ"))
# entry of a ToUnicode map: glyph and letters
_LETTERS = re.compile(r"<([0-9A-Fa-f]{4})> <((?:[0-9A-Fa-f]{4})+)>\n")

WordsAlike = Callable[[str, str], bool]
# operand of an operation: number, string, or name, bracket and other tokens
Operand = float | bytes | str
Operation = tuple[str, tuple[Operand, ...]]


def compare_pages(
    submitted: bytes, redrawn: bytes, words_alike: WordsAlike
) -> tuple[PageDifference, ...]:
    """Compare a handed-in PDF with the redrawn report, in a process with limits.

    Parameters
    ----------
    submitted : bytes
        A file that :func:`px4fuse.verification.pdf_input.read_report` accepted.
    words_alike : callable
        Returns True if two texts are equal up to the rounding of a number.

    Returns
    -------
    tuple of PageDifference
        At most MAX_FOUND, in page order; empty if the PDF is what px4fuse writes. If the limits
        are exceeded, that is the difference.
    """
    job = (submitted, redrawn, words_alike)
    found = run_one_bounded(_found, job, TIMEOUT_S, MEMORY_BYTES)
    if isinstance(found, JobFailure):
        what = f"not compared within the limits ({found.reason.rstrip('.')})"
        return (PageDifference(0, what, True),)
    return found


def _found(job: tuple[bytes, bytes, WordsAlike]) -> tuple[PageDifference, ...]:
    submitted, redrawn, words_alike = job
    try:
        with pypdf.apply_configuration(**PYPDF_LIMITS):
            submitted_pdf, redrawn_pdf = map(opened, (submitted, redrawn))
            walk = _Walk(words_alike)
            found = [PageDifference(0, what, True) for what in _tables(submitted)]
            found += islice(walk.differences(submitted_pdf, redrawn_pdf), MAX_FOUND)
            producer = (submitted_pdf.metadata or DictionaryObject()).get("/Producer")
            if producer is not None and any(difference.structural for difference in found):
                what = f"another program wrote this file ({one_line(str(producer), 60)})"
                found.insert(0, PageDifference(0, what, True))
            return tuple(found)
    except (LimitReachedError, RecursionError, SyntaxError, *BROKEN_PDF_ERRORS) as error:
        what = f"cannot be read ({type(error).__name__})"
        return (PageDifference(0, what, True),)


@dataclass
class _Walk:
    """Parallel walk through two PDFs.

    Attributes
    ----------
    compared : set of tuple
        Pairs of objects that were compared: number, generation, and px4fuse's number.
    parents : list of tuple
        Parents of pages, left for the walk from the catalogue.
    fonts : mapping
        Of the page that is compared, by the names that its content uses.
    """

    words_alike: WordsAlike
    compared: set[tuple[int, int, int]] = field(default_factory=set)
    parents: list[tuple[Any, Any, str]] = field(default_factory=list)
    fonts: Mapping[str, Any] = field(default_factory=dict)
    steps: int = 0

    def differences(
        self, submitted: pypdf.PdfReader, redrawn: pypdf.PdfReader
    ) -> Iterator[PageDifference]:
        """Yield the differences of pages, document information and catalogue."""
        pages = [_sheets(reader) for reader in (submitted, redrawn)]
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
        left = [(submitted, redrawn, key)]
        while left:
            submitted, redrawn, key = left.pop()
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
                yield from self._dictionaries(submitted, redrawn, key, page, left)
            elif isinstance(redrawn, ArrayObject):
                if len(submitted) != len(redrawn):
                    what = f"{key} has {len(submitted)} parts; px4fuse writes {len(redrawn)}"
                    yield PageDifference(page, what, True)
                    continue
                both = zip(list.__iter__(submitted), list.__iter__(redrawn), strict=True)
                left += [(one, other, key) for one, other in both][::-1]
            elif not self._same(submitted, redrawn):
                found, drawn = (one_line(str(each), 60) for each in (submitted, redrawn))
                yield PageDifference(page, f"{key} is {found!r}; px4fuse writes {drawn!r}")

    def _dictionaries(
        self,
        submitted: DictionaryObject,
        redrawn: DictionaryObject,
        key: str,
        page: int,
        left: list[tuple[Any, Any, str]],
    ) -> Iterator[PageDifference]:
        """Yield the differences of keys and streams; the values are put on the list."""
        found, drawn = (_keys(each, key) for each in (submitted, redrawn))
        for name in sorted(found ^ drawn):
            part = _PART_NAMES.get(name, f"an entry {one_line(name, 40)}")
            what = "that px4fuse does not write" if name in found else "is missing"
            yield PageDifference(page, f"{part} {what}", True)
        for name in sorted(found & drawn, reverse=True):
            pair = submitted.raw_get(name), redrawn.raw_get(name), name
            (self.parents if page and name == "/Parent" else left).append(pair)
        if isinstance(submitted, StreamObject) and isinstance(redrawn, StreamObject):
            yield from self._streams(submitted, redrawn, key, page)

    def _same(self, submitted: Any, redrawn: Any) -> bool:
        if _kind(redrawn) is float:
            return math.isclose(submitted, redrawn, rel_tol=NUMBER, abs_tol=NUMBER)
        if (
            _kind(redrawn) is str
            and _TYPST.fullmatch(str(submitted))
            and _TYPST.fullmatch(str(redrawn))
        ):
            return True
        if _kind(redrawn) is str:
            one, other = (
                str(each) if isinstance(each, str) else each.decode("latin-1")
                for each in (submitted, redrawn)
            )
            return one == other or self.words_alike(one, other)
        return bool(submitted == redrawn)

    def _streams(
        self, submitted: StreamObject, redrawn: StreamObject, key: str, page: int
    ) -> Iterator[PageDifference]:
        kind = redrawn.get("/Type")
        if kind == "/EmbeddedFile":  # results.json, which intake has read
            return
        packed = _resolved(submitted.get("/Filter"))
        if packed not in (None, "/FlateDecode", ["/FlateDecode"]):  # pypdf does not decode JPEG
            yield PageDifference(page, f"{key} has another compression", True)
            return
        one, other = submitted.get_data(), redrawn.get_data()
        if one == other or (kind == "/Metadata" and _xmp(one) == _xmp(other)):
            return
        if (key != "/Contents" and kind != "/Pattern") or len(one) > SPELLING * len(other):
            yield PageDifference(page, f"{key}: the content differs from px4fuse's")
        elif what := self._other_operation(one, other):
            yield PageDifference(page, what)

    def _other_operation(self, submitted: bytes, redrawn: bytes) -> str:
        """Describe the first operation that differs; empty if none does."""
        both = [_operations(each) for each in (submitted, redrawn)]
        font = ""
        for number, pair in enumerate(zip_longest(*both, fillvalue=("", ())), start=1):
            (one, found), (other, drawn) = pair
            if other == "Tf":
                font = str(drawn[0])
            if pair[0] == pair[1] or (one == other and _near(one, found, drawn)):
                continue
            if {one, other} <= _TEXT:
                texts = [self._text(operands, font) for operands in (found, drawn)]
                widest = max((abs(each) for each in found if isinstance(each, float)), default=0.0)
                if texts[0] != texts[1] and widest < KERNING and self.words_alike(*texts):
                    continue
                shown = [one_line(text, 60) for text in texts]
                return f"text {shown[0]!r}; px4fuse prints {shown[1]!r}"
            return f"drawing operation {number} differs from px4fuse's ({one_line(other, 9)})"
        return ""

    def _text(self, operands: tuple[Operand, ...], font: str) -> str:
        """Return the letters of Tj or TJ by the ToUnicode of its font; ? for other glyphs."""
        cmap = self.fonts[font].get_object()["/ToUnicode"].get_data().decode("latin-1")
        letters = {int(glyph, 16): bytes.fromhex(text) for glyph, text in _LETTERS.findall(cmap)}
        glyphs = b"".join(each for each in operands if isinstance(each, bytes))
        numbers = struct.unpack(f">{len(glyphs) // 2}H", glyphs[: len(glyphs) // 2 * 2])
        return b"".join(letters.get(each, b"\0?") for each in numbers).decode(
            "utf-16-be", "replace"
        )


def _tables(pdf: bytes) -> Iterator[str]:
    """Yield reasons why programs may read different objects of the PDF."""
    end = _END.search(pdf[-1024:])
    if end is None:
        yield "bytes after its end"
    elif b"/Linearized" in pdf[:1024]:
        # the end must refer to the first table in the file
        begin = pdf.find(b"endobj") + len(b"endobj")
        if pdf[begin : int(end[1])].strip():
            yield "a second table of objects"


def _sheets(reader: pypdf.PdfReader) -> list[Any]:
    """References to the pages, in order, of a page tree with one level, as px4fuse writes it."""
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
    left_out = set(_PACKED) if isinstance(value, StreamObject) else set()
    left_out |= _STAMPS if key == "/Info" else set()
    left_out |= {"/Params"} if value.get("/Type") == "/EmbeddedFile" else set()
    return {each for each in value if not isinstance(value.raw_get(each), NullObject)} - left_out


def _xmp(data: bytes) -> str:
    """Return XMP metadata in canonical form, without fields that other programs change."""
    if (
        len(data) > MAX_XMP_BYTES or b"<!" in data
    ):  # document types may contain entities that expand
        return data.decode("latin-1")
    packet = re.sub(r"<\?.*?\?>", "", data.decode("utf-8", "replace"))
    spelt = ElementTree.canonicalize(packet.strip(), strip_text=True)
    return _TYPST.sub("Typst", _XMP_STAMPS.sub("", spelt))


def _operations(content: bytes) -> Iterator[Operation]:
    """Read content as operators with their operands."""
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
    return _ESCAPED.get(escaped, escaped)


def _near(operator: str, submitted: Sequence[Operand], redrawn: Sequence[Operand]) -> bool:
    """Return True if operands are equal, coordinates within COORDINATE_PT."""
    first = _COORDINATES.get(operator, len(redrawn))
    return len(submitted) == len(redrawn) and all(
        one == other
        or (
            isinstance(one, float)
            and isinstance(other, float)
            and math.isclose(
                one, other, rel_tol=NUMBER, abs_tol=COORDINATE_PT if at >= first else NUMBER
            )
        )
        for at, (one, other) in enumerate(zip(submitted, redrawn, strict=True))
    )
