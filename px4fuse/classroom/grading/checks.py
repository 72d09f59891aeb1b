"""Rubric checks that give points to a student's report."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal

from msgspec import Meta

from px4fuse.comparison.model import ErrorsAgainstTruth
from px4fuse.core.record import Record, Share
from px4fuse.core.text import capitalise_first_letter, format_factor, format_metres, shorten_to_line
from px4fuse.filter.consistency import HorizontalNis
from px4fuse.filter.time_offset import SourceTimeOffset
from px4fuse.filter.tuning import HORIZONTAL, AxisTuning
from px4fuse.loop.model import CorrectionName, Loop, PathResult
from px4fuse.results.answer_form import Answers, check_answers
from px4fuse.results.contract import ComparisonResults, ReportedResults, to_json_dict
from px4fuse.verification.model import Verification
from px4fuse.verification.verification import flatten, is_number, log_sha256

from ..assignment.key import AnswerKey, CorrectAnswers
from .form_points import FormPoints, compute_form_points

MAX_QUOTE_LENGTH = 160
FORM_MISMATCH_REASON = "your answer form and your report are about different logs"
BOTH_AXES_ADVICE = "Make the report without --axis: the axes north and east are required"
# Text without control characters; a title is not blank
OneLineText = Annotated[str, Meta(max_length=200, pattern=r"^[^\x00-\x1f\x7f]*$")]
Title = Annotated[str, Meta(max_length=200, pattern=r"^(?=.*\S)[^\x00-\x1f\x7f]*$")]
Bound = Annotated[float, Meta(ge=-1e12, le=1e12)]
ErrorFactorAtZeroScore = Annotated[float, Meta(ge=1.0, le=1000.0)]
# Fraction of the maximum points (0 to 1), and reason for the student
ScoreAndReason = tuple[float, str]


class RubricItem(Record, kw_only=True, tag_field="check"):
    """Item of the rubric, the instructor's list of checks.

    Attributes
    ----------
    points : float
        Maximum points.
    report : {"any", "compare", "loop"}
        px4fuse command whose reports are scored; chosen by the instructor.
    command : {"any", "compare", "loop"}
        px4fuse command whose reports contain the data that the check needs; fixed for each type of
        check.
    """

    command: ClassVar[str] = "any"
    needs_answer_key: ClassVar[bool] = False
    is_scored_by_instructor: ClassVar[bool] = False

    title: Title
    points: Annotated[float, Meta(ge=0.0, le=1000.0)]
    report: Literal["any", "compare", "loop"] = "any"

    def score(self, scoring_input: ScoringInput) -> ScoreAndReason:
        """Return the fraction of the maximum points (0 to 1), and the reason as sentences."""
        raise NotImplementedError

    def is_applicable(self, command_name: str, key: AnswerKey | None) -> bool:
        """Return True if this rubric item can score the reports of a px4fuse command.

        An item with ``needs_answer_key`` can score reports only if ``key`` is given.
        """
        has_required_key = key is not None or not self.needs_answer_key
        return has_required_key and {self.report, self.command} <= {"any", command_name}


def compute_points_fraction(deviation_factor: float, factor_at_zero_score: float) -> float:
    """Return the fraction of the maximum points for a value that is too large or small by a factor.

    The fraction decreases with the logarithm of ``deviation_factor``, from 1 for the right value
    (factor 1) to 0 at ``factor_at_zero_score``.

    >>> [round(compute_points_fraction(deviation, 4.0), 2) for deviation in (1.0, 2.0, 4.0, 9.0)]
    [1.0, 0.5, 0.0, 0.0]
    """
    if deviation_factor <= 1.0:
        return 1.0
    if deviation_factor >= factor_at_zero_score:
        return 0.0
    return 1.0 - math.log(deviation_factor) / math.log(factor_at_zero_score)


@dataclass(frozen=True)
class ScoringInput:
    """Input of the checks: results and verification of one report, and answer key.

    ``submitter_id`` is the student id on the learning platform.
    """

    results: ReportedResults
    verification: Verification
    key: AnswerKey | None
    submitter_id: str = ""

    @property
    def comparison(self) -> ComparisonResults:
        assert isinstance(self.results, ComparisonResults)
        return self.results

    @cached_property
    def values(self) -> dict[str, Any]:
        """Numbers and texts in the results by path, for example ``settings.sigma_z_m``."""
        return dict(flatten(to_json_dict(self.results)))

    @cached_property
    def right_answers(self) -> CorrectAnswers | None:
        """Right answers for the log of the report; None if the log is not in the answer key."""
        return self.key.find_answers_by_log_sha256(log_sha256(self.results)) if self.key else None

    @cached_property
    def right_answers_for_assigned_log(self) -> CorrectAnswers | None:
        """Right answers for the log that the instructor gave to the student."""
        if self.key is None:
            return None
        return self.key.find_right_answers_of_student(
            self.submitter_id
        ) or self.key.find_right_answers_of_student(shorten_text(self.results.student.id))

    @cached_property
    def is_own_log(self) -> bool:
        """True if the report is about the log that the instructor gave to the student."""
        assigned = self.right_answers_for_assigned_log
        return self.key is None or (
            assigned is not None and assigned.sha256 == log_sha256(self.results)
        )

    @cached_property
    def form(self) -> Answers | str:
        """Answers of the student, or the reason why they are missing."""
        answers = self.results.student.answers
        if not isinstance(answers, Answers):
            return "your report contains no answer form. Make the report with --answers FILE"
        try:
            check_answers(answers)
        except ValueError as error:
            return f"your answer form cannot be read ({shorten_text(str(error))})"
        return FORM_MISMATCH_REASON if self.has_form_of_other_log else answers

    @property
    def has_form_of_other_log(self) -> bool:
        """True if the answer form in the report was made for another log."""
        answers = self.results.student.answers
        return isinstance(answers, Answers) and answers.log_sha256 != log_sha256(self.results)

    @cached_property
    def form_points(self) -> FormPoints | str:
        """Points for the student's answers, or the reason for no points."""
        assigned = self.right_answers_for_assigned_log
        # a student who is not in the answer key may use the log of any student
        if self.right_answers is None or (
            assigned is not None and assigned.sha256 != self.right_answers.sha256
        ):
            assigned_log_text = format_reason(assigned.file if assigned else "")
            return (
                f"this report is not about the log that you were given{assigned_log_text}. Make a "
                "report of that log, with your --id"
            )
        if isinstance(self.form, str):
            return self.form
        if self.right_answers.form is None:
            return "the answer key contains no right answers for this log"
        return compute_form_points(self.form, self.right_answers.form)

    def has_finding(self, *ids: str) -> bool:
        return any(finding.id in ids for finding in self.results.findings)

    def find_missing_reason(self, path: str) -> str:
        """Return the reason for a missing value at ``path``, in brackets; "" if unknown.

        The results contain a field "reason" in place of missing data: at this path, or at one of
        its parents.
        """
        parent_path = path
        while parent_path:
            for _, reason in find_values(self.values, f"{parent_path}.reason"):
                return format_reason(reason)
            parent_path = parent_path.rpartition(".")[0]
        return format_reason(BOTH_AXES_ADVICE) if HORIZONTAL in path else ""


