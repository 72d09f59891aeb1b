"""What a replay of EKF2 gives, and how well one agrees with the log."""

from __future__ import annotations

from collections.abc import Mapping

import pandas as pd

from px4fuse.display import brief
from px4fuse.flight import AxisName, Unavailable
from px4fuse.record import Correlation, Count, NotNegative, Positive, Record, Share, Span

Spans = tuple[Span, ...]
HORIZONTAL: tuple[AxisName, AxisName] = ("north", "east")
UPDATE_COLUMNS = [
    "innovation_north_m", "innovation_east_m", "innovation_variance_north_m2",
    "innovation_variance_east_m2", "rejected", "fused", "reset", "position_variance_north_m2",
    "position_variance_east_m2", "velocity_variance_north_m2_s2", "velocity_variance_east_m2_s2",
    "observation_variance_north_m2", "observation_variance_east_m2", "fused_at_s",
]  # fmt: skip
VELOCITY_UPDATE_COLUMNS = [
    "innovation_north_m_s", "innovation_east_m_s", "innovation_variance_north_m2_s2",
    "innovation_variance_east_m2_s2",
]  # fmt: skip


class AxisAgreement(Record, frozen=True, kw_only=True):
    """Replay as flown against log, along north or east.

    Attributes
    ----------
    innovation_correlation : float
    innovation_rms_difference : float
        In the aid's unit: m for a position.
    s_ratio_median, s_ratio_p5, s_ratio_p95 : float
        Replayed over logged innovation variance.
    nis_mean_logged, nis_mean_replayed : float
    position_rms_difference_m, velocity_rms_difference_m_s : float
        Of what is published.
    """

    innovation_correlation: Correlation
    innovation_rms_difference: NotNegative
    s_ratio_median: Positive
    s_ratio_p5: Positive
    s_ratio_p95: Positive
    nis_mean_logged: NotNegative
    nis_mean_replayed: NotNegative
    position_rms_difference_m: NotNegative
    velocity_rms_difference_m_s: NotNegative


class Agreement(Record, frozen=True, kw_only=True):
    """How well the replay as flown agrees with what EKF2 logged.

    Attributes
    ----------
    north, east : AxisAgreement
        Of the position that EKF2 fused.
    ev_pos, gnss_pos : mapping from "north" and "east" to AxisAgreement
        The same by the name of the aid; empty where it is the other one.
    gnss_vel : mapping from "north" and "east" to AxisAgreement
        Of the velocity that is fused with it.
    samples : int
        Logged innovations compared, all but those of each stretch's first seconds
        (:data:`~px4fuse.ekf2.stretches.SETTLING_S`).
    rejected_share_logged, rejected_share_replayed : float
        Of those.
    decisions_same : float
        Share of those that both reject or both do not.
    published_rms_difference_m : float
        Of the horizontal position that is published, replay minus log.
    good : bool
        Whether anything may be concluded from a replay of this log.
    reason : str
        One sentence: why, or why not.
    """

    north: AxisAgreement
    east: AxisAgreement
    ev_pos: Mapping[str, AxisAgreement] = {}
    gnss_pos: Mapping[str, AxisAgreement] = {}
    gnss_vel: Mapping[str, AxisAgreement] = {}
    samples: Count
    rejected_share_logged: Share
    rejected_share_replayed: Share
    decisions_same: Share
    published_rms_difference_m: NotNegative
    good: bool
    reason: str

    @property
    def axes(self) -> Mapping[str, AxisAgreement]:
        """Of the position, by axis."""
        return {"north": self.north, "east": self.east}

    def doubted(self, what: str) -> Unavailable:
        """What stands in for a conclusion where the replay is not good."""
        return Unavailable(
            what,
            f"the model does not reproduce what EKF2 logged: {self.reason}",
            "Record without dropouts, with SDLOG_PROFILE "
            + ("129 (default and vision)." if self.ev_pos else "3 (default and full rates)."),
        )


class Replayed(Record, frozen=True, kw_only=True, omit_defaults=False):
    """EKF2 replayed from the log.

    Attributes
    ----------
    source : str
        Position track that it was fed with.
    stretches_s : tuple of (float, float)
        Parts of the flight that were replayed, each started from the log.
    settings : mapping
        All parameters of the model in force, by PX4 name, in PX4's units.
    late, lost : int
        Samples that arrived after the horizon had passed them: fused late, and never.
    agreement : Agreement or None
        Of the replay as flown with the log; None only while that is being made.
    """

    source: str
    stretches_s: Spans
    settings: Mapping[str, float]
    late: Count = 0
    lost: Count = 0
    agreement: Agreement | None = None


class Ekf2Replay(Replayed, frozen=True, kw_only=True, eq=False):
    """EKF2 as the model replays it with one setting.

    Attributes
    ----------
    changed : mapping
        Parameters that differ from the log's on request.
    updates : DataFrame, shape (m, 14), (m, 18) where velocity is fused too
        Per sample, by the time of measurement as EKF2 takes it (stamp - delay - half a
        step): innovation (measurement minus state) and its variance S, north and east; 1 or 0
        whether it was rejected by the gate, fused, or the position reset to it; variances of
        position and velocity after it, R, and the end of the step in which that happened; then
        the same innovations of velocity.
    delayed : DataFrame, shape (n, 7)
        Position and velocity at the fusion horizon at the end of each step (m, m/s, NED), and
        ``heading_rad``.
    published : DataFrame, shape (n, 6)
        What EKF2 publishes then, by its output predictor.
    """

    written_as = Replayed
    changed: Mapping[str, float]
    updates: pd.DataFrame
    delayed: pd.DataFrame
    published: pd.DataFrame

    __repr__ = brief
