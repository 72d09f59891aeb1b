"""Diagnosis card (faults, causes and actions) as text of at most 100 columns."""

import re
import shlex
import textwrap
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from msgspec import convert, to_builtins

from px4fuse.card.model import (
    MAX_NOTES,
    RATIO_AXIS_ENDS,
    RATIO_AXIS_TICKS,
    Action,
    AidConsistency,
    CardRerun,
    DiagnosedCause,
    DiagnosisCard,
    Verdict,
    map_ratio_to_axis,
)
from px4fuse.comparison.model import FILTER_NAMES
from px4fuse.core.text import (
    capitalise_first_letter,
    convert_nested,
    format_metres,
    format_ratio,
)
from px4fuse.filter.consistency import CONSISTENT_SIGMA_RATIOS, Reference
from px4fuse.finding import MAX_LISTED_SPANS, format_spans
from px4fuse.request import quote_command

CARD_WIDTH = 100  # characters per line
# Width (characters) of the axis of σ ratios (actual σ ÷ reported σ), without its ends
SIGMA_RATIO_AXIS_WIDTH = 33
SIGMA_RATIO_AXIS_INDENT = 57  # characters left of the axis of σ ratios
TEXT_INDENT = 11  # width (characters) of the column with labels, such as "effect"
# Ticks with labels on the axis of σ ratios
LABELLED_RATIO_TICKS = (0.1, 0.5, 1.0, 2.0, 10.0)
SYMBOL_BY_REFERENCE = {"source": "●", "truth": "◆"}
QUANTITY_LABELS = {"source": "● innovation ÷ √S", "truth": "◆ error ÷ σ (ground truth)"}
SEVERITY_SIGNS = {
    "error": "■ ERROR",
    "warning": "▲ WARNING",
    "note": "● NOTE",
    "clean": "✓ NO FAULT",
    "refused": "✕ REFUSED",
}
SEVERITY_STYLES = {
    "error": "bold red",
    "warning": "bold yellow",
    "note": "cyan",
    "clean": "bold green",
}
# Text before the commands of an action, by the place where the user types them (Action.where)
PLACE_TEXTS = {
    "": "",
    "shell": "run again: ",
    "console": "set in the MAVLink Console of QGroundControl: ",
}
# Replacements of characters that ASCII terminals cannot print
ASCII_REPLACEMENTS = str.maketrans("░●◆◀▶─÷−–²³×", ":ox<>-/--23x") | str.maketrans(
    {
        "√": "sqrt ",
        "σ": "sigma",
        "→": "->",
        "←": "<-",
        "°": " deg",
        "±": "+-",
        "ν": "nu",
        "…": "...",
    }
)
# Each sentence begins on a new line
SENTENCE_END_PATTERN = re.compile(r"(?<=\.) (?=[A-Z])")
ALL_FINDINGS_PLACE = 'in section "All findings" of the report'
AIDS_CAPTION = (
    "RMS of innovation ÷ √S of each aiding source that EKF2 fused. A value below 1 means that √S "
    "is too large. For barometer, magnetometer and gravity, such a value is usual and not a fault."
)


class Paragraph(NamedTuple):
    """Paragraph on the terminal, with its style and indents.

    Attributes
    ----------
    first_indent : str
        Indent or label before the first line.
    wrap_indent : str or None
        Indent of all following lines; each sentence begins on a new line. None if the paragraph is
        always one line, such as a command or a blank line.
    plot : str
        Axis drawn with characters, to the right of the text. It is omitted on a narrow terminal.
    """

    text: str
    first_indent: str = ""
    wrap_indent: str | None = None
    style: str = ""
    plot: str = ""

    def wrap(self, width: int) -> list[str]:
        """Split the paragraph into lines; a paragraph with a plot is one line."""
        if self.wrap_indent is not None:
            lines = list[str]()
            for sentence in SENTENCE_END_PATTERN.split(self.text):
                lines += textwrap.wrap(
                    sentence,
                    width,
                    initial_indent=self.wrap_indent if lines else self.first_indent,
                    subsequent_indent=self.wrap_indent,
                    break_long_words=False,
                    break_on_hyphens=False,
                )
            return lines
        if not self.plot or len(self.text) + len(self.plot) <= width:
            return [self.text + self.plot]
        # text and plot are too long for one line: return the text only
        return [self.text.rstrip()] if self.text.strip() else []


