"""Offset between the clocks of two recordings of one motion: every lag, then least squares.

One search serves trajectories here, and a position file against EKF2 or the IMU in
:mod:`px4fuse.placing.fitting`: both series are correlated over all lags (:mod:`correlation`), the
best is refined by least squares, and is refused where another lag's residual is within
:data:`RIVAL_RATIO` of it. What differs is what is known. Trajectories may have any frame and scale,
so their speeds are correlated and a free similarity is refined; a position file is in metres with z
vertical and has outliers, so horizontal positions are correlated, and yaw and origin refined
robustly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from msgspec import structs
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Slerp
from scipy.special import stdtrit

from px4fuse.arrays import Array, BoolArray
from px4fuse.record import Record, Span
from px4fuse.trajectory.alignment import Transform, umeyama
from px4fuse.trajectory.association import bracketed, gap_limit, positions_at
from px4fuse.trajectory.correlation import autocovariance, moments
from px4fuse.trajectory.model import MIN_POSES, Trajectory

STEP_S, MAX_SAMPLES = 0.05, 200_000  # of the grid for the search
SMOOTHING_S = 0.25  # of speeds, which noise would drown
MIN_OVERLAP_S, MIN_OVERLAP_SHARE = 5.0, 0.5  # of the shorter one
MIN_POSES_SHARE = 0.3  # of those in the shorter one's span; gaps take some
CANDIDATES = 12  # peaks of the correlation whose ATE is looked at
# By which the least squares may leave a peak, and then what it found
WINDOW_S, FINE_WINDOW_S = 0.5, 0.1
APART_S = 1.0  # another offset, not the same peak
MIN_CORRELATION = 0.3
# Another offset fits as well where its residual (RMS) is not larger by this factor: of two sets of
# 80 independent residuals, which is half a minute of a flight, one is larger by it in 5 % by chance
# (F-test, F = 1.2² at 80 and 80 degrees of freedom)
RIVAL_RATIO = 1.2
MAX_POSES = 2000  # in the least squares
# Of the motion's extent: above the first nothing was matched; fits below the second are alike
MAX_MISFIT, MIN_MISFIT = 0.5, 1e-3
# Velocity that no shift, turn or scale could stand for: its share of the speed (RMS), and how far
# the two must agree on it, as noise would not
MIN_FREE_SHARE, MIN_FREE_CORRELATION = 0.05, 0.5
WINDOW_LENGTHS = 4  # correlation lengths of the score in the window of its variance
MAX_HALF_INTERVAL_S = 0.5  # that of the search; beyond it an interval helps nobody
LEVEL = 0.95


class TimeOffset(Record, frozen=True, kw_only=True):
    """Offset between two clocks.

    Attributes
    ----------
    offset_s : float or None
        What must be added to the estimate's stamps to give the reference's; None where it is not
        determinable.
    interval_s : (float, float) or None
        95 %.
    determinable : bool
    reason : str
        How it was found, or why it was not.
    """

    offset_s: float | None = None
    interval_s: Span | None = None
    determinable: bool
    reason: str


def clock_difference(estimate: Trajectory, reference: Trajectory) -> float | None:
    """What UNIX time says must be added to the estimate's stamps (s); None where one lacks it."""
    if estimate.unix_offset_s is None or reference.unix_offset_s is None:
        return None
    return estimate.unix_offset_s - reference.unix_offset_s


def estimate_time_offset(estimate: Trajectory, reference: Trajectory) -> TimeOffset:
    """Offset between the clocks of two trajectories of the same motion.

    Speeds, and angular speeds where both have orientations, do not depend on frames: their masked
    correlation over all lags (Padfield 2012; Furrer 2017) gives candidates, also where the clocks
    have nothing in common. Of these the one wins whose ATE after a free similarity is least, which
    is then minimised over the offset. The interval is that of the linearised least squares, with
    the score's variance over long runs (Newey & West 1987), as errors of poses are correlated.

    Returns
    -------
    TimeOffset
        Not determinable where nothing moves, where the speed is constant along a line or a circle
        (a shift in time is then one in space), or where other offsets fit as well.
    """
    start = clock_difference(estimate, reference)
    # what is interpolated should be the denser of the two
    is_swapped = _median_step(estimate) < _median_step(reference)
    sparse, dense = (reference, estimate) if is_swapped else (estimate, reference)
    if start is not None and is_swapped:
        start = -start
    found = _search(sparse, dense, start)
    if found.offset_s is None or found.interval_s is None or not is_swapped:
        return found
    low, high = found.interval_s
    return structs.replace(found, offset_s=-found.offset_s, interval_s=(-high, -low))


