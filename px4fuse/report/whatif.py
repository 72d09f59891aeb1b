"""Terminal output of ``px4fuse whatif``: EKF2 replayed with other parameters."""

import math

from px4fuse.analysis import WhatIfAnalysis
from px4fuse.core.text import format_number
from px4fuse.ekf2.whatif import (
    ADDED_POSITION_SIGMA_M,
    HEIGHT_TIMEOUT_S,
    MAX_REJECTED_FRACTION,
    AidStatistics,
    AxisStatistics,
    Ekf2Statistics,
)
from px4fuse.flight.ekf2_parameters import AIDS, PARAMETERS
from px4fuse.flight.model import Unavailable
from px4fuse.report.difference_page import format_replay_agreement
from px4fuse.report.page import Page

NOT_PREDICTABLE_TEXT = "not predictable"


def make_column_headings(analysis: WhatIfAnalysis) -> list[str]:
    change_texts = [
        f"{name} {format_number(value)} {PARAMETERS[name].unit}".rstrip()
        for name, value in analysis.changes.items()
    ]
    change_texts += [
        f"without {name} from {start_s:g} s" for name, start_s in analysis.without.items()
    ]
    headings = ["logged", "replayed as flown"]
    if change_texts:
        estimate_note = " (maximum-likelihood estimate)" if analysis.uses_estimates else ""
        headings.append(f"replayed, changed: {', '.join(change_texts)}{estimate_note}")
    return headings


def make_statistic_rows(analysis: WhatIfAnalysis) -> list[list[str]]:
    """Return the statistics of EKF2 as logged, replayed, and replayed with other parameters."""
    result = analysis.statistics
    texts_by_label = _format_statistics(result.replayed, result.replayed)
    columns = [
        _format_statistics(summary, result.replayed)
        if summary.is_predictable
        else dict.fromkeys(texts_by_label, NOT_PREDICTABLE_TEXT)
        for summary in (
            result.logged,
            result.replayed,
            *result.whatif[: analysis.sweep_start_index],
        )
    ]
    return [[label, *(column.get(label, "n/a") for column in columns)] for label in texts_by_label]


def _format_statistics(summary: Ekf2Statistics, replayed_summary: Ekf2Statistics) -> dict[str, str]:
    text_by_label = dict[str, str]()
    for name, axis in summary.axes.items():
        text_by_label |= _format_nis_statistics(name, axis) | {
            f"{name}: median σ_p (m)": _format_number(axis.sigma_p_median_m),
            f"{name}: position RMSE (m)": _format_number(axis.position_rmse_to_truth_m),
        }
    text_by_label |= {"samples": f"{summary.samples}", **_format_fusion_statistics(summary)}
    if summary.velocity_rejected_fraction is not None:
        text_by_label["GNSS velocities rejected"] = f"{summary.velocity_rejected_fraction:.1%}"
    if isinstance(replayed_summary.heading_error_mean_deg, float):
        text_by_label["mean heading error (°)"] = _format_number(summary.heading_error_mean_deg, 1)
    if replayed_summary.heights:
        text_by_label["height RMSE (m)"] = _format_number(summary.height_rmse_to_truth_m)
    for name, aid in {**summary.heights, **summary.others}.items():
        label = AIDS[name].label
        text_by_label |= _format_nis_statistics(label, aid) | {
            f"{label}: rejected": f"{aid.rejected_fraction:.1%}"
        }
    return text_by_label


def _format_nis_statistics(name: str, statistics: AxisStatistics | AidStatistics) -> dict[str, str]:
    return {
        f"{name}: mean NIS": format_number(statistics.nis_mean),
        f"{name}: expected NIS": "{:.2f} to {:.2f}".format(*statistics.nis_band),
        f"{name}: std of ν (m)": _format_number(statistics.innovation_std_m),
    }


def _format_fusion_statistics(summary: Ekf2Statistics) -> dict[str, str]:
    return {
        "rejected": f"{summary.rejected_fraction:.1%}",
        "longest time without fusion (s)": _format_number(summary.longest_without_fusion_s, 2),
        "position resets": f"{summary.resets}",
    }


