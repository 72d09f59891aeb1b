"""Terminal tables of ``px4fuse whatif``: EKF2 side by side, and a row per value of the sweep."""

import math
from collections.abc import Callable
from typing import Any

from px4fuse.analysis import Counterfactual
from px4fuse.ekf2.replay import HORIZONTAL
from px4fuse.ekf2.whatif import DISTURBED_M, HEIGHT_TIMEOUT_S, MOST_REJECTED, Summary
from px4fuse.ekf2_parameters import AIDS, PARAMETERS
from px4fuse.filter.signals import AISLE
from px4fuse.flight import Unavailable
from px4fuse.plain import number_words
from px4fuse.report import say
from px4fuse.report.page import Page
from px4fuse.report.why import agreement_words, write_why

CHAOTIC = "chaotic"
Rows = tuple[tuple[str, Callable[[Any], str]], ...]
# Of each EKF2 along an axis or by one of its aids
NIS_ROWS: Rows = (
    ("{}: mean NIS", lambda one: number_words(one.nis_mean)),
    ("    consistent is", lambda one: "{:.2f} to {:.2f}".format(*one.nis_band)),
    ("    std ν (m)", lambda one: _number(one.innovation_std_m)),
)
AXIS_ROWS: Rows = (
    *NIS_ROWS,
    ("    σ_p (m)", lambda axis: _number(axis.sigma_p_median_m)),
    ("    RMSE to truth (m)", lambda axis: _number(axis.position_rmse_to_truth_m)),
)
HEIGHT_ROWS: Rows = (*NIS_ROWS, ("    rejected", lambda height: f"{height.rejected_share:.1%}"))
# and over all
ROWS: Rows = (
    ("samples", lambda s: f"{s.samples}"),
    ("rejected", lambda s: f"{s.rejected_share:.1%}"),
    ("longest without fusion (s)", lambda s: _number(s.longest_without_fusion_s, 2)),
    ("position resets", lambda s: f"{s.resets}"),
)
# and where EKF2's heading and height follow what is changed
HEADING_ROW = ("heading - truth (°)", lambda s: _number(s.heading_error_mean_deg, 1))
HEIGHT_ROW = ("height: RMSE to truth (m)", lambda s: _number(s.height_rmse_to_truth_m))


def heads(made_of: Counterfactual) -> list[str]:
    """Heads of the columns of :func:`rows`."""
    parts = [
        f"{name} {number_words(value)} {PARAMETERS[name].unit}".rstrip()
        for name, value in made_of.changes.items()
    ]
    parts += [f"without {name} from {since:g} s" for name, since in made_of.without.items()]
    changed = ", ".join(parts)
    asked = " (what the data ask for)" if made_of.asked else ""
    return ["as logged", "replayed", *([f"what if {changed}{asked}"] if changed else [])]


def rows(made_of: Counterfactual) -> list[list[str]]:
    """Label and one cell per EKF2: as logged, as replayed, and with the changes."""
    found = made_of.whatif
    over_all, heights = list(ROWS), found.replayed.heights
    if isinstance(found.replayed.heading_error_mean_deg, float):
        over_all.append(HEADING_ROW)
    if heights:
        over_all.append(HEIGHT_ROW)
    besides = {**heights, **found.replayed.others}
    tables = dict.fromkeys(HORIZONTAL, AXIS_ROWS) | {"": tuple(over_all)}
    every = [found.logged, found.replayed, *found.whatif[: made_of.first]]
    return [
        [
            label.format(AIDS[name].label if name in besides else name),
            *(_cell(summary, name, cell) for summary in every),
        ]
        for name, table in (tables | dict.fromkeys(besides, HEIGHT_ROWS)).items()
        for label, cell in table
    ]


def _cell(summary: Summary, name: str, cell: Callable[[Any], str]) -> str:
    """Of one EKF2: along an axis, by one of its aids, or over all where the name is empty."""
    if not summary.steady:
        return CHAOTIC
    part = {"": summary, **summary.axes, **summary.heights, **summary.others}.get(name)
    return "n/a" if part is None else cell(part)


def sweep_table(made_of: Counterfactual) -> tuple[list[str], list[list[str]]]:
    """Heads, and a row per value of the sweep."""
    name, rows = swept(made_of), []
    unit = PARAMETERS[name].unit
    (_, nis), _, _, (_, sigma), (_, rmse) = AXIS_ROWS
    for one in sweep_of(made_of):
        cells = [CHAOTIC, *[""] * 5]
        if one.steady:
            both = ["/".join(map(cell, one.axes.values())) for cell in (nis, sigma, rmse)]
            cells = [both[0], *(cell(one) for _, cell in ROWS[1:]), *both[1:]]
        rows.append([number_words(one.changed[name]), *cells])
    head = [
        f"{name} ({unit})" if unit else name,
        "mean NIS N/E",
        "rejected",
        "longest gap (s)",
        "resets",
        "σ_p N/E (m)",
        "RMSE to truth N/E (m)",
    ]
    return head, rows


def sweep_of(made_of: Counterfactual) -> tuple[Summary, ...]:
    """What the values of the sweep gave."""
    return made_of.whatif.whatif[made_of.first :]


def swept(made_of: Counterfactual) -> str:
    """The parameter whose values are swept."""
    (name,) = sweep_of(made_of)[0].changed.keys() - made_of.changes.keys()
    return name


def reading(made_of: Counterfactual) -> list[str]:
    """What to see: which value of the sweep is best by which measure, and what to keep in mind."""
    lines = []
    if summaries := [one for one in sweep_of(made_of) if one.steady]:
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
                say("sweep_error", name=name, value=number_words(errors[least]), least=least)
            )
    if not all(one.steady for one in made_of.whatif.whatif):
        lines.append(
            say("chaotic", most=MOST_REJECTED, noise_mm=1e3 * DISTURBED_M, for_s=HEIGHT_TIMEOUT_S)
        )
    return [*lines, *(f"{note}." for note in made_of.whatif.notes)]


def _number(value: float | Unavailable, digits: int = 3) -> str:
    return "n/a" if isinstance(value, Unavailable) else f"{value:.{digits}f}"


def summary(made_of: Counterfactual) -> Page:
    """EKF2 as logged, as replayed and with other parameters, and a sweep where there is one."""
    page = Page()
    if AISLE in made_of.why:
        write_why(page, made_of.why[AISLE])
    log, found = made_of.flight.log, made_of.whatif
    page.labelled("Log", f"{log.name}, {log.firmware}, {log.duration_s:.1f} s")
    spans = ", ".join(f"{start:.1f} to {end:.1f} s" for start, end in found.judged)
    page.labelled("Judged", spans)
    page.labelled("Replay", agreement_words(found.agreement))
    head = ["", *heads(made_of)]
    page.table(head, rows(made_of), right=range(1, len(head)))
    if sweep_of(made_of):
        page.table(*sweep_table(made_of), right=range(1, 7))
    for line in reading(made_of):
        page.write(line)
    page.write("Replays are of px4fuse's model of EKF2, not of PX4's own code.")
    return page
