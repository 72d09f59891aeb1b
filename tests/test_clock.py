"""The clock offset against flights whose stamps are wrong by a known amount."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from flights import Array, aisle_flight, table, unavailable
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import binom

from px4fuse.analysis import clock_offset, tuned_horizontally
from px4fuse.comparison.comparison import compare
from px4fuse.filter.clock import (
    CHANGE_P,
    CONSTANTS,
    MIN_MEASUREMENTS,
    ClockOffset,
    PartOffset,
    _changes,
    _interval,
    _signals,
    _vertex,
    estimate_clock_offset,
)
from px4fuse.filter.kalman import Settings
from px4fuse.filter.signals import Segment
from px4fuse.flight import (
    ANGULAR_RATE_COLUMNS,
    POSITION_COLUMNS,
    POSITION_VARIANCE_COLUMNS,
    QUATERNION_COLUMNS,
    SPECIFIC_FORCE_COLUMNS,
    Flight,
    Unavailable,
)
from px4fuse.readers import read_log
from px4fuse.report.words import clock_advice

GRAVITY = np.array([0.0, 0.0, 9.80665])
AMPLITUDE = np.array([4.0, 1.0, 0.3])
PULSATION = 2.0 * np.pi / np.array([12.0, 7.0, 9.0])
IMU_HZ, UWB_HZ = 100.0, 5.0
SIGMA_A, SIGMA_Z, DT = 0.1, 0.1, 0.1
SETTINGS = Settings(sigma_a_m_s2=SIGMA_A, sigma_z_m=SIGMA_Z, dt_s=DT)


def position(time_s: Array) -> Array:
    """Truth: from rest, swinging in all three directions."""
    return AMPLITUDE * (1.0 - np.cos(np.outer(time_s, PULSATION)))


def acceleration(time_s: Array) -> Array:
    return AMPLITUDE * PULSATION**2 * np.cos(np.outer(time_s, PULSATION))


def attitude(time_s: Array) -> Rotation:
    """Truth, body to NED: yaw swings by 20°, pitch and roll by 10°."""
    phase = np.outer(time_s, 2.0 * np.pi / np.array([25.0, 6.0, 8.0]))
    angles = np.radians([30.0, 0.0, 5.0]) + np.radians([20.0, 10.0, 10.0]) * np.sin(phase)
    return Rotation.from_euler("ZYX", angles)


def made_flight(
    seed: int = 1,
    *,
    offset_s: float = 0.0,
    duration_s: float = 60.0,
    moving: float = 1.0,
    jump_s: float = 0.0,
    drift_ppm: float = 0.0,
    outliers: int = 0,
    biased: bool = True,
) -> tuple[Flight, NDArray[np.bool_]]:
    """A flight to whose stamps ``offset_s`` must be added, and which positions are outliers.

    All sensor noise is white. The jump comes in mid-flight; the drift is zero there.
    """
    rng = np.random.default_rng(seed)
    scale = 1.0 if biased else 0.0
    tilt, gyro_bias, force_bias = (
        scale * rng.normal(0.0, sigma, 3) for sigma in (0.02, 0.002, 0.1)
    )
    time = np.arange(round(duration_s * IMU_HZ) + 1) / IMU_HZ
    h = 0.25 / IMU_HZ
    rate = (attitude(time - h).inv() * attitude(time + h)).as_rotvec() / (2.0 * h)
    force = attitude(time).inv().apply(moving * acceleration(time) - GRAVITY)
    rate += gyro_bias + rng.normal(0.0, 0.002, rate.shape)
    # averaged over DT it must be SIGMA_A
    force += force_bias + rng.normal(0.0, SIGMA_A * np.sqrt(DT * IMU_HZ), force.shape)
    logged = np.arange(round(duration_s * 50.0) + 1) / 50.0
    quaternion = (Rotation.from_rotvec(tilt) * attitude(logged)).as_quat(scalar_first=True)
    true = np.arange(round(duration_s * UWB_HZ)) / UWB_HZ + rng.uniform(0.0, 0.05)
    measured = moving * position(true) + rng.normal(0.0, SIGMA_Z, (len(true), 3))
    outlier = np.zeros(len(true), dtype=bool)
    outlier[rng.choice(np.arange(10, len(true) - 10), outliers, replace=False)] = True
    measured[outlier, :2] += 1.5
    middle = duration_s / 2.0
    stamps = true - offset_s - jump_s * (true > middle) - drift_ppm * 1e-6 * (true - middle)
    base = aisle_flight(seed=seed, duration_s=duration_s, ekf2=None, truth=False)
    track = replace(
        base.positions[0],
        samples=table(
            stamps,
            np.hstack([measured, np.full(measured.shape, np.nan)]),
            POSITION_COLUMNS + POSITION_VARIANCE_COLUMNS,
        ),
    )
    imu = table(time, np.hstack([force, rate]), SPECIFIC_FORCE_COLUMNS + ANGULAR_RATE_COLUMNS)
    flight = replace(
        base,
        imu=imu,
        attitude=table(logged, quaternion, QUATERNION_COLUMNS),
        positions=(track,),
    )
    return flight, outlier


def estimate(flight: Flight, **options: object) -> ClockOffset | Unavailable:
    segment = Segment(-np.inf, np.inf, "all of it")
    return estimate_clock_offset(flight, flight.positions[0], segment, SETTINGS, SIGMA_Z, **options)


def covers(found: ClockOffset, true_s: float) -> bool:
    return found.interval_s[0] <= true_s <= found.interval_s[1]


# --- what the IMU says ---


def imu_table(time: Array, force: Array, rate: Array) -> pd.DataFrame:
    return table(time, np.hstack([force, rate]), SPECIFIC_FORCE_COLUMNS + ANGULAR_RATE_COLUMNS)


def heading(angle: Array) -> Rotation:
    return Rotation.from_rotvec(np.outer(angle, [0.0, 0.0, 1.0]))


def attitude_table(time: Array, turn: Rotation) -> pd.DataFrame:
    return table(time, turn.as_quat(scalar_first=True), QUATERNION_COLUMNS)


def test_a_level_vehicle_at_rest_accelerates_in_no_direction() -> None:
    time = np.arange(0.0, 10.0, 0.01)
    still = np.zeros((len(time), 3))
    level = heading(np.full(len(time), 0.7))
    signals = _signals(
        imu_table(time, still - GRAVITY, still), attitude_table(time, level), (1.0, 9.0)
    )
    assert signals.value.shape[1:] == (3, 1 + CONSTANTS)
    for part in (signals.value, signals.velocity, signals.position):
        np.testing.assert_allclose(part[..., 0], 0.0, atol=1e-10)
    # tilt θ about north and east moves it sideways by θ × f, f = [0, 0, -g]; heading does not
    g = GRAVITY[2]
    np.testing.assert_allclose(
        signals.value[..., 1:4], np.broadcast_to([[0, -g, 0], [g, 0, 0], [0, 0, 0]],
                                                 (len(signals.time_s), 3, 3)), atol=1e-12
    )  # fmt: skip
    # an accelerometer bias b adds -R b
    np.testing.assert_allclose(
        signals.value[..., 7:], -np.broadcast_to(level[0].as_matrix(), (len(signals.time_s), 3, 3)),
        atol=1e-12,
    )  # fmt: skip


def test_a_gyro_bias_tilts_a_level_vehicle_ever_further() -> None:
    """Bias b about body x for t seconds tilts by -b t: -g b t sideways, -g b t²/2 in velocity."""
    time = np.arange(0.0, 10.0, 0.01)
    still = np.zeros((len(time), 3))
    level = heading(np.zeros(len(time)))
    signals = _signals(
        imu_table(time, still - GRAVITY, still), attitude_table(time, level), (1.0, 9.0)
    )
    t = signals.time_s - signals.time_s[0]
    by_bias = np.zeros((len(t), 3))
    by_bias[:, 1] = -GRAVITY[2] * t  # (-t, 0, 0) × (0, 0, -g)
    np.testing.assert_allclose(signals.value[..., 4], by_bias, atol=1e-9)
    np.testing.assert_allclose(signals.velocity[:, 1, 4], -GRAVITY[2] * t**2 / 2.0, atol=1e-9)


def test_a_constant_turn_goes_round_in_a_circle() -> None:
    """Yaw rate ω with a body acceleration s to the right: a = s (-sin ωt, cos ωt)."""
    omega, sideways = 0.5, 2.0
    time = np.arange(0.0, 20.0, 0.004)
    rate = np.tile([0.0, 0.0, omega], (len(time), 1))
    force = np.tile([0.0, sideways, 0.0], (len(time), 1)) - GRAVITY
    turn = heading(omega * time)
    # of the attitude, only the beginning is used: what EKF2 made of it later must not matter
    spoiled = Rotation.concatenate([turn[:300], heading(np.full(len(time) - 300, -0.3))])
    known = attitude_table(time, spoiled)
    signals = _signals(imu_table(time, force, rate), known, (0.5, 19.0))
    t = signals.time_s
    circle = sideways * np.stack([-np.sin(omega * t), np.cos(omega * t), 0.0 * t], axis=1)
    np.testing.assert_allclose(signals.value[..., 0], circle, atol=2e-5)
    radius = sideways / omega**2
    start = t[0]
    speed = (
        radius
        * omega
        * np.stack(
            [np.cos(omega * t) - np.cos(omega * start), np.sin(omega * t) - np.sin(omega * start)],
            1,
        )
    )
    np.testing.assert_allclose(signals.velocity[:, :2, 0], speed, atol=1e-4)


def test_between_two_times_the_signals_give_the_way_of_constant_acceleration() -> None:
    time = np.arange(0.0, 10.0, 0.01)
    still = np.zeros((len(time), 3))
    force = still + np.array([1.5, 0.0, -0.5]) - GRAVITY
    level = heading(np.zeros(len(time)))
    signals = _signals(imu_table(time, force, still), attitude_table(time, level), (0.0, 9.9))
    at = np.array([[0.5, 0.733, 4.0, 9.0], [0.617, 0.85, 4.117, 9.117]])
    speed, way = signals.between(at)
    step = np.diff(at, axis=1)[..., None]
    np.testing.assert_allclose(speed[..., 0], step * [1.5, 0.0, -0.5], atol=1e-10)
    np.testing.assert_allclose(way[..., 0], step**2 / 2.0 * [1.5, 0.0, -0.5], atol=1e-10)


# --- the arithmetic of profiles and parts ---


def test_a_parabola_gives_its_vertex_sigma_and_interval() -> None:
    grid = np.linspace(-0.1, 0.3, 41)
    drop = (grid - 0.123) ** 2 / (2.0 * 0.03**2)
    vertex, sigma = _vertex(grid, drop)
    assert vertex == pytest.approx(0.123)
    assert sigma == pytest.approx(0.03)
    (low, high), closed = _interval(grid, drop - drop.min())
    assert closed
    assert [low, high] == pytest.approx([0.123 - 1.96 * 0.03, 0.123 + 1.96 * 0.03], abs=1e-3)
    _, closed = _interval(grid[18:], drop[18:] - drop.min())
    assert not closed  # what lies below its lower end was not looked at


def test_drift_and_change_are_weighted_least_squares_of_the_parts() -> None:
    middle, sigma = np.array([20.0, 60.0, 100.0, 140.0]), np.array([0.01, 0.02, 0.01, 0.03])
    line = 0.05 + 800e-6 * middle
    parts = tuple(
        PartOffset(m - 20.0, m + 20.0, o, s) for m, o, s in zip(middle, line, sigma, strict=True)
    )
    drift, drift_sigma, p = _changes(parts)
    assert drift == pytest.approx(800.0)
    design = np.stack([np.ones(4), middle], axis=1) / sigma[:, None]
    assert drift_sigma == pytest.approx(1e6 * np.sqrt(np.linalg.inv(design.T @ design)[1, 1]))
    assert 0.0 < p < 0.05
    assert _changes(parts[:2])[0] is None
    assert _changes(parts[:1]) == (None, None, None)
    same = tuple(replace(part, offset_s=0.07) for part in parts)
    assert _changes(same)[2] == pytest.approx(1.0)


# --- recovery ---


@pytest.mark.parametrize("offset_s", [-0.3, -0.1, 0.0, 0.2, 0.3])
def test_the_offset_is_recovered_in_spite_of_tilt_and_biases(offset_s: float) -> None:
    found = estimate(made_flight(round(100 * offset_s) + 50, offset_s=offset_s)[0])
    assert found.determinable
    assert found.reason == ""
    assert found.offset_s == pytest.approx(offset_s, abs=0.02)
    assert covers(found, offset_s)
    assert found.interval_s[0] < found.offset_s < found.interval_s[1]
    assert found.sigma_s < 0.02
    # the noises were found, too
    assert found.sigma_z_m == pytest.approx(SIGMA_Z, rel=0.10)


SEEDS = 25


def test_the_interval_covers_the_truth_as_often_as_it_says() -> None:
    """200 seeds by hand: see the figure in the module's test report; here what time allows."""
    inside, normalised = [], []
    for seed in range(SEEDS):
        true_s = float(np.random.default_rng(1000 + seed).uniform(-0.3, 0.3))
        found = estimate(made_flight(seed, offset_s=true_s, duration_s=40.0)[0])
        inside.append(covers(found, true_s))
        normalised.append((found.offset_s - true_s) / found.sigma_s)
    # 1 % in the tail of a binomial distribution
    assert sum(inside) >= binom.ppf(0.01, SEEDS, 0.95)
    assert abs(np.mean(normalised)) < 2.6 / np.sqrt(SEEDS)
    assert 0.6 < np.std(normalised) < 1.4


