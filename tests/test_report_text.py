"""Texts on pages: fonts for any script, Markdown notes, time offset page."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import typst
from exchange import replace
from findings_tools import source
from hypothesis import given
from hypothesis import strategies as st
from matplotlib import font_manager
from page_tools import set_by_typst

from px4fuse.analysis import Analysis
from px4fuse.filter.time_offset import FlightPartTimeOffset, SourceTimeOffset
from px4fuse.finding import Finding
from px4fuse.flight.model import Unavailable
from px4fuse.report import clock, fonts, notes, typesetting
from px4fuse.report.notes import write_markdown
from px4fuse.report.page import Page, PageBlock, replace_unprintable
from px4fuse.report.typesetting import compile_pdf
from px4fuse.results.model import Student

THAI, HAN, ARABIC = "สมชาย", "王小明", "محمد"


def written(markdown: str) -> list[PageBlock]:
    page = Page()
    write_markdown(page, markdown)
    return page.blocks


@pytest.fixture
def _clear_font_caches(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Clear the cached fonts before and after the test."""

    def clear_caches() -> None:
        for cached in (fonts.find_font, fonts._list_fonts_except_dejavu):
            cached.cache_clear()

    clear_caches()
    yield
    monkeypatch.undo()
    clear_caches()


def with_font(monkeypatch: pytest.MonkeyPatch, name: str, characters: str) -> None:
    """Pretend that one more font with these characters is installed."""
    monkeypatch.setattr(fonts, "_list_fonts_except_dejavu", lambda: ((name, "path"),))
    own = fonts._read_font_characters
    with_one_more = {"path": frozenset(map(ord, characters))}
    monkeypatch.setattr(
        fonts, "_read_font_characters", lambda path: with_one_more.get(path) or own(path)
    )


@pytest.mark.usefixtures("_clear_font_caches")
def test_characters_missing_in_dejavu_use_an_installed_font(monkeypatch) -> None:
    with_font(monkeypatch, "Some Thai", THAI)
    assert fonts.find_missing_characters(f"Ångström σ Жанна {ARABIC} 5 ≤ 6") == ""
    assert fonts.find_font_names(f"Ångström {ARABIC}") == [fonts.FONT]
    assert fonts.find_font_names(f"{THAI} and me") == [fonts.FONT, "Some Thai"]
    assert fonts.find_missing_characters(f"{THAI} {HAN}") == HAN


