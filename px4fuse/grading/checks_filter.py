"""Checks of the filter: its settings, its consistency, the clocks that it rests on."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from msgspec import Meta

from px4fuse.comparison.model import AgainstTruth, FilterName, FilterSummary
from px4fuse.filter.clock import Clock
from px4fuse.filter.consistency import HorizontalNis
from px4fuse.filter.tuning import HORIZONTAL
from px4fuse.grading.evidence import (
    Evidence,
    Factor,
    RubricItem,
    Scored,
    Text,
    absence,
    falling,
    text_of,
)
from px4fuse.loop.model import LoopPart
from px4fuse.plain import capital, factor_words
from px4fuse.record import Share
from px4fuse.results.comparison import ASKED
from px4fuse.results.contract import ComparisonResults

# Findings about stamps for which no single offset is right
CHANGING = ("source_clock_changes", "source_stamps_of_arrival")
Sigma = Literal["sigma_z_m", "sigma_a_m_s2"]
# How each noise is called, its unit, and its option
SIGMAS: dict[Sigma, tuple[str, str, str]] = {
    "sigma_z_m": ("SIGMA_Z", "m", "--sigma-z"),
    "sigma_a_m_s2": ("SIGMA_A", "m/s²", "--sigma-a"),
}


class TuningItem(RubricItem, frozen=True, kw_only=True, tag="tuning"):
    """Chosen noises are what the data ask for; none of the points from ``factor`` off."""

    settings: Annotated[tuple[Sigma, ...], Meta(min_length=1)] = tuple(SIGMAS)
    axis: Text = HORIZONTAL
    factor: Factor = 2.0

    def score(self, evidence: Evidence) -> Scored:
        """Mean over the settings."""
        found = [_tuned(evidence, self.axis, name, self.factor) for name in self.settings]
        mean = sum(share for share, _ in found) / len(found)
        return mean, f"{'; '.join(said for _, said in found)}."


def _tuned(evidence: Evidence, axis: str, name: Sigma, factor: float) -> Scored:
    label, unit, option = SIGMAS[name]
    comparison = evidence.comparison
    if comparison is None:
        return 0.0, f"your report does not say which {label} you chose"
    chosen: float = getattr(comparison.settings, name)
    interval = getattr(comparison.tuning.get(axis), f"{ASKED[name]}_interval", None)
    if interval is None or interval[1] is None:
        return (
            0.0,
            f"your report has no interval for {label}{evidence.why_absent(f'tuning.{axis}')}",
        )
    low, high = interval
    if name == "sigma_z_m" and evidence.has("source_may_drift"):
        # small innovations do not make a drifting source trustworthy: up to its error is right
        high = max(high, _error_m(comparison))
    off = max(chosen / high if high > 0.0 else math.inf, low / chosen, 1.0)
    said = f"your {label} {chosen:.3g} {unit} is"
    wanted = f"what the data ask for ({low:.3g} to {high:.3g} {unit})"
    if off == 1.0:
        return 1.0, f"{said} within {wanted}"
    side = "above" if chosen > high else "below"
    return falling(off, factor), (
        f"{said} {side} {wanted}, by a factor of {factor_words(off)}: try a value between with "
        f"{option}"
    )


def _error_m(comparison: ComparisonResults) -> float:
    """How wrong a source that drifts is, as far as a loop or the truth tells; 0 where neither."""
    truths = [axis.filters["kf"].truth for axis in comparison.axes.values()]
    found = [truth.position_rmse_m for truth in truths if isinstance(truth, AgainstTruth)]
    if isinstance(comparison.loop, LoopPart):
        found.append(comparison.loop.closure_error_m or 0.0)
    return max(found, default=0.0)


class ConsistencyItem(RubricItem, frozen=True, kw_only=True, tag="consistent"):
    """A filter is consistent, or no setting can make it so; none of the points from ``factor``."""

    filter: FilterName = "kf"
    axes: Annotated[tuple[Text, ...], Meta(min_length=1)] = (HORIZONTAL,)
    factor: Factor = 1.5

    def score(self, evidence: Evidence) -> Scored:
        """Mean over the axes."""
        found = [self._of_axis(evidence, axis) for axis in self.axes]
        mean = sum(share for share, _ in found) / len(found)
        return mean, f"{capital('; '.join(said for _, said in found))}."

    def _of_axis(self, evidence: Evidence, axis: str) -> Scored:
        owner = "your filter" if self.filter == "kf" else "EKF2"
        comparison = evidence.comparison
        judged: object = None
        path = f"{HORIZONTAL}.{self.filter}"
        if comparison is not None and axis == HORIZONTAL:
            judged = comparison.horizontal.get(self.filter)
        elif comparison is not None:
            path = f"axes.{axis}.filters.{self.filter}"
            analysed = comparison.axes.get(axis)  # type: ignore[call-overload]
            judged = analysed and analysed.filters.get(self.filter)
        if not isinstance(judged, FilterSummary | HorizontalNis):
            return 0.0, f"there is no verdict on {owner} ({axis}){evidence.why_absent(path)}"
        if judged.verdict == "consistent":
            return 1.0, f"{owner} is consistent ({axis})"
        off = max(judged.variance_factor, 1.0 / judged.variance_factor)
        said = f"{judged.verdict} by a factor of {factor_words(off)} ({owner}, {axis})"
        if all(_tuned(evidence, HORIZONTAL, name, 2.0)[0] == 1.0 for name in SIGMAS):
            return 1.0, (
                f"{said}, with the noises that the data ask for: what is left no setting fixes"
            )
        return falling(off, self.factor), (
            f"{said}: look at what the tuning page asks for, and for what the model does not "
            "explain"
        )


class ClockItem(RubricItem, frozen=True, kw_only=True, tag="clock"):
    """The clock offset that was applied is what the data ask for."""

    margin_s: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.03
    undeterminable: Share = 0.5

    def score(self, evidence: Evidence) -> Scored:
        """All or nothing, ``undeterminable`` where the flight does not tell."""
        comparison, handed_out = evidence.comparison, evidence.answer is not None
        clock = None if comparison is None else comparison.clock
        if not isinstance(clock, Clock):
            excused = comparison is not None and handed_out
            said = f"Your report says nothing about the clock offset{absence(clock)}"
            return float(excused), f"{said}{', which is not your choice' * excused}."
        if not clock.determinable:
            said = "Your flight does not determine the clock offset"
            said += f" ({text_of(clock.reason).rstrip('.')})" if clock.reason else ""
            advice = ", which is not your choice" if handed_out else "; fly clear starts and stops"
            return 1.0 if handed_out else self.undeterminable, f"{said}{advice}."
        (low, high), applied = clock.interval_s, clock.applied_s
        said = f"You applied a clock offset of {applied:.3f} s"
        if low - self.margin_s <= applied <= high + self.margin_s:
            return 1.0, f"{said}, which is what the data ask for ({low:.3f} to {high:.3f} s)."
        if any(map(evidence.has, CHANGING)):
            said = (
                "The offset of the position stamps changes in your flight: no single one is right"
            )
            known = evidence.claims("clock-jump", "clock-drift")
            advice = ", as your form says" if known else "; say in your form from when on it holds"
            return 1.0 if known else self.undeterminable, f"{said}{advice}."
        return 0.0, (
            f"{said} where the data ask for {low:.3f} to {high:.3f} s; set it with --clock-offset, "
            "or use --clock-offset auto."
        )
