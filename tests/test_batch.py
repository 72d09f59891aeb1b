"""``px4fuse batch``: table, cached results, and failures of logs, workers, cluster and disk."""

from __future__ import annotations

import contextvars
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

import batch_tools
import failing_jobs
import jsonschema
import pandas as pd
import psutil
import pytest
from artificial_batch import DAMAGED, artificial_logs
from batch_tools import environment, start_dask, tiny_log, tiny_logs
from class_tools import run_in_turn
from cli_tools import error_line, run_checked
from cli_tools import run as run_cli
from msgspec import structs
from ulog_tools import gnss_log

import px4fuse
from px4fuse.batch import engine, job, run
from px4fuse.batch.engine import connect_to_cluster, run_jobs
from px4fuse.batch.job import Job
from px4fuse.batch.logs import LogAddress, find_logs
from px4fuse.batch.rows import (
    COLUMN_TYPES,
    collect_log_values,
    format_csv,
    make_axis_rows,
    make_table,
)
from px4fuse.batch.run import BatchResult
from px4fuse.batch.terminal import format_summary
from px4fuse.cli.outputs import make_console
from px4fuse.core import workers
from px4fuse.core.workers import JobFailure, run_with_limits
from px4fuse.errors import OutputError, SettingsError
from px4fuse.report.screen import print_blocks
from px4fuse.request import ComparisonRequest
from px4fuse.results.contract import schema, to_json
from px4fuse.results.reading import read_results


@pytest.fixture(autouse=True)
def one_worker(monkeypatch) -> None:
    """Use one worker by default, as each needs 2 s to start."""
    monkeypatch.setattr(os, "cpu_count", lambda: 1)


@pytest.fixture
def in_this_process(monkeypatch) -> None:
    """Run jobs in the process of the test."""
    monkeypatch.setattr(run, "run_with_limits", run_in_turn)


@pytest.fixture
def remembered(monkeypatch, memory: Path) -> None:
    """Reuse the analysis of a log in other tests."""
    remember(monkeypatch, memory)


def remember(patch: pytest.MonkeyPatch, memory: Path) -> None:
    patch.setenv(batch_tools.MEMORY, str(memory))
    patch.setattr(run, "analyse", batch_tools.analyse_cached)


@pytest.fixture(scope="module")
def memory(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("memory")


@pytest.fixture(scope="module")
def flights(tmp_path_factory) -> Path:
    return tiny_logs(tmp_path_factory.mktemp("flights") / "logs", 3)


@pytest.fixture(scope="module")
def undisturbed(flights, memory, tmp_path_factory) -> pd.DataFrame:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run, "run_with_limits", run_in_turn)
        remember(patch, memory)
        return px4fuse.run_batch(flights, tmp_path_factory.mktemp("undisturbed"), workers=1)


def assert_same(table: pd.DataFrame, expected: pd.DataFrame) -> None:
    pd.testing.assert_frame_equal(table, expected, check_exact=True)


def running(logs: Path, output: Path, *options: str, **how: Any) -> subprocess.Popen[str]:
    """Start px4fuse batch in a new process."""
    return subprocess.Popen(
        [sys.executable, "-m", "px4fuse", "batch", logs, "-o", output, *options],
        text=True, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, env=environment(), **how,
    )  # fmt: skip


def wait_for_first_result(process: subprocess.Popen[str], output: Path) -> None:
    while not list(output.glob("rows/*.json")):
        assert process.poll() is None
        time.sleep(0.05)


def command(*arguments: str | Path) -> Any:
    return run_cli("batch", *arguments)


# ------------------------------------------------------------------ the table


