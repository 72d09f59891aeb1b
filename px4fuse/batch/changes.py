"""Differences in settings, numbers and findings between two results (``px4fuse diff``).

``measures.csv`` lists the compared numbers: path in the JSON results, label and unit. In a path,
``*`` stands for any key. A path with ``FILTER`` stands for two paths: ``axes.*.filters.kf`` and
``axes.*.filters.ekf2`` replace ``FILTER``.
"""

import math
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from msgspec.structs import replace

from px4fuse.comparison.model import FILTER_NAMES, FilterSummary
from px4fuse.comparison.reruns import is_inconsistent
from px4fuse.core.reading import display_name, hash_files, read_bytes_limited, read_head
from px4fuse.core.record import read_csv
from px4fuse.core.text import format_factor, format_number
from px4fuse.diagnose import diagnose_or_check_aids
from px4fuse.errors import LogError, ResultsError
from px4fuse.filter.frame_rotation import HeadingError
from px4fuse.filter.settings import SETTING_RANGES, Settings
from px4fuse.filter.signals import AISLE_AXIS
from px4fuse.filter.time_offset import SourceTimeOffset
from px4fuse.flight.ekf2_parameters import AIDS
from px4fuse.request import ComparisonRequest
from px4fuse.results.build import make_comparison_or_aids_results, make_results
from px4fuse.results.contract import (
    AidsResults,
    ComparisonResults,
    ConfidenceInterval,
    DiffInput,
    DiffInputName,
    DiffResults,
    NumberChange,
    SettingChange,
    UnsharedFinding,
    to_json,
)
from px4fuse.results.reading import MAX_RESULTS_BYTES, read_results
from px4fuse.verification.pdf_input import MAX_PDF_BYTES, read_attached_results

from .rows import find_value

ProgressCallback = Callable[[str], None]
Results = ComparisonResults | AidsResults
# Numbers in the results that px4fuse diff compares between two reports: rows of measures.csv. The
# column "interval" is the field in the results that contains the 95 % interval of the number
COMPARED_NUMBER_DEFINITIONS = [
    row
    | {
        "path": row["path"].replace("FILTER", f"axes.*.filters.{name}"),
        "label": row["label"].replace("FILTER", label),
    }
    for row in read_csv(__file__, dict[str, str], "measures.csv")
    for name, label in (FILTER_NAMES.items() if "FILTER" in row["path"] else [("", "")])
]
# px4fuse diff lists a number only if its relative difference between A and B is larger than this
MIN_RELATIVE_DIFFERENCE_OF_LISTED_NUMBERS = 0.01
# px4fuse diff lists a number only if A and B differ by more than this (in the unit of the number)
MIN_DIFFERENCE_OF_LISTED_NUMBERS = 0.001

# Maximum √(mean NEES) of a consistent filter; the minimum is 1 ÷ maximum. The limits are wide,
# because the errors in a flight are correlated
MAX_SQRT_MEAN_NEES = 2.0
# Settings and flight properties that px4fuse diff compares
SETTING_PATHS_BY_LABEL = {
    **{
        SETTING_RANGES[name].format_label() if name in SETTING_RANGES else name: f"settings.{name}"
        for name in Settings.__dataclass_fields__
    },
    "start of the analysed time (s)": "settings.start_s",
    "end of the analysed time (s)": "settings.end_s",
    "position source": "source.name",
    "firmware": "log.firmware",
    "firmware hash": "log.firmware_hash",
    "hardware": "log.hardware",
    "px4fuse": "provenance.px4fuse",
}
# If A and B are of different logs, `diff A B` copies only these settings from one to the other
_FILTER_SETTINGS = (*Settings.__dataclass_fields__, "axes")


@dataclass(frozen=True)
class InputResults:
    """Results of one of the two inputs of ``px4fuse diff``."""

    file_name: str
    kind: Literal["log", "report", "results"]
    results: Results


@dataclass(frozen=True)
class ComparedNumber:
    """Number that ``px4fuse diff`` compares, with its 95 % interval if it is an estimate."""

    label: str
    unit: str
    value: float
    interval: ConfidenceInterval | None = None


