"""Class page in a browser; text of students is never interpreted as HTML or script."""

from __future__ import annotations

import csv
import io
import json
import re
import unicodedata
from pathlib import Path
from typing import Any

import pytest
from browser import Browser, Elements, content
from golden_tools import assert_matches_golden, of_values
from hypothesis import given
from hypothesis import strategies as st

from px4fuse.classroom.grading.class_page import format_class_page
from px4fuse.classroom.grading.model import Grade, GradedReport, GradeOverride, ItemScore
from px4fuse.classroom.grading.outputs import anonymise_grade
from px4fuse.html.safe import MAX_TEXT_LENGTH
from px4fuse.results.answer_form import Answers, NamedFault
from px4fuse.verification.model import Mismatch, PageDifference, Verification

MARKUP = '<img src=x onerror="window.alive=1"><b>bold</b>'
BREAKOUT = "</script ></script\n<script>window.alive=2</script><!-- \u2028 ]]> & &lt;"
SHOWN_BREAKOUT = BREAKOUT.replace("\u2028", "")
FORMULA = "=cmd|' /C calc'!A0"
REVERSED = "\u202egnp.exe\u202c"
TURNED = "gnp.exe"
LONG = "W" * 5000


def graded(name: str, points: float | None, **more: Any) -> GradedReport:
    status, reasons = more.pop("status", "verified"), more.pop("reasons", ("All agrees.",))
    verdict = Verification(status, reasons, True, pages=more.pop("pages", ()))
    items = () if points is None else (
        ItemScore("Pages", min(points, 4.0), 4.0, "There."),
        ItemScore("Notes", points - 4, 16.0, "–")
    )  # fmt: skip
    return GradedReport(
        more.pop("file", f"{name.lower()}.pdf"), name, more.pop("id", ""), verdict,
        more.pop("items", items), **more,
    )  # fmt: skip


OF_ENTRY = ("submitted_at", "lateness_s", "deducted_points", "overrides", "comment", "total",
            "other_reports")  # fmt: skip


def row(name: str, points: float | None, **more: Any) -> Grade:
    """Make the grade of a student with one report; other arguments are for the report."""
    own = {key: more.pop(key) for key in OF_ENTRY if key in more}
    one = graded(name, points, **more)
    own["submission_time"] = own.pop("submitted_at", "")
    own.setdefault("total", None if points is None else one.counted_points)
    return Grade(name, one.student_id, one, max_points=one.max_points, flags=one.flags, **own)


FORM = Answers(
    log_sha256="a" * 64,
    mistakes=(NamedFault(MARKUP, 1.0, BREAKOUT, panel=MARKUP, parameter=BREAKOUT),),
)
CLASS = (
    row(
        "Zoë",
        18.5,
        id="1007",
        redrawn_report_path="reports/1007.pdf",
        did_student_name_fault={"positions that jump": True},
    ),
    row(
        "ada",
        9.0,
        id="1001",
        status="numbers differ",
        flags=("The same log as Zoë.",),
        did_student_name_fault={"positions that jump": False, "outliers": False},
        lateness_s=7200.0,
        deducted_points=1.0,
    ),
    row("Émile", 9.0, id="1010"),
    row("Bo", 20.0, id="99"),
    row(
        "",
        None,
        file="broken.pdf",
        status="cannot verify",
        reasons=("Not a PDF.",),
        instructor_action="Ask for the PDF.",
    ),
    row(
        MARKUP,
        5.0,
        id=FORMULA,
        file=BREAKOUT,
        flags=(MARKUP, MARKUP),
        notes=BREAKOUT,
        reasons=(BREAKOUT,),
        instructor_action=MARKUP,
        form=FORM,
        did_student_name_fault={MARKUP: False},
        redrawn_report_path="javascript:alert(1)",
        comment=BREAKOUT,
        items=(
            ItemScore(
                BREAKOUT, 5.0, 20.0, MARKUP, is_scored_by_instructor=True, is_awaiting_points=True
            ),
        ),
        submitted_at=MARKUP,
        overrides={BREAKOUT: GradeOverride(None, MARKUP)},
    ),
    row(REVERSED, 8.0, id="5"),
    row(LONG, 7.0, id="6"),
    Grade("Mia", "1011", None),
)


