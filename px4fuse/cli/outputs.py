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
from typing import TYPE_CHECKING, Any

import click

from px4fuse.core.input_files import check_outputs
from px4fuse.core.writing import STANDARD_OUTPUT, format_written_outputs, write_output_files
from px4fuse.errors import OutputError, ResultsError, to_one_line

if TYPE_CHECKING:
    from rich.console import Console

    from px4fuse.report.page import Page
    from px4fuse.request import Request
    from px4fuse.results.contract import Results

# Maximum length (bytes) of a default report name, and length to which a longer name is cut
MAX_REPORT_NAME_BYTES, SHORTENED_REPORT_NAME_BYTES = 200, 180

# Line width (characters) in a pipe: longer than any paragraph
LINE_WIDTH_OF_PIPED_OUTPUT = 10_000
# Key in the click context: paths of the files that the command has written
WRITTEN_FILES_KEY = "px4fuse.written"
# Key in the click context: True to open the output in its default program
OPENS_OUTPUT_KEY = "px4fuse.opens_output"
# Key in the click context: function that sends progress messages to px4fuse mcp
SEND_PROGRESS_KEY = "px4fuse.send"
# Key in the click context: list to which a command adds its results (JSON text) for px4fuse mcp
RESULTS_KEY = "px4fuse.results"
# Suffixes of files that --open can open, in order of preference
OPENABLE_SUFFIXES = (".html", ".htm", ".pdf", ".png")
# HTML element of a web page: the command that made the page, and the SHA-256 of the log
GENERATOR_PATTERN = re.compile('<meta name="generator" content="([^"]*)">')


# Function (activity, number of finished items, number of all items) that shows the progress
ShowProgress = Callable[..., None]


class Interrupted(Exception):  # noqa: N818 - no error, because the user ends the run
    """Ctrl-C or a termination signal, with a sentence about the written files."""

    def __init__(self, interrupt: KeyboardInterrupt, files_sentence: str) -> None:
        super().__init__(f"interrupted; {files_sentence}")
        # _raise_interrupt stores the signal number in args; Ctrl-C has no args
        self.exit_code = 128 + (interrupt.args[0] if interrupt.args else signal.SIGINT)


@contextmanager
def progress(*output_paths: Path | None) -> Iterator[ShowProgress]:
    """Check the output paths, and provide a function that shows the progress on a terminal.

    In a pipe, or if a target is standard output, the function shows nothing.

    Raises
    ------
    OutputError
        A target cannot be written, see :func:`check_output_paths`.
    """
    check_output_paths(output_paths)
    context = click.get_current_context(silent=True)
    if context and (send := context.meta.get(SEND_PROGRESS_KEY)):
        yield lambda activity, *_: send(activity)
        return
    from rich.console import Console

    console = Console(stderr=True)
    # older versions of rich print an empty line for a disabled progress bar
    if not console.is_terminal or STANDARD_OUTPUT in output_paths:
        yield lambda *_: None
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

        def show_progress(
            activity: str, done_count: int = 0, total_count: int | None = None
        ) -> None:
            count = "" if total_count is None else f"{done_count} of {total_count}"
            bar.update(
                task, description=activity, completed=done_count, total=total_count, count=count
            )

        yield show_progress


@contextmanager
def folder_progress(folder: Path) -> Iterator[ShowProgress]:
    """Show the progress as :func:`progress` does, for a run that writes results to a folder.

    If the user interrupts the run, the message says that the same command continues it.
    """
    try:
        with progress() as show_progress:
            yield show_progress
    except KeyboardInterrupt as interrupt:
        message = "nothing was written."
        if any(folder.glob("*")):
            message = f"{folder} contains the results so far. Run the same command to continue."
        raise Interrupted(interrupt, message) from None


def choose_default_report_path(report_stem: str, results: Results) -> Path:
    """Return the path of a report if the user gives none (-o); a long name is cut.

    Raises
    ------
    OutputError
        A file with this path exists, and is not a report on these input files and this student.
    """
    from px4fuse.results.reading import read_results
    from px4fuse.verification.pdf_input import read_attached_results

    if len(os.fsencode(report_stem)) > MAX_REPORT_NAME_BYTES:
        short_stem = os.fsencode(report_stem)[:SHORTENED_REPORT_NAME_BYTES].decode(errors="ignore")
        report_stem = f"{short_stem}_{hashlib.sha256(os.fsencode(report_stem)).hexdigest()[:8]}"
    path = Path("reports", f"{report_stem}.pdf")
    kind = "a report by the same student on the same input files"
    for target, read in (path, read_attached_results), (path.with_suffix(".json"), read_results):
        _require_replaceable_file(target, kind, partial(_is_same_report, results, read))
    return path


