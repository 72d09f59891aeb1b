"""Detect gaps in the position source, positions lost in the recording, and downsampling."""

from itertools import pairwise

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.comparison.comparison import interpolate_sigma
from px4fuse.comparison.flight_events import compute_max_interval_s
from px4fuse.comparison.model import select_north_and_east
from px4fuse.core.arrays import Array
from px4fuse.core.record import Span
from px4fuse.core.text import format_metres
from px4fuse.ekf2.aids import MAX_TIME_WITHOUT_FUSION_S
from px4fuse.ekf2.fusion_conditions import EV_START_INTERVAL_S
from px4fuse.filter.kalman import predict_track
from px4fuse.finding import Finding
from px4fuse.flight.ekf2_parameters import AIDS, EV_POS, Aid
from px4fuse.flight.model import (
    ALIGNED_BY_EKF2_ORIGIN,
    FASTER_LOGGING_ACTION,
    Ekf2,
    Unavailable,
    sample_step_function,
)
from px4fuse.readers.px4_ekf2 import OTHER_HORIZONTAL_AIDS

from .model import (
    Findings,
    error_if,
    find_source_texts,
    finding,
    format_percent,
    make_note,
    make_warning,
)

# Minimum fraction of lost positions for a finding: PX4 v1.14 and later loses 0.3 %
MIN_LOST_POSITION_FRACTION = 0.02
# Minimum number of intervals between positions to detect downsampling
MIN_INTERVALS_FOR_DOWNSAMPLING = 50
# Downsampling is reported only if at least this fraction of the positions is missing. A radio link
# loses a smaller fraction
MIN_MISSING_FRACTION_FOR_DOWNSAMPLING = 0.25
# Downsampling gives intervals between positions of two lengths: n or n + 1 periods of the source.
# Minimum fraction of intervals with these lengths, to report downsampling
MIN_FRACTION_OF_TWO_MOST_FREQUENT_INTERVALS = 0.85
# Downsampling gives intervals of two lengths: n or n + 1 periods of the source. Minimum fraction of
# intervals with the rarer of the two lengths, to report downsampling
MIN_FRACTION_OF_RARER_INTERVAL_LENGTH = 0.1
# Maximum RMS deviation of the intervals from multiples of a tested source period, as fraction of
# the period, to report downsampling. The deviation is 0.03 for intervals with jitter, and 0.29 for
# random intervals
MAX_RMS_ROUNDING_ERROR_IN_PERIODS = 0.06
# Maximum n: tested periods of a downsampled source are median interval ÷ n, with n = 1, 2, …
MAX_SOURCE_PERIODS_PER_MEDIAN_INTERVAL = 4
# Minimum duration (s) of a gap at the start or end of the flight: take-off and landing are detected
# some seconds late
MIN_GAP_AT_START_OR_END_S = 3.0
# Time (s) before an update at which KF's predicted state is read
TIME_BEFORE_UPDATE_S = 1e-6


def detect(analysis: Analysis) -> Findings:
    yield from detect_source_gaps(analysis)
    yield from detect_lost_samples(analysis)
    yield from detect_downsampling(analysis)


def detect_source_gaps(analysis: Analysis) -> Findings:
    """Detect gaps in the position source."""
    source, whole_flight = analysis.source, analysis.segment.whole_flight
    # Divide the gaps: missing only in the log, at start or end of the flight, or in flight
    gaps, gaps_only_in_log = list[Span](), list[Span]()
    invalid_times_s = source.invalid_reasons.index
    for start_s, end_s in analysis.events.gaps:
        if np.any((invalid_times_s > start_s) & (invalid_times_s < end_s)):
            continue  # source_values.py reports these invalid positions
        aids = _find_fused_aids(analysis.flight.ekf2, (start_s, end_s))
        # If EKF2 fused positions during the gap, they are only missing in the log. Positions from a
        # file (with an alignment) are not from the log: their gaps are real
        if source.origin.aid in aids and source.alignment is None:
            gaps_only_in_log.append((start_s, end_s))
        elif start_s != whole_flight.start_s and end_s != whole_flight.end_s:
            gaps.append((start_s, end_s))
        elif end_s - start_s > MIN_GAP_AT_START_OR_END_S:
            yield _make_source_stops_or_begins_finding(analysis, (start_s, end_s), aids)
    if gaps_only_in_log:
        span_s, duration_text, evidence = _summarise_gaps(gaps_only_in_log)
        yield make_warning(
            "source_gap_in_log",
            f"{source.positions_text} are missing in the log for {duration_text}, but EKF2 fused "
            "them. KF has no measurement in the gap.",
            _find_action_for_unlogged_positions(analysis, *span_s),
            evidence,
            tuple(gaps_only_in_log),
        )
    if gaps:
        span_s, duration_text, evidence = _summarise_gaps(gaps)
        yield make_warning(
            "source_gap",
            f"No position for {duration_text}. {describe_errors_after_gap(analysis, span_s)}",
            f"{find_source_texts(analysis).data_link_check} at {span_s[0]:.1f} s.",
            evidence,
            tuple(gaps),
        )


