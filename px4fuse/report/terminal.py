"""The summary on the terminal: what happened, what was compared with what, verdicts, findings."""

from px4fuse.ekf2.walk import Why
from px4fuse.findings import by_root
from px4fuse.report.aids import write_alone, write_appendix
from px4fuse.report.cover import facts, write_finding
from px4fuse.report.document import AidsDocument, Document
from px4fuse.report.page import Page
from px4fuse.report.style import MUTED
from px4fuse.report.why import write_why
from px4fuse.report.words import verdict_notes, write_errors

MOST_FINDINGS = 4
LEGEND = "Apart: ours - EKF2, RMS of position and velocity. NIS in the band: consistent."
# Of the facts on the cover those that fit on a screen
FACTS = ("Filter", "Position", "Placed", "Segment")


def summary(document: Document, report: object = None) -> Page:
    """The summary of one comparison.

    Parameters
    ----------
    document : Document
    report : Path, optional
        Where the report was written.
    """
    analysis, page = document.analysis, Page()
    for sentence in document.results.story:
        page.write(sentence)
    page.add("blank")
    log = analysis.flight.log
    names = " + ".join([log.name, *(file.name for file in analysis.flight.inputs)])
    page.labelled("Log", f"{names}, {log.firmware}, {log.duration_s:.1f} s")
    for label, text in facts(document).items():
        if label in FACTS:
            page.labelled(label, text)
    write_errors(page, document)
    for note in (LEGEND, *verdict_notes(analysis)):
        page.write(note, colour=MUTED)
    why = analysis.why.get(analysis.main.axis.name)
    is_told = isinstance(why, Why) and why.cause in document.results.story
    if why is not None and not is_told:
        write_why(page, why)
    write_appendix(page, document)
    if not document.results.findings:
        page.write("No findings.")
    groups = by_root(document.results.findings)
    for group in groups[:MOST_FINDINGS]:
        write_finding(page, group)
    if (more := len(groups) - MOST_FINDINGS) > 0:
        page.write(f"and {more} more in the report" if report else f"and {more} more")
    return page


def aids_summary(document: AidsDocument) -> Page:
    """The summary of a flight without a position source."""
    page, log = Page(), document.alone.flight.log
    page.labelled("Log", f"{log.name}, {log.firmware}, {log.duration_s:.1f} s")
    write_alone(page, document)
    return page
