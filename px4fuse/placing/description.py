"""What was found of a position file's clock and frame, with reasons and warnings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
import pandas as pd

from px4fuse.flight import Alignment, Flight, Unavailable
from px4fuse.placing.fitting import MIN_CONCORDANCE, capped_rms
from px4fuse.placing.matching import GOOD_CONCORDANCE, Match, is_sound, is_turned, residual_words
from px4fuse.placing.tracks import (
    EKF2_POSITION,
    IMU,
    MIN_MOTION_M,
    MIN_SAMPLES,
    NoMatchError,
    continuous_track,
    placed_samples,
)

if TYPE_CHECKING:
    from px4fuse.readers.position_csv import PositionRecording

# Another lag whose residual is not larger by this factor can hardly be told apart
NEAR_RESIDUAL = {EKF2_POSITION: 2.0, IMU: 1.4}  # the IMU's own noise leaves 1.4 to 1.7
LARGE_CLOCK_SIGMA_S = 0.1
LARGE_YAW_SIGMA_DEG = 2.0
MIN_MIRRORED = 0.8  # correlation of the heights below minus which they run against each other
MAX_UNIX_DIFFERENCE_S = 60.0  # computers in a lab keep time better than this


def describe(
    flight: Flight,
    file: PositionRecording,
    samples: pd.DataFrame,
    match: Match | None,
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
    placed = placed_samples(samples, frame, yaw_rad, origin_m, lag_s)
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
        ekf2, known = continuous_track(flight.ekf2, placed).at(placed.index.to_numpy())
    except NoMatchError:
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
        capped_rms_m=capped_rms(distance) / np.sqrt(2.0),
        correlation=float(np.vdot(ours, theirs).real) / power if moves and power > 0.0 else None,
    )


def _frame_reason(option: str | None, named: str | None, match: Match | None, auto: bool) -> str:
    if option:
        return "given with --position-frame"
    if named or match is None:
        return "from the names of the file's columns"
    reason = f"fits {match.reference.name} best; residuals: {residual_words(match.misfits_m)}"
    if auto and match.frame == "enu":
        reason += "; nwu differs from enu only by the yaw, which was found"
    return reason


def _match_warnings(
    match: Match | None, samples: pd.DataFrame, yaw_sigma_deg: float | None
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
        "other way. Give another --position-frame."
    ]


def _unix_warnings(
    flight: Flight, file: PositionRecording, clock_offset_s: float | None
) -> list[str]:
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
    match: Match | None, compared: _Comparison | None, yaw_rad: float, auto: bool
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
        turned = is_sound(match.free, EKF2_POSITION) and is_turned(
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
