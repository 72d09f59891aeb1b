"""SIGMA_Z or SIGMA_A is not what the innovations ask for, each told from the other.

The mean NIS alone cannot tell them apart: both make S larger. The likelihood can, since
SIGMA_A makes the innovations of a stretch agree with each other and SIGMA_Z does not.

Both are fitted together, so that they are put right together: the one that is further off comes
first. A setting that nobody chose is advice, one step less severe than one that was.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from msgspec import structs

from px4fuse.analysis import Analysis
from px4fuse.comparison.interventions import SMALLEST_SIGMA_Z_M, tuned_for
from px4fuse.comparison.model import Comparison
from px4fuse.comparison.remedy import filter_words
from px4fuse.filter.settings import Settings
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning, Noise
from px4fuse.findings.hidden_errors import hidden_errors
from px4fuse.findings.model import Found, Severity, error, finding, lowered
from px4fuse.findings.source_positions import hardly_moved
from px4fuse.flight import Unavailable, sample_rate
from px4fuse.plain import factor_words

NOISE_OFF = 1.5  # times, in standard deviation; below, the tracks hardly change
NOISE_OFF_ERROR = 4.0  # times: the gain is a different one
RESPONSE_TIME_S = 2.5  # five times the lesson's; a vehicle turns around in less
BEYOND = 1.5  # times the 95 % interval's reach; 0.3 % of clean flights lie beyond
LAG1_SLOW = 0.3  # correlation; white innovations stay below 2/√n, 0.2 at n = 100
# Options to type, and their fields of Settings
OPTIONS = {"--sigma-z": "sigma_z_m", "--sigma-a": "sigma_a_m_s2"}
# What such a setting does
READINGS = {
    "sigma_z_small": "The filter mistakes the noise of the measurements for motion.",
    "sigma_z_large": "The filter distrusts measurements that are better than it thinks.",
    "sigma_a_small": "The variance grows too little between updates, the gain is too small, and "
    "the filter lags behind.",
    "sigma_a_large": "The variance grows too much between updates, and the filter jumps to every "
    "measurement.",
}


def try_out(
    comparison: Comparison, values: Mapping[str, float], more: str = "", unseen: float | None = None
) -> str:
    """What to type, as far as a replay with it holds what the likelihood promises.

    Parameters
    ----------
    comparison : Comparison
    values : mapping from option to value
        Rounded to three digits.
    more : str
        Words behind them.
    unseen : float or None
        What such settings gain on data that they were not found on (nats), where that is known.
    """
    rounded = {option: float(f"{value:.3g}") for option, value in values.items()}
    typed = " ".join(f"{option} {value:g}" for option, value in rounded.items())
    fields: dict[str, Any] = {OPTIONS[option]: value for option, value in rounded.items()}
    changed = replace(comparison.settings, **fields)
    return filter_words(comparison, changed, f"{typed}{more}", unseen)


@dataclass(frozen=True)
class Off:
    """A setting that is off: by how many times (``size``), and on which side."""

    id: str
    option: str
    chosen: float
    asked: Noise
    value: float
    size: float
    severity: Severity


def detect(analysis: Analysis) -> Found:
    """Both."""
    yield from settings_off(analysis)
    yield from forgotten(analysis)


def settings_off(analysis: Analysis) -> Found:
    """What is off beyond its interval, the worse one first."""
    tunings = map(analysis.tuning.get, (HORIZONTAL, "aisle", "down"))
    tuned = next((tuned for tuned in tunings if isinstance(tuned, AxisTuning)), None)
    if tuned is None:
        return
    settings = analysis.settings
    both = [off_by("--sigma-z", settings.sigma_z_m, tuned.sigma_z)]
    # without motion the acceleration's noise is hardly seen
    if not hardly_moved(analysis):
        both.append(off_by("--sigma-a", settings.sigma_a_m_s2, tuned.filter_sigma_a))
    off = sorted(filter(None, both), key=lambda each: -each.size)
    # where a source may drift, or the truth shows it, innovations tell too little noise alone, and
    # a filter may follow such a source as closely as it likes
    drifts, slow = analysis.source.origin.may_drift, analysis.source.origin.is_gnss
    if drifts or slow or any(one.owner == "kf" for one in hidden_errors(analysis)):
        off = [e for e in off if e.chosen < e.value and not (drifts and e.severity == "info")]
    if not off:
        return
    values = {each.option: each.value for each in off}
    if "--sigma-z" in values and tuned.sigma_z.value is None:
        values["--sigma-z"] = max(values["--sigma-z"], SMALLEST_SIGMA_Z_M)
    unseen = None if isinstance(tuned.held_out, Unavailable) else tuned.held_out.gain_nats
    remedy, first = try_out(analysis, values, unseen=unseen), None
    for each in off:
        label, side = each.id.rsplit("_", 1)
        unit = "m" if each.option == "--sigma-z" else "m/s²"
        bounded, low, high = each.asked.value is None, each.asked.low or 0.0, each.asked.high
        range_ = "" if bounded or high is None else f", 95 % {low:.3g} to {high:.3g}"
        found = finding(
            each.severity,
            each.id,
            f"{label.upper()} {each.chosen:g} {unit} is {'at least ' if bounded else ''}"
            f"{factor_words(each.size)} times too {side}",
            f": the innovations ({tuned.name}) ask for {'at most ' if bounded else ''}"
            f"{each.value:.3g} {unit}{range_}. {READINGS[each.id]}",
            remedy,
            {
                "chosen": each.chosen,
                "most_likely": each.value,
                "factor": each.chosen / each.value,
                "lag1_autocorrelation": getattr(tuned.before, "lag1_autocorrelation", float("nan")),
            },
        )
        yield structs.replace(found, caused_by=first)
        first = first or each.id


def off_by(option: str, chosen: float, asked: Noise) -> Off | None:
    """How far a setting is off, and how bad that is; None where it is not."""
    value = asked.value if asked.value is not None else asked.high
    if value is None:
        return None
    low, high = asked.low or 0.0, asked.high
    if asked.value is not None and high is not None:
        low, high = (value * (end / value) ** BEYOND for end in (low, high))
    above = high is not None and chosen > high
    below = asked.value is not None and chosen < low
    size = max(chosen / value, value / chosen)
    if not (above or below) or size < NOISE_OFF:
        return None
    severity: Severity = "error" if size >= NOISE_OFF_ERROR else "warning"
    if chosen == getattr(Settings(), OPTIONS[option]):
        severity = lowered(severity)
    name = f"{option[2:].replace('-', '_')}_{'small' if chosen < value else 'large'}"
    return Off(name, option, chosen, asked, value, size, severity)


def forgotten(analysis: Analysis) -> Found:
    """SIGMA_A so small that σ hardly grows between updates and new measurements are ignored.

    A slow filter is no mistake where nothing happens: its innovations must say that it lags. Told
    of the first axis on which it needs too long to follow.
    """
    for name, result in analysis.axes.items():
        updates, statement = result.replay.updates, result.filters["kf"]
        if isinstance(statement, Unavailable) or statement.verdict != "variance understated":
            continue
        if statement.lag1_autocorrelation < LAG1_SLOW:
            continue
        gain = float(updates["gain_position"].iloc[len(updates) // 2 :].median())
        response_s = 1.0 / (sample_rate(updates) * gain)
        if response_s < RESPONSE_TIME_S:
            continue
        after = result.replay.steps["position_variance_m2"].reindex(updates.index).to_numpy()
        before = updates["prior_position_variance_m2"].to_numpy()
        growth = float(np.median((before[1:] / after[:-1] - 1.0)[len(after) // 2 :]))
        tuned = tuned_for(analysis.tuning, name)
        needed = None if tuned is None else tuned.filter_sigma_a.value
        more = "" if needed is None else f" {try_out(analysis, {'--sigma-a': needed})}"
        yield error(
            "process_noise_forgotten",
            f"With SIGMA_A {analysis.settings.sigma_a_m_s2:g} m/s² Q is forgotten",
            f": σ_p hardly grows between updates ({growth:.1%} in variance), the gain is "
            f"{gain:.3f}, and the filter needs {response_s:.0f} s to follow (along {name}).",
            f"Raise SIGMA_A.{more}",
            {"relative_growth": growth, "gain": gain, "response_s": response_s, "axis": name},
        )
        return
