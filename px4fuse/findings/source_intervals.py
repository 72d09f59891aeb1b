"""Detect gaps in the position source, positions lost in the recording, and downsampling."""

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.comparison.comparison import interpolate_sigma
from px4fuse.comparison.flight_events import compute_max_interval_s
from px4fuse.core.arrays import Array
from px4fuse.core.record import Span
from px4fuse.core.text import format_metres
from px4fuse.ekf2.aids import MAX_TIME_WITHOUT_FUSION_S
from px4fuse.ekf2.fusion_conditions import EV_START_INTERVAL_S
from px4fuse.filter.kalman import predict_state, predict_variance
from px4fuse.filter.signals import cut_to_segment
from px4fuse.finding import Finding
from px4fuse.findings.model import (
    Findings,
    find_source_texts,
    finding,
    format_percent,
    make_note,
    make_warning,
)
from px4fuse.flight.ekf2_parameters import AIDS, EV_POS, Aid
from px4fuse.flight.model import (
    ALIGNED_BY_EKF2_ORIGIN,
    Ekf2,
    Unavailable,
    positions_phrase,
    sample_step_function,
)
from px4fuse.readers.px4_ekf2 import OTHER_HORIZONTAL_AIDS

# Minimum fraction of lost positions for a finding: PX4 v1.14 and later loses 0.3 %
MIN_LOST_POSITION_FRACTION = 0.02
# Minimum number of intervals between positions to detect downsampling
MIN_INTERVAL_COUNT = 50
# Minimum fraction of missing positions to report downsampling: a radio link loses fewer
MIN_MISSING_FRACTION_FOR_DOWNSAMPLING = 0.25
# Minimum fraction of intervals that have one of two lengths (n or n + 1 source periods)
MIN_FRACTION_OF_BOTH_INTERVAL_LENGTHS = 0.85
# Minimum fraction of the rarer interval length
MIN_FRACTION_OF_RARER_INTERVAL_LENGTH = 0.1
# Maximum RMS deviation of intervals from multiples of the period (jitter: 0.03, random: 0.29)
MAX_ROUNDING_RMS_ERROR = 0.06
# Tested source periods: median interval ÷ 1, 2, ... up to this number
MAX_PERIODS_IN_MEDIAN_INTERVAL = 4
# Minimum gap (s) at take-off or landing: the land detector is seconds late
MIN_GAP_AT_START_OR_END_S = 3.0
# KF's predicted state is read this time (s) before the update
TIME_BEFORE_UPDATE_S = 1e-6


def detect(analysis: Analysis) -> Findings:
    yield from detect_source_gaps(analysis)
    yield from detect_lost_samples(analysis)
    yield from detect_downsampling(analysis)


def detect_source_gaps(analysis: Analysis) -> Findings:
    """Detect gaps in the position source."""
    flight, source, ekf2 = analysis.segment.whole_flight, analysis.source, analysis.flight.ekf2
    gap_spans, gap_spans_only_in_log = list[Span](), list[Span]()
    invalid_times_s = analysis.source.invalid_reasons.index
    for gap in analysis.events.gaps:
        if np.any((invalid_times_s > gap[0]) & (invalid_times_s < gap[1])):
            continue  # source_values.py reports these invalid positions
        aids = _find_fused_aids(ekf2, gap)
        if source.origin.aid in aids and source.alignment is None:
            gap_spans_only_in_log.append(gap)
        elif gap[0] == flight.start_s or gap[1] == flight.end_s:
            if gap[1] - gap[0] > MIN_GAP_AT_START_OR_END_S:
                yield _make_stop_or_begin_finding(analysis, gap, aids)
        else:
            gap_spans.append(gap)
    positions_text = positions_phrase(source)
    if gap_spans_only_in_log:
        start_s, end_s, gap_count_text = _find_longest_gap(gap_spans_only_in_log)
        yield make_warning(
            "source_gap_in_log",
            f"{positions_text} are missing in the log for {end_s - start_s:.1f} s{gap_count_text}, "
            "but EKF2 fused them. The source did not stop; KF has no measurement in this time.",
            _find_remedy_for_unlogged_positions(analysis, start_s, end_s),
            {"count": len(gap_spans_only_in_log), "longest_s": end_s - start_s, "at_s": start_s},
            tuple(gap_spans_only_in_log),
        )
    if gap_spans:
        start_s, end_s, gap_count_text = _find_longest_gap(gap_spans)
        yield make_warning(
            "source_gap",
            f"No position for {end_s - start_s:.1f} s{gap_count_text}. "
            f"{describe_errors_after_gap(analysis, (start_s, end_s))}",
            f"{find_source_texts(source).data_link_check} at {start_s:.1f} s.",
            {"count": len(gap_spans), "longest_s": end_s - start_s, "at_s": start_s},
            tuple(gap_spans),
        )


