"""Consistency tests of a filter's innovations: mean NIS, bias and autocorrelation.

Sources: Bar-Shalom, Li and Kirubarajan (2001), Estimation with Applications to Tracking and
Navigation, section 5.4; Ljung and Box (1978), Biometrika 65(2).
"""

from collections.abc import Mapping
from typing import Any, Literal, Self

import numpy as np
from scipy.special import chdtrc, gammaincinv, stdtr

from px4fuse.core.arrays import Array, ArrayPair
from px4fuse.core.record import (
    Correlation,
    Count,
    NonNegativeFloat,
    PositiveFloat,
    Record,
    Share,
    Unavailable,
)

from .signals import report_too_few_measurements

# Underconfident: the reported σ is too large. Overconfident: the reported σ is too small.
SigmaVerdict = Literal["consistent", "underconfident", "overconfident"]

Limits = tuple[float, float]
# Minimum number of innovations in a consistency test
MIN_INNOVATIONS = 10
CONFIDENCE_LEVEL = 0.95
# Maximum number of lags of the Ljung-Box whiteness test
MAX_LJUNG_BOX_LAG_COUNT = 10
# Reference for the actual σ: innovations of the position source, or ground truth
Reference = Literal["source", "truth"]
# Range of actual σ / reported σ for a consistent filter. It is wider for ground truth,
# because EKF2's σ excludes the lag of its output predictor
CONSISTENT_SIGMA_RATIOS: Mapping[Reference, Limits] = {"source": (0.8, 1.25), "truth": (0.67, 1.5)}
# Default innovation gate (in √S): PX4's default of EKF2_EVP_GATE
DEFAULT_GATE = 5.0


class NisVerdict(Record, kw_only=True):
    """Mean NIS with its 95 % band: the filter is consistent, overconfident or underconfident.

    Attributes
    ----------
    nis_mean : float
        Mean of ν²/S per degree of freedom; expected 1.
    nis_band : (float, float)
        95 % chi-square band of the mean NIS.
    sigma_ratio : float
        Actual σ over reported σ, √nis_mean; above 1: overconfident.
    """

    count: Count
    nis_mean: PositiveFloat
    nis_band: tuple[NonNegativeFloat, NonNegativeFloat]
    sigma_ratio: PositiveFloat
    verdict: SigmaVerdict

    @property
    def sigma_error_factor(self) -> float:
        """Ratio of actual to reported σ or its inverse, whichever is larger."""
        return float(max(self.nis_mean, 1.0 / self.nis_mean) ** 0.5)


