"""Biases, scale factor error, jumps and low pass, and the findings that report them.

Each detector runs on a flight without a fault, with the fault, without required data, and on a
short flight.
"""

import re
from functools import cache
from typing import Any

import numpy as np
import pytest
from comparisons import compare
from exchange import replace
from flights import aisle_flight, unavailable, unexplained

from px4fuse.analysis import Analysis
from px4fuse.comparison.estimates import _fit_source_errors, estimate
from px4fuse.core.arrays import integrate_cumulatively
from px4fuse.filter.hypotheses import (
    DesignMatrix,
    estimate_mean_acceleration_error,
    fit_systematic_errors,
    make_design_matrix,
)
from px4fuse.filter.kalman import run_kf
from px4fuse.filter.likelihood import innovations, preintegrate
from px4fuse.filter.settings import Settings
from px4fuse.finding import Finding
from px4fuse.findings import imu, noises, source_clock, source_convention
from px4fuse.findings import source_intervals as intervals
from px4fuse.findings import source_positions as sent
from px4fuse.findings import source_stamps as stamps
from px4fuse.flight.model import Columns, Flight, Unavailable
from px4fuse.simulation.faults import parse_faults
from px4fuse.simulation.flights import simulate_flight
from px4fuse.simulation.scenario import Scenario

RIGHT = Settings(sigma_a_m_s2=0.27, sigma_z_m=0.10)
OF_CAUSES = (
    imu.detect_accelerometer_bias,
    sent.detect,
    stamps.detect_arrival_timestamps,
    intervals.detect_downsampling,
)
DETECTORS = (
    *OF_CAUSES,
    source_clock.detect,
    source_convention.detect,
    noises.detect_wrong_settings,
)


def analysed(flight: Flight, settings: Settings = RIGHT, **span: float) -> Analysis:
    """Analyse a flight for the detectors: noises, time offset and frame misalignment."""
    comparison = compare(flight, settings, axes=("north", "east"), **span)
    return replace(unexplained(comparison), **vars(estimate(comparison)))


@cache
def flight(*mistakes: str, passes: int = 4) -> Flight:
    size = Scenario(ekf2=False, truth=False, seed=3, passes=passes)
    return simulate_flight(size, parse_faults(mistakes))


@cache
def flown(*mistakes: str, **passes: int) -> Analysis:
    return analysed(flight(*mistakes, **passes))


def found(analysis: Analysis, detectors: tuple[Any, ...] = DETECTORS) -> dict[str, Finding]:
    return {finding.id: finding for detector in detectors for finding in detector(analysis)}


# ------------------------------------------------------------------ the regression


def test_vectorised_kf_with_position_step_equals_kf_replay() -> None:
    """Compare innovations with and without a step with KF replays."""
    north = compare(aisle_flight(duration_s=30.0), RIGHT, axes=("north",))["north"].axis
    step = np.where(north.measurement_time_s >= 12.0, 0.7, 0.0)
    intervals = preintegrate(north, RIGHT)
    none = np.zeros(len(intervals.measurement_m), dtype=bool)
    measured = intervals.measurement_m
    both = replace(
        intervals,
        delta_position_m=np.outer(intervals.delta_position_m, [1.0, 1.0]),
        delta_velocity_m_s=np.outer(intervals.delta_velocity_m_s, [1.0, 1.0]),
        measurement_m=np.stack([measured, measured + step[1:]], 1),
    )
    nu, s = innovations(both, RIGHT.sigma_a_m_s2, RIGHT.sigma_z_m, none)
    for column, added in zip(nu.T, (0.0, step), strict=True):
        moved = replace(north, measurement_m=north.measurement_m + added)
        updates = run_kf(moved, RIGHT).updates
        np.testing.assert_allclose(column, updates["innovation_m"], atol=1e-9)
        np.testing.assert_allclose(s, updates["innovation_variance_m2"], rtol=1e-9)
    # skipped measurements
    skip = np.arange(len(none)) % 7 == 3
    nu, s = innovations(both, RIGHT.sigma_a_m_s2, RIGHT.sigma_z_m, skip)
    expected = innovations(intervals, RIGHT.sigma_a_m_s2, RIGHT.sigma_z_m, skip)
    np.testing.assert_allclose([nu[:, 0], s], expected, atol=1e-9)


def design_matrix() -> DesignMatrix:
    analysis = flown()
    axes = tuple(analysis.axes[name].axis for name in ("north", "east"))
    return make_design_matrix(analysis.flight, axes, RIGHT, 0.27, 0.10, 0.0)


