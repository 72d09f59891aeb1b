"""Height fusion in the EKF2 model on GNSS: closed forms, simulated pairs, flights of PX4's EKF2."""

import json
from functools import cache
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pandas as pd
import pytest
from ekf2_tools import opened
from exchange import replace
from findings_tools import made

from px4fuse.analysis import WhatIfAnalysis
from px4fuse.ekf2.barometer import estimate_barometer_interval_s, find_fused_barometer_samples
from px4fuse.ekf2.filter_batch import FilterBatch, FilterConfiguration
from px4fuse.ekf2.filter_recursion import SegmentRun
from px4fuse.ekf2.height_samples import add_heights
from px4fuse.ekf2.heights import BadAccelerationFlag, HeightFilter
from px4fuse.ekf2.model import Ekf2Model, run_configurations
from px4fuse.ekf2.replay_segments import HeightSamples, ReplaySegment
from px4fuse.ekf2.whatif import HEIGHT_LOGGED_NOTE, what_if
from px4fuse.errors import SettingsError
from px4fuse.flight.model import AidLog, Ekf2, Flight, FusionRecord
from px4fuse.readers import read_log
from px4fuse.report.difference_page import format_replay_agreement
from px4fuse.report.whatif import list_statistics
from px4fuse.request import WhatIfRequest
from px4fuse.results.build import make_whatif_results
from px4fuse.results.contract import schema, to_json
from px4fuse.simulation import ekf2 as simulated
from px4fuse.simulation.faults import parse_faults
from px4fuse.simulation.flights import simulate_flight
from px4fuse.simulation.scenario import make_scenario

BOTH = ("baro_hgt", "gnss_hgt")
STEP_S, PERIOD_S = 0.01, 0.1


def climbing(
    heights: HeightSamples, count: int = 400, up_m_s2: float = 0.0, **more: Any
) -> ReplaySegment:
    force = np.tile([0.0, 0.0, -9.80665 - up_m_s2], (count, 1))
    return made(
        ReplaySegment, time_s=STEP_S * np.arange(count + 1), step_s=np.full(count, STEP_S),
        body_to_ned=np.tile(np.eye(3), (count + 1, 1, 1)), specific_force_m_s2=force,
        height_samples=heights, **more,
    )  # fmt: skip


def sampled(
    steps: list[int], down_m: list[float], *, fused: tuple[str, ...] = BOTH,
    reference: str = "gnss_hgt", dead_zone_m: float = 0.0, weight: float = 1.0,
) -> HeightSamples:  # fmt: skip
    step = np.array(steps)
    samples = {"down_m": down_m, "dead_zone_m": dead_zone_m, "weight": weight}
    return HeightSamples(
        fused, reference, np.array([0.0, 1.0]), step, pd.DataFrame(samples, STEP_S * step)
    )


def of_baro(steps: list[int], down_m: list[float], **more: float) -> HeightSamples:
    """Return samples of a flight with the barometer only."""
    return sampled(steps, down_m, fused=("baro_hgt",), reference="baro_hgt", **more)


def fusing(
    segment: ReplaySegment,
    end: np.ndarray,
    *,
    reference_until: float = np.inf,
    has_gate: bool = True,
) -> HeightFilter:
    has_fix, time_s = np.zeros((len(end), 1), bool), segment.time_s[end][:, None]
    batch = made(
        FilterBatch, segment=segment, event_steps=end[:, None],
        events=np.rec.fromarrays([time_s], names="time_s"), has_gate=np.array([has_gate]),
        is_enabled_by_aid={"baro_hgt": np.ones_like(has_fix), "gnss_hgt": time_s < reference_until},
        parameters={"EKF2_BARO_NOISE": np.array([0.5]), "EKF2_BARO_GATE": np.array([5.0])},
    )  # fmt: skip
    flag = BadAccelerationFlag(np.array([True]), 3.0, segment)
    return HeightFilter(batch, has_fix, np.zeros_like(time_s), flag)


