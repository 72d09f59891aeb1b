"""Findings about gaps in the position source, lost positions, and a downsampled source."""

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.comparison.comparison import reported_sigma
from px4fuse.comparison.flight_events import max_interval_s
from px4fuse.core.arrays import Array
from px4fuse.core.record import Span
from px4fuse.core.text import format_metres
from px4fuse.ekf2.aids import MAX_NOT_FUSED_S
from px4fuse.ekf2.fusion_conditions import EV_START_INTERVAL_S
from px4fuse.filter.kalman import state_at, variance_at
from px4fuse.filter.signals import cut_to_segment
from px4fuse.finding import Finding
from px4fuse.findings.model import Findings, finding, format_percent, note, source_words, warning
from px4fuse.flight.ekf2_parameters import AIDS, EV_POS, Aid
from px4fuse.flight.model import Ekf2, Unavailable, positions_phrase, step_values_at
from px4fuse.flight.position_source import ALIGNED
from px4fuse.readers.px4_ekf2 import OTHER_HORIZONTAL_AIDS

# Minimum fraction of lost positions for a finding: PX4 v1.14 and later loses 0.3 %
MIN_LOST_FRACTION = 0.02
# Minimum number of intervals between positions for the detection of downsampling
MIN_INTERVALS = 50
# Minimum fraction of missing positions for downsampling: a radio link loses less
MIN_DOWNSAMPLED_FRACTION = 0.25
# Downsampling to a fixed rate (30 Hz to 20 Hz) alternates between two intervals (1 and 2 periods);
# lost messages do not. Minimum fraction of these two intervals
MIN_NEIGHBOURS_FRACTION = 0.85
# Minimum fraction of the less frequent one of the two intervals
MIN_MULTIPLE_FRACTION = 0.1
# Maximum RMS distance of intervals from whole periods, in periods: jitter causes 0.03, random
# intervals 0.29
MAX_MULTIPLE_RMS = 0.06
# Maximum tested number of periods in the median interval
MAX_DIVISOR = 4
# Minimum time (s) without positions at the start or end of the flight for a finding: the land
# detector is seconds late
MIN_PARTIAL_S = 3.0
# KF is evaluated this time (s) before a position, which is before its update
SMALLEST_TIME_S = 1e-6


def detect(analysis: Analysis) -> Findings:
    yield from detect_source_gaps(analysis)
    yield from detect_lost_samples(analysis)
    yield from detect_downsampling(analysis)


def detect_source_gaps(analysis: Analysis) -> Findings:
    """Detect times without positions."""
    flight, source, ekf2 = analysis.segment.flight, analysis.source, analysis.flight.ekf2
    spans, logged_spans = list[Span](), list[Span]()
    invalid_s = analysis.source.invalid.index
    for span in analysis.events.gaps:
        if np.any((invalid_s > span[0]) & (invalid_s < span[1])):
            continue  # source_values reports this gap
        aids = _continuously_fused_aids(ekf2, span)
        if source.origin.aid in aids and source.alignment is None:
            logged_spans.append(span)
        elif span[0] == flight.start_s or span[1] == flight.end_s:
            if span[1] - span[0] > MIN_PARTIAL_S:
                yield _partial_source(analysis, span, aids)
        else:
            spans.append(span)
    positions = positions_phrase(source)
    if logged_spans:
        start_s, end_s, longest = _longest(logged_spans)
        yield warning(
            "source_gap_in_log",
            f"{positions} are missing in the log for {end_s - start_s:.1f} s{longest}, but EKF2 "
            "fused them. The source did not stop; KF has no measurement in this time.",
            _logged_elsewhere(analysis, start_s, end_s),
            {"count": len(logged_spans), "longest_s": end_s - start_s, "at_s": start_s},
            tuple(logged_spans),
        )
    if spans:
        start_s, end_s, longest = _longest(spans)
        yield warning(
            "source_gap",
            f"No position for {end_s - start_s:.1f} s{longest}. "
            f"{state_errors_after(analysis, (start_s, end_s))}",
            f"Check {source_words(source).reception} at {start_s:.1f} s.",
            {"count": len(spans), "longest_s": end_s - start_s, "at_s": start_s},
            tuple(spans),
        )


def _longest(gaps: list[Span]) -> tuple[float, float, str]:
    start_s, end_s = max(gaps, key=lambda gap: gap[1] - gap[0])
    return start_s, end_s, "" if len(gaps) == 1 else f", the longest of {len(gaps)} gaps"


def _logged_elsewhere(analysis: Analysis, start_s: float, end_s: float) -> str:
    for track in analysis.flight.positions:
        if track.origin.aid == analysis.source.origin.aid and len(track.samples[start_s:end_s]) > 2:
            return f"Run again with --position-source {track.name}, which contains these positions."
    sd_card = "Use a faster SD card, or log" if analysis.flight.log.dropouts else "Log"
    return f"{sd_card} fewer topics (SDLOG_PROFILE)."


