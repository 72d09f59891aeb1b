"""Our filter against EKF2 and ground truth: every number of the report."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
from msgspec import structs

from px4fuse.arrays import Array
from px4fuse.comparison.model import (
    AgainstTruth,
    AxisComparison,
    Comparison,
    Difference,
    FilterName,
    FilterSummary,
    UnjudgedFilter,
    Updates,
)
from px4fuse.comparison.preparation import prepare
from px4fuse.comparison.projection import (
    MIN_COMMON_SAMPLES,
    continuous_state,
    project_innovations,
    project_state,
    project_truth,
    project_variance,
)
from px4fuse.filter.consistency import GATE_SIGMA, HorizontalNis, assess, assess_horizontal
from px4fuse.filter.kalman import Replay, replay, state_at, variance_at
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import Segment
from px4fuse.flight import Ekf2, Flight, PositionTrack, Unavailable, sample_rate


def compare(
    flight: Flight,
    settings: Settings | None = None,
    *,
    axes: tuple[str, ...] | None = None,
    heading_deg: float | None = None,
    position_source: str | None = None,
    start_s: float | None = None,
    end_s: float | None = None,
) -> Comparison:
    """Replay a flight and compare it with EKF2 and, where there is one, with the truth.

    Parameters
    ----------
    flight : Flight
    settings : Settings, optional
    axes : tuple of str, optional
        From "north", "east", "down", "aisle"; by default all that the source supports.
    heading_deg : float, optional
        Of the aisle.
    position_source : str, optional
        Name of a track of the flight.
    start_s, end_s : float, optional
        Segment, seconds from the first data.

    Raises
    ------
    MissingDataError
        No position source, or no such axis.
    SettingsError
        An empty segment.
    """
    prepared = prepare(
        flight, settings, axes=axes, heading_deg=heading_deg, position_source=position_source,
        start_s=start_s, end_s=end_s,
    )  # fmt: skip
    return compare_prepared(prepared)


def compare_prepared(
    prepared: Comparison, progress: Callable[[str], None] = lambda _: None
) -> Comparison:
    """:func:`compare`, with what it begins with made."""
    flight, track, segment = prepared.flight, prepared.source, prepared.segment
    notes, ekf2 = list(prepared.notes), prepared.flight.ekf2
    if isinstance(ekf2, Ekf2):
        state, statement = continuous_state(ekf2, track, segment)
        notes += [f"EKF2 {statement}"] if statement else []
        notes += ekf2.notes
        ekf2 = replace(ekf2, state=state)
    progress(", ".join(line.name for line in prepared.lines))
    axes = {
        run.axis.name: _compare_axis(flight, ekf2, track, segment, run)
        for run in (replay(line, prepared.settings) for line in prepared.lines)
    }
    both: dict[FilterName, HorizontalNis | None] = {
        "kf": _horizontal({name: axis.replay.updates for name, axis in axes.items()}),
        "ekf2": _horizontal({name: axis.ekf2_innovations for name, axis in axes.items()}),
    }
    horizontal = {name: nis for name, nis in both.items() if nis is not None}
    return replace(prepared, notes=tuple(notes), axes=axes, horizontal=horizontal)


def _compare_axis(
    flight: Flight,
    ekf2: Ekf2 | Unavailable,
    track: PositionTrack,
    segment: Segment,
    run: Replay,
) -> AxisComparison:
    """Everything about one axis; ``ekf2`` is the flight's, its resets treated."""
    axis, updates = run.axis, run.updates
    truth = project_truth(flight.truth, axis, segment)
    state: pd.DataFrame | Unavailable
    variance: pd.DataFrame | Unavailable
    innovations: pd.DataFrame | Unavailable
    difference: Difference | Unavailable
    if isinstance(ekf2, Unavailable):
        state = variance = innovations = difference = ekf2
        times, gate = run.steps.index.to_numpy(), GATE_SIGMA
    else:
        state = project_state(ekf2.state, axis, segment)
        variance = project_variance(ekf2, axis, segment)
        innovations = project_innovations(flight, ekf2, track, axis, segment)
        difference = _difference(run, state)
        times, gate = state.index.to_numpy(), ekf2.gate
    north, east, down = axis.direction.tolist()
    return AxisComparison(
        heading_deg=axis.heading_deg,
        direction=(north, east, down),
        note=axis.note,
        updates=Updates(
            count=len(updates),
            first_s=float(updates.index[0]),
            last_s=float(updates.index[-1]),
            rate_hz=sample_rate(updates) if len(updates) > 1 else None,
            input_gap_s=run.input_gap_s,
        ),
        filters={
            "kf": _summary(
                updates,
                run.steps,
                updates["prior_position_variance_m2"],
                run.steps["position_variance_m2"].reindex(updates.index),
                kf_against_truth(run, truth, times),
            ),
            "ekf2": _of_ekf2(
                variance, innovations, _ekf2_against_truth(state, variance, truth), gate
            ),
        },
        difference=difference,
        rejected_share=_rejected_share(innovations),
        axis=axis,
        replay=run,
        ekf2_state=state,
        ekf2_variance=variance,
        ekf2_innovations=innovations,
        truth=truth,
    )


