"""The seal of a report: whole as written, broken by any change."""

from __future__ import annotations

import io

from hypothesis import given
from hypothesis import strategies as st
from pypdf import PdfReader, PdfWriter

from px4fuse.report.seal import seal_of, sealed


@given(st.binary(max_size=500), st.integers(0, 10_000), st.integers(1, 255))
def test_any_changed_byte_breaks_it(content: bytes, place: int, change: int) -> None:
    whole = sealed(b"%PDF-1.4\n" + content)
    assert seal_of(whole) == "intact"
    place %= len(whole)
    changed = whole[:place] + bytes([whole[place] ^ change]) + whole[place + 1 :]
    assert seal_of(changed) != "intact"
    assert seal_of(whole + b"\n") != "intact"
    assert seal_of(whole[:-1]) != "intact"


def test_a_pdf_that_was_saved_again_has_none() -> None:
    writer = PdfWriter()
    writer.add_blank_page(100, 100)
    out = io.BytesIO()
    writer.write(out)
    whole = sealed(out.getvalue())
    assert len(PdfReader(io.BytesIO(whole)).pages) == 1
    again = io.BytesIO()
    PdfWriter(clone_from=io.BytesIO(whole)).write(again)
    assert seal_of(again.getvalue()) == "missing"
