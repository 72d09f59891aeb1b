"""What if EKF2 had had other parameters: side by side, and over the values of one."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullLocator

from px4fuse.analysis import Counterfactual
from px4fuse.ekf2.agreement import REJECTING_SHARE
from px4fuse.ekf2.replay import HORIZONTAL
from px4fuse.ekf2.whatif import Summary
from px4fuse.ekf2_parameters import PARAMETERS
from px4fuse.flight import Unavailable
from px4fuse.plain import capital, number_words
from px4fuse.report.document import WhatIfDocument
from px4fuse.report.page import Page
from px4fuse.report.style import EKF2_BAND, EKF2_LINE, MUTED, OURS_LINE
from px4fuse.report.why import agreement_words

SIZE = 8.0
PANEL_POINTS = 80.0
MAX_TICKS = 10
WIDE = 5.0  # values that span more are drawn on a logarithmic scale


def change_words(changed: dict[str, float]) -> str:
    """Parameters with their values and units."""
    return ", ".join(
        " ".join(filter(None, (name, number_words(value), PARAMETERS[name].unit)))
        for name, value in changed.items()
    )


def heads(made_of: Counterfactual) -> list[str]:
    """Heads of the columns of :func:`rows`."""
    said = change_words(dict(made_of.changes))
    asked = " (what the data ask for)" if made_of.asked else ""
    return ["as logged", "replayed", *([f"what if {said}{asked}"] if said else [])]


def rows(made_of: Counterfactual) -> list[list[str]]:
    """Label and one cell per EKF2: as logged, as replayed, and with the changes."""
    found = made_of.whatif
    every = [found.logged, found.replayed, *(found.whatif[:1] if made_of.changes else ())]
    made = []
    for axis in HORIZONTAL:
        of = [summary.axes[axis] for summary in every]
        made.append([f"{axis}: mean NIS", *(number_words(a.nis_mean) for a in of)])
        made.append(
            ["    consistent is", *(f"{a.nis_band[0]:.2f} to {a.nis_band[1]:.2f}" for a in of)]
        )
        made.append(["    std ν (m)", *(f"{a.innovation_std_m:.3f}" for a in of)])
        made.append(["    σ_p (m)", *(_number(a.sigma_p_median_m, 3) for a in of)])
        made.append(
            ["    RMSE to truth (m)", *(_number(a.position_rmse_to_truth_m, 3) for a in of)]
        )
    made.append(["samples", *(f"{s.samples}" for s in every)])
    made.append(["rejected", *(f"{s.rejected_share:.1%}" for s in every)])
    made.append(
        ["longest without fusion (s)", *(_number(s.longest_without_fusion_s, 2) for s in every)]
    )
    made.append(["position resets", *(f"{s.resets}" for s in every)])
    return made


def sweep_heads(made_of: Counterfactual) -> list[str]:
    """Heads of the columns of :func:`sweep_rows`."""
    unit = PARAMETERS[swept(made_of)].unit
    return [
        f"{swept(made_of)}{f' ({unit})' if unit else ''}", "mean NIS N, E", "rejected",
        "longest gap (s)", "resets", "σ_p N, E (m)", "RMSE to truth N, E (m)",
    ]  # fmt: skip


def sweep_rows(made_of: Counterfactual) -> list[list[str]]:
    """One row per value of the sweep."""
    name = swept(made_of)
    made = []
    for summary in sweep_of(made_of):
        axes = [summary.axes[axis] for axis in HORIZONTAL]
        made.append(
            [
                number_words(summary.changed[name]),
                ", ".join(number_words(a.nis_mean) for a in axes),
                f"{summary.rejected_share:.1%}",
                _number(summary.longest_without_fusion_s, 2),
                f"{summary.resets}",
                ", ".join(_number(a.sigma_p_median_m, 3) for a in axes),
                ", ".join(_number(a.position_rmse_to_truth_m, 3) for a in axes),
            ]
        )
    return made


def sweep_of(made_of: Counterfactual) -> tuple[Summary, ...]:
    """What the values of the sweep gave."""
    return made_of.whatif.whatif[1 if made_of.changes else 0 :]


def swept(made_of: Counterfactual) -> str:
    """The parameter whose values are swept."""
    (name,) = sweep_of(made_of)[0].changed.keys() - made_of.changes.keys()
    return name


def reading(made_of: Counterfactual) -> list[str]:
    """What to see: which value of the sweep is best by which measure, and what to keep in mind."""
    lines = []
    if summaries := sweep_of(made_of):
        name = swept(made_of)
        best = min(summaries, key=lambda s: abs(math.log(s.nis_mean)))
        lines.append(
            f"Mean NIS is nearest to 1 at {name} {number_words(best.changed[name])} "
            f"({number_words(best.nis_mean)})."
        )
        errors = {
            error: summary.changed[name]
            for summary in summaries
            if isinstance(error := summary.position_rmse_to_truth_m, float)
        }
        if errors:
            least = min(errors)
            lines.append(
                f"The position error to the truth is least at {name} {number_words(errors[least])} "
                f"({least:.3f} m, horizontally)."
            )
    shares = [s.rejected_share for s in (made_of.whatif.replayed, *made_of.whatif.whatif)]
    if max(shares) > REJECTING_SHARE:
        lines.append(
            f"Where more than {REJECTING_SHARE:.0%} are rejected each rejection decides the next: "
            "read the size of the numbers there, not their digits."
        )
    return [*lines, *(f"{note}." for note in made_of.whatif.notes)]


def _number(value: float | Unavailable, digits: int) -> str:
    return "n/a" if isinstance(value, Unavailable) else f"{value:.{digits}f}"


def draw(document: WhatIfDocument) -> Iterator[Page]:
    """Draw one page, and another where a sweep needs it."""
    made_of = document.made_of
    log, found = made_of.flight.log, made_of.whatif
    page = Page(
        "EKF2 with other parameters",
        "EKF2 replayed from the log by px4fuse's model of it, which is not PX4's own code: as "
        "flown, and with other parameters. All columns are judged over the same times.",
    )
    for text in (
        f"{log.name}, {log.firmware}, {log.duration_s:.1f} s of data",
        document.command,
        "Judged: " + ", ".join(f"{start:.1f} to {end:.1f} s" for start, end in found.judged),
        f"Replay against log: {agreement_words(found.agreement)}.",
    ):
        page.write(text, size=7.5, colour=MUTED, above=-2.0)
    page.table(["", *heads(made_of)], rows(made_of), size=SIZE)
    for line in reading(made_of):
        page.write(line, size=8.5, above=2.0)
    if sweep_of(made_of):
        _panels(page, made_of)
        page.table(sweep_heads(made_of), sweep_rows(made_of), size=SIZE)
    yield page


def _panels(page: Page, made_of: Counterfactual) -> None:
    """Mean NIS, share rejected, and error or σ_p over the values."""
    summaries, name = sweep_of(made_of), swept(made_of)
    values = [summary.changed[name] for summary in summaries]
    panels: list[tuple[str, Callable[[Summary, str], float | Unavailable]]] = [
        ("mean NIS", lambda s, axis: s.axes[axis].nis_mean),
        ("rejected (%)", lambda s, _: 100.0 * s.rejected_share),
    ]
    if isinstance(summaries[0].position_rmse_to_truth_m, float):
        panels.append(
            ("position RMSE to truth (m)", lambda s, axis: s.axes[axis].position_rmse_to_truth_m)
        )
    else:
        panels.append(("σ_p (m)", lambda s, axis: s.axes[axis].sigma_p_median_m))
    flown = made_of.whatif.replayed
    for title, of in panels:
        axes = page.panel(capital(title), "", PANEL_POINTS)
        _panel(axes, values, [[of(s, axis) for s in summaries] for axis in HORIZONTAL])
        if title == "rejected (%)":
            axes.set_ylim(0.0, max(1.0, axes.get_ylim()[1]))
        elif axes.dataLim.ymax > WIDE * axes.dataLim.ymin:
            axes.set_yscale("log")
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.yaxis.set_major_formatter("{x:g}")
            axes.yaxis.set_minor_locator(NullLocator())
        if title == "mean NIS":
            axes.axhspan(*flown.axes["north"].nis_band, color=EKF2_BAND, lw=0)
            axes.legend(loc="upper right", ncols=2)
        if title == panels[-1][0]:
            axes.set_xlabel(f"{name} ({PARAMETERS[name].unit})" if PARAMETERS[name].unit else name)


def _panel(axes: Axes, values: list[float], lines: list[list[float | Unavailable]]) -> None:
    styles = (OURS_LINE, EKF2_LINE)
    for axis, line, style in zip(HORIZONTAL, lines, styles, strict=True):
        known = [(x, y) for x, y in zip(values, line, strict=True) if isinstance(y, float)]
        axes.plot([x for x, _ in known], [y for _, y in known], marker=".", label=axis, **style)
    if min(values) > 0.0:
        axes.set_xscale("log")
    ticks = values[:: math.ceil(len(values) / MAX_TICKS)]
    axes.set_xticks(ticks, [number_words(value) for value in ticks])
    axes.xaxis.set_minor_locator(NullLocator())
    axes.margins(x=0.02)
