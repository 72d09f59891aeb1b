"""Optical flow in the EKF2 model, and times that the model cannot replay."""

from functools import cache

import numpy as np
import pandas as pd
import pytest
from ekf2_tools import intervals_of, opened
from exchange import replace
from ulog_tools import gnss_log, seconds_of, stamps, topic

from px4fuse.ekf2.inputs import read_gnss
from px4fuse.ekf2.magnetometer import EventSamples, average_by_event, fuse_mean_sample
from px4fuse.ekf2.model import Ekf2Model, replay_with_settings
from px4fuse.ekf2.replay_segments import VELOCITY, add_flow_samples
from px4fuse.ekf2.whatif import what_if
from px4fuse.flight.model import Columns, Flight, Reset
from px4fuse.readers import read_log
from px4fuse.readers.px4_innovations import replace_vision_by_gnss_innovations
from px4fuse.simulation.faults import parse_faults
from px4fuse.simulation.flights import simulate_flight
from px4fuse.simulation.scenario import make_scenario

# interval (s) and weight of a new sample in EKF2's low-pass filter, ekf.h
INTERVAL_S, SHARE = 0.02, 0.1


def low_pass_weights(raw: np.ndarray) -> np.ndarray:
    """Apply EKF2's AlphaFilter."""
    found = raw.copy()
    for k in range(1, len(raw)):
        found[k] = found[k - 1] + SHARE * (raw[k] - found[k - 1])
    return found


@cache
def model() -> Ekf2Model:
    return opened(simulate_flight(make_scenario("outdoor", seed=3, passes=3), parse_faults(())))


def true_velocity(times: np.ndarray) -> np.ndarray:
    truth = model().flight.truth
    return np.column_stack([np.interp(times, truth.samples.index, truth.samples[column])
                            for column in Columns.VELOCITY])  # fmt: skip


def flow_of(noise_m_s: float = 0.0, every: int = 10) -> pd.DataFrame:
    """Return logged flow rows of a sensor at 50 Hz."""
    (segment,) = model().inputs.segments
    times = np.arange(segment.time_s[0] + 1.0, segment.time_s[-1] - 0.5, INTERVAL_S)
    turn = segment.body_to_ned[np.searchsorted(segment.time_s, times - 1e-9)]
    raw = np.einsum("nji,nj->ni", turn, true_velocity(times))[:, :2]
    raw += np.random.default_rng(1).normal(0.0, 1.0, raw.shape) * noise_m_s
    remaining = low_pass_weights(raw)[::every]
    decay = (1.0 - SHARE) ** every
    mean = (remaining[1:] - decay * remaining[:-1]) / (1.0 - decay)
    return pd.DataFrame({
        "forward_m_s": mean[:, 0], "right_m_s": mean[:, 1], "samples": float(every),
        "interval_s": INTERVAL_S, "noise_m2_s2": max(noise_m_s, 0.3) ** 2,
    }, index=times[every::every])  # fmt: skip


def flying(noise_m_s: float = 0.3) -> Ekf2Model:
    """Return the model with flow samples."""
    inputs = model().inputs
    segments = tuple(add_flow_samples(one, flow_of(noise_m_s), 3.0) for one in inputs.segments)
    return replace(model(), inputs=replace(inputs, segments=segments))


