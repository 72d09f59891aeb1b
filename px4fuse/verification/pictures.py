"""A picture of one page of a report, small enough to put hundreds of them into one file."""

from __future__ import annotations

import importlib
import io
import math
from collections.abc import Sequence
from typing import Any

from PIL import Image

from px4fuse.flight import Unavailable

# Enough to keep our blue, EKF2's orange and the severities apart, with smooth letters
COLOURS = 16
# A page of text and lines at 700 pixels takes 25 to 40 kB; a photograph is made smaller
MAX_BYTES = 40_000
MAX_PIXELS = 2_000_000
MAX_DRAWN_COLOURS = 20_000
# PDF's own limit is 14,400 points, or 200 inches
MAX_POINTS = 14_400.0
# Headings of the first page of either kind of report
COVERS = ("Two-state Kalman filter against EKF2", "Loop closure")
WHAT = "picture of the page"
# PDFium's own errors are RuntimeErrors; the others come from ctypes and Pillow
FAILURES = (
    RuntimeError, ValueError, TypeError, ArithmeticError, LookupError, AssertionError, OSError,
    MemoryError,
)  # fmt: skip


def key_page(pages: Sequence[str]) -> int:
    """Which page to show of a report: its cover, also where a student put pages before it.

    Parameters
    ----------
    pages : sequence of str
        Text of each page.

    Returns
    -------
    int
        Counted from 0.
    """
    for page, text in enumerate(pages):
        if any(line.strip() in COVERS for line in text.splitlines()):
            return page
    return 0


def picture(pdf: bytes, page: int, width_px: int = 700) -> bytes | Unavailable:
    """Draw one page of a PDF.

    Needs pypdfium2. Nothing in the PDF is executed, and the picture's size is bounded whatever the
    page's is; time and memory are not, so call it in a process that has limits.

    Parameters
    ----------
    pdf : bytes
        May be anything.
    page : int
        Counted from 0.
    width_px : int
        Less where the page is very long, or does not fit into :data:`MAX_BYTES`.

    Returns
    -------
    bytes or Unavailable
        A PNG of at most :data:`MAX_BYTES`.
    """
    library = pdfium()
    if isinstance(library, Unavailable):
        return library
    try:
        document = library.PdfDocument(pdf)
        try:
            if not 0 <= page < len(document):
                raise ValueError(f"there is no page {page + 1}")
            return _small_png(rendered(document[page], width_px))
        finally:
            document.close()
    except FAILURES as error:
        return Unavailable(WHAT, f"it cannot be drawn ({error})", "Open the PDF itself.")


def pdfium() -> Any:
    """The module pypdfium2, or Unavailable."""
    try:
        return importlib.import_module("pypdfium2")
    except (ImportError, OSError):
        return Unavailable(
            WHAT, "pypdfium2 is not installed", 'Install it: pip install "px4fuse[grade]".'
        )


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
        reduced.save(out, "PNG", optimize=True)
        if out.tell() <= MAX_BYTES:
            return out.getvalue()
        ratio = min(0.9, math.sqrt(MAX_BYTES / out.tell()))
        width, height = (max(1, int(ratio * side)) for side in image.size)
        image = image.resize((width, height), Image.Resampling.LANCZOS)