@pytest.mark.usefixtures("in_this_process")
def test_batch_table_has_numbers_or_failure_reason_per_log(tmp_path):
    logs = tiny_logs(tmp_path / "logs", 1)
    (logs / "inner").mkdir()
    shutil.copy(logs / "f1.ulg", logs / "inner" / "twin.ulg")
    (logs / "broken.ulg").write_bytes(tiny_log(1)[:40])
    (logs / "dataflash.BIN").write_bytes(b"\xa3\x95" * 50)
    (logs / "notes.txt").write_text("no log")
    output = tmp_path / "out"
    table = px4fuse.run_batch(logs, output, reports=True)

    assert list(table.columns) == list(COLUMN_TYPES)
    of = {name: rows.reset_index(drop=True) for name, rows in table.groupby("name")}
    assert set(of) == {"f1.ulg", "twin.ulg", "broken.ulg", "dataflash.BIN"}
    assert list(table["name"]) == sorted(table["name"])
    analysis = px4fuse.compare(logs / "f1.ulg")
    first = of["f1.ulg"]
    assert list(first["axis"]) == [axis.axis.name for axis in analysis.axes.values()]
    assert list(first["kf_nis_mean"]) == [
        axis.filters["kf"].nis_mean for axis in analysis.axes.values()
    ]
    assert list(first["kf_sigma_ratio"] ** 2) == pytest.approx(list(first["kf_nis_mean"]))
    tuned = analysis.tuning["horizontal"].sigma_z
    assert first.loc[0, ["sigma_z_m", "sigma_z_low_m", "sigma_z_high_m"]].tolist() == [
        tuned.value, tuned.low, tuned.high,
    ]  # fmt: skip
    assert (first["status"] == "done").all()
    results = read_results((output / first.loc[0, "results"]).read_bytes())
    assert results.request.log == "f1.ulg"
    card = results.card
    assert first.loc[0, ["severity", "headline"]].tolist() == [card.severity, card.headline]
    ratios = [verdict.ratio for verdict in card.verdicts[:2]]
    assert first.loc[0, ["kf_source_ratio", "kf_truth_ratio"]].tolist() == pytest.approx(ratios)
    assert first["ekf2_source_ratio"].isna().all()
    assert (output / first.loc[0, "report"]).read_bytes().startswith(b"%PDF")
    # a log whose clock is out of range has no date
    beyond = structs.replace(results.log, start_unix_s=1e18)
    assert collect_log_values(results.log)["date"] == first.loc[0, "date"]
    assert collect_log_values(beyond)["date"] == ""
    # the clock offset is present only if it is determinable
    rows = make_axis_rows(
        structs.replace(results, clock=structs.replace(results.clock, is_determinable=False))
    )
    assert first["clock_offset_s"].tolist() == pytest.approx([results.clock.offset_s] * 4)
    assert all("clock_offset_s" not in row for row in rows)

    twin = of["twin.ulg"].loc[0]
    assert (twin["status"], twin["log_sha256"]) == ("not compared", first.loc[0, "log_sha256"])
    assert "identical to" in twin["reason"]
    assert "f1.ulg" in twin["reason"]
    assert of["broken.ulg"].loc[0, "status"] == of["dataflash.BIN"].loc[0, "status"] == "failed"
    assert "DataFlash" in of["dataflash.BIN"].loc[0, "reason"]
    assert of["dataflash.BIN"].loc[0, "remedy"].startswith("Give the MAVLink recording")

    assert_same(pd.read_parquet(output / "fleet.parquet"), table)
    na_values = {name: [""] for name, kind in COLUMN_TYPES.items() if kind != "str"}
    written = pd.read_csv(
        output / "fleet.csv", dtype=COLUMN_TYPES, keep_default_na=False, na_values=na_values
    )
    pd.testing.assert_frame_equal(written, table, rtol=1e-9)


def test_batch_summary_counts_logs_by_failure_reason(capsys):
    table = artificial_logs(60).fillna({"axis": "", "change": ""})
    print_blocks(make_console(), format_summary(BatchResult(table, 3, frozenset(), ())).blocks)
    said = " ".join(capsys.readouterr().out.split())
    failed = table[table["status"] == "failed"]
    first_log = failed["log"].iloc[0]
    line = f"{len(failed)} logs without results, for example {first_log}: failed: {DAMAGED[0]}"
    assert line in said
    assert f"60 logs: {(table.drop_duplicates('log')['status'] == 'done').sum()} done" in said


def test_batch_csv_leaves_missing_numbers_empty(tmp_path):
    table = make_table([{"name": "=1+1.ulg", "updates": 3, "kf_nis_mean": None}, {"reason": None}])
    assert table["kf_nis_mean"].isna().all()
    assert table["updates"].isna().tolist() == [False, True]
    head, row, _ = format_csv(table).decode("utf-8-sig").splitlines()
    values = dict(zip(head.split(","), row.split(","), strict=True))
    assert values["name"] == "'=1+1.ulg"
    assert (values["updates"], values["kf_nis_mean"]) == ("3", "")
    # a file name that is not UTF-8 is replaced
    table = make_table([{"log": os.fsdecode(b"flight-\xff.ulg"), "status": "failed"}])
    table.to_parquet(tmp_path / "fleet.parquet")
    assert pd.read_parquet(tmp_path / "fleet.parquet")["log"].item() == "flight-?.ulg"
    assert "flight-?.ulg" in format_csv(table).decode()


