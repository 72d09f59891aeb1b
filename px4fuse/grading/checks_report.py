"""Checks of the report as such: whose it is, what it holds, whether it is enough to judge from."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from px4fuse.grading.evidence import (
    Evidence,
    list_words,
    reason_of,
    text_of,
    values_at,
    why_absent,
)
from px4fuse.plain import capital
from px4fuse.results.contract import LoopResults
from px4fuse.verification.model import Verdict
from px4fuse.verification.rerun import log_sha256
from px4fuse.verification.verification import NO_LOG, is_number

# What places in the results are called that the default rubric asks for
PARTS: Mapping[str, str] = {
    "axes.*.filters.kf": "the consistency of the filter",
    "clock": "the clock offset",
    "loop.closure_error_m": "the closure error",
    "loop.path_length_m": "the length of the path",
    "loop.corrections": "the corrected paths",
    "tuning": "the noises that the data ask for",
    "tuning.horizontal.held_out.gain_nats": "what tuning would still gain",
    "why": "why EKF2 differs",
}


def verified(evidence: Evidence, given: Mapping[str, Any]) -> tuple[float, str]:
    """The numbers were computed again and agree."""
    verdict = evidence.verdict
    if without_log(verdict):
        return given["without_log"], (
            "The log of your report was not at hand, so that its numbers could not be computed "
            "again."
        )
    if verdict.status == "verified":
        return 1.0, "Your report's numbers were computed again from its log and agree."
    status = "" if verdict.status == "cannot verify" else f": {verdict.status}"
    return 0.0, f"Your report could not be verified{status}{reason_of(verdict)}."


def without_log(verdict: Verdict) -> bool:
    """Whether nothing is wrong with a report, but its log is missing."""
    if verdict.status == "verified":
        return not verdict.with_log
    return verdict.status == "cannot verify" and verdict.reasons == (NO_LOG,)


def student(evidence: Evidence, given: Mapping[str, Any]) -> tuple[float, str]:
    """The report says whose it is."""
    student = evidence.results.student
    asked = [
        (what, option, value)
        for what, option, value, wanted in (
            ("name", "--student", text_of(student.name), given["name"]),
            ("student id", "--id", text_of(student.id), given["id"]),
        )
        if wanted
    ]
    missing = [(what, option) for what, option, value in asked if not value]
    if not missing:
        return 1.0, f"Your report names {', '.join(value for *_, value in asked) or 'nobody'}."
    return 1.0 - len(missing) / len(asked), (
        f"Your report does not give your {' and '.join(what for what, _ in missing)}; make it with "
        f"{' and '.join(option for _, option in missing)}."
    )


def sections(evidence: Evidence, given: Mapping[str, Any]) -> tuple[float, str]:
    """The report has the parts that were asked for."""
    pages = [" ".join(page.split()).casefold() for page in evidence.report.pages]
    missing = [
        f"the page {text_of(wanted)!r}"
        for wanted in given["pages"]
        if not any(" ".join(wanted.split()).casefold() in page for page in pages)
    ]
    for path in given["results"]:
        there = [value for _, value in values_at(evidence.plain, path)]
        if not any(
            v
            for v in there
            if not (isinstance(v, dict) and {"what", "reason", "remedy"} <= v.keys())
        ):
            missing.append(f"{PARTS.get(path, path)}{why_absent(evidence, path)}")
    asked = len(given["pages"]) + len(given["results"])
    if not missing:
        return 1.0, f"Your report has all {asked} parts that were asked for."
    return 1.0 - len(missing) / asked, (
        f"Your report has {asked - len(missing)} of {asked} parts; missing: {list_words(missing)}. "
        "Make the report with px4fuse as it comes, on a whole flight."
    )


def text(evidence: Evidence, given: Mapping[str, Any]) -> tuple[float, str]:
    """The student's own text, which nobody but the instructor scores."""
    del given
    if not evidence.results.student.notes.strip():
        return 0.0, "Your report has no text of your own; write one and add it with --notes."
    return 0.0, "Your instructor reads your text and gives points for it."


