"""Estimation of the time offset between two recordings of the same motion.

Candidates are the peaks of the correlation of speeds. Least squares refines the best candidates.
"""

import math
from dataclasses import dataclass

import numpy as np
from msgspec import structs
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Slerp
from scipy.special import stdtrit

from px4fuse.core.arrays import Array, BoolArray, compute_median_interval_s, interpolate_columns
from px4fuse.core.record import Record, Span

from .alignment import Transform, compute_rms_length_m, umeyama
from .association import choose_gap_limit_s, is_bracketed
from .correlation import autocovariance, compute_moments
from .model import MIN_POSES, Trajectory

# Minimum step (s) of the time grid for the correlation of speeds
GRID_STEP_S = 0.05
MAX_GRID_SAMPLES = 200_000
# Standard deviation (s) of the Gaussian filter of positions, because their derivative is noisy
SMOOTHING_SIGMA_S = 0.25
# Minimum overlap in time, as fraction of the duration of the shorter trajectory
MIN_OVERLAP_FRACTION = 0.5
# Minimum number of overlapping poses, as fraction of the number at complete overlap
MIN_USED_POSES_FRACTION = 0.3
MAX_CANDIDATE_OFFSETS = 12
# Search for the time offset with the smallest ATE: half-width (s) of the first search, around a
# peak of the speed correlation
SEARCH_HALF_WIDTH_S = 0.5
# Search for the time offset with the smallest ATE: half-width (s) of the second search, around the
# result of the first
FINE_SEARCH_HALF_WIDTH_S = 0.1
# Minimum distance (s) between two peaks of the speed correlation
MIN_CORRELATION_PEAK_DISTANCE_S = 1.0
# Minimum correlation of the speeds of both trajectories at a candidate time offset
MIN_SPEED_CORRELATION = 0.3
# Minimum ratio of the residuals at second best and best time offset: limit of an F-test
MIN_SECOND_BEST_RESIDUAL_RATIO = 1.2
MAX_FITTED_POSES = 2000
# Maximum residual (RMS) of an accepted fit, divided by the extent (RMS) of the motion
MAX_RELATIVE_MISFIT = 0.5
# Lower limit of the residual ÷ extent of the motion (both RMS): below it, all fits count as equally
# good
MISFIT_FLOOR = 1e-3
# Shift, rotation and scale can have the same effect as a time offset. Minimum RMS of the velocity
# that they cannot explain ÷ RMS speed: below this limit, the time offset is not determinable
MIN_RESIDUAL_VELOCITY_FRACTION = 0.05
# Minimum correlation between the velocities of both trajectories, without the velocity that shift,
# rotation and scale explain
MIN_RESIDUAL_VELOCITY_CORRELATION = 0.5
# Maximum lag in the variance estimate of Newey and West (1987) ÷ correlation length
MAX_LAG_IN_CORRELATION_LENGTHS = 4
# Maximum half-width (s) of the 95 % interval of a time offset
MAX_INTERVAL_HALF_WIDTH_S = 0.5


class TimeOffset(Record, kw_only=True):
    """Time offset between two trajectories.

    Attributes
    ----------
    offset_s : float or None
        Offset to add to the timestamps of the estimate.
    interval_s : (float, float) or None
        95 % interval of the offset.
    is_determinable : bool
    reason : str
        Method of the estimate, or reason why there is no estimate.
    """

    offset_s: float | None = None
    interval_s: Span | None = None
    is_determinable: bool
    reason: str


def compute_clock_offset_s(estimate: Trajectory, reference: Trajectory) -> float | None:
    """Return the time offset (s) between two trajectories from UNIX times, or None."""
    if estimate.unix_offset_s is None or reference.unix_offset_s is None:
        return None
    return estimate.unix_offset_s - reference.unix_offset_s


def estimate_time_offset(estimate: Trajectory, reference: Trajectory) -> TimeOffset:
    """Estimate the time offset between two trajectories of the same motion.

    Motion at constant speed along a line or circle does not determine the offset.

    Sources: Padfield (2012) and Furrer (2017) for the correlation of speeds; Newey and West (1987)
    for the 95 % interval.
    """
    if compute_median_interval_s(estimate.time_s) >= compute_median_interval_s(reference.time_s):
        return _search_offset(estimate, reference)
    swapped_offset = _search_offset(reference, estimate)
    if swapped_offset.offset_s is None or swapped_offset.interval_s is None:
        return swapped_offset
    low_s, high_s = swapped_offset.interval_s
    return structs.replace(
        swapped_offset, offset_s=-swapped_offset.offset_s, interval_s=(-high_s, -low_s)
    )


