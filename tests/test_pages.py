"""Pages drawn: those that look the same and those that do not, small pictures, and no files."""

from __future__ import annotations

import io
import math
import random
import sys

import pytest
from conftest import REPORT
from forgery import saved
from hypothesis import example, given, settings
from hypothesis import strategies as st
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from PIL import Image
from pypdf import PdfReader, PdfWriter
from pypdf.generic import ArrayObject, DecodedStreamObject, DictionaryObject, NumberObject
from pypdf.generic import NameObject as Name

from px4fuse.flight import Unavailable
from px4fuse.report.style import report_style
from px4fuse.verification import pages
from px4fuse.verification.model import PageDifference
from px4fuse.verification.pages import DISTANCE, MAX_PIXELS, compare_pages, looks, pictures


def drawn(*texts: str, by: float = 0.0, size: float = 10.0, grey: str = "0") -> bytes:
    """A PDF as a report is made: on each page a text and a curve, ``by`` points aside."""
    out = io.BytesIO()
    with report_style(), PdfPages(out, metadata={"CreationDate": None}) as pdf:
        for text in texts:
            figure = Figure(figsize=(4, 4))
            figure.text(0.1, 0.9, text, size=size, color=grey)
            axes = figure.add_axes((0.0, 0.0, 1.0, 0.8), xlim=(0, 288), ylim=(0, 230))
            axes.set_axis_off()
            axes.plot(range(288), [100.0 + by + 50.0 * math.sin(x / 30.0) for x in range(288)])
            pdf.savefig(figure)
    return out.getvalue()


def exactly(one: str, other: str) -> bool:
    return one == other


def compared(one: bytes, other: bytes) -> tuple[PageDifference, ...]:
    return compare_pages(one, other, exactly)


pytest.importorskip("pypdfium2", reason='pypdfium2 is absent: pip install "px4fuse[grade]"')


