"""The analysis of a report once more: what was recorded, on the files that it was recorded from.

The recorded command is a stranger's text. It goes through the command's own parser, which knows
the range of every value; files are found by their SHA-256 among those that were given, never by
name; and nothing that names an output is accepted.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import click
from click.core import ParameterSource

from px4fuse.cli.inputs import MAX_NOTES_BYTES, NOT_RECORDED, command_line, run_comparison
from px4fuse.errors import Px4FuseError, SettingsError
from px4fuse.grading.model import Refused
from px4fuse.report.document import Document, LoopDocument, Student

MAX_COMMAND = 20_000
MAX_NAME_BYTES = 240
MAX_PERSON = 10_000
MAX_CLOSURES_BYTES = 1_000_000
NOT_OURS = "the recorded command is not one of px4fuse's"
COMMANDS = ("compare", "loop")
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
        name, context = _parsed(results)
        with tempfile.TemporaryDirectory(prefix="px4fuse-") as folder, context:
            files = _Files(results, logs, Path(folder))
            again = _compared if name == "compare" else _looped
            return again(context, files, person, versions)
    except SettingsError as error:  # no run with these settings can have made a report
        return Refused(f"{NOT_OURS}: {error}")
    except (_RefusedError, Px4FuseError) as error:
        return Refused(str(error))
    except Exception as error:  # noqa: BLE001 - settings made to fail may fail anywhere
        return Refused(f"the analysis cannot be repeated ({type(error).__name__})")


# -- what was recorded -----------------------------------------------------------------------------


def _parsed(results: Mapping[str, Any]) -> tuple[str, click.Context]:
    """The recorded command, through its own parser."""
    made = results.get("provenance")
    recorded = made.get("command") if isinstance(made, Mapping) else None
    if not isinstance(recorded, str) or len(recorded) > MAX_COMMAND:
        raise _RefusedError(NOT_OURS)
    try:
        words = shlex.split(recorded)
    except ValueError as error:
        raise _RefusedError(NOT_OURS) from error
    # help would be printed at once
    if len(words) < 3 or words[0] != "px4fuse" or {"--help", "-h"} & set(words):
        raise _RefusedError(NOT_OURS)
    name, file, options = words[1], words[2], words[3:]
    if name not in COMMANDS:
        raise _RefusedError(NOT_OURS)
    try:
        context = _command(name).make_context(name, [*options, "--", file])
    except (click.ClickException, click.exceptions.Exit, click.Abort, ValueError) as error:
        raise _RefusedError(NOT_OURS) from error
    for parameter in NOT_RECORDED:
        if context.get_parameter_source(parameter) == ParameterSource.COMMANDLINE:
            raise _RefusedError(NOT_OURS)
    return name, context


def _command(name: str) -> click.Command:
    from px4fuse.cli.compare import compare  # noqa: PLC0415 - they import this package
    from px4fuse.cli.loop import loop  # noqa: PLC0415

    return compare if name == "compare" else loop


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

    def place(self, recorded: Path, sha256: object, what: str) -> Path:
        """A file with this content and the recorded name."""
        path = self.logs.get(sha256) if isinstance(sha256, str) else None
        if path is None:
            raise _RefusedError(f"none of the files given has the SHA-256 of {what}")
        return self.link(recorded, path)

    def link(self, recorded: Path, path: Path) -> Path:
        """A given file under the recorded name."""
        name = str(recorded)
        plain = name == recorded.name and "\\" not in name and name.isprintable()
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


def _part(argument: Path) -> tuple[Path, str]:
    """File and part of ``LOG:vio``, without a look at any file."""
    from px4fuse.loop.tracks import PARTS  # noqa: PLC0415

    name, colon, tail = str(argument).rpartition(":")
    return (Path(name), f":{tail}") if colon and tail in PARTS else (argument, "")


# -- the two commands ------------------------------------------------------------------------------


def _compared(
    context: click.Context, files: _Files, person: Student, versions: dict[str, Any]
) -> Recomputed:
    from px4fuse.analysis import explain  # noqa: PLC0415
    from px4fuse.findings import find  # noqa: PLC0415
    from px4fuse.results.build import results, to_json  # noqa: PLC0415

    given = {name: value for name, value in context.params.items() if name not in NOT_RECORDED}
    recorded = given.pop("log")
    log = files.place(recorded, log_sha256(files.results), "the log")
    for option in ("mavlink", "position"):
        if given[option] is not None:
            sha256 = _joined(files.results, option)
            given[option] = files.place(given[option], sha256, f"--{option}")
    compared = explain(run_comparison(log, lambda _: None, **given))
    document = Document(compared, find(compared), person, command_line("compare", recorded))
    found = results(document)
    return Recomputed(found, partial(_drawn, document, to_json(found), versions))


def _looped(
    context: click.Context, files: _Files, person: Student, versions: dict[str, Any]
) -> Recomputed:
    from px4fuse.cli.loop import run_loop  # noqa: PLC0415
    from px4fuse.findings import find_loop  # noqa: PLC0415
    from px4fuse.results.build import loop_results, to_json  # noqa: PLC0415

    given = {name: value for name, value in context.params.items() if name not in NOT_RECORDED}
    recorded = given.pop("source")
    path, part = _part(recorded)
    source = files.place(path, log_sha256(files.results), "the log")
    if given["reference"] is not None:
        path, its_part = _part(given["reference"])
        references = files.results.get("references")
        last = references[-1] if isinstance(references, list) and references else None
        sha256 = last.get("sha256") if isinstance(last, Mapping) else None
        placed = files.place(path, sha256, "--reference")
        given["reference"] = Path(f"{placed}{its_part}")
    if given["closures"] is not None:
        given["closures"] = _closures(given["closures"], files)
    found = run_loop(Path(f"{source}{part}"), lambda _: None, **given)
    findings = find_loop(found)
    command = command_line("loop", recorded)
    made = loop_results(found, findings, person, command)
    document = LoopDocument(found, findings, person, command)
    return Recomputed(made, partial(_drawn, document, to_json(made), versions))


def _closures(recorded: Path, files: _Files) -> Path:
    """The file of closures, whose SHA-256 is not recorded: one whose closures were all used.

    Whether it was this one the results show, which list every closure.
    """
    from px4fuse.readers.closures import read_closures  # noqa: PLC0415

    loop = files.results.get("loop")
    used = loop.get("closures") if isinstance(loop, Mapping) else None
    # apart, as the times themselves may count from the first pose
    apart = [
        one["time_2_s"] - one["time_1_s"]
        for one in (used if isinstance(used, list) else ())
        if isinstance(one, Mapping)
    ]
    for path in files.logs.values():
        if path.stat().st_size > MAX_CLOSURES_BYTES:
            continue
        try:
            found = read_closures(path)
        except Px4FuseError:
            continue
        times = [one.time_2_s - one.time_1_s for one in found]
        if all(any(abs(time - used_s) < 1e-3 for used_s in apart) for time in times):
            return files.link(recorded, path)
    raise _RefusedError("none of the files given holds the closures of --closures")


def _drawn(document: Document | LoopDocument, text: str, versions: dict[str, Any]) -> bytes:
    """Draw the report with the versions that were recorded."""
    from px4fuse.report.pdf import render  # noqa: PLC0415
    from px4fuse.report.style import text_width  # noqa: PLC0415

    made = versions | {"command": document.command}
    drawn = render(replace(document, made=made), text)
    text_width.cache_clear()  # it holds every text of every report otherwise
    return drawn
