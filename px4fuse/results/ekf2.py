"""Results about EKF2 replayed from the log: agreement, why it differs, and what if.

Units stand in the names; mean squares are in square metres and square metres per second squared.
"""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from px4fuse.results.model import Absent, Base, Count, Interval, NotNegative, Positive, Share


class AxisAgreement(Base, frozen=True):
    """Replay as flown against log; ``s_ratio`` is replayed over logged innovation variance."""

    innovation_correlation: Annotated[float, Meta(ge=-1.0, le=1.0)]
    innovation_rms_difference_m: NotNegative
    s_ratio_median: Positive
    s_ratio_p5: Positive
    s_ratio_p95: Positive
    nis_mean_logged: NotNegative
    nis_mean_replayed: NotNegative
    position_rms_difference_m: NotNegative
    velocity_rms_difference_m_s: NotNegative


class Agreement(Base, frozen=True):
    """How well the replay agrees with the log; nothing is concluded where it is not good.

    ``same_share`` is of the samples that both reject or both do not.
    """

    north: AxisAgreement
    east: AxisAgreement
    samples: Count
    rejected_share_logged: Share
    rejected_share_replayed: Share
    same_share: Share
    good: bool
    reason: str


class Ekf2Replay(Base, frozen=True, kw_only=True):
    """EKF2 replayed as flown, by the parts of the flight that could be replayed.

    ``settings`` are the parameters of the model in force, by PX4 name and in PX4's units; ``late``
    and ``lost`` count samples that came after the fusion horizon had passed them.
    """

    source: str
    stretches_s: tuple[Interval, ...]
    settings: dict[str, float]
    late: Count
    lost: Count
    agreement: Agreement


class Step(Base, frozen=True, kw_only=True):
    """One change on the way from our filter to the logged EKF2.

    The mean squares are by how much it brings the track nearer, below 0 farther away;
    ``position_moved_m`` is how far it moves the position at most, at ``moved_at_s``.
    """

    name: str
    position_mean_square_m2: float
    velocity_mean_square_m2_s2: float
    position_moved_m: NotNegative
    moved_at_s: float
    position_rmse_to_truth_m: NotNegative | None = None


class Coast(Base, frozen=True):
    """The longest run of rejected samples, and how far EKF2 went astray in it."""

    start_s: float
    samples: Count
    duration_s: NotNegative
    distance_m: NotNegative


class Outside(Base, frozen=True):
    """How far both filters are apart at most where EKF2 was not replayed, and when."""

    maximum_m: NotNegative
    at_s: float


class Why(Base, frozen=True, kw_only=True):
    """Why EKF2 differs: the steps and what is left add up to the whole difference."""

    count: Annotated[int, Meta(ge=1)]
    spans_s: tuple[Interval, ...]
    position_mean_square_m2: NotNegative
    velocity_mean_square_m2_s2: NotNegative
    steps: tuple[Step, ...]
    position_left_mean_square_m2: NotNegative
    velocity_left_mean_square_m2_s2: NotNegative
    kf_position_rmse_to_truth_m: NotNegative | None = None
    ekf2_position_rmse_to_truth_m: NotNegative | None = None
    coast: Coast | None = None
    outside: Outside | None = None
    sentences: tuple[str, ...]


class AxisOutcome(Base, frozen=True, kw_only=True):
    """One axis of one EKF2; the error is that of what it publishes."""

    nis_mean: NotNegative
    nis_band: tuple[NotNegative, NotNegative]
    innovation_std_m: NotNegative
    sigma_p_median_m: NotNegative | Absent
    position_rmse_to_truth_m: NotNegative | Absent


class Outcome(Base, frozen=True, kw_only=True):
    """One EKF2: as logged, as replayed, or with other parameters.

    ``changed`` are those that differ from what was flown, by PX4 name and in PX4's units.
    """

    changed: dict[str, float]
    north: AxisOutcome
    east: AxisOutcome
    samples: Count
    rejected_share: Share
    longest_without_fusion_s: NotNegative | Absent
    resets: Count
    late: Count
    lost: Count
