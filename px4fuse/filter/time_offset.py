"""Time offset between position source and IMU, estimated by maximum likelihood.

The likelihood of the positions given the acceleration is maximised over time offset and noises.
Biases, tilt and scale are estimated too, because their effects are similar.

IMU noise increases the variance of the estimated time offset. The increase is simulated, and the
95 % interval is widened accordingly (sandwich estimate, White 1982).
"""

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.special import chdtrc

from px4fuse.core.arrays import Array
from px4fuse.core.record import NOT_IN_JSON, Count, NonNegativeFloat, NotInJson, Record, Share, Span
from px4fuse.flight.model import Columns, Flight, PositionTrack, Unavailable

from .fitting import NoiseParameters, add_noises
from .imu_motion import (
    COARSE_SEARCH_MEASUREMENT_COUNT,
    HEADING_SIGMA_RAD,
    MAX_TESTED_TIME_OFFSET_S,
    MotionCache,
    PositionsAndImuMotion,
    compute_imu_motion,
)
from .likelihood import (
    MAX_LOG_LIKELIHOOD_DROP,
    compute_profile_likelihood_interval,
    fit_parabola_vertex,
)
from .marginal_likelihood import compute_segment_inner_products
from .settings import Settings
from .signals import Segment, cut_to_segment, make_downsampling_slice

# Half-width (s) of the range of time offsets that is tested around the result of the coarse search
INITIAL_OFFSET_HALF_WIDTH_S = 0.1
# The likelihood curve shows the likelihood of the positions over the time offset. It covers the
# estimated time offset ± this multiple of its σ, and at least ± this time (s)
LIKELIHOOD_CURVE_HALF_WIDTH_SIGMAS, MIN_LIKELIHOOD_CURVE_HALF_WIDTH_S = 3.5, 0.01
# Width of the range of tested time offsets ÷ width of the likelihood curve. The curve is centred at
# the maximum-likelihood estimate, which is not exactly in the middle of this range
TESTED_TO_CURVE_WIDTH_RATIO = 1.3
# Number of tested time offsets near the maximum of the likelihood
FINE_GRID_OFFSET_COUNT = 11
# Maximum step (s) of the tested time offsets for an interpolation of the likelihood
MAX_INTERPOLATED_OFFSET_STEP_S = 0.05
# Number of time offsets for which the report shows the likelihood of the positions
LIKELIHOOD_CURVE_POINT_COUNT = 121
# Prior σ (rad; 11°) of EKF2's heading with GNSS. A wrong GNSS delay of 0.2 s alone causes 5° error
GNSS_HEADING_SIGMA_RAD = 0.2
# Tested differences (s): time offset of one part of the flight minus that of the whole flight
FLIGHT_PART_OFFSET_DIFFERENCES_S = np.concatenate(
    [np.linspace(-0.6, -0.3, 4), np.linspace(-0.2, 0.2, 9), np.linspace(0.3, 0.6, 4)]
)
# Maximum half-width (s) of the 95 % interval of an accepted time offset
MAX_OFFSET_INTERVAL_HALF_WIDTH_S = 0.15
# Flight segments with a larger σ (s) of the time offset are not used in the test for a change of
# the time offset
MAX_SEGMENT_OFFSET_SIGMA_S = 0.15
# The time offset changes in flight if the p-value of a constant offset is below this limit
MAX_P_VALUE_OF_CHANGED_OFFSET = 0.005
# Minimum change (s) of the time offset between source and IMU in flight: a smaller change may be
# drift of the source
MIN_TIME_OFFSET_CHANGE_S = 0.10
# Minimum ratio of a significant time offset to its σ
MIN_OFFSET_SIGMAS = 3.0
# Minimum significant time offset (s): position error of 3 cm at 1 m/s
MIN_TIME_OFFSET_S = 0.03
# The effect of IMU noise on the time offset is simulated for groups of successive flight segments.
# Minimum number of simulations (number of groups · noise series of each group), and number of
# segments in a group
IMU_NOISE_SIMULATION_COUNT, SEGMENTS_PER_NOISE_SIMULATION = 96, 12


