"""Search for submitted PDFs in folders and in zip files that learning platforms export.

Zip files are not unpacked to disk, and the names in them are never used as paths.

The learning platform writes the student's name to the beginning of a path. The student chooses the
file name at its end, and could imitate there the name of another student. Therefore the first match
of a pattern identifies the student.

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
  ``{last}_{first}_{login}_{user}/``.
"""

import re
import stat
import struct
import zipfile
import zlib
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import IO

from px4fuse.core.input_files import register_input_path
from px4fuse.core.reading import list_files_recursively
from px4fuse.core.record import read_toml
from px4fuse.core.text import clean_text, join_first_names, shorten_to_line
from px4fuse.errors import ResultsError, SettingsError
from px4fuse.verification.model import BAD_VALUE_ERRORS
from px4fuse.verification.pdf_input import MAX_PDF_BYTES

from ..assignment.roster import Person, make_unique
from .model import UNKNOWN_SUBMISSION_ORIGIN, Submission, SubmissionOrigin

MAX_ZIP_ENTRIES = 10_000
# Maximum size (bytes) of the central directory of a zip file; zipfile reads it into memory
MAX_DIRECTORY_BYTES = 4_000_000
# Maximum total size (bytes) of the unpacked entries of a zip file: protection from zip bombs
MAX_UNPACKED_BYTES = 4_000_000_000
# Maximum ratio of unpacked to packed size of a zip entry; near 1 for a PDF
MAX_COMPRESSION_RATIO = 100
# Maximum length (characters) of a file name in messages
MAX_NAME_LENGTH = 200

_TOO_LARGE_REASON = f"the file is larger than {MAX_PDF_BYTES // 1_000_000} MB."
# General purpose bit flags of a zip entry (APPNOTE.TXT of PKWARE, 4.4.4)
_ENCRYPTED_FLAG = 1
_UTF8_FLAG = 0x800
# Maximum number of ignored files that a note names
MAX_LISTED_FILES = 5
GRADESCOPE_METADATA_FILE = "submission_metadata.yml"
# Pattern of the file paths in an export, by learning platform
PATH_PATTERN_BY_PLATFORM = {
    name: re.compile(pattern)
    for name, pattern in read_toml(__file__, dict[str, str], "platforms.toml").items()
}
# Text that Blackboard or Moodle adds once to a path; students may forge the text
_PLATFORM_TEXT_PATTERN = re.compile(r"_attempt_\d{4}-|_\d+_assignsubmission_")
BLACKBOARD_TIME_FORMAT = "%Y-%m-%d-%H-%M-%S"
_SUBMISSION_PATTERN = re.compile(
    r"^(?:submission_)?(\d+)(?:\.pdf)?:\s*\n((?:[ -].*\n?)*)", re.MULTILINE
)
_SUBMITTERS_PATTERN = re.compile(r"^  :submitters:\s*\n((?:  - .*\n?|    .*\n?)*)", re.MULTILINE)


class _EntryError(Exception):
    """Reason why a zip entry or file is not read."""


# Exceptions for damaged zip files and other unreadable files. For unknown compression methods,
# zipfile raises NotImplementedError, a RuntimeError
_UNREADABLE_FILE_ERRORS = (
    *(_EntryError, zipfile.BadZipFile, zlib.error, struct.error, EOFError, MemoryError),
    *BAD_VALUE_ERRORS,
)


def _format_unread_reason(error: Exception) -> str:
    if isinstance(error, _EntryError):
        return str(error)
    reason = error.strerror if isinstance(error, OSError) and error.strerror else "damaged"
    return f"the file cannot be read ({reason})."


