"""The numbers of a comparison that are held against another's, each with its 95 % interval.

An interval says how well one flight tells its number. Noises and the clock have theirs from their
likelihood. Innovations and errors are correlated in time: with the log at hand theirs comes from a
block bootstrap (:func:`px4fuse.trajectory.scores.rmse_interval`); with the results alone that of
innovations comes from chi-square with so many of them as are independent, and that of errors is not
known.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import reduce
from typing import Any, Literal

import numpy as np
import pandas as pd
from scipy.special import ndtr
from scipy.stats import binomtest, chi2

from px4fuse.analysis import Analysis
from px4fuse.arrays import Array
from px4fuse.comparison.model import FILTERS, AxisComparison, FilterSummary
from px4fuse.filter.clock import Clock
from px4fuse.filter.heading import HeadingError
from px4fuse.filter.kalman import state_at
from px4fuse.filter.signals import AISLE
from px4fuse.flight import Unavailable
from px4fuse.results.contract import ComparisonResults
from px4fuse.trajectory.scores import rmse_interval

Aim = Literal["low", "one", "zero", ""]
Scale = Literal["ratio", "difference"]
Bounds = tuple[float, float]

Z95 = 1.959964
LEVEL = 0.95
# Innovations are not normal where their share outside ±2√S is so many standard deviations from
# that of normal ones with the same mean square
NOT_NORMAL_SIGMAS = 4.0

LIKELIHOOD = "likelihood"
BOOTSTRAP = "block bootstrap"
CHI_SQUARE = "chi-square"
WILSON = "Wilson"


@dataclass(frozen=True)
class Number:
    """One number of a comparison.

    Attributes
    ----------
    interval : (float, float) or None
        95 %; None where there is none.
    aim : {"low", "one", "zero", ""}
        What is better: lower, nearer to 1, nearer to 0; "" where nothing is.
    scale : {"ratio", "difference"}
        Whether two of them are compared by their ratio or their difference.
    method : str
        How the interval was found.
    kind : str
        What it shares with the same number of other axes: ``axes.*.filters.kf.nis_mean``.
    """

    label: str
    unit: str
    value: float
    interval: Bounds | None
    aim: Aim
    scale: Scale
    method: str
    kind: str


@dataclass(frozen=True)
class _Row:
    """A number that every axis has: where it stands below the axis, and what it is."""

    path: str
    label: str
    unit: str
    aim: Aim
    scale: Scale = "ratio"


def _of_filter(key: str, name: str) -> tuple[_Row, ...]:
    return (
        _Row(f"{key}.nis_mean", f"NIS of {name}", "", "one"),
        _Row(f"{key}.innovation_std_m", f"innovation std of {name}", "m", "low"),
        _Row(f"{key}.outside_gate", f"beyond the gate of {name}", "", "low",
             "difference"),
        _Row(f"{key}.truth.position_rmse_m", f"error of {name}", "m", "low"),
        _Row(f"{key}.truth.velocity_rmse_m_s", f"velocity error of {name}", "m/s", "low"),
        _Row(f"{key}.truth.nees_position_mean", f"NEES of {name}", "", "one"),
        _Row(f"{key}.innovation_mean_m", f"innovation mean of {name}", "m", "zero",
             "difference"),
        _Row(f"{key}.sigma_p_median_m", f"σ_p of {name}", "m", ""),
        _Row(f"{key}.sigma_v_median_m_s", f"σ_v of {name}", "m/s", ""),
    )  # fmt: skip


_ROWS = (
    *_of_filter("filters.ekf2", "EKF2"),
    *_of_filter("filters.kf", "ours"),
    _Row("difference.position_rmse_m", "ours - EKF2", "m", "low"),
    _Row("difference.velocity_rmse_m_s", "ours - EKF2, velocity", "m/s", "low"),
)
# Errors of the state by what they are of
_ERRORS = {"position_m": "position_rmse_m", "velocity_m_s": "velocity_rmse_m_s"}
_NOISES = (("sigma_z_m", "SIGMA_Z", "m"), ("filter_sigma_a_m_s2", "SIGMA_A", "m/s²"))


def numbers(results: ComparisonResults, analysis: Analysis | None = None) -> dict[str, Number]:
    """Numbers of a comparison by where they stand in its results.

    Parameters
    ----------
    analysis : Analysis, optional
        What they were made from, for the intervals that only the log can give.
    """
    return dict(_of_flight(results)) | dict(_of_axes(results, analysis))


def _of_flight(results: ComparisonResults) -> Iterator[tuple[str, Number]]:
    for name, tuned in results.tuning.items():
        for field, label, unit in _NOISES:
            value = getattr(tuned, field, None)
            if value:
                found = getattr(tuned, f"{field}_interval")
                yield f"tuning.{name}.{field}", Number(
                    f"{label} found, {name}", unit, value, found, "low", "ratio",
                    LIKELIHOOD, f"tuning.*.{field}",
                )  # fmt: skip
    clock, heading = results.clock, results.heading
    if isinstance(clock, Clock) and clock.determinable:
        yield "clock.offset_s", Number(
            "clock offset", "s", clock.offset_s, clock.interval_s, "zero",
            "difference", LIKELIHOOD, "clock.offset_s",
        )  # fmt: skip
    if isinstance(heading, HeadingError) and not heading.drifts:
        half = Z95 * heading.sigma_deg
        yield "heading.turn_deg", Number(
            "turn of the source's frame", "°", heading.turn_deg,
            (heading.turn_deg - half, heading.turn_deg + half), "zero", "difference", LIKELIHOOD,
            "heading.turn_deg",
        )  # fmt: skip
    # EKF2 rejects a horizontal position as a whole
    level = next((name for name in ("north", "east", AISLE) if name in results.axes), "")
    for at, label in ((level, "horizontal"), ("down", "down")):
        axis = next((axis for name, axis in results.axes.items() if name == at), None)
        ekf2 = None if axis is None else axis.filters["ekf2"]
        if axis is None or axis.rejected_share is None or not isinstance(ekf2, FilterSummary):
            continue
        interval = share_interval(axis.rejected_share, ekf2.count * independent_share(ekf2))
        yield f"axes.{at}.rejected_share", Number(
            f"rejected by EKF2, {label}", "", axis.rejected_share, interval, "low", "difference",
            WILSON, "axes.*.rejected_share",
        )  # fmt: skip
    plain: tuple[tuple[str, str, str, Aim], ...] = (
        ("loop.closure_error_m", "closure error of the loop", "m", "low"),
        ("source.rate_hz", "rate of the source", "Hz", ""),
        ("log.duration_s", "duration of the log", "s", ""),
    )
    for path, label, unit, aim in plain:
        value = _at(results, path)
        if value is not None:
            yield path, Number(label, unit, value, None, aim, "ratio", "", path)


def _of_axes(results: ComparisonResults, analysis: Analysis | None) -> Iterator[tuple[str, Number]]:
    known_truth = any(
        not isinstance(axis.filters[name].truth, Unavailable)
        for axis in results.axes.values()
        for name in FILTERS
    )
    for name, axis in results.axes.items():
        series = {} if analysis is None else _series(analysis[name])
        for row in _ROWS:
            value = _at(axis, row.path)
            if value is None:
                continue
            # where a truth judges both, their distance from each other is neither good nor bad
            aim = "" if known_truth and row.path.startswith("difference.") else row.aim
            interval, method = interval_of(row.path, value, _at_filter(axis, row.path), series)
            yield f"axes.{name}.{row.path}", Number(
                f"{row.label}, {name}", row.unit, value, interval, aim, row.scale, method,
                f"axes.*.{row.path}",
            )  # fmt: skip


def _at(found: object, path: str) -> float | None:
    """A number below a part of the results, None where there is none."""
    value = reduce(_below, path.split("."), found)
    return float(value) if isinstance(value, int | float) else None


def _below(found: object, name: str) -> Any:
    return found.get(name) if isinstance(found, Mapping) else getattr(found, name, None)


def _at_filter(axis: object, path: str) -> FilterSummary | None:
    judged = reduce(_below, path.split(".")[:2], axis)
    return judged if isinstance(judged, FilterSummary) else None


def interval_of(
    path: str, value: float, judged: FilterSummary | None, series: Mapping[str, Array]
) -> tuple[Bounds | None, str]:
    """95 % interval of a number of an axis, and how it was found."""
    field = path.rsplit(".", maxsplit=1)[-1]
    if path in series:
        found = rmse_interval(series[path], path)
        if isinstance(found, Unavailable):
            return None, ""
        power = 2.0 if field == "nis_mean" else 1.0
        return (found.low**power, found.high**power), BOOTSTRAP
    if judged is None:
        return None, ""
    count = judged.count * independent_share(judged)
    if field == "outside_gate":
        return share_interval(value, count), WILSON
    if field in ("nis_mean", "innovation_std_m") and _is_normal(judged, count):
        power = 1.0 if field == "nis_mean" else 0.5
        low, high = (count / chi2.ppf(p, count) for p in (0.5 + LEVEL / 2, 0.5 - LEVEL / 2))
        return (value * low**power, value * high**power), CHI_SQUARE
    return None, ""


def independent_share(judged: FilterSummary) -> float:
    """Share of the innovations' squares that are as good as independent.

    With the autocorrelation r^k of a first-order process squares have r^2k, hence
    1/(1 + 2 Σ r^2k) (Bayley and Hammersley 1946).
    """
    squared = judged.lag1_autocorrelation**2
    return (1.0 - squared) / (1.0 + squared)


def _is_normal(judged: FilterSummary, count: float) -> bool:
    """Whether the share outside ±2√S is that of normal innovations of this mean square."""
    expected = float(2.0 * ndtr(-2.0 / np.sqrt(judged.nis_mean)))
    sigma = np.sqrt(expected * (1.0 - expected) / count)
    off = abs(judged.outside_two_sigma - expected)
    return bool(off <= NOT_NORMAL_SIGMAS * sigma + 0.5 / count)


def share_interval(share: float, count: float) -> Bounds:
    """Wilson's (1927), for so many independent trials."""
    trials = max(round(count), 1)
    found = binomtest(round(share * trials), trials).proportion_ci(LEVEL, method="wilson")
    return float(found.low), float(found.high)


