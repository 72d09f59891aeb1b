"""Position timestamps that are constant, or that are arrival times instead of measurement times."""

import math

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.core.arrays import rank_correlation
from px4fuse.core.text import format_metres
from px4fuse.ekf2.fusion_conditions import EFFECT_BY_UNUSABLE_TIMESTAMP, find_timestamp_action
from px4fuse.ekf2.intervals import MAX_DELAY_BEHIND_HORIZON_S
from px4fuse.flight.ekf2_parameters import EV_POS
from px4fuse.flight.model import (
    CLOCK_METHODS_WITHOUT_MEASUREMENT_TIMES,
    REPEATED_TIMESTAMPS_NOTE,
    ClockConversion,
    Ekf2,
    Unavailable,
)

from .model import (
    Findings,
    compute_flag_fraction,
    error_if,
    finding,
    format_percent,
    make_error,
    make_warning,
)

# Maximum jitter (s) of receive times without a finding; it causes a position error of 1 cm at 1 m/s
MAX_RECEIPT_JITTER_S = 0.010
# Maximum time (s) from the arrival timestamp of a position to its publication by PX4
MAX_ARRIVAL_TO_PUBLICATION_DELAY_S = 0.001
# Minimum reported latency (s, from measurement to arrival) if TIMESYNC converges in flight. At
# 1 m/s, 0.02 s is an error of 2 cm
MIN_LATENCY_S = 0.02
# Minimum latency (s) for severity "error", and minimum reported increase (s) of the latency in
# flight. At 1 m/s, 0.1 s is an error of 10 cm
MIN_LATENCY_FOR_SEVERITY_ERROR_S = 0.10
# Minimum rank correlation of latency with time, for a latency that grows in flight
MIN_CORRELATION_OF_LATENCY_WITH_TIME = 0.8
# Minimum fraction of positions that EKF2 drops because of their latency, for a finding
MIN_DROPPED_POSITION_FRACTION = 0.02
# Minimum number of positions before and after the convergence of TIMESYNC, to detect the
# convergence
MIN_POSITIONS_BEFORE_AND_AFTER_TIMESYNC = 10
# Minimum fraction of arrival times before TIMESYNC converges, and of measurement times afterwards,
# to detect the convergence. Without convergence: minimum fraction of arrival times in the flight
MIN_FRACTION_OF_EXPECTED_TIMESTAMP_KIND = 0.95
# Minimum mean number of positions in a burst (positions that arrive together)
MIN_BURST_POSITIONS = 2.5
# Minimum number of intervals longer than the mean interval, to report that positions arrive in
# bursts; fewer long intervals are gaps in the position source
MIN_BURST_COUNT = 20
# Maximum ratio for positions in bursts: duration of a burst ÷ pause before the next burst
MAX_BURST_TO_PAUSE_DURATION_RATIO = 0.3
ANSWER_TIMESYNC_ACTION = (
    "Let the companion computer answer TIMESYNC (MAVROS does by default; with pymavlink answer "
    "every request). Send positions only after 500 answers, which take 50 s at 10 Hz."
)


def detect(analysis: Analysis) -> Findings:
    """Yield the finding on position timestamps, depending on the clock of the source."""
    clock_map, positions_text = analysis.source.clock_map, analysis.source.positions_text
    if clock_map is None:
        yield from detect_arrival_timestamps(analysis)
        yield from detect_varying_latency(analysis)
    elif clock_map.note == REPEATED_TIMESTAMPS_NOTE and clock_map.distinct_stamps:
        yield from detect_repeated_timestamps(analysis, clock_map.pairs, clock_map.distinct_stamps)
    elif clock_map.clock in EFFECT_BY_UNUSABLE_TIMESTAMP:
        yield from detect_wrong_timestamp_unit_or_clock(analysis, clock_map.clock)
    elif clock_map.distinct_stamps is not None:
        yield from detect_constant_timestamps(positions_text, clock_map, clock_map.distinct_stamps)
    elif clock_map.method in CLOCK_METHODS_WITHOUT_MEASUREMENT_TIMES:
        kf_times_sentence = (
            f"KF uses the message timestamps, converted to boot time with the {clock_map.method}."
        )
        if clock_map.method == "arrival time":
            kf_times_sentence = "KF also uses arrival times: both tracks lag by the latency."
        yield make_warning(
            "companion_not_synchronised",
            f"The source of the {positions_text} never synchronised its clock (TIMESYNC). EKF2 "
            f"used arrival times as times of measurement. {kf_times_sentence}",
            ANSWER_TIMESYNC_ACTION,
            {"jitter_s": clock_map.jitter_s},
        )


