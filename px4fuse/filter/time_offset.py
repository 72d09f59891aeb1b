"""Time offset between position source and IMU, by joint maximum likelihood.

Positions whose timestamps are wrong by τ lag or lead the measured acceleration. Innovations hardly
grow, because the filter follows; the disagreement with the acceleration shows the offset. So the
likelihood of the positions is maximised over τ. The constants of :mod:`px4fuse.filter.imu_motion`
that could be confused with τ are marginalised, and the noises are maximised at every τ.

The noise of the IMU moves with τ, too: it looks like motion that the positions do not follow. That
does not bias the estimate, but increases its scatter beyond the curvature of the likelihood. The
factor is simulated, and the interval is widened by it (sandwich estimate, White 1982).
"""

from collections.abc import Callable
from functools import cache

import numpy as np
from msgspec import structs
from scipy.interpolate import CubicSpline
from scipy.special import chdtrc

from px4fuse.arrays import Array
from px4fuse.filter.fitting import Noises, fit_noises, fit_ratios, maximise_likelihood
from px4fuse.filter.imu_motion import (
    COARSE_MEASUREMENTS,
    COARSE_POINTS,
    CONSTANT_SIGMA,
    MAX_OFFSET_S,
    PreparedMotion,
    SignalCache,
    prepare_motion,
)
from px4fuse.filter.likelihood import PROFILE_DROP, parabola_vertex, profile_interval
from px4fuse.filter.marginal_likelihood import FittedPositions, products_by_stretch
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import Segment, within
from px4fuse.flight import Columns, Flight, PositionTrack, Unavailable
from px4fuse.notebook_display import one_line_repr
from px4fuse.record import Count, NotNegative, Record, Share, Span

FINE_POINTS, CURVE_POINTS = 11, 121
# Prior σ of the heading. With a wrong GNSS delay, EKF2 rotates its heading until positions agree,
# by 5° for 0.2 s: a narrow prior with GNSS would hide the time offset
HEADING_SIGMA_RAD, GNSS_HEADING_SIGMA_RAD = float(CONSTANT_SIGMA[2]), 0.2
# s; a wider interval gives no usable time offset
MAX_HALF_INTERVAL_S = 0.15
# s; parts with a larger σ are not used to detect a change
MAX_PART_SIGMA_S = 0.15
# p value below which the offsets of the parts differ significantly
MAX_CHANGE_P = 0.005
# Significance limit of an offset in σ: false alarm probability 0.3 %
OFFSET_SIGMAS = 3.0
# Simulations of the scatter due to IMU noise
SIMULATION_COUNT = 96
# Step of ln σ for the derivatives with respect to the noises
LOG_SIGMA_STEP = 0.1


class PartOffset(Record, frozen=True):
    """Time offset of one part of the flight: start, end, offset and its σ, all in s."""

    start_s: float
    end_s: float
    offset_s: float
    sigma_s: NotNegative


class Clock(Record, frozen=True, kw_only=True):
    """Seconds to add to the position source's timestamps, including the applied offset.

    Attributes
    ----------
    offset_s : float
        Maximum-likelihood estimate; negative if the timestamps are late.
    interval_s : (float, float)
        95 % profile-likelihood interval, widened by the IMU's noise.
    sigma_s : float
        Standard deviation by the curvature at the maximum, widened likewise.
    applied_s : float
        Offset already added to the timestamps.
    is_determinable : bool
        True if the interval is closed and narrow enough.
    reason : str
        Reason if not determinable, else empty.
    parts : tuple of PartOffset
        Offsets of consecutive parts.
    drift_ppm, drift_sigma_ppm : float or None
        Drift of the source's clock relative to the autopilot's; None with fewer than three parts.
    change_p_value : float or None
        p-value of a constant offset (likelihood ratio test); None with fewer than two parts.
    count : int
        Number of measurements.
    """

    offset_s: float
    interval_s: Span
    sigma_s: NotNegative
    applied_s: float
    is_determinable: bool
    reason: str = ""
    drift_ppm: float | None = None
    drift_sigma_ppm: NotNegative | None = None
    change_p_value: Share | None = None
    parts: tuple[PartOffset, ...]
    count: Count

    @property
    def remaining_s(self) -> float:
        """Offset that remains to be added beyond the applied one (s)."""
        return self.offset_s - self.applied_s

    @property
    def three_sigma_s(self) -> float:
        """Limit of a significant offset: ``OFFSET_SIGMAS`` standard deviations (s)."""
        return OFFSET_SIGMAS * self.sigma_s


