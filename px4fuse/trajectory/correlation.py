"""Two series correlated over all lags at once, with gaps in both; and a series with itself."""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from px4fuse.arrays import Array, BoolArray, Complex

Series = TypeVar("Series", Array, Complex)


@dataclass(frozen=True)
class Moments:
    """Second moments of two series over the samples that both know, for every lag.

    Of shape (n + m - 1,); at index k the first series' sample 0 meets the second's k - (n - 1).

    Attributes
    ----------
    count : ndarray
        Samples.
    covariance : ndarray, complex where the series are
        Σ conj(a - ā)(b - b̄).
    power_a, power_b : ndarray
        Σ |a - ā|² and Σ |b - b̄|².
    """

    count: Array
    covariance: Complex
    power_a: Array
    power_b: Array


def moments(a: Series, b: Series, a_known: BoolArray, b_known: BoolArray) -> Moments:
    """Moments of two series on one grid over all lags (Padfield 2012, eqs. 3 to 9).

    Parameters
    ----------
    a, b : ndarray, shapes (n,) and (m,)
        Real or complex.
    a_known, b_known : ndarray of bool, shapes (n,) and (m,)
        At least one sample of each.
    """
    # about their means, else roundings matter
    masked_series = (a, a_known), (b, b_known)
    a, b = (
        np.where(known, values - np.mean(values[known]), 0.0) for values, known in masked_series
    )
    m, n = a_known.astype(float), b_known.astype(float)
    count = np.rint(_correlate(n, m).real)
    weight = 1.0 / np.maximum(count, 1.0)
    sum_a, sum_b = _correlate(n, a), _correlate(b, m)  # the first conjugate
    covariance = _correlate(b, a) - sum_a * sum_b * weight
    power_a = _correlate(n, np.abs(a) ** 2).real - np.abs(sum_a) ** 2 * weight
    power_b = _correlate(np.abs(b) ** 2, m).real - np.abs(sum_b) ** 2 * weight
    return Moments(count, covariance, power_a, power_b)


def autocovariance(values: Array | Complex) -> Array:
    """Real part of Σ conj(v) v later, at lags 0 to n - 1; the mean is not taken out.

    Parameters
    ----------
    values : ndarray, shape (n,)
        Real or complex.
    """
    return np.asarray(_correlate(values, values)[len(values) - 1 :].real)


def _correlate(a: Array | Complex, b: Array | Complex) -> Complex:
    """Σ a conj(b) over the overlap, for every lag."""
    # costs a tenth of a second to import: most flights have nothing to correlate
    from scipy.signal import correlate  # noqa: PLC0415

    return np.asarray(correlate(a, b, mode="full", method="fft"))
