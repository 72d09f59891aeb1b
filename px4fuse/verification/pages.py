"""Pages of reports: pictures of them, and whether those that were handed in look like ours.

No number rests on the answer, and the instructor reads the redrawn report: it says where to look
when somebody changed a page. Words are compared as text, everything else as a picture.

How far two pictures of a page are apart (:data:`DISTANCE`), measured on the report of the sample
flight, on the page where it is largest:

===========================================================  ================
saved again by pypdf, qpdf (object streams, linearised,      0
uncompressed, pages moved) or MuPDF (also appended to)
saved by MuPDF with numbers rounded ("clean")                0.05
all lines and marks 0.01, 0.05, 0.1 pt aside                 0.01, 0.03, 0.07
curves thinned by other settings of matplotlib               0.12 to 0.16
fonts embedded in another way (Type 3)                       0.44
a point of a curve moved by 2 pt                             0 to 0.03
one digit replaced (also found as a word)                    0.03 to 0.05
all of one kind of mark larger; one mark in another colour   0.06; 0.02 to 0.07
a text invisible, white or moved                             0.11 to 0.21
a letter drawn as another by an altered font                 0.13 to 0.27
a highlight or a comment over the page                       0.11 to 0.20
a text in another font or size                               0.14 to 0.47
a page clipped, turned, emptied or exchanged                 0.55 to 0.81
===========================================================  ================
"""

import importlib
import io
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from difflib import SequenceMatcher
from functools import partial
from itertools import zip_longest
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
from PIL import Image
from scipy.ndimage import uniform_filter

from px4fuse.flight import Unavailable
from px4fuse.record import lacking
from px4fuse.results.reading import cleaned, one_line
from px4fuse.verification.model import BAD_VALUES, PageDifference
from px4fuse.workers import Failed, bounded

# Side of the square over which differences are averaged: about two digits, at a pixel per point
SQUARE_PX = 8
# Largest mean difference of grey (0 to 1) over such a square that does not count. Between what
# harmless re-saves make (0.07 at the most) and what is seen as another page (from 0.11); see above
DISTANCE = 0.07
# A page that another program wrote may be rounded to whole points
SIZE_PX = 2
MAX_PAGE_TEXT = 1_000_000
# For the pages of a PDF that was handed in; libraries take 0.6 GB of the address space
TIMEOUT_S, MEMORY_BYTES = 10.0, 1_000_000_000
# Less where a page is very long, or its picture does not fit into MAX_PICTURE_BYTES
WIDTH_PX = 700
# Enough to keep our blue, EKF2's orange and the severities apart, with smooth letters
COLOURS = 16
# A page of text and lines at 700 pixels takes 15 to 55 kB; a photograph is made smaller
MAX_PICTURE_BYTES = 60_000
MAX_PIXELS = 2_000_000
MAX_DRAWN_COLOURS = 20_000
# PDF's own limit is 14,400 points, or 200 inches
MAX_POINTS = 14_400.0
# PDFium's own errors are RuntimeErrors; the others come from ctypes and Pillow
FAILURES = (*BAD_VALUES, MemoryError, ImportError)

NumbersAlike = Callable[[str, str], bool]
Made = TypeVar("Made")


@dataclass(frozen=True)
class Look:
    """What is seen of a page: its words in their order, and its grey values from 0 to 1."""

    words: tuple[str, ...]
    grey: npt.NDArray[np.float32]


def compare_pages(
    submitted: bytes, redrawn: bytes, words_alike: NumbersAlike
) -> tuple[PageDifference, ...] | Unavailable:
    """Compare the pages of two PDFs.

    Parameters
    ----------
    submitted : bytes
        May be anything: its pages are drawn in a process of their own, within bounds.
    redrawn : bytes
        The report as px4fuse draws it.
    words_alike : callable
        Whether two different words are the same up to the rounding of a number.

    Returns
    -------
    tuple of PageDifference, or Unavailable
        In the order of the pages; empty where all look the same. Unavailable without pypdfium2.
    """
    ours = looks(redrawn)
    if isinstance(ours, Unavailable):
        return ours
    # of a thousand pages that are handed in, not all are drawn
    theirs = bounded(partial(looks, most=len(ours) + 1), submitted, TIMEOUT_S, MEMORY_BYTES)
    if isinstance(theirs, Failed):
        why = f"they cannot be drawn within bounds ({theirs.reason.rstrip('.')})"
        return Unavailable("pages of the PDF", why, "Do not open it; read the redrawn report.")
    if isinstance(theirs, Unavailable):
        return (PageDifference(1, theirs.reason, 0, 1.0),)
    return tuple(_differences(theirs, ours, words_alike))


def looks(pdf: bytes, most: int = 1000) -> tuple[Look | Unavailable, ...] | Unavailable:
    """What is seen of the first pages of a PDF.

    Unavailable stands for a page that cannot be drawn, and for all of them where the file cannot be
    read or pypdfium2 is not installed.
    """
    return _of_pages(pdf, _look, slice(most))


def _of_pages(
    pdf: bytes, make: Callable[[Any, int], Made], which: slice
) -> tuple[Made, ...] | Unavailable:
    """What is made of some pages of a document of pypdfium2."""
    try:
        with closing(importlib.import_module("pypdfium2").PdfDocument(pdf)) as document:
            return tuple(make(document, page) for page in range(len(document))[which])
    except FAILURES as error:
        return undrawn(error)


