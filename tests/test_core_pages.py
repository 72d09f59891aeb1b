"""Cover, flight and other-axes pages: marks, map, findings, and texts for missing data."""

from __future__ import annotations

import pytest
from comparisons import compare
from exchange import replace
from flights import Estimator, Uwb, aisle_flight, unexplained, with_noises
from matplotlib.collections import PolyCollection
from msgspec import structs
from page_tools import axes_of, words

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import Comparison
from px4fuse.finding import Finding
from px4fuse.flight.model import Dropout, Reset
from px4fuse.report import cover, flight, panels
from px4fuse.report.page import Page
from px4fuse.report.style import apply_report_style
from px4fuse.request import ComparisonRequest
from px4fuse.results.build import make_comparison_results
from px4fuse.results.contract import ComparisonResults
from px4fuse.results.model import Student


def document(
    comparison: Comparison, findings: tuple[Finding, ...] = ()
) -> tuple[Analysis, ComparisonResults]:
    analysis = unexplained(comparison)
    made = make_comparison_results(ComparisonRequest(log="aisle.ulg"), analysis, Student("Ada"))
    return analysis, structs.replace(made, findings=findings)


def drawn(draw, of: tuple[Analysis, ComparisonResults]) -> list[Page]:
    with apply_report_style():
        return list(draw(*of))


@pytest.fixture(scope="module")
def eventful() -> Analysis:
    """Analysis of a flight with every kind of event."""
    made = aisle_flight(
        duration_s=100.0,
        uwb=Uwb(gap_s=(60.0, 65.0), outlier_share=0.03),
        ekf2=Estimator(rejected_fraction=0.1, resets=(Reset(30.0, "position", (1.0, 0.0, 0.0)),)),
        dropouts=(Dropout(50.0, 0.5),),
    )
    made = replace(made, airborne=((20.0, 90.0),))
    comparison = compare(made, start_s=5.0, end_s=95.0)
    return with_noises(comparison)


def test_event_symbols_in_plots_are_labelled_by_event_type(eventful: Analysis) -> None:
    legend = panels.add_legend(Page(), eventful)
    assert legend["alt"].endswith(
        "on the ground, position gap, log dropout, EKF2 rejected, outlier, EKF2 reset, take-off, "
        "landing"
    )
    axes = panels.add_time_panel(Page(), eventful, "Events", 100.0)
    (data,) = axes.plot([6.0, 94.0], [2.0, 3.0])
    assert axes.get_xlim() == (eventful.segment.start_s, eventful.segment.end_s)
    assert axes.get_ylim() == pytest.approx((1.95, 3.05))
    data.remove()
    bands = [c for c in axes.collections if isinstance(c, PolyCollection)]
    spans = [[tuple(path.vertices[[0, 2], 0]) for path in band.get_paths()] for band in bands]
    assert spans == [
        [(5.0, 20.0), (90.0, 95.0)], list(eventful.events.gaps), [(50.0, 50.5)],
    ]  # fmt: skip
    # rejected, outliers, resets, take-off, landing
    assert [len(line.get_xdata()) for line in axes.lines[2:]] == [1, 1, 1]
    assert set(axes.lines[1].get_xdata()) <= set(panels.find_outlier_times(eventful))


def test_zoomed_plot_shows_kf_updates_in_middle_of_flight() -> None:
    comparison = compare(aisle_flight(duration_s=120.0))
    start, end = flight.find_zoom_span(comparison.main)
    updates = comparison.main.kf_run.updates.index
    assert ((updates >= start) & (updates <= end)).sum() >= flight.ZOOM_UPDATE_COUNT
    assert end - start < 4.0
    assert abs((start + end) / 2.0 - 60.0) < 12.5


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"ekf2": None}, "not evaluated: "),
        ({"truth": False}, "no ground truth"),
        ({"ekf2": Estimator(innovations_logged=False, variance_logged=False)}, "not logged"),
        ({"ekf2": None, "truth": False}, "not evaluated: "),
    ],
    ids=["no EKF2", "no truth", "no innovations", "no reference"],
)
def test_report_pages_without_data_have_note_and_no_empty_plot(changes, expected: str) -> None:
    of = document(compare(aisle_flight(**changes)))
    draws = cover.draw_pages, flight.draw_pages, flight.draw_innovations, flight.draw_other_axes
    pages = [page for draw in draws for page in drawn(draw, of)]
    assert expected in words(*pages)
    assert len(pages) == 4
    for axes in axes_of(*pages):
        assert axes.axison
        assert axes.lines or axes.patches
