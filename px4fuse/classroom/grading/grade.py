"""Grading of a class: verify and score all submitted reports in parallel, and write the output."""

import hashlib
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import msgspec
from msgspec import structs

from px4fuse.core.reading import hash_files, max_log_bytes
from px4fuse.core.text import shorten_to_line
from px4fuse.core.workers import JobFailure, run_with_limits
from px4fuse.core.writing import write_output_files
from px4fuse.errors import ResultsError
from px4fuse.readers.ulog_topics import shows_diagnosis_of_assignments
from px4fuse.results.contract import ReportedResults, find_file_hashes, to_json
from px4fuse.results.model import provenance
from px4fuse.results.reading import read_results
from px4fuse.verification.model import Verification
from px4fuse.verification.pdf_input import read_report
from px4fuse.verification.verification import PathBySha256, log_sha256, recompute_report, verify

from ..assignment.key import AnswerKey
from . import submissions
from .entries import OVERRIDES_NAME, Course, build_grades, read_overrides
from .model import Grade, GradedReport, Submission
from .outputs import (
    DIAGNOSIS_SUFFIX,
    RECORDS_FOLDER,
    REDRAWN_REPORT_SUFFIX,
    find_grade_column,
    write_grading_files,
)
from .rubric import Rubric, grade_unreadable_file, score_report

HARMFUL_FILE_REMEDY = (
    "Do not open the file: it may be harmful. Ask the student for the PDF that px4fuse wrote."
)


@dataclass(frozen=True)
class GradeOutcome:
    """Result of grading a class.

    Attributes
    ----------
    grades : tuple of Grade
        Grades of the students in the class list, then of unknown students.
    notes : tuple of str
        Sentences about ignored input, and grades that could not be entered.
    reused_count : int
        Number of reports that were verified in an earlier run.
    written_paths : tuple of Path
    """

    grades: tuple[Grade, ...]
    notes: tuple[str, ...]
    reused_count: int
    written_paths: tuple[Path, ...]

    @property
    def reports(self) -> tuple[GradedReport, ...]:
        return tuple(report for grade in self.grades for report in grade.reports)


def grade(
    paths: Sequence[Path],
    course: Course,
    output: Path,
    *,
    processes: int | None = None,
    progress: Callable[[int, int], None] = lambda *_: None,
) -> GradeOutcome:
    """Grade all submissions of a class.

    Parameters
    ----------
    paths : sequence of Path
        Submitted PDFs, and folders and zip files with PDFs.
    output : Path
        Folder for all outputs, and for ``overrides.csv`` with the instructor's points.
    processes : int, optional
        Number of processes; by default one per core.
    progress : callable
        Called with the number of finished submissions and the number of all submissions.

    Raises
    ------
    SettingsError
        No submission was found, or a table is not valid.
    OutputError
        The folder cannot be written.
    """
    overrides = read_overrides(output / OVERRIDES_NAME)
    # raise the errors of the tables before the long verification
    for worksheet in course.worksheets:
        find_grade_column(worksheet, course.grade_column_title)
    unread_file_notes = [
        f"{shorten_to_line(file.name, 80)} was ignored: px4fuse reads only {OVERRIDES_NAME}."
        for file in sorted(output.glob("overrides*"))
        if file.name != OVERRIDES_NAME
    ]
    found_submissions, notes = submissions.find_submissions(paths)
    reports, reused_count = _grade_submissions(
        found_submissions, course, output / RECORDS_FOLDER, processes, progress
    )
    grades, override_notes = build_grades(reports, course, overrides)
    written_paths, class_notes = write_grading_files(grades, course, output)
    all_notes = *notes, *unread_file_notes, *override_notes, *class_notes
    return GradeOutcome(grades, all_notes, reused_count, written_paths)


