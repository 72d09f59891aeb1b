"""Reader of EKF2 data in a ULog: state, variances, innovations, resets, fusion horizon.

Sources: PX4-Autopilot ``EKF2.cpp``, ``EKF/common.h``, ``msg/EstimatorStatusFlags.msg`` and
``msg/EstimatorStatus.msg``.
"""

from typing import Literal

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from px4fuse.core.arrays import Array, IntArray, compute_median_interval_s
from px4fuse.flight.ekf2_parameters import AIDS, EV_POS, FLOW, fill_parameters_with_defaults
from px4fuse.flight.model import (
    BIAS_NOT_LOGGED,
    EKF2_STEP_S,
    FLOW_FILTER_NEW_SAMPLE_WEIGHT,
    HORIZON_NOT_LOGGED,
    RECORD_NOT_LOGGED,
    Columns,
    Ekf2,
    FusionRecord,
    Reset,
    StepFunctions,
    TableOrUnavailable,
    Unavailable,
    sample_step_function,
    time_index,
)

from .common import MessageLayout
from .px4_innovations import (
    collect_innovations_by_axis,
    read_aids,
    read_enabled_aids,
)
from .px4_topics import (
    ATTITUDE_VARIANCE_COUNT_BY_ARRAY_LENGTHS,
    DEFAULT_PROFILE_REMEDY,
    HEIGHT_BIAS_LAYOUT_BY_AID,
    IMU_LAYOUT,
    LOCAL_POSITION_LAYOUT,
    QUATERNION_VARIANCE_COUNT,
    STATE_VECTOR_TOPICS,
    STATUS_FLAGS_TOPIC,
    STATUS_TOPIC,
    TOPIC_LAYOUTS,
)
from .ulog_topics import Topics, get_measurement_times_us

VISION_TOPIC = "vehicle_visual_odometry"
# Fields of vehicle_local_position that are 1 while the horizontal position is valid
VALIDITY_FLAGS = ("xy_valid", "xy_global")
# Bit of filter_control_status_u (common.h) for fusion of the 3D magnetic field
MAG_3D_FUSION_BIT = 5
# Minimum rate (Hz) of a complete magnetometer log; EKF2 uses 14 Hz
MIN_MAGNETOMETER_HZ = 10.0
# Number of IMU samples per prediction step = prediction step ÷ IMU interval, rounded. The rounding
# is ambiguous if the ratio is closer to a half-integer than this value
MAX_INTERVAL_RATIO_DISTANCE_FROM_HALF_INTEGER = 0.05
# Maximum interval (s) for the inversion of EKF2's low-pass filter of optical flow
MAX_FLOW_INTERVAL_S = 0.5
# Aiding sources of horizontal position and velocity, without external vision position
OTHER_HORIZONTAL_AIDS = (
    "gnss_pos",
    "gnss_vel",
    "optical_flow",
    "ev_vel",
    "aux_global_position",
    "airspeed",
)
VARIANCES_NOT_LOGGED = Unavailable(
    "EKF2 variances",
    "estimator_states (estimator_status before v1.12) is not logged or not usable",
    f"{DEFAULT_PROFILE_REMEDY} Wait until EKF2 has started.",
)
# Reset counters in vehicle_local_position, with the reset quantity and the columns of the change
# (north, east, down)
_RESET_COUNTERS: dict[str, tuple[Literal["position", "velocity"], list[str]]] = {
    "xy_reset_counter": ("position", ["delta_north_m", "delta_east_m", ""]),
    "z_reset_counter": ("position", ["", "", "delta_down_m"]),
    "vxy_reset_counter": ("velocity", ["delta_north_m_s", "delta_east_m_s", ""]),
    "vz_reset_counter": ("velocity", ["", "", "delta_down_m_s"]),
}


