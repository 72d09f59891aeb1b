"""Gradescope: results that its autograder takes, and what it says of a submission.

After "Autograder Specifications" of gradescope-autograders.readthedocs.io: ``setup.sh`` is run once
to build the container, ``run_autograder`` for every submission; the zip file's content stands in
``/autograder/source``, what was handed in in ``/autograder/submission``, about it in
``/autograder/submission_metadata.json`` ("Submission Metadata"), and
``/autograder/results/results.json`` is what counts.
"""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Any

import msgspec

from px4fuse.errors import SettingsError
from px4fuse.grading.model import Entry
from px4fuse.grading.platforms import NOBODY, ExportOrigin
from px4fuse.reading import read_text
from px4fuse.results.reading import cleaned, one_line

VISIBLE = "after_due_date"
MAX_METADATA = 5_000_000


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
    tests = [
        _test(
            number,
            one_line(item.title, 200),
            item.comment,
            VISIBLE,
            score=item.points,
            max_score=item.of,
            status="passed" if item.points >= item.of else "failed",
            tags=["px4fuse", graded.status if graded else "missing"],
        )
        for number, item in enumerate(graded.items if graded else (), start=1)
    ]
    said = [f"Pending: {graded.pending}"] if graded and graded.pending else []
    if said := [*said, *entry.flags]:
        output = "\n".join(map(cleaned, said))
        tags = ["px4fuse", "instructor"]
        last = len(tests) + 1
        tests.append(
            _test(last, "For the instructor", output, "hidden", score=0.0, max_score=0.0, tags=tags)
        )
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


def _test(number: int, name: str, output: str, visibility: str, **more: object) -> dict[str, Any]:
    return {
        "name": name,
        "name_format": "text",
        "output": output,
        "output_format": "text",
        "number": str(number),
        "visibility": visibility,
        **more,
    }


class _User(msgspec.Struct):
    name: str | None = None
    email: str | None = None


class _Assignment(msgspec.Struct):
    due_date: datetime | None = None


class _Metadata(msgspec.Struct):
    """What is read of ``submission_metadata.json``."""

    users: list[_User] = []
    assignment: _Assignment | None = None
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
    origin = ExportOrigin("gradescope", name=name, email=email, time=said.created_at)
    return origin if name else NOBODY, getattr(said.assignment, "due_date", None)
