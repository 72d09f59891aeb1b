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
from px4fuse.filter.causes import Jump, unit_steps
from px4fuse.filter.fitting import NoiseFit, Noises, fit_noises, maximise_likelihood
from px4fuse.filter.likelihood import PROFILE_DROP
from px4fuse.filter.motion import PreparedMotion, SignalCache, prepare_motion
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import Axis, too_few_measurements
from px4fuse.flight import Flight, Unavailable

MIN_MEASUREMENTS = 100
# Longer flights are judged by their middle, which is enough
MAX_MEASUREMENTS = 2000
# Intervals longer than this many median ones begin anew: the low pass has forgotten
MAX_INTERVAL_RATIO = 3.0
# A first look for slow errors: τ, share of SIGMA_Z's variance, SIGMA_A and all noises over those
# without one
COARSE_TAUS_S, COARSE_SHARES, COARSE_SIGMA_A_FACTORS = (
    (0.2, 0.6, 2.0, 6.0),
    (0.12, 0.35, 0.8),
    (0.4, 0.9),
)
COARSE_SCALES = np.geomspace(0.7, 1.6, 12)
COARSE_MEASUREMENTS = 1000
# What it must find for more to be done, and what more must find: less is chance
MIN_COARSE_GAIN_NATS, MIN_GAIN_NATS = 0.5, 2.0
# What a slow error with a clock offset must explain beyond a low pass, whose lag is its own: 1 for
# each of its two further numbers (Akaike 1974)
OFFSET_PENALTY_NATS = 2.0
# Time constants of a low pass, and how near in ln τ is near enough
LOW_PASS_TAU_S, LOG_TAU_TOLERANCE = (0.02, 3.0), 0.05
# Against a truth: at most so many measurements, what must be gained (a likelihood ratio of 150 for
# two more numbers), how near a sample of it must be (s: between them, at 2 m/s², it is known to
# 1 cm), time constants and shares
MAX_TRUTH_MEASUREMENTS, MIN_TRUTH_GAIN_NATS, MAX_TRUTH_DISTANCE_S = 300, 5.0, 0.1
# Parts of the flight with a clock offset each, which may change
OFFSET_PART_COUNT = 12
TRUTH_TAUS_S, TRUTH_SHARES = np.geomspace(0.3, 80.0, 17), np.linspace(0.05, 0.999, 20)


@dataclass(frozen=True)
class SourceLowPass:
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
class TimeCorrelatedNoise:
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
        What a low pass, which lags, explains beyond that, :data:`OFFSET_PENALTY_NATS` more where the slow
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


