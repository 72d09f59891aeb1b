"""Rubric: reading the TOML file of an instructor, and scoring a report with it.

The rubric has items, each with title, points, a check of :mod:`px4fuse.grading.checks` and its
parameters. A number that a report does not contain gives no points and a comment.
"""

from __future__ import annotations

import re
import tomllib
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, Union

import msgspec
from msgspec import Meta

from px4fuse.answer_form import Answers
from px4fuse.assignment.key import AnswerKey
from px4fuse.assignment.roster import make_unique
from px4fuse.errors import SettingsError
from px4fuse.grading.checks import Evidence, RubricItem, Text, in_brackets, text_of
from px4fuse.grading.flags import own_flags, page_flags
from px4fuse.grading.model import TOTAL, GradedReport, Item
from px4fuse.reading import read_text
from px4fuse.results.contract import ReportedResults
from px4fuse.results.reading import one_line
from px4fuse.verification.model import Verdict
from px4fuse.verification.verification import cannot_verify, log_sha256

DEFAULT_NAME = "rubric.toml"
MAX_RUBRIC_BYTES = 1_000_000
RUBRIC_HELP = "Write a commented example with px4fuse grade --write-rubric FILE.toml."

# numbers of the class table: column title, and path in the results
NUMBERS = (
    ("SIGMA_A (m/s²)", "settings.sigma_a_m_s2"),
    ("SIGMA_Z (m)", "settings.sigma_z_m"),
    ("mean NIS north", "axes.north.filters.kf.nis_mean"),
    ("mean NIS east", "axes.east.filters.kf.nis_mean"),
    (
        "position RMSE against ground truth, aisle (m)",
        "axes.aisle.filters.kf.truth.position_rmse_m",
    ),
    ("closure error (m)", "loop.closure_error_m"),
)

if TYPE_CHECKING:
    AnyItem = RubricItem
else:
    # items of all checks, distinguished by their tag
    AnyItem = Union[tuple(RubricItem.__subclasses__())]  # noqa: UP007
# points of a report that is not fully verified: left to the instructor, zero, or counted
Doubtful = Literal["pending", "zero", "count"]


