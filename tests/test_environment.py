"""Unusual environments: commands give a result, or one line with the cause."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from cli_tools import contents, run_main
from conftest import LOG

posix = pytest.mark.skipif(os.name == "nt", reason="folders in use and limits are those of POSIX")


def started(
    arguments: str, *, before: str = "", folder: Path, **environment: str
) -> tuple[int, str, str]:
    """Run px4fuse in a new shell after a shell command; return exit code, output and errors."""
    ended = subprocess.run(
        ["sh", "-c", f'{before} exec "$0" -m px4fuse {arguments}', sys.executable],
        cwd=folder, env=os.environ | environment, capture_output=True, check=False,
    )  # fmt: skip
    return ended.returncode, ended.stdout.decode(), ended.stderr.decode()


@posix
def test_report_ignores_notebook_backend_of_matplotlib(tmp_path) -> None:
    backend = "module://matplotlib_inline.backend_inline"
    code, _, err = started(
        f"loop {LOG.with_name('loop_slam.tum')} -o r.pdf", folder=tmp_path, MPLBACKEND=backend
    )
    assert (code, err) == (0, "")
    assert (tmp_path / "r.pdf").read_bytes().startswith(b"%PDF-")


@posix
def test_info_command_ignores_invalid_source_date_epoch(tmp_path) -> None:
    code, out, err = started(f"info {LOG}", folder=tmp_path, SOURCE_DATE_EPOCH="abc")
    assert (code, err) == (0, "")
    assert out.startswith(LOG.name)


@pytest.mark.parametrize("columns", ["0", "00", "abc", ""])
def test_invalid_terminal_width_in_environment_is_ignored(monkeypatch, capsys, columns) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    usual = run_main(monkeypatch, capsys, "info", LOG)
    monkeypatch.setenv("COLUMNS", columns)
    assert run_main(monkeypatch, capsys, "info", LOG) == usual
    assert usual[1].startswith(LOG.name)


def test_info_with_terminal_width_0_prints_log_name(monkeypatch, capsys) -> None:
    monkeypatch.setenv("COLUMNS", "0")
    monkeypatch.setenv("TTY_COMPATIBLE", "1")
    code, out, _ = run_main(monkeypatch, capsys, "info", LOG)
    assert code == 0
    assert LOG.name in out


@posix
@pytest.mark.parametrize("command", ["compare {log} -o r.pdf", "info {log} --json i.json"])
def test_command_in_deleted_folder_reports_missing_folder(tmp_path, command) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    code, out, err = started(command.format(log=LOG), before='rmdir "$PWD";', folder=gone)
    said = "px4fuse: the current folder no longer exists; nothing was written. "
    assert (code, out, err) == (2, "", f"{said}Change to an existing folder.\n")


def test_command_out_of_memory_prints_one_error_line(monkeypatch, capsys, tmp_path) -> None:
    from px4fuse import diagnose

    def exhausted(*_: object) -> None:
        raise MemoryError("Unable to allocate 7.46 MiB")

    monkeypatch.setattr(diagnose, "read_flight", exhausted)
    monkeypatch.chdir(tmp_path)
    code, out, err = run_main(monkeypatch, capsys, "info", LOG, "--json", "i.json")
    assert (code, out) == (2, "")
    assert err.startswith("px4fuse: not enough memory; nothing was written. Close other programs")
    assert len(err.splitlines()) == 1


@pytest.mark.parametrize("command", ["tune {log} --start 126", "sync {log} --end 3"])
def test_tune_or_sync_command_on_short_segment_writes_no_file(
    monkeypatch, capsys, tmp_path, command
) -> None:
    monkeypatch.chdir(tmp_path)
    words = command.format(log=LOG).split()
    code, out, err = run_main(monkeypatch, capsys, *words, "--json", "j.json")
    assert (code, out, len(err.splitlines())) == (2, "", 1)
    assert "cannot be estimated" in err
    assert contents(tmp_path) == {}
