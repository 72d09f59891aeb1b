"""Speed of ``px4fuse compare`` as a process, compared with the time of its libraries.

The reference is the time for the same file and number of pages: pyulog reads the same topics,
matplotlib saves empty pages. Both run in turn, so the ratio does not depend on the load of the
computer. The benchmark prints times and asserts nothing.

    python tests/benchmarks/bench_compare.py [RUNS] [--log FULL.ulg] [--px4 SCRIPT]

``--log`` is a flight with all its topics, of some megabytes, on which compare is measured against
PX4's own report. That is ``Tools/ecl_ekf/process_logdata_ekf.py`` of PX4-Autopilot, which is not
shipped here::

    git clone --depth 1 --filter=blob:none --sparse https://github.com/PX4/PX4-Autopilot
    git -C PX4-Autopilot sparse-checkout set Tools/ecl_ekf

Then ``--px4 PX4-Autopilot/Tools/ecl_ekf/process_logdata_ekf.py``; it needs pyulog, numpy and
matplotlib, and reads logs of its PX4 version (check out that tag) with innovation flags. It runs on
a copy of the log and writes a PDF of 20 pages with about 50 panels. With matplotlib 3.11 it also
draws an empty panel on each page, a fifth of its time. Without it a script with similar work is
used: pyulog reads every topic, matplotlib draws 20 pages with 50 panels.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np
from measured import measured

LOG = Path(__file__).parents[2] / "sample_logs" / "aisle_uwb.ulg"
FLOOR = """
import sys
from pyulog import ULog
topics = sys.argv[3].split(",")
ULog(sys.argv[1], topics)
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
with PdfPages(sys.argv[2]) as pdf:
    for _ in range(int(sys.argv[4])):
        pdf.savefig(Figure(figsize=(8.27, 11.69)))
"""
STAND_IN = """
import sys
from itertools import cycle, islice
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from pyulog import ULog
lines = cycle(
    (data.data["timestamp"], data.data[name], f"{data.name} {name}")
    for data in ULog(sys.argv[1]).data_list
    for name in data.data
)
with PdfPages(sys.argv[2]) as pdf:
    for panels in (2, 3) * 10:
        page = Figure(figsize=(8.27, 11.69))
        for axes, (time, values, label) in zip(page.subplots(panels), islice(lines, panels)):
            axes.plot(time, values, label=label)
            axes.legend()
            axes.grid()
        pdf.savefig(page)
"""


def print_ratio(name: str, ours: list[str], peer: list[str], runs: int, more: str = "") -> None:
    """Run both in turn, and print the median of the ratios."""
    pairs = [[measured(ours), measured(peer)] for _ in range(runs)]
    for what in ("wall", "cpu"):
        a, b = np.transpose([[getattr(side, f"{what}_s") for side in both] for both in pairs])
        told = f"{np.median(a / b):.2f} {what} ({np.median(a):.2f} s / {np.median(b):.2f} s)"
        print(f"{name}: {told}, {runs} pairs{more}")


def main() -> None:
    from pypdf import PdfReader

    from px4fuse.readers.px4_topics import list_topics

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="?", type=int, default=5)
    parser.add_argument("--log", type=Path)
    parser.add_argument("--px4", type=Path)
    given = parser.parse_args()
    python = sys.executable
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.pdf"
        compare = [python, "-m", "px4fuse", "compare", str(LOG), "-o", str(report)]
        measured(compare)  # warm the file cache and count the pages
        pages = len(PdfReader(report).pages)
        floor_pdf = str(Path(folder) / "floor.pdf")
        floor = [python, "-c", FLOOR, str(LOG), floor_pdf, ",".join(list_topics()), str(pages)]
        print_ratio("compare / floor", compare, floor, given.runs, f", {pages} pages")
        ours, click = [python, "-m", "px4fuse", "--help"], [python, "-c", "import click"]
        print_ratio("--help / python with click", ours, click, given.runs)
        if given.log is None:
            return
        log = Path(shutil.copy(given.log, folder))
        compare = [python, "-m", "px4fuse", "compare", str(log), "-o", str(report)]
        peer, name = [python, "-c", STAND_IN, str(log), floor_pdf], "all topics and twenty pages"
        if given.px4 is not None:
            peer, name = [python, str(given.px4), str(log)], "process_logdata_ekf.py"
            measured(peer)
            if not Path(f"{log}-0.pdf").exists():
                parser.exit(2, f"{given.px4} makes no report of {given.log}: run it to see why\n")
        print_ratio(f"compare / {name}", compare, peer, given.runs)


if __name__ == "__main__":
    main()
