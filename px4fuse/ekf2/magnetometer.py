"""Fusion of a three-axis magnetometer in the EKF2 replay.

The magnetic fields of earth and body are states. The samples between two fusions are averaged.

Sources: PX4-Autopilot ``EKF/aid_sources/magnetometer`` (``mag_fusion.cpp``: fuseMag;
``mag_control.cpp``: R and its lower limit), ``EKF/covariance.cpp`` (process noise of the fields).
"""

from typing import NamedTuple

import numpy as np

from px4fuse.core.arrays import Array, IntArray
from px4fuse.trajectory.rotation import skew

from .replay_segments import THETA, VELOCITY, ReplaySegment, SensorSamples

# Minimum magnetometer noise (gauss) that EKF2 uses
MIN_MAGNETOMETER_SIGMA_GAUSS = 0.01


class EventSamples(NamedTuple):
    """Mean of the magnetometer or optical flow samples of each fusion.

    The shapes of the arrays begin with (events,) or (events, filters).

    Attributes
    ----------
    value : ndarray
        Magnetic field (gauss, FRD), or velocity forward and right (m/s).
    ned_to_body_rotation : ndarray
        Mean rotation from NED to the body axes.
    noise : ndarray
        R of one sample.
    """

    value: Array
    ned_to_body_rotation: Array
    sample_count: Array
    noise: Array


def average_by_event(
    segment: ReplaySegment, sensor_samples: SensorSamples, event_end_steps: IntArray
) -> EventSamples:
    """Return the mean of the magnetometer or optical flow samples before each fusion."""
    # Index of the event (fusion) at or after each sample
    event_index = np.searchsorted(event_end_steps, sensor_samples.step_indices)
    # Samples after the last event are collected in one more row, which is omitted at the end
    row_count = len(event_end_steps) + 1
    mean_count_by_event = np.maximum(np.bincount(event_index, minlength=row_count), 1)

    def mean(values: Array) -> Array:
        """Return the mean of the values of each event."""
        sum_by_event = np.zeros((row_count, *values.shape[1:]))
        np.add.at(sum_by_event, event_index, values)
        return (sum_by_event.T / mean_count_by_event).T[:-1]

    value, ned_to_body_rotation, noise_variance = map(
        mean, (sensor_samples.value, sensor_samples.ned_to_body_rotation, sensor_samples.noise)
    )
    if VELOCITY in sensor_samples.state_slices:
        # Each optical flow sample is a velocity without the velocity change measured by the IMU up
        # to the time of the sample. Add the velocity change up to the fusion event, so that the
        # mean is a velocity at the time of this event
        velocity_m_s = segment.imu_velocity_change_m_s[event_end_steps]
        value = value + np.einsum("eab,eb->ea", ned_to_body_rotation, velocity_m_s)
    # Each sample may be a mean of several EKF2 samples: add their sample counts
    sample_count = np.bincount(event_index, sensor_samples.sample_count, row_count)[:-1]
    return EventSamples(
        value, ned_to_body_rotation, np.asarray(sample_count, float), noise_variance
    )


def fuse_mean_sample(
    x: Array,
    P: Array,
    mean_sample: EventSamples,
    gate: Array,
    measured_states: slice,
    bias_states: slice | None = None,
) -> tuple[Array, Array, Array]:
    """Fuse the mean of several magnetometer or optical flow samples as one measurement.

    EKF2 fuses each sample separately. The gate and the returned innovation variance therefore use
    the noise of one sample; the update of the state uses the smaller noise of the mean.

    Return state, covariance, and an array of shape (3, filters, components). Its rows are the
    innovation, the innovation variance of one sample, and 1 if fused; NaN without a sample.

    Parameters
    ----------
    gate : ndarray, shape (filters,)
        Maximum accepted |innovation|, as a multiple of √S.
    measured_states : slice
        State indices of the measured vector (NED).
    bias_states : slice, optional
        State indices of the sensor bias (body frame).
    """
    estimated_vector_ned = x[:, measured_states]
    sample_count, R = mean_sample.sample_count, mean_sample.noise
    # The predicted measurement is h(x) = C (I - [δθ]×) v + b, with the rotation C from NED to the
    # nominal body axes, attitude error δθ, vector v (NED) and sensor bias b. C [v]× = dh/dδθ
    H = np.zeros((len(x), mean_sample.value.shape[-1], x.shape[1]))
    H[:, :, THETA] = mean_sample.ned_to_body_rotation @ skew(estimated_vector_ned)
    H[:, :, measured_states] = mean_sample.ned_to_body_rotation @ (np.eye(3) - skew(x[:, THETA]))
    predicted_value = (H[:, :, measured_states] @ estimated_vector_ned[:, :, None])[:, :, 0]
    if bias_states is not None:
        H[:, :, bias_states] = np.eye(3)
        predicted_value += x[:, bias_states]
    nu = mean_sample.value - predicted_value
    # EKF2 tests each sample separately. The gate therefore uses the noise R of one sample, not the
    # smaller noise of the mean
    HP = H @ P
    HPH = HP @ H.transpose(0, 2, 1)
    innovation_variance = np.diagonal(HPH, axis1=1, axis2=2) + R[:, None]
    has_sample = sample_count > 0.0
    is_fused = has_sample & (nu * nu <= gate[:, None] ** 2 * innovation_variance).all(axis=1)
    update = np.array([nu, innovation_variance, np.tile(is_fused, (nu.shape[1], 1)).T])
    update[:, ~has_sample] = np.nan
    # The update fuses the mean of n samples, whose noise is R / n. Without a sample, 1 avoids a
    # singular S
    mean_noise = np.where(has_sample, R / np.maximum(sample_count, 1.0), 1.0)
    S = HPH + mean_noise[:, None, None] * np.eye(nu.shape[1])
    K = (np.linalg.inv(S) @ HP).transpose(0, 2, 1) * is_fused[:, None, None]
    x = x + (K @ nu[:, :, None])[:, :, 0]
    P = P - K @ HP
    return x, 0.5 * (P + P.transpose(0, 2, 1)), update