@pytest.mark.usefixtures("in_this_process")
def test_batch_log_without_position_has_status_not_compared(tmp_path):
    log = gnss_log("v1.16").write(tmp_path / "a.ulg")
    row = px4fuse.run_batch(log, tmp_path / "out").loc[0]
    assert (row["status"], row["axis"]) == ("not compared", "")
    assert row["firmware"] == "PX4 v1.16.0"
    assert row["duration_s"] > 10
    assert "--position" in row["remedy"]
    assert row["aids"].startswith("gnss_pos underconfident")
    assert "from an earlier run: 1 log" in command(log, "-o", tmp_path / "out").output


@pytest.mark.reallogs
@pytest.mark.usefixtures("in_this_process")
def test_batch_gnss_flight_has_one_table_row_per_axis(shared_logs):
    (log,) = shared_logs.glob("simulated/*no_uwb.ulg")
    table = px4fuse.run_batch(log)
    assert table["axis"].tolist() == ["aisle", "north", "east"]
    assert table["aids"].str.startswith("gnss_pos underconfident;gnss_vel ").all()


# ------------------------------------------------------------------ resuming


@pytest.mark.usefixtures("remembered", "in_this_process")
def test_batch_second_run_processes_only_new_logs(flights, tmp_path):
    logs, output = tmp_path / "logs", tmp_path / "out"
    shutil.copytree(flights, logs)
    (logs / "f3.ulg").rename(tmp_path / "f3.ulg")
    (logs / "late.ulg").write_bytes(b"")
    px4fuse.run_batch(logs, output)
    times = {file: file.stat().st_mtime_ns for file in (output / "results").iterdir()}
    assert len(times) == len([*(output / "rows").iterdir()]) == 2  # a failed log has no cached rows
    (tmp_path / "f3.ulg").rename(logs / "f3.ulg")
    (logs / "f2.ulg").rename(logs / "renamed.ulg")
    (logs / "late.ulg").write_bytes(tiny_log(9))
    said: list[tuple[str, int, int]] = []
    table = px4fuse.run_batch(logs, output, progress=lambda *step: said.append(step))
    assert said[-1] == ("comparing logs, 0 failed", 4, 4)
    after = {file: file.stat().st_mtime_ns for file in (output / "results").iterdir()}
    assert {file: after[file] for file in times} == times
    assert len(after) == 4
    fresh = px4fuse.run_batch(logs)
    assert_same(table.assign(results=""), fresh)
    # other settings are compared again
    other = px4fuse.run_batch(logs / "f1.ulg", output, sigma_z_m=0.2)
    assert other.loc[0, "settings"] == "px4fuse compare LOG --sigma-z 0.2"
    assert other.loc[0, "kf_nis_mean"] < table.loc[0, "kf_nis_mean"]


@pytest.mark.usefixtures("in_this_process")  # the second time
def test_batch_stopped_by_ctrl_c_keeps_finished_results(flights, undisturbed, tmp_path):
    with running(flights, tmp_path, "--workers", "1", start_new_session=True) as process:
        wait_for_first_result(process, tmp_path)
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does: the workers too
        _, said = process.communicate()
    assert process.returncode == 130
    assert said.startswith("px4fuse: interrupted; ")
    assert said.count("\n") == 1
    again = run_checked("batch", flights, "-o", tmp_path).output
    assert "3 logs: 3 done" in again
    assert "; 0 reused" not in again
    assert_same(pd.read_parquet(tmp_path / "fleet.parquet"), undisturbed)


# ------------------------------------------------------------------ failures


