"""EKF2's estimate of the bias of a height or vision sensor.

EKF2 uses a separate scalar Kalman filter for each axis.

Source: PX4-Autopilot ``EKF/bias_estimator`` (``bias_estimator.cpp``; before v1.15
``EKF/bias_estimator.cpp``).
"""

import numpy as np

from px4fuse.core.arrays import Array, ArrayPair, BoolArray

# Noise density (m/√s) of the random walk of a height or vision bias (bias_nsd, common.h)
POSITION_BIAS_NOISE_M_PER_SQRT_S = 0.13
# Minimum variance (m²) of the estimated height or vision bias
MIN_POSITION_BIAS_VARIANCE_M2 = 1e-8
# EKF2 updates the height or vision bias only with innovations inside this gate (√S)
POSITION_BIAS_GATE = 3.0
# If the mean test ratio of the bias filter exceeds this value, EKF2 considers the estimated sensor
# bias wrong (isOffsetDetected, bias_estimator.cpp)
MAX_MEAN_TEST_RATIO_OF_VALID_BIAS = 0.2
# Factor on the random walk variance of a sensor bias that EKF2 considers wrong
RANDOM_WALK_VARIANCE_FACTOR_OF_WRONG_BIAS = 1e3
# Time constant (s) of the low-pass filter that gives the mean test ratio of the bias filter
TEST_RATIO_TIME_CONSTANT_S = 10.0


class BiasEstimator:
    """Kalman filter for the bias of one height or vision sensor.

    Several EKF2 configurations are computed at once.

    Parameters
    ----------
    bias_m, variance_m2 : ndarray, shape (filters,) or (filters, axes)
        Initial bias (state minus measurement) and its variance.
    steps_s : ndarray
        Lengths of EKF2's prediction steps.
    """

    def __init__(self, bias_m: Array, variance_m2: Array, steps_s: Array) -> None:
        step_s = np.median(steps_s)
        self.bias_m = bias_m
        self.variance_m2 = variance_m2
        self.mean_signed_test_ratio = np.zeros_like(bias_m)
        self.test_ratio_filter_weight = step_s / (TEST_RATIO_TIME_CONSTANT_S + step_s)

    def remove_and_update_bias(
        self,
        innovation_m: Array,
        predicted_variance: Array,
        R_m2: Array,
        interval_s: Array,
        is_bias_updated: BoolArray,
        represented_sample_count: Array | float = 1.0,
    ) -> ArrayPair:
        """Correct an innovation for the sensor bias, and update the bias with this innovation.

        Return the corrected innovation, and R plus the variance of the bias.

        Parameters
        ----------
        innovation_m, predicted_variance, R_m2 : ndarray
            Uncorrected innovation, HPH' and R.
        interval_s : ndarray
            Time since the previous sample; 0 if the bias is not updated.
        represented_sample_count : float or ndarray, shape (filters,)
            Number of EKF2 samples that this logged sample represents, as their mean.
        """
        # 1. Prediction: the variance grows by the random walk since the previous sample
        is_bias_wrong = np.abs(self.mean_signed_test_ratio) > MAX_MEAN_TEST_RATIO_OF_VALID_BIAS
        bias_noise_m2_per_s = np.where(
            is_bias_wrong,
            RANDOM_WALK_VARIANCE_FACTOR_OF_WRONG_BIAS * POSITION_BIAS_NOISE_M_PER_SQRT_S**2,
            POSITION_BIAS_NOISE_M_PER_SQRT_S**2,
        )
        bias_variance = np.minimum(self.variance_m2 + bias_noise_m2_per_s * interval_s, R_m2)
        # 2. Correction. The sensor bias is state minus measurement. It is therefore added to the
        # innovation ν, which is measurement minus state
        innovation_m = innovation_m + self.bias_m
        R = R_m2 + bias_variance
        # 3. Update of the bias. The bias filter measures state minus measurement: its innovation is
        # -ν, and its measurement noise is that of ν. The mean of n samples has 1/n of the variance
        # of one sample, but the bias is the same for all
        bias_innovation_m = -innovation_m
        S = bias_variance + (R_m2 + predicted_variance) / represented_sample_count
        test_ratio = bias_innovation_m**2 / (POSITION_BIAS_GATE**2 * S)
        is_fused = is_bias_updated & (test_ratio < 1.0)
        K = is_fused * bias_variance / S
        self.bias_m = self.bias_m + K * bias_innovation_m
        self.variance_m2 = np.maximum(
            bias_variance - K * bias_variance, MIN_POSITION_BIAS_VARIANCE_M2
        )
        # 4. Low-pass filter of the test ratio with the sign of the innovation. n samples have n
        # times the weight of one sample
        signed_test_ratio = np.copysign(np.minimum(test_ratio, 1.0), bias_innovation_m)
        filter_weight = is_bias_updated * self.test_ratio_filter_weight * represented_sample_count
        self.mean_signed_test_ratio = self.mean_signed_test_ratio + filter_weight * (
            signed_test_ratio - self.mean_signed_test_ratio
        )
        return innovation_m, R
