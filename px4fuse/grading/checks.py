"""Checks of a rubric: each check is a class of items; its fields are the parameters.

A check scores the :class:`Evidence` of a report. ``rubric.toml`` describes each check: the report
(verified, numbers, form, text), the filter (settings, consistency, time offset) and the loop.
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

from px4fuse.answer_form import Answers, check
from px4fuse.assignment.key import Answer, AnswerKey
from px4fuse.comparison.model import AgainstTruth
from px4fuse.filter.consistency import HorizontalNis
from px4fuse.filter.time_offset import Clock
from px4fuse.filter.tuning import HORIZONTAL
from px4fuse.grading.form_points import FormPoints, form_points
from px4fuse.loop.model import Correction, CorrectionName, LoopResult
from px4fuse.record import OrUnavailable, Share
from px4fuse.results.contract import (
    TUNED_FIELDS,
    ComparisonResults,
    LoopResults,
    Reported,
    to_plain,
)
from px4fuse.results.reading import one_line
from px4fuse.text import capitalise_first, format_factor, format_length
from px4fuse.trajectory.evaluation import Score
from px4fuse.verification.model import Verdict
from px4fuse.verification.verification import flatten, is_number, log_sha256

MAX_QUOTE = 160
NEEDS_BOTH_AXES = " (it needs the axes north and east: leave --axis out)"
# regular expression: no control characters
_PLAIN = r"[^\x00-\x1f\x7f]"
Text = Annotated[str, Meta(max_length=200, pattern=rf"^{_PLAIN}*$")]
Title = Annotated[str, Meta(max_length=200, pattern=rf"^{_PLAIN}*[^\s\x00-\x1f\x7f]{_PLAIN}*$")]
Bound = Annotated[float, Meta(ge=-1e12, le=1e12)]
Factor = Annotated[float, Meta(ge=1.0, le=1000.0)]
# share of the points (0 to 1), and its reason
Scored = tuple[float, str]


class RubricItem(
    msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="check"
):
    """Part of the grade; subclasses implement the checks.

    Attributes
    ----------
    points : float
        Maximum points.
    report : {"any", "compare", "loop"}
        Command whose reports have this item.
    needs_key, by_hand : bool
        The item needs an answer key; the item is scored by the instructor.
    """

    needs_key: ClassVar[bool] = False
    by_hand: ClassVar[bool] = False

    title: Title
    points: Annotated[float, Meta(ge=0.0, le=1000.0)]
    report: Literal["any", "compare", "loop"] = "any"

    def score(self, evidence: Evidence) -> Scored:
        """Return the share of the points (0 to 1), and a sentence with the reason."""
        raise NotImplementedError

    def applies(self, kind: str, key: AnswerKey | None) -> bool:
        """Return True if reports of this command have the item."""
        return self.report in ("any", kind) and (key is not None or not self.needs_key)


def falling_share(off: float, factor: float) -> float:
    """Return the share for a deviation by a factor: 1 at 1, 0 from ``factor``, log scale.

    >>> [round(falling_share(off, 4.0), 2) for off in (1.0, 2.0, 4.0, 9.0)]
    [1.0, 0.5, 0.0, 0.0]
    """
    if off <= 1.0:
        return 1.0
    return max(1.0 - math.log(off) / math.log(factor), 0.0) if factor > 1.0 else 0.0


@dataclass(frozen=True)
class Evidence:
    """Data for the checks: results of a report, verification verdict, and answer key.

    ``owner_id`` is the student id according to the learning platform.
    """

    results: Reported
    verdict: Verdict
    key: AnswerKey | None
    owner_id: str = ""

    @property
    def comparison(self) -> ComparisonResults | None:
        """Results of compare; None for a loop report."""
        return None if isinstance(self.results, LoopResults) else self.results

    @cached_property
    def values(self) -> dict[str, Any]:
        """Values of the results, by path (keys joined by dots)."""
        return dict(flatten(to_plain(self.results)))

    @cached_property
    def answer(self) -> Answer | None:
        """Answer for the log of the report; None if the log is not in the answer key."""
        return None if self.key is None else self.key.of_log(log_sha256(self.results))

    @cached_property
    def assigned_answer(self) -> Answer | None:
        """Answer for the student, by the id of the platform, else of the report."""
        if self.key is None:
            return None
        claimed = self.key.of_student(text_of(self.results.student.id))
        return self.key.of_student(self.owner_id) or claimed

    @cached_property
    def is_own_log(self) -> bool:
        """True if the log was given to this student, or without an answer key."""
        assigned_answer = self.assigned_answer
        return self.key is None or (
            assigned_answer is not None and assigned_answer.sha256 == log_sha256(self.results)
        )

    @cached_property
    def form(self) -> Answers | str:
        """Form about this log, or the reason why it is missing."""
        answers = self.results.student.answers
        if not isinstance(answers, Answers):
            return "your report contains no form: make the report with --answers answers.toml"
        try:
            check(answers)
        except ValueError as error:
            return f"your form cannot be read ({text_of(str(error))})"
        if answers.log_sha256 != log_sha256(self.results):
            return "your form was made for another log"
        return answers

    @cached_property
    def form_points(self) -> FormPoints | str:
        """Points of the form, or the reason why it has none."""
        if self.answer is None or (self.assigned_answer and not self.is_own_log):
            assigned_answer = (
                f" ({text_of(self.assigned_answer.file)})" if self.assigned_answer else ""
            )
            return (
                f"this report is not about the log that you were given{assigned_answer}; make a "
                "report of that log, with your --id"
            )
        if isinstance(self.form, str):
            return self.form
        answer_key_form = self.answer.form
        return (
            "the answer key contains no answers to the form"
            if answer_key_form is None
            else form_points(self.form, answer_key_form)
        )

    def names_mistake(self, *kinds: str) -> bool:
        """Return True if the form names one of these kinds of mistakes."""
        form = self.form
        return isinstance(form, Answers) and any(one.kind in kinds for one in form.mistakes)

    def has_finding(self, finding: str) -> bool:
        """Return True if the report contains a finding with this id."""
        return any(one.id == finding for one in self.results.findings)

    def missing_reason(self, path: str) -> str:
        """Format the reason for a missing value in brackets, if the results state it."""
        steps = path.split(".")
        for end in range(len(steps), 0, -1):
            for _, reason in values_at(self.values, ".".join((*steps[:end], "reason"))):
                return in_brackets(reason)
        return NEEDS_BOTH_AXES if HORIZONTAL in path else ""


def values_at(values: Mapping[str, Any], path: str) -> list[tuple[str, Any]]:
    """Return paths and values that match a path; ``*`` is any key, quotes enclose dots.

    >>> values_at({"a.b.c.0": 1, "a.b.c.d.0": 2}, 'a."b.c".*')
    [('a.b.c.0', 1)]
    """
    pattern = re.compile(re.escape(path.replace('"', "")).replace(r"\*", "[^.]*"))
    return [(name, value) for name, value in values.items() if pattern.fullmatch(name)]


def text_of(value: str) -> str:
    """Format a text on one line, without control characters, at most MAX_QUOTE characters."""
    return one_line(value, MAX_QUOTE)


def in_brackets(reason: str) -> str:
    """Format a reason in brackets, with a leading blank; "" without a reason."""
    text = text_of(reason).rstrip(".")
    return f" ({text})" if text else ""


# ------------------------------------------------------------------ the report


NO_COMPARISON: Scored = (0.0, "Your report is not a compare report.")


class VerifiedItem(RubricItem, frozen=True, kw_only=True, tag="verified"):
    """Check that the numbers agree with a new run of the analysis on the log."""

    def score(self, evidence: Evidence) -> Scored:
        """Return 1 for a verified report, else 0."""
        verdict = evidence.verdict
        why = in_brackets("".join(verdict.reasons[:1]))
        return float(verdict.status == "verified"), f"Verification: {verdict.status}{why}."


class NumberItem(RubricItem, frozen=True, kw_only=True, tag="number"):
    """Check that a number is within bounds; of several numbers on ``path`` the worst counts.

    Points decrease to zero at ``zero_at``; without ``zero_at`` there are none out of bounds.
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
            raise ValueError(
                "give at_least, at_most or both (at_least <= at_most), and zero_at outside of them"
            )

    def _width(self) -> float:
        """Return the distance from a bound to ``zero_at``."""
        zero = self.zero_at
        return 0.0 if zero is None else max(self.at_least - zero, zero - self.at_most)

    def _share(self, number: float) -> float:
        excess = max(self.at_least - number, number - self.at_most, 0.0)
        if excess == 0.0:
            return 1.0
        return max(1.0 - excess / self._width(), 0.0) if self._width() > 0.0 else 0.0

    def score(self, evidence: Evidence) -> Scored:
        """Return 1 within the bounds, decreasing to 0 at ``zero_at``."""
        values = values_at(evidence.values, self.path)
        values_by_path = {name: float(value) for name, value in values if is_number(value)}
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
        return share, f"{statement}; required: {' and '.join(limits)}.{advice}"


