"""Class lists as platforms export them, and whose a file is."""

from __future__ import annotations

import pytest

from px4fuse.assignment.roster import Person, Register, people_of_sheet
from px4fuse.assignment.sheet import read_sheet
from px4fuse.grading.model import ExportOrigin

MOODLE = (
    'Identifier,"Full name","ID number","Email address",Status,Grade,"Maximum Grade"\r\n'
    'Participant 4711,"Doe Jane",0042,jane@x.edu,"No submission",,100.00\r\n'
)
CANVAS = (
    "Student,ID,SIS User ID,SIS Login ID,Section,Lab 3 (9),Final Score\n"
    "    Points Possible,,,,,100.00,(read only)\n"
    '"Doe, Jane",12345,0042,jdoe,A,,90\n'
)
BLACKBOARD = '"Last Name","First Name","Username","Student ID"\n"Doe","Jane","jdoe","0042"\n'
ILIAS = "Nachname;Vorname;Benutzername;Matrikelnummer\nDoe;Jane;jdoe;0042\n"


@pytest.mark.parametrize(
    ("text", "is_"),
    [
        (MOODLE, Person("0042", "Doe Jane", "jane@x.edu", "", {"moodle": "4711"})),
        (CANVAS, Person("0042", "Doe, Jane", "", "jdoe", {"canvas": "12345"})),
        (BLACKBOARD, Person("0042", "Jane Doe", "", "jdoe")),
        (ILIAS, Person("0042", "Jane Doe", "", "jdoe")),
        ("name\nJane Doe\n", Person("", "Jane Doe")),
        ("Email\njane@x.edu\n", Person("jane@x.edu", "", "jane@x.edu")),
    ],
)
def test_columns_are_found_by_the_titles_that_platforms_write(tmp_path, text, is_) -> None:
    for encoding in ("utf-8", "utf-8-sig", "utf-16"):
        path = tmp_path / "roster.csv"
        path.write_text(text, encoding)
        assert people_of_sheet(read_sheet(path)) == (is_,)


CLASS = Register(
    [
        Person("0042", "Jane Doe", "jane@x.edu", "jdoe", {"moodle": "4711", "canvas": "12345"}),
        Person("43", "Max Roe", numbers={"moodle": "42"}),
        Person("44", "Zoë Doe"),
        Person("4711", "Li Lei"),
        Person("45", "Kim Min"),
        Person("46", "Min Kim"),
    ]
)


def at(platform: str, number: str = "", name: str = "", **more: str) -> ExportOrigin:
    """A file of a student whom a platform knows by its number."""
    person = Person(more.pop("student_id", ""), name, numbers={platform: number}, **more)
    return ExportOrigin(platform, person)


@pytest.mark.parametrize(
    ("origin", "place"),
    [
        # the participant, not the student of that id
        (at("moodle", "4711", "Nobody"), 0),
        (at("moodle", "42", "Nobody"), 1),
        (at("moodle", "99", "doe JANE"), 0),
        (at("canvas", "12345", "x"), 0),
        (at("canvas", "99", "roemax"), 1),
        (at("moodle", "99", "Zoe\u0308 Doe"), 2),  # the same letter, written as two
        (at("blackboard", login="JDoe"), 0),
        (at("ilias", "7", "?", login="45"), 4),
        (at("gradescope", "7", student_id="42"), 0),
        (at("gradescope", "7", email="Jane@X.edu"), 0),
        (at("moodle", "99", "Kim Min"), None),  # two of that name
        (at("moodle", "99", "Jane"), None),
    ],
)
def test_whose_a_file_is_by_what_the_platform_says(origin, place) -> None:
    assert CLASS.place(origin.person) == place


@pytest.mark.parametrize(
    ("student_id", "name", "place"),
    [("42", "Max Roe", 0), ("", "Roe, Max", 1), ("99", "Jane Doe", 0), ("", "", None)],
)
def test_whose_a_report_is_by_id_then_by_name(student_id, name, place) -> None:
    assert CLASS.place(Person(student_id, name)) == place


def test_of_two_ids_that_differ_by_zeros_the_exact_one_is_meant() -> None:
    register = Register([Person("042"), Person("42")])
    assert register.place(Person("42")) == 1
    assert register.place(Person("0042")) is None


def test_a_worksheet_adds_what_it_knows() -> None:
    register = Register(
        [Person("0042", "Jane Doe"), Person("43", "Max Roe")],
        [Person("42", "Doe J", "j@x.edu", "jdoe", {"moodle": "7"}), Person("9", "No One")],
    )
    assert register.people == [
        Person("0042", "Jane Doe", "j@x.edu", "jdoe", {"moodle": "7"}), Person("43", "Max Roe"),
    ]  # fmt: skip