def detect_bursts(analysis: Analysis) -> Findings:
    """Detect buffered positions that arrive in bursts and have arrival times as timestamps."""
    intervals_s = np.diff(analysis.source.samples.index.to_numpy())
    is_pause = intervals_s > intervals_s.mean()
    if np.count_nonzero(is_pause) < MIN_BURST_COUNT:
        return
    burst_size = 1.0 / float(is_pause.mean())
    pause_s = float(np.median(intervals_s[is_pause]))
    burst_duration_s = burst_size * np.median(intervals_s[~is_pause])
    if (
        burst_size < MIN_BURST_POSITIONS
        or burst_duration_s > MAX_BURST_TO_PAUSE_DURATION_RATIO * pause_s
    ):
        return
    yield make_error(
        "source_timestamp_jitter",
        f"The timestamps of the {analysis.source.positions_text} come in bursts of "
        f"{burst_size:.0f}, every {pause_s:.2g} s ({analysis.source.compute_rate_hz():.3g} Hz on "
        f"average). The positions were measured up to {pause_s:.2g} s earlier. At 1 m/s this is a "
        f"position error of up to {format_metres(pause_s)} m.",
        "Send each position at once, with its time of measurement.",
        {"burst_size": burst_size, "interval_s": pause_s},
    )


def detect_repeated_timestamps(
    analysis: Analysis, sample_count: int, distinct_count: int
) -> Findings:
    """Report a coarse clock: several of ``sample_count`` samples have the same timestamp."""
    resolution_s = float(np.median(np.diff(analysis.source.samples.index)))
    rate_hz = sample_count / (distinct_count * resolution_s)
    yield make_error(
        "source_timestamps_shared",
        f"The timestamps of the {analysis.source.positions_text} have a resolution of "
        f"{resolution_s:.3g} s. The {sample_count} samples ({rate_hz:.2g} Hz) have only "
        f"{distinct_count} different timestamps. px4fuse uses the first sample of each timestamp. "
        f"At 1 m/s the position error is up to {format_metres(resolution_s)} m.",
        "Send the time of measurement with a resolution of microseconds.",
        {"resolution_s": resolution_s, "samples": sample_count, "distinct": distinct_count},
    )


def detect_wrong_timestamp_unit_or_clock(analysis: Analysis, clock_name: str) -> Findings:
    """Report timestamps in a wrong unit or from another clock."""
    ekf2, fusion_sentence = analysis.flight.ekf2, ""
    if (
        isinstance(ekf2, Ekf2)
        and isinstance(ekf2.fusion_flags, pd.DataFrame)
        and not compute_flag_fraction(ekf2.fusion_flags["horizontal"], analysis.segment)
    ):
        fusion_sentence = (
            f"EKF2 never fused the positions. {EFFECT_BY_UNUSABLE_TIMESTAMP[clock_name]} "
        )
    yield make_error(
        "source_timestamp_unit",
        f"The timestamps of the {analysis.source.positions_text} are "
        f"{'0 in every message' if clock_name == '0' else f'in {clock_name}'}. PX4 expects "
        f"timestamp_sample in microseconds since the autopilot's boot. {fusion_sentence}px4fuse "
        "uses the arrival times, which are late by the latency.",
        find_timestamp_action(clock_name),
        {"clock": clock_name},
    )