class AnswersItem(RubricItem, frozen=True, kw_only=True, tag="answers"):
    """Check the form about the flight against the answer key."""

    needs_key: ClassVar[bool] = True

    def score(self, evidence: Evidence) -> Scored:
        """Return the share of the points of :mod:`px4fuse.grading.form_points`."""
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
            f"Points of 100: {', '.join(points_by_part)}. "
            f"{capitalise_first('; '.join(form_result.feedback))}.",
        )


class TextItem(RubricItem, frozen=True, kw_only=True, tag="text"):
    """Text of the student, scored by the instructor."""

    needs_key: ClassVar[bool] = True
    by_hand: ClassVar[bool] = True

    def score(self, evidence: Evidence) -> Scored:
        """Return 0, until the instructor gives points."""
        if not evidence.results.student.notes.strip():
            return 0.0, "Your report has no text. Write a text and add it with --notes."
        return 0.0, "Your instructor reads your text and gives points for it."


# ------------------------------------------------------------------ the filter


# findings on timestamps that no constant offset corrects
CHANGING_CLOCK_FINDINGS = ("source_time_offset_changes", "source_timestamps_are_arrival_times")
Sigma = Literal["sigma_z_m", "sigma_a_m_s2"]
# name in messages, unit and option of each noise
NOISE_SETTINGS: dict[Sigma, tuple[str, str, str]] = {
    "sigma_z_m": ("SIGMA_Z", "m", "--sigma-z"),
    "sigma_a_m_s2": ("SIGMA_A", "m/s²", "--sigma-a"),
}


