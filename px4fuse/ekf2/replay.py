"""What a replay of EKF2 gives, and whether it agrees with the log, so that it may be believed."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import pandas as pd
from msgspec.structs import replace
from numpy.typing import ArrayLike

from px4fuse.arrays import Array, BoolArray, IntArray
from px4fuse.display import one_line_repr
from px4fuse.ekf2.inputs import aid_source, replayed_aid, same_sample
from px4fuse.ekf2.stretches import SETTLING_S
from px4fuse.ekf2_parameters import AIDS, EV_POS, FLOW, GNSS_HGT, GNSS_POS, GNSS_VEL, MAG
from px4fuse.filter import signals
from px4fuse.filter.heading import heading_rad
from px4fuse.flight import AXIS_NAMES, AidLog, AxisName, Columns, Ekf2, Flight, Truth, Unavailable
from px4fuse.readers.px4_innovations import along as innovations_along
from px4fuse.record import (
    Correlation,
    Count,
    NotNegative,
    Positive,
    Record,
    Share,
    Span,
    missing_data,
)

Spans = tuple[Span, ...]
HORIZONTAL: tuple[AxisName, AxisName] = ("north", "east")
UPDATE_COLUMNS = [
    "innovation_north_m",
    "innovation_east_m",
    "innovation_variance_north_m2",
    "innovation_variance_east_m2",
    "rejected",
    "fused",
    "reset",
    "position_variance_north_m2",
    "position_variance_east_m2",
    "velocity_variance_north_m2_s2",
    "velocity_variance_east_m2_s2",
    "observation_variance_north_m2",
    "observation_variance_east_m2",
    "fused_at_s",
]
VELOCITY_UPDATE_COLUMNS = [
    *(f"innovation_{axis}_m_s" for axis in AXIS_NAMES),
    *(f"innovation_variance_{axis}_m2_s2" for axis in AXIS_NAMES),
]
MIN_SAMPLES = 20
CONSTANT = "its logged or replayed innovations are constant"
# The older topics repeat a sample until the next fusion, with the time of a later step
MAX_REPEAT_S = 0.5
# Measured on simulated flights of v1.13 to main: where the log is complete the correlation is
# above 0.997 and the median ratio of S within 0.3 %; with a decimated source or with an IMU with
# dropouts S is off by more than 5 % or the correlation below 0.9 (tests/benchmarks/bench_ekf2.py)
MIN_CORRELATION = 0.95
MAX_S_DIFFERENCE = 0.05
# Of the position that EKF2 publishes; there it is within 0.013 m
MAX_PUBLISHED_DIFFERENCE_M = 0.10
# and where flow alone carries it, of which the log has a part
MAX_CARRIED_OFF_M = 0.5
# Where EKF2 rejects much, one sample on the edge of the gate decides the next ones: then shares
# and mean NIS must agree, and single samples when the model rejects what EKF2 rejected
REJECTING_SHARE = 0.1
MAX_REJECTED_DIFFERENCE = 0.05
MAX_NIS_DIFFERENCE = 0.25
# What is published by a filter that rejects most of its samples wanders further
REJECTING_TOLERANCE_FACTOR = 3.0


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
        The same by the name of the aid, and of vision that is fused besides GNSS.
    gnss_vel : mapping from "north", "east" and "down" to AxisAgreement
        Of the velocity that is fused with it; "down" where its height is fused too.
    gnss_hgt, baro_hgt : mapping from "down" to AxisAgreement
        Of the heights, where the log holds what EKF2 fused of them.
    samples : int
        Logged innovations compared, all but those of each stretch's first seconds
        (:data:`~px4fuse.ekf2.stretches.SETTLING_S`).
    rejected_share_logged, rejected_share_replayed : float
        Of those.
    decisions_same : float
        Share of those that both reject or both do not.
    published_rms_difference_m : float
        Of the horizontal position that is published, replay minus log.
    heading_rms_difference_deg : float or None
        Of the filter's heading; None where the replay takes it from the log.
    carried_difference_m : float or None
        Of the same, the largest while optical flow alone carried the position, which is not in what
        is said of it otherwise; None where positions never failed for long.
    doubtful : mapping from PX4's name of an aid to str
        Of which nothing may be concluded, and why: heights, instead of which the replay has EKF2's
        own as flown, optical flow, without which it begins again where positions do, and vision
        besides GNSS, which the replay leaves out.
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
    gnss_hgt: Mapping[str, AxisAgreement] = {}
    baro_hgt: Mapping[str, AxisAgreement] = {}
    samples: Count
    rejected_share_logged: Share
    rejected_share_replayed: Share
    decisions_same: Share
    published_rms_difference_m: NotNegative
    good: bool
    reason: str
    heading_rms_difference_deg: NotNegative | None = None
    carried_difference_m: NotNegative | None = None
    doubtful: Mapping[str, str] = {}

    @property
    def axes(self) -> Mapping[str, AxisAgreement]:
        """Of the position, by axis."""
        return {"north": self.north, "east": self.east}

    def as_unavailable(self, what: str) -> Unavailable:
        """What stands in for a conclusion where the replay is not good."""
        profile = "3 (default and full rates)" if self.gnss_pos else "129 (default and vision)"
        return missing_data("replay_doubted", what=what, reason=self.reason, profile=profile)


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
    updates : DataFrame, shape (m, 14), (m, 20) where velocity is fused too
        Per sample, by the time of measurement as EKF2 takes it (stamp - delay - half a
        step): innovation (measurement minus state) and its variance S, north and east; 1 or 0
        whether it was rejected by the gate, fused, or the position reset to it; variances of
        position and velocity after it, R, and the end of the step in which that happened; then
        the same innovations of velocity.
    other_aid_updates : mapping from PX4's name to DataFrame, shape (k, 5), (k, 8) of vision
        Per sample of GNSS height and barometer, and of vision besides GNSS, where they are fused:
        innovation and S (``innovation_down_m``, ``innovation_variance_down_m2``), ``rejected``,
        ``fused`` and ``fused_at_s``; and of vision, north and east, ``reset``: whether the position
        was reset to it. Where only the bias of vision begins anew there is no row.
    flow_only_spans_s : tuple of (float, float)
        From the last position to the next ones, where optical flow alone carried the filter.
    delayed : DataFrame, shape (n, 7)
        Position and velocity at the fusion horizon at the end of each step (m, m/s, NED), and
        ``heading_rad``.
    published : DataFrame, shape (n, 6)
        What EKF2 publishes then, by its output predictor.
    """

    schema_type = Replayed
    changed: Mapping[str, float]
    updates: pd.DataFrame
    delayed: pd.DataFrame
    published: pd.DataFrame
    other_aid_updates: Mapping[str, pd.DataFrame] = {}
    flow_only_spans_s: Spans = ()

    __repr__ = one_line_repr

    @property
    def judged_s(self) -> Spans:
        """Parts that are judged: each stretch without its beginning and what flow carried."""
        spans = []
        for start, end in self.stretches_s:
            begin = start + SETTLING_S
            for last, again in self.flow_only_spans_s:
                if begin < last < end:
                    spans.append((begin, last))
                    begin = again + SETTLING_S
            if begin < end:
                spans.append((begin, end))
        return tuple(spans)


