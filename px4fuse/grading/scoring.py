"""Points by a rubric.

A report comes from a student; its results have been read strictly. A number that is not there gives
no points and a comment, never an exception.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from px4fuse.assignment.key import AnswerKey
from px4fuse.grading import checks_filter, checks_loop, checks_report
from px4fuse.grading.checks_filter import SIGMAS
from px4fuse.grading.evidence import Evidence, Scorer, reason_of, text_of
from px4fuse.grading.model import Doubtful, Graded, Item, Rubric, RubricItem, RubricParameter
from px4fuse.grading.text import text_flags
from px4fuse.plain import capital
from px4fuse.verification.model import Refused, Report, Verdict

# Items for which there has to be an answer key, and which only the instructor can score
NEED_KEY, BY_HAND = frozenset(("answers", "text")), frozenset(("text",))


@dataclass(frozen=True)
class Check:
    """What a rubric may ask for: how it is scored, and what it can be told."""

    score: Scorer
    parameters: Mapping[str, RubricParameter]


def _check(score: Scorer, **parameters: RubricParameter) -> Check:
    return Check(score, parameters)


def _share(default: float) -> RubricParameter:
    return RubricParameter("number", default, 0.0, 1.0)


# A check is a function above, its line here, and an item of rubric.toml that explains it
CHECKS: Mapping[str, Check] = {
    "verified": _check(checks_report.verified, without_log=_share(0.5)),
    "student": _check(
        checks_report.student, name=RubricParameter("flag", True), id=RubricParameter("flag", True)
    ),
    "sections": _check(
        checks_report.sections,
        results=RubricParameter("texts", ()),
        pages=RubricParameter("texts", ()),
    ),
    "tuning": _check(
        checks_filter.tuning,
        axis=RubricParameter("text", "horizontal"),
        settings=RubricParameter("texts", SIGMAS, choices=SIGMAS),
        factor=RubricParameter("number", 2.0, 1.0, 1000.0),
    ),
    "number": _check(
        checks_report.number_between,
        path=RubricParameter("texts", required=True),
        name=RubricParameter("text", ""),
        unit=RubricParameter("text", ""),
        at_least=RubricParameter("number"),
        at_most=RubricParameter("number"),
        zero_at=RubricParameter("number"),
        advice=RubricParameter("text", ""),
    ),
    "consistent": _check(
        checks_filter.consistent,
        filter=RubricParameter("text", "kf", choices=("kf", "ekf2")),
        axes=RubricParameter("texts", ("horizontal",)),
        factor=RubricParameter("number", 1.5, 1.0, 1000.0),
    ),
    "clock": _check(
        checks_filter.clock,
        margin_s=RubricParameter("number", 0.03, 0.0, 10.0),
        undeterminable=_share(0.5),
    ),
    "loop": _check(checks_loop.loop, without_reference=_share(0.5)),
    "closure": _check(
        checks_loop.closure,
        enough_p=RubricParameter("number", 0.05, 0.002, 1.0),
        open_unknown=_share(0.5),
    ),
    "flight": _check(
        checks_report.flight,
        min_duration_s=RubricParameter("number", 60.0, 0.0, 1e5),
        min_measurements=RubricParameter("whole", 100, 0, 10_000_000),
        min_path_m=RubricParameter("number", 20.0, 0.0, 1e6),
        handed_out=_share(0.4),
    ),
    "answers": _check(checks_report.answers),
    "text": _check(checks_report.text),
}


def assess(
    report: Report,
    verdict: Verdict,
    rubric: Rubric,
    key: AnswerKey | None,
    owner_id: str = "",
) -> Graded:
    """Points for one report, whether they count, and what is left for the instructor.

    Items for another kind of report are left out, and without an answer key those on the form. The
    names of the file, and what :mod:`px4fuse.grading.grade` knows of it, are for the caller to add.
    ``owner_id`` is that of who handed it in, where a platform says so, whatever the report says.
    """
    evidence = Evidence(report, verdict, rubric, key, owner_id)
    fate, why = _fate(evidence)
    made = []
    for item in rubric.items:
        if not _applies(item, key, evidence.kind):
            continue
        share, comment = 0.0, f"No points, since {why}."
        if fate != "zero":
            share, comment = CHECKS[item.check].score(evidence, item.parameters)
        written = bool(report.results.student.notes.strip())
        by_hand = item.check in BY_HAND
        waits = by_hand and written and fate != "zero"
        points = round(item.points * min(max(share, 0.0), 1.0), 2)
        made.append(Item(item.title, points, item.points, capital(comment), by_hand, waits))
    found = evidence.form_points
    return Graded(
        "",
        report.results.student.name,
        report.results.student.id,
        verdict,
        tuple(made),
        flags=(
            *text_flags(report.results, rubric.min_words, rubric.common_words),
            *checks_loop.contradictions(evidence),
        ),
        pending=why if fate == "pending" else "",
        mistakes={} if found is None or not evidence.own else found.named,
        form=evidence.form,
    )


def score(
    report: Report, verdict: Verdict, rubric: Rubric, key: AnswerKey | None
) -> tuple[Item, ...]:
    """The points of :func:`assess` alone."""
    return assess(report, verdict, rubric, key).items


def _fate(evidence: Evidence) -> tuple[Doubtful, str]:
    """What becomes of the points, and why: for "pending" what the instructor can do."""
    verdict, rubric = evidence.verdict, evidence.rubric
    reason = reason_of(verdict)
    if verdict.status == "numbers differ":
        return "zero", f"your report's numbers are not those that its log gives{reason}"
    todo: list[str] = []
    if verdict.status != "verified" or not verdict.with_log:
        if rubric.unverified == "zero":
            return "zero", f"your report could not be verified{reason}"
        todo.append(verdict.remedy or f"Look at it yourself: it could not be verified{reason}.")
    if verdict.page_status == "differ" and rubric.pages != "count":
        if rubric.pages == "zero":
            return "zero", "pages of your PDF are not those that px4fuse draws from the log"
        todo.append("Compare the pages that differ with the redrawn report.")
    if not evidence.own and rubric.others_log != "count":
        if rubric.others_log == "zero":
            return "zero", "your report is not about the log that you were given"
        todo.append(_whose(evidence))
    if evidence.key is not None and getattr(evidence.results.request, "position", None):
        todo.append("Ask where its position file comes from: none was handed out.")
    return ("pending", " ".join(todo)) if todo else ("count", "")


def _whose(evidence: Evidence) -> str:
    """What the instructor can do about a log that is not the student's."""
    student_id = text_of(evidence.results.student.id)
    said = f"the report gives the id {student_id}" if student_id else "the report gives no id"
    if evidence.owner_id:
        said += f", and {text_of(evidence.owner_id)} handed it in"
    if evidence.answer is None:
        return "Ask for a report on the log that was handed out: this one is about another."
    whose = text_of(evidence.answer.student_id)
    return f"Find out whose report it is: the log was given to {whose}, {said}."


def refused(rubric: Rubric, key: AnswerKey | None, why: Refused) -> Graded:
    """No points for what is not a report, so that it stands in the table with the others."""
    comment = f"No points, since the file could not be read as a report: {text_of(why.reason)}"
    items = (
        Item(item.title, 0.0, item.points, comment)
        for item in rubric.items
        if _applies(item, key, "compare")
    )
    verdict = Verdict("cannot verify", (why.reason,), with_log=False)
    return Graded("", "", "", verdict, tuple(items), pending=why.remedy)


def _applies(item: RubricItem, key: AnswerKey | None, kind: str) -> bool:
    return item.report in ("any", kind) and (item.check not in NEED_KEY or key is not None)
