"""Checks of the filter: its settings, its consistency, the clocks that it rests on."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from px4fuse.comparison.model import FilterName, FilterSummary
from px4fuse.filter.clock import Clock
from px4fuse.filter.consistency import HorizontalNis
from px4fuse.filter.tuning import HORIZONTAL, Tuned
from px4fuse.grading.evidence import Evidence, absence, drifts, text_of, why_not_horizontal
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
    above = chosen / high if high > 0.0 else math.inf
    # small innovations do not make a drifting source trustworthy
    off = max(1.0 if chosen > high and drifts(evidence) else above, low / chosen, 1.0)
    said = f"your {label} {chosen:.3g} {unit} is"
    wanted = f"what the data ask for ({low:.3g} to {high:.3g} {unit})"
    if off == 1.0 and chosen > high:
        return 1.0, f"{said} above {wanted}, as it should be for a source that may drift"
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
        # small innovations do not make a drifting source trustworthy
        excused = "overstated" in verdict and drifts(evidence)
        gone = given["factor"] <= off or given["factor"] <= 1.0
        # no noise explains outliers, and none should be made to
        outliers = "understated" in verdict and evidence.has("source_outliers")
        explained = outliers and evidence.claims_that("source_outliers")
        handed = not explained and _nothing_more(evidence)
        if good or explained or excused or handed:
            shares.append(1.0)
        else:
            shares.append(0.0 if gone else 1.0 - math.log(off) / math.log(given["factor"]))
        causes = (
            (explained, ", because of outliers that no setting fixes, as your notes say"),
            (outliers, ", because of outliers that no setting fixes; your notes should say so"),
            (excused, ", as it may be against a source that may drift"),
            (
                handed,
                ", because of what is wrong with the log that you were given, as your notes say",
            ),
            (
                True,
                ": look at what the tuning page asks for, and for what the model does not explain",
            ),
        )
        because = next(text for holds, text in causes if holds)
        said.append(
            f"{owner} is consistent ({axis})"
            if good
            else f"{verdict} by a factor of {factor_words(off)} ({owner}, {axis}){because}"
        )
    comment = "; ".join(said) or "the rubric names no axis"
    return sum(shares) / max(len(shares), 1), f"{comment[:1].upper() + comment[1:]}."


def _handed_out(evidence: Evidence) -> tuple[str, ...]:
    """What is wrong with the log that the student was given."""
    return () if evidence.answer is None else evidence.answer.findings


def _nothing_more(evidence: Evidence) -> bool:
    """Whether a student has found all that is wrong with the log, and set what the data ask for."""
    named = set(_handed_out(evidence))
    return bool(named) and named <= evidence.claims.earned and not evidence.notes.problem and all(
        _tuned(evidence, HORIZONTAL, name, 2.0)[0] == 1.0 for name in SIGMAS
    )  # fmt: skip


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
    if any(evidence.has(name) or name in _handed_out(evidence) for name in CHANGING):
        return _changing(evidence, given["undeterminable"])
    return 0.0, (
        f"{said} where the data ask for {low:.3f} to {high:.3f} s; set it with --clock-offset, or "
        "use --clock-offset auto."
    )


def _changing(evidence: Evidence, unnoticed: float) -> tuple[float, str]:
    """Stamps for which no single offset is right."""
    said = "The offset of the position stamps changes in your flight: no single one is right"
    if any(map(evidence.claims_that, CHANGING)):
        return 1.0, f"{said}, as your notes say."
    return unnoticed, f"{said}; say in your notes from when on it holds, and why."