def standing(of: HeightSamples, count: int = 400, **how: Any) -> tuple[HeightFilter, pd.DataFrame]:
    """Return the filter of a state at rest, and the update of each barometer sample."""
    end = np.unique(of.step_indices)
    heights = fusing(climbing(of, count), end, **how)
    for e in range(len(end)):
        heights.fuse_barometer(e, np.zeros((1, 9)), np.zeros((1, 9, 9)))
    return heights, heights.make_update_table("baro_hgt", 0, end * STEP_S)


def test_barometer_bias_matches_scalar_kalman_filter() -> None:
    """The barometer reads 1.7 m too high (down 1.7 m less); the height is known exactly.

    Steady state: p = (q + √(q² + 4 q R)) / 2 before a sample, with q = 0.13² T
    (bias_estimator.cpp).
    """
    steps = list(range(10, 4000, 10))
    heights, found = standing(sampled(steps, [-1.7] * len(steps)), 4000)
    q, R = 0.13**2 * PERIOD_S, 0.25
    p = (q + np.sqrt(q * q + 4.0 * q * R)) / 2.0
    assert heights.bias.variance_m2[0] == pytest.approx(p * R / (p + R), rel=1e-6)
    assert found["innovation_variance_down_m2"].iloc[-1] == pytest.approx(p + R, rel=1e-6)
    assert heights.bias.bias_m[0] == pytest.approx(1.7, abs=1e-6)
    # transient as in the scalar recursion
    bias, variance, innovations = 0.0, 1.0, []
    for _ in steps:
        variance = min(variance + q, R)
        innovations.append(-1.7 + bias)
        K = variance / (variance + R)
        if innovations[-1] ** 2 < 9.0 * (variance + R):
            bias, variance = bias + K * (1.7 - bias), variance * (1.0 - K)
    np.testing.assert_allclose(found["innovation_down_m"], innovations, atol=1e-9)


def test_barometer_bias_is_constant_after_height_reference_stops() -> None:
    steps = list(range(10, 400, 10))
    _, found = standing(sampled(steps, [-1.0] * len(steps)), reference_until=1.005)
    after = found["innovation_down_m"].loc[1.15:]
    assert np.ptp(after) == 0.0
    assert 0.0 < -after.iloc[0] < 0.5 < -found["innovation_down_m"].iloc[0]


@pytest.mark.parametrize(("down_m", "learned"), [(-2.0, True), (-2.3, False)])
def test_barometer_bias_ignores_innovation_outside_gate(down_m, learned) -> None:
    """The gate is 3 √(0.25 + 0.25) m."""
    heights, _ = standing(sampled([10], [down_m]))
    assert (heights.bias.bias_m[0] > 0.0) == learned


@pytest.mark.parametrize("reference", BOTH)
def test_height_bias_of_the_reference_sensor_stays_zero(reference: str) -> None:
    steps = list(range(10, 400, 10))
    heights, _ = standing(sampled(steps, [-1.0] * len(steps), reference=reference))
    assert (heights.bias.bias_m[0] == 0.0) == (reference == "baro_hgt")


def test_height_innovation_refers_to_sample_time() -> None:
    """Climb at 2 m/s and 3 m/s², with two samples before an event, and one at it."""
    time = STEP_S * np.arange(401)
    down = -2.0 * time - 1.5 * time**2
    steps = [13, 17, 30, 45]
    of = of_baro(steps, [down[at] - 0.1 for at in steps])
    end = np.array([10, 20, 30, 40, 50])
    heights = fusing(climbing(of, up_m_s2=3.0), end)
    for e, at in enumerate(end):
        x = np.zeros((1, 9))
        x[0, 5], x[0, 8] = -2.0 - 3.0 * time[at], down[at]
        heights.fuse_barometer(e, x, np.zeros((1, 9, 9)))
    found = heights.make_update_table("baro_hgt", 0, end * STEP_S)
    np.testing.assert_allclose(found["innovation_down_m"], -0.1, atol=1e-9)
    np.testing.assert_allclose(found.index, time[steps])
    np.testing.assert_allclose(found["fused_at_s"], [0.2, 0.2, 0.3, 0.5])


