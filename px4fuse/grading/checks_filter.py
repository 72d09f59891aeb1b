"""Checks of the filter: its settings, its consistency, the clocks that it rests on."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from px4fuse.comparison.model import AgainstTruth, FilterName, FilterSummary
from px4fuse.filter.clock import Clock
from px4fuse.filter.consistency import HorizontalNis
from px4fuse.filter.tuning import HORIZONTAL, Tuned
from px4fuse.grading.evidence import Evidence, absence, drifts, text_of, why_not_horizontal
from px4fuse.loop.model import LoopPart
from px4fuse.plain import factor_words
from px4fuse.results.comparison import ASKED

# Findings about stamps for which no single offset is right
CHANGING = ("source_clock_changes", "source_stamps_of_arrival")
SIGMAS = ("sigma_z_m", "sigma_a_m_s2")


def tuning(evidence: Evidence, given: Mapping[str, Any]) -> tuple[float, str]:
    """Chosen noises are what the data ask for."""
    axis = given["axis"]
    shares, said = [], []
    for name in given["settings"]:
        share, comment = _tuned(evidence, axis, name, given["factor"])
        shares.append(share)
        said.append(comment)
    if not shares:
        return 0.0, "The rubric asks for no setting."
    return sum(shares) / len(shares), f"{'; '.join(said)}."


def _tuned(evidence: Evidence, axis: str, name: str, factor: float) -> tuple[float, str]:
    label, unit = {"sigma_z_m": ("SIGMA_Z", "m")}.get(name, ("SIGMA_A", "m/s²"))
    comparison = evidence.comparison
    if comparison is None:
        return 0.0, f"Your report does not say which {label} you chose"
    chosen: float = getattr(comparison.settings, name)
    tuned = comparison.tuning.get(axis)
    interval = None
    if isinstance(tuned, Tuned):
        asked = ASKED[name]
        interval = getattr(tuned, f"{asked}_interval")
    if interval is None or interval[1] is None:
        why = absence(tuned) or (why_not_horizontal(evidence) if axis == HORIZONTAL else "")
        return 0.0, f"Your report has no interval for {label}{why}"
    low, high = interval
    if name == "sigma_z_m" and drifts(evidence):
        # small innovations do not make a drifting source trustworthy: up to its error is right
        high = max(high, _error_m(evidence))
    above = chosen / high if high > 0.0 else math.inf
    off = max(above, low / chosen, 1.0)
    said = f"your {label} {chosen:.3g} {unit} is"
    wanted = f"what the data ask for ({low:.3g} to {high:.3g} {unit})"
    if off == 1.0:
        return 1.0, f"{said} within {wanted}"
    share = 1.0 - math.log(off) / math.log(factor) if factor > max(off, 1.0) else 0.0
    side = "above" if chosen > high else "below"
    option = "--sigma-z" if label == "SIGMA_Z" else "--sigma-a"
    return share, (
        f"{said} {side} {wanted}, by a factor of {factor_words(off)}: try a value between with "
        f"{option}"
    )


def consistent(evidence: Evidence, given: Mapping[str, Any]) -> tuple[float, str]:
    """A filter is consistent, or the notes say why it cannot be."""
    shares, said = [], []
    owner = "your filter" if given["filter"] == "kf" else "EKF2"
    for axis in given["axes"]:
        judged, why = _judged(evidence, axis, given["filter"])
        if judged is None:
            shares.append(0.0)
            said.append(f"there is no verdict on {owner} ({axis}){why}")
            continue
        verdict, factor = judged.verdict, judged.variance_factor
        off = max(factor, 1.0 / factor)
        good = verdict == "consistent"
        gone = given["factor"] <= off or given["factor"] <= 1.0
        right = not good and _settings_are_right(evidence)
        if good or right:
            shares.append(1.0)
        else:
            shares.append(0.0 if gone else 1.0 - math.log(off) / math.log(given["factor"]))
        because = (
            ", with the noises that the data ask for: what is left no setting fixes"
            if right
            else ": look at what the tuning page asks for, and for what the model does not explain"
        )
        said.append(
            f"{owner} is consistent ({axis})"
            if good
            else f"{verdict} by a factor of {factor_words(off)} ({owner}, {axis}){because}"
        )
    comment = "; ".join(said) or "the rubric names no axis"
    return sum(shares) / max(len(shares), 1), f"{comment[:1].upper() + comment[1:]}."


def _settings_are_right(evidence: Evidence) -> bool:
    """Whether both noises are what the data ask for, so that nothing more can be set."""
    return all(_tuned(evidence, HORIZONTAL, name, 2.0)[0] == 1.0 for name in SIGMAS)


def _error_m(evidence: Evidence) -> float:
    """How wrong a source that drifts is, as far as a loop or the truth tells; 0 where neither."""
    comparison = evidence.comparison
    if comparison is None:
        return 0.0
    found = [
        truth.position_rmse_m
        for axis in comparison.axes.values()
        if isinstance(truth := axis.filters["kf"].truth, AgainstTruth)
    ]
    loop = comparison.loop
    if isinstance(loop, LoopPart):
        found.append(loop.closure_error_m or 0.0)
    return max(found, default=0.0)


def _judged(
    evidence: Evidence, axis: str, which: FilterName
) -> tuple[FilterSummary | HorizontalNis | None, str]:
    """The consistency of a filter along an axis, or why there is none."""
    comparison = evidence.comparison
    if comparison is None:
        return None, ""
    if axis == HORIZONTAL:
        return comparison.horizontal.get(which), why_not_horizontal(evidence)
    analysed = comparison.axes.get(axis)  # type: ignore[call-overload]
    found = None if analysed is None else analysed.filters.get(which)
    return (found, "") if isinstance(found, FilterSummary) else (None, absence(found))


def clock(evidence: Evidence, given: Mapping[str, Any]) -> tuple[float, str]:
    """The clock offset that was applied is what the data ask for."""
    comparison = evidence.comparison
    clock = None if comparison is None else comparison.clock
    if not isinstance(clock, Clock):
        said = f"Your report says nothing about the clock offset{absence(clock)}"
        if comparison is None or evidence.answer is None:
            return 0.0, f"{said}."
        return 1.0, f"{said}, which is not your choice."
    interval, applied = clock.interval_s, clock.applied_s
    if not clock.determinable:
        said = "Your flight does not determine the clock offset"
        said += f" ({text_of(clock.reason).rstrip('.')})" if clock.reason else ""
        handed_out = evidence.answer is not None
        return 1.0 if handed_out else given["undeterminable"], (
            f"{said}, which is not your choice." if handed_out
            else f"{said}; fly clear starts and stops."
        )  # fmt: skip
    low, high = interval
    said = f"You applied a clock offset of {applied:.3f} s"
    if low - given["margin_s"] <= applied <= high + given["margin_s"]:
        return 1.0, f"{said}, which is what the data ask for ({low:.3f} to {high:.3f} s)."
    if any(map(evidence.has, CHANGING)):
        return _changing(evidence, given["undeterminable"])
    return 0.0, (
        f"{said} where the data ask for {low:.3f} to {high:.3f} s; set it with --clock-offset, or "
        "use --clock-offset auto."
    )


def _changing(evidence: Evidence, unnoticed: float) -> tuple[float, str]:
    """Stamps for which no single offset is right."""
    said = "The offset of the position stamps changes in your flight: no single one is right"
    if evidence.claims("clock-jump", "clock-drift"):
        return 1.0, f"{said}, as your form says."
    return unnoticed, f"{said}; say in your form from when on it holds."
