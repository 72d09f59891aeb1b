"""Comparison of KF, EKF2 and ground truth along each axis."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
from msgspec import structs

from px4fuse.core.arrays import Array
from px4fuse.filter.consistency import HorizontalNis, assess_horizontal_nis
from px4fuse.filter.kalman import KfRun, predict_track, run_kf
from px4fuse.filter.model import STATE_COLUMNS
from px4fuse.filter.signals import AISLE_AXIS, Axis, Segment
from px4fuse.flight.model import (
    RECORD_NOT_LOGGED,
    Ekf2,
    TableOrUnavailable,
    Unavailable,
    compute_sample_rate_hz,
)

from . import projection
from .model import (
    FILTER_NAMES,
    AxisComparison,
    Comparison,
    ErrorsAgainstTruth,
    FilterDifference,
    FilterName,
    FilterSummary,
    FilterTracks,
    PreparedComparison,
    UntestedFilter,
    UpdateStatistics,
)

INNOVATION_COLUMNS = ["innovation_m", "innovation_variance_m2"]


def compare(prepared_comparison: PreparedComparison) -> Comparison:
    """Run KF along each axis, and compare KF with EKF2, and both with ground truth."""
    notes, ekf2 = prepared_comparison.notes, prepared_comparison.flight.ekf2
    if isinstance(ekf2, Ekf2):
        state, note = projection.remove_origin_resets(
            ekf2, prepared_comparison.source, prepared_comparison.segment
        )
        notes = (*notes, *filter(None, (note,)), *ekf2.notes)
        if not state.equals(ekf2.state):
            # Only the published state is without resets. The logged states at the fusion horizon
            # (aids, record) still contain the resets, so they are not used
            ekf2 = replace(ekf2, state=state, aids={}, record=RECORD_NOT_LOGGED)
    axis_names = [axis.name for axis in prepared_comparison.input_axes]
    main_axis_name = AISLE_AXIS if AISLE_AXIS in axis_names else axis_names[0]
    axes = {
        axis.name: _compare_axis(
            prepared_comparison, ekf2, axis, is_main=axis.name == main_axis_name
        )
        for axis in prepared_comparison.input_axes
    }
    north_and_east = [axes[name] for name in ("north", "east") if name in axes]
    horizontal_nis = {
        name: nis
        for name in FILTER_NAMES
        if (nis := _assess_horizontal_innovations(axis.tracks[name] for axis in north_and_east))
    }
    return Comparison(
        **vars(prepared_comparison) | {"notes": notes}, axes=axes, horizontal=horizontal_nis
    )


def _compare_axis(
    prepared_comparison: PreparedComparison, ekf2: Ekf2 | Unavailable, axis: Axis, *, is_main: bool
) -> AxisComparison:
    """Run KF along one axis, and compare KF and EKF2 with each other and with ground truth."""
    segment = prepared_comparison.segment
    # Only the axis of largest motion, which the report shows step by step, needs filterpy
    kf_run = run_kf(axis, prepared_comparison.settings, fast=not is_main)
    ekf2_tracks, truth = project_tracks(prepared_comparison, ekf2, axis, segment)
    whole_flight_tracks = ekf2_tracks, truth
    if segment.flight_span_s not in (None, (segment.start_s, segment.end_s)):
        whole_flight_tracks = project_tracks(prepared_comparison, ekf2, axis, segment.whole_flight)
    tracks: dict[FilterName, FilterTracks] = {"kf": make_run_tracks(kf_run), "ekf2": ekf2_tracks}
    filters = {}
    for name, filter_tracks in tracks.items():
        state, variance = find_compared_track(filter_tracks, ekf2_tracks.state)
        errors = compute_error_statistics(state, variance, truth, filter_tracks.fusion_horizon)
        filters[name] = _summarise_filter(filter_tracks, errors)
    updates = kf_run.updates
    north, east, down = axis.direction.tolist()
    rejected_flags = _drop_missing_values(ekf2_tracks.innovations, "rejected")
    return AxisComparison(
        heading_deg=axis.heading_deg,
        direction=(north, east, down),
        note=axis.note,
        updates=UpdateStatistics(
            count=len(updates),
            first_s=float(updates.index[0]),
            last_s=float(updates.index[-1]),
            rate_hz=compute_sample_rate_hz(updates) if len(updates) > 1 else None,
            input_gap_s=kf_run.input_gap_s,
        ),
        filters=filters,
        difference=compute_difference_statistics(kf_run, ekf2_tracks.state),
        rejected_fraction=float(rejected_flags.mean()) if len(rejected_flags) else None,
        axis=axis,
        kf_run=kf_run,
        tracks=tracks,
        truth=truth,
        whole_flight_tracks=whole_flight_tracks,
    )


def make_run_tracks(run: KfRun) -> FilterTracks:
    """Return the tracks of KF, or of another filter that px4fuse runs."""
    innovations = run.updates.assign(
        prior_variance_m2=run.updates["prior_position_variance_m2"],
        posterior_variance_m2=run.steps["position_variance_m2"].reindex(run.updates.index),
    )
    return FilterTracks(run.steps, run.steps, innovations, run)


def project_tracks(
    prepared_comparison: PreparedComparison, ekf2: Ekf2 | Unavailable, axis: Axis, segment: Segment
) -> tuple[FilterTracks, TableOrUnavailable]:
    """Project state, variance and innovations of EKF2, and ground truth, onto an axis.

    State, variance and ground truth are from ``segment``. The innovations are always from the
    analysed segment.
    """
    ekf2_tracks = (
        FilterTracks(ekf2, ekf2, ekf2)
        if isinstance(ekf2, Unavailable)
        else FilterTracks(
            projection.project(ekf2.state, axis, segment),
            projection.project_variance(ekf2, axis, segment),
            projection.project_innovations(
                prepared_comparison.flight,
                ekf2,
                prepared_comparison.source,
                axis,
                prepared_comparison.segment,
            ),
            gate=ekf2.gate,
            fusion_horizon=projection.project_fusion_horizon_position(ekf2, axis, segment),
        )
    )
    return ekf2_tracks, projection.project_truth(prepared_comparison.flight.truth, axis, segment)


def _summarise_filter(
    tracks: FilterTracks, truth: ErrorsAgainstTruth | Unavailable
) -> FilterSummary | UntestedFilter:
    """Return the consistency of a filter, its reported σ, and its errors against ground truth."""
    innovations, variance = tracks.innovations, tracks.variance
    # Fields that FilterSummary and UntestedFilter have in common
    common_fields: dict[str, Any] = {"truth": truth}
    for name, table, column in (
        ("sigma_p_median_m", variance, "position_variance_m2"),
        ("sigma_v_median_m_s", variance, "velocity_variance_m2_s2"),
        ("sigma_p_before_update_m", innovations, "prior_variance_m2"),
        ("sigma_p_after_update_m", innovations, "posterior_variance_m2"),
    ):
        variances = _drop_missing_values(table, column)
        common_fields[name] = float(np.sqrt(variances.median())) if len(variances) else None
    # Unavailable if innovations are not logged or are too few for the test
    summary: FilterSummary | Unavailable
    if isinstance(innovations, Unavailable):
        summary = innovations
    else:
        innovation_m, variance_m2 = innovations[INNOVATION_COLUMNS].to_numpy().T
        summary = FilterSummary.from_innovations(
            innovation_m, variance_m2, tracks.gate, **common_fields
        )
    if isinstance(summary, Unavailable):
        return UntestedFilter(**structs.asdict(summary), **common_fields)
    return summary


def _drop_missing_values(table: TableOrUnavailable, column: str) -> pd.Series:
    return pd.Series(dtype=float) if isinstance(table, Unavailable) else table[column].dropna()


def compute_difference_statistics(
    kf_run: KfRun, ekf2_state: TableOrUnavailable
) -> FilterDifference | Unavailable:
    """Compute the difference KF - EKF2 along one axis at EKF2's sample times."""
    if isinstance(ekf2_state, Unavailable):
        return ekf2_state
    kf_track = predict_track(kf_run, ekf2_state.index.to_numpy())
    kf_minus_ekf2 = (kf_track[STATE_COLUMNS] - ekf2_state[STATE_COLUMNS]).dropna()
    position_m, velocity_m_s = kf_minus_ekf2.to_numpy().T
    if len(position_m) < projection.MIN_COMPARED_SAMPLES:
        return Unavailable(
            "difference KF - EKF2",
            f"KF and EKF2 have only {len(position_m)} common samples",
            "Choose a time span in which EKF2 runs.",
        )
    return FilterDifference(
        count=len(position_m),
        position_rms_m=_compute_rmse(position_m),
        position_mean_m=float(np.mean(position_m)),
        position_maximum_m=float(np.max(np.abs(position_m))),
        velocity_rms_m_s=_compute_rmse(velocity_m_s),
        velocity_mean_m_s=float(np.mean(velocity_m_s)),
        velocity_maximum_m_s=float(np.max(np.abs(velocity_m_s))),
    )


