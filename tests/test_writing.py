"""Outputs are complete or absent, special files are kept, and messages name files."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from cli_tools import contents, error_line, run, run_checked, run_main
from comparisons import compare_prepared
from conftest import SAMPLES
from exchange import replace
from ulog_tools import make_log

from px4fuse.core import writing
from px4fuse.core.writing import STANDARD_OUTPUT, write_output_files
from px4fuse.diagnose import prepare_comparison, read_flight
from px4fuse.errors import OutputError
from px4fuse.report import fonts, pdf
from px4fuse.request import ComparisonRequest

pytestmark = pytest.mark.usefixtures("cached_analyses")

SECONDS = 20.0
posix = pytest.mark.skipif(os.name == "nt", reason="devices, pipes and signals are those of POSIX")
full = pytest.mark.skipif(not Path("/dev/full").exists(), reason="the device is Linux's")


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a short log and a trajectory; commands run there."""
    make_log("v1.16", SECONDS).write(tmp_path / "l.ulg")
    shutil.copy(SAMPLES / "loop_slam.tum", tmp_path / "s.tum")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def start(desk: Path, *arguments: str, **kwargs) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "px4fuse", *arguments]
    return subprocess.Popen(command, cwd=desk, stderr=subprocess.PIPE, **kwargs)


LOOP = ("loop", "s.tum", "--tum", "c.tum")

# --- special files -------------


@posix
def test_output_to_named_pipe_keeps_the_pipe(desk) -> None:
    pipe = desk / "pipe"
    os.mkfifo(pipe)
    heard = []
    reader = threading.Thread(target=lambda: heard.append(pipe.read_bytes()), daemon=True)
    reader.start()
    run_checked("info", "l.ulg", "--json", "pipe")
    reader.join(10.0)
    assert pipe.is_fifo()
    assert json.loads(heard[0])["log"]["name"] == "l.ulg"
    assert names(desk) == ["l.ulg", "pipe", "s.tum"]


@posix
def test_writing_to_a_device_does_not_replace_the_device(desk) -> None:
    """Use a link, so that a failure replaces the link and not the device."""
    link = desk / "null"
    link.symlink_to(os.devnull)
    write_output_files({link: b"gone"})
    assert link.is_symlink()
    assert Path(os.devnull).is_char_device()


@posix
def test_output_to_socket_is_refused_and_keeps_the_socket(desk) -> None:
    import socket

    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind("socket")
        said = error_line("info", "l.ulg", "--json", "socket")
        assert said.startswith("socket cannot be written")
        assert (desk / "socket").is_socket()


@posix
def test_output_to_symbolic_link_keeps_link_and_writes_target(tmp_path) -> None:
    (tmp_path / "old").write_bytes(b"old")
    for link, target in (("a", "old"), ("b", "new"), ("c", "a")):
        (tmp_path / link).symlink_to(target)
        write_output_files({tmp_path / link: link.encode()})
        assert (tmp_path / link).is_symlink()
        assert (tmp_path / target).read_bytes() == link.encode()
    assert names(tmp_path) == ["a", "b", "c", "new", "old"]
    (tmp_path / "round").symlink_to("round")
    with pytest.raises(OutputError, match="round cannot be written"):
        write_output_files({tmp_path / "round": b""})


@posix
def test_output_to_dev_stdout_appends_to_redirected_file(desk) -> None:
    """Use a link, so that a failure replaces the link and not /dev/stdout."""
    out = desk / "out.txt"
    out.write_bytes(b"before\n")
    (desk / "stdout").symlink_to("/dev/stdout")
    with out.open("ab") as stream:
        process = start(desk, "info", "l.ulg", "--json", "stdout", stdout=stream)
        assert process.communicate()[1] == b""
    text = out.read_bytes()
    assert text.startswith(b"before\n{")
    assert re.search(rb"This log permits: acceleration", text)  # the contents follow


# --- each file complete or not at all ---


def test_output_with_longest_file_name_is_written(tmp_path) -> None:
    path = tmp_path / ("n" * 250 + ".json")
    write_output_files({path: b"x"})
    assert path.read_bytes() == b"x"


def at_rename_to(target: Path, monkeypatch: pytest.MonkeyPatch, act: Callable[[], None]) -> None:
    """Act before the rename to a path."""
    real = Path.replace

    def replace(self: Path, to: Path) -> Path:
        if Path(to) == target:
            act()
        return real(self, to)

    monkeypatch.setattr(Path, "replace", replace)


def raise_permission_error() -> None:
    """Raise the error of Windows for a file that another program has open."""
    raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))


def test_write_error_lists_the_files_already_written(tmp_path, monkeypatch) -> None:
    a, b, c = (tmp_path / name for name in "abc")
    for path in (a, b, c):
        path.write_bytes(b"old")
    at_rename_to(b, monkeypatch, raise_permission_error)
    placed: list[Path] = []
    with pytest.raises(OutputError) as caught:
        write_output_files(dict.fromkeys((a, b, c), b"new"), placed.append)
    said = f"{b} cannot be written (Permission denied); outputs already written: {a}. "
    said += "Choose another output name."
    assert str(caught.value) == said
    assert placed == [a]
    assert contents(tmp_path) == {"a": b"new", "b": b"old", "c": b"old"}
    with pytest.raises(OutputError, match=r"\(Permission denied\)\. Choose"):
        write_output_files({b: b"new"})


