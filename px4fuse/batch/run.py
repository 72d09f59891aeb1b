"""Run of ``px4fuse batch``: compares logs in worker processes, and writes the table."""

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

from px4fuse.core.input_files import check_output_folder
from px4fuse.core.reading import max_log_bytes
from px4fuse.core.workers import MAX_MEMORY_BYTES, JobFailure, run_with_limits
from px4fuse.core.writing import write_output_files
from px4fuse.errors import LogError, Px4FuseError, SettingsError
from px4fuse.filter.settings import requested_settings
from px4fuse.request import ComparisonRequest, command_line

from . import LOG_ANALYSIS_TIMEOUT_S
from .engine import connect_to_cluster, run_jobs
from .job import Job, LogOutcome, analyse, make_failure_row, make_file_stem
from .logs import LogAddress, find_logs
from .page import format_html
from .rows import (
    STATUS_FAILED,
    STATUS_NOT_COMPARED,
    Row,
    clean_row,
    format_csv,
    make_table,
    replace_name_by_path,
)

# Table columns with the paths of the outputs of a log, relative to the output folder
OUTPUT_FILE_COLUMNS = ("results", "report")
RESUME_NOTE = "The results so far are kept. Run the same command to continue."

BatchProgressCallback = Callable[[str, int, int], None]


@dataclass(frozen=True)
class BatchResult:
    """Result of ``px4fuse batch``.

    Attributes
    ----------
    table : DataFrame
        One row per log and axis, with the columns of :data:`px4fuse.batch.rows.COLUMN_TYPES`.
    reused_count : int
        Number of logs whose results are from an earlier run.
    severities : frozenset of str
        Severities of all findings.
    written_paths : tuple of Path
    """

    table: pd.DataFrame
    reused_count: int
    severities: frozenset[str]
    written_paths: tuple[Path, ...]


class CachedRows(msgspec.Struct, frozen=True):
    """Cached table rows of a log, valid for one version and one set of settings of px4fuse."""

    sha256: str
    px4fuse: str
    settings: str
    size_bytes: int | None
    rows: Annotated[list[Row], msgspec.Meta(min_length=1)]


@dataclass(eq=False)
class _BatchState:
    """Settings of ``px4fuse batch``, and finished logs."""

    output: Path
    version: str
    settings: str
    # finished logs by SHA-256, also of earlier runs
    cached_rows_by_hash: dict[str, CachedRows] = field(default_factory=dict)
    hash_by_log_address: dict[str, str] = field(default_factory=dict)
    failed_row_by_log_address: dict[str, Row] = field(default_factory=dict)
    # SHA-256 of logs that were finished in an earlier run
    reused_hashes: set[str] = field(default_factory=set)


def run_batch(
    paths: str | Path | Iterable[str | Path],
    output: str | Path | None = None,
    *,
    reports: bool = False,
    **settings: Any,
) -> pd.DataFrame:
    """Compare KF and EKF2 on many logs, on this computer or on a Dask cluster.

    Parameters
    ----------
    paths : str, Path or iterable of them
        Files, folders, globs and URLs.
    output : str or Path, optional
        Folder for the table and the results of each log; by default no file is written.
    reports : bool
        True to write a PDF report for each log.
    timeout_s : float
        Maximum time for one log.
    scheduler : str, optional
        Address of a Dask scheduler.
    workers : int, optional
        Number of processes on this computer; by default the number of cores.
    memory_gb : float
        Maximum address space (GB) for one log, only on Linux.
    progress : callable
        Called with the activity, the number of finished logs and the number of all logs.
    **settings
        Arguments of :func:`px4fuse.compare`, such as ``sigma_z_m``.

    Returns
    -------
    DataFrame
        One row per log and axis; one row with the reason for a log that could not be compared.

    Raises
    ------
    SettingsError
        There are no logs, a setting is out of range, or the cluster is not usable.
    OutputError
        A result cannot be written.
    """
    log_paths_or_urls = (paths,) if isinstance(paths, str | Path) else paths
    with TemporaryDirectory(prefix="px4fuse-") as temporary_folder:
        folder = Path(temporary_folder if output is None else output)
        batch_result = run(
            map(str, log_paths_or_urls), folder, reports=reports and output is not None, **settings
        )
    # without an output folder, the files were temporary
    empty_columns = {} if output else dict.fromkeys(OUTPUT_FILE_COLUMNS, "")
    return batch_result.table.assign(**empty_columns)