@pytest.mark.usefixtures("remembered")
def test_batch_hanging_log_does_not_affect_other_logs(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "analyse", batch_tools.analyse)
    logs = tmp_path / "logs"
    logs.mkdir()
    for seed, name in enumerate(("hang", "crash", "well"), 1):
        (logs / f"{name}.ulg").write_bytes(tiny_log(seed))
    clock = batch_tools.Clock()
    monkeypatch.setattr(workers, "time", clock)

    def end_waiting(what: str, done: int, of: int) -> None:
        clock.ahead_s = 600.0 * (done == 2)

    table = px4fuse.run_batch(logs, workers=2, progress=end_waiting).set_index("name")
    assert table.loc["well.ulg", "status"].tolist() == ["done"] * 4
    hang, crash = table.loc["hang.ulg"], table.loc["crash.ulg"]
    assert (hang["status"], crash["status"]) == ("failed", "failed")
    assert hang["reason"] == "the job exceeded the time limit of 600 s"
    assert "--timeout" in hang["remedy"]
    assert crash["reason"] == "the worker process ended during a job (exit code 3)"


def analysed(log: Path | str, max_bytes: int = 10**9) -> job.LogOutcome:
    """Analyse a log in a separate context, so that its size limit has no effect elsewhere."""
    work = Job(
        LogAddress("", "", str(log), None),
        ComparisonRequest(log="LOG"),
        False,
        max_bytes,
    )
    return contextvars.copy_context().run(job.analyse, work)


def test_batch_log_changed_during_reading_is_reported_failed(flights, tmp_path, monkeypatch):
    log = tmp_path / "f.ulg"
    shutil.copy(flights / "f1.ulg", log)
    compared = job._compare_log

    def grows(work: Job, path: Path, sha256: str) -> job.LogOutcome:
        outcome = compared(work, path, sha256)
        with path.open("ab") as file:
            file.write(b"more")
        return outcome

    before = analysed(log)
    assert before.rows[0]["status"] == "done"
    monkeypatch.setattr(job, "_compare_log", grows)
    (row,) = analysed(log).rows
    assert (row["status"], row["log_sha256"]) == ("failed", before.sha256)
    assert row["reason"] == "the log changed while it was read"


@pytest.mark.usefixtures("remembered", "in_this_process")
@pytest.mark.parametrize("ends", [KeyboardInterrupt, OutputError])
def test_batch_interrupted_run_reuses_finished_results(
    flights, undisturbed, tmp_path, monkeypatch, ends
):
    write_output_files, written = run.write_output_files, []

    def full(contents: dict[Path, bytes]) -> None:
        if written and (ends is OutputError or tmp_path / "fleet.csv" not in contents):
            raise ends("results/f.json: cannot be written (No space left on device).")
        write_output_files(contents)
        written.append(contents)

    monkeypatch.setattr(run, "write_output_files", full)
    with pytest.raises(ends, match=r"No space left .*"):
        px4fuse.run_batch(flights, tmp_path)
    monkeypatch.setattr(run, "write_output_files", write_output_files)
    if ends is KeyboardInterrupt:  # the table has been written
        assert len(set(pd.read_parquet(tmp_path / "fleet.parquet")["name"])) == 1
    # a log without a valid cache file is compared again
    (tmp_path / "rows" / f"{'0' * 64}.json").write_bytes(b"{}")
    (tmp_path / "rows" / "folder.json").mkdir()
    again = command(flights, "-o", tmp_path)
    assert "3 logs: 3 done. Results from an earlier run: 1 log." in again.output
    assert_same(pd.read_parquet(tmp_path / "fleet.parquet"), undisturbed)


@pytest.mark.usefixtures("in_this_process")  # one of them
def test_two_simultaneous_batch_runs_with_one_folder_succeed(tmp_path):
    logs, out = tiny_logs(tmp_path / "logs", 3, truth=False), tmp_path / "out"
    with running(logs, out, "--workers", "1") as other:
        while not out.exists():
            assert other.poll() is None
            time.sleep(0.01)
        run_checked("batch", logs, "-o", out)
        assert (other.communicate(timeout=300)[1], other.returncode) == ("", 0)
    table = pd.read_parquet(out / "fleet.parquet")
    assert table.groupby("name")["status"].unique().map(list).to_dict() == {
        f"f{number}.ulg": ["done"] for number in (1, 2, 3)
    }


