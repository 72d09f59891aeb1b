"""Points of answer forms, compared with points given by hand; points of guesses."""

from __future__ import annotations

import dataclasses
import json
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from exchange import replace
from form_guesses import at_random, constants
from scipy.stats import spearmanr

from px4fuse.classroom.assignment.key import (
    CorrectFormAnswers,
    CorrectVerdict,
    InjectedFault,
    compute_form_answers,
)
from px4fuse.classroom.assignment.random_assignment import assign_random_flight
from px4fuse.classroom.grading.form_points import (
    FORM_PART_NAMES,
    POINTS_CONFIG,
    compute_form_points,
    find_accepted_corrections,
    find_panels_showing_fault,
)
from px4fuse.cli.simulate import simulate
from px4fuse.core.text import convert_nested
from px4fuse.results.answer_form import (
    FAULT_KINDS,
    REPORT_PANELS,
    UNITS_BY_CORRECTION,
    Answers,
    Choice,
    NamedFault,
)
from px4fuse.simulation import flights
from px4fuse.simulation.faults import FAULT_TYPES as SIMULATED
from px4fuse.simulation.faults import parse_faults
from px4fuse.simulation.scenario import Scenario, make_scenario

SHA256 = "a" * 64
LATE = InjectedFault("clock-offset", 0.2, 0.17, 0.23)
GAP = InjectedFault("dropout", 3.0, 2.55, 3.45, 50.0, 53.0)
TRUTH = CorrectFormAnswers(
    (LATE, GAP), 0.1, CorrectVerdict("overconfident", 2.0), CorrectVerdict("underconfident", 1.3),
    ("followed wrong positions", "dead-reckoned, then reset"), ("fused at the wrong time",),
    (0.5, (3.0, 7.0), -0.2),
)  # fmt: skip
RIGHT = Answers(
    log_sha256=SHA256,
    mistakes=(
        NamedFault(
            "clock-offset",
            190.0,
            "ms",
            "whole flight",
            None,
            None,
            "--clock-offset",
            -0.2,
            "s",
            "clock",
        ),
        NamedFault("dropout", 3.1, "s", "", 50.5, 53.0, "--start", 54.0, "s", "innovations"),
    ),
    verdict_kf="overconfident",
    verdict_ekf2="underconfident",
    ekf2_did=("followed wrong positions", "dead-reckoned, then reset"),
    quantities=(0.505, (3.0, 7.0), -0.2),
)
CLEAN = CorrectFormAnswers(
    (), 0.1, CorrectVerdict("consistent"), CorrectVerdict("consistent"), ("normal",),
    ("followed the positions",), (0.5, 0.1, 0.2),
)  # fmt: skip


def with_claim(**values: Any) -> Answers:
    """Return the correct form with another first fault."""
    first, second = RIGHT.mistakes
    return replace(RIGHT, mistakes=(replace(first, **values), second))


def with_false(*kinds: str) -> Answers:
    """Return the correct form with additional mistakes."""
    return replace(RIGHT, mistakes=(*RIGHT.mistakes, *map(NamedFault, kinds)))


def points_by_form_part(answers: Answers, truth: CorrectFormAnswers = TRUTH) -> dict[str, float]:
    return {part.title: part.points for part in compute_form_points(answers, truth).parts}


def parts(answers: Answers, truth: CorrectFormAnswers = TRUTH) -> list[float]:
    found = points_by_form_part(answers, truth)
    return [round(found.get(name, 0.0), 2) for name in FORM_PART_NAMES]


def test_answer_form_offers_correct_answers_for_each_fault() -> None:
    assert set(SIMULATED) == set(FAULT_KINDS) - {"none", "vio-drift"}
    assert set(POINTS_CONFIG["shows"]) | {"cover"} == set(REPORT_PANELS)
    for name in SIMULATED:
        offered = find_accepted_corrections(InjectedFault(name, 1.0, 0.85, 1.15, 10.0, 20.0), TRUTH)
        assert {cure for cure, _, _ in offered} <= set(UNITS_BY_CORRECTION)
        assert max(share for _, _, share in offered) == 1.0
        assert set(find_panels_showing_fault(name)) > {"cover"}


