"""Projection of EKF2's data and ground truth onto one axis, and removal of EKF2's resets."""

import math
from collections.abc import Iterator, Mapping
from functools import partial

import numpy as np
import pandas as pd

from px4fuse.core.arrays import Array
from px4fuse.ekf2.heights import GNSS_HEIGHT_NOISE_FACTOR
from px4fuse.filter.signals import AISLE_AXIS, Axis, Segment, cut_to_segment, weighted_sum
from px4fuse.flight.ekf2_parameters import BAROMETER, GNSS_POS
from px4fuse.flight.model import (
    AXIS_NAMES,
    Columns,
    Ekf2,
    Flight,
    PositionTrack,
    Reset,
    Truth,
    Unavailable,
)

# Minimum measurement noise √R (m) that EKF2 uses (ev_pos_control.cpp, EKF2.cpp)
EKF2_MIN_NOISE_M = 0.01
MIN_COMPARED_SAMPLES = 3
# Each quantity is projected onto an axis from these NED columns, weighted by the direction cosines
# with this exponent (2 for variances)
PROJECTED_COLUMNS: Mapping[str, tuple[list[str], int]] = {
    "position_m": (Columns.POSITION, 1),
    "velocity_m_s": (Columns.VELOCITY, 1),
    "position_variance_m2": (Columns.POSITION_VARIANCE, 2),
    "velocity_variance_m2_s2": (Columns.VELOCITY_VARIANCE, 2),
}
# Resets are removed from EKF2's track if this reduces the median squared distance between track
# and measured positions to less than this fraction
MAX_SQUARED_DISTANCE_RATIO_WITHOUT_RESETS = 0.95


def remove_origin_resets(
    ekf2: Ekf2, track: PositionTrack, segment: Segment
) -> tuple[pd.DataFrame, str]:
    """Remove the resets of EKF2's position that only move the origin of its frame.

    All other resets correct an error of EKF2 and are kept.

    Returns
    -------
    state : DataFrame
        Position and velocity as in :attr:`Ekf2.state`.
    statement : str
        Number of removed resets and of other resets, as text.
    """
    resets_in_segment = [
        reset for reset in ekf2.resets if segment.start_s < reset.time_s <= segment.end_s
    ]
    state = ekf2.state.copy() if resets_in_segment else ekf2.state
    # Number of resets of each quantity that are removed or kept, for example "2 of height"
    removed_texts, kept_texts = list[str](), list[str]()
    for label, quantity, columns in (
        ("horizontal position", "position", Columns.POSITION[:2]),
        ("height", "position", Columns.POSITION[2:]),
        ("velocity", "velocity", Columns.VELOCITY),
    ):
        # Indices in Reset.delta: 0 north, 1 east, 2 down
        axes = [Columns.STATE.index(column) % 3 for column in columns]
        resets = [
            reset
            for reset in resets_in_segment
            if reset.quantity == quantity and any(reset.delta[axis] for axis in axes)
        ]
        if not resets:
            continue
        has_only_moved_origin = False
        if quantity == "position":  # a velocity does not depend on the origin
            # Resets that only move the origin are recognised by the distance to the measured
            # positions: without the resets, EKF2's track is closer to them
            samples = cut_to_segment(track.samples, segment)[columns].dropna()
            compute_squared_distance_m2 = partial(_compute_squared_distance_m2, samples)
            candidates = _make_states_without_resets(ekf2.state[columns], resets, axes)
            closest_state = min(candidates, key=compute_squared_distance_m2)
            has_only_moved_origin = compute_squared_distance_m2(
                closest_state
            ) < MAX_SQUARED_DISTANCE_RATIO_WITHOUT_RESETS * compute_squared_distance_m2(ekf2.state)
            if has_only_moved_origin:
                state[columns] = closest_state
        texts = removed_texts if has_only_moved_origin else kept_texts
        texts.append(f"{len(resets)} of {label}")
    treatments = {
        "removed from EKF2's track: the resets only move the origin of EKF2's frame": removed_texts,
        "kept in EKF2's track: the resets correct an error of EKF2": kept_texts,
    }
    statements = (
        f"Jumps by EKF2 resets ({', '.join(texts)}) are {treatment}"
        for treatment, texts in treatments.items()
        if texts
    )
    return state, ". ".join(statements)


def _make_states_without_resets(
    published_state: pd.DataFrame, resets: list[Reset], axes: list[int]
) -> Iterator[pd.DataFrame]:
    """Yield EKF2's positions with all reset jumps removed, once for each possible origin.

    n resets divide the flight into n + 1 intervals with different origins. Each yielded table
    expresses all positions relative to the origin of one interval.
    """
    reset_m = np.array([reset.delta for reset in resets])[:, axes]
    is_after_reset = np.array([published_state.index >= reset.time_s for reset in resets]).T
    # Subtract all earlier resets from each position. All positions then refer to the origin of the
    # first interval
    state_without_resets = published_state - is_after_reset @ reset_m
    yield state_without_resets
    # The sum of the first k resets converts positions relative to the origin of the first interval
    # to positions relative to the origin of interval k + 1
    for origin_shift_m in np.cumsum(reset_m, axis=0):
        yield state_without_resets + origin_shift_m


