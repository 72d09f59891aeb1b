"""Conversion of the results of px4fuse's EKF2 model to the EKF2 topics that PX4 v1.16 logs."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from px4fuse.core.arrays import Array, Array32, BoolArray, IntArray
from px4fuse.ekf2.filter_recursion import (
    HORIZONTAL_POSITION_COLUMNS,
    VELOCITY_COLUMNS,
    SegmentRun,
)
from px4fuse.ekf2.inputs import ReplayInputs
from px4fuse.ekf2.replay_segments import HORIZONTAL_POSITION
from px4fuse.flight.ekf2_parameters import BAROMETER, GNSS_POS, GNSS_VEL, MAG, Aid
from px4fuse.readers.px4_ekf2 import MAG_3D_FUSION_BIT
from px4fuse.readers.px4_positions import unproject

from .sensors import (
    FIRST_TIMESTAMP_US,
    HOME_POSITION,
    is_kept_at_rate,
    make_attitude_topic,
    make_timestamps,
    split_vectors,
    to_seconds,
)
from .ulog_writer import Topic, make_topic

# Rate limit (Hz) at which PX4 logs estimator_aid_src_ev_pos on a vehicle (v1.16, logged_topics.cpp)
VEHICLE_AID_SOURCE_LOG_RATE_HZ = 2.0
# Rate limits (Hz) at which PX4 logs estimator_states, vehicle_local_position,
# estimator_status_flags and the other estimator_aid_src_* topics on a vehicle (v1.16,
# logged_topics.cpp)
STATES_LOG_RATE_HZ = 2.0
LOCAL_POSITION_LOG_RATE_HZ = 10.0
FLAGS_LOG_RATE_HZ = 1.0
OTHER_AIDS_LOG_RATE_HZ = 2.0
# Time (µs) from the newest IMU sample to the publication of vehicle_local_position
PUBLICATION_DELAY_US = 100


@dataclass(frozen=True)
class Ekf2Output:
    """States of the EKF2 model at the start and after each prediction step.

    Attributes
    ----------
    time_us : ndarray of int
        Times of the rows, µs from the first sample.
    lag_steps : int
        Number of prediction steps from the fusion horizon to the publication.
    attitude_at_fusion_horizon, states_at_fusion_horizon : ndarray
        Attitude quaternions; velocity, position and IMU biases.
    velocity_m_s, position_m, attitude : ndarray
        State that EKF2 publishes.
    reset_steps, reset_sizes_m : ndarray, shape (k,) and (k, 2)
        Step and size (north and east) of each reset of the published position.
    has_recent_position_aiding : ndarray of bool
        True if an aiding source was fused in the last NO_AID_TIMEOUT_S.
    """

    time_us: IntArray
    lag_steps: int
    attitude_at_fusion_horizon: Array
    states_at_fusion_horizon: Array
    velocity_m_s: Array
    position_m: Array
    attitude: Array
    reset_steps: IntArray
    reset_sizes_m: Array
    has_recent_position_aiding: BoolArray

    def make_timestamps(
        self, steps: IntArray, measurement_times_s: Array | None = None
    ) -> dict[str, Any]:
        """Return the timestamps of EKF2 messages after the prediction ``steps``.

        ``measurement_times_s`` are by default the times of the steps.
        """
        sample_times_us = self.time_us[steps]
        if measurement_times_s is not None:
            sample_times_us = np.rint(measurement_times_s * 1e6).astype(np.int64)
        return make_timestamps(
            sample_times_us, self.time_us[steps + self.lag_steps] - sample_times_us
        )

    def find_logged_messages(
        self, is_message_event: BoolArray, end_step: IntArray, rate_hz: float
    ) -> IntArray:
        """Return the fusion events whose messages a logger with a rate limit (Hz) writes.

        The events are given by their indices. ``is_message_event`` is True for events with a
        message. ``end_step`` contains the prediction step of each event.
        """
        is_published = end_step < len(self.time_us) - self.lag_steps
        event_indices = np.flatnonzero(is_message_event & is_published)
        times_s = to_seconds(self.time_us[end_step[event_indices]])
        return event_indices[is_kept_at_rate(times_s, rate_hz)]


def make_ekf2_topics(
    model_inputs: ReplayInputs,
    model_run: SegmentRun,
    ekf2_output: Ekf2Output,
    attitude_rate_hz: float,
    aid_source_log_rate_hz: float,
) -> tuple[Topic, ...]:
    """Return the EKF2 topics of a flight, without empty topics.

    ``attitude_rate_hz`` is the rate of vehicle_attitude. With
    ``aid_source_log_rate_hz`` 0, all messages of estimator_aid_src_ev_pos are logged.
    """
    topics = (
        _make_local_position_topic(model_inputs, ekf2_output),
        _make_states_topic(model_inputs, model_run, ekf2_output),
        *_make_position_aid_topics(model_inputs, model_run, ekf2_output, aid_source_log_rate_hz),
        *_make_barometer_topics(model_inputs, model_run, ekf2_output),
        *_make_magnetometer_topics(model_inputs, model_run, ekf2_output, attitude_rate_hz),
        _make_flags_topic(model_inputs, model_run, ekf2_output),
    )
    return tuple(topic for topic in topics if len(topic.fields["timestamp"]))


def _make_local_position_topic(model_inputs: ReplayInputs, ekf2_output: Ekf2Output) -> Topic:
    """Make vehicle_local_position from EKF2's output, at the log rate of the topic."""
    logged_steps = np.flatnonzero(
        is_kept_at_rate(to_seconds(ekf2_output.time_us), LOCAL_POSITION_LOG_RATE_HZ)
    )
    # Size of the last reset; row 0 is the size before the first reset
    reset_sizes_m = np.concatenate([np.zeros((1, 2)), ekf2_output.reset_sizes_m])
    reset_count = np.searchsorted(ekf2_output.reset_steps, logged_steps, side="right")
    # Aiding at the fusion horizon, lag_steps before the publication
    has_recent_position_aiding = ekf2_output.has_recent_position_aiding[
        np.maximum(logged_steps - ekf2_output.lag_steps, 0)
    ]
    fields = {
        **make_timestamps(ekf2_output.time_us[logged_steps], PUBLICATION_DELAY_US),
        **split_vectors(
            {"": ekf2_output.position_m[logged_steps], "v": ekf2_output.velocity_m_s[logged_steps]}
        ),
        "delta_xy": reset_sizes_m[reset_count],
        "xy_reset_counter": reset_count % 256,
        "xy_valid": has_recent_position_aiding,
        "v_xy_valid": has_recent_position_aiding,
    }
    if model_inputs.aid == GNSS_POS:
        fields |= dict(zip(("ref_lat", "ref_lon", "ref_alt"), HOME_POSITION, strict=True))
    return make_topic("vehicle_local_position", fields)


