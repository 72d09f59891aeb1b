"""Protection of inputs: no command writes to a file that it reads."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest
from class_tools import in_this_process, make_report
from cli_tools import error_line, run, run_checked
from conftest import REPORT, SAMPLES
from overwrite_cases import (
    RUNS,
    OverwriteCase,
    all_cases,
    file_hashes,
    make_desk,
    make_empty_folder,
)

from px4fuse.errors import OutputError

pytestmark = [
    pytest.mark.usefixtures("cached_analyses", "no_drawing"),
    pytest.mark.skipif(os.name == "nt", reason="links need rights there"),
]


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_desk(tmp_path_factory.mktemp("desk") / "desk")


def group(case: OverwriteCase) -> tuple[str, str, str | None]:
    return case.command, case.option, case.name


@pytest.mark.parametrize("command", [command for command, *_ in RUNS])
def test_every_command_refuses_to_write_over_its_input(
    desk, tmp_path, monkeypatch, command
) -> None:
    monkeypatch.chdir(desk)
    before, tried = file_hashes(desk), 0
    for case in (case for case in all_cases() if case.command == command):
        arguments = case.arguments(desk, make_empty_folder(tmp_path / "place"))
        if arguments is None:
            continue
        result = run(*arguments)
        assert isinstance(result.exception, OutputError), (case, result.output)
        assert result.stdout == ""
        assert file_hashes(desk) == before, case
        tried += 1
    assert tried >= 4


# --- the faults that were found ---


@pytest.fixture
def class_desk(tmp_path, monkeypatch) -> Path:
    """Submitted reports in a folder with the same name as an output folder of grade."""
    folder = tmp_path / "h" / "reports"
    folder.mkdir(parents=True)
    (folder / "1001.pdf").write_bytes(make_report("Ada", "1001"))
    (tmp_path / "gg").mkdir()
    (tmp_path / "gg" / "class.csv").write_text("id,name\n1001,Ada\n")
    (tmp_path / "g3" / "grades").mkdir(parents=True)
    (tmp_path / "g3" / "grades" / "ws.csv").write_text("id,name,grade\n1001,Ada,\n")
    in_this_process(monkeypatch)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    "command",
    ["grade h/reports -o h", "grade h/reports --roster gg/class.csv -o gg",
     "grade h/reports --worksheet g3/grades/ws.csv -o g3"],
)  # fmt: skip
def test_grade_refuses_output_folder_that_contains_inputs(class_desk, command) -> None:
    before = file_hashes(class_desk)
    assert "an input of this command" in error_line(*command.split())
    assert file_hashes(class_desk) == before


def test_grade_refuses_output_folder_linked_to_its_inputs(class_desk) -> None:
    (class_desk / "out").mkdir()
    (class_desk / "out" / "reports").symlink_to(class_desk / "h" / "reports")
    before = file_hashes(class_desk)
    assert "an input of this command" in error_line("grade", "h/reports", "-o", "out")
    assert file_hashes(class_desk) == before


def test_second_run_of_grade_command_keeps_pseudonym_file(class_desk) -> None:
    command = ["grade", "h/reports", "--roster", "gg/class.csv", "--anonymous", "-o", "out"]
    run_checked(*command)
    (class_desk / "out" / "overrides.csv").write_text("id,item,points,comment\n1001,,,Good\n")
    before = (class_desk / "out" / "names.csv").read_bytes()
    run_checked(*command)
    assert (class_desk / "out" / "names.csv").read_bytes() == before


def test_compare_refuses_to_write_over_its_answer_form(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(SAMPLES / "aisle_uwb.ulg", "l.ulg")
    run_checked("answers", "l.ulg", "-o", "form.toml")
    before = file_hashes(tmp_path)
    command = "compare l.ulg --answers form.toml --json form.toml"
    assert error_line(*command.split()).startswith("form.toml is an input of this command")
    assert file_hashes(tmp_path) == before


def test_verify_refuses_output_path_that_is_one_of_the_logs(tmp_path, monkeypatch) -> None:
    in_this_process(monkeypatch)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "d").mkdir()
    shutil.copy(SAMPLES / "aisle_uwb.ulg", "d/aisle.ulg")
    shutil.copy(REPORT, "a.pdf")
    before = file_hashes(tmp_path)
    said = error_line("verify", "a.pdf", "d", "--json", "d/aisle.ulg")
    assert said.startswith("d/aisle.ulg is an input of this command")
    assert file_hashes(tmp_path) == before


def test_batch_refuses_output_folder_that_contains_logs(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "d" / "in").mkdir(parents=True)
    shutil.copy(SAMPLES / "aisle_uwb.ulg", "d/in/fleet.ulg")
    for logs in ("d", "d/in/fleet.ulg", "d/*/*.ulg"):
        assert "the output folder d contains" in error_line("batch", logs, "-o", "d")


# --- the register ---


def test_write_to_file_that_was_read_as_input_is_refused(tmp_path) -> None:
    from px4fuse.core.input_files import protect_inputs
    from px4fuse.core.reading import read_text
    from px4fuse.core.writing import write_output_files

    path, other = tmp_path / "a", tmp_path / "b"
    path.write_text("mine")
    with protect_inputs():
        read_text(path, OutputError, 100)
        with pytest.raises(OutputError, match="a is an input"):
            write_output_files({other: b"x", path: b"x"})
        assert not other.exists()
    write_output_files({path: b"x"})
    assert path.read_bytes() == b"x"


def test_input_file_without_inode_number_is_not_overwritten(tmp_path, monkeypatch) -> None:
    """Simulate a file system that ignores case and gives every file the inode 0."""
    from px4fuse.core.input_files import (
        check_output_folder,
        check_outputs,
        protect_inputs,
        register_input_path,
    )

    real, real_names = Path.stat, Path.iterdir

    def lower(path: Path) -> Path:
        return Path(str(path).replace("NOTES", "notes").replace("DIR", "dir"))

    def stat(self: Path, **how: bool) -> os.stat_result:
        found = real(lower(self), **how)
        return os.stat_result((found.st_mode, 0, *found[2:]))

    notes = tmp_path / "dir" / "notes.md"
    notes.parent.mkdir()
    notes.write_text("mine")
    monkeypatch.setattr(Path, "stat", stat)
    monkeypatch.setattr(Path, "iterdir", lambda self: real_names(lower(self)))
    with protect_inputs():
        register_input_path(notes)
        check_outputs([notes.with_name("other.md")])
        with pytest.raises(OutputError):
            check_outputs([notes.with_name("NOTES.md")])
        with pytest.raises(OutputError):
            check_output_folder(tmp_path / "DIR")
