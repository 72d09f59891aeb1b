"""Analysis of one log for ``px4fuse batch``, with table rows, results and report."""

import re
from dataclasses import dataclass
from pathlib import Path

import msgspec

from px4fuse.core.reading import hash_files, max_log_bytes
from px4fuse.errors import LogError, MissingDataError, Px4FuseError
from px4fuse.request import ComparisonRequest, replace_argument_names

from .logs import LogAddress, local_file
from .rows import (
    STATUS_FAILED,
    STATUS_NOT_COMPARED,
    Row,
    collect_finding_values,
    collect_log_values,
    make_axis_rows,
)


@dataclass(frozen=True)
class Job:
    """Log to analyse, and settings of the analysis.

    Attributes
    ----------
    max_bytes : int
        Maximum size of the log.
    finished_hashes : frozenset of str
        SHA-256 of logs with results from an earlier run.
    """

    log: LogAddress
    request: ComparisonRequest
    writes_report: bool
    max_bytes: int
    finished_hashes: frozenset[str] = frozenset()


@dataclass(frozen=True)
class LogOutcome:
    """Result of one log: table rows (one per axis), results (JSON), and report (PDF)."""

    sha256: str
    rows: tuple[Row, ...] = ()
    results_json: bytes = b""
    report_pdf: bytes = b""


def analyse(job: Job) -> LogOutcome:
    """Compare KF and EKF2 on one log, as ``px4fuse compare`` does."""
    sha256 = ""
    max_log_bytes.set(job.max_bytes)
    try:
        with local_file(job.log.address) as path:
            (sha256,) = hash_files([path])
            if sha256 in job.finished_hashes:
                return LogOutcome(sha256)
            outcome = _compare_log(job, path, sha256)
            if sha256 not in hash_files([path]):
                raise LogError(
                    "the log changed while it was read",
                    "Run the same command again after the log was written completely.",
                )
            return outcome
    except Px4FuseError as error:
        return LogOutcome(sha256, (make_failure_row(error) | {"log_sha256": sha256},))


def make_failure_row(error: Px4FuseError, name: str = "") -> Row:
    """Return the columns with status, reason and action for a log without results."""
    status = STATUS_NOT_COMPARED if isinstance(error, MissingDataError) else STATUS_FAILED
    reason = replace_argument_names(error.reason).removeprefix(f"{name}: ")
    return {"status": status, "reason": reason, "remedy": replace_argument_names(error.remedy)}


def _compare_log(job: Job, path: Path, sha256: str) -> LogOutcome:
    """Analyse one log in a worker process; return its table rows, JSON results and report."""
    # slow imports, which only the worker processes need
    from px4fuse.analysis import AidingSourceAnalysis  # noqa: PLC0415
    from px4fuse.diagnose import diagnose_or_check_aids, read_flight  # noqa: PLC0415
    from px4fuse.results.build import make_comparison_results, make_log_record  # noqa: PLC0415
    from px4fuse.results.contract import to_json  # noqa: PLC0415

    request = msgspec.structs.replace(job.request, log=str(path))
    row: Row = {"name": path.name, "log_sha256": sha256}
    try:
        flight = read_flight(request)
        row |= collect_log_values(make_log_record(flight))
        analysis = diagnose_or_check_aids(request, flight=flight)
        if isinstance(analysis, AidingSourceAnalysis):
            row |= collect_finding_values(analysis.findings, analysis.aids)
            raise MissingDataError(analysis.missing_data.reason, analysis.missing_data.remedy)
        comparison_results = make_comparison_results(request, analysis)
        results_json, report_pdf = to_json(comparison_results), b""
        if job.writes_report:
            from px4fuse.report.pdf import render_pdf  # noqa: PLC0415

            report_pdf = render_pdf(analysis, comparison_results, results_json)
    except Px4FuseError as error:
        return LogOutcome(sha256, (row | make_failure_row(error, path.name),))
    return LogOutcome(
        sha256, tuple(make_axis_rows(comparison_results)), results_json.encode(), report_pdf
    )


def make_file_stem(name: str, sha256: str) -> str:
    """Return an output file name: name of the log and first digits of its SHA-256.

    >>> make_file_stem("Flug 3.ulg", "ab" * 32)
    'Flug_3-abababababab'
    """
    return f"{re.sub(r'[^A-Za-z0-9_.-]+', '_', Path(name).stem)[:60]}-{sha256[:12]}"
