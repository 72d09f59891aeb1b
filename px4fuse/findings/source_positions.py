"""Detect positions that are constant, low-pass filtered, jump or contain outliers.

A wrong scale factor, a wrong reported variance and too little motion are also detected.
"""

from dataclasses import asdict, replace

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import Comparison, select_north_and_east
from px4fuse.core.arrays import Array, rms
from px4fuse.core.text import format_factor, format_metres
from px4fuse.ekf2.fusion_conditions import find_constant_coordinates, is_height_only
from px4fuse.ekf2.replay import compute_rmse_to_truth
from px4fuse.filter.correlated_noise import SourceLowPass, TimeCorrelatedNoise
from px4fuse.filter.hypotheses import (
    OUTLIER_BURST_DURATION_S,
    OUTLIER_RETEST_DURATION_AFTER_JUMP_S,
)
from px4fuse.filter.time_offset import SourceTimeOffset
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning
from px4fuse.finding import Finding, Severity
from px4fuse.flight.ekf2_parameters import EV_POS
from px4fuse.flight.model import (
    Columns,
    Ekf2,
    PositionTrack,
    Truth,
    Unavailable,
    estimate_white_noise_m,
)

from .imu import MIN_IMU_RATE_HZ, is_rate_too_low
from .model import (
    CAUSE_KEY,
    NO_ESTIMATES_SENTENCE,
    REPORTED_VARIANCE_USED_BY_EKF2_CAUSE,
    RESET_TIME_KEY,
    VEHICLE_ON_GROUND_CAUSE,
    Findings,
    error_if,
    find_source_texts,
    finding,
    format_percent,
    make_error,
    make_note,
    make_warning,
    make_zero_length_spans,
)
from .source_stamps import detect_arrival_timestamps

