"""Diagnosis card (faults, causes and actions) as HTML."""

from collections.abc import Sequence

from px4fuse.analysis import Analysis
from px4fuse.card.build import build_card, describe_axis
from px4fuse.card.model import (
    RATIO_AXIS_ENDS,
    RATIO_AXIS_TICKS,
    DiagnosisCard,
    Verdict,
    map_ratio_to_axis,
)
from px4fuse.card.verdicts import make_sigma_verdicts
from px4fuse.comparison.model import FILTER_NAMES
from px4fuse.core.text import format_ratio
from px4fuse.filter.consistency import CONSISTENT_SIGMA_RATIOS
from px4fuse.finding import format_spans
from px4fuse.html.safe import load_template, read_asset

from . import card_text

# SVG paths of the markers on the axis of σ ratios (actual σ ÷ reported σ)
MARKER_SVG_PATHS = {
    "source": "M-5.5 0a5.5 5.5 0 1 0 11 0a5.5 5.5 0 1 0-11 0",
    "truth": "M-6.5 0L0-6.5L6.5 0L0 6.5z",
    "below": "M5-7L-7 0L5 7z",
    "above": "M-5-7L7 0L-5 7z",
}
# Axis of σ ratios, for the scripts of web pages
SIGMA_RATIO_AXIS = {
    "bands": CONSISTENT_SIGMA_RATIOS,
    "ends": RATIO_AXIS_ENDS,
    "marks": MARKER_SVG_PATHS,
}


def make_diagnosis_card(analysis: Analysis) -> DiagnosisCard:
    """Return the diagnosis card: faults, causes and actions of an analysis."""
    request = analysis.require_request()
    return card_text.with_typed_path(build_card(analysis, request), request.log)


def make_card_html(
    card: DiagnosisCard, *, is_open: bool = False, has_apply_buttons: bool = False
) -> str:
    """Return a diagnosis card as an HTML element.

    Parameters
    ----------
    is_open : bool
        True to show causes and notes without a click.
    has_apply_buttons : bool
        True to show a button beside each command that changes KF settings.
    """
    return load_template("report/card.html").render(
        card=card,
        card_text=card_text,
        open=is_open,
        apply=has_apply_buttons,
        figure=make_sigma_ratio_html(card.verdicts, card.effect.axis)
        if card.verdicts and card.effect is not None
        else "",
        format_spans=format_spans,
    )


def make_sigma_ratio_html(verdicts: Sequence[Verdict], axis: str, name: str = "") -> str:
    """Draw σ ratios (actual σ ÷ reported σ) on a logarithmic axis, as HTML."""
    return load_template("report/card_axis.html").render(
        verdicts=verdicts,
        axis=axis,
        name=name,
        card_text=card_text,
        paths=MARKER_SVG_PATHS,
        percent=_format_svg_position,
        ticks=[
            (_format_svg_position(map_ratio_to_axis(tick)), tick, label)
            for tick, label in RATIO_AXIS_TICKS.items()
        ],
        names=FILTER_NAMES,
        format_ratio=format_ratio,
    )


def make_sigma_ratio_figures(analysis: Analysis) -> str:
    """Draw the σ ratios of KF and EKF2 along each axis, as HTML."""
    return "".join(
        make_sigma_ratio_html(make_sigma_verdicts(result), describe_axis(analysis, result), name)
        for name, result in analysis.axes.items()
    )


def read_card_css() -> str:
    """Return the CSS of the diagnosis card, without its colours."""
    return read_asset("card.css", "px4fuse.report")


def make_notebook_html(card: DiagnosisCard) -> str:
    """Return a diagnosis card as HTML with CSS, for a notebook."""
    colour_css = read_asset("colours.css").replace(":root", ".px4fuse-card")
    return f"<style>{colour_css}{read_card_css()}</style>{make_card_html(card, is_open=True)}"


def _format_svg_position(fraction: float) -> str:
    # The security policy of the pages forbids style attributes, so positions are SVG percentages
    return f"{100.0 * min(max(fraction, 0.0), 1.0):.2f}%"
