"""EKF2's innovations of external vision, per axis, from a ULog of any release.

Sources: PX4-Autopilot ``EKF2.cpp`` (PublishInnovations), ``msg/EstimatorInnovations.msg``,
``msg/EstimatorAidSource2d.msg``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
import pandas as pd

from px4fuse.flight import AXIS_NAMES, AxisName, Unavailable
from px4fuse.readers.px4_instances import Instances, of_primary
from px4fuse.readers.px4_topics import AID_SOURCE, INNOVATIONS, InnovationLayout, Layout
from px4fuse.readers.ulog_topics import Topics

# EKF2_EV_CTRL and EKF2_AID_MASK, ekf2_params.c; EV_MAX_INTERVAL, ev_control.cpp
_HOW_TO_FUSE = {
    "horizontal": "Send the position at 10 Hz (EKF2 starts on samples less than 0.2 s apart) and "
    "set bit 0 of EKF2_EV_CTRL (bit 3 of EKF2_AID_MASK before v1.14).",
    "vertical": "Set bit 1 of EKF2_EV_CTRL (EKF2_HGT_MODE 3 before v1.14) if EKF2 is to fuse the "
    "source's height.",
}
# innovations, variances and ratios are logged by separate rate limiters, up to one interval of
# the default profile (0.5 s) apart; S changes little in that time
JOIN_TOLERANCE_S = 0.6
INNOVATION_COLUMNS = [
    "innovation_m",
    "innovation_variance_m2",
    "observation_variance_m2",
    "test_ratio",
    "fused",
    "rejected",
]


def read_innovations(
    topics: Topics,
    instances: Instances,
    fusing: pd.DataFrame | Unavailable,
    gate: float,
    notes: list[str],
) -> tuple[Mapping[AxisName, pd.DataFrame | Unavailable], tuple[str, ...]]:
    """Innovations per axis and their topics, each from the best one that has any.

    Parameters
    ----------
    instances : tuple of (float, int)
    fusing : DataFrame or Unavailable
        As :class:`~px4fuse.flight.Ekf2` has it.
    gate : float
        EKF2_EVP_GATE, for rejections that are not logged.
    notes : list of str
        Takes what was joined and dropped.
    """
    found: dict[AxisName, pd.DataFrame | Unavailable] = {}
    used: dict[str, None] = {}
    for axis in AXIS_NAMES:
        if isinstance(fusing, pd.DataFrame) and not fusing[_group(axis)].any():
            quantity = "height" if axis == "down" else "horizontal position"
            found[axis] = Unavailable(
                f"EKF2 innovations, {axis}",
                f"EKF2 never fused external vision for {quantity} in this log",
                _HOW_TO_FUSE[_group(axis)],
            )
            continue
        for topic, frame in _candidates(topics, instances, fusing, axis, notes):
            if len(frame):
                found[axis] = frame
                used[topic] = None
                break
        else:
            found[axis] = Unavailable(
                f"EKF2 innovations, {axis}",
                "no usable estimator_aid_src_ev_pos, estimator_aid_src_ev_hgt, "
                "estimator_innovations or ekf2_innovations sample while external vision was fused",
                "Record with SDLOG_PROFILE 129 (default and vision).",
            )
    for topic in used:
        if not any("timestamp_sample" in topics.tables[topic, n] for n in topics.instances(topic)):
            notes.append(
                f"{topic} has no time of measurement in this release: EKF2's innovations carry the "
                "time of their publication, up to 0.2 s later"
            )
    return _with_rejections(found, gate), tuple(used)


def _candidates(
    topics: Topics,
    instances: Instances,
    fusing: pd.DataFrame | Unavailable,
    axis: AxisName,
    notes: list[str],
) -> Iterator[tuple[str, pd.DataFrame]]:
    """Innovations of one axis by each topic that has them: the aid source's, then the older."""
    layout = topics.find(AID_SOURCE[axis])
    if layout is not None:
        yield layout.topic, _read_aid_source(topics, instances, layout, fusing, axis)
    for older in INNOVATIONS:
        joined = _read_joined(topics, instances, older, fusing, axis, notes)
        if joined is not None:
            yield older.topic, joined


