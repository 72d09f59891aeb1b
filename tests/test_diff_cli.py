"""``px4fuse diff`` on the command line: inputs, output, exit codes and errors."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import pytest
from cli_tools import contents, error_line, run_checked
from conftest import LOG, blank_page
from exchange import replace
from pypdf import PdfWriter
from results_tools import LOOP
from ulog_tools import gnss_log

import px4fuse
from px4fuse.batch.terminal import format_differences
from px4fuse.report import pdf
from px4fuse.results.contract import schema

pytestmark = pytest.mark.usefixtures("cached_analyses")


@pytest.fixture(scope="module")
def settings(tmp_path_factory) -> tuple[Path, Path]:
    """Reports of the sample with two settings."""
    folder = tmp_path_factory.mktemp("settings")
    files = folder / "usual.pdf", folder / "small.pdf"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pdf, "render_pdf", blank_page)  # a fast replacement for the report
        run_checked("compare", LOG, "--axis", "aisle", "-o", files[0])
        run_checked("compare", LOG, "--axis", "aisle", "--sigma-z", 0.03, "-o", files[1])
    return files


@pytest.fixture(scope="module")
def changed(settings) -> dict[str, object]:
    return json.loads(run_checked("diff", *settings, "--json", "-", code=1).stdout)


def test_diff_of_two_reports_lists_changed_settings_and_numbers(settings, changed):
    jsonschema.validate(changed, schema())
    assert changed["schema"]["name"] == "px4fuse-changes"
    assert [changed[side]["kind"] for side in "ab"] == ["report", "report"]
    (setting,) = changed["settings"]
    assert setting == {"name": "SIGMA_Z (m)", "a": 0.1, "b": 0.03}
    paths = {number["path"] for number in changed["numbers"]}
    assert "axes.aisle.filters.kf.nis_mean" in paths
    assert "axes.aisle.filters.ekf2.nis_mean" not in paths
    # the Python function returns the same
    found = px4fuse.diff(*settings)
    assert {one.path for one in found.numbers} == paths
    assert list(found.worse) == changed["worse"]


def test_diff_exit_code_is_1_if_verdict_is_worse(settings, changed):
    first, second = (path.with_suffix(".json") for path in settings)
    beside = json.loads(run_checked("diff", first, second, "--json", "-", code=1).stdout)
    assert beside["numbers"] == changed["numbers"]
    assert any(
        text.startswith("Mean NIS of KF, axis of largest motion: ") for text in beside["worse"]
    )
    said = run_checked("diff", first, second, code=1).stdout
    assert "Worse    Mean NIS of KF, axis of largest motion: " in said
    nothing = json.loads(run_checked("diff", settings[0], first, "--json", "-").stdout)
    assert [nothing[part] for part in ("settings", "numbers", "findings", "worse")] == [[]] * 4
    assert (
        "B has no new finding of severity error and no new inconsistent filter."
        in run_checked("diff", *settings[::-1]).stdout
    )


def test_diff_of_report_and_log_uses_settings_of_the_report(settings, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = json.loads(run_checked("diff", settings[1], LOG, "--json", "-").stdout)
    assert found["b"]["kind"] == "log"
    assert [found[part] for part in ("settings", "numbers", "findings", "worse")] == [[]] * 4
    assert contents(tmp_path) == {}


def test_diff_accepts_report_with_aiding_sources_only(tmp_path):
    log = gnss_log("v1.16").write(tmp_path / "a.ulg")
    run_checked("compare", log, "-o", tmp_path / "a.pdf")
    found = json.loads(
        run_checked("diff", tmp_path / "a.pdf", tmp_path / "a.json", "--json", "-").stdout
    )
    assert [found[side]["kind"] for side in "ab"] == ["report", "results"]
    assert found["numbers"] == []


# -- bad input -------------------------------------------------------------------------------------


def test_diff_of_file_with_itself_or_without_results_is_rejected(settings, tmp_path):
    usual = settings[0]
    link, printed, text = tmp_path / "link.pdf", tmp_path / "printed.pdf", tmp_path / "notes.txt"
    link.symlink_to(usual)
    writer = PdfWriter()
    writer.add_blank_page(100, 100)
    writer.write(printed)
    text.write_text("hello", encoding="utf-8")
    loop, old, other = (tmp_path / f"{name}.json" for name in ("loop", "old", "other"))
    loop.write_text(json.dumps(LOOP), encoding="utf-8")
    found = json.loads(usual.with_suffix(".json").read_text(encoding="utf-8"))
    old.write_text(json.dumps({**found, "schema": {**found["schema"], "version": "1.0"}}))
    other.write_text("{}")
    run_checked("diff", usual, code=2)  # exactly two
    run_checked("diff", usual, usual, usual, code=2)
    for a, b, said in (
        (usual, usual, "the same file"),
        (usual, link, "the same file"),
        (usual, loop, "loop.json contains results with the schema px4fuse-loop"),
        (loop, usual, "loop.json contains results with the schema px4fuse-loop"),
        (usual, old, "uses schema version 1.0"),
        (usual, other, "contains no results of px4fuse"),
        (usual, printed, "o results.json is attached"),
        (usual, tmp_path / "missing.ulg", "missing.ulg: the file cannot be read"),
        (tmp_path, usual, "is a folder"),
        (text, usual, "notes.txt"),
    ):
        assert said in error_line("diff", a, b, "--json", "-")


def test_diff_without_axis_of_largest_motion_prints_first_axis(settings):
    found = px4fuse.diff(*settings)
    numbers = [replace(one, path=one.path.replace("aisle", "north")) for one in found.numbers]
    numbers.append(replace(numbers[0], path="log.duration_s", label="Duration"))
    blocks = format_differences(replace(found, numbers=tuple(numbers))).blocks
    assert any("Mean NIS of KF, axis of largest motion, A → B" in str(block) for block in blocks)