def test_a_hover_determines_nothing_and_says_why() -> None:
    found = estimate(made_flight(3, moving=0.0)[0])
    assert not found.determinable
    assert "too little acceleration" in found.reason
    assert found.parts == ()
    assert found.change_p is None


def test_a_jump_in_mid_flight_shows_in_the_parts() -> None:
    found = estimate(made_flight(4, duration_s=120.0, jump_s=0.25)[0])
    assert found.change_p < CHANGE_P
    for part in found.parts:
        true_s = 0.25 if part.start_s > 55.0 else 0.0
        if part.end_s < 60.0 or part.start_s > 55.0:
            assert part.offset_s == pytest.approx(true_s, abs=4.0 * part.sigma_s)
    assert min(part.sigma_s for part in found.parts) < 0.05


def test_a_steady_clock_shows_no_change() -> None:
    found = estimate(made_flight(5, duration_s=120.0, offset_s=-0.2)[0])
    assert len(found.parts) >= 3
    assert found.change_p > 0.01
    assert abs(found.drift_ppm) < 3.0 * found.drift_sigma_ppm


def test_a_drift_of_1000_ppm_is_seen_with_its_sigma() -> None:
    found = estimate(made_flight(6, duration_s=240.0, drift_ppm=1000.0)[0])
    assert found.drift_ppm == pytest.approx(1000.0, abs=3.0 * found.drift_sigma_ppm)
    assert found.drift_sigma_ppm < 200.0
    assert found.change_p < CHANGE_P


