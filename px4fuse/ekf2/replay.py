"""Result of an EKF2 replay, and agreement of the replay with the log."""

import math
from collections.abc import Mapping
from typing import Any, TypeVar

import numpy as np
import pandas as pd
from msgspec.structs import replace
from numpy.typing import ArrayLike

from px4fuse.core.arrays import Array, BoolArray, IntArray, rms
from px4fuse.core.record import (
    NOT_IN_JSON,
    Correlation,
    Count,
    NonNegativeFloat,
    NotInJson,
    PositiveFloat,
    Record,
    Share,
)
from px4fuse.core.text import format_count
from px4fuse.filter import signals
from px4fuse.filter.frame_rotation import heading_rad
from px4fuse.flight.ekf2_parameters import AIDS, BAROMETER, FLOW, GNSS_VEL, MAG
from px4fuse.flight.model import (
    AXIS_NAMES,
    AidLog,
    Columns,
    Ekf2,
    Flight,
    NedAxis,
    Spans,
    Truth,
    Unavailable,
)
from px4fuse.readers.px4_innovations import select_axis_innovations

from .inputs import (
    ANALYSIS_NAME,
    find_matching_samples,
    find_replayed_position_source,
    innovation_topic,
)
from .replay_segments import REPLAY_SETTLING_S

T = TypeVar("T", pd.DataFrame, pd.Series)
HORIZONTAL_AXES: tuple[NedAxis, NedAxis] = ("north", "east")
# Minimum number of logged innovations for a comparison with the EKF2 replay
MIN_COMPARED_INNOVATIONS = 20
CONSTANT_INNOVATIONS_REASON = "the logged or replayed innovations are constant"
# Maximum time (s) from an update to its logged innovation (estimator_innovations)
MAX_INNOVATION_AGE_S = 0.5
# Maximum time difference (s) of two events in one prediction step
SAME_STEP_TOLERANCE_S = 0.002
# Minimum correlation of replayed and logged innovations: above 0.997 with complete logs
# (tests/benchmarks/bench_ekf2.py)
MIN_INNOVATION_CORRELATION = 0.95
# Maximum |median of (S replayed / S logged) - 1|: below 0.003 with complete logs
MAX_INNOVATION_VARIANCE_RATIO_DEVIATION = 0.05
# Maximum RMS difference (m) of replayed and logged position: below 0.013 m with complete logs
MAX_POSITION_DIFFERENCE_FROM_LOG_M = 0.10
# Maximum position difference (m) between replay and log while EKF2 fuses only optical flow
# horizontally
MAX_FLOW_ONLY_DIFFERENCE_M = 0.5
# If EKF2 rejects more than this fraction of the positions, replayed and logged innovations need not
# correlate: one different rejection changes all later innovations. Rejected fraction and mean NIS
# are compared instead
MAX_REJECTED_FRACTION_FOR_COMPARISON = 0.05
# If EKF2 rejects more than this fraction of the positions, EKF2's position is mostly integrated
# from the IMU
MOSTLY_REJECTED_FRACTION = 0.5
# Minimum correlation of replayed and logged innovations if EKF2 rejects more than
# MOSTLY_REJECTED_FRACTION of the positions
MIN_INNOVATION_CORRELATION_IF_MOSTLY_REJECTED = 0.99
# Maximum difference between the rejected fractions of positions in replay and log. It is tested if
# the innovations do not correlate and many positions are rejected
MAX_REJECTED_FRACTION_DIFFERENCE = 0.05
# Maximum relative difference of the mean NIS in replay and log, if they agree
MAX_RELATIVE_NIS_DIFFERENCE = 0.25
# Factor on MAX_POSITION_DIFFERENCE_FROM_LOG_M for flights with many rejections
DIFFERENCE_FACTOR_WITH_MANY_REJECTIONS = 3.0


