"""Findings grouped by cause, their order, and notes on verdicts."""

from types import SimpleNamespace
from typing import Any

import pytest
from exchange import replace
from page_tools import words

from px4fuse.analysis import Analysis
from px4fuse.finding import Finding
from px4fuse.findings.model import (
    EFFECTS_BY_CAUSE,
    FINDING_TITLES,
    SOURCE_GAP_CAUSE,
    UNKNOWN_CAUSE,
    find_effect_ids,
    group_by_cause,
)
from px4fuse.report import consistency, terminal
from px4fuse.report.page import Page
from px4fuse.report.phrases import list_verdict_warnings


def one(name: str, severity: str = "warning", **evidence: str) -> Finding:
    return Finding(name, severity, f"{name}.", "Do.", evidence)  # type: ignore[arg-type]


def test_fault_table_contains_only_existing_fault_names() -> None:
    listed = {name for cause in EFFECTS_BY_CAUSE for name in find_effect_ids(cause)}
    assert listed | set(EFFECTS_BY_CAUSE) <= set(FINDING_TITLES)


def test_fault_table_lists_each_fault_after_its_effects() -> None:
    outer = list(EFFECTS_BY_CAUSE)
    for at, cause in enumerate(outer):
        assert set(find_effect_ids(cause)) & set(outer) <= set(outer[:at]), cause


UNDERSTATED, REJECTING = "ekf2_overconfident", "ekf2_rejects_positions"


@pytest.mark.parametrize(
    ("given", "told"),
    [
        # the finding that is the cause gets the severity of its consequence
        ([one(REJECTING, "error"), one(UNDERSTATED)],
         [(UNDERSTATED, "error", None), (REJECTING, "error", UNDERSTATED)]),
        # a wrong variance is a consequence of the cause in its evidence
        ([one("source_outliers"), one("kf_overconfident", cause="outliers")],
         [("source_outliers", "warning", None),
          ("kf_overconfident", "warning", "source_outliers")]),
        ([one("source_outliers"), one("kf_overconfident", cause="measurement noise")],
         [("source_outliers", "warning", None), ("kf_overconfident", "warning", None)]),
        # consequences of consequences
        ([one("source_outliers", "error"), one(UNDERSTATED, cause="outliers"), one(REJECTING)],
         [("source_outliers", "error", None), (UNDERSTATED, "warning", "source_outliers"),
          (REJECTING, "warning", UNDERSTATED)]),
        # jump and scale are consequences of changed noise; a jump's consequence follows the jump
        ([*map(one, ("source_noise_varies", "source_position_jump", "source_scale_error")),
          one("ekf2_resets", cause=UNKNOWN_CAUSE)],
         [("source_noise_varies", "warning", None),
          ("source_position_jump", "warning", "source_noise_varies"),
          ("ekf2_resets", "warning", "source_position_jump"),
          ("source_scale_error", "warning", "source_noise_varies")]),
        # resets follow the gap if all of them are at its end, else the rejections
        ([one("source_outliers", "error"), one(REJECTING), one("source_gap"),
          one("ekf2_resets", cause=SOURCE_GAP_CAUSE)],
         [("source_outliers", "error", None), (REJECTING, "warning", "source_outliers"),
          ("source_gap", "warning", None), ("ekf2_resets", "warning", "source_gap")]),
        ([one("source_outliers", "error"), one(REJECTING), one("ekf2_resets", cause=UNKNOWN_CAUSE)],
         [("source_outliers", "error", None), (REJECTING, "warning", "source_outliers"),
          ("ekf2_resets", "warning", REJECTING)]),
        # the severity of a KF variance does not raise that of advice
        ([one("sigma_z_too_large", "note"),
          one("kf_underconfident", "error", cause="measurement noise")],
         [("sigma_z_too_large", "note", None),
          ("kf_underconfident", "error", "sigma_z_too_large")]),
        # findings about the recording come before noises
        ([one("no_motion"), one("sigma_a_too_large", "error"), one("aid_innovation_bias", "note"),
          one("source_gap"), one("source_time_offset_changes", "error")],
         [("source_time_offset_changes", "error", None), ("source_gap", "warning", None),
          ("sigma_a_too_large", "error", None), ("no_motion", "warning", None),
          ("aid_innovation_bias", "note", None)]),
    ],
)  # fmt: skip
def test_fault_report_lists_consequences_after_their_cause(given: Any, told: Any) -> None:
    assert [(each.id, each.severity, each.caused_by) for each in group_by_cause(given)] == told


def test_consistency_verdict_warns_of_correlated_innovations(sample: Analysis) -> None:
    (white,) = list_verdict_warnings(sample)
    assert "Ljung-Box test, p < 0.001" in white
    assert "KF along down, lag-1 autocorrelation" in white


def test_report_pages_with_mean_nis_state_its_consistent_range(sample: Analysis) -> None:
    pages = [Page(), *consistency.draw_pages(sample, None)]
    terminal._write_details(pages[0], sample, SimpleNamespace(findings=()))
    assert all(
        "A filter is consistent if √(mean NIS) is 0.8 to 1.25" in words(page) for page in pages
    )


def test_consistency_verdict_of_white_innovations_has_no_warning(sample: Analysis) -> None:
    east = sample.axes["east"]
    fine = replace(east.filters["kf"], ljung_box_p=0.5)
    white = replace(east, filters={**east.filters, "kf": fine})
    assert list_verdict_warnings(replace(sample, axes={"east": white})) == []


def test_note_on_consistent_odometry_states_that_it_may_drift(sample: Analysis) -> None:
    turning = replace(sample.source, origin=replace(sample.source.origin, kind="vio"))
    assert "source may drift" in list_verdict_warnings(replace(sample, source=turning))[0]
