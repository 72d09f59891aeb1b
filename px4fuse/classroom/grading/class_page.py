"""Web page for the instructor: statistics of the class, and a table with one row per student."""

import math
import statistics
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass
from typing import NamedTuple

import numpy as np

from px4fuse.core.text import format_count
from px4fuse.html import frame
from px4fuse.html.frame import Cell, Column, Row, RowDetailsSection
from px4fuse.html.safe import load_template, make_relative_url
from px4fuse.results.answer_form import form_rows

from ..assignment.roster import format_cell_number
from .model import (
    TOTAL_POINTS_TITLE,
    Grade,
    GradedReport,
    GradeOverride,
    list_item_titles,
    select_counted_reports,
)

NO_SUBMISSION_STATUS = "no submission"
# CSS style and symbol of each verification status, in sort order
STATUS_STYLES: dict[str, tuple[str, str]] = {
    "verified": ("good", "✓"),
    "numbers differ": ("bad", "≠"),
    "other log": ("odd", "⇄"),
    "cannot verify": ("open", "?"),
    "page differs": ("odd", "≠"),
    NO_SUBMISSION_STATUS: ("open", "–"),
}
STATUSES = tuple(STATUS_STYLES)
TABLE_FILTER_TAGS = (*STATUSES, "pending", "to read", "flagged", "late", "changed by instructor")
# Minimum number of reports to compute the discrimination of a rubric item: the correlation of its
# points with the points for all other items
MIN_REPORTS_FOR_CORRELATION = 5


def format_class_page(grades: Sequence[Grade], title: str, version_text: str) -> str:
    """Format the web page of the class; ``version_text`` is name and version of px4fuse."""
    item_titles = list_item_titles(grades)
    count_by_tag = Counter(tag for grade in grades for tag in _make_grade_tags(grade))
    tags = (
        *TABLE_FILTER_TAGS,
        *sorted(tag for tag in count_by_tag if tag not in TABLE_FILTER_TAGS),
    )
    options = [(tag, f"{tag} ({count_by_tag[tag]})") for tag in tags if count_by_tag[tag]]
    return frame.page(
        title=title,
        subtitle=f"{format_count(len(grades), 'student')}, graded with {version_text}",
        html_above_table=_format_statistics(grades, count_by_tag),
        rows_name="students",
        columns=(
            Column("Student"),
            Column("Id", "line", is_on_phones=False),
            Column("Status", "rank"),
            Column("Points", "number"),
            Column("Handed in", "line", is_on_phones=False),
            Column("Flags", "rank", is_on_phones=False),
            *(Column(title, "number", "items") for title in item_titles),
        ),
        rows=[_make_grade_row(grade, item_titles) for grade in grades],
        filters=[("Status", [("", f"Everyone ({len(grades)})"), *options])],
        column_groups=(("items", "Points of each rubric item"),),
        search_placeholder="search for name, id or file",
        full_table_note="class.csv contains the table of all students.",
    )


def _format_statistics(grades: Sequence[Grade], count_by_tag: Mapping[str, int]) -> str:
    """Format the summary above the table of students: reports by status, and points.

    ``count_by_tag`` contains the number of students with each tag, such as "verified". The points
    of each rubric item are shown, too.
    """
    totals = [grade.total for grade in grades if grade.total is not None]
    reports = select_counted_reports(grades)
    pending_points = [report.points for report in reports if report.instructor_action]
    # title, value and note; zeros are not shown
    numbers: list[tuple[str, float | str, str]] = [
        ("Students", len(grades), ""),
        ("Verified", count_by_tag["verified"], ""),
        ("Missing", count_by_tag[NO_SUBMISSION_STATUS], ""),
        ("Flagged", count_by_tag["flagged"], ""),
        ("Late", count_by_tag["late"], ""),
    ]
    if totals:
        max_points_text = f"of {max(grade.max_points for grade in grades):g}"
        numbers += [
            ("Mean points", f"{statistics.fmean(totals):.1f}", max_points_text),
            ("Median points", f"{statistics.median(totals):.1f}", max_points_text),
        ]
    points_text = f"{format_cell_number(sum(pending_points))} points"
    numbers.append(("Pending items", len(pending_points), points_text))
    return load_template("classroom/grading/above.html").render(
        numbers=numbers, items=analyse_items(reports)
    )


