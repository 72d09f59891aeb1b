"""Position noise that is correlated, repeated, unequal or varying: kind and size are found."""

import dataclasses
import re
from functools import cache, partial
from typing import Any

import numpy as np
import pytest
import source_errors as errors
from comparisons import compare
from exchange import replace
from scipy.interpolate import CubicSpline

from px4fuse.analysis import Analysis
from px4fuse.comparison.rerun_effects import makes_overconfident
from px4fuse.diagnose import diagnose_comparison
from px4fuse.filter import correlated_noise
from px4fuse.filter.correlated_noise import fit_time_correlation
from px4fuse.filter.fitting import NoiseParameters
from px4fuse.filter.settings import Settings
from px4fuse.finding import Finding
from px4fuse.findings import find
from px4fuse.findings.source_errors import detect, detect_noise_variation
from px4fuse.flight.model import Columns, Flight, Unavailable
from px4fuse.readers import read_log
from px4fuse.simulation.flights import simulate_flight
from px4fuse.simulation.scenario import Scenario

RIGHT = Settings(0.27, 0.10)
NONE = np.zeros(0)
NEW = {
    "source_noise_time_correlated",
    "source_samples_repeated",
    "source_noise_unequal_axes",
    "source_noise_varies",
}


@cache
def flown(seed: int, passes: int) -> tuple[Flight, CubicSpline]:
    """Simulate a flight; return it with a spline of its true path, to which errors are added."""
    flight = simulate_flight(Scenario(seed=seed, passes=passes, ekf2=False))
    truth = flight.truth.samples[Columns.POSITION].dropna()
    return flight, CubicSpline(truth.index.to_numpy(), truth.to_numpy())


@cache
def analysed(
    model: errors.Model, rate_hz: float = 10.0, seed: int = 1, truth_for: float | None = None,
    passes: int | None = None,
) -> Analysis:  # fmt: skip
    """Analyse a simulated flight without EKF2, with position errors of a model of the study.

    Ground truth is included if `truth_for`, a SIGMA_Z (m), is given.
    """
    flight, known = flown(seed, passes or PASSES.get(model, 3))
    flight, chosen = errors.laid_over(flight, known, model, rate_hz, seed), RIGHT
    if truth_for is None:
        flight = replace(flight, truth=Unavailable("truth", "", ""))
    else:
        chosen = Settings(0.27, truth_for)
    return diagnose_comparison(compare(flight, chosen, axes=("north", "east")))


def root_findings(analysis: Analysis) -> dict[str, Finding]:
    """Findings by id without infos, KF settings and consequences."""
    left_out = ("sigma_", "ekf2_not_logged")
    return {
        one.id: one for one in find(analysis)
        if one.severity != "note" and one.caused_by is None and not one.id.startswith(left_out)
    }  # fmt: skip


def diagonal_noise(rng: errors.Rng, time: errors.Values, true: errors.Values) -> errors.Made:
    """Noise of 0.2 m along 135° from north, and of 0.05 m along 45° and down."""
    along, across, down = rng.normal(size=(3, len(time))) * np.array([[0.2], [0.05], [0.05]])
    return np.column_stack([across - along, across + along, np.sqrt(2.0) * down]) / np.sqrt(
        2.0
    ), 0.0


UNEQUAL = partial(errors.white, sigma=np.array([0.05, 0.2, 0.1]))
LOUD = partial(errors.two_levels, factor=3.0)
SLOW = partial(errors.coloured, tau_s=0.5, share=1.0)
MIXED = partial(errors.coloured, tau_s=0.3, share=0.5)
HELD, OFTEN_HELD = partial(errors.held, share=0.15), partial(errors.held, share=0.6)
SMOOTH = partial(errors.low_pass, tau_s=0.5)
LOUDER, SCALED = partial(errors.two_levels, factor=6.0), partial(errors.scaled, scale=0.2)
PASSES = {UNEQUAL: 5, LOUDER: 5, SCALED: 5}


def test_white_position_noise_is_not_reported() -> None:
    analysis = analysed(errors.white)
    assert root_findings(analysis) == {}
    assert list(detect(analysis)) == []
    assert isinstance(analysis.time_correlated_noise, Unavailable)


