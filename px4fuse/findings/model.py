"""What a finding is, and what a detector compares with."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import pandas as pd

from px4fuse.analysis import Analysis
from px4fuse.comparison.comparison import Comparison
from px4fuse.filter.signals import within
from px4fuse.flight import POSITION_COLUMNS

Severity = Literal["error", "warning", "info"]
SEVERITIES: tuple[Severity, Severity, Severity] = ("error", "warning", "info")


@dataclass(frozen=True)
class Finding:
    """One named mistake or condition.

    Attributes
    ----------
    id : str
        Stable, in snake case.
    severity : {"error", "warning", "info"}
        error: the comparison or the flight is misleading as it stands; warning: a number is
        wrong or blind; info: know it when you read the report.
    message : str
        One sentence.
    evidence : dict
        Numbers, with units in their names.
    remedy : str
        What to type or to set.
    """

    id: str
    severity: Severity
    message: str
    remedy: str
    evidence: dict[str, float | str] = field(default_factory=dict)


@dataclass(frozen=True)
class Threshold:
    """A number that a detector compares with."""

    value: float
    unit: str
    source: str


Detector = Callable[[Analysis], Iterator[Finding]]


def times(count: int) -> str:
    """How often, in words: "once", "2 times"."""
    return "once" if count == 1 else f"{count} times"


def sentence(note: str) -> str:
    """A note with a capital letter, unless it begins with a file's name."""
    first = note.split(" ", 1)[0]
    return note if "." in first else note[:1].upper() + note[1:]


def motion_range_m(comparison: Comparison) -> float:
    """Larger horizontal extent of the source in the segment, 5 to 95 %."""
    inside = within(comparison.source.samples, comparison.segment)
    low, high = inside[POSITION_COLUMNS[:2]].quantile([0.05, 0.95]).to_numpy()
    return float(np.max(high - low))


def step_share(steps: pd.Series, start_s: float, end_s: float) -> float:
    """Share of a span in which a 0/1 step function is 1."""
    edges = np.clip(np.append(steps.index.to_numpy(), np.inf), start_s, end_s)
    edges[0] = start_s  # its first value also holds before
    return float(np.sum(np.diff(edges) * steps.to_numpy()) / (end_s - start_s))
