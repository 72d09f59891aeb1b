"""Cover: texts of the card, panels without values that leave unmarked."""

from __future__ import annotations

import io
import re
from typing import Any

import numpy as np
import pytest
from cards import SMALL_SIGMA_A, verdicts
from comparisons import compare
from flights import Estimator, Uwb, aisle_flight, unexplained, with_noises
from matplotlib.axes import Axes
from msgspec.structs import replace
from page_tools import axes_of, every, pdf_of, set_by_typst, smallest_type
from pypdf import PdfReader

from px4fuse.analysis import Analysis
from px4fuse.card.model import Action, AidConsistency, DiagnosedCause, DiagnosisCard, Note
from px4fuse.flight.model import Reset
from px4fuse.report import cover
from px4fuse.report.page import Page
from px4fuse.report.style import apply_report_style
from px4fuse.request import ComparisonRequest
from px4fuse.results.build import make_comparison_results


def page_of(card: DiagnosisCard) -> Page:
    page = Page()
    cover.add_card(page, card)
    return page


def text_of(card: DiagnosisCard) -> str:
    return " ".join(" ".join(set_by_typst(page_of(card))).split())


def measure_free_height(card: DiagnosisCard) -> float:
    """Return the height (points) between a text below the card and the foot of the sheet."""
    page = page_of(card)
    page.write("after the card")
    (sheet,) = PdfReader(io.BytesIO(pdf_of(page))).pages
    tops, text_top = [], 0.0

    def visit(text: str, transform: Any, text_matrix: Any, *_: Any) -> None:
        nonlocal text_top
        if text.strip():
            tops.append(text_matrix[5] * transform[3] + transform[5])
        if "after the card" in text:
            text_top = tops[-1]

    sheet.extract_text(visitor_text=visit)
    return text_top - max(top for top in tops if top < text_top)


def drawn(analysis: Analysis) -> Page:
    made = make_comparison_results(ComparisonRequest(log="aisle.ulg"), analysis)
    with apply_report_style():
        (page,) = cover.draw_pages(analysis, made)
    return page


def panels_by_title(page: Page) -> dict[str, Axes]:
    return {block["title"]: block["axes"] for block in every(page.blocks) if "axes" in block}


@pytest.fixture(scope="module")
def eventful() -> Analysis:
    flight = aisle_flight(
        duration_s=100.0,
        uwb=Uwb(gap_s=(60.0, 65.0), outlier_share=0.03),
        ekf2=Estimator(rejected_fraction=0.1, resets=(Reset(30.0, "position", (1.0, 0.0, 0.0)),)),
    )
    return with_noises(compare(flight))


def test_report_cover_prints_texts_of_the_diagnosis() -> None:
    text = text_of(SMALL_SIGMA_A)
    cause = SMALL_SIGMA_A.causes[0]
    expected = [
        "ERROR", SMALL_SIGMA_A.headline, SMALL_SIGMA_A.effect_text, *SMALL_SIGMA_A.do_this,
        "KF changed: --sigma-a 0.001 (default 0.5)", "128 overconfident", "0.93 consistent",
        cause.why, *cause.actions[0].commands, "2.11 → 0.060 m", "position and σ", cause.after,
        "[process_noise_near_zero]", SMALL_SIGMA_A.difference, "note[source_rate_at_limit]",
        "run again:",
    ]  # fmt: skip
    assert [each for each in expected if each not in text] == []


def test_alternative_actions_are_numbered_on_report_cover() -> None:
    sender = Action("sender", "subtract 0.264 s")
    console = Action("EKF2", commands=("param set EKF2_EV_DELAY 264", "reboot"), where="console")
    cause = DiagnosedCause(
        id="source_time_offset", severity="error", title="Late", why="",
        alternatives=((sender,), (console,)), actions=(Action("KF", "keep the settings"),),
    )  # fmt: skip
    text = text_of(replace(SMALL_SIGMA_A, causes=(cause,)))
    assert "option 1: sender subtract 0.264 s" in text
    place = "set in the MAVLink Console of QGroundControl:"
    assert f"option 2: EKF2 {place} param set EKF2_EV_DELAY 264 reboot" in text
    assert "in addition: KF keep the settings" in text


def test_report_cover_shows_3_notes_and_counts_the_others() -> None:
    notes = tuple(Note(f"note_{number}", f"Text {number}.") for number in range(5))
    text = text_of(replace(SMALL_SIGMA_A, notes=notes, more_causes=4))
    assert "note[note_2]: Text 2." in text
    assert "note_3" not in text
    assert '2 more notes are listed in section "All findings" of the report' in text
    assert '4 more causes are listed in section "All findings"' in text


@pytest.mark.parametrize(
    ("field", "empty"),
    [("reconcile", ""), ("difference", ""), ("causes", ()), ("notes", ()), ("do_this", ()),
     ("effect_text", ""), ("verdicts", ())],
)  # fmt: skip
def test_report_cover_leaves_no_space_for_empty_text(field: str, empty: Any) -> None:
    card = replace(SMALL_SIGMA_A, reconcile="The two verdicts differ.")
    heights = [measure_free_height(each) for each in (card, replace(card, **{field: empty}))]
    assert heights[1] > heights[0] + 8.0


def test_explained_inconsistency_on_report_cover_is_not_bold() -> None:
    card = replace(
        SMALL_SIGMA_A,
        verdicts=tuple(replace(each, is_explained=True) for each in SMALL_SIGMA_A.verdicts[:2]),
    )
    (block,) = page_of(card).blocks
    assert [row["word"] for row in block["rows"]] == ["overconfident, explained"] * 2
    assert all(row["quiet"] and not row["loud"] for row in block["rows"])


