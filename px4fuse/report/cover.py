"""First page of a report: diagnosis card (faults, causes and actions), and plots."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from msgspec import structs

from px4fuse.analysis import AidingSourceAnalysis, Analysis
from px4fuse.card.model import (
    RATIO_AXIS_TICKS,
    AidConsistency,
    DiagnosedCause,
    DiagnosisCard,
    Verdict,
    map_ratio_to_axis,
)
from px4fuse.comparison.comparison import (
    compute_position_errors,
    interpolate_sigma,
)
from px4fuse.comparison.model import FILTER_NAMES, select_north_and_east
from px4fuse.core.arrays import Array
from px4fuse.core.text import format_metres, format_ratio, shorten_to_line
from px4fuse.filter.consistency import Reference
from px4fuse.filter.kalman import predict_track
from px4fuse.filter.signals import AISLE_AXIS, cut_to_segment
from px4fuse.finding import format_spans
from px4fuse.flight.model import Ekf2, Truth
from px4fuse.results.contract import AidsResults, ComparisonResults

from . import style
from .card_text import (
    AIDS_CAPTION,
    QUANTITY_LABELS,
    SEVERITY_SIGNS,
    format_consistent_ratios,
    format_notes,
    format_rerun_note,
    label_alternatives,
    list_flight_texts,
    locate_sigma_ratio,
    make_rerun_rows,
)
from .page import (
    AXES_LEFT_MARGIN,
    AXES_RIGHT_MARGIN,
    Page,
    make_columns,
)
from .panels import (
    LANDING_MARKER_STYLE,
    TAKE_OFF_MARKER_STYLE,
    add_legend,
    add_time_panel,
    draw_dots,
    normalised_innovations,
)
from .style import SEVERITY_COLOURS, TRACK_STYLES, draw_curve

FlightResults = ComparisonResults | AidsResults

MAX_FILE_NAME_LENGTH = 56  # characters
TERMS_NOTE = (
    "Source: positions that KF and EKF2 fuse. σ and √S: standard deviations of position and "
    "innovation, as the filter reports them. KF: position and velocity along one axis, IMU "
    "acceleration as input, no gate. Replay: px4fuse's model of EKF2, run on this log."
)
AIDS_TERMS_NOTE = (
    "√S: standard deviation of an innovation as EKF2 reports it. Source: a sensor that aids EKF2."
)
ALL_FINDINGS_TITLE = "All findings"
# Heights (points) of the map and of each plot: for plots beside the map, and for plots below a map
# of full page width
FIGURE_HEIGHTS_IN_COLUMNS, FIGURE_HEIGHTS_AT_FULL_WIDTH = (190.0, 50.0), (84.0, 64.0)
# Tracks with a larger ratio of length to width have a map of full page width
MIN_LENGTH_TO_WIDTH_RATIO_OF_WIDE_MAP = 2.2
MAX_DRAWN_SIGMAS = 4.0  # larger innovations ÷ √S are triangles at the edge
MAP_MARGIN_FACTOR = 1.08  # extent of the map divided by the extent of the tracks
# Maximum margin of the map, as fraction of the extent of the positions
MAX_MAP_MARGIN_FRACTION = 0.25
MIN_MAP_EXTENT_M = 0.5
SigmaByFilter = Mapping[str, "pd.Series[float]"]


def draw_pages(analysis: Analysis | AidingSourceAnalysis, results: FlightResults) -> Iterator[Page]:
    """Draw the first page: the diagnosis card with plots below."""
    page = Page()
    add_card(page, results.card)
    if isinstance(analysis, Analysis):
        write_panels(page, analysis, results.card)
    yield page


def add_card(page: Page, card: DiagnosisCard) -> None:
    """Add a diagnosis card (faults, causes and actions) to a page."""
    direction_text = f", {card.effect.axis}" if card.effect else ""
    ratio_text = f"RMS of actual error ÷ reported σ{direction_text}"
    formatted_fields = {
        "sign": SEVERITY_SIGNS[card.severity],
        "colour": SEVERITY_COLOURS[card.severity],
        "file": shorten_to_line(card.identity.file, MAX_FILE_NAME_LENGTH),
        "flight": " · ".join(list_flight_texts(card)),
        "axis_text": AIDS_CAPTION if card.aids else ratio_text,
        "axis_legend": f"grey: σ ratios of a consistent filter ({format_consistent_ratios()}) · "
        "━ 95 % interval · ◀ ▶: ratio outside the axis",
        "ticks": [(map_ratio_to_axis(tick), label) for tick, label in RATIO_AXIS_TICKS.items()],
        "rows": [*map(_make_verdict_row, card.verdicts), *map(_make_aid_row, card.aids)],
        "causes": list(map(_make_cause_fields, card.causes)),
        "notes": format_notes(card),
        "terms": AIDS_TERMS_NOTE if card.aids else TERMS_NOTE,
    }
    page.add("cover", **structs.asdict(card) | formatted_fields)


def _make_verdict_row(verdict: Verdict) -> dict[str, Any]:
    """Return the table row on the consistency of a filter, for the template ``cover.typ``."""
    word = f"{verdict.word}, explained" if verdict.is_explained else verdict.word
    return _make_sigma_ratio_row(
        verdict.ratio,
        verdict.against,
        verdict.interval,
        filter=verdict.filter,
        label=FILTER_NAMES[verdict.filter],
        quantity=QUANTITY_LABELS[verdict.against],
        word=f"not evaluated: {verdict.reason}" if verdict.ratio is None else word,
        quiet=verdict.is_explained,
        loud=verdict.is_fault,
    )


def _make_aid_row(aid: AidConsistency) -> dict[str, Any]:
    """Return the table row on a component of an aiding source, for the template ``cover.typ``."""
    return _make_sigma_ratio_row(
        aid.ratio,
        filter="ekf2",
        label="",
        quantity=f"{aid.label} {aid.component}".strip(),
        word="not evaluated" if aid.ratio is None else "",
        quiet=aid.is_usual,
        loud=False,
    )


def _make_sigma_ratio_row(
    sigma_ratio: float | None,
    reference_of_actual_error: Reference = "source",
    interval: tuple[float, float] | None = None,
    **fields: str | bool,
) -> dict[str, Any]:
    """Return ``fields`` with the σ ratio (actual σ ÷ reported σ) and its place in the plot."""
    if sigma_ratio is None:
        return {"ratio": "", **fields}
    return {
        "ratio": format_ratio(sigma_ratio),
        **locate_sigma_ratio(sigma_ratio, reference_of_actual_error, interval),
        **fields,
    }


def _make_cause_fields(cause: DiagnosedCause) -> dict[str, Any]:
    """Return the fields of a cause with formatted texts, for the template ``cover.typ``."""
    formatted_fields = {
        "when": f"{cause.severity} · {format_spans(cause.spans_s) or 'whole flight'}",
        "actions": [
            structs.asdict(action) | {"label": label} for label, action in label_alternatives(cause)
        ],
        "reruns": make_rerun_rows(cause.reruns),
        "after": " ".join(filter(None, (format_rerun_note(cause.reruns), cause.after))),
    }
    return structs.asdict(cause) | formatted_fields


def write_panels(page: Page, analysis: Analysis, card: DiagnosisCard) -> None:
    """Draw map, position errors and innovations, together on the first or on the second page."""
    section = Page()
    add_legend(section, analysis)
    tracks, axis_names = _rotate_map_tracks(analysis)
    length_m, width_m = np.ptp(tracks["positions"], axis=1)
    is_wide = length_m > MIN_LENGTH_TO_WIDTH_RATIO_OF_WIDE_MAP * width_m
    left, right = (section, section) if is_wide else make_columns()
    map_height, plot_height = FIGURE_HEIGHTS_AT_FULL_WIDTH if is_wide else FIGURE_HEIGHTS_IN_COLUMNS
    _draw_map(left, analysis, tracks, axis_names, map_height)
    _draw_error_plots(right, analysis, card, plot_height)
    _draw_innovations(right, analysis, plot_height)
    if not is_wide:
        section.add_columns(left, right)
    page.add_columns(section)  # keeps the section on one page


def _draw_error_plots(page: Page, analysis: Analysis, card: DiagnosisCard, height: float) -> None:
    """Draw the position errors of KF and EKF2, or their difference."""
    result, effect = analysis.main.with_whole_flight_tracks(), card.effect
    plots: list[_ErrorPlot] = []
    for filter_name, label in FILTER_NAMES.items():
        errors = compute_position_errors(result, filter_name)
        if isinstance(errors, pd.DataFrame) and errors["error_m"].notna().any():
            rmse_m = effect.position_rmse_m.get(filter_name) if effect else None
            sigmas_m = {label: errors["sigma_m"]}
            title = f"{label} error (m): RMSE"
            plots.append(_ErrorPlot(title, rmse_m, errors["error_m"], sigmas_m))
    # Without ground truth, the only plot is the difference of both filters
    if not plots and isinstance(result.ekf2_tracks.state, pd.DataFrame):
        time_s = result.ekf2_tracks.state.index.to_numpy()
        kf_track = predict_track(result.kf_run, time_s)
        difference_m = kf_track["position_m"] - result.ekf2_tracks.state["position_m"]
        sigmas_m = {
            name: pd.Series(interpolate_sigma(time_s, table, "position_variance_m2"), time_s)
            for name, table in (("KF", kf_track), ("EKF2", result.ekf2_tracks.variance))
        }
        difference_rms_m = effect.difference_rms_m if effect else None
        if difference_m.notna().any():
            title = "KF − EKF2 (m): RMS"
            plots.append(_ErrorPlot(title, difference_rms_m, difference_m, sigmas_m))
    half_range_m = 1.1 * max(map(_compute_error_axis_limit_m, plots), default=0.0)
    for plot in plots:
        _draw_error_plot(page, analysis, height, plot, half_range_m)


class _ErrorPlot(NamedTuple):
    """Error of a filter, or difference of both filters, with reported σ."""

    title: str
    rms_m: float | None
    error_m: pd.Series[float]
    sigmas_m: SigmaByFilter


def _compute_error_axis_limit_m(plot: _ErrorPlot) -> float:
    """Return the limit (m) of the error axis for a plot: the largest error or 2.2 σ."""
    largest_error_m = max(float(plot.error_m.abs().max()), 1e-3)
    sigma_limits_m = [2.2 * sigma.median() for sigma in plot.sigmas_m.values()]
    # The error axis ends at 3 times the largest error: if the reported σ is much too large, its
    # band is cut off, so that the errors remain visible
    return float(np.nanmax([largest_error_m, *np.minimum(sigma_limits_m, 3.0 * largest_error_m)]))


def _draw_error_plot(
    page: Page, analysis: Analysis, height: float, plot: _ErrorPlot, half_range_m: float
) -> None:
    """Draw an error or difference over time with its ±2σ bands."""
    title, rms_m, error_m, sigmas_m = plot
    known_sigmas_m = {
        name: sigma.dropna() for name, sigma in sigmas_m.items() if sigma.notna().any()
    }
    title += " –" if rms_m is None else f" {format_metres(rms_m)}"
    is_difference_of_filters = len(sigmas_m) > 1
    for name, sigma in known_sigmas_m.items():
        label = f"σ of {name}" if is_difference_of_filters else "σ"
        title += f", median {label} {format_metres(sigma.median())}"
    line = (
        style.line_style("black", 1.0)
        if is_difference_of_filters
        else TRACK_STYLES[next(iter(sigmas_m))]
    )

    axes = add_time_panel(page, analysis, title, height, with_time_label=False)
    axes.set_ylim(-half_range_m, half_range_m)
    for name, sigma in known_sigmas_m.items():
        style.draw_sigma_band(axes, 0.0 * sigma, sigma, style.SIGMA_BAND_COLOURS[name])
    style.draw_zero_line(axes)
    draw_curve(axes, error_m, **line)


def _draw_innovations(page: Page, analysis: Analysis, height: float) -> None:
    """Draw the innovations ÷ √S of KF and EKF2 over time; KF is in front."""
    innovations = normalised_innovations(analysis.main)
    legend = ", ".join(f"{style.INNOVATION_SYMBOLS[name]} {name}" for name in innovations)
    title = f"Innovations ÷ √S ({legend}): 95 % expected within ±2; ▲▼ beyond ±{MAX_DRAWN_SIGMAS:g}"
    axes = add_time_panel(page, analysis, title, height)
    axes.set(ylim=(-1.12 * MAX_DRAWN_SIGMAS, 1.12 * MAX_DRAWN_SIGMAS), yticks=(-2.0, 2.0))
    axes.axhspan(-2.0, 2.0, color=style.CONSISTENT_BAND_COLOUR, lw=0, zorder=0.05)
    style.draw_zero_line(axes)
    for name in reversed(innovations):
        draw_dots(axes, innovations[name], MAX_DRAWN_SIGMAS, style.INNOVATION_STYLES[name])


def _rotate_map_tracks(analysis: Analysis) -> tuple[dict[str, Array], tuple[str, str]]:
    """Return tracks seen from above, and the labels of the x and y axis of the map.

    The main flight direction is to the right; without it, north is upwards. Rows of a track: m to
    the right, m upwards.
    """
    aisle_heading_deg = next(
        (line.heading_deg for line in analysis.input_axes if line.name == AISLE_AXIS), None
    )
    heading_rad, labels = np.pi / 2.0, ("east", "north")
    if aisle_heading_deg is not None:
        heading_rad = np.deg2rad(aisle_heading_deg % 180.0)
        labels = f"along {analysis.main.axis.label}", "left"
    elif analysis.source.frame == "FRD":
        labels = "y axis of the position source", "x axis"
    cosine, sine = np.cos(heading_rad), np.sin(heading_rad)
    rotation = np.array([[cosine, sine], [sine, -cosine]])
    return {name: rotation @ track for name, track in _select_map_tracks(analysis).items()}, labels


def _select_map_tracks(analysis: Analysis) -> dict[str, Array]:
    """Return the tracks of the map by label; rows of a track: north (m), east (m).

    The tracks are the measured positions, each filter that px4fuse runs, EKF2 and ground truth.
    """
    flight, results = analysis.flight, select_north_and_east(analysis)

    def cut_to_flight(table: pd.DataFrame) -> Array:
        flight_samples = cut_to_segment(table, analysis.segment.whole_flight)
        return flight_samples[["north_m", "east_m"]].to_numpy().T

    tracks = {"positions": cut_to_flight(analysis.source.samples)}
    for name, label in FILTER_NAMES.items():
        runs = [result.tracks[name].run for result in results]
        positions_m = [run.steps["position_m"] for run in runs if run]
        if len(positions_m) == 2:
            tracks[label] = np.array(positions_m)
    if isinstance(flight.ekf2, Ekf2):
        tracks["EKF2"] = cut_to_flight(flight.ekf2.state)
    if isinstance(flight.truth, Truth):
        tracks["ground truth"] = cut_to_flight(flight.truth.samples)
    return {name: track for name, track in tracks.items() if track.size}


def _draw_map(
    page: Page,
    analysis: Analysis,
    tracks: Mapping[str, Array],
    axis_names: tuple[str, str],
    height: float,
) -> None:
    """Draw the tracks from above, with take-off and landing."""
    axes_width = page.width - AXES_LEFT_MARGIN - AXES_RIGHT_MARGIN
    limits = _compute_map_limits(tracks, axes_width / height)
    # Largest distance of a track beyond the limits: |position - position clipped to the limits|
    distance_m, name = max(
        (np.nanmax(np.abs(track.T - np.clip(track.T, *limits))), name)
        for name, track in tracks.items()
    )
    title = "Map"
    if distance_m > 0.0:
        title += f"; {name} up to {format_metres(distance_m)} m outside the plotted area"
    axes = page.add_panel(title, height)
    style.set_map_axes(axes, *axis_names)
    (left, bottom), (right, top) = limits
    axes.set(xlim=(left, right), ylim=(bottom, top))
    for name, (map_x_m, map_y_m) in tracks.items():
        if name == "positions":
            axes.plot(map_x_m, map_y_m, **style.MEASUREMENT_STYLE | {"ms": 2.4})
        else:
            stride = max(1, len(map_x_m) // style.MAX_DRAWN_POINTS)
            axes.plot(map_x_m[::stride], map_y_m[::stride], **TRACK_STYLES[name])
    position_times = cut_to_segment(analysis.source.samples, analysis.segment.whole_flight).index
    for times, marker_style in (
        (analysis.events.take_off_times_s, TAKE_OFF_MARKER_STYLE),
        (analysis.events.landing_times_s, LANDING_MARKER_STYLE),
    ):
        position_rows = position_times.get_indexer(pd.Index(times, dtype=float), method="nearest")
        large_marker_style = marker_style | {"ms": 9.0, "mec": "white", "mew": 0.8}
        axes.plot(*tracks["positions"][:, position_rows], **large_marker_style)


def _compute_map_limits(tracks: Mapping[str, Array], aspect_ratio: float) -> tuple[Array, Array]:
    """Return the lower left and the upper right corner of the map (m)."""
    reference_points_m = np.percentile(tracks["positions"], (1.0, 99.0), axis=1).T
    if "ground truth" in tracks:
        reference_points_m = np.hstack([reference_points_m, tracks["ground truth"]])
    low_m, high_m = np.nanmin(reference_points_m, axis=1), np.nanmax(reference_points_m, axis=1)
    margin_m = MAX_MAP_MARGIN_FRACTION * (high_m - low_m)
    # Tracks are clipped, because a diverged filter would make the flight tiny on the map
    points_m = np.clip(np.hstack([*tracks.values()]).T, low_m - margin_m, high_m + margin_m)
    low_m, high_m = np.nanmin(points_m, axis=0), np.nanmax(points_m, axis=0)
    length_m, width_m = np.maximum(MAP_MARGIN_FACTOR * (high_m - low_m), MIN_MAP_EXTENT_M)
    map_length_m = max(length_m, width_m * aspect_ratio)
    half_size_m = 0.5 * np.array([map_length_m, map_length_m / aspect_ratio])
    centre_m = 0.5 * (low_m + high_m)
    return centre_m - half_size_m, centre_m + half_size_m
