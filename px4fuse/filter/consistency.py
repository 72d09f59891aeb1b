"""NIS, bias, whiteness and verdict of innovations, with the same functions for KF and EKF2.

Definitions: Bar-Shalom, Li and Kirubarajan (2001), Estimation with Applications to Tracking and
Navigation, section 5.4; Ljung and Box (1978), Biometrika 65(2).
"""

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from scipy.special import chdtrc, gammaincinv, stdtr

from px4fuse.arrays import Array
from px4fuse.record import Correlation, Count, NotNegative, Positive, Record, Share, Unavailable
from px4fuse.text import count_noun

# "underconfident": the reported σ is too large; "overconfident": the reported σ is too small
Verdict = Literal["consistent", "underconfident", "overconfident"]

# With fewer innovations the 95 % band of the mean NIS is wider than 0.3 to 2.1
MIN_INNOVATIONS = 10
CONFIDENCE_LEVEL = 0.95
LJUNG_BOX_LAGS = 10
# Ratios of actual to reported σ that are consistent. Against the source R is a rule of thumb, and
# tracks hardly change. Against ground truth the ratio of EKF2 is 0.84 to 1.22 on clean simulated
# flights: its output predictor lags, and σ does not describe that.
Reference = Literal["source", "truth"]
CONSISTENT_RATIOS: Mapping[Reference, tuple[float, float]] = {
    "source": (0.8, 1.25),
    "truth": (0.67, 1.5),
}
DEFAULT_GATE = 5.0  # √S; default of EKF2_EVP_GATE, for KF and for logs without a gate


class NisVerdict(Record, frozen=True, kw_only=True):
    """Mean NIS with its 95 % band, and the verdict on the reported σ.

    Attributes
    ----------
    count : int
        Number of innovations.
    nis_mean : float
        Mean of ν²/S per degree of freedom; expected 1.
    nis_band : (float, float)
        Two-sided 95 % chi-square band of the mean NIS, for white innovations.
    sigma_ratio : float
        Ratio of actual to reported σ, √nis_mean: above 1, the filter is overconfident.
    verdict : str
    """

    count: Count
    nis_mean: Positive
    nis_band: tuple[NotNegative, NotNegative]
    sigma_ratio: Positive
    verdict: Verdict

    @property
    def sigma_error_factor(self) -> float:
        """Larger of reported and actual σ over the smaller; ``verdict`` gives the direction."""
        return float(max(self.nis_mean, 1.0 / self.nis_mean) ** 0.5)


class Consistency(NisVerdict, frozen=True, kw_only=True):
    """Statistics of a filter's innovations, compared with the innovation variances S.

    Attributes
    ----------
    innovation_mean_m, innovation_std_m : float
    sqrt_s_median_m : float
        Median of √S, the standard deviation that the filter expects.
    fraction_outside_two_sigma : float
        Fraction outside ±2√S; expected 0.046.
    fraction_outside_gate : float
        Fraction outside the gate.
    bias_t, bias_p : float
        Student's t of the mean against zero, and its two-sided p-value.
    lag1_autocorrelation : float
        Lag-1 autocorrelation of ν/√S; positive if the filter lags behind the positions.
    ljung_box_p : float
        p-value of the Ljung-Box whiteness test over ``ljung_box_lags`` lags.
    ljung_box_lags : int
    """

    innovation_mean_m: float
    innovation_std_m: NotNegative
    sqrt_s_median_m: Positive
    fraction_outside_two_sigma: Share
    fraction_outside_gate: Share
    bias_t: float
    bias_p: Share
    lag1_autocorrelation: Correlation
    ljung_box_p: Share
    ljung_box_lags: Count


class HorizontalNis(NisVerdict, frozen=True, kw_only=True):
    """NIS of north and east together: sum of both NIS (two degrees of freedom), divided by two.

    The covariance between north and east is omitted for both filters: EKF2 does not log it.
    """


def nis_band(count: int, dimensions: int = 1) -> tuple[float, float]:
    """Return the two-sided 95 % band of the mean of ``count`` NIS values, per dimension.

    The expected mean is 1 for any number of ``dimensions``.

    >>> low, high = nis_band(128, 2)
    >>> round(2 * low, 2), round(2 * high, 2)
    (1.67, 2.36)
    """
    degrees_of_freedom = count * dimensions
    low = (
        2.0
        * float(gammaincinv(degrees_of_freedom / 2.0, (1 - CONFIDENCE_LEVEL) / 2))
        / degrees_of_freedom
    )
    high = (
        2.0
        * float(gammaincinv(degrees_of_freedom / 2.0, (1 + CONFIDENCE_LEVEL) / 2))
        / degrees_of_freedom
    )
    return low, high


