"""Misalignment of the source's frame over the flight, against simulated and real logs."""

from __future__ import annotations

from functools import cache

import numpy as np
import pandas as pd
import pytest
from exchange import replace
from scipy.spatial.transform import Rotation

from px4fuse.comparison.preparation import choose_segment, choose_source
from px4fuse.core.arrays import rms
from px4fuse.filter import frame_rotation
from px4fuse.filter.frame_rotation import (
    MAX_DRIFT_P_VALUE,
    HeadingError,
    HeadingErrorInPart,
    estimate_heading_error,
)
from px4fuse.filter.settings import Settings
from px4fuse.flight.model import Columns, Flight, Unavailable
from px4fuse.readers import read_log
from px4fuse.simulation.faults import parse_faults
from px4fuse.simulation.flights import simulate_flight
from px4fuse.simulation.scenario import Scenario

SIGMA_UWB_M = 0.03
HEADING_DRIFT_DEG = 40.0


@cache
def simulated(*mistakes: str, seed: int = 3, **scenario: float) -> Flight:
    made = Scenario(seed=seed, **{"sigma_uwb_m": SIGMA_UWB_M, "passes": 4, **scenario})
    return simulate_flight(made, parse_faults(mistakes))


def estimate(flight: Flight, sigma_z_m: float = SIGMA_UWB_M) -> HeadingError | Unavailable:
    track, _ = choose_source(flight)
    segment = choose_segment(flight, track)
    return estimate_heading_error(flight, track, segment, Settings(), sigma_z_m)


def rotated(quaternions: pd.DataFrame, misalignment_deg: np.ndarray) -> pd.DataFrame:
    """Return the orientations with a heading error."""
    values = quaternions[Columns.QUATERNION].to_numpy(copy=True)
    wrong = Rotation.from_euler("Z", misalignment_deg[:, None], degrees=True)
    made = (wrong * Rotation.from_quat(values, scalar_first=True)).as_quat(scalar_first=True)
    return pd.DataFrame(made, index=quaternions.index, columns=Columns.QUATERNION)


def with_heading_drift(flight: Flight) -> tuple[Flight, np.ndarray]:
    """Return a flight with a growing heading error, and the error at each sample (°)."""
    turn = HEADING_DRIFT_DEG * np.linspace(0.0, 1.0, len(flight.attitude))
    return replace(flight, attitude=rotated(flight.attitude, turn)), turn


@pytest.mark.parametrize("misalignment_deg", [0.0, 20.0, -40.0])
def test_constant_heading_misalignment_is_recovered(misalignment_deg):
    found = estimate(simulated(*([f"yaw={misalignment_deg:g}"] if misalignment_deg else [])))
    assert not found.drifts
    assert found.misalignment_deg == pytest.approx(misalignment_deg, abs=3.0 * found.sigma_deg)
    assert found.sigma_deg < 3.0


@pytest.mark.slow
def test_heading_errors_of_ten_flights_agree_with_reported_sigma() -> None:
    """If the tilt about east is not estimated, σ is too small (RMS 1.27)."""
    normalised_errors = []
    for seed in range(10):
        flight = simulate_flight(Scenario(seed=seed, passes=4, ekf2=False, truth=False))
        heading_error = estimate(flight, 0.10)
        normalised_errors.append(heading_error.misalignment_deg / heading_error.sigma_deg)
    assert 0.6 < rms(np.array(normalised_errors)) < 1.2


def test_gyro_bias_does_not_change_estimated_heading_error():
    flight = simulated()
    imu = flight.imu.copy()
    imu[Columns.ANGULAR_RATE[2]] += 0.1
    found = estimate(replace(flight, imu=imu))
    assert not found.drifts
    assert found.misalignment_deg == pytest.approx(0.0, abs=3.0 * found.sigma_deg)


@pytest.mark.parametrize("by", ["positions", "orientation"])
def test_drifting_heading_error_is_estimated_per_flight_part(by):
    """A source with an orientation gives the misalignment more accurately than positions."""
    plain = simulated(passes=6 if by == "positions" else 4)
    flight, turn = with_heading_drift(plain)
    if by == "orientation":
        oriented = plain.attitude.iloc[::4].assign(**dict.fromkeys(Columns.ROTATION_VARIANCE, 1e-4))
        tracks = tuple(replace(track, orientation=oriented) for track in flight.positions)
        flight = replace(flight, positions=tracks)
    found = estimate(flight)
    assert found.by == by
    assert found.drifts
    assert found.drift_p < MAX_DRIFT_P_VALUE
    for part in found.parts:
        middle = (part.start_s + part.end_s) / 2.0
        expected = -np.interp(middle, flight.attitude.index, turn)
        within = 0.5 if by == "orientation" else 3.5 * part.sigma_deg
        assert part.heading_error_deg == pytest.approx(expected, abs=within)
    first, last = found.find_extreme_parts()
    assert first.start_s < last.start_s
    assert first.heading_error_deg > last.heading_error_deg