def diff(
    a: str | Path, b: str | Path, *, progress: ProgressCallback = lambda _: None
) -> DiffResults:
    """List the settings, numbers and findings that differ between A and B.

    Parameters
    ----------
    a, b : str or Path
        Flight logs, reports (PDF), or results (JSON) of ``px4fuse compare``. A log is analysed with
        the settings of the other input.
    progress : callable
        Called with the name of each step of the computation.

    Raises
    ------
    LogError, MissingDataError, ResultsError
        A file cannot be read or compared, or A and B are the same file.
    """
    path_a, path_b = Path(a), Path(b)
    given_results_a, given_results_b = map(_read_given_results, (path_a, path_b))
    if path_a.samefile(path_b):
        raise ResultsError(f"{display_name(path_a)}: A and B are the same file. Give two files.")
    return list_changes(
        given_results_a or _analyse_log(path_a, given_results_b, progress),
        given_results_b or _analyse_log(path_b, given_results_a, progress),
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
    path: Path, input_to_copy_settings_from: InputResults | None, progress: ProgressCallback
) -> InputResults:
    """Analyse a log for ``px4fuse diff``, with the settings of another input if one is given."""
    request = ComparisonRequest(log=str(path))
    if input_to_copy_settings_from is not None:
        other_results = input_to_copy_settings_from.results
        other_request = other_results.request
        if other_results.log.sha256 in hash_files([path]):
            # the same log: copy all settings, except those that describe the input files
            request = replace(other_request, log=str(path), system=None, position=None)
        else:
            # another log: its times, position source and heading may differ
            copied_settings = {name: getattr(other_request, name) for name in _FILTER_SETTINGS}
            request = replace(request, **copied_settings)
    analysis = diagnose_or_check_aids(request, progress)
    # to_json rounds all numbers, as in a report
    results_json = to_json(make_comparison_or_aids_results(request, analysis))
    results = read_results(results_json.encode())
    assert isinstance(results, Results)
    return InputResults(display_name(path), "log", results)


# ------------------------------------------------------------------ differences


def list_changes(input_a: InputResults, input_b: InputResults) -> DiffResults:
    """List the settings, numbers and findings that differ between the results of A and B."""
    results_a, results_b = input_a.results, input_b.results
    findings = (
        *_find_unshared_findings(results_b, results_a, "B"),
        *_find_unshared_findings(results_a, results_b, "A"),
    )
    return make_results(
        DiffResults,
        shlex.join(["px4fuse", "diff", input_a.file_name, input_b.file_name]),
        a=_describe_input(input_a),
        b=_describe_input(input_b),
        settings=tuple(_list_setting_changes(results_a, results_b)),
        numbers=tuple(compare_numbers(*map(collect_compared_numbers, (results_a, results_b)))),
        findings=findings,
        worse=tuple(_describe_worse_verdicts(results_a, results_b, findings)),
    )


def _describe_input(diff_input: InputResults) -> DiffInput:
    """Return file name and kind of an input, and name, hash and px4fuse version of its results."""
    log = diff_input.results.log
    return DiffInput(
        given=diff_input.file_name,
        kind=diff_input.kind,
        log=log.name,
        log_sha256=log.sha256,
        px4fuse=diff_input.results.provenance.px4fuse,
    )


def _list_setting_changes(results_a: Results, results_b: Results) -> Iterator[SettingChange]:
    """Yield each setting or PX4 parameter whose values in A and B differ."""
    settings_a, settings_b = (
        {label: find_value(results, path) for label, path in SETTING_PATHS_BY_LABEL.items()}
        | _collect_parameters(results)
        for results in (results_a, results_b)
    )
    for name in {**settings_a, **settings_b}:
        if (setting_a := settings_a.get(name)) != (setting_b := settings_b.get(name)):
            yield SettingChange(name, setting_a, setting_b)


def _collect_parameters(results: Results) -> dict[str, float]:
    """Return the PX4 parameters in the results, rounded to the 6 digits of a float32."""
    # An EKF2 replay also gives the defaults of parameters that the log does not contain
    parameters = (find_value(results, "ekf2_replay.settings") or {}) | dict(results.log.parameters)
    return {name: float(f"{parameters[name]:.6g}") for name in sorted(parameters)}


def collect_compared_numbers(results: Results) -> dict[str, ComparedNumber]:
    """Return the numbers that ``px4fuse diff`` compares, by path (``clock.offset_s``)."""
    axes = {} if isinstance(results, AidsResults) else results.axes
    # EKF2 rejects north and east together, so their rejected fractions are equal: keep only one
    horizontal_axes = [name for name in ("north", "east", AISLE_AXIS) if name in axes]
    omitted_prefixes = [f"axes.{name}.rejected_fraction" for name in horizontal_axes[1:]]
    # omit the aiding source whose positions KF also uses: ``axes`` already contains EKF2's mean NIS
    # and rejected fraction for these positions. EKF2 fuses all positions except those of GNSS as
    # external vision
    if find_value(results, "source.kind") == "gnss":
        omitted_prefixes.append("aids.gnss_pos.")
    elif axes:
        omitted_prefixes += ["aids.ev_pos.", "aids.ev_hgt."]
    numbers_by_path: dict[str, ComparedNumber] = {}
    for definition in COMPARED_NUMBER_DEFINITIONS:
        interval_field = definition["interval"]
        for path, keys in _find_matching_paths(results, definition["path"]):
            record = find_value(results, path.rpartition(".")[0])
            value = find_value(results, path)
            if not isinstance(value, int | float) or path.startswith(tuple(omitted_prefixes)):
                continue
            # estimates that the data do not determine
            if isinstance(record, SourceTimeOffset) and not record.is_determinable:
                continue
            if isinstance(record, HeadingError) and record.drifts:
                continue
            labels = (AIDS[name].label if name in AIDS else name for name in keys)
            numbers_by_path[path] = ComparedNumber(
                ", ".join((definition["label"], *labels)),
                definition["unit"],
                float(value),
                getattr(record, interval_field) if interval_field else None,
            )
    return numbers_by_path