# Minimum extent (m) of the positions of a moving vehicle (5th to 95th percentile)
MIN_MOTION_RANGE_M = 0.5
# Minimum extent of the positions (5th to 95th percentile) ÷ σ of the position noise. Without
# motion, Gaussian noise has an extent of 3.29 σ; 25 % is margin
MIN_MOTION_RANGE_TO_NOISE_RATIO = 1.25 * 3.29
# Minimum log likelihood ratio (nats) of the low-pass model to the white-noise model; unfiltered
# positions reach 2
MIN_LOW_PASS_LOG_LIKELIHOOD_RATIO_NATS = 6.0
# Minimum log likelihood ratio (nats) of the low-pass model to the model of time-correlated noise
MIN_LOW_PASS_TO_CORRELATED_NOISE_NATS = 1.0
# Lag of the low-pass filter that the source applies to its positions: px4fuse uses the lag
# estimated from the autocorrelation of the position errors. If it exceeds this multiple of the
# upper 95 % limit of the delay relative to the IMU, px4fuse uses the delay instead
MAX_ESTIMATED_LAG_TO_DELAY_RATIO = 4.0
# Minimum lag (s) of low-pass filtered positions for a warning; it causes a position error of 5 cm
# at 1 m/s
MIN_FILTER_LAG_S = 0.05
# Minimum lag (s) of low-pass filtered positions for severity "error"; it causes a position error of
# 10 cm at 1 m/s
MIN_FILTER_LAG_FOR_SEVERITY_ERROR_S = 0.10
# Minimum position jump (m) for a warning: twice the noise of a good UWB system (0.1 m)
MIN_JUMP_M = 0.2
# Minimum ratio of a position jump to the σ of time-correlated noise, for a warning
MIN_JUMP_SIGMAS = 5.0
# Minimum number of jumps with a change of reset_counter to report repeated jumps
MIN_JUMPS_WITH_RESET_COUNTER = 2
# Minimum number of jumps without a change of reset_counter to report repeated jumps
MIN_JUMPS_WITHOUT_RESET_COUNTER = 3
# Minimum position jump (m) without a change of reset_counter
MIN_JUMP_WITHOUT_RESET_COUNTER_M = 0.1
# Minimum ratio: jump without a change of reset_counter ÷ median position change
MIN_JUMP_TO_MEDIAN_CHANGE_RATIO = 8.0
# A jump is compared with the median of this number of position changes
JUMP_WINDOW_SAMPLES = 61
# Minimum number of position changes to detect repeated jumps
MIN_POSITIONS_FOR_JUMPS = 100
# Minimum time (s) and number of positions that a jump lasts: outliers go back to the track earlier
MIN_JUMP_DURATION_S, MIN_JUMP_DURATION_SAMPLES = 0.6, 9
# Maximum difference between a jump and the shift of the median position (after - before the jump),
# as fraction of the jump
MAX_MEDIAN_SHIFT_DEVIATION_FRACTION = 0.5
# Maximum ratio: interval before a jump ÷ median interval; longer intervals contain vehicle motion
MAX_JUMP_TO_MEDIAN_INTERVAL_RATIO = 1.5
# Positions alternate if at least this fraction of the jumps reverses the previous jump
MIN_OPPOSITE_JUMP_FRACTION = 0.7
# Maximum time (s) from a position jump to the reset of EKF2 that the jump causes
MAX_JUMP_TO_RESET_TIME_S = 5.0
# Maximum number of jumps whose times the finding states
MAX_LISTED_JUMPS = 8
# Maximum rounding difference (s) between the timestamps of a position and of its reset_counter
RESET_TIME_TOLERANCE_S = 1e-4
# Bit masks of EKF2_EV_CTRL: EKF2 fuses the horizontal position (bit 0) or the height (bit 1)
EV_CTRL_HORIZONTAL_MASK, EV_CTRL_HEIGHT_MASK = 1, 2
# Maximum time (s) between a jump and the increment of reset_counter: two intervals at 2 Hz
MAX_JUMP_TO_RESET_COUNTER_TIME_S = 1.0
# Minimum position jump (m) for severity "error": five times the noise of a good UWB system (0.1 m)
MIN_JUMP_FOR_SEVERITY_ERROR_M = 0.5
# Minimum scale factor error (measured ÷ true distance, minus 1) for a warning: flights without a
# fault reach 0.11
MIN_SCALE_ERROR_FOR_WARNING = 0.12
# Minimum scale factor error (measured ÷ true distance, minus 1), for severity "error": it causes an
# error of 1 m in a distance of 7 m
MIN_SCALE_ERROR_FOR_SEVERITY_ERROR = 0.15
# Minimum |scale factor error| ÷ σ of its estimate, for a finding: 0.3 % of position sources without
# a scale factor error exceed 3
MIN_SCALE_ERROR_TO_SIGMA_RATIO = 3.0
# Minimum fraction of outliers for a warning: normal noise has 0.02 % beyond 3.7 σ
MIN_OUTLIER_FRACTION = 0.005
# Minimum fraction of outliers, for severity "error": one outlier in 10 s at 5 Hz
MIN_OUTLIER_FRACTION_FOR_SEVERITY_ERROR = 0.02
# Minimum number of outliers for a finding
MIN_OUTLIERS = 3
# Minimum fraction of positions with logged innovations, to state the number of rejected outliers
MIN_LOGGED_POSITION_FRACTION = 0.75
# Warning if the variance reported by the position source is at least this factor too small or too
# large
MIN_VARIANCE_ERROR_FACTOR = 2.0
# Severity "error" if the variance reported by the position source is at least this factor too small
# or too large
MIN_VARIANCE_ERROR_FACTOR_FOR_SEVERITY_ERROR = 3.0


def detect(analysis: Analysis) -> Findings:
    """Yield the findings on position values, scale, reported variance and too little motion."""
    yield from detect_constant_coordinates(analysis)
    if is_height_only(analysis.source):
        return
    yield from detect_little_motion(analysis)
    yield from detect_repeated_jumps(analysis)
    yield from detect_jumps(analysis)
    yield from detect_outliers(analysis)
    # Not for odometry (with orientation), whose errors are correlated because of drift, and not for
    # positions that px4fuse reconstructs from EKF2's data
    if analysis.source.orientation is None and not analysis.source.origin.reconstructed:
        yield from detect_low_pass(analysis)
        yield from detect_scale_error(analysis)
        yield from detect_wrong_variance(analysis)


