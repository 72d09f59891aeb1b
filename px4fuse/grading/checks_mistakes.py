"""Whether the notes name what is wrong with the student's own flight."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from px4fuse.assignment.key import Answer
from px4fuse.grading.claims import in_words
from px4fuse.grading.evidence import Evidence, also_named, list_words, text_of
from px4fuse.verification.rerun import log_sha256

TRY = (
    "Look at the report's findings and at where the innovations leave their band, and say what the "
    "cause is, how large it is, and how you know"
)


def mistakes(evidence: Evidence, given: Mapping[str, Any]) -> tuple[float, str]:
    """The notes name the mistakes of the student's flight and no others."""
    student_id = text_of(evidence.results.student.id)
    theirs = None if evidence.key is None else evidence.key.of_student(student_id)
    if theirs is not None and theirs.sha256 != log_sha256(evidence.results):
        return 0.0, f"This report is not about the log that you were given, {text_of(theirs.file)}."
    answer = evidence.answer
    if answer is None:
        return 0.0, (
            f"Neither your id ({student_id or 'none is given'}) nor your log is in the "
            "answer key; make the report of the log that you were given, with your --id."
        )
    if evidence.notes.problem:
        return 0.0, f"Your notes {evidence.notes.problem}: nothing in them counts. {TRY}."
    if not answer.findings:
        return _nothing_wrong(evidence, given)
    shown = {name for one in evidence.results.findings for name in one.ids}
    if _applied(evidence, answer):
        shown.add("source_clock_offset")
    earned = evidence.claims.earned
    found = [name for name in answer.findings if name in earned]
    left = [name for name in answer.findings if name not in earned]
    listed = [name for name in left if name in shown]
    wrong = evidence.charged
    share = (len(found) + given["in_report"] * len(listed) - len(wrong)) / len(answer.findings)
    was = f"Your flight has {list_words(in_words(answer.findings))}"
    if not left and not wrong:
        return share, f"{was}, and your notes name {'it' if len(found) == 1 else 'all of it'}."
    said = f"{was}; your notes plainly name {len(found)} of {len(answer.findings)}"
    if left:
        said += f", not {list_words(in_words(left))}"
        said += ", which your report shows" if listed else ""
    said += also_named(wrong)
    return share, f"{said}. {TRY}." if left else f"{said}."


def _nothing_wrong(evidence: Evidence, given: Mapping[str, Any]) -> tuple[float, str]:
    was = "Your flight was made without a mistake"
    wrong = evidence.charged
    if wrong:
        return -float(len(wrong)), f"{was}{also_named(wrong)}."
    if evidence.finds_nothing:
        return 1.0, f"{was}, and your notes say so."
    return given["in_report"], f"{was}; your notes should say that you looked and found none."


def _applied(evidence: Evidence, answer: Answer) -> bool:
    """Whether the clock offset was corrected, so that it is no longer a finding."""
    comparison = evidence.comparison
    applied = 0.0 if comparison is None else comparison.settings.clock_offset_s
    asked = answer.truth.get("clock_offset_to_add_s", 0.0)
    return bool(applied) and abs(applied - asked) < abs(asked) / 2.0
