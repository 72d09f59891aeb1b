"""Worker processes for untrusted files, with limits of time and memory for each job.

A job may hang, crash or use all memory without effect on the others. The pools of the standard
library cannot do this: in ``concurrent.futures`` a killed worker ends the whole pool
(BrokenProcessPool), and ``multiprocessing.Pool`` waits forever for the result of a dead worker.
Pebble's pool (5.2) ends if a worker dies before its job was registered. So each process here has a
pipe and a deadline.
"""

import multiprocessing
import os
import pickle
import signal
import threading
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

from px4fuse.errors import Px4FuseError
from px4fuse.threads import ONE_THREAD

Job = TypeVar("Job")
Result = TypeVar("Result")

# A worker is replaced after this number of jobs, because caches of libraries grow. More frequent
# replacement would cost time: the imports of a new process take 2 s
JOBS_PER_WORKER = 80
# maximum time of a job (s); one report of a 10-minute flight takes about 60 s
TIMEOUT_S = 120.0
MEMORY_BYTES = 4_000_000_000
# s for the imports of a new process on a slow and busy computer
START_TIMEOUT_S = 180.0
# Read by a Python interpreter when it starts
_ENVIRONMENT = {
    # without it, an interpreter imports modules from the current folder first: a submitted
    # functools.py would be executed
    "PYTHONSAFEPATH": "1",
    **ONE_THREAD,
}


@dataclass(frozen=True)
class JobFailure:
    """Result of a job that failed, with the reason on one line."""

    reason: str


class _Worker:
    """Worker process, the parent's end of its pipe, and its current job."""

    def __init__(self, function: Callable[[Any], Any], memory_bytes: int | None, job: int) -> None:
        # spawn works on all systems and does not copy the memory of the parent
        context = multiprocessing.get_context("spawn")
        self.pipe, child_pipe = context.Pipe()
        self.process = context.Process(target=_serve, args=(child_pipe, function, memory_bytes))
        environment = dict(os.environ)
        os.environ.update(_ENVIRONMENT)
        try:
            self.process.start()
        finally:
            os.environ.clear()
            os.environ.update(environment)
        child_pipe.close()  # so the pipe is closed when the process ends
        self.is_ready = False
        self.job = job
        self.jobs_done = 0
        self.deadline = time.monotonic() + START_TIMEOUT_S

    def end(self) -> None:
        self.process.kill()
        self.process.join()
        self.process.close()
        self.pipe.close()


def run_bounded(
    function: Callable[[Job], Result],
    jobs: Sequence[Job],
    *,
    processes: int | None = None,
    timeout_s: float = TIMEOUT_S,
    memory_bytes: int | None = MEMORY_BYTES,
) -> Generator[tuple[int, Result | JobFailure]]:
    """Call a function on every job in worker processes, each job within limits.

    If the process of a job hangs, dies or uses too much memory, it is ended and replaced; other
    jobs continue. All processes end with this generator (error, Ctrl-C, ``close``).

    Parameters
    ----------
    function : callable
        Defined at the top level of a module; function, jobs and results are pickled.
    processes : int, optional
        Number of parallel processes; by default the number of cores.
    timeout_s : float
        Time limit for one job, once its process is ready.
    memory_bytes : int or None
        Address space of one process (RLIMIT_AS), of which libraries use about 0.6 GB; None for no
        limit. Without effect on Windows and macOS.

    Yields
    ------
    (int, object)
        Index of a job and its result or :class:`JobFailure`, in the order in which jobs finish.
    """
    waiting_jobs = list(range(len(jobs)))[::-1]
    workers: dict[Connection, _Worker] = {}
    try:
        while waiting_jobs or workers:
            while waiting_jobs and len(workers) < (processes or os.cpu_count() or 1):
                # the job is assigned now, so that a process that fails to start ends only one job
                new_worker = _Worker(function, memory_bytes, waiting_jobs.pop())
                workers[new_worker.pipe] = new_worker
            # wait until the first deadline at most
            first_deadline = min(worker.deadline for worker in workers.values())
            ready_pipes = wait(workers, max(0.0, first_deadline - time.monotonic()))
            for pipe, worker in list(workers.items()):
                if pipe in ready_pipes:
                    is_usable, result = _receive_result(worker)
                    if is_usable and not worker.is_ready:
                        worker.is_ready = True
                    else:
                        yield worker.job, result
                        worker.jobs_done += 1
                        if not is_usable or worker.jobs_done >= JOBS_PER_WORKER or not waiting_jobs:
                            workers.pop(pipe).end()
                            continue
                        worker.job = waiting_jobs.pop()
                    worker.deadline = time.monotonic() + timeout_s
                    # a process that died meanwhile is detected at the next read of its pipe
                    with suppress(BrokenPipeError, ConnectionResetError):
                        pipe.send(jobs[worker.job])
                elif time.monotonic() >= worker.deadline:
                    limit = timeout_s if worker.is_ready else START_TIMEOUT_S
                    workers.pop(pipe).end()
                    yield worker.job, JobFailure(f"the time limit of {limit:g} s was exceeded.")
    finally:
        for worker in workers.values():
            worker.end()