def _search_offset(sparse_track: Trajectory, dense_track: Trajectory) -> TimeOffset:
    """Estimate the time offset to add to the timestamps of the trajectory with fewer poses.

    If several time offsets fit, the one nearest to the difference of the UNIX times is used.
    Without UNIX times, the time offset is then not determinable.
    """
    clock_offset_s = compute_clock_offset_s(sparse_track, dense_track)
    candidate_offsets_s = _find_candidate_offsets_s(sparse_track, dense_track)
    if clock_offset_s is not None:
        candidate_offsets_s.insert(0, clock_offset_s)
    if not candidate_offsets_s:
        return _make_unknown_offset(
            "the speeds of both trajectories are not correlated at any time offset (no motion, "
            "constant speed, or different flights)"
        )
    offset_fits = [
        _refine_offset(sparse_track, dense_track, offset_s, SEARCH_HALF_WIDTH_S)
        for offset_s in candidate_offsets_s
    ]
    accepted_fits = sorted(
        (fit for fit in offset_fits if fit and fit.compute_misfit() <= MAX_RELATIVE_MISFIT),
        key=_OffsetFit.compute_misfit,
    )
    if not accepted_fits:
        return _make_unknown_offset(
            "at all time offsets with correlated speeds, the positions do not match or too few "
            "poses overlap"
        )
    best_fit = accepted_fits[0]
    max_misfit = MIN_SECOND_BEST_RESIDUAL_RATIO * best_fit.compute_misfit()
    fits_similar_to_best = [fit for fit in accepted_fits if fit.compute_misfit() <= max_misfit]
    if clock_offset_s is not None:
        # If several time offsets fit equally well, use the one nearest to the offset from the UNIX
        # times of both trajectories
        best_fit = min(fits_similar_to_best, key=lambda fit: abs(fit.offset_s - clock_offset_s))
    else:
        for fit in fits_similar_to_best:
            offset_difference_s = abs(fit.offset_s - best_fit.offset_s)
            if offset_difference_s > MIN_CORRELATION_PEAK_DISTANCE_S:
                return _make_unknown_offset(
                    "the motion is periodic: two time offsets that differ by "
                    f"{offset_difference_s:.1f} s give an ATE of "
                    f"{best_fit.compute_residual_rms_m():.3g} m and "
                    f"{fit.compute_residual_rms_m():.3g} m"
                )
    # Repeat the fit in a narrower search window. A fit uses only poses that overlap with the other
    # trajectory at all tested offsets, so the narrower window allows more poses
    best_fit = (
        _refine_offset(sparse_track, dense_track, best_fit.offset_s, FINE_SEARCH_HALF_WIDTH_S)
        or best_fit
    )
    half_width_s = _compute_interval_half_width_s(sparse_track, dense_track, best_fit)
    if half_width_s > MAX_INTERVAL_HALF_WIDTH_S:
        interval_text = f" (95 %: ±{half_width_s:.2g} s)" if np.isfinite(half_width_s) else ""
        return _make_unknown_offset(
            "the speed is nearly constant, so a time offset cannot be distinguished from a "
            f"position offset{interval_text}"
        )
    return TimeOffset(
        offset_s=best_fit.offset_s,
        interval_s=(best_fit.offset_s - half_width_s, best_fit.offset_s + half_width_s),
        is_determinable=True,
        reason="The time offset is estimated from the speeds of both trajectories, and "
        "minimises the ATE "
        f"({best_fit.compute_residual_rms_m():.3g} m, {len(best_fit.time_s)} poses).",
    )


def _make_unknown_offset(reason: str) -> TimeOffset:
    return TimeOffset(
        is_determinable=False, reason=f"The time offset cannot be estimated: {reason}."
    )


def _choose_grid_step_s(*trajectories: Trajectory) -> float:
    """Return the step (s) of a time grid, which is larger for very long trajectories."""
    duration_s = max(float(np.ptp(trajectory.time_s)) for trajectory in trajectories)
    return max(GRID_STEP_S, duration_s / MAX_GRID_SAMPLES)


def _compute_grid_velocity(trajectory: Trajectory, step_s: float) -> tuple[Array, Array]:
    """Return the times (s) of a regular grid, and smoothed velocities (m/s) at these times."""
    time_s = trajectory.time_s
    grid_s = time_s[0] + step_s * np.arange(int(np.ptp(time_s) / step_s) + 1)
    grid_position_m = interpolate_columns(grid_s, time_s, trajectory.position_m)
    return grid_s, _smooth_values(grid_position_m, time_s, step_s, derivative_order=1) / step_s