def check_default_page(path: Path, page: str) -> None:
    """Check that a web page may be written to its default path.

    Raises
    ------
    OutputError
        A file with this path exists, and is not a web page of the same command and log.
    """
    generator_tags = GENERATOR_PATTERN.findall(page)
    _require_replaceable_file(
        path,
        "a web page that the same command made from the same log",
        lambda content: GENERATOR_PATTERN.findall(content.decode()) == generator_tags,
    )


def _require_replaceable_file(path: Path, kind: str, can_replace: Callable[[bytes], bool]) -> None:
    """Raise ``OutputError`` if a file exists that must not be replaced."""
    try:
        may_replace = not path.exists() or can_replace(path.read_bytes())
    except (OSError, UnicodeDecodeError, ResultsError):
        may_replace = False
    if not may_replace:
        raise OutputError(
            f"{path} exists and was not overwritten, because the file is not recognised as {kind}",
            "Choose another name with -o.",
        )


def _is_same_report(
    new_results: Results, read: Callable[[bytes, str], Results], existing_content: bytes
) -> bool:
    """Return True if an existing report has the same input files and student as the new one.

    An existing report without a student is also accepted.
    """
    from px4fuse.results.contract import find_file_hashes, to_json
    from px4fuse.results.model import NO_STUDENT

    existing_results = read(existing_content, "report")
    # Sets, because answers of a student repeat the hash of the log
    existing_hashes, new_hashes = (
        set(find_file_hashes(to_json(results))) for results in (existing_results, new_results)
    )
    existing_student, new_student = (
        getattr(results, "student", NO_STUDENT) for results in (existing_results, new_results)
    )
    return existing_hashes == new_hashes and (existing_student.name, existing_student.id) in (
        ("", ""),
        (new_student.name, new_student.id),
    )


def choose_web_page_path(output: Path | None, default: Path) -> Path:
    """Return the path of a web page: the value of -o, or the default.

    Raises
    ------
    OutputError
        The name does not end in .html or .htm.
    """
    page_path = output or default
    if page_path.suffix.lower() not in (".html", ".htm") and page_path != STANDARD_OUTPUT:
        raise OutputError(
            f"{page_path}: the output is a web page. Give a name ending in .html (-o)."
        )
    return page_path


def choose_report_paths(output: Path | None, json_path: Path | None) -> list[Path]:
    """Return the paths of a report (PDF) and its results (JSON), from the values of -o and --json.

    Without -o, only the path of the results is returned: the report name depends on the analysis.

    Raises
    ------
    OutputError
        The name of the report does not end in .pdf, or a path cannot be written.
    """
    if output is not None and output.suffix.lower() != ".pdf":
        raise OutputError(f"{output}: the output is a PDF. Give a name ending in .pdf (-o).")
    results_path = json_path
    if output is not None and json_path in (None, STANDARD_OUTPUT):
        results_path = output.with_suffix(".json")
    paths = [path for path in (output, results_path) if path is not None]
    check_output_paths(paths)
    return paths


def make_result_files(
    results: Any,
    json_path: Path | None,
    output: Path | None = None,
    analysis: object = None,
    show_progress: ShowProgress = lambda *_: None,
    default_stem: str = "",
) -> dict[Path, bytes]:
    """Return the contents of the results (JSON) and of the report (PDF) by path.

    Without -o and --json, the report is named ``default_stem``, or not made if this is "".
    """
    from px4fuse.results.contract import to_json

    # If px4fuse mcp wants no report, json_path is "-" (standard output). The default report path
    # must be chosen before "-" is replaced by None below
    if default_stem and output is None and json_path is None:
        output = choose_default_report_path(default_stem, results)
    json_text, contents = to_json(results), dict[Path, bytes]()
    # px4fuse mcp takes the results from the context, so that standard output is text only
    if (recorded_texts := click.get_current_context().meta.get(RESULTS_KEY)) is not None:
        recorded_texts.append(json_text)
        json_path = None if json_path == STANDARD_OUTPUT else json_path
    if output is not None:
        from px4fuse.report.pdf import render_pdf

        show_progress("writing the report")
        # the results beside the report, or in the file of --json
        _, results_path = choose_report_paths(output, json_path)
        contents[output] = render_pdf(analysis, results, json_text)
        contents[results_path] = json_text.encode()
    # with -o and --json -, results are written to a file and to standard output
    if json_path is not None:
        contents[json_path] = json_text.encode()
    return contents


