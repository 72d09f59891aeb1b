"""Time offset against simulated flights whose timestamps are wrong by a known amount."""

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from comparisons import compare
from exchange import replace
from filter_tools import (
    GRAVITY,
    IMU_HZ,
    SETTINGS,
    SIGMA_A,
    SIGMA_Z,
    UWB_HZ,
    acceleration,
    attitude,
    attitude_table,
    imu_table,
    made_flight,
)
from flights import unavailable
from scipy.integrate import cumulative_trapezoid
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from scipy.special import stdtr
from scipy.stats import binom, chi2, ttest_ind

from px4fuse.comparison import estimates
from px4fuse.comparison.estimates import (
    MIN_OFFSETS_BEFORE_AND_AFTER_CHANGE,
    estimate_noises_and_time_offset,
    widen_for_scatter,
)
from px4fuse.comparison.imu_oscillation import find_imu_oscillation
from px4fuse.comparison.reruns import rerun_kf_with_time_offset
from px4fuse.core.arrays import Array
from px4fuse.diagnose import diagnose, prepare_comparison
from px4fuse.filter import time_offset
from px4fuse.filter.fitting import NoiseParameters
from px4fuse.filter.imu_motion import (
    INITIAL_STATE_PRIOR_PRECISIONS,
    INTEGRATION_STEP_S,
    PRIOR_SIGMAS_OF_CONSTANT_ERRORS,
    SegmentMotion,
    compute_imu_motion,
    make_segment_motion,
)
from px4fuse.filter.likelihood import compute_profile_likelihood_interval
from px4fuse.filter.signals import Segment
from px4fuse.filter.time_offset import (
    MAX_P_VALUE_OF_CHANGED_OFFSET,
    FlightPartTimeOffset,
    SourceTimeOffset,
)
from px4fuse.flight.model import (
    ALIGNED_BY_EKF2_ORIGIN,
    GNSS_ORIGIN,
    KEPT_BY_EKF2_ORIGIN,
    MOTION_CAPTURE_ORIGIN,
    POSITION_FILE_ORIGIN,
    Columns,
    Flight,
    Truth,
    Unavailable,
)
from px4fuse.readers.px4_positions import make_track
from px4fuse.report.clock import (
    TIME_OFFSET_FINDINGS,
    make_time_offset_advice,
    summarise_offset,
)
from px4fuse.request import ComparisonRequest
from px4fuse.simulation.faults import parse_faults
from px4fuse.simulation.flights import simulate_flight
from px4fuse.simulation.scenario import Scenario

DT = SETTINGS.dt_s


def estimate(flight: Flight, **options: object) -> SourceTimeOffset | Unavailable:
    segment = Segment(-np.inf, np.inf, "all of it")
    noises = NoiseParameters(SIGMA_A, SIGMA_Z)
    track = flight.positions[0]
    return time_offset.estimate_time_offset(flight, track, segment, SETTINGS, noises, **options)


def covers(found: SourceTimeOffset, true_s: float) -> bool:
    return found.interval_s[0] <= true_s <= found.interval_s[1]


# --- signals of the IMU ---


def heading(angle: Array) -> Rotation:
    return Rotation.from_rotvec(np.outer(angle, [0.0, 0.0, 1.0]))


def level_signals(
    force: tuple[float, float, float] = (0.0, 0.0, 0.0), *, turn: float = 0.0,
    interval: float = 0.01,
) -> SegmentMotion:  # fmt: skip
    """Return signals of a level vehicle at constant yaw rate and body acceleration."""
    time = np.arange(0.0, 20.0, interval)
    still = np.zeros((len(time), 3))
    logged = heading(turn * time)
    # only the start of the logged attitude is used; a wrong later attitude must not matter
    spoiled = Rotation.concatenate([logged[:300], heading(np.full(len(time) - 300, -0.3))])
    imu = imu_table(time, still + np.array(force) - GRAVITY, still + np.array([0.0, 0.0, turn]))
    return make_segment_motion(imu, attitude_table(time, spoiled), (0.5, 19.0))