class Rubric(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Items of a grade, and rules for reports that are not fully verified.

    Attributes
    ----------
    unverified : {"pending", "zero"}
        Rule for a report that could not be verified.
    others_log : {"pending", "zero", "count"}
        Rule for a report on a log that was not given to the student.
    pages : {"count", "pending", "zero"}
        Rule for a verified report with pages that differ from the redrawn ones.
    """

    title: Text = ""
    unverified: Literal["pending", "zero"] = "pending"
    others_log: Doubtful = "pending"
    pages: Doubtful = "count"
    items: Annotated[tuple[AnyItem, ...], Meta(min_length=1, max_length=100)] = msgspec.field(
        name="item"
    )

    def __post_init__(self) -> None:
        titles = [TOTAL, *(item.title for item in self.items)]
        for title, unique_title in zip(titles, make_unique(titles), strict=True):
            if title != unique_title:
                owner = "the sum" if title.casefold() == TOTAL else "another item"
                raise ValueError(f"the title {title!r} is used by {owner}; use unique titles")


def rubric_text() -> str:
    """Return the default rubric with its comments, as an example to edit."""
    return files("px4fuse.grading").joinpath(DEFAULT_NAME).read_text(encoding="utf-8")


def read_rubric(path: Path | None) -> Rubric:
    """Read and check a rubric.

    Parameters
    ----------
    path : Path or None
        None is the default one.

    Raises
    ------
    SettingsError
        It cannot be read, or something in it is not what it should be: the text says which item.
    """
    if path is None:
        return parse_rubric(rubric_text(), DEFAULT_NAME)
    return parse_rubric(read_text(path, SettingsError, MAX_RUBRIC_BYTES, name=str(path)), str(path))


def parse_rubric(text: str, source_name: str) -> Rubric:
    """Parse and check the text of a rubric; ``source_name`` names it in errors."""
    try:
        return msgspec.convert(tomllib.loads(text.replace("\r\n", "\n")), Rubric)
    # ValueError: not TOML, or an integer of a million digits
    except (msgspec.ValidationError, ValueError, RecursionError) as error:
        message = re.sub(r"`\$\.item\[(\d+)\]\.?([^`]*)`", _describe_place, str(error))
        raise SettingsError(f"{source_name}: {one_line(message, 300)}", RUBRIC_HELP) from error


def _describe_place(path: re.Match[str]) -> str:
    """Format the place of an error: item number (from 1) and field."""
    return f"item {int(path[1]) + 1}{f', {path[2]}' * bool(path[2])}"


# ------------------------------------------------------------------ points


def assess(
    results: ReportedResults,
    verdict: Verdict,
    rubric: Rubric,
    key: AnswerKey | None,
    owner_id: str = "",
) -> GradedReport:
    """Score a report, and state whether its points count and what the instructor has to do.

    Items for other commands are left out; items on the form also without an answer key. The caller
    adds the file names. ``owner_id`` is the student id according to the learning platform, which
    takes precedence over the id in the report.
    """
    evidence = Evidence(results, verdict, key, owner_id)
    points_status, why = _points_status(evidence, rubric)
    student, kind = results.student, "compare" if evidence.comparison else "loop"
    graded_items = []
    for item in rubric.items:
        if not item.applies(kind, key):
            continue
        share, comment = 0.0, f"No points: {why}."
        if points_status != "zero":
            share, comment = item.score(evidence)
        awaits_points = item.by_hand and bool(student.notes.strip()) and points_status != "zero"
        points = round(item.points * min(max(share, 0.0), 1.0), 2)
        graded_items.append(
            Item(item.title, points, item.points, comment, item.by_hand, awaits_points)
        )
    form_result, values = evidence.form_points, evidence.values
    return GradedReport(
        "",
        student.name,
        student.id,
        verdict,
        tuple(graded_items),
        flags=(
            *page_flags(verdict),
            *own_flags(results, key is not None),
            *([] if evidence.is_own_log else [_foreign_log_advice(evidence)]),
        ),
        pending=why if points_status == "pending" else "",
        mistakes={}
        if isinstance(form_result, str) or not evidence.is_own_log
        else form_result.named,
        form=evidence.form if isinstance(evidence.form, Answers) else None,
        numbers={title: float(values[path]) for title, path in NUMBERS if path in values},
        log_sha256=log_sha256(results),
        version=results.provenance.px4fuse,
        notes=student.notes,
    )


def _points_status(evidence: Evidence, rubric: Rubric) -> tuple[Doubtful, str]:
    """Return the rule for the points and its reason; for "pending" the action required."""
    verdict = evidence.verdict
    reason = in_brackets("".join(verdict.reasons[:1]))
    if verdict.status == "numbers differ":
        return "zero", f"the numbers of your report differ from those of its log{reason}"
    # rule of the rubric, reason for the student, action for the instructor
    doubts: list[tuple[Doubtful, str, str]] = []
    if verdict.status != "verified":
        todo = verdict.remedy or f"Check the report by hand: it was not verified{reason}."
        doubts.append((rubric.unverified, f"your report could not be verified{reason}", todo))
    elif verdict.page_status == "differ":
        why = "pages of your PDF differ from those that px4fuse draws from the log"
        doubts.append((rubric.pages, why, "Compare the pages with the redrawn report."))
    if not evidence.is_own_log:
        why = "your report is not about the log that you were given"
        doubts.append((rubric.others_log, why, _foreign_log_advice(evidence)))
    if evidence.key is not None and getattr(evidence.results.request, "position", None):
        todo = "Ask where the position file (--position) is from: none was handed out."
        doubts.append(("pending", "", todo))
    for rule, why, _ in doubts:
        if rule == "zero":
            return "zero", why
    todo = " ".join(todo for rule, _, todo in doubts if rule == "pending")
    return ("pending", todo) if todo else ("count", "")


def _foreign_log_advice(evidence: Evidence) -> str:
    """Format the action of the instructor for a report on a log of another student."""
    student_id = text_of(evidence.results.student.id)
    id_text = f"the id in the report is {student_id}" if student_id else "the report has no id"
    if evidence.owner_id:
        id_text += f", and {text_of(evidence.owner_id)} handed it in"
    if evidence.answer is None:
        return "The report is not about a log of the answer key. Ask for a report on that log."
    given_to = text_of(evidence.answer.student_id)
    return f"Find the author of the report: its log was given to {given_to}, {id_text}."


def refused_report(
    rubric: Rubric, key: AnswerKey | None, why: str, remedy: str = ""
) -> GradedReport:
    """Return a graded report with zero points, for a file that is not a report."""
    comment = f"No points: the file is not a px4fuse report ({text_of(why).rstrip('.')})."
    items = (
        Item(item.title, 0.0, item.points, comment)
        for item in rubric.items
        if item.applies("compare", key)
    )
    return GradedReport("", "", "", cannot_verify(why, remedy), tuple(items), pending=remedy)
