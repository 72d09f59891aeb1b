"""``px4fuse diff`` as it is typed: what it takes, writes, prints and refuses."""

from __future__ import annotations

import io
import json
import shutil
from pathlib import Path

import jsonschema
import pytest
from click.testing import CliRunner
from conftest import REPOSITORY, page_of
from pypdf import PdfReader, PdfWriter
from results_tools import LOOP

import px4fuse
from px4fuse.cli import cli
from px4fuse.errors import Px4FuseError
from px4fuse.report import pdf
from px4fuse.results.contract import schema

pytestmark = pytest.mark.usefixtures("analysed_once")

SAMPLE = REPOSITORY / "sample_logs" / "aisle_uwb.ulg"
REPORTS = REPOSITORY / "reports"


def ran(*words: object, code: int = 0) -> str:
    """Standard output of a command that ends with this code."""
    done = CliRunner().invoke(cli, [str(word) for word in words])
    assert done.exit_code == code, (done.output, done.exception)
    return done.stdout


def refused(a: Path, b: Path, *words: object) -> str:
    """What is said of what cannot be compared."""
    done = CliRunner().invoke(cli, ["diff", str(a), str(b), "--json", "-", *map(str, words)])
    assert isinstance(done.exception, Px4FuseError), done.exception
    assert "\n" not in str(done.exception)
    assert done.stdout == ""
    return str(done.exception)


@pytest.fixture(scope="module")
def settings(tmp_path_factory) -> tuple[Path, Path]:
    """Reports of the sample with two settings."""
    folder = tmp_path_factory.mktemp("settings")
    files = folder / "usual.pdf", folder / "small.pdf"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pdf, "render", page_of)  # nobody looks at their pages
        ran("compare", SAMPLE, "--axis", "aisle", "-o", files[0])
        ran("compare", SAMPLE, "--axis", "aisle", "--sigma-z", 0.03, "-o", files[1])
    return files


@pytest.fixture(scope="module")
def changed(settings) -> dict[str, object]:
    return json.loads(ran("diff", *settings, "--json", "-"))


def test_results_follow_the_schema(changed):
    jsonschema.validate(changed, schema())
    assert changed["schema"]["name"] == "px4fuse-changes"
    assert [changed[side]["kind"] for side in "ab"] == ["report", "report"]


def test_two_settings_of_one_flight_are_exact(changed):
    numbers = {number["path"]: number for number in changed["numbers"]}
    nis = numbers["axes.aisle.filters.kf.nis_mean"]
    assert (nis["status"], nis["judgement"]) == ("differs", "worse")
    assert "q" not in nis
    assert numbers["axes.aisle.filters.ekf2.nis_mean"]["status"] == "same"
    assert changed["paired"]
    assert {"SIGMA_Z (m)"} == {text["what"] for text in changed["texts"]}
    assert changed["summary"][0].startswith("Both are of aisle_uwb.ulg:")


def test_json_and_pdf_of_one_run_are_the_same(settings, changed):
    beside = json.loads(ran("diff", *(p.with_suffix(".json") for p in settings), "--json", "-"))
    assert beside["numbers"] == changed["numbers"]
    nothing = json.loads(ran("diff", settings[0], settings[0].with_suffix(".json"), "--json", "-"))
    assert nothing["counts"]["changed"] == 0


def test_worse_is_exit_code_1(settings):
    ran("diff", *settings, "--json", "-", "--fail-on", "worse", code=1)
    better = json.loads(ran("diff", *settings[::-1], "--json", "-"))
    assert better["counts"]["better"] > 0
    same = settings[0].with_suffix(".json")
    ran("diff", settings[0], same, "--json", "-", "--fail-on", "worse")


def test_a_log_is_analysed_with_the_settings_of_the_other_ones_results(settings, tmp_path):
    """With both logs at hand the pages are drawn, the same bytes each time."""
    made = []
    for name in ("one.pdf", "two.pdf"):
        said = ran("diff", settings[1], SAMPLE, "-o", tmp_path / name)
        made.append((tmp_path / name).read_bytes())
    assert made[0] == made[1]
    assert "0 of" in said
    assert "Tracks and innovations are drawn from the logs. Give aisle_uwb.ulg for A." in said
    attached = json.loads(PdfReader(io.BytesIO(made[0])).attachments["results.json"][0])
    assert attached["counts"]["changed"] == 0
    assert attached["texts"] == []