def test_outliers_that_were_found_are_left_out() -> None:
    flight, outlier = made_flight(7, offset_s=0.15, outliers=15)
    clean = estimate(made_flight(7, offset_s=0.15)[0])
    times = flight.positions[0].samples.index.to_numpy()[outlier]
    with_them, without = estimate(flight), estimate(flight, outlier_time_s=times)
    assert without.count == with_them.count - 15
    assert without.sigma_z_m == pytest.approx(SIGMA_Z, rel=0.10)
    assert with_them.sigma_z_m > 1.5 * SIGMA_Z
    assert covers(without, 0.15)
    assert without.sigma_s < with_them.sigma_s
    assert without.sigma_s == pytest.approx(clean.sigma_s, rel=0.25)


def test_outliers_are_those_that_tuning_found() -> None:
    flight, outlier = made_flight(8, offset_s=-0.2, outliers=12)
    compared = compare(flight, SETTINGS)
    tuning = tuned_horizontally(compared)
    found = clock_offset(compared, tuning)
    tuned = tuning["horizontal"]
    at = flight.positions[0].samples.index.to_numpy()
    inside = at[outlier]
    hits = np.isin(tuned.outlier_time_s, inside)
    assert np.mean(hits) > 0.9
    assert np.sum(hits) > 0.9 * len(inside)
    assert found.offset_s == pytest.approx(-0.2, abs=0.03)


