"""Output, pages and results of commands, compared with golden files.

Each file in ``tests/golden`` contains the terminal output of a command, the blocks and artists of
its pages, and the values of its results with four digits. After an intended change::

    PX4FUSE_GOLDEN=write python -m pytest -n 0 tests/test_golden.py tests/test_findings.py

writes them again. Review the differences and the pages before committing.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
from collections.abc import Iterable
from contextvars import copy_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from artificial_batch import artificial_logs
from browser import content
from class_tools import in_this_process
from cli_tools import run
from conftest import REPOSITORY, SAMPLES, blank_page
from golden_tools import assert_matches_golden, numbers, of_blocks, of_values, rounded, written
from scipy.spatial.transform import Rotation
from ulog_tools import gnss_log

import px4fuse
from px4fuse.batch.page import format_html
from px4fuse.cli import COMMANDS as CLI_COMMANDS
from px4fuse.cli.mcp import make_tools, run_command
from px4fuse.core.text import to_json_types
from px4fuse.explore.data import ArrayEncoder, make_flight_data
from px4fuse.explore.figures import make_document_json
from px4fuse.report import pdf
from px4fuse.simulation.faults import FAULT_TYPES, parse_faults
from px4fuse.simulation.flights import make_answer_key, simulate
from px4fuse.simulation.scenario import SCENARIO_KINDS, make_scenario

NOTES = """# What I saw

1. The *timestamps* are late.
2. `EKF2_EV_DELAY` is 0.

| a | b |
|---|---|
| 1 | 2 |
"""
LATE = "simulate --mistake clock-offset=0.2 --mistake nlos --passes 2 --seed 5 -o late.ulg"
# The output of the last command is compared; the commands before it write its input files
COMMANDS = {
    "compare": ("compare sample_logs/aisle_uwb.ulg --student Ana --id 7 --notes notes.md",),
    "compare_mistakes": (LATE, "compare late.ulg --sigma-z 0.3"),
    "compare_rejecting": (
        "simulate --mistake ekf2-noise --mistake dropout --passes 2 --seed 8 -o r.ulg",
        "compare r.ulg",
    ),
    "compare_loop": ("compare sample_logs/loop_vio.ulg",),
    "compare_mavlink": ("compare sample_logs/aisle_uwb.tlog",),
    "compare_external": (
        "compare sample_logs/aisle_uwb.ulg --position sample_logs/aisle_uwb_external.csv",
    ),
    "loop": ("loop sample_logs/loop_vio.ulg --reference sample_logs/loop_slam.tum -o l.pdf",),
    "evaluate": ("evaluate sample_logs/loop_vio.ulg:vio sample_logs/loop_slam.tum -o e.pdf",),
    "evaluate_apart": (
        "evaluate shifted.tum sample_logs/loop_slam.tum --time-offset auto --alignment se3"
        " --rpe 1m --rpe 2s --rpe 5f -o e.pdf",
    ),
    "evaluate_nearest": (
        "evaluate sample_logs/loop_slam.tum sample_logs/loop_vio.ulg:truth --alignment sim3"
        " --association nearest --consecutive --rpe 2m -o e.pdf",
    ),
    "evaluate_swapped": (
        "evaluate sample_logs/loop_vio.ulg:truth shifted.tum --max-gap 0.5 -o e.pdf",
    ),
    "loop_closures": (
        "loop sample_logs/loop_vio.ulg --open --closure 8,70,0.2 --drift 2 --heading-drift 5"
        " --reference shifted.tum -o l.pdf",
    ),
    "loop_tape": (
        "loop sample_logs/loop_vio.ulg:ekf2 --landed-at 0.1,-0.2,5 --key-frames 0.3 -o l.pdf",
    ),
    "loop_file": ("loop sample_logs/loop_slam.tum --json l.json",),
    "tune_sections": ("tune sample_logs/aisle_uwb.ulg --axis north --axis aisle --json t.json",),
    "sync_file": (
        "sync sample_logs/aisle_uwb.ulg --position sample_logs/aisle_uwb_external.csv"
        " --json s.json",
    ),
    "info_mavlink": ("info sample_logs/aisle_uwb.tlog",),
    "verify": ("verify report.pdf sample_logs --json v.json",),
    "verify_other": ("verify report.pdf sample_logs/loop_vio.ulg",),
    "whatif": ("whatif sample_logs/aisle_uwb.ulg --set EKF2_EV_DELAY=150 --json w.json",),
    "diff": (
        LATE,
        "compare late.ulg -o a.pdf",
        "compare late.ulg --sigma-z 0.3 -o b.pdf",
        "diff a.json b.json --json d.json",
    ),
    "tune": (LATE, "tune late.ulg"),
    "sync": (LATE, "sync late.ulg"),
    "info": (LATE, "info late.ulg"),
}


# Exit codes: a log that does not belong to the report, and a report with a worse verdict
EXIT_CODES = {"verify_other": 1, "diff": 1}


def shift_trajectory(path: Path) -> str:
    """Return a SLAM trajectory 0.35 s early, rotated, translated and with errors of 3 cm."""
    poses = np.array([line.split() for line in path.read_text().splitlines() if line[0] != "#"])
    poses = poses.astype(float)[40:-25:2]
    time, position, rotation = poses[:, 0], poses[:, 1:4], Rotation.from_quat(poses[:, 4:])
    turn = Rotation.from_euler("z", 25.0, degrees=True)
    error = 0.03 * np.sin(np.outer(time, [0.7, 1.1, 0.9]))
    moved = np.add(turn.apply(position + error), [1.0, -2.0, 0.3])
    columns = np.column_stack((time - 0.35, moved, (turn * rotation).as_quat()))
    return "".join(" ".join(f"{one:.6f}" for one in row) + "\n" for row in columns)


@pytest.fixture
def kept_pages(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Collect the blocks of the report instead of setting a PDF."""
    blocks: list[Any] = []
    if "verify" in request.node.name:  # verify needs the PDF
        in_this_process(monkeypatch)
        request.getfixturevalue("cached_pages")
        return blocks

    def keep(page_blocks: list[Any], _log: str) -> list[Any]:
        blocks.extend(page_blocks)
        return []

    monkeypatch.setattr(pdf, "to_typst_data", keep)
    monkeypatch.setattr(pdf, "compile_pdf", lambda report: blank_page(None, report["results"]))
    return blocks


