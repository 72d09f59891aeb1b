"""Speed of tuning and of the clock estimate; prints times and asserts nothing.

A KF replay of the sample log; then ``tune`` and the clock estimate on a ten-minute flight, 5 Hz
positions and 250 Hz IMU, in memory (without reading the log).

    python tests/benchmarks/bench_tuning.py
"""

from __future__ import annotations

import sys
from pathlib import Path

from measured import seconds

sys.path.insert(0, str(Path(__file__).parents[1]))

LOG = Path(__file__).parents[2] / "sample_logs" / "aisle_uwb.ulg"
RUNS = 3


def main() -> None:
    import filter_tools
    from comparisons import compare

    from px4fuse.comparison.estimates import estimate_noises_and_time_offset
    from px4fuse.filter.kalman import run_kf
    from px4fuse.filter.settings import Settings
    from px4fuse.filter.tuning import HORIZONTAL, tune
    from px4fuse.readers import read_log

    axis = compare(read_log(LOG), axes=("north",)).input_axes[0]
    single = seconds(lambda: run_kf(axis, Settings()), RUNS)
    print(f"KF replay {single:.2f} s")
    filter_tools.IMU_HZ, settings = 250.0, filter_tools.SETTINGS
    flight, _ = filter_tools.made_flight(1, duration_s=600.0, offset_s=-0.1)
    compared = compare(flight, settings)
    for names in (None, (HORIZONTAL,)):
        took = seconds(
            lambda names=names: tune(compared.input_axes, settings, names, flight=flight)
        )
        print(f"tune, {names[0] if names else 'all axes'}, 600 s: {took:.1f} s (aim 5 s)")
    took = seconds(lambda: estimate_noises_and_time_offset(compared))
    print(f"horizontal and clock offset, 600 s: {took:.1f} s (aim 2.5 s)")


if __name__ == "__main__":
    main()
