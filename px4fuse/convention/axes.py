"""Search for axes, unit, rotation and delay of a position source, by comparison with the IMU.

1. Grid search: compare each combination of axes, unit and time offset with the motion from the IMU.
2. Least squares: refine the best combinations.

Residuals (m) have a Student distribution. The log likelihood of a combination is relative to the
hypothesis that positions and IMU motion are independent.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import product
from typing import Final, NamedTuple

import numpy as np
import pandas as pd

from px4fuse.core.arrays import Array, ArrayPair, ComplexArray, IntArray

from .model import AxisDirections, Direction, HeadingSource, Unit
from .motion import (
    GRID_INTERVAL_S,
    SECOND_DIFFERENCE_WINDOW_S,
    ImuSecondDifferences,
    SourceSecondDifferences,
)

# Maximum tested time offset (s) of the positions
MAX_TIME_OFFSET_S = 10.0
# Minimum time (s) with positions and IMU data, to determine axes, unit and time offset
MIN_OVERLAP_S = 10.0
# Residuals are second differences of the positions minus those of the doubly integrated
# acceleration. Minimum σ (m) of the horizontal residuals: IMU noise and tilt errors are always
# present
MIN_HORIZONTAL_RESIDUAL_SIGMA_M = 0.05
# Minimum σ (m) of the vertical residuals (positions minus doubly integrated acceleration)
MIN_VERTICAL_RESIDUAL_SIGMA_M = 0.08
# Degrees of freedom of the Student distribution of horizontal and vertical residuals
STUDENT_DEGREES_OF_FREEDOM = 4.0
METRES_PER_UNIT: Final[dict[Unit, float]] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "feet": 0.3048}
# A frame that is rotated from NED by at most this angle (rad) is a misaligned NED frame
SMALL_ROTATION_RAD = np.radians(8.0)

# Time offsets up to this value (s) are equally probable a priori
SMALL_TIME_OFFSET_S = 0.3
# Log prior odds of a source frame whose horizontal axes are rotated by more than SMALL_ROTATION_RAD
# from the nearest of the directions north, east, south and west
LARGE_ROTATION_LOG_PRIOR_ODDS = -1.0
# Log prior odds of a source frame whose horizontal axes have an estimated rotation of at most
# SMALL_ROTATION_RAD from the nearest of the directions north, east, south and west
SMALL_ROTATION_LOG_PRIOR_ODDS = -0.5
# Log prior odds of a time offset above SMALL_TIME_OFFSET_S
LARGE_TIME_OFFSET_LOG_PRIOR_ODDS = -2.0
# Log prior odds of a unit other than metres
UNIT_OTHER_THAN_METRES_LOG_PRIOR_ODDS = -2.0
# σ (m) of barometer heights
BAROMETER_SIGMA_M = 0.5
# Comparison of the positions with barometer heights: assumed number of independent height errors in
# a flight
INDEPENDENT_HEIGHT_ERROR_COUNT = 6.0
# Larger differences (m) between positions and barometer heights count as this value, so that
# outliers have little effect
MAX_HEIGHT_ERROR_M = 20.0 * BAROMETER_SIGMA_M
MAX_REFINED_HYPOTHESES = 8
# A hypothesis is a combination of axes, unit and delay of the positions. Least squares refine only
# hypotheses whose log-likelihood is at most this value (nats) below the largest
MAX_SCORE_DEFICIT_OF_REFINED_HYPOTHESES = 60.0
# Maximum number of second differences of the positions in one least-squares fit, to limit the
# computing time
MAX_REFINEMENT_ROWS = 1200
MAX_REFINEMENT_ITERATIONS = 7
# The least-squares fit of a hypothesis stops at a smaller change of its score (nats): a parameter
# then moves by 0.14 σ at most
MIN_SCORE_CHANGE = 0.01
# Maximum change (s) of the time offset in one Gauss-Newton iteration
MAX_TIME_OFFSET_STEP_S = 0.15
# Indices of Hypothesis.parameters; the last three parameters are the accelerometer bias
DELAY, HEADING, HEADING_DRIFT, CLOCK_DRIFT = range(4)
# Prior precision (σ⁻²) of Hypothesis.parameters: gyroscope heading drift (0.05 °/s), accelerometer
# bias (0.3 m/s²)
PARAMETER_PRIOR_PRECISION = np.array([0.0, 0.0, np.radians(0.05) ** -2, 0.0, *[0.3**-2] * 3])
CLOCKWISE_DIRECTIONS: tuple[Direction, ...] = ("north", "east", "south", "west")
# Log prior odds of common directions of x, y, z
LOG_PRIOR_ODDS_BY_AXES: Final[dict[AxisDirections, float]] = {
    ("north", "east", "down"): 1.0,  # NED, the convention of PX4
    ("east", "north", "up"): -0.5,
    ("north", "west", "up"): -1.0,
    ("north", "east", "up"): -2.5,  # NED, but z inverted
    ("east", "north", "down"): -2.5,  # NED with x and y exchanged
    ("north", "west", "down"): -2.5,  # NED, but y inverted
}


class SignedAxisPermutation(NamedTuple):
    """Choice of the vertical axis and of two horizontal axes among x, y and z.

    Attributes
    ----------
    vertical_axis, first_horizontal_axis, second_horizontal_axis : int
        Indices (0: x, 1: y, 2: z) of the vertical axis and of the horizontal axes.
    vertical_sign : {1, -1}
        1 if the vertical axis points down.
    handedness : {1, -1}
        1 if ``second_horizontal_axis`` is 90° clockwise from ``first_horizontal_axis``.
    """

    vertical_axis: int
    vertical_sign: int
    first_horizontal_axis: int
    second_horizontal_axis: int
    handedness: int

    @property
    def is_mirrored(self) -> bool:
        """True if x, y, z are a left-handed frame."""
        return (self.vertical_sign * self.handedness < 0) != (self.vertical_axis == 1)

    def combine_horizontal_axes(self, positions: Array) -> ComplexArray:
        """Return the horizontal positions as complex numbers: first axis + i · second axis.

        The product with e^{i·heading} is north + i · east, with the heading of the first axis.
        """
        return (
            positions[:, self.first_horizontal_axis]
            + 1j * self.handedness * positions[:, self.second_horizontal_axis]
        )

    def compute_axis_directions(self, quarter_turns: int) -> AxisDirections:
        """Return the directions of x, y, z.

        The first horizontal axis points ``quarter_turns`` · 90° clockwise from north.
        """
        directions: list[Direction] = ["down" if self.vertical_sign > 0 else "up"] * 3
        directions[self.first_horizontal_axis] = CLOCKWISE_DIRECTIONS[quarter_turns % 4]
        directions[self.second_horizontal_axis] = CLOCKWISE_DIRECTIONS[
            (quarter_turns + self.handedness) % 4
        ]
        return directions[0], directions[1], directions[2]

    def compute_log_prior_odds(self, quarter_turns: int) -> float:
        """Return the log prior odds (nats) of the axis directions after ``quarter_turns`` · 90°."""
        axes = self.compute_axis_directions(quarter_turns)
        if axes in LOG_PRIOR_ODDS_BY_AXES:
            return LOG_PRIOR_ODDS_BY_AXES[axes]
        if self.is_mirrored:
            return -5.0
        return -2.0 if self.vertical_axis == 2 or axes[1] == "up" else -4.0


SIGNED_AXIS_PERMUTATIONS = tuple(
    SignedAxisPermutation(vertical, sign, 0 if vertical else 1, 1 if vertical == 2 else 2, hand)
    for vertical, sign, hand in product(range(3), (1, -1), (1, -1))
)


@dataclass(frozen=True)
class SentPositions:
    """Positions in the axes, unit and clock of their source, and heights from the barometer.

    The heights are in column ``down_m`` of ``barometer``.
    """

    time_s: Array
    position_m: Array
    max_time_offset_s: float
    barometer: pd.DataFrame | None

    def remove_clock_drift(self, clock_drift: float) -> "SentPositions":
        return replace(self, time_s=correct_clock_drift(self.time_s, clock_drift))

    def compute_second_differences(self, imu: ImuSecondDifferences) -> SourceSecondDifferences:
        """Return second differences of the positions over the time span of ``imu``."""
        margin_steps = round(self.max_time_offset_s / GRID_INTERVAL_S)
        grid_s = imu.time_s[0] + GRID_INTERVAL_S * np.arange(
            -margin_steps, len(imu.time_s) + margin_steps
        )
        return SourceSecondDifferences.from_positions(self.time_s, self.position_m, grid_s)


@dataclass(frozen=True)
class Hypothesis:
    """Hypothesis on the axes, unit, rotation and delay of a source's positions.

    Attributes
    ----------
    parameters : ndarray, shape (7,)
        Delay (s), heading of the first horizontal axis (rad), heading drift of the gyroscopes
        (rad/s), clock drift (s/s), and accelerometer bias in FRD (m/s², 3 values).
    score : float
        Log likelihood plus log prior odds (nats).
    has_rotation : bool
        False if the rotation is fixed to a multiple of 90°.
    min_source_to_imu_displacement_ratio, max_source_to_imu_displacement_ratio : float
        Bounds of the scale factor of the positions: displacement according to the source ÷
        displacement according to the IMU. Noise of the source affects only the upper bound.
    residual_sigma_m : float
        Scale (m) of the Student distribution of the horizontal residuals.
    independent_residual_count : float
        Number of independent residuals.
    """

    axis_permutation: SignedAxisPermutation
    unit: Unit
    parameters: Array
    score: float
    has_rotation: bool = True
    has_clock_drift: bool = False
    min_source_to_imu_displacement_ratio: float = 1.0
    max_source_to_imu_displacement_ratio: float = 1.0
    residual_sigma_m: float = 0.0
    independent_residual_count: float = 0.0
    heading_from: HeadingSource = "EKF2"

    @property
    def delay_s(self) -> float:
        """Time (s) by which the timestamps are later than the measurements."""
        return float(self.parameters[DELAY])

    @property
    def quarter_turns(self) -> int:
        """Heading of the source's first horizontal axis, rounded to units of 90° (0: north)."""
        return round(float(self.parameters[HEADING]) / (np.pi / 2.0))

    @property
    def axes(self) -> AxisDirections:
        """Directions of x, y, z of the positions, rounded to multiples of 90°."""
        return self.axis_permutation.compute_axis_directions(self.quarter_turns)

    @property
    def heading_minus_quarter_turns_rad(self) -> float:
        """Heading (rad) of the source's first horizontal axis minus quarter_turns · 90°."""
        return float(self.parameters[HEADING] - self.quarter_turns * np.pi / 2.0)

    def is_similar_to(self, other: "Hypothesis", max_difference_rad: float = np.pi / 4.0) -> bool:
        """Return True if axes and unit are equal, and delay and heading differ little."""
        heading_difference_rad = self.parameters[HEADING] - other.parameters[HEADING]
        return bool(
            abs(self.delay_s - other.delay_s) < 0.5
            and abs(np.angle(np.exp(1j * heading_difference_rad))) < max_difference_rad
            and (self.axis_permutation, self.unit) == (other.axis_permutation, other.unit)
        )


