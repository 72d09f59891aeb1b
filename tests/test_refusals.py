"""Invalid input of all commands: one line with an action on standard error, and no output."""

from __future__ import annotations

import shlex
from pathlib import Path

import numpy as np
import pytest
from cli_tools import contents, run_main
from conftest import REPOSITORY
from ulog_tools import make_log

from px4fuse.flight.ekf2_parameters import MODEL_PARAMETERS

pytestmark = pytest.mark.usefixtures("cached_analyses")

SAMPLES = REPOSITORY / "sample_logs"
REPORT = REPOSITORY / "reports" / "example" / "aisle_uwb.pdf"
LINES = (SAMPLES / "loop_slam.tum").read_text().splitlines()
ROWS = [line for line in LINES if not line.startswith("#")]


def text(rows: list[str]) -> bytes:
    return "".join(f"{row}\n" for row in rows).encode()


def straight(step_m: float) -> bytes:
    return text([f"{0.1 * i:.1f} {step_m * i} 0 0 0 0 0 1" for i in range(100)])


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    """Valid and invalid logs, position files, trajectories, pose graphs and reports."""
    folder = tmp_path_factory.mktemp("desk")
    binary = np.random.default_rng(0).bytes(5000)
    for name, content in {
        "a.ulg": (SAMPLES / "aisle_uwb.ulg").read_bytes(),
        "c.csv": (SAMPLES / "aisle_uwb_external.csv").read_bytes(),
        "l.ulg": (SAMPLES / "loop_vio.ulg").read_bytes(), "straight.ulg": make_log().encode(),
        "empty.ulg": b"", "bad.ulg": b"no log at all", "empty.tum": b"", "junk.bin": binary,
        "f.pdf": b"%PDF-1.7\n\x00\x01\x02" + binary, "n.md": b"my own words", "abc.txt": b"abc",
        "roster.csv": b"id,name\ns01,Ada\n", "junk.txt": b"hello world\nthis is no data\n",
        "s.tum": text(ROWS), "s.pdf": text(ROWS),
        "still.tum": straight(0.0), "line.tum": straight(0.1),
        "g.g2o": text([*(f"VERTEX_SE2 {i} {i} 0 0" for i in range(3)),
                       *(f"EDGE_SE2 {i} {i + 1} 1 0 0 1 0 0 1 0 1" for i in range(2))]),
        "bad.g2o": b"VERTEX_SE2 0 0 0 0\nEDGE_SE2 0 7 1 0 0 1 0 0 1 0 1\n",
    }.items():  # fmt: skip
        (folder / name).write_bytes(content)
    (folder / "hard.json").hardlink_to(folder / "a.ulg")
    (folder / "soft.json").symlink_to(folder / "l.ulg")
    for name in ("empty", "in", "reports"):
        (folder / name).mkdir()
    (folder / "in" / "a.pdf").write_bytes(REPORT.read_bytes())
    (folder / "reports" / "bad.pdf").write_text("an older report")
    return folder


