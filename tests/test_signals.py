"""Frames, gravity, axes, averages, segments and resets, against closed forms."""

from itertools import pairwise

import numpy as np
import pandas as pd
import pytest
from exchange import replace
from filter_tools import attitude_table, imu_table
from flights import aisle_flight, table
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import trapezoid
from scipy.spatial.transform import Rotation

from px4fuse.comparison.preparation import choose_segment, shift_timestamps
from px4fuse.comparison.projection import remove_origin_resets
from px4fuse.errors import MissingDataError, SettingsError
from px4fuse.filter.signals import (
    Segment,
    compute_mean_step_acceleration,
    compute_ned_acceleration,
    estimate_main_heading,
    integrate_ned_acceleration,
    make_axes,
)
from px4fuse.flight.model import (
    AS_RECEIVED_ORIGIN,
    AXIS_NAMES,
    Columns,
    Ekf2,
    Flight,
    LogInfo,
    PositionTrack,
    Reset,
    Unavailable,
)

GRAVITY = 9.80665
NORTH = np.array([1.0, 0.0, 0.0])
ALL = Segment(-np.inf, np.inf, "all")
ABSENT = Unavailable("thing", "not in this log", "Log it.")


def still_imu(time, force=(0.0, 0.0, -GRAVITY)):
    return imu_table(time, np.broadcast_to(force, (len(time), 3)), np.zeros((len(time), 3)))


def track_of(time, positions, name="vehicle_visual_odometry", origin=AS_RECEIVED_ORIGIN):
    values = np.hstack([positions, np.full((len(time), 3), np.nan)])
    samples = table(time, values, Columns.POSITION + Columns.POSITION_VARIANCE)
    return PositionTrack(name, origin, "", samples, "NED", "", (name,))


def flight_of(*, imu=ABSENT, attitude=ABSENT, track=None, duration_s=10.0, airborne=ABSENT):
    log = LogInfo("made.ulg", "", 0, "ULog", "", "", "", 0.0, duration_s)
    tracks = () if track is None else (track,)
    return Flight(log, imu, attitude, tracks, ABSENT, ABSENT, airborne)


# ---- acceleration in NED ----------------------------------------------------------------------


def ned_acceleration_of(time, force, attitude):
    """Return the acceleration in NED of a specific force in the body frame."""
    return compute_ned_acceleration(flight_of(imu=still_imu(time, force), attitude=attitude))


@pytest.mark.parametrize(
    "angles_deg", [(0.0, 0.0, 0.0), (40.0, 0.0, 0.0), (0.0, 25.0, 0.0), (120.0, -10.0, 170.0)]
)
def test_ned_acceleration_at_rest_is_zero_at_any_attitude(angles_deg):
    time = np.arange(0.0, 5.0, 0.01)
    tilt = Rotation.from_euler("ZYX", angles_deg, degrees=True)
    attitude = attitude_table(time[::5], Rotation.concatenate([tilt] * len(time[::5])))
    acceleration = ned_acceleration_of(time, tilt.inv().apply([0.0, 0.0, -GRAVITY]), attitude)
    assert list(acceleration.columns) == list(AXIS_NAMES)
    np.testing.assert_allclose(acceleration, 0, atol=1e-12)
    np.testing.assert_array_equal(acceleration.index, time[time <= time[::5][-1]])


@pytest.mark.parametrize("axis", [(0, 0, 1), (0, 1, 0), (0.6, 0.0, 0.8)])
@pytest.mark.parametrize("rate_rad_s", [0.5, -3.0])
def test_ned_acceleration_is_recovered_on_rotating_body(axis, rate_rad_s):
    """Turning at a constant rate, the specific force is R(t)ᵀ(a − g); a must come back.

    The attitude is logged ten times slower than the IMU. Linear interpolation of quaternions has
    an error of at most 2e-5 rad for 0.15 rad between two attitudes.
    """
    truth = np.array([1.0, -2.0, 0.5])
    start = Rotation.from_euler("ZYX", [30.0, 5.0, -8.0], degrees=True)

    def body_to_ned(time):
        return start * Rotation.from_rotvec(np.outer(time * rate_rad_s, axis))

    time = np.arange(0.0, 5.0, 0.005)
    force = body_to_ned(time).inv().apply(truth - [0.0, 0.0, GRAVITY])
    acceleration = ned_acceleration_of(
        time, force, attitude_table(time[::10], body_to_ned(time[::10]))
    )
    assert len(acceleration) > 980
    np.testing.assert_allclose(acceleration, np.tile(truth, (len(acceleration), 1)), atol=3e-4)


