"""Command ``px4fuse grade``: verifies and grades the reports of a class."""

from functools import partial
from pathlib import Path
from typing import Any

import click

from px4fuse.core.input_files import check_output_folder, register_input_path
from px4fuse.core.reading import list_files_recursively
from px4fuse.errors import OutputError, SettingsError

from .options import (
    Choice,
    InputPath,
    NonEmptyPath,
    count_option,
    flag_option,
    input_option,
    max_size_option,
    open_option,
    output_option,
)
from .outputs import folder_progress, write_and_print_results, write_new_file


@click.command()
@click.argument("submissions", nargs=-1, type=InputPath())
@input_option(
    "--logs",
    "DIR",
    "Folder with flight logs, or one log; repeatable. Reports without a log are not verified.",
    multiple=True,
)
@input_option(
    "--rubric",
    "FILE.toml",
    "Rubric: points of each item.  [default: the rubric of px4fuse]",
)
@max_size_option
@input_option("--key", "FILE.json", "Answer key from px4fuse simulate --assignment.")
@output_option("DIR", "Output folder.")
@click.option("--title", help="Title of the class page.  [default: the rubric's title]")
@input_option(
    "--roster", "FILE.csv", "Class list with all students.  [default: students in the answer key]"
)
@click.option(
    "--attempt",
    type=Choice(("latest", "best", "first")),
    default="latest",
    help="Report to grade if a student handed in several.",
)
@click.option(
    "--due",
    "due_time_text",
    metavar="TIME",
    help="Due time: '2026-11-20 23:59' in this computer's time zone, or followed by '+01:00' or "
    "'Europe/Berlin'. Submission times without a zone are in the same zone.",
)
@click.option(
    "--late",
    "late_rule_text",
    metavar="RULE",
    help="Deduction per started day of delay, in % of all points: '10%/day' or "
    "'10%/day up to 50%'.  [default: none]",
)
@click.option(
    "--grace",
    type=click.FloatRange(0.0, 10_080.0),
    metavar="MINUTES",
    default=0.0,
    help="Grace period after --due without deduction.",
)
@click.option(
    "--scale",
    type=click.FloatRange(0.0, min_open=True),
    metavar="POINTS",
    help="Maximum points on the learning platform, to which the grades in --worksheet are scaled.  "
    "[default: the points of the rubric]",
)
@count_option(
    "--questions",
    1,
    10,
    help="Write questions.txt: N questions and answers for an oral examination of each student. "
    "Requires --key.",
)
@flag_option("--include-pending", help="Include points that the instructor has not confirmed.")
@input_option(
    "--worksheet",
    "FILE.csv",
    "Moodle grading worksheet, Canvas gradebook, or another table with student ids or names; a "
    "copy with the grades is written. Repeatable.",
    multiple=True,
)
@click.option("--column", metavar="TITLE", help="Title of the grade column in --worksheet.")
@flag_option(
    "--anonymous",
    help="Show pseudonyms on the class page; names.csv lists the student of each pseudonym.",
)
@count_option(
    "--jobs",
    1,
    256,
    help="Number of parallel processes.  [default: number of cores]",
)
@click.option(
    "--write-rubric",
    type=NonEmptyPath(),
    metavar="FILE.toml",
    help="Write the default rubric, and exit.",
)
@open_option
def grade(
    submissions: tuple[Path, ...],
    *,
    logs: tuple[Path, ...],
    rubric: Path | None,
    key: Path | None,
    output: Path | None,
    title: str | None,
    roster: Path | None,
    due_time_text: str | None,
    late_rule_text: str | None,
    grace: float,
    questions: int | None,
    worksheet: tuple[Path, ...],
    column: str | None,
    jobs: int | None,
    write_rubric: Path | None,
    **other_settings: Any,
) -> None:
    """Verify and grade the reports of a class.

    SUBMISSIONS are PDFs, folders, or zip files of learning platforms. Writes class.csv, class.html,
    one feedback text per student and grade files for the platforms to DIR. Entries in overrides.csv
    (id, item or total, points, comment) replace computed points. A second run verifies only changed
    reports. Submitted files are never executed, and are read with limits of time and memory.
    """
    from px4fuse.classroom.assignment.key import read_answer_key
    from px4fuse.classroom.assignment.roster import read_csv_sheet, read_people
    from px4fuse.classroom.grading.entries import Course, parse_due_time, parse_late_rule
    from px4fuse.classroom.grading.grade import grade as grade_submissions
    from px4fuse.classroom.grading.rubric import read_default_rubric_text, read_rubric
    from px4fuse.classroom.terminal import grading_page

    if write_rubric is not None:
        write_new_file(write_rubric, read_default_rubric_text().encode())
        return
    if late_rule_text and due_time_text is None:
        raise SettingsError("--late requires --due TIME.")
    if questions and key is None:
        raise SettingsError("--questions requires --key FILE.json.")
    if not submissions:
        raise SettingsError("no submissions were given. Give PDFs, folders or zip files.")
    if output is None:
        raise SettingsError("px4fuse grade requires an output folder: -o DIR.")
    _protect_inputs_from_output((*submissions, *logs), output)
    course = Course(
        read_rubric(rubric),
        None if key is None else read_answer_key(key),
        logs,
        title or "",
        roster=None if roster is None else read_people(read_csv_sheet(roster)),
        worksheets=tuple(map(read_csv_sheet, worksheet)),
        grade_column_title=column or "",
        due=parse_due_time(due_time_text) if due_time_text else None,
        grace_period_s=60.0 * grace,
        question_count=questions or 0,
        late_rule=parse_late_rule(late_rule_text) if late_rule_text else None,
        **other_settings,  # attempt, scale, include_pending and anonymous
    )
    with folder_progress(output) as show_progress:
        outcome = grade_submissions(
            submissions,
            course,
            output,
            processes=jobs,
            progress=partial(show_progress, "grading"),
        )
    write_and_print_results({}, grading_page(outcome), written_files=outcome.written_paths)


def _protect_inputs_from_output(input_paths: tuple[Path, ...], output: Path) -> None:
    """Register all input files, and check that the output folder is not inside an input folder."""
    resolved_path = output.resolve()
    output_and_parents = [
        folder for folder in (resolved_path, *resolved_path.parents) if folder.is_dir()
    ]
    for path in input_paths:
        if path.is_dir() and any(map(path.samefile, output_and_parents)):
            raise OutputError(
                f"-o {output} is inside the input {path}: the next run would read the output. "
                "Choose another output folder."
            )
        for file in list_files_recursively(path):
            register_input_path(file)
    check_output_folder(output)
