"""What commands write and show: files, standard output, and how far they are."""

from __future__ import annotations

import hashlib
import os
import shutil
import signal
import stat
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import click

from px4fuse.errors import OutputError, ResultsError, to_one_line
from px4fuse.input_files import check_outputs
from px4fuse.writing import STANDARD_OUTPUT, write_all, written_before

if TYPE_CHECKING:
    from msgspec import Struct
    from rich.console import Console

    from px4fuse.report.page import Page
    from px4fuse.request import Request
    from px4fuse.results.contract import Results

# Limit of the name of a report in bytes, and what is kept of a longer one: file systems take 255
LONGEST_NAME, LONGEST_STEM = 200, 180
# Name and id on a report without a student
NOBODY = ("", "")
# Columns of a line that no paragraph fills
UNWRAPPED_WIDTH = 10_000
# Under it a run keeps which files it has written, for what is said where it then ends early
WRITTEN_KEY = "px4fuse.written"
# And under this one whether what was written is to be opened
OPEN_KEY = "px4fuse.opened"
# What is looked at first, of all that a command writes
OPENABLE_SUFFIXES = (".html", ".htm", ".pdf", ".png")


class Interrupted(Exception):  # noqa: N818 - no error of anybody
    """The run was ended from outside.

    Parameters
    ----------
    stopped : KeyboardInterrupt
        With the number of the signal, where it was not Ctrl-C.
    left : str
        What the run leaves.
    """

    def __init__(self, stopped: KeyboardInterrupt, left: str) -> None:
        super().__init__(f"interrupted, {left}")
        self.exit_code = 128 + (stopped.args[0] if stopped.args else signal.SIGINT)


class ShowStep(Protocol):
    """Says what is being done, and how much of it is done where that can be counted."""

    def __call__(self, activity: str, done_count: int = 0, total_count: int | None = None) -> None:
        """Show it."""


def show_nothing(activity: str, done_count: int = 0, total_count: int | None = None) -> None:
    """Show nothing."""


@contextmanager
def progress(output: Path | None = None) -> Iterator[ShowStep]:
    """A bar on a terminal about what is being done, and what remains where that can be counted.

    Nothing in a pipe, nor where the output has standard output to itself.
    """
    from rich.console import Console

    console = Console(stderr=True)
    # an older rich ends a disabled bar with an empty line
    if not console.is_terminal or output == STANDARD_OUTPUT:
        yield show_nothing
        return
    from rich import progress as bars

    columns = (
        bars.SpinnerColumn(),
        bars.TextColumn("{task.description}", markup=False),
        bars.BarColumn(),
        bars.TextColumn("{task.fields[count]}"),
        bars.TimeElapsedColumn(),
        bars.TimeRemainingColumn(),
    )
    with bars.Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("starting", total=None, count="")

        def show(activity: str, done_count: int = 0, total_count: int | None = None) -> None:
            count = "" if total_count is None else f"{done_count} of {total_count}"
            bar.update(
                task, description=activity, completed=done_count, total=total_count, count=count
            )

        yield show


def default_report(stem: str, settings: str, results: Results) -> Path:
    """Path of a report without -o: the name of the log and the settings that are not defaults.

    Raises
    ------
    OutputError
        A file of that name exists that is not a report of the same files and student.
    """
    from px4fuse.results.contract import file_hashes_in, to_json
    from px4fuse.results.reading import read_results
    from px4fuse.verification.intake import attached_results

    name = f"{stem}{settings}"
    if len(os.fsencode(name)) > LONGEST_NAME:
        kept = os.fsencode(name)[:LONGEST_STEM].decode(errors="ignore")
        name = f"{kept}_{hashlib.sha256(os.fsencode(name)).hexdigest()[:8]}"
    path = Path("reports", f"{name}.pdf")
    for file, read in ((path, attached_results), (path.with_suffix(".json"), read_results)):
        if not file.exists():
            continue
        try:
            old = read(file.read_bytes(), file.name)
        except (OSError, ResultsError):
            is_same = False
        else:
            is_same = file_hashes_in(to_json(old)) == file_hashes_in(to_json(results))
            is_same &= _person(old) in (NOBODY, _person(results))
        if not is_same:
            raise OutputError.of("default_name_taken", file=file)
    return path


def _person(results: Results) -> tuple[str, str]:
    """Name and id on a report."""
    student = getattr(results, "student", None)
    return NOBODY if student is None else (student.name, student.id)


def web_page(output: Path | None, default: Path) -> Path:
    """Where a web page goes.

    Raises
    ------
    OutputError
        The name does not end as that of a web page, or as :func:`check_targets` says.
    """
    target = output or default
    if target.suffix.lower() not in (".html", ".htm") and target != STANDARD_OUTPUT:
        raise OutputError(f"{target}: a web page. Give a name that ends in .html with -o.")
    check_targets([target])
    return target