def _summarise_gaps(spans: list[Span]) -> tuple[Span, str, dict[str, float]]:
    """Return the longest gap (start, end), a text with its duration, and evidence for a finding."""
    start_s, end_s = max(spans, key=lambda span: span[1] - span[0])
    duration_text = f"{end_s - start_s:.1f} s"
    if len(spans) > 1:
        duration_text += f", the longest of {len(spans)} gaps"
    evidence = {"count": len(spans), "longest_s": end_s - start_s, "at_s": start_s}
    return (start_s, end_s), duration_text, evidence


def _find_action_for_unlogged_positions(analysis: Analysis, start_s: float, end_s: float) -> str:
    """Return the action for positions (from ``start_s`` to ``end_s``) that the log lacks."""
    for track in analysis.flight.positions:
        if track.origin.aid == analysis.source.origin.aid and len(track.samples[start_s:end_s]) > 2:
            return f"Run again with --position-source {track.name}, which contains these positions."
    if analysis.flight.log.dropouts:
        return FASTER_LOGGING_ACTION
    return "Log fewer topics (SDLOG_PROFILE)."


def _make_source_stops_or_begins_finding(
    analysis: Analysis, span_s: Span, fused_aids: list[Aid]
) -> Finding:
    """Make the finding on a gap at the start or end of the flight: positions begin late or stop."""
    (start_s, end_s), source = span_s, analysis.source
    duration_s, effect_sentence, action = end_s - start_s, "", ""
    if end_s == analysis.segment.whole_flight.end_s:
        finding_id, event, event_s = "source_stops", "stop", start_s
        before_or_after = "after"
    else:
        finding_id, event, event_s = "source_begins", "begin", end_s
        before_or_after = "before"
        action = "" if source.alignment else " Take off only when positions arrive."
    # Example: "UWB positions stop in flight at 60.0 s, so 20.0 s of the flight have no positions.
    # For 20.0 s EKF2 relied on the IMU alone (dead reckoning). EKF2's position error at 80.0 s is
    # 4.2 m."
    ekf2_errors_at_end = _find_ekf2_errors_at_end(analysis, span_s)
    quantity, value_m = "position error", ekf2_errors_at_end.get("error_m")
    if value_m is None:
        quantity, value_m = "reported σ", ekf2_errors_at_end.get("sigma_m")
    if value_m is not None:
        effect_sentence = f" EKF2's {quantity} at {end_s:.1f} s is {format_metres(value_m)} m."
    ekf2 = analysis.flight.ekf2
    has_aids = isinstance(ekf2, Ekf2) and bool(ekf2.aids)
    aiding_sentence = ""
    if has_aids:
        labels = [aid.label for aid in fused_aids] or ["the IMU alone (dead reckoning)"]
        aiding_sentence = f" For {duration_s:.1f} s EKF2 relied on {' and '.join(labels)}."
    is_dead_reckoning = has_aids and not fused_aids and duration_s > MAX_TIME_WITHOUT_FUSION_S
    return finding(
        error_if(is_dead_reckoning),
        finding_id,
        f"{source.positions_text} {event} in flight at {event_s:.1f} s, so {duration_s:.1f} s of "
        f"the flight have no positions.{aiding_sentence}{effect_sentence}",
        f"{find_source_texts(analysis).data_link_check} for the time {before_or_after} "
        f"{event_s:.1f} s.{action}",
        {"at_s": event_s, "duration_s": duration_s, **ekf2_errors_at_end},
        (span_s,),
    )


def _find_ekf2_errors_at_end(analysis: Analysis, span_s: Span) -> dict[str, float]:
    """Return EKF2's horizontal position error and reported σ (m) at the end of a time span.

    Unknown values are omitted. Without north and east, the values are along the main axis.
    """
    north_and_east = select_north_and_east(analysis)
    squared_errors_m2, variances_m2 = [], []
    for result in north_and_east if len(north_and_east) == 2 else [analysis.main]:
        ekf2, truth = result.whole_flight_tracks
        if isinstance(ekf2.state, Unavailable):
            return {}
        position_m = ekf2.state["position_m"].loc[slice(*span_s)]
        time_s, true_m = position_m.index.to_numpy(), np.full(len(position_m), np.nan)
        if isinstance(truth, pd.DataFrame):
            true_m = np.interp(time_s, truth.index, truth["position_m"], np.nan, np.nan)
        squared_errors_m2.append((position_m.to_numpy() - true_m) ** 2)
        variances_m2.append(interpolate_sigma(time_s, ekf2.variance, "position_variance_m2") ** 2)
    last_values_m = {}
    for name, squares_m2 in (("error_m", squared_errors_m2), ("sigma_m", variances_m2)):
        values_m = np.sqrt(np.sum(squares_m2, axis=0))
        known_values_m = values_m[np.isfinite(values_m)]
        if len(known_values_m):
            last_values_m[name] = float(known_values_m[-1])
    return last_values_m