def detect_constant_timestamps(
    positions_text: str, clock_map: ClockConversion, distinct_count: int
) -> Findings:
    """Report timestamps that hardly change, and the jitter of the receive times used instead."""
    yield make_error(
        "source_timestamps_constant",
        f"The timestamps of {clock_map.pairs} {positions_text} have only {distinct_count} "
        "distinct values. The time of measurement is unknown; px4fuse uses the receive time.",
        "Send the time of measurement (usec, time_usec) in microseconds, as a 64-bit integer.",
        {"stamps": clock_map.pairs, "distinct": distinct_count},
    )
    if (jitter_s := clock_map.jitter_s) > MAX_RECEIPT_JITTER_S:
        yield make_warning(
            "source_timestamp_jitter",
            f"The receive times of the {positions_text} jitter by {jitter_s * 1e3:.0f} ms (1 σ). "
            f"At 1 m/s this is a position error of {format_metres(jitter_s)} m.",
            "Send the time of measurement, and record on the computer that sends the positions.",
            {"jitter_s": jitter_s},
        )


def detect_arrival_timestamps(analysis: Analysis) -> Findings:
    """Detect timestamps that are arrival times instead of times of measurement.

    Without TIMESYNC, PX4 uses the arrival time as timestamp (Timesync.cpp).
    """
    position_age_s = _find_position_age_s(analysis)
    if position_age_s is None:
        return
    timesync_convergence = find_timesync_convergence(analysis)
    if timesync_convergence is not None:
        convergence_time_s, latency_s = timesync_convergence
        severity, airborne = (
            error_if(latency_s >= MIN_LATENCY_FOR_SEVERITY_ERROR_S),
            analysis.flight.airborne,
        )
        if not isinstance(airborne, Unavailable) and all(
            start >= convergence_time_s for start, _ in airborne
        ):
            severity = "note"
        yield finding(
            severity,
            "source_timestamps_are_arrival_times",
            f"Position timestamps are arrival times until {convergence_time_s:.1f} s, when "
            "TIMESYNC converged (PX4 needs 500 answers). Later timestamps are times of "
            f"measurement, {latency_s:.3f} s before arrival. One time offset cannot correct the "
            "whole flight.",
            "Let the clocks synchronise for one minute before take-off. Analyse only the time "
            f"after the synchronisation (--start {math.ceil(convergence_time_s)}).",
            {"until_s": convergence_time_s, "latency_s": latency_s},
            ((float(position_age_s.index[0]), convergence_time_s),),
        )
    elif (
        np.mean(position_age_s.abs() < MAX_ARRIVAL_TO_PUBLICATION_DELAY_S)
        >= MIN_FRACTION_OF_EXPECTED_TIMESTAMP_KIND
    ):
        yield make_warning(
            "source_timestamps_are_arrival_times",
            "Position timestamps are arrival times in the whole flight. The source was never "
            "synchronised with the autopilot (TIMESYNC), so position timestamps are late by the "
            "latency.",
            ANSWER_TIMESYNC_ACTION,
            {"until_s": float(position_age_s.index[-1])},
        )