def correct_clock_drift(time_s: Array, clock_drift: float) -> Array:
    """Remove the drift of a clock (rate minus 1) from timestamps; their mean does not change."""
    mean_time_s = np.mean(time_s)
    return mean_time_s + (time_s - mean_time_s) / (1.0 + clock_drift)


def search_hypotheses(
    positions: SentPositions,
    imu_motion_by_heading_source: Mapping[HeadingSource, ImuSecondDifferences],
) -> list[Hypothesis]:
    """Return the likely hypotheses on axes, unit and delay of the positions, best first."""
    hypotheses = list[Hypothesis]()
    for heading_from, imu_motion in imu_motion_by_heading_source.items():
        source_motion = positions.compute_second_differences(imu_motion)
        for candidate in find_convention_candidates(source_motion, imu_motion):
            start_hypotheses = [replace(candidate, heading_from=heading_from)]
            # If the first estimate of the rotation is small, also test a heading that is fixed to a
            # multiple of 90°: this hypothesis has one parameter less
            rotation_rad = candidate.heading_minus_quarter_turns_rad
            if abs(rotation_rad) < 3.0 * SMALL_ROTATION_RAD:
                parameters = candidate.parameters.copy()
                parameters[HEADING] -= rotation_rad
                start_hypotheses.append(
                    replace(start_hypotheses[0], parameters=parameters, has_rotation=False)
                )
            hypotheses += (
                refine_hypothesis(start_hypothesis, positions, source_motion, imu_motion)
                for start_hypothesis in start_hypotheses
            )
    return sorted(
        (hypothesis for hypothesis in hypotheses if hypothesis.score > -np.inf),
        key=lambda hypothesis: -hypothesis.score,
    )


