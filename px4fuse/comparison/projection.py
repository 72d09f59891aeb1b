"""EKF2 and ground truth along one axis: resets treated, variances and innovations projected."""

import math
from collections.abc import Iterator, Mapping
from functools import partial

import numpy as np
import pandas as pd

from px4fuse.arrays import Array
from px4fuse.ekf2_parameters import BAROMETER, GNSS_POS
from px4fuse.filter.signals import AISLE, Axis, Segment, along, within
from px4fuse.flight import (
    AXIS_NAMES,
    Columns,
    Ekf2,
    Flight,
    PositionTrack,
    Reset,
    Truth,
    Unavailable,
)
from px4fuse.record import missing_data

# EKF2 never trusts external vision better than this (ev_pos_control.cpp, EKF2.cpp)
EKF2_MIN_NOISE_M = 0.01
# EKF2 takes a height of GNSS for less exact than its position (gnss_height_control.cpp)
GNSS_HEIGHT_SCALE = 1.5
MIN_COMMON_SAMPLES = 3
# What is projected along an axis, from which columns, and by which power of its direction
PROJECTED_COLUMNS: Mapping[str, tuple[list[str], int]] = {
    "position_m": (Columns.POSITION, 1),
    "velocity_m_s": (Columns.VELOCITY, 1),
    "position_variance_m2": (Columns.POSITION_VARIANCE, 2),
    "velocity_variance_m2_s2": (Columns.VELOCITY_VARIANCE, 2),
}
# Undoing resets must bring EKF2 this much closer to the measurements (median squared distance);
# below that the published output, which the vehicle flew on, stands.
MAX_DISTANCE_RATIO = 0.95


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
    resets_inside = [r for r in ekf2.resets if segment.start_s < r.time_s <= segment.end_s]
    state = ekf2.state.copy() if resets_inside else ekf2.state
    kept_resets: list[str] = []
    undone_resets: list[str] = []
    for label, quantity, columns in (
        ("horizontal position", "position", Columns.POSITION[:2]),
        ("height", "position", Columns.POSITION[2:]),
        ("velocity", "velocity", Columns.VELOCITY),
    ):
        axes = [Columns.STATE.index(column) % 3 for column in columns]
        resets = [
            r
            for r in resets_inside
            if r.quantity == quantity and any(r.delta[axis] for axis in axes)
        ]
        if not resets:
            continue
        reset_texts = kept_resets
        if quantity == "position":  # a velocity has no frame origin to lose
            samples = within(track.samples, segment)[columns].dropna()
            best_state = min(
                _continuous_candidates(ekf2.state[columns], resets, axes),
                key=partial(_median_square_distance, samples),
            )
            if _median_square_distance(
                samples, best_state
            ) < MAX_DISTANCE_RATIO * _median_square_distance(samples, ekf2.state):
                state[columns], reset_texts = best_state, undone_resets
        reset_texts.append(f"{len(resets)} of {label}")
    statements = []
    if undone_resets:
        statements.append(f"resets undone: {', '.join(undone_resets)} (they change the frame)")
    if kept_resets:
        statements.append(f"resets kept: {', '.join(kept_resets)} (they correct an error)")
    return state, "; ".join(statements)


def _continuous_candidates(
    published: pd.DataFrame, resets: list[Reset], axes: list[int]
) -> Iterator[pd.DataFrame]:
    """Continuous position, in the frame of each stretch between resets."""
    deltas = np.array([reset.delta for reset in resets])[:, axes]
    after = np.array([published.index >= reset.time_s for reset in resets]).T
    for stretch in range(len(resets) + 1):
        # relative to this stretch: resets before it still to come are added, later ones taken away
        shift = (~after[:, :stretch]) @ deltas[:stretch] - after[:, stretch:] @ deltas[stretch:]
        yield published + shift


def _median_square_distance(samples: pd.DataFrame, state: pd.DataFrame) -> float:
    """Median squared distance of the state from samples."""
    squared = np.zeros(len(samples))
    for column in samples:
        squared += (np.interp(samples.index, state.index, state[column]) - samples[column]) ** 2
    return float(np.median(squared)) if len(squared) else float("inf")


def project(frame: pd.DataFrame, axis: Axis, segment: Segment) -> pd.DataFrame:
    """What a frame holds of :data:`PROJECTED_COLUMNS` along the axis, within the segment."""
    rows = within(frame, segment)
    available = {name: part for name, part in PROJECTED_COLUMNS.items() if part[0][0] in frame}
    projected = {
        name: along(rows, of, axis.direction**power) for name, (of, power) in available.items()
    }
    return pd.DataFrame(projected, index=rows.index)


def project_variance(ekf2: Ekf2, axis: Axis, segment: Segment) -> pd.DataFrame | Unavailable:
    """Variances along the axis; EKF2 logs no covariance between axes, so none is added."""
    if isinstance(ekf2.variance, Unavailable):
        return ekf2.variance
    projected = project(ekf2.variance, axis, segment)
    if projected.empty:
        return missing_data("variances_outside_segment")
    return projected


