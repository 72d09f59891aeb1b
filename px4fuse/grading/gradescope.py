"""Gradescope: results that its autograder takes, and an autograder to upload.

After "Autograder Specifications" of gradescope-autograders.readthedocs.io: ``setup.sh`` is run once
to build the container, ``run_autograder`` for every submission; the zip file's content stands in
``/autograder/source``, what was handed in in ``/autograder/submission``, about it in
``/autograder/submission_metadata.json`` ("Submission Metadata"), and
``/autograder/results/results.json`` is what counts.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Sequence
from datetime import datetime
from importlib import metadata
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

from px4fuse.errors import OutputError, SettingsError
from px4fuse.grading.lateness import LateRule
from px4fuse.grading.model import Entry
from px4fuse.grading.zipping import zipped
from px4fuse.reading import read_text
from px4fuse.results.reading import cleaned, one_line

VISIBLE = "after_due_date"
MAX_METADATA = 5_000_000
SETUP = """#!/usr/bin/env bash
# Run once, when the autograder is uploaded: a Python of its own, with the versions of the machine
# that wrote this, so that the numbers and pages are the same to the last digit.
set -euo pipefail
apt-get update
apt-get install -y python3-venv
python3 -m venv /opt/uv
/opt/uv/bin/pip install uv
/opt/uv/bin/uv venv --python {python} /opt/px4fuse
/opt/uv/bin/uv pip install --python /opt/px4fuse/bin/python \\
    --constraint /autograder/source/constraints.txt "/autograder/source/{wheel}[grade]"
