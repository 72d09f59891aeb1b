"""Settings, numbers and findings that differ between two comparisons: ``px4fuse diff``."""

import math
import shlex
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from px4fuse.comparison.interventions import is_inconsistent
from px4fuse.comparison.model import FilterSummary
from px4fuse.fleet.inputs import DiffInput, Progress, Results, read_inputs
from px4fuse.fleet.measures import (
    ABSOLUTE_TOLERANCE,
    RELATIVE_TOLERANCE,
    Number,
    numbers,
)
from px4fuse.fleet.rows import at
from px4fuse.plain import format_factor, format_number
from px4fuse.results import contract
from px4fuse.results.model import provenance, schema_of

# Limits of √(mean NEES) of a consistent filter, as a factor; errors of one flight are correlated,
# so that no 95 % band is known
NEES_SIGMA_OFF = 1.5
NAMES = {"kf": "KF", "ekf2": "EKF2"}
# Settings and facts about the flight, and their path in the results
SETTINGS = {
    "SIGMA_A (m/s²)": "settings.sigma_a_m_s2",
    "SIGMA_Z (m)": "settings.sigma_z_m",
    "DT (s)": "settings.dt_s",
    "input": "settings.input",
    "time offset added (s)": "settings.clock_offset_s",
    "start (s)": "settings.start_s",
    "end (s)": "settings.end_s",
    "position source": "source.name",
    "firmware": "log.firmware",
    "firmware hash": "log.firmware_hash",
    "hardware": "log.hardware",
    "px4fuse": "provenance.px4fuse",
}


def diff(
    a: str | Path, b: str | Path, *, progress: Progress = lambda _: None
) -> contract.ChangeResults:
    """List the settings, numbers and findings that differ from A to B.

    Parameters
    ----------
    a, b : str or Path
        Each a flight log, a report of ``px4fuse compare`` or its results as JSON. A log is
        analysed with the settings of the other one's results, if there are any.
    progress : callable
        Receives the name of each step.

    Raises
    ------
    LogError, MissingDataError, ResultsError
        A file cannot be read, is not of ``px4fuse compare``, or both are the same.
    """
    return changes(*read_inputs(Path(a), Path(b), progress))


def changes(a: DiffInput, b: DiffInput) -> contract.ChangeResults:
    """List the differences of two comparisons."""
    findings = tuple(_findings(a.results, b.results))
    return contract.ChangeResults(
        schema=schema_of(contract.CHANGES),
        a=_compared(a),
        b=_compared(b),
        settings=tuple(_settings(a.results, b.results)),
        numbers=tuple(number_changes(numbers(a.results), numbers(b.results))),
        findings=findings,
        worse=tuple(_worse(a.results, b.results, findings)),
        provenance=provenance(shlex.join(["px4fuse", "diff", a.given, b.given])),
    )


def _compared(side: DiffInput) -> contract.Compared:
    log = side.results.log
    return contract.Compared(
        given=side.given,
        kind=side.kind,
        log=log.name,
        log_sha256=log.sha256,
        px4fuse=side.results.provenance.px4fuse,
    )


def _settings(a: Results, b: Results) -> Iterator[contract.SettingChange]:
    """Settings, facts about the flight and parameters of PX4 that differ."""
    one, other = (
        {what: at(side, place) for what, place in SETTINGS.items()} | _parameters(side)
        for side in (a, b)
    )
    for what in {**one, **other}:
        if (first := one.get(what)) != (second := other.get(what)):
            yield contract.SettingChange(what, first, second)


def _parameters(found: Results) -> dict[str, float]:
    """Parameters of PX4 in the log, and those of the EKF2 replay, to six digits (float32)."""
    known = (at(found, "ekf2_replay.settings") or {}) | dict(found.log.parameters)
    return {name: float(f"{known[name]:.6g}") for name in sorted(known)}


def number_changes(
    first: Mapping[str, Number], second: Mapping[str, Number]
) -> Iterator[contract.NumberChange]:
    """Numbers that differ, and those that only one side has.

    Parameters
    ----------
    first, second : mapping
        Numbers of A and B by their path in the results.
    """
    for path in {**first, **second}:
        a, b = first.get(path), second.get(path)
        if (
            a
            and b
            and math.isclose(
                a.value, b.value, rel_tol=RELATIVE_TOLERANCE, abs_tol=ABSOLUTE_TOLERANCE
            )
        ):
            continue
        known = a or b
        assert known is not None
        yield contract.NumberChange(
            path=path,
            label=known.label,
            unit=known.unit,
            a=None if a is None else a.value,
            b=None if b is None else b.value,
            a_interval=None if a is None else a.interval,
            b_interval=None if b is None else b.interval,
        )


def _findings(a: Results, b: Results) -> Iterator[contract.FindingChange]:
    """Findings that only one of the two has, by id and severity."""
    both: tuple[tuple[Results, Results, contract.Which], ...]
    both = ((b, a, "B"), (a, b, "A"))
    for mine, other, only_in in both:
        known = {(one.id, one.severity) for one in other.findings}
        for one in mine.findings:
            if (one.id, one.severity) not in known:
                yield contract.FindingChange(one.id, one.severity, one.message, only_in)


def _worse(a: Results, b: Results, findings: Iterable[contract.FindingChange]) -> Iterator[str]:
    """Verdicts that are worse in B, a sentence each."""
    before, after = _verdicts(a), _verdicts(b)
    for what, (was, was_consistent) in before.items():
        value, consistent = after.get(what, (was, True))
        if was_consistent and not consistent:
            ratio = value**0.5
            off = f"{format_factor(max(ratio, 1.0 / ratio))} times too"
            said = (
                f"overconfident, σ {off} small" if ratio > 1.0 else f"underconfident, σ {off} large"
            )
            yield f"{what}: {format_number(was)} (consistent) → {format_number(value)} ({said})."
    errors = [one.id for one in findings if (one.only_in, one.severity) == ("B", "error")]
    for error in dict.fromkeys(errors):
        yield f"New finding of severity error: {error}."


def _verdicts(found: Results) -> dict[str, tuple[float, bool]]:
    """Mean NIS and mean NEES by filter and axis, and True if consistent."""
    verdicts: dict[str, tuple[float, bool]] = {}
    for axis, result in (at(found, "axes") or {}).items():
        for name, label in NAMES.items():
            one = result.filters[name]
            if isinstance(one, FilterSummary):
                verdicts[f"Mean NIS of {label}, {axis}"] = one.nis_mean, not is_inconsistent(one)
            if (nees := at(one, "truth.nees_position_mean")) is not None:
                consistent = NEES_SIGMA_OFF**-2 <= nees <= NEES_SIGMA_OFF**2
                verdicts[f"Mean NEES of {label}, {axis}"] = nees, consistent
    return verdicts