def format_card_lines(card: DiagnosisCard) -> Iterator[Paragraph]:
    """Yield the paragraphs of a diagnosis card (faults, causes and actions) for the terminal.

    The card of a refused analysis contains only the error and its facts.
    """
    if card.severity == "refused":
        yield Paragraph(f"error[{card.id}]: {card.headline}", style=SEVERITY_STYLES["error"])
        for label, text in card.facts.items():
            yield _make_labelled_paragraph(label, text)
        yield Paragraph("No file was written. Exit code 2.")
        return
    yield from _format_identity_lines(card)
    yield make_headline(card)
    yield _make_labelled_paragraph("effect", card.effect_text)
    for index, text in enumerate(card.do_this):
        yield _make_labelled_paragraph("" if index else "action", text)
    for number, cause in enumerate(card.causes, start=1):
        if number > 1:  # the headline contains the title of the first cause
            title = f"{cause.severity}[{cause.id}]: {cause.title}"
            yield Paragraph(title, style=SEVERITY_STYLES[cause.severity])
        label = f"cause {number}" if len(card.causes) > 1 else "cause"
        yield _make_labelled_paragraph(label, cause.why)
        yield from _format_cause_lines(cause, do_this=" ".join(card.do_this))
    if card.more_causes:
        yield Paragraph(f"{card.more_causes} more causes are listed {ALL_FINDINGS_PLACE}")
    for label, text in card.facts.items():
        yield _make_labelled_paragraph(label, text)
    yield from _format_verdict_lines(card)
    yield from _format_aid_lines(card.aids)
    for text in (card.reconcile, card.difference):
        yield Paragraph(text, "  ", "  ")
    if card.notes:
        yield Paragraph("")
    for text in format_notes(card):
        yield Paragraph(text, "", "  ")


def format_notes(card: DiagnosisCard) -> list[str]:
    """Format the first notes of a diagnosis card, and state where the others are."""
    texts = [
        f"note[{note.id}]: {note.text} {note.action}".rstrip() for note in card.notes[:MAX_NOTES]
    ]
    if (omitted_count := len(card.notes) - MAX_NOTES) > 0:
        texts.append(f"{omitted_count} more notes are listed {ALL_FINDINGS_PLACE}")
    return texts


def format_closing_lines(card: DiagnosisCard, *, verbose: bool = False) -> Iterator[Paragraph]:
    """Yield the last line of a diagnosis card: commands for details."""
    texts = [] if verbose else ["More: -v"]
    if card.id:
        texts.append(f"Explanation of the finding: px4fuse explain {card.id}")
    yield Paragraph("; ".join(texts), wrap_indent="")


def with_typed_path(card: DiagnosisCard, path: str) -> DiagnosisCard:
    """Replace the file name of the log in all commands by the path that the user typed.

    >>> from px4fuse.card.model import AnalysisDescription
    >>> action = Action("KF", commands=("px4fuse compare a.ulg --sigma-z 1",), where="shell")
    >>> cause = DiagnosedCause(id="x", severity="error", title="", why="", actions=(action,))
    >>> log = AnalysisDescription(file="a.ulg")
    >>> card = DiagnosisCard(severity="error", headline="", causes=(cause,), identity=log)
    >>> with_typed_path(card, "my logs/a.ulg").causes[0].actions[0].commands
    ("px4fuse compare 'my logs/a.ulg' --sigma-z 1",)
    """
    command = re.compile(rf"(px4fuse \w+ ){re.escape(shlex.quote(card.identity.file))}")

    def replace_name(element: Any) -> Any:
        if not isinstance(element, str):
            return element
        return command.sub(lambda match: match[1] + quote_command([path]), element)

    return convert(convert_nested(to_builtins(card), replace_name), DiagnosisCard)


def to_ascii(text: str) -> str:
    """Replace characters that ASCII terminals cannot print.

    >>> to_ascii("error ÷ σ 7.2 → 1.2")
    'error / sigma 7.2 -> 1.2'
    """
    return text.translate(ASCII_REPLACEMENTS)


