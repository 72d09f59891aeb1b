"""Logs with changed values, times, topics, parameters and rates as input of whole commands.

``python tests/studies/fuzz_fields.py --count 5000 --seed 1`` makes this number of logs from 14 s of
UWB, vision and GNSS flights and of MAVLink recordings. Change, topic, field and value are drawn for
each log, so a part of the logs is a fair sample of all. Each log is the input of compare and of
``--commands`` others. A table by kind of change lists logs, logs read as a flight, logs with
results of compare, commands, commands with an error of one line, and faults: exceptions, warnings,
limits exceeded (:data:`SLOW_S`, :data:`LARGEST_BYTES`) and impossible statements
(:func:`impossible`). A fault is printed with the number that reproduces it (``--first``).

The last run (seed 1, ``--commands 1 --first 50``) was stopped after 501 of 5,000 logs::

    change       logs   read  compared  commands  one line  exceptions  warnings  limits  statements
    ULog          398    398       393       796       117           0         1       0           0
    tlog          103    103        71       206        88           0         0       0           0

The warning (a replay without a logged state in its time) is now an error of one line. Two texts
"Findings: None." were counted as statements, which :func:`impossible_text` no longer does.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import gc
import json
import math
import random
import re
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cache, lru_cache
from pathlib import Path
from threading import Event
from typing import Any
from unittest import mock

TESTS = Path(__file__).resolve().parents[1]
if str(TESTS) not in sys.path:
    sys.path.insert(0, str(TESTS))

import one_thread  # noqa: E402, F401 - before NumPy

# isort: split
import mavlink_tools  # noqa: E402
import numpy as np  # noqa: E402
from click.testing import CliRunner  # noqa: E402
from conftest import blank_page  # noqa: E402
from exchange import replace  # noqa: E402
from mavlink_tools import Aisle, Recorder, frame, message, raw_frame, stamp  # noqa: E402
from pypdf import PdfReader  # noqa: E402
from ulog_tools import Log, load  # noqa: E402

from px4fuse.cli import cli  # noqa: E402
from px4fuse.errors import Px4FuseError  # noqa: E402
from px4fuse.flight.ekf2_parameters import KNOWN_PARAMETERS  # noqa: E402
from px4fuse.readers import mavlink, read_log, ulog  # noqa: E402
from px4fuse.report import pdf  # noqa: E402
from px4fuse.results.bounds import MAX_ABSOLUTE_LENGTH_M, MAX_ABSOLUTE_RATIO  # noqa: E402
from px4fuse.simulation.ulog_writer import Topic  # noqa: E402

REPOSITORY = TESTS.parent
SLOW_S, LARGEST_BYTES = 60.0, 1_000_000_000
SECONDS = 14.0  # of flight in a log: KF and tune need about 10 s
# Share of reports that are drawn; drawing takes longer than all other steps
DRAWN_SHARE = 0.02
COMPARE = ("compare", "{log}", "-o", "{out}/r.pdf")
OTHERS = (
    ("whatif", "{log}", "--json", "{out}/r.json"),
    ("whatif", "{log}", "--set", "EKF2_ACC_NOISE=0.5", "--json", "{out}/r.json"),
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
    """Keep a time interval of a log, and a part of the samples of a fast IMU or position source."""
    first = min(
        int(one.fields["timestamp"][0]) for one in log.topics if one.name == "sensor_combined"
    )
    low, high = (first + round(1e6 * at) for at in (start_s, start_s + seconds))
    topics = []
    for one in log.topics:
        times = one.fields["timestamp"]
        keep = np.flatnonzero((times >= low) & (times < high))
        if len(keep) > 200 * seconds:
            keep = keep[::2]
        if re.search("visual_odometry|aid_src_ev", one.name) and len(keep) > 20 * seconds:
            keep = keep[::3]
        if len(keep):
            topics.append(replace(one, fields={n: v[keep] for n, v in one.fields.items()}))
    return Log(topics, log.parameters, log.info)


@cache
def bases() -> dict[str, Log]:
    """Return parts of flights with UWB, vision and GNSS."""
    samples = REPOSITORY / "sample_logs"
    with tempfile.TemporaryDirectory() as folder:
        aisle, outdoor = Path(folder, "aisle.ulg"), Path(folder, "outdoor.ulg")
        for words in (
            ["-o", str(aisle), "--passes", "1", "--length", "6"],
            ["-o", str(outdoor), "--kind", "outdoor"],
        ):
            done = CliRunner().invoke(cli, ["simulate", *words], catch_exceptions=False)
            assert done.exit_code == 0, done.output
        return {
            "UWB": cut_log(load(samples / "aisle_uwb.ulg"), 60.0),
            "UWB, whole flight": load(aisle),
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
    name = rng.choice(sorted({*log.parameters} | {*KNOWN_PARAMETERS}))
    value: float | None = rng.choice(
        (None, np.nan, np.inf, -1.0, 0.0, 1e30, -1e30, 1e6, 1e-30, "low", "high")
    )
    if value is None:
        log.parameters.pop(name, None)
    elif isinstance(value, str):
        known = KNOWN_PARAMETERS.get(name)
        value = 0.0 if known is None else known.minimum if value == "low" else known.maximum
    if value is not None:
        log.parameters[name] = float(value)
    return f"{name} {value}"


def changed_rate(log: Log, rng: random.Random) -> str:
    """Resample one or all topics at a rate from 0.1 Hz to 1 kHz, without interpolation."""
    rate = rng.choice((0.1, 0.5, 2.0, 10.0, 50.0, 250.0, 1000.0))
    chosen = range(len(log.topics)) if rng.random() < 0.1 else [rng.randrange(len(log.topics))]
    for at in chosen:
        one = log.topics[at]
        times = one.fields["timestamp"].astype(np.float64)
        wanted = np.arange(times[0], times[-1] + 1.0, 1e6 / rate)
        rows = np.clip(np.searchsorted(times, wanted), 0, len(times) - 1)
        fields = {name: values[rows].copy() for name, values in one.fields.items()}
        for name in [n for n in fields if n.startswith("timestamp")]:
            fields[name] = (fields[name].astype(np.float64) + wanted - times[rows]).astype(
                np.uint64
            )
        log.topics[at] = replace(one, fields=fields)
    return f"{log.topics[chosen[0]].name} and {len(chosen) - 1} others at {rate} Hz"


def late_sample(log: Log, rng: random.Random) -> str:
    """Move the last sample of one topic one hour later."""
    one = rng.choice(log.topics)
    for name in [n for n in one.fields if n.startswith("timestamp")]:
        one.fields[name][-1] += np.uint64(3_600_000_000)
    return f"last sample of {one.name}"


def short_flight(log: Log, rng: random.Random) -> str:
    """Put ten seconds of flight between two half hours on the ground."""
    if rng.random() < 0.2:
        return late_sample(log, rng)
    first, last = (edge(edge(one.fields["timestamp"]) for one in log.topics) for edge in (min, max))
    middle, rate = (int(first) + int(last)) / 2, rng.choice((0.2, 1.0, 10.0))
    for at, one in enumerate(log.topics):
        times = one.fields["timestamp"].astype(np.float64)
        flying = np.flatnonzero(abs(times - middle) < 5e6)
        if not len(flying):
            continue
        count, step = round(1800 * rate), 1e6 / rate
        before = times[flying[0]] - step * np.arange(count, 0, -1)
        after = times[flying[-1]] + step * np.arange(1, count + 1)
        rows = np.concatenate([[flying[0]] * count, flying, [flying[-1]] * count])
        fields = {name: values[rows].copy() for name, values in one.fields.items()}
        moved = np.concatenate([before, times[flying], after]) - times[rows] + 3.6e9
        for name in [n for n in fields if n.startswith("timestamp")]:
            fields[name] = (fields[name].astype(np.float64) + moved).astype(np.uint64)
        if "landed" in fields:
            fields["landed"][:count] = fields["landed"][-count:] = 1
        log.topics[at] = replace(one, fields=fields)
    return f"{rate} Hz on the ground"


def two_changes(log: Log, rng: random.Random) -> str:
    kinds = [kind for kind in KINDS if kind != "two changes"]
    return ", ".join(KINDS[rng.choice(kinds)](log, rng) for _ in range(2))


KINDS: dict[str, Edit] = {
    "topic removed": without_topic,
    "primary_instances": permuted,
    "value of a field": changed_field,
    "times": changed_times,
    "parameters": changed_parameters,
    "rate": changed_rate,
    "flight in an hour": short_flight,
    "two changes": two_changes,
}
# Relative frequency of KINDS; fields have the most possible faults
WEIGHTS = (2, 1, 8, 3, 2, 2, 0.5, 3)


def make_changed_ulog(rng: random.Random) -> tuple[str, str, bytes]:
    """Make a changed ULog; return kind of change, description and bytes."""
    of = rng.choice([*bases()])
    kind = rng.choices([*KINDS], WEIGHTS)[0]
    log = copy.deepcopy(bases()[of])
    for one in log.topics:
        assert isinstance(one, Topic)
    description = KINDS[kind](log, rng)
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return f"ULog, {kind}", f"{of}: {description}", log.encode()


def recorded(recorder: Recorder, rng: random.Random, key: bytes | None, v1_share: float) -> bytes:
    """Return a recording with signed frames, or with some frames of MAVLink 1."""
    content, sequence = b"", Counter[Any]()
    for received, sender, made, _ in sorted(recorder.sent, key=lambda one: one[0]):
        v1 = rng.random() < v1_share and made.get_msgId() < 256
        received_us = min(max(round(received * 1e6), 0), 2**64 - 1)
        content += stamp(received_us)
        content += frame(made, sender, sequence[sender], v1=v1, key=None if v1 else key)
        sequence[sender] += 1
        if rng.random() < 0.01:  # a message of an unknown dialect
            content += stamp(received_us)
            content += raw_frame(rng.choice((230, 9_999, 60_000)), rng.randbytes(30), seed=7)
    return content


def add_vehicle(recorder: Recorder, rng: random.Random) -> str:
    """Add a second vehicle with other rates, message types and length of flight."""
    Aisle(
        seconds=rng.choice((5.0, 14.0, 30.0)), system=rng.choice((2, 1, 255)),
        start_s=mavlink_tools.BOOT_S + rng.choice((0.0, 3.0, 500.0)), imu_hz=20.0,
        uwb=rng.choice(("VISION_POSITION_ESTIMATE", "ODOMETRY", None)), asks=rng.random() < 0.5,
    ).record(recorder)  # fmt: skip
    return "second vehicle"


def add_other_dialect(recorder: Recorder, rng: random.Random) -> str:
    """Add messages of all dialects with random values, and an autopilot other than PX4."""
    names = rng.sample(sorted(mavlink_tools.MESSAGES), 30)
    for name in names:
        kind = mavlink_tools.MESSAGES[name]
        for _ in range(5):
            at = mavlink_tools.unix(mavlink_tools.BOOT_S + rng.uniform(0.0, SECONDS))
            values = {
                one: rng.choice((0, 1, 100, 255))
                for one, wire, length in zip(
                    kind.fieldnames, kind.fieldtypes,
                    dict(zip(kind.ordered_fieldnames, kind.array_lengths, strict=True)).values(),
                    strict=True,
                )
                if not length and wire not in ("char", "int8_t")
            }  # fmt: skip
            made = message(name, **values)
            with contextlib.suppress(Exception):  # the type of a field cannot have its value
                frame(made)
                recorder.hear(at, rng.choice(((1, 1), (1, 197), (7, 1))), made)
    recorder.hear(
        mavlink_tools.unix(mavlink_tools.BOOT_S), (7, 1), mavlink_tools.heartbeat(autopilot=3)
    )
    return "30 messages of all dialects"


def changed_message(recorder: Recorder, kind: str, rng: random.Random) -> str:
    """Remove the messages of one type, or change a field, the times or the rate of them."""
    name = rng.choice(sorted({made.get_type() for _, _, made, _ in recorder.sent}))
    some = [at for at, one in enumerate(recorder.sent) if one[2].get_type() == name]
    if kind == "message removed":
        recorder.sent = [one for one in recorder.sent if one[2].get_type() != name]
        return name
    if kind == "rate":
        dropped = {*some} - {*some[:: rng.choice((2, 20, 1000))]}
        recorder.sent = [one for at, one in enumerate(recorder.sent) if at not in dropped]
        return name
    fields = recorder.sent[some[0]][2].get_fieldnames()
    times = [one for one in fields if one.startswith(("time", "ts1", "tc1", "usec"))]
    if kind == "times" and (not times or rng.random() < 0.3):
        moved_s = rng.choice((-3600.0, 3600.0, -0.5, 60.0))
        for at in some[len(some) // 2 :]:
            received, *rest = recorder.sent[at]
            recorder.sent[at] = (received + moved_s, *rest)
        return f"{name} received {moved_s} s later"
    choice = rng.choice(times if kind == "times" else fields)
    value = rng.choice((math.nan, math.inf, -math.inf, 0, 1e30, -1e30, 2**64 - 1, 2**32 - 1, 1, -1))
    for at in some if rng.random() < 0.7 else some[len(some) // 2 :]:
        received, sender, made, link = recorder.sent[at]
        made = copy.copy(made)
        old = getattr(made, choice)
        setattr(made, choice, [value] * len(old) if isinstance(old, list | tuple) else value)
        with contextlib.suppress(Exception):  # the type of the field cannot have this value
            frame(made)
            recorder.sent[at] = received, sender, made, link
    return f"{name}.{choice} {value}"


@cache
def recordings() -> list[Recorder]:
    """Return recordings of the flight with several position messages and clocks."""
    return [
        Aisle(seconds=20.0, seed=seed, uwb=uwb, noise_m=0.1, asks=seed == 2).record()
        for seed, uwb in ((1, "VISION_POSITION_ESTIMATE"), (2, "ODOMETRY"), (3, None))
    ]


def make_changed_tlog(rng: random.Random) -> tuple[str, str, bytes]:
    """Make a changed MAVLink recording; return kind of change, description and bytes."""
    recorder = copy.copy(rng.choice(recordings()))
    recorder.sent = [*recorder.sent]
    if rng.random() < 0.3:
        recorder.hear(mavlink_tools.unix(60.0), mavlink_tools.AUTOPILOT, message(
            "PARAM_VALUE", param_type=9, param_id=rng.choice(sorted(KNOWN_PARAMETERS)).encode(),
            param_value=rng.choice((1e30, -1.0, 0.0, math.nan)),
        ))  # fmt: skip
    kind, key, v1_share = rng.choice(TLOG_KINDS), None, 0.0
    details = []
    if kind == "two vehicles":
        details.append(add_vehicle(recorder, rng))
    elif kind == "mixed dialects":
        v1_share = 0.5
        details.append(add_other_dialect(recorder, rng))
    elif kind == "signed frames":
        key = rng.randbytes(32)
    if kind in TLOG_KINDS[:4] or rng.random() < 0.7:
        details.append(changed_message(recorder, rng.choice(TLOG_KINDS[:4]), rng))
    return f"tlog, {kind}", ", ".join(details), recorded(recorder, rng, key, v1_share)


TLOG_KINDS = (
    "message removed", "value of a field", "times", "rate", "two vehicles", "mixed dialects",
    "signed frames",
)  # fmt: skip


# ---------------------------------------------------------------- checks


def impossible(value: Any, path: str = "") -> Iterator[str]:
    """Yield a description of each impossible number in results."""
    if isinstance(value, dict):
        for name, part in value.items():
            yield from impossible(part, f"{path}.{name}")
    elif isinstance(value, list):
        for part in value:
            yield from impossible(part, path)
    elif isinstance(value, str) and not path.endswith("sha256"):
        yield from (f"{path}: {description}" for description in impossible_text(value))
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
        elif name.endswith("_m") and abs(value) > MAX_ABSOLUTE_LENGTH_M:
            yield f"{path} {value} is no length"
        elif ("ratio" in name or "nis" in name or "factor" in name) and abs(
            value
        ) > MAX_ABSOLUTE_RATIO:
            yield f"{path} {value} is no ratio"


def impossible_text(text: str) -> Iterator[str]:
    """Yield a description of each NaN, None, huge number or impossible percentage in a text."""
    for found in re.finditer(r"(?<![\w-])(nan|[+-]?inf|NaN|None(?!\.)|NaT)(?![\w-])", text):
        yield f"says {found[0]}: {text[max(found.start() - 60, 0) : found.end() + 20]!r}"
    for line in text.splitlines():
        # a value that is reported as outside its range is no statement about the flight
        large = re.search(r"(?<![\w.])[-−]?\d[\d.,]*e\+?\d{2,}|(?<![\w.])[-−]?\d[\d,]{19,}", line)
        if large and not re.search("range|allowed|outside|finite|between|limit|SHA-256", line):
            yield f"says {large[0]}: {line[max(large.start() - 60, 0) : large.end() + 20]!r}"
    for found in re.finditer(r"(?<![\d.,])([-−]?\d[\d.]*(?:e[+-]?\d+)?) ?%", text):
        if "mean square" in text[max(found.start() - 60, 0) : found.end() + 20]:
            continue  # contributions to a difference have both signs
        with contextlib.suppress(ValueError):
            if not 0.0 <= float(found[1].replace("−", "-")) <= 100.0:
                yield f"says {found[0]}: {text[max(found.start() - 60, 0) : found.end() + 20]!r}"


@dataclass
class Outcome:
    """Counts and faults of the logs with one kind of change."""

    counts: Counter[str] = field(default_factory=Counter)
    faults: list[tuple[str, str]] = field(default_factory=list)

    def add_fault(self, kind: str, text: str) -> None:
        """Count a fault and print it."""
        self.counts[kind] += 1
        self.faults.append((kind, text))
        print(f"{kind}: {text}", file=sys.stderr, flush=True)


class TookTooLongError(BaseException):
    """A command used more than SLOW_S of CPU time."""


def _give_up(*_: object) -> None:
    raise TookTooLongError


def peak_bytes(*, reset: bool = False) -> int:
    """Return the largest resident memory of this process since the last reset (Linux)."""
    if reset:
        Path("/proc/self/clear_refs").write_text("5")
    return 1024 * int(re.findall(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())[0])


def place_of(error: BaseException) -> str:
    """Return the last place in px4fuse at which an exception was raised."""
    places = traceback.extract_tb(error.__traceback__)
    at = ([one for one in places if "/px4fuse/" in one.filename] or places)[-1]
    return f"{Path(at.filename).name}:{at.lineno} {at.name}"


def written_statements(out: Path) -> Iterator[str]:
    """Yield the impossible statements in the outputs of a command."""
    for path in out.rglob("*.json"):
        yield from impossible(json.loads(path.read_text()))
    for path in out.rglob("*.html"):
        for data in re.findall(
            r'<script[^>]*type="application/json"[^>]*>(.*?)</script>', path.read_text(), re.S
        ):
            json.loads(data, parse_constant=_reject_constant)
    for path in out.rglob("*.pdf"):
        for page in PdfReader(path).pages:
            # without percentages: those of contributions have both signs, apart from their title
            yield from impossible_text(page.extract_text().replace("%", ""))


def _reject_constant(name: str) -> None:
    raise ValueError(f"the page contains {name}")


def run_command(
    command: tuple[str, ...], log: Path, out: Path, outcome: Outcome, label: str, *, draw: bool
) -> bool:
    words = [word.format(log=log, out=out) for word in command]
    where = f"{label}: {command[0]}"
    outcome.counts["commands"] += 1
    peak_bytes(reset=True)
    signal.signal(signal.SIGPROF, _give_up)
    signal.setitimer(signal.ITIMER_PROF, SLOW_S)
    try:
        with contextlib.ExitStack() as stack:
            stack.enter_context(warnings.catch_warnings())
            warnings.simplefilter("error")
            if not draw:
                stack.enter_context(mock.patch.object(pdf, "render_pdf", blank_page))
            done = CliRunner().invoke(cli, words)
    except TookTooLongError as error:
        outcome.add_fault("limits", f"{where}: more than {SLOW_S:.0f} s ({place_of(error)})")
        return False
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
    if (peak := peak_bytes()) > LARGEST_BYTES:
        outcome.add_fault("limits", f"{where}: {peak / 1e9:.2f} GB")
    failure = done.exception
    if isinstance(failure, Px4FuseError):
        outcome.counts["one line"] += 1
        if "\n" in str(failure):
            outcome.add_fault("exceptions", f"{where}: more than one line: {failure!r}")
    elif failure is not None and not isinstance(failure, SystemExit):
        kind = "warnings" if isinstance(failure, Warning) else "exceptions"
        text = f"{type(failure).__name__}: {str(failure)[:120]} ({place_of(failure)})"
        outcome.add_fault(kind, f"{where}: {text}")
    elif done.exit_code not in (0, 1):  # no option of COMPARE and OTHERS is wrong
        outcome.add_fault("exceptions", f"{where}: {done.output[-200:]!r}")
    try:
        found = [*impossible_text(f"{done.output}\n{failure or ''}"), *written_statements(out)]
    except ValueError as invalid:
        found = [f"JSON: {invalid}"]
    for one in found[:3]:
        outcome.add_fault("statements", f"{where}: {one}")
    return failure is None and done.exit_code in (0, 1)


def is_flight(log: Path) -> bool:
    """Return True if a log can be read without a warning; the commands report the faults."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            read_log(log)
        except Exception:  # noqa: BLE001 - the commands report it
            return False
    return True


