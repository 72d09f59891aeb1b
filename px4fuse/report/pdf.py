"""The PDF report: pages in order, page numbers, and the results attached inside."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Mapping
from importlib import metadata
from typing import Any

from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.text import Text
from pypdf import PdfWriter

from px4fuse.report import (
    changes,
    clock,
    consistency,
    cover,
    evaluation,
    flight,
    innovations,
    loop,
    notes,
    other_axes,
    provenance,
    sensitivity,
    whatif,
    why,
)
from px4fuse.report.document import (
    ChangesDocument,
    Document,
    EvaluationDocument,
    LoopDocument,
    WhatIfDocument,
    who,
)
from px4fuse.report.seal import sealed
from px4fuse.report.style import LEFT, MUTED, RIGHT, printable, put, report_style, shorten

Report = Document | LoopDocument | WhatIfDocument | EvaluationDocument | ChangesDocument
RESULTS_NAME = "results.json"
PAGES: Mapping[type, tuple[Callable[[Any], Iterator[Figure]], ...]] = {
    Document: (
        cover.draw,
        flight.draw,
        innovations.draw,
        why.draw,
        other_axes.draw,
        consistency.draw,
        sensitivity.draw,
        clock.draw,
        loop.draw,
        notes.draw,
        provenance.draw,
    ),
    LoopDocument: (loop.draw_report, notes.draw, provenance.draw_loop),
    WhatIfDocument: (whatif.draw,),
    EvaluationDocument: (evaluation.draw,),
    ChangesDocument: (changes.draw,),
}


def render(document: Report, results_json: str) -> bytes:
    """Draw the report.

    Parameters
    ----------
    document : Document, LoopDocument, WhatIfDocument, EvaluationDocument or ChangesDocument
    results_json : str
        Attached inside the PDF as ``results.json``, so that the PDF alone can be checked.

    Returns
    -------
    bytes
        The same for the same input and the same versions: no dates, no random identifiers.
    """
    drawn = io.BytesIO()
    with report_style(_outside(document)):
        figures = [figure for draw in PAGES[type(document)] for figure in draw(document)]
        with PdfPages(
            drawn, metadata={"CreationDate": None, "Creator": None, "Producer": None}
        ) as pdf:
            for number, figure in enumerate(figures, start=1):
                _running_lines(figure, document, number, len(figures))
                _without_ligatures(figure)
                _places_of_empty_labels(figure)
                pdf.savefig(figure)
    return _attach(drawn.getvalue(), document, results_json)


def _outside(document: Report) -> str:
    """What is not px4fuse's own words."""
    student = document.student
    return "".join((document.title, student.name, student.id, student.notes, document.command))


def _running_lines(figure: Figure, document: Report, number: int, count: int) -> None:
    """Head and foot of a page: which log, whose, which version, which page."""
    name, sha256 = document.log
    style = {"size": 6.5, "color": MUTED}
    student = who(document.student, " · ")
    room = 330 if student else 500
    head = shorten(printable(f"px4fuse · {name} · SHA-256 {sha256[:12]}"), 6.5, room)
    put(figure, LEFT, 0.972, head, **style)
    if student:
        figure.text(RIGHT, 0.972, shorten(printable(student), 6.5, 170), ha="right", **style)  # type: ignore[arg-type]
    version = metadata.version("px4fuse")
    put(figure, LEFT, 0.022, f"px4fuse {version}", **style)
    figure.text(RIGHT, 0.022, f"{number} / {count}", ha="right", **style)  # type: ignore[arg-type]


def _without_ligatures(figure: Figure) -> None:
    """Draw "fi" as two letters: a ligature costs every font a second file in the PDF."""
    texts = list(figure.texts)
    legends = [*figure.legends, *(axes.get_legend() for axes in figure.axes)]
    texts += [text for legend in legends if legend is not None for text in legend.get_texts()]
    for axes in figure.axes:
        titles = [child for child in axes.get_children() if isinstance(child, Text)]
        texts += [*titles, axes.xaxis.label, axes.yaxis.label]
    for text in texts:
        text.set_fontfeatures(("-liga",))


def _places_of_empty_labels(figure: Figure) -> None:
    """Fix where labels without words stand: else the numbers beside are measured for each."""
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            if not axis.get_label_text():
                axis.set_label_coords(0.5, 0.5)


def _attach(drawn: bytes, document: Report, results_json: str) -> bytes:
    writer = PdfWriter(clone_from=io.BytesIO(drawn))
    writer.add_attachment(RESULTS_NAME, results_json.encode())
    writer.metadata = {
        "/Title": document.title,
        "/Creator": f"px4fuse {metadata.version('px4fuse')}",
    }
    out = io.BytesIO()
    writer.write(out)
    return sealed(out.getvalue())
