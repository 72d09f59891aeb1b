"""Maximum-likelihood SIGMA_A and SIGMA_Z with 95 % intervals.

Two values of SIGMA_A are estimated. The first is the noise of the acceleration alone: biases, tilt
and time offset are estimated too (:mod:`px4fuse.filter.imu_motion`). The second is for KF, which
needs a larger SIGMA_A because it has no states for biases.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from px4fuse.core.arrays import Array, BoolArray
from px4fuse.core.record import NOT_WRITTEN, Count, NotNegative, NotWritten, OrUnavailable, Record
from px4fuse.filter.consistency import Consistency, assess
from px4fuse.filter.fitting import (
    SIGMA_A_SEARCH_M_S2,
    SIGMA_Z_SEARCH_M,
    NoiseFit,
    Noises,
    kf_positions,
    maximise_likelihood,
    outlier_probability,
)
from px4fuse.filter.imu_motion import MotionCache, prepare_motion
from px4fuse.filter.likelihood import (
    Preintegrated,
    innovations,
    preintegrate,
    profile_ends,
)
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import Axis, independent_rows, too_few_measurements
from px4fuse.flight.model import Flight, Unavailable

HORIZONTAL = "horizontal"
NoiseInterval = tuple[NotNegative, NotNegative | None]
# Minimum number of positions from which SIGMA_A and SIGMA_Z are estimated
MIN_MEASUREMENTS = 30
# SIGMA_A and SIGMA_Z are not estimated if a larger fraction of the positions are outliers
MAX_OUTLIER_FRACTION = 0.3
# Initial values of SIGMA_A in the estimate with IMU biases, as multiples of KF's SIGMA_A
START_SIGMA_A_FACTORS = (0.1, 0.3, 1.0)
# Initial value of the random walk (m/√s) of a source that may drift
START_RANDOM_WALK_M = 0.02
# A noise estimate is only a bound if it equals an end of its search range, within this factor
MAX_SEARCH_END_RATIO = 1.001


class Noise(Record):
    """Maximum-likelihood estimate of one noise parameter, with its 95 % interval.

    ``value`` is None if the maximum is outside the search range. ``low`` is None if the noise may
    be zero, ``high`` is None without an upper bound.
    """

    value: float | None
    low: float | None
    high: float | None

    @classmethod
    def from_fields(cls, value: float | None, interval: NoiseInterval | None) -> Noise:
        """Make a noise from its value and interval in :class:`AxisTuning`."""
        low, high = interval or (0.0, None)
        return cls(value, low or None, high)

    def as_fields(self, name: str) -> dict[str, Any]:
        """Return value and interval as keyword arguments for :class:`AxisTuning`."""
        is_bounded = self.low is not None or self.high is not None
        interval = (self.low or 0.0, self.high) if is_bounded else None
        return {name: self.value, f"{name}_interval": interval}


class HeldOutCheck(Record):
    """Noises that are estimated from the first half of the flight and tested on the second half.

    Attributes
    ----------
    count : int
        Number of measurements in the second half.
    log_likelihood_gain_per_measurement : float
        Gain in the second half over KF's current settings.
    """

    sigma_a_m_s2: NotNegative
    sigma_z_m: NotNegative
    count: Count
    log_likelihood_gain_per_measurement: float


class AxisTuning(Record, kw_only=True):
    """Estimated noises of KF for one axis, or for north and east together, with 95 % intervals.

    A noise is None if its estimate is outside the search range. An interval begins at 0 if the
    noise may be zero.

    Attributes
    ----------
    sigma_a_two_state_m_s2 : float or None
        SIGMA_A that KF needs, because it has no states for biases.
    log_likelihood_gain_per_measurement : float
        Gain of the estimated over the current settings of KF.
    before, after : Consistency or Unavailable
        Consistency of KF along the first axis, with its current and with the estimated settings.
    outliers : int
        Number of measurements with an outlier probability above 0.5.
    biases_fitted : bool
        False if the IMU rate is too low to estimate biases. KF's SIGMA_A is then only an upper
        bound of the acceleration noise.
    noises : Noises
        Maximum-likelihood noises, including the random walk of a drifting source.
    """

    sigma_a_m_s2: NotNegative | None = None
    sigma_a_m_s2_interval: NoiseInterval | None = None
    sigma_a_two_state_m_s2: NotNegative | None = None
    sigma_a_two_state_m_s2_interval: NoiseInterval | None = None
    sigma_z_m: NotNegative | None = None
    sigma_z_m_interval: NoiseInterval | None = None
    log_likelihood_gain_per_measurement: float
    before: OrUnavailable[Consistency]
    after: OrUnavailable[Consistency]
    count: Count
    outliers: Count
    held_out: OrUnavailable[HeldOutCheck]
    biases_fitted: bool
    name: NotWritten[str] = NOT_WRITTEN
    outlier_time_s: NotWritten[Array] = NOT_WRITTEN
    noises: NotWritten[Noises] = NOT_WRITTEN

    @property
    def sigma_a(self) -> Noise:
        """SIGMA_A of the acceleration noise alone (m/s²)."""
        return Noise.from_fields(self.sigma_a_m_s2, self.sigma_a_m_s2_interval)

    @property
    def sigma_a_two_state(self) -> Noise:
        """SIGMA_A (m/s²) that KF needs, because it has no states for biases."""
        return Noise.from_fields(self.sigma_a_two_state_m_s2, self.sigma_a_two_state_m_s2_interval)

    @property
    def sigma_z(self) -> Noise:
        return Noise.from_fields(self.sigma_z_m, self.sigma_z_m_interval)


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
    axes : tuple of Axis
    settings : Settings
        Current settings of KF, with which the estimates are compared.
    names : tuple of str, optional
        Axis names and "horizontal"; default: all.
    progress : callable
        Called with the name of each axis.
    flight : Flight, optional
        Flight whose IMU data separate biases and tilt from noise.
    may_drift : bool
        True if the source may drift (odometry).
    motion_cache : dict, optional
        IMU motion that several estimates share.
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
                # Positions far from the path cause rounding errors
                tunings[name] = Unavailable(
                    f"estimate of the noises ({name})",
                    str(error),
                    "Remove positions far from the path.",
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
    """Estimate the noises that several axes with equal measurement times have in common.

    See :func:`tune` for the parameters.
    """
    kf_inputs = [preintegrate(axis, settings) for axis in axes]
    all_time_s = axes[0].measurement_time_s[-len(kf_inputs[0].measurement_m) :]
    axes = tuple(axis.keep_rows(independent_rows(axis.measurement_time_s)) for axis in axes)
    axis_positions = [kf_positions(preintegrate(axis, settings)) for axis in axes]
    measurement_count = len(axis_positions[0].measurement_m) - 1
    if measurement_count < MIN_MEASUREMENTS:
        return too_few_measurements(
            f"estimate of the noises ({name})", measurement_count, MIN_MEASUREMENTS
        )
    current_noises = Noises(settings.sigma_a_m_s2, settings.sigma_z_m)
    kf_fit = maximise_likelihood(axis_positions, current_noises, np.ones(measurement_count))
    # The estimate with biases, tilt and time offset needs IMU data
    motion_fit = None
    if flight is not None and settings.input == "imu":
        measured_m = np.column_stack([axis.measurement_m for axis in axes])
        # KF's fit contains no weight of the first measurement: it is the initial state
        axis_weights = np.concatenate([np.ones(len(measured_m) - measurement_count), kf_fit.weight])
        prepared_motion = prepare_motion(
            flight,
            axes[0].measurement_time_s,
            measured_m,
            directions=np.array([axis.direction for axis in axes]),
            dt_s=settings.dt_s,
            weight=axis_weights,
            motion_cache=motion_cache,
        )
        if not isinstance(prepared_motion, Unavailable):
            start_noises = replace(
                kf_fit.noises, random_walk_m=START_RANDOM_WALK_M if may_drift else 0.0
            )
            # An approximate time offset is sufficient: it hardly changes the noises
            offset_s, start_noises = prepared_motion.search_offset(
                start_noises, START_SIGMA_A_FACTORS, has_scale=False
            )
            motion_fit = maximise_likelihood(
                [prepared_motion.positions_at_offset(offset_s)],
                start_noises,
                prepared_motion.weight,
            )
    best_fit = kf_fit if motion_fit is None else motion_fit
    is_outlier = kf_fit.outlier_probability > 0.5
    if len(all_time_s) > measurement_count:
        all_positions = [kf_positions(kf_input) for kf_input in kf_inputs]
        is_outlier = outlier_probability(all_positions, kf_fit, len(all_time_s)) > 0.5
    if np.mean(is_outlier) > MAX_OUTLIER_FRACTION:
        return Unavailable(
            f"estimate of the noises ({name})",
            f"{100 * np.mean(is_outlier):.0f} % of the measurements are outliers, too many to "
            "estimate SIGMA_Z",
            "Reduce the outliers of the positioning system.",
        )
    sigma_a, sigma_z = (_estimate_noise(best_fit, noise_index) for noise_index in (0, 1))
    final_sigma_z_m = sigma_z.value or sigma_z.high or best_fit.noises.sigma_z_m
    kf_sigma_a = sigma_a if motion_fit is None else _estimate_kf_sigma_a(kf_fit, final_sigma_z_m)
    if motion_fit is None and flight is not None and settings.input == "imu":
        # Without estimates of biases and tilt, KF's SIGMA_A is only an upper bound of the noise
        sigma_a = Noise(None, None, kf_sigma_a.high)
    final_noises = Noises(
        kf_sigma_a.value or kf_sigma_a.high or kf_fit.noises.sigma_a_m_s2, final_sigma_z_m
    )
    gain_nats = kf_fit.score(current_noises) - kf_fit.score(final_noises)
    return AxisTuning(
        name=name,
        **sigma_a.as_fields("sigma_a_m_s2"),
        **sigma_z.as_fields("sigma_z_m"),
        **kf_sigma_a.as_fields("sigma_a_two_state_m_s2"),
        log_likelihood_gain_per_measurement=gain_nats / measurement_count,
        before=_assess_innovations(kf_inputs[0], current_noises, is_outlier),
        after=_assess_innovations(kf_inputs[0], final_noises, is_outlier),
        outlier_time_s=all_time_s[is_outlier],
        count=len(all_time_s),
        outliers=int(np.count_nonzero(is_outlier)),
        held_out=_check_held_out(name, current_noises, kf_fit),
        noises=best_fit.noises,
        biases_fitted=motion_fit is not None,
    )


def _estimate_noise(fit: NoiseFit, noise_index: int) -> Noise:
    """Return SIGMA_A (``noise_index`` 0) or SIGMA_Z (1) of a fit with its 95 % interval."""
    best_noises = fit.noises.sigma_a_m_s2, fit.noises.sigma_z_m

    def score(log_value: float, log_other: float) -> float:
        log_noises = (log_value, log_other) if noise_index == 0 else (log_other, log_value)
        sigma_a, sigma_z = np.exp(log_noises).tolist()
        return fit.score(Noises(sigma_a, sigma_z, fit.noises.random_walk_m))

    search_range = (SIGMA_A_SEARCH_M_S2, SIGMA_Z_SEARCH_M)[noise_index]
    variance_factor = (1.0, fit.sigma_z_variance_factor)[noise_index]
    return _noise_with_interval(
        score,
        (np.log(best_noises[noise_index]), np.log(best_noises[1 - noise_index])),
        search_range,
        variance_factor,
    )


def _estimate_kf_sigma_a(fit: NoiseFit, sigma_z: float) -> Noise:
    def score(log_a: float, _: float = 0.0) -> float:
        return fit.score(Noises(float(np.exp(log_a)), sigma_z))

    low_log_sigma, high_log_sigma = np.log(SIGMA_A_SEARCH_M_S2)
    best_log_a = float(
        minimize_scalar(score, bounds=(low_log_sigma, high_log_sigma), options={"xatol": 1e-3}).x
    )
    return _noise_with_interval(score, (best_log_a, 0.0), SIGMA_A_SEARCH_M_S2)


def _noise_with_interval(
    score: Callable[[float, float], float],
    best_logs: tuple[float, float],
    search_range: tuple[float, float],
    variance_factor: float = 1.0,
) -> Noise:
    estimate = float(np.exp(best_logs[0]))
    low, high = profile_ends(score, best_logs, search_range, variance_factor)
    is_inside = (
        search_range[0] * MAX_SEARCH_END_RATIO < estimate < search_range[1] / MAX_SEARCH_END_RATIO
    )
    is_closed = low is not None and high is not None
    return Noise(estimate if is_inside and is_closed else None, low, high)


def _assess_innovations(
    kf_input: Preintegrated, noises: Noises, is_outlier: BoolArray
) -> Consistency | Unavailable:
    nu, s = innovations(kf_input, noises.sigma_a_m_s2, noises.sigma_z_m, is_outlier)
    return assess(nu[~is_outlier], s[~is_outlier])


def _check_held_out(name: str, current_noises: Noises, fit: NoiseFit) -> HeldOutCheck | Unavailable:
    half_count = len(fit.weight) // 2
    if half_count < MIN_MEASUREMENTS:
        return Unavailable(
            f"held-out test of SIGMA_A and SIGMA_Z ({name})",
            f"half of the segment contains only {half_count} measurements (at least "
            f"{MIN_MEASUREMENTS} are needed)",
            "Analyse a longer segment.",
        )
    # The first measurement is KF's initial state
    first_half = [positions.first(1 + half_count) for positions in fit.score.axis_positions]
    first_fit = maximise_likelihood(
        first_half, fit.noises, fit.weight[:half_count], fits_outliers=False
    )
    tuned_noises = first_fit.noises
    # -ln p of the second half: whole flight minus first half
    current_score, tuned_score = (
        fit.score(noises) - first_fit.score(noises) for noises in (current_noises, tuned_noises)
    )
    count = len(fit.weight) - half_count
    return HeldOutCheck(
        tuned_noises.sigma_a_m_s2,
        tuned_noises.sigma_z_m,
        count,
        (current_score - tuned_score) / count,
    )
