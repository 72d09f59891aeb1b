"""The lists of files to change in docs/built.md, followed on a copy of px4fuse."""

from __future__ import annotations

import ast
import functools
import os
import re
import shutil
import subprocess
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path

import click
import msgspec
import pytest
from click.testing import CliRunner
from conftest import REPOSITORY as ROOT

from px4fuse.batch.changes import SETTING_PATHS_BY_LABEL
from px4fuse.cli import options
from px4fuse.errors import SettingsError
from px4fuse.filter.settings import SETTING_RANGES, Range, Settings
from px4fuse.report.phrases import format_settings
from px4fuse.request import ComparisonRequest
from px4fuse.results.contract import ChosenSettings

GUIDE = (ROOT / "docs" / "built.md").read_text(encoding="utf-8")
EXTENSIONS = GUIDE.partition("## Extensions\n")[2].partition("\n**Changed texts")[0]
TABLES = [
    textwrap.dedent(block) for block in re.findall(r"```toml\n(.*?)```", EXTENSIONS, re.DOTALL)
]
# A finding, a page, a command and a filter as short as the lists allow
NEW_FILES = {
    "findings/wind.py": """
from px4fuse.findings.model import make_note


def detect(analysis):
    yield make_note("wind", "There was wind.", "Fly indoors.")
""",
    "report/wind.py": """
from px4fuse.report.page import Page


def draw_pages(content, results):
    yield Page("Wind page")
""",
    "cli/wind.py": """
import click


@click.command()
def wind():
    \"\"\"Print the wind.\"\"\"
    click.echo("calm")
""",
    "filter/kf2.py": """
from dataclasses import replace
from px4fuse.filter.kalman import run_kf


def run_kf2(axis, settings):
    return run_kf(axis, replace(settings, sigma_a_m_s2=2.0 * settings.sigma_a_m_s2), fast=True)
""",
}
# Replacements by file, for the third filter
FILTER_CHANGES = {
    "comparison/model.py": [
        ('"kf", "ekf2"]', '"kf", "ekf2", "kf2"]'),
        ('"ekf2": "EKF2"}', '"ekf2": "EKF2", "kf2": "KF2"}'),
    ],
    "comparison/comparison.py": [
        ("import projection\n", "import projection\nfrom px4fuse.filter.kf2 import run_kf2\n"),
        (
            '"ekf2": ekf2_tracks}',
            '"ekf2": ekf2_tracks,'
            '"kf2": make_run_tracks(run_kf2(axis, prepared_comparison.settings))}',
        ),
    ],
    "report/style.py": [(r'"EKF2": (.*?)(,\n|})', r'"EKF2": \1, "KF2": \1\2')],
}
CATALOGUE_ENTRIES = "".join(
    f'\n[{name}]\ntitle = "Wind"\nmeaning = "Wind."\nreport_class = "noise"\n'
    for name in ("wind", "kf2_overconfident", "kf2_underconfident")
)
CHECKS = {
    "ulog": """
from pathlib import Path
from ulog_tools import make_log, position, seconds_of, stamps, topic
from px4fuse.readers import read_log
at = stamps(10.0, 20.0)
fields = dict(zip("xyz", position(seconds_of(at)).T, strict=True))
log = make_log().add(topic("beacon_position", at, fields))
tracks = {track.name: track for track in read_log(log.write(Path("wind.ulg"))).positions}
assert tracks["beacon_position"].frame == "NED", tracks
assert tracks["beacon_position"].origin.aid is None
assert len(tracks["beacon_position"].samples) == 200
""",
    "mavlink": """
from pathlib import Path
from mavlink_tools import Aisle, COMPANION, message, unix, us, xyz
from px4fuse.readers import read_log
aisle = Aisle()
recorder = aisle.record()
for boot_s in aisle.times(5.0):
    fields = xyz(aisle.path(boot_s)[0])
    sent = message("VICON_POSITION_ESTIMATE", usec=us(unix(boot_s)), **fields)
    recorder.hear(unix(boot_s + 0.01), COMPANION, sent)
Path("wind.tlog").write_bytes(recorder.tlog())
flight = read_log(Path("wind.tlog"))
track = next(track for track in flight.positions if track.name.startswith("VICON"))
assert flight.truth.name == "VICON_POSITION_ESTIMATE"
assert (track.name, track.frame, track.origin.kind) == ("VICON_POSITION_ESTIMATE", "NED", "mocap")
assert len(track.samples) == 200
""",
    "finding, page": """
from comparisons import compare
from flights import aisle_flight, unexplained
from px4fuse.findings import find
from px4fuse.report.pdf import PAGE_FUNCTIONS_BY_RESULTS_TYPE
from px4fuse.results.contract import ComparisonResults
assert [item.title for item in find(unexplained(compare(aisle_flight()))) if item.id == "wind"]
draw_pages = PAGE_FUNCTIONS_BY_RESULTS_TYPE[ComparisonResults][-1]
pages = list(draw_pages(None, None))
assert "Wind page" in repr(pages[0].blocks)
""",
    "filter": """
from comparisons import compare
from flights import aisle_flight, unexplained
from px4fuse.batch.page import format_html
from px4fuse.batch.rows import make_axis_rows, make_table
from px4fuse.batch.run import BatchResult
from px4fuse.batch.terminal import format_summary
from px4fuse.card.verdicts import make_sigma_verdicts
from px4fuse.filter.settings import Settings
from px4fuse.findings import find
from px4fuse.report import consistency, flight
from px4fuse.request import ComparisonRequest
from px4fuse.results.build import make_comparison_results
analysis = unexplained(compare(aisle_flight(), Settings(sigma_z_m=0.01)))
verdicts = make_sigma_verdicts(analysis.main)
assert [each.word for each in verdicts if each.filter == "kf2"] == ["overconfident"] * 2
assert "kf2_overconfident" in [each.id for each in find(analysis)]
for draw_pages in (flight.draw_pages, flight.draw_innovations, consistency.draw_pages):
    pages = list(draw_pages(analysis, None))
    assert "KF2" in repr(pages[0].blocks)
assert analysis.main.filters["kf2"].nis_mean < analysis.main.filters["kf"].nis_mean
assert analysis.horizontal.keys() == {"kf", "ekf2", "kf2"}
results = make_comparison_results(ComparisonRequest(log="a.ulg"), analysis)
table = make_table({**row, "log": "a.ulg"} for row in make_axis_rows(results))
assert '"KF2 ' in format_html(table, "", "")
assert "'KF2 ●" in repr(format_summary(BatchResult(table, 0, frozenset(), ())).blocks)
""",
    "command": """
import sys
from px4fuse.cli import cli
sys.argv = ["px4fuse", "wind"]
cli.main(standalone_mode=False)
""",
}


