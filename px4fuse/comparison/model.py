"""Inputs and results of a comparison of KF with EKF2."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import pandas as pd
from msgspec import structs

from px4fuse.convention.correction import ConventionFaults, find_convention_faults
from px4fuse.convention.model import Convention
from px4fuse.core.record import (
    NOT_IN_JSON,
    Count,
    NonNegativeFloat,
    NotInJson,
    OrUnavailable,
    PositiveFloat,
    Record,
    RecordOrUnavailable,
    Share,
    Unavailable,
    Vector,
    one_line_repr,
)
from px4fuse.errors import MissingDataError, suggest_name
from px4fuse.filter.consistency import (
    DEFAULT_GATE,
    Consistency,
    HorizontalNis,
    classify_sigma_ratio,
)
from px4fuse.filter.kalman import KfRun
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import AISLE_AXIS, Axis, Segment, cut_to_segment
from px4fuse.flight.model import Flight, PositionTrack, TableOrUnavailable

FilterName = Literal["kf", "ekf2"]
FILTER_NAMES: Mapping[FilterName, str] = {"kf": "KF", "ekf2": "EKF2"}


@dataclass(frozen=True)
class FilterTracks:
    """State, reported variance and innovations of one filter along an axis.

    Attributes
    ----------
    state : DataFrame or Unavailable
        Position and velocity. Jumps of EKF2's track by resets of its origin are removed.
    innovations : DataFrame or Unavailable
        Innovations, and position variance before and after each update.
    run : KfRun or None
        Run of the filter by px4fuse; None for EKF2, whose states are logged.
    gate : float
        Limit of |ν|/√S for the statistics of the innovations.
    fusion_horizon : DataFrame or None
        Position of EKF2 and its variance at the fusion horizon, if logged.
    """

    state: TableOrUnavailable
    variance: TableOrUnavailable
    innovations: TableOrUnavailable
    run: KfRun | None = None
    gate: float = DEFAULT_GATE
    fusion_horizon: pd.DataFrame | None = None

    __repr__ = one_line_repr


class ErrorsAgainstTruth(Record, kw_only=True):
    """Errors of one filter against ground truth.

    The mean NEES has no 95 % band, because the errors in one flight are correlated.
    """

    count: Count
    position_rmse_m: NonNegativeFloat
    velocity_rmse_m_s: NonNegativeFloat | None = None
    nees_position_mean: NonNegativeFloat | None = None
    nees_velocity_mean: NonNegativeFloat | None = None
    nees_position_horizon_mean: NonNegativeFloat | None = None

    @property
    def has_only_lag_errors(self) -> bool:
        """True if only the lag of EKF2's output predictor makes EKF2 overconfident."""
        nees = self.nees_position_horizon_mean
        return nees is not None and classify_sigma_ratio(nees**0.5, "truth") != "overconfident"


class FilterSummary(Consistency, kw_only=True):
    """Consistency of one filter along one axis, its reported σ and its errors.

    Attributes
    ----------
    sigma_p_median_m, sigma_v_median_m_s : float or None
        Median reported σ of position and velocity.
    sigma_p_before_update_m, sigma_p_after_update_m : float or None
        Median position σ before and after an update.
    truth : ErrorsAgainstTruth or Unavailable
    """

    sigma_p_median_m: PositiveFloat | None = None
    sigma_v_median_m_s: PositiveFloat | None = None
    sigma_p_before_update_m: PositiveFloat | None = None
    sigma_p_after_update_m: PositiveFloat | None = None
    truth: OrUnavailable[ErrorsAgainstTruth]

    @property
    def is_underconfident_against_truth(self) -> bool:
        nees = None if isinstance(self.truth, Unavailable) else self.truth.nees_position_mean
        return nees is not None and classify_sigma_ratio(nees**0.5, "truth") == "underconfident"


class UntestedFilter(Unavailable, kw_only=True):
    """Reported σ and errors of a filter, and the reason why its consistency was not tested."""

    sigma_p_median_m: PositiveFloat | None = None
    sigma_v_median_m_s: PositiveFloat | None = None
    sigma_p_before_update_m: PositiveFloat | None = None
    sigma_p_after_update_m: PositiveFloat | None = None
    truth: OrUnavailable[ErrorsAgainstTruth]


class FilterDifference(Record, kw_only=True):
    """Difference KF - EKF2 of position and velocity along one axis, at EKF2's sample times."""

    count: Count
    position_rms_m: NonNegativeFloat
    position_mean_m: float
    position_maximum_m: NonNegativeFloat
    velocity_rms_m_s: NonNegativeFloat
    velocity_mean_m_s: float
    velocity_maximum_m_s: NonNegativeFloat