def _make_states_topic(
    model_inputs: ReplayInputs, model_run: SegmentRun, ekf2_output: Ekf2Output
) -> Topic:
    """Make estimator_states as PX4 v1.16 logs it.

    Its horizontal position is 0, because v1.16 stores latitude and longitude elsewhere.
    """
    end_step = model_run.events[0].end_step
    # one message for each prediction step with an event: fusion of a position or, in a gap of the
    # positions, of height and heading
    logged_indices = ekf2_output.find_logged_messages(
        np.diff(end_step, prepend=0) > 0, end_step, STATES_LOG_RATE_HZ
    )
    logged_steps = end_step[logged_indices]
    # 25 states: quaternion, velocity, position, IMU biases, magnetic fields, wind and terrain.
    # States that the EKF2 model does not contain are 0
    model_states = np.hstack(
        [
            ekf2_output.attitude_at_fusion_horizon[logged_steps],
            ekf2_output.states_at_fusion_horizon[logged_steps],
        ]
    )
    states = np.zeros((len(logged_steps), 25), np.float32)
    states[:, : model_states.shape[1]] = model_states
    states[:, 7:9] = 0.0  # position north and east
    if model_inputs.aid == GNSS_POS:
        # with a global origin, v1.16 logs the altitude instead of the down position
        states[:, 9] -= HOME_POSITION[2]
    # 24 variances: the attitude has 3, about the NED axes
    variances = np.zeros((len(logged_steps), 24), np.float32)
    # row 0 of the variances is before the first event, so the row after event i is i + 1
    variances[:, : model_run.variance.shape[2]] = model_run.variance[logged_indices + 1, 0]
    return make_topic(
        "estimator_states",
        ekf2_output.make_timestamps(logged_steps) | {"states": states, "covariances": variances},
    )


