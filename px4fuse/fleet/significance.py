"""Whether two numbers with intervals differ by more than chance, and which way is better."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import numpy as np
import pandas as pd
from scipy.special import ndtr
from scipy.stats import false_discovery_control

from px4fuse.fleet.measures import Z95, Bounds, Number

#: Of what is called significant, this share is expected to be chance
FALSE_DISCOVERY_RATE = 0.05
SPREAD_TABLE = "spread.csv"


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