def mark_slow(names: Iterable[str], slow_names: set[str]) -> list[Any]:
    """Return the parameters of a test; mark those that take seconds."""
    return [pytest.param(n, marks=pytest.mark.slow) if n in slow_names else n for n in names]


@pytest.mark.usefixtures("cached_analyses")
@pytest.mark.parametrize("name", mark_slow(COMMANDS, {"compare_loop"}))
def test_command_output_matches_reference_file(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kept_pages: list[Any]
) -> None:
    shutil.copytree(REPOSITORY / "sample_logs", tmp_path / "sample_logs")
    (tmp_path / "notes.md").write_text(NOTES)
    (tmp_path / "shifted.tum").write_text(
        shift_trajectory(REPOSITORY / "sample_logs" / "loop_slam.tum")
    )
    shutil.copy(REPOSITORY / "reports" / "example" / "aisle_uwb.pdf", tmp_path / "report.pdf")
    monkeypatch.chdir(tmp_path)
    for command in COMMANDS[name]:
        before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.json")}
        kept_pages.clear()
        result = run(*command.split())
        code = EXIT_CODES.get(name, 0) if command == COMMANDS[name][-1] else 0
        assert result.exit_code == code, (command, result.output)
    output = re.sub(r"px4fuse \d\S*", "px4fuse VERSION", result.output)
    lines = [f"$ px4fuse {command}", *output.splitlines(), "", *of_blocks(kept_pages), ""]
    for path in sorted(tmp_path.rglob("*.json")):
        if path.stat().st_mtime_ns != before.get(path):
            lines += [path.name, *written(path)]
    # the file is identical only if the processor rounds as the one that made it
    again = r"the log gives (the same file again, byte for byte|all \d+ values again \(.*?\))"
    assert_matches_golden(name, [re.sub(again, "the log gives it again", line) for line in lines])


