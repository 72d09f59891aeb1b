"""The checks that a rubric can ask for: each is a kind of item, whose fields are its parameters.

A check looks at the :class:`Evidence`. Three groups: of the report as such, of the filter
(settings, consistency, the clocks that it rests on), and of a loop. A check is its class here, and
an item of rubric.toml that explains it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal

import msgspec
from msgspec import Meta

from px4fuse.answers import Answers, check
from px4fuse.assignment.key import Answer, AnswerKey
from px4fuse.comparison.model import AgainstTruth
from px4fuse.filter.clock import Clock
from px4fuse.filter.consistency import SIGMA_FACTOR_FINDING, HorizontalNis
from px4fuse.filter.tuning import HORIZONTAL
from px4fuse.grading.form_points import FormPoints, form_points
from px4fuse.loop.model import Correction, LoopResult, Way
from px4fuse.plain import capitalise_first, format_factor, format_length
from px4fuse.record import OrUnavailable, Share
from px4fuse.results.contract import (
    TUNED_FIELDS,
    ComparisonResults,
    LoopResults,
    Reported,
    to_plain,
)
from px4fuse.results.reading import one_line
from px4fuse.trajectory.evaluation import Score
from px4fuse.verification.model import Verdict
from px4fuse.verification.verification import flatten, is_number, log_sha256

MAX_QUOTE = 160
NEEDS_BOTH_AXES = " (it needs the axes north and east: leave --axis out)"
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


def falling_share(off: float, factor: float) -> float:
    """Share for what is off by a factor: 1 where it is not, 0 from ``factor`` on, by logarithms.

    >>> [round(falling_share(off, 4.0), 2) for off in (1.0, 2.0, 4.0, 9.0)]
    [1.0, 0.5, 0.0, 0.0]
    """
    if off <= 1.0:
        return 1.0
    return max(1.0 - math.log(off) / math.log(factor), 0.0) if factor > 1.0 else 0.0


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

    @cached_property
    def values(self) -> dict[str, Any]:
        """What the results hold, for paths that a rubric names."""
        return dict(flatten(to_plain(self.results)))

    @cached_property
    def answer(self) -> Answer | None:
        """What is wrong with this log, where it is one of the answer key."""
        return None if self.key is None else self.key.of_log(log_sha256(self.results))

    @cached_property
    def assigned_answer(self) -> Answer | None:
        """What the answer key gave to this student; the platform knows better who that is."""
        if self.key is None:
            return None
        claimed = self.key.of_student(text_of(self.results.student.id))
        return self.key.of_student(self.owner_id) or claimed

    @cached_property
    def is_own_log(self) -> bool:
        """Whether the answer key gave this log to this student; without a key nobody knows."""
        assigned_answer = self.assigned_answer
        return self.key is None or (
            assigned_answer is not None and assigned_answer.sha256 == log_sha256(self.results)
        )

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
        if self.answer is None or (self.assigned_answer and not self.is_own_log):
            assigned_answer = (
                f" ({text_of(self.assigned_answer.file)})" if self.assigned_answer else ""
            )
            return (
                f"this report is not about the log that you were given{assigned_answer}: make it of that "
                "log, with your --id"
            )
        if isinstance(self.form, str):
            return self.form
        answer_key_form = self.answer.form
        return (
            "the answer key has no answers"
            if answer_key_form is None
            else form_points(self.form, answer_key_form)
        )

    def names_mistake(self, *kinds: str) -> bool:
        """Whether the form names one of these mistakes."""
        form = self.form
        return isinstance(form, Answers) and any(one.kind in kinds for one in form.mistakes)

    def has_finding(self, finding: str) -> bool:
        """Whether the report lists a finding."""
        return any(one.id == finding for one in self.results.findings)

    def missing_reason(self, path: str) -> str:
        """Why there is nothing at a path, in brackets, as far as the results say it."""
        steps = path.split(".")
        for end in range(len(steps), 0, -1):
            for _, reason in values_at(self.values, ".".join((*steps[:end], "reason"))):
                return in_brackets(reason)
        return NEEDS_BOTH_AXES if HORIZONTAL in path else ""


def values_at(values: Mapping[str, Any], path: str) -> list[tuple[str, Any]]:
    """Paths and values where a path leads; ``*`` is every key, quotes may enclose names with dots.

    >>> values_at({"a.b.c.0": 1, "a.b.c.d.0": 2}, 'a."b.c".*')
    [('a.b.c.0', 1)]
    """
    pattern = re.compile(re.escape(path.replace('"', "")).replace(r"\*", "[^.]*"))
    return [(name, value) for name, value in values.items() if pattern.fullmatch(name)]


def text_of(value: str) -> str:
    """One line of text, without control characters and not too long to be quoted."""
    return one_line(value, MAX_QUOTE)


def in_brackets(reason: str) -> str:
    """A reason behind what it is the reason of."""
    text = text_of(reason).rstrip(".")
    return f" ({text})" if text else ""


# ------------------------------------------------------------------ the report


NO_COMPARISON: Scored = (0.0, "Your report compares no filters.")


class VerifiedItem(RubricItem, frozen=True, kw_only=True, tag="verified"):
    """The numbers were computed again and agree."""

    def score(self, evidence: Evidence) -> Scored:
        """All or nothing."""
        verdict = evidence.verdict
        why = in_brackets("".join(verdict.reasons[:1]))
        return float(verdict.status == "verified"), f"Verification says: {verdict.status}{why}."


class NumberItem(RubricItem, frozen=True, kw_only=True, tag="number"):
    """A number of the report is between bounds; where ``path`` has several the worst counts.

    ``zero_at`` says from where on there are no points; without it there are none out of bounds.
    """

    path: Text
    name: Text = ""
    unit: Text = ""
    at_least: Bound = -math.inf
    at_most: Bound = math.inf
    zero_at: Bound | None = None
    advice: Text = ""

    def __post_init__(self) -> None:
        bounded = math.isfinite(self.at_least) or math.isfinite(self.at_most)
        if not bounded or self.at_least > self.at_most or self._width() < 0.0:
            raise ValueError("give at_least, at_most or both, in this order, and zero_at beyond")

    def _width(self) -> float:
        """How far beyond a bound there are no points any more."""
        zero = self.zero_at
        return 0.0 if zero is None else max(self.at_least - zero, zero - self.at_most)

    def _share(self, number: float) -> float:
        excess = max(self.at_least - number, number - self.at_most, 0.0)
        if excess == 0.0:
            return 1.0
        return max(1.0 - excess / self._width(), 0.0) if self._width() > 0.0 else 0.0

    def score(self, evidence: Evidence) -> Scored:
        """1 within the bounds, falling to 0 at ``zero_at``."""
        values = values_at(evidence.values, self.path)
        values_by_path = {name: float(one) for name, one in values if is_number(one)}
        if not values_by_path:
            label = self.name or f"the number {self.path}"
            return (
                0.0,
                f"Your report has no number for {label}{evidence.missing_reason(self.path)}.",
            )
        name, number = min(values_by_path.items(), key=lambda pair: self._share(pair[1]))
        share, label = self._share(number), self.name or f"the number {text_of(name)}"
        bounds = (("at least", self.at_least), ("at most", self.at_most))
        limits = [f"{word} {bound:.4g}" for word, bound in bounds if math.isfinite(bound)]
        statement = f"{capitalise_first(label)} is {f'{number:.4g} {self.unit}'.strip()}"
        advice = f" {self.advice}" if share < 1.0 and self.advice else ""
        return share, f"{statement}; {' and '.join(limits)} was asked for.{advice}"


class AnswersItem(RubricItem, frozen=True, kw_only=True, tag="answers"):
    """The form about the flight, by the answer key."""

    needs_key: ClassVar[bool] = True

    def score(self, evidence: Evidence) -> Scored:
        """Share of the points of :mod:`px4fuse.grading.form_points`."""
        form_result = evidence.form_points
        if isinstance(form_result, str):
            return 0.0, f"{capitalise_first(form_result)}."
        points_by_part = [
            f"{name} {points:.3g} of {form_result.of[name]:g}"
            for name, points in form_result.points_by_part.items()
            if form_result.of[name]
        ]
        return (
            form_result.share,
            f"Of 100: {', '.join(points_by_part)}. {capitalise_first('; '.join(form_result.feedback))}.",
        )


class TextItem(RubricItem, frozen=True, kw_only=True, tag="text"):
    """The student's own text, which nobody but the instructor scores."""

    needs_key: ClassVar[bool] = True
    by_hand: ClassVar[bool] = True

    def score(self, evidence: Evidence) -> Scored:
        """Nothing, until the instructor says it."""
        if not evidence.results.student.notes.strip():
            return 0.0, "Your report has no text of your own; write one and add it with --notes."
        return 0.0, "Your instructor reads your text and gives points for it."