def _grade_submissions(
    found_submissions: Sequence[Submission],
    course: Course,
    verifications_folder: Path,
    processes: int | None,
    progress: Callable[[int, int], None],
) -> tuple[list[GradedReport], int]:
    """Verify and score submissions in parallel.

    Return the reports in the order of the submissions, and the number of reused verifications.
    """
    jobs = []
    for submission in found_submissions:
        student_index = course.class_list.find_student_index(submission.origin.person)
        submitter_id = (
            "" if student_index is None else course.class_list.people[student_index].student_id
        )
        jobs.append((submission, submitter_id))
    grade_job = partial(
        grade_submission,
        course.rubric,
        course.key,
        hash_files(course.logs),
        verifications_folder,
        max_log_bytes.get(),
    )
    report_by_index: dict[int, GradedReport] = {}
    reused_count = 0
    progress(0, len(found_submissions))
    with closing(run_with_limits(grade_job, jobs, process_count=processes)) as results:
        for index, result in results:
            if isinstance(result, JobFailure):
                reason = f"the grading of this file failed: {result.reason}"
                report = grade_unreadable_file(
                    course.rubric, course.key, reason, HARMFUL_FILE_REMEDY
                )
            else:
                report, is_loaded_from_cache = result
                reused_count += is_loaded_from_cache
            submission, student = found_submissions[index], report.student
            if not student and not report.student_id:  # use the name from the learning platform
                student = submission.origin.person.name
            report_by_index[index] = replace(
                report, submission=submission.name, student=student, origin=submission.origin
            )
            progress(len(report_by_index), len(found_submissions))
    return [report_by_index[index] for index in range(len(jobs))], reused_count


def grade_submission(
    rubric: Rubric,
    answer_key: AnswerKey | None,
    path_by_sha256: PathBySha256,
    verifications_folder: Path,
    max_bytes: int,
    job: tuple[Submission, str],
) -> tuple[GradedReport, bool]:
    """Read, verify and score a submitted report.

    Parameters
    ----------
    verifications_folder : Path
        Folder of earlier verifications.
    max_bytes : int
        Maximum size of a log.
    job : (Submission, str)
        Submitted file, and student id on the learning platform.

    Returns
    -------
    report : GradedReport
    is_loaded_from_cache : bool
        True if the result of an earlier verification was loaded.
    """
    max_log_bytes.set(max_bytes)
    submission, submitter_id = job
    assigned_hashes = (
        frozenset(answer.sha256 for answer in answer_key.answers) if answer_key else frozenset()
    )
    sha256, is_loaded_from_cache = "", False
    try:
        content = submissions.read_submission(submission)
        sha256 = hashlib.sha256(content).hexdigest()
        results, verification, is_loaded_from_cache = load_or_verify(
            verifications_folder, content, path_by_sha256, assigned_hashes
        )
    except ResultsError as error:
        graded_report = grade_unreadable_file(rubric, answer_key, f"{error.reason}.", error.remedy)
    else:
        graded_report = score_report(results, verification, rubric, answer_key, submitter_id)
    return replace(graded_report, sha256=sha256), is_loaded_from_cache


# ------------------------------------------------------------------ cache of verifications


@dataclass(frozen=True)
class VerificationRecord:
    """Result of the verification of a PDF, for the cache.

    Attributes
    ----------
    versions_and_files : dict
        Versions of libraries, and availability of input files by SHA-256.
    results : str
        Results (JSON) that are attached to the PDF.
    """

    versions_and_files: dict[str, str]
    results: str
    verification: Verification