def test_correct_answer_form_earns_all_and_empty_form_no_points() -> None:
    assert points_by_form_part(RIGHT) == FULL
    assert parts(Answers(log_sha256=SHA256)) == [0.0] * 6
    assert compute_form_points(RIGHT, TRUTH).did_student_name_fault == {
        "clock-offset": True,
        "dropout": True,
    }


FULL = dict(zip(FORM_PART_NAMES, (30.0, 15.0, 10.0, 15.0, 15.0, 15.0), strict=True))


def test_feedback_reports_each_right_answer_that_was_not_given() -> None:
    assert not [each for each in compute_form_points(RIGHT, TRUTH).feedback if "you gave" in each]
    choice = Choice("Figure 1: injected fault", ("yaw", "gap", "delay", "gate", "jump"))
    truth = replace(TRUTH, choices=((choice, "c"), (choice, "e")))
    form = replace(RIGHT, verdict_kf="", ekf2_did=(), quantities=(0.5, (3.0, 8.0)), choices=("a",))
    feedback = "; ".join(compute_form_points(form, truth).feedback)
    assert "consistency of KF: 'overconfident' is right, you gave 'none'" in feedback
    assert "'dead-reckoned, then reset' is right, you gave none" in feedback
    assert "3, 7 is right, you gave 3, 8" in feedback
    assert "-0.2 is right, you gave 'none'" in feedback
    assert "'delay' is right, you gave 'yaw'" in feedback
    assert "'jump' is right, you gave 'none'" in feedback


DELAY = {"parameter": "EKF2_EV_DELAY", "value": 200.0, "value_unit": "ms"}
GATE = {"parameter": "EKF2_EVP_GATE", "value": 3.0, "value_unit": "sd"}
NO_FAULTS = {"mistakes": 0.0, "sizes": 0.0, "fault time and plot": 0.0, "correction": 0.0}
# A form, and its parts with reduced points
HALF_RIGHT: list[tuple[Answers, dict[str, float]]] = [
    # wrong sign: a third of the points for the size and the action of this fault
    (with_claim(size=-190.0, value=0.2), {"sizes": 10.0, "correction": 10.0}),
    (with_claim(size=140.0), {"sizes": 11.25}),
    (with_claim(size=900.0, value=-0.9), {"sizes": 7.5, "correction": 11.25}),
    (with_claim(panel="map"), {"fault time and plot": 7.5}),
    (with_claim(when=""), {"fault time and plot": 7.5}),
    (with_claim(**DELAY), {}),
    (with_claim(**GATE), {"correction": 7.5}),
    # similar fault: 0.4 of the kind, a third of the size, half of the time
    (with_claim(kind="ekf2-delay"), {"mistakes": 21.0, "sizes": 10.0, "fault time and plot": 7.5}),
    # each wrong fault costs 10 points
    (with_false("yaw"), {"mistakes": 20.0}),
    (with_false("yaw", "nlos", "scale"), NO_FAULTS),
    (replace(RIGHT, mistakes=(NamedFault("none"),)), NO_FAULTS),
    (replace(RIGHT, verdict_kf="consistent"), {"verdicts": 10.0}),
    (replace(RIGHT, verdict_ekf2="consistent"), {"verdicts": 10.0}),
    (replace(RIGHT, ekf2_did=("dead-reckoned, then reset",)), {"verdicts": 12.5}),
    (replace(RIGHT, quantities=(0.53, (3.0,), None)), {"numbers": 5.0}),
    (replace(RIGHT, quantities=(9.0, (), None)), {"verdicts": 7.5, "numbers": 0.0}),
]


@pytest.mark.parametrize(("answers", "less"), HALF_RIGHT)
def test_partly_correct_answer_form_has_partial_points(
    answers: Answers, less: dict[str, float]
) -> None:
    assert points_by_form_part(answers) == pytest.approx({**FULL, **less}, abs=0.01)


