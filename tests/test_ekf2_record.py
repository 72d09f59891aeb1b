"""Internal state of EKF2, read from each release into one layout and unit."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from ulog_tools import GENERATIONS, covariances, make_log, stamps, topic

from px4fuse.flight.model import Columns, Unavailable
from px4fuse.readers import read_log

QUATERNION = Rotation.from_euler("ZYX", [40.0, 10.0, -5.0], degrees=True).as_quat(scalar_first=True)
BIAS = np.array([0.15, -0.10, 0.08])
STATES = [*QUATERNION, 0.5, -0.2, 0.1, 3.0, 4.0, -1.5, 1e-4, 2e-4, 3e-4, 1e-3, 2e-3, 3e-3,
          0.21, 0.01, 0.43, 0.02, -0.03, 0.04]  # fmt: skip


def made_log(generation, position=True):
    log = make_log(generation)
    states = log["estimator_states"]["states"]
    states[:, :22] = STATES
    if not position:
        states[:, 7:9] = 0.0
    log.parameters |= {"EKF2_EVP_NOISE": 0.2, "EKF2_TAU_POS": 0.3, "EKF2_EV_DELAY": 12}
    return log


@pytest.mark.parametrize("generation", ["v1.12", "v1.14", "v1.15", "v1.16"])
def test_read_ekf2_states_layout_is_equal_for_each_px4_release(read, generation):
    ekf2 = read(made_log(generation, position=generation != "v1.16")).ekf2
    record = ekf2.record
    assert (
        list(record.delayed_state) == Columns.FUSION_HORIZON_STATE + Columns.FUSION_HORIZON_VARIANCE
    )
    row = record.delayed_state.iloc[3]
    assert row[Columns.QUATERNION].to_numpy() == pytest.approx(QUATERNION)
    assert row["north_m_s"] == pytest.approx(0.5)
    assert row["down_m"] == pytest.approx(-1.5)
    old = generation in ("v1.12", "v1.14")
    assert record.has_delta_angle_biases == old
    per = ekf2.step_s if old else 1.0
    assert row[Columns.GYRO_BIAS].to_numpy() == pytest.approx(np.array([1, 2, 3]) * 1e-4 / per)
    bias = row[Columns.ACCELEROMETER_BIAS].to_numpy()
    assert bias == pytest.approx(np.array([1, 2, 3]) * 1e-3 / per)
    known = [np.nan] * 2 if generation == "v1.16" else [3.0, 4.0]
    assert row[["north_m", "east_m"]].to_numpy() == pytest.approx(known, nan_ok=True)
    logged = covariances(16)[4 if old else 3 :]
    assert row[Columns.FUSION_HORIZON_VARIANCE[3:9]].to_numpy() == pytest.approx(logged[:6])
    assert row[Columns.FUSION_HORIZON_VARIANCE[9:15]].to_numpy() == pytest.approx(
        logged[6:12] / per**2
    )
    # magnetic fields
    fields = [*Columns.EARTH_MAGNETIC_FIELD, *Columns.BODY_MAGNETIC_FIELD]
    assert row[fields].to_numpy() == pytest.approx(STATES[16:])
    of_fields = covariances(22 if old else 21)[-6:]
    assert row[Columns.FUSION_HORIZON_VARIANCE[15:]].to_numpy() == pytest.approx(of_fields)


def test_attitude_variance_equals_variance_of_sampled_angles(read):
    log = made_log("v1.14")
    variance = np.array([1e-5, 4e-5, 2e-5, 3e-5])
    log["estimator_states"]["covariances"][:, :4] = variance
    found = (
        read(log).ekf2.record.delayed_state.iloc[0][Columns.FUSION_HORIZON_VARIANCE[:3]].to_numpy()
    )
    rng = np.random.default_rng(7)
    drawn = QUATERNION + rng.normal(0.0, np.sqrt(variance), (200_000, 4))
    truth = Rotation.from_quat(QUATERNION, scalar_first=True)
    errors = (Rotation.from_quat(drawn, scalar_first=True) * truth.inv()).as_rotvec()
    assert found == pytest.approx(errors.var(axis=0), rel=0.02)


def test_read_log_keeps_all_ekf2_parameters(read, tmp_path):
    log = made_log("v1.16")
    kept = {name: value for name, value in log.parameters.items() if name.startswith("EKF2_")}
    assert read(log).ekf2.record.parameters == pytest.approx(kept)
    assert "EKF2_TAU_POS" not in read_log(log.write(tmp_path / "again.ulg")).log.parameters


@pytest.mark.parametrize(("flag", "names"), [
    ("cs_gps", ("GNSS position", "GNSS velocity")),
    ("cs_opt_flow", ("optical flow",)),
    ("cs_ev_vel", ("vision velocity",)),
])  # fmt: skip
def test_read_log_lists_all_ekf2_aiding_sources(read, flag, names):
    log = made_log("v1.16")
    flags = log["estimator_status_flags"]
    used = np.zeros(len(flags["timestamp"]), np.bool_)
    flags[flag] = used.copy()
    assert read(log).ekf2.record.other_horizontal_aids == ()
    used[4] = True
    flags[flag] = used
    assert read(log).ekf2.record.other_horizontal_aids == names


def test_vision_age_is_publication_time_minus_sample_time(read):
    log = made_log("v1.16")
    fields = log["vehicle_visual_odometry"]
    age = read(log).ekf2.record.vision_age_s
    expected = (fields["timestamp"].astype(float) - fields["timestamp_sample"]) * 1e-6
    assert age.to_numpy() == pytest.approx(expected)


def test_read_ekf2_states_without_topic_is_unavailable(read):
    assert isinstance(read(make_log("v1.16")).ekf2.record, Unavailable)  # quaternions of zero
    assert isinstance(read(made_log("v1.16").drop("estimator_states")).ekf2.record, Unavailable)
    assert isinstance(read(make_log("v1.11")).ekf2.record, Unavailable)


STEP_S = 0.010  # s, EKF2's step at an IMU rate of 100 Hz


@pytest.mark.parametrize("generation", GENERATIONS)
def test_read_accelerometer_bias_is_in_m_s2_for_each_release(read, generation):
    log = make_log(generation)
    number = int(generation.removeprefix("v1."))
    holder = log["estimator_states" if number >= 12 else "estimator_status"]
    holder["states"][:, 13:16] = BIAS * (STEP_S if number < 15 else 1.0)
    ekf2 = read(log).ekf2
    assert ekf2.step_s == pytest.approx(STEP_S)
    found = ekf2.accelerometer_bias
    np.testing.assert_allclose(found, np.tile(BIAS, (len(found), 1)), rtol=1e-5)


def test_read_accelerometer_bias_prefers_sensor_bias_topic(read):
    log = make_log("v1.14")
    own = {"accel_bias": np.tile(BIAS, (10, 1))}
    log.add(topic("estimator_sensor_bias", stamps(10.0, 1.0), own, sampled=True))
    bias = read(log).ekf2.accelerometer_bias
    np.testing.assert_allclose(bias.iloc[0], BIAS, rtol=1e-6)
    assert bias.index[1] == pytest.approx(1.0)


def test_ekf2_prediction_step_is_multiple_of_imu_interval(read):
    log = make_log("v1.14", imu_hz=1.0 / 0.004)
    log.parameters["EKF2_PREDICT_US"] = 10_000
    log["estimator_states"]["states"][:, 13:16] = BIAS * 0.012
    ekf2 = read(log).ekf2
    assert ekf2.step_s == pytest.approx(0.012)  # 2.5 samples round to 3, as roundf does
    np.testing.assert_allclose(ekf2.accelerometer_bias.iloc[0], BIAS, rtol=1e-5)
    imu = log["sensor_combined"]
    for name in imu:
        imu[name] = imu[name][:1]
    assert read(log).ekf2.step_s == STEP_S


def test_fusion_horizon_delay_equals_age_of_published_state(read):
    log = make_log("v1.16")
    assert read(log).ekf2.horizon_s == pytest.approx(0.060)
    states = log["estimator_states"]
    states["timestamp_sample"] = states["timestamp"].copy()
    assert isinstance(read(log).ekf2.horizon_s, Unavailable)
    assert isinstance(read(make_log("v1.11")).ekf2.horizon_s, Unavailable)
    without = read(log.drop("estimator_states")).ekf2
    assert isinstance(without.accelerometer_bias, Unavailable)
    assert isinstance(without.horizon_s, Unavailable)
