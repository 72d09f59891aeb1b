"""A picture of one page of a report, small enough to put hundreds of them into one file."""

from __future__ import annotations

import importlib
import io
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from PIL import Image, ImageDraw

from px4fuse.flight import Unavailable
from px4fuse.results.reading import one_line

# Less where a page is very long, or its picture does not fit into MAX_BYTES
WIDTH_PX = 700
# Enough to keep our blue, EKF2's orange and the severities apart, with smooth letters
COLOURS = 16
# A page of text and lines at 700 pixels takes 15 to 55 kB; a photograph is made smaller
MAX_BYTES = 60_000
MAX_PIXELS = 2_000_000
MAX_DRAWN_COLOURS = 20_000
# PDF's own limit is 14,400 points, or 200 inches
MAX_POINTS = 14_400.0
WHAT = "picture of the page"
# Where a report's pages name log and student, and what names are covered with
HEAD = 0.045
COVER = (190, 190, 190)
# PDFium's own errors are RuntimeErrors; the others come from ctypes and Pillow
FAILURES = (
    RuntimeError, ValueError, TypeError, ArithmeticError, LookupError, AssertionError, OSError,
    MemoryError, ImportError,
)  # fmt: skip


def picture(pdf: bytes, page: int) -> bytes | Unavailable:
    """Draw one page of a PDF.

    Needs pypdfium2. Nothing in the PDF is executed, and the picture's size is bounded whatever the
    page's is; time and memory are not, so call it in a process that has limits.

    Parameters
    ----------
    pdf : bytes
        May be anything.
    page : int
        Counted from 0.

    Returns
    -------
    bytes or Unavailable
        A PNG of at most :data:`MAX_BYTES`.
    """
    try:
        with opened(pdf) as document:
            if not 0 <= page < len(document):
                raise ValueError(f"there is no page {page + 1}")
            return _small_png(rendered(document[page], WIDTH_PX))
    except FAILURES as error:
        return undrawn(error)


def page_pictures(pdf: bytes, hide: Sequence[str] = ()) -> tuple[bytes, ...] | Unavailable:
    """Draw every page of a report that px4fuse drew.

    Parameters
    ----------
    hide : sequence of str
        Words that must not be read in the pictures: they are covered, and so is the head of each
        page. Where none of them is found on the first page, nothing is drawn: the words are there
        in letters that cannot be searched.

    Returns
    -------
    tuple of bytes or Unavailable
        A PNG per page.
    """
    made = []
    try:
        with opened(pdf) as document:
            for number in range(len(document)):
                sheet = document[number]
                image = rendered(sheet, WIDTH_PX)
                if hide and not _cover(image, sheet, hide) and not number:
                    raise ValueError("a name on its first page cannot be found to cover it")
                made.append(_small_png(image))
    except FAILURES as error:
        return undrawn(error)
    return tuple(made)


def _cover(image: Image.Image, sheet: Any, hide: Sequence[str]) -> int:
    """Cover words and the head of a page; how many places below the head there were."""
    scale = image.width / sheet.get_width()
    pen = ImageDraw.Draw(image)
    pen.rectangle((0.0, 0.0, image.width, HEAD * image.height), COVER)
    text = sheet.get_textpage()
    found = 0
    for word in hide:
        search = text.search(word, match_case=False, match_whole_word=False)
        while (place := search.get_next()) is not None:
            for each in range(text.count_rects(*place)):
                left, bottom, right, top = text.get_rect(each)
                box = (left, sheet.get_height() - top, right, sheet.get_height() - bottom)
                x0, y0, x1, y1 = (scale * edge for edge in box)
                pen.rectangle((x0 - 2.0, y0 - 2.0, x1 + 2.0, y1 + 2.0), COVER)
                found += y1 > HEAD * image.height
    return found


@contextmanager
def opened(pdf: bytes) -> Iterator[Any]:
    """A document of pypdfium2.

    Raises
    ------
    one of FAILURES
        It cannot be read, or pypdfium2 is not installed (ImportError).
    """
    document = importlib.import_module("pypdfium2").PdfDocument(pdf)
    try:
        yield document
    finally:
        document.close()


def undrawn(error: BaseException) -> Unavailable:
    """What stands for a page or file that raised one of FAILURES."""
    if isinstance(error, ImportError):
        install = 'Install it: pip install "px4fuse[grade]".'
        return Unavailable(WHAT, "pypdfium2 is not installed", install)
    reason = f"it cannot be drawn ({one_line(str(error), 80)})"
    return Unavailable(WHAT, reason, "Open the PDF itself.")


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
        if out.tell() <= MAX_BYTES:
            return out.getvalue()
        ratio = min(0.9, math.sqrt(MAX_BYTES / out.tell()))
        width, height = (max(1, int(ratio * side)) for side in image.size)
        image = image.resize((width, height), Image.Resampling.LANCZOS)