def test_full_disk_leaves_no_empty_folder(tmp_path, monkeypatch) -> None:
    def fill() -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    path = tmp_path / "new" / "imu.csv"
    at_rename_to(path, monkeypatch, fill)
    with pytest.raises(OutputError, match="Free disk space"):
        write_output_files({path: b"1"})
    assert not path.parent.exists()


def test_output_to_locked_file_advises_to_close_the_program(tmp_path, monkeypatch) -> None:
    path = tmp_path / "r.pdf"
    path.write_bytes(b"old")
    at_rename_to(path, monkeypatch, raise_permission_error)
    for locks, said in ((True, "Close the program that has the file open, or c"), (False, "C")):
        monkeypatch.setattr(writing, "OPERATING_SYSTEM_LOCKS_OPEN_FILES", locks)
        with pytest.raises(OutputError, match=rf"\. {said}hoose another"):
            write_output_files({path: b"new"})
        assert path.read_bytes() == b"old"


@posix
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_stop_signal_while_writing_leaves_only_complete_files(tmp_path, monkeypatch, name) -> None:
    number = getattr(signal, name)

    def stop(number: int, _: object) -> None:
        raise KeyboardInterrupt(number)

    before = signal.signal(number, stop)
    at_rename_to(tmp_path / "b", monkeypatch, lambda: signal.raise_signal(number))
    (tmp_path / "b").write_bytes(b"old")
    placed: list[Path] = []
    try:
        with pytest.raises(KeyboardInterrupt):
            write_output_files(
                dict.fromkeys((tmp_path / "a", tmp_path / "b"), b"new"), placed.append
            )
    finally:
        signal.signal(number, before)
    assert contents(tmp_path) == {"a": b"new", "b": b"old"}
    assert placed == [tmp_path / "a"]


# --- signals ---


@posix
@pytest.mark.parametrize(("name", "code"), [("SIGINT", 130), ("SIGTERM", 143), ("SIGHUP", 129)])
def test_stop_signal_while_writing_lists_the_written_files(desk, name, code) -> None:
    os.mkfifo(desk / "pipe")  # without a reader the run waits after writing its other file
    number = getattr(signal, name)
    handler = signal.signal(number, signal.SIG_DFL)  # the new process inherits ignored signals
    process = start(desk, *LOOP, "--json", "pipe", stdout=subprocess.PIPE)
    signal.signal(number, handler)
    deadline = time.monotonic() + 60.0
    while len(names(desk)) < 4:
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(number)
    out, err = process.communicate(timeout=30.0)
    assert (process.returncode, out) == (code, b"")
    assert err == b"px4fuse: interrupted; outputs already written: c.tum.\n"
    assert names(desk) == ["c.tum", "l.ulg", "pipe", "s.tum"]


