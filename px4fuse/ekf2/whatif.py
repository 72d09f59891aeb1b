"""Statistics of EKF2 as logged, as replayed, and as replayed with other parameters."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from msgspec.structs import replace
from numpy.typing import ArrayLike

from px4fuse.core.arrays import Array
from px4fuse.core.record import Count, NonNegativeFloat, Record, Share, one_line_repr
from px4fuse.errors import SettingsError
from px4fuse.filter.consistency import compute_nis_band
from px4fuse.filter.frame_rotation import heading_rad
from px4fuse.flight.ekf2_parameters import EV_POS, GNSS_POS, GNSS_VEL, MAG, check_parameters
from px4fuse.flight.model import Columns, Ekf2, Flight, NedAxis, Spans, Unavailable

from .height_samples import HEIGHT_SENSORS
from .inputs import find_horizontal_reset_times_s
from .model import (
    Ekf2Model,
    add_position_noise,
    list_modelled_aids,
    replay_with_settings,
)
from .replay import (
    HORIZONTAL_AXES,
    Ekf2Replay,
    ReplayAgreement,
    compute_rmse_to_truth,
    interpolate_component,
    is_inside_spans,
    list_innovation_axes,
    logged_innovations,
    rows_inside,
    select_logged_aid_innovations,
)

ANALYSIS_NAME = "EKF2 replay with other parameters"
# Minimum fraction of EKF2's innovations in the log to compute the longest time without fusion
MIN_LOGGED_INNOVATION_FRACTION = 0.9
NO_TRUTH = Unavailable(
    "RMSE against ground truth",
    "the log has no ground truth",
    "Record motion capture (ATT_POS_MOCAP) besides the position source, or fly in simulation.",
)
HEADING_LOGGED_NOTE = (
    "All replays use the logged EKF2 heading, because the log does not contain all fused "
    "magnetometer samples"
)
HEIGHT_LOGGED_NOTE = "All replays use the logged EKF2 height"
HEADING_NOT_REPLAYED = Unavailable(
    "heading error",
    "in a flight with external vision, the replay uses the logged EKF2 heading",
    "Compute the heading error from the logged heading (vehicle_attitude).",
)
HEIGHT_NOT_REPLAYED = Unavailable(
    "height error",
    "the replay uses the logged EKF2 height",
    "Compute the height error from the logged height (vehicle_local_position).",
)
HEIGHT_AID_NAMES = {aid.name for aid in HEIGHT_SENSORS}
# Minimum evaluated flight time (s) after an aiding source is disabled
MIN_EVALUATED_DURATION_S = 5.0
# Default and maximum number of parameter values in a sweep
SWEEP_VALUE_COUNT = 9
MAX_SWEEP_VALUES = 200
# Noise (m, 1 σ) added to the positions in repeated replays. If this small noise changes the
# statistics, the replay is not predictable
ADDED_POSITION_SIGMA_M = 0.002
# Number of repeated replays with added position noise
REPLAYS_WITH_ADDED_NOISE = 4
# A replay with a larger rejected fraction is repeated with added position noise
MIN_REJECTED_SAMPLE_FRACTION = 0.02
# Above this rejected fraction, the statistics of a replay are not predictable: they depend on the
# rejection of single samples
MAX_REJECTED_SAMPLE_FRACTION = 0.35
# EKF2 resets the height after this time (s) without height fusion (hgt_fusion_timeout_max,
# common.h)
HEIGHT_TIMEOUT_S = 5.0
# Maximum ratio of largest to smallest mean NIS in replays that differ only in the random noise
# added to the positions. Above this ratio, EKF2 is not predictable: very small changes of the
# positions change its statistics
MAX_NIS_RATIO_BETWEEN_REPEATED_REPLAYS = 1.10
# EKF2 is not predictable if the rejected fractions of samples differ by more than this value
# between replays with different added position noise
MAX_REJECTED_FRACTION_RANGE_OF_REPLAYS = 0.03
# EKF2 is not predictable if the ratio of largest to smallest position RMSE exceeds this value in
# replays with different added position noise
MAX_RMSE_RATIO_BETWEEN_REPEATED_REPLAYS = 1.15


class AxisStatistics(Record):
    """EKF2 statistics along one axis, with one set of parameters.

    ``sigma_p_median_m`` is the median reported σ. The mean NIS includes rejected samples.
    """

    nis_mean: NonNegativeFloat
    nis_band: tuple[NonNegativeFloat, NonNegativeFloat]
    innovation_std_m: NonNegativeFloat
    sigma_p_median_m: NonNegativeFloat | Unavailable
    position_rmse_to_truth_m: NonNegativeFloat | Unavailable


class AidStatistics(Record):
    """Innovation statistics of one aiding source."""

    nis_mean: NonNegativeFloat
    nis_band: tuple[NonNegativeFloat, NonNegativeFloat]
    innovation_std_m: NonNegativeFloat
    rejected_fraction: Share
    longest_without_fusion_s: NonNegativeFloat

    @property
    def is_predictable(self) -> bool:
        """True if the model can predict EKF2: few rejections, and no height reset."""
        has_reset = self.longest_without_fusion_s > HEIGHT_TIMEOUT_S
        return not has_reset and self.rejected_fraction <= MAX_REJECTED_SAMPLE_FRACTION


class Ekf2Statistics(Record, kw_only=True, omit_defaults=False):
    """EKF2 statistics with one set of parameters.

    Attributes
    ----------
    changed : mapping
        Changed parameters, by PX4 name.
    without : mapping from PX4's name of an aiding source to float
        Aiding sources that the replay disables, with the time (s) from which they are not fused.
    resets : int
        Number of horizontal position resets.
    heading_error_mean_deg : float or Unavailable
        Mean of heading minus true heading, clockwise from above.
    heights : mapping from PX4's name to AidStatistics
        Statistics of each height sensor.
    others : mapping from PX4's name to AidStatistics
        Statistics of external vision, if it is fused in addition to GNSS.
    late, lost : int
        Number of samples that were fused late, and number of samples too late to be fused.
    is_predictable : bool
        False if very small changes of the measured positions would change the statistics, for
        example because EKF2 would reject other samples.
    """

    changed: Mapping[str, float]
    north: AxisStatistics
    east: AxisStatistics
    samples: Count
    rejected_fraction: Share
    longest_without_fusion_s: NonNegativeFloat | Unavailable
    resets: Count
    heading_error_mean_deg: float | Unavailable = HEADING_NOT_REPLAYED
    heights: Mapping[str, AidStatistics] = {}
    others: Mapping[str, AidStatistics] = {}
    height_rmse_to_truth_m: NonNegativeFloat | Unavailable = HEIGHT_NOT_REPLAYED
    late: Count = 0
    lost: Count = 0
    is_predictable: bool = True
    velocity_rejected_fraction: Share | None = None
    without: Mapping[str, float] = {}

    @property
    def axes(self) -> dict[str, AxisStatistics]:
        return {"north": self.north, "east": self.east}

    @property
    def nis_mean(self) -> float:
        """Mean NIS of EKF2's horizontal position innovations, over north and east."""
        return float(np.mean([axis.nis_mean for axis in self.axes.values()]))

    @property
    def position_rmse_to_truth_m(self) -> float | Unavailable:
        """Horizontal RMSE of the published position against ground truth (m)."""
        north_rmse_m, east_rmse_m = (
            self.north.position_rmse_to_truth_m,
            self.east.position_rmse_to_truth_m,
        )
        if isinstance(north_rmse_m, Unavailable):
            return north_rmse_m
        return (
            east_rmse_m
            if isinstance(east_rmse_m, Unavailable)
            else float(np.hypot(north_rmse_m, east_rmse_m))
        )