def _compute_cross_moments(source_values: Array, imu_values: Array) -> Array:
    """Return Σ source·IMU at each time offset, for each source column and each IMU column."""
    windows = np.lib.stride_tricks.sliding_window_view(source_values, len(imu_values), axis=0)
    return windows @ imu_values


def find_convention_candidates(
    source_motion: SourceSecondDifferences, imu_motion: ImuSecondDifferences
) -> list[Hypothesis]:
    """Return the likely combinations of axes, unit and time offset, most likely first."""
    # Invalid second differences are 0
    source, imu_m = source_motion.second_differences, imu_motion.table[..., 0].copy()
    source_is_valid, imu_is_valid = (
        motion.is_valid[:, None].astype(float) for motion in (source_motion, imu_motion)
    )
    # The product of the masks is 1 if both samples are valid. Their sum counts these samples
    common_sample_counts = _compute_cross_moments(source_is_valid, imu_is_valid)

    has_overlap = common_sample_counts[:, 0, 0] * GRID_INTERVAL_S >= MIN_OVERLAP_S
    if not has_overlap.any():
        return []
    delay_s = (np.flatnonzero(has_overlap) - (len(has_overlap) - 1) / 2.0) * GRID_INTERVAL_S
    # Means over the common samples: products of source axes and IMU axes (NED), squares of source
    # axes, squares of IMU axes
    products, source_mean_squares, imu_mean_squares = (
        _compute_cross_moments(source_values, imu_values)[has_overlap]
        / common_sample_counts[has_overlap]
        for source_values, imu_values in (
            (source, imu_m),
            (source**2, imu_is_valid),
            (source_is_valid, imu_m**2),
        )
    )
    # If z is constant, the source measures no height, and z is the vertical axis
    permutations = [
        permutation
        for permutation in SIGNED_AXIS_PERMUTATIONS
        if permutation.vertical_axis == 2 or source[:, 2].any()
    ]
    score, rotation_rad = _compute_log_likelihoods(
        products, source_mean_squares, imu_mean_squares, permutations
    )
    # The log-likelihood per residual is multiplied by the number of independent residuals
    score *= common_sample_counts[has_overlap] * (GRID_INTERVAL_S / SECOND_DIFFERENCE_WINDOW_S)
    nearest_quarter_turns = np.round(rotation_rad / (np.pi / 2.0)).astype(int) % 4
    hypotheses = []
    for quarter_turns, (column, permutation), (unit_index, unit) in product(
        range(4), enumerate(permutations), enumerate(METRES_PER_UNIT)
    ):
        # Keep the best time offset of each axis permutation, quarter turns and unit. Only time
        # offsets count whose best rotation, rounded to 90°, gives these quarter turns
        scores_at_quarter_turns = np.where(
            nearest_quarter_turns[:, column] == quarter_turns, score[:, column, unit_index], -np.inf
        )
        offset_index = np.argmax(scores_at_quarter_turns)
        total_score = (
            scores_at_quarter_turns[offset_index]
            + permutation.compute_log_prior_odds(quarter_turns)
            + UNIT_OTHER_THAN_METRES_LOG_PRIOR_ODDS * (unit != "m")
        )
        # The least-squares fit starts without heading drift, clock drift and accelerometer bias
        parameters = np.zeros_like(PARAMETER_PRIOR_PRECISION)
        parameters[[DELAY, HEADING]] = delay_s[offset_index], rotation_rad[offset_index, column]
        hypotheses.append(Hypothesis(permutation, unit, parameters, float(total_score)))
    hypotheses.sort(key=lambda hypothesis: -hypothesis.score)
    return [
        hypothesis
        for hypothesis in hypotheses[:MAX_REFINED_HYPOTHESES]
        if hypothesis.score > hypotheses[0].score - MAX_SCORE_DEFICIT_OF_REFINED_HYPOTHESES
    ]