def test_stop_signal_after_writing_lists_the_written_files(desk, monkeypatch, capsys) -> None:
    from px4fuse.report import screen

    def stopped(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(screen, "print_blocks", stopped)
    code, _, err = run_main(monkeypatch, capsys, *LOOP, "--json", "c.json")
    assert (code, err) == (130, "px4fuse: interrupted; outputs already written: c.tum, c.json.\n")
    assert names(desk) == ["c.json", "c.tum", "l.ulg", "s.tum"]


# --- full or closed standard output ---


@full
@pytest.mark.parametrize(
    ("json_path", "left", "there"),
    [
        ("-", "; outputs already written: c.tum.", ["c.tum"]),
        ("c.json", "; outputs already written: c.tum, c.json.", ["c.json", "c.tum"]),
    ],
)
def test_full_disk_at_standard_output_lists_the_written_files(desk, json_path, left, there) -> None:
    with Path("/dev/full").open("wb") as device:
        process = start(desk, *LOOP, "--json", json_path, stdout=device)
        err = process.communicate()[1].decode()
    assert process.returncode == 2
    said = "px4fuse: standard output cannot be written (No space left on device)"
    assert err.startswith(f"{said}{left}")
    assert len(err.splitlines()) == 1
    assert names(desk) == [*there, "l.ulg", "s.tum"]


def test_json_to_closed_pipe_still_writes_the_other_files(desk) -> None:
    process = start(desk, *LOOP, "--json", "-", stdout=subprocess.PIPE)
    process.stdout.close()
    assert process.stderr.read() == b""
    process.stderr.close()
    assert process.wait() == 0
    assert names(desk) == ["c.tum", "l.ulg", "s.tum"]


def test_output_to_existing_folder_name_is_refused(tmp_path, capsysbinary) -> None:
    (tmp_path / "folder").mkdir()
    with pytest.raises(OutputError, match=r"folder cannot be written \(Is a directory\)"):
        write_output_files({tmp_path / "folder": b"", STANDARD_OUTPUT: b"{}"})
    assert capsysbinary.readouterr().out == b""
    write_output_files({tmp_path / "a": b"", STANDARD_OUTPUT: b"{}"})
    assert capsysbinary.readouterr().out == b"{}"


# --- messages, and files that are not overwritten ---


@pytest.mark.parametrize(("name", "said"), [("王小明", True), ("Ångström", False)])
def test_compare_warns_if_no_font_can_print_student_name(
    desk, monkeypatch, capsys, name: str, said: bool
) -> None:
    warnings = []

    def render_pdf(found: object, results: object, text: str) -> bytes:
        warnings.append(capsys.readouterr().err)
        return b"%PDF-"

    monkeypatch.setattr(pdf, "render_pdf", render_pdf)
    monkeypatch.setattr(fonts, "_list_fonts_except_dejavu", lambda: ())
    fonts.find_font.cache_clear()
    run_main(monkeypatch, capsys, *f"compare l.ulg -o r.pdf --student {name}".split())
    fonts.find_font.cache_clear()
    (before,) = warnings
    assert (f"No installed font has the characters {name}" in before) == said
    assert ("Install a font with these" in before) == said


@pytest.mark.usefixtures("no_drawing")
@pytest.mark.parametrize(
    "command",
    ["compare l.ulg -o \x1b[31m.pdf", "extract l.ulg -o \x1b[31m", "simulate -o \x1b[31m.ulg",
     "answers l.ulg -o \u202e.toml"],
)  # fmt: skip
def test_printed_file_names_contain_no_escape_sequences(desk, command: str) -> None:
    warnings = run(*command.split(" "))
    assert warnings.exit_code == 0
    assert not {"\x1b", "\u202e"} & set(warnings.output)
    assert any({"\x1b", "\u202e"} & set(path.name) for path in desk.iterdir())


def test_extract_into_folder_with_other_log_is_refused(desk) -> None:
    make_log("v1.14", SECONDS).write(desk / "other.ulg")
    for _ in range(2):  # the same log again
        run_checked("extract", "l.ulg", "-o", "tables")
    before = contents(desk / "tables")
    assert "l.ulg" in error_line("extract", "other.ulg", "-o", "tables")
    assert contents(desk / "tables") == before
    # the same log under another name is the same log
    (desk / "l.ulg").rename(desk / "renamed.ulg")
    run_checked("extract", "renamed.ulg", "-o", "tables")


@pytest.mark.parametrize("command", ["info", "extract"])
def test_terminal_output_to_closed_pipe_exits_with_0(desk, command) -> None:
    """The reader ends before the first line, as with px4fuse info LOG | head -1."""
    options = ["-o", "tables"] if command == "extract" else []
    process = start(desk, command, "l.ulg", *options, stdout=subprocess.PIPE)
    process.stdout.close()
    complaint = process.stderr.read()
    process.stderr.close()
    assert (process.wait(), complaint) == (0, b"")


# --- --clock-offset auto ---


def test_option_clock_offset_auto_applies_0_if_not_significant(sample_log) -> None:
    request = ComparisonRequest(log=str(sample_log), clock_offset_s="auto", axes=("north", "east"))
    found = compare_prepared(prepare_comparison(read_flight(request), request))
    assert found.settings.clock_offset_s == 0.0
    (said,) = (note for note in found.notes if note.startswith("--clock-offset auto: "))
    low, high = re.search(r"95 % (\S+)(?: s)? to (\S+)", said).groups()
    assert float(low) < 0.0 < float(high)


@pytest.mark.reallogs
def test_option_clock_offset_auto_corrects_late_timestamps(shared_logs) -> None:
    request = ComparisonRequest(
        log=str(shared_logs / "simulated" / "v1.16.1_aisle_clock_late.ulg"), axes=("aisle",)
    )
    late, found = (
        compare_prepared(
            prepare_comparison(read_flight(request), replace(request, clock_offset_s=offset_s))
        )
        for offset_s in (0.0, "auto")
    )
    assert found.settings.clock_offset_s == pytest.approx(-0.25, abs=0.05)
    before_m, after_m = (one.main.filters["kf"].truth.position_rmse_m for one in (late, found))
    assert after_m < 0.1 < before_m


# ---- outputs that cannot be written --------------------------------------------------------------


@posix
@pytest.mark.parametrize("words", ["--help", "lesson kalman"])
def test_command_with_closed_standard_output_exits_with_0(words: str) -> None:
    command = ["sh", "-c", f"{sys.executable} -m px4fuse {words} >&-"]
    ended = subprocess.run(command, stderr=subprocess.PIPE, check=False)
    assert (ended.returncode, ended.stderr) == (0, b"")


@posix
def test_grade_command_with_named_pipe_as_input_is_refused(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    assert "is not a file or folder" in error_line("grade", pipe, "-o", tmp_path / "out")
