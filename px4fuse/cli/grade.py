"""``px4fuse grade``: a folder of reports becomes a class table."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from px4fuse.cli.inputs import max_size_option, path_option
from px4fuse.cli.outputs import Interrupted, progress, terminal, write_outputs
from px4fuse.errors import OutputError, SettingsError

if TYPE_CHECKING:
    from px4fuse.grading.grade import Outcome


@click.command()
@click.argument("submissions", nargs=-1, type=click.Path(path_type=Path))
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
@click.option("--title", default="Class", show_default=True, help="Of the class page.")
@click.option(
    "--jobs",
    type=click.IntRange(1, 256),
    default=None,
    metavar="N",
    help="How many reports at once.  [default: one per core]",
)
@path_option(
    "--write-rubric", metavar="FILE.toml", help="Write the default rubric, to edit it, and stop."
)
def grade(
    submissions: tuple[Path, ...],
    logs: tuple[Path, ...],
    rubric: Path | None,
    key: Path | None,
    output: Path | None,
    title: str,
    jobs: int | None,
    write_rubric: Path | None,
) -> None:
    """Verify and score reports: PDFs, folders of them, and zip files of learning platforms.

    Writes class.csv, class.html, one feedback text per student and Gradescope's results.json into
    DIR. A second run does again only what has changed. What students hand in is read within bounds
    of time and memory, and nothing in it is executed.
    """
    from px4fuse.grading.grade import grade as grade_all
    from px4fuse.grading.rubric import read_rubric, rubric_text

    if write_rubric is not None:
        if write_rubric.exists():
            raise OutputError(f"{write_rubric}: exists already; it was not overwritten.")
        write_outputs({write_rubric: rubric_text().encode()})
        click.echo(f"Wrote    {write_rubric}")
        return
    if not submissions:
        raise SettingsError("nothing to grade: give PDFs, folders or zip files.")
    if output is None:
        raise SettingsError("say with -o where the class table goes.")
    if output.exists() and not output.is_dir():
        raise OutputError(f"-o {output}: is not a folder. Give another place.")
    for path in (*submissions, *logs):
        if not path.exists():
            raise SettingsError(f"{path}: no such file or folder.")
        if path.is_dir() and output.resolve().is_relative_to(path.resolve()):
            raise OutputError(
                f"-o {output}: lies inside {path}, which is read; its own output would be graded. "
                "Choose another folder."
            )
    answers = None
    if key is not None:
        from px4fuse.assignment.key import read_key

        answers = read_key(key)
    chosen = read_rubric(rubric)
    try:
        with progress() as step:
            outcome = grade_all(
                submissions,
                logs,
                chosen,
                output,
                key=answers,
                title=title,
                processes=jobs,
                progress=partial(step, "grading"),
            )
    except KeyboardInterrupt as stopped:
        left = "but what is graded is kept. The same command goes on from there."
        raise Interrupted(stopped, left) from None
    _print(outcome)


def _print(outcome: Outcome) -> None:
    from collections import Counter

    from rich.text import Text

    from px4fuse.report.screen import plain_table, print_file, say
    from px4fuse.results.reading import one_line

    console = terminal()
    table = plain_table(
        ("submission", "left"), ("student", "left"), ("status", "left"), ("points", "right"),
        ("flags", "right"),
    )  # fmt: skip
    for one in outcome.graded:
        style = "green" if one.status == "verified" else "yellow"
        table.add_row(
            Text(one.submission),
            Text(one_line(one.student or one.student_id, 60)),
            Text(one.status, style),
            f"{one.points:g} / {one.of:g}" if one.items else "–",
            f"{len(one.flags)}" if one.flags else "",
        )
    console.print(table)
    counts = Counter(one.status for one in outcome.graded)
    said = ", ".join(f"{count} {status}" for status, count in counts.most_common())
    say(console, f"{len(outcome.graded)} submissions: {said}; {outcome.reused} as before")
    for note in outcome.notes:
        say(console, Text(note, "dim"))
    for path in outcome.written:
        print_file(console, "Wrote", path)
