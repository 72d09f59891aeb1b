"""What dies on purpose takes nothing with it: workers, schedulers, whole runs."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import batch_tools
import pandas as pd
import psutil
import pytest
from batch_tools import act, started, tiny_logs
from cli_tools import run

from px4fuse.errors import Px4FuseError
from px4fuse.fleet.engine import connected, outcomes

PX4FUSE = [sys.executable, "-m", "px4fuse"]


def kill_workers(most: int, stop: threading.Event) -> None:
    """Kill so many processes as soon as they are seen to start."""
    killed: set[int] = set()
    while not stop.is_set() and len(killed) < most:
        for child in psutil.Process().children(recursive=True):
            try:
                starts = "spawn_main" in " ".join(child.cmdline())
                if starts and child.pid not in killed and len(killed) < most:
                    child.kill()
                    killed.add(child.pid)
            except psutil.Error:  # it has ended by itself
                continue
        time.sleep(0.02)


@pytest.mark.parametrize(("most", "works"), [(1, True), (1000, False)])
def test_a_worker_that_ends_while_it_starts_is_started_again(most: int, works: bool) -> None:
    stop = threading.Event()
    thread = threading.Thread(target=kill_workers, args=(most, stop))
    thread.start()
    try:
        if works:
            with connected(workers=1) as client:
                found = dict(outcomes(client, act, [("square", 3)], timeout_s=60.0))
            assert found == {("square", 3): 9}
        else:
            with (
                pytest.raises(Px4FuseError, match="the workers do not start"),
                connected(workers=1),
            ):
                pass
    finally:
        stop.set()
        thread.join()


def test_a_scheduler_that_goes_is_said_on_one_line(tmp_path: Path) -> None:
    """Its process is ended while a log is being compared."""
    logs, out = tiny_logs(tmp_path / "logs", 6), tmp_path / "out"
    scheduler = ("scheduler", "--port", "0", "--dashboard-address", ":0", "--host", "127.0.0.1")
    worker = ("--nthreads", "1", "--no-dashboard", "--host", "127.0.0.1")
    with started(*scheduler, says="Scheduler at:", log=tmp_path / "scheduler") as line:
        address = line.split()[-1]
        with started("worker", address, *worker, says="Starting Worker plugin", log=tmp_path / "w"):
            process = subprocess.Popen(
                [*PX4FUSE, "batch", logs, "-o", out, "--scheduler", address], text=True,
                stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, env=batch_tools.environment(),
            )  # fmt: skip
            while not list(out.glob("results/*.json")):
                assert process.poll() is None
                time.sleep(0.05)
            port = int(address.rpartition(":")[2])
            (owner,) = {
                one.pid
                for one in psutil.net_connections("tcp")
                if one.status == psutil.CONN_LISTEN and one.laddr.port == port
            }
            psutil.Process(owner).kill()
            _, said = process.communicate(timeout=120)
    assert process.returncode == 2
    assert said.startswith("px4fuse: the scheduler is gone (")
    assert said.endswith("What is done is kept: the same command goes on from there.\n")
    assert said.count("\n") == 1


def test_two_runs_in_one_folder(tmp_path: Path) -> None:
    """Both end well, and what they leave is one whole table."""
    logs, out = tiny_logs(tmp_path / "logs", 3), tmp_path / "out"
    command = [*PX4FUSE, "batch", logs, "-o", out, "--workers", "1"]
    both = [
        subprocess.Popen(command, text=True, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL,
                         env=batch_tools.environment())
        for _ in range(2)
    ]  # fmt: skip
    for process in both:
        _, said = process.communicate(timeout=300)
        assert (process.returncode, said) in {(0, ""), (2, said)}
        assert "Traceback" not in said
        assert said.count("\n") <= 1
    assert 0 in {process.returncode for process in both}
    table = pd.read_parquet(out / "fleet.parquet")
    assert table.groupby("name")["status"].unique().map(list).to_dict() == {
        f"f{number}.ulg": ["done"] for number in (1, 2, 3)
    }


def test_junk_in_thousands_costs_a_line_each(tmp_path: Path) -> None:
    folder = tmp_path / "logs"
    folder.mkdir()
    for number in range(300):
        rng = random.Random(number)
        (folder / f"{number}.ulg").write_bytes(rng.randbytes(rng.choice((0, 7, 200, 5000))))
    done = run("batch", folder, "-o", tmp_path / "out", "--workers", "2")
    assert done.exit_code == 0, done.output
    table = pd.read_parquet(tmp_path / "out" / "fleet.parquet")
    assert len(table) == 300
    assert set(table["status"]) <= {"failed", "not judged"}
    assert table["reason"].str.len().between(10, 300).all()


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGINT for one process")
@pytest.mark.parametrize("after_s", [0.8, 1.2, 1.6, 2.1, 2.7])
def test_an_interrupted_comparison_leaves_nothing_in_part(
    after_s: float, tmp_path: Path, sample_log: Path
) -> None:
    report = tmp_path / "r.pdf"
    process = subprocess.Popen(
        [*PX4FUSE, "compare", sample_log, "-o", report], text=True, stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL, env=batch_tools.environment(),
    )  # fmt: skip
    time.sleep(after_s)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=120)
    assert "Traceback" not in said
    left = sorted(path.name for path in tmp_path.iterdir())
    if process.returncode == 0:  # it was done before
        assert left == ["r.json", "r.pdf"]
    else:
        assert left == []
        # by the signal itself where Python is not up yet, or CPython was in exec() (an import)
        by_signal = process.returncode == -signal.SIGINT
        assert process.returncode == 130 or by_signal
        assert said == "px4fuse: interrupted, nothing was written.\n" or (by_signal and not said)
