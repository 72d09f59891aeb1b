"""Speed and memory of the MAVLink reader, compared with pymavlink on the same file.

Both decode every message: px4fuse into columns, pymavlink's ``recv_match`` into one object each.
They run in turn, so the ratio does not depend on the load of the computer. Prints times and asserts
nothing.

    python tests/benchmarks/bench_mavlink.py [RUNS] [FILE ...]
"""

from __future__ import annotations

import os
import sys
import tempfile
import tracemalloc
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from measured import seconds

os.environ["MAVLINK20"] = "1"
sys.path.insert(0, str(Path(__file__).parents[1]))

LOG = Path(__file__).parents[2] / "sample_logs" / "aisle_uwb.tlog"
MINUTES = 10
RATE_HZ = 200


def read_columns(path: Path) -> int:
    """Read frames, and decode every message type into columns."""
    from px4fuse.readers.mavlink_frames import message_name, read_frames

    frames = read_frames(path.name, path.read_bytes())
    for number in np.unique(frames.message_ids).tolist():
        name = message_name(number)
        frames.table(name, frames.rows(name))
    return len(frames)


def read_with_pymavlink(path: Path) -> int:
    from pymavlink import mavutil

    link = mavutil.mavlink_connection(str(path), dialect="all", notimestamps=path.suffix != ".tlog")
    count = 0
    while (made := link.recv_match()) is not None:
        kind = made.get_type()
        count += kind != "BAD_DATA" and not kind.startswith("UNKNOWN")
    link.close()
    return count


def synthetic(path: Path) -> Path:
    """Write ten minutes of the simulated aisle flight at 200 messages per second."""
    from mavlink_tools import Aisle

    # 68 messages per second in addition to the IMU, over a link that keeps their order
    aisle = Aisle(
        seconds=60.0 * MINUTES, imu_hz=RATE_HZ - 68.0,
        delay=lambda rng: 0.002 + rng.exponential(0.0003),
    )  # fmt: skip
    path.write_bytes(aisle.record().tlog())
    return path


def memory(work: Callable[[Path], object], path: Path) -> float:
    """Return the peak memory divided by the size of the file."""
    tracemalloc.start()
    work(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak / path.stat().st_size


def main() -> None:
    from px4fuse.readers import read_log

    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 5
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(name) for name in sys.argv[2:]] or [LOG]
        files.append(synthetic(Path(folder) / f"{MINUTES}_minutes.tlog"))
        for path in files:
            count, theirs = read_columns(path), read_with_pymavlink(path)
            read_log(path)  # tables that are cached
            readers = [
                partial(read, path) for read in (read_with_pymavlink, read_columns, read_log)
            ]
            took = np.array([[seconds(read) for read in readers] for _ in range(runs)])
            a, b, whole = np.median(took, axis=0)
            ratio = np.median(took[:, 0] / took[:, 1])
            print(
                f"{path.name}: recv_match / ours: {ratio:.1f} ({a:.2f} s / {b:.3f} s, {runs} runs,"
                f" {theirs} and {count} messages); read_log {whole:.3f} s, peak memory "
                f"{memory(read_log, path):.2f} times the file's {path.stat().st_size / 1e6:.1f} MB"
            )


if __name__ == "__main__":
    main()
