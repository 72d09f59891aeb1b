"""Time correlation of position errors: low-pass filtered positions or time-correlated noise.

Both models are compared with white noise by the likelihood of the positions given the IMU motion.

- Low pass: z_k = (1 - ρ) u_k + ρ z_(k-1), with measured positions z, unfiltered positions u and
  ρ = exp(-Δt/τ). The unfiltered positions have white noise.
- Time-correlated noise: a first-order Gauss-Markov process in addition to white noise.

With ground truth, τ is fitted to the position errors by restricted likelihood (Patterson and
Thompson 1971).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import product

import numpy as np
import pandas as pd
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize_scalar

from px4fuse.core.arrays import Array, ArrayPair, BoolArray, compute_median_interval_s
from px4fuse.flight.model import Flight, Unavailable

from .fitting import (
    NoiseFit,
    NoiseParameters,
    fit_constant_errors,
)
from .hypotheses import Jump, make_unit_steps
from .imu_motion import MotionCache, PositionsAndImuMotion, compute_imu_motion
from .likelihood import MAX_LOG_LIKELIHOOD_DROP
from .settings import Settings
from .signals import Axis, report_too_few_measurements

MIN_MEASUREMENTS = 100
# Maximum number of positions in a noise fit, from the middle of the flight
MAX_MEASUREMENTS = 2000
# Noise of two positions is assumed to be independent if the interval between them is above this
# multiple of the median interval
MAX_INTERVAL_TO_MEDIAN_INTERVAL_RATIO = 3.0
# Time constants (s) in the coarse search for time-correlated noise
COARSE_CORRELATION_TIMES_S = (0.2, 0.6, 2.0, 6.0)
# Tested fractions of time-correlated noise in the variance SIGMA_Z², in the coarse search
COARSE_CORRELATED_VARIANCE_FRACTIONS = (0.12, 0.35, 0.8)
# Tested multiples of SIGMA_A in the coarse search
COARSE_SIGMA_A_FACTORS = (0.4, 0.9)
# Tested common factors on SIGMA_A, SIGMA_Z and the time-correlated noise, in the coarse search
COARSE_SIGMA_FACTORS = np.geomspace(0.7, 1.6, 12)
COARSE_SEARCH_MEASUREMENT_COUNT = 1000
# Minimum log-likelihood gain of time-correlated noise over white noise in the coarse search; below
# it, the noises are not fitted
MIN_GAIN_FOR_FULL_FIT_NATS = 0.5
# Below this estimate of SIGMA_Z (m), the source probably low-pass filters its positions
MAX_SIGMA_Z_OF_LOW_PASS_SOURCE_M = 0.01
# Minimum log-likelihood gain of time-correlated noise over white noise, to report time-correlated
# noise
MIN_LIKELIHOOD_GAIN_NATS = 2.0
# Reduction (nats) of the log-likelihood of a noise fit if it also estimates a time offset. The
# Akaike information criterion (1974) deducts 1 nat for one more parameter; this is twice as much
TIME_OFFSET_PENALTY_NATS = 2.0
# Search range (s) of the time constant of a low-pass filter in the source
LOW_PASS_TAU_RANGE_S = (0.02, 3.0)
# Tolerance of ln τ in the search for the time constant τ of a low-pass filter in the source
LOG_TAU_TOLERANCE = 0.05
# Fit of the position errors against ground truth: maximum number of positions, to limit the
# computing time
MAX_MEASUREMENTS_IN_TRUTH_FIT = 300
# Fit of the position errors against ground truth: minimum log-likelihood gain of time-correlated
# noise over white noise
MIN_TRUTH_LIKELIHOOD_GAIN_NATS = 5.0
# If all position errors (m) are smaller, ground truth is a copy of the positions
MAX_RESIDUAL_OF_COPIED_TRUTH_M = 1e-5
# Maximum time difference (s) between a position and the nearest ground truth sample
MAX_TRUTH_TIME_DIFFERENCE_S = 0.1
# Fit of the position errors against ground truth: number of flight parts, each with its own time
# offset
FLIGHT_PART_COUNT = 12
# Fit of the position errors against ground truth: tested time constants (s) of time-correlated
# noise
TESTED_CORRELATION_TIMES_S = np.geomspace(0.3, 80.0, 17)
# Fit of the position errors against ground truth: tested fractions of time-correlated noise in the
# error variance
TESTED_CORRELATED_FRACTIONS = np.linspace(0.05, 0.999, 20)


@dataclass(frozen=True)
class SourceLowPass:
    """Estimate of the low-pass filter that the source applied to its positions.

    Attributes
    ----------
    correlation : float
        Correlation of the noise of successive positions; 0 for no filter.
    lag_s : float
        Lag of the positions at constant velocity.
    gain_nats : float
        Log likelihood (nats) of the innovations with the low-pass filter, minus their log
        likelihood with white noise only.
    sigma_z_m : float
        White position noise before the low-pass filter (1 σ).
    """

    correlation: float
    lag_s: float
    gain_nats: float
    sigma_z_m: float


@dataclass(frozen=True)
class TimeCorrelatedNoise:
    """Time-correlated noise in addition to the white noise of the positions.

    Attributes
    ----------
    tau_s, low_s, high_s : float
        Correlation time, and the ends of its 95 % interval.
    slow_m, white_m : float
        Standard deviation of time-correlated (slow) and of white noise, per axis.
    gain_nats : float
        Log likelihood (nats) with time-correlated noise minus log likelihood with white noise.
    low_pass_gain_nats : float
        Log likelihood (nats) with a low-pass filter instead, minus log likelihood with
        time-correlated noise.
    """

    tau_s: float
    low_s: float
    high_s: float
    slow_m: float
    white_m: float
    gain_nats: float
    low_pass_gain_nats: float


# Unfiltered positions are the positions before the low-pass filter of the source. First: unfiltered
# positions and the IMU motion at their times. Second: a term to add to their negative log
# likelihood. The sum is the negative log likelihood of the measured positions
_UnfilteredMotion = tuple[PositionsAndImuMotion | Unavailable, float]


def _undo_low_pass(
    time_s: Array,
    measured_m: Array,
    is_outlier: BoolArray,
    compute_motion: Callable[[Array, Array], PositionsAndImuMotion | Unavailable],
    tau_s: float,
) -> _UnfilteredMotion:
    """Compute the positions before a low-pass filter with time constant ``tau_s``."""
    interval_s = np.diff(time_s, prepend=time_s[0])
    has_no_gap = (
        interval_s < MAX_INTERVAL_TO_MEDIAN_INTERVAL_RATIO * np.median(interval_s[1:])
    ) & (interval_s > 0.0)
    rho = np.zeros(len(time_s))
    if tau_s:
        rho[has_no_gap] = np.exp(-interval_s[has_no_gap] / tau_s)
    # The first position has no previous one; its ρ is 0
    previous_position_m = np.roll(measured_m, 1, axis=0)
    unfiltered_m = (measured_m - rho[:, None] * previous_position_m) / (1.0 - rho)[:, None]
    # The unfiltered position is computed from a position and the previous position. Exclude both
    # unfiltered positions that are computed from an outlier
    is_computed_from_outlier = is_outlier | (has_no_gap & np.roll(is_outlier, 1))
    motion = compute_motion(
        time_s[~is_computed_from_outlier], unfiltered_m[~is_computed_from_outlier]
    )
    if isinstance(motion, Unavailable):
        return motion, 0.0
    # The first position of a segment sets the initial state, and is not part of the likelihood. Its
    # index is a segment edge; the last edge is the end
    is_used = np.isin(time_s, np.delete(motion.time_s, motion.segment_edges[:-1]))
    return motion, measured_m.shape[1] * float(np.sum(np.log1p(-rho[is_used])))


def _fit_low_pass(
    undo_low_pass: Callable[[float], _UnfilteredMotion],
    interval_s: float,
    start_parameters: NoiseParameters,
    white_noise_score: float,
) -> SourceLowPass:
    """Fit the time constant of a low-pass filter that the source applied to its positions.

    ``interval_s`` is the median interval of the positions.
    """

    def fit_noises(log_tau: float) -> tuple[float, float]:
        """Return -ln p and the estimated SIGMA_Z for a time constant of the filter."""
        # -ln p of the measured positions = -ln p of the unfiltered positions - ln |Jacobian|
        motion, minus_log_jacobian = undo_low_pass(float(np.exp(log_tau)))
        # The IMU motion at these times is already known: fit_time_correlation has computed it, and
        # the times do not depend on the time constant τ
        assert not isinstance(motion, Unavailable)
        fit = motion.fit_noises(0.0, start_parameters)
        return fit.compute_score() + minus_log_jacobian, fit.noise_parameters.sigma_z_m

    low_log_tau, high_log_tau = np.log(LOW_PASS_TAU_RANGE_S)
    log_tau = minimize_scalar(
        lambda log_tau: fit_noises(log_tau)[0],
        bounds=(low_log_tau, high_log_tau),
        options={"xatol": LOG_TAU_TOLERANCE},
    ).x
    score, sigma_z_m = fit_noises(log_tau)
    # Filtered positions are a sum of previous ones with the weights (1 - ρ) ρ^k. Their mean age is
    # ρ / (1 - ρ) intervals
    correlation = float(np.exp(-interval_s / np.exp(log_tau)))
    lag_s = interval_s * correlation / (1.0 - correlation)
    return SourceLowPass(correlation, lag_s, white_noise_score - score, sigma_z_m)


def fit_time_correlation(
    flight: Flight,
    axes: tuple[Axis, ...],
    settings: Settings,
    noise_parameters: NoiseParameters,
    *,
    outlier_time_s: Array,
    clock_offset_s: float,
    jumps: Sequence[Jump] = (),
    motion_cache: MotionCache | None = None,
) -> tuple[SourceLowPass, TimeCorrelatedNoise | Unavailable] | Unavailable:
    """Fit two models of correlated position errors: a low-pass filter and time-correlated noise.

    Parameters
    ----------
    axes : tuple of Axis
        Axes with the same measurement times.
    noise_parameters : NoiseParameters
        Initial values: estimates with white noise.
    outlier_time_s : ndarray
        Timestamps of measurements to exclude.
    clock_offset_s : float
        Time offset (s) estimated with white noise.
    jumps : sequence of Jump
        Jumps of the positions, which are subtracted.
    motion_cache : dict, optional
        IMU motion that is already computed; new motion is added.
    """
    time_s = axes[0].measurement_time_s
    if len(time_s) < MIN_MEASUREMENTS:
        return report_too_few_measurements(
            "time correlation of the position errors", len(time_s), MIN_MEASUREMENTS
        )
    first_row = max(0, (len(time_s) - MAX_MEASUREMENTS) // 2)
    middle_rows = slice(first_row, first_row + MAX_MEASUREMENTS)
    time_s = time_s[middle_rows]
    measured_m = np.column_stack([axis.measurement_m[middle_rows] for axis in axes])
    for jump in jumps:
        measured_m -= np.outer(time_s >= jump.time_s, [step.value for step in jump.step_m])
    compute_motion = partial(
        compute_imu_motion,
        flight,
        axis_directions=np.array([axis.direction for axis in axes]),
        dt_s=settings.dt_s,
        motion_cache=motion_cache,
    )
    undo_low_pass = partial(
        _undo_low_pass, time_s, measured_m, np.isin(time_s, outlier_time_s), compute_motion
    )
    imu_motion, _ = undo_low_pass(0.0)
    if isinstance(imu_motion, Unavailable):
        return imu_motion
    tested_offsets_s = sorted({0.0, clock_offset_s})
    sigma_z_m = noise_parameters.sigma_z_m
    no_low_pass = SourceLowPass(correlation=0.0, lag_s=0.0, gain_nats=0.0, sigma_z_m=sigma_z_m)
    no_correlation_found = Unavailable(
        "time-correlated noise of the positions", "the position errors are not time-correlated", ""
    )
    correlated_candidates = [
        replace(
            noise_parameters,
            sigma_z_m=sigma_z_m * (1.0 - fraction) ** 0.5,
            correlated_sigma_m=sigma_z_m * fraction**0.5,
            tau_s=tau,
        )
        for fraction, tau in product(
            COARSE_CORRELATED_VARIANCE_FRACTIONS, COARSE_CORRELATION_TIMES_S
        )
    ]
    # 1. Coarse search with and without time-correlated noise. Scores are -ln p of the positions, so
    # the lowest score is the best
    downsampled_motion = imu_motion.downsample(COARSE_SEARCH_MEASUREMENT_COUNT)
    coarse_white_noise_score, _ = _search_coarse_grid(
        downsampled_motion, tested_offsets_s, [noise_parameters]
    )
    coarse_correlated_noise_score, correlated_start_parameters = _search_coarse_grid(
        downsampled_motion, tested_offsets_s, correlated_candidates
    )
    is_sigma_z_small = sigma_z_m < MAX_SIGMA_Z_OF_LOW_PASS_SOURCE_M
    if (
        coarse_white_noise_score - coarse_correlated_noise_score < MIN_GAIN_FOR_FULL_FIT_NATS
        and not is_sigma_z_small
    ):
        return no_low_pass, no_correlation_found
    # 2. Fit of the noises with all positions, starting at the best values of the coarse search
    white_noise_fit, _ = _fit_noises_at_best_offset(imu_motion, tested_offsets_s, noise_parameters)
    correlated_noise_fit, offset_s = _fit_noises_at_best_offset(
        imu_motion, tested_offsets_s, correlated_start_parameters
    )
    white_noise_score = white_noise_fit.compute_score()
    # 3. A low-pass filter is fitted only if the noise is time-correlated or very small
    gain_nats = white_noise_score - correlated_noise_fit.compute_score()
    is_correlated = gain_nats >= MIN_LIKELIHOOD_GAIN_NATS
    if not (is_correlated or is_sigma_z_small):
        return no_low_pass, no_correlation_found
    low_pass = _fit_low_pass(
        undo_low_pass,
        compute_median_interval_s(time_s),
        white_noise_fit.noise_parameters,
        white_noise_score,
    )
    source_low_pass = low_pass if low_pass.gain_nats > 0.0 else no_low_pass
    if not is_correlated:
        return source_low_pass, no_correlation_found
    # Both log-likelihood gains are relative to white noise, so their difference compares a low-pass
    # filter with time-correlated noise. A fitted time offset is one more parameter of the
    # time-correlated noise, so a penalty is added
    fitted_parameters = correlated_noise_fit.noise_parameters
    return source_low_pass, TimeCorrelatedNoise(
        tau_s=fitted_parameters.tau_s,
        low_s=fitted_parameters.tau_s,
        high_s=np.inf,
        slow_m=fitted_parameters.correlated_sigma_m,
        white_m=fitted_parameters.sigma_z_m,
        gain_nats=gain_nats,
        low_pass_gain_nats=low_pass.gain_nats
        - gain_nats
        + (TIME_OFFSET_PENALTY_NATS if offset_s else 0.0),
    )


def fit_time_correlation_to_truth(
    axes: Sequence[Axis],
    truths: Sequence[pd.DataFrame],
    outlier_time_s: Array,
    clock_offset_s: float,
    jumps: Sequence[Jump],
    correlated_noise_from_imu: TimeCorrelatedNoise | Unavailable,
    low_pass: SourceLowPass,
) -> TimeCorrelatedNoise | Unavailable:
    """Fit time-correlated noise to the position errors against ground truth.

    Frame errors and time offsets are removed from the errors. ``correlated_noise_from_imu``, the
    estimate without ground truth, is returned in these cases: there are too few positions near
    ground truth, ground truth is a copy of the positions, or the log-likelihood gain over white
    noise is below that of ``correlated_noise_from_imu`` or below MIN_TRUTH_LIKELIHOOD_GAIN_NATS.

    Model: the covariance of the errors is σ² ((1 - f) I + f C), with C = exp(-|Δt| / τ) and the
    fraction f of time-correlated noise in the variance. For each tested τ and f, the most likely σ²
    is known in closed form.

    Parameters
    ----------
    axes, truths
        Axes with the same measurement times, and ground truth of each axis (``position_m``).
    clock_offset_s : float
        Time offset (s) that is added to the timestamps of the positions.
    """
    min_likelihood_gain_nats = MIN_TRUTH_LIKELIHOOD_GAIN_NATS
    low_pass_gain_nats = low_pass.gain_nats
    if isinstance(correlated_noise_from_imu, TimeCorrelatedNoise):
        min_likelihood_gain_nats = max(
            MIN_TRUTH_LIKELIHOOD_GAIN_NATS, correlated_noise_from_imu.gain_nats
        )
        low_pass_gain_nats = correlated_noise_from_imu.low_pass_gain_nats
    # Use positions near a sample of ground truth, without outliers, and downsample them
    true_track = pd.concat([truth["position_m"] for truth in truths], axis=1).dropna()
    measurement_time_s = np.setdiff1d(axes[0].measurement_time_s, outlier_time_s)
    measurement_time_s = measurement_time_s[
        true_track.index.get_indexer(
            pd.Index(measurement_time_s), "nearest", tolerance=MAX_TRUTH_TIME_DIFFERENCE_S
        )
        >= 0
    ]
    measurement_time_s = measurement_time_s[
        :: max(1, -(-len(measurement_time_s) // MAX_MEASUREMENTS_IN_TRUTH_FIT))
    ]
    position_count = len(measurement_time_s)
    if position_count < MIN_MEASUREMENTS:
        return correlated_noise_from_imu
    measured_m = np.transpose(
        [axis.measurement_m[np.isin(axis.measurement_time_s, measurement_time_s)] for axis in axes]
    )
    truth_spline = CubicSpline(true_track.index, true_track)
    true_m, true_velocity_m_s = (
        truth_spline(measurement_time_s + clock_offset_s, order) for order in (0, 1)
    )
    # Remove the systematic errors: a constant, scale and rotation errors (proportional to the true
    # position), jumps, and a time offset of each flight part. A time offset changes the position
    # along each axis by offset · velocity
    is_in_flight_part = np.eye(FLIGHT_PART_COUNT)[
        FLIGHT_PART_COUNT * np.arange(position_count) // position_count
    ]
    time_offset_columns = np.einsum("tp,ta->tpa", is_in_flight_part, true_velocity_m_s).reshape(
        position_count, -1
    )
    jump_columns = make_unit_steps(measurement_time_s, [jump.time_s for jump in jumps])
    systematic_error_columns = np.column_stack(
        [np.ones_like(measurement_time_s), true_m, time_offset_columns, jump_columns]
    )
    # Projections of the errors on this basis do not depend on the systematic errors (restricted
    # likelihood)
    basis_without_systematic_errors = np.linalg.qr(systematic_error_columns, mode="complete")[0][
        :, systematic_error_columns.shape[1] :
    ]
    residuals = basis_without_systematic_errors.T @ (measured_m - true_m)
    if np.abs(residuals).max() < MAX_RESIDUAL_OF_COPIED_TRUTH_M:
        return correlated_noise_from_imu
    white_noise_score = 0.5 * len(residuals) * np.log(np.mean(residuals**2, axis=0)).sum()

    # Compute the log-likelihood for each τ and each fraction f of time-correlated noise
    @cache
    def compute_scores_and_variances(tested_tau_s: float) -> ArrayPair:
        """Return -ln p and the most likely σ² for each tested fraction f of time-correlated noise.

        C is the correlation matrix of the projected errors for ``tested_tau_s``. In the basis of
        the eigenvectors of C, the covariance is diagonal for all f: σ² (1 - f + f · eigenvalue).
        σ² is fitted to each axis; the returned σ² is the mean over the axes.
        """
        correlation_matrix = (
            basis_without_systematic_errors.T
            @ np.exp(-np.abs(measurement_time_s[:, None] - measurement_time_s) / tested_tau_s)
            @ basis_without_systematic_errors
        )
        eigenvalues, eigenvectors = np.linalg.eigh(correlation_matrix)
        relative_noise_variance = (
            1.0 - TESTED_CORRELATED_FRACTIONS + TESTED_CORRELATED_FRACTIONS * eigenvalues[:, None]
        )
        normalised_mean_squares = (
            ((eigenvectors.T @ residuals) ** 2).T @ (1.0 / relative_noise_variance) / len(residuals)
        )
        log_determinant = np.log(relative_noise_variance).sum(axis=0)
        log_variances = np.log(normalised_mean_squares).sum(axis=0)
        scores = 0.5 * (len(axes) * log_determinant + len(residuals) * log_variances)
        return scores, normalised_mean_squares.mean(axis=0)

    # First test every fourth time constant: most flights have no time-correlated noise
    coarse_score = min(
        compute_scores_and_variances(tau)[0].min()
        for tau in TESTED_CORRELATION_TIMES_S[::4].tolist()
    )
    if white_noise_score - coarse_score < min_likelihood_gain_nats / 2.0:
        return correlated_noise_from_imu
    scores_and_variances = [*map(compute_scores_and_variances, TESTED_CORRELATION_TIMES_S.tolist())]
    # Rows are time constants, columns time-correlated fractions of the variance
    scores, normalised_mean_squares = np.transpose(scores_and_variances, (1, 0, 2))
    tau_index, correlated_fraction_index = divmod(
        int(np.argmin(scores)), len(TESTED_CORRELATED_FRACTIONS)
    )
    likelihood_gains_nats = white_noise_score - scores.min(axis=1)
    best_gain_nats = likelihood_gains_nats.max()
    if best_gain_nats < min_likelihood_gain_nats:
        return correlated_noise_from_imu
    # The profile likelihood of τ gives its 95 % interval
    first_tau_index, last_tau_index = np.flatnonzero(
        likelihood_gains_nats > best_gain_nats - MAX_LOG_LIKELIHOOD_DROP
    )[[0, -1]]
    # Each end of the 95 % interval of τ is between two tested values of τ: return the outer value
    taus_s = [*TESTED_CORRELATION_TIMES_S.tolist(), np.inf]
    fraction = float(TESTED_CORRELATED_FRACTIONS[correlated_fraction_index])
    variance_m2 = float(normalised_mean_squares[tau_index, correlated_fraction_index])
    return TimeCorrelatedNoise(
        tau_s=taus_s[tau_index],
        low_s=taus_s[max(first_tau_index - 1, 0)],
        high_s=taus_s[last_tau_index + 1],
        slow_m=(variance_m2 * fraction) ** 0.5,
        white_m=(variance_m2 * (1.0 - fraction)) ** 0.5,
        gain_nats=float(best_gain_nats),
        low_pass_gain_nats=low_pass_gain_nats,
    )


def _fit_noises_at_best_offset(
    imu_motion: PositionsAndImuMotion, offsets_s: Sequence[float], start_parameters: NoiseParameters
) -> tuple[NoiseFit, float]:
    """Fit the noises with each time offset; return the most likely fit and its offset (s)."""
    fits = [(imu_motion.fit_noises(offset_s, start_parameters), offset_s) for offset_s in offsets_s]
    return min(fits, key=lambda fit_and_offset: fit_and_offset[0].compute_score())


def _search_coarse_grid(
    imu_motion: PositionsAndImuMotion,
    offsets_s: Sequence[float],
    candidate_parameters: Sequence[NoiseParameters],
) -> tuple[float, NoiseParameters]:
    """Return the lowest score (-ln p) and its noises from a grid of time offsets and noises.

    Noises: each candidate, with SIGMA_A multiplied by COARSE_SIGMA_A_FACTORS, then with all σ
    multiplied by COARSE_SIGMA_FACTORS. One fit gives the scores for all common factors.
    """
    scored_parameters = []
    for positions in map(imu_motion.make_positions_at_offset, offsets_s):
        for candidate, sigma_a_factor in product(candidate_parameters, COARSE_SIGMA_A_FACTORS):
            noise_parameters = replace(
                candidate, sigma_a_m_s2=sigma_a_factor * candidate.sigma_a_m_s2
            )
            total_scores = fit_constant_errors(
                [positions], noise_parameters, imu_motion.measurement_weights
            ).compute_scores(COARSE_SIGMA_FACTORS)[:, 0]
            scored_parameters.append(
                (
                    float(total_scores.min()),
                    float(COARSE_SIGMA_FACTORS[np.argmin(total_scores)]),
                    noise_parameters,
                )
            )
    lowest_score, factor, noise_parameters = min(scored_parameters, key=lambda scored: scored[0])
    # All parameters are σ, except the time constant
    best_parameters = {
        name: value * factor for name, value in vars(noise_parameters).items() if name != "tau_s"
    }
    return lowest_score, replace(noise_parameters, **best_parameters)