"""
RUN = """#!/usr/bin/env bash
# Run for every submission: its PDF is read within bounds, and nothing in it is executed.
exec /opt/px4fuse/bin/px4fuse grade --gradescope /autograder{options}
"""
EXECUTABLE = ("setup.sh", "run_autograder")


def results(entry: Entry, text: str, seconds: float | None = None) -> dict[str, Any]:
    """``results.json`` of one student.

    Parameters
    ----------
    text : str
        What the student reads about all of it.
    seconds : float, optional
        That grading took.
    """
    graded = entry.counting
    tests: list[dict[str, Any]] = []

    def add(name: str, score: float, of: float, output: str, **more: object) -> None:
        texts = {"name": name, "name_format": "text", "output": output, "output_format": "text"}
        numbers = {"number": str(len(tests) + 1), "score": score, "max_score": of}
        tests.append({**texts, **numbers, **more})

    for item in graded.items if graded else ():
        add(
            one_line(item.title, 200),
            item.points,
            item.of,
            item.comment,
            status="passed" if item.points >= item.of else "failed",
            tags=["px4fuse", graded.status if graded else "missing"],
            visibility=VISIBLE,
        )
    said = (*entry.remarks, *(graded.flags if graded else ()))
    if graded and graded.pending:
        said = (f"Pending: {graded.pending}", *said)
    if said:
        text_for = "\n".join(map(cleaned, said))
        tags = ["px4fuse", "instructor"]
        add("For the instructor", 0.0, 0.0, text_for, tags=tags, visibility="hidden")
    made: dict[str, Any] = {
        "score": entry.total or 0.0,
        "output": text,
        "output_format": "text",
        "test_output_format": "text",
        "test_name_format": "text",
        "visibility": VISIBLE,
        "stdout_visibility": "hidden",
        "tests": tests,
    }
    return made if seconds is None else {**made, "execution_time": round(seconds, 2)}


def submission_metadata(folder: Path) -> tuple[str, str, datetime | None, datetime | None]:
    """Who handed in what ``submission_metadata.json`` is about, when, and when it was due.

    Returns
    -------
    name, email : str
        Of the first of a group.
    created, due : datetime or None

    Raises
    ------
    SettingsError
        It is not such a file.
    """
    path = folder / "submission_metadata.json"
    if not path.exists():
        return "", "", None, None
    text = read_text(path, SettingsError, MAX_METADATA, name=path.name)
    try:
        said = json.loads(text)
        users = said.get("users") or [{}]
        due = (said.get("assignment") or {}).get("due_date")
        created = said.get("created_at")
        return (
            one_line(str(users[0].get("name") or ""), 200),
            one_line(str(users[0].get("email") or ""), 200),
            datetime.fromisoformat(created) if created else None,
            datetime.fromisoformat(due) if due else None,
        )
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        raise SettingsError(f"{path.name}: not what Gradescope writes.") from error


def autograder(
    logs: Sequence[Path], rubric: str, key: str | None, late: LateRule | None, python: str
) -> bytes:
    """The zip file to upload under "Configure Autograder", for an assignment of one PDF.

    It holds px4fuse as it is installed here, the versions of what it needs, the logs, the rubric
    and the answer key, which students never see: nothing of theirs is executed.

    Parameters
    ----------
    logs : sequence of Path
        Files.
    rubric : str
        As TOML.
    key : str, optional
        As JSON.
    python : str
        Its version: "3.12".
    """
    name, wheel = _wheel()
    options = f' --late "{late.text}"' if late else ""
    contents = {
        "setup.sh": SETUP.format(wheel=name, python=python).encode(),
        "run_autograder": RUN.format(options=options).encode(),
        name: wheel,
        "constraints.txt": _constraints().encode(),
        "rubric.toml": rubric.encode(),
        **({} if key is None else {"key.json": key.encode()}),
    }
    for number, path in enumerate(logs):
        try:
            contents[f"logs/{number}{path.suffix}"] = path.read_bytes()
        except OSError as error:
            raise OutputError(f"{path}: cannot be read ({error.strerror}).") from error
    return zipped(contents, EXECUTABLE)


def _constraints() -> str:
    """The versions of what px4fuse needs, as they are here: the last digits depend on them."""
    lines = set()
    for text in metadata.requires("px4fuse") or ():
        name = re.match(r"[\w.-]+", text)
        if name is None or "extra == 'test'" in text:
            continue
        try:
            lines.add(f"{name[0]}=={metadata.version(name[0])}")
        except metadata.PackageNotFoundError:  # an extra that is not installed here
            continue
    return "\n".join(sorted(lines)) + "\n"


def _wheel() -> tuple[str, bytes]:
    """px4fuse as it is installed here, as a wheel (PEP 427)."""
    version = metadata.version("px4fuse")
    info = f"px4fuse-{version}.dist-info"
    contents = dict(_package("px4fuse", files("px4fuse")))
    about = metadata.distribution("px4fuse").read_text("METADATA") or (
        metadata.distribution("px4fuse").read_text("PKG-INFO") or ""
    )
    contents |= {
        f"{info}/METADATA": about.encode(),
        f"{info}/WHEEL": b"Wheel-Version: 1.0\nGenerator: px4fuse\nRoot-Is-Purelib: true\n"
        b"Tag: py3-none-any\n",
        f"{info}/entry_points.txt": b"[console_scripts]\npx4fuse = px4fuse.cli:main\n",
    }
    lines = [
        f"{name},sha256={_digest(content)},{len(content)}" for name, content in contents.items()
    ]
    record = "\n".join([*lines, f"{info}/RECORD,,"]) + "\n"
    return f"px4fuse-{version}-py3-none-any.whl", zipped(
        contents | {f"{info}/RECORD": record.encode()}
    )


def _digest(content: bytes) -> str:
    return base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()


def _package(name: str, folder: Traversable) -> list[tuple[str, bytes]]:
    found = []
    for one in sorted(folder.iterdir(), key=lambda each: each.name):
        if one.is_dir() and one.name != "__pycache__":
            found += _package(f"{name}/{one.name}", one)
        elif one.is_file() and not one.name.endswith(".pyc"):
            found.append((f"{name}/{one.name}", one.read_bytes()))
    return found
