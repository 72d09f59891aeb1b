"""What was handed in: PDFs in folders and in zip files as learning platforms export them.

Nothing is unpacked to disk. Names from a zip file are shown and never used as paths.
"""

from __future__ import annotations

import io
import os
import re
import stat
import struct
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import IO

from px4fuse.errors import SettingsError
from px4fuse.grading.model import Submission
from px4fuse.grading.names import distinct
from px4fuse.grading.platforms import METADATA, ExportOrigin, gradescope_metadata
from px4fuse.results.reading import cleaned, one_line
from px4fuse.verification.intake import MAX_BYTES
from px4fuse.verification.model import Refused

MAX_ENTRIES = 10_000
# Of the table of contents, which zipfile reads in one piece before it can be counted
MAX_DIRECTORY_BYTES = 4_000_000
# Of the PDFs of one zip file, unpacked one at a time, and of the zip files in it
MAX_TOTAL_BYTES = 4_000_000_000
MAX_INNER_BYTES = 500_000_000
# PDFs are compressed inside; what still shrinks a hundred times is empty
MAX_RATIO = 100
MAX_NAME = 200
# The year that stands where a program knew no time
ZIP_EPOCH = 1980

# Entry as Submission keeps it, its name for people, and when it was changed
Found = tuple[str, str, datetime | None]

_TOO_LARGE = f"larger than {MAX_BYTES // 1_000_000} MB; reports are below 2 MB."
# Between a zip file's entry and the entry of the zip file in it; no name can hold it
_INSIDE = "\0"
_ENCRYPTED = 1
_UTF8 = 0x800
_DAMAGED = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    OSError,
    EOFError,
    ValueError,
    RuntimeError,  # also NotImplementedError: what zipfile does not know
    KeyError,
    OverflowError,
)


def collect(paths: Sequence[Path]) -> tuple[tuple[Submission, ...], tuple[str, ...]]:
    """Find the PDFs in files, folders and zip files.

    Parameters
    ----------
    paths : sequence of Path
        PDFs, zip files, and folders, which are searched with their subfolders. Zip files may hold
        zip files, which may not hold more.

    Returns
    -------
    submissions : tuple of Submission
        Sorted by name. A PDF that cannot be read is among them, and :func:`read` says why.
    notes : tuple of str
        What was passed over: one sentence each.

    Raises
    ------
    SettingsError
        A path does not exist, or there is no PDF in any of them.
    """
    notes: list[str] = []
    others: Counter[str] = Counter()
    found: dict[tuple[Path, str], tuple[str, datetime | None]] = {}
    for path in paths:
        for file, name in _files(path, notes):
            if name.lower().endswith(".pdf"):
                found.setdefault((file, ""), (name, None))
            elif name.lower().endswith(".zip"):
                prefix = f"{name}/" if path.is_dir() else ""
                for entry, inner, time in _entries(partial(_outer, file), name, notes, others):
                    found.setdefault((file, entry), (prefix + inner, time))
            else:
                others[_kind(name)] += 1
    if others:
        kinds = ", ".join(f"{count} {kind}" for kind, count in others.most_common(5))
        more = ", ..." if len(others) > 5 else ""
        notes.append(f"Passed over, since they are not PDFs: {kinds}{more}.")
    if not found:
        why = f" {' '.join(notes)}" if notes else ""
        raise SettingsError(one_line(f"No PDF was found in what was given.{why}", 500))
    order = sorted(found.items(), key=lambda item: (item[1][0].casefold(), item[1][0], item[0]))
    names = distinct(_shown(name) for _, (name, _) in order)
    made = (
        Submission(*where, name, time)
        for (where, (_, time)), name in zip(order, names, strict=True)
    )
    return tuple(made), tuple(notes)


def read(submission: Submission) -> bytes | Refused:
    """Bytes of a submission, at most :data:`~px4fuse.verification.intake.MAX_BYTES` of them."""
    try:
        if not submission.file.is_file():
            return _refused(submission, "no file any more.")
        if not submission.entry:
            with submission.file.open("rb") as file:
                content = file.read(MAX_BYTES + 1)
            return content if len(content) <= MAX_BYTES else _refused(submission, _TOO_LARGE)
        outer, _, inner = submission.entry.partition(_INSIDE)
        with submission.file.open("rb") as file, _archive(file) as archive:
            content = _unpacked(archive, outer)
        if inner:
            with _archive(io.BytesIO(content)) as archive:
                content = _unpacked(archive, inner)
    except _EntryError as error:
        return _refused(submission, str(error))
    except MemoryError:
        return _refused(submission, "it takes more memory to unpack than there is.")
    except _DAMAGED as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else "damaged"
        return _refused(submission, f"it cannot be read ({reason}).")
    return content