def time_correlation_fit(
    flight: Flight,
    axes: tuple[Axis, ...],
    settings: Settings,
    noises: Noises,
    *,
    outlier_time_s: Array,
    clock_offset_s: float,
    jumps: Sequence[Jump] = (),
) -> tuple[SourceLowPass, TimeCorrelatedNoise | Unavailable] | Unavailable:
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
        return too_few_measurements("errors that hang together", len(time), MIN_MEASUREMENTS)
    first_row = max(0, (len(time) - MAX_MEASUREMENTS) // 2)
    rows = slice(first_row, first_row + MAX_MEASUREMENTS)
    time, measured_m = time[rows], np.column_stack([axis.measurement_m[rows] for axis in axes])
    for jump in jumps:
        measured_m = measured_m - np.outer(
            time >= jump.time_s, [step.value for step in jump.step_m]
        )
    interval, is_outlier = np.diff(time, prepend=time[0]), np.isin(time, outlier_time_s)
    is_short_interval = (interval < MAX_INTERVAL_RATIO * np.median(interval[1:])) & (interval > 0.0)
    directions, signals = np.array([axis.direction for axis in axes]), SignalCache()

    def undo_low_pass(tau_s: float) -> tuple[PreparedMotion | Unavailable, float]:
        """Positions with a low pass undone, and what undoing it adds to -ln p."""
        rho = (
            np.where(is_short_interval, np.exp(-interval / tau_s), 0.0)
            if tau_s
            else np.zeros(len(time))
        )
        previous_m = np.concatenate([measured_m[:1], measured_m[:-1]])
        unfiltered = (measured_m - rho[:, None] * previous_m) / (1.0 - rho)[:, None]
        # what was undone with an outlier is one too: left out of all models, which are compared
        is_good = ~(is_outlier | (is_short_interval & np.concatenate([[False], is_outlier[:-1]])))
        prepared_motion = prepare_motion(
            flight,
            time[is_good],
            unfiltered[is_good],
            directions=directions,
            dt_s=settings.dt_s,
            signals=signals,
        )
        if isinstance(prepared_motion, Unavailable):
            return prepared_motion, 0.0
        # nothing is known of where a stretch begins: the first one says nothing
        is_used = np.isin(time, np.delete(prepared_motion.time_s, prepared_motion.edges[:-1]))
        return prepared_motion, len(axes) * float(np.sum(np.log1p(-rho[is_used])))

    prepared_motion, _ = undo_low_pass(0.0)
    if isinstance(prepared_motion, Unavailable):
        return prepared_motion
    offsets = sorted({0.0, clock_offset_s})
    sigma, coarse_motion = noises.sigma_z_m, prepared_motion.downsample(COARSE_MEASUREMENTS)
    low_pass = SourceLowPass(0.0, 0.0, 0.0, sigma)
    correlated_noises = [
        replace(
            noises, sigma_z_m=sigma * (1.0 - share) ** 0.5, slow_m=sigma * share**0.5, tau_s=tau
        )
        for share, tau in product(COARSE_SHARES, COARSE_TAUS_S)
    ]
    (white_score, _), (correlated_score, correlated_start) = (
        _best_of_grid(coarse_motion, offsets, candidates)
        for candidates in ([noises], correlated_noises)
    )
    label = "slow errors of the source"
    no_correlation = Unavailable(label, "its errors do not hang together", "")
    if white_score - correlated_score < MIN_COARSE_GAIN_NATS:
        return low_pass, no_correlation
    (white_fit, _), (correlated_fit, offset_s) = (
        min(
            ((_fit_noises_at(prepared_motion, offset, start_noises), offset) for offset in offsets),
            key=lambda pair: _score_of_fit(pair[0]),
        )
        for start_noises in (noises, correlated_start)
    )
    white_full_score, white_noises, correlated_score = (
        _score_of_fit(white_fit),
        white_fit.noises,
        _score_of_fit(correlated_fit),
    )
    if (
        white_full_score - correlated_score < MIN_GAIN_NATS
    ):  # of a low pass, a slow error explains much as well
        return low_pass, no_correlation

    def unfiltered(log_tau: float) -> tuple[float, Noises]:
        prepared_motion, jacobian_term = undo_low_pass(float(np.exp(log_tau)))
        assert not isinstance(prepared_motion, Unavailable)  # it was not, of the same measurements
        correlated_score = _fit_noises_at(prepared_motion, 0.0, white_noises)
        return _score_of_fit(correlated_score) + jacobian_term, correlated_score.noises

    low, high = np.log(LOW_PASS_TAU_S).tolist()
    log_tau = minimize_scalar(
        lambda offset: unfiltered(offset)[0],
        bounds=(low, high),
        options={"xatol": LOG_TAU_TOLERANCE},
    ).x
    (score, filtered_noises), tau_s = unfiltered(log_tau), float(np.exp(log_tau))
    if score < white_full_score:
        correlation = float(np.exp(-np.median(np.diff(time)) / tau_s))
        lag_s = float(np.median(np.diff(time))) * correlation / (1.0 - correlation)
        low_pass = SourceLowPass(
            correlation, lag_s, white_full_score - score, filtered_noises.sigma_z_m
        )
    fitted_noises, lag_nats = (
        correlated_fit.noises,
        correlated_score - score + (OFFSET_PENALTY_NATS if offset_s else 0.0),
    )
    sizes = (
        fitted_noises.slow_m,
        fitted_noises.sigma_z_m,
        white_full_score - correlated_score,
        lag_nats,
    )
    return low_pass, TimeCorrelatedNoise(fitted_noises.tau_s, fitted_noises.tau_s, np.inf, *sizes)


def fit_time_correlation_to_truth(
    axes: Sequence[Axis],
    truths: Sequence[pd.DataFrame],
    outlier_time_s: Array,
    clock_offset_s: float,
    jumps: Sequence[Jump],
    by_imu: TimeCorrelatedNoise | Unavailable,
) -> TimeCorrelatedNoise | Unavailable:
    """A slow error in the positions' errors against a truth, where that says more than the IMU.

    Parameters
    ----------
    axes, outlier_time_s, clock_offset_s, jumps
        As :func:`time_correlation_fit` has them.
    truths : sequence of DataFrame
        True ``position_m`` along each axis.
    by_imu : Coloured or Unavailable
        What :func:`time_correlation_fit` found, with the lag that only it can tell.
    """
    min_gain, lag_nats = MIN_TRUTH_GAIN_NATS, 0.0
    if isinstance(by_imu, TimeCorrelatedNoise):
        min_gain, lag_nats = max(MIN_TRUTH_GAIN_NATS, by_imu.gain_nats), by_imu.lag_nats
    true_track = pd.concat([truth["position_m"] for truth in truths], axis=1).dropna()
    time = np.setdiff1d(axes[0].measurement_time_s, outlier_time_s)
    time = time[
        true_track.index.get_indexer(pd.Index(time), "nearest", tolerance=MAX_TRUTH_DISTANCE_S) >= 0
    ]
    time = time[:: max(1, -(-len(time) // MAX_TRUTH_MEASUREMENTS))]
    if len(time) < MIN_MEASUREMENTS:
        return by_imu
    measured_m = np.transpose([a.measurement_m[np.isin(a.measurement_time_s, time)] for a in axes])
    track = CubicSpline(true_track.index, true_track)
    true_m, speed = (track(time + clock_offset_s, order) for order in (0, 1))
    part_index = np.eye(OFFSET_PART_COUNT)[OFFSET_PART_COUNT * np.arange(len(time)) // len(time)]
    offset_columns = np.einsum("tp,ta->tpa", part_index, speed).reshape(len(time), -1)
    jump_columns = unit_steps(time, [jump.time_s for jump in jumps])
    nuisance_columns = np.column_stack([np.ones_like(time), true_m, offset_columns, jump_columns])
    residual_basis = np.linalg.qr(nuisance_columns, mode="complete")[0][
        :, nuisance_columns.shape[1] :
    ]
    residuals, share, grid_fitss = residual_basis.T @ (measured_m - true_m), TRUTH_SHARES, []
    half = 0.5 * np.array([len(axes), len(residuals)])
    for tau in TRUTH_TAUS_S:
        correlation = (
            residual_basis.T @ np.exp(-np.abs(time[:, None] - time) / tau) @ residual_basis
        )
        eigenvalues, eigenvectors = np.linalg.eigh(correlation)
        variance = 1.0 - share + share * eigenvalues[:, None]
        square = ((eigenvectors.T @ residuals) ** 2).T @ (1.0 / variance) / len(residuals)
        score = half @ [np.log(variance).sum(axis=0), np.log(square).sum(axis=0)]
        grid_fitss.append((score, square.mean(axis=0)))
    score, square = np.transpose(grid_fitss, (1, 0, 2))  # by time constant and share
    tau_index, share_index = divmod(int(np.argmin(score)), len(share))
    gain = half[1] * np.log(np.mean(residuals**2, axis=0)).sum() - score.min(axis=1)
    if gain.max() < min_gain:
        return by_imu
    first_tau, last_tau = np.flatnonzero(gain > gain.max() - PROFILE_DROP)[[0, -1]]
    # the ends lie between time constants that were tried
    tau_s = np.append(TRUTH_TAUS_S, np.inf)[[tau_index, max(first_tau - 1, 0), last_tau + 1]]
    sizes_m = np.sqrt(
        square[tau_index, share_index] * np.array([share[share_index], 1.0 - share[share_index]])
    )
    return TimeCorrelatedNoise(*np.concatenate([tau_s, sizes_m, [gain.max(), lag_nats]]).tolist())


def _fit_noises_at(
    prepared_motion: PreparedMotion, offset_s: float, start_noises: Noises
) -> NoiseFit:
    return maximise_likelihood(
        [prepared_motion.at(offset_s)], start_noises, prepared_motion.weight, outliers=False
    )


def _score_of_fit(fit: NoiseFit) -> float:
    return fit.score(fit.noises)


def _best_of_grid(
    prepared_motion: PreparedMotion, offsets_s: Sequence[float], candidates: Sequence[Noises]
) -> tuple[float, Noises]:
    """The most likely of some noises, with others of SIGMA_A and all of them scaled: -ln p, it."""
    results = []
    for positions in map(prepared_motion.at, offsets_s):
        for candidate, factor in product(candidates, COARSE_SIGMA_A_FACTORS):
            noises = replace(candidate, sigma_a_m_s2=factor * candidate.sigma_a_m_s2)
            totals = fit_noises([positions], noises, prepared_motion.weight).totals(COARSE_SCALES)[
                :, 0
            ]
            results.append((float(totals.min()), float(COARSE_SCALES[np.argmin(totals)]), noises))
    lowest_score, scale, noises = min(results, key=lambda result: result[0])
    sizes = {name: value * scale for name, value in vars(noises).items() if name != "tau_s"}
    return lowest_score, replace(noises, **sizes)
