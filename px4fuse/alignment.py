"""An external position file placed into a flight: clock, frame, yaw and origin.

A UWB computer records on its own clock and in its own frame. Both are found by matching its track
with a reference in the log: EKF2's position, or, where that does not serve, the IMU's acceleration
integrated twice, with both sides passed through the same filter.

Horizontal positions are complex numbers here, north + i·east, so that a yaw is a factor e^{iψ}. The
clock is found in two steps: over all lags by masked cross-correlation through the FFT (Padfield
2012), then far below one sample by robust least squares. What is found is relative to the
reference: an EKF2 that was fed with late positions is late itself, and the clock offset with it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid
from scipy.ndimage import binary_erosion, gaussian_filter1d, median_filter
from scipy.optimize import least_squares
from scipy.signal import butter, correlate, sosfiltfilt

from px4fuse.errors import MissingDataError, SettingsError
from px4fuse.flight import (
    POSITION_COLUMNS,
    POSITION_VARIANCE_COLUMNS,
    Alignment,
    Ekf2,
    Flight,
    InputFile,
    PositionTrack,
    Unavailable,
    finite_rows,
)
from px4fuse.projection import continuous_state
from px4fuse.signals import Array, Segment, ned_acceleration

if TYPE_CHECKING:
    from px4fuse.readers.position_csv import PositionFile

Complex = NDArray[np.complex128]

# Which of x, y, z is north, east, down, and with which sign
FRAMES = {
    "ned": ([0, 1, 2], [1.0, 1.0, 1.0]),
    "enu": ([1, 0, 2], [1.0, 1.0, -1.0]),
    "nwu": ([0, 1, 2], [1.0, -1.0, -1.0]),
}
# nwu is enu turned by 90°
TURNABLE_FRAMES = ("ned", "enu")
FRAME_OPTION = f"--position-frame {'|'.join(FRAMES)}"
EKF2_POSITION, IMU = "EKF2 position", "IMU"

STEP_S = 0.05  # of the common grid
MAX_SPAN_S = 86400.0  # a day takes five seconds on that grid
# Nothing is interpolated in an interval longer than this and than three median ones
GAP_S, GAP_INTERVALS = 0.5, 3.0
MIN_MOTION_M = 0.5
MIN_SAMPLES = 10
MIN_OVERLAP_S = 10.0  # or half of the shorter track
# EKF2's output moves in steps at its updates; the low-pass over them has no delay
SMOOTHING_S = 0.2
# Where acceleration integrated twice resembles a position: below this band it drifts
BAND_HZ = (0.1, 1.0)
BAND_EDGE_S, BAND_PADDING_S = 2.0, 10.0  # what the filter's transients spoil, and its padding
WINDOW_S = 1.0  # by which the least squares may leave the correlation's peak
# Concordance below which nothing was matched, and below which a warning says so
MIN_CONCORDANCE = {EKF2_POSITION: 0.7, IMU: 0.5}
GOOD_CONCORDANCE = {EKF2_POSITION: 0.9, IMU: 0.7}
MIN_MISFIT = 1e-4  # better matches are as good as this one, so that the longer of them counts
# Another lag whose residual is not larger by these factors cannot, or can hardly, be told apart
SAME_RESIDUAL = 1.2
NEAR_RESIDUAL = {EKF2_POSITION: 2.0, IMU: 1.4}  # the IMU's own noise leaves 1.4 to 1.7
FAR_S = 3.0  # at this distance a lag is another one, even on a plateau
RESIDUAL_FLOOR_M = 0.05  # what the grid's steps leave of a perfect match
MAX_CLOCK_SIGMA_S, LARGE_CLOCK_SIGMA_S = 0.5, 0.1
LARGE_YAW_SIGMA_DEG = 2.0
MIN_MIRRORED = 0.8  # correlation of the heights below minus which they run against each other
MAX_UNIX_DIFFERENCE_S = 60.0  # computers in a lab keep time better than this
FRAME_RATIO = 1.3  # by which one frame must fit better than the next
# A free yaw and origin that reduce the residual so much say that the file's frame is not EKF2's
TURNED_RATIO, TURNED_RMS_M = 2.0, 0.3
MAX_DISTANCE_M = 1.0  # a larger one counts as this where fits are compared: it may be NLOS


@dataclass(frozen=True)
class _Track:
    """Positions over time, of the file or of its reference.

    Attributes
    ----------
    time_s : ndarray, shape (n,)
        Of the flight; for the file from its first sample on.
    position_m : ndarray, shape (n, 3)
        North, east, down; down may be NaN.
    valid : ndarray of bool, shape (n,)
        False inside gaps.
    name : str
        Of a reference.
    """

    time_s: Array
    position_m: Array
    valid: NDArray[np.bool_]
    name: str = ""

    @property
    def horizontal_m(self) -> Complex:
        """North + i·east, shape (n,)."""
        return self.position_m[:, 0] + 1j * self.position_m[:, 1]

    def at(self, time_s: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Position at given times, and whether there is one (outside and in gaps there is none)."""
        position = [np.interp(time_s, self.time_s, column) for column in self.position_m.T]
        valid = np.interp(time_s, self.time_s, self.valid.astype(float), 0.0, 0.0) > 0.999
        return np.stack(position, axis=1), valid


@dataclass(frozen=True)
class _Peak:
    """Peak of the cross-correlation.

    Attributes
    ----------
    lag_s : float
        Time of the flight at the file's first sample.
    concordance : float
        2·Re(e^{-iψ}cov) / (var + var): a correlation that also falls where one of the two moves
        further than the other; 1 only where they are equal but for an offset.
    rival_s : float
        The best lag elsewhere, relative to this one; NaN where there is none.
    rival_ratio : float
        Its residual (RMS) over that of the peak.
    """

    lag_s: float
    concordance: float
    rival_s: float = float("nan")
    rival_ratio: float = float("inf")


