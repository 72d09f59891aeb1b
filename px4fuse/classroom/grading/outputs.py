"""Output files of grading: points of the class, feedback, and tables for learning platforms.

px4fuse enters grades into copies of the tables that learning platforms export. The row of a student
without a grade stays unchanged, because platforms delete a grade if the cell is empty.

- Moodle: "Using Assignment", Offline grading worksheet, docs.moodle.org, and
  ``mod/assign/feedback/offline/importgradeslib.php``.
- Canvas: "How do I import grades in the Gradebook?", Instructor Guide.
"""

import html
import random
import re
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from importlib import metadata
from operator import attrgetter
from pathlib import Path

from px4fuse.core.input_files import protect_inputs
from px4fuse.core.text import clean_text, join_first_names, neutralise_formulas, shorten_to_line
from px4fuse.core.writing import write_output_files
from px4fuse.errors import SettingsError
from px4fuse.verification.model import Verification

from ..assignment.roster import (
    Sheet,
    format_cell_number,
    format_csv,
    make_file_names,
    make_unique,
    normalise_text,
    parse_decimal,
    read_csv_sheet,
    read_student,
)
from .checks import shorten_text
from .class_page import format_class_page
from .entries import OVERRIDES_NAME, OVERRIDES_TEMPLATE, Course
from .model import (
    TOTAL_POINTS_TITLE,
    Grade,
    GradedReport,
    list_item_titles,
    select_counted_reports,
)
from .oral_check import format_questions

# Subfolder of the output folder for the cached results
RECORDS_FOLDER = "records"
# Suffix of the report that px4fuse recomputes from the log
REDRAWN_REPORT_SUFFIX = ".pdf"
# Suffix of the report with the faults that px4fuse found, as feedback for the student
DIAGNOSIS_SUFFIX = ".diagnosis.pdf"
# Folder of reports that px4fuse recomputes from the logs; safer to open than the submitted PDFs
REPORTS_FOLDER = "reports"
FEEDBACK_FOLDER = "feedback"
GRADES_FOLDER = "grades"
PSEUDONYMS_FILE = "names.csv"
QUESTIONS_FILE = "questions.txt"
PSEUDONYM_TITLES = ("pseudonym", "id", "name")
# First columns of class.csv. Columns with points and with numbers of the reports follow
TITLES_BEFORE_ITEMS = (
    "file",
    "student",
    "id",
    "status",
    "points",
    "pending points",
    "of",
    "deducted",
    "total",
)
TITLES_AFTER_ITEMS = (
    "handed in",
    "hours late",
    "pending",
    "comment",
    "flags",
    "other files",
    "reasons",
    "log SHA-256",
)
LIST_SEPARATOR = " | "
# Maximum number of reasons for a failed verification in the feedback
MAX_LISTED_REASONS = 4
# Titles of grade columns in tables of learning platforms, as lower-case letters and digits
GRADE_COLUMN_TITLES = ("grade", "bewertung", "points", "punkte", "mark", "note", "score")
TITLES_OF_MAX_GRADE_COLUMN = ("maximumgrade", "hoechstebewertung", "höchstebewertung")
# Titles of feedback columns that contain HTML (Moodle)
HTML_COMMENT_COLUMN_TITLES = ("feedbackcomments", "feedbackalskommentar")
# Titles of all feedback columns
COMMENT_COLUMN_TITLES = (*HTML_COMMENT_COLUMN_TITLES, "feedbacktolearner", "feedback", "comment")
_ASSIGNMENT_NUMBER_PATTERN = re.compile(r" \(\d+\)$")
# Text by which the learning platform Canvas marks columns that it computes: px4fuse must not change
# these columns
READ_ONLY_TEXT = "(read only)"


