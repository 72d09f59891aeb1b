"""Submissions: PDFs in folders and in zip files of learning platforms, with student and time.

Zip files are not unpacked to disk, and the names in them are never used as paths. The platform
writes the beginning of a path, and students choose the rest. Therefore the first part of a path
that matches a pattern identifies the student.

Sources of the patterns:

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

# maximum number of entries of a zip file
MAX_ENTRIES = 10_000
# maximum bytes of a zip file's table of contents, which zipfile reads before entries are counted
MAX_DIRECTORY_BYTES = 4_000_000
# bytes; maximum sum of the unpacked sizes of the entries, which may refer to the same data
MAX_TOTAL_BYTES = 4_000_000_000
# maximum ratio of unpacked to packed size of an entry: a PDF is compressed already, so its ratio is
# near 1
MAX_COMPRESSION_RATIO = 100
# maximum characters of a file name in messages
MAX_NAME_LENGTH = 200
# year that zip programs write if they do not know the time of an entry
ZIP_EPOCH_YEAR = 1980

_TOO_LARGE_REASON = f"larger than {MAX_BYTES // 1_000_000} MB; reports are below 2 MB."
# general purpose bit flags of a zip entry (APPNOTE.TXT of PKWARE, 4.4.4)
_ENCRYPTED_FLAG = 1
_UTF8_FLAG = 0x800
GRADESCOPE_METADATA = "submission_metadata.yml"
# pattern of the paths in an export, by platform
PLATFORMS = {
    name: re.compile(pattern)
    for name, pattern in table(__file__, "platforms.toml", dict[str, str]).items()
}
# parts of a path that a platform writes once; a second one was written by the student
_PLATFORM_MARKS = re.compile(r"_attempt_\d{4}-|_\d+_assignsubmission_")
BLACKBOARD_TIME_FORMAT = "%Y-%m-%d-%H-%M-%S"
_SUBMISSION_BLOCK = re.compile(
    r"^(?:submission_)?(\d+)(?:\.pdf)?:\s*\n((?:[ -].*\n?)*)", re.MULTILINE
)
_SUBMITTERS_BLOCK = re.compile(r"^  :submitters:\s*\n((?:  - .*\n?|    .*\n?)*)", re.MULTILINE)


class _EntryError(Exception):
    """Reason why an entry of a zip file is not read."""


_BROKEN_ZIP_ERRORS = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, MemoryError)
# RuntimeError in BAD_VALUES includes the NotImplementedError that zipfile raises
_UNREADABLE_ERRORS = (_EntryError, *_BROKEN_ZIP_ERRORS, *BAD_VALUES)


def _unread_reason(error: Exception) -> str:
    """Format the reason why a file was not read, for a message after the file name and a colon."""
    if isinstance(error, _EntryError):
        return str(error)
    reason = error.strerror if isinstance(error, OSError) and error.strerror else "damaged"
    return f"it cannot be read ({reason})."


def find_submissions(paths: Sequence[Path]) -> tuple[tuple[Submission, ...], tuple[str, ...]]:
    """Find the PDFs in files, folders and zip files, and identify the students by the file names.

    Parameters
    ----------
    paths : sequence of Path
        PDFs, folders (searched with their subfolders), and zip files exported by platforms. A zip
        file inside a folder or a zip file was written by a student and is not opened. Gradescope's
        ``submission_metadata.yml`` is read unless it is inside a submission.

    Returns
    -------
    submissions : tuple of Submission
        Sorted by name. Unreadable PDFs are included: :func:`read` raises an error with the reason.
    notes : tuple of str
        Sentences about ignored files.

    Raises
    ------
    SettingsError
        A path does not exist, or no PDF was found.
    """
    notes: list[str] = []
    submission_by_path: dict[tuple[Path, str], Submission] = {}
    origin_by_number: dict[str, ExportOrigin] = {}
    other_count = zip_count = 0
    for path in paths:
        is_export = path.is_file() and path.name.lower().endswith(".zip")
        for submission in (_zip_submissions if is_export else _folder_submissions)(path, notes):
            add_input(submission.file)
            suffix = submission.name.lower()[-4:]
            if suffix in (".pdf", ".zip"):
                submission_by_path.setdefault((submission.file, submission.zip_entry), submission)
                zip_count += suffix == ".zip"
            elif not _is_metadata(submission.name):
                other_count += 1
            else:
                try:
                    text = read(submission).decode("utf-8", errors="replace")
                    origin_by_number |= read_gradescope_metadata(text)
                except ResultsError as error:
                    notes.append(str(error))
    if other_count:
        notes.append(f"Ignored files (not PDF): {other_count}.")
    if zip_count:
        notes.append(
            f"Zip files not opened: {zip_count}. Name the export of a platform on the command line."
        )
    if not submission_by_path:
        raise SettingsError(one_line(" ".join(["No PDF found.", *notes]), 500))
    ordered = sorted(
        submission_by_path.values(),
        key=lambda submission: (
            submission.name.casefold(),
            submission.name,
            submission.file,
            submission.zip_entry,
        ),
    )
    names = make_unique(_short_name(submission.name) for submission in ordered)
    named_submissions = [
        replace(submission, name=name) for submission, name in zip(ordered, names, strict=True)
    ]
    return tuple(add_origins(named_submissions, origin_by_number)), tuple(notes)


def add_origins(
    submissions: Sequence[Submission], origin_by_number: Mapping[str, ExportOrigin]
) -> Iterator[Submission]:
    """Add student and platform to submissions.

    All files of an export (zip file or top-level folder) are from the platform whose pattern
    matches most of them. So a student cannot change the platform by imitating its file names.

    Parameters
    ----------
    origin_by_number : mapping
        Students and times of Gradescope, by submission number.
    """
    exports = [
        submission.file if submission.zip_entry else submission.name.partition("/")[0]
        for submission in submissions
    ]
    platform_counts: dict[object, Counter[str]] = defaultdict(Counter)
    for export, submission in zip(exports, submissions, strict=True):
        platform_counts[export].update(filter(None, [parse_origin(submission.name).platform]))
    for export, submission in zip(exports, submissions, strict=True):
        origin = parse_origin(
            submission.name, [platform for platform, _ in platform_counts[export].most_common(1)]
        )
        if origin.platform in ("gradescope", ""):
            # PDF assignments are exported as 123456.pdf
            stem = submission.name.rpartition("/")[2].casefold().removesuffix(".pdf")
            origin = origin_by_number.get(origin.person.numbers.get("gradescope", stem), origin)
        yield replace(submission, origin=origin)


def read(submission: Submission) -> bytes:
    """Read a submission of at most :data:`~px4fuse.verification.pdf_input.MAX_BYTES` bytes.

    Raises
    ------
    ResultsError
        The submission cannot be read.
    """
    try:
        with submission.file.open("rb") as file:
            if submission.zip_entry:
                with _open_zip(file) as archive:
                    content = _read_entry(archive, submission.zip_entry)
            else:
                content = file.read(MAX_BYTES + 1)
        if len(content) > MAX_BYTES:
            raise _EntryError(_TOO_LARGE_REASON)
    except _UNREADABLE_ERRORS as error:
        raise ResultsError(
            f"{one_line(submission.name, MAX_NAME_LENGTH)}: {_unread_reason(error)}"
        ) from error
    return content


def _is_metadata(name: str) -> bool:
    *folders, last = name.split("/")
    return last == GRADESCOPE_METADATA and not any(
        folder.startswith("submission_") for folder in folders
    )


class _LimitedFile:
    """File whose ``read`` returns at most MAX_DIRECTORY_BYTES."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self.seek, self.tell, self.seekable = file.seek, file.tell, file.seekable
        self.close = file.close

    def read(self, size: int = -1) -> bytes:
        if size > MAX_DIRECTORY_BYTES:
            raise zipfile.BadZipFile("table of contents too large")
        # zipfile calls read() without a size only to find the end of the archive
        return self._file.read(size if size >= 0 else MAX_DIRECTORY_BYTES)