def _make_grade_tags(grade: Grade) -> list[str]:
    """Return the tags by which the class page filters a grade, for example "late" and "pending"."""
    report = grade.counted_report
    tags = [report.status if report else NO_SUBMISSION_STATUS]
    tags += ["flagged"] * bool(grade.flags) + ["late"] * bool(grade.lateness_s)
    if report:
        tags += ["pending"] * bool(report.instructor_action)
        tags += ["to read"] * report.is_awaiting_points
        tags += [
            f"missed: {kind}"
            for kind, is_named in report.did_student_name_fault.items()
            if not is_named
        ]
    return tags + ["changed by instructor"] * bool(grade.overrides or grade.comment)


def _make_grade_row(grade: Grade, item_titles: Sequence[str]) -> Row:
    """Return the table row of a student, with details and links that the reader can open."""
    report = grade.counted_report
    status = report.status if report else NO_SUBMISSION_STATUS
    css_class, symbol = STATUS_STYLES[status]
    flag_count = len(grade.flags)
    flag_count_text = format_count(flag_count, "flag") if flag_count else ""
    late_text = f"{math.ceil(grade.lateness_s / 60.0)} min late" if grade.lateness_s else ""
    points_by_title = {item.title: item.points for item in report.items} if report else {}
    cells = (
        Cell(grade.display_name, second_line=grade.file_name),
        Cell(grade.student_id),
        Cell(f"{symbol} {status}", STATUSES.index(status), flag_count_text, css_class),
        _make_points_cell(grade),
        Cell(grade.submission_time, second_line=late_text),
        Cell("\n".join(grade.flags), flag_count, "", "flags"),
        *(frame.make_number_cell(points_by_title.get(title)) for title in item_titles),
    )
    # overrides.csv needs an id or a file name, which an anonymous student lacks
    points_input_boxes = (
        (_make_points_input_boxes(grade),) if grade.student_id or grade.file_name else ()
    )
    links = (
        [("Report recomputed from the log (PDF)", make_relative_url(report.redrawn_report_path))]
        if report
        else []
    )
    return Row(
        cells,
        tuple(_make_grade_tags(grade)),
        (*_make_grade_details(grade), *points_input_boxes),
        (frame.make_links_section("Report", links),),
    )


def _make_grade_details(grade: Grade) -> Iterator[RowDetailsSection]:
    """Yield the details of a student for the web page."""
    report = grade.counted_report
    yield frame.make_prose_section("Your comment", grade.comment)
    if report is None:
        yield frame.make_list_section("Missing", ["No submission."])
        return
    verification = report.verification
    items = [
        (
            item.title,
            format_cell_number(item.points),
            format_cell_number(item.max_points),
            item.comment,
        )
        for item in report.items
    ]
    other_report_texts = [f"{other.submission}: {other.status}" for other in grade.other_reports]
    yield frame.make_list_section("Flags", grade.flags, is_warning=True)
    yield frame.make_list_section(
        "Instructor's action needed",
        [report.instructor_action] if report.instructor_action else [],
        is_warning=True,
    )
    yield frame.make_list_section("Verification", verification.reasons)
    yield frame.make_table_section(
        "Numbers that differ from the report",
        [*map(astuple, verification.differences)],
        ("Value", "Report", "Recomputed"),
    )
    title = "Points (proposed)" if report.instructor_action else "Points"
    yield frame.make_table_section(title, items, ("Item", "Points", "Of", "Comment"), (1, 2))
    yield frame.make_name_value_section(
        "Answer form", [*form_rows(report.form)] if report.form else []
    )
    yield frame.make_prose_section("Student's text (--notes)", report.notes)
    yield frame.make_list_section("Other attempts", other_report_texts)


