"""Every aid of EKF2 judged by its own innovations: was it fused, and does S say how large they are.

Definitions as in :mod:`px4fuse.filter.consistency`; what PX4 logs and where it misleads: PX4's
``EKF/aid_sources`` and ``EKF/ekf_helper.cpp``, v1.13 to main.
"""

import math
from collections.abc import Mapping
from typing import Literal

import numpy as np
import pandas as pd

from px4fuse.arrays import Array, BoolArray
from px4fuse.ekf2_parameters import AIDS, Aid
from px4fuse.filter.consistency import SIGMA_FACTOR_FINDING, assess, classify_mean_nis, nis_band
from px4fuse.flight import AidLog, Ekf2, Flight, Unavailable, step_values_at
from px4fuse.record import (
    Correlation,
    Count,
    NotNegative,
    Positive,
    Record,
    Share,
    Span,
    missing_data,
)

AidVerdict = Literal[
    "consistent",
    "variance overstated",
    "variance understated",
    "biased",
    "starved",
    "idle",
    "too few samples",
]
# An aid pulls EKF2 to one side where the mean is half of what the innovations are, root mean
# square, and a fifth of √S: then averaging does not take it away, and EKF2 follows
MIN_BIAS_SHARE, MIN_BIAS_IN_SIGMA = 0.5, 0.2
# A change in flight: in windows of so many seconds the mean moves by half of √S, and by six times
# what those before scatter
WINDOW_S, IN_WINDOW, WINDOWS_BEFORE, MIN_CHANGE_IN_SIGMA, MIN_CHANGE_SCATTER_RATIO = (
    10.0,
    5,
    2,
    0.5,
    6.0,
)
# Longest time (s) without a sample fused while EKF2 means to fuse it. EKF2 itself resets to an aid
# after 7 s (reset_timeout_max); rates of 2 Hz are the slowest of the default profile
NOT_FUSED_LIMIT_S = 5.0
NOT_FUSED_INTERVALS = 10.0  # of its samples that were logged
# Within this of a parameter, R is formed by it
NOISE_TOLERANCE = 0.02
# Height (m) from which a flight is judged, of low ones half of the highest: below, the rotors' wash
# moves the barometer, and motors that run on the ground count as flight for the land detector
MIN_HEIGHT_M = 2.0


class AidAxis(Record, frozen=True, kw_only=True):
    """Innovations of one aid along one axis, in the aid's unit.

    Attributes
    ----------
    samples : int
        Innovations judged: fused, or rejected while meant to be fused.
    innovation_mean, innovation_std : float
    s_sqrt_median : float
        Median of √S.
    nis_mean, nis_band, sigma_factor
        As :class:`~px4fuse.filter.consistency.NisVerdict` has them.
    rejected_share : float
        Outside the gate along this axis.
    lag1_autocorrelation, ljung_box_p, bias_p : float
        As :class:`~px4fuse.filter.consistency.Consistency` has them.
    change : (float, float) or None
        When (s), and by how many √S, its mean moved farthest in flight, where it clearly did.
    """

    samples: Count
    innovation_mean: float
    innovation_std: NotNegative
    s_sqrt_median: Positive
    nis_mean: Positive
    nis_band: tuple[NotNegative, NotNegative]
    sigma_factor: Positive
    rejected_share: Share
    lag1_autocorrelation: Correlation
    ljung_box_p: Share
    bias_p: Share
    change: Span | None = None

    @property
    def mean_normalised_innovation(self) -> float:
        """Mean innovation over √S: how far the aid pulls EKF2, and to which side."""
        return self.innovation_mean / self.s_sqrt_median


class AidResult(Record, frozen=True, kw_only=True):
    """What EKF2 did with one aid in flight, and whether its variance was right.

    Attributes
    ----------
    label, unit, topic : str
    intended_share : float or None
        Of the flight, meant to be fused; None where the log does not tell.
    fused_share : float
        Of the samples while it was meant.
    fused_logged : bool
        Whether the log tells of each sample if it was fused; else the gate was applied here.
    rejected_share : float
        Of the samples while it was meant, by any axis.
    longest_without_s : (float, float)
        From when to when was the longest time without a fused sample that began while it was
        meant to be fused.
    resets : int
        Times that EKF2 took the aid's value as its own; these rows are not judged.
    gate : float
        In standard deviations.
    noise : float or None
        Median of √R, where R is logged.
    noise_from : str
        What set it: a parameter's name, or what is reported; empty where R is not logged.
    verdict : str
    axes : mapping from axis to AidAxis
        Empty where there are too few samples.
    """

    label: str
    unit: str
    topic: str
    intended_share: Share | None = None
    fused_share: Share
    fused_logged: bool
    rejected_share: Share
    longest_without_s: Span
    resets: Count
    gate: Positive
    noise: Positive | None = None
    noise_from: str
    verdict: AidVerdict
    axes: dict[str, AidAxis]

    @property
    def longest_without(self) -> float:
        """How long (s) the longest time without a fused sample was."""
        return self.longest_without_s[1] - self.longest_without_s[0]

    @property
    def is_bad(self) -> bool:
        """Whether EKF2 went without it, is misled by it or trusts it too much.

        One that is overstated is no fault: stock settings are.
        """
        return self.verdict in ("starved", "biased", "variance understated")

    @property
    def nis_mean(self) -> float:
        """Mean NIS of all axes (NaN without any)."""
        return _mean_nis(self.axes)


