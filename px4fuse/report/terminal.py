"""The summary on the terminal: what happened, what was compared with what, verdicts, findings."""

from typing import Any

from px4fuse.analysis import AidsAlone, Analysis
from px4fuse.ekf2.walk import Why
from px4fuse.findings import by_root
from px4fuse.report.aids import write_alone, write_appendix
from px4fuse.report.cover import facts, write_finding
from px4fuse.report.page import Page
from px4fuse.report.style import MUTED
from px4fuse.report.why import write_why
from px4fuse.report.words import verdict_notes, write_errors

MOST_FINDINGS = 4
LEGEND = "Apart: ours - EKF2, RMS of position and velocity. NIS in the band: consistent."
# Of the facts on the cover those that fit on a screen
FACTS = ("Filter", "Position", "Placed", "Segment")


def summary(analysis: Analysis | AidsAlone, results: Any, report: object = None) -> Page:
    """The summary of one comparison, or of the aids alone of a flight without a position source.

    Parameters
    ----------
    analysis : Analysis or AidsAlone
    results : ComparisonResults or AidsResults
    report : Path, optional
        Where the report was written.
    """
    page = Page()
    log = analysis.flight.log
    if isinstance(analysis, AidsAlone):
        page.labelled("Log", f"{log.name}, {log.firmware}, {log.duration_s:.1f} s")
        write_alone(page, analysis, results.findings)
        return page
    for sentence in results.story:
        page.write(sentence)
    page.add("blank")
    names = " + ".join([log.name, *(file.name for file in analysis.flight.inputs)])
    page.labelled("Log", f"{names}, {log.firmware}, {log.duration_s:.1f} s")
    for label, text in facts(analysis).items():
        if label in FACTS:
            page.labelled(label, text)
    write_errors(page, analysis)
    for note in (LEGEND, *verdict_notes(analysis)):
        page.write(note, colour=MUTED)
    why = analysis.why.get(analysis.main.axis.name)
    is_told = isinstance(why, Why) and why.cause in results.story
    if why is not None and not is_told:
        write_why(page, why)
    write_appendix(page, analysis)
    if not results.findings:
        page.write("No findings.")
    groups = by_root(results.findings)
    for group in groups[:MOST_FINDINGS]:
        write_finding(page, group)
    if (more := len(groups) - MOST_FINDINGS) > 0:
        page.write(f"and {more} more in the report" if report else f"and {more} more")
    return page