def _median_step(trajectory: Trajectory) -> float:
    return float(np.median(np.diff(trajectory.time_s)))


def _search(sparse: Trajectory, dense: Trajectory, start_s: float | None) -> TimeOffset:
    """Offset that must be added to the sparse one's stamps."""
    candidates = _candidates(sparse, dense, start_s)
    if not candidates:
        return _unknown(
            "the speeds of the two do not resemble each other at any offset (nothing moves, the "
            "speed is constant, or they are of different flights)"
        )
    coarse = [_refine(sparse, dense, lag, WINDOW_S) for lag in candidates]
    fits = [fit for fit in coarse if fit is not None and fit.misfit <= MAX_MISFIT]
    fits.sort(key=lambda fit: fit.misfit)
    if not fits:
        return _unknown("where speeds resemble each other, positions do not, or too few overlap")
    best = fits[0]
    if start_s is not None:
        # clocks that are set decide between offsets that fit alike
        alike = [fit for fit in fits if fit.misfit <= RIVAL_RATIO * best.misfit]
        best = min(alike, key=lambda fit: abs(fit.offset_s - start_s))
    else:
        rivals = [fit for fit in fits if abs(fit.offset_s - best.offset_s) > APART_S]
        if rivals and rivals[0].misfit <= RIVAL_RATIO * best.misfit:
            apart = rivals[0].offset_s - best.offset_s
            return _unknown(
                f"the motion repeats itself: {abs(apart):.1f} s further the ATE is "
                f"{rivals[0].rms_m:.3g} m instead of {best.rms_m:.3g} m"
            )
    # again with the poses that are known around the offset, not around the candidate
    best = _refine(sparse, dense, best.offset_s, FINE_WINDOW_S) or best
    half = best.half_interval()
    if not half <= MAX_HALF_INTERVAL_S:
        return _unknown(
            "the speed hardly changes: a shift in time is as good as one in space"
            + (f" (95 %: ±{half:.2g} s)" if np.isfinite(half) else "")
        )
    interval = (best.offset_s - half, best.offset_s + half)
    reason = (
        f"Speeds correlated over all lags, then the least ATE ({best.rms_m:.3g} m after a free "
        f"similarity, {len(best.time_s)} poses)."
    )
    return TimeOffset(offset_s=best.offset_s, interval_s=interval, determinable=True, reason=reason)


def _unknown(why: str) -> TimeOffset:
    return TimeOffset(determinable=False, reason=f"The time offset is not determinable: {why}.")


@dataclass(frozen=True)
class _Speeds:
    """Speeds on a regular grid, each scaled to variance 1, and where they are known."""

    start_s: float
    values: tuple[Array, ...]
    known: BoolArray


def _grid_velocity(trajectory: Trajectory, step_s: float) -> tuple[Array, Array]:
    """Times on a regular grid from its first stamp on, and smooth velocities there."""
    time = trajectory.time_s
    grid = time[0] + step_s * np.arange(int((time[-1] - time[0]) / step_s) + 1)
    sigma = max(SMOOTHING_S, _median_step(trajectory)) / step_s
    smooth: Array = gaussian_filter1d(positions_at(trajectory, grid), sigma, axis=0, order=1)
    return grid, smooth / step_s


def _velocity(trajectory: Trajectory, time_s: Array) -> Array:
    """Velocity at times within its span, shape (n, 3); smooth, as noise is no excitation."""
    span = float(trajectory.time_s[-1] - trajectory.time_s[0])
    grid, velocity = _grid_velocity(trajectory, max(STEP_S, span / MAX_SAMPLES))
    columns = [np.interp(time_s, grid, column) for column in velocity.T]
    return np.stack(columns, axis=1)