def agreement_with_log(flight: Flight, replay: Ekf2Replay) -> Agreement | Unavailable:
    """Compare a replay as flown with EKF2's logged innovations and published state.

    Parameters
    ----------
    flight : Flight
    replay : Ekf2Replay
        With the log's own parameters.
    """
    ekf2 = flight.ekf2
    assert isinstance(ekf2, Ekf2)
    own = aid_source(replayed_aid(ekf2)) in ekf2.innovation_topics
    log, model = _matched_samples(replay, replay.updates, logged_innovations(ekf2), own=own)
    if len(log) < MIN_SAMPLES:
        return missing_data("compared_few", count=len(log), least=MIN_SAMPLES)
    if _constant(log, model, HORIZONTAL):
        return missing_data("innovations_constant")
    axes: dict[str, AxisAgreement]
    axes = {axis: _axis_agreement(axis, log, model, ekf2, replay) for axis in HORIZONTAL}
    north, east = axes["north"], axes["east"]
    rejected_in_log, rejected_in_model = (
        frame["rejected"].to_numpy() > 0 for frame in (log, model)
    )
    shares = float(rejected_in_log.mean()), float(rejected_in_model.mean())
    good, reason = _agreement_verdict(axes, *shares)
    on_gnss = replayed_aid(ekf2) == GNSS_POS
    other_agreements, doubtful = _other_agreements(ekf2, replay)
    velocity, constant = _velocity_agreement(ekf2, replay, own=own)
    if constant:
        doubtful[GNSS_VEL.name] = CONSTANT
    position = {GNSS_POS.name if on_gnss else EV_POS.name: axes}
    distance_m = np.hypot(north.position_rms_difference_m, east.position_rms_difference_m)
    carried_m = _flow_only_error_m(ekf2, replay)
    if carried_m is not None and carried_m > MAX_CARRIED_OFF_M:
        doubtful[FLOW.name] = (
            "while it alone carried the position, what is published comes "
            f"{_format_beyond(carried_m, MAX_CARRIED_OFF_M)} m off the log (at most "
            f"{MAX_CARRIED_OFF_M:g} m)"
        )
    return Agreement(
        north=north,
        east=east,
        gnss_vel=velocity,
        **(position | other_agreements),
        doubtful=doubtful,
        samples=len(log),
        rejected_share_logged=shares[0],
        rejected_share_replayed=shares[1],
        decisions_same=float(np.mean(rejected_in_log == rejected_in_model)),
        published_rms_difference_m=float(distance_m),
        good=good,
        reason=reason,
        heading_rms_difference_deg=_heading_error_deg(ekf2, replay),
        carried_difference_m=carried_m,
    )


