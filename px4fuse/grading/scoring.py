"""Points by a rubric.

A report comes from a student; its results have been read strictly. A number that is not there gives
no points and a comment, never an exception.
"""

from px4fuse.answers import Answers
from px4fuse.assignment.key import AnswerKey
from px4fuse.grading.checks import contradictions
from px4fuse.grading.evidence import Evidence, reason_of, text_of
from px4fuse.grading.flags import text_flags
from px4fuse.grading.model import Graded, Item
from px4fuse.grading.rubric import Doubtful, Rubric
from px4fuse.results.contract import Reported
from px4fuse.verification.model import Refused, Verdict
from px4fuse.verification.rerun import log_sha256

# For the class table: column title, and where in the results
NUMBERS = (
    ("SIGMA_A (m/s²)", "settings.sigma_a_m_s2"),
    ("SIGMA_Z (m)", "settings.sigma_z_m"),
    ("mean NIS north", "axes.north.filters.kf.nis_mean"),
    ("mean NIS east", "axes.east.filters.kf.nis_mean"),
    ("position RMSE to truth, aisle (m)", "axes.aisle.filters.kf.truth.position_rmse_m"),
    ("closure error (m)", "loop.closure_error_m"),
)


def assess(
    results: Reported, verdict: Verdict, rubric: Rubric, key: AnswerKey | None, owner_id: str = ""
) -> Graded:
    """Points for one report, whether they count, and what is left for the instructor.

    Items for another kind of report are left out, and without an answer key those on the form. The
    names of the file, and what :mod:`px4fuse.grading.grade` knows of it, are for the caller to add.
    ``owner_id`` is that of who handed it in, where a platform says so, whatever the report says.
    """
    evidence = Evidence(results, verdict, key, owner_id)
    fate, why = _fate(evidence, rubric)
    student = results.student
    made = []
    for item in rubric.items:
        if not item.applies(evidence.kind, key):
            continue
        share, comment = 0.0, f"No points, since {why}."
        if fate != "zero":
            share, comment = item.score(evidence)
        waits = item.by_hand and bool(student.notes.strip()) and fate != "zero"
        points = round(item.points * min(max(share, 0.0), 1.0), 2)
        made.append(Item(item.title, points, item.points, comment, item.by_hand, waits))
    found, values = evidence.form_points, evidence.values
    return Graded(
        "",
        student.name,
        student.id,
        verdict,
        tuple(made),
        flags=(
            *text_flags(results, rubric.min_words, rubric.common_words),
            *contradictions(evidence),
            *([] if evidence.own else [_whose(evidence)]),
        ),
        pending=why if fate == "pending" else "",
        mistakes={} if isinstance(found, str) or not evidence.own else found.named,
        form=evidence.form if isinstance(evidence.form, Answers) else None,
        numbers={title: float(values[path]) for title, path in NUMBERS if path in values},
        log_sha256=log_sha256(results),
        version=results.provenance.px4fuse,
        notes=student.notes,
    )


def _fate(evidence: Evidence, rubric: Rubric) -> tuple[Doubtful, str]:
    """What becomes of the points, and why: for "pending" what the instructor can do."""
    verdict = evidence.verdict
    reason = reason_of(verdict)
    if verdict.status == "numbers differ":
        return "zero", f"your report's numbers are not those that its log gives{reason}"
    # of each doubt what the rubric says, why there are no points, and what can be done
    doubts: list[tuple[Doubtful, str, str]] = []
    if verdict.status != "verified":
        todo = verdict.remedy or f"Look at it yourself: it could not be verified{reason}."
        doubts.append((rubric.unverified, f"your report could not be verified{reason}", todo))
    elif verdict.page_status == "differ":
        why = "pages of your PDF are not those that px4fuse draws from the log"
        doubts.append((rubric.pages, why, "Compare the pages with the redrawn report."))
    if not evidence.own:
        why = "your report is not about the log that you were given"
        doubts.append((rubric.others_log, why, _whose(evidence)))
    if evidence.key is not None and getattr(evidence.results.request, "position", None):
        todo = "Ask where its position file comes from: none was handed out."
        doubts.append(("pending", "", todo))
    for rule, why, _ in doubts:
        if rule == "zero":
            return "zero", why
    todo = " ".join(todo for rule, _, todo in doubts if rule == "pending")
    return ("pending", todo) if todo else ("count", "")


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
        if item.applies("compare", key)
    )
    verdict = Verdict("cannot verify", (why.reason,), with_log=False)
    return Graded("", "", "", verdict, tuple(items), pending=why.remedy)