@pytest.fixture(autouse=True)
def _in_this_process(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if "bounds" not in request.node.name:
        monkeypatch.setattr(pages, "bounded", lambda function, job, *_: function(job))


def test_pages_that_never_end_are_not_compared_within_bounds(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Forms in forms: each draws the next one ten times, which no reader ends."""
    monkeypatch.setattr(pages, "TIMEOUT_S", 3.0)
    found = compare_pages(nested_forms(12), BASE, exactly)
    assert isinstance(found, Unavailable)
    assert "within bounds" in found.reason
    assert found.remedy.startswith("Do not open it")
    assert compare_pages(BASE, BASE, exactly) == ()


def nested_forms(depth: int) -> bytes:
    """A page that draws a form, which draws another one ten times, and so on."""
    writer = PdfWriter()
    page = writer.add_blank_page(595, 842)
    content, inner = b"0 0 1 1 re f\n", DictionaryObject()
    for _ in range(depth):
        form = DecodedStreamObject()
        form.update({Name("/Subtype"): Name("/Form"), Name("/BBox"): BOX,
                     Name("/Resources"): inner})  # fmt: skip
        form.set_data(content)
        named = DictionaryObject({Name("/X"): writer._add_object(form)})
        content, inner = b"/X Do\n" * 10, DictionaryObject({Name("/XObject"): named})
    whole = DecodedStreamObject()
    whole.set_data(content)
    page[Name("/Resources")] = inner
    page[Name("/Contents")] = writer._add_object(whole)
    return saved(writer)


BOX = ArrayObject([NumberObject(0), NumberObject(0), NumberObject(595), NumberObject(842)])


def test_another_word_is_found_on_its_page() -> None:
    (found,) = compared(drawn("one", "two 2.6 m"), drawn("one", "two 2.5 m"))
    assert (found.page, found.words) == (2, 1)
    assert "first '2.6' where px4fuse prints '2.5'" in found.what


def test_words_in_another_order_more_and_fewer() -> None:
    for one, expected in (("a c b d", 2), ("a b c d e", 1), ("a b d", 1), ("", 1)):
        (found,) = compared(drawn(one), drawn("a b c d"))
        assert found.words == expected, one


def test_rounding_is_for_the_caller_to_allow() -> None:
    asked = []

    def alike(theirs: str, ours: str) -> bool:
        asked.append((theirs, ours))
        return True

    assert compare_pages(drawn("x 2.6 m", size=6.5), drawn("x 2.5 m", size=6.5), alike) == ()
    assert asked == [("2.6", "2.5")]
    (found,) = compare_pages(drawn("x 2.6 m"), drawn("x 2.5"), alike)  # type: ignore[misc]
    assert found.words == 1


@pytest.mark.parametrize(("by", "same"), [(0.01, True), (0.05, True), (1.0, False), (5.0, False)])
def test_a_curve_aside(by: float, same: bool) -> None:
    found = compared(drawn("a", by=by), drawn("a"))
    assert (found == ()) == same
    assert all(not one.words and one.picture > DISTANCE for one in found)


@pytest.mark.parametrize("change", [{"grey": "1"}, {"size": 14.0}])
def test_a_text_that_is_there_and_looks_otherwise(change: dict[str, object]) -> None:
    (found,) = compared(drawn("2.5 m", **change), drawn("2.5 m"))  # type: ignore[arg-type]
    assert found.words == 0
    assert "its picture" in found.what


def test_pages_more_fewer_and_of_another_size() -> None:
    three, two = drawn("a", "b", "c"), drawn("a", "b")
    for pair, said in (((three, two), "px4fuse draws only 2 pages"), ((two, three), "it is miss")):
        (found,) = compared(*pair)
        assert (found.page, said in found.what) == (3, True)
    assert [one.page for one in compared(drawn("b", "a"), two)] == [1, 2]
    writer = PdfWriter(clone_from=io.BytesIO(two))
    writer.pages[1].mediabox.upper_right = (288, 250)
    pdf = saved(writer)
    (found,) = compared(pdf, two)
    assert (found.page, found.picture) == (2, 1.0)


def test_a_page_that_cannot_be_drawn_says_why() -> None:
    two = drawn("a", "b")
    writer = PdfWriter(clone_from=io.BytesIO(two))
    writer.pages[1].mediabox.upper_right = (20_000, 20_000)
    huge = saved(writer)
    for one, other in ((huge, two), (two, huge)):
        (found,) = compared(one, other)
        assert (found.page, found.picture) == (2, 1.0)
        assert "its size is 20000 by 20000 points" in found.what


def test_a_thousand_pages_are_not_all_drawn() -> None:
    many = PdfWriter()
    page = PdfReader(io.BytesIO(drawn("a"))).pages[0]
    for _ in range(300):
        many.add_page(page)
    pdf = saved(many)
    assert len(looks(pdf, 2) or ()) == 2  # type: ignore[arg-type]
    assert [one.page for one in compared(pdf, drawn("a"))] == [2]


BASE = drawn("a 1.5")


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32), st.integers(1, 40))
def test_damaged_files_never_raise(seed: int, count: int) -> None:
    content = bytearray(BASE)
    dice = random.Random(seed)
    for _ in range(count):
        content[dice.randrange(len(content))] = dice.randrange(256)
    assert isinstance(compared(bytes(content), BASE), tuple)


@pytest.mark.parametrize("content", [b"", b"%PDF-1.7", b"\0" * 1000])
def test_what_is_no_pdf_differs(content: bytes) -> None:
    (found,) = compared(content, BASE)
    assert "cannot be drawn" in found.what


def test_without_pypdfium2_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pypdfium2", None)
    for found in (compare_pages(BASE, BASE, exactly), pictures(BASE, 0)):
        assert isinstance(found, Unavailable)
        assert 'pip install "px4fuse[grade]"' in str(found)


# -- pictures --------------------------------------------------------------------------------------


def picture(pdf: bytes, page: int) -> bytes | Unavailable:
    made = pictures(pdf, page)
    if isinstance(made, Unavailable):
        return made
    (only,) = made or (b"",)
    return only


def opened(made: bytes | Unavailable) -> Image.Image:
    assert isinstance(made, bytes), made
    assert len(made) <= pages.MAX_PICTURE_BYTES
    image = Image.open(io.BytesIO(made))
    image.load()
    assert image.format == "PNG"
    return image


def test_a_report_s_cover_is_small_and_readable() -> None:
    image = opened(picture(REPORT.read_bytes(), 0))
    assert image.size == (701, 991)
    colours = image.convert("RGB").getcolors(256)
    assert colours is not None
    assert max(colours)[1] == (255, 255, 255)
    assert min(sum(colour) for _, colour in colours) < 60  # letters are black, not grey
    # Our blue and EKF2's orange survive the palette
    assert any(b > r + 60 for _, (r, _, b) in colours)
    assert any(r > b + 100 for _, (r, _, b) in colours)


def test_a_page_that_is_not_there() -> None:
    for page in (-1, 9, 10**9, 2**70):
        assert pictures(REPORT.read_bytes(), page) == ()


def test_a_photograph_is_made_to_fit() -> None:
    figure = Figure(figsize=(8.27, 11.69))
    noise = random.Random(1).randbytes(600 * 800 * 3)
    figure.figimage(Image.frombytes("RGB", (600, 800), noise))
    out = io.BytesIO()
    figure.savefig(out, format="pdf")
    image = opened(picture(out.getvalue(), 0))
    assert image.size[0] < 700
    assert len(image.getcolors(256)) <= pages.COLOURS


@pytest.mark.parametrize(
    "size",
    # PDFium takes what it cannot believe for a letter
    [(14_400, 14_400), (1, 14_400), (14_400, 1), (0.001, 0.001), (3, 3), (1e9, 1e9), (1e38, 1.0),
     (1e300, 1e300)],
)  # fmt: skip
def test_odd_pages_are_bounded(size: tuple[float, float]) -> None:
    writer = PdfWriter()
    writer.add_blank_page(*size)
    made = picture(saved(writer), 0)
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


def test_every_page_of_a_report_is_drawn() -> None:
    made = pictures(REPORT.read_bytes())
    assert len(made) == len(PdfReader(REPORT).pages)
    assert {opened(one).size for one in made} == {(701, 991)}
    assert made[0] == picture(REPORT.read_bytes(), 0)