def run_one_bounded(
    function: Callable[[Job], Result], job: Job, timeout_s: float, memory_bytes: int = MEMORY_BYTES
) -> Result | JobFailure:
    """Call a function on one job in a worker process, within limits: see :func:`run_bounded`."""
    results = run_bounded(function, [job], timeout_s=timeout_s, memory_bytes=memory_bytes)
    with closing(results):
        return next(results)[1]


def _receive_result(worker: _Worker) -> tuple[bool, Any]:
    """Return True if the process is usable, and the result that it sent."""
    try:
        message: tuple[bool, Any] = worker.pipe.recv()
    except (EOFError, OSError):
        worker.process.join(5)
        status = f"exit code {worker.process.exitcode}"
        phase = "" if worker.is_ready else " during its start"
        return False, JobFailure(f"the worker process ended{phase} ({status}).")
    # unpickling runs code of the result's classes, which may raise any exception
    except Exception as error:  # noqa: BLE001
        return False, JobFailure(f"the result could not be unpickled ({type(error).__name__}).")
    return message


def _serve(pipe: Connection, function: Callable[[Any], Any], memory_bytes: int | None) -> None:
    """Run the loop of a worker process: job by job until the pipe is closed."""
    # the parent handles Ctrl-C and ends its workers
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _limit_memory(memory_bytes)
    with suppress(EOFError, OSError):  # the parent closed the pipe, or was killed
        pipe.send((True, None))
        while True:
            pipe.send_bytes(_result_of(function, pipe.recv()))


def _result_of(function: Callable[[Any], Any], job: Any) -> bytes:
    """Run a job; return the pickled message for :func:`_receive_result`."""
    try:
        return pickle.dumps((True, function(job)), pickle.HIGHEST_PROTOCOL)
    except MemoryError:
        # the next job would not have enough memory, so the process ends
        failure = JobFailure("the memory limit for one file was exceeded.")
        return pickle.dumps((False, failure))
    except Exception as error:  # noqa: BLE001 - the failure of a job is its result
        # imported here: the import takes 2 s and is needed for errors only
        from px4fuse.results.reading import one_line  # noqa: PLC0415

        kind = "" if isinstance(error, Px4FuseError) else f"{type(error).__name__}: "
        return pickle.dumps((True, JobFailure(one_line(f"{kind}{error}", 300))))


def _end_with_parent() -> None:
    """End this process when its parent ends, even if the parent was killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _limit_memory(memory_bytes: int | None) -> None:
    try:
        import resource  # noqa: PLC0415 - not on Windows
    except ImportError:
        return
    # no core dump: it would contain the file of a student
    for resource_kind, limit in ((resource.RLIMIT_CORE, 0), (resource.RLIMIT_AS, memory_bytes)):
        if limit is not None:
            with suppress(ValueError, OSError):  # macOS refuses some values
                resource.setrlimit(resource_kind, (limit, limit))
