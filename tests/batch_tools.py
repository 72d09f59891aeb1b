"""Helpers for tests of many logs: small flights, failing jobs, Dask processes."""

from __future__ import annotations

import hashlib
import os
import pickle
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

import failing_jobs

from px4fuse.batch import job

REPOSITORY = Path(__file__).resolve().parents[1]


def tiny_log(seed: int, **options: object) -> bytes:
    """Return the log of a simulated flight of 15 s, which compare analyses within 1 s."""
    from px4fuse.simulation.flights import simulate, to_ulog  # workers import this file
    from px4fuse.simulation.scenario import Scenario

    return to_ulog(simulate(Scenario(seed=seed, passes=1, length_m=6.0, ekf2=False, **options)))


def tiny_logs(folder: Path, count: int, **options: object) -> Path:
    folder.mkdir()
    for seed in range(1, count + 1):
        (folder / f"f{seed}.ulg").write_bytes(tiny_log(seed, **options))
    return folder


class Clock:
    """Clock that can be set ahead, so that a time limit passes without waiting."""

    ahead_s = 0.0

    def monotonic(self) -> float:
        return time.monotonic() + self.ahead_s


def analyse(work: job.Job) -> job.LogOutcome:
    """Analyse a log like the worker; a log named "hang" never ends, one named "crash" crashes."""
    name = Path(work.log.address).stem
    if name in ("hang", "crash"):
        failing_jobs.run_job(("hang", 0) if name == "hang" else ("exit", 3))
    return analyse_cached(work)


# Environment variable with the folder of cached analyses
MEMORY = "PX4FUSE_TESTS_MEMORY"


def analyse_cached(work: job.Job) -> job.LogOutcome:
    """Analyse a log like the worker, or return the cached result of the same log."""
    with mock.patch.object(job, "_compare_log", _compare_cached):  # other tests use the same worker
        return job.analyse(work)


_compare_log = job._compare_log


def _compare_cached(work: job.Job, path: Path, sha256: str) -> job.LogOutcome:
    known = repr((path.name, sha256, work.request, work.writes_report))
    kept = Path(os.environ[MEMORY]) / hashlib.sha256(known.encode()).hexdigest()
    if not kept.is_file():
        outcome = _compare_log(work, path, sha256)
        kept.with_suffix(f".{os.getpid()}").write_bytes(pickle.dumps(outcome))
        kept.with_suffix(f".{os.getpid()}").replace(kept)
    return pickle.loads(kept.read_bytes())


def environment(**more: str) -> dict[str, str]:
    return os.environ | {"PYTHONPATH": str(REPOSITORY)} | more


@contextmanager
def start_dask(*command: str, says: str, log: Path, **more: str) -> Iterator[str]:
    """Start a Dask process; yield the line of its output that contains ``says``."""
    with (
        log.open("w") as file,
        subprocess.Popen(
            [sys.executable, "-m", "dask", *command], stderr=file, env=environment(**more)
        ) as process,
    ):
        try:
            yield _line(process, log, says)
        finally:
            process.terminate()


def _line(process: subprocess.Popen[bytes], log: Path, says: str) -> str:
    while process.poll() is None:
        for line in log.read_text().splitlines():
            if says in line:
                return line
        time.sleep(0.1)
    raise AssertionError(log.read_text())
