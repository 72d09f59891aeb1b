"""What the innovations say about the noise settings, of our filter and of EKF2 alike."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from px4fuse.analysis import Analysis
from px4fuse.comparison.comparison import AxisComparison, Comparison
from px4fuse.filter.consistency import Consistency
from px4fuse.filter.kalman import Settings
from px4fuse.filter.likelihood import NoiseAsked, sigma_a_asked
from px4fuse.findings.model import Finding
from px4fuse.findings.thresholds import (
    EKF2_NOISE_FLOOR,
    LAG1_SLOW,
    NOISE_ABSURD,
    NOISE_FITS,
    OUTLIER_SHARE,
    RESPONSE_TIME,
    SMALLEST_NOISE,
    VARIANCE_FACTOR,
    VARIANCE_FACTOR_ERROR,
)
from px4fuse.flight import Unavailable, sample_rate


def variance_wrong(analysis: Analysis) -> Iterator[Finding]:
    """S larger or smaller than the innovations deserve, for our filter and for EKF2 alike."""
    comparison = analysis.comparison
    for owner in ("kf", "ekf2"):
        named: list[tuple[AxisComparison, Consistency]] = []
        for result in comparison.axes:
            summary = result.kf if owner == "kf" else result.ekf2
            if isinstance(summary, Unavailable) or isinstance(summary.consistency, Unavailable):
                continue
            statement = summary.consistency
            factor = max(statement.variance_factor, 1.0 / statement.variance_factor)
            if statement.verdict != "consistent" and factor >= VARIANCE_FACTOR.value:
                named.append((result, statement))
        for group, axes in (("horizontal", ("north", "east", "aisle")), ("vertical", ("down",))):
            members = [(r, s) for r, s in named if r.axis.name in axes]
            if members:
                yield _variance_finding(comparison, owner, group, members)


def _variance_finding(
    comparison: Comparison,
    owner: str,
    group: str,
    members: list[tuple[AxisComparison, Consistency]],
) -> Finding:
    """One finding for a group of axes, on the axis whose NIS is furthest from 1."""
    result, statement = max(members, key=lambda pair: abs(np.log(pair[1].nis_mean)))
    over = statement.variance_factor > 1.0
    factor = statement.variance_factor if over else 1.0 / statement.variance_factor
    name = "Our" if owner == "kf" else "EKF2's"
    low, high = statement.nis_band
    evidence: dict[str, float | str] = {
        "axis": result.axis.name,
        "variance_factor": statement.variance_factor,
        "nis_mean": statement.nis_mean,
        "outside_gate": statement.outside_gate,
    }
    if result.noise_asked is not None:
        evidence["sigma_z_asked_m"] = result.noise_asked.sigma_z_m
        evidence["sigma_z_asked_is_upper_bound"] = float(result.noise_asked.upper_bound)
    return Finding(
        f"{owner}_variance_{'overstated' if over else 'understated'}",
        "error" if factor >= VARIANCE_FACTOR_ERROR.value else "warning",
        f"{name} innovation variance is {'overstated' if over else 'understated'} "
        f"{factor:.3g} times along {result.axis.name} (mean NIS {statement.nis_mean:.3g}, "
        f"consistent is {low:.2f} to {high:.2f}; {group}).",
        _noise_remedy(comparison, owner, result, statement),
        evidence,
    )


def _noise_remedy(
    comparison: Comparison, owner: str, result: AxisComparison, statement: Consistency
) -> str:
    """The measurement noise that the data ask for, as what to type or to set.

    It is a property of the source, so our estimate of it serves EKF2 as well.
    """
    asked, settings = result.noise_asked, comparison.settings
    lag1 = statement.lag1_autocorrelation
    noise_absurd = asked is None or asked.sigma_z_m > NOISE_ABSURD.value * settings.sigma_z_m
    if owner == "kf" and noise_absurd and lag1 > LAG1_SLOW.value:
        return (
            f"The filter follows too slowly (lag-1 correlation {lag1:+.2f}): raise SIGMA_A first, "
            f"--sigma-a {sigma_a_asked(result.axis, settings):.2g} fits these data best."
        )
    if asked is None:
        return (
            "No SIGMA_Z up to 30 m explains it: look at the acceleration input "
            "(IMU rate, gaps, vibration) and at the clocks."
        )
    if owner == "kf":
        return _kf_remedy(settings, asked, statement)
    parameters = comparison.flight.log.parameters
    used, set_noise = _ekf2_noise(result), parameters.get("EKF2_EVP_NOISE", np.nan)
    reported = used > NOISE_FITS.value * set_noise and parameters.get("EKF2_EV_NOISE_MD") != 1.0
    if reported and statement.variance_factor > 1.0:
        return (
            f"R is what the sender reports ({used:.2g} m), since that is more than EKF2_EVP_NOISE: "
            f"correct it there, or set EKF2_EV_NOISE_MD to 1 and EKF2_EVP_NOISE to "
            f"{max(asked.sigma_z_m, EKF2_NOISE_FLOOR.value):.2g}."
        )
    return _ekf2_remedy(used, asked, statement)


def _kf_remedy(settings: Settings, asked: NoiseAsked, statement: Consistency) -> str:
    noise = max(asked.sigma_z_m, SMALLEST_NOISE.value)
    if asked.upper_bound:
        return (
            f"The source's noise is at most {noise:.2g} m, below what this rate can show: lower "
            f"SIGMA_Z (--sigma-z {max(noise, 0.005):.2g}) and SIGMA_A."
        )
    if not _noise_helps(noise, settings.sigma_z_m, statement):
        return _outliers(noise, statement) or (
            f"It is not SIGMA_Z (the source's noise is {noise:.2g} m): look at SIGMA_A (--sigma-a) "
            "and the clock (--clock-offset)."
        )
    return f"The data ask for SIGMA_Z {noise:.2g} m at this SIGMA_A: --sigma-z {noise:.2g}."


def _ekf2_remedy(used: float, asked: NoiseAsked, statement: Consistency) -> str:
    noise = asked.sigma_z_m
    if asked.upper_bound:  # EKF2's own innovations bound it too, and less tightly
        noise = float(np.hypot(statement.innovation_std_m, statement.innovation_mean_m))
    noise = max(noise, SMALLEST_NOISE.value)
    if not _noise_helps(noise, used, statement):
        return _outliers(noise, statement) or (
            f"It is not EKF2_EVP_NOISE (the source's noise is {noise:.2g} m): look at the clock "
            "(EKF2_EV_DELAY) and at EKF2's process noise (EKF2_ACC_NOISE)."
        )
    bound = "at most " if asked.upper_bound else ""
    was = "" if np.isnan(used) else f" (√R was {used:.2g} m)"
    return (
        f"The source's noise is {bound}{noise:.2g} m: set EKF2_EVP_NOISE to "
        f"{max(noise, EKF2_NOISE_FLOOR.value):.2g}{was}."
    )


def _noise_helps(noise: float, used: float, statement: Consistency) -> bool:
    """Whether another measurement noise mends the variance.

    More noise mends one that is understated, less one that is overstated; if the noise already
    fits, or the other way round, the cause lies elsewhere.
    """
    if 1 / NOISE_FITS.value < noise / used < NOISE_FITS.value:
        return False
    return not (noise < used if statement.variance_factor < 1.0 else noise > used)


def _outliers(noise: float, statement: Consistency) -> str:
    """What to do about gross outliers, empty where there are none."""
    if statement.variance_factor > 1.0 or statement.outside_gate <= OUTLIER_SHARE.value:
        return ""
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


def process_noise_forgotten(analysis: Analysis) -> Iterator[Finding]:
    """SIGMA_A so small that σ hardly grows between updates and new measurements are ignored.

    A slow filter is no mistake where nothing happens: its innovations must say that it lags.
    """
    comparison = analysis.comparison
    for result in comparison.axes:
        updates, statement = result.replay.updates, result.kf.consistency
        if isinstance(statement, Unavailable) or statement.verdict != "variance understated":
            continue
        if statement.lag1_autocorrelation < LAG1_SLOW.value:
            continue
        gain = float(updates["gain_position"].iloc[len(updates) // 2 :].median())
        response_s = 1.0 / (sample_rate(updates) * gain)
        if response_s < RESPONSE_TIME.value:
            continue
        after = result.replay.steps["position_variance_m2"].reindex(updates.index).to_numpy()
        before = updates["prior_position_variance_m2"].to_numpy()
        growth = float(np.median((before[1:] / after[:-1] - 1.0)[len(after) // 2 :]))
        asked = sigma_a_asked(result.axis, comparison.settings)
        yield Finding(
            "process_noise_forgotten",
            "error",
            f"Q forgotten: with SIGMA_A {comparison.settings.sigma_a_m_s2:g} m/s² σ_p hardly grows "
            f"between updates ({growth:.1%} in variance), the gain is {gain:.3f}, and the filter "
            f"needs {response_s:.0f} s to follow (along {result.axis.name}).",
            f"Raise SIGMA_A: --sigma-a {asked:.2g} fits these data best.",
            {
                "relative_growth": growth,
                "gain": gain,
                "response_s": response_s,
                "sigma_a_asked_m_s2": asked,
                "axis": result.axis.name,
            },
        )
        return


def too_few_innovations(analysis: Analysis) -> Iterator[Finding]:
    """Our own statistics could not be stated."""
    comparison = analysis.comparison
    for result in comparison.axes:
        if isinstance(result.kf.consistency, Unavailable):
            yield Finding(
                "too_few_innovations",
                "warning",
                f"No statement on consistency: {result.kf.consistency.reason}.",
                result.kf.consistency.remedy,
                {"count": float(len(result.replay.updates))},
            )
            return