class TuningItem(RubricItem, frozen=True, kw_only=True, tag="tuning"):
    """Check that a noise fits its maximum-likelihood estimate; zero points from ``factor``."""

    setting: Sigma
    factor: Factor = 2.0

    def score(self, evidence: Evidence) -> Scored:
        """Return 1 within the 95 % interval, decreasing to 0 at ``factor`` from its end."""
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
        return 0.0, f"Your report has no 95 % interval for {label}{why}."
    low, high = interval
    if name == "sigma_z_m" and evidence.has_finding("source_may_drift"):
        # innovations do not show the error of a drifting source: values up to this error are right
        high = max(high, _error_m(comparison))
    factor_off = max(chosen_value / high if high > 0.0 else math.inf, low / chosen_value, 1.0)
    side = "within" if factor_off == 1.0 else "above" if chosen_value > high else "below"
    statement = (
        f"Your {label} {chosen_value:.3g} {unit} is {side} the 95 % interval of the "
        f"maximum-likelihood estimate ({low:.3g} to {high:.3g} {unit})"
    )
    if factor_off != 1.0:
        statement += (
            f" by a factor of {format_factor(factor_off)}. Set {option} within this interval"
        )
    return falling_share(factor_off, factor), f"{statement}."


def _error_m(comparison: ComparisonResults) -> float:
    """Return the largest known error (m) of the source, by ground truth or loop; else 0."""
    truths = [axis.filters["kf"].truth for axis in comparison.axes.values()]
    errors_m = [truth.position_rmse_m for truth in truths if isinstance(truth, AgainstTruth)]
    if isinstance(comparison.loop, LoopResult):
        errors_m.append(comparison.loop.closure_error_m or 0.0)
    return max(errors_m, default=0.0)


class ConsistencyItem(RubricItem, frozen=True, kw_only=True, tag="consistent"):
    """Check that KF is consistent, or that no setting makes it so; zero from ``factor`` in σ."""

    factor: Factor = 2.0

    def score(self, evidence: Evidence) -> Scored:
        """Score the NIS verdict on north and east together."""
        comparison = evidence.comparison
        if comparison is None:
            return NO_COMPARISON
        nis_result = comparison.horizontal.get("kf")
        if not isinstance(nis_result, HorizontalNis):
            why = evidence.missing_reason(f"{HORIZONTAL}.kf")
            return 0.0, f"Your report has no verdict on KF{why}."
        if nis_result.verdict == "consistent":
            return 1.0, "KF is consistent."
        side = "small" if nis_result.nis_mean > 1.0 else "large"
        factor_text = format_factor(nis_result.sigma_error_factor)
        statement = f"The reported σ of KF is {factor_text} times too {side}"
        if all(_score_tuning(evidence, comparison, name)[0] == 1.0 for name in NOISE_SETTINGS):
            return 1.0, (
                f"{statement}, although both noises fit the data: no setting corrects the rest."
            )
        return falling_share(nis_result.sigma_error_factor, self.factor), (
            f"{statement}. Compare your noises with the tuning page, and look for errors that the "
            "noise model does not contain."
        )


