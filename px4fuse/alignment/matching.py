"""Matching of a position file with EKF2 or the IMU: choice of frame, yaw and time offset."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pandas as pd

from px4fuse.alignment import time_and_pose_fit, tracks
from px4fuse.alignment.time_and_pose_fit import MIN_CONCORDANCE, RESIDUAL_FLOOR_M, Fit, Peak
from px4fuse.alignment.tracks import EKF2_POSITION, IMU, NoMatchError, SampledTrack
from px4fuse.flight import Flight, Unavailable
from px4fuse.trajectory.time_offset import MIN_SECOND_PEAK_RATIO, STEP_S

# frames to try if yaw is free; nwu is enu rotated by 90°
YAW_FREE_FRAMES = ("ned", "enu")
MAX_SPAN_S = 86400.0  # a day of positions takes five seconds
# concordance correlation below which a match gets a warning and does not overrule options
GOOD_CONCORDANCE = {EKF2_POSITION: 0.9, IMU: 0.7}
MAX_CLOCK_SIGMA_S = 0.5  # standard deviation of a time offset above which it is rejected
FRAME_RATIO = 1.3  # smallest ratio of the residuals in the second best and the best frame
# residual without and with free yaw and origin: above this ratio and size (m) the frame is
# misaligned
ROTATION_RATIO, ROTATION_RMS_M = 2.0, 0.3


@dataclass(frozen=True)
class AlignmentProblem:
    """Position file with the known alignment parameters; None is estimated.

    Attributes
    ----------
    samples : DataFrame
        Positions of the file, on its clock.
    frame : str or None
    yaw_rad : float or None
        Rotation of the frame of the file relative to EKF2's.
    lag_s : float or None
        Flight time of the first sample of the file.
    """

    samples: pd.DataFrame
    frame: str | None
    yaw_rad: float | None
    lag_s: float | None


@dataclass(frozen=True)
class Match:
    """Match of the file with one reference.

    Attributes
    ----------
    reference : SampledTrack
    frame : str
    misfits_m : dict from frame to float
        Residual in each frame that was tried, best first.
    fit : Fit
        Fit with the given yaw, or with free yaw if none was given.
    free_yaw_fit : Fit
        Fit with free yaw.
    is_rotated : bool
        True if the frame of the file is misaligned; the time offset is then that of
        ``free_yaw_fit``.
    better_frame : str
        Frame in which the file fits without rotation, if not the given one.
    """

    reference: SampledTrack
    frame: str
    misfits_m: dict[str, float]
    fit: Fit
    free_yaw_fit: Fit
    is_rotated: bool
    better_frame: str = ""

    @property
    def clock(self) -> Fit:
        """Fit that determines the time offset."""
        return self.free_yaw_fit if self.is_rotated else self.fit

    @property
    def misfits(self) -> str:
        """Residual in each frame, as text."""
        return ", ".join(f"{name} {misfit:.2f} m" for name, misfit in self.misfits_m.items())


def find_match(flight: Flight, problem: AlignmentProblem) -> Match | None:
    """Match with the first suitable reference; None if none is suitable and nothing is estimated.

    Raises
    ------
    NoMatchError
        With its remedy.
    """
    known = {"clock_offset_s": problem.lag_s, "frame": problem.frame, "yaw_deg": problem.yaw_rad}
    missing_options = [f"`{name}`" for name, value in known.items() if value is None]
    reasons = []
    # if all is given, only compare with EKF2; the band-passed IMU is not sufficient for that
    reference_kinds = (tracks.ekf2_references, tracks.imu_references)
    for references in reference_kinds if missing_options else reference_kinds[:1]:
        try:
            match = _match(references(flight), problem)
            _check_match(match)
            return _fit_across_resets(flight, match, problem)
        except NoMatchError as error:
            if error.remedy and missing_options:
                raise
            reasons.append(str(error))
    if missing_options:
        raise NoMatchError(
            "; ".join(dict.fromkeys(reasons)), f"Give {' and '.join(missing_options)}"
        )
    return None


def _match(references: list[SampledTrack], problem: AlignmentProblem) -> Match:
    """Match with the best of the references, in the best of the frames."""
    samples, frame, yaw_rad = problem.samples, problem.frame, problem.yaw_rad
    if samples.index[-1] - samples.index[0] > MAX_SPAN_S:
        raise NoMatchError("the position file spans more than one day; cut it to the flight")
    if tracks.horizontal_range_m(tracks.file_track(samples, "ned")) < tracks.MIN_MOTION_M:
        raise NoMatchError("the positions in the file hardly change")
    frames = (frame,) if frame else YAW_FREE_FRAMES if yaw_rad is None else tuple(tracks.FRAMES)
    matches = []
    for reference in references:
        name = reference.name
        fit_frame = partial(_best_fit, problem, reference)
        fits = {tried_frame: fit_frame(tried_frame, yaw_rad) for tried_frame in frames}
        misfits = {
            tried_frame: fits[tried_frame].rms_m
            for tried_frame in sorted(fits, key=lambda f: fits[f].rms_m)
        }
        best = next(iter(misfits))
        fit = fits[best]
        free_yaw_fit = fit if yaw_rad is None else fit_frame(best, None)
        is_rotated = is_good_fit(free_yaw_fit, name) and (
            fit.concordance < MIN_CONCORDANCE[name]
            or needs_rotation(fit.horizontal_rms_m, free_yaw_fit, name)
        )
        better = ""
        if is_rotated and frame and yaw_rad is not None:
            others = {
                tried_frame: fit_frame(tried_frame, yaw_rad)
                for tried_frame in tracks.FRAMES
                if tried_frame != frame
            }
            other, other_fit = min(others.items(), key=lambda item: item[1].rms_m)
            fits_well = other_fit.concordance >= GOOD_CONCORDANCE[name]
            better = other if fits_well and ROTATION_RATIO * other_fit.rms_m < fit.rms_m else ""
        matches.append(Match(reference, best, misfits, fit, free_yaw_fit, is_rotated, better))
    return min(matches, key=lambda match: match.clock.rms_m)


def needs_rotation(horizontal_rms_m: float, free_yaw_fit: Fit, reference: str) -> bool:
    """Return True if a free yaw and origin clearly reduce the residual."""
    return horizontal_rms_m > ROTATION_RATIO * free_yaw_fit.horizontal_rms_m and (
        horizontal_rms_m > ROTATION_RMS_M or reference == IMU
    )


def is_good_fit(fit: Fit, reference: str) -> bool:
    """Return True if the fit exceeds GOOD_CONCORDANCE and no other lag fits equally well."""
    return (
        fit.concordance >= GOOD_CONCORDANCE[reference]
        and fit.second_peak_ratio >= MIN_SECOND_PEAK_RATIO
    )


def _check_match(match: Match) -> None:
    """Raise NoMatchError if the match is poor or ambiguous."""
    name, fit = match.reference.name, match.clock
    if fit.concordance < MIN_CONCORDANCE[name]:
        raise NoMatchError(
            f"the position file does not match the {name} (concordance correlation "
            f"{fit.concordance:.2f}; at least {MIN_CONCORDANCE[name]:g} needed)"
        )
    clock_open = ""
    if fit.second_peak_ratio < MIN_SECOND_PEAK_RATIO:
        difference_s = abs(fit.second_peak_s)
        clock_open = f"; offsets that differ by {difference_s:.1f} s fit the {name} equally well"
    elif fit.lag_sigma_s is not None and fit.lag_sigma_s > MAX_CLOCK_SIGMA_S:
        clock_open = f" (its standard deviation exceeds {MAX_CLOCK_SIGMA_S:g} s)"
    if clock_open:
        raise NoMatchError(
            f"the time offset cannot be estimated from this path{clock_open}",
            "Give `clock_offset_s`",
        )
    if len(match.misfits_m) > 1:
        best, second = (np.hypot(m, RESIDUAL_FLOOR_M) for m in [*match.misfits_m.values()][:2])
        if second < FRAME_RATIO * best:
            raise NoMatchError(
                f"no frame fits the {name} significantly better than the others ({match.misfits})",
                f"Give `frame`{' or `yaw_deg` auto' if match.is_rotated else ''}",
            )


def _fit_across_resets(flight: Flight, match: Match, problem: AlignmentProblem) -> Match:
    """Repeat the fit to EKF2, with its resets corrected as in the comparison."""
    ekf2, clock = flight.ekf2, match.clock
    if match.reference.name == IMU or isinstance(ekf2, Unavailable) or not ekf2.resets:
        return match
    samples, frame = problem.samples, match.frame
    placed = tracks.placed_samples(samples, frame, clock.yaw_rad, clock.origin_m, clock.lag_s)
    track, file = tracks.continuous_track(ekf2, placed), tracks.file_track(samples, frame)
    fit_again = partial(
        time_and_pose_fit.least_squares_fit, file, track, clock_free=problem.lag_s is None
    )
    free_yaw_fit = fit_again(match.free_yaw_fit, None)
    fit = free_yaw_fit if problem.yaw_rad is None else fit_again(match.fit, problem.yaw_rad)
    return replace(match, reference=track, fit=fit, free_yaw_fit=free_yaw_fit)


def _best_fit(
    problem: AlignmentProblem, reference: SampledTrack, frame: str, yaw_rad: float | None
) -> Fit:
    """Find the lag, unless it is given, then fit."""
    file, lag_s = tracks.file_track(problem.samples, frame), problem.lag_s
    coarse = tracks.resample_to_grid(tracks.remove_spikes(file))
    if reference.name == IMU:
        if len(coarse.time_s) * STEP_S < tracks.MIN_OVERLAP_S:
            raise NoMatchError("the file is too short for a match with the IMU")
        band_passed_twice = tracks.band_pass(tracks.band_pass(coarse.position_m))
        file = coarse = tracks.remove_edges(replace(coarse, position_m=band_passed_twice))
    peak = (
        time_and_pose_fit.correlation_peak(coarse, reference, yaw_rad)
        if lag_s is None
        else Peak(lag_s)
    )
    return time_and_pose_fit.least_squares_fit(
        file, reference, peak, yaw_rad, clock_free=lag_s is None
    )