class ClockOffset(Clock, frozen=True, kw_only=True, eq=False):
    """:class:`Clock` with its likelihood curve.

    Attributes
    ----------
    curve_s, curve_drop : ndarray, shape (n,)
        Offsets, and the drop of the log-likelihood at each from its maximum.
    sigma_a_m_s2, sigma_z_m : float
        Noises at the maximum.
    """

    schema_type = Clock
    curve_s: Array
    curve_drop: Array
    sigma_a_m_s2: float
    sigma_z_m: float

    __repr__ = one_line_repr


def estimate_time_offset(
    flight: Flight,
    track: PositionTrack,
    segment: Segment,
    settings: Settings,
    noises: Noises,
    outlier_time_s: Array | None = None,
    progress: Callable[[str], None] = lambda _: None,
    signals: SignalCache | None = None,
) -> ClockOffset | Unavailable:
    """Estimate the time offset to add to the timestamps of a position track.

    Parameters
    ----------
    flight : Flight
    track : PositionTrack
        As logged.
    segment : Segment
    settings : Settings
        Its ``dt_s`` defines the unit of SIGMA_A.
    noises : Noises
        Initial values without biases; with a random walk for a source that may drift (odometry).
    outlier_time_s : ndarray, optional
        Timestamps of measurements to exclude.
    progress : callable
    signals : dict, optional
        IMU signals to reuse, see :func:`px4fuse.filter.imu_motion.prepare_motion`.

    Returns
    -------
    ClockOffset, or Unavailable without IMU or attitude or with too few measurements.
    """
    # GNSS is noisier vertically, and all axes share one SIGMA_Z
    axes = 2 if track.origin.is_gnss else 3
    samples = within(track.samples, segment)[Columns.POSITION[:axes]]
    samples = samples.dropna(subset=Columns.POSITION[:2])
    if outlier_time_s is not None:
        samples = samples[~np.isin(samples.index.to_numpy(), outlier_time_s)]
    prepared_motion = prepare_motion(
        flight,
        samples.index.to_numpy(),
        samples.to_numpy(),
        directions=np.eye(3)[:axes],
        dt_s=settings.dt_s,
        signals=signals,
        heading_sigma_rad=GNSS_HEADING_SIGMA_RAD if track.origin.is_gnss else HEADING_SIGMA_RAD,
    )
    if isinstance(prepared_motion, Unavailable):
        return prepared_motion
    progress("time offset")
    coarse_motion = prepared_motion.downsample(COARSE_MEASUREMENTS)
    offset, _ = prepared_motion.search(noises)
    sigma, width = 0.0, 0.1
    for each_motion in (coarse_motion, prepared_motion):
        noises = maximise_likelihood(
            [each_motion.at(offset)], noises, each_motion.weight, outliers=False
        ).noises
        curve = _offset_grid(offset, width, FINE_POINTS)
        totals = fit_noises(each_motion.blocks(curve), noises, each_motion.weight).totals()[0]
        offset, sigma = _minimum_and_sigma(curve, totals)
        width = float(np.clip(3.5 * sigma, 0.01, MAX_OFFSET_S))
    factor = _variance_inflation(prepared_motion, offset, noises, sigma**-2.0)
    while True:
        points, curve = (
            _offset_grid(offset, width, count) for count in (FINE_POINTS, CURVE_POINTS)
        )
        profile = CubicSpline(
            points, _profile_over_noises(prepared_motion, points, noises, offset)
        )(curve)
        low, high = profile_interval(curve, profile, PROFILE_DROP * factor)
        is_closed = low is not None and high is not None
        if is_closed or width >= 2.0 * MAX_OFFSET_S:
            break
        width *= 2.0
    offset = _minimum_and_sigma(curve, profile)[0]
    # an IMU sample is the mean over its interval; its timestamp may be anywhere in it
    resolution = 0.5 * prepared_motion.imu_interval_s
    ends = curve[0] if low is None else low, curve[-1] if high is None else high
    half_widths = np.hypot(np.array(ends) - offset, 1.96 * resolution)
    low, high = float(offset - half_widths[0]), float(offset + half_widths[1])
    reason = ""
    if not is_closed or (high - low) / 2.0 > MAX_HALF_INTERVAL_S:
        range_text = f"offsets from {low:+.2f} s to {high:+.2f} s have nearly the same likelihood"
        reason = f"{range_text}: too little acceleration, or too much position noise"
    parts: tuple[PartOffset, ...] = ()
    change_p_value = None
    if not reason:
        progress("changes of the time offset")
        parts, change_p_value = _offset_per_part(prepared_motion, offset, noises, factor)
    drift, drift_sigma = _clock_drift(parts)
    applied = settings.clock_offset_s
    return ClockOffset(
        offset_s=applied + offset,
        interval_s=(applied + low, applied + high),
        applied_s=applied,
        sigma_s=float(np.hypot(sigma * np.sqrt(factor), resolution)),
        is_determinable=not reason,
        reason=reason,
        curve_s=applied + curve,
        curve_drop=profile - profile.min(),
        parts=tuple(structs.replace(part, offset_s=applied + part.offset_s) for part in parts),
        drift_ppm=drift,
        drift_sigma_ppm=drift_sigma,
        change_p_value=change_p_value,
        sigma_a_m_s2=noises.sigma_a_m_s2,
        sigma_z_m=noises.sigma_z_m,
        count=len(prepared_motion.time_s),
    )


