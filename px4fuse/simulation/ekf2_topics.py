"""What a flight of EKF2's model looks like in the topics of PX4 v1.16."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from px4fuse.arrays import Array, BoolArray, IntArray
from px4fuse.ekf2.inputs import Inputs
from px4fuse.ekf2.recursion import EAST, LEVEL, NORTH, Run
from px4fuse.ekf2.stretches import POSITION
from px4fuse.ekf2_parameters import BAROMETER, GNSS_POS, GNSS_VEL, MAG, Aid
from px4fuse.readers.px4_ekf2 import MAG_3D_BIT
from px4fuse.readers.px4_positions import unproject
from px4fuse.simulation import sensors
from px4fuse.simulation.ulog_writer import Topic, topic

# Rates (Hz) of v1.16 (logged_topics.cpp). PX4's own simulation logs estimator_aid_src_ev_pos at
# full rate, a vehicle only at this one
VEHICLE_AID_SOURCE_HZ = 2.0
STATES_HZ, LOCAL_POSITION_HZ, FLAGS_HZ = 2.0, 10.0, 1.0
MAGNETOMETER_HZ, OTHER_AIDS_HZ = 2.0, 2.0
PUBLISHED_LATER_US = 100


@dataclass(frozen=True)
class TopicTrack:
    """What the model did, at the end of each prediction step, shape (n + 1, ...).

    Attributes
    ----------
    time_us : ndarray of int
        Since the first data.
    lag : int
        Steps from the fusion horizon to what is published.
    delayed_attitude, delayed : ndarray
        Quaternions, and velocity, position and both biases at the horizon, by the time that they
        are of.
    velocity_m_s, position_m, attitude : ndarray
        Published.
    resets : tuple of (int, ndarray)
        Step in which the published position jumped, and by how much (m, north and east).
    aided : ndarray of bool
        Whether vision was fused lately enough for a position.
    """

    time_us: IntArray
    lag: int
    delayed_attitude: Array
    delayed: Array
    velocity_m_s: Array
    position_m: Array
    attitude: Array
    resets: tuple[tuple[int, Array], ...]
    aided: BoolArray

    def stamps(self, rows: IntArray, taken_s: Array | None = None) -> dict[str, Any]:
        """The stamps of what the filter did in some steps, with samples that were taken then."""
        sampled_us = self.time_us[rows]
        if taken_s is not None:
            sampled_us = np.rint(taken_s * 1e6).astype(np.int64)
        return sensors.stamps(sampled_us, self.time_us[rows + self.lag] - sampled_us)


def ekf2_topics(
    inputs: Inputs,
    done: Run,
    track: TopicTrack,
    attitude_hz: float,
    aid_source_hz: float,
) -> tuple[Topic, ...]:
    """The topics that EKF2 had anything to say in.

    Parameters
    ----------
    done : Run
        The model's run, of one variant in one stretch.
    attitude_hz : float
        Of vehicle_attitude, which is EKF2's where it fuses a magnetometer.
    aid_source_hz : float
        To what estimator_aid_src_ev_pos is thinned; 0 leaves it.
    """
    topics = (
        _local_position(track, gnss=inputs.aid == GNSS_POS),
        _states(done, track, gnss=inputs.aid == GNSS_POS),
        *_aid_sources(inputs, done, track, aid_source_hz),
        *_barometer(inputs, done, track),
        *([] if done.stretch.field is None else _of_field(inputs, done, track, attitude_hz)),
        _flags(inputs, done, track),
    )
    return tuple(topic for topic in topics if len(topic.fields["timestamp"]))


def _local_position(track: TopicTrack, *, gnss: bool) -> Topic:
    rows = np.flatnonzero(sensors.thinned(sensors.seconds(track.time_us), LOCAL_POSITION_HZ))
    steps = np.array([step for step, _ in track.resets], dtype=np.intp)
    jumps = np.array([[0.0, 0.0], *(jump for _, jump in track.resets)])
    count = np.searchsorted(steps, rows, side="right")
    fields = sensors.stamps(track.time_us[rows], PUBLISHED_LATER_US)
    fields |= sensors.vectors({"": track.position_m[rows], "v": track.velocity_m_s[rows]})
    aided = track.aided[np.maximum(rows - track.lag, 0)]
    fields |= {"delta_xy": jumps[count], "xy_reset_counter": count % 256}
    fields |= dict.fromkeys(("xy_valid", "v_xy_valid"), aided)
    if gnss:
        fields |= dict(zip(("ref_lat", "ref_lon", "ref_alt"), sensors.HOME, strict=True))
    return topic("vehicle_local_position", fields)


def _states(done: Run, track: TopicTrack, *, gnss: bool) -> Topic:
    """estimator_states of v1.16: 25 states with 24 covariances, positions as 0."""
    end = done.events[0].end
    events = np.flatnonzero(np.diff(end, prepend=0) > 0)
    events = events[end[events] < len(track.time_us) - track.lag]
    events = events[sensors.thinned(sensors.seconds(track.time_us[end[events]]), STATES_HZ)]
    rows = end[events]
    states = np.zeros((len(rows), 25), np.float32)
    states[:, 0:4] = track.delayed_attitude[rows]
    states[:, 4 : 4 + track.delayed.shape[1]] = track.delayed[rows]
    states[:, 7:9] = 0.0  # horizontally kept as latitude and longitude
    if gnss:
        states[:, 9] -= sensors.HOME[2]  # and downwards as altitude, where there is an origin
    covariances = np.zeros((len(rows), 24), np.float32)
    covariances[:, : done.variance.shape[2]] = done.variance[events + 1, 0]
    fields = track.stamps(rows) | {"states": states, "covariances": covariances}
    return topic("estimator_states", fields)


def _aid_sources(inputs: Inputs, done: Run, track: TopicTrack, rate_hz: float) -> tuple[Topic, ...]:
    """estimator_aid_src_*: a message for every sample that came in time."""
    events, run, aid = done.events[0], done, inputs.aid
    seen = np.flatnonzero(events.usable & (events.end < len(track.time_us) - track.lag))
    seen = seen[sensors.thinned(sensors.seconds(track.time_us[events.end[seen]]), rate_hz)]
    rows, sample, received = events.end[seen], events.sample[seen], inputs.received
    shown = track.stamps(rows, events.time_s[seen])
    measured = received.position_m[sample, :2]
    north, east = measured.T
    told = (run.innovation, run.innovation_variance, run.noise)
    innovation, variance, noise = (each[seen, 0, LEVEL] for each in told)
    idle = np.isnan(innovation[:, :1])
    # while it is not fused, against the state that there is
    innovation = np.where(idle, measured - track.delayed[rows][:, POSITION][:, :2], innovation)
    variance = np.where(idle, run.variance[seen + 1, 0, NORTH : EAST + 1] + noise, variance)
    used = np.where(run.fused[seen, 0] | run.reset[seen, 0], track.time_us[rows], -1)
    last = np.maximum.accumulate(used)
    last_us = np.where(last >= 0, sensors.START_US + last, 0)
    gnss = received.velocity_m_s is not None
    observed = unproject(north, east, sensors.HOME[:2]) if gnss else (north, east)
    position = _aid_source(
        aid,
        inputs.settings,
        shown | {"time_last_fuse": last_us},
        np.stack(observed, axis=1),
        (innovation, variance, noise),
        (run.rejected[seen, 0], run.fused[seen, 0]),
    )
    if received.velocity_m_s is None:
        return (position,)
    moving, spread, speed_noise = (each[seen, 0, :3] for each in told)
    outside = np.any(moving**2 > inputs.settings[GNSS_VEL.gate] ** 2 * spread, axis=1)
    return position, _aid_source(
        GNSS_VEL,
        inputs.settings,
        shown,
        received.velocity_m_s[sample],
        (moving, spread, speed_noise),
        (outside, ~outside & np.isfinite(moving).all(axis=1)),
    )


def _barometer(inputs: Inputs, done: Run, track: TopicTrack) -> list[Topic]:
    """What a barometer has EKF2 say: its innovations."""
    heights, end = done.stretch.heights, done.events[0].end
    if heights is None or done.heights is None:
        return []
    told = done.heights.updates(BAROMETER.name, 0, end.astype(float))
    told = told[told["fused_at_s"] < len(track.time_us) - track.lag].iloc[1:]
    told = told[sensors.thinned(told.index.to_numpy(), OTHER_AIDS_HZ)]
    innovation, variance, rejected, fused, rows = told.to_numpy().T
    taken_s, step = told.index.to_numpy(), rows.astype(np.intp)
    measured = heights.down_m[np.searchsorted(heights.taken_s, taken_s)] - sensors.HOME[2]
    noise = np.full(len(step), inputs.settings[BAROMETER.noise] ** 2)
    return [
        _aid_source(
            BAROMETER,
            inputs.settings,
            track.stamps(step, taken_s),
            measured,
            (innovation, variance, noise),
            (rejected > 0, fused > 0),
        )
    ]


def _of_field(inputs: Inputs, done: Run, track: TopicTrack, attitude_hz: float) -> list[Topic]:
    """What a magnetometer has EKF2 say: vehicle_attitude, its innovations, and that it is fused."""
    field, settings, end = done.stretch.field, inputs.settings, done.events[0].end
    assert field is not None
    seen = np.flatnonzero(
        np.isfinite(done.field[:, 2, 0, 0]) & (end < len(track.time_us) - track.lag)
    )
    seen = seen[sensors.thinned(sensors.seconds(track.time_us[end[seen]]), OTHER_AIDS_HZ)]
    rows, (innovation, variance, fused) = end[seen], np.moveaxis(done.field[seen, :, 0], 1, 0)
    last = field.value[np.searchsorted(field.step, rows, side="right") - 1]
    noise = np.full(innovation.shape, settings[MAG.noise] ** 2)
    taken = fused[:, 0] > 0.0
    published = np.flatnonzero(sensors.thinned(sensors.seconds(track.time_us), attitude_hz))
    told = np.flatnonzero(sensors.thinned(sensors.seconds(track.time_us[: -track.lag]), FLAGS_HZ))
    return [
        sensors.attitude_topic(
            "vehicle_attitude",
            track.time_us[published],
            PUBLISHED_LATER_US,
            track.attitude[published],
        ),
        _aid_source(
            MAG,
            settings,
            track.stamps(rows),
            last,
            (innovation, variance, noise),
            (~taken, taken),
        ),
        topic("estimator_status", track.stamps(told) | {"control_mode_flags": 1 << MAG_3D_BIT}),
    ]


def _aid_source(
    aid: Aid,
    settings: Mapping[str, float],
    stamps: Mapping[str, Any],
    observation: Array,
    judged: tuple[Array, Array, Array],
    decided: tuple[BoolArray, BoolArray],
) -> Topic:
    """An aid's message; ``judged`` are innovation, S and R, ``decided`` rejected and fused."""
    innovation, variance, noise = judged
    ratio = innovation**2 / (max(settings[aid.gate], 1.0) ** 2 * variance)
    fields = {
        **stamps,
        "observation": observation,
        "observation_variance": noise,
        "innovation": -innovation,
        "innovation_variance": variance,
        "test_ratio": ratio,
        "innovation_rejected": decided[0],
        "fused": decided[1],
    }
    name = f"estimator_aid_src_{aid.name}"
    return topic(name, fields, name if aid == GNSS_POS else "estimator_aid_src")


