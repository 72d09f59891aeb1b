"""Fusion of GNSS and barometer heights in the EKF2 replay.

EKF2 estimates a bias of the height sensor that is not the height reference.

EKF2 flags a bad vertical acceleration (``fs_bad_acc_vertical``) if barometer and GNSS both measure
a larger height than EKF2 estimates. While the flag is set, EKF2 increases the accelerometer noise
and holds the accelerometer bias constant. EKF2 then clips vertical innovations to the gate instead
of rejecting them.

Sources: PX4-Autopilot ``EKF/aid_sources`` (``barometer/baro_height_control.cpp``,
``gnss/gnss_height_control.cpp``), before v1.16 ``EKF/baro_height_control.cpp`` and
``EKF/gnss_height_control.cpp``.
"""

import numpy as np
import pandas as pd

from px4fuse.core.arrays import Array, ArrayPair, BoolArray
from px4fuse.flight.ekf2_parameters import BAROMETER, GNSS_HGT, Aid

from .bias import BiasEstimator
from .filter_batch import FilterBatch
from .height_samples import HEIGHT_SENSORS, POSITION_DOWN
from .replay_segments import (
    ReplaySegment,
    group_samples_by_event,
    make_update_table,
    stack_samples,
)

# Index of the vertical axis in NED
DOWN_AXIS = slice(2, 3)
# State index of the vertical velocity
VELOCITY_DOWN = 5
# Minimum innovation gate (√S) that EKF2 uses
MIN_INNOVATION_GATE = 1.0
# Minimum σ of the measurement noise that EKF2 uses: position (m) or velocity (m/s)
MIN_MEASUREMENT_NOISE_SIGMA = 0.01
# Factor on EKF2_GPS_P_NOISE for GNSS heights (gnss_height_control.cpp)
GNSS_HEIGHT_NOISE_FACTOR = 1.5
# EKF2 flags a bad acceleration if height innovations are too large: that of barometer or GNSS must
# exceed this multiple of √S (vert_innov_test_lim, common.h)
MIN_BAROMETER_OR_GNSS_INNOVATION_SIGMAS = 3.0
# For a bad-acceleration flag, the height innovations of both barometer and GNSS must exceed this
# multiple of √S (vert_innov_test_min, common.h)
MIN_BAROMETER_AND_GNSS_INNOVATION_SIGMAS = 1.0