def _with_rejections(
    found: dict[AxisName, pd.DataFrame | Unavailable], gate: float
) -> dict[AxisName, pd.DataFrame | Unavailable]:
    """Fill ``rejected`` where it is not logged: ν² > gate²·S, for the horizontal vector as one."""
    judged = {}
    for axis, frame in found.items():
        if isinstance(frame, pd.DataFrame):
            beyond = frame["innovation_m"] ** 2 > gate**2 * frame["innovation_variance_m2"]
            judged[axis] = frame["rejected"].fillna(beyond.astype(float))
    if "north" in judged and "east" in judged:
        either = pd.concat([judged["north"], judged["east"]], axis=1).max(axis=1)
        judged["north"] = either.reindex(judged["north"].index)
        judged["east"] = either.reindex(judged["east"].index)
    return {
        axis: frame.assign(rejected=judged[axis]) if isinstance(frame, pd.DataFrame) else frame
        for axis, frame in found.items()
    }


def _group(axis: AxisName) -> str:
    return "vertical" if axis == "down" else "horizontal"


def _while_fused(
    frame: pd.DataFrame, fusing: pd.DataFrame | Unavailable, axis: AxisName
) -> pd.DataFrame:
    """Rows at whose times EKF2 fused external vision along an axis, where that is logged."""
    if isinstance(fusing, Unavailable):
        return frame
    # a step function; its first value holds before its first step too
    at = np.clip(np.searchsorted(fusing.index, frame.index, side="right") - 1, 0, None)
    return frame[fusing[_group(axis)].to_numpy()[at] > 0]


def _read_aid_source(
    topics: Topics,
    instances: Instances,
    layout: Layout,
    fusing: pd.DataFrame | Unavailable,
    axis: AxisName,
) -> pd.DataFrame:
    frame = of_primary(topics, layout, instances)
    if "fused" in frame and "rejected" in frame:
        frame = frame[(frame["fused"] > 0) | (frame["rejected"] > 0)]
    else:
        frame = _while_fused(frame, fusing, axis)
    usable = (frame["innovation_variance_m2"] > 0) & frame["innovation_m"].notna()
    return _flipped(frame[usable])


def _read_joined(
    topics: Topics,
    instances: Instances,
    layout: InnovationLayout,
    fusing: pd.DataFrame | Unavailable,
    axis: AxisName,
    notes: list[str],
) -> pd.DataFrame | None:
    """Join the innovation, variance and ratio topics by time, within a stated tolerance."""
    parts: dict[str, pd.DataFrame] = {}
    wanted = {
        "innovation_m": (layout.topic, layout.fields),
        "innovation_variance_m2": (layout.variance_topic, layout.variance_fields),
        "test_ratio": (layout.ratio_topic, layout.ratio_fields),
    }
    for column, (topic, fields) in wanted.items():
        if axis not in fields:
            continue
        single = topics.find((Layout(topic, {column: fields[axis]}, layout.since),))
        if single is not None:
            select = _fresh if column == "innovation_m" else None
            parts[column] = of_primary(topics, single, instances, select=select).dropna()
    if "innovation_m" not in parts or "innovation_variance_m2" not in parts:
        return None
    frame = parts.pop("innovation_m")
    before = len(frame)
    for column, part in parts.items():
        frame = pd.merge_asof(
            frame, part[[column]], left_index=True, right_index=True,
            direction="nearest", tolerance=JOIN_TOLERANCE_S,  # type: ignore[arg-type]
        )  # fmt: skip
    frame = frame.dropna(subset=["innovation_variance_m2"])
    if len(frame) < before:
        notes.append(
            f"{before - len(frame)} of {before} samples of {layout.topic} ({axis}) have no "
            f"{layout.variance_topic} within {JOIN_TOLERANCE_S:g} s and were left out"
        )
    return _flipped(_while_fused(frame[frame["innovation_variance_m2"] > 0], fusing, axis))


def _fresh(frame: pd.DataFrame) -> pd.DataFrame:
    """Innovations of one instance without repeats and without zeros, its value before any fusion.

    These topics repeat the last fusion's value until the next one: a repeat is no new evidence.
    """
    value = frame["innovation_m"]
    return frame[value.ne(value.shift()) & (value != 0)]


def _flipped(frame: pd.DataFrame) -> pd.DataFrame:
    """EKF2 logs state minus measurement; everyone else says measurement minus state."""
    flipped = frame.reindex(columns=INNOVATION_COLUMNS)
    flipped["innovation_m"] = -flipped["innovation_m"]
    return flipped
