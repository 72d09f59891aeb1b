"""Pictures of pages: small, true to the page, and never an exception."""

from __future__ import annotations

import io
import random
import sys
from pathlib import Path

import numpy as np
import pytest
from forgery import saved
from hypothesis import example, given, settings
from hypothesis import strategies as st
from matplotlib import rc_context
from matplotlib.figure import Figure
from PIL import Image
from pypdf import PdfReader, PdfWriter

from px4fuse.flight import Unavailable
from px4fuse.grading.outputs import draw_sheets
from px4fuse.verification.pages import (
    COVER,
    MAX_PICTURE_BYTES,
    MAX_PIXELS,
    page_pictures,
    picture,
)

REPORT = Path(__file__).resolve().parents[1] / "reports" / "aisle_uwb.pdf"


@pytest.fixture(autouse=True)
def _pdfium() -> None:
    pytest.importorskip("pypdfium2", reason='pypdfium2 is absent: pip install "px4fuse[grade]"')


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
    made = picture(REPORT.read_bytes(), page)
    assert isinstance(made, Unavailable)
    assert "there is no page" in made.reason


def test_a_photograph_is_made_to_fit() -> None:
    figure = Figure(figsize=(8.27, 11.69))
    noise = random.Random(1).randbytes(600 * 800 * 3)
    figure.figimage(Image.frombytes("RGB", (600, 800), noise))
    out = io.BytesIO()
    figure.savefig(out, format="pdf")
    assert opened(picture(out.getvalue(), 0)).size[0] < 700


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


# ------------------------------------------------------------------ every page, and whose it is


def written(*lines: tuple[float, str]) -> bytes:
    """A page of A4 with texts at heights from 0 to 1."""
    figure = Figure(figsize=(8.27, 11.69))
    for height, text in lines:
        figure.text(0.3, height, text, size=12)
    out = io.BytesIO()
    with rc_context({"pdf.fonttype": 42}):
        figure.savefig(out, format="pdf")
    return out.getvalue()


def darkest(made: bytes, top: float, bottom: float) -> int:
    """Of a strip of the picture, heights from 0 at the bottom to 1."""
    image = opened(made).convert("L")
    box = (0, round((1 - top) * image.height), image.width, round((1 - bottom) * image.height))
    low, _ = image.crop(box).getextrema()
    assert isinstance(low, int)
    return low


def test_every_page_of_a_report_is_drawn() -> None:
    made = page_pictures(REPORT.read_bytes())
    assert len(made) == len(PdfReader(REPORT).pages)
    assert {opened(one).size for one in made} == {(701, 991)}
    assert made[0] == picture(REPORT.read_bytes(), 0)


def test_names_are_covered_and_nothing_else() -> None:
    pdf = written(
        (0.98, "1001.ulg by Ada"), (0.9, "by Ada Lovelace, 10017"), (0.5, "what was seen")
    )
    (shown,), (hidden,) = page_pictures(pdf), page_pictures(pdf, ("Ada", "LOVELACE", "10017"))
    assert darkest(shown, 1.0, 0.97) < 60
    assert darkest(shown, 0.92, 0.89) < 60
    # the head as a whole, as light as what covers it
    assert darkest(hidden, 1.0, 0.97) >= min(COVER) - 20
    assert darkest(hidden, 0.52, 0.49) < 60
    # "by" stays, and the comma; of the names there is one grey
    line = np.asarray(opened(hidden).convert("L"))[round(0.085 * 990) : round(0.105 * 990)]
    dark = np.flatnonzero(line.min(axis=0) < 60)
    assert len(dark)
    assert np.sum(dark > 250) < 12


def test_a_name_that_cannot_be_found_is_not_shown() -> None:
    made = page_pictures(written((0.98, "Ada"), (0.9, "by somebody")), ("Ada", "10017"))
    assert isinstance(made, Unavailable)
    assert "cannot be found" in made.reason


def test_pages_are_drawn_once_and_named_by_what_they_show(tmp_path: Path) -> None:
    (tmp_path / "a.pdf").write_bytes(REPORT.read_bytes())
    (tmp_path / "b.pdf").write_bytes(written((0.9, "by Ada")))
    (tmp_path / "c.pdf").write_bytes(b"%PDF-1.7 broken")
    reports = {name: (tmp_path / f"{name}.pdf", ()) for name in "abc"}
    folder = tmp_path / "pages"
    made = draw_sheets(reports, folder, processes=1)
    assert {name: len(files) for name, files in made.items()} == {
        "a": len(PdfReader(REPORT).pages), "b": 1, "c": 0,
    }  # fmt: skip
    first = {path: path.stat().st_mtime_ns for path in folder.glob("*.png")}
    assert {path.name for path in first} == {file for files in made.values() for file in files}
    assert (folder / made["a"][0]).read_bytes() == picture(REPORT.read_bytes(), 0)
    # one that is not whole is drawn again, the others are not
    (folder / made["a"][3]).unlink()
    assert draw_sheets(reports, folder, processes=1) == made
    kept = folder / made["b"][0]
    assert kept.stat().st_mtime_ns == first[kept]
    hidden = draw_sheets({"b": (tmp_path / "b.pdf", ("Ada",))}, folder, processes=1)
    assert hidden["b"] != made["b"]
    assert not any("ada" in file.casefold() for files in hidden.values() for file in files)


def test_only_what_was_drawn_here_is_deleted(tmp_path: Path) -> None:
    folder = tmp_path / "pages"
    for name in "ab":
        (tmp_path / f"{name}.pdf").write_bytes(written((0.9, f"by {name}")))
    both = {name: (tmp_path / f"{name}.pdf", ()) for name in "ab"}
    (old,), (new,) = draw_sheets(both, folder, processes=1).values()
    # as an instructor may have put it there
    strange = folder / "1001-001-of-001.png"
    strange.write_bytes(b"mine")
    assert draw_sheets({"b": both["b"]}, folder, processes=1) == {"b": (new,)}
    assert {path.name for path in folder.glob("*.png")} == {new, strange.name}
    assert draw_sheets(both, folder, processes=1) == {"a": (old,), "b": (new,)}
    assert draw_sheets({}, folder) == {}
    assert [path.name for path in folder.glob("*.png")] == [strange.name]
    draw_sheets({}, tmp_path / "none")
    assert not (tmp_path / "none").exists()
