"""Earth in the EKF2 model: metres per degree in EKF2's state, and the earth rotation rate."""

import numpy as np
import pandas as pd
import pytest
from ekf2_tools import opened
from exchange import replace
from findings_tools import made

from px4fuse.ekf2.inputs import SIMULATED_EKF2_NOTE
from px4fuse.ekf2.replay_segments import (
    compute_earth_rate_rad_s,
    compute_internal_to_published_position_ratio,
)
from px4fuse.flight.model import FusionRecord
from px4fuse.readers.px4_positions import EARTH_RADIUS_M
from px4fuse.simulation.faults import parse_faults
from px4fuse.simulation.flights import simulate_flight
from px4fuse.simulation.scenario import make_scenario

# m per degree of latitude and of longitude on WGS84, from a table
DEGREE_M = {0.0: (110_574.0, 111_320.0), 45.0: (111_132.0, 78_847.0), 60.0: (111_412.0, 55_800.0)}
ECCENTRICITY2 = 0.00669438


def record(latitude_deg: float, altitude_m: float = 0.0, north_m: float = np.nan) -> FusionRecord:
    known = {"latitude_deg": latitude_deg, "altitude_m": altitude_m}
    return made(FusionRecord, **known, delayed_state=pd.DataFrame({"north_m": [north_m]}))


@pytest.mark.parametrize("latitude_deg", DEGREE_M)
def test_metres_per_degree_use_curvature_radii_of_ekf2(latitude_deg: float) -> None:
    """PX4's power of 2.5 makes the meridian radius too long by a known factor."""
    north_m, east_m = DEGREE_M[latitude_deg]
    latitude = np.radians(latitude_deg)
    of_degree = np.radians(1.0) * EARTH_RADIUS_M
    too_long = 1.0 / (1.0 - ECCENTRICITY2 * np.sin(latitude) ** 2)
    north, east, down = compute_internal_to_published_position_ratio(record(latitude_deg))
    assert north * of_degree == pytest.approx(north_m * too_long, rel=2e-5)
    assert east * of_degree * np.cos(latitude) == pytest.approx(east_m, rel=2e-5)
    assert down == 1.0
    higher = compute_internal_to_published_position_ratio(record(latitude_deg, 637.1))
    assert np.subtract(higher, (north, east, down)) == pytest.approx([1e-4, 1e-4, 0.0], abs=1e-12)


def test_map_projection_scale_factor_is_1_without_gnss_origin() -> None:
    assert compute_internal_to_published_position_ratio(record(45.0, north_m=3.0)) == 1.0
    assert compute_internal_to_published_position_ratio(record(np.nan)) == 1.0


def test_earth_rotation_rate_matches_sidereal_day() -> None:
    rate = 2.0 * np.pi / 86_164.1
    for latitude_deg, expected in ((0.0, (rate, 0.0, 0.0)), (90.0, (0.0, 0.0, -rate)),
                                   (-30.0, (rate * 0.75**0.5, 0.0, 0.5 * rate))):  # fmt: skip
        found = compute_earth_rate_rad_s(record(latitude_deg))
        np.testing.assert_allclose(found, expected, atol=1e-10)
    np.testing.assert_array_equal(compute_earth_rate_rad_s(record(np.nan)), np.zeros(3))


def test_ekf2_replay_of_gnss_flight_includes_earth_rotation() -> None:
    """The model uses EKF2's metres, the output those of the track; simulations are flat."""
    flight = simulate_flight(make_scenario("outdoor", seed=3), parse_faults(()))
    assert SIMULATED_EKF2_NOTE in flight.log.notes
    flat, round_ = opened(flight), opened(replace(flight, log=replace(flight.log, notes=())))
    known = flight.ekf2.record
    metres = compute_internal_to_published_position_ratio(known)
    assert metres == pytest.approx((1.00357, 1.00302, 1.0), abs=1e-5)
    flat_m, round_m = (found.inputs.received_positions.position_m for found in (flat, round_))
    np.testing.assert_allclose(round_m, flat_m * metres)
    (flat_stretch,), (segment,) = flat.inputs.segments, round_.inputs.segments
    np.testing.assert_allclose(segment.state[6:9], flat_stretch.state[6:9] * metres)
    turned = segment.attitude_correction_rad - flat_stretch.attitude_correction_rad
    expected = compute_earth_rate_rad_s(known) * segment.step_s[:, None]
    np.testing.assert_allclose(turned, expected, atol=1e-12)
    for name in ("delayed_state", "published_state"):
        difference = getattr(round_.baseline_replay, name) - getattr(flat.baseline_replay, name)
        off_m = difference[["north_m", "east_m"]].abs().to_numpy()
        assert 1e-4 < off_m.max() < 0.05
        # the difference does not grow with the distance from the origin (up to 20 m)
        assert (
            getattr(flat.baseline_replay, name)[["north_m", "east_m"]].abs().to_numpy().max() > 15.0
        )
