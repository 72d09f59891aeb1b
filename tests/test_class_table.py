"""Class table as CSV: no cell is executed as a formula by a spreadsheet program."""

from __future__ import annotations

import csv
import io
import math
import unicodedata

import pytest
from exchange import replace
from hypothesis import given
from hypothesis import strategies as st

from px4fuse.classroom.grading.model import Grade, GradedReport, ItemScore
from px4fuse.classroom.grading.outputs import (
    TITLES_AFTER_ITEMS,
    TITLES_BEFORE_ITEMS,
    _anonymise_grades,
    format_class_table,
)
from px4fuse.core.text import MAX_CELL_LENGTH, neutralise_formulas
from px4fuse.verification.model import Verification

VERIFIED = Verification("verified", (), True)
DANGEROUS = (
    "=cmd|' /C calc'!A0", "+1+1", "-2+3", "@SUM(A1)", "\t=1", "\r=1", "\n=1", "  =1", "\u00a0=1",
    "\u200b=1", "\ufeff=1", "\uff1d1", "\uff0b1", "\uff0d1", "\uff201", "\ufe661", '"=1', '""=1"',
    "'=1", "a;=1+1", 'a;"=1+1', "a; \t=1;b", "a\t=1", "a\r\n=1", "\x00=1", "\ud800=1", "\u2028=1",
    "-", "=", "\t", "\r",
)  # fmt: skip
texts = (
    st.text(max_size=40) | st.sampled_from(DANGEROUS) | st.text("=+-@;,\t\r\n\"' a1", max_size=8)
)
finite = st.floats(allow_nan=False, allow_infinity=False, width=32)


def entry(graded: GradedReport, **more) -> Grade:
    values = {"total": graded.points, "max_points": graded.max_points} | more
    return Grade(graded.student, graded.student_id, graded, **values)


def graded(text: str, numbers: dict[str, float] | None = None, points: float = 1.0) -> Grade:
    one = GradedReport(
        submission=text, student=text, student_id=text,
        verification=Verification("cannot verify", (text, text), with_log=False),
        items=(ItemScore(text, points, 2.0, text),), flags=(text, text), numbers=numbers or {},
        log_sha256="ab" * 32,
    )  # fmt: skip
    return entry(one, other_reports=(one,), submission_time=text, comment=text, flags=(text, text))


def cells(text: str, delimiter: str = ",") -> list[list[str]]:
    file = io.StringIO(text.removeprefix("\ufeff"), newline="")
    return list(csv.reader(file, delimiter=delimiter))


def is_number(cell: str) -> bool:
    try:
        return math.isfinite(float(cell)) and cell.isascii()
    except ValueError:
        return False


def may_be_formula(cell: str) -> bool:
    visible = [c for c in cell if c != '"' and unicodedata.category(c)[0] not in "ZC"]
    return bool(visible) and unicodedata.normalize("NFKC", visible[0])[0] in "=+-@"


@given(texts)
def test_grades_csv_has_no_formula_cell_for_any_delimiter(text: str) -> None:
    made = format_class_table([graded(text, {text: -3.25})])
    made.encode()
    for delimiter in (",", ";", "\t"):
        for row in cells(made, delimiter):
            for cell in row:
                assert is_number(cell) or not may_be_formula(cell), (delimiter, cell)
                assert not cell.startswith(("\t", "\r", "\n"))


