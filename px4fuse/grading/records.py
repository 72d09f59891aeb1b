"""Stored verifications: reports are verified again only if the report, a log or a version changed.

A record is found by the SHA-256 of the PDF. It is valid for the versions that made it and the files
that were available. It is independent of rubric, answer key, class list and overrides.
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

# subfolder of the output folder
RECORDS = "records"
# file name of a redrawn report: SHA-256 of the handed-in PDF with this suffix; record: ".json"
REDRAWN_SUFFIX = ".pdf"


@dataclass(frozen=True)
class VerificationRecord:
    """Verification of one report.

    Attributes
    ----------
    rests_on : dict
        Versions and files for which the record is valid: see :func:`_dependencies`.
    results : str
        Attached results.
    """

    rests_on: dict[str, str]
    results: str
    verdict: Verdict


def load_or_verify(
    records: Path, pdf: bytes, logs: Mapping[str, Path], handed_out: frozenset[str]
) -> tuple[ReportedResults, Verdict, bool]:
    """Read and verify a report, or load the stored verification.

    Parameters
    ----------
    pdf : bytes
        Content of the file.
    logs : mapping
        Files by SHA-256.
    handed_out : frozenset of str
        SHA-256 of the logs in the answer key. If such a log is not available, the verdict is
        "cannot verify", not "other log".

    Returns
    -------
    results, verdict
    recalled : bool
        True if the verification was loaded.

    Raises
    ------
    ResultsError
        The file is not a report.
    """
    sha256 = hashlib.sha256(pdf).hexdigest()
    if loaded := _load_record(records, sha256, logs, handed_out):
        return *loaded, True
    results = read_report(pdf, "The file")
    attached = to_json(results)
    rests_on = _dependencies(attached, logs, handed_out)
    gap = rests_on.get(log_sha256(results)) == "handed out"
    verdict = verify(results, pdf, {} if gap else logs)
    files = {REDRAWN_SUFFIX: verdict.redrawn} if verdict.redrawn else {}
    stored_verdict = replace(verdict, redrawn=b"")
    _write_record(records, sha256, VerificationRecord(rests_on, attached, stored_verdict), files)
    return results, stored_verdict, False


def _dependencies(
    results: str, logs: Mapping[str, Path], handed_out: frozenset[str]
) -> dict[str, str]:
    """Return the library versions, and the availability of each file of a report by SHA-256.

    Availability: "here", "handed out" (in the answer key, but not available), or "away".
    """
    return _versions() | {
        name: "here" if name in logs else "handed out" if name in handed_out else "away"
        for name in sorted(set(file_hashes_in(results)))
    }


@cache
def _versions() -> dict[str, str]:
    versions = provenance("")
    return {**versions.libraries, "px4fuse": versions.px4fuse}


def _write_record(
    records: Path, sha256: str, record: VerificationRecord, files: Mapping[str, bytes]
) -> None:
    for earlier in records.glob(f"{sha256}.*"):
        # keep the record: another process may read it for an identical file
        if earlier.suffix != ".json":
            earlier.unlink(missing_ok=True)
    contents = {**files, ".json": msgspec.json.encode(record)}
    write_all({records / f"{sha256}{end}": content for end, content in contents.items()})


def _load_record(
    records: Path, sha256: str, logs: Mapping[str, Path], handed_out: frozenset[str]
) -> tuple[ReportedResults, Verdict] | None:
    """Load a record if all of its dependencies are unchanged; else None."""
    try:
        content = (records / f"{sha256}.json").read_bytes()
        record = msgspec.json.decode(content, type=VerificationRecord)
        if record.rests_on != _dependencies(record.results, logs, handed_out):
            return None
        results = read_results(record.results.encode())
    # no record, or not readable: verify again
    except (OSError, msgspec.MsgspecError, ResultsError):
        return None
    return (results, record.verdict) if isinstance(results, ReportedResults) else None