def _compute_log_likelihoods(
    products: Array,
    source_mean_squares: Array,
    imu_squares_m2: Array,
    permutations: list[SignedAxisPermutation],
) -> ArrayPair:
    """Compute the log likelihood of each combination of axes, unit and time offset.

    Each combination has the rotation about the vertical with the smallest residuals. The log
    likelihood is relative to the hypothesis that positions and IMU motion are independent.

    Parameters
    ----------
    products : ndarray, shape (offsets, 3, 3)
        Mean products of second differences: axes of the source times north, east, down of the IMU.
    source_mean_squares : ndarray, shape (offsets, 3, 1)
        Mean squares of the second differences along the source's axes.
    imu_squares_m2 : ndarray, shape (offsets, 1, 3)
        Mean squares of the second differences from the IMU.

    Returns
    -------
    log_likelihood_per_residual : ndarray, shape (offsets, permutations, units)
    rotation_rad : ndarray, shape (offsets, permutations)
        Heading of the source's first horizontal axis with the smallest residuals.
    """
    vertical_axis, vertical_sign, first_horizontal_axis, second_horizontal_axis, handedness = (
        np.transpose(permutations)
    )
    metres_per_unit = np.array([*METRES_PER_UNIT.values()])
    # Horizontal vectors are complex numbers: first + i · handedness · second axis for the source,
    # and north + i · east for the IMU. The phase of the correlation, the mean of conj(source) ·
    # IMU, is the rotation with the smallest residuals
    horizontal_products = products[..., 0] + 1j * products[..., 1]
    correlation = (
        horizontal_products[:, first_horizontal_axis]
        - 1j * handedness * horizontal_products[:, second_horizontal_axis]
    )
    source_mean_squares = np.maximum(source_mean_squares, 1e-12)

    # Mean square (MS) residual after the best rotation, with u metres per unit:
    # u² · MS(source) + MS(IMU) - 2 · u · |correlation|. Division by 2 gives the mean of both axes
    horizontal_mean_square_residual_m2 = (
        metres_per_unit**2
        * (
            source_mean_squares[:, first_horizontal_axis]
            + source_mean_squares[:, second_horizontal_axis]
        )
        + imu_squares_m2[..., :2].sum(axis=2, keepdims=True)
        - 2.0 * metres_per_unit * np.abs(correlation)[..., None]
    ) / 2.0
    down_mean_square_residual_m2 = (
        metres_per_unit**2 * source_mean_squares[:, vertical_axis]
        + imu_squares_m2[..., 2:]
        - 2.0 * metres_per_unit * (vertical_sign * products[:, vertical_axis, 2])[..., None]
    )
    # For normal residuals, the log likelihood ratio is ½ ln(variance of the source axis ÷ variance
    # of its residuals), summed over 3 axes. Conversion to metres multiplies each source variance by
    # u², which adds 6 ln u to the logarithms
    log_likelihood_per_residual = 0.5 * (
        np.log(source_mean_squares).sum(axis=1, keepdims=True)
        + 6.0 * np.log(metres_per_unit)
        - 2.0
        * np.log(np.maximum(horizontal_mean_square_residual_m2, MIN_HORIZONTAL_RESIDUAL_SIGMA_M**2))
        - np.log(np.maximum(down_mean_square_residual_m2, MIN_VERTICAL_RESIDUAL_SIGMA_M**2))
    )
    return log_likelihood_per_residual, np.angle(correlation)