def test_ned_acceleration_without_attitude_is_unavailable():
    time = np.arange(0.0, 1.0, 0.01)
    level = attitude_table(time, Rotation.identity(len(time)))
    assert compute_ned_acceleration(flight_of(attitude=level)) is ABSENT
    assert compute_ned_acceleration(flight_of(imu=still_imu(time))) is ABSENT
    assert (
        "overlap" in ned_acceleration_of(time, (0.0, 0.0, 0.0), level.set_axis(time + 100.0)).reason
    )


# ---- averages over steps ----------------------------------------------------------------------


def acceleration_of(time, values):
    return integrate_ned_acceleration(table(time, np.outer(values, NORTH), AXIS_NAMES), ALL)


intervals = st.lists(st.integers(1, 50), min_size=3, max_size=40)


@given(intervals, st.data())
def test_acceleration_mean_per_step_of_linear_signal_is_exact(gaps_ms, data):
    """Between samples the signal is a straight line; steps that end on samples average exactly."""
    time = np.concatenate([[0.0], np.cumsum(gaps_ms) * 1e-3])
    count = len(time)
    values = np.array(data.draw(st.lists(st.floats(-20, 20), min_size=count, max_size=count)))
    ends = data.draw(st.sets(st.integers(0, len(time) - 1), min_size=2))
    at = sorted(ends)
    mean, _ = compute_mean_step_acceleration(acceleration_of(time, values), NORTH, time[at])
    for step, (first, last) in enumerate(pairwise(at)):
        area = trapezoid(values[first : last + 1], time[first : last + 1])
        assert mean[step] == pytest.approx(area / (time[last] - time[first]), abs=1e-9)


@pytest.mark.parametrize(
    ("time", "edges", "gaps"),
    [
        # nothing strictly between 2 s and 3 s
        (np.r_[0.0:2.005:0.01, 3.0:10.0:0.01], [0.0, 1.0, 1.5, 2.5, 2.7, 2.9, 4.0, 5.0],
         [0.0, 0.0, 0.5, 1.0, 1.0, 0.1 / 1.1, 0.0]),
        (np.r_[1.0:2.001:0.01], [0.0, 0.5, 1.5, 2.5, 3.0], [1.0, 0.5, 0.5, 1.0]),
        # 8.6 Hz as in a real log: every interval is long, none is longer than the rest
        (np.r_[0.0 : 20.0 : 1 / 8.6], np.arange(0.0, 19.0, 0.1), np.zeros(189)),
    ],
)  # fmt: skip
def test_imu_gap_fraction_is_fraction_of_step_without_imu_data(time, edges, gaps):
    """In a gap between equal values the mean is that value; outside the data it is zero."""
    acceleration = acceleration_of(time, np.ones(len(time)))
    mean, gap = compute_mean_step_acceleration(acceleration, NORTH, edges)
    np.testing.assert_allclose(gap, gaps, atol=1e-9)
    inside = np.clip(np.diff(np.clip(edges, time[0], time[-1])) / np.diff(edges), 0.0, 1.0)
    np.testing.assert_allclose(mean, inside, atol=1e-9)


def test_acceleration_rms_uses_only_the_evaluated_segment():
    time = np.arange(0.0, 10.0, 0.01)
    pushed = table(time, np.outer(np.where(time < 5.0, 100.0, 2.0), NORTH), AXIS_NAMES)
    inside = integrate_ned_acceleration(pushed, Segment(5.0, 9.0, ""))
    assert inside.compute_rms_m_s2(NORTH) == pytest.approx(2.0)
    assert isinstance(integrate_ned_acceleration(pushed, Segment(15.0, 19.0, "")), Unavailable)


