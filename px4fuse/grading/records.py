"""Stored verifications: a report is verified again only if the report, a log or a version changed.

The SHA-256 of the PDF identifies its record. A record is valid while library versions and available
input files are unchanged. It contains no points, so a change of the rubric or of overrides needs no
new verification.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import msgspec

from px4fuse.errors import ResultsError
from px4fuse.results.contract import ReportedResults, file_hashes_in, to_json
from px4fuse.results.model import provenance
from px4fuse.results.reading import read_results
from px4fuse.verification.model import Verdict
from px4fuse.verification.pdf_input import read_report
from px4fuse.verification.verification import log_sha256, verify
from px4fuse.writing import write_all

# subfolder of the output folder, for the records
RECORDS_FOLDER = "records"
# suffix of a redrawn report; record and redrawn report have the SHA-256 of the submitted PDF as
# name
REDRAWN_SUFFIX = ".pdf"


@dataclass(frozen=True)
class VerificationRecord:
    """Verification of one report.

    Attributes
    ----------
    dependencies : dict
        Versions and files for which the record is valid: see :func:`_dependencies`.
    results : str
        Results attached to the PDF, as JSON.
    """

    dependencies: dict[str, str]
    results: str
    verdict: Verdict


def load_or_verify(
    records: Path, pdf: bytes, logs: Mapping[str, Path], assigned_hashes: frozenset[str]
) -> tuple[ReportedResults, Verdict, bool]:
    """Read and verify a report, or load its stored verification.

    Parameters
    ----------
    records : Path
        Folder of the records.
    pdf : bytes
        Content of the submitted file.
    logs : mapping
        Files by SHA-256.
    assigned_hashes : frozenset of str
        SHA-256 of the logs in the answer key. A report on one of these logs gets the verdict
        "cannot verify", not "other log", if the log is not in ``logs``.

    Returns
    -------
    results, verdict
    is_loaded : bool
        True if the stored verification was loaded.

    Raises
    ------
    ResultsError
        The file is not a report.
    """
    sha256 = hashlib.sha256(pdf).hexdigest()
    if loaded := _load_record(records, sha256, logs, assigned_hashes):
        return *loaded, True
    results = read_report(pdf, "The file")
    attached = to_json(results)
    dependencies = _dependencies(attached, logs, assigned_hashes)
    is_log_missing = dependencies.get(log_sha256(results)) == "assigned"
    verdict = verify(results, pdf, {} if is_log_missing else logs)
    files = {REDRAWN_SUFFIX: verdict.redrawn} if verdict.redrawn else {}
    stored_verdict = replace(verdict, redrawn=b"")
    _write_record(
        records, sha256, VerificationRecord(dependencies, attached, stored_verdict), files
    )
    return results, stored_verdict, False


def _dependencies(
    results: str, logs: Mapping[str, Path], assigned_hashes: frozenset[str]
) -> dict[str, str]:
    """Return the library versions, and the availability of each input file by SHA-256.

    Availability: "available", "assigned" (in the answer key, but not available), or "missing".
    """
    return _versions() | {
        name: "available" if name in logs else "assigned" if name in assigned_hashes else "missing"
        for name in sorted(set(file_hashes_in(results)))
    }


@cache
def _versions() -> dict[str, str]:
    versions = provenance("")
    return {**versions.libraries, "px4fuse": versions.px4fuse}


def _write_record(
    records: Path, sha256: str, record: VerificationRecord, files: Mapping[str, bytes]
) -> None:
    for old_file in records.glob(f"{sha256}.*"):
        # the record is replaced, not deleted: another process may read it for an identical PDF
        if old_file.suffix != ".json":
            old_file.unlink(missing_ok=True)
    contents = {**files, ".json": msgspec.json.encode(record)}
    write_all({records / f"{sha256}{suffix}": content for suffix, content in contents.items()})


def _load_record(
    records: Path, sha256: str, logs: Mapping[str, Path], assigned_hashes: frozenset[str]
) -> tuple[ReportedResults, Verdict] | None:
    """Load the record of a PDF; None if there is none, or its dependencies have changed."""
    try:
        content = (records / f"{sha256}.json").read_bytes()
        record = msgspec.json.decode(content, type=VerificationRecord)
        if record.dependencies != _dependencies(record.results, logs, assigned_hashes):
            return None
        results = read_results(record.results.encode())
    # without a readable record, the report is verified again
    except (OSError, msgspec.MsgspecError, ResultsError):
        return None
    return (results, record.verdict) if isinstance(results, ReportedResults) else None