@dataclass(frozen=True)
class WhatIf:
    """Statistics of EKF2 as logged, as replayed, and with other parameters.

    Attributes
    ----------
    agreement : ReplayAgreement
        Agreement of the replay with the log.
    whatif : tuple of Ekf2Statistics
        Statistics with each set of changed parameters.
    evaluated_s : tuple of (float, float)
        Start and end of each evaluated time span.
    notes : tuple of str
        Limitations of the replay.
    """

    agreement: ReplayAgreement
    logged: Ekf2Statistics
    replayed: Ekf2Statistics
    whatif: tuple[Ekf2Statistics, ...]
    evaluated_s: Spans
    notes: tuple[str, ...]

    __repr__ = one_line_repr


def what_if(
    model: Ekf2Model,
    settings: Sequence[Mapping[str, float]],
    disable_time_s_by_aid: Mapping[str, float] = {},
) -> WhatIf | Unavailable:
    """Replay EKF2 with other parameters and compare with the log.

    Parameters
    ----------
    model : Ekf2Model
    settings : sequence of mapping
        Changed parameters of each replay, by PX4 name.
    disable_time_s_by_aid : mapping from PX4's name of an aiding source to float, optional
        Time (s) from which the source is not fused; only later times are evaluated.

    Raises
    ------
    SettingsError
        Unknown parameter or aiding source, value outside PX4's range, or no time to evaluate.
    """
    if not model.agreement.good:
        return model.agreement.report_disagreement(ANALYSIS_NAME)
    flight = model.flight
    spans_s = model.baseline_replay.find_evaluated_spans()
    if disable_time_s_by_aid:
        spans_s = _select_first_span_after(min(disable_time_s_by_aid.values()), spans_s)
    summaries: list[Ekf2Statistics] = []
    notes: list[str] = []
    if settings and model.inputs.aid == GNSS_POS:
        if model.agreement.heading_rms_difference_deg is None:
            notes.append(HEADING_LOGGED_NOTE)
        if model.inputs.reason_to_use_logged_height:
            notes.append(HEIGHT_LOGGED_NOTE)
    for replay in replay_with_settings(
        model, settings, disable_time_s_by_aid=disable_time_s_by_aid
    ):
        summaries.append(_summarise_replay(flight, replay, spans_s))
        notes += _describe_replay_limits(model, replay)
        if disable_time_s_by_aid:
            notes.append(_describe_deviation(model, replay, disable_time_s_by_aid, spans_s))
    return WhatIf(
        agreement=model.agreement,
        logged=_summarise_log(flight, model.baseline_replay, spans_s),
        replayed=_summarise_replay(flight, model.baseline_replay, spans_s),
        whatif=_mark_unpredictable_statistics(model, summaries, spans_s, disable_time_s_by_aid),
        evaluated_s=spans_s,
        notes=tuple(notes),
    )


