"""Jobs of batch in a worker process; test_batch.py tests whole runs."""

from functools import partial

from px4fuse.batch.engine import run_jobs
from px4fuse.core.workers import run_with_limits


def test_run_jobs_in_worker_process_yields_each_job_with_result() -> None:
    run_in_processes = partial(run_with_limits, abs, timeout_s=60.0)
    assert sorted(run_jobs(None, run_in_processes, [-1, 2], 1)) == [(-1, 1), (2, 2)]