def _flags(inputs: Inputs, done: Run, track: TopicTrack) -> Topic:
    """estimator_status_flags: once a second, and when fusion of vision starts or stops."""
    events, run, time = done.events[0], done, done.stretch.time_s
    tried = np.flatnonzero(run.fused[:, 0] | run.rejected[:, 0] | run.reset[:, 0])
    on = np.zeros(len(time), np.bool_)
    stops = np.append(time[events.end[tried]], np.inf)[1:]
    for step, stop in zip(events.end[tried].tolist(), stops.tolist(), strict=True):
        until = time[step] + inputs.rules.stop_s
        on[step : int(np.searchsorted(time, min(stop, until)))] = True
    changed = np.diff(on.astype(int), prepend=0) != 0
    kept = changed | sensors.thinned(time, FLAGS_HZ)
    rows = np.flatnonzero(kept[: len(time) - track.lag])
    gnss = inputs.aid == GNSS_POS
    fields = track.stamps(rows) | {
        "control_status_changes": np.cumsum(changed)[rows],
        "cs_gnss_pos": on[rows] & gnss,
        "cs_ev_pos": on[rows] & (not gnss),
        "cs_mag_hdg" if done.stretch.field is None else "cs_mag_3d": True,
    }
    return topic("estimator_status_flags", fields | ({"cs_gnss_vel": on[rows]} if gnss else {}))
