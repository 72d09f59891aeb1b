"""Diagnosis card as HTML: fields, escaping, axis, notebook, and layout in a browser."""

from __future__ import annotations

import re
from html import unescape
from pathlib import Path

import pytest
from browser import Browser, Elements
from cards import SMALL_SIGMA_A, verdicts
from explore_tools import axe, serious
from msgspec import structs

import px4fuse
from px4fuse.card.model import Action, AnalysisDescription, DiagnosisCard, Note, map_ratio_to_axis
from px4fuse.core.text import format_ratio
from px4fuse.report.card_html import (
    MARKER_SVG_PATHS,
    make_card_html,
    make_notebook_html,
    make_sigma_ratio_html,
)

HOSTILE = '<img src=x onerror="window.alive=1"></style><script>window.alive=2</script>\u202e'


def text_of(html: str) -> str:
    return " ".join(unescape(re.sub(r"<[^>]+>", " ", html)).split())


def test_diagnosis_html_shows_causes_actions_reruns_and_notes() -> None:
    text = text_of(make_card_html(SMALL_SIGMA_A))
    cause = SMALL_SIGMA_A.causes[0]
    for part in (
        "■ ERROR", SMALL_SIGMA_A.headline, SMALL_SIGMA_A.effect_text, *SMALL_SIGMA_A.do_this,
        SMALL_SIGMA_A.difference, cause.why, cause.after, cause.actions[0].commands[0],
        cause.actions[1].sentence, SMALL_SIGMA_A.notes[0].text, SMALL_SIGMA_A.notes[0].action,
        "2.11 → 0.060 m", "128 → 0.90", "position and σ",
    ):  # fmt: skip
        assert part in text
    assert text.count(SMALL_SIGMA_A.effect_text) == 1
    assert "Apply" not in text
    assert make_card_html(SMALL_SIGMA_A, has_apply_buttons=True).count("data-apply") == 1


def test_html_plot_of_error_to_sigma_ratio_shows_its_interval() -> None:
    four = list(verdicts((21.0, "overconfident"), (0.9, "consistent"), (0.05, "underconfident"),
                         (None, "not evaluated")))  # fmt: skip
    four[1] = structs.replace(four[1], interval=(0.8, 1.2))
    four[3] = structs.replace(four[3], reason="the log has no <ground> truth")
    html = make_sigma_ratio_html(four, "along the aisle")
    marks = re.findall(r'class="mark" y="10" x="([\d.]+)%"><path d="([^"]+)"', html)
    middle = f"{100.0 * map_ratio_to_axis(0.9):.2f}"
    assert marks == [
        ("100.00", MARKER_SVG_PATHS["above"]),
        (middle, MARKER_SVG_PATHS["truth"]),
        ("0.00", MARKER_SVG_PATHS["below"]),
    ]
    assert html.count('class="interval"') == 3
    assert "not evaluated: the log has no &lt;ground&gt; truth" in html
    assert 'aria-label="KF, ● innovation ÷ √S: 21, overconfident. KF, ◆ error ÷ σ' in html
    # only verdicts that are not consistent are bold
    assert re.findall(r'class="ratio( loud)?">([\d.]+)', html) == [
        (" loud", format_ratio(21.0)),
        ("", format_ratio(0.9)),
        (" loud", format_ratio(0.05)),
    ]


def test_diagnosis_html_of_explained_inconsistency_is_not_bold() -> None:
    one = structs.replace(verdicts(*[(2.2, "overconfident")] * 4)[2], is_explained=True)
    html = make_sigma_ratio_html([one], "along the aisle")
    assert "loud" not in html
    assert "2.2, overconfident, explained" in html


def test_diagnosis_html_escapes_text_from_logs() -> None:
    cause = structs.replace(
        SMALL_SIGMA_A.causes[0],
        title=HOSTILE,
        why=HOSTILE,
        after=HOSTILE,
        actions=(Action("KF", HOSTILE, (HOSTILE,), "shell"),),
    )
    card = structs.replace(
        SMALL_SIGMA_A,
        headline=HOSTILE,
        effect_text=HOSTILE,
        do_this=(HOSTILE,),
        reconcile=HOSTILE,
        causes=(cause, cause),
        notes=(Note("x", HOSTILE, HOSTILE),),
    )
    html = make_card_html(card, has_apply_buttons=True)
    assert {tag for tag, _ in Elements(html).found}.isdisjoint({"img", "script", "style"})
    assert "\u202e" not in html
    allowed = {
        tag for tag, _ in Elements(make_card_html(SMALL_SIGMA_A, has_apply_buttons=True)).found
    }
    assert {tag for tag, _ in Elements(html).found} <= allowed


def test_diagnosis_html_of_rejected_log_has_no_plot() -> None:
    card = DiagnosisCard(
        severity="refused",
        id="not_px4",
        headline="an ArduPilot DataFlash log, not a PX4 ULog",
        facts={"read": "4,096 bytes", "KF": "not run"},
        identity=AnalysisDescription(file="a.BIN"),
    )
    html = make_card_html(card)
    assert "✕ REFUSED" in html
    assert "<figure" not in html
    assert "4,096 bytes" in text_of(html)


@pytest.mark.usefixtures("cached_analyses")
def test_compare_result_in_notebook_displays_diagnosis(sample_log: Path) -> None:
    analysis = px4fuse.compare(sample_log)
    html = analysis._repr_html_()
    assert html.startswith("<style>")
    assert ":root" not in html
    assert "No fault found: KF and EKF2 are consistent" in html
    assert structs_without_request(analysis)._repr_html_() is None


def structs_without_request(analysis: px4fuse.Analysis) -> px4fuse.Analysis:
    from dataclasses import replace

    return replace(analysis, request=None)


@pytest.mark.parametrize("width", [1000, 390])
def test_diagnosis_html_fits_phone_and_is_accessible(
    browser: Browser, tmp_path: Path, width: int
) -> None:
    file = tmp_path / "card.html"
    head = '<!DOCTYPE html><html lang="en"><meta charset="utf-8"><title>card</title>'
    viewport = '<meta name="viewport" content="width=device-width">'
    page = f"{head}{viewport}<main><h1>Card</h1>{make_notebook_html(SMALL_SIGMA_A)}</main>"
    file.write_text(page, encoding="utf-8")
    browser.open(file, width=width)
    browser.resize(width, 800)
    assert browser.ask("document.documentElement.scrollWidth") <= width
    outside = """[...document.querySelectorAll('figure .row > *')].filter((node) => {
      const card = document.querySelector('.px4fuse-card').getBoundingClientRect();
      return node.getBoundingClientRect().right > card.right; }).length"""
    assert browser.ask(outside) == 0
    browser.ask(axe())
    assert serious(browser) == []