def find_values(values: Mapping[str, Any], path_pattern: str) -> list[tuple[str, Any]]:
    """Return (path, value) of all values whose path matches a pattern.

    In the pattern, ``*`` matches any key, and quotes enclose a key that contains dots.

    >>> find_values({"a.b.c.0": 1, "a.b.c.d.0": 2}, 'a."b.c".*')
    [('a.b.c.0', 1)]
    """
    regex = re.compile(re.escape(path_pattern.replace('"', "")).replace(r"\*", "[^.]*"))
    return [(path, value) for path, value in values.items() if regex.fullmatch(path)]


def shorten_text(value: str) -> str:
    return shorten_to_line(value, MAX_QUOTE_LENGTH)


def format_reason(reason: str) -> str:
    """Format a reason in brackets with a leading blank; "" without a reason."""
    text = shorten_text(reason).rstrip(".")
    return f" ({text})" if text else ""


# ------------------------------------------------------------------ checks of any report


class VerificationItem(RubricItem, tag="verified"):
    """Check that a re-run of the analysis on the log reproduces the numbers of the report."""

    def score(self, scoring_input: ScoringInput) -> ScoreAndReason:
        verification = scoring_input.verification
        reason_text = format_reason("".join(verification.reasons[:1]))
        return float(
            verification.status == "verified"
        ), f"Verification: {verification.status}{reason_text}."


