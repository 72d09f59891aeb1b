"""ULog reader: logs in the formats of several PX4 releases, and flights with ground truth."""

import json

import numpy as np
import pytest
from comparisons import compare
from exchange import replace
from ulog_tools import (
    AXES,
    EV_VARIANCE,
    GENERATIONS,
    GRAVITY,
    INNOVATION_VARIANCE,
    VELOCITY,
    covariances,
    ev_error,
    ev_stamps,
    innovations,
    make_log,
    odometry,
    position,
    seconds_of,
    selector,
    stamps,
    states,
    topic,
)

from px4fuse.comparison.preparation import choose_source
from px4fuse.errors import MissingDataError
from px4fuse.flight.model import (
    ALIGNED_BY_EKF2_ORIGIN,
    AS_RECEIVED_ORIGIN,
    GNSS_ORIGIN,
    KEPT_BY_EKF2_ORIGIN,
    MOTION_CAPTURE_ORIGIN,
    REBUILT_FROM_INNOVATIONS_ORIGIN,
    Columns,
    Reset,
    Unavailable,
)
from px4fuse.readers import read_log
from px4fuse.readers.px4_innovations import MAX_TIME_FROM_INNOVATION_TO_VARIANCE_S
from px4fuse.readers.px4_positions import find_motion_capture_truth

HALF_PERIOD_S = 0.005  # s; half of the prediction interval, EKF2_PREDICT_US 10,000
HOUR_US = 3_600_000_000
FLOAT32 = {"rtol": 1e-6, "atol": 1e-6}


def times(frame):
    return frame.index.to_numpy()


def shift(stamps_us, at, by_us):
    stamps_us[at] = int(stamps_us[at]) + by_us


def assert_equals_external_vision(track):
    """Check that the samples equal the external vision samples of the log."""
    expected = seconds_of(ev_stamps(10.0))
    sent = position(expected) + ev_error(expected)
    np.testing.assert_allclose(times(track.samples), expected, atol=1e-9)
    np.testing.assert_allclose(track.samples[Columns.POSITION], sent, **FLOAT32)
    variance = track.samples[Columns.POSITION_VARIANCE]
    np.testing.assert_allclose(variance, np.tile(EV_VARIANCE, (len(expected), 1)), **FLOAT32)


def delay_boot(log, by_us):
    """Add a constant (µs) to all timestamps."""
    for made in log.topics:
        for name in ("timestamp", "timestamp_sample"):
            if name in made.fields:
                made.fields[name] = made.fields[name] + np.uint64(by_us)
    return log


# ---- every generation ----------------------------------------------------------------------


@pytest.mark.parametrize("generation", GENERATIONS)
def test_read_ulog_of_each_px4_release_reads_external_vision(read, generation):
    (track, *_) = read(make_log(generation)).positions
    assert (track.name, track.origin.route) == ("vehicle_visual_odometry", AS_RECEIVED_ORIGIN.route)
    assert_equals_external_vision(track)
    assert track.frame == ("unknown" if generation == "v1.9" else "NED")
    assert track.compute_rate_hz() == pytest.approx(5.0)


@pytest.mark.parametrize("generation", GENERATIONS)
@pytest.mark.parametrize("axis", range(3))
def test_ekf2_innovation_sign_becomes_measurement_minus_state(read, generation, axis):
    """PX4 logs state minus measurement; the flight has the opposite sign."""
    log = make_log(generation)
    logged = {
        "v1.9": lambda: log["ekf2_innovations"]["vel_pos_innov"][:, 3 + axis],
        "v1.11": lambda: log["estimator_innovations"]["ev_hpos" if axis < 2 else "ev_vpos"],
    }
    if generation in logged:  # check the sign in the generated log
        first = np.ravel(logged[generation]())[axis if generation == "v1.11" and axis < 2 else 0]
        assert np.sign(first) == -np.sign(ev_error([0.1])[0, axis])
    frame = read(log).ekf2.innovations[AXES[axis]]
    expected = seconds_of(ev_stamps(10.0))
    np.testing.assert_allclose(times(frame), expected, atol=1e-9)
    np.testing.assert_allclose(frame["innovation_m"], ev_error(expected)[:, axis], **FLOAT32)
    variance = frame["innovation_variance_m2"]
    np.testing.assert_allclose(variance, INNOVATION_VARIANCE[axis], rtol=1e-6)


