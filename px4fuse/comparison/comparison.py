"""Our filter against EKF2 and ground truth: every number of the report."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from px4fuse.arrays import Array
from px4fuse.comparison.preparation import Prepared, prepare
from px4fuse.comparison.projection import (
    MIN_COMMON_SAMPLES,
    continuous_state,
    project_innovations,
    project_state,
    project_truth,
    project_variance,
)
from px4fuse.display import Shown
from px4fuse.errors import MissingDataError
from px4fuse.filter.consistency import Consistency, HorizontalNis, assess, assess_horizontal
from px4fuse.filter.kalman import Replay, Settings, replay_all, state_at, variance_at
from px4fuse.filter.signals import AISLE, Axis, Segment
from px4fuse.flight import Ekf2, Flight, PositionTrack, Unavailable


@dataclass(frozen=True)
class FilterSummary:
    """What one filter did along one axis.

    Attributes
    ----------
    consistency : Consistency or Unavailable
    sigma_p_median_m, sigma_v_median_m_s : float or None
        Median standard deviations over the segment; None where not logged.
    sigma_p_before_update_m, sigma_p_after_update_m : float or None
        Medians just before and just after an update. For EKF2 from S and R: P⁻ = S - R,
        P⁺ = P⁻R/S.
    """

    consistency: Consistency | Unavailable
    sigma_p_median_m: float | None
    sigma_v_median_m_s: float | None
    sigma_p_before_update_m: float | None
    sigma_p_after_update_m: float | None


@dataclass(frozen=True)
class Difference:
    """Ours minus EKF2, at EKF2's own sample times."""

    count: int
    position_rmse_m: float
    position_mean_m: float
    position_maximum_m: float
    velocity_rmse_m_s: float
    velocity_mean_m_s: float
    velocity_maximum_m_s: float


@dataclass(frozen=True)
class AgainstTruth:
    """One filter against ground truth.

    NEES is per component (1 is consistent); it is strongly autocorrelated within one flight, so
    no band is stated. None where the variance or the true velocity is not logged.
    """

    count: int
    position_rmse_m: float
    velocity_rmse_m_s: float | None
    nees_position_mean: float | None
    nees_velocity_mean: float | None


@dataclass(frozen=True, repr=False)
class AxisComparison(Shown):
    """Everything about one axis.

    Attributes
    ----------
    axis : Axis
    replay : Replay
    kf, ekf2 : FilterSummary (ekf2 may be Unavailable)
    ekf2_state : DataFrame or Unavailable
        ``position_m, velocity_m_s`` in the segment, resets treated as the comparison says.
    ekf2_variance : DataFrame or Unavailable
        ``position_variance_m2, velocity_variance_m2_s2`` in the segment.
    ekf2_innovations : DataFrame or Unavailable
        Columns as :attr:`Ekf2.innovations`, in the segment, plus ``prior_variance_m2`` and
        ``posterior_variance_m2`` (P⁻ = S - R and P⁺ = P⁻R/S, NaN where R is unknown).
    difference : Difference or Unavailable
    kf_truth, ekf2_truth : AgainstTruth or Unavailable
    truth : DataFrame or Unavailable
        ``position_m, velocity_m_s`` in the segment.
    """

    axis: Axis
    replay: Replay
    kf: FilterSummary
    ekf2: FilterSummary | Unavailable
    ekf2_state: pd.DataFrame | Unavailable
    ekf2_variance: pd.DataFrame | Unavailable
    ekf2_innovations: pd.DataFrame | Unavailable
    difference: Difference | Unavailable
    kf_truth: AgainstTruth | Unavailable
    ekf2_truth: AgainstTruth | Unavailable
    truth: pd.DataFrame | Unavailable


@dataclass(frozen=True, repr=False)
class Comparison(Shown, Prepared):
    """The result of ``px4fuse compare``: what it began with, and what the filters did.

    Attributes
    ----------
    flight, source, source_reason, segment, settings, lines, notes, missing
        As :class:`Prepared` has them; notes also of EKF2.
    axes : tuple of AxisComparison
    horizontal_kf, horizontal_ekf2 : HorizontalNis or None
        North and east together, None unless both were analysed.
    """

    axes: tuple[AxisComparison, ...]
    horizontal_kf: HorizontalNis | None
    horizontal_ekf2: HorizontalNis | None

    def __getitem__(self, axis: str) -> AxisComparison:
        """Everything about one axis, by its name.

        Raises
        ------
        MissingDataError
            It was not analysed.
        """
        names = {result.axis.name: result for result in self.axes}
        if axis not in names:
            raise MissingDataError(f"no axis {axis!r} here: {', '.join(names)}.")
        return names[axis]

    @property
    def main(self) -> AxisComparison:
        """The axis of the lab: the aisle, else the first."""
        return next((axis for axis in self.axes if axis.axis.name == AISLE), self.axes[0])


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
    prepared: Prepared, progress: Callable[[str], None] = lambda _: None
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
    results = [
        _compare_axis(flight, ekf2, track, segment, run)
        for run in replay_all(prepared.lines, prepared.settings)
    ]
    return Comparison(
        flight=flight,
        source=track,
        source_reason=prepared.source_reason,
        segment=segment,
        settings=prepared.settings,
        lines=prepared.lines,
        notes=tuple(notes),
        missing=prepared.missing,
        axes=tuple(results),
        horizontal_kf=_horizontal(results, lambda axis: axis.replay.updates),
        horizontal_ekf2=_horizontal(results, lambda axis: axis.ekf2_innovations),
    )