def _compute_rmse(error: Array) -> float:
    return float(np.sqrt(np.nanmean(error**2)))


def find_compared_track(
    tracks: FilterTracks, ekf2_state: TableOrUnavailable
) -> tuple[TableOrUnavailable, TableOrUnavailable]:
    """Return the state and variance of a filter that are compared with ground truth.

    EKF2: logged values. KF: values predicted to EKF2's sample times. If EKF2 is not logged, KF's
    values at the ends of KF's prediction steps. A table of KF contains both state and variance, so
    it is returned twice.
    """
    if tracks.run is None:
        return tracks.state, tracks.variance
    times_s = (tracks.run.steps if isinstance(ekf2_state, Unavailable) else ekf2_state).index
    track = predict_track(tracks.run, times_s.to_numpy())
    return track, track


def compute_error_statistics(
    state: TableOrUnavailable,
    variance: TableOrUnavailable,
    truth: TableOrUnavailable,
    fusion_horizon: pd.DataFrame | None = None,
) -> ErrorsAgainstTruth | Unavailable:
    """Compute the errors of a filter against ground truth along one axis.

    ``fusion_horizon`` is EKF2's position and variance at the fusion horizon.
    """
    if isinstance(state, Unavailable):
        return state
    if isinstance(truth, Unavailable):
        return truth
    position_m, velocity_m_s = (_compute_errors(state, truth, column) for column in STATE_COLUMNS)
    count = int(np.isfinite(position_m).sum())
    if count < projection.MIN_COMPARED_SAMPLES:
        return Unavailable(
            "error against ground truth",
            "filter and ground truth do not overlap in time",
            "Choose a time span with ground truth.",
        )
    mean_position_nees, mean_velocity_nees = (
        _compute_mean_nees(error / interpolate_sigma(state.index.to_numpy(), variance, column))
        for error, column in (
            (position_m, "position_variance_m2"),
            (velocity_m_s, "velocity_variance_m2_s2"),
        )
    )
    nees_at_horizon = None
    if fusion_horizon is not None:
        sigma_m = np.sqrt(fusion_horizon["position_variance_m2"].to_numpy())
        nees_at_horizon = _compute_mean_nees(
            _compute_errors(fusion_horizon, truth, "position_m") / sigma_m
        )
    return ErrorsAgainstTruth(
        count=count,
        position_rmse_m=_compute_rmse(position_m),
        velocity_rmse_m_s=_compute_rmse(velocity_m_s) if np.isfinite(velocity_m_s).any() else None,
        nees_position_mean=mean_position_nees,
        nees_velocity_mean=mean_velocity_nees,
        nees_position_horizon_mean=nees_at_horizon,
    )


