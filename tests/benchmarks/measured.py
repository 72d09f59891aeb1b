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
    """What one run took."""

    wall_s: float
    cpu_s: float
    peak_mb: float


def measured(command: list[str]) -> Measured:
    """Run a command; one core each, so that CPU time compares.

    Its exit code does not matter: PX4's script ends with an error where it finds an anomaly.
    """
    start = time.perf_counter()
    one_core = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    one_core.pop("PYTHONDONTWRITEBYTECODE", None)  # an installed package is compiled
    run = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=one_core
    )
    _, _, used = os.wait4(run.pid, 0)
    wall = time.perf_counter() - start
    return Measured(wall, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024.0)


def seconds(work: Callable[[], object], runs: int = 1) -> float:
    """Median over some runs."""
    return statistics.median(timeit.repeat(work, number=1, repeat=runs))
