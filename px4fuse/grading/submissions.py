"""Submissions: PDFs in folders and in zip files of learning platforms, with student and time.

Zip files are not unpacked to disk, and names in them are never used as paths. Students choose the
names of their files, but not the beginning of the path, which the platform writes: the first match
in a path counts.

Sources of the file names:

- Moodle: ``mod/assign/feedback/file/importziplib.php`` of its repository, which reads the names:
  ``{full name}_{participant}_assignsubmission_{plugin}_``, since 4.1 without the last ``_``.
- Canvas: "How do I download all student submissions for an assignment?", Instructor Guide:
  ``{surnamefirst}[_LATE]_{user}_{submission}_{file}``.
- Blackboard Learn: "Download assignments", Instructor Help:
  ``{assignment}_{user name}_attempt_{year-month-day-hour-minute-second}_{file}``.
- Gradescope: "Exporting submissions", Help Center: ``submission_{number}``, and
  ``submission_metadata.yml`` with names, ids (``:sid:``) and times.
- ILIAS: multi-feedback of ``components/ILIAS/Exercise`` in its repository:
  ``{last}_{first}_{login}_{user}/``. The name of a late file begins with "Late Submission - " if
  the language of the instructor is English; for other languages use ``--due``.
"""

import re
import stat
import struct
import zipfile
import zlib
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import IO

from px4fuse.assignment.roster import Person, make_unique
from px4fuse.errors import ResultsError, SettingsError
from px4fuse.grading.model import UNKNOWN_SUBMITTER, ExportOrigin, Submission
from px4fuse.input_files import add_input
from px4fuse.reading import files_below
from px4fuse.record import table
from px4fuse.results.reading import clean_text, one_line
from px4fuse.verification.model import BAD_VALUES
from px4fuse.verification.pdf_input import MAX_BYTES

MAX_ENTRIES = 10_000
# bytes; zipfile reads the whole table of contents before entries can be counted
MAX_DIRECTORY_BYTES = 4_000_000
# bytes; sum of the unpacked sizes of a zip file, whose entries may overlap
MAX_TOTAL_BYTES = 4_000_000_000
# compression ratio; PDFs are compressed already and do not shrink 100 times
MAX_RATIO = 100
MAX_NAME = 200
# year of zip entries without a time
ZIP_EPOCH = 1980

_TOO_LARGE = f"larger than {MAX_BYTES // 1_000_000} MB; reports are below 2 MB."
_ENCRYPTED = 1
_UTF8 = 0x800
METADATA = "submission_metadata.yml"
# patterns of the file names, by platform
PLATFORMS = {
    name: re.compile(pattern)
    for name, pattern in table(__file__, "platforms.toml", dict[str, str]).items()
}
# parts of names that a platform writes once, and that students do not write by accident
_PLATFORM_MARKS = re.compile(r"_attempt_\d{4}-|_\d+_assignsubmission_")
TIME_IN_NAMES = "%Y-%m-%d-%H-%M-%S"
_SUBMISSION = re.compile(r"^(?:submission_)?(\d+)(?:\.pdf)?:\s*\n((?:[ -].*\n?)*)", re.MULTILINE)
_SUBMITTERS = re.compile(r"^  :submitters:\s*\n((?:  - .*\n?|    .*\n?)*)", re.MULTILINE)


class _EntryError(Exception):
    """Reason why an entry of a zip file is not read."""


_BROKEN_ZIP = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, MemoryError)
# BAD_VALUES contains RuntimeError, and with it NotImplementedError of zipfile
_UNREADABLE = (_EntryError, *_BROKEN_ZIP, *BAD_VALUES)


def _unread_reason(error: Exception) -> str:
    """Format the reason why a file could not be read, as the end of a sentence."""
    if isinstance(error, _EntryError):
        return str(error)
    why = error.strerror if isinstance(error, OSError) and error.strerror else "damaged"
    return f"it cannot be read ({why})."


