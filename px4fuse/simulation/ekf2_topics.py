"""Conversion of a run of the EKF2 model to topics of PX4 v1.16."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from px4fuse.arrays import Array, BoolArray, IntArray
from px4fuse.ekf2.filter_recursion import EAST, NORTH, POSITION_COLUMNS, SegmentRun
from px4fuse.ekf2.inputs import Inputs
from px4fuse.ekf2.replay_segments import POSITION
from px4fuse.ekf2_parameters import BAROMETER, GNSS_POS, GNSS_VEL, MAG, Aid
from px4fuse.readers.px4_ekf2 import MAG_3D_BIT
from px4fuse.readers.px4_positions import unproject
from px4fuse.simulation import sensors
from px4fuse.simulation.ulog_writer import Topic, topic

# Hz; logging rates of v1.16 (logged_topics.cpp). PX4's simulation logs estimator_aid_src_ev_pos at
# full rate, a vehicle at 2 Hz
VEHICLE_AID_SOURCE_HZ = 2.0
STATES_HZ, LOCAL_POSITION_HZ, FLAGS_HZ = 2.0, 10.0, 1.0
MAGNETOMETER_HZ, OTHER_AIDS_HZ = 2.0, 2.0
PUBLICATION_DELAY_US = 100


@dataclass(frozen=True)
class TopicTrack:
    """Output of the model at the end of each prediction step, shape (n + 1, ...).

    Attributes
    ----------
    time_us : ndarray of int
        Since the first data.
    lag : int
        Steps from the fusion horizon to the publication.
    delayed_attitude, delayed : ndarray
        Quaternions; velocity, position and both biases at the fusion horizon, by their time of
        validity.
    velocity_m_s, position_m, attitude : ndarray
        Published state.
    resets : tuple of (int, ndarray)
        Step and size (m, north and east) of each reset of the published position.
    aided : ndarray of bool
        True while positions were fused recently enough for a valid position.
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

    def timestamps(self, rows: IntArray, measured_at_s: Array | None = None) -> dict[str, Any]:
        """Return the timestamps of messages about some steps, with their measurement times (s)."""
        sampled_us = self.time_us[rows]
        if measured_at_s is not None:
            sampled_us = np.rint(measured_at_s * 1e6).astype(np.int64)
        return sensors.timestamps(sampled_us, self.time_us[rows + self.lag] - sampled_us)


def ekf2_topics(
    inputs: Inputs,
    model_run: SegmentRun,
    track: TopicTrack,
    attitude_hz: float,
    aid_source_hz: float,
) -> tuple[Topic, ...]:
    """Return the topics of EKF2, without empty ones.

    Parameters
    ----------
    model_run : SegmentRun
        Run of one variant in one segment.
    attitude_hz : float
        Rate of vehicle_attitude, which EKF2 estimates if it fuses a magnetometer.
    aid_source_hz : float
        Logging rate of estimator_aid_src_ev_pos; 0: all messages.
    """
    topics = (
        _local_position_topic(track, gnss=inputs.aid == GNSS_POS),
        _states_topic(model_run, track, gnss=inputs.aid == GNSS_POS),
        *_aid_sources(inputs, model_run, track, aid_source_hz),
        *_barometer_topics(inputs, model_run, track),
        *(
            []
            if model_run.segment.field is None
            else _magnetometer_topics(inputs, model_run, track, attitude_hz)
        ),
        _flags_topic(inputs, model_run, track),
    )
    return tuple(topic for topic in topics if len(topic.fields["timestamp"]))


def _local_position_topic(track: TopicTrack, *, gnss: bool) -> Topic:
    rows = np.flatnonzero(sensors.keep_at_rate(sensors.seconds(track.time_us), LOCAL_POSITION_HZ))
    steps = np.array([step for step, _ in track.resets], dtype=np.intp)
    jumps = np.array([[0.0, 0.0], *(jump for _, jump in track.resets)])
    count = np.searchsorted(steps, rows, side="right")
    fields = sensors.timestamps(track.time_us[rows], PUBLICATION_DELAY_US)
    fields |= sensors.vectors({"": track.position_m[rows], "v": track.velocity_m_s[rows]})
    aided = track.aided[np.maximum(rows - track.lag, 0)]
    fields |= {"delta_xy": jumps[count], "xy_reset_counter": count % 256}
    fields |= dict.fromkeys(("xy_valid", "v_xy_valid"), aided)
    if gnss:
        fields |= dict(zip(("ref_lat", "ref_lon", "ref_alt"), sensors.HOME, strict=True))
    return topic("vehicle_local_position", fields)