def _partial_source(analysis: Analysis, span_s: Span, aids: list[Aid]) -> Finding:
    (start_s, end_s), source = span_s, analysis.source
    stops = end_s == analysis.segment.flight.end_s
    event, at_s, before_or_after = (
        ("stop", start_s, "after") if stops else ("begin", end_s, "before")
    )
    action = "" if stops or source.alignment else " Take off only when positions arrive."
    at_end, duration_s = _ekf2_at_end(analysis, span_s), end_s - start_s
    later = f"after {duration_s:.1f} s" if stops else "just before the first position"
    effect_text = f", {duration_s:.1f} s {'before the end' if stops else 'after the start'}"
    if "error_m" in at_end:
        effect_text = f": EKF2's position error is {format_metres(at_end['error_m'])} m {later}"
    elif "sigma_m" in at_end:
        effect_text = f": EKF2's reported σ is {format_metres(at_end['sigma_m'])} m {later}"
    has_aids, aiding = _has_aids(analysis.flight.ekf2), ""
    if has_aids:
        labels = " and ".join(aid.label for aid in aids) or "the IMU alone (dead reckoning)"
        aiding = f"For {duration_s:.1f} s EKF2 relied on {labels}. "
    return finding(
        "error" if has_aids and not aids and duration_s > MAX_NOT_FUSED_S else "warning",
        "source_stops" if stops else "source_begins",
        f"{positions_phrase(source)} {event} in flight at {at_s:.1f} s{effect_text}. "
        f"{aiding}KF, RMSE and verdicts do not include this time.",
        f"Check {source_words(source).reception} {before_or_after} {at_s:.1f} s.{action}",
        {"at_s": at_s, "duration_s": duration_s, **at_end},
        (span_s,),
    )


def _ekf2_at_end(analysis: Analysis, span_s: Span) -> dict[str, float]:
    """Return EKF2's horizontal error and reported σ (m) at the end of a time span, if known."""
    axes = [analysis.axes[name] for name in ("north", "east") if name in analysis.axes]
    squares_m2 = []
    for result in axes if len(axes) == 2 else [analysis.main]:
        tracks = result.in_flight
        if isinstance(tracks.ekf2_state, Unavailable):
            return {}
        position_m = tracks.ekf2_state["position_m"].loc[slice(*span_s)]
        time_s, true_m = position_m.index.to_numpy(), np.full(len(position_m), np.nan)
        if isinstance(tracks.truth, pd.DataFrame):
            true = tracks.truth["position_m"]
            true_m = np.interp(time_s, true.index, true, np.nan, np.nan)
        sigma_m = reported_sigma(time_s, tracks.ekf2_variance, "position_variance_m2")
        squares_m2.append([(position_m - true_m) ** 2, sigma_m**2])
    sums_m2 = zip(("error_m", "sigma_m"), np.sum(squares_m2, axis=0), strict=True)
    return {
        name: float(np.sqrt(values[np.isfinite(values)][-1]))
        for name, values in sums_m2
        if np.isfinite(values).any()
    }


def state_errors_after(analysis: Analysis, gap_s: Span) -> str:
    """Describe the position errors of KF and EKF2 at the end of a gap."""
    result, (start_s, end_s) = analysis.main, gap_s
    before_end_s = np.array([start_s, end_s - SMALLEST_TIME_S])
    axis, ekf2 = result.axis, result.ekf2_state
    reference_m = float(axis.measurement_m[np.searchsorted(axis.measurement_time_s, end_s)])
    quantity = "Distance to the first position after the gap"
    if isinstance(result.truth, pd.DataFrame):
        true_m = result.truth["position_m"]
        reference_m, quantity = (
            float(np.interp(end_s, true_m.index, true_m)),
            "Position error at the end of the gap",
        )
    texts = []
    aiding = "KF relies on the IMU alone."
    if isinstance(ekf2, pd.DataFrame) and len(before := ekf2["position_m"].loc[:end_s]):
        if _has_aids(analysis.flight.ekf2):
            aiding = "KF and EKF2 rely on the IMU alone."
        if other_aids := _continuously_fused_aids(analysis.flight.ekf2, gap_s):
            labels = " and ".join(aid.label for aid in other_aids)
            aiding = f"KF relies on the IMU alone, EKF2 also on {labels}."
        variance, at_s = result.ekf2_variance, float(before.index[-1])
        sigma = ""
        if isinstance(variance, pd.DataFrame) and len(variance):
            variance_m2 = np.interp(at_s, variance.index, variance["position_variance_m2"])
            sigma = f" (σ {format_metres(float(np.sqrt(variance_m2)))} m)"
        error_m = abs(float(before.iloc[-1]) - reference_m)
        texts.append(f"EKF2 {format_metres(error_m)} m{sigma}")
    kf_error_m = abs(float(state_at(result.replay, before_end_s)[0][1]) - reference_m)
    kf_sigma_m = float(np.sqrt(variance_at(result.replay, before_end_s)[0][1]))
    texts.append(f"KF {format_metres(kf_error_m)} m (σ {format_metres(kf_sigma_m)} m)")
    return f"{aiding} {quantity} along {axis.label}: {', '.join(texts)}."


def _has_aids(ekf2: Ekf2 | Unavailable) -> bool:
    return isinstance(ekf2, Ekf2) and bool(ekf2.aids)


