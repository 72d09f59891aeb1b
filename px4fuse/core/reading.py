"""Reading of input files: regular files only, up to a size limit.

Type and size are checked before a file is opened: reading a device or pipe may never end.
"""

import gzip
import hashlib
import os
import stat
import sys
import zlib
from collections.abc import Iterable, Sequence
from contextlib import suppress
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from px4fuse.errors import LogError, Px4FuseError, suggest_name, to_one_line

from .input_files import register_input_path

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

#: Maximum size (bytes) of a flight log; the option ``--max-size`` overrides it
max_log_bytes: ContextVar[int] = ContextVar("max_log_bytes", default=2_000_000_000)
#: Folders that ``px4fuse mcp`` may read (option ``--root``); all folders if empty
readable_folders: ContextVar[tuple[Path, ...]] = ContextVar("readable_folders", default=())
# Byte order marks of UTF-16, the encoding of texts from Windows shells
UTF_16_BYTE_ORDER_MARKS = (b"\xff\xfe", b"\xfe\xff")
LOG_SIZE_REMEDY = (
    "Cut the log to the time span of the flight, or increase the size limit with --max-size MB."
)


def display_name(path: Path) -> str:
    r"""Return the file name of a path on one line, for messages.

    >>> display_name(Path("logs/a.ulg")), display_name(Path(".")), display_name(Path("a\nb"))
    ('a.ulg', '.', 'a b')
    """
    return to_one_line(path.name or str(path))


def split_path_and_part(argument: str) -> tuple[Path, str | None]:
    """Split ``FILE:PART`` into a path and the name of a part, for example a ROS topic."""
    path, colon, part_name = argument.rpartition(":")
    if colon and not Path(argument).exists() and (part_name.isidentifier() or Path(path).exists()):
        return Path(path), part_name
    return Path(argument), None


def check_readable(path: Path, folders: Sequence[Path]) -> None:
    """Raise a LogError if a file is outside all ``folders``; symbolic links are resolved.

    If ``folders`` is empty, all paths are accepted.
    """
    resolved_path = Path(os.path.realpath(path))
    if folders and not any(map(resolved_path.is_relative_to, folders)):
        folder_names_text = " or ".join(map(str, folders))
        raise LogError(
            f"{display_name(path)} is outside the folders that --root allows",
            f"Copy the file to {folder_names_text}.",
        )


def get_file_size(path: Path, error_type: type[Px4FuseError], name: str = "") -> int:
    """Return the size (bytes) of a regular file, and register the file as an input.

    Raises
    ------
    Px4FuseError
        Type ``error_type``: the file is missing, not accessible, or not a regular file.
    LogError
        The file is outside :data:`readable_folders`.
    """
    name = name or display_name(path)
    try:
        check_readable(path, readable_folders.get())
        file_status = path.stat()
    except (OSError, ValueError) as error:  # ValueError: the path contains NUL
        suggestion = ""
        with suppress(OSError):  # no suggestion if the folder cannot be listed
            if isinstance(error, FileNotFoundError):
                folder = path.parent
                suggestion = suggest_name(path.name, os.listdir(folder), folder).strip()  # noqa: PTH208
        raise _make_read_error(name, error, error_type, suggestion) from error
    if stat.S_ISDIR(file_status.st_mode):
        raise error_type(f"{name} is a folder", "Give a file.")
    if not stat.S_ISREG(file_status.st_mode):
        raise error_type(f"{name} is a device, pipe or socket.", "Give a regular file.")
    register_input_path(path)
    return file_status.st_size


def read_head(path: Path, byte_count: int, error_type: type[Px4FuseError]) -> bytes:
    """Read the first ``byte_count`` bytes of a regular file."""
    get_file_size(path, error_type)
    return _read_bytes(path, byte_count, error_type, display_name(path))


def read_bytes_limited(
    path: Path,
    error_type: type[Px4FuseError],
    limit_bytes: int,
    *,
    name: str = "",
    remedy_if_too_large: str = "Cut the file to the time span of the flight.",
    remedy_if_empty: str | None = None,
) -> bytes:
    """Read all bytes of a regular file up to a size limit.

    Empty files are accepted if ``remedy_if_empty`` is None.

    Raises
    ------
    Px4FuseError
        Type ``error_type``: the file cannot be read, is too large or empty.
    """
    name = name or display_name(path)
    size_bytes = get_file_size(path, error_type, name)
    content = b""
    if size_bytes <= limit_bytes:
        # Python reserves as much memory as is requested, so first the size of the file is
        # requested, not the limit. One byte more shows that the content is longer: the file is
        # compressed, growing, or in /proc, where the size is 0. It is then read up to the limit
        content = _read_bytes(path, size_bytes + 1, error_type, name)
        if len(content) > size_bytes:
            content = _read_bytes(path, limit_bytes + 1, error_type, name)
            size_bytes = len(content)
    if size_bytes > limit_bytes:
        raise error_type(format_size_limit(name, size_bytes, limit_bytes), remedy_if_too_large)
    if remedy_if_empty is not None and not content:
        raise error_type(f"{name}: the file is empty", remedy_if_empty)
    return content


