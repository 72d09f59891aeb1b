"""The analysis of a report once more: what was recorded, on the files that it was recorded from.

The recorded request is a stranger's. It is decoded strictly, and the analysis knows the range of
every value; files are found by their SHA-256 among those that were given, never by name; and
nothing in it names an output.
"""

from __future__ import annotations

import os
import re
import shutil
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from dataclasses import replace as replaced
from functools import partial
from pathlib import Path
from typing import Any, cast

import msgspec
from msgspec.structs import replace

from px4fuse.errors import Px4FuseError, SettingsError
from px4fuse.report.document import Document, LoopDocument
from px4fuse.request import ComparisonRequest, LoopRequest, Request, command_line
from px4fuse.results.model import MAX_NOTES_BYTES, Student
from px4fuse.verification.model import Refused

MAX_NAME_BYTES = 240
MAX_PERSON = 10_000
NOT_OURS = "the recorded request is not one that px4fuse can have made"
# What Windows does not take in a name, or takes for something else than a file
_WINDOWS = re.compile(r'[<>:"|?*]|^(?:con|prn|aux|nul|com\d|lpt\d)(?:\.|$)|[. ]$', re.IGNORECASE)
_VERSION = re.compile(r"[0-9A-Za-z.+!_-]{1,60}")


@dataclass(frozen=True)
class Recomputed:
    """What the analysis gives now.

    Attributes
    ----------
    results : dict
        As a report attaches them.
    draw : callable
        Draws the report: with the student, and with the versions, that were recorded.
    """

    results: dict[str, Any]
    draw: Callable[[], bytes]


class _RefusedError(Exception):
    """The analysis cannot be repeated; the text says why."""


def log_sha256(results: Mapping[str, Any]) -> str:
    """SHA-256 of the log that a report is about; "" where it names none."""
    part = results.get("log", results.get("track"))
    found = part.get("sha256") if isinstance(part, Mapping) else None
    return found if isinstance(found, str) else ""


def recompute(results: Mapping[str, Any], logs: Mapping[str, Path]) -> Recomputed | Refused:
    """Repeat the analysis from what a report recorded.

    Parameters
    ----------
    results : mapping
        What is attached to the report.
    logs : mapping of str to Path
        Files by their SHA-256.

    Returns
    -------
    Recomputed or Refused
        Refused where the command is not px4fuse's, a file is missing, or the analysis fails.
    """
    try:
        person = _person(results)
        versions = _versions(results)
        request = _request(results)
        with tempfile.TemporaryDirectory(prefix="px4fuse-") as folder:
            files = _Files(results, logs, Path(folder))
            if isinstance(request, LoopRequest):
                return _looped(request, files, person, versions)
            return _compared(request, files, person, versions)
    except SettingsError as error:  # no run with these settings can have made a report
        return Refused(f"{NOT_OURS}: {error}")
    except (_RefusedError, Px4FuseError) as error:
        return Refused(str(error))
    except Exception as error:  # noqa: BLE001 - settings made to fail may fail anywhere
        return Refused(f"the analysis cannot be repeated ({type(error).__name__})")


# -- what was recorded -----------------------------------------------------------------------------


def _request(results: Mapping[str, Any]) -> Request:
    """What was analysed and how, as the results record it."""
    try:
        request: Request = msgspec.convert(results.get("request"), Request)
    except msgspec.ValidationError as error:
        raise _RefusedError(f"{NOT_OURS}: {error}") from error
    return request


def _person(results: Mapping[str, Any]) -> Student:
    """Whose report it is: words to be printed, no more."""
    student = results.get("student")
    parts = [student.get(key) if isinstance(student, Mapping) else None
             for key in ("name", "id", "notes")]  # fmt: skip
    limits = (MAX_PERSON, MAX_PERSON, MAX_NOTES_BYTES)
    for part, limit in zip(parts, limits, strict=True):
        if not isinstance(part, str) or len(part) > limit:
            raise _RefusedError("the results do not say whose report it is, as px4fuse does")
        try:
            part.encode()
        except UnicodeEncodeError as error:
            raise _RefusedError("the student's words are no text") from error
    name, number, notes = cast(list[str], parts)
    return Student(name, number, notes)


def _versions(results: Mapping[str, Any]) -> dict[str, Any]:
    """Versions to print on the page that says what the report was made with."""
    from px4fuse.results.build import LIBRARIES  # noqa: PLC0415

    made = results["provenance"]
    libraries = made.get("libraries")
    if not isinstance(libraries, Mapping) or tuple(libraries) != LIBRARIES:
        raise _RefusedError("the results do not say which libraries they were made with")
    versions = [made.get("px4fuse"), made.get("python"), *libraries.values()]
    if not all(isinstance(one, str) and _VERSION.fullmatch(one) for one in versions):
        raise _RefusedError("the results name versions that are none")
    return dict(made)


