"""The numbers that flights are compared by, each with its 95 % interval, and whether they differ.

An interval says how well one flight tells its number. Noises and the clock have theirs from their
likelihood. Innovations and errors are correlated in time: with the log at hand theirs comes from a
block bootstrap (:func:`px4fuse.trajectory.scores.rmse_interval`); with the results alone that of
innovations comes from chi-square with so many of them as are independent, and that of errors is not
known.
"""

import csv
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, reduce
from importlib.resources import files
from typing import Any, Literal

import msgspec
import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy.special import ndtr
from scipy.stats import binomtest, chi2, false_discovery_control

from px4fuse.analysis import Analysis
from px4fuse.arrays import Array
from px4fuse.comparison.model import AxisComparison, AxisResult, FilterSummary
from px4fuse.ekf2.aids import AidAxis, AidResult
from px4fuse.ekf2_parameters import AIDS
from px4fuse.filter.clock import Clock
from px4fuse.filter.heading import HeadingError
from px4fuse.filter.kalman import state_at
from px4fuse.filter.signals import AISLE
from px4fuse.filter.tuning import Tuned
from px4fuse.flight import Unavailable
from px4fuse.results.contract import AidsResults, ComparisonResults
from px4fuse.trajectory.scores import rmse_interval

Bounds = tuple[float, float]

#: Of what is called significant, this share is expected to be chance
FALSE_DISCOVERY_RATE = 0.05
SPREAD_TABLE = "spread.csv"
Z95 = 1.959964
LEVEL = 0.95
# Innovations are not normal where their share outside ±2√S is so many standard deviations from
# that of normal ones with the same mean square
NOT_NORMAL_SIGMAS = 4.0
# Two settings of one flight that differ by less are the same: of a ratio, and by unit
LEAST_RATIO = 0.01
LEAST_DIFFERENCE = {"": 0.001, "m": 0.001, "s": 0.001, "°": 0.1}


@dataclass(frozen=True)
class Measure:
    """A kind of number that flights are compared by: a row of ``measures.csv``.

    Attributes
    ----------
    path : str
        Where it stands in the results; ``*`` is any name there, of an axis or an aid.
    aim : {"low", "one", "zero", ""}
        What is better: lower, nearer to 1, nearer to 0; "" where nothing is.
    scale : {"ratio", "difference"}
        Whether two of them are compared by their ratio or their difference.
    """

    path: str
    label: str
    unit: str = ""
    aim: Literal["low", "one", "zero", ""] = "low"
    scale: Literal["ratio", "difference"] = "ratio"

    def scaled(self, values: npt.ArrayLike) -> Array:
        """Values on the scale on which they are compared; NaN where they have no logarithm."""
        found = np.asarray(values, dtype=np.float64)
        if self.scale == "difference":
            return found
        logs: Array = np.log(found, out=np.full(found.shape, np.nan), where=found > 0.0)
        return logs

    def unscaled(self, value: float) -> float:
        """A value of that scale as a ratio or difference."""
        return math.exp(value) if self.scale == "ratio" else value

    @property
    def least(self) -> float:
        """Two numbers of one flight that differ by less are the same, on their scale."""
        return math.log1p(LEAST_RATIO) if self.scale == "ratio" else LEAST_DIFFERENCE[self.unit]

    def farther(self, now: float, before: float) -> float:
        """By how much a number is farther from what is best, on its scale; 0 where nothing is."""
        if self.aim == "":
            return 0.0
        return now - before if self.aim == "low" else abs(now) - abs(before)


APART = "axes.*.difference."
REJECTED = "axes.*.rejected_share"


def read_rows(name: str) -> list[dict[str, str]]:
    """Rows of a table of this folder, by the titles of its columns."""
    with files("px4fuse.fleet").joinpath(name).open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


MEASURES = {row["path"]: msgspec.convert(row, Measure) for row in read_rows("measures.csv")}


@dataclass(frozen=True)
class Number:
    """One number of a comparison, with its 95 % interval; None where there is none."""

    measure: Measure
    value: float
    interval: Bounds | None = None


def at(found: object, path: str) -> Any:
    """What stands at a place in the results; None where there is nothing."""

    def below(part: Any, name: str) -> Any:
        if isinstance(part, tuple):
            return part[int(name)]
        return part.get(name) if isinstance(part, Mapping) else getattr(part, name, None)

    return reduce(below, path.split("."), found)


