"""Consistency tests of each aiding source of EKF2 with its logged innovations.

Statistics: :mod:`px4fuse.filter.consistency`. Logged fields: PX4's ``EKF/aid_sources`` and
``EKF/ekf_helper.cpp``, v1.13 to main.
"""

import math
from collections.abc import Mapping
from typing import Literal

import numpy as np
import pandas as pd

from px4fuse.core.arrays import Array, BoolArray, compute_median_interval_s, select_intervals
from px4fuse.core.record import (
    Correlation,
    Count,
    NonNegativeFloat,
    PositiveFloat,
    Record,
    Share,
    Span,
)
from px4fuse.filter.consistency import Consistency, classify_mean_nis, compute_nis_band
from px4fuse.flight.ekf2_parameters import AIDS, Aid
from px4fuse.flight.model import AidLog, Flight, Unavailable, longest_flight, sample_step_function

from .heights import GNSS_HEIGHT_NOISE_FACTOR

AidVerdict = Literal[
    "consistent",
    "underconfident",
    "overconfident",
    "biased",
    "not_fused",
    "disabled",
    "too few samples",
]
# Minimum |mean innovation| / RMS innovation of a biased aiding source
MIN_BIAS_TO_RMS_RATIO = 0.5
# Minimum |mean innovation| / median √S of a biased aiding source
MIN_BIAS_TO_SQRT_S_RATIO = 0.2
# Length (s) of the windows in which normalised innovations ν/√S are averaged
INNOVATION_MEAN_WINDOW_S = 10.0
# Minimum number of innovations in a window
MIN_INNOVATIONS_PER_WINDOW = 5
# Minimum number of windows before a change of the mean innovation
MIN_WINDOWS_BEFORE_MEAN_CHANGE = 2
# Minimum significant change (√S) of the mean innovation
MIN_INNOVATION_CHANGE_IN_SIGMA = 0.5
# Minimum ratio of a mean innovation change to the standard deviation of earlier window means
MIN_MEAN_CHANGE_TO_SCATTER_RATIO = 6.0
# Maximum time (s) without a fused sample of an enabled aiding source. After 7 s, EKF2 resets its
# state (reset_timeout_max)
MAX_TIME_WITHOUT_FUSION_S = 5.0
# Maximum time without a fused sample in a sparse log, as a number of logging intervals
MAX_LOG_INTERVALS_WITHOUT_FUSION = 10.0
# Maximum relative difference between √R and the noise parameter from which EKF2 computes R
NOISE_RELATIVE_TOLERANCE = 0.02
# Minimum height (m) of the evaluation: near the ground, rotor downwash disturbs the barometer
MIN_EVALUATION_HEIGHT_M = 2.0
# Window length (barometer samples) of the running median of the height
HEIGHT_MEDIAN_FILTER_LENGTH = 11


class AidAxisStatistics(Record, kw_only=True):
    """Innovation statistics of one aiding source along one axis, in the unit of its measurements.

    Attributes
    ----------
    samples : int
        Number of fused and rejected samples.
    s_sqrt_median : float
        Median of √S.
    rejected_fraction : float
        Fraction of samples outside the gate along this axis.
    change : (float, float) or None
        Time (s) and size (√S) of the largest significant change of the mean innovation.
    """

    samples: Count
    innovation_mean: float
    innovation_std: NonNegativeFloat
    s_sqrt_median: PositiveFloat
    nis_mean: PositiveFloat
    nis_band: tuple[NonNegativeFloat, NonNegativeFloat]
    sigma_ratio: PositiveFloat
    rejected_fraction: Share
    lag1_autocorrelation: Correlation
    ljung_box_p: Share
    bias_p: Share
    change: Span | None = None

    @property
    def mean_normalised_innovation(self) -> float:
        return self.innovation_mean / self.s_sqrt_median


