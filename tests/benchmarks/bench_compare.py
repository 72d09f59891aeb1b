"""Speed of ``px4fuse compare`` as a whole process, against the floor that no tool can go below.

The floor is what the same libraries need for the same file and the same number of pages: pyulog
reads the same topics, matplotlib saves empty pages. Both run in turn, so that the ratio holds on a
machine whose speed drifts. Nothing here can fail: run it, read it.

    python tests/benchmarks/bench_compare.py [RUNS]
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

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


def seconds(command: list[str]) -> float:
    start = time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - start


def main() -> None:
    from pypdf import PdfReader

    from px4fuse.readers.px4_topics import topics

    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 5
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.pdf"
        compare = [sys.executable, "-m", "px4fuse", "compare", str(LOG), "-o", str(report)]
        seconds(compare)  # warm the file cache and count the pages
        pages = len(PdfReader(report).pages)
        floor = [
            sys.executable, "-c", FLOOR, str(LOG), str(Path(folder) / "floor.pdf"),
            ",".join(topics()), str(pages),
        ]  # fmt: skip
        help_command = [sys.executable, "-m", "px4fuse", "--help"]
        bare = [sys.executable, "-c", "import click"]
        rows = {
            "compare / floor": (compare, floor),
            "--help / python with click": (help_command, bare),
        }
        for name, (ours, peer) in rows.items():
            pairs = [(seconds(ours), seconds(peer)) for _ in range(runs)]
            ratio = statistics.median(a / b for a, b in pairs)
            a = statistics.median(a for a, _ in pairs)
            b = statistics.median(b for _, b in pairs)
            print(f"{name}: {ratio:.2f} ({a:.2f} s / {b:.2f} s, {runs} pairs, {pages} pages)")


if __name__ == "__main__":
    main()
