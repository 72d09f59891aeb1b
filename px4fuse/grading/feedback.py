"""What goes back to the students: the rules' feedback and the instructor's words in one text."""

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
AGAIN = (
    "Make it again with px4fuse, of the log that you were given, and hand in the PDF as it was "
    "written."
)
FOUND = {
    "verified": "Your report was verified: its numbers are what px4fuse computes from your log",
    "numbers differ": "Your report's numbers are not those that px4fuse computes from its log",
    "other log": "The log of your report is not one of those that your instructor has",
    "cannot verify": "Your report could not be verified",
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
    """The points, and why."""
    who = ", ".join(filter(None, map(text_of, (graded.student, graded.student_id))))
    lines = [f"Report   {text_of(graded.submission)}", *([f"Student  {who}"] if who else [])]
    points = f"{number(graded.points)} of {number(graded.of)}"
    if graded.counted is None:
        points = f"pending: they do not count yet (as it is: {points})"
    proposed = bool(graded.items) and not final
    lines += [f"Points   {points}"] if proposed else []
    lines += ["", *_wrapped(verdict_text(graded.verdict)), ""]
    for item in graded.items:
        lines.append(f"{number(item.points)} of {number(item.of)}  {text_of(item.title)}")
        lines += [f"    {line}" for line in _wrapped(item.comment, 84)]
    return [*lines, *(["", *_wrapped(NEXT)] if proposed else []), ""]


def verdict_text(verdict: Verdict) -> str:
    """What verification found, and what to do about it, for the student."""
    said = FOUND[verdict.status]
    if verdict.status == "verified":
        return f"{said}."
    if reasons := joined(verdict.reasons[:NAMED]):
        said = f"{said}: {reasons}"
    if verdict.missing:
        return f"{said}. Hand in {text_of(verdict.missing)}, if your instructor does not have it."
    return f"{said}. {AGAIN}"


def _wrapped(text: str, width: int = 88) -> list[str]:
    return textwrap.wrap(text, width, break_long_words=False, break_on_hyphens=False)
