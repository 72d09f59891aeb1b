"""Ticks, grid and labels of plots, compared with those of matplotlib."""

from collections.abc import Callable

import numpy as np
import pytest

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


def rendered_axes(plot: Callable[[Axes], None]) -> Axes:
    page = Page()
    axes = page.add_panel("Panel", 150.0)
    plot(axes)
    to_typst_data(page.blocks, "")
    return axes


def tick_labels(axes: Axes) -> list[str]:
    """Return the texts of matplotlib's visible ticks."""
    axes.figure.draw_without_rendering()
    texts = []
    for axis in (axes.xaxis, axes.yaxis):
        low, high = axis.get_view_interval()
        shown = [tick for tick in axis.get_major_ticks() if low <= tick.get_loc() <= high]
        texts += [tick.label1.get_text() for tick in shown]
    return texts


@pytest.mark.parametrize("plot", PLOTS, ids=lambda plot: plot.__name__)
def test_drawn_tick_labels_are_those_of_matplotlib(plot: Callable[[Axes], None]) -> None:
    with apply_report_style():
        drawn = rendered_axes(plot)
        expected = Page().add_panel("Panel", 150.0)
        plot(expected)
        expected.set_position(drawn.get_position())
        expected.figure.set_size_inches(drawn.figure.get_size_inches())
        assert [text.get_text() for text in drawn.texts] == tick_labels(expected)
        assert drawn.get_xlim() == expected.get_xlim()
        assert drawn.get_ylim() == expected.get_ylim()


def test_drawn_tick_labels_are_at_their_ticks() -> None:
    with apply_report_style():
        axes = rendered_axes(plot_metres)
        for text in axes.texts:
            box = text.get_window_extent()
            x, y = axes.transData.inverted().transform(
                [(box.x0 + box.x1) / 2.0, (box.y0 + box.y1) / 2.0]
            )
            is_x_label = box.y1 < axes.bbox.y0
            number = float(text.get_text().replace("\N{MINUS SIGN}", "-"))
            assert (x if is_x_label else y) == pytest.approx(
                number, abs=0.2 if is_x_label else 0.02
            )


def test_common_summand_of_tick_labels_is_part_of_axis_label() -> None:
    def plot_utm_coordinates(axes: Axes) -> None:
        axes.plot(5.8e6 + np.arange(5.0), 4.7e6 + np.arange(5.0))
        set_map_axes(axes, "east", "north")

    with apply_report_style():
        axes = rendered_axes(plot_utm_coordinates)
    assert axes.get_xlabel() == "east (m) +5.8e6"
    assert axes.get_ylabel() == "north (m) +4.7e6"


def test_axes_without_label_have_no_tick_labels_along_x() -> None:
    with apply_report_style():
        axes = rendered_axes(lambda axes: axes.plot([0.0, 1.0], [10.0, 11.0]))
    assert axes.texts
    assert all(float(text.get_text()) >= 10.0 for text in axes.texts)
