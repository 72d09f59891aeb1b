"""Seconds per report and memory of grading a class, its logs beside it.

``python tests/benchmarks/bench_grade.py [REPORTS]`` makes up to 20 short simulated flights and
their reports, hands them in as often as it takes (default 40 in all; each is verified anew),
grades a quarter of them and then all, each in a process of its own, and prints the time per
report, against the time that the same analysis takes without grading, and the most memory that the
grading process and any one of its workers took.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from click.testing import CliRunner

from px4fuse.cli import cli
from px4fuse.simulation.flights import simulate, to_ulog
from px4fuse.simulation.scenario import Scenario

GRADE = """
import json, resource, sys, time
from pathlib import Path
from px4fuse.grading.grade import grade
from px4fuse.grading.rubric import read_rubric
if __name__ == "__main__":
    reports, logs, output = (Path(word) for word in sys.argv[1:])
    start = time.perf_counter()
    outcome = grade([reports], [logs], read_rubric(None), output)
    seconds = time.perf_counter() - start
    start = time.perf_counter()
    again = grade([reports], [logs], read_rubric(None), output)
    print(json.dumps({
        "reports": len(outcome.graded),
        "verified": sum(one.verdict.status == "verified" for one in outcome.graded),
        "seconds": seconds,
        "again_seconds": time.perf_counter() - start,
        "reused": again.reused,
        "parent_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "worker_mb": resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024,
    }))
"""


FLIGHTS = 20


def make(job: tuple[int, Path, Path]) -> float:
    """Simulate one flight and make its report; seconds that the report took."""
    seed, logs, reports = job
    log = logs / f"{seed}.ulg"
    flight = simulate(Scenario(passes=2, length_m=8.0, seed=seed))
    log.write_bytes(to_ulog(flight))
    words = ["compare", str(log), "--id", str(seed), "-o", str(reports / f"{seed}.pdf")]
    start = time.perf_counter()
    result = CliRunner().invoke(cli, words)
    if result.exit_code:
        raise RuntimeError(result.output)
    (reports / f"{seed}.json").unlink()
    return time.perf_counter() - start


def graded(folder: Path, count: int) -> dict[str, float]:
    """Grade the first ``count`` reports in a process of its own."""
    part = folder / f"first {count}"
    part.mkdir()
    made = sorted((folder / "reports").glob("*.pdf"))
    for number in range(count):
        os.link(made[number % len(made)], part / f"{number}.pdf")
    script = folder / "grade_them.py"
    script.write_text(GRADE)
    words = [sys.executable, str(script), str(part), str(folder / "logs"), f"{part} class"]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    found: dict[str, float] = json.loads(done.stdout)
    return found


def main() -> None:
    """Make, grade, print."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 40
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        logs, reports = folder / "logs", folder / "reports"
        logs.mkdir()
        reports.mkdir()
        with ProcessPoolExecutor(os.cpu_count()) as pool:
            taken = list(
                pool.map(make, [(seed, logs, reports) for seed in range(min(count, FLIGHTS))])
            )
        alone = sum(taken[4:]) / len(taken[4:])  # the first ones import
        for part in (max(1, count // 4), count):
            found = graded(folder, part)
            each = found["seconds"] / found["reports"]
            print(
                f"{found['reports']:4.0f} reports, {found['verified']:.0f} verified: "
                f"{each:.2f} s per report on {os.cpu_count()} cores "
                f"({each * (os.cpu_count() or 1) / alone:.2f} times the analysis alone), "
                f"a second run {found['again_seconds']:.1f} s; peak memory "
                f"{found['parent_mb']:.0f} MB, of a worker {found['worker_mb']:.0f} MB"
            )


if __name__ == "__main__":
    main()