def test_velocity_sensitivity_to_imu_errors_equals_closed_form() -> None:
    signals = level_signals()
    t, g = signals.time_s - signals.time_s[0], GRAVITY[2]
    motion = np.moveaxis(signals.motion_and_imu_error_derivatives, -1, 0)
    speed = motion[:, 1]
    value = np.diff(speed, axis=0) / INTEGRATION_STEP_S
    assert motion.shape == (len(t), 2, 3, len(PRIOR_SIGMAS_OF_CONSTANT_ERRORS))
    np.testing.assert_allclose(motion[..., 0], 0.0, atol=1e-10)
    # tilt θ about north and east moves it sideways by θ × f, f = [0, 0, -g]; heading does not
    tilted = np.tile([[0, -g, 0], [g, 0, 0], [0, 0, 0]], (len(value), 1, 1))
    np.testing.assert_allclose(value[:, :, 1:4], tilted, atol=1e-9)
    # a gyro bias b about north for t seconds tilts by -b t: (-t, 0, 0) × f, in each step's middle
    np.testing.assert_allclose(value[:, 1, 4], -g * (t[:-1] + t[1] / 2.0), atol=1e-9)
    np.testing.assert_allclose(value[:, [0, 2], 4], 0.0, atol=1e-9)
    np.testing.assert_allclose(speed[:, 1, 4], -g * t**2 / 2.0, atol=1e-9)
    # an accelerometer bias b adds -R b
    acceleration_bias = np.tile(-np.eye(3), (len(value), 1, 1))
    np.testing.assert_allclose(value[:, :, 7:10], acceleration_bias, atol=1e-9)


def test_imu_integration_at_constant_yaw_rate_gives_a_circle() -> None:
    """Yaw rate ω with a body acceleration s to the right: a = s (-sin ωt, cos ωt)."""
    omega, sideways = 0.5, 2.0
    signals = level_signals((0.0, sideways, 0.0), turn=omega, interval=0.004)
    t, middle = signals.time_s, omega * (signals.time_s + np.diff(signals.time_s)[0] / 2.0)
    circle = sideways * np.stack([-np.sin(middle), np.cos(middle), 0.0 * t], 1)
    velocity = signals.motion_and_imu_error_derivatives[1, :, 0].T
    acceleration = np.diff(velocity, axis=0) / INTEGRATION_STEP_S
    np.testing.assert_allclose(acceleration, circle[:-1], atol=2e-5)
    round_it = np.stack([np.cos(omega * t), np.sin(omega * t)], 1)
    speed = sideways / omega * (round_it - round_it[0])
    np.testing.assert_allclose(velocity[:, :2], speed, atol=1e-4)