def test_heading_drift_estimate_ignores_position_scale_error():
    flight, _ = with_heading_drift(simulated(passes=6))
    scale = 1.3
    scaled = tuple(
        replace(track, samples=track.samples.assign(**scale * track.samples[Columns.POSITION]))
        for track in flight.positions
    )
    ranges_deg = []
    for flown, sigma_m in (
        (flight, SIGMA_UWB_M),
        (replace(flight, positions=scaled), scale * SIGMA_UWB_M),
    ):
        first, last = estimate(flown, sigma_m).find_extreme_parts()
        ranges_deg.append(first.heading_error_deg - last.heading_error_deg)
    assert ranges_deg[1] == pytest.approx(ranges_deg[0], rel=0.15)


def test_heading_misalignment_without_data_gives_reason():
    flight = simulated()
    few = tuple(replace(t, samples=t.samples.iloc[:40]) for t in flight.positions)
    for changed, reason in (
        ({"attitude": Unavailable("attitude", "not logged", "")}, "not logged"),
        ({"imu": Unavailable("IMU", "not logged", "")}, "not logged"),
        ({"imu": flight.imu.iloc[::10]}, "the IMU is logged at only"),
        ({"attitude": flight.attitude.iloc[::25]}, "the attitude is logged at only"),
        ({"positions": few}, "only 10 measurements"),
    ):
        found = estimate(replace(flight, **changed))
        assert isinstance(found, Unavailable)
        assert reason in found.reason


@pytest.mark.reallogs
@pytest.mark.parametrize(
    ("log", "drifts", "low", "high"),
    [
        ("vladimireganov_ROS_PX4_MOCAP_log_3_2022-6-9-13-01-36", True, -7.0, 3.0),
        ("vladimireganov_ROS_PX4_MOCAP_square2", True, -30.0, -15.0),
        # motion of 0.7 m along one direction: σ 5°
        ("mengchaoheng_PX4_ulog_plottools_hist_6a8cf408_test3", False, -15.0, 15.0),
    ],
)
def test_heading_error_is_equal_from_positions_and_orientation(shared_logs, log, drifts, low, high):
    """Their orientation gives the misalignment of EKF2's magnetometer heading; so do positions."""
    flight = read_log(shared_logs / "real" / f"{log}.ulg")
    found = estimate(flight, 0.001)
    assert found.drifts == drifts
    assert all(low < part.heading_error_deg < high for part in found.parts)
    middles = [(part.start_s + part.end_s) / 2.0 for part in found.parts]
    # the positions alone give the same angles
    tracks = tuple(replace(track, orientation=None) for track in flight.positions)
    alone = estimate(replace(flight, positions=tracks), 0.001)
    for part in alone.parts:
        middle = (part.start_s + part.end_s) / 2.0
        turn = np.interp(middle, middles, [one.heading_error_deg for one in found.parts])
        assert part.heading_error_deg == pytest.approx(turn, abs=8.0)


# ---- parts and drift ----------------------------------------------------------------------------


def test_heading_error_is_estimated_for_all_parts_of_long_flight() -> None:
    """1,000 measurements in 25 minutes: fewer than three per part of ``FLIGHT_PART_DURATION_S``."""
    time = np.linspace(0.0, 1500.0, 1000)
    parts = frame_rotation._average_flight_parts(
        time, np.radians(np.full(1000, 4.0)), np.radians(1.0)
    )
    assert len(parts) > 100
    assert parts[0].start_s == 0.0
    assert parts[-1].end_s == 1500.0
    assert all(part.heading_error_deg == pytest.approx(4.0) for part in parts)


def test_heading_drift_requires_minimum_angle_and_small_p_value() -> None:
    for spread, drift_p, drifts in ((1.0, 0.0, True), (0.999, 0.0, False), (9.0, 1.0, False)):
        turns = (0.0, spread * frame_rotation.MIN_HEADING_DRIFT_DEG)
        parts = tuple(
            HeadingErrorInPart(float(n), n + 1.0, turn, 0.1) for n, turn in enumerate(turns)
        )
        found = frame_rotation.combine_heading_parts(parts, drift_p, "positions")
        assert (found.drifts, found.misalignment_deg) == (drifts, pytest.approx(np.mean(turns)))
