"""Maximum-likelihood SIGMA_A and SIGMA_Z with 95 % intervals.

Two values of SIGMA_A are estimated: the acceleration noise alone, and a larger value for KF. KF has
no states for biases and tilt, so its SIGMA_A includes them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from px4fuse.core.arrays import Array, BoolArray
from px4fuse.core.record import (
    NOT_IN_JSON,
    Count,
    NonNegativeFloat,
    NotInJson,
    OrUnavailable,
    Record,
)
from px4fuse.flight.model import Flight, Unavailable

from .consistency import Consistency
from .fitting import (
    SIGMA_A_SEARCH_RANGE_M_S2,
    SIGMA_Z_SEARCH_RANGE_M,
    NoiseFit,
    NoiseParameters,
    convert_to_positions_and_increments,
    estimate_outlier_probability,
    maximise_likelihood,
)
from .imu_motion import MotionCache, compute_imu_motion
from .likelihood import (
    PreintegratedMotion,
    find_profile_likelihood_interval,
    innovations,
    preintegrate,
)
from .settings import Settings
from .signals import Axis, make_downsampling_slice, report_too_few_measurements

HORIZONTAL = "horizontal"
NoiseInterval = tuple[NonNegativeFloat, NonNegativeFloat | None]
MIN_MEASUREMENTS = 30
MAX_OUTLIER_FRACTION = 0.3
# Initial values in the search for the acceleration noise: KF's SIGMA_A multiplied by these factors
START_SIGMA_A_FACTORS = (0.1, 0.3, 1.0)
# Initial value (m/√s) of the random walk of a source that may drift
START_RANDOM_WALK_M = 0.02
# Change of ln SIGMA_A between the first two values in the search for KF's SIGMA_A
LOG_SIGMA_A_BRACKET_WIDTH = 0.1
# Estimates within this factor of an end of the search range are reported as bounds only
SEARCH_RANGE_END_TOLERANCE_FACTOR = 1.001


class NoiseEstimate(Record):
    """Maximum-likelihood estimate of one noise parameter, with its 95 % interval.

    ``value`` is None if the maximum is outside the search range. A missing bound is None.
    """

    value: float | None
    low: float | None
    high: float | None

    @classmethod
    def from_fields(cls, value: float | None, interval: NoiseInterval | None) -> NoiseEstimate:
        """Make the estimate from its value and interval in :class:`AxisTuning`."""
        low, high = interval or (0.0, None)
        return cls(value, low or None, high)

    def value_or_bound(self, fallback: float) -> float:
        """Return the estimate, else its upper bound, else ``fallback``."""
        return self.value or self.high or fallback

    def as_fields(self, name: str) -> dict[str, Any]:
        """Return the estimate as two fields of :class:`AxisTuning`: value and 95 % interval.

        The keys of the fields are ``name`` and ``name`` + "_interval".
        """
        is_bounded = self.low is not None or self.high is not None
        interval = (self.low or 0.0, self.high) if is_bounded else None
        return {name: self.value, f"{name}_interval": interval}


class HeldOutCheck(Record):
    """Noises estimated from the first half of a flight, and their test on the second half.

    Attributes
    ----------
    count : int
        Number of measurements in the second half.
    log_likelihood_gain_per_measurement : float
        Log-likelihood gain (nats) over KF's current settings in the second half.
    """

    sigma_a_m_s2: NonNegativeFloat
    sigma_z_m: NonNegativeFloat
    count: Count
    log_likelihood_gain_per_measurement: float


class AxisTuning(Record, kw_only=True):
    """Estimated noises of KF for one axis, or for north and east together.

    A noise is None if its estimate is outside the search range.

    Attributes
    ----------
    sigma_a_two_state_m_s2 : float or None
        SIGMA_A for KF, which includes biases and tilt.
    log_likelihood_gain_per_measurement : float
        Log-likelihood gain (nats) of the estimated over the current settings.
    before, after : Consistency or Unavailable
        Consistency of KF with the current and with the estimated settings.
    outliers : int
        Number of measurements with an outlier probability above 0.5.
    biases_fitted : bool
        False if the IMU rate is too low to estimate biases.
    noises : NoiseParameters
        Maximum-likelihood noises, including the random walk of the source.
    """

    sigma_a_m_s2: NonNegativeFloat | None = None
    sigma_a_m_s2_interval: NoiseInterval | None = None
    sigma_a_two_state_m_s2: NonNegativeFloat | None = None
    sigma_a_two_state_m_s2_interval: NoiseInterval | None = None
    sigma_z_m: NonNegativeFloat | None = None
    sigma_z_m_interval: NoiseInterval | None = None
    log_likelihood_gain_per_measurement: float
    before: OrUnavailable[Consistency]
    after: OrUnavailable[Consistency]
    count: Count
    outliers: Count
    held_out: OrUnavailable[HeldOutCheck]
    biases_fitted: bool
    name: NotInJson[str] = NOT_IN_JSON
    outlier_time_s: NotInJson[Array] = NOT_IN_JSON
    noises: NotInJson[NoiseParameters] = NOT_IN_JSON

    @property
    def sigma_a(self) -> NoiseEstimate:
        """Estimated SIGMA_A (m/s²) of the acceleration noise alone, without biases and tilt."""
        return NoiseEstimate.from_fields(self.sigma_a_m_s2, self.sigma_a_m_s2_interval)

    @property
    def sigma_a_two_state(self) -> NoiseEstimate:
        """Estimated SIGMA_A (m/s²) for KF, which must also cover biases and tilt errors.

        KF has only two states (position, velocity) and does not estimate these errors.
        """
        return NoiseEstimate.from_fields(
            self.sigma_a_two_state_m_s2, self.sigma_a_two_state_m_s2_interval
        )

    @property
    def sigma_z(self) -> NoiseEstimate:
        return NoiseEstimate.from_fields(self.sigma_z_m, self.sigma_z_m_interval)


def tune(
    axes: tuple[Axis, ...],
    settings: Settings,
    names: tuple[str, ...] | None = None,
    progress: Callable[[str], None] = lambda _: None,
    flight: Flight | None = None,
    may_drift: bool = False,
    motion_cache: MotionCache | None = None,
) -> dict[str, AxisTuning | Unavailable]:
    """Estimate SIGMA_A and SIGMA_Z of each axis, and of north and east together.

    Parameters
    ----------
    settings : Settings
        Current settings of KF, with which the estimates are compared.
    names : tuple of str, optional
        Axis names and "horizontal"; default: all.
    progress : callable
        Called with the name of each axis.
    flight : Flight, optional
        Flight with IMU data, which separate biases and tilt from noise.
    may_drift : bool
        True if the source may drift (odometry).
    motion_cache : dict, optional
        IMU motion that is already computed; new motion is added.
    """
    axes_by_name: dict[str, tuple[Axis, ...]] = {axis.name: (axis,) for axis in axes}
    if {"north", "east"} <= axes_by_name.keys():
        horizontal_axes = (*axes_by_name["north"], *axes_by_name["east"])
        if np.array_equal(
            horizontal_axes[0].measurement_time_s, horizontal_axes[1].measurement_time_s
        ):
            axes_by_name[HORIZONTAL] = horizontal_axes
    tunings = {}
    motion_cache = {} if motion_cache is None else motion_cache
    for name, group_axes in axes_by_name.items():
        if names is None or name in names:
            progress(name)
            try:
                tunings[name] = tune_axes(
                    name, group_axes, settings, flight, may_drift, motion_cache
                )
            except np.linalg.LinAlgError as error:
                # Outliers far from the flight path cause rounding errors, which can make the matrix
                # of the normal equations singular
                tunings[name] = Unavailable(
                    f"estimate of SIGMA_A and SIGMA_Z ({name})",
                    str(error),
                    "Remove outliers far from the flight path.",
                )
    return tunings


def tune_axes(
    name: str,
    axes: tuple[Axis, ...],
    settings: Settings,
    flight: Flight | None = None,
    may_drift: bool = False,
    motion_cache: MotionCache | None = None,
) -> AxisTuning | Unavailable:
    """Estimate the noises of several axes with equal measurement times.

    See :func:`tune` for the parameters.
    """
    analysis_name = f"estimate of SIGMA_A and SIGMA_Z ({name})"
    if settings.input != "imu":
        flight = None
    # All measurements, to classify outliers and to test KF's consistency
    preintegrated_motions = [preintegrate(axis, settings) for axis in axes]
    measurement_time_before_downsampling_s = axes[0].measurement_time_s[
        -len(preintegrated_motions[0].measurement_m) :
    ]
    # Downsampled measurements, to fit the noises
    kept = make_downsampling_slice(axes[0].measurement_time_s)
    axes = tuple(
        replace(
            axis,
            measurement_time_s=axis.measurement_time_s[kept],
            measurement_m=axis.measurement_m[kept],
        )
        for axis in axes
    )
    positions_by_axis = [
        convert_to_positions_and_increments(preintegrate(axis, settings)) for axis in axes
    ]
    measurement_count = len(positions_by_axis[0].measurement_m) - 1
    if measurement_count < MIN_MEASUREMENTS:
        return report_too_few_measurements(analysis_name, measurement_count, MIN_MEASUREMENTS)
    current_parameters = NoiseParameters(settings.sigma_a_m_s2, settings.sigma_z_m)
    # Two fits: kf_fit has the states of KF, so its SIGMA_A includes biases and tilt. imu_motion_fit
    # also fits biases and tilt
    kf_fit = maximise_likelihood(positions_by_axis, current_parameters, np.ones(measurement_count))
    imu_motion_fit = None
    if flight is not None:
        imu_motion_fit = _fit_with_imu_motion(
            axes, settings, kf_fit, flight, may_drift, motion_cache
        )
    best_fit = imu_motion_fit or kf_fit
    outlier_probability = kf_fit.outlier_probability
    if len(measurement_time_before_downsampling_s) > measurement_count:
        # Also classify the measurements that downsampling omitted
        outlier_probability = estimate_outlier_probability(
            [*map(convert_to_positions_and_increments, preintegrated_motions)],
            kf_fit,
            len(measurement_time_before_downsampling_s),
        )
    is_outlier = outlier_probability > 0.5
    if np.mean(is_outlier) > MAX_OUTLIER_FRACTION:
        return Unavailable(
            analysis_name,
            f"{100 * np.mean(is_outlier):.0f} % of the measurements are outliers, too many to "
            "estimate SIGMA_Z",
            "Reduce the outliers of the positioning system.",
        )
    sigma_a, sigma_z = _estimate_noises(best_fit)
    final_sigma_z_m = sigma_z.value_or_bound(best_fit.noise_parameters.sigma_z_m)
    kf_sigma_a = sigma_a
    if imu_motion_fit is not None:
        kf_sigma_a = _estimate_kf_sigma_a(kf_fit, final_sigma_z_m)
    elif flight is not None:
        # Without estimates of biases and tilt, KF's SIGMA_A is an upper bound of the noise
        sigma_a = NoiseEstimate(None, None, kf_sigma_a.high)
    final_parameters = NoiseParameters(
        kf_sigma_a.value_or_bound(kf_fit.noise_parameters.sigma_a_m_s2), final_sigma_z_m
    )
    log_likelihood_gain_nats = kf_fit.score(current_parameters) - kf_fit.score(final_parameters)
    return AxisTuning(
        name=name,
        **sigma_a.as_fields("sigma_a_m_s2"),
        **sigma_z.as_fields("sigma_z_m"),
        **kf_sigma_a.as_fields("sigma_a_two_state_m_s2"),
        log_likelihood_gain_per_measurement=log_likelihood_gain_nats / measurement_count,
        before=_assess_kf_consistency(preintegrated_motions[0], current_parameters, is_outlier),
        after=_assess_kf_consistency(preintegrated_motions[0], final_parameters, is_outlier),
        outlier_time_s=measurement_time_before_downsampling_s[is_outlier],
        count=len(measurement_time_before_downsampling_s),
        outliers=int(np.count_nonzero(is_outlier)),
        held_out=_test_noises_on_second_half(name, current_parameters, kf_fit),
        noises=best_fit.noise_parameters,
        biases_fitted=imu_motion_fit is not None,
    )


def _fit_with_imu_motion(
    axes: tuple[Axis, ...],
    settings: Settings,
    kf_fit: NoiseFit,
    flight: Flight,
    may_drift: bool,
    motion_cache: MotionCache | None,
) -> NoiseFit | None:
    """Fit the noises together with biases, tilt and time offset; None without IMU data."""
    measured_m = np.column_stack([axis.measurement_m for axis in axes])
    # The first measurement is KF's initial state, without a weight in KF's fit: use weight 1
    measurement_weights = np.ones(len(measured_m))
    measurement_weights[-len(kf_fit.measurement_weights) :] = kf_fit.measurement_weights
    imu_motion = compute_imu_motion(
        flight,
        axes[0].measurement_time_s,
        measured_m,
        axis_directions=np.array([axis.direction for axis in axes]),
        dt_s=settings.dt_s,
        measurement_weights=measurement_weights,
        motion_cache=motion_cache,
    )
    if isinstance(imu_motion, Unavailable):
        return None
    start_parameters = replace(
        kf_fit.noise_parameters, random_walk_m=START_RANDOM_WALK_M if may_drift else 0.0
    )
    # An approximate time offset is sufficient: it hardly changes the estimated noise
    offset_s, start_parameters = imu_motion.search_time_offset(
        start_parameters, START_SIGMA_A_FACTORS, estimates_scale=False
    )
    return imu_motion.fit_noises(offset_s, start_parameters, fits_outliers=True)


def _estimate_noises(fit: NoiseFit) -> tuple[NoiseEstimate, NoiseEstimate]:
    """Return SIGMA_A and SIGMA_Z of a fit with their 95 % intervals."""
    best_parameters = fit.noise_parameters
    log_sigma_a, log_sigma_z = np.log([best_parameters.sigma_a_m_s2, best_parameters.sigma_z_m])

    def score(tested_log_sigma_a: float, tested_log_sigma_z: float) -> float:
        """Return -ln p at tested ln SIGMA_A and ln SIGMA_Z."""
        sigma_a, sigma_z = np.exp([tested_log_sigma_a, tested_log_sigma_z]).tolist()
        return fit.score(NoiseParameters(sigma_a, sigma_z, best_parameters.random_walk_m))

    sigma_a = _make_noise_estimate(score, (log_sigma_a, log_sigma_z), SIGMA_A_SEARCH_RANGE_M_S2)
    sigma_z = _make_noise_estimate(
        lambda tested_sigma_z, tested_sigma_a: score(tested_sigma_a, tested_sigma_z),
        (log_sigma_z, log_sigma_a),
        SIGMA_Z_SEARCH_RANGE_M,
        fit.variance_factor_of_ln_sigma_z,
    )
    return sigma_a, sigma_z


def _estimate_kf_sigma_a(fit: NoiseFit, sigma_z_m: float) -> NoiseEstimate:
    """Estimate SIGMA_A for KF with a given SIGMA_Z."""

    # find_profile_likelihood_interval needs a second parameter. It has no effect here
    def score(log_sigma_a: float, _: float = 0.0) -> float:
        # Limit the logarithm: the search may try values whose exponential overflows
        sigma_a_m_s2 = float(np.exp(np.clip(log_sigma_a, *np.log(SIGMA_A_SEARCH_RANGE_M_S2))))
        return fit.score(NoiseParameters(sigma_a_m_s2, sigma_z_m))

    start = float(np.log(fit.noise_parameters.sigma_a_m_s2))
    bracket = (start - LOG_SIGMA_A_BRACKET_WIDTH, start)
    best_log_sigma_a = float(minimize_scalar(score, bracket, options={"xtol": 1e-4}).x)
    return _make_noise_estimate(score, (best_log_sigma_a, 0.0), SIGMA_A_SEARCH_RANGE_M_S2)


def _make_noise_estimate(
    score: Callable[[float, float], float],
    best_log_sigmas: tuple[float, float],
    search_range: tuple[float, float],
    variance_factor: float = 1.0,
) -> NoiseEstimate:
    """Return the estimate of a noise parameter with its 95 % interval."""
    estimate = float(np.exp(best_log_sigmas[0]))
    interval_low, interval_high = find_profile_likelihood_interval(
        score, best_log_sigmas, search_range, variance_factor
    )
    is_inside = (
        search_range[0] * SEARCH_RANGE_END_TOLERANCE_FACTOR
        < estimate
        < search_range[1] / SEARCH_RANGE_END_TOLERANCE_FACTOR
    )
    is_known = is_inside and None not in (interval_low, interval_high)
    return NoiseEstimate(estimate if is_known else None, interval_low, interval_high)


def _assess_kf_consistency(
    preintegrated_motion: PreintegratedMotion,
    noise_parameters: NoiseParameters,
    is_outlier: BoolArray,
) -> Consistency | Unavailable:
    """Test the consistency of KF with given noises along one axis, without outliers."""
    nu, s = innovations(
        preintegrated_motion, noise_parameters.sigma_a_m_s2, noise_parameters.sigma_z_m, is_outlier
    )
    return Consistency.from_innovations(nu[~is_outlier], s[~is_outlier])


def _test_noises_on_second_half(
    name: str, current_parameters: NoiseParameters, fit: NoiseFit
) -> HeldOutCheck | Unavailable:
    """Estimate SIGMA_A and SIGMA_Z from the first half of a flight, and test them on the second."""
    first_half_count = len(fit.measurement_weights) // 2
    if first_half_count < MIN_MEASUREMENTS:
        return Unavailable(
            f"test of SIGMA_A and SIGMA_Z on the second half of the flight ({name})",
            f"the first half of the segment contains only {first_half_count} measurements (at "
            f"least {MIN_MEASUREMENTS} are needed)",
            "Analyse a longer segment.",
        )
    # One more position than measurements, because the first position is KF's initial state
    first_half_positions = [
        positions.first(1 + first_half_count) for positions in fit.score.positions_by_axis
    ]
    first_half_fit = maximise_likelihood(
        first_half_positions,
        fit.noise_parameters,
        fit.measurement_weights[:first_half_count],
        fits_outliers=False,
    )
    first_half_parameters = first_half_fit.noise_parameters
    # Score of the second half: score of the whole flight minus score of the first half
    current_score, first_half_noise_score = (
        fit.score(noise_parameters) - first_half_fit.score(noise_parameters)
        for noise_parameters in (current_parameters, first_half_parameters)
    )
    second_half_measurement_count = len(fit.measurement_weights) - first_half_count
    return HeldOutCheck(
        first_half_parameters.sigma_a_m_s2,
        first_half_parameters.sigma_z_m,
        second_half_measurement_count,
        (current_score - first_half_noise_score) / second_half_measurement_count,
    )
