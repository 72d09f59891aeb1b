"""Numbers of a comparison against direct computation and simulated values."""

import numpy as np
import pandas as pd
import pytest
from comparisons import compare, prepare
from exchange import replace
from flights import Estimator, Imu, Uwb, aisle_flight
from msgspec.structs import asdict
from pyulog import ULog

from px4fuse.comparison.model import AxisComparison, Comparison, FilterDifference, UntestedFilter
from px4fuse.comparison.projection import project_fusion_horizon_position
from px4fuse.core.arrays import Array
from px4fuse.errors import SettingsError
from px4fuse.filter.settings import Settings
from px4fuse.flight.model import Flight, Reset, Truth, Unavailable


@pytest.fixture(scope="module")
def made() -> Comparison:
    return compare(aisle_flight())


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def predicted(result: AxisComparison, times: Array) -> Array:
    """Predict KF's position, velocity and variances at other times from the step before.

    x = Fx + Ba, P = FPFᵀ + Q.
    """
    run, chosen = result.kf_run, result.kf_run.settings
    edges, q = run.steps.index.to_numpy(), chosen.sigma_a_m_s2**2 * chosen.dt_s
    last = np.searchsorted(edges, times, side="right") - 1
    steps = run.steps.drop(columns="imu_gap_variance_m2_s4").to_numpy()
    (p, v, pp, pv, vv, a), d = steps[last].T, times - edges[last]
    position, speed = p + v * d + a * d * d / 2, v + a * d
    return np.array([position, speed, pp + 2 * d * pv + d * d * vv + q * d**3 / 4, vv + q * d])


def ekf2_times_within(result: AxisComparison) -> Array:
    """Return EKF2's sample times within the KF replay."""
    first, last = result.kf_run.steps.index[[0, -1]]
    times = result.ekf2_tracks.state.index.to_numpy()
    return times[(times >= first) & (times <= last)]


def true_errors(flight: Flight, frame: pd.DataFrame, column: str) -> Array:
    """Return a series minus ground truth interpolated to its times, without NaN."""
    truth = flight.truth.samples[column]
    error = frame[column] - np.interp(frame.index, truth.index, truth, left=np.nan, right=np.nan)
    return error.dropna()


