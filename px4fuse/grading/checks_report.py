"""Checks of the report as such: whose it is, what it holds, whether it is enough to judge from."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, ClassVar

from msgspec import Meta

from px4fuse.grading.evidence import (
    NAMED,
    Bound,
    Evidence,
    RubricItem,
    Scored,
    Text,
    reason_of,
    text_of,
    values_at,
)
from px4fuse.plain import capital, few_words
from px4fuse.record import Share
from px4fuse.results.contract import LoopResults
from px4fuse.verification.rerun import log_sha256
from px4fuse.verification.verification import is_number

Paths = Annotated[tuple[Text, ...], Meta(min_length=1, max_length=100)]
# What places in the results are called that the default rubric asks for
PARTS: Mapping[str, str] = {
    "axes.*.filters.kf": "the consistency of the filter",
    "loop.path_length_m": "the length of the path",
    "loop.corrections": "the corrected paths",
    "tuning": "the noises that the data ask for",
    "tuning.horizontal.held_out.gain_nats": "what tuning would still gain",
    "why": "why EKF2 differs",
}


class VerifiedItem(RubricItem, frozen=True, kw_only=True, tag="verified"):
    """The numbers were computed again and agree; ``without_log`` where a file is not at hand."""

    without_log: Share = 0.5

    def score(self, evidence: Evidence) -> Scored:
        """All or nothing but for a missing file."""
        verdict = evidence.verdict
        if verdict.waits_for_file:
            return self.without_log, (
                f"A file of your report was not at hand ({text_of(verdict.missing)}), so that its "
                "numbers could not be computed again."
            )
        if verdict.status == "verified":
            return 1.0, "Your report's numbers were computed again from its log and agree."
        status = "" if verdict.status == "cannot verify" else f": {verdict.status}"
        return 0.0, f"Your report could not be verified{status}{reason_of(verdict)}."


class StudentItem(RubricItem, frozen=True, kw_only=True, tag="student"):
    """The report says whose it is, by ``name`` and ``id`` as far as they are asked for."""

    name: bool = True
    id: bool = True

    def score(self, evidence: Evidence) -> Scored:
        """Share of what is asked for."""
        student = evidence.results.student
        asked = {"name (--student)": student.name} if self.name else {}
        asked |= {"student id (--id)": student.id} if self.id else {}
        missing = [what for what, value in asked.items() if not text_of(value)]
        if not missing:
            named = ", ".join(map(text_of, asked.values()))
            return 1.0, f"Your report names {named or 'nobody'}."
        said = " and ".join(missing)
        return 1.0 - len(missing) / len(asked), f"Your report does not give your {said}."


class SectionsItem(RubricItem, frozen=True, kw_only=True, tag="sections"):
    """The report has the parts that were asked for: places in its results that hold something."""

    results: Paths

    def score(self, evidence: Evidence) -> Scored:
        """Share of the parts."""
        asked = len(self.results)
        missing = [
            f"{PARTS.get(path, path)}{evidence.why_absent(path)}"
            for path in self.results
            if not any(map(_is_there, values_at(evidence.plain, path)))
        ]
        said = f"Your report has {asked - len(missing)} of {asked} parts that were asked for"
        if missing:
            said = f"{said}; missing: {few_words(missing, NAMED)}"
        return 1.0 - len(missing) / asked, f"{said}."


def _is_there(found: tuple[str, object]) -> bool:
    value = found[1]
    unavailable = isinstance(value, Mapping) and {"what", "reason", "remedy"} <= value.keys()
    return bool(value) and not unavailable


class NumberItem(RubricItem, frozen=True, kw_only=True, tag="number"):
    """A number of the report is between bounds; of several the one that is worst counts.

    Attributes
    ----------
    path : str or tuple of str
        Where it stands; of several the first that is there.
    zero_at : float or None
        From where on there are no points; None for none outside the bounds.
    """

    path: Text | Paths
    name: Text = ""
    unit: Text = ""
    at_least: Bound | None = None
    at_most: Bound | None = None
    zero_at: Bound | None = None
    advice: Text = ""

    def __post_init__(self) -> None:
        low, high, zero = self.at_least, self.at_most, self.zero_at
        if low is None and high is None:
            raise ValueError("no bound; give at_least, at_most or both")
        if low is not None and high is not None and (low > high or zero is not None):
            raise ValueError("give at_least below at_most, and zero_at with one of them alone")
        beyond = zero is None or (zero > high if low is None else zero < low)  # type: ignore[operator]
        if not beyond:
            raise ValueError("zero_at is on the good side of the bound; put it beyond")

    def score(self, evidence: Evidence) -> Scored:
        """1 within the bounds, falling to 0 at ``zero_at``."""
        paths = (self.path,) if isinstance(self.path, str) else self.path
        found: list[tuple[str, float]] = []
        for path in paths:
            values = values_at(evidence.plain, path)
            found = found or [(name, float(one)) for name, one in values if is_number(one)]
        if not found:
            why = next(filter(None, map(evidence.why_absent, paths)), "")
            what = self.name or PARTS.get(paths[0], paths[0])
            return 0.0, f"Your report has no number for {what}{why}."
        name, number = min(found, key=lambda pair: self._share(pair[1]))
        share = self._share(number)
        bounds = (("at least", self.at_least), ("at most", self.at_most))
        limits = " and ".join(f"{word} {bound:.4g}" for word, bound in bounds if bound is not None)
        what = self.name or f"the number {text_of(name)}"
        what += f" ({text_of(name)})" * (bool(self.name) and len(found) > 1)
        shown = f"{number:.4g} {self.unit}".strip()
        advice = f" {self.advice}" if share < 1.0 and self.advice else ""
        return share, f"{capital(what)} is {shown}; {limits} was asked for.{advice}"

    def _share(self, number: float) -> float:
        low, high, zero = self.at_least, self.at_most, self.zero_at
        if (low is None or number >= low) and (high is None or number <= high):
            return 1.0
        bound = high if low is None else low
        if zero is None or bound is None:
            return 0.0
        return min(max((number - zero) / (bound - zero), 0.0), 1.0)


class FlightItem(RubricItem, frozen=True, kw_only=True, tag="flight"):
    """The flight is enough to judge from.

    Attributes
    ----------
    min_path_m : float
        Of a loop, in place of ``min_measurements``.
    handed_out : float
        Of a flight of an answer key, whose length the student did not choose, this share is enough.
    """

    min_duration_s: Annotated[float, Meta(ge=0.0, le=1e5)] = 60.0
    min_measurements: Annotated[int, Meta(ge=0, le=10_000_000)] = 100
    min_path_m: Annotated[float, Meta(ge=0.0, le=1e6)] = 20.0
    handed_out: Share = 0.4

    def score(self, evidence: Evidence) -> Scored:
        """Share of what is asked for, of the length or the count, whichever is less."""
        results = evidence.results
        if evidence.has("no_motion"):
            return 0.0, "Your vehicle hardly moved; fly several passes of 5 m or more."
        if isinstance(results, LoopResults):
            start_s, end_s = results.loop.start_s, results.loop.end_s
            value, least, unit = results.loop.path_length_m, self.min_path_m, "m of path"
        else:
            start_s, end_s = results.settings.start_s, results.settings.end_s
            value = float(max(axis.updates.count for axis in results.axes.values()))
            least, unit = float(self.min_measurements), "measurements"
        least_s = self.min_duration_s
        if evidence.answer is not None:
            whole_s = evidence.answer.truth.get("duration_s", least_s)
            least_s = min(least_s, self.handed_out * whole_s)
        pairs = ((end_s - start_s, least_s), (value, least))
        share = min(1.0 if given >= asked else max(given, 0.0) / asked for given, asked in pairs)
        said = f"You analysed {end_s - start_s:.3g} s with {value:.4g} {unit}"
        if share == 1.0:
            return 1.0, f"{said}, which is enough."
        return share, f"{said}; {least_s:.3g} s and {least:g} {unit} were asked for."


class AnswersItem(RubricItem, frozen=True, kw_only=True, tag="answers"):
    """The form about the flight, by the answer key."""

    needs_key: ClassVar[bool] = True

    def score(self, evidence: Evidence) -> Scored:
        """Share of the points of :mod:`px4fuse.grading.form_points`."""
        student_id, form = evidence.results.student.id, evidence.form
        theirs = None if evidence.key is None else evidence.key.of_student(student_id)
        if theirs is not None and theirs.sha256 != log_sha256(evidence.results):
            file = text_of(theirs.file)
            return 0.0, f"This report is not about the log that you were given, {file}."
        if evidence.answer is None:
            said = text_of(student_id) or "none is given"
            return 0.0, (
                f"Neither your id ({said}) nor your log is in the answer key; make the report of "
                "the log that you were given, with your --id."
            )
        found = evidence.form_points
        if isinstance(form, str) or found is None:
            known = (
                f"Your form {form}" if isinstance(form, str) else "The answer key has no answers"
            )
            return 0.0, f"{known}."
        parts = [
            f"{name} {points:.3g} of {found.of[name]:g}"
            for name, points in found.parts.items()
            if found.of[name]
        ]
        return found.share, f"Of 100: {', '.join(parts)}. {capital('; '.join(found.said))}."


class TextItem(RubricItem, frozen=True, kw_only=True, tag="text"):
    """The student's own text, which nobody but the instructor scores."""

    needs_key: ClassVar[bool] = True
    by_hand: ClassVar[bool] = True

    def score(self, evidence: Evidence) -> Scored:
        """Nothing, until the instructor says it."""
        if not evidence.results.student.notes.strip():
            return 0.0, "Your report has no text of your own; write one and add it with --notes."
        return 0.0, "Your instructor reads your text and gives points for it."