def find_low_pass(analysis: Analysis) -> SourceLowPass | None:
    """Return the low-pass filter of the position source; None if its positions are not filtered."""
    source, low_pass = analysis.source, analysis.source_low_pass
    time_offset = _find_valid_time_offset(analysis)
    # The method is not valid for odometry, whose errors are correlated because of drift
    if source.orientation is not None or source.origin.reconstructed or time_offset is None:
        return None
    # A low-pass filter must fit better than white noise, and have a relevant lag
    if (
        isinstance(low_pass, Unavailable)
        or low_pass.gain_nats < MIN_LOW_PASS_LOG_LIKELIHOOD_RATIO_NATS
        or low_pass.lag_s < MIN_FILTER_LAG_S
    ):
        return None
    correlated_noise = analysis.time_correlated_noise
    # Time-correlated noise also causes correlated position errors: report a low-pass filter only if
    # it fits better than time-correlated noise
    if (
        isinstance(correlated_noise, TimeCorrelatedNoise)
        and correlated_noise.low_pass_gain_nats < MIN_LOW_PASS_TO_CORRELATED_NOISE_NATS
    ):
        return None
    # At a high position rate, the lag estimated from the correlation of the noise is inaccurate:
    # use the measured delay relative to the IMU
    max_delay_s = -time_offset.interval_s[0]  # late timestamps have a negative offset
    max_lag_s = MAX_ESTIMATED_LAG_TO_DELAY_RATIO * max_delay_s
    if max_lag_s >= MIN_FILTER_LAG_S and low_pass.lag_s > max_lag_s:
        return replace(low_pass, lag_s=-time_offset.offset_s)
    return low_pass


def _find_valid_time_offset(analysis: Analysis) -> SourceTimeOffset | None:
    """Return the time offset, unless timestamps are arrival times."""
    if isinstance(analysis.time_offset, Unavailable) or any(detect_arrival_timestamps(analysis)):
        return None
    return analysis.time_offset


def detect_low_pass(analysis: Analysis) -> Findings:
    """Detect positions that the source low-pass filters, so that they lag."""
    low_pass = find_low_pass(analysis)
    if low_pass is not None:
        yield finding(
            error_if(low_pass.lag_s >= MIN_FILTER_LAG_FOR_SEVERITY_ERROR_S),
            "source_low_pass_filtered",
            f"{analysis.source.positions_text} are low-pass filtered and lag by "
            f"{low_pass.lag_s:.2f} s. The correlation of successive errors is "
            f"{low_pass.correlation:.1f}; the noise before filtering is {low_pass.sigma_z_m:.2g} "
            "m. KF and EKF2 lag, and their σ is too small.",
            f"{find_source_texts(analysis).low_pass_action} Do not change the timestamps: "
            "they are correct.",
            asdict(low_pass),
        )


def detect_jumps(analysis: Analysis) -> Findings:
    """Detect position jumps that the IMU does not measure."""
    systematic_errors = analysis.systematic_errors
    # Timestamps that change from arrival time to time of measurement resemble a position jump
    if isinstance(systematic_errors, Unavailable) or any(detect_arrival_timestamps(analysis)):
        return
    min_jump_m, correlated_noise = MIN_JUMP_M, analysis.time_correlated_noise
    if not isinstance(correlated_noise, Unavailable):
        # A smaller jump may be a change of the time-correlated noise
        min_jump_m = max(min_jump_m, MIN_JUMP_SIGMAS * correlated_noise.slow_m)
    jumps = [jump for jump in systematic_errors.jumps if jump.size_m >= min_jump_m]
    if not jumps:
        return
    largest_jump = max(jumps, key=lambda jump: jump.size_m)
    size_m, time_s = largest_jump.size_m, largest_jump.time_s
    sigma_m = max(step.sigma for step in largest_jump.step_m)
    source_texts = find_source_texts(analysis)
    cause = source_texts.jump_causes
    evidence = {"count": len(jumps), "size_m": size_m, "at_s": time_s, "sigma_m": sigma_m}
    nearest_reset_counter_time_s = min(
        analysis.source.reset_times_s, key=lambda at_s: abs(at_s - time_s), default=np.inf
    )
    if abs(nearest_reset_counter_time_s - time_s) < MAX_JUMP_TO_RESET_COUNTER_TIME_S:
        evidence[RESET_TIME_KEY] = float(nearest_reset_counter_time_s)
        cause = "The source announced the jump (reset_counter): it relocalised or set a new origin."
    jump_text = f"jump by {size_m:.2f} m"
    if len(jumps) > 1:
        jump_text = f"jump {len(jumps)} times, by up to {size_m:.2f} m"
    total_step_m = np.sum([[step.value for step in jump.step_m] for jump in jumps], axis=0)
    is_jump_sum_small = np.linalg.norm(total_step_m) < MIN_JUMP_M
    yield finding(
        error_if(size_m >= MIN_JUMP_FOR_SEVERITY_ERROR_M),
        "source_position_jump",
        f"{analysis.source.positions_text} {jump_text} at {time_s:.1f} s and "
        f"{'return afterwards' if is_jump_sum_small else 'stay there'}. The IMU shows no "
        f"such motion (95 % uncertainty ± {1.96 * sigma_m:.2f} m). {cause} KF and EKF2 follow the "
        "jump with consistent innovations.",
        f"{source_texts.jump_action} Analyse only the time before or after the jump (--start, "
        "--end).",
        evidence,
        make_zero_length_spans(jump.time_s for jump in jumps),
    )


