"""Whether the notes name what is wrong with the student's own flight."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from px4fuse.assignment.drawing import POSSIBLE_FINDINGS
from px4fuse.assignment.key import Answer, AnswerKey
from px4fuse.grading.evidence import Evidence, list_words, text_of
from px4fuse.verification.rerun import log_sha256

# In the words of the rubric: what says that a flight has no mistake
NOTHING = "none"
# Half is lost where notes name so many kinds of mistakes that some must be guesses
GUESSING = 0.5


def mistakes(evidence: Evidence, given: Mapping[str, Any]) -> tuple[float, str]:
    """The notes name the mistakes of the student's flight and no others."""
    student_id, sha256 = text_of(evidence.results.student.id), log_sha256(evidence.results)
    answer = answer_for(evidence.key, student_id, sha256)
    if answer is None:
        return 0.0, (
            f"Neither your id ({student_id or 'none is given'}) nor your log is in the "
            "answer key; make the report of the log that you were given, with your --id."
        )
    if answer.sha256 != sha256:
        return 0.0, f"This report is not about the log that you were given, {text_of(answer.file)}."
    named = [name for name in sorted(POSSIBLE_FINDINGS) if evidence.names(name, affirmed=True)]
    if not answer.findings:
        return _nothing_wrong(evidence, named, given)
    shown = {name for one in evidence.results.findings for name in one.ids}
    if _applied(evidence, answer):
        shown.add("source_clock_offset")
    shares = {
        name: 1.0 if evidence.names(name, affirmed=True) else given["in_report"] * (name in shown)
        for name in answer.findings
    }
    share = sum(shares.values()) / len(shares)
    found = [name for name, part in shares.items() if part == 1.0]
    left = [name for name in shares if name not in found]
    was = f"Your flight was made with {list_words([text_of(one) for one in answer.mistakes])}"
    if len(named) > given["most_named"]:
        return share * GUESSING, (
            f"{was}, but your notes name {len(named)} kinds of mistakes as if all were there; say "
            "which of them your log has."
        )
    if not left:
        return share, f"{was}, and your notes name {'it' if len(found) == 1 else 'all of it'}."
    listed = any(name in shown for name in left)
    return share, (
        f"{was}; your notes name {len(found)} of {len(shares)}, missing: {list_words(left)}"
        + (", which your report shows but your notes do not explain." if listed else ".")
    )


def _nothing_wrong(
    evidence: Evidence, named: Sequence[str], given: Mapping[str, Any]
) -> tuple[float, str]:
    was = "Your flight was made without a mistake"
    if evidence.notes.mention(evidence.words.get(NOTHING, ())):
        if not named:
            return 1.0, f"{was}, and your notes say so."
        return given["in_report"], f"{was}; your notes say so but also name {list_words(named)}."
    if named:
        return 0.0, f"{was}, but your notes name {list_words(named)}."
    return given["in_report"], f"{was}; your notes should say that you looked and found none."


def answer_for(key: AnswerKey | None, student_id: str, log_sha256: str) -> Answer | None:
    """The answer that counts: the student's own, or for an id that is not in the key the log's."""
    if key is None:
        return None
    return key.of_student(student_id) or key.of_log(log_sha256)


def _applied(evidence: Evidence, answer: Answer) -> bool:
    """Whether the clock offset was mended, so that it is no longer a finding."""
    comparison = evidence.comparison
    applied = 0.0 if comparison is None else comparison.settings.clock_offset_s
    asked = answer.truth.get("clock_offset_to_add_s", 0.0)
    return bool(applied) and abs(applied - asked) < abs(asked) / 2.0
