"""Whether the pages of a PDF show what px4fuse draws: operator by operator, glyph by glyph.

The other PDF is one that px4fuse has just drawn. Both are walked in step, so that a submitted
file is followed only as far as it is like ours, and only as much of it is inflated.
"""

from __future__ import annotations

import io
import re
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from pypdf import PdfReader
from pypdf.generic import DictionaryObject, StreamObject

from px4fuse.verification.content_stream import PATH, Operation, UnreadableError, operations
from px4fuse.verification.glyphs import Font, code_texts, read_font, same_glyph

# Of anything drawn, on the page: half the width of a thick line, no reading of a plot
TOLERANCE_POINTS = 0.5
# Within a marker, which is of a few points
TOLERANCE_MARKER_POINTS = 0.01
# Colours, line widths, matrices, sizes: of 1, or relative above that
TOLERANCE_STATE = 1e-3
# Thousandths of an em between letters
TOLERANCE_KERNING = 1.0
# A line that was thinned in another way is the same line within this: twice the half point that
# matplotlib's simplification allows itself
TOLERANCE_THINNED_POINTS = 1.0
_MAX_PAIRS = 4_000_000
_MARKER = re.compile(r"/M\d+")
_NUMBER = re.compile(r"\d+(?:\.\d+)?(?:e[+-]?\d+)?")
# What a page may inherit from the nodes above it, which px4fuse writes on the page itself
_INHERITED = frozenset({"/Resources", "/MediaBox", "/CropBox", "/Rotate"})
_MAX_TREE = 50
_SEAL = re.compile(rb"%px4fuse-sha256 [0-9a-f]{64}\n\Z")
Matrix = tuple[float, float, float, float, float, float]
NumbersAlike = Callable[[str, str], bool]
_IDENTITY: Matrix = (1.0, 0.0, 0.0, 1.0, 0.0, 0.0)


@dataclass(frozen=True)
class Compared:
    """What differs between a PDF and the one that px4fuse draws.

    Attributes
    ----------
    pages : dict of int to str
        Pages, counted from 1, and what is not the same on each.
    document : tuple of str
        What differs besides the pages: sentences.
    ordered : bool
        Whether its parts are numbered as in ours.
    """

    pages: dict[int, str]
    document: tuple[str, ...]
    ordered: bool


class _DiffersError(Exception):
    """The two are not the same; the text says in what."""


def _exactly(one: str, other: str) -> bool:
    return one == other


def compare_pdf(submitted: bytes, drawn: bytes, numbers_alike: NumbersAlike = _exactly) -> Compared:
    """Compare a submitted PDF with what px4fuse draws.

    Parameters
    ----------
    submitted : bytes
    drawn : bytes
        The report as it should be.
    numbers_alike : callable
        Whether two different numbers in texts are the same up to rounding.
    """
    ours = PdfReader(io.BytesIO(drawn))
    expected = list(ours.pages)
    try:
        theirs = PdfReader(io.BytesIO(submitted))
        pages = list(theirs.pages)
    except Exception as error:  # noqa: BLE001 - pypdf may raise anything on a hostile file
        return Compared({1: f"its pages cannot be read ({type(error).__name__})"}, (), False)
    fonts = _Fonts()
    altered = {}
    for number, page in enumerate(pages, start=1):
        if number > len(expected):
            altered[number] = f"px4fuse prints only {len(expected)} pages"
            continue
        try:
            _compare_page(page, expected[number - 1], numbers_alike, fonts)
        except Exception as error:  # noqa: BLE001 - as above
            reason = str(error) if isinstance(error, _DiffersError | UnreadableError) else ""
            altered[number] = reason or f"it cannot be read ({type(error).__name__})"
            other = _stands_for(page, expected, number)
            if other:
                altered[number] = f"it is what page {other} should be"
    altered |= dict.fromkeys(range(len(pages) + 1, len(expected) + 1), "it is missing")
    try:
        document, ordered = tuple(_outside(theirs, ours)), _numbering(theirs) == _numbering(ours)
    except Exception as error:  # noqa: BLE001 - as above
        document = (f"the document's parts cannot be read ({type(error).__name__})",)
        ordered = False
    return Compared(altered, document, ordered)


