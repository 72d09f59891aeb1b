"""Protection of input files from being overwritten by outputs of the same command.

Files are compared by device and inode, because different paths may lead to one file.
"""

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path

from px4fuse.errors import OutputError

# Device and inode of a file, or its path on a file system without inodes
_FileIdentity = tuple[int, int] | str


@dataclass(eq=False)  # mutable, because input files are added later
class _InputRegister:
    """Input files and folders of the running command."""

    inputs: set[_FileIdentity] = field(default_factory=set)
    # first registered input file in each folder
    first_input_by_folder: dict[_FileIdentity, Path] = field(default_factory=dict)
    registered_folders: set[Path] = field(default_factory=set)


_input_register: ContextVar[_InputRegister | None] = ContextVar("register", default=None)


@contextmanager
def protect_inputs() -> Iterator[None]:
    """Register all files that are read in this context, so that no output overwrites them."""
    context_token = _input_register.set(_InputRegister())
    try:
        yield
    finally:
        _input_register.reset(context_token)


@contextmanager
def suspend_input_registration() -> Iterator[None]:
    """Allow outputs to overwrite files that are read in this context."""
    context_token = _input_register.set(None)
    try:
        yield
    finally:
        _input_register.reset(context_token)


def add_input(path: Path) -> None:
    """Register an input file or folder, so that no output overwrites it."""
    input_register = _input_register.get()
    if input_register is None or (identity := _read_file_identity(path)) is None:
        return
    input_register.inputs.add(identity)
    for folder in {
        path.absolute().parent,
        path.resolve().parent,
    } - input_register.registered_folders:
        input_register.registered_folders.add(folder)
        for parent in map(_read_file_identity, (folder, *folder.parents)):
            if parent is not None:
                input_register.first_input_by_folder.setdefault(parent, path)


def check_outputs(output_paths: Iterable[Path]) -> None:
    """Raise an OutputError if an output path is an input file or folder of this command."""
    input_register = _input_register.get() or _InputRegister()
    for output_path in output_paths:
        if _read_file_identity(output_path) in input_register.inputs:
            raise OutputError(
                f"{output_path} is an input of this command and was not overwritten. Choose "
                "another output name."
            )


def check_output_folder(folder: Path) -> None:
    """Raise an OutputError if the output folder is a file, or contains an input file."""
    if folder.exists() and not folder.is_dir():
        raise OutputError(
            f"{folder} is a file, but the output needs a folder. Choose another name."
        )
    input_register = _input_register.get() or _InputRegister()
    folder_entries = _list_folder(folder)
    for path in (
        folder,
        *folder_entries,
        *(child for entry in folder_entries for child in _list_folder(entry)),
    ):
        if (identity := _read_file_identity(path)) is None:
            continue
        input_path = (
            path
            if identity in input_register.inputs
            else input_register.first_input_by_folder.get(identity)
        )
        if input_path is not None:
            raise OutputError(
                f"the output folder {folder} contains {input_path}, an input of this command",
                "Choose another output folder.",
            )


def _list_folder(folder: Path) -> list[Path]:
    return list(folder.iterdir()) if folder.is_dir() else []


def _read_file_identity(path: Path) -> _FileIdentity | None:
    with suppress(OSError, ValueError):  # ValueError: a path that contains NUL
        status = path.stat()
        if status.st_ino:
            return status.st_dev, status.st_ino
        return os.path.normcase(path.resolve()).casefold()
    return None