def answers(evidence: Evidence, given: Mapping[str, Any]) -> tuple[float, str]:
    """The form about the flight, by the answer key."""
    del given
    results = evidence.results
    theirs = None if evidence.key is None else evidence.key.of_student(results.student.id)
    if theirs is not None and theirs.sha256 != log_sha256(results):
        return 0.0, f"This report is not about the log that you were given, {text_of(theirs.file)}."
    if evidence.answer is None:
        return 0.0, (
            f"Neither your id ({text_of(results.student.id) or 'none is given'}) nor your log is "
            "in the answer key; make the report of the log that you were given, with your --id."
        )
    if evidence.form_problem:
        return 0.0, f"Your form {evidence.form_problem}."
    found = evidence.form_points
    if found is None:
        return 0.0, "The answer key does not say what the right answers are."
    parts = ", ".join(
        f"{name} {points:.3g} of {found.of[name]:g}"
        for name, points in found.parts.items()
        if found.of[name]
    )
    return found.share, f"Of 100: {parts}. {capital('; '.join(found.said))}."


def number_between(evidence: Evidence, given: Mapping[str, Any]) -> tuple[float, str]:
    """A number of the report is between bounds."""
    found: list[tuple[str, float]] = []
    for path in given["path"]:
        found = [
            (name, float(value))
            for name, value in values_at(evidence.plain, path)
            if is_number(value)
        ]
        if found:
            break
    label = given["name"]
    if not found:
        why = next((why for path in given["path"] if (why := why_absent(evidence, path))), "")
        first = given["path"][0]
        return 0.0, f"Your report has no number for {label or PARTS.get(first, first)}{why}."
    # of several the one that is worst counts
    name, number = min(found, key=lambda pair: _within(pair[1], given))
    share = _within(number, given)
    low, high = given["at_least"], given["at_most"]
    bounds = (("at least", low), ("at most", high))
    limits = " and ".join(f"{word} {bound:.4g}" for word, bound in bounds if bound is not None)
    shown = f"{number:.4g} {given['unit']}".strip()
    what = label or f"the number {text_of(name)}"
    what += f" ({text_of(name)})" * (bool(label) and len(found) > 1)
    advice = f" {given['advice']}" if share < 1.0 and given["advice"] else ""
    return share, f"{what[:1].upper() + what[1:]} is {shown}; {limits} was asked for.{advice}"


def _within(number: float, given: Mapping[str, Any]) -> float:
    """1 within the bounds, falling to 0 at ``zero_at``, without that 0 outside."""
    low, high, zero = given["at_least"], given["at_most"], given["zero_at"]
    if (low is None or number >= low) and (high is None or number <= high):
        return 1.0
    if zero is None:
        return 0.0
    bound: float = low if low is not None else high
    return min(max((number - float(zero)) / (bound - float(zero)), 0.0), 1.0)


def flight(evidence: Evidence, given: Mapping[str, Any]) -> tuple[float, str]:
    """The flight is enough to judge from."""
    results = evidence.results
    part = results.loop if isinstance(results, LoopResults) else results.settings
    if evidence.has("no_motion"):
        return 0.0, "Your vehicle hardly moved; fly several passes of 5 m or more."
    value: float
    if isinstance(results, LoopResults):
        value, least, unit = results.loop.path_length_m, given["min_path_m"], "m of path"
    else:
        value = max(axis.updates.count for axis in results.axes.values())
        least, unit = given["min_measurements"], "measurements"
    analysed_s, least_s = part.end_s - part.start_s, given["min_duration_s"]
    if evidence.answer is not None:  # how long it is was not the student's choice
        whole_s = evidence.answer.truth.get("duration_s", least_s)
        least_s = min(least_s, given["handed_out"] * whole_s)
    shares = [_up_to(analysed_s, least_s), _up_to(value, least)]
    said = f"You analysed {analysed_s:.3g} s with {value:.4g} {unit}"
    if min(shares) == 1.0:
        return 1.0, f"{said}, which is enough."
    return min(shares), f"{said}; {least_s:.3g} s and {least:g} {unit} were asked for."


def _up_to(value: float, least: float) -> float:
    return 1.0 if value >= least else max(value, 0.0) / least