def test_height_sample_with_weight_2_equals_two_samples() -> None:
    """R = 0.25 m² with weight 2 acts as two samples; S is that of one."""
    P = np.zeros((1, 9, 9))
    P[0, 8, 8] = 0.5
    variances = []
    for steps, weight in (([10], 2.0), ([10, 10], 1.0)):
        segment = climbing(of_baro(steps, [0.3] * len(steps), weight=weight))
        heights = fusing(segment, np.array([10]))
        x, after = heights.fuse_barometer(0, np.zeros((1, 9)), P)
        variances.append((after[0, 8, 8], x[0, 8]))
        assert heights.update_records[0, 0, 1, 0] == pytest.approx(0.75)
    assert variances[0] == pytest.approx(variances[1])


@pytest.mark.parametrize(
    ("innovation", "expected"), [(-0.5, -0.5), (0.5, 0.0), (3.9, 0.0), (4.5, 0.5)]
)
def test_barometer_innovation_inside_dead_zone_is_set_to_zero(innovation, expected) -> None:
    """Dead zone EKF2_GND_EFF_DZ of baro_height_control.cpp."""
    _, found = standing(of_baro([10], [innovation], dead_zone_m=4.0))
    assert found["innovation_down_m"].item() == pytest.approx(expected)


@pytest.mark.parametrize(("has_gate", "fused"), [(True, 0.0), (False, 1.0)])
def test_height_sample_outside_gate_is_rejected(has_gate: bool, fused: float) -> None:
    _, found = standing(of_baro([10], [2.6]), has_gate=has_gate)
    assert (found["fused"].item(), found["rejected"].item()) == (fused, 1.0 - fused)


# -------------------------------------------------------------------- simulated flights


@cache
def outdoors(baro_noise_m: float = 0.4) -> Flight:
    """Simulate a flight with this EKF2_BARO_NOISE."""
    usual = simulated.make_parameters
    noise = {"EKF2_BARO_NOISE": baro_noise_m}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulated, "make_parameters", lambda *of: usual(*of) | noise)
        return simulate_flight(make_scenario("outdoor", seed=3, passes=3), parse_faults(()))


@cache
def open_outdoor_model() -> Ekf2Model:
    return opened(outdoors())


@pytest.mark.slow
def test_replay_with_other_baro_noise_equals_flight_with_it() -> None:
    model = open_outdoor_model()
    assert model.agreement.baro_hgt["down"].innovation_correlation > 0.999
    assert model.agreement.baro_hgt["down"].position_rms_difference_m < 0.02
    other = opened(outdoors(2.0))
    for one, value, then in ((model, 2.0, other), (other, 0.4, model)):
        found, true = what_if(one, [{"EKF2_BARO_NOISE": value}]), what_if(then, [])
        (predicted,), logged = found.whatif, true.logged
        for name in ("nis_mean", "innovation_std_m"):
            expected = getattr(true.replayed.heights["baro_hgt"], name)
            assert getattr(predicted.heights["baro_hgt"], name) == pytest.approx(expected, rel=0.02)
        error_m = logged.height_rmse_to_truth_m
        assert predicted.height_rmse_to_truth_m == pytest.approx(error_m, rel=0.1)
        assert HEIGHT_LOGGED_NOTE not in found.notes
    # with 25 times the variance the barometer corrects the height less
    tight, loose = (
        column.heights["baro_hgt"].nis_mean for column in (found.whatif[0], found.logged)
    )
    assert tight > 5.0 * loose


def test_ekf2_replay_without_height_sensor_reports_height_drift() -> None:
    found = what_if(open_outdoor_model(), [{}], {"baro_hgt": 40.0})
    (lost,) = found.whatif
    assert lost.heights == {}
    assert lost.height_rmse_to_truth_m > 2.0 * found.replayed.height_rmse_to_truth_m
    assert ". The heights of both replays differ by at most " in found.notes[-1]


def test_replay_gives_no_prediction_after_5_s_height_rejection() -> None:
    """EKF2 resets the height after 5 s, which the model does not contain."""
    flight = outdoors()
    jump = flight.barometer.copy()
    jump.loc[40.0:50.0, "down_m"] += 3.0
    model = open_outdoor_model()
    ekf2, other = model.flight.ekf2, replace(flight, barometer=jump)
    log = replace(ekf2.aids["baro_hgt"], samples=pd.DataFrame())  # only the logged barometer
    ekf2 = replace(ekf2, aids=ekf2.aids | {"baro_hgt": log})
    segments = add_heights(other, ekf2, ekf2.record, model.inputs.segments)
    jumping = replace(model, inputs=replace(model.inputs, segments=segments))
    found = what_if(jumping, [{"EKF2_BARO_GATE": gate} for gate in (3.0, 50.0)])
    assert [one.is_predictable for one in found.whatif] == [False, True]
    assert found.whatif[0].heights["baro_hgt"].longest_without_fusion_s > 5.0