def detect_constant_coordinates(analysis: Analysis) -> Findings:
    """Detect coordinates that the source does not measure: they are constant in the whole log.

    A single constant coordinate is reported, or at least x and y (source of the height only). The
    action is the value of EKF2_EV_CTRL with which EKF2 fuses no constant coordinate.
    """
    source, parameters = analysis.source, analysis.flight.log.parameters
    coordinates = find_constant_coordinates(source)
    is_single_coordinate = len(coordinates) == 1
    if not (is_single_coordinate or is_height_only(source)) or (
        is_single_coordinate and source.quantisation_step_m > 0.0
    ):
        return  # rounded positions may be constant although the vehicle moves
    median_m_by_coordinate = dict(
        zip("xyz", source.samples[Columns.POSITION].median().tolist(), strict=True)
    )
    # EKF2 fuses x and y together: if one of them is constant, it must fuse neither
    finding_id, fused_mask = "source_coordinate_constant", EV_CTRL_HEIGHT_MASK
    if coordinates == ["z"]:
        finding_id, fused_mask = "source_height_constant", EV_CTRL_HORIZONTAL_MASK
        make_finding, consequence = make_warning, "The height is not evaluated."
    elif coordinates == ["x", "y"]:
        make_finding, consequence = make_warning, "Only the height is evaluated."
    else:  # only x, only y, or all
        make_finding, consequence = make_error, NO_ESTIMATES_SENTENCE
        if "z" in coordinates:
            fused_mask = 0
    action, coordinates_text = "", " and ".join(coordinates)
    if EV_POS.switch in parameters:
        value = int(parameters[EV_POS.switch])
        unfused_mask = (EV_CTRL_HORIZONTAL_MASK | EV_CTRL_HEIGHT_MASK) & ~fused_mask
        if value & unfused_mask:  # a fused coordinate is constant
            action = f"Set {EV_POS.switch} to {value & ~unfused_mask | fused_mask}"
        else:
            action = f"Leave {EV_POS.switch} at {value}"
            if coordinates == ["z"]:
                make_finding = make_note
        action += f", so that EKF2 does not fuse {coordinates_text}. "
    values_text = ", ".join(f"{median_m_by_coordinate[each]:g}" for each in coordinates)
    yield make_finding(
        finding_id,
        f"The source {source.name} does not measure {coordinates_text} (constant: {values_text} "
        f"m). {consequence}",
        f"{action}Send NaN for a coordinate that is not measured.",
        {f"{each}_m": value for each, value in median_m_by_coordinate.items()},
    )


