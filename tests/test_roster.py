"""Tables of learning platforms: class lists, owners of files, and returned grades."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import pytest
from class_tools import grade

from px4fuse.classroom.assignment.roster import (
    ClassList,
    Person,
    Sheet,
    read_csv_sheet,
    read_people,
    read_roster,
)
from px4fuse.classroom.grading.entries import Course
from px4fuse.classroom.grading.model import SubmissionOrigin
from px4fuse.classroom.grading.outputs import fill_grades, find_grade_column
from px4fuse.classroom.grading.rubric import read_rubric
from px4fuse.errors import SettingsError

SUBMITTED = "Friday, 20 November 2026, 11:58 PM"
# format of mod/assign/gradingtable.php of Moodle
MOODLE = (
    'Identifier,"Full name","ID number","Email address",Status,Grade,"Maximum Grade",'
    '"Grade can be changed","Last modified (submission)","Last modified (grade)",'
    '"Feedback comments"\r\n'
    '"Participant 4711","Doe Jane",0042,jane@x.edu,"Submitted for grading",,100.00,Yes,'
    f'"{SUBMITTED}",-,\r\n'
    '"Participant 4712","=Roe, ""Max""",,max@x.edu,"No submission",,100.00,Yes,-,-,\r\n'
    '"Participant 4713","Pending Pat",,pat@x.edu,"No submission",55.00,100.00,Yes,-,-,old\r\n'
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
GRADES = (
    grade("0042", "Jane Doe", 87.5, max_points=120.0),
    grade("43", "Max Roe", 104.0, max_points=120.0),
    grade("44", "Pending Pat", None, max_points=120.0),
)
TEXTS = ("Points 87.5\n  <b>=1+1</b>\n", "Well done.\n", "Pending.\n")


def written(tmp_path: Path, content: str | bytes, encoding: str = "utf-8-sig") -> Path:
    path = tmp_path / "table.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode(encoding))
    return path


def table(tmp_path: Path, text: str, encoding: str = "utf-8-sig") -> Sheet:
    return read_csv_sheet(written(tmp_path, text, encoding))


# -- class lists -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "is_"),
    [
        (MOODLE, Person("0042", "Doe Jane", "jane@x.edu", "", {"moodle": "4711"}, SUBMITTED)),
        (CANVAS, Person("0042", "Doe, Jane", "", "jdoe", {"canvas": "12345"})),
        (BLACKBOARD, Person("0042", "Jane Doe", "", "jdoe")),
        ("Nachname;Vorname;Benutzername;Matrikelnummer\nDoe;Jane;jdoe;0042\n",
         Person("0042", "Jane Doe", "", "jdoe")),
        ("name\nJane Doe\n", Person("", "Jane Doe")),
        ("Email\njane@x.edu\n", Person("jane@x.edu", "", "jane@x.edu")),
    ],
)  # fmt: skip
def test_read_class_list_finds_columns_of_each_learning_platform(tmp_path, text, is_) -> None:
    for encoding in ("utf-8", "utf-8-sig", "utf-16"):
        assert read_people(table(tmp_path, text, encoding))[0] == is_


ROSTERS = {
    "gradescope": "First Name,Last Name,SID,Email\nAnn,Lee,1001,a@x\nBob,Ray,1002,b@x\n",
    "id number empty": "Name,ID number,User name\nAnn Lee,,1001\nBob Ray,,1002\n",
    "semicolons": 'Student ID;Name\r\n1001;"Ann Lee"\r\n1002;Bob Ray\r\n',
    "comma in a quoted title": '"Student ID","Name, whole"\n1001,x\n1002,y\n',
    "tabs": "Student-ID\tFull name\n1001\tAnn Lee\n1002\tBob Ray\n",
    "empty rows": "\n\nid,name\n\n1001,Ann Lee\n,\n 1002 , Bob Ray \n\n",
    "Windows-1252": "id,naïve,name\n1001,ä,Ann Lee\n1002,ö,Bob Ray\n".encode("cp1252"),
    "short rows": "name,x,id\nAnn Lee,,1001\nBob Ray,,1002,more,cells\n",
}


@pytest.mark.parametrize("content", ROSTERS.values(), ids=ROSTERS.keys())
def test_read_class_list_accepts_any_table_format(tmp_path, content) -> None:
    students = read_roster(written(tmp_path, content))
    assert [one.student_id for one in students] == ["1001", "1002"]
    assert [one.log_file_name for one in students] == ["1001.ulg", "1002.ulg"]
    if "whole" not in str(content):
        assert [one.name for one in students] == ["Ann Lee", "Bob Ray"]


