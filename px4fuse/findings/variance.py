"""S larger or smaller than the innovations show it to be, for our filter and for EKF2 alike."""

from __future__ import annotations

from typing import TypeGuard

import numpy as np
from msgspec import structs

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import FILTERS, AxisComparison, FilterName
from px4fuse.comparison.remedy import (
    aid_of,
    noise_helps,
    not_replayed,
    remedy_words,
    settings_words,
)
from px4fuse.ekf2_parameters import GNSS_POS, PARAMETERS
from px4fuse.filter.consistency import Consistency
from px4fuse.filter.fitting import SIGMA_Z_SEARCH_M
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import within
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning, Noise
from px4fuse.findings.causes import CAUSE, ELSEWHERE, NOISE, OUTLIERS
from px4fuse.findings.hidden_errors import hidden_errors
from px4fuse.findings.model import Finding, Found, Severity, finding, lowered
from px4fuse.findings.sigma import LAG1_SLOW, SMALLEST_SIGMA_Z_M, try_out, tuned_for
from px4fuse.flight import POSITION_VARIANCE_COLUMNS, Unavailable
from px4fuse.plain import factor_words, number_words

VARIANCE_FACTOR = 1.5  # times: 22 % in standard deviation; chance moves it less at n > 100
VARIANCE_FACTOR_ERROR = 4.0  # times: a factor of two in standard deviation
EKF2_NOISE_FLOOR_M = 0.01  # EKF2 never trusts external vision better, EKF2.cpp
NOISE_FITS = 1.25  # times: the median's own scatter below n = 100 (1.17/√n, two σ)
SMALLEST_NOISE_M = 0.001  # below what any positioning system resolves
OUTLIER_SHARE = 0.005  # outside 5√S, where 6e-7 is expected

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
    "Lower no noise for these innovations: the errors against the truth are larger than claimed."
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
    factor = statement.variance_factor if over else 1.0 / statement.variance_factor
    return statement.verdict != "consistent" and factor >= VARIANCE_FACTOR


def _of_group(analysis: Analysis, owner: FilterName, group: str, members: list[Member]) -> Finding:
    """One finding for a group of axes, on the axis whose NIS is furthest from 1."""
    result, statement = max(members, key=lambda pair: abs(np.log(pair[1].nis_mean)))
    over = statement.variance_factor > 1.0
    factor = statement.variance_factor if over else 1.0 / statement.variance_factor
    low, high = statement.nis_band
    severity: Severity = "error" if factor >= VARIANCE_FACTOR_ERROR else "warning"
    if _is_default(analysis, owner, result):
        severity = lowered(severity)
    tuned, stated = tuned_for(analysis, result.axis.name), "overstated" if over else "understated"
    if over and analysis.source.origin.may_drift:
        severity, remedy, cause = "info", AGAINST_DRIFT, ELSEWHERE
    elif over and analysis.source.origin.is_gnss:
        remedy = _above_stated(analysis) if owner == "ekf2" else ""
        cause = NOISE if remedy else ELSEWHERE
        severity, remedy = severity if remedy else "info", remedy or AGAINST_SLOW_ERRORS
    elif over and any(hidden.owner == owner for hidden in hidden_errors(analysis)):
        remedy, cause = AGAINST_TRUTH, ELSEWHERE
    elif tuned is None:
        remedy, cause = "Which noise the data ask for could not be told: see tuning.", ELSEWHERE
    else:
        cause, remedy = _remedy(analysis, owner, result, statement, tuned)
    evidence: dict[str, float | str] = {
        "axis": result.axis.name,
        "variance_factor": statement.variance_factor,
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
        f"{factor_words(factor)} times along {result.axis.name}",
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
    analysis: Analysis, owner: FilterName, result: AxisComparison, statement: Consistency,
    tuned: AxisTuning,
) -> tuple[str, str]:  # fmt: skip
    """The cause, and the measurement noise that the data ask for, as what to type or to set.

    It is a property of the source, so our estimate of it serves EKF2 as well.
    """
    settings, over = analysis.settings, statement.variance_factor > 1.0
    lag1, needed = statement.lag1_autocorrelation, tuned.filter_sigma_a.value or 0.0
    asked_m, bounded = _asked_m(tuned.sigma_z), tuned.sigma_z.value is None
    if owner == "kf" and not over and lag1 > LAG1_SLOW and needed > settings.sigma_a_m_s2:
        return ELSEWHERE, (
            f"The filter follows too slowly (lag-1 correlation {lag1:+.2f}): raise SIGMA_A first. "
            f"{try_out(analysis, {'--sigma-a': needed})}"
        )
    if asked_m is None:
        return ELSEWHERE, (
            f"No SIGMA_Z up to {SIGMA_Z_SEARCH_M[1]:g} m explains it: look at the acceleration "
            "input (IMU rate, gaps, vibration) and at the clocks."
        )
    used_m = settings.sigma_z_m if owner == "kf" else _ekf2_noise_m(result)
    if owner == "ekf2" and bounded:  # EKF2's own innovations bound it too, and less tightly
        asked_m = float(np.hypot(statement.innovation_std_m, statement.innovation_mean_m))
    noise_m = max(asked_m, SMALLEST_NOISE_M)
    if not (owner == "kf" and bounded) and not _noise_helps(noise_m, used_m, over=over):
        return _other_cause(analysis, owner, statement, noise_m)
    if owner == "ekf2":
        return _ekf2_remedy(analysis, result, noise_m, bounded=bounded, over=over)
    why, more = f"The data ask for SIGMA_Z {noise_m:.2g} m.", ""
    if bounded:
        why = f"The source's noise is at most {noise_m:.2g} m, below what this rate can show."
        noise_m, more = max(noise_m, SMALLEST_SIGMA_Z_M), ", and less SIGMA_A"
    return NOISE, f"{why} {try_out(analysis, {'--sigma-z': float(f'{noise_m:.2g}')}, more)}"