class AxisAgreement(Record, kw_only=True):
    """Agreement of the EKF2 replay with the log along one axis.

    Attributes
    ----------
    innovation_correlation : float
        Correlation of replayed and logged innovations.
    innovation_rms_difference : float
        RMS of replayed minus logged innovations.
    s_ratio_median, s_ratio_p5, s_ratio_p95 : float
        Ratio of replayed to logged innovation variance: median, 5 and 95 % quantiles.
    position_rms_difference_m, velocity_rms_difference_m_s : float
        RMS difference between the replayed and the logged state.
    """

    innovation_correlation: Correlation
    innovation_rms_difference: NonNegativeFloat
    s_ratio_median: PositiveFloat
    s_ratio_p5: PositiveFloat
    s_ratio_p95: PositiveFloat
    nis_mean_logged: NonNegativeFloat
    nis_mean_replayed: NonNegativeFloat
    position_rms_difference_m: NonNegativeFloat
    velocity_rms_difference_m_s: NonNegativeFloat


class ReplayAgreement(Record, kw_only=True):
    """Agreement of the EKF2 replay with the log.

    Attributes
    ----------
    north, east : AxisAgreement
        Innovations of the horizontal position source.
    ev_pos, gnss_pos, gnss_vel, gnss_hgt, baro_hgt : mapping from axis to AxisAgreement
        Innovations of each aiding source, by PX4's name.
    samples : int
        Number of compared innovations.
    decisions_same : float
        Fraction of samples that EKF2 and replay both rejected or both accepted.
    published_rms_difference_m : float
        RMS difference between replayed and logged horizontal position, as published.
    heading_rms_difference_deg : float or None
        RMS difference between replayed and logged heading; None if the replay uses the logged
        heading.
    carried_difference_m : float or None
        Largest horizontal difference between replayed and logged position in the time with optical
        flow as the only horizontal aiding source.
    doubtful : mapping from PX4's name of an aiding source to str
        Aiding sources that do not agree with the log, and the reasons.
    good : bool
        True if the replay agrees with the log.
    reason : str
        Statistics on which ``good`` is based.
    """

    north: AxisAgreement
    east: AxisAgreement
    ev_pos: Mapping[str, AxisAgreement] = {}
    gnss_pos: Mapping[str, AxisAgreement] = {}
    gnss_vel: Mapping[str, AxisAgreement] = {}
    gnss_hgt: Mapping[str, AxisAgreement] = {}
    baro_hgt: Mapping[str, AxisAgreement] = {}
    samples: Count
    rejected_fraction_logged: Share
    rejected_fraction_replayed: Share
    decisions_same: Share
    published_rms_difference_m: NonNegativeFloat
    good: bool
    reason: str
    heading_rms_difference_deg: NonNegativeFloat | None = None
    carried_difference_m: NonNegativeFloat | None = None
    doubtful: Mapping[str, str] = {}

    @property
    def axes(self) -> Mapping[str, AxisAgreement]:
        """Agreement of replayed and logged position innovations, by horizontal axis."""
        return {"north": self.north, "east": self.east}

    def report_disagreement(self, result_name: str) -> Unavailable:
        """Return Unavailable for a result that needs an EKF2 replay that agrees with the log."""
        profile = "SDLOG_PROFILE 129 (default and vision)"
        if self.gnss_pos:
            profile = "SDLOG_PROFILE 3 (default and full rates)"
        return Unavailable(
            result_name,
            f"the EKF2 replay does not agree with the log: {self.reason}",
            f"Record without dropouts and with {profile}.",
        )


