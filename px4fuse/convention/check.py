"""Determination of the axes, unit, clock and orientation that a position source uses."""

import math
from dataclasses import replace

import numpy as np
import pandas as pd
from msgspec import structs

from px4fuse.flight.model import Columns, Ekf2, Flight, PositionTrack
from px4fuse.trajectory.association import choose_gap_limit_s, is_bracketed
from px4fuse.trajectory.rotation import heading

from .axes import (
    CLOCK_DRIFT,
    DELAY,
    HEADING,
    MAX_TIME_OFFSET_S,
    METRES_PER_UNIT,
    SMALL_ROTATION_RAD,
    Hypothesis,
    SentPositions,
    find_convention_candidates,
    refine_hypothesis,
    search_hypotheses,
)
from .model import (
    Convention,
    ConventionVerdict,
    HeadingSource,
    OrientationConvention,
)
from .motion import (
    MIN_POSITION_GAP_S,
    SECOND_DIFFERENCE_WINDOW_S,
    ImuSecondDifferences,
    InertialData,
    filter_imu_motion,
    integrate_imu_motion,
    integrate_inertial_data,
    replace_heading,
)
from .orientation import determine_orientation_convention
from .texts import format_axes, format_delay

# Convention of a position source: axes, unit and delay. For the verdict "determined", the
# log-likelihood (nats) of the best convention must exceed that of the second best by this value
MIN_CONVENTION_LOG_ODDS = 4.0
# Null model: the positions are unrelated to the motion measured by the IMU. A convention (axes,
# unit, delay) is not determinable if its log-likelihood gain (nats) over the null model is below
# this value
MIN_CONVENTION_LOG_LIKELIHOOD_GAIN = 8.0
# A convention (axes, unit, delay) is doubtful if its log-likelihood gain (nats per independent
# residual) over the null model (positions unrelated to the IMU motion) is below this value
MIN_LOG_LIKELIHOOD_GAIN_PER_SAMPLE = 0.15
# If other conventions (axes, unit, delay) fit nearly as well, the best one is doubtful if its
# log-likelihood gain (nats per independent residual) over the null model (positions unrelated to
# the IMU motion) is below this value
MIN_LOG_LIKELIHOOD_GAIN_PER_SAMPLE_IF_AMBIGUOUS = 0.4
# A convention (axes, unit, delay) is doubtful if the ratio of displacements in the positions to
# displacements integrated from the IMU is outside these limits
MIN_SOURCE_TO_IMU_DISPLACEMENT_RATIO, MAX_SOURCE_TO_IMU_DISPLACEMENT_RATIO = 0.88, 1.12
# A convention (axes, unit, delay) is doubtful if σ of its residuals (positions minus IMU motion) is
# above this multiple of σ of the expected noise
MAX_RESIDUAL_TO_NOISE_RATIO = 2.4
# σ (m) of the noise in second differences of the position integrated from the IMU
IMU_SECOND_DIFFERENCE_SIGMA_M = 0.05
# Up to this loss in log-likelihood (nats), EKF2's heading is preferred to the heading of the
# gyroscopes, because EKF2's heading refers to north
MAX_LOG_LIKELIHOOD_LOSS_WITH_EKF2_HEADING = 20.0
# Minimum number of GNSS positions for a fit of the heading of the source's frame
MIN_GNSS_POSITIONS = 30
# The heading fitted to GNSS positions is used if the residual is below this fraction of the extent
# of the GNSS positions (both RMS)
MAX_GNSS_RESIDUAL_RATIO = 0.1
# A clock drift is corrected only if the log-likelihood increases by more than this value (nats)
MIN_LIKELIHOOD_GAIN_FROM_CLOCK_DRIFT = 15.0
# Tested clock drifts (rate of the clock minus 1)
TESTED_CLOCK_DRIFTS = np.linspace(-0.05, 0.05, 21)
# A low-pass filter in the source is assumed instead of a delay, if it increases the log-likelihood
# by more than this value (nats). With simulated delays, the increase is below 3
MIN_LOG_LIKELIHOOD_GAIN_FROM_LOW_PASS = 8.0
# Limits (s) of delays that may be the effect of a low-pass filter
MIN_LOW_PASS_DELAY_S, MAX_LOW_PASS_DELAY_S = 0.2, 5.0
# Repeated positions are removed if they are less than this fraction of all positions
MAX_REPEATED_POSITION_FRACTION = 0.5
# Heights are used if at least this fraction of the positions has a height
MIN_FRACTION_OF_POSITIONS_WITH_HEIGHT = 0.5
# Variance of third differences of white noise with variance 1
THIRD_DIFFERENCE_VARIANCE = 20.0
# Variance of second differences of white noise with variance 1
SECOND_DIFFERENCE_VARIANCE = 6.0