def _look(document: Any, page: int) -> Look | Unavailable:
    try:
        sheet = document[page]
        # 72 dpi: a pixel per point
        grey = np.asarray(rendered(sheet, sheet.get_size()[0]).convert("L"), dtype=np.float32)
        text = sheet.get_textpage().get_text_range()[:MAX_PAGE_TEXT]
        return Look(tuple(cleaned(text.replace("\r\n", "\n")).split()), grey / 255.0)
    except FAILURES as error:
        return undrawn(error)


def _differences(
    theirs: Sequence[Look | Unavailable], ours: Sequence[Look | Unavailable], alike: NumbersAlike
) -> Iterator[PageDifference]:
    for number, (found, expected) in enumerate(zip_longest(theirs, ours), start=1):
        if not (isinstance(found, Look) and isinstance(expected, Look)):
            what = "it is missing" if found is None else f"px4fuse draws only {len(ours)} pages"
            unseen = [one.reason for one in (found, expected) if isinstance(one, Unavailable)]
            what = what if None in (found, expected) else unseen[0]
            yield PageDifference(number, what, 0, 1.0)
            continue
        words = list(_other_words(found.words, expected.words, alike))
        apart = _distance(found.grey, expected.grey)
        said = []
        if words:
            one, other = (one_line(text, 60) or "nothing" for text in words[0])
            places = f"{len(words)} places in its text"
            said.append(f"{places}, first {one!r} where px4fuse prints {other!r}")
        if apart > DISTANCE:
            said.append(f"its picture, by {apart:.2f} of 1 (up to {DISTANCE:g} is no difference)")
        if said:
            yield PageDifference(number, " and ".join(said), len(words), round(apart, 3))


def _other_words(
    theirs: Sequence[str], ours: Sequence[str], alike: NumbersAlike
) -> Iterator[tuple[str, str]]:
    """Places where the words are others: what stands there, and what should."""
    if theirs == ours:
        return
    matcher = SequenceMatcher(None, theirs[:20_000], ours, autojunk=False)
    for kind, a, b, c, d in matcher.get_opcodes():
        if kind == "equal":
            continue
        found, expected = theirs[a:b], ours[c:d]
        if b - a != d - c or not all(map(alike, found, expected)):
            yield " ".join(found), " ".join(expected)


def _distance(one: npt.NDArray[np.float32], other: npt.NDArray[np.float32]) -> float:
    """Largest mean difference of grey over a square of the page; 1 for pages of other sizes."""
    if max(abs(a - b) for a, b in zip(one.shape, other.shape, strict=True)) > SIZE_PX:
        return 1.0
    height, width = (min(a, b) for a, b in zip(one.shape, other.shape, strict=True))
    apart = np.abs(one[:height, :width] - other[:height, :width])
    return float(uniform_filter(apart, SQUARE_PX).max())


# ------------------------------------------------------------------ pictures


def pictures(pdf: bytes, page: int | None = None) -> tuple[bytes, ...] | Unavailable:
    """Draw the pages of a PDF, or one of them.

    Needs pypdfium2. Nothing in the PDF is executed, and a picture's size is bounded whatever the
    page's is; time and memory are not: what was handed in is for a process that has limits.

    Parameters
    ----------
    pdf : bytes
        May be anything.
    page : int, optional
        Counted from 0; by default all.

    Returns
    -------
    tuple of bytes or Unavailable
        PNGs of at most :data:`MAX_PICTURE_BYTES`; none for a page that is not there.
    """
    which = slice(None) if page is None else slice(page, page + 1)
    return _of_pages(pdf, lambda sheets, at: _small_png(rendered(sheets[at], WIDTH_PX)), which)


def undrawn(error: BaseException) -> Unavailable:
    """What stands for a page or file that raised one of FAILURES."""
    if isinstance(error, ImportError):
        return lacking("no_pdfium")
    return lacking("page_not_drawn", why=one_line(str(error), 80))


def rendered(sheet: Any, width_px: float) -> Image.Image:
    """A page of pypdfium2's in RGB, on white, at most :data:`MAX_PIXELS` large.

    With the comments that lie over it, since a viewer shows them; without what was typed into
    forms, which pypdfium2 draws only on request.

    Raises
    ------
    one of FAILURES
        It cannot be drawn.
    """
    width, height = sheet.get_size()
    if not (0.0 < width <= MAX_POINTS and 0.0 < height <= MAX_POINTS):
        raise ValueError(f"its size is {width:g} by {height:g} points")
    scale = min(width_px / width, math.sqrt(MAX_PIXELS / (width * height)))
    bitmap = sheet.render(scale=scale, may_draw_forms=False)
    return bitmap.to_pil().convert("RGB").copy()  # type: ignore[no-any-return]


def _small_png(image: Image.Image) -> bytes:
    while True:
        # Choosing by coverage is truer to text and lines, and takes minutes on a photograph
        drawn = image.getcolors(MAX_DRAWN_COLOURS) is not None
        method = Image.Quantize.MAXCOVERAGE if drawn else Image.Quantize.FASTOCTREE
        reduced = image.quantize(COLOURS, method, dither=Image.Dither.NONE)
        out = io.BytesIO()
        reduced.save(out, "PNG")
        if out.tell() <= MAX_PICTURE_BYTES:
            return out.getvalue()
        ratio = min(0.9, math.sqrt(MAX_PICTURE_BYTES / out.tell()))
        width, height = (max(1, int(ratio * side)) for side in image.size)
        image = image.resize((width, height), Image.Resampling.LANCZOS)