def _flow_only_error_m(ekf2: Ekf2, replay: Ekf2Replay) -> float | None:
    """How far what is published comes off the log horizontally while flow alone carried it."""
    times = ekf2.state.index
    within = inside_spans(times, replay.flow_only_spans_s)
    if not within.any():
        return None
    north, east = (
        along(replay.published, Columns.POSITION, one, times[within].to_numpy())
        - along(ekf2.state, Columns.POSITION, one, times[within].to_numpy())
        for one in np.eye(3)[:2]
    )
    return float(np.hypot(north, east).max())


def _heading_error_deg(ekf2: Ekf2, replay: Ekf2Replay) -> float | None:
    """Of a replay that fuses the magnetometer."""
    if MAG.noise not in replay.settings or isinstance(ekf2.record, Unavailable):
        return None
    logged = ekf2.record.delayed
    logged = logged[inside_spans(logged.index, replay.judged_s)]
    if logged.empty:
        return None
    replayed_heading = replay.delayed["heading_rad"]
    error = np.interp(
        logged.index, replayed_heading.index, np.unwrap(replayed_heading)
    ) - heading_rad(logged)
    return float(np.degrees(rms(np.angle(np.exp(1j * error)))))


def _constant(logged: pd.DataFrame, model: pd.DataFrame, axes: Iterable[AxisName]) -> bool:
    """Return True if the innovations of an axis are all equal: they have no correlation."""
    columns = [f"innovation_{axis}_m" for axis in axes]
    return not all(np.ptp(one[columns], axis=0).all() for one in (logged, model))


def _velocity_agreement(
    ekf2: Ekf2, replay: Ekf2Replay, *, own: bool
) -> tuple[dict[str, AxisAgreement], bool]:
    """Agreement of the velocity of GNSS, and whether there is none for constant innovations.

    Empty where it is not fused or not logged.
    """
    log = ekf2.aids.get("gnss_vel")
    if log is None or VELOCITY_UPDATE_COLUMNS[0] not in replay.updates:
        return {}, False
    logged, model = _matched_samples(replay, replay.updates, log.samples, own=own)
    if len(logged) < MIN_SAMPLES:
        return {}, False
    names: dict[str, str] = {}  # those of a position
    for axis in AXIS_NAMES:
        nu, S = f"innovation_{axis}_m", f"innovation_variance_{axis}_m2"
        names |= {f"{nu}_s": nu, f"{S}_s2": S, f"innovation_{axis}": nu, f"variance_{axis}": S}
    logged = logged.rename(columns=names)
    model = model[VELOCITY_UPDATE_COLUMNS].rename(columns=names)
    # down where the height is no longer EKF2's own
    axes = AXIS_NAMES if GNSS_HGT.name in replay.other_aid_updates else HORIZONTAL
    if _constant(logged, model, axes):
        return {}, True
    return {axis: _axis_agreement(axis, logged, model, ekf2, replay) for axis in axes}, False


def _other_agreements(ekf2: Ekf2, replay: Ekf2Replay) -> tuple[dict[str, Any], dict[str, str]]:
    """Agreement of what was fused besides, and which of these aids do not agree, and why."""
    agreements: dict[str, dict[str, AxisAgreement]] = {}
    doubtful = {}
    for name, updates in replay.other_aid_updates.items():
        log = ekf2.aids[name]
        own = aid_source(AIDS[name]) in log.topics
        rows = logged_aid_innovations(name, log)
        logged, model = _matched_samples(replay, updates, rows, own=own)
        if len(logged) < MIN_SAMPLES:
            doubtful[name] = f"{len(logged)} logged innovations are too few to compare with"
            continue
        if _constant(logged, model, axes_of(updates)):
            doubtful[name] = CONSTANT
            continue
        agreements[name] = {
            axis: _axis_agreement(axis, logged, model, ekf2, replay) for axis in axes_of(updates)
        }
        shares = (float(np.mean(frame["rejected"] > 0.0)) for frame in (logged, model))
        good, reason = _agreement_verdict(agreements[name], *shares)
        if not good:
            doubtful[name] = reason
    return agreements, doubtful


