"""Why EKF2 differs: what the comparison's steps, words, results and page say."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from exchange import replace
from flights import unexplained
from page_tools import axes_of, words

from px4fuse.analysis import Analysis, explain
from px4fuse.comparison.comparison import compare
from px4fuse.comparison.model import Comparison
from px4fuse.comparison.why import why_ekf2_differs, with_words
from px4fuse.ekf2.model import Model
from px4fuse.ekf2.walk import SAMPLES, STEPS, Why
from px4fuse.filter.clock import ClockOffset
from px4fuse.filter.kalman import state_at
from px4fuse.filter.settings import Settings
from px4fuse.findings.story import story
from px4fuse.flight import Flight, Unavailable
from px4fuse.readers import read_log
from px4fuse.report.document import Document
from px4fuse.report.style import report_style
from px4fuse.report.why import draw, nothing_concluded
from px4fuse.request import ComparisonRequest
from px4fuse.results.build import results
from px4fuse.results.contract import to_plain
from px4fuse.results.model import Student


@pytest.fixture(scope="module")
def sample(sample_flight: Flight) -> Analysis:
    return explain(compare(sample_flight))


def model_of(analysis: Analysis) -> Model:
    assert isinstance(analysis.ekf2_model, Model)
    return analysis.ekf2_model


def of(analysis: Analysis, name: str = "aisle") -> Why:
    found = analysis.why[name]
    assert isinstance(found, Why)
    return found


def again(analysis: Analysis, comparison: Comparison, **changes: object) -> Why:
    """The aisle of the same flight, compared otherwise."""
    given = {"model": analysis.ekf2_model, "tuning": analysis.tuning, "clock": analysis.clock}
    found = why_ekf2_differs(comparison, **{**given, **changes})["aisle"]
    assert isinstance(found, Why)
    return found


def test_the_whole_is_our_filter_against_what_ekf2_published(sample: Analysis) -> None:
    why = of(sample)
    result = next(r for r in sample.axes.values() if r.axis.name == "aisle")
    ours, speed = state_at(result.replay, why.times_s)
    logged = result.ekf2_state.loc[why.times_s]
    apart = ours - logged["position_m"].to_numpy()
    np.testing.assert_allclose(why.apart_m, apart, atol=1e-9)
    assert why.position_mean_square_m2 == pytest.approx(np.mean(apart**2))
    v = speed - logged["velocity_m_s"].to_numpy()
    assert why.velocity_mean_square_m2_s2 == pytest.approx(np.mean(v**2))
    assert np.mean(why.left_m**2) == pytest.approx(why.position_left_mean_square_m2)


def test_the_words_name_the_largest_steps_with_numbers_and_moments(sample: Analysis) -> None:
    why = of(sample)
    first, second = sorted(why.steps, key=lambda step: -step.position_mean_square_m2)[:2]
    for sentence, step in zip(why.sentences[:2], (first, second), strict=True):
        assert step.name in sentence
        assert f"{step.position_mean_square_m2 / why.position_mean_square_m2:.0%}" in sentence
        assert f"at {step.moved_at_s:.1f} s" in sentence
        assert f"{step.position_moved_m:.2f} m" in sentence
    assert "EKF2_EVP_NOISE" not in " ".join(why.sentences)
    said = " ".join(why.sentences)
    assert f"equally close, {why.position_rmse_to_truth_m['kf']:.3f} m (ours)" in said
    assert "m/s rms apart" in said
    assert "late" not in said


def test_settings_of_ours_are_in_the_steps_that_they_make(sample: Analysis) -> None:
    flight = sample.flight
    plain = of(sample)
    zero = again(sample, compare(flight, Settings(input="zero"), axes=("aisle",)))
    assert zero.steps[0].name == SAMPLES
    assert zero.steps[0].position_mean_square_m2 > 10 * plain.steps[0].position_mean_square_m2
    assert "ours knows no acceleration (--input zero)" in " ".join(zero.sentences)
    small = again(sample, compare(flight, Settings(sigma_z_m=0.02), axes=("aisle",)))
    assert small.steps[2].position_moved_m > 0.05
    late = again(sample, compare(flight, Settings(clock_offset_s=-0.3), axes=("aisle",)))
    assert "stamps and delay" in late.sentences[0]
    assert "ours 300 ms" in late.sentences[0]
    for other in (zero, small, late):
        assert other.position_left_mean_square_m2 == pytest.approx(
            plain.position_left_mean_square_m2, rel=0.02
        )


def offset(clock: object, offset_s: float) -> ClockOffset:
    assert isinstance(clock, ClockOffset)
    return replace(clock, offset_s=offset_s, determinable=True)


def test_a_clock_that_is_wrong_for_both_is_said_first(sample: Analysis) -> None:
    comparison = compare(sample.flight, axes=("aisle",))
    shared = again(sample, comparison, clock=offset(sample.clock, -0.25))
    assert shared.sentences[0].startswith("The source's stamps are late by 0.25 s for both filters")
    early = again(sample, comparison, clock=offset(sample.clock, 0.25))
    assert "early by 0.25 s" in early.sentences[0]
    # within its own uncertainty of zero
    unsure = replace(offset(sample.clock, 0.05), sigma_s=0.023)
    assert "early" not in again(sample, comparison, clock=unsure).sentences[0]
    # put right in ours: no longer shared
    ours = compare(sample.flight, Settings(clock_offset_s=-0.25), axes=("aisle",))
    for given in (offset(sample.clock, 0.0), replace(offset(sample.clock, -0.25))):
        said = again(sample, ours, clock=given).sentences
        assert "for both filters" not in " ".join(said)


def test_only_what_was_analysed_is_walked(sample: Analysis) -> None:
    part = compare(sample.flight, axes=("aisle",), start_s=30.0, end_s=60.0)
    why = again(sample, part)
    assert why.spans_s[0][0] == pytest.approx(30.0, abs=0.2)
    assert why.spans_s[0][1] == pytest.approx(60.0, abs=0.3)
    assert of(sample).outside is not None
    assert of(sample).outside.at_s < of(sample).spans_s[0][0]


def test_without_a_horizontal_axis_or_a_model_the_reason_stands(sample: Analysis) -> None:
    down = compare(sample.flight, axes=("down",))
    found = why_ekf2_differs(down, sample.ekf2_model, {}, sample.clock)["down"]
    assert "horizontal" in found.reason
    none = Unavailable("EKF2 replay", "no IMU", "Record it.")
    for name, why in why_ekf2_differs(sample, none, {}, sample.clock).items():
        assert name != "down"
        assert (why.reason, why.remedy) == ("no IMU", "Record it.")


def document(analysis: Analysis) -> Document:
    return Document(analysis, (), Student(), "px4fuse compare")


def drawn(analysis: Analysis) -> list:
    with report_style():
        return list(draw(document(analysis)))


def test_the_page_shows_words_bars_and_agreement(sample: Analysis) -> None:
    (page,) = drawn(sample)
    said = words(page)
    assert "Why EKF2 differs" in said
    assert "0.9997 (north)" in said
    for sentence in of(sample).sentences:
        assert " ".join(sentence.split()[:6]) in said
    position, velocity, over_time = axes_of(page)
    for axes, total in (
        (position, "position_mean_square_m2"),
        (velocity, "velocity_mean_square_m2_s2"),
    ):
        whole, *steps, left = axes.patches
        assert whole.get_width() == 100.0
        assert len(steps) == len(STEPS)
        end = steps[-1].get_x() + steps[-1].get_width()
        assert end == pytest.approx(left.get_width(), abs=1e-9)
        assert getattr(of(sample), total) > 0.0
    ours, left = over_time.lines[-2:]
    assert abs(ours.get_ydata()).max() == abs(of(sample).apart_m).max()
    assert abs(left.get_ydata()).max() == abs(of(sample).left_m).max()


def test_doubtful_and_absent_replays_conclude_nothing(sample: Analysis) -> None:
    model = model_of(sample)
    agreement = replace(model.agreement, good=False, reason="they part")
    doubtful = replace(model, agreement=agreement, flown=replace(model.flown, agreement=agreement))
    why = why_ekf2_differs(sample, doubtful, sample.tuning, sample.clock)
    parted = replace(sample, ekf2_model=doubtful, why=why)
    absent = Unavailable("EKF2 replay", "no IMU", "Record it.")
    without = replace(sample, ekf2_model=absent, why={"north": absent, "east": absent})
    for analysis, reason in ((parted, "they part"), (without, "no IMU")):
        assert drawn(analysis) == []
        line = nothing_concluded(document(analysis))
        assert line.startswith("Why EKF2 differs: nothing is concluded")
        assert line.count(reason) == 1
    assert drawn(unexplained(sample)) == []
    assert not nothing_concluded(document(unexplained(sample)))
    assert not nothing_concluded(document(sample))


def test_every_axis_that_is_explained_has_its_panels(sample: Analysis) -> None:
    absent = Unavailable("why", "a sentence of some length", "None")
    (page,) = drawn(replace(sample, why={"north": of(sample), "east": absent}))
    assert "east: nothing is concluded" in words(page)
    assert len(axes_of(page)) == 3
    (both,) = drawn(replace(sample, why={name: of(sample, name) for name in ("north", "east")}))
    assert len(axes_of(both)) == 6


def test_results_hold_the_steps_and_the_agreement(sample: Analysis) -> None:
    said = to_plain(results(ComparisonRequest(log="x.ulg"), sample, (), Student(), ""))
    assert set(said["why"]) == {"north", "east", "aisle"}
    aisle, agreement = said["why"]["aisle"], said["ekf2_replay"]["agreement"]
    assert [step["name"] for step in aisle["steps"]] == list(STEPS)
    assert not {"apart_m", "left_m", "times_s", "cause"} & aisle.keys()
    north = agreement["north"]
    assert north["s_ratio_p5"] < north["s_ratio_median"] < north["s_ratio_p95"]
    assert agreement["ev_pos"]["north"] == north
    none = to_plain(results(ComparisonRequest(log="x"), unexplained(sample), (), Student(), ""))
    assert none["ekf2_replay"]["reason"]


@pytest.mark.reallogs
@pytest.mark.parametrize(
    ("log", "first", "elsewhere", "never"),
    [
        ("v1.16.1_aisle_overconfident",
         ("EKF2_EVP_NOISE is too small", "55% of the samples", "samples in a row and coasted",
          "the rejections that follow from it are"),
         ("through its too small noise and the rejections",), ()),
        # outliers are of the gate, and no noise is blamed; it did not fuse for 15 s
        ("v1.16.1_aisle_nlos", (),
         ("the gate, missed samples, resets", "EKF2 is closer to the truth",
          "up to 4.0 m apart (at 64 s)"), ("EKF2_EVP_NOISE",)),
        ("v1.16.1_aisle_clock_late", ("The source's stamps are late by 0.26 s for both",), (), ()),
        ("v1.13.3_aisle_evdelay175",
         ("is the stamps and delay",
          "175 ms older than its stamp (EKF2_EV_DELAY), ours 0 ms"),
         ("mostly through the stamps and delay",), ()),
    ],
)  # fmt: skip
def test_flown_flights(
    shared_logs: Path, log: str, first: tuple[str, ...], elsewhere: tuple[str, ...],
    never: tuple[str, ...],
) -> None:  # fmt: skip
    why = of(explain(compare(read_log(shared_logs / "simulated" / f"{log}.ulg"))))
    assert all(words in why.sentences[0] for words in first)
    assert all(words in " ".join(why.sentences) for words in elsewhere)
    assert not any(words in " ".join(why.sentences) for words in never)
    assert why.position_left_share < 0.03
    if log.endswith("clock_late"):  # on a late clock no delay is blamed
        by_name = {step.name: step for step in why.steps}
        stamps = by_name["stamps and delay"].position_mean_square_m2
        assert abs(stamps) < 0.05 * why.position_mean_square_m2
        assert by_name["measurement noise"].position_moved_m < 1e-6


def test_the_story_leaves_wrong_stamps_to_their_finding(sample: Analysis) -> None:
    late = again(sample, sample, clock=offset(sample.clock, -0.25))
    told = story(replace(sample, why={"aisle": late}), ())
    assert told[1:] == (late.cause,)
    assert late.sentences[1].startswith(late.cause.removesuffix("."))
    assert "; most at" not in late.cause


@pytest.mark.parametrize(
    ("share", "weight", "words"),
    [
        (0.47, "The largest part", "47% of the mean square"),
        (0.5, "Most", "50% of the mean square"),
        (1.0, "Most", "100% of the mean square"),
        (1.4, "Most", "all of the mean square and more, which other changes take back"),
    ],
)
def test_most_is_at_least_half_and_no_share_above_all(
    sample: Analysis, share: float, weight: str, words: str
) -> None:
    why = of(sample)
    whole, names = why.position_mean_square_m2, [step.name for step in why.steps]
    parts = [share * whole, *[0.001 * whole] * (len(names) - 1)]
    steps = tuple(
        replace(step, position_mean_square_m2=part)
        for step, part in zip(why.steps, parts, strict=True)
    )
    told = with_words("aisle", replace(why, steps=steps), sample, model_of(sample), None, None)
    assert told.cause.startswith(f"{weight} of what ours and EKF2 are apart along the aisle is the")
    assert f"the {names[0]} ({words}): " in told.cause
