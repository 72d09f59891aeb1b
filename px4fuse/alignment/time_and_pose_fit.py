"""Fit of a position file to a reference track: time offset (lag), yaw and origin."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import label
from scipy.optimize import least_squares

from px4fuse.core.arrays import Array, ComplexArray, rms
from px4fuse.trajectory.correlation import autocovariance, compute_moments
from px4fuse.trajectory.time_offset import GRID_STEP_S

from .tracks import (
    EKF2_REFERENCE,
    IMU_REFERENCE,
    MIN_MATCHED_SAMPLES,
    MIN_OVERLAP_S,
    NoMatchError,
    SampledTrack,
)

# Maximum change (s) of the lag from the correlation peak to the least-squares fit
MAX_LAG_CORRECTION_S = 1.0
# Minimum concordance correlation coefficient (Lin 1989) of position file and reference track, to
# accept their match
MIN_CONCORDANCE_CORRELATION_TO_ACCEPT_MATCH = {EKF2_REFERENCE: 0.7, IMU_REFERENCE: 0.5}
# Lower limit of 1 - c in the match quality -N·ln(1 - c) of N common samples with concordance
# correlation coefficient c. Without this limit, a lag at which a few samples agree exactly would be
# the best match
MIN_ONE_MINUS_CONCORDANCE = 1e-4
# Lags within this time (s) of the best lag may belong to the same correlation peak
MIN_PEAK_DISTANCE_S = 3.0
# Second peak of the correlation over the lag: minimum number of common samples, and minimum sum of
# squared positions, as fractions of the values at the best lag. A match of few samples, or of
# samples at rest, is no evidence
MIN_SECOND_PEAK_SAMPLE_FRACTION, MIN_SECOND_PEAK_SQUARE_SUM_FRACTION = 0.5, 0.25
# Error (m) of the interpolation of positions to the time grid
INTERPOLATION_ERROR_M = 0.05
# In the RMS, larger position residuals (m) count as this value, because they may be outliers
RESIDUAL_CLIP_LIMIT_M = 1.0


@dataclass(frozen=True)
class CorrelationPeak:
    """Lag with the best match between position file and reference track.

    Attributes
    ----------
    lag_s : float
        Time to add to the times of the file.
    concordance_correlation : float
        Lin's concordance correlation coefficient, 1 for equal tracks.
    second_peak_lag_difference_s : float
        Second best lag minus best lag; NaN without a second peak.
    second_to_best_residual_ratio : float
        Residual (RMS) at the second best lag over residual at the best lag.
    """

    lag_s: float
    concordance_correlation: float = np.nan
    second_peak_lag_difference_s: float = np.nan
    second_to_best_residual_ratio: float = np.inf


@dataclass(frozen=True, kw_only=True)
class TrackFit(CorrelationPeak):
    """Least-squares fit of e^{i·yaw}·file(t) + origin to reference(t + lag).

    Horizontal positions are complex numbers north + i·east.

    Attributes
    ----------
    lag_sigma_s, yaw_sigma_rad : float or None
        Standard deviations of lag and yaw.
    origin_m : ndarray, shape (3,)
        Position of the file's origin: north, east, down.
    coherence : complex
        Correlation of file and reference; its phase is the yaw.
    horizontal_residual_rms_m, residual_rms_m : float
        RMS residual per horizontal axis, and RMS length of the residual.
    """

    lag_sigma_s: float | None
    yaw_rad: float
    yaw_sigma_rad: float | None
    origin_m: Array
    coherence: complex
    horizontal_residual_rms_m: float
    residual_rms_m: float


def find_correlation_peak(
    file_track: SampledTrack, reference: SampledTrack, yaw_rad: float | None
) -> CorrelationPeak:
    """Return the lag at which a position file matches a reference track best.

    It maximises -N·ln(1 - c) with N common samples and Lin's concordance correlation coefficient c.

    Raises
    ------
    NoMatchError
        The tracks have too few samples.
    """
    shorter_sample_count = min(
        np.count_nonzero(file_track.is_valid), np.count_nonzero(reference.is_valid)
    )
    min_sample_count = max(
        MIN_MATCHED_SAMPLES,
        min(MIN_OVERLAP_S / GRID_STEP_S, shorter_sample_count / 2),
    )
    if shorter_sample_count < min_sample_count:
        raise NoMatchError("position file and reference have too few common samples for a match")
    moments_by_lag = compute_moments(
        file_track.to_complex_m(), reference.to_complex_m(), file_track.is_valid, reference.is_valid
    )
    # All arrays below have one value for each lag
    common_sample_counts, covariance = moments_by_lag.count, moments_by_lag.covariance
    square_sum_m2 = moments_by_lag.sum_of_squares_a + moments_by_lag.sum_of_squares_b
    has_overlap = common_sample_counts >= min_sample_count
    # If the vehicle is at rest in both tracks, the sum of squared positions (relative to their
    # mean) is only a rounding error
    has_overlap &= square_sum_m2 > 1e-9 * np.max(square_sum_m2)
    # Horizontal positions are complex numbers (north + i·east). A rotation of the file by yaw
    # therefore multiplies its covariance with the reference by e^{-i·yaw}. The estimated yaw makes
    # this product real and positive, which is its largest real part
    rotated_covariance = (
        np.abs(covariance) if yaw_rad is None else (np.exp(-1j * yaw_rad) * covariance).real
    )
    # Lin's coefficient c = 2·covariance / (variance of file + variance of reference)
    concordance_correlation = np.zeros_like(square_sum_m2)
    np.divide(
        2.0 * rotated_covariance, square_sum_m2, out=concordance_correlation, where=has_overlap
    )
    log_likelihood_gain = -common_sample_counts * np.log(
        np.maximum(1.0 - concordance_correlation, MIN_ONE_MINUS_CONCORDANCE)
    )
    best_index = int(np.argmax(np.where(has_overlap, log_likelihood_gain, -np.inf)))

    peak = CorrelationPeak(
        float(reference.time_s[0]) + (best_index - len(file_track.is_valid) + 1) * GRID_STEP_S,
        concordance_correlation[best_index],
    )
    # The best peak is the region around the best lag, at most MIN_PEAK_DISTANCE_S to each side, in
    # which the concordance is at least half of its maximum. label() numbers such regions
    steps_from_best = np.arange(len(covariance)) - best_index
    region_numbers, _ = label(
        (np.abs(steps_from_best) <= round(MIN_PEAK_DISTANCE_S / GRID_STEP_S))
        & (concordance_correlation >= 0.5 * concordance_correlation[best_index])
    )
    # A second peak is outside the best peak, has enough samples and motion, and is an acceptable
    # match
    can_be_second_peak = (
        has_overlap
        & (region_numbers != region_numbers[best_index])
        & (
            common_sample_counts
            >= MIN_SECOND_PEAK_SAMPLE_FRACTION * common_sample_counts[best_index]
        )
        & (square_sum_m2 >= MIN_SECOND_PEAK_SQUARE_SUM_FRACTION * square_sum_m2[best_index])
        & (concordance_correlation >= MIN_CONCORDANCE_CORRELATION_TO_ACCEPT_MATCH[reference.name])
    )
    if not can_be_second_peak.any():
        return peak
    # Sum of squared residuals of two centred series: Σ|a|² + Σ|b|² - 2 Re Σ conj(a) b
    mean_square_residual_m2 = np.maximum(square_sum_m2 - 2.0 * rotated_covariance, 0.0) / (
        2.0 * np.maximum(common_sample_counts, 1.0)
    )
    residual_m = np.sqrt(mean_square_residual_m2 + INTERPOLATION_ERROR_M**2)
    second_peak_index = int(np.argmin(np.where(can_be_second_peak, residual_m, np.inf)))
    return replace(
        peak,
        second_peak_lag_difference_s=float(steps_from_best[second_peak_index]) * GRID_STEP_S,
        second_to_best_residual_ratio=residual_m[second_peak_index] / residual_m[best_index],
    )


def fit_by_least_squares(
    file_track: SampledTrack,
    reference: SampledTrack,
    peak: CorrelationPeak,
    yaw_rad: float | None,
    *,
    is_lag_estimated: bool,
) -> TrackFit:
    """Fit a position file to a reference track by robust least squares (soft L1).

    The origin is always fitted, because an error of the origin would look like a lag.

    Parameters
    ----------
    yaw_rad : float or None
        Given yaw; None to fit the yaw.
    is_lag_estimated : bool
        True to fit the lag.

    Raises
    ------
    NoMatchError
        Too few samples overlap in time.
    """
    reference_m, is_known = reference.at(file_track.time_s + peak.lag_s)
    is_used = is_known & file_track.is_valid
    if np.count_nonzero(is_used) < MIN_MATCHED_SAMPLES:
        raise NoMatchError(
            f"only {np.count_nonzero(is_used)} positions of the file overlap the "
            f"{reference.name} in time; {MIN_MATCHED_SAMPLES} are needed"
        )
    reference_time_s = file_track.time_s[is_used] + peak.lag_s
    file_position_m = file_track.to_complex_m()[is_used]
    reference_position_m = reference_m[is_used, 0] + 1j * reference_m[is_used, 1]
    # Initial values. With positions relative to their centre, the errors of yaw and origin are
    # uncorrelated; below, the origin is converted back
    centre_m, reference_mean_m = file_position_m.mean(), reference_position_m.mean()
    file_position_m = file_position_m - centre_m
    file_position_variance_m2, reference_position_variance_m2 = (
        np.var(file_position_m),
        np.var(reference_position_m),
    )
    sigma_product_m2 = np.sqrt(file_position_variance_m2 * reference_position_variance_m2)
    covariance_m2 = np.vdot(file_position_m, reference_position_m) / len(file_position_m)
    # Positions are complex numbers north + i·east, so the phase of their correlation coefficient
    # (coherence) is the yaw. Its magnitude does not depend on a scale factor between file and
    # reference, unlike the concordance correlation coefficient below
    coherence = complex(covariance_m2 / sigma_product_m2) if sigma_product_m2 > 0.0 else 0j
    reference_horizontal_position_m = reference.to_complex_m()

    # Parameters: origin north, origin east (m), lag correction (s), yaw (rad)
    initial_yaw_rad = np.angle(coherence) if yaw_rad is None else yaw_rad
    parameters = np.array([reference_mean_m.real, reference_mean_m.imag, 0.0, initial_yaw_rad])
    bounds = np.array([np.inf, np.inf, MAX_LAG_CORRECTION_S, np.inf])
    is_fitted = np.array([True, True, is_lag_estimated, yaw_rad is None])

    def compute_residuals_m(fitted_parameters: Array) -> Array:
        """Return the aligned positions of the file minus the reference positions (m).

        ``fitted_parameters`` are trial values of the parameters in ``is_fitted``; the other
        parameters keep their initial values. The result contains north and east of the first
        position, then of the second, and so on.
        """
        all_parameters = parameters.copy()
        all_parameters[is_fitted] = fitted_parameters
        origin_north_m, origin_east_m, lag_correction_s, fitted_yaw_rad = all_parameters
        reference_position_at_lag_m = np.interp(
            reference_time_s + lag_correction_s, reference.time_s, reference_horizontal_position_m
        )
        residuals_m: ComplexArray = (
            np.exp(1j * fitted_yaw_rad) * file_position_m
            + complex(origin_north_m, origin_east_m)
            - reference_position_at_lag_m
        )
        return residuals_m.view(float)

    solution = least_squares(
        compute_residuals_m,
        parameters[is_fitted],
        bounds=(-bounds[is_fitted], bounds[is_fitted]),
        loss="soft_l1",
        f_scale=_compute_robust_sigma(compute_residuals_m(parameters[is_fitted])),
    )
    residuals_m = solution.fun.view(complex)
    parameters[is_fitted] = solution.x
    parameter_sigma = np.full(4, np.nan)
    parameter_sigma[is_fitted] = _compute_parameter_sigma(np.asarray(solution.jac), residuals_m)
    origin_north_m, origin_east_m, lag_correction_s, fitted_yaw_rad = parameters.tolist()
    _, _, lag_sigma_s, yaw_sigma_rad = parameter_sigma.tolist()
    # At its limit, the lag is not determined by the data
    if abs(lag_correction_s) > 0.99 * MAX_LAG_CORRECTION_S:
        lag_sigma_s = np.inf
    concordance_correlation = peak.concordance_correlation
    # If the lag is given, there is no correlation peak: compute the concordance at the fitted yaw
    if np.isnan(concordance_correlation):
        rotated_covariance_m2 = (np.exp(-1j * fitted_yaw_rad) * covariance_m2).real
        mean_of_variances_m2 = max(
            (file_position_variance_m2 + reference_position_variance_m2) / 2.0, 1e-300
        )
        concordance_correlation = rotated_covariance_m2 / mean_of_variances_m2
    # Position of the file's origin, from that of the centre of its positions
    complex_origin_m = (
        complex(origin_north_m, origin_east_m) - np.exp(1j * fitted_yaw_rad) * centre_m
    )
    horizontal_residual_rms_m = compute_clipped_rms_m(np.abs(residuals_m)) / np.sqrt(2.0)
    reference_ned_m, _ = reference.at(reference_time_s + lag_correction_s)
    origin_down_m, vertical_rms_m = _fit_vertical(
        reference_ned_m[:, 2] - file_track.position_m[is_used, 2]
    )
    return TrackFit(
        lag_s=peak.lag_s + lag_correction_s,
        lag_sigma_s=lag_sigma_s if is_lag_estimated else None,
        concordance_correlation=concordance_correlation,
        second_peak_lag_difference_s=peak.second_peak_lag_difference_s,
        second_to_best_residual_ratio=peak.second_to_best_residual_ratio,
        yaw_rad=fitted_yaw_rad,
        yaw_sigma_rad=yaw_sigma_rad if yaw_rad is None else None,
        origin_m=np.array([complex_origin_m.real, complex_origin_m.imag, origin_down_m]),
        coherence=coherence,
        horizontal_residual_rms_m=horizontal_residual_rms_m,
        residual_rms_m=np.sqrt(2.0 * horizontal_residual_rms_m**2 + vertical_rms_m**2),
    )


def _fit_vertical(down_difference_m: Array) -> tuple[float, float]:
    """Return the vertical origin of the file's frame (m, down) and the RMS of the residuals.

    Both are zero without heights.
    """
    down_difference_m = down_difference_m[np.isfinite(down_difference_m)]
    if not len(down_difference_m):
        return 0.0, 0.0
    origin_down_m = float(np.median(down_difference_m))
    return origin_down_m, compute_clipped_rms_m(down_difference_m - origin_down_m)


def _compute_parameter_sigma(jacobian: Array, residuals_m: ComplexArray) -> Array:
    """Return σ of the fitted origin, lag and yaw, from Jacobian and residuals of their fit."""
    information = jacobian.T @ jacobian
    # The added diagonal prevents a singular matrix
    information += 1e-9 * np.diag(np.diag(information) + 1e-12)
    parameter_variance = (
        np.diag(np.linalg.inv(information))
        * _compute_robust_sigma(residuals_m.view(float)) ** 2
        * _compute_autocorrelation_factor(residuals_m)
    )
    return np.sqrt(np.maximum(parameter_variance, 0.0))


def _compute_robust_sigma(residual: Array) -> float:
    """Return the standard deviation from the median absolute residual."""
    return max(1.4826 * float(np.median(np.abs(residual))), 1e-3)


def _compute_autocorrelation_factor(residual: ComplexArray) -> float:
    """Return the factor by which autocorrelation increases the variance of a mean (1 + 2Σρ)."""
    clip_limit = 3.0 * _compute_robust_sigma(np.abs(residual))
    clipped_residual = residual * np.minimum(1.0, clip_limit / np.maximum(np.abs(residual), 1e-12))
    covariance_by_lag = autocovariance(clipped_residual)
    if covariance_by_lag[0] <= 0.0:
        return 1.0
    # Only the lags before the first negative autocorrelation are used
    is_used = np.logical_and.accumulate(covariance_by_lag > 0.0)
    return float(2.0 * np.sum(covariance_by_lag[is_used]) / covariance_by_lag[0] - 1.0)


def compute_clipped_rms_m(residual_m: Array) -> float:
    """Return the RMS (m) of residuals that are limited to RESIDUAL_CLIP_LIMIT_M."""
    return rms(np.minimum(np.abs(residual_m), RESIDUAL_CLIP_LIMIT_M))
