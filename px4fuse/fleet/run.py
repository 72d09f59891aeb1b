"""Logs → the fleet's table: each log compared by a worker, its rows kept, the table written."""

import io
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import msgspec
import pandas as pd

from px4fuse.errors import LogError, Px4FuseError, SettingsError
from px4fuse.filter.settings import Settings
from px4fuse.fleet import TIMEOUT_S
from px4fuse.fleet.engine import connect_cluster, run_jobs
from px4fuse.fleet.job import Job, Outcome, analyse, file_stem, refused_row
from px4fuse.fleet.logs import FoundLog, find_logs
from px4fuse.fleet.page import html_text
from px4fuse.fleet.rows import FAILED, NOT_JUDGED, Row, clean_row, csv_bytes, fleet_table
from px4fuse.input_files import check_output_folder
from px4fuse.reading import max_log_bytes
from px4fuse.request import ComparisonRequest, command_line
from px4fuse.workers import MEMORY_BYTES, JobFailure, run_bounded
from px4fuse.writing import write_all

# Columns of the files of a log, relative to the folder
FILES = ("results", "report")
_RESUME_NOTE = "What is done is kept: the same command goes on from there."

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Fleet:
    """What came of many logs.

    Attributes
    ----------
    table : DataFrame
        A row per log and axis, with the columns of :data:`px4fuse.fleet.rows.COLUMNS`.
    reused : int
        How many logs an earlier run has compared.
    severities : frozenset of str
        Of all findings.
    """

    table: pd.DataFrame
    reused: int
    severities: frozenset[str]
    written: tuple[Path, ...]


class CachedRows(msgspec.Struct, frozen=True):
    """The rows of a log, of one px4fuse and one set of settings."""

    sha256: str
    px4fuse: str
    settings: str
    size_bytes: int | None
    rows: Annotated[list[Row], msgspec.Meta(min_length=1)]

    @property
    def file(self) -> str:
        """Where it is kept, relative to the fleet's folder."""
        return f"rows/{self.sha256}.json"


@dataclass(frozen=True)
class _Run:
    """Where a run writes, what its rows rest on, and what is known of its logs so far."""

    output: Path
    px4fuse: str
    settings: str
    hash_of: dict[str, str] = field(default_factory=dict)  # by address, of those that have rows
    first_of: dict[str, FoundLog] = field(default_factory=dict)  # by hash, whose rows stand for all
    failed_rows: dict[str, Row] = field(
        default_factory=dict
    )  # by address, rows of those that failed
    reused: set[str] = field(default_factory=set)


def batch(
    paths: str | Path | Iterable[str | Path],
    output: str | Path | None = None,
    *,
    reports: bool = False,
    **how: Any,
) -> pd.DataFrame:
    """Compare many logs, on this computer or a Dask cluster.

    In a session with a Dask client of its own (``distributed.Client``), that one's cluster does
    the work.

    Parameters
    ----------
    paths : str, Path or iterable of them
        Files, folders, globs and URLs.
    output : str or Path, optional
        Folder for the table and every log's results; a second run does only what is new. Without
        it nothing is kept.
    reports : bool
        Also every log's PDF.
    timeout_s : float
        For one log.
    scheduler : str, optional
        Address of a Dask scheduler.
    workers : int, optional
        Processes on this computer; by default one per core.
    memory_gb : float
        Address space for one log, of which libraries take 0.6 GB; Linux alone enforces it.
    progress : callable
        Told what is being done, how many logs are done, and of how many.
    **how
        The above by name, and arguments of :func:`px4fuse.compare`, as ``sigma_z_m``.

    Returns
    -------
    DataFrame
        A row per log and axis; one that says why for a log that could not be compared.

    Raises
    ------
    SettingsError
        There are no logs, a setting is out of range, or the cluster cannot do this.
    OutputError
        A result cannot be written.
    """
    sources = (paths,) if isinstance(paths, str | Path) else paths
    with TemporaryDirectory(prefix="px4fuse-") as scratch:
        folder = Path(scratch if output is None else output)
        fleet = run(map(str, sources), folder, reports=reports and output is not None, **how)
    return fleet.table if output is not None else fleet.table.assign(results="", report="")


def run(
    paths: Iterable[str],
    output: Path,
    *,
    reports: bool = False,
    timeout_s: float = TIMEOUT_S,
    scheduler: str | None = None,
    workers: int | None = None,
    memory_gb: float = MEMORY_BYTES / 1e9,
    progress: Progress = lambda what, done, of: None,
    **settings: Any,
) -> Fleet:
    """As :func:`batch`, with what else there is to say of a run.

    What ends the run early (Ctrl-C, a full disk, a cluster that is gone) costs what was not done
    by then; what was done is in the folder, and in the table as far as it can be written.

    Raises
    ------
    SettingsError
        As :func:`batch`.
    OutputError
        A result cannot be written.
    Px4FuseError
        The cluster is gone.
    """
    if find_spec("fsspec") is None or find_spec("pyarrow") is None:
        raise SettingsError("many logs require more", 'Run pip install "px4fuse[batch]".')
    logs = find_logs(paths)
    check_output_folder(output)
    try:
        request = ComparisonRequest(log="LOG", **settings)
    except TypeError as error:
        raise SettingsError(f"no such setting ({error}).") from error
    if request.mavlink is not None or request.position is not None:
        raise SettingsError("`mavlink` and `position` belong to one flight, not to many.")
    sigma_z_m = Settings().sigma_z_m if request.sigma_z_m is None else request.sigma_z_m
    Settings(request.sigma_a_m_s2, sigma_z_m, request.dt_s)  # refuses what is out of range
    state = _Run(output, metadata.version("px4fuse"), command_line(request))
    hashes_by_size = _cached_hashes(state, reports)
    of_address = {log.address: log for log in logs}
    jobs = [
        Job(
            log.address,
            request,
            reports,
            max_log_bytes.get(),
            frozenset(hashes_by_size[log.size_bytes]),
        )
        for log in logs
    ]
    bounded = partial(run_bounded, analyse, timeout_s=timeout_s, memory_bytes=int(memory_gb * 1e9))
    with (
        connect_cluster(scheduler) as client,
        closing(run_jobs(client, bounded, jobs, workers)) as work,
    ):
        progress("comparing", 0, len(jobs))
        try:
            try:
                for number, (job, outcome) in enumerate(work, 1):
                    _cache_outcome(state, of_address[job.address], outcome)
                    progress(f"comparing, {len(state.failed_rows)} failed", number, len(jobs))
            finally:
                fleet = _write_fleet(state, logs)
        except Px4FuseError as error:
            raise type(error)(f"{error} {_RESUME_NOTE}") from error
    return fleet


