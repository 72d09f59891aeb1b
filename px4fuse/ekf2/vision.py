"""Positions of external vision as EKF2 fuses them besides GNSS: about a frame of their own.

How far that frame is from EKF2's is a bias, which follows within seconds, so that vision tells how
the vehicle moves, and GNSS where it is. Without GNSS there is no bias: EKF2 then resets its
position to vision's. Samples between two events are fused at the later one, as measurements of
position and velocity then: where the vehicle was before is known from both and the IMU.

Sources: PX4-Autopilot ``EKF/aid_sources/external_vision`` (``ev_pos_control.cpp``; before v1.16
``EKF/ev_pos_control.cpp``), ``EKF/control.cpp`` (vision comes after GNSS and heights).
"""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from px4fuse.arrays import Array, BoolArray, IntArray
from px4fuse.ekf2.bias import Bias
from px4fuse.ekf2.heights import MIN_GATE, MIN_SD
from px4fuse.ekf2.inputs import Inputs
from px4fuse.ekf2.intervals import MAX_LATE_S
from px4fuse.ekf2.stretches import Stretch, by_event, padded
from px4fuse.ekf2_parameters import EV_POS, GNSS_POS

SPEED, HORIZONTAL = slice(3, 5), slice(6, 8)
# After so long without a sample fusion stops (2 EV_MAX_INTERVAL, ev_control.cpp); after so long
# outside the gate the bias, or the position, begins anew (no_aid_timeout_max, common.h)
STOP_S, FAILING_S = 0.4, 1.0
COLUMNS = [
    "innovation_north_m",
    "innovation_east_m",
    "innovation_variance_north_m2",
    "innovation_variance_east_m2",
    "rejected",
    "fused",
    "reset",
]


def vision_samples(
    inputs: Inputs, stretch: Stretch, end: IntArray, settings: Mapping[str, float], horizon_s: float
) -> Array:
    """Samples by the event at which they are fused, shape (8, k, E).

    North and east at the event as :func:`~px4fuse.ekf2.stretches.by_event` has them, age then, time
    of measurement, time of fusion, the variances that the sender states, and 1.
    """
    vision, time_s = inputs.vision, stretch.time_s
    assert vision is not None
    taken_s = vision.stamp_s - settings[EV_POS.delay] * 1e-3 - 0.5 * inputs.step_s
    due_s = np.maximum(taken_s, vision.arrival_s - horizon_s)
    step = np.maximum.accumulate(np.searchsorted(time_s, due_s - 1e-9))
    kept = (step > 0) & (step < len(time_s)) & (due_s < taken_s + MAX_LATE_S)
    kept &= np.isfinite(vision.position_m[:, 0])
    kept[:-1] &= step[1:] > step[:-1]  # of two samples in one step the newer one is fused
    step = step[kept]
    place_m = np.array([settings[name] for name in EV_POS.place]) - inputs.imu_offset_m
    position_m = (vision.position_m[kept] - stretch.rotation[step] @ place_m)[:, :2]
    more = taken_s[kept], time_s[step], *vision.variance_m2[kept, :2].T
    return by_event(stretch, end, step, position_m, slice(0, 2), *more)


