"""Time and memory of ``compare``, ``tune`` and ``sync`` on flights of 2 to 60 minutes.

The flights are simulated. The reference is the time of pyulog for the same topics, which runs in
turn with each command, so the ratio does not depend on the load of the computer. Prints times and
asserts nothing. Linux and macOS.

    python tests/benchmarks/bench_long.py [MINUTES ...]   # of 2, 10, 23, 27, 60
"""

from __future__ import annotations

import sys
import tempfile
from itertools import pairwise
from pathlib import Path

from measured import Measured, measured

# Number of passes and length of the aisle (m) by minutes; longer flights cannot be simulated
FLIGHTS = {2: (6, 12), 10: (35, 12), 23: (82, 12), 27: (96, 12), 60: (100, 31)}
READ = "import sys; from pyulog import ULog; ULog(sys.argv[1], sys.argv[2].split(','))"


def main() -> None:
    from px4fuse.readers.px4_topics import topics

    px4fuse = [sys.executable, "-m", "px4fuse"]
    found: dict[str, list[tuple[float, Measured]]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for minutes in [int(word) for word in sys.argv[1:]] or FLIGHTS:
            log = Path(folder) / f"{minutes}.ulg"
            passes, length = FLIGHTS[minutes]
            flight = ["--passes", str(passes), "--length", str(length), "-o", str(log)]
            measured([*px4fuse, "simulate", *flight])
            for name in ("compare", "tune", "sync"):
                more = ["-o", str(Path(folder) / "report.pdf")] if name == "compare" else []
                took = measured([*px4fuse, name, str(log), *more])
                read = measured([sys.executable, "-c", READ, str(log), ",".join(topics())])
                found.setdefault(name, []).append((minutes, took))
                print(
                    f"{minutes} min, {log.stat().st_size / 1e6:.1f} MB, {name}: "
                    f"{took.cpu_s:.2f} s CPU, {took.wall_s:.2f} s wall, "
                    f"{took.cpu_s / read.cpu_s:.1f} x pyulog alone; peak {took.peak_mb:.0f} MB "
                    f"(pyulog {read.peak_mb:.0f} MB)",
                    flush=True,
                )
            log.unlink()
    for name, rows in found.items():
        first = rows[0][1].cpu_s
        ratios = ", ".join(f"{took.cpu_s / first:.2f} at {minutes:g} min" for minutes, took in rows)
        print(f"{name}: CPU time over that of the shortest flight: {ratios}")
        each = ", ".join(
            f"{(now.cpu_s - before.cpu_s) / (long - short):.2f} s from {short:g} to {long:g} min"
            for (short, before), (long, now) in pairwise(rows)
        )
        print(f"{name}: more for each minute, the same where time grows linearly: {each}")


if __name__ == "__main__":
    main()
