"""S larger or smaller than the innovations show it to be, for our filter and for EKF2 alike."""

from __future__ import annotations

from typing import TypeGuard

import numpy as np
from msgspec import structs

from px4fuse.analysis import Analysis
from px4fuse.comparison.interventions import (
    OF_SETTINGS,
    SIGMA_Z,
    Intervention,
    cause_of,
    tried_on,
    tuned_for,
)
from px4fuse.comparison.model import FILTERS, AxisComparison, FilterName
from px4fuse.comparison.remedy import (
    aid_of,
    noise_helps,
    not_replayed,
    remedy_words,
    settings_words,
)
from px4fuse.ekf2_parameters import PARAMETERS
from px4fuse.filter.consistency import SIGMA_OFF, Consistency
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import within
from px4fuse.filter.tuning import AxisTuning, Noise
from px4fuse.findings.causes import CAUSE, ELSEWHERE, NOISE
from px4fuse.findings.hidden_errors import hidden_errors
from px4fuse.findings.model import Finding, Found, Severity, finding, lowered
from px4fuse.findings.sigma import try_out
from px4fuse.findings.since import OPTIONS, cure_words, ekf2_cure_words, kind_of, reason_words
from px4fuse.flight import POSITION_VARIANCE_COLUMNS, Unavailable
from px4fuse.plain import factor_words, number_words

SIGMA_OFF_ERROR = 2.0  # times, in standard deviation
EKF2_NOISE_FLOOR_M = 0.01  # EKF2 never trusts external vision better, EKF2.cpp
NOISE_FITS = 1.25  # times: the median's own scatter below n = 100 (1.17/√n, two σ)
NOT_EXPLAINED = (
    "No change of a noise, the clock, the frame or the outliers explains half of it: look at the "
    "acceleration input (IMU rate, gaps, vibration) and at what else the findings name."
)
UNKNOWN_NOISE = "Which noise the data ask for could not be told: see tuning."

OWNERS = {"kf": "Our", "ekf2": "EKF2's"}
GROUPS = {"horizontal": ("north", "east", "aisle"), "vertical": ("down",)}
ONLY_HORIZONTAL = Unavailable("EKF2 replay", "the model of EKF2 is of horizontal position", "None.")
AGAINST_DRIFT = (
    "Nothing follows from innovations alone: against a source that may drift they show how well "
    "the filter follows it, not how wrong both are."
)
AGAINST_SLOW_ERRORS = (
    "Lower no noise for these innovations: errors of GNSS are slow for the most part, which R has "
    "to cover and innovations do not show."
)
AGAINST_TRUTH = (
    "Lower no noise for these innovations: the filter would claim less than its errors against the "
    "truth."
)

Member = tuple[AxisComparison, Consistency]


def detect(analysis: Analysis) -> Found:
    """One finding for the horizontal axes, which the vertical one follows: they have one noise."""
    for owner in FILTERS:
        for over in (True, False):
            first = None
            for group, axes in GROUPS.items():
                results = [analysis.axes[name] for name in axes if name in analysis.axes]
                pairs = [(result, result.filters[owner]) for result in results]
                members = [(result, each) for result, each in pairs if _is_off(each, over=over)]
                if members:
                    found = _of_group(analysis, owner, group, members)
                    yield structs.replace(found, caused_by=first)
                    first = found.id


def _is_off(statement: Consistency | Unavailable, *, over: bool) -> TypeGuard[Consistency]:
    """Whether a variance is over-, or else understated."""
    if isinstance(statement, Unavailable):
        return False
    right = (statement.sigma_factor > 1.0) == over
    return right and statement.verdict != "consistent" and statement.times_off >= SIGMA_OFF


def _of_group(analysis: Analysis, owner: FilterName, group: str, members: list[Member]) -> Finding:
    """One finding for a group of axes, on the axis whose NIS is furthest from 1."""
    result, statement = max(members, key=lambda pair: abs(np.log(pair[1].nis_mean)))
    over, factor = statement.sigma_factor > 1.0, statement.times_off
    low, high = statement.nis_band
    severity: Severity = "error" if factor >= SIGMA_OFF_ERROR else "warning"
    if _is_default(analysis, owner, result):
        severity = lowered(severity)
    tuned = tuned_for(analysis.tuning, result.axis.name)
    stated = "overstated" if over else "understated"
    if over and analysis.source.origin.may_drift:
        severity, remedy, cause = "info", AGAINST_DRIFT, ELSEWHERE
    elif over and analysis.source.origin.is_gnss:
        remedy = _above_stated(analysis) if owner == "ekf2" else ""
        cause = NOISE if remedy else ELSEWHERE
        severity, remedy = severity if remedy else "info", remedy or AGAINST_SLOW_ERRORS
    elif over and any(hidden.owner == owner for hidden in hidden_errors(analysis)):
        remedy, cause = AGAINST_TRUTH, ELSEWHERE
    else:
        found = cause_of(analysis.causes, owner, result.axis.name)
        cause, remedy = kind_of(analysis, found), _remedy(analysis, owner, result, tuned, found)
        severity = "info" if remedy == AGAINST_TRUTH else severity
    evidence: dict[str, float | str] = {
        "axis": result.axis.name,
        "sigma_factor": statement.sigma_factor,
        "nis_mean": statement.nis_mean,
        "outside_gate": statement.outside_gate,
        CAUSE: cause,
    }
    if tuned is not None and (asked := _asked_m(tuned.sigma_z)) is not None:
        evidence["sigma_z_asked_m"] = asked
        evidence["sigma_z_asked_is_upper_bound"] = float(tuned.sigma_z.value is None)
    return finding(
        severity,
        f"{owner}_variance_{stated}",
        f"{OWNERS[owner]} innovation variance is {stated} "
        f"{factor_words(factor)} times in σ along {result.axis.name}",
        f" (mean NIS {number_words(statement.nis_mean)}, consistent is {low:.2f} to {high:.2f}; "
        f"{group}).",
        remedy,
        evidence,
    )