def load_or_verify(
    verifications_folder: Path,
    pdf: bytes,
    path_by_sha256: PathBySha256,
    assigned_hashes: frozenset[str],
) -> tuple[ReportedResults, Verification, bool]:
    """Read and verify a report, or load the result of an earlier verification.

    Parameters
    ----------
    verifications_folder : Path
        Folder of earlier results.
    pdf : bytes
        Content of the submitted file.
    path_by_sha256 : mapping
        Logs and other input files.
    assigned_hashes : frozenset of str
        SHA-256 of the logs in the answer key.

    Returns
    -------
    results : ComparisonResults or LoopResults
        Results of the report.
    verification : Verification
    is_loaded_from_cache : bool
        True if an earlier result was loaded.

    Raises
    ------
    ResultsError
        The file is not a report.
    """
    record_path = verifications_folder / hashlib.sha256(pdf).hexdigest()
    loaded_verification = _load_verification(record_path, path_by_sha256, assigned_hashes)
    if loaded_verification is not None:
        return (*loaded_verification, True)
    results = read_report(pdf, "The file")
    versions_and_files = _collect_versions_and_files(
        to_json(results), path_by_sha256, assigned_hashes
    )
    if versions_and_files.get(log_sha256(results)) == "assigned":
        # The instructor did not give the assigned log. Pass no log to verify(), so that its status
        # is "cannot verify" and not "other log" (the student analysed a wrong log)
        path_by_sha256 = {}
    verification, diagnosis_pdf = verify(results, pdf, path_by_sha256), b""
    if verification.status == "verified" and log_sha256(results) in assigned_hashes:
        results, diagnosis_pdf = repeat_analysis_with_diagnosis(results, path_by_sha256)
    for suffix, content in (
        (REDRAWN_REPORT_SUFFIX, verification.redrawn_pdf),
        (DIAGNOSIS_SUFFIX, diagnosis_pdf),
    ):
        if content:
            write_output_files({record_path.with_suffix(suffix): content})
        else:  # delete the PDF of an earlier verification
            record_path.with_suffix(suffix).unlink(missing_ok=True)
    # the PDFs are stored as files only
    verification = replace(verification, redrawn_pdf=b"")
    record = VerificationRecord(versions_and_files, to_json(results), verification)
    write_output_files({record_path.with_suffix(".json"): msgspec.json.encode(record)})
    return results, verification, False


def _load_verification(
    record_path: Path, path_by_sha256: PathBySha256, assigned_hashes: frozenset[str]
) -> tuple[ReportedResults, Verification] | None:
    """Load an earlier verification; None if it is missing, unreadable or had other inputs."""
    try:
        content = record_path.with_suffix(".json").read_bytes()
        record = msgspec.json.decode(content, type=VerificationRecord)
        results = read_results(record.results.encode())
    except (OSError, ValueError, ResultsError):
        return None
    versions_and_files = _collect_versions_and_files(
        record.results, path_by_sha256, assigned_hashes
    )
    if record.versions_and_files != versions_and_files or not isinstance(results, ReportedResults):
        return None
    return results, record.verification


def repeat_analysis_with_diagnosis(
    results: ReportedResults, path_by_sha256: PathBySha256
) -> tuple[ReportedResults, bytes]:
    """Repeat the analysis and include the faults that were hidden from the student.

    Return results and report (PDF).
    """
    token = shows_diagnosis_of_assignments.set(True)
    try:
        outcome = recompute_report(results, path_by_sha256)
    finally:
        shows_diagnosis_of_assignments.reset(token)
    if isinstance(outcome, Verification):
        raise ResultsError(f"No diagnosis report for the student: {'; '.join(outcome.reasons)}.")
    diagnosed_results, draw = outcome
    return structs.replace(diagnosed_results, provenance=results.provenance), draw()


def _collect_versions_and_files(
    results: str, path_by_sha256: PathBySha256, assigned_hashes: frozenset[str]
) -> dict[str, str]:
    """Return library versions and input files, on which a stored verification depends.

    Keys are library names, and SHA-256 hashes of the input files. A file is "available" in the
    given files, "assigned" (not given, but assigned to a student) or "missing".
    """
    versions = provenance("")  # only the versions are used, not the command
    versions_and_files = {**versions.libraries, "px4fuse": versions.px4fuse}
    for sha256 in find_file_hashes(results):
        if sha256 in path_by_sha256:
            versions_and_files[sha256] = "available"
        else:
            versions_and_files[sha256] = "assigned" if sha256 in assigned_hashes else "missing"
    return versions_and_files
