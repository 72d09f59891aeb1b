"""``px4fuse grade``: a folder of reports becomes a class table."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from px4fuse.cli.inputs import Named, max_size_option, open_option, path_option
from px4fuse.cli.outputs import Interrupted, open_written, progress, terminal, write_new
from px4fuse.errors import OutputError, SettingsError

if TYPE_CHECKING:
    from px4fuse.grading.grade import GradeOutcome


@click.command()
@click.argument("submissions", nargs=-1, type=Named())
@path_option(
    "--logs",
    multiple=True,
    metavar="DIR",
    help="Folder of the flight logs (or one log); may be repeated. Without a report's log its "
    "numbers cannot be verified.",
)
@path_option(
    "--rubric", metavar="FILE.toml", help="What is worth how many points.  [default: of this lab]"
)
@max_size_option
@path_option("--key", metavar="FILE.json", help="Answer key of px4fuse simulate --assignment.")
@path_option("-o", "--output", metavar="DIR", help="Folder for the class table and the feedback.")
@click.option(
    "--title", default="", show_default=False, help="Of the class page.  [default: the rubric's]"
)
@path_option(
    "--roster", metavar="FILE.csv", help="Everyone in the class.  [default: those of --key]"
)
@click.option(
    "--attempt",
    type=click.Choice(["latest", "best", "first"]),
    default="latest",
    help="Which of a student's files counts.",
)
@click.option(
    "--due",
    metavar="TIME",
    help="When it was due: '2026-11-20 23:59', in this computer's time zone or with "
    "'+01:00' or 'Europe/Berlin' behind it. Platforms' times without a zone are in the same.",
)
@click.option(
    "--late",
    metavar="RULE",
    help="What being late costs: '10%/day' or '10%/day up to 50%' of all points, per started day.",
)
@click.option(
    "--include-pending",
    is_flag=True,
    help="Enter points that still wait for you as they are proposed.",
)
@path_option(
    "--worksheet",
    multiple=True,
    metavar="FILE.csv",
    help="Moodle's grading worksheet, Canvas's gradebook, or another table with ids or names: a "
    "copy with the grades filled in is written. May be repeated.",
)
@click.option("--column", metavar="TITLE", help="Of the worksheets, for the grade.")
@click.option(
    "--anonymous", is_flag=True, help="The class page shows pseudonyms; names.csv says whose."
)
@click.option(
    "--jobs",
    type=click.IntRange(1, 256),
    metavar="N",
    help="How many reports at once.  [default: one per core]",
)
@path_option(
    "--write-rubric", metavar="FILE.toml", help="Write the default rubric, to edit it, and stop."
)
@path_option(
    "--write-autograder",
    metavar="FILE.zip",
    help="Write an autograder for Gradescope, with --logs, --key, --rubric and --late, and stop.",
)
@path_option("--gradescope", metavar="DIR", help="Run inside that autograder, on its folder.")
@open_option
def grade(submissions: tuple[Path, ...], output: Path | None, **given: Any) -> None:
    """Verify and score reports: PDFs, folders of them, and zip files of learning platforms.

    Writes class.csv, class.html, a feedback text per student and files that learning platforms
    import into DIR. What you write into its overrides.csv (id, item or total, points, comment)
    counts and is never written over. A second run verifies again only what has changed, so that
    a new rubric takes seconds. What students hand in is read within bounds of time and memory, and
    nothing in it is executed.
    """
    from px4fuse.assignment.key import read_key
    from px4fuse.assignment.roster import read_people
    from px4fuse.assignment.sheet import read_sheet
    from px4fuse.grading.entries import Course
    from px4fuse.grading.grade import grade as grade_all
    from px4fuse.grading.lateness import due_time, late_rule
    from px4fuse.grading.rubric import read_rubric, rubric_text

    if given["write_rubric"] is not None:
        write_new(given["write_rubric"], rubric_text().encode())
        return
    late = late_rule(given["late"]) if given["late"] else None
    if given["gradescope"] is not None:
        from px4fuse.grading.gradescope import run_autograder

        run_autograder(given["gradescope"], late)
        return
    if given["write_autograder"] is not None:
        from px4fuse.grading.gradescope import autograder_zip

        content = autograder_zip(given["logs"], given["rubric"], given["key"], late)
        write_new(given["write_autograder"], content)
        return
    if late is not None and given["due"] is None:
        raise SettingsError("--late: say with --due when it was due.")
    if not submissions:
        raise SettingsError("nothing to grade: give PDFs, folders or zip files.")
    if output is None:
        raise SettingsError("say with -o where the class table goes.")
    _check_place(output, (*submissions, *given["logs"]))
    key = None if given["key"] is None else read_key(given["key"])
    rubric = read_rubric(given["rubric"])
    course = Course(
        roster=None if given["roster"] is None else read_people(given["roster"]),
        worksheets=tuple(map(read_sheet, given["worksheet"])),
        column=given["column"] or "",
        attempt=given["attempt"],
        due=due_time(given["due"]) if given["due"] else None,
        late=late,
        include_pending=given["include_pending"],
        anonymous=given["anonymous"],
    )
    try:
        with progress() as step:
            outcome = grade_all(
                submissions,
                given["logs"],
                rubric,
                output,
                key=key,
                course=course,
                title=given["title"],
                processes=given["jobs"],
                progress=partial(step, "grading"),
            )
    except KeyboardInterrupt as stopped:
        left = "but what is graded is kept. The same command goes on from there."
        raise Interrupted(stopped, left) from None
    _print(outcome)
    open_written(output / "class.html")


def _check_place(output: Path, given: tuple[Path, ...]) -> None:
    if output.exists() and not output.is_dir():
        raise OutputError(f"-o {output}: is not a folder. Give another place.")
    for path in given:
        if path.is_dir() and output.resolve().is_relative_to(path.resolve()):
            raise OutputError(
                f"-o {output}: lies inside {path}, which is read; its own output would be graded. "
                "Choose another folder."
            )


def _print(outcome: GradeOutcome) -> None:
    from collections import Counter

    from px4fuse.report.page import Page
    from px4fuse.report.screen import print_file, show
    from px4fuse.report.style import GOOD, MUTED, SEVERITY_COLOURS
    from px4fuse.results.reading import one_line

    page, rows = Page(), []
    for entry in outcome.entries:
        one = entry.counting
        pending = ", pending" if one and entry.total is None else ""
        status = one.status + pending if one else "missing"
        look = GOOD if status == "verified" else SEVERITY_COLOURS["warning"]
        total = "–" if entry.total is None else f"{entry.total:g}"
        name = one_line(entry.student or entry.student_id, 60)
        file, flags = one.submission if one else "", f"{len(entry.flags) or ''}"
        rows.append((name, file, (status, look), f"{total} / {entry.of:g}", flags))
    page.table(("student", "submission", "status", "points", "flags"), rows, right=(3, 4))
    counts = Counter(one.status for one in outcome.graded)
    said = ", ".join(f"{count} {status}" for status, count in counts.most_common())
    missing = sum(entry.counting is None for entry in outcome.entries)
    page.write(
        f"{len(outcome.graded)} submissions: {said or 'none'}; {missing} of "
        f"{len(outcome.entries)} students handed in nothing; {outcome.reused} as verified before"
    )
    for note in outcome.notes:
        page.write(note, colour=MUTED)
    console = terminal()
    show(console, page.blocks)
    for path in outcome.written:
        print_file(console, "Wrote", path)
