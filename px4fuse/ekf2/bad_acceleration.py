"""Model of EKF2's flag for a bad vertical acceleration (``fs_bad_acc_vertical``).

EKF2 sets the flag if barometer and GNSS both measure a larger height than EKF2 estimates. While the
flag is set, EKF2 increases the accelerometer noise and holds the accelerometer bias constant. EKF2
then clips vertical innovations to the gate instead of rejecting them.

Source: PX4-Autopilot ``EKF/height_control.cpp`` (checkVerticalAccelerationHealth,
estimateInertialNavFallingLikelihood).
"""

import numpy as np

from px4fuse.core.arrays import Array, BoolArray
from px4fuse.ekf2.replay_segments import ReplaySegment

# Minimum normalised height innovation (√S) of barometer or GNSS for a bad-acceleration flag
# (vert_innov_test_lim, common.h)
MIN_HEIGHT_INNOVATION_OF_ONE_SENSOR = 3.0
# Minimum normalised height innovation (√S) of barometer and GNSS for a bad-acceleration flag
# (vert_innov_test_min, common.h)
MIN_HEIGHT_INNOVATION_OF_BOTH_SENSORS = 1.0


class BadAccelerationFlag:
    """EKF2's flag for a bad vertical acceleration, for several filter configurations.

    Parameters
    ----------
    uses_logged_flag : ndarray of bool, shape (filters,)
        True to use the logged flag.
    flag_duration_s : float
        Time for which the flag stays set after a large innovation.

    Attributes
    ----------
    since_s, until_s : ndarray, shape (filters,)
        Start and end of the latest time with a set flag.
    """

    def __init__(
        self, uses_logged_flag: BoolArray, flag_duration_s: float, segment: ReplaySegment
    ) -> None:
        time_s = segment.time_s
        logged_flag = segment.is_acceleration_bad
        if logged_flag is None:
            logged_flag = np.zeros(len(time_s), bool)
        self.uses_logged_flag = uses_logged_flag
        self.flag_duration_s = flag_duration_s
        flag_change_steps = np.flatnonzero(np.diff(logged_flag, prepend=False, append=False))
        self.logged_spans_s = np.append(time_s, np.inf)[flag_change_steps].reshape(-1, 2)
        self.since_s = np.full(len(uses_logged_flag), time_s[0])
        self.until_s = np.full(
            len(uses_logged_flag), time_s[0] + flag_duration_s * float(logged_flag[0])
        )

    def compute_bad_acceleration_fraction(self, begin_s: Array, end_s: Array) -> Array:
        """Return the fraction of a time interval with a bad acceleration, for each configuration.

        Call this method in time order.
        """
        if len(self.logged_spans_s):
            last_row = np.searchsorted(self.logged_spans_s[:, 0], end_s) - 1
            follows_log = self.uses_logged_flag & (last_row >= 0)
            self.since_s[follows_log], self.until_s[follows_log] = self.logged_spans_s[
                last_row[follows_log]
            ].T
        if not (self.until_s > begin_s).any():
            return np.zeros_like(self.until_s)
        overlap_s = np.minimum(self.until_s, end_s) - np.maximum(self.since_s, begin_s)
        return np.asarray(np.maximum(overlap_s, 0.0) / np.maximum(end_s - begin_s, 1e-9))

    def update(self, time_s: Array, previous_innovations: Array, innovations: Array) -> None:
        """Update the modelled flag after a fusion of heights.

        Parameters
        ----------
        time_s : ndarray, shape (filters,) or (1,)
            Time of the fusion.
        previous_innovations, innovations : ndarray, shape (k + 1, filters)
            Normalised height innovations (√S, positive upwards): k of the barometer, one of GNSS.
            NaN without a sample.
        """
        *previous_barometer, previous_gnss = previous_innovations
        *barometer, gnss = innovations
        # EKF2's test uses the latest innovation of each height sensor
        latest_barometer = np.full_like(gnss, np.nan)
        is_acceleration_bad = np.zeros(len(gnss), bool)
        for sample_number, sample in enumerate((*previous_barometer, *barometer), start=1):
            latest_barometer = np.where(np.isnan(sample), latest_barometer, sample)
            if sample_number >= len(previous_barometer):
                is_acceleration_bad |= _has_large_height_innovations(
                    latest_barometer, previous_gnss
                )
        is_acceleration_bad |= _has_large_height_innovations(latest_barometer, gnss)
        is_acceleration_bad &= ~self.uses_logged_flag
        self.since_s = np.where(is_acceleration_bad & (self.until_s < time_s), time_s, self.since_s)
        self.until_s = np.where(is_acceleration_bad, time_s + self.flag_duration_s, self.until_s)


def _has_large_height_innovations(barometer_innovation: Array, gnss_innovation: Array) -> BoolArray:
    """Return True if both height innovations are large: EKF2 then assumes that it is falling.

    The innovations are normalised (√S) and positive upwards (PX4: ``vert_innov_test``).
    """
    larger_innovation = np.maximum(barometer_innovation, gnss_innovation)
    smaller_innovation = np.minimum(barometer_innovation, gnss_innovation)
    return np.asarray(
        (larger_innovation > MIN_HEIGHT_INNOVATION_OF_ONE_SENSOR)
        & (smaller_innovation > MIN_HEIGHT_INNOVATION_OF_BOTH_SENSORS)
    )