def _speeds(trajectory: Trajectory, step_s: float, with_rotation: bool) -> _Speeds:
    """Speed (and angular speed) on a grid from its first stamp on."""
    time = trajectory.time_s
    grid, velocity = _grid_velocity(trajectory, step_s)
    # key frames are interpolated too, tracking that is lost is not
    known = bracketed(grid, time, max(10.0 * _median_step(trajectory), 0.5))
    values = [np.linalg.norm(velocity, axis=1)]
    if with_rotation and trajectory.rotation is not None:
        turned = Slerp(time, trajectory.rotation)(grid)
        rates = (turned[:-1].inv() * turned[1:]).as_rotvec() / step_s
        rates = np.concatenate((rates, rates[-1:]))
        sigma = max(SMOOTHING_S, _median_step(trajectory)) / step_s
        values.append(np.linalg.norm(gaussian_filter1d(rates, sigma, axis=0), axis=1))
    return _Speeds(float(time[0]), tuple(values), known)


def _candidates(sparse: Trajectory, dense: Trajectory, start_s: float | None) -> list[float]:
    """Offsets at which speeds correlate, best first, and the start where there is one."""
    spans = [float(one.time_s[-1] - one.time_s[0]) for one in (sparse, dense)]
    step = max(STEP_S, max(spans) / MAX_SAMPLES)
    if min(spans) < 10 * step:
        return [] if start_s is None else [start_s]
    with_rotation = sparse.rotation is not None and dense.rotation is not None
    x, y = (_speeds(one, step, with_rotation) for one in (sparse, dense))
    needed = max(MIN_OVERLAP_S, MIN_OVERLAP_SHARE * min(spans)) / step
    needed = min(needed, 0.5 * min(spans) / step)
    each = [
        _correlation(a, b, x.known, y.known, needed)
        for a, b in zip(x.values, y.values, strict=True)
    ]
    total = np.mean(each, axis=0)
    peaks = (total == maximum_filter1d(total, round(2 * APART_S / step) + 1)) & (
        total > MIN_CORRELATION
    )
    order = np.flatnonzero(peaks)
    order = order[np.argsort(-total[order])][:CANDIDATES]
    # index k: the sparse one's first sample is at the dense one's sample k - (n - 1)
    lags = (order - (len(x.known) - 1)) * step + y.start_s - x.start_s
    return [*([] if start_s is None else [start_s]), *lags.tolist()]


def _correlation(
    a: Array, b: Array, a_known: BoolArray, b_known: BoolArray, needed: float
) -> Array:
    """Correlation coefficient at every lag over the samples known in both; 0 where too few are.

    Padfield (2012), eqs. 3 to 9.
    """
    found = moments(a, b, a_known, b_known)
    # a stretch at rest correlates with anything once its variance is rounding
    usable = found.count >= needed
    for values, known, power in ((a, a_known, found.power_a), (b, b_known, found.power_b)):
        whole = float(np.var(values[known])) * np.count_nonzero(known)
        usable &= power > 1e-3 * whole / len(values) * found.count
    scale = np.sqrt(np.where(usable, found.power_a * found.power_b, 1.0))
    return np.where(usable, found.covariance.real / scale, 0.0)