@pytest.mark.parametrize("generation", GENERATIONS)
def test_ekf2_innovation_flags_are_read_since_px4_v1_14(read, generation):
    ekf2 = read(make_log(generation)).ekf2
    if int(generation.removeprefix("v1.")) < 14:
        older = ekf2.innovations["north"]
        assert older[["observation_variance_m2", "fused"]].isna().all(axis=None)
        return
    assert ekf2.innovation_topics == ("estimator_aid_src_ev_pos", "estimator_aid_src_ev_hgt")
    for at, axis in enumerate(AXES):
        frame = ekf2.innovations[axis]
        np.testing.assert_allclose(frame["observation_variance_m2"], EV_VARIANCE[at], rtol=1e-6)
        ratio = ev_error(times(frame))[:, at] ** 2 / (25.0 * INNOVATION_VARIANCE[at])
        np.testing.assert_allclose(frame["test_ratio"], ratio, rtol=1e-5, atol=1e-9)
        assert (frame["fused"] == 1).all()
        assert (frame["rejected"] == 0).all()


@pytest.mark.parametrize("generation", ["v1.9", "v1.11", "v1.12"])
def test_unlogged_ekf2_rejection_is_derived_from_gate(read, generation):
    """An innovation above 5 √S along east rejects both horizontal axes."""
    log = make_log(generation)
    topic = "ekf2_innovations" if generation == "v1.9" else "estimator_innovations"
    field = "vel_pos_innov" if generation == "v1.9" else "ev_hpos"
    at = 4 if generation == "v1.9" else 1
    copies = 1 if generation == "v1.9" else 2  # the newer topic has two rows per fusion
    of_sigma = np.repeat([4.99, -4.99, 5.01, -5.01], copies)
    log[topic][field][20 : 20 + 4 * copies, at] = np.sqrt(INNOVATION_VARIANCE[1]) * of_sigma
    innovations = read(log).ekf2.innovations
    for axis in ("north", "east"):
        assert innovations[axis]["rejected"].sum() == 2
    assert innovations["down"]["rejected"].sum() == 0


@pytest.mark.parametrize("generation", GENERATIONS)
def test_read_ulog_of_each_px4_release_reads_state_and_imu(read, generation):
    flight = read(make_log(generation))
    state = flight.ekf2.state
    np.testing.assert_allclose(times(state), seconds_of(stamps(10.0, 10.0)), atol=1e-9)
    np.testing.assert_allclose(state[Columns.POSITION], position(times(state)), **FLOAT32)
    np.testing.assert_allclose(state[Columns.VELOCITY], np.tile(VELOCITY, (100, 1)), **FLOAT32)
    assert len(flight.imu) == 1000
    np.testing.assert_allclose(flight.imu["down_m_s2"], -GRAVITY, rtol=1e-6)
    assert (flight.attitude == [1.0, 0.0, 0.0, 0.0]).all(axis=None)
    assert flight.airborne == ((1.0, 9.0),)
    assert (flight.ekf2.fusion_flags[["horizontal", "vertical"]] == 1).all(axis=None)
    assert (flight.ekf2.fusion_flags["yaw"] == 0).all()


@pytest.mark.parametrize("generation", GENERATIONS)
def test_ekf2_covariance_layout_follows_from_array_length(read, generation):
    """Element i of the arrays is (i + 1) / 100, so a wrong offset is detected."""
    variance = read(make_log(generation)).ekf2.variance
    found = variance[Columns.VELOCITY_VARIANCE + Columns.POSITION_VARIANCE]
    first = 3 if generation in ("v1.15", "v1.16") else 4
    expected = covariances(24)[first : first + 6]
    np.testing.assert_allclose(found, np.tile(expected, (len(variance), 1)), rtol=1e-6)


def test_ekf2_covariance_of_unknown_length_is_unavailable(read):
    """The firmware version is ignored; a development version may have either layout."""
    log = make_log("v1.15")
    log.info["ver_sw_release"] = 1 << 24 | 14 << 16
    assert read(log).ekf2.variance["north_m2"].iloc[0] == pytest.approx(0.07, rel=1e-6)
    log = make_log("v1.16")
    fields = log["estimator_states"]
    fields["covariances"] = fields["covariances"][:, :22]
    variance = read(log).ekf2.variance
    assert isinstance(variance, Unavailable)
    assert "no supported PX4 release has states and covariances of these lengths" in variance.reason