@pytest.mark.parametrize(
    ("model", "name", "severity", "evidence"),
    [
        (SLOW, "source_noise_time_correlated", "error",  # the severity of its consequences
         {"tau_s": (0.5, 0.35), "slow_m": (0.1, 0.03), "white_m": (0.0, 0.04)}),
        (MIXED, "source_noise_time_correlated", "warning",
         {"slow_m": (0.07, 0.03), "white_m": (0.07, 0.02)}),
        (HELD, "source_samples_repeated", "warning", {"share": (0.15, 0.03)}),
        (OFTEN_HELD, "source_samples_repeated", "error", {"share": (0.6, 0.05)}),
        (UNEQUAL, "source_noise_unequal_axes", "error",
         {"north_sigma_z_m": (0.05, 0.01), "east_sigma_z_m": (0.2, 0.02)}),
        (LOUD, "source_noise_varies", "error", {"ratio": (2.7, 0.4)}),
        (LOUDER, "source_noise_varies", "error", {"ratio": (6.0, 1.3)}),
    ],
)  # fmt: skip
def test_simulated_position_noise_is_found_with_type_and_size(
    model, name, severity, evidence
) -> None:
    found = root_findings(analysed(model))
    assert set(found) == {name}
    assert found[name].severity == severity
    for key, (value, within) in evidence.items():
        assert found[name].evidence[key] == pytest.approx(value, abs=within)


@pytest.mark.parametrize("rate_hz", [5.0, 20.0])
def test_direction_of_largest_horizontal_noise_is_reported(rate_hz) -> None:
    found = root_findings(analysed(diagonal_noise, rate_hz, passes=5))["source_noise_unequal_axes"]
    heading_deg = float(re.search(r"along (\d+)° from north and", found.message)[1])
    assert heading_deg == pytest.approx(135.0, abs=6.0)
    assert found.evidence["larger_noise_sigma_z_m"] == pytest.approx(0.2, abs=0.03)
    assert found.evidence["smaller_noise_sigma_z_m"] == pytest.approx(0.05, abs=0.02)


def test_report_on_noise_variation_names_noisy_third_of_flight() -> None:
    analysis = analysed(LOUD)
    ((start, end),) = root_findings(analysis)["source_noise_varies"].spans_s
    time = analysis.axes["north"].axis.measurement_time_s
    third = (time[-1] - time[0]) / 3.0
    assert start == pytest.approx(time[0] + third, abs=third / 3.0)
    assert end == pytest.approx(time[0] + 2.0 * third, abs=third / 3.0)


def test_correlated_noise_is_not_reported_as_low_pass_filtering() -> None:
    slow, smooth = analysed(SLOW), analysed(SMOOTH)
    assert "source_low_pass_filtered" not in {one.id for one in find(slow)}
    assert "source_noise_time_correlated" not in {one.id for one in find(smooth)}
    assert "source_low_pass_filtered" in root_findings(smooth)
    for analysis, lags in ((slow, False), (smooth, True)):
        found = analysis.time_correlated_noise
        assert found.gain_nats > 30.0
        assert (found.low_pass_gain_nats > 1.0) == lags
        assert found.slow_m >= found.white_m


def test_outliers_and_jumps_are_not_reported_as_correlated_noise() -> None:
    for model, name in (
        (partial(errors.with_outliers, share=0.05), "source_outliers"),
        (partial(errors.jumped, size=1.0), "source_position_jump"),
        (partial(errors.clock, late=0.3), "source_time_offset"),
    ):
        found = root_findings(analysed(model))
        assert name in found
        assert not NEW & set(found)


@pytest.mark.parametrize(
    ("model", "sigma_z_m", "contradicts"),
    [(partial(errors.coloured, tau_s=20.0), 0.10, True), (errors.white, 0.14, False)],
)
def test_smaller_noise_is_advised_only_if_nees_stays_consistent(
    model, sigma_z_m, contradicts
) -> None:
    """The estimate is 0.7 SIGMA_Z in both cases; the first one has time-correlated errors too."""
    analysis = analysed(model, truth_for=sigma_z_m)
    tried = [
        each
        for each in analysis.reruns
        if "sigma_z_m" in each.change and "nis" in each.discrepancies
    ]
    assert {each.axis for each in tried} == {"north", "east"}
    assert all(makes_overconfident(each, "nis") == contradicts for each in tried)
    assert all(each.change["sigma_z_m"] == pytest.approx(0.7 * sigma_z_m, rel=0.05)
               for each in tried)  # fmt: skip
    if contradicts:
        assert set(root_findings(analysis)) == {"source_noise_time_correlated"}


