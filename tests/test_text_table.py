"""Text, numbers and lines of the tables that people hand in."""

from __future__ import annotations

import pytest

from px4fuse.readers.text_table import is_number, quote, text_of

TEXT = "time,x\n1,2\n"


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "latin-1"])
def test_text_in_any_encoding(encoding: str) -> None:
    assert text_of(("# Köln\n" + TEXT).encode(encoding)) == "# Köln\n" + TEXT


@pytest.mark.parametrize("end", ["\r\n", "\r", "\n"])
def test_ends_of_lines_and_nuls_of_a_power_cut(end: str) -> None:
    assert text_of(TEXT.replace("\n", end).encode() + bytes(512)) == TEXT


@pytest.mark.parametrize(
    "content", [b"ULog\x01\x12", b"1,2\n" * 50_000 + b"\0\n1,2\n", bytes(range(256))]
)
def test_binary_files_have_no_text(content: bytes) -> None:
    assert text_of(content) is None


@pytest.mark.parametrize("text", ["1", "-1.", "+.5", "1e-3", "1.5E+10", "nan", "-INF"])
def test_numbers(text: str) -> None:
    assert is_number(text)
    float(text)


@pytest.mark.parametrize("text", ["", ".", "1,5", "1_0", "0x1f", "1.2.3", "١", "12m", "infinite"])
def test_what_is_no_number(text: str) -> None:
    assert not is_number(text)


def test_long_texts_are_shortened() -> None:
    assert quote("a" * 40) == repr("a" * 40)
    assert quote("a" * 41) == repr("a" * 37 + "...")
