"""Logs → the fleet's table: each log compared by a worker, its rows kept, the table written."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from importlib import metadata
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import pandas as pd

from px4fuse.errors import OutputError, Px4FuseError, SettingsError
from px4fuse.filter.settings import Settings
from px4fuse.fleet import TIMEOUT_S
from px4fuse.fleet.engine import WorkerFailed, connected, outcomes
from px4fuse.fleet.job import Job, Outcome, analyse, file_stem, identify, refused
from px4fuse.fleet.logs import FoundLog, find_logs
from px4fuse.fleet.page import html_text
from px4fuse.fleet.regressions import marked
from px4fuse.fleet.rows import FAILED, NOT_JUDGED, Row, csv_bytes, table_of
from px4fuse.fleet.store import Store, opened
from px4fuse.reading import max_log_bytes
from px4fuse.request import ComparisonRequest, command_line
from px4fuse.writing import write_all

if TYPE_CHECKING:
    from distributed import Client

# Columns of the files of a log, relative to the folder
FILES = ("results", "report")
_GOES_ON = "What is done is kept: the same command goes on from there."

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
    against : str
        What the logs were held against; empty without a baseline.
    """

    table: pd.DataFrame
    reused: int
    severities: frozenset[str]
    written: tuple[Path, ...]
    against: str = ""


@dataclass(frozen=True)
class _Found:
    """What is known of the logs so far."""

    logs: Mapping[str, FoundLog]  # by address, as all of it
    output: Path
    store: Store
    hash_of: dict[str, str] = field(default_factory=dict)
    lost: dict[str, Row] = field(default_factory=dict)  # rows of those that give none
    reused: set[str] = field(default_factory=set)


