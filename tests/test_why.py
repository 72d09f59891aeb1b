"""Explanation of the difference KF - EKF2: contributions, texts, and cases without a page."""

from typing import Any

import numpy as np
import pytest
from comparisons import compare
from ekf2_tools import REPLACED_PROPERTIES
from exchange import replace
from flights import unexplained

from px4fuse.analysis import Analysis
from px4fuse.comparison.difference_steps import (
    add_cause_sentences,
    explain_ekf2_difference,
    find_corrected_noise_settings,
)
from px4fuse.ekf2.steps import (
    MEASUREMENT_NOISE_PROPERTY_NAME,
    SAMPLE_TIMES_PROPERTY_NAME,
    TIMESTAMPS_PROPERTY_NAME,
    DifferenceExplanation,
)
from px4fuse.filter.kalman import predict_track
from px4fuse.filter.settings import Settings
from px4fuse.flight.model import Unavailable
from px4fuse.report.difference_page import describe_missing_explanation, draw_pages
from px4fuse.report.style import apply_report_style


def of(analysis: Analysis, name: str = "aisle") -> DifferenceExplanation:
    return analysis.difference_steps[name]


def explain_again(analysis: Analysis, settings: Settings, **choices: Any) -> DifferenceExplanation:
    """Explain the difference along the aisle with other settings."""
    comparison = compare(analysis.flight, settings, axes=("aisle",), **choices)
    return explain_ekf2_difference(comparison, analysis.ekf2_model, analysis.time_offset, {})[
        "aisle"
    ]


def test_position_difference_on_report_page_is_kf_minus_ekf2(sample: Analysis) -> None:
    explanation = of(sample)
    result = next(r for r in sample.axes.values() if r.axis.name == "aisle")
    track = predict_track(result.kf_run, explanation.times_s)
    position, speed = track["position_m"].to_numpy(), track["velocity_m_s"].to_numpy()
    logged = result.ekf2_tracks.state.loc[explanation.times_s]
    difference = position - logged["position_m"].to_numpy()
    np.testing.assert_allclose(explanation.kf_minus_ekf2_m, difference, atol=1e-9)
    assert explanation.position_mean_square_m2 == pytest.approx(np.mean(difference**2))
    v = speed - logged["velocity_m_s"].to_numpy()
    assert explanation.velocity_mean_square_m2_s2 == pytest.approx(np.mean(v**2))
    assert np.mean(explanation.unexplained_difference_m**2) == pytest.approx(
        explanation.unexplained_mean_square_m2
    )


def test_kf_setting_contributes_to_kf_minus_ekf2_position(sample: Analysis) -> None:
    plain = of(sample)
    zero = explain_again(sample, Settings(input="zero"))
    assert zero.steps[0].name == SAMPLE_TIMES_PROPERTY_NAME
    assert zero.steps[0].position_mean_square_m2 > 10 * plain.steps[0].position_mean_square_m2
    assert "KF uses no acceleration (--input zero)" in " ".join(zero.sentences)
    small = explain_again(sample, Settings(sigma_z_m=0.02))
    assert (
        next(
            step for step in small.steps if step.name == MEASUREMENT_NOISE_PROPERTY_NAME
        ).position_moved_m
        > 0.05
    )
    assert MEASUREMENT_NOISE_PROPERTY_NAME not in {
        step.name for step in plain.steps
    }  # equal settings
    late = explain_again(sample, Settings(clock_offset_s=-0.3))
    assert TIMESTAMPS_PROPERTY_NAME in late.sentences[0]
    assert "300 ms" in late.sentences[0]
    left = pytest.approx(plain.unexplained_mean_square_m2, rel=0.02)
    assert [o.unexplained_mean_square_m2 for o in (zero, small, late)] == [left] * 3


