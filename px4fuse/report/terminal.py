"""Terminal output of ``px4fuse compare``."""

from collections.abc import Iterable
from typing import Any

from px4fuse.analysis import AidingSourceAnalysis, Analysis
from px4fuse.ekf2.steps import DifferenceExplanation

from .aids import select_aids_of_outdoor_flight, write_aids
from .card_text import (
    Paragraph,
    format_card_lines,
    make_headline,
    with_typed_path,
)
from .page import Page
from .phrases import (
    VERDICT_LEGEND,
    list_verdict_warnings,
    write_error_table,
    write_findings,
)

ERROR_LEGEND = (
    "KF-EKF2 is the RMS difference of position and velocity; RMSE is against ground truth. "
    f"{VERDICT_LEGEND}"
)


def make_comparison_page(
    analysis: Analysis | AidingSourceAnalysis,
    results: Any,
    log_path: str,
    *,
    verbose: bool = False,
    quiet: bool = False,
) -> Page:
    """Make the terminal output of ``px4fuse compare``: faults, causes and actions.

    Parameters
    ----------
    log_path : str
        Path of the log as the user typed it, for commands.
    verbose : bool
        True to add settings, statistics and all findings (detected faults).
    quiet : bool
        True for the headline only.
    """
    card = with_typed_path(results.card, log_path)
    page = make_card_page([make_headline(card)] if quiet else format_card_lines(card))
    if not verbose:
        return page
    if isinstance(analysis, AidingSourceAnalysis):
        write_aids(page, analysis.aids)
        page.write_muted_text(VERDICT_LEGEND)
        page.write_heading("Findings")
        write_findings(page, results.findings)
        if not results.findings:
            page.write("None.")
    else:
        _write_details(page, analysis, results)
    return page


def _write_details(page: Page, analysis: Analysis, results: Any) -> None:
    """Write the lines that --verbose adds: source, time span, errors and all findings."""
    source, segment = analysis.source, analysis.segment
    page.add("blank")
    page.write_labelled_text(
        "Position",
        f"{source.name}: {source.description}, {source.compute_rate_hz():.1f} Hz, "
        f"{source.frame}; {analysis.source_reason}",
    )
    page.write_labelled_text(
        "Segment", f"{segment.start_s:.2f} s to {segment.end_s:.2f} s, {segment.reason}"
    )
    write_error_table(page, analysis)
    for note in (ERROR_LEGEND, *list_verdict_warnings(analysis)):
        page.write_muted_text(note)
    explanation = analysis.difference_steps.get(analysis.main.axis.name)
    if isinstance(explanation, DifferenceExplanation):
        page.write_labelled_text("KF-EKF2", explanation.sentences[0])
    if aids := select_aids_of_outdoor_flight(analysis):
        write_aids(page, aids)
    write_findings(page, results.findings)


def make_card_page(paragraphs: Iterable[Paragraph]) -> Page:
    """Make the page with the diagnosis of a flight: fault, effect, actions and σ ratios."""
    page = Page()
    page.add("card", paragraphs=list(paragraphs))
    return page