# ------------------------------------------------------------------ the filter


# Findings about stamps for which no single offset is right
CHANGING_CLOCK_FINDINGS = ("source_clock_changes", "source_stamps_of_arrival")
Sigma = Literal["sigma_z_m", "sigma_a_m_s2"]
# How each noise is called, its unit, and its option
NOISE_SETTINGS: dict[Sigma, tuple[str, str, str]] = {
    "sigma_z_m": ("SIGMA_Z", "m", "--sigma-z"),
    "sigma_a_m_s2": ("SIGMA_A", "m/s²", "--sigma-a"),
}


class TuningItem(RubricItem, frozen=True, kw_only=True, tag="tuning"):
    """A chosen noise is what the data ask for; none of the points from ``factor`` off."""

    setting: Sigma
    factor: Factor = 2.0

    def score(self, evidence: Evidence) -> Scored:
        """1 in the interval, falling to 0 at ``factor`` from its end."""
        if evidence.comparison is None:
            return NO_COMPARISON
        return _score_tuning(evidence, evidence.comparison, self.setting, self.factor)


def _score_tuning(
    evidence: Evidence, comparison: ComparisonResults, name: Sigma, factor: float = 2.0
) -> Scored:
    label, unit, option = NOISE_SETTINGS[name]
    chosen_value: float = getattr(comparison.settings, name)
    tuned = comparison.tuning.get(HORIZONTAL)
    interval = getattr(tuned, f"{TUNED_FIELDS[name]}_interval", None)
    if interval is None or interval[1] is None:
        why = evidence.missing_reason(f"tuning.{HORIZONTAL}")
        return 0.0, f"Your report has no interval for {label}{why}."
    low, high = interval
    if name == "sigma_z_m" and evidence.has_finding("source_may_drift"):
        # small innovations do not make a drifting source trustworthy: up to its error is right
        high = max(high, _error_m(comparison))
    factor_off = max(chosen_value / high if high > 0.0 else math.inf, low / chosen_value, 1.0)
    side = "within" if factor_off == 1.0 else "above" if chosen_value > high else "below"
    statement = f"Your {label} {chosen_value:.3g} {unit} is {side} what the data ask for"
    advice = f", by a factor of {format_factor(factor_off)}: try a value between with {option}"
    ml_interval_text = f"({low:.3g} to {high:.3g} {unit})"
    return falling_share(
        factor_off, factor
    ), f"{statement} {ml_interval_text}{advice * (factor_off != 1.0)}."


