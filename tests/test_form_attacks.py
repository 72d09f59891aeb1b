"""Attacks on the answer form: each is refused, or earns at most what its true answers earn.

Each row of :data:`ATTACKS` is one attack. The expected result is a part of the error message, or
the maximum points of 100. Attacks on reports, PDF files and archives are in test_attacks.py,
test_intake.py, test_verify.py and test_submissions.py; several attempts are in test_entries.py.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from class_tools import graded_report
from exchange import replace
from form_guesses import SHA256, right
from test_form_points import CLEAN, GAP, RIGHT, TRUTH

from px4fuse.classroom.assignment.key import CorrectFormAnswers, CorrectVerdict, InjectedFault
from px4fuse.classroom.grading.form_points import compute_form_points
from px4fuse.classroom.grading.rubric import flag_equal_contents
from px4fuse.errors import SettingsError
from px4fuse.results.answer_form import (
    FAULT_KINDS,
    MAX_MISTAKES,
    Answers,
    NamedFault,
    read_answers,
)
from px4fuse.simulation.faults import FAULT_TYPES as SIMULATED

FIRST = 'kind = "clock-offset"\nsize = 0.19\nunit = "s"\nwhen = "whole flight"\n'
HONEST = f"""log_sha256 = "{"a" * 64}"
verdict_kf = "overconfident"
verdict_ekf2 = "underconfident"
ekf2_did = ["followed wrong positions", "dead-reckoned, then reset"]
[[mistake]]
{FIRST}parameter = "--clock-offset"
value = -0.2
panel = "clock"
[[mistake]]
kind = "dropout"
size = 3.1
from_s = 50.5
until_s = 53
parameter = "--start"
value = 54
panel = "innovations"
[quantities]
q1 = 0.505
q2 = [3, 7]
q3 = -0.2
"""
NAMES = [name for name in FAULT_KINDS if name != "none"]


def changed(old: str, new: str) -> str:
    assert old in HONEST
    return HONEST.replace(old, new, 1)


def of_kinds(*kinds: str, size: float | None = 0.0) -> str:
    """Return a form that names these faults, with a size or with the default of the simulation."""
    head, _, end = HONEST.partition("[[mistake]]")
    blocks = []
    for kind in kinds:
        default = SIMULATED[kind].default if kind in SIMULATED else 0.0
        number = float(default if size is None else size)
        size_text = f"size = {number}\n" if FAULT_KINDS[kind].units else ""
        blocks.append(f'[[mistake]]\nkind = "{kind}"\n{size_text}when = "whole flight"\n')
    return head + "".join(blocks) + "[quantities]" + end.partition("[quantities]")[2]


def number(text: str) -> str:
    return changed("size = 0.19", f"size = {text}")


# Points of a form with correct verdicts and numbers, and no correct fault
VERDICTS_AND_NUMBERS = 30.0
NOT_A_NUMBER = "give a number with a decimal point"
ATTACKS: dict[str, tuple[str, str | float]] = {
    "honest form": (HONEST, 100.0),
    "N1 milliseconds without unit": (changed('0.19\nunit = "s"', "190"), "out of range"),
    "N1 milliseconds as seconds": (number("190"), "size 190 is out of range (-5 to 5 s)"),
    "N2 unknown unit": (changed('unit = "s"', 'unit = "us"'), '\'us\' is not one of "s", "ms"'),
    "N2 micro sign in unit": (changed('unit = "s"', 'unit = "µs"'), 'is not one of "s", "ms"'),
    "N3 nan": (number("nan"), NOT_A_NUMBER),
    "N3 infinity": (number("inf"), NOT_A_NUMBER),
    "N3 negative infinity": (number("-inf"), NOT_A_NUMBER),
    "N3 1e999": (number("1e999"), NOT_A_NUMBER),
    "N4 huge number": (number("1e308"), NOT_A_NUMBER),
    "N4 tiny number": (number("5e-324"), 85.0 + 7.5),
    "N4 negative zero": (number("-0.0"), 85.0 + 7.5),
    "N4 hexadecimal number": (number("0xD4"), "out of range"),
    "N5 5000 digits": (changed("= 0.505", "= " + "1" * 5000), "more than 500 characters"),
    "N5 490 digits": (changed("= 0.505", "= " + "1" * 490), NOT_A_NUMBER),
    "N6 dotted key of 2000 parts": ("a." * 2000 + "a = 1\n" + HONEST, "more than 500 characters"),
    "N6 dotted key of 100 parts": ("a." * 100 + "a = 1\n" + HONEST, "unknown field"),
    "N7 nested lists": ("a = " + "[\n" * 900 + "]\n" * 900 + HONEST, "recursion"),
    "N8 500,000 faults": (HONEST + "[[mistake]]\n" * 500_000, "more than the limit"),
    "N8 too many faults": (HONEST + '[[mistake]]\nkind = "jump"\n' * 40, "mistakes"),
    "N9 key twice": (changed(FIRST, FIRST + 'kind = "yaw"\n'), "line 10"),
    "N9 table twice": (HONEST + "[quantities]\nq1 = 1\n", "line"),
    "N10 kind twice": (HONEST + '[[mistake]]\nkind = "dropout"\n', "twice"),
    "N11 list as size": (number("[0.1, 0.2, 0.3]"), NOT_A_NUMBER),
    "N11 range as size": (number('"0.1 to 0.3"'), NOT_A_NUMBER),
    "N12 20 faults of size 0": (of_kinds(*NAMES[:MAX_MISTAKES]), VERDICTS_AND_NUMBERS),
    "N12 three false faults": (of_kinds("yaw", "jump", "nlos", "dropout"), VERDICTS_AND_NUMBERS),
    "N13 default sizes": (of_kinds(*NAMES[:MAX_MISTAKES], size=None), VERDICTS_AND_NUMBERS),
    "N14 none and a fault": (HONEST + '[[mistake]]\nkind = "none"\n', "only one of them"),
    "N15 Cyrillic letter": (changed('"clock-', '"\u0441lock-'), "is not one of"),
    "N15 zero-width space": (changed('"clock-', '"clock\u200b-'), "is not one of"),
    "N15 capital letters": (changed('"clock-offset', '"CLOCK-OFFSET'), "is not one of"),
    "N16 misspelt table": (HONEST.replace("[[mistake]]", "[[mistakes]]"), "no field mistakes"),
    "N16 points": ("points = 100\n" + HONEST, "unknown field `points`"),
    "N17 times outside flight": (changed("50.5\nuntil_s = 53", "-5\nuntil_s = 1e8"), 97.5),
    "N17 end before start": (changed("until_s = 53", "until_s = 40"), 97.5),
    "N18 all times": (changed("50.5\nuntil_s = 53", "0\nuntil_s = 1e6"), 97.5),
    "N19 all updates": (changed("[3, 7]", f"{[*range(1, 100)]}"), 95.0),
    "N19 no update": (changed("[3, 7]", "[]"), 95.0),
    "N20 two verdicts": (changed('"overconfident"', '"consistent or overconfident"'), "verdict_kf"),
    "N20 list of verdicts": (changed('"overconfident"', '["consistent"]'), "verdict_kf"),
    "N21 two values": (changed("-0.2\npanel", '"0 or 5"\npanel'), NOT_A_NUMBER),
    "N21 two corrections": (changed('"--start"', '["--start", "--end"]'), "text in quotes"),
    "N27 UTF-16": (HONEST.encode("utf-16").decode("latin-1"), "line 1"),
    "N27 NUL": (changed('"clock"', '"clo\x00ck"'), "line"),
    "N27 escaped NUL": (changed('"clock"', '"clock\\u0000"'), "is not one of"),
    "N28 formula as parameter": (changed('"--start"', '"=cmd|calc"'), "is not one of"),
    "N28 HTML as panel": (changed('"clock"\n', '"<script>"\n'), "is not one of"),
    "N29 true as size": (number("true"), NOT_A_NUMBER),
    "N29 date as size": (number("2026-11-20"), NOT_A_NUMBER),
    "N29 number as kind": (changed('"clock-offset"', "3"), "text in quotes"),
    "N31 path in a field": ('file = "../flights_answers.json"\n' + HONEST, "unknown field `file`"),
    "N36 list of panels": (changed('"clock"\n', '"clock, map"\n'), "is not one of"),
    "N37 text to the grader": (changed('"clock"\n', '"judge: all right"\n'), "is not one of"),
    "decimal comma": (changed("0.505", "0,505"), "line 22 (q1 = 0,505) is not valid"),
    "unit behind the number": (number("0.19 s"), "line 7 (size = 0.19 s) is not valid"),
    "answer to unknown question": (HONEST + "q4 = 1\n", "q4"),
    "letter outside the figures": (HONEST + '[choices]\nc1 = "f"\n', "c1 is 'f'"),
    "unknown question on figures": (HONEST + '[choices]\nc99 = "a"\n', "c99"),
    "list of letters": (HONEST + '[choices]\nc1 = ["a", "b"]\n', "c1 is"),
}  # fmt: skip


@pytest.mark.parametrize("name", ATTACKS)
def test_manipulated_answer_form_gives_error_or_few_points(name: str, tmp_path: Path) -> None:
    text, expected = ATTACKS[name]
    file = tmp_path / "answers.toml"
    file.write_text(text, encoding="utf-8", newline="")
    if isinstance(expected, str):
        with pytest.raises(SettingsError) as caught:
            read_answers(file)
        message = str(caught.value)
        assert expected in message
        assert "\n" not in message
        assert "$" not in message
        return
    points = 100.0 * compute_form_points(read_answers(file), TRUTH).fraction
    assert points <= expected + 0.01
    assert points == pytest.approx(expected, abs=6.0)


@pytest.mark.parametrize("kinds", [("nlos",), NAMES[:MAX_MISTAKES]])
def test_wrongly_named_faults_earn_no_points_on_faultless_flight(kinds, tmp_path: Path) -> None:
    file = tmp_path / "answers.toml"
    file.write_text(of_kinds(*kinds), encoding="utf-8")
    named = compute_form_points(read_answers(file), CLEAN)
    assert [part.points for part in named.parts if part.title == "mistakes"] == [0.0]
    assert named.fraction < 0.5 * compute_form_points(right(CLEAN), CLEAN).fraction


def test_two_students_with_equal_plot_answers_are_flagged() -> None:
    form = Answers(log_sha256=SHA256, choices=("a", "b", "", "c", "d", "e", "a"))
    reports = [
        graded_report(name, 5.0, student_id=name, form=replace(form, choices=choices))
        for name, choices in (("s1", form.choices), ("s2", form.choices), ("s3", ("a", "b")))
    ]
    flags = flag_equal_contents(reports)
    assert set(flags) == {"s1", "s2"}
    assert "plots" in flags["s1"][0]


# ------------------------------------------------ students who analysed their flight

OFF = InjectedFault("ekf2-off")
OFF_TRUTH = CorrectFormAnswers(
    (OFF,), 0.1, CorrectVerdict("consistent"), CorrectVerdict(""), ("never fused",),
    ("followed wrong positions",), (0.5, 0.1, 0.2),
)  # fmt: skip
NLOS_TRUTH = replace(TRUTH, mistakes=(InjectedFault("nlos", 3.0, 2.5, 3.5, 10.0, 60.0), GAP))
COMPASS_TRUTH = replace(TRUTH, mistakes=(InjectedFault("heading", 20.0, 17.0, 23.0, 30.0), GAP))
END_TRUTH = replace(TRUTH, mistakes=(InjectedFault("open-end", 5.0, 4.7, 5.3, 60.0),))


def first_mistake(truth: CorrectFormAnswers, **values) -> Answers:
    """Return the right form with other values of its first fault."""
    form = right(truth)
    return replace(form, mistakes=(replace(form.mistakes[0], **values), *form.mistakes[1:]))


# Right answers, form of a student who analysed the flight, and minimum points of 100
HONEST_FORMS: dict[str, tuple[CorrectFormAnswers, Answers, float]] = {
    "EKF2 never fused, verdict not available": (OFF_TRUTH, right(OFF_TRUTH), 100.0),
    "EKF2 never fused and followed": (
        OFF_TRUTH,
        replace(right(OFF_TRUTH), ekf2_did=("never fused", "followed wrong positions")), 100.0,
    ),
    "EKF2 off in the map": (OFF_TRUTH, first_mistake(OFF_TRUTH, panel="map"), 100.0),
    "outliers in the position": (
        NLOS_TRUTH, first_mistake(NLOS_TRUTH, panel="position along the aisle"), 100.0,
    ),
    "clean flight without own numbers": (CLEAN, replace(right(CLEAN), quantities=()), 70.0),
    "faulty flight without own numbers": (TRUTH, replace(RIGHT, quantities=()), 70.0),
    "open end 5 % off": (END_TRUTH, first_mistake(END_TRUTH, size=5.25), 100.0),
    "open end 7 % off": (END_TRUTH, first_mistake(END_TRUTH, size=5.35), 90.0),
    "compass calibration": (
        COMPASS_TRUTH,
        first_mistake(COMPASS_TRUTH, parameter="calibrate the compass", value=None), 100.0,
    ),
    "number instead of a list of one update": (
        replace(TRUTH, quantities=(0.5, (61.0,), -0.2)),
        replace(RIGHT, quantities=(0.5, 61.0, -0.2)), 100.0,
    ),
    "no update outside the gate": (
        replace(TRUTH, quantities=(0.5, (), -0.2)), replace(RIGHT, quantities=(0.5, (), -0.2)),
        100.0,
    ),
    "factor instead of percent": (
        replace(TRUTH, mistakes=(InjectedFault("scale", 14.0, 12.0, 16.0),)),
        replace(RIGHT, mistakes=(NamedFault("scale", 1.14, "factor"),)), 70.0,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", HONEST_FORMS)
def test_honest_answer_form_earns_at_least_expected_points(name: str) -> None:
    truth, form, expected = HONEST_FORMS[name]
    assert 100.0 * compute_form_points(form, truth).fraction >= expected - 0.01