# ---- axes -------------------------------------------------------------------------------------


def line_track(heading_deg, count=200, noise=0.0):
    """Return a track along a direction, ±6 m, at a height of 1.5 m."""
    time = np.arange(count) / 5.0
    along = 6.0 * np.sin(0.4 * time)
    heading = np.radians(heading_deg)
    middle = np.array([3.0, -4.0, -1.5])
    positions = middle + np.outer(along, [np.cos(heading), np.sin(heading), 0.0])
    positions += np.random.default_rng(1).normal(0.0, noise, positions.shape) if noise else 0.0
    return track_of(time, positions), along


@pytest.mark.parametrize("heading_deg", [0.0, 30.0, 90.0, 135.0, 179.0, 210.0])
def test_axis_of_largest_motion_is_direction_of_straight_track(heading_deg):
    heading, elongation = estimate_main_heading(line_track(heading_deg)[0], ALL)
    assert (heading - heading_deg + 90.0) % 180.0 - 90.0 == pytest.approx(0.0, abs=1e-6)
    assert 0.0 <= heading < 180.0
    assert elongation > 1e6


def test_positions_are_projected_on_each_axis():
    track, along = line_track(30.0)
    axes = {axis.name: axis for axis in make_axes(flight_of(track=track), track, ALL)}
    assert list(axes) == ["north", "east", "down", "aisle"]
    for at, name in enumerate(AXIS_NAMES):
        np.testing.assert_array_equal(axes[name].measurement_m, track.samples[Columns.POSITION[at]])
    assert (axes["north"].heading_deg, axes["east"].heading_deg) == (0.0, 90.0)
    assert axes["down"].heading_deg is None
    offset = np.dot([3.0, -4.0], [np.cos(np.radians(30)), np.sin(np.radians(30))])
    np.testing.assert_allclose(axes["aisle"].measurement_m, along + offset, atol=1e-9)


def test_positions_and_imu_are_projected_on_requested_heading():
    time = np.arange(0.0, 10.0, 0.01)
    track, _ = line_track(30.0, count=50)
    flight = flight_of(
        imu=still_imu(time, (3.0, 4.0, -GRAVITY)),
        attitude=attitude_table(time, Rotation.identity(len(time))),
    )
    heading = float(np.degrees(np.arctan2(4, 3)))
    (axis,) = make_axes(flight, track, ALL, names=("aisle",), heading_deg=heading)
    expected = 0.6 * track.samples["north_m"] + 0.8 * track.samples["east_m"]
    np.testing.assert_allclose(axis.measurement_m, expected, atol=1e-12)
    np.testing.assert_allclose(
        axis.acceleration.compute_velocity_change_m_s(axis.direction), 5.0 * time, atol=1e-11
    )
    assert axis.heading_deg == heading
    assert "--heading" in axis.note


def test_clock_shift_changes_only_timestamps():
    track, _ = line_track(30.0)
    moved = shift_timestamps(track, -0.1)
    np.testing.assert_allclose(moved.samples.index, track.samples.index - 0.1, atol=1e-12)
    np.testing.assert_array_equal(moved.samples, track.samples)
    kept = {name: getattr(track, name) for name in ("samples", "invalid_reasons", "status")}
    assert replace(moved, **kept) == track


def test_kf_uses_only_measurements_of_evaluated_segment():
    track, _ = line_track(30.0)
    track.samples["down_m"] = np.nan
    axes = make_axes(flight_of(track=track), track, ALL)
    assert [axis.name for axis in axes] == ["north", "east", "aisle"]
    assert all(np.isfinite(axis.measurement_m).all() for axis in axes)
    with pytest.raises(MissingDataError, match="down"):
        make_axes(flight_of(track=track), track, ALL, names=("down",))

    (axis,) = make_axes(flight_of(track=track), track, Segment(4.0, 8.0, ""), names=("east",))
    assert (axis.measurement_time_s[0], axis.measurement_time_s[-1]) == (4.0, 8.0)


# ---- position sources and the segment -----------------------------------------------------------