# Command, and a part of its error message
REFUSED = {
    # settings
    "no noise": ("compare a.ulg --sigma-a 0", "--sigma-a 0 is out of range"),
    "noise of NaN": ("compare a.ulg --sigma-z nan", "--sigma-z"),
    "endless offset": ("compare a.ulg --clock-offset inf", "--clock-offset"),
    "heading of NaN": ("compare a.ulg --heading nan", "--heading"),
    "beyond the flight": ("compare a.ulg --start 500", "has 0 positions between 500 s and"),
    "end before start": (
        "compare a.ulg --start 50 --end 40",
        "end (40 s) is not after the start (50 s)",
    ),
    "no such source": ("compare a.ulg --position-source nonsense", "no such source"),
    "no notes": ("compare a.ulg --notes absent.md", "absent.md"),
    "no report": ("compare a.ulg -o report.txt", "report.txt"),
    "a file as a folder": ("compare a.ulg -o n.md/r.pdf", "n.md"),
    "no such axis": ("compare a.ulg --axis up", "up"),
    "no such option": ("compare a.ulg --no-such-option", "--no-such-option"),
    "auto at constant speed": (
        "compare straight.ulg --clock-offset auto",
        "--clock-offset SECONDS",
    ),
    # slips, and what to type instead
    "slip of a command": ("comapre x.ulg", "Did you mean compare?"),
    "no command": ("l.ulg --dt 0.2", "px4fuse compare l.ulg --dt 0.2"),
    "slip of an option": ("compare l.ulg --sigmaz 1", "--sigma-z"),
    "metres with a unit": (
        "compare l.ulg --sigma-z 10cm",
        "not a number in metres. Give 0.1.",
    ),
    "seconds with a unit": (
        "tune l.ulg --start 20s",
        "not a number in seconds. Give 20.",
    ),
    "offset with a unit": ("sync l.ulg --clock-offset -120ms", "in seconds or auto. Give -0.12."),
    "negative heading": ("compare l.ulg --heading -30", "not between 0 and 360"),
    "heading of words": (
        "compare l.ulg --heading north",
        "not a number in degrees.",
    ),
    "heading of a simulation": ("simulate -o s.ulg --heading 361", "--heading 361 is out of range"),
    "speed with a unit": (
        "simulate -o s.ulg --speed 3.6km/h",
        "not a number in metres per second.",
    ),
    "drift with a unit": (
        "loop l.ulg --drift '1 m'",
        "not a number in metres. Give 1.",
    ),
    "delay with a unit": ("whatif l.ulg --set EKF2_EV_DELAY=0.1s", "in milliseconds. Give 100."),
    "system of a ULog": (
        "compare a.ulg --system 1",
        "a.ulg: the file is a ULog, but --system is only for MAVLink recordings",
    ),
    "far time offset": ("evaluate l.ulg:vio s.tum --time-offset 9e5", "set --time-offset to auto"),
    "loop of no drift": ("loop l.ulg --drift 0", "--drift 0 is out of range (0.0001 to 100)"),
    # simulations, pages and invalid logs
    "simulation as PDF": ("simulate -o flight.pdf", "ending in .ulg"),
    "log and answer": ("simulate -o x.ulg --answer x.ulg", "the same file name"),
    "page of nothing": ("explore missing.ulg", "missing.ulg"),
    "page as PDF": ("explore a.ulg -o page.pdf", "ending in .html"),
    "page of three": ("explore a.ulg a.ulg a.ulg", "unexpected extra argument"),
    "too long a name": (f"info a.ulg --json {'x' * 300}.json", "File name too long"),
    "no name": ("extract a.ulg -o ''", "the file name is empty"),
    "no name of a log": ("batch '' -o out", "the name of a log is empty"),
    **{
        f"{name} by {command}": (f"{command} {name}.ulg", f"px4fuse: {name}.ulg")
        for name in ("missing", "empty", "bad")
        for command in ("compare", "info", "extract -o tables", "tune", "sync")
    },
    # practice, verify and whatif
    "no such level": ("practice --level 4", "4 is not in the range"),
    "practice as PDF": ("practice -o a.pdf", "ending in .html"),
    "practice of nothing": ("practice --flights 0", "0 is not in the range"),
    "practice by no seed": ("practice --seed -1", "-1 is not in the range"),
    "verify nothing": ("verify none.pdf", "none.pdf"),
    "verify a log": ("verify a.ulg", "a.ulg"),
    "verify by nothing": (f"verify {REPORT} none.ulg", "none.ulg"),
    **{
        f"what if {typed}": (f"whatif missing.ulg {typed}", said)  # before the log is read
        for typed, said in (
            ("--set EKF2_BARO_DELAY=1", ", ".join(MODEL_PARAMETERS)),
            ("--set EKF2_EVP_NOISE", "is not NAME=VALUE"),
            ("--set EKF2_EVP_NOISE=much", "EKF2_EVP_NOISE: 'much' is not a number"),
            ("--set EKF2_EVP_GATE=4SD", "'4SD' is not a number in SD. Give 4"),
            ("--set EKF2_EVP_NOISE=nan", "not a finite number"),
            ("--set EKF2_EVP_GATE=3 --set EKF2_EVP_GATE=4", "given twice"),
            ("--sweep EKF2_EVP_NOISE=0.1", "is not NAME=LOW:HIGH"),
            (
                "--sweep EKF2_EVP_NOISE=0.2:0.1",
                "EKF2_EVP_NOISE=0.2:0.1: give the smaller parameter value first",
            ),
            (
                "--sweep EKF2_EVP_NOISE=0.1:0.2:1",
                "1 is not a valid number of sweep values. Use 2 to 200.",
            ),
            (
                "--set EKF2_EVP_NOISE=0.1 --sweep EKF2_EVP_NOISE=0.1:0.2",
                "has both a new value and a sweep",
            ),
            ("--from 60", "--from requires --without AID"),
        )
    },
    # batch and grade
    "batch of nothing": ("batch empty -o o", "no logs found"),
    "batch of what is missing": ("batch none.ulg -o o", "no logs found"),
    "batch of a pattern": ("batch x*.ulg -o o", "no logs found"),
    "batch without logs": ("batch -o o", "no logs"),
    "batch to nowhere": ("batch a.ulg", "-o"),
    "batch into a file": ("batch a.ulg -o n.md", "n.md is a file, but the output"),
    "batch of no noise": ("batch a.ulg -o o --sigma-z 0", "--sigma-z 0 is out of range"),
    "two kinds of workers": ("batch a.ulg -o o --scheduler tcp://h:1 --workers 2", "--workers"),
    "memory of words": ("batch a.ulg -o o --memory lots", "--memory"),
    "batch from a bucket": ("batch s3://bucket/logs -o o", 'pip install "s3fs"'),
    "batch from nonsense": ("batch nonsense://x -o o", "nonsense"),
    "nothing to grade": ("grade", "no submissions were given"),
    "grade to nowhere": ("grade in", "requires an output folder"),
    "grade into what is graded": ("grade in -o in/out", "is inside the input in"),
    "grade into a report": ("grade in -o in/a.pdf", "is inside the input"),
    "no rubric": ("grade in -o out --rubric missing.toml", "missing.toml"),
    "no key": ("grade in -o out --key missing.json", "missing.json"),
    "no logs": ("grade in -o out --logs missing", "missing: the file cannot be read"),
    "no roster": ("grade in -o out --roster missing", "cannot be read"),
    "late from when": ("grade in -o out --late 10%/day", "--due"),
    "due in words": ("grade in -o out --due soon", "--due"),
    "late by what": ("grade in -o out --due 2026-11-20 --late 10", "--late"),
    # assignments
    **{
        name: (f"simulate -o f --assignment roster.csv {typed}", said)
        for name, typed, said in (
            ("short secret", "--secret-file abc.txt", "can be guessed"),
            ("no secret file", "--secret-file none", "cannot be read"),
            ("seed of a class", "--seed 3", "--seed is not available with --assignment"),
            ("too many for a loop", "--kind mixed --mistakes 2", "0 to 1"),
            ("key inside", "--answer f/k.json", "students' folder"),
        )
    },
    "mistakes alone": ("simulate -o f.ulg --mistakes 1", "requires --assignment"),
    # trajectories and pose graphs
    "empty trajectory": ("loop empty.tum", "px4fuse: empty.tum: the file is empty"),
    "text junk": ("loop junk.txt", "junk.txt: the first 3 lines contain no header"),
    "PDF": ("loop f.pdf", "f.pdf: the file is a PDF, not a flight log"),
    "no motion": ("loop still.tum", "still.tum: the path of 0.00 m"),
    "closure outside": ("loop s.tum --closure 10,5000", "in ascending order, between"),
    "closure of one time": ("loop s.tum --closure 10", "'10' is not T1,T2"),
    "closure of four": ("loop s.tum --closure 1,2,3,4", "is not T1,T2"),
    "closure backwards": ("loop s.tum --closure 50,10", "in ascending order, between"),
    "closure of no width": (
        "loop s.tum --closure 10,50,0",
        "SIGMA 0 is out of range (0.0001 to 100 m)",
    ),
    "closure of NaN": ("loop s.tum --closure 1,nan", "is not T1,T2"),
    "landing of words": ("loop s.tum --landed-at junk", "'junk' is not FORWARD,RIGHT"),
    "landing on the moon": ("loop s.tum --landed-at 1e300,1", "is not FORWARD,RIGHT"),
    "landing, and open": ("loop s.tum --landed-at 1,2 --open", "exclude each other"),
    "open, and nothing to correct": ("loop s.tum --open --tum o.tum", "the path is not corrected"),
    "from after to": ("loop s.tum --from 50 --to 40", "Change --from or --to"),
    "no such part": ("loop l.ulg:slam", "a flight log contains no trajectory 'slam'"),
    "part of a trajectory": ("loop s.tum:vio", "s.tum contains only one rigid body"),
    "frame of a flight": ("loop l.ulg --frame enu", "--frame is only for trajectory files"),
    "no PDF": ("loop s.tum -o r.txt", "r.txt: the output is a PDF"),
    "path and graph": ("loop s.tum --tum x --g2o x", "two outputs have the same file name"),
    "path to standard output": ("loop s.tum --tum -", "--tum cannot write to standard output"),
    "reference a graph": (
        "loop s.tum --reference g.g2o",
        "g.g2o is a pose graph, not a trajectory",
    ),
    "graph with a bad edge": ("loop bad.g2o", "bad.g2o, line 2"),
    "part of a graph": ("loop g.g2o:vio", "a pose graph contains no trajectory 'vio'"),
    "report of a graph": ("loop g.g2o -o r.pdf", "not available for a pose graph"),
    "evaluate junk": ("evaluate s.tum junk.bin", "junk.bin: the file is neither a PX4 ULog"),
    "evaluate apart": ("evaluate s.tum l.ulg --time-offset 0", "0 poses match in time"),
    "offset of words": (
        "evaluate s.tum s.tum --time-offset abc",
        "not a number in seconds or auto.",
    ),
    "RPE over nothing": ("evaluate s.tum s.tum --rpe 0m", "'0m' is not a distance"),
    "RPE over half a frame": (
        "evaluate s.tum s.tum --rpe 1.5f",
        "1.5 frames: the number of frames must be an integer",
    ),
    "RPE over too many": (f"evaluate s.tum s.tum --rpe {'9' * 26}f", "is not a distance"),
    "page as text": ("evaluate s.tum s.tum -o page.txt", "ending in .pdf"),
}

