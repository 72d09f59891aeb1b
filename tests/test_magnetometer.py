"""Magnetometer in the EKF2 model: fusion against simulated fields, and reading from logs."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from findings_tools import made
from scipy.spatial.transform import Rotation
from ulog_tools import Log, gnss_log, seconds_of, stamps, topic

from px4fuse.ekf2.magnetometer import EventSamples, average_by_event, fuse_mean_sample
from px4fuse.ekf2.replay_segments import (
    BODY_MAGNETIC_FIELD,
    EARTH_MAGNETIC_FIELD,
    ReplaySegment,
    SensorSamples,
    _compute_mean_magnetic_field,
    _find_magnetometer_3d_fusion_span,
)
from px4fuse.flight.model import Columns, FusionRecord
from px4fuse.readers import read_log

EARTH = np.array([0.21, 0.015, 0.43])


def field_samples(rotation: Rotation, body: np.ndarray, size: int = 1) -> EventSamples:
    """Return the measurement of a magnetometer with this attitude."""
    turn = rotation.inv().as_matrix()
    value = np.tile(turn @ EARTH + body, (size, 1))
    return EventSamples(value, np.tile(turn, (size, 1, 1)), np.ones(size), np.zeros(size))


def fuse_field(
    x: np.ndarray, P: np.ndarray, seen: EventSamples, noise_gauss: np.ndarray, gate: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return fuse_mean_sample(
        x, P, seen._replace(noise=noise_gauss**2), gate, EARTH_MAGNETIC_FIELD, BODY_MAGNETIC_FIELD
    )


def known_field_state(size: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Return state and covariance of filters with a known earth field and tilt."""
    x = np.zeros((size, 21))
    x[:, 15:18] = EARTH
    deviation = np.full(21, 1e-6)
    deviation[2] = 0.1
    return x, np.tile(np.diag(deviation**2), (size, 1, 1))


def test_magnetometer_fusion_corrects_heading_error() -> None:
    """The true heading is 0.05 rad larger than the filter's."""
    body = np.zeros(3)
    nominal = Rotation.from_euler("ZYX", [0.7, 0.1, -0.05])
    true = Rotation.from_rotvec([0.0, 0.0, 0.05]) * nominal
    seen = field_samples(nominal, body)._replace(value=field_samples(true, body).value)
    x, P = known_field_state()
    for _ in range(400):
        x, P, innovation = fuse_field(x, P, seen, np.array([0.02]), np.array([3.0]))
    # remaining innovation, and its variance HPH' + R
    np.testing.assert_allclose(innovation[0, 0], 0.0, atol=5e-4)
    np.testing.assert_allclose(innovation[1, 0], 0.02**2, rtol=0.01)
    assert innovation[2].all()
    assert x[0, 2] == pytest.approx(0.05, abs=0.002)
    # 1/P = 1/P₀ + n·|horizontal field|²/R
    information = 0.1**-2 + 400 * np.hypot(*EARTH[:2]) ** 2 / 0.02**2
    assert P[0, 2, 2] == pytest.approx(1.0 / information, rel=0.01)
    assert np.linalg.eigvalsh(P[0]).min() > -1e-15


def test_magnetometer_bias_is_estimated_on_turning_vehicle() -> None:
    body = np.array([0.05, -0.03, 0.02])
    x, P = known_field_state()
    deviation = np.full(21, 1e-6)
    deviation[15:] = 0.1
    P[0] = np.diag(deviation**2)
    x[0, 15:18] += [0.03, -0.02, 0.01]
    for heading in np.linspace(0.0, 6.0, 200):
        seen = field_samples(
            Rotation.from_euler("ZYX", [heading, 0.3 * np.sin(heading), 0.0]), body
        )
        x, P, _ = fuse_field(x, P, seen, np.array([0.01]), np.array([100.0]))
    np.testing.assert_allclose(x[0, 18:], body, atol=1e-3)
    np.testing.assert_allclose(x[0, 15:18], EARTH, atol=1e-3)


def test_magnetometer_sample_with_weight_5_equals_five_samples() -> None:
    seen = field_samples(Rotation.from_euler("z", 0.4), np.zeros(3))
    noise, gate = np.array([0.05]), np.array([3.0])
    x, P = known_field_state()
    once = fuse_field(x, P, seen._replace(sample_count=np.full(1, 5.0)), noise, gate)
    for _ in range(5):
        x, P, _ = fuse_field(x, P, seen, noise, gate)
    np.testing.assert_allclose(once[0], x, atol=1e-9)
    np.testing.assert_allclose(once[1], P, atol=1e-9)