def _find_longest_gap(gaps: list[Span]) -> tuple[float, float, str]:
    start_s, end_s = max(gaps, key=lambda gap: gap[1] - gap[0])
    return start_s, end_s, "" if len(gaps) == 1 else f", the longest of {len(gaps)} gaps"


def _find_remedy_for_unlogged_positions(analysis: Analysis, start_s: float, end_s: float) -> str:
    for track in analysis.flight.positions:
        if track.origin.aid == analysis.source.origin.aid and len(track.samples[start_s:end_s]) > 2:
            return f"Run again with --position-source {track.name}, which contains these positions."
    if analysis.flight.log.dropouts:
        return "Use a faster SD card, or log fewer topics (SDLOG_PROFILE)."
    return "Log fewer topics (SDLOG_PROFILE)."


def _make_stop_or_begin_finding(analysis: Analysis, span_s: Span, fused_aids: list[Aid]) -> Finding:
    (start_s, end_s), source = span_s, analysis.source
    is_source_stop = end_s == analysis.segment.whole_flight.end_s
    event_verb, start_or_stop_s, before_or_after = (
        ("stop", start_s, "after") if is_source_stop else ("begin", end_s, "before")
    )
    action = "" if is_source_stop or source.alignment else " Take off only when positions arrive."
    ekf2_errors_at_end, duration_s = _find_ekf2_errors_at_end(analysis, span_s), end_s - start_s
    time_text = f"{duration_s:.1f} s {'before the end' if is_source_stop else 'after the start'}"
    effect_sentence = ""
    if "error_m" in ekf2_errors_at_end:
        error_text = format_metres(ekf2_errors_at_end["error_m"])
        effect_sentence = f"EKF2's position error at the end of this time is {error_text} m. "
    elif "sigma_m" in ekf2_errors_at_end:
        sigma_text = format_metres(ekf2_errors_at_end["sigma_m"])
        effect_sentence = f"EKF2's reported σ at the end of this time is {sigma_text} m. "
    has_aids, aiding_sentence = _has_aiding_sources(analysis.flight.ekf2), ""
    if has_aids:
        labels = [aid.label for aid in fused_aids] or ["the IMU alone (dead reckoning)"]
        aiding_sentence = f"For {duration_s:.1f} s EKF2 relied on {' and '.join(labels)}. "
    return finding(
        "error"
        if has_aids and not fused_aids and duration_s > MAX_TIME_WITHOUT_FUSION_S
        else "warning",
        "source_stops" if is_source_stop else "source_begins",
        f"{positions_phrase(source)} {event_verb} in flight at {start_or_stop_s:.1f} "
        f"s, {time_text}. {aiding_sentence}{effect_sentence}px4fuse evaluates KF and EKF2 only "
        "while positions "
        "arrive.",
        f"{find_source_texts(source).data_link_check} {before_or_after} {start_or_stop_s:.1f} "
        f"s.{action}",
        {"at_s": start_or_stop_s, "duration_s": duration_s, **ekf2_errors_at_end},
        (span_s,),
    )


def _find_ekf2_errors_at_end(analysis: Analysis, span_s: Span) -> dict[str, float]:
    """Return EKF2's horizontal position error and reported σ (m) at the end of a time span."""
    axes = [analysis.axes[name] for name in ("north", "east") if name in analysis.axes]
    squared_errors_m2 = []
    for result in axes if len(axes) == 2 else [analysis.main]:
        tracks = result.with_whole_flight_tracks()
        if isinstance(tracks.ekf2_state, Unavailable):
            return {}
        position_m = tracks.ekf2_state["position_m"].loc[slice(*span_s)]
        time_s, true_position_m = position_m.index.to_numpy(), np.full(len(position_m), np.nan)
        if isinstance(tracks.truth, pd.DataFrame):
            true_positions = tracks.truth["position_m"]
            true_position_m = np.interp(
                time_s, true_positions.index, true_positions, np.nan, np.nan
            )
        sigma_m = interpolate_sigma(time_s, tracks.ekf2_variance, "position_variance_m2")
        squared_errors_m2.append([(position_m - true_position_m) ** 2, sigma_m**2])
    quantities_and_square_sums = zip(
        ("error_m", "sigma_m"), np.sum(squared_errors_m2, axis=0), strict=True
    )
    return {
        name: float(np.sqrt(values[np.isfinite(values)][-1]))
        for name, values in quantities_and_square_sums
        if np.isfinite(values).any()
    }


