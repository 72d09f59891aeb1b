"""Terminal page of ``px4fuse whatif``: logged, replayed and changed EKF2, and the sweep."""

import math
from collections.abc import Callable
from typing import Any

from px4fuse.analysis import WhatIfAnalysis
from px4fuse.ekf2.replay import HORIZONTAL
from px4fuse.ekf2.whatif import DISTURBANCE_M, HEIGHT_TIMEOUT_S, MAX_REJECTED_SHARE, Summary
from px4fuse.ekf2_parameters import AIDS, PARAMETERS
from px4fuse.filter.signals import AISLE
from px4fuse.flight import Unavailable
from px4fuse.report.difference_page import format_agreement, write_explanation
from px4fuse.report.page import Page
from px4fuse.text import format_number

NOT_PREDICTABLE = "not predictable"
Rows = tuple[tuple[str, Callable[[Any], str]], ...]
# Label and cell text of each row: statistics of an axis or of an aid
NIS_ROWS: Rows = (
    ("{}: mean NIS", lambda one: format_number(one.nis_mean)),
    ("    expected", lambda one: "{:.2f} to {:.2f}".format(*one.nis_band)),
    ("    std of ν (m)", lambda one: _format_number(one.innovation_std_m)),
)
AXIS_ROWS: Rows = (
    *NIS_ROWS,
    ("    median σ_p (m)", lambda axis: _format_number(axis.sigma_p_median_m)),
    ("    position RMSE (m)", lambda axis: _format_number(axis.position_rmse_to_truth_m)),
)
HEIGHT_ROWS: Rows = (*NIS_ROWS, ("    rejected", lambda height: f"{height.rejected_fraction:.1%}"))
# statistics of the whole replay
OVERALL_ROWS: Rows = (
    ("samples", lambda s: f"{s.samples}"),
    ("rejected", lambda s: f"{s.rejected_fraction:.1%}"),
    ("longest time without fusion (s)", lambda s: _format_number(s.longest_without_fusion_s, 2)),
    ("position resets", lambda s: f"{s.resets}"),
)
# only if the replay estimates heading and height itself
HEADING_ROW = ("mean heading error (°)", lambda s: _format_number(s.heading_error_mean_deg, 1))
HEIGHT_ROW = ("height RMSE (m)", lambda s: _format_number(s.height_rmse_to_truth_m))


def column_heads(counterfactual: WhatIfAnalysis) -> list[str]:
    """Return the column heads of :func:`rows`."""
    change_texts = [
        f"{name} {format_number(value)} {PARAMETERS[name].unit}".rstrip()
        for name, value in counterfactual.changes.items()
    ]
    change_texts += [
        f"without {name} from {since:g} s" for name, since in counterfactual.without.items()
    ]
    changed = ", ".join(change_texts)
    ml_note = " (maximum-likelihood estimate)" if counterfactual.asked else ""
    return ["logged", "replayed", *([f"replayed with {changed}{ml_note}"] if changed else [])]


def rows(counterfactual: WhatIfAnalysis) -> list[list[str]]:
    """Return table rows: a label, then the cells of the logged, replayed and changed EKF2."""
    whatif_result = counterfactual.whatif
    overall_rows, heights = list(OVERALL_ROWS), whatif_result.replayed.heights
    if isinstance(whatif_result.replayed.heading_error_mean_deg, float):
        overall_rows.append(HEADING_ROW)
    if heights:
        overall_rows.append(HEIGHT_ROW)
    other_aid_updates = {**heights, **whatif_result.replayed.others}
    tables = dict.fromkeys(HORIZONTAL, AXIS_ROWS) | {"": tuple(overall_rows)}
    summaries = [
        whatif_result.logged,
        whatif_result.replayed,
        *whatif_result.whatif[: counterfactual.first],
    ]
    return [
        [
            label.format(AIDS[name].label if name in other_aid_updates else name),
            *(_format_cell(summary, name, cell) for summary in summaries),
        ]
        for name, table in (tables | dict.fromkeys(other_aid_updates, HEIGHT_ROWS)).items()
        for label, cell in table
    ]


def _format_cell(summary: Summary, name: str, cell: Callable[[Any], str]) -> str:
    """Format a statistic of an axis or aid; the name "" stands for the whole replay."""
    if not summary.is_predictable:
        return NOT_PREDICTABLE
    part = {"": summary, **summary.axes, **summary.heights, **summary.others}.get(name)
    return "n/a" if part is None else cell(part)


