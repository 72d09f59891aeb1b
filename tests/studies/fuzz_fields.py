"""Logs with changed values, times, topics, parameters and rates as input of whole commands.

``python tests/studies/fuzz_fields.py --count 500 --seed 1`` makes this number of logs from 20 s of
the sample flights, of a simulated GNSS flight and of a MAVLink recording. Each log is the input of
all :data:`COMMANDS`, or of a random selection (``--commands``). A table by kind of change lists
logs, commands with results, commands with an error of one line, and faults: an exception, a
warning, more than :data:`SLOW_S`, or an impossible number in the output (:func:`impossible`).
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import json
import math
import random
import re
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from click.testing import CliRunner

TESTS = Path(__file__).resolve().parents[1]
if str(TESTS) not in sys.path:
    sys.path.insert(0, str(TESTS))

import mavlink_tools  # noqa: E402
from conftest import blank_page  # noqa: E402
from exchange import replace  # noqa: E402
from ulog_tools import Log, load  # noqa: E402

from px4fuse.cli import cli  # noqa: E402
from px4fuse.ekf2_parameters import RANGES  # noqa: E402
from px4fuse.errors import Px4FuseError  # noqa: E402
from px4fuse.report import pdf  # noqa: E402
from px4fuse.results.bounds import LARGEST_RATIO, LONGEST_M  # noqa: E402
from px4fuse.simulation.ulog_writer import Topic  # noqa: E402

REPOSITORY = TESTS.parent
SLOW_S = 60.0
SECONDS = 20.0
COMMANDS = (
    ("compare", "{log}", "--json", "{out}/r.json"),
    ("whatif", "{log}", "--json", "{out}/r.json"),
    ("tune", "{log}", "--json", "{out}/r.json"),
    ("sync", "{log}", "--json", "{out}/r.json"),
    ("info", "{log}", "--json", "{out}/r.json"),
    ("extract", "{log}", "-o", "{out}/tables"),
    ("explore", "{log}", "-o", "{out}/page.html"),
)
VALUES: dict[str, Callable[[np.ndarray], Any]] = {
    "NaN": lambda _: np.nan,
    "+inf": lambda _: np.inf,
    "-inf": lambda _: -np.inf,
    "0": lambda _: 0,
    "constant": lambda values: values[:1],
    "1e30": lambda _: 1e30,
    "-1e30": lambda _: -1e30,
    "1e6": lambda _: 1e6,
    "negative": lambda values: -values if values.dtype.kind == "f" else values[::-1],
}
Edit = Callable[[Log, random.Random], str]


# ---------------------------------------------------------------- logs


def cut_log(log: Log, start_s: float, seconds: float = SECONDS) -> Log:
    """Keep a time interval of a log, and every second sample of a fast IMU."""
    first = min(
        int(one.fields["timestamp"][0]) for one in log.topics if one.name == "sensor_combined"
    )
    low, high = (first + round(1e6 * at) for at in (start_s, start_s + seconds))
    topics = []
    for one in log.topics:
        stamp = one.fields["timestamp"]
        keep = np.flatnonzero((stamp >= low) & (stamp < high))
        if one.name == "sensor_combined" and np.median(np.diff(stamp)) < 6000:
            keep = keep[::2]
        if len(keep):
            topics.append(replace(one, fields={n: v[keep] for n, v in one.fields.items()}))
    return Log(topics, log.parameters, log.info)


@cache
def bases() -> dict[str, Log]:
    """Return parts of flights with UWB, vision and GNSS."""
    samples = REPOSITORY / "sample_logs"
    with tempfile.TemporaryDirectory() as folder:
        outdoor = Path(folder, "outdoor.ulg")
        done = CliRunner().invoke(
            cli, ["simulate", "--kind", "outdoor", "-o", str(outdoor)], catch_exceptions=False
        )
        assert done.exit_code == 0, done.output
        return {
            "UWB": cut_log(load(samples / "aisle_uwb.ulg"), 60.0),
            "vision": cut_log(load(samples / "loop_vio.ulg"), 40.0),
            "GNSS": cut_log(load(outdoor), 30.0),
        }


# ---------------------------------------------------------------- changes


def without_topic(log: Log, rng: random.Random) -> str:
    name = rng.choice(sorted(log.names()))
    log.drop(name)
    return name


def permuted(log: Log, rng: random.Random) -> str:
    """Change the instance number of a topic and add a copy as another instance."""
    at = rng.randrange(len(log.topics))
    one, number = log.topics[at], rng.choice((0, 1, 3))
    log.topics[at] = replace(one, instance=rng.choice((1, 2)))
    rows = slice(None, None, rng.choice((1, 5)))
    log.add(replace(one, instance=number, fields={n: v[rows] for n, v in one.fields.items()}))
    return f"{one.name} {number}"


def changed_field(log: Log, rng: random.Random) -> str:
    """Change all, the later half, or one of the samples of a field."""
    one = rng.choice(log.topics)
    name = rng.choice([n for n in one.fields if not n.startswith("timestamp")] or ["timestamp"])
    kind, make = rng.choice([*VALUES.items()])
    values = one.fields[name]
    count = len(values)
    rows = rng.choice((slice(None), slice(count // 2, None), slice(count // 2, count // 2 + 1)))
    some: Any = rows
    if values.ndim == 2 and rng.random() < 0.5:
        some = (rows, rng.randrange(values.shape[1]))
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        new = np.asarray(make(values[some]))
        if values.dtype.kind != "f":
            limits = np.iinfo(values.dtype) if values.dtype.kind in "iu" else np.iinfo(np.uint8)
            new = np.clip(np.nan_to_num(new.astype(float)), limits.min, limits.max)
            new = np.where(new >= limits.max, limits.max, new.astype(np.int64))
        values[some] = new.astype(values.dtype)
    return f"{one.name}.{name} {kind} {some}"


def changed_times(log: Log, rng: random.Random) -> str:
    one = rng.choice(log.topics)
    kind = rng.choice(("backward", "doubled", "late", "early", "overflow", "zero", "one sample"))
    fields, stamps = one.fields, [n for n in one.fields if n.startswith("timestamp")]
    if kind == "one sample":
        at = log.topics.index(one)
        log.topics[at] = replace(one, fields={n: v[:1] for n, v in fields.items()})
        return f"{one.name} {kind}"
    rows = slice(len(fields["timestamp"]) // 2, None) if rng.random() < 0.4 else slice(None)
    for name in stamps:
        values = fields[name]
        if kind == "backward":
            values[rows] = values[rows][::-1]
        elif kind == "doubled":
            values[rows] = np.repeat(values[rows][::2], 2)[: len(values[rows])]
        elif kind in ("late", "early"):
            shift = np.uint64(60_000_000)
            values[rows] = values[rows] + shift if kind == "late" else values[rows] - shift
        else:
            most = rng.choice((2**64 - 1, 2**63, 2**53)) if kind == "overflow" else 0
            values[rows] = np.uint64(most)
    return f"{one.name} {kind} {rows}"


def changed_parameters(log: Log, rng: random.Random) -> str:
    """Remove a parameter, or set it out of range or to a limit of its range."""
    name = rng.choice(sorted({*log.parameters} | {*RANGES}))
    value: float | None = rng.choice(
        (None, np.nan, np.inf, -1.0, 0.0, 1e30, -1e30, 1e6, 1e-30, "low", "high")
    )
    if value is None:
        log.parameters.pop(name, None)
    elif isinstance(value, str):
        known = RANGES.get(name)
        value = 0.0 if known is None else known.minimum if value == "low" else known.maximum
    if value is not None:
        log.parameters[name] = float(value)
    return f"{name} {value}"


def changed_rate(log: Log, rng: random.Random) -> str:
    """Resample a topic at another rate, from 0.1 Hz to 1 kHz, without interpolation."""
    at, rate = rng.randrange(len(log.topics)), rng.choice((0.1, 0.5, 2.0, 1000.0))
    one = log.topics[at]
    stamp = one.fields["timestamp"].astype(np.float64)
    wanted = np.arange(stamp[0], stamp[-1] + 1.0, 1e6 / rate)
    rows = np.clip(np.searchsorted(stamp, wanted), 0, len(stamp) - 1)
    fields = {name: values[rows].copy() for name, values in one.fields.items()}
    if rate > 100.0:
        moved = wanted - stamp[rows]
        for name in [n for n in fields if n.startswith("timestamp")]:
            fields[name] = (fields[name].astype(np.float64) + moved).astype(np.uint64)
    log.topics[at] = replace(one, fields=fields)
    return f"{one.name} at {rate} Hz"


def sparse_flight(log: Log, rng: random.Random) -> str:
    """Move the last sample of one topic one hour later."""
    one = rng.choice(log.topics)
    for name in [n for n in one.fields if n.startswith("timestamp")]:
        one.fields[name][-1] += np.uint64(3_600_000_000)
    return one.name


KINDS: dict[str, Edit] = {
    "topic removed": without_topic,
    "instances": permuted,
    "value of a field": changed_field,
    "times": changed_times,
    "parameters": changed_parameters,
    "rate": changed_rate,
    "flight in an hour": sparse_flight,
}
# Relative frequency of KINDS; fields have the most possible faults
WEIGHTS = (2, 1, 8, 3, 2, 1, 0.5)


def make_changed_ulog(rng: random.Random) -> tuple[str, str, bytes]:
    """Make a changed ULog; return kind of change, description and bytes."""
    of = rng.choice([*bases()])
    kind = rng.choices([*KINDS], WEIGHTS)[0]
    log = copy.deepcopy(bases()[of])
    for one in log.topics:
        assert isinstance(one, Topic)
    faults_found = KINDS[kind](log, rng)
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return f"ULog, {kind}", f"{of}: {faults_found}", log.encode()


def make_changed_tlog(rng: random.Random) -> tuple[str, str, bytes]:
    """Make a changed MAVLink recording; return kind of change, description and bytes."""
    recorder = mavlink_tools.Aisle(seconds=20.0, seed=rng.randrange(5)).record()
    recorder.hear(mavlink_tools.unix(60.0), mavlink_tools.AUTOPILOT, mavlink_tools.message(
        "PARAM_VALUE", param_type=9, param_id=rng.choice(sorted(RANGES)).encode(),
        param_value=rng.choice((1e30, -1.0, 0.0, float("nan"))),
    ))  # fmt: skip
    kind = rng.choice(("message removed", "value of a field", "times", "rate"))
    name = rng.choice(sorted({made.get_type() for _, _, made, _ in recorder.sent}))
    some = [at for at, one in enumerate(recorder.sent) if one[2].get_type() == name]
    detail = ""
    if kind == "message removed":
        recorder.sent = [one for one in recorder.sent if one[2].get_type() != name]
    elif kind == "rate":
        kept = set(some[:: rng.choice((2, 20))])
        recorder.sent = [
            one for at, one in enumerate(recorder.sent) if at in kept or at not in some
        ]
    else:
        fields = recorder.sent[some[0]][2].get_fieldnames()
        stamps = [one for one in fields if one.startswith(("time", "ts1", "tc1"))]
        choice = rng.choice(stamps if kind == "times" and stamps else fields)
        value = rng.choice((float("nan"), float("inf"), 0, 1e30, -1e30, 2**64 - 1, 1, -1))
        detail = f"{choice} {value}"
        for at in some if rng.random() < 0.7 else some[len(some) // 2 :]:
            received, sender, made, link = recorder.sent[at]
            made = copy.copy(made)
            old = getattr(made, choice)
            new = [value] * len(old) if isinstance(old, list | tuple) else value
            setattr(made, choice, new)
            with contextlib.suppress(Exception):  # the type of the field cannot have this value
                mavlink_tools.frame(made)
                recorder.sent[at] = received, sender, made, link
    return f"tlog, {kind}", f"{name} {detail}", recorder.tlog()


# ---------------------------------------------------------------- checks


def impossible(value: Any, path: str = "") -> Iterator[str]:
    """Yield a description of each impossible number in results."""
    if isinstance(value, dict):
        for name, part in value.items():
            yield from impossible(part, f"{path}.{name}")
    elif isinstance(value, list):
        for part in value:
            yield from impossible(part, path)
    elif isinstance(value, str):
        yield from (f"{path}: {faults_found}" for faults_found in impossible_text(value))
    elif isinstance(value, float | int) and not isinstance(value, bool):
        name = path.rpartition(".")[2]
        if not math.isfinite(value):
            yield f"{path} is {value}"
        elif ("nis" in name or "nees" in name or "sigma" in name) and value < 0.0:
            yield f"{path} {value} is negative"
        elif "correlation" in name and "time" not in name and abs(value) > 1.0:
            yield f"{path} {value} is no correlation"
        elif (
            name.endswith("fraction")
            and name != "explained_fraction"
            and not -1e-9 <= value <= 1.0 + 1e-9
        ):
            yield f"{path} {value} is no share"
        elif name.endswith("_m") and abs(value) > LONGEST_M:
            yield f"{path} {value} is no length"
        elif ("ratio" in name or "nis" in name or "factor" in name) and abs(value) > LARGEST_RATIO:
            yield f"{path} {value} is no ratio"


def impossible_text(text: str) -> Iterator[str]:
    """Yield a description of each NaN, None or impossible percentage in a text."""
    for found in re.finditer(r"(?<![\w-])(nan|[+-]?inf|NaN|None|NaT)(?![\w-])", text):
        yield f"says {found[0]}: {text[max(found.start() - 60, 0) : found.end() + 20]!r}"
    for found in re.finditer(r"(?<![\d.,])([-−]?\d[\d.]*(?:e[+-]?\d+)?) ?%", text):
        with contextlib.suppress(ValueError):
            if not 0.0 <= float(found[1].replace("−", "-")) <= 100.0:
                yield f"says {found[0]}: {text[max(found.start() - 60, 0) : found.end() + 20]!r}"


@dataclass
class Outcome:
    """Results of the logs with one kind of change."""

    logs: int = 0
    results: int = 0
    rejected: int = 0
    faults: list[str] = field(default_factory=list)


def run_command(
    command: tuple[str, ...], log: Path, out: Path, outcome: Outcome, label: str
) -> None:
    """Run one command on a log and count its outcome."""
    words = [word.format(log=log, out=out) for word in command]
    where = f"{label}: {command[0]}"
    begin = time.process_time()
    with warnings.catch_warnings(), mock.patch.object(pdf, "render", blank_page):
        warnings.simplefilter("error")
        done = CliRunner().invoke(cli, words)
    took = time.process_time() - begin
    faults = outcome.faults
    if isinstance(done.exception, Px4FuseError):
        outcome.rejected += 1
        if "\n" in str(done.exception):
            faults.append(f"{where}: more than one line: {done.exception!r}")
    elif done.exception is not None and not isinstance(done.exception, SystemExit):
        places = traceback.extract_tb(done.exception.__traceback__)
        at = ([one for one in places if "px4fuse/" in one.filename] or places)[-1]
        name = type(done.exception).__name__
        place = f"{Path(at.filename).name}:{at.lineno} {at.name}"
        faults.append(f"{where}: {name}: {str(done.exception)[:120]} ({place})")
    elif done.exit_code == 2:
        outcome.rejected += 1
        lines = done.output.strip().splitlines()
        if len(lines) != 1 and not (lines and lines[0].startswith("Usage")):
            faults.append(f"{where}: {len(lines)} lines: {done.output[-200:]!r}")
    else:
        outcome.results += 1
    written = [*out.rglob("*.json")]
    faults_found = [*impossible_text(f"{done.output}\n{done.exception or ''}")]
    for path in written:
        faults_found += impossible(json.loads(path.read_text()))
    faults += [f"{where}: {one}" for one in faults_found[:3]]
    if took > SLOW_S:
        faults.append(f"{where}: took {took:.0f} s of CPU")


def run_logs(
    count: int,
    seed: int,
    seconds: float = float("inf"),
    first: int = 0,
    commands: int = len(COMMANDS),
) -> dict[str, Outcome]:
    """Return outcomes by kind of change; the same seed gives the same logs."""
    outcomes: dict[str, Outcome] = {}
    end = time.monotonic() + seconds
    for number in range(first, first + count):
        if time.monotonic() > end:
            break
        rng = random.Random(f"{seed} {number}")
        tlog = rng.random() < 0.2
        kind, detail, content = (make_changed_tlog if tlog else make_changed_ulog)(rng)
        outcome = outcomes.setdefault(kind, Outcome())
        outcome.logs += 1
        with tempfile.TemporaryDirectory() as folder:
            log = Path(folder, "log.tlog" if tlog else "log.ulg")
            log.write_bytes(content)
            for command in rng.sample(COMMANDS, commands):
                out = Path(folder, command[0])
                out.mkdir()
                run_command(command, log, out, outcome, f"{seed} {number} ({detail})")
    return outcomes


def main() -> None:
    """Run the study and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="number of the first log")
    parser.add_argument("--seconds", type=float, default=float("inf"))
    parser.add_argument("--commands", type=int, default=len(COMMANDS), help="drawn for each log")
    given = parser.parse_args()
    outcomes = run_logs(given.count, given.seed, given.seconds, given.first, given.commands)
    print(f"{'change':30}{'logs':>8}{'results':>10}{'one line':>10}{'faults':>10}")
    for kind, one in sorted(outcomes.items()):
        numbers = (one.results, one.rejected, len(one.faults))
        print(f"{kind:30}{one.logs:8}{''.join(f'{n:10}' for n in numbers)}")
    faults = [fault for one in outcomes.values() for fault in one.faults]
    kinds = Counter(re.sub(r"^.*?\): ", "", fault) for fault in faults)
    for kind, times in kinds.most_common(60):
        print(f"{times} times, first {next(fault for fault in faults if kind in fault)}")


if __name__ == "__main__":
    main()