def write_grading_files(
    grades: Sequence[Grade], course: Course, output: Path
) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """Write all output files of grading. An existing ``overrides.csv`` is not overwritten.

    Parameters
    ----------
    grades : sequence of Grade
        Grades of the students in ``course.class_list``, then of unknown students.

    Returns
    -------
    written_paths : tuple of Path
        Files and folders.
    notes : tuple of str
        Sentences about grades that could not be entered.

    Raises
    ------
    OutputError
        The folder cannot be written.
    """
    class_title = course.title or course.rubric.title or "Class"
    file_stems = make_file_names(grade.student_id or Path(grade.file_name).stem for grade in grades)
    # Only the web page of the class uses these grades: they contain links to the recomputed
    # reports, and may be anonymous
    class_page_grades = [
        _copy_redrawn_report(grade, stem, output)
        for grade, stem in zip(grades, file_stems, strict=True)
    ]
    has_redrawn_reports = any(
        report.redrawn_report_path for report in select_counted_reports(class_page_grades)
    )
    feedback_texts = [feedback_text(grade, class_title) for grade in grades]
    texts = {"class.csv": format_class_table(grades)}
    if course.anonymous:
        class_page_grades, texts[PSEUDONYMS_FILE] = _anonymise_grades(
            class_page_grades, output / PSEUDONYMS_FILE
        )
    texts["class.html"] = format_class_page(
        class_page_grades, class_title, f"px4fuse {metadata.version('px4fuse')}"
    )
    if course.question_count and course.key is not None:
        texts[QUESTIONS_FILE] = format_questions(grades, course.key, course.question_count)
    if not (output / OVERRIDES_NAME).exists():
        texts[OVERRIDES_NAME] = OVERRIDES_TEMPLATE
    for stem, text in zip(file_stems, feedback_texts, strict=True):
        texts[f"{FEEDBACK_FOLDER}/{stem}.txt"] = text
    contents = {name: text.encode() for name, text in texts.items()}
    notes: list[str] = []
    # worksheets of the same name are from different folders
    table_names = make_unique((sheet.path.name for sheet in course.worksheets), "{1}-{0}")
    for sheet, name in zip(course.worksheets, table_names, strict=True):
        filled_sheet, sheet_notes = fill_grades(sheet, grades, course, feedback_texts)
        contents[f"{GRADES_FOLDER}/{name}"] = filled_sheet.content()
        notes += sheet_notes
    write_output_files({output / name: content for name, content in contents.items()})
    # overrides.csv is listed in any case: it was written now, or it existed before. dict.fromkeys
    # removes repeated folders
    written_names = [*contents, OVERRIDES_NAME]
    if has_redrawn_reports:
        written_names.append(REPORTS_FOLDER)
    written_paths = dict.fromkeys(output / name.partition("/")[0] for name in written_names)
    return tuple(written_paths), tuple(notes)


def _identify_student(grade: Grade) -> str:
    return grade.student_id or grade.student or grade.file_name


def _copy_redrawn_report(grade: Grade, stem: str, output: Path) -> Grade:
    """Copy the recomputed report and the diagnosis (PDF) to the output folder."""
    report = grade.counted_report
    if report is None or not report.sha256:
        return grade
    record_path = output / RECORDS_FOLDER / report.sha256
    redrawn_file, diagnosis_file = map(
        record_path.with_suffix, (REDRAWN_REPORT_SUFFIX, DIAGNOSIS_SUFFIX)
    )
    if diagnosis_file.exists():
        write_output_files({output / FEEDBACK_FOLDER / f"{stem}.pdf": diagnosis_file.read_bytes()})
    if not redrawn_file.exists():
        return grade
    name = f"{REPORTS_FOLDER}/{stem}.pdf"
    write_output_files({output / name: redrawn_file.read_bytes()})
    return replace(grade, counted_report=replace(report, redrawn_report_path=name))


def _anonymise_grades(grades: Sequence[Grade], path: Path) -> tuple[list[Grade], str]:
    """Replace names by pseudonyms, and sort by pseudonym.

    Return the anonymous grades and a CSV table of the pseudonyms.
    """
    pseudonym_by_identity: dict[str, str] = {}
    if path.exists():
        with protect_inputs(is_active=False):  # not an input: the new table overwrites the file
            sheet = read_csv_sheet(path)
        for row in sheet.rows:
            pseudonym, identity, _ = (
                sheet.find_cell(row, (title,)).removeprefix("'") for title in PSEUDONYM_TITLES
            )
            pseudonym_by_identity[identity] = pseudonym
    name_by_identity = {_identify_student(grade): grade.student for grade in grades}
    # students keep their pseudonyms; new students get the free ones in random order
    free_pseudonyms = [
        pseudonym
        for number in range(1, len(name_by_identity | pseudonym_by_identity) + 1)
        if (pseudonym := f"Student {number:03}") not in pseudonym_by_identity.values()
    ]
    new_identities = [each for each in name_by_identity if each not in pseudonym_by_identity]
    pseudonyms = random.SystemRandom().sample(free_pseudonyms, len(new_identities))
    pseudonym_by_identity |= zip(new_identities, pseudonyms, strict=True)
    # students who are no longer in the class are omitted
    rows = sorted(
        (pseudonym_by_identity[identity], identity, name)
        for identity, name in name_by_identity.items()
    )
    anonymous_grades = (
        anonymise_grade(grade, pseudonym_by_identity[_identify_student(grade)]) for grade in grades
    )
    return sorted(anonymous_grades, key=attrgetter("student")), _format_csv(PSEUDONYM_TITLES, rows)


