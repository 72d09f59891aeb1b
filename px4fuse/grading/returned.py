"""What goes back to the students: the rules' feedback and the instructor's words in one text."""

from __future__ import annotations

from px4fuse.grading.class_table import number, settled_report
from px4fuse.grading.feedback import feedback
from px4fuse.grading.model import Entry
from px4fuse.grading.overrides import TOTAL


def returned_text(entry: Entry, class_name: str = "") -> str:
    """Plain text for one student: points and why, what being late costs, and the instructor's word.

    Flags and remarks are for the instructor and are not in it.
    """
    graded = settled_report(entry)
    lines = []
    if graded is None:
        lines += [*([class_name] if class_name else []), "Nothing was handed in.", ""]
    else:
        lines += [feedback(graded, class_name)]
    if entry.deduction:
        hours = (entry.late_s or 0.0) / 3600.0
        off = number(entry.deduction)
        lines.append(f"Handed in {hours:.1f} hours late: {off} points taken off.")
    if entry.total is not None and (entry.deduction or TOTAL in entry.overrides):
        lines.append(f"Total    {number(entry.total)} of {number(entry.of)}")
    if entry.comment:
        lines += ["", "From your instructor:", "", entry.comment]
    return "\n".join(lines).rstrip("\n") + "\n"
