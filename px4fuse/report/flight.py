"""Report pages on position, velocity, innovations and σ of KF and EKF2 over time."""

from collections.abc import Iterator

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import AxisComparison
from px4fuse.core.record import Span
from px4fuse.filter.signals import Segment
from px4fuse.flight.model import Unavailable
from px4fuse.report import panels, style
from px4fuse.report.difference_page import describe_missing_explanation
from px4fuse.report.page import COLUMN_GAP, PAGE_WIDTH, Page
from px4fuse.report.phrases import get_statistics_by_filter, list_verdict_warnings
from px4fuse.report.style import EKF2_COLOUR, KF_COLOUR, Axes

ZOOM_UPDATE_COUNT = 15  # in the enlarged plot of σ of position
MIN_ZOOM_S = 1.0  # minimum duration of the enlarged plot
ENLARGED_PLOT_HEIGHT = 125.0  # points


def draw_pages(analysis: Analysis, _: object) -> Iterator[Page]:
    """Draw position and velocity along the main axis over time."""
    result = analysis.main
    page = Page(f"Position and velocity along {result.axis.label}")
    panels.add_legend(page, analysis)
    panels.POSITION_PANEL.draw_on_page(page, analysis, result, with_time_label=False)
    panels.VELOCITY_PANEL.draw_on_page(page, analysis, result, with_time_label=True)
    page.write(describe_missing_explanation(analysis), gap_above=6.0)
    yield page


def draw_innovations(analysis: Analysis, _: object) -> Iterator[Page]:
    """Draw innovations and σ along the main axis over time."""
    result = analysis.main
    page = Page(f"Innovations and variances along {result.axis.label}")
    for panel in (
        panels.INNOVATIONS_PANEL,
        panels.POSITION_SIGMA_PANEL,
        panels.VELOCITY_SIGMA_PANEL,
    ):
        panel.draw_on_page(
            page, analysis, result, with_time_label=panel is panels.VELOCITY_SIGMA_PANEL
        )
    _draw_enlarged_sigma_plot(page, analysis)
    for note in list_verdict_warnings(analysis):
        page.write_small_text(note)
    yield page


def _draw_enlarged_sigma_plot(page: Page, analysis: Analysis) -> None:
    """Draw σ of position over a few updates."""
    result = analysis.main
    start_s, end_s = zoom_span_s = find_zoom_span(result, analysis.segment)
    title = f"σ of position (m), {end_s - start_s:.1f} s of the flight"
    axes = page.add_panel(title, ENLARGED_PLOT_HEIGHT, caption=describe_sigma_at_updates(result))
    _draw_sigma_at_updates(axes, result, zoom_span_s)
    update_times_s = result.replay.updates.loc[start_s:end_s].index
    axes.vlines(
        update_times_s,
        0.0,
        0.03,
        transform=axes.get_xaxis_transform(),
        color=style.MEASUREMENT_COLOUR,
        lw=1.2,
    )
    axes.set_xlabel(style.TIME_LABEL)
    ekf2_legend = ""
    if not isinstance(result.ekf2_state, Unavailable):
        ekf2_legend = " EKF2: ▵ before and ▾ after an update, □ logged σ."
    page.write_small_text(f"The line is σ of KF; grey ticks mark measurements.{ekf2_legend}")


