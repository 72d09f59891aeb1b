"""The turn of the source's frame over the flight, against flights whose heading is known."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from px4fuse.filter.heading import DRIFT_P, HeadingError, heading_error
from px4fuse.filter.kalman import Settings
from px4fuse.filter.signals import choose_segment, choose_source
from px4fuse.flight import QUATERNION_COLUMNS, ROTATION_VARIANCE_COLUMNS, Flight, Unavailable
from px4fuse.readers import read_log
from px4fuse.simulation.flights import simulate_flight
from px4fuse.simulation.mistakes import parse
from px4fuse.simulation.scenario import Scenario

SIGMA_UWB_M = 0.03
WANDER_DEG = 24.0


@cache
def flown(*mistakes: str, seed: int = 3, **scenario: float) -> Flight:
    made = Scenario(seed=seed, **{"sigma_uwb_m": SIGMA_UWB_M, "passes": 4, **scenario})
    return simulate_flight(made, parse(mistakes))


def estimated(flight: Flight, sigma_z_m: float = SIGMA_UWB_M) -> HeadingError | Unavailable:
    track, _ = choose_source(flight)
    return heading_error(flight, track, choose_segment(flight, track), Settings(), sigma_z_m)


def turned(quaternions: pd.DataFrame, turn_deg: np.ndarray) -> pd.DataFrame:
    """The same orientations with a heading that is wrong."""
    values = quaternions[QUATERNION_COLUMNS].to_numpy(copy=True)
    wrong = Rotation.from_euler("Z", turn_deg[:, None], degrees=True)
    made = (wrong * Rotation.from_quat(values, scalar_first=True)).as_quat(scalar_first=True)
    return pd.DataFrame(made, index=quaternions.index, columns=QUATERNION_COLUMNS)


def wandering(flight: Flight) -> tuple[Flight, np.ndarray]:
    """A magnetometer turns the logged attitude more and more; and by how much at each sample."""
    assert isinstance(flight.attitude, pd.DataFrame)
    turn = WANDER_DEG * np.linspace(0.0, 1.0, len(flight.attitude))
    return replace(flight, attitude=turned(flight.attitude, turn)), turn


@pytest.mark.parametrize("turn_deg", [0.0, 20.0, -40.0])
def test_a_constant_turn_comes_back_and_is_called_constant(turn_deg):
    found = estimated(flown(*([f"yaw={turn_deg:g}"] if turn_deg else [])))
    assert isinstance(found, HeadingError)
    assert not found.drifts
    assert found.turn_deg == pytest.approx(turn_deg, abs=3.0 * found.sigma_deg)
    assert found.sigma_deg < 3.0


def test_a_heading_that_wanders_is_followed():
    flight, turn = wandering(flown())
    found = estimated(flight)
    assert isinstance(found, HeadingError)
    assert found.by == "positions"
    assert found.drift_p < DRIFT_P
    assert found.drifts
    for part in found.parts:
        middle = (part.start_s + part.end_s) / 2.0
        expected = -np.interp(middle, flight.attitude.index, turn)
        assert part.heading_error_deg == pytest.approx(expected, abs=3.5 * part.sigma_deg)
    first, last = found.ends
    assert first.start_s < last.start_s
    assert first.heading_error_deg > last.heading_error_deg


def test_the_sources_own_orientation_tells_it_at_once():
    flight, turn = wandering(flown())
    true = pd.DataFrame(flown().attitude).iloc[::4]
    oriented = true.assign(**dict.fromkeys(ROTATION_VARIANCE_COLUMNS, 1e-4))
    tracks = tuple(replace(track, orientation=oriented) for track in flight.positions)
    found = estimated(replace(flight, positions=tracks))
    assert isinstance(found, HeadingError)
    assert found.by == "orientation"
    assert found.drifts
    for part in found.parts:
        middle = (part.start_s + part.end_s) / 2.0
        expected = -np.interp(middle, flight.attitude.index, turn)
        assert part.heading_error_deg == pytest.approx(expected, abs=0.5)


def test_what_cannot_be_told_says_why():
    flight = flown()
    assert isinstance(
        estimated(replace(flight, attitude=Unavailable("attitude", "", ""))), Unavailable
    )
    assert isinstance(estimated(replace(flight, imu=Unavailable("IMU", "", ""))), Unavailable)
    slow = replace(flight, imu=flight.imu.iloc[::10])
    found = estimated(slow)
    assert isinstance(found, Unavailable)
    assert "too slow" in found.reason
    few = tuple(replace(t, samples=t.samples.iloc[:40]) for t in flight.positions)
    found = estimated(replace(flight, positions=few))
    assert isinstance(found, Unavailable)
    assert "too few" in found.reason


@pytest.mark.reallogs
@pytest.mark.parametrize(
    ("log", "drifts", "low", "high"),
    [
        ("vladimireganov_ROS_PX4_MOCAP_log_3_2022-6-9-13-01-36", True, -7.0, 3.0),
        ("vladimireganov_ROS_PX4_MOCAP_square2", True, -30.0, -15.0),
        ("mengchaoheng_PX4_ulog_plottools_hist_6a8cf408_test3", False, -5.0, 5.0),
    ],
)
def test_motion_capture_flights(shared_logs, log, drifts, low, high):
    """Their own orientation says how EKF2's heading, by the magnetometer, lies to the frame."""
    flight = read_log(shared_logs / "real" / f"{log}.ulg")
    found = estimated(flight, 0.001)
    assert isinstance(found, HeadingError)
    assert found.drifts == drifts
    assert all(low < part.heading_error_deg < high for part in found.parts)
    # and the positions alone say the same
    tracks = tuple(replace(track, orientation=None) for track in flight.positions)
    alone = estimated(replace(flight, positions=tracks), 0.001)
    assert isinstance(alone, HeadingError)
    middles = [(part.start_s + part.end_s) / 2.0 for part in alone.parts]
    turns = [part.heading_error_deg for part in alone.parts]
    for part in found.parts:
        turn = np.interp((part.start_s + part.end_s) / 2.0, middles, turns)
        assert turn == pytest.approx(part.heading_error_deg, abs=6.0)
