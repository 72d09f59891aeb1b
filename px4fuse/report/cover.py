"""First page of a report: diagnosis card (faults, causes and actions), and plots."""

from collections.abc import Iterator, Sequence
from typing import Any

from px4fuse.analysis import AidingSourceAnalysis, Analysis
from px4fuse.card.model import (
    RATIO_AXIS_ENDS,
    RATIO_AXIS_TICKS,
    Action,
    AidConsistency,
    Card,
    DiagnosedCause,
    Verdict,
    map_ratio_to_axis,
)
from px4fuse.comparison.model import FILTER_NAMES
from px4fuse.core.text import format_ratio
from px4fuse.filter.consistency import Reference
from px4fuse.report import fonts
from px4fuse.report.card_text import (
    AIDS_CAPTION,
    MAX_COMMAND_LENGTH,
    QUANTITY_LABELS,
    SEVERITY_SIGNS,
    format_consistent_ratios,
    format_rerun_note,
    format_spans,
    label_alternatives,
    locate_sigma_ratio,
    make_rerun_columns,
    note_texts,
)
from px4fuse.report.cover_panels import write_panels
from px4fuse.report.page import Page, PageBlock, to_typst_data
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
COMMAND_LOCATIONS = {"shell": "your computer", "console": "MAVLink Console of QGroundControl"}
ALL_FINDINGS_TITLE = "All findings"


def draw_pages(analysis: Analysis | AidingSourceAnalysis, results: FlightResults) -> Iterator[Page]:
    """Draw the first page: the diagnosis card with plots below."""
    page = Page()
    block = add_card(page, results.card)
    if isinstance(analysis, Analysis):
        write_panels(block, analysis, results.card, find_free_height(page))
    yield page


def add_card(page: Page, card: Card) -> PageBlock:
    """Add a diagnosis card (faults, causes and actions) to a page."""
    identity = card.identity
    flight_texts = (
        identity.firmware,
        identity.hardware,
        f"{identity.duration_s:.1f} s",
        identity.source,
    )
    return page.add(
        "cover",
        sign=SEVERITY_SIGNS[card.severity],
        colour=SEVERITY_COLOURS[card.severity],
        file=_shorten_middle(identity.file),
        student=[text for text in (identity.student, identity.student_id) if text],
        flight=" · ".join(filter(None, flight_texts)),
        changed=f"KF changed: {', '.join(identity.changed)}" if identity.changed else "",
        settings=f"KF: {identity.settings}" if identity.settings else "",
        parameters=", ".join(identity.parameters),
        headline=card.headline,
        effect=card.effect_text,
        do_this=card.do_this,
        **_make_sigma_ratio_axis(card),
        facts=list(card.facts.items()),
        reconcile=card.reconcile,
        causes_title="Cause and fix" if len(card.causes) == 1 else "Causes and fixes",
        causes_legend=_format_causes_legend(card.causes),
        causes=[
            _make_cause_fields(number, cause) for number, cause in enumerate(card.causes, start=1)
        ],
        more_causes=f"{card.more_causes} more causes are listed in {ALL_FINDINGS_TITLE}"
        if card.more_causes
        else "",
        difference=card.difference,
        notes=note_texts(card, f"in {ALL_FINDINGS_TITLE}"),
        terms=AIDS_TERMS_NOTE if card.aids else TERMS_NOTE,
        command=identity.command,
        segment=f"analysed {identity.segment}" if identity.segment else "",
        version=identity.version,
        blocks=[],
    )


def find_free_height(page: Page) -> float:
    return measure_free_height(
        to_typst_data(page.blocks, ""), fonts.find_font_names(str(page.blocks))
    )


def _shorten_middle(name: str) -> str:
    """Shorten a long file name in its middle.

    >>> _shorten_middle("2026-04-02_14-13-00_" + "x" * 60 + "_issue.ulg")
    '2026-04-02_14-13-00_xxxxxxx…xxxxxxxxxxxxxxxxxx_issue.ulg'
    """
    if len(name) <= MAX_FILE_NAME_LENGTH:
        return name
    half_length = MAX_FILE_NAME_LENGTH // 2
    return f"{name[: half_length - 1]}…{name[-half_length:]}"


