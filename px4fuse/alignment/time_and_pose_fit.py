"""Fit of a position track to a reference: lag by cross-correlation, then lag, yaw and origin."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from px4fuse.alignment import tracks
from px4fuse.alignment.tracks import EKF2_POSITION, IMU, NoMatchError, SampledTrack
from px4fuse.arrays import Array, Complex
from px4fuse.trajectory.correlation import autocovariance, moments
from px4fuse.trajectory.time_offset import STEP_S

WINDOW_S = 1.0  # largest shift of the least squares from the correlation peak
# concordance correlation below which a match is rejected
MIN_CONCORDANCE = {EKF2_POSITION: 0.7, IMU: 0.5}
MIN_MISFIT = 1e-4  # lower limit of 1 - concordance; of better matches the longer one counts
SEPARATE_LAG_S = 3.0  # distance of two lags that count as separate peaks
RESIDUAL_FLOOR_M = 0.05  # residual of a perfect match, because of the grid
MAX_DISTANCE_M = 1.0  # limit of residuals in the comparison of fits; larger ones may be outliers


@dataclass(frozen=True)
class Peak:
    """Peak of the cross-correlation between position file and reference.

    Attributes
    ----------
    lag_s : float
        Flight time of the first sample of the file.
    concordance : float
        Concordance correlation 2·Re(e^{-iψ}cov) / (var + var): 1 if the tracks are equal up to an
        offset; smaller if their extents differ. NaN if the lag was given.
    second_peak_s : float
        Best lag elsewhere, relative to this one; NaN without another peak.
    second_peak_ratio : float
        Residual (RMS) of that lag over the residual of the peak.
    """

    lag_s: float
    concordance: float = float("nan")
    second_peak_s: float = float("nan")
    second_peak_ratio: float = float("inf")


@dataclass(frozen=True, kw_only=True)
class Fit(Peak):
    """Least-squares fit of e^{iψ}·file(t) + origin to reference(t + lag), near a peak.

    Attributes
    ----------
    concordance : float
        Value of the peak; if the time offset was given, value of the fit.
    yaw_rad : float
    lag_sigma_s, yaw_sigma_rad : float or None
        Standard deviations; None if the parameter was given.
    origin_m : ndarray, shape (3,)
        North, east, down.
    coherence : complex
        Normalised covariance of reference and file before rotation; its angle is the best yaw.
    horizontal_rms_m, rms_m : float
        RMS of the truncated residuals: per horizontal axis, and of the vector (with height if both
        contain it).
    """

    lag_sigma_s: float | None
    yaw_rad: float
    yaw_sigma_rad: float | None
    origin_m: Array
    coherence: complex
    horizontal_rms_m: float
    rms_m: float


def correlation_peak(file: SampledTrack, reference: SampledTrack, yaw_rad: float | None) -> Peak:
    """Find the lag with the greatest likelihood gain on the grid; yaw is free if None.

    With a free origin the residual sum of squares over an overlap of N grid points is
    Σ|f - f̄|² + Σ|g - ḡ|² - 2·Re(e^{-iψ}cov). Relative to two independent tracks the log-likelihood
    increases by -N·ln(1 - concordance), which is maximised. A long overlap with an excellent match
    is preferred to a short one in which two straight lines match equally well.

    Raises
    ------
    NoMatchError
        No lag has sufficient overlap.
    """
    if not file.valid.any() or not reference.valid.any():
        raise NoMatchError("too few samples between gaps to match the tracks")
    found = moments(file.horizontal_m, reference.horizontal_m, file.valid, reference.valid)
    count, covariance, power = found.count, found.covariance, found.power_a + found.power_b
    min_count = min(np.count_nonzero(file.valid), np.count_nonzero(reference.valid))
    has_overlap = count >= max(
        tracks.MIN_SAMPLES, min(tracks.MIN_OVERLAP_S / STEP_S, min_count / 2.0)
    )
    if not has_overlap.any():
        raise NoMatchError("too few samples between gaps to match the tracks")
    has_overlap &= power > 1e-9 * np.max(power)  # exclude rounding errors
    real_covariance = (
        np.abs(covariance) if yaw_rad is None else (np.exp(-1j * yaw_rad) * covariance).real
    )
    concordance = np.zeros_like(power)
    concordance[has_overlap] = 2.0 * real_covariance[has_overlap] / power[has_overlap]
    gain = -count * np.log(np.maximum(1.0 - concordance, MIN_MISFIT))
    best = int(np.argmax(np.where(has_overlap, gain, -np.inf)))

    def lag(index: int) -> float:
        return float(reference.time_s[0]) + (index - len(file.valid) + 1) * STEP_S

    # another peak: the concordance falls to one half in between, or the lag is far away
    outside = np.flatnonzero(concordance < 0.5 * concordance[best])
    low = np.max(outside[outside < best], initial=-1)
    high = np.min(outside[outside > best], initial=len(count))
    is_other_peak = (count >= 0.5 * count[best]) & (power >= 0.25 * power[best]) & has_overlap
    is_other_peak &= concordance >= MIN_CONCORDANCE[reference.name]
    far = round(SEPARATE_LAG_S / STEP_S)
    is_other_peak[max(low + 1, best - far) : min(high, best + far + 1)] = False
    peak = Peak(lag(best), float(concordance[best]))
    if not is_other_peak.any():
        return peak
    # per axis; the floor makes two perfect matches equal
    square = np.maximum(power - 2.0 * real_covariance, 0.0) / (2.0 * np.maximum(count, 1.0))
    residual = np.sqrt(square + RESIDUAL_FLOOR_M**2)
    second_peak = int(np.argmin(np.where(is_other_peak, residual, np.inf)))
    ratio = float(residual[second_peak] / residual[best])
    return replace(peak, second_peak_s=lag(second_peak) - lag(best), second_peak_ratio=ratio)


def least_squares_fit(
    file: SampledTrack,
    reference: SampledTrack,
    peak: Peak,
    yaw_rad: float | None,
    *,
    clock_free: bool,
) -> Fit:
    """Fit origin and, if free, lag and yaw by robust least squares (soft L1).

    The origin is always free, even if it is not used: otherwise an offset of the file would be
    mistaken for a lag if the vehicle flies mostly in one direction. Covariance: σ²(JᵀJ)⁻¹ at the
    optimum, with σ from the median residual, times 1 + 2Σρ for autocorrelated residuals (ρ summed
    to its first zero).

    Raises
    ------
    NoMatchError
        Too few samples overlap the reference.
    """
    start, is_known = reference.at(file.time_s + peak.lag_s)
    used = is_known & file.valid
    if np.count_nonzero(used) < tracks.MIN_SAMPLES:
        raise NoMatchError(
            f"only {np.count_nonzero(used)} positions of the file overlap the reference in time"
        )
    time = file.time_s[used] + peak.lag_s
    z, target = file.horizontal_m[used], (start[:, 0] + 1j * start[:, 1])[used]
    centre = np.mean(z)
    z = z - centre  # makes yaw and origin uncorrelated
    power = float(np.sqrt(np.var(z) * np.var(target)))
    coherence = complex(np.vdot(z, target) / len(z) / power) if power > 0 else 0j
    mean_square = float(np.var(z) + np.var(target)) / 2.0
    horizontal = reference.horizontal_m

    def unpack(x: Array) -> tuple[complex, float, float]:
        """Return origin, lag relative to the start, and yaw."""
        shift = float(x[2]) if clock_free else 0.0
        return complex(x[0], x[1]), shift, float(x[-1]) if yaw_rad is None else yaw_rad

    def residual(x: Array) -> Array:
        origin, shift, yaw = unpack(x)
        r = np.exp(1j * yaw) * z + origin - np.interp(time + shift, reference.time_s, horizontal)
        return np.concatenate([r.real, r.imag])

    start_at = complex(np.mean(target))
    # free parameters: origin, lag, yaw
    free_parameters = [True, True, clock_free, yaw_rad is None]
    x0 = np.array([start_at.real, start_at.imag, 0.0, float(np.angle(coherence))])[free_parameters]
    limit = np.array([np.inf, np.inf, WINDOW_S, np.inf])[free_parameters]
    scale = _robust_scale(residual(x0))
    solution = least_squares(residual, x0, bounds=(-limit, limit), loss="soft_l1", f_scale=scale)
    (origin, shift, yaw), r = unpack(solution.x), residual(solution.x)
    r_complex = r[: len(z)] + 1j * r[len(z) :]
    jacobian = np.asarray(solution.jac)
    information = jacobian.T @ jacobian
    information += 1e-9 * np.diag(
        np.diag(information) + 1e-12
    )  # a singular matrix gives a huge variance
    variance = (
        np.diag(np.linalg.inv(information))
        * _robust_scale(r) ** 2
        * _autocorrelation_factor(r_complex)
    )
    sigma = np.sqrt(np.maximum(variance, 0.0))
    is_at_limit = clock_free and abs(shift) > 0.99 * WINDOW_S
    ned, _ = reference.at(time + shift)
    down = ned[:, 2] - file.position_m[used, 2]
    down = down[np.isfinite(down)]
    origin_down = float(np.median(down)) if len(down) else 0.0
    horizontal_rms = truncated_rms(np.abs(r_complex)) / np.sqrt(2.0)
    vertical_rms = truncated_rms(down - origin_down) if len(down) else 0.0
    concordance = peak.concordance
    if np.isnan(concordance):
        real_covariance = float((np.exp(-1j * yaw) * coherence).real)
        concordance = real_covariance * power / mean_square if power > 0 else 0.0
    origin -= np.exp(1j * yaw) * centre
    return Fit(
        lag_s=peak.lag_s + shift,
        lag_sigma_s=(np.inf if is_at_limit else float(sigma[2])) if clock_free else None,
        concordance=concordance,
        second_peak_s=peak.second_peak_s,
        second_peak_ratio=peak.second_peak_ratio,
        yaw_rad=yaw,
        yaw_sigma_rad=float(sigma[-1]) if yaw_rad is None else None,
        origin_m=np.array([origin.real, origin.imag, origin_down]),
        coherence=coherence,
        horizontal_rms_m=float(horizontal_rms),
        rms_m=float(np.sqrt(2.0 * horizontal_rms**2 + vertical_rms**2)),
    )


def _robust_scale(residual: Array) -> float:
    """Return the standard deviation from the median absolute residual, at least 1 mm."""
    return max(1.4826 * float(np.median(np.abs(residual))), 1e-3)


def _autocorrelation_factor(residual: Complex) -> float:
    """Return 1 + 2Σρ: number of correlated residuals per independent one."""
    limit = 3.0 * _robust_scale(np.abs(residual))
    clipped = residual * np.minimum(1.0, limit / np.maximum(np.abs(residual), 1e-12))
    rho = autocovariance(clipped)
    if rho[0] <= 0.0:
        return 1.0
    zero_crossings = np.flatnonzero(rho <= 0.0)
    first_zero = zero_crossings[0] if len(zero_crossings) else len(rho)
    return float(1.0 + 2.0 * np.sum(rho[1:first_zero]) / rho[0])


def truncated_rms(values_m: Array) -> float:
    """Return the RMS with values limited to MAX_DISTANCE_M."""
    return float(np.sqrt(np.mean(np.minimum(np.abs(values_m), MAX_DISTANCE_M) ** 2)))