def _compute_squared_distance_m2(samples: pd.DataFrame, state: pd.DataFrame) -> float:
    squared_distance_m2 = np.zeros(len(samples))
    for column in samples:
        squared_distance_m2 += (
            np.interp(samples.index, state.index, state[column]) - samples[column]
        ) ** 2
    return float(np.median(squared_distance_m2)) if len(squared_distance_m2) else float("inf")


def project(table: pd.DataFrame, axis: Axis, segment: Segment) -> pd.DataFrame:
    """Cut a table to a time segment, and project positions, velocities and variances onto an axis.

    Quantities without columns in ``table`` are omitted. Variances are projected with squared
    direction cosines, without covariances.
    """
    rows = cut_to_segment(table, segment)
    projected_columns = {
        name: weighted_sum(rows, columns, axis.direction**exponent)
        for name, (columns, exponent) in PROJECTED_COLUMNS.items()
        if columns[0] in table
    }
    return pd.DataFrame(projected_columns, index=rows.index)


def _make_no_samples_result(quantity_name: str) -> Unavailable:
    reason = f"the log contains no {quantity_name} in the analysed time span"
    return Unavailable(quantity_name, reason, "Analyse a longer time span.")


def project_variance(ekf2: Ekf2, axis: Axis, segment: Segment) -> pd.DataFrame | Unavailable:
    """Project EKF2's variances onto an axis, without covariances, which are not logged."""
    if isinstance(ekf2.variance, Unavailable):
        return ekf2.variance
    projected_variance = project(ekf2.variance, axis, segment)
    if projected_variance.empty:
        return _make_no_samples_result("EKF2 variances")
    return projected_variance


def project_fusion_horizon_position(
    ekf2: Ekf2, axis: Axis, segment: Segment
) -> pd.DataFrame | None:
    """Return EKF2's position (m) and its variance (m²) at the fusion horizon, if logged.

    EKF2's variance belongs to this position, not to the published position.
    """
    aid = ekf2.aids.get("ev_hgt" if axis.name == "down" else "ev_pos")
    if aid is not None and f"observation_{aid.axes[0]}" in aid.samples:
        # Before an update, the position is observation - innovation, and the variance P⁻ is S - R
        samples = cut_to_segment(aid.samples, segment)
        weights = axis.direction[[AXIS_NAMES.index(name) for name in aid.axes]]
        observation_m, innovation_m, innovation_variance_m2, noise_variance_m2 = (
            samples[[f"{quantity}_{name}" for name in aid.axes]].to_numpy()
            for quantity in ("observation", "innovation", "variance", "noise")
        )
        positions = pd.DataFrame(
            {
                "position_m": (observation_m - innovation_m) @ weights,
                "position_variance_m2": (innovation_variance_m2 - noise_variance_m2) @ weights**2,
            },
            samples.index,
        )
        if axis.name == "down":
            positions["position_m"] += _find_altitude_offset_m(ekf2, positions["position_m"])
        return positions[positions["position_variance_m2"] > 0.0]
    if isinstance(ekf2.record, Unavailable):
        return None
    # Logs of PX4 before v1.16 contain the state at the fusion horizon
    state = project(ekf2.record.delayed_state, axis, segment)
    positions = state[["position_m", "position_variance_m2"]].dropna()
    return positions if len(positions) else None


def _find_altitude_offset_m(ekf2: Ekf2, down_m: pd.Series) -> float:
    """Return the altitude (m) of EKF2's origin if logged heights are altitudes, else 0.

    ``down_m`` are the logged heights: down from the origin, or negative altitudes. Since PX4
    v1.16, EKF2 fuses altitudes above sea level as soon as it has an origin.
    """
    published_down_m = np.interp(down_m.index, ekf2.state.index, ekf2.state["down_m"])
    altitude_m = 0.0 if isinstance(ekf2.record, Unavailable) else ekf2.record.altitude_m
    # About 0 for heights from the origin, about -altitude_m for altitudes
    difference_m = float((down_m - published_down_m).median())
    return altitude_m if abs(difference_m + altitude_m) < abs(difference_m) else 0.0


