"""EKF2's innovations of external vision, per axis, from what a log has of its aids."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd

from px4fuse.flight import AXIS_NAMES, AidLog, AxisName, Unavailable
from px4fuse.readers.px4_topics import HOW_TO_FUSE

Innovations = dict[AxisName, pd.DataFrame | Unavailable]


def innovations_of(
    aids: Mapping[str, AidLog], fusing: pd.DataFrame | Unavailable, gate: float
) -> tuple[Innovations, tuple[str, ...]]:
    """Innovations per axis, and their topics.

    Parameters
    ----------
    aids : mapping from PX4's name to AidLog
    fusing : DataFrame or Unavailable
        As :class:`~px4fuse.flight.Ekf2` has it.
    gate : float
        Of external vision position, for rejections that are not logged.
    """
    found: Innovations = {}
    used: dict[str, None] = {}
    for axis in AXIS_NAMES:
        group = "vertical" if axis == "down" else "horizontal"
        log = aids.get("ev_hgt" if axis == "down" else "ev_pos")
        frame = None if log is None else _along(log, axis, gate)
        if isinstance(fusing, pd.DataFrame) and not fusing[group].any():
            quantity = "height" if axis == "down" else "horizontal position"
            found[axis] = Unavailable(
                f"EKF2 innovations, {axis}",
                f"EKF2 never fused external vision for {quantity} in this log",
                HOW_TO_FUSE[group],
            )
        elif log is None or frame is None or frame.empty:
            found[axis] = Unavailable(
                f"EKF2 innovations, {axis}",
                "no usable estimator_aid_src_ev_pos, estimator_aid_src_ev_hgt, "
                "estimator_innovations or ekf2_innovations sample while external vision was fused",
                "Record with SDLOG_PROFILE 129 (default and vision).",
            )
        else:
            found[axis] = frame
            used |= dict.fromkeys(log.topics)
    return found, tuple(used)


def _along(log: AidLog, axis: AxisName, gate: float) -> pd.DataFrame:
    """One axis of what was fused or rejected; a rejection is of all axes of the aid."""
    samples = log.samples
    nis = {
        name: samples[f"innovation_{name}"] ** 2 / samples[f"variance_{name}"] for name in log.axes
    }
    beyond = pd.DataFrame(nis).max(axis=1) > gate**2
    frame = pd.DataFrame(
        {
            "innovation_m": samples[f"innovation_{axis}"],
            "innovation_variance_m2": samples[f"variance_{axis}"],
            "observation_variance_m2": samples.get(f"noise_{axis}", np.nan),
            "test_ratio": nis[axis] / gate**2,
            "fused": samples.get("fused", np.nan),
            "rejected": samples.get("rejected", beyond.astype(float)),
        }
    )
    return frame[(frame["fused"] > 0.0) | (frame["rejected"] > 0.0) | frame["fused"].isna()]