@pytest.mark.parametrize(("generation", "code", "frame"), [
    ("v1.11", 0, "NED"), ("v1.11", 1, "FRD"), ("v1.11", 2, "unknown"), ("v1.11", 3, "FRD"),
    ("v1.16", 0, "unknown"), ("v1.16", 1, "NED"), ("v1.16", 2, "FRD"), ("v1.16", 9, "unknown"),
])  # fmt: skip
def test_external_vision_frame_code_is_converted_to_frame_name(read, generation, code, frame):
    log = make_log(generation)
    fields = log["vehicle_visual_odometry"]
    name = "pose_frame" if "pose_frame" in fields else "local_frame"
    fields[name][:] = code
    assert read(log).positions[0].frame == frame


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_external_vision_variance_zero_or_nan_is_nan(read, value):
    log = make_log("v1.16")
    log["vehicle_visual_odometry"]["position_variance"][:] = value
    assert read(log).positions[0].samples[Columns.POSITION_VARIANCE].isna().all(axis=None)


# ---- time -----------------------------------------------------------------------------------


def test_imu_times_include_accelerometer_timestamp_offset(read):
    log = make_log("v1.16")
    offset = log["sensor_combined"]["accelerometer_timestamp_relative"]
    offset[:] = -2_000
    offset[7] = 0x7FFFFFFF  # value of PX4 for an invalid accelerometer sample
    imu = read(log).imu
    expected = np.delete(seconds_of(stamps(10.0, 100.0)), 7) - 0.002
    np.testing.assert_allclose(times(imu), expected, atol=1e-9)


def test_read_ulog_reads_imu_clipping_and_failure_detector(read):
    log = make_log("v1.16")
    assert (plain := read(log)).excessive_tilt_spans_s == ()
    assert "clipped" not in plain.imu
    bits = np.zeros(len(log["sensor_combined"]["timestamp"]), np.uint8)
    bits[300:304] = 4  # bit of the third axis
    log["sensor_combined"]["accelerometer_clipping"] = bits
    at = stamps(10.0, 2.0)
    seconds = seconds_of(at)
    sides = {"fd_roll": (2.9, 4.1), "fd_pitch": (3.9, 5.1), "fd_motor": (7.9, 8.1)}
    failing = {name: (seconds > low) & (seconds < high) for name, (low, high) in sides.items()}
    log.add(topic("failure_detector_status", at, failing))
    flight = read(log)
    np.testing.assert_array_equal(np.flatnonzero(flight.imu["clipped"]), range(300, 304))
    assert flight.excessive_tilt_spans_s == ((pytest.approx(3.0), pytest.approx(5.5)),)


@pytest.mark.parametrize(("name", "at", "jump_us"), [
    ("vehicle_land_detected", -1, 3 * HOUR_US), ("vehicle_land_detected", 0, -3 * HOUR_US),
    *(("sensor_combined", at, hours * HOUR_US)
      for at in (0, 1, 500, -2, -1) for hours in (3, -3)),
])  # fmt: skip
def test_log_duration_ignores_a_stray_timestamp(read, name, at, jump_us):
    log = delay_boot(make_log("v1.16"), 4 * HOUR_US)
    shift(log[name]["timestamp"], at, jump_us)
    info = read(log).log
    allowed = 0.03 if name == "sensor_combined" else 1e-6
    assert info.duration_s == pytest.approx(9.99, abs=allowed)
    assert info.boot_time_s == pytest.approx(4 * 3600 + 5.0, abs=allowed)


def test_log_duration_without_imu_uses_densest_topic(read):
    log = make_log("v1.16").drop("sensor_combined")
    shift(log["vehicle_land_detected"]["timestamp"], -1, 3 * HOUR_US)
    flight = read(log)
    assert flight.log.duration_s == pytest.approx(9.95)
    assert isinstance(flight.imu, Unavailable)


# ---- two instances of EKF2 --------------------------------------------------------------------


def with_two_instances(generation, switches):
    """Add a second EKF2 instance with three times the variances and innovations."""
    log = make_log(generation)
    number = int(generation.removeprefix("v1."))
    log.add(*states(10.0, generation, instance=1, scale=3.0))
    log.add(*innovations(10.0, number, instance=1, scale=3.0))
    return log.add(selector(switches))