@pytest.mark.parametrize(("tau_s", "seed"), [(5.0, 1), (20.0, 2)])
def test_slowly_varying_position_error_is_found_only_with_truth(tau_s: float, seed: int) -> None:
    """Correlation times of IMU errors, so the innovations do not show them."""
    analysis = analysed(partial(errors.coloured, tau_s=tau_s), 5.0, seed, truth_for=0.10)
    found = root_findings(analysis)
    assert set(found) == {"source_noise_time_correlated"}
    finding = found["source_noise_time_correlated"]
    evidence = finding.evidence
    assert evidence["low_s"] < tau_s < 1.1 * evidence.get("high_s", np.inf)
    assert evidence["white_m"] == pytest.approx(0.07, abs=0.015)
    assert 0.03 < evidence["slow_m"] < 0.15
    assert ("correlation time at least" in finding.title) == ("high_s" not in evidence)
    blind = root_findings(analysed(partial(errors.coloured, tau_s=tau_s), 5.0, seed))
    assert (
        "source_noise_time_correlated" not in blind
        or "correlation time at least" in blind["source_noise_time_correlated"].title
    )


@pytest.mark.parametrize(
    ("model", "name"),
    [
        (SCALED, "source_scale_error"),
        (partial(errors.jumped, size=1.0), "source_position_jump"),
        (partial(errors.clock, late=0.3), "source_time_offset"),
        (LOUD, "source_noise_varies"),
        (UNEQUAL, "source_noise_unequal_axes"),
        (partial(errors.low_pass, tau_s=0.3), "source_low_pass_filtered"),
    ],
)
def test_scale_error_is_not_reported_as_correlated_noise(model: errors.Model, name: str) -> None:
    analysis = analysed(model, truth_for=0.10)
    assert set(root_findings(analysis)) == {name}


def test_small_clock_jump_is_not_reported_as_correlated_noise() -> None:
    """Errors along the motion after the jump are correlated in time against ground truth."""
    changes = partial(errors.clock_jump, late=0.15)
    assert "source_noise_time_correlated" not in root_findings(
        analysed(changes, 20.0, truth_for=0.10)
    )


def test_report_on_low_pass_filtered_positions_states_their_lag() -> None:
    """Expected lag for steady motion: Δt ρ / (1 - ρ)."""
    found = root_findings(analysed(SMOOTH, 5.0))["source_low_pass_filtered"]
    assert found.evidence["lag_s"] == pytest.approx(0.2 / (np.exp(0.2 / 0.5) - 1.0), abs=0.06)


@pytest.mark.reallogs
@pytest.mark.parametrize(
    ("name", "model", "seed", "finding"),
    [
        # not a time-correlated error with a time offset, which fits as well
        ("nominal", partial(errors.low_pass, tau_s=0.3), 8, "source_low_pass_filtered"),
        # not a jump of 0.5 m, which one noise for both axes would suggest
        ("10hz", UNEQUAL, 1107, "source_noise_unequal_axes"),
    ],
)
def test_sitl_flight_with_added_error_reports_only_this_error(
    shared_logs, name, model, seed, finding
) -> None:
    log = shared_logs / "simulated" / f"v1.16.1_aisle_{name}.ulg"
    flight = read_log(log)
    flight = errors.laid_over(flight, errors.truth_of(log, flight), model, 5.0, seed)
    assert set(
        root_findings(diagnose_comparison(compare(flight, RIGHT, axes=("north", "east"))))
    ) == {finding}


def test_fused_outliers_are_not_reported_as_noise_variation() -> None:
    """At 2 Hz outliers pull KF away, so most innovations within 13 s are large."""
    analysis = analysed(partial(errors.with_outliers, share=0.05), 2.0, seed=13)
    assert {"source_outliers"} == set(root_findings(analysis))
    assert list(detect_noise_variation(analysis)) == []