@dataclass(frozen=True)
class _Fit:
    """Least-squares fit of e^{iψ}·file(t) + origin to reference(t + lag).

    Attributes
    ----------
    peak : _Peak
        Where it started; where the clock was given, with the fit's own concordance.
    lag_s, yaw_rad : float
    lag_sigma_s, yaw_sigma_rad : float or None
        None where it was not free.
    origin_m : ndarray, shape (3,)
        North, east, down.
    coherence : complex
        Normalised covariance of reference and file before the yaw: its angle is the best yaw.
    horizontal_rms_m, rms_m : float
        Capped residual: per horizontal axis; and of the vector, with height where both have it.
    overlap_s : float
        From the first to the last sample that was used.
    """

    peak: _Peak
    lag_s: float
    lag_sigma_s: float | None
    yaw_rad: float
    yaw_sigma_rad: float | None
    origin_m: Array
    coherence: complex
    horizontal_rms_m: float
    rms_m: float
    overlap_s: float


@dataclass(frozen=True)
class _Match:
    """The file in one frame, matched with one reference.

    Attributes
    ----------
    reference : _Track
    frame : str
    misfits_m : dict from frame to float
        Residual in each frame that was tried, best first.
    fit : _Fit
        With the yaw that was asked for, found where none was.
    free : _Fit
        With the yaw found in any case.
    turned : bool
        Whether the file's frame is clearly not EKF2's, so that the clock is taken from ``free``.
    better_frame : str
        Frame in which the file fits without a turn, where that is not the one asked for.
    """

    reference: _Track
    frame: str
    misfits_m: dict[str, float]
    fit: _Fit
    free: _Fit
    turned: bool
    better_frame: str = ""

    @property
    def clock(self) -> _Fit:
        """The fit that the clock is taken from."""
        return self.free if self.turned else self.fit


class _NoMatchError(Exception):
    """A reference does not match; with a remedy where no other reference could do better."""

    def __init__(self, reason: str, remedy: str = "") -> None:
        super().__init__(reason)
        self.remedy = remedy


def place(
    flight: Flight,
    file: PositionFile,
    *,
    frame: str | None = None,
    yaw_deg: float | Literal["auto"] | None = None,
    clock_offset_s: float | None = None,
) -> Flight:
    """Place an external position file into a flight, as its first position track.

    Parameters
    ----------
    flight : Flight
    file : PositionFile
    frame : {"ned", "enu", "nwu"}, optional
        What the file's x, y, z are; by default what its column names say, or else what fits.
    yaw_deg : float or "auto", optional
        Rotation of the file about down, clockwise seen from above, after the frame. None is 0: the
        file's frame is EKF2's but for the names of its axes. "auto" finds yaw and origin.
    clock_offset_s : float, optional
        The autopilot's boot clock minus the file's; by default it is found, relative to the
        reference. Where EKF2 was fed with late positions its track lags the vehicle, and the
        offset that is found contains this lag.

    Returns
    -------
    Flight
        With the track first in ``positions``, the file in ``inputs``, and what the file's reader
        decided in ``log.notes``. All of the file is kept, what lies outside the flight too.

    Raises
    ------
    SettingsError
        The frame is unknown, or yaw or clock offset is not a finite number.
    MissingDataError
        Clock, frame or yaw was to be found and cannot be, or file and log do not overlap in time.
    """
    _check_options(frame, yaw_deg, clock_offset_s)
    samples = finite_rows(file.samples, ["x_m", "y_m"])
    if len(samples) < MIN_SAMPLES:
        raise MissingDataError(
            f"{file.name}: {len(samples)} positions are too few, at least {MIN_SAMPLES} are needed."
        )
    start_s, end_s = float(samples.index[0]), float(samples.index[-1])
    boot_s = flight.log.boot_time_s
    spans = (
        f"the log covers {boot_s:.2f} s to {boot_s + flight.log.duration_s:.2f} s of the boot "
        f"clock, the file {start_s:.2f} s to {end_s:.2f} s of its own {file.clock} clock"
    )
    lag_s = None if clock_offset_s is None else start_s + clock_offset_s - boot_s
    if lag_s is not None and not start_s - end_s <= lag_s <= flight.log.duration_s:
        raise MissingDataError(
            f"{file.name}: with --clock-offset {clock_offset_s:.3f} it does not overlap the log; "
            f"{spans}. Correct the offset, or leave it out to have it found."
        )
    yaw_rad = None if yaw_deg == "auto" else float(np.radians(yaw_deg or 0.0))
    try:
        match = _find(flight, samples, frame or file.frame, yaw_rad, lag_s)
    except _NoMatchError as error:
        raise MissingDataError(f"{file.name}: {error}; {spans}. {error.remedy}.") from None
    alignment, placed = _describe(flight, file, samples, match, frame, yaw_deg, clock_offset_s)
    how = f"matched with {alignment.reference}" if clock_offset_s is None else "as given"
    track = PositionTrack(
        name=file.name,
        rung=1,
        description=f"external position file, {len(placed)} samples, {alignment.frame}"
        + (f" turned by {alignment.yaw_deg:.1f}°" if alignment.yaw_deg else ""),
        samples=placed,
        frame="NED",
        clock=f"the file's own {file.clock} clock, {alignment.clock_offset_s:+.3f} s to the boot "
        f"clock, {how}",
        reconstructed=False,
        topics=(file.name,),
        log=file.name,
        alignment=alignment,
    )
    said = tuple(f"{file.name}: {text}" for text in (*file.detected, *file.notes))
    return replace(
        flight,
        log=replace(flight.log, notes=(*flight.log.notes, *said)),
        positions=(track, *flight.positions),
        inputs=(
            *flight.inputs,
            InputFile(file.name, file.sha256, file.size_bytes, role="position"),
        ),
    )


