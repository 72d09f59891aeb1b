"""Why EKF2 differs: what the comparison's steps and words say, and when there is no page."""

import re
from typing import Any

import numpy as np
import pytest
from exchange import replace
from flights import unexplained

from px4fuse.analysis import Analysis
from px4fuse.comparison.comparison import compare
from px4fuse.comparison.why import add_sentences, explain_ekf2_difference
from px4fuse.ekf2.walk import SAMPLES, Why
from px4fuse.filter.kalman import state_at
from px4fuse.filter.settings import Settings
from px4fuse.flight import Unavailable
from px4fuse.report.style import report_style
from px4fuse.report.why import draw, unexplained_note


def of(analysis: Analysis, name: str = "aisle") -> Why:
    return analysis.why[name]


def again(analysis: Analysis, settings: Settings, **choices: Any) -> Why:
    """The aisle of the same flight, compared otherwise."""
    comparison = compare(analysis.flight, settings, axes=("aisle",), **choices)
    return explain_ekf2_difference(comparison, analysis.ekf2_model, analysis.clock)["aisle"]


def test_the_whole_is_our_filter_against_what_ekf2_published(sample: Analysis) -> None:
    why = of(sample)
    result = next(r for r in sample.axes.values() if r.axis.name == "aisle")
    ours, speed = state_at(result.replay, why.times_s)
    logged = result.ekf2_state.loc[why.times_s]
    apart = ours - logged["position_m"].to_numpy()
    np.testing.assert_allclose(why.kf_minus_ekf2_m, apart, atol=1e-9)
    assert why.position_mean_square_m2 == pytest.approx(np.mean(apart**2))
    v = speed - logged["velocity_m_s"].to_numpy()
    assert why.velocity_mean_square_m2_s2 == pytest.approx(np.mean(v**2))
    assert np.mean(why.unexplained_m**2) == pytest.approx(why.position_left_mean_square_m2)


def test_settings_of_ours_are_in_the_steps_that_they_make(sample: Analysis) -> None:
    plain = of(sample)
    zero = again(sample, Settings(input="zero"))
    assert zero.steps[0].name == SAMPLES
    assert zero.steps[0].position_mean_square_m2 > 10 * plain.steps[0].position_mean_square_m2
    assert "ours knows no acceleration (--input zero)" in " ".join(zero.sentences)
    small = again(sample, Settings(sigma_z_m=0.02))
    assert small.steps[2].position_moved_m > 0.05
    late = again(sample, Settings(clock_offset_s=-0.3))
    assert "stamps and delay" in late.sentences[0]
    assert "ours 300 ms" in late.sentences[0]
    left = pytest.approx(plain.position_left_mean_square_m2, rel=0.02)
    assert [o.position_left_mean_square_m2 for o in (zero, small, late)] == [left] * 3


def test_only_what_was_analysed_is_walked(sample: Analysis) -> None:
    why = again(sample, Settings(), start_s=30.0, end_s=60.0)
    assert why.spans_s[0][0] == pytest.approx(30.0, abs=0.2)
    assert why.spans_s[0][1] == pytest.approx(60.0, abs=0.3)
    assert of(sample).outside.at_s < of(sample).spans_s[0][0]


def test_without_a_horizontal_axis_or_a_model_the_reason_stands(sample: Analysis) -> None:
    down = compare(sample.flight, axes=("down",))
    found = explain_ekf2_difference(down, sample.ekf2_model, sample.clock)["down"]
    assert "horizontal" in found.reason
    none = Unavailable("EKF2 replay", "no IMU", "Record it.")
    for name, why in explain_ekf2_difference(sample, none, sample.clock).items():
        assert name != "down"
        assert (why.reason, why.remedy) == ("no IMU", "Record it.")


def drawn(analysis: Analysis) -> list:
    with report_style():
        return list(draw(analysis, None))


def test_doubtful_and_absent_replays_conclude_nothing(sample: Analysis) -> None:
    model = sample.ekf2_model
    agreement = replace(model.agreement, good=False, reason="they part")
    doubtful = replace(model, agreement=agreement, flown=replace(model.flown, agreement=agreement))
    why = explain_ekf2_difference(sample, doubtful, sample.clock)
    parted = replace(sample, ekf2_model=doubtful, why=why)
    absent = Unavailable("EKF2 replay", "no IMU", "Record it.")
    without = replace(sample, ekf2_model=absent, why={"north": absent, "east": absent})
    for analysis, reason in ((parted, "they part"), (without, "no IMU")):
        assert drawn(analysis) == []
        line = unexplained_note(analysis)
        assert line.startswith("Why EKF2 differs: nothing is concluded")
        assert line.count(reason) == 1
    assert drawn(unexplained(sample)) == []
    assert not unexplained_note(unexplained(sample))
    assert not unexplained_note(sample)


@pytest.mark.parametrize(
    ("share", "words"),
    [(0.47, "The largest part of .* is the {} .47% of the mean square"),
     (0.5, "Most of .* is the {} .50% of the mean square"),
     (1.4, "Most of .* is the {} .all of the mean square and more, which other changes take")],
)  # fmt: skip
def test_most_is_at_least_half_and_no_share_above_all(sample, share, words) -> None:
    why = of(sample)
    first, whole = why.steps[0], why.position_mean_square_m2
    shares = [share, *[1e-3] * (len(why.steps) - 1)]
    steps = tuple(replace(one, position_mean_square_m2=of * whole)
                  for one, of in zip(why.steps, shares, strict=True))  # fmt: skip
    because = {step.name: f"so {step.name} is" for step in steps}
    told = add_sentences(replace(why, steps=steps), "the aisle", because)
    assert re.match(words.format(first.name), told.cause)
    assert told.cause.endswith(f": so {first.name} is.")
    assert f"; most at {first.moved_at_s:.1f} s" in told.sentences[0]
