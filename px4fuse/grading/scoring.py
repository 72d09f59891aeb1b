"""Points by a rubric.

A report comes from a student; its results have been read strictly. A number that is not there gives
no points and a comment, never an exception.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from px4fuse.assignment.key import AnswerKey
from px4fuse.findings import SEVERITIES
from px4fuse.grading import checks_filter, checks_loop, checks_mistakes, checks_report
from px4fuse.grading.checks_filter import SIGMAS
from px4fuse.grading.evidence import Evidence, Scorer, reason_of, text_of
from px4fuse.grading.model import Item, Parameter, Rubric, RubricItem
from px4fuse.verification.model import Report, Verdict

# What verification has refuted, rather than what it could not look at
REFUTED: Mapping[str, str] = {
    "numbers differ": "your report's numbers are not those that its log gives",
    "other log": "the log of your report is not one of those that your instructor has",
}


@dataclass(frozen=True)
class Check:
    """What a rubric may ask for: how it is scored, and what it can be told."""

    score: Scorer
    parameters: Mapping[str, Parameter]


def _check(score: Scorer, **parameters: Parameter) -> Check:
    return Check(score, parameters)


def _share(default: float) -> Parameter:
    return Parameter("number", default, 0.0, 1.0)


# A check is a function above, its line here, and an item of rubric.toml that explains it
CHECKS: Mapping[str, Check] = {
    "verified": _check(checks_report.verified, without_log=_share(0.5)),
    "student": _check(
        checks_report.student, name=Parameter("flag", True), id=Parameter("flag", True)
    ),
    "sections": _check(
        checks_report.sections, results=Parameter("texts", ()), pages=Parameter("texts", ())
    ),
    "notes": _check(
        checks_report.notes,
        min_words=Parameter("whole", 150, 1, 100_000),
        min_different=Parameter("whole", 60, 1, 100_000),
    ),
    "findings": _check(
        checks_report.findings,
        severities=Parameter("texts", ("error", "warning"), choices=SEVERITIES),
        ignore=Parameter("texts", ("ekf2_unavailable",)),
    ),
    "tuning": _check(
        checks_filter.tuning,
        axis=Parameter("text", "horizontal"),
        settings=Parameter("texts", SIGMAS, choices=SIGMAS),
        factor=Parameter("number", 2.0, 1.0, 1000.0),
    ),
    "number": _check(
        checks_report.number_between,
        path=Parameter("texts", required=True),
        name=Parameter("text", ""),
        unit=Parameter("text", ""),
        at_least=Parameter("number"),
        at_most=Parameter("number"),
        zero_at=Parameter("number"),
    ),
    "consistent": _check(
        checks_filter.consistent,
        filter=Parameter("text", "kf", choices=("kf", "ekf2")),
        axes=Parameter("texts", ("horizontal",)),
        factor=Parameter("number", 1.5, 1.0, 1000.0),
    ),
    "clock": _check(
        checks_filter.clock,
        margin_s=Parameter("number", 0.03, 0.0, 10.0),
        undeterminable=_share(0.5),
    ),
    "loop": _check(checks_loop.loop, without_reference=_share(0.5)),
    "flight": _check(
        checks_report.flight,
        min_duration_s=Parameter("number", 60.0, 0.0, 1e5),
        min_measurements=Parameter("whole", 100, 0, 10_000_000),
        min_path_m=Parameter("number", 20.0, 0.0, 1e6),
    ),
    "mistakes": _check(
        checks_mistakes.mistakes, in_report=_share(0.25), most_named=Parameter("whole", 4, 1, 100)
    ),
}


# ------------------------------------------------------------------ points


def score(
    report: Report, verdict: Verdict, rubric: Rubric, key: AnswerKey | None
) -> tuple[Item, ...]:
    """Points for one report.

    Items for another kind of report are left out, and without an answer key those on mistakes.
    """
    evidence = Evidence(report, verdict, rubric.words, key)
    refuted = verdict.status in REFUTED and rubric.unverified == "zero"
    made = []
    for item in rubric.items:
        if not _applies(item, key, evidence.kind):
            continue
        if refuted:
            comment = f"No points, since {REFUTED[verdict.status]}{reason_of(verdict)}."
            made.append(Item(item.title, 0.0, item.points, comment))
            continue
        share, comment = CHECKS[item.check].score(evidence, item.parameters)
        made.append(
            Item(
                item.title,
                round(item.points * min(max(share, 0.0), 1.0), 2),
                item.points,
                comment[:1].upper() + comment[1:],
            )
        )
    return tuple(made)


def score_refused(rubric: Rubric, key: AnswerKey | None, reason: str) -> tuple[Item, ...]:
    """No points for what is no report, so that it stands in the table with the others."""
    comment = f"No points, since the file could not be read as a report: {text_of(reason)}"
    return tuple(
        Item(item.title, 0.0, item.points, comment)
        for item in rubric.items
        if _applies(item, key, "compare")
    )


def _applies(item: RubricItem, key: AnswerKey | None, kind: str) -> bool:
    return item.report in ("any", kind) and (item.check != "mistakes" or key is not None)