def run(
    paths: Iterable[str],
    output: Path,
    *,
    reports: bool = False,
    timeout_s: float = LOG_ANALYSIS_TIMEOUT_S,
    scheduler: str | None = None,
    workers: int | None = None,
    memory_gb: float = MAX_MEMORY_BYTES / 1e9,
    progress: BatchProgressCallback = lambda *_: None,
    **settings: Any,
) -> BatchResult:
    """Compare KF and EKF2 on many logs, and write a table and the results to a folder.

    For the parameters see :func:`run_batch`. The results of finished logs are kept if the run ends
    early.

    Raises
    ------
    SettingsError
        See :func:`run_batch`.
    OutputError
        A result cannot be written.
    Px4FuseError
        The connection to the cluster was lost.
    """
    if find_spec("fsspec") is None or find_spec("pyarrow") is None:
        raise SettingsError(
            "px4fuse batch requires fsspec and pyarrow", 'Run pip install "px4fuse[batch]".'
        )
    logs = find_logs(paths)
    check_output_folder(output)
    try:
        request = ComparisonRequest(log="LOG", **settings)
    except TypeError as error:
        raise SettingsError(f"px4fuse.compare does not accept a setting ({error})") from error
    if request.position is not None:
        raise SettingsError("A position file belongs to one flight. Omit `position` for many logs.")
    requested_settings(request)  # raises SettingsError if a setting is out of range
    state = _BatchState(output, metadata.version("px4fuse"), command_line(request))
    jobs = _make_jobs(state, logs, request, reports)

    run_in_processes = partial(
        run_with_limits, analyse, timeout_s=timeout_s, max_memory_bytes=int(memory_gb * 1e9)
    )
    with (
        connect_to_cluster(scheduler) as client,
        # closing() ends the worker processes, also after an error or Ctrl-C
        closing(run_jobs(client, run_in_processes, jobs, workers)) as finished_jobs,
    ):
        progress("comparing logs", 0, len(jobs))
        try:
            for number, (job, outcome) in enumerate(finished_jobs, 1):
                _cache_outcome(state, job.log, outcome)
                failure_count = len(state.failed_row_by_log_address)
                progress(f"comparing logs, {failure_count} failed", number, len(jobs))
        except Px4FuseError as error:
            if (output / "rows").is_dir():
                error.args = (f"{error} {RESUME_NOTE}",)
            raise
        finally:
            # also after an error or an interruption: write the results so far. Without an error,
            # each log is finished or failed
            if state.hash_by_log_address or state.failed_row_by_log_address:
                batch_result = _write_table(state, logs)
    return batch_result


def _make_jobs(
    state: _BatchState, logs: Iterable[LogAddress], request: ComparisonRequest, reports: bool
) -> list[Job]:
    """Return a job for each log, and register in ``state`` the logs of an earlier run."""
    # Hashes of the finished logs by file size. A worker process gets only the hashes of logs that
    # have the same size as its log, because the set of all hashes may be large
    hashes_by_size: dict[int | None, set[str]] = defaultdict(set)
    for cached_rows in load_cached_rows(state, reports):
        state.cached_rows_by_hash[cached_rows.sha256] = cached_rows
        hashes_by_size[cached_rows.size_bytes].add(cached_rows.sha256)
    max_bytes = max_log_bytes.get()
    return [
        Job(log, request, reports, max_bytes, frozenset(hashes_by_size[log.size_bytes]))
        for log in logs
    ]