def _states_topic(model_run: SegmentRun, track: TopicTrack, *, gnss: bool) -> Topic:
    """Return estimator_states of v1.16: 25 states and 24 variances, horizontal positions as 0."""
    end = model_run.events[0].end_step
    events = np.flatnonzero(np.diff(end, prepend=0) > 0)
    events = events[end[events] < len(track.time_us) - track.lag]
    events = events[sensors.keep_at_rate(sensors.seconds(track.time_us[end[events]]), STATES_HZ)]
    rows = end[events]
    states = np.zeros((len(rows), 25), np.float32)
    states[:, 0:4] = track.delayed_attitude[rows]
    states[:, 4 : 4 + track.delayed.shape[1]] = track.delayed[rows]
    states[:, 7:9] = 0.0  # v1.16 stores horizontal positions as latitude and longitude
    if gnss:
        # the vertical position is an altitude if there is an origin
        states[:, 9] -= sensors.HOME[2]
    covariances = np.zeros((len(rows), 24), np.float32)
    covariances[:, : model_run.variance.shape[2]] = model_run.variance[events + 1, 0]
    fields = track.timestamps(rows) | {"states": states, "covariances": covariances}
    return topic("estimator_states", fields)


def _aid_sources(
    inputs: Inputs, model_run: SegmentRun, track: TopicTrack, rate_hz: float
) -> tuple[Topic, ...]:
    """Return estimator_aid_src_*: one message per sample that arrived in time."""
    events, run, aid = model_run.events[0], model_run, inputs.aid
    event_rows = np.flatnonzero(events.usable & (events.end_step < len(track.time_us) - track.lag))
    event_rows = event_rows[
        sensors.keep_at_rate(sensors.seconds(track.time_us[events.end_step[event_rows]]), rate_hz)
    ]
    rows, sample, received = events.end_step[event_rows], events.sample[event_rows], inputs.received
    aid_stamps = track.timestamps(rows, events.time_s[event_rows])
    measured = received.position_m[sample, :2]
    north, east = measured.T
    innovation_arrays = (run.innovation, run.innovation_variance, run.noise)
    innovation, variance, noise = (
        each[event_rows, 0, POSITION_COLUMNS] for each in innovation_arrays
    )
    idle = np.isnan(innovation[:, :1])
    # while not fused, the innovation refers to the current state
    innovation = np.where(idle, measured - track.delayed[rows][:, POSITION][:, :2], innovation)
    variance = np.where(idle, run.variance[event_rows + 1, 0, NORTH : EAST + 1] + noise, variance)
    used = np.where(run.fused[event_rows, 0] | run.reset[event_rows, 0], track.time_us[rows], -1)
    last = np.maximum.accumulate(used)
    last_us = np.where(last >= 0, sensors.START_US + last, 0)
    gnss = received.velocity_m_s is not None
    observed = unproject(north, east, sensors.HOME[:2]) if gnss else (north, east)
    position = _aid_source(
        aid,
        inputs.settings,
        aid_stamps | {"time_last_fuse": last_us},
        np.stack(observed, axis=1),
        (innovation, variance, noise),
        (run.rejected[event_rows, 0], run.fused[event_rows, 0]),
    )
    if received.velocity_m_s is None:
        return (position,)
    moving, spread, speed_noise = (each[event_rows, 0, :3] for each in innovation_arrays)
    outside = np.any(moving**2 > inputs.settings[GNSS_VEL.gate] ** 2 * spread, axis=1)
    return position, _aid_source(
        GNSS_VEL,
        inputs.settings,
        aid_stamps,
        received.velocity_m_s[sample],
        (moving, spread, speed_noise),
        (outside, ~outside & np.isfinite(moving).all(axis=1)),
    )


def _barometer_topics(inputs: Inputs, model_run: SegmentRun, track: TopicTrack) -> list[Topic]:
    """Return estimator_aid_src_baro_hgt, or nothing without a barometer."""
    heights, end = model_run.segment.heights, model_run.events[0].end_step
    if heights is None or model_run.heights is None:
        return []
    update_rows = model_run.heights.updates(BAROMETER.name, 0, end.astype(float))
    update_rows = update_rows[update_rows["fused_at_s"] < len(track.time_us) - track.lag].iloc[1:]
    update_rows = update_rows[sensors.keep_at_rate(update_rows.index.to_numpy(), OTHER_AIDS_HZ)]
    innovation, variance, rejected, fused, rows = update_rows.to_numpy().T
    measured_at_s, step = update_rows.index.to_numpy(), rows.astype(np.intp)
    measured = (
        heights.down_m[np.searchsorted(heights.measured_at_s, measured_at_s)] - sensors.HOME[2]
    )
    noise = np.full(len(step), inputs.settings[BAROMETER.noise] ** 2)
    return [
        _aid_source(
            BAROMETER,
            inputs.settings,
            track.timestamps(step, measured_at_s),
            measured,
            (innovation, variance, noise),
            (rejected > 0, fused > 0),
        )
    ]


