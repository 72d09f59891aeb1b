"""EKF2 and ground truth along one axis: resets treated, variances and innovations projected."""

from __future__ import annotations

import numpy as np
import pandas as pd

from px4fuse.arrays import Array
from px4fuse.filter.signals import AISLE, Axis, Segment, along, within
from px4fuse.flight import (
    POSITION_COLUMNS,
    POSITION_VARIANCE_COLUMNS,
    VELOCITY_COLUMNS,
    VELOCITY_VARIANCE_COLUMNS,
    Ekf2,
    Flight,
    PositionTrack,
    Truth,
    Unavailable,
)

# EKF2 never trusts external vision better than this (ev_pos_control.cpp, EKF2.cpp)
EKF2_MIN_NOISE_M = 0.01
MIN_COMMON_SAMPLES = 3
# Undoing resets must bring EKF2 this much closer to the measurements (median squared distance);
# below that the published output, which the vehicle flew on, stands.
CLEARLY_CLOSER = 0.95


def continuous_state(
    ekf2: Ekf2, track: PositionTrack, segment: Segment
) -> tuple[pd.DataFrame, str]:
    """EKF2's state with its resets undone, where undoing them is right.

    A reset that changes EKF2's frame must be undone before positions are compared. A reset that
    moves EKF2 back onto the measurements corrects an error, and undoing it would carry that error
    through the rest of the flight. The measurements decide: the resets are undone where that
    brings the series clearly closer to them (median distance).

    Returns
    -------
    state : DataFrame
        Position and velocity as in :attr:`Ekf2.state`.
    statement : str
        What was done, empty where there was no reset in the segment.
    """
    inside = [r for r in ekf2.resets if segment.start_s < r.time_s <= segment.end_s]
    if not inside:
        return ekf2.state, ""
    state = ekf2.state.copy()
    kept: list[str] = []
    undone: list[str] = []
    groups = (
        ("horizontal position", "position", POSITION_COLUMNS[:2], [0, 1]),
        ("height", "position", POSITION_COLUMNS[2:], [2]),
        ("velocity", "velocity", VELOCITY_COLUMNS, [0, 1, 2]),
    )
    for label, quantity, columns, axes in groups:
        deltas = np.array(
            [[r.delta[axis] if r.quantity == quantity else 0.0 for axis in axes] for r in inside]
        )
        times = np.array([r.time_s for r in inside])
        real = np.any(deltas != 0, axis=1)
        if not real.any():
            continue
        done = kept
        if quantity == "position":  # a velocity has no frame origin to lose
            published = ekf2.state[columns]
            candidate = _undo(published, times[real], deltas[real], track, segment, columns)
            distance = _distance(published, track, segment, columns)
            if _distance(candidate, track, segment, columns) < CLEARLY_CLOSER * distance:
                state[columns] = candidate
                done = undone
        done.append(f"{np.count_nonzero(real)} of {label}")
    said = []
    if undone:
        said.append(f"resets undone: {', '.join(undone)} (they change the frame)")
    if kept:
        said.append(f"resets kept: {', '.join(kept)} (they correct an error)")
    return state, "; ".join(said)


def _undo(
    published: pd.DataFrame,
    times: Array,
    deltas: Array,
    track: PositionTrack,
    segment: Segment,
    columns: list[str],
) -> pd.DataFrame:
    """Continuous position, in the frame of that stretch between resets that fits the track best."""
    after = published.index.to_numpy()[:, None] >= times[None, :]
    candidates = []
    for stretch in range(len(times) + 1):
        # relative to this stretch: resets before it still to come are added, later ones taken away
        shift = (~after[:, :stretch]) @ deltas[:stretch] - after[:, stretch:] @ deltas[stretch:]
        candidates.append(published + shift)
    return min(candidates, key=lambda frame: _distance(frame, track, segment, columns))


def _distance(
    state: pd.DataFrame, track: PositionTrack, segment: Segment, columns: list[str]
) -> float:
    samples = within(track.samples, segment)[columns].dropna()
    squared = np.zeros(len(samples))
    for column in columns:
        squared += (np.interp(samples.index, state.index, state[column]) - samples[column]) ** 2
    return float(np.median(squared)) if len(squared) else float("inf")


def project_state(state: pd.DataFrame, axis: Axis, segment: Segment) -> pd.DataFrame:
    """Position (m) and velocity (m/s) along the axis, within the segment."""
    cut = within(state, segment)
    return pd.DataFrame(
        {
            "position_m": along(cut, POSITION_COLUMNS, axis.direction),
            "velocity_m_s": along(cut, VELOCITY_COLUMNS, axis.direction),
        },
        index=cut.index,
    )