def determine_source_convention(
    flight: Flight, track: PositionTrack, max_time_offset_s: float = MAX_TIME_OFFSET_S
) -> Convention | None:
    """Determine axes, unit, clock and orientation of a position source.

    Parameters
    ----------
    flight : Flight
    track : PositionTrack
        Positions as read from the log.
    max_time_offset_s : float
        Maximum tested time offset (s).

    Returns
    -------
    Convention, or None if IMU data, attitude or motion are missing.
    """
    inertial_data = integrate_inertial_data(flight)
    if inertial_data is None:
        return None
    positions = _read_positions(flight, track, max_time_offset_s)
    imu_motion_by_heading_source = {
        name: integrate_imu_motion(inertial_data, attitude)
        for name, attitude in inertial_data.compute_attitudes().items()
    }
    hypotheses = _rank_convention_hypotheses(positions, imu_motion_by_heading_source)
    if not hypotheses:
        return None
    best_hypothesis, *other_hypotheses = hypotheses
    if clock_drift := _estimate_clock_drift(
        positions, imu_motion_by_heading_source[best_hypothesis.heading_from], best_hypothesis
    ):
        positions_without_drift = positions.remove_clock_drift(clock_drift)
        hypotheses = _rank_convention_hypotheses(
            positions_without_drift, imu_motion_by_heading_source
        )
        min_score = best_hypothesis.score + MIN_LIKELIHOOD_GAIN_FROM_CLOCK_DRIFT
        if hypotheses and hypotheses[0].score > min_score:
            best_hypothesis, *other_hypotheses = hypotheses
            positions = positions_without_drift
        else:
            clock_drift = 0.0
    best_hypothesis = _replace_delay_by_low_pass_filter(
        best_hypothesis, positions, imu_motion_by_heading_source[best_hypothesis.heading_from]
    )
    if not is_source_fused(flight):
        best_hypothesis = _rotate_to_gnss(best_hypothesis, positions, flight, track)
    convention = _choose_convention(best_hypothesis, other_hypotheses, positions, clock_drift)
    if track.orientation is None:
        return convention
    orientation = _check_orientation(
        inertial_data, track.orientation, positions, best_hypothesis, convention.verdict
    )
    return structs.replace(convention, orientation=orientation)


def _read_positions(
    flight: Flight, track: PositionTrack, max_time_offset_s: float
) -> SentPositions:
    """Return the positions of a source without repeated samples."""
    samples = track.samples[Columns.POSITION]
    if samples["down_m"].notna().mean() < MIN_FRACTION_OF_POSITIONS_WITH_HEIGHT:
        samples = samples.assign(down_m=0.0)
    samples = samples.dropna()
    is_repeated = (samples.diff() == 0.0).all(axis=1)
    if is_repeated.mean() < MAX_REPEATED_POSITION_FRACTION:
        samples = samples[~is_repeated]
    return SentPositions(
        samples.index.to_numpy(), samples.to_numpy(), max_time_offset_s, flight.barometer
    )


def _rank_convention_hypotheses(
    positions: SentPositions,
    imu_motion_by_heading_source: dict[HeadingSource, ImuSecondDifferences],
) -> list[Hypothesis]:
    """Return the likely axes, units and delays of the positions, best first.

    EKF2's heading is preferred if it fits nearly as well as that of the gyroscopes.
    """
    hypotheses = search_hypotheses(positions, imu_motion_by_heading_source)
    for hypothesis in hypotheses:
        if (
            hypothesis.heading_from == "EKF2"
            and hypothesis.score > hypotheses[0].score - MAX_LOG_LIKELIHOOD_LOSS_WITH_EKF2_HEADING
            and hypothesis.is_similar_to(hypotheses[0], SMALL_ROTATION_RAD)
        ):
            other_hypotheses = [other for other in hypotheses if other is not hypothesis]
            return [replace(hypothesis, score=hypotheses[0].score), *other_hypotheses]
    return hypotheses


