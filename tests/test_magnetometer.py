"""The magnetometer in the model of EKF2: against the field that was made, and in what is read."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from findings_tools import made
from scipy.spatial.transform import Rotation
from ulog_tools import Log, gnss_log, seconds_of, stamps, topic

from px4fuse.ekf2.magnetometer import EventSamples, fuse_field, mean_by_event
from px4fuse.ekf2.stretches import SensorSamples, Stretch, _field_span, _mean_field
from px4fuse.flight import Columns, FusionRecord
from px4fuse.readers import read_log

EARTH = np.array([0.21, 0.015, 0.43])


def told(rotation: Rotation, body: np.ndarray, size: int = 1) -> EventSamples:
    """What the magnetometer of a body that stands so measures."""
    turn = rotation.inv().as_matrix()
    value = np.tile(turn @ EARTH + body, (size, 1))
    return EventSamples(value, np.tile(turn, (size, 1, 1)), np.ones(size), np.zeros(size))


def knowing(size: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """State and covariance of filters that know the earth's field and the tilt."""
    x = np.zeros((size, 21))
    x[:, 15:18] = EARTH
    deviation = np.full(21, 1e-6)
    deviation[2] = 0.1
    return x, np.tile(np.diag(deviation**2), (size, 1, 1))


def test_a_heading_error_is_put_right_and_its_variance_is_the_kalman_filters() -> None:
    """The body is turned by 0.05 rad about the vertical beyond what the filter takes it to be."""
    body = np.zeros(3)
    nominal = Rotation.from_euler("ZYX", [0.7, 0.1, -0.05])
    true = Rotation.from_rotvec([0.0, 0.0, 0.05]) * nominal
    seen = told(nominal, body)._replace(value=told(true, body).value)
    x, P = knowing()
    for _ in range(400):
        x, P, told_of = fuse_field(x, P, seen, np.array([0.02]), np.array([3.0]))
    # what is left between measured and expected, and its variance: HPH' + R
    np.testing.assert_allclose(told_of[0, 0], 0.0, atol=5e-4)
    np.testing.assert_allclose(told_of[1, 0], 0.02**2, rtol=0.01)
    assert told_of[2].all()
    assert x[0, 2] == pytest.approx(0.05, abs=0.002)
    # 1/P = 1/P₀ + n·|horizontal field|²/R
    information = 0.1**-2 + 400 * np.hypot(*EARTH[:2]) ** 2 / 0.02**2
    assert P[0, 2, 2] == pytest.approx(1.0 / information, rel=0.01)
    assert np.linalg.eigvalsh(P[0]).min() > -1e-15


def test_the_fields_of_earth_and_body_are_told_apart_where_the_vehicle_turns() -> None:
    body = np.array([0.05, -0.03, 0.02])
    x, P = knowing()
    deviation = np.full(21, 1e-6)
    deviation[15:] = 0.1
    P[0] = np.diag(deviation**2)
    x[0, 15:18] += [0.03, -0.02, 0.01]
    for heading in np.linspace(0.0, 6.0, 200):
        seen = told(Rotation.from_euler("ZYX", [heading, 0.3 * np.sin(heading), 0.0]), body)
        x, P, _ = fuse_field(x, P, seen, np.array([0.01]), np.array([100.0]))
    np.testing.assert_allclose(x[0, 18:], body, atol=1e-3)
    np.testing.assert_allclose(x[0, 15:18], EARTH, atol=1e-3)


def test_one_sample_that_stands_for_several_counts_as_often() -> None:
    seen = told(Rotation.from_euler("z", 0.4), np.zeros(3))
    noise, gate = np.array([0.05]), np.array([3.0])
    x, P = knowing()
    once = fuse_field(x, P, seen._replace(number=np.full(1, 5.0)), noise, gate)
    for _ in range(5):
        x, P, _ = fuse_field(x, P, seen, noise, gate)
    np.testing.assert_allclose(once[0], x, atol=1e-9)
    np.testing.assert_allclose(once[1], P, atol=1e-9)