class BadAccelerationFlag:
    """EKF2's flag for a bad vertical acceleration, for several filter configurations.

    Source: PX4-Autopilot ``EKF/height_control.cpp`` (checkVerticalAccelerationHealth,
    estimateInertialNavFallingLikelihood).

    Parameters
    ----------
    uses_logged_flag : ndarray of bool, shape (filters,)
        True to use the logged flag instead of a computed flag.
    flag_duration_s : float
        Time for which the flag stays set after a large innovation.

    Attributes
    ----------
    since_s, until_s : ndarray, shape (filters,)
        Start and end of the latest time with a set flag, up to the latest event.
    """

    def __init__(
        self, uses_logged_flag: BoolArray, flag_duration_s: float, segment: ReplaySegment
    ) -> None:
        """Read the bad-acceleration flag that EKF2 logged in a segment."""
        time_s = segment.time_s
        logged_flag = segment.is_acceleration_bad
        if logged_flag is None:
            logged_flag = np.zeros(len(time_s), bool)
        self.uses_logged_flag = uses_logged_flag
        self.flag_duration_s = flag_duration_s
        # Start and end (s) of each logged time with a set flag. Changes of the flag are start, end,
        # start, end, and so on. A flag that is still set at the end has the end infinity
        flag_change_steps = np.flatnonzero(np.diff(logged_flag, prepend=False, append=False))
        self.logged_spans_s = np.append(time_s, np.inf)[flag_change_steps].reshape(-1, 2)
        self.since_s = np.full(len(uses_logged_flag), time_s[0])
        self.until_s = self.since_s.copy()
        if logged_flag[0]:
            # The start of the flag is before the segment: assume that it is the first step
            self.until_s += flag_duration_s

    def apply_logged_flag(self, now_s: Array) -> None:
        """Set ``since_s`` and ``until_s`` to the latest logged time with a set flag before now.

        ``now_s`` is the present time of each filter configuration, shape (filters,). Only
        configurations that use the logged flag are changed.
        """
        if len(self.logged_spans_s):
            latest_row = np.searchsorted(self.logged_spans_s[:, 0], now_s) - 1
            selected = self.uses_logged_flag & (latest_row >= 0)
            self.since_s[selected], self.until_s[selected] = self.logged_spans_s[
                latest_row[selected]
            ].T

    def compute_bad_acceleration_fraction(self, begin_s: Array, end_s: Array) -> Array:
        """Return the fraction of a time interval in which the flag is set.

        The result has one value for each filter configuration.
        """
        if not (self.until_s > begin_s).any():
            return np.zeros_like(self.until_s)
        overlap_s = np.minimum(self.until_s, end_s) - np.maximum(self.since_s, begin_s)
        return np.asarray(np.maximum(overlap_s, 0.0) / np.maximum(end_s - begin_s, 1e-9))

    def update(self, time_s: Array, previous_innovations: Array, innovations: Array) -> None:
        """Update the flag for a bad vertical acceleration after a fusion event.

        Configurations that use the logged flag are not changed.

        Parameters
        ----------
        time_s : ndarray, shape (filters,) or (1,)
            Time of the fusion event.
        previous_innovations, innovations : ndarray, shape (k + 1, filters)
            Height innovations ÷ √S (positive upwards) of the previous and of this event. The first
            k rows are those of k barometer samples, the last row is that of GNSS. NaN without a
            sample.
        """
        *previous_barometer, previous_gnss = previous_innovations
        *barometer, gnss = innovations
        # After each fusion, EKF2 tests the latest barometer and GNSS innovations for a bad
        # acceleration. The first test uses the last barometer and GNSS samples of the previous
        # event
        latest_barometer_innovation = np.full_like(gnss, np.nan)
        for sample in previous_barometer:
            latest_barometer_innovation = np.where(
                np.isnan(sample), latest_barometer_innovation, sample
            )
        is_acceleration_bad = _has_large_height_innovations(
            latest_barometer_innovation, previous_gnss
        )
        # EKF2 fuses the barometer samples of this event before its GNSS sample, so each is tested
        # together with the previous GNSS sample
        for sample in barometer:
            latest_barometer_innovation = np.where(
                np.isnan(sample), latest_barometer_innovation, sample
            )
            is_acceleration_bad |= _has_large_height_innovations(
                latest_barometer_innovation, previous_gnss
            )
        # The last test follows the fusion of the GNSS sample of this event
        is_acceleration_bad |= _has_large_height_innovations(latest_barometer_innovation, gnss)
        is_acceleration_bad &= ~self.uses_logged_flag
        # If the flag is still set from an earlier event, its start stays the same and only its end
        # changes
        self.since_s = np.where(is_acceleration_bad & (self.until_s < time_s), time_s, self.since_s)
        self.until_s = np.where(is_acceleration_bad, time_s + self.flag_duration_s, self.until_s)


def _has_large_height_innovations(barometer_innovation: Array, gnss_innovation: Array) -> BoolArray:
    """Return True if both height innovations are large: EKF2 then assumes a falling vehicle.

    The innovations are normalised (√S) and positive upwards (PX4: ``vert_innov_test``).
    """
    larger_innovation = np.maximum(barometer_innovation, gnss_innovation)
    smaller_innovation = np.minimum(barometer_innovation, gnss_innovation)
    return (larger_innovation > MIN_BAROMETER_OR_GNSS_INNOVATION_SIGMAS) & (
        smaller_innovation > MIN_BAROMETER_AND_GNSS_INNOVATION_SIGMAS
    )


