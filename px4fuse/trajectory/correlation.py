"""Cross-correlation of two series with gaps, and autocovariance of a series."""

from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from scipy import fft

from px4fuse.core.arrays import Array, BoolArray, ComplexArray

RealOrComplex = TypeVar("RealOrComplex", Array, ComplexArray)


@dataclass(frozen=True)
class Moments:
    """Second moments of two series a and b at each lag, over the common samples.

    All arrays have one value per lag, shape (n + m - 1,). ā and b̄ are the means of a and b.

    Attributes
    ----------
    count : ndarray
        Number of common samples.
    covariance : ndarray
        Σ conj(a - ā)(b - b̄).
    sum_of_squares_a, sum_of_squares_b : ndarray
        Σ |a - ā|² and Σ |b - b̄|².
    """

    count: Array
    covariance: ComplexArray
    sum_of_squares_a: Array
    sum_of_squares_b: Array


def compute_moments(
    a: RealOrComplex, b: RealOrComplex, is_known_a: BoolArray, is_known_b: BoolArray
) -> Moments:
    """Compute the second moments of two series at each lag (Padfield 2012, eqs. 3 to 9).

    Parameters
    ----------
    a, b : ndarray, shapes (n,) and (m,)
        Real or complex series.
    is_known_a, is_known_b : ndarray of bool, shapes (n,) and (m,)
        Masks of the known samples.
    """
    # Subtracting the means first improves the numerical precision
    a, b = (
        np.where(is_known, values - np.mean(values[is_known]), 0.0)
        for values, is_known in ((a, is_known_a), (b, is_known_b))
    )
    # At each lag, only samples that are known in both series are summed. Unknown samples are 0, so
    # the correlation of one series with the mask of the other is its sum over these samples.
    # _correlate conjugates its second argument, which is a or the mask of a
    mask_a = is_known_a.astype(float)
    mask_b = is_known_b.astype(float)
    common_sample_count = np.rint(_correlate(mask_b, mask_a).real)
    reciprocal_count = 1.0 / np.maximum(common_sample_count, 1.0)
    conjugate_sum_a, sum_b = _correlate(mask_b, a), _correlate(b, mask_a)
    # Moments about the means: Σ conj(a - ā)(b - b̄) = Σ conj(a) b - (Σ conj(a)) (Σ b) / count
    covariance = _correlate(b, a) - conjugate_sum_a * sum_b * reciprocal_count
    sum_of_squares_a = (
        _correlate(mask_b, np.abs(a) ** 2).real - np.abs(conjugate_sum_a) ** 2 * reciprocal_count
    )
    sum_of_squares_b = (
        _correlate(np.abs(b) ** 2, mask_a).real - np.abs(sum_b) ** 2 * reciprocal_count
    )
    return Moments(common_sample_count, covariance, sum_of_squares_a, sum_of_squares_b)


def autocovariance(values: Array | ComplexArray) -> Array:
    """Return the real part of Σ conj(v_k) v_(k+l) at each lag l ≥ 0; the mean is not subtracted."""
    return _correlate(values, values)[len(values) - 1 :].real


def _correlate(a: Array | ComplexArray, b: Array | ComplexArray) -> ComplexArray:
    """Compute the cross-correlation of two series, like ``scipy.signal.correlate``.

    The import of ``scipy.signal`` is slow. The value at index n - 1 + l is Σ a_(k+l) conj(b_k), for
    n values of b.
    """
    lag_count = len(a) + len(b) - 1
    is_complex = np.iscomplexobj(a) or np.iscomplexobj(b)
    transform: Any = fft.fft if is_complex else fft.rfft
    inverse: Any = fft.ifft if is_complex else fft.irfft
    padded_size = fft.next_fast_len(lag_count, not is_complex)
    spectrum = transform(a, padded_size) * transform(np.conj(b[::-1]), padded_size)
    return np.asarray(inverse(spectrum, padded_size)[:lag_count])