def _continuously_fused_aids(ekf2: Ekf2 | Unavailable, span_s: Span) -> list[Aid]:
    """Return the horizontal aiding sources that EKF2 fused all over a time span."""
    aids, (start_s, end_s) = list[Aid](), span_s
    for name in (EV_POS.name, *OTHER_HORIZONTAL_AIDS):
        log = None if isinstance(ekf2, Unavailable) else ekf2.aids.get(name)
        if log is None:
            continue
        samples = log.samples.loc[start_s:end_s]
        is_fused = np.zeros(len(samples), bool)
        if "fused" in samples:
            is_fused = samples["fused"].to_numpy() > 0.0
        elif log.enabled is not None:
            is_fused = step_values_at(log.enabled, samples.index) > 0.0
        times_s = [start_s, *samples.index[is_fused], end_s]
        if np.diff(times_s).max() < 0.5 * (end_s - start_s):
            aids.append(AIDS[name])
    return aids


def detect_lost_samples(analysis: Analysis) -> Findings:
    source, clock = analysis.source, analysis.source.clock_map
    if clock is None or clock.method == "arrival time" or clock.distinct_stamps is not None:
        return
    intervals, typical_s = _intervals(analysis)
    lost_count = int(np.sum(np.rint(intervals / typical_s) - 1.0))
    sent_count = lost_count + len(intervals)
    if len(intervals) > 1 and lost_count / sent_count > MIN_LOST_FRACTION:
        action = "Record on the companion computer or on a link without message loss."
        if analysis.flight.log.has_ulog:
            action += " Or set SDLOG_PROFILE to 129: the ULog then contains the received positions."
        yield note(
            "source_samples_lost",
            f"The recording lacks {format_percent(lost_count / sent_count)} of the "
            f"{positions_phrase(source)}. "
            f"{lost_count} of {sent_count} positions are missing (one per "
            f"{typical_s:.2f} s is expected). EKF2 may have received them.",
            action,
            {"lost": lost_count, "lost_fraction": lost_count / sent_count},
        )


def detect_downsampling(analysis: Analysis) -> Findings:
    """Detect positions that were downsampled before PX4 received them."""
    source = analysis.source
    # mapped timestamps and a logger with a lower rate do not show the intervals of received
    # positions
    if source.clock_map is not None or source.origin.preference_rank >= ALIGNED.preference_rank:
        return
    intervals, _ = _intervals(analysis)
    base_and_multiples = _base_interval(intervals) if len(intervals) >= MIN_INTERVALS else None
    if base_and_multiples is None:
        return
    base_s, multiples = base_and_multiples
    lost_fraction = 1.0 - 1.0 / float(np.mean(multiples))
    fractions = np.bincount(multiples.astype(np.intp)) / len(multiples)
    pair_fractions = fractions[:-1] + fractions[1:]
    multiple = int(np.argmax(pair_fractions))
    is_alternating = (
        pair_fractions[multiple] >= MIN_NEIGHBOURS_FRACTION
        and fractions[multiple : multiple + 2].min() >= MIN_MULTIPLE_FRACTION
    )
    if lost_fraction < MIN_DOWNSAMPLED_FRACTION or not is_alternating:
        return
    interval_s = float(np.mean(intervals))
    is_too_slow = interval_s > EV_START_INTERVAL_S
    message = (
        f"{positions_phrase(source)} arrive at {1.0 / interval_s:.2g} Hz, "
        f"downsampled from {1.0 / base_s:.2g} Hz. The intervals are whole multiples of "
        f"{base_s:.3g} s, so {format_percent(lost_fraction)} of the positions are missing."
    )
    if is_too_slow:
        message += (
            " EKF2 (v1.14 and later) starts fusion only if two positions come within "
            f"{EV_START_INTERVAL_S:g} s."
        )
    yield finding(
        "error" if is_too_slow else "warning",
        "source_downsampled",
        message,
        "Increase the message rate of the positions (MAVROS, bridge, link), and remove any rate "
        "limit.",
        {
            "rate_hz": 1.0 / interval_s,
            "source_rate_hz": 1.0 / base_s,
            "lost_fraction": lost_fraction,
        },
    )


def _intervals(analysis: Analysis) -> tuple[Array, float]:
    intervals = np.diff(cut_to_segment(analysis.source.samples, analysis.segment).index.to_numpy())
    typical = float(np.median(intervals)) if len(intervals) else np.nan
    return intervals[intervals <= max_interval_s(typical)], typical


def _base_interval(intervals: Array) -> tuple[float, Array] | None:
    """Return the period (s) of the source, and the number of periods in each interval."""
    # the upper median is a measured interval, not a mean of two
    typical = float(np.sort(intervals)[len(intervals) // 2])
    for divisor in range(1, MAX_DIVISOR + 1):
        multiples = np.rint(intervals * divisor / typical)
        if np.any(multiples < 1.0):
            continue
        base = float(np.sum(intervals) / np.sum(multiples))
        if float(np.sqrt(np.mean((intervals / base - multiples) ** 2))) <= MAX_MULTIPLE_RMS:
            return base, multiples
    return None
