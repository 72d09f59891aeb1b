"""Results of a comparison, part by part: log, source, settings, axes, and what explains them.

Units stand in the names; times are seconds from the first data of the log. ``kf`` is px4fuse's
two-state filter.
"""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from px4fuse.request import InputName
from px4fuse.results.model import (
    Absent,
    Base,
    Count,
    Either,
    Interval,
    Missing,
    NotNegative,
    Part,
    Positive,
    Sha256,
    Share,
    Vector,
)

Verdict = Literal["consistent", "variance overstated", "variance understated"]
Correlation = Annotated[float, Meta(ge=-1.0, le=1.0)]


class Dropout(Base, frozen=True):
    """A gap of the log itself."""

    start_s: float
    duration_s: NotNegative


class JoinedFile(Base, frozen=True):
    """A file that was read beside the log."""

    name: str
    sha256: Sha256
    size_bytes: Count
    role: Literal["mavlink", "position"]


class ClockMap(Base, frozen=True):
    """A clock mapped to the autopilot's: boot = stamp + offset + drift (stamp - middle)."""

    clock: str
    method: Literal[
        "boot clock",
        "TIMESYNC",
        "SYSTEM_TIME",
        "receive time",
        "arrival time",
        "position in the stream",
    ]
    pairs: Count
    offset_s: float
    drift_ppm: float
    jitter_s: NotNegative
    note: str
    distinct_stamps: Count | None = None


class Log(Base, frozen=True, kw_only=True):
    """The recording.

    ``parameters`` are those of PX4 that bear on fusion and logging; ``start_unix_s`` is the UNIX
    time of time zero, where the log has it; ``vehicle`` identifies the flight controller, and is
    empty where the log does not.
    """

    name: str
    sha256: Sha256
    size_bytes: Count
    format: Literal["ULog", "MAVLink tlog", "MAVLink stream"]
    firmware: str
    firmware_hash: str
    hardware: str
    boot_time_s: float
    duration_s: NotNegative
    dropouts: tuple[Dropout, ...]
    parameters: dict[str, int | float]
    notes: tuple[str, ...]
    autopilot: str
    start_unix_s: float | None = None
    joined: tuple[JoinedFile, ...]
    clocks: tuple[ClockMap, ...]
    vehicle: str = ""


class AvailableTrack(Base, frozen=True):
    """A position track of the flight."""

    name: str
    rung: Count
    samples: Count
    rate_hz: Positive | None = None


class Alignment(Base, frozen=True, kw_only=True):
    """How a position file was placed into the flight."""

    frame: Literal["ned", "enu", "nwu"]
    frame_reason: str
    yaw_deg: float
    yaw_sigma_deg: NotNegative | None = None
    yaw_reason: str
    origin_m: Vector
    clock_offset_s: float
    clock_offset_sigma_s: NotNegative | None = None
    clock_reason: str
    reference: str
    correlation: float | None = None
    residual_rms_m: NotNegative | None = None
    warnings: tuple[str, ...]


class PositionSource(Base, frozen=True):
    """The position that both filters are judged by.

    ``rung`` is its place in the ladder of sources, 1 is best; ``log`` the file that it was read
    from.
    """

    name: str
    rung: Annotated[int, Meta(ge=1, le=7)]
    description: str
    reason: str
    rate_hz: Positive
    frame: Literal["NED", "FRD", "unknown"]
    clock: str
    reconstructed: bool
    topics: tuple[str, ...]
    available: tuple[AvailableTrack, ...]
    not_in_log: tuple[Missing, ...]
    log: str
    alignment: Alignment | None = None


class ChosenSettings(Base, frozen=True):
    """Settings of the filter; ``clock_offset_s`` was added to the source's time stamps."""

    sigma_a_m_s2: Positive
    sigma_z_m: Positive
    dt_s: Positive
    input: InputName
    start_s: float
    end_s: float
    segment_reason: str
    clock_offset_s: float


class Consistency(Base, frozen=True):
    """Whether innovations are what the filter's own variances say.

    ``nis_mean`` 1 is consistent; ``nis_band`` is its two-sided 95 % band for white innovations;
    ``variance_factor`` = 1/nis_mean says how many times S is overstated.
    """

    count: Count
    innovation_mean_m: float
    innovation_std_m: NotNegative
    sqrt_s_median_m: Positive
    nis_mean: Positive
    nis_band: tuple[NotNegative, NotNegative]
    variance_factor: Positive
    verdict: Verdict
    outside_two_sigma: Share
    outside_gate: Share
    bias_t: float
    bias_p: Share
    lag1_autocorrelation: Correlation
    ljung_box_p: Share
    ljung_box_lags: Count


class Filter(Consistency, frozen=True, kw_only=True):
    """One filter on one axis: its consistency and its own σ."""

    sigma_p_median_m: Positive | None = None
    sigma_v_median_m_s: Positive | None = None
    sigma_p_before_update_m: Positive | None = None
    sigma_p_after_update_m: Positive | None = None


class UnjudgedFilter(Absent, frozen=True, kw_only=True):
    """A filter whose innovations say nothing, with the reason, and its own σ."""

    sigma_p_median_m: Positive | None = None
    sigma_v_median_m_s: Positive | None = None
    sigma_p_before_update_m: Positive | None = None
    sigma_p_after_update_m: Positive | None = None


