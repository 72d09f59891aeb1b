"""What the commands write, and what they never write over; what they say about what they read."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from cli_tools import contents, run, run_main
from click.testing import CliRunner
from exchange import replace
from ulog_tools import make_log

from px4fuse.analysis import run_comparison
from px4fuse.cli import cli
from px4fuse.report import fonts, pdf
from px4fuse.request import ComparisonRequest

pytestmark = pytest.mark.usefixtures("analysed_once")

SECONDS = 20.0


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a short log; the commands run there."""
    make_log("v1.16", SECONDS).write(tmp_path / "l.ulg")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(("name", "said"), [("王小明", True), ("Ångström", False)])
def test_a_name_that_no_font_has_is_said_before_the_report(
    desk, monkeypatch, capsys, name: str, said: bool
) -> None:
    told = []

    def render(found: object, results: object, text: str) -> bytes:
        told.append(capsys.readouterr().err)
        return b"%PDF-"

    monkeypatch.setattr(pdf, "render", render)
    monkeypatch.setattr(fonts, "_others", lambda: ())
    fonts.font_of.cache_clear()
    run_main(monkeypatch, capsys, *f"compare l.ulg -o r.pdf --student {name}".split())
    fonts.font_of.cache_clear()
    (before,) = told
    assert (f"No font of this machine has the characters {name}" in before) == said
    assert ("Install a font that has them" in before) == said


@pytest.mark.usefixtures("no_drawing")
@pytest.mark.parametrize(
    "command",
    ["compare l.ulg -o \x1b[31m.pdf", "extract l.ulg -o \x1b[31m", "simulate -o \x1b[31m.ulg",
     "answers l.ulg -o \u202e.toml"],
)  # fmt: skip
def test_what_was_written_is_told_without_acting_on_the_terminal(desk, command: str) -> None:
    told = run(*command.split(" "))
    assert told.exit_code == 0
    assert not {"\x1b", "\u202e"} & set(told.output)
    assert any({"\x1b", "\u202e"} & set(path.name) for path in desk.iterdir())


def test_extract_keeps_the_tables_of_two_logs_apart(desk, monkeypatch, capsys) -> None:
    make_log("v1.14", SECONDS).write(desk / "other.ulg")
    for _ in range(2):  # the same log again
        assert run_main(monkeypatch, capsys, "extract", "l.ulg", "-o", "tables")[0] == 0
    before = contents(desk / "tables")
    code, out, err = run_main(monkeypatch, capsys, "extract", "other.ulg", "-o", "tables")
    assert code == 2
    assert out == ""
    assert len(err.splitlines()) == 1
    assert "l.ulg" in err
    assert contents(desk / "tables") == before
    # the same log under another name is the same log
    (desk / "l.ulg").rename(desk / "renamed.ulg")
    assert run_main(monkeypatch, capsys, "extract", "renamed.ulg", "-o", "tables")[0] == 0


@pytest.mark.parametrize("command", ["info", "extract"])
def test_a_reader_that_leaves_is_no_error(desk, command) -> None:
    """As in px4fuse info LOG | head -1, when head has gone before anything is printed."""
    arguments = [sys.executable, "-m", "px4fuse", command, "l.ulg"]
    arguments += ["-o", "tables"] if command == "extract" else []
    process = subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    complaint = process.stderr.read()
    process.stderr.close()
    assert (process.wait(), complaint) == (0, b"")


# --- --clock-offset auto ---


def test_auto_on_a_flight_without_motion_is_refused_with_the_reason(
    desk, monkeypatch, capsys
) -> None:
    """The made flight goes straight ahead at constant speed: no acceleration, no clock offset."""
    before = contents(desk)
    code, out, err = run_main(monkeypatch, capsys, "compare", "l.ulg", "--clock-offset", "auto")
    assert code == 2
    assert out == ""
    assert len(err.splitlines()) == 1
    assert err.startswith("px4fuse: l.ulg: --clock-offset auto: not determinable: ")
    assert "Give the seconds to add" in err
    assert contents(desk) == before


def test_auto_adds_nothing_where_zero_is_as_good(sample_log) -> None:
    request = ComparisonRequest(log=str(sample_log), clock_offset_s="auto", axes=("north", "east"))
    found = run_comparison(request)
    assert found.settings.clock_offset_s == 0.0
    (said,) = (note for note in found.notes if note.startswith("--clock-offset auto: "))
    assert said.endswith("holds zero: nothing was added to the stamps")


@pytest.mark.reallogs
def test_auto_brings_late_stamps_to_the_truth(shared_logs) -> None:
    request = ComparisonRequest(
        log=str(shared_logs / "simulated" / "v1.16.1_aisle_clock_late.ulg"), axes=("aisle",)
    )
    late, found = (
        run_comparison(replace(request, clock_offset_s=offset_s)) for offset_s in (0.0, "auto")
    )
    assert found.settings.clock_offset_s == pytest.approx(-0.25, abs=0.05)
    before_m, after_m = (one.main.filters["kf"].truth.position_rmse_m for one in (late, found))
    assert after_m < 0.1 < before_m


# ---- places that take no output ------------------------------------------------------------------


@pytest.mark.skipif(os.name != "posix", reason="closes a file descriptor")
@pytest.mark.parametrize("words", ["--help", "lesson kalman"])
def test_a_closed_standard_output_is_no_error(words: str) -> None:
    done = subprocess.run(
        ["sh", "-c", f"{sys.executable} -m px4fuse {words} >&-"],
        stderr=subprocess.PIPE, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, b"")


@pytest.mark.skipif(os.name != "posix", reason="named pipes are of POSIX")
def test_a_pipe_that_nobody_reads_is_not_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sample_log: Path
) -> None:
    monkeypatch.setattr("px4fuse.writing.READER_S", 0.1)
    os.mkfifo(tmp_path / "pipe")
    words = ["info", str(sample_log), "--json", str(tmp_path / "pipe")]
    outcome = CliRunner().invoke(cli, words, standalone_mode=False)
    assert "nobody reads this pipe" in str(outcome.exception)
    words = ["grade", str(tmp_path / "pipe"), "-o", str(tmp_path / "out")]
    outcome = CliRunner().invoke(cli, words, standalone_mode=False)
    assert "no regular file, and no folder" in str(outcome.exception)