def numbers(
    results: ComparisonResults | AidsResults, analysis: Analysis | None = None
) -> dict[str, Number]:
    """Numbers of a comparison by where they stand in its results.

    Parameters
    ----------
    analysis : Analysis, optional
        What they were made from, for the intervals that only the log can give.
    """
    axes = {} if isinstance(results, AidsResults) else results.axes
    every = [summary for axis in axes.values() for summary in axis.filters.values()]
    has_truth = not all(isinstance(summary.truth, Unavailable) for summary in every)
    # EKF2 rejects a horizontal position as a whole
    level = next((name for name in ("north", "east", AISLE) if name in axes), "")
    errors = {
        f"axes.{name}.{path}": values
        for name, axis in ({} if analysis is None else analysis.axes).items()
        for path, values in errors_of(axis).items()
    }
    # what EKF2 did with the source itself is among the axes
    own: tuple[str, ...] = ("ev_pos", "ev_hgt") if axes else ()
    if at(results, "source.kind") == "gnss":
        own = ("gnss_pos",)
    found: dict[str, Number] = {}
    for kind, measure in MEASURES.items():
        for path, names in _places(results, kind):
            value, name = at(results, path), names[0] if names else ""
            parent, _, field = path.rpartition(".")
            part = at(results, parent)
            unclear = isinstance(part, Clock) and not part.determinable
            unclear |= isinstance(part, HeadingError) and part.drifts
            if unclear or not isinstance(value, int | float):
                continue
            if kind == REJECTED and name not in (level, "down"):
                continue
            if kind.startswith("aids.") and name in own:
                continue
            words = (AIDS[each].label if each in AIDS else each for each in names)
            label = ", ".join((measure.label, *words))
            # where a truth judges both, their distance from each other is neither good nor bad
            aim = "" if has_truth and kind.startswith(APART) else measure.aim
            found[path] = Number(
                replace(measure, label=label, aim=aim),
                float(value),
                bootstrapped(errors[path], field)
                if path in errors
                else interval_of(part, field, value),
            )
    return found