def _offset_grid(offset: float, width: float, count: int) -> Array:
    """Return offsets from ``offset - width`` to ``offset + width``, within the search range."""
    low, high = np.clip([offset - width, offset + width], -MAX_OFFSET_S, MAX_OFFSET_S).tolist()
    return np.linspace(low, high, count)


def _profile_over_noises(
    prepared_motion: PreparedMotion, curve: Array, noises: Noises, offset: float
) -> Array:
    """Compute -ln p over offsets, with the noises maximised at each by a Newton step.

    The gradient is evaluated at each offset, the Hessian, which hardly changes, at the best one.
    """
    sigma_z, sigma_a = noises.sigma_z_m, noises.sigma_a_m_s2
    offsets = np.append(curve, offset)
    ratios = sigma_a / sigma_z * np.exp(LOG_SIGMA_STEP * np.array([-1.0, 0.0, 1.0]))

    @cache
    def fits_at_walk(walk: float) -> list[FittedPositions]:
        return fit_ratios(
            prepared_motion.blocks(offsets), ratios.tolist(), walk, prepared_motion.weight, sigma_z
        )

    def profile_at(shift_a: int, shift_z: int) -> Array:
        scale = sigma_z * float(np.exp(LOG_SIGMA_STEP * shift_z))
        fit = fits_at_walk(noises.walk_m / scale)[1 + shift_a - shift_z]
        return np.asarray(fit.totals(np.array([scale]))[0])

    centre = profile_at(0, 0)
    forward, backward = (np.array([profile_at(sign, 0), profile_at(0, sign)]) for sign in (1, -1))
    slope = (forward - backward)[:, :-1] / (2.0 * LOG_SIGMA_STEP)
    hessian = np.diag((forward + backward)[:, -1] - 2.0 * centre[-1])
    mixed = profile_at(1, 1)[-1] + profile_at(-1, -1)[-1] - 2.0 * centre[-1]
    hessian[0, 1] = hessian[1, 0] = 0.5 * (mixed - hessian[0, 0] - hessian[1, 1])
    hessian /= LOG_SIGMA_STEP**2
    if np.any(np.linalg.eigvalsh(hessian) <= 0.0):  # SIGMA_A is at the end of its search range
        return centre[:-1]
    gain = 0.5 * np.einsum("it,ij,jt->t", slope, np.linalg.inv(hessian), slope)
    return np.asarray(centre[:-1] - gain)


