"""Valid combinations of options: each run must give results or an error of one line.

``python tests/studies/fuzz_options.py --count 1000 --seed 1`` draws a command, its arguments and up
to five of its options as click declares them, with values in their range. Options that need another
one are drawn with it. A table lists runs, runs with results, errors of one line and faults:
usage errors, other exceptions, warnings and impossible statements (see ``fuzz_fields.py``).

The last run (seed 1) was stopped after 810 of 1,000 runs, without a fault. A run before, with seed
9, found the traceback of ``whatif --set EKF2_EV_DELAY=300``.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from unittest import mock

TESTS = Path(__file__).resolve().parents[1]
for folder in (TESTS, TESTS / "studies"):
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))

import one_thread  # noqa: E402, F401 - before NumPy

# isort: split
import click  # noqa: E402
from class_tools import run_in_turn  # noqa: E402
from click.testing import CliRunner  # noqa: E402
from conftest import REPOSITORY, SAMPLES, blank_page  # noqa: E402
from fuzz_fields import (  # noqa: E402
    DRAWN_SHARE,
    bases,
    cut_log,
    impossible_text,
    place_of,
    written_statements,
)
from ulog_tools import load  # noqa: E402

from px4fuse.classroom.assignment.key import AnswerKey, format_answer_key  # noqa: E402
from px4fuse.classroom.grading import grade as grading  # noqa: E402
from px4fuse.classroom.grading.rubric import read_default_rubric_text  # noqa: E402
from px4fuse.cli import COMMANDS, cli  # noqa: E402
from px4fuse.core import workers  # noqa: E402
from px4fuse.errors import Px4FuseError  # noqa: E402
from px4fuse.findings.model import FINDING_CATALOGUE  # noqa: E402
from px4fuse.report import pdf  # noqa: E402
from px4fuse.simulation.faults import FAULT_TYPES  # noqa: E402

LOGS = ("aisle.ulg", "aisle.ulg", "gnss.ulg", "vio.ulg", "m.tlog")
# Arguments by command; one of the rows is drawn
ARGUMENTS: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("compare", "answers", "explore", "info", "extract", "tune", "sync"), LOGS),
    "whatif": ("aisle.ulg", "gnss.ulg"),
    "batch": ("aisle.ulg", "aisle.ulg m.tlog", "logs"),
    "diff": ("r.pdf aisle.ulg", "r.json r.pdf", "aisle.ulg gnss.ulg"),
    "explain": tuple(FINDING_CATALOGUE),
    "loop": ("a.tum", "vio.ulg:vio", "vio.ulg", "g.g2o"),
    "evaluate": ("a.tum b.tum", "aisle.ulg:ekf2 aisle.ulg:truth", "a.tum a.tum"),
    "verify": ("r.pdf", "r.pdf aisle.ulg", "r.pdf logs"),
    "lesson": ("kalman", "loop"),
    "grade": ("subs", "r.pdf", "subs r.pdf"),
}
Draw = Callable[[random.Random], object]


def between(low: float, high: float) -> Draw:
    """Draw a number of an interval; one of five draws is a limit of it."""
    return lambda rng: f"{rng.choice((low, high, *[rng.uniform(low, high)] * 8)):.6g}"


def one_of(*values: str) -> Draw:
    return lambda rng: rng.choice(values)


_NAME = one_of("Ada", "山田 太郎", 'O\'Neil, "B"', "=1+1", "x" * 200, "<b>&amp;", "σ #*_[]$")
# Values of options that click declares as text, path or number without range, by name of the
# parameter, or by command and parameter if commands differ
VALUES: dict[str, Draw] = {
    "sigma_a_m_s2": between(1e-4, 100.0), "sigma_z_m": between(1e-4, 100.0),
    "dt_s": between(0.001, 1.0), "heading_deg": between(0.0, 360.0),
    "start_s": between(0.0, 8.0), "end_s": between(10.0, 40.0),
    "clock_offset_s": lambda rng: rng.choice(("auto", between(-5.0, 5.0)(rng))),
    "position_source": one_of("vehicle_visual_odometry"),
    "gnss.ulg position_source": one_of("vehicle_gps_position"),
    "m.tlog position_source": one_of("VISION_POSITION_ESTIMATE"),
    "position": one_of("pos.csv"),
    "position_yaw": lambda rng: rng.choice(("auto", between(-360.0, 360.0)(rng))),
    "position_columns": one_of("time_s,x_m,y_m,z_m", "1,2,3,4", "1,2,3,4,5", "1,3,2,4"),
    "student": _NAME, "student_id": _NAME, "title": _NAME,
    "notes": one_of("notes.md"), "answers": one_of("form.toml"),
    "rpe": one_of("1m", "0.5s", "1f", "10 frames", "1000000m", ".001s"),
    "max_gap_s": between(0.001, 10.0), "time_offset_s": one_of("auto", "0", "-3", "100", "0.01"),
    "landed_at": one_of("0,0", "0.5,-0.2", "1,1,90", "10000,-10000,-360"),
    "closures": one_of("1,8", "2,9,0.5", "0.5,20,1e-3", "3,3.1"),
    "position_drift_m": between(1e-4, 1.0), "heading_drift_deg": between(1e-3, 10.0),
    "key_frames_m": between(0.01, 5.0), "reference": one_of("b.tum", "vio.ulg:truth"),
    "loop end_s": between(9.0, 60.0),
    "aisle.ulg changes": one_of(
        "EKF2_ACC_NOISE=1", "EKF2_EV_DELAY=300", "EKF2_EVP_GATE=1", "EKF2_EV_CTRL=0"
    ),
    "gnss.ulg changes": one_of("EKF2_GPS_P_NOISE=10", "EKF2_GYR_NOISE=0.0001", "EKF2_GPS_DELAY=0"),
    "aisle.ulg sweep": one_of("EKF2_EVP_NOISE=0.01:1:2", "EKF2_EV_DELAY=0:300:3"),
    "gnss.ulg sweep": one_of("EKF2_GPS_DELAY=0:300:3", "EKF2_ACC_NOISE=0.01:1:2"),
    "aisle.ulg without": one_of("ev_pos"),
    "gnss.ulg without": one_of("gnss_pos", "gnss_vel", "baro_hgt", "mag"),
    "since": between(0.0, 30.0),
    "seed": lambda rng: rng.randrange(2**32),
    "passes": one_of("1", "2"), "length_m": one_of("2", "4", "8"),
    "speed_m_s": between(0.5, 3.0), "uwb_rate_hz": between(0.5, 50.0),
    "sigma_uwb_m": between(0.001, 5.0), "vio_drift": between(0.0, 0.1),
    "sigma_gnss_m": between(0.01, 10.0), "accel_bias_sigma_m_s2": between(0.0, 1.0),
    "simulate sigma_a_m_s2": between(0.01, 5.0),
    "mistake": lambda rng: rng.choice(sorted(FAULT_TYPES)), "mistakes": one_of("0", "1", "2"),
    "assignment": one_of("roster.csv"), "secret_file": one_of("secret.txt"),
    "logs": one_of("logs", "aisle.ulg"), "rubric": one_of("rubric.toml"), "key": one_of("key.json"),
    "roster": one_of("roster.csv"), "worksheet": one_of("sheet.csv"), "column": one_of("grade"),
    "due": one_of("2026-11-20 23:59", "2026-11-20 23:59+01:00", "2020-02-29 00:00 Europe/Berlin"),
    "late": one_of("10%/day", "10%/day up to 50%", "100%/day"),
    "json_path": one_of("{out}/r.json", "-"), "tum_path": one_of("{out}/p.tum"),
    "g2o_path": one_of("{out}/p.g2o"), "answer_key_path": one_of("{out}/a.json"),
    "write_rubric": one_of("{out}/w.toml"),
}  # fmt: skip
# Options that need another option, by name of the parameter
NEEDS = {
    **dict.fromkeys(
        ("position_frame", "position_yaw", "position_columns", "position_time_unit",
         "position_unit"), "position",
    ),
    **dict.fromkeys(("secret_file", "mistakes"), "assignment"),
    "since": "without", "column": "worksheet", "late": "due",
}  # fmt: skip
# Options that exclude each other
EXCLUDED = (
    {"is_open_path", "landed_at"}, {"is_open_path", "closures"},
    {"sweep", "without"}, {"sweep", "changes"},
    {"source_kind", "height"},
)  # fmt: skip
# Options that a desk has no value for, and those that only limit a run
NEVER = ("scheduler", "workers", "memory", "timeout", "system", "max_size", "output")
# Output of -o; commands that need none write to the current folder
OUTPUTS = {
    "compare": "r.pdf", "explore": "p.html", "practice": "p.html", "answers": "f.toml",
    "simulate": "s.ulg", "verify": "r.pdf", "batch": "out", "grade": "out", "sample": "out",
    "extract": "out", "loop": "r.pdf", "evaluate": "r.pdf",
}  # fmt: skip


def make_desk(folder: Path) -> None:
    """Write all types of inputs to a folder, for a short flight."""
    for name, log in {
        # long enough for a match with the position file
        "aisle.ulg": cut_log(load(SAMPLES / "aisle_uwb.ulg"), 40.0, 50.0),
        "gnss.ulg": bases()["GNSS"], "vio.ulg": bases()["vision"],
    }.items():  # fmt: skip
        log.write(folder / name)
    (folder / "logs").mkdir()
    (folder / "subs").mkdir()
    (folder / "logs" / "aisle.ulg").write_bytes((folder / "aisle.ulg").read_bytes())
    (folder / "m.tlog").write_bytes((SAMPLES / "aisle_uwb.tlog").read_bytes())
    track = (SAMPLES / "loop_slam.tum").read_text().splitlines()[:300]
    other = [line if at % 3 else f"{line} " for at, line in enumerate(track) if at % 7]
    steps = [f"EDGE_SE2 {at} {at + 1} 1 0 0.5 10 0 0 10 0 10" for at in range(12)]
    for name, text in {
        "a.tum": "\n".join(track), "b.tum": "\n".join(other),
        "pos.csv": (SAMPLES / "aisle_uwb_external.csv").read_text(),
        "g.g2o": "\n".join([*steps, "EDGE_SE2 0 12 0.1 0.1 6 10 0 0 10 0 10"]),
        "notes.md": "# Title\n\n* words **bold** $x^2$\n",
        "secret.txt": "a secret of enough letters",
        "roster.csv": "id,name\n1,Ada\n2,山田\n", "sheet.csv": "id,name,grade\n1,Ada,\n",
        "rubric.toml": read_default_rubric_text(),
        "key.json": format_answer_key(AnswerKey("aisle", ())),
    }.items():  # fmt: skip
        (folder / name).write_text(text, encoding="utf-8")
    os.chdir(folder)
    for words in (
        ["compare", "aisle.ulg", "-o", "r.pdf", "--student", "Ada", "--id", "1"],
        ["answers", "aisle.ulg", "-o", "form.toml"],
    ):
        CliRunner().invoke(cli, words, catch_exceptions=False)
    (folder / "subs" / "s1.pdf").write_bytes((folder / "r.pdf").read_bytes())


def drawn_words(name: str, command: click.Command, rng: random.Random, out: Path) -> list[str]:
    """Draw arguments and options of a command."""
    options = {
        one.name or "": one
        for one in command.params
        if isinstance(one, click.Option) and one.expose_value and one.name not in NEVER
    }
    if name == "practice":
        del options["opens_browser"]  # it opens a browser
    arguments = rng.choice(ARGUMENTS.get(name, ("",)))
    chosen = set(rng.sample(sorted(options), min(rng.randrange(6), len(options))))
    chosen |= {NEEDS[one] for one in chosen if one in NEEDS}
    if "assignment" in chosen:
        chosen &= {"assignment", "secret_file", "mistakes", "no_truth", "answer_key_path"}
    if arguments == "g.g2o":
        chosen &= {"g2o_path", "json_path", "robust"}
    if arguments not in ("", "aisle.ulg"):  # the position file is of this flight
        chosen -= {"position", *(one for one in NEEDS if NEEDS[one] == "position")}
    for pair in EXCLUDED:
        if pair <= chosen:
            chosen.discard(sorted(pair)[0])
    words = [name, *arguments.split()]
    for one in sorted(chosen):
        for _ in range(rng.choice((1, 1, 2)) if options[one].multiple else 1):
            words += [options[one].opts[0], *drawn_value((arguments, name), options[one], rng)]
    if name in OUTPUTS:
        words += ["-o", str(out / OUTPUTS[name])]
    return [word.replace("{out}", str(out)) for word in words]


def drawn_value(of: tuple[str, str], option: click.Option, rng: random.Random) -> list[str]:
    """Draw a valid value of an option, for some arguments and a command; a flag has none."""
    name, kind = option.name or "", option.type
    if option.is_flag:
        return []
    for key in (*(f"{one} {name}" for one in of), name):
        if key in VALUES:
            return [str(VALUES[key](rng))]
    if isinstance(kind, click.Choice):
        return [str(rng.choice(kind.choices))]
    assert isinstance(kind, click.IntRange), f"VALUES has no {name}"
    return [str(rng.randint(int(kind.min or 0), min(int(kind.max or 3), 3)))]


def run_once(name: str, rng: random.Random, out: Path) -> tuple[str, str]:
    """Run a command with drawn options; return its outcome, and the command or the fault."""
    command = cli.get_command(click.Context(cli), name)
    assert command is not None
    words = drawn_words(name, command, rng, out)
    typed = " ".join(words)
    with contextlib.ExitStack() as stack:
        stack.enter_context(warnings.catch_warnings())
        warnings.simplefilter("error")
        for module in (grading, workers):
            stack.enter_context(mock.patch.object(module, "run_with_limits", run_in_turn))
        if rng.random() > DRAWN_SHARE:
            stack.enter_context(mock.patch.object(pdf, "render_pdf", blank_page))
        done = CliRunner().invoke(cli, words)
    failure = done.exception
    if isinstance(failure, Px4FuseError):
        return "one line", f"{typed}: {failure}"
    if failure is not None and not (isinstance(failure, SystemExit) and done.exit_code == 1):
        text = done.output if isinstance(failure, SystemExit) else f"{failure} {place_of(failure)}"
        return "faults", f"{typed}: {type(failure).__name__} {text}"
    text = "" if "{" in done.stdout[:1] else done.output
    found = [*impossible_text(text), *written_statements(out)]
    return ("faults", f"{typed}: {found[0]}") if found else ("results", typed)


def main() -> None:
    """Run the study and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="number of the first run")
    given = parser.parse_args()
    names = [name for name in COMMANDS if name != "mcp"]  # a server uses standard input
    # commands with many options are drawn more often
    weights = [2 + len(cli.get_command(click.Context(cli), name).params) for name in names]  # type: ignore[union-attr]
    counts: dict[str, Counter[str]] = {name: Counter() for name in COMMANDS}
    lines = Counter[str]()
    with tempfile.TemporaryDirectory() as folder:
        make_desk(Path(folder))
        for number in range(given.first, given.first + given.count):
            rng, out = random.Random(f"{given.seed} {number}"), Path(folder, f"out{number}")
            name = rng.choices(names, weights)[0]
            out.mkdir()
            outcome, text = run_once(name, rng, out)
            counts[name].update(("runs", outcome))
            if outcome == "faults":
                print(f"{given.seed} {number}: {text}", file=sys.stderr, flush=True)
            elif outcome == "one line":
                lines[f"{name}: {text.partition(': ')[2][:110]}"] += 1
        os.chdir(REPOSITORY)
    columns = ("runs", "results", "one line", "faults")
    print(f"{'command':12}{''.join(f'{column:>10}' for column in columns)}")
    for name, row in [*counts.items(), ("all", sum(counts.values(), Counter[str]()))]:
        print(f"{name:12}{''.join(f'{row[column]:10}' for column in columns)}")
    for line, times in lines.most_common(given.count):
        print(f"{times:4} {line}")


if __name__ == "__main__":
    main()
