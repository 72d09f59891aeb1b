"""Events for the time axes: gaps, dropouts, resets, rejections."""

from __future__ import annotations

import numpy as np
import pytest
from comparisons import compare
from exchange import replace
from flights import Estimator, Uwb, aisle_flight

from px4fuse.comparison.flight_events import collect_events, find_source_gaps
from px4fuse.flight.model import Dropout, Reset, Unavailable


def test_detected_position_gaps_exceed_1_s_and_five_intervals() -> None:
    time_s = np.array([0.0, 0.2, 0.4, 1.4, 1.6, 3.0, 3.2])
    assert find_source_gaps(time_s, 5.0) == ((1.6, 3.0),)
    assert find_source_gaps(time_s, 1.0) == ()
    assert find_source_gaps(time_s[:1], 5.0) == ()


def test_flight_events_outside_evaluated_segment_are_excluded() -> None:
    resets = tuple(Reset(time, "position", (1.0, 0.0, 0.0)) for time in (5.0, 30.0, 30.0, 95.0))
    flight = aisle_flight(
        duration_s=100.0, uwb=Uwb(gap_s=(60.0, 65.0)), ekf2=Estimator(resets=resets),
        dropouts=(Dropout(9.0, 2.0), Dropout(50.0, 0.5), Dropout(98.0, 1.0)),
    )  # fmt: skip
    flight = replace(flight, airborne=((20.0, 70.0), (80.0, 99.0)))
    comparison = compare(flight, start_s=10.0, end_s=90.0)
    found = collect_events(comparison)
    ((start, end),) = found.gaps
    assert (start, end) == pytest.approx((60.0, 65.0), abs=0.21)
    assert found.dropouts == ((10.0, 11.0), (50.0, 50.5))
    assert found.ground_spans_s == ((10.0, 20.0), (70.0, 80.0))
    assert (found.take_off_times_s, found.landing_times_s) == ((20.0, 80.0), (70.0,))
    assert found.reset_times_s == (30.0,)


def test_time_without_positions_is_plotted_but_not_evaluated() -> None:
    resets = (Reset(100.0, "position", (1.0, 0.0, 0.0)),)
    flight = aisle_flight(uwb=Uwb(gap_s=(80.0, 130.0)), ekf2=Estimator(resets=resets))
    whole, covered = compare(flight), compare(flight, end_s=80.0)
    assert (whole.segment.end_s, whole.segment.whole_flight.end_s) == (80.0, 120.0)
    chosen = compare(flight, end_s=100.0).segment
    assert (chosen.end_s, chosen.whole_flight.end_s) == (80.0, 100.0)
    events = collect_events(whole)
    assert (events.gaps, events.reset_times_s, events.landing_times_s) == (
        ((80.0, 120.0),),
        (100.0,),
        (120.0,),
    )
    assert collect_events(covered).gaps == ()
    for result, other in zip(whole.axes.values(), covered.axes.values(), strict=True):
        assert (result.filters, result.difference) == (other.filters, other.difference)
        shown = result.with_whole_flight_tracks()
        for table, shown_table in (
            (result.ekf2_tracks.state, shown.ekf2_tracks.state),
            (result.ekf2_tracks.variance, shown.ekf2_tracks.variance),
            (result.truth, shown.truth),
        ):
            assert table.index[-1] <= 80.0
            assert shown_table.index[-1] > 119.0


def test_flight_events_list_rejections_per_axis() -> None:
    comparison = compare(aisle_flight(ekf2=Estimator(rejected_fraction=0.2)))
    found = collect_events(comparison)
    for result in comparison.axes.values():
        frame = result.ekf2_tracks.innovations
        assert list(found.rejection_times_s[result.axis.name]) == list(
            frame.index[frame["rejected"] > 0]
        )
    assert len(found.rejection_times_s["aisle"]) > 50


def test_flight_without_ekf2_and_land_detector_has_no_events() -> None:
    flight = aisle_flight(ekf2=None)
    absent = Unavailable("land detector", "no topic", "Record it.")
    found = collect_events(compare(replace(flight, airborne=absent)))
    assert (found.gaps, found.dropouts, found.ground_spans_s) == ((), (), ())
    assert (found.take_off_times_s, found.reset_times_s, dict(found.rejection_times_s)) == (
        (),
        (),
        {},
    )
    never = compare(replace(flight, airborne=()))
    assert collect_events(never).ground_spans_s == ((never.segment.start_s, never.segment.end_s),)
