"""Terminal page of ``px4fuse whatif``: logged, replayed and changed EKF2, and the sweep."""

import math
from collections.abc import Callable
from typing import Any

from px4fuse.analysis import WhatIfAnalysis
from px4fuse.core.text import format_number
from px4fuse.ekf2.replay import HORIZONTAL
from px4fuse.ekf2.whatif import ADDED_NOISE_M, HEIGHT_TIMEOUT_S, MAX_REJECTED_SHARE, Summary
from px4fuse.filter.signals import AISLE
from px4fuse.flight.ekf2_parameters import AIDS, PARAMETERS
from px4fuse.flight.model import Unavailable
from px4fuse.report.difference_page import format_agreement, write_explanation
from px4fuse.report.page import Page

NOT_PREDICTABLE = "not predictable"
Rows = tuple[tuple[str, Callable[[Any], str]], ...]
# Label of each table row, and the function that formats its statistic of an axis or aiding source
NIS_ROWS: Rows = (
    ("{}: mean NIS", lambda summary: format_number(summary.nis_mean)),
    ("    expected", lambda summary: "{:.2f} to {:.2f}".format(*summary.nis_band)),
    ("    std of ν (m)", lambda summary: _format_number(summary.innovation_std_m)),
)
AXIS_ROWS: Rows = (
    *NIS_ROWS,
    ("    median σ_p (m)", lambda axis: _format_number(axis.sigma_p_median_m)),
    ("    position RMSE (m)", lambda axis: _format_number(axis.position_rmse_to_truth_m)),
)
HEIGHT_ROWS: Rows = (*NIS_ROWS, ("    rejected", lambda height: f"{height.rejected_fraction:.1%}"))
# Table rows with statistics of the whole replay of EKF2
OVERALL_ROWS: Rows = (
    ("samples", lambda s: f"{s.samples}"),
    ("rejected", lambda s: f"{s.rejected_fraction:.1%}"),
    ("longest time without fusion (s)", lambda s: _format_number(s.longest_without_fusion_s, 2)),
    ("position resets", lambda s: f"{s.resets}"),
)
VELOCITY_ROW = (
    "GNSS velocities rejected",
    lambda s: (
        f"{s.velocity_rejected_fraction:.1%}" if s.velocity_rejected_fraction is not None else "n/a"
    ),
)
# Table rows of replays that estimate heading and height instead of taking them from the log
HEADING_ROW = ("mean heading error (°)", lambda s: _format_number(s.heading_error_mean_deg, 1))
HEIGHT_ROW = ("height RMSE (m)", lambda s: _format_number(s.height_rmse_to_truth_m))


def column_heads(analysis: WhatIfAnalysis) -> list[str]:
    """Return the heads of the columns of EKF2: logged, replayed, replayed with changes."""
    change_texts = [
        f"{name} {format_number(value)} {PARAMETERS[name].unit}".rstrip()
        for name, value in analysis.changes.items()
    ]
    change_texts += [
        f"without {name} from {start_s:g} s" for name, start_s in analysis.without.items()
    ]
    change_text = ", ".join(change_texts)
    ml_note = " (maximum-likelihood estimate)" if analysis.uses_estimates else ""
    return [
        "logged",
        "replayed",
        *([f"replayed with {change_text}{ml_note}"] if change_text else []),
    ]


