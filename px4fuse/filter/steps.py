"""Prediction steps of KF: a step ends at each multiple of DT and at each measurement."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from px4fuse.core.arrays import Array, IntArray
from px4fuse.errors import SettingsError
from px4fuse.filter.settings import InitialState, Settings
from px4fuse.filter.signals import Axis, compute_mean_step_acceleration
from px4fuse.flight.model import Unavailable

# Timestamps with a smaller difference (s) are equal: half of PX4's resolution of 1 µs
MAX_EQUAL_TIME_DIFFERENCE_S = 5e-7


@dataclass(frozen=True)
class PredictionSteps:
    """Prediction steps of KF, and the acceleration in each step.

    Attributes
    ----------
    time_s : ndarray, shape (n,)
        Time of the initial state, then end of each step.
    measurement_index : ndarray of int, shape (n,)
        Index of the measurement at each time, or -1.
    acceleration_m_s2 : ndarray, shape (n - 1,)
        Mean acceleration over each step.
    input_variance_m2_s4 : ndarray, shape (n - 1,)
        Additional acceleration variance in gaps of the IMU.
    input_gap_s : float
        Time without IMU data.
    """

    time_s: Array
    measurement_index: IntArray
    acceleration_m_s2: Array
    input_variance_m2_s4: Array
    input_gap_s: float

    @cached_property
    def last_steps(self) -> IntArray:
        """Index of the last step of each interval between measurements."""
        return np.flatnonzero(self.measurement_index >= 0)

    @cached_property
    def interval_index(self) -> IntArray:
        """Index of the interval between measurements that contains each step, shape (n - 1,)."""
        return np.searchsorted(self.last_steps, np.arange(1, len(self.time_s)))

    @cached_property
    def time_to_interval_end_s(self) -> Array:
        """Time from the end of each step to the end of its interval, shape (n - 1,)."""
        return np.asarray(self.time_s[self.last_steps[self.interval_index]] - self.time_s[1:])


def make_prediction_steps(
    axis: Axis, settings: Settings, initial_state: InitialState | None = None
) -> PredictionSteps:
    """Return the prediction steps of KF along an axis.

    Raises
    ------
    SettingsError
        ``settings.input`` is "imu" and the axis has no acceleration, or no measurement is later
        than the initial state.
    """
    start_s = axis.measurement_time_s[0] if initial_state is None else initial_state.time_s
    is_usable = axis.measurement_time_s > start_s + MAX_EQUAL_TIME_DIFFERENCE_S
    measurement_time_s = axis.measurement_time_s[is_usable]
    if not len(measurement_time_s):
        raise SettingsError(
            f"Axis {axis.name} has no position after the initial time of KF, {start_s:.2f} s."
        )
    grid_count = int(np.floor((measurement_time_s[-1] - start_s) / settings.dt_s + 1e-9)) + 1
    grid_s = start_s + settings.dt_s * np.arange(grid_count)
    # Multiples of DT that equal a measurement time are omitted, so that no step has zero length
    nearest_index = np.rint(
        np.interp(grid_s, measurement_time_s, np.arange(len(measurement_time_s)))
    ).astype(int)
    time_to_measurement_s = np.abs(measurement_time_s[nearest_index] - grid_s)
    time_s = np.union1d(
        grid_s[time_to_measurement_s > MAX_EQUAL_TIME_DIFFERENCE_S], measurement_time_s
    )
    if time_s[0] > start_s + MAX_EQUAL_TIME_DIFFERENCE_S:
        time_s = np.append(start_s, time_s)
    measurement_index = np.full(len(time_s), -1, dtype=np.intp)
    measurement_index[np.searchsorted(time_s, measurement_time_s)] = np.flatnonzero(is_usable)
    zeros = np.zeros(len(time_s) - 1)
    steps = PredictionSteps(time_s, measurement_index, zeros, zeros, 0.0)
    if settings.input == "zero":
        return steps
    if isinstance(axis.acceleration, Unavailable):
        raise SettingsError(
            f"The setting `input` is imu, but the axis {axis.name} has no IMU acceleration.",
            f"{axis.acceleration}",
        )
    mean_acceleration_m_s2, gap_fraction = compute_mean_step_acceleration(
        axis.acceleration, axis.direction, time_s
    )
    gap_s = gap_fraction * np.diff(time_s)
    # Unlike white noise, the unknown acceleration is constant in an IMU gap of T seconds. This
    # increases the velocity variance by the factor T/DT
    gap_in_interval_s = np.bincount(steps.interval_index, weights=gap_s)[steps.interval_index]
    gap_variance_m2_s4 = (
        gap_fraction
        * np.maximum(gap_in_interval_s / settings.dt_s, 1.0)
        * axis.acceleration.compute_rms_m_s2(axis.direction) ** 2
    )
    return replace(
        steps,
        acceleration_m_s2=mean_acceleration_m_s2,
        input_variance_m2_s4=gap_variance_m2_s4,
        input_gap_s=float(np.sum(gap_s)),
    )
