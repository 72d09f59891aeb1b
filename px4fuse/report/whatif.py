"""Terminal output of ``px4fuse whatif``: EKF2 replayed with other parameters."""

import math
from collections.abc import Iterator

from px4fuse.analysis import WhatIfAnalysis
from px4fuse.core.text import format_number
from px4fuse.ekf2.whatif import (
    ADDED_POSITION_SIGMA_M,
    HEIGHT_TIMEOUT_S,
    MAX_REJECTED_SAMPLE_FRACTION,
    AidStatistics,
    AxisStatistics,
    Ekf2Statistics,
)
from px4fuse.flight.ekf2_parameters import AIDS, MODEL_PARAMETERS
from px4fuse.flight.model import Unavailable

from .difference_page import format_replay_agreement
from .page import Page

NOT_PREDICTABLE_TEXT = "not predictable"


def describe_changes(analysis: WhatIfAnalysis) -> str:
    """Describe the changed parameters and omitted aiding sources; "" without a change."""
    change_texts = [
        f"{name} {format_number(value)} {MODEL_PARAMETERS[name].unit}".rstrip()
        for name, value in analysis.changes.items()
    ]
    change_texts += [
        f"without {name} from {start_s:g} s" for name, start_s in analysis.without.items()
    ]
    estimate_note = " (maximum-likelihood estimate)" if analysis.uses_estimates else ""
    return ", ".join(change_texts) + estimate_note if change_texts else ""


def list_statistics(analysis: WhatIfAnalysis) -> Iterator[str]:
    """Yield lines with the statistics of EKF2 as replayed, and with changed parameters."""
    result, changes_text = analysis.statistics, describe_changes(analysis)
    changed_texts, change_text = dict[str, str](), ""
    if analysis.sweep_start_index:  # the first replay is not part of the sweep
        if result.whatif[0].is_predictable:
            changed_texts, change_text = _format_statistics(result.whatif[0]), f" → {changes_text}"
        else:
            yield f"EKF2 (replay), {changes_text}: {NOT_PREDICTABLE_TEXT}"
    spans_text = ", ".join(f"{start:.1f} to {end:.1f} s" for start, end in result.evaluated_s)
    yield f"{analysis.flight.log.name}, {spans_text}, EKF2 (replay) as flown{change_text}:"
    for label, replayed_text in _format_statistics(result.replayed).items():
        if replayed_text == "n/a":
            continue
        text = replayed_text
        if changed_texts:
            changed_text = changed_texts.get(label, "n/a")
            # Each text is a number, then its unit or the expected NIS. If both texts end with the
            # same unit, the unit is printed only once
            unit = changed_text.partition(" ")[2]
            text = f"{text.removesuffix(f' {unit}')} → {changed_text}"
        yield f"EKF2 (replay), {label} {text}"


def _format_statistics(summary: Ekf2Statistics) -> dict[str, str]:
    """Return each statistic with its unit, by label."""
    texts = dict[str, str]()
    for name, axis in summary.axes.items():
        texts |= {
            f"{name}: position RMSE": _format_number(axis.position_rmse_to_truth_m, " m"),
            f"{name}: mean NIS": _format_nis(axis),
            f"{name}: median reported position σ": _format_number(axis.sigma_p_median_m, " m"),
        }
    texts |= {
        "rejected positions": _format_percent(summary.rejected_fraction),
        "longest time without fusion": _format_number(summary.longest_without_fusion_s, " s", 2),
        "position resets": f"{summary.resets}",
    }
    if (rejected_fraction := summary.velocity_rejected_fraction) is not None:
        texts["rejected GNSS velocities"] = _format_percent(rejected_fraction)
    texts["mean heading error"] = _format_number(summary.heading_error_mean_deg, "°", 1)
    texts["height RMSE"] = _format_number(summary.height_rmse_to_truth_m, " m")
    for name, aid in {**summary.heights, **summary.others}.items():
        label = AIDS[name].label
        texts[f"{label}: mean NIS"] = _format_nis(aid)
        texts[f"{label}: rejected"] = _format_percent(aid.rejected_fraction)
    return texts


def _format_nis(statistics: AxisStatistics | AidStatistics) -> str:
    band_text = " (expected {:.2f} to {:.2f})".format(*statistics.nis_band)
    return format_number(statistics.nis_mean) + band_text


def _format_percent(fraction: float) -> str:
    return f"{100.0 * fraction:.1f} %"


def list_sweep_results(analysis: WhatIfAnalysis) -> Iterator[str]:
    """Yield a line with EKF2 statistics for each value of a parameter."""
    for summary in select_sweep_summaries(analysis):
        name = find_swept_parameter(analysis)
        value_text = f"{name} {format_number(summary.changed[name])} {MODEL_PARAMETERS[name].unit}"
        text = NOT_PREDICTABLE_TEXT
        if summary.is_predictable:
            text = (
                "horizontal position RMSE "
                f"{_format_number(summary.position_rmse_to_truth_m, ' m')}, "
                f"mean NIS {format_number(summary.nis_mean)}, "
                f"rejected {_format_percent(summary.rejected_fraction)}"
            )
        yield f"{value_text.rstrip()}: {text}"


def select_sweep_summaries(analysis: WhatIfAnalysis) -> tuple[Ekf2Statistics, ...]:
    return analysis.statistics.whatif[analysis.sweep_start_index :]


def find_swept_parameter(analysis: WhatIfAnalysis) -> str:
    """Return the only parameter of the sweep that is not one of the constant changes."""
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
            f"{MAX_REJECTED_SAMPLE_FRACTION:.0%} of the samples, "
            f"{1000.0 * ADDED_POSITION_SIGMA_M:.0f} mm "
            "of added position noise changes the results strongly, or the replay fuses no height "
            f"for {HEIGHT_TIMEOUT_S:g} s."
        )
    return [*sentences, *(f"{note}." for note in analysis.statistics.notes)]


def _format_number(value: float | Unavailable, unit: str, digits: int = 3) -> str:
    return "n/a" if isinstance(value, Unavailable) else f"{value:.{digits}f}{unit}"


def make_whatif_page(analysis: WhatIfAnalysis) -> Page:
    """Make the terminal output of ``px4fuse whatif``: statistics, sweep, and replay agreement."""
    page = Page()
    if analysis.uses_estimates and not analysis.changes:
        no_change_text = (
            "The logged noise and delay parameters fit this log best. "
            "Test another value with --set NAME=VALUE."
        )
        page.write_labelled_text("Change", no_change_text)
    lines = (*list_statistics(analysis), *describe_sweep(analysis), *list_sweep_results(analysis))
    for line in lines:
        page.write(line)
    page.write_labelled_text("Replay", format_replay_agreement(analysis.statistics.agreement))
    page.write("Replays use px4fuse's model of EKF2, not PX4's code.")
    return page