class TestSample:
    def test_ekf2_mean_nis_is_mean_test_ratio_times_gate_squared(
        self, sample, sample_flight
    ) -> None:
        """PX4 logs the test ratio ν² / (gate² S) with the opposite sign of ν."""
        segment = sample.segment
        for name in ("north", "east"):
            kf, ekf2 = (sample[name].filters[who] for who in ("kf", "ekf2"))
            logged = sample_flight.ekf2.innovations[name].loc[segment.start_s : segment.end_s]
            assert ekf2.count == len(logged)
            assert ekf2.nis_mean == pytest.approx(logged["test_ratio"].mean() * 5.0**2, rel=1e-4)
            assert ekf2.innovation_std_m == pytest.approx(logged["innovation_m"].std())
            ours = sample[name].kf_run.updates
            nis = ours["innovation_m"] ** 2 / ours["innovation_variance_m2"]
            assert kf.nis_mean == pytest.approx(nis.mean(), rel=1e-12)

    def test_ekf2_errors_equal_those_computed_from_logged_topics(
        self, sample, sample_flight
    ) -> None:
        start, end = sample.segment.start_s, sample.segment.end_s
        state = sample_flight.ekf2.state.loc[start:end]
        for name in ("north", "east"):
            truth = sample[name].filters["ekf2"].truth
            position, velocity = (
                true_errors(sample_flight, state, f"{name}_{unit}") for unit in ("m", "m_s")
            )
            assert truth.count == len(position)
            stated = truth.position_rmse_m, truth.velocity_rmse_m_s
            assert stated == pytest.approx((rms(position), rms(velocity)))
            variance = sample_flight.ekf2.variance.loc[start:end]
            for error, nees, unit in (
                (position, truth.nees_position_mean, "m2"),
                (velocity, truth.nees_velocity_mean, "m2_s2"),
            ):
                column = variance[f"{name}_{unit}"]
                reported = np.interp(error.index, column.index, column, np.nan, np.nan)
                assert nees == pytest.approx(np.nanmean(error**2 / reported))

    def test_ekf2_fusion_horizon_position_is_before_vision_update(
        self, sample, sample_flight, sample_log
    ):
        """Published positions include the output predictor's lag, which no variance contains."""
        (met,) = ULog(str(sample_log), ["estimator_aid_src_ev_pos"]).data_list
        at = met.data["timestamp_sample"] * 1e-6 - sample_flight.log.boot_time_s
        inside = (at >= sample.segment.start_s) & (at <= sample.segment.end_s)
        for number, name in enumerate(("north", "east")):
            observed, state_minus, s, r = (
                met.data[f"{field}[{number}]"][inside].astype(float)
                for field in ("observation", "innovation", "innovation_variance",
                              "observation_variance")
            )  # fmt: skip
            axis = sample[name].axis
            horizon = project_fusion_horizon_position(sample_flight.ekf2, axis, sample.segment)
            np.testing.assert_allclose(horizon["position_m"], observed + state_minus, atol=1e-9)
            np.testing.assert_allclose(horizon["position_variance_m2"], s - r, rtol=1e-9)

    def test_kf_errors_are_computed_at_ekf2_timestamps(self, sample, sample_flight):
        for name in ("north", "east"):
            result = sample[name]
            times = ekf2_times_within(result)
            p, v, pp, vv = predicted(result, times)
            truth = sample_flight.truth.samples
            ep = p - np.interp(times, truth.index, truth[f"{name}_m"])
            ev = v - np.interp(times, truth.index, truth[f"{name}_m_s"])
            found = result.filters["kf"].truth
            assert found.position_rmse_m == pytest.approx(rms(ep))
            assert found.velocity_rmse_m_s == pytest.approx(rms(ev))
            assert found.nees_position_mean == pytest.approx(np.mean(ep**2 / pp), rel=1e-9)
            assert found.nees_velocity_mean == pytest.approx(np.mean(ev**2 / vv), rel=1e-9)


def test_compare_with_source_kind_vio_assumes_position_drift(sample_flight: Flight) -> None:
    plain = compare(sample_flight)
    for kind, drifts, slow in (
        ("uwb", False, False), ("vio", True, False), ("mocap", False, False), ("gnss", False, True),
    ):  # fmt: skip
        said = compare(sample_flight, source_kind=kind)
        origin = said.source.origin
        assert (origin.kind, origin.may_drift, origin.is_gnss) == (kind, drifts, slow)
        # EKF2 still fused it as external vision, with the same numbers
        assert origin.is_vision
        assert not origin.is_fused_as_gnss
        assert said.horizontal == plain.horizontal