def find_submissions(paths: Sequence[Path]) -> tuple[tuple[Submission, ...], tuple[str, ...]]:
    """Find PDFs in folders and zip files, and identify the students by the file names.

    Parameters
    ----------
    paths : sequence of Path
        PDFs, folders, and zip files exported by learning platforms.

    Returns
    -------
    submissions : tuple of Submission
        Submitted PDFs, sorted by name.
    notes : tuple of str
        Sentences about ignored files.

    Raises
    ------
    SettingsError
        A path does not exist, or no PDF was found.
    """
    notes: list[str] = []
    submission_by_path: dict[tuple[Path, str], Submission] = {}
    origin_by_submission_number: dict[str, SubmissionOrigin] = {}
    ignored_names, zip_count = list[str](), 0
    for path in paths:
        is_zip = path.is_file() and path.name.lower().endswith(".zip")
        list_files = _list_zip_submissions if is_zip else _list_folder_submissions
        for submission in list_files(path, notes):
            register_input_path(submission.file)
            name = submission.name.lower()
            if name.endswith((".pdf", ".zip")):
                # a zip file in a folder or zip file is graded as an unreadable report
                submission_by_path.setdefault((submission.file, submission.zip_entry), submission)
                zip_count += name.endswith(".zip")
            elif _is_gradescope_metadata(submission.name):
                try:
                    content = read_submission(submission).decode("utf-8", errors="replace")
                except ResultsError as error:
                    notes.append(str(error))
                else:
                    origin_by_submission_number |= read_gradescope_metadata(content)
            else:
                ignored_names.append(_shorten_name(submission.name))
    if ignored_names:
        names_text = join_first_names(ignored_names, MAX_LISTED_FILES)
        notes.append(f"Ignored files (not PDF): {len(ignored_names)} ({names_text}).")
    if zip_count:
        notes.append(
            f"Zip files not opened: {zip_count}. Name each exported zip file on the command line."
        )
    if not submission_by_path:
        raise SettingsError(shorten_to_line(" ".join(["No PDF found.", *notes]), 500))
    submissions = sorted(
        submission_by_path.values(),
        key=lambda each: (each.name.casefold(), each.name, each.file, each.zip_entry),
    )
    names = make_unique(_shorten_name(submission.name) for submission in submissions)
    named_submissions = [
        replace(submission, name=name) for submission, name in zip(submissions, names, strict=True)
    ]
    return tuple(add_submitters(named_submissions, origin_by_submission_number)), tuple(notes)


def add_submitters(
    submissions: Sequence[Submission], origin_by_submission_number: Mapping[str, SubmissionOrigin]
) -> Iterator[Submission]:
    """Add student and learning platform, found in the file names, to submissions.

    ``origin_by_submission_number`` contains students and times from the metadata of Gradescope.
    """
    # files of one export are in the same zip file, or in the same folder
    export_locations = [
        submission.file if submission.zip_entry else submission.name.partition("/")[0]
        for submission in submissions
    ]
    # one platform wrote all names of an export, but students may imitate another platform: count
    # the platforms, and then parse the names with the pattern of the most frequent platform only
    platform_counts_by_export: dict[object, Counter[str]] = defaultdict(Counter)
    for export, submission in zip(export_locations, submissions, strict=True):
        if platform := parse_submission_path(submission.name).platform:
            platform_counts_by_export[export][platform] += 1
    for export, submission in zip(export_locations, submissions, strict=True):
        most_common = platform_counts_by_export[export].most_common(1)
        origin = parse_submission_path(submission.name, [platform for platform, _ in most_common])
        if origin.platform in ("gradescope", ""):
            # Gradescope also exports PDFs as SUBMISSION_NUMBER.pdf, which no pattern matches
            stem = submission.name.rpartition("/")[2].casefold().removesuffix(".pdf")
            number = origin.person.numbers.get("gradescope", stem)
            origin = origin_by_submission_number.get(number, origin)
        yield replace(submission, origin=origin)


