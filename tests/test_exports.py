"""Grades in the tables that learning platforms import, with the titles that they write."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import pytest
from class_tools import entry

from px4fuse.assignment.roster import Person, Register, people_of_sheet
from px4fuse.assignment.sheet import read_sheet
from px4fuse.errors import SettingsError
from px4fuse.grading.outputs import filled, grade_column

# As mod/assign/gradingtable.php of Moodle writes it
MOODLE = (
    'Identifier,"Full name","Email address",Status,Grade,"Maximum Grade","Grade can be changed",'
    '"Last modified (submission)","Last modified (grade)","Feedback comments"\r\n'
    '"Participant 4711","Doe Jane",jane@x.edu,"Submitted for grading",,100.00,Yes,'
    '"Friday, 20 November 2026, 11:58 PM",-,\r\n'
    '"Participant 4712","=Roe, ""Max""",max@x.edu,"No submission",,100.00,Yes,-,-,\r\n'
    '"Participant 4713","Pending Pat",pat@x.edu,"No submission",55.00,100.00,Yes,-,-,old\r\n'
)
CANVAS = (
    "Student,ID,SIS User ID,SIS Login ID,Section,Quiz (8),Lab 3 (9),Roll (7),Final Score\n"
    ",,,,,,Manual Posting,,\n"
    "    Points Possible,,,,,10.00,100.00,(read only),(read only)\n"
    '"Doe, Jane",12345,0042,jdoe,A,8.00,,1,90\n'
    '"Roe, Max",12346,43,mroe,A,7.00,,1,80\n'
    '"Pat, Pending",12347,44,ppat,A,7.00,,1,80\n'
)
TITLE = "Lab 3 [Total Pts: 100 Score] |1281892"
BLACKBOARD = (
    '"Last Name"\t"First Name"\t"Username"\t"Student ID"\t"Lab 3 [Total Pts: 100 Score] |1281892"\t'
    '"Grading Notes"\t"Notes Format"\t"Feedback to Learner"\t"Feedback Format"\n'
    '"Doe"\t"Jane"\t"jdoe"\t"0042"\t""\t""\t""\t""\t""\n'
    '"Roe"\t"Max"\t"mroe"\t"43"\t""\t""\t""\t""\t""\n'
    '"Pat"\t"Pending"\t"ppat"\t"44"\t"1"\t""\t""\t""\t""\n'
)
PEOPLE = [
    Person("0042", "Jane Doe", "jane@x.edu", "jdoe"),
    Person("43", "Max Roe", "max@x.edu", "mroe"),
    Person("44", "Pending Pat", "pat@x.edu", "ppat"),
]
ENTRIES = (
    entry("0042", "Jane Doe", 87.5, of=120.0),
    entry("43", "Max Roe", 104.0, of=120.0),
    entry("44", "Pending Pat", None, of=120.0),
)
TEXTS = ("Points 87.5\n  <b>=1+1</b>\n", "Well done.\n", "Pending.\n")


def table(tmp_path: Path, text: str, encoding: str = "utf-8-sig"):
    path = tmp_path / "table.csv"
    path.write_bytes(text.encode(encoding))
    return read_sheet(path)


def rows(text: str, separator: str = ",") -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text, newline=""), delimiter=separator))


def register(sheet) -> Register:
    return Register(PEOPLE, people_of_sheet(sheet))


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
@pytest.mark.parametrize(
    ("text", "column", "title", "feedback"),
    [
        (MOODLE, "", "Grade", "Feedback comments"),
        (CANVAS, "Lab 3", "Lab 3 (9)", None),
        (BLACKBOARD, TITLE, TITLE, "Feedback to Learner"),
    ],
)
def test_a_platforms_table_comes_back_with_two_columns_filled(
    tmp_path, text, column, title, feedback, encoding
) -> None:
    sheet = table(tmp_path, text, encoding)
    made, notes = filled(sheet, ENTRIES, register(sheet), column, TEXTS)
    content = made.content()
    assert content[:2] == sheet.path.read_bytes()[:2]
    separator = "\t" if text is BLACKBOARD else ","
    before, after = rows(text, separator), rows(content.decode(encoding), separator)
    assert list(after[0]) == list(before[0])
    assert len(after) == len(before)
    people = after[2:] if text is CANVAS else after
    for old, new in zip(before, after, strict=True):
        assert {key for key in old if old[key] != new[key]} <= {title, feedback}
    grades = [row[title] for row in people]
    assert grades[:2] == ["87.5", "104"]
    # who has no grade keeps what is there: an empty cell would delete, a zero would count
    assert after[-1] == before[-1]
    if text is MOODLE:
        assert people[0][feedback] == "Points 87.5<br>&nbsp;&nbsp;&lt;b&gt;=1+1&lt;/b&gt;"
    if text is not BLACKBOARD:
        assert any("more than the platform's 100" in note for note in notes)


def test_a_row_is_found_by_participant_email_id_or_name(tmp_path) -> None:
    hidden = MOODLE.replace("Doe Jane", "").replace("jane@x.edu", "")
    sheet = table(tmp_path, hidden)
    people = Register([Person("0042", numbers={"moodle": "4711"}), *PEOPLE[1:]])
    assert filled(sheet, ENTRIES, people, "", TEXTS)[0].rows[0][4] == "87.5"


def test_who_is_not_in_the_table_is_said(tmp_path) -> None:
    sheet = table(tmp_path, "\r\n".join(MOODLE.split("\r\n")[:2]) + "\r\n")
    _, notes = filled(sheet, ENTRIES, register(sheet), "", TEXTS)
    assert notes == ("table.csv: it has no row for Max Roe.",)


def test_a_german_table_has_its_separator_and_comma(tmp_path) -> None:
    text = "Matrikelnummer;Name;Punkte;Kommentar\n0042;Jane Doe;;\n"
    sheet = table(tmp_path, text, "cp1252")
    made, _ = filled(sheet, ENTRIES, Register(PEOPLE), "", TEXTS)
    assert made.content() == b"Matrikelnummer;Name;Punkte;Kommentar\r\n0042;Jane Doe;87.5;\r\n"
    moodle = MOODLE.replace(",100.00,", ',"100,00",')
    sheet = table(tmp_path, moodle)
    made, _ = filled(sheet, ENTRIES, register(sheet), "", TEXTS)
    assert made.rows[0][4] == "87,5"


@pytest.mark.parametrize(
    ("text", "column", "says"),
    [
        (CANVAS, "", r"several columns.*--column: Quiz, Lab 3\."),
        (CANVAS, "Roll", "no column for the grade"),
        (CANVAS, "Lab 4", "no column for the grade"),
        (CANVAS, "Final Score", "no column for the grade"),
        ("id,name\n1,A\n", "", "no column for the grade"),
    ],
)
def test_the_column_of_the_grade_is_named_or_the_only_one(tmp_path, text, column, says) -> None:
    with pytest.raises(SettingsError, match=says) as caught:
        grade_column(table(tmp_path, text), column)
    assert "\n" not in str(caught.value)
