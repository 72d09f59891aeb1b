"""Clock offset between the position source and the IMU, by joint maximum likelihood.

Positions whose stamps are wrong by τ lag or lead what the IMU felt. Innovations hardly grow, since
the filter follows; what shows is that they agree with the acceleration. So the likelihood of the
positions is maximised over τ, jointly with everything that could pass for it: the constants of
:mod:`px4fuse.filter.motion` are marginalised, and the noises are maximised at every τ.

The IMU is noisy, and its noise moves with τ too: it looks like motion that the positions do not
follow. The estimate is not biased by that (the noise of the velocity is as often ahead as behind),
but it scatters more than the likelihood's curvature says. By how much is simulated, and the
interval is as much wider (a sandwich estimate: White 1982).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.special import chdtrc

from px4fuse.arrays import Array
from px4fuse.display import Shown
from px4fuse.filter.chain import Columns
from px4fuse.filter.fitting import (
    NoiseFit,
    Noises,
    Part,
    arguments,
    most_likely,
    over_sigma_z,
)
from px4fuse.filter.lanes import gains, lanes_of_paths
from px4fuse.filter.likelihood import PROFILE_DROP, parabola_vertex, profile_interval
from px4fuse.filter.marginal import Fitted, Positions, centred, paired_products
from px4fuse.filter.motion import CONSTANT_SIGMA, SEARCH_S, Made, PreparedMotion, motion
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import Segment, within
from px4fuse.flight import POSITION_COLUMNS, Flight, PositionTrack, Unavailable
from px4fuse.record import Count, NotNegative, Record, Share, Span

COARSE_POINTS, FINE_POINTS, CURVE_POINTS = 25, 11, 121
# Enough to find the offset roughly
COARSE_MEASUREMENTS = 600
MIN_MEASUREMENTS = 30
# A wider interval says nothing that a student could use
MAX_HALF_INTERVAL_S = 0.15
# A part that says less than this about its own offset (s) says nothing about a change
MAX_PART_SIGMA_S = 0.15
# Parts further apart than chance would put them (two-sided)
CHANGE_P = 0.005
# Standard deviations beyond which an offset is not chance: 0.3 % of clean flights lie there
SURE_SIGMAS = 3.0
# Flights simulated for the scatter that the IMU's noise adds
REPLICATES = 96
# Of these so many are weighed together: whitened they are twice as long
REPLICATES_AT_ONCE = 16
# Numbers of signals that are made at once
BLOCK = 2**18
# Steps of ln σ by which the noises are tried at every offset
NOISE_STEP = 0.1


class PartOffset(Record, frozen=True):
    """Offset of one part of the flight: start, end, offset and its standard deviation, all s."""

    start_s: float
    end_s: float
    offset_s: float
    sigma_s: NotNegative


class Clock(Record, frozen=True, kw_only=True):
    """What must be added to the position source's own stamps, what was applied included.

    Attributes
    ----------
    offset_s : float
        Most likely; negative where the stamps are late.
    interval_s : (float, float)
        95 % profile-likelihood interval, widened by the IMU's noise.
    sigma_s : float
        Standard deviation by the curvature at the maximum, widened likewise.
    applied_s : float
        What was added to the stamps before this was found.
    determinable : bool
        Whether the interval is narrow enough, and closed, to say anything.
    reason : str
        Why not, where it is not; else empty.
    parts : tuple of PartOffset
        Offsets of consecutive parts.
    drift_ppm, drift_sigma_ppm : float or None
        Of the source's clock against the autopilot's, from the parts; None with fewer than three.
    change_p : float or None
        p-value of "all parts have the same offset", by the likelihood ratio; None with fewer than
        two parts.
    count : int
        Measurements.
    """

    offset_s: float
    interval_s: Span
    sigma_s: NotNegative
    applied_s: float
    determinable: bool
    reason: str = ""
    drift_ppm: float | None = None
    drift_sigma_ppm: NotNegative | None = None
    change_p: Share | None = None
    parts: tuple[PartOffset, ...]
    count: Count

    @property
    def remaining_s(self) -> float:
        """What must still be added, beyond what was applied (s)."""
        return self.offset_s - self.applied_s

    @property
    def chance_s(self) -> float:
        """How far chance may take it from the truth: ``SURE_SIGMAS`` standard deviations (s)."""
        return SURE_SIGMAS * self.sigma_s


class ClockOffset(Shown, Clock, frozen=True, kw_only=True, eq=False):
    """:class:`Clock`, with the likelihood that it was found from.

    Attributes
    ----------
    curve_s, curve_drop : ndarray, shape (n,)
        Offsets, and how far each lies below the greatest log-likelihood.
    interval_drop : float
        How far below it the interval reaches: more than chi-square says, by the IMU's noise.
    sigma_a_m_s2, sigma_z_m : float
        Noises at the maximum.
    """

    written_as = Clock
    curve_s: Array
    curve_drop: Array
    interval_drop: float
    sigma_a_m_s2: float
    sigma_z_m: float


@dataclass(frozen=True)
class _Problem:
    """Positions over the IMU's motion, with everything but the offset and the noises chosen."""

    motion: PreparedMotion
    positions_m: Array
    directions: Array
    dt_s: float

    @cached_property
    def positions(self) -> Positions:
        return self.motion.positions(self.positions_m, self.dt_s)

    def part(self, offset_s: Array | float) -> Part:
        legs = self.motion.legs(self.directions, np.atleast_1d(offset_s))
        return Part(*centred(self.positions, *legs, scaled=True))

    def fitted(self, offset_s: Array | float, noises: Noises) -> Fitted:
        sigma = noises.sigma_z_m
        ratio, walk = noises.sigma_a_m_s2 / sigma, noises.walk_m / sigma
        return self.of_ratios(np.atleast_1d(offset_s), [ratio], walk, sigma)[0].scaled(sigma)

    def of_ratios(
        self, offset_s: Array, ratios: list[float], walk: float, sigma_z_m: float
    ) -> list[Fitted]:
        """Fit at some offsets, a few at a time: their signals are long."""
        count = len(self.motion.time_s)
        each = max(1, BLOCK // (count * len(self.directions) * (1 + len(CONSTANT_SIGMA))))
        positions, variance = over_sigma_z(self.positions, walk, np.ones(count), sigma_z_m)
        steps = gains(positions, ratios, variance)
        paths = (
            self.motion.paths(self.directions, offset_s[at : at + each])
            for at in range(0, len(offset_s), each)
        )
        made = [lanes_of_paths(self.positions, path).fit(steps) for path in paths]
        return [
            replace(of_one[0], gram=np.concatenate([part.gram for part in of_one], axis=1))
            for of_one in zip(*made, strict=True)
        ]


def estimate_clock_offset(
    flight: Flight,
    track: PositionTrack,
    segment: Segment,
    settings: Settings,
    noises: Noises,
    outlier_time_s: Array | None = None,
    progress: Callable[[str], None] = lambda _: None,
    made: Made | None = None,
) -> ClockOffset | Unavailable:
    """Estimate what must be added to the stamps of a position track.

    Parameters
    ----------
    flight : Flight
    track : PositionTrack
        As logged.
    segment : Segment
    settings : Settings
        ``dt_s`` gives SIGMA_A its meaning.
    noises : Noises
        To start with, biases taken out; a walk where the source may wander by itself, as odometry
        does.
    outlier_time_s : ndarray, optional
        Measurements to leave out.
    progress : callable
    made : dict, optional
        As :func:`px4fuse.filter.motion.motion` has it.

    Returns
    -------
    ClockOffset, or Unavailable where there is no IMU, no attitude or too few measurements.
    """
    if isinstance(flight.imu, Unavailable):
        return flight.imu
    if isinstance(flight.attitude, Unavailable):
        return flight.attitude
    samples = within(track.samples, segment)[POSITION_COLUMNS].dropna(subset=POSITION_COLUMNS[:2])
    if outlier_time_s is not None and len(outlier_time_s):
        samples = samples[~np.isin(samples.index.to_numpy(), outlier_time_s)]
    moved = motion(flight.imu, flight.attitude, samples.index.to_numpy(), made)
    count = 0 if moved is None else len(moved.time_s)
    if moved is None or count < MIN_MEASUREMENTS:
        return Unavailable(
            "clock offset",
            f"{count} measurements with IMU and attitude are too few (at least {MIN_MEASUREMENTS})",
            "Analyse a longer segment.",
        )
    progress("clock offset")
    problem = _Problem(moved, samples.to_numpy(), np.eye(3), settings.dt_s)
    offset = _coarse(problem, noises)
    sigma, width = 0.0, 0.1
    for _ in range(2):
        noises = _noises(problem, offset, noises)
        ends = np.clip([offset - width, offset + width], -SEARCH_S, SEARCH_S)
        curve = np.linspace(ends[0], ends[1], FINE_POINTS)
        profile = problem.fitted(curve, noises).total()
        offset, sigma = _vertex(curve, profile)
        width = float(np.clip(3.5 * sigma, 0.01, SEARCH_S))
    factor = _scatter(problem, offset, noises, sigma**-2.0)
    while True:
        ends = np.clip([offset - width, offset + width], -SEARCH_S, SEARCH_S)
        points = np.linspace(ends[0], ends[1], FINE_POINTS)
        curve = np.linspace(ends[0], ends[1], CURVE_POINTS)
        profile = CubicSpline(points, _profiled(problem, points, noises, offset))(curve)
        low, high = profile_interval(curve, profile, PROFILE_DROP * factor)
        closed = low is not None and high is not None
        if closed or width >= 2.0 * SEARCH_S:
            break
        width *= 2.0
    offset = _vertex(curve, profile)[0]
    # an IMU sample is the mean over its interval, stamped somewhere in it
    resolution = 0.5 * float(np.median(np.diff(flight.imu.index.to_numpy())))
    interval = curve[0] if low is None else low, curve[-1] if high is None else high
    widened = np.hypot(np.array(interval) - offset, 1.96 * resolution)
    interval = float(offset - widened[0]), float(offset + widened[1])
    reason = ""
    if not closed or (interval[1] - interval[0]) / 2.0 > MAX_HALF_INTERVAL_S:
        reason = (
            f"the positions fit offsets from {interval[0]:+.2f} s to {interval[1]:+.2f} s almost "
            "equally well: too little acceleration, or too noisy a source"
        )
    parts: tuple[PartOffset, ...] = ()
    change_p = None
    if not reason:
        progress("changes of the clock")
        parts, change_p = _parts(problem, offset, noises, factor)
    drift, drift_sigma = _drift(parts)
    applied = settings.clock_offset_s
    return ClockOffset(
        offset_s=applied + offset,
        interval_s=(applied + interval[0], applied + interval[1]),
        applied_s=applied,
        sigma_s=float(np.hypot(sigma * np.sqrt(factor), resolution)),
        determinable=not reason,
        reason=reason,
        curve_s=applied + curve,
        curve_drop=profile - profile.min(),
        interval_drop=PROFILE_DROP * factor,
        parts=tuple(
            PartOffset(part.start_s, part.end_s, applied + part.offset_s, part.sigma_s)
            for part in parts
        ),
        drift_ppm=drift,
        drift_sigma_ppm=drift_sigma,
        change_p=change_p,
        sigma_a_m_s2=noises.sigma_a_m_s2,
        sigma_z_m=noises.sigma_z_m,
        count=count,
    )


def _coarse(problem: _Problem, noises: Noises) -> float:
    """Offset of greatest likelihood over the whole search, from some of the measurements."""
    some = problem.motion.thinned(COARSE_MEASUREMENTS) or problem.motion
    grid = np.linspace(-SEARCH_S, SEARCH_S, COARSE_POINTS)
    return float(grid[np.argmin(replace(problem, motion=some).fitted(grid, noises).total())])


def _noises(problem: _Problem, offset: float, start: Noises) -> Noises:
    weight = np.ones(len(problem.motion.time_s))
    found: NoiseFit = most_likely([problem.part(offset)], start, weight, outliers=False)
    return found.noises


def _profiled(problem: _Problem, curve: Array, noises: Noises, offset: float) -> Array:
    """-ln p over offsets, the noises maximised at each by a Newton step from the best ones.

    The step's slopes are taken at each offset; the bends, which hardly change, at the best one.
    """
    sigma_z, sigma_a = noises.sigma_z_m, noises.sigma_a_m_s2
    offsets = np.append(curve, offset)
    ratios = sigma_a / sigma_z * np.exp(NOISE_STEP * np.array([-1.0, 0.0, 1.0]))
    fits = cache(lambda walk: problem.of_ratios(offsets, ratios.tolist(), walk, sigma_z))

    def at(shift_a: int, shift_z: int) -> Array:
        scale = sigma_z * float(np.exp(NOISE_STEP * shift_z))
        found: Fitted = fits(noises.walk_m / scale)[1 + shift_a - shift_z]
        return np.asarray(found.totals(np.array([scale]))[0])

    made = at(0, 0)
    ahead, back = (np.array([at(sign, 0), at(0, sign)]) for sign in (1, -1))
    slope = (ahead - back)[:, :-1] / (2.0 * NOISE_STEP)
    bend = np.diag((ahead + back)[:, -1] - 2.0 * made[-1])
    both = at(1, 1)[-1] + at(-1, -1)[-1] - 2.0 * made[-1]
    bend[0, 1] = bend[1, 0] = 0.5 * (both - bend[0, 0] - bend[1, 1])
    bend /= NOISE_STEP**2
    made = made[:-1]
    if np.any(np.linalg.eigvalsh(bend) <= 0.0):  # SIGMA_A at the end of its search
        return made
    gain = 0.5 * np.einsum("it,ij,jt->t", slope, np.linalg.inv(bend), slope)
    return np.asarray(made - gain)


def _scatter(problem: _Problem, offset: float, noises: Noises, information: float) -> float:
    """Variance of the estimate over that by the curvature alone, from simulated noise.

    The score of τ is eᵀM(v + n): e the residuals, v the velocity, n the noise of the velocity that
    the IMU measures, M the inverse covariance with the constants taken out. Its part eᵀMn is
    random even where nothing moves, and e holds the same noise.
    """
    part = problem.part(offset)
    chain, count = part.positions.chain, len(problem.motion.time_s)
    axes = len(problem.directions)
    rng = np.random.default_rng(count)
    q00, q01, q11 = (noises.sigma_a_m_s2**2 * chain.noise_unit).T[:, :, None, None]
    # the noise of each leg, made in place: these are the longest signals of all
    dp, dv = rng.standard_normal((2, len(q00), axes, REPLICATES))
    dv *= np.sqrt(q11 - q01**2 / q00)
    dp *= np.sqrt(q00)
    dv += q01 / q00 * dp
    error = rng.standard_normal((count, axes, REPLICATES))
    error *= noises.sigma_z_m
    if noises.walk_m:  # the source's own walk is in the residuals, but nothing the IMU measured
        walk = noises.walk_m * np.sqrt(chain.length_s)[:, None, None]
        dp += walk * rng.standard_normal(dp.shape)
    given = arguments(part, noises, np.ones(count))
    still = np.broadcast_to(0.0, (axes, REPLICATES_AT_ONCE, len(q00)))

    def some(first: int) -> tuple[Columns, Columns]:
        """Some of the errors, and of the noise of the velocity that goes with each."""
        own = slice(first, first + REPLICATES_AT_ONCE)
        moved = Columns(*(np.transpose(each[..., own], (1, 2, 0)) for each in (error, dp, dv)))
        speed = np.zeros(moved.measurement_m.shape)
        speed[..., chain.end] = moved.delta_velocity_m_s
        for begin, end in zip(problem.motion.edges, problem.motion.edges[1:], strict=False):
            np.cumsum(speed[..., begin:end], axis=-1, out=speed[..., begin:end])
        return moved, Columns(speed, still, still)

    score = paired_products(*given, map(some, range(0, REPLICATES, REPLICATES_AT_ONCE)))
    return 1.0 + float(np.var(score.sum(axis=0))) / information


def _vertex(grid: Array, profile: Array) -> tuple[float, float]:
    """Minimum of a profile by a parabola, and the standard deviation that its bend gives."""
    at = int(np.clip(np.argmin(profile), 1, len(grid) - 2))
    step = grid[1] - grid[0]
    shift, bend = parabola_vertex(profile, at)
    if bend <= 0.0:
        return float(grid[int(np.argmin(profile))]), float(grid[-1] - grid[0])
    return float(grid[at] + np.clip(shift, -1.0, 1.0) * step), float(step / np.sqrt(bend))


def _parts(
    problem: _Problem, offset: float, noises: Noises, factor: float
) -> tuple[tuple[PartOffset, ...], float | None]:
    """Offset of each stretch by itself, and the p-value of no change, by the likelihood ratio."""
    grid = offset + np.linspace(-SEARCH_S, SEARCH_S, 2 * COARSE_POINTS - 1)
    grid = grid[np.abs(grid) <= SEARCH_S]  # at equal steps, as the parabolas need them
    profiles = problem.fitted(grid, noises).by_stretch()
    found, used = [], []
    for begin, end, profile in zip(
        problem.motion.edges, problem.motion.edges[1:], profiles, strict=False
    ):
        middle, sigma = _vertex(grid, profile)
        sigma *= float(np.sqrt(factor))
        if sigma < MAX_PART_SIGMA_S:
            time = problem.motion.time_s[[begin, end - 1]]
            found.append(PartOffset(float(time[0]), float(time[1]), middle, sigma))
            used.append(profile)
    if len(found) < 2:
        return tuple(found), None
    drops = np.array(used) - np.min(used, axis=1)[:, None]
    ratio = 2.0 * float(drops.sum(axis=0).min()) / factor
    return tuple(found), float(chdtrc(len(found) - 1, ratio))


def _drift(parts: tuple[PartOffset, ...]) -> tuple[float | None, float | None]:
    """Drift of the source's clock (ppm) with its standard deviation."""
    if len(parts) < 3:
        return None, None
    offset = np.array([part.offset_s for part in parts])
    weight = np.array([part.sigma_s for part in parts]) ** -2.0
    time = np.array([(part.start_s + part.end_s) / 2.0 for part in parts])
    centred = time - np.sum(weight * time) / np.sum(weight)
    spread = np.sum(weight * centred**2)
    drift = float(np.sum(weight * centred * offset) / spread)
    return drift * 1e6, float(spread**-0.5) * 1e6