def test_an_offset_that_was_set_is_not_found_again() -> None:
    flight, _ = made_flight(9, offset_s=-0.2)
    compared = compare(flight, replace(SETTINGS, clock_offset_s=-0.2))
    found = clock_offset(compared, tuned_horizontally(compared))
    assert covers(found, 0.0)
    words = clock_advice(compared, found)
    assert words[0].startswith("Offset   -0.")


def test_a_source_without_heights_gives_the_offset_all_the_same() -> None:
    flight, _ = made_flight(10, offset_s=0.1)
    samples = flight.positions[0].samples.assign(down_m=np.nan)
    flat = replace(flight, positions=(replace(flight.positions[0], samples=samples),))
    found = estimate(flat)
    assert covers(found, 0.1)
    assert found.sigma_s < 0.03


@pytest.mark.parametrize("part", ["imu", "attitude"])
def test_without_imu_or_attitude_there_is_no_offset(part: str) -> None:
    flight, _ = made_flight(1)
    found = estimate(replace(flight, **{part: unavailable(part)}))
    assert isinstance(found, Unavailable)
    assert found.what == part


def test_too_few_measurements_are_said_to_be() -> None:
    flight, _ = made_flight(1, duration_s=6.0)
    found = estimate(flight)
    assert isinstance(found, Unavailable)
    assert f"at least {MIN_MEASUREMENTS}" in found.reason