def test_pages_show_both_flights_over_each_other(tmp_path):
    done = ran("diff", SAMPLE, SAMPLE.with_suffix(".tlog"), "-o", tmp_path / "d.pdf")
    pages = [page.extract_text() for page in PdfReader(tmp_path / "d.pdf").pages]
    assert "What changed from A to B" in pages[0]
    assert any("Tracks of A and B" in page and "time since take-off (s)" in page for page in pages)
    assert any("Innovations and variances along the aisle" in page for page in pages)
    assert "tested numbers changed by more than chance from A to B" in done
    # EKF2's innovations are not in a MAVLink recording
    assert "in A alone" in done
    assert (tmp_path / "d.json").is_file()


def test_the_terminal_says_what_changed_first(settings, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    lines = ran("diff", *settings).splitlines()
    assert lines[0].startswith("Both are of aisle_uwb.ulg:")
    table = [line for line in lines if line.startswith("worse")]
    assert any("NIS of ours, aisle" in line and "×" in line for line in table)
    assert any(line.startswith("Numbers not shown:") and "unchanged" in line for line in lines)
    assert any(line.startswith("Setting  SIGMA_Z (m): 0.1 → 0.03") for line in lines)
    assert any(line.startswith("New") for line in lines)
    assert lines[-1] == "Report   reports/usual_to_small.pdf"
    # the same again is written over, another pair of the same names is not
    ran("diff", *settings)
    assert sorted(path.name for path in Path("reports").iterdir()) == [
        "usual_to_small.json", "usual_to_small.pdf",
    ]  # fmt: skip


def test_python_gives_the_same(settings, changed):
    found = px4fuse.diff(*settings)
    assert [c.path for c in found.results.numbers] == [n["path"] for n in changed["numbers"]]
    assert repr(found).startswith(changed["summary"][0])
    assert len(found.to_frame()) == changed["counts"]["compared"]


# -- bad input -------------------------------------------------------------------------------------


def test_the_same_file_twice_is_refused(settings, tmp_path):
    assert "the same file" in refused(settings[0], settings[0])
    link = tmp_path / "link.pdf"
    link.symlink_to(settings[0])
    assert "the same file" in refused(settings[0], link)


def test_results_of_another_command_are_refused(settings, tmp_path):
    loop = tmp_path / "loop.json"
    loop.write_text(json.dumps(LOOP), encoding="utf-8")
    assert "loop.json: holds px4fuse-loop" in refused(settings[0], loop)
    assert "loop.json: holds px4fuse-loop" in refused(loop, settings[0])


def test_results_of_another_version_and_other_json_are_refused(settings, tmp_path):
    found = json.loads(settings[0].with_suffix(".json").read_text(encoding="utf-8"))
    old, other = tmp_path / "old.json", tmp_path / "other.json"
    old.write_text(json.dumps({**found, "schema": {**found["schema"], "version": "1.0"}}))
    other.write_text("{}")
    assert "version 1.0 of the results' schema" in refused(settings[0], old)
    assert "holds no results of px4fuse" in refused(settings[0], other)


def test_a_pdf_without_results_is_refused(settings, tmp_path):
    printed = tmp_path / "printed.pdf"
    writer = PdfWriter()
    writer.add_blank_page(100, 100)
    writer.write(printed)
    assert "no results.json is attached" in refused(settings[0], printed)


def test_what_cannot_be_read_is_refused(settings, tmp_path):
    text = tmp_path / "notes.txt"
    text.write_text("hello", encoding="utf-8")
    assert "missing.ulg: cannot be read" in refused(settings[0], tmp_path / "missing.ulg")
    assert "is a folder" in refused(tmp_path, settings[0])
    assert "notes.txt" in refused(text, settings[0])


def test_an_input_is_not_written_over(settings, tmp_path):
    report = shutil.copy(settings[0], tmp_path / "a.pdf")
    assert "is what this command reads" in refused(report, settings[1], "-o", report)
    assert Path(report).read_bytes() == settings[0].read_bytes()
