"""What commands print, draw and write stays as it was looked at.

Each file in ``tests/golden`` holds what one command prints, every block of its pages with what is
drawn, and the numbers of its results in four digits. After a change that is meant::

    PX4FUSE_GOLDEN=write python -m pytest tests/test_golden.py

writes them anew; look at the difference, and at the pages, before it is committed.
"""

from __future__ import annotations

import difflib
import json
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from cli_tools import run
from conftest import REPOSITORY, page_of
from golden_tools import numbers, of_blocks, of_values

from px4fuse.report import pdf
from px4fuse.simulation.flights import answer, simulate
from px4fuse.simulation.mistakes import MISTAKES, parse
from px4fuse.simulation.scenario import Scenario

GOLDEN = Path(__file__).with_name("golden")
# What is in results because of the machine, the file or the command
NOT_KEPT = ("schema", "request", "provenance", "log", "command")
NOTES = """# What I saw

1. The *stamps* are late.
2. `EKF2_EV_DELAY` is 0.

| a | b |
|---|---|
| 1 | 2 |
"""
LATE = "simulate --mistake clock-offset=0.2 --mistake nlos --passes 2 --seed 5 -o late.ulg"
# The last command's output is kept; those before make its files
COMMANDS = {
    "compare": ("compare sample_logs/aisle_uwb.ulg --student Ana --id 7 --notes notes.md",),
    "compare_mistakes": (LATE, "compare late.ulg --sigma-z 0.3"),
    "compare_mavlink": ("compare sample_logs/aisle_uwb.tlog",),
    "compare_external": (
        "compare sample_logs/aisle_uwb.ulg --position sample_logs/aisle_uwb_external.csv",
    ),
    "loop": ("loop sample_logs/loop_vio.ulg --reference sample_logs/loop_slam.tum -o l.pdf",),
    "evaluate": ("evaluate sample_logs/loop_vio.ulg:vio sample_logs/loop_slam.tum -o e.pdf",),
    "whatif": ("whatif sample_logs/aisle_uwb.ulg --set EKF2_EV_DELAY=150 -o w.pdf",),
    "diff": (
        LATE,
        "compare late.ulg -o a.pdf",
        "compare late.ulg --sigma-z 0.3 -o b.pdf",
        "diff a.json b.json -o d.pdf",
    ),
    "tune": (LATE, "tune late.ulg"),
    "sync": (LATE, "sync late.ulg"),
    "info": (LATE, "info late.ulg"),
}


def agrees(name: str, lines: list[str]) -> None:
    """Compare with what is kept."""
    path = GOLDEN / f"{name}.txt"
    text = "\n".join(lines) + "\n"
    if os.environ.get("PX4FUSE_GOLDEN") == "write":
        path.write_text(text, encoding="utf-8")
    kept = path.read_text(encoding="utf-8")
    different = difflib.unified_diff(kept.splitlines(), text.splitlines(), lineterm="", n=1)
    assert text == kept, "\n".join(list(different)[:40])


def written(path: Path) -> Iterator[str]:
    """The numbers of results."""
    results = json.loads(path.read_text(encoding="utf-8"))
    yield from of_values({name: results[name] for name in results if name not in NOT_KEPT})


@pytest.mark.usefixtures("analysed_once")
@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_shows_what_it_showed(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(REPOSITORY / "sample_logs", tmp_path / "sample_logs")
    (tmp_path / "notes.md").write_text(NOTES)
    monkeypatch.chdir(tmp_path)
    blocks: list[Any] = []

    def keep(made: list[Any]) -> list[Any]:
        blocks[:] = made
        return []

    monkeypatch.setattr(pdf, "data", keep)
    monkeypatch.setattr(pdf, "compiled", lambda report: page_of(None, report["results"]))
    for command in COMMANDS[name]:
        before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.json")}
        blocks.clear()
        result = run(*command.split())
        assert result.exit_code == 0, (command, result.output)
    output = re.sub(r"px4fuse \d\S*", "px4fuse VERSION", result.output)
    lines = [f"$ px4fuse {command}", *output.splitlines(), "", *of_blocks(blocks), ""]
    for path in sorted(tmp_path.rglob("*.json")):
        if path.stat().st_mtime_ns != before.get(path):
            lines += [path.name, *written(path)]
    agrees(name, lines)


def spread(kind: str, *mistakes: str) -> list[str]:
    """How the fields of a simulated flight's topics are spread, and what its answer holds."""
    made = simulate(Scenario(kind=kind, passes=1, length_m=6.0, seed=3), parse(mistakes))
    return [
        f"{topic.name} {field} {numbers(part)}"
        for topic in made.topics
        for field, part in topic.fields.items()
    ] + list(of_values(answer(made)))


@pytest.mark.parametrize("kind", ["aisle", "loop"])
def test_a_simulated_flight_is_as_it_was(kind: str) -> None:
    """One without mistakes; and with each, the lines that differ."""
    clean = spread(kind)
    lines = [*clean]
    for name, mistake in MISTAKES.items():
        if mistake.kind in ("", kind):
            lines += ["", name, *(line for line in spread(kind, name) if line not in clean)]
    agrees(f"simulated_{kind}", lines)
