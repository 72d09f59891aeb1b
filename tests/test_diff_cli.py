"""``px4fuse diff`` as it is typed: what it takes, writes, prints and refuses."""

from __future__ import annotations

import io
import json
from collections import Counter
from pathlib import Path

import jsonschema
import pytest
from cli_tools import contents, done, refused
from conftest import LOG, page_of
from pypdf import PdfReader, PdfWriter
from results_tools import LOOP
from ulog_tools import gnss_log

import px4fuse
from px4fuse.report import pdf
from px4fuse.results.contract import schema

pytestmark = pytest.mark.usefixtures("analysed_once")


@pytest.fixture(scope="module")
def settings(tmp_path_factory) -> tuple[Path, Path]:
    """Reports of the sample with two settings."""
    folder = tmp_path_factory.mktemp("settings")
    files = folder / "usual.pdf", folder / "small.pdf"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pdf, "render", page_of)  # nobody looks at their pages
        done("compare", LOG, "--axis", "aisle", "-o", files[0])
        done("compare", LOG, "--axis", "aisle", "--sigma-z", 0.03, "-o", files[1])
    return files


@pytest.fixture(scope="module")
def changed(settings) -> dict[str, object]:
    return json.loads(done("diff", *settings, "--json", "-").stdout)


def judgements(found: dict[str, object]) -> Counter[str]:
    return Counter(number.get("judgement", "") for number in found["numbers"])


def test_two_settings_of_one_flight_are_exact(settings, changed):
    jsonschema.validate(changed, schema())
    assert changed["schema"]["name"] == "px4fuse-changes"
    assert [changed[side]["kind"] for side in "ab"] == ["report", "report"]
    numbers = {number["path"]: number for number in changed["numbers"]}
    nis = numbers["axes.aisle.filters.kf.nis_mean"]
    assert (nis["status"], nis["judgement"]) == ("differs", "worse")
    assert "q" not in nis
    assert numbers["axes.aisle.filters.ekf2.nis_mean"]["status"] == "same"
    assert changed["paired"]
    assert {"SIGMA_Z (m)"} == {text["what"] for text in changed["texts"]}
    assert changed["summary"][0].startswith("Both are of aisle_uwb.ulg:")
    # Python gives the same
    found = px4fuse.diff(*settings)
    assert [c.path for c in found.numbers] == [n["path"] for n in changed["numbers"]]
    assert found.summary[0] == changed["summary"][0]


def test_json_and_pdf_of_one_run_are_the_same_and_worse_is_exit_code_1(settings, changed):
    first, second = (path.with_suffix(".json") for path in settings)
    fail = ("--json", "-", "--fail-on", "worse")
    beside = json.loads(done("diff", first, second, *fail, code=1).stdout)
    assert beside["numbers"] == changed["numbers"]
    nothing = json.loads(done("diff", settings[0], first, *fail).stdout)
    assert set(judgements(nothing)) == {""}
    back = json.loads(done("diff", *settings[::-1], "--json", "-").stdout)
    assert judgements(back)["better"] > 0


def test_a_log_is_analysed_with_the_settings_of_the_other_ones_results(settings, tmp_path):
    """The same bytes each time."""
    made = []
    for name in ("one.pdf", "two.pdf"):
        said = done("diff", settings[1], LOG, "-o", tmp_path / name).stdout
        made.append((tmp_path / name).read_bytes())
    assert made[0] == made[1]
    assert "0 of" in said
    assert "Flights are drawn from their logs. Give aisle_uwb.ulg for A." in said
    attached = json.loads(PdfReader(io.BytesIO(made[0])).attachments["results.json"][0])
    assert set(judgements(attached)) == {""}
    assert attached["texts"] == []


def test_the_same_pair_again_is_written_over(settings, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        assert "Wrote    reports/usual_to_small.pdf" in done("diff", *settings).stdout
    assert contents(Path("reports")).keys() == {"usual_to_small.json", "usual_to_small.pdf"}


def test_a_report_of_aids_alone_is_taken_as_its_results_are(tmp_path):
    log = gnss_log("v1.16").write(tmp_path / "a.ulg")
    done("compare", log, "-o", tmp_path / "a.pdf")
    found = json.loads(done("diff", tmp_path / "a.pdf", tmp_path / "a.json", "--json", "-").stdout)
    assert [found[side]["kind"] for side in "ab"] == ["report", "results"]
    assert {number["status"] for number in found["numbers"]} == {"same"}


# -- bad input -------------------------------------------------------------------------------------


def test_what_cannot_be_compared_is_refused(settings, tmp_path):
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
    for a, b, said in (
        (usual, usual, "the same file"),
        (usual, link, "the same file"),
        (usual, loop, "loop.json: holds px4fuse-loop"),
        (loop, usual, "loop.json: holds px4fuse-loop"),
        (usual, old, "version 1.0 of the results' schema"),
        (usual, other, "holds no results of px4fuse"),
        (usual, printed, "no results.json is attached"),
        (usual, tmp_path / "missing.ulg", "missing.ulg: cannot be read"),
        (tmp_path, usual, "is a folder"),
        (text, usual, "notes.txt"),
    ):
        assert said in refused("diff", a, b, "--json", "-")