class Ekf2Replay(Record, kw_only=True, omit_defaults=False):
    """Replay of EKF2 with one set of parameters.

    Attributes
    ----------
    source : str
        Name of the position source.
    stretches_s : tuple of (float, float)
        Start and end of each replayed part of the flight.
    settings : mapping
        EKF2 parameters, by PX4 name.
    late, lost : int
        Number of samples that were fused late, and number of samples too late to be fused.
    updates : DataFrame
        One row per position sample, at EKF2's measurement time.
    other_aid_updates : mapping from PX4's name to DataFrame
        Updates with each of the other aiding sources.
    optical_flow_only_spans_s : tuple of (float, float)
        Times with optical flow as the only horizontal source.
    delayed_state, published_state : DataFrame
        State (NED) at the fusion horizon, and as published.
    """

    source: str
    stretches_s: Spans
    settings: Mapping[str, float]
    late: Count = 0
    lost: Count = 0
    agreement: ReplayAgreement | None = None
    changed_parameters: NotInJson[Mapping[str, float]] = NOT_IN_JSON
    updates: NotInJson[pd.DataFrame] = NOT_IN_JSON
    delayed_state: NotInJson[pd.DataFrame] = NOT_IN_JSON
    published_state: NotInJson[pd.DataFrame] = NOT_IN_JSON
    other_aid_updates: NotInJson[Mapping[str, pd.DataFrame]] = NOT_IN_JSON
    optical_flow_only_spans_s: NotInJson[Spans] = NOT_IN_JSON

    def find_evaluated_spans(self) -> Spans:
        """Return the time spans (s) in which the replay is compared with the log.

        The first REPLAY_SETTLING_S of each replayed part are excluded.
        """
        evaluated_spans_s = []
        for start, end in self.stretches_s:
            begin_s = start + REPLAY_SETTLING_S
            for flow_start, flow_end in self.optical_flow_only_spans_s:
                if begin_s < flow_start < end:
                    evaluated_spans_s.append((begin_s, flow_start))
                    begin_s = flow_end + REPLAY_SETTLING_S
            if begin_s < end:
                evaluated_spans_s.append((begin_s, end))
        return tuple(evaluated_spans_s)


def compare_with_log(flight: Flight, replay: Ekf2Replay) -> ReplayAgreement | Unavailable:
    """Compare an EKF2 replay with the logged innovations and states."""
    ekf2 = flight.ekf2
    assert isinstance(ekf2, Ekf2)
    state_difference = subtract_states(
        replay.published_state, rows_inside(ekf2.state, replay.find_evaluated_spans())
    )
    if state_difference.empty:
        return Unavailable(
            ANALYSIS_NAME,
            "EKF2's position is not logged in the replayed time",
            "Record vehicle_local_position during the whole flight.",
        )
    aid = find_replayed_position_source(ekf2)
    comparison = _compare_innovations(
        replay,
        replay.updates,
        logged_innovations(ekf2),
        innovation_topic(aid) in ekf2.innovation_topics,
        state_difference,
    )
    if isinstance(comparison, str):
        return Unavailable(
            ANALYSIS_NAME,
            comparison,
            "Record a longer flight with motion, with SDLOG_PROFILE bit 0 (default).",
        )
    agreement_by_axis, agreement_statistics = comparison
    agreement_by_aid, omitted_aids = _compare_other_aids(ekf2, replay, state_difference)
    agreement_by_aid[aid.name] = agreement_by_axis
    # While EKF2 fuses only optical flow, position errors accumulate. Replay and log are therefore
    # compared by their largest position difference
    flow_only_difference = subtract_states(
        replay.published_state, rows_inside(ekf2.state, replay.optical_flow_only_spans_s)
    )
    flow_position_difference_m = None
    if len(flow_only_difference):
        flow_position_difference_m = float(
            np.hypot(flow_only_difference["north_m"], flow_only_difference["east_m"]).max()
        )
        if flow_position_difference_m > MAX_FLOW_ONLY_DIFFERENCE_M:
            omitted_aids[FLOW.name] = (
                f"while {FLOW.label} was the only horizontal aiding source, replayed and logged "
                "positions differed by "
                f"{_format_unlike_limit(flow_position_difference_m, MAX_FLOW_ONLY_DIFFERENCE_M)} m "
                f"(limit {MAX_FLOW_ONLY_DIFFERENCE_M:g} m)"
            )
    # The keys of the three mappings are field names of ReplayAgreement
    return ReplayAgreement(
        **agreement_by_axis,
        **agreement_by_aid,
        **agreement_statistics,
        doubtful=omitted_aids,
        published_rms_difference_m=math.hypot(
            *(axis.position_rms_difference_m for axis in agreement_by_axis.values())
        ),
        heading_rms_difference_deg=_compute_heading_difference_deg(ekf2, replay),
        carried_difference_m=flow_position_difference_m,
    )


