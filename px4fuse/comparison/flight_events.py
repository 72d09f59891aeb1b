"""Events of a flight for marks in charts: gaps, rejections, resets, take-off and landing."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd

from px4fuse.core.arrays import Array, select_intervals
from px4fuse.core.record import Span
from px4fuse.flight.model import Ekf2, Flight, Unavailable

from .model import Comparison

# Minimum length (s) of a gap in the position source
MIN_GAP_S = 1.0
# Minimum length of a gap in the position source, in sample intervals
MIN_GAP_IN_INTERVALS = 5.0


@dataclass(frozen=True)
class Events:
    """Events of the whole flight; times are in seconds since the first sample of the log.

    Attributes
    ----------
    gaps : tuple of (float, float)
        Spans without positions.
    dropouts : tuple of (float, float)
        Spans in which the logger wrote no data.
    ground_spans_s : tuple of (float, float)
        Spans on the ground, from the land detector.
    reset_times_s : tuple of float
        Resets of EKF2's position or velocity.
    rejection_times_s : mapping from axis name to ndarray
        Positions that EKF2 rejected.
    """

    gaps: tuple[Span, ...]
    dropouts: tuple[Span, ...]
    ground_spans_s: tuple[Span, ...]
    take_off_times_s: tuple[float, ...]
    landing_times_s: tuple[float, ...]
    reset_times_s: tuple[float, ...]
    rejection_times_s: Mapping[str, Array]


def compute_max_interval_s(interval_s: float) -> float:
    """Return the longest interval (s) between two positions that is not a gap."""
    return max(MIN_GAP_S, MIN_GAP_IN_INTERVALS * interval_s)


def find_source_gaps(time_s: Array, rate_hz: float) -> tuple[Span, ...]:
    """Return start and end (s) of each gap in positions with the normal rate ``rate_hz``."""
    is_gap = np.diff(time_s) > compute_max_interval_s(1.0 / rate_hz)
    return tuple(select_intervals(time_s, is_gap))


def find_airborne_spans(flight: Flight) -> tuple[Span, ...]:
    """Return the take-off and landing times (s) of each flight in the log."""
    return () if isinstance(flight.airborne, Unavailable) else flight.airborne


def collect_events(comparison: Comparison) -> Events:
    """Collect the events of a flight: gaps, rejections, resets, take-off and landing."""
    flight, segment = comparison.flight, comparison.segment.whole_flight
    start_s, end_s = segment.start_s, segment.end_s
    time_s = np.concatenate([[start_s], comparison.input_axes[0].measurement_time_s, [end_s]])

    airborne_spans_s = find_airborne_spans(flight)
    flight_edges_s = [start_s, *(edge_s for span in airborne_spans_s for edge_s in span), end_s]
    resets = flight.ekf2.resets if isinstance(flight.ekf2, Ekf2) else ()
    return Events(
        gaps=find_source_gaps(time_s, comparison.source.compute_rate_hz()),
        dropouts=segment.clip_spans(
            (dropout.start_s, dropout.start_s + dropout.duration_s)
            for dropout in flight.log.dropouts
        ),
        ground_spans_s=()
        if isinstance(flight.airborne, Unavailable)
        else segment.clip_spans(zip(flight_edges_s[::2], flight_edges_s[1::2], strict=True)),
        take_off_times_s=tuple(start for start, _ in airborne_spans_s if start_s <= start <= end_s),
        landing_times_s=tuple(end for _, end in airborne_spans_s if start_s <= end <= end_s),
        reset_times_s=tuple(
            sorted({reset.time_s for reset in resets if start_s <= reset.time_s <= end_s})
        ),
        rejection_times_s={
            axis_result.axis.name: frame.index[frame["rejected"] > 0].to_numpy()
            for axis_result in comparison.axes.values()
            if isinstance(frame := axis_result.ekf2_tracks.innovations, pd.DataFrame)
        },
    )
