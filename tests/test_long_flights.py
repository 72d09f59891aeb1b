"""Memory and results of computations that divide a long flight into parts."""

import tracemalloc
from collections.abc import Callable

import numpy as np
import pandas as pd
import pytest

from px4fuse.comparison.error_patterns import (
    ErrorFit,
    find_periodic_error,
    find_time_offset_variation,
)
from px4fuse.flight.model import rows_between, time_index


def fit_of(count: int, error_m: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> ErrorFit:
    """Return a fit whose remaining errors are a function of time (s) and velocity (m/s)."""
    time_s = 0.2 * np.arange(count)
    velocity_m_s = np.stack([np.sin(time_s / 7.0), 0.6 * np.cos(time_s / 5.0)], axis=1)
    path_m = np.stack([-7.0 * np.cos(time_s / 7.0), 3.0 * np.sin(time_s / 5.0)], axis=1)
    rotated_m = path_m[:, ::-1] * [-1.0, 1.0]
    constants = np.broadcast_to(np.eye(2)[:, None], (2, count, 2))
    columns = np.stack([*constants, path_m, rotated_m, -velocity_m_s], axis=-1)
    noise_m = 0.005 * np.random.default_rng(count).standard_normal((count, 2))
    residual_m = error_m(time_s, velocity_m_s) + noise_m
    return ErrorFit(time_s, velocity_m_s, path_m, columns, residual_m, 0.005, 0.0, 0.1)


def varying_offset(time_s: np.ndarray, velocity_m_s: np.ndarray) -> np.ndarray:
    return -velocity_m_s * 0.2 * np.sin(time_s / 30.0)[:, None]


def peak_bytes(work: Callable[[], object]) -> int:
    tracemalloc.start()
    work()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak


def test_memory_of_time_offset_fit_grows_linearly_with_duration():
    short, long = (fit_of(count, varying_offset) for count in (1000, 8000))
    peaks = [peak_bytes(lambda fit=fit: find_time_offset_variation(fit)) for fit in (short, long)]
    assert peaks[1] < 10.0 * peaks[0]


def test_time_offset_per_flight_part_equals_numpy_least_squares():
    fit = fit_of(600, varying_offset)
    found = find_time_offset_variation(fit)
    parts = np.floor(fit.time_s / 4.0).astype(int)
    square_speeds = np.bincount(parts, np.sum(fit.velocity_m_s**2, axis=1)) / np.bincount(parts)
    moving = np.flatnonzero(square_speeds > 0.3**2)
    dense = -fit.velocity_m_s[:, :, None] * (parts[:, None] == moving)[:, None, :]
    columns = np.concatenate([fit.columns[..., :-1], dense], axis=-1).reshape(1200, -1)
    offsets_s = np.linalg.lstsq(columns, fit.residual_m.ravel(), rcond=None)[0][4:]
    assert found is not None
    assert (found.least_s, found.most_s) == pytest.approx((offsets_s.min(), offsets_s.max()))


@pytest.mark.parametrize("count", [900, 18_000])
def test_period_of_position_error_is_found_at_any_duration(count):
    def error_m(time_s: np.ndarray, _: np.ndarray) -> np.ndarray:
        phase = 2.0 * np.pi * time_s / 13.0
        return 0.3 * np.stack([np.sin(phase), np.cos(phase)], axis=1)

    found = find_periodic_error(fit_of(count, error_m))
    assert found is not None
    assert found.period_s == pytest.approx(13.0, rel=0.01)
    assert found.amplitude_m == pytest.approx(0.3 * np.sqrt(2.0), rel=0.02)


def test_fast_row_selection_equals_pandas_loc_slice():
    time_s = np.sort(np.random.default_rng(1).uniform(0.0, 9.0, 50))
    samples = pd.DataFrame({"value": np.arange(50.0)}, time_index(time_s))
    for start_s, end_s in ((time_s[3], time_s[8]), (-1.0, 4.0), (5.0, 20.0), (20.0, 30.0)):
        expected = samples.loc[start_s:end_s]
        pd.testing.assert_frame_equal(rows_between(samples, start_s, end_s), expected)