class HorizontalNis(Base, frozen=True):
    """NIS of north and east together: two degrees of freedom, divided by two."""

    count: Count
    nis_mean: Positive
    nis_band: tuple[NotNegative, NotNegative]
    variance_factor: Positive
    verdict: Verdict


class Horizontal(Base, frozen=True):
    """North and east together, by filter."""

    kf: HorizontalNis | None = None
    ekf2: HorizontalNis | None = None


class Updates(Base, frozen=True, kw_only=True):
    """The measurements of one axis; ``input_gap_s`` is the longest gap of the IMU."""

    count: Count
    first_s: float
    last_s: float
    rate_hz: Positive | None = None
    input_gap_s: NotNegative


class Difference(Base, frozen=True):
    """Our filter minus EKF2, at EKF2's own sample times."""

    count: Count
    position_rmse_m: NotNegative
    position_mean_m: float
    position_maximum_m: NotNegative
    velocity_rmse_m_s: NotNegative
    velocity_mean_m_s: float
    velocity_maximum_m_s: NotNegative


class AgainstTruth(Base, frozen=True):
    """Both filters against ground truth that neither has used."""

    kf_count: Count | None = None
    kf_position_rmse_m: NotNegative | None = None
    kf_velocity_rmse_m_s: NotNegative | None = None
    kf_nees_position_mean: NotNegative | None = None
    kf_nees_velocity_mean: NotNegative | None = None
    ekf2_count: Count | None = None
    ekf2_position_rmse_m: NotNegative | None = None
    ekf2_velocity_rmse_m_s: NotNegative | None = None
    ekf2_nees_position_mean: NotNegative | None = None
    ekf2_nees_velocity_mean: NotNegative | None = None


class Axis(Base, frozen=True, kw_only=True):
    """One axis; ``direction`` is its unit vector in NED.

    ``rejected_share`` is of the source's samples that EKF2 rejected, where that is logged.
    """

    heading_deg: float | None = None
    direction: Vector
    note: str
    updates: Updates
    kf: Either[Filter, UnjudgedFilter]
    ekf2: Either[Filter, UnjudgedFilter]
    difference: Part[Difference]
    truth: Part[AgainstTruth]
    rejected_share: Share | None = None


class HeldOut(Base, frozen=True):
    """Noises found on the first half, and their gain on the second."""

    sigma_a_m_s2: NotNegative
    sigma_z_m: NotNegative
    count: Count
    gain_nats: float


# Field of Tuned that says what each setting of the filter should be
ASKED = {"sigma_a_m_s2": "filter_sigma_a_m_s2", "sigma_z_m": "sigma_z_m"}


class Tuned(Base, frozen=True, kw_only=True):
    """Most likely noises, with 95 % intervals.

    ``sigma_a_m_s2`` and ``sigma_z_m`` are noise alone, with biases and tilt taken out where
    ``biases_fitted``; ``filter_sigma_a_m_s2`` is what the two-state filter needs, which has no
    states for them. An upper bound stands instead of a value where the likelihood has its maximum
    at zero. ``gain_nats`` is the log-likelihood per measurement of that filter above the chosen
    settings'.
    """

    sigma_a_m_s2: NotNegative | None = None
    sigma_a_m_s2_interval: Interval | None = None
    sigma_a_m_s2_upper_bound: NotNegative | None = None
    sigma_a_m_s2_lower_bound: NotNegative | None = None
    filter_sigma_a_m_s2: NotNegative | None = None
    filter_sigma_a_m_s2_interval: Interval | None = None
    filter_sigma_a_m_s2_upper_bound: NotNegative | None = None
    filter_sigma_a_m_s2_lower_bound: NotNegative | None = None
    sigma_z_m: NotNegative | None = None
    sigma_z_m_interval: Interval | None = None
    sigma_z_m_upper_bound: NotNegative | None = None
    sigma_z_m_lower_bound: NotNegative | None = None
    count: Count
    outliers: Count
    gain_nats: float
    before: Part[Consistency]
    after: Part[Consistency]
    held_out: Part[HeldOut]
    biases_fitted: bool


class PartOffset(Base, frozen=True):
    """Clock offset of one part of the flight."""

    start_s: float
    end_s: float
    offset_s: float
    sigma_s: NotNegative


class HeadingPart(Base, frozen=True):
    """Turn of the source's frame in one part of the flight."""

    start_s: float
    end_s: float
    heading_error_deg: float
    sigma_deg: NotNegative


class Heading(Base, frozen=True, kw_only=True):
    """Turn of the source's frame against the logged attitude, clockwise seen from above.

    ``drift_p`` is the p-value of "it is the same throughout"; ``by`` says whether the source's own
    orientation or its positions and the IMU tell it.
    """

    turn_deg: float
    sigma_deg: NotNegative
    drifts: bool
    drift_p: Share
    by: str
    parts: tuple[HeadingPart, ...]


class Clock(Base, frozen=True, kw_only=True):
    """What must be added to the source's own stamps, what was applied included.

    ``change_p`` is the p-value of "all parts have the same offset".
    """

    offset_s: float
    interval_s: Interval
    sigma_s: NotNegative
    determinable: bool
    reason: str | None = None
    applied_s: float
    drift_ppm: float | None = None
    drift_sigma_ppm: NotNegative | None = None
    change_p: Share | None = None
    parts: tuple[PartOffset, ...]
    count: Count
