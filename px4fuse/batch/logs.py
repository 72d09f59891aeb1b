"""Search for logs among files, folders, globs and URLs (with fsspec)."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from px4fuse.core.input_files import register_input_path
from px4fuse.core.reading import max_log_bytes
from px4fuse.core.text import shorten_to_line
from px4fuse.errors import LogError, SettingsError

if TYPE_CHECKING:
    from fsspec import AbstractFileSystem

#: Suffixes of logs in a folder; a single file may have any suffix
LOG_SUFFIXES = (".ulg", ".tlog", ".bin", ".ulg.gz", ".ulg.zst")
# One of the names (protocols) of the local file system in fsspec
LOCAL_PROTOCOL = "local"


@dataclass(frozen=True, order=True)
class LogAddress:
    """Location of a log.

    Attributes
    ----------
    name : str
        File name.
    path_for_table : str
        Path or URL for the table of px4fuse batch.
    address : str
        Absolute path or URL.
    size_bytes : int or None
    """

    name: str
    path_for_table: str
    address: str
    size_bytes: int | None


def find_logs(patterns: Iterable[str]) -> list[LogAddress]:
    """Find logs in files, folders, globs and URLs; return each log once, sorted by name.

    Raises
    ------
    SettingsError
        A pattern matches no log, or a URL requires a package that is not installed.
    """
    logs_by_address = {
        log.address: log for pattern in patterns for log in _find_logs_matching_pattern(pattern)
    }
    if not logs_by_address:
        raise SettingsError("no logs were given. Give files, folders, globs or URLs.")
    return sorted(logs_by_address.values())


def _find_logs_matching_pattern(pattern: str) -> list[LogAddress]:
    """Return the logs that match a path, folder, glob or URL."""
    if not pattern:
        raise SettingsError("the name of a log is empty", "Give files, folders, globs or URLs.")
    file_system, root_path = _open_file_system(pattern)
    try:
        size_by_path = _find_file_sizes(file_system, root_path)
    # fsspec raises exceptions of many types, for example for an unknown account
    except Exception as error:
        raise SettingsError(
            f"{pattern}: cannot be read "
            f"({shorten_to_line(str(error), 200) or type(error).__name__})."
        ) from error
    if not size_by_path:
        raise SettingsError(
            f"{pattern}: no logs found",
            f"Give existing logs, or folders with logs ({', '.join(LOG_SUFFIXES)}).",
        )
    found_logs = []
    for path, size_bytes in size_by_path.items():
        if LOCAL_PROTOCOL in file_system.protocol:
            register_input_path(Path(path))
            address = path_for_table = path
            if not Path(pattern).is_absolute():
                path_for_table = os.path.relpath(path)
        else:
            address = path_for_table = file_system.unstrip_protocol(path)
        found_logs.append(LogAddress(_file_name(path), path_for_table, address, size_bytes))
    return found_logs


def _find_file_sizes(file_system: AbstractFileSystem, path: str) -> dict[str, int | None]:
    """Return the size of each log in a folder, of each file that matches a glob, or of a file."""
    if file_system.isdir(path):
        info_by_path = file_system.find(path, detail=True)
        info_by_path = {
            name: info_by_path[name] for name in info_by_path if name.lower().endswith(LOG_SUFFIXES)
        }
    elif file_system.exists(path):
        # A path that exists, but is no regular file, such as a device or pipe, is also returned.
        # The process that reads it reports the error
        return {path: file_system.size(path) if file_system.isfile(path) else None}
    else:
        info_by_path = file_system.glob(path, detail=True)
    # without folders: a glob may also match their names
    return {
        name: info.get("size")
        for name, info in info_by_path.items()
        if info.get("type", "file") == "file"
    }


@contextmanager
def local_file(address: str) -> Iterator[Path]:
    """Provide the local path of a log; a log at a URL is downloaded to a temporary file.

    Raises
    ------
    LogError
        The log is too large.
    SettingsError
        The URL requires a package that is not installed.
    """
    file_system, path = _open_file_system(address)
    if LOCAL_PROTOCOL in file_system.protocol:
        yield Path(path)
        return
    size_bytes, limit_bytes = file_system.info(path).get("size"), max_log_bytes.get()
    if size_bytes is not None and size_bytes > limit_bytes:
        raise LogError(
            f"the file has {size_bytes / 1e6:,.0f} MB; the limit is {limit_bytes / 1e6:,.0f} MB",
            "Increase the limit with --max-size MB.",
        )
    with TemporaryDirectory(prefix="px4fuse-") as folder:
        local_path = Path(folder, _file_name(path))
        file_system.get_file(path, str(local_path))
        yield local_path


def _open_file_system(address: str) -> tuple[AbstractFileSystem, str]:
    """Return the fsspec file system of a path or URL, and the path in this file system."""
    from fsspec.core import url_to_fs  # noqa: PLC0415 - needs the extra `batch`

    try:
        file_system, path = url_to_fs(address)
    except ImportError as error:  # only __cause__ names the missing package
        package = getattr(error.__cause__, "name", None) or "fsspec[full]"
        raise SettingsError(
            f"{address}: this type of URL requires {package}.", f'Run pip install "{package}".'
        ) from error
    except ValueError as error:  # the protocol of the URL is unknown
        raise SettingsError(
            f"{address}: {error}",
            "Give the path of a log, or a URL with a protocol that fsspec supports.",
        ) from error
    return file_system, path


def _file_name(path: str) -> str:
    """Return the file name in a path or URL; the query of a URL (after "?") is omitted."""
    return PurePosixPath(path.partition("?")[0]).name or "log"
