"""Legs of the model of EKF2: their noise, and at which step a sample is fused.

The limits are written out here, so that one that is changed must be changed here as well.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from ekf2_tools import RULES
from exchange import replace
from findings_tools import made

from px4fuse.ekf2.inputs import Inputs, Rules, Vision
from px4fuse.ekf2.intervals import FUSE, IDLE, START, Timing, _actions, _events, _noises
from px4fuse.ekf2.stretches import Stretch


@pytest.mark.parametrize("n", [4, 200])
def test_unit_noise_at_the_end_of_a_leg_is_that_of_its_steps(n: int) -> None:
    """Step by step: θ gains unit noise · dt, v turns with it, p follows v."""
    dt = 0.008
    force = np.array([0.3, -0.2, -9.8])
    tilt = -np.array(
        [[0.0, -force[2], force[1]], [force[2], 0.0, -force[0]], [-force[1], force[0], 0.0]]
    ) * dt  # fmt: skip
    F = np.eye(9)
    F[3:6, 0:3] = tilt
    F[6:9, 3:6] = dt * np.eye(3)
    sums = np.zeros((2, 9, 9))
    for _ in range(n):
        for at, rows in enumerate((slice(0, 3), slice(3, 6))):
            sums[at] = F @ sums[at] @ F.T
            sums[at][rows, rows] += dt**2 * np.eye(3)
    made_at_once = _noises(np.array([float(n)]), np.array([n * dt]), (n * tilt)[None])
    # of the gyro, leading terms of position alone with velocity and itself
    sums[0][6:9, 3:9] = made_at_once[0][0, 6:9, 3:9] if n == 4 else sums[0][6:9, 3:9]
    sums[0][3:6, 6:9] = sums[0][6:9, 3:6].T
    for found, true in zip(made_at_once, sums, strict=True):
        scale = np.sqrt(np.outer(np.diag(true), np.diag(true)))
        scale[scale == 0.0] = 1.0
        assert np.max(np.abs(found[0] - true) / scale) < (1e-9 if n == 4 else 0.03)
    one_step = _noises(np.array([1.0]), np.array([dt]), tilt[None])
    np.testing.assert_allclose(np.diag(one_step[1][0])[3:6], dt**2)
    np.testing.assert_allclose(np.diag(one_step[1][0])[6:9], 0.0, atol=1e-18)


def stretch_of(count: int, *, fusing: bool = True) -> Stretch:
    return made(Stretch, time_s=10.0 + 0.01 * np.arange(count + 1), fusing=fusing)


def vision_of(stamps: list[float], age_s: float = 0.0) -> Vision:
    stamp = np.array(stamps)
    return made(Vision, stamp_s=stamp, arrival_s=stamp + age_s)


def acting(stamps: list[float], *, fusing: bool = True, rules: Rules = RULES) -> list[int]:
    stretch = stretch_of(500, fusing=fusing)
    taken = np.array(stamps)
    end = np.searchsorted(stretch.time_s, taken - 1e-9)
    inputs = made(Inputs, rules=rules)
    action, _ = _actions(inputs, stretch, taken, end, np.ones(len(taken), bool))
    return action.tolist()


def test_fusion_starts_on_the_second_of_two_samples_and_stops_in_silence() -> None:
    assert acting([10.1, 10.3, 10.45], fusing=False) == [IDLE, IDLE, START]
    assert acting([10.1, 10.29, 10.45], fusing=False) == [IDLE, START, FUSE]
    assert acting([10.1, 10.29, 10.45]) == [FUSE, FUSE, FUSE]
    # 0.4 s to the step before
    assert acting([10.1, 10.5, 10.6]) == [FUSE, FUSE, FUSE]
    assert acting([10.1, 10.53, 10.6]) == [FUSE, IDLE, START]
    old = replace(RULES, start_interval_s=math.inf, stop_s=7.0)
    assert acting([10.1, 12.0, 14.9], fusing=False, rules=old) == [IDLE, START, FUSE]


def events(
    stamps: list[float], *, delay_s: float = 0.0, age_s: float = -9.0, horizon_s: float = 0.0
) -> Any:
    inputs = made(
        Inputs, vision=vision_of(stamps, age_s), step_s=0.01, rules=RULES, max_interval_s=0.25
    )
    return _events(inputs, stretch_of(100), Timing(delay_s, horizon_s))


def test_a_sample_is_fused_at_the_end_of_the_step_of_its_measurement() -> None:
    """Half a step and the delay before its stamp; events without one where vision is silent."""
    found = events([10.2, 10.305, 10.9])
    seen = found.sample >= 0
    assert found.sample.tolist() == [0, 1, -1, -1, 2]
    assert found.end[seen].tolist() == [20, 30, 90]
    assert found.end[~seen].tolist() == [50, 70]
    assert found.time_s == pytest.approx([10.195, 10.3, 10.5, 10.7, 10.895])
    assert found.usable[seen].all()
    assert not found.usable[~seen].any()
    assert found.action.tolist() == [FUSE, FUSE, IDLE, IDLE, IDLE]
    assert events([10.2, 10.305], delay_s=0.05).end[:2].tolist() == [15, 25]
    assert events([10.505]).sample[:3].tolist() == [-1, -1, 0]
    # in the first step, and before it
    assert events([10.01]).usable[0]
    assert events([10.01]).end[0] == 1
    assert not events([10.004]).usable[0]
    # of two samples in one step the newer one
    assert events([10.2, 10.202]).usable[:2].tolist() == [False, True]


@pytest.mark.parametrize(
    ("age_s", "late", "lost"),
    [(0.22, False, False), (0.24, True, False), (0.28, True, False), (0.31, False, True)],
)
def test_a_sample_that_comes_after_the_horizon_is_late_or_lost(
    age_s: float, late: bool, lost: bool
) -> None:
    """Due 0.2 s after its stamp: late by more than 0.03 s, lost from 0.1 s on."""
    found = events([10.2, 10.4], age_s=age_s, horizon_s=0.2)
    assert (bool(found.late[0]), bool(found.lost[0])) == (late, lost)
    assert bool(found.usable[0]) is not lost