BAD_ROSTERS = {
    "no id column": ("a,b\n1,2\n", "no column contains ids"), "empty": ("", "empty"),
    "header alone": ("id,name\n", "0 students"),
    "empty id": ("id,name\n1,A\n,B\n", "the id of 'B'"),
    "same id": ("id\n1\n2\n1\n", "rows 2 and 4 have the same id '1'"),
    "ids equal except for case": ("id\nab\nAB\n", "rows 2 and 3"),
    "same file": ("id\na/b\na:b\n", "the id of 'a:b' cannot be used as a file name"),
    "no usable characters": ("id\n///\n", "letters or digits"),
    "binary": (b"\x00\x01\x02id", "not a text file"),
    "spreadsheet": (b"PK\x03\x04....", "Save the table as CSV"),
    "too many": ("id\n" + "\n".join(map(str, range(1001))), "1001 students"),
    "too long": (b"id\n" + b"1" * 20_000_001, "more than the limit"),
    "quotes never closed": ('id,name\n1,"Ada\n2,Bob\n', "not a CSV file"),
    "huge cell": ('id,name\n1,"' + "x" * 200_000 + '"\n', "not a CSV file"),
}  # fmt: skip


@pytest.mark.parametrize(("content", "said"), BAD_ROSTERS.values(), ids=BAD_ROSTERS.keys())
def test_read_invalid_class_list_raises_one_line_error(tmp_path, content, said) -> None:
    with pytest.raises(SettingsError) as error:
        read_roster(written(tmp_path, content, "utf-8"))
    assert said in str(error.value)
    assert "\n" not in str(error.value)


# -- owner of a file -------------------------------------------------------------------------------


CLASS = ClassList(
    [
        Person("0042", "Jane Doe", "jane@x.edu", "jdoe", {"moodle": "4711", "canvas": "12345"}),
        Person("43", "Max Roe", numbers={"moodle": "42"}), Person("44", "Zoë Doe"),
        Person("4711", "Li Lei"), Person("45", "Kim Min"), Person("46", "Min Kim"),
    ]
)  # fmt: skip


def at(platform: str, number: str = "", name: str = "", **more: str) -> SubmissionOrigin:
    """Make the origin of a file: platform and number of the student there."""
    person = Person(more.pop("student_id", ""), name, numbers={platform: number}, **more)
    return SubmissionOrigin(platform, person)


@pytest.mark.parametrize(
    ("origin", "place"),
    [
        # participant number, not student id
        (at("moodle", "4711", "Nobody"), 0),
        (at("moodle", "42", "Nobody"), 1),
        (at("moodle", "99", "doe JANE"), 0),
        (at("canvas", "12345", "x"), 0),
        (at("canvas", "99", "roemax"), 1),
        (at("moodle", "99", "Zoe\u0308 Doe"), 2),  # decomposed letter
        (at("blackboard", login="JDoe"), 0),
        (at("ilias", "7", "?", login="45"), 4),
        (at("gradescope", "7", student_id="42"), 0),
        (at("gradescope", "7", email="Jane@X.edu"), 0),
        (at("moodle", "99", "Kim Min"), None),  # the name is ambiguous
        (at("moodle", "99", "Jane"), None),
    ],
)
def test_student_is_identified_by_learning_platform_id_first(origin, place) -> None:
    assert CLASS.find_student_index(origin.person) == place


def test_student_is_matched_by_id_before_name() -> None:
    said = (("42", "Max Roe"), ("", "Roe, Max"), ("99", "Jane Doe"), ("", ""))
    assert [CLASS.find_student_index(Person(*each)) for each in said] == [0, 1, 0, None]
    # an exact id has priority over one with leading zeros
    class_list = ClassList([Person("042"), Person("42")])
    assert [class_list.find_student_index(Person(each)) for each in ("42", "0042")] == [1, None]


def test_class_list_is_completed_from_grading_worksheet() -> None:
    class_list = ClassList(
        [Person("0042", "Jane Doe"), Person("43", "Max Roe")],
        [Person("42", "Doe J", "j@x.edu", "jdoe", {"moodle": "7"}), Person("9", "No One")],
    )
    assert class_list.people == [
        Person("0042", "Jane Doe", "j@x.edu", "jdoe", {"moodle": "7"}), Person("43", "Max Roe"),
    ]  # fmt: skip


