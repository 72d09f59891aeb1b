"""Worker processes for untrusted files, with limits of time and memory for each job.

A job may hang, crash or use all memory without effect on other jobs.
Process pools are not suitable, because they stop or wait forever if one process is killed.
"""

import math
import multiprocessing
import os
import pickle
import signal
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

from px4fuse.errors import Px4FuseError

from .text import shorten_to_line
from .threads import ONE_THREAD_ENVIRONMENT

Job = TypeVar("Job")
Result = TypeVar("Result")

# Maximum number of jobs of a worker process, because caches of libraries grow
MAX_JOBS_PER_WORKER = 80
# Default limits of time (s) and memory (bytes) for each job
JOB_TIMEOUT_S, MAX_MEMORY_BYTES = 120.0, 4_000_000_000
# Maximum time (s) for the start of a worker process
WORKER_START_TIMEOUT_S = 180.0
# PYTHONSAFEPATH: do not import Python files of students from the current folder
_WORKER_ENVIRONMENT = {"PYTHONSAFEPATH": "1", **ONE_THREAD_ENVIRONMENT}


@dataclass(frozen=True)
class JobFailure:
    """Reason why a job in a worker process failed, returned instead of its result."""

    reason: str


class _Worker:
    """Worker process with its current job, and the pipe for jobs and results."""

    def __init__(
        self, function: Callable[[Any], Any], max_memory_bytes: int | None, job_index: int
    ) -> None:
        """Start a worker process for ``function``; ``job_index`` is the index of its first job."""
        # spawn works on all systems and does not copy the memory of this process
        context = multiprocessing.get_context("spawn")
        self.pipe, child_pipe = context.Pipe()
        self.process = context.Process(
            target=_run_worker, args=(child_pipe, function, max_memory_bytes)
        )
        previous_environment = dict(os.environ)
        os.environ.update(_WORKER_ENVIRONMENT)
        try:
            with _block_interrupts():
                self.process.start()
        finally:
            os.environ.clear()
            os.environ.update(previous_environment)
        child_pipe.close()  # otherwise the pipe stays open after the end of the worker process
        self.is_ready = False
        self.job_index = job_index
        self.finished_count = 0
        self.deadline = time.monotonic() + WORKER_START_TIMEOUT_S

    def terminate(self) -> None:
        self.process.kill()
        self.process.join()
        self.process.close()
        self.pipe.close()

    def send(self, job: object, timeout_s: float) -> None:
        """Start a job, which may last ``timeout_s``."""
        self.deadline = time.monotonic() + timeout_s
        # a dead worker process is found at the next read of its pipe
        with suppress(BrokenPipeError, ConnectionResetError):
            self.pipe.send(job)


