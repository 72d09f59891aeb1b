"""The rubric: what a report is worth, as an instructor writes it down, and points by it.

A TOML file of items, each with a title, points, the name of a check and its parameters: see
:mod:`px4fuse.grading.checks`. A number that a report does not have gives no points and a comment,
never an exception.
"""

from __future__ import annotations

import re
import tomllib
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, Union

import msgspec
from msgspec import Meta

from px4fuse.answers import Answers
from px4fuse.assignment.key import AnswerKey
from px4fuse.assignment.roster import make_unique
from px4fuse.errors import SettingsError
from px4fuse.grading.checks import Evidence, RubricItem, Text, in_brackets, text_of
from px4fuse.grading.flags import own_flags, page_flags
from px4fuse.grading.model import TOTAL, GradedReport, Item
from px4fuse.reading import read_text
from px4fuse.results.contract import Reported
from px4fuse.results.reading import one_line
from px4fuse.verification.model import Verdict
from px4fuse.verification.verification import cannot_verify, log_sha256

DEFAULT_NAME = "rubric.toml"
MAX_RUBRIC_BYTES = 1_000_000
RUBRIC_HELP = "px4fuse grade --write-rubric FILE.toml writes one that explains itself."

# For the class table: column title, and where in the results
NUMBERS = (
    ("SIGMA_A (m/s²)", "settings.sigma_a_m_s2"),
    ("SIGMA_Z (m)", "settings.sigma_z_m"),
    ("mean NIS north", "axes.north.filters.kf.nis_mean"),
    ("mean NIS east", "axes.east.filters.kf.nis_mean"),
    ("position RMSE to truth, aisle (m)", "axes.aisle.filters.kf.truth.position_rmse_m"),
    ("closure error (m)", "loop.closure_error_m"),
)

if TYPE_CHECKING:
    AnyItem = RubricItem
else:
    # of every check, told apart by their tags
    AnyItem = Union[tuple(RubricItem.__subclasses__())]  # noqa: UP007
# What is done with points that nobody can vouch for: left for the instructor, taken, or counted
Doubtful = Literal["pending", "zero", "count"]


class Rubric(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a report is worth.

    Attributes
    ----------
    unverified : {"pending", "zero"}
        What becomes of the points of a report that cannot be verified.
    others_log : {"pending", "zero", "count"}
        What becomes of those of a report on a log that was not given to the student.
    pages : {"count", "pending", "zero"}
        What becomes of those of a verified report whose pages look otherwise.
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
                owner = "that of the sum" if title.casefold() == TOTAL else "another item's"
                raise ValueError(f"the title {title!r} is {owner}; give each its own")


def rubric_text() -> str:
    """The default rubric, comments and all, for an instructor to copy and edit."""
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
    """Check the text of a rubric; ``source_name`` names it in errors."""
    try:
        return msgspec.convert(tomllib.loads(text.replace("\r\n", "\n")), Rubric)
    # ValueError: not TOML, or an integer of a million digits
    except (msgspec.ValidationError, ValueError, RecursionError) as error:
        message = re.sub(r"`\$\.item\[(\d+)\]\.?([^`]*)`", _describe_place, str(error))
        raise SettingsError(f"{source_name}: {one_line(message, 300)}", RUBRIC_HELP) from error


def _describe_place(path: re.Match[str]) -> str:
    """Which item and what of it, as a person counts."""
    return f"item {int(path[1]) + 1}{f', {path[2]}' * bool(path[2])}"


# ------------------------------------------------------------------ points


def assess(
    results: Reported, verdict: Verdict, rubric: Rubric, key: AnswerKey | None, owner_id: str = ""
) -> GradedReport:
    """Points for one report, whether they count, and what is left for the instructor.

    Items for another kind of report are left out, and without an answer key those on the form. The
    names of the file, and what :mod:`px4fuse.grading.grade` knows of it, are for the caller to add.
    ``owner_id`` is that of who handed it in, where a platform says so, whatever the report says.
    """
    evidence = Evidence(results, verdict, key, owner_id)
    points_status, why = _points_status(evidence, rubric)
    student, kind = results.student, "compare" if evidence.comparison else "loop"
    graded_items = []
    for item in rubric.items:
        if not item.applies(kind, key):
            continue
        share, comment = 0.0, f"No points, since {why}."
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
    """What becomes of the points, and why: for "pending" what the instructor can do."""
    verdict = evidence.verdict
    reason = in_brackets("".join(verdict.reasons[:1]))
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
    if not evidence.is_own_log:
        why = "your report is not about the log that you were given"
        doubts.append((rubric.others_log, why, _foreign_log_advice(evidence)))
    if evidence.key is not None and getattr(evidence.results.request, "position", None):
        todo = "Ask where its position file comes from: none was handed out."
        doubts.append(("pending", "", todo))
    for rule, why, _ in doubts:
        if rule == "zero":
            return "zero", why
    todo = " ".join(todo for rule, _, todo in doubts if rule == "pending")
    return ("pending", todo) if todo else ("count", "")


def _foreign_log_advice(evidence: Evidence) -> str:
    """What the instructor can do about a log that is not the student's."""
    student_id = text_of(evidence.results.student.id)
    id_text = f"the report gives the id {student_id}" if student_id else "the report gives no id"
    if evidence.owner_id:
        id_text += f", and {text_of(evidence.owner_id)} handed it in"
    if evidence.answer is None:
        return "Ask for a report on the log that was handed out: this one is about another."
    given_to = text_of(evidence.answer.student_id)
    return f"Find out whose report it is: the log was given to {given_to}, {id_text}."


def refused_report(
    rubric: Rubric, key: AnswerKey | None, why: str, remedy: str = ""
) -> GradedReport:
    """No points for what is not a report, so that it stands in the table with the others."""
    comment = f"No points, since the file could not be read as a report: {text_of(why)}"
    items = (
        Item(item.title, 0.0, item.points, comment)
        for item in rubric.items
        if item.applies("compare", key)
    )
    return GradedReport("", "", "", cannot_verify(why, remedy), tuple(items), pending=remedy)