def test_imu_motion_at_constant_acceleration_equals_closed_form() -> None:
    """Sideways acceleration s over dt gives s dt²/2 and s dt at every offset in each stretch."""
    time, stamps = np.arange(0.0, 80.0, 0.01), np.arange(0.0, 80.0, 0.25)
    still = np.zeros((len(time), 3))
    flight = replace(
        made_flight()[0],
        imu=imu_table(time, still + np.array([0.0, 1.5, 0.0]) - GRAVITY, still),
        attitude=attitude_table(time, heading(np.zeros(len(time)))),
    )
    measured = np.column_stack([stamps, np.full(len(stamps), np.nan)])
    measured[:5, 0] = np.nan
    moved = compute_imu_motion(flight, stamps, measured, axis_directions=np.eye(3)[:2], dt_s=DT)
    assert len(moved.segment_motions) == 3
    assert moved.time_s[[0, -1]] == pytest.approx([0.75, 79.25])
    positions = moved.make_positions_and_increments(np.array([-0.3, 0.0, 0.21]))
    way, speed = positions.delta_position_m, positions.delta_velocity_m_s
    assert way.shape == (2, 3, 1 + len(PRIOR_SIGMAS_OF_CONSTANT_ERRORS), len(moved.time_s) - 1)
    inside = np.flatnonzero(positions.is_within_segment)
    np.testing.assert_allclose(way[0, :, 0], 0.0, atol=1e-9)
    np.testing.assert_allclose(way[1, :, 0, inside], 1.5 * 0.25**2 / 2.0, atol=1e-9)
    np.testing.assert_allclose(speed[1, :, 0, inside], 1.5 * 0.25, atol=1e-9)
    np.testing.assert_array_equal(
        np.flatnonzero(~positions.is_within_segment) + 1, moved.segment_edges[1:-1]
    )
    # positions are relative to the first measured one of each stretch
    edges = [*positions.segment_start_indices.tolist(), len(positions.measurement_m)]
    for begin, end in pairwise(edges):
        known = positions.measurement_m[begin:end, 0]
        known = known[np.isfinite(known)]
        np.testing.assert_allclose(known, 0.25 * np.arange(len(known)), atol=1e-12)
    assert np.all(np.isnan(positions.measurement_m[:, 1]))
    # a third of the measurements, in every stretch
    some = moved.downsample(len(moved.time_s) // 3)
    np.testing.assert_array_equal(some.time_s, moved.time_s[::3])
    assert len(some.segment_edges) == 4


# --- the likelihood of an offset ---


class JointNormal:
    """Joint normal distribution of a stretch's positions: the estimator's model without a filter.

    The mean follows from the true acceleration. The covariance contains the unknown initial state,
    white acceleration noise, measurement noise, and constants with known variance: tilt, gyro and
    accelerometer biases, and scale.
    """

    def __init__(self, stamps: Array, measured: Array, offset: float) -> None:
        time = stamps + offset
        fine = np.arange(stamps[0] - 0.64, time[-1] + 0.002, 0.001)
        turn = attitude(fine).as_matrix()
        force = acceleration(fine) - GRAVITY
        unit = np.eye(3)
        angles = [np.broadcast_to(axis, force.shape) for axis in unit]
        angles += [-cumulative_trapezoid(turn @ axis, fine, axis=0, initial=0.0) for axis in unit]
        columns = [np.cross(angle, force) for angle in angles] + [-turn @ axis for axis in unit]
        ways = []
        for column in (acceleration(fine), *columns, acceleration(fine)):
            speed = cumulative_trapezoid(column, fine, axis=0, initial=0.0)
            way = cumulative_trapezoid(speed, fine, axis=0, initial=0.0)
            # from rest at the first measurement: the initial state is unknown
            first, before = (
                np.array([np.interp(time[0], fine, each) for each in part.T])
                for part in (speed, way)
            )
            at = np.stack([np.interp(time, fine, each) for each in way.T], axis=1)
            ways.append(at - before - np.outer(time - time[0], first))
        self.by_constants = np.array(ways[1:]).transpose(1, 2, 0).reshape(-1, 10)  # (time, axis)
        self.left = (measured - measured[0] - ways[0]).ravel()
        self.since = time - time[0]
        sigma = np.append(np.repeat([0.05, 0.004, 0.3], 3), 0.1)
        self.prior = np.diag(sigma**2)

    def solved(self, sigma_a: float, sigma_z: float) -> tuple[float, Array, Array]:
        """Return -ln p (without a constant), and the constants with their covariance."""
        since = self.since
        short, long = np.minimum.outer(since, since), np.maximum.outer(since, since)
        one_axis = (
            1.0 / INITIAL_STATE_PRIOR_PRECISIONS[0]
            + np.multiply.outer(since, since) / INITIAL_STATE_PRIOR_PRECISIONS[1]
            + sigma_a**2 * DT * short**2 * (3.0 * long - short) / 6.0
            + sigma_z**2 * np.eye(len(since))
        )
        factor = cho_factor(one_axis, lower=True)

        def weigh(signals: Array) -> Array:
            return cho_solve(factor, signals.reshape(len(since), -1)).reshape(signals.shape)

        # the constants by the matrix inversion and determinant lemmas
        by = self.by_constants
        information = np.linalg.inv(self.prior) + by.T @ weigh(by)
        covariance = np.linalg.inv(information)
        found = covariance @ by.T @ weigh(self.left)
        square = self.left @ weigh(self.left) - found @ information @ found
        log_determinant = 6.0 * np.log(np.diag(factor[0])).sum() + np.linalg.slogdet(information)[1]
        return 0.5 * float(square + log_determinant), found, covariance


@pytest.fixture(scope="module")
def exact_imu() -> tuple[Flight, SourceTimeOffset, list[tuple[Array, Array]]]:
    """Return 50 s with an ideal IMU and wind that it does not measure, and its segments."""
    flight, _ = made_flight(duration_s=50.0, offset_s=0.07)
    time = np.arange(0.0, 50.005, 1.0 / IMU_HZ)
    h = 0.0005
    rate = (attitude(time - h).inv() * attitude(time + h)).as_rotvec() / (2.0 * h)
    force = attitude(time).inv().apply(acceleration(time) - GRAVITY)
    track = flight.positions[0]
    samples = track.samples.copy()
    rng = np.random.default_rng(12)
    wind = rng.normal(0.0, SIGMA_A * np.sqrt(DT * UWB_HZ), (len(samples), 3))
    way = np.cumsum(np.cumsum(wind, axis=0), axis=0) / UWB_HZ**2
    samples[Columns.POSITION] += way
    logged = np.arange(0.0, 50.005, 0.02)
    flight = replace(
        flight,
        imu=imu_table(time, force, rate),
        attitude=attitude_table(logged, attitude(logged)),
        positions=(replace(track, samples=samples),),
    )
    found = estimate(flight)
    # positions that the search can shift, in equal segments of at most 30 s
    used = samples[(samples.index >= 0.6) & (samples.index <= 49.4)]
    first = used.index < (used.index[0] + used.index[-1]) / 2.0
    parts = used[first], used[~first]
    segments = [(part.index.to_numpy(), part[Columns.POSITION].to_numpy()) for part in parts]
    assert found.count == len(used)
    return flight, found, segments


def test_time_offset_likelihood_equals_joint_normal_density(exact_imu) -> None:
    """The noises of all offsets are those that maximise the likelihood."""
    _, found, segments = exact_imu
    noises = np.log([found.sigma_a_m_s2, found.sigma_z_m])
    within = [24, 60, 90]
    costs = []
    for offset in found.likelihood_curve_offsets_s[within]:
        normals = [JointNormal(*segment, offset) for segment in segments]

        def cost(logs: Array, normals: list[JointNormal] = normals) -> float:
            return sum(normal.solved(*np.exp(logs))[0] for normal in normals)

        costs.append(cost)
    expected = np.array([cost(noises) for cost in costs])
    expected -= expected.min()
    profile_drop = (
        found.curve_log_likelihood_drops[within] - found.curve_log_likelihood_drops[within].min()
    )
    assert 1.0 < expected.max() < 4.0
    np.testing.assert_allclose(profile_drop, expected, rtol=0.02, atol=0.03)
    options = {"xatol": 0.01, "fatol": 0.003}
    best = minimize(costs[int(np.argmin(expected))], noises, method="Nelder-Mead", options=options)
    assert np.exp(noises) == pytest.approx(np.exp(best.x), rel=0.03)


# --- profiles and parts ---


def test_time_offset_sigma_equals_width_of_likelihood_parabola() -> None:
    grid = np.linspace(-0.1, 0.3, 41)
    drop = (grid - 0.123) ** 2 / (2.0 * 0.03**2)
    assert time_offset._fit_minimum_and_sigma(grid, drop) == pytest.approx((0.123, 0.03))
    ends = 0.123 - 1.96 * 0.03, 0.123 + 1.96 * 0.03
    assert compute_profile_likelihood_interval(grid, drop) == pytest.approx(ends, abs=1e-3)
    # an end outside the grid is None
    assert compute_profile_likelihood_interval(grid[18:], drop[18:]) == (
        None,
        pytest.approx(ends[1], abs=1e-3),
    )
    assert compute_profile_likelihood_interval(grid[:25], drop[:25])[1] is None
    # without a minimum, σ is the width of the grid
    found, sigma = time_offset._fit_minimum_and_sigma(grid, -((grid - 0.1) ** 2))
    assert found in (grid[0], grid[-1])
    assert sigma == pytest.approx(0.4)


@pytest.mark.parametrize("offset_s", [0.0, -0.2, -0.21, 0.333])
def test_time_offset_of_each_flight_part_has_maximum_likelihood(offset_s) -> None:
    """Use parabolas as profiles of the parts."""
    shift, sigma = np.array([-0.05, 0.025, 0.0, 0.0]), np.array([0.03, 0.02, 0.03, 0.5])

    def fit_at_offsets(grid: Array, _: object) -> SimpleNamespace:
        square = (grid - offset_s - shift[:, None]) ** 2 / sigma[:, None] ** 2
        return SimpleNamespace(compute_segment_scores=lambda: 0.5 * square[None])

    moved = SimpleNamespace(
        segment_edges=np.arange(5) * 2, time_s=np.arange(8.0), fit_at_offsets=fit_at_offsets
    )
    parts, p = time_offset._estimate_flight_part_offsets(
        moved, offset_s, NoiseParameters(0.1, 0.1), 1.0, 0.0
    )
    # the last part has a σ above the limit
    assert [(part.start_s, part.end_s) for part in parts] == [(0.0, 1.0), (2.0, 3.0), (4.0, 5.0)]
    assert [part.offset_s for part in parts] == pytest.approx(offset_s + shift[:3])
    assert [part.sigma_s for part in parts] == pytest.approx(sigma[:3])
    weight = sigma[:3] ** -2.0
    left = shift[:3] - np.sum(weight * shift[:3]) / weight.sum()
    ratio = np.sum(weight * left**2)
    assert p == pytest.approx(chi2.sf(ratio, 2), abs=0.03)


# --- recovery ---


SEEDS = 12


def test_time_offset_95_percent_interval_contains_true_value() -> None:
    """12 seeds with random offsets; the estimates are also unbiased."""
    inside, normalised = [], []
    for seed in range(SEEDS):
        true_s = float(np.random.default_rng(1000 + seed).uniform(-0.3, 0.3))
        found = estimate(made_flight(seed, offset_s=true_s, duration_s=40.0)[0])
        inside.append(covers(found, true_s))
        normalised.append((found.offset_s - true_s) / found.sigma_s)
        # tilt and biases do not disturb the offset, and the noise is recovered
        assert found.is_determinable
        assert found.offset_s == pytest.approx(true_s, abs=0.03)
        assert found.sigma_z_m == pytest.approx(SIGMA_Z, rel=0.12)
    # 1 % in the tail of the binomial distribution
    assert sum(inside) >= binom.ppf(0.01, SEEDS, 0.95)
    assert abs(np.mean(normalised)) < 2.6 / np.sqrt(SEEDS)
    assert 0.6 < np.std(normalised) < 1.4


def test_time_offset_from_insufficient_data_gives_reason() -> None:
    hovering = estimate(made_flight(3, moving=0.0)[0])
    assert not hovering.is_determinable
    assert "little acceleration" in hovering.reason
    assert (hovering.parts, hovering.change_p_value) == ((), None)
    assert not estimate(
        made_flight(11, offset_s=0.9)[0]
    ).is_determinable  # outside the search range
    flight, _ = made_flight(1)
    for part in ("imu", "attitude"):
        assert estimate(replace(flight, **{part: unavailable(part)})).what == part
    short = estimate(made_flight(1, duration_s=6.0)[0])
    assert isinstance(short, Unavailable)
    assert "at least 30" in short.reason


def test_clock_jump_and_drift_within_a_flight_are_detected() -> None:
    found = estimate(made_flight(4, duration_s=120.0, jump_s=-0.25)[0])
    assert found.change_p_value < MAX_P_VALUE_OF_CHANGED_OFFSET
    for part in found.parts:
        true_s = -0.25 if part.start_s > 55.0 else 0.0
        if part.end_s < 60.0 or part.start_s > 55.0:
            assert part.offset_s == pytest.approx(true_s, abs=4.0 * part.sigma_s)
    assert min(part.sigma_s for part in found.parts) < 0.05
    found = estimate(made_flight(6, duration_s=240.0, drift_ppm=1000.0)[0])
    assert found.drift_ppm == pytest.approx(1000.0, abs=3.0 * found.drift_sigma_ppm)
    assert found.drift_sigma_ppm < 200.0
    assert found.change_p_value < MAX_P_VALUE_OF_CHANGED_OFFSET


@pytest.mark.parametrize("hole_s", [0.0, 1.0])
def test_constant_time_offset_is_not_reported_as_drift(hole_s: float) -> None:
    found = estimate(made_flight(5, duration_s=100.0, offset_s=-0.2, hole_s=hole_s)[0])
    assert len(found.parts) == 4
    assert found.change_p_value > 0.01
    assert covers(found, -0.2)
    assert abs(found.drift_ppm) < 3.0 * found.drift_sigma_ppm
    assert not hole_s or not any(part.start_s < 50.5 < part.end_s for part in found.parts)


def test_time_offset_estimate_excludes_position_outliers() -> None:
    flight, outlier = made_flight(8, offset_s=-0.2, outliers=12)
    inside = flight.positions[0].samples.index.to_numpy()[outlier]
    tuning, found = estimate_noises_and_time_offset(compare(flight, SETTINGS))
    hits = np.isin(tuning["horizontal"].outlier_time_s, inside)
    assert np.mean(hits) > 0.9
    assert np.sum(hits) > 0.9 * len(inside)
    assert found.offset_s == pytest.approx(-0.2, abs=0.03)
    compared = compare(flight, replace(SETTINGS, clock_offset_s=-0.2))
    _, found = estimate_noises_and_time_offset(compared)
    assert covers(found, -0.2)
    assert (found.applied_s, found.remaining_s) == (-0.2, pytest.approx(0.0, abs=0.03))
    assert make_time_offset_advice(compared, found)["Offset"].startswith("Add -0.")


def test_time_offset_refuted_by_ground_truth_is_not_recommended() -> None:
    """Ground truth is late too, so timestamps without the offset increase the RMSE."""
    flight = simulate_flight(Scenario(seed=3, passes=3), parse_faults(["clock-offset=0.3"]))
    assert isinstance(flight.truth, Truth)
    shifted = flight.truth.samples.set_axis(flight.truth.samples.index + 0.3)
    flight = replace(flight, truth=replace(flight.truth, samples=shifted))
    request = ComparisonRequest(log=flight.log.name)
    prepared = prepare_comparison(flight, request)
    _, found = estimate_noises_and_time_offset(prepared)
    assert covers(found, -0.3)
    advice = make_time_offset_advice(prepared, found, rerun_kf_with_time_offset(prepared, found))
    assert advice["Result"].startswith("Ground truth refutes the estimated time offset")
    assert not advice.keys() & {"Re-run", "PX4"}
    analysis = diagnose(request, flight=flight)
    assert summarise_offset(analysis, analysis.findings).startswith(advice["Result"])
    assert not {one.id for one in analysis.findings} & {*TIME_OFFSET_FINDINGS}


def oscillating(flight: Flight) -> Flight:
    """Add 1 m/s² at 0.4 Hz to the forward axis of the accelerometer."""
    imu = flight.imu.copy()
    imu[Columns.SPECIFIC_FORCE[0]] += np.sin(2.0 * np.pi * 0.4 * imu.index.to_numpy())
    return replace(flight, imu=imu)


def test_imu_oscillation_is_not_taken_for_time_offset_change(monkeypatch) -> None:
    scenario = Scenario(seed=4, ekf2=False)
    flight = oscillating(simulate_flight(scenario, parse_faults([])))
    prepared = prepare_comparison(flight, ComparisonRequest(log=flight.log.name))
    assert not estimate_noises_and_time_offset(prepared)[1].has_changed()
    found = find_imu_oscillation(prepared)
    assert found is not None
    assert found.frequency_hz == pytest.approx(0.4, rel=0.02)
    assert found.amplitude_m_s2 == pytest.approx(1.0, rel=0.2)
    monkeypatch.setattr(estimates, "find_imu_oscillation", lambda *_: None)
    assert estimate_noises_and_time_offset(prepared)[1].has_changed()


@pytest.mark.parametrize("mistake", ["clock-jump=0.3", "smoothed=1", "vibration=5", "yaw=40"])
def test_other_faults_are_not_detected_as_imu_oscillation(mistake: str) -> None:
    flight = simulate_flight(Scenario(seed=4, ekf2=False), parse_faults([mistake]))
    prepared = prepare_comparison(flight, ComparisonRequest(log=flight.log.name))
    assert find_imu_oscillation(prepared) is None


def test_time_offset_jump_p_value_equals_bonferroni_t_test() -> None:
    """Compare with scipy's two-sample t for equal weights and a scatter above the stated σ."""
    offset = np.array([0.0, 0.03, -0.02, 0.01, 0.2, 0.24, 0.19, 0.22, 0.2])
    weight = np.full(len(offset), 1e6)
    places = range(
        MIN_OFFSETS_BEFORE_AND_AFTER_CHANGE,
        len(offset) - MIN_OFFSETS_BEFORE_AND_AFTER_CHANGE + 1,
    )
    smallest_p = min(ttest_ind(offset[:at], offset[at:]).pvalue for at in places)
    assert estimates._compute_change_p_value(offset, weight) == pytest.approx(
        smallest_p * len(places), rel=1e-9
    )
    # for a scatter below the stated σ, the stated σ is used
    sure = np.full(len(offset), 100.0)
    t = min(
        -abs(offset[:at].mean() - offset[at:].mean())
        / np.sqrt(1.0 / sure[:at].sum() + 1.0 / sure[at:].sum())
        for at in places
    )
    assert estimates._compute_change_p_value(offset, sure) == pytest.approx(
        min(1.0, 2.0 * stdtr(len(offset) - 2, t) * len(places))
    )


# --- sources that may drift ---


def stated(
    *offsets: float, sigma_s: float = 0.02, change_p_value: float | None = 1e-7
) -> SourceTimeOffset:
    parts = tuple(
        FlightPartTimeOffset(30.0 * i, 30.0 * (i + 1), each, sigma_s)
        for i, each in enumerate(offsets)
    )
    middle = float(np.mean(offsets))
    curve = np.array([0.0])
    return SourceTimeOffset(
        offset_s=middle, interval_s=(middle - 0.02, middle + 0.02), sigma_s=0.01, applied_s=0.0,
        is_determinable=True, likelihood_curve_offsets_s=curve, curve_log_likelihood_drops=curve,
        parts=parts,
        drift_ppm=100.0, drift_sigma_ppm=50.0, change_p_value=change_p_value, sigma_a_m_s2=0.2,
        sigma_z_m=0.01, count=3000,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("origin", "drifts"),
    [
        (POSITION_FILE_ORIGIN, False),
        (MOTION_CAPTURE_ORIGIN, False),
        (GNSS_ORIGIN, False),
        (ALIGNED_BY_EKF2_ORIGIN, True),
        (KEPT_BY_EKF2_ORIGIN, True),
    ],
)
def test_vision_odometry_is_marked_as_source_that_may_drift(origin, drifts) -> None:
    samples = pd.DataFrame(np.arange(15.0).reshape(5, 3), np.arange(5.0), Columns.POSITION)
    fields = {"description": "", "frame": "NED", "clock": "", "topics": ()}
    assert make_track("a", samples, origin, is_odometry=True, **fields).origin.may_drift is drifts
    assert not make_track("a", samples, origin, **fields).origin.may_drift


def test_time_offset_interval_widens_if_flight_parts_differ() -> None:
    """Offsets of parts as measured on a VIO with correct timestamps."""
    scattered = stated(-0.013, 0.019, 0.076, 0.031, 0.082, 0.107, -0.077, 0.012, -0.007, -0.024)
    found = widen_for_scatter(scattered, "the positions drift")
    scatter = found.sigma_s / scattered.sigma_s
    assert scatter == pytest.approx(np.std([p.offset_s for p in found.parts], ddof=1) / 0.02)
    low, high = found.interval_s
    assert (high - low) / 0.04 == pytest.approx(scatter)
    assert found.change_p_value == 1.0
    assert found.is_determinable


def test_time_offset_interval_is_not_wider_if_flight_parts_agree() -> None:
    found = widen_for_scatter(stated(0.01, -0.01, 0.015, -0.02, 0.0), "the positions drift")
    assert (found.interval_s, found.sigma_s) == (pytest.approx((-0.021, 0.019)), 0.01)


def test_time_offset_with_too_wide_interval_is_undetermined() -> None:
    step = widen_for_scatter(
        stated(-0.41, -0.36, 0.03, -0.04, 0.02, 0.05, -0.03, 0.0), "the positions drift"
    )
    assert step.change_p_value < 1e-3
    wide = widen_for_scatter(
        replace(stated(-0.4, 0.4, -0.3, 0.3), interval_s=(-0.05, 0.05)), "the positions drift"
    )
    assert not wide.is_determinable
    assert "probably because the positions drift" in wide.reason
    assert (
        widen_for_scatter(stated(0.0, 0.3), "drift").change_p_value is None
    )  # two parts give no scatter