class FlightPartTimeOffset(Record):
    """Time offset of the position source in one part of the flight, with its σ."""

    start_s: float
    end_s: float
    offset_s: float
    sigma_s: NonNegativeFloat


class SourceTimeOffset(Record, kw_only=True):
    """Time offset to add to the logged timestamps of the position source.

    Attributes
    ----------
    offset_s : float
        Maximum-likelihood estimate; negative if the timestamps are late.
    interval_s : (float, float)
        95 % interval.
    applied_s : float
        Time offset that was already added to the timestamps.
    is_determinable : bool
        True if the 95 % interval is narrow.
    parts : tuple of FlightPartTimeOffset
        Offsets of consecutive parts of the flight.
    drift_ppm, drift_sigma_ppm : float or None
        Clock drift of the source; None with fewer than three parts.
    change_p_value : float or None
        p-value of a constant offset; None with one part.
    likelihood_curve_offsets_s, curve_log_likelihood_drops : ndarray, shape (n,)
        Tested time offsets, and decrease of the log-likelihood from its maximum.
    """

    offset_s: float
    interval_s: Span
    sigma_s: NonNegativeFloat
    applied_s: float
    is_determinable: bool
    reason: str = ""
    drift_ppm: float | None = None
    drift_sigma_ppm: NonNegativeFloat | None = None
    change_p_value: Share | None = None
    parts: tuple[FlightPartTimeOffset, ...]
    count: Count
    likelihood_curve_offsets_s: NotInJson[Array] = NOT_IN_JSON
    curve_log_likelihood_drops: NotInJson[Array] = NOT_IN_JSON
    sigma_a_m_s2: NotInJson[float] = NOT_IN_JSON
    sigma_z_m: NotInJson[float] = NOT_IN_JSON

    @property
    def remaining_s(self) -> float:
        """Estimated time offset (s) minus the offset that is already in the timestamps."""
        return self.offset_s - self.applied_s

    @property
    def significance_limit_s(self) -> float:
        return MIN_OFFSET_SIGMAS * self.sigma_s

    def has_changed(self) -> bool:
        """Return True if the time offset of the source changes significantly in flight."""
        if self.change_p_value is None or self.change_p_value >= MAX_P_VALUE_OF_CHANGED_OFFSET:
            return False
        return abs(self.parts[-1].offset_s - self.parts[0].offset_s) >= MIN_TIME_OFFSET_CHANGE_S

    @property
    def min_significant_offset_s(self) -> float:
        """Smallest significant time offset (s)."""
        return max(MIN_TIME_OFFSET_S, self.significance_limit_s)

    def is_significant(self, offset_s: float) -> bool:
        return abs(offset_s) > self.min_significant_offset_s