def describe_errors_after_gap(analysis: Analysis, gap_span_s: Span) -> str:
    """Describe the position errors of KF and EKF2 at the end of a gap."""
    result, (start_s, end_s) = analysis.main, gap_span_s
    start_and_end_times_s = np.array([start_s, end_s - TIME_BEFORE_UPDATE_S])
    axis, ekf2_state = result.axis, result.ekf2_state
    reference_m = float(axis.measurement_m[np.searchsorted(axis.measurement_time_s, end_s)])
    quantity = "Distance from estimate to first position after the gap"
    if isinstance(result.truth, pd.DataFrame):
        true_positions_m = result.truth["position_m"]
        reference_m, quantity = (
            float(np.interp(end_s, true_positions_m.index, true_positions_m)),
            "Position error at the end of the gap",
        )
    error_texts = []
    aiding_sentence = "In the gap KF relies on the IMU alone."
    if isinstance(ekf2_state, pd.DataFrame) and len(
        positions_before := ekf2_state["position_m"].loc[:end_s]
    ):
        if _has_aiding_sources(analysis.flight.ekf2):
            aiding_sentence = "In the gap KF and EKF2 rely on the IMU alone."
        if other_aids := _find_fused_aids(analysis.flight.ekf2, gap_span_s):
            aid_labels_text = " and ".join(aid.label for aid in other_aids)
            aiding_sentence = (
                f"In the gap KF relies on the IMU alone. EKF2 also relies on {aid_labels_text}."
            )
        variance, state_time_s = result.ekf2_variance, float(positions_before.index[-1])
        sigma_text = ""
        if isinstance(variance, pd.DataFrame) and len(variance):
            variance_m2 = np.interp(state_time_s, variance.index, variance["position_variance_m2"])
            sigma_text = f" (σ {format_metres(float(np.sqrt(variance_m2)))} m)"
        error_m = abs(float(positions_before.iloc[-1]) - reference_m)
        error_texts.append(f"EKF2 {format_metres(error_m)} m{sigma_text}")
    kf_error_m = abs(float(predict_state(result.replay, start_and_end_times_s)[0][1]) - reference_m)
    kf_sigma_m = float(np.sqrt(predict_variance(result.replay, start_and_end_times_s)[0][1]))
    error_texts.append(f"KF {format_metres(kf_error_m)} m (σ {format_metres(kf_sigma_m)} m)")
    return f"{aiding_sentence} {quantity} along {axis.label}: {', '.join(error_texts)}."


def _has_aiding_sources(ekf2: Ekf2 | Unavailable) -> bool:
    return isinstance(ekf2, Ekf2) and bool(ekf2.aids)


def _find_fused_aids(ekf2: Ekf2 | Unavailable, span_s: Span) -> list[Aid]:
    """Return the horizontal aiding sources that EKF2 fused during a whole time span."""
    aids, (start_s, end_s) = list[Aid](), span_s
    for name in (EV_POS.name, *OTHER_HORIZONTAL_AIDS):
        aid_log = None if isinstance(ekf2, Unavailable) else ekf2.aids.get(name)
        if aid_log is None:
            continue
        samples = aid_log.samples.loc[start_s:end_s]
        is_fused = np.zeros(len(samples), bool)
        if "fused" in samples:
            is_fused = samples["fused"].to_numpy() > 0.0
        elif aid_log.enabled is not None:
            is_fused = sample_step_function(aid_log.enabled, samples.index) > 0.0
        times_s = [start_s, *samples.index[is_fused], end_s]
        if np.diff(times_s).max() < 0.5 * (end_s - start_s):
            aids.append(AIDS[name])
    return aids


