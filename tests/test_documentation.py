"""Commands, code, links and figures of README and documentation, executed and checked."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import matplotlib as mpl
import pytest
from batch_tools import tiny_logs
from class_tools import in_this_process, run_in_turn
from cli_tools import run_checked
from conftest import REPOSITORY as ROOT
from matplotlib import pyplot

from px4fuse.batch import run
from px4fuse.cli import COMMANDS, cli

pytestmark = pytest.mark.usefixtures("cached_analyses")

PAGES = {
    path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8")
    for path in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
}
README = PAGES["README.md"]
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", re.DOTALL | re.MULTILINE)


def blocks(page: str, kind: str) -> list[str]:
    return [text for name, text in BLOCK.findall(PAGES[page]) if name == kind]


def commands(page: str) -> list[str]:
    """Return the px4fuse commands of a page, each up to its first pipe."""
    lines = [line for text in blocks(page, "sh") for line in text.splitlines()]
    return [line.split(" | ")[0] for line in lines if line.startswith("px4fuse ")]


@pytest.fixture
def at_root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Change to a temporary folder with the sample logs, so that outputs are not in the clone."""
    samples = ROOT / "sample_logs"
    shutil.copytree(samples, tmp_path / "sample_logs")
    shutil.copytree(samples, tmp_path / "installed" / "px4fuse_samples")
    monkeypatch.syspath_prepend(str(tmp_path / "installed"))
    monkeypatch.chdir(tmp_path)


def run_command(line: str) -> str:
    return run_checked(*shlex.split(line, comments=True)[1:]).output


@pytest.mark.usefixtures("no_drawing", "at_root")  # other tests draw each kind of report
@pytest.mark.parametrize("page", [page for page in PAGES if commands(page)])
def test_commands_in_documentation_run_without_error(
    page: str, monkeypatch, tmp_path: Path
) -> None:
    """Commands that README contains too run only for README."""
    if page == "docs/instructors.md":
        pytest.skip("test_commands_in_instructor_guide_run_without_error makes the inputs")
    monkeypatch.setattr(run, "run_with_limits", run_in_turn)
    readme_commands = commands("README.md") if page != "README.md" else []
    for number, line in enumerate(line for line in commands(page) if line not in readme_commands):
        if line == "px4fuse practice":
            run_command(f"{line} --flights 1")
        elif line.startswith("px4fuse batch"):  # a small log: other commands use the sample logs
            folder = tmp_path / f"batch_{number}"
            folder.mkdir()
            tiny_logs(folder / "sample_logs", 1)
            monkeypatch.chdir(folder)
            run_command(line)
            monkeypatch.chdir(tmp_path)
        else:
            run_command(line)


@pytest.mark.usefixtures("cached_pages", "at_root")
def test_commands_in_instructor_guide_run_without_error(monkeypatch) -> None:
    in_this_process(monkeypatch)
    Path("roster.csv").write_text("id,name\n1001,Ada Lovelace\n1002,Grace Hopper\n")
    Path("notes.md").write_text("# What I found\n\nThe timestamps are late.\n")
    lines = commands("docs/instructors.md")
    assert len(lines) == 4
    outputs = [run_command(line) for line in lines]
    assert {path.name for path in Path("flights").glob("*.ulg")} == {"1001.ulg", "1002.ulg"}
    assert "verified" in outputs[-1]
    table = Path("class/class.csv").read_text(encoding="utf-8-sig")
    assert "Ada Lovelace,1001,verified" in table


@pytest.mark.usefixtures("at_root")
@pytest.mark.parametrize("page", ["README.md", "docs/python.md"])
def test_documented_python_examples_run_without_error(page: str, capsys) -> None:
    """The tables of `px4fuse extract` are written first; the code blocks run in order."""
    mpl.use("Agg")
    for line in commands(page):
        if line.startswith("px4fuse extract"):
            run_command(line)
            capsys.readouterr()
    for block in blocks(page, "python"):
        exec(compile(block, page, "exec"), {})
        output = capsys.readouterr().out
        numbers = re.findall(r"-?\d+\.\d+", output)
        assert numbers
        assert all(abs(float(number)) < 1e3 for number in numbers)
        assert len(output.splitlines()) < 150 or "gain" in output  # no whole table is printed
    pyplot.close("all")