def straight(first_s, last_s):
    time = np.arange(first_s, last_s + 0.1, 0.2)
    return track_of(time, np.zeros((len(time), 3)))


@pytest.mark.parametrize(("airborne", "expected"), [
    (((4.0, 12.0),), (4.0, 12.0)),
    (((4.0, 6.0), (8.0, 12.0)), (4.0, 12.0)),  # first take-off to last touch-down
    (((0.0, 30.0),), (2.0, 18.0)),
    (((10.0, 30.0),), (10.0, 18.0)),
    ((), (2.0, 18.0)),  # without take-off
    (((19.0, 20.0),), (2.0, 18.0)),  # no positions in flight
    (ABSENT, (2.0, 18.0)),  # no land detector
])  # fmt: skip
def test_default_segment_is_time_in_flight_with_positions(airborne, expected):
    track = straight(2.0, 18.0)
    flight = flight_of(track=track, duration_s=20.0, airborne=airborne)
    segment = choose_segment(flight, track)
    assert (segment.start_s, segment.end_s) == pytest.approx(expected)
    assert segment.reason


def test_evaluated_segment_uses_start_and_end_options():
    track = straight(2.0, 18.0)
    flight = flight_of(track=track, duration_s=20.0, airborne=((4.0, 12.0),))
    for start_s, end_s in ((5.0, None), (None, 9.0), (3.0, 15.0)):
        segment = choose_segment(flight, track, start_s, end_s)
        assert (segment.start_s, segment.end_s) == (start_s or 4.0, end_s or 12.0)
        assert ("--start" in segment.reason) == (start_s is not None)
        assert ("--end" in segment.reason) == (end_s is not None)
    for start_s, end_s, said in (
        (9.0, 9.0, "is not after"), (9.0, 5.0, "is not after"), (50.0, None, "0 positions"),
        (5.0, 5.3, "at least 3"), (18.5, 19.5, "at least 3"),
        (50.0, 60.0, "between 50 s and 60 s"),
    ):  # fmt: skip
        with pytest.raises(SettingsError, match=said):
            choose_segment(flight, track, start_s, end_s)


# ---- resets of EKF2 ---------------------------------------------------------------------------

STATE_TIME = np.arange(0.0, 20.0, 0.1)
EV_TIME = np.arange(0.05, 19.8, 0.2)


def truth_at(time):
    """Slow curve on which a shift in time or position is visible."""
    return np.stack([0.5 * time, 2.0 * np.sin(0.3 * time), -1.5 + 0.0 * time], axis=1)


def ekf2_of(offset, resets, velocity=0.0):
    """Return EKF2 that publishes ground truth plus an offset, shape (n, 3)."""
    state = np.hstack([truth_at(STATE_TIME) + offset, np.full((len(STATE_TIME), 3), velocity)])
    known = table(STATE_TIME, state, Columns.POSITION + Columns.VELOCITY)
    absent = dict.fromkeys(AXIS_NAMES, ABSENT)
    return Ekf2(known, ABSENT, absent, (), ABSENT, tuple(resets), ((-np.inf, 0),), 5.0)


def noisy_track():
    noise = np.random.default_rng(3).normal(0.0, 0.1, (len(EV_TIME), 3))
    return track_of(EV_TIME, truth_at(EV_TIME) + noise)


WHOLE = Segment(0.0, 19.9, "")


@pytest.mark.parametrize(
    ("at", "good"),
    [([2.0], 0), ([6.0], 0), ([17.0], 0), *(([5.0, 15.0], good) for good in range(3))],
)
def test_ekf2_position_jump_at_origin_shift_is_removed(at, good):
    """The source is in the frame of the first, middle or last stretch between resets."""
    deltas = np.array([[1.0, 0.5, 0.0], [-3.0, 2.0, 0.0]])[: len(at)]
    later = STATE_TIME[:, None] >= np.array(at)
    offset = later @ deltas - deltas[:good].sum(axis=0)
    resets = [Reset(t, "position", tuple(d)) for t, d in zip(at, deltas, strict=True)]
    state, statement = remove_origin_resets(ekf2_of(offset, resets), noisy_track(), WHOLE)
    np.testing.assert_allclose(state[Columns.POSITION], truth_at(STATE_TIME), atol=1e-12)
    assert f"{len(at)} of horizontal position" in statement
    assert "removed" in statement
    assert "kept" not in statement