def _check_options(
    frame: str | None, yaw_deg: float | str | None, clock_offset_s: float | None
) -> None:
    if frame is not None and frame not in FRAMES:
        raise SettingsError(
            f"--position-frame {frame}: there is no such frame. Choose from {', '.join(FRAMES)}."
        )
    if isinstance(yaw_deg, str):
        if yaw_deg != "auto":
            raise SettingsError(f"--position-yaw {yaw_deg}: give degrees, or auto.")
    elif yaw_deg is not None and not np.isfinite(yaw_deg):
        raise SettingsError(f"--position-yaw {yaw_deg:g} is not a finite number.")
    if clock_offset_s is not None and not np.isfinite(clock_offset_s):
        raise SettingsError(f"--clock-offset {clock_offset_s:g} is not a finite number.")


# -- from samples to tracks ------------------------------------------------------------------------


def _file_track(samples: pd.DataFrame, frame: str) -> _Track:
    """Read the file's axes as north, east, down; time from its first sample on."""
    order, sign = FRAMES[frame]
    time = samples.index.to_numpy()
    return _Track(
        time - time[0],
        samples[["x_m", "y_m", "z_m"]].to_numpy()[:, order] * sign,
        np.ones(len(time), dtype=bool),
    )


def _on_grid(track: _Track) -> _Track:
    """Resample to the grid that begins with the track, gaps marked."""
    interval = np.diff(track.time_s)
    grid = np.arange(track.time_s[0], track.time_s[-1], STEP_S)
    before = np.searchsorted(track.time_s, grid, side="right") - 1
    longest = max(GAP_S, GAP_INTERVALS * float(np.median(interval)))
    within = interval[np.clip(before, 0, len(interval) - 1)] <= longest
    return _Track(grid, track.at(grid)[0], within)


def _despiked(track: _Track, window: int = 3) -> _Track:
    """Without single outliers, or more with a longer median."""
    return replace(track, position_m=median_filter(track.position_m, size=(window, 1)))


def _band(position_m: Array) -> Array:
    """Band-pass without delay."""
    sos = butter(2, BAND_HZ, "bandpass", fs=1.0 / STEP_S, output="sos")
    padding = min(round(BAND_PADDING_S / STEP_S), len(position_m) - 1)
    filtered: Array = sosfiltfilt(sos, position_m, axis=0, padlen=padding)
    return filtered


def _without_edges(track: _Track) -> _Track:
    edge = round(BAND_EDGE_S / STEP_S)
    return replace(track, valid=binary_erosion(track.valid, np.ones(2 * edge + 1, dtype=bool)))


def _range(track: _Track) -> float:
    """Larger horizontal range (m), noise and outliers left out."""
    return float(np.max(np.ptp(_despiked(track, 5).position_m[:, :2], axis=0)))


def _ekf2_track(state: pd.DataFrame) -> _Track:
    """EKF2's position on the grid, smoothed."""
    known = finite_rows(state, POSITION_COLUMNS[:2])
    if len(known) < MIN_SAMPLES:
        raise _NoMatchError("EKF2 has no horizontal position in this log")
    raw = _Track(
        known.index.to_numpy(), known[POSITION_COLUMNS].to_numpy(), np.ones(len(known), dtype=bool)
    )
    grid = _on_grid(raw)
    smooth = gaussian_filter1d(grid.position_m, SMOOTHING_S / STEP_S, axis=0, mode="nearest")
    return replace(grid, position_m=smooth, name=EKF2_POSITION)


def _ekf2_references(flight: Flight) -> list[_Track]:
    """EKF2's position as published and, where it was reset horizontally, without those resets.

    Height is always as published: most of its resets correct an error of before take-off.
    """
    if isinstance(flight.ekf2, Unavailable):
        raise _NoMatchError("the log has no EKF2 position")
    state = flight.ekf2.state
    states = [state]
    resets = [
        reset
        for reset in flight.ekf2.resets
        if reset.quantity == "position" and any(reset.delta[:2])
    ]
    if resets:
        after = state.index.to_numpy()[:, None] >= np.array([reset.time_s for reset in resets])
        moved = after @ np.array([(*reset.delta[:2], 0.0) for reset in resets])
        states.append(state.assign(**(state[POSITION_COLUMNS] - moved)))
    references = [_ekf2_track(state) for state in states]
    if max(map(_range, references)) < MIN_MOTION_M:
        raise _NoMatchError("EKF2's position hardly moves")
    return references


def _imu_references(flight: Flight) -> list[_Track]:
    """Acceleration integrated twice, band-passed after each integration."""
    acceleration = ned_acceleration(flight)
    if isinstance(acceleration, Unavailable):
        raise _NoMatchError("the log has no acceleration in NED")
    time = acceleration.index.to_numpy()
    velocity = cumulative_trapezoid(acceleration.to_numpy(), time, axis=0, initial=0)
    grid = _on_grid(_Track(time, velocity, np.ones(len(time), dtype=bool)))
    if len(grid.time_s) * STEP_S < MIN_OVERLAP_S:
        raise _NoMatchError("the IMU's record is too short")
    position = cumulative_trapezoid(_band(grid.position_m), dx=STEP_S, axis=0, initial=0)
    return [_without_edges(replace(grid, position_m=_band(position), name=IMU))]