def _of_ekf2(
    variance: pd.DataFrame | Unavailable,
    innovations: pd.DataFrame | Unavailable,
    truth: AgainstTruth | Unavailable,
    gate: float,
) -> FilterSummary | UnjudgedFilter:
    before = after = None
    if isinstance(innovations, pd.DataFrame):
        before, after = innovations["prior_variance_m2"], innovations["posterior_variance_m2"]
    return _summary(innovations, variance, before, after, truth, gate)


def _summary(
    innovations: pd.DataFrame | Unavailable,
    variance: pd.DataFrame | Unavailable,
    before: pd.Series | None,
    after: pd.Series | None,
    truth: AgainstTruth | Unavailable,
    gate: float = GATE_SIGMA,
) -> FilterSummary | UnjudgedFilter:
    """What a filter did, from its innovations, its variances, and those around each update."""
    position = velocity = None
    if isinstance(variance, pd.DataFrame):
        position, velocity = variance["position_variance_m2"], variance["velocity_variance_m2_s2"]
    more: dict[str, Any] = {
        "sigma_p_median_m": _median_sigma(position),
        "sigma_v_median_m_s": _median_sigma(velocity),
        "sigma_p_before_update_m": _median_sigma(before),
        "sigma_p_after_update_m": _median_sigma(after),
        "truth": truth,
    }
    if isinstance(innovations, Unavailable):
        return UnjudgedFilter(**structs.asdict(innovations), **more)
    nu, s = innovations["innovation_m"], innovations["innovation_variance_m2"]
    statement = assess(nu.to_numpy(), s.to_numpy(), gate)
    if isinstance(statement, Unavailable):
        return UnjudgedFilter(**structs.asdict(statement), **more)
    return FilterSummary(**structs.asdict(statement), **more)


def _rejected_share(innovations: pd.DataFrame | Unavailable) -> float | None:
    if isinstance(innovations, Unavailable):
        return None
    known = innovations["rejected"].dropna()
    return float(known.mean()) if len(known) else None


def _median_sigma(variance: pd.Series | None) -> float | None:
    if variance is None or (known := variance.dropna()).empty:
        return None
    return float(np.sqrt(known.median()))


