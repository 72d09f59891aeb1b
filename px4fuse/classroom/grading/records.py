"""Cache for the verification of submitted reports (PDF).

A cached result is valid while library versions and available input files are unchanged.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
from msgspec import structs

from px4fuse.core.writing import write_output_files
from px4fuse.errors import ResultsError
from px4fuse.readers.ulog_topics import ignores_assignment_flag
from px4fuse.results.contract import ReportedResults, find_file_hashes, to_json
from px4fuse.results.model import provenance
from px4fuse.results.reading import read_results
from px4fuse.verification.model import Verification
from px4fuse.verification.pdf_input import read_report
from px4fuse.verification.verification import log_sha256, recompute_report, verify

# Subfolder of the output folder for the cached results
RECORDS_FOLDER = "records"
# Suffix of the report that px4fuse recomputes from the log
REDRAWN_REPORT_SUFFIX = ".pdf"
# Suffix of the report with the faults that px4fuse found, as feedback for the student
DIAGNOSIS_SUFFIX = ".diagnosis.pdf"


@dataclass(frozen=True)
class VerificationRecord:
    """Result of the verification of a PDF, for the cache.

    Attributes
    ----------
    versions_and_files : dict
        Versions of libraries, and availability of input files by SHA-256.
    results : str
        Results (JSON) that are attached to the PDF.
    """

    versions_and_files: dict[str, str]
    results: str
    verification: Verification


def load_or_verify(
    records_folder: Path,
    pdf: bytes,
    path_by_sha256: Mapping[str, Path],
    assigned_hashes: frozenset[str],
) -> tuple[ReportedResults, Verification, bool]:
    """Read and verify a report, or load the result of an earlier verification.

    Parameters
    ----------
    records_folder : Path
        Folder of earlier results.
    pdf : bytes
        Content of the submitted file.
    path_by_sha256 : mapping
        Logs and other input files.
    assigned_hashes : frozenset of str
        SHA-256 of the logs in the answer key.

    Returns
    -------
    results : ComparisonResults or LoopResults
        Results of the report.
    verification : Verification
    is_loaded : bool
        True if an earlier result was loaded.

    Raises
    ------
    ResultsError
        The file is not a report.
    """
    sha256 = hashlib.sha256(pdf).hexdigest()
    if loaded := _load_record(records_folder, sha256, path_by_sha256, assigned_hashes):
        return *loaded, True
    results = read_report(pdf, "The file")
    versions_and_files = _collect_versions_and_files(
        to_json(results), path_by_sha256, assigned_hashes
    )
    # without logs, the status is "cannot verify" instead of "other log"
    is_log_missing = versions_and_files.get(log_sha256(results)) == "assigned"
    verification = verify(results, pdf, {} if is_log_missing else path_by_sha256)
    files = {REDRAWN_REPORT_SUFFIX: verification.redrawn_pdf} if verification.redrawn_pdf else {}
    if verification.status == "verified" and log_sha256(results) in assigned_hashes:
        results, files[DIAGNOSIS_SUFFIX] = repeat_analysis_with_diagnosis(results, path_by_sha256)
    stored_verification = replace(verification, redrawn_pdf=b"")
    record = VerificationRecord(versions_and_files, to_json(results), stored_verification)
    for old_file in records_folder.glob(f"{sha256}.*"):
        # keep the JSON file: another process may read it if two students handed in the same PDF
        if old_file.suffix != ".json":
            old_file.unlink(missing_ok=True)
    files[".json"] = msgspec.json.encode(record)
    write_output_files(
        {records_folder / f"{sha256}{suffix}": content for suffix, content in files.items()}
    )
    return results, stored_verification, False


def repeat_analysis_with_diagnosis(
    results: ReportedResults, path_by_sha256: Mapping[str, Path]
) -> tuple[ReportedResults, bytes]:
    """Repeat the analysis and include the faults that were hidden from the student.

    Return results and report (PDF).
    """
    token = ignores_assignment_flag.set(True)
    try:
        outcome = recompute_report(results, path_by_sha256)
    finally:
        ignores_assignment_flag.reset(token)
    if isinstance(outcome, Verification):
        raise ResultsError(f"No diagnosis report for the student: {'; '.join(outcome.reasons)}.")
    diagnosed_results, draw = outcome
    return structs.replace(diagnosed_results, provenance=results.provenance), draw()


def _collect_versions_and_files(
    results: str, path_by_sha256: Mapping[str, Path], assigned_hashes: frozenset[str]
) -> dict[str, str]:
    """Return the versions of libraries, and the availability of input files by SHA-256."""
    versions = provenance("")
    versions_and_files = {**versions.libraries, "px4fuse": versions.px4fuse}
    for sha256 in find_file_hashes(results):
        if sha256 in path_by_sha256:
            versions_and_files[sha256] = "available"
        else:
            versions_and_files[sha256] = "assigned" if sha256 in assigned_hashes else "missing"
    return versions_and_files


def _load_record(
    records_folder: Path,
    sha256: str,
    path_by_sha256: Mapping[str, Path],
    assigned_hashes: frozenset[str],
) -> tuple[ReportedResults, Verification] | None:
    """Load the result of an earlier verification; None without a valid result."""
    try:
        record = msgspec.json.decode(
            (records_folder / f"{sha256}.json").read_bytes(), type=VerificationRecord
        )
        if record.versions_and_files != _collect_versions_and_files(
            record.results, path_by_sha256, assigned_hashes
        ):
            return None
        results = read_results(record.results.encode())
    # the report is verified again if the earlier result is unreadable
    except (OSError, msgspec.MsgspecError, ResultsError):
        return None
    return (results, record.verification) if isinstance(results, ReportedResults) else None