def format_consistent_ratios() -> str:
    """Format the limits of the σ ratio (actual σ ÷ reported σ) of a consistent filter.

    ● marks the ratio from innovations, ◆ the ratio from errors against ground truth.

    >>> format_consistent_ratios()
    '● 0.8 to 1.25, ◆ 0.67 to 1.5'
    """
    return ", ".join(
        f"{SYMBOL_BY_REFERENCE[name]} {low:g} to {high:g}"
        for name, (low, high) in CONSISTENT_SIGMA_RATIOS.items()
    )


def draw_sigma_ratio(ratio: float | None, reference: Reference) -> str:
    """Draw a σ ratio (actual σ ÷ reported σ) as a mark on a logarithmic axis of characters.

    ● is a ratio from innovations, ◆ from errors against ground truth. ░ is the range of a
    consistent filter. An arrow is a ratio outside the axis.

    >>> draw_sigma_ratio(0.93, "source")
    '1/10 ──────────────░●░░░────────────── 10'
    >>> draw_sigma_ratio(128.0, "truth")
    '1/10 ─────────────░░░░░░░────────────▶ 10'
    """
    first_band_column, last_band_column = (
        _map_ratio_to_character_column(end) for end in CONSISTENT_SIGMA_RATIOS[reference]
    )
    characters = [
        "░" if first_band_column <= column <= last_band_column else "─"
        for column in range(SIGMA_RATIO_AXIS_WIDTH)
    ]
    if ratio is not None:
        column, last_column = _map_ratio_to_character_column(ratio), SIGMA_RATIO_AXIS_WIDTH - 1
        symbol = (
            "◀" if column < 0 else "▶" if column > last_column else SYMBOL_BY_REFERENCE[reference]
        )
        characters[min(max(column, 0), last_column)] = symbol
    return f"1/10 {''.join(characters)} 10"


def locate_sigma_ratio(
    ratio: float, reference: Reference, interval: tuple[float, float] | None
) -> dict[str, Any]:
    """Return the place of a σ ratio on the axis of its plot, as a fraction of the axis length.

    Return also the fractions for the range of a consistent filter, and for the 95 % interval of the
    ratio.
    """
    fraction = map_ratio_to_axis(ratio)
    return {
        "fraction": fraction,
        # symbol at the ratio: an arrow if the ratio is outside the axis
        "mark": "below" if fraction < 0.0 else "above" if fraction > 1.0 else reference,
        "band": [map_ratio_to_axis(end) for end in CONSISTENT_SIGMA_RATIOS[reference]],
        "interval": [
            map_ratio_to_axis(float(np.clip(end, *RATIO_AXIS_ENDS))) for end in interval or ()
        ],
    }


def _map_ratio_to_character_column(ratio: float) -> int:
    return round(map_ratio_to_axis(ratio) * (SIGMA_RATIO_AXIS_WIDTH - 1))


def _format_identity_lines(card: DiagnosisCard) -> Iterator[Paragraph]:
    """Yield lines on file, flight and student, then KF settings and changed options."""
    identity = card.identity
    student_text = ", ".join(filter(None, (identity.student, identity.student_id)))
    texts = (identity.file, ", ".join(list_flight_texts(card)), student_text)
    yield Paragraph("  ".join(filter(None, texts)))
    if identity.settings:
        yield Paragraph(f"KF: {identity.settings}", "  ", " " * 6)
    if changed_options := (*identity.changed, *identity.parameters):
        yield Paragraph(f"changed: {'; '.join(changed_options)}", "  ", " " * TEXT_INDENT)
    yield Paragraph("")


def list_flight_texts(card: DiagnosisCard) -> list[str]:
    """Return firmware, hardware, duration and position source of a flight."""
    identity = card.identity
    duration_text = f"{identity.duration_s:.1f} s"
    texts = (identity.firmware, identity.hardware, duration_text, identity.source)
    return [text for text in texts if text]


def make_headline(card: DiagnosisCard) -> Paragraph:
    """Return the first line of a diagnosis card: severity and title of the worst fault."""
    label = "ok" if card.severity == "clean" else card.severity
    severity_and_id = f"{label}[{card.id}]" if card.id else label
    return Paragraph(f"{severity_and_id}: {card.headline}", style=SEVERITY_STYLES[card.severity])


