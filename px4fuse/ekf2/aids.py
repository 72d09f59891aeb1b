"""Consistency of each EKF2 aid (measurement source), tested with its logged innovations.

Definitions: :mod:`px4fuse.filter.consistency`. Logged fields: PX4's ``EKF/aid_sources`` and
``EKF/ekf_helper.cpp``, v1.13 to main.
"""

import math
from collections.abc import Mapping
from typing import Literal

import numpy as np
import pandas as pd

from px4fuse.arrays import Array, BoolArray
from px4fuse.ekf2_parameters import AIDS, Aid
from px4fuse.filter.consistency import assess, classify_mean_nis, nis_band
from px4fuse.flight import AidLog, Ekf2, Flight, Unavailable, step_values_at
from px4fuse.record import Correlation, Count, NotNegative, Positive, Record, Share, Span

AidVerdict = Literal[
    "consistent",
    "underconfident",
    "overconfident",
    "biased",
    "not_fused",
    "disabled",
    "too few samples",
]
# Minimum |mean ν| / RMS ν and minimum |mean ν| / √S of a biased aid: above both, the mean does not
# average out, and EKF2 follows the bias
MIN_BIAS_SHARE, MIN_BIAS_IN_SIGMA = 0.5, 0.2
# Detection of a change of mean ν/√S in flight: window length (s), minimum number of samples per
# window, minimum number of windows before the change, minimum change (√S), and minimum ratio of the
# change to the scatter of the earlier window means
WINDOW_S, MIN_WINDOW_SAMPLES, MIN_WINDOWS_BEFORE, MIN_CHANGE_IN_SIGMA, MIN_CHANGE_SCATTER_RATIO = (
    10.0,
    5,
    2,
    0.5,
    6.0,
)
# Maximum time (s) without a fused sample of an enabled aid, in a log with frequent samples. EKF2
# resets to an aid after 7 s (reset_timeout_max); the default logging profile records at least 2 Hz
NOT_FUSED_LIMIT_S = 5.0
NOT_FUSED_INTERVALS = 10.0  # the same maximum in median intervals between logged fused samples
# Maximum relative difference between √R and a noise parameter that count as equal
NOISE_TOLERANCE = 0.02
# Minimum height (m) above ground at which aids are evaluated; half of the maximum height in a low
# flight. Near the ground rotor downwash disturbs the barometer, and the land detector may be wrong
MIN_HEIGHT_M = 2.0


class AidAxis(Record, frozen=True, kw_only=True):
    """Innovation statistics of one aid along one axis, in the unit of the aid.

    Attributes
    ----------
    samples : int
        Number of samples that EKF2 fused or rejected while the aid was enabled.
    innovation_mean, innovation_std : float
    s_sqrt_median : float
        Median of √S.
    nis_mean, nis_band, sigma_ratio
        See :class:`~px4fuse.filter.consistency.NisVerdict`.
    rejected_fraction : float
        Share of samples outside the gate along this axis.
    lag1_autocorrelation, ljung_box_p, bias_p : float
        See :class:`~px4fuse.filter.consistency.Consistency`.
    change : (float, float) or None
        Time (s) and size (√S) of the largest significant change of mean ν/√S in flight.
    """

    samples: Count
    innovation_mean: float
    innovation_std: NotNegative
    s_sqrt_median: Positive
    nis_mean: Positive
    nis_band: tuple[NotNegative, NotNegative]
    sigma_ratio: Positive
    rejected_fraction: Share
    lag1_autocorrelation: Correlation
    ljung_box_p: Share
    bias_p: Share
    change: Span | None = None

    @property
    def mean_normalised_innovation(self) -> float:
        """Mean innovation divided by the median √S, with sign."""
        return self.innovation_mean / self.s_sqrt_median