def find_submissions(paths: Sequence[Path]) -> tuple[tuple[Submission, ...], tuple[str, ...]]:
    """Find the PDFs in files, folders and zip files, and their students by the file names.

    Parameters
    ----------
    paths : sequence of Path
        PDFs, folders (searched with their subfolders), and zip files exported by platforms. A zip
        file inside of a folder or zip file is a student's and not opened. Gradescope's
        ``submission_metadata.yml`` is read beside the submissions, never inside of one.

    Returns
    -------
    submissions : tuple of Submission
        Sorted by name, including unreadable PDFs: :func:`read` gives the reason.
    notes : tuple of str
        Ignored files, one sentence each.

    Raises
    ------
    SettingsError
        A path does not exist, or no PDF was found.
    """
    notes: list[str] = []
    submissions_by_place: dict[tuple[Path, str], Submission] = {}
    people: dict[str, ExportOrigin] = {}
    other_count = zip_count = 0
    for path in paths:
        export = path.is_file() and path.name.lower().endswith(".zip")
        for place in (_zip_submissions if export else _folder_submissions)(path, notes):
            add_input(place.file)
            end = place.name.lower()[-4:]
            if end in (".pdf", ".zip"):
                submissions_by_place.setdefault((place.file, place.entry), place)
                zip_count += end == ".zip"
            elif not _is_metadata(place.name):
                other_count += 1
            else:
                try:
                    text = read(place).decode("utf-8", errors="replace")
                    people |= gradescope_metadata(text)
                except ResultsError as error:
                    notes.append(str(error))
    if other_count:
        notes.append(f"Ignored files (not PDF): {other_count}.")
    if zip_count:
        notes.append(
            f"Zip files not opened: {zip_count}. Name the export of a platform on the command line."
        )
    if not submissions_by_place:
        raise SettingsError(one_line(" ".join(["No PDF found.", *notes]), 500))
    order = sorted(
        submissions_by_place.values(),
        key=lambda one: (one.name.casefold(), one.name, one.file, one.entry),
    )
    names = make_unique(_short_name(one.name) for one in order)
    named_submissions = [replace(one, name=name) for one, name in zip(order, names, strict=True)]
    return tuple(with_origins(named_submissions, people)), tuple(notes)


def with_origins(
    submissions: Sequence[Submission], people: Mapping[str, ExportOrigin]
) -> Iterator[Submission]:
    """Add student and platform to submissions.

    All files of an export are of the platform that matches most of them. A file that a student
    named like those of another platform is not assigned to it.

    Parameters
    ----------
    people : mapping
        Gradescope's metadata, by submission number.
    """
    exports = [one.file if one.entry else one.name.partition("/")[0] for one in submissions]
    platform_counts: dict[object, Counter[str]] = defaultdict(Counter)
    for export, one in zip(exports, submissions, strict=True):
        platform_counts[export].update(filter(None, [origin_of(one.name).platform]))
    for export, one in zip(exports, submissions, strict=True):
        origin = origin_of(
            one.name, [platform for platform, _ in platform_counts[export].most_common(1)]
        )
        if origin.platform in ("gradescope", ""):
            # PDF assignments are exported as 123456.pdf
            stem = one.name.rpartition("/")[2].casefold().removesuffix(".pdf")
            origin = people.get(origin.person.numbers.get("gradescope", stem), origin)
        yield replace(one, origin=origin)


def read(submission: Submission) -> bytes:
    """Bytes of a submission, at most :data:`~px4fuse.verification.pdf_input.MAX_BYTES` of them.

    Raises
    ------
    ResultsError
        The submission cannot be read.
    """
    try:
        with submission.file.open("rb") as file:
            if submission.entry:
                with _archive(file) as archive:
                    content = _read_entry(archive, submission.entry)
            else:
                content = file.read(MAX_BYTES + 1)
        if len(content) > MAX_BYTES:
            raise _EntryError(_TOO_LARGE)
    except _UNREADABLE as error:
        raise ResultsError(
            f"{one_line(submission.name, MAX_NAME)}: {_unread_reason(error)}"
        ) from error
    return content


def _is_metadata(name: str) -> bool:
    *folders, last = name.split("/")
    return last == METADATA and not any(one.startswith("submission_") for one in folders)


