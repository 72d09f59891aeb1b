"""Points by a rubric.

A report comes from a student; its results have been read strictly. A number that is not there gives
no points and a comment, never an exception.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from px4fuse.assignment.key import AnswerKey
from px4fuse.findings import SEVERITIES, named
from px4fuse.grading import checks_filter, checks_loop, checks_mistakes, checks_report
from px4fuse.grading.checks_filter import SIGMAS
from px4fuse.grading.evidence import Evidence, Scorer, reason_of, text_of
from px4fuse.grading.model import Doubtful, Graded, Item, Parameter, Rubric, RubricItem
from px4fuse.grading.notes import MANY_DISGUISED
from px4fuse.verification.model import Refused, Report, Verdict

# Checks in which a wrong claim costs what a right one earns, so that guessing does not pay
COSTLY = frozenset(("findings", "mistakes"))
# Passages for the instructor to read, of one report
MOST_TO_READ = 6


@dataclass(frozen=True)
class Check:
    """What a rubric may ask for: how it is scored, and what it can be told."""

    score: Scorer
    parameters: Mapping[str, Parameter]


def _check(score: Scorer, **parameters: Parameter) -> Check:
    return Check(score, parameters)


def _share(default: float) -> Parameter:
    return Parameter("number", default, 0.0, 1.0)


# A check is a function above, its line here, and an item of rubric.toml that explains it
CHECKS: Mapping[str, Check] = {
    "verified": _check(checks_report.verified, without_log=_share(0.5)),
    "student": _check(
        checks_report.student, name=Parameter("flag", True), id=Parameter("flag", True)
    ),
    "sections": _check(
        checks_report.sections, results=Parameter("texts", ()), pages=Parameter("texts", ())
    ),
    "notes": _check(
        checks_report.notes,
        min_words=Parameter("whole", 150, 1, 100_000),
        min_different=Parameter("whole", 60, 1, 100_000),
    ),
    "findings": _check(
        checks_report.findings,
        severities=Parameter("texts", ("error", "warning"), choices=SEVERITIES),
        ignore=Parameter("texts", ("ekf2_unavailable",)),
    ),
    "tuning": _check(
        checks_filter.tuning,
        axis=Parameter("text", "horizontal"),
        settings=Parameter("texts", SIGMAS, choices=SIGMAS),
        factor=Parameter("number", 2.0, 1.0, 1000.0),
    ),
    "number": _check(
        checks_report.number_between,
        path=Parameter("texts", required=True),
        name=Parameter("text", ""),
        unit=Parameter("text", ""),
        at_least=Parameter("number"),
        at_most=Parameter("number"),
        zero_at=Parameter("number"),
        advice=Parameter("text", ""),
    ),
    "consistent": _check(
        checks_filter.consistent,
        filter=Parameter("text", "kf", choices=("kf", "ekf2")),
        axes=Parameter("texts", ("horizontal",)),
        factor=Parameter("number", 1.5, 1.0, 1000.0),
    ),
    "clock": _check(
        checks_filter.clock,
        margin_s=Parameter("number", 0.03, 0.0, 10.0),
        undeterminable=_share(0.5),
    ),
    "loop": _check(checks_loop.loop, without_reference=_share(0.5)),
    "closure": _check(
        checks_loop.closure,
        enough_p=Parameter("number", 0.05, 0.002, 1.0),
        open_unknown=_share(0.5),
    ),
    "flight": _check(
        checks_report.flight,
        min_duration_s=Parameter("number", 60.0, 0.0, 1e5),
        min_measurements=Parameter("whole", 100, 0, 10_000_000),
        min_path_m=Parameter("number", 20.0, 0.0, 1e6),
        handed_out=_share(0.4),
    ),
    "mistakes": _check(checks_mistakes.mistakes, in_report=_share(0.0)),
}


def assess(
    report: Report,
    verdict: Verdict,
    rubric: Rubric,
    key: AnswerKey | None,
    owner_id: str = "",
) -> Graded:
    """Points for one report, whether they count, and what is left for the instructor.

    Items for another kind of report are left out, and without an answer key those on mistakes. The
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
        least = -1.0 if item.check in COSTLY else 0.0
        points = round(item.points * min(max(share, least), 1.0), 2)
        made.append(Item(item.title, points, item.points, comment[:1].upper() + comment[1:]))
    return Graded(
        "",
        report.results.student.name,
        report.results.student.id,
        verdict,
        tuple(made),
        flags=(*_notes_flags(evidence), *checks_loop.contradictions(evidence)),
        pending=why if fate == "pending" else "",
        to_read=tuple(_to_read(evidence)),
        mistakes=_mistakes(evidence),
    )


def _mistakes(evidence: Evidence) -> dict[str, bool]:
    if evidence.answer is None or not evidence.own:
        return {}
    earned = frozenset() if evidence.notes.problem else evidence.claims.earned
    return {named(finding): finding in earned for finding in evidence.answer.findings}


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


def _notes_flags(evidence: Evidence) -> Iterator[str]:
    notes = evidence.notes
    if notes.problem:
        yield f"The notes {notes.problem}; they were not scored."
    if notes.disguised >= MANY_DISGUISED:
        yield (
            f"The notes hold {notes.disguised} words with letters that only look like those of the "
            "alphabet, or that nobody sees: such words hide from a search."
        )


def _to_read(evidence: Evidence) -> Iterator[tuple[str, str]]:
    """Passages for the instructor, the first few."""
    if evidence.notes.problem:
        return
    claims = evidence.claims
    known = "the log has" if evidence.answer is not None else "the report finds"
    earned = claims.earned
    lines = [
        (f"May name {named(one)}, which {known}", said)
        for one, said in {**claims.open, **claims.unsure}.items() if one not in earned
    ]  # fmt: skip
    lacks = "the log does not have" if evidence.answer is not None else "the report does not find"
    cost = "; it cost points" if evidence.charged else ""
    lines += [
        (f"Was read as naming {named(one)}, which {lacks}{cost}", said)
        for one, said in claims.wrong.items()
    ]
    if checks_loop.unjudged(evidence):
        lines.append(("Says that it did not come back (--open), which the log cannot tell", ""))
    yield from ((f"{why}.", text_of(said)) for why, said in lines[:MOST_TO_READ])


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
    return item.report in ("any", kind) and (item.check != "mistakes" or key is not None)
