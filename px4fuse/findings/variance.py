"""S larger or smaller than the innovations show it to be, for our filter and for EKF2 alike."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from msgspec import structs

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import FILTERS, AxisComparison, Comparison
from px4fuse.comparison.remedy import (
    filter_words,
    noise_helps,
    not_replayed,
    remedy_words,
    settings_words,
)
from px4fuse.ekf2_parameters import PARAMETERS
from px4fuse.filter.consistency import Consistency
from px4fuse.filter.fitting import SIGMA_Z_SEARCH_M
from px4fuse.filter.settings import Settings
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning
from px4fuse.findings.causes import CAUSE, ELSEWHERE, NOISE, OUTLIERS
from px4fuse.findings.errors_larger_than_claimed import hidden_errors
from px4fuse.findings.model import Detector, Finding, Found, Severity, Threshold, lowered
from px4fuse.findings.sigma import SMALLEST_SIGMA_Z
from px4fuse.flight import Unavailable
from px4fuse.plain import factor_words, number_words

VARIANCE_FACTOR = Threshold(
    1.5, "times", "22 % in standard deviation; chance moves it less at n > 100"
)
VARIANCE_FACTOR_ERROR = Threshold(4.0, "times", "a factor of two in standard deviation")
EKF2_NOISE_FLOOR = Threshold(0.01, "m", "EKF2 never trusts external vision better, EKF2.cpp")
NOISE_FITS = Threshold(1.25, "times", "the median's own scatter below n = 100 (1.17/√n, two σ)")
LAG1_SLOW = Threshold(0.3, "correlation", "white innovations stay below 2/√n, 0.2 at n = 100")
SMALLEST_NOISE = Threshold(0.001, "m", "below what any positioning system resolves")
OUTLIER_SHARE = Threshold(0.005, "outside 5√S", "6e-7 is expected")

ONLY_HORIZONTAL = Unavailable("EKF2 replay", "the model of EKF2 is of horizontal position", "None.")
LOOK_ELSEWHERE = (
    "Look at the clock (EKF2_EV_DELAY), the outliers and EKF2's process noise (EKF2_ACC_NOISE):"
)
AGAINST_DRIFT = (
    "Nothing follows from innovations alone: against a source that may drift they show how well "
    "the filter follows it, not how wrong both are."
)

AGAINST_TRUTH = (
    "Lower no noise for these innovations: the errors against the truth are larger than claimed."
)

Member = tuple[AxisComparison, Consistency]


def _detect(analysis: Analysis) -> Found:
    for owner in FILTERS:
        named: list[Member] = []
        for result in analysis.axes.values():
            statement = result.filters[owner]
            if isinstance(statement, Unavailable):
                continue
            factor = max(statement.variance_factor, 1.0 / statement.variance_factor)
            if statement.verdict != "consistent" and factor >= VARIANCE_FACTOR.value:
                named.append((result, statement))
        for over in (True, False):
            groups = [
                _variance_finding(analysis, owner, group, members)
                for group, axes in (
                    ("horizontal", ("north", "east", "aisle")),
                    ("vertical", ("down",)),
                )
                if (
                    members := [
                        (r, s)
                        for r, s in named
                        if r.axis.name in axes and (s.variance_factor > 1.0) == over
                    ]
                )
            ]
            if groups:  # one noise for all axes: the vertical axis tells no other cause
                yield structs.replace(groups[0], consequences=tuple(groups[1:]))


def _variance_finding(analysis: Analysis, owner: str, group: str, members: list[Member]) -> Finding:
    """One finding for a group of axes, on the axis whose NIS is furthest from 1."""
    result, statement = max(members, key=lambda pair: abs(np.log(pair[1].nis_mean)))
    over = statement.variance_factor > 1.0
    factor = statement.variance_factor if over else 1.0 / statement.variance_factor
    name = "Our" if owner == "kf" else "EKF2's"
    low, high = statement.nis_band
    comparison = analysis
    severity: Severity = "error" if factor >= VARIANCE_FACTOR_ERROR.value else "warning"
    if _is_default(comparison, owner, result):
        severity = lowered(severity)
    if over and comparison.source.origin.may_drift:
        severity, remedy, cause = "info", AGAINST_DRIFT, ELSEWHERE
    elif over and any(hidden.owner == owner for hidden in hidden_errors(comparison)):
        remedy, cause = AGAINST_TRUTH, ELSEWHERE
    else:
        remedy, cause = _noise_remedy(analysis, owner, result, statement)
    evidence: dict[str, float | str] = {
        "axis": result.axis.name,
        "variance_factor": statement.variance_factor,
        "nis_mean": statement.nis_mean,
        "outside_gate": statement.outside_gate,
        CAUSE: cause,
    }
    asked = _asked(analysis, result)
    if asked is not None:
        evidence["sigma_z_asked_m"] = asked.sigma_z_m
        evidence["sigma_z_asked_is_upper_bound"] = float(asked.upper_bound)
    return Finding(
        f"{owner}_variance_{'overstated' if over else 'understated'}",
        severity,
        f"{name} innovation variance is {'overstated' if over else 'understated'} "
        f"{factor_words(factor)} times along {result.axis.name} (mean NIS "
        f"{number_words(statement.nis_mean)}, consistent is {low:.2f} to {high:.2f}; {group}).",
        remedy,
        evidence,
    )


def _is_default(comparison: Comparison, owner: str, result: AxisComparison) -> bool:
    """Whether the measurement noise in force is the one that comes with the program."""
    if owner == "kf":
        chosen, defaults = comparison.settings, Settings()
        return (chosen.sigma_z_m, chosen.sigma_a_m_s2) == (
            defaults.sigma_z_m,
            defaults.sigma_a_m_s2,
        )
    default = PARAMETERS["EKF2_EVP_NOISE"].default
    used = _ekf2_noise(result)
    untouched = comparison.flight.log.parameters.get("EKF2_EVP_NOISE", default) == default
    # a sender that reports a larger variance has chosen it
    return untouched and not abs(np.log(used / default)) > np.log(NOISE_FITS.value)


@dataclass(frozen=True)
class SourceNoise:
    """The source's noise by tuning, the same in all findings: a value or an upper bound."""

    sigma_z_m: float
    upper_bound: bool


