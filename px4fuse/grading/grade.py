"""A folder of submissions becomes a class table: in parallel, within bounds, and resumable."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

from px4fuse.assignment.key import AnswerKey
from px4fuse.assignment.roster import RESERVED
from px4fuse.flight import Unavailable
from px4fuse.grading import submissions
from px4fuse.grading.class_page import html_text
from px4fuse.grading.class_table import csv_text
from px4fuse.grading.evidence import values_at
from px4fuse.grading.feedback import feedback, gradescope
from px4fuse.grading.flags import chosen_settings, class_flags, own_flags
from px4fuse.grading.model import Graded, Item, Rubric, Submission
from px4fuse.grading.scoring import score, score_refused
from px4fuse.grading.workers import Failed, run_bounded
from px4fuse.reading import files_by_sha256, max_log_bytes
from px4fuse.results.contract import Reported, to_plain
from px4fuse.verification.intake import read_report
from px4fuse.verification.model import Difference, PageDifference, Refused, Report, Verdict
from px4fuse.verification.pages import page_texts
from px4fuse.verification.pictures import key_page, picture
from px4fuse.verification.rerun import log_sha256
from px4fuse.verification.verification import verify
from px4fuse.writing import write_all

RECORDS = "records"
# Reports drawn again from their logs: what to read instead of what was handed in
REDRAWN = "reports"
# What a record keeps besides its JSON, by field of Graded
FILES = {"picture": ".png", "handed_in": ".handed-in.png", "redrawn": ".pdf"}
# Of one report: a flight of ten minutes takes about one; what takes longer is no report
TIMEOUT_S = 300.0
MEMORY_BYTES = 4_000_000_000
# For the class table: column title, and where in the results
NUMBERS = (
    ("SIGMA_A (m/s²)", "settings.sigma_a_m_s2"),
    ("SIGMA_Z (m)", "settings.sigma_z_m"),
    ("mean NIS north", "axes.north.kf.nis_mean"),
    ("mean NIS east", "axes.east.kf.nis_mean"),
    ("position RMSE to truth, aisle (m)", "axes.aisle.truth.kf_position_rmse_m"),
    ("closure error (m)", "loop.closure_error_m"),
)


@dataclass(frozen=True)
class Outcome:
    """What grading a class gave.

    Attributes
    ----------
    graded : tuple of Graded
        In the order of the submissions, without their pictures and redrawn reports.
    notes : tuple of str
        What was passed over.
    reused : int
        How many were not done again, since nothing of theirs has changed.
    written : tuple of Path
    """

    graded: tuple[Graded, ...]
    notes: tuple[str, ...]
    reused: int
    written: tuple[Path, ...]


def grade(
    paths: Sequence[Path],
    logs: Sequence[Path],
    rubric: Rubric,
    output: Path,
    *,
    key: AnswerKey | None = None,
    title: str = "Class",
    processes: int | None = None,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> Outcome:
    """Grade everything that was handed in.

    Parameters
    ----------
    paths : sequence of Path
        PDFs, folders and zip files.
    logs : sequence of Path
        Flight logs and folders of them; a report names its log by SHA-256.
    rubric : Rubric
    output : Path
        Folder for the class table (``class.csv``, ``class.html``), the redrawn ``reports/``,
        ``feedback/``, ``gradescope/`` and the records that make a second run quick.
    key : AnswerKey, optional
        Which mistakes each student's flight has.
    title : str
        Of the class page.
    processes : int, optional
        By default as many as there are cores.
    progress : callable
        Told how many submissions are done, and of how many.

    Raises
    ------
    SettingsError
        Nothing was handed in.
    OutputError
        The folder cannot be written.
    """
    found, notes = submissions.collect(paths)
    known = files_by_sha256(logs)
    records = output / RECORDS
    context = _context(rubric, key)
    graded: list[Graded | None] = [None] * len(found)
    todo: list[int] = []
    for index, submission in enumerate(found):
        graded[index] = _recalled(records, submission, context, known)
        if graded[index] is None:
            todo.append(index)
    reused = len(found) - len(todo)
    progress(reused, len(found))
    done = reused

    def on_done(position: int, result: Graded | Failed) -> None:
        nonlocal done
        index = todo[position]
        if isinstance(result, Failed):
            why = Refused(f"Grading it failed: {result.reason}")
            made = _refused(found[index], why, "", rubric, key)
        else:
            made = result
        _remember(records, found[index], context, made)
        graded[index] = _light(made)
        done += 1
        progress(done, len(found))

    run_bounded(
        partial(
            grade_one, logs=known, rubric=rubric, key=key, largest_log_bytes=max_log_bytes.get()
        ),
        [found[index] for index in todo],
        processes=processes or os.cpu_count() or 1,
        timeout_s=TIMEOUT_S,
        memory_bytes=MEMORY_BYTES,
        on_done=on_done,
        keep=False,
    )
    complete = [one for one in graded if one is not None]
    flags = class_flags(complete, key)
    complete = [
        replace(one, flags=(*one.flags, *flags.get(index, ())))
        for index, one in enumerate(complete)
    ]
    written = _write(output, complete, found, title)
    return Outcome(tuple(complete), (*notes, *_left_over(output, complete)), reused, written)


def grade_one(
    submission: Submission,
    logs: Mapping[str, Path],
    rubric: Rubric,
    key: AnswerKey | None,
    largest_log_bytes: int,
) -> Graded:
    """Read, verify and score one submission; runs in a process of its own, within bounds."""
    max_log_bytes.set(largest_log_bytes)
    content = submissions.read(submission)
    if isinstance(content, Refused):
        return _refused(submission, content, "", rubric, key)
    sha256 = hashlib.sha256(content).hexdigest()
    report = read_report(content, submission.name)
    if isinstance(report, Refused):
        return _refused(submission, report, sha256, rubric, key)
    log = log_sha256(report.results)
    # handed out and not among the logs: the instructor's gap, not another log
    missing = key is not None and key.of_log(log) is not None and log not in logs
    verdict = verify(report, {} if missing else logs)
    # what is shown and scored is the redrawn report, as far as there is one
    report = replace(report, pages=page_texts(verdict.redrawn or report.pdf))
    results = report.results
    page = _page_to_show(verdict, report)
    shown = picture(verdict.redrawn, page - 1) if verdict.redrawn else b""
    compare = verdict.pages or not verdict.redrawn
    handed_in = picture(report.pdf, page - 1) if compare else b""
    return Graded(
        submission=submission.name,
        student=results.student.name,
        student_id=results.student.id,
        verdict=replace(verdict, redrawn=b""),
        items=score(report, verdict, rubric, key),
        flags=(*_page_flags(verdict), *own_flags(results)),
        numbers=_numbers(results),
        sha256=sha256,
        log_sha256=log,
        version=results.provenance.px4fuse,
        settings=chosen_settings(results),
        notes=results.student.notes,
        picture=b"" if isinstance(shown, Unavailable) else shown,
        handed_in=b"" if isinstance(handed_in, Unavailable) else handed_in,
        page=page,
        redrawn=verdict.redrawn,
    )


def _page_to_show(verdict: Verdict, report: Report) -> int:
    """The page that differs most, else the cover; counted from 1."""
    if verdict.pages:
        return max(verdict.pages, key=lambda one: (one.picture, one.words)).page
    return 1 + (0 if verdict.redrawn else key_page(report.pages))


def _page_flags(verdict: Verdict) -> tuple[str, ...]:
    if not verdict.pages:
        return ()
    first, *others = verdict.pages
    more = f" Also: page {', '.join(str(one.page) for one in others)}." if others else ""
    return (
        f"Page {first.page} of the PDF that was handed in is not what px4fuse draws from the log: "
        f"{first.what}.{more} Read the redrawn report.",
    )


def _numbers(results: Reported) -> dict[str, float]:
    plain = to_plain(results)
    return {title: float(value) for title, path in NUMBERS for _, value in values_at(plain, path)}


def _refused(
    submission: Submission, why: Refused, sha256: str, rubric: Rubric, key: AnswerKey | None
) -> Graded:
    student, student_id = submissions.guess_student(submission.name)
    verdict = Verdict("cannot verify", (why.reason,), with_log=False)
    items = score_refused(rubric, key, why.reason)
    return Graded(submission.name, student, student_id, verdict, items, sha256=sha256)


# ------------------------------------------------------------------ records of earlier runs


def _context(rubric: Rubric, key: AnswerKey | None) -> str:
    """Hash of what all results depend on besides the submission and its log."""
    made_with = [metadata.version(name) for name in ("px4fuse", "numpy", "scipy", "matplotlib")]
    text = json.dumps([made_with, repr(rubric), repr(key)])
    return hashlib.sha256(text.encode()).hexdigest()


def _record(records: Path, submission: Submission) -> Path:
    # not by the name of the file: platforms put everyone's report.pdf into a folder of its own
    name = hashlib.sha256(f"{submission.name}\0{submission.entry}".encode()).hexdigest()
    return records / f"{name}.json"


def _recalled(
    records: Path, submission: Submission, context: str, logs: Mapping[str, Path]
) -> Graded | None:
    """What an earlier run found, if nothing that it rests on has changed."""
    path = _record(records, submission)
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        made = graded_from(record["graded"])
    except (OSError, ValueError, KeyError, TypeError):  # none, or not one of ours: done again
        return None
    content = submissions.read(submission)
    sha256 = "" if isinstance(content, Refused) else hashlib.sha256(content).hexdigest()
    same = record.get("context") == context and made.sha256 == sha256 != ""
    if not same or made.submission != submission.name:
        return None
    return made if made.verdict.with_log == (made.log_sha256 in logs) else None


def _remember(records: Path, submission: Submission, context: str, made: Graded) -> None:
    path = _record(records, submission)
    values = asdict(_light(made))
    for name in FILES:
        del values[name]
    del values["verdict"]["redrawn"]
    text = json.dumps({"context": context, "graded": values}, ensure_ascii=False, indent=1)
    kept = {path.with_suffix(end): getattr(made, name) for name, end in FILES.items()}
    write_all({path: text.encode(), **kept})


def _light(made: Graded) -> Graded:
    """Without what a record keeps in files of their own."""
    return replace(made, picture=b"", handed_in=b"", redrawn=b"")


def graded_from(values: dict[str, Any]) -> Graded:
    """A record's part back as what it was."""
    verdict = values["verdict"]
    return Graded(
        **{
            **values,
            "verdict": Verdict(
                **{
                    **verdict,
                    "reasons": tuple(verdict["reasons"]),
                    "differences": tuple(Difference(**d) for d in verdict["differences"]),
                    "pages": tuple(PageDifference(**page) for page in verdict["pages"]),
                }
            ),
            "items": tuple(Item(**item) for item in values["items"]),
            "flags": tuple(values["flags"]),
            "to_read": tuple((why, passage) for why, passage in values["to_read"]),
        }
    )