def detect_repeated_jumps(analysis: Analysis) -> Findings:
    """Detect repeated jumps: a source corrects its drift, or alternates between two positions."""
    times_s, jump_vectors_m, is_announced_by_source = _find_jumps(analysis)
    if len(times_s) < MIN_JUMPS_WITHOUT_RESET_COUNTER and not is_announced_by_source:
        return
    jump_sizes_m = np.linalg.norm(jump_vectors_m, axis=1)
    jump_times_text = ", ".join(f"{at_s:.1f}" for at_s in times_s[:MAX_LISTED_JUMPS])
    is_reversal = np.sum(jump_vectors_m[1:] * jump_vectors_m[:-1], axis=1) < 0.0
    if is_announced_by_source:
        counter_sentence = "The source increments reset_counter at each jump."
        cause_sentence = "The source (VIO or SLAM) drifts, and each jump corrects its drift."
    else:
        counter_sentence = "The source does not change reset_counter at the jumps."
        cause_sentence = find_source_texts(analysis).jump_causes
    ekf2 = analysis.flight.ekf2
    resets = ekf2.find_horizontal_resets() if isinstance(ekf2, Ekf2) else ()
    delays_s = (
        min((reset.time_s - at_s for reset in resets if reset.time_s > at_s), default=np.inf)
        for at_s in times_s
    )
    reset_sentence = ""
    if reset_delays_s := [delay for delay in delays_s if delay < MAX_JUMP_TO_RESET_TIME_S]:
        reset_sentence = (
            " EKF2 rejects the positions after a jump and resets its position "
            f"{np.median(reset_delays_s):.1f} s later."
        )
    action = "Improve the tracking of the source, or let it correct its drift in smaller steps."
    # Most jumps go back: the source alternates between two positions
    if is_reversal.mean() >= MIN_OPPOSITE_JUMP_FRACTION:
        cause_sentence = (
            "The source alternately sends the positions of two points of the vehicle, "
            f"{np.median(jump_sizes_m):.2f} m apart."
        )
        action = "Send the position of one point of the vehicle, for example of one tag."
    yield make_error(
        "source_relocalises",
        f"The source jumps {len(times_s)} times, by up to {jump_sizes_m.max():.2f} m. Times: "
        f"{jump_times_text} s, about every {np.median(np.diff(times_s)):.0f} s. "
        f"{counter_sentence} {cause_sentence}{reset_sentence}",
        f"{action} Analyse the time between two jumps (--start, --end).",
        {
            "count": len(times_s),
            "largest_m": float(jump_sizes_m.max()),
            "announced": is_announced_by_source,
        },
        make_zero_length_spans(times_s.tolist()),
    )


def _find_jumps(analysis: Analysis) -> tuple[Array, Array, bool]:
    """Return times (s) and steps (m) of jumps, and True if ``reset_counter`` announces them."""
    position_m = analysis.source_samples[Columns.POSITION[:2]].dropna()
    # A position change after a repeated position contains the motion of two intervals
    position_m = position_m[(position_m.diff() != 0.0).any(axis=1)]
    time_s = position_m.index.to_numpy()
    position_changes_m = np.diff(position_m.to_numpy(), axis=0)
    if len(position_changes_m) < MIN_POSITIONS_FOR_JUMPS:
        return time_s[:0], position_changes_m[:0], False
    # 1. Possible jumps: each position change except the first and the last, minus the mean of the
    # changes before and after, which is the motion of the vehicle. Possible jump k is the change
    # from position k + 1 to position k + 2
    jump_times_s = time_s[2:-1]
    jump_vectors_m = position_changes_m[1:-1] - 0.5 * (
        position_changes_m[:-2] + position_changes_m[2:]
    )
    jump_sizes_m = np.linalg.norm(jump_vectors_m, axis=1)
    # 2. Jumps that reset_counter announces; a single one is reported by detect_jumps
    reset_jumps = (
        np.searchsorted(time_s, analysis.source.reset_times_s - RESET_TIME_TOLERANCE_S) - 2
    )
    reset_jumps = reset_jumps[(reset_jumps >= 0) & (reset_jumps < len(jump_sizes_m))]
    reset_jumps = reset_jumps[jump_sizes_m[reset_jumps] >= MIN_JUMP_M]
    if len(reset_jumps) >= MIN_JUMPS_WITH_RESET_COUNTER:
        return jump_times_s[reset_jumps], jump_vectors_m[reset_jumps], True
    # 3. Without reset_counter: jumps much larger than the changes near them
    intervals_s = np.diff(time_s)[1:-1]
    median_interval_s = float(np.median(intervals_s))
    local_median_change_m = (
        pd.Series(jump_sizes_m).rolling(JUMP_WINDOW_SAMPLES, center=True, min_periods=1).median()
    )
    min_jump_sizes_m = np.maximum(
        MIN_JUMP_WITHOUT_RESET_COUNTER_M,
        MIN_JUMP_TO_MEDIAN_CHANGE_RATIO * local_median_change_m.to_numpy(),
    )
    is_jump = (jump_sizes_m > min_jump_sizes_m) & (
        intervals_s < MAX_JUMP_TO_MEDIAN_INTERVAL_RATIO * median_interval_s
    )
    # 4. An outlier is no jump: the positions return. The median position of a window after the
    # jump, minus that of a window before, must equal the jump plus the motion between the window
    # centres
    window_size = max(MIN_JUMP_DURATION_SAMPLES, round(MIN_JUMP_DURATION_S / median_interval_s))
    for jump in np.flatnonzero(is_jump):
        row = jump + 2  # the first position after the jump
        first_row, end_row = max(row - window_size, 0), row + window_size
        median_shift_m = (
            position_m.iloc[row:end_row].median()
            - position_m.iloc[first_row:row].median()
            - window_size * np.median(position_changes_m[first_row:end_row], axis=0)
        )
        is_jump[jump] = (
            np.linalg.norm(median_shift_m - jump_vectors_m[jump])
            < MAX_MEDIAN_SHIFT_DEVIATION_FRACTION * jump_sizes_m[jump]
        )
    return jump_times_s[is_jump], jump_vectors_m[is_jump], False


