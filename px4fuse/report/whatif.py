"""What if EKF2 had had other parameters: side by side, and a row for each value of one."""

import math
from collections.abc import Callable, Iterator

from px4fuse.analysis import Counterfactual
from px4fuse.ekf2.replay import HORIZONTAL
from px4fuse.ekf2.whatif import (
    DISTURBED_M,
    HEIGHT_TIMEOUT_S,
    MOST_REJECTED,
    HeightSummary,
    Summary,
)
from px4fuse.ekf2_parameters import AIDS, PARAMETERS
from px4fuse.filter.signals import AISLE
from px4fuse.flight import Unavailable
from px4fuse.plain import number_words
from px4fuse.report.document import WhatIfDocument
from px4fuse.report.page import Page
from px4fuse.report.why import agreement_words, write_why

SIZE = 8.0
CHAOTIC = "chaotic"
# Of each EKF2 along an axis
AXIS_ROWS: tuple[tuple[str, Callable[[Summary, str], str]], ...] = (
    ("{}: mean NIS", lambda s, axis: number_words(s.axes[axis].nis_mean)),
    ("    consistent is", lambda s, axis: "{:.2f} to {:.2f}".format(*s.axes[axis].nis_band)),
    ("    std ν (m)", lambda s, axis: _number(s.axes[axis].innovation_std_m)),
    ("    σ_p (m)", lambda s, axis: _number(s.axes[axis].sigma_p_median_m)),
    ("    RMSE to truth (m)", lambda s, axis: _number(s.axes[axis].position_rmse_to_truth_m)),
)
# and over both
ROWS: tuple[tuple[str, Callable[[Summary], str]], ...] = (
    ("samples", lambda s: f"{s.samples}"),
    ("rejected", lambda s: f"{s.rejected_share:.1%}"),
    ("longest without fusion (s)", lambda s: _number(s.longest_without_fusion_s, 2)),
    ("position resets", lambda s: f"{s.resets}"),
)
# and where EKF2's heading follows what is changed
HEADING_ROW = ("heading - truth (°)", lambda s: _number(s.heading_error_mean_deg, 1))
# and its height: of each sensor, and over all
HEIGHT_ROWS: tuple[tuple[str, Callable[[HeightSummary], str]], ...] = (
    ("{}: mean NIS", lambda s: number_words(s.nis_mean)),
    ("    consistent is", lambda s: "{:.2f} to {:.2f}".format(*s.nis_band)),
    ("    std ν (m)", lambda s: _number(s.innovation_std_m)),
    ("    rejected", lambda s: f"{s.rejected_share:.1%}"),
)
HEIGHT_ROW = ("height: RMSE to truth (m)", lambda s: _number(s.height_rmse_to_truth_m))


def _named(name: str) -> str:
    """A parameter with its unit in brackets."""
    unit = PARAMETERS[name].unit
    return f"{name} ({unit})" if unit else name


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
    every = [found.logged, found.replayed, *found.whatif[: made_of.first]]
    made = [
        [label.format(axis), *(cell(s, axis) if s.steady else CHAOTIC for s in every)]
        for axis in HORIZONTAL
        for label, cell in AXIS_ROWS
    ]
    follows = isinstance(found.replayed.heading_error_mean_deg, float)
    heights = found.replayed.heights
    more = [*([HEADING_ROW] if follows else []), *([HEIGHT_ROW] if heights else [])]
    made += [
        [label, *(cell(s) if s.steady else CHAOTIC for s in every)]
        for label, cell in (*ROWS, *more)
    ]
    return made + [
        [label.format(AIDS[name].label),
         *(CHAOTIC if not s.steady else cell(s.heights[name]) if name in s.heights else "n/a"
           for s in every)]
        for name in heights
        for label, cell in HEIGHT_ROWS
    ]  # fmt: skip


def sweep_heads(made_of: Counterfactual) -> list[str]:
    """Heads of the columns of :func:`sweep_rows`."""
    return [
        _named(swept(made_of)), "mean NIS N/E", "rejected", "longest gap (s)", "resets",
        "σ_p N/E (m)", "RMSE to truth N/E (m)",
    ]  # fmt: skip


def sweep_rows(made_of: Counterfactual) -> list[list[str]]:
    """One row per value of the sweep."""
    name = swept(made_of)
    return [
        [
            number_words(summary.changed[name]),
            *([CHAOTIC] + [""] * 5 if not summary.steady else _sweep_cells(summary)),
        ]
        for summary in sweep_of(made_of)
    ]


def _sweep_cells(summary: Summary) -> list[str]:
    nis, _, _, sigma, rmse = (cell for _, cell in AXIS_ROWS)
    return [
        "/".join(nis(summary, axis) for axis in HORIZONTAL),
        *(cell(summary) for _, cell in ROWS[1:]),
        *("/".join(cell(summary, axis) for axis in HORIZONTAL) for cell in (sigma, rmse)),
    ]


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
                f"The position error to the truth is least at {name} {number_words(errors[least])} "
                f"({least:.3f} m, horizontally)."
            )
    if not all(one.steady for one in made_of.whatif.whatif):
        lines.append(
            f"Chaotic: more than {MOST_REJECTED:.0%} would be rejected, or "
            f"{1e3 * DISTURBED_M:.0f} mm of noise on the positions changes the answer, or heights "
            f"would be rejected for {HEIGHT_TIMEOUT_S:g} s on end. Each rejection decides the next "
            "there, and nothing can be predicted."
        )
    return [*lines, *(f"{note}." for note in made_of.whatif.notes)]


def _number(value: float | Unavailable, digits: int = 3) -> str:
    return "n/a" if isinstance(value, Unavailable) else f"{value:.{digits}f}"


def draw(document: WhatIfDocument) -> Iterator[Page]:
    """One page of tables."""
    page = Page(
        "EKF2 with other parameters",
        "EKF2 replayed from the log by px4fuse's model of it, which is not PX4's own code: as "
        "flown, and with other parameters. All columns are judged over the same times.",
    )
    page.labelled("Command", document.results.provenance.command)
    _tables(page, document.made_of)
    yield page


def summary(made_of: Counterfactual) -> Page:
    """EKF2 as logged, as replayed and with other parameters, and a sweep where there is one."""
    page = Page()
    if AISLE in made_of.why:
        write_why(page, made_of.why[AISLE])
    _tables(page, made_of)
    page.write("Replays are of px4fuse's model of EKF2, not of PX4's own code.")
    return page


def _tables(page: Page, made_of: Counterfactual) -> None:
    """All that is said in words and numbers."""
    log, found = made_of.flight.log, made_of.whatif
    page.labelled("Log", f"{log.name}, {log.firmware}, {log.duration_s:.1f} s")
    spans = ", ".join(f"{start:.1f} to {end:.1f} s" for start, end in found.judged)
    page.labelled("Judged", spans)
    page.labelled("Replay", agreement_words(found.agreement))
    head = ["", *heads(made_of)]
    page.table(head, rows(made_of), right=range(1, len(head)), size=SIZE)
    if sweep_of(made_of):
        page.table(sweep_heads(made_of), sweep_rows(made_of), right=range(1, 7), size=SIZE)
    for line in reading(made_of):
        page.write(line, size=8.5, above=2.0)