def estimate_time_offset(
    flight: Flight,
    track: PositionTrack,
    segment: Segment,
    settings: Settings,
    noise_parameters: NoiseParameters,
    outlier_time_s: Array | None = None,
    progress: Callable[[str], None] = lambda _: None,
    motion_cache: MotionCache | None = None,
) -> SourceTimeOffset | Unavailable:
    """Estimate the time offset to add to the timestamps of a position source.

    Parameters
    ----------
    settings : Settings
        ``clock_offset_s`` is a time offset that was already added.
    noise_parameters : NoiseParameters
        Initial values; the random walk is above zero for odometry, which may drift.
    outlier_time_s : ndarray, optional
        Timestamps of measurements to exclude.
    progress : callable
        Called with the name of each step of the analysis.
    motion_cache : dict, optional
        IMU motion that is already computed; new motion is added.
    """
    # GNSS height is omitted: it is noisier than north and east, but the fit has one SIGMA_Z for all
    axis_count = 2 if track.origin.is_gnss else 3
    position_samples = cut_to_segment(track.samples, segment)[Columns.POSITION[:axis_count]]
    position_samples = position_samples.dropna(subset=Columns.POSITION[:2])
    if outlier_time_s is not None:
        position_samples = position_samples[~np.isin(position_samples.index, outlier_time_s)]
    position_samples = position_samples[make_downsampling_slice(position_samples.index.to_numpy())]
    imu_motion = compute_imu_motion(
        flight,
        position_samples.index.to_numpy(),
        position_samples.to_numpy(),
        axis_directions=np.eye(3)[:axis_count],
        dt_s=settings.dt_s,
        motion_cache=motion_cache,
        heading_sigma_rad=GNSS_HEADING_SIGMA_RAD if track.origin.is_gnss else HEADING_SIGMA_RAD,
    )
    if isinstance(imu_motion, Unavailable):
        return imu_motion
    # 1. Maximum-likelihood time offset: coarse search, then a fine grid with downsampled positions,
    # then with all. Each result is the middle of the next grid, and sets its width
    progress("time offset")
    downsampled_motion = imu_motion.downsample(COARSE_SEARCH_MEASUREMENT_COUNT)
    offset_s, _ = imu_motion.search_time_offset(noise_parameters)
    search_half_width_s = INITIAL_OFFSET_HALF_WIDTH_S
    for motion in (downsampled_motion, imu_motion):
        noise_parameters = motion.fit_noises(offset_s, noise_parameters).noise_parameters
        tested_offsets_s = _make_offset_grid(offset_s, search_half_width_s, FINE_GRID_OFFSET_COUNT)
        scores = motion.fit_at_offsets(tested_offsets_s, noise_parameters).compute_scores()[0]
        offset_s, offset_sigma_s = _fit_minimum_and_sigma(tested_offsets_s, scores)
        likelihood_curve_half_width_s = max(
            LIKELIHOOD_CURVE_HALF_WIDTH_SIGMAS * offset_sigma_s, MIN_LIKELIHOOD_CURVE_HALF_WIDTH_S
        )
        search_half_width_s = TESTED_TO_CURVE_WIDTH_RATIO * likelihood_curve_half_width_s
    # 2. 95 % interval, with the effect of IMU noise, from the likelihood curve. The results of the
    # last grid above are used
    offset_variance_factor = _simulate_variance_increase_by_imu_noise(
        imu_motion, offset_s, noise_parameters, offset_sigma_s**-2.0
    )
    curve = _compute_offset_likelihood_curve(
        imu_motion,
        noise_parameters,
        tested_offsets_s,
        scores,
        offset_s,
        likelihood_curve_half_width_s,
        MAX_LOG_LIKELIHOOD_DROP * offset_variance_factor,
    )
    offset_s = _fit_minimum_and_sigma(curve.offsets_s, curve.scores)[0]
    # An IMU sample is an average over its interval, so its time has an error of half an interval (1
    # σ). The 95 % interval of the time offset is widened by this error
    offset_resolution_s = 0.5 * imu_motion.imu_interval_s
    interval_low_s, interval_high_s = curve.widen_interval(offset_s, 1.96 * offset_resolution_s)
    rejection_reason = ""
    if (
        None in (curve.low_s, curve.high_s)
        or (interval_high_s - interval_low_s) / 2.0 > MAX_OFFSET_INTERVAL_HALF_WIDTH_S
    ):
        rejection_reason = (
            f"all time offsets from {interval_low_s:+.2f} s to {interval_high_s:+.2f} s fit the "
            "data almost equally well. Possible causes: the flight has little acceleration, or the "
            "positions are noisy"
        )
    # 3. Change of the time offset in flight
    applied_offset_s = settings.clock_offset_s
    parts: tuple[FlightPartTimeOffset, ...] = ()
    change_p_value = None
    if not rejection_reason:
        progress("change of the position source's time offset during the flight")
        parts, change_p_value = _estimate_flight_part_offsets(
            imu_motion, offset_s, noise_parameters, offset_variance_factor, applied_offset_s
        )
    drift_ppm, drift_sigma_ppm = _fit_clock_drift(parts)
    return SourceTimeOffset(
        offset_s=applied_offset_s + offset_s,
        interval_s=(applied_offset_s + interval_low_s, applied_offset_s + interval_high_s),
        applied_s=applied_offset_s,
        sigma_s=float(
            np.hypot(offset_sigma_s * np.sqrt(offset_variance_factor), offset_resolution_s)
        ),
        is_determinable=not rejection_reason,
        reason=rejection_reason,
        likelihood_curve_offsets_s=applied_offset_s + curve.offsets_s,
        curve_log_likelihood_drops=curve.scores - curve.scores.min(),
        parts=parts,
        drift_ppm=drift_ppm,
        drift_sigma_ppm=drift_sigma_ppm,
        change_p_value=change_p_value,
        sigma_a_m_s2=noise_parameters.sigma_a_m_s2,
        sigma_z_m=noise_parameters.sigma_z_m,
        count=len(imu_motion.time_s),
    )