def _above_stated(analysis: Analysis) -> str:
    """What to set where EKF2's parameter holds R above the accuracy that a receiver states."""
    name = aid_of(analysis).noise
    least_m = analysis.flight.log.parameters.get(name, float("nan"))
    stated = within(analysis.source.samples, analysis.segment)[POSITION_VARIANCE_COLUMNS[0]]
    stated_m = float(np.sqrt(stated.median()))
    if not least_m > NOISE_FITS * stated_m:  # false for NaN too
        return ""
    held = f"{name} {least_m:g} m holds R above what the receiver states ({stated_m:.2g} m)"
    words, _ = remedy_words(
        analysis.ekf2_model, {name: float(f"{stated_m:.2g}")}, noise_helps,
        why=f"{held}: where you trust the receiver, ", otherwise=f"{held}.",
    )  # fmt: skip
    return words


def _is_default(analysis: Analysis, owner: FilterName, result: AxisComparison) -> bool:
    """Whether the measurement noise in force is the one that comes with the program."""
    if owner == "kf":
        chosen, own = analysis.settings, Settings()
        return (chosen.sigma_z_m, chosen.sigma_a_m_s2) == (own.sigma_z_m, own.sigma_a_m_s2)
    name = aid_of(analysis).noise
    default = PARAMETERS[name].default
    untouched = analysis.flight.log.parameters.get(name, default) == default
    # a sender that reports a larger variance has chosen it
    return untouched and not abs(np.log(_ekf2_noise_m(result) / default)) > np.log(NOISE_FITS)


def _asked_m(noise: Noise) -> float | None:
    """The source's noise by tuning, the same in all findings: a value, else an upper bound."""
    return noise.high if noise.value is None else noise.value


def _remedy(
    analysis: Analysis, owner: FilterName, result: AxisComparison, tuned: AxisTuning | None,
    cause: Intervention | None,
) -> str:  # fmt: skip
    """What to type or to set against the cause; where there is none, what it is not."""
    if cause is None:
        return _without_cause(analysis, owner, result, tuned)
    if owner == "ekf2":
        return ekf2_cure_words(analysis, cause)
    if not cause.change.keys() <= OF_SETTINGS:
        return cure_words(analysis, cause)
    bounded = tuned is not None and tuned.sigma_z.value is None and SIGMA_Z in cause.change
    values = {OPTIONS[name]: value for name, value in cause.change.items()}
    if not bounded:
        return try_out(analysis, values)
    return (
        "The source's noise is below what this rate can show. "
        f"{try_out(analysis, values, ', and less SIGMA_A')}"
    )


def _without_cause(
    analysis: Analysis, owner: FilterName, result: AxisComparison, tuned: AxisTuning | None
) -> str:
    """What was tried and how near it came, or that nothing could be."""
    tried = tried_on(analysis.causes, owner, result.axis.name)
    if any(each.denied_by_truth for each in tried):
        return AGAINST_TRUTH
    if tried:
        nearest = min(tried, key=lambda each: abs(each.explains - 1.0))
        return f"{NOT_EXPLAINED} The nearest: {reason_words(analysis, nearest)}."
    if owner == "ekf2":
        return _not_replayed(analysis, result, tuned)
    return UNKNOWN_NOISE if tuned is None else NOT_EXPLAINED


def _not_replayed(analysis: Analysis, result: AxisComparison, tuned: AxisTuning | None) -> str:
    """What the data ask of EKF2's noise where no replay can confirm it."""
    aid, model = aid_of(analysis), analysis.ekf2_model
    why: Unavailable | None = model if isinstance(model, Unavailable) else None
    if result.axis.name == "down":
        why = ONLY_HORIZONTAL
    elif not isinstance(model, Unavailable) and not model.agreement.good:
        why = model.agreement.doubted("EKF2 replay")
    asked_m = None if tuned is None else _asked_m(tuned.sigma_z)
    if asked_m is None or why is None:
        return UNKNOWN_NOISE if tuned is None else NOT_EXPLAINED
    noise_m, used_m = max(asked_m, EKF2_NOISE_FLOOR_M), _ekf2_noise_m(result)
    said = f"The source's noise is {noise_m:.2g} m, EKF2 takes it to be {used_m:.2g} m"
    statement = result.filters["ekf2"]
    assert not isinstance(statement, Unavailable)
    ratio = noise_m / used_m
    if not (ratio < 1.0 / NOISE_FITS if statement.sigma_factor > 1.0 else ratio > NOISE_FITS):
        return (
            f"{said}: that is not it. Look at the clock ({aid.delay}) and at EKF2's process noise "
            f"(EKF2_ACC_NOISE). {not_replayed(why)}"
        )
    changes = {aid.noise: float(f"{noise_m:.2g}")}
    set_m = analysis.flight.log.parameters.get(aid.noise, np.inf)
    if aid.noise_mode and used_m > NOISE_FITS * set_m:
        changes[aid.noise_mode] = 1.0
    return f"{said}: set {settings_words(changes)}. {not_replayed(why)}"


def _ekf2_noise_m(result: AxisComparison) -> float:
    """Median √R that EKF2 used; NaN where unknown."""
    frame = result.ekf2_innovations
    if isinstance(frame, Unavailable):
        return float("nan")
    return float(np.sqrt(frame["observation_variance_m2"].median()))