def detect_scale_error(analysis: Analysis) -> Findings:
    """Detect a scale factor error of the positions relative to the IMU."""
    imu, systematic_errors = analysis.flight.imu, analysis.systematic_errors
    if (
        isinstance(imu, Unavailable)
        or is_rate_too_low(imu, MIN_IMU_RATE_HZ)
        or analysis.source.origin.is_gnss  # GNSS has no scale factor error
        # With ground truth, source_errors.py detects the scale factor error
        or isinstance(analysis.flight.truth, Truth)
        or isinstance(systematic_errors, Unavailable)
        # The effects of a low-pass filter or of time-correlated noise resemble a scale factor error
        or find_low_pass(analysis) is not None
        or not isinstance(analysis.time_correlated_noise, Unavailable)
        or _find_valid_time_offset(analysis) is None
    ):
        return
    scale_error, sigma = systematic_errors.scale.value, systematic_errors.scale.sigma
    if abs(scale_error) >= max(MIN_SCALE_ERROR_FOR_WARNING, MIN_SCALE_ERROR_TO_SIGMA_RATIO * sigma):
        yield make_scale_finding(
            analysis.source,
            scale_error,
            sigma,
            f"the IMU (± {format_percent(1.96 * sigma)}, 95 %)",
            "Measure a known distance with the source. "
            f"{find_source_texts(analysis).scale_check}. If the distance is right, "
            "calibrate the accelerometers.",
        )


def make_scale_finding(
    source: PositionTrack, scale_error: float, sigma: float, reference: str, remedy: str
) -> Finding:
    """Make the finding on a scale factor error of the positions.

    ``reference`` is the data from which the scale is estimated, with the accuracy of the estimate,
    for example "the IMU (± 2 %, 95 %)".
    """
    return finding(
        error_if(abs(scale_error) >= MIN_SCALE_ERROR_FOR_SEVERITY_ERROR),
        "source_scale_error",
        f"{source.kind_name} distances are {format_percent(abs(scale_error))} too "
        f"{'long' if scale_error > 0.0 else 'short'}. The scale is estimated from {reference}. "
        "Innovations do not show a scale factor error.",
        remedy,
        {"scale": 1.0 + scale_error, "sigma": sigma},
    )