@pytest.mark.parametrize("reset_s", [4.0, 10.0, 15.0])
def test_ekf2_reset_that_corrects_drift_is_kept_in_ekf2_track(reset_s):
    """EKF2 drifts by 2 m and a reset moves it back to the source."""
    drift = np.where(reset_s > STATE_TIME, 2.0 * STATE_TIME / reset_s, 0.0)
    resets = [Reset(reset_s, kind, (-2.0, 0.0, 0.0)) for kind in ("position", "velocity")]
    ekf2 = ekf2_of(np.outer(drift, NORTH), resets)
    state, statement = remove_origin_resets(ekf2, noisy_track(), WHOLE)
    pd.testing.assert_frame_equal(state, ekf2.state)
    assert "kept" in statement
    assert "1 of velocity" in statement
    assert "undone" not in statement


def test_removing_position_reset_keeps_ekf2_height_reset():
    frame_change = np.where(STATE_TIME >= 8.0, 3.0, 0.0)
    drift = np.where(STATE_TIME < 12.0, 0.1 * STATE_TIME, 0.0)
    offset = np.stack([frame_change, 0.0 * drift, drift], axis=1)
    resets = [Reset(8.0, "position", (3.0, 0.0, 0.0)), Reset(12.0, "position", (0.0, 0.0, -1.2))]
    ekf2 = ekf2_of(offset, resets)
    state, statement = remove_origin_resets(ekf2, noisy_track(), WHOLE)
    np.testing.assert_allclose(state["north_m"], truth_at(STATE_TIME)[:, 0], atol=1e-12)
    np.testing.assert_array_equal(state["down_m"], ekf2.state["down_m"])
    assert "horizontal" in statement.split("EKF2 resets")[1]
    assert "height" in statement.split("EKF2 resets")[2]


def test_ekf2_height_reset_stays_in_track_without_source_height():
    """A source without height contains no information on a change of the frame."""
    track = noisy_track()
    blind = replace(track, samples=track.samples.assign(down_m=np.nan))
    offset = np.where(STATE_TIME[:, None] >= 8.0, [0.0, 0.0, 3.0], 0.0)
    ekf2 = ekf2_of(offset, [Reset(8.0, "position", (0.0, 0.0, 3.0))])
    assert "removed" in remove_origin_resets(ekf2, track, WHOLE)[1]
    state, statement = remove_origin_resets(ekf2, blind, WHOLE)
    pd.testing.assert_frame_equal(state, ekf2.state)
    assert (
        statement
        == "Jumps by EKF2 resets (1 of height) are kept in EKF2's track: the resets correct an "
        "error of EKF2"
    )


@pytest.mark.parametrize(("reset_s", "said"), [
    (0.5, ""), (1.0, ""), (1.1, "kept"), (17.9, "kept"), (18.0, "kept"),
    (18.5, ""),
])  # fmt: skip
def test_ekf2_resets_outside_evaluated_segment_stay_in_the_track(reset_s, said):
    """A reset at the start defines the frame; one at the end affects the last sample only."""
    ekf2 = ekf2_of(np.zeros(3), [Reset(reset_s, "position", (5.0, 5.0, 0.0))])
    state, statement = remove_origin_resets(ekf2, noisy_track(), Segment(1.0, 18.0, ""))
    pd.testing.assert_frame_equal(state, ekf2.state)
    assert said in statement
    assert bool(said) == bool(statement)


def test_axis_label_states_largest_motion_or_heading_option() -> None:
    flight = aisle_flight()
    labels = {axis.name: axis.label for axis in make_axes(flight, flight.positions[0], ALL)}
    assert (labels["north"], labels["aisle"]) == ("north", "the axis of largest motion")
    *_, aisle = make_axes(flight, flight.positions[0], ALL, heading_deg=10.0)
    assert aisle.label == "the axis of --heading"