def _error_m(comparison: ComparisonResults) -> float:
    """How wrong a source that drifts is, as far as a loop or the truth tells; 0 where neither."""
    truths = [axis.filters["kf"].truth for axis in comparison.axes.values()]
    errors_m = [truth.position_rmse_m for truth in truths if isinstance(truth, AgainstTruth)]
    if isinstance(comparison.loop, LoopResult):
        errors_m.append(comparison.loop.closure_error_m or 0.0)
    return max(errors_m, default=0.0)


class ConsistencyItem(RubricItem, frozen=True, kw_only=True, tag="consistent"):
    """The filter is consistent, or no setting makes it so; no points from ``factor`` in σ on."""

    factor: Factor = SIGMA_FACTOR_FINDING

    def score(self, evidence: Evidence) -> Scored:
        """By the verdict on both horizontal axes together."""
        comparison = evidence.comparison
        if comparison is None:
            return NO_COMPARISON
        nis_result = comparison.horizontal.get("kf")
        if not isinstance(nis_result, HorizontalNis):
            why = evidence.missing_reason(f"{HORIZONTAL}.kf")
            return 0.0, f"There is no verdict on your filter{why}."
        if nis_result.verdict == "consistent":
            return 1.0, "Your filter is consistent."
        statement = f"{capitalise_first(nis_result.verdict)} {format_factor(nis_result.sigma_error_factor)} times in σ"
        if all(_score_tuning(evidence, comparison, name)[0] == 1.0 for name in NOISE_SETTINGS):
            return 1.0, (
                f"{statement}, with the noises that the data ask for: what is left no setting fixes."
            )
        return falling_share(nis_result.sigma_error_factor, self.factor), (
            f"{statement}: look at what the tuning page asks for, and for what the model does not "
            "explain."
        )


