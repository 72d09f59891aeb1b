"""Terminal output of ``px4fuse simulate --assignment`` and ``px4fuse grade``."""

from collections import Counter
from pathlib import Path

from px4fuse.classroom.assignment.key import AnswerKey
from px4fuse.classroom.assignment.random_assignment import EASIEST_DIFFICULTY, MAX_FAULT_DIFFICULTY
from px4fuse.classroom.grading.grade import GradeOutcome
from px4fuse.core.text import format_count, one_line
from px4fuse.errors import to_one_line
from px4fuse.report.page import Page
from px4fuse.report.style import GOOD_COLOUR, MUTED_COLOUR, SEVERITY_COLOURS


def assignment_page(key: AnswerKey, folder: Path, key_file: Path, written_count: int) -> Page:
    """Summarise the assigned flights (injected faults, difficulty) and the written files."""
    flight_count_by_fault = Counter(
        mistake.partition("=")[0]
        for answer in key.answers
        for mistake in answer.mistakes or ("none",)
    )
    difficulties = [answer.difficulty for answer in key.answers if answer.difficulty is not None]
    folder_text, key_path_text = (to_one_line(str(path)) for path in (folder, key_file))
    flight_count = len(key.answers)
    text_by_label = {
        "Class": f"{format_count(flight_count, 'student')}, {key.kind}",
        "Faults": ", ".join(
            f"{name} {number}" for name, number in sorted(flight_count_by_fault.items())
        ),
        "Level": f"difficulty {min(difficulties):.2f} to {max(difficulties):.2f} (easiest "
        f"{EASIEST_DIFFICULTY:g}, hardest {MAX_FAULT_DIFFICULTY:g}). Difficulty: smallest size "
        "that px4fuse detects in 19 of 20 flights, divided by the size in the flight.",
        "Flights": f"{folder_text} ({written_count} logs written, {flight_count - written_count} "
        "existed already)",
        "Answers": f"{key_path_text} (not for students: the file lists the injected faults)",
    }
    if key.secret:
        text_by_label["Secret"] = (
            "The answer key contains a new secret, the seed of the flights. To write the same "
            "flights again or to add students, give this secret with --secret-file."
        )
    page = Page()
    page.write_labelled_texts(text_by_label)
    return page


def grading_page(outcome: GradeOutcome) -> Page:
    """Format a table of the students with their points, and the reasons for pending points."""
    page, rows = Page(), []
    for grade in outcome.grades:
        report = grade.counted_report
        pending_text = ", pending" if report and grade.total is None else ""
        status = report.status + pending_text if report else "missing"
        status_colour = GOOD_COLOUR if status == "verified" else SEVERITY_COLOURS["warning"]
        points_text = "–" if grade.total is None else f"{grade.total:g}"
        points_text += f" / {grade.max_points:g}"
        name = one_line(grade.student or grade.student_id, 60)
        flag_count_text = f"{len(grade.flags) or ''}"
        rows.append((name, grade.file_name, (status, status_colour), points_text, flag_count_text))
    page.add_table(
        ("student", "submission", "status", "points", "flags"), rows, right_aligned_columns=(3, 4)
    )
    report_count_by_status = Counter(report.status for report in outcome.reports)
    counts_text = ", ".join(
        f"{count} {status}" for status, count in report_count_by_status.most_common()
    )
    missing_student_count = sum(grade.counted_report is None for grade in outcome.grades)
    page.write(
        f"{len(outcome.reports)} submissions: {counts_text or 'none'}; no submission from "
        f"{format_count(missing_student_count, 'student')}; verified in an earlier run: "
        f"{outcome.reused_count} submissions"
    )
    for grade in outcome.grades:
        report = grade.counted_report
        if report is not None and grade.total is None:
            name = one_line(grade.display_name, 60)
            page.write(f"{name}: {report.pending_actions}", colour=MUTED_COLOUR)
    for note in outcome.notes:
        page.write(note, colour=MUTED_COLOUR)
    return page