def _make_sigma_ratio_axis(card: Card) -> dict[str, Any]:
    interval_legend = "" if card.aids else " · ├─┤ 95 % interval"
    axis_range_text = " to ".join(RATIO_AXIS_TICKS[end] for end in RATIO_AXIS_ENDS)
    direction_text = f", {card.effect.axis}" if card.effect else ""
    return {
        "axis_title": "Is the σ reported by the filters right?",
        "axis_text": AIDS_CAPTION
        if card.aids
        else f"RMS of actual error ÷ reported σ{direction_text}",
        "axis_legend": (
            f"grey: ratio of a consistent filter ({format_consistent_ratios()}){interval_legend} · "
            f"◀ ▶: ratio outside {axis_range_text}"
        ),
        "ticks": [
            {"fraction": map_ratio_to_axis(tick), "label": label}
            for tick, label in RATIO_AXIS_TICKS.items()
        ],
        "rows": [*map(_make_verdict_row, card.verdicts), *map(_make_aid_row, card.aids)],
    }


def _make_verdict_row(verdict: Verdict) -> dict[str, Any]:
    verdict_text = f"{verdict.word}, explained" if verdict.is_explained else verdict.word
    if verdict.ratio is None:
        verdict_text = f"not evaluated: {verdict.reason}"
    return {
        "filter": verdict.filter,
        "label": FILTER_NAMES[verdict.filter] if verdict.against == "source" else "",
        "quantity": QUANTITY_LABELS[verdict.against],
        "word": verdict_text,
        "quiet": verdict.is_explained,
        "loud": verdict.is_fault,
        **_make_sigma_ratio_fields(verdict.ratio, verdict.against, verdict.interval),
    }


def _make_aid_row(aid: AidConsistency) -> dict[str, Any]:
    return {
        "filter": "ekf2",
        "label": "",
        "quantity": f"{aid.label} {aid.component}".strip(),
        "word": "not evaluated" if aid.ratio is None else "",
        "quiet": aid.is_usual,
        "loud": False,
        **_make_sigma_ratio_fields(aid.ratio, "source", None),
    }


def _make_sigma_ratio_fields(
    ratio: float | None, reference: Reference, interval: tuple[float, float] | None
) -> dict[str, Any]:
    if ratio is None:
        return {"ratio": ""}
    return {"ratio": format_ratio(ratio), **locate_sigma_ratio(ratio, reference, interval)}


def _format_causes_legend(causes: Sequence[DiagnosedCause]) -> str:
    programs_with_commands = {
        action.where for cause in causes for _, action in label_alternatives(cause)
    }
    legend_texts = [
        f"{location}: {text}"
        for location, text in COMMAND_LOCATIONS.items()
        if location in programs_with_commands
    ]
    return " · ".join([*legend_texts, "[id]: `px4fuse explain ID` explains the finding"])


def _make_cause_fields(number: int, cause: DiagnosedCause) -> dict[str, Any]:
    columns = make_rerun_columns(cause.reruns)
    head, *rows = zip(*columns, strict=True) if columns else ((),)
    return {
        "number": str(number),
        "title": cause.title,
        "when": f"{cause.severity} · {format_spans(cause) or 'whole flight'}",
        "why": cause.why,
        "actions": [
            _make_action_fields(prefix, action) for prefix, action in label_alternatives(cause)
        ],
        "reruns": {"head": head, "rows": rows},
        "after": " ".join(filter(None, (format_rerun_note(cause.reruns), cause.after))),
        "id": cause.id,
    }


def _make_action_fields(prefix: str, action: Action) -> dict[str, Any]:
    return {
        "label": f"{prefix}{action.target}",
        "where": action.where,
        "sentence": action.sentence,
        "commands": action.commands,
        "long": any(len(command) > MAX_COMMAND_LENGTH for command in action.commands),
    }