# -- matching --------------------------------------------------------------------------------------


def _find(
    flight: Flight,
    samples: pd.DataFrame,
    frame: str | None,
    yaw_rad: float | None,
    lag_s: float | None,
) -> _Match | None:
    """Match with the first reference that serves; None where none does and nothing is sought.

    Raises
    ------
    _NoMatchError
        With its remedy.
    """
    sought = [
        option
        for option, known in (
            ("--clock-offset SECONDS", lag_s),
            (FRAME_OPTION, frame),
            ("--position-yaw DEGREES", yaw_rad),
        )
        if known is None
    ]
    reasons = []
    # what is all given is at most compared, for which the IMU's band says too little
    for references in (_ekf2_references, _imu_references) if sought else (_ekf2_references,):
        try:
            match = _match(references(flight), samples, frame, yaw_rad, lag_s)
            _check_match(match)
            if match.reference.name == IMU:
                return match
            return _mend_resets(flight, samples, match, yaw_rad, lag_s)
        except _NoMatchError as error:
            if error.remedy and sought:
                raise
            reasons.append(str(error))
    if sought:
        raise _NoMatchError("; ".join(dict.fromkeys(reasons)), f"Give {' and '.join(sought)}")
    return None


def _match(
    references: list[_Track],
    samples: pd.DataFrame,
    frame: str | None,
    yaw_rad: float | None,
    lag_s: float | None,
) -> _Match:
    """Match with the best of the references, in the best of the frames."""
    if samples.index[-1] - samples.index[0] > MAX_SPAN_S:
        raise _NoMatchError("the file spans more than a day: cut it to the day of the flight")
    if _range(_file_track(samples, "ned")) < MIN_MOTION_M:
        raise _NoMatchError("the file hardly moves")
    frames = (frame,) if frame else TURNABLE_FRAMES if yaw_rad is None else tuple(FRAMES)
    matches = []
    for reference in references:
        fits = {name: _best_fit(samples, name, reference, yaw_rad, lag_s) for name in frames}
        fits = dict(sorted(fits.items(), key=lambda item: item[1].rms_m))
        best, fit = next(iter(fits.items()))
        free = fit if yaw_rad is None else _best_fit(samples, best, reference, None, lag_s)
        turned = fit.peak.concordance < MIN_CONCORDANCE[reference.name] or _is_turned(
            fit.horizontal_rms_m, free, reference.name
        )
        turned &= _is_sound(free, reference.name)
        misfits = {name: tried.rms_m for name, tried in fits.items()}
        better = ""
        if turned and frame and yaw_rad is not None:
            others = {
                name: _best_fit(samples, name, reference, yaw_rad, lag_s)
                for name in FRAMES
                if name != frame
            }
            name, other = min(others.items(), key=lambda item: item[1].rms_m)
            fits_well = other.peak.concordance >= GOOD_CONCORDANCE[reference.name]
            if fits_well and TURNED_RATIO * other.rms_m < fit.rms_m:
                better = name
        matches.append(_Match(reference, best, misfits, fit, free, turned, better))
    return min(matches, key=lambda match: match.clock.rms_m)


def _is_turned(horizontal_rms_m: float, free: _Fit, reference: str) -> bool:
    """Whether the file fits clearly better with a yaw and origin of its own."""
    return horizontal_rms_m > TURNED_RATIO * free.horizontal_rms_m and (
        horizontal_rms_m > TURNED_RMS_M or reference == IMU
    )


def _is_sound(fit: _Fit, reference: str) -> bool:
    """Whether a fit is good enough to overrule what was asked for."""
    good = fit.peak.concordance >= GOOD_CONCORDANCE[reference]
    return good and fit.peak.rival_ratio >= SAME_RESIDUAL


def _check_match(match: _Match) -> None:
    """Refuse a match that is none, or is not the only one.

    Raises
    ------
    _NoMatchError
    """
    name, fit = match.reference.name, match.clock
    peak = fit.peak
    if peak.concordance < MIN_CONCORDANCE[name]:
        raise _NoMatchError(
            f"the file does not follow the {name} (concordance {peak.concordance:.2f}, at least "
            f"{MIN_CONCORDANCE[name]:g} is needed)"
        )
    if peak.rival_ratio < SAME_RESIDUAL:
        raise _NoMatchError(
            f"the flight's path leaves the clock open: offsets {abs(peak.rival_s):.1f} s apart fit "
            f"the {name} equally well",
            "Give --clock-offset SECONDS",
        )
    if fit.lag_sigma_s is not None and fit.lag_sigma_s > MAX_CLOCK_SIGMA_S:
        raise _NoMatchError(
            "the flight's path leaves the clock open (standard deviation of the offset above "
            f"{MAX_CLOCK_SIGMA_S:g} s)",
            "Give --clock-offset SECONDS",
        )
    if len(match.misfits_m) > 1:
        best, second = (np.hypot(m, RESIDUAL_FLOOR_M) for m in [*match.misfits_m.values()][:2])
        if second < FRAME_RATIO * best:
            raise _NoMatchError(
                f"no frame fits the {name} clearly best ({_figures(match.misfits_m)})",
                f"Give {FRAME_OPTION}{' or --position-yaw auto' if match.turned else ''}",
            )


