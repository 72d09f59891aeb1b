"""EKF2's part of a ULog: state, variances, innovations, resets, of the primary instance.

Source: PX4-Autopilot ``EKF2.cpp`` (PublishStates).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np
import pandas as pd

from px4fuse.ekf2_parameters import EV_POS, settings_in_force
from px4fuse.flight import (
    BIAS_NOT_LOGGED,
    EKF2_STEP_S,
    HORIZON_NOT_LOGGED,
    POSITION_VARIANCE_COLUMNS,
    SPECIFIC_FORCE_COLUMNS,
    STATE_COLUMNS,
    VELOCITY_VARIANCE_COLUMNS,
    Ekf2,
    Reset,
    Unavailable,
)
from px4fuse.readers.px4_fusion_record import read_record
from px4fuse.readers.px4_innovations import read_innovations
from px4fuse.readers.px4_instances import Instances, of_primary, primary_instances
from px4fuse.readers.px4_topics import (
    ACCELEROMETER_BIAS_STATE,
    BIAS_PER_STEP,
    CONTROL_MODE_BITS,
    COVARIANCE_OFFSETS,
    ESTIMATOR_STATES,
    FUSING,
    IMU,
    INNOVATIONS,
    LOCAL_POSITION,
    SENSOR_BIAS,
    Layout,
)
from px4fuse.readers.ulog_topics import Topics, measurement_time_us, states_and_covariances

_RESET_COUNTERS: tuple[
    tuple[Literal["position", "velocity"], str, tuple[str | None, str | None, str | None]], ...
] = (
    ("position", "xy_reset_counter", ("delta_north_m", "delta_east_m", None)),
    ("position", "z_reset_counter", (None, None, "delta_down_m")),
    ("velocity", "vxy_reset_counter", ("delta_north_m_s", "delta_east_m_s", None)),
    ("velocity", "vz_reset_counter", (None, None, "delta_down_m_s")),
)


def read_ekf2(topics: Topics) -> Ekf2 | Unavailable:
    """EKF2's output, or why there is none."""
    parameters = topics.log.parameters
    if parameters.get("EKF2_EN") == 0.0:
        return Unavailable("EKF2", "EKF2_EN is 0: EKF2 did not run", "Set EKF2_EN to 1.")
    if parameters.get("SYS_MC_EST_GROUP", 2.0) != 2.0:
        return Unavailable(
            "EKF2",
            f"SYS_MC_EST_GROUP is {parameters['SYS_MC_EST_GROUP']:.0f}: another estimator ran",
            "Set SYS_MC_EST_GROUP to 2.",
        )
    local = topics.read(LOCAL_POSITION)
    if local is None:
        return Unavailable(
            "EKF2", "no topic vehicle_local_position", "Record with SDLOG_PROFILE bit 0 (default)."
        )
    state = local[STATE_COLUMNS].dropna()
    if state.empty:
        return Unavailable(
            "EKF2", "vehicle_local_position holds no finite sample", "Wait until EKF2 has started."
        )
    instances = primary_instances(topics)
    notes: list[str] = []
    fusing = _read_fusing(topics, instances)
    gate = settings_in_force(parameters)[EV_POS.gate]
    innovations, innovation_topics = read_innovations(topics, instances, fusing, gate, notes)
    step_s = _step_s(topics)
    return Ekf2(
        state=state,
        variance=_read_variance(topics, instances),
        innovations=innovations,
        innovation_topics=innovation_topics,
        fusing=fusing,
        resets=read_resets(local),
        instances=instances,
        gate=gate,
        notes=tuple(notes),
        accelerometer_bias=_read_accelerometer_bias(topics, instances, step_s),
        step_s=step_s,
        horizon_s=_horizon_s(topics, step_s),
        record=read_record(topics, step_s, instances),
    )


def ekf2_topics(topics: Topics, ekf2: Ekf2 | Unavailable) -> Mapping[str, tuple[str, ...]]:
    """Topics behind each part that is there, by the part's name in ``Flight.streams``."""
    if isinstance(ekf2, Unavailable):
        return {}
    used = {"ekf2_state": tuple(layout.topic for layout in LOCAL_POSITION)}
    if isinstance(ekf2.variance, pd.DataFrame):
        used["ekf2_variance"] = tuple(_lengths(topics))[:1]
    if ekf2.innovation_topics:
        joined = [
            (layout.variance_topic, layout.ratio_topic)
            for layout in INNOVATIONS
            if layout.topic in ekf2.innovation_topics
        ]
        names = [*ekf2.innovation_topics, *(name for pair in joined for name in pair)]
        used["ekf2_innovations"] = tuple(n for n in dict.fromkeys(names) if topics.instances(n))
    layout = topics.find(FUSING)
    if isinstance(ekf2.fusing, pd.DataFrame) and layout is not None:
        used["ekf2_fusing"] = (layout.topic,)
    return used


def _lengths(topics: Topics) -> Mapping[str, tuple[int, int]]:
    """Numbers of states and of covariances of each topic that has both, best first."""
    lengths = {}
    for candidate in ESTIMATOR_STATES:
        for (name, _), table in topics.tables.items():
            if name == candidate.topic and "covariances[0]" in table:
                lengths[candidate.topic] = states_and_covariances(table)
    return lengths


