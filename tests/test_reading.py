"""Reading of inputs: regular files up to a size limit; one error line for all others."""

import os
import shutil
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from cli_tools import run_main
from conftest import REPOSITORY
from time_limit import time_limit

from px4fuse.core import workers
from px4fuse.core.reading import (
    display_name,
    list_files_recursively,
    max_log_bytes,
    read_bytes_limited,
    read_text,
)
from px4fuse.errors import LogError, Px4FuseError
from px4fuse.verification.model import Verification
from px4fuse.verification.verification import log_sha256

SAMPLES = REPOSITORY / "sample_logs"
posix = pytest.mark.skipif(os.name == "nt", reason="devices, pipes and sockets are those of POSIX")


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Files of each kind, a sparse file, a pipe, a device and a socket; tests only read them."""
    folder = tmp_path_factory.mktemp("desk")
    shutil.copy(SAMPLES / "aisle_uwb.ulg", folder / "l.ulg")
    shutil.copy(SAMPLES / "loop_slam.tum", folder / "s.tum")
    shutil.copy(REPOSITORY / "reports" / "example" / "aisle_uwb.pdf", folder / "r.pdf")
    (folder / "roster.csv").write_text("id,name\n1,A\n")
    (folder / "folder").mkdir()
    with (folder / "sparse").open("wb") as file:
        file.write(b"ULog\x01\x12\x35")
        file.truncate(10_000_000_000)
    if os.name == "nt":
        yield folder
        return
    os.mkfifo(folder / "pipe")
    (folder / "zero").symlink_to("/dev/zero")
    with socket.socket(socket.AF_UNIX) as listening:
        here = Path.cwd()
        os.chdir(folder)  # the path of a socket has a maximum length
        listening.bind("socket")
        os.chdir(here)
        yield folder


# Commands that read a file ({}); OF_FOLDERS accept a folder of logs, too
OF_FOLDERS = "verify r.pdf {}", "grade r.pdf --logs {} -o out"
OF_FILES = (
    "info {}", "compare {} -o out/c.pdf", "tune {}", "sync {}", "extract {} -o out", "loop {}",
    "loop {}:vio", "evaluate {} s.tum", "evaluate s.tum {}", "verify {}",
    "info l.ulg --position {}", "compare l.ulg --notes {} -o out/c.pdf",
    "loop s.tum --reference {}", "simulate --assignment {} -o out",
    "simulate --assignment roster.csv --secret-file {} -o out",
    "grade r.pdf --rubric {} -o out", "grade r.pdf --key {} -o out",
)  # fmt: skip
READERS = OF_FILES + OF_FOLDERS


def refusal(monkeypatch, capsys, desk: Path, command: str) -> str:
    """Return the error of a command; assert one line, no other output, and no long wait."""
    monkeypatch.chdir(desk)
    before = sorted(desk.iterdir())
    with time_limit():
        code, out, err = run_main(monkeypatch, capsys, *command.split(" "))
    assert (code, out) == (2, "")
    assert err.startswith("px4fuse: ")
    assert len(err.splitlines()) == 1
    assert sorted(desk.iterdir()) == before
    return err


@posix
@pytest.mark.parametrize("what", ["zero", "pipe", "socket"])
@pytest.mark.parametrize("command", READERS)
def test_reading_a_device_pipe_or_socket_is_refused(
    desk, monkeypatch, capsys, command, what
) -> None:
    err = refusal(monkeypatch, capsys, desk, command.format(what))
    assert f"{what} is a device, pipe or socket" in err


@pytest.mark.parametrize("command", READERS)
def test_file_of_10_gb_is_rejected_without_reading_it(desk, monkeypatch, capsys, command) -> None:
    err = refusal(monkeypatch, capsys, desk, command.format("sparse"))
    assert "sparse: the file has 10,000 MB, more than the limit of " in err


@posix
def test_file_search_by_sha256_ignores_special_and_huge_files(desk, monkeypatch, capsys):
    found = []

    def verify_nothing(work, reports, **_):
        (report,) = reports
        found.append(work.keywords["path_by_sha256"][log_sha256(report)])
        yield 0, Verification("verified", (), with_log=True, page_status="same")

    monkeypatch.setattr(workers, "run_with_limits", verify_nothing)
    monkeypatch.chdir(desk)
    with time_limit():
        code, out, err = run_main(monkeypatch, capsys, "verify", "r.pdf", ".")
    assert (code, err) == (0, "")
    assert "r.pdf: verified" in out
    assert found == [Path("l.ulg")]


# --- the limit, and its option ---


def test_max_size_option_does_not_change_later_commands(desk, monkeypatch, capsys) -> None:
    monkeypatch.chdir(desk)
    assert 1_000_000 < (desk / "l.ulg").stat().st_size < 10_000_000
    before = max_log_bytes.get()
    err = refusal(monkeypatch, capsys, desk, "info l.ulg --max-size 1")
    assert "MB, more than the limit of 1.00 MB" in err
    assert "--max-size MB" in err
    assert max_log_bytes.get() == before
    assert run_main(monkeypatch, capsys, "info", "l.ulg", "--max-size", "10")[0] == 0


def test_file_of_exactly_the_size_limit_is_read_completely(tmp_path) -> None:
    path = tmp_path / "x"
    path.write_bytes(b"x" * 100)
    assert len(read_bytes_limited(path, LogError, 100)) == 100
    with pytest.raises(LogError, match=r"x: the file has 0\.00 MB, more than the limit"):
        read_bytes_limited(path, LogError, 99)


@pytest.mark.skipif(not Path("/proc/kallsyms").exists(), reason="the file is Linux's")
def test_file_with_reported_size_0_is_read_only_up_to_limit() -> None:
    path = Path("/proc/kallsyms")
    assert path.stat().st_size == 0
    with pytest.raises(LogError, match="more than the limit"):
        read_bytes_limited(path, LogError, 1000)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_text_file_in_utf8_or_utf16_is_read(tmp_path, encoding) -> None:
    path = tmp_path / "t"
    path.write_bytes("σ = 1\n".encode(encoding))
    assert read_text(path, LogError, 100) == "σ = 1\n"
    path.write_bytes(b"ab\xff")
    with pytest.raises(LogError, match=r"t is not a text file in UTF-8: the byte at position 2"):
        read_text(path, LogError, 100)


# --- names ---


@posix
@pytest.mark.parametrize("command", READERS)
def test_error_about_file_name_with_line_feed_is_one_line(
    tmp_path, desk, monkeypatch, capsys, command
):
    name = "a\nb\x1b[2J"
    (tmp_path / name).write_bytes(b"\xff\0 junk")
    for other in ("l.ulg", "s.tum", "r.pdf", "roster.csv"):
        (tmp_path / other).symlink_to(desk / other)
    if command in OF_FOLDERS:
        (tmp_path / name).unlink()
    err = refusal(monkeypatch, capsys, tmp_path, command.format(name))
    assert "\x1b" not in err
    assert "a b?[2J" in err


@pytest.mark.parametrize("command", OF_FILES)
@pytest.mark.parametrize("path", ["folder", ".", "..", "/"])
def test_folder_given_as_input_file_is_named_in_the_error(
    desk, monkeypatch, capsys, command, path
) -> None:
    err = refusal(monkeypatch, capsys, desk, command.format(path))
    assert f"{path} is a folder. Give a file." in err


def test_error_message_with_line_feeds_becomes_one_line() -> None:
    assert str(Px4FuseError("a\r\nb c\td\x00\ud800")) == "a  b c d??"
    assert display_name(Path("logs") / "σ.ulg") == "σ.ulg"


def test_file_search_lists_files_without_permission_to_stat_them(tmp_path, monkeypatch):
    (tmp_path / "closed" / "subfolder").mkdir(parents=True)
    file = tmp_path / "closed" / "uwb.csv"
    file.touch()

    def refuse(path, *_, **__):
        raise PermissionError(13, "Permission denied", str(path))

    with monkeypatch.context() as patch:  # as for a folder that can be listed, but not entered
        patch.setattr(os, "stat", refuse)
        patch.setattr(os, "lstat", refuse)
        files = list_files_recursively(tmp_path)
    assert files == [file]