def _select_first_span_after(disable_time_s: float, spans_s: Spans) -> Spans:
    """Return the part of the first evaluated span after an aiding source is disabled.

    Later spans are omitted: their replay starts from a logged state, to which the disabled source
    contributed.
    """
    for start, end in spans_s:
        if end - disable_time_s > MIN_EVALUATED_DURATION_S:
            return ((max(start, disable_time_s), end),)
    raise SettingsError(
        f"--from {disable_time_s:g} s leaves less than {MIN_EVALUATED_DURATION_S:g} s of the "
        f"replayed flight, which ends at {spans_s[-1][1]:.0f} s. Choose an earlier time."
    )


def make_sweep_values(
    name: str, low: float, high: float, count: int = SWEEP_VALUE_COUNT
) -> list[float]:
    """Return values of a parameter from ``low`` to ``high``, both included.

    The values have equal ratios if ``low`` is above zero, else equal differences.

    Raises
    ------
    SettingsError
        Unknown parameter, value outside PX4's range, limits in wrong order, or invalid count.

    Examples
    --------
    >>> make_sweep_values("EKF2_EV_DELAY", 0, 200, 3)
    [0.0, 100.0, 200.0]
    """
    for limit in (low, high):
        check_parameters({name: limit})
    if not low < high:
        raise SettingsError(f"{name}={low:g}:{high:g}: give the smaller parameter value first.")
    if not 2 <= count <= MAX_SWEEP_VALUES:
        raise SettingsError(
            f"{count} is not a valid number of sweep values. Use 2 to {MAX_SWEEP_VALUES}."
        )
    sweep = np.geomspace(low, high, count) if low > 0 else np.linspace(low, high, count)
    return [float(value) for value in sweep]