def test_each_variant_has_its_own_noise_and_gate_and_takes_what_it_was_sent() -> None:
    x, P = knowing(4)
    seen = told(Rotation.identity(), np.array([0.3, 0.0, 0.0]), size=4)
    seen = seen._replace(number=np.array([1.0, 1.0, 0.0, 1.0]))
    noise, gate = np.array([0.05, 0.2, 0.2, 0.0]), np.array([3.0, 3.0, 3.0, 100.0])
    after, left, told_of = fuse_field(x, P, seen, noise, gate)
    # 0.3 gauss off: 6 standard deviations of the first; the third was sent nothing
    moved = np.abs(after - x).max(axis=1) > 0.0
    assert moved.tolist() == [False, True, False, True]
    np.testing.assert_array_equal(left[0], P[0])
    assert told_of[2, [0, 1, 3], 0].tolist() == [0.0, 1.0, 1.0]
    np.testing.assert_allclose(told_of[0, [0, 1, 3], 0], 0.3)
    assert np.isnan(told_of[:, 2]).all()
    # 0.01 gauss of noise at least, as mag_control.cpp has it
    least, *_ = fuse_field(x[:1], P[:1], EventSamples(*(each[:1] for each in seen)),
                           np.array([0.01]), np.array([100.0]))  # fmt: skip
    np.testing.assert_allclose(after[3], least[0])


def test_samples_are_fused_at_the_first_event_after_them() -> None:
    rotation = Rotation.from_rotvec(0.1 * np.eye(3)[2] * np.arange(10)[:, None]).as_matrix()
    gauss = np.arange(12.0).reshape(4, 3)
    step = np.array([2, 3, 6, 9])
    turn = rotation[step].transpose(0, 2, 1)
    sensed = SensorSamples(step, gauss, turn, np.full(4, 2.0), np.array([0.1, 0.3, 0.2, 0.4]))
    found = mean_by_event(sensed, np.array([1, 3, 6, 6, 8]))
    np.testing.assert_allclose(found.noise, [0.0, 0.2, 0.2, 0.0, 0.0])
    assert found.number.tolist() == [0.0, 4.0, 2.0, 0.0, 0.0]
    np.testing.assert_allclose(found.value[1], gauss[:2].mean(axis=0))
    np.testing.assert_allclose(found.turn[1], rotation[2:4].mean(axis=0).T)
    np.testing.assert_allclose(found.turn[2], rotation[6].T)


# ---------------------------------------------------------------- reading


def magnetic(generation: str = "v1.16", kept_hz: float = 2.0) -> Log:
    """A log with a magnetometer at 5 Hz, whose samples EKF2 has kept at another rate."""
    log = gnss_log(generation)
    log["estimator_states"]["states"][:, :4] = [1.0, 0.0, 0.0, 0.0]
    at, kept = stamps(20.0, 5.0), stamps(20.0, kept_hz)
    log.add(topic("vehicle_magnetometer", at, {"magnetometer_ga": np.tile(EARTH, (len(at), 1))}))
    own = {"observation": np.tile(2.0 * EARTH, (len(kept), 1))}
    log.add(topic("estimator_aid_src_mag", kept, own))
    flags = np.where(at < at[40], 1 << 4, 1 << 5).astype(np.uint64)
    log.drop(*({"estimator_status"} & log.names()))
    log.add(topic("estimator_status", at, {"control_mode_flags": flags}))
    log.parameters |= {"EKF2_MAG_DELAY": 20.0}
    return log


def field_of(log: Log, folder: Path) -> pd.DataFrame:
    return read_log(log.write(folder / "a.ulg")).ekf2.record.field_gauss


@pytest.mark.parametrize("generation", ["v1.14", "v1.16"])
def test_the_field_is_read_with_when_ekf2_fused_all_of_it(generation: str, tmp_path: Path) -> None:
    field = field_of(magnetic(generation), tmp_path)
    np.testing.assert_allclose(field.iloc[:, :3], np.tile(EARTH, (len(field), 1)), rtol=1e-6)
    assert field["fused_3d"].tolist() == [0.0] * 40 + [1.0] * (len(field) - 40)