def read_ekf2(topics: Topics) -> Ekf2 | Unavailable:
    """Read EKF2's published state, variances, innovations and fusion flags."""
    parameters = topics.log.parameters
    if parameters.get("EKF2_EN") == 0.0:
        return Unavailable("EKF2", "EKF2 did not run, because EKF2_EN is 0", "Set EKF2_EN to 1.")
    if (estimator_group := parameters.get("SYS_MC_EST_GROUP", 2.0)) != 2.0:
        return Unavailable(
            "EKF2",
            f"another estimator was running, because SYS_MC_EST_GROUP is {estimator_group:.0f}",
            "Set SYS_MC_EST_GROUP to 2 (EKF2).",
        )
    local_position = topics.read(LOCAL_POSITION_LAYOUT)
    if topics.find_layout(LOCAL_POSITION_LAYOUT) is None:
        return Unavailable("EKF2", "vehicle_local_position is not logged", DEFAULT_PROFILE_REMEDY)
    state = local_position[Columns.STATE].dropna()
    if state.empty:
        return Unavailable(
            "EKF2",
            "vehicle_local_position has no finite sample",
            "Start the recording after EKF2 has started.",
        )
    topics.record_data_source("ekf2_state", LOCAL_POSITION_LAYOUT.topic)
    aid_enabled_flags = read_enabled_aids(topics)
    fusion_flags = _read_fusion_flags(topics, aid_enabled_flags)
    vision_gate = fill_parameters_with_defaults(parameters)[EV_POS.gate]
    aids = read_aids(topics, aid_enabled_flags)
    notes: tuple[str, ...] = ()
    innovations, innovation_topics = collect_innovations_by_axis(aids, fusion_flags, vision_gate)
    if innovation_topics:
        topics.record_data_source("ekf2_innovations", *innovation_topics)
        topic = innovation_topics[0]
        if not any("timestamp_sample" in table for table in topics.tables_of(topic)):
            notes = (
                f"{topic} has no measurement times, so the times of EKF2 innovations are "
                "publication times (up to 0.2 s late)",
            )
    status_flags = aid_enabled_flags | {
        name: local_position[name] for name in VALIDITY_FLAGS if name in local_position
    }
    failed_gnss_checks = topics.primary_samples(TOPIC_LAYOUTS["gnss_checks"])["failed"].dropna()
    if len(failed_gnss_checks):
        status_flags["failed_checks"] = failed_gnss_checks
    step_s = _estimate_prediction_interval_s(topics)
    horizon_state = _read_horizon_state(topics, step_s)
    return Ekf2(
        state=state,
        variance=_select_variance(topics, horizon_state),
        innovations=innovations,
        innovation_topics=innovation_topics,
        fusion_flags=fusion_flags,
        resets=read_resets(local_position),
        primary_instances=topics.primary_instances,
        gate=vision_gate,
        notes=notes,
        accelerometer_bias=_read_accelerometer_bias(topics, horizon_state),
        step_s=step_s,
        horizon_s=_compute_horizon_delay_s(topics, step_s),
        record=_read_fusion_record(
            topics, horizon_state, local_position, aid_enabled_flags, step_s
        ),
        aids=aids,
        status_flags=status_flags,
        parameters=topics.ekf2_parameters,
        parameter_changes=topics.parameter_changes,
    )


def _select_variance(topics: Topics, horizon_state: TableOrUnavailable) -> TableOrUnavailable:
    """Return the variances of position and velocity, which are logged at the fusion horizon."""
    if isinstance(horizon_state, Unavailable):
        return horizon_state
    variance = horizon_state[Columns.POSITION_VARIANCE + Columns.VELOCITY_VARIANCE]
    variance = variance[(variance > 0.0).all(axis=1)]
    if variance.empty:
        return VARIANCES_NOT_LOGGED
    topics.record_data_source("ekf2_variance", _find_state_vector(topics)[0])
    return variance


def _find_state_vector(topics: Topics) -> tuple[str, int]:
    """Return the topic with EKF2's state vector, and its number of attitude variances.

    The topic is "" if it is not logged. The number is 0 if the lengths of the logged arrays
    ``states`` and ``covariances`` match no supported PX4 release.
    """
    for topic in STATE_VECTOR_TOPICS:
        table = topics.first_table(topic)
        state_count = sum(name.startswith("states[") for name in table)
        variance_count = sum(name.startswith("covariances[") for name in table)
        if variance_count:
            return topic, ATTITUDE_VARIANCE_COUNT_BY_ARRAY_LENGTHS.get(
                (state_count, variance_count), 0
            )
    return "", 0


