"""Writing of output files; an interruption leaves no incomplete file."""

import errno
import os
import secrets
import stat
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from px4fuse.errors import OutputError

from .input_files import check_outputs

STANDARD_OUTPUT = Path("-")
# Windows does not replace a file that another program has open
OPERATING_SYSTEM_LOCKS_OPEN_FILES = sys.platform == "win32"
# Advice to the user if an output cannot be written, by error number
REMEDY_BY_ERRNO = {
    errno.ENOSPC: "Free disk space, or choose another disk.",
    errno.EROFS: "Choose a folder with write permission.",
}
# Messages about more paths contain only the number of paths
_MAX_LISTED_PATHS = 4


def write_output_files(
    contents: Mapping[Path, bytes], on_written: Callable[[Path], None] = lambda _: None
) -> None:
    """Write output files; create missing folders.

    An interruption leaves no incomplete file. ``on_written`` is called with each written path.

    Raises
    ------
    OutputError
        An output is an input of this command, or cannot be written.
    BrokenPipeError
        The program that reads a pipe has ended; all other outputs are written.
    """
    check_outputs(path for path in contents if path != STANDARD_OUTPUT)
    written_files: list[Path] = []
    pipe_error = None
    for path, content in contents.items():
        try:
            _write_output(path, content)
        except BrokenPipeError as error:  # the program that reads the pipe has ended
            pipe_error = error
            continue
        except OSError as error:
            raise _make_output_error(path, error, written_files) from error
        written_files.append(path)
        on_written(path)
    if pipe_error is not None:
        raise pipe_error


def format_written_outputs(paths: Sequence[Path]) -> str:
    """List the files that were written before an error or an interruption.

    >>> format_written_outputs([Path("a.pdf"), Path("a.json")])
    'outputs already written: a.pdf, a.json'
    """
    paths_text = (
        ", ".join(map(str, paths)) if len(paths) <= _MAX_LISTED_PATHS else f"{len(paths)} files"
    )
    return f"outputs already written: {paths_text}"


def _write_output(path: Path, content: bytes) -> None:
    """Write the bytes to standard output, to a regular file, or to a named pipe or device."""
    if path == STANDARD_OUTPUT or _is_standard_output(path):
        sys.stdout.flush()
        sys.stdout.buffer.write(content)
        sys.stdout.flush()
    elif stat.S_ISREG(_read_file_mode(path)):
        _replace_file(path.resolve(), content)
    else:  # named pipe or device
        path.write_bytes(content)


def _is_standard_output(path: Path) -> bool:
    """Return True if standard output is redirected to this file."""
    try:
        return os.path.samestat(path.stat(), os.fstat(1))
    except OSError:  # the file does not exist, or standard output is closed
        return False


def _read_file_mode(path: Path) -> int:
    """Return file type and permissions of a path; only the type "regular file" for a new file."""
    try:
        return path.stat().st_mode
    except FileNotFoundError:
        return stat.S_IFREG


def _replace_file(target: Path, content: bytes) -> None:
    """Write a file completely or not at all: a temporary file replaces the target."""
    is_new_folder = not target.parent.exists()
    target.parent.mkdir(parents=True, exist_ok=True)
    # a short name, because the target name may have the maximum length
    temporary_path = target.with_name(f".px4fuse-{secrets.token_hex(8)}")
    try:
        with temporary_path.open("xb") as file:
            file.write(content)
        temporary_path.replace(target)
    finally:
        temporary_path.unlink(missing_ok=True)
        if is_new_folder and not target.exists():  # writing failed
            target.parent.rmdir()


def _make_output_error(path: Path, error: OSError, written_files: Sequence[Path]) -> OutputError:
    """Return the error for an output that cannot be written, with advice to the user."""
    output_name = "standard output" if path == STANDARD_OUTPUT else path
    faults = [f"{output_name} cannot be written ({error.strerror})"]
    if written_files:
        faults.append(format_written_outputs(written_files))
    remedy = REMEDY_BY_ERRNO.get(error.errno or 0, "Choose another output name.")
    if OPERATING_SYSTEM_LOCKS_OPEN_FILES and isinstance(error, PermissionError):
        remedy = "Close the program that has the file open, or choose another output name."
    return OutputError("; ".join(faults), remedy)