def detect_outliers(analysis: Analysis) -> Findings:
    """Detect more outliers than Gaussian noise causes."""
    axis_tuning = analysis.tuning.get(HORIZONTAL) or next(iter(analysis.tuning.values()), None)
    if not isinstance(axis_tuning, AxisTuning):
        return
    outlier_time_s, systematic_errors = axis_tuning.outlier_time_s, analysis.systematic_errors
    jumps = () if isinstance(systematic_errors, Unavailable) else systematic_errors.jumps
    for jump in jumps:  # detect_jumps reports outliers that belong to a jump
        is_near_jump = (outlier_time_s >= jump.time_s - OUTLIER_BURST_DURATION_S) & (
            outlier_time_s < jump.time_s + OUTLIER_RETEST_DURATION_AFTER_JUMP_S
        )
        outlier_time_s = outlier_time_s[~is_near_jump]
    outlier_count = len(outlier_time_s)
    outlier_fraction = outlier_count / axis_tuning.count
    if outlier_fraction < MIN_OUTLIER_FRACTION or outlier_count < MIN_OUTLIERS:
        return
    source_texts = find_source_texts(analysis)
    outlier_sizes_m, reference = compute_outlier_sizes_m(analysis, outlier_time_s)
    yield finding(
        error_if(outlier_fraction >= MIN_OUTLIER_FRACTION_FOR_SEVERITY_ERROR),
        "source_outliers",
        f"{outlier_count} of {axis_tuning.count} {analysis.source.positions_text} "
        f"({format_percent(outlier_fraction, 1)}) are outliers of up to "
        f"{format_metres(outlier_sizes_m.max())} m. Median distance of the outliers to "
        f"{reference}: {format_metres(float(np.median(outlier_sizes_m)))} m. "
        f"{source_texts.outlier_causes} KF follows each outlier."
        f"{_format_rejected_outliers(analysis, outlier_time_s)}",
        source_texts.outlier_action,
        {
            "count": outlier_count,
            "share": outlier_fraction,
            "first_s": float(outlier_time_s[0]),
            "max_m": float(outlier_sizes_m.max()),
        },
        make_zero_length_spans(outlier_time_s),
    )


def compute_outlier_sizes_m(analysis: Analysis, outlier_time_s: Array) -> tuple[Array, str]:
    """Return the horizontal distances (m) of outliers from a reference, and its name.

    The reference is ground truth or, without it, the previous and next positions.
    """
    reference, distances_m = "the previous and next positions", np.zeros(len(outlier_time_s))
    for result in select_north_and_east(analysis) or [analysis.main]:
        measured_m = pd.Series(result.axis.measurement_m, result.axis.measurement_time_s)
        reference_m = measured_m[~measured_m.index.isin(outlier_time_s)]
        if isinstance(result.truth, pd.DataFrame):
            reference, reference_m = "ground truth", result.truth["position_m"].dropna()
        outlier_m, expected_m = (
            np.interp(outlier_time_s, position_m.index, position_m)
            for position_m in (measured_m, reference_m)
        )
        distances_m = np.hypot(distances_m, outlier_m - expected_m)
    return distances_m, reference


def _format_rejected_outliers(analysis: Analysis, outlier_time_s: Array) -> str:
    """Format the number of outliers that EKF2's gate rejected; "" if the log does not show it."""
    innovations = analysis.main.ekf2_tracks.innovations
    position_count = len(analysis.main.axis.measurement_time_s)
    if (
        isinstance(innovations, Unavailable)
        or innovations["rejected"].isna().any()
        or len(innovations) < MIN_LOGGED_POSITION_FRACTION * position_count
    ):
        return ""
    rejection_times_s = innovations.index[innovations["rejected"] > 0.0].to_numpy()
    time_differences_s = np.abs(rejection_times_s - outlier_time_s[:, None])
    is_rejected = np.any(time_differences_s < 0.5 / analysis.source.compute_rate_hz(), axis=1)
    return f" EKF2's gate rejected {is_rejected.sum()} of the {len(is_rejected)} outliers."