@pytest.mark.parametrize("generation", ["v1.12", "v1.15", "v1.16"])
@pytest.mark.parametrize("switches", [
    [(0.0, 0), (4.95, 1)],
    [(0.0, 1), (4.95, 0)],
    [(0.0, 0), (2.05, 1), (3.05, 1), (6.95, 0)],
])  # fmt: skip
def test_ekf2_samples_are_taken_from_primary_instance(read, generation, switches):
    ekf2 = read(with_two_instances(generation, switches)).ekf2
    starts = np.array([start for start, _ in switches])
    numbers = np.array([number for _, number in switches])

    def scale(time):
        return np.where(numbers[np.searchsorted(starts, time, side="right") - 1] == 1, 3.0, 1.0)

    at = times(ekf2.variance)
    np.testing.assert_allclose(at, seconds_of(stamps(10.0, 2.0)), atol=1e-9)
    first = 6 if generation in ("v1.15", "v1.16") else 7
    expected = covariances(24)[first] * scale(at)
    np.testing.assert_allclose(ekf2.variance["north_m2"], expected, rtol=1e-6)
    frame = ekf2.innovations["east"]
    at = times(frame)
    np.testing.assert_allclose(at, seconds_of(ev_stamps(10.0)), atol=1e-9)
    np.testing.assert_allclose(frame["innovation_m"], ev_error(at)[:, 1] * scale(at), **FLOAT32)
    assert [number for _, number in ekf2.primary_instances] == [
        number for at, number in enumerate(numbers) if at == 0 or number != numbers[at - 1]
    ]


def test_selector_value_255_is_not_used_as_primary_instance(read):
    ekf2 = read(with_two_instances("v1.16", [(0.0, 255), (3.05, 1)])).ekf2
    assert ekf2.primary_instances == ((-np.inf, 1),)
    assert ekf2.variance["north_m2"].iloc[-1] == pytest.approx(3.0 * 0.07, rel=1e-6)


# ---- resets -----------------------------------------------------------------------------------


@pytest.mark.parametrize("before", [0, 254, 255])
def test_ekf2_reset_counter_overflow_counts_as_one_reset(read, before):
    """The counters are uint8: the reset after number 255 is number 0."""
    log = make_log("v1.16")
    fields = log["vehicle_local_position"]
    after = (before + 1) % 256
    for at, name, delta in (
        (40, "xy", [1.5, -0.5]), (60, "z", 0.25), (70, "vxy", [0.125, 2.0]), (80, "vz", -4.0),
    ):  # fmt: skip
        counter = fields[f"{name}_reset_counter"]
        counter[:at], counter[at:] = before, after
        fields[f"delta_{name}"][at:] = delta
    resets = read(log).ekf2.resets
    assert [replace(r, time_s=round(r.time_s, 6)) for r in resets] == [
        Reset(4.0, "position", (1.5, -0.5, 0.0)),
        Reset(6.0, "position", (0.0, 0.0, 0.25)),
        Reset(7.0, "velocity", (0.125, 2.0, 0.0)),
        Reset(8.0, "velocity", (0.0, 0.0, -4.0)),
    ]


# ---- innovations ------------------------------------------------------------------------------


def test_innovation_without_variance_near_in_time_is_dropped(read):
    log = make_log("v1.12")
    late = log["estimator_innovation_variances"]
    kept = seconds_of(late["timestamp_sample"]) < 5.0
    for name in late:
        late[name] = late[name][kept]
    ekf2 = read(log).ekf2
    assert times(ekf2.innovations["north"]).max() < 5.0 + MAX_TIME_FROM_INNOVATION_TO_VARIANCE_S


def test_ekf2_innovations_while_vision_is_not_fused_are_dropped(read):
    log = make_log("v1.12")
    flags = log["estimator_status_flags"]
    at = seconds_of(flags["timestamp_sample"])
    flags["cs_ev_pos"][:] = (at >= 3.0) & (at < 6.0)
    frame = read(log).ekf2.innovations["north"]
    expected = seconds_of(ev_stamps(10.0))
    expected = expected[(expected >= 3.0) & (expected < 6.0)]
    np.testing.assert_allclose(times(frame), expected, atol=1e-9)


def test_innovations_neither_fused_nor_rejected_are_dropped(read):
    log = make_log("v1.16")
    fields = log["estimator_aid_src_ev_pos"]
    fields["fused"][:10] = False
    fields["fused"][10:13], fields["innovation_rejected"][10:13] = False, True
    frame = read(log).ekf2.innovations["north"]
    np.testing.assert_allclose(times(frame), seconds_of(ev_stamps(10.0))[10:], atol=1e-9)
    assert frame["rejected"].sum() == 3
    assert frame["fused"].sum() == len(frame) - 3