def _make_position_aid_topics(
    model_inputs: ReplayInputs, model_run: SegmentRun, ekf2_output: Ekf2Output, rate_hz: float
) -> tuple[Topic, ...]:
    """Make estimator_aid_src_* of the position source, with one message per usable position."""
    # The simulation runs one filter configuration, so its index in the arrays of model_run is 0
    events, positions = model_run.events[0], model_inputs.received_positions
    # select events with a position that EKF2 can use: in a gap, an event has no position, and a
    # position may arrive too late
    logged_indices = ekf2_output.find_logged_messages(events.usable, events.end_step, rate_hz)
    logged_steps, sample_indices = events.end_step[logged_indices], events.sample[logged_indices]
    timestamps = ekf2_output.make_timestamps(logged_steps, events.time_s[logged_indices])
    is_fused = model_run.fused[logged_indices, 0]
    measured_m = positions.position_m[sample_indices, :2]
    innovation, innovation_variance, noise_variance = (
        values[logged_indices, 0]
        for values in (model_run.innovation, model_run.innovation_variance, model_run.noise)
    )
    # If EKF2 does not test a position against the innovation gate, it still logs an innovation:
    # measured minus estimated position. The states are the velocity (3 columns), then the position
    estimated_m = ekf2_output.states_at_fusion_horizon[logged_steps, 3:5]
    # row 0 of the variances is before the first event, so the row after event i is i + 1
    state_variance = model_run.variance[logged_indices + 1, 0, HORIZONTAL_POSITION]
    position_noise_variance = noise_variance[:, HORIZONTAL_POSITION_COLUMNS]
    position_innovation = innovation[:, HORIZONTAL_POSITION_COLUMNS]
    is_untested = np.isnan(position_innovation[:, :1])
    # EKF2 also sets time_last_fuse at a reset to the position
    is_used = is_fused | model_run.reset[logged_indices, 0]
    last_fused_us = np.maximum.accumulate(
        is_used * (FIRST_TIMESTAMP_US + ekf2_output.time_us[logged_steps])
    )
    # For GNSS positions, PX4 v1.16 logs latitude and longitude instead of north and east
    observation = measured_m
    if positions.velocity_m_s is not None:
        north_m, east_m = measured_m.T
        observation = np.stack(unproject(north_m, east_m, HOME_POSITION[:2]), axis=1)
    position_topic = _make_aid_source_topic(
        model_inputs.aid,
        model_inputs.settings,
        timestamps | {"time_last_fuse": last_fused_us},
        observation,
        np.where(is_untested, measured_m - estimated_m, position_innovation),
        np.where(
            is_untested,
            state_variance + position_noise_variance,
            innovation_variance[:, HORIZONTAL_POSITION_COLUMNS],
        ).astype(float),
        position_noise_variance,
        model_run.rejected[logged_indices, 0],
        is_fused,
    )
    if positions.velocity_m_s is None:
        return (position_topic,)
    innovation = innovation[:, VELOCITY_COLUMNS]
    innovation_variance = innovation_variance[:, VELOCITY_COLUMNS]
    squared_gate = model_inputs.settings[GNSS_VEL.gate] ** 2
    is_outside_gate = np.any(innovation**2 > squared_gate * innovation_variance, axis=1)
    return position_topic, _make_aid_source_topic(
        GNSS_VEL,
        model_inputs.settings,
        timestamps,
        positions.velocity_m_s[sample_indices],
        innovation,
        innovation_variance,
        noise_variance[:, VELOCITY_COLUMNS],
        is_outside_gate,
        ~is_outside_gate & np.isfinite(innovation).all(axis=1),
    )