def rows(analysis: WhatIfAnalysis) -> list[list[str]]:
    """Return the table rows: label, then the statistic of the logged, replayed and changed EKF2."""
    whatif_result = analysis.whatif
    overall_rows, heights = list(OVERALL_ROWS), whatif_result.replayed.heights
    if whatif_result.replayed.velocity_rejected_fraction is not None:
        overall_rows.append(VELOCITY_ROW)
    if isinstance(whatif_result.replayed.heading_error_mean_deg, float):
        overall_rows.append(HEADING_ROW)
    if heights:
        overall_rows.append(HEIGHT_ROW)
    other_aid_updates = {**heights, **whatif_result.replayed.others}
    tables = dict.fromkeys(HORIZONTAL, AXIS_ROWS) | {"": tuple(overall_rows)}
    summaries = [
        whatif_result.logged,
        whatif_result.replayed,
        *whatif_result.whatif[: analysis.sweep_start],
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
    """Format a statistic of an axis or aiding source; the name "" stands for the whole replay."""
    if not summary.is_predictable:
        return NOT_PREDICTABLE
    statistics = {"": summary, **summary.axes, **summary.heights, **summary.others}.get(name)
    return "n/a" if statistics is None else cell(statistics)


def sweep_table(analysis: WhatIfAnalysis) -> tuple[list[str], list[list[str]]]:
    """Return the column heads, and a row of EKF2 statistics per value of the swept parameter."""
    name, rows = swept_parameter(analysis), []
    unit = PARAMETERS[name].unit
    (_, nis), _, _, (_, sigma), (_, rmse) = AXIS_ROWS
    for summary in sweep_summaries(analysis):
        cells = [NOT_PREDICTABLE, *[""] * 5]
        if summary.is_predictable:
            per_axis_cells = [
                "/".join(map(cell, summary.axes.values())) for cell in (nis, sigma, rmse)
            ]
            cells = [
                per_axis_cells[0],
                *(cell(summary) for _, cell in OVERALL_ROWS[1:]),
                *per_axis_cells[1:],
            ]
        rows.append([format_number(summary.changed[name]), *cells])
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


def sweep_summaries(analysis: WhatIfAnalysis) -> tuple[Summary, ...]:
    """Return the statistics of EKF2 replayed with each value of the swept parameter."""
    return analysis.whatif.whatif[analysis.sweep_start :]


def swept_parameter(analysis: WhatIfAnalysis) -> str:
    """Return the name of the swept parameter."""
    (name,) = sweep_summaries(analysis)[0].changed.keys() - analysis.changes.keys()
    return name


def sweep_notes(analysis: WhatIfAnalysis) -> list[str]:
    """Return sentences on the best value of the swept parameter and on the limits of the replay."""
    sentences = []
    if summaries := [summary for summary in sweep_summaries(analysis) if summary.is_predictable]:
        name = swept_parameter(analysis)
        best_summary = min(summaries, key=lambda s: abs(math.log(s.nis_mean)))
        sentences.append(
            f"The mean NIS is closest to 1 at {name} {format_number(best_summary.changed[name])} "
            f"({format_number(best_summary.nis_mean)})."
        )
        errors = {
            error: summary.changed[name]
            for summary in summaries
            if isinstance(error := summary.position_rmse_to_truth_m, float)
        }
        if errors:
            min_error_m = min(errors)
            sentences.append(
                f"The horizontal position RMSE against ground truth is smallest at {name} "
                f"{format_number(errors[min_error_m])} ({min_error_m:.3f} m)."
            )
    if not all(summary.is_predictable for summary in analysis.whatif.whatif):
        sentences.append(
            f"Not predictable: more than {MAX_REJECTED_SHARE:.0%} of the samples would "
            f"be rejected, {1000.0 * ADDED_NOISE_M:.0f} mm of position noise would change "
            f"the result, or heights would be rejected for {HEIGHT_TIMEOUT_S:g} s. The "
            "result then depends on single rejections."
        )
    return [*sentences, *(f"{note}." for note in analysis.whatif.notes)]


def _format_number(value: float | Unavailable, digits: int = 3) -> str:
    return "n/a" if isinstance(value, Unavailable) else f"{value:.{digits}f}"


def summary(analysis: WhatIfAnalysis) -> Page:
    """Make the terminal page of ``px4fuse whatif``."""
    page = Page()
    if AISLE in analysis.difference_steps:
        write_explanation(page, analysis.difference_steps[AISLE])
    log, whatif_result = analysis.flight.log, analysis.whatif
    page.write_labelled("Log", f"{log.name}, {log.firmware}, {log.duration_s:.1f} s")
    spans = ", ".join(f"{start:.1f} to {end:.1f} s" for start, end in whatif_result.evaluated_s)
    page.write_labelled("Used", f"All columns contain {spans} of the flight.")
    page.write_labelled("Replay", format_agreement(whatif_result.agreement))
    head = ["", *column_heads(analysis)]
    page.table(head, rows(analysis), right_aligned_columns=range(1, len(head)))
    if sweep_summaries(analysis):
        page.table(*sweep_table(analysis), right_aligned_columns=range(1, 7))
    for line in sweep_notes(analysis):
        page.write(line)
    page.write("Replays use px4fuse's model of EKF2, not PX4's code.")
    return page