# -- files -----------------------------------------------------------------------------------------


class _Files:
    """Puts the files of an analysis where it finds them, under the names that were recorded.

    Names are printed in the report. They are those of links in a folder of this run alone, and
    only where they are plain names.
    """

    def __init__(self, results: Mapping[str, Any], logs: Mapping[str, Path], folder: Path) -> None:
        self.results = results
        self.logs = logs
        self._folder = folder

    def place(self, recorded: str, sha256: object, what: str) -> Path:
        """A file with this content and the recorded name."""
        path = self.logs.get(sha256) if isinstance(sha256, str) else None
        if path is None:
            raise _RefusedError(f"none of the files given has the SHA-256 of {what}")
        name = recorded
        plain = name == Path(name).name and "\\" not in name and name.isprintable()
        if not plain or len(name.encode(errors="replace")) > MAX_NAME_BYTES:
            raise _RefusedError(f"{NOT_OURS}: a file name in it is none")
        if os.name == "nt" and _WINDOWS.search(name):
            raise _RefusedError("a recorded file name is none on Windows: verify it elsewhere")
        # each in a folder of its own: two may have one name
        folder = Path(tempfile.mkdtemp(dir=self._folder))
        target = folder / name
        try:
            target.symlink_to(path.resolve())
        except OSError:  # on Windows for administrators only
            shutil.copyfile(path, target)
        return target


def _joined(results: Mapping[str, Any], role: str) -> object:
    """SHA-256 of the recording that was joined to the log in a role."""
    log = results.get("log")
    joined = log.get("joined") if isinstance(log, Mapping) else None
    for entry in joined if isinstance(joined, list) else ():
        if isinstance(entry, Mapping) and entry.get("role") == role:
            return entry.get("sha256")
    return None


def _part(source: str) -> tuple[str, str]:
    """File and part of ``LOG:vio``, without a look at any file."""
    from px4fuse.loop.tracks import PARTS  # noqa: PLC0415

    name, colon, tail = source.rpartition(":")
    return (name, f":{tail}") if colon and tail in PARTS else (source, "")


# -- the two kinds of report -----------------------------------------------------------------------


def _compared(
    request: ComparisonRequest, files: _Files, person: Student, versions: dict[str, Any]
) -> Recomputed:
    from px4fuse.analysis import run  # noqa: PLC0415
    from px4fuse.findings import find  # noqa: PLC0415
    from px4fuse.results.build import results, to_json  # noqa: PLC0415

    recorded = request
    log = files.place(request.log, log_sha256(files.results), "the log")
    request = replace(request, log=str(log))
    if request.mavlink is not None:
        sha256 = _joined(files.results, "mavlink")
        placed = files.place(request.mavlink, sha256, "--mavlink")
        request = replace(request, mavlink=str(placed))
    if request.position is not None:
        sha256 = _joined(files.results, "position")
        placed = files.place(request.position.path, sha256, "--position")
        request = replace(request, position=replace(request.position, path=str(placed)))
    analysis = run(request)
    document = Document(analysis, find(analysis), person, command_line(recorded))
    found = results(recorded, analysis, document.findings, person, document.command)
    return Recomputed(found, partial(_drawn, document, to_json(found), versions))


def _looped(
    request: LoopRequest, files: _Files, person: Student, versions: dict[str, Any]
) -> Recomputed:
    from px4fuse.analysis import run_loop  # noqa: PLC0415
    from px4fuse.findings import find_loop  # noqa: PLC0415
    from px4fuse.results.build import loop_results, to_json  # noqa: PLC0415

    recorded = request
    path, part = _part(request.source)
    source = files.place(path, log_sha256(files.results), "the log")
    request = replace(request, source=f"{source}{part}")
    if request.reference is not None:
        path, part = _part(request.reference)
        references = files.results.get("references")
        last = references[-1] if isinstance(references, list) and references else None
        sha256 = last.get("sha256") if isinstance(last, Mapping) else None
        placed = files.place(path, sha256, "--reference")
        request = replace(request, reference=f"{placed}{part}")
    found = run_loop(request)
    document = LoopDocument(found, find_loop(found), person, command_line(recorded))
    made = loop_results(recorded, found, document.findings, person, document.command)
    return Recomputed(made, partial(_drawn, document, to_json(made), versions))


def _drawn(document: Document | LoopDocument, text: str, versions: dict[str, Any]) -> bytes:
    """Draw the report with the versions that were recorded."""
    from px4fuse.report.pdf import render  # noqa: PLC0415
    from px4fuse.report.style import text_width  # noqa: PLC0415

    made = versions | {"command": document.command}
    drawn = render(replaced(document, made=made), text)
    text_width.cache_clear()  # it holds every text of every report otherwise
    return drawn
