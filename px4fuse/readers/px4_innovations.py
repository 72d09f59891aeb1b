"""EKF2's innovations of external vision, per axis, from a ULog of any release.

Sources: PX4-Autopilot ``EKF2.cpp`` (PublishInnovations), ``msg/EstimatorInnovations.msg``,
``msg/EstimatorAidSource2d.msg``.
"""

from __future__ import annotations

from collections.abc import Mapping

import pandas as pd

from px4fuse.flight import AXIS_NAMES, AxisName, Unavailable, at_times
from px4fuse.readers.layouts import Layout
from px4fuse.readers.px4_topics import HOW_TO_FUSE, INNOVATIONS
from px4fuse.readers.ulog_topics import Topics

# innovations, variances and ratios are logged by separate rate limiters, up to one interval of
# the default profile (0.5 s) apart; S changes little in that time
JOIN_TOLERANCE_S = 0.6
INNOVATION_COLUMNS = [
    "innovation_m", "innovation_variance_m2", "observation_variance_m2", "test_ratio", "fused",
    "rejected",
]  # fmt: skip
Innovations = dict[AxisName, pd.DataFrame | Unavailable]


def read_innovations(
    topics: Topics, fusing: pd.DataFrame | Unavailable, gate: float
) -> tuple[Mapping[AxisName, pd.DataFrame | Unavailable], tuple[str, ...], tuple[str, ...]]:
    """Innovations per axis, each from the best topic that has any, their topics, and notes.

    Parameters
    ----------
    fusing : DataFrame or Unavailable
        As :class:`~px4fuse.flight.Ekf2` has it.
    gate : float
        Of external vision position, for rejections that are not logged.
    """
    found: Innovations = {}
    used: dict[str, None] = {}
    notes: list[str] = []
    for axis in AXIS_NAMES:
        group = "vertical" if axis == "down" else "horizontal"
        if isinstance(fusing, pd.DataFrame) and not fusing[group].any():
            quantity = "height" if axis == "down" else "horizontal position"
            found[axis] = Unavailable(
                f"EKF2 innovations, {axis}",
                f"EKF2 never fused external vision for {quantity} in this log",
                HOW_TO_FUSE[group],
            )
            continue
        fused = None if isinstance(fusing, Unavailable) else fusing[group]
        for layouts in INNOVATIONS[axis]:
            frame = _read(topics, layouts, fused, axis, notes)
            if len(frame):
                found[axis] = frame
                used[layouts[0].topic] = None
                break
        else:
            found[axis] = Unavailable(
                f"EKF2 innovations, {axis}",
                "no usable estimator_aid_src_ev_pos, estimator_aid_src_ev_hgt, "
                "estimator_innovations or ekf2_innovations sample while external vision was fused",
                "Record with SDLOG_PROFILE 129 (default and vision).",
            )
    for topic in used:
        if not any("timestamp_sample" in table for table in topics.of(topic)):
            notes.append(
                f"{topic} has no time of measurement in this release: EKF2's innovations carry the "
                "time of their publication, up to 0.2 s later"
            )
    return _with_rejections(found, gate), tuple(used), tuple(notes)


def _read(
    topics: Topics,
    layouts: tuple[Layout, ...],
    fused: pd.Series | None,
    axis: AxisName,
    notes: list[str],
) -> pd.DataFrame:
    """Innovations of one axis by one release's topics, joined by time; empty without variances.

    ``fused`` is 1 while EKF2 fused external vision along the axis; None where that is not logged.
    """
    first, *others = layouts
    nothing = pd.DataFrame(columns=INNOVATION_COLUMNS)
    if topics.find((first,)) is None:
        return nothing
    own_flags = bool(first.optional)  # only the aid source says for itself what was fused
    frame = topics.of_primary(first, select=None if own_flags else _fresh)
    frame = frame.dropna(subset=["innovation_m"])
    before = len(frame)
    for layout in others:
        if topics.find((layout,)) is not None:
            frame = pd.merge_asof(
                frame, topics.of_primary(layout).dropna(), left_index=True, right_index=True,
                direction="nearest", tolerance=JOIN_TOLERANCE_S,  # type: ignore[arg-type]
            )  # fmt: skip
    if "innovation_variance_m2" not in frame:
        return nothing
    frame = frame.dropna(subset=["innovation_variance_m2"])
    if len(frame) < before and not own_flags:
        notes.append(
            f"{before - len(frame)} of {before} samples of {first.topic} ({axis}) have no "
            f"{layouts[-2:][0].topic} within {JOIN_TOLERANCE_S:g} s and were left out"
        )
    if {"fused", "rejected"} <= {*frame.columns}:
        frame = frame[(frame["fused"] > 0) | (frame["rejected"] > 0)]
    elif fused is not None:
        frame = frame[at_times(fused, frame.index) > 0]
    frame = frame[frame["innovation_variance_m2"] > 0].reindex(columns=INNOVATION_COLUMNS)
    # EKF2 logs state minus measurement; everyone else says measurement minus state
    return frame.assign(innovation_m=-frame["innovation_m"])


def _fresh(frame: pd.DataFrame) -> pd.DataFrame:
    """Innovations of one instance without repeats and without zeros, its value before any fusion.

    These topics repeat the last fusion's value until the next one: a repeat is no new evidence.
    """
    value = frame["innovation_m"]
    return frame[value.ne(value.shift()) & (value != 0)]


def _with_rejections(found: Innovations, gate: float) -> Innovations:
    """Fill ``rejected`` where it is not logged: ν² > gate²·S, for the horizontal vector as one."""
    judged = {}
    for axis, frame in found.items():
        if isinstance(frame, pd.DataFrame):
            beyond = frame["innovation_m"] ** 2 > gate**2 * frame["innovation_variance_m2"]
            judged[axis] = frame["rejected"].fillna(beyond.astype(float))
    if "north" in judged and "east" in judged:
        either = pd.concat([judged["north"], judged["east"]], axis=1).max(axis=1)
        for axis in ("north", "east"):
            judged[axis] = either.reindex(judged[axis].index)
    return {
        axis: frame.assign(rejected=judged[axis]) if isinstance(frame, pd.DataFrame) else frame
        for axis, frame in found.items()
    }
