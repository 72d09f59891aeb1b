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
LINES = [
    line
    for kind, block in BLOCKS
    if kind == "sh"
    for line in block.splitlines()
    if line.startswith("px4fuse ") and "|" not in line
]


@pytest.fixture
def at_root(tmp_path, monkeypatch):
    """A folder that looks like a fresh clone, so that outputs do not land in this one."""
    (tmp_path / "sample_logs").mkdir()
    shutil.copy(ROOT / "sample_logs" / "aisle_uwb.ulg", tmp_path / "sample_logs")
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("line", LINES)
def test_command_runs(at_root, line):
    result = CliRunner().invoke(cli, shlex.split(line)[1:])
    assert result.exit_code == 0, result.output


def test_python_example_runs(at_root, capsys):
    (block,) = [block for kind, block in BLOCKS if kind == "python"]
    exec(compile(block, "README.md", "exec"), {})
    assert float(capsys.readouterr().out.splitlines()[0]) > 0


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