@pytest.mark.usefixtures("_clear_font_caches")
def test_characters_without_any_font_are_printed_as_squares(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(fonts, "_list_fonts_except_dejavu", lambda: ())
    assert fonts.find_font_names(THAI + HAN) == [fonts.FONT]
    assert replace_unprintable(f"a {HAN}\x1b b") == "a □□□ b"
    advice = fonts.format_font_advice(THAI + HAN)
    assert "characters สมชาย王小明;" in advice
    assert "fonts.google.com" in advice


@pytest.mark.usefixtures("_clear_font_caches")
def test_fonts_that_draw_only_boxes_are_ignored(monkeypatch: pytest.MonkeyPatch) -> None:
    own = font_manager.findfont(fonts.FONT)
    entries = [
        SimpleNamespace(name=name, style="normal", weight=400, fname=str(own), index=0)
        for name in ("Zebra", "Noto Sans Thai", "LastResort", "Adobe Blank", "An Alphabet Sans")
    ]
    manager = SimpleNamespace(ttflist=entries, addfont=lambda _: None)
    monkeypatch.setattr(font_manager, "fontManager", manager)
    monkeypatch.setattr(font_manager, "findSystemFonts", list)
    assert [name for name, _ in fonts._list_fonts_except_dejavu()] == [
        "Noto Sans Thai",
        "An Alphabet Sans",
        "Zebra",
    ]


def test_markdown_lists_in_notes_keep_bullets_and_indent() -> None:
    blocks = written("- a\n  - b\n\n    c\n- d\n\n7. e\n8. f\n\n- - g\n")
    assert [(b["mark"], b["text"], b["indent"] / notes.INDENT) for b in blocks] == [
        ("•", "a", 1), ("•", "b", 2), ("", "c", 2), ("•", "d", 1),
        ("7.", "e", 1), ("8.", "f", 1), ("•", "", 1), ("•", "g", 2),
    ]  # fmt: skip


def test_markdown_code_in_notes_keeps_spaces_and_dollar_signs() -> None:
    assert replace_unprintable("\N{NO-BREAK SPACE}x\n") == "\N{NO-BREAK SPACE}x\n"
    (code,) = written("```\nif x:\n    $y$ <b>\n```")
    assert code["text"].replace("\N{NO-BREAK SPACE}", " ") == "if x:\n    $y$ <b>"


@pytest.mark.parametrize(
    ("markdown", "read_as"),
    [
        ("# A *b* **c**\n\nd `e` ~~f~~ g\nh\n\n> i", ["A b c", "d e f g h", "i"]),
        ("a  \nb", ["a\nb"]),
        ("[x](https://y.z) <https://y.z>", ["x (https://y.z) https://y.z"]),
        ("SIGMA_A and SIGMA_Z, 2 * 3 * 4", ["SIGMA_A and SIGMA_Z, 2 * 3 * 4"]),
        # dollar signs are unchanged
        ("costs $5 and $10", ["costs $5 and $10"]),
        (r"\$5 and `$x$`", ["$5 and $x$"]),
        # emphasis can be nested deeper than Python's recursion limit
        ("*" * 5000 + "a" + "*" * 5000, ["a"]),
        # pictures become descriptions, HTML tags are removed
        ("![a map](m.png) ![](m.png)", ["[picture: a map] [picture]"]),
        ("a <b>c</b> d &amp; e", ["a c d & e"]),
        ("<div><p>a</p></div>\n\n<!-- no -->\n\nyes", ["a", "yes"]),
    ],
)
def test_markdown_in_student_notes_becomes_plain_text(markdown: str, read_as: list[str]) -> None:
    assert [block["text"] for block in written(markdown) if block["text"]] == read_as


@given(st.text(st.sampled_from("#*-_`$|<>[]()!\\ \n1.ab{}^&;~="), max_size=80))
def test_any_markdown_in_student_notes_is_converted(text: str) -> None:
    assert all(block["kind"] in ("text", "heading", "table") for block in written(text))


def pages_of(student: Student) -> Iterator[Page]:
    empty = object.__new__(Analysis)  # the page uses only its type
    return notes.draw_pages(empty, SimpleNamespace(student=student))  # type: ignore[arg-type]


def test_long_notes_continue_on_next_report_pages() -> None:
    words = [f"word{number}" for number in range(1500)]
    table = "| a | b |\n|---|---|\n" + "".join(f"| r{i} | {'cell ' * 30} |\n" for i in range(40))
    student = Student("", "", " ".join(words) + "\n\n" + table)
    sheets = set_by_typst(*pages_of(student))
    assert len(sheets) > 2
    assert sheets[0].strip().startswith("Appendix: student notes")
    text = " ".join(sheets).split()
    assert [word for word in text if word.startswith("word")] == words
    assert sum(word == "cell" for word in text) == 1200
    assert not list(pages_of(Student("", "", " \n <!-- nothing --> \n")))


def test_very_long_words_in_notes_are_split() -> None:
    """PDF/A limits strings to 32,767 characters."""
    endless = "a" * 33_000
    code = '{"x": 1, ' * 4_000
    student = Student("", "", f"{endless}\n\n| {endless} |\n|---|\n\n```\n{code}\n```\n")
    text = "".join(set_by_typst(*pages_of(student)))
    assert text.count("a") >= 66_000
    assert text.count("{") == 4_000


def test_typst_code_in_student_notes_is_printed_as_text() -> None:
    hostile = '#read("/etc/passwd") #sys.inputs $x$ = y *b* @ref <label> // c'
    page = Page("Notes")
    page.write(hostile)
    page.add_table(["#panic()"], [[hostile]])
    (sheet,) = set_by_typst(page)
    assert " ".join(sheet.split()).count(hostile) == 2
    assert "#panic()" in sheet


@pytest.mark.parametrize(
    "code",
    ['read("/etc/passwd")', 'read("../../../etc/passwd")', 'image("/etc/hostname")',
     'image(bytes("<svg xmlns=\'http://www.w3.org/2000/svg\'><image href=\'/etc/hostname\' '
     'width=\'1\' height=\'1\'/></svg>"), format: "svg")'],
)  # fmt: skip
def test_typst_template_cannot_read_files(code: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(typesetting, "read_template", lambda: f"#{code}")
    with pytest.raises(typst.TypstError):
        compile_pdf({})


def offset(**changes: Any) -> SourceTimeOffset:
    curve = np.linspace(-0.1, 0.1, 21)
    parts = tuple(
        FlightPartTimeOffset(10.0 * i, 10.0 * i + 9.0, 0.06 * (i - 1), 0.02) for i in range(3)
    )
    return replace(
        SourceTimeOffset(
            applied_s=0.0, offset_s=0.005, interval_s=(-0.02, 0.03), sigma_s=0.012,
            is_determinable=True,
            likelihood_curve_offsets_s=curve, curve_log_likelihood_drops=curve**2 * 1e3,
            parts=parts,
            drift_ppm=100.0, drift_sigma_ppm=300.0, change_p_value=0.4, sigma_a_m_s2=0.1,
            sigma_z_m=0.1,
            count=200,
        ),
        **changes,
    )  # fmt: skip


def with_clock(found: SourceTimeOffset | Unavailable, delay_ms: float = 0.0) -> Any:
    log = SimpleNamespace(name="x.ulg", parameters={"EKF2_EV_DELAY": delay_ms})
    ekf2 = SimpleNamespace(parameters={"EKF2_DELAY_MAX": 200.0})
    settings, flight = SimpleNamespace(clock_offset_s=0.0), SimpleNamespace(log=log, ekf2=ekf2)
    return SimpleNamespace(
        time_offset=found, settings=settings, flight=flight, source=source(), convention=None,
        select_main_reruns=lambda: [],
    )  # fmt: skip


def test_report_omits_time_offset_page_if_not_significant() -> None:
    whole = offset(parts=())
    fine, unknown = with_clock(whole), replace(whole, is_determinable=False, reason="no motion")
    with_finding = [
        SimpleNamespace(findings=[Finding(name, "error", "", "")])
        for name in clock.TIME_OFFSET_FINDINGS
    ]
    nothing: Any = SimpleNamespace(findings=[])
    assert "no significant time offset" in clock.summarise_offset(fine, [])
    assert not list(clock.draw_pages(fine, nothing))
    for analysis, results in (
        (with_clock(unknown), nothing), *((fine, each) for each in with_finding)
    ):  # fmt: skip
        line = clock.summarise_offset(analysis, results.findings)
        assert line == ""
        assert len(list(clock.draw_pages(analysis, results))) == 1
    none = with_clock(Unavailable("clock offset", "no IMU", "Give the ULog."))
    assert (
        clock.summarise_offset(none, [])
        == "The time offset cannot be estimated: no IMU. Give the ULog."
    )
    assert not list(clock.draw_pages(none, nothing))


@pytest.mark.parametrize(
    ("changes", "delay_ms", "expected"),
    [
        ({}, 0.0, {"Result": "no significant time offset", "PX4": "0 ms agrees"}),
        ({}, 175.0, {"PX4": "Set EKF2_EV_DELAY to 0 ms (now 175 ms)"}),
        ({"offset_s": -0.25, "interval_s": (-0.28, -0.22)}, 250.0,
         {"Result": "0.250 s late", "Re-run": "--clock-offset -0.250", "PX4": "agrees"}),
        ({"offset_s": 0.25, "interval_s": (0.22, 0.28)}, 0.0,
         {"Result": "0.250 s early", "PX4": "cannot be negative"}),
        ({"offset_s": 0.009, "interval_s": (0.008, 0.0095)}, 0.0,
         {"Result": "too small for a correction: the limit is 0.036 s",
          "Offset": "The estimated time offset is"}),
        ({"offset_s": -0.25, "interval_s": (-0.28, -0.22)}, 0.0,
         {"PX4": "250 ms (now 0 ms), or correct the sender's clock. Also set "
          "EKF2_DELAY_MAX to 300 ms."}),
        ({"offset_s": -0.31, "interval_s": (-0.34, -0.28)}, 0.0,
         {"PX4": "cannot exceed 300 ms. Correct the sender's clock. Also set EKF2_DELAY_MAX to "
          "350 ms."}),
        ({"change_p_value": 0.001}, 0.0, {"Changes": "+0.00 s from 10 s"}),
        ({"drift_ppm": 1000.0}, 0.0, {"Drift": "+1000 ± 588 ppm (95 %)."}),
        ({"drift_ppm": 100.0}, 0.0, {"Drift": "not significant"}),
    ],
    ids=["fits", "other delay", "late", "early", "negligible", "delay max", "limit", "changes",
         "drift", "no drift"],
)  # fmt: skip
def test_report_on_time_offset_has_estimate_and_advised_action(
    changes: dict[str, Any], delay_ms: float, expected: dict[str, str]
) -> None:
    analysis = with_clock(offset(**changes), delay_ms)
    advice = clock.make_time_offset_advice(analysis, analysis.time_offset)
    assert all(text in advice[label] for label, text in expected.items()), advice