def test_what_ekf2_kept_is_taken_where_that_is_more(tmp_path: Path) -> None:
    """By the time of the sensor, from which EKF2 takes its delay and half a step."""
    log = magnetic(kept_hz=20.0)
    field = field_of(log, tmp_path)
    np.testing.assert_allclose(field.iloc[:, :3], np.tile(2.0 * EARTH, (len(field), 1)), rtol=1e-6)
    stamped_s = seconds_of(log["estimator_aid_src_mag"]["timestamp"])[0]
    assert field.index[0] - stamped_s == pytest.approx(0.02 + 0.5 * 0.01, abs=1e-6)


def test_samples_between_two_rows_are_told_by_the_low_pass_of_innovations(tmp_path: Path) -> None:
    """Those that EKF2 kept at a low rate are taken all the same, unless the sensor has them all."""
    log = magnetic()
    kept = log["estimator_aid_src_mag"]
    kept["innovation_filtered"] = np.linspace(0.0, 0.01, kept["timestamp"].size)[:, None] + EARTH
    field = field_of(log, tmp_path)
    assert len(field) == kept["timestamp"].size
    np.testing.assert_allclose(field.iloc[:, :3], np.tile(2.0 * EARTH, (len(field), 1)), rtol=1e-6)
    np.testing.assert_allclose(field[Columns.FIELD_INNOVATION], kept["innovation_filtered"], 1e-6)
    at = stamps(20.0, 12.0)
    log.drop("vehicle_magnetometer")
    log.add(topic("vehicle_magnetometer", at, {"magnetometer_ga": np.tile(EARTH, (len(at), 1))}))
    field = field_of(log, tmp_path)
    assert len(field) == len(at)
    assert list(field) == ["forward_gauss", "right_gauss", "down_gauss", "fused_3d"]


def test_a_mean_of_samples_is_what_was_expected_less_the_mean_innovation() -> None:
    """The vehicle turns, EKF2's attitude is off the published one, and the sensor is noisy."""
    count, every, rows = 12, 7, 30
    interval_s, dt = 0.5 / every, 0.008
    time_s = 100.0 + dt * np.arange(round(rows * 0.5 / dt) + 200)
    heading = 0.8 * np.sin(0.9 * time_s)
    rotation = Rotation.from_euler("ZY", np.column_stack([heading, 0.2 * heading]))
    error = np.tile([0.002, -0.003, 0.01], (len(time_s), 1))
    body = np.array([0.02, -0.01, 0.03])
    rng = np.random.default_rng(7)
    taken_s = time_s[0] + 0.2 + interval_s * np.arange(rows * every)
    step = np.searchsorted(time_s, taken_s - 1e-9)
    measured = rng.normal(0.0, 0.3, (len(taken_s), 3))
    own = Rotation.from_rotvec(error[step]) * rotation[step]
    innovation = own.inv().apply(EARTH) + body - measured
    share = interval_s / (interval_s + 0.5)
    filtered = innovation.copy()
    for k in range(1, len(taken_s)):
        filtered[k] = filtered[k - 1] + share * (innovation[k] - filtered[k - 1])
    kept = np.r_[np.arange(every - 1, len(taken_s), every)]
    kept = np.delete(kept, [count, *range(20, 26)])  # the logger missed one, then three seconds
    fields = [*Columns.EARTH_FIELD, *Columns.BODY_FIELD]
    delayed = pd.DataFrame(dict(zip(fields, [*EARTH, *body], strict=True)), [99.0, 200.0])
    matrices = rotation.as_matrix()
    stretch = made(Stretch, time_s=time_s, rotation=matrices, attitude_error_rad=error)
    found = _mean_field(stretch, delayed, taken_s[kept], filtered[kept])
    near = np.flatnonzero(np.diff(kept) < 20) + 1
    assert found.samples.tolist() == np.diff(kept)[near - 1].tolist()
    assert sorted(set(found.samples)) == [7.0, 14.0]
    assert found.step.tolist() == step[kept[near]].tolist()
    for row, samples, value, turn in zip(
        kept[near], found.samples.astype(int), found.value, found.turn, strict=True
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
    return _field_span(made(FusionRecord, field_gauss=frame))


def test_the_magnetometer_is_replayed_where_all_of_it_was_fused_without_a_break() -> None:
    assert settled(2.0, slice(20, 50)) == (11.0, 24.5)
    assert settled(1.4, slice(20, 50)) is None
    assert settled(2.0, slice(0, 0)) is None
    assert settled(2.0, slice(20, 50, 2)) is None