def plain_layout(pdf: bytes) -> bool:
    """Whether a file is laid out as pypdf writes one in one go: no second version of anything.

    Its objects follow one another without a gap in the order of their numbers, one
    cross-reference table points at them, and nothing but the seal comes after the end. No two
    programs can see different pages in such a file.
    """
    body = _SEAL.sub(b"", pdf)
    end = re.search(rb"startxref\n(\d{1,9})\n%%EOF\n\Z", body[-64:])
    if end is None:
        return False
    start = int(end[1])
    head = re.match(rb"xref\n0 (\d{1,6})\n0000000000 65535 f \n", body[start : start + 64])
    if head is None:
        return False
    count = int(head[1]) - 1
    table = body[start + head.end() :]
    entries, trailer = table[: 20 * count], table[20 * count :]
    if not re.fullmatch(rb"(?:\d{10} 00000 n \n)*", entries) or len(entries) != 20 * count:
        return False
    if not re.fullmatch(rb"trailer\n<<\n[^<>]*>>\nstartxref\n\d+\n%%EOF\n", trailer):
        return False
    places = [int(entries[20 * i : 20 * i + 10]) for i in range(count)] + [start]
    head_only = re.fullmatch(rb"%PDF-1\.\d\n%[\x80-\xff]{4}\n", body[: places[0]])
    return head_only is not None and all(
        body.startswith(b"%d 0 obj\n" % number, place)
        and body[place:following].endswith(b"endobj\n")
        for number, (place, following) in enumerate(pairwise(places), start=1)
    )


def font_names(pdf: bytes) -> frozenset[str]:
    """Names of a report's fonts, without the tags of their subsets; empty if unreadable."""
    try:
        page: Any = PdfReader(io.BytesIO(pdf)).pages[0]
        fonts = page["/Resources"]["/Font"].values()
        return frozenset(str(font.get_object()["/BaseFont"]).rpartition("+")[2] for font in fonts)
    except Exception:  # noqa: BLE001 - pypdf may raise anything on a hostile file
        return frozenset()


# -- besides the pages -----------------------------------------------------------------------------


def _outside(theirs: PdfReader, ours: PdfReader) -> Iterator[str]:
    """What differs between two files besides their pages."""
    root: Any = theirs.trailer["/Root"]
    our_root: Any = ours.trailer["/Root"]
    if root.keys() != our_root.keys():
        names = sorted(root.keys() ^ our_root.keys())
        yield f"the document has other parts than px4fuse writes: {', '.join(names)[:200]}"
    attached, our_attached = _attachment(root), _attachment(our_root)
    if attached != our_attached:
        yield "what is attached is not what px4fuse attaches"
    if not _same(theirs.trailer["/Info"], ours.trailer["/Info"], set()):
        yield "the document's title or creator is not what px4fuse writes"


def _attachment(root: Any) -> list[Any]:
    """Everything about the attachments but the content of the results."""
    names = root["/Names"]
    files = names["/EmbeddedFiles"]
    label, reference = files["/Names"]
    whole = reference.get_object()
    stream = whole["/EF"]["/F"].get_object()
    keys = [sorted(part.keys()) for part in (names, files, whole, whole["/EF"])]
    stream_keys = sorted(stream.keys() - {"/Length", "/Filter"})
    return [*keys, stream_keys, str(label), str(whole["/F"]), len(files["/Names"])]


def _numbering(reader: PdfReader) -> list[Any]:
    """Numbers of the parts that a program which saves a file again moves."""
    trailer = reader.trailer
    names: Any = trailer["/Root"]
    return [
        trailer["/Size"],
        trailer.raw_get("/Info").idnum,
        names.raw_get("/Names").idnum,
        sorted(trailer.keys()),
        reader.pdf_header,
    ]


def _stands_for(page: Any, expected: Sequence[Any], number: int) -> int:
    """Another page that this one is; 0 for none."""
    content = page.get("/Contents")
    data = getattr(content.get_object(), "_data", None) if content is not None else None
    for other, ours in enumerate(expected, start=1):
        if other != number and data == ours["/Contents"].get_object()._data:
            return other
    return 0


# -- a page ----------------------------------------------------------------------------------------