def _make_barometer_topics(
    model_inputs: ReplayInputs, model_run: SegmentRun, ekf2_output: Ekf2Output
) -> list[Topic]:
    """Return estimator_aid_src_baro_hgt, or nothing without barometer."""
    height_samples, end_step = model_run.segment.height_samples, model_run.events[0].end_step
    if height_samples is None or model_run.height_filter is None:
        return []
    # make_update_table copies its last argument, the time of each fusion event, to the column
    # fused_at_s. Give step numbers as times, because the steps are needed below
    updates = model_run.height_filter.make_update_table(BAROMETER.name, 0, end_step.astype(float))
    last_published_step = len(ekf2_output.time_us) - ekf2_output.lag_steps - 1
    # EKF2 does not log the first sample, which only initialises the height
    updates = updates[updates["fused_at_s"] <= last_published_step].iloc[1:]
    updates = updates[is_kept_at_rate(updates.index.to_numpy(), OTHER_AIDS_LOG_RATE_HZ)]
    innovation, innovation_variance, is_rejected, is_fused, step_by_update = updates.to_numpy().T
    measurement_times_s, steps = updates.index.to_numpy(), step_by_update.astype(np.intp)
    measured_down_m = height_samples.samples["down_m"][measurement_times_s].to_numpy()
    return [
        _make_aid_source_topic(
            BAROMETER,
            model_inputs.settings,
            ekf2_output.make_timestamps(steps, measurement_times_s),
            measured_down_m - HOME_POSITION[2],
            innovation,
            innovation_variance,
            model_inputs.settings[BAROMETER.noise] ** 2,
            is_rejected > 0,
            is_fused > 0,
        )
    ]


def _make_magnetometer_topics(
    model_inputs: ReplayInputs,
    model_run: SegmentRun,
    ekf2_output: Ekf2Output,
    attitude_rate_hz: float,
) -> list[Topic]:
    """Return vehicle_attitude, estimator_aid_src_mag and estimator_status.

    The result is empty if the EKF2 model does not fuse all axes of the magnetic field: indoors, or
    with fusion of the magnetic heading only.
    """
    field, settings = model_run.segment.magnetic_field, model_inputs.settings
    end_step = model_run.events[0].end_step
    if field is None:
        return []
    # for each event: innovation, innovation variance, and 1 if fused, of the only filter
    # configuration (index 0)
    updates = model_run.magnetometer_updates[:, :, 0]
    has_sample = np.isfinite(updates[:, 2, 0])
    logged_indices = ekf2_output.find_logged_messages(has_sample, end_step, OTHER_AIDS_LOG_RATE_HZ)
    logged_steps = end_step[logged_indices]
    innovation, innovation_variance, fused_fraction = updates[logged_indices].swapaxes(0, 1)
    is_fused = fused_fraction[:, 0] > 0.0
    sample_indices = np.searchsorted(field.step_indices, logged_steps, side="right") - 1
    time_s = to_seconds(ekf2_output.time_us)
    logged_attitude_steps = np.flatnonzero(is_kept_at_rate(time_s, attitude_rate_hz))
    logged_status_steps = np.flatnonzero(
        is_kept_at_rate(time_s[: -ekf2_output.lag_steps], FLAGS_LOG_RATE_HZ)
    )
    return [
        make_attitude_topic(
            "vehicle_attitude",
            ekf2_output.time_us[logged_attitude_steps],
            PUBLICATION_DELAY_US,
            ekf2_output.attitude[logged_attitude_steps],
        ),
        _make_aid_source_topic(
            MAG,
            settings,
            ekf2_output.make_timestamps(logged_steps),
            field.value[sample_indices],
            innovation,
            innovation_variance,
            settings[MAG.noise] ** 2,
            ~is_fused,
            is_fused,
        ),
        make_topic(
            "estimator_status",
            ekf2_output.make_timestamps(logged_status_steps)
            | {"control_mode_flags": 1 << MAG_3D_FUSION_BIT},
        ),
    ]


