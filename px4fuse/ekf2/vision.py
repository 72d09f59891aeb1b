"""Fusion of external vision in addition to GNSS in the EKF2 replay.

EKF2 estimates a bias of the vision positions, which adapts within seconds. Vision therefore
determines the relative motion, GNSS the position. Without GNSS, the bias is zero, and EKF2 resets
its position to vision.

Sources: PX4-Autopilot ``EKF/aid_sources/external_vision`` (``ev_pos_control.cpp``; before v1.16
``EKF/ev_pos_control.cpp``), ``EKF/control.cpp`` (vision is fused after GNSS and heights).
"""

import numpy as np
import pandas as pd

from px4fuse.core.arrays import Array, ArrayPair, BoolArray, IntArray
from px4fuse.flight.ekf2_parameters import EV_POS, GNSS_POS

from .bias import BiasEstimator
from .filter_batch import FilterBatch, FilterConfiguration
from .heights import MIN_INNOVATION_GATE, MIN_MEASUREMENT_NOISE_SIGMA
from .intervals import MAX_DELAY_BEHIND_HORIZON_S
from .replay_segments import (
    HORIZONTAL_POSITION,
    HORIZONTAL_VELOCITY,
    group_samples_by_event,
    make_update_table,
    stack_samples,
)

# EKF2 stops vision fusion after this time (s) without a sample (2 EV_MAX_INTERVAL, ev_control.cpp)
MAX_SAMPLE_GAP_S = 0.4
# EKF2 resets the vision bias or the position after this time (s) with only rejected samples:
# no_aid_timeout_max (common.h)
REJECTION_TIMEOUT_S = 1.0


def _group_vision_by_event(
    batch: FilterBatch, event_steps: IntArray, configuration: FilterConfiguration
) -> Array:
    """Group the vision samples of one filter configuration by fusion event.

    Each event fuses the samples since the previous event.

    Return an array of shape (8, k, events) for up to k samples per event. Rows: position north and
    east (m), age, measurement time, fusion time (s), reported variances north and east (m²), and 1
    for a sample (0 for padding).
    """
    inputs, segment, settings = batch.inputs, batch.segment, configuration.settings
    vision_positions, time_s = inputs.vision_positions, segment.time_s
    assert vision_positions is not None
    # 1. Prediction step in which EKF2 fuses each sample
    measurement_times_s = (
        vision_positions.timestamp_s - settings[EV_POS.delay] * 1e-3 - 0.5 * inputs.mean_step_s
    )
    earliest_fusion_times_s = np.maximum(
        measurement_times_s,
        vision_positions.arrival_s - configuration.compute_delays(inputs).horizon_s,
    )
    # EKF2 fuses a late sample when it arrives, after the earlier samples. 1e-9: rounding errors
    step_index = np.maximum.accumulate(np.searchsorted(time_s, earliest_fusion_times_s - 1e-9))
    # 2. Samples that EKF2 can fuse: inside the segment, and not too late
    is_usable = (
        (step_index > 0)
        & (step_index < len(time_s))
        & (earliest_fusion_times_s < measurement_times_s + MAX_DELAY_BEHIND_HORIZON_S)
    )
    # Positions are NaN while external vision was disabled in flight
    is_usable &= np.isfinite(vision_positions.position_m[:, 0])
    # EKF2 fuses only the newer of two samples in one prediction step
    is_usable[:-1] &= step_index[1:] > step_index[:-1]
    step_index = step_index[is_usable]
    # 3. Position of the IMU: position of the camera minus lever arm
    lever_arm_m = np.array([settings[name] for name in EV_POS.lever_arm]) - inputs.imu_offset_m
    position_m = vision_positions.position_m[is_usable]
    position_m = position_m - segment.body_to_ned[step_index] @ lever_arm_m
    variance_north_m2, variance_east_m2, _ = vision_positions.variance_m2[is_usable].T
    return group_samples_by_event(
        segment,
        event_steps,
        step_index,
        position_m[:, :2],
        slice(0, 2),  # axes north and east
        measurement_times_s[is_usable],
        time_s[step_index],
        variance_north_m2,
        variance_east_m2,
    )


