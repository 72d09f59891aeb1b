"""Report page on the difference between KF and EKF2, and the contribution of each setting."""

from collections.abc import Iterator, Mapping

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.ekf2.replay import ReplayAgreement
from px4fuse.ekf2.steps import DifferenceExplanation
from px4fuse.flight.ekf2_parameters import AIDS
from px4fuse.flight.model import Unavailable

from .page import Page, make_columns
from .panels import add_time_panel
from .style import (
    EKF2_COLOUR,
    KF_BAND_COLOUR,
    KF_COLOUR,
    TRACK_STYLES,
    draw_curve,
)

BAR_ROW_HEIGHT = 12.0  # points
LABEL_WIDTH = 125.0  # points
TIME_PLOT_HEIGHT = 105.0  # points


def draw_pages(analysis: Analysis, _: object) -> Iterator[Page]:
    """Draw the contribution of each EKF2 setting to the mean square difference KF - EKF2."""
    name, model = analysis.main.axis.name, analysis.ekf2_model
    explanation = analysis.difference_steps.get(name)
    if not isinstance(explanation, DifferenceExplanation):
        return
    page = Page(
        "Difference between KF and EKF2, setting by setting",
        "px4fuse replays KF and replaces its settings and equations by those of EKF2, one after "
        "another. Each bar is the reduction of the mean square difference KF - EKF2 by one "
        "replacement.",
    )
    spans_text = ", ".join(f"{start:.0f} to {end:.0f} s" for start, end in explanation.spans_s)
    page.write_heading(f"{name}, {spans_text}")
    for sentence in explanation.sentences:
        page.write(sentence)
    left_column, right_column = make_columns()
    _draw_contributions(
        left_column,
        "Contributions to the position difference KF - EKF2",
        {step.name: step.position_mean_square_m2 for step in explanation.steps},
        explanation.unexplained_mean_square_m2,
        explanation.position_mean_square_m2,
    )
    _draw_contributions(
        right_column,
        "Contributions to the velocity difference KF - EKF2",
        {step.name: step.velocity_mean_square_m2_s2 for step in explanation.steps},
        explanation.unexplained_velocity_mean_square_m2_s2,
        explanation.velocity_mean_square_m2_s2,
    )
    page.add_columns(left_column, right_column)
    difference_m = pd.Series(explanation.kf_minus_ekf2_m, explanation.times_s)
    axes = add_time_panel(
        page,
        analysis,
        "Position difference KF - EKF2 (m): total (dark), remainder after all replacements (light)",
        TIME_PLOT_HEIGHT,
    )
    unexplained_difference_m = pd.Series(explanation.unexplained_difference_m, explanation.times_s)
    for start, end in explanation.spans_s:
        draw_curve(axes, difference_m.loc[start:end], **TRACK_STYLES["KF"])
        draw_curve(axes, unexplained_difference_m.loc[start:end], color=EKF2_COLOUR, lw=0.8)
    assert not isinstance(model, Unavailable)
    page.write_muted_text(f"{format_replay_agreement(model.agreement)}.")
    yield page


def describe_missing_explanation(analysis: Analysis) -> str:
    """Return the reason why the difference KF - EKF2 has no explanation, if any."""
    explanation = analysis.difference_steps.get(analysis.main.axis.name)
    if isinstance(analysis.flight.ekf2, Unavailable) or not isinstance(explanation, Unavailable):
        return ""
    return (
        f"The difference between KF and EKF2 cannot be explained: {explanation.reason}. "
        f"{explanation.remedy}"
    )


def format_replay_agreement(agreement: ReplayAgreement) -> str:
    """State if the replay of EKF2 agrees with the log, without the last full stop."""
    sentences = [
        f"The replay {'agrees' if agreement.good else 'does not agree'} with the log "
        f"({agreement.reason})",
        *(
            f"The replay of {AIDS[name].label} does not agree with the log and is not used: "
            f"{reason}"
            for name, reason in agreement.doubtful.items()
        ),
    ]
    return ". ".join(sentences)


def _draw_contributions(
    column: Page,
    title: str,
    reduction_by_setting: Mapping[str, float],
    unexplained_mean_square: float,
    total_mean_square: float,
) -> None:
    """Draw the contribution (%) of each setting to the mean square difference KF - EKF2."""
    names = [*reduction_by_setting, "unexplained"]
    percents = (
        100.0
        / total_mean_square
        * np.array([*reduction_by_setting.values(), unexplained_mean_square])
    )
    max_percent = percents.max()
    axes = column.add_panel(title, BAR_ROW_HEIGHT * len(names), left_margin=LABEL_WIDTH)
    rows = range(len(names))
    axes.barh(rows, percents, height=0.7, color=KF_BAND_COLOUR, edgecolor=KF_COLOUR, lw=0.6)
    axes.set_yticks(rows, names)
    for row, percent in enumerate(percents):
        axes.text(1.05 * max_percent, row, f"{percent:z.1f} %", va="center", size=8.0)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.set_xlim(min(0.0, 1.1 * percents.min()), 1.5 * max_percent)
    axes.set_xlabel("% of the mean square difference")