class NumberItem(RubricItem, tag="number"):
    """Check that a number of the report is between ``at_least`` and ``at_most``.

    Outside these bounds, the points decrease linearly to zero at the value ``zero_at``.
    """

    path: OneLineText
    name: OneLineText = ""
    unit: OneLineText = ""
    at_least: Bound = -math.inf
    at_most: Bound = math.inf
    zero_at: Bound | None = None
    advice: OneLineText = ""

    def __post_init__(self) -> None:
        is_bounded = math.isfinite(self.at_least) or math.isfinite(self.at_most)
        is_zero_at_in_bounds = self.zero_at is not None and self._compute_excess(self.zero_at) < 0
        if not is_bounded or self.at_least > self.at_most or is_zero_at_in_bounds:
            raise ValueError(
                "give at_least, at_most or both (at_least <= at_most); zero_at must be outside"
            )

    def _compute_excess(self, number: float) -> float:
        """Return the distance of a number from the nearer bound of this item.

        It is negative within the bounds.
        """
        return max(self.at_least - number, number - self.at_most)

    def _score_number(self, number: float) -> float:
        """Return 1 within the bounds, and 0 from ``zero_at`` on; linear in between."""
        excess = self._compute_excess(number)
        if excess <= 0.0:
            return 1.0
        excess_at_zero_score = 0.0 if self.zero_at is None else self._compute_excess(self.zero_at)
        return 0.0 if excess >= excess_at_zero_score else 1.0 - excess / excess_at_zero_score

    def score(self, scoring_input: ScoringInput) -> ScoreAndReason:
        """Score the worst of all numbers that ``path`` matches."""
        values = find_values(scoring_input.values, self.path)
        numbers = [
            (self._score_number(value), value, path) for path, value in values if is_number(value)
        ]
        if not numbers:
            label = self.name or f"the number {self.path}"
            reason_text = scoring_input.find_missing_reason(self.path)
            return 0.0, f"Your report does not contain {label}{reason_text}."
        points_fraction, number, path = min(numbers, key=lambda each: each[0])
        label = self.name or f"the number {shorten_text(path)}"
        bounds = (("at least", self.at_least), ("at most", self.at_most))
        limit_texts = [f"{word} {bound:.4g}" for word, bound in bounds if math.isfinite(bound)]
        statement = f"{capitalise_first_letter(label)} is {f'{number:.4g} {self.unit}'.strip()}"
        advice = f" {self.advice}" if points_fraction < 1.0 and self.advice else ""
        return points_fraction, f"{statement}; required: {' and '.join(limit_texts)}.{advice}"


class AnswersItem(RubricItem, tag="answers"):
    """Compare the student's answers with the answer key."""

    needs_answer_key: ClassVar[bool] = True

    def score(self, scoring_input: ScoringInput) -> ScoreAndReason:
        """Score the answer form: the sum of the points of its parts."""
        points_or_reason = scoring_input.form_points
        if isinstance(points_or_reason, str):
            return 0.0, f"{capitalise_first_letter(points_or_reason)}."
        points_text = ", ".join(
            f"{part.title} {part.points:.3g} of {part.max_points:g}"
            for part in points_or_reason.parts
        )
        feedback = capitalise_first_letter("; ".join(points_or_reason.feedback))
        return points_or_reason.fraction, f"Points of 100: {points_text}. {feedback}."


class TextItem(RubricItem, tag="text"):
    """Let the instructor score the student's text about the flight (option ``--notes``)."""

    needs_answer_key: ClassVar[bool] = True
    is_scored_by_instructor: ClassVar[bool] = True

    def score(self, scoring_input: ScoringInput) -> ScoreAndReason:
        if not scoring_input.results.student.notes.strip():
            return 0.0, "Your report has no text. Write a text and add it with --notes."
        return 0.0, "Your instructor reads your text and gives points for it."


# ------------------------------------------------------------------ checks of the settings of KF


# Finding ids that report a change of the time offset during the flight
CHANGING_CLOCK_FINDINGS = ("source_time_offset_changes", "source_timestamps_are_arrival_times")
NoiseSettingName = Literal["sigma_z_m", "sigma_a_m_s2"]
# Name, unit and command-line option of the measurement noise and the process noise of KF
NOISE_SETTINGS: dict[NoiseSettingName, tuple[str, str, str]] = {
    "sigma_z_m": ("SIGMA_Z", "m", "--sigma-z"),
    "sigma_a_m_s2": ("SIGMA_A", "m/s²", "--sigma-a"),
}