def tuned_for(analysis: Analysis, axis: str) -> AxisTuning | None:
    """What was tuned for an axis: both horizontal ones together, where there are both."""
    names = (axis,) if axis == "down" else (HORIZONTAL, axis)
    found = (analysis.tuning.get(name) for name in names)
    return next((tuned for tuned in found if isinstance(tuned, AxisTuning)), None)


def _asked(analysis: Analysis, result: AxisComparison) -> SourceNoise | None:
    tuned = tuned_for(analysis, result.axis.name)
    if tuned is None:
        return None
    noise = tuned.sigma_z
    if noise.value is not None:
        return SourceNoise(noise.value, upper_bound=False)
    return None if noise.high is None else SourceNoise(noise.high, upper_bound=True)


def _noise_remedy(
    analysis: Analysis, owner: str, result: AxisComparison, statement: Consistency
) -> tuple[str, str]:
    """The measurement noise that the data ask for, as what to type or to set, and the cause.

    It is a property of the source, so our estimate of it serves EKF2 as well.
    """
    comparison = analysis
    asked, settings = _asked(analysis, result), comparison.settings
    lag1 = statement.lag1_autocorrelation
    tuned = tuned_for(analysis, result.axis.name)
    needed = None if tuned is None else tuned.filter_sigma_a.value
    slow = statement.variance_factor < 1.0 and lag1 > LAG1_SLOW.value
    if owner == "kf" and slow and needed and needed > settings.sigma_a_m_s2:
        sigma_a = float(f"{needed:.3g}")
        typed = f"--sigma-a {sigma_a:g}"
        words = filter_words(comparison, replace(settings, sigma_a_m_s2=sigma_a), typed)
        return (
            f"The filter follows too slowly (lag-1 correlation {lag1:+.2f}): raise SIGMA_A first. "
            f"{words}",
            ELSEWHERE,
        )
    if tuned is None:
        return "Which noise the data ask for could not be told: see tuning.", ELSEWHERE
    if asked is None:
        return (
            f"No SIGMA_Z up to {SIGMA_Z_SEARCH_M[1]:g} m explains it: look at the acceleration "
            "input (IMU rate, gaps, vibration) and at the clocks.",
            ELSEWHERE,
        )
    if owner == "kf":
        return _kf_remedy(analysis, asked, statement)
    return _ekf2_remedy(analysis, result, asked, statement)


def _kf_remedy(analysis: Analysis, asked: SourceNoise, statement: Consistency) -> tuple[str, str]:
    comparison = analysis
    settings = comparison.settings
    noise = max(asked.sigma_z_m, SMALLEST_NOISE.value)
    if asked.upper_bound:
        typed = float(f"{max(noise, SMALLEST_SIGMA_Z.value):.2g}")
        words = filter_words(
            comparison, replace(settings, sigma_z_m=typed), f"--sigma-z {typed:g}, and less SIGMA_A"
        )
        return (
            f"The source's noise is at most {noise:.2g} m, below what this rate can show. {words}",
            NOISE,
        )
    if not _noise_helps(noise, settings.sigma_z_m, statement):
        outliers = _outliers(analysis, noise, statement)
        return (outliers, OUTLIERS) if outliers else (
            f"It is not SIGMA_Z (the source's noise is {noise:.2g} m): look at SIGMA_A (--sigma-a) "
            "and the clock (--clock-offset).",
            ELSEWHERE,
        )  # fmt: skip
    typed = float(f"{noise:.2g}")
    words = filter_words(comparison, replace(settings, sigma_z_m=typed), f"--sigma-z {typed:g}")
    return f"The data ask for SIGMA_Z {noise:.2g} m. {words}", NOISE