class AidResult(Record, kw_only=True):
    """Fusion and consistency of one aiding source of EKF2 in flight.

    Attributes
    ----------
    enabled_fraction : float or None
        Fraction of the flight in which the source was enabled; None if not logged.
    fused_fraction, rejected_fraction : float
        Fractions of the samples in the time in which the source was enabled.
    fused_logged : bool
        True if the log contains fusion flags.
    longest_gap_s : (float, float)
        Start and end (s) of the longest time without a fused sample.
    resets : int
        Number of resets of EKF2's state to the source.
    gate : float
        Innovation gate in √S.
    noise : float or None
        Median √R.
    noise_from : str
        Parameter from which R is computed, or "reported accuracy".
    """

    label: str
    unit: str
    topic: str
    enabled_fraction: Share | None = None
    fused_fraction: Share
    fused_logged: bool
    rejected_fraction: Share
    longest_gap_s: Span
    resets: Count
    gate: PositiveFloat
    noise: PositiveFloat | None = None
    noise_from: str
    verdict: AidVerdict
    axes: dict[str, AidAxisStatistics]

    @property
    def longest_gap_duration_s(self) -> float:
        return self.longest_gap_s[1] - self.longest_gap_s[0]

    @property
    def is_faulty(self) -> bool:
        """True if the source is biased, overconfident, or enabled but not fused."""
        return self.verdict in ("not_fused", "biased", "overconfident")

    @property
    def nis_mean(self) -> float:
        """Mean NIS of EKF2 with this aiding source, over all its axes; NaN if unknown."""
        return _compute_mean_nis(self.axes)


def find_flight_span(flight: Flight) -> Span | Unavailable:
    """Return start and end (s) of the longest flight, without the time close to the ground."""
    if isinstance(flight.airborne, Unavailable):
        return 0.0, flight.log.duration_s
    if not flight.airborne:
        return Unavailable("EKF2 aids", "the vehicle never took off", "Record a flight.")
    start, end = longest_flight(flight.airborne)
    # The barometer is used, because EKF2's height may be wrong
    if flight.barometer is not None:
        down_m = (
            flight.barometer["down_m"].loc[start:end].rolling(HEIGHT_MEDIAN_FILTER_LENGTH).median()
        )
        height_m = (down_m.dropna().iloc[0] if down_m.notna().any() else 0.0) - down_m
        times_above_min_height_s = height_m.index[
            height_m > min(MIN_EVALUATION_HEIGHT_M, height_m.max() / 2.0)
        ]
        if len(times_above_min_height_s):
            start, end = times_above_min_height_s[[0, -1]].tolist()
    return start, end


def evaluate_aids(flight: Flight) -> dict[str, AidResult] | Unavailable:
    """Evaluate all logged aiding sources of EKF2 in flight; keys: PX4's source names."""
    if isinstance(flight.ekf2, Unavailable):
        return flight.ekf2
    if not flight.ekf2.aids:
        return Unavailable(
            "EKF2 aids",
            "the log contains no EKF2 innovations in flight (estimator_aid_src topics, "
            "estimator_innovations or ekf2_innovations)",
            "Record a ULog with SDLOG_PROFILE bit 0 (default).",
        )
    span = find_flight_span(flight)
    if isinstance(span, Unavailable):
        return span
    aid_logs = flight.ekf2.aids
    return {
        name: _evaluate_aid(aid, aid_logs[name], *span)
        for name, aid in AIDS.items()
        if name in aid_logs
    }