@contextmanager
def _open_zip(file: IO[bytes]) -> Iterator[zipfile.ZipFile]:
    with zipfile.ZipFile(_LimitedFile(file)) as archive:
        if len(archive.infolist()) > MAX_ENTRIES:
            raise _EntryError(f"it has more than {MAX_ENTRIES} entries.")
        yield archive


def _zip_submissions(path: Path, notes: list[str]) -> list[Submission]:
    """Return the files in a zip file; if it cannot be read, return none and add a note."""
    try:
        with path.open("rb") as file, _open_zip(file) as archive:
            entries = [entry for entry in archive.infolist() if not entry.is_dir()]
        # the declared sizes are reliable limits: zipfile never returns more than the declared size
        if sum(entry.file_size for entry in entries) > MAX_TOTAL_BYTES:
            raise _EntryError(f"it unpacks to more than {MAX_TOTAL_BYTES // 10**9} GB.")
    except _UNREADABLE_ERRORS as error:
        notes.append(f"{_short_name(path.name)}: ignored: {_unread_reason(error)}")
        return []
    last_by_name = {entry.filename: entry for entry in entries}
    if len(last_by_name) < len(entries):
        duplicate_count = len(entries) - len(last_by_name)
        notes.append(
            f"{_short_name(path.name)}: {duplicate_count} entries have duplicate names; "
            "only the last entry of each name was read."
        )
    submissions = (
        Submission(path.resolve(), name, _entry_label(entry), _entry_time(entry))
        for name, entry in last_by_name.items()
    )
    return [
        submission
        for submission in submissions
        if not any(map(_is_hidden, submission.name.split("/")))
    ]


