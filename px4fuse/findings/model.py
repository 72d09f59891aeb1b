"""What a finding is, and the words that several of them share."""

from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np
import pandas as pd
from msgspec import Meta

from px4fuse.filter.signals import Segment
from px4fuse.record import Record, Span, table

Severity = Literal["error", "warning", "info"]
SEVERITIES: tuple[Severity, Severity, Severity] = ("error", "warning", "info")
# Of each finding, in the order in which those of one rank are told
WORDS: Mapping[str, Mapping[str, Any]] = table(__file__, "words.toml", dict[str, Any])
NAMES: Mapping[str, str] = {name: words["called"] for name, words in WORDS.items()}
# More times are not listed one by one
MAX_LISTED_SPANS = 3
# Shorter is told as one moment
MOMENT_S = 0.05


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
        What is wrong, and what that means.
    remedy : str
        What to type or to set.
    evidence : dict
        Numbers, with units in their names.
    headline : str
        The first part of the message: what is wrong, without full stop.
    caused_by : str or None
        Id of the finding that it follows from: the nearest one before it with that id.
    spans_s : tuple of (float, float)
        From when to when it shows, seconds from the first data; empty where that is throughout.
    """

    id: Annotated[str, Meta(pattern="^[a-z0-9_]+$")]
    severity: Severity
    message: str
    remedy: str
    evidence: Mapping[str, int | float | str] = {}
    headline: str = ""
    caused_by: str | None = None
    spans_s: tuple[Span, ...] = ()

    @property
    def when(self) -> str:
        """When it shows, in words; empty where that is throughout."""
        if len(self.spans_s) > MAX_LISTED_SPANS:
            return f"from {self.spans_s[0][0]:.1f} s to {self.spans_s[-1][1]:.1f} s"
        return ", ".join(
            f"{start:.1f} s to {end:.1f} s" if end - start > MOMENT_S else f"{start:.1f} s"
            for start, end in self.spans_s
        )

    @property
    def says_when(self) -> bool:
        """Whether the message names the moment, as the evidence does."""
        return not {"at_s", "first_s", "until_s"}.isdisjoint(self.evidence)

    def __repr__(self) -> str:
        return f"<{self.severity} {self.id}: {self.message} {self.remedy}>"


Found = Iterator[Finding]


def finding(
    severity: Severity,
    name: str,
    evidence: Mapping[str, int | float | str] = {},
    spans_s: tuple[Span, ...] = (),
    **facts: Any,
) -> Finding:
    """A finding in its words of ``words.toml``, filled with the evidence and more facts.

    Of several texts a fact of their name chooses one, and ``case`` where there is none of it.
    """
    values: dict[str, Any] = {**evidence, **facts}
    for part, text in WORDS[name].items():
        template = (
            text if isinstance(text, str) else text[values[part if part in values else "case"]]
        )
        values[part] = template.format_map(values)
    message = f"{values['headline']}{values['more']}"
    return Finding(
        name, severity, message, values["remedy"], evidence, values["headline"], spans_s=spans_s
    )


error, warning, info = (partial(finding, severity) for severity in SEVERITIES)


def by_root(findings: Iterable[Finding]) -> list[list[Finding]]:
    """Findings that follow from no other, each with those behind it that follow from it."""
    groups: list[list[Finding]] = []
    for one in findings:
        if one.caused_by is None:
            groups.append([])
        groups[-1].append(one)
    return groups


def moments(times_s: Iterable[float]) -> tuple[Span, ...]:
    """Spans of no length, for what happens at a moment."""
    return tuple((float(time), float(time)) for time in times_s)


def one_level_lower(severity: Severity) -> Severity:
    """One step less severe: what nobody chose is advice."""
    return "warning" if severity == "error" else "info"


def format_count(count: int) -> str:
    """How often, in words: "once", "2 times"."""
    return "once" if count == 1 else f"{count} times"


def spans_at(value: float, steps: pd.Series, segment: Segment) -> tuple[Span, ...]:
    """Parts of a segment in which a step function has a value; its first one holds before too."""
    edges = np.clip(np.append(steps.index.to_numpy(), np.inf), segment.start_s, segment.end_s)
    edges[0] = segment.start_s
    there = (steps.to_numpy() == value) & (np.diff(edges) > 0.0)
    return tuple(zip(edges[:-1][there].tolist(), edges[1:][there].tolist(), strict=True))


def fraction_on(steps: pd.Series, segment: Segment) -> float:
    """Share of a segment in which a 0/1 step function is 1."""
    on_s = sum(end - start for start, end in spans_at(1.0, steps, segment))
    return on_s / (segment.end_s - segment.start_s)