@pytest.mark.usefixtures("in_this_process")
def test_batch_table_has_one_row_per_invalid_log(tmp_path):
    folder = tmp_path / "logs"
    folder.mkdir()
    for number in range(160):
        rng = random.Random(number)
        (folder / f"{number}.ulg").write_bytes(rng.randbytes(rng.choice((0, 7, 200, 5000))))
    run_checked("batch", folder, "-o", tmp_path / "out")
    table = pd.read_parquet(tmp_path / "out" / "fleet.parquet")
    assert len(table) == 160
    assert set(table["status"]) <= {"failed", "not compared"}
    assert table["reason"].str.len().between(10, 300).all()


def test_batch_rejects_options_that_apply_to_one_flight_only(flights):
    for settings in ({"position": "a.csv"}, {"sigma": 1.0}, {"sigma_z_m": 0.0}):
        with pytest.raises(SettingsError):
            px4fuse.run_batch(flights, **settings)


# ------------------------------------------------------------------ search for logs


def test_find_logs_accepts_folders_globs_and_urls(tmp_path, monkeypatch):
    import fsspec

    monkeypatch.chdir(tmp_path)
    for name in ("logs/b.ulg", "logs/deep/a.TLOG", "logs/c.txt", "logs/d[1].ulg", "logs/e.ULG.gz",
                 "named"):  # fmt: skip
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"12345")
    assert [(log.name, log.path_for_table) for log in find_logs(["logs"])] == [
        ("a.TLOG", "logs/deep/a.TLOG"), ("b.ulg", "logs/b.ulg"), ("d[1].ulg", "logs/d[1].ulg"),
        ("e.ULG.gz", "logs/e.ULG.gz"),
    ]  # fmt: skip
    # each log once; a file that is given by its name may have any suffix
    again = find_logs(["logs/*.ulg", str(tmp_path / "logs/b.ulg"), "logs/d[1].ulg", "named"])
    assert [log.name for log in again] == ["b.ulg", "d[1].ulg", "named"]
    assert {log.size_bytes for log in again} == {5}
    memory = fsspec.filesystem("memory")
    memory.pipe("/fleet/x.ulg", tiny_log(3))
    (log,) = find_logs(["memory://fleet"])
    assert (log.name, log.path_for_table) == ("x.ulg", "memory:///fleet/x.ulg")
    found = analysed(log.address)
    assert {(row["name"], row["log_sha256"]) for row in found.rows} == {("x.ulg", found.sha256)}
    (small,) = analysed(log.address, max_bytes=10).rows
    assert small["reason"] == "the file has 1 MB; the limit is 0 MB"


@pytest.mark.reallogs
def test_batch_processes_all_test_logs_without_exception(shared_logs, tmp_path):
    """Analyse all logs of ``../shared/logs``, except long ones and those of other tests.

    test_gnss.py has the GNSS flights; test_flown.py and test_whatif_cli.py have other releases.
    """
    others = r"v1\.1[46]|ArduPilot_UAV|.*_gps_|v1\.13.*(vision|175)\.ulg|mbiuki.*\.tlog"
    files = [
        str(file)
        for file in sorted(shared_logs.glob("*/*"))
        if file.suffix != ".json" and not re.match(others, file.name)
    ]
    table = px4fuse.run_batch(files, tmp_path, reports=True, workers=2)
    assert set(table["log"]) == set(files)
    validator = jsonschema.Draft202012Validator(schema())
    for log, rows in table.groupby("log"):
        first = rows.iloc[0]
        if first["axis"]:
            assert rows["kf_nis_mean"].notna().any() or first["reason"], log
            text = (tmp_path / first["results"]).read_text(encoding="utf-8")
            validator.validate(json.loads(text))
            assert to_json(read_results(text.encode())) == text
            assert (tmp_path / first["report"]).read_bytes().startswith(b"%PDF-")
        else:
            assert len(rows) == 1
            assert first["reason"], log
            assert first["status"] in ("not compared", "failed")
    assert (table.drop_duplicates("log")["status"] == "done").sum() >= 12


# ------------------------------------------------------------------ Dask cluster


def test_batch_unreachable_cluster_raises_one_line_error(monkeypatch, flights):
    monkeypatch.setattr(engine, "CONNECT_TIMEOUT_S", 0.5)
    for address in ("tcp://127.0.0.1:1", "nonsense://x", ""):
        with (
            pytest.raises(SettingsError, match="no Dask scheduler answers"),
            connect_to_cluster(address),
        ):
            pass
    with connect_to_cluster() as client:
        assert client is None  # a failed client is not the default of this session
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(SettingsError, match=r'pip install "px4fuse\[batch\]"'):
        px4fuse.run_batch(flights, scheduler="tcp://127.0.0.1:1")