def make_sweep_table(analysis: WhatIfAnalysis) -> tuple[list[str], list[list[str]]]:
    """Return headings and rows of a table: EKF2 statistics for each value of a parameter."""
    parameter_name, rows = find_swept_parameter(analysis), []
    unit = PARAMETERS[parameter_name].unit
    for summary in select_sweep_summaries(analysis):
        axes = summary.axes.values()
        cells = [
            "/".join(format_number(axis.nis_mean) for axis in axes),
            *_format_fusion_statistics(summary).values(),
            "/".join(_format_number(axis.sigma_p_median_m) for axis in axes),
            "/".join(_format_number(axis.position_rmse_to_truth_m) for axis in axes),
        ]
        if not summary.is_predictable:
            cells = [NOT_PREDICTABLE_TEXT, *[""] * 5]
        rows.append([format_number(summary.changed[parameter_name]), *cells])
    head = [
        f"{parameter_name} ({unit})" if unit else parameter_name,
        "mean NIS N/E",
        "rejected",
        "longest gap (s)",
        "resets",
        "σ_p N/E (m)",
        "RMSE N/E (m)",
    ]
    return head, rows


def select_sweep_summaries(analysis: WhatIfAnalysis) -> tuple[Ekf2Statistics, ...]:
    return analysis.statistics.whatif[analysis.sweep_start_index :]


def find_swept_parameter(analysis: WhatIfAnalysis) -> str:
    (name,) = select_sweep_summaries(analysis)[0].changed.keys() - analysis.changes.keys()
    return name


def describe_sweep(analysis: WhatIfAnalysis) -> list[str]:
    """Describe the best value of a parameter in the replays of EKF2."""
    summaries = [summary for summary in select_sweep_summaries(analysis) if summary.is_predictable]
    sentences = []
    if summaries:
        parameter_name = find_swept_parameter(analysis)
        best_summary = min(summaries, key=lambda s: abs(math.log(s.nis_mean)))
        sentences.append(
            f"The mean NIS is closest to 1 at {parameter_name} "
            f"{format_number(best_summary.changed[parameter_name])} "
            f"({format_number(best_summary.nis_mean)})."
        )
        rmse_value_pairs = [
            (rmse_m, summary.changed[parameter_name])
            for summary in summaries
            if isinstance(rmse_m := summary.position_rmse_to_truth_m, float)
        ]
        if rmse_value_pairs:
            rmse_m, value = min(rmse_value_pairs)
            sentences.append(
                "The horizontal position RMSE against ground truth is smallest at "
                f"{parameter_name} {format_number(value)} ({rmse_m:.3f} m)."
            )
    if not all(summary.is_predictable for summary in analysis.statistics.whatif):
        sentences.append(
            "'not predictable': the replay rejects more than "
            f"{MAX_REJECTED_FRACTION:.0%} of the samples, {1000.0 * ADDED_POSITION_SIGMA_M:.0f} mm "
            "of added position noise changes the results strongly, or the replay fuses no height "
            f"for {HEIGHT_TIMEOUT_S:g} s."
        )
    return [*sentences, *(f"{note}." for note in analysis.statistics.notes)]


def _format_number(value: float | Unavailable, digits: int = 3) -> str:
    return "n/a" if isinstance(value, Unavailable) else f"{value:.{digits}f}"


def make_whatif_page(analysis: WhatIfAnalysis) -> Page:
    page = Page()
    log, whatif_result = analysis.flight.log, analysis.statistics
    page.write_labelled("Log", f"{log.name}, {log.firmware}, {log.duration_s:.1f} s")
    spans_text = ", ".join(
        f"{start:.1f} to {end:.1f} s" for start, end in whatif_result.evaluated_s
    )
    page.write_labelled("Segment", f"all statistics are from {spans_text}")
    page.write_labelled("Replay", format_replay_agreement(whatif_result.agreement))
    if analysis.uses_estimates and not analysis.changes:
        no_change_text = (
            "The logged noise and delay parameters fit this log best. "
            "Test another value with --set NAME=VALUE."
        )
        page.write_labelled("Change", no_change_text)
    head = ["", *make_column_headings(analysis)]
    page.add_table(head, make_statistic_rows(analysis), right_aligned_columns=range(1, len(head)))
    if select_sweep_summaries(analysis):
        page.add_table(*make_sweep_table(analysis), right_aligned_columns=range(1, 7))
    for line in describe_sweep(analysis):
        page.write(line)
    page.write("Replays use px4fuse's model of EKF2, not PX4's code.")
    return page
