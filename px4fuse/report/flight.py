"""Report pages on position, velocity, innovations and σ of KF and EKF2 over time."""

from collections.abc import Iterator

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.comparison.model import AxisComparison
from px4fuse.core.record import Span

from . import panels, style
from .difference_page import describe_missing_explanation
from .page import Page, make_columns
from .phrases import get_statistics_by_filter, list_verdict_warnings
from .style import EKF2_COLOUR, TRACK_STYLES

ZOOM_UPDATE_COUNT = 15  # in the enlarged plot of σ of position
MIN_ZOOM_DURATION_S = 1.0  # minimum duration of the enlarged plot
TRACK_PANELS = (panels.POSITION_PANEL, panels.VELOCITY_PANEL)
INNOVATION_PANELS = (
    panels.INNOVATIONS_PANEL,
    panels.POSITION_SIGMA_PANEL,
    panels.VELOCITY_SIGMA_PANEL,
)
# Panels of each axis in the appendix
NARROW_PANELS = (*TRACK_PANELS, *INNOVATION_PANELS[:2])
ENLARGED_PLOT_HEIGHT = 125.0  # points


def draw_pages(analysis: Analysis, _: object) -> Iterator[Page]:
    """Draw position and velocity along the axis of largest motion over time."""
    result = analysis.main
    page = Page(f"Position and velocity along {result.axis.label}")
    panels.add_legend(page, analysis)
    panels.draw_panels(page, analysis, result, TRACK_PANELS)
    page.write(describe_missing_explanation(analysis))
    yield page


def draw_innovations(analysis: Analysis, _: object) -> Iterator[Page]:
    """Draw innovations and σ along the axis of largest motion over time."""
    result = analysis.main
    page = Page(f"Innovations and variances along {result.axis.label}")
    panels.draw_panels(page, analysis, result, INNOVATION_PANELS)
    _draw_enlarged_sigma_plot(page, result)
    for note in list_verdict_warnings(analysis):
        page.write_muted_text(note)
    yield page


def _draw_enlarged_sigma_plot(page: Page, result: AxisComparison) -> None:
    """Draw σ of position over a few updates."""
    start_s, end_s = find_zoom_span(result)
    axes = page.add_panel(
        "σ of position (m) at a few updates",
        ENLARGED_PLOT_HEIGHT,
        caption=_describe_sigma_at_updates(result),
    )
    kf_run, ekf2 = result.kf_run, result.ekf2_tracks
    kf_variances_m2 = pd.concat(
        [kf_run.updates["prior_position_variance_m2"], kf_run.steps["position_variance_m2"]]
    )
    # A stable sort keeps the prior variance before the posterior variance
    kf_variances_m2 = kf_variances_m2.sort_index(kind="stable").loc[start_s:end_s]
    axes.plot(np.sqrt(kf_variances_m2), **TRACK_STYLES["KF"])
    if isinstance(ekf2.innovations, pd.DataFrame):
        ekf2_updates = ekf2.innovations.loc[start_s:end_s]
        for side, marker in (("prior", "^"), ("posterior", "v")):
            sigma_m = np.sqrt(ekf2_updates[f"{side}_variance_m2"])
            axes.plot(sigma_m, **style.dot_style(EKF2_COLOUR, marker, 3.6, 0.7), mfc="none")
    if isinstance(ekf2.variance, pd.DataFrame):
        logged_sigma_m = np.sqrt(ekf2.variance["position_variance_m2"].loc[start_s:end_s])
        axes.plot(logged_sigma_m, **style.dot_style(EKF2_COLOUR, "s", 3.0, 0.7), mfc="white")
    axes.set_xlim(start_s, end_s)
    axes.set_xlabel(style.TIME_LABEL)


def find_zoom_span(result: AxisComparison) -> Span:
    """Return the start and end (s) of a few updates in the middle of the flight."""
    update_times_s = result.kf_run.updates.index.to_numpy()
    start_s = float(update_times_s[len(update_times_s) // 2])
    interval_s = np.median(np.diff(update_times_s)) if len(update_times_s) > 1 else 0.0
    return start_s, start_s + max(float(ZOOM_UPDATE_COUNT * interval_s), MIN_ZOOM_DURATION_S)


def _describe_sigma_at_updates(result: AxisComparison) -> str:
    """Describe the lines and markers of the plot of σ."""
    sentences = [
        "The line is σ of KF, which grows in each prediction (SIGMA_A "
        f"{result.kf_run.settings.sigma_a_m_s2:g} m/s²).",
        "σ of EKF2: ▵ before and ▿ after an update, □ logged.",
    ]
    for name, filter_summary in get_statistics_by_filter(result).items():
        sigma_before_update_m = filter_summary.sigma_p_before_update_m
        sigma_after_update_m = filter_summary.sigma_p_after_update_m
        if sigma_before_update_m is None or sigma_after_update_m is None:
            sentences.append(f"{name}: σ before and after an update is unknown.")
        else:
            sentences.append(
                f"{name}: an update reduces σ from {sigma_before_update_m:.3f} to "
                f"{sigma_after_update_m:.3f} m."
            )
    return " ".join(sentences)


def draw_other_axes(analysis: Analysis, _: object) -> Iterator[Page]:
    """Draw position, velocity, innovations and σ along all axes but that of largest motion."""
    secondary_axes = analysis.select_secondary_axes()
    if not secondary_axes:
        return
    page = Page("Appendix: other axes")
    # a single axis fills half of the page
    columns = make_columns(max(len(secondary_axes), 2))[: len(secondary_axes)]
    for column, result in zip(columns, secondary_axes, strict=True):
        column.write_heading(result.axis.name)
        panels.draw_panels(column, analysis, result, NARROW_PANELS, is_narrow=True)
    page.add_columns(*columns)
    yield page
