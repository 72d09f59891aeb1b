"""EKF2's flag for a bad vertical acceleration (``fs_bad_acc_vertical``), from innovations.

EKF2 sets the flag if barometer and GNSS both measure a larger height than the state, one of them by
more than 3 √S, the other by more than √S. While the flag is set, the accelerometer noise is
increased, the accelerometer bias is constant, and vertical innovations outside the gate are clipped
instead of rejected.

Source: PX4-Autopilot ``EKF/height_control.cpp`` (checkVerticalAccelerationHealth,
estimateInertialNavFallingLikelihood).
"""

import numpy as np

from px4fuse.core.arrays import Array, BoolArray
from px4fuse.ekf2.replay_segments import ReplaySegment

# Minimum larger innovation (√S) of barometer and GNSS height for a bad acceleration
# (vert_innov_test_lim, common.h)
MIN_LARGER_RATIO = 3.0
# Minimum smaller innovation (√S) of barometer and GNSS height for a bad acceleration
# (vert_innov_test_min, common.h)
MIN_SMALLER_RATIO = 1.0


class BadAcceleration:
    """Flag for a bad vertical acceleration in S filter configurations.

    Parameters
    ----------
    follows_log : ndarray of bool, shape (S,)
        True for configurations that use the logged flag.
    duration_s : float
        Time for which the flag remains set after the last innovation that sets it.
    segment : ReplaySegment
        Segment with the logged flag.

    Attributes
    ----------
    since_s, until_s : ndarray, shape (S,)
        Start and end of the latest time with the flag.
    models_flag : bool
        True if any configuration does not use the logged flag.
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

    def flagged_fraction(self, begin_s: Array, end_s: Array) -> Array | None:
        """Return the fraction of an interval with the flag, per configuration; None without a flag.

        Each call continues the logged flag, so call it for successive intervals. If the flag is
        set several times in an interval, only the last time counts.
        """
        if len(self.logged_since_s):
            last_row = np.searchsorted(self.logged_since_s, end_s) - 1
            has_begun = self.follows_log & (last_row >= 0)
            self.since_s = np.where(has_begun, self.logged_since_s[last_row], self.since_s)
            self.until_s = np.where(has_begun, self.logged_until_s[last_row], self.until_s)
        if not (self.until_s > begin_s).any():
            return None
        overlap_s = np.minimum(self.until_s, end_s) - np.maximum(self.since_s, begin_s)
        return np.asarray(np.maximum(overlap_s, 0.0) / np.maximum(end_s - begin_s, 1e-9))

    def update(self, time_s: Array, previous_ratios: Array, ratios: Array) -> None:
        """Update the modelled flag after all fusions of one event.

        Parameters
        ----------
        time_s : ndarray, shape (S,) or (1,)
            Time of the event.
        previous_ratios, ratios : ndarray, shape (k + 1, S)
            Measured height above the state, in √S, at the previous and at this event: of k
            barometer samples, then of GNSS. NaN without a sample.
        """
        # an innovation is valid until the next innovation of the same sensor
        gnss_ratio = previous_ratios[-1]
        barometer_ratio = np.full(len(gnss_ratio), np.nan)
        for sample_ratio in previous_ratios[:-1]:
            barometer_ratio = np.where(np.isnan(sample_ratio), barometer_ratio, sample_ratio)
        is_bad = _is_falling(barometer_ratio, gnss_ratio)
        for sample_ratio in ratios[:-1]:
            barometer_ratio = np.where(np.isnan(sample_ratio), barometer_ratio, sample_ratio)
            is_bad |= _is_falling(barometer_ratio, gnss_ratio)
        is_bad |= _is_falling(barometer_ratio, ratios[-1])
        is_bad &= ~self.follows_log
        self.since_s = np.where(is_bad & (self.until_s < time_s), time_s, self.since_s)
        self.until_s = np.where(is_bad, time_s + self.duration_s, self.until_s)


def _is_falling(barometer_ratio: Array, gnss_ratio: Array) -> BoolArray:
    larger_ratio = np.maximum(barometer_ratio, gnss_ratio)
    smaller_ratio = np.minimum(barometer_ratio, gnss_ratio)
    return np.asarray((larger_ratio > MIN_LARGER_RATIO) & (smaller_ratio > MIN_SMALLER_RATIO))
