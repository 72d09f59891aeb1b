"""Summary of a flight: it states the mistakes and events that the flight contains."""

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
from px4fuse.findings.summary import MAX_PARAGRAPHS, summarise
from px4fuse.flight import AidLog

ALONG_DEG = 30.0


def summary(comparison: Comparison) -> tuple[str, ...]:
    """Summarise a comparison, and check the form of each paragraph."""
    analysis = with_noises(comparison)
    paragraphs = summarise(analysis, find(analysis))
    assert 1 <= len(paragraphs) <= MAX_PARAGRAPHS
    for paragraph in paragraphs:
        assert re.fullmatch(r"[A-Z0-9].*[^.]\.", paragraph), paragraph
        assert "nan" not in paragraph
    return paragraphs


def test_summary_clean_flight_states_rmse_and_consistency() -> None:
    flight = aisle_flight(heading_deg=ALONG_DEG, ekf2=Estimator(sigma_p_m=0.05))
    comparison = compare(flight)
    (only,) = summary(comparison)
    steps = comparison.main.replay.steps
    true = motion(steps.index.to_numpy(), ALONG_DEG, 10.0)[0] @ comparison.main.axis.direction
    kf_rmse_m = float(np.sqrt(np.mean((steps["position_m"] - true) ** 2)))
    ekf2_rmse_m = comparison.main.filters["ekf2"].truth.position_rmse_m
    assert only == (
        f"Along the aisle EKF2 has a position RMSE of {ekf2_rmse_m:.3f} m and is consistent. "
        f"Along the aisle KF has a position RMSE of {kf_rmse_m:.3f} m and is consistent."
    )
    assert ekf2_rmse_m == pytest.approx(0.05, abs=0.005)


def test_summary_source_gap_states_errors_at_its_end() -> None:
    gap_s = (50.0, 58.0)
    comparison = compare(aisle_flight(uwb=Uwb(gap_s=gap_s), heading_deg=ALONG_DEG))
    gap = next(text for text in summary(comparison) if text.startswith("Gap in the position"))
    assert "from 50 s to 58 s" in gap
    assert BOTH_IMU in gap
    steps = comparison.main.replay.steps
    before = steps[steps.index < gap_s[1]].iloc[-1]
    moved = before["velocity_m_s"] * (gap_s[1] - steps.index[steps.index < gap_s[1]][-1])
    true = motion(np.array([gap_s[1]]), ALONG_DEG, 10.0)[0][0] @ comparison.main.axis.direction
    error_m = abs(before["position_m"] + moved - true)
    assert f"position error was {error_m:.2f} m (KF)" in gap


BOTH_IMU = "KF and EKF2 relied on the IMU."


@pytest.mark.parametrize("aid", [FLOW, EV_POS])
@pytest.mark.parametrize(("fused", "gap_s", "expected"), [
    (1.0, (0.0, 0.0), "KF relied on the IMU, EKF2 also on {}."),
    (0.0, (0.0, 0.0), BOTH_IMU),
    (1.0, (50.5, 57.5), BOTH_IMU),  # fused only at the ends of the gap
])  # fmt: skip
def test_summary_source_gap_names_aid_that_ekf2_fused(
    aid: Aid, fused: float, gap_s: tuple[float, float], expected: str
) -> None:
    flight = aisle_flight(uwb=Uwb(gap_s=(50.0, 58.0)), heading_deg=ALONG_DEG)
    times_s = np.arange(45.0, 65.0, 0.2)
    innovation = np.random.default_rng(3).normal(size=len(times_s))
    columns = {"innovation_x": innovation, "variance_x": 1.0, "noise_x": 0.5, "ratio_x": 0.1}
    samples = pd.DataFrame({**columns, "fused": fused, "rejected": 0.0}, times_s)
    samples = samples[(times_s <= gap_s[0]) | (times_s >= gap_s[1])]
    log = AidLog(("estimator_aid_src",), ("x",), samples, None)
    paragraphs = summary(compare(replace(flight, ekf2=replace(flight.ekf2, aids={aid.name: log}))))
    assert any(expected.format(aid.label) in paragraph for paragraph in paragraphs)


def test_summary_without_ekf2_states_the_reason() -> None:
    first, *_ = summary(compare(aisle_flight(ekf2=None)))
    assert first.startswith("Along the aisle KF has a position RMSE of ")
    assert first.endswith("The log contains no EKF2 state: no topic for EKF2.")