def anonymise_grade(grade: Grade, pseudonym: str) -> Grade:
    """Replace the name by a pseudonym, and delete all texts that could identify the student."""
    report = grade.counted_report
    # new objects, so that all fields that are not listed are empty
    if report is not None:
        report = GradedReport(
            submission="",
            student="",
            student_id="",
            verification=replace(report.verification, reasons=(), differences=()),
            items=tuple(replace(item, comment="") for item in report.items),
            instructor_action=report.instructor_action
            and "The points are not final: the instructor must confirm the points.",
            form=report.form,
            did_student_name_fault=report.did_student_name_fault,
            form_part_scores=report.form_part_scores,
        )
    return Grade(
        pseudonym,
        "",
        report,
        submission_time=grade.submission_time,
        lateness_s=grade.lateness_s,
        deducted_points=grade.deducted_points,
        total=grade.total,
        max_points=grade.max_points,
        flags=("Check this report. The reasons are in class.csv.",) if grade.flags else (),
    )


# ------------------------------------------------------------------ the class table


def format_class_table(grades: Sequence[Grade]) -> str:
    """Format a table with one row per student as CSV for Excel and LibreOffice."""
    item_titles = list_item_titles(grades)
    numeric_column_titles = dict.fromkeys(
        title for report in select_counted_reports(grades) for title in report.numbers
    )
    titles = (*TITLES_BEFORE_ITEMS, *item_titles, *numeric_column_titles, *TITLES_AFTER_ITEMS)
    rows = []
    for grade in grades:
        report = grade.counted_report
        points_by_title = {item.title: item.points for item in report.items} if report else {}
        row: list[str | float | None] = [
            grade.file_name,
            grade.student,
            grade.student_id,
            report.status if report else "missing",
            report.counted_points if report else None,
            report.points if report and report.counted_points is None else None,
            grade.max_points,
            grade.deducted_points or None,
            grade.total,
            *map(points_by_title.get, item_titles),
            *(report.numbers.get(title) if report else None for title in numeric_column_titles),
            grade.submission_time,
            None if grade.lateness_s is None else grade.lateness_s / 3600.0,
            report.pending_actions if report else "",
            grade.comment,
            LIST_SEPARATOR.join(grade.flags),
            LIST_SEPARATOR.join(other_report.submission for other_report in grade.other_reports),
            LIST_SEPARATOR.join(report.verification.reasons) if report else "",
            report.log_sha256 if report else "",
        ]
        rows.append(row)
    return _format_csv(titles, rows)


def _format_csv(titles: Sequence[str], rows: Iterable[Sequence[str | float | None]]) -> str:
    """Format a table as CSV that Excel opens as UTF-8; texts are never executed as formulas."""
    cell_rows = (
        [
            neutralise_formulas(value) if isinstance(value, str) else format_cell_number(value)
            for value in row
        ]
        for row in (titles, *rows)
    )
    # Excel detects UTF-8 by the byte order mark
    return "\ufeff" + format_csv(cell_rows)


# ------------------------------------------------------------------ feedback


