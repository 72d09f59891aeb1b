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
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import IO

from px4fuse.errors import SettingsError
from px4fuse.grading.model import Submission
from px4fuse.grading.names import distinct
from px4fuse.grading.platforms import METADATA, ExportOrigin, gradescope_metadata, origins_of
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
    LookupError,
    OverflowError,
    MemoryError,
)


@dataclass
class _Search:
    """What a search has met: PDFs by where they are, people of Gradescope, and what it says."""

    found: dict[tuple[Path, str], tuple[str, datetime | None]] = field(default_factory=dict)
    people: dict[str, ExportOrigin] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    others: Counter[str] = field(default_factory=Counter)


def collect(paths: Sequence[Path]) -> tuple[tuple[Submission, ...], tuple[str, ...]]:
    """Find the PDFs in files, folders and zip files, and who handed them in by their names.

    Parameters
    ----------
    paths : sequence of Path
        PDFs, zip files, and folders, which are searched with their subfolders. Zip files may hold
        zip files, which may not hold more. Gradescope's ``submission_metadata.yml`` is read where
        it stands beside the submissions, never inside one.

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
    search = _Search()
    for path in paths:
        for file, name in _files(path, search.notes):
            if name.lower().endswith(".pdf"):
                search.found.setdefault((file, ""), (name, None))
            elif name.lower().endswith(".zip"):
                with file.open("rb") as stream:
                    prefix = f"{name}/" if path.is_dir() else ""
                    _search_zip(stream, name, prefix, file, search)
            elif _is_metadata(name):
                with file.open("rb") as stream:
                    search.people |= _people(stream.read(MAX_BYTES))
            else:
                search.others[_kind(name)] += 1
    notes = search.notes
    if search.others:
        kinds = ", ".join(f"{count} {kind}" for kind, count in search.others.most_common(5))
        more = ", ..." if len(search.others) > 5 else ""
        notes.append(f"Passed over, since they are not PDFs: {kinds}{more}.")
    if not search.found:
        raise SettingsError(
            one_line(" ".join(["No PDF was found in what was given.", *notes]), 500)
        )
    order = sorted(
        search.found.items(), key=lambda item: (item[1][0].casefold(), item[1][0], item[0])
    )
    names = distinct(_shown(name) for _, (name, _) in order)
    exports = [(file if entry else None, name)
               for ((file, entry), _), name in zip(order, names, strict=True)]  # fmt: skip
    made = (
        Submission(*where, name, time, origin)
        for (where, (_, time)), name, origin in zip(
            order, names, origins_of(exports, search.people), strict=True
        )
    )
    return tuple(made), tuple(notes)


def read(submission: Submission) -> bytes | Refused:
    """Bytes of a submission, at most :data:`~px4fuse.verification.intake.MAX_BYTES` of them."""
    reason = "no file any more."
    try:
        if submission.file.is_file():
            with submission.file.open("rb") as file:
                stream: IO[bytes] = file
                for entry in filter(None, submission.entry.split(_INSIDE)):
                    with _archive(stream) as archive:
                        stream = io.BytesIO(_unpacked(archive, entry))
                content = stream.read(MAX_BYTES + 1)
            if len(content) > MAX_BYTES:
                raise _EntryError(_TOO_LARGE)
            return content
    except _EntryError as error:
        reason = str(error)
    except _DAMAGED as error:
        why = error.strerror if isinstance(error, OSError) and error.strerror else "damaged"
        reason = f"it cannot be read ({why})."
    return Refused(f"{one_line(submission.name, MAX_NAME)}: {reason}")


def _is_metadata(name: str) -> bool:
    *folders, last = name.split("/")
    return last == METADATA and not any(one.startswith("submission_") for one in folders)


def _people(content: bytes) -> dict[str, ExportOrigin]:
    return gradescope_metadata(content.decode("utf-8", errors="replace"))


class _EntryError(Exception):
    """Why an entry of a zip file is not read."""


class _Limited:
    """A file of which no more than a table of contents can be read in one piece."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self.seek, self.tell, self.seekable = file.seek, file.tell, file.seekable
        self.close = file.close

    def read(self, size: int = -1) -> bytes:
        if size > MAX_DIRECTORY_BYTES:
            raise zipfile.BadZipFile("table of contents too large")
        # zipfile asks for "the rest" only where it looks for the end of the archive
        return self._file.read(size if size >= 0 else MAX_DIRECTORY_BYTES)


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
        for file in sorted(each for each in files if not _hidden(each)):
            whole = Path(folder) / file
            try:
                resolved = whole.resolve(strict=True)
                # a named pipe would keep us waiting forever
                inside = resolved.is_relative_to(root) and resolved.is_file()
            except (OSError, RuntimeError):  # it leads nowhere, or in a circle
                inside = False
            if inside:
                yield resolved, whole.relative_to(root).as_posix()
            outside += not inside
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