@pytest.mark.usefixtures("cached_analyses")
def test_mcp_session_in_docs_equals_current_server_answers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The page contains calls of the tools of `px4fuse mcp`, each followed by its answer."""
    monkeypatch.delenv("COLUMNS", raising=False)  # set by pytest-xdist
    page = REPOSITORY / "docs" / "assistants.md"
    parsers = {tool.name: parse for tool, parse in make_tools((SAMPLES,))}

    def with_answer(call: re.Match[str]) -> str:
        words = parsers[call[1]](json.loads(call[2]))
        answer, _ = copy_context().run(run_command, (SAMPLES,), 10**9, None, None, words)
        lines = [line.rstrip() for line in answer.strip().splitlines()]
        return "\n".join([f"> {call[1]} {call[2]}", *lines, "```"])

    text = page.read_text(encoding="utf-8")
    current, count = re.subn(r"^> (\w+) (\{.*?\})\n.*?^```$", with_answer, text, flags=re.M | re.S)
    if os.environ.get("PX4FUSE_GOLDEN") == "write":
        page.write_text(current, encoding="utf-8")
    assert page.read_text(encoding="utf-8") == current
    assert count == 2


def spread(kind: str, *mistakes: str) -> list[str]:
    """Summarise the fields of a simulated flight's topics, and its answer key."""
    size = {} if kind == "outdoor" else {"length_m": 6.0}
    made = simulate(make_scenario(kind, passes=1, seed=3, **size), parse_faults(mistakes))
    return [
        f"{topic.name} {field} {numbers(part)}"
        for topic in made.topics
        for field, part in topic.fields.items()
    ] + list(of_values(make_answer_key(made)))


@pytest.mark.parametrize("kind", mark_slow(SCENARIO_KINDS, {"loop", "outdoor"}))
def test_simulated_flight_values_match_reference_file(kind: str) -> None:
    """Flight without faults, then the lines that differ with each fault."""
    clean = spread(kind)
    lines = [*clean]
    for name, mistake in FAULT_TYPES.items():
        if kind in mistake.kinds:
            # EKF2 ignores a GNSS noise below the receiver's accuracy
            typed = f"{name}=2" if (kind, name) == ("outdoor", "ekf2-noise") else name
            lines += ["", name, *(line for line in spread(kind, typed) if line not in clean)]
    assert_matches_golden(f"simulated_{kind}", lines)


def test_help_texts_match_reference_file() -> None:
    lines = []
    for command in ("", *CLI_COMMANDS, "lesson kalman"):
        lines += [
            f"$ px4fuse {command} --help",
            *run(*command.split(), "--help").output.splitlines(),
        ]
    assert_matches_golden("help", lines)


def test_report_on_aiding_sources_matches_reference_file(
    tmp_path: Path, kept_pages: list[Any]
) -> None:
    log = gnss_log("v1.16").write(tmp_path / "a.ulg")
    result = run("compare", log, "-o", tmp_path / "a.pdf")
    assert result.exit_code == 0, result.output
    output = result.output.replace(str(tmp_path), "").splitlines()
    assert_matches_golden(
        "aids", [*output, "", *of_blocks(kept_pages), *written(tmp_path / "a.json")]
    )


def test_batch_page_matches_reference_file() -> None:
    text = format_html(artificial_logs(12), "Bench", "px4fuse 1")
    above = re.sub(r"<(script|style).*?</\1>", "", text, flags=re.DOTALL)
    drawn = [rounded(line) for line in above.splitlines() if line.strip()]
    assert_matches_golden("fleet_page", [*drawn, *of_values(content(text))])


@pytest.mark.usefixtures("cached_analyses")
def test_explore_page_plots_match_reference_file(sample_log: Path) -> None:
    analysis = px4fuse.compare(str(sample_log))
    data = make_flight_data(analysis, ArrayEncoder())
    document, _ = make_document_json(data)
    ids: dict[str, str] = {}

    def number_bokeh_ids(found: re.Match[str]) -> str:
        """Number Bokeh's ids, which count the models of the process, from 0."""
        return ids.setdefault(found[0], f"id{len(ids)}")

    lines = [
        re.sub(r"\bp\d{4,}\b", number_bokeh_ids, line) for line in of_values(document["roots"])
    ]
    drawn = [rounded(line[:200]) for line in lines if " id" not in line]
    drawn = [re.sub(r"data: H4s.*", "data: packed", line) for line in drawn]
    # another test may have analysed the log by another path
    path = shlex.quote(analysis.request.log)
    values = [line.replace(path, "LOG") for line in of_values(to_json_types(data))]
    assert_matches_golden("explore", [*drawn, *(line[:200] for line in values)])