def _difference(run: Replay, ekf2_state: pd.DataFrame) -> Difference | Unavailable:
    position, velocity = state_at(run, ekf2_state.index.to_numpy())
    dp = position - ekf2_state["position_m"].to_numpy()
    dv = velocity - ekf2_state["velocity_m_s"].to_numpy()
    common = np.isfinite(dp) & np.isfinite(dv)
    dp, dv = dp[common], dv[common]
    if len(dp) < MIN_COMMON_SAMPLES:
        return Unavailable(
            "difference to EKF2",
            f"{len(dp)} common samples in the segment",
            "Choose a segment in which EKF2 runs.",
        )
    return Difference(
        count=len(dp),
        position_rmse_m=_rmse(dp),
        position_mean_m=float(np.mean(dp)),
        position_maximum_m=float(np.max(np.abs(dp))),
        velocity_rmse_m_s=_rmse(dv),
        velocity_mean_m_s=float(np.mean(dv)),
        velocity_maximum_m_s=float(np.max(np.abs(dv))),
    )


def _rmse(error: Array) -> float:
    return float(np.sqrt(np.mean(error**2)))


def kf_against_truth(
    run: Replay, truth: pd.DataFrame | Unavailable, times: Array
) -> AgainstTruth | Unavailable:
    """Our filter against the truth along one axis, at some times."""
    if isinstance(truth, Unavailable):
        return truth
    return _against_truth(times, state_at(run, times), times, variance_at(run, times), truth)


def _ekf2_against_truth(
    state: pd.DataFrame | Unavailable,
    variance: pd.DataFrame | Unavailable,
    truth: pd.DataFrame | Unavailable,
) -> AgainstTruth | Unavailable:
    if isinstance(state, Unavailable):
        return state
    if isinstance(truth, Unavailable):
        return truth
    columns = state["position_m"].to_numpy(), state["velocity_m_s"].to_numpy()
    times = state.index.to_numpy()
    if isinstance(variance, Unavailable):
        return _against_truth(times, columns, None, None, truth)
    # EKF2's variances are logged at a tenth of the state's rate: NEES at their own times
    return _against_truth(
        times,
        columns,
        variance.index.to_numpy(),
        (
            variance["position_variance_m2"].to_numpy(),
            variance["velocity_variance_m2_s2"].to_numpy(),
        ),
        truth,
    )


def _against_truth(
    times: Array,
    state: tuple[Array, Array],
    variance_times: Array | None,
    variances: tuple[Array, Array] | None,
    truth: pd.DataFrame,
) -> AgainstTruth | Unavailable:
    errors = [
        values - np.interp(times, truth.index, truth[column], left=np.nan, right=np.nan)
        for values, column in zip(state, ("position_m", "velocity_m_s"), strict=True)
    ]
    finite = np.isfinite(errors[0])
    if np.count_nonzero(finite) < MIN_COMMON_SAMPLES:
        return Unavailable(
            "difference to truth", "no common samples", "Choose a segment that the truth covers."
        )
    nees: list[float | None] = [None, None]
    if variances is not None and variance_times is not None:
        for i, (error, variance) in enumerate(zip(errors, variances, strict=True)):
            known = np.isfinite(error)
            if not np.any(known):
                continue
            at = np.interp(variance_times, times[known], error[known], left=np.nan, right=np.nan)
            normalised = at**2 / variance
            if np.any(np.isfinite(normalised)):
                nees[i] = float(np.nanmean(normalised))
    velocity_known = np.isfinite(errors[1])
    return AgainstTruth(
        count=int(np.count_nonzero(finite)),
        position_rmse_m=_rmse(errors[0][finite]),
        velocity_rmse_m_s=_rmse(errors[1][velocity_known]) if np.any(velocity_known) else None,
        nees_position_mean=nees[0],
        nees_velocity_mean=nees[1],
    )


def _horizontal(frames: Mapping[str, pd.DataFrame | Unavailable]) -> HorizontalNis | None:
    columns = ["innovation_m", "innovation_variance_m2"]
    pair = [frame[columns] for name in ("north", "east")
            if isinstance(frame := frames.get(name), pd.DataFrame)]  # fmt: skip
    if len(pair) < 2:
        return None
    # only updates that both axes have, at the very same times
    both = pd.concat(pair, axis=1, join="inner").to_numpy().T
    return assess_horizontal((both[0], both[1]), (both[2], both[3]))