def test_noise_correlation_time_without_imu_is_unavailable() -> None:
    analysis = analysed(MIXED)
    axis, given = analysis.axes["north"].axis, {"outlier_time_s": NONE, "clock_offset_s": 0.0}
    few = replace(axis, measurement_time_s=axis.measurement_time_s[:99],
                  measurement_m=axis.measurement_m[:99])  # fmt: skip
    found = fit_time_correlation(analysis.flight, (few,), RIGHT, NoiseParameters(0.3, 0.1), **given)
    assert isinstance(found, Unavailable)
    assert "99" in found.reason
    blind = replace(analysis.flight, imu=Unavailable("IMU", "no IMU", ""))
    assert (
        fit_time_correlation(blind, (axis,), RIGHT, NoiseParameters(0.3, 0.1), **given) == blind.imu
    )


def test_noise_correlation_fit_tries_zero_and_given_time_offset(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    analysis, tried = analysed(MIXED), []

    def none_better(moved: Any, offsets: list[float], noises: Any) -> tuple[float, Any]:
        tried.append(offsets)
        return 0.0, noises[0]

    monkeypatch.setattr(correlated_noise, "_search_coarse_grid", none_better)
    for offset_s in (0.0, 0.3, -0.2):
        fit_time_correlation(
            analysis.flight, (analysis.axes["north"].axis,), RIGHT, NoiseParameters(0.3, 0.1),
            outlier_time_s=NONE, clock_offset_s=offset_s,
        )  # fmt: skip
    assert tried[::2] == tried[1::2] == [[0.0], [0.0, 0.3], [-0.2, 0.0]]


def test_correlated_noise_and_outliers_are_both_reported() -> None:
    """Jumps and outliers are removed before the correlation is estimated."""
    assert {"source_position_jump", "source_noise_time_correlated"} <= set(
        root_findings(analysed(partial(both, jump_m=2.0)))
    )
    found = root_findings(analysed(partial(both, outliers=0.03)))
    assert {"source_outliers", "source_noise_time_correlated"} <= set(found)
    assert "source_position_jump" not in found


def both(rng: Any, time: Any, true: Any, jump_m: float = 0.0, outliers: float = 0.0) -> Any:
    return SLOW(rng, time, true)[0] + errors.jumped(rng, time, true, jump_m)[0] * bool(jump_m) + (
        errors.with_outliers(rng, time, true, outliers)[0] * bool(outliers)
    ), 0.0


@pytest.mark.parametrize("seed", [1, 2])
def test_position_jump_among_outliers_is_reported_once(seed: int) -> None:
    """Outliers in the seconds after the jump must not hide it."""
    kept: dict[str, float] = {}

    def model(rng: Any, time: Any, true: Any) -> Any:
        at = 2 * len(time) // 3
        kept["at_s"] = time[at]
        error, _ = errors.with_outliers(rng, time, true, 0.08)
        error[at:, 0] += 1.0
        return error, 0.0

    found = root_findings(analysed(model, seed=seed, passes=5))
    assert {"source_position_jump", "source_outliers"} == set(found)
    evidence = found["source_position_jump"].evidence
    assert evidence["count"] == 1
    assert evidence["size_m"] == pytest.approx(1.0, abs=4.0 * evidence["sigma_m"])
    assert evidence["at_s"] == pytest.approx(kept["at_s"], abs=0.2)


def test_positions_equal_to_truth_have_no_correlated_noise():
    axes = [compare(simulate_flight(Scenario(passes=2))).axes[name] for name in ("north", "east")]
    copies = [
        dataclasses.replace(
            line.axis,
            measurement_time_s=line.truth.index.to_numpy()[::10],
            measurement_m=line.truth["position_m"].to_numpy()[::10],
        )
        for line in axes
    ]
    none, white = Unavailable("", "", ""), correlated_noise.SourceLowPass(0.0, 0.0, 0.0, 0.1)
    truths = [line.truth for line in axes]
    assert (
        correlated_noise.fit_time_correlation_to_truth(
            copies, truths, np.zeros(0), 0.0, (), none, white
        )
        is none
    )