# ------------------------------------------------------------------ outputs


def _write(
    output: Path, graded: Sequence[Graded], found: Sequence[Submission], title: str
) -> tuple[Path, ...]:
    made_with = f"px4fuse {metadata.version('px4fuse')}"
    names = file_names(graded)
    pictured = []
    for one, submission, name in zip(graded, found, names, strict=True):
        path = _record(output / RECORDS, submission)
        shown, handed_in, redrawn = (_content(path.with_suffix(end)) for end in FILES.values())
        if redrawn:
            write_all({output / REDRAWN / f"{name}.pdf": redrawn})
        where = f"{REDRAWN}/{name}.pdf" if redrawn else ""
        pictured.append(replace(one, picture=shown, handed_in=handed_in, redrawn_name=where))
    table, page = output / "class.csv", output / "class.html"
    write_all(
        {
            table: csv_text(graded).encode(),
            page: html_text(pictured, title, made_with).encode(),
        }
    )
    for one, name in zip(graded, names, strict=True):
        results = json.dumps(gradescope(one), ensure_ascii=False, indent=2)
        write_all(
            {
                output / "feedback" / f"{name}.txt": feedback(one, title).encode(),
                output / "gradescope" / name / "results.json": results.encode(),
            }
        )
    reports = [output / REDRAWN] if any(one.redrawn_name for one in pictured) else []
    return table, page, *reports, output / "feedback", output / "gradescope"


