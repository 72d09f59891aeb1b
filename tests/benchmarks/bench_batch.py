"""Parallel efficiency and the coordinator's memory of ``px4fuse batch``.

``python tests/benchmarks/bench_batch.py [FLIGHTS] [WORKERS]`` simulates short flights (default
200), compares them in one process, and then with workers (default 2), including their start.
Efficiency is the time of one process divided by time and number of the workers; on a computer with
other load, the ratio of CPU times per log is more exact. Prints both, the coordinator's memory
after each tenth of the run, and the number of logs per worker-hour.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from pathlib import Path

import psutil

from px4fuse.batch.job import Job, analyse
from px4fuse.batch.logs import find_logs
from px4fuse.batch.run import run
from px4fuse.request import ComparisonRequest
from px4fuse.simulation.flights import simulate, to_ulog
from px4fuse.simulation.scenario import Scenario

WARM = 2


def main(count: int, workers: int) -> None:
    """Measure and print the efficiency."""
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch, "logs")
        folder.mkdir()
        for seed in range(count):
            flight = simulate(Scenario(passes=2, length_m=8.0, seed=seed))
            (folder / f"{seed:04d}.ulg").write_bytes(to_ulog(flight))
        logs, request = find_logs([str(folder)]), ComparisonRequest(log="LOG")
        jobs = [Job(log.address, request, False, 2 * 10**9) for log in logs]
        for job in jobs[:WARM]:
            analyse(job)
        begun, cpu = time.perf_counter(), time.process_time()
        for job in jobs:
            analyse(job)
        one_s, one_cpu_s = time.perf_counter() - begun, time.process_time() - cpu

        memory: list[float] = []
        here = psutil.Process()

        def look(what: str, done: int, of: int) -> None:
            if what.startswith("comparing") and done % max(1, of // 10) == 0:
                memory.append(here.memory_info().rss / 1e6)

        # CPU time of the coordinator and of ended workers
        cpu, begun = sum(os.times()[:4]), time.perf_counter()
        run([str(folder)], Path(scratch, "out"), workers=workers, progress=look)
        many_s, many_cpu_s = time.perf_counter() - begun, sum(os.times()[:4]) - cpu
    print(f"one process: {one_s:.1f} s, {one_cpu_s / count:.2f} s of CPU per log")
    print(f"{workers} workers: {many_s:.1f} s, {many_cpu_s / count:.2f} s of CPU per log, all told")
    print(f"efficiency by the clock {one_s / many_s / workers:.2f}, by CPU time", end=" ")
    print(f"{one_cpu_s / many_cpu_s:.2f}")
    print("coordinator, MB:", *(f"{megabytes:.0f}" for megabytes in memory))
    print(f"one worker-hour: {3600.0 * count / many_s / workers:.0f} logs")


if __name__ == "__main__":
    main(*(int(word) for word in (*sys.argv[1:], "200", "2")[:2]))
