"""Bias of a height or vision sensor relative to EKF2's reference sensor.

EKF2 estimates this bias with a separate scalar Kalman filter for each axis.

Source: PX4-Autopilot ``EKF/bias_estimator`` (``bias_estimator.cpp``; before v1.15
``EKF/bias_estimator.cpp``).
"""

import numpy as np

from px4fuse.core.arrays import Array, BoolArray

# Noise density (m/s/√Hz) of the random walk of the bias (bias_nsd, common.h)
BIAS_DENSITY = 0.13
# Minimum variance (m²) of the sensor bias
MIN_VARIANCE_M2 = 1e-8
# Minimum measurement variance R (m²) in updates of the sensor bias
MIN_NOISE_M2 = 1e-4
# Innovation gate (√S) in updates of the sensor bias
BIAS_GATE = 3.0
# Maximum |mean| of test ratio times sign of the innovation: if it is larger, EKF2 multiplies the
# variance of the random walk by RANDOM_WALK_FACTOR (isOffsetDetected)
MAX_MEAN_SIGNED_RATIO = 0.2
RANDOM_WALK_FACTOR = 1e3
# Time constant (s) of the low-pass filter that averages the signed test ratio
TEST_RATIO_FILTER_S = 10.0


class BiasEstimator:
    """Bias of one sensor along k axes in S filter configurations, updated with each sample.

    Parameters
    ----------
    value_m, variance_m2 : ndarray, shape (S,) or (S, k)
        Initial bias (it is added to innovations), and variance of the bias.
    start_s : float
        Time of the initial bias.
    step_s : float
        Prediction step of EKF2.
    """

    def __init__(self, value_m: Array, variance_m2: Array, start_s: float, step_s: float) -> None:
        self.value_m = value_m
        self.variance_m2 = variance_m2
        self.mean_signed_ratio = np.zeros_like(value_m)
        self.last_s = np.full_like(value_m, start_s)
        self.filter_weight = step_s / (TEST_RATIO_FILTER_S + step_s)

    def remove_bias(
        self,
        nu: Array,
        predicted_variance: Array,
        noise_m2: Array,
        time_s: Array,
        has_sample: BoolArray,
        updates_bias: BoolArray,
        weight: Array | float = 1.0,
    ) -> tuple[Array, Array]:
        """Return innovation and R corrected for the current bias, then update the bias.

        Parameters
        ----------
        nu, predicted_variance, noise_m2 : ndarray
            Innovation without the bias (m), HPH' and R (m²).
        time_s, has_sample, updates_bias : ndarray
            Per filter configuration: sample time, True with a sample, True to update the bias.
        weight : float or ndarray, shape (S,)
            Number of samples that EKF2 fused per known sample.
        """
        updates_now = has_sample & updates_bias
        growth_s = (time_s - self.last_s) * updates_now
        has_offset = np.abs(self.mean_signed_ratio) > MAX_MEAN_SIGNED_RATIO
        if has_offset.any():
            growth_s = np.where(has_offset, RANDOM_WALK_FACTOR, 1.0) * growth_s
        variance = np.minimum(
            self.variance_m2 + BIAS_DENSITY**2 * growth_s, np.maximum(noise_m2, MIN_NOISE_M2)
        )
        nu = nu + self.value_m
        R = noise_m2 + variance
        S = variance + np.maximum((noise_m2 + predicted_variance) / weight, MIN_NOISE_M2)
        ratio = nu * nu / (BIAS_GATE**2 * S)
        K = variance / S * (updates_now & (ratio < 1.0))
        self.value_m = self.value_m - K * nu
        self.variance_m2 = np.maximum(variance - K * variance, MIN_VARIANCE_M2)
        change = np.copysign(np.minimum(ratio, 1.0), nu) + self.mean_signed_ratio
        self.mean_signed_ratio = self.mean_signed_ratio - (
            self.filter_weight * weight * updates_now * change
        )
        self.last_s = np.where(has_sample, time_s, self.last_s)
        return nu, R
