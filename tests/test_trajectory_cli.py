"""``px4fuse loop`` and ``px4fuse evaluate`` as a student types them."""

import io
import json
from pathlib import Path
from typing import Any

import jsonschema
import pypdf
import pytest
from cli_tools import contents, error_line, run
from click.testing import Result
from conftest import REPOSITORY

from px4fuse.results.contract import schema

pytestmark = pytest.mark.usefixtures("cached_analyses")

LOG = REPOSITORY / "sample_logs" / "loop_vio.ulg"
SLAM = REPOSITORY / "sample_logs" / "loop_slam.tum"
TRUTH = "loop_vio.ulg:truth"
ROWS = [line for line in SLAM.read_text().splitlines() if not line.startswith("#")]


def results(*arguments: str | Path) -> dict[str, Any]:
    """Return the JSON that a command prints with ``--json -``."""
    result = run(*arguments, "--json", "-")
    assert result.exit_code == 0, result.output
    assert result.stderr == ""
    found: dict[str, Any] = json.loads(result.stdout)
    return found


def write(path: Path, rows: list[str]) -> None:
    path.write_bytes("".join(row + "\n" for row in rows).encode())


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a flight, two trajectories and a pose graph."""
    folder = tmp_path_factory.mktemp("desk")
    (folder / "l.ulg").write_bytes(LOG.read_bytes())
    for name, rows in {
        "s.tum": ROWS,
        "line.tum": [f"{0.1 * i:.1f} {0.1 * i} 0 0 0 0 0 1" for i in range(100)],
        "g.g2o": [
            *(f"VERTEX_SE2 {i} {i} 0 0" for i in range(3)),
            *(f"EDGE_SE2 {i} {i + 1} 1 0 0 1 0 0 1 0 1" for i in range(2)),
        ],
    }.items():
        write(folder / name, rows)
    return folder


# ------------------------------------------------------------------ what the commands write


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Result]:
    """All files that ``px4fuse loop`` writes for the sample flight."""
    folder = tmp_path_factory.mktemp("made")
    return folder, make(folder)


def make(folder: Path) -> Result:
    return run(
        "loop", LOG, "--reference", SLAM, "--closure", "10,60", "-o", folder / "r.pdf",
        "--tum", folder / "r.tum", "--g2o", folder / "r.g2o",
        "--student", "Ana $x$ Müller", "--id", "$^2_",
    )  # fmt: skip


@pytest.fixture(scope="module")
def found(made: tuple[Path, Result]) -> dict[str, Any]:
    read: dict[str, Any] = json.loads((made[0] / "r.json").read_text(encoding="utf-8"))
    return read


def test_loop_command_writes_report_results_tum_and_g2o(made, found) -> None:
    folder, result = made
    assert result.exit_code == 0, result.output
    names = ["r.g2o", "r.json", "r.pdf", "r.tum"]
    assert sorted(path.name for path in folder.iterdir()) == names
    for said in ("rejected by the χ² test", *(f"Wrote    {folder / n}" for n in names)):
        assert said in result.output
    reader = pypdf.PdfReader(folder / "r.pdf")
    assert reader.attachments["results.json"] == [(folder / "r.json").read_bytes()]
    jsonschema.validate(found, schema())
    assert found["loop"]["closure_error_m"] == pytest.approx(1.42, abs=0.05)
    assert [each["accepted"] for each in found["loop"]["closures"]] == [True, False]


@pytest.mark.slow
def test_loop_report_is_reproducible_and_contains_no_paths(made, tmp_path):
    folder, _ = made
    pages = "".join(page.extract_text() for page in pypdf.PdfReader(folder / "r.pdf").pages)
    assert "Ana $x$ Müller" in pages
    for content in contents(folder).values():
        assert str(folder).encode() not in content
        assert str(REPOSITORY).encode() not in content
    assert make(tmp_path).exit_code == 0
    assert contents(tmp_path) == contents(folder)


@pytest.mark.parametrize("reference", [f"{LOG}:truth", str(LOG)])
def test_evaluate_command_reproduces_ate_of_loop_command(made, found, reference) -> None:
    gated = found["loop"]["corrections"]["pose_graph_gated"]["scores"][TRUTH]
    again = results("evaluate", made[0] / "r.tum", reference, "--alignment", gated["alignment"])
    in_loop, in_evaluate = (score["ate"]["translation_m"]["rmse"] for score in (gated, again))
    assert in_evaluate == pytest.approx(in_loop, rel=1e-4)
    assert again["association"]["poses"] == gated["association"]["poses"]


def test_loop_g2o_file_contains_the_optimised_pose_graph(made, found, tmp_path) -> None:
    """All closures of this graph are accepted; a rejected one would change the optimum."""
    graph = tmp_path / "g.g2o"
    written = results("loop", LOG, "--g2o", graph)["loop"]["corrections"]["pose_graph_gated"]
    again = results("loop", graph)["graph"]
    solved = again["solutions"]["all"]
    assert solved["cost"] == pytest.approx(written["cost"], rel=1e-6)
    assert solved["cost_initial"] == pytest.approx(solved["cost"], rel=1e-6)
    assert [gate["accepted"] for gate in again["gates"]] == [True]
    rejected = results("loop", made[0] / "r.g2o")["graph"]
    assert [gate["accepted"] for gate in rejected["gates"]] == [True, False]
    judged = found["loop"]["closures"][1]
    assert rejected["gates"][1]["degrees_of_freedom"] == judged["degrees_of_freedom"]


def test_loop_results_json_contains_command_to_repeat_run(desk, tmp_path) -> None:
    given = ["--landed-at", "0.1,-0.2,5", "--drift", "2"]
    given += ["--closure", "10,50", "--closure", " 20, 60,0.2"]
    found = results("loop", desk / "s.tum", *given)
    assert found["provenance"]["command"] == (
        "px4fuse loop s.tum --landed-at 0.1,-0.2,5 --closure 10,50,0.1 --closure 20,60,0.2 "
        "--drift 2"
    )
    assert len(found["loop"]["closures"]) == 3
    beside = results("loop", desk / "s.tum", "--tum", tmp_path / "o.tum")
    assert beside["provenance"]["command"] == "px4fuse loop s.tum"
    assert set(contents(tmp_path)) == {"o.tum"}


def test_evaluate_command_writes_report_and_results(desk, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    command = ["evaluate", desk / "s.tum", desk / "l.ulg:truth"]
    result = run(*command)
    assert result.exit_code == 0, result.output
    before = contents(tmp_path)
    pdf, text = (before[f"s_against_l_truth.{end}"] for end in ("pdf", "json"))
    assert len(before) == 2
    reader = pypdf.PdfReader(io.BytesIO(pdf))
    assert reader.attachments["results.json"] == [text]
    assert str(tmp_path) not in "".join(page.extract_text() for page in reader.pages)
    found = json.loads(text)
    jsonschema.validate(found, schema())
    assert found == results(*command)
    assert found["alignment"] == "se3"
    assert found["ate"]["translation_m"]["rmse"] == pytest.approx(0.060, abs=0.01)
    assert found["time_offset"]["is_determinable"]
    assert run(*command).exit_code == 0
    assert contents(tmp_path) == before
    deltas = results(*command, "--rpe", "5m", "--rpe", "10s", "--rpe", "1f")["rpe"]
    units = [(5.0, "m"), (10.0, "s"), (1.0, "frames")]
    assert [(one["delta"], one["unit"]) for one in deltas] == units
    output = run(*command, "--rpe", "900m", "--json", tmp_path / "far.json").output
    assert "RPE over 900 m: the reference has no pair of poses" in output


@pytest.mark.usefixtures("no_drawing")
def test_evaluate_with_other_settings_keeps_the_old_report(desk, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "other").mkdir()
    write(tmp_path / "other" / "s.tum", ROWS[:-50])
    commands = {
        "s_against_s": [desk / "s.tum"],
        "s_against_s_rpe-5-m_consecutive": [desk / "s.tum", "--rpe", "5m", "--consecutive"],
    }
    for count, (estimate, *options) in enumerate(commands.values(), start=1):
        assert run("evaluate", estimate, desk / "s.tum", *options).exit_code == 0
        written = {Path(name).stem for name in contents(tmp_path / "reports")}
        assert written == set(list(commands)[:count])
    before = contents(tmp_path / "reports")
    assert "-o" in error_line("evaluate", tmp_path / "other" / "s.tum", desk / "s.tum")
    assert contents(tmp_path / "reports") == before


@pytest.mark.usefixtures("no_drawing")
@pytest.mark.parametrize(("options", "written"), [
    ("-o p.pdf", {"p.pdf", "p.json"}),
    ("-o p.pdf --json r.json", {"p.pdf", "r.json"}),
    ("--json r.json", {"r.json"}),
    ("--json -", set()),
])  # fmt: skip
def test_evaluate_command_writes_only_the_named_files(
    desk, tmp_path, monkeypatch, options, written
) -> None:
    monkeypatch.chdir(tmp_path)
    result = run("evaluate", desk / "s.tum", desk / "l.ulg:truth", *options.split())
    assert result.exit_code == 0, result.output
    assert set(contents(tmp_path)) == written
    alone = "--json -" in options
    assert alone == result.output.startswith("{")
    assert alone == ("ATE: " not in result.output)


def test_loop_command_with_reference_reports_ate_of_each_method(desk) -> None:
    """References: the source itself, a flight with other timestamps, and one without overlap."""

    def scores(reference: str, way: str = "uncorrected") -> dict[str, Any]:
        found = results("loop", desk / "s.tum", "--reference", desk / reference)["loop"]
        score: dict[str, Any] = found["corrections"][way]["scores"][reference]
        return score

    assert scores("s.tum")["ate"]["translation_m"]["rmse"] < 1e-5
    assert scores("s.tum", "pose_graph_gated")["ate"]["translation_m"]["rmse"] > 0.05
    flown = scores("l.ulg:truth")["ate"]["translation_m"]["rmse"]
    assert flown == pytest.approx(0.060, abs=0.01)
    assert "s.tum: 0 poses match in time" in json.dumps(scores("line.tum"))


# ------------------------------------------------------------------ unusual frames


def to_z_up(rows: list[str]) -> list[str]:
    """Convert a trajectory of a camera to a body frame with z up, as in ROS."""
    converted = []
    for row in rows:
        time, x, y, z, qx, qy, qz, qw = row.split()
        minus = [str(-float(text)) for text in (x, y, qx, qy)]
        converted.append(" ".join([time, z, *minus[:2], qz, *minus[2:], qw]))
    return converted


def test_loop_command_on_two_equal_z_up_tracks_has_zero_rpe(tmp_path) -> None:
    for name in ("a.tum", "truth.tum"):
        write(tmp_path / name, to_z_up(ROWS))
    found = results("loop", tmp_path / "a.tum", "--reference", tmp_path / "truth.tum")["loop"]
    score = found["corrections"]["uncorrected"]["scores"]["truth.tum"]
    assert score["ate"]["rotation_deg"]["max"] < 0.01
    assert score["rpe"][0]["translation_m"]["max"] < 0.01
