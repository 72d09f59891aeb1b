"""Output of ``px4fuse compare`` on the terminal: the diagnosis card, and details with ``-v``."""

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

ERROR_LEGEND = (
    "KF-EKF2: RMS difference of position and velocity. RMSE: against ground truth. Consistent: "
    "σ ratio 0.8 to 1.25, or its 95 % interval contains 1."
)


def summary(
    analysis: Analysis | AidsOnlyAnalysis,
    results: Any,
    *,
    verbose: bool = False,
    quiet: bool = False,
) -> Page:
    """Make the terminal page of a comparison, or of a flight without a position source.

    Parameters
    ----------
    analysis : Analysis or AidsOnlyAnalysis
    results : ComparisonResults or AidsResults
    verbose : bool
        Add the table of axes, the settings and all findings with their consequences.
    quiet : bool
        Print the headline only.
    """
    page = Page()
    if isinstance(analysis, AidsOnlyAnalysis):
        log = analysis.flight.log
        page.write_labelled("Log", f"{log.name}, {log.firmware}, {log.duration_s:.1f} s")
        write_aids_only(page, analysis, results.findings)
        return page
    page.add("card", card=results.card, headline_only=quiet)
    if verbose:
        _write_details(page, analysis, results)
    return page


def _write_details(page: Page, analysis: Analysis, results: Any) -> None:
    """Write what the card leaves out."""
    page.add("blank")
    page.write_labelled_texts(facts(analysis))
    write_errors(page, analysis)
    for note in (ERROR_LEGEND, *verdict_notes(analysis)):
        page.write(note, colour=MUTED_COLOUR)
    explanation = analysis.difference_steps.get(analysis.main.axis.name)
    if isinstance(explanation, DifferenceExplanation):
        write_explanation(page, explanation)
    write_aids_of_comparison(page, analysis)
    for group in group_by_root(results.findings):
        write_finding(page, group)
