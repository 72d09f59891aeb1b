"""Fusion of GNSS and barometer heights in the EKF2 replay.

EKF2 estimates a bias of the height sensor that is not the height reference.

Sources: PX4-Autopilot ``EKF/aid_sources`` (``barometer/baro_height_control.cpp``,
``gnss/gnss_height_control.cpp``), before v1.16 ``EKF/baro_height_control.cpp`` and
``EKF/gnss_height_control.cpp``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from px4fuse.core.arrays import Array, ArrayPair, BoolArray, IntArray
from px4fuse.ekf2.bad_acceleration import MIN_HEIGHT_INNOVATION_OF_ONE_SENSOR, BadAccelerationFlag
from px4fuse.ekf2.barometer import find_fused_barometer_samples
from px4fuse.ekf2.bias import BiasEstimator
from px4fuse.ekf2.replay_segments import (
    HeightSamples,
    ReplaySegment,
    find_sample_steps,
    group_samples_by_event,
    make_update_table,
    pad_samples,
)
from px4fuse.flight.ekf2_parameters import AIDS, BAROMETER, GNSS_HGT, uses_aid_mask
from px4fuse.flight.model import (
    GROUND_EFFECT_FLAG,
    Ekf2,
    Flight,
    FusionRecord,
    sample_step_function,
)

# State indices of vertical velocity and height
VELOCITY_DOWN, POSITION_DOWN = 5, 8
HEIGHT_SENSORS = (BAROMETER, GNSS_HGT)
HEIGHT_AIDS = (*HEIGHT_SENSORS, AIDS["rng_hgt"], AIDS["ev_hgt"])
# Default (m) of EKF2_GND_EFF_DZ, the barometer's dead zone near the ground
DEFAULT_GROUND_EFFECT_DEAD_ZONE_M = 4.0
# PX4's name of the height reference, by value of EKF2_HGT_REF
HEIGHT_AID_BY_REFERENCE = {0: BAROMETER.name, 1: GNSS_HGT.name}
# Maximum time (s) from the start of the replay to the first logged height bias
MAX_BIAS_LOG_DELAY_S = 1.0
# Minimum logging rate (Hz) of the barometer for a replay of its fusion
MIN_BAROMETER_LOG_HZ = 4.0
# Minimum innovation gate (√S) that EKF2 uses
MIN_INNOVATION_GATE = 1.0
# Minimum σ of the measurement noise that EKF2 uses: position (m) or velocity (m/s)
MIN_MEASUREMENT_NOISE_SIGMA = 0.01
# Factor on EKF2_GPS_P_NOISE for GNSS heights (gnss_height_control.cpp)
GNSS_HEIGHT_NOISE_FACTOR = 1.5


def add_heights(
    flight: Flight, ekf2: Ekf2, fusion_record: FusionRecord, segments: Sequence[ReplaySegment]
) -> tuple[ReplaySegment, ...] | str:
    """Add height measurements to the replay, or return the reason why this is impossible."""
    parameters = fusion_record.parameters
    replayed_times_s = np.concatenate([segment.time_s for segment in segments])
    if uses_aid_mask(parameters):
        return "EKF2 before PX4 v1.14 fuses only one height sensor"
    enabled_fractions = {
        name: np.mean(sample_step_function(aid_log.enabled, replayed_times_s) > 0.0)
        for name, aid_log in ekf2.aids.items()
        if aid_log.enabled is not None
    }
    fused_aids = [aid.name for aid in HEIGHT_SENSORS if enabled_fractions.get(aid.name) == 1.0]
    for aid in HEIGHT_AIDS:
        if enabled_fractions.get(aid.name) and aid.name not in fused_aids:
            return f"EKF2 also fused {aid.label} in part of the flight"
    reference = HEIGHT_AID_BY_REFERENCE.get(int(parameters.get("EKF2_HGT_REF", 1.0)))
    # A single height sensor is the height reference
    if len(fused_aids) == 1:
        (reference,) = fused_aids
    if reference not in fused_aids:
        return "EKF2's height reference is neither GNSS nor barometer, or not logged"
    measurement_times_s, down_m, sample_weight = np.zeros((3, 0))
    if BAROMETER.name in fused_aids and flight.barometer is not None:
        barometer_down_m = flight.barometer["down_m"]
        barometer_down_m = barometer_down_m.set_axis(barometer_down_m.index - 0.5 * ekf2.step_s)
        barometer_samples = find_fused_barometer_samples(ekf2, fusion_record, barometer_down_m)
        measurement_times_s = barometer_samples.index.to_numpy()
        down_m = barometer_samples["down_m"].to_numpy() + fusion_record.altitude_m
        sample_weight = barometer_samples["weight"].to_numpy()
    dead_zone_m = np.where(
        fusion_record.was_flag_set(GROUND_EFFECT_FLAG, measurement_times_s),
        parameters.get("EKF2_GND_EFF_DZ", DEFAULT_GROUND_EFFECT_DEAD_ZONE_M),
        0.0,
    )
    segments_with_heights = []
    delayed_down_m = fusion_record.delayed["down_m"]
    for segment in segments:
        start_s = float(segment.time_s[0])
        bias_and_variance = (0.0, 0.0)
        for aid_name in {*fused_aids} - {reference}:
            logged_bias = fusion_record.height_bias_updates.get(aid_name)
            if (
                logged_bias is None
                or not logged_bias.index[0] - MAX_BIAS_LOG_DELAY_S < start_s < logged_bias.index[-1]
            ):
                return f"EKF2's bias of the {AIDS[aid_name].label} is not logged"
            bias_m, bias_variance_m2 = (
                float(np.interp(start_s, logged_bias.index, logged_bias[name]))
                for name in ("bias_m", "bias_m2")
            )
            bias_and_variance = bias_m, bias_variance_m2
        segment_samples = select_samples_in_segment(
            segment, measurement_times_s, down_m, dead_zone_m, sample_weight
        )
        rate_hz = len(segment_samples[0]) / float(segment.time_s[-1] - start_s)
        if BAROMETER.name in fused_aids and rate_hz < MIN_BAROMETER_LOG_HZ:
            return (
                f"the barometer is logged at {rate_hz:.1f} Hz; a replay of its fusion needs "
                f"{MIN_BAROMETER_LOG_HZ:g} Hz"
            )
        initial_state = segment.state.copy()
        initial_state[POSITION_DOWN] = np.interp(start_s, delayed_down_m.index, delayed_down_m)
        height_samples = HeightSamples(
            tuple(fused_aids), reference, bias_and_variance, *segment_samples
        )
        segments_with_heights.append(
            replace(segment, state=initial_state, height_samples=height_samples)
        )
    return tuple(segments_with_heights)


def select_samples_in_segment(
    segment: ReplaySegment, measurement_times_s: Array, *quantities: Array
) -> tuple[Any, ...]:
    """Return prediction steps, measurement times and ``quantities`` of the samples in a segment."""
    step_indices, is_inside = find_sample_steps(segment, measurement_times_s)
    return step_indices, *(values[is_inside] for values in (measurement_times_s, *quantities))


def group_barometer_by_event(
    segment: ReplaySegment, event_steps_by_interval_set: Sequence[IntArray]
) -> list[Array]:
    """Group the barometer samples by event: each event fuses the samples since the previous event.

    Returns
    -------
    list of ndarray, shape (6, k, events)
        Up to k samples per event. Rows: height (m, down), age (s), time (s), dead zone (m), weight,
        and 1 for a sample (0 for padding).
    """
    height_samples = segment.height_samples
    assert height_samples is not None
    return pad_samples(
        [
            group_samples_by_event(
                segment,
                event_steps,
                height_samples.step_indices,
                height_samples.down_m[:, None],
                slice(2, 3),
                height_samples.measurement_times_s,
                height_samples.dead_zone_m,
                height_samples.weight,
            )
            for event_steps in event_steps_by_interval_set
        ]
    )


class HeightFilter:
    """Fusion of heights as in EKF2, for several filter configurations at once.

    Parameters
    ----------
    barometer_samples_by_event : ndarray, shape (6, k, events, filters) or (6, k, events, 1)
        Result of :func:`group_barometer_by_event`.
    gnss_fix_times_s, has_gnss_fix : ndarray, shape (events, filters) or (events, 1)
        Time of the GNSS fix of each event, and True for events with a fix.
    is_enabled_by_aid : mapping from PX4's name of a source to ndarray of bool, (events, filters)
    parameters : mapping from parameter name to ndarray, shape (filters,)
    has_gate : ndarray of bool, shape (filters,)
        False to fuse every sample.

    Attributes
    ----------
    update_records : ndarray, shape (events, k + 2, 4, filters)
        Rows of :func:`~px4fuse.ekf2.replay_segments.make_update_table` for k barometer samples,
        GNSS height and GNSS velocity.
    """

    def __init__(
        self,
        segment: ReplaySegment,
        barometer_samples_by_event: Array,
        gnss_fix_times_s: Array,
        has_gnss_fix: BoolArray,
        is_enabled_by_aid: Mapping[str, BoolArray],
        parameters: Mapping[str, Array],
        has_gate: BoolArray,
        bad_acceleration_flag: BadAccelerationFlag,
    ) -> None:
        self.bad_acceleration_flag = bad_acceleration_flag
        height_samples = segment.height_samples
        configuration_count = len(has_gate)
        assert height_samples is not None
        self.fused_sensors = height_samples.fused_sensors
        (
            self.down_m,
            self.age_s,
            measurement_times_s,
            self.dead_zone_m,
            weight,
            is_barometer_sample,
        ) = barometer_samples_by_event
        has_gnss_fix = (
            has_gnss_fix
            & is_enabled_by_aid[GNSS_HGT.name]
            & (GNSS_HGT.name in height_samples.fused_sensors)
        )
        has_barometer_sample = (is_barometer_sample > 0.0) & is_enabled_by_aid[BAROMETER.name]
        self.has_sample = np.concatenate(
            [
                has_barometer_sample,
                np.broadcast_to(has_gnss_fix, (1, *has_barometer_sample.shape[1:])),
            ]
        )
        self.any_sample = [np.any(mask, axis=1).tolist() for mask in self.has_sample]
        self.in_ground_effect = self.dead_zone_m.any(axis=2)
        gates = [
            np.maximum(parameters.get(aid.gate, MIN_INNOVATION_GATE), MIN_INNOVATION_GATE)
            for aid in HEIGHT_SENSORS
        ]
        self.gate_squared = [np.where(has_gate, gate**2, np.inf) for gate in gates]
        self.R_m2 = (
            np.maximum(
                parameters.get(BAROMETER.noise, MIN_MEASUREMENT_NOISE_SIGMA),
                MIN_MEASUREMENT_NOISE_SIGMA,
            )
            ** 2
        )
        self.has_bias = [aid.name != height_samples.reference for aid in HEIGHT_SENSORS]
        self.weight = [*np.maximum(weight, 1.0), np.ones_like(gnss_fix_times_s)]
        bias_m, bias_variance_m2 = np.tile(
            height_samples.initial_bias_and_variance, (configuration_count, 1)
        ).T
        start_s = segment.time_s[0]
        self.bias = BiasEstimator(bias_m, bias_variance_m2, segment.step_s)
        self.is_bias_updated = self.has_sample & is_enabled_by_aid[height_samples.reference]
        samples_with_bias = slice(0, -1) if self.has_bias[0] else slice(-1, None)
        self.interval_s = np.zeros(self.has_sample.shape)
        self.time_s = np.stack(
            np.broadcast_arrays(*measurement_times_s, gnss_fix_times_s, self.has_sample[0])[:-1]
        )
        max_samples_per_event, event_count, _ = self.time_s.shape
        self.update_records = np.full(
            (event_count, max_samples_per_event + 1, 4, configuration_count), np.nan
        )
        # A missing sample has the time start_s, so it does not change the latest sample time
        sample_times_s = np.where(self.has_sample, self.time_s, start_s)[
            samples_with_bias
        ].swapaxes(0, 1)
        latest_sample_times_s = np.maximum.accumulate(
            sample_times_s.reshape(-1, configuration_count), axis=0
        )
        interval_s = np.diff(latest_sample_times_s, axis=0, prepend=start_s).reshape(
            sample_times_s.shape
        )
        self.interval_s[samples_with_bias] = interval_s.swapaxes(0, 1)
        self.interval_s *= self.is_bias_updated

    def make_update_table(
        self, sensor: str, configuration_index: int, end_s: Array
    ) -> pd.DataFrame:
        """Return a table of one configuration's updates with a height sensor.

        ``end_s`` contains the time (s) of each event.
        """
        gnss_sample_index = len(self.down_m)
        sensor_sample_slice = (
            slice(gnss_sample_index, gnss_sample_index + 1)
            if sensor == GNSS_HGT.name
            else slice(gnss_sample_index)
        )
        return make_update_table(
            self.update_records[:, sensor_sample_slice, :, configuration_index],
            self.time_s[sensor_sample_slice, :, configuration_index].T,
            end_s,
            ["down"],
        )

    def fuse_barometer(self, event: int, x: Array, P: Array) -> ArrayPair:
        for sample_index in range(len(self.down_m)):
            x, P = self._fuse_sample(
                event,
                sample_index,
                x,
                P,
                self.down_m[sample_index, event],
                self.age_s[sample_index, event],
                self.R_m2,
            )
        return x, P

    def fuse_gnss(
        self, event: int, x: Array, P: Array, gnss_down_m: Array, gnss_variance_m2: Array
    ) -> ArrayPair:
        """Fuse the GNSS height (m, down) of one event with its R (m²); return x and P."""
        return self._fuse_sample(
            event, len(self.down_m), x, P, gnss_down_m, np.zeros(1), gnss_variance_m2
        )

    def update_bad_acceleration_flag(self, event: int, time_s: Array) -> None:
        update_records = self.update_records[max(event - 1, 0) : event + 1]
        innovations = -update_records[:, :, 0] / np.sqrt(update_records[:, :, 1])
        if (innovations > MIN_HEIGHT_INNOVATION_OF_ONE_SENSOR).any():
            innovations[:, -2] = np.fmax(innovations[:, -2], innovations[:, -1])
            self.bad_acceleration_flag.update(time_s, innovations[0, :-1], innovations[-1, :-1])

    def _fuse_sample(
        self,
        event: int,
        sample_index: int,
        x: Array,
        P: Array,
        down_m: Array,
        age_s: Array,
        R: Array,
    ) -> ArrayPair:
        """Fuse a height (m, down) that was measured ``age_s`` (s) before the event."""
        if not self.any_sample[sample_index][event]:
            return x, P
        height_sensor_index = int(sample_index == len(self.down_m))
        # The sample measured an earlier height: height - age_s · vertical velocity
        covariance_with_measured_height = (
            P[:, :, POSITION_DOWN] - age_s[:, None] * P[:, :, VELOCITY_DOWN]
        )
        predicted_variance = (
            covariance_with_measured_height[:, POSITION_DOWN]
            - age_s * covariance_with_measured_height[:, VELOCITY_DOWN]
        )
        nu = down_m - x[:, POSITION_DOWN] + age_s * x[:, VELOCITY_DOWN]
        sample_weight = self.weight[sample_index][event]
        if self.has_bias[height_sensor_index]:
            nu, R = self.bias.remove_and_update_bias(
                nu,
                predicted_variance,
                R,
                self.interval_s[sample_index, event],
                self.is_bias_updated[sample_index, event],
                sample_weight,
            )
        if height_sensor_index == 0 and self.in_ground_effect[sample_index, event]:
            nu = np.where(nu > 0.0, np.maximum(nu - self.dead_zone_m[sample_index, event], 0.0), nu)
        S = predicted_variance + R
        has_sample = self.has_sample[sample_index, event]
        is_fused = has_sample & (nu * nu <= self.gate_squared[height_sensor_index] * S)
        if not is_fused.all():
            is_clipped = (
                has_sample
                & ~is_fused
                & (self.bad_acceleration_flag.until_s > self.time_s[sample_index, event])
            )
            innovation_limit = np.sqrt(self.gate_squared[height_sensor_index] * S)
            nu = np.where(is_clipped, np.clip(nu, -innovation_limit, innovation_limit), nu)
            is_fused |= is_clipped
        self.update_records[event, sample_index] = np.where(
            has_sample, (nu, S, ~is_fused, is_fused), np.nan
        )
        K = (
            covariance_with_measured_height
            * (is_fused / (predicted_variance + R / sample_weight))[:, None]
        )
        return x + K * nu[:, None], P - K[:, :, None] * covariance_with_measured_height[:, None]
