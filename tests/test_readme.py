"""What the README tells a newcomer to type works word for word."""

import re
import shlex
import shutil
from pathlib import Path

import pytest
from click.testing import CliRunner

from px4fuse.cli import COMMANDS, cli

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```(\w+)\n(.*?)```", README, re.DOTALL)
SHELL = [block.splitlines() for kind, block in BLOCKS if kind == "sh"]
# The instructor's four commands need each other
(JOURNEY,) = (lines for lines in SHELL if any("--assignment" in line for line in lines))
LINES = [
    line
    for lines in SHELL
    if lines is not JOURNEY
    for line in lines
    if line.startswith("px4fuse ") and "|" not in line
]


@pytest.fixture
def at_root(tmp_path, monkeypatch):
    """A folder that looks like a fresh clone, so that outputs do not land in this one."""
    (tmp_path / "sample_logs").mkdir()
    for name in ("aisle_uwb.ulg", "aisle_uwb.tlog", "aisle_uwb_external.csv",
                 "loop_vio.ulg", "loop_slam.tum"):  # fmt: skip
        shutil.copy(ROOT / "sample_logs" / name, tmp_path / "sample_logs")
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("line", LINES)
def test_command_runs(at_root, line):
    result = CliRunner().invoke(cli, shlex.split(line)[1:])
    assert result.exit_code == 0, result.output


def test_the_instructors_four_commands_run_in_order(at_root):
    Path("roster.csv").write_text("id,name\n1001,Ada Lovelace\n1002,Grace Hopper\n")
    Path("notes.md").write_text("# What I found\n\nThe stamps are late.\n")
    assert len(JOURNEY) == 4
    for line in JOURNEY:
        result = CliRunner().invoke(cli, shlex.split(line)[1:])
        assert result.exit_code == 0, (line, result.output)
    assert {path.name for path in Path("flights").iterdir()} == {"1001.ulg", "1002.ulg"}
    assert "verified" in result.output
    table = Path("class/class.csv").read_text(encoding="utf-8-sig")
    assert "Ada Lovelace,1001,verified" in table


def test_python_examples_run(at_root, capsys):
    """In the README's order, on the tables that its own command extracts."""
    extracts = [line for line in LINES if line.startswith("px4fuse extract")]
    for line in extracts:
        assert CliRunner().invoke(cli, shlex.split(line)[1:]).exit_code == 0
    blocks = [block for kind, block in BLOCKS if kind == "python"]
    assert len(blocks) == 2
    for block in blocks:
        exec(compile(block, "README.md", "exec"), {})
        numbers = re.findall(r"-?\d+\.\d+", capsys.readouterr().out)
        assert numbers
        assert all(abs(float(number)) < 1e3 for number in numbers)


def test_every_command_is_in_the_table():
    for command in COMMANDS:
        assert f"`px4fuse {command}" in README


def test_ci_runs_the_readmes_test_command():
    command = ".venv/bin/python -m pytest"
    assert command in README
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    assert script.rstrip().endswith(command)


def test_linked_files_exist():
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        assert (ROOT / target).exists(), target