class TuningItem(RubricItem, tag="tuning", rename={"factor_at_zero_score": "factor"}):
    """Check that SIGMA_A or SIGMA_Z is within the 95 % interval of its estimate.

    Outside the interval, the points decrease to zero at a deviation of ``factor_at_zero_score``.
    """

    command: ClassVar[str] = "compare"

    setting: NoiseSettingName
    factor_at_zero_score: ErrorFactorAtZeroScore = 2.0

    def score(self, scoring_input: ScoringInput) -> ScoreAndReason:
        """Score the chosen SIGMA_A or SIGMA_Z: full points in the 95 % interval of the estimate."""
        comparison = scoring_input.comparison
        label, unit, option = NOISE_SETTINGS[self.setting]
        chosen_value: float = getattr(comparison.settings, self.setting)
        interval, tuning = None, comparison.tuning.get(HORIZONTAL)
        if isinstance(tuning, AxisTuning):
            interval = tuning.sigma_z_m_interval
            if self.setting == "sigma_a_m_s2":
                interval = tuning.sigma_a_two_state_m_s2_interval
        lower_bound, upper_bound = interval or (0.0, None)
        if upper_bound is None:  # no estimate, or the data do not limit the noise
            reason_text = scoring_input.find_missing_reason(f"tuning.{HORIZONTAL}")
            return 0.0, f"Your report has no 95 % interval for {label}{reason_text}."
        if self.setting == "sigma_z_m" and scoring_input.has_finding(
            "source_may_drift", "source_drift"
        ):
            # If the source drifts, SIGMA_Z may be as large as the position error: the estimate of
            # SIGMA_Z is from innovations, which do not contain the drift
            upper_bound = max(upper_bound, _find_max_position_error_m(comparison))
        # setting ÷ upper limit or lower limit ÷ setting, at least 1: larger than 1 only outside the
        # interval
        deviation_factor = max(
            chosen_value / upper_bound if upper_bound > 0.0 else math.inf,
            lower_bound / chosen_value,
            1.0,
        )
        deviation_text, advice = "within", ""
        if deviation_factor > 1.0:
            side = "above" if chosen_value > upper_bound else "below"
            deviation_text = f"a factor of {format_factor(deviation_factor)} {side}"
            advice = f" Set {option} to a value in this interval."
        return compute_points_fraction(deviation_factor, self.factor_at_zero_score), (
            f"Your {label} {chosen_value:.3g} {unit} is {deviation_text} the 95 % interval of the "
            f"maximum-likelihood estimate ({lower_bound:.3g} to {upper_bound:.3g} {unit}).{advice}"
        )


def _find_max_position_error_m(comparison: ComparisonResults) -> float:
    """Return the position RMSE of KF or the loop closure error (m), whichever is larger."""
    kf_errors = [axis.filters["kf"].truth for axis in comparison.axes.values()]
    errors_m = [
        errors.position_rmse_m for errors in kf_errors if isinstance(errors, ErrorsAgainstTruth)
    ]
    if isinstance(comparison.loop, Loop):
        errors_m.append(comparison.loop.closure_error_m or 0.0)
    return max(errors_m, default=0.0)


class ConsistencyItem(RubricItem, tag="consistent", rename={"factor_at_zero_score": "factor"}):
    """Check that KF is consistent, by the mean NIS of north and east together.

    The points decrease to zero if the reported σ is wrong by ``factor_at_zero_score``.
    """

    command: ClassVar[str] = "compare"

    factor_at_zero_score: ErrorFactorAtZeroScore = 2.0

    def score(self, scoring_input: ScoringInput) -> ScoreAndReason:
        """Score the consistency of KF in the horizontal plane."""
        nis_result = scoring_input.comparison.horizontal.get("kf")
        if not isinstance(nis_result, HorizontalNis):
            reason_text = scoring_input.find_missing_reason(f"{HORIZONTAL}.kf")
            return 0.0, f"Your report has no result on the consistency of KF{reason_text}."
        if nis_result.verdict == "consistent":
            return 1.0, "KF is consistent."
        direction = "small" if nis_result.nis_mean > 1.0 else "large"
        sigma_factor = nis_result.sigma_error_factor
        points_fraction = compute_points_fraction(sigma_factor, self.factor_at_zero_score)
        advice = (
            "Compare SIGMA_A and SIGMA_Z with the maximum-likelihood estimates, and look for "
            "errors that are not white noise."
        )
        tuning_items = [TuningItem(title="", points=0.0, setting=name) for name in NOISE_SETTINGS]
        if all(item.score(scoring_input)[0] == 1.0 for item in tuning_items):
            points_fraction = 1.0
            advice = (
                "SIGMA_A and SIGMA_Z agree with their estimates (95 % intervals). No change of "
                "SIGMA_A or SIGMA_Z makes KF consistent."
            )
        return points_fraction, (
            f"The reported σ of KF is {format_factor(sigma_factor)} times too {direction}. {advice}"
        )


