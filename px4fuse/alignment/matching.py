"""Search for frame, yaw and time offset at which a position file matches EKF2 or the IMU."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pandas as pd

from px4fuse.flight.model import Flight, Unavailable
from px4fuse.trajectory.time_offset import GRID_STEP_S, MIN_SECOND_BEST_RESIDUAL_RATIO

from .time_and_pose_fit import (
    INTERPOLATION_ERROR_M,
    MIN_CONCORDANCE_CORRELATION_TO_ACCEPT_MATCH,
    CorrelationPeak,
    TrackFit,
    find_correlation_peak,
    fit_by_least_squares,
)
from .tracks import (
    EKF2_REFERENCE,
    IMU_REFERENCE,
    MIN_MOTION_M,
    MIN_OVERLAP_S,
    AmbiguousMatchError,
    NoMatchError,
    SampledTrack,
    align_samples,
    apply_band_pass,
    compute_horizontal_range_m,
    convert_to_ned,
    make_continuous_ekf2_track,
    make_ekf2_references,
    make_imu_references,
    mark_transients,
    remove_spikes,
    resample_to_grid,
)

# Frames to try if the yaw is estimated, without nwu: it is the same as enu with another yaw
FRAMES_FOR_ESTIMATED_YAW = ("ned", "enu")
# Frames to try if the user gives the yaw, without frames whose y axis is vertical: the result can
# be ambiguous
FRAMES_FOR_GIVEN_YAW = ("ned", "enu", "nwu")
# Maximum duration (s) of a position file, to limit the computing time
MAX_FILE_DURATION_S = 86400.0
# Minimum concordance correlation coefficient (Lin 1989) of position file and reference track;
# below it, px4fuse prints a warning
MIN_CONCORDANCE_CORRELATION_WITHOUT_WARNING = {EKF2_REFERENCE: 0.9, IMU_REFERENCE: 0.7}
# Maximum standard deviation (s) of an accepted time offset
MAX_TIME_OFFSET_SIGMA_S = 0.5
# The best frame is unambiguous if the residual in the second best frame is larger by this factor
MIN_SECOND_TO_BEST_FRAME_RESIDUAL_RATIO = 1.3
# A yaw from the user is reported as wrong only if the horizontal RMS residual (file minus reference
# track) with this yaw exceeds this multiple of the residual with the estimated yaw
MIN_RESIDUAL_RATIO_OF_GIVEN_TO_ESTIMATED_YAW = 2.0
# A yaw from the user is reported as wrong only if the horizontal RMS residual (file minus EKF2's
# position) with this yaw exceeds this value (m)
MIN_RESIDUAL_OF_MISALIGNED_FRAME_M = 0.3


@dataclass(frozen=True)
class AlignmentProblem:
    """Positions of a file, and alignment parameters from the user.

    A parameter that is None is estimated.

    Attributes
    ----------
    samples : DataFrame
        Positions by time (s) of the file's clock.
    frames : tuple of str
        Possible frames of the file, such as ("enu",).
    yaw_rad : float or None
        Yaw of the file's frame relative to EKF2's frame.
    lag_s : float or None
        Time (s) of the first position after the first sample of the log.
    """

    samples: pd.DataFrame
    frames: tuple[str, ...]
    yaw_rad: float | None
    lag_s: float | None


@dataclass(frozen=True)
class TrackMatch:
    """Best fit of a position file to a reference track.

    Attributes
    ----------
    reference : SampledTrack
        EKF2's position, or integrated acceleration.
    frame : str
        Directions of x, y and z in the file, such as "enu".
    rms_m_by_frame : dict from frame to float
        RMS position residual (m) in each tried frame, best first.
    fit : TrackFit
        Fit with the yaw from the user.
    fit_with_estimated_yaw : TrackFit
        Fit with estimated yaw.
    is_given_yaw_wrong : bool
        True if the yaw from the user is wrong.
    """

    reference: SampledTrack
    frame: str
    rms_m_by_frame: dict[str, float]
    fit: TrackFit
    fit_with_estimated_yaw: TrackFit
    is_given_yaw_wrong: bool

    @property
    def time_offset_fit(self) -> TrackFit:
        """Fit that determines the time offset.

        A wrong yaw also makes the time offset wrong. If the yaw from the user is wrong, the time
        offset is therefore from the fit with the estimated yaw.
        """
        return self.fit_with_estimated_yaw if self.is_given_yaw_wrong else self.fit

    @property
    def residuals_text(self) -> str:
        """RMS residual of the file in each tested frame, such as "ned 0.12 m, enu 3.40 m"."""
        return ", ".join(
            f"{name} {residual_m:.2f} m" for name, residual_m in self.rms_m_by_frame.items()
        )


def find_match(flight: Flight, problem: AlignmentProblem) -> TrackMatch | None:
    """Match a position file with EKF2's position or, if this fails, with the IMU.

    If the user gave time offset, frame and yaw, the match only checks these parameters. Return None
    if this check fails.

    Raises
    ------
    NoMatchError
        The user did not give all parameters, and the missing ones cannot be estimated, because the
        file matches neither EKF2's position nor the IMU.
    """
    is_missing_by_option = {
        "`clock_offset_s`": problem.lag_s is None,
        "`frame`": len(problem.frames) != 1,
        "`yaw_deg`": problem.yaw_rad is None,
    }
    missing_options = [option for option, is_missing in is_missing_by_option.items() if is_missing]
    reasons = []
    for make_references in (make_ekf2_references, make_imu_references):
        try:
            match = _find_best_match(make_references(flight), problem)
            _require_unique_match(match)
            return _refit_without_origin_resets(flight, match, problem)
        except NoMatchError as error:
            # The user gave all alignment parameters, so the match only checks them. The IMU is not
            # accurate enough for such a check
            if not missing_options:
                return None
            # Several time offsets or frames fit equally well. From the IMU, time offset and frame
            # are less accurate than from EKF2's position, so the IMU cannot resolve an ambiguity
            if isinstance(error, AmbiguousMatchError):
                raise
            reasons.append(error.reason)
    raise NoMatchError("; ".join(dict.fromkeys(reasons)), f"Give {' and '.join(missing_options)}")


def _find_best_match(references: list[SampledTrack], problem: AlignmentProblem) -> TrackMatch:
    """Match the file with each reference; return the match with the smallest residual."""
    samples = problem.samples
    if samples.index[-1] - samples.index[0] > MAX_FILE_DURATION_S:
        raise NoMatchError(
            "the position file covers more than one day; shorten the file to the flight"
        )
    frames = problem.frames or (
        FRAMES_FOR_ESTIMATED_YAW if problem.yaw_rad is None else FRAMES_FOR_GIVEN_YAW
    )
    if compute_horizontal_range_m(convert_to_ned(samples, frames[0])) < MIN_MOTION_M:
        raise NoMatchError(
            f"the positions in the file change by less than {MIN_MOTION_M:g} m, too little "
            "to match the log"
        )
    return min(
        (_match_with_reference(reference, frames, problem) for reference in references),
        key=lambda match: match.time_offset_fit.residual_rms_m,
    )


def _match_with_reference(
    reference: SampledTrack, frames: tuple[str, ...], problem: AlignmentProblem
) -> TrackMatch:
    """Fit the position file, in each possible frame, to a reference, and test the user's yaw.

    The user's yaw is wrong if only the fit with an estimated yaw is acceptable, or much better.
    """
    yaw_rad = problem.yaw_rad
    fits = sorted(
        ((_fit_file_in_frame(problem, reference, frame, yaw_rad), frame) for frame in frames),
        key=lambda fit_and_frame: fit_and_frame[0].residual_rms_m,
    )
    fit, best_frame = fits[0]
    fit_with_estimated_yaw, is_given_yaw_wrong = fit, False
    if yaw_rad is not None:
        fit_with_estimated_yaw = _fit_file_in_frame(problem, reference, best_frame, None)
        is_given_yaw_wrong = is_reliable_fit(fit_with_estimated_yaw, reference.name) and (
            fit.concordance_correlation
            < MIN_CONCORDANCE_CORRELATION_TO_ACCEPT_MATCH[reference.name]
            or needs_rotation(fit.horizontal_residual_rms_m, fit_with_estimated_yaw, reference.name)
        )
    return TrackMatch(
        reference,
        best_frame,
        {frame: fit.residual_rms_m for fit, frame in fits},
        fit,
        fit_with_estimated_yaw,
        is_given_yaw_wrong,
    )


def needs_rotation(
    horizontal_residual_rms_m: float, fit_with_estimated_yaw: TrackFit, reference: str
) -> bool:
    """Return True if the fit with estimated yaw has a much smaller horizontal residual (m)."""
    return (
        horizontal_residual_rms_m
        > MIN_RESIDUAL_RATIO_OF_GIVEN_TO_ESTIMATED_YAW
        * fit_with_estimated_yaw.horizontal_residual_rms_m
        and (
            horizontal_residual_rms_m > MIN_RESIDUAL_OF_MISALIGNED_FRAME_M
            or reference == IMU_REFERENCE
        )
    )


def is_reliable_fit(fit: TrackFit, reference: str) -> bool:
    """Return True if the correlation is high and no second time offset fits equally well."""
    return (
        fit.concordance_correlation >= MIN_CONCORDANCE_CORRELATION_WITHOUT_WARNING[reference]
        and fit.second_to_best_residual_ratio >= MIN_SECOND_BEST_RESIDUAL_RATIO
    )


def _require_unique_match(match: TrackMatch) -> None:
    """Raise an error if a match is poor (NoMatchError) or ambiguous (AmbiguousMatchError)."""
    reference_name = match.reference.name
    fit = match.time_offset_fit
    min_correlation = MIN_CONCORDANCE_CORRELATION_TO_ACCEPT_MATCH[reference_name]
    if fit.concordance_correlation < min_correlation:
        raise NoMatchError(
            f"the position file does not match the {reference_name}: Lin's concordance correlation "
            f"coefficient is {fit.concordance_correlation:.2f} (minimum {min_correlation:g})"
        )
    ambiguity_text = ""
    if fit.second_to_best_residual_ratio < MIN_SECOND_BEST_RESIDUAL_RATIO:
        ambiguity_text = (
            f"two time offsets that differ by {abs(fit.second_peak_lag_difference_s):.1f} s fit "
            "equally well"
        )
    elif fit.lag_sigma_s is not None and fit.lag_sigma_s > MAX_TIME_OFFSET_SIGMA_S:
        ambiguity_text = (
            f"the standard deviation of the time offset exceeds {MAX_TIME_OFFSET_SIGMA_S:g} s"
        )
    if ambiguity_text:
        raise AmbiguousMatchError(
            f"the time offset between position file and {reference_name} cannot be estimated: "
            f"{ambiguity_text}",
            "Give `clock_offset_s`",
        )
    if len(match.rms_m_by_frame) > 1:
        best_residual_m, second_best_residual_m, *_ = np.hypot(
            [*match.rms_m_by_frame.values()], INTERPOLATION_ERROR_M
        )
        if second_best_residual_m < MIN_SECOND_TO_BEST_FRAME_RESIDUAL_RATIO * best_residual_m:
            raise AmbiguousMatchError(
                "the frame of the position file cannot be estimated: several frames have "
                f"similar residuals against the {reference_name} ({match.residuals_text})",
                f"Give `frame`{' or `yaw_deg` auto' if match.is_given_yaw_wrong else ''}",
            )


def _refit_without_origin_resets(
    flight: Flight, match: TrackMatch, problem: AlignmentProblem
) -> TrackMatch:
    """Repeat the fit to EKF2's position without resets that only moved its origin.

    The first fit aligns the position file with EKF2. The aligned positions then show at which
    resets only the origin of EKF2's frame moved. A match with the IMU, or a flight without resets,
    is returned unchanged.
    """
    ekf2, first_fit = flight.ekf2, match.time_offset_fit
    if match.reference.name == IMU_REFERENCE or isinstance(ekf2, Unavailable) or not ekf2.resets:
        return match
    aligned_samples = align_samples(
        problem.samples, match.frame, first_fit.yaw_rad, first_fit.origin_m, first_fit.lag_s
    )
    ekf2_track = make_continuous_ekf2_track(ekf2, aligned_samples)
    refit = partial(
        fit_by_least_squares,
        convert_to_ned(problem.samples, match.frame),
        ekf2_track,
        is_lag_estimated=problem.lag_s is None,
    )
    # Repeat the fit with estimated yaw and the fit with the user's yaw. Each starts at the lag that
    # it had before. If the user gave no yaw, both are the same fit
    fit_with_estimated_yaw = refit(match.fit_with_estimated_yaw, yaw_rad=None)
    fit = fit_with_estimated_yaw
    if problem.yaw_rad is not None:
        fit = refit(match.fit, yaw_rad=problem.yaw_rad)
    return replace(
        match, reference=ekf2_track, fit=fit, fit_with_estimated_yaw=fit_with_estimated_yaw
    )


def _fit_file_in_frame(
    problem: AlignmentProblem, reference: SampledTrack, frame: str, yaw_rad: float | None
) -> TrackFit:
    """Fit the position file, interpreted in the given frame, to a reference track.

    The lag is estimated if the user gave none.
    """
    file_track = convert_to_ned(problem.samples, frame)
    resampled_track = resample_to_grid(remove_spikes(file_track))
    if reference.name == IMU_REFERENCE:
        if len(resampled_track.time_s) * GRID_STEP_S < MIN_OVERLAP_S:
            raise NoMatchError(
                f"the position file is shorter than {MIN_OVERLAP_S:g} s, too short for a "
                "match with the IMU"
            )
        # make_imu_references applies the band-pass filter twice: to velocity and to position. Apply
        # it twice to the positions of the file, too
        position_m = apply_band_pass(apply_band_pass(resampled_track.position_m))
        file_track = resampled_track = mark_transients(
            replace(resampled_track, position_m=position_m)
        )
    if problem.lag_s is None:
        peak = find_correlation_peak(resampled_track, reference, yaw_rad)
    else:
        peak = CorrelationPeak(problem.lag_s)
    return fit_by_least_squares(
        file_track, reference, peak, yaw_rad, is_lag_estimated=problem.lag_s is None
    )