def _search_zip(
    stream: IO[bytes],
    name: str,
    prefix: str,
    file: Path,
    search: _Search,
    outer: tuple[str, datetime | None] | None = None,
) -> None:
    """Look for PDFs in a zip file, and in the zip files in it.

    Parameters
    ----------
    prefix : str
        What names of its files begin with.
    outer : (str, datetime or None), optional
        Of a zip file in another one: its entry there, and its time. The student set the clock of
        what is in it.
    """
    shown, left = _shown(name), MAX_INNER_BYTES
    with _damage_noted(shown, search), _archive(stream) as archive:
        for entry, label in _listed(archive, shown, search.notes):
            where = entry.filename if outer is None else f"{outer[0]}{_INSIDE}{entry.filename}"
            time = _time(entry) if outer is None else outer[1]
            end, whole = label.lower()[-4:], prefix + label
            about = outer is None and _is_metadata(label)
            if end == ".pdf":
                search.found.setdefault((file, where), (whole, time))
            elif not about and end != ".zip":
                search.others[_kind(label)] += 1
            elif outer is not None:
                search.notes.append(f"{shown}: a zip file in it was passed over: too deep.")
            elif (left := left - entry.file_size) < 0:
                raise _EntryError("it holds too many zip files.")
            else:
                with _damage_noted(_shown(whole), search):
                    content = _unpacked(archive, entry.filename)
                    if about:
                        search.people |= _people(content)
                        continue
                    inside = io.BytesIO(content)
                    _search_zip(inside, whole, f"{whole}/", file, search, (where, time))


@contextmanager
def _damage_noted(shown: str, search: _Search) -> Iterator[None]:
    """Whatever is wrong with a zip file, or with an entry of it, is a note and ends no search."""
    try:
        yield
    except (_EntryError, *_DAMAGED) as error:
        why = str(error) if isinstance(error, _EntryError) else "not a zip file, or damaged."
        search.notes.append(f"{shown}: passed over: {why}")


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
    small = entry.file_size <= max(1_000_000, MAX_RATIO * entry.compress_size)
    known = entry.compress_type in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
    for wrong, why in (
        (entry.flag_bits & _ENCRYPTED, "encrypted in its zip file."),
        (stat.S_ISLNK(entry.external_attr >> 16),
         "a symbolic link in its zip file, which is not followed."),
        (not known, "packed in its zip file by a method that is not read."),
        (entry.file_size > MAX_BYTES, _TOO_LARGE),
        (not small, f"it shrinks more than {MAX_RATIO} times in its zip file: no report."),
    ):  # fmt: skip
        if wrong:
            raise _EntryError(why)
    # zipfile gives no more than the declared size
    return archive.read(entry)


def _shown(name: str) -> str:
    """A name that does nothing wherever it is shown, with its end, where the file's name is."""
    line = " ".join(cleaned(name[-10 * MAX_NAME :]).split())
    line = re.sub(r'[<>"`|]', "_", line)
    if line[:1] in set("=+-@"):  # a formula to a spreadsheet
        line = f"_{line[1:]}"
    if len(line) > MAX_NAME:
        line = f"{line[: MAX_NAME // 2]}…{line[-(MAX_NAME - MAX_NAME // 2 - 1) :]}"
    return line or "nameless"
