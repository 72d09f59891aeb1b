"""Jobs on a Dask cluster: what hangs, crashes or takes all memory is lost alone."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from importlib import metadata
from typing import TYPE_CHECKING, Any, TypeVar

from px4fuse.errors import LogError, Px4FuseError, SettingsError
from px4fuse.results.reading import one_line

if TYPE_CHECKING:
    from distributed import Client, Future, LocalCluster

Job = TypeVar("Job")
Result = TypeVar("Result")

CONNECT_S = 15.0
# A cluster's machines may come one by one; after so long without any, none will come
WORKERS_S = 120.0
# Until a worker that hangs is killed and, on most machines, has begun again
RESTART_S = 15.0
# How often the clocks of running jobs are looked at
TICK_S = 1.0
# For one result to come from its worker, before the others are looked at
FETCH_S = 10.0
# Of a cluster of this computer, before it is given up
STARTS = 3
# Of the workers that had a job: another log, or another program, may have ended one or two
ENDS = 3
_CONFIG = {
    # one whose worker ended is handed out anew here: Dask may put it behind a job that hangs
    "distributed.scheduler.allowed-failures": 0,
    # after this a worker that is just then being restarted, for the second time, is given up
    "distributed.deploy.lost-worker-timeout": "24 hours",
    # results are small, so all memory is the log's: nothing to spill, and a pause would not help
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    # a worker must not import a module that lies in the folder of the logs
    "distributed.nanny.pre-spawn-environ.PYTHONSAFEPATH": 1,
    # Dask has memory given back at every chance, which costs a comparison a tenth of its time
    "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": None,
}
_START = "Start workers with: dask worker {} --nthreads 1"


@dataclass(frozen=True)
class WorkerFailed:
    """Stands for the result of a job that gave none.

    Attributes
    ----------
    error : Px4FuseError
        Why, and what to do.
    """

    error: Px4FuseError


# What stands for a job whose worker ended each time
_ENDED = WorkerFailed(
    LogError(
        f"the process that read it ended {ENDS} times: it crashed, or needed more memory than it "
        "may take",
        "Give each more with --memory, or look at this log with px4fuse compare.",
    )
)


@contextmanager
def connected(
    scheduler: str | None = None, workers: int | None = None, memory: str = "auto"
) -> Iterator[Client]:
    """A client of the cluster that does the work.

    Parameters
    ----------
    scheduler : str, optional
        Address of a scheduler that runs; without one, the client that this session has, as in a
        notebook, or else a cluster of this computer that lives as long as the context.
    workers : int, optional
        Processes of such a cluster; by default one per core.
    memory : str
        Of each, as "2 GB"; "auto" shares this computer's.

    Raises
    ------
    SettingsError
        Dask is not installed, the scheduler does not answer or has no workers, or its workers
        cannot do this work.
    """
    try:
        import dask  # noqa: PLC0415 - of the extra `batch`
        from dask.utils import parse_bytes  # noqa: PLC0415
        from distributed import Client, default_client  # noqa: PLC0415
        from distributed.utils import silence_logging_cmgr  # noqa: PLC0415
    except ImportError as error:
        raise SettingsError(
            "many logs require Dask", 'Run pip install "px4fuse[batch]".'
        ) from error
    try:
        limit = memory if memory == "auto" else parse_bytes(memory)
    except ValueError as error:
        raise SettingsError(f"`memory` {memory}: not a size", "Give one like 2GB.") from error
    if scheduler is not None:
        try:
            # one that fails must not become the session's own
            client = Client(scheduler, timeout=CONNECT_S, set_as_default=False)
        except (OSError, ValueError) as error:
            raise SettingsError(
                f"`scheduler` {scheduler}: no Dask scheduler answers there "
                f"({one_line(str(error), 120)})",
                "Start one with: dask scheduler",
            ) from error
        # a scheduler that goes is said here, in one line: Dask would print its tracebacks
        with silence_logging_cmgr(logging.CRITICAL), client, client.as_current():
            _check(client, scheduler)
            yield client
        return
    try:
        own = default_client()
    except ValueError:  # this session has none
        pass
    else:
        _check(own, own.scheduler.address)
        yield own
        return
    with (
        dask.config.set(_CONFIG),
        _local_cluster(workers, limit) as cluster,
        Client(cluster) as client,
    ):
        yield client


def _local_cluster(workers: int | None, limit: str | int, tries: int = STARTS) -> LocalCluster:
    """Workers of this computer; tried again where one ends while it starts.

    Raises
    ------
    Px4FuseError
        They do not start.
    """
    from distributed import LocalCluster  # noqa: PLC0415

    try:
        return LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            memory_limit=limit,
            dashboard_address=None,
            # its web server starts all the same, and warns where its usual port is taken
            scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},
            preload=["px4fuse.fleet.job"],
            silence_logs=logging.CRITICAL,
        )
    except RuntimeError as error:
        if tries > 1:
            return _local_cluster(workers, limit, tries - 1)
        raise Px4FuseError(
            f"the workers do not start ({one_line(str(error), 120)})",
            "Give them more memory (--memory), or use fewer (--workers).",
        ) from error


def _check(client: Client, address: str) -> None:
    """Refuse workers that cannot do this work."""
    try:
        client.wait_for_workers(1, timeout=CONNECT_S)
    except TimeoutError as error:
        raise SettingsError(f"{address}: has no workers", f"{_START.format(address)}") from error
    for name, worker in client.scheduler_info(n_workers=-1)["workers"].items():
        # matplotlib draws in one thread only, and what hangs must be ended alone
        if worker["nthreads"] != 1 or worker["nanny"] is None:
            lacks = "no nanny" if worker["nanny"] is None else f"{worker['nthreads']} threads"
            raise SettingsError(
                f"worker {name} has {lacks}; each log requires a process of its own, which can be "
                f"ended",
                f"{_START.format(address)}",
            )
    here = metadata.version("px4fuse")
    for name, there in client.run(metadata.version, "px4fuse", on_error="return").items():
        if there != here:
            other = f"px4fuse {there}" if isinstance(there, str) else "no px4fuse"
            raise SettingsError(
                f"worker {name} has {other}, and this is {here}", "Install the same on both."
            )


@dataclass(frozen=True)
class _BatchRun:
    """A job, how many workers have ended with it, and which has it until when at the latest."""

    job: Any
    ends: int = 0
    address: str = ""
    deadline_s: float = 0.0


def outcomes(
    client: Client,
    function: Callable[[Job], Result],
    jobs: Iterable[Job],
    *,
    timeout_s: float,
) -> Generator[tuple[Job, Result | WorkerFailed]]:
    """Call a function on every job on a cluster, and give what comes of each as it comes.

    A worker gets a job when it has nothing to do, and no other before its result is here: none
    waits behind one that hangs, or is ended with it. Nothing of a finished job is kept.

    Parameters
    ----------
    client : Client
        Of workers with one thread each, and a nanny.
    function : callable
        At the top level of a module.
    timeout_s : float
        For one job.

    Raises
    ------
    Px4FuseError
        The cluster is gone.
    """
    from distributed import CancelledError, wait  # noqa: PLC0415

    waiting = deque(_BatchRun(job) for job in jobs)
    running: dict[Future[Any], _BatchRun] = {}
    seen_s = time.monotonic()
    try:
        while waiting or running:
            workers, now_s = client.processing(), time.monotonic()
            seen_s = now_s if workers else seen_s
            if now_s - seen_s > WORKERS_S:
                raise Px4FuseError("the cluster has lost all its workers.")
            given = {run.address for run in running.values()}
            for address, tasks in workers.items():
                if waiting and not tasks and address not in given:
                    run = waiting.popleft()
                    future = client.submit(function, run.job, pure=False, workers=address)
                    running[future] = replace(run, address=address, deadline_s=now_s + timeout_s)
            with suppress(TimeoutError):
                wait(list(running), timeout=TICK_S, return_when="FIRST_COMPLETED")
            if not running:
                time.sleep(TICK_S)
            yield from _finished(client, running, waiting, timeout_s)
    except (CancelledError, OSError) as error:
        raise Px4FuseError(f"the scheduler is gone ({one_line(str(error), 120)}).") from error
    finally:
        if running and client.status == "running":
            client.cancel(list(running))


def _finished(
    client: Client, running: dict[Future[Any], _BatchRun], waiting: deque[_BatchRun],
    timeout_s: float,
) -> Iterator[tuple[Any, Any]]:  # fmt: skip
    """Take what is over from the running jobs: done, with their worker, or out of time."""
    workers, now_s = client.processing(), time.monotonic()
    for future, run in list(running.items()):
        result: Any
        if future.done():
            try:
                result = _result(future)
            except TimeoutError:  # its worker has begun work of others that does not let it answer
                continue
        elif run.address not in workers:
            result = _ENDED
        elif now_s > run.deadline_s:
            said = f"it took longer than {timeout_s:g} s and was ended"
            result = WorkerFailed(LogError(said, "Allow more with --timeout."))
            client.restart_workers([run.address], timeout=RESTART_S, raise_for_error=False)
        else:
            continue
        if not future.done():
            client.cancel([future])
        del running[future]
        if result is _ENDED and run.ends + 1 < ENDS:
            waiting.appendleft(_BatchRun(run.job, run.ends + 1))
        else:
            yield run.job, result


def _result(future: Future[Any]) -> Any:
    """What a function gave, or why there is nothing."""
    from distributed import KilledWorker  # noqa: PLC0415

    if not _failed(future):
        try:
            return future.result(timeout=FETCH_S)
        except Exception:
            if not _failed(future):  # else its worker ended before its result was here
                raise
    error = future.exception()
    if isinstance(error, KilledWorker):
        return _ENDED
    if isinstance(error, MemoryError):
        error = LogError("it needs more memory than there is", "Use fewer --workers.")
    if not isinstance(error, Px4FuseError):
        said = f"{type(error).__name__}: {one_line(str(error), 300)}"
        error = LogError(said, "Look at it with px4fuse compare.")
    return WorkerFailed(error)


def _failed(future: Future[Any]) -> bool:
    return future.status == "error"
