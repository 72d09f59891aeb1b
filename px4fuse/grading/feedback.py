"""What goes back to the students: the rules' feedback and the instructor's words in one text."""

from __future__ import annotations

import re
import textwrap

from px4fuse.grading.checks_report import without_log
from px4fuse.grading.class_table import number, settled_report
from px4fuse.grading.evidence import NAMED, joined, text_of
from px4fuse.grading.model import Entry, Graded
from px4fuse.grading.overrides import TOTAL
from px4fuse.verification.model import Verdict

# What an instructor is told, from which a student learns what to hand in
MISSING = re.compile(r"Add (.*) to --logs\.")
NEXT = (
    "Your instructor has these points as a proposal and decides; ask if you think that something "
    "was overlooked."
)


def feedback(graded: Graded, class_name: str = "", final: bool = False) -> str:
    """Plain text for the student: the points, why, and where most can still be gained.

    Flags are for the instructor and are not in it. ``final``: the instructor has said the total,
    so that no proposal is told beside it.
    """
    who = ", ".join(part for part in (text_of(graded.student), text_of(graded.student_id)) if part)
    lines = [*([class_name] if class_name else []), f"Report   {text_of(graded.submission)}"]
    lines += [f"Student  {who}"] if who else []
    points = f"{_points(graded.points)} of {_points(graded.of)}"
    if graded.counted is None:
        points = f"pending: they do not count yet (as it is: {points})"
    lines += [f"Points   {points}"] if graded.items and not final else []
    lines += ["", *_wrapped(verdict_text(graded.verdict))]
    lines += [""] if graded.items else []
    for item in graded.items:
        lines.append(f"{_points(item.points)} of {_points(item.of)}  {text_of(item.title)}")
        lines += [f"    {line}" for line in _wrapped(item.comment, 84)]
    lost = sorted(
        (item for item in graded.items if item.of > item.points),
        key=lambda item: item.points - item.of,
    )
    if lost and graded.points > 0.0:
        lines += ["", "You can still gain most points here:"]
        lines += [f"  - {text_of(i.title)} ({_points(i.of - i.points)})" for i in lost[:3]]
    elif graded.items and not lost:
        lines += ["", "Nothing is missing. Well done."]
    lines += ["", *_wrapped(NEXT)] if graded.items and not final else []
    return "\n".join(lines) + "\n"


def returned_text(entry: Entry, class_name: str = "") -> str:
    """Plain text for one student: points and why, what being late costs, and the instructor's word.

    Flags and remarks are for the instructor and are not in it.
    """
    graded = settled_report(entry)
    lines = []
    if graded is None:
        lines += [*([class_name] if class_name else []), "Nothing was handed in.", ""]
    else:
        final = TOTAL in entry.overrides and entry.total is not None
        lines += [feedback(graded, class_name, final)]
    if entry.deduction:
        hours = (entry.late_s or 0.0) / 3600.0
        off = number(entry.deduction)
        lines.append(f"Handed in {hours:.1f} hours late: {off} points taken off.")
    if entry.total is not None and (entry.deduction or TOTAL in entry.overrides):
        lines.append(f"Total    {number(entry.total)} of {number(entry.of)}")
    if entry.comment:
        lines += ["", "From your instructor:", "", entry.comment]
    return "\n".join(lines).rstrip("\n") + "\n"


def verdict_text(verdict: Verdict) -> str:
    """What verification found, for the student."""
    said = {
        "verified": "Your report was verified: its numbers are what px4fuse computes"
        + (" from your log." if verdict.with_log else "; its log was not at hand."),
        "numbers differ": "Numbers in your report are not those that px4fuse computes from the "
        "log with your settings.",
        "other log": "The log of your report is not one of those that your instructor has.",
        "cannot verify": "Your report could not be verified.",
    }[verdict.status]
    if verdict.status == "verified":
        return said
    if without_log(verdict):
        return (
            "The log of your report was not at hand, so that its numbers could not be computed "
            "again."
        )
    reasons = joined(verdict.reasons[:NAMED])
    said = f"{said.rstrip('.')}: {reasons}." if reasons else said
    missing = MISSING.fullmatch(verdict.remedy)
    if missing:
        return f"{said} Hand in {text_of(missing[1])} too, if your instructor does not have it."
    if verdict.status == "other log":
        return f"{said} Make the report of the log that you were given, or hand in your log too."
    return f"{said} Make it again with px4fuse and hand in the PDF as it was written."


def _wrapped(text: str, width: int = 88) -> list[str]:
    return textwrap.wrap(text, width, break_long_words=False, break_on_hyphens=False)


def _points(value: float) -> str:
    return f"{value:.2f}".rstrip("0").rstrip(".")