class ClockItem(RubricItem, frozen=True, kw_only=True, tag="clock"):
    """The clock offset that was applied is what the data ask for.

    ``undeterminable`` is the share of the points where the flight does not tell; of a flight that
    was handed out, which the student did not choose, all of them.
    """

    margin_s: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.03
    undeterminable: Share = 0.5

    def score(self, evidence: Evidence) -> Scored:
        """All or nothing, ``undeterminable`` where the flight does not tell."""
        if evidence.comparison is None:
            return NO_COMPARISON
        clock = evidence.comparison.clock
        if not isinstance(clock, Clock) or not clock.determinable:
            share = self.undeterminable if isinstance(clock, Clock) else 0.0
            why = in_brackets(clock.reason or "")
            statement = f"Your flight does not determine the clock offset{why}."
            return 1.0 if evidence.answer is not None else share, statement
        (low, high), applied = clock.interval_s, clock.applied_s
        statement = f"You applied a clock offset of {applied:.3f} s"
        if low - self.margin_s <= applied <= high + self.margin_s:
            return 1.0, f"{statement}, which is what the data ask for ({low:.3f} to {high:.3f} s)."
        if any(map(evidence.has_finding, CHANGING_CLOCK_FINDINGS)):
            statement = "The offset of the position stamps changes in your flight"
            known = evidence.names_mistake("clock-jump", "clock-drift")
            advice = ", as your form says" if known else "; say in your form from when on it holds"
            return 1.0 if known else self.undeterminable, f"{statement}{advice}."
        return (
            0.0,
            f"{statement} where the data ask for {low:.3f} to {high:.3f} s: --clock-offset auto.",
        )


# ------------------------------------------------------------------ a loop


# Distance of landing and take-off up to which a loop is closed (m): the accuracy of a tape
CLOSED_M = 0.5
# Share of the last quarter for a corrected path without a reference, which has no ATE
NO_REFERENCE_SHARE = 0.5


class LoopItem(RubricItem, frozen=True, kw_only=True, tag="loop"):
    """Quarters: closure error measured, closure accepted, path corrected, ATE reduced.

    A flight that by the answer key ended elsewhere has all of them for a path without an accepted
    closure.
    """

    def score(self, evidence: Evidence) -> Scored:
        """Return the quarters, and a sentence with closure error and ATE."""
        loop = evidence.results.loop
        accepted = isinstance(loop, LoopResult) and any(one.accepted for one in loop.closures)
        landed_m = evidence.answer.truth.get("closure_error_m") if evidence.answer else None
        if landed_m is not None and landed_m > CLOSED_M and not accepted:
            landed = format_length(landed_m)
            return 1.0, f"Your vehicle landed {landed} from the take-off: the path stays as it is."
        if not isinstance(loop, LoopResult) or loop.closure_error_m is None:
            missing = loop.known_end if isinstance(loop, LoopResult) else loop
            why = in_brackets(getattr(missing, "reason", ""))
            return 0.0, f"Your report measures no loop{why}."
        if loop.absolute:
            return 0.0, "Your loop is on a track that does not drift; measure it on odometry."
        error_text, path = format_length(loop.closure_error_m), format_length(loop.path_length_m)
        statement = f"You measured a closure error of {error_text} in {path}"
        if not accepted:
            return 0.25, f"{statement}; no closure was accepted."
        corrected, comment = _score_corrections(loop.corrections)
        return (2.0 + corrected) / 4.0, f"{statement}; the closure was accepted{comment}"


def _score_corrections(corrections: Mapping[Way, OrUnavailable[Correction]]) -> Scored:
    """One for a corrected path and one for an ATE below the uncorrected one."""
    ways: tuple[Way, ...] = ("by_distance_plain", "by_distance", "pose_graph_gated")
    corrected_paths = [one for one in map(corrections.get, ways) if isinstance(one, Correction)]
    if not corrected_paths:
        return 0.0, ", but the path is not corrected."
    before = _ate_by_reference(corrections.get("uncorrected"))
    pairs = [
        (before[name], after_m)
        for one in corrected_paths
        for name, after_m in _ate_by_reference(one).items()
        if before.get(name)
    ]
    if not pairs:
        return 1.0 + NO_REFERENCE_SHARE, (
            ", and corrected the path, but not against a reference: with --reference its error "
            "would show."
        )
    before_m, after_m = min(pairs, key=lambda pair: pair[1] / pair[0])
    changed = f", and corrected the path, whose ATE went from {before_m:.3g} m to {after_m:.3g} m"
    if after_m < before_m:
        return 2.0, f"{changed}."
    return 1.0, f"{changed}: explain why the correction makes it worse."


def _ate_by_reference(correction: object) -> dict[str, float]:
    """ATE (m) of a correction by the reference that it was scored against."""
    scores = correction.scores if isinstance(correction, Correction) else {}
    return {
        name: one.ate.translation_m.rmse for name, one in scores.items() if isinstance(one, Score)
    }