def _make_points_cell(grade: Grade) -> Cell:
    report = grade.counted_report
    if grade.total is None:
        if report is None:
            return Cell("–")
        # the points wait for a decision of the instructor
        return Cell("pending", None, f"{format_cell_number(report.points)} proposed")
    notes = []
    if grade.deducted_points:
        notes.append(f"{format_cell_number(grade.deducted_points)} deducted (late)")
    if any(override.points is not None for override in grade.overrides.values()):
        notes.append("changed by instructor")
    return Cell(
        f"{format_cell_number(grade.total)} / {format_cell_number(grade.max_points)}",
        grade.total,
        ", ".join(notes),
    )


def _make_points_input_boxes(grade: Grade) -> RowDetailsSection:
    """Return input boxes for the points and comments of the instructor."""
    report = grade.counted_report
    max_points_by_title = {
        item.title: item.max_points
        for item in (report.items if report else ())
        if item.is_scored_by_instructor
    }
    max_points_by_title[TOTAL_POINTS_TITLE] = grade.max_points
    rows = []
    for title, max_points in max_points_by_title.items():
        override = grade.overrides.get(title, GradeOverride())
        rows.append((title, max_points, override.points, override.comment))
    # the page replaces the whole file overrides.csv, so it must also contain the points for which
    # the page has no input box
    rows_without_input_box = [
        (title, override.points, override.comment)
        for title, override in grade.overrides.items()
        if title not in max_points_by_title
    ]
    identity = grade.student_id or grade.file_name
    return frame.make_input_boxes_section(
        "Points and comments by the instructor", identity, rows, rows_without_input_box
    )


# ------------------------------------------------------------------ statistics of rubric items


@dataclass(frozen=True)
class ItemStatistics:
    """Statistics of a class for one rubric item, one part of the answer form, or one fault.

    Attributes
    ----------
    discrimination : float or None
        Correlation between the points for this item and the points for the other items. None if
        there are too few reports, or if all reports have the same points.
    """

    title: str
    mean_points: float
    max_points: float
    discrimination: float | None


class _ItemPoints(NamedTuple):
    """Points of one report for an item."""

    points: float
    max_points: float
    points_of_other_items: float


def analyse_items(reports: Sequence[GradedReport]) -> list[ItemStatistics]:
    """Compute the statistics of all graded reports, for three kinds of items.

    The items are those of the rubric, the parts of the answer form, and the injected faults. A
    fault gives one point if the student named it.
    """
    final_reports = [report for report in reports if not report.instructor_action]
    scores_by_title = defaultdict[str, list[_ItemPoints]](list)
    for prefix, items_by_report in (
        ("", [report.items for report in final_reports]),
        ("Answer form: ", [report.form_part_scores for report in final_reports]),
    ):
        for items in items_by_report:
            total_points = sum(item.points for item in items)
            for item in items:
                if not item.is_awaiting_points:
                    scores_by_title[prefix + item.title].append(
                        _ItemPoints(item.points, item.max_points, total_points - item.points)
                    )
    for report in final_reports:
        for kind, is_named in report.did_student_name_fault.items():
            scores_by_title[f"Fault: {kind}"].append(_ItemPoints(is_named, 1.0, report.points))
    statistics_of_items = []
    for title, scores in scores_by_title.items():
        # one array over the reports for each field of _ItemPoints
        points, max_points, points_of_other_items = np.transpose(scores)
        discrimination = None
        has_variation = np.ptp(points) > 0.0 and np.ptp(points_of_other_items) > 0.0
        if len(scores) >= MIN_REPORTS_FOR_CORRELATION and has_variation:
            discrimination = float(np.corrcoef(points, points_of_other_items)[0, 1])
        statistics_of_items.append(
            ItemStatistics(title, float(points.mean()), float(max_points.max()), discrimination)
        )
    return statistics_of_items