def _ekf2_remedy(
    analysis: Analysis, result: AxisComparison, asked: SourceNoise, statement: Consistency
) -> tuple[str, str]:
    parameters = analysis.flight.log.parameters
    used, set_noise = _ekf2_noise(result), parameters.get("EKF2_EVP_NOISE", np.nan)
    noise = asked.sigma_z_m
    if asked.upper_bound:  # EKF2's own innovations bound it too, and less tightly
        noise = float(np.hypot(statement.innovation_std_m, statement.innovation_mean_m))
    noise = max(noise, SMALLEST_NOISE.value)
    if not _noise_helps(noise, used, statement):
        outliers = _outliers(analysis, noise, statement)
        return (outliers, OUTLIERS) if outliers else (
            f"It is not EKF2_EVP_NOISE (the source's noise is {noise:.2g} m): look at the clock "
            "(EKF2_EV_DELAY) and at EKF2's process noise (EKF2_ACC_NOISE).",
            ELSEWHERE,
        )  # fmt: skip
    changes = {"EKF2_EVP_NOISE": max(float(f"{noise:.2g}"), EKF2_NOISE_FLOOR.value)}
    reported = used > NOISE_FITS.value * set_noise and parameters.get("EKF2_EV_NOISE_MD") != 1.0
    bound = "at most " if asked.upper_bound else ""
    was = "" if np.isnan(used) else f" (√R was {used:.2g} m)"
    why = f"The source's noise is {bound}{noise:.2g} m{was}: "
    if reported and statement.variance_factor > 1.0:
        changes = {"EKF2_EV_NOISE_MD": 1.0, **changes}
        why = (
            f"R is what the sender reports ({used:.2g} m), since that is more than EKF2_EVP_NOISE: "
            "correct it there, or "
        )
    if result.axis.name == "down":
        return f"{why}set {settings_words(changes)}. {not_replayed(ONLY_HORIZONTAL)}", NOISE
    words = remedy_words(
        analysis.ekf2_model, changes, noise_helps, why=why, otherwise=LOOK_ELSEWHERE
    )
    return words, ELSEWHERE if words.startswith(LOOK_ELSEWHERE) else NOISE


def _noise_helps(noise: float, used: float, statement: Consistency) -> bool:
    """Whether another measurement noise fixes the variance.

    More noise fixes one that is understated, less one that is overstated; if the noise already
    fits, or the other way round, the cause lies elsewhere.
    """
    if 1 / NOISE_FITS.value < noise / used < NOISE_FITS.value:
        return False
    return not (noise < used if statement.variance_factor < 1.0 else noise > used)


def _outliers(analysis: Analysis, noise: float, statement: Consistency) -> str:
    """What to do about gross outliers, empty where there are none."""
    if statement.variance_factor > 1.0 or statement.outside_gate <= OUTLIER_SHARE.value:
        return ""
    tuned = analysis.tuning.get(HORIZONTAL)
    if isinstance(tuned, AxisTuning) and (
        len(tuned.outlier_time_s) <= OUTLIER_SHARE.value * tuned.count
    ):
        return ""  # the source has none: it is the filter that is elsewhere
    return (
        f"{statement.outside_gate:.1%} lie outside the gate while the bulk fits {noise:.2g} m: "
        "remove the outliers (line of sight, anchor survey) instead of raising the noise."
    )


def _ekf2_noise(result: AxisComparison) -> float:
    """Median √R (m) that EKF2 used; NaN where unknown."""
    frame = result.ekf2_innovations
    if isinstance(frame, Unavailable):
        return float("nan")
    return float(np.sqrt(frame["observation_variance_m2"].median()))


DETECTOR = Detector(
    _detect,
    {
        "ekf2_variance_understated": tuple(f"--mistake ekf2-noise={cm}cm" for cm in (4, 3)),
    },
    names={
        "kf_variance_overstated": "a filter variance that is too large",
        "kf_variance_understated": "a filter variance that is too small",
        "ekf2_variance_overstated": "EKF2 that is too cautious about its variance",
        "ekf2_variance_understated": "EKF2 that is too sure: its variance is too small",
    },
)