@contextmanager
def _block_interrupts() -> Iterator[None]:
    """Block Ctrl-C in this process and in processes that it starts."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    # The start of the resource tracker would unblock Ctrl-C
    resource_tracker.ensure_running()
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


def run_with_limits(
    function: Callable[[Job], Result],
    jobs: Sequence[Job],
    *,
    process_count: int | None = None,
    timeout_s: float = JOB_TIMEOUT_S,
    max_memory_bytes: int | None = MAX_MEMORY_BYTES,
) -> Generator[tuple[int, Result | JobFailure]]:
    """Call a function on every job in worker processes, with limits of time and memory.

    A process that hangs, dies or uses too much memory is replaced. The other jobs continue.

    Parameters
    ----------
    function : callable
        Function at the top level of a module (it is pickled).
    process_count : int, optional
        Number of parallel processes; by default the number of cores.
    timeout_s : float
        Maximum time for one job.
    max_memory_bytes : int or None
        Maximum address space of one process on Linux; None for no limit.

    Yields
    ------
    (int, object)
        Index of a finished job, and its result or :class:`JobFailure`.
    """
    with closing(
        poll_with_limits(function, jobs, process_count, timeout_s, max_memory_bytes)
    ) as outcomes:
        yield from (outcome for outcome in outcomes if outcome is not None)


def poll_with_limits(
    function: Callable[[Job], Result],
    jobs: Sequence[Job],
    process_count: int | None,
    timeout_s: float,
    max_memory_bytes: int | None,
    max_wait_s: float = math.inf,
) -> Generator[tuple[int, Result | JobFailure] | None]:
    """Yield the results of jobs, and None if no job ends within ``max_wait_s``."""
    waiting_indices = list(range(len(jobs)))[::-1]
    workers: dict[Connection, _Worker] = {}
    try:
        while waiting_indices or workers:
            while waiting_indices and len(workers) < (process_count or os.cpu_count() or 1):
                # if the process does not start, only this job fails
                new_worker = _Worker(function, max_memory_bytes, waiting_indices.pop())
                workers[new_worker.pipe] = new_worker
            first_deadline = min(worker.deadline for worker in workers.values())
            remaining_s = max(0.0, first_deadline - time.monotonic())
            ready_pipes = wait(workers, min(remaining_s, max_wait_s))
            if not ready_pipes and remaining_s > 0.0:
                yield None
            for pipe, worker in list(workers.items()):
                # 1. The worker process sent a message, or ended
                if pipe in ready_pipes:
                    is_usable, result = _receive_result(worker)
                    if is_usable and not worker.is_ready:
                        # The first message is not a result: the process is ready for its job
                        worker.is_ready = True
                        worker.send(jobs[worker.job_index], timeout_s)
                        continue
                # The start or the job of the worker exceeds its time limit
                elif time.monotonic() >= worker.deadline:
                    is_usable = False
                    time_limit_s = timeout_s if worker.is_ready else WORKER_START_TIMEOUT_S
                    result = JobFailure(f"the job exceeded the time limit of {time_limit_s:g} s.")
                # The worker is still running
                else:
                    continue
                # The job is finished: use the worker process for the next job, or end it
                outcome = worker.job_index, result
                worker.finished_count += 1
                if is_usable and waiting_indices and worker.finished_count < MAX_JOBS_PER_WORKER:
                    worker.job_index = waiting_indices.pop()
                    worker.send(jobs[worker.job_index], timeout_s)
                else:
                    workers.pop(pipe).terminate()
                yield outcome
    finally:
        for worker in workers.values():
            worker.terminate()


def run_one_with_limits(
    function: Callable[[Job], Result],
    job: Job,
    timeout_s: float,
    max_memory_bytes: int = MAX_MEMORY_BYTES,
) -> Result | JobFailure:
    """Call a function on one job in a worker process, with limits of time and memory."""
    [(_, outcome)] = run_with_limits(
        function, [job], timeout_s=timeout_s, max_memory_bytes=max_memory_bytes
    )
    return outcome


def _receive_result(worker: _Worker) -> tuple[bool, Any]:
    """Return the next message of a worker: a flag, and the result of its job."""
    try:
        message: tuple[bool, Any] = worker.pipe.recv()
    except (EOFError, OSError):
        worker.process.join(5)
        phase = "a job" if worker.is_ready else "its start"
        return False, JobFailure(
            f"the worker process ended during {phase} (exit code {worker.process.exitcode})."
        )
    # unpickling may raise any exception
    except Exception as error:  # noqa: BLE001
        return False, JobFailure(f"the result of the job cannot be read ({type(error).__name__}).")
    return message


def _run_worker(
    pipe: Connection, function: Callable[[Any], Any], max_memory_bytes: int | None
) -> None:
    """Receive and run jobs in a worker process, until its pipe is closed."""
    # the parent process handles Ctrl-C and ends its worker processes
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _limit_memory(max_memory_bytes)
    with suppress(EOFError, OSError):  # the parent process closed the pipe, or was killed
        pipe.send((True, None))
        while True:
            pipe.send_bytes(_run_and_pickle(function, pipe.recv()))


def _run_and_pickle(function: Callable[[Any], Any], job: Any) -> bytes:
    """Run a job; return a pickled pair of a flag and the result.

    The flag is False if the memory was not sufficient. The parent process must then end this worker
    process, because it would not have enough memory for the next job.
    """
    try:
        return pickle.dumps((True, function(job)), pickle.HIGHEST_PROTOCOL)
    except MemoryError:
        return pickle.dumps((False, JobFailure("the job exceeded the memory limit for one file.")))
    except Exception as error:  # noqa: BLE001 - the failure of a job is its result
        error_prefix = "" if isinstance(error, Px4FuseError) else f"{type(error).__name__}: "
        return pickle.dumps((True, JobFailure(shorten_to_line(f"{error_prefix}{error}", 300))))


def _end_with_parent() -> None:
    """End this worker process when its parent process ends or is killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _limit_memory(max_memory_bytes: int | None) -> None:
    """Limit the memory of this process (bytes; None: no limit), and disable core dumps."""
    try:
        import resource  # noqa: PLC0415 - not on Windows
    except ImportError:
        return
    # no core dump, which would contain data of a student
    for resource_kind, limit in ((resource.RLIMIT_CORE, 0), (resource.RLIMIT_AS, max_memory_bytes)):
        if limit is not None:
            with suppress(ValueError, OSError):  # macOS rejects some limits
                resource.setrlimit(resource_kind, (limit, limit))