class _LikelihoodCurve(NamedTuple):
    """-ln p (score) of the positions at time offsets, and the 95 % interval (s) of the offset.

    An end of the interval outside the search range is None.
    """

    offsets_s: Array
    scores: Array
    low_s: float | None
    high_s: float | None

    def widen_interval(self, offset_s: float, additional_half_width_s: float) -> Span:
        """Return the interval of the time offset, widened by an independent error.

        ``offset_s`` is the estimated time offset. ``additional_half_width_s`` is half the width of
        the 95 % interval of the independent error.
        """
        low_s = self.offsets_s[0] if self.low_s is None else self.low_s
        high_s = self.offsets_s[-1] if self.high_s is None else self.high_s
        low_half_width_s, high_half_width_s = np.hypot(
            [low_s - offset_s, high_s - offset_s], additional_half_width_s
        ).tolist()
        return offset_s - low_half_width_s, offset_s + high_half_width_s


def _compute_offset_likelihood_curve(
    motion: PositionsAndImuMotion,
    noise_parameters: NoiseParameters,
    tested_offsets_s: Array,
    tested_scores: Array,
    offset_s: float,
    half_width_s: float,
    max_score_increase: float,
) -> _LikelihoodCurve:
    """Compute -ln p of the positions as a function of the time offset.

    ``tested_scores`` contains -ln p of ``tested_offsets_s``. The curve is widened until it contains
    both ends of the 95 % interval of the time offset. At the ends, -ln p exceeds its minimum by
    ``max_score_increase``.
    """
    while True:
        offsets_s = _make_offset_grid(offset_s, half_width_s, LIKELIHOOD_CURVE_POINT_COUNT)
        # Interpolate the negative log-likelihood (-ln p) between tested time offsets. Test new
        # offsets outside the tested range, or if the spacing is too large for an interpolation
        if (
            offsets_s[0] < tested_offsets_s[0]
            or offsets_s[-1] > tested_offsets_s[-1]
            or tested_offsets_s[1] - tested_offsets_s[0] > MAX_INTERPOLATED_OFFSET_STEP_S
        ):
            tested_offsets_s = _make_offset_grid(offset_s, half_width_s, FINE_GRID_OFFSET_COUNT)
            tested_scores = motion.fit_at_offsets(
                tested_offsets_s, noise_parameters
            ).compute_scores()[0]
        scores = CubicSpline(tested_offsets_s, tested_scores)(offsets_s)
        interval_s = compute_profile_likelihood_interval(offsets_s, scores, max_score_increase)
        if None not in interval_s or half_width_s >= 2.0 * MAX_TESTED_TIME_OFFSET_S:
            return _LikelihoodCurve(offsets_s, scores, *interval_s)
        half_width_s *= 2.0


def _make_offset_grid(centre_s: float, half_width_s: float, offset_count: int) -> Array:
    """Return equally spaced time offsets (s) around a centre, inside the search range."""
    return np.linspace(
        max(centre_s - half_width_s, -MAX_TESTED_TIME_OFFSET_S),
        min(centre_s + half_width_s, MAX_TESTED_TIME_OFFSET_S),
        offset_count,
    )


