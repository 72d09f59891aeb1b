"""EKF2's innovations of external vision or GNSS along each axis."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from px4fuse.flight.ekf2_parameters import BAROMETER, GNSS_POS
from px4fuse.flight.model import AXIS_NAMES, AidLog, Ekf2, NedAxis, TableOrUnavailable, Unavailable

Innovations = dict[NedAxis, TableOrUnavailable]


@dataclass(frozen=True)
class Ekf2PositionSource:
    """Position source (external vision or GNSS) and its EKF2 aiding sources."""

    name: str
    # PX4's names of the aiding sources for horizontal position and height
    horizontal_aid: str
    vertical_aid: str
    # Advice to enable fusion, for "horizontal" and "vertical" position
    remedies: Mapping[str, str]
    # Advice if the innovations are not logged
    logging_remedy: str
    # Name of a separate height sensor, if any
    height_sensor: str = ""


VISION = Ekf2PositionSource(
    name="external vision",
    horizontal_aid="ev_pos",
    vertical_aid="ev_hgt",
    remedies={
        # EKF2 starts fusion of vision at sample intervals below 0.2 s (ev_control.cpp)
        "horizontal": "Send the position at 10 Hz or more (EKF2 starts fusion at intervals below "
        "0.2 s) and set bit 0 of EKF2_EV_CTRL (bit 3 of EKF2_AID_MASK before v1.14).",
        "vertical": "Set bit 1 of EKF2_EV_CTRL (EKF2_HGT_MODE 3 before v1.14) to fuse the height "
        "of the source.",
    },
    logging_remedy="Record with SDLOG_PROFILE 129 (default and vision).",
)
GNSS = Ekf2PositionSource(
    name="GNSS",
    horizontal_aid="gnss_pos",
    vertical_aid="gnss_hgt",
    remedies={
        "horizontal": "Set bit 0 of EKF2_GPS_CTRL (bit 0 of EKF2_AID_MASK before v1.14), and wait "
        "for a fix that passes EKF2's checks.",
        "vertical": "Set bit 1 of EKF2_GPS_CTRL (EKF2_HGT_MODE 1 before v1.14) to fuse the GNSS "
        "height.",
    },
    logging_remedy="Record with SDLOG_PROFILE bit 0 (default).",
)
GNSS_WITH_BAROMETER_HEIGHT = replace(
    GNSS,
    vertical_aid=BAROMETER.name,
    height_sensor="the barometer",
    remedies={
        **GNSS.remedies,
        "vertical": "Set EKF2_BARO_CTRL to 1 (EKF2_HGT_MODE to 0 before v1.14) to fuse the "
        "barometer height.",
    },
)


def has_fused_aid(ekf2: Ekf2 | Unavailable, aid: str = GNSS_POS.name) -> bool:
    """Return True if EKF2 fused the aiding source at any time."""
    if isinstance(ekf2, Unavailable):
        return False
    if aid_log := ekf2.aids.get(aid):
        if "fused" in aid_log.samples:
            return bool(aid_log.samples["fused"].any())
        if aid_log.enabled is not None:
            return True
    # a valid global position shows that EKF2 fused GNSS
    if (
        aid != GNSS_POS.name
        or "tilt_align" in ekf2.status_flags
        or "xy_global" not in ekf2.status_flags
    ):
        return False
    return bool(ekf2.status_flags["xy_global"].any())


def replace_vision_by_gnss_innovations(ekf2: Ekf2, source: Ekf2PositionSource = GNSS) -> Ekf2:
    """Return the EKF2 data with innovations of GNSS instead of external vision."""
    enabled_flags = {
        group: ekf2.status_flags[name]
        for group, name in (
            ("horizontal", source.horizontal_aid),
            ("vertical", source.vertical_aid),
        )
        if name in ekf2.status_flags
    }
    fusion_flags: TableOrUnavailable = Unavailable(
        "EKF2 fusion flags",
        "the log does not contain the fusion flags of GNSS",
        GNSS.logging_remedy,
    )
    if enabled_flags:
        columns = ["horizontal", "vertical", "yaw"]
        fusion_flags = (
            pd.DataFrame(enabled_flags).ffill().bfill().reindex(columns=columns, fill_value=0.0)
        )
    gate = ekf2.parameters.get(GNSS_POS.gate, GNSS_POS.default_gate)
    innovations, topics = collect_innovations_by_axis(ekf2.aids, fusion_flags, gate, source)
    return replace(
        ekf2,
        innovations=innovations,
        innovation_topics=topics,
        fusion_flags=fusion_flags,
        gate=gate,
    )


def collect_innovations_by_axis(
    aids: Mapping[str, AidLog],
    fusion_flags: TableOrUnavailable,
    gate: float,
    source: Ekf2PositionSource = VISION,
) -> tuple[Innovations, tuple[str, ...]]:
    """Return the innovations along each axis, and the topics that contain them.

    ``gate`` is the innovation gate, a multiple of √S, for logs without rejection flags.
    """
    innovations: Innovations = {}
    used_topics: dict[str, None] = {}
    for axis in AXIS_NAMES:
        axis_group, quantity = "horizontal", "horizontal position"
        aid_name, sensor_name = source.horizontal_aid, source.name
        if axis == "down":
            axis_group, quantity = "vertical", "height"
            aid_name, sensor_name = source.vertical_aid, source.height_sensor or source.name
        aid_log = aids.get(aid_name)
        axis_innovations = None if aid_log is None else select_axis_innovations(aid_log, axis, gate)
        remedy = source.logging_remedy
        if isinstance(fusion_flags, pd.DataFrame) and not fusion_flags[axis_group].any():
            reason = f"EKF2 never fused the {quantity} from {sensor_name} in this log"
            remedy = source.remedies[axis_group]
        elif aid_log is None or axis_innovations is None or axis_innovations.empty:
            reason = (
                f"the log has no usable innovation of {sensor_name} in "
                f"estimator_aid_src_{source.horizontal_aid}, "
                f"estimator_aid_src_{source.vertical_aid}, estimator_innovations or "
                "ekf2_innovations"
            )
        else:
            innovations[axis] = axis_innovations
            used_topics |= dict.fromkeys(aid_log.topics)
            continue  # the innovations are available
        innovations[axis] = Unavailable(f"EKF2 innovations, {axis}", reason, remedy)
    return innovations, tuple(used_topics)


def select_axis_innovations(log: AidLog, axis: NedAxis, gate: float) -> pd.DataFrame:
    """Return the innovations along one axis, with the flags "fused" and "rejected".

    ``gate`` is the innovation gate, a multiple of √S. EKF2 rejects a sample along all
    its axes together.
    """
    samples = log.samples
    nis_by_axis = {
        name: samples[f"innovation_{name}"] ** 2 / samples[f"variance_{name}"] for name in log.axes
    }
    rejected = samples.get("rejected")
    if rejected is None:
        rejected = (pd.DataFrame(nis_by_axis).max(axis=1) > gate**2).astype(float)
    innovations = pd.DataFrame(
        {
            "innovation_m": samples[f"innovation_{axis}"],
            "innovation_variance_m2": samples[f"variance_{axis}"],
            "observation_variance_m2": samples.get(f"noise_{axis}", np.nan),
            "test_ratio": nis_by_axis[axis] / gate**2,
            "fused": samples.get("fused", np.nan),
            "rejected": rejected,
        }
    )
    return innovations[
        (innovations["fused"] > 0.0) | (innovations["rejected"] > 0.0) | innovations["fused"].isna()
    ]