def classify_ratio(
    ratio: float, against: Reference, interval: tuple[float, float] | None = None
) -> Verdict:
    """Return the verdict on a ratio of actual to reported σ.

    Consistent inside :data:`CONSISTENT_RATIOS`, or if the 95 % interval contains 1.
    """
    low, high = CONSISTENT_RATIOS[against]
    if low <= ratio <= high or (interval is not None and interval[0] <= 1.0 <= interval[1]):
        return "consistent"
    return "overconfident" if ratio > 1.0 else "underconfident"


def ratio_interval(nis_mean: float, band: tuple[float, float]) -> tuple[float, float]:
    """Return the 95 % interval of √(mean NIS) from the 95 % band of a consistent filter."""
    return (nis_mean / band[1]) ** 0.5, (nis_mean / band[0]) ** 0.5


def classify_mean_nis(nis_mean: float, band: tuple[float, float]) -> Verdict:
    """Return the verdict on a mean NIS with its 95 % band."""
    return classify_ratio(nis_mean**0.5, "source", ratio_interval(nis_mean, band))


def _verdict_fields(nis: Array, dimensions: int = 1) -> dict[str, Any]:
    mean, band = float(np.mean(nis)) / dimensions, nis_band(len(nis), dimensions)
    return {
        "count": len(nis),
        "nis_mean": mean,
        "nis_band": band,
        "sigma_ratio": float(np.sqrt(mean)),
        "verdict": classify_mean_nis(mean, band),
    }


def autocorrelation(values: Array, lags: int) -> Array:
    """Return the autocorrelation of a series at lags 1 to ``lags``: Σ ν(k) ν(k+l) / Σ ν(k)².

    The mean is not subtracted: it has a separate test (``bias_p``).
    """
    square_sum = float(np.dot(values, values))
    return np.array(
        [np.dot(values[:-lag], values[lag:]) / square_sum for lag in range(1, lags + 1)]
    )


def assess(
    innovation_m: Array, innovation_variance_m2: Array, gate: float = DEFAULT_GATE
) -> Consistency | Unavailable:
    """Test innovations against the innovation variances S that the filter reports.

    Parameters
    ----------
    innovation_m : ndarray, shape (n,)
        Measurement minus predicted measurement, in time order.
    innovation_variance_m2 : ndarray, shape (n,)
        S, positive.
    gate : float
        Gate in √S.

    Returns
    -------
    Consistency, or Unavailable with fewer than ten finite innovations.
    """
    is_usable = np.isfinite(innovation_m) & (innovation_variance_m2 > 0)
    nu_m, variance_m2 = innovation_m[is_usable], innovation_variance_m2[is_usable]
    count = len(nu_m)
    if count < MIN_INNOVATIONS:
        return Unavailable(
            "consistency test",
            f"only {count_noun(count, 'innovation')} (at least {MIN_INNOVATIONS} are needed)",
            "Analyse a longer segment, or log the source at a higher rate.",
        )
    if np.ptp(nu_m) == 0.0:
        return Unavailable(
            "consistency test",
            "all innovations have the same value",
            "Check the position source; then analyse a longer segment.",
        )
    normalised = nu_m / np.sqrt(variance_m2)
    std_m = float(np.std(nu_m, ddof=1))
    bias_t = float(np.sqrt(count) * np.mean(nu_m) / std_m)
    lags = min(LJUNG_BOX_LAGS, count // 5)
    correlations = autocorrelation(normalised, lags)
    ljung_box_q = (
        count * (count + 2) * float(np.sum(correlations**2 / (count - np.arange(1, lags + 1))))
    )
    return Consistency(
        **_verdict_fields(normalised**2),
        innovation_mean_m=float(np.mean(nu_m)),
        innovation_std_m=std_m,
        sqrt_s_median_m=float(np.median(np.sqrt(variance_m2))),
        fraction_outside_two_sigma=float(np.mean(np.abs(normalised) > 2.0)),
        fraction_outside_gate=float(np.mean(np.abs(normalised) > gate)),
        bias_t=bias_t,
        bias_p=float(2.0 * stdtr(count - 1, -abs(bias_t))),
        lag1_autocorrelation=float(correlations[0]),
        ljung_box_p=float(chdtrc(lags, ljung_box_q)),
        ljung_box_lags=lags,
    )


def assess_horizontal(
    north: tuple[Array, Array], east: tuple[Array, Array]
) -> HorizontalNis | None:
    """Test the innovations of north and east together; both have the same timestamps.

    Parameters
    ----------
    north, east : (innovation_m, innovation_variance_m2), each of shape (n,)

    Returns
    -------
    HorizontalNis, or None below ten innovations.
    """
    is_usable = (north[1] > 0) & (east[1] > 0) & np.isfinite(north[0]) & np.isfinite(east[0])
    nis = np.sum([nu[is_usable] ** 2 / s[is_usable] for nu, s in (north, east)], axis=0)
    if len(nis) < MIN_INNOVATIONS or not nis.any():
        return None
    return HorizontalNis(**_verdict_fields(nis, 2))