def flight_span(flight: Flight) -> tuple[float, float] | Unavailable:
    """When the vehicle flew (s), away from the ground where its height is known."""
    if isinstance(flight.airborne, Unavailable):
        return 0.0, flight.log.duration_s
    if not flight.airborne:
        return Unavailable("aids of EKF2", "the vehicle never took off", "Record a flight.")
    start, end = flight.airborne[0][0], flight.airborne[-1][1]
    if isinstance(flight.ekf2, Ekf2):
        down = flight.ekf2.state["down_m"].loc[start:end]
        height = (down.iloc[0] if len(down) else 0.0) - down
        high = height.index[height > min(MIN_HEIGHT_M, height.max() / 2.0)]
        if len(high):
            start, end = float(high[0]), float(high[-1])
    return start, end


def evaluate_aids(flight: Flight) -> dict[str, AidResult] | Unavailable:
    """Judge everything that EKF2 could fuse, in flight.

    Returns
    -------
    mapping from PX4's name to AidResult, in the order of :data:`~px4fuse.ekf2_parameters.AIDS`; or
    Unavailable without EKF2, without innovations, or without a flight.
    """
    if isinstance(flight.ekf2, Unavailable):
        return flight.ekf2
    if not flight.ekf2.aids:
        return missing_data("aids_not_logged")
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
    gate = _gate_in_force(aid, log)
    innovation, variance = (
        samples[[f"{what}_{axis}" for axis in log.axes]].to_numpy()
        for what in ("innovation", "variance")
    )
    enabled = np.ones(len(samples), bool)
    intended_share = None
    if log.enabled is not None:
        enabled = np.asarray(step_values_at(log.enabled, samples.index) > 0.0)
        grid = pd.Index(np.arange(start_s, end_s, 0.1))
        intended_share = (
            float(np.mean(step_values_at(log.enabled, grid) > 0.0)) if len(grid) else 0.0
        )
    fused_logged = "fused" in samples
    fused: BoolArray
    rejected: BoolArray
    if fused_logged:
        fused, rejected = (samples[flag].to_numpy() > 0.0 for flag in ("fused", "rejected"))
        noise = samples[[f"noise_{axis}" for axis in log.axes]].to_numpy()
        # after a reset to the aid the row says innovation 0 and S = R
        reset = ((innovation == 0.0) & np.isclose(variance, noise)).all(axis=1)
        noise_median = float(np.median(np.sqrt(noise[fused, 0]))) if fused.any() else None
    else:
        rejected = np.max(innovation**2 / variance, axis=1, initial=0.0) > gate**2
        fused, reset, noise_median = ~rejected, np.zeros(len(samples), bool), None
    is_evaluated = (fused | rejected) & enabled & ~reset
    without_s = _longest_gap(times, fused & enabled, log, start_s, end_s)
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
                sigma_factor=assessment.sigma_factor,
                rejected_share=assessment.outside_gate,
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
        intended_share=intended_share,
        fused_share=_fraction(fused & enabled, enabled),
        fused_logged=fused_logged,
        rejected_share=_fraction(rejected & enabled, enabled),
        longest_without_s=without_s,
        resets=int(reset.sum()),
        gate=gate,
        noise=noise_median,
        noise_from=_noise_origin(aid, log, noise_median),
        axes=axes,
        verdict="idle"
        if is_disabled
        else _verdict(axes, without_s[1] - without_s[0], times[fused & (not fused_logged)]),
    )


