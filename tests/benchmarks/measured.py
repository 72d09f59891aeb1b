"""Wall time, CPU time and peak memory of a command; the time of a call."""

from __future__ import annotations

import os
import statistics
import subprocess
import time
import timeit
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Measured:
    """Times and memory of one run."""

    wall_s: float
    cpu_s: float
    peak_mb: float


def measured(command: list[str]) -> Measured:
    """Run a command on one core, so that CPU times are comparable.

    The exit code is ignored: PX4's script ends with an error if it finds an anomaly.
    """
    start = time.perf_counter()
    one_core = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    one_core.pop("PYTHONDONTWRITEBYTECODE", None)  # write bytecode, as for an installed package
    run = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=one_core
    )
    _, _, used = os.wait4(run.pid, 0)
    wall = time.perf_counter() - start
    return Measured(wall, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024.0)


def seconds(work: Callable[[], object], runs: int = 1) -> float:
    """Return the median time of several runs."""
    return statistics.median(timeit.repeat(work, number=1, repeat=runs))
