"""EKF2's part of a ULog: state, variances, innovations, resets, of the primary instance.

Sources: PX4-Autopilot ``EKF2.cpp`` (PublishStates, PublishInnovations), ``EKF2Selector.cpp``
(primary instance), ``msg/EstimatorInnovations.msg``, ``msg/EstimatorAidSource2d.msg``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
import pandas as pd

from px4fuse.flight import (
    AXIS_NAMES,
    BIAS_NOT_LOGGED,
    EKF2_STEP_S,
    HORIZON_NOT_LOGGED,
    POSITION_VARIANCE_COLUMNS,
    SPECIFIC_FORCE_COLUMNS,
    STATE_COLUMNS,
    VELOCITY_VARIANCE_COLUMNS,
    AxisName,
    Ekf2,
    Reset,
    Unavailable,
)
from px4fuse.readers.px4_fusion_record import read_record
from px4fuse.readers.px4_topics import (
    ACCELEROMETER_BIAS_STATE,
    AID_SOURCE,
    BIAS_PER_STEP,
    CONTROL_MODE_BITS,
    COVARIANCE_OFFSETS,
    ESTIMATOR_STATES,
    FUSING,
    IMU,
    INNOVATIONS,
    LOCAL_POSITION,
    SELECTOR,
    SENSOR_BIAS,
    InnovationLayout,
    Layout,
)
from px4fuse.readers.ulog_topics import Topics, measurement_time_us

# Primary EKF2 instance from each time on
Instances = tuple[tuple[float, int], ...]
# One EKF2 instance alone publishes no selector
NO_SELECTOR: Instances = ((-np.inf, 0),)
# EKF2_EVP_GATE has had this default in every release read (v1.9 to main)
DEFAULT_GATE = 5.0
# EKF2_EV_CTRL and EKF2_AID_MASK, ekf2_params.c; EV_MAX_INTERVAL, ev_control.cpp
_HOW_TO_FUSE = {
    "horizontal": "Send the position at 10 Hz (EKF2 starts on samples less than 0.2 s apart) and "
    "set bit 0 of EKF2_EV_CTRL (bit 3 of EKF2_AID_MASK before v1.14).",
    "vertical": "Set bit 1 of EKF2_EV_CTRL (EKF2_HGT_MODE 3 before v1.14) if EKF2 is to fuse the "
    "source's height.",
}
# innovations, variances and ratios are logged by separate rate limiters, up to one interval of
# the default profile (0.5 s) apart; S changes little in that time
JOIN_TOLERANCE_S = 0.6
_RESET_COUNTERS = (
    ("position", "xy_reset_counter", ("delta_north_m", "delta_east_m", None)),
    ("position", "z_reset_counter", (None, None, "delta_down_m")),
    ("velocity", "vxy_reset_counter", ("delta_north_m_s", "delta_east_m_s", None)),
    ("velocity", "vz_reset_counter", (None, None, "delta_down_m_s")),
)
INNOVATION_COLUMNS = [
    "innovation_m",
    "innovation_variance_m2",
    "observation_variance_m2",
    "test_ratio",
    "fused",
    "rejected",
]


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
    layout = topics.find(LOCAL_POSITION)
    if layout is None:
        return Unavailable(
            "EKF2", "no topic vehicle_local_position", "Record with SDLOG_PROFILE bit 0 (default)."
        )
    local = topics.frame(layout)
    state = local[STATE_COLUMNS].dropna()
    if state.empty:
        return Unavailable(
            "EKF2", "vehicle_local_position holds no finite sample", "Wait until EKF2 has started."
        )
    instances = _primary_instances(topics)
    notes: list[str] = []
    fusing = _read_fusing(topics, instances)
    innovations, innovation_topics = _read_innovations(topics, instances, fusing, notes)
    primary = partial(of_primary, topics, instances=instances)
    return Ekf2(
        state=state,
        variance=_read_variance(topics, instances),
        innovations=innovations,
        innovation_topics=innovation_topics,
        fusing=fusing,
        resets=read_resets(local),
        instances=instances,
        gate=_gate(topics),
        notes=tuple(notes),
        accelerometer_bias=_read_accelerometer_bias(topics, instances),
        step_s=_step_s(topics),
        horizon_s=_horizon_s(topics),
        record=read_record(topics, _step_s(topics), primary),
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


def _primary_instances(topics: Topics) -> Instances:
    """Primary EKF2 instance from each time on; instance 0 where there is no selector."""
    layout = topics.find(SELECTOR)
    if layout is None:
        return NO_SELECTOR
    selected = topics.frame(layout, step=True)["instance"]
    selected = selected[selected < 255]  # 255: none selected yet
    if selected.empty:
        return NO_SELECTOR
    changes = selected[selected.ne(selected.shift())]
    times = [-np.inf, *changes.index[1:]]
    return tuple((float(time), int(number)) for time, number in zip(times, changes, strict=True))


def of_primary(
    topics: Topics, topic: str, instances: Instances, read: Callable[[int], pd.DataFrame]
) -> pd.DataFrame:
    """Rows of each instance of a topic from the times in which that instance was primary."""
    available = topics.instances(topic)
    if instances == NO_SELECTOR:
        return read(available[0])
    starts = np.array([start for start, _ in instances])
    numbers = np.array([number for _, number in instances])
    parts: list[pd.DataFrame] = []
    for number in available:
        frame = read(number)
        at = np.searchsorted(starts, frame.index.to_numpy(), side="right") - 1
        parts.append(frame[numbers[at] == number])
    joined = pd.concat(parts).sort_index()
    return joined[~joined.index.duplicated()]


def _lengths(topics: Topics) -> Mapping[str, tuple[int, int]]:
    """Numbers of states and of covariances of each topic that has both, best first."""
    lengths = {}
    for candidate in ESTIMATOR_STATES:
        for (name, _), table in topics.tables.items():
            if name == candidate.topic and "covariances[0]" in table:
                lengths[candidate.topic] = (
                    sum(column.startswith("states[") for column in table),
                    sum(column.startswith("covariances[") for column in table),
                )
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
        read = partial(topics.frame, Layout(topic, columns, ""))
        frame = of_primary(topics, topic, instances, read)
        frame = frame[(frame > 0.0).all(axis=1)]
        if len(frame):
            return frame
    return Unavailable(
        "EKF2 variances",
        "no usable topic estimator_states (estimator_status before v1.12)",
        "Record with SDLOG_PROFILE bit 0 (default), or EKF2 had not started.",
    )


def _step_s(topics: Topics) -> float:
    """Time between two predictions: EKF2 gathers whole IMU samples (ImuDownSampler.cpp)."""
    target = topics.log.parameters.get("EKF2_PREDICT_US", EKF2_STEP_S * 1e6) * 1e-6
    layout = topics.find(IMU)
    if layout is None:
        return target
    intervals = np.diff(topics.frame(layout).index.to_numpy())
    if not len(intervals):
        return target
    interval = float(np.median(intervals))
    return samples_per_step(target, interval) * interval if interval < target else target


def samples_per_step(target_s: float, interval_s: float) -> int:
    """IMU samples that EKF2 gathers for a prediction: the nearest whole number, halves up.

    >>> samples_per_step(0.010, 0.00375), samples_per_step(0.010, 0.004)
    (3, 3)
    """
    # stamps in µs: an interval of 4 ms must not fall to either side by rounding
    return max(int(target_s / interval_s + 0.5 + 1e-6), 1)


def _read_accelerometer_bias(topics: Topics, instances: Instances) -> pd.DataFrame | Unavailable:
    """Accelerometer bias from its own topic, or else from the state vector.

    A state vector of 24 with 24 covariances holds it per prediction step: divided by that step.
    """
    layout = topics.find(SENSOR_BIAS)
    if layout is not None:
        own = of_primary(topics, layout.topic, instances, partial(topics.frame, layout)).dropna()
        if len(own):
            return own
    for topic, length in _lengths(topics).items():
        if length not in COVARIANCE_OFFSETS:
            continue
        columns = {
            name: f"states[{ACCELEROMETER_BIAS_STATE + i}]"
            for i, name in enumerate(SPECIFIC_FORCE_COLUMNS)
        }
        read = partial(topics.frame, Layout(topic, columns, ""))
        frame = of_primary(topics, topic, instances, read).dropna()
        if len(frame):
            return frame / (_step_s(topics) if length in BIAS_PER_STEP else 1.0)
    return BIAS_NOT_LOGGED


def _horizon_s(topics: Topics) -> float | Unavailable:
    """How long after the time that it is of the delayed state is published (median).

    Releases before v1.13 stamp it with the newest IMU sample instead, so that what is left is less
    than a prediction step.
    """
    for topic in _lengths(topics):
        table = topics.tables[topic, topics.instances(topic)[0]]
        if "timestamp_sample" in table:
            measured = measurement_time_us(table).astype(np.float64)
            lag = float(np.median(table["timestamp"] - measured)) * 1e-6
            if lag > _step_s(topics):
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
    read = partial(topics.frame, layout, step=True)
    frame = of_primary(topics, layout.topic, instances, read)
    if "flags" in frame:
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


def step_at(steps: pd.Series, times: pd.Index) -> pd.Series:
    """Value of a step function at other times (its first value before its first step)."""
    at = np.clip(np.searchsorted(steps.index, times, side="right") - 1, 0, None)
    return pd.Series(steps.to_numpy()[at], index=times)


def _read_innovations(
    topics: Topics, instances: Instances, fusing: pd.DataFrame | Unavailable, notes: list[str]
) -> tuple[Mapping[AxisName, pd.DataFrame | Unavailable], tuple[str, ...]]:
    """Innovations per axis, from the aid-source topics or else from the older three topics."""
    found: dict[AxisName, pd.DataFrame | Unavailable] = {}
    used: dict[str, None] = {}
    for axis in AXIS_NAMES:
        if isinstance(fusing, pd.DataFrame) and not fusing[_group(axis)].any():
            found[axis] = Unavailable(
                f"EKF2 innovations, {axis}",
                f"EKF2 never fused external vision for {_position_or_height(axis)} in this log",
                _HOW_TO_FUSE[_group(axis)],
            )
            continue
        layout = topics.find(AID_SOURCE[axis])
        if layout is not None:
            frame = _read_aid_source(topics, instances, layout, fusing, axis)
            if len(frame):
                found[axis] = frame
                used[layout.topic] = None
                continue
        for older in INNOVATIONS:
            joined = _read_joined(topics, instances, older, fusing, axis, notes)
            if joined is not None and len(joined):
                found[axis] = joined
                used[older.topic] = None
                break
        else:
            found[axis] = Unavailable(
                f"EKF2 innovations, {axis}",
                "no usable estimator_aid_src_ev_pos, estimator_aid_src_ev_hgt, "
                "estimator_innovations or ekf2_innovations sample while external vision was fused",
                "Record with SDLOG_PROFILE 129 (default and vision).",
            )
    for topic in used:
        if not any("timestamp_sample" in topics.tables[topic, n] for n in topics.instances(topic)):
            notes.append(
                f"{topic} has no time of measurement in this release: EKF2's innovations carry the "
                "time of their publication, up to 0.2 s later"
            )
    return _with_rejections(found, _gate(topics)), tuple(used)


def _gate(topics: Topics) -> float:
    return topics.log.parameters.get("EKF2_EVP_GATE", DEFAULT_GATE)


def _with_rejections(
    found: dict[AxisName, pd.DataFrame | Unavailable], gate: float
) -> dict[AxisName, pd.DataFrame | Unavailable]:
    """Fill ``rejected`` where it is not logged: ν² > gate²·S, for the horizontal vector as one."""
    judged = {}
    for axis, frame in found.items():
        if isinstance(frame, pd.DataFrame):
            beyond = frame["innovation_m"] ** 2 > gate**2 * frame["innovation_variance_m2"]
            judged[axis] = frame["rejected"].fillna(beyond.astype(float))
    if "north" in judged and "east" in judged:
        either = pd.concat([judged["north"], judged["east"]], axis=1).max(axis=1)
        judged["north"] = either.reindex(judged["north"].index)
        judged["east"] = either.reindex(judged["east"].index)
    return {
        axis: frame.assign(rejected=judged[axis]) if isinstance(frame, pd.DataFrame) else frame
        for axis, frame in found.items()
    }


def _group(axis: AxisName) -> str:
    return "vertical" if axis == "down" else "horizontal"


def _position_or_height(axis: AxisName) -> str:
    return "height" if axis == "down" else "horizontal position"


def _read_aid_source(
    topics: Topics,
    instances: Instances,
    layout: Layout,
    fusing: pd.DataFrame | Unavailable,
    axis: AxisName,
) -> pd.DataFrame:
    frame = of_primary(topics, layout.topic, instances, partial(topics.frame, layout))
    if "fused" in frame and "rejected" in frame:
        attempted = (frame["fused"] > 0) | (frame["rejected"] > 0)
    elif isinstance(fusing, pd.DataFrame):
        attempted = step_at(fusing[_group(axis)], frame.index) > 0
    else:
        attempted = pd.Series(True, index=frame.index)
    frame = frame[attempted & (frame["innovation_variance_m2"] > 0) & frame["innovation_m"].notna()]
    return _flipped(frame)


def _read_joined(
    topics: Topics,
    instances: Instances,
    layout: InnovationLayout,
    fusing: pd.DataFrame | Unavailable,
    axis: AxisName,
    notes: list[str],
) -> pd.DataFrame | None:
    """Join the innovation, variance and ratio topics by time, within a stated tolerance."""
    parts: dict[str, pd.DataFrame] = {}
    wanted = {
        "innovation_m": (layout.topic, layout.fields),
        "innovation_variance_m2": (layout.variance_topic, layout.variance_fields),
        "test_ratio": (layout.ratio_topic, layout.ratio_fields),
    }
    for column, (topic, fields) in wanted.items():
        if axis not in fields:
            continue
        single = topics.find((Layout(topic, {column: fields[axis]}, layout.since),))
        if single is not None:
            read = partial(topics.frame, single)
            if column == "innovation_m":
                read = partial(_read_fresh, topics, single)
            parts[column] = of_primary(topics, topic, instances, read).dropna()
    if "innovation_m" not in parts or "innovation_variance_m2" not in parts:
        return None
    frame = parts.pop("innovation_m")
    before = len(frame)
    for column, part in parts.items():
        frame = pd.merge_asof(
            frame, part[[column]], left_index=True, right_index=True,
            direction="nearest", tolerance=JOIN_TOLERANCE_S,  # type: ignore[arg-type]
        )  # fmt: skip
    frame = frame.dropna(subset=["innovation_variance_m2"])
    if len(frame) < before:
        notes.append(
            f"{before - len(frame)} of {before} samples of {layout.topic} ({axis}) have no "
            f"{layout.variance_topic} within {JOIN_TOLERANCE_S:g} s and were left out"
        )
    frame = frame[frame["innovation_variance_m2"] > 0]
    if isinstance(fusing, pd.DataFrame) and len(frame):
        frame = frame[step_at(fusing[_group(axis)], frame.index) > 0]
    return _flipped(frame)


def _read_fresh(topics: Topics, layout: Layout, instance: int) -> pd.DataFrame:
    """Innovations of one instance without repeats and without zeros, its value before any fusion.

    These topics repeat the last fusion's value until the next one: a repeat is no new evidence.
    """
    frame = topics.frame(layout, instance)
    value = frame["innovation_m"]
    return frame[value.ne(value.shift()) & (value != 0)]


def _flipped(frame: pd.DataFrame) -> pd.DataFrame:
    """EKF2 logs state minus measurement; everyone else says measurement minus state."""
    flipped = frame.reindex(columns=INNOVATION_COLUMNS)
    flipped["innovation_m"] = -flipped["innovation_m"]
    return flipped


def read_resets(local: pd.DataFrame) -> tuple[Reset, ...]:
    """Resets of the published state, from the counters (uint8, they wrap) and their deltas."""
    resets = []
    times = local.index.to_numpy()
    for quantity, counter, deltas in _RESET_COUNTERS:
        if counter not in local:
            continue
        count = local[counter].to_numpy()
        changed = np.flatnonzero(np.diff(count) != 0) + 1
        for row in changed:
            delta = tuple(
                0.0 if name is None or name not in local else float(local[name].iloc[row])
                for name in deltas
            )
            if all(np.isfinite(delta)):
                north, east, down = delta
                time = float(times[row])
                if quantity == "position":
                    resets.append(Reset(time, "position", (north, east, down)))
                else:
                    resets.append(Reset(time, "velocity", (north, east, down)))
    return tuple(sorted(resets, key=lambda reset: reset.time_s))