def _read_horizon_state(topics: Topics, step_s: float) -> TableOrUnavailable:
    """Read EKF2's state and variances at the fusion horizon.

    Older PX4 releases log variances of the quaternion, and IMU biases per prediction. The biases
    are divided by the interval ``step_s``.
    """
    topic, attitude_variance_count = _find_state_vector(topics)
    if not topic:
        return VARIANCES_NOT_LOGGED
    if not attitude_variance_count:
        return Unavailable(
            "EKF2 variances",
            f"no supported PX4 release has states and covariances of these lengths in {topic}",
            "Report the PX4 version in an issue of px4fuse.",
        )
    has_quaternion_variances = attitude_variance_count == QUATERNION_VARIANCE_COUNT
    variance_columns = Columns.FUSION_HORIZON_VARIANCE
    if has_quaternion_variances:
        quaternion_variances = [f"{component}_variance" for component in Columns.QUATERNION]
        variance_columns = quaternion_variances + Columns.FUSION_HORIZON_VARIANCE[3:]
    fields = {name: f"states[{i}]" for i, name in enumerate(Columns.FUSION_HORIZON_STATE)}
    fields |= {name: f"covariances[{i}]" for i, name in enumerate(variance_columns)}
    samples = topics.primary_samples(MessageLayout(topic, fields)).dropna()
    samples = samples[(samples[variance_columns] >= 0.0).all(axis=1)].copy()
    if has_quaternion_variances:
        biases = Columns.GYRO_BIAS + Columns.ACCELEROMETER_BIAS
        samples[biases] /= step_s
        samples[[f"{bias}_squared" for bias in biases]] /= step_s**2
        samples[Columns.FUSION_HORIZON_VARIANCE[:3]] = _convert_attitude_variance(
            samples[Columns.QUATERNION].to_numpy(), samples[quaternion_variances].to_numpy()
        )
    return samples[Columns.FUSION_HORIZON_STATE + Columns.FUSION_HORIZON_VARIANCE]


def configured_step_s(topics: Topics) -> float:
    """Return the prediction interval EKF2_PREDICT_US in s."""
    return topics.log.parameters.get("EKF2_PREDICT_US", EKF2_STEP_S * 1e6) * 1e-6


def _estimate_prediction_interval_s(topics: Topics) -> float:
    """Return EKF2's actual prediction interval (s), a multiple of the IMU interval."""
    configured_interval_s = configured_step_s(topics)
    # Only the times of both topics are needed
    imu_layout, state_layout = (
        MessageLayout(topic, {"time": "timestamp"})
        for topic in (IMU_LAYOUT.topic, _find_state_vector(topics)[0])
    )
    imu_time_s = topics.read(imu_layout).index.to_numpy()
    if len(imu_time_s) < 2:
        return configured_interval_s
    interval_s = compute_median_interval_s(imu_time_s)
    if interval_s >= configured_interval_s:
        return configured_interval_s
    # A state has the time of the last IMU sample of its prediction
    imu_rows_at_prediction_ends = find_rows_of_timestamps(
        imu_time_s, topics.primary_samples(state_layout).index
    )
    # Compute sample indices from times, because IMU samples may be missing in the log
    prediction_end_indices = np.rint(
        (imu_time_s[imu_rows_at_prediction_ends] - imu_time_s[0]) / interval_s
    )
    return (
        compute_samples_per_step(configured_interval_s, interval_s, prediction_end_indices)
        * interval_s
    )


def find_rows_of_timestamps(times_s: Array, wanted_times_s: ArrayLike) -> IntArray:
    """Return the indices of ``times_s`` (increasing) that equal a wanted time, rounded to 1 µs."""
    times_us, wanted_times_us = (
        np.rint(np.multiply(times, 1e6)) for times in (times_s, wanted_times_s)
    )
    rows = np.searchsorted(times_us, wanted_times_us)
    is_inside = rows < len(times_us)
    rows, wanted_times_us = rows[is_inside], wanted_times_us[is_inside]
    return np.unique(rows[times_us[rows] == wanted_times_us])