def test_ekf2_replay_excludes_barometer_that_disagrees_with_log() -> None:
    flight = outdoors()
    noise = np.random.default_rng(1).normal(0.0, 1.0, (len(flight.barometer), 1))
    model = opened(replace(flight, barometer=flight.barometer + noise))
    agreement = model.agreement
    assert agreement.good
    assert set(agreement.doubtful) == {"baro_hgt"}
    assert "a correlation of" in agreement.doubtful["baro_hgt"]
    assert agreement.baro_hgt["down"].innovation_correlation < 0.95
    assert "barometer" in format_replay_agreement(agreement)
    assert model.baseline_replay.other_aid_updates.keys() == {"gnss_vel"}
    own = np.interp(
        model.baseline_replay.delayed_state.index,
        flight.ekf2.state.index,
        flight.ekf2.state["down_m"],
    )
    assert np.abs(model.baseline_replay.delayed_state["down_m"] - own).max() < 0.5
    found = what_if(model, [{"EKF2_GPS_DELAY": 0.0}])
    assert HEIGHT_LOGGED_NOTE in found.notes
    with pytest.raises(SettingsError, match=r"EKF2_BARO_NOISE has no effect .*barometer: "):
        what_if(model, [{"EKF2_BARO_NOISE": 1.0}])
    with pytest.raises(SettingsError, match=r"baro_hgt cannot be omitted: .*barometer: "):
        what_if(model, [{}], {"baro_hgt": 40.0})


def test_ekf2_replay_without_all_height_samples_gives_reason() -> None:
    flight = outdoors()
    model = open_outdoor_model()
    ekf2, segments = model.flight.ekf2, model.inputs.segments
    record = ekf2.record

    def why(enabled: dict[str, float], rows: int = 1, **parameters: float) -> str:
        """Return the reason for aiding sources enabled from the start (1) or from 60 s on (0)."""
        found = {
            name: made(
                AidLog, enabled=pd.Series([share, 1.0], index=[0.0, 60.0]), samples=pd.DataFrame()
            )
            for name, share in enabled.items()
        }
        log = replace(record, parameters=record.parameters | parameters)
        other = replace(flight, barometer=flight.barometer.iloc[::rows])
        update_records = add_heights(other, replace(ekf2, aids=found), log, segments)
        return update_records if isinstance(update_records, str) else ""

    assert why({"baro_hgt": 1.0}) == ""
    assert "range finder in part" in why({"baro_hgt": 1.0, "rng_hgt": 0.0})
    assert "GNSS height in part" in why({"baro_hgt": 1.0, "gnss_hgt": 0.0})
    assert "barometer bias" in why(dict.fromkeys(BOTH, 1.0), EKF2_HGT_REF=1.0)
    assert "GNSS height bias" in why(dict.fromkeys(BOTH, 1.0), EKF2_HGT_REF=0.0)
    assert "height reference is neither" in why(dict.fromkeys(BOTH, 1.0), EKF2_HGT_REF=2.0)
    assert "height reference is neither" in why({})
    assert "barometer is logged at 3.3 Hz" in why({"baro_hgt": 1.0}, rows=3)
    old = {"EKF2_AID_MASK": 1.0}
    log = replace(record, parameters=old)
    assert "before PX4 v1.14" in add_heights(flight, ekf2, log, segments)