def _series(result: AxisComparison) -> dict[str, Array]:
    """What the root mean squares of an axis are over, by where they stand in the results."""
    found: dict[str, Array] = {}
    for name, frame in (("kf", result.replay.updates), ("ekf2", result.ekf2_innovations)):
        if isinstance(frame, pd.DataFrame):
            innovation = frame["innovation_m"].to_numpy()
            found[f"filters.{name}.nis_mean"] = innovation / np.sqrt(
                frame["innovation_variance_m2"].to_numpy()
            )
            found[f"filters.{name}.innovation_std_m"] = innovation - np.nanmean(innovation)
    state = result.ekf2_state
    times = result.replay.steps.index if isinstance(state, Unavailable) else state.index
    ours = dict(zip(_ERRORS, state_at(result.replay, times.to_numpy()), strict=True))
    for column, field in _ERRORS.items():
        theirs = None if isinstance(state, Unavailable) else state[column].to_numpy()
        if theirs is not None:
            found[f"difference.{field}"] = ours[column] - theirs
        if isinstance(truth := result.truth, Unavailable):
            continue
        true = np.interp(times, truth.index, truth[column], left=np.nan, right=np.nan)
        found[f"filters.kf.truth.{field}"] = ours[column] - true
        if theirs is not None:
            found[f"filters.ekf2.truth.{field}"] = theirs - true
    return {path: values[np.isfinite(values)] for path, values in found.items()}
