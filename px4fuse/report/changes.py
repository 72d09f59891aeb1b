"""What changed from A to B: numbers in a table, then tracks, innovations and σ over each other."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from px4fuse.analysis import Analysis
from px4fuse.arrays import Array
from px4fuse.comparison.events import happened
from px4fuse.comparison.model import AxisComparison
from px4fuse.comparison.why import the
from px4fuse.filter.kalman import state_at
from px4fuse.filter.signals import AISLE
from px4fuse.plain import number_words
from px4fuse.report.changes_words import (
    chance_words,
    change_words,
    folded_words,
    judgement_words,
    told,
    value_words,
)
from px4fuse.report.document import ChangesDocument
from px4fuse.report.page import Cell, Page, halves, legend_above
from px4fuse.report.style import MAX_POINTS, MUTED, SEVERITY_COLOURS, bare_x, log_ticks, thin
from px4fuse.results.changes import NumberChange
from px4fuse.results.contract import ChangeResults

# A is dark and solid, B lighter and dashed, so that they stay apart in grey; neither has a colour
# of one of the filters
STYLES: dict[str, dict[str, Any]] = {
    "A": {"color": "#4b2e83", "lw": 1.1, "ls": "-"},
    "B": {"color": "#2e9e6b", "lw": 1.1, "ls": (0, (4, 1.6))},
}
DOTS: dict[str, dict[str, Any]] = {
    "A": {"color": "#4b2e83", "marker": "o", "ms": 1.9, "mew": 0, "ls": "none"},
    "B": {"color": "#2e9e6b", "marker": "s", "ms": 2.1, "mew": 0, "ls": "none"},
}
COLOURS = {"worse": SEVERITY_COLOURS["error"], "better": "#1f6b3a"}
SIZE = 7.6
SHARES = (7.5, 28.0, 7.5, 10.0, 25.0, 9.0)
HEADS = ("", "number", "A", "B", "change, with its 95 % interval", "by chance?")
# The axes of innovations reach so many of the larger median 2√S
EDGE = 2.2
MAP, PANEL, LEGEND = 160.0, 95.0, 14.0


@dataclass(frozen=True)
class SideTrack:
    """One of the two on an axis that both have; its times count from ``zero_s``."""

    name: str
    analysis: Analysis
    result: AxisComparison
    zero_s: float

    def since(self, index: pd.Index) -> Array:
        """Times of a frame since its time zero (s)."""
        time: Array = index.to_numpy() - self.zero_s
        return time


def draw(document: ChangesDocument) -> Iterator[Page]:
    """Draw the summary, and where both logs are at hand what they show."""
    yield _numbers(document.results)
    a, b = document.a, document.b
    if a is None or b is None:
        return
    named = [set(analysis.axes) for analysis in (a, b)]
    common = [n for n in (AISLE, "north", "east", "down") if all(n in names for names in named)]
    if not common:
        return
    tracks, since = _tracks(a, b, common[0])
    yield _drawn_tracks(tracks, since)
    yield _drawn_innovations(tracks, since)


# -- numbers ---------------------------------------------------------------------------------------


def _numbers(results: ChangeResults) -> Page:
    page = Page("What changed from A to B")
    for text in results.summary[:1]:
        page.write(text, size=10.0, bold=True)
    for text in results.summary[1:]:
        page.write(text, size=8.6, above=2.0)
    for name, side in (("A", results.a), ("B", results.b)):
        kind = {"log": "its log", "report": "its report", "results": "its results"}[side.kind]
        page.write(
            f"{name}: {side.given}, {kind}; SHA-256 {side.log_sha256[:12]}, px4fuse {side.px4fuse}",
            size=7.4, colour=MUTED,
        )  # fmt: skip
    shown = told(results)
    if shown:
        page.table(HEADS, [_cells(change) for change in shown], shares=SHARES, size=SIZE)
    page.write(folded_words(results), size=SIZE, colour=MUTED, above=3.0)
    for change in results.texts:
        said = f"{change.kind.capitalize()}: {change.what}, {change.a} in A, {change.b} in B."
        page.write(said, size=SIZE, above=1.0)
    for one in results.findings:
        said = f"{'New' if one.only_in == 'B' else 'Gone'} ({one.severity}): {one.message}"
        page.write(said, size=SIZE, colour=SEVERITY_COLOURS[one.severity], above=1.0)
    for text in (*results.notes, *results.methods):
        page.write(text, size=SIZE, colour=MUTED, above=1.0)
    return page


def _cells(change: NumberChange) -> list[Cell]:
    judged = judgement_words(change)
    return [
        (judged, COLOURS.get(judged, "black")),
        change.label,
        value_words(change, change.a),
        value_words(change, change.b, unit=True),
        change_words(change),
        chance_words(change),
    ]


# -- pictures --------------------------------------------------------------------------------------


def _tracks(a: Analysis, b: Analysis, axis: str) -> tuple[tuple[SideTrack, SideTrack], str]:
    """Both on one axis, and what their times count from."""
    took_off = [happened(analysis).take_off_s for analysis in (a, b)]
    zeros = [times[0] for times in took_off if times]
    since = "take-off"
    if len(zeros) < len(took_off):
        zeros = [float(x[axis].axis.measurement_time_s[0]) for x in (a, b)]
        since = "the first measurement"
    first, second = (
        SideTrack(name, analysis, analysis[axis], zero)
        for name, analysis, zero in zip("AB", (a, b), zeros, strict=True)
    )
    return (first, second), f"time since {since} (s)"


def _drawn_tracks(tracks: tuple[SideTrack, SideTrack], since: str) -> Page:
    along = the(tracks[0].result.axis.name)
    page = Page("Tracks of A and B", "A is dark and solid, B lighter and dashed, on common axes.")
    columns = halves()
    sides: tuple[tuple[str, Callable[[AxisComparison], Any]], ...] = (
        ("EKF2 from above", lambda result: result.ekf2_state),
        ("Ours from above", lambda result: result.replay.steps),
    )
    for column, (title, of) in zip(columns, sides, strict=True):
        paths = [(t.name, path) for t in tracks if (path := _path(t.analysis, of)) is not None]
        say = "North is up." if len(paths) == len(tracks) else "Not both have it."
        axes = column.panel(title, say, MAP, above=LEGEND, left=34.0)
        for name, (north, east) in paths:
            every = max(1, len(north) // MAX_POINTS)
            axes.plot(east[::every], north[::every], **STYLES[name], label=name)
        axes.set_aspect("equal", adjustable="datalim")
        axes.grid(visible=True, axis="both")
        axes.xaxis.set_major_locator(MaxNLocator(5))
        axes.set_xlabel("east (m)")
        axes.set_ylabel("north (m)")
        if paths:
            legend_above(axes)
    page.beside(*columns)
    _series(
        page, tracks, since,
        (f"Position along {along}, EKF2 (m)", "As EKF2 published it.", _ekf2_position),
        (f"Ours - EKF2 along {along} (m)", _rms_words(tracks, _apart), _apart),
        (f"Error of EKF2 along {along} (m)", _rms_words(tracks, _error), _error),
    )  # fmt: skip
    return page


def _drawn_innovations(tracks: tuple[SideTrack, SideTrack], since: str) -> Page:
    along = the(tracks[0].result.axis.name)
    page = Page(
        f"Innovations and variances along {along}",
        "Dots: innovations; lines: ±2√S of A (solid) and B (dashed). About 95 % of the dots "
        "belong between their lines.",
    )
    for title, of in (
        ("Innovations of EKF2 (m)", lambda track: track.result.ekf2_innovations),
        ("Innovations of ours (m)", lambda track: track.result.replay.updates),
    ):
        _innovations(page, tracks, title, of)
    _series(
        page, tracks, since,
        ("σ of position, EKF2 (m), log scale", _median_words(tracks, _ekf2_sigma), _ekf2_sigma),
        ("σ of position, ours, before each measurement (m), log scale",
         _median_words(tracks, _our_sigma), _our_sigma),
        log=True,
    )  # fmt: skip
    return page


Series = tuple[Array, Array]
Of = Callable[[SideTrack], Series | None]


def _series(
    page: Page, tracks: Sequence[SideTrack], since: str, *panels: tuple[str, str, Of],
    log: bool = False,
) -> None:  # fmt: skip
    """One series of both per panel; what neither has is left out, the last says what times are."""
    found = [(title, say, [(t, made) for t in tracks if (made := of(t)) is not None])
             for title, say, of in panels]  # fmt: skip
    found = [panel for panel in found if panel[2]]
    for at, (title, say, drawn) in enumerate(found):
        only = f" Only {drawn[0][0].name} has it." if len(drawn) < len(tracks) else ""
        axes = page.panel(title, say + only, PANEL, above=LEGEND)
        for track, made in drawn:
            axes.plot(*thin(*made), **STYLES[track.name], label=track.name)
        if log:
            log_ticks(axes)
        _finish(axes, tracks, since if at == len(found) - 1 else "")
        legend_above(axes)


def _innovations(
    page: Page, tracks: Sequence[SideTrack], title: str, of: Callable[[SideTrack], Any]
) -> None:
    frames = [(track, frame) for track in tracks if isinstance(frame := of(track), pd.DataFrame)]
    sigmas = {t.name: 2.0 * np.sqrt(f["innovation_variance_m2"].to_numpy()) for t, f in frames}
    missing = [track.name for track in tracks if track.name not in sigmas]
    edge = EDGE * max((float(np.median(s)) for s in sigmas.values()), default=1.0)
    outside = [
        f"{track.name} {np.mean(np.abs(frame['innovation_m']) > sigmas[track.name]):.1%}"
        for track, frame in frames
    ]
    beyond = sum(int((frame["innovation_m"].abs() > edge).sum()) for _, frame in frames)
    say = f"Outside their own ±2√S: {', '.join(outside)}." if outside else ""
    say += f" {beyond} lie beyond the axis." if beyond else ""
    say += f" Not available in {' and '.join(missing)}." if missing else ""
    axes = page.panel(title, say.strip(), PANEL, above=LEGEND)
    for track, frame in frames:
        time, nu = track.since(frame.index), frame["innovation_m"].to_numpy()
        for sign in (1.0, -1.0):
            line = thin(time, sign * sigmas[track.name])
            axes.plot(*line, **{**STYLES[track.name], "lw": 0.8})
        inside = np.abs(nu) <= edge
        axes.plot(*thin(time[inside], nu[inside]), **DOTS[track.name], label=track.name)
    axes.axhline(0.0, color="black", lw=0.5)
    axes.set_ylim(-edge, edge)
    _finish(axes, tracks, "")
    if frames:
        legend_above(axes, markerscale=2.0)


def _finish(axes: Axes, tracks: Sequence[SideTrack], since: str) -> None:
    """Common limits in time, whose numbers stand at the last panel alone."""
    segments = [(track.analysis.segment, track.zero_s) for track in tracks]
    axes.set_xlim(
        min(segment.start_s - zero for segment, zero in segments),
        max(segment.end_s - zero for segment, zero in segments),
    )
    if since:
        axes.set_xlabel(since)
    else:
        bare_x(axes)


def _ekf2_position(track: SideTrack) -> Series | None:
    state = track.result.ekf2_state
    if not isinstance(state, pd.DataFrame):
        return None
    return track.since(state.index), state["position_m"].to_numpy()


def _ekf2_sigma(track: SideTrack) -> Series | None:
    variance = track.result.ekf2_variance
    if not isinstance(variance, pd.DataFrame):
        return None
    return track.since(variance.index), np.sqrt(variance["position_variance_m2"].to_numpy())


def _our_sigma(track: SideTrack) -> Series | None:
    updates = track.result.replay.updates
    return track.since(updates.index), np.sqrt(updates["prior_position_variance_m2"].to_numpy())


def _apart(track: SideTrack) -> Series | None:
    """Ours minus EKF2, at EKF2's times."""
    state = track.result.ekf2_state
    if not isinstance(state, pd.DataFrame):
        return None
    ours, _ = state_at(track.result.replay, state.index.to_numpy())
    return _known(track.since(state.index), ours - state["position_m"].to_numpy())


