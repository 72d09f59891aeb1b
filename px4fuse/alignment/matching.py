"""The position file matched with EKF2 or the IMU, in the frame that fits, or refused."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pandas as pd

from px4fuse.alignment import fitting, tracks
from px4fuse.alignment.fitting import MIN_CONCORDANCE, RESIDUAL_FLOOR_M, Fit, Peak
from px4fuse.alignment.tracks import EKF2_POSITION, IMU, NoMatchError, SampledTrack
from px4fuse.flight import Flight, Unavailable
from px4fuse.trajectory.offset import MIN_SECOND_PEAK_RATIO, STEP_S

# nwu is enu turned by 90°
YAW_FREE_FRAMES = ("ned", "enu")
MAX_SPAN_S = 86400.0  # a day takes five seconds on the tracks' grid
# Concordance below which a match is rough: a warning says so, and it overrules nothing
GOOD_CONCORDANCE = {EKF2_POSITION: 0.9, IMU: 0.7}
MAX_CLOCK_SIGMA_S = 0.5
FRAME_RATIO = 1.3  # by which one frame must fit better than the next
# A free yaw and origin that reduce the residual so much say that the file's frame is not EKF2's
ROTATION_RATIO, ROTATION_RMS_M = 2.0, 0.3


@dataclass(frozen=True)
class AlignmentProblem:
    """A position file, and what is known of how it lies in the flight; what is None is sought.

    Attributes
    ----------
    samples : DataFrame
        Of the file, by its own clock.
    frame : str or None
    yaw_rad : float or None
        Of the file's frame against EKF2's.
    lag_s : float or None
        Time of the flight at the file's first sample.
    """

    samples: pd.DataFrame
    frame: str | None
    yaw_rad: float | None
    lag_s: float | None


@dataclass(frozen=True)
class Match:
    """The file in one frame, matched with one reference.

    Attributes
    ----------
    reference : OwnTrack
    frame : str
    misfits_m : dict from frame to float
        Residual in each frame that was tried, best first.
    fit : Fit
        With the yaw that was asked for, found where none was.
    free_yaw_fit : Fit
        With the yaw found in any case.
    is_rotated : bool
        Whether the file's frame is clearly not EKF2's, so that the clock is taken from ``free_yaw_fit``.
    better_frame : str
        Frame in which the file fits without a turn, where that is not the one asked for.
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
        """The fit that the clock is taken from."""
        return self.free_yaw_fit if self.is_rotated else self.fit

    @property
    def misfits(self) -> str:
        """Residual in each frame, in words."""
        return ", ".join(f"{name} {misfit:.2f} m" for name, misfit in self.misfits_m.items())


def find_match(flight: Flight, problem: AlignmentProblem) -> Match | None:
    """Match with the first reference that serves; None where none does and nothing is sought.

    Raises
    ------
    NoMatchError
        With its remedy.
    """
    known = {"clock_offset_s": problem.lag_s, "frame": problem.frame, "yaw_deg": problem.yaw_rad}
    missing_options = [f"`{name}`" for name, value in known.items() if value is None]
    reasons = []
    # what is all given is at most compared, for which the IMU's band says too little
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
        raise NoMatchError("the file spans more than a day: cut it to the day of the flight")
    if tracks.horizontal_range_m(tracks.file_track(samples, "ned")) < tracks.MIN_MOTION_M:
        raise NoMatchError("the file hardly moves")
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
    """Whether the file fits clearly better with a yaw and origin of its own."""
    return horizontal_rms_m > ROTATION_RATIO * free_yaw_fit.horizontal_rms_m and (
        horizontal_rms_m > ROTATION_RMS_M or reference == IMU
    )


def is_good_fit(fit: Fit, reference: str) -> bool:
    """Whether a fit is good enough to overrule what was asked for."""
    return (
        fit.concordance >= GOOD_CONCORDANCE[reference]
        and fit.second_peak_ratio >= MIN_SECOND_PEAK_RATIO
    )


def _check_match(match: Match) -> None:
    """Refuse a match that is poor, or is not the only one.

    Raises
    ------
    NoMatchError
    """
    name, fit = match.reference.name, match.clock
    if fit.concordance < MIN_CONCORDANCE[name]:
        raise NoMatchError(
            f"the file does not follow the {name} (concordance {fit.concordance:.2f}, at least "
            f"{MIN_CONCORDANCE[name]:g} is needed)"
        )
    clock_open = ""
    if fit.second_peak_ratio < MIN_SECOND_PEAK_RATIO:
        clock_open = f": offsets {abs(fit.second_peak_s):.1f} s apart fit the {name} equally well"
    elif fit.lag_sigma_s is not None and fit.lag_sigma_s > MAX_CLOCK_SIGMA_S:
        clock_open = f" (standard deviation of the offset above {MAX_CLOCK_SIGMA_S:g} s)"
    if clock_open:
        raise NoMatchError(
            f"the flight's path leaves the clock open{clock_open}", "Give `clock_offset_s`"
        )
    if len(match.misfits_m) > 1:
        best, second = (np.hypot(m, RESIDUAL_FLOOR_M) for m in [*match.misfits_m.values()][:2])
        if second < FRAME_RATIO * best:
            raise NoMatchError(
                f"no frame fits the {name} clearly best ({match.misfits})",
                f"Give `frame`{' or `yaw_deg` auto' if match.is_rotated else ''}",
            )


def _fit_across_resets(flight: Flight, match: Match, problem: AlignmentProblem) -> Match:
    """Fit again to EKF2 with its resets treated as everything else in px4fuse treats them."""
    ekf2, clock = flight.ekf2, match.clock
    if match.reference.name == IMU or isinstance(ekf2, Unavailable) or not ekf2.resets:
        return match
    samples, frame = problem.samples, match.frame
    placed = tracks.placed_samples(samples, frame, clock.yaw_rad, clock.origin_m, clock.lag_s)
    track, file = tracks.continuous_track(ekf2, placed), tracks.file_track(samples, frame)
    fit_again = partial(fitting.least_squares_fit, file, track, clock_free=problem.lag_s is None)
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
    peak = fitting.correlation_peak(coarse, reference, yaw_rad) if lag_s is None else Peak(lag_s)
    return fitting.least_squares_fit(file, reference, peak, yaw_rad, clock_free=lag_s is None)