# -- grades in the platform's table ----------------------------------------------------------------


def rows(text: str, separator: str = ",") -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text, newline=""), delimiter=separator))


def course(people=PEOPLE, **settings) -> Course:
    return Course(read_rubric(None), roster=tuple(people), **settings)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
@pytest.mark.parametrize(
    ("text", "column", "title", "feedback"),
    [
        (MOODLE, "", "Grade", "Feedback comments"),
        (CANVAS, "Lab 3", "Lab 3 (9)", None),
        (BLACKBOARD, TITLE, TITLE, "Feedback to Learner"),
    ],
)
def test_fill_grades_changes_only_grade_and_feedback(
    tmp_path, text, column, title, feedback, encoding
) -> None:
    sheet = table(tmp_path, text, encoding)
    lab = course(worksheets=(sheet,), grade_column_title=column)
    made, notes = fill_grades(sheet, GRADES, lab, TEXTS)
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
    # without a grade the cell is unchanged: an empty one would delete, a zero would count
    assert after[-1] == before[-1]
    if text is MOODLE:
        assert people[0][feedback] == "Points 87.5<br>&nbsp;&nbsp;&lt;b&gt;=1+1&lt;/b&gt;"
    if text is not BLACKBOARD:
        assert any("above the maximum of 100 in the table" in note for note in notes)


def test_fill_grades_matches_anonymous_row_by_participant_number(tmp_path) -> None:
    hidden = MOODLE.replace("Doe Jane", "").replace("0042,jane@x.edu", ",")
    sheet = table(tmp_path, hidden)
    people = (Person("0042", numbers={"moodle": "4711"}), *PEOPLE[1:])
    assert fill_grades(sheet, GRADES, course(people), TEXTS)[0].rows[0][5] == "87.5"


def test_fill_grades_scales_points_to_learning_platform_maximum(tmp_path) -> None:
    sheet = table(tmp_path, MOODLE)
    scaled = fill_grades(sheet, GRADES, course(worksheets=(sheet,), scale=50.0), TEXTS)[0]
    maximum = GRADES[0].max_points
    assert float(scaled.rows[0][5]) == round(87.5 * 50.0 / maximum, 2)


def test_read_class_list_reads_due_time_extension(tmp_path) -> None:
    sheet = table(tmp_path, "id,name,Extension\n0042,Jane Doe,2026-11-22 12:00\n7,Max Roe,\n")
    assert [person.extended_due for person in read_people(sheet)] == ["2026-11-22 12:00", ""]


def test_fill_grades_reports_a_student_missing_in_the_table(tmp_path) -> None:
    sheet = table(tmp_path, "\r\n".join(MOODLE.split("\r\n")[:2]) + "\r\n")
    _, notes = fill_grades(sheet, GRADES, course(worksheets=(sheet,)), TEXTS)
    assert notes == ("table.csv has no row for Max Roe. These grades were not entered.",)


def test_fill_grades_keeps_semicolon_and_decimal_comma(tmp_path) -> None:
    text = "Matrikelnummer;Name;Punkte;Kommentar\n0042;Jane Doe;;\n"
    sheet = table(tmp_path, text, "cp1252")
    made, _ = fill_grades(sheet, GRADES, course(), TEXTS)
    assert made.content() == b"Matrikelnummer;Name;Punkte;Kommentar\r\n0042;Jane Doe;87.5;\r\n"
    moodle = MOODLE.replace(",100.00,", ',"100,00",')
    sheet = table(tmp_path, moodle)
    made, _ = fill_grades(sheet, GRADES, course(worksheets=(sheet,)), TEXTS)
    assert made.rows[0][5] == "87,5"


@pytest.mark.parametrize(
    ("text", "column", "says"),
    [
        (CANVAS, "", r"several grade columns.*--column: Quiz, Lab 3\."),
        (CANVAS, "Roll", "no grade column"),
        (CANVAS, "Lab 4", "no grade column"),
        (CANVAS, "Final Score", "no grade column"),
        ("id,name\n1,A\n", "", "no grade column"),
    ],
)
def test_ambiguous_or_missing_grade_column_raises_error(tmp_path, text, column, says) -> None:
    with pytest.raises(SettingsError, match=says) as caught:
        find_grade_column(table(tmp_path, text), column)
    assert "\n" not in str(caught.value)
