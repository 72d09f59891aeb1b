"""What ``diff`` compares: a log, the results attached to a report, or results as JSON."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from msgspec.structs import replace

from px4fuse.analysis import Analysis, run
from px4fuse.display import brief
from px4fuse.errors import LogError, ResultsError
from px4fuse.findings import find
from px4fuse.reading import read_head, read_whole, shown
from px4fuse.request import ComparisonRequest, command_line
from px4fuse.results.build import results
from px4fuse.results.contract import ComparisonResults
from px4fuse.results.model import Student
from px4fuse.results.reading import MAX_BYTES as MAX_RESULTS_BYTES
from px4fuse.results.reading import read_results
from px4fuse.verification.intake import MAX_BYTES as MAX_REPORT_BYTES
from px4fuse.verification.intake import read_report
from px4fuse.verification.model import Refused

Kind = Literal["log", "report", "results"]
Progress = Callable[[str], None]
# What a log is analysed with is what the other side's results were made with; more of it where
# they are of the same log
_FILTER = ("sigma_a_m_s2", "sigma_z_m", "dt_s", "input", "axes", "clock_offset_s")
_PART = ("heading_deg", "start_s", "end_s", "position_source")


@dataclass(frozen=True, repr=False)
class Side:
    """One of two comparisons.

    Attributes
    ----------
    given : str
        Name of the file.
    analysis : Analysis or None
        Where the log is at hand.
    """

    given: str
    kind: Kind
    results: ComparisonResults
    analysis: Analysis | None = None

    __repr__ = brief


def read_sides(a: Path, b: Path, progress: Progress = lambda _: None) -> tuple[Side, Side]:
    """Read both; a log is analysed with the settings of the other side's results, if it has some.

    Raises
    ------
    LogError, MissingDataError
        A log cannot be read, or cannot be compared with EKF2.
    ResultsError
        A report or results cannot be read, are not of ``px4fuse compare``, or both are one file.
    """
    paths = (a, b)
    kinds = [_kind(path) for path in paths]
    if a.samefile(b):
        raise ResultsError(f"{shown(a)}: A and B are the same file. Give two.")
    read = [
        None if kind == "log" else Side(shown(path), kind, _read(path, kind))
        for path, kind in zip(paths, kinds, strict=True)
    ]
    made = [
        side or _analysed(path, read[1 - at], progress)
        for at, (path, side) in enumerate(zip(paths, read, strict=True))
    ]
    return made[0], made[1]


def _kind(path: Path) -> Kind:
    head = read_head(path, 64, LogError)
    if head.startswith(b"%PDF-"):
        return "report"
    return "results" if head.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"{") else "log"


def _read(path: Path, kind: Kind) -> ComparisonResults:
    name = shown(path)
    if kind == "report":
        content = read_whole(path, ResultsError, MAX_REPORT_BYTES, smaller="Reports are below 2 MB")
        report = read_report(content, name)
        if isinstance(report, Refused):
            raise ResultsError(report.reason)
        found: object = report.results
    else:
        content = read_whole(
            path, ResultsError, MAX_RESULTS_BYTES, smaller="Give results of px4fuse compare"
        )
        found = read_results(content, name)
    if not isinstance(found, ComparisonResults):
        made_by = getattr(found, "schema").name  # noqa: B009 - every kind of results has one
        raise ResultsError(
            f"{name}: holds {made_by}; px4fuse diff takes what px4fuse compare writes, or a log."
        )
    return found


def _analysed(path: Path, other: Side | None, progress: Progress) -> Side:
    request = ComparisonRequest(log=str(path))
    if other is not None:
        with path.open("rb") as file:
            is_same = hashlib.file_digest(file, "sha256").hexdigest() == other.results.log.sha256
        asked = other.results.request
        fields = (*_FILTER, *_PART) if is_same else _FILTER
        request = replace(request, **{name: getattr(asked, name) for name in fields})
    analysis = run(request, progress)
    found = results(request, analysis, find(analysis), Student(), command_line(request))
    return Side(shown(path), "log", found, analysis)