def report_paths(output: Path | None, json_path: Path | None) -> list[Path]:
    """Where a report and its results go: the results beside it, unless --json names a file.

    Of a report whose name will be found, what is known by now.

    Raises
    ------
    OutputError
        The report is no PDF, or as :func:`check_targets` says.
    """
    if output is not None and output.suffix.lower() != ".pdf":
        raise OutputError(f"{output}: the report is a PDF. Give a name that ends in .pdf with -o.")
    results_path = json_path
    if output is not None and json_path in (None, STANDARD_OUTPUT):
        results_path = output.with_suffix(".json")
    paths = [path for path in (output, results_path) if path is not None]
    check_targets(paths)
    return paths


def result_files(
    results: Struct | dict[str, Any],
    json_path: Path | None,
    output: Path | None = None,
    subject: object = None,
    step: ShowStep = show_nothing,
) -> dict[Path, bytes]:
    """Results where --json says, and a document as a PDF that holds them and has them beside it.

    Parameters
    ----------
    results : Struct or dict
    json_path, output : Path or None
        As given with --json and -o.
    subject : object, optional
        What the results are of, which is drawn.
    step : callable
        Told what is being done.
    """
    from px4fuse.results.contract import to_json

    text, contents = to_json(results), dict[Path, bytes]()
    if output is not None and subject is not None:
        from px4fuse.report.pdf import render

        step("drawing the report")
        output, results_path = report_paths(output, json_path)
        contents |= {output: render(subject, results, text), results_path: text.encode()}
    if json_path is not None:
        contents[json_path] = text.encode()
    return contents


def write_outputs(contents: Mapping[Path, bytes]) -> None:
    """Write results.

    Raises
    ------
    OutputError
        As :func:`check_targets`, or a target cannot be written.
    """
    check_targets(contents)
    written: list[Path] = click.get_current_context().meta.setdefault(WRITTEN_KEY, [])
    write_all(contents, written.append)


def written_so_far(context: click.Context) -> str:
    """List the files that this run has written, for a run that ends early."""
    written: list[Path] = context.meta.get(WRITTEN_KEY, [])
    return f"{written_before(written)}." if written else "nothing was written."


def write_new(path: Path, content: bytes) -> None:
    """Write a file that is not there yet, and say so.

    Raises
    ------
    OutputError
        It is there.
    """
    if path.exists():
        raise OutputError(f"{path}: exists already; it was not overwritten. Give another name.")
    write_and_print({path: content})


def check_targets(targets: Iterable[Path | None]) -> None:
    """Refuse outputs before the analysis.

    Raises
    ------
    OutputError
        Two targets are the same file, a target is a folder or one of the inputs so far, or its
        path is not possible.
    """
    files = [target for target in targets if target not in (None, STANDARD_OUTPUT)]
    if len({file.resolve() for file in files}) < len(files):
        raise OutputError("two outputs name the same file. Give each a name of its own.")
    for target in files:
        try:
            if stat.S_ISDIR(target.stat().st_mode):
                raise OutputError(f"{target}: is a folder. Give a file name.")
        except FileNotFoundError:
            continue
        except OSError as error:  # a name that is too long, a file in the place of a folder
            raise OutputError.of("cannot_be_written", target=target, error=error) from error
    check_outputs(files)


def write_and_print(
    contents: Mapping[Path, bytes],
    page: Page | None = None,
    request: Request | None = None,
    written: Iterable[Path] = (),
) -> None:
    """Write all outputs; then print the results and the names of the files; open one on request.

    Nothing is told where the results have standard output to themselves. Commands in the words are
    printed so that they run, where the request is given. ``written`` is what is there already.
    """
    from px4fuse.report.screen import print_line, show

    write_outputs(contents)
    files = [*contents, *written]
    if STANDARD_OUTPUT not in contents:
        console = terminal()
        if page is not None:
            show(console, page.blocks, request)
        for path in files:
            print_line(console, "Wrote", to_one_line(str(path)), "bold")
    openable = [
        path for ending in OPENABLE_SUFFIXES for path in files if path.suffix.lower() == ending
    ]
    if click.get_current_context().meta.get(OPEN_KEY) and openable:
        click.launch(str(openable[0].resolve()))


def terminal() -> Console:
    """Standard output for people; a reader that has gone, as with ``| head``, is no error.

    As wide as the terminal. In a pipe lines do not wrap, unless COLUMNS is their width, a number
    above 0: a paragraph is one line.
    """
    from rich.console import Console

    class PipeConsole(Console):
        def on_broken_pipe(self) -> None:
            raise BrokenPipeError

    console = PipeConsole(highlight=False)
    columns = os.environ.get("COLUMNS", "")
    if not console.is_terminal and not (columns.isdecimal() and int(columns)):
        console.width = UNWRAPPED_WIDTH
    elif console.width < 1:  # COLUMNS=0
        console.width = shutil.get_terminal_size().columns
    return console