def _error(track: SideTrack) -> Series | None:
    """EKF2 against the truth."""
    state, truth = track.result.ekf2_state, track.result.truth
    if not isinstance(state, pd.DataFrame) or not isinstance(truth, pd.DataFrame):
        return None
    true = np.interp(state.index, truth.index, truth["position_m"], left=np.nan, right=np.nan)
    return _known(track.since(state.index), state["position_m"].to_numpy() - true)


def _known(time: Array, values: Array) -> Series | None:
    finite = np.isfinite(values)
    return (time[finite], values[finite]) if finite.any() else None


def _rms_words(tracks: Sequence[SideTrack], of: Of) -> str:
    return _said("Root mean square", tracks, of, lambda values: np.sqrt(np.mean(values**2)))


def _median_words(tracks: Sequence[SideTrack], of: Of) -> str:
    return _said("Median", tracks, of, np.median)


def _said(
    head: str, tracks: Sequence[SideTrack], of: Of, statistic: Callable[[Array], np.floating[Any]]
) -> str:
    """One number (m) of each series; nothing where there is none."""
    said = [
        f"{track.name} {number_words(float(statistic(found[1])))} m"
        for track in tracks
        if (found := of(track)) is not None
    ]
    return f"{head}: {', '.join(said)}." if said else ""


def _path(analysis: Analysis, of: Callable[[AxisComparison], Any]) -> Series | None:
    """North and east (m), where both were analysed."""
    frames = {name: of(result) for name, result in analysis.axes.items()}
    north, east = frames.get("north"), frames.get("east")
    if not isinstance(north, pd.DataFrame) or not isinstance(east, pd.DataFrame):
        return None
    return north["position_m"].to_numpy(), east["position_m"].to_numpy()
