"""Parallel analysis of many logs on this computer or on a Dask cluster.

Each log is analysed in a separate process, with limits of time and memory.
"""

from __future__ import annotations

import logging
import multiprocessing
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from importlib import metadata
from typing import TYPE_CHECKING, Any

from px4fuse.core.text import shorten_to_line
from px4fuse.core.workers import Job, JobFailure, Result
from px4fuse.errors import Px4FuseError, SettingsError

if TYPE_CHECKING:
    from distributed import Client

# Maximum time (s) to connect to the Dask scheduler
CONNECT_TIMEOUT_S = 15.0
# Maximum number of logs per Dask task; the start of a process for the task takes 2 s
MAX_LOGS_PER_DASK_TASK = 4


@contextmanager
def connect_to_cluster(scheduler: str | None = None) -> Iterator[Client | None]:
    """Connect to a Dask cluster; ``scheduler`` is the address of its scheduler.

    Yield None without an address: jobs then run on this computer.

    Raises
    ------
    SettingsError
        Dask is not installed, the scheduler does not answer, or a worker has another version of
        px4fuse.
    """
    if scheduler is None:
        yield None
        return
    try:
        from distributed import Client  # noqa: PLC0415 - of the extra `batch`
        from distributed.utils import silence_logging_cmgr  # noqa: PLC0415
    except ImportError as error:
        raise SettingsError(
            "--scheduler requires Dask.", 'Run pip install "px4fuse[batch]".'
        ) from error
    try:
        # if the connection fails, Dask must not keep this client as its default
        client = Client(scheduler, timeout=CONNECT_TIMEOUT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise SettingsError(
            f"--scheduler {scheduler}: no Dask scheduler answers "
            f"({shorten_to_line(str(error), 120)}).",
            "Start a Dask scheduler with: dask scheduler",
        ) from error
    # without this, Dask prints tracebacks when the scheduler ends
    with silence_logging_cmgr(logging.CRITICAL), client, client.as_current():
        _check_versions(client)
        yield client


def _check_versions(client: Client) -> None:
    """Raise a SettingsError if a Dask worker and this computer have different px4fuse versions."""
    own_version = metadata.version("px4fuse")
    for name, version in client.run(metadata.version, "px4fuse", on_error="return").items():
        if version != own_version:
            raise SettingsError(
                f"Dask worker {name} has px4fuse {version}, but this computer has {own_version}.",
                "Install the same version of px4fuse on the worker and on this computer.",
            )


def run_jobs(
    client: Client | None,
    run_job_list: Callable[..., Iterator[tuple[int, Result | JobFailure]]],
    jobs: Sequence[Job],
    processes: int | None = None,
) -> Generator[tuple[Job, Result | JobFailure]]:
    """Run jobs on a Dask cluster, or on this computer if ``client`` is None.

    Yield each job with its result as soon as it is finished.

    Raises
    ------
    Px4FuseError
        The connection to the scheduler was lost.
    """
    if client is None:
        for index, result in run_job_list(jobs, process_count=processes):
            yield jobs[index], result
        return
    from distributed import as_completed  # noqa: PLC0415

    job_lists = [
        jobs[start : start + MAX_LOGS_PER_DASK_TASK]
        for start in range(0, len(jobs), MAX_LOGS_PER_DASK_TASK)
    ]
    futures = client.map(partial(_run_task, run_job_list), job_lists, pure=False)
    jobs_by_future = dict(zip(futures, job_lists, strict=True))
    try:
        for future in as_completed(list(jobs_by_future)):
            jobs_of_task = jobs_by_future.pop(future)
            if future.status not in ("finished", "error"):
                raise Px4FuseError("the connection to the Dask scheduler was lost.")
            # jobs catch their own errors, so an exception means that the worker process failed
            error = future.exception()
            failure = JobFailure(shorten_to_line(f"{type(error).__name__}: {error}", 300))
            results = [failure] * len(jobs_of_task) if error else future.result()
            yield from zip(jobs_of_task, results, strict=True)
    finally:
        if client.status == "running":
            client.cancel(list(jobs_by_future))


def _run_task(
    run_job_list: Callable[..., Iterator[tuple[int, Any]]], jobs: Sequence[Any]
) -> list[Any]:
    """Run the jobs of one Dask task in sequence, in a child process of the Dask worker."""
    # Python does not allow daemon processes, such as Dask workers, to start processes
    multiprocessing.current_process().daemon = False
    # one process finishes the jobs in their order
    return [result for _, result in run_job_list(jobs, process_count=1)]
