"""Search for the axes, unit, rotation and delay of positions that agree with the IMU.

1. Grid search: compare each combination of axes (also left-handed ones), unit and time offset with
   the motion from the IMU. The best rotation about the vertical has a closed form.
2. Least squares: refine the best hypotheses, together with an accelerometer bias and, if the
   heading is integrated from the gyroscopes, its drift.

Residuals (m) have a Student distribution. The log likelihood is relative to positions that are
unrelated to the motion.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import product
from typing import Final, NamedTuple

import numpy as np

from px4fuse.convention.model import Axes, Direction, HeadingSource, Unit
from px4fuse.convention.motion import DIFFERENCE_WINDOW_S, GRID_INTERVAL_S, ImuMotion, SourceMotion
from px4fuse.core.arrays import Array, IntArray

# Maximum tested time offset (s) of the positions
MAX_OFFSET_S = 10.0
# Minimum time (s) with positions and IMU data for the score of a hypothesis
MIN_OVERLAP_S = 10.0
# Minimum σ (m) of the horizontal residuals: IMU noise, tilt errors and interpolation
MIN_SIGMA_M = 0.05
# Minimum σ (m) of the vertical residuals: IMU noise, tilt errors and interpolation
MIN_SIGMA_DOWN_M = 0.08
# Degrees of freedom of the Student distribution of the residuals
DEGREES_OF_FREEDOM = 4.0
# Size of each length unit in metres
UNIT_SIZES_M: Final[dict[Unit, float]] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "feet": 0.3048}
# Maximum rotation (rad) of the frame about the vertical that is a misalignment
SMALL_ROTATION_RAD = np.radians(8.0)
# Maximum time offset (s) that does not lower the prior odds of a hypothesis
SMALL_OFFSET_S = 0.3
# Log prior odds of a frame that is rotated by more than SMALL_ROTATION_RAD
ROTATION_LOG_ODDS = -1.0
# Log prior odds of a frame that is rotated by less than SMALL_ROTATION_RAD, but not by zero
SMALL_ROTATION_LOG_ODDS = -0.5
# Log prior odds of a time offset above SMALL_OFFSET_S
OFFSET_LOG_ODDS = -2.0
# Log prior odds of a unit other than metres
UNIT_LOG_ODDS = -2.0
# Standard deviation (m) of barometer heights in the likelihood
BAROMETER_SIGMA_M = 0.5
# Assumed number of independent barometer heights
INDEPENDENT_BAROMETER_COUNT = 6.0
# Limit (m) of height errors in the likelihood, which limits the effect of outliers
MAX_HEIGHT_ERROR_M = 20.0 * BAROMETER_SIGMA_M
# Maximum number of hypotheses of the grid search that are refined
MAX_REFINED_HYPOTHESES = 8
# Maximum log-likelihood difference from the best hypothesis for a refinement
MAX_SCORE_DEFICIT = 60.0
# Maximum number of second differences in the refinement of a hypothesis
MAX_REFINEMENT_ROWS = 1200
# Number of Gauss-Newton iterations in the refinement of a hypothesis
REFINEMENT_ITERATIONS = 7
# Maximum change (s) of the time offset in one Gauss-Newton iteration
MAX_OFFSET_STEP_S = 0.15
# Prior precision (σ⁻²) of the seven Hypothesis.parameters: heading drift of the gyroscopes (σ
# 0.05 °/s), accelerometer bias (σ 0.3 m/s², 3 axes), no prior (0) for the others
PARAMETER_PRECISION = np.array([0.0, 0.0, np.radians(0.05) ** -2, 0.0, *[0.3**-2] * 3])
# Horizontal directions, clockwise from above
CLOCKWISE_DIRECTIONS: tuple[Direction, ...] = ("north", "east", "south", "west")
# Log prior odds of common directions of x, y, z
AXES_LOG_ODDS: Final[dict[Axes, float]] = {
    ("north", "east", "down"): 1.0,  # convention of PX4
    ("east", "north", "up"): -0.5,
    ("north", "west", "up"): -1.0,
    ("north", "east", "up"): -2.5,  # north, east, down with wrong sign of z
    ("east", "north", "down"): -2.5,  # x and y exchanged
    ("north", "west", "down"): -2.5,  # wrong sign of y
}


class AxisAssignment(NamedTuple):
    """Vertical axis and pair of horizontal axes among x, y, z, without the rotation of the pair.

    Attributes
    ----------
    vertical_axis, axis_a, axis_b : int
        Indices (0: x, 1: y, 2: z) of the vertical axis and of the horizontal axes.
    vertical_sign : {1, -1}
        1 if the vertical axis points down.
    handedness : {1, -1}
        1 if ``axis_b`` is 90° clockwise from ``axis_a``.
    """

    vertical_axis: int
    vertical_sign: int
    axis_a: int
    axis_b: int
    handedness: int

    @property
    def is_mirrored(self) -> bool:
        return (self.vertical_sign * self.handedness < 0) != (self.vertical_axis == 1)

    def axes(self, quarter_turns: int) -> Axes:
        """Return the directions of x, y, z if the heading of ``axis_a`` is 90° · quarter_turns."""
        directions: list[Direction] = ["down" if self.vertical_sign > 0 else "up"] * 3
        directions[self.axis_a] = CLOCKWISE_DIRECTIONS[quarter_turns % 4]
        directions[self.axis_b] = CLOCKWISE_DIRECTIONS[(quarter_turns + self.handedness) % 4]
        return directions[0], directions[1], directions[2]

    def log_odds(self, quarter_turns: int) -> float:
        axes = self.axes(quarter_turns)
        other_axes_log_odds = -2.0 if self.vertical_axis == 2 or axes[1] == "up" else -4.0
        return AXES_LOG_ODDS.get(axes, -5.0 if self.is_mirrored else other_axes_log_odds)


AXIS_ASSIGNMENTS = tuple(
    AxisAssignment(vertical, sign, 0 if vertical else 1, 1 if vertical == 2 else 2, hand)
    for vertical, sign, hand in product(range(3), (1, -1), (1, -1))
)


@dataclass(frozen=True)
class SentPositions:
    """Positions of a source as sent, unconverted, and barometer times (s) and heights (m)."""

    time_s: Array
    position_m: Array
    max_offset_s: float
    barometer: tuple[Array, Array] | None = None

    def remove_clock_drift(self, clock_drift: float) -> "SentPositions":
        return replace(self, time_s=without_clock_drift(self.time_s, clock_drift))

    def motion(self, imu: ImuMotion) -> SourceMotion:
        """Return the second differences of the positions at a constant interval."""
        margin_steps = round(self.max_offset_s / GRID_INTERVAL_S)
        grid_s = imu.time_s[0] + GRID_INTERVAL_S * np.arange(
            -margin_steps, len(imu.time_s) + margin_steps
        )
        return SourceMotion.of(self.time_s, self.position_m, grid_s)


@dataclass(frozen=True)
class Hypothesis:
    """Hypothesis on the axes, unit, rotation and delay of a source's positions.

    Attributes
    ----------
    parameters : ndarray, shape (7,)
        Delay of the timestamps (s), rotation of ``axis_a`` clockwise from north (rad), heading
        drift of the gyroscopes (rad/s), clock drift, accelerometer bias in FRD (m/s²).
    score : float
        Log likelihood plus log prior odds.
    has_rotation : bool
        False if the rotation is fixed to a multiple of 90°.
    min_scale, max_scale : float
        Bounds of the scale factor of the positions, relative to the displacement from the IMU.
    residual_sigma_m : float
        Scale (m) of the Student distribution of the horizontal residuals.
    independent_count : float
        Number of independent residuals.
    """

    assignment: AxisAssignment
    unit: Unit
    parameters: Array
    score: float
    has_rotation: bool = True
    has_clock_drift: bool = False
    min_scale: float = 1.0
    max_scale: float = 1.0
    residual_sigma_m: float = 0.0
    independent_count: float = 0.0
    heading_from: HeadingSource = "EKF2"

    @property
    def offset_s(self) -> float:
        """Delay (s) of the timestamps."""
        return float(self.parameters[0])

    @property
    def quarter_turns(self) -> int:
        """Heading of ``axis_a``, rounded to multiples of 90° (1: east)."""
        return round(float(self.parameters[1]) / (np.pi / 2.0))

    @property
    def axes(self) -> Axes:
        """Directions of x, y, z of the positions, rounded to multiples of 90°."""
        return self.assignment.axes(self.quarter_turns)

    @property
    def remainder_rad(self) -> float:
        """Heading (rad) of ``axis_a`` minus the nearest multiple of 90°."""
        return float(self.parameters[1] - self.quarter_turns * np.pi / 2.0)

    def is_similar_to(self, other: "Hypothesis", max_turn_rad: float = np.pi / 4.0) -> bool:
        turn_rad = np.angle(np.exp(1j * (self.parameters[1] - other.parameters[1])))
        is_similar = abs(self.offset_s - other.offset_s) < 0.5 and abs(turn_rad) < max_turn_rad
        return bool(is_similar and (self.assignment, self.unit) == (other.assignment, other.unit))


def without_clock_drift(time_s: Array, clock_drift: float) -> Array:
    """Remove the drift of a clock (rate minus 1) from timestamps; their mean does not change."""
    mean_time_s = float(np.mean(time_s))
    return mean_time_s + (time_s - mean_time_s) / (1.0 + clock_drift)


def search_hypotheses(
    positions: SentPositions, motions: Mapping[HeadingSource, ImuMotion]
) -> list[Hypothesis]:
    """Return the likely hypotheses on axes, unit and delay of the positions, best first.

    The list is empty without motion, or with an overlap of less than ``MIN_OVERLAP_S``.
    """
    hypotheses = []
    for heading_from, imu_motion in motions.items():
        source_motion = positions.motion(imu_motion)
        for candidate in find_candidates(source_motion, imu_motion):
            start_hypotheses = [replace(candidate, heading_from=heading_from)]
            if abs(candidate.remainder_rad) < 3.0 * SMALL_ROTATION_RAD:
                parameters = candidate.parameters.copy()
                parameters[1] -= candidate.remainder_rad
                start_hypotheses.append(
                    replace(start_hypotheses[0], parameters=parameters, has_rotation=False)
                )
            hypotheses += [
                refine_hypothesis(start_hypothesis, positions, source_motion, imu_motion)
                for start_hypothesis in start_hypotheses
            ]
    return sorted(
        (hypothesis for hypothesis in hypotheses if hypothesis.score > -np.inf),
        key=lambda hypothesis: -hypothesis.score,
    )


def find_candidates(source_motion: SourceMotion, imu_motion: ImuMotion) -> list[Hypothesis]:
    """Return the most likely hypotheses of a search over axes, units and time offsets."""
    source_columns = np.column_stack(
        [
            source_motion.second_differences,
            source_motion.second_differences**2,
            source_motion.is_valid,
        ]
    )
    imu_columns = np.column_stack(
        [imu_motion.table[..., 0], imu_motion.table[..., 0] ** 2, imu_motion.is_valid]
    )
    offset_steps = np.arange(len(source_columns) - len(imu_columns) + 1)
    moments = np.stack(
        [source_columns[step : step + len(imu_columns)].T @ imu_columns for step in offset_steps]
    )
    # each moment is a sum of products of a source column and an IMU column. Column 6 is 1 for a
    # valid sample, so the moment [6, 6] is the number of samples
    has_overlap = moments[:, 6, 6] * GRID_INTERVAL_S >= MIN_OVERLAP_S
    if not has_overlap.any():
        return []
    offset_s = (offset_steps[has_overlap] - offset_steps[-1] / 2.0) * GRID_INTERVAL_S
    moments = moments[has_overlap]
    independent_count = moments[:, 6, 6, None, None] * (GRID_INTERVAL_S / DIFFERENCE_WINDOW_S)
    moments /= moments[:, 6:, 6:]
    vertical_axis, vertical_sign, axis_a, axis_b, handedness = np.array(AXIS_ASSIGNMENTS).T
    correlation = (
        moments[:, axis_a, 0] + handedness * moments[:, axis_b, 1] + 1j * moments[:, axis_a, 1]
    )
    correlation -= 1j * handedness * moments[:, axis_b, 0]
    source_mean_square = np.maximum(moments[:, 3:6, 6, None], 1e-12)
    unit_sizes_m = np.array([*UNIT_SIZES_M.values()])
    north_mean_square, east_mean_square, down_mean_square = np.moveaxis(
        moments[:, 6, 3:6, None, None], 1, 0
    )
    horizontal_residual_m2 = (
        unit_sizes_m**2 * (source_mean_square[:, axis_a] + source_mean_square[:, axis_b])
        + north_mean_square
        + east_mean_square
    )
    horizontal_residual_m2 = (
        horizontal_residual_m2 - 2.0 * unit_sizes_m * np.abs(correlation)[..., None]
    ) / 2.0
    down_residual_m2 = unit_sizes_m**2 * source_mean_square[:, vertical_axis] + down_mean_square
    down_residual_m2 -= (
        2.0 * unit_sizes_m * (vertical_sign * moments[:, vertical_axis, 2])[..., None]
    )
    score = np.sum(np.log(source_mean_square), axis=1)[:, None] + 6.0 * np.log(unit_sizes_m)
    score = score - 2.0 * np.log(np.maximum(horizontal_residual_m2, MIN_SIGMA_M**2))
    score = (
        0.5
        * independent_count
        * (score - np.log(np.maximum(down_residual_m2, MIN_SIGMA_DOWN_M**2)))
    )
    rotation_rad = np.angle(correlation)
    nearest_quarter_turns = np.round(rotation_rad / (np.pi / 2.0)).astype(int) % 4
    hypotheses = []
    for quarter_turns in range(4):
        scores_at_quarter = np.where(
            (nearest_quarter_turns == quarter_turns)[..., None], score, -np.inf
        )
        for (assignment_index, unit_index), offset_index in np.ndenumerate(
            np.argmax(scores_at_quarter, axis=0)
        ):
            unit_name, assignment = [*UNIT_SIZES_M][unit_index], AXIS_ASSIGNMENTS[assignment_index]
            # without heights, only the third axis can be vertical
            if assignment.vertical_axis != 2 and not source_motion.second_differences[:, 2].any():
                continue
            total_score = (
                scores_at_quarter[offset_index, assignment_index, unit_index]
                + assignment.log_odds(quarter_turns)
                + UNIT_LOG_ODDS * (unit_name != "m")
            )
            parameters = np.array(
                [offset_s[offset_index], rotation_rad[offset_index, assignment_index], *[0.0] * 5]
            )
            hypotheses.append(Hypothesis(assignment, unit_name, parameters, float(total_score)))
    hypotheses.sort(key=lambda hypothesis: -hypothesis.score)
    return [
        hypothesis
        for hypothesis in hypotheses[:MAX_REFINED_HYPOTHESES]
        if hypothesis.score > hypotheses[0].score - MAX_SCORE_DEFICIT
    ]


def refine_hypothesis(
    initial_hypothesis: Hypothesis,
    positions: SentPositions,
    source_motion: SourceMotion,
    imu_motion: ImuMotion,
) -> Hypothesis:
    """Refine the parameters of a hypothesis by robust least squares (Gauss-Newton)."""
    rows = np.flatnonzero(source_motion.is_valid)
    rows = rows[:: max(1, len(rows) // MAX_REFINEMENT_ROWS)]
    best, parameters = replace(initial_hypothesis, score=-np.inf), initial_hypothesis.parameters
    for _ in range(REFINEMENT_ITERATIONS):
        hypothesis, step = _evaluate_hypothesis(
            replace(initial_hypothesis, parameters=parameters), rows, source_motion, imu_motion
        )
        if hypothesis.score > best.score:
            best = hypothesis
        parameters = parameters + step
    return replace(best, score=best.score + _log_odds(best, positions))


def _evaluate_hypothesis(
    hypothesis: Hypothesis, rows: IntArray, source_motion: SourceMotion, imu_motion: ImuMotion
) -> tuple[Hypothesis, Array]:
    """Return the hypothesis with its log likelihood, and the Gauss-Newton step."""
    offset_s, rotation_rad, heading_drift_rad_s, clock_drift, *_ = hypothesis.parameters
    time_s = source_motion.time_s[rows]
    row_interval_s = GRID_INTERVAL_S * float(np.median(np.diff(rows)))
    mean_time_s = float(np.mean(time_s))
    grid_position = time_s - offset_s - clock_drift * (time_s - mean_time_s)
    grid_position = (grid_position - imu_motion.time_s[0]) / GRID_INTERVAL_S
    grid_index = np.clip(np.floor(grid_position).astype(int), 0, len(imu_motion.time_s) - 2)
    is_used = (
        (grid_position >= 0)
        & (grid_position < len(imu_motion.time_s) - 1)
        & imu_motion.is_valid[grid_index]
    )
    independent_count = float(np.count_nonzero(is_used)) * row_interval_s / DIFFERENCE_WINDOW_S
    rejected_hypothesis = replace(hypothesis, score=-np.inf), np.zeros(len(PARAMETER_PRECISION))
    if independent_count * DIFFERENCE_WINDOW_S < MIN_OVERLAP_S:
        return rejected_hypothesis
    grid_index, time_s = grid_index[is_used], time_s[is_used]
    elapsed_s = time_s - time_s[0]
    grid_fraction = (grid_position[is_used] - grid_index)[:, None, None]
    imu_differences = (1.0 - grid_fraction) * imu_motion.table[
        grid_index
    ] + grid_fraction * imu_motion.table[grid_index + 1]
    sent_differences = source_motion.second_differences[rows[is_used]]
    vertical_axis, vertical_sign, axis_a, axis_b, handedness = hypothesis.assignment
    unit_size_m = UNIT_SIZES_M[hypothesis.unit]
    complex_rotation = unit_size_m * np.exp(1j * (rotation_rad + heading_drift_rad_s * elapsed_s))
    horizontal_m = complex_rotation * (
        sent_differences[:, axis_a] + 1j * handedness * sent_differences[:, axis_b]
    )
    source_ned_m = np.column_stack(
        [
            horizontal_m.real,
            horizontal_m.imag,
            unit_size_m * vertical_sign * sent_differences[:, vertical_axis],
        ]
    )
    imu_ned_m = imu_differences[..., 0] - imu_differences[..., 1:] @ hypothesis.parameters[4:]
    residual = source_ned_m - imu_ned_m
    residual_squares = np.stack([np.sum(residual[:, :2] ** 2, axis=1), residual[:, 2] ** 2])
    log_likelihood_gain, sigma_m = student_score(residual_squares[0], 2, MIN_SIGMA_M)
    vertical_log_likelihood, sigma_down_m = student_score(residual_squares[1], 1, MIN_SIGMA_DOWN_M)
    is_axis_known = sent_differences.any(axis=0)  # False for the height if the source has none
    log_likelihood_gain += vertical_log_likelihood * is_axis_known[vertical_axis] + np.log(
        unit_size_m
    ) * np.count_nonzero(is_axis_known)
    log_likelihood_gain -= sum(
        student_score(column**2, 1, 1e-6)[0] for column in sent_differences.T[is_axis_known]
    )
    weight = 1.0 / (
        np.array([[sigma_m**2], [sigma_down_m**2]]) + residual_squares / DEGREES_OF_FREEDOM
    )
    weight *= row_interval_s / DIFFERENCE_WINDOW_S
    ned_square, source_imu_product, imu_square = (
        float(np.sum(weight[0] @ (first * second)[:, :2]))
        for first, second in (
            (source_ned_m, source_ned_m),
            (source_ned_m, imu_ned_m),
            (imu_ned_m, imu_ned_m),
        )
    )
    # without motion the convention is unknown
    if 0.0 in (ned_square, source_imu_product, imu_square):
        return rejected_hypothesis
    jacobian = np.zeros((len(grid_index), 3, len(PARAMETER_PRECISION)))
    jacobian[..., 0] = imu_motion.rate_m_s[grid_index]
    jacobian[:, 0, 1], jacobian[:, 1, 1] = -horizontal_m.imag, horizontal_m.real
    jacobian[..., 2] = jacobian[..., 1] * elapsed_s[:, None]
    jacobian[..., 3] = jacobian[..., 0] * (time_s - mean_time_s)[:, None]
    jacobian[..., 4:] = imu_differences[..., 1:]
    uses_gyro_heading = hypothesis.heading_from != "EKF2"
    is_free = np.array(
        [True, hypothesis.has_rotation, uses_gyro_heading, hypothesis.has_clock_drift, *[True] * 3]
    )
    columns = jacobian[..., is_free].reshape(-1, is_free.sum())
    weighted_columns = columns.T * weight[[0, 0, 1]].T.ravel()
    normal_matrix = weighted_columns @ columns + np.diag(PARAMETER_PRECISION[is_free] + 1e-9)
    gradient = (
        weighted_columns @ residual.ravel() + (PARAMETER_PRECISION * hypothesis.parameters)[is_free]
    )
    parameter_step = np.zeros(len(PARAMETER_PRECISION))
    parameter_step[is_free] = -np.linalg.solve(normal_matrix, gradient)
    parameter_step[0] = np.clip(parameter_step[0], -MAX_OFFSET_STEP_S, MAX_OFFSET_STEP_S)
    scored_hypothesis = replace(
        hypothesis,
        score=float(
            independent_count * log_likelihood_gain
            - 0.5 * PARAMETER_PRECISION @ hypothesis.parameters**2
        ),
        min_scale=source_imu_product / imu_square,
        max_scale=ned_square / source_imu_product,
        residual_sigma_m=sigma_m,
        independent_count=independent_count,
    )
    return scored_hypothesis, parameter_step


def student_score(squares: Array, dimensions: int, min_sigma: float) -> tuple[float, float]:
    """Fit a Student distribution to squared residuals; return mean log likelihood and scale."""
    variance = max(float(np.median(squares)) / (0.455, 1.386)[dimensions - 1], min_sigma**2)
    for _ in range(5):
        weight = (DEGREES_OF_FREEDOM + dimensions) / (DEGREES_OF_FREEDOM + squares / variance)
        variance = max(float(np.mean(weight * squares)) / dimensions, min_sigma**2)
    mean_log_tail = np.mean(np.log1p(squares / variance / DEGREES_OF_FREEDOM))
    score = -0.5 * (
        dimensions * np.log(variance) + (DEGREES_OF_FREEDOM + dimensions) * mean_log_tail
    )
    return float(score), float(np.sqrt(variance))


def _log_odds(hypothesis: Hypothesis, positions: SentPositions) -> float:
    """Return the log prior odds of a hypothesis, plus a log likelihood ratio from the barometer."""
    log_odds = hypothesis.assignment.log_odds(hypothesis.quarter_turns)
    log_odds += UNIT_LOG_ODDS * (hypothesis.unit != "m")
    log_odds += OFFSET_LOG_ODDS * (abs(hypothesis.offset_s) > SMALL_OFFSET_S)
    if hypothesis.has_rotation:
        # Bayesian information criterion: one more estimated parameter costs ½ ln n
        log_odds -= 0.5 * float(np.log(max(hypothesis.independent_count, 2.0)))
        is_large_rotation = abs(hypothesis.remainder_rad) > SMALL_ROTATION_RAD
        log_odds += ROTATION_LOG_ODDS if is_large_rotation else SMALL_ROTATION_LOG_ODDS
    if positions.barometer is not None:
        log_odds += _height_log_likelihood(hypothesis, positions, *positions.barometer)
    return log_odds


def _height_log_likelihood(
    hypothesis: Hypothesis, positions: SentPositions, time_s: Array, barometer_m: Array
) -> float:
    """Return the log likelihood ratio of a source's heights: barometer against constant height."""
    height_m = np.interp(positions.time_s - hypothesis.offset_s, time_s, barometer_m)
    down_m = (
        UNIT_SIZES_M[hypothesis.unit]
        * hypothesis.assignment.vertical_sign
        * positions.position_m[:, hypothesis.assignment.vertical_axis]
    )
    # height is positive upwards, so down + height is constant for a correct hypothesis
    error_m = down_m - np.median(down_m) + height_m - np.median(height_m)
    error_m2 = float(np.mean(np.minimum(error_m**2, MAX_HEIGHT_ERROR_M**2)))
    min_m2 = BAROMETER_SIGMA_M**2
    variance_ratio = max(float(np.var(height_m)), min_m2) / max(error_m2, min_m2)
    return 0.5 * INDEPENDENT_BAROMETER_COUNT * float(np.log(variance_ratio))