def test_position_difference_uses_only_evaluated_segment(sample: Analysis) -> None:
    explanation = explain_again(sample, Settings(), start_s=30.0, end_s=60.0)
    assert explanation.spans_s[0][0] == pytest.approx(30.0, abs=0.2)
    assert explanation.spans_s[0][1] == pytest.approx(60.0, abs=0.3)
    assert of(sample).outside.at_s < of(sample).spans_s[0][0]


def test_kf_ekf2_difference_without_ekf2_replay_is_unexplained(sample: Analysis) -> None:
    down = compare(sample.flight, axes=("down",))
    found = explain_ekf2_difference(down, sample.ekf2_model, sample.time_offset, {})["down"]
    assert "horizontal" in found.reason
    none = Unavailable("EKF2 replay", "no IMU", "Record it.")
    for name, explanation in explain_ekf2_difference(sample, none, sample.time_offset, {}).items():
        assert name != "down"
        assert (explanation.reason, explanation.remedy) == ("no IMU", "Record it.")


def drawn(analysis: Analysis) -> list:
    with apply_report_style():
        return list(draw_pages(analysis, None))


def test_report_without_ekf2_replay_omits_kf_minus_ekf2_page(sample: Analysis) -> None:
    model = sample.ekf2_model
    agreement = replace(model.agreement, good=False, reason="they part")
    doubtful = replace(
        model,
        agreement=agreement,
        baseline_replay=replace(model.baseline_replay, agreement=agreement),
    )
    explanation = explain_ekf2_difference(sample, doubtful, sample.time_offset, {})
    parted = replace(sample, ekf2_model=doubtful, difference_steps=explanation)
    absent = Unavailable("EKF2 replay", "no IMU", "Record it.")
    without = replace(
        sample, ekf2_model=absent, difference_steps=dict.fromkeys(sample.axes, absent)
    )
    for analysis, reason in ((parted, "they part"), (without, "no IMU")):
        assert drawn(analysis) == []
        line = describe_missing_explanation(analysis)
        assert line.startswith("The difference between KF and EKF2 cannot be explained: ")
        assert line.count(reason) == 1
    assert drawn(unexplained(sample)) == []
    assert not describe_missing_explanation(unexplained(sample))
    assert not describe_missing_explanation(sample)


@pytest.mark.parametrize(
    ("share", "text"),
    [
        (0.47, "decreases by 47 % of its original value."),
        (1.4, "decreases by 140 % of its original value. Other replacements"),
    ],
)
def test_kf_ekf2_difference_text_names_largest_contribution(sample, share, text) -> None:
    explanation = of(sample)
    first, whole = explanation.steps[0], explanation.position_mean_square_m2
    shares = [share, *[1e-3] * (len(explanation.steps) - 1)]
    steps = tuple(replace(one, position_mean_square_m2=of * whole)
                  for one, of in zip(explanation.steps, shares, strict=True))  # fmt: skip
    reasons = {name: f"Reason of {name}" for name in REPLACED_PROPERTIES}
    explained = add_cause_sentences(replace(explanation, steps=steps), "the aisle", reasons)
    assert f"along the aisle: {first.name}. Reason of {first.name}." in explained.sentences[0]
    assert text in explained.sentences[0]
    assert f" m (at {first.moved_at_s:.1f} s)" in explained.sentences[0]


def test_wrong_kf_noise_is_first_in_report_on_kf_minus_ekf2(sample: Analysis) -> None:
    comparison = compare(sample.flight, Settings(sigma_a_m_s2=0.001), axes=("aisle",))
    corrected = find_corrected_noise_settings(comparison, sample.tuning)
    assert corrected == {"sigma_a_m_s2": pytest.approx(0.363, abs=0.01)}
    explained = explain_ekf2_difference(
        comparison, sample.ekf2_model, sample.time_offset, corrected
    )["aisle"]
    assert explained.corrected == corrected
    assert explained.position_mean_square_m2 < 0.01
    assert "--sigma-a 0.363" in explained.sentences[0]
    assert find_corrected_noise_settings(sample, sample.tuning) == {}
