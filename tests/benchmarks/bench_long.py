"""Time and memory of ``compare``, ``tune`` and ``sync`` on long flights and at high rates.

The flights are simulated: 2 to 60 minutes at 5 Hz, and two minutes at 2 to 100 Hz. The reference is
the time of pyulog for the same topics, which runs in turn with each command, so the ratio does not
depend on the load of the computer. The exponent of growth is that of the CPU time above the
shortest flight or lowest rate, as a function of the additional minutes or Hz: 1 is linear. Prints
times and asserts nothing. Linux and macOS.

    python tests/benchmarks/bench_long.py [2min ... 60min] [2Hz ... 100Hz]
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np
from measured import measured

# Options of ``px4fuse simulate`` by minutes and by rate. Longer flights cannot be simulated
FLIGHTS = {
    "min": {
        minutes: ["--passes", str(passes), "--length", str(length)]
        for minutes, passes, length in ((2, 6, 12), (6, 21, 12), (23, 82, 12), (60, 100, 31))
    },
    "Hz": {rate: ["--uwb-rate", str(rate)] for rate in (2, 5, 10, 25, 50, 100)},
}
READ = "import sys; from pyulog import ULog; ULog(sys.argv[1], sys.argv[2].split(','))"
AIM = 1.05


def growth(sizes: list[int], cpu_s: list[float]) -> str:
    """Return the CPU times relative to the first, and the exponent of growth."""
    ratios = ", ".join(
        f"{cpu / cpu_s[0]:.2f} at {size}" for size, cpu in zip(sizes, cpu_s, strict=True)
    )
    more = [np.array(values[1:]) - values[0] for values in (sizes, cpu_s)]
    if len(sizes) < 3 or np.any(more[1] <= 0.0):
        return ratios
    return f"{ratios}; exponent {np.polyfit(*np.log(more), 1)[0]:.2f} (aim {AIM})"


def main() -> None:
    from px4fuse.readers.px4_topics import list_topics

    px4fuse = [sys.executable, "-m", "px4fuse"]
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "flight.ulg"
        for unit, flights in FLIGHTS.items():
            sizes = [size for size in flights if f"{size}{unit}" in sys.argv[1:]]
            sizes = sizes if sys.argv[1:] else list(flights)
            cpu_s: dict[str, list[float]] = {name: [] for name in ("compare", "tune", "sync")}
            for size in sizes:
                measured([*px4fuse, "simulate", *flights[size], "-o", str(log)])
                for name, times in cpu_s.items():
                    more = ["-o", str(Path(folder) / "report.pdf")] if name == "compare" else []
                    took = measured([*px4fuse, name, str(log), *more])
                    read = measured([sys.executable, "-c", READ, str(log), ",".join(list_topics())])
                    times.append(took.cpu_s)
                    print(
                        f"{size} {unit}, {log.stat().st_size / 1e6:.1f} MB, {name}: "
                        f"{took.cpu_s:.2f} s CPU, {took.wall_s:.2f} s wall, "
                        f"{took.cpu_s / read.cpu_s:.1f} x pyulog alone; peak {took.peak_mb:.0f} MB "
                        f"(pyulog {read.peak_mb:.0f} MB)",
                        flush=True,
                    )
            for name, times in cpu_s.items():
                if times:
                    print(f"{name}, {unit}: CPU time relative to the first {growth(sizes, times)}")


if __name__ == "__main__":
    main()