def _smooth_values(
    grid_values: Array, time_s: Array, step_s: float, derivative_order: int = 0
) -> Array:
    """Smooth values on a time grid with a Gaussian filter.

    With ``derivative_order`` 1, return the derivative of the smoothed values per grid step.
    """
    from scipy.ndimage import gaussian_filter1d  # noqa: PLC0415 - slow import

    smoothing_sigma_samples = max(SMOOTHING_SIGMA_S, compute_median_interval_s(time_s)) / step_s
    return np.asarray(
        gaussian_filter1d(grid_values, smoothing_sigma_samples, axis=0, order=derivative_order)
    )


def _compute_velocity(trajectory: Trajectory, time_s: Array) -> Array:
    """Return the smoothed velocities (m/s) at given times, shape (n, 3)."""
    grid_s, velocity_m_s = _compute_grid_velocity(trajectory, _choose_grid_step_s(trajectory))
    return interpolate_columns(time_s, grid_s, velocity_m_s)


def _compute_speeds(trajectory: Trajectory, step_s: float) -> tuple[list[Array], BoolArray]:
    """Compute speed and angular speed on a time grid, and a mask of the times outside gaps."""
    time_s = trajectory.time_s
    grid_s, velocity_m_s = _compute_grid_velocity(trajectory, step_s)
    # A gap above this limit is a loss of tracking, not an interval between key frames
    is_known = is_bracketed(grid_s, time_s, max(10.0 * compute_median_interval_s(time_s), 0.5))
    linear_and_angular_speeds = [np.linalg.norm(velocity_m_s, axis=1)]
    if trajectory.rotation is not None:
        rotations = Slerp(time_s, trajectory.rotation)(grid_s)
        rates_rad_s = (rotations[:-1].inv() * rotations[1:]).as_rotvec() / step_s
        rates_rad_s = np.append(rates_rad_s, rates_rad_s[-1:], axis=0)
        smoothed_rates_rad_s = _smooth_values(rates_rad_s, time_s, step_s)
        linear_and_angular_speeds.append(np.linalg.norm(smoothed_rates_rad_s, axis=1))
    return linear_and_angular_speeds, is_known


def _find_candidate_offsets_s(sparse_track: Trajectory, dense_track: Trajectory) -> list[float]:
    """Find the time offsets with correlated speeds, best first (Padfield 2012, eqs. 3 to 9)."""
    from scipy.ndimage import maximum_filter1d  # noqa: PLC0415 - slow import

    step_s = _choose_grid_step_s(sparse_track, dense_track)
    shorter_duration_s = min(float(np.ptp(track.time_s)) for track in (sparse_track, dense_track))
    if shorter_duration_s < 10 * step_s:
        return []
    sparse_track_speeds, is_sparse_speed_known = _compute_speeds(sparse_track, step_s)
    dense_track_speeds, is_dense_speed_known = _compute_speeds(dense_track, step_s)
    # 1. Correlation at each lag: mean of the correlations of speed and angular speed. If a
    # trajectory has no orientations, only the speeds are correlated
    correlations = []
    for sparse_values, dense_values in zip(sparse_track_speeds, dense_track_speeds, strict=False):
        moments = compute_moments(
            sparse_values, dense_values, is_sparse_speed_known, is_dense_speed_known
        )
        is_usable = moments.count >= MIN_OVERLAP_FRACTION * shorter_duration_s / step_s
        # Both speeds must vary in the overlap: their variance must be at least 0.1 % of that of the
        # whole trajectory. At rest, it is a rounding error
        for values, is_known, square_sum in (
            (sparse_values, is_sparse_speed_known, moments.sum_of_squares_a),
            (dense_values, is_dense_speed_known, moments.sum_of_squares_b),
        ):
            mean_square = np.var(values[is_known]) * np.mean(is_known)
            is_usable &= square_sum > 1e-3 * mean_square * moments.count
        # With an infinite scale, the correlation at unusable lags is 0
        product_of_square_sums = moments.sum_of_squares_a * moments.sum_of_squares_b
        scale = np.sqrt(np.where(is_usable, product_of_square_sums, np.inf))
        correlations.append(moments.covariance.real / scale)
    correlation = np.mean(correlations, axis=0)
    # 2. Highest peaks of the correlation. A peak is the maximum of all lags around it
    sliding_maximum = maximum_filter1d(
        correlation, round(2 * MIN_CORRELATION_PEAK_DISTANCE_S / step_s) + 1
    )
    peak_indices = np.flatnonzero(
        (correlation == sliding_maximum) & (correlation > MIN_SPEED_CORRELATION)
    )
    peak_indices = peak_indices[np.argsort(-correlation[peak_indices])][:MAX_CANDIDATE_OFFSETS]
    # 3. Time offsets of the peaks. Correlation index k is a shift by k - (n - 1) samples, for n
    # sparse samples. The grids of both trajectories begin at their first poses
    sparse_start_indices = peak_indices - (len(is_sparse_speed_known) - 1)
    lags_s = sparse_start_indices * step_s + dense_track.time_s[0] - sparse_track.time_s[0]
    return list(lags_s.tolist())