@pytest.mark.parametrize(
    ("page", "max_commands"), [("README.md", 3), ("docs/lab.md", 2)], ids=["readme", "lab"]
)
def test_each_step_of_lab_guide_contains_commands(page: str, max_commands: int) -> None:
    steps = re.split(r"\n\*\*\d\. ", PAGES[page].split("The lab in five steps\n")[-1])[1:]
    assert len(steps) == 5
    for number, step in enumerate(steps, 1):
        step = step.split("\n## ")[0]  # noqa: PLW2901 - without the next section
        assert 1 <= len(re.findall(r"^px4fuse ", step, re.MULTILINE)) <= max_commands
        assert page == "README.md" or f"reports/example/lab_{number}.png)" in step


def test_readme_pictures_are_small_and_created_by_script() -> None:
    script = (ROOT / "tests" / "benchmarks" / "readme_pictures.py").read_text(encoding="utf-8")
    pictures = re.findall(r"!\[[^]]+\]\((\S+\.png)\)", README + PAGES["docs/lab.md"])
    assert len({Path(picture).name for picture in pictures}) == 7
    for picture in pictures:
        file = ROOT / "reports" / "example" / Path(picture).name
        assert file.stat().st_size <= 100_000
        assert f'Picture("{file.stem}"' in script


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_documented_shell_completion_lines_work(shell, monkeypatch, capsys) -> None:
    page = PAGES["docs/commands.md"]
    assert all(f"`px4fuse {command}" in page for command in COMMANDS)
    assert f"_PX4FUSE_COMPLETE={shell}_source px4fuse" in page
    monkeypatch.setenv("_PX4FUSE_COMPLETE", f"{shell}_source")
    with pytest.raises(SystemExit) as exit_info:
        cli.main(prog_name="px4fuse")
    assert exit_info.value.code == 0
    assert "px4fuse" in capsys.readouterr().out
    monkeypatch.setenv("_PX4FUSE_COMPLETE", f"{shell}_complete")
    monkeypatch.setenv("COMP_WORDS", "px4fuse comp")
    monkeypatch.setenv("COMP_CWORD", "comp" if shell == "fish" else "1")
    with pytest.raises(SystemExit):
        cli.main(prog_name="px4fuse")
    assert "compare" in capsys.readouterr().out


@pytest.mark.parametrize("page", PAGES)
def test_documentation_links_lead_to_existing_headings(page: str) -> None:
    folder = (ROOT / page).parent
    targets = re.findall(r"\]\(([^)]+)\)", PAGES[page])
    targets += re.findall(r"(?<=\{image\} )\S+|(?<=\}`)[^`]+", PAGES[page])
    for target in targets:
        target = target.partition("<")[2].removesuffix(">") or target  # noqa: PLW2901 - target of a download
        name, _, heading = target.partition("#")
        if "//" in target or name.startswith("made/"):  # generated and checked by the build
            continue
        path = folder / name if name else ROOT / page
        assert path.exists(), target
        headings = (
            re.findall(r"^#+ (.*)", path.read_text(encoding="utf-8"), re.M) if heading else []
        )
        anchors = [re.sub(r"[^\w -]", "", title).lower().replace(" ", "-") for title in headings]
        assert not heading or heading in anchors, target


def test_readme_on_pypi_contains_only_absolute_links() -> None:
    """The substitutions are those that pyproject.toml gives the build plugin."""
    import tomllib

    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    rules = settings["tool"]["hatch"]["metadata"]["hooks"]["fancy-pypi-readme"]["substitutions"]
    text = README
    for rule in rules:
        text = re.sub(rule["pattern"], rule["replacement"], text)
    links = re.findall(r"\]\(([^)]+)\)", text)
    assert len(links) == len(re.findall(r"\]\(([^)]+)\)", README)) > 20
    assert all(link.startswith("https://") for link in links)


def test_source_distribution_includes_each_top_level_document() -> None:
    import tomllib

    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    included = settings["tool"]["hatch"]["build"]["targets"]["sdist"]["include"]
    documents = {path.name for end in ("*.md", "*.cff", "LICENSE") for path in ROOT.glob(end)}
    assert documents >= {"README.md", "SECURITY.md", "CONTRIBUTING.md", "CITATION.cff", "LICENSE"}
    assert documents <= set(included)