def feedback_text(grade: Grade, class_name: str = "") -> str:
    """Format points, comments and reasons for one student as text.

    Flags are omitted, because they are for the instructor.
    """
    report = grade.counted_report
    is_total_set_by_instructor = TOTAL_POINTS_TITLE in grade.overrides
    lines = [class_name] if class_name else []
    if report is None:
        lines.append("No submission.")
    else:
        # the computed points are not printed if the instructor has set the total
        lines += _format_report_feedback(
            report, bool(report.items) and (grade.total is None or not is_total_set_by_instructor)
        )
    lines.append("")
    if grade.deducted_points:
        lines.append(
            f"Handed in {(grade.lateness_s or 0.0) / 3600.0:.1f} hours late: "
            f"{format_cell_number(grade.deducted_points)} points deducted."
        )
    if grade.total is not None and (grade.deducted_points or is_total_set_by_instructor):
        lines.append(f"Total    {_format_points(grade.total, grade.max_points)}")
    if grade.comment:
        lines += ["", "From your instructor:", "", grade.comment]
    return clean_text("\n".join(lines).rstrip("\n")) + "\n"


def _format_report_feedback(report: GradedReport, has_proposed_points: bool) -> Iterator[str]:
    """Yield the lines of the feedback about the report that counts for the grade.

    Without ``has_proposed_points``, the sum of the computed points is omitted.
    """
    yield f"Report   {shorten_text(report.submission)}"
    if student := ", ".join(filter(None, map(shorten_text, (report.student, report.student_id)))):
        yield f"Student  {student}"
    points_text = _format_points(report.points, report.max_points)
    if report.counted_points is None:
        points_text = f"pending, not counted yet (proposed: {points_text})"
    if has_proposed_points:
        yield f"Points   {points_text}"
    yield f"\n{_wrap_text(_describe_verification(report.verification))}\n"
    for item in report.items:
        yield f"{_format_points(item.points, item.max_points)}  {shorten_text(item.title)}"
        if item.comment:
            yield textwrap.indent(_wrap_text(item.comment, 84), "    ")
    if has_proposed_points:
        text = (
            "These points are a proposal; your instructor decides. Ask if you think that a point "
            "is missing."
        )
        yield f"\n{_wrap_text(text)}"


def _describe_verification(verification: Verification) -> str:
    """Return a sentence for the student: result of the verification, reasons, required action."""
    if verification.status == "verified":
        return "Your report is verified: px4fuse computes the same numbers from your log."
    statement = "Your report could not be verified"
    if verification.status == "numbers differ":
        statement = (
            "The numbers in your report differ from those that px4fuse computes from the same log"
        )
    elif verification.status == "other log":
        statement = "The log of your report is missing"
    reasons = (shorten_text(text).rstrip(".") for text in verification.reasons[:MAX_LISTED_REASONS])
    advice = "Make a new report of the log that you were given, and hand in the unchanged PDF."
    if verification.missing:
        missing_file = shorten_text(verification.missing)
        advice = f"Hand in {missing_file} if your instructor does not have it."
    return f"{statement}: {'; '.join(filter(None, reasons))}. {advice}"


def _format_points(points: float, max_points: float) -> str:
    return f"{format_cell_number(points)} of {format_cell_number(max_points)}"


def _wrap_text(text: str, width: int = 88) -> str:
    return textwrap.fill(text, width, break_long_words=False, break_on_hyphens=False)


# ------------------------------------------------------------------ platform tables


def find_grade_column(sheet: Sheet, column_title: str) -> int:
    """Return the index of the grade column in a table of a learning platform.

    ``column_title`` is "" if the table has only one grade column.

    Raises
    ------
    SettingsError
        No column matches, or several columns match.
    """
    titles = sheet.column_titles
    short_titles = [_ASSIGNMENT_NUMBER_PATTERN.sub("", title) for title in titles]
    # The Canvas gradebook marks computed columns with READ_ONLY_TEXT in one of its first three
    # rows
    editable_column_indices = [
        index
        for index in range(len(titles))
        if not any(READ_ONLY_TEXT in row[index] for row in sheet.rows[:3])
    ]
    # Canvas adds the number of the assignment to the title of its column
    assignment_column_indices = [
        index for index in editable_column_indices if short_titles[index] != titles[index]
    ]
    candidate_indices = []
    if column_title:
        candidate_indices = [
            index
            for index in editable_column_indices
            if normalise_text(column_title)
            in map(normalise_text, (titles[index], short_titles[index]))
        ]
    # a table of Moodle (with a column "identifier") has only one grade column. If no column of the
    # table has the title given with --column, --column is meant for another table
    is_moodle_table = sheet.find_column_index(("identifier",)) is not None
    if not candidate_indices and (is_moodle_table or not column_title):
        grade_column_index = sheet.find_column_index(GRADE_COLUMN_TITLES)
        candidate_indices = assignment_column_indices
        if grade_column_index is not None:
            candidate_indices = [grade_column_index]
    if len(candidate_indices) == 1:
        return candidate_indices[0]
    problem = "several grade columns" if candidate_indices else "no grade column was found"
    listed_titles = ", ".join(
        shorten_to_line(short_titles[index], 40)
        for index in assignment_column_indices or editable_column_indices
    )
    remedy = f"Choose the grade column with --column: {shorten_to_line(listed_titles, 300)}."
    raise SettingsError(f"{sheet.path}: {problem}.", remedy)


