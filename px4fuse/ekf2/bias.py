"""Bias of a sensor relative to EKF2's reference sensor, estimated outside EKF2's Kalman filter.

Source: PX4-Autopilot ``EKF/bias_estimator`` (``bias_estimator.cpp``; before v1.15
``EKF/bias_estimator.cpp``).
"""

import numpy as np

from px4fuse.arrays import Array, BoolArray

# Noise density of the bias random walk (m/s/√Hz; bias_nsd, common.h), minimum variance of the bias
# (m²), minimum measurement variance (m²), and gate (√S)
BIAS_DENSITY, MIN_VARIANCE_M2, MIN_NOISE_M2, BIAS_GATE = 0.13, 1e-8, 1e-4, 3.0
# Maximum mean signed test ratio with the normal random walk (isOffsetDetected), factor on the
# variance of the random walk above it, and averaging time of the test ratio (s)
MAX_MEAN_SIGNED_RATIO, NOISE_FACTOR, FILTER_S = 0.2, 1e3, 10.0


class BiasEstimator:
    """Bias of one sensor along k axes in S filter configurations, updated with each sample.

    Parameters
    ----------
    value_m, variance_m2 : ndarray, shape (S,) or (S, k)
        Initial bias, which is added to innovations, and its variance.
    start_s : float
    step_s : float
        Prediction step of EKF2.
    """

    def __init__(self, value_m: Array, variance_m2: Array, start_s: float, step_s: float) -> None:
        self.value_m = value_m
        self.variance_m2 = variance_m2
        self.mean_signed_ratio = np.zeros_like(value_m)
        self.last_s = np.full_like(value_m, start_s)
        self.filter_weight = step_s / (FILTER_S + step_s)

    def remove_bias(
        self,
        nu: Array,
        predicted_variance: Array,
        noise_m2: Array,
        time_s: Array,
        has_sample: BoolArray,
        updates_bias: BoolArray,
        weight: float = 1.0,
    ) -> tuple[Array, Array]:
        """Return innovation and R corrected for the current bias, then update the bias.

        Parameters
        ----------
        nu, predicted_variance, noise_m2 : ndarray
            Innovation without bias, HPH' and R.
        time_s, has_sample, updates_bias : ndarray
            For each configuration: sample time, True with a sample, True if it updates the bias.
        weight : float
            Number of samples in EKF2 that the logged sample represents.
        """
        updates_now = has_sample & updates_bias
        bounded_noise = np.maximum(noise_m2, MIN_NOISE_M2)
        density_factor = np.where(
            np.abs(self.mean_signed_ratio) > MAX_MEAN_SIGNED_RATIO, NOISE_FACTOR, 1.0
        )
        variance_growth = BIAS_DENSITY**2 * (time_s - self.last_s) * density_factor * updates_now
        variance = np.minimum(self.variance_m2 + variance_growth, bounded_noise)
        nu = nu + self.value_m
        R = noise_m2 + variance
        S = variance + np.maximum((noise_m2 + predicted_variance) / weight, MIN_NOISE_M2)
        ratio = nu * nu / (BIAS_GATE**2 * S)
        K = variance / S * (updates_now & (ratio < 1.0))
        self.value_m = self.value_m - K * nu
        self.variance_m2 = np.maximum(variance * (1.0 - K), MIN_VARIANCE_M2)
        signed = np.minimum(ratio, 1.0) * np.sign(-nu)
        self.mean_signed_ratio = (
            self.mean_signed_ratio
            + self.filter_weight * weight * updates_now * (signed - self.mean_signed_ratio)
        )
        self.last_s = np.where(has_sample, time_s, self.last_s)
        return nu, R