def test_ekf2_noise_of_clipped_accelerometer_is_4_9_m_s2() -> None:
    """The noise is BADACC_BIAS_PNOISE of covariance.cpp."""
    inputs = open_outdoor_model().inputs
    (segment,) = inputs.segments
    spoilt = replace(segment, clipped_fraction=np.ones(len(segment.time_s), bool))

    def ran(one: ReplaySegment, **changed: float) -> SegmentRun:
        settings = inputs.settings | changed
        given = replace(inputs, segments=(one,))
        return run_configurations(given, [FilterConfiguration(settings)])[0]

    np.testing.assert_array_equal(ran(spoilt).state, ran(segment, EKF2_ACC_NOISE=4.9).state)
    # one clipped axis of three equals a third of the steps
    third = np.sqrt((2.0 * inputs.settings["EKF2_ACC_NOISE"] ** 2 + 4.9**2) / 3.0)
    clipped = replace(segment, clipped_fraction=np.full(len(segment.time_s), 1.0 / 3.0))
    expected = ran(segment, EKF2_ACC_NOISE=float(third)).variance
    np.testing.assert_allclose(ran(clipped).variance, expected, rtol=1e-9)


def test_clipping_fraction_is_number_of_clipped_imu_axes_over_3() -> None:
    flight = outdoors()
    (plain,) = open_outdoor_model().inputs.segments
    clipped = pd.Series(0, flight.imu.index)
    at = plain.time_s[[100, 200]] - 1e-4
    clipped.iloc[np.searchsorted(flight.imu.index, at)] = [0b101, 0b111]
    (update_records,) = opened(
        replace(flight, imu=flight.imu.assign(clipped=clipped))
    ).inputs.segments
    assert not plain.clipped_fraction.any()
    assert update_records.clipped_fraction[[100, 200]].tolist() == [pytest.approx(2.0 / 3.0), 1.0]
    assert np.flatnonzero(update_records.clipped_fraction).tolist() == [100, 200]


def test_two_large_height_innovations_set_bad_acceleration_flag() -> None:
    """Two innovations of different sensors, above 3 √S and above √S; the flag lasts 3 s."""
    nan = np.nan
    segment = climbing(of_baro([10], [0.0]))
    flag = BadAccelerationFlag(np.array([False, True]), 3.0, segment)
    ratios = [np.full((2, 2), nan)]

    def event(time_s: float, barometer: list[float], gnss: float) -> list[float]:
        """Return the fraction of the 0.1 s before an event with the flag, then fuse samples."""
        flag.apply_logged_flag(np.array([time_s]))
        share = flag.compute_bad_acceleration_fraction(np.array([time_s - 0.1]), np.array([time_s]))
        ratios.append(np.array([[one, one] for one in (*barometer, gnss)]))
        flag.update(np.array([time_s]), *ratios[-2:])
        return share.tolist()

    # one sensor alone, or in the other direction, is not sufficient
    assert event(0.1, [3.5], 0.9) == event(0.2, [-3.5], -1.5) == event(0.3, [0.0], 3.5) == [0, 0]
    assert event(0.4, [0.9, nan], 3.5) == [0.0, 0.0]
    # the GNSS innovation is valid until the next fix; the second configuration follows the log
    assert event(0.5, [nan, 1.1], 0.0) == [0.0, 0.0]
    assert event(0.6, [0.0], 0.0) == [1.0, 0.0]
    assert event(3.55, [0.0], 0.0)[0] == pytest.approx(0.5)
    assert event(3.7, [0.0], 0.0) == [0.0, 0.0]
    # the innovations of an event are valid until the next event
    assert event(3.8, [3.1], 1.1) == [0.0, 0.0]
    event(3.9, [0.0], 0.0)
    assert flag.until_s[0] == pytest.approx(6.9)


def test_ekf2_flag_for_bad_acceleration_is_read_from_log() -> None:
    is_bad = np.zeros(401, bool)
    is_bad[[*range(100, 150), *range(300, 401)]] = True
    segment = climbing(of_baro([10], [0.0]), is_acceleration_bad=is_bad)
    flag = BadAccelerationFlag(np.array([True]), 3.0, segment)
    shares = []
    for end_s in (0.9, 1.1, 1.3, 1.6, 1.8, 4.0):
        flag.apply_logged_flag(np.array([end_s]))
        shares += flag.compute_bad_acceleration_fraction(
            np.array([end_s - 0.2]), np.array([end_s])
        ).tolist()
    assert shares == pytest.approx([0.0, 0.5, 1.0, 0.5, 0.0, 1.0])