def _evaluate_aid(aid: Aid, aid_log: AidLog, start_s: float, end_s: float) -> AidResult:
    """Evaluate fusion and innovations of one aiding source between two times of the flight (s)."""
    samples = aid_log.samples.loc[start_s:end_s]
    sample_times_s = samples.index.to_numpy()
    gate = _find_applied_gate(aid, aid_log)

    def select_axis_columns(name: str) -> Array:
        """Return the columns of a quantity, shape (samples, axes)."""
        return samples[[f"{name}_{axis}" for axis in aid_log.axes]].to_numpy()

    innovation, innovation_variance = map(select_axis_columns, ("innovation", "variance"))
    # 1. Decision of EKF2 on each sample: logged, or computed from the gate
    max_gap_s = MAX_TIME_WITHOUT_FUSION_S
    is_fusion_logged = "fused" in samples
    is_reset = np.zeros(len(samples), bool)
    noise_sigma_median = None
    if is_fusion_logged:
        is_fused, is_rejected = samples[["fused", "rejected"]].to_numpy().T > 0.0
        noise_variance = select_axis_columns("noise")
        # If EKF2 resets its state to a sample, it logs innovation 0 and S = R for this sample
        is_reset = ((innovation == 0.0) & np.isclose(innovation_variance, noise_variance)).all(
            axis=1
        )
        if is_fused.any():
            noise_sigma_median = float(np.median(np.sqrt(noise_variance[is_fused, 0])))
    else:
        is_rejected = np.max(innovation**2 / innovation_variance, axis=1, initial=0.0) > gate**2
        is_fused = ~is_rejected
        # The log may contain only a part of the fused samples
        if is_fused.sum() > 1:
            log_interval_s = compute_median_interval_s(sample_times_s[is_fused])
            max_gap_s = max(max_gap_s, MAX_LOG_INTERVALS_WITHOUT_FUSION * log_interval_s)
    # Samples of a disabled source do not count
    is_enabled = _was_enabled(aid_log, sample_times_s)
    is_fused &= is_enabled
    is_rejected &= is_enabled
    enabled_count = max(int(is_enabled.sum()), 1)
    # 2. Statistics of the innovations of each axis
    is_evaluated = (is_fused | is_rejected) & ~is_reset
    axes = {}
    for axis, nu, S in zip(
        aid_log.axes, innovation[is_evaluated].T, innovation_variance[is_evaluated].T, strict=True
    ):
        statistics = _evaluate_axis(sample_times_s[is_evaluated], nu, S, gate)
        if statistics is not None:
            axes[axis] = statistics
    longest_gap_s = _find_longest_gap(sample_times_s[is_fused], aid_log, start_s, end_s)
    is_gap_too_long = longest_gap_s[1] - longest_gap_s[0] > max_gap_s
    return AidResult(
        label=aid.label,
        unit=aid.unit,
        topic=aid_log.topics[0],
        enabled_fraction=None
        if aid_log.enabled is None
        else float(np.mean(_was_enabled(aid_log, np.arange(start_s, end_s, 0.1)))),
        fused_fraction=int(is_fused.sum()) / enabled_count,
        fused_logged=is_fusion_logged,
        rejected_fraction=int(is_rejected.sum()) / enabled_count,
        longest_gap_s=longest_gap_s,
        resets=int(is_reset.sum()),
        gate=gate,
        noise=noise_sigma_median,
        noise_from=_find_noise_origin(aid, aid_log, noise_sigma_median),
        axes=axes,
        verdict=_classify_aid(axes, is_gap_too_long) if is_evaluated.any() else "disabled",
    )


def _evaluate_axis(times_s: Array, nu: Array, S: Array, gate: float) -> AidAxisStatistics | None:
    """Return the statistics of innovations along one axis; None with too few innovations."""
    consistency = Consistency.from_innovations(nu, S, gate)
    if isinstance(consistency, Unavailable):
        return None
    return AidAxisStatistics(
        samples=consistency.count,
        innovation_mean=consistency.innovation_mean_m,
        innovation_std=consistency.innovation_std_m,
        s_sqrt_median=consistency.sqrt_s_median_m,
        nis_mean=consistency.nis_mean,
        nis_band=consistency.nis_band,
        sigma_ratio=consistency.sigma_ratio,
        rejected_fraction=consistency.fraction_outside_gate,
        bias_p=consistency.bias_p,
        lag1_autocorrelation=consistency.lag1_autocorrelation,
        ljung_box_p=consistency.ljung_box_p,
        change=_find_largest_innovation_mean_change(times_s, nu / np.sqrt(S)),
    )


def _was_enabled(aid_log: AidLog, times_s: Array) -> BoolArray:
    """Return True for each time at which fusion was enabled, or may have been enabled."""
    if aid_log.enabled is None:
        return np.ones(len(times_s), bool)
    return sample_step_function(aid_log.enabled, times_s) > 0.0


def _find_largest_innovation_mean_change(
    time_s: Array, normalised_innovations: Array
) -> Span | None:
    """Return time (s) and size (in √S) of the largest significant change of the mean innovation.

    Return None if no change is significant.
    """
    window_index = np.floor((time_s - time_s[0]) / INNOVATION_MEAN_WINDOW_S)
    windows = pd.Series(normalised_innovations).groupby(window_index).agg(["mean", "size"])
    windows = windows[windows["size"] >= MIN_INNOVATIONS_PER_WINDOW]
    window_means = windows["mean"].to_numpy()
    largest_mean_change = None
    # Each change that is found raises this limit to its own size, so the largest change remains
    min_mean_change = MIN_INNOVATION_CHANGE_IN_SIGMA
    # For each window, compare the mean innovation before it with that of the next two windows. A
    # change may be inside the window, so neither mean contains the window
    for index in range(MIN_WINDOWS_BEFORE_MEAN_CHANGE, len(window_means) - 2):
        mean_before_window = np.mean(window_means[:index])
        mean_change = float(np.mean(window_means[index + 1 : index + 3]) - mean_before_window)
        # Without a change, the mean of the two windows scatters by its standard error, or more if
        # the innovations are time-correlated
        std_before_window = np.std(normalised_innovations[window_index < windows.index[index]])
        innovations_per_window = windows["size"].iloc[:index].median()
        standard_error = std_before_window / math.sqrt(2.0 * innovations_per_window)
        scatter_of_window_means = max(np.std(window_means[:index], ddof=1), standard_error)
        if abs(mean_change) > max(
            min_mean_change, MIN_MEAN_CHANGE_TO_SCATTER_RATIO * scatter_of_window_means
        ):
            first_changed_index = index
            if abs(window_means[index] - mean_before_window) <= abs(mean_change) / 3.0:
                # The mean of this window is near the mean before the change, so the change is in
                # the next window
                first_changed_index += 1
            largest_mean_change = (
                float(time_s[0] + INNOVATION_MEAN_WINDOW_S * windows.index[first_changed_index]),
                mean_change,
            )
            min_mean_change = abs(mean_change)
    return largest_mean_change