def detect_varying_latency(analysis: Analysis) -> Findings:
    """Detect positions that arrive later and later, or too late for EKF2's buffer."""
    position_age_s = _find_position_age_s(analysis)
    if position_age_s is None or find_timesync_convergence(analysis) is not None:
        return
    # Median latency in the first and in the last tenth of the flight
    sample_count = max(MIN_POSITIONS_BEFORE_AND_AFTER_TIMESYNC, len(position_age_s) // 10)
    initial_latency_s, final_latency_s = (
        float(age_s.median())
        for age_s in (position_age_s.iloc[:sample_count], position_age_s.iloc[-sample_count:])
    )
    # EKF2 drops positions that are older than its buffer when they arrive
    ekf2, late_drop_sentence, dropped_fraction = analysis.flight.ekf2, "", 0.0
    if isinstance(ekf2, Ekf2) and isinstance(ekf2.horizon_s, float):
        delay_s = 1e-3 * analysis.flight.log.parameters.get(EV_POS.delay, 0.0)
        limit_s = ekf2.horizon_s + MAX_DELAY_BEHIND_HORIZON_S - delay_s
        dropped_fraction = float((position_age_s > limit_s).mean())
        late_drop_sentence = (
            f" EKF2 drops positions that arrive more than {limit_s:.2f} s after their timestamp: "
            f"{format_percent(dropped_fraction)} in this flight."
        )
    is_any_dropped = dropped_fraction > MIN_DROPPED_POSITION_FRACTION
    if (
        final_latency_s - initial_latency_s >= MIN_LATENCY_FOR_SEVERITY_ERROR_S
        and rank_correlation(position_age_s.index.to_numpy(), position_age_s.to_numpy())
        >= MIN_CORRELATION_OF_LATENCY_WITH_TIME
    ):
        change_verb, low_latency_s, high_latency_s = "grows", initial_latency_s, final_latency_s
    # If EKF2 drops only some positions, their latency varies. If EKF2 drops nearly all of them, the
    # latency is constant and too long, which is not reported here
    elif is_any_dropped and dropped_fraction < 1.0 - MIN_DROPPED_POSITION_FRACTION:
        change_verb = "varies"
        low_latency_s, high_latency_s = position_age_s.quantile([0.05, 0.95]).tolist()
    else:
        return
    yield finding(
        error_if(is_any_dropped),
        "source_latency_varies",
        f"The latency of the {analysis.source.positions_text} {change_verb} in flight from "
        f"{low_latency_s:.2f} s to {high_latency_s:.2f} s (time from measurement to arrival)."
        f"{late_drop_sentence}",
        "Find the queue that fills up: sender, bridge or link. Send fewer or smaller messages, and "
        "let the sender drop old positions.",
        {
            "start_s": low_latency_s,
            "end_s": high_latency_s,
            "dropped_fraction": dropped_fraction,
        },
    )


def find_timesync_convergence(analysis: Analysis) -> tuple[float, float] | None:
    """Find the time (s) at which TIMESYNC converged in flight, and the position latency (s)."""
    position_age_s = _find_position_age_s(analysis)
    if position_age_s is None:
        return None
    is_arrival_time = (position_age_s.abs() < MAX_ARRIVAL_TO_PUBLICATION_DELAY_S).to_numpy()
    # Before TIMESYNC converges, the timestamps are arrival times. Choose the time that has the most
    # arrival times before it and the fewest after it
    converged_index = int(np.argmax(np.cumsum(np.where(is_arrival_time, 1, -1)))) + 1
    is_arrival_time_before_convergence, is_arrival_time_after_convergence = np.split(
        is_arrival_time, [converged_index]
    )
    if (
        is_arrival_time.mean() >= MIN_FRACTION_OF_EXPECTED_TIMESTAMP_KIND
        or min(len(is_arrival_time_before_convergence), len(is_arrival_time_after_convergence))
        < MIN_POSITIONS_BEFORE_AND_AFTER_TIMESYNC
        or min(
            is_arrival_time_before_convergence.mean(),
            1.0 - is_arrival_time_after_convergence.mean(),
        )
        < MIN_FRACTION_OF_EXPECTED_TIMESTAMP_KIND
    ):
        return None
    latency_s = float(position_age_s.iloc[converged_index:].median())
    convergence_time_s = float(position_age_s.index[converged_index])
    return None if latency_s < MIN_LATENCY_S else (convergence_time_s, latency_s)


def _find_position_age_s(analysis: Analysis) -> pd.Series | None:
    """Return the age (s) of each position at its publication, if logged (timestamp_sample)."""
    ekf2, source, segment = analysis.flight.ekf2, analysis.source, analysis.segment
    if (
        isinstance(ekf2, Unavailable)
        or isinstance(ekf2.record, Unavailable)
        or source.origin.reconstructed
        or source.clock_map
    ):
        return None
    position_age_s = ekf2.record.vision_age_s.loc[segment.start_s : segment.end_s]
    is_long_enough = len(position_age_s) >= 2 * MIN_POSITIONS_BEFORE_AND_AFTER_TIMESYNC
    return position_age_s if is_long_enough else None
