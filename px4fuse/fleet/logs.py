"""The logs of a fleet, wherever they lie: files, folders, globs, and URLs that fsspec knows."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from px4fuse.errors import LogError, SettingsError
from px4fuse.input_files import add_input
from px4fuse.reading import max_log_bytes
from px4fuse.results.reading import one_line

if TYPE_CHECKING:
    from fsspec import AbstractFileSystem

#: What is taken from a folder; a file that is named itself may be called anything
SUFFIXES = (".ulg", ".tlog", ".bin")


@dataclass(frozen=True, order=True)
class FoundLog:
    """A log before it is read.

    Attributes
    ----------
    name : str
        Without its folder.
    log : str
        As a person gave it.
    address : str
        Absolute path or URL, as a worker opens it.
    size_bytes : int or None
        None where the file system does not say.
    """

    name: str
    log: str
    address: str
    size_bytes: int | None


def find_logs(patterns: Iterable[str]) -> list[FoundLog]:
    """Logs by what a person gave, each once, in the order of their names.

    Parameters
    ----------
    patterns : iterable of str
        Files, folders (all logs in them, by their suffixes), globs and URLs.

    Raises
    ------
    SettingsError
        There is no log in one of them, or a package is missing that its kind of URL requires.
    """
    logs_by_address = {log.address: log for pattern in patterns for log in _logs_in(pattern)}
    if not logs_by_address:
        raise SettingsError("no logs: give files, folders, globs or URLs.")
    return sorted(logs_by_address.values())


def _logs_in(pattern: str) -> list[FoundLog]:
    if not pattern:
        raise SettingsError("the name of a log is empty", "Give files, folders or URLs.")
    files, root = _file_system(pattern)
    try:
        if files.isdir(root):
            all_files = files.find(root, detail=True)
            infos = {
                path: info
                for path, info in all_files.items()
                if PurePosixPath(path).suffix.lower() in SUFFIXES
            }
        elif files.exists(root):  # of a device or pipe its worker says that it is none
            infos = {root: files.info(root) if files.isfile(root) else {}}
        else:
            all_files = (
                files.glob(root, detail=True) if any(sign in pattern for sign in "*?[") else {}
            )
            infos = {path: info for path, info in all_files.items() if info["type"] == "file"}
    # OSError, and what the package of each kind of URL defines: no account, no such bucket
    except Exception as error:
        raise SettingsError(
            f"{pattern}: cannot be read ({one_line(str(error), 200) or type(error).__name__})."
        ) from error
    if not infos:
        raise SettingsError.of("no_logs", given=pattern, suffixes=", ".join(SUFFIXES))
    found_logs = []
    for path, info in infos.items():
        address = path if _is_local(files) else files.unstrip_protocol(path)
        is_relative = _is_local(files) and not Path(pattern).is_absolute()
        log = os.path.relpath(path) if is_relative else address
        found_logs.append(FoundLog(_name(path), log, address, info.get("size")))
        if _is_local(files):
            add_input(Path(path))
    return found_logs


@contextmanager
def local_file(address: str) -> Iterator[Path]:
    """A log as a file of this computer; what is fetched for it is deleted afterwards.

    Parameters
    ----------
    address : str
        Absolute path or URL.

    Raises
    ------
    LogError
        It is too large.
    SettingsError
        A package is missing that its kind of URL requires.
    """
    files, path = _file_system(address)
    if _is_local(files):
        yield Path(path)
        return
    size, limit = files.info(path).get("size"), max_log_bytes.get()
    if size is not None and size > limit:
        raise LogError.of("log_large", size_mb=size / 1000000.0, limit_mb=limit / 1000000.0)
    with TemporaryDirectory(prefix="px4fuse-") as folder:
        local = Path(folder, _name(path))
        files.get_file(path, str(local))
        yield local


def _file_system(address: str) -> tuple[AbstractFileSystem, str]:
    from fsspec.core import url_to_fs  # noqa: PLC0415 - of the extra `batch`

    try:
        files, path = url_to_fs(address)
    except ImportError as error:  # its cause names the module, which is the package's name
        package = getattr(error.__cause__, "name", None) or "the package that it names"
        raise SettingsError.of("no_package_of_url", address=address, package=package) from error
    except ValueError as error:  # of a protocol that nobody knows
        raise SettingsError(f"{address}: {error}", "Give a path or another URL.") from error
    return files, path


def _is_local(files: AbstractFileSystem) -> bool:
    from fsspec.implementations.local import LocalFileSystem  # noqa: PLC0415

    return isinstance(files, LocalFileSystem)


def _name(path: str) -> str:
    """Without its folder, and without what a URL asks for."""
    return PurePosixPath(path.partition("?")[0]).name or "log"