@dataclass(frozen=True)
class _OffsetFit:
    """Fit of the trajectory with fewer poses (sparse) to the trajectory with more poses (dense).

    The arrays contain the times and positions of the compared poses.
    """

    offset_s: float
    transform: Transform
    time_s: Array
    aligned_position_m: Array
    dense_track_position_m: Array

    def compute_residual_rms_m(self) -> float:
        """Return the RMS distance (m) between the compared poses of both trajectories."""
        return compute_rms_length_m(self.dense_track_position_m - self.aligned_position_m)

    def compute_misfit(self) -> float:
        """Return the RMS position residual, relative to the extent of the trajectory.

        The extent is the RMS distance from the mean position, for the trajectory with more poses.
        """
        # A bad fit can shrink the sparse trajectory, so its extent is not used
        extent_m = float(np.sqrt(self.dense_track_position_m.var(axis=0).sum()))
        if extent_m == 0.0:
            return float("inf")
        return max(self.compute_residual_rms_m() / extent_m, MISFIT_FLOOR)


def _compute_interval_half_width_s(
    sparse_track: Trajectory, dense_track: Trajectory, fit: _OffsetFit
) -> float:
    """Compute the half-width (s) of the 95 % interval of the time offset.

    It is infinite if a shift or rotation of the trajectory has the same effect as a time offset.
    """
    pose_count = len(fit.time_s)
    # 1. A time offset dt changes the positions by velocity * dt. Velocities of both trajectories
    dense_track_velocity_m_s = _compute_velocity(dense_track, fit.time_s + fit.offset_s)
    sparse_track_velocity_m_s = fit.transform.to_rotation().apply(
        fit.transform.scale * _compute_velocity(sparse_track, fit.time_s)
    )
    # Shift, rotation and scale can have the same effect as a time offset. Remove the part of the
    # velocity that a change of these 7 parameters explains. Columns of the Jacobian: change of the
    # positions by a shift along each axis, by a rotation about each axis, and by the scale
    centred_m = fit.aligned_position_m - fit.aligned_position_m.mean(axis=0)
    columns = [np.tile(axis, (pose_count, 1)) for axis in np.eye(3)]
    columns += [np.cross(axis, centred_m) for axis in np.eye(3)]
    similarity_jacobian = np.stack([*columns, centred_m], axis=-1).reshape(3 * pose_count, 7)
    velocities = np.stack((dense_track_velocity_m_s, sparse_track_velocity_m_s), axis=-1).reshape(
        3 * pose_count, 2
    )
    residual_velocities = (
        velocities
        - similarity_jacobian @ np.linalg.lstsq(similarity_jacobian, velocities, rcond=None)[0]
    )
    dense_residuals, sparse_residuals = residual_velocities.T
    dense_track_square_sum = float(dense_residuals @ dense_residuals)
    sparse_track_square_sum = float(sparse_residuals @ sparse_residuals)
    # The remaining velocity, which shift, rotation and scale do not explain, must not be small. It
    # must be the same motion in both trajectories, not noise
    if (
        dense_track_square_sum
        <= MIN_RESIDUAL_VELOCITY_FRACTION**2 * float((dense_track_velocity_m_s**2).sum())
        or dense_residuals @ sparse_residuals
        <= MIN_RESIDUAL_VELOCITY_CORRELATION
        * (dense_track_square_sum * sparse_track_square_sum) ** 0.5
    ):
        return float("inf")
    # 4. The least-squares estimate of the time offset has σ = √(variance of Σ v·r) ÷ Σ v², with the
    # velocity v from step 2 and the position residual r. Successive products v·r are correlated, so
    # the variance of their sum also contains their autocovariances at other lags
    likelihood_score = (
        dense_residuals.reshape(pose_count, 3)
        * (fit.dense_track_position_m - fit.aligned_position_m)
    ).sum(axis=1)
    # The lags must exceed the correlation length (Newey and West 1987)
    lag_count = min(
        max(1, MAX_LAG_IN_CORRELATION_LENGTHS * _compute_correlation_length(likelihood_score)),
        pose_count // 4,
    )
    lag_weights = 1.0 - np.arange(1, lag_count + 1) / (lag_count + 1.0)
    variance_if_uncorrelated, *lagged_autocovariances = autocovariance(likelihood_score)[
        : lag_count + 1
    ]
    score_variance = variance_if_uncorrelated + max(
        2.0 * (lag_weights @ lagged_autocovariances), 0.0
    )
    # Each interval of lag_count poses counts as one independent value
    student_t_quantile = float(stdtrit(max(pose_count / lag_count - 1.0, 1.0), 0.975))
    return float(student_t_quantile * np.sqrt(score_variance) / dense_track_square_sum)


