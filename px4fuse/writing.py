"""Writing results so that a failed run leaves nothing behind and overwrites nothing."""

import errno
import os
import secrets
import signal
import stat
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from px4fuse.errors import OutputError

STANDARD_OUTPUT = Path("-")
# How long a named pipe is waited for that nobody reads yet
READER_S = 5.0
# Whether a file that another program has open cannot be replaced
LOCKS = sys.platform == "win32"
#: What ends a run from outside: Ctrl-C, termination, and (not on Windows) a closed terminal
STOPPING = (signal.SIGINT, signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else []))


@dataclass(frozen=True)
class _Staged:
    """A file that is written but not yet in its place."""

    path: Path  # as it was given
    real: Path  # behind symbolic links
    part: Path


def write_all(
    contents: Mapping[Path, bytes], placed: Callable[[Path], None] = lambda _: None
) -> None:
    """Write several outputs together: first all that can fail, then every file to its place.

    A regular file, old or new, is written under a temporary name beside it and renamed; a symbolic
    link stays, and what it leads to is replaced. Standard output, devices and named pipes are
    written to as they are, after the temporary files and before the first rename. Ctrl-C and
    termination take effect before the first rename or after the last one.

    Parameters
    ----------
    contents : mapping from Path to bytes
        Missing folders are made. :data:`STANDARD_OUTPUT` is standard output.
    placed : callable
        Told of every file once all are in their places.

    Raises
    ------
    OutputError
        A target cannot be written. What was there before is there again; where that failed too,
        the text says what is there.
    BrokenPipeError
        The reader of a pipe has left; the files are in their places all the same.
    """
    streams = [path for path in contents if _is_stream(path)]
    staged: list[_Staged] = []
    gone = None
    try:
        for path, content in contents.items():
            if path not in streams:
                with _explained(path):
                    _stage(path, content, staged)
        for path in streams:
            try:
                with _explained(path):
                    _stream(path, contents[path])
            except BrokenPipeError as error:  # as with | head, which may have seen enough
                gone = error
        with _uninterrupted():
            _rename(staged)
            for one in staged:
                placed(one.path)
    finally:
        for one in staged:
            one.part.unlink(missing_ok=True)
    if gone is not None:
        raise gone


def _is_stream(path: Path) -> bool:
    """Whether a target is written to as it is: nothing may be renamed to its place."""
    if path == STANDARD_OUTPUT:
        return True
    with _explained(path):
        try:
            status = path.stat()
        except FileNotFoundError:
            return False
    if stat.S_ISDIR(status.st_mode):
        raise OutputError(f"{path}: is a folder. Give a file name.")
    return not stat.S_ISREG(status.st_mode) or _is_standard_output(status)


def _is_standard_output(status: os.stat_result) -> bool:
    """Whether standard output goes there, as to /dev/stdout under ``> file``."""
    try:
        return os.path.samestat(status, os.fstat(1))
    except OSError:  # closed
        return False


def _stage(path: Path, content: bytes, staged: list[_Staged]) -> None:
    real = path.resolve()
    real.parent.mkdir(parents=True, exist_ok=True)
    staged.append(_Staged(path, real, _temporary(real)))
    with staged[-1].part.open("xb") as file:
        file.write(content)


def _temporary(real: Path) -> Path:
    """A free name in the same folder; short, as a name may already be as long as it can be."""
    return real.with_name(f".px4fuse-{secrets.token_hex(8)}")


def _stream(path: Path, content: bytes) -> None:
    if path == STANDARD_OUTPUT or _is_standard_output(path.stat()):
        sys.stdout.flush()
        sys.stdout.buffer.write(content)
        sys.stdout.flush()
        return
    with _opened_pipe(path) if path.is_fifo() else path.open("wb") as file:
        file.write(content)


def _opened_pipe(path: Path) -> IO[bytes]:
    """A named pipe that somebody reads; one that nobody reads would keep us waiting for ever."""
    until = time.monotonic() + READER_S
    while True:
        try:
            number = os.open(path, os.O_WRONLY | os.O_NONBLOCK)
        except OSError as error:
            if error.errno != errno.ENXIO or time.monotonic() > until:
                raise
            time.sleep(0.05)
        else:
            os.set_blocking(number, True)
            return os.fdopen(number, "wb")


def _rename(staged: Sequence[_Staged]) -> None:
    """Move all files to their places, or none."""
    old: dict[Path, Path] = {}
    new: list[Path] = []
    try:
        for one in staged:
            with _explained(one.path):
                # the last rename happens or not; only what is before it may have to be undone
                if one is not staged[-1] and one.real.exists():
                    kept = _temporary(one.real)
                    one.real.replace(kept)
                    old[one.real] = kept
                one.part.replace(one.real)
                new.append(one.real)
    except OutputError as error:
        raise OutputError(f"{error} {_put_back(old, new)}") from error
    for kept in old.values():
        kept.unlink()


def _put_back(old: Mapping[Path, Path], new: Sequence[Path]) -> str:
    """Undo renames, and say what is there now."""
    failed = []
    for real in {*old, *new}:
        try:
            if real in old:
                old[real].replace(real)
            else:
                real.unlink()
        except OSError as error:
            held = f"what it held is in {old[real].name}" if real in old else "it is new"
            failed.append(f"{real} could not be put back ({error.strerror}): {held}.")
    return " ".join(sorted(failed)) or "No file was written."


@contextmanager
def _explained(path: Path) -> Iterator[None]:
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        name = "standard output" if path == STANDARD_OUTPUT else path
        why = "nobody reads this pipe" if error.errno == errno.ENXIO else error.strerror
        locked = LOCKS and isinstance(error, PermissionError)
        remedy = "Close the program that has it open, or choose" if locked else "Choose"
        raise OutputError.of("not_written", name=name, why=why, remedy=remedy) from error


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Hold back what would end the run; only the main thread can be interrupted."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    before = {
        number: signal.signal(number, lambda number, _: came.append(number)) for number in STOPPING
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if came:
            signal.raise_signal(came[0])
