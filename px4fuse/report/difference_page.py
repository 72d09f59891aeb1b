"""Report page on the difference between KF and EKF2, and the contribution of each setting."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.core.arrays import Array
from px4fuse.ekf2.replay import Agreement, Ekf2Replay
from px4fuse.ekf2.steps import DifferenceExplanation
from px4fuse.filter.signals import AISLE
from px4fuse.flight.ekf2_parameters import AIDS
from px4fuse.flight.model import Unavailable
from px4fuse.report import event_marks
from px4fuse.report.page import Page, make_two_columns
from px4fuse.report.style import (
    EKF2_BAND_COLOUR,
    EKF2_COLOUR,
    KF_BAND_COLOUR,
    KF_COLOUR,
    MUTED_COLOUR,
    TRACK_STYLES,
    Axes,
    draw_curve,
)

TITLE = "Difference between KF and EKF2, setting by setting"
BAR_ROW_HEIGHT = 12.0  # points
LABEL_WIDTH = 140.0  # points
LEFT_COLUMN_FRACTION = 0.62  # fraction of the page width
TIME_PLOT_HEIGHT = 105.0  # points
# Style of a bar for a setting that increases the difference KF - EKF2
INCREASE_BAR_STYLE: dict[str, Any] = {"color": "white", "hatch": "////"}


def draw_pages(analysis: Analysis, _: object) -> Iterator[Page]:
    """Draw the contribution of each EKF2 setting to the mean square difference KF - EKF2."""
    explanation_by_axis = _select_difference_explanations(analysis)
    if not _has_explanation(explanation_by_axis):
        return
    page = Page(
        TITLE,
        "px4fuse replays KF and replaces its settings and equations by those of EKF2, one after "
        "another. Each bar is the reduction of the mean square difference KF - EKF2 by one "
        "replacement; a hatched bar is an increase. The bars add up to 100 %.",
    )
    for name, explanation in explanation_by_axis.items():
        if isinstance(explanation, DifferenceExplanation):
            _draw_axis_explanation(page, name, explanation, analysis)
    replay = analysis.ekf2_replay
    assert isinstance(replay, Ekf2Replay)
    assert replay.agreement is not None
    page.write_small_text(f"EKF2 replay: {format_replay_agreement(replay.agreement)}.")
    yield page


def _select_difference_explanations(
    analysis: Analysis,
) -> Mapping[str, DifferenceExplanation | Unavailable]:
    """Return the explanations of the difference KF - EKF2, by axis."""
    explanation_by_axis = analysis.difference_steps
    return (
        {AISLE: explanation_by_axis[AISLE]} if AISLE in explanation_by_axis else explanation_by_axis
    )


def _has_explanation(
    explanation_by_axis: Mapping[str, DifferenceExplanation | Unavailable],
) -> bool:
    return any(isinstance(entry, DifferenceExplanation) for entry in explanation_by_axis.values())


def write_explanation(page: Page, explanation: DifferenceExplanation | Unavailable) -> None:
    """Write the explanation of the difference KF - EKF2, or why it is missing."""
    if isinstance(explanation, Unavailable):
        page.write_labelled(
            "KF-EKF2",
            f"The difference between KF and EKF2 cannot be explained: {explanation.reason}.",
        )
    else:
        page.write_labelled("KF-EKF2", explanation.sentences[0])


def describe_missing_explanation(analysis: Analysis) -> str:
    """Return the reason why the difference KF - EKF2 has no explanation, if any."""
    explanation_by_axis = _select_difference_explanations(analysis)
    if isinstance(analysis.flight.ekf2, Unavailable) or _has_explanation(explanation_by_axis):
        return ""
    reasons = {
        f"{explanation.reason}. {explanation.remedy}": None
        for explanation in explanation_by_axis.values()
        if isinstance(explanation, Unavailable)
    }
    return (
        f"The difference between KF and EKF2 cannot be explained: {' '.join(reasons)}"
        if reasons
        else ""
    )


def format_replay_agreement(agreement: Agreement) -> str:
    correlation_text = ", ".join(
        f"{axis.innovation_correlation:.4f} ({name})" for name, axis in agreement.axes.items()
    )
    ratio_text = ", ".join(
        f"{axis.s_ratio_median:.3f} (5 to 95 % {axis.s_ratio_p5:.3f} to {axis.s_ratio_p95:.3f})"
        for axis in agreement.axes.values()
    )
    sentences = [
        f"{'agrees' if agreement.good else 'does not agree'} with the log ({agreement.reason})",
        f"Correlation of {agreement.samples} replayed with logged innovations: {correlation_text}",
        f"Replayed ÷ logged innovation variance S: {ratio_text}",
        f"Rejected samples: {agreement.rejected_fraction_replayed:.1%} in the replay, "
        f"{agreement.rejected_fraction_logged:.1%} in the log",
        *(
            f"The replay of {AIDS[name].label} does not agree with the log and is not used: "
            f"{reason}"
            for name, reason in agreement.doubtful.items()
        ),
    ]
    return ". ".join(sentences)


def _draw_axis_explanation(
    page: Page, name: str, explanation: DifferenceExplanation, analysis: Analysis
) -> None:
    spans_text = ", ".join(f"{start:.0f} to {end:.0f} s" for start, end in explanation.spans_s)
    page.write_heading(f"{name}, {spans_text}")
    for sentence in explanation.sentences:
        page.write(sentence, size=8.5, gap_above=1.0)
    setting_names = [step.name for step in explanation.steps]
    columns = make_two_columns(LEFT_COLUMN_FRACTION)
    quantities = (
        ("position", "m", "m2", explanation.unexplained_mean_square_m2),
        ("velocity", "m/s", "m2_s2", explanation.unexplained_velocity_mean_square_m2_s2),
    )
    for column, left_margin, (quantity, unit, squared_unit, unexplained) in zip(
        columns, (LABEL_WIDTH, 4.0), quantities, strict=True
    ):
        mean_square_field_name = f"{quantity}_mean_square_{squared_unit}"
        total_mean_square = getattr(explanation, mean_square_field_name)
        mean_square_reductions = np.array(
            [getattr(step, mean_square_field_name) for step in explanation.steps]
        )
        title = f"{quantity} difference, {np.sqrt(total_mean_square):.3f} {unit} RMS"
        height = BAR_ROW_HEIGHT * (len(setting_names) + 2)
        axes = column.add_panel(title, height, left_margin=left_margin)
        contributions_percent = (
            100.0 * mean_square_reductions / total_mean_square,
            100.0 * unexplained / total_mean_square,
        )
        _draw_waterfall(axes, setting_names, *contributions_percent)
    axes.set_yticklabels([])
    page.add_columns(*columns)
    axes = event_marks.add_panel(
        page,
        analysis,
        "Position difference KF - EKF2 (m): total (dark) and unexplained part (light)",
        TIME_PLOT_HEIGHT,
        caption=_describe_largest_difference(explanation),
        axis=name,
    )
    position_difference_m, unexplained_difference_m = (
        pd.Series(values, explanation.times_s)
        for values in (explanation.kf_minus_ekf2_m, explanation.unexplained_difference_m)
    )
    for start, end in explanation.spans_s:
        draw_curve(axes, position_difference_m.loc[start:end], **TRACK_STYLES["KF"])
        draw_curve(axes, unexplained_difference_m.loc[start:end], color=EKF2_COLOUR, lw=0.8)


def _draw_waterfall(
    axes: Axes, setting_names: list[str], reductions_percent: Array, unexplained_percent: float
) -> None:
    """Draw the contribution (%) of each setting to the mean square difference KF - EKF2."""
    bar_ends = 100.0 - np.concatenate([[0.0], np.cumsum(reductions_percent)])
    row_count, right_end = len(setting_names) + 2, max(100.0, float(bar_ends.max()))
    kf_bar_style: dict[str, Any] = {"height": 0.7, "edgecolor": KF_COLOUR, "lw": 0.6}
    axes.barh(0, 100.0, **kf_bar_style, color=KF_COLOUR)
    for row, (reduction, bar_start) in enumerate(
        zip(reductions_percent, bar_ends, strict=False), start=1
    ):
        bar_style = INCREASE_BAR_STYLE if reduction < 0.0 else {"color": KF_BAND_COLOUR}
        axes.barh(row, -reduction, left=bar_start, **kf_bar_style, **bar_style)
        axes.plot([bar_start] * 2, [row - 1.35, row + 0.35], color=MUTED_COLOUR, lw=0.5)
    ekf2_bar_style = kf_bar_style | {"color": EKF2_BAND_COLOUR, "edgecolor": EKF2_COLOUR}
    axes.barh(row_count - 1, unexplained_percent, **ekf2_bar_style)
    for row, percent in enumerate((100.0, *reductions_percent, unexplained_percent)):
        digits = 1 if 0.05 <= abs(percent) < 9.95 else 0
        axes.text(1.03 * right_end, row, f"{percent:z.{digits}f} %", va="center", size=8.0)
    axes.set_yticks(range(row_count), ["total difference", *setting_names, "unexplained"])
    axes.set_ylim(row_count - 0.4, -0.6)
    axes.set_xlim(min(0.0, float(bar_ends.min())), 1.2 * right_end)
    axes.set_xlabel("% of the mean square difference KF - EKF2")


def _describe_largest_difference(explanation: DifferenceExplanation) -> str:
    differences_m = np.abs(explanation.kf_minus_ekf2_m)
    row = int(np.argmax(differences_m))
    return (
        f"Largest difference KF - EKF2: {differences_m[row]:.2g} m at "
        f"{explanation.times_s[row]:.1f} s; RMS of the part that no setting explains: "
        f"{np.sqrt(np.mean(explanation.unexplained_difference_m**2)):.2g} m."
    )
