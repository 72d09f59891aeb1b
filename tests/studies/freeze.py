"""Freeze the output of px4fuse on 60 recordings, and compare two frozen states.

``freeze.py FOLDER`` runs each case in a new process and writes, per case, the exit code, the
terminal text, the JSON results, and the text and drawing operations of every PDF page.
``freeze.py --compare BEFORE AFTER`` lists the differences; floats agree to 1e-9.

Simulated flights are made once, in ``simulated`` beside FOLDER, so that two frozen states have the
same inputs. Cases whose recordings are absent (``../shared``) are skipped and counted.
"""

from __future__ import annotations

import argparse
import gzip
import io
import json
import math
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pypdf import PdfReader

ROOT = Path(__file__).parents[2]
SAMPLES = ROOT / "sample_logs"
SHARED = ROOT.parent / "shared"
RELATIVE_TOLERANCE, ABSOLUTE_TOLERANCE = 1e-9, 1e-12
TIMEOUT_S = 600.0
SHOWN_DIFFERENCES = 12  # per case
# 24 simulated flights: each fault once, three clean flights, loops and outdoor flights
SIMULATED = {
    "clean": "", "clean_60": "--heading 60 --passes 4", "clean_10hz": "--uwb-rate 10 --passes 4",
    "late": "--mistake clock-offset", "clock_drift": "--mistake clock-drift",
    "clock_jump": "--mistake clock-jump", "nlos": "--mistake nlos", "dropout": "--mistake dropout",
    "imu_dropout": "--mistake imu-dropout", "decimate": "--mistake decimate",
    "r_scale": "--mistake r-scale", "yaw": "--mistake yaw", "scale": "--mistake scale",
    "jump": "--mistake jump", "smoothed": "--mistake smoothed", "slow": "--mistake slow-error",
    "accel_bias": "--mistake accel-bias", "vibration": "--mistake vibration",
    "no_motion": "--mistake no-motion", "ekf2_noise": "--mistake ekf2-noise",
    "ekf2_gate": "--mistake ekf2-gate --mistake ekf2-delay", "no_truth": "--no-truth --no-ekf2",
    "loop": "--kind loop --mistake open-end", "outdoor": "--kind outdoor --mistake mag",
}  # fmt: skip
SHARED_LOGS = [
    "simulated/v1.16.1_aisle_hwlogvision.ulg",
    "simulated/v1.16.1_aisle_hwlog.ulg",
    "simulated/v1.16.1_aisle_2hz_stock.ulg",
    "simulated/v1.16.1_aisle_overconfident.ulg",
    "simulated/v1.16.1_aisle_clock_late.ulg",
    "simulated/v1.16.1_aisle_nlos.ulg",
    "simulated/v1.16.1_no_uwb.ulg",
    "simulated/v1.13.3_aisle_evdelay175.ulg",
    "simulated/main202603_aisle_hwlogvision.ulg",
    "gps/v1.16.1_gps_overconfident.ulg",
    "gps/v1.16.1_gps_delay0.ulg",
    "gps/v1.16.1_gps_stock_flow.ulg",
    "real/mengchaoheng_PX4_ulog_plottools_hist_6a8cf408_test3.ulg",
    "real/vladimireganov_ROS_PX4_MOCAP_square2.ulg",
    "real/PX4_flight-review-rs_ekf_failure.ulg",
    "real/PX4_flight-review-rs_battery_brownout.ulg",
    "real/PX4_pyulog_sample_px4_events.ulg",
]
SHARED_TELEMETRY = [
    "v1.16.1_aisle_clock_late.tlog",
    "v1.13.3_aisle_hwlogvision.tlog",
    "Ian-McConachie-CU_drone_position_hold_hist_40e21c1c_mav.tlog",
    "ArduPilot_UAVLogViewer_vtol.tlog",
    "mbiuki_Phoenix_mission1.tlog",
]
POSITION_FILES = 10
# Other commands, on the sample flights
OTHERS = {
    "tune": "tune {aisle} --json results.json", "sync": "sync {aisle} --json results.json",
    "whatif": "whatif {aisle} --json results.json", "info": "info {aisle} --json results.json",
    "loop": "loop {loop} -o report.pdf --json results.json",
    "evaluate": "evaluate {loop}:vio {slam} -o report.pdf --json results.json",
    "diff": "diff {aisle} {tlog} --json results.json",
}  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A command; paths of its inputs are absolute."""

    name: str
    arguments: tuple[str, ...]


def compare_case(name: str, *arguments: object) -> Case:
    """Return the case of ``px4fuse compare`` with a report and results."""
    given = *map(str, arguments), "-o", "report.pdf", "--json", "results.json"
    return Case(name, ("compare", *given))


def cases(simulated: Path) -> Iterator[Case]:
    """Yield all cases: 4 samples, 24 simulated, 17 shared, 10 with position files, 5 telemetry."""
    aisle = SAMPLES / "aisle_uwb.ulg"
    for name in ("aisle_uwb.ulg", "aisle_uwb.tlog", "loop_vio.ulg"):
        yield compare_case(f"sample_{name}", SAMPLES / name)
    external = SAMPLES / "aisle_uwb_external.csv"
    yield compare_case("sample_external", aisle, "--position", external)
    for name in SIMULATED:
        yield compare_case(f"simulated_{name}", simulated / f"{name}.ulg")
    for log in SHARED_LOGS:
        yield compare_case(f"shared_{Path(log).stem}", SHARED / "logs" / log)
    for name, command in position_file_cases():
        yield compare_case(f"position_{name}", *command)
    for log in SHARED_TELEMETRY:
        yield compare_case(f"telemetry_{log}", SHARED / "logs" / "mavlink" / log)
    files = {
        "aisle": aisle, "tlog": SAMPLES / "aisle_uwb.tlog", "loop": SAMPLES / "loop_vio.ulg",
        "slam": SAMPLES / "loop_slam.tum",
    }  # fmt: skip
    for name, command in OTHERS.items():
        yield Case(f"command_{name}", tuple(word.format(**files) for word in command.split()))


def position_file_cases() -> Iterator[tuple[str, list[str]]]:
    """Yield the first cases of ``shared/cases`` that give a position file."""
    folder = SHARED / "cases"
    expected = folder / "EXPECTED.json"
    if not expected.exists():
        return
    known = json.loads(expected.read_text(encoding="utf-8"))["cases"]
    with_file = [(name, case) for name, case in known.items() if "--position" in case["command"]]
    for name, case in with_file[:POSITION_FILES]:
        words = case["command"][1:]
        yield name, [str((folder / w).resolve()) if (folder / w).is_file() else w for w in words]


def make_simulated(python: str, folder: Path) -> None:
    """Simulate the flights that are not there yet."""
    folder.mkdir(parents=True, exist_ok=True)
    for seed, (name, options) in enumerate(SIMULATED.items(), start=1):
        target = folder / f"{name}.ulg"
        if not target.exists():
            command = [python, "-m", "px4fuse", "simulate", "-o", str(target), "--seed", str(seed)]
            subprocess.run([*command, *options.split()], check=True, capture_output=True)


def freeze(case: Case, python: str, folder: Path) -> str:
    """Run one case and write its record; return one word about it."""
    inputs = [Path(word.removesuffix(":vio")) for word in case.arguments if word.startswith("/")]
    if not all(path.exists() for path in inputs):
        return "skipped"
    with tempfile.TemporaryDirectory() as where:
        environment = os.environ | {"COLUMNS": "100", "SOURCE_DATE_EPOCH": "1790000000"}
        ran = subprocess.run(
            [python, "-m", "px4fuse", *case.arguments],
            cwd=where, env=environment, capture_output=True, timeout=TIMEOUT_S, check=False,
        )  # fmt: skip
        results, report = Path(where, "results.json"), Path(where, "report.pdf")
        record = {
            "exit_code": ran.returncode,
            "terminal": ran.stdout.decode().splitlines(),
            "errors": ran.stderr.decode().splitlines(),
            "results": json.loads(results.read_bytes()) if results.exists() else None,
            "pages": list(pages(report.read_bytes())) if report.exists() else [],
        }
    with gzip.open(folder / f"{case.name}.json.gz", "wt", encoding="utf-8") as file:
        json.dump(record, file)
    return f"exit code {ran.returncode}"


def pages(pdf: bytes) -> Iterator[dict[str, list[str]]]:
    """Yield the text and the drawing operations of each page, line by line."""
    for page in PdfReader(io.BytesIO(pdf)).pages:
        content = page.get_contents()
        operations = content.get_data().decode("latin-1") if content is not None else ""
        yield {"text": page.extract_text().splitlines(), "operations": operations.splitlines()}


NUMBER = re.compile(r"-?\d+\.\d+(?:e[-+]?\d+)?")
# Identities of the run, of files and of library versions
IGNORED = {"provenance", "command", "request"}


def differences(before: Any, after: Any, path: str = "") -> Iterator[str]:
    """Yield a line for each place where two records differ."""
    if isinstance(before, dict) and isinstance(after, dict):
        for key in sorted((before.keys() | after.keys()) - IGNORED):
            if key not in before or key not in after:
                yield f"{path}.{key}: {'added' if key in after else 'removed'}"
            else:
                yield from differences(before[key], after[key], f"{path}.{key}")
    elif isinstance(before, list) and isinstance(after, list):
        if len(before) != len(after):
            yield f"{path}: {len(before)} -> {len(after)} entries"
        for number, (one, other) in enumerate(zip(before, after, strict=False)):
            yield from differences(one, other, f"{path}[{number}]")
    elif not equal(before, after):
        yield f"{path}: {str(before)[:160]!r} -> {str(after)[:160]!r}"


def equal(before: Any, after: Any) -> bool:
    """Return True if two values agree, numbers (also those in texts) to the tolerance."""
    if isinstance(before, str) and isinstance(after, str):
        if before == after:
            return True
        if NUMBER.sub("#", before) != NUMBER.sub("#", after):
            return False
        numbers = zip(NUMBER.findall(before), NUMBER.findall(after), strict=True)
        return all(close(float(one), float(other)) for one, other in numbers)
    if isinstance(before, int | float) and isinstance(after, int | float):
        return close(before, after)
    return bool(before == after)


def close(before: float, after: float) -> bool:
    """Return True if two numbers agree to the tolerance."""
    return math.isclose(before, after, rel_tol=RELATIVE_TOLERANCE, abs_tol=ABSOLUTE_TOLERANCE)


def compare(before: Path, after: Path, shown: int) -> int:
    """Print the differences of two frozen states; return the number of cases that differ."""
    names = {path.name for folder in (before, after) for path in folder.glob("*.json.gz")}
    differing = 0
    for name in sorted(names):
        records = [folder / name for folder in (before, after)]
        if not all(path.exists() for path in records):
            print(f"{name}: only in one of the two")
            differing += 1
            continue
        one, other = (json.loads(gzip.decompress(path.read_bytes())) for path in records)
        found = list(differences(one, other))
        if found:
            differing += 1
            print(f"{name}: {len(found)} differences")
            for line in found[:shown]:
                print(f"    {line}")
    print(f"{len(names) - differing} of {len(names)} cases are identical")
    return differing


def main() -> int:
    """Freeze, or compare two frozen states."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--compare", type=Path, nargs=2, metavar=("BEFORE", "AFTER"))
    parser.add_argument("--only", default="", help="cases whose name contains this text")
    parser.add_argument("--python", default=sys.executable, help="interpreter that has px4fuse")
    parser.add_argument("--processes", type=int, default=os.cpu_count())
    parser.add_argument("--shown", type=int, default=SHOWN_DIFFERENCES, help="lines per case")
    given = parser.parse_args()
    if given.compare:
        return min(compare(*given.compare, given.shown), 1)
    if given.folder is None:
        parser.error("give a folder, or --compare")
    given.folder.mkdir(parents=True, exist_ok=True)
    simulated = given.folder.resolve().parent / "simulated"
    make_simulated(given.python, simulated)
    chosen = [case for case in cases(simulated) if given.only in case.name]
    with ThreadPoolExecutor(given.processes) as pool:
        done = pool.map(lambda case: freeze(case, given.python, given.folder), chosen)
        for case, what in zip(chosen, done, strict=True):
            print(f"{case.name}: {what}", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