def test_magnetometer_fusion_uses_noise_and_gate_of_each_run() -> None:
    x, P = known_field_state(4)
    seen = field_samples(Rotation.identity(), np.array([0.3, 0.0, 0.0]), size=4)
    seen = seen._replace(sample_count=np.array([1.0, 1.0, 0.0, 1.0]))
    noise, gate = np.array([0.05, 0.2, 0.2, 0.01]), np.array([3.0, 3.0, 3.0, 100.0])
    after, left, innovation = fuse_field(x, P, seen, noise, gate)
    # 0.3 gauss is 6 σ for the first configuration; the third has no sample
    moved = np.abs(after - x).max(axis=1) > 0.0
    assert moved.tolist() == [False, True, False, True]
    np.testing.assert_array_equal(left[0], P[0])
    assert innovation[2, [0, 1, 3], 0].tolist() == [0.0, 1.0, 1.0]
    np.testing.assert_allclose(innovation[0, [0, 1, 3], 0], 0.3)
    assert np.isnan(innovation[:, 2]).all()


def test_magnetometer_samples_are_averaged_until_next_update() -> None:
    rotation = Rotation.from_rotvec(0.1 * np.eye(3)[2] * np.arange(10)[:, None]).as_matrix()
    gauss = np.arange(12.0).reshape(4, 3)
    step = np.array([2, 3, 6, 9])
    turn = rotation[step].transpose(0, 2, 1)
    sensed = SensorSamples(step, gauss, turn, np.full(4, 2.0), np.array([0.1, 0.3, 0.2, 0.4]))
    found = average_by_event(made(ReplaySegment), sensed, np.array([1, 3, 6, 6, 8]))
    np.testing.assert_allclose(found.noise, [0.0, 0.2, 0.2, 0.0, 0.0])
    assert found.sample_count.tolist() == [0.0, 4.0, 2.0, 0.0, 0.0]
    np.testing.assert_allclose(found.value[1], gauss[:2].mean(axis=0))
    np.testing.assert_allclose(found.ned_to_body_rotation[1], rotation[2:4].mean(axis=0).T)
    np.testing.assert_allclose(found.ned_to_body_rotation[2], rotation[6].T)


# ---------------------------------------------------------------- reading


def magnetic(generation: str = "v1.16", kept_hz: float = 2.0) -> Log:
    """Return a log with a magnetometer at 5 Hz, and EKF2's copy at another rate."""
    log = gnss_log(generation)
    log["estimator_states"]["states"][:, :4] = [1.0, 0.0, 0.0, 0.0]
    at, remaining = stamps(20.0, 5.0), stamps(20.0, kept_hz)
    log.add(topic("vehicle_magnetometer", at, {"magnetometer_ga": np.tile(EARTH, (len(at), 1))}))
    own = {"observation": np.tile(2.0 * EARTH, (len(remaining), 1))}
    log.add(topic("estimator_aid_src_mag", remaining, own))
    flags = np.where(at < at[40], 1 << 4, 1 << 5).astype(np.uint64)
    log.drop(*({"estimator_status"} & log.names()))
    log.add(topic("estimator_status", at, {"control_mode_flags": flags}))
    log.parameters |= {"EKF2_MAG_DELAY": 20.0}
    return log


def field_of(log: Log, folder: Path) -> pd.DataFrame:
    return read_log(log.write(folder / "a.ulg")).ekf2.record.magnetic_field_gauss


@pytest.mark.parametrize("generation", ["v1.14", "v1.16"])
def test_read_magnetometer_contains_3d_fusion_flag(generation: str, tmp_path: Path) -> None:
    field = field_of(magnetic(generation), tmp_path)
    np.testing.assert_allclose(field.iloc[:, :3], np.tile(EARTH, (len(field), 1)), rtol=1e-6)
    assert field["fused_3d"].tolist() == [0.0] * 40 + [1.0] * (len(field) - 40)


def test_read_magnetometer_prefers_topic_with_more_samples(tmp_path: Path) -> None:
    """The measurement time is that of the sensor, minus EKF2's delay and half a step."""
    log = magnetic(kept_hz=20.0)
    field = field_of(log, tmp_path)
    np.testing.assert_allclose(field.iloc[:, :3], np.tile(2.0 * EARTH, (len(field), 1)), rtol=1e-6)
    stamped_s = seconds_of(log["estimator_aid_src_mag"]["timestamp"])[0]
    assert field.index[0] - stamped_s == pytest.approx(0.02 + 0.5 * 0.01, abs=1e-6)