def _mend_resets(
    flight: Flight,
    samples: pd.DataFrame,
    match: _Match,
    yaw_rad: float | None,
    lag_s: float | None,
) -> _Match:
    """Fit again to EKF2 with its resets treated as everything else in px4fuse treats them."""
    if isinstance(flight.ekf2, Unavailable) or not flight.ekf2.resets:
        return match
    clock = match.clock
    placed = _placed(samples, match.frame, clock.yaw_rad, clock.origin_m, clock.lag_s)
    track = _continuous_track(flight.ekf2, placed)
    again = partial(_fit, _file_track(samples, match.frame), track, clock_free=lag_s is None)
    free = again(match.free.peak, match.free.lag_s, None)
    fit = free if yaw_rad is None else again(match.fit.peak, match.fit.lag_s, yaw_rad)
    return replace(match, reference=track, fit=fit, free=free)


def _best_fit(
    samples: pd.DataFrame,
    frame: str,
    reference: _Track,
    yaw_rad: float | None,
    lag_s: float | None,
) -> _Fit:
    """Find the lag, unless it is given, then fit."""
    file = _file_track(samples, frame)
    coarse = _on_grid(_despiked(file))
    if reference.name == IMU:
        if len(coarse.time_s) * STEP_S < MIN_OVERLAP_S:
            raise _NoMatchError("the file is too short for a match with the IMU")
        coarse = replace(coarse, position_m=_band(_band(coarse.position_m)))
        file = coarse = _without_edges(coarse)
    if lag_s is not None:
        return _fit(file, reference, None, lag_s, yaw_rad, clock_free=False)
    peak = _peak(coarse, reference, yaw_rad)
    return _fit(file, reference, peak, peak.lag_s, yaw_rad, clock_free=True)


def _peak(file: _Track, reference: _Track, yaw_rad: float | None) -> _Peak:
    """Lag of greatest likelihood gain over all lags on the grid, yaw free where None.

    With a free offset the residual sum of squares over an overlap of N grid points is
    Σ|f - f̄|² + Σ|g - ḡ|² - 2·Re(e^{-iψ}cov); against two tracks that have nothing in common the
    log-likelihood grows by -N·ln(1 - concordance), which is maximised: a long overlap with an
    excellent match beats a short one in which two straight lines match as well.

    Raises
    ------
    _NoMatchError
        No lag has enough overlap.
    """
    f_mask, g_mask = file.valid.astype(float), reference.valid.astype(float)

    def masked(track: _Track) -> Complex:
        z = track.horizontal_m
        return np.where(track.valid, z - np.mean(z[track.valid]), 0.0)

    def total(of_file: Array | Complex, of_reference: Array | Complex) -> Complex:
        """Σ conj(file)·reference over the overlap, for each lag."""
        sums: Complex = correlate(of_reference, of_file, method="fft").astype(np.complex128)
        return sums

    if not file.valid.any() or not reference.valid.any():
        raise _NoMatchError("too little is left between gaps to be matched")
    f, g = masked(file), masked(reference)
    count = np.rint(total(f_mask, g_mask).real)
    shorter = min(np.count_nonzero(file.valid), np.count_nonzero(reference.valid))
    enough = count >= max(MIN_SAMPLES, min(MIN_OVERLAP_S / STEP_S, shorter / 2.0))
    if not enough.any():
        raise _NoMatchError("too little is left between gaps to be matched")
    n = np.maximum(count, 1.0)
    sum_f, sum_g = total(f, g_mask).conj(), total(f_mask, g)
    covariance = total(f, g) - sum_f.conj() * sum_g / n
    power = (
        total(np.abs(f) ** 2, g_mask).real
        - np.abs(sum_f) ** 2 / n
        + total(f_mask, np.abs(g) ** 2).real
        - np.abs(sum_g) ** 2 / n
    )
    enough &= power > 1e-9 * np.max(power)  # else rounding errors correlate
    agreed = np.abs(covariance) if yaw_rad is None else (np.exp(-1j * yaw_rad) * covariance).real
    concordance = np.zeros_like(power)
    concordance[enough] = 2.0 * agreed[enough] / power[enough]
    gain = -count * np.log(np.maximum(1.0 - concordance, MIN_MISFIT))
    best = int(np.argmax(np.where(enough, gain, -np.inf)))

    def lag(index: int) -> float:
        return float(reference.time_s[0]) + (index - len(f) + 1) * STEP_S

    # a rival lies where the concordance has fallen to half in between, or far away
    outside = np.flatnonzero(concordance < 0.5 * concordance[best])
    low = np.max(outside[outside < best], initial=-1)
    high = np.min(outside[outside > best], initial=len(n))
    rivals = (count >= 0.5 * count[best]) & (power >= 0.25 * power[best]) & enough
    rivals &= concordance >= MIN_CONCORDANCE[reference.name]
    far = round(FAR_S / STEP_S)
    rivals[max(low + 1, best - far) : min(high, best + far + 1)] = False
    peak = _Peak(lag(best), float(concordance[best]))
    if not rivals.any():
        return peak
    # per axis; the floor keeps two perfect matches equal
    residual = np.sqrt(np.maximum(power - 2.0 * agreed, 0.0) / (2.0 * n) + RESIDUAL_FLOOR_M**2)
    rival = int(np.argmin(np.where(rivals, residual, np.inf)))
    return replace(
        peak, rival_s=lag(rival) - lag(best), rival_ratio=float(residual[rival] / residual[best])
    )