def _magnetometer_topics(
    inputs: Inputs, model_run: SegmentRun, track: TopicTrack, attitude_hz: float
) -> list[Topic]:
    """Return the topics that exist with a magnetometer: attitude, innovations and status."""
    field, settings, end = model_run.segment.field, inputs.settings, model_run.events[0].end_step
    assert field is not None
    event_rows = np.flatnonzero(
        np.isfinite(model_run.field[:, 2, 0, 0]) & (end < len(track.time_us) - track.lag)
    )
    event_rows = event_rows[
        sensors.keep_at_rate(sensors.seconds(track.time_us[end[event_rows]]), OTHER_AIDS_HZ)
    ]
    rows, (innovation, variance, fused) = (
        end[event_rows],
        np.moveaxis(model_run.field[event_rows, :, 0], 1, 0),
    )
    last = field.value[np.searchsorted(field.step, rows, side="right") - 1]
    noise = np.full(innovation.shape, settings[MAG.noise] ** 2)
    taken = fused[:, 0] > 0.0
    published = np.flatnonzero(sensors.keep_at_rate(sensors.seconds(track.time_us), attitude_hz))
    status_rows = np.flatnonzero(
        sensors.keep_at_rate(sensors.seconds(track.time_us[: -track.lag]), FLAGS_HZ)
    )
    return [
        sensors.attitude_topic(
            "vehicle_attitude",
            track.time_us[published],
            PUBLICATION_DELAY_US,
            track.attitude[published],
        ),
        _aid_source(
            MAG,
            settings,
            track.timestamps(rows),
            last,
            (innovation, variance, noise),
            (~taken, taken),
        ),
        topic(
            "estimator_status",
            track.timestamps(status_rows) | {"control_mode_flags": 1 << MAG_3D_BIT},
        ),
    ]


def _aid_source(
    aid: Aid,
    settings: Mapping[str, float],
    timestamps: Mapping[str, Any],
    observation: Array,
    innovation_parts: tuple[Array, Array, Array],
    decisions: tuple[BoolArray, BoolArray],
) -> Topic:
    """Return the message of an aid.

    ``innovation_parts``: innovation, S and R; ``decisions``: rejected and fused.
    """
    innovation, variance, noise = innovation_parts
    ratio = innovation**2 / (max(settings[aid.gate], 1.0) ** 2 * variance)
    fields = {
        **timestamps,
        "observation": observation,
        "observation_variance": noise,
        "innovation": -innovation,
        "innovation_variance": variance,
        "test_ratio": ratio,
        "innovation_rejected": decisions[0],
        "fused": decisions[1],
    }
    name = f"estimator_aid_src_{aid.name}"
    return topic(name, fields, name if aid == GNSS_POS else "estimator_aid_src")


def _flags_topic(inputs: Inputs, model_run: SegmentRun, track: TopicTrack) -> Topic:
    """Return estimator_status_flags: once a second and at each start or stop of fusion."""
    events, run, time = model_run.events[0], model_run, model_run.segment.time_s
    attempts = np.flatnonzero(run.fused[:, 0] | run.rejected[:, 0] | run.reset[:, 0])
    is_fusing = np.zeros(len(time), np.bool_)
    stops = np.append(time[events.end_step[attempts]], np.inf)[1:]
    for step, stop in zip(events.end_step[attempts].tolist(), stops.tolist(), strict=True):
        until = time[step] + inputs.rules.stop_s
        is_fusing[step : int(np.searchsorted(time, min(stop, until)))] = True
    changed = np.diff(is_fusing.astype(int), prepend=0) != 0
    is_logged = changed | sensors.keep_at_rate(time, FLAGS_HZ)
    rows = np.flatnonzero(is_logged[: len(time) - track.lag])
    gnss = inputs.aid == GNSS_POS
    fields = track.timestamps(rows) | {
        "control_status_changes": np.cumsum(changed)[rows],
        "cs_gnss_pos": is_fusing[rows] & gnss,
        "cs_ev_pos": is_fusing[rows] & (not gnss),
        "cs_mag_hdg" if model_run.segment.field is None else "cs_mag_3d": True,
    }
    return topic(
        "estimator_status_flags", fields | ({"cs_gnss_vel": is_fusing[rows]} if gnss else {})
    )
