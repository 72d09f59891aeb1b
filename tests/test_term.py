"""Grading of 40 students on three platforms, with a new rubric, overrides and grade tables."""

from __future__ import annotations

import csv
import hashlib
import io
import re
import zipfile
from pathlib import Path

import pytest
from class_tools import make_report, skip_verification, write_zip
from golden_tools import assert_matches_golden

from px4fuse.classroom.assignment.key import AnswerKey, CorrectAnswers
from px4fuse.classroom.assignment.roster import read_csv_sheet, read_people
from px4fuse.classroom.grading.entries import Course, parse_due_time, parse_late_rule
from px4fuse.classroom.grading.grade import GradeOutcome, grade
from px4fuse.classroom.grading.model import Grade
from px4fuse.classroom.grading.rubric import read_default_rubric_text, read_rubric

STUDENTS = range(1, 41)
MOODLE, CANVAS, BLACKBOARD = range(1, 16), range(16, 28), range(28, 39)  # 39 and 40 submit nothing
LATE, RESUBMITTED, COPIED, HOSTILE, INTRUDER = 30, 31, 20, 5, 9
# Students whose feedback is in the golden file
SHOWN = ("0001", "0005", "0009", "0020", "0030", "0031", "0039")
HEADS = {
    "moodle": ["Identifier", "Full name", "ID number", "Email address", "Status", "Grade",
               "Maximum Grade", "Grade can be changed", "Last modified (submission)",
               "Last modified (grade)", "Feedback comments"],
    "canvas": ["Student", "ID", "SIS User ID", "SIS Login ID", "Section", "Lab (77)"],
    "blackboard": ["Last Name", "First Name", "Username", "Student ID",
                   "Grade", "Feedback to Learner"],
}  # fmt: skip


def student_id(number: int) -> str:
    return f"{number:04}"


def first(number: int) -> str:
    return f"Anna{chr(65 + number % 26)}{chr(65 + number // 26)}"


def last(number: int) -> str:
    return "=Doe" if number == HOSTILE else f"Doe{chr(65 + number // 26)}{chr(65 + number % 26)}"


def name(number: int) -> str:
    return f"{first(number)} {last(number)}"


def log(number: int) -> bytes:
    return f"the log of {number}".encode()


def report(number: int) -> bytes:
    made = hashlib.sha256(log(number)).hexdigest()
    return make_report(name(number), student_id(number), made)


def table(path: Path, head: list[str], rows: list[list[str]], separator: str = ",") -> Path:
    with path.open("w", newline="", encoding="utf-8-sig") as file:
        writer = csv.writer(file, delimiter=separator)
        writer.writerows([head, *rows])
    return path


