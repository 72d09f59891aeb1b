"""The sentences that open a report: what they say is what was made to happen."""

from __future__ import annotations

import re

import numpy as np
import pytest
from flights import Estimator, Uwb, aisle_flight, motion, unexplained, with_noises

from px4fuse.comparison.comparison import compare
from px4fuse.comparison.model import Comparison
from px4fuse.findings import find
from px4fuse.findings.story import MOST_SENTENCES, story
from px4fuse.flight import Reset
from px4fuse.recording import Dropout

ALONG_DEG = 30.0


def told(comparison: Comparison, *, tuned: bool = True) -> tuple[str, ...]:
    """Story of a comparison, each sentence checked for form."""
    analysis = with_noises(comparison) if tuned else unexplained(comparison)
    sentences = story(analysis, find(analysis))
    assert 1 <= len(sentences) <= MOST_SENTENCES
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


def test_an_ekf2_that_is_too_sure_is_told_by_how_much() -> None:
    first, *_ = told(compare(aisle_flight(ekf2=Estimator(nis=9.0, every=1))), tuned=False)
    factor = float(re.search(r"and ([\d.]+) times too sure of itself; our", first)[1])
    assert factor == pytest.approx(3.0, rel=0.08)


def test_without_ekf2_its_absence_is_told_with_the_reason() -> None:
    first, *_ = told(compare(aisle_flight(ekf2=None)))
    assert "there is no EKF2 beside it: no topic for EKF2" in first


def test_what_cannot_be_judged_is_not_called_honest() -> None:
    first, *_ = told(compare(aisle_flight(ekf2=Estimator(innovations_logged=False))))
    ekf2, ours = first.split(";")
    assert "cannot be judged, since the log has no innovations or too few" in ekf2
    assert "honest" not in ekf2
    assert "honest" in ours


def test_findings_say_when_they_show() -> None:
    resets = (
        Reset(31.0, "position", (0.5, 0.0, 0.0)),
        Reset(72.5, "position", (-0.5, 0.0, 0.0)),
    )
    flight = aisle_flight(
        uwb=Uwb(gap_s=(50.0, 58.0)),
        ekf2=Estimator(resets=resets, fusing=((0.0, 1.0), (51.0, 0.0), (58.5, 1.0))),
        dropouts=(Dropout(20.0, 0.3),),
    )
    when = {found.id: (found.when, found.says_when) for found in find(unexplained(compare(flight)))}
    assert when["source_gap"] == ("50.0 s to 58.0 s", True)
    assert when["ekf2_resets"] == ("31.0 s, 72.5 s", True)
    assert when["logger_dropouts"] == ("20.0 s to 20.3 s", False)
    assert when["ekf2_fusion_interrupted"] == ("51.0 s to 58.5 s", False)