def _format_cause_lines(cause: DiagnosedCause, do_this: str) -> Iterator[Paragraph]:
    """Yield lines on a cause: times, actions, re-runs and closing sentence."""
    is_shortened = len(cause.spans_s) > MAX_LISTED_SPANS
    times_text = " (spans_s in the JSON results lists all times)" * is_shortened
    yield _make_labelled_paragraph("when", format_spans(cause.spans_s) + times_text)
    # ``do_this`` is already printed above the causes. Omit an action if ``do_this`` contains its
    # sentence, unless the action is an alternative (": " in the label) or has commands. The first
    # letter may differ (lowercase in ``do_this``), so it is not compared
    actions = [
        (label, action)
        for label, action in label_alternatives(cause)
        if ": " in label or action.commands or action.sentence[1:] not in do_this
    ]
    label_width = max((len(label) for label, _ in actions), default=0) + 2
    for label, action in actions:
        yield from _format_action_lines(label, label_width, action)
    yield from _format_rerun_lines(cause.reruns)
    yield Paragraph(cause.after, "  ", "  ")


def label_alternatives(cause: DiagnosedCause) -> list[tuple[str, Action]]:
    """Return the actions of a cause, with labels such as "KF" or "option 1: KF"."""
    alternatives = [
        (f"option {place}: {action.target_name}", action)
        for place, alternative in enumerate(cause.alternatives, start=1)
        for action in alternative
    ]
    prefix = "in addition: " if alternatives else ""
    return alternatives + [(f"{prefix}{action.target_name}", action) for action in cause.actions]


def _format_action_lines(label: str, label_width: int, action: Action) -> Iterator[Paragraph]:
    """Yield the sentence of an action beside its label, then one line for each command."""
    indent, label_text = " " * (2 + label_width), f"  {label:{label_width}}"
    place_text = PLACE_TEXTS[action.where]
    if action.sentence:
        yield Paragraph(f"{place_text}{action.sentence}", label_text, indent)
        label_text = indent
    else:
        label_text += place_text
    for command in action.commands:
        yield Paragraph(f"{label_text}{command}", style="bold")
        label_text = indent


def _format_rerun_lines(reruns: Sequence[CardRerun]) -> Iterator[Paragraph]:
    """Yield a line for each re-run (label, result, then values with their headings), and a note."""
    headings, *rows = make_rerun_rows(reruns) or [[]]
    for label, *values, result in rows:
        # The headings also contain "result" at the end, which has no value here: zip ignores it
        named_values = zip(headings[1:], values, strict=False)
        texts = [f"{heading.lstrip('●◆ ')} {value}" for heading, value in named_values if value]
        values_text = capitalise_first_letter(", ".join(texts))
        yield _make_labelled_paragraph("re-run", f"{label}: {result}. {values_text}")
    yield Paragraph(format_rerun_note(reruns), "  ", "  ")


def make_rerun_rows(reruns: Sequence[CardRerun]) -> list[list[str]]:
    """Return the table (first row: headings) of re-runs with changed settings."""
    rows = [
        {
            "re-run": rerun.label,
            "position RMSE": _format_before_after(rerun.position_rmse_m, format_metres, " m"),
            "● innovation ÷ √S": _format_before_after(rerun.source_ratio, format_ratio),
            "◆ error ÷ σ": _format_before_after(rerun.truth_ratio, format_ratio),
            "rejected": _format_before_after(
                rerun.rejected_fraction, lambda fraction: f"{100.0 * fraction:.0f}", " %"
            ),
            "result": f"improves {rerun.improves.removesuffix(' only')}".replace("σ", "σ ratio")
            if rerun.improves != "nothing"
            else "no improvement",
        }
        for rerun in reruns
    ]
    if not rows:
        return []
    headings = [head for head in rows[0] if any(row[head] for row in rows)]
    return [headings, *([row[head] for head in headings] for row in rows)]