class Lab:
    """Folder of an instructor: logs, exports of platforms, class list and grade tables."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.output, self.logs = folder, folder / "class", folder / "logs"
        self.logs.mkdir()
        for number in STUDENTS:
            (self.logs / f"{number}.ulg").write_bytes(log(number))
        answers = (
            CorrectAnswers(student_id(n), name(n), f"{n}.ulg", hashlib.sha256(log(n)).hexdigest(),
                   mistakes=("nlos=5%",))
            for n in STUDENTS
        )  # fmt: skip
        self.key = AnswerKey("aisle", tuple(answers))
        self.pdf = {one: report(one) for one in STUDENTS}
        self.better = report(RESUBMITTED)
        self.exports = [self.moodle(), self.canvas(), self.blackboard()]
        rows = [[student_id(n), first(n), last(n), f"s{n}@x.edu"] for n in STUDENTS]
        roster = table(folder / "roster.csv", ["id", "first name", "last name", "email"], rows)
        self.sheets = [self.worksheet(), self.gradebook(), self.grades()]
        self.roster = read_people(read_csv_sheet(roster))

    def moodle(self) -> Path:
        files = {f"{name(n)}_{9000 + n}_assignsubmission_file_/report.pdf": self.pdf[n]
                 for n in MOODLE}  # fmt: skip
        own = f"{name(HOSTILE)}_{9000 + HOSTILE}_assignsubmission_file_"
        files[f"{own}/report.pdf"] = b"%PDF-1.7 /JavaScript %%EOF"
        # zip file that contains the folder of another student
        inner = io.BytesIO()
        with zipfile.ZipFile(inner, "w") as archive:
            archive.writestr(f"{name(1)}_9001_assignsubmission_file_/report.pdf", b"%PDF- none")
        files[f"{name(INTRUDER)}_{9000 + INTRUDER}_assignsubmission_file_/w.zip"] = inner.getvalue()
        return write_zip(self.folder / "moodle.zip", files)

    def canvas(self) -> Path:
        self.pdf[COPIED] = self.pdf[3]
        return write_zip(
            self.folder / "canvas.zip",
            {f"{(last(n) + first(n)).lower()}_{'LATE_' if n == 17 else ''}{700 + n}_{n}_r.pdf":
             self.pdf[n] for n in CANVAS},
        )  # fmt: skip

    def blackboard(self) -> Path:
        files = {f"Lab_user{n}_attempt_2026-11-{20 if n != LATE else 22}-11-00-00_r.pdf":
                 self.pdf[n] for n in BLACKBOARD}  # fmt: skip
        files[f"Lab_user{RESUBMITTED}_attempt_2026-11-20-11-30-00_r.pdf"] = self.better
        return write_zip(self.folder / "blackboard.zip", files)

    def worksheet(self) -> Path:
        rows = [[f"Participant {9000 + n}", name(n), "", f"s{n}@x.edu", "Submitted for grading", "",
                 "200.00", "Yes", "Friday, 20 November 2026, 11:58 PM" if n == 2 else
                 "Friday, 20 November 2026, 10:58 AM", "-", ""] for n in (*MOODLE, 39)]  # fmt: skip
        return table(self.folder / "worksheet.csv", HEADS["moodle"], rows)

    def gradebook(self) -> Path:
        rows = [["    Points Possible", "", "", "", "", "200.00"]]
        rows += [[f"{last(n)}, {first(n)}", f"{700 + n}", student_id(n), f"s{n}", "A", ""]
                 for n in CANVAS]  # fmt: skip
        return table(self.folder / "gradebook.csv", HEADS["canvas"], rows)

    def grades(self) -> Path:
        rows = [[last(n), first(n), f"user{n}", student_id(n), "", ""] for n in BLACKBOARD]
        return table(self.folder / "grades.csv", HEADS["blackboard"], rows, "\t")

    def grade(self, rubric=None) -> GradeOutcome:
        due = parse_due_time("2026-11-20 12:00:00 Europe/Berlin")
        course = Course(rubric or read_rubric(None), self.key, [self.logs], "Lab", self.roster,
                        tuple(map(read_csv_sheet, self.sheets)), due=due,
                        late_rule=parse_late_rule("10%/day"),
                        anonymous=True)  # fmt: skip
        return grade(self.exports, course, self.output, processes=1)


@pytest.fixture
def lab(tmp_path: Path) -> Lab:
    return Lab(tmp_path)


def grade_of(outcome: GradeOutcome, number: int) -> Grade:
    return next(one for one in outcome.grades if one.student_id == student_id(number))


def points(outcome: GradeOutcome) -> dict[str, float | None]:
    return {one.student_id: one.total for one in outcome.grades}


@pytest.mark.slow
def test_second_grade_run_applies_changed_rubric_and_overrides(lab, monkeypatch) -> None:
    verified = skip_verification(monkeypatch)
    outcome = lab.grade()
    check_golden_tables(lab.output)
    assert outcome.reused_count == 2  # the copied and the repeated report
    count = len(verified)
    check_other_rubric(lab, outcome)
    check_overrides(lab, outcome)
    assert len(verified) == count  # points changed without a new verification
    check_pseudonyms(lab, outcome)


def check_golden_tables(output: Path) -> None:
    """Compare tables and some feedback with the golden file."""
    lines = []
    tables = [output / "class.csv", *sorted((output / "grades").glob("*.csv"))]
    told = [path for path in sorted((output / "feedback").iterdir()) if path.stem in SHOWN]
    for path in (*tables, *told):
        lines += ["", path.name, *path.read_text(encoding="utf-8-sig").splitlines()]
    assert_matches_golden("term", lines)


def check_other_rubric(lab: Lab, outcome: GradeOutcome) -> None:
    doubled = re.sub(
        r"(?m)^points = (\d+)", lambda m: f"points = {2 * int(m[1])}", read_default_rubric_text()
    )
    (lab.folder / "lab.toml").write_text(doubled, encoding="utf-8")
    second = lab.grade(read_rubric(lab.folder / "lab.toml"))
    assert second.reused_count == 38  # two files are not reports
    assert grade_of(second, 1).total == pytest.approx(2 * grade_of(outcome, 1).total, abs=0.2)


def check_overrides(lab: Lab, outcome: GradeOutcome) -> None:
    """Check that overrides are applied, not overwritten, and kept when grading again."""
    usual = grade_of(outcome, 1)
    item = usual.counted_report.items[0].title
    said = lab.output / "overrides.csv"
    assert said.read_text(encoding="utf-8-sig") == "id,item,points,comment\n"
    with said.open("a", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows(
            [["0001", item, "1", "Not shown."], ["40", "total", "12", "Seen in the lab."],
             ["0001", "", "", "Well argued."], ["0099", "total", "1", ""]]
        )  # fmt: skip
    before = said.read_bytes()
    third = lab.grade()
    assert said.read_bytes() == before
    expected = usual.total - usual.counted_report.items[0].points + 1.0
    assert grade_of(third, 1).total == pytest.approx(expected)
    assert grade_of(third, 40).total == 12.0
    assert "overrides.csv: no student has the id 0099." in third.notes
    changed = {key for key, value in points(third).items() if value != points(outcome)[key]}
    assert changed == {"0001", "0040"}
    text = (lab.output / "feedback" / "0001.txt").read_text(encoding="utf-8")
    words = " ".join(text.split())
    assert "Well argued." in words
    assert "Your instructor: Not shown." in words
    fleet_table = (lab.output / "class.csv").read_bytes()
    assert lab.grade().grades == third.grades
    assert (lab.output / "class.csv").read_bytes() == fleet_table


def check_pseudonyms(lab: Lab, outcome: GradeOutcome) -> None:
    """Check the table of pseudonyms."""
    text = (lab.output / "names.csv").read_text(encoding="utf-8-sig")
    rows = list(csv.DictReader(io.StringIO(text, newline="")))
    assert {row["id"] for row in rows} == {one.student_id for one in outcome.grades}
    assert len({row["pseudonym"] for row in rows}) == 40
    assert [row["id"] for row in rows] != sorted(row["id"] for row in rows)
