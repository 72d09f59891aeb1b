"""Coverage of the 95 % intervals of SIGMA_Z, SIGMA_A and the clock offset.

``python tests/studies/intervals.py [FLIGHTS]`` simulates each scenario of detector_rates.py, and
the default one with outliers, with this number of seeds (default 50). It prints for each: coverage,
bias of SIGMA_Z and of the offset with the standard error of its mean, scatter of the offset divided
by its σ, and false clock findings. Nothing is asserted.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace

import numpy as np
from comparisons import compare
from detector_rates import DEFAULT, SCENARIOS, clean

from px4fuse.comparison.estimates import estimate_noises_and_time_offset
from px4fuse.filter.time_offset import (
    MAX_P_VALUE_OF_CHANGED_OFFSET,
    MIN_TIME_OFFSET_S,
    SourceTimeOffset,
)
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning, NoiseEstimate
from px4fuse.simulation.faults import parse_faults
from px4fuse.simulation.flights import simulate_flight

FIRST_SEED = 2000
OUTLIERS = ("nlos=2%", "nlos=7%", "nlos=12%", "nlos=6%,0.5m")
Job = tuple[int, str, str]


def covers(noise: NoiseEstimate, true: float) -> bool:
    """Return True if an interval, which may have open ends, contains a value."""
    return (noise.low or 0.0) <= true <= (noise.high or np.inf)


def measured(job: Job) -> tuple[float, ...] | None:
    """Return the estimates of one flight; None without an estimate."""
    seed, scenario, mistake = job
    flown = replace(clean(scenario).flight(seed), ekf2=False, truth=False)
    flight = simulate_flight(flown, parse_faults((mistake,) if mistake else ()))
    comparison = compare(flight, axes=("north", "east"))
    tuning, clock = estimate_noises_and_time_offset(comparison)
    tuned = tuning[HORIZONTAL]
    if not isinstance(tuned, AxisTuning) or not isinstance(clock, SourceTimeOffset):
        return None
    low, high = clock.interval_s
    false = abs(clock.offset_s) > max(clock.significance_limit_s, MIN_TIME_OFFSET_S)
    return (
        (tuned.sigma_z.value or np.nan) / flown.source_sigma_m - 1.0,
        covers(tuned.sigma_z, flown.source_sigma_m), covers(tuned.sigma_a, flown.sigma_a_m_s2),
        clock.offset_s, low <= 0.0 <= high, clock.offset_s / clock.sigma_s, clock.is_determinable,
        clock.is_determinable and false,
        clock.change_p_value is not None and clock.change_p_value < MAX_P_VALUE_OF_CHANGED_OFFSET,
    )  # fmt: skip


def lines(flights: int) -> Iterator[str]:
    """Yield one line for each scenario."""
    conditions = [(name, "") for name in SCENARIOS] + [(DEFAULT, each) for each in OUTLIERS]
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        for name, mistake in conditions:
            jobs = [(FIRST_SEED + seed, name, mistake) for seed in range(flights)]
            rows = np.array([row for row in pool.map(measured, jobs) if row is not None])
            if not len(rows):
                yield f"{name} {mistake}: no estimate"
                continue
            bias, z, a, offset, clock, score, sure, false, change = rows.T
            error = offset.std() / len(rows) ** 0.5
            yield (
                f"{name + ' ' + mistake:32} n {len(rows)}: SIGMA_Z {np.nanmean(bias):+.1%}, "
                f"covered {z.mean():.0%}; SIGMA_A covered {a.mean():.0%}; "
                f"clock {1e3 * offset.mean():+.1f} ± {1e3 * error:.1f} ms, "
                f"covered {clock.mean():.0%}, "
                f"scatter {score.std():.2f} sigma, determinable {sure.mean():.0%}; false offset "
                f"{false.mean():.1%}, change {change.mean():.1%}"
            )


if __name__ == "__main__":
    for line in lines(int(sys.argv[1]) if len(sys.argv) > 1 else 50):
        print(line, flush=True)
