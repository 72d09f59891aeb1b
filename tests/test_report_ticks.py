"""Ticks, grid and labels of plots, compared with those of matplotlib."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from matplotlib.axis import Axis

from px4fuse.report.page import Page, to_typst_data
from px4fuse.report.style import Axes, apply_report_style, set_log_scale, set_map_axes


def plot_metres(axes: Axes) -> None:
    axes.plot([0.0, 30.0], [-0.26, 0.31])
    axes.set(xlabel="time (s)", xlim=(0.0, 30.0))


def plot_on_log_scale(axes: Axes) -> None:
    axes.plot([0.0, 30.0], [0.02, 1.5])
    set_log_scale(axes)
    axes.set_xlabel("time (s)")


def plot_map(axes: Axes) -> None:
    axes.plot([0.0, 12.0], [0.0, 1.0])
    set_map_axes(axes, "east", "north")


def plot_named_rows(axes: Axes) -> None:
    axes.barh([0, 1], [3.0, 5.0])
    axes.set_yticks([0, 1], ["process noise", "unexplained"])
    axes.set_xlabel("%")


PLOTS = (plot_metres, plot_on_log_scale, plot_map, plot_named_rows)


def render(plot: Callable[[Axes], None]) -> tuple[Axes, dict[str, Any]]:
    """Return the axes of a drawn plot, and the data that Typst draws around it."""
    page = Page()
    axes = page.add_panel("Panel", 150.0)
    plot(axes)
    (block,) = to_typst_data(page.blocks, "")
    return axes, block


def read_ticks(axis: Axis) -> list[tuple[float, str]]:
    """Return fraction and text of matplotlib's visible ticks."""
    low, high = axis.get_view_interval()
    shown = [tick for tick in axis.get_major_ticks() if low <= tick.get_loc() <= high]
    to_fraction = axis.get_transform().transform
    low, high = to_fraction(np.array([low, high]))
    return [
        ((float(to_fraction(tick.get_loc())) - low) / (high - low), tick.label1.get_text())
        for tick in shown
    ]


@pytest.mark.parametrize("plot", PLOTS, ids=lambda plot: plot.__name__)
def test_drawn_tick_labels_are_those_of_matplotlib(plot: Callable[[Axes], None]) -> None:
    with apply_report_style():
        drawn, block = render(plot)
        expected = Page().add_panel("Panel", 150.0)
        plot(expected)
        expected.set_position(drawn.get_position())
        expected.figure.set_size_inches(drawn.figure.get_size_inches())
        expected.figure.draw_without_rendering()
        for axis, name in ((expected.xaxis, "x_axis"), (expected.yaxis, "y_axis")):
            ticks, _ = block[name]
            fractions, labels = zip(*read_ticks(axis), strict=True)
            assert [label for _, label in ticks] == list(labels)
            assert [fraction for fraction, _ in ticks] == pytest.approx(fractions, abs=1e-9)
        assert drawn.get_xlim() == expected.get_xlim()
        assert drawn.get_ylim() == expected.get_ylim()


def test_frame_of_report_plot_equals_matplotlib_axes_rectangle() -> None:
    with apply_report_style():
        axes, block = render(plot_metres)
    width, height = 72.0 * axes.figure.get_size_inches()
    left, top, frame_width, frame_height = block["frame"]
    box = axes.get_position()
    assert (left, left + frame_width) == pytest.approx((box.x0 * width, box.x1 * width))
    ends = ((1.0 - box.y1) * height, (1.0 - box.y0) * height)
    assert (top, top + frame_height) == pytest.approx(ends)


def test_common_offset_of_tick_labels_is_part_of_axis_label() -> None:
    def plot_utm_coordinates(axes: Axes) -> None:
        axes.plot(5.8e6 + np.arange(5.0), 4.7e6 + np.arange(5.0))
        set_map_axes(axes, "east", "north")

    with apply_report_style():
        _, block = render(plot_utm_coordinates)
    assert block["x_axis"][1] == "east (m) +5.8e6"
    assert block["y_axis"][1] == "north (m) +4.7e6"