def logged_aid_innovations(name: str, log: AidLog) -> pd.DataFrame:
    """Innovations, variances and rejections of an aid that is fused besides, by PX4's name."""
    gate = log.parameters.get(AIDS[name].gate, AIDS[name].default_gate)
    axes = [axis for axis in AXIS_NAMES if axis in log.axes]
    return _columns_by_axis({axis: innovations_along(log, axis, gate) for axis in axes})


def axes_of(updates: pd.DataFrame) -> list[AxisName]:
    """Along which axes there are innovations of position."""
    return [axis for axis in AXIS_NAMES if f"innovation_{axis}_m" in updates]


def _matched_samples(
    replay: Ekf2Replay, updates: pd.DataFrame, logged: pd.DataFrame, *, own: bool
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """The logged innovations that are judged, and the updates of the same samples."""
    matched = match_updates(updates, logged.index.to_numpy(), own=own)
    is_used = (matched >= 0) & inside_spans(logged.index, replay.judged_s)
    return logged[is_used], updates.iloc[matched[is_used]]


def logged_innovations(ekf2: Ekf2) -> pd.DataFrame:
    """Innovations, variances and rejections of north and east, one row per logged sample."""
    return _columns_by_axis({axis: ekf2.innovations[axis] for axis in HORIZONTAL})


def _columns_by_axis(innovations: Mapping[AxisName, pd.DataFrame | Unavailable]) -> pd.DataFrame:
    columns = {}
    for axis, frame in innovations.items():
        if isinstance(frame, Unavailable):
            return pd.DataFrame()
        columns[f"innovation_{axis}_m"] = frame["innovation_m"]
        columns[f"innovation_variance_{axis}_m2"] = frame["innovation_variance_m2"]
        columns["rejected"] = frame["rejected"]
    return pd.DataFrame(columns).dropna()


def inside_spans(times_s: ArrayLike, spans: Spans) -> BoolArray:
    """Which times lie in one of some spans."""
    times = np.asarray(times_s)
    is_inside = np.zeros(times.shape, bool)
    for start, end in spans:
        is_inside |= (times > start) & (times < end)
    return is_inside


def match_updates(updates: pd.DataFrame, times: Array, *, own: bool) -> IntArray:
    """Row of the updates of each logged innovation; -1 where there is none.

    ``own``: of the aid's own topic, which has the times of measurement.
    """
    if own:
        return same_sample(updates.index.to_numpy(), times)
    fused_at = updates["fused_at_s"].to_numpy()
    row = np.searchsorted(fused_at, times + 1e-4, side="right") - 1
    age = times - fused_at[np.maximum(row, 0)]
    return np.where((row >= 0) & (age <= MAX_REPEAT_S), row, -1)


def _axis_agreement(
    axis: AxisName, log: pd.DataFrame, model: pd.DataFrame, ekf2: Ekf2, replay: Ekf2Replay
) -> AxisAgreement:
    nu, nu_log = (frame[f"innovation_{axis}_m"].to_numpy() for frame in (model, log))
    s, s_log = (frame[f"innovation_variance_{axis}_m2"].to_numpy() for frame in (model, log))
    low, middle, high = np.percentile(s / s_log, [5, 50, 95])
    times = ekf2.state.index[inside_spans(ekf2.state.index, replay.judged_s)].to_numpy()
    direction = np.eye(3)[AXIS_NAMES.index(axis)]
    position, velocity = (
        along(replay.published, columns, direction, times)
        - along(ekf2.state, columns, direction, times)
        for columns in (Columns.POSITION, Columns.VELOCITY)
    )
    return AxisAgreement(
        innovation_correlation=float(np.corrcoef(nu, nu_log)[0, 1]),
        innovation_rms_difference=rms(nu - nu_log),
        s_ratio_median=float(middle),
        s_ratio_p5=float(low),
        s_ratio_p95=float(high),
        nis_mean_logged=float(np.mean(nu_log**2 / s_log)),
        nis_mean_replayed=float(np.mean(nu**2 / s)),
        position_rms_difference_m=rms(position),
        velocity_rms_difference_m_s=rms(velocity),
    )


def along(frame: pd.DataFrame, columns: list[str], direction: Array, times: Array) -> Array:
    """Columns of a time-indexed frame, interpolated, along a direction."""
    summed = signals.along(frame, columns, direction[: len(columns)])
    return np.asarray(np.interp(times, frame.index, summed))


def rms_to_truth(flight: Flight, position: Array, direction: Array, times: Array) -> float | None:
    """Error of a position (m, RMS) along a direction in the truth's span; None without truth."""
    if not isinstance(flight.truth, Truth):
        return None
    needed = Columns.POSITION[2:] if direction[2] else Columns.POSITION[:2]
    truth = flight.truth.samples.dropna(subset=needed)
    if truth.empty:
        return None
    is_inside = (times >= truth.index[0]) & (times <= truth.index[-1])
    error = (position - along(truth, Columns.POSITION, direction, times))[is_inside]
    return rms(error) if len(error) else None


def rms(values: Array) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(values**2)))