def _replace_delay_by_low_pass_filter(
    hypothesis: Hypothesis, positions: SentPositions, imu_motion: ImuSecondDifferences
) -> Hypothesis:
    """Replace the delay in a hypothesis by a low-pass filter of the source, if it fits better.

    Both hypotheses are compared by the likelihood of the positions, given the motion from the IMU.
    """
    if not MIN_LOW_PASS_DELAY_S < hypothesis.delay_s < MAX_LOW_PASS_DELAY_S:
        return hypothesis
    filtered_motion = filter_imu_motion(imu_motion, hypothesis.delay_s)
    parameters = hypothesis.parameters.copy()
    parameters[DELAY] = 0.0
    low_pass_hypothesis = refine_hypothesis(
        replace(hypothesis, parameters=parameters),
        positions,
        positions.compute_second_differences(filtered_motion),
        filtered_motion,
    )
    is_low_pass_better = (
        low_pass_hypothesis.score > hypothesis.score + MIN_LOG_LIKELIHOOD_GAIN_FROM_LOW_PASS
    )
    return low_pass_hypothesis if is_low_pass_better else hypothesis


def is_source_fused(flight: Flight) -> bool:
    """Return True if the log shows that EKF2 fused position, height or yaw of the source."""
    fusion_flags = flight.ekf2.fusion_flags if isinstance(flight.ekf2, Ekf2) else None
    return isinstance(fusion_flags, pd.DataFrame) and bool((fusion_flags > 0).any(axis=None))


def _rotate_to_gnss(
    hypothesis: Hypothesis, positions: SentPositions, flight: Flight, track: PositionTrack
) -> Hypothesis:
    """Fit the rotation of the frame to GNSS positions, because EKF2's heading may be wrong.

    The fit is GNSS position = c·(source position) + d·(source velocity) + constant, with complex
    numbers north + i·east. The phase of c is the rotation; d is a remaining delay.
    """
    gnss_tracks = [other for other in flight.positions if other.origin.is_gnss]
    if not gnss_tracks or track.origin.is_gnss or not hypothesis.has_rotation:
        return hypothesis
    gnss_positions = gnss_tracks[0].samples[Columns.POSITION[:2]].dropna()
    time_s = gnss_positions.index.to_numpy() + hypothesis.delay_s
    source_time_s = positions.time_s
    is_between_source_samples = is_bracketed(
        time_s, source_time_s, choose_gap_limit_s(source_time_s, MIN_POSITION_GAP_S)
    )
    if np.count_nonzero(is_between_source_samples) < MIN_GNSS_POSITIONS:
        return hypothesis
    sent_position_m = METRES_PER_UNIT[hypothesis.unit] * positions.position_m
    source_position_m = hypothesis.axis_permutation.combine_horizontal_axes(sent_position_m)
    velocity_m_s = np.interp(time_s, source_time_s, np.gradient(source_position_m, source_time_s))
    columns = np.column_stack([np.interp(time_s, source_time_s, source_position_m), velocity_m_s])[
        is_between_source_samples
    ]
    columns -= columns.mean(axis=0)
    north_east_m = (gnss_positions.to_numpy() @ [1.0, 1j])[is_between_source_samples]
    north_east_m -= north_east_m.mean()
    coefficients = np.linalg.lstsq(columns, north_east_m)[0]
    residual_m = north_east_m - columns @ coefficients
    if np.linalg.norm(residual_m) >= MAX_GNSS_RESIDUAL_RATIO * np.linalg.norm(north_east_m):
        return hypothesis
    parameters = hypothesis.parameters.copy()
    parameters[HEADING] = np.angle(coefficients[0])
    return replace(hypothesis, parameters=parameters, heading_from="GNSS")


def _choose_convention(
    best_hypothesis: Hypothesis,
    other_hypotheses: list[Hypothesis],
    positions: SentPositions,
    clock_drift: float,
) -> Convention:
    """Return the best hypothesis as convention of the source, with verdict and alternatives.

    The alternatives are the other hypotheses that are also likely.
    """
    # Without heights, z up and z down fit equally well
    has_heights = positions.position_m[:, 2].any()
    other_hypotheses = [
        hypothesis
        for hypothesis in other_hypotheses
        if not hypothesis.is_similar_to(best_hypothesis)
        and (has_heights or hypothesis.axes[:2] != best_hypothesis.axes[:2])
    ]
    # In a frame that is rotated clockwise, the positions appear rotated counterclockwise
    rotation_deg = 0.0
    if best_hypothesis.has_rotation:
        rotation_deg = -float(np.degrees(best_hypothesis.heading_minus_quarter_turns_rad))
    x, y, z = best_hypothesis.axes
    likely_conventions = [
        _describe_hypothesis(hypothesis)
        for hypothesis in other_hypotheses
        if hypothesis.score > best_hypothesis.score - MIN_CONVENTION_LOG_ODDS
    ]
    return Convention(
        verdict=_judge_hypothesis(best_hypothesis, positions, bool(likely_conventions)),
        x=x,
        y=y,
        z=z,
        unit=best_hypothesis.unit,
        heading_from=best_hypothesis.heading_from,
        is_mirrored=best_hypothesis.axis_permutation.is_mirrored,
        rotation_deg=rotation_deg,
        late_s=best_hypothesis.delay_s,
        clock_drift=clock_drift,
        # The scale factor is the lower bound of the displacement ratio, because noise of the source
        # affects only the upper bound
        scale=best_hypothesis.min_source_to_imu_displacement_ratio,
        log_odds=best_hypothesis.score - other_hypotheses[0].score if other_hypotheses else None,
        log_likelihood_gain=best_hypothesis.score,
        alternatives=tuple(dict.fromkeys(likely_conventions)),
    )