def format_rerun_note(reruns: Sequence[CardRerun]) -> str:
    """Return a note on the replays of EKF2 among the re-runs, or "" without a replay."""
    replay_starts_s = [
        rerun.from_s for rerun in reruns if rerun.is_prediction and rerun.from_s is not None
    ]
    if not replay_starts_s:
        return ""
    return (
        "EKF2 (replay): predictions by px4fuse's model of EKF2. They exclude gaps in the positions "
        f"and the first {min(replay_starts_s):.0f} s."
    )


def _format_before_after(
    values: tuple[float, float] | None,
    format_value: Callable[[float], str],
    unit: str = "",
) -> str:
    """Format a pair of values as "before → after" with a unit; "" without values."""
    return " → ".join(map(format_value, values)) + unit if values else ""


def _format_verdict_lines(card: DiagnosisCard) -> Iterator[Paragraph]:
    """Yield the consistency of each filter: heading, legend and axis, then a line per verdict."""
    if not card.verdicts:
        return
    direction_text = "" if card.effect is None else f" {card.effect.axis}"
    yield Paragraph("")
    heading = f"Consistency{direction_text}: RMS of error ÷ reported σ (expected 1)"
    yield Paragraph(heading, "", "  ")
    legend = f"  ░ consistent ({format_consistent_ratios()})"
    left_label, right_label = "← reported σ too large", "too small →"
    # the plot has 8 more characters than its axis: the labels of the ends
    right_label_width = SIGMA_RATIO_AXIS_WIDTH + 8 - len(left_label)
    yield Paragraph(
        f"{'':{SIGMA_RATIO_AXIS_INDENT}}", plot=f"{left_label}{right_label:>{right_label_width}}"
    )
    yield Paragraph(f"{legend:{SIGMA_RATIO_AXIS_INDENT}}", plot=_format_tick_labels())
    if any(verdict.is_explained for verdict in card.verdicts):
        yield Paragraph("  A verdict in brackets, such as (overconfident), needs no action.")
    yield from map(_format_verdict_line, card.verdicts)


def _format_verdict_line(verdict: Verdict) -> Paragraph:
    """Format a verdict: filter, quantity, ratio and verdict word, with a plot of the ratio."""
    label_text = f"  {FILTER_NAMES[verdict.filter]:4} {QUANTITY_LABELS[verdict.against]:26}"
    if verdict.ratio is None:
        verdict_text = f"{'–':>5}  not evaluated: {verdict.reason}"
        return Paragraph(verdict_text, label_text, " " * 40)
    verdict_word = f"({verdict.word})" if verdict.is_explained else verdict.word
    verdict_text = f"{label_text}{format_ratio(verdict.ratio):>5}  {verdict_word}"
    return Paragraph(
        f"{verdict_text:{SIGMA_RATIO_AXIS_INDENT}}",
        style="bold" if verdict.is_fault else "",
        plot=draw_sigma_ratio(verdict.ratio, verdict.against),
    )


def _format_tick_labels() -> str:
    """Return the labels of the axis of σ ratios as one line above the plots."""
    characters = [" "] * SIGMA_RATIO_AXIS_WIDTH
    for tick in LABELLED_RATIO_TICKS[1:-1]:
        label = RATIO_AXIS_TICKS[tick]
        start = _map_ratio_to_character_column(tick) - len(label) // 2
        characters[start : start + len(label)] = label
    return f"{'':5}{''.join(characters).rstrip()}"


def _format_aid_lines(aid_rows: Sequence[AidConsistency]) -> Iterator[Paragraph]:
    """Yield a caption, the axis, and the σ ratio of each aiding source; nothing without rows."""
    if not aid_rows:
        return
    yield Paragraph("")
    yield Paragraph(AIDS_CAPTION, "", "  ")
    indent = 31
    yield Paragraph(f"{'':{indent}}", plot=_format_tick_labels())
    for row in aid_rows:
        ratio_text = "–" if row.ratio is None else format_ratio(row.ratio)
        label_text = f"  {row.label:13} {row.component:5}{ratio_text:>7}"
        yield Paragraph(f"{label_text:{indent}}", plot=draw_sigma_ratio(row.ratio, "source"))


def _make_labelled_paragraph(label: str, text: str) -> Paragraph:
    return Paragraph(text, f"  {label:{TEXT_INDENT - 2}}", " " * TEXT_INDENT)
