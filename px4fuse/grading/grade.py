"""Grading of a class: submissions are verified in parallel, with limits of time and memory."""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from px4fuse.assignment.key import AnswerKey
from px4fuse.errors import ResultsError
from px4fuse.grading import submissions
from px4fuse.grading.entries import OVERRIDES_NAME, Course, build_entries, read_overrides
from px4fuse.grading.model import Entry, GradedReport, Submission
from px4fuse.grading.outputs import find_grade_column, write_class
from px4fuse.grading.records import RECORDS_FOLDER, load_or_verify
from px4fuse.grading.rubric import Rubric, grade_unreadable, score_report
from px4fuse.reading import files_by_sha256, max_log_bytes
from px4fuse.results.reading import one_line
from px4fuse.workers import JobFailure, run_bounded

FAILED_REMEDY = "Do not open the file. Ask for the PDF that px4fuse wrote."


@dataclass(frozen=True)
class GradeOutcome:
    """Result of grading a class.

    Attributes
    ----------
    entries : tuple of Entry
        Rows of the class list, then rows of unknown students; without the redrawn PDFs.
    notes : tuple of str
        Sentences about ignored files, overrides and grades.
    reused_count : int
        Number of reports whose stored verification was loaded.
    written_paths : tuple of Path
        Files and folders that were written.
    """

    entries: tuple[Entry, ...]
    notes: tuple[str, ...]
    reused_count: int
    written_paths: tuple[Path, ...]

    @property
    def reports(self) -> tuple[GradedReport, ...]:
        """All reports, grouped by student; the first one of each student counts."""
        return tuple(report for entry in self.entries for report in entry.reports)


def grade(
    paths: Sequence[Path],
    course: Course,
    output: Path,
    *,
    processes: int | None = None,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> GradeOutcome:
    """Grade all submissions of a class.

    Parameters
    ----------
    paths : sequence of Path
        PDFs, folders and zip files.
    output : Path
        Folder for the class table (``class.csv``, ``class.html``), redrawn ``reports/``,
        ``feedback/``, ``grades/`` for learning platforms, and ``records/``: stored verifications,
        which make a second run fast. ``overrides.csv`` in this folder is read.
    processes : int, optional
        Number of processes; by default one per core.
    progress : callable
        Called with the number of finished submissions, and the number of all.

    Raises
    ------
    SettingsError
        No submission was found, or ``overrides.csv`` or a worksheet is not valid.
    OutputError
        The folder cannot be written.
    """
    overrides = read_overrides(output / OVERRIDES_NAME)
    for worksheet in course.worksheets:
        find_grade_column(worksheet, course.column)
    unread_names = sorted(
        file.name for file in output.glob("overrides*") if file.name != OVERRIDES_NAME
    )
    unread_notes = [
        f"{one_line(name, 80)} was not read; only {OVERRIDES_NAME} is read."
        for name in unread_names
    ]
    found_submissions, notes = submissions.find_submissions(paths)
    jobs = []
    for submission in found_submissions:
        student_index = course.register.student_index(submission.origin.person)
        owner_id = "" if student_index is None else course.register.people[student_index].student_id
        jobs.append((submission, owner_id))
    rules, logs = (course.rubric, course.key), files_by_sha256(course.logs)
    grade_job = partial(
        grade_submission, *rules, logs, output / RECORDS_FOLDER, max_log_bytes.get()
    )
    graded_by_index: dict[int, GradedReport] = {}
    reused_count = 0
    progress(0, len(found_submissions))
    with closing(run_bounded(grade_job, jobs, processes=processes)) as results:
        for index, result in results:
            if isinstance(result, JobFailure):
                graded_report = grade_unreadable(
                    *rules, f"grading failed: {result.reason}", FAILED_REMEDY
                )
                is_loaded = False
            else:
                graded_report, is_loaded = result
            submission = found_submissions[index]
            has_identity = graded_report.student or graded_report.student_id
            student = graded_report.student if has_identity else submission.origin.person.name
            graded_by_index[index] = replace(
                graded_report, submission=submission.name, student=student
            )
            reused_count += is_loaded
            progress(len(graded_by_index), len(found_submissions))
    graded = [graded_by_index[index] for index in range(len(found_submissions))]
    entries, override_notes = build_entries(graded, found_submissions, course, overrides)
    written_paths, class_notes = write_class(entries, course, output)
    return GradeOutcome(
        entries, (*notes, *unread_notes, *override_notes, *class_notes), reused_count, written_paths
    )


def grade_submission(
    rubric: Rubric,
    key: AnswerKey | None,
    logs: Mapping[str, Path],
    records: Path,
    max_bytes: int,
    job: tuple[Submission, str],
) -> tuple[GradedReport, bool]:
    """Read, verify and score one file, in a separate process.

    Returns
    -------
    GradedReport
    bool
        True if a stored verification was loaded.
    """
    max_log_bytes.set(max_bytes)
    submission, owner_id = job
    assigned_hashes = frozenset(answer.sha256 for answer in key.answers) if key else frozenset()
    sha256, is_loaded = "", False
    try:
        content = submissions.read(submission)
        sha256 = hashlib.sha256(content).hexdigest()
        results, verdict, is_loaded = load_or_verify(records, content, logs, assigned_hashes)
    except ResultsError as error:
        graded_report = grade_unreadable(rubric, key, f"{error.reason}.", error.remedy)
    else:
        graded_report = score_report(results, verdict, rubric, key, owner_id)
    return replace(graded_report, sha256=sha256), is_loaded
