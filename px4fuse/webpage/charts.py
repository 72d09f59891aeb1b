"""Charts as inline SVG: places in per cent of the width, so that letters keep their size."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import pandas as pd

from px4fuse.plain import number_words
from px4fuse.webpage.safe import escaped

BINS = 10
# Fewer are drawn one by one, not as a box
FEW = 8
# More marks than this in one panel are drawn as medians of so many equal stretches of time
MOST_MARKS = 120
STRETCHES = 60


@dataclass(frozen=True)
class Scale:
    """An axis, linear or logarithmic."""

    low: float
    high: float
    log: bool = False

    def share(self, value: float) -> float:
        """Where a value stands, from 0 to 1; what is beyond an end stands at it."""
        if self.log:
            share = math.log(max(value, self.low) / self.low) / math.log(self.high / self.low)
        else:
            share = (value - self.low) / (self.high - self.low)
        return min(max(share, 0.0), 1.0)

    @property
    def ticks(self) -> list[float]:
        """Round numbers on it, at most four intervals on a linear one."""
        if not self.log:
            step = 10.0 ** math.floor(math.log10((self.high - self.low) / 2.0))
            step *= next(k for k in (1, 2, 5, 10) if (self.high - self.low) / (k * step) <= 4.0)
            first, last = math.ceil(self.low / step - 1e-9), math.floor(self.high / step + 1e-9)
            return [number * step for number in range(first, last + 1)]
        decades = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
        factors = (1.0,) if len(decades) > 4 else (1.0, 3.0)
        every = [factor * 10.0**decade for decade in decades for factor in factors]
        return [tick for tick in every if self.low * 0.999 <= tick <= self.high * 1.001]


def log_scale(values: npt.ArrayLike, least: float = 3.0) -> Scale:
    """One that holds the values but for a hundredth at each end; at least a factor wide."""
    low, high = np.quantile(np.asarray(values, float), (0.01, 0.99))
    middle = math.sqrt(low * high)
    low, high = min(low, middle / math.sqrt(least)), max(high, middle * math.sqrt(least))
    return Scale(low / 1.15, high * 1.15, log=True)


def around_one(values: npt.ArrayLike) -> Scale:
    """A logarithmic one for factors: the same to both sides of 1."""
    numbers = np.asarray(values, float)
    numbers = numbers[np.isfinite(numbers) & (numbers > 0.0)]
    far = float(np.quantile(np.abs(np.log10(numbers)), 0.99)) if len(numbers) else 0.0
    most = next((10.0**end for end in (0.5, 1.0, 1.5, 2.0, 3.0) if far <= end), 1e4)
    return Scale(1.0 / most, most, log=True)


def linear_scale(values: npt.ArrayLike, least: float) -> Scale:
    """One that holds the values but for a hundredth at each end; at least so wide."""
    low, high = np.quantile(np.asarray(values, float), (0.01, 0.99))
    more = max(0.04 * (high - low), 0.5 * (least - (high - low)), 1e-9)
    return Scale(low - more, high + more)


def histogram(values: Sequence[float], most: float, caption: str) -> str:
    """Bars of how many values lie in each tenth from 0 to ``most``; empty without any."""
    if not values:
        return ""
    counts = [0] * BINS
    for value in values:
        counts[min(max(math.floor(value / most * BINS), 0), BINS - 1)] += 1
    edges = [number_words(round(most * edge / BINS, 2)) for edge in range(BINS + 1)]
    bins = zip(pairwise(edges), counts, strict=True)
    told = "; ".join(f"{low} to {high}: {count}" for (low, high), count in bins)
    marks = []
    for place, count in enumerate(counts):
        height, middle = 64.0 * count / max(counts), 2.0 + 9.6 * (place + 0.5)
        marks.append(_rect(middle - 4.3, 80.0 - height, 8.6, height, "bar"))
        if count:
            marks.append(_text(middle, 76.0 - height, str(count)))
    marks.append('<line x1="1%" x2="99%" y1="80.5" y2="80.5" class="grid"/>')
    marks += [_text(2.0 + 9.6 * edge, 94.0, edges[edge]) for edge in range(0, BINS + 1, 2)]
    return (
        f"<figure>{plot(98, f'{caption}. {told}', marks)}"
        f"<figcaption>{escaped(caption)}</figcaption></figure>"
    )


def bins(shares: Sequence[float]) -> str:
    """A small histogram of shares from 0 to 1, in tenths, for a table that says the numbers."""
    counts, _ = np.histogram(np.clip(shares, 0.0, 1.0), BINS, (0.0, 1.0))
    marks = [_line(0.0, 100.0, 27.5, 27.5, "grid")]
    for place, count in enumerate(counts / counts.max()):
        if count:
            marks.append(_rect(10.0 * place + 1.0, 27.0 - 25.0 * count, 8.0, 25.0 * count, "bar"))
    return plot(30, "", marks)


def plot(height: int, told: str, marks: Sequence[str]) -> str:
    """The drawing itself; ``told`` is what a screen reader says, "" where a table says it."""
    said = f'role="img" aria-label="{escaped(told)}"' if told else 'aria-hidden="true"'
    return f'<svg class="plot" height="{height}" {said}>{"".join(marks)}</svg>'


def bar(share: float) -> str:
    """A bar of a list: part of its full width, in pixels."""
    part = max(96.0 * min(max(share, 0.0), 1.0), 1.0)
    drawn = f'<rect width="{part:.0f}" height="8"/>'
    return f'<svg width="96" height="8" aria-hidden="true">{drawn}</svg>'


def axis(scale: Scale) -> str:
    """Ticks of a scale, with their numbers."""
    marks = []
    for place, tick in enumerate(scale.ticks):
        at = 100.0 * scale.share(tick)
        # a phone has room for half of them
        said = _text(at, 11.0, f"{tick:g}", "wide-only" if place % 2 else "")
        marks += [said, _line(at, at, 15.0, 18.0, "grid")]
    return plot(18, "", marks)


def spread(values: npt.NDArray[np.float64], scale: Scale, kind: str, y: float) -> str:
    """Median, middle half and middle nine tenths of values; a few are drawn one by one."""
    if not len(values):
        return ""
    if len(values) < FEW:
        return "".join(_mark(100.0 * scale.share(value), y, kind) for value in values)
    low, first, middle, third, high = (
        100.0 * scale.share(value) for value in np.quantile(values, (0.05, 0.25, 0.5, 0.75, 0.95))
    )
    return (
        _line(low, high, y, y, kind)
        + _rect(first, y - 4.0, max(third - first, 0.3), 8.0, f"{kind} box")
        + _mark(middle, y, kind)
    )


def grid(scale: Scale, height: float, mark: float | None = None) -> str:
    """Lines of a scale behind what is drawn on it, and one at ``mark``."""
    lines = [100.0 * scale.share(tick) for tick in scale.ticks]
    drawn = "".join(_line(at, at, 0.0, height, "grid") for at in lines)
    at = None if mark is None else 100.0 * scale.share(mark)
    return drawn if at is None else drawn + _line(at, at, 0.0, height, "mark")


def over_time(
    times: pd.Series, values: pd.DataFrame, span: tuple[pd.Timestamp, pd.Timestamp], scale: Scale
) -> tuple[list[str], int]:
    """Marks of values over time, with the line of their interval.

    Parameters
    ----------
    values : DataFrame
        Columns value, low, high; the last two may be absent numbers.
    span : (Timestamp, Timestamp)
        Ends of the axis.
    scale : Scale
        Of the values, from bottom to top.

    Returns
    -------
    marks : list of str
        In a drawing of 74 pixels, of which the lower 12 are the axis of time.
    each : int
        Of how many values a mark is the median: 1 where each has its own.
    """
    seconds = (times - span[0]).dt.total_seconds().to_numpy()
    whole = max((span[1] - span[0]).total_seconds(), 1.0)
    table = values.assign(x=4.0 + 94.0 * seconds / whole)
    each = 1
    if len(table) > MOST_MARKS:
        place = np.floor((table["x"] - 4.0) / 94.0 * STRETCHES).clip(upper=STRETCHES - 1)
        groups = table.groupby(place)
        each = round(groups.size().median())
        table = groups[["x", "value"]].median()
        table["low"], table["high"] = groups["value"].quantile(0.05), groups["value"].quantile(0.95)

    def y(value: float) -> float:
        return 56.0 - 50.0 * scale.share(value)

    marks = [
        _text(3.0, y(tick) + 4.0, f"{tick:g}", "last") + _line(4.0, 98.0, y(tick), y(tick), "grid")
        for tick in scale.ticks
    ]
    for x, value, low, high in table[["x", "value", "low", "high"]].to_numpy(float):
        if math.isfinite(low) and math.isfinite(high):
            marks.append(_line(x, x, y(low), y(high), "span"))
        marks.append(f'<circle cx="{x:.2f}%" cy="{y(value):.1f}" r="2.5" class="dot"/>')
    return marks, each


def _mark(x: float, y: float, kind: str) -> str:
    """Ours is round, EKF2 is square."""
    if kind == "ours":
        return f'<circle cx="{x:.2f}%" cy="{y:g}" r="3.5" class="ours"/>'
    return (
        f'<svg x="{x:.2f}%" y="{y:g}" overflow="visible"><rect x="-3.5" y="-3.5" width="7" '
        'height="7" class="ekf2"/></svg>'
    )


def _rect(x: float, y: float, width: float, height: float, kind: str) -> str:
    size = f'width="{width:.2f}%" height="{height:.1f}"'
    return f'<rect x="{x:.2f}%" y="{y:.1f}" {size} class="{kind}"/>'


def _line(x1: float, x2: float, y1: float, y2: float, kind: str) -> str:
    return f'<line x1="{x1:.2f}%" x2="{x2:.2f}%" y1="{y1:.1f}" y2="{y2:.1f}" class="{kind}"/>'


def _text(x: float, y: float, text: str, kind: str = "") -> str:
    kind = f' class="{kind}"' if kind else ""
    return f'<text x="{x:.2f}%" y="{y:.1f}"{kind}>{escaped(text)}</text>'