class UpdateStatistics(Record, kw_only=True):
    """Number of KF's updates along one axis, and times (s) of the first and the last update.

    ``input_gap_s`` is the time (s) without IMU data.
    """

    count: Count
    first_s: float
    last_s: float
    rate_hz: PositiveFloat | None = None
    input_gap_s: NonNegativeFloat


class AxisComparison(Record, kw_only=True):
    """Comparison of KF with EKF2 along one axis.

    Attributes
    ----------
    heading_deg : float or None
        Heading of the axis, clockwise from north; None for the down axis.
    direction : (float, float, float)
        Unit vector in NED.
    note : str
        Reason for the direction of the axis, as text.
    rejected_fraction : float or None
        Fraction of the positions that EKF2 rejected; None if not logged.
    whole_flight_tracks : (FilterTracks, DataFrame or Unavailable)
        EKF2 and ground truth over the whole flight, but innovations in the analysed segment.
    """

    heading_deg: float | None = None
    direction: Vector
    note: str
    updates: UpdateStatistics
    filters: Mapping[FilterName, RecordOrUnavailable[FilterSummary, UntestedFilter]]
    difference: OrUnavailable[FilterDifference]
    rejected_fraction: Share | None = None
    axis: NotInJson[Axis] = NOT_IN_JSON
    kf_run: NotInJson[KfRun] = NOT_IN_JSON
    tracks: NotInJson[Mapping[FilterName, FilterTracks]] = NOT_IN_JSON
    truth: NotInJson[TableOrUnavailable] = NOT_IN_JSON
    whole_flight_tracks: NotInJson[tuple[FilterTracks, TableOrUnavailable]] = NOT_IN_JSON

    @property
    def ekf2_tracks(self) -> FilterTracks:
        return self.tracks["ekf2"]

    def with_whole_flight_tracks(self) -> "AxisComparison":
        """Return a copy with EKF2 and ground truth over the whole flight, for plots."""
        ekf2, truth = self.whole_flight_tracks
        return structs.replace(self, tracks={**self.tracks, "ekf2": ekf2}, truth=truth)


@dataclass(frozen=True)
class PreparedComparison:
    """Inputs of a comparison of KF with EKF2, before KF runs.

    Attributes
    ----------
    settings : Settings
        Settings of KF.
    input_axes : tuple of Axis
        Axes with their measurements and accelerations, the inputs of KF.
    notes : tuple of str
        Notes for the user about the log and about automatic choices.
    convention : Convention or None
        Axes, unit and clock of the positions as sent.
    """

    flight: Flight
    source: PositionTrack
    source_reason: str
    segment: Segment
    settings: Settings
    input_axes: tuple[Axis, ...]
    notes: tuple[str, ...]
    missing: tuple[Unavailable, ...]
    convention: Convention | None

    __repr__ = one_line_repr

    @property
    def source_samples(self) -> pd.DataFrame:
        """Positions of the source and reported variances in the analysed segment."""
        return cut_to_segment(self.source.samples, self.segment)

    @property
    def convention_faults(self) -> ConventionFaults:
        """Deviations of the source from PX4's convention: axes, unit, clock, orientation."""
        return find_convention_faults(self.convention, self.flight, self.source.frame)


@dataclass(frozen=True, repr=False)
class Comparison(PreparedComparison):
    """Results of a comparison of KF with EKF2 along each axis, and its inputs.

    Attributes
    ----------
    axes : mapping from axis name to AxisComparison
    horizontal : mapping from filter name to HorizontalNis
        NIS of north and east together, if both were analysed.
    """

    axes: Mapping[str, AxisComparison]
    horizontal: Mapping[FilterName, HorizontalNis]

    def __getitem__(self, axis: str) -> AxisComparison:
        """Return the comparison along an axis, by its name.

        Raises
        ------
        MissingDataError
            The axis was not analysed.
        """
        if axis not in self.axes:
            raise MissingDataError(
                f"The axis {axis!r} was not analysed.",
                f"{suggest_name(axis, self.axes)}Available axes: {', '.join(self.axes)}.",
            )
        return self.axes[axis]

    @property
    def main(self) -> AxisComparison:
        """Result along the axis of largest motion if analysed, else along the first axis."""
        return self.axes.get(AISLE_AXIS) or next(iter(self.axes.values()))


def select_north_and_east(comparison: Comparison) -> list[AxisComparison]:
    return [comparison.axes[name] for name in ("north", "east") if name in comparison.axes]