def compute_samples_per_step(
    configured_step_s: float, imu_interval_s: float, step_ends: ArrayLike = ()
) -> int:
    """Return the number of IMU samples in one EKF2 prediction.

    It is the configured prediction interval divided by the IMU interval, rounded. Near 2.5, for
    example, both 2 and 3 are possible. Then the number is used that agrees with ``step_ends``, the
    indices of the IMU samples at which logged predictions end.

    >>> compute_samples_per_step(0.010, 0.00375), compute_samples_per_step(0.010, 0.004)
    (3, 3)
    >>> compute_samples_per_step(0.010, 0.004, [0, 4, 6, 14])
    2
    """
    interval_ratio = configured_step_s / imu_interval_s
    # 1e-6 compensates rounding errors of the IMU interval
    larger_count = max(int(interval_ratio + 0.5 + 1e-6), 1)
    smaller_count = larger_count - 1
    # If the ratio is near a half-integer such as 2.5, both counts (3 and 2) are possible
    is_ambiguous = (
        abs(interval_ratio + 0.5 - larger_count) < MAX_INTERVAL_RATIO_DISTANCE_FROM_HALF_INTEGER
    )
    samples_between_ends = np.diff(step_ends)
    if not smaller_count or not is_ambiguous or not len(samples_between_ends):
        return larger_count
    # If the log lacks predictions, the number of IMU samples between two logged predictions is a
    # multiple of the number in one prediction
    is_larger_count_possible, is_smaller_count_possible = (
        np.mean(samples_between_ends % count == 0.0) > 0.9
        for count in (larger_count, smaller_count)
    )
    return (
        smaller_count
        if is_smaller_count_possible and not is_larger_count_possible
        else larger_count
    )


def _read_accelerometer_bias(
    topics: Topics, horizon_state: TableOrUnavailable
) -> TableOrUnavailable:
    """Return EKF2's accelerometer bias (m/s²) over time, in the columns SPECIFIC_FORCE."""
    if len(bias := topics.primary_samples(TOPIC_LAYOUTS["estimator_sensor_bias"]).dropna()):
        return bias
    if isinstance(horizon_state, Unavailable) or horizon_state.empty:
        return BIAS_NOT_LOGGED
    return horizon_state[Columns.ACCELEROMETER_BIAS].set_axis(Columns.SPECIFIC_FORCE, axis=1)


def _compute_horizon_delay_s(topics: Topics, step_s: float) -> float | Unavailable:
    """Return the median delay (s) from EKF2's fusion horizon to the publication of its state.

    PX4 before v1.13 does not log the time of the fusion horizon.
    """
    delay_s = _compute_publication_delay_s(topics, _find_state_vector(topics)[0])
    if len(delay_s) and (median_delay_s := float(delay_s.median())) > step_s:
        return median_delay_s
    return HORIZON_NOT_LOGGED


def _compute_publication_delay_s(topics: Topics, topic: str) -> pd.Series:
    """Return the delay (s) from measurement to publication, indexed by measurement time (s)."""
    table = topics.first_table(topic)
    if "timestamp_sample" not in table:
        return pd.Series(dtype=np.float64)
    sample_times_us = get_measurement_times_us(table)
    delay_us = table["timestamp"].astype(np.int64) - sample_times_us
    sample_times_s = (sample_times_us - topics.time_origin_us) * 1e-6
    return pd.Series(delay_us * 1e-6, time_index(sample_times_s))


def _read_fusion_flags(topics: Topics, enabled_aids: StepFunctions) -> TableOrUnavailable:
    """Read EKF2's fusion flags of external vision: horizontal position, height and yaw."""
    flags = pd.DataFrame(dict(enabled_aids)).reindex(columns=["ev_pos", "ev_hgt", "ev_yaw"])
    flags = flags.set_axis(["horizontal", "vertical", "yaw"], axis=1).dropna()
    if flags.empty:
        return Unavailable(
            "EKF2 fusion flags",
            "estimator_status_flags and estimator_status are not logged or not usable",
            DEFAULT_PROFILE_REMEDY,
        )
    topic = STATUS_FLAGS_TOPIC if topics.instances(STATUS_FLAGS_TOPIC) else STATUS_TOPIC
    topics.record_data_source("ekf2_fusing", topic)
    return flags


