"""Random SIGTERM and SIGKILL during ``batch`` and ``grade``, which are then resumed.

``python tests/studies/kill_and_resume.py --count 100 --seed 1`` starts a command on a few short
flights, ends it by a signal at a random time, and starts it again, until a run ends by itself. Half
of the signals go to the command, half to its workers too, as from a job scheduler. The output must
then be identical to that of an uninterrupted run, file by file. Prints signals, resumed outputs and
differences; a difference, or another exit code than that of the signal, ends with exit code 1.

The last run (100 signals, seed 1)::

    batch (21 s): {'SIGTERM': 24, 'SIGKILL': 26, 'resumed': 5}, 0 differences
    grade (39 s): {'SIGKILL': 23, 'SIGTERM': 27, 'resumed': 7}, 0 differences
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

TESTS = Path(__file__).resolve().parents[1]
if str(TESTS) not in sys.path:
    sys.path.insert(0, str(TESTS))

from batch_tools import environment, tiny_logs  # noqa: E402
from cli_tools import contents  # noqa: E402

COMMANDS = {
    "batch": ("batch", "../logs", "-o", "out", "--workers", "2"),
    "grade": ("grade", "../subs", "--logs", "../logs", "-o", "out", "--jobs", "2"),
}
LOGS, REPORTS = 4, 3
SIGNALS = (signal.SIGTERM, signal.SIGKILL)


def start(words: tuple[str, ...], folder: Path) -> subprocess.Popen[bytes]:
    """Start a command in a process group of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "px4fuse", *words], cwd=folder, env=environment(),
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True,
    )  # fmt: skip


def run_to_end(words: tuple[str, ...], folder: Path) -> float:
    """Run a command without a signal; return its time (s)."""
    begin, process = time.monotonic(), start(words, folder)
    _, errors = process.communicate()
    assert process.returncode == 0, errors.decode()
    return time.monotonic() - begin


def end_by_signal(process: subprocess.Popen[bytes], rng: random.Random, after_s: float) -> str:
    """Send a signal after some time; return its name, "" if the command ended before it."""
    try:
        process.wait(after_s)
    except subprocess.TimeoutExpired:
        number = rng.choice(SIGNALS)
        (os.killpg if rng.random() < 0.5 else os.kill)(process.pid, number)
        _, errors = process.communicate()
        # SIGTERM may arrive when all is written, or before px4fuse handles it
        expected = (0, 128 + number, -number) if number == signal.SIGTERM else (-number,)
        assert process.returncode in expected, (process.returncode, errors.decode())
        # Python itself prints one for a worker whose parent is killed during its start
        assert number == signal.SIGKILL or b"Traceback" not in errors, errors.decode()
        return number.name
    _, errors = process.communicate()
    assert process.returncode == 0, errors.decode()
    return ""


def main() -> None:
    """Run the study and print the counts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=100, help="signals, half for each command")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    rng, differences = random.Random(given.seed), 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        tiny_logs(folder / "logs", LOGS)
        for at in range(1, REPORTS + 1):
            words = ("compare", f"logs/f{at}.ulg", "-o", f"subs/s{at}.pdf", "--id", str(at))
            run_to_end(words, folder)
        for command, words in COMMANDS.items():
            place = folder / command
            place.mkdir()
            lasts_s = run_to_end(words, place)
            expected = contents(place / "out")
            shutil.rmtree(place / "out")
            counts = Counter[str]()
            while True:
                missing = given.count // 2 > counts["SIGTERM"] + counts["SIGKILL"]
                after_s = rng.uniform(0.0, lasts_s) if missing else 600.0
                if ended := end_by_signal(start(words, place), rng, after_s):
                    counts[ended] += 1
                    continue
                counts["resumed"] += 1
                differences += compared(expected, contents(place / "out"))
                shutil.rmtree(place / "out")
                if not missing:
                    break
            print(
                f"{command} ({lasts_s:.0f} s): {dict(counts)}, {differences} differences",
                flush=True,
            )
    sys.exit(differences > 0)


def compared(expected: dict[str, bytes], found: dict[str, bytes]) -> int:
    """Print the names of files that differ, and return their number."""
    names = [name for name in sorted({*expected, *found}) if expected.get(name) != found.get(name)]
    for name in names:
        print(f"differs: {name} ({name in expected} expected, {name in found} found)")
    return len(names)


if __name__ == "__main__":
    main()