class TestSimulatedFlight:
    @pytest.mark.parametrize("nis", [0.01, 1.0, 20.0])
    def test_ekf2_error_to_sigma_ratio_is_root_of_simulated_mean_nis(self, nis: float) -> None:
        comparison = compare(aisle_flight(ekf2=Estimator(nis=nis)))
        assert comparison.horizontal.get("ekf2").sigma_ratio == pytest.approx(nis**0.5, rel=0.05)

    def test_ekf2_rmse_nees_and_sigma_equal_simulated_values(self, made: Comparison) -> None:
        """P⁻ = S - R and P⁺ = P⁻R/S, with P⁻ = (0.06 m)² and R = (0.10 m)²."""
        for result in made.axes.values():
            ekf2 = result.filters["ekf2"]
            errors = ekf2.truth.position_rmse_m, ekf2.truth.velocity_rmse_m_s
            assert errors == pytest.approx((0.05, 0.04), rel=0.06)
            nees = ekf2.truth.nees_position_mean, ekf2.truth.nees_velocity_mean
            assert nees == pytest.approx((1.0, 1.0), abs=0.35)
            medians = ekf2.sigma_p_median_m, ekf2.sigma_v_median_m_s
            assert medians == pytest.approx((0.05, 0.04))
            around = ekf2.sigma_p_before_update_m, ekf2.sigma_p_after_update_m
            assert around == pytest.approx((0.06, 0.06 * 0.10 / np.hypot(0.06, 0.10)))

    def test_position_difference_is_kf_minus_ekf2_at_ekf2_times(self, made: Comparison) -> None:
        for result in made.axes.values():
            times = ekf2_times_within(result)
            p, v, *_ = predicted(result, times)
            ekf2 = result.ekf2_tracks.state.loc[times]
            dp, dv = p - ekf2["position_m"], v - ekf2["velocity_m_s"]
            assert result.difference.count == len(times)
            statistics = (rms, np.mean, lambda values: np.max(np.abs(values)))
            expected = [each(values) for values in (dp, dv) for each in statistics]
            assert list(asdict(result.difference).values())[1:] == pytest.approx(expected)

    def test_kf_nees_does_not_depend_on_prediction_step_dt(self) -> None:
        """Variance and error have the same time, also between two steps."""
        flight = aisle_flight(uwb=Uwb(rate_hz=1.0))
        fine, coarse = (
            compare(flight, Settings(dt_s=dt, sigma_a_m_s2=0.5 * (0.1 / dt) ** 0.5), axes=("east",))
            for dt in (0.1, 1.0)
        )
        one, other = (c.main.filters["kf"].truth.nees_position_mean for c in (fine, coarse))
        assert other == pytest.approx(one, rel=0.1)

    @pytest.mark.parametrize(("heading", "name"), [(0.0, "north"), (90.0, "east")])
    def test_analysis_along_heading_0_or_90_deg_equals_north_or_east(
        self, made, heading, name
    ) -> None:
        aisle = compare(made.flight, axes=("aisle",), heading_deg=heading).main
        same = made[name]
        assert asdict(aisle.difference) == pytest.approx(asdict(same.difference))
        for who in ("kf", "ekf2"):
            one, other = aisle.filters[who], same.filters[who]
            assert asdict(one.truth) == pytest.approx(asdict(other.truth))
            assert one.nis_mean == pytest.approx(other.nis_mean)
            assert one.sigma_p_after_update_m == pytest.approx(other.sigma_p_after_update_m)

    def test_compare_applies_noise_settings_and_time_range(self, made: Comparison) -> None:
        chosen = Settings(sigma_z_m=0.3, clock_offset_s=0.05)
        run = compare(made.flight, chosen, start_s=20.0, end_s=50.0).main.kf_run
        assert run.settings == chosen
        assert run.steps.index[0] == pytest.approx(20.05)
        assert run.steps.index[-1] <= 50.0
        s = run.updates["innovation_variance_m2"] - run.updates["prior_position_variance_m2"]
        np.testing.assert_allclose(s, 0.3**2)


