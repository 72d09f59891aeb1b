"""Damaged input for all file readers: each must give a result or a px4fuse error.

``python tests/studies/fuzz.py --inputs 1000000 --seed 1`` distributes this number of inputs over
the targets and prints how many were read, rejected and failed. Failures are other exceptions,
warnings and more than :data:`SLOW_S` of CPU time; they are printed with the number that reproduces
them. ``--commands 400`` runs whole commands instead, for logs ``compare`` without drawing.

``tests/test_fuzz.py`` runs a part of the study.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import random
import shutil
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from unittest import mock

from click.testing import CliRunner

TESTS = Path(__file__).resolve().parents[1]
if str(TESTS) not in sys.path:
    sys.path.insert(0, str(TESTS))

import mavlink_tools  # noqa: E402
import ulog_tools  # noqa: E402
from class_tools import run_in_turn  # noqa: E402
from conftest import blank_page  # noqa: E402

from px4fuse.classroom.assignment.key import (  # noqa: E402
    AnswerKey,
    CorrectAnswers,
    format_answer_key,
    read_answer_key,
)
from px4fuse.classroom.assignment.roster import (  # noqa: E402
    read_csv_sheet,
    read_people,
    read_roster,
)
from px4fuse.classroom.grading import grade as grading  # noqa: E402
from px4fuse.classroom.grading.entries import read_overrides  # noqa: E402
from px4fuse.classroom.grading.rubric import read_default_rubric_text, read_rubric  # noqa: E402
from px4fuse.cli import cli  # noqa: E402
from px4fuse.core import workers  # noqa: E402
from px4fuse.diagnose import diagnose_or_check_aids  # noqa: E402
from px4fuse.errors import Px4FuseError  # noqa: E402
from px4fuse.readers import read_log  # noqa: E402
from px4fuse.readers.g2o import read_g2o  # noqa: E402
from px4fuse.readers.position_file import read_position_file  # noqa: E402
from px4fuse.readers.trajectory import read_trajectory  # noqa: E402
from px4fuse.request import ComparisonRequest  # noqa: E402
from px4fuse.results import answer_form  # noqa: E402
from px4fuse.results.build import make_comparison_or_aids_results  # noqa: E402
from px4fuse.results.contract import to_json  # noqa: E402
from px4fuse.results.reading import read_results  # noqa: E402
from px4fuse.trajectory.graph.solver import analyse_graph  # noqa: E402
from px4fuse.verification.pdf_input import read_report  # noqa: E402

REPOSITORY = TESTS.parent
REPORT = REPOSITORY / "reports" / "example" / "aisle_uwb.pdf"
SLOW_S, COMMAND_S = 5.0, 15.0
# Numbers and texts that parsers may handle incorrectly
ODD = (
    b"nan", b"-inf", b"1e999", b"-1e-400", b"1.8e308", b"0", b"-0", b"", b"9" * 400, b"0x1p3",
    "١٢".encode(), "−1".encode(), b"1,5", b"1_0", b"\x00", b"\xff\xfe", b"\xef\xbb\xbf", b"#",
    b'"', b"\r", b"\x1b[2J", "\u202e".encode(), b"true", b"null", b"[" * 300, b"{", b"= = =",
)  # fmt: skip


def damaged(content: bytes, rng: random.Random, *, words: bool) -> bytes:
    """Damage a file: change bits, bytes or words, delete, repeat or copy pieces, or truncate."""
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        size = len(data)
        if not size:
            break
        at, length = rng.randrange(size), min(rng.choice((1, 2, 4, 8, 64, 512)), size)
        match rng.randrange(9 if words else 7):
            case 0:
                data[at] ^= 1 << rng.randrange(8)
            case 1:
                data[at : at + length] = rng.randbytes(len(data[at : at + length]))
            case 2:
                data[at : at + length] = bytes([rng.choice((0, 255))]) * length
            case 3:
                del data[at : at + length]
            case 4:
                data[at:at] = data[at : at + length]
            case 5:
                del data[at:]
            case 6:
                other = rng.randrange(size)
                piece = bytes(data[other : other + length])
                data[at : at + length] = piece
            case _:
                # replace one word, so that the text around it stays valid
                ends = [i for i, byte in enumerate(data) if byte in b" ,;\t\n=:\"'"]
                if len(ends) > 1:
                    first = rng.randrange(len(ends) - 1)
                    data[ends[first] + 1 : ends[first + 1]] = rng.choice(ODD)
    return bytes(data)


@dataclass(frozen=True)
class Target:
    """File reader or command under test.

    Attributes
    ----------
    name : str
    seeds : callable
        Returns valid files as bytes.
    read : callable
        Reads the file at a path.
    end : str
        Suffix of the file name.
    words : bool
        True if the format is text.
    in_suite : int
        Number of inputs in the test suite.
    weight : float
        Relative number of inputs in a study; larger for fast readers.
    slow_s : float
        Limit of the CPU time per input.
    """

    name: str
    seeds: Callable[[], list[bytes]]
    read: Callable[[Path], object]
    end: str
    words: bool
    in_suite: int
    weight: float
    slow_s: float = SLOW_S


@dataclass
class Outcome:
    """Results of the inputs of one target."""

    read: int = 0
    rejected: int = 0
    faults: list[str] = field(default_factory=list)


@cache
def _ulogs() -> list[bytes]:
    versions = ("v1.9", "v1.12", "v1.16")
    return [ulog_tools.make_log(one, 1.0, imu_hz=20.0).encode() for one in versions]


@cache
def _recordings() -> list[bytes]:
    sent = mavlink_tools.Aisle(seconds=3.0, imu_hz=20.0).record()
    return [sent.tlog(), sent.raw()]


def _reports() -> list[bytes]:
    """Return the example report, and its results attached to an empty page."""
    report = REPORT
    return [report.read_bytes(), blank_page(None, report.with_suffix(".json").read_text())]


def _report(path: Path) -> object:
    return read_report(path.read_bytes(), path.name)


def _graph(path: Path) -> object:
    return analyse_graph(path.name, read_g2o(path))


def _text(*texts: str) -> Callable[[], list[bytes]]:
    return lambda: [text.encode() for text in texts]


_TRACK = "\n".join(f"{i}.5 {i} {i % 3} 0.1 0 0 0.38268343 0.92387953" for i in range(12))
_EUROC = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], "
_EUROC += "\n".join(["q_RS_z []", *(f"{i}000000000,{i},{i % 3},0.1,1,0,0,0" for i in range(12))])
_KITTI = "\n".join(f"1 0 0 {i} 0 1 0 {i % 3} 0 0 1 0.5" for i in range(12))
_POSITIONS = (
    "time_s,x_m,y_m,z_m,sigma_m\n" + "\n".join(f"{i / 5},{i % 7},0.5,-1,0.1" for i in range(40)),
    "timestamp_us;north;east;down\n" + "\n".join(f"{i}00000;{i % 7};1,5;-1" for i in range(40)),
)
_GRAPH_2D = "\n".join(
    [*(f"VERTEX_SE2 {i} {i} 0 0" for i in range(6)),
     *(f"EDGE_SE2 {i} {i + 1} 1 0 0 10 0 0 10 0 10" for i in range(5)),
     "EDGE_SE2 0 5 5 0.1 0 10 0 0 10 0 10"]
)  # fmt: skip
_WEIGHTS = "9 0 0 0 0 0 9 0 0 0 0 9 0 0 0 9 0 0 9 0 9"
_GRAPH_3D = "\n".join(
    [*(f"VERTEX_SE3:QUAT {i} {i} 0 0 0 0 0 1" for i in range(5)),
     *(f"EDGE_SE3:QUAT {i} {i + 1} 1 0 0 0 0 0 1 {_WEIGHTS}" for i in range(4)),
     f"EDGE_SE3:QUAT 0 4 4 0.1 0 0 0 0 1 {_WEIGHTS}"]
)  # fmt: skip
_ROSTER = "id,name,email\ns1,Ada Lovelace,ada@x.org\ns2,山田,y@x.org\n"
_MOODLE = "Identifier,Full name,ID number,Email address,Grade\nParticipant 7,Ada L,s1,a@x,\n"
_OVERRIDES = "id,item,points,comment\ns1,total,80,good\ns2,,,see me\n"


def _key() -> list[bytes]:
    people = (
        CorrectAnswers("s1", "Ada", "s1.ulg", "0" * 64),
        CorrectAnswers("s2", "山田", "s2.ulg", "1" * 64),
    )
    return [format_answer_key(AnswerKey("aisle", people)).encode()]


def _class_list(path: Path) -> object:
    return read_people(read_csv_sheet(path))


TARGETS = (
    Target("ULog", _ulogs, read_log, ".ulg", False, 60, 0.5),
    Target("MAVLink", _recordings, read_log, ".tlog", False, 60, 0.5),
    Target("trajectory", _text(_TRACK, _EUROC, _KITTI), read_trajectory, ".txt", True, 1800, 20.0),
    Target("position file", _text(*_POSITIONS), read_position_file, ".csv", True, 300, 5.0),
    Target("g2o", _text(_GRAPH_2D, _GRAPH_3D), read_g2o, ".g2o", True, 1800, 20.0),
    Target("pose graph", _text(_GRAPH_2D, _GRAPH_3D), _graph, ".g2o", True, 180, 2.0),
    Target(
        "answers", lambda: [answer_form.format_answer_form("a.ulg", "0" * 64).encode()],
        answer_form.read_answers, ".toml", True, 900, 8.0,
    ),
    Target(
        "results", lambda: [(REPORT.with_suffix(".json")).read_bytes()],
        lambda path: read_results(path.read_bytes()), ".json", True, 100, 2.0,
    ),
    Target("report", _reports, _report, ".pdf", False, 60, 0.2),
    Target("rubric", lambda: [read_default_rubric_text().encode()],
           read_rubric, ".toml", True, 900, 8.0),
    Target("overrides", _text(_OVERRIDES), read_overrides, ".csv", True, 900, 6.0),
    Target("roster", _text(_ROSTER, _MOODLE), read_roster, ".csv", True, 900, 6.0),
    Target("class list", _text(_ROSTER, _MOODLE), _class_list, ".csv", True, 900, 6.0),
    Target("answer key", _key, read_answer_key, ".json", True, 300, 2.0),
)  # fmt: skip


def _command(*words: str) -> Callable[[Path], object]:
    """Return a reader that runs a command in this process."""

    def read(path: Path) -> object:
        out = path.parent / "out"
        shutil.rmtree(out, ignore_errors=True)
        given = [word.format(path=path, out=out) for word in words]
        with contextlib.ExitStack() as stack:
            for module in (grading, workers):
                stack.enter_context(mock.patch.object(module, "run_with_limits", run_in_turn))
            done = CliRunner().invoke(cli, given)
        if done.exception is not None and not isinstance(done.exception, SystemExit):
            raise done.exception
        if done.exit_code == 2:
            raise Px4FuseError(done.output.splitlines()[-1])
        assert done.exit_code in (0, 1)
        return done.output

    return read


def _handed_in() -> list[bytes]:
    report = (REPORT).read_bytes()
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("Ada Lovelace_7", "Grace_8"):
            archive.writestr(f"{name}_assignsubmission_file_/r.pdf", report)
    return [out.getvalue()]


@cache
def _flights() -> list[bytes]:
    return [ulog_tools.make_log(one, 10.0).encode() for one in ("v1.12", "v1.14", "v1.16")]


def _compared(path: Path) -> object:
    """Run ``compare`` without drawing: findings and results of a log."""
    request = ComparisonRequest(log=str(path))
    return to_json(make_comparison_or_aids_results(request, diagnose_or_check_aids(request)))


LOG = str(REPOSITORY / "sample_logs/aisle_uwb.ulg")
COMMANDS = (
    Target("grade", _handed_in, _command("grade", "{path}", "--logs", LOG, "-o", "{out}"), ".zip",
           False, 2, 1.0, COMMAND_S),
    Target("grade by rubric", lambda: [read_default_rubric_text().encode()],
           _command("grade", str(REPORT), "--logs", LOG, "--rubric",
                    "{path}", "-o", "{out}"), ".toml", True, 2, 1.0, COMMAND_S),
    Target("verify", lambda: [(REPORT).read_bytes()],
           _command("verify", "{path}", LOG), ".pdf", False, 2, 1.0, COMMAND_S),
    Target("assign", _text(_ROSTER, _MOODLE),
           _command("simulate", "--assignment", "{path}", "--secret-file", "{path}",
                    "--mistakes", "9", "-o", "{out}"), ".csv", True, 20, 2.0, COMMAND_S),
    Target("batch", lambda: _ulogs() + _recordings(), _command("batch", "{path}", "-o", "{out}"),
           ".ulg", False, 0, 1.0, COMMAND_S),
    Target("compare, ULog", _flights, _compared, ".ulg", False, 0, 2.0),
    Target("compare, MAVLink", lambda: [mavlink_tools.Aisle(seconds=15.0).record().tlog()],
           _compared, ".tlog", False, 0, 1.0),
)  # fmt: skip


def read_input(target: Target, content: bytes, path: Path, outcome: Outcome, label: str) -> None:
    """Read one input and record its result."""
    path.write_bytes(content)
    begin = time.process_time()
    printed = io.StringIO()
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(printed):
            warnings.simplefilter("error")
            target.read(path)
        outcome.read += 1
    except Px4FuseError as error:
        outcome.rejected += 1
        if "\n" in str(error):
            outcome.faults.append(f"{label}: more than one line: {error!r}")
    except Exception as error:  # noqa: BLE001 - every other exception is a fault
        places = traceback.extract_tb(error.__traceback__)
        at = ([one for one in places if "px4fuse/" in one.filename] or places)[-1]
        outcome.faults.append(
            f"{label}: {type(error).__name__}: {str(error)[:120]} "
            f"({Path(at.filename).name}:{at.lineno} {at.name})"
        )
    if printed.getvalue():
        outcome.faults.append(f"{label}: it printed {printed.getvalue()[:80]!r}")
    if (took := time.process_time() - begin) > target.slow_s:
        outcome.faults.append(f"{label}: took {took:.1f} s of CPU")


def run_target(target: Target, count: int, seed: int, folder: Path) -> Outcome:
    """Run a number of inputs of a target; the same seed gives the same inputs."""
    outcome, seeds = Outcome(), target.seeds()
    for number in range(count):
        rng = random.Random(f"{target.name} {seed} {number}")
        content = damaged(rng.choice(seeds), rng, words=target.words)
        path = folder / f"input{target.end}"
        read_input(target, content, path, outcome, f"{target.name} {seed} {number}")
    return outcome


def main() -> None:
    """Run the study and print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--inputs", type=int, default=1_000_000)
    parser.add_argument("--commands", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="")
    given = parser.parse_args()
    targets = [one for one in (COMMANDS if given.commands else TARGETS) if given.only in one.name]
    weights = sum(one.weight for one in targets)
    inputs = given.commands or given.inputs
    print(f"{'target':20}{'inputs':>10}{'read':>10}{'rejected':>10}{'faults':>10}{'s':>8}")
    with tempfile.TemporaryDirectory() as folder:
        for target in targets:
            count = round(inputs * target.weight / weights)
            begin = time.monotonic()
            outcome = run_target(target, count, given.seed, Path(folder))
            took = time.monotonic() - begin
            numbers = (count, outcome.read, outcome.rejected, len(outcome.faults))
            print(f"{target.name:20}{''.join(f'{n:10}' for n in numbers)}{took:8.0f}", flush=True)
            kinds = Counter(escape.split(": ", 1)[1] for escape in outcome.faults)
            first = {e.split(": ", 1)[1]: e for e in reversed(outcome.faults)}
            for kind, times in kinds.most_common(20):
                print(f"    {times} times, first {first[kind]}", flush=True)


if __name__ == "__main__":
    main()
