"""What a check may look at, and how it speaks of it."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

from px4fuse.answers import Answers, check
from px4fuse.assignment.key import Answer, AnswerKey
from px4fuse.filter.tuning import HORIZONTAL
from px4fuse.grading.form_points import FormPoints, form_points
from px4fuse.grading.model import Rubric
from px4fuse.plain import few_words
from px4fuse.record import Unavailable
from px4fuse.results.contract import ComparisonResults, LoopResults, Reported, to_plain
from px4fuse.results.reading import one_line
from px4fuse.verification.model import Report, Verdict
from px4fuse.verification.rerun import log_sha256

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
    rubric: Rubric
    key: AnswerKey | None
    owner_id: str = ""

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
    def answer(self) -> Answer | None:
        """What is wrong with this log, where it is one of the answer key."""
        return None if self.key is None else self.key.of_log(log_sha256(self.results))

    @cached_property
    def own(self) -> bool:
        """Whether the answer key gave this log to this student; without a key nobody knows."""
        if self.key is None:
            return True
        claimed = self.key.of_student(text_of(self.results.student.id))
        given = self.key.of_student(self.owner_id) or claimed
        return given is not None and given.sha256 == log_sha256(self.results)

    @cached_property
    def form(self) -> Answers | None:
        """The form of the report, where it can be read and is about this log."""
        answers = self.results.student.answers
        return answers if isinstance(answers, Answers) and not self.form_problem else None

    @cached_property
    def form_problem(self) -> str:
        """Why there is no form to score, as the end of "your form ..."."""
        answers = self.results.student.answers
        if not isinstance(answers, Answers):
            return "is not in your report: make it with --answers answers.toml"
        try:
            check(answers)
        except ValueError as error:
            return f"cannot be read ({text_of(str(error))})"
        if answers.log_sha256 != log_sha256(self.results):
            return "was made for another log"
        return ""

    def claims(self, *kinds: str) -> bool:
        """Whether the form names one of these mistakes."""
        return self.form is not None and any(one.kind in kinds for one in self.form.mistakes)

    @property
    def form_points(self) -> FormPoints | None:
        """What the form is worth; None without an answer key for this log, or without a form."""
        truth = None if self.answer is None else self.answer.form
        return None if truth is None or self.form is None else form_points(self.form, truth)

    def has(self, finding: str) -> bool:
        """Whether the report lists a finding."""
        return any(one.id == finding for one in self.results.findings)


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


def text_of(value: str) -> str:
    """One line of text, without control characters and not too long to be quoted."""
    return one_line(value, MAX_QUOTE)


def absence(part: object) -> str:
    """Why a part is not there, in brackets; "" where it is, or nobody says."""
    if isinstance(part, Unavailable):
        return f" ({text_of(part.reason).rstrip('.')})"
    return ""


def why_absent(evidence: Evidence, path: str) -> str:
    """Why there is nothing at a path of the rubric: what the results themselves say of it."""
    steps = [match[0] for match in STEP.finditer(path)]
    for end in range(len(steps), 0, -1):
        above = ".".join(steps[:end])
        for _, reason in values_at(evidence.plain, f"{above}.reason"):
            return f" ({text_of(reason).rstrip('.')})"
    return why_not_horizontal(evidence) if HORIZONTAL in path else ""


def why_not_horizontal(evidence: Evidence) -> str:
    """Why there is nothing about north and east together."""
    if evidence.comparison is None or {"north", "east"} <= set(evidence.comparison.axes):
        return ""
    return " (it needs the axes north and east, which were not both analysed: leave --axis out)"


def list_words(names: Sequence[str]) -> str:
    """Names with commas between them, the first few."""
    return few_words(names, NAMED)


def reason_of(verdict: Verdict) -> str:
    """The first reason of a verdict, in brackets."""
    said = joined(verdict.reasons[:1])
    return f" ({said})" if said else ""


def joined(reasons: Sequence[str]) -> str:
    """Reasons as the end of a sentence."""
    return "; ".join(text for reason in reasons if (text := text_of(reason).rstrip(".")))


def drifts(evidence: Evidence) -> bool:
    """Whether the report says that its innovations do not measure the error."""
    return evidence.has("source_may_drift")
