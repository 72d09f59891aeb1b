"""EKF2's flag for a bad vertical acceleration (``fs_bad_acc_vertical``), from innovations.

EKF2 sets the flag if the barometer and GNSS both show that the vehicle is above the state: one
innovation is above 3 √S, and one of the other sensor above √S. EKF2 resets the flag some seconds
after the last such innovation. While it is set, the accelerometer noise is increased, the
accelerometer bias is constant, and vertical innovations outside the gate are clipped and fused.

Source: PX4-Autopilot ``EKF/height_control.cpp`` (checkVerticalAccelerationHealth,
estimateInertialNavFallingLikelihood).
"""

import numpy as np

from px4fuse.core.arrays import Array, BoolArray
from px4fuse.ekf2.replay_segments import ReplaySegment

# Minimum innovation (√S) of one sensor for setting the flag (vert_innov_test_lim, common.h)
MIN_LARGER_RATIO = 3.0
# Minimum innovation (√S) of the other sensor for setting the flag (vert_innov_test_min, common.h)
MIN_SMALLER_RATIO = 1.0


class BadAcceleration:
    """Flag for a bad vertical acceleration in S filter configurations.

    Parameters
    ----------
    follows_log : ndarray of bool, shape (S,)
        True for filter configurations with the logged flag.
    duration_s : float
        Time from the last sign of a bad acceleration to the reset of the flag.
    segment : ReplaySegment
        Segment with the logged flag.

    Attributes
    ----------
    since_s, until_s : ndarray, shape (S,)
        Start and end of the latest time with the flag.
    models_flag : bool
        True if the flag of any filter configuration is modelled.
    """

    def __init__(self, follows_log: BoolArray, duration_s: float, segment: ReplaySegment) -> None:
        time_s = segment.time_s
        is_logged = segment.is_acceleration_bad
        if is_logged is None:
            is_logged = np.zeros(len(time_s), bool)
        self.models_flag = not follows_log.all()
        self.follows_log = follows_log
        self.duration_s = duration_s
        edges = np.flatnonzero(np.diff(is_logged, prepend=False, append=False))
        self.logged_since_s, self.logged_until_s = np.append(time_s, np.inf)[edges].reshape(-1, 2).T
        self.since_s = np.full(len(follows_log), time_s[0])
        self.until_s = np.full(len(follows_log), time_s[0] + duration_s * float(is_logged[0]))
        # latest innovations (√S) of barometer and GNSS, and the largest of these innovations
        self.ratios = np.full((2, len(follows_log)), np.nan)
        self.largest_ratio = 0.0

    def share(self, begin_s: Array, end_s: Array) -> Array | None:
        """Return the fraction of an interval in which the flag is set; None if it is not set.

        Call this method for successive intervals: a flag that follows the log gets the logged value
        at the end of the interval.
        """
        if len(self.logged_since_s):
            row = np.searchsorted(self.logged_since_s, end_s) - 1
            has_begun = self.follows_log & (row >= 0)
            self.since_s = np.where(has_begun, self.logged_since_s[row], self.since_s)
            self.until_s = np.where(has_begun, self.logged_until_s[row], self.until_s)
        if not (self.until_s > begin_s).any():
            return None
        duration_s = np.minimum(self.until_s, end_s) - np.maximum(self.since_s, begin_s)
        return np.asarray(np.maximum(duration_s, 0.0) / np.maximum(end_s - begin_s, 1e-9))

    def update(self, time_s: Array, ratios: Array) -> None:
        """Update the modelled flag after all fusions of one event.

        Parameters
        ----------
        time_s : ndarray, shape (S,) or (1,)
            Time of the event.
        ratios : ndarray, shape (k + 1, S)
            State minus measurement (down) in √S: of the barometer samples before the event, and the
            larger one of GNSS height and GNSS velocity. NaN without a sample.
        """
        previous_ratios, self.ratios = self.ratios, ratios
        previous_largest, self.largest_ratio = self.largest_ratio, np.fmax.reduce(ratios, axis=None)
        if max(previous_largest, self.largest_ratio) <= MIN_LARGER_RATIO:
            return
        # an innovation is valid until the next innovation of the same sensor
        gnss = previous_ratios[-1]
        pressure = np.full(len(gnss), np.nan)
        for ratio in previous_ratios[:-1]:
            pressure = np.where(np.isnan(ratio), pressure, ratio)
        is_bad = _is_falling(pressure, gnss)
        for ratio in ratios[:-1]:
            pressure = np.where(np.isnan(ratio), pressure, ratio)
            is_bad |= _is_falling(pressure, gnss)
        is_bad |= _is_falling(pressure, ratios[-1])
        is_bad &= ~self.follows_log
        self.since_s = np.where(is_bad & (self.until_s < time_s), time_s, self.since_s)
        self.until_s = np.where(is_bad, time_s + self.duration_s, self.until_s)


def _is_falling(pressure_ratio: Array, gnss_ratio: Array) -> BoolArray:
    larger = np.maximum(pressure_ratio, gnss_ratio)
    smaller = np.minimum(pressure_ratio, gnss_ratio)
    return np.asarray((larger > MIN_LARGER_RATIO) & (smaller > MIN_SMALLER_RATIO))