def _compute_correlation_length(values: Array) -> int:
    """Return the first lag (samples) with an autocorrelation below 1/e."""
    covariance_by_lag = autocovariance(values - values.mean())
    lags_below_limit = np.flatnonzero(covariance_by_lag < covariance_by_lag[0] / np.e)
    return int(lags_below_limit[0]) if len(lags_below_limit) else len(values) // 4


def _refine_offset(
    sparse_track: Trajectory, dense_track: Trajectory, lag_s: float, half_width_s: float
) -> _OffsetFit | None:
    """Minimise the ATE over time offsets near ``lag_s``; return None if too few poses overlap."""
    sparse_time_s = sparse_track.time_s
    gap_limit_s = max(
        choose_gap_limit_s(dense_track.time_s), 0.5 * choose_gap_limit_s(sparse_time_s)
    )
    # Use only poses that overlap with the other trajectory at all tested time offsets. With the
    # same poses, the sum of squared residuals is a continuous function of the offset
    is_known = [
        is_bracketed(sparse_time_s + (lag_s + shift), dense_track.time_s, gap_limit_s)
        for shift in (-half_width_s, 0.0, half_width_s)
    ]
    pose_indices = np.flatnonzero(np.all(is_known, axis=0))
    # A short dense trajectory can overlap with a part of the poses only
    duration_ratio = min(1.0, float(np.ptp(dense_track.time_s) / np.ptp(sparse_time_s)))
    min_pose_count = max(
        2 * MIN_POSES, MIN_USED_POSES_FRACTION * duration_ratio * len(sparse_time_s)
    )
    if len(pose_indices) < min_pose_count:
        return None
    stride = math.ceil(len(pose_indices) / MAX_FITTED_POSES)
    pose_indices = pose_indices[::stride]
    sparse_time_s = sparse_time_s[pose_indices]
    sparse_position_m = sparse_track.position_m[pose_indices]

    def make_fit(shift_s: float) -> _OffsetFit:
        """Fit the sparse trajectory to the dense one at the time offset lag_s + shift_s."""
        dense_track_position_m = interpolate_columns(
            sparse_time_s + (lag_s + shift_s), dense_track.time_s, dense_track.position_m
        )
        # The sparse trajectory is scaled, because a scale of the dense trajectory could be fitted
        # as zero
        transform = umeyama(sparse_position_m, dense_track_position_m, with_scale=True)
        return _OffsetFit(
            lag_s + shift_s,
            transform,
            sparse_time_s,
            transform.apply(sparse_position_m),
            dense_track_position_m,
        )

    def compute_cost(shift_s: float) -> float:
        """Return the sum of the squared position residuals (m²) at the offset lag_s + shift_s."""
        fit = make_fit(shift_s)
        return float(((fit.dense_track_position_m - fit.aligned_position_m) ** 2).sum())

    # Best of 21 shifts, then refinement between its neighbours. The optimiser has a relative
    # tolerance, so it varies the shift and not the large offset (up to 1e9 s)
    shifts_s = half_width_s * np.linspace(-1.0, 1.0, 21)
    best_index = int(np.argmin([compute_cost(shift_s) for shift_s in shifts_s]))
    neighbours = np.clip([best_index - 1, best_index + 1], 0, len(shifts_s) - 1)
    optimum = minimize_scalar(compute_cost, bounds=shifts_s[neighbours], method="bounded")
    return make_fit(float(optimum.x))