def test_mean_flow_is_recovered_from_low_pass_filtered_log(tmp_path):
    log = gnss_log("v1.16")
    log["estimator_states"]["states"][:, :4] = [1.0, 0.0, 0.0, 0.0]
    at = stamps(20.0, 50.0)
    raw = np.random.default_rng(3).normal(0.0, 1.0, (len(at), 2))
    # irregular logging intervals, with one of 50 samples
    rows = np.cumsum([*[10, 10, 9, 11] * 6, 50, *[10, 10, 9, 11] * 12])
    log.add(topic("estimator_optical_flow_vel", at[rows], {
        "vel_body": raw[rows], "vel_body_filtered": low_pass_weights(raw)[rows],
        "flow_rate_compensated": raw[rows][:, ::-1] * [1.0, -1.0] / 6.0,
    }))  # fmt: skip
    log.add(topic("vehicle_optical_flow", at[::25], {
        "integration_timespan_us": np.full(len(at[::25]), 20_000, np.uint32),
    }))  # fmt: skip
    log.add(topic("estimator_aid_src_optical_flow", at[::25], {
        "observation_variance": np.full((len(at[::25]), 2), 0.04),
    }))  # fmt: skip
    flags = log["estimator_status_flags"]
    off_us = at[rows[30]]  # µs; EKF2 disables flow then, shown by the flags of the next second
    flags["cs_opt_flow"] = flags["timestamp"] < off_us
    ekf2 = read_log(log.write(tmp_path / "a.ulg")).ekf2
    flow = ekf2.record.flow
    end_s = seconds_of(flags["timestamp"][flags["timestamp"] >= off_us])[0]
    fused = np.flatnonzero(seconds_of(at[rows]) < end_s)[1:]
    fused = fused[fused != 24]
    assert len(fused) > 25
    assert flow["samples"].tolist() == np.diff(rows)[fused - 1].tolist()
    assert flow["interval_s"].unique() == pytest.approx([INTERVAL_S])
    np.testing.assert_allclose(flow["noise_m2_s2"], 0.04 * 6.0**2, rtol=1e-4)
    for end, count, forward, right in zip(
        rows[fused], flow["samples"].astype(int), flow["forward_m_s"], flow["right_m_s"],
        strict=True,
    ):  # fmt: skip
        weight = (1.0 - SHARE) ** np.arange(count)
        mean = weight @ raw[end - np.arange(count)] / weight.sum()
        assert [forward, right] == pytest.approx(mean.tolist(), abs=1e-4)


@pytest.mark.parametrize("every", [1, 10])
def test_mean_flow_velocity_of_each_update_equals_true_velocity(every):
    """The motion since a sample is known from the IMU, so corners cause no innovations."""
    (segment,) = model().inputs.segments
    with_flow = add_flow_samples(segment, flow_of(every=every), 3.0)
    end = intervals_of(model()).events.end_step
    found = average_by_event(segment, with_flow.flow, end)
    has_sample = found.sample_count > 0.0
    assert found.sample_count.sum() == pytest.approx(len(flow_of(every=every)) * every, abs=12.0)
    speed = true_velocity(segment.time_s[end[has_sample]])
    expected = np.einsum("kab,kb->ka", found.ned_to_body_rotation[has_sample], speed)
    off = found.value[has_sample] - expected
    assert np.sqrt(np.mean(off**2)) < 0.03
    assert np.ptp(expected, axis=0).min() > 0.7


def test_fused_optical_flow_mean_is_weighted_by_sample_count():
    turn = np.eye(3)[None, :2]
    x, P = np.zeros((1, 15)), np.diag(np.full(15, 1e-9))[None].copy()
    P[0, 3:5, 3:5] = 0.25 * np.eye(2)
    samples = EventSamples(np.array([[1.0, -0.5]]), turn, np.array([10.0]), np.array([0.8]))
    gate = np.array([3.0])
    after, left, _ = fuse_mean_sample(x, P, samples, gate, VELOCITY)
    # 1/P = 1/P₀ + n/R
    assert left[0, 3, 3] == pytest.approx(1.0 / (1.0 / 0.25 + 10.0 / 0.8), rel=1e-6)
    assert after[0, 3:5] == pytest.approx(np.array([1.0, -0.5]) * left[0, 3, 3] * 10.0 / 0.8)
    far = samples._replace(value=np.array([[3.1, 0.0]]))  # 3 σ of one sample are 3.07
    np.testing.assert_array_equal(fuse_mean_sample(x, P, far, gate, VELOCITY)[0], x)
    assert fuse_mean_sample(x, P, far, np.array([3.1]), VELOCITY)[0][0, 3] > 1.0
    none = samples._replace(
        sample_count=np.zeros(1), noise=np.zeros(1), ned_to_body_rotation=np.zeros((1, 2, 3))
    )
    np.testing.assert_array_equal(fuse_mean_sample(x, P, none, gate, VELOCITY)[0], x)