def project_horizon(ekf2: Ekf2, axis: Axis, segment: Segment) -> pd.DataFrame | None:
    """EKF2's position (m) at its fusion horizon and the variance that it states of it, or None.

    What is published is that position carried to the present by the output predictor, which lags;
    the variance says nothing about that. Where EKF2 met external vision, its position before the
    update is observation minus innovation, and its variance P⁻ = S - R; before v1.16 the log also
    has its delayed state. EKF2 logs no covariance between axes, so none is added.
    """
    weights = dict(zip(AXIS_NAMES, axis.direction.tolist(), strict=True))
    aid = ekf2.aids.get("ev_hgt" if axis.name == "down" else "ev_pos")
    if aid is not None and f"observation_{aid.axes[0]}" in aid.samples:
        samples = within(aid.samples, segment)
        position, variance = (
            sum(
                weights[name] ** power * (samples[f"{a}_{name}"] - samples[f"{b}_{name}"])
                for name in aid.axes
            )
            for power, a, b in ((1, "observation", "innovation"), (2, "variance", "noise"))
        )
        found = pd.DataFrame({"position_m": position, "position_variance_m2": variance})
        return found[found["position_variance_m2"] > 0.0]
    if isinstance(ekf2.record, Unavailable):
        return None
    projected = project(ekf2.record.delayed, axis, segment)
    found = projected[["position_m", "position_variance_m2"]].dropna()
    return found if len(found) else None


def project_innovations(
    flight: Flight, ekf2: Ekf2, track: PositionTrack, axis: Axis, segment: Segment
) -> pd.DataFrame | Unavailable:
    """EKF2's innovations along the axis, with its variances just before and after each update.

    Columns as :attr:`Ekf2.innovations` plus ``prior_variance_m2`` (P⁻ = S - R) and
    ``posterior_variance_m2`` (P⁺ = P⁻R/S, or P⁻ where rejected), NaN where R is unknown.
    """
    if track.aid(axis.name) is None:
        return missing_data("innovations_of_another", name=track.name)
    frames = []
    for name in ("north", "east") if axis.name == AISLE else (axis.name,):
        frame = next(frame for key, frame in ekf2.innovations.items() if key == name)
        if isinstance(frame, Unavailable):
            return frame
        frames.append(frame)
    rows = within(frames[0], segment).copy()
    if axis.name == AISLE:
        rows = _innovations_along(rows, frames[1], axis.direction)
    if rows.empty:
        return missing_data("innovations_outside_segment")
    r = rows["observation_variance_m2"].fillna(observation_variance(flight, track, axis, segment))
    s_total = rows["innovation_variance_m2"]
    prior = (s_total - r).where(s_total > r)
    rows["observation_variance_m2"] = r
    rows["prior_variance_m2"] = prior
    # a rejected sample updates nothing
    rows["posterior_variance_m2"] = (prior * r / s_total).where(~(rows["rejected"] > 0), prior)
    return rows


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
    flight: Flight,
    track: PositionTrack,
    axis: Axis,
    segment: Segment,
    default_noise_m: float = math.nan,
) -> float:
    """R (m²) that EKF2 used for the source where it does not log it, NaN if unknown.

    ``default_noise_m`` is taken for EKF2's own noise where the parameter is not in the log.

    R = EKF2_EVP_NOISE², or the sender's variance if larger, unless EKF2_EV_NOISE_MD is 1
    (EKF2.cpp, ev_pos_control.cpp); of GNSS EKF2_GPS_P_NOISE², half as much again in σ for height,
    or the receiver's accuracy if larger (gps_control.cpp, gnss_height_control.cpp); of the
    barometer EKF2_BARO_NOISE² (baro_height_control.cpp).
    """
    aid, parameters, ekf2 = track.aid(axis.name), flight.log.parameters, flight.ekf2
    if aid is not None and isinstance(ekf2, Ekf2) and aid.name in ekf2.aids:
        parameters = {**parameters, **ekf2.aids[aid.name].parameters}
    noise_m = default_noise_m if aid is None else parameters.get(aid.noise, default_noise_m)
    if aid is None or math.isnan(noise_m):
        return math.nan
    scale = GNSS_HEIGHT_SCALE if aid == GNSS_POS and axis.name == "down" else 1.0
    r = max(scale * noise_m, EKF2_MIN_NOISE_M) ** 2
    # what a file of its own reports is not what EKF2 was sent
    ignores_reported = track.alignment is not None or aid == BAROMETER
    if ignores_reported or parameters.get(aid.noise_mode) == 1.0:
        return r
    reported = within(track.samples, segment)[Columns.POSITION_VARIANCE].median()
    reported_along = float(np.nansum(reported.to_numpy() * axis.direction**2))
    return max(r, reported_along)


def project_truth(
    truth: Truth | Unavailable, axis: Axis, segment: Segment
) -> pd.DataFrame | Unavailable:
    """Position and velocity of the ground truth along the axis."""
    if isinstance(truth, Unavailable):
        return truth
    projected = project(truth.samples, axis, segment)
    if len(projected) < MIN_COMMON_SAMPLES:
        return missing_data("truth_outside_segment", name=truth.name)
    return projected