def _mark_unpredictable_statistics(
    model: Ekf2Model,
    summaries: Sequence[Ekf2Statistics],
    spans_s: Spans,
    disable_time_s_by_aid: Mapping[str, float],
) -> tuple[Ekf2Statistics, ...]:
    """Set ``is_predictable`` of each replay.

    A replay is not predictable if repetitions with added position noise differ.
    """
    uncertain_summaries = [
        summary
        for summary in summaries
        if summary.changed
        and MIN_REJECTED_SAMPLE_FRACTION < summary.rejected_fraction <= MAX_REJECTED_SAMPLE_FRACTION
    ]
    changes = [summary.changed for summary in uncertain_summaries]
    summaries_by_seed = [uncertain_summaries]
    if changes:
        for seed in range(REPLAYS_WITH_ADDED_NOISE):
            replays = replay_with_settings(
                add_position_noise(model, ADDED_POSITION_SIGMA_M, seed),
                changes,
                disable_time_s_by_aid=disable_time_s_by_aid,
            )
            summaries_by_seed.append(
                [_summarise_replay(model.flight, replay, spans_s) for replay in replays]
            )
    sensitive_changes = [
        repeated_summaries[0].changed
        for repeated_summaries in zip(*summaries_by_seed, strict=True)
        if not _results_agree(repeated_summaries)
    ]
    return tuple(
        replace(
            summary,
            is_predictable=_has_few_rejections(summary)
            and summary.changed not in sensitive_changes,
            without=disable_time_s_by_aid,
        )
        for summary in summaries
    )


def _has_few_rejections(summary: Ekf2Statistics) -> bool:
    """Return True if EKF2 rejects so few samples that the model can predict the rejections.

    Rejections of the position source are counted only in replays with changed parameters.
    """
    rejected_fractions = [aid.rejected_fraction for aid in summary.others.values()]
    if summary.changed:
        rejected_fractions.append(summary.rejected_fraction)
    return max(rejected_fractions, default=0.0) <= MAX_REJECTED_SAMPLE_FRACTION and all(
        height.is_predictable for height in summary.heights.values()
    )


def _results_agree(summaries: Sequence[Ekf2Statistics]) -> bool:
    """Return True if mean NIS, rejected fraction and RMSE of repeated replays hardly differ."""
    rejected_fractions = [summary.rejected_fraction for summary in summaries]
    rmses_m = [summary.position_rmse_to_truth_m for summary in summaries]
    return (
        np.ptp(rejected_fractions) <= MAX_REJECTED_FRACTION_RANGE_OF_REPLAYS
        and _is_ratio_below(
            MAX_RMSE_RATIO_BETWEEN_REPEATED_REPLAYS,
            [rmse_m for rmse_m in rmses_m if isinstance(rmse_m, float)],
        )
        and all(
            _is_ratio_below(
                MAX_NIS_RATIO_BETWEEN_REPEATED_REPLAYS,
                [summary.axes[axis].nis_mean for summary in summaries],
            )
            for axis in HORIZONTAL_AXES
        )
    )


def _is_ratio_below(max_ratio: float, values: Sequence[float]) -> bool:
    """Return True if largest ÷ smallest value is at most ``max_ratio``, or without values."""
    return max(values, default=0.0) <= max_ratio * min(values, default=0.0)


def _summarise_replay(flight: Flight, replay: Ekf2Replay, spans_s: Spans) -> Ekf2Statistics:
    """Return statistics of a replay in the evaluated time spans."""
    updates = replay.updates
    evaluated_updates = rows_inside(updates, spans_s)
    update_times_s = updates["fused_at_s"]
    if evaluated_updates.empty:
        raise SettingsError(
            f"{_format_changes(replay)}: the replay fuses no sample of {replay.source} in the "
            f"evaluated time span, because {replay.lost} samples are older than the fusion horizon",
            "Choose another value, or add --set EKF2_DELAY_MAX=... (PX4 v1.15 and later).",
        )
    # Position variance 1 µs before each update, and after the update
    variance = pd.DataFrame(index=np.column_stack([update_times_s - 1e-6, update_times_s]).ravel())
    for axis in HORIZONTAL_AXES:
        prior_variance_m2 = (
            updates[f"innovation_variance_{axis}_m2"] - updates[f"observation_variance_{axis}_m2"]
        )
        variance[f"{axis}_m2"] = np.column_stack(
            [prior_variance_m2, updates[f"position_variance_{axis}_m2"]]
        ).ravel()
    fusion_times_s = evaluated_updates["fused_at_s"][
        evaluated_updates[["fused", "reset"]].any(axis=1)
    ]
    reset_count = evaluated_updates["reset"].sum()
    if (vision := replay.other_aid_updates.get(EV_POS.name)) is not None:
        reset_count += vision["reset"][is_inside_spans(vision["fused_at_s"], spans_s)].sum()
    return _make_summary(
        flight,
        replay,
        spans_s,
        evaluated_updates,
        replay.published_state,
        variance,
        replay.other_aid_updates,
        replay.delayed_state["heading_rad"],
        changed=replay.changed_parameters,
        longest_without_fusion_s=_find_longest_gap_s(fusion_times_s, spans_s),
        resets=int(reset_count),
        late=replay.late,
        lost=replay.lost,
    )