def _places(
    results: ComparisonResults | AidsResults, kind: str
) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Every place of a kind in the results, and the names that stand for its ``*``."""
    head, several, tail = kind.partition(".*")
    if not several:
        yield kind, ()
    for name in (at(results, head) or ()) if several else ():
        for path, names in _places(results, f"{head}.{name}{tail}"):
            yield path, (name, *names)


def interval_of(part: object, field: str, value: float) -> Bounds | None:
    """95 % interval of a number in a part of the results, from the results alone."""
    match part:
        case Tuned():
            interval: Bounds | None = getattr(part, f"{field}_interval")
            return None if interval is None or None in interval else interval
        case Clock():
            return part.interval_s
        case HeadingError():
            return value - Z95 * part.sigma_deg, value + Z95 * part.sigma_deg
        case AidAxis() | AidResult():
            return _of_aid(part, value)
    judged = part.filters["ekf2"] if isinstance(part, AxisResult) else part
    return _of_innovations(judged, field, value) if isinstance(judged, FilterSummary) else None


def _of_aid(part: AidAxis | AidResult, value: float) -> Bounds | None:
    axes = (part,) if isinstance(part, AidAxis) else tuple(part.axes.values())
    if not axes:
        return None
    count = min(independent_count(axis.samples, axis.lag1_autocorrelation) for axis in axes)
    if isinstance(part, AidResult):
        return share_interval(value, count)
    # innovations beyond the gate are not normal
    return _of_normal(value, count) if part.rejected_share == 0.0 else None


def _of_normal(mean_square: float, count: float) -> Bounds:
    """95 % interval of a mean square of so many independent normal numbers (chi-square)."""
    high, low = np.asarray(chi2.ppf((0.5 - LEVEL / 2, 0.5 + LEVEL / 2), count)).tolist()
    return mean_square * count / low, mean_square * count / high


def _of_innovations(judged: FilterSummary, field: str, value: float) -> Bounds | None:
    count = independent_count(judged.count, judged.lag1_autocorrelation)
    if field in ("outside_gate", "rejected_share"):
        return share_interval(value, count)
    if field not in ("nis_mean", "innovation_std_m") or not _is_normal(judged, count):
        return None
    power = 1.0 if field == "nis_mean" else 0.5
    low, high = _of_normal(value ** (1.0 / power), count)
    return low**power, high**power


def bootstrapped(errors: Array, field: str) -> Bounds | None:
    """95 % interval of a (root) mean square of correlated errors."""
    found = rmse_interval(errors, field)
    power = 2.0 if field == "nis_mean" else 1.0
    return None if isinstance(found, Unavailable) else (found.low**power, found.high**power)


def independent_count(count: int, lag1: float) -> float:
    """How many of so many innovations' squares are as good as independent.

    With the autocorrelation r^k of a first-order process squares have r^2k, hence a share of
    1/(1 + 2 Σ r^2k) (Bayley and Hammersley 1946).
    """
    return count * (1.0 - lag1**2) / (1.0 + lag1**2)


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


def errors_of(axis: AxisComparison) -> dict[str, Array]:
    """What the root mean squares of an axis are over, by where they stand in its results."""
    found: dict[str, Array] = {}
    for name, frame in (("kf", axis.replay.updates), ("ekf2", axis.ekf2_innovations)):
        if isinstance(frame, pd.DataFrame):
            innovation = frame["innovation_m"].to_numpy()
            sigma = np.sqrt(frame["innovation_variance_m2"].to_numpy())
            found[f"filters.{name}.nis_mean"] = innovation / sigma
            found[f"filters.{name}.innovation_std_m"] = innovation - np.nanmean(innovation)
    ekf2 = axis.ekf2_state if isinstance(axis.ekf2_state, pd.DataFrame) else None
    times = (axis.replay.steps if ekf2 is None else ekf2).index.to_numpy()
    position, velocity = state_at(axis.replay, times)
    for column, field, ours in (
        ("position_m", "position_rmse_m", position),
        ("velocity_m_s", "velocity_rmse_m_s", velocity),
    ):
        states = {"kf": ours} | ({} if ekf2 is None else {"ekf2": ekf2[column].to_numpy()})
        if ekf2 is not None:
            found[f"difference.{field}"] = ours - states["ekf2"]
        if isinstance(truth := axis.truth, pd.DataFrame):
            true = np.interp(times, truth.index, truth[column], left=np.nan, right=np.nan)
            for name, state in states.items():
                found[f"filters.{name}.truth.{field}"] = state - true
    return {path: values[np.isfinite(values)] for path, values in found.items()}


# -------------------- whether two of them differ by more than chance


@dataclass(frozen=True)
class Contrast:
    """Two numbers against each other, on the scale on which they are compared.

    Attributes
    ----------
    delta : float
        ln(b/a) or b - a.
    farther : float
        By how much b is farther than a from what is best; 0 where nothing is.
    interval : (float, float) or None
        Of ``delta``, 95 %; None where one of the two has none.
    """

    delta: float
    farther: float
    interval: Bounds | None = None

    @property
    def half(self) -> float:
        """From ``delta`` to the end of its interval that faces "no change"; 0 without one."""
        if self.interval is None:
            return 0.0
        low, high = self.interval
        return self.delta - low if self.delta > 0.0 else high - self.delta

    @property
    def z(self) -> float:
        """Standard deviations from "no change"."""
        return Z95 * abs(self.delta) / self.half if self.half and self.delta else 0.0

    @property
    def p(self) -> float:
        """Two-sided p-value of "no change"."""
        return float(2.0 * ndtr(-self.z))


def contrast(a: Number, b: Number, spread: float = 0.0) -> Contrast | None:
    """Combine the intervals of two independent numbers, which need not be symmetric.

    By the distances from each value to the end of its interval (Zou and Donner 2008, "Construction
    of confidence limits about effect measures", eq. 5; for shares Newcombe 1998, method 10).

    Parameters
    ----------
    spread : float
        Standard deviation, on their scale, by which one number of two flights with the same
        equipment varies beyond its own interval.

    Returns
    -------
    Contrast or None
        None where a ratio to zero would be needed.
    """
    x, y = a.measure.scaled((a.value, b.value)).tolist()
    if not np.isfinite(y - x):
        return None
    farther = a.measure.farther(y, x)
    if a.interval is None or b.interval is None:
        return Contrast(y - x, farther)
    a_below, a_above = _reach(a, a.interval, spread)
    b_below, b_above = _reach(b, b.interval, spread)
    below, above = np.hypot(b_below, a_above), np.hypot(b_above, a_below)
    return Contrast(y - x, farther, (float(y - x - below), float(y - x + above)))


def _reach(number: Number, interval: Bounds, spread: float) -> Bounds:
    """How far the interval of a number reaches below and above it, on its scale."""
    low, value, high = number.measure.scaled((interval[0], number.value, interval[1])).tolist()
    above = high - value
    # an interval that is open below has no logarithm there
    below = value - low if np.isfinite(low) else above
    wide = Z95 * spread
    return float(np.hypot(max(below, 0.0), wide)), float(np.hypot(max(above, 0.0), wide))


def corrected(p: Sequence[float]) -> list[float]:
    """p-values of many tests, corrected so that the false discovery rate can be read from them.

    Benjamini and Hochberg (1995), which holds for tests that are independent or positively
    dependent, as those of the axes of one flight are.
    """
    return [float(q) for q in false_discovery_control(p)] if p else []


@cache
def spreads() -> Mapping[str, float]:
    """By which standard deviation a number varies between flights beyond its interval, by kind.

    Measured by ``tests/studies/spread.py``.
    """
    with files("px4fuse.fleet").joinpath(SPREAD_TABLE).open(encoding="utf-8") as file:
        return dict(pd.read_csv(file).set_index("kind")["spread"])
