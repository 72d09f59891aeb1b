"""Terminal output of ``px4fuse simulate --assignment`` and ``px4fuse grade``."""

from collections import Counter
from pathlib import Path

from px4fuse.core.text import format_count, shorten_to_line
from px4fuse.errors import to_one_line
from px4fuse.report.page import Page
from px4fuse.report.style import GOOD_COLOUR, SEVERITY_COLOURS

from .assignment.key import AnswerKey
from .grading.grade import GradeOutcome


def assignment_page(key: AnswerKey, folder: Path, key_file: Path, written_count: int) -> Page:
    """Summarise the injected faults of the assigned flights, and the written files."""
    flight_count_by_fault = Counter(
        mistake.partition("=")[0]
        for answer in key.answers
        for mistake in answer.mistakes or ("none",)
    )
    flight_count = len(key.answers)
    text_by_label = {
        "Class": f"{format_count(flight_count, 'student')}, {key.kind}",
        "Faults": ", ".join(
            f"{name} {number}" for name, number in sorted(flight_count_by_fault.items())
        ),
        "Flights": f"{to_one_line(str(folder))} ({written_count} logs written, "
        f"{flight_count - written_count} existed already)",
        "Answers": f"{to_one_line(str(key_file))} (not for students)",
    }
    if key.secret:
        text_by_label["Secret"] = (
            "The answer key contains a new secret. To write the same flights again or to add "
            "students, give this secret with --secret-file."
        )
    page = Page()
    page.write_labelled_texts(text_by_label)
    return page


def grading_page(outcome: GradeOutcome) -> Page:
    """Format a table of the students with their points, and the reasons for pending points."""
    page, rows, pending_texts = Page(), [], []
    for grade in outcome.grades:
        report = grade.counted_report
        status = report.status if report else "missing"
        if report and grade.total is None:
            status += ", pending"
            name = shorten_to_line(grade.display_name, 60)
            pending_texts.append(f"{name}: {report.pending_actions}")
        colour = GOOD_COLOUR if status == "verified" else SEVERITY_COLOURS["warning"]
        points_text = "–" if grade.total is None else f"{grade.total:g}"
        rows.append(
            (
                shorten_to_line(grade.student or grade.student_id, 60),
                grade.file_name,
                (status, colour),
                f"{points_text} / {grade.max_points:g}",
                f"{len(grade.flags) or ''}",
            )
        )
    page.add_table(
        ("student", "submission", "status", "points", "flags"), rows, right_aligned_columns=(3, 4)
    )
    count_by_status = Counter(report.status for report in outcome.reports).most_common()
    counts_text = ", ".join(f"{count} {status}" for status, count in count_by_status)
    missing_student_count = sum(grade.counted_report is None for grade in outcome.grades)
    page.write(
        f"{len(outcome.reports)} submissions: {counts_text or 'none'}; no submission from "
        f"{format_count(missing_student_count, 'student')}; {outcome.reused_count} submissions "
        "verified in an earlier run"
    )
    for text in (*pending_texts, *outcome.notes):
        page.write_muted_text(text)
    return page
