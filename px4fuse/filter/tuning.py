"""Maximum-likelihood SIGMA_A and SIGMA_Z, with intervals, and what speaks for and against them.

The innovations of a filter with the right noises are white and as large as it says, and these
noises make them most likely (Schweppe 1965): minimise Σ -ln p(ν_k), over grids of both on log
scales. The likelihood has heavy tails, so that outliers (NLOS) do not pass for noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov
from scipy.optimize import nnls
from scipy.stats import chi2

from px4fuse.arrays import Array, BoolArray
from px4fuse.filter.consistency import Consistency, assess
from px4fuse.filter.kalman import Settings
from px4fuse.filter.likelihood import (
    Preintegrated,
    innovations,
    negative_log_likelihood,
    outlier_probability,
    parabola_vertex,
    preintegrate,
    profile_interval,
    recursion,
)
from px4fuse.filter.model import H, matrix, transition
from px4fuse.filter.signals import Axis
from px4fuse.flight import Unavailable

HORIZONTAL = "horizontal"
GRID = 64
SIGMA_A_SEARCH_M_S2 = (1e-3, 30.0)
# From what no positioning system resolves
SIGMA_Z_SEARCH_M = (1e-3, 10.0)
# Points per side of the first grid over the whole range and of the next ones, each of which spans
# this many steps of the one before on either side of its minimum
FIRST_POINTS, NEXT_POINTS, ZOOMS, ZOOM_STEPS = 25, 17, 3, 1.6
# The map shows what lies less than this below the greatest log-likelihood: three σ and more
MAP_DROP = 9.0
MIN_MEASUREMENTS = 30
MAX_PASSES = 5
MAX_OUTLIER_SHARE = 0.3
# Median NIS, against that of chi-square, below which outliers are hidden in the fitted noise
MASKED = 0.6
# Legs longer than this many median ones break the constant interval that ALS needs
ALS_LONGEST_LEG = 1.5
ALS_LAGS = 15
# Innovations that are scored at once: a whole flight's over a grid would take gigabytes, and five
# times as long outside the processor's cache
BLOCK = 2**14


@dataclass(frozen=True)
class Noise:
    """One noise parameter as the data have it.

    Attributes
    ----------
    value : float or None
        Most likely value; None where the likelihood has its maximum at zero or beyond the search.
    low, high : float or None
        Ends of the 95 % profile-likelihood interval; ``low`` is None where the value may be zero,
        ``high`` None where nothing bounds it.
    """

    value: float | None
    low: float | None
    high: float | None


@dataclass(frozen=True)
class LikelihoodMap:
    """Negative log-likelihood above its minimum, shape (n, m), over SIGMA_A × SIGMA_Z."""

    sigma_a_m_s2: Array
    sigma_z_m: Array
    drop: Array


@dataclass(frozen=True)
class HeldOut:
    """Settings found on the first half, scored on the second.

    Attributes
    ----------
    sigma_a_m_s2, sigma_z_m : float
        Most likely on the first half.
    count : int
        Measurements of the second half.
    gain_nats : float
        Log-likelihood per measurement of the second half above that of the chosen settings:
        positive where tuning helps on data that it has not seen.
    """

    sigma_a_m_s2: float
    sigma_z_m: float
    count: int
    gain_nats: float


@dataclass(frozen=True)
class AxisTuning:
    """The noises of one axis, or of the horizontal axes together.

    Attributes
    ----------
    name : str
    sigma_a, sigma_z : Noise
        m/s² and m.
    map : LikelihoodMap
        Around the optimum.
    gain_nats : float
        Log-likelihood per measurement above that of the chosen settings.
    before, after : Consistency or Unavailable
        Of the chosen and of the most likely settings, outliers left out; of the first axis where
        there are several.
    outlier_time_s : ndarray, shape (k,)
        Measurements that are more likely outliers than not.
    count : int
        Measurements, outliers included.
    held_out : HeldOut or Unavailable
    als_sigma_a_m_s2, als_sigma_z_m : float or None
        By autocovariance least squares, as a cross-check; None where the intervals of the source
        vary too much for it.
    """

    name: str
    sigma_a: Noise
    sigma_z: Noise
    map: LikelihoodMap
    gain_nats: float
    before: Consistency | Unavailable
    after: Consistency | Unavailable
    outlier_time_s: Array
    count: int
    held_out: HeldOut | Unavailable
    als_sigma_a_m_s2: float | None
    als_sigma_z_m: float | None


@dataclass(frozen=True)
class _Best:
    """Settings of greatest likelihood, and the ranges of their logarithms that are likely."""

    sigma_a: float
    sigma_z: float
    likely: tuple[Array, Array]


def tune(
    axes: tuple[Axis, ...],
    settings: Settings,
    names: tuple[str, ...] | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> dict[str, AxisTuning | Unavailable]:
    """Most likely SIGMA_A and SIGMA_Z of each axis, and of north and east together.

    Parameters
    ----------
    axes : tuple of Axis
    settings : Settings
        The chosen ones: ``dt_s`` and ``input`` are used, the noises compared with.
    names : tuple of str, optional
        Axis names and "horizontal"; by default all that there are.
    progress : callable
        Told the name of each axis as it starts.

    Returns
    -------
    mapping from axis name, or "horizontal", to AxisTuning or Unavailable
    """
    groups: dict[str, tuple[Axis, ...]] = {axis.name: (axis,) for axis in axes}
    if {"north", "east"} <= groups.keys():
        pair = (*groups["north"], *groups["east"])
        if np.array_equal(pair[0].measurement_time_s, pair[1].measurement_time_s):
            groups[HORIZONTAL] = pair
    tuned = {}
    for name, group in groups.items():
        if names is None or name in names:
            progress(name)
            tuned[name] = tune_axes(name, group, settings)
    return tuned


def tune_axes(name: str, axes: tuple[Axis, ...], settings: Settings) -> AxisTuning | Unavailable:
    """Most likely noises that several axes share.

    Parameters
    ----------
    name : str
    axes : tuple of Axis
        With the same measurement times.
    settings : Settings
        The chosen ones: ``dt_s`` and ``input`` are used, the noises compared with.
    """
    legs = [preintegrate(axis, settings) for axis in axes]
    count = len(legs[0].measurement_m)
    if count < MIN_MEASUREMENTS:
        return Unavailable(
            f"tuning, {name}",
            f"{count} measurements are too few (at least {MIN_MEASUREMENTS})",
            "Analyse a longer segment, or log the source at a higher rate.",
        )
    best, skip = _fit_without_outliers(legs)
    if np.mean(skip) > MAX_OUTLIER_SHARE:
        return Unavailable(
            f"tuning, {name}",
            f"{np.mean(skip):.0%} of the measurements look like outliers",
            "Mend the source first; noises cannot be told from outliers.",
        )
    around = _map(legs, skip, best)
    chosen = _total(legs, settings.sigma_a_m_s2, settings.sigma_z_m, skip)
    found = _total(legs, best.sigma_a, best.sigma_z, skip)
    times = axes[0].measurement_time_s[-count:]
    als = _autocovariance_least_squares(legs, best, skip)
    return AxisTuning(
        name=name,
        sigma_a=_profile(around.sigma_a_m_s2, around.drop.min(axis=1), SIGMA_A_SEARCH_M_S2),
        sigma_z=_profile(around.sigma_z_m, around.drop.min(axis=0), SIGMA_Z_SEARCH_M),
        map=around,
        gain_nats=float(chosen - found) / count,
        before=_assess(legs[0], settings.sigma_a_m_s2, settings.sigma_z_m, skip),
        after=_assess(legs[0], best.sigma_a, best.sigma_z, skip),
        outlier_time_s=times[skip],
        count=count,
        held_out=_hold_out(name, legs, settings, skip),
        als_sigma_a_m_s2=als[0],
        als_sigma_z_m=als[1],
    )


def _total(
    legs: list[Preintegrated],
    sigma_a: Array | float,
    sigma_z: Array | float,
    skip: BoolArray,
    start: int = 0,
) -> Array:
    """Negative log-likelihood of all axes from one measurement on, shape of the grid."""
    shape = np.broadcast(sigma_a, sigma_z).shape
    if not shape:
        pairs = [innovations(leg, sigma_a, sigma_z, skip) for leg in legs]
        scores = [negative_log_likelihood(nu[start:], s[start:]) for nu, s in pairs]
        return np.asarray(np.sum(scores), dtype=np.float64)
    rows = max(1, BLOCK // max(1, int(np.prod(shape))))
    nu, s = np.empty((rows, *shape)), np.empty((rows, *shape))
    total = np.zeros(shape)
    for leg in legs:
        row = 0
        for step in islice(recursion(leg, sigma_a, sigma_z, skip), start, None):
            nu[row], s[row] = step[:2]
            row += 1
            if row == rows:
                total += negative_log_likelihood(nu, s)
                row = 0
        total += negative_log_likelihood(nu[:row], s[:row])
    return total


def _fit_without_outliers(legs: list[Preintegrated]) -> tuple[_Best, BoolArray]:
    """Fit, find the outliers at the optimum, do not fuse them, and again until they stay."""
    skip = np.zeros(len(legs[0].measurement_m), dtype=bool)
    best = _search(legs, skip)
    for _ in range(MAX_PASSES):
        pairs = [innovations(leg, best.sigma_a, best.sigma_z, skip) for leg in legs]
        nu, s = [nu for nu, _ in pairs], [s for _, s in pairs]
        # many outliers at once raise the fitted SIGMA_Z until they pass: the median tells, where
        # SIGMA_Z makes up most of S
        square = np.sum([n**2 / v for n, v in zip(nu, s, strict=True)], axis=0)
        scale = float(np.median(square[~skip]) / chi2.median(len(legs)))
        if scale < MASKED and best.sigma_z**2 > 0.5 * np.median(s):
            s = [v * scale for v in s]
        outlier = outlier_probability(nu, s) > 0.5
        if np.array_equal(outlier, skip):
            break
        skip = outlier
        if skip.all():  # nothing is left to fit, which the caller says
            break
        best = _search(legs, skip)
    return best, skip


def _search(legs: list[Preintegrated], skip: BoolArray) -> _Best:
    """Find the optimum on grids that zoom in, from the whole search range."""
    ranges = [np.log(SIGMA_A_SEARCH_M_S2), np.log(SIGMA_Z_SEARCH_M)]
    extents = [np.array(limits) for limits in ranges]
    likely = list(extents)
    points = FIRST_POINTS
    for _ in range(ZOOMS):
        a, z = (np.exp(np.linspace(extent[0], extent[1], points)) for extent in extents)
        total = _total(legs, a[:, None], z[None, :], skip)
        profiles = (total.min(axis=1), total.min(axis=0))
        wide = [
            _likely(np.log(grid), profile, search)
            for grid, profile, search in zip((a, z), profiles, ranges, strict=True)
        ]
        best = _vertex(a, profiles[0]), _vertex(z, profiles[1])
        step = [(extent[1] - extent[0]) / (points - 1) for extent in extents]
        extents = [
            np.clip(np.log(centre) + ZOOM_STEPS * width * np.array([-1.0, 1.0]), *search)
            for centre, width, search in zip(best, step, ranges, strict=True)
        ]
        points = NEXT_POINTS
        # the narrowest grid that still shows both ends
        for axis, (extent, ends) in enumerate(wide):
            if ends:
                likely[axis] = extent
    return _Best(*best, (likely[0], likely[1]))


def _likely(log_grid: Array, profile: Array, search: Array) -> tuple[Array, bool]:
    """Where a profile is not far above its minimum, and whether that is seen to end on both sides.

    The end of the search range counts as one: there is nothing beyond.
    """
    inside = np.flatnonzero(profile - profile.min() < MAP_DROP)
    first, last = max(int(inside[0]) - 1, 0), min(int(inside[-1]) + 1, len(log_grid) - 1)
    ends = (inside[0] > 0 or log_grid[0] <= search[0] + 1e-9) and (
        inside[-1] < len(log_grid) - 1 or log_grid[-1] >= search[1] - 1e-9
    )
    return log_grid[[first, last]], bool(ends)


def _map(legs: list[Preintegrated], skip: BoolArray, best: _Best) -> LikelihoodMap:
    """Likelihood all around the optimum."""
    a, z = (np.exp(np.linspace(extent[0], extent[1], GRID)) for extent in best.likely)
    total = _total(legs, a[:, None], z[None, :], skip)
    return LikelihoodMap(a, z, total - total.min())


def _vertex(grid: Array, profile: Array) -> float:
    """Minimum of a profile between grid points, by a parabola on the log scale."""
    at = int(np.argmin(profile))
    if at in (0, len(grid) - 1):
        return float(grid[at])
    shift, _ = parabola_vertex(profile, at)
    step = np.log(grid[at + 1] / grid[at])
    return float(np.exp(np.log(grid[at]) + shift * step))


def _profile(grid: Array, profile: Array, search: tuple[float, float]) -> Noise:
    """Value and 95 % interval from a profile likelihood."""
    low, high = (
        None if end is None else float(np.exp(end))
        for end in profile_interval(np.log(grid), profile)
    )
    at_zero = low is None and grid[0] <= search[0] * (1.0 + 1e-9)
    unbounded = high is None and grid[-1] >= search[1] * (1.0 - 1e-9)
    value = None if at_zero or unbounded else _vertex(grid, profile)
    return Noise(value, low, high)


def _assess(
    legs: Preintegrated, sigma_a: float, sigma_z: float, skip: BoolArray
) -> Consistency | Unavailable:
    nu, s = innovations(legs, sigma_a, sigma_z, skip)
    return assess(nu[~skip], s[~skip])


def _hold_out(
    name: str, legs: list[Preintegrated], settings: Settings, skip: BoolArray
) -> HeldOut | Unavailable:
    """Tune on the first half, score on the second."""
    half = len(skip) // 2
    if half < MIN_MEASUREMENTS:
        return Unavailable(
            f"held-out check, {name}",
            f"half of the segment holds {half} measurements (at least {MIN_MEASUREMENTS})",
            "Analyse a longer segment.",
        )
    tuned = _search([_cut(leg, half) for leg in legs], skip[:half])
    chosen, scored = (
        float(_total(legs, sigma_a, sigma_z, skip, half))
        for sigma_a, sigma_z in (
            (settings.sigma_a_m_s2, settings.sigma_z_m),
            (tuned.sigma_a, tuned.sigma_z),
        )
    )
    count = len(skip) - half
    return HeldOut(tuned.sigma_a, tuned.sigma_z, count, (chosen - scored) / count)


def _cut(legs: Preintegrated, count: int) -> Preintegrated:
    """The first measurements only."""
    return replace(
        legs,
        length_s=legs.length_s[:count],
        delta_position_m=legs.delta_position_m[:count],
        delta_velocity_m_s=legs.delta_velocity_m_s[:count],
        noise_unit=legs.noise_unit[:count],
        noise_fixed=legs.noise_fixed[:count],
        measurement_m=legs.measurement_m[:count],
    )


def _autocovariance_least_squares(
    legs: list[Preintegrated], best: _Best, skip: BoolArray
) -> tuple[float | None, float | None]:
    """SIGMA_A and SIGMA_Z from the autocovariance of a fixed-gain filter's innovations.

    Odelson, Rajamani and Rawlings (2006): with any stable gain the autocovariances C_j are linear
    in Q and R, so that non-negative least squares gives both. The interval must be constant.
    """
    length = legs[0].length_s
    interval = float(np.median(length))
    regular = (length < ALS_LONGEST_LEG * interval) & (length > interval / ALS_LONGEST_LEG)
    if np.mean(regular) < 0.8:
        return None, None
    F = transition(interval)
    Q = matrix(legs[0].noise_unit[regular].mean(axis=0))
    P = solve_discrete_are(F.T, H.T, best.sigma_a**2 * Q, np.array([[best.sigma_z**2]]))
    L = P @ H.T / (H @ P @ H.T + best.sigma_z**2)
    A = F - F @ L @ H
    drive = F @ L
    by_q, by_r = solve_discrete_lyapunov(A, Q), solve_discrete_lyapunov(A, drive @ drive.T)
    powers = [np.linalg.matrix_power(A, j) for j in range(ALS_LAGS)]
    c_q = np.array([(H @ power @ by_q @ H.T).item() for power in powers])
    c_r = np.array([(H @ power @ by_r @ H.T).item() for power in powers])
    c_r[0] += 1.0
    c_r[1:] -= np.array([(H @ power @ drive).item() for power in powers[:-1]])
    if np.count_nonzero(skip | ~regular) * 2 * ALS_LAGS > len(skip):
        return None, None
    measured = np.mean([_autocovariance(leg, F, L, skip | ~regular) for leg in legs], axis=0)
    if not np.all(np.isfinite(measured)):
        return None, None
    (q_found, r_found), _ = nnls(np.column_stack([c_q, c_r]), measured)
    return (
        float(np.sqrt(q_found)) if q_found > 0.0 else None,
        float(np.sqrt(r_found)) if r_found > 0.0 else None,
    )


def _autocovariance(legs: Preintegrated, F: Array, L: Array, skip: BoolArray) -> Array:
    """Autocovariance of the innovations of a filter of fixed gain, without what is skipped.

    NaN where hardly any stretch between what is skipped is longer than the lags.
    """
    x = np.array([legs.initial.position_m, legs.initial.velocity_m_s])
    nu = np.full(len(skip), np.nan)
    known = 0  # measurements since the filter last lost its state
    for k in range(len(skip)):
        x = np.array([x[0] + legs.length_s[k] * x[1], x[1]])
        x += np.array([legs.delta_position_m[k], legs.delta_velocity_m_s[k]])
        error = legs.measurement_m[k] - x[0]
        known = 0 if skip[k] else known + 1
        if known:
            x += L[:, 0] * error
        if known > ALS_LAGS:
            nu[k] = error
    products = [nu[: len(nu) - lag] * nu[lag:] for lag in range(ALS_LAGS)]
    if np.count_nonzero(np.isfinite(products[-1])) < ALS_LAGS:
        return np.full(ALS_LAGS, np.nan)
    return np.array([np.nanmean(product) for product in products])
