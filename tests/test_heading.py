"""The turn of the source's frame over the flight, against flights whose heading is known."""

from __future__ import annotations

from functools import cache

import numpy as np
import pandas as pd
import pytest
from exchange import replace
from scipy.spatial.transform import Rotation

from px4fuse.comparison.preparation import choose_segment, choose_source
from px4fuse.filter import heading
from px4fuse.filter.heading import MAX_DRIFT_P, HeadingError, HeadingPart, estimate_heading_error
from px4fuse.filter.settings import Settings
from px4fuse.flight import Columns, Flight, Unavailable
from px4fuse.readers import read_log
from px4fuse.simulation.flights import simulate_flight
from px4fuse.simulation.mistakes import parse
from px4fuse.simulation.scenario import Scenario

SIGMA_UWB_M = 0.03
WANDER_DEG = 40.0


@cache
def flown(*mistakes: str, seed: int = 3, **scenario: float) -> Flight:
    made = Scenario(seed=seed, **{"sigma_uwb_m": SIGMA_UWB_M, "passes": 4, **scenario})
    return simulate_flight(made, parse(mistakes))


def estimated(flight: Flight, sigma_z_m: float = SIGMA_UWB_M) -> HeadingError | Unavailable:
    track, _ = choose_source(flight)
    return estimate_heading_error(
        flight, track, choose_segment(flight, track), Settings(), sigma_z_m
    )


def turned(quaternions: pd.DataFrame, turn_deg: np.ndarray) -> pd.DataFrame:
    """The same orientations with a heading that is wrong."""
    values = quaternions[Columns.QUATERNION].to_numpy(copy=True)
    wrong = Rotation.from_euler("Z", turn_deg[:, None], degrees=True)
    made = (wrong * Rotation.from_quat(values, scalar_first=True)).as_quat(scalar_first=True)
    return pd.DataFrame(made, index=quaternions.index, columns=Columns.QUATERNION)


def wandering(flight: Flight) -> tuple[Flight, np.ndarray]:
    """A magnetometer turns the logged attitude more and more; and by how much at each sample."""
    turn = WANDER_DEG * np.linspace(0.0, 1.0, len(flight.attitude))
    return replace(flight, attitude=turned(flight.attitude, turn)), turn


@pytest.mark.parametrize("turn_deg", [0.0, 20.0, -40.0])
def test_a_constant_turn_comes_back_and_is_called_constant(turn_deg):
    found = estimated(flown(*([f"yaw={turn_deg:g}"] if turn_deg else [])))
    assert not found.drifts
    assert found.turn_deg == pytest.approx(turn_deg, abs=3.0 * found.sigma_deg)
    assert found.sigma_deg < 3.0


@pytest.mark.parametrize("by", ["positions", "orientation"])
def test_a_heading_that_wanders_is_followed(by):
    """By the positions; a source's own orientation tells it at once, and closer."""
    plain = flown(passes=6 if by == "positions" else 4)
    flight, turn = wandering(plain)
    if by == "orientation":
        oriented = plain.attitude.iloc[::4].assign(**dict.fromkeys(Columns.ROTATION_VARIANCE, 1e-4))
        tracks = tuple(replace(track, orientation=oriented) for track in flight.positions)
        flight = replace(flight, positions=tracks)
    found = estimated(flight)
    assert found.by == by
    assert found.drifts
    assert found.drift_p < MAX_DRIFT_P
    for part in found.parts:
        middle = (part.start_s + part.end_s) / 2.0
        expected = -np.interp(middle, flight.attitude.index, turn)
        within = 0.5 if by == "orientation" else 3.5 * part.sigma_deg
        assert part.heading_error_deg == pytest.approx(expected, abs=within)
    first, last = found.ends
    assert first.start_s < last.start_s
    assert first.heading_error_deg > last.heading_error_deg


def test_what_cannot_be_told_says_why():
    flight = flown()
    few = tuple(replace(t, samples=t.samples.iloc[:40]) for t in flight.positions)
    for changed, reason in (
        ({"attitude": Unavailable("attitude", "not logged", "")}, "not logged"),
        ({"imu": Unavailable("IMU", "not logged", "")}, "not logged"),
        ({"imu": flight.imu.iloc[::10]}, "the IMU is too slow"),
        ({"attitude": flight.attitude.iloc[::25]}, "the attitude is too slow"),
        ({"positions": few}, "too few"),
    ):
        found = estimated(replace(flight, **changed))
        assert isinstance(found, Unavailable)
        assert reason in found.reason


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
    assert found.drifts == drifts
    assert all(low < part.heading_error_deg < high for part in found.parts)
    middles = [(part.start_s + part.end_s) / 2.0 for part in found.parts]
    # and the positions alone say the same
    tracks = tuple(replace(track, orientation=None) for track in flight.positions)
    alone = estimated(replace(flight, positions=tracks), 0.001)
    for part in alone.parts:
        middle = (part.start_s + part.end_s) / 2.0
        turn = np.interp(middle, middles, [one.heading_error_deg for one in found.parts])
        assert part.heading_error_deg == pytest.approx(turn, abs=8.0)


# ---- what is said of it -------------------------------------------------------------------------


def test_a_long_flight_whose_positions_are_thinned_still_has_parts() -> None:
    """1,000 measurements over 25 minutes: further apart than a third of a short part."""
    time = np.linspace(0.0, 1500.0, 1000)
    parts = heading._mean_per_part(
        time, np.radians(np.full(1000, 4.0)), np.radians(np.full(1000, 1.0))
    )
    assert len(parts) > 100
    assert parts[0].start_s == 0.0
    assert parts[-1].end_s == 1500.0
    assert all(part.heading_error_deg == pytest.approx(4.0) for part in parts)


def test_a_heading_drifts_where_it_turned_far_enough() -> None:
    for spread, drift_p, drifts in ((1.0, 0.0, True), (0.999, 0.0, False), (9.0, 1.0, False)):
        turns = (0.0, spread * heading.MIN_DRIFT_DEG)
        parts = tuple(HeadingPart(float(n), n + 1.0, turn, 0.1) for n, turn in enumerate(turns))
        found = heading.combine_heading_parts(parts, drift_p, "positions")
        assert (found.drifts, found.turn_deg) == (drifts, pytest.approx(np.mean(turns)))