def read_resets(local_samples: pd.DataFrame) -> tuple[Reset, ...]:
    """Return the resets of EKF2's position and velocity, from ``vehicle_local_position``."""
    resets = []
    for counter, (quantity, delta_columns) in _RESET_COUNTERS.items():
        if counter in local_samples:
            deltas = local_samples.reindex(columns=delta_columns, fill_value=0.0)
            is_reset = local_samples[counter].diff().fillna(0.0) != 0.0
            for time_s, *delta in deltas[is_reset].dropna().itertuples():
                resets.append(Reset(time_s, quantity, tuple(delta)))
    return tuple(sorted(resets, key=lambda reset: reset.time_s))


def _read_fusion_record(
    topics: Topics,
    horizon_state: TableOrUnavailable,
    local_samples: pd.DataFrame,
    enabled_aids: StepFunctions,
    step_s: float,
) -> FusionRecord | Unavailable:
    """Read the data for the EKF2 replay. ``local_samples`` are of ``vehicle_local_position``."""
    topic, attitude_variance_count = _find_state_vector(topics)
    if topic != STATE_VECTOR_TOPICS[0] or isinstance(horizon_state, Unavailable):
        return RECORD_NOT_LOGGED
    quaternion_norm = np.linalg.norm(horizon_state[Columns.QUATERNION], axis=1)
    usable_state = horizon_state[np.abs(quaternion_norm - 1.0) < 0.01].copy()
    if usable_state.empty:
        return RECORD_NOT_LOGGED
    origin = local_samples.reindex(columns=["ref_lat", "ref_alt"]).ffill().iloc[-1]
    horizontal_columns = Columns.POSITION[:2]
    altitude_m = 0.0
    # Since v1.16, EKF2 logs zeros for the horizontal position, and the negative altitude as down
    # position (ekf_helper.cpp). The altitude of the origin converts it to the local frame
    if not usable_state[horizontal_columns].to_numpy().any():
        usable_state[horizontal_columns] = np.nan
        altitude_m = float(np.nan_to_num(origin["ref_alt"]))
        usable_state["down_m"] += altitude_m
    vision_delay_s = _compute_publication_delay_s(topics, VISION_TOPIC).sort_index()
    return FusionRecord(
        parameters=topics.ekf2_parameters,
        delayed_state=usable_state,
        has_delta_angle_biases=attitude_variance_count == QUATERNION_VARIANCE_COUNT,
        other_horizontal_aids=tuple(
            # "vision velocity" is shorter than "external vision, velocity"
            AIDS[name].label.replace("external vision,", "vision")
            for name in OTHER_HORIZONTAL_AIDS
            if name in enabled_aids and enabled_aids[name].any()
        ),
        vision_age_s=vision_delay_s[~vision_delay_s.index.duplicated()],
        magnetic_field_gauss=_read_magnetic_field(topics, step_s),
        flow=_read_optical_flow(topics, enabled_aids),
        latitude_deg=float(origin["ref_lat"]),
        altitude_m=altitude_m,
        status_flags=enabled_aids,
        height_bias_updates={
            name: topics.primary_samples(layout).dropna()
            for name, layout in HEIGHT_BIAS_LAYOUT_BY_AID.items()
            if topics.find_layout(layout) is not None
        },
    )