def detect_wrong_variance(analysis: Analysis) -> Findings:
    """Detect a reported variance that differs from the estimated position noise."""
    source, axis_tuning = analysis.source, analysis.tuning.get(HORIZONTAL)
    if (
        isinstance(analysis.source_low_pass, Unavailable)
        or find_low_pass(analysis) is not None
        or not isinstance(axis_tuning, AxisTuning)
        or not source.origin.is_vision
    ):
        return
    reported_variance_m2 = analysis.source_samples[Columns.POSITION_VARIANCE[:2]].dropna()
    noise = axis_tuning.sigma_z
    noise_m, low, high = noise.value, noise.low, noise.high
    if reported_variance_m2.empty or noise_m is None or low is None or high is None:
        return
    reported_sigma_m = float(np.sqrt(reported_variance_m2.mean(axis=1)).mean())
    variance_ratio = (reported_sigma_m / noise_m) ** 2
    error_factor = max(variance_ratio, 1.0 / variance_ratio)
    if error_factor < MIN_VARIANCE_ERROR_FACTOR or low <= reported_sigma_m <= high:
        return
    # A large reported σ may be correct: it may include time-correlated errors, which the noise
    # estimate does not contain. So also compare a large σ with the errors against ground truth
    size_word, correlation_note = "small", ""
    if variance_ratio > 1.0:
        size_word, rmse_m = "large", _compute_rmse_per_axis_m(analysis)
        if rmse_m is None:
            correlation_note = (
                " The reported σ may include time-correlated errors, which innovations do not show."
            )
        elif reported_sigma_m**2 < MIN_VARIANCE_ERROR_FACTOR * rmse_m**2:
            return
    if analysis.flight.log.parameters.get("EKF2_EV_NOISE_MD") == 1:
        severity: Severity = "note"
        cause, effect = "", "EKF2 ignores reported variances (EKF2_EV_NOISE_MD 1)."
    else:
        severity = error_if(error_factor >= MIN_VARIANCE_ERROR_FACTOR_FOR_SEVERITY_ERROR)
        cause = REPORTED_VARIANCE_USED_BY_EKF2_CAUSE
        effect = (
            "EKF2 uses the larger of reported variance and EKF2_EVP_NOISE² (EKF2_EV_NOISE_MD 0)."
        )
    yield finding(
        severity,
        "source_reported_variance_wrong",
        f"The variance that {source.kind_name} reports is {format_factor(error_factor)} times "
        f"too {size_word}. The reported σ is {reported_sigma_m:.3g} m, the position noise "
        f"{noise_m:.3g} m (95 % {low:.3g} to {high:.3g} m). {effect}{correlation_note}",
        f"Report a variance of {noise_m**2:.2g} m² with each position.",
        {
            "reported_sigma_m": reported_sigma_m,
            "sigma_z_m": noise_m,
            "variance_factor": variance_ratio,
            CAUSE_KEY: cause,
        },
    )


def _compute_rmse_per_axis_m(analysis: Analysis) -> float | None:
    """Return the position RMSE (m) against ground truth per horizontal axis, if known."""
    rmses_m = [
        compute_rmse_to_truth(
            analysis.flight, axis.measurement_m, axis.direction, axis.measurement_time_s
        )
        for axis in (result.axis for result in select_north_and_east(analysis))
    ]
    return rms(np.array(rmses_m)) if rmses_m and None not in rmses_m else None


def compute_motion_range_m(comparison: Comparison) -> float:
    """Return the larger extent (m) of the positions, north or east, 5th to 95th percentile."""
    positions = comparison.source_samples[Columns.POSITION[:2]]
    low, high = positions.quantile([0.05, 0.95]).to_numpy()
    return float(np.max(high - low))


def has_little_motion(comparison: Comparison) -> bool:
    """Return True if the extent of the positions is small, or not larger than their noise."""
    positions = comparison.source_samples[Columns.POSITION[:2]].dropna()
    noise_m = estimate_white_noise_m(positions.to_numpy())
    return compute_motion_range_m(comparison) < max(
        MIN_MOTION_RANGE_M, MIN_MOTION_RANGE_TO_NOISE_RATIO * noise_m
    )


def detect_little_motion(analysis: Analysis) -> Findings:
    """Detect too little motion to estimate velocity, heading and time offset."""
    extent_m = compute_motion_range_m(analysis)
    if has_little_motion(analysis):
        yield make_warning(
            "no_motion",
            f"The vehicle moved only {extent_m:.2f} m horizontally (5th to 95th percentile). This "
            "motion is too small to estimate velocity, heading and time offset.",
            "Fly several passes back and forth over 5 m or more, with clear starts and stops.",
            {"range_m": extent_m}
            | ({CAUSE_KEY: VEHICLE_ON_GROUND_CAUSE} if analysis.flight.airborne == () else {}),
        )