def _summarise_log(flight: Flight, replay: Ekf2Replay, spans_s: Spans) -> Ekf2Statistics:
    """Return statistics of EKF2 in the log, in the evaluated time spans."""
    ekf2 = flight.ekf2
    assert isinstance(ekf2, Ekf2)
    evaluated_updates = rows_inside(logged_innovations(ekf2), spans_s)
    # EKF2 publishes a reset when it happens. The reset sample was measured earlier, by the delay of
    # the fusion horizon
    fusion_horizon_delay_s = 0.0 if isinstance(ekf2.horizon_s, Unavailable) else ekf2.horizon_s
    reset_times_s = find_horizontal_reset_times_s(ekf2) - fusion_horizon_delay_s
    reset_times_s = reset_times_s[is_inside_spans(reset_times_s, spans_s)]
    replayed_update_count = len(rows_inside(replay.updates, spans_s))
    longest_gap_s: float | Unavailable
    if len(evaluated_updates) > MIN_LOGGED_INNOVATION_FRACTION * replayed_update_count:
        fusion_times_s = evaluated_updates.index[evaluated_updates["rejected"] == 0]
        longest_gap_s = _find_longest_gap_s(
            np.concatenate([fusion_times_s, reset_times_s]), spans_s
        )
    else:
        longest_gap_s = Unavailable(
            "longest time without fusion",
            f"the log contains only {len(evaluated_updates)} of about {replayed_update_count} "
            "innovations",
            f"Log {ekf2.innovation_topics[0]} at full rate.",
        )
    # A flight with a replay has an attitude
    assert isinstance(flight.attitude, pd.DataFrame)
    headings_rad = pd.Series(heading_rad(flight.attitude), flight.attitude.index)
    other_aid_updates = {
        name: select_logged_aid_innovations(name, ekf2.aids[name])
        for name in replay.other_aid_updates
        if name in ekf2.aids
    }
    return _make_summary(
        flight,
        replay,
        spans_s,
        evaluated_updates,
        ekf2.state,
        None,  # the reported σ is from the logged position variance
        other_aid_updates,
        headings_rad,
        changed={},
        longest_without_fusion_s=longest_gap_s,
        resets=len(reset_times_s),
    )


