"""EKF2 topics of PX4 v1.16 with the results of px4fuse's EKF2 model."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from px4fuse.core.arrays import Array, BoolArray, IntArray
from px4fuse.ekf2.filter_recursion import HORIZONTAL_POSITION, POSITION_COLUMNS, SegmentRun
from px4fuse.ekf2.inputs import Inputs
from px4fuse.ekf2.replay_segments import POSITION
from px4fuse.flight.ekf2_parameters import BAROMETER, GNSS_POS, GNSS_VEL, MAG, Aid
from px4fuse.readers.px4_ekf2 import MAG_3D_BIT
from px4fuse.readers.px4_positions import unproject
from px4fuse.simulation import sensors
from px4fuse.simulation.ulog_writer import Topic, topic

# Logging rate (Hz) of estimator_aid_src_ev_pos on a vehicle (PX4 v1.16, logged_topics.cpp); PX4's
# simulation (SITL) logs all messages
VEHICLE_AID_SOURCE_HZ = 2.0
# Logging rates (Hz) of EKF2 topics and vehicle_magnetometer on a vehicle (PX4 v1.16,
# logged_topics.cpp)
STATES_HZ = 2.0
LOCAL_POSITION_HZ = 10.0
FLAGS_HZ = 1.0
MAGNETOMETER_HZ = 2.0
OTHER_AIDS_HZ = 2.0
# Time (µs) from the newest IMU sample to the publication of vehicle_local_position
PUBLICATION_DELAY_US = 100


@dataclass(frozen=True)
class TopicTrack:
    """Results of the EKF2 model at the ends of its n prediction steps, shape (n + 1, ...).

    Attributes
    ----------
    time_us : ndarray of int
        Times of the steps, µs from the first data.
    lag_steps : int
        Number of prediction steps from the fusion horizon to the publication.
    delayed_attitude, delayed_states : ndarray
        Quaternions, and velocity, position, gyro and accelerometer bias, at the fusion horizon.
    velocity_m_s, position_m, attitude : ndarray
        State that the output predictor publishes.
    resets : tuple of (int, ndarray)
        Step and size (m, north and east) of each reset of the published position.
    is_step_aided : ndarray of bool
        True at steps with an aiding source that was fused within NO_AID_TIMEOUT_S.
    """

    time_us: IntArray
    lag_steps: int
    delayed_attitude: Array
    delayed_states: Array
    velocity_m_s: Array
    position_m: Array
    attitude: Array
    resets: tuple[tuple[int, Array], ...]
    is_step_aided: BoolArray

    def timestamps(self, steps: IntArray, measured_s: Array | None = None) -> dict[str, Any]:
        """Return the timestamps of messages that EKF2 publishes after the prediction ``steps``.

        ``measured_s`` are the measurement times (s), by default the times of the steps.
        """
        sample_us = self.time_us[steps]
        if measured_s is not None:
            sample_us = np.rint(measured_s * 1e6).astype(np.int64)
        return sensors.timestamps(sample_us, self.time_us[steps + self.lag_steps] - sample_us)

    def logged_events(self, is_message: BoolArray, end_step: IntArray, rate_hz: float) -> IntArray:
        """Return the indices of messages that a logger with a rate limit (Hz) writes."""
        is_published = end_step < len(self.time_us) - self.lag_steps
        events = np.flatnonzero(is_message & is_published)
        times_s = sensors.seconds(self.time_us[end_step[events]])
        return events[sensors.keep_at_rate(times_s, rate_hz)]


def ekf2_topics(
    inputs: Inputs,
    model_run: SegmentRun,
    track: TopicTrack,
    attitude_hz: float,
    aid_source_hz: float,
) -> tuple[Topic, ...]:
    """Return the EKF2 topics of a flight, without empty ones.

    ``attitude_hz`` is the rate of vehicle_attitude, and ``aid_source_hz`` the rate at which
    estimator_aid_src_ev_pos is logged (0: all messages).
    """
    topics = (
        _local_position_topic(inputs, track),
        _states_topic(inputs, model_run, track),
        *_position_aid_topics(inputs, model_run, track, aid_source_hz),
        *_barometer_topics(inputs, model_run, track),
        *_magnetometer_topics(inputs, model_run, track, attitude_hz),
        _flags_topic(inputs, model_run, track),
    )
    return tuple(topic for topic in topics if len(topic.fields["timestamp"]))


def _local_position_topic(inputs: Inputs, track: TopicTrack) -> Topic:
    rows = np.flatnonzero(sensors.keep_at_rate(sensors.seconds(track.time_us), LOCAL_POSITION_HZ))
    steps = np.array([step for step, _ in track.resets], dtype=np.intp)
    resets_m = np.array([[0.0, 0.0], *(reset_m for _, reset_m in track.resets)])
    reset_count = np.searchsorted(steps, rows, side="right")
    fields = sensors.timestamps(track.time_us[rows], PUBLICATION_DELAY_US)
    fields |= sensors.vectors({"": track.position_m[rows], "v": track.velocity_m_s[rows]})
    is_step_aided = track.is_step_aided[np.maximum(rows - track.lag_steps, 0)]
    fields |= {"delta_xy": resets_m[reset_count], "xy_reset_counter": reset_count % 256}
    fields |= dict.fromkeys(("xy_valid", "v_xy_valid"), is_step_aided)
    if inputs.aid == GNSS_POS:
        fields |= dict(zip(("ref_lat", "ref_lon", "ref_alt"), sensors.HOME_POSITION, strict=True))
    return topic("vehicle_local_position", fields)


def _states_topic(inputs: Inputs, model_run: SegmentRun, track: TopicTrack) -> Topic:
    """Make estimator_states as PX4 v1.16 logs it: horizontal positions are 0."""
    end_step = model_run.events[0].end_step
    events = track.logged_events(np.diff(end_step, prepend=0) > 0, end_step, STATES_HZ)
    rows = end_step[events]
    states = np.zeros((len(rows), 25), np.float32)
    states[:, 0:4] = track.delayed_attitude[rows]
    states[:, 4 : 4 + track.delayed_states.shape[1]] = track.delayed_states[rows]
    states[:, 7:9] = 0.0  # v1.16 logs latitude and longitude instead of horizontal positions
    if inputs.aid == GNSS_POS:
        # with a global origin, v1.16 logs the altitude instead of the down position
        states[:, 9] -= sensors.HOME_POSITION[2]
    covariances = np.zeros((len(rows), 24), np.float32)
    covariances[:, : model_run.variance.shape[2]] = model_run.variance[events + 1, 0]
    fields = track.timestamps(rows) | {"states": states, "covariances": covariances}
    return topic("estimator_states", fields)


def _position_aid_topics(
    inputs: Inputs, model_run: SegmentRun, track: TopicTrack, rate_hz: float
) -> tuple[Topic, ...]:
    """Make estimator_aid_src_* of the position source, with one message per usable position."""
    events, run, received = model_run.events[0], model_run, inputs.received
    velocity_m_s = received.velocity_m_s
    event_rows = track.logged_events(events.usable, events.end_step, rate_hz)
    steps, sample_indices = events.end_step[event_rows], events.sample[event_rows]
    timestamps = track.timestamps(steps, events.time_s[event_rows])
    measured_m = received.position_m[sample_indices, :2]
    north, east = measured_m.T
    innovation_arrays = (run.innovation, run.innovation_variance, run.noise)
    innovation, innovation_variance, noise_variance = (
        values[event_rows, 0, POSITION_COLUMNS] for values in innovation_arrays
    )
    # EKF2 also logs an innovation for positions that it does not test, but the model computes none
    innovation, innovation_variance = np.where(
        np.isnan(innovation[:, :1]),
        (
            measured_m - track.delayed_states[steps][:, POSITION][:, :2],
            run.variance[event_rows + 1, 0, HORIZONTAL_POSITION] + noise_variance,
        ),
        (innovation, innovation_variance),
    )
    fused_us = np.where(
        run.fused[event_rows, 0] | run.reset[event_rows, 0], track.time_us[steps], -1
    )
    newest_fused_us = np.maximum.accumulate(fused_us)
    last_fused_us = np.where(newest_fused_us >= 0, sensors.START_US + newest_fused_us, 0)
    observed = north, east
    if velocity_m_s is not None:
        observed = unproject(north, east, sensors.HOME_POSITION[:2])
    position_topic = _aid_source_topic(
        inputs.aid,
        inputs.settings,
        timestamps | {"time_last_fuse": last_fused_us},
        np.stack(observed, axis=1),
        (innovation, innovation_variance, noise_variance),
        (run.rejected[event_rows, 0], run.fused[event_rows, 0]),
    )
    if velocity_m_s is None:
        return (position_topic,)
    velocity_innovation, velocity_innovation_variance, velocity_noise = (
        values[event_rows, 0, :3] for values in innovation_arrays
    )
    is_outside_gate = np.any(
        velocity_innovation**2 > inputs.settings[GNSS_VEL.gate] ** 2 * velocity_innovation_variance,
        axis=1,
    )
    return position_topic, _aid_source_topic(
        GNSS_VEL,
        inputs.settings,
        timestamps,
        velocity_m_s[sample_indices],
        (velocity_innovation, velocity_innovation_variance, velocity_noise),
        (is_outside_gate, ~is_outside_gate & np.isfinite(velocity_innovation).all(axis=1)),
    )


def _barometer_topics(inputs: Inputs, model_run: SegmentRun, track: TopicTrack) -> list[Topic]:
    """Make estimator_aid_src_baro_hgt; the list is empty without barometer."""
    heights, end_step = model_run.segment.heights, model_run.events[0].end_step
    if heights is None or model_run.heights is None:
        return []
    update_rows = model_run.heights.updates(BAROMETER.name, 0, end_step.astype(float))
    update_rows = update_rows[
        update_rows["fused_at_s"] < len(track.time_us) - track.lag_steps
    ].iloc[1:]
    update_rows = update_rows[sensors.keep_at_rate(update_rows.index.to_numpy(), OTHER_AIDS_HZ)]
    innovation, innovation_variance, is_rejected, is_fused, rows = update_rows.to_numpy().T
    measured_s, steps = update_rows.index.to_numpy(), rows.astype(np.intp)
    measured_m = (
        heights.down_m[np.searchsorted(heights.measured_at_s, measured_s)]
        - sensors.HOME_POSITION[2]
    )
    noise_variance = np.full(len(steps), inputs.settings[BAROMETER.noise] ** 2)
    return [
        _aid_source_topic(
            BAROMETER,
            inputs.settings,
            track.timestamps(steps, measured_s),
            measured_m,
            (innovation, innovation_variance, noise_variance),
            (is_rejected > 0, is_fused > 0),
        )
    ]


def _magnetometer_topics(
    inputs: Inputs, model_run: SegmentRun, track: TopicTrack, attitude_hz: float
) -> list[Topic]:
    """Make the topics that need a magnetometer; the list is empty without magnetometer."""
    field, settings = model_run.segment.field, inputs.settings
    end_step = model_run.events[0].end_step
    if field is None:
        return []
    has_sample = np.isfinite(model_run.magnetometer_updates[:, 2, 0, 0])
    event_rows = track.logged_events(has_sample, end_step, OTHER_AIDS_HZ)
    rows = end_step[event_rows]
    innovation, innovation_variance, fused_fraction = np.moveaxis(
        model_run.magnetometer_updates[event_rows, :, 0], 1, 0
    )
    observed_gauss = field.value[np.searchsorted(field.step, rows, side="right") - 1]
    noise_variance = np.full(innovation.shape, settings[MAG.noise] ** 2)
    is_fused = fused_fraction[:, 0] > 0.0
    published_rows, status_rows = (
        np.flatnonzero(sensors.keep_at_rate(sensors.seconds(time_us), rate_hz))
        for time_us, rate_hz in (
            (track.time_us, attitude_hz),
            (track.time_us[: -track.lag_steps], FLAGS_HZ),
        )
    )
    return [
        sensors.attitude_topic(
            "vehicle_attitude",
            track.time_us[published_rows],
            PUBLICATION_DELAY_US,
            track.attitude[published_rows],
        ),
        _aid_source_topic(
            MAG,
            settings,
            track.timestamps(rows),
            observed_gauss,
            (innovation, innovation_variance, noise_variance),
            (~is_fused, is_fused),
        ),
        topic(
            "estimator_status",
            track.timestamps(status_rows) | {"control_mode_flags": 1 << MAG_3D_BIT},
        ),
    ]


def _aid_source_topic(
    aid: Aid,
    settings: Mapping[str, float],
    timestamps: Mapping[str, Any],
    observation: Array,
    innovation_values: tuple[Array, Array, Array],
    decisions: tuple[BoolArray, BoolArray],
) -> Topic:
    """Return estimator_aid_src_* of an aiding source.

    ``innovation_values`` are innovation, its variance S, and the measurement variance R.
    ``decisions`` are masks of rejected and of fused samples.
    """
    innovation, innovation_variance, noise_variance = innovation_values
    test_ratio = innovation**2 / (max(settings[aid.gate], 1.0) ** 2 * innovation_variance)
    fields = {
        **timestamps,
        "observation": observation,
        "observation_variance": noise_variance,
        "innovation": -innovation,
        "innovation_variance": innovation_variance,
        "test_ratio": test_ratio,
        "innovation_rejected": decisions[0],
        "fused": decisions[1],
    }
    return topic(f"estimator_aid_src_{aid.name}", fields)


def _flags_topic(inputs: Inputs, model_run: SegmentRun, track: TopicTrack) -> Topic:
    """Make estimator_status_flags: once a second, and when fusion starts or stops."""
    events, run, time_s = model_run.events[0], model_run, model_run.segment.time_s
    fusion_attempts = np.flatnonzero(run.fused[:, 0] | run.rejected[:, 0] | run.reset[:, 0])
    is_fusing = np.zeros(len(time_s), np.bool_)
    next_attempts_s = np.append(time_s[events.end_step[fusion_attempts]], np.inf)[1:]
    for step, next_attempt_s in zip(
        events.end_step[fusion_attempts].tolist(), next_attempts_s.tolist(), strict=True
    ):
        stop_s = time_s[step] + inputs.rules.stop_timeout_s
        is_fusing[step : int(np.searchsorted(time_s, min(next_attempt_s, stop_s)))] = True
    has_changed = np.diff(is_fusing.astype(int), prepend=0) != 0
    is_logged = has_changed | sensors.keep_at_rate(time_s, FLAGS_HZ)
    rows = np.flatnonzero(is_logged[: len(time_s) - track.lag_steps])
    is_gnss = inputs.aid == GNSS_POS
    fields = track.timestamps(rows) | {
        "control_status_changes": np.cumsum(has_changed)[rows],
        "cs_gnss_pos": is_fusing[rows] & is_gnss,
        "cs_ev_pos": is_fusing[rows] & (not is_gnss),
        "cs_mag_hdg" if model_run.segment.field is None else "cs_mag_3d": True,
    }
    return topic(
        "estimator_status_flags", fields | ({"cs_gnss_vel": is_fusing[rows]} if is_gnss else {})
    )
