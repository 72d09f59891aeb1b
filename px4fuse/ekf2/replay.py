"""What a replay of EKF2 gives, and how well one agrees with the log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import pandas as pd

from px4fuse.display import brief
from px4fuse.flight import AxisName

HORIZONTAL: tuple[AxisName, AxisName] = ("north", "east")
UPDATE_COLUMNS = [
    "innovation_north_m", "innovation_east_m", "innovation_variance_north_m2",
    "innovation_variance_east_m2", "rejected", "fused", "reset", "position_variance_north_m2",
    "position_variance_east_m2", "velocity_variance_north_m2_s2", "velocity_variance_east_m2_s2",
    "observation_variance_north_m2", "observation_variance_east_m2", "fused_at_s",
]  # fmt: skip


@dataclass(frozen=True)
class AxisAgreement:
    """Replay as flown against log, along north or east.

    Attributes
    ----------
    innovation_correlation : float
    innovation_rms_difference_m : float
    s_ratio_median, s_ratio_p5, s_ratio_p95 : float
        Replayed over logged innovation variance.
    nis_mean_logged, nis_mean_replayed : float
    position_rms_difference_m, velocity_rms_difference_m_s : float
        Of what is published.
    """

    innovation_correlation: float
    innovation_rms_difference_m: float
    s_ratio_median: float
    s_ratio_p5: float
    s_ratio_p95: float
    nis_mean_logged: float
    nis_mean_replayed: float
    position_rms_difference_m: float
    velocity_rms_difference_m_s: float


@dataclass(frozen=True)
class Agreement:
    """How well the replay as flown agrees with what EKF2 logged.

    Attributes
    ----------
    axes : mapping from "north" and "east" to AxisAgreement
    samples : int
        Logged innovations compared, all but those of each stretch's first seconds
        (:data:`~px4fuse.ekf2.stretches.SETTLING_S`).
    rejected_share_logged, rejected_share_replayed : float
        Of those.
    same_share : float
        Of those that both reject or both do not.
    good : bool
        Whether anything may be concluded from a replay of this log.
    reason : str
        One sentence: why, or why not.
    """

    axes: Mapping[str, AxisAgreement]
    samples: int
    rejected_share_logged: float
    rejected_share_replayed: float
    same_share: float
    good: bool
    reason: str


@dataclass(frozen=True)
class Ekf2Replay:
    """EKF2 as the model replays it with one setting.

    Attributes
    ----------
    settings : mapping
        All parameters of the model in force, by PX4 name, in PX4's units.
    changed : mapping
        Those that differ from the log's on request.
    updates : DataFrame, shape (m, 14)
        Per vision sample, by the time of measurement as EKF2 takes it (stamp - delay - half a
        step): innovation (measurement minus state) and its variance S, north and east; 1 or 0
        whether it was rejected by the gate, fused, or the position reset to it; variances of
        position and velocity after it, R, and the end of the step in which that happened.
    delayed : DataFrame, shape (n, 6)
        Position and velocity at the fusion horizon at the end of each step (m, m/s, NED).
    published : DataFrame, shape (n, 6)
        What EKF2 publishes then, by its output predictor.
    stretches : tuple of (float, float)
        Parts of the flight that were replayed, each started from the log.
    source : str
        Position track that it was fed with.
    late, lost : int
        Vision samples that arrived after the horizon had passed them: fused late, and never.
    agreement : Agreement or None
        Of the replay as flown with the log; None only while that is being made.
    """

    settings: Mapping[str, float]
    changed: Mapping[str, float]
    updates: pd.DataFrame
    delayed: pd.DataFrame
    published: pd.DataFrame
    stretches: tuple[tuple[float, float], ...]
    source: str
    late: int = 0
    lost: int = 0
    agreement: Agreement | None = None

    __repr__ = brief