@pytest.mark.parametrize(("every", "has_filter"), [(1, False), (2, False), (2, True), (3, True)])
def test_barometer_samples_missing_in_log_are_reconstructed(every: int, has_filter: bool) -> None:
    """Vehicle at rest, 20 Hz barometer with a bias of 1.7 m; aid and bias are logged at 2 Hz."""
    rng = np.random.default_rng(3)
    time_s = 0.05 * np.arange(401)
    innovation_m = 0.5 * rng.standard_normal(401)
    share = 0.05 / 0.55
    filtered_m = [0.0]
    for nu in innovation_m[1:]:
        filtered_m.append((1.0 - share) * filtered_m[-1] - share * nu)
    rows = pd.DataFrame(
        {"observation_down": innovation_m, "innovation_down": innovation_m,
         "filtered_down": filtered_m},
        pd.Index(time_s),
    )[10::10]  # fmt: skip
    # steady variance after an update with S = 0.25 m² + p
    q = 0.13**2 * 0.05
    p = (q + np.sqrt(q * q + 4.0 * q * 0.25)) / 2.0
    bias = {"bias_m": 1.7, "innovation_m": 0.0, "bias_m2": p * 0.25 / (p + 0.25)}
    bias = pd.DataFrame(bias | {"variance_m2": p + 0.25}, pd.Index(time_s[10::10]))
    record = made(
        FusionRecord,
        height_bias_updates={"baro_hgt": bias},
        has_delta_angle_biases=False,
        status_flags={},
    )
    state = pd.DataFrame({"down_m_s": 0.0}, time_s)
    log = made(AidLog, samples=rows if has_filter else rows.drop(columns="filtered_down"))
    ekf2 = made(Ekf2, state=state, aids={"baro_hgt": log})
    assert estimate_barometer_interval_s(record) == pytest.approx(0.05, rel=1e-6)
    raw = pd.Series(innovation_m - 1.7, time_s)
    found = find_fused_barometer_samples(ekf2, record, raw.iloc[::every])["down_m"]
    is_known = np.isin(
        np.arange(401) % (10 * every), [*range(0, 10 * every, every), *range(0, 99, 10)]
    )
    at = np.rint(found.index / 0.05).astype(int)
    np.testing.assert_allclose(found[is_known[at]], raw.iloc[at][is_known[at]], atol=1e-9)
    if not has_filter:
        assert len(found) == is_known.sum()
        return
    # between the rows all samples are present, with the logged low-pass filtered innovation
    complete = found[(found.index > 0.49) & (found.index < 20.01)]
    assert len(complete) == 391
    low = filtered_m[10]
    for nu in complete.iloc[1:11] + 1.7:
        low = (1.0 - share) * low - share * nu
    assert low == pytest.approx(filtered_m[20], abs=1e-9)
    assert complete.std() == pytest.approx(0.5, rel=0.1)


# ------------------------------------------------------------------ flights of PX4's EKF2

FLOWN = {
    "delay0": (0.998, 0.97, 0.05), "fullrate": (0.999, 0.99, 0.03), "nominal": (0.999, 0.99, 0.04),
    "overconfident": (0.999, 0.999, 0.02),
}  # fmt: skip


@pytest.fixture(scope="module")
def models(shared_logs: Path, model_of: Any) -> dict[str, Ekf2Model]:
    return {name: model_of(shared_logs / "gps" / f"v1.16.1_gps_{name}.ulg") for name in FLOWN}


@pytest.mark.reallogs
@pytest.mark.parametrize("name", FLOWN)
def test_ekf2_replay_heights_of_real_flights_agree_with_log(
    models: dict[str, Ekf2Model], name: str
) -> None:
    """Half of the barometer samples are not logged, except in the last flight."""
    gnss, barometer, published_m = FLOWN[name]
    agreement = models[name].agreement
    assert agreement.doubtful == {}
    for aid, least in (("gnss_hgt", gnss), ("baro_hgt", barometer)):
        axis = getattr(agreement, aid)["down"]
        assert axis.innovation_correlation > least
        assert 0.99 < axis.s_ratio_p5 <= axis.s_ratio_p95 < 1.01
        assert axis.nis_mean_replayed == pytest.approx(axis.nis_mean_logged, rel=0.15)
        assert axis.position_rms_difference_m < published_m
        assert axis.velocity_rms_difference_m_s < 0.02
    for summary in (found := what_if(models[name], [])).logged, found.replayed:  # type: ignore[union-attr]
        assert {one.rejected_fraction for one in summary.heights.values()} == {0.0}
    error_m = found.logged.height_rmse_to_truth_m
    assert found.replayed.height_rmse_to_truth_m == pytest.approx(error_m, abs=0.02)