def load_cached_rows(state: _BatchState, reports: bool) -> Iterator[CachedRows]:
    """Yield the cached table rows of logs that an earlier run finished with the same settings.

    With ``reports``, a log without a PDF report is not finished.
    """
    for cache_file in sorted((state.output / "rows").glob("*.json")):
        try:
            cached_rows = msgspec.json.decode(cache_file.read_bytes(), type=CachedRows)
        except (OSError, ValueError):
            # without a readable cache file, px4fuse compares KF and EKF2 for this log again
            continue
        first_row = cached_rows.rows[0]
        output_columns: tuple[str, ...] = ()
        if "axis" in first_row:  # KF and EKF2 were compared, so output files exist
            output_columns = OUTPUT_FILE_COLUMNS if reports else OUTPUT_FILE_COLUMNS[:1]
        output_files = [state.output / first_row.get(column, "") for column in output_columns]
        if (cached_rows.px4fuse, cached_rows.settings) == (state.version, state.settings) and all(
            file.is_file() for file in output_files
        ):
            yield cached_rows


def _cache_outcome(state: _BatchState, log: LogAddress, outcome: LogOutcome | JobFailure) -> None:
    """Register a finished log in ``state``, and write its results."""
    if isinstance(outcome, JobFailure):
        remedy = "Increase --timeout or --memory, or run px4fuse compare on this log."
        failed_row = make_failure_row(LogError(outcome.reason, remedy))
        state.failed_row_by_log_address[log.address] = failed_row
        return
    if outcome.rows and outcome.rows[0]["status"] == STATUS_FAILED:
        state.failed_row_by_log_address[log.address] = outcome.rows[0]
        return
    if not outcome.rows:  # a log with results from an earlier run
        state.reused_hashes.add(outcome.sha256)
    elif outcome.sha256 not in state.cached_rows_by_hash:  # otherwise already written
        state.cached_rows_by_hash[outcome.sha256] = _write_log(state, log, outcome)
    state.hash_by_log_address[log.address] = outcome.sha256


def _write_log(state: _BatchState, log: LogAddress, outcome: LogOutcome) -> CachedRows:
    """Write the results of one log to the output folder: JSON, PDF and its table rows."""
    path_stem = f"results/{make_file_stem(log.name, outcome.sha256)}"
    # a log that was not compared has no results, and without --reports there is no PDF
    json_path = f"{path_stem}.json" if outcome.results_json else ""
    pdf_path = f"{path_stem}.pdf" if outcome.report_pdf else ""
    rows = [clean_row(row) | {"results": json_path, "report": pdf_path} for row in outcome.rows]
    cached_rows = CachedRows(outcome.sha256, state.version, state.settings, log.size_bytes, rows)
    contents = {
        json_path: outcome.results_json,
        pdf_path: outcome.report_pdf,
        f"rows/{outcome.sha256}.json": msgspec.json.encode(cached_rows),
    }
    write_output_files({state.output / path: data for path, data in contents.items() if path})
    return cached_rows


def _write_table(state: _BatchState, logs: Iterable[LogAddress]) -> BatchResult:
    """Write the table of the finished logs as CSV, Parquet and web page."""
    all_rows: list[Row] = []
    first_log_by_hash: dict[str, LogAddress] = {}
    for log in logs:
        sha256 = state.hash_by_log_address.get(log.address, "")
        first_log = first_log_by_hash.setdefault(sha256, log)
        if failed_row := state.failed_row_by_log_address.get(log.address):
            rows = [failed_row]
        elif not sha256:  # batch stopped before this log
            continue
        elif first_log is log:
            rows = state.cached_rows_by_hash[sha256].rows
        else:
            reason = f"the log is identical to {first_log.path_for_table}"
            rows = [{"status": STATUS_NOT_COMPARED, "log_sha256": sha256, "reason": reason}]
        common_values = {"log": log.path_for_table, "name": log.name}
        common_values |= {"px4fuse": state.version, "settings": state.settings}
        all_rows += (replace_name_by_path(row, log.path_for_table) | common_values for row in rows)
    severities = {severity for row in all_rows for severity in row.get("severities", ())}
    table = make_table(all_rows)
    page = format_html(table, state.output.resolve().name, f"px4fuse {state.version}")
    contents = {
        state.output / "fleet.parquet": table.to_parquet(index=False),
        state.output / "fleet.csv": format_csv(table),
        state.output / "fleet.html": page.encode(),
    }
    write_output_files(contents)
    return BatchResult(table, len(state.reused_hashes), frozenset(severities), tuple(contents))