class TimeOffsetItem(RubricItem, tag="clock"):
    """Check that the applied time offset of the position source agrees with the estimate.

    Attributes
    ----------
    margin_s : float
        Maximum distance (s) of the applied time offset from the 95 % interval of the estimate.
    undeterminable : float
        Fraction of the points if the time offset cannot be estimated or changes.
    """

    command: ClassVar[str] = "compare"

    margin_s: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.03
    undeterminable: Share = 0.5

    def score(self, scoring_input: ScoringInput) -> ScoreAndReason:
        """Score the time offset that the student applied."""
        clock = scoring_input.comparison.clock
        if not isinstance(clock, SourceTimeOffset) or not clock.is_determinable:
            reason_text = format_reason(clock.reason or "")
            statement = f"The time offset cannot be estimated from your flight{reason_text}."
            # The estimate of the time offset needs motion. Students cannot change the motion in an
            # assigned flight, so they get full points
            if scoring_input.right_answers is not None:
                return 1.0, statement
            # A flight that the student chose: no points without an estimate (for example no IMU
            # data), a part of the points for an uncertain estimate
            return self.undeterminable if isinstance(clock, SourceTimeOffset) else 0.0, statement
        (low, high), applied_offset_s = clock.interval_s, clock.applied_s
        statement = (
            f"Your time offset is {applied_offset_s:.3f} s. The estimated time offset is {low:.3f} "
            f"to {high:.3f} s (95 % interval)."
        )
        if low - self.margin_s <= applied_offset_s <= high + self.margin_s:
            return 1.0, statement
        if scoring_input.has_finding(*CHANGING_CLOCK_FINDINGS):
            faults = scoring_input.form.mistakes if isinstance(scoring_input.form, Answers) else ()
            if any(fault.kind in ("clock-jump", "clock-drift") for fault in faults):
                return 1.0, "The time offset changes during your flight, as your form states."
            return self.undeterminable, (
                "The time offset changes during your flight. State the time of the change in your "
                "answer form."
            )
        return 0.0, f"{statement} Use --clock-offset auto to apply the estimate."


# ------------------------------------------------------------------ check of a loop


# Maximum distance (m) between take-off and landing: with a larger distance, a loop closure is wrong
MAX_TRUE_CLOSURE_ERROR_M = 0.5
CORRECTED_PATH_NAMES: tuple[CorrectionName, ...] = (
    "by_distance_plain",
    "by_distance",
    "pose_graph_gated",
)


class LoopItem(RubricItem, tag="loop"):
    """Score the analysis of a loop.

    - 1/4 of the points if the report states the loop closure error.
    - 1/2 of the points if a loop closure was also accepted.
    - All points if the path was also corrected. If the vehicle did not land at the take-off
      position, all points if no loop closure was accepted.
    """

    def score(self, scoring_input: ScoringInput) -> ScoreAndReason:
        """Score the loop closure: measured (1/4), accepted (1/2), path corrected (full points)."""
        loop = scoring_input.results.loop
        has_accepted_closure = isinstance(loop, Loop) and any(
            each.accepted for each in loop.closures
        )
        # the true closure error of an assigned flight is known from the answer key, so the student
        # can get points even if the report contains no loop
        right_answers = scoring_input.right_answers
        true_values = right_answers.true_values if right_answers else {}
        true_closure_error_m = true_values.get("closure_error_m", 0.0)
        if true_closure_error_m > MAX_TRUE_CLOSURE_ERROR_M and not has_accepted_closure:
            return 1.0, (
                f"Your vehicle landed {format_metres(true_closure_error_m)} m from the take-off "
                "place, so it is right that no loop closure was accepted."
            )
        if not isinstance(loop, Loop) or loop.closure_error_m is None:
            # reason for no loop, or for an unknown true end of the loop
            unavailable = loop.true_end if isinstance(loop, Loop) else loop
            reason_text = format_reason(getattr(unavailable, "reason", ""))
            return 0.0, f"Your report does not state a loop closure error{reason_text}."
        if loop.is_absolute_track:
            return 0.0, (
                "The track in your report does not drift. Analyse odometry, for example LOG:vio."
            )
        points_fraction, comment = 0.25, "No loop closure was accepted."
        if has_accepted_closure:
            corrected_paths = map(loop.corrections.get, CORRECTED_PATH_NAMES)
            is_corrected = any(isinstance(path, PathResult) for path in corrected_paths)
            points_fraction = 1.0 if is_corrected else 0.5
            comment = (
                "A loop closure was accepted, and the drift of the path was "
                f"{'' if is_corrected else 'not '}corrected."
            )
        return points_fraction, (
            f"Your loop closure error is {format_metres(loop.closure_error_m)} m after a path of "
            f"{format_metres(loop.path_length_m)} m. {comment}"
        )
