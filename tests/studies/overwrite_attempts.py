"""Random commands whose output path is one of their inputs; no run may change an input.

``python tests/studies/overwrite_attempts.py --count 2000 --seed 1`` draws a command, one of its
inputs, one of its outputs and a way to it (``tests/overwrite_cases.py``), and adds detours (``./``,
``x/../``) and further links. It prints per command the runs, how many were refused as an input and
otherwise, and the runs that changed an input; these end with exit code 1.

Each case once, without detours, is in the suite: ``tests/test_input_files.py``.
"""

from __future__ import annotations

import argparse
import os
import random
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from unittest import mock

from click.testing import CliRunner

TESTS = Path(__file__).resolve().parents[1]
if str(TESTS) not in sys.path:
    sys.path.insert(0, str(TESTS))

from conftest import blank_page  # noqa: E402
from overwrite_cases import OverwriteCase, all_cases, file_hashes, make_desk, make_empty_folder  # noqa: E402

from px4fuse.cli import cli  # noqa: E402
from px4fuse.errors import OutputError  # noqa: E402

WAYS = ("refused", "other error", "written", "changed")


def detoured(typed: str, place: Path, rng: random.Random) -> str:
    """Return the same path with additional links and detours."""
    for number in range(rng.randrange(3)):
        folder, name = os.path.split(typed.rstrip(os.sep))
        match rng.randrange(4):
            case 0:
                typed = os.path.join(folder, ".", name)  # noqa: PTH118
            case 1 if folder and Path(folder).name not in ("", ".", ".."):
                typed = os.path.join(folder, "..", Path(folder).resolve().name, name)  # noqa: PTH118
            case 2 if (Path(folder) / name).exists():
                link = place / f"further{number}{Path(name).suffix}"
                link.symlink_to(Path(typed).absolute())
                typed = str(link)
            case 3 if os.path.realpath(os.path.relpath(typed)) == os.path.realpath(typed):
                typed = os.path.relpath(typed)  # it removes "x/..", also if x is a link
    return typed


def outcome(
    case: OverwriteCase, desk: Path, place: Path, rng: random.Random, before: object
) -> str:
    """Run one case and return its outcome; "" if the way is not possible."""
    arguments = case.arguments(desk, make_empty_folder(place))
    if arguments is None:
        return ""
    *rest, target = arguments
    if not target.endswith(".pdf") or case.way != "beside":
        target = detoured(target, place, rng)
    result = CliRunner().invoke(cli, [*rest, target])
    if file_hashes(desk) != before:
        return "changed"
    if isinstance(result.exception, OutputError):
        return "refused"
    return "other error" if result.exception else "written"


def main() -> None:
    """Draw and run cases, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    rng, every, begin = random.Random(given.seed), all_cases(), time.monotonic()
    counts: dict[str, Counter[str]] = {case.command: Counter() for case in every}
    with (
        tempfile.TemporaryDirectory() as folder,
        mock.patch("px4fuse.report.pdf.render_pdf", blank_page),
    ):
        desk = make_desk(Path(folder, "desk"))
        before = file_hashes(desk)
        os.chdir(desk)
        done = 0
        while done < given.count:
            case = rng.choice(every)
            found = outcome(case, desk, Path(folder, "place"), rng, before)
            done += bool(found)
            counts[case.command][found] += 1
            if found not in ("", "refused"):
                print(f"{found}: {case}", flush=True)
            if found == "changed":
                sys.exit(1)
        os.chdir(TESTS)
    print(f"{'command':66}{'runs':>6}{''.join(f'{way:>13}' for way in WAYS)}")
    total: Counter[str] = sum(counts.values(), Counter())
    for command, one in (*counts.items(), (f"all, {time.monotonic() - begin:.0f} s", total)):
        numbers = "".join(f"{one[way]:13}" for way in WAYS)
        print(f"{command[:64]:66}{sum(one[way] for way in WAYS):6}{numbers}")


if __name__ == "__main__":
    main()
