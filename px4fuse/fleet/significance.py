"""Whether two numbers with intervals differ by more than chance, and which way is better."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import numpy as np
import pandas as pd
from scipy.special import ndtr
from scipy.stats import false_discovery_control

from px4fuse.fleet.measures import Z95, Aim, Bounds, Number, Scale

#: Of what is called significant, this share is expected to be chance
FALSE_DISCOVERY_RATE = 0.05
SPREAD_TABLE = "spread.csv"
# Two settings of one flight that differ by less are the same: of a ratio, and by unit
LEAST_RATIO = 0.01
LEAST_DIFFERENCE = {"": 0.001, "m": 0.001, "s": 0.001, "°": 0.1}


@dataclass(frozen=True)
class Contrast:
    """Two numbers against each other, on the scale on which they are compared.

    Attributes
    ----------
    delta : float
        ln(b/a) or b - a.
    half : float or None
        By how much ``delta`` must differ from 0 to lie outside its 95 % interval; None without
        intervals.
    interval : (float, float) or None
        Of ``delta``.
    nearer : float
        By how much b is farther than a from what is best, on the same scale; 0 where nothing is.
    """

    delta: float
    half: float | None
    interval: Bounds | None
    nearer: float

    @property
    def z(self) -> float:
        """Standard deviations from "no change"."""
        if not self.half or self.delta == 0.0:
            return 0.0
        return Z95 * abs(self.delta) / self.half

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
    ratio = a.scale == "ratio"
    if ratio and min(a.value, b.value) <= 0.0:
        return None
    x, y = (float(np.log(n.value)) if ratio else n.value for n in (a, b))
    delta = y - x
    nearer = farther(a.aim, y, x)
    reach_a, reach_b = (_reach(n, at, spread) for n, at in ((a, x), (b, y)))
    if reach_a is None or reach_b is None:
        return Contrast(delta, None, None, nearer)
    below = float(np.hypot(reach_b[0], reach_a[1]))
    above = float(np.hypot(reach_b[1], reach_a[0]))
    half = below if delta > 0.0 else above
    return Contrast(delta, half, (delta - below, delta + above), nearer)


def _reach(number: Number, at: float, spread: float) -> Bounds | None:
    """How far the interval of a number reaches below and above it, on its scale."""
    if number.interval is None:
        return None
    low, high = number.interval
    if number.scale == "ratio":
        above = float(np.log(high)) - at
        # an interval that is open below has no logarithm there
        below = at - float(np.log(low)) if low > 0.0 else above
    else:
        below, above = at - low, high - at
    wide = Z95 * spread
    return float(np.hypot(max(below, 0.0), wide)), float(np.hypot(max(above, 0.0), wide))


def corrected(p: Sequence[float]) -> list[float]:
    """p-values of many tests, corrected so that the false discovery rate can be read from them.

    Benjamini and Hochberg (1995), which holds for tests that are independent or positively
    dependent, as those of the axes of one flight are.
    """
    return [float(q) for q in false_discovery_control(p)] if p else []


def least_difference(scale: Scale, unit: str) -> float:
    """Two numbers of one flight that differ by less are the same, on their scale."""
    return math.log1p(LEAST_RATIO) if scale == "ratio" else LEAST_DIFFERENCE[unit]


def farther(aim: Aim, now: float, before: float) -> float:
    """By how much a number is farther from what is best, on its scale; 0 where nothing is."""
    if aim == "":
        return 0.0
    return now - before if aim == "low" else abs(now) - abs(before)


@cache
def spreads() -> Mapping[str, float]:
    """By which standard deviation a number varies between flights beyond its interval, by kind.

    Measured by :mod:`px4fuse.fleet.spread`; of a kind that is not in the table 0.
    """
    with files("px4fuse.fleet").joinpath(SPREAD_TABLE).open(encoding="utf-8") as file:
        table = pd.read_csv(file)
    return dict(zip(table["kind"], table["spread"], strict=True))