def read_submission(submission: Submission) -> bytes:
    """Read a submission of at most :data:`~px4fuse.verification.pdf_input.MAX_PDF_BYTES` bytes.

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
                content = file.read(MAX_PDF_BYTES + 1)
        if len(content) > MAX_PDF_BYTES:
            raise _EntryError(_TOO_LARGE_REASON)
    except _UNREADABLE_FILE_ERRORS as error:
        name = shorten_to_line(submission.name, MAX_NAME_LENGTH)
        raise ResultsError(f"{name}: {_format_unread_reason(error)}") from error
    return content


def _is_gradescope_metadata(name: str) -> bool:
    """Return True for the metadata file of Gradescope, outside the folders of students."""
    *folders, file = name.split("/")
    is_in_submission_folder = any(folder.startswith("submission_") for folder in folders)
    return file == GRADESCOPE_METADATA_FILE and not is_in_submission_folder


class _BlockLimitedFile:
    """Zip file with a limit on the size of one read, MAX_DIRECTORY_BYTES.

    zipfile reads the central directory (list of entries) at once into memory. The limit rejects a
    zip file with a huge central directory.
    """

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self.seek, self.tell, self.seekable = file.seek, file.tell, file.seekable
        self.close = file.close

    def read(self, size: int = -1) -> bytes:
        if size > MAX_DIRECTORY_BYTES:
            raise zipfile.BadZipFile("the central directory of the zip file is too large")
        # zipfile calls read() without a size only to search for the end of the archive
        return self._file.read(size if size >= 0 else MAX_DIRECTORY_BYTES)


@contextmanager
def _open_zip(file: IO[bytes]) -> Iterator[zipfile.ZipFile]:
    with zipfile.ZipFile(_BlockLimitedFile(file)) as archive:
        if len(archive.infolist()) > MAX_ZIP_ENTRIES:
            raise _EntryError(f"the zip file has more than {MAX_ZIP_ENTRIES} entries.")
        yield archive


def _list_zip_submissions(path: Path, notes: list[str]) -> list[Submission]:
    """Return the files in a zip file; for an unreadable zip file, add a note and return []."""
    try:
        with path.open("rb") as file, _open_zip(file) as archive:
            entries = [entry for entry in archive.infolist() if not entry.is_dir()]
        # the sizes are those that the zip file declares; zipfile never unpacks more than these
        if sum(entry.file_size for entry in entries) > MAX_UNPACKED_BYTES:
            raise _EntryError(
                f"the zip file unpacks to more than {MAX_UNPACKED_BYTES // 10**9} GB."
            )
    except _UNREADABLE_FILE_ERRORS as error:
        notes.append(f"{_shorten_name(path.name)} was ignored: {_format_unread_reason(error)}")
        return []
    for name, count in Counter(entry.filename for entry in entries).items():
        if count > 1:
            raise SettingsError(
                f"{_shorten_name(path.name)} contains two files with the name "
                f"{_shorten_name(name)}: a student may have added one of them.",
                "Export the submissions again.",
            )
    submissions = (
        Submission(path.resolve(), entry.filename, _make_entry_label(entry)) for entry in entries
    )
    return [each for each in submissions if not any(map(_is_hidden, each.name.split("/")))]


def _list_folder_submissions(path: Path, notes: list[str]) -> Iterator[Submission]:
    """Yield the regular files of a folder and its subfolders, except hidden files."""
    if path.is_file():
        yield Submission(path.resolve(), "", path.name)
        return
    if not path.is_dir():
        raise SettingsError(
            f"{shorten_to_line(str(path), MAX_NAME_LENGTH)} is not a file or folder."
        )
    root = path.resolve()
    ignored_entry_count = 0
    for file in list_files_recursively(root):  # symbolic links to folders are not entered
        name = file.relative_to(root)
        if any(map(_is_hidden, name.parts)):
            continue
        try:
            resolved_path = file.resolve(strict=True)
            # only regular files: reading a named pipe would wait forever
            is_inside = resolved_path.is_relative_to(root) and resolved_path.is_file()
        except (OSError, RuntimeError):  # broken or circular symbolic link
            is_inside = False
        if is_inside:
            yield Submission(resolved_path, "", name.as_posix())
        ignored_entry_count += not is_inside
    if ignored_entry_count:
        notes.append(
            f"{shorten_to_line(path.name, MAX_NAME_LENGTH)}: {ignored_entry_count} entries were "
            "ignored "
            "(links to files outside the folder, special files, unreadable folders)."
        )


def _is_hidden(name: str) -> bool:
    return name.startswith(".") or name == "__MACOSX"


def _make_entry_label(entry: zipfile.ZipInfo) -> str:
    """Return the path of a zip entry without ``.``, ``..`` and drive letters, for messages."""
    name = entry.filename
    if not entry.flag_bits & _UTF8_FLAG:
        # zipfile decodes names without UTF-8 flag as code page 437, but most programs write UTF-8
        with suppress(UnicodeError):
            name = name.encode("cp437").decode("utf-8")
    return "/".join(
        each for each in re.split(r"[/\\]", name) if each not in ("", ".", "..") and each[1:] != ":"
    )


def _read_entry(archive: zipfile.ZipFile, name: str) -> bytes:
    """Read a zip entry; reject encrypted, linked and very large entries."""
    entry = archive.getinfo(name)
    max_unpacked_bytes = max(1_000_000, MAX_COMPRESSION_RATIO * entry.compress_size)
    if entry.flag_bits & _ENCRYPTED_FLAG:
        raise _EntryError("the zip entry is encrypted.")
    if stat.S_ISLNK(entry.external_attr >> 16):
        raise _EntryError("the zip entry is a symbolic link.")
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise _EntryError("the compression method of the zip entry is not supported.")
    if entry.file_size > MAX_PDF_BYTES:
        raise _EntryError(_TOO_LARGE_REASON)
    if entry.file_size > max_unpacked_bytes:
        raise _EntryError(
            f"the zip entry unpacks to more than {MAX_COMPRESSION_RATIO} times its packed size."
        )
    return archive.read(entry)


def _shorten_name(name: str) -> str:
    """Return a file name on one line, without its middle part if it is too long."""
    short_name = " ".join(clean_text(name[-10 * MAX_NAME_LENGTH :]).split())
    if len(short_name) > MAX_NAME_LENGTH:
        half_length = MAX_NAME_LENGTH // 2
        short_name = f"{short_name[:half_length]}…{short_name[1 - half_length :]}"
    return short_name or "no name"


# ------------------------------------------------------------------ student and time in exports


def parse_submission_path(
    name: str, platforms: Iterable[str] = tuple(PATH_PATTERN_BY_PLATFORM)
) -> SubmissionOrigin:
    """Return student and submission time from a file path that a learning platform wrote.

    >>> parse_submission_path("Doe Jane_4711_assignsubmission_file_/report.pdf").person.name
    'Doe Jane'
    >>> parse_submission_path("doejane_LATE_12345_67890_report-1.pdf").person.numbers
    {'canvas': '12345'}
    >>> parse_submission_path("Lab 3_jdoe_attempt_2026-11-20-12-34-56_report.pdf").time
    datetime.datetime(2026, 11, 20, 12, 34, 56)
    >>> parse_submission_path("report.pdf") == SubmissionOrigin()
    True
    """
    for platform, match in _match_platforms(name, platforms):
        fields = match.groupdict("")
        time = None
        if time_text := fields.get("time"):
            try:
                time = datetime.strptime(time_text, BLACKBOARD_TIME_FORMAT)
            except ValueError:
                # learning platforms write only valid times, so a student chose this file name
                continue
        full_name = " ".join(filter(None, map(fields.get, ("name", "first", "last"))))
        numbers = {platform: fields["number"]} if "number" in fields else {}
        # a learning platform adds the text of _PLATFORM_TEXT_PATTERN only once, and only Moodle and
        # Blackboard add it: more matches are forged
        platform_text_count = 1 if platform in ("moodle", "blackboard") else 0
        found_text_count = len(_PLATFORM_TEXT_PATTERN.findall(name))
        return SubmissionOrigin(
            platform,
            Person("", full_name, login=fields.get("login", ""), numbers=numbers),
            time,
            is_late=bool(fields.get("late")),
            has_imitated_platform_name=found_text_count > platform_text_count,
        )
    return UNKNOWN_SUBMISSION_ORIGIN


def _match_platforms(name: str, platforms: Iterable[str]) -> Iterator[tuple[str, re.Match[str]]]:
    """Yield the learning platforms whose path pattern matches, with the match.

    The patterns are tested from the first folder of the path, then from the second one, and so on,
    and last from the file name.
    """
    while name:
        for platform in platforms:
            if match := PATH_PATTERN_BY_PLATFORM[platform].match(name):
                yield platform, match
        name = name.partition("/")[2]


def read_gradescope_metadata(text: str) -> dict[str, SubmissionOrigin]:
    r"""Read students and times from Gradescope's ``submission_metadata.yml``, by submission number.

    Keys with a larger indentation are texts of students, and are not read.

    >>> text = "submission_7:\n  :submitters:\n  - :name: Ada\n    :sid: '12'\n"
    >>> read_gradescope_metadata(text)["7"].person.student_id
    '12'
    """
    origins = {}
    for number, block in _SUBMISSION_PATTERN.findall(text.replace("\r\n", "\n")):
        submitters_match = _SUBMITTERS_PATTERN.search(block)
        name, student_id, email = (
            _read_yaml_value(submitters_match[1] if submitters_match else "", rf"  (?:- |  ):{key}")
            for key in ("name", "sid", "email")
        )
        person = Person(student_id, name, email, "", {"gradescope": number})
        time = _parse_time(_read_yaml_value(block, "  :created_at"))
        origins[number] = SubmissionOrigin("gradescope", person, time)
    return origins


def _read_yaml_value(block: str, key: str) -> str:
    """Return the value of a key in a YAML block, without quotes; "" if the key is missing."""
    match = re.search(rf"^{key}: *(['\"]?)(.*)\1 *$", block, re.MULTILINE)
    return match[2] if match else ""


def _parse_time(value: str) -> datetime | None:
    """Parse a time in Gradescope's YAML file (default time zone UTC); None for an invalid time.

    >>> _parse_time("2026-11-20 12:34:56.123456000 Z").isoformat()
    '2026-11-20T12:34:56.123456+00:00'
    """
    try:
        time = datetime.fromisoformat(re.sub(r" (?=Z|[+-]\d)", "", value))
    except ValueError:
        return None
    return time if time.tzinfo else time.replace(tzinfo=UTC)