def _left_over(output: Path, graded: Sequence[Graded]) -> tuple[str, ...]:
    """What an earlier run wrote for others: never taken away, but told."""
    names = set(file_names(graded))
    others = sorted(p.stem for p in (output / "feedback").glob("*.txt") if p.stem not in names)
    if not others:
        return ()
    shown = ", ".join(others[:4]) + (", ..." if len(others) > 4 else "")
    return (
        f"feedback and gradescope also hold {len(others)} of an earlier run, which are not among "
        f"these submissions: {shown}. Delete them if they are out of date.",
    )


def _content(path: Path) -> bytes:
    return path.read_bytes() if path.is_file() else b""


def file_names(graded: Sequence[Graded]) -> list[str]:
    """A name for each submission's files, unique ignoring case: letters, digits, - and _ only."""
    taken: set[str] = set()
    names = []
    for one in graded:
        stem = one.student_id or Path(one.submission).stem
        safe = "".join(c if c.isascii() and (c.isalnum() or c in "-_") else "_" for c in stem)[:60]
        if not safe or safe.casefold() in RESERVED:
            safe = f"report_{safe}"
        name, number = safe, 2
        while name.lower() in taken:
            name, number = f"{safe}-{number}", number + 1
        taken.add(name.lower())
        names.append(name)
    return names