def _fit(
    file: _Track,
    reference: _Track,
    peak: _Peak | None,
    lag_s: float,
    yaw_rad: float | None,
    *,
    clock_free: bool,
) -> _Fit:
    """Robust least squares (soft L1) over origin and, where free, lag and yaw.

    The origin is always free, even where it is not used: an offset of the file would otherwise
    pass for a lag wherever the vehicle flies more one way than the other. Covariance:
    σ²(JᵀJ)⁻¹ at the optimum with σ from the median residual, times 1 + 2Σρ, the factor by which
    autocorrelated residuals count for fewer (ρ summed up to its first zero).

    Raises
    ------
    _NoMatchError
        Too few samples lie within the reference.
    """
    start, known = reference.at(file.time_s + lag_s)
    used = known & file.valid
    if np.count_nonzero(used) < MIN_SAMPLES:
        raise _NoMatchError(
            f"{np.count_nonzero(used)} of the file's positions fall on the reference"
        )
    time = file.time_s[used] + lag_s
    z, target = file.horizontal_m[used], (start[:, 0] + 1j * start[:, 1])[used]
    centre = np.mean(z)
    z = z - centre  # decorrelates yaw and origin
    power = float(np.sqrt(np.var(z) * np.var(target)))
    coherence = complex(np.vdot(z, target) / len(z) / power) if power > 0 else 0j
    mean_square = float(np.var(z) + np.var(target)) / 2.0
    horizontal = reference.horizontal_m
    yaw_free = yaw_rad is None

    def unpack(x: Array) -> tuple[complex, float, float]:
        """Origin, lag beyond the start, yaw."""
        shift = float(x[2]) if clock_free else 0.0
        return complex(x[0], x[1]), shift, float(x[-1]) if yaw_rad is None else yaw_rad

    def residual(x: Array) -> Array:
        origin, shift, yaw = unpack(x)
        r = np.exp(1j * yaw) * z + origin - np.interp(time + shift, reference.time_s, horizontal)
        return np.concatenate([r.real, r.imag])

    start_at = complex(np.mean(target))
    first = [start_at.real, start_at.imag] + [0.0] * clock_free
    first += [float(np.angle(coherence))] * yaw_free
    limit = np.full(len(first), np.inf)
    if clock_free:
        limit[2] = WINDOW_S
    x0 = np.array(first)
    solution = least_squares(
        residual, x0, bounds=(-limit, limit), loss="soft_l1", f_scale=_scale(residual(x0))
    )
    (origin, shift, yaw), r = unpack(solution.x), residual(solution.x)
    r_complex = r[: len(z)] + 1j * r[len(z) :]
    jacobian = np.asarray(solution.jac)
    information = jacobian.T @ jacobian
    information += 1e-9 * np.diag(np.diag(information) + 1e-12)  # singular: a huge variance
    variance = np.diag(np.linalg.inv(information)) * _scale(r) ** 2 * _inflation(r_complex)
    sigma = np.sqrt(np.maximum(variance, 0.0))
    at_limit = clock_free and abs(shift) > 0.99 * WINDOW_S
    ned, _ = reference.at(time + shift)
    down = ned[:, 2] - file.position_m[used, 2]
    down = down[np.isfinite(down)]
    origin_down = float(np.median(down)) if len(down) else 0.0
    horizontal_rms = _capped_rms(np.abs(r_complex)) / np.sqrt(2.0)
    vertical_rms = _capped_rms(down - origin_down) if len(down) else 0.0
    concordance = (np.exp(-1j * yaw) * coherence).real * power / mean_square if power > 0 else 0.0
    origin -= np.exp(1j * yaw) * centre
    return _Fit(
        peak=peak or _Peak(lag_s, float(concordance)),
        lag_s=lag_s + shift,
        lag_sigma_s=(np.inf if at_limit else float(sigma[2])) if clock_free else None,
        yaw_rad=yaw,
        yaw_sigma_rad=float(sigma[-1]) if yaw_free else None,
        origin_m=np.array([origin.real, origin.imag, origin_down]),
        coherence=coherence,
        horizontal_rms_m=float(horizontal_rms),
        rms_m=float(np.sqrt(2.0 * horizontal_rms**2 + vertical_rms**2)),
        overlap_s=float(time[-1] - time[0]),
    )


def _scale(residual: Array) -> float:
    """Standard deviation by the median; never 0, for a perfect fit too."""
    return max(1.4826 * float(np.median(np.abs(residual))), 1e-3)


def _inflation(residual: Complex) -> float:
    """1 + 2Σρ: how many autocorrelated residuals say as much as one independent one."""
    limit = 3.0 * _scale(np.abs(residual))
    clipped = residual * np.minimum(1.0, limit / np.maximum(np.abs(residual), 1e-12))
    rho = correlate(clipped, clipped, method="fft")[len(clipped) - 1 :].real
    if rho[0] <= 0.0:
        return 1.0
    crossed = np.flatnonzero(rho <= 0.0)
    until = crossed[0] if len(crossed) else len(rho)
    return float(1.0 + 2.0 * np.sum(rho[1:until]) / rho[0])


def _capped_rms(values_m: Array) -> float:
    """Root mean square with large values counted as the largest that counts."""
    return float(np.sqrt(np.mean(np.minimum(np.abs(values_m), MAX_DISTANCE_M) ** 2)))


# -- the result ------------------------------------------------------------------------------------


