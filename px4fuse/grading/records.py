"""What verifying a report found, kept apart from its points: they change, the flight does not.

A record is found by the content of the PDF, whoever handed it in and under what name, and holds
for the versions that made it and the files that were there: the report says which log and which
request. Rubric, answer key, roster and overrides are not in it.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from importlib import metadata
from pathlib import Path

import msgspec

from px4fuse.errors import ResultsError
from px4fuse.flight import Unavailable
from px4fuse.results.contract import ComparisonResults, LoopResults, Reported, to_json
from px4fuse.results.reading import read_results
from px4fuse.verification.intake import read_report
from px4fuse.verification.model import Refused, Report, Seal, Verdict
from px4fuse.verification.pages import MEMORY_BYTES, TIMEOUT_S, page_texts
from px4fuse.verification.pictures import key_page, picture
from px4fuse.verification.rerun import log_sha256
from px4fuse.verification.verification import verify
from px4fuse.verification.workers import Failed, bounded
from px4fuse.writing import write_all

HANDED_IN, REDRAWN, RESULTS = ".handed-in.png", ".pdf", ".results.json"
MADE_WITH = ("px4fuse", "numpy", "scipy", "matplotlib", "pypdfium2", "pillow")
THE_FILE = "The file"
_SHA256 = re.compile(rb'"([0-9a-f]{64})"')


# A report without its bytes, with the pages of the redrawn one as far as there is one; what was
# found; and which page the pictures show, counted from 1
Verified = tuple[Report, Verdict, int]


@dataclass(frozen=True)
class _Kept:
    """What a record says besides its other files; of a refused file only why."""

    made_with: dict[str, str]
    refused: str = ""
    files: dict[str, bool] = field(default_factory=dict)
    gap: bool = False
    verdict: Verdict | None = None
    seal: Seal = "missing"
    pages: tuple[str, ...] = ()
    page: int = 1


def file_of(records: Path, sha256: str, end: str = ".json") -> Path:
    """Where a part of the record of a PDF stands."""
    return records / f"{sha256}{end}"


def verified(
    records: Path, pdf: bytes, logs: Mapping[str, Path], handed_out: frozenset[str]
) -> tuple[Verified | Refused, bool]:
    """Read and verify a report, or recall what an earlier run found.

    Parameters
    ----------
    pdf : bytes
        Anything.
    logs : mapping
        Files by SHA-256.
    handed_out : frozenset of str
        SHA-256 of the logs in the answer key: one of them that is not at hand is the
        instructor's gap, not another log.

    Returns
    -------
    Verified or Refused
    recalled : bool
    """
    sha256 = hashlib.sha256(pdf).hexdigest()
    found = _recalled(records, sha256, logs, handed_out)
    if found is not None:
        return found, True
    report = read_report(pdf, THE_FILE)
    if isinstance(report, Refused):
        _keep(records, sha256, _Kept(_versions(), report.reason), {})
        return report, False
    gap = _is_gap(report.results, logs, handed_out)
    verdict = verify(report, {} if gap else logs)
    # what is shown and scored is the redrawn report, as far as there is one
    if verdict.redrawn:
        seen = replace(report, pages=page_texts(verdict.redrawn))
    else:
        texts = bounded(page_texts, pdf, TIMEOUT_S, MEMORY_BYTES)
        seen = replace(report, pages=() if isinstance(texts, Failed) else texts)
    page = _page_to_show(verdict, seen)
    handed_in: bytes | Unavailable | Failed = b""
    if verdict.pages or not verdict.redrawn:
        handed_in = bounded(_picture, (pdf, page - 1), TIMEOUT_S, MEMORY_BYTES)
    results = to_json(report.results).encode()
    unread = replace(verdict, redrawn=b"")
    files = {name: name in logs for name in _named(results)}
    kept = _Kept(_versions(), "", files, gap, unread, report.seal, seen.pages, page)
    parts = {
        RESULTS: results,
        HANDED_IN: handed_in if isinstance(handed_in, bytes) else b"",
        REDRAWN: verdict.redrawn,
    }
    _keep(records, sha256, kept, parts)
    return (replace(seen, pdf=b""), unread, page), False


def _picture(job: tuple[bytes, int]) -> bytes | Unavailable:
    return picture(*job)


def _is_gap(results: Reported, logs: Mapping[str, Path], handed_out: frozenset[str]) -> bool:
    log = log_sha256(results)
    return log in handed_out and log not in logs


def _named(results: bytes) -> list[str]:
    """The SHA-256 of every file that a report rests on."""
    return sorted({match[1].decode() for match in _SHA256.finditer(results)})


def _page_to_show(verdict: Verdict, report: Report) -> int:
    """The page that differs most, else the cover; counted from 1."""
    if verdict.pages:
        return max(verdict.pages, key=lambda one: (one.picture, one.words)).page
    return 1 + (0 if verdict.redrawn else key_page(report.pages))


@cache
def _versions() -> dict[str, str]:
    found = {}
    for name in MADE_WITH:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:  # pictures are an extra
            found[name] = ""
    return found


def _keep(records: Path, sha256: str, kept: _Kept, parts: Mapping[str, bytes]) -> None:
    files = {file_of(records, sha256, end): content for end, content in parts.items()}
    write_all({**files, file_of(records, sha256): msgspec.json.encode(kept)})


def _recalled(
    records: Path, sha256: str, logs: Mapping[str, Path], handed_out: frozenset[str]
) -> Verified | Refused | None:
    """What an earlier run found, if nothing that it rests on has changed."""
    try:
        kept = msgspec.json.decode(file_of(records, sha256).read_bytes(), type=_Kept)
        if kept.made_with != _versions():
            return None
        if kept.verdict is None:
            return Refused(kept.refused)
        data = file_of(records, sha256, RESULTS).read_bytes()
        results = read_results(data)
    # none, or not one of ours: done again
    except (OSError, msgspec.MsgspecError, ResultsError):
        return None
    if not isinstance(results, ComparisonResults | LoopResults):
        return None
    files = {name: name in logs for name in _named(data)}
    if kept.files != files or kept.gap != _is_gap(results, logs, handed_out):
        return None
    return Report(sha256, kept.seal, results, kept.pages, b""), kept.verdict, kept.page
