"""What a check may look at, and how it speaks of it."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, Literal

from px4fuse.assignment.drawing import POSSIBLE_FINDINGS
from px4fuse.assignment.key import Answer, AnswerKey
from px4fuse.filter.tuning import HORIZONTAL
from px4fuse.findings import named
from px4fuse.grading.claims import TOPICS, Claims, claims_of, entailed, family
from px4fuse.grading.folding import folded
from px4fuse.grading.model import Rubric
from px4fuse.grading.notes import WORD, Mention, Notes, Words, read_notes
from px4fuse.plain import few_words
from px4fuse.record import Unavailable
from px4fuse.results.contract import ComparisonResults, LoopResults, Reported, to_plain
from px4fuse.results.reading import one_line
from px4fuse.verification.model import Report, Verdict
from px4fuse.verification.rerun import log_sha256

MAX_QUOTE = 160
MAX_PASSAGE = 80
# Lists are cut where a comment would become longer than a sentence
NAMED = 4
# Words of the field: these, and those of the rubric's phrases that are not shorter
SHORT = 3
FIELD = frozenset(("ekf", "gps", "imu", "nis", "uwb", "vio"))
# In the words of the rubric: what says that a flight has no mistake
NOTHING = "none"
NUMBER = re.compile(r"(?<![\w.])\d+(?:\.\d+)?")
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

    @property
    def words(self) -> Mapping[str, tuple[str, ...]]:
        """The rubric's words."""
        return self.rubric.words

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
    def notes(self) -> Notes:
        """The student's own words; what names everything is refused as a whole."""
        notes = self._notes
        if self.claims.count > self.rubric.notes.most_named:
            problem = f"name {self.claims.count} kinds of mistakes as if all were there"
            return replace(notes, problem=problem)
        return notes

    @cached_property
    def _notes(self) -> Notes:
        ids = {name for name in self.words if "_" in name}
        phrases = (phrase for name in ids for phrase in self.words[name])
        terms = {stem for phrase in phrases for stem in WORD.findall(folded(phrase))}
        known = (
            frozenset(folded(word) for word in self.words.get(name, ()))
            for name in ("negation", "doubt", "reassurance", "contrast")
        )
        return read_notes(
            self.results.student.notes,
            Words(*known),
            self.rubric.notes,
            ids,
            tuple(_texts({**self.plain, "student": None})),
            {stem for stem in terms if len(stem) > SHORT} | FIELD,
        )

    @cached_property
    def claims(self) -> Claims:
        """What the notes claim against what the answer key, or else the report, has."""
        shown = {one for found in self.results.findings for one in found.ids}
        there = shown if self.answer is None else set(self.answer.findings)
        return claims_of(
            partial(self._mention, self._notes), there, POSSIBLE_FINDINGS, entailed(there) | shown
        )

    @property
    def charged(self) -> Mapping[str, str]:
        """Mistakes that the notes wrongly claim, with the passages; only a key knows which.

        Notes that name nothing of what is there have named the subjects to which they give a size:
        "a clock offset of 0.2 s", but not "the clock offset is 0.00 s".
        """
        if self.answer is None or self.notes.problem:
            return {}
        claims = self.claims
        charged = dict(claims.wrong)
        right = bool(claims.earned or claims.unsure or claims.open)
        if not self.answer.findings:
            right = self.finds_nothing
        for finding, passage in () if right else claims.unsure_wrong.items():
            sized = any(float(number) for number in NUMBER.findall(passage))
            if sized and finding not in family(charged):
                charged[finding] = passage
        return charged

    @property
    def finds_nothing(self) -> bool:
        """Whether the notes say plainly that the flight has no mistake."""
        return self.notes.claims(self.words.get(NOTHING, ()))

    def _mention(self, notes: Notes, finding: str) -> tuple[Mention | None, bool]:
        """What notes say of a finding, and whether they only touch upon it."""
        topics = set(self.words.get(TOPICS, ()))
        phrases = (finding, finding.replace("_", " "), *self.words.get(finding, ()))
        plain = notes.mention([one for one in phrases if one not in topics])
        if plain is not None and plain.stance == "claimed":
            return plain, False
        touched = notes.mention([one for one in phrases if one in topics])
        if touched is not None and (plain is None or touched.stance == "claimed"):
            return touched, True
        return plain, False

    def names(self, finding: str) -> bool:
        """Whether the notes take a finding up."""
        said, weak = self._mention(self.notes, finding)
        if said is None or said.stance != "claimed":
            return False
        return not weak or finding not in POSSIBLE_FINDINGS or not self.claims.unsure_wrong

    def claims_that(self, finding: str) -> bool:
        """Whether the notes say plainly that it is so."""
        said, weak = self._mention(self.notes, finding)
        return said is not None and said.stance == "claimed" and not weak

    def has(self, finding: str) -> bool:
        """Whether the report lists a finding."""
        return any(finding in one.ids for one in self.results.findings)


def _texts(value: object) -> Iterator[str]:
    """All texts in plain results."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for part in value.values():
            yield from _texts(part)
    elif isinstance(value, list | tuple):
        for part in value:
            yield from _texts(part)


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
    return evidence.has("source_may_drift") or evidence.has("errors_larger_than_claimed")


def also_named(wrong: Mapping[str, str]) -> str:
    """What notes wrongly claim, as the end of a sentence; empty without any."""
    if not wrong:
        return ""
    passages = [
        f"{named(one)} (\u201c{one_line(said, MAX_PASSAGE)}\u201d)" for one, said in wrong.items()
    ]
    return (
        f"; they also name {list_words(passages)}, which your log does not have: that costs as "
        "much as naming what it has earns"
    )