class _LimitedFile:
    """File that does not return more than MAX_DIRECTORY_BYTES at once."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self.seek, self.tell, self.seekable = file.seek, file.tell, file.seekable
        self.close = file.close

    def read(self, size: int = -1) -> bytes:
        if size > MAX_DIRECTORY_BYTES:
            raise zipfile.BadZipFile("table of contents too large")
        # zipfile reads without size only to find the end of the archive
        return self._file.read(size if size >= 0 else MAX_DIRECTORY_BYTES)


@contextmanager
def _archive(file: IO[bytes]) -> Iterator[zipfile.ZipFile]:
    with zipfile.ZipFile(_LimitedFile(file)) as archive:
        if len(archive.infolist()) > MAX_ENTRIES:
            raise _EntryError(f"it has more than {MAX_ENTRIES} entries.")
        yield archive


def _zip_submissions(path: Path, notes: list[str]) -> list[Submission]:
    """Return the entries of a zip file; none, and a note, if it cannot be read."""
    try:
        with path.open("rb") as file, _archive(file) as archive:
            entries = [one for one in archive.infolist() if not one.is_dir()]
        # zipfile returns at most the declared size
        if sum(one.file_size for one in entries) > MAX_TOTAL_BYTES:
            raise _EntryError(f"it unpacks to more than {MAX_TOTAL_BYTES // 10**9} GB.")
    except _UNREADABLE as error:
        notes.append(f"{_short_name(path.name)}: ignored: {_unread_reason(error)}")
        return []
    last = {one.filename: one for one in entries}
    if len(last) < len(entries):
        notes.append(
            f"{_short_name(path.name)}: {len(entries) - len(last)} entries have duplicate names; "
            "only the last entry of each name was read."
        )
    places = (
        Submission(path.resolve(), name, _entry_label(one), _entry_time(one))
        for name, one in last.items()
    )
    return [place for place in places if not any(map(_is_hidden, place.name.split("/")))]


def _folder_submissions(path: Path, notes: list[str]) -> Iterator[Submission]:
    """Yield the regular files of a folder, except hidden ones."""
    if path.is_file():
        yield Submission(path.resolve(), "", path.name)
        return
    if not path.is_dir():
        raise SettingsError(f"{one_line(str(path), MAX_NAME)} is not a file or folder.")
    root = path.resolve()
    outside = 0
    for file in files_below(root):  # symbolic links to folders are not entered
        name = file.relative_to(root)
        if any(map(_is_hidden, name.parts)):
            continue
        try:
            resolved = file.resolve(strict=True)
            # reading a named pipe would wait forever
            inside = resolved.is_relative_to(root) and resolved.is_file()
        except (OSError, RuntimeError):  # link without target, or circular
            inside = False
        if inside:
            yield Submission(resolved, "", name.as_posix())
        outside += not inside
    if outside:
        notes.append(
            f"{one_line(path.name, MAX_NAME)}: {outside} links out of the folder, special files or "
            "unreadable folders were ignored."
        )


def _is_hidden(name: str) -> bool:
    return name.startswith(".") or name == "__MACOSX"


def _entry_time(entry: zipfile.ZipInfo) -> datetime | None:
    """Return the time of a zip entry, in an unknown time zone; None if it is not valid."""
    try:
        time = datetime(*entry.date_time)
    except ValueError:
        return None
    return time if time.year > ZIP_EPOCH else None


def _entry_label(entry: zipfile.ZipInfo) -> str:
    """Return folders and name of a zip entry for messages, without '.', '..' and drives."""
    name = entry.filename
    if not entry.flag_bits & _UTF8:
        # zipfile decodes names without UTF-8 flag as code page 437; most programs write UTF-8
        try:
            name = name.encode("cp437").decode("utf-8")
        except UnicodeError:
            name = entry.filename
    path_parts = re.split(r"[/\\]", name)
    return "/".join(
        path_part
        for path_part in path_parts
        if path_part not in ("", ".", "..") and path_part[1:] != ":"
    )


def _read_entry(archive: zipfile.ZipFile, name: str) -> bytes:
    """Read an entry that is of a kind that learning platforms write."""
    entry = archive.getinfo(name)
    is_small = entry.file_size <= max(1_000_000, MAX_RATIO * entry.compress_size)
    is_known_method = entry.compress_type in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
    for has_problem, why in (
        (entry.flag_bits & _ENCRYPTED, "the zip entry is encrypted."),
        (
            stat.S_ISLNK(entry.external_attr >> 16),
            "the zip entry is a symbolic link.",
        ),
        (not is_known_method, "the compression method of the zip entry is not supported."),
        (entry.file_size > MAX_BYTES, _TOO_LARGE),
        (
            not is_small,
            f"the zip entry is compressed more than {MAX_RATIO} times, so it is not a report.",
        ),
    ):
        if has_problem:
            raise _EntryError(why)
    # zipfile returns at most the declared size
    return archive.read(entry)


def _short_name(name: str) -> str:
    """Format a name on one line; of a long name the start and the end."""
    line = " ".join(clean_text(name[-10 * MAX_NAME :]).split())
    if len(line) > MAX_NAME:
        line = f"{line[: MAX_NAME // 2]}…{line[-(MAX_NAME - MAX_NAME // 2 - 1) :]}"
    return line or "no name"


# ------------------------------------------------------------------ student and time in exports


def origin_of(name: str, platforms: Iterable[str] = tuple(PLATFORMS)) -> ExportOrigin:
    """Return the student of a file, by its path in the export.

    >>> origin_of("Doe Jane_4711_assignsubmission_file_/report.pdf").person.name
    'Doe Jane'
    >>> origin_of("doejane_LATE_12345_67890_report-1.pdf").person.numbers
    {'canvas': '12345'}
    >>> origin_of("Lab 3_jdoe_attempt_2026-11-20-12-34-56_report.pdf").time
    datetime.datetime(2026, 11, 20, 12, 34, 56)
    >>> origin_of("report.pdf") == ExportOrigin()
    True
    """
    path_parts = name.split("/")
    for index in range(len(path_parts)):
        tail = "/".join(path_parts[index:])
        for platform in platforms:
            match = PLATFORMS[platform].match(tail)
            if match is None:
                continue
            fields = {key: value or "" for key, value in match.groupdict().items()}
            stamp = fields.get("time", "")
            try:
                time = datetime.strptime(stamp, TIME_IN_NAMES) if stamp else None
            except ValueError:  # not a valid time: the student chose the name
                continue
            full_name = (
                fields.get("name") or f"{fields.get('first', '')} {fields.get('last', '')}".strip()
            )
            numbers = {platform: fields["number"]} if "number" in fields else {}
            person = Person("", full_name, "", fields.get("login", ""), numbers)
            is_imitated = len(_PLATFORM_MARKS.findall(name)) > (
                platform in ("moodle", "blackboard")
            )
            return ExportOrigin(platform, person, time, bool(fields.get("late")), is_imitated)
    return UNKNOWN_SUBMITTER


def gradescope_metadata(text: str) -> dict[str, ExportOrigin]:
    r"""Read students and times from Gradescope's ``submission_metadata.yml``, by submission number.

    Only keys at the depth of Gradescope's own are read; texts of students are deeper. The student
    of a group is its first member.

    >>> text = "submission_7:\n  :submitters:\n  - :name: Ada\n    :sid: '12'\n"
    >>> gradescope_metadata(text)["7"].person.student_id
    '12'
    """
    origins = {}
    for number, block in _SUBMISSION.findall(text.replace("\r\n", "\n")):
        people = _SUBMITTERS.search(block)
        name, student_id, email = (
            _value(people[1] if people else "", rf"  (?:- |  ):{key}")
            for key in ("name", "sid", "email")
        )
        person = Person(student_id, name, email, "", {"gradescope": number})
        origins[number] = ExportOrigin(
            "gradescope", person, _time_of(_value(block, "  :created_at"))
        )
    return origins


def _value(block: str, key: str) -> str:
    """Return the first value of a key, without quotes."""
    match = re.search(rf"^{key}: *(['\"]?)(.*)\1 *$", block, re.MULTILINE)
    return match[2] if match else ""


def _time_of(value: str) -> datetime | None:
    """Read a time of Gradescope's YAML, with its time zone.

    >>> _time_of("2026-11-20 12:34:56.123456000 Z").isoformat()
    '2026-11-20T12:34:56.123456+00:00'
    """
    try:
        time = datetime.fromisoformat(re.sub(r" (?=Z|[+-]\d)", "", value))
    except ValueError:
        return None
    return time if time.tzinfo else time.replace(tzinfo=UTC)