def _placed(
    samples: pd.DataFrame, frame: str, yaw_rad: float, origin_m: Array, lag_s: float
) -> pd.DataFrame:
    """NED positions and variances: R·C·p + origin, and the diagonal of R·C·diag(σ²)·Cᵀ·Rᵀ."""
    track = _file_track(samples, frame)
    position = track.position_m.copy()
    order, _ = FRAMES[frame]
    variance = samples[["sigma_x_m", "sigma_y_m", "sigma_z_m"]].to_numpy()[:, order] ** 2
    if yaw_rad:  # at 0 a missing sigma of one axis is none of the other's
        c, s = np.cos(yaw_rad), np.sin(yaw_rad)
        turn = np.array([[c, -s], [s, c]])
        position[:, :2] = position[:, :2] @ turn.T
        variance[:, :2] = variance[:, :2] @ (turn**2).T
    columns = POSITION_COLUMNS + POSITION_VARIANCE_COLUMNS
    values = np.hstack([position + origin_m, variance])
    return pd.DataFrame(
        dict(zip(columns, values.T, strict=True)),
        index=pd.Index(track.time_s + lag_s, name="time_s"),
    )


def _continuous_track(ekf2: Ekf2, placed: pd.DataFrame) -> _Track:
    """EKF2's track with its resets treated as the placed file has it."""
    track = PositionTrack("", 1, "", placed, "NED", "", False, ())
    whole = Segment(float(placed.index[0]), float(placed.index[-1]), "")
    return _ekf2_track(continuous_state(ekf2, track, whole)[0])


@dataclass(frozen=True)
class _Comparison:
    """The placed file against EKF2, horizontally.

    Attributes
    ----------
    rms_m, capped_rms_m : float
        Per axis.
    correlation : float or None
        None where EKF2 hardly moves.
    """

    rms_m: float
    capped_rms_m: float
    correlation: float | None


def _compare(flight: Flight, placed: pd.DataFrame) -> _Comparison | None:
    """Compare at the file's times; None where EKF2 has no position there."""
    if isinstance(flight.ekf2, Unavailable):
        return None
    try:
        ekf2, known = _continuous_track(flight.ekf2, placed).at(placed.index.to_numpy())
    except _NoMatchError:
        return None
    if np.count_nonzero(known) < MIN_SAMPLES:
        return None
    ours = (placed["north_m"].to_numpy() + 1j * placed["east_m"].to_numpy())[known]
    theirs = (ekf2[:, 0] + 1j * ekf2[:, 1])[known]
    distance = np.abs(ours - theirs)
    ours, theirs = ours - np.mean(ours), theirs - np.mean(theirs)
    moves = max(np.ptp(theirs.real), np.ptp(theirs.imag)) >= MIN_MOTION_M
    power = float(np.linalg.norm(ours) * np.linalg.norm(theirs))
    return _Comparison(
        rms_m=float(np.sqrt(np.mean(distance**2) / 2.0)),
        capped_rms_m=_capped_rms(distance) / np.sqrt(2.0),
        correlation=float(np.vdot(ours, theirs).real) / power if moves and power > 0.0 else None,
    )


def _describe(
    flight: Flight,
    file: PositionFile,
    samples: pd.DataFrame,
    match: _Match | None,
    frame_option: str | None,
    yaw_deg: float | Literal["auto"] | None,
    clock_offset_s: float | None,
) -> tuple[Alignment, pd.DataFrame]:
    """Alignment, with the reason for each of its parts, and the placed samples."""
    start_to_boot_s = flight.log.boot_time_s - float(samples.index[0])
    frame = frame_option or file.frame or ""
    yaw_rad = 0.0 if yaw_deg is None or yaw_deg == "auto" else float(np.radians(yaw_deg))
    yaw_sigma_deg = clock_sigma_s = correlation = None
    lag_s = 0.0 if clock_offset_s is None else clock_offset_s - start_to_boot_s
    origin_m = np.zeros(3)
    reference = ""
    if match:
        frame, reference = match.frame, match.reference.name
        if yaw_deg == "auto":
            yaw_rad = match.fit.yaw_rad
            yaw_sigma_deg = float(np.degrees(match.fit.yaw_sigma_rad or 0.0))
            origin_m = match.fit.origin_m if reference == EKF2_POSITION else origin_m
        if clock_offset_s is None:
            lag_s, clock_sigma_s = match.clock.lag_s, match.clock.lag_sigma_s
            clock_offset_s = lag_s + start_to_boot_s
        correlation = float((np.exp(-1j * yaw_rad) * match.clock.coherence).real)
    placed = _placed(samples, frame, yaw_rad, origin_m, lag_s)
    compared = None if reference == IMU else _compare(flight, placed)
    if compared:
        reference, correlation = EKF2_POSITION, compared.correlation
    if clock_sigma_s is None:
        clock_reason = "given with --clock-offset"
    else:
        clock_reason = f"matched with {reference}, so that a delay of that is part of it"
    if yaw_deg == "auto":
        yaw_reason = f"matched with {reference}"
    else:
        yaw_reason = (
            "the file's frame is taken to be EKF2's"
            if yaw_deg is None
            else "given with --position-yaw"
        )
    alignment = Alignment(
        frame=frame,
        frame_reason=_frame_reason(frame_option, file.frame, match, yaw_deg == "auto"),
        yaw_deg=float(np.degrees(yaw_rad)),
        yaw_sigma_deg=yaw_sigma_deg,
        yaw_reason=yaw_reason,
        origin_m=(float(origin_m[0]), float(origin_m[1]), float(origin_m[2])),
        clock_offset_s=float(clock_offset_s or 0.0),
        clock_offset_sigma_s=clock_sigma_s,
        clock_reason=clock_reason,
        reference=reference,
        correlation=correlation,
        residual_rms_m=compared.rms_m if compared else None,
        warnings=(
            *_match_warnings(match, samples, yaw_sigma_deg),
            *_frame_warnings(match, compared, yaw_rad, yaw_deg == "auto"),
            *([] if match and match.better_frame else _height_warnings(flight, placed)),
            *_unix_warnings(flight, file, clock_offset_s),
        ),
    )
    return alignment, placed