def _compare_page(page: Any, ours: Any, alike: NumbersAlike, fonts: _Fonts) -> None:
    keys, our_keys = set(page.keys()), set(ours.keys())
    if keys != our_keys:
        names = ", ".join(sorted(keys ^ our_keys))[:200]
        raise _DiffersError(f"it has other parts than px4fuse writes: {names}")
    for key in sorted(our_keys - {"/Parent", "/Contents", "/Resources"}):
        if not _same(page[key], ours[key], set()):
            raise _DiffersError(
                "it has annotations" if key == "/Annots" else f"its {key[1:]} is another"
            )
    node, depth = page["/Parent"].get_object(), 0
    while node is not None and depth < _MAX_TREE:
        if _INHERITED & node.keys():
            raise _DiffersError("the tree of pages says how it is shown")
        node, depth = node.get("/Parent"), depth + 1
        node = None if node is None else node.get_object()
    content, our_content = page["/Contents"].get_object(), ours["/Contents"].get_object()
    if content.keys() - {"/Filter", "/Length"} != our_content.keys() - {"/Filter", "/Length"}:
        raise _DiffersError("its content is not what px4fuse writes")
    pair = _Pair(page["/Resources"], ours["/Resources"], alike, fonts, TOLERANCE_POINTS)
    _compare_content(content, our_content, pair)


def _inflated(stream: Any, limit: int) -> bytes:
    """Bytes of a stream, at most ``limit`` of them."""
    data: bytes = stream._data
    kind = stream.get("/Filter")
    if kind is not None:
        if kind not in ("/FlateDecode", ["/FlateDecode"]) or "/F" in stream:
            raise _DiffersError("it is packed in another way than px4fuse packs")
        unpacker = zlib.decompressobj()
        try:
            data = unpacker.decompress(data, limit + 1)
        except zlib.error as error:
            raise _DiffersError("it is damaged") from error
        if not unpacker.eof and len(data) <= limit:
            raise _DiffersError("it is cut short")
    if len(data) > limit:
        raise _DiffersError("it is much longer than what px4fuse draws")
    return data


def _expected_size(stream: Any) -> int:
    """Bytes that a stream may have that should be like ours."""
    return 2 * len(_inflated(stream, 1 << 30)) + 65_536


def _same(one: Any, other: Any, seen: set[tuple[int, int]]) -> bool:
    """Whether two parts of PDFs are the same, followed along the second, which is ours."""
    one, other = one.get_object(), other.get_object()
    pair = (id(one), id(other))
    if pair in seen:
        return True
    seen.add(pair)
    if isinstance(other, StreamObject):
        return isinstance(one, StreamObject) and _same_stream(one, other, seen)
    if isinstance(other, DictionaryObject):
        is_plain = isinstance(one, DictionaryObject) and not isinstance(one, StreamObject)
        return is_plain and _same_entries(one, other, seen)
    if isinstance(other, list):
        return (
            isinstance(one, list)
            and len(one) == len(other)
            and all(_same(part, ours, seen) for part, ours in zip(one, other, strict=True))
        )
    if _is_number(other):
        return _is_number(one) and _close(float(one), float(other))
    return type(one) is type(other) and bool(one == other)


def _same_entries(one: Any, other: Any, seen: set[tuple[int, int]]) -> bool:
    keys = other.keys() - {"/Length"}
    return one.keys() - {"/Length"} == keys and all(
        _same(one.raw_get(key), other.raw_get(key), seen) for key in keys
    )


def _same_stream(one: Any, other: Any, seen: set[tuple[int, int]]) -> bool:
    if not _same_entries(one, other, seen):
        return False
    if one._data == other._data:
        return True
    return _inflated(one, _expected_size(other)) == _inflated(other, 1 << 30)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _close(one: float, other: float) -> bool:
    return abs(one - other) <= TOLERANCE_STATE * max(1.0, abs(other))


# -- fonts -----------------------------------------------------------------------------------------


@dataclass
class _Fonts:
    """What was found out about pairs of fonts, which the pages share."""

    same: dict[tuple[int, int], bool] = field(default_factory=dict)
    read: dict[int, Font] = field(default_factory=dict)
    texts: dict[int, dict[int, str]] = field(default_factory=dict)

    def alike(self, one: Any, other: Any) -> bool:
        """Whether two fonts, or two sets of resources, are the same, byte for byte."""
        pair = (id(one), id(other))
        if pair not in self.same:
            self.same[pair] = _same(one, other, set())
        return self.same[pair]

    def text(self, font: Any, shown: bytes, limit: int) -> str:
        """What a string says in a font."""
        if id(font) not in self.texts:
            self.texts[id(font)] = code_texts(_inflated(font["/ToUnicode"].get_object(), limit))
        return "".join(self.texts[id(font)][code] for code in _codes(shown))

    def composite(self, font: Any, limit: int) -> Font:
        """A font taken apart into its glyphs."""
        if id(font) not in self.read:
            self.read[id(font)] = read_font(
                font, lambda stream: _inflated(stream.get_object(), limit)
            )
        return self.read[id(font)]


