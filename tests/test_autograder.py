"""Gradescope: results with all that it takes, and an autograder that runs as it is unpacked."""

from __future__ import annotations

import json
import subprocess
import sys
import zipfile
from importlib.metadata import version
from pathlib import Path

import pytest
from class_tools import at_once, entry, graded, report_of
from cli_tools import done, refused
from conftest import LOG

from px4fuse.errors import SettingsError
from px4fuse.grading import gradescope
from px4fuse.grading.entries import late_rule
from px4fuse.grading.gradescope import results, submission_metadata
from px4fuse.grading.model import NOBODY, Entry
from px4fuse.grading.rubric import read_rubric

# The example of "Submission Metadata", gradescope-autograders.readthedocs.io
METADATA = {
    "id": 123456,
    "created_at": "2026-11-21T14:22:32.365935-07:00",
    "assignment": {
        "due_date": "2026-11-20T23:00:00.000000-07:00", "group_size": 4, "group_submission": True,
        "id": 25828, "course_id": 1234, "late_due_date": None,
        "release_date": "2026-11-02T00:00:00.000000-07:00", "title": "Lab", "total_points": "20.0",
    },
    "submission_method": "upload",
    "users": [{"email": "ada@example.com", "id": 1234, "name": "Ada Lovelace"}],
    "previous_submissions": [],
}  # fmt: skip
# "Autograder Specifications" of the same
TOP = {"score", "execution_time", "output", "output_format", "test_output_format",
       "test_name_format", "visibility", "stdout_visibility", "extra_data", "tests",
       "leaderboard"}  # fmt: skip
TEST = {"score", "max_score", "status", "name", "name_format", "number", "output", "output_format",
        "tags", "visibility", "extra_data"}  # fmt: skip


def check(made: dict) -> None:
    assert {"score", "output", "visibility", "tests"} <= set(made) <= TOP
    assert isinstance(made["score"], int | float)
    assert (made["visibility"], made["stdout_visibility"]) == ("after_due_date", "hidden")
    for test in made["tests"]:
        assert set(test) <= TEST
        assert test["visibility"] == "hidden"


def test_results_have_every_part_that_gradescope_names() -> None:
    one = graded("a.pdf", 10.0, 4.0, pending="Run 0.1.1.")
    made = results(Entry("Ada", "1", one, flags=("Late.", "a\x00flag"), total=14.0), "Points 14")
    check(made)
    assert (made["score"], made["output"]) == (14.0, "Points 14")
    (hidden,) = made["tests"]
    assert hidden["output"] == "Pending: Run 0.1.1.\nLate.\naflag"
    missing = results(entry("1", "Ada", None), "Nothing was handed in.")
    check(missing)
    assert (missing["score"], missing["tests"]) == (0.0, [])


def unpacked(tmp_path: Path, *options: str) -> Path:
    """An autograder as Gradescope unpacks it."""
    done("grade", "--write-autograder", tmp_path / "a.zip", "--logs", LOG, *options)
    folder = tmp_path / "autograder"
    with zipfile.ZipFile(tmp_path / "a.zip") as archive:
        modes = {one.filename: one.external_attr >> 16 for one in archive.infolist()}
        archive.extractall(folder / "source")
    runs = {name for name, mode in modes.items() if mode & 0o111}
    assert runs == {"setup.sh", "run_autograder"}
    (folder / "submission").mkdir()
    (folder / "submission_metadata.json").write_text(json.dumps(METADATA))
    return folder


def test_the_autograder_holds_px4fuse_as_it_is_here(tmp_path) -> None:
    folder = unpacked(tmp_path, "--late", "10%/day")
    source = folder / "source"
    for script in ("setup.sh", "run_autograder"):
        subprocess.run(["bash", "-n", str(source / script)], check=True)
    assert '--gradescope /autograder --late "10%/day"' in (source / "run_autograder").read_text()
    assert "numpy==" in (source / "requirements.txt").read_text()
    assert read_rubric(source / "rubric.toml") == read_rubric(None)
    assert next((source / "logs").iterdir()).read_bytes() == LOG.read_bytes()
    ran = subprocess.run(
        [sys.executable, "-P", "-c", "import px4fuse, importlib.metadata as m;"
         "print(px4fuse.__file__, m.version('px4fuse'))"],
        env={"PYTHONPATH": str(source)}, capture_output=True, text=True, check=True, cwd=tmp_path,
    )  # fmt: skip
    assert ran.stdout.split() == [str(source / "px4fuse" / "__init__.py"), version("px4fuse")]
    assert "--logs" in refused("grade", "--write-autograder", tmp_path / "a.zip")


def run(folder: Path, late: str | None = None) -> dict:
    gradescope.run_autograder(folder, late_rule(late) if late else None)
    made = json.loads((folder / "results" / "results.json").read_text())
    check(made)
    return made


def test_it_grades_what_is_in_its_folder(tmp_path, monkeypatch) -> None:
    folder = unpacked(tmp_path)
    at_once(monkeypatch)
    nothing = run(folder)
    assert nothing["score"] == 0.0
    assert "No PDF" in nothing["output"]
    (folder / "submission" / "report.pdf").write_bytes(report_of("Ada Lovelace", "1"))
    full = run(folder)
    assert full["score"] > 0.0
    # a day late, by Gradescope's own times
    late = run(folder, "10%/day")
    assert late["score"] == pytest.approx(full["score"] - 0.1 * 60.0, abs=0.01)
    assert "late" in late["output"]
    (folder / "submission" / "report.pdf").write_bytes(b"%PDF-1.7\n%%EOF")
    assert run(folder)["score"] == 0.0


def test_its_metadata_says_who_and_when(tmp_path) -> None:
    path = tmp_path / "submission_metadata.json"
    assert submission_metadata(tmp_path) == (NOBODY, None)
    path.write_text(json.dumps(METADATA))
    origin, due = submission_metadata(tmp_path)
    assert (origin.person.name, origin.person.email) == ("Ada Lovelace", "ada@example.com")
    assert (origin.time - due).total_seconds() == pytest.approx(15.3756 * 3600, abs=1.0)
    path.write_text('{"users": 3}')
    with pytest.raises(SettingsError, match=r"submission_metadata\.json"):
        submission_metadata(tmp_path)
