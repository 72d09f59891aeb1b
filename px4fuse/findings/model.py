"""What a finding is, and what its file declares of it."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Generic, Literal, TypeVar

import msgspec
import numpy as np
import pandas as pd
from msgspec import Meta

from px4fuse.record import Record, Span

Subject = TypeVar("Subject")
Severity = Literal["error", "warning", "info"]
SEVERITIES: tuple[Severity, Severity, Severity] = ("error", "warning", "info")


class Finding(Record, frozen=True, omit_defaults=False):
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
    consequences : tuple of Finding
        What the same cause brings with it, each with its own evidence.
    spans_s : tuple of (float, float)
        From when to when it shows, seconds from the first data; empty where that is throughout.
    """

    id: Annotated[str, Meta(pattern="^[a-z0-9_]+$")]
    severity: Severity
    message: str
    remedy: str
    evidence: Mapping[str, int | float | str] = msgspec.field(default_factory=dict)
    consequences: tuple[Finding, ...] = ()
    spans_s: tuple[Span, ...] = ()

    @property
    def when(self) -> str:
        """When it shows, in words; empty where that is throughout."""
        if len(self.spans_s) > MOST_SPANS:
            return f"from {self.spans_s[0][0]:.1f} s to {self.spans_s[-1][1]:.1f} s"
        told = [
            f"{start:.1f} s to {end:.1f} s" if end - start > MOMENT_S else f"{start:.1f} s"
            for start, end in self.spans_s
        ]
        return ", ".join(told)

    @property
    def headline(self) -> str:
        """What the message says before it explains: no brackets, no full stop."""
        told = re.sub(r" \([^()]*\)", "", self.message)
        return re.split(r"[:;.] |\.$", told, maxsplit=1)[0]

    def __repr__(self) -> str:
        return f"<{self.severity} {self.id}: {self.message} {self.remedy}>"

    @property
    def ids(self) -> tuple[str, ...]:
        """Its own id and those of its consequences."""
        return (self.id, *(finding.id for finding in self.consequences))


@dataclass(frozen=True)
class Threshold:
    """A number that a detector compares with."""

    value: float
    unit: str
    source: str


Found = Iterator[Finding]

# More are not listed one by one
MOST_SPANS = 3
# Shorter is told as one moment
MOMENT_S = 0.05


def moments(times_s: Iterable[float]) -> tuple[tuple[float, float], ...]:
    """Spans of no length, for what happens at a moment."""
    return tuple((float(time), float(time)) for time in times_s)


@dataclass(frozen=True)
class Detector(Generic[Subject]):
    """What one file of this package declares: one finding, or those that share a condition.

    Attributes
    ----------
    detect : callable
        From an ``Analysis`` or a ``Loop`` to findings, with condition, words and remedy.
    names : mapping
        Every id that it may yield, to what it is called within a sentence.
    measured_on : mapping
        Id to the simulated flights on which its rate is measured (``rates.csv``): options of
        ``px4fuse simulate``, or a field of ``Settings`` with its value.
    """

    detect: Callable[[Subject], Found]
    measured_on: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    names: Mapping[str, str] = field(kw_only=True)


def lowered(severity: Severity) -> Severity:
    """One step less severe: what nobody chose is advice."""
    return SEVERITIES[min(SEVERITIES.index(severity) + 1, len(SEVERITIES) - 1)]


def times(count: int) -> str:
    """How often, in words: "once", "2 times"."""
    return "once" if count == 1 else f"{count} times"


def sentence(note: str) -> str:
    """A note with a capital letter, unless it begins with a file's name."""
    first = note.split(" ", 1)[0]
    return note if "." in first else note[:1].upper() + note[1:]


def off_spans(steps: pd.Series, start_s: float, end_s: float) -> tuple[tuple[float, float], ...]:
    """Parts of a span in which a 0/1 step function is 0."""
    begins = np.clip(steps.index.to_numpy(), start_s, end_s)
    begins[0] = start_s  # its first value also holds before
    ends = np.append(begins[1:], end_s)
    off = (steps.to_numpy() == 0.0) & (ends > begins)
    return tuple(zip(begins[off].tolist(), ends[off].tolist(), strict=True))


def step_share(steps: pd.Series, start_s: float, end_s: float) -> float:
    """Share of a span in which a 0/1 step function is 1."""
    edges = np.clip(np.append(steps.index.to_numpy(), np.inf), start_s, end_s)
    edges[0] = start_s  # its first value also holds before
    return float(np.sum(np.diff(edges) * steps.to_numpy()) / (end_s - start_s))