def _variance_inflation(
    prepared_motion: PreparedMotion, offset: float, noises: Noises, information: float
) -> float:
    """Ratio of the estimate's variance to that from the curvature, from simulated noise.

    The score of τ is eᵀM(v + n): e the residuals, v the velocity, n the velocity noise of the IMU,
    M the inverse covariance with the constants marginalised. Its part eᵀMn is random even without
    motion, and e contains the same noise.
    """
    positions = prepared_motion.at(offset)
    joined, count, axes = (
        positions.joined,
        len(prepared_motion.time_s),
        len(prepared_motion.directions),
    )
    interval_count, rng = int(np.count_nonzero(joined)), np.random.default_rng(count)

    def draw_normal(size: int) -> Array:
        return rng.standard_normal((size, axes, SIMULATION_COUNT)).transpose(1, 2, 0)

    q00, q01, q11 = noises.sigma_a_m_s2**2 * positions.noise_unit[:, joined]
    dp, dv = np.zeros((2, axes, SIMULATION_COUNT, count - 1))
    dp[..., joined] = np.sqrt(q00) * draw_normal(interval_count)
    dv[..., joined] = np.sqrt(q11 - q01**2 / q00) * draw_normal(interval_count)
    dv[..., joined] += q01 / q00 * dp[..., joined]
    error = noises.sigma_z_m * draw_normal(count)
    # velocity noise from the start of each stretch
    speed = np.zeros_like(error)
    for begin, end in positions.stretches:
        np.cumsum(dv[..., begin : end - 1], axis=-1, out=speed[..., begin + 1 : end])
    if noises.walk_m:  # random walk of the source: in the residuals, not in the IMU
        dp[..., joined] += (
            noises.walk_m * np.sqrt(positions.length_s[joined]) * draw_normal(interval_count)
        )
    positions, variance = positions.over(
        1.0, noises.walk_m, prepared_motion.weight / noises.sigma_z_m**2
    )
    products = products_by_stretch(positions, noises.sigma_a_m_s2, variance, (error, dp, dv), speed)
    return 1.0 + float(np.var(products.sum(axis=0))) / information


def _minimum_and_sigma(grid: Array, profile: Array) -> tuple[float, float]:
    """Return the minimum of a profile (parabola) and the σ from its curvature."""
    index = int(np.clip(np.argmin(profile), 1, len(grid) - 2))
    step = grid[1] - grid[0]
    shift, curvature = parabola_vertex(profile, index)
    if curvature <= 0.0:
        return float(grid[int(np.argmin(profile))]), float(grid[-1] - grid[0])
    return float(grid[index] + np.clip(shift, -1.0, 1.0) * step), float(step / np.sqrt(curvature))


def _offset_per_part(
    prepared_motion: PreparedMotion, offset: float, noises: Noises, factor: float
) -> tuple[tuple[PartOffset, ...], float | None]:
    """Estimate the offset of each stretch, and the p-value of a constant offset."""
    coarse = offset + np.linspace(-MAX_OFFSET_S, MAX_OFFSET_S, COARSE_POINTS)
    coarse = coarse[np.abs(coarse) <= MAX_OFFSET_S]
    coarse_profiles = fit_noises(
        prepared_motion.blocks(coarse), noises, prepared_motion.weight
    ).by_stretch()[0]
    grid = np.linspace(coarse[0], coarse[-1], CURVE_POINTS)
    profiles = CubicSpline(coarse, coarse_profiles, axis=1)(grid)
    part_offsets, drops = [], []
    for begin, end, profile in zip(
        prepared_motion.edges, prepared_motion.edges[1:], profiles, strict=False
    ):
        middle, sigma = _minimum_and_sigma(grid, profile)
        sigma *= float(np.sqrt(factor))
        if sigma < MAX_PART_SIGMA_S:
            first, last = prepared_motion.time_s[[begin, end - 1]].tolist()
            part_offsets.append(PartOffset(first, last, middle, sigma))
            drops.append(profile - profile.min())
    if len(part_offsets) < 2:
        return tuple(part_offsets), None
    ratio = 2.0 * float(np.sum(drops, axis=0).min()) / factor
    return tuple(part_offsets), float(chdtrc(len(part_offsets) - 1, ratio))


def _clock_drift(part_offsets: tuple[PartOffset, ...]) -> tuple[float | None, float | None]:
    """Return the drift of the source's clock (ppm) and its standard deviation."""
    if len(part_offsets) < 3:
        return None, None
    rows = [
        ((part_offset.start_s + part_offset.end_s) / 2.0, part_offset.offset_s, part_offset.sigma_s)
        for part_offset in part_offsets
    ]
    time, offset, sigma = np.transpose(rows)
    line, covariance = np.polyfit(time - time.mean(), offset, 1, w=1.0 / sigma, cov="unscaled")
    return float(line[0]) * 1e6, float(np.sqrt(covariance[0, 0])) * 1e6
