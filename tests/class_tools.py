"""Classes made up for tests: reports under any name, exports of platforms, and grading at once."""

from __future__ import annotations

import json
import pickle
import zipfile
from collections.abc import Mapping
from contextvars import copy_context
from pathlib import Path

from conftest import REPORT, page_of

from px4fuse import workers
from px4fuse.grading import grade as grading
from px4fuse.grading import records
from px4fuse.grading.model import Entry, GradedReport, Item
from px4fuse.verification.model import Verdict
from px4fuse.verification.verification import log_sha256, verify

VERIFIED = Verdict("verified", ("the log gives every value again",), True, page_status="same")


def report_of(name: str, student_id: str, log: str = "") -> bytes:
    """The sample's report on an empty page, with another student and log in its results."""
    results = json.loads(REPORT.with_suffix(".json").read_text(encoding="utf-8"))
    results["student"] = {"name": name, "id": student_id, "notes": ""}
    if log:
        results["log"]["sha256"] = log
    return page_of(None, json.dumps(results))


def at_once(monkeypatch) -> list[str]:
    """Grade in this process, and believe every report whose log is there; gives what was verified.

    Bounds and verification have tests of their own, and take seconds per report.
    """
    asked: list[str] = []

    def believed(results, pdf, logs):
        asked.append(results.student.id)
        return VERIFIED if log_sha256(results) in logs else verify(results, pdf, logs)

    monkeypatch.setattr(records, "verify", believed)
    in_this_process(monkeypatch)
    return asked


def in_turn(function, jobs, **_):
    """One job after the other, in this process, whose limits stay as they are."""
    for index, job in enumerate(jobs):
        function_, job_ = pickle.loads(pickle.dumps((function, job)))
        yield index, pickle.loads(pickle.dumps(copy_context().run(function_, job_)))


def in_this_process(monkeypatch) -> None:
    """Do without the processes that keep what strangers wrote within bounds: each takes seconds.

    What goes to them and what comes back is pickled all the same.
    """

    for module in (grading, workers):
        monkeypatch.setattr(module, "run_bounded", in_turn)


def zipped(path: Path, entries: Mapping[str, bytes], date=(2026, 11, 20, 12, 0, 0)) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in entries.items():
            archive.writestr(zipfile.ZipInfo(name, date), content)
    return path


def graded(
    name: str, *points: float, student: str = "", student_id: str = "", **more
) -> GradedReport:
    """A report with items A, B, … of ten points each."""
    items = tuple(
        Item(chr(ord("A") + at), each, 10.0, "Because.") for at, each in enumerate(points)
    )
    values = {"sha256": name, "version": "0.2.0"} | more
    return GradedReport(name, student, student_id, VERIFIED, items, **values)


def entry(student_id: str, name: str, total: float | None, **more) -> Entry:
    one = None if total is None else graded(f"{student_id}.pdf", total, student_id=student_id)
    return Entry(name, student_id, one, total=total, **({"max_points": 10.0} | more))
