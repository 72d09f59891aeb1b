"""What EKF2 fused: a page with a table and a strip of innovations for each aid."""

from collections.abc import Iterator, Mapping

import numpy as np
import pandas as pd

from px4fuse.analysis import AidsAlone, Analysis
from px4fuse.ekf2.aids import AidResult, flown
from px4fuse.findings import Finding
from px4fuse.flight import AidLog, Flight, Unavailable, at_times
from px4fuse.plain import factor_words, number_words
from px4fuse.report import say, style
from px4fuse.report.cover import about, write_findings
from px4fuse.report.marks import GROUND
from px4fuse.report.page import Cell, Page, appendix
from px4fuse.request import with_options
from px4fuse.results.contract import AidsResults

TITLE = "What EKF2 fused"
STRIP = 21.0  # points, height of the innovations of one aid
WIDEST = 4.0  # in √S; what is beyond stands at the edge
DOTS = 400  # of each axis, at most
# Horizontal aids other than external vision: with them a flight has the page in its appendix
OUTDOORS = ("gnss_pos", "gnss_vel", "optical_flow", "aux_global_position")


def draw(analysis: Analysis, _: object) -> Iterator[Page]:
    """Draw a page of the appendix where something besides external vision carried the flight."""
    page = Page(appendix(TITLE), say("aids"))
    found = write_appendix(page, analysis)
    if found:
        _strips(page, analysis.flight, found)
        yield page


def write_appendix(page: Page, analysis: Analysis) -> Mapping[str, AidResult]:
    """Write the table of a comparison's aids, and return them; of the lab's flights none."""
    found = analysis.aids
    if isinstance(found, Unavailable):
        return {}
    if all(name not in found or found[name].verdict == "idle" for name in OUTDOORS):
        return {}
    write_aids(page, found)
    return found


def draw_alone(alone: AidsAlone, results: AidsResults) -> Iterator[Page]:
    """Draw the page of a flight without a position source."""
    page = Page(TITLE, say("aids"))
    page.write(about(results.student, alone.flight.log), colour=style.MUTED)
    write_alone(page, alone, results.findings)
    _strips(page, alone.flight, alone.aids)
    yield page


def write_alone(page: Page, alone: AidsAlone, findings: tuple[Finding, ...]) -> None:
    """Write why there is no comparison, the table and the findings."""
    lacking = alone.lacking
    page.write(f"Our filter has nothing to compare with EKF2: {lacking.reason}.", above=2.0)
    page.write(with_options(lacking.remedy), colour=style.MUTED)
    write_aids(page, alone.aids)
    write_findings(page, findings)


def write_aids(page: Page, aids: Mapping[str, AidResult]) -> None:
    """Write a table with a row for each aid and axis; what EKF2 never fused is named below."""
    rows: list[list[Cell]] = []
    for aid in aids.values():
        if aid.verdict == "idle":
            continue
        meant = "" if aid.intended_share is None else f"{aid.intended_share:.0%}"
        noise = "" if aid.noise is None else f"{number_words(aid.noise)} {aid.unit}"
        colour = style.GOOD if aid.verdict == "consistent" else style.MUTED
        if aid.is_bad:
            colour = style.SEVERITY_COLOURS["warning"]
        begun: list[Cell] = [
            aid.label,
            (aid_verdict_words(aid), colour),
            meant,
            f"{aid.rejected_share:.1%}",
            f"{aid.longest_without:.1f}",
            noise,
        ]
        for name, axis in aid.axes.items():
            low, high = axis.nis_band
            rows.append(
                [
                    *begun,
                    name,
                    f"{axis.samples}",
                    number_words(axis.nis_mean),
                    f"{low:.2f} – {high:.2f}",
                    f"{axis.pull:+.2f}",
                ]
            )
            begun = [""] * len(begun)
        if not aid.axes:
            rows.append([*begun, *[""] * 5])
    page.table(
        [
            "aid",
            "verdict",
            "meant",
            "rejec-\nted",
            "longest\nwithout (s)",
            "√R",
            "axis",
            "n",
            "mean\nNIS",
            "95 %\nband",
            "mean\nν/√S",
        ],
        rows,
        right=(2, 3, 4, 5, 7, 8, 10),
        size=6.8,
    )
    idle = [aid.label for aid in aids.values() if aid.verdict == "idle"]
    if idle:
        page.write(
            f"Logged but never fused in flight: {', '.join(idle)}.", colour=style.MUTED, size=7.0
        )


def aid_verdict_words(aid: AidResult) -> str:
    """The verdict on an aid in a few words, with its factor in σ."""
    if not aid.verdict.startswith("variance"):
        return aid.verdict
    factor = max(aid.nis_mean, 1.0 / aid.nis_mean) ** 0.5
    return f"{aid.verdict.removeprefix('variance ')} {factor_words(factor)}× in σ"


def _strips(page: Page, flight: Flight, aids: Mapping[str, AidResult]) -> None:
    """Innovations over √S of each aid that was fused, one below the other."""
    span = flown(flight)
    if isinstance(flight.ekf2, Unavailable) or isinstance(span, Unavailable):
        return
    shown = [name for name, aid in aids.items() if aid.verdict != "idle"]
    page.heading("Innovations over √S, all axes of an aid", above=8.0)
    page.numbers(say("strips", most=WIDEST))
    for name in shown:
        _strip(page, aids[name], flight.ekf2.aids[name], span, last=name == shown[-1])


def _strip(
    page: Page, aid: AidResult, log: AidLog, span: tuple[float, float], *, last: bool
) -> None:
    samples = log.samples.loc[span[0] : span[1]]
    axes = page.panel(aid.label, "", STRIP, above=1.0)
    fused = samples["fused"].to_numpy() > 0.0 if "fused" in samples else np.ones(len(samples), bool)
    for axis in log.axes:
        value = samples[f"innovation_{axis}"] / np.sqrt(samples[f"variance_{axis}"])
        size = value.clip(-WIDEST, WIDEST).to_numpy()
        for which, look in ((fused, style.EKF2_DOTS), (~fused, style.EKF2_REJECTED)):
            if which.any():
                dots = style.thin(samples.index.to_numpy()[which], size[which], DOTS)
                axes.plot(*dots, **look | {"ms": 1.4})
    for level in (-2.0, 2.0):
        axes.axhline(level, color="black", lw=0.4, ls=(0, (1, 1.5)))
    if log.meant is not None:
        grid = np.linspace(*span, 2000)
        off = at_times(log.meant, pd.Index(grid)) <= 0.0
        if off.any():
            axes.fill_between(grid, -WIDEST, WIDEST, where=off.tolist(), zorder=0.1, **GROUND)
    axes.set(xlim=span, ylim=(-1.1 * WIDEST, 1.1 * WIDEST), yticks=(-2.0, 2.0))
    style.time_axis(axes, last)