class HeightFilter:
    """Fusion of barometer and GNSS heights as in EKF2, for several filter configurations.

    Each fusion event fuses the samples since the previous event: up to k barometer samples, then
    one GNSS sample. Arrays of samples have the shape (k + 1, events, filters).

    Parameters
    ----------
    has_gnss_fix, gnss_down_m : ndarray, shape (events, filters)
        True if a GNSS height is available in the event, and this height (positive down).

    Attributes
    ----------
    down_m, age_s, time_s : ndarray
        Height (m, down) of each sample, age at its fusion event, and measurement time.
    dead_zone_m, weight, has_sample : ndarray
        Width of the dead zone for positive innovations (ground effect), number of EKF2 samples that
        the logged sample represents, and True for a sample (False for padding).
    last_sample_s : ndarray, shape (filters,)
        Time (s) of the last sample of the sensor whose bias EKF2 estimates.
    update_records : ndarray, shape (events, k + 2, 4, filters)
        Rows of :func:`~px4fuse.ekf2.replay_segments.make_update_table` for k barometer samples,
        GNSS height and GNSS velocity.
    """

    def __init__(
        self,
        batch: FilterBatch,
        has_gnss_fix: BoolArray,
        gnss_down_m: Array,
        bad_acceleration_flag: BadAccelerationFlag,
    ) -> None:
        """Collect the height samples of all fusion events, and set noise, gates and bias."""
        self.bad_acceleration_flag = bad_acceleration_flag
        segment, parameters = batch.segment, batch.parameters
        height_samples = segment.height_samples
        assert height_samples is not None
        self.fused_sensors, samples = height_samples.fused_sensors, height_samples.samples
        barometer_samples = stack_samples(
            [
                group_samples_by_event(
                    segment,
                    end_steps,
                    height_samples.step_indices,
                    samples[["down_m"]].to_numpy(),
                    DOWN_AXIS,
                    samples.index.to_numpy(),
                    *samples[["dead_zone_m", "weight"]].to_numpy().T,
                )
                for end_steps in batch.event_steps.T
            ]
        )
        # Index of the GNSS sample, after the barometer samples of each event
        self.gnss_index = barometer_samples.shape[1]
        # Append one GNSS sample to the barometer samples of each event. Its age is 0, because a
        # fusion event is at the measurement time of the GNSS sample
        self.down_m, self.age_s, self.time_s, self.dead_zone_m, weight, has_sample = np.pad(
            barometer_samples, ((0, 0), (0, 1), (0, 0), (0, 0))
        )
        self.down_m[-1], self.time_s[-1] = gnss_down_m, batch.events["time_s"]
        # GNSS samples and padding have the weight 1
        self.weight = np.maximum(weight, 1.0)
        self.has_sample = (has_sample > 0.0) & batch.is_enabled_by_aid[BAROMETER.name]
        if GNSS_HGT.name in self.fused_sensors:
            self.has_sample[-1] = has_gnss_fix & batch.is_enabled_by_aid[GNSS_HGT.name]
        self.has_samples = np.any(self.has_sample, axis=2).tolist()
        self.gate_squared = {
            aid.name: np.where(
                batch.has_gate,
                np.maximum(parameters.get(aid.gate, MIN_INNOVATION_GATE), MIN_INNOVATION_GATE) ** 2,
                np.inf,
            )
            for aid in HEIGHT_SENSORS
        }
        noise_m = parameters.get(BAROMETER.noise, MIN_MEASUREMENT_NOISE_SIGMA)
        self.R_m2 = np.maximum(noise_m, MIN_MEASUREMENT_NOISE_SIGMA) ** 2
        self.reference = height_samples.reference
        self.is_reference_enabled = batch.is_enabled_by_aid[self.reference]
        event_count, filter_count = batch.events.shape
        bias_m, bias_variance_m2 = np.tile(
            height_samples.initial_bias_and_variance, (filter_count, 1)
        ).T
        self.bias = BiasEstimator(bias_m, bias_variance_m2, segment.step_s)
        self.last_sample_s = np.full(filter_count, segment.time_s[0])
        self.update_records = np.full((event_count, self.gnss_index + 2, 4, filter_count), np.nan)

    def make_update_table(
        self, sensor: str, configuration_index: int, end_s: Array
    ) -> pd.DataFrame:
        """Return a table of the updates of one filter configuration with a height sensor.

        ``end_s`` contains the time (s) of each fusion event.
        """
        # The barometer samples are before the GNSS sample
        samples = slice(self.gnss_index)
        if sensor == GNSS_HGT.name:
            samples = slice(self.gnss_index, self.gnss_index + 1)
        return make_update_table(
            self.update_records[:, samples, :, configuration_index],
            self.time_s[samples, :, configuration_index].T,
            end_s,
            ["down"],
        )

    def fuse_barometer(self, event: int, x: Array, P: Array) -> ArrayPair:
        """Fuse the barometer samples of an event, which are stored before the GNSS sample."""
        for sample_index in range(self.gnss_index):
            x, P = self._fuse_sample(BAROMETER, event, sample_index, x, P, self.R_m2)
        return x, P

    def fuse_gnss(self, event: int, x: Array, P: Array, R: Array) -> ArrayPair:
        """Fuse the GNSS height of an event with its variance R (m²)."""
        return self._fuse_sample(GNSS_HGT, event, self.gnss_index, x, P, R)

    def update_bad_acceleration_flag(
        self, event: int, time_s: Array, velocity_down_update: Array
    ) -> None:
        """Update the bad-acceleration flag with the vertical innovations of a fusion event.

        ``time_s`` is the time of the event. ``velocity_down_update``, shape (2, filters), contains
        ν and S of the GNSS velocity.
        """
        self.update_records[event, -1, :2] = velocity_down_update
        # Previous and this event; for the first event, twice this event
        records = self.update_records[[max(event - 1, 0), event]]
        # ν / √S, positive upwards. ν and S are the first two rows of a record
        innovations = -records[:, :, 0] / np.sqrt(records[:, :, 1])
        if (innovations > MIN_BAROMETER_OR_GNSS_INNOVATION_SIGMAS).any():
            # The last two columns are GNSS height and GNSS velocity. EKF2 uses the larger
            # innovation; a missing one is NaN
            innovations[:, -2] = np.fmax(innovations[:, -2], innovations[:, -1])
            self.bad_acceleration_flag.update(time_s, *innovations[:, :-1])

    def _fuse_sample(
        self, aid: Aid, event: int, sample_index: int, x: Array, P: Array, R: Array
    ) -> ArrayPair:
        """Fuse a height (m, down) measured before its fusion event; return x and P."""
        if not self.has_samples[sample_index][event]:
            return x, P
        sample = sample_index, event
        has_sample, age_s, time_s = self.has_sample[sample], self.age_s[sample], self.time_s[sample]
        # 1. Innovation. The sample measured an earlier height: height - age_s · vertical velocity
        PH = P[:, :, POSITION_DOWN] - age_s[:, None] * P[:, :, VELOCITY_DOWN]
        predicted_variance = PH[:, POSITION_DOWN] - age_s * PH[:, VELOCITY_DOWN]
        nu = self.down_m[sample] - x[:, POSITION_DOWN] + age_s * x[:, VELOCITY_DOWN]
        weight = self.weight[sample]
        # 2. Bias of the sensor that is not the height reference
        if aid.name != self.reference:
            previous_sample_s = self.last_sample_s
            self.last_sample_s = np.where(
                has_sample, np.maximum(previous_sample_s, time_s), previous_sample_s
            )
            # While the height reference is disabled, EKF2 holds the bias of the other sensor
            # constant
            is_bias_updated = has_sample & self.is_reference_enabled[event]
            interval_s = (self.last_sample_s - previous_sample_s) * is_bias_updated
            nu, R = self.bias.remove_and_update_bias(
                nu, predicted_variance, R, interval_s, is_bias_updated, weight
            )
        # In ground effect, the measured height is too low: EKF2 reduces a positive innovation
        nu = nu - np.minimum(np.maximum(nu, 0.0), self.dead_zone_m[sample])
        # 3. Gate
        S = predicted_variance + R
        gate_squared = self.gate_squared[aid.name]
        is_fused = has_sample & (nu * nu <= gate_squared * S)
        if not is_fused.all():
            # With a bad vertical acceleration, EKF2 clips the innovation to the gate
            is_clipped = has_sample & (self.bad_acceleration_flag.until_s > time_s)
            limit = np.where(is_clipped, np.sqrt(gate_squared * S), np.inf)
            nu = np.clip(nu, -limit, limit)
            is_fused |= is_clipped
        self.update_records[event, sample_index] = np.where(
            has_sample, (nu, S, ~is_fused, is_fused), np.nan
        )
        # A sample that represents n EKF2 samples is fused with 1/n of their noise. The gate test
        # above uses the noise of one EKF2 sample
        K = PH * (is_fused / (predicted_variance + R / weight))[:, None]
        return x + K * nu[:, None], P - K[:, :, None] * PH[:, None]
