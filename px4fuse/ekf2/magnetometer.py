"""Fusion of all three magnetometer axes in the EKF2 replay, with earth and body fields as states.

The samples between two events (:mod:`px4fuse.ekf2.filter_recursion`) are averaged, and the mean is
fused at the later event, because the attitude error hardly changes between events.

Sources: PX4-Autopilot ``EKF/aid_sources/magnetometer`` (``mag_fusion.cpp``: fuseMag;
``mag_control.cpp``: R and its lower limit), ``EKF/covariance.cpp`` (process noise of the fields).
"""

from typing import NamedTuple

import numpy as np

from px4fuse.core.arrays import Array, IntArray
from px4fuse.ekf2.replay_segments import THETA, VELOCITY, ReplaySegment, SensorSamples
from px4fuse.trajectory.rotation import skew

# Minimum magnetometer noise (gauss) that EKF2 uses
MIN_MAGNETOMETER_SIGMA_GAUSS = 0.01
IDENTITY_MATRIX = np.eye(3)
# v @ CROSS_PRODUCT is the cross product matrix [v]× of a vector v, flattened
CROSS_PRODUCT_TENSOR = skew(IDENTITY_MATRIX).reshape(3, 9)


class EventSamples(NamedTuple):
    """Mean of the magnetometer or optical flow samples that are fused at each event.

    The shapes of the arrays begin with (events,) or (events, filters).

    Attributes
    ----------
    value : ndarray
        Magnetic field (gauss, FRD), or velocity forward and right (m/s).
    rotation_to_body : ndarray
        Mean rotation from NED to the body axes.
    sample_count : ndarray
    noise : ndarray
        R of one sample.
    """

    value: Array
    rotation_to_body: Array
    sample_count: Array
    noise: Array


def average_by_event(
    segment: ReplaySegment, sensor_samples: SensorSamples, event_steps: IntArray
) -> EventSamples:
    """Average the magnetometer or optical flow samples between two events (fused at the later)."""
    event_index = np.searchsorted(event_steps, sensor_samples.step_indices)
    is_inside = event_index < len(event_steps)
    event_count = len(event_steps)
    event_index = event_index[is_inside]
    sample_counts = np.maximum(np.bincount(event_index, minlength=event_count), 1)

    def mean(rows: Array) -> Array:
        event_sums = np.zeros((event_count, *rows.shape[1:]))
        np.add.at(event_sums, event_index, rows[is_inside])
        return np.asarray((event_sums.T / sample_counts).T)

    value, rotation_to_body, noise_variance = map(
        mean, (sensor_samples.value, sensor_samples.rotation_to_body, sensor_samples.noise)
    )
    if VELOCITY in sensor_samples.state_rows:
        # Optical flow samples exclude the velocity change since the start of the segment
        velocity_m_s = segment.imu_velocity_change_m_s[event_steps]
        value = value + np.einsum("eab,eb->ea", rotation_to_body, velocity_m_s)
    sample_count = np.bincount(event_index, sensor_samples.sample_count[is_inside], event_count)
    return EventSamples(value, rotation_to_body, np.asarray(sample_count, float), noise_variance)


def fuse_mean(
    x: Array,
    P: Array,
    sample_mean: EventSamples,
    gate: Array,
    state_rows: slice,
    bias_state_rows: slice | None = None,
) -> tuple[Array, Array, Array]:
    """Fuse the mean of magnetometer or optical flow samples in all filter configurations.

    Return state, covariance, and an array of shape (3, filters, components): innovation, the
    innovation variance of a single sample (for the gate), and 1 if fused; NaN without a sample.

    Parameters
    ----------
    sample_mean : EventSamples
        Mean of one event.
    gate : ndarray, shape (filters,)
        Innovation gate in √S.
    state_rows : slice
        Indices of the state vector (NED) that the sensor measures in the body frame.
    bias_state_rows : slice, optional
        Indices of the state vector (body frame) that is added to the measurement.
    """
    measured_state = x[:, state_rows]
    sample_count, R = sample_mean.sample_count, sample_mean.noise
    state_skew_matrix, theta_skew_matrix = (
        (vectors @ CROSS_PRODUCT_TENSOR).reshape(-1, 3, 3)
        for vectors in (measured_state, x[:, THETA])
    )
    H = np.zeros((len(x), sample_mean.value.shape[-1], x.shape[1]))
    H[:, :, THETA] = sample_mean.rotation_to_body @ state_skew_matrix
    H[:, :, state_rows] = sample_mean.rotation_to_body @ (IDENTITY_MATRIX - theta_skew_matrix)
    predicted_value = (H[:, :, state_rows] @ measured_state[:, :, None])[:, :, 0]
    if bias_state_rows is not None:
        H[:, :, bias_state_rows] = IDENTITY_MATRIX
        predicted_value += x[:, bias_state_rows]
    nu = sample_mean.value - predicted_value
    HP = H @ P
    S = HP @ H.transpose(0, 2, 1)
    # diagonal is a view of S: adding R to it changes S
    diagonal = S.reshape(len(S), -1)[:, :: nu.shape[1] + 1]
    innovation_record = np.empty((3, *nu.shape))
    innovation_record[0] = nu
    innovation_record[1] = diagonal + R[:, None]
    has_sample = sample_count > 0.0
    is_fused = has_sample & (nu * nu <= gate[:, None] ** 2 * innovation_record[1]).all(axis=1)
    innovation_record[2] = is_fused[:, None]
    innovation_record[:, ~has_sample] = np.nan
    diagonal += np.where(has_sample, R / np.maximum(sample_count, 1.0), 1.0)[:, None]
    K = (np.linalg.inv(S) @ HP).transpose(0, 2, 1) * is_fused[:, None, None]
    x = x + (K @ nu[:, :, None])[:, :, 0]
    P = P - K @ HP
    return x, 0.5 * (P + P.transpose(0, 2, 1)), innovation_record