class Consistency(NisVerdict, kw_only=True):
    """Statistics of a filter's innovations ν, compared with the innovation variances S.

    Attributes
    ----------
    sqrt_s_median_m : float
        Median of √S, the expected standard deviation of the innovations.
    fraction_outside_two_sigma : float
        Fraction of the innovations outside ±2√S; expected 0.046.
    bias_t, bias_p : float
        t statistic of the mean innovation, and its two-sided p-value.
    lag1_autocorrelation : float
        Autocorrelation of ν/√S at lag 1; expected 0.
    ljung_box_p : float
        p-value of the Ljung-Box whiteness test.
    """

    innovation_mean_m: float
    innovation_std_m: NonNegativeFloat
    sqrt_s_median_m: PositiveFloat
    fraction_outside_two_sigma: Share
    fraction_outside_gate: Share
    bias_t: float
    bias_p: Share
    lag1_autocorrelation: Correlation
    ljung_box_p: Share
    ljung_box_lags: Count

    @classmethod
    def from_innovations(
        cls,
        innovation_m: Array,
        innovation_variance_m2: Array,
        gate: float = DEFAULT_GATE,
        **other_fields: Any,
    ) -> Self | Unavailable:
        """Test innovations against the innovation variances: NIS, bias, whiteness.

        ``gate`` is the innovation gate in √S. At least ten finite innovations are needed.
        ``other_fields`` are the fields of a subclass.
        """
        is_usable = np.isfinite(innovation_m) & (innovation_variance_m2 > 0)
        usable_innovation_m = innovation_m[is_usable]
        variance_m2 = innovation_variance_m2[is_usable]
        innovation_count = len(usable_innovation_m)
        if innovation_count < MIN_INNOVATIONS:
            return report_too_few_measurements(
                "consistency test", innovation_count, MIN_INNOVATIONS
            )
        if np.ptp(usable_innovation_m) == 0.0:
            return Unavailable(
                "consistency test",
                "all innovations have the same value",
                "Check the position source; then analyse a longer segment.",
            )
        normalised_innovation = usable_innovation_m / np.sqrt(variance_m2)
        std_m = float(np.std(usable_innovation_m, ddof=1))
        mean_m = float(np.mean(usable_innovation_m))
        mean_t_statistic = float(np.sqrt(innovation_count) * mean_m / std_m)
        lag_count = min(MAX_LJUNG_BOX_LAG_COUNT, innovation_count // 5)
        autocorrelations = compute_autocorrelation(normalised_innovation, lag_count)
        ljung_box_terms = autocorrelations**2 / (innovation_count - np.arange(1, lag_count + 1))
        return cls(
            **_compute_nis_verdict_fields(normalised_innovation**2),
            innovation_mean_m=mean_m,
            innovation_std_m=std_m,
            sqrt_s_median_m=float(np.median(np.sqrt(variance_m2))),
            fraction_outside_two_sigma=float(np.mean(np.abs(normalised_innovation) > 2.0)),
            fraction_outside_gate=float(np.mean(np.abs(normalised_innovation) > gate)),
            bias_t=mean_t_statistic,
            bias_p=float(2.0 * stdtr(innovation_count - 1, -abs(mean_t_statistic))),
            lag1_autocorrelation=float(autocorrelations[0]),
            ljung_box_p=float(
                chdtrc(lag_count, innovation_count * (innovation_count + 2) * ljung_box_terms.sum())
            ),
            ljung_box_lags=lag_count,
            **other_fields,
        )


class HorizontalNis(NisVerdict, kw_only=True):
    """NIS of north and east together (two degrees of freedom), divided by two.

    The covariance between north and east is ignored, because EKF2 does not log it.
    """


def compute_nis_band(count: int, dimension_count: int = 1) -> Limits:
    """Return the 95 % chi-square band of the mean of ``count`` NIS values.

    Each NIS is divided by its number of dimensions, so that the expected mean is 1.

    >>> low, high = compute_nis_band(128, 2)
    >>> round(2 * low, 2), round(2 * high, 2)
    (1.67, 2.36)
    """
    # Half the sum of the NIS values has a gamma distribution with this shape parameter
    gamma_shape = 0.5 * count * dimension_count
    low, high = (
        float(gammaincinv(gamma_shape, (1 + sign * CONFIDENCE_LEVEL) / 2)) / gamma_shape
        for sign in (-1, 1)
    )
    return low, high


def classify_sigma_ratio(
    ratio: float, reference: Reference, ratio_interval: Limits | None = None
) -> SigmaVerdict:
    """Classify a filter by the ratio of its actual to its reported σ.

    A ratio inside :data:`CONSISTENT_SIGMA_RATIOS` is consistent.
    A 95 % ``ratio_interval`` that contains 1 is also consistent.
    """
    low, high = CONSISTENT_SIGMA_RATIOS[reference]
    if low <= ratio <= high or (
        ratio_interval is not None and ratio_interval[0] <= 1.0 <= ratio_interval[1]
    ):
        return "consistent"
    return "overconfident" if ratio > 1.0 else "underconfident"


def compute_sigma_ratio_interval(nis_mean: float, nis_band: Limits) -> Limits:
    """Return the 95 % interval of the σ ratio (actual σ ÷ reported σ), estimated as √(mean NIS)."""
    return (nis_mean / nis_band[1]) ** 0.5, (nis_mean / nis_band[0]) ** 0.5


def classify_mean_nis(nis_mean: float, nis_band: Limits) -> SigmaVerdict:
    return classify_sigma_ratio(
        nis_mean**0.5, "source", compute_sigma_ratio_interval(nis_mean, nis_band)
    )


def _compute_nis_verdict_fields(nis: Array, dimension_count: int = 1) -> dict[str, Any]:
    """Return count, mean NIS, its 95 % band, σ ratio and verdict from NIS values."""
    nis_mean = float(np.mean(nis)) / dimension_count
    mean_nis_band = compute_nis_band(len(nis), dimension_count)
    return {
        "count": len(nis),
        "nis_mean": nis_mean,
        "nis_band": mean_nis_band,
        "sigma_ratio": float(np.sqrt(nis_mean)),
        "verdict": classify_mean_nis(nis_mean, mean_nis_band),
    }


def compute_autocorrelation(values: Array, lag_count: int) -> Array:
    """Return the autocorrelation at lags 1 to ``lag_count``, without subtracting the mean."""
    square_sum = float(np.dot(values, values))
    return np.array(
        [np.dot(values[:-lag], values[lag:]) / square_sum for lag in range(1, lag_count + 1)]
    )


def assess_horizontal_nis(north: ArrayPair, east: ArrayPair) -> HorizontalNis | None:
    """Test the innovations along north and east together; None if there are fewer than ten.

    ``north`` and ``east`` are pairs of arrays: innovations (m) and innovation variances (m²).
    """
    is_usable = (north[1] > 0) & (east[1] > 0) & np.isfinite(north[0]) & np.isfinite(east[0])
    nis = np.sum([nu[is_usable] ** 2 / s[is_usable] for nu, s in (north, east)], axis=0)
    if len(nis) < MIN_INNOVATIONS or not nis.any():
        return None
    return HorizontalNis(**_compute_nis_verdict_fields(nis, 2))