def _codes(shown: bytes) -> list[int]:
    if len(shown) % 2:
        raise _DiffersError("a text has half a letter")
    return [int.from_bytes(shown[i : i + 2], "big") for i in range(0, len(shown), 2)]


# -- what is drawn ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Pair:
    """What two content streams refer to, and how close they must be."""

    theirs: Any
    ours: Any
    alike: NumbersAlike
    fonts: _Fonts
    tolerance: float

    def named(self, kind: str, name: str, our_name: str) -> tuple[Any, Any]:
        """What two names stand for."""
        ours = self.ours[kind][our_name].get_object()
        found = self.theirs[kind][name].get_object()
        return found, ours


class _State:
    """Where one content stream draws: its matrices and its font."""

    def __init__(self) -> None:
        self.matrix: Matrix = _IDENTITY
        self.line: Matrix = _IDENTITY
        self.font = ""
        self._saved: list[tuple[Matrix, str]] = []

    def follow(self, operator: str, operands: list[Any]) -> None:
        """Take over what an operator sets."""
        if operator == "q":
            self._saved.append((self.matrix, self.font))
        elif operator == "Q":
            if not self._saved:
                raise _DiffersError("a state is restored that was never saved")
            self.matrix, self.font = self._saved.pop()
        elif operator == "cm":
            self.matrix = _times(_matrix(operands), self.matrix)
        elif operator == "BT":
            self.line = _IDENTITY
        elif operator in ("Td", "TD"):
            x, y = operands
            self.line = _times((1.0, 0.0, 0.0, 1.0, x, y), self.line)
        elif operator == "Tm":
            self.line = _matrix(operands)
        elif operator == "Tf":
            self.font = operands[0]


def _matrix(operands: list[Any]) -> Matrix:
    a, b, c, d, e, f = (float(number) for number in operands)
    return a, b, c, d, e, f


def _times(one: Matrix, two: Matrix) -> Matrix:
    a, b, c, d, e, f = one
    k, m, n, p, s, t = two
    return (
        a * k + b * n, a * m + b * p, c * k + d * n, c * m + d * p,
        e * k + f * n + s, e * m + f * p + t,
    )  # fmt: skip


def _compare_content(theirs: Any, ours: Any, pair: _Pair) -> None:
    """Compare two content streams, and what they refer to as far as they use it."""
    content = _inflated(ours, 1 << 30)
    found = _inflated(theirs, 2 * len(content) + 65_536)
    if found == content and pair.fonts.alike(pair.theirs, pair.ours):
        return
    expected = operations(content)
    drawn = expected if found == content else operations(found)
    state, our_state = _State(), _State()
    for one, other in zip(drawn, expected, strict=False):
        if one.operator != other.operator:
            raise _DiffersError(_what(one, other))
        state.follow(*one)
        our_state.follow(*other)
        _compare_operation(one, other, state, our_state, pair)
    if len(drawn) != len(expected):
        more = len(drawn) > len(expected)
        raise _DiffersError(f"{'more' if more else 'less'} is drawn than px4fuse draws")


def _what(one: Operation, other: Operation) -> str:
    shows = {"TJ": "a text", PATH: "a line or area", "Do": "a mark or picture"}
    return (
        f"{shows.get(one.operator, 'something')} is drawn where px4fuse draws "
        f"{shows.get(other.operator, 'something else')}"
    )


def _compare_operation(
    one: Operation, other: Operation, state: _State, our_state: _State, pair: _Pair
) -> None:
    operator, operands, expected = one.operator, one.operands, other.operands
    if operator == PATH:
        _compare_path(operands, expected, state.matrix, our_state.matrix, pair.tolerance)
    elif operator in ("TJ", "Tj"):
        place, our_place = (_times(s.line, s.matrix) for s in (state, our_state))
        _compare_place(place, our_place, pair.tolerance)
        _compare_text(operands, expected, state.font, our_state.font, pair)
    elif operator in ("cm", "Td", "TD", "Tm"):
        _compare_place(state.matrix, our_state.matrix, pair.tolerance)
    elif operator == "Tf":
        if len(operands) != 2 or not _close(operands[1], expected[1]):
            raise _DiffersError("a text has another size")
    elif operator == "Do":
        _compare_drawing(operands[0], expected[0], pair)
    elif operator == "gs":
        if not _same(*pair.named("/ExtGState", operands[0], expected[0]), set()):
            raise _DiffersError("something is drawn with another opacity")
    else:
        if not _same_operands(operands, expected):
            raise _DiffersError(f"a colour, width or style is another ({operator})")
        for name, our_name in zip(operands, expected, strict=True):
            _compare_named(operator, name, our_name, pair)


