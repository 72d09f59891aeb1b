"""Prediction steps of KF: a step ends at each multiple of DT and at each measurement."""

from dataclasses import dataclass

import numpy as np

from px4fuse.core.arrays import Array, IntArray
from px4fuse.errors import SettingsError
from px4fuse.flight.model import Unavailable

from .settings import Settings
from .signals import Axis, compute_mean_step_acceleration

# Timestamps with a smaller difference (s) are equal: half of PX4's resolution of 1 µs
MAX_DIFFERENCE_OF_EQUAL_TIMES_S = 5e-7


@dataclass(frozen=True)
class PredictionSteps:
    """Prediction steps of KF, and the acceleration in each step.

    Attributes
    ----------
    time_s : ndarray, shape (n,)
        Time of the initial state, then end of each step.
    measurement_index : ndarray of int, shape (n,)
        Index of the measurement at each time, or -1.
    last_steps : ndarray of int, shape (m,)
        Index in ``time_s`` of each measurement, which is the end of the interval since the previous
        measurement.
    interval_index : ndarray of int, shape (n - 1,)
        Index of the interval between measurements that contains each prediction step.
    acceleration_m_s2 : ndarray, shape (n - 1,)
        Mean acceleration over each step.
    imu_gap_variance_m2_s4 : ndarray, shape (n - 1,)
        Additional acceleration variance in gaps of the IMU.
    input_gap_s : float
        Time without IMU data.
    """

    time_s: Array
    measurement_index: IntArray
    last_steps: IntArray
    interval_index: IntArray
    acceleration_m_s2: Array
    imu_gap_variance_m2_s4: Array
    input_gap_s: float

    def compute_time_to_interval_end_s(self) -> Array:
        """Return the time (s) from the end of each prediction step to the next measurement.

        It is 0 for a step that ends at a measurement.
        """
        return self.time_s[self.last_steps[self.interval_index]] - self.time_s[1:]


def make_prediction_steps(axis: Axis, settings: Settings) -> PredictionSteps:
    """Return the prediction steps of KF along an axis.

    KF starts at the first measurement, which is its initial position.

    Raises
    ------
    SettingsError
        ``settings.input`` is "imu" and the axis has no acceleration, or no measurement is later
        than the first one.
    """
    start_s = axis.measurement_time_s[0]
    is_usable = axis.measurement_time_s > start_s + MAX_DIFFERENCE_OF_EQUAL_TIMES_S
    measurement_time_s = axis.measurement_time_s[is_usable]
    if not len(measurement_time_s):
        raise SettingsError(
            f"Axis {axis.name} has no position after the initial time of KF, {start_s:.2f} s."
        )
    # A step ends at each multiple of DT and at each measurement
    grid_point_count = int(np.floor((measurement_time_s[-1] - start_s) / settings.dt_s + 1e-9)) + 1
    grid_s = start_s + settings.dt_s * np.arange(grid_point_count)
    # Multiples of DT that equal a measurement time are omitted, so that no step has zero length
    measurement_numbers = np.arange(len(measurement_time_s))
    nearest_index = np.rint(np.interp(grid_s, measurement_time_s, measurement_numbers)).astype(int)
    time_to_measurement_s = np.abs(measurement_time_s[nearest_index] - grid_s)
    time_s = np.union1d(
        grid_s[time_to_measurement_s > MAX_DIFFERENCE_OF_EQUAL_TIMES_S], measurement_time_s
    )
    # Attributes of PredictionSteps. A step belongs to the interval of the next measurement at or
    # after its end
    measurement_index = np.full(len(time_s), -1, dtype=np.intp)
    measurement_index[np.searchsorted(time_s, measurement_time_s)] = np.flatnonzero(is_usable)
    last_steps = np.flatnonzero(measurement_index >= 0)
    interval_index = np.searchsorted(last_steps, np.arange(1, len(time_s)))
    acceleration_m_s2 = gap_s = imu_gap_variance_m2_s4 = np.zeros(len(time_s) - 1)
    if settings.input == "imu":
        if isinstance(axis.acceleration, Unavailable):
            raise SettingsError(
                f"The setting `input` is imu, but the axis {axis.name} has no IMU acceleration.",
                f"{axis.acceleration}",
            )
        acceleration_m_s2, gap_fraction = compute_mean_step_acceleration(
            axis.acceleration, axis.direction, time_s
        )
        gap_s = gap_fraction * np.diff(time_s)
        # Unlike white noise, the unknown acceleration is constant in an IMU gap of T seconds. This
        # increases the velocity variance by the factor T/DT
        gap_duration_in_interval_s = np.bincount(interval_index, weights=gap_s)[interval_index]
        gap_variance_factor = np.maximum(gap_duration_in_interval_s / settings.dt_s, 1.0)
        mean_square_m2_s4 = axis.acceleration.compute_rms_m_s2(axis.direction) ** 2
        imu_gap_variance_m2_s4 = gap_fraction * gap_variance_factor * mean_square_m2_s4
    return PredictionSteps(
        time_s,
        measurement_index,
        last_steps,
        interval_index,
        acceleration_m_s2,
        imu_gap_variance_m2_s4,
        float(np.sum(gap_s)),
    )
