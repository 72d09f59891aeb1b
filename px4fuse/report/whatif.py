"""What if EKF2 had had other parameters: side by side, and a row for each value of one."""

import math
from collections.abc import Callable, Iterator
from typing import Any

from px4fuse.analysis import WhatIfAnalysis
from px4fuse.ekf2.replay import HORIZONTAL
from px4fuse.ekf2.whatif import DISTURBED_M, HEIGHT_TIMEOUT_S, MAX_REJECTED_SHARE, Summary
from px4fuse.ekf2_parameters import AIDS, PARAMETERS
from px4fuse.filter.signals import AISLE
from px4fuse.flight import Unavailable
from px4fuse.plain import format_number
from px4fuse.report import say
from px4fuse.report.page import Page
from px4fuse.report.why import format_agreement, write_explanation
from px4fuse.results.contract import WhatIfResults

SIZE = 8.0
CHAOTIC = "chaotic"
Rows = tuple[tuple[str, Callable[[Any], str]], ...]
# Of each EKF2 along an axis or by one of its aids
NIS_ROWS: Rows = (
    ("{}: mean NIS", lambda one: format_number(one.nis_mean)),
    ("    consistent is", lambda one: "{:.2f} to {:.2f}".format(*one.nis_band)),
    ("    std ν (m)", lambda one: _format_number(one.innovation_std_m)),
)
AXIS_ROWS: Rows = (
    *NIS_ROWS,
    ("    σ_p (m)", lambda axis: _format_number(axis.sigma_p_median_m)),
    ("    RMSE to truth (m)", lambda axis: _format_number(axis.position_rmse_to_truth_m)),
)
HEIGHT_ROWS: Rows = (*NIS_ROWS, ("    rejected", lambda height: f"{height.rejected_share:.1%}"))
# and over all
OVERALL_ROWS: Rows = (
    ("samples", lambda s: f"{s.samples}"),
    ("rejected", lambda s: f"{s.rejected_share:.1%}"),
    ("longest without fusion (s)", lambda s: _format_number(s.longest_without_fusion_s, 2)),
    ("position resets", lambda s: f"{s.resets}"),
)
# and where EKF2's heading and height follow what is changed
HEADING_ROW = ("heading - truth (°)", lambda s: _format_number(s.heading_error_mean_deg, 1))
HEIGHT_ROW = ("height: RMSE to truth (m)", lambda s: _format_number(s.height_rmse_to_truth_m))


def column_heads(counterfactual: WhatIfAnalysis) -> list[str]:
    """Heads of the columns of :func:`rows`."""
    change_texts = [
        f"{name} {format_number(value)} {PARAMETERS[name].unit}".rstrip()
        for name, value in counterfactual.changes.items()
    ]
    change_texts += [
        f"without {name} from {since:g} s" for name, since in counterfactual.without.items()
    ]
    changed = ", ".join(change_texts)
    ml_note = " (what the data ask for)" if counterfactual.asked else ""
    return ["as logged", "replayed", *([f"what if {changed}{ml_note}"] if changed else [])]


def rows(counterfactual: WhatIfAnalysis) -> list[list[str]]:
    """Label and one cell per EKF2: as logged, as replayed, and with the changes."""
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
    """Of one EKF2: along an axis, by one of its aids, or over all where the name is empty."""
    if not summary.steady:
        return CHAOTIC
    part = {"": summary, **summary.axes, **summary.heights, **summary.others}.get(name)
    return "n/a" if part is None else cell(part)


def sweep_table(counterfactual: WhatIfAnalysis) -> tuple[list[str], list[list[str]]]:
    """Heads, and a row per value of the sweep."""
    name, rows = swept_parameter(counterfactual), []
    unit = PARAMETERS[name].unit
    (_, nis), _, _, (_, sigma), (_, rmse) = AXIS_ROWS
    for one in sweep_summaries(counterfactual):
        cells = [CHAOTIC, *[""] * 5]
        if one.steady:
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
        "RMSE to truth N/E (m)",
    ]
    return head, rows


def sweep_summaries(counterfactual: WhatIfAnalysis) -> tuple[Summary, ...]:
    """What the values of the sweep gave."""
    return counterfactual.whatif.whatif[counterfactual.first :]


def swept_parameter(counterfactual: WhatIfAnalysis) -> str:
    """The parameter whose values are swept."""
    (name,) = sweep_summaries(counterfactual)[0].changed.keys() - counterfactual.changes.keys()
    return name


def reading(counterfactual: WhatIfAnalysis) -> list[str]:
    """What to see: which value of the sweep is best by which measure, and what to keep in mind."""
    lines = []
    if summaries := [one for one in sweep_summaries(counterfactual) if one.steady]:
        name = swept_parameter(counterfactual)
        best = min(summaries, key=lambda s: abs(math.log(s.nis_mean)))
        lines.append(
            f"Mean NIS is nearest to 1 at {name} {format_number(best.changed[name])} "
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
                say("sweep_error", name=name, value=format_number(errors[least]), least=least)
            )
    if not all(one.steady for one in counterfactual.whatif.whatif):
        lines.append(
            say(
                "chaotic",
                most=MAX_REJECTED_SHARE,
                noise_mm=1e3 * DISTURBED_M,
                for_s=HEIGHT_TIMEOUT_S,
            )
        )
    return [*lines, *(f"{note}." for note in counterfactual.whatif.notes)]


def _format_number(value: float | Unavailable, digits: int = 3) -> str:
    return "n/a" if isinstance(value, Unavailable) else f"{value:.{digits}f}"


def draw(counterfactual: WhatIfAnalysis, results: WhatIfResults) -> Iterator[Page]:
    """One page of tables."""
    page = Page("EKF2 with other parameters", say("whatif"))
    page.labelled("Command", results.provenance.command)
    _write_tables(page, counterfactual)
    yield page


def summary(counterfactual: WhatIfAnalysis) -> Page:
    """EKF2 as logged, as replayed and with other parameters, and a sweep where there is one."""
    page = Page()
    if AISLE in counterfactual.why:
        write_explanation(page, counterfactual.why[AISLE])
    _write_tables(page, counterfactual)
    page.write("Replays are of px4fuse's model of EKF2, not of PX4's own code.")
    return page


def _write_tables(page: Page, counterfactual: WhatIfAnalysis) -> None:
    """All that is said in words and numbers."""
    log, whatif_result = counterfactual.flight.log, counterfactual.whatif
    page.labelled("Log", f"{log.name}, {log.firmware}, {log.duration_s:.1f} s")
    spans = ", ".join(f"{start:.1f} to {end:.1f} s" for start, end in whatif_result.judged)
    page.labelled("Judged", spans)
    page.labelled("Replay", format_agreement(whatif_result.agreement))
    head = ["", *column_heads(counterfactual)]
    page.table(head, rows(counterfactual), right=range(1, len(head)), size=SIZE)
    if sweep_summaries(counterfactual):
        page.table(*sweep_table(counterfactual), right=range(1, 7), size=SIZE)
    for line in reading(counterfactual):
        page.write(line, size=8.5, above=2.0)
