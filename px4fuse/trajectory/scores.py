"""Errors of a trajectory: statistics, relative pose error (RPE), and 95 % interval of the RMSE."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import ndtr, stdtrit

from px4fuse.core.arrays import Array, IntArray, compute_median_interval_s, rms
from px4fuse.core.record import Count, NonNegativeFloat, OrUnavailable, Record
from px4fuse.errors import SettingsError
from px4fuse.flight.model import Unavailable

from .correlation import autocovariance
from .model import Trajectory, cumulative_distance

PairDistanceUnit = Literal["frames", "m", "s"]

# Maximum relative deviation of the distance of a pose pair from the requested distance, as in the
# evo package
MAX_RELATIVE_PAIR_DISTANCE_ERROR = 0.1
DEFAULT_RPE_DISTANCES_M = (0.1, 0.5, 1.0, 5.0, 10.0, 50.0, 100.0, 500.0, 1000.0)
DEFAULT_RPE_TIMES_S = (1.0, 10.0, 60.0)
MAX_DEFAULT_RPE_DISTANCES = 3
MAX_DEFAULT_RPE_TIMES = 2
# Lower limit of the default distance of RPE pairs, as fraction of the length of the path
MIN_PAIR_DISTANCE_FRACTION_OF_PATH = 1 / 200
# Maximum default path length (or time) between the two poses of an RPE pair, as fraction of the
# whole path length (or duration)
MAX_PAIR_DISTANCE_FRACTION = 1 / 5
BOOTSTRAP_RESAMPLES = 2000
BOOTSTRAP_SEED = 20120101
# Block length of the bootstrap ÷ autocorrelation time of the squared errors
BLOCK_LENGTH_IN_CORRELATION_TIMES = 3.0
# Maximum lag in the sum of autocorrelations ÷ autocorrelation time (Sokal 1997)
WINDOW_LENGTH_IN_CORRELATION_TIMES = 5.0
# Minimum number of bootstrap blocks for a 95 % interval
MIN_BOOTSTRAP_BLOCKS = 5.0


@dataclass(frozen=True)
class RpePairDistance:
    """Distance between the two poses of an RPE pair in frames, metres or seconds."""

    value: float
    unit: PairDistanceUnit

    def __str__(self) -> str:
        return f"{self.value:g} {self.unit}"


class Statistics(Record):
    """Statistics of a series of errors."""

    count: Count
    rmse: NonNegativeFloat
    mean: float
    median: float
    std: NonNegativeFloat
    min: float
    max: float


class RmseInterval(Record):
    """95 % interval of an RMSE by block bootstrap.

    Attributes
    ----------
    low, high : float
        Limits of the interval.
    block_length : int
        Number of successive errors in a block.
    blocks : float
        Number of errors divided by the block length.
    """

    low: float
    high: float
    block_length: Count
    blocks: float


class RelativePoseError(Record):
    """Relative pose error (RPE) of pairs of poses at a fixed distance.

    Attributes
    ----------
    delta : float
        Distance between the two poses of a pair, in ``unit``.
    all_pairs : bool
        True: pairs overlap. False: each pair starts at the end of the previous pair.
    pairs_from : str
        Path along which distances are measured: the reference.
    translation_m, rotation_deg : Statistics or Unavailable
    interval_m : RmseInterval or Unavailable
        95 % interval of the RMSE of the translation.
    """

    delta: float
    unit: PairDistanceUnit
    all_pairs: bool
    pairs_from: Literal["reference"]
    translation_m: OrUnavailable[Statistics]
    interval_m: OrUnavailable[RmseInterval]
    rotation_deg: OrUnavailable[Statistics]

    @property
    def delta_text(self) -> str:
        """Distance between the two poses of a pair, with unit."""
        return str(RpePairDistance(self.delta, self.unit))


def compute_statistics(errors: Array) -> Statistics:
    """Compute RMSE, mean, median, standard deviation and range of errors, shape (n,)."""
    return Statistics(
        count=len(errors),
        rmse=rms(errors),
        mean=float(np.mean(errors)),
        median=float(np.median(errors)),
        std=float(np.std(errors)),
        min=float(np.min(errors)),
        max=float(np.max(errors)),
    )


def compute_rotation_statistics(a: Rotation, b: Rotation) -> Statistics:
    """Compute the statistics of the angles (°) between two series of rotations."""
    return compute_statistics(np.degrees((a.inv() * b).magnitude()))


def choose_default_deltas(distance_m: Array, time_s: Array) -> tuple[RpePairDistance, ...]:
    """Choose distances and times for the RPE from path length and duration of the flight."""

    def choose_delta_values(
        distance_or_time: Array, values: Sequence[float], min_fraction: float
    ) -> list[float]:
        """Return the allowed ``values``, in their order."""
        total = float(np.ptp(distance_or_time))
        minimum = max(min_fraction * total, 2.0 * compute_median_interval_s(distance_or_time))
        return [value for value in values if minimum <= value <= MAX_PAIR_DISTANCE_FRACTION * total]

    distances_m = choose_delta_values(
        distance_m, DEFAULT_RPE_DISTANCES_M, MIN_PAIR_DISTANCE_FRACTION_OF_PATH
    )
    times_s = choose_delta_values(time_s, DEFAULT_RPE_TIMES_S, 0.0)
    return (
        *(RpePairDistance(value, "m") for value in distances_m[-MAX_DEFAULT_RPE_DISTANCES:]),
        *(RpePairDistance(value, "s") for value in times_s[-MAX_DEFAULT_RPE_TIMES:]),
    )


def find_pose_pairs(
    position_m: Array, time_s: Array, delta: RpePairDistance, *, all_pairs: bool = True
) -> tuple[IntArray, IntArray]:
    """Find pairs of poses at a fixed distance for the RPE.

    Parameters
    ----------
    position_m : ndarray, shape (n, 3)
    time_s : ndarray, shape (n,)
    delta : RpePairDistance
        Distance of a pair: path length, time or number of frames.
    all_pairs : bool
        True: pairs start at every pose. False: pairs do not overlap.

    Returns
    -------
    start_indices, end_indices : ndarray of int, shape (k,)
        Indices of the two poses of each pair.

    Raises
    ------
    SettingsError
        The distance is not positive, or the number of frames is not an integer.
    """
    if not 0.0 < delta.value < np.inf:
        raise SettingsError(f"RPE delta {delta}: the value must be positive.")
    pose_count = len(time_s)
    if delta.unit == "frames":
        frame_step = int(delta.value)
        if frame_step != delta.value:
            raise SettingsError(f"RPE delta {delta}: the number of frames must be an integer.")
        start_indices = np.arange(0, pose_count - frame_step, 1 if all_pairs else frame_step)
        return start_indices, start_indices + frame_step
    distance_or_time = cumulative_distance(position_m) if delta.unit == "m" else time_s - time_s[0]
    if not all_pairs:
        return _find_consecutive_pairs(np.diff(distance_or_time), delta.value)
    start_indices = np.arange(pose_count - 1)
    # Candidates for the second pose of each pair, one row per pair: the last two poses before the
    # distance delta, and the first two poses at or after it. Rounding errors may change which one
    # is nearest. All candidates are after the first pose
    next_indices = np.searchsorted(distance_or_time, distance_or_time + delta.value)[:-1]
    candidate_indices = np.clip(
        next_indices[:, None] + np.arange(-2, 2), start_indices[:, None] + 1, pose_count - 1
    )
    candidates = distance_or_time[candidate_indices]
    pair_distance_error = np.abs(candidates - distance_or_time[start_indices, None] - delta.value)
    best_columns = np.argmin(pair_distance_error, axis=1)
    # While the vehicle is at rest, several poses have the same distance. Use the first of them that
    # is after the start
    end_indices = np.searchsorted(distance_or_time, candidates[start_indices, best_columns])
    end_indices = np.maximum(end_indices, start_indices + 1)
    min_error = pair_distance_error.min(axis=1)
    is_distance_near_delta = min_error <= MAX_RELATIVE_PAIR_DISTANCE_ERROR * delta.value
    return start_indices[is_distance_near_delta], end_indices[is_distance_near_delta]


def _find_consecutive_pairs(steps: Array, delta: float) -> tuple[IntArray, IntArray]:
    """Return first and last indices of consecutive pose pairs with the distance ``delta``."""
    # For each pair, the sum of steps (distance or time) starts again at 0, as in the evo package.
    # Differences of one cumulative sum would have other rounding errors
    pair_ends = [0]
    distance_or_time = 0.0
    for index, step in enumerate(steps.tolist(), 1):
        distance_or_time += step
        if distance_or_time >= delta:
            pair_ends.append(index)
            distance_or_time = 0.0
    end_indices = np.array(pair_ends, dtype=np.intp)
    return end_indices[:-1], end_indices[1:]


def compute_relative_pose_error(
    aligned_estimate: Trajectory,
    reference: Trajectory,
    delta: RpePairDistance,
    *,
    all_pairs: bool = True,
) -> RelativePoseError:
    """Compute the relative pose error (RPE) of pairs of poses at a fixed distance.

    The error of a pair (i, j) is E = (Q_i⁻¹ Q_j)⁻¹ (P_i⁻¹ P_j), Sturm (2012), eq. 1.

    Parameters
    ----------
    aligned_estimate, reference : Trajectory
        Trajectories P and Q, with poses at the same times.
    delta, all_pairs
        See :func:`find_pose_pairs`.
    """
    start_indices, end_indices = find_pose_pairs(
        reference.position_m, reference.time_s, delta, all_pairs=all_pairs
    )
    analysis_name = f"RPE over {delta}"
    # The three remaining arguments of make_result are translation_m, interval_m and rotation_deg
    make_result = partial(RelativePoseError, delta.value, delta.unit, all_pairs, "reference")
    if not len(start_indices):
        no_pairs_result = Unavailable(
            analysis_name,
            f"the reference has no pair of poses with a distance of {delta}",
            "Use another distance of RPE pairs (delta).",
        )
        return make_result(no_pairs_result, no_pairs_result, no_pairs_result)
    # Displacements in each pair, in the frame of the reference
    estimate_m, reference_m = (
        track.position_m[end_indices] - track.position_m[start_indices]
        for track in (aligned_estimate, reference)
    )
    rotations = get_rotations(aligned_estimate, reference, analysis_name)
    rotation_deg: OrUnavailable[Statistics]
    if isinstance(rotations, Unavailable):
        rotation_deg = rotations
    else:
        # With orientations, convert each displacement to the axes of the first pose of its pair
        estimate_start_inverse, reference_start_inverse = (
            rotation[start_indices].inv() for rotation in rotations
        )
        estimate_m = estimate_start_inverse.apply(estimate_m)
        reference_m = reference_start_inverse.apply(reference_m)
        estimate_rotation, reference_rotation = rotations
        rotation_deg = compute_rotation_statistics(
            reference_start_inverse * reference_rotation[end_indices],
            estimate_start_inverse * estimate_rotation[end_indices],
        )
    # Error of the displacement between the two poses: estimate minus reference. It is as long as
    # the translation of the pose error E, because a rotation does not change the length
    translation_m = np.linalg.norm(estimate_m - reference_m, axis=1)
    # Pairs that overlap have correlated errors: a pair overlaps with as many following pairs as it
    # has steps. A bootstrap block contains all of them
    overlapping_pair_count = int(np.median(end_indices - start_indices)) if all_pairs else 1
    rmse_interval_m = estimate_rmse_interval(
        translation_m, analysis_name, min_block_length=overlapping_pair_count
    )
    return make_result(compute_statistics(translation_m), rmse_interval_m, rotation_deg)


def get_rotations(
    aligned_estimate: Trajectory, reference: Trajectory, analysis_name: str
) -> tuple[Rotation, Rotation] | Unavailable:
    """Return the orientations of both trajectories, or Unavailable if one has none."""
    if aligned_estimate.rotation is not None and reference.rotation is not None:
        return aligned_estimate.rotation, reference.rotation
    role = "reference" if aligned_estimate.rotation else "estimate"
    return Unavailable(
        analysis_name,
        f"the {role} has no orientations",
        f"Give a trajectory with orientations as {role}.",
    )


def estimate_rmse_interval(
    errors: Array, analysis_name: str, *, min_block_length: int = 1
) -> RmseInterval | Unavailable:
    """Compute the 95 % interval of the RMSE of correlated errors by circular block bootstrap.

    Sources: Politis and Romano (1992); Hesterberg (2015), section 5.3, for the percentiles.
    """
    squared_errors = errors**2
    error_count = len(squared_errors)
    correlation_time_in_samples = compute_autocorrelation_time(squared_errors)
    block_length = max(
        int(np.ceil(BLOCK_LENGTH_IN_CORRELATION_TIMES * correlation_time_in_samples)),
        min_block_length,
    )
    if error_count < MIN_BOOTSTRAP_BLOCKS * block_length:
        return Unavailable(
            f"95 % interval of the {analysis_name} RMSE",
            f"{error_count} errors form fewer than {MIN_BOOTSTRAP_BLOCKS:.0f} independent blocks "
            f"of {block_length} errors for the bootstrap",
            "Use a longer flight.",
        )
    circular_errors = np.append(squared_errors, squared_errors[: block_length - 1])
    cumulative_squared_errors = np.append(0.0, np.cumsum(circular_errors))
    # Mean squared error of each circular block
    block_means = (
        cumulative_squared_errors[block_length:] - cumulative_squared_errors[:-block_length]
    ) / block_length
    block_count = error_count / block_length
    block_starts = np.random.default_rng(BOOTSTRAP_SEED).integers(
        0, error_count, (BOOTSTRAP_RESAMPLES, round(block_count))
    )
    resampled_means = block_means[block_starts].mean(axis=1)
    # With few blocks, the interval between the 2.5 % and 97.5 % quantiles is too narrow. Other
    # quantiles give the width of a Student t interval with √(n / (n - 1)) bias correction
    student_t_quantile = float(stdtrit(block_count - 1.0, 0.975))
    tail_probability = float(ndtr(-student_t_quantile * np.sqrt(block_count / (block_count - 1.0))))
    limits = np.quantile(resampled_means, [tail_probability, 1.0 - tail_probability])
    low, high = np.sqrt(np.maximum(limits, 0.0))
    return RmseInterval(float(low), float(high), block_length, block_count)


def compute_autocorrelation_time(values: Array) -> float:
    """Compute the integrated autocorrelation time (samples), 1 + 2 Σ ρ (Sokal 1997, section 3)."""
    centred_values = values - values.mean()
    if not centred_values.any():
        return 1.0
    sample_count = len(centred_values)
    covariance_by_lag = autocovariance(centred_values)
    correlation_times = 2.0 * np.cumsum(covariance_by_lag / covariance_by_lag[0]) - 1.0
    is_long_enough = (
        np.arange(sample_count) >= WINDOW_LENGTH_IN_CORRELATION_TIMES * correlation_times
    )
    if not is_long_enough.any():
        return float(sample_count)
    return max(1.0, float(correlation_times[np.argmax(is_long_enough)]))