def _simulate_variance_increase_by_imu_noise(
    imu_motion: PositionsAndImuMotion,
    offset_s: float,
    noise_parameters: NoiseParameters,
    fisher_information: float,
) -> float:
    """Return the factor by which IMU noise increases the variance of the time offset.

    Without IMU noise, the variance is 1 / ``fisher_information``. IMU noise is in the residuals and
    in the velocity, so its effect is not negligible.

    Method: the score (derivative of the log-likelihood with respect to the time offset) is the
    inner product of position residuals and velocity. The error of the score is the inner product of
    residuals and velocity noise; both are simulated. The variance of this error is computed for
    each group of successive flight segments, then summed over the groups.
    """
    # Draw noise: noise_series_count independent series for each axis and measurement or interval
    positions_at_offset = imu_motion.make_positions_at_offset(offset_s)
    is_within_segment = positions_at_offset.is_within_segment
    measurement_count = len(imu_motion.time_s)
    axis_count = len(imu_motion.axis_directions)
    rng = np.random.default_rng(measurement_count)
    first_segment_of_each_group = np.arange(
        0, len(imu_motion.segment_motions), SEGMENTS_PER_NOISE_SIMULATION
    )
    noise_series_count = -(-IMU_NOISE_SIMULATION_COUNT // len(first_segment_of_each_group))

    def draw_normal(count: int) -> Array:
        """Return standard normal noise, shape (axes, noise series, count)."""
        return rng.standard_normal((count, axis_count, noise_series_count)).transpose(1, 2, 0)

    q00, q01, q11 = (
        noise_parameters.sigma_a_m_s2**2
        * positions_at_offset.process_noise_per_sigma_a_squared[:, is_within_segment]
    )
    # Noise of Δp and Δv with the covariance Q, drawn as Δp and Δv given Δp
    dp_noise = np.sqrt(q00) * draw_normal(len(q00))
    dv_noise = np.sqrt(q11 - q01**2 / q00) * draw_normal(len(q00)) + q01 / q00 * dp_noise
    error_m = noise_parameters.sigma_z_m * draw_normal(measurement_count)
    # The random walk changes the positions, but not the velocity from the IMU
    if noise_parameters.random_walk_m:
        interval_s = positions_at_offset.interval_s[is_within_segment]
        random_walk_m = noise_parameters.random_walk_m * np.sqrt(interval_s)
        dp_noise += random_walk_m * draw_normal(len(q00))
    dp, dv = np.zeros((2, axis_count, noise_series_count, measurement_count - 1))
    dp[..., is_within_segment], dv[..., is_within_segment] = dp_noise, dv_noise
    # Velocity noise of the IMU: sum of the noise of Δv since the start of the segment
    velocity_noise = np.zeros_like(error_m)
    for begin, end in pairwise(imu_motion.segment_edges.tolist()):
        np.cumsum(dv[..., begin : end - 1], axis=-1, out=velocity_noise[..., begin + 1 : end])
    # The error of the score is the inner product of the simulated residuals (error_m, dp, dv) and
    # the velocity noise. It is computed for each segment and each noise series. Its variance over
    # the series, summed over groups of segments, increases the variance of the score
    positions_at_offset, measurement_variance_m2 = add_noises(
        positions_at_offset, noise_parameters, imu_motion.measurement_weights
    )
    residual_and_noise_inner_products = compute_segment_inner_products(
        positions_at_offset,
        noise_parameters.sigma_a_m_s2,
        measurement_variance_m2,
        (error_m, dp, dv),
        velocity_noise,
    )
    group_sums = np.add.reduceat(residual_and_noise_inner_products, first_segment_of_each_group)
    return 1.0 + float(group_sums.var(axis=1).sum()) / fisher_information


def _fit_minimum_and_sigma(grid: Array, scores: Array) -> tuple[float, float]:
    """Fit a parabola to -ln p on a grid; return its minimiser, and σ from its curvature."""
    lowest_index = int(np.argmin(scores))
    middle_index = min(max(lowest_index, 1), len(grid) - 2)
    grid_step = grid[1] - grid[0]
    vertex_shift, curvature = fit_parabola_vertex(scores, middle_index)
    if curvature <= 0.0:
        return float(grid[lowest_index]), float(grid[-1] - grid[0])
    minimiser = grid[middle_index] + np.clip(vertex_shift, -1.0, 1.0) * grid_step
    return float(minimiser), float(grid_step / np.sqrt(curvature))


def _estimate_flight_part_offsets(
    imu_motion: PositionsAndImuMotion,
    offset_s: float,
    noise_parameters: NoiseParameters,
    offset_variance_factor: float,
    applied_offset_s: float,
) -> tuple[tuple[FlightPartTimeOffset, ...], float | None]:
    """Estimate the time offset of the source in each flight segment.

    Return also the p-value of a test for a constant time offset; None with fewer than two
    estimates. ``applied_offset_s``, which was already added to the timestamps, is added to each
    estimate.
    """
    # -ln p of each segment at a few time offsets, interpolated to a fine grid
    coarse_offsets_s = offset_s + FLIGHT_PART_OFFSET_DIFFERENCES_S
    coarse_offsets_s = coarse_offsets_s[np.abs(coarse_offsets_s) <= MAX_TESTED_TIME_OFFSET_S]
    segment_scores_at_coarse_offsets = imu_motion.fit_at_offsets(
        coarse_offsets_s, noise_parameters
    ).compute_segment_scores()[0]
    grid_offsets_s = np.linspace(
        coarse_offsets_s[0], coarse_offsets_s[-1], LIKELIHOOD_CURVE_POINT_COUNT
    )
    spline = CubicSpline(coarse_offsets_s, segment_scores_at_coarse_offsets, axis=1)
    part_offsets = []
    score_excesses = []
    for (begin, end), scores in zip(
        pairwise(imu_motion.segment_edges), spline(grid_offsets_s), strict=True
    ):
        part_offset_s, sigma_s = _fit_minimum_and_sigma(grid_offsets_s, scores)
        # σ from the curvature omits the effect of IMU noise on the variance
        sigma_s *= float(np.sqrt(offset_variance_factor))
        if sigma_s < MAX_SEGMENT_OFFSET_SIGMA_S:
            start_s, end_s = imu_motion.time_s[[begin, end - 1]].tolist()
            part_offsets.append(
                FlightPartTimeOffset(start_s, end_s, applied_offset_s + part_offset_s, sigma_s)
            )
            score_excesses.append(scores - scores.min())
    if len(part_offsets) < 2:
        return tuple(part_offsets), None
    # Likelihood-ratio test of one common time offset against a separate time offset of each
    # segment. score_excesses contains -ln p minus its minimum in each segment. IMU noise increases
    # the variance of the offsets, so χ² is divided by the variance factor
    chi_square = 2.0 * float(np.sum(score_excesses, axis=0).min()) / offset_variance_factor
    return tuple(part_offsets), float(chdtrc(len(part_offsets) - 1, chi_square))


def _fit_clock_drift(
    part_offsets: tuple[FlightPartTimeOffset, ...],
) -> tuple[float | None, float | None]:
    """Return clock drift and its σ (ppm) of the source; None with fewer than three flight parts."""
    if len(part_offsets) < 3:
        return None, None
    time_s, offset_s, sigma_s = np.transpose(
        [((part.start_s + part.end_s) / 2.0, part.offset_s, part.sigma_s) for part in part_offsets]
    )
    coefficients, covariance = np.polyfit(
        time_s - time_s.mean(), offset_s, 1, w=1.0 / sigma_s, cov="unscaled"
    )
    return float(coefficients[0]) * 1e6, float(np.sqrt(covariance[0, 0])) * 1e6