def fill_grades(
    sheet: Sheet, grades: Sequence[Grade], course: Course, feedback_texts: Sequence[str]
) -> tuple[Sheet, tuple[str, ...]]:
    """Enter grades and feedback into a copy of a table of a learning platform.

    Parameters
    ----------
    grades, feedback_texts : sequences
        Grade and feedback of each student in ``course.class_list``, then of unknown students.

    Returns
    -------
    filled_sheet : Sheet
    notes : tuple of str
        Sentences about grades that were not entered, or that are above the maximum.

    Raises
    ------
    SettingsError
        No grade column was found, or several.
    """
    grade_column_index = find_grade_column(sheet, course.grade_column_title)
    people = course.class_list.people
    feedback_column_index = sheet.find_column_index(COMMENT_COLUMN_TITLES)
    format_feedback = (
        neutralise_formulas
        if sheet.find_column_index(HTML_COMMENT_COLUMN_TITLES) is None
        else escape_html
    )
    cells_by_row = [list(row) for row in sheet.rows]
    names = [shorten_to_line(grade.student or grade.student_id, 40) for grade in grades]
    has_decimal_comma = any(
        re.fullmatch(r"\d+,\d+", cell.strip()) for row in cells_by_row for cell in row
    )
    notes, matched_student_indices = [], set()
    for row in cells_by_row:
        person = read_student(sheet, row)
        student_index = course.class_list.find_student_index(person) if person else None
        if student_index is None:
            continue
        matched_student_indices.add(student_index)
        grade, name = grades[student_index], names[student_index]
        points = grade.total
        if points is None:  # the cell is not changed
            continue
        if course.scale is not None and grade.max_points:
            points = round(points * course.scale / grade.max_points, 2)
        max_points = _find_max_points(sheet, row, grade_column_index)
        if max_points is not None and points > max_points:
            notes.append(
                f"{sheet.path.name}: {name} has {points:.10g} points, above "
                f"the maximum of {max_points:.10g} in the table. Increase the maximum on the "
                f"learning platform, or run grade again with --scale {max_points:.10g}."
            )
        points_text = format_cell_number(points)
        if has_decimal_comma:
            points_text = points_text.replace(".", ",")
        row[grade_column_index] = points_text
        if feedback_column_index is not None and feedback_column_index != grade_column_index:
            row[feedback_column_index] = format_feedback(feedback_texts[student_index])
    missing_names = [
        names[index]
        for index in range(len(people))
        if index not in matched_student_indices and grades[index].total is not None
    ]
    if missing_names:
        notes.append(
            f"{sheet.path.name} has no row for {join_first_names(missing_names, 4)}. These grades "
            "were not entered."
        )
    return replace(sheet, rows=tuple(map(tuple, cells_by_row))), tuple(notes)


def _find_max_points(sheet: Sheet, row: Sequence[str], grade_column_index: int) -> float | None:
    """Return the maximum points of a student's row; None if the table does not contain them."""
    max_points_texts = (
        cells[grade_column_index]
        for cells in sheet.rows[:3]
        if "points possible" in cells[0].casefold()
    )
    return parse_decimal(next(max_points_texts, sheet.find_cell(row, TITLES_OF_MAX_GRADE_COLUMN)))


def escape_html(text: str) -> str:
    r"""Convert a text to HTML; keep line breaks and indentation.

    >>> escape_html("a <b>\n 1")
    'a &lt;b&gt;<br>&nbsp;1'
    """
    lines = html.escape(text, quote=False).rstrip("\n").split("\n")
    return "<br>".join(re.sub(r"^ +", lambda m: "&nbsp;" * len(m[0]), line) for line in lines)