def test_ekf2_innovations_of_never_fused_axis_are_unavailable(read):
    log = make_log("v1.16")
    log["estimator_status_flags"]["cs_ev_hgt"][:] = False
    flight = read(log)
    assert isinstance(flight.ekf2.innovations["down"], Unavailable)
    assert len(flight.ekf2.innovations["north"]) == len(ev_stamps(10.0))
    (missing,) = [one for one in flight.missing if one.what == "EKF2 innovations, down"]
    assert "never fused" in str(missing)


# ---- EKF2 that did not run --------------------------------------------------------------------


@pytest.mark.parametrize(("parameters", "reason"), [
    ({"EKF2_EN": 0}, "EKF2_EN is 0"), ({"SYS_MC_EST_GROUP": 1}, "SYS_MC_EST_GROUP is 1"),
])  # fmt: skip
def test_ekf2_is_unavailable_if_other_estimator_was_active(read, parameters, reason):
    """The position topics are in the log, published by the other estimator."""
    log = make_log("v1.11")
    log.parameters |= parameters
    flight = read(log)
    assert isinstance(flight.ekf2, Unavailable)
    assert reason in flight.ekf2.reason
    assert flight.ekf2 in flight.missing
    assert flight.positions[0].name == "vehicle_visual_odometry"


def test_ekf2_gate_of_px4_v1_11_log_is_read_from_parameter(read):
    log = make_log("v1.11")
    log.parameters |= {"SYS_MC_EST_GROUP": 2, "EKF2_EVP_GATE": 3.0}
    ekf2 = read(log).ekf2
    assert (len(ekf2.state), ekf2.gate) == (100, 3.0)
    del log.parameters["EKF2_EVP_GATE"]
    assert read(log).ekf2.gate == 5.0  # PX4's default


# ---- preference of position sources -----------------------------------------------------------


def gps_topic():
    """Make a GPS topic that moves 0.001° of latitude (111.19 m) per second."""
    at = stamps(10.0, 5.0)
    time = seconds_of(at)
    made = topic("vehicle_gps_position", at, {"fix_type": np.full(len(time), 3, np.uint8)})
    made.fields["latitude_deg"], made.fields["longitude_deg"] = 47.0 + 0.001 * time, 8.0 + 0 * time
    made.fields["altitude_msl_m"] = 500.0 + time
    return made


PREFERRED = [
    ("vehicle_visual_odometry", AS_RECEIVED_ORIGIN),
    ("vehicle_mocap_odometry", MOTION_CAPTURE_ORIGIN),
    ("estimator_visual_odometry_aligned", ALIGNED_BY_EKF2_ORIGIN),
    ("estimator_aid_src_ev_pos", KEPT_BY_EKF2_ORIGIN),
    ("ekf2_state_plus_innovation", REBUILT_FROM_INNOVATIONS_ORIGIN),
    ("vehicle_gps_position", GNSS_ORIGIN),
]


def test_position_sources_are_listed_in_order_of_preference(read):
    log = make_log("v1.16")
    log.add(odometry("vehicle_mocap_odometry", 10.0, 16), gps_topic())
    log.add(odometry("estimator_visual_odometry_aligned", 10.0, 12))
    flight = read(log)
    assert [(track.name, track.origin.route) for track in flight.positions] == [
        (name, origin.route) for name, origin in PREFERRED
    ]
    reason = choose_source(flight)[1]
    assert "--position-source" not in reason
    assert "no usable" not in reason
    for name, _ in PREFERRED:
        track, reason = choose_source(flight, name)
        assert track.name == name
        assert "--position-source" in reason


def test_choosing_missing_position_source_lists_other_sources(read):
    flight = read(make_log("v1.16"))
    with pytest.raises(MissingDataError, match="vehicle_mocap_odometry") as error:
        choose_source(flight, "vehicle_mocap_odometry")
    assert "vehicle_visual_odometry, estimator_aid_src_ev_pos" in str(error.value)
    with pytest.raises(MissingDataError, match="no such source"):
        choose_source(flight, "sonar")


