"""What a comparison is: its records, by axis and by filter, and the tracks beside them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import pandas as pd

from px4fuse.display import one_line_repr
from px4fuse.errors import MissingDataError, suggest_name
from px4fuse.filter.consistency import Consistency, HorizontalNis
from px4fuse.filter.kalman import Replay
from px4fuse.filter.settings import Settings
from px4fuse.filter.signals import AISLE, Axis, Segment
from px4fuse.flight import Flight, PositionTrack
from px4fuse.record import (
    Count,
    NotNegative,
    OrUnavailable,
    Positive,
    Record,
    RecordOrUnavailable,
    Share,
    Unavailable,
    Vector,
)

FilterName = Literal["kf", "ekf2"]
FILTERS: tuple[FilterName, FilterName] = ("kf", "ekf2")


class AgainstTruth(Record, frozen=True, kw_only=True):
    """One filter against ground truth that it has not used.

    NEES is per component (1 is consistent); it is strongly autocorrelated within one flight, so
    no band is stated. EKF2's is of its position at its fusion horizon, where its variance is
    stated, as far as that is logged; errors are those of what it publishes. None where the variance
    or the true velocity is not logged.
    """

    count: Count
    position_rmse_m: NotNegative
    velocity_rmse_m_s: NotNegative | None = None
    nees_position_mean: NotNegative | None = None
    nees_velocity_mean: NotNegative | None = None


class FilterSummary(Consistency, frozen=True, kw_only=True):
    """What one filter did along one axis: its consistency, its own σ, and its error.

    Attributes
    ----------
    sigma_p_median_m, sigma_v_median_m_s : float or None
        Median standard deviations over the segment; None where not logged.
    sigma_p_before_update_m, sigma_p_after_update_m : float or None
        Medians just before and just after an update. For EKF2 from S and R: P⁻ = S - R,
        P⁺ = P⁻R/S.
    truth : AgainstTruth or Unavailable
    """

    sigma_p_median_m: Positive | None = None
    sigma_v_median_m_s: Positive | None = None
    sigma_p_before_update_m: Positive | None = None
    sigma_p_after_update_m: Positive | None = None
    truth: OrUnavailable[AgainstTruth]


class UnjudgedFilter(Unavailable, frozen=True, kw_only=True):
    """A filter whose innovations say nothing, and why; else as :class:`FilterSummary`."""

    sigma_p_median_m: Positive | None = None
    sigma_v_median_m_s: Positive | None = None
    sigma_p_before_update_m: Positive | None = None
    sigma_p_after_update_m: Positive | None = None
    truth: OrUnavailable[AgainstTruth]


class Difference(Record, frozen=True, kw_only=True):
    """Ours minus EKF2, at EKF2's own sample times."""

    count: Count
    position_rmse_m: NotNegative
    position_mean_m: float
    position_maximum_m: NotNegative
    velocity_rmse_m_s: NotNegative
    velocity_mean_m_s: float
    velocity_maximum_m_s: NotNegative


class Updates(Record, frozen=True, kw_only=True):
    """The measurements of one axis; ``input_gap_s`` is the longest gap of the IMU."""

    count: Count
    first_s: float
    last_s: float
    rate_hz: Positive | None = None
    input_gap_s: NotNegative


class AxisResult(Record, frozen=True, kw_only=True):
    """One axis.

    Attributes
    ----------
    heading_deg : float or None
    direction : (float, float, float)
        Its unit vector in NED.
    note : str
    updates : Updates
    filters : mapping from "kf" (ours) and "ekf2" to FilterSummary or UnjudgedFilter
    difference : Difference or Unavailable
    rejected_share : float or None
        Of the source's samples that EKF2 rejected; None where that is not logged.
    """

    heading_deg: float | None = None
    direction: Vector
    note: str
    updates: Updates
    filters: Mapping[FilterName, RecordOrUnavailable[FilterSummary, UnjudgedFilter]]
    difference: OrUnavailable[Difference]
    rejected_share: Share | None = None


class AxisComparison(AxisResult, frozen=True, kw_only=True, eq=False):
    """:class:`AxisResult`, with the tracks.

    Attributes
    ----------
    axis : Axis
    replay : Replay
    ekf2_state : DataFrame or Unavailable
        ``position_m, velocity_m_s`` in the segment, resets treated as the comparison says.
    ekf2_variance : DataFrame or Unavailable
        ``position_variance_m2, velocity_variance_m2_s2`` in the segment.
    ekf2_innovations : DataFrame or Unavailable
        Columns as :attr:`Ekf2.innovations`, in the segment, plus ``prior_variance_m2`` and
        ``posterior_variance_m2`` (P⁻ = S - R and P⁺ = P⁻R/S, NaN where R is unknown).
    truth : DataFrame or Unavailable
        ``position_m, velocity_m_s`` in the segment.
    """

    schema_type = AxisResult
    axis: Axis
    replay: Replay
    ekf2_state: pd.DataFrame | Unavailable
    ekf2_variance: pd.DataFrame | Unavailable
    ekf2_innovations: pd.DataFrame | Unavailable
    truth: pd.DataFrame | Unavailable

    __repr__ = one_line_repr


@dataclass(frozen=True)
class Comparison:
    """What is compared and, once the filters ran, what they did.

    Attributes
    ----------
    flight : Flight
    source : PositionTrack
    source_reason : str
    segment : Segment
    settings : Settings
        As used: ``input`` is "zero" where the log has no acceleration.
    lines : tuple of Axis
    notes : tuple of str
        Choices made on the way.
    missing : tuple of Unavailable
    axes : mapping from axis name to AxisComparison
        Empty before the filters ran.
    horizontal : mapping from "kf" and "ekf2" to HorizontalNis
        North and east together, as far as both were analysed.
    """

    flight: Flight
    source: PositionTrack
    source_reason: str
    segment: Segment
    settings: Settings
    lines: tuple[Axis, ...]
    notes: tuple[str, ...]
    missing: tuple[Unavailable, ...]
    axes: Mapping[str, AxisComparison] = field(default_factory=dict)
    horizontal: Mapping[FilterName, HorizontalNis] = field(default_factory=dict)

    __repr__ = one_line_repr

    def __getitem__(self, axis: str) -> AxisComparison:
        """Everything about one axis, by its name.

        Raises
        ------
        MissingDataError
            It was not analysed.
        """
        if axis not in self.axes:
            raise MissingDataError.of(
                "no_such_axis",
                axis=axis,
                near=suggest_name(axis, self.axes),
                known=", ".join(self.axes),
            )
        return self.axes[axis]

    @property
    def main(self) -> AxisComparison:
        """The axis of the lab: the aisle, else the first."""
        return self.axes.get(AISLE) or next(iter(self.axes.values()))
