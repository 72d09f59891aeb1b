"""The offset of a sensor from EKF2's reference, which EKF2 estimates beside its filter.

Source: PX4-Autopilot ``EKF/bias_estimator`` (``bias_estimator.cpp``; before v1.15
``EKF/bias_estimator.cpp``).
"""

import numpy as np

from px4fuse.arrays import Array, BoolArray

# Of the bias: noise density (m/s/√Hz; bias_nsd, common.h), least variance, least one of a
# measurement, gate; where innovations keep to one side its noise is raised (isOffsetDetected)
BIAS_DENSITY, MIN_VARIANCE_M2, MIN_NOISE_M2, BIAS_GATE = 0.13, 1e-8, 1e-4, 3.0
MAX_ONE_SIDED, NOISE_FACTOR, FILTER_S = 0.2, 1e3, 10.0


class BiasEstimator:
    """The bias of one sensor in S variants, sample by sample.

    Parameters
    ----------
    value_m, variance_m2 : ndarray, shape (S,) or (S, k)
        What is added to innovations, and its variance.
    start_s : float
    step_s : float
        Of a prediction.
    """

    def __init__(self, value_m: Array, variance_m2: Array, start_s: float, step_s: float) -> None:
        self.value_m, self.variance_m2 = value_m, variance_m2
        self.one_sided, self.last_s = np.zeros_like(value_m), np.full_like(value_m, start_s)
        self.share = step_s / (FILTER_S + step_s)

    def remove_bias(
        self,
        nu: Array,
        spread: Array,
        noise_m2: Array,
        time_s: Array,
        has_sample: BoolArray,
        learning: BoolArray,
        weight: float = 1.0,
    ) -> tuple[Array, Array]:
        """Innovation and R with the bias as it was, which learns of them before they are fused.

        Parameters
        ----------
        nu, spread, noise_m2 : ndarray
            Innovation without a bias, HPH' and R.
        time_s, has_sample, learning : ndarray
            Time of the sample, whether there is one, and whether the bias learns of it.
        weight : float
            Samples that EKF2 had for it.
        """
        is_learning, bounded_noise = has_sample & learning, np.maximum(noise_m2, MIN_NOISE_M2)
        raised = np.where(np.abs(self.one_sided) > MAX_ONE_SIDED, NOISE_FACTOR, 1.0)
        variance_growth = BIAS_DENSITY**2 * (time_s - self.last_s) * raised * is_learning
        variance = np.minimum(self.variance_m2 + variance_growth, bounded_noise)
        nu, R = nu + self.value_m, noise_m2 + variance
        S = variance + np.maximum((noise_m2 + spread) / weight, MIN_NOISE_M2)
        ratio = nu * nu / (BIAS_GATE**2 * S)
        K = variance / S * (is_learning & (ratio < 1.0))
        self.value_m = self.value_m - K * nu
        self.variance_m2 = np.maximum(variance * (1.0 - K), MIN_VARIANCE_M2)
        signed = np.minimum(ratio, 1.0) * np.sign(-nu)
        self.one_sided = self.one_sided + self.share * weight * is_learning * (
            signed - self.one_sided
        )
        self.last_s = np.where(has_sample, time_s, self.last_s)
        return nu, R