class AidResult(Record, frozen=True, kw_only=True):
    """Fusion and consistency of one aid in flight.

    Attributes
    ----------
    label, unit, topic : str
    enabled_fraction : float or None
        Share of the flight in which EKF2 enabled the aid; None if not logged.
    fused_fraction : float
        Share of fused samples, of all samples received while the aid was enabled.
    fused_logged : bool
        True if the log contains EKF2's decision (fused or not) on each sample; False if px4fuse
        applies the gate instead.
    rejected_fraction : float
        Share of samples rejected along any axis, of all samples received while the aid was enabled.
    longest_gap_s : (float, float)
        Start and end of the longest time without a fused sample. Only times that began while the
        aid was enabled count.
    resets : int
        Number of resets of EKF2 to the aid; the samples of resets are excluded.
    gate : float
        Innovation gate in √S.
    noise : float or None
        Median √R; None if R is not logged.
    noise_from : str
        Origin of R: a parameter name, or the reported accuracy; empty if R is not logged.
    verdict : str
    axes : mapping from axis to AidAxis
        Statistics by axis; empty with too few samples.
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
    gate: Positive
    noise: Positive | None = None
    noise_from: str
    verdict: AidVerdict
    axes: dict[str, AidAxis]

    @property
    def longest_gap_duration_s(self) -> float:
        """Longest time without a fused sample (s)."""
        return self.longest_gap_s[1] - self.longest_gap_s[0]

    @property
    def is_faulty(self) -> bool:
        """Return True if the aid is biased, overconfident, or enabled but not fused.

        An underconfident aid is not a fault: PX4's default settings are underconfident.
        """
        return self.verdict in ("not_fused", "biased", "overconfident")

    @property
    def nis_mean(self) -> float:
        """Mean NIS over all axes; NaN without axes."""
        return _mean_nis(self.axes)


def flight_span(flight: Flight) -> tuple[float, float] | Unavailable:
    """Return start and end of the flight (s), without take-off and landing close to the ground."""
    if isinstance(flight.airborne, Unavailable):
        return 0.0, flight.log.duration_s
    if not flight.airborne:
        return Unavailable("aids of EKF2", "the vehicle never took off", "Record a flight.")
    start = flight.airborne[0][0]
    end = flight.airborne[-1][1]
    if isinstance(flight.ekf2, Ekf2):
        down = flight.ekf2.state["down_m"].loc[start:end]
        height = (down.iloc[0] if len(down) else 0.0) - down
        high = height.index[height > min(MIN_HEIGHT_M, height.max() / 2.0)]
        if len(high):
            start = float(high[0])
            end = float(high[-1])
    return start, end


def evaluate_aids(flight: Flight) -> dict[str, AidResult] | Unavailable:
    """Evaluate all logged aids of EKF2 in flight.

    Returns
    -------
    mapping from PX4's name to AidResult, in the order of :data:`~px4fuse.ekf2_parameters.AIDS`;
    or Unavailable without EKF2, without innovations, or without a flight.
    """
    if isinstance(flight.ekf2, Unavailable):
        return flight.ekf2
    if not flight.ekf2.aids:
        return Unavailable(
            "EKF2 aids",
            "no estimator_aid_src topic, estimator_innovations or ekf2_innovations in flight",
            "Record a ULog with SDLOG_PROFILE bit 0 (default).",
        )
    span = flight_span(flight)
    if isinstance(span, Unavailable):
        return span
    logs = flight.ekf2.aids
    return {
        name: _evaluate_aid(aid, logs[name], *span) for name, aid in AIDS.items() if name in logs
    }


def _evaluate_aid(aid: Aid, log: AidLog, start_s: float, end_s: float) -> AidResult:
    samples = log.samples.loc[start_s:end_s]
    times = samples.index.to_numpy()
    gate = _effective_gate(aid, log)
    innovation, variance = (
        samples[[f"{quantity}_{axis}" for axis in log.axes]].to_numpy()
        for quantity in ("innovation", "variance")
    )
    enabled = np.ones(len(samples), bool)
    enabled_fraction = None
    if log.enabled is not None:
        enabled = np.asarray(step_values_at(log.enabled, samples.index) > 0.0)
        grid = pd.Index(np.arange(start_s, end_s, 0.1))
        enabled_fraction = (
            float(np.mean(step_values_at(log.enabled, grid) > 0.0)) if len(grid) else 0.0
        )
    fused_logged = "fused" in samples
    fused: BoolArray
    rejected: BoolArray
    if fused_logged:
        fused, rejected = (samples[flag].to_numpy() > 0.0 for flag in ("fused", "rejected"))
        noise = samples[[f"noise_{axis}" for axis in log.axes]].to_numpy()
        # for a sample to which EKF2 resets its state, it logs innovation 0 and S = R
        is_reset = ((innovation == 0.0) & np.isclose(variance, noise)).all(axis=1)
        noise_median = float(np.median(np.sqrt(noise[fused, 0]))) if fused.any() else None
    else:
        rejected = np.max(innovation**2 / variance, axis=1, initial=0.0) > gate**2
        fused = ~rejected
        is_reset = np.zeros(len(samples), bool)
        noise_median = None
    is_evaluated = (fused | rejected) & enabled & ~is_reset
    unfused_span_s = _longest_gap(times, fused & enabled, log, start_s, end_s)
    axes = {}
    for number, axis in enumerate(log.axes):
        assessment = assess(innovation[is_evaluated, number], variance[is_evaluated, number], gate)
        if not isinstance(assessment, Unavailable):
            axes[axis] = AidAxis(
                samples=assessment.count,
                innovation_mean=assessment.innovation_mean_m,
                innovation_std=assessment.innovation_std_m,
                s_sqrt_median=assessment.sqrt_s_median_m,
                nis_mean=assessment.nis_mean,
                nis_band=assessment.nis_band,
                sigma_ratio=assessment.sigma_ratio,
                rejected_fraction=assessment.fraction_outside_gate,
                bias_p=assessment.bias_p,
                lag1_autocorrelation=assessment.lag1_autocorrelation,
                ljung_box_p=assessment.ljung_box_p,
                change=_largest_mean_change(
                    times[is_evaluated],
                    innovation[is_evaluated, number] / np.sqrt(variance[is_evaluated, number]),
                ),
            )
    is_disabled = not is_evaluated.any()
    return AidResult(
        label=aid.label,
        unit=aid.unit,
        topic=log.topics[0],
        enabled_fraction=enabled_fraction,
        fused_fraction=_fraction(fused & enabled, enabled),
        fused_logged=fused_logged,
        rejected_fraction=_fraction(rejected & enabled, enabled),
        longest_gap_s=unfused_span_s,
        resets=int(is_reset.sum()),
        gate=gate,
        noise=noise_median,
        noise_from=_noise_origin(aid, log, noise_median),
        axes=axes,
        verdict="disabled"
        if is_disabled
        else _verdict(
            axes, unfused_span_s[1] - unfused_span_s[0], times[fused & (not fused_logged)]
        ),
    )


def _largest_mean_change(time_s: Array, normalised: Array) -> Span | None:
    """Return time (s) and size (√S) of the largest significant change of mean ν/√S, or None.

    Each window is a candidate: the mean of the two windows after it is compared with the mean of
    all windows before it. The change begins in the candidate window if the mean of that window
    differs from the mean before by at least a third of the change.
    """
    window = np.floor((time_s - time_s[0]) / WINDOW_S)
    window_statistics = (
        pd.Series(normalised)
        .groupby(window)
        .agg(["mean", "size"])
        .query("size >= @MIN_WINDOW_SAMPLES")
    )
    mean = window_statistics["mean"].to_numpy()
    largest_change = None
    for window_index in range(MIN_WINDOWS_BEFORE, len(mean) - 2):
        mean_change = float(
            np.mean(mean[window_index + 1 : window_index + 3]) - np.mean(mean[:window_index])
        )
        earlier = normalised[window < window_statistics.index[window_index]]
        standard_error = float(np.std(earlier)) / math.sqrt(
            2.0 * window_statistics["size"].iloc[:window_index].median()
        )
        scatter = max(float(np.std(mean[:window_index], ddof=1)), standard_error)
        if abs(mean_change) > max(
            MIN_CHANGE_IN_SIGMA,
            MIN_CHANGE_SCATTER_RATIO * scatter,
            abs(largest_change[1]) if largest_change else 0.0,
        ):
            has_begun = (
                abs(mean[window_index] - np.mean(mean[:window_index])) > abs(mean_change) / 3.0
            )
            first_window = window_statistics.index[window_index if has_begun else window_index + 1]
            largest_change = float(time_s[0] + WINDOW_S * first_window), mean_change
    return largest_change


def _fraction(is_selected: BoolArray, is_in_set: BoolArray) -> float:
    return float(is_selected.sum() / max(is_in_set.sum(), 1))


def _effective_gate(aid: Aid, log: AidLog) -> float:
    """Return the gate in √S, from the logged test ratios or else from the parameter."""
    axis = log.axes[0]
    if f"ratio_{axis}" in log.samples:
        rows = log.samples[log.samples[f"ratio_{axis}"] > 0.0]
        nis = rows[f"innovation_{axis}"] ** 2 / rows[f"variance_{axis}"]
        if len(rows) and (nis > 0.0).any():
            return float(np.sqrt(np.median(nis / rows[f"ratio_{axis}"])))
    return max(log.parameters.get(aid.gate, aid.default_gate), 0.01)


def _noise_origin(aid: Aid, log: AidLog, noise: float | None) -> str:
    """Return the name of the parameter from which R is derived, or "reported accuracy"."""
    value = log.parameters.get(aid.noise)
    if noise is None or value is None:
        return "" if noise is None else aid.noise_origin
    # EKF2 multiplies the noise of GNSS heights by 1.5
    for expected in (value, 1.5 * value, np.sqrt(value)):
        if abs(noise - expected) <= NOISE_TOLERANCE * expected:
            return aid.noise
    return aid.noise_origin or aid.noise


def _longest_gap(times: Array, fused: BoolArray, log: AidLog, start_s: float, end_s: float) -> Span:
    """Return start and end (s) of the longest time without a fused sample, see AidResult."""
    ends = np.concatenate([[start_s], times[fused], [end_s]])
    starts = ends[:-1]
    enabled = np.ones(len(starts), bool)
    if log.enabled is not None:
        # EKF2 disables an aid up to 1 s after its last fused sample
        enabled = step_values_at(log.enabled, pd.Index(starts + 1.0)) > 0.0
    longest = int(np.argmax(np.diff(ends) * enabled))
    if not enabled[longest]:
        return start_s, start_s
    return float(ends[longest]), float(ends[longest + 1])


def _verdict(axes: dict[str, AidAxis], longest_gap_duration_s: float, fused_s: Array) -> AidVerdict:
    # topics of old releases are logged at a reduced rate, so the limit is in logged intervals
    interval_s = float(np.median(np.diff(fused_s))) if len(fused_s) > 1 else 0.0
    if longest_gap_duration_s > max(NOT_FUSED_LIMIT_S, NOT_FUSED_INTERVALS * interval_s):
        return "not_fused"
    if not axes:
        return "too few samples"
    if any(_is_biased(axis) for axis in axes.values()):
        return "biased"
    nis = _mean_nis(axes)
    return classify_mean_nis(nis, nis_band(sum(axis.samples for axis in axes.values())))


def _mean_nis(axes: Mapping[str, AidAxis]) -> float:
    return float(np.mean([axis.nis_mean for axis in axes.values()] or [np.nan]))


def _is_biased(axis: AidAxis) -> bool:
    return abs(axis.mean_normalised_innovation) > max(
        MIN_BIAS_IN_SIGMA, MIN_BIAS_SHARE * math.sqrt(axis.nis_mean)
    )