def test_ekf2_replay_without_gnss_drifts_less_with_optical_flow():
    """Over one minute the drift is about 1 m with flow, above 10 m with the IMU only."""
    lost = dict.fromkeys(("gnss_pos", "gnss_vel"), 40.0)
    off = []
    for carried in (flying(), model()):
        (replay,) = replay_with_settings(carried, [{}], disable_time_s_by_aid=lost)
        difference = (
            replay.delayed_state[["north_m", "east_m"]]
            - model().baseline_replay.delayed_state[["north_m", "east_m"]]
        )
        off.append(float(np.hypot(*difference.loc[100.0:101.0].to_numpy().T).max()))
    assert off[0] < 1.5
    assert off[1] > 10.0
    (alone,) = replay_with_settings(flying(), [{}], disable_time_s_by_aid={"optical_flow": 0.0})
    (flown,) = replay_with_settings(model(), [{}])
    pd.testing.assert_frame_equal(alone.delayed_state, flown.delayed_state)


def stretches_s(flight: Flight) -> list[tuple[float, float]]:
    segments = opened(flight).inputs.segments
    return [(float(one.time_s[0]), float(one.time_s[-1])) for one in segments]


def test_ekf2_replay_restarts_after_height_reset_or_clipping():
    flight = model().flight
    ((start, end),) = stretches_s(flight)
    for delta, parted in (((0.0, 0.0, 1.0), True), ((1.0, 0.0, 0.0), False)):
        reset = Reset(60.0, "velocity", delta)
        found = stretches_s(replace(flight, ekf2=replace(flight.ekf2, resets=(reset,))))
        assert len(found) == 1 + parted
        if parted:
            assert found[0] == (start, pytest.approx(59.5, abs=0.02))
            assert 60.0 <= found[1][0] <= 61.5
            assert found[1][1] == end
    count = round(0.05 / float(np.median(np.diff(flight.imu.index))))
    for clips, parted in ((count + 2, True), (count - 2, False)):
        clipped = pd.Series(0, flight.imu.index)
        at = int(np.searchsorted(flight.imu.index, 60.0))
        clipped.iloc[at : at + clips] = 0b111
        found = stretches_s(replace(flight, imu=flight.imu.assign(clipped=clipped)))
        assert len(found) == 1 + parted
        if parted:
            assert found[0][1] == pytest.approx(59.5, abs=0.02)
            assert found[1][0] > 60.5


def test_read_gnss_omits_fixes_while_fusion_is_disabled():
    flight = model().flight
    ekf2 = flight.ekf2
    enabled = pd.Series([1.0, 0.0, 1.0], index=[0.0, 50.0, 60.0])
    aids = {**ekf2.aids, "gnss_pos": replace(ekf2.aids["gnss_pos"], enabled=enabled)}
    found = read_gnss(
        flight, replace_vision_by_gnss_innovations(replace(ekf2, aids=aids)), ekf2.record
    )
    aids["gnss_pos"] = replace(ekf2.aids["gnss_pos"], enabled=None)
    every = read_gnss(
        flight, replace_vision_by_gnss_innovations(replace(ekf2, aids=aids)), ekf2.record
    )
    delay_s = ekf2.record.parameters["EKF2_GPS_DELAY"] * 1e-3
    measured_s = every.timestamp_s - delay_s  # type: ignore[union-attr]
    remaining = (measured_s < 50.0) | (measured_s >= 60.0)
    assert 0 < np.sum(~remaining) < len(remaining)
    np.testing.assert_array_equal(found.timestamp_s, every.timestamp_s[remaining])  # type: ignore[union-attr]