def _compare_named(operator: str, name: Any, our_name: Any, pair: _Pair) -> None:
    """Compare what the name in an operator stands for, where it stands for something."""
    kinds = {"scn": "/Pattern", "SCN": "/Pattern", "cs": "/ColorSpace", "CS": "/ColorSpace",
             "sh": "/Shading"}  # fmt: skip
    kind = kinds.get(operator)
    if kind is None or not isinstance(our_name, str):
        return
    if kind == "/ColorSpace" and our_name not in pair.ours.get(kind, {}):
        if our_name in pair.theirs.get(kind, {}):
            raise _DiffersError("a colour space is another")
        return
    if not _same(*pair.named(kind, name, our_name), set()):
        raise _DiffersError("something is drawn with another pattern")


def _same_operands(one: Any, other: Any) -> bool:
    if isinstance(other, list):
        return (
            isinstance(one, list)
            and len(one) == len(other)
            and all(_same_operands(a, b) for a, b in zip(one, other, strict=True))
        )
    if isinstance(other, float):
        return isinstance(one, float) and _close(one, other)
    return bool(one == other)


def _compare_place(one: Matrix, other: Matrix, tolerance: float) -> None:
    turned = all(_close(a, b) for a, b in zip(one[:4], other[:4], strict=True))
    near = abs(one[4] - other[4]) <= tolerance and abs(one[5] - other[5]) <= tolerance
    if not (turned and near):
        raise _DiffersError("something is drawn at another place")


def _compare_drawing(name: str, our_name: str, pair: _Pair) -> None:
    """Compare two markers, shapes or pictures."""
    found, ours = pair.named("/XObject", name, our_name)
    key = (id(found), id(ours))
    if key in pair.fonts.same:
        return
    apart = {"/Length", "/Filter", "/BBox", "/Resources"}
    if ours["/Subtype"] != "/Form":
        if not _same(found, ours, set()):
            raise _DiffersError("a picture is another")
    else:
        if found.keys() - {"/Filter", "/Length"} != ours.keys() - {"/Filter", "/Length"} or not all(
            _same(found[part], ours[part], set()) for part in ours.keys() - apart
        ):
            raise _DiffersError("a mark is another")
        tolerance = TOLERANCE_MARKER_POINTS if _MARKER.fullmatch(our_name) else pair.tolerance
        if not all(
            abs(float(a) - float(b)) <= tolerance
            for a, b in zip(found["/BBox"], ours["/BBox"], strict=True)
        ):
            raise _DiffersError("a mark is another")
        inner = _Pair(
            found.get("/Resources", pair.theirs),
            ours.get("/Resources", pair.ours),
            pair.alike,
            pair.fonts,
            tolerance,
        )
        _compare_content(found, ours, inner)
    pair.fonts.same[key] = True


def _compare_text(
    shown: list[Any], expected: list[Any], font: str, our_font: str, pair: _Pair
) -> None:
    """Compare two texts: what they say, in which letters, and the space between those."""
    parts = shown[0] if isinstance(shown[0], list) else [shown[0]]
    our_parts = expected[0] if isinstance(expected[0], list) else [expected[0]]
    text = b"".join(part for part in parts if isinstance(part, bytes))
    our_text = b"".join(part for part in our_parts if isinstance(part, bytes))
    found, ours = pair.named("/Font", font, our_font)
    if text == our_text and len(parts) != len(our_parts):
        raise _DiffersError("a text is set in another way")
    if text == our_text and not _same_kerning(parts, our_parts):
        raise _DiffersError("letters of a text are moved")
    if pair.fonts.alike(found, ours) and text == our_text:
        return
    limit = _expected_size(ours["/DescendantFonts"][0]["/FontDescriptor"]["/FontFile2"])
    said = pair.fonts.text(found, text, limit)
    our_said = pair.fonts.text(ours, our_text, limit)
    if not same_words(said, our_said, pair.alike):
        raise _DiffersError(f"a text is {said[:80]!r} where px4fuse prints {our_said[:80]!r}")
    if any(isinstance(part, float) and abs(part) > 500.0 for part in parts):
        raise _DiffersError("letters of a text are moved")
    one, other = pair.fonts.composite(found, limit), pair.fonts.composite(ours, limit)
    codes = {letter: code for code, letter in reversed(other.text.items())}
    codes |= dict(zip(our_said, _codes(our_text), strict=False))
    for letter, code in zip(said, _codes(text), strict=True):
        if letter not in codes or not same_glyph(one, code, other, codes[letter]):
            raise _DiffersError(f"the font draws another {letter!r}")


