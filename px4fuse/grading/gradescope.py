"""Gradescope: results that its autograder takes, and what it says of a submission.

After "Autograder Specifications" of gradescope-autograders.readthedocs.io: ``setup.sh`` is run once
to build the container, ``run_autograder`` for every submission; the zip file's content stands in
``/autograder/source``, what was handed in in ``/autograder/submission``, about it in
``/autograder/submission_metadata.json`` ("Submission Metadata"), and
``/autograder/results/results.json`` is what counts.
"""

from __future__ import annotations

import json
from datetime import datetime
from pathlib import Path
from typing import Any

from px4fuse.errors import SettingsError
from px4fuse.grading.model import Entry
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