def gradescope_people(paths: Sequence[Path]) -> tuple[dict[str, ExportOrigin], tuple[str, ...]]:
    """What Gradescope's export says of its submissions; empty where nothing came from there.

    Only the file beside the submissions is read, never one that a student handed in.

    Returns
    -------
    people : dict
        Number of a submission to who handed it in.
    notes : tuple of str
        Why such a file was not read.
    """
    found: dict[str, ExportOrigin] = {}
    notes: list[str] = []
    for path in paths:
        for file, name in _files(path, []):
            texts: list[bytes] = []
            if _is_metadata(name):
                with file.open("rb") as stream:
                    texts.append(stream.read(MAX_BYTES))
            elif name.lower().endswith(".zip"):
                try:
                    texts += _metadata_inside(file)
                except _EntryError as error:
                    notes.append(f"{_shown(name)}: who handed in is not known: {error}")
                except (MemoryError, *_DAMAGED):  # collect says so of the whole zip file
                    continue
            for text in texts:
                found |= gradescope_metadata(text.decode("utf-8", errors="replace"))
    return found, tuple(notes)


def _metadata_inside(file: Path) -> list[bytes]:
    with file.open("rb") as stream, _archive(stream) as archive:
        return [
            _unpacked(archive, entry.filename)
            for entry in archive.infolist()
            if _is_metadata(_label(entry))
        ]


def _is_metadata(name: str) -> bool:
    *folders, last = name.split("/")
    return last == METADATA and not any(one.startswith("submission_") for one in folders)


class _EntryError(Exception):
    """Why an entry of a zip file is not read."""