def test_bias_regression_residuals_equal_kf_innovations() -> None:
    model = design_matrix()
    gap = np.zeros_like(model.preintegrated_inputs.process_noise_independent_of_sigma_a)
    gap[200] = 0.5, 0.5, 1.0
    with_gap = replace(
        model,
        preintegrated_inputs=replace(
            model.preintegrated_inputs, process_noise_independent_of_sigma_a=gap
        ),
    )
    skip = np.zeros(len(model.time_s), dtype=bool)
    for each in (model, with_gap):
        fits = each.fit(skip)
        data, columns = each.compute_innovations_and_design_matrix(fits.gains)
        arrays = "measurement_m", "delta_position_m", "delta_velocity_m_s"
        residual = (data - columns @ fits.coefficients).reshape(2, -1)
        np.testing.assert_allclose(fits.residual, residual, atol=1e-9)
        for at, column in enumerate((0, 4)):
            own = {name: getattr(each.preintegrated_inputs, name)[:, column] for name in arrays}
            nu, s = innovations(replace(each.preintegrated_inputs, **own), 0.27, 0.10)
            np.testing.assert_allclose(data.reshape(2, -1)[at], nu / np.sqrt(s), atol=1e-9)


def test_bias_regression_equals_lstsq_with_prior_as_data_row() -> None:
    model = design_matrix()
    skip = np.arange(len(model.time_s)) % 5 == 0
    made = model.fit(skip)
    data, columns = model.compute_innovations_and_design_matrix(made.gains)
    used = np.tile(~skip, 2)
    rows = np.vstack([columns[used], np.diag(1.0 / model.prior_sigma)])
    values = np.append(data[used], np.zeros(len(model.prior_sigma)))
    expected, *_ = np.linalg.lstsq(rows, values, rcond=None)
    np.testing.assert_allclose(made.coefficients, expected, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(made.residual.ravel(), data - columns @ expected, atol=1e-6)
    np.testing.assert_allclose(made.covariance, np.linalg.inv(rows.T @ rows), rtol=1e-5, atol=1e-9)
    square_sum = np.sum((values - rows @ expected) ** 2)
    assert made.residual_and_prior_square_sum == pytest.approx(square_sum)
    mean_squares = np.mean(made.residual[:, ~skip] ** 2, axis=1)
    np.testing.assert_allclose(made.residual_rms_by_axis, np.sqrt(np.maximum(mean_squares, 1.0)))
    # σ is widened if the residual exceeds the assumed noise
    sigma = np.sqrt(made.covariance[0, 0])
    for spread, widened in ((3.0, 3.0), (0.5, 1.0)):
        assert replace(made, residual_rms=spread).estimate(0).sigma == pytest.approx(
            widened * sigma
        )


# ------------------------------------------------------------------ the causes


def test_clean_flight_has_no_bias_scale_error_or_jump() -> None:
    causes, low_pass = flown().systematic_errors, flown().source_low_pass
    assert causes.jumps == ()
    assert low_pass.correlation == 0.0
    assert causes.sigma_a_m_s2 == pytest.approx(0.2, rel=0.35)  # the white noise alone
    assert found(flown()) == {}


@pytest.mark.parametrize(
    ("mistake", "name", "severity", "evidence"),
    [
        ("accel-bias=0.4", "accelerometer_bias", "error", {"bias_m_s2": (0.4, 0.1)}),
        ("scale=25%", "source_scale_error", "error", {"scale": (1.25, 0.1)}),
        # the lag is the time constant minus half an interval
        ("smoothed=0.5", "source_low_pass_filtered", "error", {"lag_s": (0.41, 0.1)}),
        (
            "jump=1,40s",
            "source_position_jump",
            "error",
            {"size_m": (1.0, 0.3), "count": (1.0, 0.0)},
        ),
        ("decimate=2Hz", "source_downsampled", "error", {"source_rate_hz": (5.0, 0.1)}),
        # EKF2_EV_NOISE_MD is 1 in simulated logs: EKF2 does not use the reported variance
        (
            "r-scale=0.25",
            "source_reported_variance_wrong",
            "note",
            {"variance_factor": (0.25, 0.05)},
        ),
        ("r-scale=4", "source_reported_variance_wrong", "note", {"variance_factor": (4.0, 0.8)}),
    ],
)
def test_simulated_fault_is_reported_first_with_its_size(mistake, name, severity, evidence) -> None:
    named = found(flown(mistake))
    assert next(iter(named)) == name
    assert ("source_low_pass_filtered" in named) == (name == "source_low_pass_filtered")
    assert named[name].severity == severity
    for key, (value, within) in evidence.items():
        assert named[name].evidence[key] == pytest.approx(value, abs=within)


@pytest.mark.parametrize(
    ("name", "mistake", "settings", "severity", "remedy"),
    [
        ("source_time_offset", "clock-offset=250ms", {}, "error", "Subtract 0."),
        ("source_time_offset_changes", "clock-jump=400ms", {}, "error", "--start"),
        ("source_frame_misaligned", "yaw=30", {}, "error", "Rotate the positions by -2|by -3"),
        ("source_outliers", "nlos=5%", {}, "error", "line of sight"),
        ("sigma_z_too_large", "", {"sigma_z_m": 0.3}, "warning", "no re-run confirmed"),
        ("sigma_a_too_large", "", {"sigma_a_m_s2": 2.0}, "error", "no re-run confirmed"),
    ],
)
def test_report_on_simulated_fault_contains_recommended_action(
    name, mistake, settings, severity, remedy
) -> None:
    named = found(analysed(flight(), replace(RIGHT, **settings)) if settings else flown(mistake))
    assert named[name].severity == severity
    # either noise makes S too large; the likelihood separates them
    if name.endswith("_large"):
        assert [other for other in named if other.startswith("sigma")] == [name]
    assert any(part in named[name].remedy for part in remedy.split("|"))


def test_scale_factor_estimate_is_not_biased_by_imu_noise() -> None:
    """Plain regression on a noisy acceleration would be 8 % too small."""
    scales = []
    for seed in range(5):
        flown = simulate_flight(Scenario(ekf2=False, truth=False, seed=seed))
        comparison = compare(flown, RIGHT, axes=("north", "east"))
        found = fit_systematic_errors(
            comparison.flight, tuple(result.axis for result in comparison.axes.values()), RIGHT,
            sigma_a_m_s2=0.2, sigma_z_m=0.1, outlier_time_s=np.array([]), clock_offset_s=0.0,
        )  # fmt: skip
        scales.append(found.scale.value)
    assert np.mean(scales) == pytest.approx(0.0, abs=0.04)


def test_outlier_burst_is_not_reported_as_position_jump() -> None:
    assert set(found(flown("nlos=5%"))) == {"source_outliers"}
    assert "source_outliers" not in found(flown("jump=1,40s"))
    causes = flown("jump=1,40s").systematic_errors
    (jump,) = causes.jumps
    assert jump.time_s == pytest.approx(40.0, abs=0.5)
    heading = np.degrees(np.arctan2(jump.step_m[1].value, jump.step_m[0].value))
    assert heading == pytest.approx(30.0, abs=15.0)


def test_position_jump_size_at_source_reset_ignores_time_offset() -> None:
    comparison = compare(flight("jump=0.5,40s"), RIGHT, axes=("north", "east"))
    sizes_m = []
    for delay_s in (0.0, 0.3):
        axes = [
            replace(result.axis, measurement_time_s=result.axis.measurement_time_s - delay_s)
            for result in comparison.axes.values()
        ]
        time_s = axes[0].measurement_time_s
        errors = fit_systematic_errors(
            comparison.flight, tuple(axes), RIGHT, sigma_a_m_s2=0.27, sigma_z_m=0.1,
            outlier_time_s=np.array([]), clock_offset_s=delay_s,
            source_reset_times_s=[time_s[np.searchsorted(time_s, 40.0 - delay_s)]],
        )  # fmt: skip
        (jump,) = errors.jumps
        assert jump.time_s + delay_s == pytest.approx(40.1, abs=0.01)
        sizes_m.append([size.value for size in jump.step_m])
    assert sizes_m[1] == pytest.approx(sizes_m[0], abs=1e-6)


def test_late_positions_are_not_reported_as_low_pass_filtered() -> None:
    late = flown("clock-offset=250ms", passes=6)
    assert late.source_low_pass.gain_nats == 0.0
    _, low_pass, _ = _fit_source_errors(late, late.tuning, unavailable("clock offset"), None, {})
    assert low_pass.gain_nats > 3.0


# ------------------------------------------------------------------ arrival times


@cache
def with_ekf2(*mistakes: str) -> Analysis:
    return unexplained(
        compare(simulate_flight(Scenario(seed=3), parse_faults(mistakes)), axes=("north",))
    )


@pytest.mark.parametrize(("jump", "severity"), [("50ms", "warning"), ("300ms", "error")])
def test_clock_jump_of_50_ms_is_warning_and_of_300_ms_is_error(jump, severity):
    (finding,) = stamps.detect_arrival_timestamps(with_ekf2(f"clock-jump={jump}"))
    assert finding.severity == severity
    assert finding.evidence["until_s"] == pytest.approx(50.0, abs=0.5)
    assert finding.evidence["latency_s"] == pytest.approx(float(jump[:-2]) / 1e3, abs=0.005)
    assert "--start 51" in finding.remedy


@pytest.mark.parametrize("scale", [0.96, 1.04])
def test_accelerometer_scale_error_is_reported_as_vertical_bias(scale) -> None:
    scaled = flight()
    imu_samples = scaled.imu.copy()
    imu_samples[Columns.SPECIFIC_FORCE] *= scale
    scaled = replace(scaled, imu=imu_samples)
    axes = ("north", "east", "down")
    comparison = compare(scaled, RIGHT, axes=axes)
    analysis = replace(unexplained(comparison), **vars(estimate(comparison)))
    (finding,) = imu.detect_accelerometer_bias(analysis)
    assert finding.evidence["bias_m_s2"] == pytest.approx(9.81 * 0.04, abs=0.12)
    scale_text = re.search(r"scale factor of (\S+) has", finding.message)[1]
    assert float(scale_text) == pytest.approx(scale, abs=0.012)  # the IMU has a bias, too
    # without the height, the bias is unknown
    assert found(analysed(scaled), (imu.detect_accelerometer_bias,)) == {}


@pytest.mark.parametrize("error_m_s2", [-0.5, 0.3])
def test_mean_acceleration_error_of_noise_free_axis_is_exact(error_m_s2) -> None:
    down = compare(aisle_flight(duration_s=30.0), RIGHT, axes=("down",))["down"].axis
    acceleration = down.acceleration
    time_s = acceleration.time_s
    biased = acceleration.acceleration_integral_m_s + error_m_s2 * (time_s - time_s[0])
    at_rest = replace(
        down,
        measurement_m=np.interp(
            down.measurement_time_s,
            time_s,
            integrate_cumulatively(
                acceleration.compute_velocity_change_m_s(down.direction), time_s
            ),
        ),
        acceleration=replace(acceleration, acceleration_integral_m_s=biased),
    )
    assert estimate_mean_acceleration_error(at_rest) == pytest.approx(error_m_s2, abs=1e-3)
    gap = replace(at_rest.acceleration, cumulative_gap_s=np.array([0.0, 1.0]))
    assert estimate_mean_acceleration_error(replace(at_rest, acceleration=gap)) is None
    few = at_rest.measurement_time_s[:20]
    assert estimate_mean_acceleration_error(replace(at_rest, measurement_time_s=few)) is None


# ------------------------------------------------------------------ missing data


def without_variances(flight: Flight) -> Flight:
    (track,) = flight.positions
    samples = track.samples.assign(**dict.fromkeys(Columns.POSITION_VARIANCE, np.nan))
    return replace(flight, positions=(replace(track, samples=samples),))


@pytest.mark.parametrize(
    ("mistake", "change"),
    [
        ("accel-bias=0.4", lambda flight: replace(flight, attitude=unavailable("attitude"))),
        ("scale=25%", lambda flight: replace(flight, imu=unavailable("IMU"))),
        ("jump=1", lambda flight: replace(flight, imu=unavailable("IMU"))),
        ("smoothed=0.5", lambda flight: replace(flight, imu=unavailable("IMU"))),
        ("r-scale=0.25", without_variances),
    ],
)
def test_fault_is_not_reported_if_log_lacks_imu_or_variances(mistake, change) -> None:
    named = set(found(analysed(change(flight(mistake))), OF_CAUSES))
    assert named <= {"source_outliers"}


def test_bias_estimate_without_noise_estimate_is_unavailable() -> None:
    tuned = flown("jump=1,40s")
    fit, low_pass, correlated_noise = _fit_source_errors(tuned, {}, tuned.time_offset, None, {})
    assert isinstance(fit, Unavailable)
    assert isinstance(low_pass, Unavailable)
    untuned = replace(
        tuned, tuning={}, systematic_errors=fit, source_low_pass=low_pass,
        time_correlated_noise=correlated_noise,
    )  # fmt: skip
    assert found(untuned) == {}


@pytest.mark.parametrize("mistake", ["accel-bias=0.4", "jump=1,21s", "decimate=2Hz"])
def test_bias_or_jump_on_very_short_flight_is_not_reported(mistake) -> None:
    short = analysed(flight(mistake), start_s=20.0, end_s=25.0)
    assert found(short) == {}
    assert isinstance(short.systematic_errors, Unavailable)
    assert isinstance(short.source_low_pass, Unavailable)