# Commands with an input as output, by how the output names the input
SPARED = {
    "path": "loop s.tum --tum s.tum",
    "results by soft link of a part": "loop l.ulg:vio --json soft.json",
    "reference": "loop l.ulg --reference s.tum --tum s.tum",
    "pose graph": "loop g.g2o --g2o g.g2o",
    "reference of evaluate": "evaluate s.tum l.ulg:truth --json l.ulg",
    "estimate by its page": "evaluate s.pdf s.tum -o s.pdf",
    "info": "info a.ulg --json a.ulg",
    "info by soft link": "info l.ulg --json soft.json",
    "tune by hard link": "tune a.ulg --axis north --json hard.json",
    "sync": "sync a.ulg --json ./a.ulg",
    "sync over positions": "sync a.ulg --position c.csv --json c.csv",
    "compare by hard link": "compare a.ulg -o r.pdf --json hard.json",
    "compare over positions": "compare a.ulg --position c.csv -o r.pdf --json ../{folder}/c.csv",
    "key over roster": "simulate -o f --assignment roster.csv --answer roster.csv",
    "compare over notes": "compare a.ulg --notes n.md -o r.pdf --json n.md",
}


@pytest.mark.parametrize(
    ("command", "said"),
    [*REFUSED.values(), *((command, "not overwritten") for command in SPARED.values())],
    ids=[*REFUSED, *(f"over {name}" for name in SPARED)],
)
def test_commands_on_invalid_input_print_one_error_line(desk, monkeypatch, capsys, command, said):
    monkeypatch.chdir(desk)
    before = contents(desk)
    typed = shlex.split(command.format(folder=Path(desk).name))
    code, out, err = run_main(monkeypatch, capsys, *typed)
    assert (code, out) == (2, ""), err
    assert err.startswith("px4fuse: ")
    assert len(err.splitlines()) == 1
    assert said in err
    assert "`" not in err  # options instead of arguments in backticks
    assert "1.79525e+09" not in err  # UNIX times have all digits
    assert contents(desk) == before


def test_tune_and_sync_commands_without_result_exit_with_2(desk, monkeypatch, capsys):
    monkeypatch.chdir(desk)
    for command, said in (
        ("tune a.ulg --start 126", "SIGMA_A and SIGMA_Z cannot be estimated"),
        ("sync a.ulg --end 3", "the time offset cannot be estimated"),
    ):
        code, _, err = run_main(monkeypatch, capsys, *command.split())
        assert (code, len(err.splitlines()), said in err) == (2, 1, True), err
