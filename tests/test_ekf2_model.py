"""EKF2 model against its equations in plain form, and against the log."""

import tracemalloc
from typing import Any

import numpy as np
import pandas as pd
import pytest
from conftest import LOG
from ekf2_tools import intervals_of, opened, plain_replay, step_matrix, step_noise, step_state
from exchange import replace

from px4fuse.ekf2.filter_batch import FilterConfiguration
from px4fuse.ekf2.model import (
    Ekf2Model,
    compute_delayed_states,
    prepare_ekf2_model,
    replay_with_settings,
    run_configurations,
)
from px4fuse.ekf2.replay import HORIZONTAL_AXES
from px4fuse.flight.model import AS_RECEIVED_ORIGIN, Flight, Unavailable
from px4fuse.readers import read_log


def with_record(flight: Flight, **changes: object) -> Flight:
    ekf2, record = flight.ekf2, flight.ekf2.record
    return replace(flight, ekf2=replace(ekf2, record=replace(record, **changes)))


def with_vision(flight: Flight, samples: pd.DataFrame, **changes: object) -> Flight:
    tracks = [t for t in flight.positions if t.name != "vehicle_visual_odometry"]
    own = next(t for t in flight.positions if t.name == "vehicle_visual_odometry")
    return replace(flight, positions=(replace(own, samples=samples, **changes), *tracks))


def vision_of(flight: Flight) -> pd.DataFrame:
    return next(t for t in flight.positions if t.name == "vehicle_visual_odometry").samples


def test_ekf2_model_transition_equals_product_of_step_matrices(model: Ekf2Model) -> None:
    segment, intervals = model.inputs.segments[0], intervals_of(model)
    transition, correction, acceleration, gyro_noise, acceleration_noise = (
        intervals.compute_transitions(slice(None))
    )
    end = intervals.events.end_step
    starts = np.concatenate([[0], end[:-1]])
    gyro, force = (model.inputs.settings[f"EKF2_{name}_NOISE"] for name in ("GYR", "ACC"))
    noise = gyro**2 * gyro_noise + force**2 * acceleration_noise
    for at in (0, 1, 57, 300, len(end) - 1):
        F, Q = np.eye(15), np.zeros((15, 15))
        x = x0 = np.random.default_rng(at).normal(0.0, 0.01, 15)
        for k in range(starts[at], end[at]):
            F = step_matrix(segment, k) @ F
            old = step_matrix(segment, k, trapezoid=False)
            Q = old @ Q @ old.T + step_noise(segment, k, gyro, force)
            x = step_state(segment, k, x)
        assert transition[at] == pytest.approx(F[:9], abs=1e-12)
        np.testing.assert_array_equal(F[9:], np.eye(15)[9:])
        moved = transition[at] @ x0 + correction[at] + acceleration[at]
        assert moved == pytest.approx(x[:9], abs=1e-12)
        # closed forms assume equal steps and a mean force; the real ones vary
        Q = Q[:9, :9]
        scale = np.sqrt(np.outer(np.diag(Q), np.diag(Q)))
        assert np.max(np.abs(noise[at] - Q) / scale) < 0.03


@pytest.mark.parametrize("attitude", [True, False])
def test_ekf2_model_state_between_updates_is_imu_prediction(
    model: Ekf2Model, attitude: bool
) -> None:
    """Without attitude as a state, the nominal attitude is not corrected."""
    configuration = FilterConfiguration(model.inputs.settings, estimates_attitude=attitude)
    (part,) = run_configurations(model.inputs, [configuration])
    kept = np.random.default_rng(4).normal(0.0, 0.05, part.state.shape)
    state = compute_delayed_states(replace(part, state=kept), 0)
    segment, ends = part.segment, part.events[0].end_step
    if not attitude:
        segment = replace(
            segment, attitude_correction_rad=np.zeros_like(segment.attitude_correction_rad)
        )
    np.testing.assert_array_equal(state[ends], kept[1:, 0])
    for at in (0, 1, 57, 300, len(ends)):  # after the last event follows one more interval
        x = kept[at, 0]
        first, last = np.concatenate([[0], ends, [len(segment.step_s)]])[[at, at + 1]]
        for k in range(first, last - 1):
            x = step_state(segment, k, x)
            np.testing.assert_allclose(state[k + 1], x, rtol=0.0, atol=1e-10)


