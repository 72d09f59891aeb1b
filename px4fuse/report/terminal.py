"""Summary of a comparison on the terminal: result, inputs, verdicts and findings."""

from typing import Any

from px4fuse.analysis import AidsOnlyAnalysis, Analysis
from px4fuse.ekf2.steps import DifferenceExplanation
from px4fuse.findings import group_by_root
from px4fuse.report.aids import write_aids_of_comparison, write_aids_only
from px4fuse.report.cover import facts, write_finding
from px4fuse.report.difference_page import write_explanation
from px4fuse.report.page import Page
from px4fuse.report.phrases import verdict_notes, write_errors
from px4fuse.report.style import MUTED_COLOUR

MAX_FINDINGS = 4
ERROR_LEGEND = (
    "KF-EKF2: RMS difference of position and velocity. RMSE: against ground truth. Consistent: "
    "mean NIS within its 95 % band."
)
# Labels of the cover's facts that the terminal prints too
TERMINAL_FACTS = ("Filter", "Position", "Aligned", "Segment")


def summary(analysis: Analysis | AidsOnlyAnalysis, results: Any, report: object = None) -> Page:
    """Make the terminal page of a comparison, or of EKF2's aids without a position source.

    Parameters
    ----------
    analysis : Analysis or AidsOnlyAnalysis
    results : ComparisonResults or AidsResults
    report : Path, optional
        Path of the written report.
    """
    page = Page()
    log = analysis.flight.log
    if isinstance(analysis, AidsOnlyAnalysis):
        page.write_labelled("Log", f"{log.name}, {log.firmware}, {log.duration_s:.1f} s")
        write_aids_only(page, analysis, results.findings)
        return page
    for sentence in results.summary:
        page.write(sentence)
    page.add("blank")
    names = " + ".join([log.name, *(file.name for file in analysis.flight.inputs)])
    page.write_labelled("Log", f"{names}, {log.firmware}, {log.duration_s:.1f} s")
    for label, text in facts(analysis).items():
        if label in TERMINAL_FACTS:
            page.write_labelled(label, text)
    write_errors(page, analysis)
    for note in (ERROR_LEGEND, *verdict_notes(analysis)):
        page.write(note, colour=MUTED_COLOUR)
    explanation = analysis.difference_steps.get(analysis.main.axis.name)
    is_in_summary = (
        isinstance(explanation, DifferenceExplanation) and explanation.cause in results.summary
    )
    if explanation is not None and not is_in_summary:
        write_explanation(page, explanation)
    write_aids_of_comparison(page, analysis)
    if not results.findings:
        page.write("Findings: none.")
    groups = group_by_root(results.findings)
    for group in groups[:MAX_FINDINGS]:
        write_finding(page, group)
    if (more_count := len(groups) - MAX_FINDINGS) > 0:
        place = " in the report" if report else ""
        noun = "finding" if more_count == 1 else "findings"
        page.write(f"{more_count} more {noun}{place}.")
    return page