def sweep_table(counterfactual: WhatIfAnalysis) -> tuple[list[str], list[list[str]]]:
    """Return column heads and a row per value of the sweep."""
    name, rows = swept_parameter(counterfactual), []
    unit = PARAMETERS[name].unit
    (_, nis), _, _, (_, sigma), (_, rmse) = AXIS_ROWS
    for one in sweep_summaries(counterfactual):
        cells = [NOT_PREDICTABLE, *[""] * 5]
        if one.is_predictable:
            per_axis_cells = ["/".join(map(cell, one.axes.values())) for cell in (nis, sigma, rmse)]
            cells = [
                per_axis_cells[0],
                *(cell(one) for _, cell in OVERALL_ROWS[1:]),
                *per_axis_cells[1:],
            ]
        rows.append([format_number(one.changed[name]), *cells])
    head = [
        f"{name} ({unit})" if unit else name,
        "mean NIS N/E",
        "rejected",
        "longest gap (s)",
        "resets",
        "σ_p N/E (m)",
        "RMSE N/E (m)",
    ]
    return head, rows


def sweep_summaries(counterfactual: WhatIfAnalysis) -> tuple[Summary, ...]:
    """Return the summaries of the sweep."""
    return counterfactual.whatif.whatif[counterfactual.first :]


def swept_parameter(counterfactual: WhatIfAnalysis) -> str:
    """Return the name of the swept parameter."""
    (name,) = sweep_summaries(counterfactual)[0].changed.keys() - counterfactual.changes.keys()
    return name


def reading(counterfactual: WhatIfAnalysis) -> list[str]:
    """Return notes on the best values of the sweep and on the limits of the replay."""
    lines = []
    if summaries := [one for one in sweep_summaries(counterfactual) if one.is_predictable]:
        name = swept_parameter(counterfactual)
        best = min(summaries, key=lambda s: abs(math.log(s.nis_mean)))
        lines.append(
            f"The mean NIS is closest to 1 at {name} {format_number(best.changed[name])} "
            f"({format_number(best.nis_mean)})."
        )
        errors = {
            error: summary.changed[name]
            for summary in summaries
            if isinstance(error := summary.position_rmse_to_truth_m, float)
        }
        if errors:
            least = min(errors)
            lines.append(
                f"The horizontal position RMSE against ground truth is smallest at {name} "
                f"{format_number(errors[least])} ({least:.3f} m)."
            )
    if not all(one.is_predictable for one in counterfactual.whatif.whatif):
        lines.append(
            f"Not predictable: more than {MAX_REJECTED_SHARE:.0%} of the samples would "
            f"be rejected, {1000.0 * DISTURBANCE_M:.0f} mm of position noise would change "
            f"the result, or heights would be rejected for {HEIGHT_TIMEOUT_S:g} s. Each "
            "rejection then decides the next."
        )
    return [*lines, *(f"{note}." for note in counterfactual.whatif.notes)]


def _format_number(value: float | Unavailable, digits: int = 3) -> str:
    return "n/a" if isinstance(value, Unavailable) else f"{value:.{digits}f}"


def summary(counterfactual: WhatIfAnalysis) -> Page:
    """Make the terminal page of ``px4fuse whatif``."""
    page = Page()
    if AISLE in counterfactual.difference_steps:
        write_explanation(page, counterfactual.difference_steps[AISLE])
    log, whatif_result = counterfactual.flight.log, counterfactual.whatif
    page.labelled("Log", f"{log.name}, {log.firmware}, {log.duration_s:.1f} s")
    spans = ", ".join(f"{start:.1f} to {end:.1f} s" for start, end in whatif_result.evaluated_s)
    page.labelled("Used", f"{spans} of the flight, in all columns")
    page.labelled("Replay", format_agreement(whatif_result.agreement))
    head = ["", *column_heads(counterfactual)]
    page.table(head, rows(counterfactual), right=range(1, len(head)))
    if sweep_summaries(counterfactual):
        page.table(*sweep_table(counterfactual), right=range(1, 7))
    for line in reading(counterfactual):
        page.write(line)
    page.write("Replays use px4fuse's model of EKF2, not PX4's code.")
    return page