def detect_lost_samples(analysis: Analysis) -> Findings:
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
    if len(intervals_s) > 1 and lost_count / sent_count > MIN_LOST_POSITION_FRACTION:
        action = "Record on the companion computer or on a link without message loss."
        if analysis.flight.log.writes_ulog:
            action += " Or set SDLOG_PROFILE to 129: the ULog then contains the received positions."
        yield make_note(
            "source_samples_lost",
            f"The recording lacks {format_percent(lost_count / sent_count)} of the "
            f"{positions_phrase(source)}. {lost_count} of {sent_count} positions are missing (one "
            f"per {median_interval_s:.2f} s is expected). EKF2 may have received them.",
            action,
            {"lost": lost_count, "lost_fraction": lost_count / sent_count},
        )


def detect_downsampling(analysis: Analysis) -> Findings:
    """Detect positions that were downsampled before PX4 received them."""
    source = analysis.source
    # The timestamps must be the times at which PX4 received the positions
    if (
        source.clock_map is not None
        or source.origin.find_preference_rank() >= ALIGNED_BY_EKF2_ORIGIN.find_preference_rank()
    ):
        return
    intervals_s, _ = _compute_intervals_s(analysis)
    if (
        len(intervals_s) < MIN_INTERVAL_COUNT
        or (period_and_multiples := _find_period(intervals_s)) is None
    ):
        return
    period_s, periods_in_intervals = period_and_multiples
    lost_fraction = 1.0 - 1.0 / float(np.mean(periods_in_intervals))
    fraction_by_interval_length = np.bincount(periods_in_intervals.astype(np.intp)) / len(
        periods_in_intervals
    )
    fraction_by_pair_of_lengths = fraction_by_interval_length[:-1] + fraction_by_interval_length[1:]
    periods_in_shorter_interval = int(np.argmax(fraction_by_pair_of_lengths))
    has_two_interval_lengths = (
        fraction_by_pair_of_lengths[periods_in_shorter_interval]
        >= MIN_FRACTION_OF_BOTH_INTERVAL_LENGTHS
        and fraction_by_interval_length[
            periods_in_shorter_interval : periods_in_shorter_interval + 2
        ].min()
        >= MIN_FRACTION_OF_RARER_INTERVAL_LENGTH
    )
    if lost_fraction < MIN_MISSING_FRACTION_FOR_DOWNSAMPLING or not has_two_interval_lengths:
        return
    mean_interval_s = float(np.mean(intervals_s))
    is_too_slow = mean_interval_s > EV_START_INTERVAL_S
    message = (
        f"{positions_phrase(source)} arrive at {1.0 / mean_interval_s:.2g} Hz, "
        f"downsampled from {1.0 / period_s:.2g} Hz. The intervals are whole multiples of "
        f"{period_s:.3g} s, so {format_percent(lost_fraction)} of the positions are missing."
    )
    if is_too_slow:
        message += (
            " EKF2 (v1.14 and later) cannot start fusion at this rate: two positions must arrive "
            f"within {EV_START_INTERVAL_S:g} s."
        )
    yield finding(
        "error" if is_too_slow else "warning",
        "source_downsampled",
        message,
        "Increase the message rate of the positions (MAVROS, bridge, link), and remove any rate "
        "limit.",
        {
            "rate_hz": 1.0 / mean_interval_s,
            "source_rate_hz": 1.0 / period_s,
            "lost_fraction": lost_fraction,
        },
    )


def _compute_intervals_s(analysis: Analysis) -> tuple[Array, float]:
    intervals_s = np.diff(
        cut_to_segment(analysis.source.samples, analysis.segment).index.to_numpy()
    )
    median_interval_s = float(np.median(intervals_s)) if len(intervals_s) else np.nan
    return intervals_s[intervals_s <= compute_max_interval_s(median_interval_s)], median_interval_s


def _find_period(intervals_s: Array) -> tuple[float, Array] | None:
    """Return the period (s) of the source, and the number of periods in each interval."""
    # The upper median is one of the intervals; numpy.median may be the mean of two
    median_interval_s = float(np.sort(intervals_s)[len(intervals_s) // 2])
    for median_count in range(1, MAX_PERIODS_IN_MEDIAN_INTERVAL + 1):
        periods_in_intervals = np.rint(intervals_s * median_count / median_interval_s)
        if np.any(periods_in_intervals < 1.0):
            continue
        period_s = float(np.sum(intervals_s) / np.sum(periods_in_intervals))
        if (
            float(np.sqrt(np.mean((intervals_s / period_s - periods_in_intervals) ** 2)))
            <= MAX_ROUNDING_RMS_ERROR
        ):
            return period_s, periods_in_intervals
    return None