def _find_matching_paths(results: Results, pattern: str) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield the field paths in the results that match a pattern with ``*`` in place of keys.

    Each path is yielded with the keys that replace ``*``: for ``tuning.*.sigma_z_m``, for example
    ("tuning.horizontal.sigma_z_m", ("horizontal",)). A pattern without ``*`` is yielded unchanged,
    even if the results do not contain this path.
    """
    parent, wildcard, pattern_end = pattern.partition(".*")
    if not wildcard:
        yield pattern, ()
        return
    for key in find_value(results, parent) or ():
        for path, keys in _find_matching_paths(results, f"{parent}.{key}{pattern_end}"):
            yield path, (key, *keys)


def compare_numbers(
    numbers_a: Mapping[str, ComparedNumber], numbers_b: Mapping[str, ComparedNumber]
) -> Iterator[NumberChange]:
    """Yield the numbers that differ between A and B, or that only one of them contains.

    Parameters
    ----------
    numbers_a, numbers_b : mapping
        Numbers by their path in the results.
    """
    for path in {**numbers_a, **numbers_b}:
        number_a, number_b = numbers_a.get(path), numbers_b.get(path)
        if (
            number_a
            and number_b
            and math.isclose(
                number_a.value,
                number_b.value,
                rel_tol=MIN_RELATIVE_DIFFERENCE_OF_LISTED_NUMBERS,
                abs_tol=MIN_DIFFERENCE_OF_LISTED_NUMBERS,
            )
        ):
            continue
        described_number = number_a or numbers_b[path]
        yield NumberChange(
            path=path,
            label=described_number.label,
            unit=described_number.unit,
            a=number_a.value if number_a else None,
            b=number_b.value if number_b else None,
            a_interval=number_a.interval if number_a else None,
            b_interval=number_b.interval if number_b else None,
        )


def _find_unshared_findings(
    results: Results, other_results: Results, only_in: DiffInputName
) -> Iterator[UnsharedFinding]:
    """Yield the findings whose id and severity are not in the other results."""
    other_ids_and_severities = {
        (finding.id, finding.severity) for finding in other_results.findings
    }
    for finding in results.findings:
        if (finding.id, finding.severity) not in other_ids_and_severities:
            yield UnsharedFinding(finding.id, finding.severity, finding.message, only_in)


def _describe_worse_verdicts(
    results_a: Results, results_b: Results, findings: Iterable[UnsharedFinding]
) -> Iterator[str]:
    """Yield a sentence for each deterioration from results A to results B.

    A deterioration is a filter that is consistent in A but not in B, or a finding of severity
    "error" that only B contains.
    """
    nis_and_nees_a, nis_and_nees_b = map(_collect_nis_and_nees, (results_a, results_b))
    for label, (mean_a, is_consistent_in_a) in nis_and_nees_a.items():
        if label not in nis_and_nees_b:
            continue
        mean_b, is_consistent_in_b = nis_and_nees_b[label]
        if is_consistent_in_a and not is_consistent_in_b:
            # NIS and NEES are squares of actual ÷ reported σ
            ratio = mean_b**0.5
            factor_text = format_factor(max(ratio, 1.0 / ratio))
            verdict_text = f"overconfident, σ {factor_text} times too small"
            if ratio < 1.0:
                verdict_text = f"underconfident, σ {factor_text} times too large"
            yield (
                f"{label}: {format_number(mean_a)} (consistent) → "
                f"{format_number(mean_b)} ({verdict_text})."
            )
    error_ids = [
        finding.id for finding in findings if (finding.only_in, finding.severity) == ("B", "error")
    ]
    for finding_id in dict.fromkeys(error_ids):
        yield f"New finding of severity error: {finding_id}."


def _collect_nis_and_nees(results: Results) -> dict[str, tuple[float, bool]]:
    """Return each mean NIS and mean NEES by label, with True for a consistent filter."""
    mean_and_consistency_by_label: dict[str, tuple[float, bool]] = {}
    for axis, result in (find_value(results, "axes") or {}).items():
        for name, summary in result.filters.items():
            label = f"{FILTER_NAMES[name]}, {axis.replace(AISLE_AXIS, 'axis of largest motion')}"
            if isinstance(summary, FilterSummary):
                mean_and_consistency_by_label[f"Mean NIS of {label}"] = (
                    summary.nis_mean,
                    not is_inconsistent(summary),
                )
            if (nees := find_value(summary, "truth.nees_position_mean")) is not None:
                mean_and_consistency_by_label[f"Mean NEES of {label}"] = (
                    nees,
                    MAX_SQRT_MEAN_NEES**-2 <= nees <= MAX_SQRT_MEAN_NEES**2,
                )
    return mean_and_consistency_by_label