def test_unfused_gnss_is_used_as_source_only_on_request(read):
    log = make_log("v1.16")
    log.drop(*(n for n in log.names() if "_ev_" in n or n == "vehicle_visual_odometry"))
    with pytest.raises(MissingDataError, match="SDLOG_PROFILE to 129"):
        choose_source(read(log))
    flight = read(log.add(gps_topic()))
    with pytest.raises(MissingDataError, match=r"position.source`? vehicle_gps_position"):
        choose_source(flight)
    assert choose_source(flight, "vehicle_gps_position")[0].origin == GNSS_ORIGIN


@pytest.mark.parametrize("delay_ms", [0.0, 175.0])
def test_reader_adds_ev_delay_to_times_of_ekf2_vision_samples(read, delay_ms):
    """EKF2 subtracts EKF2_EV_DELAY and half its prediction interval from the timestamp."""
    log = make_log("v1.16").drop("vehicle_visual_odometry")
    log.parameters["EKF2_EV_DELAY"] = delay_ms
    for name in ("estimator_aid_src_ev_pos", "estimator_aid_src_ev_hgt"):
        log[name]["timestamp_sample"] -= np.uint64((delay_ms * 1e-3 + HALF_PERIOD_S) * 1e6)
    track, _ = choose_source(read(log))
    assert (track.name, track.origin.route) == (
        "estimator_aid_src_ev_pos",
        KEPT_BY_EKF2_ORIGIN.route,
    )
    assert_equals_external_vision(track)


def test_position_sample_without_logged_height_has_nan_height(read):
    """The logger decimates heights separately, so their times may differ from the positions."""
    log = make_log("v1.16").drop("vehicle_visual_odometry")
    stamped = log["estimator_aid_src_ev_hgt"]["timestamp_sample"]
    assert len(stamped) == 50
    stamped[10:30] += np.uint64(20_000)
    stamped[30:33] += np.uint64(90_000)
    track, _ = choose_source(flight := read(log))
    rows_without_height = np.flatnonzero(track.samples["down_m"].isna())
    np.testing.assert_array_equal(rows_without_height, [30, 31, 32])
    # observations are float32
    at = seconds_of(ev_stamps(10.0))[10:30]
    height = (position(at) + ev_error(at))[:, 2]
    np.testing.assert_allclose(track.samples["down_m"].to_numpy()[10:30], height, **FLOAT32)
    (note,) = track.notes
    for words in ("3 of 50", "50 ms"):
        assert words in note
    assert note in compare(flight).notes


@pytest.mark.parametrize("generation", ["v1.9", "v1.11", "v1.12"])
def test_position_reconstructed_from_innovation_equals_measured(read, generation):
    log = make_log(generation).drop("vehicle_visual_odometry")
    if generation == "v1.12":
        log.drop("estimator_visual_odometry_aligned")
    track, _ = choose_source(read(log))
    assert (track.name, track.origin.route) == (
        "ekf2_state_plus_innovation",
        REBUILT_FROM_INNOVATIONS_ORIGIN.route,
    )
    expected = position(times(track.samples)) + ev_error(times(track.samples))
    np.testing.assert_allclose(track.samples[Columns.POSITION], expected, atol=1e-5)
    assert len(track.samples) >= len(ev_stamps(10.0)) - 1


def test_innovations_before_first_ekf2_state_add_no_height_note(sample_log):
    track, _ = choose_source(read_log(sample_log.with_name("loop_vio.ulg")), STATE)
    assert len(track.invalid_reasons) > 0
    assert track.notes == ()


# ---- truth ------------------------------------------------------------------------------------


def test_read_ulog_reads_ground_truth_of_simulation(read):
    at = stamps(10.0, 20.0)
    here = position(seconds_of(at)) + 0.5
    fields = dict(zip("xyz", here.T, strict=True))
    fields |= {name: np.full(len(at), 0.25) for name in ("vx", "vy", "vz")}
    flight = read(make_log("v1.16").add(topic("vehicle_local_position_groundtruth", at, fields)))
    assert flight.truth.name == "vehicle_local_position_groundtruth"
    np.testing.assert_allclose(flight.truth.samples[Columns.POSITION], here, **FLOAT32)
    assert (flight.truth.samples[Columns.VELOCITY] == 0.25).all(axis=None)


