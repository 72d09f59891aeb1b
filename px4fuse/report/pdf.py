"""PDF report with the results attached."""

from collections.abc import Callable, Iterator, Mapping
from importlib import metadata
from typing import Any

from px4fuse.core.memory import release_free_memory
from px4fuse.core.text import shorten_to_line
from px4fuse.results import contract
from px4fuse.results.model import NO_STUDENT

from . import (
    aids,
    clock,
    consistency,
    cover,
    difference_page,
    evaluation,
    flight,
    loop,
    notes,
    provenance,
)
from .page import Page, replace_unprintable, to_typst_data
from .style import apply_report_style
from .typesetting import compile_pdf

RESULTS_NAME = "results.json"
# Functions that draw the pages of a report, by type of results
PAGE_FUNCTIONS_BY_RESULTS_TYPE: Mapping[type, tuple[Callable[[Any, Any], Iterator[Page]], ...]] = {
    contract.ComparisonResults: (
        cover.draw_pages,
        flight.draw_pages,
        flight.draw_innovations,
        difference_page.draw_pages,
        flight.draw_other_axes,
        consistency.draw_pages,
        clock.draw_pages,
        aids.draw_pages,
        loop.draw_pages,
        notes.draw_pages,
        provenance.draw_pages,
    ),
    contract.AidsResults: (
        cover.draw_pages,
        aids.draw_pages,
        notes.draw_pages,
        provenance.draw_pages,
    ),
    contract.LoopResults: (loop.draw_report, notes.draw_pages, provenance.draw_loop_provenance),
    contract.EvaluationResults: (evaluation.draw_pages,),
}


def render_pdf(content: Any, results: Any, results_json: str) -> bytes:
    """Draw all pages of a report and typeset them as PDF.

    The PDF is reproducible: it contains no dates and no random identifiers.

    Parameters
    ----------
    content : Analysis, AidingSourceAnalysis, Loop or Evaluation
        Data for the figures.
    results : Results
        Data for the texts.
    results_json : str
        Results that are attached to the PDF as ``results.json``.
    """
    title = results.provenance.command
    match results:
        case contract.LoopResults():
            source = results.track
        case contract.EvaluationResults():
            source = results.estimate
        case _:
            source = results.log
    blocks = list[Any]()
    with apply_report_style():
        # Converting each page immediately saves memory
        for draw in PAGE_FUNCTIONS_BY_RESULTS_TYPE[type(results)]:
            for page in draw(content, results):
                blocks += to_typst_data(page.blocks, source.name)
    producer = f"px4fuse {metadata.version('px4fuse')}"
    student = getattr(results, "student", NO_STUDENT)
    student_text = ", ".join(filter(None, (student.name, student.id)))
    release_free_memory()  # before Typst starts
    return compile_pdf(
        {
            "title": title,
            "author": producer,
            "head": shorten_to_line(
                replace_unprintable(f"px4fuse · {source.name} · SHA-256 {source.sha256[:12]}"), 90
            ),
            "student": shorten_to_line(replace_unprintable(student_text), 40),
            "blocks": blocks,
            "results": results_json,
        }
    )
