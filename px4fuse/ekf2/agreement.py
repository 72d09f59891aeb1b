"""Replay as flown against log: whether anything may be concluded from replays of a flight."""

from __future__ import annotations

import numpy as np
import pandas as pd
from msgspec.structs import replace
from numpy.typing import ArrayLike

from px4fuse.arrays import Array, BoolArray, IntArray
from px4fuse.ekf2.inputs import aid_source, replayed_aid, same_sample
from px4fuse.ekf2.replay import (
    HORIZONTAL,
    UPDATE_COLUMNS,
    VELOCITY_UPDATE_COLUMNS,
    Agreement,
    AxisAgreement,
    Ekf2Replay,
    Spans,
)
from px4fuse.ekf2.stretches import SETTLING_S
from px4fuse.ekf2_parameters import GNSS_POS
from px4fuse.flight import POSITION_COLUMNS, VELOCITY_COLUMNS, Ekf2, Flight, Truth, Unavailable

MIN_SAMPLES = 20
# The older topics repeat a sample until the next fusion, with the time of a later step
MAX_REPEAT_S = 0.5
# Measured on simulated flights of v1.13 to main: where the log is complete the correlation is
# above 0.997 and the median ratio of S within 0.3 %; with a decimated source or with an IMU with
# dropouts S is off by more than 5 % or the correlation below 0.9 (tests/benchmarks/bench_ekf2.py)
MIN_CORRELATION = 0.95
MAX_S_OFF = 0.05
# Of the position that EKF2 publishes; there it is within 0.013 m
MAX_PUBLISHED_OFF_M = 0.10
# Where EKF2 rejects much, one sample on the edge of the gate decides the next ones: then shares
# and mean NIS must agree, and single samples when the model rejects what EKF2 rejected
REJECTING_SHARE = 0.1
MAX_REJECTED_OFF = 0.05
MAX_NIS_OFF = 0.25
# What is published by a filter that rejects most of its samples wanders further
REJECTING_LOOSER = 3.0


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
    logged = logged_innovations(ekf2)
    matched = match(replay, ekf2, logged.index.to_numpy())
    use = (matched >= 0) & settled(logged.index, judged_from(replay))
    log, model = logged[use], replay.updates.iloc[matched[use]]
    if len(log) < MIN_SAMPLES:
        return Unavailable(
            "EKF2 replay",
            f"{len(log)} logged innovations to compare with are too few (at least {MIN_SAMPLES})",
            "Fly longer on external vision, and record with SDLOG_PROFILE bit 0 (default).",
        )
    columns = [f"innovation_{axis}_m" for axis in HORIZONTAL]
    if not (np.ptp(log[columns], axis=0).all() and np.ptp(model[columns], axis=0).all()):
        return Unavailable(
            "EKF2 replay",
            "the innovations do not vary, so that nothing tells whether they agree",
            "Record a flight with motion and measured positions.",
        )
    axes: dict[str, AxisAgreement]
    axes = {axis: _axis(axis, log, model, ekf2, replay) for axis in HORIZONTAL}
    north, east = axes["north"], axes["east"]
    by_log, by_model = (frame["rejected"].to_numpy() > 0 for frame in (log, model))
    shares = float(by_log.mean()), float(by_model.mean())
    good, reason = _verdict(axes, *shares)
    on_gnss = replayed_aid(ekf2) == GNSS_POS
    apart_m = np.hypot(north.position_rms_difference_m, east.position_rms_difference_m)
    return Agreement(
        north=north,
        east=east,
        ev_pos={} if on_gnss else axes,
        gnss_pos=axes if on_gnss else {},
        gnss_vel=_velocity(ekf2, replay),
        samples=len(log),
        rejected_share_logged=shares[0],
        rejected_share_replayed=shares[1],
        decisions_same=float(np.mean(by_log == by_model)),
        published_rms_difference_m=float(apart_m),
        good=good,
        reason=reason,
    )


