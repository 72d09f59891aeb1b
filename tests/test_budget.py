"""The difference budget against EKF2s that are our own filter with known changes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from flights import PARAMETERS, Estimator, Uwb, aisle_flight, table, unexplained
from scipy.integrate import cumulative_trapezoid
from ulog_tools import GENERATIONS, make_log, stamps, topic

from px4fuse.analysis import Analysis
from px4fuse.arrays import Array
from px4fuse.comparison.budget import CAUSES, Budget, Effect, Run, budget, states_at
from px4fuse.comparison.comparison import compare
from px4fuse.filter.clock import ClockOffset
from px4fuse.filter.kalman import Replay, Settings, replay, state_at
from px4fuse.filter.signals import (
    choose_segment,
    choose_source,
    make_axes,
    ned_acceleration,
    shift_clock,
)
from px4fuse.flight import (
    AXIS_NAMES,
    POSITION_COLUMNS,
    SPECIFIC_FORCE_COLUMNS,
    VELOCITY_COLUMNS,
    Ekf2,
    Flight,
    Truth,
    Unavailable,
)
from px4fuse.readers import read_log
from px4fuse.report.budget import draw
from px4fuse.report.style import BOTTOM, report_style
from px4fuse.request import ComparisonRequest
from px4fuse.results import comparison as made
from px4fuse.results.build import results
from px4fuse.results.contract import to_json
from px4fuse.results.model import Student
from px4fuse.results.reading import read_results

DEFAULT = Settings()

STEP_S = 0.01
# EKF2's accelerometer noise at which its process noise is the default SIGMA_A's
SAME_NOISE = 0.5 * np.sqrt(0.1 / STEP_S)
SAME = {**PARAMETERS, "EKF2_EV_DELAY": 0.0, "EKF2_ACC_NOISE": SAME_NOISE}
BIAS = np.array([0.15, -0.10, 0.08])


def base_flight(**options: object) -> Flight:
    return aisle_flight(**{"parameters": SAME, "duration_s": 60.0, **options})


def replays(flight: Flight, settings: Settings) -> list[Replay]:
    """Our filter on north, east and down, by filterpy."""
    track = shift_clock(choose_source(flight)[0], settings.clock_offset_s)
    axes = make_axes(flight, track, choose_segment(flight, track), names=AXIS_NAMES)
    return [replay(axis, settings) for axis in axes]


def ekf2_is(
    flight: Flight,
    other: Flight,
    settings: Settings = DEFAULT,
    state_of: Callable[[Replay, Array], tuple[Array, Array]] = state_at,
) -> Flight:
    """The flight with EKF2's state replaced by our filter's on another one or with settings."""
    assert isinstance(flight.ekf2, Ekf2)
    time = flight.ekf2.state.index.to_numpy()
    runs = [state_of(run, time) for run in replays(other, settings)]
    states = np.column_stack([run[0] for run in runs] + [run[1] for run in runs])
    known = np.isfinite(states).all(axis=1)
    state = table(time[known], states[known], POSITION_COLUMNS + VELOCITY_COLUMNS)
    return with_ekf2(flight, state=state)


def behind(run: Replay, time: Array, horizon_s: float) -> tuple[Array, Array]:
    """State from the measurements up to a while ago, carried to now by the raw acceleration."""
    then = time - horizon_s
    position, velocity = state_at(run, then)
    signal = run.axis.acceleration
    dv = cumulative_trapezoid(signal.value_m_s2, signal.time_s, initial=0)
    dp = cumulative_trapezoid(dv, signal.time_s, initial=0)
    v0, v1 = (np.interp(at, signal.time_s, dv) for at in (then, time))
    p0, p1 = (np.interp(at, signal.time_s, dp) for at in (then, time))
    return position + velocity * horizon_s + p1 - p0 - v0 * horizon_s, velocity + v1 - v0


def with_ekf2(flight: Flight, **changes: object) -> Flight:
    assert isinstance(flight.ekf2, Ekf2)
    return replace(flight, ekf2=replace(flight.ekf2, **changes))


def with_parameters(flight: Flight, **parameters: float) -> Flight:
    log = flight.log
    return replace(flight, log=replace(log, parameters={**log.parameters, **parameters}))


def with_r(flight: Flight, sigma_z_m: float) -> Flight:
    """EKF2 logs this R with its innovations."""
    assert isinstance(flight.ekf2, Ekf2)
    innovations = {
        name: frame.assign(observation_variance_m2=sigma_z_m**2)
        for name, frame in flight.ekf2.innovations.items()
    }
    return with_ekf2(flight, innovations=innovations)


def other_variance() -> Flight:
    flight = with_r(base_flight(), 0.4)
    return ekf2_is(flight, flight, Settings(sigma_z_m=0.4))


def other_process_noise() -> Flight:
    flight = with_parameters(base_flight(), EKF2_ACC_NOISE=SAME_NOISE / 5.0)
    return ekf2_is(flight, flight, Settings(sigma_a_m_s2=0.1))


def other_delay() -> Flight:
    flight = with_parameters(base_flight(), EKF2_EV_DELAY=175.0)
    # so that both begin with the same measurement
    flight = without_rows(flight, flight.positions[0].samples.index.to_numpy() < 1.0)
    return ekf2_is(flight, flight, Settings(clock_offset_s=-0.175))


def other_bias() -> Flight:
    flight = base_flight()
    bias = table([0.0, 60.0], [BIAS, BIAS], SPECIFIC_FORCE_COLUMNS)
    imu = flight.imu.copy()
    imu[SPECIFIC_FORCE_COLUMNS] -= BIAS
    made = with_ekf2(flight, accelerometer_bias=bias)
    return ekf2_is(made, replace(flight, imu=imu))


def without_rows(flight: Flight, rows: Array) -> Flight:
    track = flight.positions[0]
    return replace(flight, positions=(replace(track, samples=track.samples[~rows]),))


def other_samples() -> Flight:
    """Outliers that EKF2 rejects; its innovations carry the time at which EKF2 fuses."""
    flight = base_flight(uwb=Uwb(outlier_share=0.05))
    samples = flight.positions[0].samples
    truth = np.interp(samples.index, flight.truth.samples.index, flight.truth.samples["north_m"])
    outlier = np.abs(samples["north_m"].to_numpy() - truth) > 1.0
    assert not outlier[0]
    rows = np.flatnonzero(np.ones(len(samples)))[1:]
    assert isinstance(flight.ekf2, Ekf2)
    innovations = {
        name: frame.assign(rejected=outlier[rows].astype(float)).set_axis(
            frame.index - STEP_S / 2.0
        )
        for name, frame in flight.ekf2.innovations.items()
    }
    made = with_ekf2(flight, innovations=innovations)
    return ekf2_is(made, without_rows(flight, outlier))


def other_gaps() -> Flight:
    """EKF2 does not fuse for ten seconds."""
    flight = base_flight()
    fusing = table([0.0, 30.0, 40.0], [[1.0] * 3, [0.0] * 3, [1.0] * 3],
                   ["horizontal", "vertical", "yaw"])  # fmt: skip
    time = flight.positions[0].samples.index.to_numpy()
    made = with_ekf2(flight, fusing=fusing)
    return ekf2_is(made, without_rows(flight, (time >= 30.0) & (time < 40.0)))


def other_horizon() -> Flight:
    flight = with_ekf2(base_flight(), horizon_s=0.2)
    return ekf2_is(flight, flight, state_of=lambda run, time: behind(run, time, 0.2))


NO_CLOCK = Unavailable("clock offset", "it was not asked for", "Ask for it.")
MADE = {
    "measurement variance": other_variance,
    "process noise": other_process_noise,
    "delay": other_delay,
    "accelerometer bias": other_bias,
    "rejected samples": other_samples,
    "gaps of fusion": other_gaps,
    "fusion horizon": other_horizon,
}


@cache
def made_flight(cause: str) -> Flight:
    return MADE[cause]()


def of_axis(flight: Flight, name: str = "aisle", settings: Settings = DEFAULT) -> Budget:
    found = budget(compare(flight, settings, axes=(name,)), NO_CLOCK)[name]
    assert isinstance(found, Budget)
    return found


@pytest.mark.parametrize("cause", MADE)
@pytest.mark.parametrize("axis", ["aisle", "down"])
def test_the_one_cause_that_was_made_explains_and_the_others_do_not(cause: str, axis: str):
    found = of_axis(made_flight(cause), axis)
    effect = found.causes[cause]
    assert isinstance(effect, Effect)
    assert found.baseline.position_rms_m > 5e-3
    assert effect.position_share > 0.95
    assert effect.velocity_share > 0.95
    assert found.together.position_share > 0.95
    assert found.together.velocity_share > 0.95
    # without it nothing is explained
    assert effect.without.position_rms_m == pytest.approx(found.baseline.position_rms_m, rel=0.02)
    for other, part in found.causes.items():
        if other != cause and isinstance(part, Effect):
            assert abs(part.position_share) < 0.01, other
            assert abs(part.velocity_share) < 0.01, other


def test_every_cause_is_tested_or_never_replayed():
    assert CAUSES.keys() - MADE.keys() == {"full attitude rate"}


@pytest.fixture(scope="module")
def sample(sample_flight: Flight) -> Analysis:
    made = compare(sample_flight)
    return replace(unexplained(made), budget=budget(made, NO_CLOCK))


def test_baseline_is_the_difference_of_the_comparison(sample: Analysis):
    for name, found in sample.budget.items():
        axes = sample.comparison.axes
        difference = next(part.difference for part in axes if part.axis.name == name)
        assert found.count == difference.count
        assert found.baseline.position_rms_m == pytest.approx(difference.position_rmse_m, abs=1e-9)
        assert found.baseline.velocity_rms_m_s == pytest.approx(
            difference.velocity_rmse_m_s, abs=1e-9
        )


def test_states_are_those_of_the_filterpy_replay_with_an_imu_gap():
    from flights import Imu

    made = compare(aisle_flight(imu=Imu(gap_s=(30.0, 34.0)), duration_s=60.0), axes=("north",))
    axis = made.axes[0].axis
    run = replay(axis, made.settings)
    time = np.linspace(run.steps.index[0], run.steps.index[-1], 1001)
    ours = states_at(Run(axis, made.settings, np.zeros(len(axis.measurement_m), bool)), time)
    np.testing.assert_allclose(ours, state_at(run, time), atol=1e-9)


def test_runs_reach_beyond_the_measurements_by_the_input_alone():
    """Stamps moved by a second either way: no sample of EKF2 is lost."""
    made = compare(base_flight(duration_s=30.0), axes=("aisle",))
    axis = made.axes[0].axis
    time = np.linspace(axis.measurement_time_s[0], axis.measurement_time_s[-1], 301)
    for shift in (-1.0, 1.0):
        moved = replace(axis, measurement_time_s=axis.measurement_time_s + shift)
        position, velocity = states_at(
            Run(moved, made.settings, np.zeros(len(axis.measurement_m), bool)), time
        )
        assert np.isfinite(position).all()
        assert np.isfinite(velocity).all()


def test_a_clock_offset_of_ours_is_taken_back_for_ekf2():
    """EKF2 had the stamps as they are: a replay at another offset differs by that alone."""
    flight = base_flight()
    made = ekf2_is(flight, flight)
    effect = of_axis(made, settings=Settings(clock_offset_s=0.2)).causes["delay"]
    assert effect.position_share > 0.95
    assert "+0.2 s" in effect.made


def test_source_that_ekf2_never_fused_and_unlogged_settings_are_named():
    found = of_axis(aisle_flight(uwb=Uwb(rung=3, name="vehicle_mocap_odometry"), duration_s=30.0))
    for cause in ("measurement variance", "delay", "rejected samples", "gaps of fusion"):
        assert isinstance(found.causes[cause], Unavailable)
        assert "does not fuse vehicle_mocap_odometry" in found.causes[cause].reason
    found = of_axis(aisle_flight(duration_s=30.0))
    assert "EKF2_EV_DELAY is not in the log" in found.causes["delay"].reason
    assert "0.35, default" in found.causes["process noise"].made
    assert isinstance(found.causes["accelerometer bias"], Unavailable)
    assert isinstance(found.causes["fusion horizon"], Unavailable)
    assert "50 Hz, the IMU at 100 Hz" in found.causes["full attitude rate"].reason
    assert "never fused" in of_axis(
        aisle_flight(ekf2=Estimator(fusing=((0.0, 0.0),)), duration_s=30.0)
    ).causes["delay"].reason  # fmt: skip


def test_no_ekf2_and_no_known_choice_have_no_budget():
    without = aisle_flight(ekf2=None, duration_s=30.0)
    assert isinstance(budget(compare(without, axes=("north",)), NO_CLOCK)["north"], Unavailable)
    flight = aisle_flight(ekf2=Estimator(fusing=((0.0, 0.0),)), duration_s=30.0)
    unknown = replace(flight, log=replace(flight.log, autopilot="ArduPilot"))
    found = budget(compare(unknown, axes=("north",)), NO_CLOCK)["north"]
    assert isinstance(found, Unavailable)
    assert "none of EKF2's choices" in found.reason


def test_constant_velocity_has_no_accelerometer_causes():
    found = of_axis(base_flight(), settings=Settings(input="zero", sigma_a_m_s2=1.0))
    assert "constant" not in str(found.causes["process noise"])
    for cause in ("process noise", "accelerometer bias"):
        assert "--input imu" in found.causes[cause].remedy


def test_axes_are_the_aisle_and_down_or_else_all():
    flight = base_flight(duration_s=30.0)
    assert list(budget(compare(flight), NO_CLOCK)) == ["aisle", "down"]
    assert list(budget(compare(flight, axes=("north", "east")), NO_CLOCK)) == ["north", "east"]


class TestClock:
    def test_what_a_late_clock_does_is_shown_apart(self):
        """Late stamps, EKF2 as the truth: only moving the stamps back explains the difference."""
        flight = base_flight()
        track = flight.positions[0]
        late = replace(track, samples=track.samples.set_axis(track.samples.index + 0.25))
        made = replace(ekf2_is(flight, flight), positions=(late,))
        offset = ClockOffset(
            -0.25, (-0.3, -0.2), 0.02, True, "", np.zeros(1), np.zeros(1), (), None, None, None,
            0.5, 0.1, 100, 0.0, 2.0,
        )  # fmt: skip
        found = budget(compare(made, axes=("aisle",)), offset)["aisle"]
        assert found.clock.position_share > 0.95
        assert "clock" not in found.together.made
        assert found.together.position_share < 0.05

    @pytest.mark.parametrize(
        ("changes", "reason"),
        [({"interval_s": (-0.3, 0.1)}, "includes zero"), ({"determinable": False}, "not determin")],
    )
    def test_an_uncertain_offset_is_not_replayed(self, changes: dict[str, object], reason: str):
        offset = ClockOffset(
            -0.1, (-0.2, -0.05), 0.02, True, "", np.zeros(1), np.zeros(1), (), None, None, None,
            0.5, 0.1, 100, 0.0, 2.0,
        )  # fmt: skip
        made = compare(base_flight(duration_s=30.0), axes=("aisle",))
        found = budget(made, replace(offset, **changes))
        assert reason in found["aisle"].clock.reason


class TestTruth:
    def test_which_is_closer_and_what_moves_ours(self):
        """EKF2 takes the measurements to be older than they are: that alone takes it away."""
        made = compare(made_flight("delay"), axes=("aisle",))
        found = budget(made, NO_CLOCK)["aisle"]
        aisle = next(part for part in made.axes if part.axis.name == "aisle")
        assert found.truth.kf_position_rmse_m == pytest.approx(aisle.kf_truth.position_rmse_m)
        assert found.truth.ekf2_position_rmse_m == pytest.approx(
            aisle.ekf2_truth.position_rmse_m, rel=0.01
        )
        position, velocity = found.truth.reasons
        assert position.startswith("Our filter is closer to the truth in position")
        moved = found.causes["delay"].alone.truth_position_rmse_m - found.truth.kf_position_rmse_m
        assert f"delay {moved:+.3f} m" in position
        assert "rejected samples" not in position
        assert "in velocity" in velocity

    def test_equal_filters_are_said_to_be_equal(self):
        flight = base_flight()
        reasons = of_axis(ekf2_is(flight, flight)).truth.reasons
        assert reasons[0].startswith("In position both are equally close")
        assert "No choice of EKF2's alone changes our error by 5%" in reasons[0]

    def test_without_truth_or_its_velocity_nothing_is_made_up(self):
        assert isinstance(of_axis(base_flight(truth=False)).truth, Unavailable)
        flight = base_flight()
        assert isinstance(flight.truth, Truth)
        samples = flight.truth.samples.copy()
        samples[VELOCITY_COLUMNS] = np.nan
        found = of_axis(replace(flight, truth=replace(flight.truth, samples=samples)))
        assert found.truth.kf_velocity_rmse_m_s is None
        assert len(found.truth.reasons) == 1


class TestReader:
    """Bias and horizon from ULogs of every generation."""

    STEP_S = 0.010  # of EKF2 at the made flight's 100 Hz

    def read(self, tmp_path, log) -> Ekf2:
        ekf2 = read_log(log.write(tmp_path / "made.ulg")).ekf2
        assert isinstance(ekf2, Ekf2)
        return ekf2

    @pytest.mark.parametrize("generation", GENERATIONS)
    def test_bias_is_in_m_s2_whatever_the_state_vector_holds(self, tmp_path, generation: str):
        log = make_log(generation)
        number = int(generation.removeprefix("v1."))
        holder = log["estimator_states" if number >= 12 else "estimator_status"]
        holder["states"][:, 13:16] = BIAS * (self.STEP_S if number < 15 else 1.0)
        ekf2 = self.read(tmp_path, log)
        assert ekf2.step_s == pytest.approx(self.STEP_S)
        np.testing.assert_allclose(
            ekf2.accelerometer_bias, np.tile(BIAS, (len(ekf2.accelerometer_bias), 1)), rtol=1e-5
        )

    def test_its_own_topic_is_preferred(self, tmp_path):
        log = make_log("v1.14")
        time = stamps(10.0, 1.0)
        log.add(topic("estimator_sensor_bias", time, {"accel_bias": np.tile(BIAS, (10, 1))},
                      sampled=True))  # fmt: skip
        bias = self.read(tmp_path, log).accelerometer_bias
        np.testing.assert_allclose(bias.iloc[0], BIAS, rtol=1e-6)
        assert bias.index[1] == pytest.approx(1.0)

    def test_step_is_a_whole_number_of_imu_samples(self, tmp_path):
        log = make_log("v1.14", imu_hz=1.0 / 0.004)
        log.parameters["EKF2_PREDICT_US"] = 10_000
        log["estimator_states"]["states"][:, 13:16] = BIAS * 0.008
        ekf2 = self.read(tmp_path, log)
        assert ekf2.step_s == pytest.approx(0.008)  # 2.5 samples round to 2
        np.testing.assert_allclose(ekf2.accelerometer_bias.iloc[0], BIAS, rtol=1e-5)

    def test_horizon_is_the_age_at_publication(self, tmp_path):
        assert self.read(tmp_path, make_log("v1.16")).horizon_s == pytest.approx(0.060)
        assert isinstance(self.read(tmp_path, make_log("v1.11")).horizon_s, Unavailable)

    def test_no_states_and_no_horizon_are_said(self, tmp_path):
        ekf2 = self.read(tmp_path, make_log("v1.16").drop("estimator_states"))
        assert isinstance(ekf2.accelerometer_bias, Unavailable)
        assert isinstance(ekf2.horizon_s, Unavailable)

    def test_unusable_horizons_and_few_imu_samples_are_passed_over(self, tmp_path):
        log = make_log("v1.16")
        log["estimator_states"]["timestamp_sample"] = log["estimator_states"]["timestamp"].copy()
        assert isinstance(self.read(tmp_path, log).horizon_s, Unavailable)
        lone = make_log("v1.16")
        imu = lone["sensor_combined"]
        for name in imu:
            imu[name] = imu[name][:1]
        assert self.read(tmp_path, lone).step_s == 0.010


def test_results_with_a_budget_validate_and_say_which_filter(sample: Analysis):
    said = results(ComparisonRequest(log="aisle_uwb.ulg"), sample, (), Student(), "")
    assert to_json(read_results(to_json(said).encode())) == to_json(said)
    aisle = said.budget["aisle"]
    assert isinstance(aisle, made.Budget)
    assert aisle.causes.keys() == {name.replace(" ", "_") for name in CAUSES}
    assert "velocity" in aisle.truth.reasons[1]
    assert aisle.together.position_share > 0.5


def test_corrected_acceleration_is_what_the_bias_leaves():
    flight = made_flight("accelerometer bias")
    assert isinstance(flight.imu, pd.DataFrame)
    found = of_axis(flight, "down")
    assert "+0.150, -0.100, +0.080 m/s²" in found.causes["accelerometer bias"].made
    assert isinstance(ned_acceleration(flight), pd.DataFrame)


@pytest.mark.reallogs
class TestFlownFlights:
    def of(self, shared_logs, name: str) -> Budget:
        return of_axis(read_log(shared_logs / "simulated" / f"{name}.ulg"))

    def test_delay_left_at_its_old_default_is_the_largest_cause(self, shared_logs):
        found = self.of(shared_logs, "v1.13.3_aisle_evdelay175")
        effects = {name: e for name, e in found.causes.items() if isinstance(e, Effect)}
        assert max(effects, key=lambda name: effects[name].position_share) == "delay"
        assert max(effects, key=lambda name: effects[name].without.position_rms_m) == "delay"
        assert found.together.position_share > 0.8
        assert found.truth.reasons[0].startswith("Our filter is closer to the truth")
        assert "delay +0.098 m" in found.truth.reasons[0]

    def test_overconfident_ekf2_differs_by_what_it_rejects(self, shared_logs):
        found = self.of(shared_logs, "v1.16.1_aisle_overconfident")
        effects = {name: e for name, e in found.causes.items() if isinstance(e, Effect)}
        assert max(effects, key=lambda name: effects[name].position_share) == "rejected samples"
        assert "SIGMA_Z 0.02 m" in effects["measurement variance"].made
        assert effects["rejected samples"].without.position_rms_m > 1.5 * (
            found.together.alone.position_rms_m
        )


def test_what_does_not_fit_on_a_page_begins_the_next() -> None:
    """Two axes with much to say ran over the foot of the page."""
    long = Unavailable("budget", "a sentence of some length, again " * 160, "None")
    document = SimpleNamespace(analysis=SimpleNamespace(budget={"aisle": long, "down": long}))
    with report_style():
        pages = list(draw(document))  # type: ignore[arg-type]
    assert len(pages) == 2
    assert min(text.get_position()[1] for figure in pages for text in figure.texts) >= BOTTOM