def _compute_errors(state: pd.DataFrame, truth: pd.DataFrame, column: str) -> Array:
    true_values = np.interp(state.index, truth.index, truth[column], np.nan, np.nan)
    return np.asarray(state[column].to_numpy() - true_values)


def interpolate_sigma(time_s: Array, variance: TableOrUnavailable, column: str) -> Array:
    """Interpolate the reported σ to ``time_s`` (s). Unknown values are NaN."""
    known_variance = _drop_missing_values(variance, column)
    if known_variance.empty:
        return np.full(len(time_s), np.nan)
    variance_at_times = np.interp(time_s, known_variance.index, known_variance, np.nan, np.nan)
    return np.sqrt(np.where(variance_at_times > 0.0, variance_at_times, np.nan))


def _compute_mean_nees(normalised_errors: Array) -> float | None:
    if not np.isfinite(normalised_errors).any():
        return None
    return float(np.nanmean(normalised_errors**2))


def compute_position_errors(
    axis_result: AxisComparison, filter_name: FilterName
) -> TableOrUnavailable:
    """Return position errors against ground truth, and the reported σ, along an axis.

    The columns are ``error_m`` and ``sigma_m``. The index is the time (s).
    """
    if isinstance(axis_result.truth, Unavailable):
        return axis_result.truth
    state, variance = find_compared_track(
        axis_result.tracks[filter_name], axis_result.ekf2_tracks.state
    )
    if isinstance(state, Unavailable):
        return state
    time_s = state.index.to_numpy()
    errors_m = {
        "error_m": _compute_errors(state, axis_result.truth, "position_m"),
        "sigma_m": interpolate_sigma(time_s, variance, "position_variance_m2"),
    }
    return pd.DataFrame(errors_m, time_s)


def compute_normalised_errors(
    axis_result: AxisComparison, filter_name: FilterName
) -> tuple[Array, Array] | Unavailable:
    """Return times (s) and normalised position errors: error against ground truth ÷ reported σ."""
    errors = compute_position_errors(axis_result, filter_name)
    if isinstance(errors, Unavailable):
        return errors
    if isinstance(variance := axis_result.tracks[filter_name].variance, Unavailable):
        return variance
    normalised_errors = (errors["error_m"] / errors["sigma_m"]).dropna()
    if normalised_errors.empty:
        return Unavailable(
            "error against ground truth",
            "no analysed sample has both a reported σ and ground truth",
            "Choose a time span with reported σ and ground truth.",
        )
    return normalised_errors.index.to_numpy(), normalised_errors.to_numpy()


def _assess_horizontal_innovations(
    north_and_east: Iterable[FilterTracks],
) -> HorizontalNis | None:
    """Test the NIS of north and east together; None if an axis has no innovations."""
    tables = [
        tracks.innovations[INNOVATION_COLUMNS]
        for tracks in north_and_east
        if isinstance(tracks.innovations, pd.DataFrame)
    ]
    if len(tables) < 2:
        return None
    # Use only times with innovations along both axes
    common_rows = pd.concat(tables, axis=1, join="inner").to_numpy()
    # The four columns are innovation and variance along north, then along east
    north_m, north_variance_m2, east_m, east_variance_m2 = common_rows.T
    return assess_horizontal_nis((north_m, north_variance_m2), (east_m, east_variance_m2))