class VisionFilter:
    """The positions of vision in S variants through one stretch, event by event.

    Parameters
    ----------
    stretch : Stretch
    sent : sequence of S ndarrays, shape (8, k, E)
        As :func:`vision_samples` has them.
    on : mapping from PX4's name of an aid to ndarray of bool, shape (E, S)
        Whether it is still there.
    knob : mapping from PX4's name to ndarray, shape (S,)
    gated, reported : ndarray of bool, shape (S,)
        Whether there is a gate, and whether the sender's variances are used.

    Attributes
    ----------
    told : ndarray, shape (E, k, 7, S)
        Of each sample innovation (m, measurement minus state) and its variance, north and east, and
        whether it was rejected, fused, and the position reset to it; NaN where EKF2 did not try.
    moved_m : ndarray, shape (E, S, 2)
        By how much the position was reset at each event.
    fused_s : ndarray, shape (S,)
        When the position was last fused or reset.
    """

    def __init__(
        self,
        stretch: Stretch,
        sent: Sequence[Array],
        on: Mapping[str, BoolArray],
        knob: Mapping[str, Array],
        gated: BoolArray,
        reported: BoolArray,
    ) -> None:
        samples = np.stack(padded(sent), axis=-1)
        self.position_m = np.moveaxis(samples[:2], 0, -1)
        self.age_s, self.taken_s, self.now_s = samples[2:5]
        _, count, events, size = samples.shape
        self.told = np.full((events, count, 7, size), np.nan)
        self.moved_m = np.zeros((events, size, 2))
        seen = (samples[7] > 0.0) & on[EV_POS.name]
        # those of the event's own step come after GNSS
        self.seen = [seen & (self.age_s > 0.0), seen & (self.age_s == 0.0)]
        self.gated, self.alone = gated, ~on[GNSS_POS.name]
        self.gate2 = np.maximum(knob[EV_POS.gate], MIN_GATE)[:, None] ** 2
        stated = samples[5:7] * (reported & (knob[EV_POS.noise_mode] != 1.0))
        least = np.maximum(knob[EV_POS.noise], MIN_SD) ** 2
        with_gnss = np.where(self.alone, 0.0, knob[GNSS_POS.noise] ** 2)
        self.noise_m2 = np.moveaxis(np.maximum(stated, np.maximum(least, with_gnss)), 0, -1)
        start_s = float(stretch.time_s[0])
        unknown = np.full((size, 2), np.inf)
        self.bias = Bias(np.zeros((size, 2)), unknown, start_s, float(np.median(stretch.step_s)))
        self.seen_s, self.tried_s = np.full((2, size), -np.inf)
        self.fused_s, self.was_alone = np.full(size, start_s), self.alone[0]

    def updates(self, variant: int, end_s: Array) -> pd.DataFrame:
        """What one variant did with each sample, by the time of measurement as EKF2 takes it.

        ``end_s`` is the time of each event.
        """
        told = self.told[..., variant]
        event, place = np.nonzero(np.isfinite(told[:, :, 0]))
        index = pd.Index(self.taken_s[place, event, variant], name="time_s")
        found = pd.DataFrame(told[event, place], index, COLUMNS)
        return found.assign(fused_at_s=end_s[event])

    def fuse(self, e: int, x: Array, P: Array, own_step: bool, fix_s: Array) -> tuple[Array, Array]:
        """State and covariance after the samples of one event.

        Parameters
        ----------
        e : int
        x, P : ndarray
        own_step : bool
            Of the event's own step, or those before.
        fix_s : ndarray, shape (S,)
            When a position was last fused otherwise.
        """
        for place, seen in enumerate(self.seen[own_step][:, e]):
            if seen.any():
                x, P = self._take(e, place, seen, x, P, fix_s)
        return x, P

    def _take(
        self, e: int, place: int, seen: BoolArray, x: Array, P: Array, fix_s: Array
    ) -> tuple[Array, Array]:
        age_s, now_s = self.age_s[place, e][:, None], self.now_s[place, e]
        alone, noise_m2 = self.alone[e], self.noise_m2[place, e]
        HP = P[:, HORIZONTAL] - age_s[:, None] * P[:, SPEED]
        S = HP[:, :, HORIZONTAL] - age_s[:, None] * HP[:, :, SPEED]
        diagonal = S.reshape(len(S), -1)[:, ::3]  # a view
        off_m = self.position_m[place, e] - x[:, HORIZONTAL] + age_s * x[:, SPEED]
        each = now_s[:, None], seen[:, None], ~alone[:, None]
        nu, R = self.bias.corrected(off_m, diagonal.copy(), noise_m2, *each)
        diagonal += R
        started = (now_s - self.seen_s > STOP_S) | (alone != self.was_alone)
        outside = (nu * nu > self.gate2 * diagonal).any(axis=1) & self.gated & ~started
        failing = outside & (now_s - self.tried_s > FAILING_S)
        restart, taken = seen & (started | failing), seen & ~outside & ~started
        reset = restart & (alone | (failing & (now_s - fix_s > FAILING_S)))
        tried = seen & ~started | reset
        # a reset leaves nothing of the innovation
        told = *np.where(reset, 0.0, nu.T), *diagonal.T, outside & ~reset, taken, reset
        self.told[e, place] = np.where(tried, np.stack(told), np.nan)
        K = (np.linalg.inv(S) @ HP).transpose(0, 2, 1) * taken[:, None, None]
        x, P = x + (K @ nu[:, :, None])[:, :, 0], P - K @ HP
        if reset.any():
            moved_m = np.where(alone[:, None], off_m, nu) * reset[:, None]
            variance = np.where(alone[:, None], noise_m2, R)
            set_states(x, P, reset, HORIZONTAL, x[:, HORIZONTAL] + moved_m, variance)
            self.moved_m[e] += moved_m
        if restart.any():
            anew, gone = (restart & ~reset)[:, None], (reset & alone)[:, None]
            self.bias.value_m = np.where(anew, -off_m, np.where(gone, 0.0, self.bias.value_m))
            self.bias.variance_m2 = np.where(gone, 0.0, self.bias.variance_m2)
        self.seen_s = np.where(seen, now_s, self.seen_s)
        self.tried_s = np.where(taken | restart, now_s, self.tried_s)
        self.fused_s = np.where(taken | reset, now_s, self.fused_s)
        self.was_alone = np.where(seen, alone, self.was_alone)
        return x, P


def set_states(
    x: Array, P: Array, which: BoolArray, rows: slice, value: Array, variance: Array
) -> None:
    """Set some states of some variants to what was measured, with its variance."""
    x[which, rows] = value[which]
    P[which, :, rows] = 0.0
    P[which, rows, :] = 0.0
    P[which, rows, rows] = np.eye(value.shape[1]) * variance[which][:, :, None]
