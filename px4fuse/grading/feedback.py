"""What goes back to the students: the rules' feedback and the instructor's words in one text."""

from __future__ import annotations

import textwrap

from px4fuse.grading.class_table import number
from px4fuse.grading.evidence import NAMED, joined, text_of
from px4fuse.grading.model import Entry, Graded
from px4fuse.grading.overrides import TOTAL
from px4fuse.verification.model import Verdict

NEXT = (
    "Your instructor has these points as a proposal and decides; ask if you think that something "
    "was overlooked."
)
AGAIN = " Make it again with px4fuse and hand in the PDF as it was written."
# What verification found, and what to do about it
FOUND = {
    "verified": (
        "Your report was verified: its numbers are what px4fuse computes from your log",
        "",
    ),
    "numbers differ": (
        "Numbers in your report are not those that px4fuse computes from the log with your "
        "settings",
        AGAIN,
    ),
    "other log": (
        "The log of your report is not one of those that your instructor has",
        " Make the report of the log that you were given, or hand in your log too.",
    ),
    "cannot verify": ("Your report could not be verified", AGAIN),
}


def returned_text(entry: Entry, class_name: str = "") -> str:
    """Plain text for one student: points and why, what being late costs, and the instructor's word.

    Flags and remarks are for the instructor and are not in it.
    """
    graded = entry.counting
    lines = [class_name] if class_name else []
    if graded is None:
        lines += ["Nothing was handed in.", ""]
    else:
        # a total that the instructor has said leaves no proposal beside it
        lines += _feedback(graded, final=TOTAL in entry.overrides and entry.total is not None)
    if entry.deduction:
        hours = (entry.late_s or 0.0) / 3600.0
        off = number(entry.deduction)
        lines.append(f"Handed in {hours:.1f} hours late: {off} points taken off.")
    if entry.total is not None and (entry.deduction or TOTAL in entry.overrides):
        lines.append(f"Total    {number(entry.total)} of {number(entry.of)}")
    if entry.comment:
        lines += ["", "From your instructor:", "", entry.comment]
    return "\n".join(lines).rstrip("\n") + "\n"


def _feedback(graded: Graded, final: bool) -> list[str]:
    """The points, why, and where most can still be gained."""
    who = ", ".join(filter(None, map(text_of, (graded.student, graded.student_id))))
    lines = [f"Report   {text_of(graded.submission)}", *([f"Student  {who}"] if who else [])]
    points = f"{_points(graded.points)} of {_points(graded.of)}"
    if graded.counted is None:
        points = f"pending: they do not count yet (as it is: {points})"
    lines += [f"Points   {points}"] if graded.items and not final else []
    lines += ["", *_wrapped(verdict_text(graded.verdict)), ""]
    for item in graded.items:
        lines.append(f"{_points(item.points)} of {_points(item.of)}  {text_of(item.title)}")
        lines += [f"    {line}" for line in _wrapped(item.comment, 84)]
    lost = sorted((item for item in graded.items if item.of > item.points),
                  key=lambda item: item.points - item.of)  # fmt: skip
    if lost and graded.points > 0.0:
        lines += ["", "You can still gain most points here:"]
        lines += [f"  - {text_of(i.title)} ({_points(i.of - i.points)})" for i in lost[:3]]
    elif graded.items and not lost:
        lines += ["", "Nothing is missing. Well done."]
    return [*lines, *(["", *_wrapped(NEXT)] if graded.items and not final else []), ""]


def verdict_text(verdict: Verdict) -> str:
    """What verification found, for the student."""
    if verdict.waits_for_file:
        return (
            f"A file of your report was not at hand ({text_of(verdict.missing)}), so that its "
            "numbers could not be computed again. Hand it in too, if your instructor does not have "
            "it."
        )
    said, remedy = FOUND[verdict.status]
    reasons = "" if verdict.status == "verified" else joined(verdict.reasons[:NAMED])
    return f"{said}: {reasons}.{remedy}" if reasons else f"{said}.{remedy}"


def _wrapped(text: str, width: int = 88) -> list[str]:
    return textwrap.wrap(text, width, break_long_words=False, break_on_hyphens=False)


def _points(value: float) -> str:
    return f"{value:.2f}".rstrip("0").rstrip(".")
