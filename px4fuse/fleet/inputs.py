"""What ``diff`` compares: a log, the results attached to a report, or results as JSON."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from msgspec.structs import replace

from px4fuse.analysis import run_or_judge_aids
from px4fuse.errors import LogError, ResultsError
from px4fuse.reading import files_by_sha256, read_head, read_whole, shown
from px4fuse.request import ComparisonRequest
from px4fuse.results.build import judged_results
from px4fuse.results.contract import AidsResults, ComparisonResults, to_json
from px4fuse.results.reading import MAX_BYTES as MAX_RESULTS_BYTES
from px4fuse.results.reading import read_results
from px4fuse.verification.intake import MAX_BYTES as MAX_REPORT_BYTES
from px4fuse.verification.intake import attached_results

Kind = Literal["log", "report", "results"]
Progress = Callable[[str], None]
Results = ComparisonResults | AidsResults
# A log is analysed with these settings of the other one's results, and with more of them where
# they are of the same log
_FILTER = ("sigma_a_m_s2", "sigma_z_m", "dt_s", "input", "axes", "clock_offset_s")
_PART = ("heading_deg", "start_s", "end_s", "position_source", "source_kind", "height")


@dataclass(frozen=True)
class DiffInput:
    """One of two comparisons; ``given`` is the name of the file."""

    given: str
    kind: Kind
    results: Results


def read_inputs(
    a: Path, b: Path, progress: Progress = lambda _: None
) -> tuple[DiffInput, DiffInput]:
    """Read both; a log is analysed with the settings of the other one's results, if it has some.

    Raises
    ------
    LogError, MissingDataError
        A log cannot be read, or nothing of it can be judged.
    ResultsError
        A report or results cannot be read, are not of ``px4fuse compare``, or both are one file.
    """
    first, second = (_read(path) for path in (a, b))
    if a.samefile(b):
        raise ResultsError(f"{shown(a)}: A and B are the same file. Give two.")
    return (
        first or _analysed(a, second, progress),
        second or _analysed(b, first, progress),
    )


def _read(path: Path) -> DiffInput | None:
    """The results in a file; None of a log."""
    name, head = shown(path), read_head(path, 64, LogError)
    is_report = head.startswith(b"%PDF-")
    if not is_report and not head.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"{"):
        return None
    limit = MAX_REPORT_BYTES if is_report else MAX_RESULTS_BYTES
    advice = "Reports are below 2 MB" if is_report else "Give results of px4fuse compare"
    content = read_whole(path, ResultsError, limit, smaller=advice)
    found = (attached_results if is_report else read_results)(content, name)
    if not isinstance(found, Results):
        raise ResultsError.of("not_to_compare", name=name, found=found)
    return DiffInput(name, "report" if is_report else "results", found)


def _analysed(path: Path, other: DiffInput | None, progress: Progress) -> DiffInput:
    request = ComparisonRequest(log=str(path))
    if other is not None:
        is_same = other.results.log.sha256 in files_by_sha256([path])
        fields = (*_FILTER, *_PART) if is_same else _FILTER
        request = replace(
            request, **{name: getattr(other.results.request, name) for name in fields}
        )
    found = run_or_judge_aids(request, progress)
    text = to_json(judged_results(request, found))  # the same digits as in a report
    results = read_results(text.encode())
    assert isinstance(results, Results)
    return DiffInput(shown(path), "log", results)