def test_motion_capture_is_ground_truth_if_other_source_exists(read):
    log = make_log("v1.16").add(odometry("vehicle_mocap_odometry", 10.0, 16))
    flight = read(log)
    assert flight.truth.name == "vehicle_mocap_odometry"
    without_north = (replace(track, frame="FRD") for track in flight.positions)
    assert find_motion_capture_truth(tuple(without_north)) is None
    log.drop(*(n for n in log.names() if "_ev_" in n or n == "vehicle_visual_odometry"))
    flight = read(log)
    assert isinstance(flight.truth, Unavailable)
    assert choose_source(flight)[0].name == "vehicle_mocap_odometry"


# ---- source of each part ----------------------------------------------------------------------

STREAMS = {
    "v1.9": ["ekf2_innovations", "estimator_status", "estimator_status"],
    "v1.12": ["estimator_innovations", "estimator_status_flags", "estimator_states"],
    "v1.16": ["estimator_aid_src_ev_pos", "estimator_status_flags", "estimator_states"],
}


@pytest.mark.parametrize("generation", STREAMS)
def test_read_log_lists_topics_clock_and_file_of_each_stream(read, generation):
    streams = read(make_log(generation)).streams
    of_ekf2 = ("ekf2_innovations", "ekf2_fusing", "ekf2_variance")
    assert [streams[part].topics[0] for part in of_ekf2] == STREAMS[generation]
    others = {part: stream.topics for part, stream in streams.items() if part not in of_ekf2}
    assert others == {
        "imu": ("sensor_combined",), "attitude": ("vehicle_attitude",),
        "ekf2_state": ("vehicle_local_position",), "airborne": ("vehicle_land_detected",),
    }  # fmt: skip
    assert {stream.log for stream in streams.values()} == {"made.ulg"}
    measured = {part for part, s in streams.items() if s.clock.endswith("(measurement time)")}
    assert measured == {"imu"} | (set() if generation == "v1.9" else {"ekf2_state", *of_ekf2})


def test_uwb_ranges_are_listed_as_unused_data(read):
    at = stamps(10.0, 4.0)
    ranges = topic("sensor_uwb", at, {"distance": np.ones(len(at))})
    grid = topic("uwb_grid", at[:3], {"num_anchors": np.ones(3, np.uint8)})
    flight = read(make_log().add(ranges, grid))
    unused = [(part.name, part.count) for part in flight.unused]
    assert unused == [("sensor_uwb", 40), ("uwb_grid", 3)]
    assert "a range and two angles" in flight.unused[0].reason
    assert flight.positions[0].name == "vehicle_visual_odometry"


@pytest.mark.parametrize("unknown_us", [0, 5_000_000, 2**64 - 1])
def test_unix_start_time_of_log_is_read_from_gnss_fixes(read, unknown_us):
    made = gps_topic()
    utc_us = 1_700_000_000_000_000 + np.round(seconds_of(made.fields["timestamp"]) * 1e6)
    made.fields["time_utc_usec"] = utc_us.astype(np.uint64)
    made.fields["time_utc_usec"][:2] = unknown_us
    start = read(make_log().add(made)).log.start_unix_s
    assert start == pytest.approx(1_700_000_000.0, abs=1e-5)
    made.fields["fix_type"][:] = 2
    assert read(make_log().add(made)).log.start_unix_s is None


# ---- flights with known truth -----------------------------------------------------------------

SIMULATED = [
    "main202603_aisle_hwlogvision", "v1.13.3_aisle_evdelay175", "v1.13.3_aisle_hwlogvision",
    "v1.14.4_aisle_nominal", "v1.16.1_aisle_10hz", "v1.16.1_aisle_2hz_stock",
    "v1.16.1_aisle_clock_late", "v1.16.1_aisle_clock_nosync", "v1.16.1_aisle_hwlog",
    "v1.16.1_aisle_hwlogvision", "v1.16.1_aisle_nlos", "v1.16.1_aisle_nominal",
    "v1.16.1_aisle_overconfident",
]  # fmt: skip


