"""Inputs of ``px4fuse diff``: a log, a report (PDF) with its results, or results (JSON)."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from msgspec.structs import replace

from px4fuse.core.reading import display_name, hash_files, read_bytes_limited, read_head
from px4fuse.diagnose import diagnose_or_check_aids
from px4fuse.errors import LogError, ResultsError
from px4fuse.filter.settings import Settings
from px4fuse.request import ComparisonRequest
from px4fuse.results.build import make_comparison_or_aids_results
from px4fuse.results.contract import AidsResults, ComparisonResults, to_json
from px4fuse.results.reading import MAX_RESULTS_BYTES, read_results
from px4fuse.verification.pdf_input import MAX_PDF_BYTES, read_attached_results

InputKind = Literal["log", "report", "results"]
ProgressCallback = Callable[[str], None]
Results = ComparisonResults | AidsResults
# Settings that are copied from the other input if A and B are different logs
_FILTER_SETTINGS = {*Settings.__dataclass_fields__, "axes"}
# Settings that name input files. They are not copied if A and B are the same log
_INPUT_FILE_SETTINGS = {"log", "system", "position"}


@dataclass(frozen=True)
class InputResults:
    """Results of one of the two inputs of ``px4fuse diff``."""

    file_name: str
    kind: InputKind
    results: Results


def read_diff_inputs(
    a: Path, b: Path, progress: ProgressCallback = lambda _: None
) -> tuple[InputResults, InputResults]:
    """Read results from two logs, reports (PDF) or results files.

    If only one input is a log, the log is analysed with the settings in the other input.

    Raises
    ------
    LogError, MissingDataError
        A log cannot be read, or does not contain the required data.
    ResultsError
        An input cannot be read or compared, or A and B are the same file.
    """
    first_input, second_input = (_read_given_results(path) for path in (a, b))
    if a.samefile(b):
        raise ResultsError(f"{display_name(a)}: A and B are the same file. Give two files.")
    return (
        first_input or _analyse_log(a, second_input, progress),
        second_input or _analyse_log(b, first_input, progress),
    )


def _read_given_results(path: Path) -> InputResults | None:
    """Read the results in a report (PDF) or a JSON file; return None for a log."""
    name, head = display_name(path), read_head(path, 64, LogError)
    is_report = head.startswith(b"%PDF-")
    if not is_report and not head.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"{"):
        return None
    limit_bytes = MAX_PDF_BYTES if is_report else MAX_RESULTS_BYTES
    remedy = "Give a report (PDF) or the results (JSON) of px4fuse compare."
    content = read_bytes_limited(path, ResultsError, limit_bytes, remedy_if_too_large=remedy)
    results = (read_attached_results if is_report else read_results)(content, name)
    if not isinstance(results, Results):
        raise ResultsError(
            f"{name} contains results with the schema {results.schema.name}, which px4fuse diff "
            "cannot compare. Give a log, or a report or results of px4fuse compare."
        )
    return InputResults(name, "report" if is_report else "results", results)


def _analyse_log(
    path: Path, input_with_settings: InputResults | None, progress: ProgressCallback
) -> InputResults:
    request = ComparisonRequest(log=str(path))
    if input_with_settings is not None:
        is_same_log = input_with_settings.results.log.sha256 in hash_files([path])
        copied_setting_names = (
            {*request.__struct_fields__} - _INPUT_FILE_SETTINGS if is_same_log else _FILTER_SETTINGS
        )
        request = replace(
            request,
            **{
                name: getattr(input_with_settings.results.request, name)
                for name in copied_setting_names
            },
        )
    analysis = diagnose_or_check_aids(request, progress)
    # to_json rounds all numbers, as in a report
    results_json = to_json(make_comparison_or_aids_results(request, analysis))
    results = read_results(results_json.encode())
    assert isinstance(results, Results)
    return InputResults(display_name(path), "log", results)