def _other_cause(
    analysis: Analysis, owner: FilterName, statement: Consistency, noise_m: float
) -> tuple[str, str]:
    """Where to look when the noise is as large as the filter takes it to be."""
    if statement.variance_factor < 1.0 and _has_outliers(analysis, statement):
        return OUTLIERS, (
            f"{statement.outside_gate:.1%} lie outside the gate while the bulk fits "
            f"{noise_m:.2g} m: remove the outliers instead of raising the noise."
        )
    name, where = "SIGMA_Z", "SIGMA_A (--sigma-a) and the clock (--clock-offset)"
    if owner == "ekf2":
        aid = aid_of(analysis)
        name = aid.noise
        where = f"the clock ({aid.delay}) and at EKF2's process noise (EKF2_ACC_NOISE)"
    return ELSEWHERE, f"It is not {name} (the source's noise is {noise_m:.2g} m): look at {where}."


def _ekf2_remedy(
    analysis: Analysis, result: AxisComparison, noise_m: float, *, bounded: bool, over: bool
) -> tuple[str, str]:
    parameters, used_m = analysis.flight.log.parameters, _ekf2_noise_m(result)
    aid = aid_of(analysis)
    changes = {aid.noise: max(float(f"{noise_m:.2g}"), EKF2_NOISE_FLOOR_M)}
    was = "" if np.isnan(used_m) else f" (√R was {used_m:.2g} m)"
    why = f"The source's noise is {'at most ' if bounded else ''}{noise_m:.2g} m{was}: "
    reported = used_m > NOISE_FITS * parameters.get(aid.noise, np.nan)
    if over and reported and aid.noise_mode and parameters.get(aid.noise_mode) != 1.0:
        changes = {aid.noise_mode: 1.0, **changes}
        why = (
            f"R is what the sender reports ({used_m:.2g} m), since that is more than "
            f"{aid.noise}: correct it there, or "
        )
    if aid == GNSS_POS:
        why = (
            f"From one fix to the next the source scatters by {noise_m:.2g} m{was}, and slow "
            "errors come on top: as a first step "
        )
    if result.axis.name == "down":
        return NOISE, f"{why}set {settings_words(changes)}. {not_replayed(ONLY_HORIZONTAL)}"
    words, helps = remedy_words(
        analysis.ekf2_model, changes, noise_helps, why=why,
        otherwise=f"Look at the clock ({aid.delay}), the outliers and EKF2's process noise "
        "(EKF2_ACC_NOISE):",
    )  # fmt: skip
    return NOISE if helps else ELSEWHERE, words


def _noise_helps(noise_m: float, used_m: float, *, over: bool) -> bool:
    """Whether another measurement noise fixes a variance that is over- or understated.

    More noise fixes one that is understated, less one that is overstated; if the noise already
    fits, or the other way round, the cause lies elsewhere.
    """
    ratio = noise_m / used_m
    return not (ratio > 1.0 / NOISE_FITS if over else ratio < NOISE_FITS)


def _has_outliers(analysis: Analysis, statement: Consistency) -> bool:
    """Whether gross outliers explain the innovations, which the source has as well."""
    tuned = analysis.tuning.get(HORIZONTAL)
    if statement.outside_gate <= OUTLIER_SHARE:
        return False
    # where the source has none, it is the filter that is elsewhere
    return not isinstance(tuned, AxisTuning) or (
        len(tuned.outlier_time_s) > OUTLIER_SHARE * tuned.count
    )


def _ekf2_noise_m(result: AxisComparison) -> float:
    """Median √R that EKF2 used; NaN where unknown."""
    frame = result.ekf2_innovations
    if isinstance(frame, Unavailable):
        return float("nan")
    return float(np.sqrt(frame["observation_variance_m2"].median()))