@pytest.mark.reallogs
@pytest.mark.parametrize("name", SIMULATED)
def test_read_log_of_simulation_returns_simulated_uwb_samples(shared_logs, name):
    """Each sample of the chosen source equals a sent sample, at its measurement time."""
    flight = read_log(shared_logs / "simulated" / f"{name}.ulg")
    sent = json.loads((shared_logs / "simulated" / f"{name}.json").read_text())
    track, _ = choose_source(flight)
    kept = name == "v1.16.1_aisle_hwlog"  # logging profile without the vision topic
    assert track.name == ("estimator_aid_src_ev_pos" if kept else "vehicle_visual_odometry")

    axes = (
        slice(0, 2) if track.origin.route == KEPT_BY_EKF2_ORIGIN.route else slice(0, 3)
    )  # EKF2's observations contain no height in these logs
    sent_z = np.array([sample["z"] for sample in sent["uwb"]])[:, axes]
    sent_s = np.array([sample["t_px4_us"] for sample in sent["uwb"]]) * 1e-6
    read_z = track.samples[Columns.POSITION[axes]].to_numpy()
    read_s = times(track.samples) + flight.log.boot_time_s

    distance = np.abs(read_z[:, None, :] - sent_z[None, :, :]).max(axis=2)
    match = distance.argmin(axis=1)
    assert distance.min(axis=1).max() < 1e-4  # the file with ground truth is rounded to 0.1 mm
    assert (np.diff(match) > 0).all()

    late = read_s - sent_s[match]
    config = sent["config"]
    if config["timesync"]:
        synced = np.abs(late - config["stamp_offset_s"]) < 0.01
        first = int(synced.argmax())
        # Earlier timestamps are arrival times: PX4 needs 500 TIMESYNC replies at 10 Hz
        assert sent_s[match[first]] - sent_s[0] < 55.0
        assert synced[first:].all()
    else:
        assert np.median(late) == pytest.approx(config["latency_ms"] * 1e-3, abs=0.02)
    inside = (sent_s > sent_s[match[0]]) & (sent_s < sent_s[match[-1]])
    if track.origin.route == AS_RECEIVED_ORIGIN.route and not config["dropouts"]:
        assert len(read_s) >= 0.98 * np.count_nonzero(inside)


@pytest.mark.reallogs
@pytest.mark.parametrize("name", [name for name in SIMULATED if "1.13" in name])
def test_global_ground_truth_is_projected_to_local_metres(shared_logs, name):
    """The UWB error against the projected ground truth has the simulated noise (0.10 m)."""
    flight = read_log(shared_logs / "simulated" / f"{name}.ulg")
    assert flight.truth.name == "vehicle_global_position_groundtruth"
    samples, truth = flight.positions[0].samples, flight.truth.samples
    for column in ("north_m", "east_m"):
        error = samples[column] - np.interp(times(samples), truth.index, truth[column])
        assert error.std() == pytest.approx(0.10, abs=0.015)
        assert abs(error.mean()) < 0.02


VISION, ALIGNED_VISION = "vehicle_visual_odometry", "estimator_visual_odometry_aligned"
GPS_POSITION, STATE = "vehicle_gps_position", "ekf2_state_plus_innovation"
# Duration of the data (s) and chosen source; None if EKF2 fused no position
REAL = {
    "PX4_pyulog_sample_log_small": (6.5, None),  # one message has a timestamp of 1194 s
    "PX4_pyulog_sample": (68.9, None),
    "PX4_pyulog_hist_fa8acbdc_sample_unordered": (68.9, None),
    "PX4_pyulog_sample_appended_multiple": (9.6, None),
    "mengchaoheng_PX4_ulog_plottools_hist_6a8cf408_test3": (37.7, VISION),
    "Auterion_px4-ulog-rs_hist_2f3b79f6_corrupt_unregistered_msg_id": (95.1, GPS_POSITION),
    "PX4_flight-review-rs_battery_brownout": (76.0, STATE),
    "vladimireganov_ROS_PX4_MOCAP_min_snap_01": (35.0, ALIGNED_VISION),
    "PX4_pyulog_sample_px4_events": (31.1, GPS_POSITION),  # EKF2_EV_CTRL 15, but no vision
    "Auterion_px4-ulog-rs_hist_571df892_quadrotor_local": (92.5, None),
}


@pytest.mark.reallogs
@pytest.mark.parametrize("name", REAL)
def test_read_log_of_real_logs_finds_duration_and_positions(shared_logs, name):
    duration_s, source = REAL[name]
    flight = read_log(shared_logs / "real" / f"{name}.ulg")
    assert flight.log.duration_s == pytest.approx(duration_s, abs=0.06)
    if source is None:
        with pytest.raises(MissingDataError):
            choose_source(flight)
        return
    assert choose_source(flight)[0].name == source
    fused = not isinstance(flight.ekf2.innovations["north"], Unavailable)
    assert fused == (source != GPS_POSITION)