def _judge_hypothesis(
    hypothesis: Hypothesis, positions: SentPositions, is_ambiguous: bool
) -> ConventionVerdict:
    """Return the verdict on the best hypothesis on the axes, unit and delay of a source.

    The first of these verdicts that applies is returned: not determinable, doubtful, ambiguous,
    determined. ``is_ambiguous`` is True if other conventions fit nearly as well.
    """
    if hypothesis.score < MIN_CONVENTION_LOG_LIKELIHOOD_GAIN:
        return "not determinable"
    min_gain_per_sample = MIN_LOG_LIKELIHOOD_GAIN_PER_SAMPLE
    if is_ambiguous:
        min_gain_per_sample = MIN_LOG_LIKELIHOOD_GAIN_PER_SAMPLE_IF_AMBIGUOUS
    if (
        hypothesis.score < min_gain_per_sample * hypothesis.independent_residual_count
        or hypothesis.min_source_to_imu_displacement_ratio > MAX_SOURCE_TO_IMU_DISPLACEMENT_RATIO
        or hypothesis.max_source_to_imu_displacement_ratio < MIN_SOURCE_TO_IMU_DISPLACEMENT_RATIO
        or compute_residual_ratio(hypothesis, positions) > MAX_RESIDUAL_TO_NOISE_RATIO
    ):
        return "doubtful"
    return "ambiguous" if is_ambiguous else "determined"


def _describe_hypothesis(hypothesis: Hypothesis) -> str:
    """Describe axes, unit, rotation and delay of a hypothesis, for a list of alternatives."""
    properties = [format_axes(hypothesis.axes, hypothesis.unit)]
    if hypothesis.has_rotation:
        properties.append(
            f"axes rotated by {-np.degrees(hypothesis.heading_minus_quarter_turns_rad):+.0f}°"
        )
    if delay_text := format_delay(hypothesis.delay_s, 1):
        properties.append(f"timestamps {delay_text}")
    return ", ".join(properties)


def compute_residual_ratio(hypothesis: Hypothesis, positions: SentPositions) -> float:
    """Return σ of the residuals of a hypothesis divided by σ of the expected noise.

    Both are of horizontal second differences. The expected noise is that of source and IMU.
    """
    # Third differences of positions hardly contain motion: estimate the noise from third
    # differences, and convert its σ to second differences
    third_differences = np.diff(positions.position_m, 3, axis=0)
    third_difference_sigma = 1.4826 * np.median(
        np.abs(third_differences - np.median(third_differences, axis=0))
    )
    noise_m = (
        METRES_PER_UNIT[hypothesis.unit]
        * third_difference_sigma
        * np.sqrt(SECOND_DIFFERENCE_VARIANCE / THIRD_DIFFERENCE_VARIANCE)
    )
    return float(hypothesis.residual_sigma_m / np.hypot(noise_m, IMU_SECOND_DIFFERENCE_SIGMA_M))