def batch(
    paths: str | Path | Iterable[str | Path],
    output: str | Path | None = None,
    *,
    reports: bool = False,
    timeout_s: float = TIMEOUT_S,
    baseline: pd.DataFrame | None = None,
    scheduler: str | None = None,
    workers: int | None = None,
    memory: str = "auto",
    progress: Progress = lambda what, done, of: None,
    **settings: Any,
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
    baseline : DataFrame, optional
        An earlier table: the column ``change`` says what is worse than in it.
    scheduler : str, optional
        Address of a Dask scheduler.
    workers : int, optional
        Processes on this computer; by default one per core.
    memory : str
        Of each, as "2 GB".
    progress : callable
        Told what is being done, how many logs are done, and of how many.
    **settings
        Fields of :class:`px4fuse.ComparisonRequest`, as ``sigma_z_m``.

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
    given = (paths,) if isinstance(paths, str | Path) else paths
    with TemporaryDirectory(prefix="px4fuse-") as scratch:
        fleet = run(
            map(str, given),
            Path(scratch if output is None else output),
            reports=reports and output is not None,
            timeout_s=timeout_s,
            baseline=baseline,
            scheduler=scheduler,
            workers=workers,
            memory=memory,
            progress=progress,
            **settings,
        )
    return fleet.table if output is not None else fleet.table.assign(results="", report="")


def run(
    paths: Iterable[str],
    output: Path,
    *,
    reports: bool = False,
    timeout_s: float = TIMEOUT_S,
    baseline: pd.DataFrame | None = None,
    scheduler: str | None = None,
    workers: int | None = None,
    memory: str = "auto",
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
    logs = {log.address: log for log in find_logs(paths)}
    try:
        request = ComparisonRequest(log="LOG", **settings)
    except TypeError as error:
        raise SettingsError(f"no such setting ({error}).") from error
    if request.mavlink is not None or request.position is not None:
        raise SettingsError("`mavlink` and `position` belong to one flight, not to many.")
    sigma_z_m = Settings().sigma_z_m if request.sigma_z_m is None else request.sigma_z_m
    Settings(request.sigma_a_m_s2, sigma_z_m, request.dt_s)  # refuses what is out of range
    version, used = metadata.version("px4fuse"), command_line(request)
    job = Job("", request, reports, max_log_bytes.get(), version)
    with connected(scheduler, workers, memory) as client, opened(output, version, used) as store:
        work = partial(_worked, client, timeout_s, progress)
        found = _Found(logs, output, store)
        try:
            _identify(found, work, job)
            todo = list(_todo(found, job))
            try:
                for one, outcome in work(analyse, todo, "comparing"):
                    _keep(found, one.address, outcome)
            finally:
                fleet = _written(found, baseline)
        except OutputError as error:
            raise OutputError(f"{error} {_GOES_ON}") from error
        except Px4FuseError as error:
            raise Px4FuseError(f"{error} {_GOES_ON}") from error
    return fleet


def _worked(
    client: Client, timeout_s: float, progress: Progress, function: Callable[[Job], Any],
    jobs: Sequence[Job], what: str,
) -> Iterator[tuple[Job, Any]]:  # fmt: skip
    """What comes of every job; of one whose worker gave nothing, the row that says why."""
    failed = 0
    progress(what, 0, len(jobs))
    with closing(outcomes(client, function, jobs, timeout_s=timeout_s)) as found:
        for number, (job, outcome) in enumerate(found, 1):
            if isinstance(outcome, WorkerFailed):
                row = refused(outcome.error, FAILED) | {"log_sha256": job.sha256}
                outcome = Outcome((row,))  # noqa: PLW2901
            failed += isinstance(outcome, Outcome) and outcome.rows[0]["status"] == FAILED
            yield job, outcome
            progress(f"{what}, {failed} failed", number, len(jobs))


def _identify(found: _Found, work: Callable[..., Iterator[tuple[Job, Any]]], job: Job) -> None:
    """Hash the logs that may be known, or be the same as another: those of a size that is."""
    sizes, known = Counter(log.size_bytes for log in found.logs.values()), found.store.sizes()
    asked = [
        replace(job, address=log.address)
        for log in found.logs.values()
        if log.size_bytes is None or sizes[log.size_bytes] > 1 or log.size_bytes in known
    ]
    for one, sha256 in work(identify, asked, "looking for what is new"):
        if isinstance(sha256, Outcome):
            found.lost[one.address] = sha256.rows[0]
        else:
            found.hash_of[one.address] = sha256
    first_of: dict[str, FoundLog] = {}
    for log in found.logs.values():
        if (sha256 := found.hash_of.get(log.address)) is None:
            continue
        if (first := first_of.setdefault(sha256, log)) is not log:
            found.lost[log.address] = {
                "status": NOT_JUDGED,
                "log_sha256": sha256,
                "reason": f"the same file as {first.log}, whose rows stand for both",
            }


def _todo(found: _Found, job: Job) -> Iterator[Job]:
    """Jobs of the logs of which not everything is there."""
    for log in found.logs.values():
        if log.address in found.lost:
            continue
        sha256 = found.hash_of.get(log.address, "")
        rows = found.store.rows(sha256)
        files = [rows[0][kind] for kind in FILES[: 1 + job.reports]] if rows else [""]
        if rows and ("axis" not in rows[0] or all((found.output / f).is_file() for f in files)):
            found.reused.add(sha256)
        else:
            yield replace(job, address=log.address, sha256=sha256)


def _keep(found: _Found, address: str, outcome: Outcome) -> None:
    """Write a log's files, then its rows: rows without files are never there."""
    row = outcome.rows[0]
    if row["status"] == FAILED:
        found.lost[address] = row
        return
    sha256 = found.hash_of[address] = row["log_sha256"]
    stem = f"results/{file_stem(row['name'], sha256)}"
    contents = {
        f"{stem}{end}": content
        for end, content in ((".json", outcome.results), (".pdf", outcome.report))
    }
    write_all({found.output / name: content for name, content in contents.items() if content})
    files = dict(zip(FILES, (name if contents[name] else "" for name in contents), strict=True))
    rows = [each | files for each in outcome.rows]
    found.store.keep(sha256, found.logs[address].size_bytes, rows)


def _written(found: _Found, baseline: pd.DataFrame | None) -> Fleet:
    """Make the table of all that is known by now, and write it."""
    severities: set[str] = set()

    def rows() -> Iterator[Row]:
        for log in found.logs.values():
            lost = found.lost.get(log.address)
            kept = [lost] if lost else found.store.rows(found.hash_of.get(log.address, ""))
            for row in kept:
                severities.update(row.get("severities", ()))
                yield row | {
                    "log": log.log,
                    "name": log.name,
                    "px4fuse": found.store.px4fuse,
                    "settings": found.store.settings,
                }

    table, against = table_of(rows()), ""
    if baseline is not None:
        table, against = marked(table, baseline)
    page = html_text(table, found.output.resolve().name, f"px4fuse {found.store.px4fuse}")
    parquet = io.BytesIO()
    table.to_parquet(parquet, index=False)
    contents = {
        found.output / "fleet.parquet": parquet.getvalue(),
        found.output / "fleet.csv": csv_bytes(table),
        found.output / "fleet.html": page.encode(),
    }
    write_all(contents)
    return Fleet(table, len(found.reused), frozenset(severities), tuple(contents), against)
