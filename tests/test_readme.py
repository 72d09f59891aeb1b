"""What the README tells a newcomer to type works word for word."""

import re
import shlex
import shutil
from pathlib import Path

import matplotlib as mpl
import pytest
from batch_tools import tiny_logs
from class_tools import in_this_process
from click.testing import CliRunner
from matplotlib import pyplot

from px4fuse.cli import COMMANDS, cli
from px4fuse.fleet.engine import connected

pytestmark = pytest.mark.usefixtures("analysed_once")

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


@pytest.fixture(scope="module")
def workers():
    """Of the session, so that a batch begins none of its own, as another test's does."""
    with connected(workers=1, memory="2GB"):
        yield


@pytest.mark.usefixtures("no_drawing")  # tests of their own draw each kind of report
@pytest.mark.parametrize("line", LINES)
def test_command_runs(at_root, line, request):
    if line.startswith("px4fuse batch"):  # the sample logs themselves are in the other lines
        request.getfixturevalue("workers")
        shutil.rmtree("sample_logs")
        tiny_logs(Path("sample_logs"), 1)
    result = CliRunner().invoke(cli, shlex.split(line, comments=True)[1:])
    assert result.exit_code == 0, result.output


@pytest.mark.usefixtures("drawn_once")
def test_the_instructors_four_commands_run_in_order(at_root, monkeypatch):
    in_this_process(monkeypatch)
    Path("roster.csv").write_text("id,name\n1001,Ada Lovelace\n1002,Grace Hopper\n")
    Path("notes.md").write_text("# What I found\n\nThe stamps are late.\n")
    assert len(JOURNEY) == 4
    for line in JOURNEY:
        result = CliRunner().invoke(cli, shlex.split(line)[1:])
        assert result.exit_code == 0, (line, result.output)
    assert {path.name for path in Path("flights").glob("*.ulg")} == {"1001.ulg", "1002.ulg"}
    assert "verified" in result.output
    table = Path("class/class.csv").read_text(encoding="utf-8-sig")
    assert "Ada Lovelace,1001,verified" in table


def test_python_examples_run(at_root, capsys):
    """In the README's order, on the tables that its own command extracts."""
    mpl.use("Agg")
    extracts = [line for line in LINES if line.startswith("px4fuse extract")]
    for line in extracts:
        assert CliRunner().invoke(cli, shlex.split(line)[1:]).exit_code == 0
    blocks = [block for kind, block in BLOCKS if kind == "python"]
    assert len(blocks) == 2
    for block in blocks:
        exec(compile(block, "README.md", "exec"), {})
        said = capsys.readouterr().out
        numbers = re.findall(r"-?\d+\.\d+", said)
        assert numbers
        assert all(abs(float(number)) < 1e3 for number in numbers)
        assert len(said.splitlines()) < 150 or "gain" in said  # no table is printed whole
    assert len(pyplot.get_fignums()) == len(re.findall(r"\S\.plot\(\)", blocks[0]))
    pyplot.close("all")


def test_the_lab_has_a_command_and_a_picture_for_each_step():
    lab = README.split("## The lab in five steps")[1].split("\n## ")[0]
    steps = re.split(r"\n\*\*\d\. ", lab)[1:]
    assert len(steps) == 5
    for number, step in enumerate(steps, 1):
        assert 1 <= len(re.findall(r"^px4fuse ", step, re.MULTILINE)) <= 2
        assert f"](reports/lab_{number}.png)" in step


def test_pictures_are_small_and_made_by_the_script():
    script = (ROOT / "tests" / "benchmarks" / "readme_pictures.py").read_text(encoding="utf-8")
    pictures = re.findall(r"!\[[^]]+\]\((\S+\.png)\)", README)
    assert len(pictures) == 7
    for picture in pictures:
        assert (ROOT / picture).stat().st_size <= 100_000
        assert f'Picture("{Path(picture).stem}"' in script


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_shells_complete_as_said(shell, monkeypatch, capsys):
    assert f"_PX4FUSE_COMPLETE={shell}_source px4fuse" in README or f"`{shell}_source`" in README
    monkeypatch.setenv("_PX4FUSE_COMPLETE", f"{shell}_source")
    with pytest.raises(SystemExit) as done:
        cli.main(prog_name="px4fuse")
    assert done.value.code == 0
    assert "px4fuse" in capsys.readouterr().out
    monkeypatch.setenv("_PX4FUSE_COMPLETE", f"{shell}_complete")
    monkeypatch.setenv("COMP_WORDS", "px4fuse comp")
    monkeypatch.setenv("COMP_CWORD", "comp" if shell == "fish" else "1")
    with pytest.raises(SystemExit):
        cli.main(prog_name="px4fuse")
    assert "compare" in capsys.readouterr().out


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