def refine_hypothesis(
    initial_hypothesis: Hypothesis,
    positions: SentPositions,
    source_motion: SourceSecondDifferences,
    imu_motion: ImuSecondDifferences,
) -> Hypothesis:
    """Refine the parameters of a hypothesis on the source's axes (robust Gauss-Newton).

    The parameters are delay, heading, heading drift of the gyroscopes, clock drift and
    accelerometer bias. The score of the returned hypothesis includes the log prior odds.
    """
    rows = np.flatnonzero(source_motion.is_valid)
    rows = rows[:: max(1, len(rows) // MAX_REFINEMENT_ROWS)]
    best_hypothesis = replace(initial_hypothesis, score=-np.inf)
    parameters = initial_hypothesis.parameters
    previous_score = -np.inf
    for _ in range(MAX_REFINEMENT_ITERATIONS):
        evaluation = _evaluate_hypothesis(
            replace(initial_hypothesis, parameters=parameters), rows, source_motion, imu_motion
        )
        if not evaluation:
            break
        hypothesis, parameter_step = evaluation
        if hypothesis.score > best_hypothesis.score:
            best_hypothesis = hypothesis
        if abs(hypothesis.score - previous_score) < MIN_SCORE_CHANGE:
            break
        previous_score = hypothesis.score
        parameters = parameters + parameter_step
    return replace(
        best_hypothesis,
        score=best_hypothesis.score + _compute_total_log_odds(best_hypothesis, positions),
    )


def _evaluate_hypothesis(
    hypothesis: Hypothesis,
    rows: IntArray,
    source_motion: SourceSecondDifferences,
    imu_motion: ImuSecondDifferences,
) -> tuple[Hypothesis, Array] | None:
    """Compute the score of a hypothesis on the source's axes, and the next Gauss-Newton step.

    The score is the log likelihood of the source's second differences, given those from the IMU.
    The step is added to the parameters of the hypothesis. Return None if source and IMU have too
    few common samples, or no motion.
    """
    delay_s, rotation_rad, heading_drift_rad_s, clock_drift, *accelerometer_bias_m_s2 = (
        hypothesis.parameters
    )
    # 1. Rows of the IMU at the times of the source, corrected for delay and clock drift
    time_s = source_motion.time_s[rows]
    row_interval_s = GRID_INTERVAL_S * np.median(np.diff(rows))
    mean_time_s = np.mean(time_s)
    measurement_time_s = time_s - delay_s - clock_drift * (time_s - mean_time_s)
    fractional_grid_index = (measurement_time_s - imu_motion.time_s[0]) / GRID_INTERVAL_S
    grid_index = np.clip(np.floor(fractional_grid_index).astype(int), 0, len(imu_motion.time_s) - 2)
    is_used = (
        (fractional_grid_index >= 0)
        & (fractional_grid_index < len(imu_motion.time_s) - 1)
        & imu_motion.is_valid[grid_index]
    )
    independent_residual_count = (
        np.count_nonzero(is_used) * row_interval_s / SECOND_DIFFERENCE_WINDOW_S
    )
    if independent_residual_count * SECOND_DIFFERENCE_WINDOW_S < MIN_OVERLAP_S:
        return None
    grid_index, time_s = grid_index[is_used], time_s[is_used]
    elapsed_s = time_s - time_s[0]
    grid_fraction = (fractional_grid_index[is_used] - grid_index)[:, None, None]
    interpolated_imu_table = (1.0 - grid_fraction) * imu_motion.table[
        grid_index
    ] + grid_fraction * imu_motion.table[grid_index + 1]
    # 2. Residuals: second differences of the source, converted to NED and metres, minus those of
    # the IMU
    unconverted_second_differences = source_motion.second_differences[rows[is_used]]
    axis_permutation = hypothesis.axis_permutation
    metres_per_unit = METRES_PER_UNIT[hypothesis.unit]
    complex_second_difference_m = (
        metres_per_unit
        * np.exp(1j * (rotation_rad + heading_drift_rad_s * elapsed_s))
        * axis_permutation.combine_horizontal_axes(unconverted_second_differences)
    )
    source_second_difference_m = np.column_stack(
        [
            complex_second_difference_m.real,
            complex_second_difference_m.imag,
            metres_per_unit
            * axis_permutation.vertical_sign
            * unconverted_second_differences[:, axis_permutation.vertical_axis],
        ]
    )
    imu_second_difference_m = (
        interpolated_imu_table[..., 0] - interpolated_imu_table[..., 1:] @ accelerometer_bias_m_s2
    )
    residual = source_second_difference_m - imu_second_difference_m
    # 3. Compute the log likelihoods of two models. In the first, the positions follow the motion
    # measured by the IMU (horizontal and vertical residuals). In the second, they are unrelated to
    # this motion: x, y and z of the source have their own distributions
    residual_squares = np.stack([np.sum(residual[:, :2] ** 2, axis=1), residual[:, 2] ** 2])
    log_likelihoods, variances = _fit_student_distributions(
        np.concatenate([residual_squares, unconverted_second_differences.T**2]),
        np.array([2, 1, 1, 1, 1]),
        np.array([MIN_HORIZONTAL_RESIDUAL_SIGMA_M, MIN_VERTICAL_RESIDUAL_SIGMA_M, 1e-6, 1e-6, 1e-6])
        ** 2,
    )
    # Log likelihood ratio of first model and null model. The density of the first model is per
    # metre: ln(metres per unit) per axis converts it to the unit of the source. Constant axes, such
    # as missing heights, are omitted
    is_axis_known = unconverted_second_differences.any(axis=0)
    log_likelihood_gain = (
        log_likelihoods[0]
        + log_likelihoods[1] * is_axis_known[axis_permutation.vertical_axis]
        + np.log(metres_per_unit) * np.count_nonzero(is_axis_known)
        - np.sum(log_likelihoods[2:], where=is_axis_known)
    )
    # 4. Weights of the residuals by their Student distribution, reduced because successive rows are
    # correlated
    weight = 1.0 / (variances[:2, None] + residual_squares / STUDENT_DEGREES_OF_FREEDOM)
    weight *= row_interval_s / SECOND_DIFFERENCE_WINDOW_S
    horizontal_m = np.stack([source_second_difference_m, imu_second_difference_m])[..., :2]
    (source_square_sum, source_imu_product_sum), (_, imu_square_sum) = np.einsum(
        "n,ink,jnk->ij", weight[0], horizontal_m, horizontal_m
    ).tolist()
    # Without motion, axes and unit cannot be determined
    if 0.0 in (source_square_sum, source_imu_product_sum, imu_square_sum):
        return None
    # 5. Gauss-Newton step from the derivatives of the residuals with respect to the parameters
    jacobian = np.zeros((len(grid_index), 3, len(PARAMETER_PRIOR_PRECISION)))
    jacobian[..., DELAY] = imu_motion.second_difference_derivative_m_s[grid_index]
    jacobian[:, 0, HEADING] = -complex_second_difference_m.imag
    jacobian[:, 1, HEADING] = complex_second_difference_m.real
    jacobian[..., HEADING_DRIFT] = jacobian[..., HEADING] * elapsed_s[:, None]
    jacobian[..., CLOCK_DRIFT] = jacobian[..., DELAY] * (time_s - mean_time_s)[:, None]
    jacobian[..., 4:] = interpolated_imu_table[..., 1:]
    is_parameter_estimated = np.ones(len(PARAMETER_PRIOR_PRECISION), dtype=bool)
    is_parameter_estimated[HEADING] = hypothesis.has_rotation
    # Only the heading of the gyroscopes drifts
    is_parameter_estimated[HEADING_DRIFT] = hypothesis.heading_from != "EKF2"
    is_parameter_estimated[CLOCK_DRIFT] = hypothesis.has_clock_drift
    columns = jacobian[..., is_parameter_estimated].reshape(-1, is_parameter_estimated.sum())
    weighted_design_columns = columns.T * weight[[0, 0, 1]].T.ravel()
    normal_matrix = weighted_design_columns @ columns + np.diag(
        PARAMETER_PRIOR_PRECISION[is_parameter_estimated] + 1e-9
    )
    gradient = (
        weighted_design_columns @ residual.ravel()
        + (PARAMETER_PRIOR_PRECISION * hypothesis.parameters)[is_parameter_estimated]
    )
    parameter_step = np.zeros_like(PARAMETER_PRIOR_PRECISION)
    parameter_step[is_parameter_estimated] = -np.linalg.solve(normal_matrix, gradient)
    parameter_step[DELAY] = np.clip(
        parameter_step[DELAY], -MAX_TIME_OFFSET_STEP_S, MAX_TIME_OFFSET_STEP_S
    )
    return replace(
        hypothesis,
        score=float(
            independent_residual_count * log_likelihood_gain
            - 0.5 * PARAMETER_PRIOR_PRECISION @ hypothesis.parameters**2
        ),
        min_source_to_imu_displacement_ratio=source_imu_product_sum / imu_square_sum,
        max_source_to_imu_displacement_ratio=source_square_sum / source_imu_product_sum,
        residual_sigma_m=np.sqrt(variances[0]),
        independent_residual_count=independent_residual_count,
    ), parameter_step


def _fit_student_distributions(
    squared_residuals: Array, dimensions: IntArray, min_variances: Array
) -> ArrayPair:
    """Fit Student's t distribution to each row; return mean log likelihoods and variances.

    The variances are fitted by expectation maximisation (Liu and Rubin 1995, ML estimation of the t
    distribution). The log likelihoods lack their constant terms.

    Parameters
    ----------
    squared_residuals : ndarray, shape (distributions, n)
        Squared lengths of the residual vectors.
    dimensions : ndarray, shape (distributions,)
        Dimensions (1 or 2) of the residual vectors.
    """
    medians = np.median(squared_residuals, axis=1)
    # Initial variances from the medians of χ² with one and with two degrees of freedom: 0.455 and
    # 1.386. Iteration: σ² = mean of weight · r² / d, with the weight (ν + d) / (ν + r² / σ²) of a
    # residual with length r, d dimensions, and ν degrees of freedom
    variances = np.maximum(medians / np.where(dimensions == 1, 0.455, 1.386), min_variances)
    degrees_of_freedom = STUDENT_DEGREES_OF_FREEDOM + dimensions
    for _ in range(5):  # the variances change little in later iterations
        denominators = STUDENT_DEGREES_OF_FREEDOM + squared_residuals / variances[:, None]
        weighted_means = np.mean(squared_residuals / denominators, axis=1)
        variances = np.maximum(degrees_of_freedom * weighted_means / dimensions, min_variances)
    # Mean log density of the Student t distribution of vectors with d dimensions and length r:
    # -½ (d ln σ² + (ν + d) ln(1 + r² / (ν σ²))). Its constant terms are omitted
    normalised_squares = squared_residuals / variances[:, None] / STUDENT_DEGREES_OF_FREEDOM
    mean_log1p_squares = np.mean(np.log1p(normalised_squares), axis=1)
    return (
        -0.5 * (dimensions * np.log(variances) + degrees_of_freedom * mean_log1p_squares),
        variances,
    )


def _compute_total_log_odds(hypothesis: Hypothesis, positions: SentPositions) -> float:
    """Return the log prior odds of a hypothesis, plus the evidence from heights.

    The evidence is the log likelihood ratio of the source's heights, compared with the barometer.
    """
    log_odds = hypothesis.axis_permutation.compute_log_prior_odds(hypothesis.quarter_turns)
    log_odds += UNIT_OTHER_THAN_METRES_LOG_PRIOR_ODDS * (hypothesis.unit != "m")
    log_odds += LARGE_TIME_OFFSET_LOG_PRIOR_ODDS * (abs(hypothesis.delay_s) > SMALL_TIME_OFFSET_S)
    if hypothesis.has_rotation:
        # Bayesian information criterion: one more estimated parameter costs ½ ln n
        log_odds -= 0.5 * float(np.log(max(hypothesis.independent_residual_count, 2.0)))
        is_large_rotation = abs(hypothesis.heading_minus_quarter_turns_rad) > SMALL_ROTATION_RAD
        log_odds += (
            LARGE_ROTATION_LOG_PRIOR_ODDS if is_large_rotation else SMALL_ROTATION_LOG_PRIOR_ODDS
        )
    if positions.barometer is not None:
        log_odds += _compute_height_log_likelihood_ratio(
            hypothesis, positions, positions.barometer["down_m"]
        )
    return log_odds


def _compute_height_log_likelihood_ratio(
    hypothesis: Hypothesis, positions: SentPositions, barometer_down_m: "pd.Series[float]"
) -> float:
    """Return the log likelihood ratio (nats) of two models of the barometer height.

    First model: the height according to the hypothesis. Second model: a constant height.
    """
    height_m = -np.interp(
        positions.time_s - hypothesis.delay_s, barometer_down_m.index, barometer_down_m
    )
    down_m = (
        METRES_PER_UNIT[hypothesis.unit]
        * hypothesis.axis_permutation.vertical_sign
        * positions.position_m[:, hypothesis.axis_permutation.vertical_axis]
    )
    # If the hypothesis on the vertical axis is correct, down position + barometer height is
    # constant. Medians remove the unknown origins
    error_m = down_m - np.median(down_m) + height_m - np.median(height_m)
    mean_square_error_m2 = np.mean(np.minimum(error_m**2, MAX_HEIGHT_ERROR_M**2))
    min_variance_m2 = BAROMETER_SIGMA_M**2
    variance_ratio = np.maximum(np.var(height_m), min_variance_m2) / np.maximum(
        mean_square_error_m2, min_variance_m2
    )
    return 0.5 * INDEPENDENT_HEIGHT_ERROR_COUNT * float(np.log(variance_ratio))