def _estimate_clock_drift(
    positions: SentPositions, imu_motion: ImuSecondDifferences, best_hypothesis: Hypothesis
) -> float:
    """Return the rate error (s/s) of the source's clock, or 0 if it is not significant.

    With a large drift, no axes fit the motion. If the best axes fit badly, the search is therefore
    repeated with a grid of drifts.
    """
    # If no hypothesis fits, a large clock drift may hide the motion: search a grid of drifts. Only
    # compare the unrefined candidates of each drift, because refining them would take too long
    start_hypothesis, removed_drift = best_hypothesis, 0.0
    if (
        best_hypothesis.score < MIN_CONVENTION_LOG_LIKELIHOOD_GAIN
        or compute_residual_ratio(best_hypothesis, positions) > MAX_RESIDUAL_TO_NOISE_RATIO
    ):
        candidates_and_drifts = [
            (candidate, clock_drift)
            for clock_drift in TESTED_CLOCK_DRIFTS.tolist()
            for candidate in find_convention_candidates(
                positions.remove_clock_drift(clock_drift).compute_second_differences(imu_motion),
                imu_motion,
            )
        ]
        best_candidate, removed_drift = max(candidates_and_drifts, key=lambda pair: pair[0].score)
        start_hypothesis = replace(best_candidate, heading_from=best_hypothesis.heading_from)
        positions = positions.remove_clock_drift(removed_drift)
    # Estimate the remaining clock drift, together with the other parameters
    hypothesis = refine_hypothesis(
        replace(start_hypothesis, has_clock_drift=True),
        positions,
        positions.compute_second_differences(imu_motion),
        imu_motion,
    )
    # A drift must increase the score significantly. This test is not possible if a drift of the
    # grid was removed, because start_hypothesis is then not refined. The caller tests such a drift
    if (
        not removed_drift
        and hypothesis.score <= start_hypothesis.score + MIN_LIKELIHOOD_GAIN_FROM_CLOCK_DRIFT
    ):
        return 0.0
    # Clock rates are multiplied: 1 + removed drift, and 1 / (1 - drift that is left), because
    # _evaluate_hypothesis multiplies times of the source by 1 - drift
    return (1.0 + removed_drift) / (1.0 - float(hypothesis.parameters[CLOCK_DRIFT])) - 1.0


def _check_orientation(
    inertial_data: InertialData,
    sent_orientation: pd.DataFrame,
    positions: SentPositions,
    best_hypothesis: Hypothesis,
    verdict: ConventionVerdict,
) -> OrientationConvention | None:
    """Return the convention of the source's orientation, and the heading error if determinable."""
    orientation_check_result = determine_orientation_convention(
        inertial_data,
        sent_orientation.index.to_numpy(),
        sent_orientation[Columns.QUATERNION].to_numpy(),
    )
    if orientation_check_result is None:
        return None
    convention, time_s, attitude = orientation_check_result
    axis_permutation = best_hypothesis.axis_permutation
    if (
        verdict != "determined"
        or convention.verdict not in ("determined", "ambiguous")
        or axis_permutation.vertical_axis != 2
        or axis_permutation.is_mirrored
    ):
        return convention
    # Heading error: integrate the IMU with the heading of the source's orientation. If the
    # orientation is correct, the positions are not rotated relative to this motion
    source_heading_rad = np.interp(inertial_data.time_s, time_s, heading(attitude))
    imu_motion = integrate_imu_motion(
        inertial_data, replace_heading(inertial_data.gyro_attitude, source_heading_rad)
    )
    is_covered = (imu_motion.time_s > time_s[0] + SECOND_DIFFERENCE_WINDOW_S) & (
        imu_motion.time_s < time_s[-1] - SECOND_DIFFERENCE_WINDOW_S
    )
    imu_motion = replace(imu_motion, is_valid=imu_motion.is_valid & is_covered)
    # These headings (°) of the positions' x axis are expected without a heading error. With z down,
    # x points north. With z up, x points north (NWU) or east (ENU). Both are possible if the frames
    # of the orientation are unknown
    if axis_permutation.vertical_sign > 0 or convention.frames == "FLU to NWU":
        expected_x_axis_headings_deg = [0.0]
    elif convention.frames == "FLU to ENU":
        expected_x_axis_headings_deg = [90.0]
    else:
        expected_x_axis_headings_deg = [0.0, 90.0]
    # The first hypothesis with the known axes and unit is the most likely one. With the key "EKF2",
    # no heading drift is fitted
    for hypothesis in search_hypotheses(positions, {"EKF2": imu_motion}):
        if (
            hypothesis.has_rotation
            and hypothesis.axis_permutation == axis_permutation
            and hypothesis.unit == best_hypothesis.unit
        ):
            heading_errors_deg = (
                math.remainder(np.degrees(hypothesis.parameters[HEADING]) - expected_deg, 360.0)
                for expected_deg in expected_x_axis_headings_deg
            )
            return structs.replace(convention, heading_error_deg=min(heading_errors_deg, key=abs))
    return convention