# ------------------------------------------------------------------ without a browser


def shape(text: str) -> list[tuple[str, list[str]]]:
    return [(tag, sorted(attributes)) for tag, attributes in Elements(text).found]


def test_grades_page_html_equals_reference_file() -> None:
    text = format_class_page(CLASS, "Class", "px4fuse 1")
    above = re.sub(r"<(script|style).*?</\1>", "", text, flags=re.DOTALL).splitlines()
    lines = [line for line in above if line.strip() and "sha256" not in line]
    lines += of_values(content(text))
    assert_matches_golden("class_page", [line[:300] for line in lines])


@given(text=st.text(max_size=60) | st.sampled_from([MARKUP, BREAKOUT, "\0\x1b\ud800", "$title"]))
def test_grades_page_escapes_html_in_student_text(text: str) -> None:
    def page(word: str) -> str:
        one = row(
            word, 5.0, id=word, file=f"{word}.pdf", flags=(word,), reasons=(word,),
            notes=f"So: {word}",
            items=(ItemScore(word, 5.0, 20.0, word),),
            did_student_name_fault={word: False},
            instructor_action=word, form=FORM, comment=word,
        )  # fmt: skip
        return format_class_page([one], word, word)

    made = page(text)
    made.encode()
    # An empty name is marked as missing
    assert shape(made) == shape(page("x" if text else ""))


def test_grades_page_mean_excludes_pending_points() -> None:
    said = {"Notes": GradeOverride(9.0, "Good.")}
    grades = [row("Ada", 10.0, lateness_s=61), row("Bo", 20.0),
               row("Cy", 12.0, instructor_action="Run 0.1.1."),
               row("Di", 13.0, overrides=said, total=13.0)]  # fmt: skip
    text = format_class_page(grades, "Class", "px4fuse 1")
    assert "2 min late" in text  # 61 s are rounded up
    assert "14.3 <small>of 20" in text  # mean of 10, 20 and 13
    assert "1 <small>12 points" in text
    # mean of 6, 16 and 9 of 16 points for notes
    assert "10.3&nbsp;/&nbsp;16" in text
    cells = [row[0][3] for row in content(text)["rows"]]
    assert cells[2:] == [["pending", None, "12 proposed", ""],
                         ["13 / 20", 13.0, "changed by instructor", ""]]  # fmt: skip


def test_grades_page_shortens_long_text() -> None:
    odd = row("x" * 10**6, 3.0, notes="y" * 10**6)
    text = format_class_page([odd], "Class", "px4fuse 1")
    assert len(text) < 16 * MAX_TEXT_LENGTH
    apart = (Mismatch("axes.49", "1.0", "2.0"),)
    one = GradedReport("a.pdf", "Ada", "1", Verification("numbers differ", ("60.",), True, apart))
    text = format_class_page([Grade("Ada", "1", one)], "Class", "px4fuse 1")
    assert '["axes.49","1.0","2.0"]' in text


PEOPLE = (
    ("Ada Lovelace", "10017", "Lovelace Ada_4711_assignsubmission_file_/ada report.pdf"),
    ("Émile du Châtelet", "s-2031", "chatelet/Émile_du_Châtelet.pdf"),
    ("王小明", "30044", "30044.pdf"),
    ("Quirin Mikkelsen", "20", ""),
)
SAYS = "Ada and LOVELACE, s-2031 and 30044; by E\u0301mile du Cha\u0302telet, see lab_Ada_2."