def _same_kerning(parts: list[Any], ours: list[Any]) -> bool:
    return all(
        abs(part - our_part) <= TOLERANCE_KERNING
        if isinstance(part, float) and isinstance(our_part, float)
        else part == our_part
        for part, our_part in zip(parts, ours, strict=True)
    )


def same_words(one: str, other: str, alike: NumbersAlike) -> bool:
    """Whether two texts are the same but for the rounding of their numbers.

    >>> same_words("0.15 m", "0.16 m", lambda one, other: True)
    True
    >>> same_words("0.15 m", "0.15 s", lambda one, other: True)
    False
    """
    if one == other:
        return True
    numbers, our_numbers = _NUMBER.findall(one), _NUMBER.findall(other)
    return (
        _NUMBER.split(one) == _NUMBER.split(other)
        and len(numbers) == len(our_numbers)
        and all(a == b or alike(a, b) for a, b in zip(numbers, our_numbers, strict=True))
    )


# -- lines -----------------------------------------------------------------------------------------


def _compare_path(
    one: list[Any], other: list[Any], matrix: Matrix, our_matrix: Matrix, tolerance: float
) -> None:
    if one == other and matrix == our_matrix:
        return
    kinds, our_kinds = [step[0] for step in one], [step[0] for step in other]
    if kinds == our_kinds:
        if any(len(a[1]) != len(b[1]) for a, b in zip(one, other, strict=True)):
            raise _DiffersError("a line is broken off")
        near = np.abs(_corners(one, matrix) - _corners(other, our_matrix)) <= tolerance
        if not near.all():
            raise _DiffersError("a line or area is drawn at another place")
        return
    if not {*kinds, *our_kinds} <= {"m", "l", "h"}:
        raise _DiffersError("a line or area has another shape")
    lines, our_lines = _polylines(one, matrix), _polylines(other, our_matrix)
    if len(lines) != len(our_lines) or kinds.count("h") != our_kinds.count("h"):
        raise _DiffersError("a line or area has other parts")
    for line, our_line in zip(lines, our_lines, strict=True):
        if len(line) * len(our_line) > _MAX_PAIRS or not (
            _near(line, our_line) and _near(our_line, line)
        ):
            raise _DiffersError("a line is drawn at another place")


def _corners(path: list[Any], matrix: Matrix) -> Any:
    """All points of a path on the page; of a rectangle, two opposite corners."""
    numbers: list[float] = []
    for kind, operands in path:
        if kind == "re":
            x, y, width, height = operands
            numbers += (x, y, x + width, y + height)
        else:
            numbers += operands
    points = np.array(numbers, dtype=float).reshape(-1, 2)
    return points @ np.array([matrix[:2], matrix[2:4]]) + np.array(matrix[4:])


def _polylines(path: list[Any], matrix: Matrix) -> list[Any]:
    starts = [i for i, (kind, _) in enumerate(path) if kind == "m"]
    if not starts or starts[0] != 0:
        raise _DiffersError("a line has no beginning")
    ends = [*starts[1:], len(path)]
    return [_corners(path[a:b], matrix) for a, b in zip(starts, ends, strict=True)]


def _near(points: Any, line: Any) -> bool:
    """Whether all points are near a line."""
    start, step = line[:-1], np.diff(line, axis=0)
    if not len(step):
        start, step = line, np.zeros_like(line)
    length2 = np.maximum((step**2).sum(axis=1), 1e-12)
    for chunk in np.array_split(points, max(1, len(points) // 256)):
        to = chunk[:, None, :] - start[None, :, :]
        share = np.clip((to * step).sum(axis=2) / length2, 0.0, 1.0)
        apart = np.linalg.norm(to - share[:, :, None] * step, axis=2).min(axis=1)
        if not (apart <= TOLERANCE_THINNED_POINTS).all():
            return False
    return True
