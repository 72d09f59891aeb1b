"""The autograder that :mod:`px4fuse.grading.gradescope` describes: written here, run there."""

from __future__ import annotations

import json
import platform
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from px4fuse.assignment.key import key_text, read_key
from px4fuse.errors import SettingsError
from px4fuse.grading.entries import Term, class_entries
from px4fuse.grading.grade import grade_all
from px4fuse.grading.gradescope import autograder, results, submission_metadata
from px4fuse.grading.lateness import LateRule
from px4fuse.grading.model import Entry
from px4fuse.grading.platforms import Origin
from px4fuse.grading.returned import returned_text
from px4fuse.grading.roster import Register, people_of_key
from px4fuse.grading.rubric import read_rubric, rubric_text
from px4fuse.grading.submissions import collect
from px4fuse.reading import files_by_sha256
from px4fuse.writing import write_all


def autograder_zip(
    logs: Sequence[Path], rubric: Path | None, key: Path | None, late: LateRule | None
) -> bytes:
    """The zip file to upload; see :func:`px4fuse.grading.gradescope.autograder`.

    Raises
    ------
    SettingsError
        No log was given, or rubric or key are not what they should be.
    """
    files = list(files_by_sha256(logs).values())
    if not files:
        raise SettingsError("--write-autograder: give the flight logs with --logs.")
    read_rubric(rubric)
    said = rubric_text() if rubric is None else rubric.read_text(encoding="utf-8-sig")
    answers = None if key is None else key_text(read_key(key))
    python = ".".join(platform.python_version_tuple()[:2])
    return autograder(files, said, answers, late, python)


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
    start = time.perf_counter()
    source = folder / "source"
    rubric = read_rubric(source / "rubric.toml")
    key_path = source / "key.json"
    key = read_key(key_path) if key_path.exists() else None
    name, email, created, due = submission_metadata(folder)
    register = Register(people_of_key(key)) if key else None
    origin = Origin("gradescope", name=name, email=email, time=created) if name else Origin()
    try:
        found, _ = collect([folder / "submission"])
    except SettingsError as error:  # an empty folder, or other files than PDFs
        entry = Entry(name, "", None, email=email, of=sum(item.points for item in rubric.items))
        text = str(error)
    else:
        with tempfile.TemporaryDirectory(prefix="px4fuse-") as records:
            origins = [origin] * len(found)
            graded, _ = grade_all(
                found, origins, [source / "logs"], rubric, Path(records), key, register, 1
            )
        term = Term("latest", due, late)
        entries, _ = class_entries(graded, found, origins, register, term, {})
        entry = max(
            (one for one in entries if one.counting),
            key=lambda one: -1.0 if one.total is None else one.total,
        )
        text = returned_text(entry)
        if register and register.by_platform(origin) is None:
            unknown = (
                f"The answer key has nobody of the name {name or '(none)'}: compare the report's."
            )
            entry = replace(entry, remarks=(unknown, *entry.remarks))
    made = results(entry, text, time.perf_counter() - start)
    content = json.dumps(made, ensure_ascii=False, indent=2)
    write_all({folder / "results" / "results.json": content.encode()})
