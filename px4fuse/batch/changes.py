"""Differences in settings, numbers and findings between two results (``px4fuse diff``)."""

import math
import shlex
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from px4fuse.batch.inputs import InputResults, ProgressCallback, Results, read_diff_inputs
from px4fuse.batch.measures import (
    MAX_OMITTED_DIFFERENCE,
    MAX_OMITTED_RELATIVE_DIFFERENCE,
    ComparedNumber,
    collect_compared_numbers,
)
from px4fuse.batch.rows import find_value
from px4fuse.comparison.model import FILTER_NAMES, FilterSummary
from px4fuse.comparison.reruns import is_inconsistent
from px4fuse.core.text import format_factor, format_number
from px4fuse.filter.settings import SETTING_RANGES, Settings
from px4fuse.results import contract
from px4fuse.results.model import provenance, schema_of

# Maximum √(mean NEES) of a consistent filter; wide, because errors in a flight are correlated
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


def diff(
    a: str | Path, b: str | Path, *, progress: ProgressCallback = lambda _: None
) -> contract.ChangeResults:
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
    return list_changes(*read_diff_inputs(Path(a), Path(b), progress))


def list_changes(input_a: InputResults, input_b: InputResults) -> contract.ChangeResults:
    """List the settings, numbers and findings that differ between the results of A and B."""
    findings = tuple(_list_finding_changes(input_a.results, input_b.results))
    return contract.ChangeResults(
        schema=schema_of(contract.CHANGES_SCHEMA_NAME),
        a=_describe_input(input_a),
        b=_describe_input(input_b),
        settings=tuple(_list_setting_changes(input_a.results, input_b.results)),
        numbers=tuple(
            compare_numbers(
                collect_compared_numbers(input_a.results), collect_compared_numbers(input_b.results)
            )
        ),
        findings=findings,
        worse=tuple(_describe_worse_verdicts(input_a.results, input_b.results, findings)),
        provenance=provenance(
            shlex.join(["px4fuse", "diff", input_a.file_name, input_b.file_name])
        ),
    )


def _describe_input(diff_input: InputResults) -> contract.DiffInput:
    log = diff_input.results.log
    return contract.DiffInput(
        given=diff_input.file_name,
        kind=diff_input.kind,
        log=log.name,
        log_sha256=log.sha256,
        px4fuse=diff_input.results.provenance.px4fuse,
    )


def _list_setting_changes(
    results_a: Results, results_b: Results
) -> Iterator[contract.SettingChange]:
    settings_a, settings_b = (
        {label: find_value(results, path) for label, path in SETTING_PATHS_BY_LABEL.items()}
        | _collect_parameters(results)
        for results in (results_a, results_b)
    )
    for name in {**settings_a, **settings_b}:
        if (setting_a := settings_a.get(name)) != (setting_b := settings_b.get(name)):
            yield contract.SettingChange(name, setting_a, setting_b)


def _collect_parameters(results: Results) -> dict[str, float]:
    """Return the PX4 parameters in the results, rounded to the 6 digits of a float32."""
    # The replay also contains the defaults of parameters that the log does not contain
    parameters = (find_value(results, "ekf2_replay.settings") or {}) | dict(results.log.parameters)
    return {name: float(f"{parameters[name]:.6g}") for name in sorted(parameters)}


def compare_numbers(
    numbers_a: Mapping[str, ComparedNumber], numbers_b: Mapping[str, ComparedNumber]
) -> Iterator[contract.NumberChange]:
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
                rel_tol=MAX_OMITTED_RELATIVE_DIFFERENCE,
                abs_tol=MAX_OMITTED_DIFFERENCE,
            )
        ):
            continue
        described_number = number_a or numbers_b[path]
        yield contract.NumberChange(
            path=path,
            label=described_number.label,
            unit=described_number.unit,
            a=getattr(number_a, "value", None),
            b=getattr(number_b, "value", None),
            a_interval=getattr(number_a, "interval", None),
            b_interval=getattr(number_b, "interval", None),
        )


def _list_finding_changes(
    results_a: Results, results_b: Results
) -> Iterator[contract.UnsharedFinding]:
    """Yield the findings whose id and severity are only in A or only in B."""
    comparisons: tuple[tuple[Results, Results, contract.DiffInputName], ...] = (
        (results_b, results_a, "B"),
        (results_a, results_b, "A"),
    )
    for results, other_results, only_in in comparisons:
        other_ids_and_severities = {
            (finding.id, finding.severity) for finding in other_results.findings
        }
        for finding in results.findings:
            if (finding.id, finding.severity) not in other_ids_and_severities:
                yield contract.UnsharedFinding(
                    finding.id, finding.severity, finding.message, only_in
                )


def _describe_worse_verdicts(
    results_a: Results, results_b: Results, findings: Iterable[contract.UnsharedFinding]
) -> Iterator[str]:
    """Yield a sentence for each filter that is consistent only in A, and for each new error."""
    nis_and_nees_a, nis_and_nees_b = map(_collect_nis_and_nees, (results_a, results_b))
    for label, (mean_a, was_consistent) in nis_and_nees_a.items():
        mean_b, is_consistent = nis_and_nees_b.get(label, (mean_a, True))
        if was_consistent and not is_consistent:
            ratio = mean_b**0.5
            factor_text = format_factor(max(ratio, 1.0 / ratio))
            verdict_text = f"overconfident, σ {factor_text} times too small"
            if ratio < 1.0:
                verdict_text = f"underconfident, σ {factor_text} times too large"
            yield (
                f"{label}: {format_number(mean_a)} (consistent) → {format_number(mean_b)} "
                f"({verdict_text})."
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
        for name, label in FILTER_NAMES.items():
            summary = result.filters[name]
            if isinstance(summary, FilterSummary):
                mean_and_consistency_by_label[f"Mean NIS of {label}, {axis}"] = (
                    summary.nis_mean,
                    not is_inconsistent(summary),
                )
            if (nees := find_value(summary, "truth.nees_position_mean")) is not None:
                mean_and_consistency_by_label[f"Mean NEES of {label}, {axis}"] = (
                    nees,
                    MAX_SQRT_MEAN_NEES**-2 <= nees <= MAX_SQRT_MEAN_NEES**2,
                )
    return mean_and_consistency_by_label
