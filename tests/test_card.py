"""Diagnosis card: order of causes, improvements, actions, and a flight without a fault."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import findings_tools
import pytest
from cards import verdicts
from comparisons import compare
from exchange import replace

from px4fuse.analysis import Analysis
from px4fuse.card.build import (
    _describe_kf_settings,
    _explain_verdict_differences,
    _format_actions,
    build_card,
    build_unusable_log_card,
)
from px4fuse.card.causes import _find_action_target, make_cause, rank_causes
from px4fuse.card.model import Action, DiagnosedCause, Note, Verdict
from px4fuse.comparison.model import ErrorsAgainstTruth
from px4fuse.comparison.rerun_effects import Rerun, RunStatistics, classify_improvement
from px4fuse.diagnose import diagnose_comparison
from px4fuse.errors import LogError
from px4fuse.filter.settings import Settings
from px4fuse.finding import Finding
from px4fuse.flight.model import AS_RECEIVED_ORIGIN, GNSS_ORIGIN
from px4fuse.readers import read_log
from px4fuse.report.card_text import format_card_lines
from px4fuse.request import ComparisonRequest
from px4fuse.simulation.faults import parse_faults
from px4fuse.simulation.flights import simulate_flight
from px4fuse.simulation.scenario import Scenario

REQUEST = ComparisonRequest(log="a.ulg")
CHANGES = {
    "time offset": {"clock_offset_s": -0.2},
    "noises": {"sigma_z_m": 0.3},
    "delay": {"EKF2_EV_DELAY": 200.0},
    "process noise": {"EKF2_ACC_NOISE": 0.7},
}


def outcome(
    source: float, truth: float | None = None, rmse_m: float | None = None
) -> RunStatistics:
    """Return the result of a filter run with these σ ratios (actual over reported)."""
    nees = None if truth is None else truth**2
    return RunStatistics(
        innovations=600, nis_mean=source**2, nees_mean=nees, position_rmse_m=rmse_m
    )


FLOWN = outcome(1.0, 3.0, 0.3)
CORRECTED = outcome(1.0, 1.1, 0.1)


def trial(
    kind: str, after: RunStatistics, before: RunStatistics = FLOWN, owner: Any = "kf"
) -> Rerun:
    change = CHANGES[kind]
    return Rerun(
        filter=owner, axis="aisle", kinds=(kind,), change=change, before=before, after=after
    )


def analysis(*trials: Rerun) -> Any:
    source = SimpleNamespace(origin=AS_RECEIVED_ORIGIN, alignment=None, clock_map=None)
    model = SimpleNamespace(inputs=SimpleNamespace(settings={"EKF2_ACC_NOISE": 0.35}))
    return SimpleNamespace(
        select_main_reruns=lambda: trials,
        settings=Settings(),
        source=source,
        tuning={},
        ekf2_model=model,
    )


OFFSET = Finding("source_time_offset", "error", "Timestamps are late.", "Subtract 0.2 s.", {})
NOISE = Finding("sigma_z_too_small", "error", "SIGMA_Z is too small.", "", {})


def test_diagnosis_lists_sensor_fault_before_wrong_parameter() -> None:
    flight = analysis(trial("noises", outcome(1.0, 1.0, 0.1)), trial("time offset", CORRECTED))
    ranked = rank_causes(flight, [NOISE, OFFSET])
    assert [(each.finding.id, each.rank) for each in ranked] == [
        ("source_time_offset", 1), ("sigma_z_too_small", 1),
    ]  # fmt: skip
    # the setting reduces the error more, but a source fault comes first
    assert ranked[1].ln_sigma_ratio_reduction > ranked[0].ln_sigma_ratio_reduction


@pytest.mark.parametrize(
    ("after", "improves"),
    [
        (CORRECTED, "position and σ"),
        (outcome(1.0, 3.0, 0.2), "position"),
        (outcome(1.0, 1.0, 0.29), "σ only"),
        (outcome(1.0, 2.9, 0.29), "nothing"),
        (outcome(0.3, 1.0, 0.29), "nothing"),  # the σ ratio against the source becomes worse
    ],
)
def test_rerun_is_classified_by_better_rmse_and_reported_sigma(after, improves) -> None:
    assert classify_improvement(trial("noises", after)) == improves


def test_setting_without_improvement_in_rerun_is_not_recommended() -> None:
    helps, fails = trial("time offset", CORRECTED), trial("delay", FLOWN, owner="ekf2")
    (ranked,) = rank_causes(analysis(helps, fails), [OFFSET])
    cause = make_cause(analysis(helps, fails), ranked, (), REQUEST)
    assert [rerun.improves for rerun in cause.reruns] == ["position and σ", "nothing"]
    assert [action.target for action in cause.actions] == ["sender", "KF"]
    assert cause.actions[1].commands == ("px4fuse compare a.ulg --clock-offset -0.2",)
    assert rank_causes(analysis(trial("time offset", FLOWN), fails), [OFFSET]) == []


def test_advised_clock_offset_is_applied_offset_plus_correction() -> None:
    flight = analysis(trial("time offset", CORRECTED))
    flight.source.alignment = SimpleNamespace(clock_offset_s=-1795287249.945)
    (ranked,) = rank_causes(flight, [OFFSET])
    (command,) = make_cause(flight, ranked, (), REQUEST).actions[1].commands
    assert command == "px4fuse compare a.ulg --clock-offset -1795287250.145"


def test_diagnosis_without_ground_truth_still_lists_time_offset() -> None:
    """Innovations hardly show a time offset, so the re-run cannot refute it."""
    flight = analysis(trial("time offset", outcome(0.98), outcome(1.0)))
    (ranked,) = rank_causes(flight, [OFFSET])
    cause = make_cause(flight, ranked, (), REQUEST)
    assert cause.reruns == ()
    assert [action.target for action in cause.actions] == ["sender", "KF"]
    assert cause.actions[1].commands == ("px4fuse compare a.ulg --clock-offset -0.2",)
    assert rank_causes(analysis(trial("noises", outcome(0.98), outcome(1.0))), [NOISE]) == []


def test_diagnosis_advises_parameter_that_makes_rerun_consistent() -> None:
    vibration = Finding("ekf2_overconfident", "error", "EKF2 is overconfident.", "Check.", {})
    helps = trial("process noise", CORRECTED, owner="ekf2")
    for trials, commands in (((helps,), ("param set EKF2_ACC_NOISE 0.7",)), ((), ())):
        flight = analysis(*trials)
        (ranked,) = rank_causes(flight, [vibration])
        (action,) = make_cause(flight, ranked, (), REQUEST).actions
        assert action.commands == commands
        assert action.sentence == ("EKF2_ACC_NOISE 0.35 → 0.7 m/s²" if trials else "Check.")
    fails = trial("process noise", FLOWN, owner="ekf2")
    assert rank_causes(analysis(fails), [vibration])[0].reruns == ()


def test_diagnosis_merges_equal_actions_for_kf_and_ekf2() -> None:
    ratios = [(3.0, "overconfident")] * 4
    gap = Finding("source_gap", "warning", "No position for 8 s.", "Check the link.", {})
    flight = analysis()
    (ranked,) = rank_causes(flight, [gap])
    cause = make_cause(flight, ranked, verdicts(*ratios), REQUEST)
    assert [(action.target, action.sentence) for action in cause.actions] == [
        ("sender", "Check the link."), ("KF, EKF2", "no filter setting corrects this fault"),
    ]  # fmt: skip


def test_position_lag_explains_ekf2_verdict_at_any_place() -> None:
    errors = ErrorsAgainstTruth(count=9, position_rmse_m=0.1, nees_position_horizon_mean=1.0)
    flown: Any = SimpleNamespace(
        source=SimpleNamespace(origin=AS_RECEIVED_ORIGIN),
        main=SimpleNamespace(filters={"ekf2": SimpleNamespace(truth=errors)}),
    )
    names: Any = (("ekf2", "source"), ("ekf2", "truth"), ("kf", "truth"))
    given = tuple(
        Verdict(filter=name, against=against, ratio=2.0, word="overconfident")
        for name, against in names
    )
    marked, _ = _explain_verdict_differences(flown, given, ())
    assert [(each.filter, each.against) for each in marked if each.is_explained] == [
        ("ekf2", "truth")
    ]


def test_diagnosis_without_ground_truth_is_reported_as_untested() -> None:
    ratios = verdicts(*[(1.0, "consistent")] * 4)
    untested = tuple(each for each in ratios if each.against == "source")
    (ranked,) = rank_causes(analysis(), [OFFSET])
    for evaluated, reason in (
        (ratios, "keep the settings: the reported σ is consistent"),
        (
            untested,
            "keep the settings: only ground truth shows this fault, but the log has none",
        ),
    ):
        cause = make_cause(analysis(), ranked, evaluated, REQUEST)
        assert cause.actions[-1] == Action("KF, EKF2", reason)


def test_diagnosis_of_unreadable_log_shows_first_bytes_of_file(tmp_path) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(b"\xa3\x95\x80\x01" * 300)
    with pytest.raises(LogError) as caught:
        read_log(path)
    card = build_unusable_log_card(caught.value, path)
    lines = [text for line in format_card_lines(card) for text in line.wrap(100)]
    assert lines == [
        "error[log_unreadable]: a.bin: the file is an ArduPilot DataFlash log, not a PX4 ULog",
        "  read     1,200 bytes; first bytes A3 95 80 01 (of a ULog: 55 4C 6F 67)",
        "  fix      Give the MAVLink recording (.tlog) of the ground station.",
        "No file was written. Exit code 2.",
    ]
    missing = build_unusable_log_card(LogError("b.ulg: cannot be read"), tmp_path / "b.ulg")
    assert missing.facts == {}


def test_diagnosis_of_clean_flight_advises_no_change(sample: Analysis) -> None:
    card = build_card(replace(sample, findings=()), REQUEST)
    assert (card.severity, card.id, card.causes) == ("clean", "", ())
    assert card.headline == "No fault found: KF and EKF2 are consistent"
    assert card.do_this == ("Change nothing.",)


def test_diagnosis_without_fault_lists_actions_as_optional() -> None:
    noise = Note("sigma_a_too_large", "", "Set SIGMA_A to 0.1 m/s² (--sigma-a 0.1).")
    kept_noise = Note("kf_underconfident", "", "Do not reduce noise settings.")
    expected = ("Optional: set SIGMA_A to 0.1 m/s² (--sigma-a 0.1).",)
    assert _format_actions((), (kept_noise, noise)) == expected
    assert _format_actions((), (kept_noise,)) == ("Change nothing.",)


def test_diagnosis_omits_actions_that_advise_no_change() -> None:
    sender = Action("sender", "Remove outliers before sending.")
    kept = Action("EKF2", "keep the settings: EKF2's gate rejects these outliers")
    no_option = Action("KF", "no option makes KF reject outliers")
    cause = DiagnosedCause(
        id="source_outliers", severity="error", title="Outliers", why="",
        actions=(sender, kept, no_option),
    )  # fmt: skip
    assert _format_actions((cause,), ()) == ("Sender: remove outliers before sending.",)


def test_kf_measurement_noise_text_names_px4_default_parameter() -> None:
    gnss = findings_tools.analysis(source=findings_tools.source(origin=GNSS_ORIGIN))
    _, changed = _describe_kf_settings(gnss, ComparisonRequest(log="a.ulg", sigma_z_m=0.1))
    assert changed == ("--sigma-z 0.1 (default from EKF2_GPS_P_NOISE)",)


@pytest.mark.parametrize(
    ("remedy", "target"),
    [("Check EKF2_EV_DELAY.", "EKF2"), ("Correct the timestamps at the sender.", "sender")],
)
def test_advice_that_names_ekf2_ev_delay_is_assigned_to_ekf2(remedy: str, target: str) -> None:
    delay = findings_tools.made(Finding, id="ekf2_ev_delay_wrong", remedy=remedy)
    assert _find_action_target(delay) == target


def test_diagnosis_explains_differing_nis_and_nees_verdicts() -> None:
    flight = simulate_flight(Scenario(seed=8), parse_faults(("ekf2-delay=0.25",)))
    explained = diagnose_comparison(compare(flight, Settings()))
    card = build_card(explained, REQUEST)
    assert (card.id, card.causes[0].reruns[0].improves) == (
        "ekf2_ev_delay_wrong",
        "position and σ",
    )
    assert card.reconcile == (
        "The main fault hardly changes the innovations of EKF2, but it increases the errors "
        "against ground truth. A re-run without the main fault reduces the position error."
    )
