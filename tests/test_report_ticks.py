"""Ticks, grid and labels of plots, compared with those of matplotlib."""

from collections.abc import Callable

import numpy as np
import pytest
from matplotlib.figure import Figure

from px4fuse.report.page import measure_text_width
from px4fuse.report.style import Axes, apply_report_style, set_map_axes, set_plain_ticks
from px4fuse.report.ticks import replace_ticks

MAX_DISTANCE_POINTS = 3.0  # between the places of a text in both drawings


def plot_metres(axes: Axes) -> None:
    axes.plot([0.0, 30.0], [-0.26, 0.31])
    axes.set(xlabel="time (s)", xlim=(0.0, 30.0))


def plot_utm_coordinates(axes: Axes) -> None:
    axes.plot(5.8e6 + np.arange(5.0), 4.7e6 + np.arange(5.0))
    axes.set(xlabel="east (m)", ylabel="north (m)")


def plot_on_log_scale(axes: Axes) -> None:
    axes.plot([0.0, 30.0], [0.02, 1.5])
    axes.set_yscale("log")
    set_plain_ticks(axes)
    axes.tick_params(axis="x", labelbottom=False)


def plot_map(axes: Axes) -> None:
    axes.plot([0.0, 12.0], [0.0, 1.0])
    set_map_axes(axes, "east", "north")


def plot_named_rows(axes: Axes) -> None:
    axes.barh([0, 1], [3.0, 5.0])
    axes.set_yticks([0, 1], ["process noise", "unexplained"])
    axes.grid(visible=False)


PLOTS = (plot_metres, plot_utm_coordinates, plot_on_log_scale, plot_map, plot_named_rows)


def drawn_texts(
    plot: Callable[[Axes], None], *, few_artists: bool
) -> list[tuple[str, float, float]]:
    """Return the texts of a plot, each with x and y (points) of its centre."""
    with apply_report_style():
        axes = Figure(figsize=(4.0, 2.6), dpi=72.0).add_axes((0.3, 0.3, 0.6, 0.6))
        plot(axes)
        if few_artists:
            replace_ticks(axes, measure_text_width)
            texts = axes.texts
        else:
            axes.figure.draw_without_rendering()
            texts = [axes.xaxis.label, axes.yaxis.label]
            for axis in (axes.xaxis, axes.yaxis):
                low, high = axis.get_view_interval()
                shown = [tick for tick in axis.get_major_ticks() if low <= tick.get_loc() <= high]
                texts += [tick.label1 for tick in shown if tick.label1.get_visible()]
                texts += [axis.get_offset_text()]
        boxes = {text: text.get_window_extent() for text in texts if text.get_text()}
    return sorted(
        (text.get_text(), (box.x0 + box.x1) / 2.0, (box.y0 + box.y1) / 2.0)
        for text, box in boxes.items()
    )


@pytest.mark.parametrize("plot", PLOTS, ids=lambda plot: plot.__name__)
def test_fast_tick_labels_have_matplotlib_texts_and_positions(plot: Callable[[Axes], None]) -> None:
    expected = drawn_texts(plot, few_artists=False)
    drawn = drawn_texts(plot, few_artists=True)
    assert [text for text, *_ in drawn] == [text for text, *_ in expected]
    for (_, *place), (text, *expected_place) in zip(drawn, expected, strict=True):
        if not text.startswith("+"):  # the common summand stands left of the axis
            assert place == pytest.approx(expected_place, abs=MAX_DISTANCE_POINTS), text


def test_replaced_ticks_keep_the_grid_of_each_axis() -> None:
    with apply_report_style():
        for grid_axis, expected_count in (("y", 1), ("both", 2)):
            axes = Figure().add_axes((0.0, 0.0, 1.0, 1.0))
            axes.grid(visible=False)
            axes.grid(visible=True, axis=grid_axis)
            replace_ticks(axes, measure_text_width)
            colours = [line.get_color() for line in axes.lines]
            assert colours.count("#e3e3e3") == expected_count
