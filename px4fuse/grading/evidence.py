"""What a check may look at, and how it speaks of it."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

from px4fuse.assignment.key import AnswerKey
from px4fuse.filter.tuning import HORIZONTAL
from px4fuse.grading.notes import Notes
from px4fuse.results.contract import ComparisonResults, LoopResults, Reported, to_plain
from px4fuse.results.model import Absent
from px4fuse.verification.model import Report, Verdict

MAX_QUOTE = 160
# Lists are cut where a comment would become longer than a sentence
NAMED = 4
STEP = re.compile(r'"([^"]*)"|([^."]+)')

Scorer = Callable[["Evidence", Mapping[str, Any]], tuple[float, str]]


@dataclass(frozen=True)
class Evidence:
    """What a check may look at."""

    report: Report
    verdict: Verdict
    words: Mapping[str, tuple[str, ...]]
    key: AnswerKey | None

    @property
    def results(self) -> Reported:
        """The attached results."""
        return self.report.results

    @property
    def comparison(self) -> ComparisonResults | None:
        """The attached results where they compare filters."""
        return None if isinstance(self.results, LoopResults) else self.results

    @property
    def kind(self) -> Literal["compare", "loop"]:
        """Which command made the report."""
        return "loop" if isinstance(self.results, LoopResults) else "compare"

    @cached_property
    def plain(self) -> dict[str, Any]:
        """The attached results, for paths that a rubric names."""
        return to_plain(self.results)

    @cached_property
    def notes(self) -> Notes:
        """The student's own words."""
        return Notes(self.results.student.notes)

    def names(self, finding: str, affirmed: bool = False) -> bool:
        """Whether the notes name a finding: by its id, or by words that stand for it."""
        phrases = (finding, finding.replace("_", " "), *self.words.get(finding, ()))
        return self.notes.mention(phrases, affirmed)

    def has(self, finding: str) -> bool:
        """Whether the report lists a finding."""
        return any(finding in one.ids for one in self.results.findings)


def values_at(results: Mapping[str, Any], path: str) -> Iterator[tuple[str, Any]]:
    """Paths and values where a path leads; ``*`` is every key, quotes hold names with dots.

    >>> list(values_at({"a": {"b.c": [1, 2]}}, 'a."b.c".1'))
    [('a.b.c.1', 2)]
    """
    found: list[tuple[str, Any]] = [("", results)]
    for match in STEP.finditer(path):
        step = match[1] if match[1] is not None else match[2]
        every = match[2] == "*"
        following = []
        for name, value in found:
            if isinstance(value, dict):
                keys = list(value) if every else [step] * (step in value)
                following += [(f"{name}.{key}", value[key]) for key in keys]
            elif isinstance(value, list | tuple):
                following += [
                    (f"{name}.{place}", value[place])
                    for place in range(len(value))
                    if every or step == str(place)
                ]
        found = following
    yield from ((name.removeprefix("."), value) for name, value in found)


def is_number(value: object) -> bool:
    """Whether a value is a number, and no flag."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def text_of(value: str) -> str:
    """One line of text, without control characters and not too long to be quoted."""
    kept = "".join(c if unicodedata.category(c)[0] != "C" else " " for c in value[: 4 * MAX_QUOTE])
    line = " ".join(kept.split())
    return line if len(line) <= MAX_QUOTE else line[: MAX_QUOTE - 1] + "…"


def absence(part: object) -> str:
    """Why a part is not there, in brackets; "" where it is, or nobody says."""
    if isinstance(part, Absent):
        return f" ({text_of(part.unavailable.reason).rstrip('.')})"
    return ""


def why_absent(evidence: Evidence, path: str) -> str:
    """Why there is nothing at a path of the rubric: what the results themselves say of it."""
    steps = [match[0] for match in STEP.finditer(path)]
    for end in range(len(steps), 0, -1):
        above = ".".join(steps[:end])
        for _, reason in values_at(evidence.plain, f"{above}.unavailable.reason"):
            return f" ({text_of(reason).rstrip('.')})"
    return why_not_horizontal(evidence) if HORIZONTAL in path else ""


def why_not_horizontal(evidence: Evidence) -> str:
    """Why there is nothing about north and east together."""
    if evidence.comparison is None or {"north", "east"} <= set(evidence.comparison.axes):
        return ""
    return " (it needs the axes north and east, which were not both analysed: leave --axis out)"


def list_words(names: Sequence[str]) -> str:
    """Names with commas between them, the first few."""
    shown = ", ".join(names[:NAMED])
    return f"{shown} and {len(names) - NAMED} more" if len(names) > NAMED else shown


def reason_of(verdict: Verdict) -> str:
    """The first reason of a verdict, in brackets."""
    said = joined(verdict.reasons[:1])
    return f" ({said})" if said else ""


def joined(reasons: Sequence[str]) -> str:
    """Reasons as the end of a sentence."""
    return "; ".join(text for reason in reasons if (text := text_of(reason).rstrip(".")))


def drifts(evidence: Evidence) -> bool:
    """Whether the report says that its innovations are no measure of the error."""
    return evidence.has("source_may_drift") or evidence.has("errors_larger_than_claimed")
