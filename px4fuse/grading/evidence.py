"""What a check may look at, how a rubric asks for it, and how it speaks of what it found."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal

import msgspec
from msgspec import Meta

from px4fuse.answers import Answers, check
from px4fuse.assignment.key import Answer, AnswerKey
from px4fuse.filter.tuning import HORIZONTAL
from px4fuse.grading.form_points import FormPoints, form_points
from px4fuse.record import Unavailable
from px4fuse.results.contract import ComparisonResults, LoopResults, Reported, to_plain
from px4fuse.results.reading import one_line
from px4fuse.verification.model import Verdict
from px4fuse.verification.rerun import log_sha256
from px4fuse.verification.verification import flattened

MAX_QUOTE = 160
# Lists are cut where a comment would become longer than a sentence
NAMED = 4
NOT_BOTH = " (it needs the axes north and east: leave --axis out)"

# What stands on one line
_PLAIN = r"[^\x00-\x1f\x7f]"
Text = Annotated[str, Meta(max_length=200, pattern=rf"^{_PLAIN}*$")]
Title = Annotated[str, Meta(max_length=200, pattern=rf"^{_PLAIN}*[^\s\x00-\x1f\x7f]{_PLAIN}*$")]
Bound = Annotated[float, Meta(ge=-1e12, le=1e12)]
Factor = Annotated[float, Meta(ge=1.0, le=1000.0)]
# Share of the points, and why
Scored = tuple[float, str]


class RubricItem(
    msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="check"
):
    """One part of the grade; each check is a kind of item, whose fields are its parameters.

    Attributes
    ----------
    points : float
        The most that it gives.
    report : {"any", "compare", "loop"}
        The reports that it is for; in others it is left out.
    needs_key, by_hand : bool
        Whether it takes an answer key, and whether only the instructor can score it.
    """

    needs_key: ClassVar[bool] = False
    by_hand: ClassVar[bool] = False

    title: Title
    points: Annotated[float, Meta(ge=0.0, le=1000.0)]
    report: Literal["any", "compare", "loop"] = "any"

    def score(self, evidence: Evidence) -> Scored:
        """Share of the points from 0 to 1, and a sentence that says why."""
        raise NotImplementedError

    def applies(self, kind: str, key: AnswerKey | None) -> bool:
        """Whether reports of this kind have it."""
        return self.report in ("any", kind) and (key is not None or not self.needs_key)


@dataclass(frozen=True)
class Evidence:
    """What a check may look at: a report's results, the verdict on them, and the answer key.

    ``owner_id`` is who handed it in by what a platform says, whatever the report says.
    """

    results: Reported
    verdict: Verdict
    key: AnswerKey | None
    owner_id: str = ""

    @property
    def comparison(self) -> ComparisonResults | None:
        """The results where they compare filters."""
        return None if isinstance(self.results, LoopResults) else self.results

    @property
    def kind(self) -> Literal["compare", "loop"]:
        """Which command made the report."""
        return "loop" if isinstance(self.results, LoopResults) else "compare"

    @cached_property
    def values(self) -> dict[str, Any]:
        """What the results hold, for paths that a rubric names."""
        return dict(flattened(to_plain(self.results)))

    @cached_property
    def answer(self) -> Answer | None:
        """What is wrong with this log, where it is one of the answer key."""
        return None if self.key is None else self.key.of_log(log_sha256(self.results))

    @cached_property
    def given(self) -> Answer | None:
        """What the answer key gave to this student; the platform knows better who that is."""
        if self.key is None:
            return None
        claimed = self.key.of_student(text_of(self.results.student.id))
        return self.key.of_student(self.owner_id) or claimed

    @cached_property
    def own(self) -> bool:
        """Whether the answer key gave this log to this student; without a key nobody knows."""
        given = self.given
        return self.key is None or (given is not None and given.sha256 == log_sha256(self.results))

    @cached_property
    def form(self) -> Answers | str:
        """The form about this log, or why there is none."""
        answers = self.results.student.answers
        if not isinstance(answers, Answers):
            return "your form is not in your report: make it with --answers answers.toml"
        try:
            check(answers)
        except ValueError as error:
            return f"your form cannot be read ({text_of(str(error))})"
        if answers.log_sha256 != log_sha256(self.results):
            return "your form was made for another log"
        return answers

    @cached_property
    def form_points(self) -> FormPoints | str:
        """What the form is worth, or why nothing."""
        if self.answer is None or (self.given and not self.own):
            given = f" ({text_of(self.given.file)})" if self.given else ""
            return (
                f"this report is not about the log that you were given{given}: make it of that "
                "log, with your --id"
            )
        if isinstance(self.form, str):
            return self.form
        truth = self.answer.form
        return "the answer key has no answers" if truth is None else form_points(self.form, truth)

    def claims(self, *kinds: str) -> bool:
        """Whether the form names one of these mistakes."""
        form = self.form
        return isinstance(form, Answers) and any(one.kind in kinds for one in form.mistakes)

    def has(self, finding: str) -> bool:
        """Whether the report lists a finding."""
        return any(one.id == finding for one in self.results.findings)

    def why_absent(self, path: str) -> str:
        """Why there is nothing at a path, in brackets, as far as the results say it."""
        steps = path.split(".")
        for end in range(len(steps), 0, -1):
            for _, reason in values_at(self.values, ".".join((*steps[:end], "reason"))):
                return f" ({text_of(reason).rstrip('.')})"
        return NOT_BOTH if HORIZONTAL in path else ""


def values_at(values: Mapping[str, Any], path: str) -> list[tuple[str, Any]]:
    """Paths and values where a path leads; ``*`` is every key, quotes may enclose names with dots.

    >>> values_at({"a.b.c.0": 1, "a.b.c.d.0": 2}, 'a."b.c".*')
    [('a.b.c.0', 1)]
    """
    pattern = re.compile(re.escape(path.replace('"', "")).replace(r"\*", "[^.]*"))
    return [(name, value) for name, value in values.items() if pattern.fullmatch(name)]


def falling(off: float, factor: float) -> float:
    """Share for what is off by a factor: 1 where it is not, 0 from ``factor`` on, by logarithms.

    >>> [round(falling(off, 4.0), 2) for off in (1.0, 2.0, 4.0, 9.0)]
    [1.0, 0.5, 0.0, 0.0]
    """
    if off <= 1.0:
        return 1.0
    return max(1.0 - math.log(off) / math.log(factor), 0.0) if factor > 1.0 else 0.0


def text_of(value: str) -> str:
    """One line of text, without control characters and not too long to be quoted."""
    return one_line(value, MAX_QUOTE)


def absence(part: object) -> str:
    """Why a part is not there, in brackets; "" where it is, or nobody says."""
    return f" ({text_of(part.reason).rstrip('.')})" if isinstance(part, Unavailable) else ""


def joined(reasons: Sequence[str]) -> str:
    """Reasons as the end of a sentence."""
    return "; ".join(text for reason in reasons if (text := text_of(reason).rstrip(".")))


def reason_of(verdict: Verdict) -> str:
    """The first reason of a verdict, in brackets."""
    said = joined(verdict.reasons[:1])
    return f" ({said})" if said else ""
