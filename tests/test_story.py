"""The sentences that open a report: what they say is what was made to happen."""

from __future__ import annotations

import re

import numpy as np
import pandas as pd
import pytest
from exchange import replace
from flights import Estimator, Uwb, aisle_flight, motion, with_noises

from px4fuse.comparison.comparison import compare
from px4fuse.comparison.model import Comparison
from px4fuse.ekf2_parameters import EV_POS, FLOW, Aid
from px4fuse.findings import find
from px4fuse.findings.story import MAX_SENTENCES, story
from px4fuse.flight import AidLog

ALONG_DEG = 30.0


def told(comparison: Comparison) -> tuple[str, ...]:
    """Story of a comparison, each sentence checked for form."""
    analysis = with_noises(comparison)
    sentences = story(analysis, find(analysis))
    assert 1 <= len(sentences) <= MAX_SENTENCES
    for sentence in sentences:
        assert re.fullmatch(r"[A-Z0-9].*[^.]\.", sentence), sentence
        assert "nan" not in sentence
    return sentences


def test_a_clean_flight_is_told_in_one_sentence_with_its_errors() -> None:
    flight = aisle_flight(heading_deg=ALONG_DEG, ekf2=Estimator(sigma_p_m=0.05))
    comparison = compare(flight)
    (only,) = told(comparison)
    steps = comparison.main.replay.steps
    true = motion(steps.index.to_numpy(), ALONG_DEG, 10.0)[0] @ comparison.main.axis.direction
    ours_cm = 100.0 * float(np.sqrt(np.mean((steps["position_m"] - true) ** 2)))
    assert only == (
        "Along the aisle EKF2 was 5 cm from the truth (RMS) and honest about it; our filter was "
        f"{ours_cm:.0f} cm from the truth (RMS) and honest about it."
    )


def test_a_silent_source_is_told_with_how_far_both_filters_coasted() -> None:
    silence = (50.0, 58.0)
    comparison = compare(aisle_flight(uwb=Uwb(gap_s=silence), heading_deg=ALONG_DEG))
    sentences = told(comparison)
    gap = next(sentence for sentence in sentences if "silent" in sentence)
    assert gap.startswith("From 50 s to 58 s the source was silent: both filters coasted")
    steps = comparison.main.replay.steps
    before = steps[steps.index < silence[1]].iloc[-1]
    moved = before["velocity_m_s"] * (silence[1] - steps.index[steps.index < silence[1]][-1])
    true = motion(np.array([silence[1]]), ALONG_DEG, 10.0)[0][0] @ comparison.main.axis.direction
    off = abs(before["position_m"] + moved - true)
    assert f"ours was {off:.1f} m " in gap


COASTED = "both filters coasted on the IMU;"


@pytest.mark.parametrize("aid", [FLOW, EV_POS])
@pytest.mark.parametrize(("fused", "silent_s", "by"), [
    (1.0, (0.0, 0.0), "ours coasted on the IMU, EKF2 went on by {};"),
    (0.0, (0.0, 0.0), COASTED),
    (1.0, (50.5, 57.5), COASTED),  # silent too, but for the ends
])  # fmt: skip
def test_what_carried_ekf2_through_a_silence_is_told(
    aid: Aid, fused: float, silent_s: tuple[float, float], by: str
) -> None:
    flight = aisle_flight(uwb=Uwb(gap_s=(50.0, 58.0)), heading_deg=ALONG_DEG)
    times_s = np.arange(45.0, 65.0, 0.2)
    innovation = np.random.default_rng(3).normal(size=len(times_s))
    columns = {"innovation_x": innovation, "variance_x": 1.0, "noise_x": 0.5, "ratio_x": 0.1}
    samples = pd.DataFrame({**columns, "fused": fused, "rejected": 0.0}, times_s)
    samples = samples[(times_s <= silent_s[0]) | (times_s >= silent_s[1])]
    log = AidLog(("estimator_aid_src",), ("x",), samples, None)
    sentences = told(compare(replace(flight, ekf2=replace(flight.ekf2, aids={aid.name: log}))))
    assert any(f"silent: {by.format(aid.label)}" in sentence for sentence in sentences)


def test_without_ekf2_its_absence_is_told_with_the_reason() -> None:
    first, *_ = told(compare(aisle_flight(ekf2=None)))
    assert "there is no EKF2 beside it: no topic for EKF2" in first