def test_fault_named_for_fault_free_flight_earns_no_points() -> None:
    none = Answers(log_sha256=SHA256, mistakes=(NamedFault("none"),))
    assert parts(none, CLEAN) == [40.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    assert compute_form_points(none, CLEAN).fraction == 0.4
    whole = replace(
        none, verdict_kf="consistent", verdict_ekf2="consistent", quantities=(0.5, 0.1, 0.2),
        ekf2_did=("followed the positions",),
    )  # fmt: skip
    assert compute_form_points(whole, CLEAN).fraction == 1.0
    assert parts(RIGHT, CLEAN)[:4] == [0.0] * 4


def test_loop_fault_named_without_its_size_earns_partial_points() -> None:
    landed = InjectedFault("open-end", 5.0, 4.25, 5.75, 60.0, None)
    truth = replace(CLEAN, mistakes=(landed,), quantities=())
    claim = NamedFault("open-end", None, "", "", 60.0, None, "--open", None, "", "loop")
    guess = Answers(log_sha256=SHA256, mistakes=(claim,))
    assert parts(guess, truth) == [30.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    measured = replace(guess, mistakes=(replace(claim, size=5.1, unit="m"),))
    assert parts(measured, truth)[:4] == [30.0, 15.0, 10.0, 15.0]


def test_guessed_answers_for_all_loop_flights_earn_few_points() -> None:
    """300 drawn loops with their closure errors and verdicts.

    Most have no update outside the gate, so an empty list is not counted as an answer.
    """
    rng = np.random.default_rng(7)
    truths = []
    for number in range(300):
        drawn = assign_random_flight(b"constant forms", f"s{number}", "loop")
        sizes = [float(typed.partition("=")[2].rstrip("m")) for typed in drawn.mistake_options]
        measured = [size + rng.normal(0.0, 0.4) for size in sizes]
        wrong = [InjectedFault("open-end", size, size - 0.3, size + 0.3, 65.0) for size in measured]
        verdicts = CorrectVerdict("underconfident", 7.0), CorrectVerdict("overconfident", 1.1)
        truths.append(
            CorrectFormAnswers(tuple(wrong), 0.01, *verdicts, ("normal",), (), (0.5, 0.1, ()))
        )
    for kind in ("open-end", "none"):
        for each in constants(truths, kind):
            form = replace(each, quantities=(None, None, ()))
            assert np.mean([compute_form_points(form, one).fraction for one in truths]) <= 0.36


def test_expected_loop_closure_error_includes_odometry_drift() -> None:
    """A student cannot separate the drift from the measured closure error."""
    scenario = Scenario(kind="loop", passes=1, vio_drift=0.02, seed=4, truth=False)
    (wrong,) = compute_form_answers(
        flights.simulate(scenario, parse_faults(("open-end=5m",))), SHA256
    ).mistakes
    assert wrong.size is not None
    assert wrong.low is not None
    assert 0.1 < abs(wrong.size - 5.0) < 1.5
    assert wrong.low == pytest.approx(wrong.size - 0.3)


# ------------------------------------------------------------------ forms with points by hand


def simulation_of(typed: str) -> flights.Simulation:
    """Simulate the flight of a px4fuse simulate command."""
    given = simulate.make_context("simulate", shlex.split(typed)[2:]).params
    names = {field.name for field in dataclasses.fields(Scenario)} - {"kind", "truth", "ekf2"}
    chosen = {name: given[name] for name in names if given.get(name) is not None}
    scenario = make_scenario(given["kind"], truth=not given["no_truth"], **chosen)
    return flights.simulate(scenario, parse_faults(given["fault_texts"]))


def answers_of(form: dict[str, Any]) -> Answers:
    form = convert_nested(
        form, lambda word: NEW_WORDS.get(word, word)
    )  # the forms use the values before schema 4
    claims = []
    for one in form["mistakes"] or []:
        when = one["when"]
        parameter = one["parameter"] if one["parameter"] in UNITS_BY_CORRECTION else ""
        unit = (
            one["value_unit"] if one["value_unit"] in UNITS_BY_CORRECTION.get(parameter, {}) else ""
        )
        claims.append(
            NamedFault(
                one["kind"], one["size"],
                one["unit"] * (one["unit"] != next(iter(FAULT_KINDS[one["kind"]].units), "")),
                "whole flight" if when["text"] == "whole flight" else "", when["from_s"],
                when["until_s"], parameter, distance(one["value"]), unit, one["where"]["panel"],
            )
        )  # fmt: skip
    return Answers(
        log_sha256=SHA256, mistakes=tuple(claims), verdict_kf=form["verdict_kf"],
        verdict_ekf2=form["verdict_ekf2"], ekf2_did=tuple(form["ekf2_did"]),
        quantities=tuple(to_tuple(one["given"]) for one in form["quantities"]),
    )  # fmt: skip


def distance(value: Any) -> Any:
    """Convert forward and right to a distance."""
    if isinstance(value, str):
        value = [float(part) for part in value.split(",")]
    return float(np.linalg.norm(value)) if isinstance(value, list) else value


def to_tuple(value: Any) -> Any:
    return tuple(map(float, value)) if isinstance(value, list) else value


# Answers before schema 4, in the forms of the study
NEW_WORDS = {
    "calibrate the magnetometer": "calibrate the compass",
    "verdict_ours": "verdict_kf",
    "ours": "kf",
    "overstated": "underconfident",
    "understated": "overconfident",
    "nothing unusual": "normal",
    "followed the wrong positions": "followed wrong positions",
    "rejected the bad samples": "rejected outliers",
    "coasted, then reset": "dead-reckoned, then reset",
    "trusted the positions too little": "weighted the positions too little",
    "error to truth": "error against ground truth",
    "why EKF2 differs": "differences KF - EKF2",
    "correct the stamps at the sender": "correct the timestamps at the sender",
    "multiply the positions at the sender": "scale the positions at the sender",
    "turn the positions at the sender": "rotate the positions at the sender",
    "one set of anchors": "use one set of anchors",
    "line of sight and link": "improve line of sight and link",
    "switch the smoothing off": "disable the low-pass filter",
}
VERDICT_WORDS = {
    "consistent": "consistent", "overstated": "underconfident", "understated": "overconfident",
}  # fmt: skip


def verdicts_by_hand(flight: dict[str, Any]) -> tuple[CorrectVerdict, CorrectVerdict]:
    """Return the verdicts on KF and EKF2 with which the forms were judged.

    They are of the 95 % band of the mean NIS, without a band for the ratio.
    """
    words = (VERDICT_WORDS[flight[name]["verdict"]] for name in ("verdict_ours", "verdict_ekf2"))
    kf, ekf2 = map(CorrectVerdict, words)
    return kf, ekf2


@pytest.mark.reallogs
def test_answer_form_points_agree_with_manual_grading(shared_logs: Path) -> None:
    bank = json.loads((shared_logs.parent / "grading" / "bank.json").read_text(encoding="utf-8"))
    truths = {
        flight["flight"]: compute_form_answers(simulation_of(flight["simulate"]), SHA256)
        for flight in bank["flights"]
    }
    by_hand = {flight["flight"]: verdicts_by_hand(flight) for flight in bank["flights"]}
    ours, theirs = [], []
    for form in bank["forms"]:
        known = tuple(to_tuple(one["truth"]) for one in form["quantities"])
        kf, ekf2 = by_hand[form["flight"]]
        truth = replace(truths[form["flight"]], quantities=known, kf=kf, ekf2=ekf2)
        made = compute_form_points(answers_of(form), truth)
        ours.append(sum(part.points for part in made.parts))
        theirs.append(form["judgement"]["points"])
    assert len(ours) >= 30
    assert np.abs(np.subtract(ours, theirs)).mean() <= 2.0
    assert spearmanr(ours, theirs).statistic >= 0.95
    # a variance wrong by less than a factor of 1.5 is inside the band of a consistent ratio
    for flight in bank["flights"]:
        truth = truths[flight["flight"]]
        for name, made in (("verdict_ours", truth.kf), ("verdict_ekf2", truth.ekf2)):
            known = (
                VERDICT_WORDS[flight[name]["verdict"]] if flight[name]["clear"] else "consistent"
            )
            assert made.verdict == known, flight["flight"]


def test_random_answer_forms_earn_at_most_20_percent() -> None:
    """500 random forms on flights with two faults, one and none."""
    rng = np.random.default_rng(5)
    truths = (TRUTH, replace(TRUTH, mistakes=(LATE,)), CLEAN)
    earned = [
        compute_form_points(at_random(rng, truths[n % 3]), truths[n % 3]).fraction
        for n in range(500)
    ]
    assert np.mean(earned) <= 0.2