def test_ekf2_model_innovations_equal_reference_filter(model: Ekf2Model) -> None:
    events = intervals_of(model).events
    nu, S = plain_replay(model.inputs, model.inputs.segments[0], events[events.end_step < 3000])
    updates = model.baseline_replay.updates.iloc[: len(nu)]
    assert len(nu) > 100
    for at, axis in enumerate(HORIZONTAL_AXES):
        np.testing.assert_allclose(updates[f"innovation_{axis}_m"], nu[:, at], rtol=0, atol=5e-4)
        np.testing.assert_allclose(updates[f"innovation_variance_{axis}_m2"], S[:, at], rtol=3e-3)


def test_ekf2_replay_of_sample_flight_agrees_with_log(model: Ekf2Model) -> None:
    agreement = model.agreement
    assert agreement.good
    assert agreement.samples > 200
    assert agreement.rejected_fraction_logged == agreement.rejected_fraction_replayed == 0.0
    for axis in agreement.ev_pos.values():
        assert axis.innovation_correlation > 0.999
        assert axis.innovation_rms_difference < 0.005
        assert axis.s_ratio_median == pytest.approx(1.0, abs=0.005)
        assert axis.s_ratio_p5 > 0.98
        assert axis.s_ratio_p95 < 1.02
        assert axis.position_rms_difference_m < 0.007
        assert axis.velocity_rms_difference_m_s < 0.010
        assert axis.nis_mean_replayed == pytest.approx(axis.nis_mean_logged, rel=0.02)