class TestMissingParts:
    def test_compare_without_ekf2_evaluates_kf_and_gives_reason(self) -> None:
        comparison = compare(aisle_flight(ekf2=None))
        assert comparison.horizontal.get("kf").verdict == "consistent"
        assert comparison.horizontal.get("ekf2") is None
        for result in comparison.axes.values():
            assert result.filters["kf"].count == 600
            assert result.filters["kf"].truth.position_rmse_m < 0.09
            ekf2 = result.filters["ekf2"]
            assert isinstance(ekf2, UntestedFilter)
            assert ekf2.reason == comparison.flight.ekf2.reason
            for part in (
                result.ekf2_tracks.state, result.ekf2_tracks.variance,
                result.ekf2_tracks.innovations, result.difference, ekf2.truth,
            ):  # fmt: skip
                assert part == comparison.flight.ekf2

    @pytest.mark.parametrize("left_out", ["imu", "attitude_hz"])
    def test_compare_without_imu_uses_constant_velocity_model(self, left_out) -> None:
        flight = aisle_flight(**{left_out: None})
        comparison = compare(flight, Settings(sigma_z_m=0.2))
        assert comparison.settings == Settings(sigma_z_m=0.2, input="zero")
        assert any("KF assumes constant velocity" in note for note in comparison.notes)
        assert isinstance(comparison.input_axes[0].acceleration, Unavailable)
        assert comparison.input_axes[0].acceleration in comparison.missing
        assert comparison.main.filters["kf"].count == 600
        with pytest.raises(SettingsError, match="`input` imu"):
            prepare(flight, input="imu")

    def test_compare_without_ekf2_variances_has_rmse_but_no_nees(self) -> None:
        for result in compare(aisle_flight(ekf2=Estimator(variance_logged=False))).axes.values():
            assert isinstance(result.ekf2_tracks.variance, Unavailable)
            assert result.filters["ekf2"].sigma_p_median_m is None
            assert result.filters["ekf2"].truth.nees_position_mean is None
            assert result.filters["ekf2"].truth.position_rmse_m == pytest.approx(0.05, rel=0.06)

    def test_compare_without_ekf2_innovations_has_no_ekf2_verdict(self) -> None:
        comparison = compare(aisle_flight(ekf2=Estimator(innovations_logged=False)))
        assert comparison.horizontal.get("ekf2") is None
        for result in comparison.axes.values():
            assert isinstance(result.filters["ekf2"], Unavailable)
            assert result.filters["ekf2"].sigma_p_before_update_m is None
            assert isinstance(result.difference, FilterDifference)

    def test_ekf2_nees_uses_variance_interpolated_to_ground_truth(self, made: Comparison) -> None:
        """EKF2's variances are logged at 1 Hz: none is within these 0.8 s of ground truth."""
        samples = made.flight.truth.samples.loc[40.1:40.9]
        flight = replace(made.flight, truth=Truth("0.8 s", samples))
        result = compare(flight, axes=("north",)).main
        truth = result.filters["ekf2"].truth
        assert truth.count == 9
        variance = result.ekf2_tracks.variance["position_variance_m2"]
        assert truth.nees_position_mean == pytest.approx(
            truth.position_rmse_m**2 / np.interp(40.5, variance.index, variance), rel=0.1
        )

    def test_horizontal_nis_uses_only_updates_with_north_and_east(self) -> None:
        flight = aisle_flight(ekf2=Estimator(nis=0.5))
        innovations = flight.ekf2.innovations
        north, east = innovations["north"], innovations["east"].iloc[100:]
        ekf2 = replace(flight.ekf2, innovations={**innovations, "east": east})
        joint = compare(replace(flight, ekf2=ekf2)).horizontal.get("ekf2")
        both = (north.iloc[-500:], east.iloc[-500:])
        nis = [frame["innovation_m"] ** 2 / frame["innovation_variance_m2"] for frame in both]
        assert joint.count == 500
        assert joint.nis_mean == pytest.approx(np.mean(nis))


class TestRobustness:
    def test_compare_removes_ekf2_position_reset_and_adds_note(self, made: Comparison) -> None:
        reset = Reset(60.0, "position", (5.0, -3.0, 0.0))
        comparison = compare(aisle_flight(ekf2=Estimator(resets=(reset,))))
        assert any(
            "EKF2 resets (1 of horizontal position) are removed" in note
            for note in comparison.notes
        )
        for result, same in zip(comparison.axes.values(), made.axes.values(), strict=True):
            assert asdict(result.difference) == pytest.approx(asdict(same.difference))

    def test_compare_does_not_modify_the_flight_data(self) -> None:
        flight = aisle_flight(ekf2=Estimator(resets=(Reset(60.0, "position", (5.0, 0.0, 0.0)),)))

        def frames() -> list[pd.DataFrame]:
            ekf2 = flight.ekf2
            return [
                flight.imu, flight.attitude, flight.positions[0].samples, flight.truth.samples,
                ekf2.state, ekf2.variance, ekf2.fusion_flags, *ekf2.innovations.values(),
            ]  # fmt: skip

        before = [frame.copy() for frame in frames()]
        compare(flight, Settings(clock_offset_s=0.3))
        for frame, copy in zip(frames(), before, strict=True):
            pd.testing.assert_frame_equal(frame, copy)


def test_compare_reports_duration_of_imu_gap() -> None:
    result = compare(aisle_flight(imu=Imu(gap_s=(40.0, 42.0))), axes=("north",)).main
    assert result.updates.input_gap_s == pytest.approx(2.0, abs=1e-6)