class _Limited:
    """A file of which no more than a table of contents can be read in one piece."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self.seek, self.tell, self.seekable = file.seek, file.tell, file.seekable

    def read(self, size: int = -1) -> bytes:
        if size > MAX_DIRECTORY_BYTES:
            raise zipfile.BadZipFile("table of contents too large")
        # zipfile asks for "the rest" only where it looks for the end of the archive
        return self._file.read(size if size >= 0 else MAX_DIRECTORY_BYTES)

    def close(self) -> None:
        self._file.close()


@contextmanager
def _archive(file: IO[bytes]) -> Iterator[zipfile.ZipFile]:
    with zipfile.ZipFile(_Limited(file)) as archive:
        if len(archive.infolist()) > MAX_ENTRIES:
            raise _EntryError(f"it has more than {MAX_ENTRIES} entries.")
        yield archive


def _files(path: Path, notes: list[str]) -> Iterator[tuple[Path, str]]:
    """Regular files with their names for people, without hidden ones."""
    if path.is_file():
        yield path.resolve(), path.name
        return
    if not path.is_dir():
        raise SettingsError(f"{one_line(str(path), MAX_NAME)}: no such file or folder.")
    root = path.resolve()
    outside = 0
    for folder, folders, files in os.walk(root):  # symbolic links to folders are not entered
        folders[:] = sorted(each for each in folders if not _hidden(each))
        outside += sum((Path(folder) / each).is_symlink() for each in folders)
        for file in sorted(files):
            whole = Path(folder) / file
            if _hidden(file):
                continue
            try:
                resolved = whole.resolve(strict=True)
            except (OSError, RuntimeError):  # it leads nowhere, or in a circle
                outside += 1
                continue
            # a named pipe would keep us waiting forever
            if not resolved.is_relative_to(root) or not resolved.is_file():
                outside += 1
                continue
            yield resolved, whole.relative_to(root).as_posix()
    if outside:
        notes.append(
            f"{one_line(path.name, MAX_NAME)}: {outside} links out of the folder or special files "
            "were not followed."
        )


def _hidden(name: str) -> bool:
    return name.startswith(".") or name == "__MACOSX"


def _kind(name: str) -> str:
    """What to call a file that is not a PDF."""
    suffix = Path(name).suffix.lower()
    return suffix if re.fullmatch(r"\.[a-z0-9]{1,8}", suffix) else "without a known suffix"


def _entries(
    opened: Callable[[], IO[bytes]],
    name: str,
    notes: list[str],
    others: Counter[str],
    is_inner: bool = False,
) -> Iterator[Found]:
    """PDFs in a zip file, and in the zip files in it, with the time of the outer entry."""
    shown = _shown(name)
    try:
        with opened() as stream, _archive(stream) as archive:
            inner_left = MAX_INNER_BYTES
            for entry, label in _listed(archive, shown, notes):
                # the student set the clock of what is in an inner zip file
                time = _time(entry)
                if label.lower().endswith(".pdf"):
                    yield entry.filename, label, time
                elif not label.lower().endswith(".zip"):
                    others[_kind(label)] += 1
                elif is_inner:
                    notes.append(f"{shown}: a zip file in it was passed over: too deep.")
                else:
                    inner_left -= entry.file_size
                    if inner_left < 0:
                        notes.append(
                            f"{shown}: it holds too many zip files; the rest of it was passed over."
                        )
                        return
                    content = partial(_inner, archive, entry.filename)
                    for inside, inner_label, _ in _entries(content, label, notes, others, True):
                        yield f"{entry.filename}{_INSIDE}{inside}", f"{label}/{inner_label}", time
    except (_EntryError, MemoryError, *_DAMAGED) as error:
        why = str(error) if isinstance(error, _EntryError) else "not a zip file, or damaged."
        notes.append(f"{shown}: passed over: {why}")


def _outer(file: Path) -> IO[bytes]:
    return file.open("rb")


def _inner(archive: zipfile.ZipFile, name: str) -> IO[bytes]:
    return io.BytesIO(_unpacked(archive, name))


def _listed(
    archive: zipfile.ZipFile, shown: str, notes: list[str]
) -> Iterator[tuple[zipfile.ZipInfo, str]]:
    """Entries of a zip file that are files and not hidden, with their names for people."""
    entries = [entry for entry in archive.infolist() if not entry.is_dir()]
    # the declared size is the most that zipfile unpacks of an entry, so a lie makes it smaller
    if sum(entry.file_size for entry in entries) > MAX_TOTAL_BYTES:
        raise _EntryError(f"it unpacks to more than {MAX_TOTAL_BYTES // 10**9} GB.")
    last = {entry.filename: entry for entry in entries}
    if len(last) < len(entries):
        notes.append(
            f"{shown}: {len(entries) - len(last)} entries have the name of another one; only the "
            "last of each name was read."
        )
    for entry in last.values():
        label = _label(entry)
        if not any(map(_hidden, label.split("/"))):
            yield entry, label


def _time(entry: zipfile.ZipInfo) -> datetime | None:
    """When an entry was changed, in the time zone of who packed it; None where that is nonsense."""
    try:
        time = datetime(*entry.date_time)
    except ValueError:
        return None
    return time if time.year > ZIP_EPOCH else None


def _label(entry: zipfile.ZipInfo) -> str:
    """Name of an entry for people: its folders and name, whatever else is in it left out."""
    name = entry.filename
    if not entry.flag_bits & _UTF8:
        # zipfile takes unmarked names for code page 437; most programs write UTF-8 unmarked
        try:
            name = name.encode("cp437").decode("utf-8")
        except UnicodeError:
            name = entry.filename
    parts = re.split(r"[/\\]", name)
    return "/".join(part for part in parts if part not in ("", ".", "..") and part[1:] != ":")


def _unpacked(archive: zipfile.ZipFile, name: str) -> bytes:
    """Content of an entry, if it is one that a learning platform would write."""
    entry = archive.getinfo(name)
    if entry.flag_bits & _ENCRYPTED:
        raise _EntryError("encrypted in its zip file.")
    if stat.S_ISLNK(entry.external_attr >> 16):
        raise _EntryError("a symbolic link in its zip file, which is not followed.")
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise _EntryError("packed in its zip file by a method that is not read.")
    if entry.file_size > MAX_BYTES:
        raise _EntryError(_TOO_LARGE)
    if entry.file_size > 1_000_000 and entry.file_size > MAX_RATIO * entry.compress_size:
        raise _EntryError(f"it shrinks more than {MAX_RATIO} times in its zip file: no report.")
    with archive.open(entry) as stream:
        content = stream.read(MAX_BYTES + 1)
    if len(content) > MAX_BYTES:
        raise _EntryError(_TOO_LARGE)
    return content


def _refused(submission: Submission, reason: str) -> Refused:
    return Refused(f"{one_line(submission.name, MAX_NAME)}: {reason}")


def _shown(name: str) -> str:
    """A name that does nothing wherever it is shown, with its end, where the file's name is."""
    line = " ".join(cleaned(name[-10 * MAX_NAME :]).split())
    line = re.sub(r'[<>"`|]', "_", line)
    if line[:1] in set("=+-@"):  # a formula to a spreadsheet
        line = f"_{line[1:]}"
    if len(line) > MAX_NAME:
        line = f"{line[: MAX_NAME // 2]}…{line[-(MAX_NAME - MAX_NAME // 2 - 1) :]}"
    return line or "nameless"
