"""Worker processes: a job that hangs, crashes or uses too much memory fails alone."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
from contextlib import closing

import pytest
from failing_jobs import run_job

from px4fuse.core import workers
from px4fuse.core.workers import JobFailure, run_with_limits

MEMORY = 1_500_000_000


def run(jobs, processes=2, timeout_s=60.0, max_memory_bytes=None):
    outcomes = list(
        run_with_limits(
            run_job,
            jobs,
            process_count=processes,
            timeout_s=timeout_s,
            max_memory_bytes=max_memory_bytes,
        )
    )
    assert not multiprocessing.active_children()
    assert [index for index, _ in sorted(outcomes, key=lambda outcome: outcome[0])] == [
        *range(len(jobs))
    ]
    return [result for _, result in sorted(outcomes, key=lambda outcome: outcome[0])], outcomes


def test_worker_job_that_fails_does_not_affect_other_jobs():
    before = os.environ.get("OMP_NUM_THREADS")
    jobs = [
        ("square", 1),
        ("exit", 3),
        ("raise", "a\nb\x1b[2J"),
        ("square", 2),
        ("own error", "x.ulg: empty."),
        ("local", 1),
        ("unreadable", 0),
        ("big", 30_000_000),
        ("variable", "OMP_NUM_THREADS"),
        ("exit", 0),
        ("square", 3),
    ]
    results, _ = run(jobs)
    assert [results[n] for n in (0, 3, 10)] == [1, 4, 9]
    assert results[1] == JobFailure("the worker process ended during a job (exit code 3).")
    assert results[2] == JobFailure("ValueError: a b[2J")
    assert results[4] == JobFailure("x.ulg: empty.")
    assert isinstance(results[5], JobFailure)
    assert results[6] == JobFailure("the result of the job cannot be read (ValueError).")
    assert results[7] == bytes(30_000_000)
    assert results[8] == "1"
    assert results[9] == JobFailure("the worker process ended during a job (exit code 0).")
    assert os.environ.get("OMP_NUM_THREADS") == before


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no signal masks")
def test_worker_process_starts_with_blocked_ctrl_c():
    assert run([("blocks Ctrl-C", None)])[0] == [True]
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, [])


def test_worker_job_that_hangs_ends_at_time_limit():
    results, _ = run([("hang", 0), ("square", 2), ("hang", 0), ("square", 3)], timeout_s=3.0)
    assert results[1::2] == [4, 9]
    late = JobFailure("the job exceeded the time limit of 3 s.")
    assert results[0::2] == [late, late]


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not enforce the limit")
def test_worker_job_above_memory_limit_is_ended():
    jobs = [("square", 2), ("hog", 10 * MEMORY), ("square", 3)]
    results, _ = run(jobs, processes=1, max_memory_bytes=MEMORY)
    assert results == [4, JobFailure("the job exceeded the memory limit for one file."), 9]
    # after a memory error the process is replaced
    jobs = [("process", 0), ("hog", 10 * MEMORY), ("process", 0)]
    (before, _, after), _ = run(jobs, processes=1, max_memory_bytes=MEMORY)
    assert before != after


def test_worker_process_is_replaced_after_maximum_job_count(monkeypatch):
    monkeypatch.setattr(workers, "MAX_JOBS_PER_WORKER", 2)
    results, _ = run([("process", 0)] * 5, processes=1)
    assert len(set(results)) == 3
    assert results[0] == results[1] != results[2]


def test_all_jobs_fail_if_worker_cannot_import_the_function(monkeypatch):
    monkeypatch.setattr(run_job, "__module__", "test_workers_is_not_here")
    monkeypatch.setitem(sys.modules, "test_workers_is_not_here", sys.modules[__name__])
    results, _ = run([("square", 1), ("square", 2)])
    assert all(
        isinstance(result, JobFailure) and "during its start" in result.reason for result in results
    )


def test_closing_the_worker_pool_ends_all_processes():
    jobs = [("square", 1), ("hang", 0)]
    with closing(
        run_with_limits(run_job, jobs, process_count=2, timeout_s=60, max_memory_bytes=None)
    ) as work:
        assert next(work) == (0, 1)
    assert not multiprocessing.active_children()


INTERRUPTED = """
import os, sys, time
sys.path.insert(0, {tests!r})
from px4fuse.core.workers import run_with_limits
from failing_jobs import run_job

if __name__ == "__main__":
    for _, result in run_with_limits(run_job, [("process", 0), ("hang", 0)], process_count=1,
                                     timeout_s=500, max_memory_bytes=None):
        print(result, flush=True)
"""


def hanging(folder):
    """Start a program that prints the id of its worker process, which then hangs."""
    script = folder / "script.py"
    script.write_text(INTERRUPTED.format(tests=os.path.dirname(__file__)))  # noqa: PTH120
    pipe = subprocess.PIPE
    return subprocess.Popen([sys.executable, script], stdout=pipe, stderr=pipe, text=True)


def test_worker_process_does_not_import_from_current_folder(tmp_path):
    """A submitted types.py must not be executed if grade runs in its folder."""
    script = tmp_path / "program" / "script.py"
    script.parent.mkdir()
    script.write_text(INTERRUPTED.format(tests=os.path.dirname(__file__)).replace("hang", "square"))  # noqa: PTH120
    work = tmp_path / "work"
    work.mkdir()
    for name in ("types", "functools", "multiprocessing", "numpy", "threading", "sitecustomize"):
        (work / f"{name}.py").write_text("open('executed', 'w').close()")
    ran = subprocess.run(
        [sys.executable, script], cwd=work, capture_output=True, text=True, check=True, timeout=60
    )
    assert ran.stdout.splitlines()[-1] == "0"
    assert not (work / "executed").exists()


def test_worker_with_closed_pipe_ends_without_traceback():
    script = """if True:
        from multiprocessing import Pipe
        from px4fuse.core.workers import _run_worker
        parent, worker = Pipe()
        parent.close()
        _run_worker(worker, len, None)
    """
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, timeout=60, check=False
    )
    assert (done.returncode, done.stderr) == (0, b"")


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGKILL")
def test_killing_the_parent_process_ends_a_hanging_worker(tmp_path):
    with hanging(tmp_path) as parent:
        parent.stdout.readline()
        parent.kill()
        # the pipes are closed when the last worker has ended
        parent.communicate(timeout=30)


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGINT for one process")
def test_ctrl_c_ends_a_hanging_worker_job(tmp_path):
    with hanging(tmp_path) as parent:
        worker = int(parent.stdout.readline())
        parent.send_signal(signal.SIGINT)
        _, said = parent.communicate(timeout=60)
    assert "KeyboardInterrupt" in said
    with pytest.raises(ProcessLookupError):
        os.kill(worker, 0)