def read_log_bytes(path: Path) -> bytes:
    """Read all bytes of a flight log, up to :data:`max_log_bytes`.

    Raises
    ------
    LogError
        The log cannot be read, is not a regular file, is empty or too large.
    """
    return read_bytes_limited(
        path,
        LogError,
        max_log_bytes.get(),
        remedy_if_too_large=LOG_SIZE_REMEDY,
        remedy_if_empty="Copy the log from the vehicle again.",
    )


def read_text(
    path: Path,
    error_type: type[Px4FuseError],
    limit_bytes: int,
    *,
    name: str = "",
    remedy_if_too_large: str = "Give a smaller file.",
) -> str:
    """Read a text file in UTF-8 or UTF-16.

    For arguments and errors see :func:`read_bytes_limited`.
    """
    name = name or display_name(path)
    content = read_bytes_limited(
        path, error_type, limit_bytes, name=name, remedy_if_too_large=remedy_if_too_large
    )
    is_utf_16 = content.startswith(UTF_16_BYTE_ORDER_MARKS)
    try:
        return content.decode("utf-16" if is_utf_16 else "utf-8-sig")
    except UnicodeDecodeError as error:
        raise error_type(
            f"{name} is not a text file in UTF-8: the byte at position {error.start} is invalid.",
            "Save the file as UTF-8.",
        ) from error


def hash_files(paths: Iterable[Path]) -> dict[str, Path]:
    """Return a mapping from SHA-256 to file, for files and all files in folders.

    Files in folders are ignored if they are larger than :data:`max_log_bytes`.

    Raises
    ------
    LogError
        A path is not a regular file or a folder, or the file is too large or cannot be read.
    """
    file_by_hash: dict[str, Path] = {}
    limit_bytes = max_log_bytes.get()
    for path in paths:
        if path.is_dir():
            files = [
                folder_file
                for folder_file in list_files_recursively(path)
                if folder_file.is_file() and get_file_size(folder_file, LogError) <= limit_bytes
            ]
        elif (size_bytes := get_file_size(path, LogError)) > limit_bytes:
            raise LogError(
                format_size_limit(display_name(path), size_bytes, limit_bytes), LOG_SIZE_REMEDY
            )
        else:
            files = [path]
        for file in files:
            try:
                with file.open("rb") as stream:
                    sha256 = hashlib.file_digest(stream, "sha256").hexdigest()
            except OSError as error:
                raise _make_read_error(display_name(file), error, LogError) from error
            file_by_hash.setdefault(sha256, file)
    return file_by_hash


def list_files_recursively(folder: Path) -> list[Path]:
    """Return all files in a folder and its subfolders; links to folders are not followed.

    A folder that cannot be listed is returned too, so that reading it raises an error.
    """
    files: list[Path] = []
    # os.walk of Python 3.11 is recursive, so it fails for deeply nested folders
    pending_folders = [folder]
    while pending_folders:
        folder_path = pending_folders.pop()
        try:
            with os.scandir(folder_path) as entries:
                for entry in entries:
                    target_paths = pending_folders if entry.is_dir(follow_symlinks=False) else files
                    target_paths.append(Path(entry.path))
        except OSError:
            files.append(folder_path)
    return sorted(files)


def _read_bytes(path: Path, byte_count: int, error_type: type[Px4FuseError], name: str) -> bytes:
    try:
        with _open_decompressed(path) as file:
            content: bytes = file.read(byte_count)
            return content
    except (OSError, EOFError, zlib.error, zstd.ZstdError) as error:
        raise _make_read_error(name, error, error_type) from error


def _open_decompressed(path: Path) -> Any:
    """Open a file; decompress it if it is compressed by gzip or zstd."""
    with path.open("rb") as file:
        compression_module = {b"\x1f\x8b\x08": gzip, b"\x28\xb5\x2f": zstd}.get(file.read(3))
    return compression_module.open(path) if compression_module else path.open("rb")


def _make_read_error(
    name: str, error: Exception, error_type: type[Px4FuseError], remedy: str = ""
) -> Px4FuseError:
    reason = getattr(error, "strerror", None) or error
    return error_type(f"{name}: the file cannot be read ({reason}).", remedy)


def format_size_limit(name: str, size_bytes: int, limit_bytes: int) -> str:
    """Return the error message for a file that exceeds the size limit."""
    size_mb_text, limit_mb_text = (
        f"{byte_count / 1e6:,.{0 if byte_count >= 10_000_000 else 2}f}"
        for byte_count in (size_bytes, limit_bytes)
    )
    return f"{name}: the file has {size_mb_text} MB, more than the limit of {limit_mb_text} MB"