@pytest.mark.slow
def test_ekf2_replay_memory_does_not_grow_with_parameter_sets(
    model: Ekf2Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("px4fuse.ekf2.model.CONFIGURATIONS_PER_BATCH", 2)

    def peak(count: int) -> int:
        tracemalloc.start()
        for _ in replay_with_settings(model, [{"EKF2_EV_DELAY": 20.0 + at} for at in range(count)]):
            pass
        found = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return found

    assert peak(6) < 1.15 * peak(2)


def test_ekf2_replay_of_several_settings_equals_separate_runs(model: Ekf2Model) -> None:
    settings = [
        {"EKF2_EVP_NOISE": 0.02}, {"EKF2_EV_DELAY": 80.0},
        {"EKF2_EVP_NOISE": 0.3, "EKF2_EV_DELAY": 40.0, "EKF2_EVP_GATE": 2.0}, {},
    ]  # fmt: skip
    together = list(replay_with_settings(model, settings))
    for change, found in zip(settings, together, strict=True):
        (alone,) = replay_with_settings(model, [change])
        for part in ("updates", "delayed_state", "published_state"):
            joint, separate = getattr(found, part), getattr(alone, part)
            pd.testing.assert_frame_equal(joint, separate, rtol=0.0, atol=1e-9)
        assert dict(found.changed_parameters) == change
    pd.testing.assert_frame_equal(
        together[3].published_state, model.baseline_replay.published_state, rtol=0.0, atol=1e-9
    )


def test_ekf2_replay_counts_late_and_lost_vision_samples(model: Ekf2Model) -> None:
    vision = model.inputs.received_positions
    assert (model.baseline_replay.late, model.baseline_replay.lost) == (0, 0)
    # the horizon is 214 ms, and samples may be 100 ms later

    def arriving(after_s: float, **settings: float) -> Any:
        slow = replace(vision, arrival_s=vision.timestamp_s + after_s)
        made = replace(model, inputs=replace(model.inputs, received_positions=slow))
        return next(replay_with_settings(made, [{"EKF2_EV_DELAY": 1.0, **settings}]))

    in_time, late, lost = (arriving(after_s) for after_s in (0.20, 0.28, 0.36))
    assert (in_time.late, in_time.lost) == (0, 0)
    assert late.late > 0.95 * len(late.updates)
    assert late.lost == 0
    assert lost.lost > 500
    assert lost.updates["fused"].sum() < 10
    more = arriving(0.36, EKF2_DELAY_MAX=400.0)
    assert (more.late, more.lost) == (0, 0)
    # EKF2 raises EKF2_DELAY_MAX to its largest delay
    longest = arriving(0.02, EKF2_EV_DELAY=300.0)
    assert (longest.late, longest.lost) == (0, 0)


def with_copies(flight: Flight) -> Flight:
    """Return the flight with EKF2's copies of the positions only."""
    copies = tuple(track for track in flight.positions if track.origin != AS_RECEIVED_ORIGIN)
    return replace(flight, positions=copies)


def unavailable(flight: Flight) -> str:
    found = prepare_ekf2_model(flight)
    assert isinstance(found, Unavailable)
    assert found.remedy.endswith(".")
    return found.reason


def test_ekf2_model_without_required_topic_gives_reason(sample_flight: Flight) -> None:
    ekf2 = sample_flight.ekf2
    missing = Unavailable("IMU", "no topic sensor_combined", "Record it.")
    assert "sensor_combined" in unavailable(replace(sample_flight, imu=missing))
    assert "GPS" in unavailable(with_record(sample_flight, other_horizontal_aids=("GPS",)))
    bare = replace(ekf2, record=Unavailable("record", "no estimator_states", "Record it."))
    assert "estimator_states" in unavailable(replace(sample_flight, ekf2=bare))
    slow = sample_flight.imu.iloc[::5]
    assert "53 Hz" in unavailable(replace(sample_flight, imu=slow))
    copies = unavailable(with_copies(sample_flight))
    assert "estimator_aid_src_ev_pos is logged every 0.5" in copies
    dropped = sample_flight.imu[(sample_flight.imu.index % 8.0) > 0.1]
    assert "without a gap" in unavailable(replace(sample_flight, imu=dropped))
    frame = with_vision(sample_flight, vision_of(sample_flight), frame="FRD")
    assert "without an orientation" in unavailable(frame)
    no_horizon = replace(ekf2, horizon_s=Unavailable("horizon", "not logged", "Update PX4."))
    assert "not logged" in unavailable(replace(sample_flight, ekf2=no_horizon))


def test_ekf2_replay_of_mavlink_recording_is_unavailable() -> None:
    assert "estimator_states" in unavailable(read_log(LOG.with_suffix(".tlog")))


def test_ekf2_model_fuses_vision_height_if_enabled(model: Ekf2Model, sample_flight: Flight) -> None:
    ekf2 = sample_flight.ekf2
    samples = vision_of(sample_flight).copy()
    samples["down_m"] += 0.7
    fused = replace(
        sample_flight, ekf2=replace(ekf2, fusion_flags=ekf2.fusion_flags.assign(vertical=1.0))
    )
    low = (
        opened(with_vision(fused, samples)).baseline_replay.delayed_state["down_m"].loc[40.0:100.0]
    )
    own = model.baseline_replay.delayed_state["down_m"].loc[40.0:100.0]
    vision = samples["down_m"].loc[40.0:100.0]
    assert low.mean() == pytest.approx(vision.mean(), abs=0.03)
    assert abs(own.mean() - vision.mean()) > 0.4


def test_ekf2_replay_with_zero_bias_variance_is_finite(sample_flight: Flight) -> None:
    record = sample_flight.ekf2.record
    fixed = record.delayed_state.copy()
    fixed.loc[:, [name for name in fixed if str(name).endswith("m2_s4")]] = 0.0
    parameters = {**record.parameters, "EKF2_ACC_B_NOISE": 0.0}
    made = opened(with_record(sample_flight, delayed_state=fixed, parameters=parameters))
    assert np.isfinite(made.baseline_replay.published_state.to_numpy()).all()
    assert np.isfinite(made.baseline_replay.updates.to_numpy()).all()