def test_ekf2_replay_initial_correlation_uses_preceding_imu_data():
    """Six seconds at rest and the climb correlate tilt and accelerometer bias."""
    (segment,) = model().inputs.segments
    assert segment.preceding_segment is not None
    assert segment.preceding_segment.time_s[-1] == pytest.approx(segment.time_s[0], abs=1e-6)
    assert segment.preceding_segment.time_s[0] < 1.0
    of_tilt = segment.initial_state_correlation[:2, 12:15] @ segment.body_to_ned[0].T
    # θ × f = Rb with f = -g: the north bias couples with the east tilt, and vice versa
    np.testing.assert_allclose(of_tilt[:, :2], [[0.0, 0.98], [-0.98, 0.0]], atol=0.02)


# ------------------------------------------------------------------ flights of PX4's EKF2


@pytest.mark.reallogs
@pytest.mark.parametrize("name", ["v1.16.1_gps_stock_flow", "main202603_gps_outage_flow"])
def test_ekf2_replay_of_optical_flow_flights_agrees_with_log(name, shared_logs, model_of):
    found = model_of(shared_logs / "gps" / f"{name}.ulg")
    agreement = found.agreement
    assert agreement.good
    assert all(axis.innovation_correlation > 0.997 for axis in agreement.gnss_vel.values())
    for axis in agreement.gnss_pos.values():
        assert axis.innovation_correlation > 0.999
        assert 0.99 < axis.s_ratio_p5 < axis.s_ratio_p95 < 1.01
        assert axis.position_rms_difference_m < 0.03
    if "outage" in name:
        assert agreement.carried_difference_m < 0.5
        assert agreement.doubtful == {}
        ((lost_s, back_s),) = found.baseline_replay.optical_flow_only_spans_s
        assert lost_s == pytest.approx(42.1, abs=0.2)  # 35.2 s after take-off
        assert back_s == pytest.approx(72.6, abs=1.0)
    else:
        assert agreement.carried_difference_m is None
        notes = " ".join(
            what_if(
                found, [{}], disable_time_s_by_aid=dict.fromkeys(("gnss_pos", "gnss_vel"), 60.0)
            ).notes
        )  # type: ignore[union-attr]
        assert "Without gnss_pos from 60 s on" in notes
        assert "EKF2_NOAID_TOUT" not in notes


@pytest.mark.reallogs
def test_ekf2_replay_restarts_if_optical_flow_drift_is_too_large(shared_logs, monkeypatch):
    monkeypatch.setattr("px4fuse.ekf2.replay.MAX_FLOW_ONLY_DIFFERENCE_M", 0.3)
    found = opened(read_log(shared_logs / "gps" / "main202603_gps_outage_flow.ulg"))
    assert set(found.agreement.doubtful) == {"optical_flow"}
    assert 0.3 < found.agreement.carried_difference_m < 0.5
    before, after = found.inputs.segments
    assert before.time_s[-1] == pytest.approx(42.1, abs=0.2)
    assert after.time_s[0] == pytest.approx(74.0, abs=1.0)


@pytest.mark.reallogs
def test_ekf2_replay_of_crash_flight_agrees_with_log_until_crash(shared_logs):
    """Vertical velocity was reset at 47 s; the IMU clipped strongly at 26 and 46 s."""
    found = opened(read_log(shared_logs / "real" / "PX4_flight-review-rs_ekf_failure.ulg"))
    ends = [(one.time_s[0], one.time_s[-1]) for one in found.inputs.segments]
    assert np.array(ends) == pytest.approx(np.array([(6.7, 24.7), (30.7, 44.2), (49.7, 67.2)]),
                                           abs=0.1)  # fmt: skip
    agreement = found.agreement
    for axis in (*agreement.gnss_pos.values(), *agreement.gnss_hgt.values(),
                 *agreement.baro_hgt.values()):  # fmt: skip
        assert axis.innovation_correlation > 0.97
        assert 0.99 < axis.s_ratio_p5 < axis.s_ratio_p95 < 1.01
    assert agreement.doubtful == {}