def run_logs(
    count: int,
    seed: int,
    seconds: float = math.inf,
    first: int = 0,
    others: int = len(OTHERS),
) -> dict[str, Outcome]:
    """Return outcomes by kind of change; the same seed gives the same logs."""
    outcomes: dict[str, Outcome] = {}
    # all commands of a log use the flight that was read once
    mock.patch.object(ulog, "read_ulog", lru_cache(1)(ulog.read_ulog)).start()
    mock.patch.object(mavlink, "read_mavlink", lru_cache(1)(mavlink.read_mavlink)).start()
    gc.freeze()
    stopped = Event()  # a terminated study prints the table of the logs so far
    signal.signal(signal.SIGTERM, lambda *_: stopped.set())
    end = time.monotonic() + seconds
    for number in range(first, first + count):
        if stopped.is_set() or time.monotonic() > end:
            break
        rng = random.Random(f"{seed} {number}")
        tlog = rng.random() < 0.2
        kind, detail, content = (make_changed_tlog if tlog else make_changed_ulog)(rng)
        outcome = outcomes.setdefault(kind, Outcome())
        outcome.counts["logs"] += 1
        label, draw = f"{seed} {number} ({detail})", rng.random() < DRAWN_SHARE
        with tempfile.TemporaryDirectory() as folder:
            log = Path(folder, "log.tlog" if tlog else "log.ulg")
            log.write_bytes(content)
            outcome.counts["read"] += is_flight(log)
            for at, command in enumerate((COMPARE, *rng.sample(OTHERS, others))):
                out = Path(folder, str(at))
                out.mkdir()
                has_results = run_command(command, log, out, outcome, label, draw=draw)
                outcome.counts["results" if at else "compared"] += has_results
    return outcomes


COLUMNS = (
    "logs", "read", "compared", "commands", "one line", "exceptions", "warnings", "limits",
    "statements",
)  # fmt: skip


def main() -> None:
    """Run the study and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="number of the first log")
    parser.add_argument("--seconds", type=float, default=math.inf)
    parser.add_argument("--commands", type=int, default=len(OTHERS), help="drawn for each log")
    given = parser.parse_args()
    outcomes = run_logs(given.count, given.seed, given.seconds, given.first, given.commands)
    print(f"{'change':26}{''.join(f'{name:>11}' for name in COLUMNS)}")
    total = sum((one.counts for one in outcomes.values()), Counter[str]())
    for kind, counts in [(k, one.counts) for k, one in sorted(outcomes.items())] + [("all", total)]:
        print(f"{kind:26}{''.join(f'{counts[name]:11}' for name in COLUMNS)}")
    faults = [fault for one in outcomes.values() for _, fault in one.faults]
    kinds = Counter(re.sub(r"^.*?\): ", "", fault) for fault in faults)
    for kind, times in kinds.most_common(60):
        print(f"{times} times, first {next(fault for fault in faults if kind in fault)}")


if __name__ == "__main__":
    main()