def _folder_submissions(path: Path, notes: list[str]) -> Iterator[Submission]:
    """Yield the regular files of a folder, except hidden ones."""
    if path.is_file():
        yield Submission(path.resolve(), "", path.name)
        return
    if not path.is_dir():
        raise SettingsError(f"{one_line(str(path), MAX_NAME_LENGTH)} is not a file or folder.")
    root = path.resolve()
    outside_count = 0
    for file in files_below(root):  # symbolic links to folders are not entered
        name = file.relative_to(root)
        if any(map(_is_hidden, name.parts)):
            continue
        try:
            resolved = file.resolve(strict=True)
            # reading a named pipe would wait forever
            is_inside = resolved.is_relative_to(root) and resolved.is_file()
        except (OSError, RuntimeError):  # link without target, or circular
            is_inside = False
        if is_inside:
            yield Submission(resolved, "", name.as_posix())
        outside_count += not is_inside
    if outside_count:
        notes.append(
            f"{one_line(path.name, MAX_NAME_LENGTH)}: {outside_count} links out of the folder, "
            "special files or unreadable folders were ignored."
        )


def _is_hidden(name: str) -> bool:
    return name.startswith(".") or name == "__MACOSX"


def _entry_time(entry: zipfile.ZipInfo) -> datetime | None:
    """Return the time of a zip entry, in an unknown time zone; None without a valid time."""
    try:
        time = datetime(*entry.date_time)
    except ValueError:
        return None
    return time if time.year > ZIP_EPOCH_YEAR else None