def _largest_mean_change(time_s: Array, normalised: Array) -> Span | None:
    """From which window on the mean of ν/√S is farthest from all before, in the two after; how far.

    The window in between counts where it has moved by a third of that.
    """
    window = np.floor((time_s - time_s[0]) / WINDOW_S)
    window_statistics = (
        pd.Series(normalised).groupby(window).agg(["mean", "size"]).query("size >= @IN_WINDOW")
    )
    mean, worst = window_statistics["mean"].to_numpy(), None
    for window_index in range(WINDOWS_BEFORE, len(mean) - 2):
        mean_change = float(
            np.mean(mean[window_index + 1 : window_index + 3]) - np.mean(mean[:window_index])
        )
        earlier = normalised[window < window_statistics.index[window_index]]
        chance = float(np.std(earlier)) / math.sqrt(
            2.0 * window_statistics["size"].iloc[:window_index].median()
        )
        scatter = max(float(np.std(mean[:window_index], ddof=1)), chance)
        if abs(mean_change) > max(
            MIN_CHANGE_IN_SIGMA, MIN_CHANGE_SCATTER_RATIO * scatter, abs(worst[1]) if worst else 0.0
        ):
            has_begun = (
                abs(mean[window_index] - np.mean(mean[:window_index])) > abs(mean_change) / 3.0
            )
            first = window_statistics.index[window_index if has_begun else window_index + 1]
            worst = float(time_s[0] + WINDOW_S * first), mean_change
    return worst


def _fraction(selected: BoolArray, whole_set: BoolArray) -> float:
    return float(selected.sum() / max(whole_set.sum(), 1))


def _gate_in_force(aid: Aid, log: AidLog) -> float:
    """The gate in force: as the log's test ratios have it, or else by its parameter."""
    axis = log.axes[0]
    if f"ratio_{axis}" in log.samples:
        evaluated = log.samples[log.samples[f"ratio_{axis}"] > 0.0]
        nis = evaluated[f"innovation_{axis}"] ** 2 / evaluated[f"variance_{axis}"]
        if len(evaluated) and (nis > 0.0).any():
            return float(np.sqrt(np.median(nis / evaluated[f"ratio_{axis}"])))
    return max(log.parameters.get(aid.gate, aid.default_gate), 0.01)


def _noise_origin(aid: Aid, log: AidLog, noise: float | None) -> str:
    """What set R: the parameter where they are alike (or R is its root), else what is reported."""
    value = log.parameters.get(aid.noise)
    if noise is None or value is None:
        return "" if noise is None else aid.reported
    for expected in (value, 1.5 * value, np.sqrt(value)):  # the factor of GNSS heights
        if abs(noise - expected) <= NOISE_TOLERANCE * expected:
            return aid.noise
    return aid.reported or aid.noise


def _longest_gap(times: Array, fused: BoolArray, log: AidLog, start_s: float, end_s: float) -> Span:
    """Longest time without a fused sample, of those that begin while it was meant to be fused."""
    ends = np.concatenate([[start_s], times[fused], [end_s]])
    starts = ends[:-1]
    enabled = np.ones(len(starts), bool)
    if log.enabled is not None:
        # an aid that is given up when its last sample was fused is no longer meant a second later
        enabled = step_values_at(log.enabled, pd.Index(starts + 1.0)) > 0.0
    longest = int(np.argmax(np.diff(ends) * enabled))
    if not enabled[longest]:
        return start_s, start_s
    return float(ends[longest]), float(ends[longest + 1])


def _verdict(axes: dict[str, AidAxis], longest_without: float, fused_s: Array) -> AidVerdict:
    # rows that EKF2's aids share are thinned, and zero where they fell between two samples
    interval_s = float(np.median(np.diff(fused_s))) if len(fused_s) > 1 else 0.0
    if longest_without > max(NOT_FUSED_LIMIT_S, NOT_FUSED_INTERVALS * interval_s):
        return "starved"
    if not axes:
        return "too few samples"
    if any(_is_biased(axis) for axis in axes.values()):
        return "biased"
    nis = _mean_nis(axes)
    nis_verdict = classify_mean_nis(nis, nis_band(sum(axis.samples for axis in axes.values())))
    return nis_verdict if max(nis, 1.0 / nis) > SIGMA_FACTOR_FINDING**2 else "consistent"


def _mean_nis(axes: Mapping[str, AidAxis]) -> float:
    return float(np.mean([axis.nis_mean for axis in axes.values()] or [np.nan]))


def _is_biased(axis: AidAxis) -> bool:
    return abs(axis.mean_normalised_innovation) > max(
        MIN_BIAS_IN_SIGMA, MIN_BIAS_SHARE * math.sqrt(axis.nis_mean)
    )