def describe_errors_after_gap(analysis: Analysis, gap_span_s: Span) -> str:
    """Describe the position errors of KF and EKF2 at the end of a gap."""
    result, end_s = analysis.main, gap_span_s[1]
    axis, ekf2, ekf2_state = result.axis, analysis.flight.ekf2, result.ekf2_tracks.state
    # 1. Reference: ground truth or, without it, the first position after the gap
    if isinstance(result.truth, pd.DataFrame):
        true_m = result.truth["position_m"]
        reference_m = float(np.interp(end_s, true_m.index, true_m))
        quantity = "Position error at the end of the gap"
    else:
        reference_m = float(axis.measurement_m[np.searchsorted(axis.measurement_time_s, end_s)])
        quantity = "Distance from the estimated to the first measured position after the gap"
    # 2. EKF2: last logged position before the end of the gap
    ekf2_text, aiding_sentence = "", "In the gap KF relies on the IMU alone."
    if isinstance(ekf2_state, pd.DataFrame) and len(
        positions_before := ekf2_state["position_m"].loc[:end_s]
    ):
        if other_aids := _find_fused_aids(ekf2, gap_span_s):
            labels_text = " and ".join(aid.label for aid in other_aids)
            aiding_sentence += f" EKF2 also relies on {labels_text}."
        elif isinstance(ekf2, Ekf2) and ekf2.aids:  # the log shows which sources EKF2 fuses
            aiding_sentence = "In the gap KF and EKF2 rely on the IMU alone."
        ekf2_text = f"EKF2 {format_metres(abs(positions_before.iloc[-1] - reference_m))} m"
        variance = result.ekf2_tracks.variance
        if isinstance(variance, pd.DataFrame) and len(variance):
            variance_m2 = np.interp(
                positions_before.index[-1], variance.index, variance["position_variance_m2"]
            )
            ekf2_text += f" (σ {format_metres(variance_m2**0.5)} m)"
        ekf2_text += ", "
    # 3. The position at the end of the gap corrects KF: read the state before this update
    kf_track = predict_track(result.kf_run, np.array([end_s - TIME_BEFORE_UPDATE_S])).iloc[0]
    kf_error_m = abs(kf_track["position_m"] - reference_m)
    kf_sigma_m = kf_track["position_variance_m2"] ** 0.5
    return (
        f"{aiding_sentence} {quantity}, along {axis.label}: {ekf2_text}KF "
        f"{format_metres(kf_error_m)} m (σ {format_metres(kf_sigma_m)} m)."
    )


def _find_fused_aids(ekf2: Ekf2 | Unavailable, span_s: Span) -> list[Aid]:
    """Return the horizontal aiding sources that EKF2 fused during a whole time span."""
    aids, (start_s, end_s) = list[Aid](), span_s
    aid_logs = {} if isinstance(ekf2, Unavailable) else ekf2.aids
    for name in (EV_POS.name, *OTHER_HORIZONTAL_AIDS):
        if name not in aid_logs:
            continue
        samples, enabled = aid_logs[name].samples.loc[start_s:end_s], aid_logs[name].enabled
        is_fused = np.zeros(len(samples), bool)
        if "fused" in samples:
            is_fused = samples["fused"].to_numpy() > 0.0
        elif enabled is not None:
            is_fused = sample_step_function(enabled, samples.index) > 0.0
        # Fused during the whole span: no pause is as long as half of the span
        times_s = [start_s, *samples.index[is_fused], end_s]
        if np.diff(times_s).max() < 0.5 * (end_s - start_s):
            aids.append(AIDS[name])
    return aids