def anonymous_class() -> list[Grade]:
    grades = []
    for number, (name, student_id, file) in enumerate(PEOPLE):
        others = [one for one in PEOPLE if one[0] != name]
        flag = f"The same log as {others[0][0]}, {others[0][1]} ({others[0][2] or 'x'}). {SAYS}"
        said = f"Your report names {name}, {student_id}. {SAYS}"
        grade = row(
            name, 9.0, id=student_id, file=file, flags=(flag,), reasons=(said,),
            instructor_action=said,
            notes=f"{name} ({student_id}): {SAYS} 王小明", form=FORM,
            items=(ItemScore("Settings", 9.0, 20.0, said),),
            did_student_name_fault={"positions that jump": False}, comment=said,
            overrides={"Settings": GradeOverride(10.0, said)},
            other_reports=(graded(name, 3.0, file=f"old/{file}"),),
            redrawn_report_path=f"reports/{student_id}.pdf", sha256="ab" * 32,
        )  # fmt: skip
        grade = grade if file else Grade(name, student_id, None)
        grades.append(anonymise_grade(grade, f"Student {(7 * number) % 4 + 1:03}"))
    return grades


def test_grades_page_in_anonymous_mode_contains_no_names() -> None:
    text = format_class_page(anonymous_class(), "Class", "px4fuse 1")
    written = unicodedata.normalize("NFC", text + json.dumps(content(text), ensure_ascii=False))
    for name, student_id, file in PEOPLE:
        for word in (*name.split(), student_id, *re.split(r"[/. _]", file)):
            if len(word) > 2 and word.lower() not in ("pdf", "report", "file", "assignsubmission"):
                assert word.casefold() not in written.casefold(), word
    assert "Student 003" in written
    parts = [part for one in content(text)["rows"] for part in one[2]]
    points = [part[2] for part in parts if part[1] == "Points (proposed)"]
    assert {tuple(row) for rows in points for row in rows} == {("Settings", "9", "20", "")}
    assert "missed: positions that jump" in written
    # no text of students, no link to a PDF, no input boxes without an owner
    assert not {"boxes", "prose", "links"} & {part[0] for part in parts}
    for there in ("Lovelace", ".pdf", "data:image/png"):
        assert there not in written


# ------------------------------------------------------------------ in a browser


@pytest.fixture
def page(browser: Browser, tmp_path: Path) -> Browser:
    file = tmp_path / "class.html"
    file.write_bytes(format_class_page(CLASS, "Navigation lab & more", "px4fuse 1").encode())
    browser.open(file)
    return browser


HEADS = ("Student", "Id", "Status", "Points", "Handed in", "Flags", "Pages", "Notes", BREAKOUT)


def test_grades_page_filters_reports_by_text_and_status(page: Browser) -> None:
    count = "document.querySelector('.count').textContent"
    assert page.ask(count) == f"Showing {len(CLASS)} of {len(CLASS)}"
    page.click("#text")
    page.write("zoe")
    # the row of Zoë, and one with a flag that contains the name
    assert page.names() == ["Zoë", "ada"]
    assert page.ask(count) == f"Showing 2 of {len(CLASS)}"
    page.write(" nobody")
    assert page.names() == []
    page.click("#all")
    assert len(page.names()) == len(CLASS)
    for status, names in (("numbers differ", ["ada"]), ("flagged", ["ada", MARKUP]),
                          ("to read", [MARKUP]), ("no submission", ["Mia"])):  # fmt: skip
        page.choose("#filter-0", status)
        assert page.names() == names
    page.choose("#filter-0", "missed: outliers")
    assert page.names() == ["ada"]
    assert page.complaints() == []


def test_grades_page_click_on_row_opens_report_details(page: Browser) -> None:
    page.click("tbody tr:first-child .name")
    assert page.ask("document.querySelector('.unfold').ariaExpanded") == "true"
    assert "There." in page.ask("document.querySelector('.more').innerText")
    assert page.ask("document.querySelector('.detail a').href").endswith("/reports/1007.pdf")
    # details are sorted and filtered with their row
    page.click(f".list > thead th:nth-child({HEADS.index('Points') + 1}) button")
    before = "document.querySelector('.more').previousElementSibling.querySelector('.name')"
    assert page.ask(f"{before}.textContent") == "Zoë"
    page.click("#text")
    page.write("ada")
    assert page.ask("document.querySelector('.more') === null")
    assert page.complaints() == []
    assert page.requests() <= {"file", "data"}