def test_magnetic_field_is_from_ekf2_topic_if_sensor_log_is_slow(tmp_path: Path) -> None:
    """EKF2's copy at a low rate is used, except if the sensor topic contains all samples."""
    log = magnetic()
    remaining = log["estimator_aid_src_mag"]
    remaining["innovation_filtered"] = (
        np.linspace(0.0, 0.01, remaining["timestamp"].size)[:, None] + EARTH
    )
    field = field_of(log, tmp_path)
    assert len(field) == remaining["timestamp"].size
    np.testing.assert_allclose(field.iloc[:, :3], np.tile(2.0 * EARTH, (len(field), 1)), rtol=1e-6)
    np.testing.assert_allclose(
        field[Columns.MAGNETIC_FIELD_INNOVATION], remaining["innovation_filtered"], 1e-6
    )
    at = stamps(20.0, 12.0)
    log.drop("vehicle_magnetometer")
    log.add(topic("vehicle_magnetometer", at, {"magnetometer_ga": np.tile(EARTH, (len(at), 1))}))
    field = field_of(log, tmp_path)
    assert len(field) == len(at)
    assert list(field) == ["forward_gauss", "right_gauss", "down_gauss", "fused_3d"]


def test_magnetic_field_is_recovered_from_filtered_innovations() -> None:
    """The vehicle rotates, EKF2's attitude differs from the published one, the sensor is noisy."""
    count, every, rows = 12, 7, 30
    interval_s, dt = 0.5 / every, 0.008
    time_s = 100.0 + dt * np.arange(round(rows * 0.5 / dt) + 200)
    heading = 0.8 * np.sin(0.9 * time_s)
    rotation = Rotation.from_euler("ZY", np.column_stack([heading, 0.2 * heading]))
    error = np.tile([0.002, -0.003, 0.01], (len(time_s), 1))
    body = np.array([0.02, -0.01, 0.03])
    rng = np.random.default_rng(7)
    measured_at_s = time_s[0] + 0.2 + interval_s * np.arange(rows * every)
    step = np.searchsorted(time_s, measured_at_s - 1e-9)
    measured = rng.normal(0.0, 0.3, (len(measured_at_s), 3))
    own = Rotation.from_rotvec(error[step]) * rotation[step]
    innovation = own.inv().apply(EARTH) + body - measured
    share = interval_s / (interval_s + 0.5)
    filtered = innovation.copy()
    for k in range(1, len(measured_at_s)):
        filtered[k] = filtered[k - 1] + share * (innovation[k] - filtered[k - 1])
    remaining = np.r_[np.arange(every - 1, len(measured_at_s), every)]
    remaining = np.delete(
        remaining, [count, *range(20, 26)]
    )  # the logger missed one row, then three seconds
    fields = [*Columns.EARTH_MAGNETIC_FIELD, *Columns.BODY_MAGNETIC_FIELD]
    delayed_state = pd.DataFrame(dict(zip(fields, [*EARTH, *body], strict=True)), [99.0, 200.0])
    matrices = rotation.as_matrix()
    segment = made(ReplaySegment, time_s=time_s, body_to_ned=matrices, attitude_error_rad=error)
    found = _compute_mean_magnetic_field(
        segment, delayed_state, measured_at_s[remaining], filtered[remaining]
    )
    near = np.flatnonzero(np.diff(remaining) < 20) + 1
    assert found.sample_count.tolist() == np.diff(remaining)[near - 1].tolist()
    assert sorted(set(found.sample_count)) == [7.0, 14.0]
    assert found.step_indices.tolist() == step[remaining[near]].tolist()
    for row, samples, value, turn in zip(
        remaining[near],
        found.sample_count.astype(int),
        found.value,
        found.ned_to_body_rotation,
        strict=True,
    ):
        of = row - np.arange(samples)
        weight = (1.0 - share) ** np.arange(samples)
        weight /= weight.sum()
        np.testing.assert_allclose(value, weight @ measured[of], atol=1e-4)
        expected = np.einsum("k,kab->ba", weight, rotation[step[of]].as_matrix())
        np.testing.assert_allclose(turn, expected, atol=1e-9)


def settled(frame_hz: float, on: slice, count: int = 60) -> tuple[float, float] | None:
    fused = np.zeros(count)
    fused[on] = 1.0
    frame = pd.DataFrame({"fused_3d": fused}, index=np.arange(count) / frame_hz)
    return _find_magnetometer_3d_fusion_span(made(FusionRecord, magnetic_field_gauss=frame))


def test_magnetometer_replay_requires_continuous_3d_fusion() -> None:
    assert settled(2.0, slice(20, 50)) == (11.0, 24.5)
    assert settled(1.4, slice(20, 50)) == (np.inf, np.inf)
    assert settled(2.0, slice(0, 0)) == (np.inf, np.inf)
    assert settled(2.0, slice(20, 50, 2)) == (np.inf, np.inf)