def _make_aid_source_topic(
    aid: Aid,
    settings: Mapping[str, float],
    timestamps: Mapping[str, Any],
    observation: Array,
    innovation: Array | Array32,
    innovation_variance: Array | Array32,
    noise_variance: Array | Array32 | float,
    is_rejected: BoolArray,
    is_fused: BoolArray,
) -> Topic:
    """Return estimator_aid_src_* of an aiding source.

    The argument ``innovation`` is measurement minus state. PX4 logs the opposite sign. All arrays
    have one row per message.
    """
    fields = {
        **timestamps,
        "observation": observation,
        "observation_variance": np.broadcast_to(noise_variance, innovation.shape),
        "innovation": -innovation,
        "innovation_variance": innovation_variance,
        "test_ratio": innovation**2 / (max(settings[aid.gate], 1.0) ** 2 * innovation_variance),
        "innovation_rejected": is_rejected,
        "fused": is_fused,
    }
    return make_topic(f"estimator_aid_src_{aid.name}", fields)


def compute_time_since_last_event_s(time_s: Array, event_steps: IntArray, start_s: float) -> Array:
    """Return the time (s) since the last event at each step.

    ``start_s`` is the time of an event before the first step, or minus infinity.
    """
    last_event_s = np.full(len(time_s), start_s)
    last_event_s[event_steps] = time_s[event_steps]
    # The maximum of all earlier events is the last event
    return time_s - np.maximum.accumulate(last_event_s)


def _make_flags_topic(
    model_inputs: ReplayInputs, model_run: SegmentRun, ekf2_output: Ekf2Output
) -> Topic:
    """Return estimator_status_flags: a message each second, and at each start or end of fusion."""
    events, time_s = model_run.events[0], model_run.segment.time_s
    # A rejected position also counts as an attempt to fuse: EKF2 keeps the flag cs_ev_pos or
    # cs_gnss_pos set while it rejects positions
    attempt_steps = events.end_step[
        model_run.fused[:, 0] | model_run.rejected[:, 0] | model_run.reset[:, 0]
    ]
    time_since_attempt_s = compute_time_since_last_event_s(time_s, attempt_steps, -np.inf)
    is_fusing = time_since_attempt_s < model_inputs.rules.stop_timeout_s
    has_changed = np.diff(is_fusing, prepend=False)
    is_logged = has_changed | is_kept_at_rate(time_s, FLAGS_LOG_RATE_HZ)
    # The last lag_steps are not published before the end of the log
    logged_steps = np.flatnonzero(is_logged[: len(time_s) - ekf2_output.lag_steps])
    is_fusing = is_fusing[logged_steps]
    is_gnss = model_inputs.aid == GNSS_POS
    has_field_states = model_run.segment.magnetic_field is not None
    fields = ekf2_output.make_timestamps(logged_steps) | {
        "control_status_changes": np.cumsum(has_changed)[logged_steps],
        "cs_gnss_pos": is_fusing & is_gnss,
        "cs_ev_pos": is_fusing & (not is_gnss),
        "cs_mag_3d" if has_field_states else "cs_mag_hdg": True,
    }
    if is_gnss:
        fields["cs_gnss_vel"] = is_fusing
    return make_topic("estimator_status_flags", fields)
