"""Register of the files that a command reads: nothing is written to any of them.

Files are known by device and inode, so that another path, a symbolic or hard link and other
letters on a file system that ignores case are the same file. Readers add each file that they open;
:func:`px4fuse.writing.write_all` refuses to write to one. Only the process of the command has a
register: what its workers read is added before they start.
"""

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path

from px4fuse.errors import OutputError

# Device and inode; a path on a file system without inodes
_Identity = tuple[int, int] | str


@dataclass(frozen=True)
class _Register:
    """Files and folders that are read, and the folders that contain one, at any depth."""

    read: set[_Identity] = field(default_factory=set)
    containing: dict[_Identity, Path] = field(default_factory=dict)
    entered: set[Path] = field(default_factory=set)  # folders whose parents are in `containing`


_register: ContextVar[_Register | None] = ContextVar("register", default=None)


@contextmanager
def inputs_protected() -> Iterator[None]:
    """Register what is read inside, and refuse to write to it inside."""
    before = _register.set(_Register())
    try:
        yield
    finally:
        _register.reset(before)


@contextmanager
def own_files() -> Iterator[None]:
    """Read files that px4fuse wrote and is about to update, which are not registered."""
    before = _register.set(None)
    try:
        yield
    finally:
        _register.reset(before)


def add_input(path: Path) -> None:
    """Register a file or folder; a path that does not exist is ignored."""
    register = _register.get()
    if register is None or (identity := _identity(path)) is None:
        return
    register.read.add(identity)
    for folder in {path.absolute().parent, path.resolve().parent} - register.entered:
        register.entered.add(folder)
        for above in map(_identity, (folder, *folder.parents)):
            if above is not None:
                register.containing.setdefault(above, path)


def check_outputs(targets: Iterable[Path]) -> None:
    """Refuse targets that are registered files.

    Raises
    ------
    OutputError
        A target is one of the inputs.
    """
    register = _register.get() or _Register()
    for target in targets:
        if _identity(target) in register.read:
            raise OutputError.of("output_is_input", target=target)


def check_output_folder(folder: Path) -> None:
    """Refuse a folder for outputs that contains a registered file or folder, also by a link.

    Outputs are written into the folder and its subfolders, so the entries of both are compared.

    Raises
    ------
    OutputError
        It contains one.
    """
    register = _register.get() or _Register()
    entries = _entries(folder)
    for place in (folder, *entries, *(one for entry in entries for one in _entries(entry))):
        if (identity := _identity(place)) is None:
            continue
        found = place if identity in register.read else register.containing.get(identity)
        if found is not None:
            raise OutputError.of("folder_of_inputs", folder=folder, found=found)


def _entries(folder: Path) -> list[Path]:
    return list(folder.iterdir()) if folder.is_dir() else []


def _identity(path: Path) -> _Identity | None:
    with suppress(OSError, ValueError):  # ValueError: a path that contains NUL
        status = path.stat()
        if status.st_ino:
            return status.st_dev, status.st_ino
        return os.path.normcase(path.resolve()).casefold()
    return None