def find_zoom_span(result: AxisComparison, segment: Segment) -> Span:
    """Return the start and end (s) of a few updates in the middle of the flight."""
    update_times_s = result.replay.updates.index.to_numpy()
    if len(update_times_s) < 2:
        return segment.start_s, min(segment.start_s + MIN_ZOOM_S, segment.end_s)
    interval_s = float(np.median(np.diff(update_times_s)))
    update_count = min(
        max(ZOOM_UPDATE_COUNT, round(MIN_ZOOM_S / interval_s)), len(update_times_s) - 1
    )
    durations_s = update_times_s[update_count:] - update_times_s[:-update_count]
    middle_s = float(update_times_s[len(update_times_s) // 2])
    if isinstance(result.ekf2_innovations, pd.DataFrame) and len(result.ekf2_innovations):
        middle_s = float(result.ekf2_innovations.index[len(result.ekf2_innovations) // 2])
    nearest_row = np.argmin(np.abs(update_times_s[:-update_count] + durations_s / 2.0 - middle_s))
    return float(update_times_s[nearest_row]), float(update_times_s[nearest_row + update_count])


def _draw_sigma_at_updates(axes: Axes, result: AxisComparison, zoom_span_s: Span) -> None:
    updates, steps = result.replay.updates, result.replay.steps
    variances_m2 = pd.concat([updates["prior_position_variance_m2"], steps["position_variance_m2"]])
    # A stable sort keeps the prior variance before the posterior variance
    variances_m2 = variances_m2.sort_index(kind="stable").loc[slice(*zoom_span_s)]
    dots = style.dot_style(KF_COLOUR, ".", 2.4) | {"ls": "-", "lw": 1.1}
    axes.plot(variances_m2.index, np.sqrt(variances_m2), **dots)
    if isinstance(result.ekf2_innovations, pd.DataFrame):
        ekf2_updates = result.ekf2_innovations.loc[slice(*zoom_span_s)].dropna(
            subset=["prior_variance_m2"]
        )
        prior_sigma_m, posterior_sigma_m = (
            np.sqrt(ekf2_updates[f"{side}_variance_m2"]) for side in ("prior", "posterior")
        )
        axes.vlines(ekf2_updates.index, posterior_sigma_m, prior_sigma_m, color=EKF2_COLOUR, lw=1.0)
        axes.plot(prior_sigma_m, **style.dot_style(EKF2_COLOUR, "^", 3.6, 0.7), mfc="none")
        axes.plot(posterior_sigma_m, **style.dot_style(EKF2_COLOUR, "v", 3.6))
    if isinstance(result.ekf2_variance, pd.DataFrame):
        variance_m2 = result.ekf2_variance["position_variance_m2"]
        logged_sigma = np.sqrt(variance_m2.loc[slice(*zoom_span_s)])
        axes.plot(logged_sigma, **style.dot_style(EKF2_COLOUR, "s", 3.0, 0.7), mfc="white")
    axes.set_xlim(*zoom_span_s)


def describe_sigma_at_updates(result: AxisComparison) -> str:
    filter_texts = []
    for name, filter_summary in get_statistics_by_filter(result).items():
        prior_sigma_m = filter_summary.sigma_p_before_update_m
        posterior_sigma_m = filter_summary.sigma_p_after_update_m
        if prior_sigma_m is None or posterior_sigma_m is None:
            if name == "EKF2":
                filter_texts.append(
                    "σ of EKF2 before and after an update is unknown: S or R is not logged"
                )
            continue
        sigma_text = (
            f"{name}: an update reduces σ from {prior_sigma_m:.3f} to {posterior_sigma_m:.3f} m "
            f"(variance by {1.0 - posterior_sigma_m**2 / prior_sigma_m**2:.0%})"
        )
        if name == "KF":
            sigma_text = (
                f"σ grows in each prediction (SIGMA_A {result.replay.settings.sigma_a_m_s2:g} "
                f"m/s²) and decreases with each measurement; {sigma_text}"
            )
        filter_texts.append(sigma_text)
    return f"{'; '.join(filter_texts)}." if filter_texts else ""


def draw_other_axes(analysis: Analysis, _: object) -> Iterator[Page]:
    """Draw position, velocity, innovations and σ along the other axes."""
    secondary_axes = analysis.select_secondary_axes()
    if not secondary_axes:
        return
    page = Page(
        "Appendix: other axes",
        "Position, velocity, innovations and σ of the other axes, drawn as for the main axis.",
    )
    width = (PAGE_WIDTH - COLUMN_GAP * (len(secondary_axes) - 1)) / max(len(secondary_axes), 2)
    for panel in (
        panels.POSITION_PANEL,
        panels.VELOCITY_PANEL,
        panels.INNOVATIONS_PANEL,
        panels.POSITION_SIGMA_PANEL,
    ):
        columns = [Page(width=width) for _ in secondary_axes]
        for column, result in zip(columns, secondary_axes, strict=True):
            if panel is panels.POSITION_PANEL:
                column.write_heading(result.axis.name)
            panel.draw_on_page(
                column,
                analysis,
                result,
                with_time_label=panel is panels.POSITION_SIGMA_PANEL,
                is_narrow=True,
            )
        page.add_columns(*columns)
    yield page
