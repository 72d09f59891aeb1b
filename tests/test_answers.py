"""Answer form: values are read as filled in, and invalid forms are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cli_tools import error_line, run_checked
from comparisons import compare
from flights import aisle_flight
from pypdf import PdfReader

from px4fuse.classroom.assignment.key import compute_numeric_answer
from px4fuse.errors import SettingsError
from px4fuse.filter.kalman import run_kf
from px4fuse.filter.settings import Settings
from px4fuse.results.answer_form import (
    FAULT_KINDS,
    NamedFault,
    format_answer_form,
    read_answers,
    select_questions,
)
from px4fuse.results.contract import ComparisonResults
from px4fuse.results.reading import read_results
from px4fuse.simulation.faults import FAULT_TYPES as SIMULATED

SHA256 = "b" * 64
EMPTY = format_answer_form("s07.ulg", SHA256)
CLAIM = '[[mistake]]\nkind = "{}"\n{}\n'


def read(tmp_path: Path, text: str):
    path = tmp_path / "a.toml"
    path.write_text(text, encoding="utf-8")
    return read_answers(path)


def test_empty_answer_form_lists_every_possible_fault(tmp_path: Path) -> None:
    found = read(tmp_path, EMPTY)
    assert found.log_sha256 == SHA256
    assert (found.mistakes, found.quantities) == ((), (None, None, None))
    assert set(SIMULATED) < set(FAULT_KINDS)
    for name in FAULT_KINDS:
        assert f"#     {name} " in EMPTY


def test_read_answer_form_returns_filled_in_values(tmp_path: Path) -> None:
    text = EMPTY.replace('kind = ""', 'kind = "yaw"').replace('size = ""', "size = -0.367")
    text = text.replace('unit = ""', 'unit = "rad"', 1).replace('q2 = ""', "q2 = [3, 7]")
    found = read(tmp_path, text.replace('verdict_kf = ""', 'verdict_kf = "underconfident"'))
    (claim,) = found.mistakes
    assert claim.convert_size_to_standard_unit() == pytest.approx(-21.03, abs=0.01)
    assert found.quantities[1] == (3.0, 7.0)
    assert found.verdict_kf == "underconfident"
    assert NamedFault("scale", 1.14, "factor").convert_size_to_standard_unit() == pytest.approx(
        14.0
    )
    assert NamedFault("clock-offset", 200.0, "ms").convert_size_to_standard_unit() == pytest.approx(
        0.2
    )


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a" * 30_000, "the file has 0.03 MB, more than the limit of 0.02 MB"),
        ("a." * 400 + "b = 1", "a line has more than 500"),
        (EMPTY.replace('q1 = ""', "q1 = 0,5"), "(q1 = 0,5) is not valid; give a number"),
        (EMPTY.replace('q1 = ""', 'q1 = "half"'), "q1 is 'half'; give a number"),
        (EMPTY.replace('kind = ""', 'kind = "yaw"').replace('size = ""', 'size = "big"'),
         "size of mistake 1 is 'big'; give a number"),
        ("mistake = 5", "mistakes is '5'; give"),
        ("ekf2_did = [5]", "ekf2_did is '5'; give a list of texts"),
        (EMPTY.replace('verdict_kf = ""', 'verdict_kf = "good"'),
         "verdict_kf is 'good'; give one of consistent, overconfident"),
        ("x = " + "[" * 450, "Correct the answer form"),
        ("log_sha256 = 'x'", "Correct the answer form"),
        (EMPTY.replace('kind = ""', 'kind = "gremlins"'), "'gremlins' is not one of"),
        (EMPTY + CLAIM.format("yaw", "size = 900"), "is out of range"),
        (EMPTY.replace('kind = ""', 'kind = "yaw"').replace('size = ""', "size = nan"), "size"),
        (EMPTY.replace('kind = ""', 'kind = "yaw"').replace('size = ""', "size = true"), "size"),
        (EMPTY.replace('kind = ""', 'kind = "yaw"\ncolour = 1'), "colour"),
        (EMPTY + CLAIM.format("yaw", "") * 2, "twice"),
        (EMPTY + CLAIM.format("none", "") + CLAIM.format("yaw", ""), "only one of them"),
        (EMPTY + CLAIM.format("yaw", 'unit = "kg"'), "'kg' is not one of"),
        (EMPTY + CLAIM.format("yaw", 'panel = "sky"'), "'sky' is not one of"),
        (EMPTY + CLAIM.format("yaw", 'parameter = "EKF3"'), "'EKF3' is not one of"),
        (EMPTY.replace('q1 = ""', "q1 = inf"), "q1 is 'inf'"),
        (EMPTY.replace('q1 = ""', 'q1 = ""\nq9 = 1'), "q9"),
        (EMPTY.replace("ekf2_did = []", 'ekf2_did = ["slept"]'), "'slept' is not one of"),
    ],
)  # fmt: skip
def test_read_invalid_answer_form_raises_one_line_error(
    tmp_path: Path, text: str, said: str
) -> None:
    with pytest.raises(SettingsError) as error:
        read(tmp_path, text)
    assert said in str(error.value)
    assert "\n" not in str(error.value).replace("\\n", "")


def test_answer_form_questions_differ_for_each_log() -> None:
    drawn = {select_questions(f"{n:064x}") for n in range(200)}
    assert len(drawn) == 200
    kinds = {quantity.kind for each in drawn for quantity in each}
    assert kinds == {"gain", "variance", "innovation", "nis", "prediction", "gate"}
    main = compare(aisle_flight(duration_s=60.0)).main
    for quantity in next(iter(drawn)):
        run = run_kf(main.axis, Settings(quantity.sigma_a_m_s2, quantity.sigma_z_m))
        row = run.updates.iloc[quantity.update_number - 1]
        s, p = row["innovation_variance_m2"], row["prior_position_variance_m2"]
        by_hand = {
            "gain": p / s, "variance": p * (1.0 - p / s), "nis": row["innovation_m"] ** 2 / s,
            "innovation": row["measurement_m"] - row["prior_position_m"],
        }  # fmt: skip
        found = compute_numeric_answer(main, quantity)
        assert found == pytest.approx(by_hand.get(quantity.kind, found), rel=1e-9)


def test_correct_answer_on_predicted_sigma_equals_closed_form() -> None:
    """Closed form: P grows by F P Fᵀ + Q in each step of DT."""
    main = compare(aisle_flight(duration_s=60.0)).main
    quantity = next(
        q for n in range(99) for q in select_questions(f"{n:064x}") if q.kind == "prediction"
    )
    settings = Settings(quantity.sigma_a_m_s2, quantity.sigma_z_m)
    run = run_kf(main.axis, settings)
    at = run.updates.index[quantity.update_number - 1]
    p0, p1, p2 = run.steps.loc[at, ["position_variance_m2", "covariance_m2_s",
                                    "velocity_variance_m2_s2"]]  # fmt: skip
    dt, n = settings.dt_s, round(quantity.question_parameter / settings.dt_s)
    t = n * dt
    # the acceleration of a step moves the position by dt²/2, and by dt² in each later step
    lags = dt * (np.arange(n) + 0.5)
    grown = settings.sigma_a_m_s2**2 * dt**2 * float((lags**2).sum())
    expected = np.sqrt(p0 + 2.0 * t * p1 + t**2 * p2 + grown)
    assert compute_numeric_answer(main, quantity) == pytest.approx(expected, rel=1e-9)


@pytest.mark.usefixtures("cached_analyses", "cached_pages")
def test_answers_option_of_compare_prints_answer_form_in_report(
    tmp_path: Path, sample_log: Path
) -> None:
    """``answers`` writes the form, ``compare`` reads it."""
    form, report = tmp_path / "f.toml", tmp_path / "r.pdf"
    run_checked("answers", sample_log, "-o", form)
    assert "f.toml exists and was not overwritten" in error_line("answers", sample_log, "-o", form)
    text = form.read_text(encoding="utf-8").replace('kind = ""', 'kind = "none"')
    form.write_text(text, encoding="utf-8")
    run_checked("compare", sample_log, "--answers", form, "-o", report)
    reader = PdfReader(report)
    results = read_results(reader.attachments["results.json"][0])
    assert isinstance(results, ComparisonResults)
    assert results.student.answers.declares_no_fault  # type: ignore[union-attr]
    assert any("Answer form" in page.extract_text() for page in reader.pages)


def test_student_answers_about_another_log_are_rejected(tmp_path: Path, sample_log: Path) -> None:
    form = tmp_path / "f.toml"
    form.write_text(format_answer_form(sample_log.name, SHA256), encoding="utf-8")
    for command in ("compare", "loop"):
        said = error_line(command, sample_log, "--answers", form, "-o", tmp_path / "r.pdf")
        assert "f.toml was made for another log than" in said


def test_answer_form_accepts_not_available_as_verdict(tmp_path: Path) -> None:
    text = EMPTY.replace('verdict_ekf2 = ""', 'verdict_ekf2 = "not available"')
    assert read(tmp_path, text).verdict_ekf2 == "not available"