def _cached_hashes(state: _Run, reports: bool) -> dict[int | None, set[str]]:
    """Hashes of the logs of which everything is there, by their size."""
    hashes_by_size: dict[int | None, set[str]] = defaultdict(set)
    for cached in load_cached_rows(state.output, state.px4fuse, state.settings):
        first = cached.rows[0]
        files = [state.output / first.get(kind, "") for kind in FILES[: 1 + reports]]
        if "axis" not in first or all(file.is_file() for file in files):
            hashes_by_size[cached.size_bytes].add(cached.sha256)
    return hashes_by_size


def load_cached_rows(folder: Path, px4fuse: str, settings: str) -> Iterator[CachedRows]:
    """What a folder keeps of this px4fuse and these settings."""
    for file in sorted((folder / "rows").glob("*.json")):
        try:
            cached = msgspec.json.decode(file.read_bytes(), type=CachedRows)
        except (OSError, msgspec.MsgspecError):
            continue  # not ours, or of another px4fuse: the log is done again
        if (cached.px4fuse, cached.settings) == (px4fuse, settings):
            yield cached


def _cache_outcome(state: _Run, log: FoundLog, outcome: Outcome | JobFailure) -> None:
    """Keep what came of a log."""
    if isinstance(outcome, JobFailure):
        remedy = "Allow more with --timeout or --memory, or look at it with px4fuse compare."
        outcome = Outcome("", (refused_row(LogError(outcome.reason.rstrip("."), remedy), FAILED),))
    if outcome.rows and outcome.rows[0]["status"] == FAILED:
        state.failed_rows[log.address] = outcome.rows[0]
        return
    first = min(log, state.first_of.get(outcome.sha256, log))
    if not outcome.rows:
        state.reused.add(outcome.sha256)
    elif first is log:
        _write_log(state, log, outcome)
    state.hash_of[log.address] = outcome.sha256
    state.first_of[outcome.sha256] = first


def _write_log(state: _Run, log: FoundLog, outcome: Outcome) -> None:
    """Write a log's files and its rows together."""
    stem = f"results/{file_stem(log.name, outcome.sha256)}"
    named_contents = {f"{stem}.json": outcome.results, f"{stem}.pdf": outcome.report}
    files = {
        kind: name if named_contents[name] else ""
        for kind, name in zip(FILES, named_contents, strict=True)
    }
    rows = [clean_row(row) | files for row in outcome.rows]
    cached = CachedRows(outcome.sha256, state.px4fuse, state.settings, log.size_bytes, rows)
    contents = named_contents | {cached.file: msgspec.json.encode(cached)}
    write_all({state.output / name: content for name, content in contents.items() if content})


def _write_fleet(state: _Run, logs: Iterable[FoundLog]) -> Fleet:
    """Make the table of all that is known by now, and write it."""
    severities: set[str] = set()
    rows_of = {
        cached.sha256: cached.rows
        for cached in load_cached_rows(state.output, state.px4fuse, state.settings)
    }

    def rows_of_log(log: FoundLog) -> Iterable[Row]:
        if log.address not in state.hash_of:
            return [state.failed_rows[log.address]] if log.address in state.failed_rows else []
        sha256 = state.hash_of[log.address]
        first = state.first_of[sha256]
        if first is log and sha256 in rows_of:
            return rows_of[sha256]
        status, reason = NOT_JUDGED, f"the same file as {first.log}, whose rows stand for both"
        if first is log:
            status, reason = FAILED, "another run in this folder has replaced its rows"
        return [{"status": status, "log_sha256": sha256, "reason": reason}]

    def rows() -> Iterator[Row]:
        for log in logs:
            common = {"log": log.log, "name": log.name}
            common |= {"px4fuse": state.px4fuse, "settings": state.settings}
            for row in rows_of_log(log):
                severities.update(row.get("severities", ()))
                yield row | common

    table = fleet_table(rows())
    page = html_text(table, state.output.resolve().name, f"px4fuse {state.px4fuse}")
    parquet = io.BytesIO()
    table.to_parquet(parquet, index=False)
    contents = {
        state.output / "fleet.parquet": parquet.getvalue(),
        state.output / "fleet.csv": csv_bytes(table),
        state.output / "fleet.html": page.encode(),
    }
    write_all(contents)
    return Fleet(table, len(state.reused), frozenset(severities), tuple(contents))