def test_an_offset_beyond_the_search_is_not_called_determined() -> None:
    found = estimate(made_flight(11, offset_s=0.9)[0])
    assert not found.determinable


# --- flights of PX4's simulation with stamps that are wrong by design ---


@pytest.mark.reallogs
@pytest.mark.parametrize(
    ("name", "true_s"),
    [
        ("v1.16.1_aisle_nominal", 0.0),
        ("v1.14.4_aisle_nominal", 0.0),
        ("v1.16.1_aisle_clock_late", -0.25),
        ("v1.16.1_aisle_clock_nosync", -0.25),
        ("v1.16.1_aisle_10hz", 0.0),
        ("v1.16.1_aisle_hwlog", 0.0),
        ("v1.16.1_aisle_nlos", 0.0),
        ("v1.13.3_aisle_evdelay175", 0.0),
    ],
)
def test_the_offset_of_simulated_flights(shared_logs, name: str, true_s: float) -> None:
    compared = compare(read_log(shared_logs / "simulated" / f"{name}.ulg"))
    found = clock_offset(compared, tuned_horizontally(compared))
    assert found.determinable
    assert found.offset_s == pytest.approx(true_s, abs=0.05)
    assert covers(found, true_s)
    assert found.change_p > CHANGE_P
    assert abs(found.drift_ppm) < 4.0 * found.drift_sigma_ppm
    if name.endswith("evdelay175"):
        assert not found.interval_s[0] <= -0.175 <= found.interval_s[1]
        words = "\n".join(clock_advice(compared, found))
        assert "EKF2_EV_DELAY is 175 ms" in words
        assert "set it, or fix the clock" in words
