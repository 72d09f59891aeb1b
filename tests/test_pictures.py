"""Pictures of pages: small, true to the page, and never an exception."""

from __future__ import annotations

import io
import random
import sys
from pathlib import Path

import pytest
from forgery import saved
from hypothesis import example, given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure
from PIL import Image
from pypdf import PdfReader, PdfWriter

from px4fuse.flight import Unavailable
from px4fuse.verification.pages import (
    COLOURS,
    MAX_PICTURE_BYTES,
    MAX_PIXELS,
    pictures,
)

REPORT = Path(__file__).resolve().parents[1] / "reports" / "aisle_uwb.pdf"


@pytest.fixture(autouse=True)
def _pdfium() -> None:
    pytest.importorskip("pypdfium2", reason='pypdfium2 is absent: pip install "px4fuse[grade]"')


def picture(pdf: bytes, page: int) -> bytes | Unavailable:
    made = pictures(pdf, page)
    if isinstance(made, Unavailable):
        return made
    (only,) = made or (b"",)
    return only


def opened(made: bytes | Unavailable) -> Image.Image:
    assert isinstance(made, bytes), made
    assert len(made) <= MAX_PICTURE_BYTES
    image = Image.open(io.BytesIO(made))
    image.load()
    assert image.format == "PNG"
    return image


def blank(width: float, height: float) -> bytes:
    writer = PdfWriter()
    writer.add_blank_page(width, height)
    return saved(writer)


def test_a_report_s_cover_is_small_and_readable() -> None:
    made = picture(REPORT.read_bytes(), 0)
    image = opened(made)
    assert image.size == (701, 991)
    colours = image.convert("RGB").getcolors(256)
    assert colours is not None
    assert max(colours)[1] == (255, 255, 255)
    assert min(sum(colour) for _, colour in colours) < 60  # letters are black, not grey
    # Our blue and EKF2's orange survive the palette
    assert any(b > r + 60 for _, (r, _, b) in colours)
    assert any(r > b + 100 for _, (r, _, b) in colours)


@pytest.mark.parametrize("page", [-1, 9, 10**9, 2**70])
def test_a_page_that_is_not_there(page: int) -> None:
    assert pictures(REPORT.read_bytes(), page) == ()


def test_a_photograph_is_made_to_fit() -> None:
    figure = Figure(figsize=(8.27, 11.69))
    noise = random.Random(1).randbytes(600 * 800 * 3)
    figure.figimage(Image.frombytes("RGB", (600, 800), noise))
    out = io.BytesIO()
    figure.savefig(out, format="pdf")
    image = opened(picture(out.getvalue(), 0))
    assert image.size[0] < 700
    assert len(image.getcolors(256)) <= COLOURS


@pytest.mark.parametrize(
    "size",
    # PDFium takes what it cannot believe for a letter
    [(14_400, 14_400), (1, 14_400), (14_400, 1), (0.001, 0.001), (3, 3), (1e9, 1e9), (1e38, 1.0),
     (1e300, 1e300)],
)  # fmt: skip
def test_odd_pages_are_bounded(size: tuple[float, float]) -> None:
    made = picture(blank(*size), 0)
    if not isinstance(made, Unavailable):
        width, height = opened(made).size
        assert width * height <= 1.1 * MAX_PIXELS


def test_locked_and_broken_files_are_unavailable() -> None:
    writer = PdfWriter(clone_from=REPORT)
    writer.encrypt("secret", algorithm="RC4-128")
    pdf = saved(writer)
    for content in (pdf, b"", b"%PDF-1.7", b"\0" * 1000, REPORT.read_bytes()[:3000]):
        made = picture(content, 0)
        assert isinstance(made, Unavailable)
        assert made.remedy == "Open the PDF itself."


@settings(max_examples=60)
@given(st.integers(0, 2**32), st.integers(1, 60))
@example(0, 1)
def test_damaged_reports_never_raise(seed: int, count: int) -> None:
    content = bytearray(REPORT.read_bytes())
    dice = random.Random(seed)
    for _ in range(count):
        content[dice.randrange(len(content))] = dice.randrange(256)
    made = picture(bytes(content), dice.randrange(9))
    assert isinstance(made, bytes | Unavailable)


def test_without_pypdfium2_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pypdfium2", None)
    made = picture(REPORT.read_bytes(), 0)
    assert isinstance(made, Unavailable)
    assert 'pip install "px4fuse[grade]"' in str(made)


def test_every_page_of_a_report_is_drawn() -> None:
    made = pictures(REPORT.read_bytes())
    assert len(made) == len(PdfReader(REPORT).pages)
    assert {opened(one).size for one in made} == {(701, 991)}
    assert made[0] == picture(REPORT.read_bytes(), 0)
