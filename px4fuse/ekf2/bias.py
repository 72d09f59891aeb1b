"""EKF2's estimate of the bias of a height or vision sensor relative to its reference sensor.

EKF2 uses a separate scalar Kalman filter for each axis.

Source: PX4-Autopilot ``EKF/bias_estimator`` (``bias_estimator.cpp``; before v1.15
``EKF/bias_estimator.cpp``).
"""

import numpy as np

from px4fuse.core.arrays import Array, BoolArray

# Noise density (m/s/√Hz) of the random walk of a height or vision bias (bias_nsd, common.h)
SENSOR_BIAS_NOISE_DENSITY = 0.13
# Minimum variance (m²) of the estimated height or vision bias
MIN_BIAS_VARIANCE_M2 = 1e-8
# EKF2 updates the height or vision bias only with innovations inside this gate (√S)
BIAS_GATE = 3.0
# EKF2 considers the bias wrong if |mean of (test ratio · sign of innovation)| exceeds this value
# (isOffsetDetected, bias_estimator.cpp)
MAX_MEAN_SIGNED_TEST_RATIO = 0.2
# Factor by which EKF2 multiplies the random walk variance of a bias that it considers wrong
WRONG_BIAS_VARIANCE_FACTOR = 1e3
# Time constant (s) of the low-pass filter of (test ratio · sign of innovation)
TEST_RATIO_TIME_CONSTANT_S = 10.0


class BiasEstimator:
    """Estimated bias of one sensor, for several filter configurations at once.

    ``bias_m`` (state minus measurement) is added to innovations. ``bias_m`` and ``variance_m2``
    have the shape (filters,) or (filters, axes). ``steps_s``: lengths of EKF2's prediction steps.
    """

    def __init__(self, bias_m: Array, variance_m2: Array, steps_s: Array) -> None:
        step_s = np.median(steps_s)
        self.bias_m = bias_m
        self.variance_m2 = variance_m2
        self.mean_signed_test_ratio = np.zeros_like(bias_m)
        self.filter_weight = step_s / (TEST_RATIO_TIME_CONSTANT_S + step_s)

    def remove_bias(
        self,
        nu: Array,
        predicted_variance: Array,
        R_m2: Array,
        interval_s: Array,
        updates_bias: BoolArray,
        weight: Array | float = 1.0,
    ) -> tuple[Array, Array]:
        """Correct innovation and R of a sample with the bias, then update the bias.

        Parameters
        ----------
        nu, predicted_variance, R_m2 : ndarray
            Uncorrected innovation (m), HPH' and R (m²).
        interval_s : ndarray
            Time (s) since the previous sample; 0 if the bias is not updated.
        updates_bias : ndarray of bool
        weight : float or ndarray, shape (filters,)
            Number of samples fused by EKF2 that this sample represents.
        """
        has_offset = np.abs(self.mean_signed_test_ratio) > MAX_MEAN_SIGNED_TEST_RATIO
        variance_rate = np.where(
            has_offset,
            WRONG_BIAS_VARIANCE_FACTOR * SENSOR_BIAS_NOISE_DENSITY**2,
            SENSOR_BIAS_NOISE_DENSITY**2,
        )
        bias_variance = np.minimum(self.variance_m2 + variance_rate * interval_s, R_m2)
        nu = nu + self.bias_m
        R = R_m2 + bias_variance
        S = bias_variance + (R_m2 + predicted_variance) / weight
        test_ratio = nu * nu / (BIAS_GATE**2 * S)
        K = bias_variance / S * (updates_bias & (test_ratio < 1.0))
        self.bias_m = self.bias_m - K * nu
        self.variance_m2 = np.maximum(bias_variance - K * bias_variance, MIN_BIAS_VARIANCE_M2)
        signed_ratio_sum = (
            np.copysign(np.minimum(test_ratio, 1.0), nu) + self.mean_signed_test_ratio
        )
        self.mean_signed_test_ratio = self.mean_signed_test_ratio - (
            self.filter_weight * weight * updates_bias * signed_ratio_sum
        )
        return nu, R
