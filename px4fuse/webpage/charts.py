"""Charts of a page: counts for bars, intervals on a scale, and numbers over time."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pandas as pd

from px4fuse.plain import number_words
from px4fuse.webpage.safe import PICTURE

BINS = 10
# In light and in dark pages alike
INK, MUTED = "#4d76ad", "#77818c"


@dataclass(frozen=True)
class Scale:
    """An axis, linear or logarithmic."""

    low: float
    high: float
    log: bool = False

    @classmethod
    def of(cls, values: npt.ArrayLike, least: float, *, log: bool = False) -> Scale:
        """One that holds values but for a hundredth at each end; at least so wide (a factor).

        Without any values it is about 1.
        """
        held = np.asarray(values if np.size(values) else [1.0], float)
        found = np.log(held) if log else held
        low, high = np.quantile(found, (0.01, 0.99))
        reach = 0.54 * max(high - low, math.log(least) if log else least)
        ends = (low + high) / 2.0 + np.array((-reach, reach))
        low, high = np.exp(ends) if log else ends
        return cls(float(low), float(high), log)

    def share(self, value: float) -> float:
        """Where a value stands, from 0 to 1; what is beyond an end stands at it."""
        ends = np.array((self.low, self.high))
        at = float(np.clip(value, *ends))
        if self.log:
            at, ends = math.log(at), np.log(ends)
        return float((at - ends[0]) / np.ptp(ends))


def tenths(values: Sequence[float], most: float) -> list[tuple[int, str]]:
    """How many values lie in each tenth from 0 to ``most``, and where it begins, in words.

    >>> tenths([0.0, 5.0, 5.5, 9.0], 10.0)[5]
    (2, '5')
    """
    counts, edges = np.histogram(np.clip(values, 0.0, most), BINS, (0.0, most))
    words = (number_words(round(edge, 2)) for edge in edges.tolist())
    return list(zip(counts.tolist(), words, strict=False))


def sketched(parts: Iterable[float], scale: Scale) -> str:
    """An interval (low, value, high) on a scale, for the page's script, which draws it."""
    return " ".join(f"{scale.share(part):.3f}" for part in parts)


def over_time(table: pd.DataFrame, span: tuple[pd.Timestamp, ...], scale: Scale) -> str:
    """Address of a picture of values over time, each with its interval.

    Parameters
    ----------
    table : DataFrame
        Columns value, low, high, of which the last two may be absent numbers, by date.
    span : (Timestamp, Timestamp)
        Ends of the axis of time.
    scale : Scale
        Of the values.
    """
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415 - takes its time

    figure = Figure(figsize=(6.0, 1.1), layout="constrained")
    axes = figure.add_subplot()
    reach = table[["low", "high"]].sub(table["value"], axis=0).abs()
    reach[reach.isna().any(axis=1)] = 0.0
    axes.errorbar(
        table.index, table["value"], yerr=reach.to_numpy().T, fmt="o", ms=2.5, lw=0.7, color=INK
    )
    margin = max((span[1] - span[0]) / 50, pd.Timedelta(hours=1))
    locator = AutoDateLocator(maxticks=8)  # type: ignore[no-untyped-call]
    axes.set(xlim=(span[0] - margin, span[1] + margin), ylim=(scale.low, scale.high))
    axes.xaxis.set_major_locator(locator)
    written = ConciseDateFormatter(locator)  # type: ignore[no-untyped-call]
    axes.xaxis.set_major_formatter(written)
    axes.tick_params(colors=MUTED, labelsize=8)
    axes.spines[:].set_color(MUTED)
    axes.spines[["top", "right"]].set_visible(False)
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=150, transparent=True, metadata={"Software": None})
    return PICTURE + base64.b64encode(drawn.getvalue()).decode()