@given(st.lists(st.tuples(texts, st.dictionaries(texts, finite, max_size=3)), max_size=4))
def test_grades_csv_escapes_cells_that_start_like_formulas(
    rows: list[tuple[str, dict[str, float]]],
) -> None:
    head, *rest = cells(format_class_table([graded(text, numbers) for text, numbers in rows]))
    assert tuple(head[: len(TITLES_BEFORE_ITEMS)]) == TITLES_BEFORE_ITEMS
    assert tuple(head[-len(TITLES_AFTER_ITEMS) :]) == TITLES_AFTER_ITEMS
    assert len(rest) == len(rows)
    for (text, numbers), row in zip(rows, rest, strict=True):
        assert len(row) == len(head)
        said = [neutralise_formulas(text)] * 2 + [
            neutralise_formulas(text),
            "cannot verify",
            "1",
            "",
            "2",
            "",
            "1",
        ]
        assert row[: len(TITLES_BEFORE_ITEMS)] == said
        both = neutralise_formulas(f"{text} | {text}")
        said = [
            neutralise_formulas(text),
            "",
            "",
            neutralise_formulas(text),
            both,
            neutralise_formulas(text),
            both,
            "ab" * 32,
        ]
        assert row[-len(TITLES_AFTER_ITEMS) :] == said
        found = sorted(
            float(cell) for cell in row[len(TITLES_BEFORE_ITEMS) : -len(TITLES_AFTER_ITEMS)] if cell
        )
        assert found == pytest.approx(sorted([*numbers.values(), 1.0]), rel=1e-9, abs=1e-300)


@given(texts)
def test_neutralise_csv_formulas_is_idempotent(text: str) -> None:
    once = neutralise_formulas(text)
    assert neutralise_formulas(once).replace("'", "") == once.replace("'", "")
    assert is_number(once) or not may_be_formula(once)


def test_neutralise_csv_formulas_changes_only_formulas() -> None:
    for text in DANGEROUS:
        assert neutralise_formulas(text) != text
        assert not may_be_formula(neutralise_formulas(text)), text
    for text in ("Ada", "Zoë", "李雷", "3 - 2", "a@b.nl", "x=1", "O'Neill", "0012", "", "a; b"):
        assert neutralise_formulas(text) == text
    for text in ("0042", "-17", "+49", "a.b@c.de", "s1", "x-y", "日本"):
        assert neutralise_formulas(text) == text


def test_grades_csv_begins_with_bom_and_has_crlf_line_ends() -> None:
    made = format_class_table([graded("Zoë 李雷", {"NIS": float("nan")}, points=0.1 + 0.2)])
    assert made.encode().startswith(b"\xef\xbb\xbffile,student,")
    assert made.count("\r\n") == made.count("\n") == 2
    (_, row) = cells(made)
    assert row[len(TITLES_BEFORE_ITEMS) : -len(TITLES_AFTER_ITEMS)] == ["0.3", ""]


def test_grades_csv_lists_late_and_missing_students() -> None:
    one = GradedReport("a.pdf", "A", "1", VERIFIED, (ItemScore("notes", 1.5, 2.0, ""),))
    late = entry(one, lateness_s=5400.0, deducted_points=0.4, total=1.1, comment="see me")
    pending = entry(replace(one, instructor_action="Run 0.1.1."), total=None)
    head, *rest = cells(
        format_class_table([late, pending, Grade("C", "-17", None, max_points=4.0)])
    )
    asked = ("id", "status", "points", "pending points", "deducted", "total", "hours late",
             "pending", "comment")  # fmt: skip
    assert [[dict(zip(head, row, strict=True))[name] for name in asked] for row in rest] == [
        ["1", "verified", "1.5", "", "0.4", "1.1", "1.5", "", "see me"],
        ["1", "verified", "", "1.5", "", "", "", "Run 0.1.1.", ""],
        ["-17", "missing", "", "", "", "", "", "", ""],
    ]
    assert len(cells(format_class_table([]))) == 1
    assert (
        len(neutralise_formulas("=" * 10**6)) <= MAX_CELL_LENGTH + 1
    )  # maximum length of a cell in Excel


def test_new_student_gets_the_first_free_pseudonym(tmp_path) -> None:
    names = tmp_path / "names.csv"
    students = [Grade("", f"id{number}", None) for number in range(40)]
    names.write_text(_anonymise_grades(students[:39], names)[1])
    before = names.read_text()
    grades, text = _anonymise_grades(students, names)
    assert grades[39].student == "Student 040"
    assert [line for line in text.splitlines() if "id39" not in line] == before.splitlines()