def project_innovations(
    flight: Flight, ekf2: Ekf2, track: PositionTrack, axis: Axis, segment: Segment
) -> pd.DataFrame | Unavailable:
    """Project EKF2's innovations onto an axis, and add EKF2's position variance at each update.

    Added columns: ``prior_variance_m2`` (P⁻ = S - R), and ``posterior_variance_m2`` (P⁺ = P⁻R/S, or
    P⁻ if the position is rejected).
    """
    if track.aid(axis.name) is None:
        return Unavailable(
            "EKF2 innovations",
            f"EKF2 never fuses {track.name}; the logged innovations belong to another source",
            "Choose the source that EKF2 fused (--position-source).",
        )
    axis_innovations = []
    for name in ("north", "east") if axis.name == AISLE_AXIS else (axis.name,):
        if isinstance(innovations := ekf2.innovations[name], Unavailable):
            return innovations
        axis_innovations.append(innovations)
    rows = cut_to_segment(axis_innovations[0], segment)
    if axis.name == AISLE_AXIS:
        rows = _combine_north_and_east(rows, axis_innovations[1], axis.direction)
    if rows.empty:
        return _make_no_samples_result("EKF2 innovations")
    noise_variance = rows["observation_variance_m2"].fillna(
        find_observation_variance(flight, track, axis, segment)
    )
    prior_variance = rows["innovation_variance_m2"] - noise_variance
    prior_variance = prior_variance.where(prior_variance > 0.0)
    posterior_variance = prior_variance * noise_variance / rows["innovation_variance_m2"]
    return rows.assign(
        observation_variance_m2=noise_variance,
        prior_variance_m2=prior_variance,
        # EKF2 does not change P if it rejects a position
        posterior_variance_m2=posterior_variance.where(~(rows["rejected"] > 0), prior_variance),
    )


def _combine_north_and_east(
    north_innovations: pd.DataFrame, east_innovations: pd.DataFrame, direction: Array
) -> pd.DataFrame:
    """Project the innovations of north and east onto a horizontal axis, at their common times."""
    common_times = north_innovations.index.intersection(east_innovations.index)
    north, east = north_innovations.loc[common_times], east_innovations.loc[common_times]
    cosine, sine = float(direction[0]), float(direction[1])
    # The weights cos² and sin² are right for variances; the other columns are replaced below
    combined_innovations = cosine * cosine * north + sine * sine * east
    combined_innovations["innovation_m"] = (
        cosine * north["innovation_m"] + sine * east["innovation_m"]
    )
    for column in ("test_ratio", "fused", "rejected"):
        # EKF2 fuses or rejects north and east together: use the larger test ratio or flag of both
        # axes
        combined_innovations[column] = np.fmax(north[column], east[column])
    return combined_innovations


def find_observation_variance(
    flight: Flight,
    track: PositionTrack,
    axis: Axis,
    segment: Segment,
    default_noise_m: float = math.nan,
) -> float:
    """Return EKF2's measurement noise variance R (m²) of the positions; NaN if unknown.

    R is the square of EKF2's noise parameter, or a larger variance that the source reports.
    ``default_noise_m`` replaces a parameter that is not logged. Sources: PX4 EKF2.cpp,
    ev_pos_control.cpp, gps_control.cpp, gnss_height_control.cpp, baro_height_control.cpp.
    """
    aid, parameters, ekf2 = track.aid(axis.name), flight.log.parameters, flight.ekf2
    if aid is None:
        return math.nan
    if isinstance(ekf2, Ekf2) and aid.name in ekf2.aids:
        parameters = {**parameters, **ekf2.aids[aid.name].parameters}
    noise_m = parameters.get(aid.noise, default_noise_m)
    if math.isnan(noise_m):
        return math.nan
    noise_factor = GNSS_HEIGHT_NOISE_FACTOR if aid == GNSS_POS and axis.name == "down" else 1.0
    configured_variance_m2 = max(noise_factor * noise_m, EKF2_MIN_NOISE_M) ** 2
    # EKF2 receives no variance from a position file or barometer
    ignores_reported_variance = track.alignment is not None or aid == BAROMETER
    if ignores_reported_variance or parameters.get(aid.noise_mode_parameter) == 1.0:
        return configured_variance_m2
    median_variance_m2 = cut_to_segment(track.samples, segment)[Columns.POSITION_VARIANCE].median()
    reported_variance_m2 = float(np.nansum(median_variance_m2.to_numpy() * axis.direction**2))
    return max(configured_variance_m2, reported_variance_m2)


def project_truth(
    truth: Truth | Unavailable, axis: Axis, segment: Segment
) -> pd.DataFrame | Unavailable:
    """Project ground truth onto an axis; Unavailable if the segment has hardly any of it."""
    if isinstance(truth, Unavailable):
        return truth
    projected_truth = project(truth.samples, axis, segment)
    if len(projected_truth) < MIN_COMPARED_SAMPLES:
        return _make_no_samples_result("ground truth")
    return projected_truth