def change(path: Path, edit: Callable[[str], str]) -> None:
    text = path.read_text(encoding="utf-8")
    assert edit(text) != text
    path.write_text(edit(text), encoding="utf-8")


@pytest.fixture(scope="module")
def extended(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a copy of px4fuse that was extended by the lists."""
    folder = tmp_path_factory.mktemp("extended")
    package = folder / "px4fuse"
    shutil.copytree(ROOT / "px4fuse", package, ignore=shutil.ignore_patterns("__pycache__"))
    source, message = TABLES
    change(package / "readers" / "px4_topics.toml", lambda text: text + "\n" + source)
    change(
        package / "readers" / "mavlink_messages.toml",
        lambda text: re.sub(r"(?m)^VICON_POSITION_ESTIMATE = .*\n", "", text) + "\n" + message,
    )
    for name, text in NEW_FILES.items():
        (package / name).write_text(text, encoding="utf-8")
    change(
        package / "findings" / "__init__.py",
        lambda text: text.replace("    source_values,\n", "    source_values,\n    wind,\n"),
    )
    change(package / "findings" / "catalogue.toml", lambda text: text + CATALOGUE_ENTRIES)
    change(
        package / "report" / "pdf.py",
        lambda text: text.replace("    provenance,\n", "    provenance,\n    wind,\n").replace(
            "        provenance.draw_pages,\n    ),",
            "        provenance.draw_pages,\n        wind.draw_pages,\n    ),",
            1,
        ),
    )
    for name, replacements in FILTER_CHANGES.items():
        for pattern, text in replacements:
            change(package / name, functools.partial(re.sub, pattern, text))
    change(
        package / "cli" / "__init__.py",
        lambda text: text.replace("COMMANDS = (\n", 'COMMANDS = (\n    "wind",\n'),
    )
    return folder


@pytest.mark.process
@pytest.mark.parametrize("kind", CHECKS)
def test_extension_guide_steps_give_a_working_extension(kind: str, extended: Path) -> None:
    paths = os.pathsep.join(map(str, (extended, ROOT / "tests")))
    run = subprocess.run(
        [sys.executable, "-c", CHECKS[kind]],
        cwd=extended, env={**os.environ, "PYTHONPATH": paths}, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    assert kind != "command" or run.stdout == "calm\n"


def test_extension_guide_names_only_existing_files() -> None:
    paths = set(re.findall(r"`((?:\w+/)*\w+\.(?:py|toml|md|js|csv))`", EXTENSIONS))
    texts = {}
    for path in paths:
        (file,) = [root / path for root in (ROOT, ROOT / "px4fuse") if (root / path).is_file()]
        texts[path] = file.read_text(encoding="utf-8")
    assert len(paths) > 30
    for path, names in {
        "tests/test_findings.py": ["FAULTS"],
        "tests/test_options.py": ["CHANGED"],
        "findings/source_values.py": ["def detect_rounding"],
        "cli/options.py": [],
        "filter/settings.py": ["class Settings", "SETTING_RANGES"],
        "results/contract.py": ["class ChosenSettings"],
        "flight/model.py": ["SOURCE_ORIGINS"],
        "report/pdf.py": ["PAGE_FUNCTIONS_BY_RESULTS_TYPE"],
        "cli/__init__.py": ["COMMANDS"],
    }.items():
        for name in names:
            assert name in texts[path]
            assert name.split()[-1] in EXTENSIONS


def test_each_kf_setting_has_option_range_and_json_field() -> None:
    names = set(Settings.__dataclass_fields__)
    assert names <= set(ComparisonRequest.__struct_fields__)
    assert names <= set(ChosenSettings.__struct_fields__)
    assert {f"settings.{name}" for name in names} <= set(SETTING_PATHS_BY_LABEL.values())
    assert set(SETTING_RANGES) == {
        name for name in names if isinstance(getattr(Settings(), name), float)
    }


def test_setting_without_unit_is_printed_without_trailing_space(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(SETTING_RANGES, "dt_s", Range(1.0, 5.0, "", "GATE"))
    assert SETTING_RANGES["dt_s"].format_label() == "GATE"
    assert "GATE 3, acceleration input imu" in format_settings(Settings(dt_s=3.0))
    with pytest.raises(SettingsError, match=r"give 1 to 5\.$"):
        Settings(dt_s=9.0)

    @click.command()
    @options.request_option(ComparisonRequest, "dt_s", "Gate (RANGE).")
    def fuse(**_: float) -> None: ...

    assert "Gate (1 to 5)." in CliRunner().invoke(fuse, ["--help"]).output


def test_command_line_option_accepts_number_without_unit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Request(msgspec.Struct):
        gate_factor: float = 1.0
        robust: bool = False

    names = {"gate_factor": "--gate-factor", "robust": "--robust"}
    monkeypatch.setattr(options, "OPTION_NAMES", {Request: names})

    @click.command()
    @options.request_option(Request, "gate_factor", "Factor on the gate.")
    @options.request_option(Request, "robust", "Reject outliers.")
    def fuse(**values: float | bool) -> None:
        click.echo(values)

    def run(*arguments: str) -> object:
        result = CliRunner().invoke(fuse, arguments)
        assert result.exit_code == 0, result.output
        return ast.literal_eval(result.output)

    assert run() == {"gate_factor": 1.0, "robust": False}
    assert run("--gate-factor", "-2", "--robust") == {"gate_factor": -2.0, "robust": True}
    with pytest.raises(AssertionError, match=r"'two' is not a number"):
        run("--gate-factor", "two")