def _compare_innovations(
    replay: Ekf2Replay,
    replayed_innovations: pd.DataFrame,
    logged_innovations: pd.DataFrame,
    has_logged_measurement_times: bool,
    state_difference: pd.DataFrame,
) -> tuple[dict[str, Any], dict[str, Any]] | str:
    """Compare replayed with logged innovations.

    Return :class:`AxisAgreement` by axis, and fields of :class:`ReplayAgreement` for all axes
    together; or the reason why the innovations cannot be compared.
    """
    # 1. Pairs of logged and replayed innovations in the evaluated time, row by row
    update_rows = match_updates(
        replayed_innovations,
        logged_innovations.index.to_numpy(),
        has_logged_measurement_times=has_logged_measurement_times,
    )
    is_used = (update_rows >= 0) & is_inside_spans(
        logged_innovations.index, replay.find_evaluated_spans()
    )
    axes = list_innovation_axes(replayed_innovations)
    columns = [f"innovation_{axis}_m" for axis in axes]
    # If EKF2 resets its state to a sample, it logs innovation 0
    is_used &= logged_innovations[columns].any(axis=1)
    logged_innovations = logged_innovations[is_used]
    replayed_innovations = replayed_innovations.iloc[update_rows[is_used]]
    # 2. Reasons against a comparison
    if len(logged_innovations) < MIN_COMPARED_INNOVATIONS:
        return (
            f"the log contains only {format_count(len(logged_innovations), 'innovation')} in the "
            f"replayed time (at least {MIN_COMPARED_INNOVATIONS} are needed)"
        )
    # A constant innovation has no correlation
    for innovations in (logged_innovations, replayed_innovations):
        if not np.ptp(innovations[columns], axis=0).all():
            return CONSTANT_INNOVATIONS_REASON
    # 3. Comparison
    agreement_by_axis: dict[str, Any] = {
        axis: _compare_axis(axis, logged_innovations, replayed_innovations, state_difference)
        for axis in axes
    }
    is_rejected_logged = logged_innovations["rejected"].to_numpy() > 0.0
    is_rejected_replayed = replayed_innovations["rejected"].to_numpy() > 0.0
    rejected_fractions = float(is_rejected_logged.mean()), float(is_rejected_replayed.mean())
    is_in_agreement, reason = _judge_agreement(agreement_by_axis, *rejected_fractions)
    return agreement_by_axis, {
        "samples": len(logged_innovations),
        "rejected_fraction_logged": rejected_fractions[0],
        "rejected_fraction_replayed": rejected_fractions[1],
        "decisions_same": float(np.mean(is_rejected_logged == is_rejected_replayed)),
        "good": is_in_agreement,
        "reason": reason,
    }


def subtract_states(state: pd.DataFrame, reference: pd.DataFrame) -> pd.DataFrame:
    """Return a state minus a reference state, at the times of the reference."""
    return pd.DataFrame(
        {
            name: np.interp(reference.index, state.index, state[name]) - reference[name]
            for name in Columns.STATE
        }
    )


def _compute_heading_difference_deg(ekf2: Ekf2, replay: Ekf2Replay) -> float | None:
    """Return the RMS difference (°) of replayed and logged heading.

    Return None if the replay does not estimate the heading: it then uses the logged heading.
    """
    # The settings contain magnetometer parameters only if the replay fuses the magnetometer
    if MAG.noise not in replay.settings or isinstance(ekf2.record, Unavailable):
        return None
    logged_state = rows_inside(ekf2.record.delayed_state, replay.find_evaluated_spans())
    if logged_state.empty:
        return None
    replayed_heading_rad = replay.delayed_state["heading_rad"]
    heading_at_log_times_rad = np.interp(
        logged_state.index, replayed_heading_rad.index, np.unwrap(replayed_heading_rad)
    )
    heading_difference_rad = np.angle(
        np.exp(1j * (heading_at_log_times_rad - heading_rad(logged_state)))
    )
    return float(np.degrees(rms(heading_difference_rad)))