def _velocity(ekf2: Ekf2, replay: Ekf2Replay) -> dict[str, AxisAgreement]:
    """Agreement of the velocity of GNSS; empty where it is not fused or not logged."""
    log = ekf2.aids.get("gnss_vel")
    if log is None or VELOCITY_UPDATE_COLUMNS[0] not in replay.updates:
        return {}
    logged = log.samples
    matched = match(replay, ekf2, logged.index.to_numpy())
    use = (matched >= 0) & settled(logged.index, judged_from(replay))
    if use.sum() < MIN_SAMPLES:
        return {}
    # under the names of a position's
    names = dict(zip(VELOCITY_UPDATE_COLUMNS, UPDATE_COLUMNS, strict=False))
    model = replay.updates[VELOCITY_UPDATE_COLUMNS].rename(columns=names).iloc[matched[use]]
    parts = ("innovation_north", "innovation_east", "variance_north", "variance_east")
    renamed = logged[use].rename(columns=dict(zip(parts, UPDATE_COLUMNS, strict=False)))
    return {axis: _axis(axis, renamed, model, ekf2, replay) for axis in HORIZONTAL}


def logged_innovations(ekf2: Ekf2) -> pd.DataFrame:
    """Innovations, variances and rejections of north and east, one row per logged sample."""
    parts = {}
    for axis in HORIZONTAL:
        frame = ekf2.innovations[axis]
        if isinstance(frame, Unavailable):
            return pd.DataFrame()
        parts[f"innovation_{axis}_m"] = frame["innovation_m"]
        parts[f"innovation_variance_{axis}_m2"] = frame["innovation_variance_m2"]
        parts["rejected"] = frame["rejected"]
    return pd.DataFrame(parts).dropna()


def judged_from(replay: Ekf2Replay) -> Spans:
    """Parts of the replay that are judged: each stretch without its beginning."""
    return tuple((start + SETTLING_S, end) for start, end in replay.stretches_s)


def settled(times_s: ArrayLike, judged: Spans) -> BoolArray:
    """Which times lie in one of some spans."""
    times = np.asarray(times_s)
    return np.asarray(np.any([(times > a) & (times < b) for a, b in judged], axis=0))


def match(replay: Ekf2Replay, ekf2: Ekf2, times: Array) -> IntArray:
    """Row of the replay's updates of each logged innovation; -1 where there is none."""
    if aid_source(replayed_aid(ekf2)) in ekf2.innovation_topics:
        return same_sample(replay.updates.index.to_numpy(), times)
    fused_at = replay.updates["fused_at_s"].to_numpy()
    at = np.searchsorted(fused_at, times + 1e-4, side="right") - 1
    age = times - fused_at[np.maximum(at, 0)]
    return np.where((at >= 0) & (age <= MAX_REPEAT_S), at, -1)


def _axis(
    axis: str, log: pd.DataFrame, model: pd.DataFrame, ekf2: Ekf2, replay: Ekf2Replay
) -> AxisAgreement:
    nu, nu_log = (f[f"innovation_{axis}_m"].to_numpy() for f in (model, log))
    s, s_log = (f[f"innovation_variance_{axis}_m2"].to_numpy() for f in (model, log))
    low, middle, high = np.percentile(s / s_log, [5, 50, 95])
    times = ekf2.state.index[settled(ekf2.state.index, judged_from(replay))].to_numpy()
    at = HORIZONTAL.index(axis)
    position, velocity = (
        at_times(replay.published, column, times) - at_times(ekf2.state, column, times)
        for column in (POSITION_COLUMNS[at], VELOCITY_COLUMNS[at])
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


def at_times(frame: pd.DataFrame, column: str, times: Array) -> Array:
    """One column of a time-indexed frame, interpolated."""
    return np.asarray(np.interp(times, frame.index, frame[column]))


def along(frame: pd.DataFrame, columns: list[str], direction: Array, times: Array) -> Array:
    """North and east columns of a time-indexed frame, interpolated, along a direction."""
    north, east = (
        weight * at_times(frame, column, times) if weight else np.zeros(len(times))
        for weight, column in zip(direction[:2], columns[:2], strict=True)
    )
    return np.asarray(north + east)


def rms_to_truth(flight: Flight, position: Array, direction: Array, times: Array) -> float | None:
    """Error of a horizontal position (m, RMS) in the truth's span; None where there is no truth."""
    if not isinstance(flight.truth, Truth):
        return None
    truth = flight.truth.samples.dropna(subset=POSITION_COLUMNS[:2])
    inside = (times >= truth.index[0]) & (times <= truth.index[-1])
    error = (position - along(truth, POSITION_COLUMNS, direction, times))[inside]
    return rms(error) if len(error) else None


def rms(values: Array) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(values**2)))