def test_grades_page_has_link_to_report_recomputed_from_log() -> None:
    one = row(
        "Zoë", 18.5, redrawn_report_path="reports/1.pdf", pages=(PageDifference(1, "a word"),)
    )
    made = content(format_class_page([one, row("Bo", 1.0)], "Class", "px4fuse 1"))
    (leads,) = (part for part in made["rows"][0][3] if part[0] == "links")
    assert [to for _, to in leads[2]] == ["reports/1.pdf"]
    assert made["rows"][1][3] == []


def test_grades_page_shows_markup_in_student_text_as_text(page: Browser) -> None:
    page.ask("[...document.querySelectorAll('.unfold')].forEach((button) => button.click())")
    named = [TURNED if one.student == REVERSED else one.display_name for one in CLASS]
    assert page.names() == named
    row = page.ask(
        "[...document.querySelector('.list > tbody > tr:nth-child(11)').querySelectorAll("
        "':scope > :nth-child(2), .file, li')].map((node) => node.textContent)"
    )
    assert row == [SHOWN_BREAKOUT, FORMULA, "2 flags", "5 proposed", MARKUP, MARKUP]
    shown = page.ask(
        "document.querySelector('.list > tbody > tr:nth-child(11)').nextSibling.textContent"
    )
    assert shown.count(SHOWN_BREAKOUT) >= 4  # reason, notes, item, comment
    assert shown.count(MARKUP) >= 4  # flag, comment, pending, name
    assert LONG in page.ask("document.querySelector('.list > tbody').textContent")
    assert page.ask("document.querySelectorAll('b, svg[onload], img[onerror]').length") == 0
    assert page.ask("document.images.length") == 0
    assert page.ask("document.scripts.length") == 2
    leads = page.ask("[...document.links].map((link) => link.protocol)")
    assert set(leads) == {"file:"}
    assert page.ask("window.alive === undefined")
    assert page.complaints() == []
    assert page.requests() <= {"file", "data"}


def test_grades_page_content_security_policy_blocks_requests(page: Browser) -> None:
    page.ask(
        "document.body.insertAdjacentHTML('beforeend',"
        ' \'<img src="http://127.0.0.1:9/x.png" onerror="window.alive=3">\')'
    )
    page.ask("fetch('http://127.0.0.1:9/').catch(() => {})")
    assert page.ask("window.alive === undefined")
    refusals = [c["entry"]["text"] for c in page.complaints() if "entry" in c]
    assert len([text for text in refusals if "Content Security Policy" in text]) >= 2
    assert any("img-src" in text and "127.0.0.1" in text for text in refusals)


def test_grades_page_downloads_points_and_comments_as_csv(page: Browser) -> None:
    page.ask("URL.createObjectURL = (one) => { window.table = one.text(); return '#'; }; 0")
    assert not page.ask("document.querySelector('#save').checkVisibility()")
    page.ask("document.querySelector('.list > tbody > tr .unfold').click()")
    page.ask(
        "(() => { const [points] = document.querySelectorAll('.boxes input');"
        " const [words] = document.querySelectorAll('.boxes textarea');"
        " points.value = '7.5'; words.value = '=1+1, \"well\"';"
        " words.dispatchEvent(new Event('input')); })()"
    )
    leave = "window.dispatchEvent(new Event('beforeunload', { cancelable: true }))"
    assert not page.ask(leave)  # the browser warns of unsaved changes
    page.click("#save")
    made = str(page.ask_later("window.table"))
    rows = list(csv.reader(io.StringIO(made.removeprefix("\ufeff"))))
    assert page.ask(leave)
    assert rows[0] == ["id", "item", "points", "comment"]
    assert ["1007", "total", "7.5", '\'=1+1, "well"'] in rows
    assert ["'" + FORMULA, SHOWN_BREAKOUT, "", MARKUP] in rows  # earlier comments are kept