def _entry_label(entry: zipfile.ZipInfo) -> str:
    """Return the path of a zip entry for messages, without '.', '..' and drive letters."""
    name = entry.filename
    if not entry.flag_bits & _UTF8_FLAG:
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
    """Read an entry of a zip file; refuse kinds of entries that learning platforms do not write."""
    entry = archive.getinfo(name)
    is_small = entry.file_size <= max(1_000_000, MAX_COMPRESSION_RATIO * entry.compress_size)
    is_known_method = entry.compress_type in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
    for has_problem, reason in (
        (entry.flag_bits & _ENCRYPTED_FLAG, "the zip entry is encrypted."),
        (
            stat.S_ISLNK(entry.external_attr >> 16),
            "the zip entry is a symbolic link.",
        ),
        (not is_known_method, "the compression method of the zip entry is not supported."),
        (entry.file_size > MAX_BYTES, _TOO_LARGE_REASON),
        (
            not is_small,
            f"the zip entry is compressed more than {MAX_COMPRESSION_RATIO} times, unlike reports.",
        ),
    ):
        if has_problem:
            raise _EntryError(reason)
    # zipfile returns at most the declared size
    return archive.read(entry)


def _short_name(name: str) -> str:
    """Format a name on one line; shorten a long name in the middle."""
    line = " ".join(clean_text(name[-10 * MAX_NAME_LENGTH :]).split())
    if len(line) > MAX_NAME_LENGTH:
        head_length = MAX_NAME_LENGTH // 2
        line = f"{line[:head_length]}…{line[head_length + 1 - MAX_NAME_LENGTH :]}"
    return line or "no name"


# ------------------------------------------------------------------ student and time in exports


def parse_origin(name: str, platforms: Iterable[str] = tuple(PLATFORMS)) -> ExportOrigin:
    """Return student and time of a file, from its path in the export.

    >>> parse_origin("Doe Jane_4711_assignsubmission_file_/report.pdf").person.name
    'Doe Jane'
    >>> parse_origin("doejane_LATE_12345_67890_report-1.pdf").person.numbers
    {'canvas': '12345'}
    >>> parse_origin("Lab 3_jdoe_attempt_2026-11-20-12-34-56_report.pdf").time
    datetime.datetime(2026, 11, 20, 12, 34, 56)
    >>> parse_origin("report.pdf") == ExportOrigin()
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
            time_text = fields.get("time", "")
            try:
                time = datetime.strptime(time_text, BLACKBOARD_TIME_FORMAT) if time_text else None
            except ValueError:  # a platform writes valid times, so a student wrote this name
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


def read_gradescope_metadata(text: str) -> dict[str, ExportOrigin]:
    r"""Read students and times from Gradescope's ``submission_metadata.yml``, by submission number.

    Only keys at the indentation of Gradescope's own keys are read; texts of students are indented
    further. A group submission belongs to its first member.

    >>> text = "submission_7:\n  :submitters:\n  - :name: Ada\n    :sid: '12'\n"
    >>> read_gradescope_metadata(text)["7"].person.student_id
    '12'
    """
    origins = {}
    for number, block in _SUBMISSION_BLOCK.findall(text.replace("\r\n", "\n")):
        submitters = _SUBMITTERS_BLOCK.search(block)
        name, student_id, email = (
            _yaml_value(submitters[1] if submitters else "", rf"  (?:- |  ):{key}")
            for key in ("name", "sid", "email")
        )
        person = Person(student_id, name, email, "", {"gradescope": number})
        origins[number] = ExportOrigin(
            "gradescope", person, _parse_time(_yaml_value(block, "  :created_at"))
        )
    return origins


def _yaml_value(block: str, key: str) -> str:
    """Return the value at the first occurrence of a key, without quotes."""
    match = re.search(rf"^{key}: *(['\"]?)(.*)\1 *$", block, re.MULTILINE)
    return match[2] if match else ""


def _parse_time(value: str) -> datetime | None:
    """Parse a time in Gradescope's YAML; UTC if it has no time zone. None if it is not valid.

    >>> _parse_time("2026-11-20 12:34:56.123456000 Z").isoformat()
    '2026-11-20T12:34:56.123456+00:00'
    """
    try:
        time = datetime.fromisoformat(re.sub(r" (?=Z|[+-]\d)", "", value))
    except ValueError:
        return None
    return time if time.tzinfo else time.replace(tzinfo=UTC)
