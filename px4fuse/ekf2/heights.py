"""Fusion of GNSS and barometer heights in the EKF2 replay.

EKF2 estimates a bias of the sensor that is not the height reference. Barometer samples between two
events (ends of intervals, see :mod:`px4fuse.ekf2.intervals`) are fused at the later event. The
vertical motion from sample to event is computed from the state and the IMU. Array shapes: E events,
S variants (filter configurations), k samples per event.

Sources: PX4-Autopilot ``EKF/aid_sources`` (``barometer/baro_height_control.cpp``,
``gnss/gnss_height_control.cpp``), before v1.16 ``EKF/baro_height_control.cpp`` and
``EKF/gnss_height_control.cpp``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from px4fuse.arrays import Array, BoolArray, IntArray
from px4fuse.ekf2.bias import BiasEstimator
from px4fuse.ekf2.replay_segments import (
    HeightSamples,
    ReplaySegment,
    pad_samples,
    sample_steps,
    samples_by_event,
)
from px4fuse.ekf2_parameters import AIDS, BAROMETER, GNSS_HGT, fuses_by_mask
from px4fuse.flight import GROUND_EFFECT, Ekf2, Flight, FusionRecord, step_values_at

VELOCITY_DOWN, DOWN = 5, 8
SENSORS = (BAROMETER, GNSS_HGT)
HEIGHTS = (*SENSORS, AIDS["rng_hgt"], AIDS["ev_hgt"])
DEFAULT_DEAD_ZONE_M = 4.0  # m; default of EKF2_GND_EFF_DZ
HEIGHT_REFERENCES = {0: BAROMETER.name, 1: GNSS_HGT.name}  # values of EKF2_HGT_REF
# Maximum time (s) from the start of the replay to the first logged height bias (logged at 2 Hz)
MAX_BIAS_LOG_DELAY_S = 1.0
# Barometer rate (Hz) in EKF2 from v1.15 on and before v1.15, and minimum logged rate for a replay.
# If the logged rate is below EKF2's rate, one logged sample represents several
BAROMETER_HZ, OLD_BAROMETER_HZ, MIN_BAROMETER_LOG_HZ = 10.0, 15.0, 4.0
# Minimum gate (√S), and minimum noise of position (m) and velocity (m/s)
MIN_GATE, MIN_SIGMA = 1.0, 0.01


def add_heights(
    flight: Flight, ekf2: Ekf2, record: FusionRecord, segments: Sequence[ReplaySegment]
) -> tuple[ReplaySegment, ...] | str:
    """Add height samples to the segments, or return the reason why the log is not sufficient."""
    parameters = record.parameters
    times = np.concatenate([segment.time_s for segment in segments])
    if fuses_by_mask(parameters):
        return "EKF2 before PX4 v1.14 fuses only one height sensor"
    enabled = {name: log.enabled for name, log in ekf2.aids.items() if log.enabled is not None}
    enabled_shares = {
        name: float(np.mean(step_values_at(is_enabled, times) > 0.0))
        for name, is_enabled in enabled.items()
    }
    fused = [aid.name for aid in SENSORS if enabled_shares.get(aid.name) == 1.0]
    if other_aids := [
        aid for aid in HEIGHTS if enabled_shares.get(aid.name) and aid.name not in fused
    ]:
        return f"EKF2 also fused {other_aids[0].label} in part of the flight"
    reference = HEIGHT_REFERENCES.get(int(parameters.get("EKF2_HGT_REF", 1.0)))
    if len(fused) == 1:  # a single sensor is the reference
        (reference,) = fused
    if reference not in fused:
        return "the height reference is neither GNSS nor barometer, or not logged"
    measured_at_s, down_m = np.zeros((2, 0))
    if BAROMETER.name in fused and flight.barometer is not None:
        measured_at_s = flight.barometer.index.to_numpy() - 0.5 * ekf2.step_s
        down_m = flight.barometer["down_m"].to_numpy() + record.altitude_m
    effect_height_m = parameters.get("EKF2_GND_EFF_DZ", DEFAULT_DEAD_ZONE_M)
    dead_zone_m = np.where(record.was_in_state(GROUND_EFFECT, measured_at_s), effect_height_m, 0.0)
    ekf2_rate_hz = OLD_BAROMETER_HZ if record.per_step_biases else BAROMETER_HZ
    new_segments = []
    delayed = record.delayed["down_m"]
    for segment in segments:
        start_s = float(segment.time_s[0])
        bias = (0.0, 0.0)
        for aid_name in {*fused} - {reference}:
            logged_bias = record.height_bias.get(aid_name)
            if (
                logged_bias is None
                or not logged_bias.index[0] - MAX_BIAS_LOG_DELAY_S < start_s < logged_bias.index[-1]
            ):
                return f"EKF2's bias of the {AIDS[aid_name].label} is not logged"
            value, variance = (
                np.interp(start_s, logged_bias.index, logged_bias[name]) for name in logged_bias
            )
            bias = float(value), float(variance)
        samples = barometer_samples_inside(segment, measured_at_s, down_m, dead_zone_m)
        rate_hz = len(samples[0]) / float(segment.time_s[-1] - start_s)
        if BAROMETER.name in fused and rate_hz < MIN_BAROMETER_LOG_HZ:
            return f"the barometer is logged at {rate_hz:.1f} Hz"
        weight = max(ekf2_rate_hz / rate_hz, 1.0) if rate_hz else 1.0
        state = segment.state.copy()
        state[DOWN] = np.interp(start_s, delayed.index, delayed)
        heights = HeightSamples(tuple(fused), reference, bias, *samples, weight)
        new_segments.append(replace(segment, state=state, heights=heights))
    return tuple(new_segments)


def barometer_samples_inside(
    segment: ReplaySegment, measured_at_s: Array, down_m: Array, dead_zone_m: Array
) -> tuple[IntArray, Array, Array, Array]:
    """Return prediction step, time (s), height (m, down) and dead zone (m) of barometer samples."""
    step, is_inside = sample_steps(segment, measured_at_s)
    return step, measured_at_s[is_inside], down_m[is_inside], dead_zone_m[is_inside]


def barometer_samples(segment: ReplaySegment, ends: Sequence[IntArray]) -> list[Array]:
    """Return barometer samples by the event at which they are fused, one array per ``ends``.

    Each element of ``ends`` contains the prediction steps of E events. Each array has shape
    (5, k, E). Rows: height (m, down), see
    :func:`~px4fuse.ekf2.replay_segments.samples_by_event`; sample age (s); sample time (s); dead
    zone (m); and 1. All are 0 without a sample.
    """
    heights = segment.heights
    assert heights is not None
    sample_columns = (
        heights.down_m[:, None],
        slice(2, 3),
        heights.measured_at_s,
        heights.dead_zone_m,
    )
    return pad_samples(
        [
            samples_by_event(segment, event_steps, heights.step, *sample_columns)
            for event_steps in ends
        ]
    )


class HeightFilter:
    """Height fusion of S variants through one segment, event by event.

    Parameters
    ----------
    segment : ReplaySegment
    barometer : ndarray, shape (5, k, E, S) or (5, k, E, 1)
        Result of :func:`barometer_samples`.
    fix_s, has_fix : ndarray, shape (E, S) or (E, 1)
        Measurement time of the GNSS fix of each event, and mask of the events with a fix.
    enabled : mapping from PX4's name of an aid to ndarray of bool, shape (E, S)
        True while the aid is fused.
    parameters : mapping from parameter name to ndarray, shape (S,)
    has_gate : ndarray of bool, shape (S,)
        True for variants that apply the gate.

    Attributes
    ----------
    update_log : ndarray, shape (E, k + 1, 3, S)
        For the k barometer samples and the GNSS height of each event: innovation (m, measurement
        minus state), its variance (m²), and 1 if fused.
    """

    def __init__(
        self,
        segment: ReplaySegment,
        barometer: Array,
        fix_s: Array,
        has_fix: BoolArray,
        enabled: Mapping[str, BoolArray],
        parameters: Mapping[str, Array],
        has_gate: BoolArray,
    ) -> None:
        heights = segment.heights
        size = len(has_gate)
        assert heights is not None
        self.fused = heights.fused
        self.down_m, self.age_s, measured_at_s, self.dead_zone_m, is_sample = barometer
        self.time_s = [*measured_at_s, fix_s]
        self.update_log = np.full((len(fix_s), len(self.time_s), 3, size), np.nan)
        has_fix = has_fix & enabled[GNSS_HGT.name] & (GNSS_HGT.name in heights.fused)
        self.has_sample = [*((is_sample > 0.0) & enabled[BAROMETER.name]), has_fix]
        self.any = [np.any(each, axis=1).tolist() for each in self.has_sample]
        self.in_ground_effect = self.dead_zone_m.any(axis=2)
        gates = [np.maximum(parameters.get(aid.gate, MIN_GATE), MIN_GATE) for aid in SENSORS]
        self.gate2 = [np.where(has_gate, gate**2, np.inf) for gate in gates]
        self.noise_m2 = np.maximum(parameters.get(BAROMETER.noise, MIN_SIGMA), MIN_SIGMA) ** 2
        self.biased = [aid.name != heights.reference for aid in SENSORS]
        self.weight = (heights.weight, 1.0)
        self.learning = enabled[heights.reference]
        value_m, variance_m2 = (np.full(size, part) for part in heights.bias)
        start_s = float(segment.time_s[0])
        step_s = float(np.median(segment.step_s))
        self.bias = BiasEstimator(value_m, variance_m2, start_s, step_s)

    def updates(self, sensor: str, variant: int, end_s: Array) -> pd.DataFrame:
        """Return the updates of one variant with one sensor, indexed by EKF2's measurement time.

        ``end_s`` is the time of each event.
        """
        rows = []
        slots = len(self.down_m)
        for slot in [slots] if sensor == GNSS_HGT.name else range(slots):
            times = self.time_s[slot]
            has_sample = self.has_sample[slot][:, variant]
            measured_s = times[has_sample, min(variant, times.shape[1] - 1)]
            rows.append(
                np.vstack(
                    [measured_s, self.update_log[has_sample, slot, :, variant].T, end_s[has_sample]]
                )
            )
        measured_s, nu, S, fused, end_s = np.hstack(rows)
        columns = {"innovation_down_m": nu, "innovation_variance_down_m2": S}
        columns |= {"rejected": 1.0 - fused, "fused": fused, "fused_at_s": end_s}
        return pd.DataFrame(columns, pd.Index(measured_s, name="time_s")).sort_index()

    def fuse(
        self, e: int, x: Array, P: Array, gnss_m: Array, gnss_m2: Array
    ) -> tuple[Array, Array]:
        """Return state and covariance after fusing barometer and GNSS height at one event.

        ``gnss_m`` and ``gnss_m2`` are the GNSS height (m, down) and its R.
        """
        for slot in range(len(self.down_m)):
            if self.any[slot][e]:
                age_s = self.age_s[slot, e]
                column = P[:, :, DOWN] - age_s[:, None] * P[:, :, VELOCITY_DOWN]
                predicted_variance = column[:, DOWN] - age_s * column[:, VELOCITY_DOWN]
                nu = self.down_m[slot, e] - x[:, DOWN] + age_s * x[:, VELOCITY_DOWN]
                x, P = self._fuse_innovation(
                    e, slot, 0, x, P, column, predicted_variance, nu, self.noise_m2
                )
        if self.any[-1][e]:
            column = P[:, :, DOWN]
            nu = gnss_m - x[:, DOWN]
            x, P = self._fuse_innovation(e, -1, 1, x, P, column, column[:, DOWN], nu, gnss_m2)
        return x, P

    def _fuse_innovation(
        self,
        e: int,
        slot: int,
        sensor_index: int,
        x: Array,
        P: Array,
        column: Array,
        predicted_variance: Array,
        nu: Array,
        R: Array,
    ) -> tuple[Array, Array]:
        """Fuse one innovation; ``column`` is PH', ``predicted_variance`` HPH'."""
        if self.biased[sensor_index]:
            has_sample = self.has_sample[slot][e]
            time_s = self.time_s[slot][e]
            nu, R = self.bias.remove_bias(
                nu,
                predicted_variance,
                R,
                time_s,
                has_sample,
                self.learning[e],
                self.weight[sensor_index],
            )
        if sensor_index == 0 and self.in_ground_effect[slot, e]:
            nu = np.where(nu > 0.0, np.maximum(nu - self.dead_zone_m[slot, e], 0.0), nu)
        S = predicted_variance + R
        is_fused = self.has_sample[slot][e] & (nu * nu <= self.gate2[sensor_index] * S)
        self.update_log[e, slot] = nu, S, is_fused
        K = column * (is_fused / (predicted_variance + R / self.weight[sensor_index]))[:, None]
        return x + K * nu[:, None], P - K[:, :, None] * column[:, None]
