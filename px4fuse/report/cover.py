"""First page of a report: diagnosis card (faults, causes and actions), and plots."""

from collections.abc import Iterator
from typing import Any

from msgspec import structs

from px4fuse.analysis import AidingSourceAnalysis, Analysis
from px4fuse.card.model import (
    RATIO_AXIS_TICKS,
    AidConsistency,
    Card,
    DiagnosedCause,
    Verdict,
    map_ratio_to_axis,
)
from px4fuse.comparison.model import FILTER_NAMES
from px4fuse.core.text import format_ratio, one_line
from px4fuse.filter.consistency import Reference
from px4fuse.finding import format_spans
from px4fuse.report.card_text import (
    AIDS_CAPTION,
    QUANTITY_LABELS,
    SEVERITY_SIGNS,
    format_consistent_ratios,
    format_rerun_note,
    label_alternatives,
    list_flight_texts,
    locate_sigma_ratio,
    make_rerun_rows,
    note_texts,
)
from px4fuse.report.cover_panels import write_panels
from px4fuse.report.page import Page, PageBlock
from px4fuse.report.style import SEVERITY_COLOURS
from px4fuse.report.typesetting import measure_free_height
from px4fuse.results.contract import AidsResults, ComparisonResults

FlightResults = ComparisonResults | AidsResults

MAX_FILE_NAME_LENGTH = 56  # characters
TERMS_NOTE = (
    "Source: positions that KF and EKF2 fuse. σ and √S: standard deviations of position and "
    "innovation, as the filter reports them. KF: position and velocity along one axis, IMU "
    "acceleration as input, no gate. Replay: px4fuse's model of EKF2, run on this log."
)
AIDS_TERMS_NOTE = (
    "√S: standard deviation of an innovation as EKF2 reports it. Source: a sensor that aids EKF2."
)
ALL_FINDINGS_TITLE = "All findings"


def draw_pages(analysis: Analysis | AidingSourceAnalysis, results: FlightResults) -> Iterator[Page]:
    """Draw the first page: the diagnosis card with plots below."""
    page = Page()
    block = add_card(page, results.card)
    if isinstance(analysis, Analysis):
        write_panels(block, analysis, results.card, measure_free_height(page))
    yield page


def add_card(page: Page, card: Card) -> PageBlock:
    """Add a diagnosis card (faults, causes and actions) to a page."""
    direction_text = f", {card.effect.axis}" if card.effect else ""
    ratio_text = f"RMS of actual error ÷ reported σ{direction_text}"
    return page.add(
        "cover",
        identity=structs.asdict(card.identity),
        headline=card.headline,
        effect=card.effect_text,
        do_this=card.do_this,
        facts=list(card.facts.items()),
        reconcile=card.reconcile,
        difference=card.difference,
        more_causes=card.more_causes,
        sign=SEVERITY_SIGNS[card.severity],
        colour=SEVERITY_COLOURS[card.severity],
        file=one_line(card.identity.file, MAX_FILE_NAME_LENGTH),
        flight=" · ".join(list_flight_texts(card)),
        axis_text=AIDS_CAPTION if card.aids else ratio_text,
        axis_legend=(
            f"grey: ratio of a consistent filter ({format_consistent_ratios()}) · ━ 95 % interval "
            "· ◀ ▶: ratio outside the axis"
        ),
        ticks=[
            {"fraction": map_ratio_to_axis(tick), "label": label}
            for tick, label in RATIO_AXIS_TICKS.items()
        ],
        rows=[*map(_make_verdict_row, card.verdicts), *map(_make_aid_row, card.aids)],
        causes=list(map(_make_cause_fields, card.causes)),
        notes=note_texts(card),
        terms=AIDS_TERMS_NOTE if card.aids else TERMS_NOTE,
        blocks=[],
    )


def _make_verdict_row(verdict: Verdict) -> dict[str, Any]:
    word = f"{verdict.word}, explained" if verdict.is_explained else verdict.word
    return _make_ratio_row(
        verdict.ratio,
        verdict.against,
        verdict.interval,
        filter=verdict.filter,
        label=FILTER_NAMES[verdict.filter] if verdict.against == "source" else "",
        quantity=QUANTITY_LABELS[verdict.against],
        word=f"not evaluated: {verdict.reason}" if verdict.ratio is None else word,
        quiet=verdict.is_explained,
        loud=verdict.is_fault,
    )


def _make_aid_row(aid: AidConsistency) -> dict[str, Any]:
    return _make_ratio_row(
        aid.ratio,
        filter="ekf2",
        label="",
        quantity=f"{aid.label} {aid.component}".strip(),
        word="not evaluated" if aid.ratio is None else "",
        quiet=aid.is_usual,
        loud=False,
    )


def _make_ratio_row(
    ratio: float | None,
    reference: Reference = "source",
    interval: tuple[float, float] | None = None,
    **fields: str | bool,
) -> dict[str, Any]:
    if ratio is None:
        return {"ratio": "", **fields}
    return {
        "ratio": format_ratio(ratio),
        **locate_sigma_ratio(ratio, reference, interval),
        **fields,
    }


def _make_cause_fields(cause: DiagnosedCause) -> dict[str, Any]:
    head, *rows = make_rerun_rows(cause.reruns) or [[]]
    return {
        "title": cause.title,
        "id": cause.id,
        "when": f"{cause.severity} · {format_spans(cause.spans_s) or 'whole flight'}",
        "why": cause.why,
        "actions": [
            structs.asdict(action) | {"label": f"{prefix}{action.target}"}
            for prefix, action in label_alternatives(cause)
        ],
        "reruns": {"head": head, "rows": rows},
        "after": " ".join(filter(None, (format_rerun_note(cause.reruns), cause.after))),
    }