def _make_summary(
    flight: Flight,
    replay: Ekf2Replay,
    spans_s: Spans,
    evaluated_updates: pd.DataFrame,
    published_track: pd.DataFrame,
    variance: pd.DataFrame | None,
    other_aid_updates: Mapping[str, pd.DataFrame],
    headings_rad: pd.Series,
    **other_fields: Any,
) -> Ekf2Statistics:
    """Return statistics of EKF2's innovations, reported σ and position errors.

    Parameters
    ----------
    evaluated_updates : DataFrame
        Updates with the position source.
    published_track : DataFrame
        Published state.
    variance : DataFrame or None
        Position variance; None for the logged variance.
    other_aid_updates : mapping from PX4's name to DataFrame
        Updates with the other aiding sources, also outside the evaluated time.
    headings_rad : Series
        Heading of EKF2.
    **other_fields
        Further fields of :class:`Ekf2Statistics`.
    """
    ekf2 = flight.ekf2
    assert isinstance(ekf2, Ekf2)
    evaluated_times_s = rows_inside(ekf2.state, spans_s).index.to_numpy()

    def compute_rmse_m(direction: Array) -> float | Unavailable:
        position_m = interpolate_component(
            published_track, Columns.POSITION, direction, evaluated_times_s
        )
        rmse_to_truth = compute_rmse_to_truth(flight, position_m, direction, evaluated_times_s)
        return NO_TRUTH if rmse_to_truth is None else rmse_to_truth

    def summarise_axis(axis: NedAxis, direction: Array) -> AxisStatistics:
        """Return the statistics of the position source along one axis."""
        median_sigma: float | Unavailable
        if isinstance(ekf2.variance, Unavailable):
            median_sigma = ekf2.variance
        else:
            # At the times of the log, so replay and log have the same number of values
            times_s = rows_inside(ekf2.variance, spans_s).index
            table = ekf2.variance if variance is None else variance
            axis_variance = np.interp(times_s, table.index, table[f"{axis}_m2"])
            median_sigma = float(np.sqrt(np.median(axis_variance)))
        return AxisStatistics(
            *_compute_innovation_statistics(evaluated_updates, axis),
            median_sigma,
            compute_rmse_m(direction),
        )

    north_direction, east_direction, down_direction = np.eye(3)
    aids = {
        name: _summarise_aid(evaluated, spans_s)
        for name, updates in other_aid_updates.items()
        if len(evaluated := rows_inside(updates, spans_s))
    }
    velocity = aids.get(GNSS_VEL.name)
    return Ekf2Statistics(
        north=summarise_axis("north", north_direction),
        east=summarise_axis("east", east_direction),
        samples=len(evaluated_updates),
        rejected_fraction=float(evaluated_updates["rejected"].mean()),
        heading_error_mean_deg=_compute_heading_error_deg(flight, replay, headings_rad, spans_s),
        heights={name: aids[name] for name in aids if name in HEIGHT_AID_NAMES},
        others={name: aids[name] for name in aids if name == EV_POS.name},
        height_rmse_to_truth_m=compute_rmse_m(down_direction)
        if other_aid_updates.keys() & HEIGHT_AID_NAMES
        else HEIGHT_NOT_REPLAYED,
        velocity_rejected_fraction=velocity.rejected_fraction if velocity else None,
        **other_fields,
    )


def _compute_innovation_statistics(
    updates: pd.DataFrame, *axes: NedAxis
) -> tuple[float, tuple[float, float], float]:
    """Return mean NIS, its band, and innovation standard deviation (m) of several axes together."""
    nu = np.concatenate([updates[f"innovation_{axis}_m"] for axis in axes])
    S = np.concatenate([updates[f"innovation_variance_{axis}_m2"] for axis in axes])
    return float(np.mean(nu**2 / S)), compute_nis_band(len(nu)), float(np.std(nu))


def _summarise_aid(evaluated_updates: pd.DataFrame, spans_s: Spans) -> AidStatistics:
    """Return innovation statistics of one aiding source, all axes together."""
    fused_updates = evaluated_updates[evaluated_updates["rejected"] == 0.0]
    longest_gap_s = max(
        _find_longest_gap_s(rows_inside(fused_updates, (span,)).index, (span,)) for span in spans_s
    )
    return AidStatistics(
        *_compute_innovation_statistics(
            evaluated_updates, *list_innovation_axes(evaluated_updates)
        ),
        float(evaluated_updates["rejected"].mean()),
        longest_gap_s,
    )


def _compute_heading_error_deg(
    flight: Flight, replay: Ekf2Replay, headings_rad: pd.Series, spans_s: Spans
) -> float | Unavailable:
    """Return the mean (°) of ``headings_rad`` minus true heading."""
    # Only a replay with GNSS estimates the heading; its settings contain the GNSS noise. A replay
    # with vision alone uses EKF2's logged heading
    if GNSS_POS.noise not in replay.settings:
        return HEADING_NOT_REPLAYED
    true_attitude = None if isinstance(flight.truth, Unavailable) else flight.truth.attitude
    if true_attitude is None:
        return replace(NO_TRUTH, what="heading error", reason="the log has no true attitude")
    headings_rad = rows_inside(headings_rad, spans_s)
    true_headings_rad = np.interp(
        headings_rad.index, true_attitude.index, heading_rad(true_attitude), np.nan, np.nan
    )
    error_rad = np.angle(np.exp(1j * (headings_rad - true_headings_rad)))
    return float(np.degrees(np.nanmean(error_rad)))


def _find_longest_gap_s(fusion_times_s: ArrayLike, spans_s: Spans) -> float:
    """Return the longest time (s) without fusion."""
    span_limits_s = [spans_s[0][0], spans_s[-1][1]]
    return float(np.diff(np.sort(np.append(span_limits_s, fusion_times_s))).max())