def _compare_other_aids(
    ekf2: Ekf2, replay: Ekf2Replay, state_difference: pd.DataFrame
) -> tuple[dict[str, Any], dict[str, str]]:
    """Compare innovations of all aiding sources except the position source with the log.

    Return the agreement of each source by axis, and the reasons to omit a source from the replay.
    """
    agreement_by_aid: dict[str, Any] = {}
    omitted_aids = {}
    for name, updates in replay.other_aid_updates.items():
        if (aid_log := ekf2.aids.get(name)) is None:
            continue
        # If the log contains no measurement times, replayed and logged innovations are matched by
        # fusion time. The replay fuses barometer samples later than EKF2, so they are matched by
        # measurement time
        times_s = updates.index if name == BAROMETER.name else updates["fused_at_s"]
        comparison = _compare_innovations(
            replay,
            updates.assign(fused_at_s=times_s),
            select_logged_aid_innovations(name, aid_log),
            innovation_topic(AIDS[name]) in aid_log.topics,
            state_difference,
        )
        reason = ""
        if isinstance(comparison, str):
            reason = comparison
        else:
            agreement_by_aid[name], agreement_statistics = comparison
            if not agreement_statistics["good"]:
                reason = agreement_statistics["reason"]
        # GNSS velocity is omitted only if its innovations are constant, as those of a frozen sensor
        if reason and (name != GNSS_VEL.name or reason == CONSTANT_INNOVATIONS_REASON):
            omitted_aids[name] = reason
    return agreement_by_aid, omitted_aids


def select_logged_aid_innovations(name: str, aid_log: AidLog) -> pd.DataFrame:
    """Return logged innovations, S and rejections of an aiding source (PX4's name)."""
    gate = aid_log.parameters.get(AIDS[name].gate, AIDS[name].default_gate)
    axes = [axis for axis in AXIS_NAMES if axis in aid_log.axes]
    return _join_axis_innovations(
        {axis: select_axis_innovations(aid_log, axis, gate) for axis in axes}
    )


def list_innovation_axes(updates: pd.DataFrame) -> list[NedAxis]:
    return [axis for axis in AXIS_NAMES if f"innovation_{axis}_m" in updates]


def logged_innovations(ekf2: Ekf2) -> pd.DataFrame:
    """Return the logged position innovations north and east, with S and rejections."""
    return _join_axis_innovations({axis: ekf2.innovations[axis] for axis in HORIZONTAL_AXES})


def _join_axis_innovations(
    innovations: Mapping[NedAxis, pd.DataFrame | Unavailable],
) -> pd.DataFrame:
    """Return one table with the innovations of all axes; empty if an axis is not logged."""
    columns = {}
    for axis, axis_innovations in innovations.items():
        if isinstance(axis_innovations, Unavailable):
            return pd.DataFrame()
        columns[f"innovation_{axis}_m"] = axis_innovations["innovation_m"]
        columns[f"innovation_variance_{axis}_m2"] = axis_innovations["innovation_variance_m2"]
        # The flag is the same for all axes of a sample
        columns["rejected"] = axis_innovations["rejected"]
    return pd.DataFrame(columns).dropna()


def is_inside_spans(times_s: ArrayLike, spans_s: Spans) -> BoolArray:
    """Return True for each time that is inside one of the time spans."""
    times_array_s = np.asarray(times_s)
    is_inside = np.zeros(times_array_s.shape, bool)
    for start, end in spans_s:
        is_inside |= (times_array_s > start) & (times_array_s < end)
    return is_inside


def rows_inside(table: T, spans_s: Spans) -> T:
    """Return the rows of a table inside the time spans; the table index is time (s)."""
    return table[is_inside_spans(table.index, spans_s)]


def match_updates(
    updates: pd.DataFrame, logged_times_s: Array, *, has_logged_measurement_times: bool
) -> IntArray:
    """Return for each logged innovation the row of its replayed update, or -1.

    ``has_logged_measurement_times`` is True for estimator_aid_src topics.
    """
    if has_logged_measurement_times:
        return find_matching_samples(updates.index.to_numpy(), logged_times_s)
    # The log contains EKF2's innovations at the logging times: those of the latest update. 0.1 ms
    # allows for rounding errors of times
    fusion_times_s = updates["fused_at_s"].to_numpy()
    update_rows = np.searchsorted(fusion_times_s, logged_times_s + 1e-4, side="right") - 1
    age_s = logged_times_s - fusion_times_s[np.maximum(update_rows, 0)]
    is_matched = (update_rows >= 0) & (age_s <= MAX_INNOVATION_AGE_S)
    # A log row in the same prediction step as a fusion may still contain the previous innovation.
    # Omit such rows, if more than half of the rows remain
    is_unambiguous = is_matched & (age_s >= SAME_STEP_TOLERANCE_S)
    if is_unambiguous.sum() > 0.5 * is_matched.sum():
        is_matched = is_unambiguous
    return np.where(is_matched, update_rows, -1)