def project_variance(ekf2: Ekf2, axis: Axis, segment: Segment) -> pd.DataFrame | Unavailable:
    """Variances along the axis; EKF2 logs no covariance between axes, so none is added."""
    if isinstance(ekf2.variance, Unavailable):
        return ekf2.variance
    cut = within(ekf2.variance, segment)
    if cut.empty:
        return Unavailable("EKF2 variances", "no sample in the segment", "Analyse more of the log.")
    weights = axis.direction**2
    return pd.DataFrame(
        {
            "position_variance_m2": along(cut, POSITION_VARIANCE_COLUMNS, weights),
            "velocity_variance_m2_s2": along(cut, VELOCITY_VARIANCE_COLUMNS, weights),
        },
        index=cut.index,
    )


def project_innovations(
    flight: Flight, ekf2: Ekf2, track: PositionTrack, axis: Axis, segment: Segment
) -> pd.DataFrame | Unavailable:
    """EKF2's innovations along the axis, with its variances just before and after each update.

    Columns as :attr:`Ekf2.innovations` plus ``prior_variance_m2`` (P⁻ = S - R) and
    ``posterior_variance_m2`` (P⁺ = P⁻R/S, or P⁻ where rejected), NaN where R is unknown.
    """
    if not track.origin.is_vision:
        return Unavailable(
            "EKF2 innovations",
            f"those in the log belong to external vision, not to {track.name}",
            "Choose the source that EKF2 fused (--position-source).",
        )
    if axis.name == AISLE:
        north, east = ekf2.innovations["north"], ekf2.innovations["east"]
        if isinstance(north, Unavailable):
            return north
        if isinstance(east, Unavailable):
            return east
        cut = _innovations_along(within(north, segment), east, axis.direction)
    else:
        frame = next(frame for name, frame in ekf2.innovations.items() if name == axis.name)
        if isinstance(frame, Unavailable):
            return frame
        cut = within(frame, segment).copy()
    if cut.empty:
        return Unavailable(
            "EKF2 innovations", "no sample in the segment", "Analyse more of the log."
        )
    r = cut["observation_variance_m2"].fillna(observation_variance(flight, track, axis, segment))
    s_total = cut["innovation_variance_m2"]
    prior = (s_total - r).where(s_total > r)
    cut["observation_variance_m2"] = r
    cut["prior_variance_m2"] = prior
    # a rejected sample updates nothing
    cut["posterior_variance_m2"] = (prior * r / s_total).where(~(cut["rejected"] > 0), prior)
    return cut


def _innovations_along(north: pd.DataFrame, east: pd.DataFrame, direction: Array) -> pd.DataFrame:
    """Innovations along a horizontal direction, at the times that north and east share."""
    common = north.index.intersection(east.index)
    n, e = north.loc[common], east.loc[common]
    c, s = float(direction[0]), float(direction[1])
    projected = c * c * n + s * s * e  # variances; the rest is set below
    projected["innovation_m"] = c * n["innovation_m"] + s * e["innovation_m"]
    for column in ("test_ratio", "fused", "rejected"):
        # the larger: before v1.14 PX4 keeps one ratio for both; a rejection is of the vector
        projected[column] = np.fmax(n[column], e[column])
    return projected


def observation_variance(
    flight: Flight, track: PositionTrack, axis: Axis, segment: Segment
) -> float:
    """R (m²) that EKF2 used for external vision where it does not log it, NaN if unknown.

    R = EKF2_EVP_NOISE², or the sender's variance if larger, unless EKF2_EV_NOISE_MD is 1
    (EKF2.cpp, ev_pos_control.cpp).
    """
    parameters = flight.log.parameters
    if "EKF2_EVP_NOISE" not in parameters:
        return float("nan")
    r = max(parameters["EKF2_EVP_NOISE"], EKF2_MIN_NOISE_M) ** 2
    # what a file of its own reports is not what EKF2 was sent
    if parameters.get("EKF2_EV_NOISE_MD") == 1.0 or track.alignment is not None:
        return r
    reported = within(track.samples, segment)[POSITION_VARIANCE_COLUMNS].median()
    reported_along = float(np.nansum(reported.to_numpy() * axis.direction**2))
    return max(r, reported_along)


def project_truth(
    truth: Truth | Unavailable, axis: Axis, segment: Segment
) -> pd.DataFrame | Unavailable:
    """Ground truth along the axis, as :func:`project_state`."""
    if isinstance(truth, Unavailable):
        return truth
    projected = project_state(truth.samples, axis, segment)
    if len(projected) < MIN_COMMON_SAMPLES:
        return Unavailable(
            "ground truth",
            f"{truth.name} has no samples in the segment",
            "Analyse more of the log.",
        )
    return projected
