"""Reading the files that a person names: regular ones only, within a limit, and in one line if not.

Every file that is read is registered as an input, which no output replaces.

A device, a named pipe or a socket may never end or may block; a sparse file may be larger than any
memory. So a file is looked at before it is opened, and no more than its limit is read.
"""

import hashlib
import os
import stat
from collections.abc import Iterable
from contextlib import suppress
from contextvars import ContextVar
from pathlib import Path

from px4fuse.errors import LogError, Px4FuseError, did_you_mean, on_one_line
from px4fuse.input_files import add_input

#: Largest flight log that is read, in bytes; ``--max-size`` sets it for one command
max_log_bytes: ContextVar[int] = ContextVar("max_log_bytes", default=2_000_000_000)
_LARGER_LOGS = "Cut it to the flight, or allow more with --max-size MB"
_BYTES_PER_MB = 1_000_000


def shown(path: Path) -> str:
    r"""A path's last part for messages: never empty, and on one line.

    >>> shown(Path("logs/a.ulg")), shown(Path(".")), shown(Path("a\nb"))
    ('a.ulg', '.', 'a b')
    """
    return on_one_line(path.name or str(path))


def size_of(path: Path, refuse: type[Px4FuseError], name: str = "") -> int:
    """Size of a regular file in bytes; the file is registered as an input.

    Parameters
    ----------
    path : Path
        Symbolic links are followed.
    refuse : type
        Error to raise.
    name : str, optional
        For messages; by default as :func:`shown` shows it.

    Raises
    ------
    Px4FuseError
        Of type ``refuse``: it is missing, cannot be looked at, or is not a regular file.
    """
    name = name or shown(path)
    try:
        status = path.stat()
    except (OSError, ValueError) as error:  # ValueError: a path with a NUL in it
        near = ""
        with suppress(OSError):  # a folder that may not be looked into has no names to offer
            if isinstance(error, FileNotFoundError):
                near = did_you_mean(path.name, os.listdir(path.parent)).strip()  # noqa: PTH208
        raise _unreadable(name, error, refuse, near) from error
    if stat.S_ISDIR(status.st_mode):
        raise refuse(f"{name}: is a folder", "Give a file.")
    if not stat.S_ISREG(status.st_mode):
        raise refuse.of("not_regular", name=name)
    add_input(path)
    return status.st_size


def read_head(path: Path, count: int, refuse: type[Px4FuseError]) -> bytes:
    """First bytes of a regular file, at most ``count``.

    Raises
    ------
    Px4FuseError
        Of type ``refuse``.
    """
    size_of(path, refuse)
    return _read(path, count, refuse, shown(path))


def read_whole(
    path: Path,
    refuse: type[Px4FuseError],
    limit_bytes: int,
    *,
    name: str = "",
    smaller: str = "Cut it to the flight",
    again: str | None = None,
) -> bytes:
    """All bytes of a regular file that is not too large.

    Parameters
    ----------
    refuse : type
        Error to raise.
    name : str, optional
        For messages; by default as :func:`shown` shows it.
    smaller : str
        What to do where it is too large.
    again : str, optional
        What to do where it is empty; without it an empty file is read as it is.

    Raises
    ------
    Px4FuseError
        Of type ``refuse``.
    """
    name = name or shown(path)
    size = size_of(path, refuse, name)
    content = b"" if size > limit_bytes else _read(path, size + 1, refuse, name)
    if len(content) > size:  # it grows, or is one of /proc, which say that they are empty
        content = _read(path, limit_bytes + 1, refuse, name)
    if (least := max(size, len(content))) > limit_bytes:
        raise refuse(_too_large(name, least, limit_bytes), f"{smaller}.")
    if again is not None and not content:
        raise refuse(f"{name}: the file is empty", f"{again}.")
    return content


def read_log_bytes(path: Path) -> bytes:
    """All bytes of a flight log, up to :data:`max_log_bytes`.

    Raises
    ------
    LogError
        It cannot be read, is not a regular file, is empty or too large.
    """
    limit, again = max_log_bytes.get(), "Copy it from the vehicle again"
    return read_whole(path, LogError, limit, smaller=_LARGER_LOGS, again=again)


def read_text(
    path: Path,
    refuse: type[Px4FuseError],
    limit_bytes: int,
    *,
    name: str = "",
    smaller: str = "Cut it",
) -> str:
    """Text of a regular file in UTF-8, or in UTF-16 as a Windows shell writes it.

    Parameters
    ----------
    path, refuse, limit_bytes, name, smaller
        As :func:`read_whole` takes them.

    Raises
    ------
    Px4FuseError
        Of type ``refuse``.
    """
    name = name or shown(path)
    content = read_whole(path, refuse, limit_bytes, name=name, smaller=smaller)
    is_utf16 = content.startswith((b"\xff\xfe", b"\xfe\xff"))
    try:
        return content.decode("utf-16" if is_utf16 else "utf-8-sig")
    except UnicodeDecodeError as error:
        raise refuse.of("not_utf8", name=name, error=error) from error


def files_by_sha256(paths: Iterable[Path]) -> dict[str, Path]:
    """Flight logs and other recordings by their SHA-256; of a folder all regular files in it.

    In a folder, files larger than :data:`max_log_bytes` are passed over, as no log of such a size
    is read. Of files with the same content the first one counts.

    Raises
    ------
    LogError
        What was given is not a regular file or a folder, is too large, or cannot be read.
    """
    found: dict[str, Path] = {}
    limit = max_log_bytes.get()
    for path in paths:
        if path.is_dir():
            files = [f for f in files_below(path) if f.is_file() and size_of(f, LogError) <= limit]
        elif (size := size_of(path, LogError)) > limit:
            raise LogError(_too_large(shown(path), size, limit), f"{_LARGER_LOGS}.")
        else:
            files = [path]
        for file in files:
            try:
                with file.open("rb") as stream:
                    sha256 = hashlib.file_digest(stream, "sha256").hexdigest()
            except OSError as error:
                raise _unreadable(shown(file), error, LogError) from error
            found.setdefault(sha256, file)
    return found


def files_below(folder: Path) -> list[Path]:
    """All but folders in a folder and its subfolders, however deep, sorted; links as they are.

    A folder that cannot be looked into is among them.
    """
    found: list[Path] = []
    left = [folder]
    while left:
        place = left.pop()
        try:
            with os.scandir(place) as entries:
                for entry in entries:
                    into = left if entry.is_dir(follow_symlinks=False) else found
                    into.append(Path(entry.path))
        except OSError:
            found.append(place)
    return sorted(found)


def _read(path: Path, count: int, refuse: type[Px4FuseError], name: str) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(count)
    except OSError as error:
        raise _unreadable(name, error, refuse) from error


def _unreadable(
    name: str, error: Exception, refuse: type[Px4FuseError], remedy: str = ""
) -> Px4FuseError:
    reason = getattr(error, "strerror", None) or error
    return refuse(f"{name}: cannot be read ({reason}).", remedy)


def _too_large(name: str, *sizes: int) -> str:
    size, limit = (f"{n / _BYTES_PER_MB:,.{0 if n >= 10 * _BYTES_PER_MB else 2}f}" for n in sizes)
    return f"{name}: {size} MB, more than the limit of {limit} MB"
