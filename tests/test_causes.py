"""One finding per cause, advice for what nobody chose, and the order in which causes are told."""

from __future__ import annotations

import re
from pathlib import Path

from exchange import replace

from px4fuse.analysis import Analysis
from px4fuse.findings import NAMES, Finding, causes
from px4fuse.findings.causes import CONSEQUENCES, NOISES, RECORDING, by_cause
from px4fuse.findings.model import WORDS
from px4fuse.report.words import verdict_notes


def one(name: str, severity: str = "warning", **evidence: str) -> Finding:
    return Finding(name, severity, f"{name}.", "Do.", evidence)  # type: ignore[arg-type]


def test_the_table_knows_only_findings_that_there_are() -> None:
    listed = {name.split(":")[0] for names in CONSEQUENCES.values() for name in names}
    assert listed | set(CONSEQUENCES) | NOISES | RECORDING <= set(NAMES)
    kinds = {name.partition(":")[2] for names in CONSEQUENCES.values() for name in names}
    assert kinds - {""} <= {value for name, value in vars(causes).items() if name.isupper()
                            and isinstance(value, str)}  # fmt: skip


def test_detectors_give_every_fact_that_the_words_name() -> None:
    files = Path(causes.__file__).parent.glob("*.py")
    source = "".join(path.read_text(encoding="utf-8") for path in files)
    for name, words in WORDS.items():
        for fact in set(re.findall(r"{(\w+)", str(words))) - set(words):
            assert re.search(rf'\b{fact}=|"{fact}"', source), (name, fact)


def test_what_a_cause_brings_with_it_is_told_behind_it() -> None:
    cause, effect = by_cause([one("ekf2_rejecting", "error"), one("ekf2_variance_understated")])
    assert (cause.id, cause.caused_by) == ("ekf2_variance_understated", None)
    assert (effect.id, effect.caused_by) == ("ekf2_rejecting", "ekf2_variance_understated")
    assert cause.severity == "error"  # as severe as what it brings with it


def test_a_variance_follows_from_what_its_evidence_names() -> None:
    outliers = one("source_outliers")
    for named, joined in (("outliers", True), ("measurement noise", False)):
        found = by_cause([outliers, one("kf_variance_understated", cause=named)])
        assert [each.caused_by for each in found] == [None, "source_outliers" if joined else None]


def test_the_table_has_inner_causes_before_outer_ones() -> None:
    outer = list(CONSEQUENCES)
    for at, cause in enumerate(outer):
        inner = {name.split(":")[0] for name in CONSEQUENCES[cause]} & set(outer)
        assert inner <= set(outer[:at])


def test_where_the_noise_changes_a_jump_and_a_scale_follow_from_it() -> None:
    """Both are judged by one noise; what a jump brings with it stays behind it."""
    names = ("source_noise_changes", "source_jumps", "source_scale_wrong", "ekf2_resets")
    found = by_cause(map(one, names))
    assert {each.id: each.caused_by for each in found} == {
        "source_noise_changes": None, "source_jumps": "source_noise_changes",
        "source_scale_wrong": "source_noise_changes", "ekf2_resets": "source_jumps",
    }  # fmt: skip


def test_consequences_of_consequences_are_told_too() -> None:
    found = by_cause(
        [
            one("source_outliers", "error"),
            one("ekf2_variance_understated", cause="outliers"),
            one("ekf2_rejecting"),
        ]
    )
    assert [(each.id, each.caused_by) for each in found] == [
        ("source_outliers", None), ("ekf2_variance_understated", "source_outliers"),
        ("ekf2_rejecting", "ekf2_variance_understated"),
    ]  # fmt: skip


def test_the_size_of_our_variance_does_not_make_advice_an_error() -> None:
    cause, _ = by_cause(
        [
            one("sigma_z_large", "info"),
            one("kf_variance_overstated", "error", cause="measurement noise"),
        ]
    )
    assert cause.severity == "info"


def test_what_the_recording_lacks_comes_before_noises() -> None:
    order = by_cause(
        [
            one("no_motion"), one("sigma_a_large", "error"), one("ekf2_resets", "info"),
            one("source_gap"), one("source_clock_changes", "error"),
        ]
    )  # fmt: skip
    assert [each.id for each in order] == [
        "source_clock_changes", "source_gap", "sigma_a_large", "no_motion", "ekf2_resets",
    ]  # fmt: skip


def test_verdicts_that_could_be_misread_have_a_sentence(sample: Analysis) -> None:
    small, white = verdict_notes(sample)
    assert "ours aisle overstated 1.09× in σ" in small
    assert "ours down p < 0.001" in white


def test_what_is_consistent_and_white_needs_no_words(sample: Analysis) -> None:
    east = sample.axes["east"]
    fine = replace(east.filters["kf"], ljung_box_p=0.5)
    white = replace(east, filters={**east.filters, "kf": fine})
    assert verdict_notes(replace(sample, axes={"east": white})) == []


def test_a_source_that_may_drift_is_said_to(sample: Analysis) -> None:
    turning = replace(sample.source, origin=replace(sample.source.origin, kind="vio"))
    assert "is not correct" in verdict_notes(replace(sample, source=turning))[0]
