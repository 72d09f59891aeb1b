"""One finding per cause, advice for what nobody chose, and the order in which causes are told."""

from typing import Any

import pytest
from exchange import replace

from px4fuse.analysis import Analysis
from px4fuse.findings import NAMES, Finding, causes
from px4fuse.findings.causes import CONSEQUENCES, NOISES, RECORDING, group_by_cause
from px4fuse.report.words import verdict_notes


def one(name: str, severity: str = "warning", **evidence: str) -> Finding:
    return Finding(name, severity, f"{name}.", "Do.", evidence)  # type: ignore[arg-type]


def test_the_table_knows_only_findings_that_there_are() -> None:
    listed = {name.split(":")[0] for names in CONSEQUENCES.values() for name in names}
    assert listed | set(CONSEQUENCES) | NOISES | RECORDING <= set(NAMES)
    kinds = {name.partition(":")[2] for names in CONSEQUENCES.values() for name in names}
    assert kinds - {""} <= {value for name, value in vars(causes).items() if name.isupper()
                            and isinstance(value, str)}  # fmt: skip


def test_the_table_has_inner_causes_before_outer_ones() -> None:
    outer = list(CONSEQUENCES)
    for at, cause in enumerate(outer):
        inner = {name.split(":")[0] for name in CONSEQUENCES[cause]} & set(outer)
        assert inner <= set(outer[:at])


UNDERSTATED, REJECTING = "ekf2_variance_understated", "ekf2_rejecting"


@pytest.mark.parametrize(
    ("given", "told"),
    [
        # the cause is as severe as what it brings with it
        ([one(REJECTING, "error"), one(UNDERSTATED)],
         [(UNDERSTATED, "error", None), (REJECTING, "error", UNDERSTATED)]),
        # a variance follows from what its evidence names
        ([one("source_outliers"), one("kf_variance_understated", cause="outliers")],
         [("source_outliers", "warning", None),
          ("kf_variance_understated", "warning", "source_outliers")]),
        ([one("source_outliers"), one("kf_variance_understated", cause="measurement noise")],
         [("source_outliers", "warning", None), ("kf_variance_understated", "warning", None)]),
        # so does what follows from a consequence
        ([one("source_outliers", "error"), one(UNDERSTATED, cause="outliers"), one(REJECTING)],
         [("source_outliers", "error", None), (UNDERSTATED, "warning", "source_outliers"),
          (REJECTING, "warning", UNDERSTATED)]),
        # jump and scale are judged by one noise; what a jump brings with it stays behind it
        ([*map(one, ("source_noise_changes", "source_jumps", "source_scale_wrong", "ekf2_resets"))],
         [("source_noise_changes", "warning", None),
          ("source_jumps", "warning", "source_noise_changes"),
          ("ekf2_resets", "warning", "source_jumps"),
          ("source_scale_wrong", "warning", "source_noise_changes")]),
        # the size of our variance does not make advice an error
        ([one("sigma_z_large", "info"),
          one("kf_variance_overstated", "error", cause="measurement noise")],
         [("sigma_z_large", "info", None), ("kf_variance_overstated", "error", "sigma_z_large")]),
        # what the recording lacks comes before noises
        ([one("no_motion"), one("sigma_a_large", "error"), one("ekf2_resets", "info"),
          one("source_gap"), one("source_clock_changes", "error")],
         [("source_clock_changes", "error", None), ("source_gap", "warning", None),
          ("sigma_a_large", "error", None), ("no_motion", "warning", None),
          ("ekf2_resets", "info", None)]),
    ],
)  # fmt: skip
def test_what_a_cause_brings_with_it_is_told_behind_it(given: Any, told: Any) -> None:
    assert [(each.id, each.severity, each.caused_by) for each in group_by_cause(given)] == told


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