def _agreement_verdict(
    axes: Mapping[str, AxisAgreement],
    logged_share: float,
    replayed_share: float,
    published_factor: float = 1.0,
) -> tuple[bool, str]:
    """Whether a replay may be believed, and why or why not; ``published_factor`` is what it publishes."""
    ratio = max((axis.s_ratio_median for axis in axes.values()), key=lambda s: abs(s - 1.0))
    if abs(ratio - 1.0) > MAX_S_DIFFERENCE:
        return False, (
            f"the replayed innovation variance is {ratio:.2f} of the logged one (at most "
            f"{MAX_S_DIFFERENCE:.0%} off): EKF2 had other samples than the log holds"
        )
    min_correlation = min(axis.innovation_correlation for axis in axes.values())
    correlated = f"replayed and logged innovations correlate by {min_correlation:.4f}"
    if min_correlation >= MIN_CORRELATION:
        off_m = max(axis.position_rms_difference_m for axis in axes.values())
        most_m = published_factor * MAX_PUBLISHED_DIFFERENCE_M
        if off_m > most_m:
            return False, (
                "the innovations agree, but what is published is "
                f"{_format_beyond(off_m, most_m)} m off the log (RMS; at most {most_m:g} m): EKF2's "
                "output is not of this filter alone"
            )
        return True, f"{correlated} or better"
    if max(logged_share, replayed_share) < REJECTING_SHARE:
        return False, f"{correlated} only (at least {MIN_CORRELATION:g})"
    rejected_difference = abs(replayed_share - logged_share)
    nis = max(abs(a.nis_mean_replayed / a.nis_mean_logged - 1.0) for a in axes.values())
    text = (
        f"{replayed_share:.1%} of the samples are rejected, {logged_share:.1%} in the log, and "
        f"mean NIS differs by {nis:.0%}"
    )
    if rejected_difference > MAX_REJECTED_DIFFERENCE or nis > MAX_NIS_DIFFERENCE:
        return (
            False,
            f"{text} (at most {MAX_REJECTED_DIFFERENCE:.0%} and {MAX_NIS_DIFFERENCE:.0%} are allowed)",
        )
    return True, f"{text}; single samples part, since each rejection decides the next"


def _format_beyond(value: float, most: float) -> str:
    """A value beyond what is allowed, with two decimals, or as many as it takes to show that."""
    return next(f"{value:.{n}f}" for n in range(2, 17) if round(value, n) > most or n == 16)


def with_logged_rejections(
    agreement: Agreement, logged_rejections_agreement: Agreement, *, has_all_decisions: bool
) -> Agreement:
    """The verdict where EKF2 rejects much: of a replay that rejects what EKF2 rejected.

    By its own gate the replay parts from the log where one sample lies on the edge, and each
    rejection decides the next; that says nothing of the filter.

    Parameters
    ----------
    agreement, logged_rejections_agreement : Agreement
        Of the replay by its own gate, and of the other.
    has_all_decisions : bool
        Whether what EKF2 did with every sample is known: then all else is of the other one too.
    """
    good, reason = _agreement_verdict(
        logged_rejections_agreement.axes, 0.0, 0.0, REJECTING_TOLERANCE_FACTOR
    )
    return replace(
        logged_rejections_agreement if has_all_decisions else agreement,
        rejected_share_replayed=agreement.rejected_share_replayed,
        decisions_same=agreement.decisions_same,
        good=good,
        reason=f"with EKF2's own rejections, {reason}",
    )
