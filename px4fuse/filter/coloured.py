"""Whether the errors of successive positions hang together: a low pass, or a slow error.

All models are judged by the likelihood of the same positions over the motion that the IMU has, with
its biases, its tilt and the scale taken out (:mod:`px4fuse.filter.motion`), and each with the
noises that make it most likely: the two-state filter's SIGMA_A, which has to cover the biases,
would hide what is slow.

A low pass of first order, z_k = (1 - ρ) u_k + ρ z_(k-1), ρ = exp(-Δt/τ), makes the noise of
successive positions agree and the positions lag behind the motion. Undone, u_k = (z_k - ρ z_(k-1))
/ (1 - ρ), it gives back positions whose noise is white and which do not lag. So the likelihood of
what was sent is that of u, times the Jacobian Π 1/(1 - ρ) of undoing it.

A slow error of first order, c_k = ρ c_(k-1) + √(1 - ρ²) σ_c w, is a third state that the
measurement sees: z = p + c + v. It hangs together too, but lags behind nothing. Both are tried with
the stamps as they are, and a slow error also with the clock offset that was found, the other
reading of a lag.

What is much slower than a second passes for an error of the IMU, so that such a time constant is a
lower bound. A truth shows the errors themselves, and judges them where there is one: by their own
likelihood, what a turned, moved or scaled frame and late stamps would add to them taken out
(restricted likelihood, Patterson and Thompson 1971).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import pandas as pd
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize_scalar

from px4fuse.arrays import Array
from px4fuse.filter.causes import Jump, steps
from px4fuse.filter.fitting import NoiseFit, Noises, fitted, most_likely
from px4fuse.filter.likelihood import PROFILE_DROP
from px4fuse.filter.motion import PreparedMotion, SignalCache, motion
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import Axis, too_few
from px4fuse.flight import Flight, Unavailable

MIN_MEASUREMENTS = 100
# Longer flights are judged by their middle, which is enough
MAX_MEASUREMENTS = 2000
# Intervals longer than this many median ones begin anew: the low pass has forgotten
GAP_INTERVALS = 3.0
# A first look for slow errors: τ, share of SIGMA_Z's variance, SIGMA_A and all noises over those
# without one
LOOK_TAUS_S, LOOK_SHARES, LOOK_SIGMA_A = (0.2, 0.6, 2.0, 6.0), (0.12, 0.35, 0.8), (0.4, 0.9)
LOOK_SCALES = np.geomspace(0.7, 1.6, 12)
LOOK_MEASUREMENTS = 1000
# What it must find for more to be done, and what more must find: less is chance
LOOK_NATS, LEAST_NATS = 0.5, 2.0
# What a slow error with a clock offset must explain beyond a low pass, whose lag is its own: 1 for
# each of its two further numbers (Akaike 1974)
OFFSET_NATS = 2.0
# Time constants of a low pass, and how near in ln τ is near enough
LOW_PASS_S, LOG_TAU_STEP = (0.02, 3.0), 0.05
# Against a truth: at most so many measurements, what must be gained (a likelihood ratio of 150 for
# two more numbers), how near a sample of it must be (s: between them, at 2 m/s², it is known to
# 1 cm), time constants and shares
TRUTH_MEASUREMENTS, TRUTH_NATS, TRUTH_AWAY_S = 300, 5.0, 0.1
# Parts of the flight with a clock offset each, which may change
CLOCK_PARTS = 12
TRUTH_TAUS_S, TRUTH_SHARES = np.geomspace(0.3, 80.0, 17), np.linspace(0.05, 0.999, 20)


@dataclass(frozen=True)
class Smoothing:
    """A low pass in the source.

    Attributes
    ----------
    correlation : float
        Of the noise of successive positions; 0 where there is no low pass.
    lag_s : float
        By how much positions come behind a steady motion, Δt ρ / (1 - ρ): less than the time
        constant, by about half an interval.
    gain_nats : float
        Log-likelihood above that of no low pass, with the stamps as they are or moved.
    sigma_z_m : float
        White noise of a single position before the low pass.
    """

    correlation: float
    lag_s: float
    gain_nats: float
    sigma_z_m: float


@dataclass(frozen=True)
class Coloured:
    """A slow error beside the white noise of the positions.

    Attributes
    ----------
    tau_s : float
        Time in which it forgets itself.
    low_s, high_s : float
        Where that lies: 95 % by a truth; over the IMU it may be any longer (infinity).
    slow_m, white_m : float
        Standard deviations of both parts, per axis.
    gain_nats : float
        Log-likelihood above that of white noise alone.
    lag_nats : float
        What a low pass, which lags, explains beyond that, :data:`OFFSET_NATS` more where the slow
        error asks for a clock offset besides.
    """

    tau_s: float
    low_s: float
    high_s: float
    slow_m: float
    white_m: float
    gain_nats: float
    lag_nats: float

    @property
    def share(self) -> float:
        """Share of the variance that is slow."""
        return self.slow_m**2 / (self.slow_m**2 + self.white_m**2)


def hanging_together(
    flight: Flight,
    axes: tuple[Axis, ...],
    settings: Settings,
    noises: Noises,
    *,
    outlier_time_s: Array,
    clock_offset_s: float,
    jumps: Sequence[Jump] = (),
) -> tuple[Smoothing, Coloured | Unavailable] | Unavailable:
    """Look for a low pass and for a slow error of the source.

    Parameters
    ----------
    flight : Flight
    axes : tuple of Axis
        With the same measurement times.
    settings : Settings
        ``dt_s`` gives SIGMA_A its meaning.
    noises : Noises
        About the most likely ones with neither.
    outlier_time_s : ndarray
        Measurements to leave out.
    clock_offset_s : float
        What would have to be added to the stamps if there were neither.
    jumps : sequence of Jump
        Steps of the source along these axes, which are taken out.
    """
    time = axes[0].measurement_time_s
    if len(time) < MIN_MEASUREMENTS:
        return too_few("errors that hang together", len(time), MIN_MEASUREMENTS)
    first = max(0, (len(time) - MAX_MEASUREMENTS) // 2)
    part = slice(first, first + MAX_MEASUREMENTS)
    time, sent = time[part], np.column_stack([axis.measurement_m[part] for axis in axes])
    for jump in jumps:
        sent = sent - np.outer(time >= jump.time_s, [step.value for step in jump.step_m])
    interval, bad = np.diff(time, prepend=time[0]), np.isin(time, outlier_time_s)
    known = (interval < GAP_INTERVALS * np.median(interval[1:])) & (interval > 0.0)
    directions, signals = np.array([axis.direction for axis in axes]), SignalCache()

    def over_imu(tau_s: float) -> tuple[PreparedMotion | Unavailable, float]:
        """Positions with a low pass undone, and what undoing it adds to -ln p."""
        rho = np.where(known, np.exp(-interval / tau_s), 0.0) if tau_s else np.zeros(len(time))
        before = np.concatenate([sent[:1], sent[:-1]])
        undone = (sent - rho[:, None] * before) / (1.0 - rho)[:, None]
        # what was undone with an outlier is one too: left out of all models, which are compared
        kept = ~(bad | (known & np.concatenate([[False], bad[:-1]])))
        moved = motion(
            flight,
            time[kept],
            undone[kept],
            directions=directions,
            dt_s=settings.dt_s,
            signals=signals,
        )
        if isinstance(moved, Unavailable):
            return moved, 0.0
        # nothing is known of where a stretch begins: the first one says nothing
        used = np.isin(time, np.delete(moved.time_s, moved.edges[:-1]))
        return moved, len(axes) * float(np.sum(np.log1p(-rho[used])))

    moved, _ = over_imu(0.0)
    if isinstance(moved, Unavailable):
        return moved
    offsets = sorted({0.0, clock_offset_s})
    sigma, some = noises.sigma_z_m, moved.thinned(LOOK_MEASUREMENTS)
    smooth = Smoothing(0.0, 0.0, 0.0, sigma)
    slower = [
        replace(noises, sigma_z_m=sigma * (1.0 - share) ** 0.5, slow_m=sigma * share**0.5, tau_s=of)
        for share, of in product(LOOK_SHARES, LOOK_TAUS_S)
    ]
    (least, _), (found, begin) = (_best_of(some, offsets, tried) for tried in ([noises], slower))
    what = "slow errors of the source"
    neither = Unavailable(what, "its errors do not hang together", "")
    if least - found < LOOK_NATS:
        return smooth, neither
    (white, _), (slow, late_s) = (
        min(((_most_likely(moved, at, start), at) for at in offsets), key=lambda e: _score(e[0]))
        for start in (noises, begin)
    )
    plain, alone, found = _score(white), white.noises, _score(slow)
    if plain - found < LEAST_NATS:  # of a low pass, a slow error explains much as well
        return smooth, neither

    def undone(log_tau: float) -> tuple[float, Noises]:
        moved, more = over_imu(float(np.exp(log_tau)))
        assert not isinstance(moved, Unavailable)  # it was not, of the same measurements
        found = _most_likely(moved, 0.0, alone)
        return _score(found) + more, found.noises

    low, high = np.log(LOW_PASS_S).tolist()
    log_tau = minimize_scalar(
        lambda at: undone(at)[0], bounds=(low, high), options={"xatol": LOG_TAU_STEP}
    ).x
    (score, before), tau_s = undone(log_tau), float(np.exp(log_tau))
    if score < plain:
        correlation = float(np.exp(-np.median(np.diff(time)) / tau_s))
        lag_s = float(np.median(np.diff(time))) * correlation / (1.0 - correlation)
        smooth = Smoothing(correlation, lag_s, plain - score, before.sigma_z_m)
    likely, lag_nats = slow.noises, found - score + (OFFSET_NATS if late_s else 0.0)
    sizes = likely.slow_m, likely.sigma_z_m, plain - found, lag_nats
    return smooth, Coloured(likely.tau_s, likely.tau_s, np.inf, *sizes)


def against_truth(
    axes: Sequence[Axis],
    truths: Sequence[pd.DataFrame],
    outlier_time_s: Array,
    clock_offset_s: float,
    jumps: Sequence[Jump],
    by_imu: Coloured | Unavailable,
) -> Coloured | Unavailable:
    """A slow error in the positions' errors against a truth, where that says more than the IMU.

    Parameters
    ----------
    axes, outlier_time_s, clock_offset_s, jumps
        As :func:`hanging_together` has them.
    truths : sequence of DataFrame
        True ``position_m`` along each axis.
    by_imu : Coloured or Unavailable
        What :func:`hanging_together` found, with the lag that only it can tell.
    """
    least, lag_nats = TRUTH_NATS, 0.0
    if isinstance(by_imu, Coloured):
        least, lag_nats = max(TRUTH_NATS, by_imu.gain_nats), by_imu.lag_nats
    place = pd.concat([truth["position_m"] for truth in truths], axis=1).dropna()
    time = np.setdiff1d(axes[0].measurement_time_s, outlier_time_s)
    time = time[place.index.get_indexer(pd.Index(time), "nearest", tolerance=TRUTH_AWAY_S) >= 0]
    time = time[:: max(1, -(-len(time) // TRUTH_MEASUREMENTS))]
    if len(time) < MIN_MEASUREMENTS:
        return by_imu
    sent = np.transpose([a.measurement_m[np.isin(a.measurement_time_s, time)] for a in axes])
    track = CubicSpline(place.index, place)
    true, speed = (track(time + clock_offset_s, order) for order in (0, 1))
    part = np.eye(CLOCK_PARTS)[CLOCK_PARTS * np.arange(len(time)) // len(time)]
    late = np.einsum("tp,ta->tpa", part, speed).reshape(len(time), -1)
    jumped = steps(time, [jump.time_s for jump in jumps])
    taken = np.column_stack([np.ones_like(time), true, late, jumped])
    rest = np.linalg.qr(taken, mode="complete")[0][:, taken.shape[1] :]
    error, share, fits = rest.T @ (sent - true), TRUTH_SHARES, []
    half = 0.5 * np.array([len(axes), len(error)])
    for tau in TRUTH_TAUS_S:
        slow = rest.T @ np.exp(-np.abs(time[:, None] - time) / tau) @ rest
        spread, turn = np.linalg.eigh(slow)
        variance = 1.0 - share + share * spread[:, None]
        square = ((turn.T @ error) ** 2).T @ (1.0 / variance) / len(error)
        score = half @ [np.log(variance).sum(axis=0), np.log(square).sum(axis=0)]
        fits.append((score, square.mean(axis=0)))
    score, square = np.transpose(fits, (1, 0, 2))  # by time constant and share
    at, of = divmod(int(np.argmin(score)), len(share))
    gain = half[1] * np.log(np.mean(error**2, axis=0)).sum() - score.min(axis=1)
    if gain.max() < least:
        return by_imu
    first, last = np.flatnonzero(gain > gain.max() - PROFILE_DROP)[[0, -1]]
    # the ends lie between time constants that were tried
    tau_s = np.append(TRUTH_TAUS_S, np.inf)[[at, max(first - 1, 0), last + 1]]
    sizes_m = np.sqrt(square[at, of] * np.array([share[of], 1.0 - share[of]]))
    return Coloured(*np.concatenate([tau_s, sizes_m, [gain.max(), lag_nats]]).tolist())


def _most_likely(moved: PreparedMotion, offset_s: float, start: Noises) -> NoiseFit:
    return most_likely([moved.at(offset_s)], start, moved.weight, outliers=False)


def _score(found: NoiseFit) -> float:
    return found.score(found.noises)


def _best_of(
    moved: PreparedMotion, offsets_s: Sequence[float], tried: Sequence[Noises]
) -> tuple[float, Noises]:
    """The most likely of some noises, with others of SIGMA_A and all of them scaled: -ln p, it."""
    found = []
    for positions in map(moved.at, offsets_s):
        for one, factor in product(tried, LOOK_SIGMA_A):
            noises = replace(one, sigma_a_m_s2=factor * one.sigma_a_m_s2)
            totals = fitted([positions], noises, moved.weight).totals(LOOK_SCALES)[:, 0]
            found.append((float(totals.min()), float(LOOK_SCALES[np.argmin(totals)]), noises))
    least, scale, noises = min(found, key=lambda each: each[0])
    sizes = {name: value * scale for name, value in vars(noises).items() if name != "tau_s"}
    return least, replace(noises, **sizes)