class ClockItem(RubricItem, frozen=True, kw_only=True, tag="clock"):
    """Check that the applied time offset agrees with the estimated one.

    ``undeterminable``: share of the points if the flight does not determine the offset. For a
    handed-out log, which the student did not choose, all points are given.
    """

    margin_s: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.03
    undeterminable: Share = 0.5

    def score(self, evidence: Evidence) -> Scored:
        """Return 1 or 0; ``undeterminable`` if the offset cannot be estimated."""
        if evidence.comparison is None:
            return NO_COMPARISON
        clock = evidence.comparison.clock
        if not isinstance(clock, Clock) or not clock.is_determinable:
            share = self.undeterminable if isinstance(clock, Clock) else 0.0
            why = in_brackets(clock.reason or "")
            statement = f"The time offset cannot be estimated from your flight{why}."
            return 1.0 if evidence.answer is not None else share, statement
        (low, high), applied = clock.interval_s, clock.applied_s
        statement = f"You applied a time offset of {applied:.3f} s"
        if low - self.margin_s <= applied <= high + self.margin_s:
            return 1.0, f"{statement}; the estimate is {low:.3f} to {high:.3f} s (95 %)."
        if any(map(evidence.has_finding, CHANGING_CLOCK_FINDINGS)):
            statement = "The time offset changes in your flight"
            known = evidence.names_mistake("clock-jump", "clock-drift")
            advice = ", as your form states" if known else "; state its time in your form"
            return 1.0 if known else self.undeterminable, f"{statement}{advice}."
        return (
            0.0,
            f"{statement}, but the estimate is {low:.3f} to {high:.3f} s (95 %). "
            "Use --clock-offset auto.",
        )


# ------------------------------------------------------------------ a loop


# m; distance of landing and take-off up to which a loop is closed (accuracy of a measuring tape)
CLOSED_M = 0.5
# share of the last quarter for a corrected path without a reference (no ATE)
NO_REFERENCE_SHARE = 0.5


class LoopItem(RubricItem, frozen=True, kw_only=True, tag="loop"):
    """Check a loop; a quarter each: error measured, closure accepted, path corrected, ATE reduced.

    If the vehicle landed elsewhere (answer key), a path without an accepted closure has all points.
    """

    def score(self, evidence: Evidence) -> Scored:
        """Return the share of the four quarters, and a sentence with closure error and ATE."""
        loop = evidence.results.loop
        accepted = isinstance(loop, LoopResult) and any(one.accepted for one in loop.closures)
        landed_m = evidence.answer.truth.get("closure_error_m") if evidence.answer else None
        if landed_m is not None and landed_m > CLOSED_M and not accepted:
            landed = format_length(landed_m)
            return 1.0, f"Your vehicle landed {landed} from take-off: no correction is right."
        if not isinstance(loop, LoopResult) or loop.closure_error_m is None:
            missing = loop.true_end if isinstance(loop, LoopResult) else loop
            why = in_brackets(getattr(missing, "reason", ""))
            return 0.0, f"Your report contains no loop closure error{why}."
        if loop.is_absolute_track:
            return 0.0, "The track of your loop does not drift. Measure the loop on odometry."
        error_text, path = format_length(loop.closure_error_m), format_length(loop.path_length_m)
        statement = f"You measured a loop closure error of {error_text} after {path}"
        if not accepted:
            return 0.25, f"{statement}; no closure was accepted."
        corrected, comment = _score_corrections(loop.corrections)
        return (2.0 + corrected) / 4.0, f"{statement}; the closure was accepted{comment}"


def _score_corrections(corrections: Mapping[CorrectionName, OrUnavailable[Correction]]) -> Scored:
    """Return 1 for a corrected path, plus 1 for an ATE below the uncorrected one."""
    ways: tuple[CorrectionName, ...] = ("by_distance_plain", "by_distance", "pose_graph_gated")
    corrected_paths = [one for one in map(corrections.get, ways) if isinstance(one, Correction)]
    if not corrected_paths:
        return 0.0, ", but the path was not corrected."
    before = _ate_by_reference(corrections.get("uncorrected"))
    pairs = [
        (before[name], after_m)
        for one in corrected_paths
        for name, after_m in _ate_by_reference(one).items()
        if before.get(name)
    ]
    if not pairs:
        return 1.0 + NO_REFERENCE_SHARE, (
            " and the path corrected. Without a reference its error is unknown; use --reference."
        )
    before_m, after_m = min(pairs, key=lambda pair: pair[1] / pair[0])
    changed = f" and the path corrected. Its ATE changed from {before_m:.3g} m to {after_m:.3g} m"
    if after_m < before_m:
        return 2.0, f"{changed}."
    return 1.0, f"{changed}. Explain why the correction increases the error."


def _ate_by_reference(correction: object) -> dict[str, float]:
    """Return the ATE (m) of a correction, by reference."""
    scores = correction.scores if isinstance(correction, Correction) else {}
    return {
        name: one.ate.translation_m.rmse for name, one in scores.items() if isinstance(one, Score)
    }
