"""Time per report and memory of grading a class with its logs.

``python tests/benchmarks/bench_grade.py [REPORTS]`` makes up to 20 short simulated flights and
their reports, grades them, and prints the time per report, compared with the time of the analysis
without grading, and the peak memory of the grading process and of a worker. Then it copies them
under other names to REPORTS (default 300) files with cached verifications, and prints the time for
another rubric.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from click.testing import CliRunner

from px4fuse.classroom.grading.rubric import read_default_rubric_text
from px4fuse.cli import cli
from px4fuse.simulation.flights import simulate, to_ulog
from px4fuse.simulation.scenario import Scenario

GRADE = """
import json, re, resource, sys, time
from pathlib import Path
from px4fuse.classroom.grading.entries import Course
from px4fuse.classroom.grading.grade import grade
from px4fuse.classroom.grading.rubric import read_rubric
if __name__ == "__main__":
    reports, logs, output, rubric = (Path(word) for word in sys.argv[1:])
    start = time.perf_counter()
    outcome = grade([reports], Course(read_rubric(rubric), logs=[logs]), output)
    print(json.dumps({
        "reports": len(outcome.graded),
        "verified": sum(one.verification.status == "verified" for one in outcome.graded),
        "seconds": time.perf_counter() - start,
        "reused": outcome.reused,
        "parent_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "worker_mb": resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024,
    }))
"""


FLIGHTS = 20


def make(job: tuple[int, Path, Path]) -> float:
    """Simulate one flight and make its report; return the time of the report (s)."""
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


def graded(folder: Path, reports: Path, rubric: Path) -> dict[str, float]:
    """Grade a folder of reports in a new process."""
    script = folder / "grade_them.py"
    script.write_text(GRADE)
    paths = (script, reports, folder / "logs", folder / "class", rubric)
    words = [sys.executable, *map(str, paths)]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    found: dict[str, float] = json.loads(done.stdout)
    return found


def hand_in_again(folder: Path, count: int) -> Path:
    """Copy reports with other names and bytes, each with its cached record."""
    again = folder / "again"
    made = sorted((folder / "reports").glob("*.pdf"))
    records = folder / "class" / "records"
    for number in range(count):
        pdf = made[number % len(made)].read_bytes()
        content = pdf + f"%{number}\n".encode()
        place = again / f"Student {number}_{1000 + number}_assignsubmission_file_"
        place.mkdir(parents=True)
        (place / "report.pdf").write_bytes(content)
        old, new = (hashlib.sha256(one).hexdigest() for one in (pdf, content))
        for part in records.glob(f"{old}.*"):
            shutil.copy(part, records / part.name.replace(old, new))
    return again


def main() -> None:
    """Make reports, grade them and print times."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 300
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        logs, reports = folder / "logs", folder / "reports"
        logs.mkdir()
        reports.mkdir()
        with ProcessPoolExecutor(os.cpu_count()) as pool:
            jobs = [(seed, logs, reports) for seed in range(min(count, FLIGHTS))]
            taken = list(pool.map(make, jobs))
        alone = sum(taken[4:]) / len(taken[4:])  # the first reports include imports
        first, other = folder / "first.toml", folder / "other.toml"
        first.write_text(read_default_rubric_text(), encoding="utf-8")
        other.write_text(
            read_default_rubric_text().replace("points = 10", "points = 12"), encoding="utf-8"
        )
        found = graded(folder, reports, first)
        each = found["seconds"] / found["reports"]
        print(
            f"{found['reports']:4.0f} reports, {found['verified']:.0f} verified: {each:.2f} s per "
            f"report on {os.cpu_count()} cores ({each * (os.cpu_count() or 1) / alone:.2f} times "
            f"the analysis alone); peak memory {found['parent_mb']:.0f} MB, of a worker "
            f"{found['worker_mb']:.0f} MB"
        )
        again = hand_in_again(folder, count)
        graded(folder, again, first)
        found = graded(folder, again, other)
        print(
            f"{found['reports']:4.0f} reports, {found['reused']:.0f} as verified before, another "
            f"rubric: {found['seconds']:.1f} s; peak memory {found['parent_mb']:.0f} MB, of a "
            f"worker {found['worker_mb']:.0f} MB"
        )


if __name__ == "__main__":
    main()