def write_outputs(contents: Mapping[Path, bytes]) -> None:
    """Write all outputs of a command.

    The paths are stored in the click context, because error messages list the files that were
    written before an error.

    Raises
    ------
    OutputError
        An output cannot be written.
    """
    check_output_paths(contents)
    written_files: list[Path] = click.get_current_context().meta.setdefault(WRITTEN_FILES_KEY, [])
    write_output_files(contents, written_files.append)


def describe_written_files(context: click.Context) -> str:
    written_files: list[Path] = context.meta.get(WRITTEN_FILES_KEY, [])
    return f"{format_written_outputs(written_files)}." if written_files else "nothing was written."


def write_new_file(path: Path, content: bytes) -> None:
    """Write a new file and print its name; an existing file is not overwritten.

    Raises
    ------
    OutputError
        The file exists.
    """
    if path.exists():
        raise OutputError(f"{path} exists and was not overwritten. Choose another file name.")
    write_and_print_results({path: content})


def check_output_paths(output_paths: Iterable[Path | None]) -> None:
    """Check output paths before the analysis begins; None and standard output are ignored.

    Raises
    ------
    OutputError
        Two outputs are the same file, an output is a folder or an input of this command, or a path
        cannot be written.
    """
    file_paths = [
        output_path for output_path in output_paths if output_path not in (None, STANDARD_OUTPUT)
    ]
    if len({file.resolve() for file in file_paths}) < len(file_paths):
        raise OutputError("two outputs have the same file name. Give different names.")
    for output_path in file_paths:
        try:
            if stat.S_ISDIR(output_path.stat().st_mode):
                raise OutputError(f"{output_path} is a folder. Give a file name.")
        except FileNotFoundError:
            continue
        except OSError as error:  # the file name is too long, or a parent folder is a file
            raise OutputError(
                f"{output_path} cannot be written ({error.strerror}). Choose another path."
            ) from error
    check_outputs(file_paths)


def write_and_print_results(
    contents: Mapping[Path, bytes],
    page: Page | None = None,
    request: Request | None = None,
    written_files: Iterable[Path] = (),
) -> None:
    """Write all outputs, print the results and the file names, and open a file (--open).

    Parameters
    ----------
    contents : mapping from Path to bytes
        Contents by path. If a path is standard output, nothing else is printed.
    page : Page, optional
        Results to print.
    request : Request, optional
        Settings of this analysis. The commands that ``page`` recommends are printed with these
        settings.
    written_files : iterable of Path
        Files that are already written.
    """
    from px4fuse.report.screen import print_blocks, print_line

    write_outputs(contents)
    files = [*contents, *written_files]
    if STANDARD_OUTPUT not in contents:
        console = make_console()
        if page is not None:
            print_blocks(console, page.blocks, request)
        for path in files:
            print_line(console, "Wrote", to_one_line(str(path)), "bold")
    openable_files = [
        path for suffix in OPENABLE_SUFFIXES for path in files if path.suffix.lower() == suffix
    ]
    if click.get_current_context().meta.get(OPENS_OUTPUT_KEY) and openable_files:
        click.launch(str(openable_files[0].resolve()))


def show_page(page: Page, *, uses_stderr: bool = False) -> None:
    from px4fuse.report.screen import print_blocks

    print_blocks(make_console(uses_stderr=uses_stderr), page.blocks)


def make_console(*, uses_stderr: bool = False) -> Console:
    """Return a console that raises BrokenPipeError if the reader of a pipe has ended.

    In a pipe, lines are not wrapped unless the environment variable COLUMNS contains a width.
    """
    from rich.console import Console

    class PipeConsole(Console):
        def on_broken_pipe(self) -> None:
            raise BrokenPipeError

    console = PipeConsole(highlight=False, stderr=uses_stderr)
    columns_text = os.environ.get("COLUMNS", "")
    if not console.is_terminal and not (columns_text.isdecimal() and int(columns_text)):
        console.width = LINE_WIDTH_OF_PIPED_OUTPUT
    elif console.width < 1:  # COLUMNS=0: rich would print nothing
        console.width = shutil.get_terminal_size().columns
    return console
