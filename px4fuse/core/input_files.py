"""Protection of input files from being overwritten by outputs of the same command.

Files are compared by device and inode, because different paths may lead to one file.
"""

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path

from px4fuse.errors import OutputError

# Device and inode of a file, or its path on a file system without inodes
_FileIdentity = tuple[int, int] | str


# Input files and folders of the running command
_input_path_by_file_id: ContextVar[dict[_FileIdentity | None, Path] | None] = ContextVar(
    "input_path_by_file_id", default=None
)


@contextmanager
def protect_inputs(*, is_active: bool = True) -> Iterator[None]:
    """Register all files that are read in this context, so that no output overwrites them.

    If ``is_active`` is False, outputs may overwrite files that are read in this context.
    """
    context_token = _input_path_by_file_id.set({} if is_active else None)
    try:
        yield
    finally:
        _input_path_by_file_id.reset(context_token)


def register_input_path(path: Path) -> None:
    """Register an input file or folder, so that no output overwrites it."""
    input_path_by_file_id = _input_path_by_file_id.get()
    if input_path_by_file_id is not None and (identity := _read_file_identity(path)) is not None:
        input_path_by_file_id.setdefault(identity, path)


def check_outputs(output_paths: Iterable[Path]) -> None:
    """Raise an OutputError if an output path is an input file or folder of this command."""
    input_path_by_file_id = _input_path_by_file_id.get() or {}
    for output_path in output_paths:
        if _read_file_identity(output_path) in input_path_by_file_id:
            raise OutputError(
                f"{output_path} is an input of this command and was not overwritten. Choose "
                "another output name."
            )


def check_output_folder(folder: Path) -> None:
    """Raise an OutputError if the output folder is a file, or contains an input file.

    Links in the folder and its subfolders may also lead to an input, or to a folder with an input.
    """
    if folder.exists() and not folder.is_dir():
        raise OutputError(
            f"{folder} is a file, but the output needs a folder. Choose another name."
        )
    input_path_by_file_id = {
        _read_file_identity(protected_path): path
        for path in (_input_path_by_file_id.get() or {}).values()
        # The parents of a link, and the parents of the file to which it leads
        for protected_path in (path, *path.absolute().parents, *path.resolve().parents)
    }
    input_path_by_file_id.pop(None, None)  # None is the key of folders that no longer exist
    entries = _list_folder(folder)
    for path in (folder, *entries, *(child for entry in entries for child in _list_folder(entry))):
        input_path = input_path_by_file_id.get(_read_file_identity(path))
        if input_path is not None:
            raise OutputError(
                f"the output folder {folder} contains {input_path}, an input of this command",
                "Choose another output folder.",
            )


def _list_folder(folder: Path) -> list[Path]:
    return list(folder.iterdir()) if folder.is_dir() else []


def _read_file_identity(path: Path) -> _FileIdentity | None:
    """Return a value that is equal for all paths to one file; None if stat() fails on the path."""
    with suppress(OSError, ValueError):  # ValueError: a path that contains NUL
        status = path.stat()
        if status.st_ino:
            return status.st_dev, status.st_ino
        return os.path.normcase(path.resolve()).casefold()
    return None