def _describe_deviation(
    model: Ekf2Model, replay: Ekf2Replay, disable_time_s_by_aid: Mapping[str, float], spans_s: Spans
) -> str:
    """Describe the position difference between replays with and without aiding sources.

    ``disable_time_s_by_aid`` contains the time (s) from which ``replay`` omits an aiding source.
    """
    position_difference_m = rows_inside(
        replay.published_state[Columns.POSITION]
        - model.baseline_replay.published_state[Columns.POSITION],
        spans_s,
    )
    *horizontal_differences_m, height_difference_m = np.abs(position_difference_m.to_numpy()).T
    horizontal_distance_m = np.hypot(*horizontal_differences_m)
    aids_text = ", ".join(
        f"{aid} from {from_s:g} s on" for aid, from_s in disable_time_s_by_aid.items()
    )
    # All aiding sources except magnetometer and height sensors measure horizontal motion
    enabled_horizontal_aids = {*list_modelled_aids(model.inputs)}.difference(
        disable_time_s_by_aid, HEIGHT_AID_NAMES, [MAG.name]
    )
    largest_distance_time_s = position_difference_m.index[horizontal_distance_m.argmax()]
    note = (
        f"Without {aids_text}, the replayed position differs from the replay with all aiding "
        f"sources by at most {horizontal_distance_m.max():.3g} m (at "
        f"{largest_distance_time_s:.1f} s), and by {horizontal_distance_m[-1]:.3g} m at the end"
    )
    if HEIGHT_AID_NAMES & disable_time_s_by_aid.keys():
        note += f". The heights of both replays differ by at most {height_difference_m.max():.3g} m"
    if not enabled_horizontal_aids:
        note += (
            ". The replay without aiding sources uses only the IMU. EKF2 stops publishing "
            "a position after EKF2_NOAID_TOUT (5 s)"
        )
    return note


def _describe_replay_limits(model: Ekf2Model, replay: Ekf2Replay) -> Iterator[str]:
    """Yield texts for the user about the limits of one replay with changed parameters."""
    # 1. Effects of the changed parameters
    min_noise_m = replay.settings.get(GNSS_POS.noise, 0.0)
    if EV_POS.noise in replay.changed_parameters and (
        replay.changed_parameters[EV_POS.noise] <= min_noise_m
    ):
        yield (
            f"While EKF2 fuses GNSS, the noise of vision positions is at least {GNSS_POS.noise} "
            f"({min_noise_m:g} m)"
        )
    # Before PX4 v1.15, the largest delay parameter sets the fusion horizon, and the parameter
    # EKF2_DELAY_MAX does not exist
    is_horizon_set_by_largest_delay = model.inputs.rules.is_horizon_set_by_largest_delay
    delay_ms = max(replay.changed_parameters.get(aid.delay, 0.0) for aid in (EV_POS, GNSS_POS))
    if not is_horizon_set_by_largest_delay and delay_ms > (
        delay_max_ms := replay.settings["EKF2_DELAY_MAX"]
    ):
        yield (
            f"{_format_changes(replay)}: EKF2 increases EKF2_DELAY_MAX from {delay_max_ms:g} to "
            f"{delay_ms:g} ms at its start. Reboot PX4 after the change"
        )
    # 2. Late samples. Unknown arrival times are infinite
    if delay_ms and np.isinf(model.inputs.received_positions.arrival_s).all():
        yield ("Without logged arrival times, the replay assumes that no position arrives too late")
    if replay.late or replay.lost:
        # If two samples arrive in one prediction step, EKF2 fuses only the newer, so there may be
        # fewer updates than late samples
        received_count = max(len(replay.updates), replay.late) + replay.lost
        note = (
            f"{_format_changes(replay)}: {replay.late + replay.lost} of {received_count} samples "
            "would arrive late, after the fusion horizon. EKF2 would never fuse "
            f"{replay.lost} of them"
        )
        yield note if is_horizon_set_by_largest_delay else f"{note}. Increase EKF2_DELAY_MAX"


def _format_changes(replay: Ekf2Replay) -> str:
    return (
        ", ".join(f"{name}={value:g}" for name, value in replay.changed_parameters.items())
        or "Logged parameters"
    )