class VisionFilter:
    """Fusion of vision positions as in EKF2, for several filter configurations at once.

    Attributes
    ----------
    update_records : ndarray, shape (events, k, 7, filters)
        Rows of :func:`~px4fuse.ekf2.replay_segments.make_update_table` for each sample.
    position_reset_m : ndarray, shape (events, filters, 2)
        Change of the position by resets, north and east.
    last_fusion_s : ndarray, shape (filters,)
        Time of the last position fusion or reset.
    """

    def __init__(self, batch: FilterBatch) -> None:
        segment, parameters = batch.segment, batch.parameters
        is_enabled_by_aid = batch.is_enabled_by_aid
        # Rows of _group_vision_by_event, each of shape (samples of an event, events, filters)
        samples = stack_samples(
            [
                _group_vision_by_event(batch, event_steps, configuration)
                for event_steps, configuration in zip(
                    batch.event_steps.T, batch.configurations, strict=True
                )
            ]
        )
        _, _, self.age_s, self.measurement_times_s, self.fusion_time_s, _, _, sample_flags = samples
        sample_count, event_count, configuration_count = sample_flags.shape
        # North and east become the last axis, as in the states
        self.position_m = np.moveaxis(samples[:2], 0, -1)
        reported_variance_m2 = np.moveaxis(samples[5:7], 0, -1)
        self.update_records = np.full((event_count, sample_count, 7, configuration_count), np.nan)
        self.position_reset_m = np.zeros((event_count, configuration_count, 2))
        has_sample = (sample_flags > 0.0) & is_enabled_by_aid[EV_POS.name]
        # Element 0: samples of prediction steps before the event. Element 1: samples of the
        # prediction step of the event (age 0), which EKF2 fuses after GNSS
        self.has_sample = [has_sample & (self.age_s > 0.0), has_sample & (self.age_s == 0.0)]
        self.has_gate = batch.has_gate
        self.is_gnss_off = ~is_enabled_by_aid[GNSS_POS.name]
        self.gate_squared = np.maximum(parameters[EV_POS.gate], MIN_INNOVATION_GATE)[:, None] ** 2
        # R: reported variance, but at least the noise parameter of vision and, while EKF2 fuses
        # GNSS, that of GNSS
        uses_reported_noise = batch.uses_reported_noise & (
            parameters[EV_POS.noise_mode_parameter] != 1.0
        )
        min_variance_m2 = np.maximum(
            np.maximum(parameters[EV_POS.noise], MIN_MEASUREMENT_NOISE_SIGMA) ** 2,
            np.where(self.is_gnss_off, 0.0, parameters[GNSS_POS.noise] ** 2),
        )
        self.R_m2 = np.maximum(
            reported_variance_m2 * uses_reported_noise[:, None], min_variance_m2[..., None]
        )
        bias = np.zeros((configuration_count, 2))
        self.bias = BiasEstimator(bias, bias + np.inf, segment.step_s)
        # No sample yet: the first sample starts the fusion, as after a gap
        self.last_sample_s, self.last_attempt_s = np.full((2, configuration_count), -np.inf)
        self.last_fusion_s = np.full(configuration_count, segment.time_s[0])
        self.was_gnss_off = self.is_gnss_off[0]

    def make_update_table(self, configuration_index: int, end_s: Array) -> pd.DataFrame:
        """Return a table of the vision updates of a filter configuration, one row per sample.

        ``end_s`` contains the time (s) of each fusion event.
        """
        return make_update_table(
            self.update_records[..., configuration_index],
            self.measurement_times_s[..., configuration_index].T,
            end_s,
            ["north", "east"],
        )

    def fuse(
        self, event: int, x: Array, P: Array, is_after_gnss_fusion: bool, last_gnss_fusion_s: Array
    ) -> ArrayPair:
        """Fuse the vision samples of one fusion event; return x and P.

        ``is_after_gnss_fusion`` is True for the samples that EKF2 fuses after GNSS.

        A restart of the fusion resets the position or, with GNSS, the vision bias to the sample.
        EKF2 restarts the fusion after a gap of vision, a change of GNSS fusion, and too many
        rejections.

        Sources: ``ev_pos_control.cpp``, functions controlEvPosFusion and updateEvPosFusion.
        """
        is_gnss_off = self.is_gnss_off[event]
        # Loop over the samples of this event. In each iteration, every filter configuration fuses
        # at most one sample
        for sample_index, has_sample in enumerate(self.has_sample[is_after_gnss_fusion][:, event]):
            if not has_sample.any():
                continue
            age_s, fusion_time_s, R_m2 = (
                array[sample_index, event] for array in (self.age_s, self.fusion_time_s, self.R_m2)
            )
            # 1. Innovation. The sample measured an earlier position: position - age_s · velocity
            HP = P[:, HORIZONTAL_POSITION] - age_s[:, None, None] * P[:, HORIZONTAL_VELOCITY]
            HPH = (
                HP[:, :, HORIZONTAL_POSITION] - age_s[:, None, None] * HP[:, :, HORIZONTAL_VELOCITY]
            )
            predicted_variance = np.diagonal(HPH, axis1=1, axis2=2)
            position_innovation_m = (
                self.position_m[sample_index, event]
                - x[:, HORIZONTAL_POSITION]
                + age_s[:, None] * x[:, HORIZONTAL_VELOCITY]
            )
            time_since_sample_s = fusion_time_s - self.last_sample_s
            is_bias_updated = has_sample & ~is_gnss_off
            nu, R = self.bias.remove_and_update_bias(
                position_innovation_m,
                predicted_variance,
                R_m2,
                np.where(is_bias_updated, time_since_sample_s, 0.0)[:, None],
                is_bias_updated[:, None],
            )
            S = predicted_variance + R
            # 2. Decision: fuse, reject, or restart. The first sample after a gap, and after a
            # change of GNSS fusion, restarts the fusion. All others are tested with the gate
            must_restart = (time_since_sample_s > MAX_SAMPLE_GAP_S) | (
                is_gnss_off != self.was_gnss_off
            )
            is_tested = has_sample & ~must_restart
            is_innovation_large = np.any(nu * nu > self.gate_squared * S, axis=1)
            is_outside_gate = is_tested & is_innovation_large & self.has_gate
            is_fused = is_tested & ~is_outside_gate
            is_rejection_timed_out = is_outside_gate & (
                fusion_time_s - self.last_attempt_s > REJECTION_TIMEOUT_S
            )
            is_fusion_restarting = (has_sample & must_restart) | is_rejection_timed_out
            # A restart resets the position if vision is the only position source, or if EKF2 has
            # fused neither vision nor GNSS for a time. Otherwise, it sets the vision bias
            is_gnss_timed_out = fusion_time_s - last_gnss_fusion_s > REJECTION_TIMEOUT_S
            is_position_reset = is_fusion_restarting & (
                is_gnss_off | (is_rejection_timed_out & is_gnss_timed_out)
            )
            is_bias_initialised = is_fusion_restarting & ~is_position_reset
            # If EKF2 resets its position to a sample, it logs innovation 0
            update_record = (
                *np.where(is_position_reset, 0.0, nu.T),
                *S.T,
                is_outside_gate & ~is_position_reset,
                is_fused,
                is_position_reset,
            )
            is_evaluated = is_fused | is_outside_gate | is_position_reset
            self.update_records[event, sample_index] = np.where(is_evaluated, update_record, np.nan)
            # 3. Update of the state, or reset of the position
            K = (np.linalg.inv(HPH + R[:, :, None] * np.eye(2)) @ HP).transpose(0, 2, 1)
            K *= is_fused[:, None, None]
            x = x + (K @ nu[:, :, None])[:, :, 0]
            P = P - K @ HP
            # EKF2 corrects vision for a bias only during GNSS fusion. Without GNSS, EKF2 resets its
            # position to the uncorrected vision position
            position_reset_m = np.where(is_gnss_off[:, None], position_innovation_m, nu)
            position_reset_m *= is_position_reset[:, None]
            set_states(
                x,
                P,
                is_position_reset,
                HORIZONTAL_POSITION,
                x[:, HORIZONTAL_POSITION] + position_reset_m,
                np.where(is_gnss_off[:, None], R_m2, R),
            )
            self.position_reset_m[event] += position_reset_m
            # 4. Bias (state minus measurement). If the fusion of vision restarts during GNSS
            # fusion, EKF2 sets the bias so that vision agrees with EKF2's position
            is_bias_cleared = is_position_reset & is_gnss_off
            self.bias.bias_m[is_bias_initialised] = -position_innovation_m[is_bias_initialised]
            self.bias.bias_m[is_bias_cleared] = self.bias.variance_m2[is_bias_cleared] = 0.0
            # 5. Times of the last sample, attempt and fusion
            self.last_sample_s[has_sample] = fusion_time_s[has_sample]
            self.last_attempt_s = np.where(
                is_fused | is_fusion_restarting, fusion_time_s, self.last_attempt_s
            )
            self.last_fusion_s = np.where(
                is_fused | is_position_reset, fusion_time_s, self.last_fusion_s
            )
            self.was_gnss_off = np.where(has_sample, is_gnss_off, self.was_gnss_off)
        return x, P


def set_states(
    x: Array, P: Array, is_selected: BoolArray, rows: slice, value: Array, variance: Array
) -> None:
    """Set value and variance of the states ``rows``, and set their correlations to zero.

    Only the selected filter configurations change. ``value`` and ``variance`` have the shape
    (filters, states).
    """
    x[is_selected, rows] = value[is_selected]
    P[is_selected, :, rows] = 0.0
    P[is_selected, rows, :] = 0.0
    P[is_selected, rows, rows] = np.eye(value.shape[1]) * variance[is_selected][:, :, None]