def _read_magnetic_field(topics: Topics, step_s: float) -> pd.DataFrame:
    """Read the magnetic field (gauss, FRD) for the replay, at the times of measurement.

    The columns are the field, EKF2's innovations if logged, and fused_3d: 1 while EKF2 fuses the
    field as a vector. The table is empty if data are missing.

    The field is logged in vehicle_magnetometer and in estimator_aid_src_mag. The topic with more
    samples is used if it contains every fused sample. Otherwise, estimator_aid_src_mag is used if
    it contains innovations: they are low-pass filtered, so they give the mean field between two
    logged samples.
    """
    magnetometer, observations = (
        topics.primary_samples(TOPIC_LAYOUTS[topic]).dropna()
        for topic in ("vehicle_magnetometer", "estimator_aid_src_mag")
    )
    # EKF2 subtracts EKF2_MAG_DELAY and half a prediction interval from the times of observations.
    # Add them again, so that both topics have the times of measurement
    delay_s = topics.ekf2_parameters.get("EKF2_MAG_DELAY", 0.0) * 1e-3 + 0.5 * step_s
    observations = observations.set_axis(observations.index + delay_s)
    field = max(magnetometer, observations, key=len)
    # EKF2 fuses the field at 14 Hz. At a lower logged rate, fused samples are missing, and only the
    # innovations give the mean field between logged samples
    is_field_log_incomplete = len(field) <= MIN_MAGNETOMETER_HZ * topics.log.duration_s
    if is_field_log_incomplete and Columns.MAGNETIC_FIELD_INNOVATION[0] in observations:
        field = observations
    control_bits = topics.read(TOPIC_LAYOUTS["control_bits"])["bits"].dropna()
    if field.empty or control_bits.empty:
        return pd.DataFrame()
    flags = sample_step_function(control_bits, field.index).astype(np.int64)
    return field.assign(fused_3d=(flags >> MAG_3D_FUSION_BIT & 1).astype(float))


def _read_optical_flow(topics: Topics, enabled_aids: StepFunctions) -> pd.DataFrame:
    """Compute the mean optical flow between logged samples: inverse of EKF2's low-pass filter."""
    flow_velocity, flow_intervals, flow_noise = (
        topics.primary_samples(TOPIC_LAYOUTS[topic]).dropna()
        for topic in (
            "estimator_optical_flow_vel",
            "vehicle_optical_flow",
            "estimator_aid_src_optical_flow",
        )
    )
    interval_s = flow_intervals["interval_us"].median() * 1e-6
    if not interval_s > 0.0 or flow_noise.empty:
        return pd.DataFrame()
    # 1. Mean flow of the n samples between two logged outputs y of the low-pass filter:
    # y_k = (1 - w)^n · y_(k-1) + (1 - (1 - w)^n) · mean, with the weight w of a new sample
    steps_s = flow_velocity.index.to_series().diff()
    sample_count = np.rint(steps_s / interval_s)
    previous_output_weight = (1.0 - FLOW_FILTER_NEW_SAMPLE_WEIGHT) ** sample_count
    filtered_velocity = flow_velocity[["forward_m_s", "right_m_s"]]
    previous_output_term = filtered_velocity.shift().mul(previous_output_weight, axis=0)
    flow = (filtered_velocity - previous_output_term).div(1.0 - previous_output_weight, axis=0)
    # 2. Noise variance: it is logged in (rad/s)². The range to the ground, velocity ÷ flow rate of
    # the newest sample, converts it to (m/s)²
    newest_velocity = flow_velocity[["newest_forward_m_s", "newest_right_m_s"]]
    flow_rate = flow_velocity[["x_rad_s", "y_rad_s"]]
    squared_range_m2 = (newest_velocity**2).sum(axis=1) / (flow_rate**2).sum(axis=1)
    noise_rad2_s2 = np.interp(flow.index, flow_noise.index, flow_noise["noise"])
    flow = flow.assign(
        samples=sample_count,
        interval_s=interval_s,
        noise_m2_s2=squared_range_m2 * noise_rad2_s2,
    )
    is_used = (steps_s > 0.5 * interval_s) & (steps_s <= MAX_FLOW_INTERVAL_S)
    if FLOW.name in enabled_aids:
        is_used &= sample_step_function(enabled_aids[FLOW.name], flow.index) > 0.0
    # If the flow rate is zero, the range to the ground is infinite: drop the sample
    return flow[is_used].replace(np.inf, np.nan).dropna()


def _convert_attitude_variance(quaternion: Array, variance: Array) -> Array:
    """Convert quaternion variances to variances (rad²) of the attitude error about the NED axes.

    The attitude error is δθ = 2 Im(δq ⊗ q*). Correlations are not logged and assumed to be zero.
    """
    w, x, y, z = quaternion.T
    attitude_error_jacobian = np.array([[-x, w, -z, y], [-y, z, w, -x], [-z, -y, x, w]])
    return np.asarray(4.0 * np.einsum("ijn,nj->ni", attitude_error_jacobian**2, variance))