@pytest.mark.reallogs
def test_ekf2_replay_with_smaller_barometer_gate_rejects_more(models: dict[str, Ekf2Model]) -> None:
    """EKF2_BARO_NOISE scales NIS; the gate rejects innovations outside it."""

    def heights(without: dict[str, float] | None = None, **settings: float) -> Any:
        found = what_if(models["nominal"], [settings], without or {})
        return found.whatif[0], found.replayed

    loose, flown = heights(EKF2_BARO_NOISE=3.5)
    # R is 49 times larger; the bias takes up the slow part
    ratio = loose.heights["baro_hgt"].nis_mean / flown.heights["baro_hgt"].nis_mean
    assert 1.0 / 49.0 < ratio < 1.0 / 25.0
    # R is 1.5 times EKF2_GPS_P_NOISE instead of the reported 0.6 m
    wide = heights(EKF2_GPS_P_NOISE=2.0)[0].heights["gnss_hgt"]
    assert 7.5 < wide.innovation_std_m**2 / wide.nis_mean < 9.6  # plus the square of the mean
    narrow, _ = heights(EKF2_BARO_GATE=1.0)
    # share outside 1 √S of a normal distribution with this NIS
    assert narrow.heights["baro_hgt"].rejected_fraction == pytest.approx(0.17, abs=0.03)
    assert narrow.heights["gnss_hgt"].rejected_fraction == 0.0
    # GNSS only: 0.6 m noise at 10 Hz, stabilised by its velocity
    alone, flown = heights({"baro_hgt": 60.0})
    assert alone.heights.keys() == {"gnss_hgt"}
    assert alone.height_rmse_to_truth_m == pytest.approx(flown.height_rmse_to_truth_m, abs=0.05)
    # the barometer bias is then no longer estimated
    drifting, flown = heights({"gnss_hgt": 60.0})
    assert drifting.height_rmse_to_truth_m > 1.5 * flown.height_rmse_to_truth_m
    error_m = flown.north.position_rmse_to_truth_m
    assert drifting.north.position_rmse_to_truth_m == pytest.approx(error_m, abs=0.01)


@pytest.mark.reallogs
def test_ekf2_replay_with_baro_noise_rejects_range_finder_log(shared_logs: Path) -> None:
    model = opened(read_log(shared_logs / "simulated" / "v1.16.1_no_uwb.ulg"))
    assert model.agreement.good
    with pytest.raises(SettingsError, match="EKF2 also fused range finder"):
        what_if(model, [{"EKF2_BARO_NOISE": 1.0}])


@pytest.mark.reallogs
def test_ekf2_replay_results_contain_each_height_sensor(models: dict[str, Ekf2Model]) -> None:
    model, changes, without = models["nominal"], {"EKF2_BARO_GATE": 1.5}, {"gnss_hgt": 100.0}
    request = WhatIfRequest(log=model.flight.log.name, changes=changes, without=without)
    asked = what_if(model, [changes], without)
    found = WhatIfAnalysis(model.flight, asked, changes, uses_estimates=False, without=without)
    results = json.loads(to_json(make_whatif_results(request, found)))
    jsonschema.validate(results, schema())
    assert results["whatif"]["heights"].keys() == {"baro_hgt"}
    assert results["replayed"]["heights"].keys() == {"baro_hgt", "gnss_hgt"}
    lines = list(list_statistics(found))
    assert any("GNSS height: mean NIS" in line and line.endswith("→ n/a") for line in lines)
    before, after = (
        f"{results[which]['height_rmse_to_truth_m']:.3f}" for which in ("replayed", "whatif")
    )
    assert f"EKF2 (replay), height RMSE {before} → {after} m" in lines
