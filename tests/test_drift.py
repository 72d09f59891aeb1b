"""Sources that may drift: which they are, and what is left of their clock estimate."""

from __future__ import annotations

import numpy as np
import pytest
from exchange import replace

from px4fuse.comparison.estimates import with_drift
from px4fuse.filter.clock import ClockOffset, PartOffset
from px4fuse.origin import (
    ALIGNED,
    GIVEN_FILE,
    GNSS,
    KEPT,
    MOTION_CAPTURE,
    Origin,
    with_orientation,
)  # fmt: skip


def clock(*offsets: float, sigma_s: float = 0.02, change_p: float | None = 1e-7) -> ClockOffset:
    parts = tuple(
        PartOffset(30.0 * i, 30.0 * (i + 1), each, sigma_s) for i, each in enumerate(offsets)
    )
    middle = float(np.mean(offsets))
    curve = np.array([0.0])
    return ClockOffset(
        offset_s=middle, interval_s=(middle - 0.02, middle + 0.02), sigma_s=0.01, applied_s=0.0,
        determinable=True, curve_s=curve, curve_drop=curve, interval_drop=1.92, parts=parts,
        drift_ppm=100.0, drift_sigma_ppm=50.0, change_p=change_p, sigma_a_m_s2=0.2,
        sigma_z_m=0.01, count=3000,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("origin", "drifts"),
    [(GIVEN_FILE, False), (MOTION_CAPTURE, False), (GNSS, False), (ALIGNED, True), (KEPT, True)],
)
def test_external_vision_with_an_orientation_that_turns_may_drift(
    origin: Origin, drifts: bool
) -> None:
    assert with_orientation(origin, turns=True).may_drift is drifts
    assert not with_orientation(origin, turns=False).may_drift


def test_parts_that_scatter_widen_the_interval_and_are_no_change() -> None:
    """As measured on a VIO whose stamps were right throughout."""
    scattered = clock(-0.013, 0.019, 0.076, 0.031, 0.082, 0.107, -0.077, 0.012, -0.007, -0.024)
    found = with_drift(scattered)
    scatter = found.sigma_s / scattered.sigma_s
    assert scatter == pytest.approx(np.std([p.offset_s for p in found.parts], ddof=1) / 0.02)
    low, high = found.interval_s
    assert (high - low) / 0.04 == pytest.approx(scatter)
    assert found.change_p == 1.0
    assert found.determinable


def test_parts_as_far_apart_as_their_noise_change_nothing() -> None:
    found = with_drift(clock(0.01, -0.01, 0.015, -0.02, 0.0))
    assert (found.interval_s, found.sigma_s) == (pytest.approx((-0.021, 0.019)), 0.01)


def test_a_step_that_drift_cannot_imitate_is_a_change() -> None:
    found = with_drift(clock(-0.41, -0.36, 0.03, -0.04, 0.02, 0.05, -0.03, 0.0))
    assert found.change_p is not None
    assert found.change_p < 1e-3


def test_too_wide_an_interval_determines_nothing() -> None:
    found = with_drift(replace(clock(-0.4, 0.4, -0.3, 0.3), interval_s=(-0.05, 0.05)))
    assert not found.determinable
    assert "drifts" in found.reason


def test_two_parts_show_no_scatter_of_their_own() -> None:
    found = with_drift(clock(0.0, 0.3))
    assert found.change_p is None