def started_worker(address: str, log: Path, path: str) -> Any:
    """Start a Dask worker without the process that would restart it."""
    local = ("--nthreads", "1", "--no-nanny", "--no-dashboard", "--host", "127.0.0.1")
    says = "Starting Worker plugin"
    return start_dask("worker", address, *local, says=says, log=log, PYTHONPATH=path)


def test_batch_on_dask_cluster_equals_local_batch(flights, undisturbed, tmp_path):
    """A scheduler and two workers; the scheduler is killed at the end."""
    path = os.pathsep.join((str(batch_tools.REPOSITORY / "tests"), str(batch_tools.REPOSITORY)))
    ports = ("--port", "0", "--dashboard-address", ":0", "--host", "127.0.0.1")
    named = {"says": "Scheduler at:", "log": tmp_path / "scheduler", "PYTHONPATH": path}
    with start_dask("scheduler", *ports, **named) as line:
        address = line.split()[-1]
        with (
            started_worker(address, tmp_path / "one", path),
            started_worker(address, tmp_path / "other", path),
        ):
            assert_cluster_gives_the_same_table(address, flights, undisturbed, tmp_path)
            assert_failed_job_does_not_affect_others(address)
            assert_killed_scheduler_prints_one_line(address, tmp_path)


def assert_cluster_gives_the_same_table(address, flights, undisturbed, tmp_path):
    """Assert the table of the cluster; a worker with another version of px4fuse is refused."""
    arguments = [flights, "-o", tmp_path / "out", "--scheduler", address]
    run_checked("batch", *arguments, "--fail-on", "failed")
    assert_same(pd.read_parquet(tmp_path / "out" / "fleet.parquet"), undisturbed)
    other = tmp_path / "px4fuse-9.9.dist-info"
    other.mkdir()
    (other / "METADATA").write_text("Metadata-Version: 2.1\nName: px4fuse\nVersion: 9.9\n")
    path = f"{tmp_path}{os.pathsep}{batch_tools.REPOSITORY}"
    with started_worker(address, tmp_path / "third", path):
        assert "has px4fuse 9.9, but this computer has" in error_line("batch", *arguments)


def assert_failed_job_does_not_affect_others(address):
    """Assert that other jobs succeed, also after a worker was killed."""
    # jobs that end at once or never: reporting an exception takes seconds of imports
    jobs = [("square", 3), ("unreadable", 0), ("exit", 3), ("hang", 0), ("square", 4)]
    work = partial(run_with_limits, failing_jobs.run_job, timeout_s=5.0, max_memory_bytes=2 * 10**9)
    expected = [9, "cannot be read (ValueError)", "exit code 3", "limit of 5 s", 16]
    with connect_to_cluster(address) as client:
        found = []
        for one, result in run_jobs(client, work, [*jobs, ("square", 5)]):
            if not found:
                killed = next(iter(client.run(os.getpid).values()))
                os.kill(killed, signal.SIGKILL)
            found.append((one, result.reason if isinstance(result, JobFailure) else result))
    assert dict(found).keys() == {*jobs, ("square", 5)}
    for one, what in zip(jobs, expected, strict=True):
        assert str(what) in str(dict(found)[one])


def assert_killed_scheduler_prints_one_line(address, tmp_path):
    """Kill the scheduler while a log is being compared."""
    logs, out = tiny_logs(tmp_path / "logs", 6, truth=False), tmp_path / "lost"
    process = running(logs, out, "--scheduler", address)
    wait_for_first_result(process, out)
    port = int(address.rpartition(":")[2])
    (owner,) = {
        one.pid
        for one in psutil.net_connections("tcp")
        if one.status == psutil.CONN_LISTEN and one.laddr.port == port
    }
    psutil.Process(owner).kill()
    _, said = process.communicate(timeout=120)
    assert process.returncode == 2
    assert said.startswith("px4fuse: the connection to the Dask scheduler was lost")
    assert said.endswith("The results so far are kept. Run the same command to continue.\n")
    assert said.count("\n") == 1