def _find_applied_gate(aid: Aid, aid_log: AidLog) -> float:
    """Return the innovation gate of EKF2, in multiples of √S.

    It is computed from logged test ratios or, without them, from the gate parameter.
    """
    axis = aid_log.axes[0]
    if f"ratio_{axis}" in aid_log.samples:
        rows = aid_log.samples[aid_log.samples[f"ratio_{axis}"] > 0.0]
        nis = rows[f"innovation_{axis}"] ** 2 / rows[f"variance_{axis}"]
        if (nis > 0.0).any():
            return float(np.sqrt(np.median(nis / rows[f"ratio_{axis}"])))
    return max(aid_log.parameters.get(aid.gate, aid.default_gate), 0.01)


def _find_noise_origin(aid: Aid, aid_log: AidLog, noise_sigma: float | None) -> str:
    """Return the origin of R: a parameter name, or a text such as "reported accuracy"."""
    parameter_value = aid_log.parameters.get(aid.noise)
    if noise_sigma is None:
        return ""
    if parameter_value is None:
        return aid.noise_source_text
    # σ is the parameter, the parameter times a factor (GNSS height), or the square root of the
    # parameter (EKF2_DRAG_NOISE is a variance)
    possible_sigmas = (
        parameter_value,
        GNSS_HEIGHT_NOISE_FACTOR * parameter_value,
        math.sqrt(parameter_value),
    )
    if np.isclose(noise_sigma, possible_sigmas, NOISE_RELATIVE_TOLERANCE, 0.0).any():
        return aid.noise
    return aid.noise_source_text or aid.noise


def _find_longest_gap(fusion_times_s: Array, aid_log: AidLog, start_s: float, end_s: float) -> Span:
    """Return start and end (s) of the longest time without a fused sample of an enabled source.

    A sample whose fusion is not logged counts as fused.
    """
    times_with_unknown_fusion_s = aid_log.times_with_unknown_fusion_s
    is_inside = (times_with_unknown_fusion_s > start_s) & (times_with_unknown_fusion_s < end_s)
    gap_limits_s = np.unique(
        np.r_[start_s, fusion_times_s, end_s, times_with_unknown_fusion_s[is_inside]]
    )
    # EKF2 may disable an aiding source up to 1 s after its last fused sample. A gap therefore
    # counts only if the source is still enabled 1 s after the gap has started
    is_enabled_in_gap = _was_enabled(aid_log, gap_limits_s[:-1] + 1.0)
    return max(
        select_intervals(gap_limits_s, is_enabled_in_gap),
        key=lambda gap: gap[1] - gap[0],
        default=(start_s, start_s),
    )


def _classify_aid(axes: dict[str, AidAxisStatistics], is_gap_too_long: bool) -> AidVerdict:
    """Return the verdict on an aiding source: the first fault found, or "consistent"."""
    if is_gap_too_long:
        return "not_fused"
    if not axes:
        return "too few samples"
    for axis in axes.values():
        min_mean_innovation = max(
            MIN_BIAS_TO_SQRT_S_RATIO, MIN_BIAS_TO_RMS_RATIO * math.sqrt(axis.nis_mean)
        )
        if abs(axis.mean_normalised_innovation) > min_mean_innovation:
            return "biased"
    return classify_mean_nis(
        _compute_mean_nis(axes), compute_nis_band(sum(axis.samples for axis in axes.values()))
    )


def _compute_mean_nis(axes: Mapping[str, AidAxisStatistics]) -> float:
    return float(np.mean([axis.nis_mean for axis in axes.values()] or [np.nan]))
