"""Diagnosis card: order of causes, improvements, actions, and a flight without a fault."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from exchange import replace

from px4fuse.analysis import Analysis
from px4fuse.card.build import build_card
from px4fuse.card.causes import make_cause, rank_causes
from px4fuse.comparison.trials import RunStatistics, Trial, improvement
from px4fuse.filter.settings import Settings
from px4fuse.findings import Finding
from px4fuse.position_source import RECEIVED
from px4fuse.request import ComparisonRequest

REQUEST = ComparisonRequest(log="a.ulg")
CHANGES = {
    "time offset": {"clock_offset_s": -0.2},
    "noises": {"sigma_z_m": 0.3},
    "delay": {"EKF2_EV_DELAY": 200.0},
}


def outcome(
    source: float, truth: float | None = None, rmse_m: float | None = None
) -> RunStatistics:
    """Return an outcome with these ratios of actual to reported σ."""
    nees = None if truth is None else truth**2
    return RunStatistics(
        innovations=600, nis_mean=source**2, nees_mean=nees, position_rmse_m=rmse_m
    )


FLOWN = outcome(1.0, 3.0, 0.3)
CORRECTED = outcome(1.0, 1.1, 0.1)


def trial(
    kind: str, after: RunStatistics, before: RunStatistics = FLOWN, owner: Any = "kf"
) -> Trial:
    return Trial(filter=owner, kinds=(kind,), change=CHANGES[kind], before=before, after=after)


def analysis(*trials: Trial) -> Any:
    source = SimpleNamespace(origin=RECEIVED)
    return SimpleNamespace(trials=trials, settings=Settings(), source=source, tuning={})


OFFSET = Finding("source_time_offset", "error", "Timestamps are late.", "Subtract 0.2 s.", {})
NOISE = Finding("sigma_z_too_small", "error", "SIGMA_Z is too small.", "", {})


def test_rank_causes_puts_source_fault_before_wrong_setting() -> None:
    flight = analysis(trial("noises", outcome(1.0, 1.0, 0.1)), trial("time offset", CORRECTED))
    ranked = rank_causes(flight, [NOISE, OFFSET])
    assert [(each.finding.id, each.tier) for each in ranked] == [
        ("source_time_offset", 1), ("sigma_z_too_small", 1),
    ]  # fmt: skip
    # the larger reduction is that of the setting
    assert ranked[1].reduction > ranked[0].reduction


@pytest.mark.parametrize(
    ("after", "improves"),
    [
        (CORRECTED, "position and σ"),
        (outcome(1.0, 3.0, 0.2), "position"),
        (outcome(1.0, 1.0, 0.29), "σ only"),
        (outcome(1.0, 2.9, 0.29), "nothing"),
        (outcome(0.3, 1.0, 0.29), "nothing"),  # the ratio against the source gets worse
    ],
)
def test_filter_rerun_improvement_names_position_or_sigma(after, improves) -> None:
    assert improvement(trial("noises", after)) == improves


def test_correction_without_improvement_is_not_recommended() -> None:
    helps, fails = trial("time offset", CORRECTED), trial("delay", FLOWN, owner="ekf2")
    (ranked,) = rank_causes(analysis(helps, fails), [OFFSET])
    cause = make_cause(analysis(helps, fails), ranked, (), REQUEST)
    assert [rerun.improves for rerun in cause.reruns] == ["position and σ", "nothing"]
    assert [action.target for action in cause.actions] == ["sender", "KF"]
    assert cause.actions[1].commands == ("px4fuse compare a.ulg --clock-offset -0.2",)
    assert rank_causes(analysis(trial("time offset", FLOWN), fails), [OFFSET]) == []


def test_diagnosis_keeps_time_offset_cause_without_ground_truth() -> None:
    """Innovations hardly show a time offset, so the re-run cannot refute it."""
    flight = analysis(trial("time offset", outcome(0.98), outcome(1.0)))
    (ranked,) = rank_causes(flight, [OFFSET])
    cause = make_cause(flight, ranked, (), REQUEST)
    assert cause.reruns == ()
    assert [action.sentence for action in cause.actions] == [OFFSET.remedy]
    assert rank_causes(analysis(trial("noises", outcome(0.98), outcome(1.0))), [NOISE]) == []


def test_diagnosis_card_of_clean_flight_advises_no_change(sample: Analysis) -> None:
    card = build_card(replace(sample, findings=()), REQUEST)
    assert (card.severity, card.id, card.causes) == ("clean", "", ())
    assert card.headline == "No fault found: KF and EKF2 are consistent"
    assert card.do_this == ("Change nothing.",)