def _compare_axis(
    flight: Flight,
    ekf2: Ekf2 | Unavailable,
    track: PositionTrack,
    segment: Segment,
    run: Replay,
) -> AxisComparison:
    """Everything about one axis; ``ekf2`` is the flight's, its resets treated."""
    axis = run.axis
    truth = project_truth(flight.truth, axis, segment)
    kf = FilterSummary(
        consistency=assess(
            run.updates["innovation_m"].to_numpy(),
            run.updates["innovation_variance_m2"].to_numpy(),
        ),
        sigma_p_median_m=_median_sigma(run.steps["position_variance_m2"]),
        sigma_v_median_m_s=_median_sigma(run.steps["velocity_variance_m2_s2"]),
        sigma_p_before_update_m=_median_sigma(run.updates["prior_position_variance_m2"]),
        sigma_p_after_update_m=_median_sigma(
            run.steps["position_variance_m2"].reindex(run.updates.index)
        ),
    )
    if isinstance(ekf2, Unavailable):
        times = run.steps.index.to_numpy()
        return AxisComparison(
            axis=axis, replay=run, kf=kf, ekf2=ekf2, ekf2_state=ekf2, ekf2_variance=ekf2,
            ekf2_innovations=ekf2, difference=ekf2,
            kf_truth=kf_against_truth(run, truth, times), ekf2_truth=ekf2, truth=truth,
        )  # fmt: skip
    ekf2_state = project_state(ekf2.state, axis, segment)
    ekf2_variance = project_variance(ekf2, axis, segment)
    ekf2_innovations = project_innovations(flight, ekf2, track, axis, segment)
    times = ekf2_state.index.to_numpy()
    return AxisComparison(
        axis=axis,
        replay=run,
        kf=kf,
        ekf2=_ekf2_summary(ekf2, ekf2_variance, ekf2_innovations),
        ekf2_state=ekf2_state,
        ekf2_variance=ekf2_variance,
        ekf2_innovations=ekf2_innovations,
        difference=_difference(run, ekf2_state),
        kf_truth=kf_against_truth(run, truth, times),
        ekf2_truth=_ekf2_against_truth(ekf2_state, ekf2_variance, truth),
        truth=truth,
    )


def _median_sigma(variance: pd.Series) -> float | None:
    variance = variance.dropna()
    return float(np.sqrt(variance.median())) if len(variance) else None


def _ekf2_summary(
    ekf2: Ekf2, variance: pd.DataFrame | Unavailable, innovations: pd.DataFrame | Unavailable
) -> FilterSummary:
    consistency: Consistency | Unavailable
    before = after = sigma_p = sigma_v = None
    if isinstance(innovations, Unavailable):
        consistency = innovations
    else:
        consistency = assess(
            innovations["innovation_m"].to_numpy(),
            innovations["innovation_variance_m2"].to_numpy(),
            ekf2.gate,
        )
        before = _median_sigma(innovations["prior_variance_m2"])
        after = _median_sigma(innovations["posterior_variance_m2"])
    if isinstance(variance, pd.DataFrame):
        sigma_p = _median_sigma(variance["position_variance_m2"])
        sigma_v = _median_sigma(variance["velocity_variance_m2_s2"])
    return FilterSummary(
        consistency=consistency,
        sigma_p_median_m=sigma_p,
        sigma_v_median_m_s=sigma_v,
        sigma_p_before_update_m=before,
        sigma_p_after_update_m=after,
    )


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
    state: pd.DataFrame, variance: pd.DataFrame | Unavailable, truth: pd.DataFrame | Unavailable
) -> AgainstTruth | Unavailable:
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


def _horizontal(
    results: list[AxisComparison], frame_of: Callable[[AxisComparison], pd.DataFrame | Unavailable]
) -> HorizontalNis | None:
    frames = {}
    for result in results:
        frame = frame_of(result)
        if isinstance(frame, pd.DataFrame):
            frames[result.axis.name] = frame[["innovation_m", "innovation_variance_m2"]]
    if not {"north", "east"} <= frames.keys():
        return None
    # only updates that both axes have, at the very same times
    both = pd.concat([frames["north"], frames["east"]], axis=1, join="inner").to_numpy().T
    return assess_horizontal((both[0], both[1]), (both[2], both[3]))