def _compare_axis(
    axis: NedAxis,
    logged_innovations: pd.DataFrame,
    replayed_innovations: pd.DataFrame,
    state_difference: pd.DataFrame,
) -> AxisAgreement:
    """Return the agreement of replay and log along one axis."""
    # The inner loop is over replay and log: replayed and logged innovation, then replayed and
    # logged innovation variance
    nu, nu_logged, S, S_logged = (
        innovations[name].to_numpy()
        for name in (f"innovation_{axis}_m", f"innovation_variance_{axis}_m2")
        for innovations in (replayed_innovations, logged_innovations)
    )
    s_ratio_p5, s_ratio_median, s_ratio_p95 = np.percentile(S / S_logged, [5, 50, 95]).tolist()
    return AxisAgreement(
        innovation_correlation=float(np.corrcoef(nu, nu_logged)[0, 1]),
        innovation_rms_difference=rms(nu - nu_logged),
        s_ratio_median=s_ratio_median,
        s_ratio_p5=s_ratio_p5,
        s_ratio_p95=s_ratio_p95,
        nis_mean_logged=float(np.mean(nu_logged**2 / S_logged)),
        nis_mean_replayed=float(np.mean(nu**2 / S)),
        position_rms_difference_m=rms(state_difference[f"{axis}_m"]),
        velocity_rms_difference_m_s=rms(state_difference[f"{axis}_m_s"]),
    )


def interpolate_component(
    vectors: pd.DataFrame, columns: list[str], direction: Array, times_s: Array
) -> Array:
    """Interpolate the component of a vector (NED columns) along a direction."""
    component = signals.weighted_sum(vectors, columns, direction[: len(columns)])
    return np.interp(times_s, vectors.index, component)


def compute_rmse_to_truth(
    flight: Flight, position_m: Array, direction: Array, times_s: Array
) -> float | None:
    """Return the position RMSE (m) along a direction; None without ground truth."""
    if not isinstance(flight.truth, Truth):
        return None
    samples = flight.truth.samples
    true_component_m = signals.weighted_sum(samples, Columns.POSITION, direction)
    is_known = np.isfinite(true_component_m)
    if not is_known.any():
        return None
    true_position_m = np.interp(
        times_s, samples.index[is_known], true_component_m[is_known], np.nan, np.nan
    )
    error_m = (position_m - true_position_m)[np.isfinite(true_position_m)]
    return rms(error_m) if len(error_m) else None