def _figures(misfits_m: dict[str, float]) -> str:
    return ", ".join(f"{name} {misfit:.2f} m" for name, misfit in misfits_m.items())


def _frame_reason(option: str | None, named: str | None, match: _Match | None, auto: bool) -> str:
    if option:
        return "given with --position-frame"
    if named or match is None:
        return "from the names of the file's columns"
    reason = f"fits {match.reference.name} best; residuals: {_figures(match.misfits_m)}"
    if auto and match.frame == "enu":
        reason += "; nwu differs from enu only by the yaw, which was found"
    return reason


def _match_warnings(
    match: _Match | None, samples: pd.DataFrame, yaw_sigma_deg: float | None
) -> list[str]:
    """What is poorly determined."""
    if match is None:
        return []
    name, fit, peak = match.reference.name, match.clock, match.clock.peak
    warnings = []
    if peak.concordance < GOOD_CONCORDANCE[name]:
        warnings.append(
            f"The file follows the {name} only roughly (concordance {peak.concordance:.2f})."
        )
    if peak.rival_ratio < NEAR_RESIDUAL[name]:
        warnings.append(
            f"A clock offset {peak.rival_s:+.1f} s from this one fits nearly as well, with a "
            f"residual only {peak.rival_ratio:.1f} times as large: if this one is wrong, give "
            "--clock-offset SECONDS."
        )
    if fit.lag_sigma_s is not None:
        if fit.lag_sigma_s > LARGE_CLOCK_SIGMA_S:
            warnings.append(
                "The clock offset is poorly determined (standard deviation "
                f"{fit.lag_sigma_s:.2f} s)."
            )
        whole = min(
            float(samples.index[-1] - samples.index[0]), float(np.ptp(match.reference.time_s))
        )
        if fit.overlap_s < 0.5 * whole:
            warnings.append(
                f"Only {fit.overlap_s:.0f} s of the file overlap the {name}: if more should, "
                "give --clock-offset SECONDS."
            )
    if yaw_sigma_deg is not None and yaw_sigma_deg > LARGE_YAW_SIGMA_DEG:
        warnings.append(
            f"The yaw is poorly determined (standard deviation {yaw_sigma_deg:.1f}°): the flight "
            "is short, or nearly a point."
        )
    return warnings


def _height_warnings(flight: Flight, placed: pd.DataFrame) -> list[str]:
    """Whether the file's height runs against EKF2's: then its frame is another one."""
    if isinstance(flight.ekf2, Unavailable):
        return []
    down = flight.ekf2.state["down_m"]
    inside = placed[(placed.index >= down.index[0]) & (placed.index <= down.index[-1])]
    file_down = inside["down_m"].to_numpy()
    known = np.isfinite(file_down)
    if np.count_nonzero(known) < MIN_SAMPLES:
        return []
    ours = file_down[known]
    theirs = np.interp(inside.index[known], down.index, down)
    if min(np.ptp(np.percentile(ours, [2, 98])), np.ptp(theirs)) < MIN_MOTION_M:
        return []
    if np.corrcoef(ours, theirs)[0, 1] > -MIN_MIRRORED:
        return []
    return [
        "The file's height runs against EKF2's (one rises where the other sinks): its z points the "
        f"other way. Give another {FRAME_OPTION}."
    ]


def _unix_warnings(flight: Flight, file: PositionFile, clock_offset_s: float | None) -> list[str]:
    """Whether the file's UNIX clock is far from the log's: then it may be of another flight."""
    start_s = flight.log.start_unix_s
    if file.clock != "UNIX" or start_s is None or clock_offset_s is None:
        return []
    apart_s = flight.log.boot_time_s - clock_offset_s - start_s
    if abs(apart_s) < MAX_UNIX_DIFFERENCE_S:
        return []
    return [
        f"By their UNIX times file and log are {abs(apart_s):.0f} s apart: is it the same flight? "
        "Flights along one path match each other well."
    ]


def _frame_warnings(
    match: _Match | None, compared: _Comparison | None, yaw_rad: float, auto: bool
) -> list[str]:
    """Whether the file's frame is EKF2's, where it was not fitted to be, and where it cannot be."""
    if auto:
        imu = match is not None and match.reference.name == IMU
        return [
            "The IMU tells the yaw to a few degrees only (1° to 6° off on simulated flights), and "
            "not the origin of the file's frame, which was left at 0."
        ] * imu
    turned = match is not None and match.turned
    if match and compared:
        turned = _is_sound(match.free, EKF2_POSITION) and _is_turned(
            compared.capped_rms_m, match.free, EKF2_POSITION
        )
    if match and turned:
        yaw = np.degrees(np.angle(np.exp(1j * (match.free.yaw_rad - yaw_rad))))
        shift = np.hypot(*match.free.origin_m[:2])
        if match.better_frame:
            return [
                f"The file does not fit the {match.reference.name} as {match.frame}, but it does "
                f"as {match.better_frame}: give --position-frame {match.better_frame}."
            ]
        how = f" and shifted by {shift:.1f} m" if compared else ""
        return [
            f"The file's frame seems turned by {yaw:.1f}°{how} against the {match.reference.name}: "
            "give --position-yaw auto."
        ]
    lowest = MIN_CONCORDANCE[EKF2_POSITION]
    if compared and compared.correlation is not None and compared.correlation < lowest:
        return [
            f"The file hardly follows the EKF2 position (correlation {compared.correlation:.2f}): "
            "check clock offset, frame and yaw."
        ]
    return []
