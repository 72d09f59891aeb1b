"""Report page on the aiding sources of EKF2, with statistics and plots of their innovations."""

from collections.abc import Iterator, Mapping

import numpy as np
import pandas as pd

from px4fuse.analysis import AidingSourceAnalysis, Analysis
from px4fuse.core.record import Span
from px4fuse.core.text import format_number
from px4fuse.ekf2.aids import AidResult, find_flight_span
from px4fuse.flight.model import AidLog, Flight, Unavailable, sample_step_function

from . import style
from .page import Cell, Page
from .panels import ON_GROUND_BAND_STYLE, draw_dots
from .phrases import VERDICT_LEGEND, format_sigma_verdict

LEAD_TEXT = (
    "Each aiding source is tested with its innovations in flight: a mean NIS of 1 is expected. "
    "The NIS hardly shows time-correlated errors, wrong delays and wrong headings."
)
AID_PANEL_HEIGHT = 21.0  # points, per aiding source
MAX_DRAWN_SIGMAS = 4.0  # larger |ν/√S| are triangles at the edge
# Aiding sources of outdoor flights
OUTDOOR_AIDS = ("gnss_pos", "gnss_vel", "optical_flow", "aux_global_position")


def draw_pages(analysis: Analysis | AidingSourceAnalysis, _: object) -> Iterator[Page]:
    """Draw the page on the aiding sources of EKF2."""
    if isinstance(analysis, Analysis):
        title, aids = "Appendix: aiding sources", select_aids_of_outdoor_flight(analysis)
    else:
        title, aids = "Aiding sources", analysis.aids
    if aids:
        page = Page(f"{title} of EKF2", LEAD_TEXT)
        write_aids(page, aids)
        page.write_muted_text(VERDICT_LEGEND)
        _draw_aid_panels(page, analysis.flight, aids)
        yield page


def select_aids_of_outdoor_flight(analysis: Analysis) -> Mapping[str, AidResult]:
    """Return all aiding sources if EKF2 fused GNSS or optical flow, else none."""
    aids = {} if isinstance(analysis.aids, Unavailable) else analysis.aids
    return {} if _select_enabled_aids(aids).keys().isdisjoint(OUTDOOR_AIDS) else aids


def _select_enabled_aids(aids: Mapping[str, AidResult]) -> dict[str, AidResult]:
    return {name: aid for name, aid in aids.items() if aid.verdict != "disabled"}


def write_aids(page: Page, aids: Mapping[str, AidResult]) -> None:
    """Write a table of the aiding sources and their innovation statistics."""
    rows: list[list[Cell]] = []
    for aid in _select_enabled_aids(aids).values():
        verdict_colour = style.GOOD_COLOUR if aid.verdict == "consistent" else style.MUTED_COLOUR
        if aid.is_faulty:
            verdict_colour = style.SEVERITY_COLOURS["warning"]
        aid_cells: list[Cell] = [
            aid.label,
            (format_aid_verdict(aid), verdict_colour),
            "" if aid.enabled_fraction is None else f"{aid.enabled_fraction:.0%}",
            f"{aid.rejected_fraction:.1%}",
            f"{aid.longest_gap_duration_s:.1f}",
            "" if aid.noise is None else f"{format_number(aid.noise)} {aid.unit}",
        ]
        axis_rows = [
            [
                name,
                f"{axis.samples}",
                format_number(axis.nis_mean),
                "{:.2f} – {:.2f}".format(*axis.nis_band),
                f"{axis.mean_normalised_innovation:+.2f}",
            ]
            for name, axis in aid.axes.items()
        ]
        for axis_cells in axis_rows or [[""] * 5]:
            rows.append([*aid_cells, *axis_cells])
            aid_cells = [""] * 6
    column_heads = ["aiding source", "verdict", "enabled", "rejec-\nted", "longest\ngap (s)", "√R"]
    column_heads += ["axis", "n", "mean\nNIS", "95 %\nband", "mean\nν/√S"]
    page.add_table(column_heads, rows, right_aligned_columns=(2, 3, 4, 5, 7, 8, 10))
    if disabled_labels := [aid.label for aid in aids.values() if aid.verdict == "disabled"]:
        page.write_muted_text(
            f"Aiding sources that are logged but never fused: {', '.join(disabled_labels)}."
        )


def format_aid_verdict(aid: AidResult) -> str:
    if aid.verdict == "not_fused":
        return f"not fused for up to {aid.longest_gap_duration_s:.1f} s"
    return format_sigma_verdict(aid.verdict, max(aid.nis_mean, 1.0 / aid.nis_mean) ** 0.5)


def _draw_aid_panels(page: Page, flight: Flight, aids: Mapping[str, AidResult]) -> None:
    """Draw ν/√S of each enabled aiding source over time, in one plot per source."""
    flight_span_s, enabled_aids = find_flight_span(flight), _select_enabled_aids(aids)
    if (
        not enabled_aids
        or isinstance(flight.ekf2, Unavailable)
        or isinstance(flight_span_s, Unavailable)
    ):
        return
    page.write_heading("Normalised innovations of each aiding source")
    page.write_muted_text(
        "95 % of the normalised innovations ν/√S are expected within ±2 (lines). Hollow samples "
        "were not fused. Grey: fusion was disabled. Triangles: values beyond "
        f"±{MAX_DRAWN_SIGMAS:g}."
    )
    for name, aid in enabled_aids.items():
        axes = page.add_panel(aid.label, AID_PANEL_HEIGHT)
        _draw_normalised_innovations(axes, flight.ekf2.aids[name], flight_span_s)
    axes.set_xlabel(style.TIME_LABEL)


def _draw_normalised_innovations(axes: style.Axes, aid_log: AidLog, span_s: Span) -> None:
    """Draw ν/√S of an aiding source, and a grey band while its fusion was disabled."""
    samples = aid_log.samples.loc[slice(*span_s)]
    is_fused = samples["fused"] > 0.0 if "fused" in samples else pd.Series(True, samples.index)
    for axis in aid_log.axes:
        innovations = samples[f"innovation_{axis}"] / np.sqrt(samples[f"variance_{axis}"])
        for is_drawn, dot_style in (
            (is_fused, style.INNOVATION_STYLES["EKF2"]),
            (~is_fused, style.REJECTED_INNOVATION_STYLE),
        ):
            marker_style = dot_style | {"ms": 1.4}
            draw_dots(axes, innovations[is_drawn], MAX_DRAWN_SIGMAS, marker_style)
    if aid_log.enabled is not None:
        times_s = np.linspace(*span_s, 2000)
        is_disabled = sample_step_function(aid_log.enabled, pd.Index(times_s)) <= 0.0
        band_style = ON_GROUND_BAND_STYLE | {"zorder": 0.1}
        axes.fill_between(times_s, -5.0, 5.0, where=is_disabled.tolist(), **band_style)
    limit = 1.1 * MAX_DRAWN_SIGMAS
    axes.set(xlim=span_s, ylim=(-limit, limit), yticks=(-2.0, 2.0))
