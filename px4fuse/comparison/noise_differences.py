"""Position noise that differs between horizontal directions, or between parts of the flight."""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pandas as pd

from px4fuse.core.arrays import Array, BoolArray
from px4fuse.filter.likelihood import innovations, preintegrate
from px4fuse.filter.signals import Axis, make_horizontal_axis
from px4fuse.filter.tuning import AxisTuning, tune
from px4fuse.flight.model import Unavailable

from .model import AxisComparison, Comparison, select_north_and_east

# Minimum ratio of the mean NIS along north and east, for separate noise estimates
MIN_AXIS_NIS_RATIO = 1.7
# Minimum ratio of the noise correlation (north to east) to its σ: reached by chance once in 3
# million flights
MIN_CORRELATION_SIGMAS = 5.0
MAX_FLIGHT_PART_COUNT = 12
MIN_PART_MEASUREMENTS = 25


class NoisyFlightPart(NamedTuple):
    """Time span (s) with larger innovations than the rest of the flight.

    ``sigma_ratio`` is σ of the innovations in the time span ÷ σ in the rest of the flight.
    ``sigma_ratio_without_outliers`` is computed without the detected outliers.
    """

    start_s: float
    end_s: float
    sigma_ratio: float
    sigma_ratio_without_outliers: float


def tune_perpendicular_axes(comparison: Comparison) -> tuple[AxisTuning, ...]:
    """Estimate separate noises along two perpendicular axes, if the noises seem to differ.

    The axes are the directions of the largest and the smallest noise if north and east are
    correlated, else north and east. Return () if north or east is missing, or if they are not
    correlated and their mean NIS are similar.
    """
    compared_axes = select_north_and_east(comparison)
    summaries = [axis.filters["kf"] for axis in compared_axes]
    nis_means = [summary.nis_mean for summary in summaries if not isinstance(summary, Unavailable)]
    if len(nis_means) < 2:
        return ()
    axes: Sequence[Axis] = [compared.axis for compared in compared_axes]
    if (heading_deg := _find_heading_of_largest_noise(compared_axes)) is not None:
        axes = [make_horizontal_axis(axes, heading_deg + turn_deg) for turn_deg in (0.0, 90.0)]
    elif max(nis_means) < MIN_AXIS_NIS_RATIO * min(nis_means):
        return ()
    return tuple(
        axis_tuning
        for axis in axes
        for axis_tuning in tune((axis,), comparison.settings).values()
        if isinstance(axis_tuning, AxisTuning)
    )


def _find_heading_of_largest_noise(north_and_east: Sequence[AxisComparison]) -> float | None:
    """Return the heading (°, 0 to 180) of the largest noise, if north and east are correlated.

    The noise is estimated from differences of successive innovations of KF, in which slow errors
    cancel. The correlation of north and east is computed from the signs of these differences:
    sin(π/2 · mean(sign(north) · sign(east))) (Blomqvist 1950).
    """
    innovations_m = [axis.kf_run.updates["innovation_m"] for axis in north_and_east]
    innovation_changes_m = (
        pd.concat(innovations_m, axis="columns", join="inner").diff().dropna().to_numpy()
    )
    innovation_changes_m = innovation_changes_m[::2]  # neighbouring changes share an innovation
    if len(innovation_changes_m) < MIN_PART_MEASUREMENTS:
        return None
    correlation = np.sin(0.5 * np.pi * np.sign(innovation_changes_m).prod(axis=1).mean())
    if abs(correlation) * np.sqrt(len(innovation_changes_m)) < MIN_CORRELATION_SIGMAS:
        return None
    # Direction of largest variance (principal axis) of a covariance matrix with σ of north and
    # east: tan(2 · heading) = 2 · correlation · σ_north · σ_east / (σ_north² - σ_east²). The median
    # of the absolute values is proportional to σ, and insensitive to outliers
    north_m, east_m = np.median(np.abs(innovation_changes_m), axis=0)
    double_angle_rad = np.arctan2(2.0 * correlation * north_m * east_m, north_m**2 - east_m**2)
    return float(np.degrees(0.5 * double_angle_rad)) % 180.0


def find_noisy_flight_part(
    comparison: Comparison, axis_tuning: AxisTuning | Unavailable | None
) -> NoisyFlightPart | None:
    """Find a time span with larger innovations than in the rest of the flight."""
    axes = [axis_result.axis for axis_result in select_north_and_east(comparison)]
    if axis_tuning is None or len(axes) < 2:
        return None
    settings = comparison.settings
    if isinstance(axis_tuning, AxisTuning):
        sigma_a, sigma_z = axis_tuning.sigma_a_two_state.value, axis_tuning.sigma_z.value
        outlier_time_s = axis_tuning.outlier_time_s
    else:  # use KF's settings
        sigma_a, sigma_z = settings.sigma_a_m_s2, settings.sigma_z_m
        outlier_time_s = np.zeros(0)
    if sigma_a is None or sigma_z is None:
        return None
    axis_motions = [preintegrate(axis, settings) for axis in axes]
    # Times of the positions that have an innovation
    time_s = axes[0].measurement_time_s[-len(axis_motions[0].measurement_m) :]
    if len(time_s) < MAX_FLIGHT_PART_COUNT * MIN_PART_MEASUREMENTS // 2:
        return None
    part_count = min(MAX_FLIGHT_PART_COUNT, len(time_s) // MIN_PART_MEASUREMENTS)
    part_edges = np.linspace(0, len(time_s), part_count + 1).astype(int)

    def compute_scaled_innovations(is_excluded: BoolArray | None) -> Array:
        """Return |innovation| / √S divided by its median, shape (axes, n)."""
        axis_innovations = [
            innovations(axis_motion, sigma_a, sigma_z, is_excluded) for axis_motion in axis_motions
        ]
        magnitudes = np.abs([nu / np.sqrt(s) for nu, s in axis_innovations])
        return magnitudes / np.median(magnitudes, axis=1, keepdims=True)

    scaled_innovations = compute_scaled_innovations(None)
    part_medians = np.array(
        [np.median(scaled_innovations[:, first:end]) for first, end in pairwise(part_edges)]
    )
    # A flight part is noisy if its median innovation is above the geometric mean of the smallest
    # and the largest median of all parts: this limit separates two levels of noise
    noisy_parts = np.flatnonzero(part_medians > np.sqrt(part_medians.min() * part_medians.max()))
    if len(noisy_parts) in (0, part_count):
        return None
    # The noisy parts must be consecutive, so that they are one time span
    if noisy_parts[-1] - noisy_parts[0] + 1 > len(noisy_parts):
        return None
    first_row, end_row = part_edges[noisy_parts[0]], part_edges[noisy_parts[-1] + 1]
    is_noisy = np.zeros(len(time_s), bool)
    is_noisy[first_row:end_row] = True

    def compute_noise_increase(magnitudes: Array) -> float:
        return float(np.median(magnitudes[:, is_noisy]) / np.median(magnitudes[:, ~is_noisy]))

    innovations_without_outliers = compute_scaled_innovations(np.isin(time_s, outlier_time_s))
    return NoisyFlightPart(
        float(time_s[first_row]),
        float(time_s[end_row - 1]),
        compute_noise_increase(scaled_innovations),
        compute_noise_increase(innovations_without_outliers),
    )
