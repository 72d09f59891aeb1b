"""Array types for annotations, and integration over time."""

from collections.abc import Iterator

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
ComplexArray = NDArray[np.complex128]
ArrayPair = tuple[Array, Array]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]

# Maximum number of rows that are processed at once
BLOCK_ROWS = 2**14


def iterate_row_blocks(count: int) -> Iterator[slice]:
    """Yield slices of at most BLOCK_ROWS rows, to process a long array in parts."""
    return (slice(first, first + BLOCK_ROWS) for first in range(0, count, BLOCK_ROWS))


def compute_median_interval_s(time_s: ArrayLike) -> float:
    """Return the median interval (s) between successive times."""
    return float(np.median(np.diff(time_s)))


def rms(values: "Array | pd.Series[float]") -> float:
    return float(np.sqrt(np.mean(values**2)))


def integrate_cumulatively(values: Array, time_s: Array) -> Array:
    """Integrate values over time up to each sample (trapezoidal rule, axis 0)."""
    integral = np.zeros(values.shape)
    intervals_s = np.diff(time_s).reshape(-1, *[1] * (values.ndim - 1))
    np.cumsum((values[1:] + values[:-1]) / 2.0 * intervals_s, axis=0, out=integral[1:])
    return integral


def cumulative_sums(rows: Array) -> Array:
    """Return cumulative sums of the rows, shape (n + 1, k); the first sum is zero."""
    return np.concatenate([np.zeros((1, rows.shape[1])), np.cumsum(rows, axis=0)])


def interpolate_columns(time_s: Array, known_time_s: Array, values: Array) -> Array:
    """Interpolate each column of values linearly at given times, shape (n, k)."""
    return np.stack([np.interp(time_s, known_time_s, column) for column in values.T], axis=1)


def select_intervals(time_s: Array, is_selected: BoolArray) -> list[tuple[float, float]]:
    """Return start and end (s) of the selected intervals between successive times."""
    starts_s, ends_s = time_s[:-1][is_selected], time_s[1:][is_selected]
    return list(zip(starts_s.tolist(), ends_s.tolist(), strict=True))


def rank_correlation(first_values: Array, second_values: Array) -> float:
    """Return Spearman's rank correlation (without scipy.stats, whose import is slow).

    >>> rank_correlation(np.array([1.0, 2.0, 3.0]), np.array([1.0, 4.0, 9.0]))
    1.0
    """
    return float(pd.Series(first_values).rank().corr(pd.Series(second_values).rank()))
