"""Artificial classes for tests: reports of any student, exports, grading in one process."""

from __future__ import annotations

import json
import pickle
import zipfile
from collections.abc import Mapping
from contextvars import copy_context
from pathlib import Path

from conftest import REPORT, blank_page

from px4fuse.classroom.grading import grade as grading
from px4fuse.classroom.grading.model import Grade, GradedReport, ItemScore
from px4fuse.core import workers
from px4fuse.verification.model import Verification
from px4fuse.verification.verification import log_sha256, verify

VERIFIED = Verification("verified", ("the log gives every value again",), True, page_status="same")


def make_report(name: str, student_id: str, log: str = "") -> bytes:
    """Return an empty page with the sample's results, for another student and log."""
    results = json.loads(REPORT.with_suffix(".json").read_text(encoding="utf-8"))
    results["student"] = {"name": name, "id": student_id, "notes": ""}
    if log:
        results["log"]["sha256"] = log
    return blank_page(None, json.dumps(results))


def skip_verification(monkeypatch) -> list[str]:
    """Grade in this process, accept each report with a known log; return the verified ids.

    Other tests cover limits and verification, which take seconds per report.
    """
    verified_ids: list[str] = []

    def verify_by_log(results, pdf, logs):
        verified_ids.append(results.student.id)
        return VERIFIED if log_sha256(results) in logs else verify(results, pdf, logs)

    monkeypatch.setattr(grading, "verify", verify_by_log)
    monkeypatch.setattr(
        grading, "repeat_analysis_with_diagnosis", lambda results, _: (results, b"PDF")
    )
    in_this_process(monkeypatch)
    return verified_ids


def run_in_turn(function, jobs, **_):
    """Run jobs one after the other in this process, in a copy of its context."""
    for index, job in enumerate(jobs):
        function_, job_ = pickle.loads(pickle.dumps((function, job)))
        yield index, pickle.loads(pickle.dumps(copy_context().run(function_, job_)))


def in_this_process(monkeypatch) -> None:
    """Run jobs in this process instead of workers with limits, which take seconds to start.

    Jobs and results are pickled nevertheless.
    """

    for module in (grading, workers):
        monkeypatch.setattr(module, "run_with_limits", run_in_turn)


def write_zip(path: Path, entries: Mapping[str, bytes], date=(2026, 11, 20, 12, 0, 0)) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in entries.items():
            archive.writestr(zipfile.ZipInfo(name, date), content)
    return path


def graded_report(
    name: str, *points: float, student: str = "", student_id: str = "", **more
) -> GradedReport:
    """Return a graded report with items A, B, … of 10 points each."""
    items = tuple(
        ItemScore(chr(ord("A") + at), each, 10.0, "Because.") for at, each in enumerate(points)
    )
    values = {"sha256": name, "version": "0.2.0"} | more
    return GradedReport(name, student, student_id, VERIFIED, items, **values)


def grade(student_id: str, name: str, total: float | None, **more) -> Grade:
    one = (
        None if total is None else graded_report(f"{student_id}.pdf", total, student_id=student_id)
    )
    return Grade(name, student_id, one, total=total, **({"max_points": 10.0} | more))