def _verdict(
    axes: dict[str, AxisAgreement], logged_share: float, replayed_share: float
) -> tuple[bool, str]:
    for axis, found in axes.items():
        if abs(found.s_ratio_median - 1.0) > MAX_S_OFF:
            return False, (
                f"the replayed innovation variance is {found.s_ratio_median:.2f} of the logged one "
                f"({axis}; at most {MAX_S_OFF:.0%} off): EKF2 had other samples than the log holds"
            )
    worst = min(found.innovation_correlation for found in axes.values())
    if worst >= MIN_CORRELATION:
        off_m = max(found.position_rms_difference_m for found in axes.values())
        if off_m > MAX_PUBLISHED_OFF_M:
            return False, (
                f"the innovations agree, but what is published is {off_m:.2f} m off the log (RMS; "
                f"at most {MAX_PUBLISHED_OFF_M:g} m): EKF2's output is not of this filter alone"
            )
        return True, f"replayed and logged innovations correlate by {worst:.4f} or better"
    if max(logged_share, replayed_share) < REJECTING_SHARE:
        return False, (
            f"replayed and logged innovations correlate by {worst:.2f} only (at least "
            f"{MIN_CORRELATION:g})"
        )
    off = abs(replayed_share - logged_share)
    nis = max(abs(a.nis_mean_replayed / a.nis_mean_logged - 1.0) for a in axes.values())
    words = (
        f"{replayed_share:.1%} of the samples are rejected, {logged_share:.1%} in the log, and "
        f"mean NIS differs by {nis:.0%}"
    )
    if off > MAX_REJECTED_OFF or nis > MAX_NIS_OFF:
        return False, f"{words} (at most {MAX_REJECTED_OFF:.0%} and {MAX_NIS_OFF:.0%} are allowed)"
    return True, f"{words}; single samples part, since each rejection decides the next"


def with_obedient(agreement: Agreement, obedient: Agreement) -> Agreement:
    """The verdict where EKF2 rejects much: of a replay that rejects what EKF2 rejected.

    By its own gate the replay parts from the log where one sample lies on the edge, and each
    rejection decides the next; that says nothing of the filter.

    Parameters
    ----------
    agreement, obedient : Agreement
        Of the replay by its own gate, and of the other.
    """
    axes = obedient.axes.values()
    worst = min(axis.innovation_correlation for axis in axes)
    ratio = max((axis.s_ratio_median for axis in axes), key=lambda s: abs(s - 1.0))
    off_m = max(axis.position_rms_difference_m for axis in axes)
    words = (
        f"with EKF2's own rejections the innovations correlate by {worst:.3f} or better, their "
        f"variance is {ratio:.2f} of the logged one, and what is published is {off_m:.2f} m off"
    )
    good = (
        worst >= MIN_CORRELATION
        and abs(ratio - 1.0) <= MAX_S_OFF
        and off_m <= MAX_PUBLISHED_OFF_M * REJECTING_LOOSER
    )
    allowed = (
        f" (at least {MIN_CORRELATION:g}, at most {MAX_S_OFF:.0%} off, and at most "
        f"{MAX_PUBLISHED_OFF_M * REJECTING_LOOSER:g} m)"
    )
    return replace(agreement, good=good, reason=words + ("" if good else allowed))