def _judge_agreement(
    axes: Mapping[str, AxisAgreement],
    rejected_fraction_logged: float,
    rejected_fraction_replayed: float,
    tolerance_factor: float = 1.0,
    min_allowed_correlation: float = MIN_INNOVATION_CORRELATION,
) -> tuple[bool, str]:
    """Return True if the replay agrees with the log, and the statistics or the reason as a text.

    1. The innovation variances must agree, because they hardly depend on single rejections.
    2. If the correlation of the innovations is at least the minimum, the positions must agree.
    3. If the correlation is smaller and few samples are rejected, the replay does not agree.
    4. If the correlation is smaller and many samples are rejected, rejected fraction and mean NIS
       must agree. One different rejection changes all later innovations.

    ``tolerance_factor`` multiplies the maximum position difference.
    """
    # 1. Innovation variances
    variance_ratios = (axis.s_ratio_median for axis in axes.values())
    worst_variance_ratio = max(variance_ratios, key=lambda s_ratio: abs(s_ratio - 1.0))
    if abs(worst_variance_ratio - 1.0) > MAX_INNOVATION_VARIANCE_RATIO_DEVIATION:
        return False, (
            "the innovation variance S of the replay is "
            f"{worst_variance_ratio:.2f} times the logged S "
            f"(limit 1 ± {MAX_INNOVATION_VARIANCE_RATIO_DEVIATION:.2f}): "
            "EKF2 fused samples that are not in the log"
        )
    # 2. Correlation of the innovations (smallest of all axes), and position difference
    min_correlation = min(axis.innovation_correlation for axis in axes.values())
    correlation_text = (
        f"replayed and logged innovations have a correlation of {min_correlation:.4f}"
    )
    if min_correlation >= min_allowed_correlation:
        difference_m = max(axis.position_rms_difference_m for axis in axes.values())
        max_difference_m = tolerance_factor * MAX_POSITION_DIFFERENCE_FROM_LOG_M
        if difference_m > max_difference_m:
            return False, (
                "the innovations agree with the log, but replayed and logged positions differ by "
                f"{_format_unlike_limit(difference_m, max_difference_m)} m RMS "
                f"(limit {max_difference_m:g} m): the log lacks data of EKF2's output predictor"
            )
        return True, correlation_text
    # 3. Rejections
    if (
        max(rejected_fraction_logged, rejected_fraction_replayed)
        < MAX_REJECTED_FRACTION_FOR_COMPARISON
    ):
        return False, f"{correlation_text}, below the minimum of {min_allowed_correlation:g}"
    rejected_fraction_difference = abs(rejected_fraction_replayed - rejected_fraction_logged)
    relative_nis_difference = max(
        abs(axis.nis_mean_replayed / axis.nis_mean_logged - 1.0) for axis in axes.values()
    )
    rejection_text = (
        f"the replay rejected {rejected_fraction_replayed:.1%} of the samples, EKF2 rejected "
        f"{rejected_fraction_logged:.1%}; "
        f"the mean NIS differs by {relative_nis_difference:.0%}"
    )
    if (
        rejected_fraction_difference > MAX_REJECTED_FRACTION_DIFFERENCE
        or relative_nis_difference > MAX_RELATIVE_NIS_DIFFERENCE
    ):
        return False, (
            f"{rejection_text} (limits {MAX_REJECTED_FRACTION_DIFFERENCE:.0%} and "
            f"{MAX_RELATIVE_NIS_DIFFERENCE:.0%})"
        )
    return (
        True,
        f"{rejection_text}; replayed and logged innovations are not compared one by one, because "
        "each rejection changes the later innovations",
    )


def _format_unlike_limit(value: float, limit: float) -> str:
    """Format a value with enough decimals to differ from the limit."""
    return next(f"{value:.{n}f}" for n in range(2, 17) if round(value, n) > limit or n == 16)


def judge_agreement_with_logged_rejections(
    agreement: ReplayAgreement, agreement_with_logged_rejections: ReplayAgreement
) -> ReplayAgreement:
    """Judge the agreement of replay and log for a flight in which EKF2 rejected many samples.

    If replay and EKF2 reject different samples, they differ much even with a correct model.
    Therefore a second replay rejects the same samples as EKF2. The result is the agreement of the
    second replay, judged with wider limits; only its numbers of rejections are from the first
    replay.

    Parameters
    ----------
    agreement : ReplayAgreement
        Agreement of the replay that decides itself on rejections.
    agreement_with_logged_rejections : ReplayAgreement
        Agreement of the replay that rejects the same samples as EKF2.
    """
    rejected_fraction = agreement.rejected_fraction_logged
    is_mostly_rejected = rejected_fraction > MOSTLY_REJECTED_FRACTION
    agreement_limits = DIFFERENCE_FACTOR_WITH_MANY_REJECTIONS, MIN_INNOVATION_CORRELATION
    if is_mostly_rejected:
        agreement_limits = np.inf, MIN_INNOVATION_CORRELATION_IF_MOSTLY_REJECTED
    is_in_agreement, reason = _judge_agreement(
        agreement_with_logged_rejections.axes, 0.0, 0.0, *agreement_limits
    )
    reason = f"if the EKF2 replay rejects the same samples as in the log, {reason}"
    if is_mostly_rejected and not is_in_agreement:
        reason = (
            f"{reason}. EKF2 rejected {rejected_fraction:.0%} of the positions and relied on the "
            "IMU. The frame of the position source is probably wrong"
        )
    return replace(
        agreement_with_logged_rejections,
        rejected_fraction_replayed=agreement.rejected_fraction_replayed,
        decisions_same=agreement.decisions_same,
        good=is_in_agreement,
        reason=reason,
    )
