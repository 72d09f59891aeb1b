"""Grading of a class: submissions are verified in parallel and within limits."""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from px4fuse.assignment.key import AnswerKey
from px4fuse.errors import ResultsError
from px4fuse.grading import submissions
from px4fuse.grading.entries import OVERRIDES_NAME, Course, class_entries, read_overrides
from px4fuse.grading.model import Entry, GradedReport, Submission
from px4fuse.grading.outputs import grade_column, write_class
from px4fuse.grading.records import RECORDS, load_or_verify
from px4fuse.grading.rubric import Rubric, assess, refused_report
from px4fuse.reading import files_by_sha256, max_log_bytes
from px4fuse.results.reading import one_line
from px4fuse.workers import JobFailure, run_bounded

FAILED = "Do not open the file. Ask for the PDF that px4fuse wrote."


@dataclass(frozen=True)
class GradeOutcome:
    """Result of grading a class.

    Attributes
    ----------
    entries : tuple of Entry
        Students of the class list, then others; without redrawn reports.
    notes : tuple of str
        Ignored files and other remarks.
    reused : int
        Number of reports whose stored verification was used, because nothing changed.
    written : tuple of Path
        Files and folders that were written.
    """

    entries: tuple[Entry, ...]
    notes: tuple[str, ...]
    reused: int
    written: tuple[Path, ...]

    @property
    def graded(self) -> tuple[GradedReport, ...]:
        """All files, those that count first, in the order of the entries."""
        return tuple(one for entry in self.entries for one in entry.files)


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
        Folder for the class table (``class.csv``, ``class.html``), the redrawn ``reports/``,
        ``feedback/``, ``grades/`` for learning platforms, and stored verifications, which make a
        second run fast. Its ``overrides.csv`` is read.
    processes : int, optional
        Number of processes; by default that of the cores.
    progress : callable
        Called with the number of finished submissions and of all.

    Raises
    ------
    SettingsError
        No submission was found, or a table is not valid.
    OutputError
        The folder cannot be written.
    """
    overrides = read_overrides(output / OVERRIDES_NAME)
    for sheet in course.worksheets:
        grade_column(sheet, course.column)
    unread_names = sorted(
        one.name for one in output.glob("overrides*") if one.name != OVERRIDES_NAME
    )
    unread_notes = [
        f"{one_line(name, 80)} was not read; only {OVERRIDES_NAME} is read."
        for name in unread_names
    ]
    found_files, notes = submissions.find_submissions(paths)
    jobs = []
    for submission in found_files:
        student_index = course.register.student_index(submission.origin.person)
        owner = "" if student_index is None else course.register.people[student_index].student_id
        jobs.append((submission, owner))
    rules, logs = (course.rubric, course.key), files_by_sha256(course.logs)
    scored = partial(grade_one, *rules, logs, output / RECORDS, max_log_bytes.get())
    graded_by_index: dict[int, GradedReport] = {}
    reused = 0
    progress(0, len(found_files))
    with closing(run_bounded(scored, jobs, processes=processes)) as work:
        for index, result in work:
            if isinstance(result, JobFailure):
                one = refused_report(*rules, f"grading failed: {result.reason}", FAILED)
                recalled = False
            else:
                one, recalled = result
            submission = found_files[index]
            known = one.student or one.student_id
            student = one.student if known else submission.origin.person.name
            graded_by_index[index] = replace(one, submission=submission.name, student=student)
            reused += recalled
            progress(len(graded_by_index), len(found_files))
    graded = [graded_by_index[index] for index in range(len(found_files))]
    entries, override_notes = class_entries(graded, found_files, course, overrides)
    written, class_notes = write_class(entries, course, output)
    return GradeOutcome(
        entries, (*notes, *unread_notes, *override_notes, *class_notes), reused, written
    )


def grade_one(
    rubric: Rubric,
    key: AnswerKey | None,
    logs: Mapping[str, Path],
    records: Path,
    largest_log_bytes: int,
    job: tuple[Submission, str],
) -> tuple[GradedReport, bool]:
    """Read, verify (or load the stored verification) and score one file, in a separate process."""
    max_log_bytes.set(largest_log_bytes)
    submission, owner_id = job
    handed_out = frozenset(answer.sha256 for answer in key.answers) if key else frozenset()
    sha256, recalled = "", False
    try:
        content = submissions.read(submission)
        sha256 = hashlib.sha256(content).hexdigest()
        results, verdict, recalled = load_or_verify(records, content, logs, handed_out)
    except ResultsError as error:
        one = refused_report(rubric, key, f"{error.reason}.", error.remedy)
    else:
        one = assess(results, verdict, rubric, key, owner_id)
    return replace(one, sha256=sha256), recalled