def test_error_to_sigma_ratio_beyond_plot_scale_is_a_triangle() -> None:
    ratios = verdicts(
        (0.05, "underconfident"), (0.1, "underconfident"), (10.0, "overconfident"),
        (35.0, "overconfident"),
    )  # fmt: skip
    marked = [replace(each, interval=(each.ratio, 2.0 * each.ratio)) for each in ratios]
    (block,) = page_of(replace(SMALL_SIGMA_A, verdicts=tuple(marked))).blocks
    assert [row["mark"] for row in block["rows"]] == ["below", "truth", "source", "above"]
    assert block["rows"][2]["interval"] == [1.0, 1.0]


def test_report_cover_contains_reason_of_missing_verdict() -> None:
    missing = replace(
        SMALL_SIGMA_A.verdicts[3], ratio=None, word="not evaluated", reason="no ground truth"
    )
    card = replace(SMALL_SIGMA_A, verdicts=(*SMALL_SIGMA_A.verdicts[:3], missing))
    assert "error ÷ σ (ground truth) not evaluated: no ground truth" in text_of(card)


def test_report_cover_lists_consistency_of_aiding_sources() -> None:
    aids = (
        AidConsistency(label="barometer", component="height", ratio=0.57, is_usual=True),
        AidConsistency(label="magnetometer", component="x", ratio=None),
    )
    card = replace(SMALL_SIGMA_A, verdicts=(), causes=(), effect=None, aids=aids)
    text = text_of(card)
    assert "barometer height ● 0.57" in text
    assert "magnetometer x not evaluated" in text
    assert "such a value is usual and not a fault" in text


def test_report_cover_prints_right_to_left_name_before_id() -> None:
    name = "محمد"
    identity = replace(SMALL_SIGMA_A.identity, student=name, student_id="s123")
    text = text_of(replace(SMALL_SIGMA_A, identity=identity))
    assert re.search(f"{name} ?, ?s123", text)


def test_report_cover_has_four_plots_on_one_page(eventful: Analysis) -> None:
    page = drawn(eventful)
    pdf = pdf_of(page)
    panels = axes_of(page)
    assert len(panels) == 4
    assert all(axes.lines for axes in panels)
    assert any(axes.get_xlabel() for axes in panels)
    assert len(set_by_typst(page)) == 1
    assert smallest_type(pdf) >= 8.0 - 1e-3


def test_report_cover_error_plots_share_one_scale(eventful: Analysis) -> None:
    panels = panels_by_title(drawn(eventful))
    limits = {axes.get_ylim() for title, axes in panels.items() if " error (m)" in title}
    assert len(limits) == 1


@pytest.mark.parametrize(
    ("changes", "titles"),
    [
        ({"ekf2": None}, ("KF error (m): RMSE",)),
        ({"truth": False}, ("KF − EKF2 (m): RMS",)),
        ({"ekf2": None, "truth": False}, ()),
    ],
    ids=["no EKF2", "no truth", "neither"],
)
def test_report_cover_omits_plots_of_missing_data(changes, titles) -> None:
    page = drawn(unexplained(compare(aisle_flight(**changes))))
    found = [*panels_by_title(page)]
    assert found[0].startswith("Map")
    assert found[-1].startswith("Innovations")
    assert [title.partition(" 0")[0] for title in found[1:-1]] == list(titles)
    assert len(set_by_typst(page)) == 1


def test_cover_map_title_states_how_far_ekf2_is_outside_the_map() -> None:
    flight = aisle_flight(duration_s=60.0)
    flight.ekf2.state.loc[30.0:31.0, "east_m"] += 40.0
    analysis = unexplained(compare(flight))
    titles = panels_by_title(drawn(analysis))
    (title,) = (title for title in titles if title.startswith("Map"))
    distance_m = float(
        re.fullmatch(r"Map; EKF2 up to ([\d.]+) m outside the plotted area", title)[1]
    )
    assert 20.0 < distance_m < 40.0  # a part of the jump of 40 m is inside


def test_innovations_beyond_plot_scale_are_drawn_as_triangles(eventful: Analysis) -> None:
    updates = eventful.main.kf_run.updates
    normalised = updates["innovation_m"] / np.sqrt(updates["innovation_variance_m2"])
    assert normalised.abs().max() > cover.MAX_DRAWN_SIGMAS
    title, axes = [*panels_by_title(drawn(eventful)).items()][-1]
    assert title.endswith("▲▼ beyond ±4")
    edges = [
        line for line in axes.lines if line.get_marker() in ("^", "v") and len(line.get_xdata())
    ]
    assert edges
    assert {abs(value) for line in edges for value in line.get_ydata()} == {4.0}


def test_report_cover_from_same_input_is_byte_identical(eventful: Analysis) -> None:
    assert pdf_of(drawn(eventful)) == pdf_of(drawn(eventful))


@pytest.mark.parametrize("count", [3, 6])
def test_report_cover_long_text_moves_plots_to_second_page(eventful: Analysis, count: int) -> None:
    page = page_of(replace(SMALL_SIGMA_A, causes=SMALL_SIGMA_A.causes * count))
    with apply_report_style():
        cover.write_panels(page, eventful, SMALL_SIGMA_A)
    first, second = set_by_typst(page)
    assert "Innovations ÷ √S" not in first
    assert "Innovations ÷ √S" in second


def test_report_section_title_is_on_page_of_its_first_plot() -> None:
    sections = [Page(f"Section {number}") for number in range(4)]
    for section in sections:
        section.add_panel("Panel", 240.0)
    sheets = set_by_typst(*sections)
    assert [sheet.count("Section") for sheet in sheets] == [2, 2]
    assert [sheet.count("Panel") for sheet in sheets] == [2, 2]