def _read_variance(topics: Topics, instances: Instances) -> pd.DataFrame | Unavailable:
    """Velocity and position variances, their place decided by the lengths of the arrays."""
    for topic, length in _lengths(topics).items():
        offsets = COVARIANCE_OFFSETS.get(length)
        if offsets is None:
            return Unavailable(
                "EKF2 variances",
                f"{topic} has {length[0]} states and {length[1]} covariances, a layout unknown "
                "here",
                "Report the PX4 version to the authors of px4fuse.",
            )
        velocity, position = offsets
        columns = {
            name: f"covariances[{first + i}]"
            for first, names in (
                (position, POSITION_VARIANCE_COLUMNS),
                (velocity, VELOCITY_VARIANCE_COLUMNS),
            )
            for i, name in enumerate(names)
        }
        frame = of_primary(topics, Layout(topic, columns, ""), instances)
        frame = frame[(frame > 0.0).all(axis=1)]
        if len(frame):
            return frame
    return Unavailable(
        "EKF2 variances",
        "no usable topic estimator_states (estimator_status before v1.12)",
        "Record with SDLOG_PROFILE bit 0 (default), or EKF2 had not started.",
    )


def target_step_s(topics: Topics) -> float:
    """EKF2_PREDICT_US, in s."""
    return topics.log.parameters.get("EKF2_PREDICT_US", EKF2_STEP_S * 1e6) * 1e-6


def _step_s(topics: Topics) -> float:
    """Time between two predictions: EKF2 gathers whole IMU samples (ImuDownSampler.cpp)."""
    target = target_step_s(topics)
    imu = topics.read(IMU)
    if imu is None or len(imu) < 2:
        return target
    intervals = np.diff(imu.index.to_numpy())
    interval = float(np.median(intervals))
    return samples_per_step(target, interval) * interval if interval < target else target


def samples_per_step(target_s: float, interval_s: float) -> int:
    """IMU samples that EKF2 gathers for a prediction: the nearest whole number, halves up.

    >>> samples_per_step(0.010, 0.00375), samples_per_step(0.010, 0.004)
    (3, 3)
    """
    # stamps in µs: an interval of 4 ms must not fall to either side by rounding
    return max(int(target_s / interval_s + 0.5 + 1e-6), 1)


def _read_accelerometer_bias(
    topics: Topics, instances: Instances, step_s: float
) -> pd.DataFrame | Unavailable:
    """Accelerometer bias from its own topic, or else from the state vector.

    A state vector of 24 with 24 covariances holds it per prediction step: divided by that step.
    """
    layout = topics.find(SENSOR_BIAS)
    if layout is not None:
        own = of_primary(topics, layout, instances).dropna()
        if len(own):
            return own
    for topic, length in _lengths(topics).items():
        if length not in COVARIANCE_OFFSETS:
            continue
        columns = {
            name: f"states[{ACCELEROMETER_BIAS_STATE + i}]"
            for i, name in enumerate(SPECIFIC_FORCE_COLUMNS)
        }
        frame = of_primary(topics, Layout(topic, columns, ""), instances).dropna()
        if len(frame):
            return frame / (step_s if length in BIAS_PER_STEP else 1.0)
    return BIAS_NOT_LOGGED


def _horizon_s(topics: Topics, step_s: float) -> float | Unavailable:
    """How long after the time that it is of the delayed state is published (median).

    Releases before v1.13 stamp it with the newest IMU sample instead, so that what is left is less
    than a prediction step.
    """
    for topic in _lengths(topics):
        table = topics.tables[topic, topics.instances(topic)[0]]
        if "timestamp_sample" in table:
            measured = measurement_time_us(table).astype(np.float64)
            lag = float(np.median(table["timestamp"] - measured)) * 1e-6
            if lag > step_s:
                return lag
    return HORIZON_NOT_LOGGED


def _read_fusing(topics: Topics, instances: Instances) -> pd.DataFrame | Unavailable:
    layout = topics.find(FUSING)
    if layout is None:
        return Unavailable(
            "EKF2 fusion flags",
            "neither estimator_status_flags nor estimator_status is in the log",
            "Record with SDLOG_PROFILE bit 0 (default).",
        )
    frame = of_primary(topics, layout, instances, step=True)
    if "flags" in frame:
        frame = frame[np.isfinite(frame["flags"])]
        bits = frame["flags"].to_numpy().astype(np.int64)
        frame = pd.DataFrame(
            {name: (bits >> bit & 1).astype(float) for name, bit in CONTROL_MODE_BITS.items()},
            index=frame.index,
        )
    frame = frame[["horizontal", "vertical", "yaw"]].dropna()
    if frame.empty:
        return Unavailable(
            "EKF2 fusion flags", f"{layout.topic} holds no usable sample", "Record again."
        )
    return frame


def read_resets(local: pd.DataFrame) -> tuple[Reset, ...]:
    """Resets of the published state, from the counters (uint8, they wrap) and their deltas."""
    resets = []
    for quantity, counter, deltas in _RESET_COUNTERS:
        if counter not in local:
            continue
        for row in (np.flatnonzero(np.diff(local[counter].to_numpy()) != 0) + 1).tolist():
            north, east, down = (
                float(local[name].iloc[row]) if name in local else 0.0 for name in deltas
            )
            if all(np.isfinite([north, east, down])):
                resets.append(Reset(float(local.index[row]), quantity, (north, east, down)))
    return tuple(sorted(resets, key=lambda reset: reset.time_s))
