"""The autograder that Gradescope runs: written here, run there.

After "Autograder Specifications" of gradescope-autograders.readthedocs.io: ``setup.sh`` is run once
to build the container, ``run_autograder`` for every submission; the zip file's content stands in
``/autograder/source``, what was handed in in ``/autograder/submission``, about it in
``/autograder/submission_metadata.json`` ("Submission Metadata"), and
``/autograder/results/results.json`` is what counts.
"""

import io
import json
import platform
import re
import tempfile
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import datetime
from importlib import metadata
from pathlib import Path
from string import Template
from typing import Any

import msgspec

from px4fuse.assignment.key import key_text, read_key
from px4fuse.assignment.roster import Person
from px4fuse.errors import SettingsError
from px4fuse.grading.entries import Course, LateRule
from px4fuse.grading.grade import grade_all
from px4fuse.grading.model import NOBODY, Entry, ExportOrigin
from px4fuse.grading.outputs import returned_text
from px4fuse.grading.rubric import read_rubric, rubric_text
from px4fuse.grading.submissions import collect
from px4fuse.reading import files_by_sha256, read_log_bytes, read_text
from px4fuse.results.reading import cleaned, one_line
from px4fuse.writing import write_all

SCRIPTS = {"setup.sh": "setup.sh", "run_autograder": "run_autograder.sh"}
VISIBLE = "after_due_date"
MAX_METADATA = 5_000_000


def results(entry: Entry, text: str) -> dict[str, Any]:
    """``results.json`` of one student, who reads ``text``; flags are the instructor's alone."""
    graded = entry.counting
    pending = [f"Pending: {graded.pending}"] if graded and graded.pending else []
    said = "\n".join(map(cleaned, (*pending, *entry.flags)))
    hidden = {"name": "For the instructor", "output": said, "visibility": "hidden"}
    return {
        "score": entry.total or 0.0,
        "output": text,
        "visibility": VISIBLE,
        "stdout_visibility": "hidden",
        "tests": [hidden] if said else [],
    }


class _User(msgspec.Struct, frozen=True):
    name: str | None = None
    email: str | None = None


class _Assignment(msgspec.Struct, frozen=True):
    due_date: datetime | None = None


class _Metadata(msgspec.Struct):
    """What is read of ``submission_metadata.json``."""

    users: list[_User] = []
    assignment: _Assignment = _Assignment()
    created_at: datetime | None = None


def submission_metadata(folder: Path) -> tuple[ExportOrigin, datetime | None]:
    """Who handed in what ``submission_metadata.json`` is about, and when it was due.

    Of a group the first is named; without a name nobody is known.

    Raises
    ------
    SettingsError
        It is not such a file.
    """
    path = folder / "submission_metadata.json"
    if not path.exists():
        return NOBODY, None
    text = read_text(path, SettingsError, MAX_METADATA, name=path.name)
    try:
        said = msgspec.json.decode(text, type=_Metadata)
    except (msgspec.MsgspecError, RecursionError) as error:
        raise SettingsError(f"{path.name}: not what Gradescope writes.") from error
    user = said.users[0] if said.users else _User()
    name, email = (one_line(one or "", 200) for one in (user.name, user.email))
    origin = ExportOrigin("gradescope", Person("", name, email), said.created_at)
    return origin if name else NOBODY, said.assignment.due_date


def autograder_zip(
    logs: Sequence[Path], rubric: Path | None, key: Path | None, late: LateRule | None
) -> bytes:
    """The zip file to upload under "Configure Autograder", for an assignment of one PDF.

    It holds px4fuse as it is installed here, the versions of what it needs, the logs, the rubric
    and the answer key, which students never see: nothing of theirs is executed.

    Raises
    ------
    SettingsError
        No log was given, or rubric or key are not what they should be.
    LogError
        A log cannot be read.
    """
    paths = files_by_sha256(logs).values()
    if not paths:
        raise SettingsError("--write-autograder: give the flight logs with --logs.")
    read_rubric(rubric)
    text = rubric_text() if rubric is None else rubric.read_text(encoding="utf-8-sig")
    python = ".".join(platform.python_version_tuple()[:2])
    options = f' --late "{late.text}"' if late else ""
    package = Path(__file__).parents[1]
    contents: dict[str, str | bytes] = {}
    for name, file in SCRIPTS.items():
        script = Template((package / "grading" / file).read_text(encoding="utf-8"))
        contents[name] = script.substitute(python=python, options=options)
    contents["requirements.txt"] = "".join(f"{one}\n" for one in sorted(set(_requirements())))
    about = metadata.distribution("px4fuse")
    described = about.read_text("METADATA") or about.read_text("PKG-INFO") or ""
    contents[f"px4fuse-{about.version}.dist-info/METADATA"] = described
    for path in sorted(package.rglob("*")):
        if path.is_file() and "__pycache__" not in path.parts:
            contents[f"px4fuse/{path.relative_to(package).as_posix()}"] = path.read_bytes()
    contents["rubric.toml"] = text
    if key is not None:
        contents["key.json"] = key_text(read_key(key))
    for number, path in enumerate(paths):
        contents[f"logs/{number}{path.suffix}"] = read_log_bytes(path)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in contents.items():
            entry = zipfile.ZipInfo(name)  # without the time of today
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = (0o100755 if name in SCRIPTS else 0o100644) << 16
            archive.writestr(entry, content)
    return out.getvalue()


def _requirements() -> Iterator[str]:
    """The versions of what px4fuse needs, as they are here: the last digits depend on them."""
    for text in metadata.requires("px4fuse") or ():
        name = re.match(r"[\w.-]+", text)
        if name is not None and "extra == 'test'" not in text:
            with suppress(metadata.PackageNotFoundError):  # an extra that is not installed here
                yield f"{name[0]}=={metadata.version(name[0])}"


def run_autograder(folder: Path, late: LateRule | None) -> None:
    """Grade the one submission that Gradescope put into its folder, and write its results.

    Parameters
    ----------
    folder : Path
        ``/autograder``, with ``source``, ``submission`` and ``submission_metadata.json``.

    Raises
    ------
    SettingsError
        Rubric, key or metadata are not what they should be: Gradescope shows it to the instructor.
    """
    source = folder / "source"
    rubric, key = read_rubric(source / "rubric.toml"), source / "key.json"
    origin, due = submission_metadata(folder)
    answers, logs = read_key(key) if key.exists() else None, [source / "logs"]
    course = Course(rubric, answers, logs, due=due, late=late)
    try:
        found, _ = collect([folder / "submission"])
    except SettingsError as error:  # an empty folder, or other files than PDFs
        entry, text = Entry(origin.person.name, "", None), str(error)
    else:
        found = tuple(replace(one, origin=origin) for one in found)
        with tempfile.TemporaryDirectory(prefix="px4fuse-") as records:
            entries, *_ = grade_all(found, course, Path(records), {}, 1)
        entry = max(
            (one for one in entries if one.counting),
            key=lambda one: -1.0 if one.total is None else one.total,
        )
        text = returned_text(entry)
        if course.register.people and course.register.place(origin.person) is None:
            name = origin.person.name or "(none)"
            unknown = f"The answer key has nobody of the name {name}: compare the report's."
            entry = replace(entry, flags=(unknown, *entry.flags))
    content = json.dumps(results(entry, text), ensure_ascii=False, indent=2)
    write_all({folder / "results" / "results.json": content.encode()})
