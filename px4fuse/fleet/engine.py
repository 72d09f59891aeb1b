"""Jobs in bounded processes of this computer, or spread by Dask over a cluster.

Either way a job runs in a process of :mod:`px4fuse.workers`, which may hang, crash or
take all memory: a cluster's workers only start these.
"""

from __future__ import annotations

import logging
import multiprocessing
import sys
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from importlib import metadata
from typing import TYPE_CHECKING, Any

from px4fuse.errors import Px4FuseError, SettingsError
from px4fuse.results.reading import one_line
from px4fuse.workers import Job, JobFailure, Result

if TYPE_CHECKING:
    from distributed import Client

CONNECT_S = 15.0
# Jobs that a cluster's worker takes at once: to import what they need takes a process 2 s
JOBS_PER_TASK = 4


@contextmanager
def connect_cluster(scheduler: str | None = None) -> Iterator[Client | None]:
    """A client of the cluster that does the work; None where this computer does it.

    Parameters
    ----------
    scheduler : str, optional
        Address of a Dask scheduler that runs; without one, the client that this session has, as in
        a notebook, or none.

    Raises
    ------
    SettingsError
        Dask is not installed, the scheduler does not answer or has no workers, or its workers
        have another px4fuse.
    """
    if scheduler is None:
        client = _session_client()
        if client is not None:
            _check(client)
        yield client
        return
    try:
        from distributed import Client  # noqa: PLC0415 - of the extra `batch`
        from distributed.utils import silence_logging_cmgr  # noqa: PLC0415
    except ImportError as error:
        raise SettingsError.of("no_dask") from error
    try:
        # one that fails must not become the session's own
        client = Client(scheduler, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise SettingsError.of(
            "no_scheduler", scheduler=scheduler, why=one_line(str(error), 120)
        ) from error
    # a scheduler that goes is said here, in one line: Dask would print its tracebacks
    with silence_logging_cmgr(logging.CRITICAL), client, client.as_current():
        _check(client)
        yield client


def _session_client() -> Client | None:
    if "distributed" not in sys.modules:
        return None
    from distributed import default_client  # noqa: PLC0415

    try:
        client: Client = default_client()
    except ValueError:  # this session has none
        return None
    return client


def _check(client: Client) -> None:
    """Refuse workers that cannot do this work."""
    address = client.scheduler_info()["address"]
    try:
        client.wait_for_workers(1, timeout=CONNECT_S)
    except TimeoutError as error:
        raise SettingsError.of("no_workers", address=address) from error
    here = metadata.version("px4fuse")
    for name, worker_version in client.run(metadata.version, "px4fuse", on_error="return").items():
        if worker_version != here:
            other = f"px4fuse {worker_version}" if isinstance(worker_version, str) else "no px4fuse"
            raise SettingsError.of("worker_of_another", name=name, other=other, here=here)


def run_jobs(
    client: Client | None,
    work: Callable[..., Iterator[tuple[int, Result | JobFailure]]],
    jobs: Sequence[Job],
    processes: int | None = None,
) -> Generator[tuple[Job, Result | JobFailure]]:
    """What comes of every job, as it comes.

    Parameters
    ----------
    client : Client or None
        Of a cluster; None for processes of this computer.
    work : callable
        :func:`~px4fuse.workers.run_bounded` with its function and bounds.
    processes : int, optional
        At once on this computer; by default one per core.

    Raises
    ------
    Px4FuseError
        The cluster is gone.
    """
    if client is None:
        for index, result in work(jobs, processes=processes):
            yield jobs[index], result
        return
    from distributed import as_completed  # noqa: PLC0415

    chunks = [jobs[start : start + JOBS_PER_TASK] for start in range(0, len(jobs), JOBS_PER_TASK)]
    futures = dict(
        zip(client.map(partial(_run_several, work), chunks, pure=False), chunks, strict=True)
    )
    try:
        for future in as_completed(list(futures)):
            chunk = futures.pop(future)
            if future.status not in ("finished", "error"):
                raise Px4FuseError("the scheduler is gone.")
            error = future.exception()  # its worker ended several times, or cannot load the job
            failed = JobFailure(one_line(f"{type(error).__name__}: {error}", 300))
            results = [failed] * len(chunk) if error else future.result()
            yield from zip(chunk, results, strict=True)
    finally:
        if futures and client.status == "running":
            client.cancel(list(futures))


def _run_several(work: Callable[..., Iterator[tuple[int, Any]]], jobs: Sequence[Any]) -> list[Any]:
    """What a cluster's worker does: some jobs, one by one in a process apart from its own."""
    # by Dask's default a worker's process is a daemon, which may have no children
    multiprocessing.current_process().daemon = False
    results_by_index = dict(work(jobs, processes=1))
    return [results_by_index[index] for index in range(len(jobs))]
