"""Work on what strangers wrote, in processes that may hang, crash or take all memory.

Neither pool of the standard library can do this. ``concurrent.futures`` cannot end one running
job: a worker that is killed breaks the whole pool (BrokenProcessPool). ``multiprocessing.Pool``
waits forever for the result of a worker that died. Pebble's pool (5.2) breaks as a whole, too,
where a worker dies before it was noted which job it has. So: one pipe per process, and a clock.
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

# A worker is replaced after so many jobs: what libraries cache does not grow with the class. A new
# process takes two seconds to import
JOBS_PER_WORKER = 80
# Of one report: a flight of ten minutes takes about one minute; what takes longer is not a report
TIMEOUT_S = 120.0
MEMORY_BYTES = 4_000_000_000
# Until a new process has imported what the function needs, on a slow and busy machine
START_S = 180.0
# Read by an interpreter as it starts, before any code of ours runs
_ENVIRONMENT = {
    # a spawned interpreter looks for modules in the current folder first; who grades there would
    # run a functools.py that was handed in
    "PYTHONSAFEPATH": "1",
    **ONE_THREAD,
}


@dataclass(frozen=True)
class JobFailure:
    """What stands for the result of a job that gave none, and why: one line for a person."""

    reason: str


class _Worker:
    """A process, our end of its pipe, and the job it has."""

    def __init__(self, function: Callable[[Any], Any], memory_bytes: int | None, job: int) -> None:
        # spawn: the same on Windows and macOS, and no copy of the parent's memory
        context = multiprocessing.get_context("spawn")
        self.pipe, child_pipe = context.Pipe()
        self.process = context.Process(target=_serve, args=(child_pipe, function, memory_bytes))
        before = dict(os.environ)
        os.environ.update(_ENVIRONMENT)
        try:
            self.process.start()
        finally:
            os.environ.clear()
            os.environ.update(before)
        child_pipe.close()  # so that the pipe ends when the process does
        self.ready = False
        self.job = job
        self.jobs_done = 0
        self.deadline = time.monotonic() + START_S

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
    """Call a function on every job, in processes of their own, each within bounds.

    A job whose process hangs, dies or takes too much memory is lost alone: its process is ended
    and replaced. Whatever ends this generator (an error, Ctrl-C, its ``close``) ends all processes.

    Parameters
    ----------
    function : callable
        At the top level of a module; pickled, as are jobs and results.
    processes : int, optional
        At once; by default as many as there are cores.
    timeout_s : float
        For one job, once its process is ready.
    memory_bytes : int or None
        Address space of one process (RLIMIT_AS), libraries included, which take about 0.6 GB of it;
        None for no limit. Without effect on Windows, which has no such limit, and on macOS, which
        does not enforce it.

    Yields
    ------
    (int, object)
        Index of a job and its result, :class:`JobFailure` where there is none, in the order in which
        they finish.
    """
    waiting = list(range(len(jobs)))[::-1]
    workers: dict[Connection, _Worker] = {}
    try:
        while waiting or workers:
            while waiting and len(workers) < (processes or os.cpu_count() or 1):
                # given now, sent when the process is ready: a start that fails costs one job
                new_worker = _Worker(function, memory_bytes, waiting.pop())
                workers[new_worker.pipe] = new_worker
            # the latest when somebody's time is up
            first_deadline = min(worker.deadline for worker in workers.values())
            ready_pipes = wait(workers, max(0.0, first_deadline - time.monotonic()))
            for pipe, worker in list(workers.items()):
                if pipe in ready_pipes:
                    is_usable, result = _receive_result(worker)
                    if is_usable and not worker.ready:
                        worker.ready = True
                    else:
                        yield worker.job, result
                        worker.jobs_done += 1
                        if not is_usable or worker.jobs_done >= JOBS_PER_WORKER or not waiting:
                            workers.pop(pipe).end()
                            continue
                        worker.job = waiting.pop()
                    worker.deadline = time.monotonic() + timeout_s
                    # a process that died in between shows at the next look at its pipe
                    with suppress(BrokenPipeError, ConnectionResetError):
                        pipe.send(jobs[worker.job])
                elif time.monotonic() >= worker.deadline:
                    limit = timeout_s if worker.ready else START_S
                    workers.pop(pipe).end()
                    yield worker.job, JobFailure(f"it took longer than {limit:g} s and was ended.")
    finally:
        for worker in workers.values():
            worker.end()


def run_one_bounded(
    function: Callable[[Job], Result], job: Job, timeout_s: float, memory_bytes: int = MEMORY_BYTES
) -> Result | JobFailure:
    """One call in a process of its own, within bounds: see :func:`run_bounded`."""
    work = run_bounded(function, [job], timeout_s=timeout_s, memory_bytes=memory_bytes)
    with closing(work):
        return next(work)[1]


def _receive_result(worker: _Worker) -> tuple[bool, Any]:
    """Whether the process can go on, and what it said."""
    try:
        message: tuple[bool, Any] = worker.pipe.recv()
    except (EOFError, OSError):
        worker.process.join(5)
        how = f"exit code {worker.process.exitcode}"
        when = "" if worker.ready else " before it began"
        return False, JobFailure(f"the process that read it ended{when} ({how}).")
    # unpickling runs what the classes of a result define: anything can go wrong
    except Exception as error:  # noqa: BLE001
        return False, JobFailure(f"its result could not be read ({type(error).__name__}).")
    return message


def _serve(pipe: Connection, function: Callable[[Any], Any], memory_bytes: int | None) -> None:
    """Life of a worker: ready, then job by job until the pipe ends."""
    # Ctrl-C is for the parent, which ends us
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _limit_memory(memory_bytes)
    pipe.send((True, None))
    while True:
        try:
            job = pipe.recv()
        except (EOFError, OSError):
            return
        try:
            message = pickle.dumps((True, function(job)), pickle.HIGHEST_PROTOCOL)
        except MemoryError:
            # the next job would not find enough memory either
            why = JobFailure("it needed more memory than one file may take.")
            message = pickle.dumps((False, why))
        except Exception as error:  # noqa: BLE001 - a job's failure is its result
            # two seconds to import, in every process, for what mostly does not happen
            from px4fuse.results.reading import one_line  # noqa: PLC0415

            kind = "" if isinstance(error, Px4FuseError) else f"{type(error).__name__}: "
            message = pickle.dumps((True, JobFailure(one_line(f"{kind}{error}", 300))))
        del job
        pipe.send_bytes(message)


def _end_with_parent() -> None:
    """Not to hang for ever where the parent was killed and can end nobody."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _limit_memory(memory_bytes: int | None) -> None:
    try:
        import resource  # noqa: PLC0415 - not on Windows
    except ImportError:
        return
    # a crash leaves no memory image of a student's file behind
    for kind, most in ((resource.RLIMIT_CORE, 0), (resource.RLIMIT_AS, memory_bytes)):
        if most is not None:
            with suppress(ValueError, OSError):  # macOS refuses some values
                resource.setrlimit(kind, (most, most))