@dataclass(frozen=True)
class _OffsetFit:
    """Least squares over the offset, near one candidate.

    Attributes
    ----------
    offset_s, rms_m : float
    time_s : ndarray, shape (n,)
        Of the sparse one.
    position_m, left_m : ndarray, shape (n, 3)
        Aligned position of the sparse one, and what is left to the dense one.
    velocity_m_s, other_m_s : ndarray, shape (n, 3)
        Of the dense one, and of the sparse one as aligned.
    """

    offset_s: float
    rms_m: float
    time_s: Array
    position_m: Array
    left_m: Array
    velocity_m_s: Array
    other_m_s: Array

    @property
    def misfit(self) -> float:
        """RMS of what is left over that of the motion: fits of a part do not win by moving less."""
        # of the target: an estimate that does not follow is scaled to a point
        extent = float(np.sqrt((self.position_m + self.left_m).var(axis=0).sum()))
        return max(self.rms_m / extent, MIN_MISFIT) if extent > 0.0 else float("inf")

    def half_interval(self) -> float:
        """Half of the 95 % interval (s); infinite where a shift in space does as well."""
        n = len(self.time_s)
        # what the similarity cannot take over of a shift in time: shifts, small turns, scale
        centred = self.position_m - self.position_m.mean(axis=0)
        columns = [np.tile(axis, (n, 1)) for axis in np.eye(3)]
        columns += [np.cross(axis, centred) for axis in np.eye(3)]
        absorbed = np.stack([*columns, centred], axis=-1).reshape(3 * n, 7)
        both = np.stack((self.velocity_m_s, self.other_m_s), axis=-1).reshape(3 * n, 2)
        both = both - absorbed @ np.linalg.lstsq(absorbed, both, rcond=None)[0]
        information, other = (float(power) for power in (both * both).sum(axis=0))
        agreed = float(both[:, 0] @ both[:, 1])
        moved = float((self.velocity_m_s**2).sum())
        if information <= MIN_FREE_SHARE**2 * moved or agreed <= MIN_FREE_CORRELATION * np.sqrt(
            information * other
        ):
            return float("inf")
        free = both[:, 0].reshape(n, 3)
        score = (free * self.left_m).sum(axis=1)
        # weights that fall to zero must not do so within the correlation
        lags = min(max(1, WINDOW_LENGTHS * _correlation_length(score)), n // 4)
        weights = 1.0 - np.arange(1, lags + 1) / (lags + 1.0)
        products = [float(score[k:] @ score[:-k]) for k in range(1, lags + 1)]
        variance = max(float(score @ score) + 2.0 * float(weights @ products), 0.0)
        variance = max(variance, float(score @ score))
        runs = max(n / lags - 1.0, 1.0)
        quantile = float(stdtrit(runs, 0.5 + LEVEL / 2.0))
        return quantile * float(np.sqrt(variance)) / information


def _correlation_length(values: Array) -> int:
    """First lag at which the autocorrelation is below 1/e, at most a quarter of them."""
    centred = values - values.mean()
    full = autocovariance(centred)
    below = np.flatnonzero(full < full[0] / np.e)
    return int(below[0]) if len(below) else len(values) // 4


def _refine(
    sparse: Trajectory, dense: Trajectory, lag_s: float, window_s: float
) -> _OffsetFit | None:
    """Minimise the ATE over offsets around a given one; None where too few poses overlap."""
    time, limit = sparse.time_s, max(gap_limit(dense.time_s), 0.5 * gap_limit(sparse.time_s))
    # the same poses at every offset, else the objective jumps where poses come and go
    around = (lag_s + edge for edge in (-window_s, 0.0, window_s))
    known = np.all([bracketed(time + offset, dense.time_s, limit) for offset in around], axis=0)
    chosen = np.flatnonzero(known)
    span = float(time[-1] - time[0])
    shorter = min(1.0, float(dense.time_s[-1] - dense.time_s[0]) / span)
    if len(chosen) < max(2 * MIN_POSES, MIN_POSES_SHARE * shorter * len(time)):
        return None
    chosen = chosen[:: -(-len(chosen) // MAX_POSES)]
    time, position = time[chosen], sparse.position_m[chosen]

    def aligned(shift_s: float) -> tuple[Transform, Array]:
        target = positions_at(dense, time + (lag_s + shift_s))
        # the similarity acts on the sparse one: acting on the target, its scale could fall to zero
        return umeyama(position, target, with_scale=True), target

    def cost(shift_s: float) -> float:
        transform, target = aligned(shift_s)
        left = target - transform.apply(position)
        return float((left * left).sum())

    # over the shift, not the offset: beside a difference of 50 years tolerances are seconds
    grid = window_s * np.linspace(-1.0, 1.0, 21)
    best = int(np.argmin([cost(shift) for shift in grid]))
    bracket = (grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)])
    shift = float(minimize_scalar(cost, bounds=bracket, method="bounded").x)
    offset = lag_s + shift
    transform, target = aligned(shift)
    left = target - transform.apply(position)
    return _OffsetFit(
        offset_s=offset,
        rms_m=float(np.sqrt((left * left).sum(axis=1).mean())),
        time_s=time,
        position_m=transform.apply(position),
        left_m=left,
        velocity_m_s=_velocity(dense, time + offset),
        other_m_s=transform.rotation.apply(transform.scale * _velocity(sparse, time)),
    )
