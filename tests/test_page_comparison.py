"""Content streams, glyphs and lines: what is the same drawing, and what is not read at all."""

from __future__ import annotations

import contextlib
import io
import math

import pytest
from forgery import numbers_of, taken_apart
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from pypdf import PdfWriter

from px4fuse.report.seal import sealed
from px4fuse.report.style import report_style
from px4fuse.verification.content_stream import UnreadableError, operations
from px4fuse.verification.glyphs import code_texts
from px4fuse.verification.page_comparison import Compared, compare_pdf, plain_layout, same_words


def drawn(*texts: str, thinned: float = 0.5, by: float = 0.0, size: float = 12.0) -> bytes:
    """A PDF as a report is made: a page with a curve and each of some texts."""
    out = io.BytesIO()
    with report_style(), PdfPages(out, metadata={"CreationDate": None}) as pdf:
        for text in texts:
            figure = Figure(figsize=(4, 4))
            figure.text(0.1, 0.9, text, size=size)
            axes = figure.add_axes((0.1, 0.1, 0.8, 0.7))
            x = [i / 400.0 for i in range(401)]
            (line,) = axes.plot(x, [math.sin(9.0 * one) + by for one in x])
            line.get_path().simplify_threshold = thinned
            axes.plot([0.5], [0.5], "o")
            axes.set_ylim(-2, 2)
            pdf.savefig(figure)
    writer = PdfWriter(clone_from=io.BytesIO(out.getvalue()))
    writer.add_attachment("results.json", b"{}")
    made = io.BytesIO()
    writer.write(made)
    return sealed(made.getvalue())


def test_what_is_the_same() -> None:
    pdf = drawn("one 1.25", "two")
    assert compare_pdf(pdf, pdf) == Compared({}, (), True)
    assert plain_layout(pdf)


def test_another_text_is_found_on_its_page() -> None:
    altered = compare_pdf(drawn("one", "two 2.6"), drawn("one", "two 2.5")).pages
    assert set(altered) == {2}
    assert "'two 2.6' where px4fuse prints 'two 2.5'" in altered[2]


def test_rounding_is_for_the_caller_to_allow() -> None:
    """The subsets of the fonts differ then, and are compared glyph by glyph."""
    one, other = drawn("x 2.6"), drawn("x 2.5")
    asked = []

    def alike(theirs: str, ours: str) -> bool:
        asked.append((theirs, ours))
        return True

    # a 6 is not among the letters that px4fuse drew, so that nothing says how one looks
    assert not compare_pdf(one, drawn("x 2.56"), alike).pages.keys() - {1}
    assert compare_pdf(drawn("6 x 2.6 5"), drawn("6 x 2.5 5"), alike).pages == {}
    assert ("2.6", "2.5") in asked
    assert 1 in compare_pdf(one, other).pages


def test_a_line_thinned_in_another_way_is_the_same_line() -> None:
    assert compare_pdf(drawn("a", thinned=0.1), drawn("a", thinned=0.5)).pages == {}
    moved = compare_pdf(drawn("a", thinned=0.1, by=0.1), drawn("a", thinned=0.5)).pages
    assert moved == {1: "a line is drawn at another place"}


@pytest.mark.parametrize(("by", "same"), [(0.001, True), (0.05, False)])
def test_lines_are_the_same_within_half_a_point(by: float, same: bool) -> None:
    assert (compare_pdf(drawn("a", by=by), drawn("a")).pages == {}) == same


def test_pages_more_and_fewer() -> None:
    three, two = drawn("a", "b", "c"), drawn("a", "b")
    assert compare_pdf(three, two).pages[3] == "px4fuse prints only 2 pages"
    assert compare_pdf(two, three).pages[3] == "it is missing"
    assert compare_pdf(drawn("b", "a"), two).pages[1] == "it is what page 2 should be"


@given(st.binary(max_size=300))
def test_no_bytes_are_more_than_unreadable(content: bytes) -> None:
    with contextlib.suppress(UnreadableError):
        operations(content)


@pytest.mark.parametrize(
    "content",
    [b"% comment", b"BI ID EI", b"<< /A 1 >> gs", b"[ [ 1 ] ] TJ", b"] TJ", b"[ 1 TJ", b"1 2",
     b"(a(b)c) Tj", b"0 0 m 1 1 l", b"1e5 w", b"true w", b"1-2 w"],
)  # fmt: skip
def test_what_px4fuse_never_writes_is_not_read(content: bytes) -> None:
    with pytest.raises(UnreadableError):
        operations(content)


def test_strings_and_numbers() -> None:
    found = operations(b"[ (\\(a\\051\\\\) -1.5 <4142> ] TJ /F1 .5 Tf")
    assert found[0].operands == [[b"(a)\\", -1.5, b"AB"]]
    assert found[1].operands == ["/F1", 0.5]


def test_a_stream_that_expands_is_not_inflated() -> None:
    """Of what is handed in no more is unpacked than what should be there."""
    pdf = drawn("a")
    number = numbers_of(pdf).contents[0]
    bomb = taken_apart(pdf).streamed(number, lambda content: content + b" " * 50_000_000)
    altered = compare_pdf(bomb.sealed(), pdf).pages
    assert altered == {1: "it is much longer than what px4fuse draws"}


@settings(deadline=None)
@given(st.binary(max_size=400))
def test_any_other_bytes_are_compared_without_an_error(content: bytes) -> None:
    pdf = drawn_once()
    assert compare_pdf(content, pdf).pages
    assert not plain_layout(content)


def drawn_once(made: list[bytes] = []) -> bytes:  # noqa: B006
    if not made:
        made.append(drawn("a"))
    return made[0]


def test_words() -> None:
    assert same_words("a 1.5 b", "a 1.6 b", lambda *_: True)
    assert not same_words("a 1.5 b", "a 1.6 c", lambda *_: True)
    assert not same_words("a 1.5 b", "a 1.6 b", lambda *_: False)
    assert code_texts(b"beginbfchar <0001> <D83DDE00> endbfchar") == {1: "\N{GRINNING FACE}"}