def detect_lost_samples(analysis: Analysis) -> Findings:
    """Detect gaps of single positions in a recording with the sender's timestamps."""
    source, clock_map = analysis.source, analysis.source.clock_map
    if (
        clock_map is None
        or clock_map.method == "arrival time"
        or clock_map.distinct_stamps is not None
    ):
        return
    intervals_s, median_interval_s = _compute_intervals_s(analysis)
    lost_count = int(np.sum(np.rint(intervals_s / median_interval_s) - 1.0))
    sent_count = lost_count + len(intervals_s)
    lost_fraction = lost_count / max(sent_count, 1)
    if len(intervals_s) > 1 and lost_fraction > MIN_LOST_POSITION_FRACTION:
        yield make_note(
            "source_samples_lost",
            f"The recording lacks {format_percent(lost_fraction)} of the "
            f"{source.positions_text}. {lost_count} of {sent_count} positions are missing (one "
            f"per {median_interval_s:.2f} s is expected). EKF2 may have received these samples.",
            "Record on the companion computer or on a link without message loss. Or set "
            "SDLOG_PROFILE to 129: the ULog then contains the received positions.",
            {"lost": lost_count, "lost_fraction": lost_fraction},
        )


def detect_downsampling(analysis: Analysis) -> Findings:
    """Detect positions that were downsampled before PX4 received them."""
    source = analysis.source
    # Intervals show downsampling only if the timestamps are the times at which PX4 received the
    # positions. Positions on the clock of their sender, positions from EKF2's topics and GNSS
    # positions have other timestamps
    if (
        source.clock_map is not None
        or source.origin.find_preference_rank() >= ALIGNED_BY_EKF2_ORIGIN.find_preference_rank()
    ):
        return
    intervals_s, _ = _compute_intervals_s(analysis)
    if len(intervals_s) < MIN_INTERVALS_FOR_DOWNSAMPLING:
        return
    period_and_multiples = _find_period(intervals_s)
    if period_and_multiples is None:
        return
    # Period of the source, and number of periods in each interval between received positions
    period_s, multiples = period_and_multiples
    lost_fraction = 1.0 - 1.0 / float(np.mean(multiples))
    # Downsampling to a constant rate gives intervals of two lengths: n and n + 1 periods of the
    # source. Randomly lost positions give many lengths, and a slower source gives only one
    fraction_by_multiple = np.bincount(multiples.astype(np.intp)) / len(multiples)
    # Find the two successive lengths (n and n + 1 periods) that are most frequent together.
    # pair_fractions are their fractions of all intervals
    pair_fractions = max(pairwise(fraction_by_multiple), key=sum)
    if (
        lost_fraction < MIN_MISSING_FRACTION_FOR_DOWNSAMPLING
        or sum(pair_fractions) < MIN_FRACTION_OF_TWO_MOST_FREQUENT_INTERVALS
        or min(pair_fractions) < MIN_FRACTION_OF_RARER_INTERVAL_LENGTH
    ):
        return
    mean_interval_s = float(np.mean(intervals_s))
    rate_hz, source_rate_hz = 1.0 / mean_interval_s, 1.0 / period_s
    is_too_slow_for_fusion = mean_interval_s > EV_START_INTERVAL_S
    message = (
        f"{source.positions_text} arrive at {rate_hz:.2g} Hz, downsampled from "
        f"{source_rate_hz:.2g} Hz. The intervals are whole multiples of {period_s:.3g} s, so "
        f"{format_percent(lost_fraction)} of the positions are missing."
    )
    if is_too_slow_for_fusion:
        message += (
            " EKF2 (v1.14 and later) cannot start fusion at this rate: two positions must arrive "
            f"within {EV_START_INTERVAL_S:g} s."
        )
    yield finding(
        error_if(is_too_slow_for_fusion),
        "source_downsampled",
        message,
        "Increase the message rate of the positions (MAVROS, bridge, link).",
        {"rate_hz": rate_hz, "source_rate_hz": source_rate_hz, "lost_fraction": lost_fraction},
    )


def _compute_intervals_s(analysis: Analysis) -> tuple[Array, float]:
    intervals_s = np.diff(analysis.source_samples.index.to_numpy())
    median_interval_s = float(np.median(intervals_s)) if len(intervals_s) else np.nan
    return intervals_s[intervals_s <= compute_max_interval_s(median_interval_s)], median_interval_s


def _find_period(intervals_s: Array) -> tuple[float, Array] | None:
    """Return the measurement period (s) of the source, and the intervals as multiples of it.

    ``intervals_s`` are the times between received positions. Return None if no period fits.
    """
    # The upper median is one of the intervals; numpy.median may be the mean of two
    median_interval_s = float(np.sort(intervals_s)[len(intervals_s) // 2])
    for median_count in range(1, MAX_SOURCE_PERIODS_PER_MEDIAN_INTERVAL + 1):
        multiples = np.rint(intervals_s * median_count / median_interval_s)
        if np.any(multiples < 1.0):
            continue
        period_s = float(np.sum(intervals_s) / np.sum(multiples))
        rounding_errors = intervals_s / period_s - multiples
        if np.mean(rounding_errors**2) ** 0.5 <= MAX_RMS_ROUNDING_ERROR_IN_PERIODS:
            return period_s, multiples
    return None
