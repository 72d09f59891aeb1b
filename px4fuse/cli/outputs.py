"""Output of commands: files, standard output and progress."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import signal
import stat
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
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

# Maximum bytes of a report's name (file systems allow 255), and of the start of a longer name
MAX_NAME_BYTES, KEPT_STEM_BYTES = 200, 180
# Name and id on a report without a student
NO_PERSON = ("", "")
# In characters; longer than any paragraph
UNWRAPPED_WIDTH = 10_000
# Key in click's context: files that this run has written, for the message if it ends early
WRITTEN_KEY = "px4fuse.written"
# Key in click's context: True if the output is to be opened
OPEN_KEY = "px4fuse.opened"
# --open opens the first file with one of these suffixes, in this order
OPENABLE_SUFFIXES = (".html", ".htm", ".pdf", ".png")
# Command and SHA-256 of the log in the head of a web page
GENERATOR = re.compile('<meta name="generator" content="([^"]*)">')


class Interrupted(Exception):  # noqa: N818 - the user ends the run: no error
    """End of a run by Ctrl-C or a signal.

    Parameters
    ----------
    interrupt : KeyboardInterrupt
        Contains the number of the signal, except for Ctrl-C.
    files_sentence : str
        Sentence on the files that the run has written.
    """

    def __init__(self, interrupt: KeyboardInterrupt, files_sentence: str) -> None:
        super().__init__(f"interrupted; {files_sentence}")
        self.exit_code = 128 + (interrupt.args[0] if interrupt.args else signal.SIGINT)


class ShowProgress(Protocol):
    """Function that shows the current activity, with counts if the work can be counted."""

    def __call__(self, activity: str, done_count: int = 0, total_count: int | None = None) -> None:
        """Show the activity."""


def show_nothing(activity: str, done_count: int = 0, total_count: int | None = None) -> None:
    """Do nothing: no progress is shown."""


@contextmanager
def progress(output: Path | None = None) -> Iterator[ShowProgress]:
    """Show a progress bar on the terminal with the current activity and the remaining time.

    Nothing is shown in a pipe, or if the output is written to standard output.
    """
    from rich.console import Console

    console = Console(stderr=True)
    # Older versions of rich print an empty line after a disabled bar
    if not console.is_terminal or output == STANDARD_OUTPUT:
        yield show_nothing
        return
    from rich import progress as rich_progress

    columns = (
        rich_progress.SpinnerColumn(),
        rich_progress.TextColumn("{task.description}", markup=False),
        rich_progress.BarColumn(),
        rich_progress.TextColumn("{task.fields[count]}"),
        rich_progress.TimeElapsedColumn(),
        rich_progress.TimeRemainingColumn(),
    )
    with rich_progress.Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("starting", total=None, count="")

        def show(activity: str, done_count: int = 0, total_count: int | None = None) -> None:
            count = "" if total_count is None else f"{done_count} of {total_count}"
            bar.update(
                task, description=activity, completed=done_count, total=total_count, count=count
            )

        yield show


def default_report(stem: str, settings: str, results: Results) -> Path:
    """Return the path of a report without -o: log name and changed settings.

    Raises
    ------
    OutputError
        A file of that name exists and is not a report of the same files and student.
    """
    from px4fuse.results.reading import read_results
    from px4fuse.verification.pdf_input import attached_results

    name = f"{stem}{settings}"
    if len(os.fsencode(name)) > MAX_NAME_BYTES:
        short_stem = os.fsencode(name)[:KEPT_STEM_BYTES].decode(errors="ignore")
        name = f"{short_stem}_{hashlib.sha256(os.fsencode(name)).hexdigest()[:8]}"
    path = Path("reports", f"{name}.pdf")
    kind = "a report of the same files and student by this version"
    _check_default(path, kind, partial(_is_same_report, results, attached_results))
    _check_default(path.with_suffix(".json"), kind, partial(_is_same_report, results, read_results))
    return path


def check_default_page(path: Path, page: str) -> None:
    """Check the default path of a web page.

    Raises
    ------
    OutputError
        A file of that name exists and is not a page of the same command and log.
    """
    generator = GENERATOR.findall(page)
    kind = "a page of the same command and log by this version"
    _check_default(path, kind, lambda content: GENERATOR.findall(content.decode()) == generator)


def _check_default(path: Path, kind: str, is_replaceable: Callable[[bytes], bool]) -> None:
    """Raise an error if the file of a default path exists and its content is of another kind."""
    try:
        may_replace = not path.exists() or is_replaceable(path.read_bytes())
    except (OSError, UnicodeDecodeError, ResultsError):
        may_replace = False
    if not may_replace:
        raise OutputError(
            f"{path} exists and is not {kind}; it was not overwritten",
            "Choose another name with -o.",
        )


def _is_same_report(
    results: Results, read: Callable[[bytes, str], Results], content: bytes
) -> bool:
    """Return True if an existing report has the same input files, and no other student."""
    from px4fuse.results.contract import file_hashes_in, to_json

    existing = read(content, "report")
    same_files = file_hashes_in(to_json(existing)) == file_hashes_in(to_json(results))
    return same_files and _person(existing) in (NO_PERSON, _person(results))


def _person(results: Results) -> tuple[str, str]:
    """Return name and id of the student on a report."""
    student = getattr(results, "student", None)
    return NO_PERSON if student is None else (student.name, student.id)


def web_page(output: Path | None, default: Path) -> Path:
    """Return the path of a web page.

    Raises
    ------
    OutputError
        The name does not end in .html or .htm; also errors of :func:`check_targets`.
    """
    target = output or default
    if target.suffix.lower() not in (".html", ".htm") and target != STANDARD_OUTPUT:
        raise OutputError(f"{target}: the output is a web page. Give a name ending in .html (-o).")
    check_targets([target])
    return target


def report_paths(output: Path | None, json_path: Path | None) -> list[Path]:
    """Return the paths of a report and its results; without --json the results are beside it.

    Without -o the list does not contain the report, because its name is determined later.

    Raises
    ------
    OutputError
        The name does not end in .pdf; also errors of :func:`check_targets`.
    """
    if output is not None and output.suffix.lower() != ".pdf":
        raise OutputError(f"{output}: the output is a PDF. Give a name ending in .pdf (-o).")
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
    analysis: object = None,
    show_progress: ShowProgress = show_nothing,
) -> dict[Path, bytes]:
    """Return the contents of the results (JSON) and of the report (PDF) by their paths.

    Parameters
    ----------
    results : Struct or dict
    json_path, output : Path or None
        Values of --json and -o.
    analysis : object, optional
        Analysis that the report shows; without it no report is written.
    show_progress : callable
    """
    from px4fuse.results.contract import to_json

    text, contents = to_json(results), dict[Path, bytes]()
    if output is not None and analysis is not None:
        from px4fuse.report.pdf import render

        show_progress("writing the report")
        output, results_path = report_paths(output, json_path)
        contents |= {output: render(analysis, results, text), results_path: text.encode()}
    if json_path is not None:
        contents[json_path] = text.encode()
    return contents


def write_outputs(contents: Mapping[Path, bytes]) -> None:
    """Write all outputs of a command and remember them for messages.

    Raises
    ------
    OutputError
        A target cannot be written; also errors of :func:`check_targets`.
    """
    check_targets(contents)
    written: list[Path] = click.get_current_context().meta.setdefault(WRITTEN_KEY, [])
    write_all(contents, written.append)


def written_so_far(context: click.Context) -> str:
    """List the files that this run has written, for the message if it ends early."""
    written: list[Path] = context.meta.get(WRITTEN_KEY, [])
    return f"{written_before(written)}." if written else "nothing was written."


def write_new(path: Path, content: bytes) -> None:
    """Write a file that does not exist yet, and print its name.

    Raises
    ------
    OutputError
        The file exists.
    """
    if path.exists():
        raise OutputError(f"{path} exists and was not overwritten. Choose another name.")
    write_and_print({path: content})


def check_targets(targets: Iterable[Path | None]) -> None:
    """Reject impossible output paths before the analysis begins.

    Raises
    ------
    OutputError
        Two targets are the same file, a target is a folder or an input of this command, or its
        path is not possible.
    """
    files = [target for target in targets if target not in (None, STANDARD_OUTPUT)]
    if len({file.resolve() for file in files}) < len(files):
        raise OutputError("two outputs have the same file name. Give them different names.")
    for target in files:
        try:
            if stat.S_ISDIR(target.stat().st_mode):
                raise OutputError(f"{target} is a folder. Give a file name.")
        except FileNotFoundError:
            continue
        except OSError as error:  # The name is too long, or a parent is a file
            raise OutputError(
                f"{target} cannot be written ({error.strerror}). Choose another place."
            ) from error
    check_outputs(files)


def write_and_print(
    contents: Mapping[Path, bytes],
    page: Page | None = None,
    request: Request | None = None,
    written: Iterable[Path] = (),
) -> None:
    """Write all outputs, print the results and the file names, and open one file if requested.

    Parameters
    ----------
    contents : mapping from Path to bytes
        With standard output among the paths, nothing else is printed.
    page : Page, optional
        Results to print.
    request : Request, optional
        Files and options that complete the commands on the page, so that they can be pasted.
    written : iterable of Path
        Files that the command has written already.
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
        path for suffix in OPENABLE_SUFFIXES for path in files if path.suffix.lower() == suffix
    ]
    if click.get_current_context().meta.get(OPEN_KEY) and openable:
        click.launch(str(openable[0].resolve()))


def show_page(page: Page, *, is_error: bool = False) -> None:
    """Print a page on the terminal, an error on standard error."""
    from px4fuse.report.screen import show

    show(terminal(is_error=is_error), page.blocks)


def terminal(*, is_error: bool = False) -> Console:
    """Return a console; it raises BrokenPipeError if the reader of standard output has ended.

    Lines have the width of the terminal. In a pipe a paragraph is one line, unless the environment
    variable COLUMNS gives the width.
    """
    from rich.console import Console

    class PipeConsole(Console):
        def on_broken_pipe(self) -> None:
            raise BrokenPipeError

    console = PipeConsole(highlight=False, stderr=is_error)
    columns_text = os.environ.get("COLUMNS", "")
    if not console.is_terminal and not (columns_text.isdecimal() and int(columns_text)):
        console.width = UNWRAPPED_WIDTH
    elif console.width < 1:  # The environment variable COLUMNS is 0
        console.width = shutil.get_terminal_size().columns
    return console
